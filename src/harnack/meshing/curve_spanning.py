"""Triangles of an angle's level set that end at its curve, in Delaunay's tetrahedra.

Where a check fails in known places, cells are made smaller there alone and the mesh is computed
again. Where that does not help, or the places are not known, cells are made smaller everywhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.geometry.polygons import cancel_opposite_edges
from harnack.meshing.checks import (
    LocalizedMeshingError,
    MeshingError,
    check_manifold,
    intersecting_faces,
    misoriented_faces,
)
from harnack.meshing.delaunay_points import (
    BoundaryCurve,
    RefinementBalls,
    TetrahedronPoints,
    box_cells,
    newton_to_level,
    sample_delaunay_points,
)
from harnack.meshing.edges import IntArray, boundary_edges, edge_keys
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
from harnack.meshing.refinement import improve, refine, smooth
from harnack.tree.empty_space import BoxCells

__all__ = ["SpanningMesh", "mesh_spanning_curve", "restore_curve_edges"]

# The largest move of a point, relative to the edges of triangles beside it.
_SHALLOW = 0.1


def restore_curve_edges(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    curve_count: int,
    cut: int,
    height: float,
) -> tuple[FloatArray, IntArray]:
    """Restore edges of the boundary curve that were subdivided for the tetrahedra, so that only the
    first `curve_count` vertices, the vertices of the curve, are on the boundary. Returns vertices
    and faces.

    Long edges of a curve are subdivided so that cells near them need not be as large. The extra
    points are moved off the edge into the surface, by at most the tolerance, and the gap is filled:
    the mesh then ends at the given curve. The filling triangles are thin, unavoidably: the surface
    twists about the edge, and a triangle along all of it is within the tolerance only if its height
    is about the tolerance.

    curve_count, cut: vertices before `curve_count` are the vertices of the curve; from there to
        `cut` they are the extra points on its edges.
    height: how far the extra points are moved, at most.
    """
    if cut == curve_count:
        return vertices, faces
    successor = dict(boundary_edges(faces).tolist())
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
    owner = np.repeat(np.arange(len(chains)), [len(path) - 2 for path in chains])
    ends = np.array([(path[0], path[-1]) for path in chains], np.int64)
    vertices = vertices.copy()
    vertices[inner] = _push_inward(function, vertices, faces, inner, owner, ends, height)
    gaps = [face for chain in chains for face in _filling(chain)]
    return vertices, np.concatenate([faces, np.array(gaps, np.int64)])


def _push_inward(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    inner: IntArray,
    owner: IntArray,
    ends: IntArray,
    height: float,
) -> FloatArray:
    """(n, 3) the vertices, with the points `inner` (k,) moved off their edges and onto the surface.
    owner: (k,) the edge of each point; ends: (m, 2) the ends of the edges. The heights over an edge
    are one parabola, so that its filling lies below the chain."""
    points = vertices[inner]
    a, along = vertices[ends[:, 0]], vertices[ends[:, 1]] - vertices[ends[:, 0]]
    length = np.linalg.norm(along, axis=1)
    along, a = (along / length[:, None])[owner], a[owner]
    fraction = ((points - a) * along).sum(axis=1) / length[owner]
    inward, shortest = np.zeros_like(vertices), np.full(len(vertices), np.inf)
    for k in range(3):
        corner, second, third = (faces[:, (k + j) % 3] for j in range(3))
        np.add.at(inward, corner, vertices[second] + vertices[third] - 2 * vertices[corner])
        for end in (second, third):
            span = np.linalg.norm(vertices[end] - vertices[corner], axis=1)
            np.minimum.at(shortest, corner, span)
    max_height = np.full(len(ends), height)
    np.minimum.at(max_height, owner, _SHALLOW * shortest[inner])
    lift = 4 * fraction * (1 - fraction) * max_height[owner]
    direction = _unit_perpendicular(inward[inner], along)
    start = points + lift[:, None] * direction
    projected = newton_to_level(function, start, function.sample(start), 0.3 * lift, None)
    # Points keep their position along the edge and their distance from it: they turn about it.
    turned = _unit_perpendicular(projected - points, along)
    is_close = (turned * direction).sum(axis=1) > 0.3
    return points + lift[:, None] * np.where(is_close[:, None], turned, direction)


def _unit_perpendicular(vectors: FloatArray, along: FloatArray) -> FloatArray:
    """The unit vectors (k, 3) of the components of vectors at right angles to unit vectors."""
    part = vectors - (vectors * along).sum(axis=1)[:, None] * along
    return part / np.maximum(np.linalg.norm(part, axis=1), 1e-300)[:, None]


def _filling(chain: list[int]) -> list[tuple[int, int, int]]:
    """Triangles between the edge from the first to the last point of a chain, and the chain."""
    if len(chain) < 3:
        return []
    middle = len(chain) // 2
    return [
        (chain[0], chain[-1], chain[middle]),
        *_filling(chain[: middle + 1]),
        *_filling(chain[middle:]),
    ]


# The whole surface.

# How often the mesh is computed again because finished triangles fail.
_MAX_ATTEMPTS = 4
# How often cells are made smaller where the first triangles fail, before they are made smaller
# everywhere.
_MOST_LOCAL = 4
# Edges of a curve that are longer than this many cells are cut.
_LONGEST = 2.5
# How often edges of a curve that are too near to others are halved.
_MAX_CUTS = 4
# The ratio of the size of smaller cells everywhere to the size before.
_SMALLER = 0.6


@dataclass(frozen=True)
class SpanningMesh:
    """A mesh that ends at a boundary curve, and facts about how it was computed.

    vertices: (n, 3).
    faces: (m, 3).
    curve: the boundary curve, with its edges as subdivided.
    spacing: of cells.
    finer: where cells were smaller.
    crossings: of the edges of tetrahedra.
    isotopy: on how many tetrahedra the topology is proved.
    turned: how many faces are turned over.
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
    """The function and the box in which its level set is meshed.

    lower, upper: (3,) the box.
    walls: the same box, if the surface may end at its faces, or None.
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
    """The mesh of an angle's level set within the tolerance, none of whose triangles pass through
    each other; where triangles do, or are turned over, cells are made smaller and the mesh is
    computed again.

    attempts: the number of spacings that are tried, each smaller than the spacing before.
    box: the box that cells fill. has_walls: whether the surface may end at its faces.
    tolerance: a length.

    Raises:
        MeshingError: no mesh passes the checks.
    """
    task = _SpanningInput(function, *box, box if has_walls else None, seed, report)
    walls = task.walls
    finer: tuple[RefinementBalls, ...] = ()
    best: SpanningMesh | None = None
    crossing = np.zeros(0, np.int64)
    for attempt in range(_MAX_ATTEMPTS):
        first = _first_surface(task, spacing, attempts, finer)
        spacing, finer = first.spacing, first.finer
        faces = first.faces
        check_estimated_triangles(function, first.vertices, faces, tolerance)
        vertices = smooth(function, first.vertices, faces, walls)
        vertices, faces = refine(function, vertices, faces, tolerance, walls, report)
        vertices, faces = improve(function, vertices, faces, tolerance, walls, report)
        turned = misoriented_faces(function, vertices, faces)
        curve_count = sum(map(len, _loops(function)))
        vertices, faces = restore_curve_edges(
            function, vertices, faces, curve_count, len(first.curve.points), tolerance
        )
        check_manifold(faces)
        crossing = intersecting_faces(vertices, faces)
        if not len(crossing) and (best is None or len(turned) < best.turned):
            best = dataclasses.replace(first, vertices=vertices, faces=faces, turned=len(turned))
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


def _loops(function: LevelFunction) -> tuple[FloatArray, ...]:
    assert isinstance(function.field, SolidAngle)
    return cancel_opposite_edges(function.field.loops)


def _first_surface(
    task: _SpanningInput, spacing: float, attempts: int, finer: tuple[RefinementBalls, ...]
) -> SpanningMesh:
    """The mesh in cells of that spacing, smaller where necessary; or where that fails, in smaller
    cells everywhere."""
    task.report(f"cells of {spacing:.3g}")
    local = finer
    try:
        for trial in range(_MOST_LOCAL):
            try:
                return _in_cells(task, spacing, local)
            except LocalizedMeshingError as error:
                task.report(f"{len(error.locations)} places fail: smaller cells there")
                local = (*local, RefinementBalls(error.locations, spacing * 0.5**trial))
        return _in_cells(task, spacing, local)
    except MeshingError:
        if attempts == 1:
            raise
    return _first_surface(task, _SMALLER * spacing, attempts - 1, finer)


def _in_cells(
    task: _SpanningInput, spacing: float, finer: tuple[RefinementBalls, ...]
) -> SpanningMesh:
    """The mesh in cells of that spacing, split in the balls `finer`, and its proved isotopy.

    Raises:
        MeshingError: checks that fail, or edges of the curve that are in no tetrahedron.
    """
    function, walls = task.function, task.walls
    curve = BoundaryCurve.of(_loops(function), _LONGEST * spacing)
    for k, balls in enumerate(finer):  # balls on long edges leave no room for points
        curve = curve.split_near(balls, spacing * 0.5**k)
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
    """Tetrahedra that have all edges of the curve, whose edges are cut where others are too
    near."""
    for _ in range(_MAX_CUTS):
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
    edges = boundary_edges(faces)
    count = max(int(faces.max()) + 1, len(curve.points))
    if walls is not None:  # the surface ends there as well
        margin = 1e-9 * (walls[1] - walls[0])
        near = np.minimum(np.abs(vertices - walls[0]), np.abs(vertices - walls[1]))
        on = np.asarray((near <= margin).any(axis=1))
        edges = edges[~on[edges].all(axis=1)]
    unmatched = np.setxor1d(edge_keys(edges, count), edge_keys(curve.edges, count))
    if len(unmatched):
        ends = np.stack(np.divmod(unmatched, count), axis=1)
        raise LocalizedMeshingError(
            "the mesh does not end at the curve: cells are too large for it; choose a smaller "
            "`cell_size`",
            vertices[ends].mean(axis=1),
        )
