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

# The number of sizes of cells that are tried for harmonic fillings if all triangles have to stay;
# and if they need not stay, where there are at most the third number of open edges.
_ATTEMPTS, _OPTIONAL_ATTEMPTS, _MAX_OPTIONAL_EDGES = 6, 1, 1000
# The number of cells across the mesh if it is remeshed. If the surface is rough and has more
# triangles than the second number, cells are made larger by the third, at most as often as the
# fourth says.
_ACROSS_ANEW = 48
_MOST_ANEW, _CELL_GROWTH, _MAX_GROWTHS = 80_000, 1.4, 3

# Points lie in a plane if the smallest of their singular values is below this fraction of the
# largest.
_FLAT = 1e-9

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

    First, vertices that differ by rounding only are merged, and components that are inside out as a
    whole are reversed: each closed component that lies in no other, with all that lies in it. Then
    five stages are tried in turn:

    - filled: all triangles stay, and holes are filled;
    - boolean_union: a closed mesh that intersects itself, also along edges that lie on its faces,
      or components that overlap or touch, are cut exactly along the intersections; interior faces
      are removed, and those that wind around a point clockwise: cavities stay where the mesh winds
      around no point;
    - cleaned: duplicate, degenerate and intersecting triangles are removed, those turned over
      against their neighbors are flipped, and holes are filled; around a hole that cannot be
      filled, triangles are removed ring by ring;
    - welded: nearby corners of loose triangles, as in a mesh full of cracks, are merged at their
      mean, and the mesh is then cleaned;
    - remeshed: the surface on which the winding number w of the mesh is 1/2 is extracted from the
      signs of w - 1/2 in cells (`meshing.sign_isosurface`); it is closed whatever the mesh is.

    Each result is compared with w at some thousand points, farther from both surfaces than two
    tolerances: where w is above 0.86 the inside has to be, and where it is below 0.14 the outside;
    and the volume has to be that of a closed mesh that winds around no point twice. One that
    differs gives way to the next stage; if all do, the one that differs least is returned, with a
    warning. That is sampled: what differs in less than a thousandth of the box may not be seen.

    mesh: anything with `vertices` (n, 3) and `faces` (m, 3).
    keep: "all" does only the stage "filled", "valid" only "cleaned", and "none" only "remeshed",
        or raises an error; None tries all five, up to the first that succeeds.
    filling: "smooth" hole fillings continue the surface around each hole, with its tangents, and
        bend least. They are computed hole by hole, and used where w is within 0.36 of 1/2 modulo 1
        on them; other holes get "harmonic" fillings, on which w is 1/2 modulo 1: these join the
        boundary loops of a gap between two components, and have a dent where the surface was
        round. Only for harmonic fillings is it proved which surface they approximate.
    largest: keep only the body of the largest volume, with its cavities.
    cell_size: of cells before anything is refined, in the mesh's unit; None chooses.
    seed: of the small random moves that keep points in general position.
    progress: called with the name of each step of the work.
    options: a `TraceOptions`, of which repairs have the tolerance alone: the largest distance of
        harmonic fillings and of remeshed triangles from the surface w = 1/2, a length, sampled and
        not proved. None is 1e-3 of the longest side of the box of the mesh and, for fillings, of
        the box around all holes. tolerance: the same, in place of `options`.

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
        MeshError: a ValueError, for a mesh that has no triangles, or numbers that are none; one
            that is an open sheet, most of which has nothing inside, if it would be made anew; with
            keep="all" also for edges of more than two faces, faces that disagree on their sides,
            faces without an area and vertices at one place.
        MeshingError: a ValueError, with keep="all" or "valid", if patches could not be made, or
            meet the mesh or each other; else if the surface w = 1/2 is empty or takes too many
            cells.
    """
    largest = flag(largest, "largest")
    keywords = {} if tolerance is None else {"tolerance": tolerance}
    accuracy = MeshTolerance.of(trace_options("repair", options, keywords, ("tolerance",)))
    settings = _checked_settings(keep, filling, accuracy, cell_size, seed, teller(progress))
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
        away = 2 * accuracy.at(intended.size) + facts.get("moved", 0.0)
        results.append(_Result(surface, facts, intended.difference(surface, away)))
        if results[-1].difference is None:
            break
        reasons.append(f"the result of {facts['stage']} is another solid: {results[-1].difference}")
        settings.report(f"{reasons[-1]}; so another way")
    best = min(results, key=lambda result: result.badness)
    moved = best.facts.get("moved", 0.0)
    if moved > 2 * accuracy.at(intended.size):
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
    """The arguments of `repair`."""

    keep: Keep | None
    patches: Patches
    tolerance: MeshTolerance
    spacing: float | None
    seed: int
    report: Callable[[str], None]


def _checked_settings(
    keep: Keep | None,
    patches: Patches,
    tolerance: MeshTolerance,
    spacing: float | None,
    seed: int,
    report: Callable[[str], None],
) -> _RepairOptions:
    if keep is not None and not is_one_of(keep, ("all", "valid", "none")):
        raise ValueError(f'keep is None, "all", "valid" or "none", not {keep!r}')
    if not is_one_of(patches, ("smooth", "harmonic")):
        raise ValueError(f'filling is "smooth" or "harmonic", not {patches!r}')
    check_options(spacing, None, seed, 1)
    return _RepairOptions(keep, patches, tolerance, spacing, seed, report)


@dataclass(frozen=True)
class _Result:
    """The result of a stage, and its difference from the intended solid; None for no difference."""

    surface: TriangleMesh
    facts: dict[str, Any]
    difference: Difference | None

    @property
    def badness(self) -> float:
        """0 if it does not differ: see `Difference`."""
        return 0.0 if self.difference is None else self.difference.badness

    def finished(self, more_facts: dict[str, Any], largest: bool) -> trimesh.Trimesh:
        """The mesh, with its metadata; with a warning if it differs from the intended solid.

        more_facts: further metadata."""
        from harnack.meshing.closed_mesh import ClosedMesh

        surface = self.surface
        facts: dict[str, Any] = {**self.facts, **more_facts, "differs": None}
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
            facts["kept"] = _count_of(surface, self.surface, facts["kept"])
        repaired = ClosedMesh(surface.vertices, surface.faces, process=False, validate=False)
        repaired.metadata["harnack"] = {
            **facts,
            "parts": parts,
            "dropped": dropped,
            "euler_characteristic": euler_characteristic(surface.faces),
        }
        return repaired


def _count_of(surface: TriangleMesh, whole: TriangleMesh, first: int) -> int:
    """The number of the first faces of a whole mesh that are in a surface that is a part of it."""
    corners = [mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in (surface, whole)]
    rows = {row.tobytes() for row in corners[0]}
    return sum(row.tobytes() in rows for row in corners[1][:first])


def _check_is_mesh(mesh: Any) -> None:
    if not hasattr(mesh, "vertices") or not hasattr(mesh, "faces"):
        raise TypeError(
            f"repair takes a mesh with vertices and faces, such as a trimesh.Trimesh, not "
            f"{type(mesh).__name__}"
        )


def _check_encloses(mesh: Any) -> None:
    """Raise if all faces lie in a plane, or form a strip of one side only.

    Raises:
        MeshError: so; or as `validate_mesh`.
    """
    vertices, faces = validate_mesh(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), allow_zero_area=True
    )
    x = vertices[np.unique(faces)]
    x = x - x.mean(axis=0)
    largest, *_, least = np.linalg.svd(x / np.abs(x).max(), compute_uv=False)
    if least <= _FLAT * largest:
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
    intended: IntendedSolid, options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The boundary of the solid that a closed mesh bounds which passes through itself, or of parts
    that touch.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = intended.vertices, intended.oriented
    if len(singular_edges(faces)[0]):
        raise MeshError("the mesh is not closed")
    if _is_free_of_overlaps(vertices, faces):
        raise MeshError("nothing of it passes through or lies in itself")
    facts = {"stage": "boolean_union", "kept": 0}
    slivers = 0.5 * options.tolerance.at(intended.size)
    if len(intended.parts) > 1 and sum(map(len, intended.parts)) == len(faces):
        options.report(f"uniting {len(intended.parts):,} parts")
        try:
            return united_parts(vertices, faces, intended.parts, slivers), facts
        except (MeshError, MeshingError) as error:
            options.report(f"{error}; so all at once")
    options.report("cutting faces along each other")
    try:
        return mended_by_cuts(vertices, faces, slivers), facts
    except MeshingError as error:
        options.report(f"{error}; so by cells")
    mesh = mesh_of(MeshSolid(vertices, faces), progress=options.report)
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)), facts


def _is_free_of_overlaps(vertices: FloatArray, faces: IntArray) -> bool:
    """Whether no triangles meet except in common vertices and edges, and no part is in another's
    material."""
    try:
        _check_sides(TriangleMesh.without_unused_vertices(vertices, faces))
    except MeshError:
        return False
    return not len(nonmanifold_vertices(faces)) and not len(intersecting_faces(vertices, faces))


# Remeshing.


def _remesh(
    intended: IntendedSolid, options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The surface on which the winding number is 1/2, closed whatever the mesh is."""
    intended.check_encloses()
    corners = without_zero_area_faces(intended.vertices, intended.oriented)
    field = WindingNumber(*corners)
    if options.spacing is not None:
        mesh = _by_signs(field, options.spacing, options)
    else:
        spacing = float(np.ptp(corners[0], axis=0).max()) / _ACROSS_ANEW
        try:
            mesh = _of_bounded_size(field, spacing, options)
        except MeshingError:
            mesh = _by_signs(field, 0.6 * spacing, options)
    facts = mesh.metadata["harnack"] | {"stage": "remeshed", "kept": 0}
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)), facts


def _of_bounded_size(
    field: WindingNumber, spacing: float, options: _RepairOptions
) -> trimesh.Trimesh:
    """The mesh by signs, with larger cells if there would be too many triangles, as for noisy
    meshes: the time of checks grows with their number."""
    for k in range(_MAX_GROWTHS):
        try:
            return _by_signs(field, spacing * _CELL_GROWTH**k, options, _MOST_ANEW)
        except TriangleLimitError as error:
            options.report(f"{error}; so of larger cells")
    return _by_signs(field, spacing * _CELL_GROWTH**_MAX_GROWTHS, options)


def _by_signs(
    field: WindingNumber, spacing: float, options: _RepairOptions, max_triangles: int = 2_000_000
) -> trimesh.Trimesh:
    return mesh_of(
        field, level=0.5, side="above", tolerance=options.tolerance.length, cell_size=spacing,
        max_triangles=max_triangles, progress=options.report,
    )  # fmt: skip


# Valid triangles kept.


def _keep_valid(
    intended: IntendedSolid, options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The valid triangles, with hole fillings.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = without_zero_area_faces(intended.vertices, intended.faces)
    cleaned = clean_and_fill(vertices, faces, options.report)
    flat = len(intended.faces) - len(faces)
    left_out = {"flat": cleaned.left_out["flat"] + flat}
    return cleaned.surface, {
        "stage": "cleaned",
        "kept": len(cleaned.kept_faces),
        "turned": _count_turned(intended, cleaned),
        "left_out": cleaned.left_out | left_out,
        "holes": cleaned.holes,
        "patches": len(cleaned.surface.faces) - len(cleaned.kept_faces),
        "harmonic": 0,
    }


def _count_turned(intended: IntendedSolid, sound: CleanedMesh) -> int:
    """The number of kept triangles whose orientation differs from that of the input triangles."""
    turned_before = np.delete(
        intended.is_turned, zero_area_faces(intended.vertices, intended.faces)
    )
    is_turned = np.zeros(len(turned_before), np.bool_)
    is_turned[sound.turned] = True
    return int((is_turned ^ turned_before)[sound.kept_faces].sum())


# Loose triangles joined.


def _weld_loose(
    intended: IntendedSolid, options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Triangles with near corners joined, with hole fillings; none is kept bit by bit.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    corners = without_zero_area_faces(intended.vertices, intended.faces)
    vertices, faces, moved = weld_near_corners(*corners)
    cleaned = clean_and_fill(vertices, faces, options.report)
    count = len(cleaned.kept_faces)
    return cleaned.surface, {
        "stage": "welded",
        "kept": 0,
        "joined": count,
        "moved": moved,
        "turned": len(cleaned.turned),
        "left_out": cleaned.left_out | {"flat": len(intended.faces) - len(faces)},
        "holes": cleaned.holes,
        "patches": len(cleaned.surface.faces) - count,
        "harmonic": 0,
    }


# All kept.


def _fill_only(
    intended: IntendedSolid, options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh with hole fillings; all its triangles stay.

    Raises:
        MeshError, MeshingError: as `repair`.
    """
    vertices, faces = _checked(intended)
    if intended.is_turned.any():
        raise MeshError("a part of the mesh is inside out")
    edges = checked_boundary_edges(faces)
    if options.keep is None and len(crossing := intersecting_faces(vertices, faces)):
        raise MeshError(f"{len(crossing):,} triangles of the mesh pass through others")
    loops = hole_loops(vertices, faces, edges)
    if options.patches == "smooth":
        try:
            return _fill_all_holes(vertices, faces, loops, options)
        except MeshingError as error:
            if options.keep is None:
                raise
            options.report(f"{error}; once more, with harmonic patches alone")
    return _fill_all_holes(vertices, faces, loops, dataclasses.replace(options, patches="harmonic"))


def _checked(intended: IntendedSolid) -> tuple[FloatArray, IntArray]:
    """The vertices and faces of a mesh, if all of them can be kept; else MeshError."""
    vertices, faces = validate_mesh(intended.vertices, intended.faces)
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


def _fill_all_holes(
    vertices: FloatArray, faces: IntArray, loops: list[IntArray], options: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """The mesh with its holes filled: by smooth fillings if requested, and by harmonic fillings.

    Raises:
        MeshingError: as `repair`.
    """
    x, whole, unfilled = vertices, faces, loops
    if loops and options.patches == "smooth":
        options.report(f"filling {len(loops):,} holes")
        field = WindingNumber(vertices, faces)
        filling = fill_holes(vertices, faces, loops, lambda p: field.value(p, precision="double"))
        x, whole = np.concatenate([x, filling.vertices]), np.concatenate([faces, filling.faces])
        unfilled = filling.unfilled_loops
        options.report(f"{len(unfilled):,} holes are left" + f": {filling.reason}" * bool(unfilled))
    harmonic = HarmonicFilling(vertices[:0], faces[:0], True, 0.0, 0)
    if unfilled:
        edges = checked_boundary_edges(whole)
        if options.keep is None and len(edges) > _MAX_OPTIONAL_EDGES:
            raise MeshingError(
                f"{len(unfilled):,} holes of {len(edges):,} edges have no smooth patch"
            )
        attempts = _ATTEMPTS if options.keep == "all" else _OPTIONAL_ATTEMPTS
        setup = HoleFillingOptions(
            options.tolerance, options.spacing, options.seed, attempts, options.report
        )
        harmonic = harmonic_patches(x, whole, edges, setup)
        x, whole = np.concatenate([x, harmonic.vertices]), np.concatenate([whole, harmonic.faces])
    surface = TriangleMesh.without_unused_vertices(x, whole)
    if loops or options.keep is None:
        _check_touching(whole)
    if options.keep is None:
        _check_sides(surface)
    return surface, {
        "stage": "filled",
        "kept": len(faces),
        "holes": len(loops),
        "patches": len(whole) - len(faces),
        "harmonic": len(harmonic.faces),
        "missing": harmonic.triangle_fill_count,
        "refined": harmonic.is_refined,
        "spacing": harmonic.spacing,
        "evaluations": harmonic.evaluations,
    }


def _check_sides(surface: TriangleMesh) -> None:
    """Raise if a part is inside out, or inside the material of another one, also in part."""
    shells = Shells.of(surface)
    depths = shells.nesting_depths()
    if ((shells.volumes < 0) & (depths == 0)).any():
        raise MeshError("a part of the mesh is inside out")
    if ((shells.volumes > 0) & (depths > 0)).any():
        raise MeshError("a part of the mesh is inside the material of another one")
    if passes_itself(surface, shells.component_of_face):
        raise MeshError("the mesh passes through itself along edges that lie on faces")


def _check_touching(faces: IntArray) -> None:
    """Raise unless the faces around each vertex are joined by edges."""
    if len(places := nonmanifold_vertices(faces)):
        raise MeshingError(
            f"faces touch in {len(places):,} vertices alone, such as vertex {places[0]}: such a "
            "mesh has no two sides there"
        )
