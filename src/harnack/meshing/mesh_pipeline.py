"""The function `mesh`: triangle meshes of level sets of a field, and closed meshes of solids. A
field is a function f of space. A solid is the set of points at which f lies between two values.
Three ways of meshing are combined here: in a lattice, for functions that are smooth nearly
everywhere; spanning a curve, for `SolidAngle`; and "by signs", for fields that jump or are rough,
from the signs of f - level alone.
"""

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
    check_inside,
    check_manifold,
    check_near_level,
    check_no_self_intersection,
)
from harnack.meshing.clipping import clip_to_volume
from harnack.meshing.closed_mesh import box_manifold, from_manifold, to_manifold, volume_manifold
from harnack.meshing.components import largest_body, largest_component
from harnack.meshing.csg_meshing import (
    AngleMesher,
    mesh_solid,
    solid_and_level,
    solid_size,
    solid_value_range,
)
from harnack.meshing.curve_spanning import mesh_spanning_curve
from harnack.meshing.finishing import check_options, simplify_mesh, to_trimesh, vertex_normals
from harnack.meshing.lattice_meshing import mesh_open_surface
from harnack.meshing.level_function import CELLS_PER_WAVE, MOST_FACES, LevelFunction
from harnack.meshing.lost_parts import LostParts
from harnack.meshing.mesh_tolerance import MeshTolerance
from harnack.meshing.meshing_errors import (
    CELL_SIZE_RATIO,
    EmptySurfaceError,
    MeshingError,
    TriangleLimitError,
    is_retry_promising,
)
from harnack.meshing.sign_function import (
    SignFunction,
    cell_size_for_smoothing,
    empty_surface_hint,
    uses_sign_meshing,
)
from harnack.meshing.sign_isosurface import (
    MAX_OFF_LEVEL_FRACTION,
    mesh_from_signs,
)
from harnack.meshing.singular_advice import singular_points_explained
from harnack.meshing.thickening import thicken
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.progress import ProgressFunction, show_progress
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

# The number of cells across the level set and the largest number of attempts, each with smaller
# cells, unless a cell size is given; then the same for meshing by signs.
_CELLS_ACROSS = 24
_MAX_ATTEMPTS = 4
_SIGN_CELLS, _SIGN_ATTEMPTS = 48, 2
# The margin of the box around a level set that has an extent, and of the box around a curve whose
# surface has none, as fractions of the box's size.
_MARGIN = 0.01
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
    progress: bool | ProgressFunction = False,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> trimesh.Trimesh:
    """Triangles of a level set, or the closed surface of a solid.

    How it is meshed depends on the field:

    - Smooth fields and angles. An octree finds the tetrahedra around the level set; cells are left
      out only if they are proved empty. The level set cuts the tetrahedra into triangles; the
      surface of an angle ends exactly at its curve. Then edges are split and vertices moved onto
      the surface, until the midpoints of edges and the centers of triangles are within the
      tolerance.
    - Solids. The meshes of smooth levels are put together by manifold3d, which also cuts them by
      the clip.
    - Sums over meshes, points and blobs (`WindingNumber`, `DipolePotential`,
      `ScreenedWindingNumber`, `Morph`, `HRBF`, `Blobs`). They are meshed by the signs of their
      values alone (`meshing.sign_isosurface`), which gives a closed surface whatever the mesh or
      the cloud is. Vertices lie where edges of the cells meet the level set, so on the triangles of
      a valid mesh themselves. Parts that are thinner than a cell, or nearer to each other, may be
      missed or joined. That is looked for at about three thousand points of the level set
      (`meshing.lost_parts`), and a warning says so.
    - A `WindingNumber` of a mesh that is its own spanning surface, such as a mesh of a
      `SolidAngle`. The triangles are kept as they are, whatever the tolerance, cell size and seed
      are.

    surface: a field or a `Surface`. The field is a `SolidAngle` of polygons, a continuous
        real-valued field, or one of those named above. There is one level, except with
        side="between". Surfaces end where the clip, the section or the field's domain cuts them;
        solids (`side`) are closed there. A clip is needed if the level set has no extent. The
        points of a `Solid` are those with f <= level, unless side="surface" asks for the level set
        alone, which is open where it is cut. `largest` keeps a single connected component: the one
        with the largest area of a surface, and the one with the largest volume, with its cavities,
        of a closed mesh.
    cell_size: the size of cells before refinement, in the field's unit. None chooses a 24th of the
        longest side of the box (a 48th for meshing by signs), and at most a fifth of the length of
        waves (`Traits.min_wavelength`). Sheets that are nearer to each other are told apart where
        that is noticed; otherwise a MeshingError says so.
    thickness: makes a closed part with this thickness of a surface, in the field's unit: half of it
        on each side.
    simplify: whether to remove vertices that are not needed within the tolerance; for closed
        meshes. The mesh that is simplified has midpoints of edges within half of the tolerance.
    seed: of the small random moves that keep points in general position.
    max_triangles: the largest number of triangles of one level set, before it is simplified. A mesh
        that would take more is not begun, or given up, with a MeshingError. It limits the number of
        cells too, as does a fixed limit of two million.
    progress: whether to show what is being done, or a function that is called with a `Progress`.
    options: a `TraceOptions`. Meshes use only its tolerance: the largest distance of triangles from
        the surface, which is sampled and not proved; None for 1e-3 of the longest side of the level
        set's box.
    keywords: the keywords of `Surface`, if `surface` is a field; and `tolerance` in place of
        `options`.

    The result has been checked, and a MeshingError is raised if a check fails: every edge has two
    faces, or one at the boundary; no two triangles pass through each other; and vertices and
    centers of triangles are within the tolerance of the level set, by samples of the field, and
    inside the clip (for a thickened surface, those of the surface before). For meshing by signs,
    the last check differs. If more than one in a hundred vertices and centers are farther than the
    tolerance, smaller cells are tried. If that is not enough, a warning says how many there are and
    how far they are; if some are farther than a few cells, a MeshingError is raised. Smaller cells
    are also tried, and a warning given, where parts of the level set are lost.

    Returns:
        A trimesh.Trimesh. If it is closed, its `export` writes closed files, in single precision,
        or raises a MeshingError. Vertices of a curve come first, in order, bit by bit, and the
        edges of the curve are the boundary. Without a boundary, faces are turned outwards, so that
        the volume is positive; otherwise they are turned towards larger values.
        `metadata["harnack"]` has level, spacing (the size of cells), evaluations, the Euler
        characteristic, and

        boundary: (k, 2) the vertices of the edges of one face;
        creases: the number of edges whose faces are more than 30 degrees apart. A function with
            kinks, such as |x| or max(f, g), has such edges where its level set does. Whether these
            are within the tolerance is checked at midpoints of edges and centers of triangles, and
            not proved;
        proved, integrated: the number of edges of tetrahedra along which the change of the function
            is proved to be the difference of wrapped values, and of those along which it was
            integrated;
        isotopy, isotopy_far: the fraction of the tetrahedra on which the first triangles are proved
            to have the topology of the level set (`meshing.isotopy`); the same among the tetrahedra
            farther than 1.5 times the spacing from the curve;
        turned: the number of triangles of an angle, smaller than the tolerance, that are turned
            over.

        For meshes by signs, made_by is "signs", and there are

        far, looked_at, within: the number of vertices and centers of triangles that are farther
            than the tolerance; the number of all that were tested; and a distance within which all
            are, too large by up to a factor of 2;
        lost, sought: the number of points of the level set that are farther than the tolerance from
            the mesh, and of all that were tested: on triangles of a mesh, at points of a cloud, on
            the way out of blobs;
        undecided: the number of points of the lattice at which the error of f leaves its sign open;
        flat: the number of triangles that were not fitted to creases, as they would pass through
            others;
        cloud: for a `DipolePotential`, what its `describe` returns, such as the number of points,
            what was estimated, and the smoothing and noise that were chosen and found.

        If the triangles of a mesh were kept, made_by is "faces", and these entries are missing.
        Solids and thickened surfaces have more entries: see `docs/printing.md`.

    Raises:
        MeshingError: a ValueError, if the surface could not be meshed; the message says why.
        TypeError: the field has patches; the clip is no volume; an option of traces that meshes do
            not have; keywords beside an object that holds them.
        ValueError: options are out of range or contradict each other; several levels.
    """
    target, trace_choices = surface_and_options("mesh", surface, options, keywords, _HONORED)
    accuracy = MeshTolerance.of(trace_choices)
    check_options(cell_size, thickness, seed, max_triangles)
    simplify = flag(simplify, "simplify")
    field, level, solid = _checked(target.field), *_level_and_solid(target, thickness)
    if simplify and not solid and thickness is None:
        raise ValueError('simplify is for closed meshes: give side="below" or thickness as well')
    volume = intersection_of([field.domain, target.clip, target.section])
    with show_progress("mesh", progress) as reporter:
        mesh_options = _MeshOptions(volume, accuracy, cell_size, seed, max_triangles, reporter.tell)
        # Three ways of meshing, by the kind of the field.
        if uses_sign_meshing(field):
            raw_mesh = _mesh_from_signs(field, level, solid, thickness is not None, mesh_options)
        elif solid:
            raw_mesh = _mesh_solid(field, level, solid, mesh_options)
        else:
            raw_mesh = _mesh_level_set(field, level, mesh_options)
        with singular_points_explained(field, raw_mesh.function, lambda: raw_mesh.size):
            return _finished(raw_mesh, target, solid, thickness, simplify, mesh_options)


def _finished(
    raw_mesh: _RawMesh,
    target: Surface,
    solid: tuple[float, float] | bool,
    thickness: float | None,
    simplify: bool,
    mesh_options: _MeshOptions,
) -> trimesh.Trimesh:
    """The result of `mesh`: a mesh that is thickened, reduced to its largest part, checked and
    simplified, as asked.

    raw_mesh: the mesh of the level set or solid.
    target: the surface that is meshed.
    solid: as returned by `_level_and_solid`.
    thickness, simplify: the arguments of `mesh`.
    mesh_options: the other arguments of `mesh`.

    Raises:
        MeshingError: a check fails, or the surface cannot be thickened.
    """
    is_closed, largest = bool(solid) or thickness is not None, target.largest > 0
    triangles, facts = raw_mesh.surface, dict(raw_mesh.facts)
    if solid:
        facts["side"] = target.side or "below"
    else:
        # Of a level set, `largest` keeps the component with the largest area, before it is
        # thickened.
        triangles = largest_component(triangles) if largest else triangles
        raw_mesh.check_level(triangles)
    tolerance = mesh_options.tolerance.at(raw_mesh.size)
    if thickness is not None:
        mesh_options.report("thickening")
        normals = vertex_normals(raw_mesh.function, triangles)
        # Half of the tolerance is left for the simplification.
        triangles, more_facts = thicken(triangles, normals, float(thickness), 0.5 * tolerance)
        facts |= more_facts
    if largest and is_closed:
        triangles = largest_body(triangles)

    def check(surface: TriangleMesh) -> None:
        """Raise a MeshingError unless the mesh `surface`, which was changed, is still a
        manifold and, for a solid, within the tolerance of the level set."""
        if solid:
            raw_mesh.check_level(surface)
        check_manifold(surface.faces)

    # Meshes that are not known to be valid are checked here.
    if not raw_mesh.is_checked:
        mesh_options.report("checking")
        check(triangles)
        check_no_self_intersection(triangles.vertices, triangles.faces)
    if simplify:
        mesh_options.report("simplifying")
        triangles, more_facts = simplify_mesh(triangles, tolerance, check)
        facts |= more_facts
    return to_trimesh(triangles, facts, is_closed)


@dataclass(frozen=True)
class _MeshOptions:
    """The checked arguments of `mesh`.

    volume: the volume to which the level set is cut (clip, section and domain); None if it is not
        cut.
    spacing: the size of cells, a length; None to choose it.
    most_faces: the largest number of triangles.
    report: called with messages about progress.

    The other attributes are arguments of `mesh` with the same names."""

    volume: Volume | None
    tolerance: MeshTolerance
    spacing: float | None
    seed: int
    most_faces: int
    report: Callable[[str], None]


@dataclass(frozen=True)
class _RawMesh:
    """A mesh before it is thickened or simplified: of a level set, or the closed surface of a
    solid.

    surface: the mesh. size: the longest side of the box in which it was meshed, a length.
    facts: its entries in `metadata["harnack"]`.
    function: the function of which the mesh is a level set.
    check_level: a function that raises a MeshingError unless a given mesh is within the tolerance
        of the level set.
    is_checked: whether it is already known that `surface` is a manifold within the tolerance of the
        level set, and does not pass through itself."""

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
    mesh_options: _MeshOptions,
) -> _RawMesh:
    """Mesh a level set of the field's function f, or the closed surface of a solid, from the signs
    of f - level at the points of a lattice.

    level: the level; None for the field's default.
    solid: False for a level set; True for the points of a `Solid`; or the interval (low, high) of
        the values of f in a solid.
    is_thick: whether the level set will be thickened.
    mesh_options: the arguments of `mesh`.

    A winding number whose mesh lies on its own level set is not meshed: its triangles are the
    result (`_faces_alone`). A solid between two levels is computed from closed meshes of both level
    sets. Warns if the mesh is coarse, or lacks parts of the level set.

    Raises:
        MeshingError: the result is empty, or far from the level set; or `mesh_from_signs` fails.
    """
    ends = _ends_by_signs(field, level, solid, is_thick)
    levels = tuple(end for end in ends if math.isfinite(end))
    if isinstance(field, WindingNumber) and field.is_whole_surface(levels):
        return _faces_alone(field, levels[0], solid, mesh_options)
    volume, box = mesh_options.volume, _box(field, levels, mesh_options.volume)
    size = float((box.upper - box.lower).max())
    if solid and _is_outside_inside(field, ends, box):
        box = _unlimited_box(field, volume)
    cell_size, attempts = _cells_by_signs(field, size, mesh_options.spacing)
    # If the surface may not end at the box, the box is enlarged by uneven amounts: otherwise
    # lattice points would lie on planes of symmetry, where f often equals its level.
    margin = np.zeros(3) if box.has_walls else size * np.array([0.0037, 0.0053, 0.0029])
    lattice_box = box.lower - margin, box.upper + 0.5 * margin
    facts: list[dict[str, Any]] = []
    losses: list[LostParts] = []

    def function(value: float, side: float) -> SignFunction:
        """The function side * (f - value). Its level set 0 is the level set of f at `value`; it is
        positive on one side of it."""
        return SignFunction.of(
            field, value, lattice_box, cell_size, side=side, most_faces=mesh_options.most_faces
        )

    is_intersection_free = False

    def signed(value: float, side: float, closed: bool) -> TriangleMesh:
        """The mesh of the level set of f at `value`. side: 1; or -1 to reverse all faces. closed:
        whether parts of the box's faces close the mesh; otherwise it ends at the box.

        As side effects, variables of the enclosing function change. The mesh's entries for the
        metadata are appended to `facts`, the parts of the level set that it lacks to `losses`, and
        `is_intersection_free` is set."""
        nonlocal is_intersection_free
        try:
            triangles, lost, mesh_facts = mesh_from_signs(
                function(value, side),
                lattice_box,
                cell_size,
                mesh_options.tolerance.at(size),
                attempts,
                mesh_options.report,
                closed=closed,
                volume=mesh_options.volume,
            )
        except EmptySurfaceError as error:
            raise EmptySurfaceError(f"{error}{empty_surface_hint(field)}") from error
        facts.append(mesh_facts)
        losses.append(lost)
        # The last mesh decides; with two levels this is set to False later.
        is_intersection_free = triangles.is_intersection_free
        return triangles.surface

    if not solid:
        # (False: the mesh may end at the box; parts of its faces do not close it.)
        triangles = signed(levels[0], 1.0, False)
        if volume is not None and not (isinstance(volume, Box) and box.has_walls):
            # The box itself has cut the mesh already if the clip is a box.
            triangles, is_intersection_free = clip_to_volume(triangles, volume), False
    elif volume is None and ends[1] == math.inf:
        # Reversed, the faces look out of the solid of larger values.
        triangles = signed(levels[0], -1.0, False)
    else:
        # Between two levels: the points below the upper level without those below the lower one.
        solid_so_far = box_manifold(box.lower, box.upper)
        if math.isfinite(ends[0]):
            solid_so_far = to_manifold(signed(ends[0], -1.0, True))
        if math.isfinite(ends[1]):
            solid_so_far = solid_so_far - to_manifold(signed(ends[1], -1.0, True))
        if field.traits.has_jumps and len(levels) == 2:
            _check_has_thickness(field, solid_so_far, ends, mesh_options.tolerance.at(size))
        cut_volume = volume or Box(tuple(box.lower.tolist()), tuple(box.upper.tolist()))
        solid_so_far ^= volume_manifold(
            cut_volume, box.lower, box.upper, 0.5 * mesh_options.tolerance.at(size)
        )
        triangles, is_intersection_free = from_manifold(solid_so_far), False
    if not len(triangles.faces):
        raise MeshingError("the level set is empty: it lies outside of the clip")
    if is_intersection_free:
        check_manifold(triangles.faces)
    metadata = {"level": levels[0], **_merge_facts(facts)}
    if isinstance(field, DipolePotential):
        metadata["cloud"] = field.describe()
    is_told = _check_sign_accuracy(field, metadata, mesh_options.tolerance.at(size))
    _warn_of_lost(field, losses, is_told)
    # No check of the level (`_accept`): distances from it have been measured.
    return _RawMesh(
        triangles, size, metadata, function(levels[0], 1.0), _accept, is_intersection_free
    )


def _ends_by_signs(
    field: Field,
    level: float | None,
    solid: tuple[float, float] | bool,
    is_thick: bool,
) -> tuple[float, float]:
    """The interval (low, high) of the values of f in the solid that is to be meshed by signs. For a
    level set it is (level, inf).

    level: the level; None for the field's default. is_thick: whether the level set will be
        thickened.
    solid: False for a level set; True for the points of a `Solid`; or the interval itself.

    Raises:
        TypeError: the level set is to be thickened, but f jumps across it.
        ValueError: the field has no such level.
    """
    if is_thick and field.traits.has_jumps:
        raise TypeError(
            f"{type(field).__name__} jumps, and its surface has no normals to thicken it "
            "along: mesh it, and move the mesh's vertices instead"
        )
    if solid:
        return solid_value_range(field, solid, level)
    level = field.default_level if level is None else float(level)
    field.validate_levels((level,))
    return level, math.inf


def _cells_by_signs(field: Field, size: float, spacing: float | None) -> tuple[float, int]:
    """The size of the lattice cells that are tried first when meshing by signs (a length), and the
    largest number of attempts, each with smaller cells.

    size: the longest side of the box, a length.
    spacing: the size of cells that the caller asked for; then there is only one attempt. None to
        choose it: a 48th of the box, or smaller if the field is smoothed over a shorter length."""
    if spacing is not None:
        return float(spacing), 1
    cell_size, attempts = size / _SIGN_CELLS, _SIGN_ATTEMPTS
    smaller_size = cell_size_for_smoothing(field, cell_size, CELL_SIZE_RATIO, CELL_SIZE_RATIO**2)
    # Begin with smaller cells at once; that counts as the first attempt.
    return (smaller_size, attempts - 1) if smaller_size < cell_size else (cell_size, attempts)


def _faces_alone(
    field: WindingNumber,
    level: float,
    solid: tuple[float, float] | bool,
    mesh_options: _MeshOptions,
) -> _RawMesh:
    """Mesh the level set of a `WindingNumber` whose open mesh lies on that level set, such as a
    mesh of a `SolidAngle`. The result consists of the triangles of that mesh, cut by the volume of
    the arguments and otherwise unchanged.

    level: the level. solid: must be False.
    mesh_options: the arguments of `mesh`.

    Raises:
        MeshingError: a solid was asked for, nothing is left, or there are too many triangles.
    """
    if solid:
        raise MeshingError(
            "this mesh is a sheet that lies on its own spanning surface, so that nothing is inside "
            "of it: mesh the SolidAngle of its boundary with thickness=..."
        )
    vertices, faces = field.mesh.vertices, field.mesh.faces
    size = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    surface = TriangleMesh.without_unused_vertices(vertices, faces)
    if mesh_options.volume is not None:
        surface = clip_to_volume(surface, mesh_options.volume)
    if not len(surface.faces):
        raise MeshingError("the level set is empty: it lies outside of the clip")
    if len(surface.faces) > mesh_options.most_faces:
        raise TriangleLimitError(
            f"{len(surface.faces):,} triangles of the mesh are its surface, and max_triangles is "
            f"{mesh_options.most_faces:,}: choose a larger `max_triangles`, or a smaller `clip`"
        )
    facts = {"level": level, "made_by": "faces", "spacing": math.nan, "evaluations": 0}
    function = LevelFunction(field, level, most_faces=mesh_options.most_faces)
    # No check of the level: the triangles are the level set. Other checks follow (False).
    return _RawMesh(surface, size, facts, function, _accept, False)


def _check_has_thickness(
    field: Field, whole: Manifold, ends: tuple[float, float], tolerance: float
) -> None:
    """Raise a MeshingError if the solid between two levels has no thickness. That is so if the
    field jumps from below the lower to above the upper level: then both level sets are the same
    triangles.

    whole: the solid. ends: the two levels. tolerance: the smallest mean thickness, a length."""
    # A thin sheet of thickness h has the volume h * area / 2, as both of its sides count.
    if 2 * abs(whole.volume()) < tolerance * whole.surface_area():
        low, high = (f"{end:g}" for end in ends)
        raise MeshingError(
            f"the part between the levels {low} and {high} of this {type(field).__name__} has no "
            f'thickness: it jumps across both at its triangles; for the inside give side="above"'
        )


def _merge_facts(facts: list[dict[str, Any]]) -> dict[str, Any]:
    """Merge the metadata entries of the surfaces at the two levels of a solid into one dictionary:
    counts are added, and of two lengths the larger one is taken. facts: one dictionary for each
    level."""
    sums = ("evaluations", "undecided", "flat", "far", "looked_at", "lost", "sought")
    larger = {key: max(entry[key] for entry in facts) for key in ("spacing", "within")}
    return {**facts[0], **larger, **{key: sum(entry[key] for entry in facts) for key in sums}}


def _check_sign_accuracy(field: Field, facts: dict[str, Any], tolerance: float) -> bool:
    """Warn if more than one in a hundred vertices and centers of triangles are farther than
    `tolerance` (a length) from the level set. Returns whether there was a warning.

    facts: the metadata entries that `mesh_from_signs` returned; they hold the measured distances.

    Raises:
        MeshingError: some of them are farther than several cells from the level set.
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


def _warn_of_lost(field: Field, losses: list[LostParts], is_told: bool) -> None:
    """Warn if the mesh lacks parts of the level set.

    losses: the missing parts, for each level that was meshed.
    is_told: whether another warning already says that the mesh is coarse. Then there is a warning
        only for thin parts, and for parts far from the mesh."""
    for lost in losses:
        if lost.matter and (lost.show_thin_parts or not is_told):
            warnings.warn(
                f"the mesh is not quite the level of this {type(field).__name__}: {lost}; "
                f"{lost.advice}",
                stacklevel=4,
            )


def _accept(surface: TriangleMesh) -> None:
    """Accept every mesh. It serves as `_RawMesh.check_level` of meshes by signs, whose distances
    from the level set have been measured before."""


def _level_and_solid(
    surface: Surface, thickness: float | None
) -> tuple[float | None, tuple[float, float] | bool]:
    """Decide what to mesh: a level set of the field's function f, or a solid.

    thickness: the thickness of the closed part that is made of a level set; None for none.

    Returns:
        The level, or None for the field's default; and one of three: False for the level set; True
        for the points of a `Solid`; or, for a solid given by values of f, the interval (low, high)
        of these values. In the last case the level is None.

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
    function: LevelFunction, triangles: TriangleMesh, tolerance: float, volume: Volume | None
) -> None:
    """Raise a MeshingError unless the mesh `triangles` is within `tolerance` (a length) of the
    level set of the function, and inside the volume if there is one. The distance is tested at
    vertices and centers of triangles."""
    if volume is not None:
        check_inside(triangles.vertices, volume, tolerance)
    check_near_level(function, triangles.vertices, triangles.faces, tolerance, volume)


def _checked(field: Field) -> Field:
    """Return the field if it can be meshed. For a `SolidAngle`, return a new one with the same
    loops, so that no setting of the given one counts.

    Raises:
        TypeError: it has patches (several functions in boxes of their own), circles, jumps that
            meshing by signs does not handle, or values that are angles although it is no
            `SolidAngle`.
    """
    check_is_field(field)
    if field.traits.has_patches or (field.traits.has_jumps and not uses_sign_meshing(field)):
        raise TypeError(
            f"{type(field).__name__} is not one continuous function: mesh its parts, or the "
            "solid angle of its boundary"
        )
    if isinstance(field, SolidAngle):
        if field.circles:
            raise TypeError(
                "the mesh of a circle ends on a polygon: give circle.polygon(n) in its place"
            )
        # Without the settings of the given one.
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
    mesh_options: _MeshOptions,
) -> _RawMesh:
    """Mesh the closed surface of a solid: the smooth level sets of its parts are meshed and then
    combined by unions, intersections and differences.

    level: the level; None for the field's default.
    solid: True for the points of a `Solid`; or the interval (low, high) of the values of f in the
        solid.
    mesh_options: the arguments of `mesh`."""
    region = LevelFunction(
        *solid_and_level(field, solid, level), most_faces=mesh_options.most_faces, is_near=True
    )
    # In a list, so that a nested function can change it.
    angle_evaluations = [0]

    def angle_mesher(error: float, cells: float) -> AngleMesher:
        """Make a function that meshes level sets of angles. error: the tolerance of these meshes;
        cells: the size of their cells; both are lengths."""

        def mesh_angle(angle: SolidAngle, value: float) -> TriangleMesh:
            """The mesh of the level set of `angle` at `value`. The number of evaluations of `angle`
            is added to `angle_evaluations`, the count of the outermost function."""
            angle = cast("SolidAngle", _checked(angle))
            # (None: no clip volume.)
            box = _box(angle, (value,), None)
            function = LevelFunction(angle, value, most_faces=mesh_options.most_faces)
            # In a single attempt: the caller tries again with smaller cells.
            solid_mesh, facts = _mesh_spanning_curve(
                function, box, error, cells, 1, mesh_options.seed, mesh_options.report
            )
            angle_evaluations[0] += facts["evaluations"]
            return solid_mesh

        return mesh_angle

    def check_level(surface: TriangleMesh, size: float) -> None:
        """Raise a MeshingError unless the mesh is within the tolerance of the solid's level set.
        size: the longest side of the solid's box, a length, to which the tolerance is relative."""
        _check_level(region, surface, mesh_options.tolerance.at(size), mesh_options.volume)

    def check(surface: TriangleMesh, size: float) -> None:
        """Raise a MeshingError unless the mesh is a manifold within the tolerance of the level set.
        size: the longest side of the solid's box, a length, to which the tolerance is relative."""
        check_manifold(surface.faces, surface.vertices)
        check_level(surface, size)

    solid_field = cast("Solid", region.field)
    with singular_points_explained(
        field, region, lambda: solid_size(solid_field, region.level, mesh_options.volume)
    ):
        solid_mesh = mesh_solid(
            solid_field,
            region.level,
            mesh_options.volume,
            mesh_options.tolerance,
            mesh_options.spacing,
            angle_mesher,
            mesh_options.most_faces,
            check,
            mesh_options.report,
        )
    facts = {
        "level": region.level,
        "spacing": solid_mesh.spacing,
        "evaluations": solid_mesh.evaluations + angle_evaluations[0],
        "surfaces_with_options": solid_mesh.levels,
    }
    # (True: `mesh_solid` has checked it.)
    return _RawMesh(
        solid_mesh.surface,
        solid_mesh.size,
        facts,
        region,
        lambda surface: check_level(surface, solid_mesh.size),
        True,
    )


def _mesh_level_set(field: Field, level: float | None, mesh_options: _MeshOptions) -> _RawMesh:
    """Mesh a level set of a function that is smooth nearly everywhere, or of a `SolidAngle`, and
    cut it by the volume of the arguments.

    level: the level; None for the field's default.
    mesh_options: the arguments of `mesh`.

    Raises:
        MeshingError: the level set is empty or cannot be meshed.
    """
    level = field.default_level if level is None else float(level)
    function = LevelFunction(field, level, most_faces=mesh_options.most_faces)
    field.validate_levels((level,))
    volume, report = mesh_options.volume, mesh_options.report
    box = _box(field, (level,), volume)
    size = float((box.upper - box.lower).max())
    # The other half of the tolerance is left for changes of the mesh that follow.
    mesh_tolerance = 0.5 * mesh_options.tolerance.at(size)
    cell_size = (
        size / _CELLS_ACROSS if mesh_options.spacing is None else float(mesh_options.spacing)
    )
    if mesh_options.spacing is None and field.traits.min_wavelength is not None:
        cell_size = min(cell_size, field.traits.min_wavelength / CELLS_PER_WAVE)
    attempts = 1 if mesh_options.spacing is not None else _MAX_ATTEMPTS
    if isinstance(field, SolidAngle):
        triangles, facts = _mesh_spanning_curve(
            function, box, mesh_tolerance, cell_size, attempts, mesh_options.seed, report
        )
    else:
        with singular_points_explained(field, function, lambda: size):
            triangles, facts = _mesh_in_lattice(
                function, box, mesh_tolerance, cell_size, attempts, report
            )
    # If the clip is a box, the lattice has ended the mesh there already.
    if volume is not None and not (isinstance(volume, Box) and box.has_walls):
        triangles = clip_to_volume(triangles, volume)
        if not len(triangles.faces):
            raise MeshingError("the level set is empty: it lies outside of the clip")

    def check_level(surface: TriangleMesh) -> None:
        """Raise a MeshingError unless the mesh is within the tolerance of the level set and in the
        volume."""
        _check_level(function, surface, mesh_options.tolerance.at(size), volume)

    # (False: it is checked later, after it was cut and perhaps thickened.)
    return _RawMesh(triangles, size, {"level": level, **facts}, function, check_level, False)


def _mesh_in_lattice(
    function: LevelFunction,
    box: _MeshingBox,
    tolerance: float,
    spacing: float,
    attempts: int,
    report: Callable[[str], None],
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Mesh the level set of a real-valued function in a box. Returns the mesh, and its entries in
    `metadata["harnack"]`.

    tolerance: the largest distance of triangles from the level set, a length.
    spacing: the size of the lattice cells that are tried first, a length.
    attempts: the largest number of attempts. If one fails in a way that smaller cells may mend, the
        next one has cells 0.6 times as large.
    report: called with messages about the progress.

    Raises:
        MeshingError: the last attempt failed, or one that smaller cells do not mend.
    """
    previous_error: MeshingError | None = None
    while True:
        report(f"cells of {spacing:.3g}")
        try:
            lattice = BccLattice.covering_box(box.lower, box.upper, spacing)
            triangles, isotopy = mesh_open_surface(function, lattice, tolerance, report)
            check_manifold(triangles.faces, triangles.vertices)
            # (None: no volume has cut the mesh yet.)
            check_near_level(function, triangles.vertices, triangles.faces, 2 * tolerance, None)
            check_no_self_intersection(triangles.vertices, triangles.faces)
            break
        except MeshingError as error:
            attempts -= 1
            # Give up after the last attempt, or if even the smallest cells to come would not help.
            if not attempts or not is_retry_promising(
                error, previous_error, CELL_SIZE_RATIO**attempts
            ):
                raise
            previous_error, spacing = error, CELL_SIZE_RATIO * spacing
            report(f"{error}; so smaller cells")
    facts = {
        "spacing": spacing,
        "evaluations": function.evaluations,
        "proved": 0,
        "integrated": 0,
        **isotopy.shares(),
    }
    return triangles, facts


def _mesh_spanning_curve(
    function: LevelFunction,
    box: _MeshingBox,
    tolerance: float,
    spacing: float,
    attempts: int,
    seed: int,
    report: Callable[[str], None],
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Mesh the level set of a `SolidAngle`, a surface that ends at the curve of this angle. Returns
    the mesh, and its entries in `metadata["harnack"]`.

    function: f - level for a field f; it is 0 on the level set.
    tolerance: the largest distance of triangles from the level set, a length.
    spacing: the size of the cells that are tried first, a length.
    attempts: the largest number of attempts, each with smaller cells.
    seed: of the small random moves that keep points in general position.
    report: called with messages about the progress.
    """
    ends = box.lower, box.upper
    made = mesh_spanning_curve(
        function, spacing, attempts, ends, box.has_walls, seed, tolerance, report
    )
    facts = {
        "spacing": made.spacing,
        "evaluations": function.evaluations,
        "proved": made.crossings.proved,
        "integrated": made.crossings.integrated_count,
        **made.isotopy.shares(),
        "turned": made.turned,
    }
    return TriangleMesh.without_unused_vertices(made.vertices, made.faces), facts


@dataclass(frozen=True)
class _MeshingBox:
    """The box in which a level set is meshed.

    lower, upper: (3,) its corners.
    has_walls: whether the surface may reach the faces of the box, and end there."""

    lower: FloatArray
    upper: FloatArray
    has_walls: bool


def _is_outside_inside(field: Field, ends: tuple[float, float], box: _MeshingBox) -> bool:
    """Whether the points outside of `box` belong to the solid in which f lies between two levels.
    The box contains both level sets. So either all points outside belong to the solid or none does,
    and the value of f at one of them decides. False if no such point is in the field's domain.

    ends: the two levels."""
    center, half = 0.5 * (box.lower + box.upper), 0.5 * (box.upper - box.lower)
    # Points around the box: its corners and the centers of its edges and faces, moved outwards.
    signs = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)).reshape(3, -1).T
    signs = signs[signs.any(axis=1)]
    # First points well outside; then, as these may be outside of the domain, points nearby.
    points = np.concatenate([center + factor * half * signs for factor in (1.5, 1.02)])
    if field.domain is not None:
        points = points[field.domain.contains_points(points)]
    if not len(points):
        return False
    value = float(np.asarray(field.value(points[:1], precision="double"))[0])
    return ends[0] <= value <= ends[1]


def _unlimited_box(field: Field, volume: Volume | None) -> _MeshingBox:
    """The bounding box of the clip volume. It is the box for meshing if the solid continues outside
    of the box that contains its level sets.

    Raises:
        MeshingError: there is no clip volume, or it is unbounded: so is the solid.
    """
    bounds = None if volume is None else _bounds_of(volume)
    if bounds is None or not np.isfinite(bounds).all():
        raise MeshingError(
            f"the solid on this side of the level of {type(field).__name__} reaches to infinity: "
            "choose the other side, or give a clip with bounds, such as a box"
        )
    return _MeshingBox(*bounds, True)  # the surface may end at its faces


def _box(field: Field, levels: tuple[float, ...], volume: Volume | None) -> _MeshingBox:
    """The box in which level sets of a field are meshed. It contains the intersection of two
    regions: the extent (a region proved to contain the level sets) and the clip volume. Either may
    be unknown or unbounded.

    levels: the levels. volume: the clip volume, or None.

    Raises:
        MeshingError: neither region is bounded, or they have no point in common.
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
            "clip, such as a box"
        )
    if isinstance(field, SolidAngle):
        return _around_curve(field, extent, volume)
    lower, upper = _bounds_of(extent if volume is None else volume)
    if volume is not None and extent is not None and extent != volume:
        # A little room, so that what touches its extent does not end there.
        low, high = _bounds_of(extent)
        pad = _MARGIN * float((high - low).max())
        if math.isfinite(pad):
            lower, upper = np.maximum(lower, low - pad), np.minimum(upper, high + pad)
    elif volume is None:
        pad = _MARGIN * (upper - lower).max()
        lower, upper = lower - pad, upper + pad
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise MeshingError(
            f"the clip {volume} has no bounds, and {type(field).__name__} does not say where its "
            f"level {level:g} ends: give a clip with bounds"
        )
    if not (lower < upper).all():
        raise MeshingError("the level set is empty: it lies outside of the clip")
    return _MeshingBox(lower, upper, volume is not None)


def _around_curve(field: SolidAngle, extent: Volume | None, volume: Volume | None) -> _MeshingBox:
    """The box in which a level set of a `SolidAngle` is meshed, a surface that spans a curve.

    extent: a region proved to contain the surface, or None. If there is one, it is the box, and the
        surface is cut by the clip later; otherwise the box contains the curve and the clip volume.
    volume: the clip volume; it must not be None if there is no extent.

    Raises:
        MeshingError: there is no extent, and the clip volume is unbounded.
    """
    if extent is not None:
        # The surface lies inside of its extent, so it does not end at the box.
        return _MeshingBox(*_bounds_of(extent), False)
    assert volume is not None
    points = np.concatenate(list(field.loops))
    low, high = _bounds_of(volume)
    lower, upper = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    if not np.isfinite(upper - lower).all():
        raise MeshingError("the clip has no bounds: give a box or a ball")
    pad = _CURVE_MARGIN * (upper - lower).max()
    return _MeshingBox(lower - pad, upper + pad, True)  # the surface may end at its faces


def _bounds_of(volume: Volume | None) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper corner (3,) of the bounding box of a volume. The volume must not be
    None."""
    assert volume is not None
    lower, upper = (np.array(end, np.float64) for end in volume.bounds())
    return lower, upper
