"""Promises: proved bounds of a field's function f near a point p, in every direction. For example,
a promise says that f stays within a range on the ball of some radius about p.

A promise is stated in the field's own units and must be *true*: every step that the tracer takes
relies on it. Enclosures (bounds of f along a path) are derived from promises, once the slope along
the path is known.

Only this module derives, from a promise about f, promises about other functions. If f is scaled,
shifted, negated or stretched in space, the new promise follows from the units of the old promise's
numbers. A new kind of promise defines these units, the bounds of f that it implies
(`movement_bounds`), and further consequences.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr

from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import SlopeRange

# For a harmonic f on a ball of radius 1 with upper - lower = 1: bounds of |f''| at the center, the
# first for up to three dimensions, the second for four; and a bound of |f'| within half the radius,
# for up to four. See `HarmonicBall`.
_SECOND_DERIVATIVE_BOUND, _SECOND_DERIVATIVE_BOUND_4D, _FIRST_DERIVATIVE_BOUND = (
    10 / (3 * math.sqrt(3)),
    9 * math.sqrt(3) / (2 * math.pi),
    1.7001,
)


@dataclass(frozen=True)
class Promise(abc.ABC):
    """A proved bound of a function f near a point p, the promise: base of all kinds. A promise
    holds at all points within its `radius` of p; value stands for f(p), and f_v for the derivative
    of f along a unit vector v.

    A subclass is a frozen dataclass of its numbers. `radius` is the distance from p within which
    the promise holds.
    """

    units: ClassVar[tuple[tuple[str, int, int], ...]]
    """(name, i, j) for each of its numbers, whose unit is (unit of f)^i (length)^j."""

    interval_pairs: ClassVar[tuple[tuple[str, str], ...]] = ()
    """The names of numbers that are the lower and the upper end of a range. The first pair bounds f
    itself."""

    holds_outside_domain: ClassVar[bool] = False
    """Whether it holds on the whole ball, also outside of the field's domain."""

    implies_smooth: ClassVar[bool] = True
    """Whether the promise implies that f has no creases within the radius."""

    if TYPE_CHECKING:

        @property
        def radius(self) -> Any: ...

    @abc.abstractmethod
    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Return a lower and an upper bound of f(y) - f(p) for a point y along a direction from p.

        value: f(p).
        slopes: the range of the derivative of f along the direction at p.
        length: |y - p|, less than the radius.

        All arguments are NumPy or Dr.Jit arrays.
        """

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        """Return a bound of |f(y) - T(y)| for |y - p| <= length, where T is the Taylor polynomial
        of f about p; infinite if the promise implies none.

        value: f(p).
        degree: the degree of T, 1 or 2. As the length decreases, the bound decreases at least as
            length^(degree + 1).
        """
        del value, length, degree
        return dr.inf

    def implied_lipschitz(self, value: Real) -> Lipschitz | None:
        """Return a Lipschitz constant of f on a ball about p that follows from this promise, as a
        `Lipschitz`; None if none follows.

        value: f(p).
        """
        del value
        return None

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """Return a bound of the second derivatives |f_vv|, for all unit vectors v, that holds
        everywhere in a ball about p, and the radius of that ball; None if the promise implies no
        such bound.

        value: f(p).

        `taylor_remainder_bound` is smaller, as it is about the Taylor polynomial at p alone.
        """
        del value

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        """Return a weaker promise, of a kind that every linear map A of space preserves.

        value: f(p).

        If f makes a promise of such a kind, then x -> f(A x) makes a promise of the same kind with
        other numbers (`linearly_mapped`). Harmonic functions and bounds of the Laplacian are
        preserved by similarities only. So HarmonicBall returns a TaylorRemainder, and
        BoundedLaplacian a Lipschitz promise. All other kinds return themselves.
        """
        del value
        return self

    def scaled(self, factor: Real) -> Self:
        """Return the promise of factor * f, for factor > 0."""
        # A number whose unit contains that of f is multiplied; the power is 1. An infinite one
        # stays a Python number, for code that asks for it while a kernel is recorded.
        return self.map_numbers(
            lambda number, of_f, _: number * factor if of_f and not _is_infinite(number) else number
        )

    def shifted(self, offset: Real) -> Self:
        """Return the promise of f + offset. The range of f itself, the first pair of
        `interval_pairs`, is shifted."""
        names = [name for pair in self.interval_pairs[:1] for name in pair]
        ends = {name: getattr(self, name) for name in names}
        numbers = {name: end if _is_infinite(end) else end + offset for name, end in ends.items()}
        return dataclasses.replace(self, **numbers)

    def negated(self) -> Self:
        """Return the promise of -f: a range from a to b becomes the range from -b to -a."""
        # A pair: the names of the attributes that are the lower and the upper end of a range.
        numbers = {
            name: -getattr(self, opposite)
            for lower, upper in self.interval_pairs
            for name, opposite in ((lower, upper), (upper, lower))
        }
        return dataclasses.replace(self, **numbers)

    def space_scaled(self, size: Real) -> Self:
        """Return the promise that x -> f(x / size) makes at the point size * p. A number with the
        unit (length)^j is multiplied by size^j."""

        def rescaled(number: Real, power: int) -> Real:
            """Return number * size^power."""
            if power == 0:
                return number
            return number * size if power > 0 else number / _power(size, -power)

        return self.map_numbers(lambda number, _, power: rescaled(number, power))

    def linearly_mapped(self, stretch: Real) -> Self:
        """Return the promise of x -> f(A x) for a linear map A, at the point that A maps to p.

        stretch: an upper bound of the factor by which A stretches lengths.

        A number with the unit (length)^j is divided by stretch^j: lengths shrink, and slopes grow.
        """

        def rescaled(number: Real, power: int) -> Real:
            """Return number / stretch^power, for power <= 1."""
            if power > 0:
                return number / stretch
            for _ in range(-power):
                number = number * stretch
            return number

        return self.map_numbers(lambda number, _, power: rescaled(number, power))

    def map_numbers(self, change: Callable[[Any, int, int], Any]) -> Self:
        """Return a promise of the same kind with other numbers.

        change: a function of (number, i, j) that returns the new number; i and j are the exponents
            of the number's unit, (unit of f)^i (length)^j.
        """
        # An entry of `units`: the name of an attribute, and the two exponents.
        numbers = {name: change(getattr(self, name), *powers) for name, *powers in self.units}
        return dataclasses.replace(self, **numbers)

    def select(self, mask: Mask, other: Self) -> Self:
        """Return the promise `other`, which is of the same kind, on the lanes of the mask, and this
        promise on all other lanes."""
        numbers: dict[str, Any] = {}
        # `units` has an entry for each number; it begins with the name of its attribute.
        for name, *_ in self.units:
            new, old = getattr(other, name), getattr(self, name)
            # Equal Python numbers stay Python numbers: code asks whether they are infinite while a
            # kernel is recorded.
            is_same = isinstance(new, float) and isinstance(old, float) and new == old
            numbers[name] = old if is_same else dr.select(mask, new, old)
        return dataclasses.replace(self, **numbers)


def _power(number: Real, exponent: int) -> Real:
    """Return number^exponent for an integer exponent >= 1."""
    return number if exponent == 1 else number * _power(number, exponent - 1)


@dataclass(frozen=True)
class HarmonicBall(Promise):
    """The promise that f extends to a harmonic function on the ball B(p, radius) of R^dimension,
    with values between `lower` and `upper`.

    If f has a period, the promise is about the continuous function that equals `Sample.value` at p
    and f elsewhere up to multiples of the period.

    lower, upper: bounds of the harmonic function on the open ball. One of them may be infinite.
    dimension: 2 for a function of x and y that does not depend on z; 3 for a function of space; 4
        if f is the restriction of a function of R^4 to a space in it.
    """

    radius: Real
    lower: Real
    upper: Real
    dimension: int = 3

    units = (("radius", 0, 1), ("lower", 1, 0), ("upper", 1, 0))
    interval_pairs = (("lower", "upper"),)
    holds_outside_domain = True

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Return a lower and an upper bound of f(y) - f(p) on the ball: the bounds of f, less f(p).
        They do not depend on the slopes and the length. value: f(p)."""
        return self.lower - value, self.upper - value

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        """Return a bound of |f(y) - T(y)| for |y - p| <= length, where T is the Taylor polynomial
        of f about p; infinite beyond the ball, or if f is not bounded.

        value: f(p).
        degree: the degree of T, 1 or 2.

        Proof for a harmonic f >= c on a ball of radius R in n dimensions. f - c is the integral of
        Poisson's kernel P(q, s) with a measure of mass f(p) - c. Here q = length/R, and s is the
        cosine of the angle between y - p and a point of the sphere. P is the sum over l of the
        zonal harmonics of degree l, which are all largest at s = 1. Those of degree 0 and 1 give
        the value and the gradient. The sum of all others is at most P - 1 - n q at s = 1, in
        absolute value, where P = (1 + q)/(1 - q)^(n - 1). So the error is at most this number times
        f(p) - c. The same holds for C - f with f <= C, and the smaller of the two bounds is
        returned. For degree 2, the harmonic of degree 2 is left out, too: at s = 1 it is 2, 5 and 9
        times q^2 for n = 2, 3 and 4.
        """
        mass = fmin(value - self.lower, self.upper - value)
        q = length / self.radius
        # P - 1 - n q, less the term of degree 2, as a fraction: by (dimension, degree).
        remainder_per_mass = {
            (2, 1): 2 * q * q / (1 - q),
            (3, 1): q * q * (5 - 3 * q) / dr.square(1 - q),
            (4, 1): q * q * (9 - q * (11 - 4 * q)) / (dr.square(1 - q) * (1 - q)),
            (2, 2): 2 * q * q * q / (1 - q),
            (3, 2): q * q * q * (7 - 5 * q) / dr.square(1 - q),
            (4, 2): q * q * q * (16 - q * (23 - 9 * q)) / (dr.square(1 - q) * (1 - q)),
        }[self.dimension, degree]
        return dr.select((q < 1) & (mass < dr.inf), mass * remainder_per_mass, dr.inf)

    def implied_lipschitz(self, value: Real) -> Lipschitz | None:
        """Return a Lipschitz constant of f on half the ball; None if f is not bounded on both
        sides. value: f(p).

        Proof. Let f be within M of a constant on a ball of radius r in R^n. At the center f_v is
        n/r times the mean of f s over the sphere, where s is the cosine of the angle to v. So |f_v|
        is at most n M/r times the mean of |s|: 1.28, 1.5 and 1.7 M/r for n = 2, 3, 4. Points within
        R/2 are centers of balls of radius R/2, on which M is half of upper - lower. With r = R/2
        this is 1.7 (upper - lower)/R.
        """
        if _is_infinite(self.lower) or _is_infinite(self.upper):
            return None
        return Lipschitz(
            _FIRST_DERIVATIVE_BOUND * self._span(value) / self.radius, 0.5 * self.radius
        )

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        """Return a `TaylorRemainder` on half the ball: a bound of the second derivatives. value:
        f(p).

        Proof in space (and so in the plane). At the center of a ball of radius R, f_vv is R^-2
        times the mean of 5 (3 s^2 - 1) f over the sphere, where s is the cosine of the angle to v.
        For f between lower and upper this is at most 10/(3 sqrt 3) (upper - lower)/R^2. Points
        within R/2 are centers of balls of radius R/2.

        Proof in R^4. Here the factor is 6 (4 s^2 - 1), and c = 2.49 takes the place of 10/(3 sqrt
        3) = 1.92. At the distance u from p, |f_vv| <= c (upper - lower)/(R - u)^2. By Taylor's
        formula the remainder at a length t <= R/2 is at most (upper - lower) times the integral of
        c (t - u)/(R - u)^2 over [0, t]. As one factor falls and the other rises, this is at most
        t^2/2 times the mean of c/(R - u)^2, which is c/(R (R - t)) <= 2 c/R^2. That is less than
        the constant 7.7/R^2 of the promise.
        """
        half = 0.5 * self.radius
        # (1.0001 allows for rounding.)
        return TaylorRemainder(
            1.0001 * _SECOND_DERIVATIVE_BOUND * self._span(value) / (half * half), half
        )

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """Return a bound of |f_vv| for all unit vectors v on half the ball, and the radius R/2 of
        that half; None if f is not bounded on both sides.

        Proof. `weakened_for_linear_maps` has the proof at the center of a ball; here it is used at
        the centers of balls of radius R/2. In R^4, f_vv is R^-2 times the mean of 6 (4 s^2 - 1) f.
        The mean of the positive part of this kernel is 9 sqrt(3)/(2 pi) = 2.48, which is half the
        mean of its absolute value.
        """
        if _is_infinite(self.lower) or _is_infinite(self.upper):
            return None
        half = 0.5 * self.radius
        constant = _SECOND_DERIVATIVE_BOUND_4D if self.dimension == 4 else _SECOND_DERIVATIVE_BOUND
        # (1.0001 allows for rounding.)
        return 1.0001 * constant * self._span(value) / (half * half), half

    def _span(self, value: Real) -> Real:
        """Return upper - lower, the length of the range of f on the ball, computed as (upper -
        value) + (value - lower). With value = f(p) between the two, both terms are at least 0."""
        return (self.upper - value) + (value - self.lower)


@dataclass(frozen=True)
class BoundedLaplacian(Promise):
    """The promise that f and its Laplacian stay within ranges on the ball B(p, radius) of space.

    f is continuously differentiable there, and its Laplacian is a bounded function, which may jump.

    lower, upper: the range of f.
    laplacian_lower, laplacian_upper: the range of the Laplacian, in units of f over length squared.

    All four ends are needed. A subharmonic function, for example, has laplacian_lower = 0, but
    nothing follows unless laplacian_upper is known as well, because f may have spikes.
    """

    radius: Real
    lower: Real
    upper: Real
    laplacian_lower: Real
    laplacian_upper: Real

    units = (
        ("radius", 0, 1), ("lower", 1, 0), ("upper", 1, 0),
        ("laplacian_lower", 1, -2), ("laplacian_upper", 1, -2),
    )  # fmt: skip
    interval_pairs = (("lower", "upper"), ("laplacian_lower", "laplacian_upper"))
    holds_outside_domain = True

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Return a lower and an upper bound of f(y) - f(p) on the ball: the bounds of f, less f(p).
        They do not depend on the slopes and the length. value: f(p)."""
        return self.lower - value, self.upper - value

    def implied_lipschitz(self, value: Real) -> Lipschitz:
        """Return a Lipschitz constant of f on half the ball. It does not depend on the value f(p).

        Proof. Let R be the radius. Points within R/2 are centers of balls of radius r = R/2. On
        such a ball f = h - integral of G Laplacian f, where G is the Green function and h is
        harmonic with the boundary values of f, which are between lower and upper. So |h_v| <= 3/2
        (upper - lower)/(2 r), and the integral of |d_v G| is 3 r/8.
        """
        half = 0.5 * self.radius
        max_laplacian = fmax(dr.abs(self.laplacian_lower), dr.abs(self.laplacian_upper))
        max_slope = 0.75 * (self.upper - self.lower) / half + 0.375 * half * max_laplacian
        # (1.0001 allows for rounding.)
        return Lipschitz(1.0001 * max_slope, half)

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        """Return a Lipschitz constant of f on half the ball."""
        return self.implied_lipschitz(value)

    def linearly_mapped(self, stretch: Real) -> BoundedLaplacian:
        """Return the promise of x -> f(A x) for a similarity A, at the point that A maps to p.

        stretch: the factor by which A stretches lengths, up to some roundings.

        The Laplacian of x -> f(A x) is the Laplacian of f times the square of the exact factor. So
        its range is widened by a few roundings first.
        """
        slack = 5e-6 * (dr.abs(self.laplacian_lower) + dr.abs(self.laplacian_upper))
        lower, upper = self.laplacian_lower - slack, self.laplacian_upper + slack
        widened = dataclasses.replace(self, laplacian_lower=lower, laplacian_upper=upper)
        return super(BoundedLaplacian, widened).linearly_mapped(stretch)


@dataclass(frozen=True)
class Lipschitz(Promise):
    """The promise that |f(y) - f(p)| <= constant * |y - p| for every y with |y - p| < radius
    (default: all y).

    If the field has a domain, this holds for every such y in the domain. Without a radius the
    constant must be the same at every point of the field.
    """

    constant: Real
    radius: Real = float("inf")

    units = (("constant", 1, -1), ("radius", 0, 1))
    implies_smooth = False

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Return the bounds of f(y) - f(p): constant times length, to both sides. They do not
        depend on the value f(p) and the slopes. length: |y - p|."""
        movement = self.constant * length
        return -movement, movement

    def implied_lipschitz(self, value: Real) -> Lipschitz:
        """Return this promise."""
        return self


@dataclass(frozen=True)
class TaylorRemainder(Promise):
    """The promise that |f(y) - f(p) - grad f(p).(y-p)| <= constant |y-p|^2/2 for every y with |y-p|
    < radius.

    If the field has a domain, this holds for every such y in the domain. Without a radius the
    constant must be the same at every point of the field; it then bounds all second derivatives.

    cubic_constant: if it is finite, the remainder of Taylor's polynomial of second degree is at
        most cubic_constant |y-p|^3/6 for the same y.
    """

    constant: Real
    radius: Real = float("inf")
    cubic_constant: Real = float("inf")

    units = (("constant", 1, -2), ("radius", 0, 1), ("cubic_constant", 1, -3))

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Return the bounds of f(y) - f(p): the slope times the length, and constant length^2/2 to
        both sides.

        value: f(p), not used. slopes: the range of the derivative of f along the direction at p.
        length: |y - p|.
        """
        curved = 0.5 * self.constant * length * length
        return slopes.lower * length - curved, slopes.upper * length + curved

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """Return the constant, which bounds |f_vv| for all unit vectors v, and the infinite radius,
        if the promise has no radius: then it holds at every point. Otherwise return None."""
        del value
        return (self.constant, self.radius) if _is_infinite(self.radius) else None

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        """Return the bound of |f(y) - T(y)| for |y - p| <= length that the promise states for the
        Taylor polynomial T of degree 1 or 2; infinite beyond its radius. value: f(p), not used."""
        if degree == 2 and _is_infinite(self.cubic_constant):
            return dr.inf
        factor = 0.5 * self.constant if degree == 1 else self.cubic_constant * length / 6
        return dr.select(length < self.radius, factor * length * length, dr.inf)


def _is_infinite(end: Any) -> bool:
    """Return whether the end `end` of a range is an infinite Python float, which is known while a
    kernel is being recorded. For a Dr.Jit number the result is False."""
    return isinstance(end, float) and math.isinf(end)
