"""Harmonic fillings of the holes of a mesh: they lie on the surface on which the winding number w
of the mesh is 1/2 modulo 1, and fill all holes at once. A patch is a connected piece of the
filling; here `patches` is the filling as a whole. The mesh has vertices (n, 3) and faces (m, 3),
which hold indices of vertices; its boundary edges have a single face.

The surface w = 1/2 modulo 1 is the level set 2 pi, modulo 4 pi, of the solid angle of the boundary
edges (`geometry.boundary_edges` has the proof): a smooth surface that ends at these edges. The
surface is meshed so that its mesh has exactly these boundary edges, and both meshes are joined at
the common vertices. A harmonic filling connects all boundary loops of a gap, whereas `hole_filling`
closes each loop by itself.
"""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import IntArray
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry import MeshError
from harnack.geometry.boundary_edges import singular_loops
from harnack.geometry.mesh_edges import Edges, area_normals, half_edges
from harnack.meshing.checks import check_manifold, nonmanifold_vertices
from harnack.meshing.delaunay_points import (
    BoundaryCurve,
    RefinementBalls,
    box_cells,
    sample_delaunay_points,
)
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.marching_tetrahedra import count_crossings, delaunay, extract_triangles
from harnack.meshing.meshing_errors import (
    LocalizedMeshingError,
    MeshingError,
    TriangleLimitError,
    is_retry_promising,
)
from harnack.meshing.refinement import improve, refine, smooth, unrefined_midpoints
from harnack.meshing.self_intersection import intersecting_faces

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.meshing.mesh_tolerance import MeshTolerance

__all__ = [
    "HarmonicFilling",
    "HoleFillingOptions",
    "checked_boundary_edges",
    "harmonic_patches",
    "triangle_fills",
]

_LEVEL = 2 * math.pi
# The initial number of cells across the box around all holes.
_CELLS_ACROSS = 24
# Boundary edges that are missing among the edges of the tetrahedra are halved, at most so often.
# The largest number of pieces in all, and for each edge: so many arise where edges lie on each
# other.
_MAX_HALVINGS, _MAX_PIECES, _MAX_PIECES_PER_EDGE = 12, 20_000, 64
# How often a filling that intersects the mesh is computed again, with smaller cells.
_MAX_MESH_RETRIES = 1
# How far the winding number may be from 1/2, modulo 1, at vertices of patches.
_MAX_WINDING_ERROR = 1e-6


@dataclass(frozen=True)
class HoleFillingOptions:
    """Options of harmonic fillings.

    tolerance: how far fillings may be from the surface, relative to the size of the box around all
        holes.
    spacing: the size of cells at first, a length; None for a 24th of that box.
    seed: the seed of the random moves of points.
    attempts: how many times a filling is computed, with smaller cells where checks failed.
    report: receives messages about the progress.
    """

    tolerance: MeshTolerance
    spacing: float | None
    seed: int
    attempts: int
    report: Callable[[str], None]


@dataclass(frozen=True)
class HarmonicFilling:
    """The vertices and faces that a harmonic filling adds to a mesh.

    vertices: (k, 3) the new vertices.
    faces: (p, 3). Indices below the number of the mesh's vertices stand for vertices of the mesh,
        the following ones for new vertices.
    is_refined: whether the faces were refined to the tolerance.
    spacing: the size of cells at first, a length.
    evaluations: the number of points at which the solid angle was evaluated.
    triangle_fill_count: how many of the faces are single triangles that fill holes of three edges.
    """

    vertices: FloatArray
    faces: IntArray
    is_refined: bool
    spacing: float
    evaluations: int
    triangle_fill_count: int = 0


def harmonic_patches(
    vertices: FloatArray, faces: IntArray, edges: IntArray, options: HoleFillingOptions
) -> HarmonicFilling:
    """Fill the holes of a mesh by a harmonic filling that ends at its boundary edges. If that
    fails, holes of three edges are filled by triangles, and all other holes by a harmonic filling.

    vertices, faces: (n, 3), (m, 3) the mesh.
    edges: (k, 2) its boundary edges, in the direction of its faces.

    Raises:
        MeshingError: a filling could not be computed, or intersects the mesh or itself.
    """
    try:
        return _fill_all_holes(vertices, faces, edges, options)
    except MeshingError as error:
        missing = triangle_fills(vertices, faces, edges)
        if not len(missing):
            raise
        first = error
    options.report(f"once more, with triangles in {len(missing):,} holes of three edges")
    together = np.concatenate([faces, missing])
    try:
        filling = _fill_all_holes(vertices, together, checked_boundary_edges(together), options)
    except MeshingError as error:
        raise MeshingError(
            f"{first}; and with triangles in {len(missing):,} holes of three edges: {error}"
        ) from error
    all_new_faces = np.concatenate([missing, filling.faces])
    return dataclasses.replace(filling, faces=all_new_faces, triangle_fill_count=len(missing))


def _fill_all_holes(
    vertices: FloatArray, faces: IntArray, edges: IntArray, options: HoleFillingOptions
) -> HarmonicFilling:
    """Make the harmonic filling of all holes: faces that end at the boundary edges of the mesh. If
    a check fails in known places, the filling is computed again with smaller cells there. If a
    point lies where the function is too inaccurate, it is computed again with other random moves of
    points.

    vertices, faces: (n, 3), (m, 3) the mesh.
    edges: (k, 2) its boundary edges, in the direction of its faces.

    Raises:
        MeshingError: the filling could not be computed, or intersects the mesh or itself.
    """
    # No hole: no vertices, no faces, nothing to refine, no cells and no evaluations.
    if not len(edges):
        return HarmonicFilling(vertices[:0], faces[:0], True, 0.0, 0)
    # Each boundary edge counts once, in its direction.
    loops = singular_loops(edges, np.ones(len(edges), np.int64))
    function = LevelFunction(SolidAngle([vertices[loop] for loop in loops]), _LEVEL)
    size = float(np.ptp(vertices[np.unique(edges)], axis=0).max())
    cell_size = size / _CELLS_ACROSS if options.spacing is None else float(options.spacing)
    report, tolerance = options.report, options.tolerance.within(size)
    refinement_balls: tuple[RefinementBalls, ...] = ()
    mesh_intersection_count, seed, previous = 0, options.seed, None
    for attempt in range(options.attempts):
        is_last = attempt == options.attempts - 1
        report(f"cells of {cell_size:.3g}" + ", smaller in places" * bool(refinement_balls))
        try:
            patches = _mesh_patches(
                function,
                vertices,
                edges,
                cell_size,
                refinement_balls,
                tolerance,
                seed,
                is_last,
                report,
            )
            _check_filled_mesh(vertices, faces, patches, report)
        except LocalizedMeshingError as error:
            mesh_intersection_count += isinstance(error, _MeshIntersectionError)
            is_hopeless, previous = not is_retry_promising(error, previous), error
            if is_last or is_hopeless or mesh_intersection_count > _MAX_MESH_RETRIES:
                location = ", ".join(f"{c:.4g}" for c in error.locations[0])
                raise MeshingError(
                    f"{error} (cells were {cell_size:.3g} wide, and smaller in "
                    f"{len(error.locations)} places, such as near ({location}))"
                ) from None
            report(f"{error} ({len(error.locations)} places)")
            # The radius is two cells, half of that in the next attempt, and so on.
            refinement_balls = (
                *refinement_balls,
                RefinementBalls(error.locations, 2 * cell_size * 0.5 ** len(refinement_balls)),
            )
        except TriangleLimitError:
            raise
        except MeshingError as error:  # a point lies where the function is too inaccurate
            if is_last:
                raise
            report(f"{error}; once more, with points moved at random in another way")
            seed += 1
        else:
            return patches
    raise AssertionError("unreachable: the last attempt returns or raises")


class _MeshIntersectionError(LocalizedMeshingError):
    """A harmonic filling intersects the mesh; `locations` holds the centers of its faces that
    do."""


def checked_boundary_edges(faces: IntArray) -> IntArray:
    """The boundary edges (k, 2) of faces (m, 3), which have a single face each; in the direction in
    which this face runs them.

    Raises:
        MeshError: an edge has more than two faces, or two that run it in the same direction.
    """
    pairs = half_edges(faces)
    edges = Edges.of(pairs)
    index, uses = edges.edge_of_pair, edges.multiplicity
    overused = np.flatnonzero(uses > 2)
    if len(overused):
        a, b = edges.vertices[overused[0]].tolist()
        raise MeshError(
            f"{len(overused):,} edges have more than two faces, the first of them between vertices "
            f"{a} and {b}: such a mesh has no two sides there, and where all faces are kept none "
            "are left out"
        )
    turned = np.flatnonzero(edges.run_twice_alike(pairs))
    if len(turned):
        a, b = edges.vertices[turned[0]].tolist()
        raise MeshError(
            f"the faces at {len(turned):,} edges do not agree which side is outside, the first of "
            f"them between vertices {a} and {b}, and where all faces are kept none are turned over"
        )
    return pairs[uses[index] == 1]


def triangle_fills(vertices: FloatArray, faces: IntArray, edges: IntArray) -> IntArray:
    """Triangles (k, 3) that fill those holes of a mesh that have three edges. Triangles without an
    area, and triangles that would intersect others, are left out.

    vertices, faces: (n, 3), (m, 3) the mesh.
    edges: (j, 2) its boundary edges, in the direction of the faces.
    """
    successors: dict[int, set[int]] = defaultdict(set)
    for a, b in edges.tolist():
        successors[a].add(b)
    existing = {tuple(sorted(face)) for face in faces.tolist()}
    fills: list[tuple[int, int, int]] = []
    for a, b in edges.tolist():
        for c in successors[b]:
            # A loop a, b, c whose edges are not used yet, and which is no face of the mesh itself.
            if (
                a in successors[c]
                and tuple(sorted((a, b, c))) not in existing
                and b in successors[a]
            ):
                # The triangle runs the edges in the other direction than the faces around the hole.
                fills.append((a, c, b))
                for start, end in ((a, b), (b, c), (c, a)):
                    successors[start].discard(end)
                break
    triangles = np.array(fills, np.int64).reshape(-1, 3)
    corners = vertices[triangles]
    triangles = triangles[np.linalg.norm(_unit_normals(corners), axis=1) > 0]
    together = np.concatenate([faces, triangles])
    is_new = np.arange(len(together)) >= len(faces)
    # Of the intersecting faces those that are new.
    intersecting = np.setdiff1d(
        intersecting_faces(vertices, together, is_new), np.arange(len(faces))
    )
    return np.delete(triangles, intersecting - len(faces), axis=0)


def _mesh_patches(
    function: LevelFunction,
    vertices: FloatArray,
    edges: IntArray,
    spacing: float,
    finer: tuple[RefinementBalls, ...],
    tolerance: float,
    seed: int,
    is_last: bool,
    report: Callable[[str], None],
) -> HarmonicFilling:
    """Mesh the level set of the function so that it ends at the boundary edges of a mesh; returns
    it as a filling.

    The level set is meshed in a Delaunay tetrahedralization that contains all boundary edges. Edges
    that are missing in it are halved first, and their midpoints are removed from the filling
    afterwards.

    function: the solid angle of the boundary edges, minus its level.
    vertices: (n, 3) of the mesh.
    edges: (k, 2) its boundary edges.
    spacing: the size of cells, a length.
    finer: sets of balls; a cell is halved once for each set with a ball that meets it.
    tolerance: a length.
    seed: the seed of the random moves of points.
    is_last: whether this is the last attempt; then a filling that cannot be refined to the
        tolerance is accepted.
    report: called with messages about the progress.

    Raises:
        MeshingError: no filling ends at the edges, or a check of the mesh fails. It is a
            TriangleLimitError if edges are cut into too many pieces.
    """
    # The vertices of the mesh at boundary edges become points 0, 1, ... of the curve.
    rim, rim_edges = np.unique(edges, return_inverse=True)
    boundary = BoundaryCurve(vertices[rim], rim_edges.reshape(-1, 2))
    extent: Any = function.field.extent((_LEVEL,))
    lower, upper = (np.array(end, np.float64) for end in extent.bounds())
    # Cells around all points in which the level set can lie.
    root = box_cells(lower - 0.5 * spacing, upper + 0.5 * spacing, spacing, exact=False)
    # `halved` lists the ends of the edges that are halved. (Below, None: there are no walls.)
    curve, halved = boundary, np.zeros((0, 2), np.int64)
    points = sample_delaunay_points(function, root, curve, None, seed, finer)
    tets = delaunay(points.points)
    for _ in range(_MAX_HALVINGS):
        lacks = ~tets.has_edges(curve.edges)
        if not lacks.any():
            break
        if len(curve.edges) > min(_MAX_PIECES, _MAX_PIECES_PER_EDGE * len(edges)):
            raise TriangleLimitError(
                f"{len(edges):,} boundary edges of the mesh lie on others or next to them: cut to "
                f"{len(curve.edges):,} pieces some are still too near to others for a patch that "
                "ends at them; join or remove the triangles there"
            )
        halved = np.concatenate([halved, curve.edges[lacks]])
        curve = curve.split(lacks)
        points = sample_delaunay_points(function, root, curve, None, seed, finer)
        tets = delaunay(points.points)
    lacks = ~tets.has_edges(curve.edges)
    if lacks.any():
        raise LocalizedMeshingError(
            f"{int(lacks.sum())} boundary edges of the mesh are too near to others for a patch "
            "that ends at them: subdivide the mesh there, or choose a smaller `cell_size`",
            curve.points[curve.edges[lacks]].mean(axis=1),
        )
    report(f"{len(points.points):,} points, {len(tets.corners):,} tetrahedra")
    x, faces = extract_triangles(function, points, tets, count_crossings(function, points, tets))
    # Midpoints are numbered in the order of the halvings; the last ones are removed first.
    for k, ends in reversed(list(enumerate(halved.tolist(), start=len(rim)))):
        faces = _collapse_midpoint(x, faces, k, ends)
    if not len(faces):
        raise LocalizedMeshingError(
            "no patch was found: choose a smaller `cell_size`", boundary.points
        )
    _check_boundary(x, faces, boundary)
    is_refined = True
    try:
        x, faces = _refine_patches(function, x, faces, tolerance, report)
    except LocalizedMeshingError:
        if not is_last or len(intersecting_faces(x, faces)):
            raise
        is_refined = False
    # Faces of level sets are seen from where w is greater, those of meshes from outside.
    faces = faces[:, ::-1]
    # Indices in the filled mesh: points of the curve are vertices of the mesh, the others are new.
    used = np.unique(faces)
    inner = used[used >= len(rim)]
    index = np.full(len(x), -1, np.int64)
    index[: len(rim)] = rim
    index[inner] = len(vertices) + np.arange(len(inner))
    return HarmonicFilling(x[inner], index[faces], is_refined, spacing, function.evaluations)


def _refine_patches(
    function: LevelFunction,
    x: FloatArray,
    faces: IntArray,
    tolerance: float,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Refine a filling until it is within the tolerance of the level set; returns its vertices and
    faces. Three ways are tried, and the first result that does not pass through itself is taken:
    smoothing, refining and improving; smoothing before and after refining; refining alone.

    function: f, whose level set {f = 0} is meshed.
    x, faces: (n, 3), (m, 3) the filling before refinement.
    tolerance: a length.
    report: called with messages about the progress.

    Raises:
        LocalizedMeshingError: all results pass through themselves, as small triangles do that turn
            over each other beside sharp corners of holes; or triangles do not come near the
            surface.
    """
    failed = x[:0]
    # (None: there are no walls.)
    for mode in ("improving", "smoothing", "refining alone"):
        report(mode)
        new_vertices, new_faces = (
            (x if mode == "refining alone" else smooth(function, x, faces, None)),
            faces,
        )
        new_vertices, new_faces = refine(
            function, new_vertices, new_faces, 0.5 * tolerance, None, report
        )
        far = unrefined_midpoints(function, new_vertices, new_faces, 0.5 * tolerance)
        if len(far):  # the patch departs from the surface, or connects two of its sheets
            raise LocalizedMeshingError(
                f"{len(far):,} triangles of patches do not come near the surface, however they are "
                "cut: subdivide the mesh there, or choose a smaller `cell_size`",
                far,
            )
        if mode == "improving":
            new_vertices, new_faces = improve(
                function, new_vertices, new_faces, 0.5 * tolerance, None, report
            )
        elif mode == "smoothing":
            new_vertices = smooth(function, new_vertices, new_faces, None)
        centers = new_vertices[new_faces[intersecting_faces(new_vertices, new_faces)]].mean(axis=1)
        failed = np.concatenate(
            [centers, new_vertices[_new_nonmanifold_vertices(faces, new_faces)]]
        )
        if not len(failed):
            return new_vertices, new_faces
    raise LocalizedMeshingError("the patches meet each other: choose a smaller `cell_size`", failed)


def _new_nonmanifold_vertices(before: IntArray, after: IntArray) -> IntArray:
    """Indices of the vertices at which the faces `before` are a manifold, but the faces `after` are
    not. (Where holes touch in a vertex, the faces are no manifold in the first place.)"""
    return np.setdiff1d(nonmanifold_vertices(after), nonmanifold_vertices(before))


def _collapse_midpoint(x: FloatArray, faces: IntArray, middle: int, ends: list[int]) -> IntArray:
    """Merge the vertex `middle`, which halves a boundary edge, with one end of that edge; returns
    the new faces. The end is chosen so that fewer faces intersect afterwards or, if the numbers are
    equal, so that the faces around the vertex turn less.

    x, faces: (n, 3), (m, 3) the filling.
    ends: the two vertices at the ends of the edge.

    Raises:
        LocalizedMeshingError: merging with either end would also join faces that are not at the
            edge.
    """
    is_at_middle = (faces == middle).any(axis=1)
    faces_at_middle, others = faces[is_at_middle], faces[~is_at_middle]
    # (number of intersecting faces, minus the smallest cosine of a turn, the new faces)
    candidates: list[tuple[int, float, IntArray]] = []
    for end in ends:
        at_end = (faces == end).any(axis=1)
        # The midpoint and the end may share three vertices: these two, and the third corner of the
        # face between them.
        if len(np.intersect1d(faces_at_middle, faces[at_end])) != 3:
            continue
        moved = np.where(faces_at_middle == middle, end, faces_at_middle)
        # The face between both vanishes.
        is_kept = ~(faces_at_middle == end).any(axis=1)
        before, after = _unit_normals(x[faces_at_middle[is_kept]]), _unit_normals(x[moved[is_kept]])
        cosine = float((before * after).sum(axis=1).min(initial=1.0))
        new_faces = np.concatenate([others, moved[is_kept]])
        is_moved = np.arange(len(new_faces)) >= len(others)
        candidates.append((len(intersecting_faces(x, new_faces, is_moved)), -cosine, new_faces))
    if not candidates:
        raise LocalizedMeshingError(
            "boundary edges of the mesh are too near to others for patches that end at them: "
            "subdivide the mesh there, or choose a smaller `cell_size`",
            x[[middle]],
        )
    # The new faces of the best candidate.
    return min(candidates, key=lambda candidate: candidate[:2])[2]


def _unit_normals(corners: FloatArray) -> FloatArray:
    """Unit normals of triangles (m, 3, 3), 0 for triangles without an area."""
    normal = area_normals(corners)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _check_boundary(x: FloatArray, faces: IntArray, boundary: BoundaryCurve) -> None:
    """Raise LocalizedMeshingError unless the boundary edges of a filling are the edges of the curve
    `boundary`, run in the same direction. (The filling is turned over afterwards, so that it runs
    each edge opposite to the face of the mesh.)

    x, faces: (n, 3), (m, 3) the filling.
    """
    directed = {(int(a), int(b)) for a, b in half_edges(faces)}
    open_edges = {(a, b) for a, b in directed if (b, a) not in directed}
    # Edges that are in one of the two sets only.
    unmatched = open_edges ^ {(int(a), int(b)) for a, b in boundary.edges}
    if unmatched:
        raise LocalizedMeshingError(
            "the patches do not end at the edges of the holes: cells are too large for them; "
            "choose a smaller `cell_size`",
            x[np.array(sorted(unmatched))].mean(axis=1),
        )


def _check_filled_mesh(
    vertices: FloatArray,
    faces: IntArray,
    patches: HarmonicFilling,
    report: Callable[[str], None],
) -> None:
    """Raise an error unless a mesh together with its filling passes three checks. They form a
    manifold. At the filling's vertices the winding number of the mesh is 1/2 modulo 1. And the
    filling intersects neither the mesh nor itself.

    vertices, faces: (n, 3), (m, 3) the mesh.
    patches: the filling.
    report: receives a message.

    Raises:
        LocalizedMeshingError: a check fails. It is a _MeshIntersectionError if the filling
            intersects the mesh.
    """
    report("checking the patches")
    x = np.concatenate([vertices, patches.vertices])
    together = np.concatenate([faces, patches.faces])
    try:
        check_manifold(together)
    except MeshingError as error:
        raise LocalizedMeshingError(str(error), x[nonmanifold_vertices(together)]) from None
    added = patches.vertices
    w = WindingNumber(vertices, faces).value(added, precision="double")
    gap = np.abs(w - np.floor(w) - 0.5)
    if not (gap <= _MAX_WINDING_ERROR).all():
        raise LocalizedMeshingError(
            f"the winding number is off 1/2 by {gap.max():.2g} at a vertex of the patches: choose "
            "a smaller `cell_size`",
            added[gap > _MAX_WINDING_ERROR],
        )
    is_patch = np.arange(len(together)) >= len(faces)
    met = intersecting_faces(x, together, is_patch)
    if not len(met):
        return
    centers = x[together[met[is_patch[met]]]].mean(axis=1)
    if is_patch[met].all():
        raise LocalizedMeshingError(
            "the patches meet each other: choose a smaller `cell_size`", centers
        )
    raise _MeshIntersectionError(
        f"the patches meet {int((~is_patch[met]).sum()):,} triangles of the mesh, where the "
        "winding number jumps: the hole cannot be closed by its 1/2 level alone; remove the "
        "triangles that stand in it, or draw the mesh with WindingNumber, which needs no repair",
        centers,
    )
