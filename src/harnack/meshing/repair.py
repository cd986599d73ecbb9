"""Repair of triangle meshes: patches over holes; the triangles that are there stay as they are.

The 1/2 level of the winding number w modulo 1 is the 2 pi level of the solid angle of the boundary
edges (`geometry.chains`), a smooth surface that ends at them. It is meshed with these very edges in
it, and joined to the mesh by index.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry import MeshError, validate_mesh
from harnack.geometry.chains import singular_loops, weld_vertices
from harnack.geometry.meshes import without_zero_area_faces
from harnack.meshing.checks import (
    LocalError,
    MeshingError,
    TooLargeError,
    check_manifold,
    euler_characteristic,
    intersecting_faces,
    singular_vertices,
)
from harnack.meshing.edges import Edges, IntArray, directed_edges
from harnack.meshing.marching_tetrahedra import crossings_of, delaunay, triangles_of
from harnack.meshing.mesh import mesh as mesh_of
from harnack.meshing.points import Boundary, Places, box_cells, place_points
from harnack.meshing.refinement import far_places, improved, refined, smoothed
from harnack.meshing.samples import LevelFunction

if TYPE_CHECKING:
    import trimesh

    from harnack.backend import FloatArray

__all__ = ["repair"]

_LEVEL = 2 * math.pi
# Cells across the holes at first, and how often they are made smaller where that fails.
_ACROSS = 24
_ATTEMPTS = 6
# How often if all may be made anew instead; and cells across the mesh then.
_FEW_ATTEMPTS = 3
# Meshes with more open edges than that, or than this part of their faces, are made anew at once.
_MOST_OPEN, _MOST_OPEN_PART = 4000, 0.5
_ACROSS_ANEW = 48
# How often edges of holes that are too near to others are halved for the tetrahedra.
_MOST_CUTS = 12
# How often patches that meet the mesh are made again, of smaller cells.
_MOST_MET = 1
# How far w may be from 1/2, modulo 1, at vertices of patches.
_NEAR = 1e-6


Keep = Literal["all", "none"]


def repair(
    mesh: trimesh.Trimesh,
    *,
    keep: Keep | None = None,
    largest: bool = False,
    tolerance: float = 1e-3,
    spacing: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> trimesh.Trimesh:
    """A closed mesh of a damaged one: with patches over its holes, or made anew.

    Patches are where the winding number w of the mesh is 1/2 modulo 1, and the triangles that are
    there stay. If that cannot be meshed, for which holes at one corner are the usual reason, holes
    of three edges get their triangle, where it passes through no other, and patches are those of
    the mesh with them. Where that fails too, or the mesh is none with two sides (edges of more than
    two faces, faces turned over, loose triangles), the surface w = 1/2 is made anew by the signs of
    w - 1/2 in cells (`meshing.by_signs`): closed whatever the mesh is.

    mesh: anything with `vertices` (n, 3) and `faces` (m, 3); faces without an area are left out.
    keep: None keeps all triangles if possible, and else makes all anew; "all" raises an error where
        that is not possible; "none" makes all anew.
    largest: of what is made anew keep the part of the largest volume alone, with its cavities.
    tolerance: how far triangles may be from the surface, sampled and not proved, as a part of the
        size of the box around all holes, or of the mesh if all is made anew; but for triangles
        between three edges of holes, which stay as they are.
    spacing: of cells before anything is refined, in the mesh's unit; None chooses.
    seed: of the small random moves that keep points in general position.
    progress: told what is being done.

    Returns:
        A closed trimesh.Trimesh: every edge has two faces, which agree. `metadata["harnack"]` has
        stage: "kept" or "anew"; and why (None, or what the other stage failed with).

        If all was kept, the first vertices and faces are those given, bit by bit and in their
        order; vertices inside of patches and their faces follow, and no patch meets another
        triangle but at the edges and corners that they share. Then there are also holes (loops of
        edges that were open), patches (triangles added), missing (how many of these are the
        triangles of holes of three edges), refined (whether they are within the tolerance: they
        stay as the cells cut them if finer ones would pass through each other, however small cells
        are made there), spacing, evaluations and the Euler characteristic. A closed mesh gets
        nothing added.

        If all was made anew, no triangles pass through each other, and there is what `mesh` says of
        meshes by signs, such as far and within; kept is 0.

    Raises:
        MeshError: a ValueError, for a mesh that has no triangles, or numbers that are none; with
            keep="all" also for one that is not as said above.
        MeshingError: a ValueError, with keep="all", if the patches could not be made, or meet the
            mesh or each other; if the surface w = 1/2 is empty, as for faces turned inwards, or
            takes too many cells.
    """
    report = progress or _silent
    if keep is not None and keep not in ("all", "none"):
        raise ValueError(f'keep is None, "all" or "none", not {keep!r}')
    if not 0 < tolerance < 0.5:
        raise ValueError(
            f"tolerance is a part of the size: it must lie in (0, 0.5), not {tolerance}"
        )
    if spacing is not None and not 0 < spacing < math.inf:
        raise ValueError(f"spacing must be a positive length, not {spacing!r}")
    if keep == "none":
        return _anew(mesh, None, tolerance, spacing, largest, report)
    try:
        attempts = _ATTEMPTS if keep == "all" else _FEW_ATTEMPTS
        return _kept(mesh, tolerance, spacing, seed, attempts, report)
    except (MeshError, MeshingError) as error:
        if keep == "all":
            raise
        report(f"{error}; so all is made anew")
        return _anew(mesh, str(error), tolerance, spacing, largest, report)


def _anew(
    mesh: Any,
    why: str | None,
    tolerance: float,
    spacing: float | None,
    largest: bool,
    report: Callable[[str], None],
) -> trimesh.Trimesh:
    """The surface on which the winding number is 1/2, closed whatever the mesh is."""
    _check_is_mesh(mesh)
    corners = without_zero_area_faces(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    field = WindingNumber(*corners)
    if spacing is None:
        spacing = float(np.ptp(corners[0], axis=0).max()) / _ACROSS_ANEW
    made = mesh_of(
        field, solid=(0.5, math.inf), tolerance=tolerance, spacing=spacing, largest=largest,
        progress=report,
    )  # fmt: skip
    made.metadata["harnack"] |= {"stage": "anew", "kept": 0, "why": why}
    return made


def _kept(
    mesh: Any,
    tolerance: float,
    spacing: float | None,
    seed: int,
    attempts: int,
    report: Callable[[str], None],
) -> trimesh.Trimesh:
    """The mesh with patches; all its triangles stay.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = _checked(mesh)
    edges = _open_edges(faces)
    if not len(edges):
        nothing = _Patches(vertices[:0], faces[:0], True, 0.0, 0)
        return _joined(vertices, faces, nothing, len(faces))
    if attempts < _ATTEMPTS and len(edges) > min(_MOST_OPEN, _MOST_OPEN_PART * len(faces)):
        raise MeshError(
            f"{len(edges):,} edges of {len(faces):,} faces are open, too many for patches that all "
            'end there, unless keep="all" asks for them'
        )
    asked = _Asked(len(faces), tolerance, spacing, seed, attempts, report)
    try:
        return _repaired(vertices, faces, edges, asked)
    except MeshingError as error:
        missing = _missing_triangles(vertices, faces, edges)
        if not len(missing):
            raise
        first = error
    report(f"once more, with triangles in {len(missing):,} holes of three edges")
    together = np.concatenate([faces, missing])
    try:
        return _repaired(vertices, together, _open_edges(together), asked)
    except MeshingError as error:
        raise MeshingError(
            f"{first}; and with triangles in {len(missing):,} holes of three edges: {error}"
        ) from error


@dataclass(frozen=True)
class _Asked:
    """The arguments of `repair`. given: how many faces there were. attempts: how many sizes of
    cells are tried."""

    given: int
    tolerance: float
    spacing: float | None
    seed: int
    attempts: int
    report: Callable[[str], None]


def _repaired(
    vertices: FloatArray, faces: IntArray, edges: IntArray, asked: _Asked
) -> trimesh.Trimesh:
    """The mesh with patches that end at its open edges; cells are made smaller where checks fail.

    Raises:
        MeshingError: as `repair`.
    """
    if not len(edges):
        nothing = _Patches(vertices[:0], faces[:0], True, 0.0, 0)
        return _joined(vertices, faces, nothing, asked.given)
    loops = singular_loops(edges, np.ones(len(edges), np.int64))
    function = LevelFunction(SolidAngle([vertices[loop] for loop in loops]), _LEVEL)
    size = float(np.ptp(vertices[np.unique(edges)], axis=0).max())
    cell = size / _ACROSS if asked.spacing is None else float(asked.spacing)
    report, tolerance = asked.report, asked.tolerance * size
    finer: tuple[Places, ...] = ()
    times_met, seed = 0, asked.seed
    for attempt in range(asked.attempts):
        last = attempt == asked.attempts - 1
        report(f"cells of {cell:.3g}" + ", smaller in places" * bool(finer))
        try:
            patches = _patches(
                function, vertices, edges, cell, finer, tolerance, seed, last, report
            )
            result = _joined(vertices, faces, patches, asked.given)
            _check(vertices, faces, result, report)
        except LocalError as error:
            times_met += isinstance(error, _MetError)
            if last or times_met > _MOST_MET:
                place = ", ".join(f"{c:.4g}" for c in error.places[0])
                raise MeshingError(
                    f"{error} (cells were {cell:.3g} wide, and smaller in {len(error.places)} "
                    f"places, such as near ({place}))"
                ) from None
            report(f"{error} ({len(error.places)} places)")
            finer = (*finer, Places(error.places, 2 * cell * 0.5 ** len(finer)))
        except TooLargeError:
            raise
        except MeshingError as error:  # a point lies where the function is too inaccurate
            if last:
                raise
            report(f"{error}; once more, with points moved at random in another way")
            seed += 1
        else:
            return result
    raise AssertionError("unreachable: the last attempt returns or raises")


class _MetError(LocalError):
    """Patches intersect the mesh."""


@dataclass(frozen=True)
class _Patches:
    """What is added.

    vertices: (k, 3).
    faces: (p, 3); indices below the number of given vertices are of these.
    is_fine: whether they were refined to the tolerance.
    """

    vertices: FloatArray
    faces: IntArray
    is_fine: bool
    spacing: float
    evaluations: int


def _silent(text: str) -> None:
    """Reports nothing."""


def _check_is_mesh(mesh: Any) -> None:
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise TypeError(
            f"repair takes a mesh with vertices and faces, such as a trimesh.Trimesh, not "
            f"{type(mesh).__name__}"
        )


def _checked(mesh: Any) -> tuple[FloatArray, IntArray]:
    """Vertices and faces of a mesh that can be repaired."""
    _check_is_mesh(mesh)
    vertices, faces = validate_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    used = np.unique(faces)
    welded = weld_vertices(vertices[used])
    twice = np.flatnonzero(welded != np.arange(len(used)))
    if len(twice):
        raise MeshError(
            f"vertices {used[welded[twice[0]]]} and {used[twice[0]]} are at the same place, and "
            f"{len(twice):,} in all: join such vertices first, for instance by "
            "mesh.merge_vertices() of trimesh, or faces are not known to be neighbors"
        )
    return vertices, faces


def _open_edges(faces: IntArray) -> IntArray:
    """(k, 2): edges of one face, in its direction.

    Raises:
        MeshError: an edge of more than two faces, or of two that have it in the same direction.
    """
    pairs = directed_edges(faces)
    edges = Edges.of(pairs)
    index, uses = edges.index, edges.uses
    several = np.flatnonzero(uses > 2)
    if len(several):
        a, b = edges.ends[several[0]].tolist()
        raise MeshError(
            f"{len(several):,} edges have more than two faces, the first of them between vertices "
            f"{a} and {b}: such a mesh has no two sides there; remove faces, or draw it with "
            "WindingNumber, which needs no repair"
        )
    sign = np.bincount(index, np.where(pairs[:, 0] < pairs[:, 1], 1, -1), minlength=len(uses))
    turned = np.flatnonzero((uses == 2) & (sign != 0))
    if len(turned):
        a, b = edges.ends[turned[0]].tolist()
        raise MeshError(
            f"the faces at {len(turned):,} edges do not agree which side is outside, the first of "
            f"them between vertices {a} and {b}: reverse some faces, for instance by "
            "trimesh.repair.fix_winding(mesh)"
        )
    return pairs[uses[index] == 1]


def _missing_triangles(vertices: FloatArray, faces: IntArray, edges: IntArray) -> IntArray:
    """The triangles (k, 3) that holes of three edges lack, where these pass through no others.

    edges: (n, 2) open ones, as the faces run them.
    """
    leads: dict[int, set[int]] = defaultdict(set)
    for a, b in edges.tolist():
        leads[a].add(b)
    there = {tuple(sorted(face)) for face in faces.tolist()}
    found: list[tuple[int, int, int]] = []
    for a, b in edges.tolist():
        for c in leads[b]:
            if a in leads[c] and tuple(sorted((a, b, c))) not in there and b in leads[a]:
                found.append((a, c, b))
                for one, other in ((a, b), (b, c), (c, a)):
                    leads[one].discard(other)
                break
    made = np.array(found, np.int64).reshape(-1, 3)
    corners = vertices[made]
    made = made[np.linalg.norm(_normals(corners), axis=1) > 0]
    together = np.concatenate([faces, made])
    is_made = np.arange(len(together)) >= len(faces)
    met = np.setdiff1d(intersecting_faces(vertices, together, is_made), np.arange(len(faces)))
    return np.delete(made, met - len(faces), axis=0)


def _patches(
    function: LevelFunction,
    vertices: FloatArray,
    edges: IntArray,
    spacing: float,
    finer: tuple[Places, ...],
    tolerance: float,
    seed: int,
    last: bool,
    report: Callable[[str], None],
) -> _Patches:
    """The level set, ending at the edges (k, 2) of the mesh.

    last: whether patches that cannot be refined will do.

    Raises:
        MeshingError: as `mesh`; or Delaunay's tetrahedra lack an edge.
    """
    rim, place = np.unique(edges, return_inverse=True)
    boundary = Boundary(vertices[rim], place.reshape(-1, 2))
    hull: Any = function.field.extent((_LEVEL,))
    lower, upper = (np.array(end, np.float64) for end in hull.bounds())
    root = box_cells(lower - 0.5 * spacing, upper + 0.5 * spacing, spacing, exact=False)
    cut, middles = boundary, np.zeros((0, 2), np.int64)
    points = place_points(function, root, cut, None, seed, finer)
    tets = delaunay(points.points)
    for _ in range(_MOST_CUTS):
        lacks = ~tets.has_edges(cut.edges)
        if not lacks.any():
            break
        middles = np.concatenate([middles, cut.edges[lacks]])
        cut = cut.split(lacks)
        points = place_points(function, root, cut, None, seed, finer)
        tets = delaunay(points.points)
    lacks = ~tets.has_edges(cut.edges)
    if lacks.any():
        raise LocalError(
            f"{int(lacks.sum())} boundary edges of the mesh are too near to others for a patch "
            "that ends at them: subdivide the mesh there, or choose a smaller `spacing`",
            cut.points[cut.edges[lacks]].mean(axis=1),
        )
    report(f"{len(points.points):,} points, {len(tets.corners):,} tetrahedra")
    x, faces = triangles_of(function, points, tets, crossings_of(function, points, tets))
    for k, ends in reversed(list(enumerate(middles.tolist(), start=len(rim)))):
        faces = _collapsed(x, faces, k, ends)
    if not len(faces):
        raise LocalError("no patch was found: choose a smaller `spacing`", boundary.points)
    _check_boundary(x, faces, boundary)
    is_fine = True
    try:
        x, faces = _finished(function, x, faces, tolerance, report)
    except LocalError:
        if not last or len(intersecting_faces(x, faces)):
            raise
        is_fine = False
    # Faces of level sets are seen from where w is greater, those of meshes from outside.
    faces = faces[:, ::-1]
    kept = np.unique(faces)
    inner = kept[kept >= len(rim)]
    index = np.full(len(x), -1, np.int64)
    index[: len(rim)] = rim
    index[inner] = len(vertices) + np.arange(len(inner))
    return _Patches(x[inner], index[faces], is_fine, spacing, function.evaluations)


def _finished(
    function: LevelFunction,
    x: FloatArray,
    faces: IntArray,
    tolerance: float,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Vertices and faces of patches refined to the tolerance: smoothed and improved, or only
    smoothed, or as they are, whichever first does not pass through itself.

    Raises:
        MeshingError: all do, as small triangles turn over each other beside sharp corners of holes.
    """
    bad = x[:0]
    for way in ("improving", "smoothing", "refining alone"):
        report(way)
        finer, split = (x if way == "refining alone" else smoothed(function, x, faces, None)), faces
        finer, split = refined(function, finer, split, 0.5 * tolerance, None, report)
        far = far_places(function, finer, split, 0.5 * tolerance)
        if len(far):  # the patch takes another way than the surface, or connects two of its sheets
            raise LocalError(
                f"{len(far):,} triangles of patches do not come near the surface, however they are "
                "cut: subdivide the mesh there, or choose a smaller `spacing`",
                far,
            )
        if way == "improving":
            finer, split = improved(function, finer, split, 0.5 * tolerance, None, report)
        elif way == "smoothing":
            finer = smoothed(function, finer, split, None)
        met = finer[split[intersecting_faces(finer, split)]].mean(axis=1)
        bad = np.concatenate([met, finer[_new_singular(faces, split)]])
        if not len(bad):
            return finer, split
    raise LocalError("the patches meet each other: choose a smaller `spacing`", bad)


def _new_singular(before: IntArray, after: IntArray) -> IntArray:
    """Vertices at which faces are not a manifold any more; holes may touch in others."""
    return np.setdiff1d(singular_vertices(after), singular_vertices(before))


def _collapsed(x: FloatArray, faces: IntArray, middle: int, ends: list[int]) -> IntArray:
    """The faces with a vertex in the middle of a boundary edge moved to one of its ends: that with
    which fewer faces meet or, if they are as many, the faces around it are turned less.

    Raises:
        MeshingError: both ends would join more than the two faces at the edge.
    """
    around = (faces == middle).any(axis=1)
    star, rest = faces[around], faces[~around]
    found: list[tuple[int, float, IntArray]] = []
    for end in ends:
        joined = (faces == end).any(axis=1)
        if len(np.intersect1d(star, faces[joined])) != 3:  # these two, and the face's third corner
            continue
        moved = np.where(star == middle, end, star)
        kept = ~(star == end).any(axis=1)
        one, other = _normals(x[star[kept]]), _normals(x[moved[kept]])
        turned = float((one * other).sum(axis=1).min(initial=1.0))
        made = np.concatenate([rest, moved[kept]])
        is_moved = np.arange(len(made)) >= len(rest)
        found.append((len(intersecting_faces(x, made, is_moved)), -turned, made))
    if not found:
        raise LocalError(
            "boundary edges of the mesh are too near to others for patches that end at them: "
            "subdivide the mesh there, or choose a smaller `spacing`",
            x[[middle]],
        )
    return min(found, key=lambda one: one[:2])[2]


def _normals(corners: FloatArray) -> FloatArray:
    """Unit normals of triangles (m, 3, 3), 0 of those without an area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _check_boundary(x: FloatArray, faces: IntArray, boundary: Boundary) -> None:
    """Raise unless patches end at the boundary, and run each of its edges as the mesh does: they
    are reversed afterwards."""
    directed = {(int(a), int(b)) for a, b in directed_edges(faces)}
    rim = {(a, b) for a, b in directed if (b, a) not in directed}
    wrong = rim ^ {(int(a), int(b)) for a, b in boundary.edges}
    if wrong:
        raise LocalError(
            "the patches do not end at the edges of the holes: cells are too large for them; "
            "choose a smaller `spacing`",
            x[np.array(sorted(wrong))].mean(axis=1),
        )


def _joined(
    vertices: FloatArray, faces: IntArray, patches: _Patches, given: int
) -> trimesh.Trimesh:
    """The mesh and its patches. given: how many of the faces were there before."""
    from harnack.meshing.closed_mesh import ClosedMesh

    edges = _open_edges(faces[:given])
    together = np.concatenate([faces, patches.faces])
    result = ClosedMesh(
        np.concatenate([vertices, patches.vertices]), together, process=False, validate=False
    )
    result.metadata["harnack"] = {
        "stage": "kept",
        "kept": given,
        "why": None,
        "holes": len(singular_loops(edges, np.ones(len(edges), np.int64))) if len(edges) else 0,
        "patches": len(together) - given,
        "missing": len(faces) - given,
        "refined": patches.is_fine,
        "spacing": patches.spacing,
        "evaluations": patches.evaluations,
        "euler_characteristic": euler_characteristic(together),
    }
    return result


def _check(
    vertices: FloatArray, faces: IntArray, result: Any, report: Callable[[str], None]
) -> None:
    """Raise unless the result is what `repair` promises.

    Raises:
        MeshingError: it is not.
    """
    report("checking the patches")
    x = np.asarray(result.vertices, np.float64)
    together = np.asarray(result.faces, np.int64)
    try:
        check_manifold(together)
    except MeshingError as error:
        raise LocalError(str(error), x[singular_vertices(together)]) from None
    added = x[len(vertices) :]
    w = WindingNumber(vertices, faces).value(added, precision="double")
    off = np.abs(w - np.floor(w) - 0.5)
    if not (off <= _NEAR).all():
        raise LocalError(
            f"the winding number is off 1/2 by {off.max():.2g} at a vertex of the patches: choose "
            "a smaller `spacing`",
            added[off > _NEAR],
        )
    is_patch = np.arange(len(together)) >= len(faces)
    met = intersecting_faces(x, together, is_patch)
    if not len(met):
        return
    places = x[together[met[is_patch[met]]]].mean(axis=1)
    if is_patch[met].all():
        raise LocalError("the patches meet each other: choose a smaller `spacing`", places)
    raise _MetError(
        f"the patches meet {int((~is_patch[met]).sum()):,} triangles of the mesh, where the "
        "winding number jumps: the hole cannot be closed by its 1/2 level alone; remove the "
        "triangles that stand in it, or draw the mesh with WindingNumber, which needs no repair",
        places,
    )
