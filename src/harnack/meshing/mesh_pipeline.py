"""Meshes of level sets: `mesh`."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from harnack.backend.validation import flag
from harnack.fields import Field, Solid
from harnack.fields.field import check_is_field
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry import Box, Volume
from harnack.meshing.bcc_lattice import BccLattice
from harnack.meshing.checks import (
    EmptySurfaceError,
    MeshingError,
    TriangleLimitError,
    check_inside,
    check_manifold,
    check_near_level,
    check_no_self_intersection,
    is_retry_promising,
)
from harnack.meshing.clipping import clip_to_volume, largest_body, largest_component
from harnack.meshing.closed_mesh import box_manifold, from_manifold, to_manifold, volume_manifold
from harnack.meshing.csg_meshing import (
    AngleMesher,
    mesh_solid,
    solid_and_level,
    solid_value_range,
)
from harnack.meshing.curve_spanning import mesh_spanning_curve
from harnack.meshing.finishing import (
    check_options,
    simplify_mesh,
    thicken,
    to_trimesh,
    vertex_normals,
)
from harnack.meshing.lattice_meshing import TriangleMesh, mesh_open_surface
from harnack.meshing.level_function import CELLS_PER_WAVE, MOST_FACES, LevelFunction
from harnack.meshing.lost_parts import LostParts
from harnack.meshing.mesh_tolerance import MeshTolerance
from harnack.meshing.sign_function import (
    SignFunction,
    cell_size_for_smoothing,
    empty_surface_hint,
    uses_sign_meshing,
)
from harnack.meshing.sign_isosurface import (
    CELL_REFINEMENT_FACTOR,
    MAX_OFF_LEVEL_FRACTION,
    mesh_from_signs,
)
from harnack.progress import teller
from harnack.tracer import Surface
from harnack.tracer.surface import intersection_of
from harnack.tracer.trace_options import SURFACE_OPTIONS, shows_keywords, surface_and_options

if TYPE_CHECKING:
    from collections.abc import Callable

    import trimesh
    from manifold3d import Manifold
    from typing_extensions import Unpack

    from harnack.backend import FloatArray
    from harnack.tracer import TraceKeywords, TraceOptions

__all__ = ["mesh"]

_HONORED = (*SURFACE_OPTIONS, "tolerance")

# The number of cells along the longest side of the level set's box, if no cell size is given, and
# the number of cell sizes that are tried; then the same for meshes by signs.
_CELLS_ACROSS = 24
_MAX_ATTEMPTS = 4
_SIGN_CELLS_ACROSS, _MAX_SIGN_ATTEMPTS = 48, 2
# Margins of the meshing box, as fractions of its size: around the extent of a level set; and around
# a curve whose surface has no extent.
_EXTENT_MARGIN = 0.01
_CURVE_MARGIN = 0.05


@shows_keywords(*_HONORED)
def mesh(
    surface: Field | Surface,
    *,
    cell_size: float | None = None,
    thickness: float | None = None,
    simplify: bool = False,
    max_triangles: int = MOST_FACES,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> trimesh.Trimesh:
    """Triangles of a level set, or the closed surface of a solid.

    An octree finds the cells around the level set: all others are proved empty. The tetrahedra of
    these cells are cut by the level set. Then edges are split and vertices moved onto the surface,
    until midpoints of edges and centers of triangles are within the tolerance. The surface of an
    angle ends exactly at its curve. A solid is made of the meshes of smooth level sets by
    manifold3d, which also cuts it by the clip.

    Fields that are sums over meshes, points and blobs (`WindingNumber`, `DipolePotential`,
    `ScreenedWindingNumber`, `Morph`, `HRBF`, `Blobs`) are meshed by the signs of their values alone
    (`meshing.sign_isosurface`). This gives a closed surface, whatever the mesh or the cloud is.
    Vertices lie where edges of the cells meet the level, so exactly on the triangles of a valid
    mesh. Parts of the surface that are thinner than a cell, or nearer to each other, may be missed
    or joined: that is tested at about three thousand points of the level (`meshing.lost_parts`),
    and a warning says so. If the mesh of a `WindingNumber` is its own spanning surface, as in the
    file of a mesh of a `SolidAngle`, its triangles are kept as they are, whatever tolerance, cell
    size and seed are.

    surface: a field or a `Surface`, of one level (two for side="between"). The field is a
        `SolidAngle` of polygons, a continuous real-valued function, or one of those above. A
        surface ends where clip, section or the field's domain cut it; a solid (`side`) is closed
        there. A clip is needed if the level set has no extent. For a `Solid`, the solid
        f <= level is meshed, unless side="surface" asks for the level set alone, which is open
        where it is cut. `largest` keeps a single connected component: of a surface the one of
        largest area; of a closed mesh the one of largest volume, with its cavities.
    cell_size: the size of cells before refinement, in the field's unit. None is 1/24 of the longest
        side of the level set's box (1/48 for meshes by signs), and at most a fifth of the
        wavelength for waves (`Field.min_wavelength`). If the mesh joins parts of the surface that
        are nearer to each other, smaller cells are tried, or a MeshingError says so.
    thickness: makes a closed part of this thickness out of a surface, in the field's unit: half of
        it on each side.
    simplify: for closed meshes, whether to remove vertices that are not needed. All triangles stay
        within the tolerance of the mesh that is made without this; its midpoints of edges are
        within half of the tolerance of the surface.
    seed: of the small random moves that keep points in general position.
    max_triangles: the largest number of triangles of a level set, before simplification. If there
        would be more, a MeshingError is raised. The number of cells is limited as well, to at most
        two millions.
    progress: a function that is called with a text about each stage.
    options: a `TraceOptions`; meshes use its `tolerance` alone, the largest distance of triangles
        from the surface, sampled and not proved. None is 1e-3 of the longest side of the level
        set's box.
    keywords: those of `Surface` for a bare field, and `tolerance` in place of `options`.

    The result has been checked: every edge has two faces, or one at the boundary; no two triangles
    intersect; and vertices and centers of triangles are within the tolerance of the level, by
    samples of the field, and inside the clip. (For a thick part, the latter is checked for the
    surface that it is made of.) If a check fails, a MeshingError is raised. Meshes by signs differ
    in the check of distances: if more than one in a hundred vertices and centers are beyond the
    tolerance, smaller cells are tried; if that is not enough, a warning says how many there are and
    how far they are; and a MeshingError is raised if some are farther than a few cells. The same is
    done if parts of the level set are missing.

    Returns:
        A trimesh.Trimesh. If it is closed, its method `export` writes closed files, in single
        precision, or raises a MeshingError. Vertices of a curve come first, in order and bit by
        bit, and its edges are the boundary. A mesh without a boundary faces outwards: its volume is
        positive; a mesh with a boundary faces towards larger values. `metadata["harnack"]` has
        level, spacing, evaluations, the Euler characteristic,
        boundary: indices (k, 2) of the edges with one face;
        creases: the number of edges whose faces differ by more than 30 degrees. A function with
            kinks, such as |x| or max(f, g), has them where its level set does. Their distance is
            checked at midpoints of edges and centers of triangles; nothing is proved there;
        proved, integrated: how many changes of an angle along edges of tetrahedra are proved to be
            differences of wrapped values, and how many were integrated;
        isotopy, isotopy_far: the fractions of tetrahedra on which the first triangles are proved to
            have the topology of the level set (`meshing.isotopy`), among all, and among those
            farther than 1.5 times the spacing from the curve;
        turned: the number of triangles of an angle, smaller than the tolerance, that are reversed.
        For meshes by signs, made_by is "signs", and there are
        far, looked_at, within: the number of vertices and triangle centers beyond the tolerance,
            the number of all, and a distance within which all are, sampled up to a factor of 2;
        lost, sought: the number of points of the level that are beyond the tolerance from the mesh,
            and the number tested: on triangles of a mesh, at points of a cloud, on rays out of
            blobs;
        undecided: the number of points of the lattice at which the error of f leaves its sign open;
        flat: the number of triangles that were not fitted to creases, as they would have
            intersected others.
        If the triangles of a mesh were kept, made_by is "faces", and the others are missing.
        cloud: for a `DipolePotential`, its `describe`, such as the number of points, the quantities
            that were estimated, and the smoothing and noise that were chosen and found.

        For solids and thick surfaces there is more: see `docs/printing.md`.

    Raises:
        MeshingError: a ValueError: the mesh could not be made; the message says why.
        TypeError: a field that has patches; a clip that is no volume; an option of traces that
            meshes do not have; keywords beside an object that holds them.
        ValueError: options out of range, or that contradict each other; several levels.
    """
    target, choices = surface_and_options("mesh", surface, options, keywords, _HONORED)
    mesh_tolerance = MeshTolerance.of(choices)
    check_options(cell_size, thickness, seed, max_triangles)
    simplify, largest = flag(simplify, "simplify"), target.largest > 0
    report = teller(progress)
    field, level, solid = _meshable_field(target.field), *_level_and_solid(target, thickness)
    is_closed = bool(solid) or thickness is not None
    if simplify and not is_closed:
        raise ValueError('simplify is for closed meshes: give side="below" or thickness as well')
    volume = intersection_of([field.domain, target.clip, target.section])
    settings = _MeshOptions(volume, mesh_tolerance, cell_size, seed, max_triangles, report)
    if uses_sign_meshing(field):
        raw = _mesh_from_signs(field, level, solid, thickness is not None, settings)
    elif solid:
        raw = _mesh_solid(field, level, solid, settings)
    else:
        raw = _mesh_level_set(field, level, settings)
    triangles, facts = raw.surface, dict(raw.facts)
    if solid:
        facts["side"] = target.side or "below"
    else:
        triangles = largest_component(triangles) if largest else triangles
        raw.check_level(triangles)
    tolerance = mesh_tolerance.at(raw.size)
    if thickness is not None:
        report("thickening")
        normals = vertex_normals(raw.function, triangles)
        triangles, new_facts = thicken(triangles, normals, float(thickness), 0.5 * tolerance)
        facts |= new_facts
    if largest and is_closed:
        triangles = largest_body(triangles)

    def check(candidate: TriangleMesh) -> None:
        """Raise a MeshingError unless the mesh is manifold and, for a solid, near the level."""
        if solid:
            raw.check_level(candidate)
        check_manifold(candidate.faces)

    if not raw.is_checked:
        report("checking")
        check(triangles)
        check_no_self_intersection(triangles.vertices, triangles.faces)
    if simplify:
        report("simplifying")
        triangles, new_facts = simplify_mesh(triangles, tolerance, check)
        facts |= new_facts
    return to_trimesh(triangles, facts, is_closed)


@dataclass(frozen=True)
class _MeshOptions:
    """The arguments of `mesh`, validated.

    volume: the intersection of clip, section and the field's domain, which cuts the level set; None
        for none.
    spacing: the size of the first cells, None for a default.
    most_faces: the largest number of triangles.
    report: is told what is being done.
    """

    volume: Volume | None
    tolerance: MeshTolerance
    spacing: float | None
    seed: int
    most_faces: int
    report: Callable[[str], None]


@dataclass(frozen=True)
class _RawMesh:
    """A mesh before it is thickened or simplified.

    surface: the triangles.
    size: the longest side of the box that was meshed.
    facts: entries of the metadata.
    function: the function of which the surface is a level set.
    check_level: raises a MeshingError unless a surface is within the tolerance of the level.
    is_checked: whether the surface is already known to be near the level, to be a manifold, and not
        to intersect itself.
    """

    surface: TriangleMesh
    size: float
    facts: dict[str, Any]
    function: LevelFunction
    check_level: Callable[[TriangleMesh], None]
    is_checked: bool


def _mesh_from_signs(
    field: Field,
    level: float | None,
    solid: tuple[float, float] | bool,
    is_thick: bool,
    settings: _MeshOptions,
) -> _RawMesh:
    """Mesh a level set, or the closed surface of a solid, from the signs of f - level.

    level: of the level set; None for the field's default.
    solid: the values (low, high) between which the inside of a solid lies; True for the inside of a
        `Solid`, False for a level set.
    is_thick: whether the surface is to be thickened.

    Raises:
        MeshingError: as `mesh_from_signs`; the level set is empty, or the mesh is not near the
            level at all.
    """
    ends = _sign_value_range(field, level, solid, is_thick)
    levels = tuple(end for end in ends if math.isfinite(end))
    if isinstance(field, WindingNumber) and field.is_of_sheets_alone(levels):
        return _keep_faces(field, levels[0], solid, settings)
    volume, box = settings.volume, _meshing_box(field, levels, settings.volume)
    size = float((box.upper - box.lower).max())
    cell_size, attempts = _sign_cell_size(field, size, settings.spacing)
    # If the surface does not end at the box, its cells are shifted off the symmetry planes.
    margin = np.zeros(3) if box.has_walls else size * np.array([0.0037, 0.0053, 0.0029])
    bounds = box.lower - margin, box.upper + 0.5 * margin
    facts: list[dict[str, Any]] = []
    losses: list[LostParts] = []

    def sign_function(value: float, side: float) -> SignFunction:
        """The sign of side * (f - value), sampled in the cells."""
        return SignFunction.of(
            field, value, bounds, cell_size, side=side, most_faces=settings.most_faces
        )

    is_apart = False

    def mesh_level(value: float, side: float, closed: bool) -> TriangleMesh:
        """The mesh of the level `value`, from the sign of side * (f - value); closed: along the
        faces of the box as well. Its facts and lost parts are added to the lists."""
        nonlocal is_apart
        try:
            made, lost, new_facts = mesh_from_signs(
                sign_function(value, side),
                bounds,
                cell_size,
                settings.tolerance.at(size),
                attempts,
                settings.report,
                closed=closed,
                volume=settings.volume,
            )
        except EmptySurfaceError as error:
            raise EmptySurfaceError(f"{error}{empty_surface_hint(field)}") from error
        facts.append(new_facts)
        losses.append(lost)
        is_apart = made.is_intersection_free
        return made.surface

    if not solid:
        made = mesh_level(levels[0], 1.0, False)
        if volume is not None and not (isinstance(volume, Box) and box.has_walls):
            made, is_apart = clip_to_volume(made, volume), False
    elif volume is None and ends[1] == math.inf:
        made = mesh_level(levels[0], -1.0, False)
    else:
        body = box_manifold(box.lower, box.upper)
        if math.isfinite(ends[0]):
            body = to_manifold(mesh_level(ends[0], -1.0, True))
        if math.isfinite(ends[1]):
            body = body - to_manifold(mesh_level(ends[1], -1.0, True))
        if field.has_jumps and len(levels) == 2:
            _check_has_thickness(field, body, ends, settings.tolerance.at(size))
        cut_volume = volume or Box(tuple(box.lower.tolist()), tuple(box.upper.tolist()))
        body ^= volume_manifold(cut_volume, box.lower, box.upper, 0.5 * settings.tolerance.at(size))
        made, is_apart = from_manifold(body), False
    if not len(made.faces):
        raise MeshingError("the level set is empty: it lies outside of the clip")
    if is_apart:
        check_manifold(made.faces)
    all_facts = {"level": levels[0], **_merge_facts(facts)}
    if isinstance(field, DipolePotential):
        all_facts["cloud"] = field.describe()
    is_warned = _check_sign_accuracy(field, all_facts, settings.tolerance.at(size))
    _warn_of_lost_parts(field, losses, is_warned)
    return _RawMesh(made, size, all_facts, sign_function(levels[0], 1.0), _accept_any, is_apart)


def _sign_value_range(
    field: Field,
    level: float | None,
    solid: tuple[float, float] | bool,
    is_thick: bool,
) -> tuple[float, float]:
    """The values (low, high) of f between which the inside of a solid lies. For a level set that is
    not closed: its level, and infinity.

    solid: as in `_mesh_from_signs`.

    Raises:
        TypeError: a surface that jumps is to be thickened.
        ValueError: the field has no such level.
    """
    if is_thick and field.has_jumps:
        raise TypeError(
            f"{type(field).__name__} jumps, and its surface has no normals to thicken it "
            "along: mesh it, and move the mesh's vertices instead"
        )
    if solid:
        return solid_value_range(field, solid, level)
    level = field.default_level if level is None else float(level)
    field.validate_levels((level,))
    return level, math.inf


def _sign_cell_size(field: Field, size: float, spacing: float | None) -> tuple[float, int]:
    """The size of cells for meshes by signs, and the number of sizes that may be tried. size: of
    the box; spacing: the prescribed cell size, or None."""
    if spacing is not None:
        return float(spacing), 1
    cell_size, attempts = size / _SIGN_CELLS_ACROSS, _MAX_SIGN_ATTEMPTS
    detailed = cell_size_for_smoothing(
        field, cell_size, CELL_REFINEMENT_FACTOR, CELL_REFINEMENT_FACTOR**2
    )
    # A field with more detail begins with the cells that would be tried next.
    return (detailed, attempts - 1) if detailed < cell_size else (cell_size, attempts)


def _keep_faces(
    field: WindingNumber,
    level: float,
    solid: tuple[float, float] | bool,
    settings: _MeshOptions,
) -> _RawMesh:
    """The raw mesh of a winding number whose level set consists of all triangles of its mesh: these
    triangles, cut by the volume.

    Raises:
        MeshingError: a solid is wanted; the surface is empty; it has too many triangles.
    """
    if solid:
        raise MeshingError(
            "this mesh is a sheet that lies on its own spanning surface, so that nothing is inside "
            "of it: mesh the SolidAngle of its boundary with thickness=..."
        )
    vertices, faces = field.mesh.vertices, field.mesh.faces
    size = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    surface = TriangleMesh.without_unused_vertices(vertices, faces)
    if settings.volume is not None:
        surface = clip_to_volume(surface, settings.volume)
    if not len(surface.faces):
        raise MeshingError("the level set is empty: it lies outside of the clip")
    if len(surface.faces) > settings.most_faces:
        raise TriangleLimitError(
            f"{len(surface.faces):,} triangles of the mesh are its surface, and max_triangles is "
            f"{settings.most_faces:,}: choose a larger `max_triangles`, or a smaller `clip`"
        )
    facts = {"level": level, "made_by": "faces", "spacing": math.nan, "evaluations": 0}
    function = LevelFunction(field, level, most_faces=settings.most_faces)
    return _RawMesh(surface, size, facts, function, _accept_any, False)


def _check_has_thickness(
    field: Field, body: Manifold, value_range: tuple[float, float], tolerance: float
) -> None:
    """Raise a MeshingError if a body between two levels has no thickness, as the field jumps across
    both levels at the same triangles."""
    if 2 * abs(body.volume()) < tolerance * body.surface_area():
        low, high = (f"{value:g}" for value in value_range)
        raise MeshingError(
            f"the part between the levels {low} and {high} of this {type(field).__name__} has no "
            f'thickness: it jumps across both at its triangles; for the inside give side="above"'
        )


def _merge_facts(facts: list[dict[str, Any]]) -> dict[str, Any]:
    """The facts of the one or two surfaces of a solid, merged: sums of counts, maxima of
    lengths."""
    sums = ("evaluations", "undecided", "flat", "far", "looked_at", "lost", "sought")
    maxima = {key: max(entry[key] for entry in facts) for key in ("spacing", "within")}
    return {**facts[0], **maxima, **{key: sum(entry[key] for entry in facts) for key in sums}}


def _check_sign_accuracy(field: Field, facts: dict[str, Any], tolerance: float) -> bool:
    """Warn if more than the permitted fraction of vertices and triangle centers are farther from
    the level than the tolerance. Returns whether that is so.

    Raises:
        MeshingError: some of them are farther from the level than several cells.
    """
    far, count, within = facts["far"], facts["looked_at"], facts["within"]
    kind = type(field).__name__
    if not math.isfinite(within):
        raise MeshingError(
            f"some of {far:,} vertices and centers of triangles are farther than several cells "
            f"from where the sign of {kind} changes: its values are not what it promises there; "
            "choose a smaller `cell_size`, or a `clip` without these places"
        )
    if far > MAX_OFF_LEVEL_FRACTION * count:
        warnings.warn(
            f"{far:,} of {count:,} vertices and centers of triangles are farther from the level of "
            f"this {kind} than the tolerance, which is {tolerance:.3g}; all are within "
            f"{within:.3g}. The level is rough there, or has parts that are nearer to each other "
            f"than its cells of {facts['spacing']:.3g} are wide: choose a smaller `cell_size`, or "
            "a "
            "larger `tolerance`",
            stacklevel=4,
        )
    return far > MAX_OFF_LEVEL_FRACTION * count


def _warn_of_lost_parts(field: Field, losses: list[LostParts], is_warned: bool) -> None:
    """Warn if parts of the level set are missing from the mesh.

    is_warned: whether a warning has already said that the mesh is coarse; then only thin parts are
        worth another.
    """
    for lost in losses:
        if lost.matter and (lost.show_thin_parts or not is_warned):
            warnings.warn(
                f"the mesh is not quite the level of this {type(field).__name__}: {lost}; "
                f"{lost.advice}",
                stacklevel=4,
            )


def _accept_any(surface: TriangleMesh) -> None:
    """The `check_level` of meshes by signs: accepts every surface, as its distance from the level
    was measured when it was made."""


def _level_and_solid(
    surface: Surface, thickness: float | None
) -> tuple[float | None, tuple[float, float] | bool]:
    """The level of a surface, and the range (low, high) of values inside the solid that is meshed
    in its place: True for the points of a `Solid`, False for a level set. The level is None where
    the range says all.

    Raises:
        ValueError: several levels; a solid that is to be thickened.
    """
    if thickness is not None and surface.solid_range is not None:
        raise ValueError("give either side or thickness, not both: a solid has an inside already")
    if surface.side == "between":
        return None, surface.level_values  # pyright: ignore[reportReturnType]
    if len(surface.levels) > 1:
        numbers = ", ".join(f"{level:g}" for level in surface.level_values)
        raise ValueError(
            f"there are {len(surface.levels)} levels ({numbers}), and a mesh is of one: mesh one "
            f"after the other, with level={surface.level_values[0]:g} and so on, or the solid "
            'between two of them (side="between")'
        )
    level = surface.level_values[0]
    if isinstance(surface.field, Solid) and surface.side in (None, "below"):
        return level, thickness is None
    solid = surface.solid_range
    return (level, False) if solid is None else (None, solid)


def _check_level(
    function: LevelFunction, surface: TriangleMesh, tolerance: float, volume: Volume | None
) -> None:
    """Raise a MeshingError unless a surface is within the tolerance of the level, and inside the
    volume."""
    if volume is not None:
        check_inside(surface.vertices, volume, tolerance)
    check_near_level(function, surface.vertices, surface.faces, tolerance, volume)


def _meshable_field(field: Field) -> Field:
    """The field, if it can be meshed; a `SolidAngle` as a new one of its loops alone.

    Raises:
        TypeError: a field that is not one continuous function, has circles, or is periodic.
    """
    check_is_field(field)
    if field.has_patches or (field.has_jumps and not uses_sign_meshing(field)):
        raise TypeError(
            f"{type(field).__name__} is not one continuous function: mesh its parts, or the "
            "solid angle of its boundary"
        )
    if isinstance(field, SolidAngle):
        if field.circles:
            raise TypeError(
                "the mesh of a circle ends on a polygon: give circle.polygon(n) in its place"
            )
        return SolidAngle(list(field.loops))
    if field.period is not None:
        raise TypeError(
            f"{type(field).__name__} is angle-valued, and mesh() knows of no other angle-valued "
            "field than SolidAngle where its surfaces end"
        )
    return field


def _mesh_solid(
    field: Field,
    level: float | None,
    solid: tuple[float, float] | Literal[True],
    settings: _MeshOptions,
) -> _RawMesh:
    """The closed surface of a solid that is made of smooth level sets.

    solid: as in `_mesh_from_signs`.
    """
    region = LevelFunction(*solid_and_level(field, solid, level), most_faces=settings.most_faces)
    evaluations = [0]

    def angle_mesher(error: float, cell_size: float) -> AngleMesher:
        """A function that meshes a level of an angle, for operands of the solid, with cells of that
        size and within the distance `error`."""

        def mesh_angle(angle: SolidAngle, value: float) -> TriangleMesh:
            """Mesh the level `value` of an angle, and count its evaluations."""
            angle = cast("SolidAngle", _meshable_field(angle))
            box = _meshing_box(angle, (value,), None)
            function = LevelFunction(angle, value, most_faces=settings.most_faces)
            made, facts = _mesh_spanning_curve(
                function, box, error, cell_size, 1, settings.seed, settings.report
            )
            evaluations[0] += facts["evaluations"]
            return made

        return mesh_angle

    def check_level(made: TriangleMesh, size: float) -> None:
        """Raise a MeshingError unless a surface is near the level and in the volume."""
        _check_level(region, made, settings.tolerance.at(size), settings.volume)

    def check(made: TriangleMesh, size: float) -> None:
        check_manifold(made.faces, made.vertices)
        check_level(made, size)

    made = mesh_solid(
        cast("Solid", region.field),
        region.level,
        settings.volume,
        settings.tolerance,
        settings.spacing,
        angle_mesher,
        settings.most_faces,
        check,
        settings.report,
    )
    facts = {
        "level": region.level,
        "spacing": made.spacing,
        "evaluations": made.evaluations + evaluations[0],
        "surfaces_with_options": made.levels,
    }
    return _RawMesh(
        made.surface,
        made.size,
        facts,
        region,
        lambda surface: check_level(surface, made.size),
        True,
    )


def _mesh_level_set(field: Field, level: float | None, settings: _MeshOptions) -> _RawMesh:
    """Mesh a level set of an angle, or of a function that is smooth nearly everywhere."""
    level = field.default_level if level is None else float(level)
    function = LevelFunction(field, level, most_faces=settings.most_faces)
    field.validate_levels((level,))
    volume, report = settings.volume, settings.report
    box = _meshing_box(field, (level,), volume)
    size = float((box.upper - box.lower).max())
    error = 0.5 * settings.tolerance.at(size)
    cell_size = size / _CELLS_ACROSS if settings.spacing is None else float(settings.spacing)
    if settings.spacing is None and field.min_wavelength is not None:
        cell_size = min(cell_size, field.min_wavelength / CELLS_PER_WAVE)
    attempts = 1 if settings.spacing is not None else _MAX_ATTEMPTS
    if isinstance(field, SolidAngle):
        made, facts = _mesh_spanning_curve(
            function, box, error, cell_size, attempts, settings.seed, report
        )
    else:
        made, facts = _mesh_in_lattice(function, box, error, cell_size, attempts, report)
    if volume is not None and not (isinstance(volume, Box) and box.has_walls):
        made = clip_to_volume(made, volume)
        if not len(made.faces):
            raise MeshingError("the level set is empty: it lies outside of the clip")

    def check_level(surface: TriangleMesh) -> None:
        _check_level(function, surface, settings.tolerance.at(size), volume)

    return _RawMesh(made, size, {"level": level, **facts}, function, check_level, False)


def _mesh_in_lattice(
    function: LevelFunction,
    box: _MeshingBox,
    tolerance: float,
    spacing: float,
    attempts: int,
    report: Callable[[str], None],
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Mesh the level set of a real-valued field in a box, in cells of a lattice of that spacing;
    smaller cells are tried if a check fails. Returns the triangles and their facts.

    attempts: the number of cell sizes that may be tried.
    """
    last_error: MeshingError | None = None
    while True:
        report(f"cells of {spacing:.3g}")
        try:
            lattice = BccLattice.covering_box(box.lower, box.upper, spacing)
            made, isotopy = mesh_open_surface(function, lattice, tolerance, report)
            check_manifold(made.faces, made.vertices)
            check_near_level(function, made.vertices, made.faces, 2 * tolerance, None)
            check_no_self_intersection(made.vertices, made.faces)
            break
        except MeshingError as wrong:
            attempts -= 1
            if not attempts or not is_retry_promising(
                wrong, last_error, CELL_REFINEMENT_FACTOR**attempts
            ):
                raise
            last_error, spacing = wrong, CELL_REFINEMENT_FACTOR * spacing
            report(f"{wrong}; so smaller cells")
    facts = {
        "spacing": spacing,
        "evaluations": function.evaluations,
        "proved": 0,
        "integrated": 0,
        **isotopy.shares(),
    }
    return made, facts


def _mesh_spanning_curve(
    function: LevelFunction,
    box: _MeshingBox,
    tolerance: float,
    spacing: float,
    attempts: int,
    seed: int,
    report: Callable[[str], None],
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Mesh the level set of an angle, which ends at its curve. Returns the triangles and their
    facts.

    attempts: the number of cell sizes that may be tried.
    """
    bounds = box.lower, box.upper
    mesh = mesh_spanning_curve(
        function, spacing, attempts, bounds, box.has_walls, seed, tolerance, report
    )
    facts = {
        "spacing": mesh.spacing,
        "evaluations": function.evaluations,
        "proved": mesh.crossings.proved,
        "integrated": mesh.crossings.integrated_count,
        **mesh.isotopy.shares(),
        "turned": mesh.turned,
    }
    return TriangleMesh.without_unused_vertices(mesh.vertices, mesh.faces), facts


@dataclass(frozen=True)
class _MeshingBox:
    """The box that is meshed.

    lower, upper: its corners, (3,).
    has_walls: whether the surface may end at the faces of the box.
    """

    lower: FloatArray
    upper: FloatArray
    has_walls: bool


def _meshing_box(field: Field, levels: tuple[float, ...], volume: Volume | None) -> _MeshingBox:
    """The box that is meshed: around the level sets, if these have an extent, and inside the
    volume's bounds.

    Raises:
        MeshingError: neither has finite bounds, or they do not intersect.
    """
    extent, level = field.extent(levels), levels[0]
    if volume is None and extent is None and isinstance(field, SolidAngle):
        raise MeshingError(
            f"level {level:g} is a multiple of 4 pi: the surface of a curve has no end there; "
            "choose a level between them, such as 2 pi, or give a clip, such as a box"
        )
    if volume is None and extent is None:
        raise MeshingError(
            f"{type(field).__name__} does not say where its level {level:g} ends: give a "
            "clip, such as a box (harnack.Box)"
        )
    if isinstance(field, SolidAngle):
        return _curve_box(field, extent, volume)
    lower, upper = _bounds_of(extent if volume is None else volume)
    if volume is not None and extent is not None and extent != volume:
        # With a margin, so that a surface that touches its extent does not end at the box.
        low, high = _bounds_of(extent)
        pad = _EXTENT_MARGIN * float((high - low).max())
        if math.isfinite(pad):
            lower, upper = np.maximum(lower, low - pad), np.minimum(upper, high + pad)
    elif volume is None:
        pad = _EXTENT_MARGIN * (upper - lower).max()
        lower, upper = lower - pad, upper + pad
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise MeshingError(
            f"the clip {volume} has no bounds, and {type(field).__name__} does not say where its "
            f"level {level:g} ends: give a clip with bounds"
        )
    if not (lower < upper).all():
        raise MeshingError("the level set is empty: it lies outside of the clip")
    return _MeshingBox(lower, upper, volume is not None)


def _curve_box(field: SolidAngle, extent: Volume | None, volume: Volume | None) -> _MeshingBox:
    """The box around the whole surface that a curve spans, which is cut by the volume later. If the
    surface has no extent: the box around the curve and the volume.
    """
    if extent is not None:
        return _MeshingBox(*_bounds_of(extent), False)
    assert volume is not None
    points = np.concatenate(list(field.loops))
    low, high = _bounds_of(volume)
    lower, upper = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if not np.isfinite(upper - lower).all():
        raise MeshingError("the clip has no bounds: give a box or a ball")
    pad = _CURVE_MARGIN * (upper - lower).max()
    return _MeshingBox(lower - pad, upper + pad, True)


def _bounds_of(volume: Volume | None) -> tuple[FloatArray, FloatArray]:
    """The lower and upper corner of the volume, (3,) each."""
    assert volume is not None
    lower, upper = (np.array(corner, np.float64) for corner in volume.bounds())
    return lower, upper
