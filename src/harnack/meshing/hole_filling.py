"""Fills the holes of a mesh smoothly, each bounded by a loop of boundary edges.

A filling begins as the triangulation of its loop that has the smallest dihedral angles with the
faces around it (Liepa, Filling Holes in Meshes, 2003) or, for long loops, the smallest area
(Barequet and Sharir 1995), which may cut through a tube where the other goes around it. Edges are
split and flipped until triangles are as large as those around the hole. Then the filling is faired,
to bend as little as possible: the sum of squared Laplacians of positions, over the new vertices and
those of the loop, is minimized, while all vertices of the mesh stay (Botsch and Kobbelt 2004). So
it continues the surface around it, tangents included. Laplacians are those of the filling before;
repeated, with long edges split, this converges to surfaces whose mean curvature is harmonic, such
as spheres and cylinders.

Nothing is proved about such fillings. Fillings that pass the checks of `fill_holes` are returned.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import intersecting_faces
from harnack.meshing.edges import (
    Edges,
    IntArray,
    area_normals,
    edge_keys,
    half_edges,
    row_dots,
    row_norms,
)
from harnack.meshing.refinement import split_faces

__all__ = ["HoleFilling", "fill_holes", "hole_loops"]

# Loops of more edges are not filled: the time grows with the cube of their number.
_MAX_LOOP_EDGES = 600
# The largest number of edges of a loop for which angles count, beyond which areas alone do; and the
# number up to which angles always count.
_MAX_ANGLE_EDGES, _ALWAYS_BY_ANGLES = 150, 10
# Largest angles count as the same if their cosines differ by less than this.
_SAME_TURN = 1e-9
# Edges are split that are longer than this multiple of the usual length around the hole; and the
# number of rounds.
_LONG, _ROUNDS = 1.4, 10
_MAX_CUT = 200_000
# Edges are flipped if the cotangents of the two opposite angles have a sum below this.
_MAX_FLIP_COTANGENT_SUM = -1e-3
_MAX_FLIPS = 12
# Cotangents are clamped to this range, so that every matrix is definite.
_MIN_COTANGENT, _MAX_COTANGENT = 0.02, 20.0
# The strategies in the order of the attempts: whether loops are triangulated by angles, and how
# often the patch is faired, by the cotangents of the patch before.
_STRATEGIES = ((True, 6), (False, 2), (True, 0), (False, 0))
# The largest deviation of the mesh's winding number from 1/2 modulo 1 on a patch.
_MAX_WINDING_DEVIATION = 0.36

Winding = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class HoleFilling:
    """The vertices and faces added to a mesh by filling its holes.

    vertices: (k, 3) new vertices.
    faces: (p, 3) of the fillings; indices below the number of the mesh's vertices are of these.
    unfilled_loops: loops whose fillings failed, each an array of vertices.
    reason: why these failed, in words.
    """

    vertices: FloatArray
    faces: IntArray
    unfilled_loops: list[IntArray]
    reason: str


def fill_holes(
    vertices: FloatArray, faces: IntArray, loops: list[IntArray], winding: Winding
) -> HoleFilling:
    """Fill holes, each bounded by a loop of boundary edges (`hole_loops`).

    A filling is accepted if its triangles have positive area and intersect no other triangle, and
    if the mesh's winding number at its vertices and centers is near 1/2 modulo 1. The latter fails
    where a loop bounds no hole of its own: two loops bound one gap, or another component stands in
    it. Failed loops are tried again with the minimum-area triangulation, then without fairing.

    winding: the winding number of the mesh at points.
    """
    x, together = vertices, faces
    pending: list[IntArray] = loops
    reasons = dict[int, str]()
    for by_angles, fairings in _STRATEGIES:
        if not pending:
            break
        patched, new, owner, reasons = _patches(x, together, pending, by_angles, fairings)
        reasons |= _failures(patched, together, new, owner, len(x), winding)
        is_accepted = ~np.isin(owner, list(reasons))
        x, together = _without_unused_vertices(
            patched, np.concatenate([together, new[is_accepted]]), len(x)
        )
        pending = [pending[k] for k in sorted(reasons)]
    counts = Counter(reasons.values())
    why = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
    return HoleFilling(x[len(vertices) :], together[len(faces) :], pending, why)


def _without_unused_vertices(
    x: FloatArray, faces: IntArray, input_count: int
) -> tuple[FloatArray, IntArray]:
    """The vertices and faces, without new vertices that no face uses."""
    used = np.zeros(len(x), np.bool_)
    used[:input_count] = True
    used[faces] = True
    return x[used], (np.cumsum(used) - 1)[faces]


def _failures(
    x: FloatArray,
    faces: IntArray,
    new: IntArray,
    owner: IntArray,
    input_count: int,
    winding: Winding,
) -> dict[int, str]:
    """The reasons why fillings fail, by loop. new: the faces of fillings; owner: their loops."""
    reasons: dict[int, str] = {}
    if not len(new):
        return reasons
    loop_of = np.zeros(len(x), np.int64)
    loop_of[new] = owner[:, None]
    loops = np.concatenate([owner, loop_of[input_count:]])
    w = winding(np.concatenate([x[new].mean(axis=1), x[input_count:]]))
    is_off = ~(np.abs(w - np.floor(w) - 0.5) <= _MAX_WINDING_DEVIATION)
    reasons |= dict.fromkeys(loops[is_off].tolist(), "not where the winding number is near 1/2")
    together = np.concatenate([faces, new])
    is_new = np.arange(len(together)) >= len(faces)
    met = intersecting_faces(x, together, is_new)
    reasons |= dict.fromkeys(
        owner[met[is_new[met]] - len(faces)].tolist(), "passing through other triangles"
    )
    flat = row_norms(area_normals(x[new])) == 0
    return reasons | dict.fromkeys(owner[flat].tolist(), "with triangles without an area")


# Loops.


def hole_loops(vertices: FloatArray, faces: IntArray, edges: IntArray) -> list[IntArray]:
    """The loops of open edges (k, 2), in the direction of their faces, each without a repeated
    vertex.

    Where several holes meet at a vertex, a loop goes on with the edge that bounds the same gap
    between faces, as seen along the normal there.
    """
    leaving: defaultdict[int, list[int]] = defaultdict(list)
    arriving: defaultdict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        leaving[a].append(b)
        arriving[b].append(a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], area_normals(vertices[faces]))
    following: dict[tuple[int, int], int] = {}
    for v, starts in arriving.items():
        ends = leaving[v]
        if len(ends) > 1:
            ends = _match_loop_edges(vertices, v, normals[v], starts, ends)
        following |= {(a, v): c for a, c in zip(starts, ends, strict=True)}
    loops: list[IntArray] = []
    while following:
        (a, b), _ = next(iter(following.items()))
        path, position = [a], {a: 0}
        while (a, b) in following:
            a, b = b, following.pop((a, b))
            if a in position:  # a loop is complete; what led to it goes on
                first = position[a]
                loops.append(np.array(path[first:]))
                for vertex in path[first + 1 :]:
                    del position[vertex]
                del path[first + 1 :]
            else:
                position[a] = len(path)
                path.append(a)
    return loops


def _match_loop_edges(
    x: FloatArray, v: int, normal: FloatArray, starts: list[int], ends: list[int]
) -> list[int]:
    """For each edge from a start to v, the end to which its loop goes on: the next end
    counter-clockwise, since faces are to the left of their edges and holes to the right."""
    axis = np.eye(3)[np.abs(normal).argmin()]
    unit_normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    u = np.cross(unit_normal, axis)
    w = np.cross(unit_normal, u)

    def angle(k: int) -> float:
        direction = x[k] - x[v]
        return float(np.arctan2(direction @ w, direction @ u))

    free, matches = {c: angle(c) for c in ends}, list[int]()
    for a in starts:
        from_here = angle(a)
        nearest = min(free, key=lambda c: (free[c] - from_here) % (2 * np.pi))
        del free[nearest]
        matches.append(nearest)
    return matches


# Triangulations of loops.


def _patches(
    vertices: FloatArray,
    faces: IntArray,
    loops: list[IntArray],
    by_angles: bool,
    fairings: int,
) -> tuple[FloatArray, IntArray, IntArray, dict[int, str]]:
    """All vertices, those of patches last; the faces of patches; the loop of each face; and the
    reasons why loops have no patch, by loop."""
    third = _opposite_corners(faces, np.unique(np.concatenate(loops)), len(vertices))
    used_edges = {(min(edge), max(edge)) for edge in third}
    fixed_edges = np.array(sorted(used_edges), np.int64).reshape(-1, 2)
    patches, failed = list[IntArray](), dict[int, str]()
    for k, loop in enumerate(loops):
        if len(loop) > _MAX_LOOP_EDGES:
            failed[k] = f"of more than {_MAX_LOOP_EDGES} edges"
            continue
        polygon = loop[::-1].copy()
        limit = _MAX_ANGLE_EDGES if by_angles else _ALWAYS_BY_ANGLES
        plan = _min_dihedral_triangulation if len(polygon) <= limit else _min_area_triangulation
        triangles = plan(vertices, polygon, third, used_edges)
        if triangles is None:
            failed[k] = "between edges that are joined already"
            continue
        used_edges |= {(min(e), max(e)) for e in half_edges(triangles).tolist()}
        patches.append(triangles)
    if not patches:
        return vertices, faces[:0], np.zeros(0, np.int64), failed
    sized, new = _refine(vertices, faces, np.concatenate(patches), fixed_edges)
    for rounds_left in range(fairings if len(sized) > len(vertices) else 0, 0, -1):
        sized[:, :3] = _fair(sized[:, :3], faces, new, len(vertices))
        new = _flipped(sized[:, :3], new, fixed_edges)
        if rounds_left > 2:
            sized, new = _split_long_edges(sized, new)
            new = _flipped(sized[:, :3], new, fixed_edges)
    return sized[:, :3], new, _loop_of_faces(new, loops, len(sized)), failed


def _opposite_corners(faces: IntArray, rims: IntArray, count: int) -> dict[tuple[int, int], int]:
    """The third corners of faces, by their directed edges between some vertices."""
    is_rim = np.zeros(count, np.bool_)
    is_rim[rims] = True
    directed = half_edges(faces)
    near = is_rim[directed].all(axis=1)
    third = np.roll(faces, 1, axis=1).T.ravel()[near].tolist()
    ends = directed[near].tolist()
    return {(a, b): c for (a, b), c in zip(ends, third, strict=True)}


def _forbidden_diagonals(polygon: IntArray, used_edges: set[tuple[int, int]]) -> BoolArray:
    """(n, n) which diagonals of a polygon are already edges."""
    n = len(polygon)
    barred = np.zeros((n, n), np.bool_)
    position = {v: k for k, v in enumerate(polygon.tolist())}
    for a, b in used_edges if n * n > len(used_edges) else _pairs(polygon, used_edges):
        if a in position and b in position:
            barred[position[a], position[b]] = barred[position[b], position[a]] = True
    k = np.arange(n)
    barred[k, (k + 1) % n] = barred[(k + 1) % n, k] = False
    return barred


def _pairs(polygon: IntArray, used_edges: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """The pairs of a polygon's vertices that are already edges."""
    ordered = sorted(polygon.tolist())
    return [(a, b) for i, a in enumerate(ordered) for b in ordered[i + 1 :] if (a, b) in used_edges]


def _min_area_triangulation(
    x: FloatArray,
    polygon: IntArray,
    third: dict[tuple[int, int], int],
    used_edges: set[tuple[int, int]],
) -> IntArray | None:
    """The triangulation (n - 2, 3) of a polygon with the smallest area; None if existing edges
    exclude every triangulation."""
    n, corner = len(polygon), x[polygon]
    if n == 3:
        return polygon[None]
    cost = np.where(_forbidden_diagonals(polygon, used_edges), np.inf, 0.0)
    middle = np.zeros((n, n), np.int64)
    for d in range(2, n):
        i = np.arange(n - d)[:, None]
        m = i + np.arange(1, d)
        area = 0.5 * row_norms(
            np.cross(corner[m] - corner[i], corner[i + d] - corner[i]).reshape(-1, 3)
        ).reshape(m.shape)
        total = cost[i, m] + cost[m, i + d] + area
        best = total.argmin(axis=1)
        rows = np.arange(n - d)
        cost[rows, rows + d] += total[rows, best]
        middle[rows, rows + d] = m[rows, best]
    if not np.isfinite(cost[0, n - 1]):
        return None
    return polygon[_triangles_of_plan(middle, n)]


def _triangles_of_plan(middle: IntArray, n: int) -> IntArray:
    """The triangles of a plan: middle[i, k] is the third corner of the triangle at the diagonal
    from i to k, on the side of the corners between them."""
    triangles, todo = list[tuple[int, int, int]](), [(0, n - 1)]
    while todo:
        i, k = todo.pop()
        if k - i > 1:
            m = int(middle[i, k])
            triangles.append((i, m, k))
            todo += [(i, m), (m, k)]
    return np.array(triangles, np.int64)


def _min_dihedral_triangulation(
    x: FloatArray,
    polygon: IntArray,
    third: dict[tuple[int, int], int],
    used_edges: set[tuple[int, int]],
) -> IntArray | None:
    """The triangulation of a polygon whose largest angle between neighbors, including those around
    the polygon, is smallest; of equal angles the one with the smallest area (Liepa 2003)."""
    n, corner = len(polygon), x[polygon]
    if n == 3:
        return polygon[None]
    barred = _forbidden_diagonals(polygon, used_edges)
    beside = np.zeros((n, n, 3))  # 0: no neighbor, or not yet
    for k in range(n):
        a, b = int(polygon[k]), int(polygon[(k + 1) % n])
        if (b, a) in third:
            face = np.array([[b, a, third[b, a]]])
            beside[k, (k + 1) % n] = _unit(area_normals(x[face]))[0]
    turn, area = np.full((n, n), -1.0), np.zeros((n, n))
    middle = np.zeros((n, n), np.int64)
    for d in range(2, n):
        i = np.arange(n - d)[:, None]
        m, k = i + np.arange(1, d), i + d
        cross = np.cross(corner[m] - corner[i], corner[k] - corner[i])
        normals = _unit(cross)
        sides = [beside[i, m], beside[m, k]]
        if d == n - 1:
            sides.append(np.broadcast_to(beside[k, i], normals.shape))
        turns = [-np.einsum("imk,imk->im", normals, side) for side in sides]
        turns = [np.where(side.any(axis=2), t, -1.0) for side, t in zip(sides, turns, strict=True)]
        worst = np.maximum.reduce([*turns, turn[i, m], turn[m, k]])
        size = area[i, m] + area[m, k] + np.sqrt((cross**2).sum(axis=2))
        smallest = worst.min(axis=1, keepdims=True)
        best = np.where(worst <= smallest + _SAME_TURN, size, np.inf).argmin(axis=1)
        rows = np.arange(n - d)
        bar = barred[rows, rows + d] if d < n - 1 else np.zeros(1, np.bool_)
        turn[rows, rows + d] = np.where(bar, np.inf, worst[rows, best])
        area[rows, rows + d] = size[rows, best]
        middle[rows, rows + d] = m[rows, best]
        beside[rows, rows + d] = normals[rows, best]
    if not np.isfinite(turn[0, n - 1]):
        return None
    return polygon[_triangles_of_plan(middle, n)]


def _unit(vectors: FloatArray) -> FloatArray:
    """(..., 3) vectors scaled to length 1; 0 stays 0."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


# Finer triangles.


def _refine(
    vertices: FloatArray, faces: IntArray, new: IntArray, fixed_edges: IntArray
) -> tuple[FloatArray, IntArray]:
    """All vertices (n, 4), new vertices last, each with the usual length of edges there; and
    patches of triangles about as large as those around them, with the smallest area.

    fixed_edges: (t, 2) the existing edges.
    """
    input_count = len(vertices)
    x = np.column_stack([vertices, _mean_edge_lengths(vertices, faces, np.unique(new))])
    for _ in range(_ROUNDS):
        new, count = _flipped(x[:, :3], new, fixed_edges), len(x)
        x, new = _split_long_edges(x, new)
        if len(x) == count:
            break
        x = _at_neighbor_means(x, new, input_count)
    return x, _flipped(x[:, :3], new, fixed_edges)


def _split_long_edges(x: FloatArray, new: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 4) and triangles, with edges that are too long cut in the middle."""
    edges = Edges.of(half_edges(new))
    ends = x[edges.vertices]
    long = row_norms(ends[:, 0, :3] - ends[:, 1, :3]) > _LONG * ends[:, :, 3].mean(axis=1)
    rows = np.flatnonzero(long & (edges.multiplicity == 2))
    if not len(rows) or len(new) > _MAX_CUT:
        return x, new
    midpoint = np.full(len(edges.vertices), -1, np.int64)
    midpoint[rows] = len(x) + np.arange(len(rows))
    x = np.concatenate([x, ends[rows].mean(axis=1)])
    return x, split_faces(x[:, :3], new, midpoint[edges.edge_of_pair].reshape(3, -1).T)


def _mean_edge_lengths(x: FloatArray, faces: IntArray, rims: IntArray) -> FloatArray:
    """(n,) the mean length of a vertex's edges, at the vertices `rims`; 0 at others."""
    is_rim = np.zeros(len(x), np.bool_)
    is_rim[rims] = True
    edges = Edges.of(half_edges(faces[is_rim[faces].any(axis=1)])).vertices
    long = row_norms(x[edges[:, 0]] - x[edges[:, 1]])
    total, count = (
        np.bincount(edges.ravel(), np.repeat(weights, 2), minlength=len(x))
        for weights in (long, np.ones(len(long)))
    )
    return np.where(is_rim, total / np.maximum(count, 1), 0.0)


def _at_neighbor_means(x: FloatArray, new: IntArray, input_count: int) -> FloatArray:
    """(n, 4) the vertices, with the rows of new vertices in the middle of their neighbors' rows."""
    ends = Edges.of(half_edges(new)).vertices
    weights = _graph_laplacian(ends, np.ones(len(ends)), len(x))
    return _solve_least_squares(weights[input_count:], x, input_count)


def _solve_least_squares(rows: Any, x: FloatArray, input_count: int) -> FloatArray:
    """All rows, with those from `input_count` on chosen so that a linear map of all is nearest to
    0."""
    import scipy.sparse.linalg as linalg  # imported here: it takes half a second

    solver = cast("Any", linalg)
    inner, fixed = rows[:, input_count:], rows[:, :input_count]
    after = x.copy()
    right = inner.T @ (fixed @ x[:input_count])
    after[input_count:] = -solver.splu((inner.T @ inner).tocsc()).solve(np.asarray(right))
    return after


def _graph_laplacian(ends: IntArray, weight: FloatArray, count: int) -> Any:
    """The Laplacian of a graph with these edges (k, 2), as a sparse matrix."""
    import scipy.sparse  # imported here: it takes half a second

    sparse = cast("Any", scipy.sparse)
    a, b = ends.T
    total = np.bincount(ends.ravel(), np.repeat(weight, 2), minlength=count)
    every = np.arange(count)
    return sparse.coo_matrix(
        (
            np.concatenate([-weight, -weight, total]),
            (np.concatenate([a, b, every]), np.concatenate([b, a, every])),
        ),
        shape=(count, count),
    ).tocsr()


def _fair(x: FloatArray, faces: IntArray, new: IntArray, input_count: int) -> FloatArray:
    """The vertices, with new vertices where the patches and the faces around them bend least."""
    is_rim = np.zeros(len(x), np.bool_)
    is_rim[new] = True
    triangles = np.concatenate([faces[is_rim[faces].any(axis=1)], new])
    edges = Edges.of(half_edges(triangles))
    corner = x[triangles]
    weight = np.zeros(len(edges.vertices))
    area = np.zeros(len(x))
    double = np.maximum(row_norms(area_normals(x[triangles])), 1e-300)
    for k in range(3):  # the edge from corner k to k + 1 is opposite to corner k + 2
        u, w = (corner[:, j] - corner[:, k - 1] for j in (k, (k + 1) % 3))
        cotangent = np.clip(row_dots(u, w) / double, -_MAX_COTANGENT, _MAX_COTANGENT)
        m = len(triangles)
        np.add.at(weight, edges.edge_of_pair[k * m : (k + 1) * m], 0.5 * cotangent)
        np.add.at(area, triangles[:, k], double / 6)
    weight = np.maximum(weight, _MIN_COTANGENT)
    # Beside holes that remain open only new vertices count.
    is_rim[edges.vertices[edges.multiplicity != 2]] = False
    rows = np.flatnonzero(is_rim & (area > 0))
    laplacian = _graph_laplacian(edges.vertices, weight, len(x))[rows]
    scale = 1 / np.sqrt(np.maximum(area[rows], 1e-300))
    return _solve_least_squares(laplacian.multiply(scale[:, None]).tocsr(), x, input_count)


def _flipped(x: FloatArray, new: IntArray, fixed_edges: IntArray) -> IntArray:
    """Triangles with edges flipped so that angles opposite to them are small (Delaunay's
    criterion), where the new edge does not exist yet and no triangle turns over."""
    new = new.copy()
    fixed_keys = edge_keys(fixed_edges, len(x))
    for _ in range(_MAX_FLIPS):
        edges = Edges.of(half_edges(new))
        half = edges.paired_half_edges()
        f, g = half.T % len(new)
        k, j = half.T // len(new)
        a, b, c, d = new[f, k], new[f, (k + 1) % 3], new[f, (k + 2) % 3], new[g, (j + 2) % 3]
        key = edge_keys(np.column_stack([c, d]), len(x))
        gain = _cotangents(x[a], x[b], x[c]) + _cotangents(x[a], x[b], x[d])
        is_flippable = (gain < _MAX_FLIP_COTANGENT_SUM) & (c != d)
        is_flippable &= ~np.isin(key, fixed_keys) & ~np.isin(key, edge_keys(edges.vertices, len(x)))
        before = area_normals(x[new])
        mean = before[f] + before[g]
        for triangle in ((a, d, c), (d, b, c)):
            is_flippable &= row_dots(area_normals(x[np.column_stack(triangle)]), mean) > 0
        rows = np.flatnonzero(is_flippable)
        rows = rows[np.argsort(gain[rows])]
        rows = rows[np.sort(np.unique(key[rows], return_index=True)[1])]
        best = np.full(len(new), len(rows))
        for side in (f, g):
            np.minimum.at(best, side[rows], np.arange(len(rows)))
        rank = np.arange(len(rows))
        rows = rows[(best[f[rows]] == rank) & (best[g[rows]] == rank)]
        if not len(rows):
            break
        a, b, c, d = a[rows], b[rows], c[rows], d[rows]
        new[f[rows]], new[g[rows]] = np.column_stack([a, d, c]), np.column_stack([d, b, c])
    return new


def _cotangents(a: FloatArray, b: FloatArray, apex: FloatArray) -> FloatArray:
    """(k,) the cotangents of the angles at `apex` between points a and b."""
    u, w = a - apex, b - apex
    return row_dots(u, w) / np.maximum(row_norms(np.cross(u, w)), 1e-300)


def _loop_of_faces(new: IntArray, loops: list[IntArray], count: int) -> IntArray:
    """(p,) the loop of each face of fillings: faces are joined by edges to a face at their loop."""
    import scipy.sparse  # imported here: it takes half a second
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    edges = Edges.of(half_edges(new))
    first, second = edges.paired_half_edges().T % len(new)
    joined = sparse.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(new), len(new)))
    part = np.asarray(csgraph.connected_components(joined, directed=False)[1])
    loop_at = np.full(int(part.max()) + 1, -1, np.int64)
    keys = edge_keys(edges.vertices, count)
    face_at = np.empty(len(keys), np.int64)
    face_at[edges.edge_of_pair] = np.arange(3 * len(new)) % len(new)
    firsts = edge_keys(np.array([loop[:2] for loop in loops]), count)
    positions = np.minimum(np.searchsorted(keys, firsts), len(keys) - 1)
    matched = np.flatnonzero(keys[positions] == firsts)
    loop_at[part[face_at[positions[matched]]]] = matched
    return loop_at[part]
