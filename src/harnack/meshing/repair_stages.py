"""The function `repair`: computes a closed triangle mesh from a damaged one, and keeps its valid
triangles where possible. The solid that the damaged mesh was meant to bound is known by its winding
number w, which says how often the mesh winds around a point: 1 inside of a closed mesh, 0 outside,
and values between for an open one. A "stage" is one way of repairing; a "filling" (or "patch")
consists of new triangles that close a hole; the "boundary edges" around a hole have a single face.

Stages are tried in turn, from the one that keeps most to the one that always gives a result: all
triangles stay and holes are filled; bodies that overlap are united (`bodies`), and a surface that
passes through itself is cut into pieces, of which the outer ones are joined (`joined_pieces`); only
valid triangles stay (`mesh_cleaning`); triangles that share no vertices are joined at near corners;
everything is remeshed: the surface on which the winding number of the mesh is 1/2 is extracted from
signs.

That a result is closed is not enough. The solid that it bounds is compared with the winding number
of the input, and the result is rejected if they disagree (`intended_solid`). Holes are filled in
one of two ways. Of smooth fillings, which have minimal bending (`hole_filling`), it is proved that
they intersect neither the mesh nor each other, and nothing else. Harmonic fillings
(`harmonic_filling`) are parts of the surface on which the winding number is 1/2 modulo 1, and it is
proved which surface they approximate; but they have a dent where the surface was round.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harnack.backend import IntArray
from harnack.backend.validation import flag
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.geometry import MeshError, validate_mesh, zero_area_faces
from harnack.geometry.boundary_edges import singular_edges, weld_vertices
from harnack.geometry.meshes import mesh_arrays, without_zero_area_faces
from harnack.geometry.orientability import is_nonorientable
from harnack.meshing.bodies import mended_by_cuts, united_parts
from harnack.meshing.checks import euler_characteristic, nonmanifold_vertices
from harnack.meshing.components import Shells, component_facts, largest_body
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
from harnack.meshing.mesh_cleaning import CleanedMesh, clean_and_fill, weld_near_corners
from harnack.meshing.mesh_pipeline import mesh as mesh_of
from harnack.meshing.mesh_tolerance import MeshTolerance
from harnack.meshing.meshing_errors import MeshingError, TriangleLimitError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.name_suggestions import is_one_of
from harnack.progress import ProgressFunction, show_progress
from harnack.tracer.trace_options import trace_options

if TYPE_CHECKING:
    import trimesh

    from harnack.backend import FloatArray
    from harnack.tracer import TraceOptions

__all__ = ["repair"]

# How many sizes of cells are tried for harmonic fillings, if all triangles have to stay; and if
# they need not. In that case holes with more open edges than the third are not filled like that.
_ATTEMPTS, _FEW_ATTEMPTS, _FEW_EDGES = 6, 1, 1000
# If the mesh is remeshed: the number of cells across it. If that takes more triangles than the
# first of the next numbers, as for a rough surface, cells are made larger by the second, at most as
# often as the third says.
_CELLS_ACROSS = 48
_MAX_TRIANGLES, _GROWTH, _MAX_GROWTHS = 80_000, 1.4, 3

# Points lie in a plane if the smallest of their singular values is at most this fraction of the
# largest.
_FLATNESS = 1e-9

Keep = Literal["all", "valid", "none"]
Patches = Literal["smooth", "harmonic"]


def repair(
    mesh: Any,
    *,
    keep: Keep | None = None,
    filling: Patches = "smooth",
    largest: bool = False,
    cell_size: float | None = None,
    seed: int = 0,
    progress: bool | ProgressFunction = False,
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

    Each result is compared with w at some thousand points that are farther than two tolerances from
    both surfaces. Points where w is above 0.86 have to be inside of the result, points where it is
    below 0.14 outside. If the input is a closed mesh that winds around no point twice, the volumes
    have to agree as well. If a result differs, the next stage is tried; if all results differ, the
    one that differs least is returned, with a warning. The comparison is a sample: what differs in
    less than a thousandth of the box may not be seen.

    mesh: anything with `vertices` (n, 3) and `faces` (m, 3), such as a trimesh.Trimesh, or the
        pair (vertices, faces).
    keep: which stages to try. "all" is only "filled", "valid" only "cleaned", "none" only
        "remeshed"; an error is raised if the stage fails. None tries all five, up to the first that
        succeeds.
    filling: "smooth" or "harmonic". Smooth fillings continue the surface around a hole, with its
        tangents, and have minimal bending. They are computed hole by hole, and used if w is within
        0.36 of 1/2 modulo 1 on them. Other holes get harmonic fillings, on which w is 1/2 modulo 1.
        These can join the boundary loops of a gap between two components, and have a dent where the
        surface was round. Only for harmonic fillings is it proved which surface they approximate.
    largest: whether to keep only the body of the largest volume, with its cavities.
    cell_size: the size of cells before refinement, in the mesh's unit; None chooses it.
    seed: of the small random moves that keep points in general position.
    progress: whether to show what is being done, or a function that is called with a `Progress`.
    options: a `TraceOptions`. Repairs use only its tolerance: the largest distance of harmonic
        fillings and of remeshed triangles from the surface w = 1/2, a length, which is sampled and
        not proved. None is 1e-3 of the longest side of the box around the mesh or, for fillings, of
        the box around all holes.
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
        TypeError: the argument is no mesh.
        MeshError: a ValueError. The mesh has no triangles, or numbers that are not finite; or it
            would be remeshed and is an open sheet: most of it has nothing inside. With keep="all"
            also: it has edges of more than two faces, faces that disagree in orientation, faces
            without an area, or several vertices at one place.
        MeshingError: a ValueError, with keep="all" or "valid", if patches could not be made, or
            meet the mesh or each other; else if the surface w = 1/2 is empty or takes too many
            cells.
    """
    largest = flag(largest, "largest")
    keywords = {} if tolerance is None else {"tolerance": tolerance}
    accuracy = MeshTolerance.of(trace_options("repair", options, keywords, ("tolerance",)))
    with show_progress("repair", progress) as reporter:
        settings = _checked_settings(keep, filling, accuracy, cell_size, seed, reporter.tell)
        vertices, faces = mesh_arrays(mesh)
        input_mesh = TriangleMesh(np.asarray(vertices), np.asarray(faces))
        _check_encloses(input_mesh)
        intended = IntendedSolid.of(input_mesh, as_it_is=keep == "all")
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
            reasons.append(
                f"the result of {facts['stage']} is another solid: {results[-1].difference}"
            )
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
    """The arguments of `repair`, checked.

    keep: which stages to try, "all", "valid" or "none"; None for all stages.
    patches: how holes are filled, "smooth" or "harmonic": the argument `filling`.
    tolerance: the largest distance of new triangles from the surface w = 1/2.
    spacing: the size of cells, a length: the argument `cell_size`; None to choose it.
    report: called with messages: the argument `progress`."""

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
    """Check the arguments of `repair`, and collect them in one object. patches: the argument
    `filling`. spacing: the argument `cell_size`. report: the argument `progress`. The others (keep,
    tolerance, seed) have the same names.

    Raises:
        ValueError: one of them is not among the allowed values.
    """
    if keep is not None and not is_one_of(keep, ("all", "valid", "none")):
        raise ValueError(f'keep is None, "all", "valid" or "none", not {keep!r}')
    if not is_one_of(patches, ("smooth", "harmonic")):
        raise ValueError(f'filling is "smooth" or "harmonic", not {patches!r}')
    check_options(spacing, None, seed, 1)  # (no thickness; any valid number of triangles)
    return _RepairOptions(keep, patches, tolerance, spacing, seed, report)


@dataclass(frozen=True)
class _Result:
    """The repaired mesh that one stage computed.

    surface: the closed mesh. facts: its entries in `metadata["harnack"]`.
    difference: how it differs from the solid that the input describes; None if it does not."""

    surface: TriangleMesh
    facts: dict[str, Any]
    difference: Difference | None

    @property
    def badness(self) -> float:
        """A number that says how much the result differs from the input (`Difference.badness`); 0
        if it does not differ. Of several results, the one with the smallest is returned."""
        return 0.0 if self.difference is None else self.difference.badness

    def finished(self, more: dict[str, Any], largest: bool) -> trimesh.Trimesh:
        """The mesh that `repair` returns, with its metadata. Warns if the result differs from the
        input.

        more: entries that are added to `metadata["harnack"]`.
        largest: whether to keep only the body with the largest volume."""
        from harnack.meshing.closed_export import ClosedMesh

        surface = self.surface
        facts: dict[str, Any] = {**self.facts, **more, "differs": None}
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
            # A body may have several components: its cavities.
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


def _count_kept(surface: TriangleMesh, whole: TriangleMesh, input_count: int) -> int:
    """How many of the first `input_count` faces of the mesh `whole` are also faces of `surface`.
    Faces are the same if their corners have the same coordinates, in the same order."""
    corners = [mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in (surface, whole)]
    present = {row.tobytes() for row in corners[0]}
    return sum(row.tobytes() in present for row in corners[1][:input_count])


def _check_encloses(mesh: TriangleMesh) -> None:
    """Check that a mesh can enclose something.

    Raises:
        MeshError: all faces lie in a plane, or the mesh has one side only, like a Moebius strip; or
            `validate_mesh` rejects it.
    """
    vertices, faces = validate_mesh(mesh.vertices, mesh.faces, allow_zero_area=True)
    x = vertices[np.unique(faces)]
    x = x - x.mean(axis=0)
    # Points lie in a plane if one singular value is nearly 0.
    largest, *_, smallest = np.linalg.svd(x / np.abs(x).max(), compute_uv=False)
    if smallest <= _FLATNESS * largest:
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
    """Stage "boolean_union" of the repair. It is for a closed mesh that passes through itself, or
    whose components overlap or touch. It computes the boundary of the solid that the mesh
    describes: the set of points around which the mesh winds at least once.

    Three methods are tried, each if the one before fails: the union of the closed parts of the
    mesh, if there are several; cutting all faces along each other; and meshing the solid anew by
    cells.

    intended: the damaged mesh, with faces that agree in orientation.
    settings: the options of the repair. Slivers that arise from cuts are removed by moving the
        surface by at most half of `settings.tolerance`.

    Returns:
        The boundary; and its entries in `metadata["harnack"]`. The entry "kept" (how many faces of
        the input are there) is 0.

    Raises:
        MeshError, MeshingError: the mesh is not closed, no parts of it overlap, or the union cannot
            be computed.
    """
    vertices, faces = intended.vertices, intended.oriented
    # Edges that do not cancel between faces (the first result) are open.
    if len(singular_edges(faces)[0]):
        raise MeshError("the mesh is not closed")
    if _bounds_a_solid(vertices, faces):
        raise MeshError("nothing of it passes through or lies in itself")
    facts = {"stage": "boolean_union", "kept": 0}
    sliver_width = 0.5 * settings.tolerance.at(intended.size)
    # Several parts, and every face is in one of them:
    if len(intended.parts) > 1 and sum(map(len, intended.parts)) == len(faces):
        settings.report(f"uniting {len(intended.parts):,} parts")
        try:
            return united_parts(vertices, faces, intended.parts, sliver_width), facts
        except (MeshError, MeshingError) as error:
            settings.report(f"{error}; so all at once")
    settings.report("cutting faces along each other")
    try:
        return mended_by_cuts(vertices, faces, sliver_width), facts
    except MeshingError as error:
        settings.report(f"{error}; so by cells")
    made = mesh_of(MeshSolid(vertices, faces), progress=settings.report)
    return TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64)), facts


def _bounds_a_solid(vertices: FloatArray, faces: IntArray) -> bool:
    """Whether a mesh bounds a solid. It does if its triangles meet only in shared edges and
    vertices, and if no component is inside out or lies in the material of another one."""
    try:
        _check_sides(TriangleMesh.without_unused_vertices(vertices, faces))
    except MeshError:
        return False
    return not len(nonmanifold_vertices(faces)) and not len(intersecting_faces(vertices, faces))


# All made anew.


def _remesh(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Stage "remeshed" of the repair: extract the surface on which the winding number of the mesh
    is 1/2. It is closed whatever the mesh is. Returns this mesh, and its entries in
    `metadata["harnack"]`.

    settings: the options of the repair.

    If cells of a 48th of the mesh's size (and larger ones) fail, cells 0.6 times as large are
    tried.

    intended: the damaged mesh, whose winding number it is.
    """
    intended.check_encloses()
    mesh_arrays = without_zero_area_faces(intended.vertices, intended.oriented)
    field = WindingNumber(*mesh_arrays)
    # Cells of a given size are used as they are; otherwise several sizes are tried.
    if settings.spacing is not None:
        made = _mesh_half_level(field, settings.spacing, settings)
    else:
        spacing = float(np.ptp(mesh_arrays[0], axis=0).max()) / _CELLS_ACROSS
        try:
            made = _remesh_of_bounded_size(field, spacing, settings)
        except MeshingError:
            # Once more, with cells of 0.6 times that size.
            made = _mesh_half_level(field, 0.6 * spacing, settings)
    facts = made.metadata["harnack"] | {"stage": "remeshed", "kept": 0}
    return TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64)), facts


def _remesh_of_bounded_size(
    field: WindingNumber, spacing: float, settings: _RepairOptions
) -> trimesh.Trimesh:
    """Extract the surface on which the winding number is 1/2, with at most 80,000 triangles if
    possible. If there are more, as for a noisy mesh, it is extracted again from larger cells,
    because the time of the checks grows with the number of triangles. After three attempts the
    surface is extracted from still larger cells without this limit.

    spacing: the size of cells that is tried first, a length.
    settings: the options of the repair.
    """
    for k in range(_MAX_GROWTHS):
        try:
            return _mesh_half_level(field, spacing * _GROWTH**k, settings, _MAX_TRIANGLES)
        except TriangleLimitError as error:
            settings.report(f"{error}; so of larger cells")
    return _mesh_half_level(field, spacing * _GROWTH**_MAX_GROWTHS, settings)


def _mesh_half_level(
    field: WindingNumber, spacing: float, settings: _RepairOptions, most: int = 2_000_000
) -> trimesh.Trimesh:
    """Extract the surface on which the winding number is 1/2, from the signs of its values in
    cells.

    spacing: the size of cells, a length.
    settings: the options of the repair.
    most: the largest number of triangles. If the surface takes more, a TriangleLimitError is
        raised.
    """
    return mesh_of(
        field, level=0.5, side="above", tolerance=settings.tolerance.length, cell_size=spacing,
        max_triangles=most, progress=settings.report,
    )  # fmt: skip


# What is sound kept.


def _keep_valid(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Stage "cleaned" of the repair: keep the valid triangles of the damaged mesh `intended`,
    remove the others, and fill all holes.

    settings: the options of the repair.

    Returns:
        The closed mesh; and its entries in `metadata["harnack"]`: how many triangles were kept,
        turned over, removed for each reason ("left_out"), and added by fillings ("patches"); how
        many holes were filled; and how many fillings are harmonic (none in this stage).

    Raises:
        MeshError, MeshingError: too few triangles are valid, or a hole cannot be filled.
    """
    vertices, faces = without_zero_area_faces(intended.vertices, intended.faces)
    cleaned = clean_and_fill(vertices, faces, settings.report)
    flat_count = len(intended.faces) - len(faces)
    flat = {"flat": cleaned.left_out["flat"] + flat_count}
    return cleaned.surface, {
        "stage": "cleaned",
        "kept": len(cleaned.kept_faces),
        "turned": _count_turned(intended, cleaned),
        "left_out": cleaned.left_out | flat,
        "holes": cleaned.holes,
        "patches": len(cleaned.surface.faces) - len(cleaned.kept_faces),
        "harmonic": 0,
    }


def _count_turned(intended: IntendedSolid, cleaned: CleanedMesh) -> int:
    """How many of the triangles that the cleaning kept have the reverse of the orientation that
    they had in the input. A triangle may be reversed twice, which leaves it as it was: once with
    its whole component (`IntendedSolid`), and once to agree with its neighbors (in the cleaning).

    cleaned: the result of the cleaning."""
    # The cleaning counts faces without those of zero area.
    was_turned_before = np.delete(
        intended.is_turned, zero_area_faces(intended.vertices, intended.faces)
    )
    is_turned = np.zeros(len(was_turned_before), np.bool_)
    is_turned[cleaned.turned] = True
    return int((is_turned ^ was_turned_before)[cleaned.kept_faces].sum())


# Loose triangles joined.


def _weld_loose(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Stage "welded" of the repair, for loose triangles, which share no vertices: merge corners of
    the damaged mesh `intended` that are near to each other, clean the mesh and fill its holes.
    Vertices move, so no triangle counts as kept.

    settings: the options of the repair.

    Returns:
        The closed mesh; and its entries in `metadata["harnack"]`.

    Raises:
        MeshError, MeshingError: the triangles are not loose, or the mesh cannot be cleaned.
    """
    mesh_arrays = without_zero_area_faces(intended.vertices, intended.faces)
    vertices, faces, moved = weld_near_corners(*mesh_arrays)
    made = clean_and_fill(vertices, faces, settings.report)
    joined_count = len(made.kept_faces)
    return made.surface, {
        "stage": "welded",
        "kept": 0,
        "joined": joined_count,
        "moved": moved,
        "turned": len(made.turned),
        "left_out": made.left_out | {"flat": len(intended.faces) - len(faces)},
        "holes": made.holes,
        "patches": len(made.surface.faces) - joined_count,
        "harmonic": 0,
    }


# All kept.


def _fill_only(
    intended: IntendedSolid, settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Stage "filled" of the repair: keep all triangles of the damaged mesh `intended`, and fill its
    holes.

    settings: the options of the repair.

    If smooth fillings were asked for and cannot be made, all holes get harmonic fillings instead,
    provided that `keep` is "all"; otherwise the error is raised, and `repair` tries its next stage.

    Returns:
        The closed mesh; and its entries in `metadata["harnack"]`.

    Raises:
        MeshError: some triangles cannot be kept (`_vertices_and_faces_to_keep`), a component is
            inside out, or, unless `keep` is "all", triangles intersect.
        MeshingError: the fillings cannot be made.
    """
    vertices, faces = _vertices_and_faces_to_keep(intended)
    if intended.is_turned.any():
        raise MeshError("a part of the mesh is inside out")
    edges = checked_boundary_edges(faces)
    # With keep="all" crossing triangles stay as well.
    if settings.keep is None and len(crossing := intersecting_faces(vertices, faces)):
        raise MeshError(f"{len(crossing):,} triangles of the mesh pass through others")
    loops = hole_loops(vertices, faces, edges)
    if settings.patches == "smooth":
        try:
            return _with_filled_holes(vertices, faces, loops, settings)
        except MeshingError as error:
            if settings.keep is None:
                raise
            settings.report(f"{error}; once more, with harmonic patches alone")
    return _with_filled_holes(
        vertices, faces, loops, dataclasses.replace(settings, patches="harmonic")
    )


def _vertices_and_faces_to_keep(intended: IntendedSolid) -> tuple[FloatArray, IntArray]:
    """The vertices (n, 3) and faces (m, 3) of the input, checked so that all of its triangles can
    be kept.

    Raises:
        MeshError: several vertices are at the same place, or `validate_mesh` rejects the mesh.
    """
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


def _with_filled_holes(
    vertices: FloatArray, faces: IntArray, loops: list[IntArray], settings: _RepairOptions
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Fill the holes of a mesh.

    vertices, faces: (n, 3), (m, 3) the mesh.
    loops: for each hole, the indices (k,) of the vertices around it. A hole gets a smooth filling
        if the options ask for these; a harmonic filling if they do not, or if the smooth one fails.
    settings: the options of the repair.

    Returns:
        The closed mesh; and its entries in `metadata["harnack"]`.

    Raises:
        MeshingError: the fillings cannot be made, or meet the mesh or each other; or, unless `keep`
            is "all", more than 1000 boundary edges are left without a smooth filling.
        MeshError: unless `keep` is "all": a component of the result is inside out, or lies in
            another one.
    """
    all_vertices, all_faces, unfilled_loops = vertices, faces, loops
    if loops and settings.patches == "smooth":
        settings.report(f"filling {len(loops):,} holes")
        field = WindingNumber(vertices, faces)
        made = fill_holes(vertices, faces, loops, lambda p: field.value(p, precision="double"))
        all_vertices, all_faces = (
            np.concatenate([all_vertices, made.vertices]),
            np.concatenate([faces, made.faces]),
        )
        unfilled_loops = made.unfilled_loops
        settings.report(
            f"{len(unfilled_loops):,} holes are left" + f": {made.reason}" * bool(unfilled_loops)
        )
    # No harmonic filling so far: no vertices, no faces.
    harmonic = HarmonicFilling(vertices[:0], faces[:0], True, 0.0, 0)
    if unfilled_loops:
        edges = checked_boundary_edges(all_faces)
        if settings.keep is None and len(edges) > _FEW_EDGES:
            raise MeshingError(
                f"{len(unfilled_loops):,} holes of {len(edges):,} edges have no smooth patch"
            )
        attempts = _ATTEMPTS if settings.keep == "all" else _FEW_ATTEMPTS
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
        _check_touching(all_faces)
    if settings.keep is None:
        _check_sides(surface)
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


def _check_sides(surface: TriangleMesh) -> None:
    """Raise a MeshError if a component of a mesh is inside out, lies in the material of another
    one, or passes through itself or another one.

    A component at an even depth of nesting bounds material, one at an odd depth a cavity."""
    shells = Shells.of(surface)
    depths = shells.nesting_depths()
    if ((shells.volumes < 0) & (depths == 0)).any():
        raise MeshError("a part of the mesh is inside out")
    if ((shells.volumes > 0) & (depths > 0)).any():
        raise MeshError("a part of the mesh is inside the material of another one")
    if passes_itself(surface, shells.component_of_face):
        raise MeshError("the mesh passes through itself along edges that lie on faces")


def _check_touching(faces: IntArray) -> None:
    """Raise a MeshingError if, at some vertex of the mesh, the faces around it are not all
    connected by shared edges: two sheets touch only in that vertex."""
    if len(places := nonmanifold_vertices(faces)):
        raise MeshingError(
            f"faces touch in {len(places):,} vertices alone, such as vertex {places[0]}: such a "
            "mesh has no two sides there"
        )
