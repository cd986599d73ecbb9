"""Repair of triangle meshes: patches over holes, the triangles that there are kept as they are.

The 1/2 level of the winding number w modulo 1 is the 2 pi level of the solid angle of the boundary
edges (`geometry.singular`), a smooth surface that ends at them. It is meshed with these very edges
in it, and joined to the mesh by index.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.fields import SolidAngle, WindingNumber
from harnack.geometry import MeshError, validate_mesh
from harnack.geometry.singular import singular_loops, weld_vertices
from harnack.meshing.checks import MeshingError, check_manifold, euler_characteristic
from harnack.meshing.crossed import edges_through
from harnack.meshing.edges import Edges, IntArray, directed_edges
from harnack.meshing.marching import crossings_of, triangles_of
from harnack.meshing.points import Boundary, box_cells, place_points
from harnack.meshing.refining.refinement import refined, smoothed
from harnack.meshing.samples import LevelFunction
from harnack.meshing.tetrahedra import delaunay

if TYPE_CHECKING:
    import trimesh

    from harnack.backend import FloatArray

__all__ = ["repair"]

_LEVEL = 2 * math.pi
# Cells across the patches at first, and how often they are made smaller where that fails.
_ACROSS = 24
_ATTEMPTS = 5
# How often edges of holes that are too near to others are halved for the tetrahedra.
_MOST_CUTS = 5
# How far w may be from 1/2, modulo 1, at vertices of patches.
_NEAR = 1e-6


def repair(
    mesh: trimesh.Trimesh,
    *,
    tolerance: float = 1e-3,
    spacing: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> trimesh.Trimesh:
    """The mesh with patches over its holes, where its winding number is 1/2 modulo 1.

    mesh: anything with `vertices` (n, 3) and `faces` (m, 3): every edge has one or two faces, which
        agree on its two sides.
    tolerance: how far triangles of the patches may be from the surface, as a part of the size of
        the patches' box, sampled and not proved. Where triangles so small would pass through each
        other, at sharp corners of holes, patches stay coarser.
    spacing: of cells before anything is refined, in the mesh's unit; None chooses.
    seed: of the small random moves that keep points in general position.
    progress: told what is being done.

    Returns:
        A trimesh.Trimesh whose first vertices and faces are those given, bit by bit and in their
        order; vertices inside of patches and their faces follow. Every edge has two faces, which
        agree, and no patch meets another triangle but at the edges and corners that they share.
        `metadata["harnack"]` has holes (loops of edges that were open), patches (triangles added),
        spacing, evaluations and the Euler characteristic. A closed mesh gets nothing added.

    Raises:
        MeshError: a ValueError, for a mesh that is not as said above; the message says where.
        MeshingError: a ValueError, if the patches could not be made, or meet the mesh or each
            other.
    """
    report = progress or _silent
    if not 0 < tolerance < 0.5:
        raise ValueError(
            f"tolerance is a part of the size: it must lie in (0, 0.5), not {tolerance}"
        )
    if spacing is not None and not 0 < spacing < math.inf:
        raise ValueError(f"spacing must be a positive length, not {spacing!r}")
    vertices, faces = _checked(mesh)
    edges = _open_edges(faces)
    if not len(edges):
        return _joined(vertices, faces, _Patches(vertices[:0], faces[:0], 0.0, 0), 0)
    loops = singular_loops(edges, np.ones(len(edges), np.int64))
    field = SolidAngle([vertices[loop] for loop in loops])
    function = LevelFunction(field, _LEVEL)
    hull: Any = field.extent((_LEVEL,))
    lower, upper = (np.array(end, np.float64) for end in hull.bounds())
    size = float((upper - lower).max())
    cell = size / _ACROSS if spacing is None else float(spacing)
    for attempt in range(_ATTEMPTS if spacing is None else 1):
        report(f"cells of {cell:.3g}")
        try:
            patches = _patches(
                function, vertices, edges, (lower, upper), cell, tolerance * size, seed, report
            )
            result = _joined(vertices, faces, patches, len(loops))
            _check(vertices, faces, result, report)
        except MeshingError:
            if spacing is not None or attempt == _ATTEMPTS - 1:
                raise
            cell *= 0.6
        else:
            return result
    raise AssertionError("unreachable: the last attempt returns or raises")


@dataclass(frozen=True)
class _Patches:
    """What is added: vertices (k, 3), and faces (p, 3) whose indices below the number of vertices
    given are of these."""

    vertices: FloatArray
    faces: IntArray
    spacing: float
    evaluations: int


def _silent(text: str) -> None:
    """Tells nobody."""


def _checked(mesh: Any) -> tuple[FloatArray, IntArray]:
    """Vertices and faces of a mesh that can be repaired."""
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise TypeError(
            f"repair takes a mesh with vertices and faces, such as a trimesh.Trimesh, not "
            f"{type(mesh).__name__}"
        )
    vertices, faces = validate_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    used = np.unique(faces)
    welded = weld_vertices(vertices[used])
    twice = np.flatnonzero(welded != np.arange(len(used)))
    if len(twice):
        raise MeshError(
            f"vertices {used[welded[twice[0]]]} and {used[twice[0]]} are at the same place, and "
            f"{len(twice):,} in all: join such vertices first, for instance by "
            "mesh.merge_vertices() of trimesh, or faces are not known to be neighbours"
        )
    return vertices, faces


def _open_edges(faces: IntArray) -> IntArray:
    """(k, 2): edges of one face, as it runs them.

    Raises:
        MeshError: an edge of more than two faces, or of two that run it the same way.
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


def _patches(
    function: LevelFunction,
    vertices: FloatArray,
    edges: IntArray,
    box: tuple[FloatArray, FloatArray],
    spacing: float,
    tolerance: float,
    seed: int,
    report: Callable[[str], None],
) -> _Patches:
    """The level set, ending at the edges (k, 2) of the mesh.

    Raises:
        MeshingError: as `mesh`; or Delaunay's tetrahedra lack an edge.
    """
    rim, place = np.unique(edges, return_inverse=True)
    boundary = Boundary(vertices[rim], place.reshape(-1, 2))
    root = box_cells(box[0] - 0.5 * spacing, box[1] + 0.5 * spacing, spacing, exact=False)
    cut, middles = boundary, np.zeros((0, 2), np.int64)
    points = place_points(function, root, cut, None, seed)
    tets = delaunay(points.points)
    for _ in range(_MOST_CUTS):
        lacks = ~tets.has_edges(cut.edges)
        if not lacks.any():
            break
        middles = np.concatenate([middles, cut.edges[lacks]])
        cut = cut.split(lacks)
        points = place_points(function, root, cut, None, seed)
        tets = delaunay(points.points)
    if lacking := int((~tets.has_edges(cut.edges)).sum()):
        raise MeshingError(
            f"{lacking} boundary edges of the mesh are too near to others for a patch that ends at "
            "them: subdivide the mesh there, or choose a smaller `spacing`"
        )
    report(f"{len(points.points):,} points, {len(tets.corners):,} tetrahedra")
    x, faces = triangles_of(function, points, tets, crossings_of(function, points, tets))
    for k, ends in reversed(list(enumerate(middles.tolist(), start=len(rim)))):
        faces = _collapsed(x, faces, k, ends)
    if not len(faces):
        raise MeshingError("no patch was found: choose a smaller `spacing`")
    _check_rim(faces, boundary)
    x, faces = _finished(function, x, faces, tolerance, report)
    # Faces of level sets are seen from where w is greater, those of meshes from outside.
    faces = faces[:, ::-1]
    kept = np.unique(faces)
    inner = kept[kept >= len(rim)]
    index = np.full(len(x), -1, np.int64)
    index[: len(rim)] = rim
    index[inner] = len(vertices) + np.arange(len(inner))
    return _Patches(x[inner], index[faces], spacing, function.evaluations)


def _finished(
    function: LevelFunction,
    x: FloatArray,
    faces: IntArray,
    tolerance: float,
    report: Callable[[str], None],
) -> tuple[FloatArray, IntArray]:
    """Patches refined and smoothed; where they would pass through themselves, which happens at
    sharp corners of holes, refined alone, or as the tetrahedra cut them."""
    even = smoothed(function, x, faces, None)
    finer, split = refined(function, even, faces, 0.5 * tolerance, None, report)
    finer = smoothed(function, finer, split, None)
    if not edges_through(finer, split, split):
        return finer, split
    report("refining again, without smoothing")
    finer, split = refined(function, x, faces, 0.5 * tolerance, None, report)
    return (x, faces) if edges_through(finer, split, split) else (finer, split)


def _collapsed(x: FloatArray, faces: IntArray, middle: int, ends: list[int]) -> IntArray:
    """The faces with a vertex in the middle of a boundary edge moved to one of its ends: that which
    turns the faces around it less.

    Raises:
        MeshingError: both ends would join more than the two faces at the edge.
    """
    around = (faces == middle).any(axis=1)
    star = faces[around]
    best = -np.inf, star
    for end in ends:
        joined = (faces == end).any(axis=1)
        if len(np.intersect1d(star, faces[joined])) != 3:  # these two, and the face's third corner
            continue
        moved = np.where(star == middle, end, star)
        kept = ~(star == end).any(axis=1)
        one, other = _normals(x[star[kept]]), _normals(x[moved[kept]])
        worst = float((one * other).sum(axis=1).min(initial=1.0))
        if worst > best[0]:
            best = worst, moved[kept]
    if best[0] == -np.inf:
        raise MeshingError(
            "boundary edges of the mesh are too near to others for patches that end at them: "
            "subdivide the mesh there, or choose a smaller `spacing`"
        )
    return np.concatenate([faces[~around], best[1]])


def _normals(corners: FloatArray) -> FloatArray:
    """Unit normals of triangles (m, 3, 3), 0 of those without an area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _check_rim(faces: IntArray, boundary: Boundary) -> None:
    """Raise unless patches end at the boundary, and run each of its edges as the mesh does: they
    are reversed afterwards."""
    directed = {(int(a), int(b)) for a, b in directed_edges(faces)}
    rim = {(a, b) for a, b in directed if (b, a) not in directed}
    if rim != {(int(a), int(b)) for a, b in boundary.edges}:
        raise MeshingError(
            "the patches do not end at the edges of the holes: cells are too large for them; "
            "choose a smaller `spacing`"
        )


def _joined(
    vertices: FloatArray, faces: IntArray, patches: _Patches, holes: int
) -> trimesh.Trimesh:
    """The mesh and its patches."""
    import trimesh

    together = np.concatenate([faces, patches.faces])
    result = trimesh.Trimesh(
        np.concatenate([vertices, patches.vertices]), together, process=False, validate=False
    )
    result.metadata["harnack"] = {
        "holes": holes,
        "patches": len(patches.faces),
        "spacing": patches.spacing,
        "evaluations": patches.evaluations,
        "euler_characteristic": euler_characteristic(together),
    }
    return result


def _check(
    vertices: FloatArray, faces: IntArray, result: Any, report: Callable[[str], None]
) -> None:
    """What is promised of the result.

    Raises:
        MeshingError: it does not hold.
    """
    report("checking the patches")
    x = np.asarray(result.vertices, np.float64)
    together = np.asarray(result.faces, np.int64)
    patches = together[len(faces) :]
    check_manifold(together)
    w = WindingNumber(vertices, faces).value(x[len(vertices) :], precision="double")
    off = np.abs(w - np.floor(w) - 0.5)
    if not (off <= _NEAR).all():
        raise MeshingError(
            f"the winding number is off 1/2 by {off.max():.2g} at a vertex of the patches: choose "
            "a smaller `spacing`"
        )
    met = edges_through(x, patches, faces) | edges_through(x, faces, patches)
    if met:
        raise MeshingError(
            f"the patches meet triangles of the mesh in {met:,} places, where the winding number "
            "jumps: the hole cannot be closed by its 1/2 level alone; remove the triangles that "
            "stand in it, or draw the mesh with WindingNumber, which needs no repair"
        )
    if edges_through(x, patches, patches):
        raise MeshingError("the patches meet each other: choose a smaller `spacing`")
