"""The evaluator of fields that are defined by a formula. The formula is evaluated with jets: ranges
(intervals) of a number and of its derivatives. Jets of the coordinates at a point give the value
and gradient of f, with bounds of their rounding. Jets of the coordinates along a piece of a ray
give the ranges of the derivatives of f there, from which steps along the ray are proved."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.arithmetic.interval import machine_epsilon
from harnack.arithmetic.jet import Dual
from harnack.arithmetic.operators import FormulaNumber, Tally
from harnack.backend.elementary import fmin, max_norm, safe_norm
from harnack.backend.validation import check_no_derivatives
from harnack.enclosures import Lipschitz, SlopeRange
from harnack.enclosures.enclosure import PathPiece
from harnack.enclosures.parabola import ConvexityEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.evaluator import Evaluator
from harnack.fields.field import refuse_hidden_parameters

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.enclosures import Promise


FormulaFunction: TypeAlias = Callable[[Any, Any, Any], Any]
"""A formula as a function of three coordinates, which may be numbers of any arithmetic."""

# Radii of the balls on which a Lipschitz constant is computed, in multiples of |f|/|grad f|; and
# the largest radius.
_RADII, _MAX_RADIUS = (0.25, 1.0, 4.0), 1e12
# At a tie (a point at which two branches of the formula are equal, as at x = 0 for max(x, 0)) the
# gradient is taken at a point this many roundings of coordinates and value away. The direction to
# that point is the direction of the middle gradient (a unit vector or 0) plus the vector
# `_TIE_DIRECTION`, so that it runs along no tie.
_TIE_OFFSET, _TIE_DIRECTION = 64.0, (0.31, 0.19, 0.13)
# If the error of the gradient is at most this many roundings, there is no tie.
_TIE_THRESHOLD = 1024.0
# If a formula may jump, or is abrupt, pieces of a ray begin this many roundings of t before the
# point.
_ROUNDINGS_BEFORE = 8.0

# Whether samples of formulas omit alternative promises (`without_alternatives`).
_WITHOUT_ALTERNATIVES: ContextVar[bool] = ContextVar("without_alternatives", default=False)


@contextmanager
def without_alternatives() -> Generator[None]:
    """A context within which samples of formulas are computed without their alternative promises,
    which are further proved bounds of f near the point that are rarely used. To record these takes
    several times as long as value and gradient. The context is for callers that use value and
    gradient only."""
    token = _WITHOUT_ALTERNATIVES.set(True)
    try:
        yield
    finally:
        _WITHOUT_ALTERNATIVES.reset(token)


@dataclass(frozen=True, eq=False)
class FormulaEvaluator(Evaluator):
    """The evaluator of a formula. A formula "may jump" if it uses functions that are not
    continuous, and is "abrupt" if it may change by far more than its slopes allow within the
    rounding of coordinates.

    field: the formula's field (`Formula`), with Python numbers.
    formula: f as a function of three coordinates, with the numbers of the backend.
    lipschitz: a proved bound of |grad f| everywhere, as a number of the backend or of Python; None
        if none is known.
    """

    field: Any
    formula: FormulaFunction
    lipschitz: Real | None

    def __post_init__(self) -> None:
        """Compute a constant that is a sum of numbers of the backend. A kernel that is recorded
        would compute it for each of its lanes, and keep that as the number."""
        if dr.is_array_v(type(self.lipschitz)):
            dr.eval(self.lipschitz)

    @property
    def name(self) -> str:
        """The name of the field's class, for messages."""
        return type(self.field).__name__

    @functools.cached_property
    def tally(self) -> Tally:
        """The field's summary of the formula's operations."""
        return self.field.tally

    @functools.cached_property
    def may_jump(self) -> bool:
        """Whether f may jump, by what the field knows of the formula."""
        return self.field.may_jump

    @property
    def is_convex(self) -> bool:
        """Whether f is known to be convex."""
        return self.field.is_convex

    @property
    def max_radius(self) -> Real:
        """The largest radius of a ball within which a Lipschitz constant is computed."""
        return _MAX_RADIUS

    @property
    def is_steep(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the formula uses an operation that may have a vertical tangent or a pole, or f
        changes so fast that it acts like a pole within the rounding of coordinates
        (`is_abrupt`)."""
        return self.tally.is_steep or self.is_abrupt

    @property
    def is_abrupt(self) -> bool:
        """Whether f may change within the rounding of coordinates by far more than its slopes
        allow, as a steep step between two flat parts does.

        `Tally.turns_within` estimates this from the constants in the formula. A part of the formula
        such as max(y, 0.01) can turn from flat to steep and to flat again while it changes by as
        little as its constant. So f counts as abrupt if, within some roundings of the coordinates,
        its steepest part may change by as much as the smallest constant (`tally.finest`).

        If a Lipschitz constant is stated, values of f are about as large as distances, as for the
        library's shapes. Then small constants are mere lengths, and 1 is taken in place of the
        smallest one, so that only large constants make f abrupt.
        """
        # self.lipschitz: the stated Lipschitz constant of f, or None.
        return self.tally.turns_within(1.0 if self.lipschitz is not None else self.tally.finest)

    def evaluate(self, p: Vec3) -> Sample:
        sample = self._with_one_sided_gradient(p, self.sample_without_alternatives(p))
        # Derivatives of the value that do not come from p would be lost.
        if not dr.grad_enabled(p):
            check_no_derivatives(self.name, sample.value)
        if _WITHOUT_ALTERNATIVES.get():
            return sample
        return dataclasses.replace(sample, alternative_promises=self._local_lipschitz(p, sample))

    def differentiable_value(self, p: Vec3) -> Real:
        refuse_hidden_parameters(self.field)
        return super().differentiable_value(p)

    def _with_one_sided_gradient(self, p: Vec3, sample: Sample) -> Sample:
        """The sample at p, where the gradient is that of one side if p lies on a tie of the
        formula.

        A tie is a point at which two branches of a formula are equal, such as x = 0 for max(x, 0).
        There the jet gives a range of gradients. The range contains all gradients nearby, and
        further ones if terms of several ties are added, as on the faces of
        `orthogonal_intersection`. The middle of the range is the gradient at no point, but its
        direction mostly leads across the tie. So f is evaluated once more, with dual numbers
        (`Dual`), at a point a few roundings away, in about this direction, and the gradient there
        is used.

        Proof of the error. The gradient at p lies within `gradient_error` of the middle. If the
        second gradient is farther from the middle than twice that error, it does not come from a
        tie at p: the gradient of f changes that much over these few roundings, as that of a sine of
        a large angle does. In this case the middle is kept. Otherwise the error is `gradient_error`
        plus the distance of the second gradient from the middle.
        """
        epsilon = float(dr.epsilon(type(p.x)))
        is_bounded = dr.isfinite(sample.gradient_error + dr.sum(sample.gradient))
        # An unbounded range has no middle: 0 with an infinite error stands for it.
        middle = dr.select(is_bounded, sample.gradient, 0)
        error = dr.select(is_bounded, sample.gradient_error, dr.inf)
        norm = safe_norm(middle)
        # The vector that is added makes sure that the direction runs along no tie.
        direction = dr.select(norm > 0, middle / norm, 0) + type(p)(*_TIE_DIRECTION)
        size = max_norm(p) + dr.abs(sample.value)
        # Numbers in the formula may be larger than p: over the length in which f changes by the
        # error of its value, they change by about their rounding.
        length = sample.value_error / (norm + error)
        size = size + dr.select(dr.isfinite(length), length / epsilon, 0)
        # At the origin with f = 0 any offset will do.
        size = dr.select(size > 0, size, 1)
        # Value and gradient at a point a few roundings away.
        coordinates = Dual.at_point(p + direction * (_TIE_OFFSET * epsilon * size))
        try:
            nearby_value = coordinates[0].coerce(self.formula(*coordinates))
        except TypeError:  # a formula that accepts only ranges, as that of noise
            return sample
        gradient = type(p)(*(0 * p.x + component for component in nearby_value.first_derivatives))
        change = safe_norm(gradient - middle)
        # Not a tie if the error is mere rounding, or if the second gradient is too far from the
        # middle: see the docstring. NaN and infinity are no tie either.
        is_tie = (
            (error > _TIE_THRESHOLD * epsilon * norm) & (change <= 2 * error) & dr.isfinite(change)
        )
        return dataclasses.replace(
            sample,
            gradient=dr.select(is_tie, gradient, sample.gradient),
            gradient_error=dr.select(is_tie, error + change, error),
        )

    def sample_without_alternatives(self, p: Vec3) -> Sample:
        """The sample at p with the proved bounds of `promises` only. Samples on rays use no
        others."""
        return self.sample_of_jet(self._jet(Jet.at_point(p)), p)

    def sample_of_jet(self, jet: Jet, p: Vec3) -> Sample:
        """The sample at p, made from `jet`, the jet of f at p. Value and gradient are the midpoints
        of the ranges in it; their errors are half the widths of the ranges."""
        # Adding it turns a Python number into a Dr.Jit array.
        zero = 0 * p.x
        gradient = type(p)(*(zero + derivative.midpoint for derivative in jet.first_derivatives))
        # The sum of the three half widths is a bound of the error as a length.
        gradient_error = zero
        for derivative in jet.first_derivatives:
            gradient_error = gradient_error + derivative.radius
        promises = self.promises(p)
        value, error = zero + jet.value.midpoint, zero + jet.value.radius
        return Sample(value, gradient, promises, error, gradient_error)

    def _local_lipschitz(self, p: Vec3, sample: Sample) -> tuple[Lipschitz, ...]:
        """Lipschitz constants of f on three balls around p, as promises (proved bounds of f near
        p). Each constant is a bound of |grad f| on the box around the ball.

        sample: the sample of f at p. The radii are the multiples `_RADII` of |f|/|grad f|, which
            estimates the distance to the level 0 (one step of Newton's method).

        Where no bound is known, the promise has the radius 0.
        """
        newton_length = dr.abs(sample.value) / safe_norm(sample.gradient)
        promises: list[Lipschitz] = []
        for multiple in _RADII:
            radius = fmin(multiple * newton_length, self.max_radius)
            jet = self._jet(Jet.over_ball(p, radius))
            slopes = (0 * p.x + derivative.max_abs for derivative in jet.first_derivatives)
            # A bound of the length of the gradient, from bounds of its components, and enlarged for
            # rounding.
            constant = safe_norm(type(p)(*slopes)) * (1 + 1e-5)
            is_known = dr.isfinite(constant) & (radius > 0)
            promises.append(
                Lipschitz(dr.select(is_known, constant, dr.inf), dr.select(is_known, radius, 0))
            )
        return tuple(promises)

    def promises(self, p: Vec3) -> tuple[Promise, ...]:
        """Proved bounds of f that hold in every direction from p, as a tuple of promises. It holds
        the Lipschitz constant, and is empty if this is not known."""
        return () if self.lipschitz is None else (Lipschitz(0 * p.x + self.lipschitz),)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        jet = self._jet(Jet.at_point(p, order=2))
        xx, xy, xz, yy, yz, zz = (0 * p.x + entry.midpoint for entry in jet.second_derivatives)
        vector = cast("Any", type(p))
        return vector(xx, xy, xz), vector(xy, yy, yz), vector(xz, yz, zz)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p: of the gradient, as stated in the sample, and of the Hessian. The
        latter follows from the ranges of the second derivatives, which include rounding and ties of
        the formula."""
        return sample.gradient_error, hessian_error(self._jet(Jet.at_point(p, order=2)), p.x)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with enclosures (proved bounds of the
        change of f along the ray) in front of the point, up to the length `ahead`. They follow from
        the ranges of the formula's derivatives along the ray. If the ranges give none, the
        enclosures of `Ray.enclose` are returned, which follow from the sample alone. There are no
        enclosures behind the point. Slopes and errors include all rounding: f is evaluated with
        intervals.

        path: the ray.
        ahead, back: the lengths in front of and behind the point; `back` is not used.

        Proof that no jump of f is passed. If a piece of the ray holds a jump, the range of f' on it
        is all numbers. A march steps from t to t + s, rounded. This point may lie beyond the s that
        was proved, and the march goes on from a point that is rounded again. A jump between these
        two points would be missed from both. So if f may jump, the piece begins before t, by more
        than the rounding of t, and covers all lines that lead through the point up to its rounding
        (`FormulaOnRay.rounded`). Then the exact ray up to t + s lies in such pieces altogether, and
        they have no jump.

        Proof that no level is passed if f is abrupt (`is_abrupt`), as max(-1, min(1, 1e9 y)) is. At
        the rounded point p, f may be -1 with slope 0, although f is 1 at the exact point of the
        ray. So for an abrupt f two things are widened. The range of slopes at the start holds at
        all points that round to p. And the pieces begin before p, and cover all lines through these
        points, as above. So both hold for the exact ray. What is left is the value at the start: f
        at the exact point differs from f(p) by at most `tracer.steep.SteepPlace.error`, which the
        tracer takes as the error of the value. So the free lengths hold for the exact ray.

        If f is not abrupt, the enclosures hold for the ray through p, and the tracer's error of the
        value covers the difference to the exact ray. The only exception is a ray that passes the
        end of a surface thinner than rounding.
        """
        del back
        p = path.point(t)
        jet = self._jet(Jet.at_point(p))
        sample = self.sample_of_jet(jet, p)
        slope, slope_error = self._slope(p, path.direction)
        slopes = SlopeRange.around(slope, slope_error)
        function = self.restrict(p, path.direction)
        # The two proofs of the docstring: slopes of all points that round to p, and pieces that
        # begin before p.
        if self.is_abrupt:
            slopes = SlopeRange.around(*self._slope(p, path.direction, is_rounded=True))
        if self.is_abrupt or self.may_jump:
            function = function.rounded(t)
        enclosures = path.proofs.from_restriction(function, slopes, ahead)
        if not enclosures:
            return self.enclose_by_promises(path, p, sample)
        # A `PiecewiseTaylorEnclosure` proves nothing on a piece whose slopes are unbounded. The
        # other kinds assume that f is continuous, so they are made only for a length on which that
        # is proved.
        if self.may_jump and not all(
            isinstance(entry, PiecewiseTaylorEnclosure) for entry in enclosures
        ):
            ahead = dr.select(function.is_continuous(ahead), ahead, 0)
            enclosures = path.proofs.from_restriction(function, slopes, ahead)
        # How far the next sample should look, as a multiple of the step proved here. It is taken
        # from the kinds that examine a given length, before the one is added that holds on all
        # lengths.
        growth = max(entry.reach_growth for entry in enclosures)
        if self.is_convex and ConvexityEnclosure in path.proofs.kinds:
            enclosures = (*enclosures, ConvexityEnclosure(slopes))
        # A lower bound of |grad f|, from lower bounds of its components. (0 * p.x turns Python
        # numbers into Dr.Jit arrays.)
        min_norm = safe_norm(type(p)(*(0 * p.x + entry.min_abs for entry in jet.first_derivatives)))
        return RaySample(sample, enclosures, (), slope, growth, slope_error, min_norm)

    def enclose_by_promises(self, path: Ray, p: Vec3, sample: Sample) -> RaySample:
        """The ray sample at the points p of rays that follows from promises alone. sample: that at
        p."""
        del p
        return path.enclose(sample)

    def _slope(self, p: Vec3, direction: Vec3, *, is_rounded: bool = False) -> tuple[Real, Real]:
        """The derivative of f at p along a direction, and a bound of its error. It is computed from
        f along the line, not from the gradient: on a crease of f the gradient is a range, but for a
        direction along the crease the derivative is a single number.

        is_rounded: whether the error also covers all points that round to p.

        The jet computed here also occurs at the start of the first piece of the ray
        (`FormulaOnRay`). Dr.Jit finds equal operations, so that the kernel does them once.

        p: the point.
        direction: the vector along which the derivative is taken.
        """
        zero = 0 * p.x

        def coordinate(k: int) -> Jet:
            """The jet of a coordinate along the direction, at p: the ranges of its value and of its
            derivative. k: 0, 1 or 2 for x, y or z."""
            at = Interval.point(p[k])
            # The interval of all coordinates that round to p[k].
            at = at.widened(machine_epsilon(p[k])) if is_rounded else at
            # A piece of length 0, without second derivatives.
            return Jet(at, (Interval.point(direction[k]),), (), piece_length=zero)

        x, y, z = (coordinate(k) for k in range(3))
        # There is one variable, the length along the direction, and so one derivative.
        (slope,) = self._jet((x, y, z)).first_derivatives
        return zero + slope.midpoint, zero + slope.radius

    def restrict(self, p: Vec3, direction: Vec3) -> FormulaOnRay:
        """The formula restricted to the line p + s direction, as a function of the length s, from
        which enclosures are made."""
        return FormulaOnRay(self, p, direction)

    def _jet(self, coordinates: tuple[Jet, Jet, Jet]) -> Jet:
        """The jet of f (ranges of its value and derivatives) from the jets of the three
        coordinates."""
        return as_jet(self.formula(*coordinates), coordinates[0], self.name)


def hessian_error(jet: Jet, like: Real) -> Real:
    """A bound of the error of a Hessian, in the spectral norm. Its entries are the midpoints of the
    ranges of the second derivatives.

    jet: the jet of f at a point, with the ranges of all six second derivatives.
    like: any number of the backend, which decides the type of the result.

    Proof. The error of an entry is at most half the width of its range. The spectral norm of a
    matrix is at most the sum of the absolute values of its entries.
    """
    xx, xy, xz, yy, yz, zz = (entry.radius for entry in jet.second_derivatives)
    return 0 * like + xx + yy + zz + 2 * (xy + xz + yz)


def is_jet(x: Any, name: str) -> bool:
    """Whether a coordinate x is a jet (ranges of a number and its derivatives); False for a plain
    number.

    name: the name of the field, for the message.

    Raises:
        TypeError: x is a number of another arithmetic of bounds, which the formula does not accept.
    """
    if isinstance(x, FormulaNumber) and not isinstance(x, Jet):
        raise TypeError(
            f"{name} gives ranges of derivatives alone, and the enclosures asked for are made of "
            'others: leave enclosures out, or use "pieces", "quadratic-taylor", "linear-taylor" or '
            '"segment"'
        )
    return isinstance(x, Jet)


def as_jet(value: Any, like: Jet, name: str) -> Jet:
    """The result `value` of a formula as a jet (ranges of a number and its derivatives). A constant
    becomes a constant jet.

    like: any jet of the same variables on the same piece.
    name: the name of the field, for the message.

    Raises:
        TypeError: the result is neither a jet nor a constant.
    """
    if isinstance(value, Jet):
        return value
    if isinstance(value, int | float):
        return like.constant(float(value))
    raise TypeError(
        f"{name}: the formula returned an object of type {type(value).__name__}, not a number made "
        "of its coordinates: write it with + - * / ** and functions such as harnack.math.sin"
    )


@dataclass(frozen=True)
class FormulaOnRay:
    """A formula f along a line, as the function F(s) = f(p + s d) of the length s. The line is cut
    into pieces at given lengths, the knots. For each piece, jets give proved ranges of F' and F''.
    Enclosures (bounds of the change of f along a ray) are made from it.

    evaluator: the evaluator of the formula.
    p, direction: (3,) p and d.
    before: the distance before p at which the first piece begins. If it is not 0.0, the pieces
        cover all lines along d that lead through p up to rounding.
    piece_count: the number of pieces into which the ray is cut. The ranges of a formula take as
        much time as its value: one piece takes the least time; four pieces take two thirds of the
        samples, but twice the time.
    """

    evaluator: FormulaEvaluator
    p: Vec3
    direction: Vec3
    before: Real = 0.0
    piece_count: int = 1

    def rounded(self, t: Real) -> FormulaOnRay:
        """The formula along all lines that lead through p up to the rounding of p, where p is the
        point of a ray at the parameter t. The first piece begins before p, by more than the
        rounding of t."""
        before = _ROUNDINGS_BEFORE * float(dr.epsilon(type(t))) * dr.abs(t)
        return dataclasses.replace(self, before=before)

    def is_continuous(self, length: Real) -> Mask:
        """Whether f is proved to be continuous for 0 <= s <= length. It is if the range of F' is
        bounded."""
        slopes = self._jet(0.0, length).first_derivatives[0]
        return dr.isfinite(0 * length + slopes.lower) & dr.isfinite(0 * length + slopes.upper)

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """The ranges of the derivatives of F(s), as `PathPiece`s, one between each knot and the
        next.

        knots: increasing lengths s, the first of them 0.
        """
        return tuple(self._piece(start, end) for start, end in itertools.pairwise(knots))

    def _piece(self, start: Real, end: Real) -> PathPiece:
        """The proved ranges of F' and F'' on the piece start <= s <= end of the line."""
        jet = self._jet(start, end)
        (slopes,), (curvatures,) = jet.first_derivatives, jet.second_derivatives
        zero = 0 * self.p.x
        return PathPiece(
            end - start,
            SlopeRange(zero + slopes.lower, zero + slopes.upper),
            zero + curvatures.lower,
            zero + curvatures.upper,
        )

    def _jet(self, start: Real, end: Real) -> Jet:
        """The jet of F (ranges of its value and derivatives) for start <= s <= end."""
        # before: the length by which the first piece begins before p; the Python number 0 for none.
        is_exact = isinstance(self.before, float) and self.before == 0.0
        if not is_exact and isinstance(start, float):  # the first piece starts at 0.0
            start = -self.before
        # If the first piece begins before p, the jets hold for all lines along d through points
        # that round to p.
        coordinates = Jet.along_ray(self.p, self.direction, start, end, is_rounded=not is_exact)
        return as_jet(self.evaluator.formula(*coordinates), coordinates[0], self.evaluator.name)
