"""Closed meshes of a level set, made from the signs of a function on a lattice. This is for fields
that jump, are rough, or have few proved bounds. "The function" is a `SignFunction`, f - level for a
field f; the surface is where its sign changes. A lattice divides a box into cubes ("cells") and
these into tetrahedra. A "crease" is a sharp edge of the level set.

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

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    boundary_edges,
    half_edges,
    limited_rows,
    longest_edges,
    row_dots,
    row_norms,
    unit_normals,
)
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.bcc_lattice import BccLattice, distinct_rows
from harnack.meshing.checks import check_triangle_limit, points_off_level
from harnack.meshing.closed_mesh import from_manifold, to_manifold, without_short_edges
from harnack.meshing.delaunay_points import TetrahedronPoints
from harnack.meshing.level_function import LevelSamples
from harnack.meshing.lost_parts import LostParts, PointsOnLevel
from harnack.meshing.marching_tetrahedra import Tetrahedra, count_crossings, extract_triangles
from harnack.meshing.meshing_errors import (
    CELL_SIZE_RATIO,
    EmptySurfaceError,
    LocalizedMeshingError,
    MeshingError,
)
from harnack.meshing.refinement import cuts_off_crease, split_faces
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.sign_function import SignFunction
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from harnack.geometry import Volume

__all__ = [
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
# Across a crease normals turn by more than this angle.
_MIN_CREASE_ANGLE = math.radians(2)
# The level set is searched for on the line from an edge to the point where tangent planes meet. The
# search begins before the edge and ends after that point, by the first and up to the second of the
# displacement between them. The displacement is clamped to the third, in lengths of the edge.
_BEFORE, _AFTER, _OFFSET = 0.3, 1.3, 1.0
# Two tangent planes meet in a line if the squared sine of the angle between them is larger than the
# first; three of them meet in a point if the determinant of their unit normals is larger than the
# second.
_MIN_SQUARE, _INDEPENDENT = 1e-4, 0.1
# The largest fraction of vertices and centers that may be beyond the tolerance before cells are
# made smaller.
MAX_OFF_LEVEL_FRACTION = 0.01
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
    """Mesh the level set of a function from its signs in the cells of a box (`extract_from_signs`),
    again with smaller cells if these do not suffice.

    box: the lower and the upper corner (3,) of the box.
    spacing: the size of the cells that are tried first, a length.
    tolerance: the largest distance of triangles from the level set, a length.
    attempts: the largest number of extractions.
    report: called with messages about progress.
    closed: whether parts of the box's faces close the surface; otherwise it ends at the box.
    volume: parts of the level set that the mesh lacks are counted only if they lie in this volume;
        None for all.

    The mesh is extracted again, from cells 0.6 times as large, if more than one in a hundred
    vertices and centers of triangles are farther than the tolerance from the level set, or if
    smaller cells may show parts that the mesh lacks. A mesh of more than 100,000 triangles is not
    extracted again.

    Returns:
        The mesh; the parts of the level set that it lacks; and entries for the metadata, among them
        the number of vertices and centers that are finally farther than the tolerance, and a
        distance within which all of them are.

    Raises:
        EmptySurfaceError: there is no surface.
        MeshingError: there are too many cells, or values are not finite.
    """
    level_points = PointsOnLevel.of(function, tolerance).within(*box, volume)
    while True:
        report(f"cells of {spacing:.3g}")
        # Two more layers of cells around the box, in which a closed surface may be coarse.
        layers = 2 if closed else 0
        lattice = BccLattice.covering_box(*box, spacing, layers=layers)
        try:
            # Edges are split from 0.8 of the tolerance on, by an estimate of distances. Then
            # distances are measured.
            mesh = extract_from_signs(function, lattice, 0.8 * tolerance, report, closed=closed)
        except EmptySurfaceError as error:
            empty_mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
            # A level set that is known to have points is lost, not empty.
            lost = LostParts.of(function, level_points, empty_mesh, tolerance, spacing)
            if not lost.far:
                raise
            raise EmptySurfaceError(f"the mesh is empty: {lost}; {lost.advice}") from error
        report("measuring distances to the level")
        far_count, measured_count, within = _distances(
            function, mesh.surface, tolerance, lattice, closed
        )
        report("looking for parts that were lost")
        lost = LostParts.of(function, level_points, mesh.surface, tolerance, spacing)
        attempts -= 1
        may_help = far_count > MAX_OFF_LEVEL_FRACTION * measured_count or (
            lost.matter and lost.are_mended_by(CELL_SIZE_RATIO)
        )
        if attempts <= 0 or not may_help or len(mesh.surface.faces) > _MOST_REMADE:
            break
        report(f"{far_count:,} of {measured_count:,} vertices and centers are beyond the tolerance")
        if lost.matter:
            report(str(lost))
        spacing *= CELL_SIZE_RATIO
    facts = {
        "made_by": "signs",
        "spacing": spacing,
        "evaluations": function.evaluations,
        "isotopy": 0.0,
        "isotopy_far": 0.0,
        "undecided": mesh.undecided,
        "flat": mesh.unfitted,
        "far": far_count,
        "looked_at": measured_count,
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

    function: side * (f - level) for a field f; its sign changes at the level set.
    tolerance: a length.
    lattice, closed: the lattice of the mesh, and whether parts of the box's faces close the mesh.
        If they do, faces in the two outermost layers of cells are not measured, because they will
        be cut away.

    Of meshes with more than 20,000 faces only every second face is measured, or every third and so
    on.

    Returns:
        The number of points that are farther than `tolerance` from the level set; the number of
        points that were measured; and a distance within which all of them are, too large by up to a
        factor of 2, or inf if some are farther than 4 cells.
    """
    x, faces = surface.vertices, surface.faces
    if closed:
        lower, upper = lattice.lower + 2 * lattice.size, lattice.upper - 2 * lattice.size
        faces = faces[((x[faces] > lower) & (x[faces] < upper)).all(axis=(1, 2))]
    # Every k-th face, with the smallest k for which at most 20,000 are left (1 without faces).
    surface = TriangleMesh.without_unused_vertices(
        x, faces[:: -(-len(faces) // _MOST_MEASURED) or 1]
    )
    x, faces = surface.vertices, surface.faces
    # (None: no volume has cut the mesh.)
    off_level, measured_count = points_off_level(function, x, faces, tolerance, None)
    # Double the distance until no point is farther.
    within, farther = tolerance, off_level
    while len(farther) and within < _MAX_DISTANCE_CELLS * float(lattice.size.max()):
        within *= 2
        no_faces = np.zeros((0, 3), np.int64)
        farther, _ = points_off_level(function, farther, no_faces, within, None)
    return len(off_level), measured_count, within if not len(farther) else math.inf


def extract_from_signs(
    function: SignFunction,
    lattice: BccLattice,
    tolerance: float,
    report: Callable[[str], None],
    *,
    closed: bool = False,
) -> SignIsosurface:
    """Extract the surface where a function changes its sign, in the box of a lattice: the boundary
    of the set of points at which it is not positive.

    Tetrahedra are cut by the level set, slivers removed, and then edges and faces are split along
    creases in up to two rounds. If triangles of the result intersect and that cannot be mended, the
    triangles as cut from the tetrahedra are returned.

    tolerance: a length. An edge is split if it is farther than this from the surface, estimated
        from the normals at its ends.
    report: called with messages about progress.
    closed: whether the function counts as positive outside of the box. Then parts of the box's
        faces close the surface; otherwise it ends there.

    Raises:
        EmptySurfaceError: there is no surface.
        MeshingError: there are too many cells, or values are not finite.
    """
    raw = _march(function, lattice, closed, report)
    x, faces, normals, is_intersection_free = _collapse_slivers(
        raw,
        min(_SIMPLIFY_TOLERANCE * tolerance, _SIMPLIFY_CELL_FRACTION * float(lattice.size.min())),
    )
    report(f"{len(raw.faces):,} triangles, {len(faces):,} without slivers")
    check_triangle_limit(len(faces), function.most_faces)
    # For each vertex its position on the unrefined triangles, to which it can be moved back.
    unmoved = x
    on_crease = np.zeros(len(x), np.bool_)
    last_split_count = len(faces)
    for round_number in range(_ROUNDS):
        report(f"refining, round {round_number + 1}: {len(faces):,} triangles")
        refinement = _CreaseRefinement.of(function, x, normals, on_crease, faces, tolerance)
        if (
            not len(refinement.points)
            or len(refinement.points) > _MAX_CUT_FRACTION * last_split_count
        ):
            break
        last_split_count = len(refinement.points)
        check_triangle_limit(len(faces) + 2 * len(refinement.points), function.most_faces)
        # Unmoved positions of new vertices: on edges, and the mean of three of these in faces.
        start, end = (unmoved[refinement.ends[:, k]] for k in (0, 1))
        unmoved_on_edges = start + refinement.share[:, None] * (end - start)
        unmoved_in_faces = unmoved_on_edges[
            refinement.vertex_of_edge[refinement.edges[refinement.rows]] - len(x)
        ]
        unmoved = np.concatenate([unmoved, unmoved_on_edges, unmoved_in_faces.mean(axis=1)])
        x, faces = refinement.applied(x, faces)
        normals = np.concatenate([normals, refinement.normals])
        on_crease = np.concatenate([on_crease, refinement.is_on_crease])
    report("looking for triangles that pass through each other")
    try:
        x, unfitted_count = _undo_until_valid(x, unmoved, faces)
    except LocalizedMeshingError:  # as cut from the tetrahedra
        x, faces, unfitted_count = raw.vertices, raw.faces, len(raw.faces)
        is_intersection_free = False
    return SignIsosurface(
        TriangleMesh(x, faces), raw.points, raw.undecided, unfitted_count, is_intersection_free
    )


@dataclass(frozen=True)
class _RawIsosurface:
    """The mesh of the triangles in which the level set cuts tetrahedra, before it is improved.

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
    """Cut the level set from the tetrahedra of a lattice: all tetrahedra that have corners of both
    signs (marching tetrahedra).

    closed: whether the function counts as positive on the box's faces, so that the mesh is closed.
    report: called with messages about the progress.

    Cells that are proved to contain no level are left out. Values and proofs are subject to
    rounding, so signs may nevertheless differ at the corners of such a cell. Then the surface has
    open edges inside of the box; the cells around these edges are added, until the surface ends
    only on the box.

    Raises:
        EmptySurfaceError: there is no surface.
        MeshingError: too many cells, values that are not finite, or a surface that still has open
            edges inside of the box after 20 rounds.
    """
    cells = lattice.nonempty_cells(function.clearance, function.most_faces)
    if closed:
        outer = lattice.outer_cells()
        # Outermost cells that are inside belong to the solid as a whole.
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
            # A positive value on the box, of the size of the others.
            value[is_wall] = np.abs(value).max(initial=1.0)
        normals: list[FloatArray] = []

        def roots(low: FloatArray, high: FloatArray, normals: Any = normals) -> FloatArray:
            """(k, 3) the points where the edges from `low` to `high` (k, 3) meet the level set,
            moved a little if they are too near to an end. As a side effect, the unit normals (k, 3)
            there are appended to the list `normals`."""
            x, normal = function.crossings(low, high)
            normals.append(normal)
            edge = high - low
            square = row_dots(edge, edge)
            t = np.clip(row_dots(x - low, edge) / square, _EDGE_END_MARGIN, 1 - _EDGE_END_MARGIN)
            return low + t[:, None] * edge

        x, faces = _triangles(function, points, value, corners, roots)
        if not len(faces):
            raise EmptySurfaceError("the level set is empty: no cell of the box holds the level")
        open_edges = boundary_edges(faces)
        middles = x[open_edges].mean(axis=1)
        # Middles this near to a face of the box lie on it, up to rounding.
        margin = 1e-9 * lattice.size
        is_inside = (middles > lattice.lower + margin) & (middles < lattice.upper - margin)
        open_middles = middles[is_inside.all(axis=1)]
        if not len(open_middles):
            return _RawIsosurface(
                x, normals[0], faces, len(points), function.count_undecided(points, value)
            )
        # Add the 27 cells around each open edge.
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
    """Simplify the mesh `raw`: contract short edges, and remove vertices whose faces lie in a
    plane. The surface moves by at most `tolerance` (a length).

    The mesh stays unchanged if it is open, or if triangles of the simplified mesh would intersect.

    Returns:
        The vertices (n, 3); the faces (m, 3); the normals (n, 3) at the vertices; and whether it
        was checked that no triangles intersect. (Triangles of an unchanged mesh do not intersect,
        up to rounding, since they lie in different tetrahedra.)
    """
    x, faces = raw.vertices, raw.faces
    if len(boundary_edges(faces)):
        return x, faces, raw.normals, False
    simplified = from_manifold(without_short_edges(to_manifold(TriangleMesh(x, faces)), tolerance))
    # Vertices are only removed, never moved: each is one of the given ones, with its normal.
    distances, nearest = kd_tree(x).query(simplified.vertices)
    if not len(simplified.faces) or distances.any():
        return x, faces, raw.normals, False
    if len(intersecting_faces(simplified.vertices, simplified.faces)):
        return x, faces, raw.normals, False
    return simplified.vertices, simplified.faces, raw.normals[nearest], True


def _finite_values(function: SignFunction, points: FloatArray, size: FloatArray) -> FloatArray:
    """Evaluate the function at points (n, 3). Returns its values (n,). If a value is not finite, as
    at a dipole, the function is evaluated beside the point instead, a small fraction of a cell
    away.

    size: (3,) the edge lengths of a cell.

    Raises:
        MeshingError: some values are still not finite.
    """
    value = function.values(points)
    # Try two points beside each of these, along the diagonal of a cell.
    for k in (1, 2):
        rows = np.flatnonzero(~np.isfinite(value))
        if not len(rows):
            return value
        value[rows] = function.values(points[rows] + k * _SINGULAR_POINT_SHIFT * size)
    rows = ~np.isfinite(value)
    if rows.any():
        x, y, z = points[rows][0]
        raise MeshingError(
            f"{type(function.field).__name__} has no finite value at {rows.sum():,} points, such "
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
    """The triangles in which the level set cuts tetrahedra: one or two in each tetrahedron whose
    corners have both signs.

    points, value: (n, 3), (n,) points, and the values of the function there; 0 counts as negative.
    corners: (m, 4) the corners of the tetrahedra, as indices of points.
    roots: a function that takes the ends (k, 3) and (k, 3) of edges, and returns the points (k, 3)
        where the edges meet the level set.

    Returns:
        The vertices (k, 3), which lie within edges of tetrahedra, and the faces (j, 3).
    """
    is_positive = value > 0
    positive_count = is_positive[corners].sum(axis=1)
    tetrahedra = Tetrahedra.of(points, corners[(positive_count > 0) & (positive_count < 4)])
    if not len(tetrahedra.corners):
        return points[:0], np.zeros((0, 3), np.int64)
    # A value of 0 counts as below; no point is on the level. Gradients and radii are not used.
    is_on_level = np.zeros(len(points), np.bool_)
    sampled = TetrahedronPoints(
        points, is_on_level, LevelSamples(value, np.zeros_like(points), value)
    )
    vertices, faces = extract_triangles(
        function, sampled, tetrahedra, count_crossings(function, sampled, tetrahedra), roots
    )
    # The first vertices are the lattice points, which no face uses here.
    return vertices[len(points) :], faces - len(points)


@dataclass(frozen=True)
class _CreaseRefinement:
    """A plan for splitting the edges and faces of a mesh, so that it follows creases of the level
    set: which are split, and where the new vertices are. The mesh has m faces and k edges; c edges
    are split, and d faces get a vertex in their interior.

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
        """Choose the edges and faces of a mesh that are to be split, and find their new vertices.

        function: side * (f - level) for a field f; its sign changes at the level set.
        x, normals: (n, 3) the vertices, and the unit normals of the level set there.
        bent: (n,) the mask of the vertices that lie on a crease. Since the surface has two tangent
            planes there, edges at these vertices are not split.
        faces: (m, 3). tolerance: a length.

        An edge is split if it is farther than `tolerance` from the line in which the tangent planes
        at both ends meet, and if the level set is found between the edge and that line. The new
        vertex lies on a crease if the normal there differs from the normal at one end of the edge
        by nearly the angle between both ends; on a smooth surface it differs by about half of that.
        A face gets a vertex in its interior if all of its edges are split at a crease.
        """
        all_edges = Edges.of(half_edges(faces))
        edges = all_edges.edge_of_pair.reshape(3, -1).T
        # Candidates: interior edges without an end on a crease.
        rows = np.flatnonzero((all_edges.multiplicity == 2) & ~bent[all_edges.vertices].any(axis=1))
        ends = all_edges.vertices[rows]
        one, other = normals[ends[:, 0]], normals[ends[:, 1]]
        a, b = x[ends[:, 0]], x[ends[:, 1]]
        fraction, to_line, squared_sine = _toward_tangent_planes(a, b, one, other)
        edge_length = row_norms(b - a)
        # Of these, the edges that are far from the line in which the tangent planes meet; neither
        # nearly parallel planes nor short edges.
        is_far = (
            (squared_sine > _MIN_SQUARE)
            & (row_norms(to_line) > tolerance)
            & (edge_length > _SHORTEST * tolerance)
        )
        rows, to_line, fraction = rows[is_far], to_line[is_far], fraction[is_far]
        # Of these, the edges beside which the level set is found, on segments at most `_OFFSET`
        # times as long as the edge.
        foot, far_length = a[is_far] + fraction[:, None] * (b - a)[is_far], edge_length[is_far]
        points, new_normal, is_found = _level_along(function, foot, to_line, _OFFSET * far_length)
        rows, points, new_normal, fraction = (
            rows[is_found],
            points[is_found],
            new_normal[is_found],
            fraction[is_found],
        )
        ends = all_edges.vertices[rows]
        vertex_of_edge = np.full(len(all_edges.vertices), -1, np.int64)
        vertex_of_edge[rows] = len(x) + np.arange(len(rows))
        is_on_crease = cuts_off_crease(
            normals[ends[:, 0]], normals[ends[:, 1]], new_normal, _MIN_CREASE_ANGLE
        )
        is_bent = np.concatenate([bent, is_on_crease])
        new_vertices_of_face = vertex_of_edge[edges]
        # Faces whose three new vertices all lie on creases; then those that get an inner vertex. (0
        # in place of -1: the first condition has excluded these faces.)
        fan_rows = np.flatnonzero(
            (new_vertices_of_face >= 0).all(axis=1)
            & is_bent[np.maximum(new_vertices_of_face, 0)].all(axis=1)
        )
        inner_points, inner_normal, fan_rows = _crease_corners(
            function, x, normals, faces, fan_rows
        )
        return cls(
            edges, vertex_of_edge, ends, fraction, faces[fan_rows], fan_rows,
            np.concatenate([points, inner_points]), np.concatenate([new_normal, inner_normal]),
            np.concatenate([is_on_crease, np.ones(len(inner_points), np.bool_)]),
        )  # fmt: skip

    def applied(self, x: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
        """Split the edges and faces of the mesh `x` (n, 3), `faces` (m, 3). Returns the vertices of
        the finer mesh, the given ones first, and its faces."""
        # `rows` and `corner_faces` are the faces that get an inner vertex; these come last in
        # `points`.
        vertices = np.concatenate([x, self.points])
        middle = self.vertex_of_edge[self.edges]
        is_without_inner = np.ones(len(faces), np.bool_)
        is_without_inner[self.rows] = False
        parts = [split_faces(vertices, faces[is_without_inner], middle[is_without_inner])]
        a, b, c = self.corner_faces.T
        u, v, w = middle[self.rows].T  # on the edges ab, bc and ca
        inner_vertices = len(vertices) - len(self.rows) + np.arange(len(self.rows))
        # A face with an inner vertex becomes six: one at each corner, three around the new vertex.
        parts += [np.stack(t, axis=1) for t in ((a, u, w), (u, b, v), (w, v, c))]
        parts += [np.stack([*t, inner_vertices], axis=1) for t in ((u, v), (v, w), (w, u))]
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
        middle of the edge, and the displacement is 0.

    The new vertex of the edge is searched for along this segment. If many edges of a flat
    triangulation cross the same line, their nearest points on it are in the order in which they
    cross it. So the new triangles do not fold.
    """
    edge, line = b - a, np.cross(n_a, n_b)
    cosine, squared_sine = row_dots(n_a, n_b), row_dots(line, line)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # A point of the line, relative to a: p.n_a = 0 and p.n_b = edge.n_b.
        factor = row_dots(edge, n_b) / squared_sine
        point = factor[:, None] * (n_b - cosine[:, None] * n_a)
        axis = line / np.sqrt(squared_sine)[:, None]
        # The part of the edge across the line decides where it is nearest to the line.
        across = edge - row_dots(edge, axis)[:, None] * axis
        fraction = row_dots(point, across) / row_dots(across, across)
        fraction = np.clip(fraction, _FROM_CORNERS, 1 - _FROM_CORNERS)
        foot = fraction[:, None] * edge
        # From the point of the edge to the nearest point of the line.
        direction = point + row_dots(foot - point, axis)[:, None] * axis - foot
    is_finite = np.isfinite(fraction) & np.isfinite(direction).all(axis=1)
    return (
        np.where(is_finite, fraction, 0.5),
        np.where(is_finite[:, None], direction, 0.0),
        squared_sine,
    )


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
    along = limited_rows(along, limit)
    begin, end = start - _BEFORE * along, start + _AFTER * along
    is_positive = function.values(begin) > 0
    changes_sign = is_positive != (function.values(end) > 0)
    rows = np.flatnonzero(changes_sign)
    # `SignFunction.crossings` expects the end with the lower value first.
    is_rising = ~is_positive[rows, None]
    low, high = (
        np.where(is_rising, begin[rows], end[rows]),
        np.where(is_rising, end[rows], begin[rows]),
    )
    points, normal = start.copy(), np.zeros_like(start)
    points[rows], normal[rows] = function.crossings(low, high)
    return points, normal, changes_sign


def _crease_corners(
    function: SignFunction, x: FloatArray, normals: FloatArray, faces: IntArray, rows: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """New vertices in the interior of faces that cut off a corner of the level set, where creases
    meet.

    function: side * (f - level) for a field f; its sign changes at the level set.
    x, normals: (n, 3) the vertices of the mesh, and the unit normals there. faces: (m, 3).
    rows: (k,) the indices of the faces that may get a new vertex.

    If the three normals at the corners of a face are linearly independent, the tangent planes there
    meet in a point. The new vertex is where the line from the face's center to this point passes
    the level set. A face has no new vertex if the normals are dependent, or if the line does not
    pass the level set near the face.

    Returns:
        The new vertices (j, 3); the normals (j, 3) there; and the indices (j,) of the faces that
        have such a vertex.
    """
    corner, normal = x[faces[rows]], normals[faces[rows]]
    determinant: Any = np.linalg.det
    independent = np.flatnonzero(np.abs(determinant(normal)) > _INDEPENDENT)
    rows, corner, normal = rows[independent], corner[independent], normal[independent]
    center = corner.mean(axis=1)
    # The common point p of the planes n_k . (p - corner_k) = 0, relative to the center.
    offsets = np.einsum("kij,kij->ki", normal, corner - center[:, None])
    solve: Any = np.linalg.solve
    direction: FloatArray = solve(normal, offsets[:, :, None])[:, :, 0]
    points, new_normals, is_found = _level_along(
        function, center, direction, _OFFSET * longest_edges(corner)
    )
    return points[is_found], new_normals[is_found], rows[is_found]


def _undo_until_valid(
    x: FloatArray, unmoved: FloatArray, faces: IntArray
) -> tuple[FloatArray, int]:
    """Undo moves of vertices onto creases, until no face is folded over and no two faces intersect.
    Pairs of faces that have no moved vertex are not tested.

    x: (n, 3) the vertices after the moves.
    unmoved: (n, 3) the vertices before the moves, on the triangles in which the level set cuts
        tetrahedra.
    faces: (m, 3).

    Returns:
        The vertices (n, 3), and the number of faces whose vertices were moved back.

    Raises:
        LocalizedMeshingError: triangles still intersect.
    """
    # First faces that are turned over, then faces that intersect others or are folded onto them.
    x = x.copy()
    undone_count = 0
    unmoved_normals = area_normals(unmoved[faces])
    for _ in range(_MOST_REPAIRS):
        is_moved = (x != unmoved).any(axis=1)
        is_turned = is_moved[faces].any(axis=1)
        # Of the faces with moved vertices, those whose normal turned by 90 degrees or more.
        is_turned[is_turned] = (
            row_dots(area_normals(x[faces[is_turned]]), unmoved_normals[is_turned]) <= 0
        )
        if not is_turned.any():
            break
        x[faces[is_turned]] = unmoved[faces[is_turned]]
        undone_count += int(is_turned.sum())
    is_tested: BoolArray = np.asarray((x != unmoved).any(axis=1)[faces].any(axis=1))
    failing = faces[:0, 0]  # no indices
    for _ in range(_MOST_REPAIRS):
        failing = np.union1d(
            intersecting_faces(x, faces, is_tested), _folded_faces(x, faces, is_tested)
        )
        if not len(failing):
            return x, undone_count
        undone_count += len(failing)
        is_reset = np.zeros(len(x), np.bool_)
        is_reset[faces[failing]] = True
        is_tested = np.asarray(is_reset[faces].any(axis=1))
        if not (x[is_reset] != unmoved[is_reset]).any():  # none moved: undo at neighbors, too
            is_reset[faces[is_tested]] = True
            is_tested = np.asarray(is_reset[faces].any(axis=1))
        x[is_reset] = unmoved[is_reset]
    raise LocalizedMeshingError(
        f"{len(failing):,} triangles pass through each other still", x[faces[failing]].mean(axis=1)
    )


def _folded_faces(x: FloatArray, faces: IntArray, among: BoolArray) -> IntArray:
    """The indices of the faces that are folded onto a neighbor (a face with a common edge), up to
    rounding: the normals of both are opposite. A pair of neighbors is tested if the mask `among`
    (m,) is set for at least one of the two."""
    normal = unit_normals(x[faces])
    # Half edge h is one of face h % len(faces).
    pairs = Edges.of(half_edges(faces)).paired_half_edges() % len(faces)
    first, second = pairs.T
    is_folded = (row_dots(normal[first], normal[second]) < _FOLDED) & (among[first] | among[second])
    return np.unique(pairs[is_folded])
