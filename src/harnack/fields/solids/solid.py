"""The base classes of solids. A solid is the set of points where its function f is not positive: f
< 0 inside, f = 0 on the surface, f > 0 outside. Solids are combined by operators (union,
intersection, difference), and moved and deformed by maps of space; the solids that are combined are
called operands, or parts. `Solid` is the base of all solids, `FormulaSolid` that of solids whose f
is a formula, and `SolidOfField` that of solids made of another field. `SpaceMap` is the base of
maps of space."""

from __future__ import annotations

import abc
import dataclasses
import math
import numbers
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.validation import as_positive, as_real
from harnack.fields.capabilities import VariableAccuracy
from harnack.fields.evaluator import Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.formula import Formula
from harnack.fields.formula_evaluator import FormulaFunction
from harnack.fields.number_table import is_attached_number
from harnack.geometry import Ball, Box, Volume
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt

    from harnack.backend import Backend, Real, Vec3
    from harnack.enclosures.samples import Sample

# Extents are widened by this fraction of the coordinates, as the numbers of a shape are rounded to
# the precision in which it is traced.
_EXTENT_MARGIN = 1e-6

Point = tuple[float, float, float]


def box_around(half: tuple[float, float, float], center: Any = (0.0, 0.0, 0.0)) -> Volume:
    """The box with a given center and given half sides, enlarged by `_EXTENT_MARGIN` for rounding.
    Negative half sides count as 0.

    half: (3,) half of the length of the side along each axis.
    center: (3,).
    """
    half_sides = [
        max(h, 0.0) + _EXTENT_MARGIN * (abs(h) + abs(c)) for h, c in zip(half, center, strict=True)
    ]
    lower = [c - s for c, s in zip(center, half_sides, strict=True)]
    upper = [c + s for c, s in zip(center, half_sides, strict=True)]
    return Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]))


def ball_around(center: tuple[float, float, float], radius: float) -> Volume:
    """The ball around a center, enlarged by `_EXTENT_MARGIN` for rounding. A negative radius counts
    as 0."""
    # The 1e-30 keeps the radius above 0, as a ball needs it.
    slack = _EXTENT_MARGIN * (abs(radius) + sum(abs(c) for c in center)) + 1e-30
    return Ball(center, max(radius, 0.0) + slack)


def set_frozen(shape: Any, name: str, value: Any) -> None:
    """Set the attribute `name` of a solid, `shape`. Its class is a frozen dataclass, whose
    attributes cannot be set in the usual way."""
    object.__setattr__(shape, name, value)


AXES = {"x": 0, "y": 1, "z": 2}


class SpaceMap(abc.ABC):
    """A one-to-one map of space, such as a rotation or a twist, that can be applied to solids."""

    @abc.abstractmethod
    def apply(self, solid: Solid) -> Solid:
        """The image of a solid under the map. It is called only for solids that are not
        combinations of other solids, because a combination is mapped operand by operand."""


def axis_index(axis: str) -> int:
    """The index of a coordinate axis: 0, 1 or 2 for "x", "y" or "z".

    Raises:
        ValueError: another name.
    """
    if axis not in AXES:
        raise ValueError(f'axis must be "x", "y" or "z", not {axis!r}')
    return AXES[axis]


def not_a_solid(other: Any) -> str:
    """The text of an error message about an object that is not a solid. For a field it says how to
    make a solid of it."""
    kind = type(other).__name__
    if isinstance(other, Field):
        return (
            f"{kind} is a field and no solid: make one of it by harnack.solid(field, below=level), "
            "above=level or between=(low, high); blobs are solid above 1, formulas mostly below 0"
        )
    message = f"only solids, such as harnack.Sphere(1.0), are combined, not {kind}"
    if callable(getattr(other, "struts", None)):
        message += ": make one of it by .struts(radius)"
    elif isinstance(other, numbers.Real) or dr.is_array_v(cast("Any", type(other))):
        message += "; a solid grows by offset(distance), and shrinks by a negative one"
    return message


class Solid(Field):
    """A solid: the points where its function f is at most 0. Its surface is the level set f = 0. A
    solid is also a field, so samples of f give its value and gradient at a point, with proved
    bounds of f near the point. A combination (union, intersection, difference) is made of other
    solids, its operands.

    Solids are combined by operators: `a | b` (union), `a & b` (intersection), `a - b` (difference)
    and `~a` (complement). They are moved and deformed by methods. Steps of rays are proved from
    enclosures of the operands (bounds of their change along the ray), never from a distance, since
    f of a combination is not a distance.

    lipschitz: a proved bound of |grad f| everywhere; None if no such bound is known. Outside of the
        solid f/lipschitz is a lower bound of the distance (Hart 1996, definition 3).
    """

    traits = Traits(over_relaxation=1.0, has_creases=True)
    lipschitz: Any = None

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A volume that is proved to contain all points where f <= level or, if `above`, all points
        where f >= level. None if no such volume is known.

        The default is the domain.
        """
        del level, above
        return self.domain

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that is proved to contain the level sets of f at these levels; None if none is
        known. It is a volume that contains all points with f at most the highest level; if none is
        known, one that contains all points with f at least the lowest level."""
        return self.sublevel_extent(max(levels)) or self.sublevel_extent(min(levels), above=True)

    def operands(self) -> tuple[Solid, ...]:
        """The solids of which this one is combined: at each point its function is that of one of
        them. So each of its level sets lies in the union of theirs at the same level. A solid that
        is no combination is its own only operand."""
        return (self,)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers, or jets (ranges of numbers and of their
        derivatives).

        Raises:
            TypeError: f has no formula, as for this default.
        """
        del x, y, z
        raise TypeError(
            f"{type(self).__name__} has no formula, so it cannot be blended, twisted or tapered; "
            "move it by moved, rotated, scaled or transformed, and join it by |, & and -"
        )

    def formula_on(self, backend: Backend) -> FormulaFunction:
        """The formula with its data on a backend. By default it is that of the evaluator."""
        evaluator: Any = self.evaluator(backend)
        return getattr(evaluator, "formula", self.formula)

    @abc.abstractmethod
    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        """The same combination with each operand replaced by change(operand). (Operands are the
        solids that are combined.) For a solid that is not a combination the result is
        change(self)."""

    # Combinations. Operands that are not solids are refused.

    def __or__(self, other: Any) -> Solid:
        from harnack.fields.solids.booleans import union

        return union(self, other)

    def __and__(self, other: Any) -> Solid:
        from harnack.fields.solids.booleans import intersection

        return intersection(self, other)

    def __sub__(self, other: Any) -> Solid:
        from harnack.fields.solids.booleans import Complement, intersection

        return intersection(self, Complement(other) if isinstance(other, Solid) else other)

    def __ror__(self, other: Any) -> Solid:
        raise TypeError(not_a_solid(other))

    __rand__ = __rsub__ = __ror__

    def _refuse_arithmetic(self, other: Any = None) -> Any:
        """Refuse arithmetic with a solid, which is a set of points. It is the method of several
        operators.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            f"{with_article(type(self).__name__)} is a set of points: solids are combined by |, & "
            "and -, scaled by scaled(factor), and grown by offset(distance); the sum of their "
            "functions, as a field, is harnack.fields.FieldSum([a, b], [1, 1])"
        )

    __add__ = __radd__ = __mul__ = __rmul__ = _refuse_arithmetic
    __truediv__ = __neg__ = _refuse_arithmetic

    def __invert__(self) -> Solid:
        from harnack.fields.solids.booleans import Complement

        return Complement(self)

    def blended(
        self, other: Solid, radius: float, *, power: float = 2.0, intersect: bool = False
    ) -> Solid:
        """The union with another solid, with a fillet where the surfaces meet; or, with
        intersect=True, the intersection with a rounded edge.

        other: the other solid.
        radius: how far the fillet extends along both surfaces, where f is a distance.
        power: the exponent of the superellipse that the fillet is a part of: 2 for a circle, larger
            for a sharper corner (Hart 1996, appendix D.3, corrected).

        The fillet fills the space where both surfaces are near, whatever the angle between them.
        Where faces are flush, such as the faces of a plate and a rib of the same height, the blend
        bulges by radius (1 - 2^(-1/power)), which is 0.29 radius for a circle. To avoid this, cut
        the bulge off by a slab of the same height, here 10,

            plate.blended(rib, 2.0) & hk.Cuboid((60.0, 60.0, 10.0))

        or let one of the solids end a radius below the face of the other.

        Raises:
            ValueError: radius or power out of range.
            TypeError: a solid without a formula.
        """
        from harnack.fields.solids.booleans import BlendedSolid

        return BlendedSolid((self, other), radius, power, not intersect)

    def offset(self, distance: float) -> Solid:
        """The solid of the points where f <= distance. If f is a distance, the solid grows by this
        length on all sides, or shrinks if it is negative."""
        from harnack.fields.solids.booleans import OffsetSolid

        return OffsetSolid(self, distance)

    def shell(self, thickness: float) -> Solid:
        """The hollow solid of the points where -thickness <= f <= 0. If f is a distance, as for a
        mesh, a sphere or an outline, this is a wall of that thickness inside of the surface.

        Raises:
            ValueError: a thickness that is not positive.
        """
        from harnack.fields.solids.from_field import BandSolid

        is_attached_number(thickness, "the thickness of a shell")  # raises an error for others
        as_positive(thickness, "the thickness of a shell")
        half = thickness * 0.5
        return BandSolid(self, -half, half)

    # Maps of space. Maps that do not keep lines straight need a formula.

    def translated(self, offset: Sequence[float]) -> Solid:
        """The solid, moved by the vector offset = (x, y, z)."""
        from harnack.fields.solids.transforms import AffineMap

        return self._apply_map(AffineMap.translation(offset))

    def rotated(self, degrees: float, axis: str | Sequence[float] = "z") -> Solid:
        """The solid, rotated about an axis through the origin by an angle in degrees,
        counter-clockwise as seen from the positive end of the axis.

        axis: "x", "y", "z" or a vector (3,).
        """
        from harnack.fields.solids.transforms import AffineMap

        return self._apply_map(AffineMap.rotation(degrees, axis))

    def scaled(self, factors: float | Sequence[float]) -> Solid:
        """The solid, scaled about the origin.

        factors: one factor, or one for each axis.

        If all factors are equal, f is multiplied by the factor too, so that a distance stays a
        distance. Otherwise f is not multiplied.
        """
        from harnack.fields.solids.transforms import AffineMap

        return self._apply_map(AffineMap.scaling(factors))

    def transformed(self, matrix: npt.ArrayLike) -> Solid:
        """The image of the solid under a linear or an affine map.

        matrix: (3, 3) for a linear map; (3, 4) or (4, 4) for an affine one.
        """
        from harnack.fields.solids.transforms import AffineMap

        return self._apply_map(AffineMap.of_matrix(matrix))

    def twisted(self, rate: float, axis: str = "z") -> Solid:
        """The solid, twisted about a coordinate axis: each cross section is rotated by `rate`
        degrees for each unit of length along the axis."""
        from harnack.fields.solids.deformations import Twist

        if not is_attached_number(rate, "the rate of a twist"):  # raises an error for others
            rate = as_real(rate, "the rate of a twist")
        return self._apply_map(Twist(rate * (math.pi / 180), axis))

    def tapered(
        self, start: tuple[float, float], end: tuple[float, float], axis: str = "z"
    ) -> Solid:
        """The solid, with its cross sections scaled by a factor that varies along a coordinate
        axis.

        start, end: (position along the axis, scale there), for two positions. The scale is linear
            between them and constant beyond them. Scales are positive.
        axis: "x", "y" or "z".
        """
        from harnack.fields.solids.deformations import Taper

        return self._apply_map(Taper(start, end, axis))

    # Patterns: unions of copies.

    def arranged(self, transforms: npt.ArrayLike) -> Solid:
        """The union of copies of the solid at given places. Copies may overlap.

        transforms: (n, 3) translations; or (n, 3, 3), (n, 3, 4) or (n, 4, 4) matrices, as in
            `transformed`. The solid itself is not among the copies unless a transform says so.

        Raises:
            ValueError: another shape, no transform, numbers that are not finite, or a singular
                matrix.
        """
        from harnack.fields.solids.patterns import maps_of, union_of_images

        return union_of_images(self, maps_of(transforms))

    def repeated(self, period: npt.ArrayLike, counts: int | Sequence[int]) -> Solid:
        """The union of copies of the solid in a row, a plane or a block: the solid itself, and
        copies moved by i a + j b + k c for 0 <= i, j, k below the counts. Copies may overlap.

        period: the vectors a, b and c: a number, for steps of this length along x, y and z; three
            numbers, the lengths of these steps; or three vectors (3, 3), a in the first row.
        counts: how many copies there are along a, b and c; or a number for all three. (5, 1, 1) is
            a row of five.

        Raises:
            ValueError: a period of another shape, not finite, or 0 where there are several copies;
                counts that are not positive integers.
        """
        from harnack.fields.solids.patterns import translations_of, union_of_images

        return union_of_images(self, translations_of(period, counts))

    def mirrored(self, normal: str | Sequence[float] = "x", offset: float = 0.0) -> Solid:
        """The union of the solid and its mirror image. (The mirror image alone is
        transformed(matrix) with the matrix of a reflection.)

        normal: of the mirror: "x", "y", "z" or a vector (3,).
        offset: the distance of the mirror from the origin, along the normal.

        Raises:
            ValueError: a normal that is 0, or an offset that is not finite.
        """
        from harnack.fields.solids.booleans import union
        from harnack.fields.solids.patterns import mirror_image

        return union(self, mirror_image(self, normal, offset))

    def around(self, count: int, axis: str | Sequence[float] = "z") -> Solid:
        """The union of copies of the solid at equal angles around an axis through the origin: the
        solid itself, and copies rotated by multiples of 360/count degrees.

        count: the number of copies, with the solid itself.
        axis: "x", "y", "z" or a vector (3,).

        Raises:
            ValueError: a count that is not a positive integer, or a vector that is 0.
        """
        from harnack.fields.solids.patterns import rotations_of, union_of_images

        return union_of_images(self, rotations_of(count, axis))

    def _apply_map(self, change: SpaceMap) -> Solid:
        """The image of the solid under a map of space. The map is applied to each operand of a
        combination of solids."""
        return self.map_operands(change.apply)


class SolidOfField(Solid):
    """A solid whose function is made from the function of another field, the inner field, for
    example by a change of sign. The solid takes over the inner field's settings for the tracer.

    field: the inner field.
    """

    field: Any

    def _copy_settings(self, *names: str) -> None:
        """Copy from the inner field to this solid what of its traits holds for the solid as well,
        and the attributes with these names."""
        inner = self.field.traits
        traits = dataclasses.replace(
            self.traits, over_relaxation=inner.over_relaxation, is_cheap=inner.is_cheap,
            min_wavelength=inner.min_wavelength, has_variable_accuracy=inner.has_variable_accuracy,
        )  # fmt: skip
        object.__setattr__(self, "traits", traits)
        for name in names:
            object.__setattr__(self, name, getattr(self.field, name))

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def operands(self) -> tuple[Solid, ...]:
        """If the inner field is a combination, the solids of the same kind, such as complements, of
        its operands; otherwise this solid alone."""
        inner = self.field.operands() if isinstance(self.field, Solid) else ()
        return tuple(map(self._with_inner, inner)) if len(inner) > 1 else (self,)

    def _with_inner(self, inner: Field) -> Solid:
        """The same solid made of another inner field."""
        return dataclasses.replace(cast("Any", self), field=inner)


@dataclass(frozen=True, eq=False)
class EvaluatorOfInner(Evaluator):
    """The evaluator of a solid whose function is made from the function of another field, the inner
    field. Its derivatives are those of the inner field, up to their sign.

    inner: the evaluator of the inner field.
    """

    inner: Evaluator

    @property
    def is_steep(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.is_steep

    @property
    def variable_accuracy(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> VariableAccuracy | None:
        inner = self.inner.variable_accuracy
        if inner is None:
            return None
        return VariableAccuracy(lambda scale: replace(self, inner=inner.at(scale)), inner.coarsest)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p, of the gradient and of the Hessian: those of the inner field,
        whose derivatives are the same up to their sign."""
        del sample
        return self.inner.derivative_errors(p, self.inner.evaluate(p))


def without_levels(plan: Plan) -> Plan:
    """The plan for a field whose levels are others than those of the solid that is made of it."""
    return Plan(ray_count=plan.ray_count)


def formula_of(evaluator: Evaluator) -> FormulaFunction:
    """The formula of an evaluator.

    Raises:
        TypeError: it has none.
    """
    formula: FormulaFunction | None = getattr(evaluator, "formula", None)
    if formula is None:
        raise TypeError(f"{evaluator.name} has no formula")
    return formula


def by_numbers(*names: str) -> Traits:
    """The traits of solids with a formula that uses the numbers of these arguments as they are, so
    that it can be differentiated by them."""
    return dataclasses.replace(FormulaSolid.traits, differentiable_arguments=names)


class FormulaSolid(Formula, Solid):
    """A solid whose function f is a formula of the coordinates, its method `formula`. Value,
    gradient and proofs follow from the formula."""

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)
