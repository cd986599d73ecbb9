"""Meshes of a level set {f = 0} of a solid angle. Such a level set ends at a closed curve, the
field's boundary curve, whose straight edges join its vertices. The space around is divided into
tetrahedra (a Delaunay tetrahedralization of points in the cells of an octree), so that the curve's
edges are edges of tetrahedra, and the level set is meshed in these.

If a check fails in known places, the cells of the octree are made smaller in these places only and
the mesh is computed again. If that does not help, or the places are not known, cells are made
smaller everywhere. The places are given as sets of balls: a cell is halved once for each set with a
ball that meets it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.geometry.mesh_edges import boundary_edges, edge_keys
from harnack.geometry.polygons import cancel_opposite_edges
from harnack.meshing.checks import check_manifold, misoriented_faces
from harnack.meshing.delaunay_points import (
    BoundaryCurve,
    RefinementBalls,
    TetrahedronPoints,
    box_cells,
    newton_to_level,
    sample_delaunay_points,
)
from harnack.meshing.isotopy import IsotopyCoverage, isotopy_of
from harnack.meshing.lattice_meshing import check_estimated_triangles
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.marching_tetrahedra import (
    EdgeCrossings,
    Tetrahedra,
    count_crossings,
    delaunay,
    extract_triangles,
    is_cut,
)
from harnack.meshing.meshing_errors import CELL_SIZE_RATIO, LocalizedMeshingError, MeshingError
from harnack.meshing.refinement import improve, refine, smooth
from harnack.meshing.self_intersection import intersecting_faces
from harnack.tree.empty_space import BoxCells

__all__ = ["SpanningMesh", "mesh_spanning_curve", "restore_curve_edges"]

# Points on edges of the curve are moved by at most this fraction of the shortest edge at them.
_MAX_MOVE = 0.1


def restore_curve_edges(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    curve_count: int,
    cut: int,
    height: float,
) -> tuple[FloatArray, IntArray]:
    """Make a mesh end at the vertices of the given curve only. Long edges of the curve were
    subdivided, so that cells near them may be smaller than they are; the mesh has these extra
    points on its boundary. They are moved off their edge into the surface, by at most `height`, and
    the gap beside the edge is filled with triangles. Returns the vertices (n, 3) and the faces (k,
    3).

    These triangles are unavoidably thin: the surface twists about the edge, so a triangle that has
    all of the edge as a side is within the tolerance only if its height is about the tolerance.

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    curve_count, cut: vertices 0 to curve_count - 1 are those of the curve; vertices curve_count to
        cut - 1 are the extra points on its edges.
    height: the largest distance by which extra points are moved.
    """
    if cut == curve_count:
        return vertices, faces
    successor = dict(boundary_edges(faces).tolist())
    # A chain runs along the boundary of the mesh from one vertex of the curve to the next.
    chains: list[list[int]] = []
    for start in range(curve_count):
        chain = [start]
        while (vertex := successor.get(chain[-1])) is not None:
            chain.append(vertex)
            if vertex < curve_count:
                break
        if len(chain) > 2:
            chains.append(chain)
    inner = np.array([vertex for chain in chains for vertex in chain[1:-1]], np.int64)
    if not len(inner):
        return vertices, faces
    chain_of_point = np.repeat(np.arange(len(chains)), [len(path) - 2 for path in chains])
    ends = np.array([(path[0], path[-1]) for path in chains], np.int64)
    vertices = vertices.copy()
    vertices[inner] = _push_inward(function, vertices, faces, inner, chain_of_point, ends, height)
    gaps = [face for chain in chains for face in _triangulate_gap(chain)]
    return vertices, np.concatenate([faces, np.array(gaps, np.int64)])


def _push_inward(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    inner: IntArray,
    edge: IntArray,
    ends: IntArray,
    height: float,
) -> FloatArray:
    """Move the extra points on edges of the curve off their edges and onto the surface; returns all
    vertices (n, 3).

    The distances of an edge's points from the edge form a parabola over it, so that the triangles
    that fill the gap lie between the edge and the chain of points. A point is first moved into the
    surface, along the mean direction to its neighbors at right angles to the edge. It is then
    turned about the edge towards the level set: it keeps its position along the edge and its
    distance from it. If that would turn it by more than about 70 degrees, it stays.

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    inner: (k,) indices of the extra points.
    edge: (k,) for each extra point, the index of its edge.
    ends: (e, 2) the two vertices at the ends of each edge.
    height: the largest distance from the edge, a length.
    """
    points = vertices[inner]
    a, edge_direction = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]
    length = np.linalg.norm(edge_direction, axis=1)
    edge_direction, a = (edge_direction / length[:, None])[edge], a[edge]
    # The position of each point along its edge, from 0 to 1.
    fraction = ((points - a) * edge_direction).sum(axis=1) / length[edge]
    # For each vertex the sum of the vectors to its neighbors, and the length of its shortest edge.
    inwards, shortest = np.zeros_like(vertices), np.full(len(vertices), np.inf)
    for k in range(3):
        corner, second, third = (faces[:, (k + j) % 3] for j in range(3))
        np.add.at(inwards, corner, vertices[second] + vertices[third] - 2 * vertices[corner])
        for end in (second, third):
            span = np.linalg.norm(vertices[end] - vertices[corner], axis=1)
            np.minimum.at(shortest, corner, span)
    # The same parabola for all points of an edge: at most `height`, and a tenth of the shortest
    # edge of the mesh at one of them.
    max_distance = np.full(len(ends), height)
    np.minimum.at(max_distance, edge, _MAX_MOVE * shortest[inner])
    distance = 4 * fraction * (1 - fraction) * max_distance[edge]
    direction = _unit_perpendicular(inwards[inner], edge_direction)
    start = points + distance[:, None] * direction
    # With steps of at most 0.3 of the distance, and without walls.
    projected = newton_to_level(function, start, function.sample(start), 0.3 * distance, None)
    # Points keep their position along the edge and their distance from it: they turn about it.
    toward = _unit_perpendicular(projected - points, edge_direction)
    # The cosine of the angle by which the point would turn.
    is_close = (toward * direction).sum(axis=1) > 0.3
    return points + distance[:, None] * np.where(is_close[:, None], toward, direction)


def _unit_perpendicular(vectors: FloatArray, along: FloatArray) -> FloatArray:
    """(k, 3) unit vectors in the directions of `vectors` (k, 3) after their components along the
    unit vectors `along` (k, 3) are taken away; 0 if nothing is left."""
    part = vectors - (vectors * along).sum(axis=1)[:, None] * along
    return part / np.maximum(np.linalg.norm(part, axis=1), 1e-300)[:, None]


def _triangulate_gap(chain: list[int]) -> list[tuple[int, int, int]]:
    """Triangles, as triples of indices, that fill the gap between a chain of points and the
    straight edge between the ends of the chain. The triangle at the edge has the middle point of
    the chain as its third corner, and so on for both halves of the chain.

    chain: the indices of the points, in order.
    """
    if len(chain) < 3:
        return []
    middle = len(chain) // 2
    return [
        (chain[0], chain[-1], chain[middle]),
        *_triangulate_gap(chain[: middle + 1]),
        *_triangulate_gap(chain[middle:]),
    ]


# The whole surface.

# How often the mesh is computed, each time with smaller cells where finished triangles failed.
_MAX_ATTEMPTS = 4
# How often cells are made smaller in places where the first triangles fail, before they are made
# smaller everywhere.
_MOST_LOCAL = 4
# Edges of the curve are divided into pieces no longer than this, in sizes of cells.
_MAX_EDGE_CELLS = 2.5
# How often edges of the curve that are missing among those of the tetrahedra are halved.
_MAX_HALVINGS = 4


@dataclass(frozen=True)
class SpanningMesh:
    """A mesh of a level set that ends at a boundary curve, and facts about how it was computed.

    vertices: (n, 3).
    faces: (m, 3).
    curve: the boundary curve, with its edges as subdivided.
    spacing: the size of cells.
    finer: sets of balls; a cell was halved once for each set with a ball that meets it.
    crossings: how often, and in which direction, the level set crosses each edge of the tetrahedra.
    isotopy: on how many tetrahedra the topology is proved.
    turned: how many faces look to the side on which the function is smaller.
    """

    vertices: FloatArray
    faces: IntArray
    curve: BoundaryCurve
    spacing: float
    finer: tuple[RefinementBalls, ...]
    crossings: EdgeCrossings
    isotopy: IsotopyCoverage
    turned: int = 0


@dataclass(frozen=True)
class _SpanningInput:
    """What all attempts to mesh a level set have in common: the function f, and the box in which
    its level set {f = 0} is meshed.

    lower, upper: (3,) the corners of the box.
    walls: the same corners, if the surface may end at the faces of the box; else None.
    seed: the seed of the random moves of points.
    report: receives messages about the progress.
    """

    function: LevelFunction
    lower: FloatArray
    upper: FloatArray
    walls: tuple[FloatArray, FloatArray] | None
    seed: int
    report: Callable[[str], None]


def mesh_spanning_curve(
    function: LevelFunction,
    spacing: float,
    attempts: int,
    box: tuple[FloatArray, FloatArray],
    has_walls: bool,
    seed: int,
    tolerance: float,
    report: Callable[[str], None],
) -> SpanningMesh:
    """Mesh a level set of a solid angle within the tolerance, so that no triangles pass through
    each other. If triangles pass through each other or are turned over, cells are made smaller
    there and the mesh is computed again. Triangles that are still turned over in the last attempt
    are counted in the result.

    function: f, the solid angle minus its level.
    spacing: the first size of cells, a length.
    attempts: the number of sizes of cells that are tried, each smaller than the one before.
    box: the lower and upper corners (3,) of the box that cells fill.
    has_walls: whether the surface may end at the faces of the box.
    seed: the seed of the random moves of points.
    tolerance: a length.
    report: receives messages about the progress.

    Raises:
        MeshingError: no mesh passes the checks.
    """
    task = _SpanningInput(function, *box, box if has_walls else None, seed, report)
    walls = task.walls
    # Sets of balls in which cells are made smaller.
    finer: tuple[RefinementBalls, ...] = ()
    # The mesh with the fewest faces turned over, of those whose triangles do not cross.
    best: SpanningMesh | None = None
    crossing = np.zeros(0, np.int64)
    for attempt in range(_MAX_ATTEMPTS):
        unrefined = _mesh_with_retries(task, spacing, attempts, finer)
        spacing, finer = unrefined.spacing, unrefined.finer
        faces = unrefined.faces
        check_estimated_triangles(function, unrefined.vertices, faces, tolerance)
        vertices = smooth(function, unrefined.vertices, faces, walls)
        vertices, faces = refine(function, vertices, faces, tolerance, walls, report)
        vertices, faces = improve(function, vertices, faces, tolerance, walls, report)
        turned = misoriented_faces(function, vertices, faces)
        curve_count = sum(map(len, _curve_loops(function)))
        vertices, faces = restore_curve_edges(
            function, vertices, faces, curve_count, len(unrefined.curve.points), tolerance
        )
        check_manifold(faces)
        crossing = intersecting_faces(vertices, faces)
        if not len(crossing) and (best is None or len(turned) < best.turned):
            best = dataclasses.replace(
                unrefined, vertices=vertices, faces=faces, turned=len(turned)
            )
        failing = np.union1d(crossing, turned)
        if not len(failing):
            break
        if attempt < _MAX_ATTEMPTS - 1:
            report(f"{len(failing)} triangles fail: smaller cells there")
            finer = (*finer, RefinementBalls(vertices[faces[failing]].mean(axis=1), spacing))
    if best is None:
        raise MeshingError(
            f"{len(crossing)} triangles pass through others, in cells as small as "
            f"{spacing / 2 ** len(finer):.3g}: choose a smaller `tolerance` or `cell_size`"
        )
    return best


def _curve_loops(function: LevelFunction) -> tuple[FloatArray, ...]:
    """Returns the closed loops of the boundary curve of a solid angle, each an array (k, 3) of
    vertices. function: the solid angle minus its level. Edges that are run in both directions are
    left out."""
    assert isinstance(function.field, SolidAngle)
    return cancel_opposite_edges(function.field.loops)


def _mesh_with_retries(
    task: _SpanningInput, spacing: float, attempts: int, finer: tuple[RefinementBalls, ...]
) -> SpanningMesh:
    """Mesh the level set in cells of the size `spacing`, which are made smaller in places where a
    check fails. If that does not help, or the places are not known, mesh it in smaller cells
    everywhere. The mesh is not refined yet.

    task: the function, and the box in which it is meshed.
    attempts: how many sizes of cells may be tried.
    finer: sets of balls; a cell is halved once for each set with a ball that meets it.

    Raises:
        MeshingError: no attempt succeeds.
    """
    task.report(f"cells of {spacing:.3g}")
    balls = finer
    try:
        for trial in range(_MOST_LOCAL):
            try:
                return _mesh_in_cells(task, spacing, balls)
            except LocalizedMeshingError as error:
                task.report(f"{len(error.locations)} places fail: smaller cells there")
                # The balls' radius is the size of the cells that failed; each trial halves it.
                balls = (*balls, RefinementBalls(error.locations, spacing * 0.5**trial))
        return _mesh_in_cells(task, spacing, balls)
    # No places are known, or the last local attempt failed.
    except MeshingError:
        if attempts == 1:
            raise
    return _mesh_with_retries(task, CELL_SIZE_RATIO * spacing, attempts - 1, finer)


def _mesh_in_cells(
    task: _SpanningInput, spacing: float, finer: tuple[RefinementBalls, ...]
) -> SpanningMesh:
    """Mesh the level set in cells of the size `spacing`, without refinement; and find out on how
    many tetrahedra the topology is proved.

    task: the function, and the box in which it is meshed.
    finer: sets of balls; a cell is halved once for each set with a ball that meets it.

    Raises:
        MeshingError: a check fails, or edges of the curve are edges of no tetrahedron.
    """
    function, walls = task.function, task.walls
    curve = BoundaryCurve.of(_curve_loops(function), _MAX_EDGE_CELLS * spacing)
    # Points keep a distance from the curve that grows with its edges, so edges are halved where
    # smaller cells are wanted.
    for k, balls in enumerate(finer):
        curve = curve.split_near(balls, spacing * 0.5**k)
    # A surface that does not end at the box must lie inside of the cells.
    margin = 0.5 * spacing if walls is None else 0.0
    root = box_cells(task.lower - margin, task.upper + margin, spacing, exact=walls is not None)
    curve, points, tets = _tetrahedralize(task, root, curve, finer)
    task.report(f"{len(points.points):,} points, {len(tets.corners):,} tetrahedra")
    crossings = count_crossings(function, points, tets)
    vertices, faces = extract_triangles(function, points, tets, crossings)
    if not len(faces):
        raise MeshingError("the level set is empty: no cell of the box holds the level")
    check_manifold(faces, vertices)
    _check_boundary(vertices, faces, curve, walls)
    cut = is_cut(points, tets, crossings)
    isotopy = isotopy_of(function, points, tets.corners, cut, faces, curve, spacing, walls)
    return SpanningMesh(vertices, faces, curve, spacing, finer, crossings, isotopy)


def _tetrahedralize(
    task: _SpanningInput,
    root: tuple[BoxCells, int],
    curve: BoundaryCurve,
    finer: tuple[RefinementBalls, ...],
) -> tuple[BoundaryCurve, TetrahedronPoints, Tetrahedra]:
    """Compute a Delaunay tetrahedralization that contains every edge of the boundary curve. Edges
    of the curve that are missing in it, because other points are too near to them, are halved, and
    it is computed again.

    task: the function, and the box that tetrahedra fill.
    curve: the boundary curve.
    root: cells that fill the box, and how many times they are to be halved.
    finer: sets of balls; a cell is halved once more for each set with a ball that meets it.

    Returns the curve with its edges as subdivided, the points with samples of the function, and the
    tetrahedra.

    Raises:
        MeshingError: edges of the curve are missing after all halvings.
    """
    for _ in range(_MAX_HALVINGS):
        points = sample_delaunay_points(task.function, root, curve, task.walls, task.seed, finer)
        tets = delaunay(points.points)
        has_edge = tets.has_edges(curve.edges)
        if has_edge.all():
            return curve, points, tets
        curve = curve.split(~has_edge)
    raise MeshingError("edges of the curve are too near to others: choose a smaller `cell_size`")


def _check_boundary(
    vertices: FloatArray,
    faces: IntArray,
    curve: BoundaryCurve,
    walls: tuple[FloatArray, FloatArray] | None,
) -> None:
    """Raise LocalizedMeshingError unless the boundary edges of the faces are the edges of the
    curve.

    vertices, faces: (n, 3), (m, 3) the mesh.
    walls: the lower and upper corners (3,) of the box if the surface may end on the faces of the
        box as well; else None.
    """
    edges = boundary_edges(faces)
    count = max(int(faces.max()) + 1, len(curve.points))
    if walls is not None:  # the surface ends there as well
        margin = 1e-9 * (walls[1] - walls[0])
        distances = np.minimum(np.abs(vertices - walls[0]), np.abs(vertices - walls[1]))
        is_on_wall = np.asarray((distances <= margin).any(axis=1))
        edges = edges[~is_on_wall[edges].all(axis=1)]
    # Edges that are in one of the two sets only, by their keys: a * count + b for vertices a < b.
    unmatched = np.setxor1d(edge_keys(edges, count), edge_keys(curve.edges, count))
    if len(unmatched):
        ends = np.stack(np.divmod(unmatched, count), axis=1)
        raise LocalizedMeshingError(
            "the mesh does not end at the curve: cells are too large for it; choose a smaller "
            "`cell_size`",
            vertices[ends].mean(axis=1),
        )
