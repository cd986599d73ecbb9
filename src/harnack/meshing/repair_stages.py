"""Repairs triangle meshes: computes a closed mesh from a damaged one, and keeps its valid triangles
where possible.

Stages are tried in turn, from the one that keeps most to the one that always gives a result: all
triangles stay and holes are filled; bodies that overlap are united (`bodies`; for a surface that
passes through itself, pieces of its faces, `joined_pieces`); only valid triangles stay
(`mesh_cleaning`); corners of loose triangles are merged; everything is remeshed from signs, on the
surface where the winding number is 1/2.

A result is not accepted for being closed: each is compared with the winding number of the input
(`intended_solid`). Smooth hole fillings have minimal bending (`hole_filling`), and nothing is
proved of them but that they intersect nothing; those on which w = 1/2 (`harmonic_filling`) have a
proof, and a dent where the surface was round.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harnack.backend.validation import flag
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.geometry import MeshError, validate_mesh, zero_area_faces
from harnack.geometry.boundary_edges import singular_edges, weld_vertices
from harnack.geometry.meshes import without_zero_area_faces
from harnack.geometry.orientability import is_nonorientable
from harnack.meshing.bodies import mended_by_cuts, united_parts
from harnack.meshing.checks import (
    MeshingError,
    TriangleLimitError,
    euler_characteristic,
    intersecting_faces,
    nonmanifold_vertices,
)
from harnack.meshing.clipping import Shells, component_facts, largest_body
from harnack.meshing.edges import IntArray
from harnack.meshing.finishing import check_options
from harnack.meshing.harmonic_filling import (
    HarmonicFilling,
    HoleFillingOptions,
    checked_boundary_edges,
    harmonic_patches,
)
from harnack.meshing.hole_filling import fill_holes, hole_loops
from harnack.meshing.intended_solid import Difference, IntendedSolid
from harnack.meshing.joined_pieces import passes_itself
from harnack.meshing.lattice_meshing import TriangleMesh
from harnack.meshing.mesh_cleaning import CleanedMesh, clean_and_fill, weld_near_corners
from harnack.meshing.mesh_pipeline import mesh as mesh_of
from harnack.meshing.mesh_tolerance import MeshTolerance
from harnack.name_suggestions import is_one_of
from harnack.progress import teller
from harnack.tracer.trace_options import trace_options

if TYPE_CHECKING:
    import trimesh

    from harnack.backend import FloatArray
    from harnack.tracer import TraceOptions

__all__ = ["repair"]

# The number of cell sizes that are tried for harmonic hole fillings: if all triangles have to stay,
# and else. In the latter case there may be no more open edges than the last number.
_MAX_ATTEMPTS, _FEW_ATTEMPTS, _FEW_EDGES = 6, 1, 1000
# The number of cells along the longest side of a mesh that is remeshed. If the surface is rough and
# would have more than _MAX_REMESHED_FACES triangles, cells are made larger by the factor
# _CELL_GROWTH, up to _MAX_CELL_GROWTHS times.
_REMESH_CELLS_ACROSS = 48
_MAX_REMESHED_FACES, _CELL_GROWTH, _MAX_CELL_GROWTHS = 80_000, 1.4, 3

# Points lie in a plane if the smallest of their singular values is below this fraction of the
# largest.
_PLANE_TOLERANCE = 1e-9

Keep = Literal["all", "valid", "none"]
Patches = Literal["smooth", "harmonic"]


def repair(
    mesh: trimesh.Trimesh,
    *,
    keep: Keep | None = None,
    filling: Patches = "smooth",
    largest: bool = False,
    cell_size: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    options: TraceOptions | None = None,
    tolerance: float | None = None,
) -> trimesh.Trimesh:
    """Return a closed mesh for a damaged one: with its holes filled, or remeshed.

    First, vertices that differ only by rounding are merged. Closed components that lie in no other
    component and are inside out are reversed, together with all components in them. Then five
    stages are tried in turn:

    - filled: all triangles stay, and holes are filled;
    - boolean_union: a closed mesh that intersects itself (also along edges that lie on its faces),
      or components that overlap or touch, are cut exactly along the intersections. Faces in the
      interior are removed, and faces of parts with a negative winding number; a cavity stays where
      the winding number is 0;
    - cleaned: duplicate, degenerate and intersecting triangles are removed, those turned over
      against their neighbors are flipped, and holes are filled; around a hole that cannot be
      filled, triangles are removed ring by ring;
    - welded: nearby corners of loose triangles, as in a mesh full of cracks, are merged at their
      mean, and the mesh is then cleaned;
    - remeshed: the surface on which the winding number w of the mesh is 1/2 is extracted from the
      signs of w - 1/2 in cells (`meshing.sign_isosurface`); it is closed whatever the mesh is.

    Each result is compared with w at some thousand points that are farther than two tolerances from
    both surfaces: points with w > 0.86 have to be inside, and points with w < 0.14 outside; and if
    the input is closed and winds around no point twice, the volumes have to agree. If a result
    differs, the next stage is tried; if all results differ, the one that differs least is returned,
    with a warning. As this is sampled, a difference in less than a thousandth of the box may not be
    found.

    mesh: anything with `vertices` (n, 3) and `faces` (m, 3).
    keep: "all" does only the stage "filled", "valid" only "cleaned", and "none" only "remeshed",
        or raises an error; None tries all five, up to the first that succeeds.
    filling: "smooth" hole fillings continue the surface around each hole, with its tangents, and
        bend least. They are computed hole by hole, and used where w is within 0.36 of 1/2 modulo 1
        on them; other holes get "harmonic" fillings, on which w is 1/2 modulo 1: these join the
        boundary loops of a gap between two components, and have a dent where the surface was
        round. Only for harmonic fillings is it proved which surface they approximate.
    largest: keep only the body of the largest volume, with its cavities.
    cell_size: the size of cells before refinement, in the mesh's unit; None for a default.
    seed: of the small random moves that keep points in general position.
    progress: a function that is called with a text about each stage.
    options: a `TraceOptions`; repairs use its `tolerance` alone, the largest distance of harmonic
        fillings and of remeshed triangles from the surface w = 1/2, a length, sampled and not
        proved. None is 1e-3 of the longest side of the box of the mesh and, for fillings, of the
        box around all holes.
    tolerance: the same, in place of `options`.

    Returns:
        A closed trimesh.Trimesh: every edge has two faces, which agree. `metadata["harnack"]` has
        stage: "filled", "boolean_union", "cleaned", "welded" or "remeshed"; why: the failures of
        the stages before, or None; kept: how many of the input triangles are there; parts: for
        each component, largest first, a dictionary of its faces, volume and center; dropped: how
        many components were removed for `largest`; welded: how many corners were merged because
        they differed by rounding only; differs: None, or a dictionary of the differences from the
        input (share of the points on the wrong side, places of some, how many are missing and
        added, and volumes of both); and the Euler characteristic.

        After "filled", "cleaned" and "welded" there are also holes (how many loops of boundary
        edges there were), patches (how many triangles were added) and harmonic (how many of these
        are harmonic). After "filled" and "cleaned" the input's vertices and faces come first, bit
        by bit and in their order: all of them if all were kept and nothing was dropped, else those
        that are in use. Fillings meet other triangles only at shared edges and vertices, decided
        exactly.

        After "filled": missing (how many patches are single triangles that fill holes of three
        edges), refined (whether harmonic fillings are within the tolerance: they stay as the cells
        cut them if finer ones would intersect each other), spacing and evaluations of these.
        Nothing is added to a closed mesh; unless keep is "all", it is only returned if it does not
        intersect itself.

        After "boolean_union", kept is 0: triangles that were not cut lie where they were, but may
        be divided otherwise.

        After "cleaned": turned (how many triangles were flipped) and left_out, a dictionary of how
        many were removed because they were "flat" (without an area), "doubled", "crossing",
        "branching" (at edges of more than two), "one-sided" (at edges where the surface has no two
        sides), "around" holes that could not be filled or "inside" the material of other
        components. Vertices at the same position are merged. No triangles intersect, and no
        component is inside out.

        After "welded": the same, and joined (how many of the input triangles are there, with moved
        vertices) and moved (how far the farthest vertex was moved, a length); kept is 0. A warning
        says so where that is more than two tolerances.

        After "remeshed", no triangles intersect, and there are the facts of `mesh` about meshes by
        signs, such as far and within; kept is 0.

    Raises:
        MeshError: a ValueError: the mesh has no triangles, or invalid numbers; it would be
            remeshed, but is an open sheet, most of which encloses nothing; with keep="all"
            also edges of more than two faces, neighbors with opposite orientations, faces of zero
            area, and vertices at the same position.
        MeshingError: a ValueError: with keep="all" or "valid", fillings could not be made, or they
            intersect the mesh or each other; else, the surface w = 1/2 is empty or needs too many
            cells.
    """
    largest = flag(largest, "largest")
    keywords = {} if tolerance is None else {"tolerance": tolerance}
    mesh_tolerance = MeshTolerance.of(trace_options("repair", options, keywords, ("tolerance",)))
    settings = _repair_options(keep, filling, mesh_tolerance, cell_size, seed, teller(progress))
    _check_is_mesh(mesh)
    _check_encloses(mesh)
    intended = IntendedSolid.of(mesh, as_it_is=keep == "all")
    stages = {
        "all": _fill_only,
        "boolean_union": _unite_bodies,
        "valid": _keep_valid,
        "welded": _weld_loose,
        "none": _remesh,
    }
    names = list(stages) if keep is None else [keep]
    reasons, results = list[str](), list[_Result]()
    for name in names:
        try:
            surface, facts = stages[name](intended, settings)
        except (MeshError, MeshingError) as error:
            if name == names[-1] and not results:
                raise
            reasons.append(str(error))
            settings.report(f"{error}; so not all is kept")
            continue
        settings.report("comparing with what was given")
        distance = 2 * mesh_tolerance.at(intended.size) + facts.get("moved", 0.0)
        results.append(_Result(surface, facts, intended.difference(surface, distance)))
        if results[-1].difference is None:
            break
        reasons.append(f"the result of {facts['stage']} is another solid: {results[-1].difference}")
        settings.report(f"{reasons[-1]}; so another way")
    best = min(results, key=lambda result: result.badness)
    moved = best.facts.get("moved", 0.0)
    if moved > 2 * mesh_tolerance.at(intended.size):
        warnings.warn(
            f"faces that were apart were joined, which moved corners by up to {moved:.3g}: the "
            "repaired mesh may be off by as much",
            stacklevel=2,
        )
    # Each reason once.
    why = "; ".join(dict.fromkeys(reasons)) or None
    return best.finished({"why": why, "welded": intended.rounded}, largest)


@dataclass(frozen=True)
class _RepairOptions:
    """The arguments of `repair`, validated. patches: the argument `filling`; spacing: the argument
    `cell_size`; report: is told what is being done."""

    keep: Keep | None
    patches: Patches
    tolerance: MeshTolerance
    spacing: float | None
    seed: int
    report: Callable[[str], None]


def _repair_options(
    keep: Keep | None,
    patches: Patches,
    tolerance: MeshTolerance,
    spacing: float | None,
    seed: int,
    report: Callable[[str], None],
) -> _RepairOptions:
    """Validate the arguments of `repair`.

    Raises:
        ValueError: an unknown `keep` or `filling`, or a number out of range.
    """
    if keep is not None and not is_one_of(keep, ("all", "valid", "none")):
        raise ValueError(f'keep is None, "all", "valid" or "none", not {keep!r}')
    if not is_one_of(patches, ("smooth", "harmonic")):
        raise ValueError(f'filling is "smooth" or "harmonic", not {patches!r}')
    check_options(spacing, None, seed, 1)
    return _RepairOptions(keep, patches, tolerance, spacing, seed, report)


@dataclass(frozen=True)
class _Result:
    """The result of a stage.

    surface: the repaired mesh.
    facts: entries of its metadata.
    difference: how it differs from the solid that the input bounds; None if it does not.
    """

    surface: TriangleMesh
    facts: dict[str, Any]
    difference: Difference | None

    @property
    def badness(self) -> float:
        """How much the result differs from the input (`Difference.badness`); 0 if it does not."""
        return 0.0 if self.difference is None else self.difference.badness

    def finished(self, new_facts: dict[str, Any], largest: bool) -> trimesh.Trimesh:
        """The mesh with its metadata: the facts of the stage, `new_facts`, and facts of its
        components. Warns if the result differs from the input.

        largest: whether only the body of the largest volume is kept.
        """
        from harnack.meshing.closed_mesh import ClosedMesh

        surface = self.surface
        facts: dict[str, Any] = {**self.facts, **new_facts, "differs": None}
        if self.difference is not None:
            facts["differs"] = dataclasses.asdict(self.difference)
            warnings.warn(
                f"the repaired mesh is not quite the solid that was given: {self.difference}",
                stacklevel=3,
            )
        parts = component_facts(surface)
        dropped = 0
        if largest and len(parts) > 1:
            surface = largest_body(surface)
            dropped = len(parts) - len(component_facts(surface))
            facts["kept"] = _count_kept(surface, self.surface, facts["kept"])
        repaired = ClosedMesh(surface.vertices, surface.faces, process=False, validate=False)
        repaired.metadata["harnack"] = {
            **facts,
            "parts": parts,
            "dropped": dropped,
            "euler_characteristic": euler_characteristic(surface.faces),
        }
        return repaired


def _count_kept(surface: TriangleMesh, original: TriangleMesh, count: int) -> int:
    """How many of the first `count` faces of the mesh `original` are in `surface`, which is a part
    of it."""
    corners = [mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in (surface, original)]
    corner_bytes = {row.tobytes() for row in corners[0]}
    return sum(row.tobytes() in corner_bytes for row in corners[1][:count])


def _check_is_mesh(mesh: Any) -> None:
    """Raise a TypeError for an object without `vertices` and `faces`."""
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise TypeError(
            f"repair takes a mesh with vertices and faces, such as a trimesh.Trimesh, not "
            f"{type(mesh).__name__}"
        )


def _check_encloses(mesh: Any) -> None:
    """Raise if a mesh cannot enclose a volume.

    Raises:
        MeshError: all faces lie in a plane; the mesh is one-sided, like a Moebius strip; or as
            `validate_mesh`.
    """
    vertices, faces = validate_mesh(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), allow_zero_area=True
    )
    x = vertices[np.unique(faces)]
    x = x - x.mean(axis=0)
    largest, *_, smallest = np.linalg.svd(x / np.abs(x).max(), compute_uv=False)
    if smallest <= _PLANE_TOLERANCE * largest:
        raise MeshError(
            "all faces of the mesh lie in a plane, or nearly so: they enclose nothing that could "
            "be closed; give it a thickness first, or mesh its boundary with `thickness`"
        )
    if is_nonorientable(weld_vertices(vertices)[faces]):
        raise MeshError(
            "the mesh has one side only, as a Moebius strip has: nothing is inside of it that "
            "could be closed; give it a thickness first, in the program that made it"
        )


# Bodies united.


def _unite_bodies(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The stage "boolean_union": the boundary of the solid that is bounded by a closed mesh that
    intersects itself, or by components that overlap or touch. Returns it with its facts.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = intended.vertices, intended.oriented
    if len(singular_edges(faces)[0]):
        raise MeshError("the mesh is not closed")
    if _is_sound(vertices, faces):
        raise MeshError("nothing of it passes through or lies in itself")
    facts = {"stage": "boolean_union", "kept": 0}
    sliver_size = 0.5 * settings.tolerance.at(intended.size)
    if len(intended.parts) > 1 and sum(map(len, intended.parts)) == len(faces):
        settings.report(f"uniting {len(intended.parts):,} parts")
        try:
            return united_parts(vertices, faces, intended.parts, sliver_size), facts
        except (MeshError, MeshingError) as error:
            settings.report(f"{error}; so all at once")
    settings.report("cutting faces along each other")
    try:
        return mended_by_cuts(vertices, faces, sliver_size), facts
    except MeshingError as error:
        settings.report(f"{error}; so by cells")
    remeshed = mesh_of(MeshSolid(vertices, faces), progress=settings.report)
    return TriangleMesh(np.asarray(remeshed.vertices), np.asarray(remeshed.faces, np.int64)), facts


def _is_sound(vertices: FloatArray, faces: IntArray) -> bool:
    """Whether triangles meet only at shared vertices and edges, and no component is inside the
    material of another."""
    try:
        _check_nesting(TriangleMesh.without_unused_vertices(vertices, faces))
    except MeshError:
        return False
    return not len(nonmanifold_vertices(faces)) and not len(intersecting_faces(vertices, faces))


# All made anew.


def _remesh(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The stage "remeshed": the surface on which the winding number is 1/2, which is closed
    whatever the mesh is. Returns it with its facts."""
    intended.check_encloses()
    vertices_faces = without_zero_area_faces(intended.vertices, intended.oriented)
    field = WindingNumber(*vertices_faces)
    if settings.spacing is not None:
        remeshed = _mesh_from_signs(field, settings.spacing, settings)
    else:
        spacing = float(np.ptp(vertices_faces[0], axis=0).max()) / _REMESH_CELLS_ACROSS
        try:
            remeshed = _remesh_bounded(field, spacing, settings)
        except MeshingError:
            remeshed = _mesh_from_signs(field, 0.6 * spacing, settings)
    facts = remeshed.metadata["harnack"] | {"stage": "remeshed", "kept": 0}
    return TriangleMesh(np.asarray(remeshed.vertices), np.asarray(remeshed.faces, np.int64)), facts


def _remesh_bounded(
    field: WindingNumber, spacing: float, settings: _RepairOptions
) -> trimesh.Trimesh:
    """The level set w = 1/2, in larger cells if there would be too many triangles, as for noisy
    meshes: the time of the checks grows with their number.
    """
    for k in range(_MAX_CELL_GROWTHS):
        try:
            return _mesh_from_signs(field, spacing * _CELL_GROWTH**k, settings, _MAX_REMESHED_FACES)
        except TriangleLimitError as error:
            settings.report(f"{error}; so of larger cells")
    return _mesh_from_signs(field, spacing * _CELL_GROWTH**_MAX_CELL_GROWTHS, settings)


def _mesh_from_signs(
    field: WindingNumber, spacing: float, settings: _RepairOptions, max_faces: int = 2_000_000
) -> trimesh.Trimesh:
    """The level set w = 1/2 of a winding number, closed, in cells of size `spacing`."""
    return mesh_of(
        field, level=0.5, side="above", tolerance=settings.tolerance.length, cell_size=spacing,
        max_triangles=max_faces, progress=settings.report,
    )  # fmt: skip


# What is sound kept.


def _keep_valid(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The stage "cleaned": the valid triangles, with filled holes. Returns the mesh with its facts.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = without_zero_area_faces(intended.vertices, intended.faces)
    cleaned = clean_and_fill(vertices, faces, settings.report)
    flat_count = len(intended.faces) - len(faces)
    left_out = {"flat": cleaned.left_out["flat"] + flat_count}
    return cleaned.surface, {
        "stage": "cleaned",
        "kept": len(cleaned.kept),
        "turned": _count_flipped(intended, cleaned),
        "left_out": cleaned.left_out | left_out,
        "holes": cleaned.holes,
        "patches": len(cleaned.surface.faces) - len(cleaned.kept),
        "harmonic": 0,
    }


def _count_flipped(intended: IntendedSolid, cleaned: CleanedMesh) -> int:
    """How many of the triangles that were kept have the opposite orientation of those of the
    input."""
    was_turned = np.delete(intended.is_turned, zero_area_faces(intended.vertices, intended.faces))
    is_turned = np.zeros(len(was_turned), np.bool_)
    is_turned[cleaned.turned] = True
    return int((is_turned ^ was_turned)[cleaned.kept].sum())


# Loose triangles joined.


def _weld_loose(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The stage "welded": nearby corners of loose triangles are merged and holes filled; no
    triangle is kept bit by bit. Returns the mesh with its facts.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices_faces = without_zero_area_faces(intended.vertices, intended.faces)
    vertices, faces, moved = weld_near_corners(*vertices_faces)
    cleaned = clean_and_fill(vertices, faces, settings.report)
    kept_count = len(cleaned.kept)
    return cleaned.surface, {
        "stage": "welded",
        "kept": 0,
        "joined": kept_count,
        "moved": moved,
        "turned": len(cleaned.turned),
        "left_out": cleaned.left_out | {"flat": len(intended.faces) - len(faces)},
        "holes": cleaned.holes,
        "patches": len(cleaned.surface.faces) - kept_count,
        "harmonic": 0,
    }


# All kept.


def _fill_only(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The stage "filled": the mesh with all its triangles, and filled holes. Returns it with its
    facts.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = _checked_mesh(intended)
    if intended.is_turned.any():
        raise MeshError("a part of the mesh is inside out")
    edges = checked_boundary_edges(faces)
    if settings.keep is None and len(crossing := intersecting_faces(vertices, faces)):
        raise MeshError(f"{len(crossing):,} triangles of the mesh pass through others")
    loops = hole_loops(vertices, faces, edges)
    if settings.patches == "smooth":
        try:
            return _fill_kept_mesh(vertices, faces, loops, settings)
        except MeshingError as error:
            if settings.keep is None:
                raise
            settings.report(f"{error}; once more, with harmonic patches alone")
    return _fill_kept_mesh(
        vertices, faces, loops, dataclasses.replace(settings, patches="harmonic")
    )


def _checked_mesh(intended: IntendedSolid) -> tuple[FloatArray, IntArray]:
    """The vertices and faces of a mesh of which all triangles can be kept.

    Raises:
        MeshError: as `validate_mesh`; two vertices are at the same position.
    """
    vertices, faces = validate_mesh(intended.vertices, intended.faces)
    used = np.unique(faces)
    welded = weld_vertices(vertices[used])
    copies = np.flatnonzero(welded != np.arange(len(used)))
    if len(copies):
        raise MeshError(
            f"vertices {used[welded[copies[0]]]} and {used[copies[0]]} are at the same place, and "
            f"{len(copies):,} in all: join such vertices first, for instance by "
            "mesh.merge_vertices() of trimesh, or faces are not known to be neighbors"
        )
    return vertices, faces


def _fill_kept_mesh(
    vertices: FloatArray, faces: IntArray, loops: list[IntArray], settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh with fillings over its holes: smooth ones if `settings` asks for them, and harmonic
    ones for the holes that remain. Returns it with its facts.

    loops: the vertex indices of the boundary of each hole.

    Raises:
        MeshingError: as `repair`.
    """
    all_vertices, all_faces, unfilled = vertices, faces, loops
    if loops and settings.patches == "smooth":
        settings.report(f"filling {len(loops):,} holes")
        field = WindingNumber(vertices, faces)
        smooth = fill_holes(vertices, faces, loops, lambda p: field.value(p, precision="double"))
        all_vertices, all_faces = (
            np.concatenate([all_vertices, smooth.vertices]),
            np.concatenate([faces, smooth.faces]),
        )
        unfilled = smooth.unfilled_loops
        settings.report(f"{len(unfilled):,} holes are left" + f": {smooth.reason}" * bool(unfilled))
    harmonic = HarmonicFilling(vertices[:0], faces[:0], True, 0.0, 0)
    if unfilled:
        edges = checked_boundary_edges(all_faces)
        if settings.keep is None and len(edges) > _FEW_EDGES:
            raise MeshingError(
                f"{len(unfilled):,} holes of {len(edges):,} edges have no smooth patch"
            )
        attempts = _MAX_ATTEMPTS if settings.keep == "all" else _FEW_ATTEMPTS
        filling_options = HoleFillingOptions(
            settings.tolerance, settings.spacing, settings.seed, attempts, settings.report
        )
        harmonic = harmonic_patches(all_vertices, all_faces, edges, filling_options)
        all_vertices, all_faces = (
            np.concatenate([all_vertices, harmonic.vertices]),
            np.concatenate([all_faces, harmonic.faces]),
        )
    surface = TriangleMesh.without_unused_vertices(all_vertices, all_faces)
    if loops or settings.keep is None:
        _check_vertex_neighborhoods(all_faces)
    if settings.keep is None:
        _check_nesting(surface)
    return surface, {
        "stage": "filled",
        "kept": len(faces),
        "holes": len(loops),
        "patches": len(all_faces) - len(faces),
        "harmonic": len(harmonic.faces),
        "missing": harmonic.triangle_fill_count,
        "refined": harmonic.is_refined,
        "spacing": harmonic.spacing,
        "evaluations": harmonic.evaluations,
    }


def _check_nesting(surface: TriangleMesh) -> None:
    """Raise a MeshError if a component is inside out, or lies wholly or partly inside the material
    of another one."""
    shells = Shells.of(surface)
    depths = shells.nesting_depths()
    if ((shells.volumes < 0) & (depths == 0)).any():
        raise MeshError("a part of the mesh is inside out")
    if ((shells.volumes > 0) & (depths > 0)).any():
        raise MeshError("a part of the mesh is inside the material of another one")
    if passes_itself(surface, shells.component_of_face):
        raise MeshError("the mesh passes through itself along edges that lie on faces")


def _check_vertex_neighborhoods(faces: IntArray) -> None:
    """Raise a MeshingError unless the faces around each vertex are connected by edges."""
    if len(pinched := nonmanifold_vertices(faces)):
        raise MeshingError(
            f"faces touch in {len(pinched):,} vertices alone, such as vertex {pinched[0]}: such a "
            "mesh has no two sides there"
        )
