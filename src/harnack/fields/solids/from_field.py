"""Solids that are made of a field with the function f: all points at which f is below a level,
above a level, or between two levels. f may be angle-valued: then it is known up to multiples of its
period, and a difference of values of f is reduced by the multiple of the period that is nearest to
it. A sample of f at a point is its value and gradient there, with proved bounds of f near the
point. An enclosure is a proved bound of the change of f along a ray, from which follows a length of
ray on which f meets no level. The gaps are the differences between f and the next level below and
above."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.backend.validation import as_finite, check_no_derivatives, has_derivatives
from harnack.enclosures import Enclosure, LevelGaps
from harnack.enclosures.samples import Ray, RaySample, Sample, value_error_bound
from harnack.fields.attached_numbers import has_own_formula, own_formula
from harnack.fields.clearance import bounded_side_extent
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, check_is_field
from harnack.fields.formula import Formula, on_backend
from harnack.fields.formula_evaluator import is_jet
from harnack.fields.number_table import plain_numbers
from harnack.fields.solids.booleans import Complement, OffsetSolid, lipschitz_of, negated_sample
from harnack.fields.solids.mesh_solid import looks_like_mesh, solid_of_mesh
from harnack.fields.solids.solid import (
    EvaluatorOfInner,
    Solid,
    SolidOfField,
    formula_of,
    without_levels,
)
from harnack.geometry.meshes import mesh_arrays

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.geometry import Volume


def solid(
    field: Any,
    *,
    below: float | None = None,
    above: float | None = None,
    between: tuple[float, float] | None = None,
    around: tuple[float, float] | None = None,
) -> Solid:
    """Make a solid: the one that a closed mesh bounds; or the set of all points at which a field is
    below a level, above a level, or between two levels.

    field: a field, together with exactly one of the four level arguments; or, without these, a
        mesh: a trimesh.Trimesh, a pair (vertices (n, 3), faces (m, 3)), or the path of a surface
        file. The solid of a mesh is a `MeshSolid`, whose f is the signed distance from the mesh.
    below, above: a level.
    between: (low, high), two levels.
    around: (level, half_width): the points at which f is at most half_width from the level. Use
        this for an angle-valued field, for example to thicken a surface that spans a knot.

        hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3)) & hk.Torus(0.8, 0.3)
        hk.solid("part.stl") - hk.Cylinder(2.0, 50.0)

    Raises:
        TypeError: the argument is neither a field nor a mesh.
        ValueError: none, or more than one, of the four level arguments for a field; numbers out of
            range; a field with jumps; an angle-valued field without `around`; a mesh that bounds no
            solid (`MeshError`).
    """
    bounds = [bound for bound in (below, above, between, around) if bound is not None]
    if looks_like_mesh(field):
        if bounds:
            raise ValueError(
                "a mesh is solid by itself: below=, above=, between= and around= are for fields; "
                "solid(mesh).offset(d) moves its surface by d, and solid(mesh).shell(t) hollows it"
            )
        return solid_of_mesh(field)
    if not isinstance(field, Formula | Solid):
        check_no_derivatives("solid", field)
    if len(bounds) != 1:
        _check_is_no_mesh(field)
        raise ValueError("give exactly one of below=, above=, between=, around=")
    check_is_field(field)
    if field.traits.has_jumps:
        raise ValueError(
            f"{type(field).__name__} jumps across sheets: values on both sides of a level may meet "
            "without any in between, so it bounds no solid"
        )
    # `between` and `around` have two numbers, `below` and `above` one.
    is_band = between is not None or around is not None
    numbers = _levels(bounds[0] if is_band else (bounds[0],), 2 if is_band else 1)
    levels: Any = bounds[0] if is_band else (bounds[0],)
    is_attached = has_derivatives(levels)
    if numbers is None:
        count = ", two of them" if is_band else ""
        raise ValueError(f"levels must be finite numbers{count}, not {bounds[0]!r}")
    if field.period is not None and around is None:
        raise ValueError(
            f"{type(field).__name__} is angle-valued: no value is below another. Use "
            "around=(level, half_width) for the solid near a level"
        )
    # f <= level is an offset of f <= 0; f >= level is the complement.
    sublevel = SublevelSolid(field)
    if below is not None:
        return OffsetSolid(sublevel, levels[0])
    if above is not None:
        return Complement(OffsetSolid(sublevel, levels[0]))
    lower, upper = numbers
    # Here `around` is given: lower is its level, and upper its half width.
    if around is not None:
        return BandSolid(field, levels[0], levels[1])
    if not lower < upper:
        raise ValueError(f"between must be (low, high) with low < high, not {between}")
    if is_attached:
        lower, upper = levels
    return BandSolid(field, (lower + upper) * 0.5, (upper - lower) * 0.5)


def _check_is_no_mesh(argument: Any) -> None:
    """Raise a TypeError that says how meshes are given, if the argument of `solid` may have been
    meant as one: it is no field, and no name."""
    if not isinstance(argument, Field | str | os.PathLike):
        mesh_arrays(argument)


def _levels(levels: Any, count: int) -> tuple[float, ...] | None:
    """The levels as a tuple of floats; None unless they are `count` finite numbers."""
    try:
        numbers = tuple(plain_numbers(level).item() for level in levels)
        numbers = tuple(float(number) for number in numbers)
    except (TypeError, ValueError):
        check_no_derivatives("a solid of a field", levels)
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


def _check_has_formula_if_attached(solid: SublevelSolid | BandSolid) -> None:
    """Raise NotImplementedError if a solid is made of a field with derivatives that has no formula
    through which they pass."""
    if not isinstance(solid.field, Formula | Solid):
        check_no_derivatives(type(solid).__name__, solid.field)


@dataclass(frozen=True, eq=False)
class SublevelSolid(SolidOfField):
    """The solid of the points where a field's function f is at most 0. So the solid has the
    function f itself.

    field: any field.
    """

    traits = dataclasses.replace(SolidOfField.traits, differentiable_arguments=("field",))

    field: Field

    def __post_init__(self) -> None:
        _check_has_formula_if_attached(self)
        self._copy_settings()
        domain = None if self.field.traits.is_global else self.field.domain
        object.__setattr__(self, "domain", domain)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A volume that is proved to contain all points where f <= level or, if `above`, all points
        where f >= level. None if no such volume is known, as for a field that is defined in all of
        space."""
        if self.field.traits.is_global:
            return None

        def is_inside(value: float) -> bool:
            """Whether points at which f is `value` are among the points that the volume must
            contain."""
            return value >= level if above else value <= level

        return bounded_side_extent(self.field, (level,), is_inside)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> _SublevelSolidEvaluator:
        inner = self.field.evaluator(backend, plan)
        has_formula = isinstance(self.field, Formula) and has_own_formula(self.field)
        return _SublevelSolidEvaluator(inner, type(self.field).__name__, has_formula)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if isinstance(self.field, Formula | Solid) and has_own_formula(self.field):
            return self.field.formula(x, y, z)
        number = x.backend_number() if is_jet(x, type(self.field).__name__) else x
        return self.evaluator(backend_of(number)).formula(x, y, z)


@dataclass(frozen=True, eq=False)
class _SublevelSolidEvaluator(EvaluatorOfInner):
    """The evaluator of a `SublevelSolid`, whose function is that of the field.

    field_name: the name of the field's class, for messages.
    has_formula: whether the field is a `Formula` with a formula of its own function.
    """

    field_name: str
    has_formula: bool

    def evaluate(self, p: Vec3) -> Sample:
        return self.inner.evaluate(p)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self.inner.hessian(p)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        return self.inner.sample_ray(path, t, ahead, back)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers or jets; of a `Formula`, numbers of any
        arithmetic."""
        if self.has_formula:
            return formula_of(self.inner)(x, y, z)
        if not is_jet(x, self.field_name):
            return self.differentiable_value(_vector(x, y, z))
        return field_jet(self.inner, x, y, z, self.field_name)


def _vector(x: Real, y: Real, z: Real) -> Vec3:
    """The Dr.Jit 3-vector with these components."""
    return backend_of(x).Array3f(x, y, z)


def field_jet(evaluator: Evaluator, x: Jet, y: Jet, z: Jet, name: str) -> Jet:
    """The jet of a field f (proved ranges of its value and derivatives), from the jets of the
    coordinates. It lets a field without a formula be used in formulas of solids. The field's
    samples must promise a bound of second derivatives near the point.

    evaluator: the evaluator of the field.
    x, y, z: the jets of the coordinates, at a point or on a piece of a line.
    name: the name of the field's class, for a message.

    Proof. Let q be the point, or the start of the piece, and |f''| <= H within the distance r of q.
    Let all points of the piece be within m of q, rounding included. If m <= r, the gradient on the
    piece differs from that at q by at most H m, by the mean value theorem. Derivatives along the
    line follow by the chain rule. The value is the value at the start plus the length times the
    range of the derivative. If m > r, derivatives are not bounded. Second derivatives at a point,
    if all six are asked for, are those of the field's Hessian. Their error is the one that the
    field states (without the effect of the rounding of coordinates). It is at most 2 H, as the
    computed and the true second derivatives are at most H.

    Raises:
        TypeError: the field has no proved bound of its second derivatives.
    """
    # Jets at the start of the piece; at a point, the jets themselves.
    coordinates = (x, y, z)
    starts = [entry if entry.jet_at_start is None else entry.jet_at_start for entry in coordinates]
    # q is the middle of the ranges of the coordinates, and `offset` bounds its distance from the
    # start, which is known up to rounding. (0 times a number of the backend gives arrays, not
    # Python numbers.)
    q = _vector(*(0 * x.piece_length + entry.value.midpoint for entry in starts))
    sample = evaluator.evaluate(q)
    bound, radius = _second_derivative_bound(sample, name)
    offset = safe_norm(type(q)(*(0 * x.piece_length + entry.value.radius for entry in starts)))
    rows = _hessian_rows(evaluator, q) if len(x.second_derivatives) == _PAIR_COUNT else None
    second_error = 2 * bound
    if rows is not None:
        is_point = offset <= _MAX_POINT_ROUNDINGS * float(dr.epsilon(type(q.x))) * max_norm(q)
        second_error = dr.select(
            # The second result bounds the error of the Hessian.
            is_point,
            fmin(second_error, evaluator.derivative_errors(q, sample)[1]),
            second_error,
        )

    def derivative_ranges(
        jets: list[Jet], distance: Real
    ) -> tuple[tuple[Interval, ...], tuple[Interval, ...]]:
        """Return two tuples: the ranges of the first derivatives of f with respect to the variables
        of the jets, and those of the second derivatives, by the chain rule.

        jets: the jets of the three coordinates.
        distance: a bound of the distance from q to all points of the box of these jets (m in the
            proof).
        """
        # The bound H, infinite if the jets reach beyond its ball; and by how much the gradient on
        # the box may differ from that of the sample at q.
        limit = dr.select(distance <= radius, bound, dr.inf)
        spread = limit * distance * (1 + 1e-5) + sample.gradient_error
        slopes = [Interval(entry - spread, entry + spread) for entry in sample.gradient]
        first = tuple(
            _interval_sum(
                g * entry.first_derivatives[i] for g, entry in zip(slopes, jets, strict=True)
            )
            for i in range(len(x.first_derivatives))
        )
        # Bounds of the length of the derivative of (x, y, z) by each variable.
        speeds = [
            safe_norm(
                type(q)(
                    *(0 * x.piece_length + entry.first_derivatives[i].max_abs for entry in jets)
                )
            )
            for i in range(len(x.first_derivatives))
        ]
        second: list[Interval] = []
        for k, (i, j) in enumerate(
            _variable_pairs(len(x.first_derivatives), len(x.second_derivatives))
        ):
            # The part grad f . d^2 (x, y, z); the part of the Hessian of f follows.
            rate = _interval_sum(
                g * entry.second_derivatives[k] for g, entry in zip(slopes, jets, strict=True)
            )
            # (1e-5 covers the rounding of the products.)
            if rows is None:
                margin = limit * speeds[i] * speeds[j] * (1 + 1e-5)
            else:
                margin = second_error * speeds[i] * speeds[j] * (1 + 1e-5)
                terms = (
                    row[n] * (left.first_derivatives[i] * right.first_derivatives[j])
                    for row, left in zip(rows, jets, strict=True)
                    for n, right in enumerate(jets)
                )
                rate = rate + _interval_sum(terms)
            second.append(rate + Interval(-margin, margin))
        return first, tuple(second)

    # The error of the value includes the change of f within `offset` of q.
    slope = safe_norm(sample.gradient) + sample.gradient_error
    epsilon = 2 * float(dr.epsilon(type(q.x)))  # the machine epsilon
    error = sample.value_error + 8 * epsilon * dr.abs(sample.value)
    error = (error + offset * (slope + dr.select(offset <= radius, bound, dr.inf) * offset)) * (
        1 + 1e-5
    )
    value = Interval(sample.value - error, sample.value + error)
    first, second = derivative_ranges(starts, offset)
    start = Jet(value, first, second, piece_length=starts[0].piece_length)
    if x.jet_at_start is None:
        return start
    # The distance from q to the farthest point of the whole piece.
    offsets = (
        fmax(dr.abs(entry.value.upper - m), dr.abs(entry.value.lower - m))
        for entry, m in zip(coordinates, q, strict=True)
    )
    first, second = derivative_ranges(list(coordinates), safe_norm(type(q)(*offsets)) * (1 + 1e-5))
    # The lengths along the piece, from 0 to its end.
    span = Interval(0 * x.piece_length, 0 * value.lower + x.piece_length)
    return Jet(value + first[0] * span, first, second, start, x.piece_length)


def _interval_sum(terms: Iterable[Interval]) -> Interval:
    """The sum of intervals."""
    total = Interval(0.0, 0.0)
    for term in terms:
        total = total + term
    return total


def _variable_pairs(n: int, count: int) -> list[tuple[int, int]]:
    """The first `count` pairs (i, j) with i <= j of n variables, in the order of the entries of
    `Jet.second_derivatives`: the upper triangle of a matrix, row by row."""
    return [(i, j) for i in range(n) for j in range(i, n)][:count]


# The number of second derivatives with respect to three coordinates. And a number of roundings:
# coordinates with an error of at most so many roundings stand for a point, others for a range.
_PAIR_COUNT, _MAX_POINT_ROUNDINGS = 6, 256.0


def _hessian_rows(evaluator: Evaluator, q: Vec3) -> list[list[Interval]] | None:
    """The rows of the Hessian of a field at a point q, with each entry as an interval of a single
    number; None for a field without a Hessian."""
    try:
        rows = evaluator.hessian(q)
    except NotImplementedError:
        return None
    return [[Interval.point(number) for number in row] for row in rows]


def _second_derivative_bound(sample: Sample, name: str) -> tuple[Real, Real]:
    """A bound of the second derivatives of a field along all lines, on a ball about the point of a
    sample, and the radius of that ball. It follows from the first of the sample's promises (proved
    bounds of f near the point) that implies one.

    name: the name of the field's class, for the message.

    Raises:
        TypeError: no promise implies such a bound.
    """
    for promise in sample.all_promises:
        bound = promise.implied_second_derivative_bound(sample.value)
        if bound is not None:
            return bound
    raise TypeError(
        f"{name} promises neither a HarmonicBall with both ends nor a Curvature "
        "without a radius, and has no formula, so it cannot be blended, twisted or tapered; "
        "move it by moved, rotated, scaled or transformed, and join it by |, & and -"
    )


@dataclass(frozen=True, eq=False)
class BandSolid(SolidOfField):
    """The solid of the points where a field's function f differs from a level by at most
    half_width. The function of the solid is |f - level| - half_width. If f is angle-valued, f -
    level is reduced by the nearest multiple of the period.

    Proof of steps. The function of the solid changes as f does, up to the sign. It takes the value
    v only where f is level + v + half_width or level - v - half_width, or one of these plus a
    multiple of the period. So it does not reach v as long as f stays away from all these numbers
    (`FoldedEnclosure`).
    """

    traits = dataclasses.replace(
        SolidOfField.traits, differentiable_arguments=("field", "level", "half_width")
    )

    field: Field
    level: float
    half_width: float

    def __post_init__(self) -> None:
        """Check the numbers, and take over the settings of the field.

        Raises:
            ValueError: a number is not finite, or half_width is not positive or too large.
        """
        _check_has_formula_if_attached(self)
        numbers = self.level, self.half_width
        object.__setattr__(self, "level", as_finite(self.level, "level"))
        object.__setattr__(self, "half_width", as_finite(self.half_width, "half_width"))
        if not self.half_width > 0:
            raise ValueError(f"half_width must be positive, not {self.half_width:g}")
        period = self.field.period
        if period is not None:
            check_no_derivatives("a solid around a level of an angle", numbers)
        if period is not None and not 2 * self.half_width < period:
            raise ValueError(f"half_width must be below {period / 2:g}, half of the period")
        self._copy_settings()
        domain = None if self.field.traits.is_global else self.field.domain
        object.__setattr__(self, "domain", domain)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        inner = self.field.evaluator(backend, without_levels(plan))
        level, half_width = on_backend((self.level, self.half_width), backend)
        return _BandSolidEvaluator(inner, level, half_width, self.field.period)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if not hasattr(self.field, "formula"):
            return super().formula(x, y, z)
        return abs(own_formula(self.field)(x, y, z) - self.level) - self.half_width

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A volume that is proved to contain all points where the solid's function, |f -
        self.level| - half_width, is at most the argument `level`. These points lie between two
        level sets of f. With `above` the volume contains all points where the solid's function is
        at least `level`.

        The field's domain (outside of which f is not defined) is returned with `above`, and if no
        smaller volume is known. None if there is no domain.
        """
        # The two values of f on the surface of these points.
        ends = tuple(self.level + sign * (self.half_width + level) for sign in (-1, 1))
        if above or (self.field.traits.is_global and self.field.period is None):
            return self.domain

        def is_inside(value: float) -> bool:
            """Whether points at which f is `value` are among the points that the volume must
            contain."""
            offset, period = value - self.level, self.field.period
            if period is not None:
                offset -= period * round(offset / period)
            return abs(offset) <= self.half_width + level

        return bounded_side_extent(self.field, ends, is_inside)


@dataclass(frozen=True, eq=False)
class _BandSolidEvaluator(EvaluatorOfInner):
    """The evaluator of a `BandSolid`, from that of f.

    level, half_width: kernel parameters.
    period: the period of f; None if f is real-valued.
    """

    level: Real
    half_width: Real
    period: float | None

    def evaluate(self, p: Vec3) -> Sample:
        return self._sample_with_difference(self.inner.evaluate(p))[0]

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        is_below = self._level_difference(self.inner.evaluate(p).value) < 0
        x, y, z = (dr.select(is_below, -row, row) for row in self.inner.hessian(p))
        return x, y, z

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p, of the gradient and of the Hessian: those of the field f. Both are
        infinite where rounding leaves open whether f is above or below the level, since derivatives
        jump there. For an angle-valued f they are also infinite where rounding leaves open which
        multiple of the period is nearest.

        sample: the sample of the solid at p; not used.
        """
        inner_sample = self.inner.evaluate(p)
        first_error, second_error = self.inner.derivative_errors(p, inner_sample)
        error = value_error_bound(inner_sample, safe_norm(inner_sample.gradient), max_norm(p))
        # The difference between f and the nearest value at which derivatives jump: the level or,
        # for an angle-valued f, also the value half a period away from it.
        kink_distance = dr.abs(self._level_difference(inner_sample.value))
        if self.period is not None:
            kink_distance = fmin(kink_distance, 0.5 * self.period - kink_distance)
        is_clear = kink_distance > error
        return dr.select(is_clear, first_error, dr.inf), dr.select(is_clear, second_error, dr.inf)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample of |f - level| - half_width at the point of a ray with parameter t, with
        enclosures (proved bounds of its change along the ray), from the ray sample of f. The
        enclosures are `FoldedEnclosure`s.

        path: the ray.
        ahead, back: the lengths in front of and behind the point up to which enclosures are useful.
        """
        ray_sample = self.inner.sample_ray(path, t, ahead, back)
        sample, offset = self._sample_with_difference(ray_sample.sample)

        def folded(enclosures: tuple[Enclosure, ...]) -> tuple[Enclosure, ...]:
            """The enclosures of |f - level|, from the given enclosures of f: one for each."""
            return tuple(
                FoldedEnclosure(enclosure, offset, self.period) for enclosure in enclosures
            )

        # The absolute value reverses the slope where f is below the level.
        slope = dr.mulsign(ray_sample.slope, offset)
        forward, backward = folded(ray_sample.forward), folded(ray_sample.backward)
        return RaySample(
            sample, forward, backward, slope, ray_sample.reach_growth, ray_sample.slope_error
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """The function of the solid at coordinates that are numbers of any arithmetic. Raises
        TypeError if the field has no formula."""
        return abs(formula_of(self.inner)(x, y, z) - self.level) - self.half_width

    def _level_difference(self, value: Real) -> Real:
        """f - level. If f is angle-valued, the multiple of its period that is nearest is
        subtracted.

        value: f.
        """
        offset, period = value - self.level, self.period
        return offset if period is None else offset - period * dr.round(offset / period)

    def _sample_with_difference(self, sample: Sample) -> tuple[Sample, Real]:
        """Two results: the sample of |f - level| - half_width, from the sample of f at the same
        point; and the difference f - level, reduced by the nearest multiple of the period if f is
        angle-valued.

        The only promise of the new sample (a proved bound near the point) is a Lipschitz constant
        of f, if one is known. Other bounds of f are not bounds of |f - level|, whose gradient jumps
        at the level.
        """
        offset = self._level_difference(sample.value)
        negated = negated_sample(sample)
        is_below = offset < 0
        epsilon = 2 * float(dr.epsilon(type(offset)))  # the machine epsilon
        # The rounding of the two differences.
        rounding = 8 * epsilon * (dr.abs(sample.value) + abs(self.level) + self.half_width)
        lipschitz = lipschitz_of(sample)
        # Where f is below the level, |f - level| has the opposite gradient.
        return replace(
            sample,
            value=dr.abs(offset) - self.half_width,
            gradient=dr.select(is_below, negated.gradient, sample.gradient),
            value_error=sample.value_error + rounding,
            shading_normal=None,
            promises=() if lipschitz is None else (lipschitz,),
            alternative_promises=(),
            ray_promises=(),
        ), offset


@dataclass(frozen=True)
class FoldedEnclosure(Enclosure):
    """A proved bound of the change of |r| along a line, from an enclosure (such a bound) of a
    function r. The gaps are the differences between |r| at the start and its next level below and
    above. If there is a period, r is known up to multiples of it, and |r| stands for the distance
    of r from the nearest multiple.

    inner: the enclosure of r.
    offset: r at the start of the line, within half a period of 0.
    period: the period of r; None if there is none.

    Proof. |r| rises by g only where r reaches plus or minus (|r| + g), with |r| taken at the start,
    or one of these two numbers plus a multiple of the period. It falls by g only where r reaches
    plus or minus (|r| - g), or one of these two numbers plus a multiple of the period. The nearest
    of all these numbers above and below r are the levels of r. If |r| - g < 0, or |r| + g is more
    than half a period, |r| never takes this value.
    """

    inner: Enclosure
    offset: Real
    period: float | None

    def free_length(self, gaps: LevelGaps) -> Real:
        return self.inner.free_length(self._gaps_of_offset(gaps))

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        return self.inner.is_free(self._gaps_of_offset(gaps), length)

    def _gaps_of_offset(self, gaps: LevelGaps) -> LevelGaps:
        """The gaps of r: how far r must rise, and how far it must fall, until |r| reaches one of
        its next levels. A gap is infinite if that cannot happen.

        gaps: the differences between |r| at the start and its next level below and above.

        Let s = |r| at the start. The levels of |r| are B = s - gaps.below and A = s + gaps.above. B
        is reached only if B >= 0. If r has a period P, then s <= P/2, |r| stands for the distance
        of r from the nearest multiple of P, and |r| is at most P/2, so A is reached only if A <=
        P/2. Let r >= 0 at the start. If r rises, |r| can be A at r = A, and B at r = P - B, which
        is at the distance B from the multiple P. If r falls, |r| can be B at r = B, and A at r =
        -A. If r < 0, the two directions are exchanged.
        """
        size, inf = dr.abs(self.offset), type(self.offset)(dr.inf)
        has_below = gaps.below <= size * _ROUNDING_FACTOR
        # Gaps for r >= 0: up to A, and down to -A, at the distance s + A.
        upwards, downwards = gaps.above, 2 * size + gaps.above
        if self.period is not None:
            has_above = size + gaps.above <= 0.5 * self.period * _ROUNDING_FACTOR
            upwards, downwards = (dr.select(has_above, gap, inf) for gap in (upwards, downwards))
            # The distance from r = s up to P - B.
            wrapped = self.period - 2 * size + gaps.below
            upwards = dr.select(has_below, fmin(wrapped, upwards), upwards)
        downwards = dr.select(has_below, fmin(gaps.below, downwards), downwards)
        # NaN proves nothing.
        is_valid = (gaps.below >= 0) & (gaps.above >= 0) & (size >= 0)
        upwards, downwards = (dr.select(is_valid, gap, dr.nan) for gap in (upwards, downwards))
        # If r < 0, exchange the two directions. The gap below comes first in `LevelGaps`.
        is_positive = self.offset >= 0
        return LevelGaps(
            dr.select(is_positive, downwards, upwards), dr.select(is_positive, upwards, downwards)
        )


# A factor that covers the rounding in tests whether |r| can take a value.
_ROUNDING_FACTOR = 1.0 + 1e-5
