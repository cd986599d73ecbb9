"""Closed meshes of solids, cut by volumes: the meshes of smooth level sets, put together.

A solid is where a function is at most a level. A wall |g| <= w is not meshed as {|g| - w = 0}, of
which marching cubes makes hundreds of pieces where cells are thicker than the wall. It is {g <= w}
less {g <= -w}, two smooth surfaces which do not meet, in a box a little larger than the clip; and
it is cut by the clip itself. Unions, intersections and complements likewise are those of the parts'
meshes, so that the creases where parts meet are edges of the mesh. Creases of a single function,
such as a cylinder's, are chamfered within the tolerance.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.validation import finite
from harnack.fields import Field, Solid
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solids.booleans import Combined, Complement, Offset
from harnack.fields.solids.extrusions import Extruded, Revolved
from harnack.fields.solids.from_field import Near, Region, bounded_side
from harnack.fields.solids.from_field import solid as solid_of
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.fields.solids.primitives import Cuboid, Plane
from harnack.fields.solids.thread import Thread
from harnack.fields.solids.transforms import AffineImage
from harnack.fields.solids.tube import Tube
from harnack.geometry import Ball, Box, Intersection, Volume
from harnack.meshing.bcc_lattice import Lattice
from harnack.meshing.checks import (
    CrossingError,
    FarError,
    LocalError,
    MeshingError,
    TooLargeError,
    check_manifold,
    may_help_again,
)
from harnack.meshing.clipping import without_films
from harnack.meshing.closed_mesh import (
    box_manifold,
    extruded_manifold,
    manifold_of,
    mesh_manifold,
    revolved_manifold,
    surface_of,
    volume_manifold,
    without_short_edges,
)
from harnack.meshing.csg_rewrite import common_parts_taken_out, flat, without_cut_parts
from harnack.meshing.lattice_meshing import (
    Elsewhere,
    MissedError,
    Surface,
    closed_surface,
    cut_where_far,
)
from harnack.meshing.level_function import CELLS_PER_WAVE, LevelFunction, Samples, Uploads
from harnack.meshing.outlier_projection import brought_near
from harnack.meshing.self_intersection_repair import made_apart
from harnack.meshing.thread_mesh import thread_manifold
from harnack.meshing.tube_mesh import tube_manifold

if TYPE_CHECKING:
    from manifold3d import Manifold

__all__ = [
    "AngleMesher",
    "RegionMesher",
    "SolidMesh",
    "apart_of",
    "ends_of_solid",
    "is_smooth",
    "mesh_solid",
    "region_of",
]

# Cells of offsets of meshes, in tolerances; and how many secants find roots on their edges.
_CELLS_OF_OFFSET, _SECANTS = 6.0, 2
# Where other parts leave nothing is looked for at once in lattices of more cells than this.
_MANY_CELLS = 100_000
# How far joining their triangles may move them, in tolerances: the first that does no harm; and how
# far mending may, which is tried with the least.
_JOINED_WITHIN, _MENDED_WITHIN = (0.5, 0.25, 0.1), 0.5
# Triangles of them are cut in three where their centers are farther off, in tolerances; so often.
_FAR_OFF, _TIMES_CUT = 1.8, 2

# Meshes the level set of an angle, which ends at its curve: field, level -> vertices and faces.
AngleMesher = Callable[[SolidAngle, float], Surface]


Others: TypeAlias = tuple[tuple[Solid, float], ...]
"""Solids and their levels: what is meshed is intersected with all of them, so that it need not be
made where one of them is proved to have nothing.

Proof that parts of a tree of unions, intersections and complements may be left out there. Inside
of a complement, only parts that are not one are taken, of the intersection that the complement is
itself a part of; elsewhere those of all intersections above. First let nothing be left out within
complements. Then all that is made of a tree is a part of the truth, since unions and intersections
grow with their parts. If something is left out at a point, some part of an intersection above has
nothing there in truth, so neither has what is made of it, nor the intersection: which is the truth.
Now let something be left out within complements. At such a point a part of the intersection that
the complement is in, without complements within, has nothing there, and as before what is made of
it is a part of the truth: again the intersection is the truth."""


@dataclass
class RegionMesher:
    """Meshes solids in a box from `lower` to `upper`, (3,) each.

    tolerance: a length, of the middles of edges and faces. spacing: of cells, at most.
    per_wave: cells along a wave (`Field.wavelength`) at the least; None for as many as there are.
    mesh_angle: meshes level sets of angles, which end at a curve. most_faces: of each level set.
    evaluations, levels, finest: of fields, in points, how many level sets were meshed so far, and
        the smallest spacing of these.
    uploads: of the fields that were meshed so far.
    others: parts that everything meshed next is intersected with (see `Others`).
    last_elsewhere: where others left nothing, when that was asked for last.
    """

    lower: FloatArray
    upper: FloatArray
    tolerance: float
    spacing: float
    per_wave: float | None
    mesh_angle: AngleMesher
    most_faces: int
    report: Callable[[str], None]
    evaluations: int = 0
    levels: int = 0
    finest: float = math.inf
    uploads: Uploads = dataclasses.field(default_factory=Uploads)
    others: Others = ()
    last_elsewhere: tuple[Others, Elsewhere] | None = None

    def below(self, solid: Solid, level: float) -> Manifold:
        """The points of the box where a solid's function is at most `level`; what there is outside
        of the box has no meaning.

        Raises:
            MeshingError: a part cannot be meshed.
        """
        from manifold3d import Manifold

        if isinstance(solid, Combined):
            apart = common_parts_taken_out(solid, level) if solid.is_union else None
            if apart is not None:
                return self.below(apart, 0.0)
            kept = without_cut_parts(flat(solid), level)
            return Manifold() if kept is None else self._joined(kept, level)
        if isinstance(solid, Complement):  # -f <= c where f >= -c
            return self._space() - self.below(solid.inner, -level)
        if isinstance(solid, Offset):
            return self.below(solid.inner, level + solid.distance)
        if isinstance(solid, Near):
            return self._wall(solid, level)
        if isinstance(solid, Region) and isinstance(solid.inner, Solid):
            return self.below(solid.inner, level)
        if isinstance(solid, AffineImage) and not is_smooth(solid.inner):
            return self._image(solid, level)
        if isinstance(solid, Cuboid) and solid.radius == 0 and level <= 0:
            half = np.array(solid.half_sides) + level
            return box_manifold(-half, half) if (half > 0).all() else Manifold()
        if isinstance(solid, Extruded) and level == 0:
            return extruded_manifold(
                solid.loops, solid.height, solid.twist, solid.taper, self.tolerance
            )
        if isinstance(solid, Revolved) and level == 0:
            return revolved_manifold(solid.loops, self.tolerance)
        if isinstance(solid, Thread) and level == 0:
            low, high = float(self.lower[2]), float(self.upper[2])
            return thread_manifold(solid, low, high, self.tolerance)
        if isinstance(solid, Tube):
            return tube_manifold(solid, level, self.tolerance)
        if isinstance(solid, MeshSolid):
            return (mesh_manifold(solid) if level == 0 else None) or self._offset(solid, level)
        if isinstance(solid, Plane):
            x, y, z = solid.normal
            return self._space().trim_by_plane((-x, -y, -z), -(solid.distance + level))
        return manifold_of(self.smooth(solid, level)[0])

    def _joined(self, solid: Combined, level: float) -> Manifold:
        """A union; or an intersection, from which complements are cut away."""
        from manifold3d import Manifold, OpType

        numbers = range(len(solid.parts))
        if solid.is_union:
            return Manifold.batch_boolean(
                [self._part(solid, k, level) for k in numbers], OpType.Add
            )
        cut = [k for k in numbers if isinstance(solid.parts[k], Complement)]
        kept = [self._part(solid, k, level) for k in numbers if k not in cut]
        whole = Manifold.batch_boolean(kept, OpType.Intersect) if kept else self._space()
        away = [self._part(solid, k, level) for k in cut]
        return Manifold.batch_boolean([whole, *away], OpType.Subtract)

    def _part(self, solid: Combined, number: int, level: float) -> Manifold:
        """One part of a union or an intersection, made where the others of an intersection may
        leave something of it (`Others`); of a complement in an intersection what is cut away."""
        kept, part = self.others, solid.parts[number]
        if not solid.is_union:
            beside = [one for one in solid.parts if one is not part]
            if isinstance(part, Complement):
                self.others = tuple((one, level) for one in beside if _is_exact(one))
                part, level = part.inner, -level
            else:
                self.others = (*kept, *((one, level) for one in beside))
        try:
            return self.below(part, level)
        finally:
            self.others = kept

    def _closed(self, function: LevelFunction, lattice: Lattice) -> Surface:
        """A level set in a box: where the other parts may leave something, if cells are many. Of
        few all are made, so that what is there twice is the same bit by bit; unless that goes
        wrong, as it may where nothing is left: a function of the angle about an axis jumps there,
        and others have no value beyond some surface."""
        elsewhere: Elsewhere | None = None
        if math.prod(lattice.counts.tolist()) < _MANY_CELLS:
            try:
                return closed_surface(function, lattice, self.tolerance, self.report)
            except MeshingError as wrong:
                elsewhere = self._elsewhere()
                if elsewhere is None:
                    raise
                self.report(f"{wrong}; so only where the other parts leave something")
        return closed_surface(
            function, lattice, self.tolerance, self.report, elsewhere=elsewhere or self._elsewhere()
        )

    def _elsewhere(self) -> Elsewhere | None:
        """How far around points the other parts leave nothing, by proof; None if there are none.
        The two sides of a wall have the same."""
        if not self.others:
            return None
        if self.last_elsewhere is not None and self.last_elsewhere[0] is self.others:
            return self.last_elsewhere[1]
        functions = [self.function(one, level) for one, level in self.others]

        def clearance(points: FloatArray) -> FloatArray:
            found = np.zeros(len(points))
            for one in functions:
                outside = np.flatnonzero(one.values(points) > 0)
                found[outside] = np.maximum(found[outside], one.clearance(points[outside]))
            return found

        made = Elsewhere(clearance)
        self.last_elsewhere = self.others, made
        return made

    def smooth(self, field: Field, level: float) -> tuple[Surface, bool]:
        """The boundary of {f <= level} as one level set, and whether it is all of it: if not, it is
        closed outside of the box in a way that has no meaning."""
        hull = _hull(field, level)
        lower, upper = self.lower, self.upper
        is_whole = False
        if hull is not None:
            low, high = hull.bounds()
            is_whole = bool((low >= lower).all() and (high <= upper).all())
            lower, upper = np.maximum(lower, low), np.minimum(upper, high)
            if not (lower < upper).all():
                return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), is_whole
        size = float((upper - lower).max())
        spacing = min(self.spacing, size / 8)
        if self.per_wave is not None and field.wavelength is not None:
            spacing = min(spacing, field.wavelength / self.per_wave)
        self.finest = min(self.finest, spacing)
        function = self.function(_entire(field), level)
        self.report(f"level {level:g} of {type(field).__name__} in cells of {spacing:.3g}")
        lattice = Lattice.filling(lower, upper, spacing, layers=2)
        made = self._closed(function, lattice)
        self.evaluations += function.evaluations
        self.levels += 1
        return made, is_whole

    def function(self, field: Field, level: float) -> LevelFunction:
        """f - level, continued beyond the field's domain."""
        return _WithinDomain(field, level, most_faces=self.most_faces, uploads=self.uploads)

    def _space(self) -> Manifold:
        pad = 1e-3 * (self.upper - self.lower)
        return box_manifold(self.lower - pad, self.upper + pad)

    def _wall(self, wall: Near, level: float) -> Manifold:
        """Where a field is within half_width + level of the wall's level."""
        from manifold3d import Manifold

        half = wall.half_width + level
        if half <= 0:
            return Manifold()
        low, high = wall.level - half, wall.level + half
        field = wall.inner
        if field.period is None:
            inside = Region(field)
            if not isinstance(field, Solid):
                self._check_wall(field, low, high)
            return self.below(inside, high) - self.below(inside, low)
        if 2 * half >= field.period:
            return self._space()
        if not isinstance(field, SolidAngle):
            raise MeshingError(
                f"a solid around a level of {type(field).__name__}, which is angle-valued, cannot "
                "be meshed: only those of a SolidAngle"
            )
        return manifold_of(self._lens(field, low, high))

    def _check_wall(self, field: Field, low: float, high: float) -> None:
        """Raise if a wall is thinner than both of its sides' tolerance: they would meet."""
        lattice = Lattice.filling(
            self.lower, self.upper, float((self.upper - self.lower).max()) / 8
        )
        points = lattice.points(2 * np.argwhere(np.ones(lattice.counts)) + 1)
        middle = 0.5 * (low + high)
        samples = self.function(field, middle).at(points)
        # Where the wall may be near.
        near = samples.distance <= np.median(samples.distance)
        steep = float(np.median(np.linalg.norm(samples.gradient[near], axis=1)))
        self.evaluations += len(points)
        if high - low < 2 * self.tolerance * steep:
            raise MeshingError(
                f"the wall is about {(high - low) / steep:.2g} thick, and its sides are made "
                f"within {self.tolerance:.2g}: choose a smaller `tolerance`, or make the "
                "wall thicker"
            )

    def _lens(self, field: SolidAngle, low: float, high: float) -> Surface:
        """Between two levels of an angle: both end at the same vertices, those of the curve."""
        inner, outer = self.mesh_angle(field, low), self.mesh_angle(field, high)
        count = sum(map(len, field.loops))
        if not np.array_equal(inner.vertices[:count], outer.vertices[:count]):
            raise MeshingError("the two sides of the solid do not end at the same curve")
        place = np.arange(len(inner.vertices)) - count + len(outer.vertices)
        place[:count] = np.arange(count)
        vertices = np.concatenate([outer.vertices, inner.vertices[count:]])
        self.levels += 2
        return Surface(vertices, np.concatenate([outer.faces, place[inner.faces][:, ::-1]]))

    def _offset(self, solid: MeshSolid, level: float) -> Manifold:
        """The points within a distance of a mesh, or deeper inside than that.

        Offsets of meshes have creases wherever the mesh has, too many for cells to be refined
        beside them. So cells are small at once, and of f, a distance, roots are linear along their
        edges but at creases. Then triangles that are nearly in a plane are joined, those that lie
        across a crease are cut, and those that pass through each other are mended. Parts thinner
        than a cell, such as the tip of a knife edge, may be left out: points of them are less than
        a cell from the level.
        """
        lower, upper = (np.array(end) for end in _finite_hull(solid, level))
        if not (lower < upper).all():
            return manifold_of(Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64)))
        cells = min(self.spacing, _CELLS_OF_OFFSET * self.tolerance)
        self.finest = min(self.finest, cells)
        function = dataclasses.replace(self.function(solid, level), secants=_SECANTS)
        self.report(f"level {level:g} of a mesh in cells of {cells:.3g}")
        lattice = Lattice.filling(lower - cells, upper + cells, cells, layers=2)
        made = closed_surface(function, lattice, self.tolerance, self.report, as_cut=True)
        whole = manifold_of(made)
        self.levels += 1
        for share in _JOINED_WITHIN:
            joined = surface_of(without_short_edges(whole, share * self.tolerance))
            joined = cut_where_far(function, joined, _FAR_OFF * self.tolerance, _TIMES_CUT)
            try:
                made = made_apart(joined, _MENDED_WITHIN * self.tolerance)
            except CrossingError:
                continue
            break
        self.evaluations += function.evaluations
        return manifold_of(made)

    def _image(self, solid: AffineImage, level: float) -> Manifold:
        """Of a solid under an affine map: the image of its mesh."""
        matrix, offset = np.array(solid.map.matrix), np.array(solid.map.offset)
        ends = np.stack([self.lower, self.upper])
        corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)
        own = (corners - offset) @ solid.map.inverse.T
        scale = float(np.linalg.norm(matrix, 2))
        local = dataclasses.replace(
            self, lower=own.min(axis=0), upper=own.max(axis=0), tolerance=self.tolerance / scale,
            spacing=self.spacing / scale, evaluations=0, levels=0, finest=math.inf, others=(),
        )  # fmt: skip
        made = local.below(solid.inner, level / solid.map.factor)
        self.evaluations += local.evaluations
        self.levels += local.levels
        self.finest = min(self.finest, local.finest * scale)
        return made.transform(np.column_stack([matrix, offset]))


def _is_exact(solid: Solid) -> bool:
    """Whether there is no complement within a solid, as it is meshed."""
    if isinstance(solid, Combined):
        return all(_is_exact(one) for one in solid.parts)
    if isinstance(solid, AffineImage | Offset):
        return _is_exact(solid.inner)
    return not isinstance(solid, Complement | Near)


def is_smooth(solid: Solid) -> bool:
    """Whether a solid is meshed as one level set."""
    if isinstance(solid, Region):
        return not isinstance(solid.inner, Solid) or is_smooth(solid.inner)
    if isinstance(solid, AffineImage):
        return is_smooth(solid.inner)
    with_edges = Cuboid | Plane | Extruded | Revolved | Thread | Tube | MeshSolid
    return not isinstance(solid, Combined | Complement | Offset | Near | with_edges)


def _finite_hull(solid: MeshSolid, level: float) -> tuple[FloatArray, FloatArray]:
    low, high = cast("Volume", solid.hull(level)).bounds()
    return np.array(low), np.array(high)


def _hull(field: Field, level: float) -> Volume | None:
    """A volume that holds {f <= level}, if it has bounds. A domain does not count: what ends there
    is cut by it."""
    if isinstance(field, Solid):
        found = field.hull(level)
    else:
        found = bounded_side(field, (level,), lambda value: value <= level)
    if found is None or found == field.domain:
        return None
    if isinstance(field, Region) and found == field.inner.domain:
        return None
    low, high = found.bounds()
    return found if np.isfinite(low).all() and np.isfinite(high).all() else None


def _entire(field: Field) -> Field:
    """The field itself, of a region of a field."""
    return field.inner if isinstance(field, Region) else field


@dataclass
class _WithinDomain(LevelFunction):
    """A field continued beyond its domain as it is at the domain's closest point.

    The closest points of two points are no farther from each other than the two are, so that the
    clearance of the closest point of p holds around p.
    """

    def at(self, points: FloatArray) -> Samples:
        return super().at(self._closest(points))

    def values(self, points: FloatArray) -> FloatArray:
        return super().values(self._closest(points))

    def clearance(self, points: FloatArray) -> FloatArray:
        return super().clearance(self._closest(points))

    def _closest(self, points: FloatArray) -> FloatArray:
        domain = self.field.domain
        if domain is None or self.field.is_entire:
            return points
        if isinstance(domain, Box):
            return np.clip(points, *domain.bounds())
        if isinstance(domain, Ball):
            away = points - domain.center
            length = np.linalg.norm(away, axis=1)
            shrunk = np.minimum(1.0, domain.radius / np.maximum(length, 1e-300))
            return np.array(domain.center) + away * shrunk[:, None]
        low, high = domain.bounds()
        if math.prod(high - low) < math.inf and domain.contains_points(points).all():
            return points
        raise MeshingError(
            f"{type(self.field).__name__} ends at a {type(domain).__name__}, near which it cannot "
            "be meshed: give the field a box or a ball as its domain"
        )


# Solids cut by volumes.

# Cells across a solid, unless a spacing is given.
_ACROSS = 24
# How many sizes of cells are tried, and what each is of the one before.
_MOST_ATTEMPTS = 3
_SMALLER = 0.6
# Where parts were cut by each other, slivers may pass through their neighbors by rounding: what may
# be moved to leave them out, in tolerances, in the order in which it is tried.
_SLIVERS_WITHIN = (1e-3, 1e-4, 0.0)
# Room around what has an extent, as a part of its size.
_MARGIN = 0.01


@dataclass(frozen=True)
class SolidMesh:
    """A closed surface; the spacing of cells, evaluations of fields in points, and how many level
    sets it was made of. size: of its box, to which tolerances relate."""

    surface: Surface
    spacing: float
    evaluations: int
    levels: int
    size: float


def region_of(field: Field, solid: Any, level: float | None) -> tuple[Solid, float]:
    """The solid that is asked for by `solid`, (low, high) or True, and its level.

    Raises:
        ValueError: it is none; levels that no solid has.
        TypeError: neither.
    """
    if solid is True and isinstance(field, Solid):
        level = field.default_level if level is None else finite(level, "level")
        return field, level
    low, high = ends_of_solid(field, solid, level)
    if low == -math.inf:
        return solid_of(field, below=high), 0.0
    if high == math.inf:
        return solid_of(field, above=low), 0.0
    if field.period is not None:
        return solid_of(field, around=(0.5 * (low + high), 0.5 * (high - low))), 0.0
    return solid_of(field, between=(low, high)), 0.0


def ends_of_solid(field: Field, solid: Any, level: float | None) -> tuple[float, float]:
    """The values (low, high) between which a solid is, given as such.

    Raises:
        ValueError, TypeError: as `region_of`.
    """
    if solid is True:
        raise ValueError(
            f"solid=True is for solids, and a {type(field).__name__} has two sides: give "
            "solid=(low, high), the values inside, such as solid=(-math.inf, 0.0)"
        )
    if level is not None:
        raise ValueError("give either level or solid: the ends of a solid are its levels")
    low, high = two_numbers(solid)
    if not low < high or not (math.isfinite(low) or math.isfinite(high)):
        raise ValueError(f"solid must be (low, high) with low < high, one finite, not {solid}")
    field.check_levels(tuple(end for end in (low, high) if math.isfinite(end)))
    return low, high


def two_numbers(solid: Any) -> tuple[float, float]:
    """(low, high), of whatever holds two numbers.

    Raises:
        TypeError: it does not.
    """
    try:
        low, high = (float(one) for one in solid)
    except (TypeError, ValueError):
        raise TypeError(f"solid must be (low, high), two numbers, or True, not {solid!r}") from None
    return low, high


def mesh_solid(
    solid: Solid,
    level: float,
    volume: Volume | None,
    tolerance: float,
    spacing: float | None,
    angle_mesher: Callable[[float, float], AngleMesher],
    most_faces: int,
    check: Callable[[Surface, float], None],
    report: Callable[[str], None],
) -> SolidMesh:
    """The boundary of the points of a volume where a solid's function is at most `level`.

    volume: None for all of space. tolerance: a part of the size. most_faces: of a level set.
    angle_mesher: given a tolerance and a spacing, both lengths, how to mesh level sets of angles.
    check: of the surface, of which no triangles pass through each other, given the size, that it is
        near the level last. Where it is not, in a few places, these are mended (`brought_near`);
        where another check fails in known places, or that is not enough, smaller cells are tried,
        and half the tolerance: beside a thin part triangles within it may be anywhere.

    Raises:
        MeshingError: it has no bounds; it is empty; a part cannot be meshed.
    """
    lower, upper = _bounds(solid, level, volume)
    size = float((upper - lower).max())
    cells = size / _ACROSS if spacing is None else spacing
    error = 0.5 * tolerance * size
    attempts = _MOST_ATTEMPTS if spacing is None else 1
    per_wave = CELLS_PER_WAVE if spacing is None else None
    uploads = Uploads()
    first: MeshingError | None = None
    before: MeshingError | None = None
    while True:
        mesher = RegionMesher(
            lower, upper, error, cells, per_wave, angle_mesher(error, cells),
            most_faces, report, uploads=uploads,
        )  # fmt: skip
        try:
            made = _apart(_put_together(mesher, solid, level, volume), error)
            report("checking")
            made = _checked(mesher, solid, level, made, size, check)
            break
        except TooLargeError as large:
            if first is None:
                raise
            raise first from large  # what smaller cells were for is what went wrong
        except (MissedError, LocalError) as wrong:
            attempts, first = attempts - 1, first or wrong
            if not attempts or not may_help_again(wrong, before, _SMALLER**attempts):
                raise
            before = wrong
            cells *= _SMALLER
            per_wave = CELLS_PER_WAVE * size / (_ACROSS * cells)
            if isinstance(wrong, LocalError):
                error *= 0.5
            report(f"{wrong}; so cells of {cells:.3g}")
    return SolidMesh(made, min(cells, mesher.finest), mesher.evaluations, mesher.levels, size)


def _checked(
    mesher: RegionMesher,
    solid: Solid,
    level: float,
    made: Surface,
    size: float,
    check: Callable[[Surface, float], None],
) -> Surface:
    """The surface, checked; brought nearer to the level in a few places, if need be.

    Raises:
        MeshingError: it fails the check.
    """
    try:
        check(made, size)
    except FarError as far:
        mended = brought_near(
            mesher.function(solid, level), made, far.places, 2 * mesher.tolerance,
            lambda one: check(one, size),
        )  # fmt: skip
        if mended is None:
            raise
        check_manifold(mended.faces, mended.vertices)  # all of it: `check` saw what is new
        return mended
    return made


def apart_of(whole: Manifold, tolerance: float) -> Surface:
    """The surface of parts put together, of which no triangles pass through each other.

    Raises:
        MeshingError: it is empty, or triangles cross.
    """
    return _apart(_Joined(whole), tolerance)


def _apart(parts: Surface | _Joined, tolerance: float) -> Surface:
    """The surface, of which no triangles pass through each other; of parts put together mended, or
    without slivers.

    Raises:
        MeshingError: it is empty; a CrossingError where that does not help, or hardly any fewer
            triangles cross where less is left out.
    """
    raised: CrossingError | None = None
    for share in _SLIVERS_WITHIN if isinstance(parts, _Joined) else (0.0,):
        one = parts.without_slivers(share * tolerance) if isinstance(parts, _Joined) else parts
        if not len(one.faces):
            raise MeshingError("the solid is empty: no point of the box is inside")
        try:
            return made_apart(one, _MENDED_WITHIN * tolerance)
        except CrossingError as error:
            if not may_help_again(error, raised):
                raise
            raised = error
    raise cast("CrossingError", raised)


@dataclass(frozen=True)
class _Joined:
    """Parts put together, in a volume or in all of space."""

    whole: Manifold
    volume: Volume | None = None

    def without_slivers(self, length: float) -> Surface:
        """The surface, short edges and slivers left out within a length, and bodies that are
        nothing but rounding."""
        simpler = without_short_edges(self.whole, length) if length > 0 else self.whole
        surface = without_films(surface_of(simpler))
        return surface if self.volume is None else _on_box(surface, self.volume)


def _put_together(
    mesher: RegionMesher, solid: Solid, level: float, volume: Volume | None
) -> Surface | _Joined:
    """The boundary of the solid in the volume."""
    if volume is None and is_smooth(solid):
        return mesher.smooth(solid, level)[0]
    lower, upper = mesher.lower, mesher.upper
    whole = mesher.below(solid, level)
    mesher.report("putting the parts together")
    if volume is None:
        volume = Box(_point(lower), _point(upper))
        ends = np.array(whole.bounding_box(), np.float64)
        if (ends[:3] > lower).all() and (ends[3:] < upper).all():
            return _Joined(whole, volume)
    cut = volume_manifold(volume, lower, upper, mesher.tolerance)
    return _Joined(whole ^ cut, volume)


def _bounds(solid: Solid, level: float, volume: Volume | None) -> tuple[FloatArray, FloatArray]:
    """A box that holds the solid within the volume.

    Raises:
        MeshingError: there is none.
    """
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    if volume is not None:
        lower, upper = (np.array(end, np.float64) for end in volume.bounds())
    hull = solid.hull(level)
    if hull is not None:
        low, high = (np.array(end, np.float64) for end in hull.bounds())
        pad = _MARGIN * float((high - low).max())
        if math.isfinite(pad):
            low, high = low - pad, high + pad
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise MeshingError(
            f"{type(solid).__name__} does not say where it ends (a solid does not end at the "
            "domain of the field it is made of): give clip=harnack.Box(lower, "
            "upper) or harnack.Ball(center, radius)"
        )
    if not (lower < upper).all():
        raise MeshingError("the solid is empty: it lies outside of the clip")
    return lower, upper


def _point(x: FloatArray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


def _on_box(surface: Surface, volume: Volume) -> Surface:
    """Vertices within rounding of a box's faces, put there."""
    boxes = volume.volumes if isinstance(volume, Intersection) else (volume,)
    vertices = surface.vertices
    for box in boxes:
        if isinstance(box, Box):
            vertices = np.clip(vertices, *box.bounds())
            for end in box.bounds():
                near = np.abs(vertices - end) <= 1e-12 * (1 + np.abs(end))
                vertices = np.where(near, end, vertices)
    return Surface(vertices, surface.faces)
