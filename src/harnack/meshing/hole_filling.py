"""Fills the holes of a triangle mesh smoothly. A loop is a closed chain of boundary edges (edges
with a single face), and it bounds a hole. A patch is the set of new triangles that fills one loop;
all patches together are the filling. Vertices (n, 3) and faces (m, 3), which hold indices of
vertices, belong to the mesh; new vertices have indices from n on. "Existing edges" are those of the
mesh, which a patch must not make a second time.

A patch begins as a triangulation of its loop: the one that has the smallest dihedral angles, also
with the faces around the loop (Liepa, Filling Holes in Meshes, 2003); or, for long loops, the one
with the smallest area (Barequet and Sharir 1995). The two may differ: the smallest area may cut
through a tube where the smallest angles go around it. Edges are split and flipped until triangles
are as large as those around the hole.

Then the patch is faired: its vertices are moved so that it bends as little as possible. The sum of
squared Laplacians of positions, over the new vertices and the vertices of the loop, is minimized,
while all vertices of the mesh stay (Botsch and Kobbelt 2004). So the patch continues the surface
around it, tangents included. The weights of the Laplacians are computed from the patch before this
step. If the step is repeated, with long edges split in between, it converges to surfaces whose mean
curvature is harmonic, such as spheres and cylinders.

Nothing is proved about such patches. `fill_holes` checks them and keeps the ones that pass the
checks.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    edge_keys,
    half_edges,
    normals_at_vertices,
    row_dots,
    row_norms,
)
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.refinement import split_faces
from harnack.meshing.self_intersection import intersecting_faces

__all__ = ["HoleFilling", "fill_holes", "hole_loops"]

# Loops of more edges are not filled: the time grows with the cube of their number.
_MAX_LOOP_EDGES = 600
# Loops of up to the first number of edges are triangulated with the smallest angles, longer ones
# with the smallest area. Loops of up to the second number are triangulated with the smallest angles
# even in attempts that ask for the smallest area.
_MAX_BY_ANGLES, _ALWAYS_BY_ANGLES = 150, 10
# Two angles count as equal if their cosines differ by no more than this.
_EQUAL_COSINES = 1e-9
# Edges are split if they are longer than this multiple of the usual length around the hole; and the
# largest number of rounds of splitting.
_LONG_RATIO, _SPLIT_ROUNDS = 1.4, 10
# Patches of more faces than this are not split any more.
_MAX_FACES_TO_SPLIT = 200_000
# Edges are flipped if the cotangents of the two opposite angles have a sum below this.
_MAX_FLIP_COTANGENT_SUM = -1e-3
# The largest number of rounds of flipping.
_FLIP_ROUNDS = 12
# The weight of an edge in a Laplacian is half of the sum of the cotangents of the two opposite
# angles. Weights are at least the first number and cotangents at most the second in absolute value,
# so that the matrices are positive definite.
_MIN_WEIGHT, _MAX_COTANGENT = 0.02, 20.0
# The strategies, tried in this order: whether loops are triangulated with the smallest angles (else
# area), and how often the patch is faired, each time with the cotangents of the patch before.
_STRATEGIES = ((True, 6), (False, 2), (True, 0), (False, 0))
# The largest deviation of the mesh's winding number from 1/2 modulo 1 on a patch.
_MAX_WINDING_DEVIATION = 0.36

Winding = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class HoleFilling:
    """The vertices and faces that are added to a mesh by filling its holes.

    vertices: (k, 3) new vertices.
    faces: (p, 3) the faces of the patches that were accepted. Indices below the number of the
        mesh's vertices stand for vertices of the mesh, the following ones for new vertices.
    unfilled_loops: the loops whose patches were not accepted, each an array of indices of vertices.
    reason: why these patches were not accepted, in words, with the number of loops for each reason.
    """

    vertices: FloatArray
    faces: IntArray
    unfilled_loops: list[IntArray]
    reason: str


def fill_holes(
    vertices: FloatArray, faces: IntArray, loops: list[IntArray], winding: Winding
) -> HoleFilling:
    """Fill holes of a mesh, each bounded by a loop of boundary edges.

    A patch is accepted if its triangles have positive area and intersect no other triangle, and if
    the mesh's winding number at its vertices and at the centers of its faces is near 1/2 modulo 1.
    The winding number is not near 1/2 if a loop does not bound a hole by itself: two loops bound
    one gap, or another component stands in the hole. Loops whose patches are not accepted are tried
    again by the next strategy: with the triangulation of smallest area, then without fairing.

    vertices, faces: (n, 3), (m, 3) the mesh.
    loops: the indices of the vertices of each loop (`hole_loops`).
    winding: returns the winding numbers (k,) of the mesh at points (k, 3).
    """
    # The mesh with the patches accepted so far, and the loops that are still to be filled.
    x, together = vertices, faces
    pending: list[IntArray] = loops
    reasons = dict[int, str]()
    for by_angles, fairings in _STRATEGIES:
        if not pending:
            break
        patched, new, loop_of_face, reasons = _make_patches(
            x, together, pending, by_angles, fairings
        )
        # `reasons` holds the loops without an accepted patch.
        reasons |= _failure_reasons(patched, together, new, loop_of_face, len(x), winding)
        is_accepted = ~np.isin(loop_of_face, list(reasons))
        x, together = _drop_unused(patched, np.concatenate([together, new[is_accepted]]), len(x))
        pending = [pending[k] for k in sorted(reasons)]
    counts = Counter(reasons.values())
    all_reasons = ", ".join(f"{count:,} {reason}" for reason, count in counts.items())
    return HoleFilling(x[len(vertices) :], together[len(faces) :], pending, all_reasons)


def _drop_unused(x: FloatArray, faces: IntArray, input_count: int) -> tuple[FloatArray, IntArray]:
    """Remove the vertices that no face uses; returns vertices and faces. The first `input_count`
    vertices, which belong to the input mesh, are kept in any case.

    x, faces: (n, 3), (m, 3).
    """
    used = np.zeros(len(x), np.bool_)
    used[:input_count] = True
    used[faces] = True
    return x[used], (np.cumsum(used) - 1)[faces]


def _failure_reasons(
    x: FloatArray,
    faces: IntArray,
    new: IntArray,
    owner: IntArray,
    input_count: int,
    winding: Winding,
) -> dict[int, str]:
    """Find the patches that are not acceptable. Returns a dictionary from the indices of their
    loops to the reasons, in words.

    x: (n, 3) all vertices; the first `input_count` are the vertices of the mesh.
    faces: (m, 3) of the mesh.
    new: (p, 3) the faces of all patches.
    owner: (p,) for each face of a patch, the index of the loop that the patch fills.
    winding: returns the winding numbers (k,) of the mesh at points (k, 3).
    """
    reasons: dict[int, str] = {}
    if not len(new):
        return reasons
    # Centers of new faces and new vertices are tested; `loops` holds the loop of each.
    vertex_loop = np.zeros(len(x), np.int64)
    vertex_loop[new] = owner[:, None]
    loops = np.concatenate([owner, vertex_loop[input_count:]])
    w = winding(np.concatenate([x[new].mean(axis=1), x[input_count:]]))
    # The distance of w from 1/2 modulo 1; not `>`, so that values that are no numbers fail.
    is_off = ~(np.abs(w - np.floor(w) - 0.5) <= _MAX_WINDING_DEVIATION)
    reasons |= dict.fromkeys(loops[is_off].tolist(), "not where the winding number is near 1/2")
    together = np.concatenate([faces, new])
    is_new = np.arange(len(together)) >= len(faces)
    crossing = intersecting_faces(x, together, is_new)
    # Of these, the faces of patches, as indices of `new`.
    reasons |= dict.fromkeys(
        owner[crossing[is_new[crossing]] - len(faces)].tolist(), "passing through other triangles"
    )
    flat = row_norms(area_normals(x[new])) == 0
    return reasons | dict.fromkeys(owner[flat].tolist(), "with triangles without an area")


# Loops.


def hole_loops(vertices: FloatArray, faces: IntArray, edges: IntArray) -> list[IntArray]:
    """The closed loops that boundary edges form, each an array (k,) of indices of vertices without
    repetition.

    vertices, faces: (n, 3), (m, 3) the mesh.
    edges: (k, 2) its boundary edges, in the direction in which the faces run them; loops have this
        direction too.

    If several holes meet at a vertex, a loop goes on with the other edge of the same gap between
    the faces around the vertex.
    """
    leaving: defaultdict[int, list[int]] = defaultdict(list)
    arriving: defaultdict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        leaving[a].append(b)
        arriving[b].append(a)
    normals = normals_at_vertices(vertices, faces)
    # following[a, b] = c: after the edge from a to b, the loop goes on to c.
    following: dict[tuple[int, int], int] = {}
    for v, starts in arriving.items():
        ends = leaving[v]
        if len(ends) > 1:
            ends = _match_loop_edges(vertices, v, normals[v], starts, ends)
        following |= {(a, v): c for a, c in zip(starts, ends, strict=True)}
    loops: list[IntArray] = []
    while following:
        (a, b), _ = next(iter(following.items()))
        # The path so far, and for each of its vertices the position on it.
        path, position = [a], {a: 0}
        while (a, b) in following:
            a, b = b, following.pop((a, b))
            # A vertex is reached again: what follows it on the path is a loop; the rest of the path
            # goes on.
            if a in position:
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
    """Find the vertices with which loops go on at the vertex `v`, at which several holes meet.
    Returns one of `ends` for each vertex in `starts`: the next one counter-clockwise from it,
    around v and as seen from where the normal points. (Faces are to the left of their edges, and
    holes to the right.)

    x: (n, 3) all vertices.
    normal: (3,) of the surface at v, of any length.
    starts, ends: the vertices from which boundary edges lead to v, and the vertices to which
        boundary edges lead from v; the same number of both.
    """
    # u and w are two directions at right angles to the normal and to each other.
    axis = np.eye(3)[np.abs(normal).argmin()]
    unit_normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
    u = np.cross(unit_normal, axis)
    w = np.cross(unit_normal, u)

    def angle(k: int) -> float:
        """The angle in radians, about the normal at v, of the direction to the vertex k."""
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


def _make_patches(
    vertices: FloatArray,
    faces: IntArray,
    loops: list[IntArray],
    by_angles: bool,
    fairings: int,
) -> tuple[FloatArray, IntArray, IntArray, dict[int, str]]:
    """Triangulate all loops, refine the triangulations, and fair them.

    vertices, faces: (n, 3), (m, 3) the mesh.
    loops: the indices of the vertices of each loop.
    by_angles: whether loops are triangulated with the smallest angles between neighboring
        triangles, unless they are long; otherwise with the smallest area, unless they are very
        short.
    fairings: how often patches are faired: their vertices are moved so that they bend least.

    Returns all vertices (k, 3), the new ones last; the faces (p, 3) of patches; (p,) for each face
    the index of the loop that it helps to fill; and a dictionary from the indices of loops without
    a patch to the reasons, in words.
    """
    # For each directed edge around the holes the third corner of its face.
    third = _opposite_corners(faces, np.unique(np.concatenate(loops)), len(vertices))
    used_edges = {(min(edge), max(edge)) for edge in third}
    fixed_edges = np.array(sorted(used_edges), np.int64).reshape(-1, 2)
    patches, failed = list[IntArray](), dict[int, str]()
    for k, loop in enumerate(loops):
        if len(loop) > _MAX_LOOP_EDGES:
            failed[k] = f"of more than {_MAX_LOOP_EDGES} edges"
            continue
        # A patch runs the loop's edges in the other direction than the faces of the mesh.
        polygon = loop[::-1].copy()
        limit = _MAX_BY_ANGLES if by_angles else _ALWAYS_BY_ANGLES
        method = _min_dihedral_triangulation if len(polygon) <= limit else _min_area_triangulation
        triangles = method(vertices, polygon, third, used_edges)
        if triangles is None:
            failed[k] = "between edges that are joined already"
            continue
        used_edges |= {(min(e), max(e)) for e in half_edges(triangles).tolist()}
        patches.append(triangles)
    if not patches:
        return vertices, faces[:0], np.zeros(0, np.int64), failed
    # x has four columns: the coordinates, and the usual length of edges (`_refine_patches`).
    x, new = _refine_patches(vertices, faces, np.concatenate(patches), fixed_edges)
    # Without new vertices nothing can be moved. The last two rounds split no edges.
    for rounds_left in range(fairings if len(x) > len(vertices) else 0, 0, -1):
        x[:, :3] = _fair_patches(x[:, :3], faces, new, len(vertices))
        new = _flip_edges(x[:, :3], new, fixed_edges)
        if rounds_left > 2:
            x, new = _split_long_edges(x, new)
            new = _flip_edges(x[:, :3], new, fixed_edges)
    return x[:, :3], new, _loop_of_faces(new, loops, len(x)), failed


def _opposite_corners(faces: IntArray, rims: IntArray, count: int) -> dict[tuple[int, int], int]:
    """A dictionary from directed edges to the third corner of the face that runs the edge in this
    direction. It holds the edges between two of the vertices `rims`.

    faces: (m, 3).
    rims: (k,) indices of vertices.
    count: the number of vertices of the mesh.
    """
    is_rim = np.zeros(count, np.bool_)
    is_rim[rims] = True
    directed = half_edges(faces)
    is_kept = is_rim[directed].all(axis=1)
    # In the order of `half_edges`: all corners 2, then all corners 0, then all corners 1.
    third = np.roll(faces, 1, axis=1).T.ravel()[is_kept].tolist()
    ends = directed[is_kept].tolist()
    return {(a, b): c for (a, b), c in zip(ends, third, strict=True)}


def _forbidden_diagonals(polygon: IntArray, used_edges: set[tuple[int, int]]) -> BoolArray:
    """(n, n) for each pair of positions in a polygon, whether an existing edge joins the two
    vertices, so that no diagonal may join them. False for the polygon's own edges.

    polygon: (n,) indices of vertices.
    used_edges: all existing edges, the lower index first.
    """
    n = len(polygon)
    barred = np.zeros((n, n), np.bool_)
    position = {v: k for k, v in enumerate(polygon.tolist())}
    # Go through the edges or through the pairs of the polygon's vertices, whichever are fewer.
    for a, b in used_edges if n * n > len(used_edges) else _used_pairs(polygon, used_edges):
        if a in position and b in position:
            barred[position[a], position[b]] = barred[position[b], position[a]] = True
    k = np.arange(n)
    barred[k, (k + 1) % n] = barred[(k + 1) % n, k] = False
    return barred


def _used_pairs(polygon: IntArray, used_edges: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those pairs of a polygon's vertices, the lower index first, that are joined by an existing
    edge, one of `used_edges`."""
    ordered = sorted(polygon.tolist())
    return [(a, b) for i, a in enumerate(ordered) for b in ordered[i + 1 :] if (a, b) in used_edges]


def _min_area_triangulation(
    x: FloatArray,
    polygon: IntArray,
    third: dict[tuple[int, int], int],
    used_edges: set[tuple[int, int]],
) -> IntArray | None:
    """Triangulate a polygon with the smallest area. Returns the triangles (n - 2, 3) by indices of
    vertices; None if existing edges exclude every triangulation. The method is dynamic programming:
    cost[i, k] is the smallest area of a triangulation of the part from position i to position k. It
    is found from the shorter parts, by trying all positions m between i and k for the third corner
    of the triangle that has the diagonal from i to k as a side.

    x: (v, 3) all vertices.
    polygon: (n,) indices of vertices.
    third: unused; the parameters are those of `_min_dihedral_triangulation`.
    used_edges: existing edges, the lower index first; they are no diagonals.
    """
    n, corner = len(polygon), x[polygon]
    if n == 3:
        return polygon[None]  # a single triangle, (1, 3)
    # An infinite cost excludes a diagonal; `+=` below keeps it.
    cost = np.where(_forbidden_diagonals(polygon, used_edges), np.inf, 0.0)
    apex = np.zeros((n, n), np.int64)
    for d in range(2, n):
        # All diagonals over d positions at once: from i to i + d, with m between them.
        i = np.arange(n - d)[:, None]
        m = i + np.arange(1, d)
        area = 0.5 * row_norms(
            np.cross(corner[m] - corner[i], corner[i + d] - corner[i]).reshape(-1, 3)
        ).reshape(m.shape)
        total = cost[i, m] + cost[m, i + d] + area
        best = total.argmin(axis=1)
        rows = np.arange(n - d)
        cost[rows, rows + d] += total[rows, best]
        apex[rows, rows + d] = m[rows, best]
    if not np.isfinite(cost[0, n - 1]):
        return None
    return polygon[_triangles_from_apexes(apex, n)]


def _triangles_from_apexes(apex: IntArray, n: int) -> IntArray:
    """The triangles (n - 2, 3) of a triangulated polygon with n corners, by positions in the
    polygon.

    apex: (n, n) at [i, k] the position, between i and k, of the third corner of the triangle at the
        diagonal from i to k.
    """
    triangles, todo = list[tuple[int, int, int]](), [(0, n - 1)]
    while todo:
        i, k = todo.pop()
        if k - i > 1:
            m = int(apex[i, k])
            triangles.append((i, m, k))
            todo += [(i, m), (m, k)]
    return np.array(triangles, np.int64)


def _min_dihedral_triangulation(
    x: FloatArray,
    polygon: IntArray,
    third: dict[tuple[int, int], int],
    used_edges: set[tuple[int, int]],
) -> IntArray | None:
    """Triangulate a polygon so that the largest angle between the normals of neighboring triangles,
    also with the faces around the polygon, is as small as possible. Of triangulations with equal
    angles, the one with the smallest area is chosen (Liepa 2003). Returns the triangles (n - 2, 3)
    by indices of vertices; None if existing edges exclude every triangulation.

    The method is dynamic programming over the part of the polygon from position i to position k.
    turn[i, k] is minus the cosine of the largest angle in it, -1 for no angle; area[i, k] is twice
    its area; beside[i, k] is the normal of its triangle at the diagonal or, for an edge of the
    polygon, the normal of the face outside.

    x: (v, 3) all vertices.
    polygon: (n,) indices of vertices.
    third: from directed edges around the polygon to the third corners of their faces
        (`_opposite_corners`).
    used_edges: existing edges, the lower index first; they are no diagonals.
    """
    n, corner = len(polygon), x[polygon]
    if n == 3:
        return polygon[None]  # a single triangle, (1, 3)
    barred = _forbidden_diagonals(polygon, used_edges)
    beside = np.zeros((n, n, 3))  # 0: no neighbor, or not yet
    for position in range(n):
        # The face outside runs the polygon's edge from b to a.
        a, b = int(polygon[position]), int(polygon[(position + 1) % n])
        if (b, a) in third:
            face = np.array([[b, a, third[b, a]]])
            beside[position, (position + 1) % n] = _normalized(area_normals(x[face]))[0]
    turn, area = np.full((n, n), -1.0), np.zeros((n, n))
    apex = np.zeros((n, n), np.int64)
    for d in range(2, n):
        # All diagonals over d positions at once: from i to k, with the third corner m between them.
        i = np.arange(n - d)[:, None]
        m, k = i + np.arange(1, d), i + d
        cross = np.cross(corner[m] - corner[i], corner[k] - corner[i])
        normals = _normalized(cross)
        sides = [beside[i, m], beside[m, k]]
        # The last diagonal is an edge of the polygon, with a face outside.
        if d == n - 1:
            sides.append(np.broadcast_to(beside[k, i], normals.shape))
        turns_at_sides = [-np.einsum("imk,imk->im", normals, side) for side in sides]
        # No neighbor, no angle.
        turns_at_sides = [
            np.where(side.any(axis=2), t, -1.0)
            for side, t in zip(sides, turns_at_sides, strict=True)
        ]
        # For each m, the largest turn of the part that is divided at m, and twice its area.
        worst = np.maximum.reduce([*turns_at_sides, turn[i, m], turn[m, k]])
        size = area[i, m] + area[m, k] + np.sqrt((cross**2).sum(axis=2))
        smallest = worst.min(axis=1, keepdims=True)
        best = np.where(worst <= smallest + _EQUAL_COSINES, size, np.inf).argmin(axis=1)
        rows = np.arange(n - d)
        # The last diagonal is an edge of the polygon and never barred.
        bar = barred[rows, rows + d] if d < n - 1 else np.zeros(1, np.bool_)
        turn[rows, rows + d] = np.where(bar, np.inf, worst[rows, best])
        area[rows, rows + d] = size[rows, best]
        apex[rows, rows + d] = m[rows, best]
        beside[rows, rows + d] = normals[rows, best]
    if not np.isfinite(turn[0, n - 1]):
        return None
    return polygon[_triangles_from_apexes(apex, n)]


def _normalized(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) scaled to length 1; zero vectors stay zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


# Finer triangles.


def _refine_patches(
    vertices: FloatArray, faces: IntArray, new: IntArray, fixed_edges: IntArray
) -> tuple[FloatArray, IntArray]:
    """Split and flip edges of patches until the triangles are about as large as the faces around
    the patch. New vertices are moved to the means of their neighbors.

    vertices, faces: (n, 3), (m, 3) the mesh.
    new: (p, 3) the faces of patches.
    fixed_edges: (t, 2) the existing edges of the mesh, which no flip may make again.

    Returns all vertices (k, 4), new ones last: their coordinates and, in column 3, the usual length
    of edges near the vertex. Also the faces (q, 3) of patches.
    """
    input_count = len(vertices)
    x = np.column_stack([vertices, _mean_edge_lengths(vertices, faces, np.unique(new))])
    for _ in range(_SPLIT_ROUNDS):
        new, count = _flip_edges(x[:, :3], new, fixed_edges), len(x)
        x, new = _split_long_edges(x, new)
        if len(x) == count:
            break
        x = _relax_new_vertices(x, new, input_count)
    return x, _flip_edges(x[:, :3], new, fixed_edges)


def _split_long_edges(x: FloatArray, new: IntArray) -> tuple[FloatArray, IntArray]:
    """Split inner edges of patches at their midpoints if they are longer than `_LONG_RATIO` times
    the mean of the usual lengths at their ends. Returns all vertices (j, 4) and the faces of
    patches. Nothing is split if the patches have very many faces.

    x: (n, 4) vertices, with the usual length of edges in the last column; new vertices get the mean
        of the values at both ends.
    new: (p, 3) the faces of patches.
    """
    edges = Edges.of(half_edges(new))
    ends = x[edges.vertices]
    is_long = row_norms(ends[:, 0, :3] - ends[:, 1, :3]) > _LONG_RATIO * ends[:, :, 3].mean(axis=1)
    # Edges with two faces of patches: the others belong to the loop.
    rows = np.flatnonzero(is_long & (edges.multiplicity == 2))
    if not len(rows) or len(new) > _MAX_FACES_TO_SPLIT:
        return x, new
    midpoint = np.full(len(edges.vertices), -1, np.int64)
    midpoint[rows] = len(x) + np.arange(len(rows))
    x = np.concatenate([x, ends[rows].mean(axis=1)])
    # For each face (p, 3) the midpoints of its edges; -1 for edges that are not split.
    return x, split_faces(x[:, :3], new, midpoint[edges.edge_of_pair].reshape(3, -1).T)


def _mean_edge_lengths(x: FloatArray, faces: IntArray, rims: IntArray) -> FloatArray:
    """(n,) the mean length of the edges at each of the vertices with indices `rims`; 0 at other
    vertices.

    x, faces: (n, 3), (m, 3) the mesh.
    """
    is_rim = np.zeros(len(x), np.bool_)
    is_rim[rims] = True
    edges = Edges.of(half_edges(faces[is_rim[faces].any(axis=1)])).vertices
    lengths = row_norms(x[edges[:, 0]] - x[edges[:, 1]])
    total, count = (
        np.bincount(edges.ravel(), np.repeat(weights, 2), minlength=len(x))
        for weights in (lengths, np.ones(len(lengths)))
    )
    return np.where(is_rim, total / np.maximum(count, 1), 0.0)


def _relax_new_vertices(x: FloatArray, new: IntArray, input_count: int) -> FloatArray:
    """Move new vertices of patches to the means of their neighbors along edges of patches, in the
    sense of least squares. The usual lengths of edges, in the last column, are averaged in the same
    way. Returns the new array (n, 4).

    x: (n, 4) all vertices; those from index `input_count` on are new.
    new: (p, 3) the faces of patches.
    """
    ends = Edges.of(half_edges(new)).vertices
    laplacian = _graph_laplacian(ends, np.ones(len(ends)), len(x))
    return _solve_least_squares(laplacian[input_count:], x, input_count)


def _solve_least_squares(matrix: Any, x: FloatArray, input_count: int) -> FloatArray:
    """Replace the rows of x (n, d) from index `input_count` on so that the sum of the squares of
    all entries of matrix @ x is smallest. Returns the new array (n, d).

    matrix: (k, n) sparse.
    """
    import scipy.sparse.linalg as linalg  # imported here: it takes half a second

    solver = cast("Any", linalg)
    free, fixed = matrix[:, input_count:], matrix[:, :input_count]
    solution = x.copy()
    # With x = (fixed part, y): free^T free y = -free^T (fixed @ fixed part).
    right = free.T @ (fixed @ x[:input_count])
    solution[input_count:] = -solver.splu((free.T @ free).tocsc()).solve(np.asarray(right))
    return solution


def _graph_laplacian(ends: IntArray, weight: FloatArray, count: int) -> Any:
    """The Laplacian of a graph, as a sparse matrix (count, count): -weight for each edge, and at
    each vertex the sum of the weights of its edges.

    ends: (k, 2) the vertices of each edge.
    weight: (k,) the weights of the edges.
    count: the number of vertices.
    """
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


def _fair_patches(x: FloatArray, faces: IntArray, new: IntArray, input_count: int) -> FloatArray:
    """Move the new vertices so that the patches and the faces around them bend least. Returns all
    vertices (n, 3). What is minimized is the sum, over the vertices of patches, of |Laplacian of
    the position|^2 times the area around the vertex. Vertices at edges that remain open do not
    count in the sum.

    x: (n, 3) all vertices; those from index `input_count` on are new.
    faces: (m, 3) of the mesh.
    new: (p, 3) of patches.
    """
    is_in_sum = np.zeros(len(x), np.bool_)
    is_in_sum[new] = True
    triangles = np.concatenate([faces[is_in_sum[faces].any(axis=1)], new])
    edges = Edges.of(half_edges(triangles))
    corner = x[triangles]
    weight = np.zeros(len(edges.vertices))
    area = np.zeros(len(x))
    twice_area = np.maximum(row_norms(area_normals(x[triangles])), 1e-300)
    for k in range(3):  # the edge from corner k to k + 1 is opposite to corner k + 2
        u, w = (corner[:, j] - corner[:, k - 1] for j in (k, (k + 1) % 3))
        cotangent = np.clip(row_dots(u, w) / twice_area, -_MAX_COTANGENT, _MAX_COTANGENT)
        # `half_edges` lists the first edges of all triangles, then the second, then the third.
        count = len(triangles)
        np.add.at(weight, edges.edge_of_pair[k * count : (k + 1) * count], 0.5 * cotangent)
        # A vertex gets a third of the area of each of its triangles.
        np.add.at(area, triangles[:, k], twice_area / 6)
    weight = np.maximum(weight, _MIN_WEIGHT)
    # Beside holes that remain open the Laplacian is incomplete, so their vertices do not count.
    is_in_sum[edges.vertices[edges.multiplicity != 2]] = False
    rows = np.flatnonzero(is_in_sum & (area > 0))
    laplacian = _graph_laplacian(edges.vertices, weight, len(x))[rows]
    # A row of the graph's Laplacian is the Laplacian at a vertex times the area around it, so its
    # square is divided by the area.
    row_scale = 1 / np.sqrt(np.maximum(area[rows], 1e-300))
    return _solve_least_squares(laplacian.multiply(row_scale[:, None]).tocsr(), x, input_count)


def _flip_edges(x: FloatArray, new: IntArray, fixed_edges: IntArray) -> IntArray:
    """Flip edges of patches so that the angles opposite to edges become small (Delaunay's
    criterion). Returns the new faces (p, 3). An edge is flipped only if the new edge does not exist
    yet and no triangle turns over.

    The edge from a to b is common to the faces f, with the third corner c, and g, with the third
    corner d. A flip replaces it by the edge from c to d. An edge is flipped if the sum of the
    cotangents of the angles at c and d is negative enough, which means that the angles add up to
    more than 180 degrees. The smallest sums come first; each face takes part in one flip per round.

    x: (n, 3) all vertices.
    new: (p, 3) the faces of patches.
    fixed_edges: (t, 2) the existing edges of the mesh.
    """
    new = new.copy()
    fixed_keys = edge_keys(fixed_edges, len(x))
    for _ in range(_FLIP_ROUNDS):
        edges = Edges.of(half_edges(new))
        paired = edges.paired_half_edges()
        # The row of a half-edge is its position in the face times the number of faces, plus the
        # face.
        f, g = paired.T % len(new)
        k, j = paired.T // len(new)
        a, b, c, d = new[f, k], new[f, (k + 1) % 3], new[f, (k + 2) % 3], new[g, (j + 2) % 3]
        key = edge_keys(np.column_stack([c, d]), len(x))
        cotangents = _cotangents(x[a], x[b], x[c]) + _cotangents(x[a], x[b], x[d])
        is_flippable = (cotangents < _MAX_FLIP_COTANGENT_SUM) & (c != d)
        is_flippable &= ~np.isin(key, fixed_keys) & ~np.isin(key, edge_keys(edges.vertices, len(x)))
        # The new triangles must look to the same side as the old ones.
        before = area_normals(x[new])
        mean = before[f] + before[g]
        for triangle in ((a, d, c), (d, b, c)):
            is_flippable &= row_dots(area_normals(x[np.column_stack(triangle)]), mean) > 0
        rows = np.flatnonzero(is_flippable)
        rows = rows[np.argsort(cotangents[rows])]
        # Of edges that would become the same edge, the one with the smallest sum.
        rows = rows[np.sort(np.unique(key[rows], return_index=True)[1])]
        # best[face]: the first flip in which the face takes part. A flip is done if it is the first
        # for both of its faces.
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
    """The cotangents (k,) of the angles at points `apex` between the directions to `a` and to `b`,
    all (k, 3)."""
    u, w = a - apex, b - apex
    return row_dots(u, w) / np.maximum(row_norms(np.cross(u, w)), 1e-300)


def _loop_of_faces(new: IntArray, loops: list[IntArray], count: int) -> IntArray:
    """(p,) for each face of a patch, the index of the loop that the patch fills. It is found from
    the connected groups of faces: the faces of a patch are connected by edges, and one of them has
    the first edge of the loop.

    new: (p, 3) the faces of all patches.
    loops: the indices of the vertices of each loop.
    count: the number of vertices.
    """
    edges = Edges.of(half_edges(new))
    # Half edge h is one of face h % len(new).
    part = connected_groups(edges.paired_half_edges() % len(new), len(new))
    loop_at = np.full(int(part.max()) + 1, -1, np.int64)
    keys = edge_keys(edges.vertices, count)
    # For each edge, one of its faces.
    face_at = np.empty(len(keys), np.int64)
    face_at[edges.edge_of_pair] = np.arange(3 * len(new)) % len(new)
    # The first edges of the loops, looked up among the edges of patches. Loops without a patch have
    # none.
    first_edge_keys = edge_keys(np.array([loop[:2] for loop in loops]), count)
    positions = np.minimum(np.searchsorted(keys, first_edge_keys), len(keys) - 1)
    matched = np.flatnonzero(keys[positions] == first_edge_keys)
    loop_at[part[face_at[positions[matched]]]] = matched
    return loop_at[part]
