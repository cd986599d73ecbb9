"""Closed meshes from the signs of a function on a lattice, for fields that jump, are rough, or have
few proved bounds.

A tetrahedron with corners of both signs is cut by one triangle or quadrilateral with vertices on
its edges. Neighbors share these edges, so every mesh edge has two faces, except on the box: the
mesh is a closed manifold without self-intersections, whatever the function.

Where the normals at the ends of a mesh edge differ, the edge is split at the level's crossing of a
segment toward the intersection of the tangent planes (Kobbelt et al. 2001), so that edges follow
creases. Vertices whose faces then flip or intersect are moved back. Finally an exact test checks
for self-intersections.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.bcc_lattice import BccLattice, distinct_rows
from harnack.meshing.checks import (
    EmptySurfaceError,
    LocalizedMeshingError,
    MeshingError,
    check_triangle_limit,
    intersecting_faces,
    points_off_level,
)
from harnack.meshing.closed_mesh import from_manifold, to_manifold, without_short_edges
from harnack.meshing.delaunay_points import TetrahedronPoints
from harnack.meshing.edges import (
    Edges,
    IntArray,
    area_normals,
    boundary_edges,
    half_edges,
    row_dots,
    row_norms,
)
from harnack.meshing.lattice_meshing import TriangleMesh
from harnack.meshing.level_function import LevelSamples
from harnack.meshing.lost_parts import LostParts, PointsOnLevel
from harnack.meshing.marching_tetrahedra import Tetrahedra, count_crossings, extract_triangles
from harnack.meshing.refinement import split_faces
from harnack.meshing.sign_function import SignFunction

if TYPE_CHECKING:
    from harnack.geometry import Volume

__all__ = [
    "CELL_REFINEMENT_FACTOR",
    "MAX_OFF_LEVEL_FRACTION",
    "SignIsosurface",
    "extract_from_signs",
    "mesh_from_signs",
]

# The smallest distance of vertices from the ends of edges, relative to the edge, so that all
# triangles have an area.
_EDGE_END_MARGIN = 1e-4
# The largest number of rounds in which edges are cut; and of rounds in which vertices of triangles
# that pass through others are moved back.
_ROUNDS, _MOST_REPAIRS = 2, 12
# A round that would cut more than this fraction of the edges that the last round cut, or of the
# faces, is omitted: the surface is rough at every scale.
_MAX_CUT_FRACTION = 0.5
# Neighbors lie on each other if the cosine between their normals is less than this.
_FOLDED = -0.99999
# Slivers and flat places are simplified by at most the first, relative to the tolerance, and by at
# most the second, relative to a cell.
_SIMPLIFY_TOLERANCE, _SIMPLIFY_CELL_FRACTION = 0.5, 0.05
# Edges shorter than this, in tolerances, are not cut.
_SHORTEST = 4.0
# An edge is cut no nearer to its ends than this, relative to its length.
_FROM_CORNERS = 0.1
# Across a crease normals turn by at least this angle; and by this fraction of the angle between the
# point on the crease and one of the ends of the edge.
_MIN_CREASE_ANGLE, _CREASE_ANGLE_SHARE = math.radians(2), 0.75
# The level set is searched for on the line from an edge to the point where tangent planes meet. The
# search begins before the edge and ends after that point, by the first and up to the second of the
# displacement between them. The displacement is clamped to the third, in lengths of the edge.
_BEFORE, _AFTER, _OFFSET = 0.3, 1.3, 1.0
# Two tangent planes meet in a line if the squared sine of the angle between them is larger than the
# first; three of them meet in a point if the determinant of their unit normals is larger than the
# second.
_MIN_SQUARE, _INDEPENDENT = 1e-4, 0.1
# The largest fraction of vertices and centers that may be beyond the tolerance before cells are
# made smaller; and the ratio of smaller cells to the cells before.
MAX_OFF_LEVEL_FRACTION, CELL_REFINEMENT_FACTOR = 0.01, 0.6
# The largest distance from the level, in cells, that is measured.
_MAX_DISTANCE_CELLS = 4.0
# The largest number of triangles at whose corners and centers distances are measured.
_MOST_MEASURED = 20_000
# Meshes with more triangles are not computed again.
_MOST_REMADE = 100_000
# How far points at which the function is no number are moved, relative to a cell.
_SINGULAR_POINT_SHIFT = 1e-3
_MAX_GROWTH_ROUNDS = 20


@dataclass(frozen=True)
class SignIsosurface:
    """A mesh that was extracted from the signs of f - level at the points of a lattice.

    surface: the mesh.
    points: the number of lattice points.
    undecided: the number of lattice points whose sign is not certain, because the error bound of f
        is not smaller than |f - level|.
    unfitted: the number of triangles whose vertices had been moved onto creases, and were moved
        back because triangles folded over or intersected.
    is_intersection_free: whether it was checked exactly that no triangles intersect."""

    surface: TriangleMesh
    points: int
    undecided: int
    unfitted: int
    is_intersection_free: bool


def mesh_from_signs(
    function: SignFunction,
    box: tuple[FloatArray, FloatArray],
    spacing: float,
    tolerance: float,
    attempts: int,
    report: Callable[[str], None],
    *,
    closed: bool = False,
    volume: Volume | None = None,
) -> tuple[SignIsosurface, LostParts, dict[str, Any]]:
    """Extract a mesh from signs in cells of a box (`extract_from_signs`), in smaller cells if these
    do not suffice.

    box: the lower and the upper corner (3,) of the box.
    spacing: the size of the cells that are tried first, a length.
    tolerance: the largest distance of triangles from the level set, a length.
    attempts: the largest number of extractions.
    closed: whether the surface is closed by parts of the box's faces, rather than ending there.
    volume: parts of the level set that the mesh lacks are counted only if they lie in this volume;
        None for all.

    The mesh is extracted again, from cells 0.6 times as large, if more than one in a hundred
    vertices and centers of triangles are farther than the tolerance from the level set, or if
    smaller cells may show parts that the mesh lacks.

    Returns:
        The mesh; the parts of the level set that it lost; and facts for the metadata, among them
        the number of points that are finally farther than the tolerance, and a distance within
        which all of them are.

    Raises:
        MeshingError: there is no surface, there are too many cells, or values are not finite.
    """
    level_points = PointsOnLevel.of(function, tolerance).within(*box, volume)
    while True:
        report(f"cells of {spacing:.3g}")
        layers = 2 if closed else 0
        lattice = BccLattice.covering_box(*box, spacing, layers=layers)
        try:
            mesh = extract_from_signs(function, lattice, 0.8 * tolerance, report, closed=closed)
        except EmptySurfaceError as error:
            nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
            lost = LostParts.of(function, level_points, nothing, tolerance, spacing)
            if not lost.far:
                raise
            raise EmptySurfaceError(f"the mesh is empty: {lost}; {lost.advice}") from error
        report("measuring distances to the level")
        far_count, count, within = _distances(function, mesh.surface, tolerance, lattice, closed)
        report("looking for parts that were lost")
        lost = LostParts.of(function, level_points, mesh.surface, tolerance, spacing)
        attempts -= 1
        may_help = far_count > MAX_OFF_LEVEL_FRACTION * count or (
            lost.matter and lost.are_mended_by(CELL_REFINEMENT_FACTOR)
        )
        if attempts <= 0 or not may_help or len(mesh.surface.faces) > _MOST_REMADE:
            break
        report(f"{far_count:,} of {count:,} vertices and centers are beyond the tolerance")
        if lost.matter:
            report(str(lost))
        spacing *= CELL_REFINEMENT_FACTOR
    facts = {
        "made_by": "signs",
        "spacing": spacing,
        "evaluations": function.evaluations,
        "isotopy": 0.0,
        "isotopy_far": 0.0,
        "undecided": mesh.undecided,
        "flat": mesh.unfitted,
        "far": far_count,
        "looked_at": count,
        "within": within,
        "lost": lost.far,
        "sought": lost.looked_at,
    }
    return mesh, lost, facts


def _distances(
    function: SignFunction,
    surface: TriangleMesh,
    tolerance: float,
    lattice: BccLattice,
    closed: bool,
) -> tuple[int, int, float]:
    """Measure how far the vertices and the centers of faces of a mesh are from the level set.

    Of large meshes only every second face is tested, or every third and so on. If the mesh is
    `closed` at the box of the lattice, faces in the two outermost layers of cells are not tested,
    because they will be cut away.

    Returns:
        The number of these points that are farther than `tolerance` from the level set; the number
        of points that were tested; and a distance within which all of them are, too large by up to
        a factor of 2, or inf if some are farther than 4 cells.
    """
    x, faces = surface.vertices, surface.faces
    if closed:
        lower, upper = lattice.lower + 2 * lattice.size, lattice.upper - 2 * lattice.size
        faces = faces[((x[faces] > lower) & (x[faces] < upper)).all(axis=(1, 2))]
    surface = TriangleMesh.without_unused_vertices(
        x, faces[:: -(-len(faces) // _MOST_MEASURED) or 1]
    )
    x, faces = surface.vertices, surface.faces
    off_level, count = points_off_level(function, x, faces, tolerance, None)
    within, farther = tolerance, off_level
    while len(farther) and within < _MAX_DISTANCE_CELLS * float(lattice.size.max()):
        within *= 2
        no_faces = np.zeros((0, 3), np.int64)
        farther, _ = points_off_level(function, farther, no_faces, within, None)
    return len(off_level), count, within if not len(farther) else math.inf


def extract_from_signs(
    function: SignFunction,
    lattice: BccLattice,
    tolerance: float,
    report: Callable[[str], None],
    *,
    closed: bool = False,
) -> SignIsosurface:
    """Extract the boundary of the set of points, in the box of a lattice, at which a function is
    not positive.

    tolerance: a length. An edge is split if it is farther than this from the surface, estimated
        from the normals at its ends.
    closed: whether the function counts as positive outside of the box. Then the surface is closed
        by parts of the box's faces; otherwise it ends there.

    Raises:
        MeshingError: there is no surface, there are too many cells, or values are not finite.
    """
    first = _march(function, lattice, closed, report)
    x, faces, normals, is_apart = _collapse_slivers(
        first,
        min(_SIMPLIFY_TOLERANCE * tolerance, _SIMPLIFY_CELL_FRACTION * float(lattice.size.min())),
    )
    report(f"{len(first.faces):,} triangles, {len(faces):,} without slivers")
    check_triangle_limit(len(faces), function.most_faces)
    flat = x
    on_crease = np.zeros(len(x), np.bool_)
    before = len(faces)
    for round_number in range(_ROUNDS):
        report(f"refining, round {round_number + 1}: {len(faces):,} triangles")
        cut = _CreaseRefinement.of(function, x, normals, on_crease, faces, tolerance)
        if not len(cut.points) or len(cut.points) > _MAX_CUT_FRACTION * before:
            break
        before = len(cut.points)
        check_triangle_limit(len(faces) + 2 * len(cut.points), function.most_faces)
        start, end = (flat[cut.ends[:, k]] for k in (0, 1))
        feet = start + cut.share[:, None] * (end - start)
        corner_feet = feet[cut.vertex_of_edge[cut.edges[cut.rows]] - len(x)]
        flat = np.concatenate([flat, feet, corner_feet.mean(axis=1)])
        x, faces = cut.applied(x, faces)
        normals = np.concatenate([normals, cut.normals])
        on_crease = np.concatenate([on_crease, cut.is_on_crease])
    report("looking for triangles that pass through each other")
    try:
        x, count = _undo_until_valid(x, flat, faces)
    except LocalizedMeshingError:  # as the tetrahedra cut it
        x, faces, count = first.vertices, first.faces, len(first.faces)
        is_apart = False
    return SignIsosurface(TriangleMesh(x, faces), first.points, first.undecided, count, is_apart)


@dataclass(frozen=True)
class _RawIsosurface:
    """The mesh that consists of the triangles in which the level set cuts tetrahedra, before it is
    improved.

    vertices: (n, 3), on the level set. normals: (n, 3) unit normals of the level set there.
    faces: (m, 3).
    points: the number of points of the lattice.
    undecided: the number of these points whose sign is not certain."""

    vertices: FloatArray
    normals: FloatArray
    faces: IntArray
    points: int
    undecided: int


def _march(
    function: SignFunction, lattice: BccLattice, closed: bool, report: Callable[[str], None]
) -> _RawIsosurface:
    """Cut all tetrahedra of a lattice that have corners of both signs, by marching tetrahedra.

    closed: whether the function counts as positive on the box's faces, so that the mesh is closed.

    Cells that are proved to contain no level are left out. Values and proofs are subject to
    rounding, so signs may nevertheless differ at the corners of such a cell. Then the surface has
    open edges there; the cells around these are added, until the surface ends only on the box.

    Raises:
        EmptySurfaceError: there is no surface.
        MeshingError: too many cells, values that are not finite, or a surface that still ends after
            20 rounds.
    """
    cells = lattice.nonempty_cells(function.clearance, function.most_faces)
    if closed:
        outer = lattice.outer_cells()
        outer = outer[function.values(lattice.points(2 * outer + 1)) <= 0]
        cells = distinct_rows(np.concatenate([cells, outer]))
    open_middles = np.zeros((0, 3))
    for _ in range(_MAX_GROWTH_ROUNDS):
        if not len(cells):
            raise EmptySurfaceError("the level set is empty: no cell of the box holds the level")
        coordinates, corners = lattice.tetrahedra(cells)
        points = lattice.points(coordinates)
        report(f"{len(points):,} points, {len(corners):,} tetrahedra")
        value = _finite_values(function, points, lattice.size)
        is_wall = lattice.is_on_box(coordinates)
        if closed:
            value[is_wall] = np.abs(value).max(initial=1.0)
        normals: list[FloatArray] = []

        def roots(low: FloatArray, high: FloatArray, normals: Any = normals) -> FloatArray:
            """(k, 3) the points where the edges from `low` to `high` (k, 3) meet the level set,
            moved a little if they are too near to an end. The unit normals (k, 3) there are
            appended to the list `normals`."""
            x, normal = function.crossings(low, high)
            normals.append(normal)
            edge = high - low
            square = row_dots(edge, edge)
            t = np.clip(row_dots(x - low, edge) / square, _EDGE_END_MARGIN, 1 - _EDGE_END_MARGIN)
            return low + t[:, None] * edge

        x, faces = _triangles(function, points, value, corners, roots)
        if not len(faces):
            raise EmptySurfaceError("the level set is empty: no cell of the box holds the level")
        ends = boundary_edges(faces)
        middle = x[ends].mean(axis=1)
        margin = 1e-9 * lattice.size
        is_inside = (middle > lattice.lower + margin) & (middle < lattice.upper - margin)
        open_middles = middle[is_inside.all(axis=1)]
        if not len(open_middles):
            return _RawIsosurface(
                x, normals[0], faces, len(points), function.count_undecided(points, value)
            )
        cell_index = np.floor((open_middles - lattice.lower) / lattice.size).astype(np.int64)
        offsets = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
        neighbors = np.clip((cell_index[:, None] + offsets).reshape(-1, 3), 0, lattice.counts - 1)
        cells = distinct_rows(np.concatenate([cells, neighbors]))
    raise LocalizedMeshingError(
        "signs differ at the corners of ever more cells that are proved empty: values of "
        f"{type(function.field).__name__} are not what it promises; choose a smaller `cell_size`",
        open_middles,
    )


def _collapse_slivers(
    raw: _RawIsosurface, tolerance: float
) -> tuple[FloatArray, IntArray, FloatArray, bool]:
    """Simplify a mesh: contract short edges, and remove vertices whose faces lie in a plane, so
    that the surface moves by at most `tolerance` (a length).

    The mesh stays unchanged if it is open, or if triangles of the simplified mesh would intersect.

    Returns:
        The vertices (n, 3); the faces (m, 3); the normals (n, 3) at the vertices; and whether it
        was checked that no triangles intersect. (Triangles of an unchanged mesh do not intersect,
        up to rounding, since they lie in different tetrahedra.)
    """
    import scipy.spatial  # imported here: it takes half a second

    searching: Any = scipy.spatial
    x, faces = raw.vertices, raw.faces
    if len(boundary_edges(faces)):
        return x, faces, raw.normals, False
    simpler = from_manifold(without_short_edges(to_manifold(TriangleMesh(x, faces)), tolerance))
    away, nearest = searching.cKDTree(x).query(simpler.vertices)
    if not len(simpler.faces) or away.any():
        return x, faces, raw.normals, False
    if len(intersecting_faces(simpler.vertices, simpler.faces)):
        return x, faces, raw.normals, False
    return simpler.vertices, simpler.faces, raw.normals[nearest], True


def _finite_values(function: SignFunction, points: FloatArray, size: FloatArray) -> FloatArray:
    """The values (n,) of the function at points (n, 3). If a value is not finite, as at a dipole,
    the function is evaluated a small fraction of a cell beside the point instead.

    size: (3,) the edge lengths of a cell.

    Raises:
        MeshingError: some values are still not finite.
    """
    value = function.values(points)
    for k in (1, 2):
        fails = np.flatnonzero(~np.isfinite(value))
        if not len(fails):
            return value
        value[fails] = function.values(points[fails] + k * _SINGULAR_POINT_SHIFT * size)
    fails = ~np.isfinite(value)
    if fails.any():
        x, y, z = points[fails][0]
        raise MeshingError(
            f"{type(function.field).__name__} has no finite value at {fails.sum():,} points, such "
            f"as ({x:.4g}, {y:.4g}, {z:.4g}): choose a `clip` where it has"
        )
    return value


def _triangles(
    function: SignFunction,
    points: FloatArray,
    value: FloatArray,
    corners: IntArray,
    roots: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, IntArray]:
    """The triangles in which the level set cuts tetrahedra: one triangle or two in each tetrahedron
    whose corners have both signs.

    points, value: (n, 3), (n,) points, and the values of the function there; 0 counts as negative.
    corners: (m, 4) the corners of the tetrahedra, as indices of points.
    roots: a function that takes the ends (k, 3) and (k, 3) of edges, and returns the points (k, 3)
        where the edges meet the level set.

    Returns:
        The vertices (k, 3), which lie within edges of tetrahedra, and the faces (j, 3).
    """
    above = value > 0
    up = above[corners].sum(axis=1)
    tets = Tetrahedra.of(points, corners[(up > 0) & (up < 4)])
    if not len(tets.corners):
        return points[:0], np.zeros((0, 3), np.int64)
    # A value of 0 counts as below; no point is on the level.
    nowhere = np.zeros(len(points), np.bool_)
    sampled = TetrahedronPoints(points, nowhere, LevelSamples(value, np.zeros_like(points), value))
    vertices, faces = extract_triangles(
        function, sampled, tets, count_crossings(function, sampled, tets), roots
    )
    return vertices[len(points) :], faces - len(points)


@dataclass(frozen=True)
class _CreaseRefinement:
    """The new vertices of a mesh whose edges and faces are split, so that it follows creases. The
    mesh has m faces and k edges; c edges are split, and d faces get a vertex in their interior.

    edges: (m, 3) the indices of the edges of each face.
    vertex_of_edge: (k,) the index of the new vertex of each edge; -1 for edges that are not split.
    ends: (c, 2) the vertices at the ends of the edges that are split.
    share: (c,) the fraction of each of these edges at which it is split.
    corner_faces, rows: (d, 3), (d,) the faces that get a vertex in their interior, and their
        indices.
    points, normals: (c + d, 3) the positions of the new vertices and the unit normals there; the
        new vertices on edges come first.
    is_on_crease: (c + d,) the mask of the new vertices that lie on a crease."""

    edges: IntArray
    vertex_of_edge: IntArray
    ends: IntArray
    share: FloatArray
    corner_faces: IntArray
    rows: IntArray
    points: FloatArray
    normals: FloatArray
    is_on_crease: BoolArray

    @classmethod
    def of(
        cls,
        function: SignFunction,
        x: FloatArray,
        normals: FloatArray,
        bent: BoolArray,
        faces: IntArray,
        tolerance: float,
    ) -> _CreaseRefinement:
        """Choose the edges and faces of a mesh to be split, and find their new vertices.

        x, normals: (n, 3) the vertices, and the unit normals of the level set there.
        bent: (n,) the mask of the vertices that lie on a crease. Since the surface has two tangent
            planes there, edges at these vertices are not split.
        faces: (m, 3). tolerance: a length.

        An edge is split if it is farther than `tolerance` from the line in which the tangent planes
        at both ends meet, and if the level set is found between the edge and that line. A face gets
        a vertex in its interior if all of its edges are split at a crease."""
        every = Edges.of(half_edges(faces))
        edges = every.edge_of_pair.reshape(3, -1).T
        rows = np.flatnonzero((every.multiplicity == 2) & ~bent[every.vertices].any(axis=1))
        ends = every.vertices[rows]
        one, other = normals[ends[:, 0]], normals[ends[:, 1]]
        a, b = x[ends[:, 0]], x[ends[:, 1]]
        t, along, sine2 = _toward_tangent_planes(a, b, one, other)
        long = row_norms(b - a)
        is_far = (
            (sine2 > _MIN_SQUARE) & (row_norms(along) > tolerance) & (long > _SHORTEST * tolerance)
        )
        rows, along, t = rows[is_far], along[is_far], t[is_far]
        foot, span = a[is_far] + t[:, None] * (b - a)[is_far], long[is_far]
        points, normal, passed = _level_along(function, foot, along, _OFFSET * span)
        rows, points, normal, t = rows[passed], points[passed], normal[passed], t[passed]
        ends = every.vertices[rows]
        vertex = np.full(len(every.vertices), -1, np.int64)
        vertex[rows] = len(x) + np.arange(len(rows))
        total, angle = (
            np.arccos(np.clip(one, -1, 1))
            for one in (
                row_dots(normals[ends[:, 0]], normals[ends[:, 1]]),
                np.minimum(*(row_dots(normals[ends[:, k]], normal) for k in (0, 1))),
            )
        )
        on_crease = (total > _MIN_CREASE_ANGLE) & (angle > _CREASE_ANGLE_SHARE * total)
        is_bent = np.concatenate([bent, on_crease])
        new = vertex[edges]
        corner = np.flatnonzero((new >= 0).all(axis=1) & is_bent[np.maximum(new, 0)].all(axis=1))
        inner, inner_normal, corner = _crease_corners(function, x, normals, faces, corner)
        return cls(
            edges, vertex, ends, t, faces[corner], corner, np.concatenate([points, inner]),
            np.concatenate([normal, inner_normal]),
            np.concatenate([on_crease, np.ones(len(inner), np.bool_)]),
        )  # fmt: skip

    def applied(self, x: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
        """Split the edges and faces. Returns the vertices, those of the mesh first, and the faces
        of the finer mesh.

        x, faces: (n, 3), (m, 3) the mesh."""
        vertices = np.concatenate([x, self.points])
        middle = self.vertex_of_edge[self.edges]
        is_other = np.ones(len(faces), np.bool_)
        is_other[self.rows] = False
        parts = [split_faces(vertices, faces[is_other], middle[is_other])]
        a, b, c = self.corner_faces.T
        u, v, w = middle[self.rows].T  # on the edges ab, bc and ca
        inner = len(vertices) - len(self.rows) + np.arange(len(self.rows))
        parts += [np.stack(t, axis=1) for t in ((a, u, w), (u, b, v), (w, v, c))]
        parts += [np.stack([*t, inner], axis=1) for t in ((u, v), (v, w), (w, u))]
        return vertices, np.concatenate(parts)


def _toward_tangent_planes(
    a: FloatArray, b: FloatArray, n_a: FloatArray, n_b: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """For each edge, the segment from the edge to the line in which the tangent planes at both of
    its ends meet.

    a, b: (k, 3) the ends of edges.
    n_a, n_b: (k, 3) unit normals of the tangent planes through a and through b.

    Returns:
        The point of the edge that is nearest to the line, as a fraction (k,) of the edge, kept away
        from both ends; the displacement (k, 3) from this point to the line; and the squared sine
        (k,) of the angle between the two normals. If the planes are parallel, the point is the
        middle of the edge, and the displacement 0.

    If many edges of a flat triangulation cross the same line, then the points of the line that
    belong to them come in the order in which the edges cross it. So the new triangles do not fold.
    """
    edge, line = b - a, np.cross(n_a, n_b)
    cosine, sine2 = row_dots(n_a, n_b), row_dots(line, line)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # A point of the line, relative to a: p.n_a = 0 and p.n_b = edge.n_b.
        factor = row_dots(edge, n_b) / sine2
        point = factor[:, None] * (n_b - cosine[:, None] * n_a)
        axis = line / np.sqrt(sine2)[:, None]
        across = edge - row_dots(edge, axis)[:, None] * axis
        fraction = row_dots(point, across) / row_dots(across, across)
        fraction = np.clip(fraction, _FROM_CORNERS, 1 - _FROM_CORNERS)
        foot = fraction[:, None] * edge
        direction = point + row_dots(foot - point, axis)[:, None] * axis - foot
    is_finite = np.isfinite(fraction) & np.isfinite(direction).all(axis=1)
    return np.where(is_finite, fraction, 0.5), np.where(is_finite[:, None], direction, 0.0), sine2


def _level_along(
    function: SignFunction, start: FloatArray, along: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Search for the level set along segments.

    start, along: (k, 3) the start of each segment, and the vector to its end. A vector longer than
        `limit` (k,) is shortened to that length. The search begins a little before the start and
        ends a little beyond the end.

    Returns:
        A point (k, 3) of the level set on each segment; the unit normal (k, 3) there; and the mask
        (k,) of the segments that have such a point: the function has different signs at the two
        ends of the search. For other segments, point and normal have no meaning.
    """
    along = along * np.minimum(1, limit / np.maximum(row_norms(along), 1e-300))[:, None]
    begin, end = start - _BEFORE * along, start + _AFTER * along
    is_positive = function.values(begin) > 0
    changes_sign = is_positive != (function.values(end) > 0)
    rows = np.flatnonzero(changes_sign)
    upwards = ~is_positive[rows, None]
    low, high = np.where(upwards, begin[rows], end[rows]), np.where(upwards, end[rows], begin[rows])
    points, normal = start.copy(), np.zeros_like(start)
    points[rows], normal[rows] = function.crossings(low, high)
    return points, normal, changes_sign


def _crease_corners(
    function: SignFunction, x: FloatArray, normals: FloatArray, faces: IntArray, rows: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """New vertices in the interior of faces that cut off a corner of the level set.

    x, normals: (n, 3) the vertices of the mesh, and the unit normals there. faces: (m, 3).
    rows: (k,) the indices of the faces that may get a new vertex.

    If the three normals at the corners of a face are linearly independent, the tangent planes there
    meet in a point. The line from the face's center to this point is followed, and the new vertex
    is where it passes the level set. A face has no new vertex if the normals are dependent, or if
    the line does not pass the level set near the face.

    Returns:
        The new vertices (j, 3); the normals (j, 3) there; and the indices (j,) of the faces that
        have such a vertex.
    """
    corner, normal = x[faces[rows]], normals[faces[rows]]
    det: Any = np.linalg.det
    independent = np.flatnonzero(np.abs(det(normal)) > _INDEPENDENT)
    rows, corner, normal = rows[independent], corner[independent], normal[independent]
    center = corner.mean(axis=1)
    longest = np.stack([row_norms(corner[:, k] - corner[:, k - 1]) for k in range(3)]).max(axis=0)
    offsets = np.einsum("kij,kij->ki", normal, corner - center[:, None])
    solve: Any = np.linalg.solve
    direction: FloatArray = solve(normal, offsets[:, :, None])[:, :, 0]
    points, normal, passed = _level_along(function, center, direction, _OFFSET * longest)
    return points[passed], normal[passed], rows[passed]


def _undo_until_valid(x: FloatArray, flat: FloatArray, faces: IntArray) -> tuple[FloatArray, int]:
    """Undo moves of vertices onto creases, until no face is folded over and no two faces intersect.
    Pairs of faces that have no moved vertex are not tested.

    x: (n, 3) the vertices after the moves.
    flat: (n, 3) the vertices before, on the triangles in which the level set cuts tetrahedra.

    Returns:
        The vertices (n, 3), and the number of faces whose vertices were moved back.

    Raises:
        LocalizedMeshingError: triangles still intersect.
    """
    x = x.copy()
    total = 0
    flat_normals = area_normals(flat[faces])
    for _ in range(_MOST_REPAIRS):
        moved = (x != flat).any(axis=1)
        turned = moved[faces].any(axis=1)
        turned[turned] = row_dots(area_normals(x[faces[turned]]), flat_normals[turned]) <= 0
        if not turned.any():
            break
        x[faces[turned]] = flat[faces[turned]]
        total += int(turned.sum())
    among: BoolArray = np.asarray((x != flat).any(axis=1)[faces].any(axis=1))
    failing = faces[:0, 0]
    for _ in range(_MOST_REPAIRS):
        failing = np.union1d(intersecting_faces(x, faces, among), _folded_faces(x, faces, among))
        if not len(failing):
            return x, total
        total += len(failing)
        near = np.zeros(len(x), np.bool_)
        near[faces[failing]] = True
        among = np.asarray(near[faces].any(axis=1))
        if not (x[near] != flat[near]).any():  # together with neighbors, so that the loop ends
            near[faces[among]] = True
            among = np.asarray(near[faces].any(axis=1))
        x[near] = flat[near]
    raise LocalizedMeshingError(
        f"{len(failing):,} triangles pass through each other still", x[faces[failing]].mean(axis=1)
    )


def _folded_faces(x: FloatArray, faces: IntArray, among: BoolArray) -> IntArray:
    """The indices of the faces that are folded onto a neighbor, up to rounding. A pair of neighbors
    is tested if the mask `among` (m,) is set for at least one of the two."""
    normal = area_normals(x[faces])
    normal /= np.maximum(row_norms(normal), 1e-300)[:, None]
    pairs = Edges.of(half_edges(faces)).paired_half_edges() % len(faces)
    first, second = pairs.T
    on_other = (row_dots(normal[first], normal[second]) < _FOLDED) & (among[first] | among[second])
    return np.unique(pairs[on_other])
