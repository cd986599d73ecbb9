"""Promises: what a field guarantees near a point, in every direction.

A promise is stated in the field's own units and must be *true*: every step that the tracer takes
relies on it. Enclosures are derived from promises, once the slope along a direction is known.

This module alone derives promises of other functions from a promise of f. For f scaled, shifted,
negated and stretched in space they follow from the units of the promise's numbers. A new kind of
promise defines those units, the bounds of f that it implies (`movement_bounds`), and further
consequences.
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

# For a harmonic f on a ball of radius 1 with upper - lower = 1: the largest |f''| at the center, in
# up to three and in four dimensions, and a bound of |f'| within half the radius, in up to four. See
# `HarmonicBall`.
_SECOND_DERIVATIVE_BOUND, _SECOND_DERIVATIVE_BOUND_4D, _FIRST_DERIVATIVE_BOUND = (
    10 / (3 * math.sqrt(3)),
    9 * math.sqrt(3) / (2 * math.pi),
    1.7001,
)


@dataclass(frozen=True)
class Promise(abc.ABC):
    """Base of all kinds of promises. A subclass is a frozen dataclass of its numbers; `radius` is
    the distance from the point within which the promise holds."""

    units: ClassVar[tuple[tuple[str, int, int], ...]]
    """The names of its numbers, and the powers of the units of f and of length that each is in."""

    interval_pairs: ClassVar[tuple[tuple[str, str], ...]] = ()
    """The pairs of numbers that are a lower and an upper end; the first pair bounds f itself."""

    holds_outside_domain: ClassVar[bool] = False
    """Whether it holds on the whole ball, also where that leaves the field's domain."""

    implies_smooth: ClassVar[bool] = True
    """Whether it says that f has no creases within the radius."""

    if TYPE_CHECKING:

        @property
        def radius(self) -> Any: ...

    @abc.abstractmethod
    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        """Lower and upper bound of f(y) - f(p), for y at a length, less than the radius, from p
        along a direction in which f has these slopes at p.

        value: f(p). For NumPy and Dr.Jit arrays alike.
        """

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        """A bound of |f(y) - T(y)| for |y - p| <= length, T the Taylor polynomial of f about p of a
        degree (1 or 2); infinite if none follows. As the length decreases, it decreases at least as
        length^(degree + 1)."""
        del value, length, degree
        return dr.inf

    def implied_lipschitz(self, value: Real) -> Lipschitz | None:
        """A Lipschitz promise that follows from this one; None if none does."""
        del value
        return None

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """A bound of |f_vv| for all unit vectors v, and the radius of the ball about p in which it
        holds at every point; None if none follows. (`taylor_remainder_bound` is smaller: it is
        about the Taylor polynomial at p alone.)"""
        del value

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        """A weaker promise of a kind that survives every linear map A of space: if f makes it, f(A
        x) makes it in a transformed form.

        Harmonic functions and bounds of the Laplacian survive similarities only: HarmonicBall
        returns a TaylorRemainder, and BoundedLaplacian a Lipschitz promise. Other kinds return
        themselves.
        """
        del value
        return self

    def scaled(self, factor: Real) -> Self:
        """The promise of factor * f, factor > 0."""
        return self.map_numbers(lambda number, of_f, _: number * factor if of_f else number)

    def shifted(self, offset: Real) -> Self:
        """The promise of f + offset."""
        numbers = {
            name: getattr(self, name) + offset for pair in self.interval_pairs[:1] for name in pair
        }
        return dataclasses.replace(self, **numbers)

    def negated(self) -> Self:
        """The promise of -f."""
        numbers = {
            name: -getattr(self, opposite)
            for lower, upper in self.interval_pairs
            for name, opposite in ((lower, upper), (upper, lower))
        }
        return dataclasses.replace(self, **numbers)

    def space_scaled(self, size: Real) -> Self:
        """The promise of x -> f(x / size), at size * p."""

        def rescaled(number: Real, power: int) -> Real:
            if power == 0:
                return number
            return number * size if power > 0 else number / _power(size, -power)

        return self.map_numbers(lambda number, _, power: rescaled(number, power))

    def linearly_mapped(self, stretch: Real) -> Self:
        """The promise of x -> f(A x) for a linear map A that stretches no length by more than the
        factor `stretch`."""

        def rescaled(number: Real, power: int) -> Real:
            if power > 0:
                return number / stretch
            for _ in range(-power):
                number = number * stretch
            return number

        return self.map_numbers(lambda number, _, power: rescaled(number, power))

    def map_numbers(self, change: Callable[[Any, int, int], Any]) -> Self:
        """The promise with other numbers. change: a function of a number and the powers of its
        unit, which returns the new number."""
        numbers = {name: change(getattr(self, name), *powers) for name, *powers in self.units}
        return dataclasses.replace(self, **numbers)

    def select(self, mask: Mask, other: Self) -> Self:
        """The other promise, of the same kind, on lanes where the mask is set; this promise
        elsewhere."""
        numbers: dict[str, Any] = {}
        for name, *_ in self.units:
            new, old = getattr(other, name), getattr(self, name)
            is_same = isinstance(new, float) and isinstance(old, float) and new == old
            numbers[name] = old if is_same else dr.select(mask, new, old)
        return dataclasses.replace(self, **numbers)


def _power(number: Real, exponent: int) -> Real:
    return number if exponent == 1 else number * _power(number, exponent - 1)


@dataclass(frozen=True)
class HarmonicBall(Promise):
    """f extends to a harmonic function on the ball B(p, radius) of R^dimension that stays in range.

    The continuous lift of f that agrees with `Sample.value` at p is harmonic on the open ball and
    stays within [lower, upper] there. Either end may be infinite, not both. dimension is 2, 3 or
    4: a function of the plane extended constantly, of space, or a slice of a function of R^4.
    """

    radius: Real
    lower: Real
    upper: Real
    dimension: int = 3

    units = (("radius", 0, 1), ("lower", 1, 0), ("upper", 1, 0))
    interval_pairs = (("lower", "upper"),)
    holds_outside_domain = True

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        return self.lower - value, self.upper - value

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        """Proof for a harmonic f >= c on a ball of radius R in n dimensions: f - c is the integral
        of Poisson's kernel P(q, s) = sum over l of the zonal harmonics, all largest at s = 1, with
        a measure of mass f(p) - c; those of degree 0 and 1 are the value and the gradient. The rest
        is between -(P - 1 - n q) and P - 1 - n q at s = 1, P = (1 + q)/(1 - q)^(n - 1), times
        f(p) - c. The same holds for C - f, and the smaller of the two bounds is returned. For
        degree 2 that harmonic is left out, too: at s = 1 it is 2, 5 and 9 times q^2.
        """
        mass = fmin(value - self.lower, self.upper - value)
        q = length / self.radius
        remainder = {
            (2, 1): 2 * q * q / (1 - q),
            (3, 1): q * q * (5 - 3 * q) / dr.square(1 - q),
            (4, 1): q * q * (9 - q * (11 - 4 * q)) / (dr.square(1 - q) * (1 - q)),
            (2, 2): 2 * q * q * q / (1 - q),
            (3, 2): q * q * q * (7 - 5 * q) / dr.square(1 - q),
            (4, 2): q * q * q * (16 - q * (23 - 9 * q)) / (dr.square(1 - q) * (1 - q)),
        }[self.dimension, degree]
        return dr.select((q < 1) & (mass < dr.inf), mass * remainder, dr.inf)

    def implied_lipschitz(self, value: Real) -> Lipschitz | None:
        """On half the ball. Proof. Let f be within M of a constant on a ball of radius r in R^n. At
        its center f_v is n/r times the mean of f s over the sphere, s the cosine of the angle to v,
        so at most n M/r times the mean of |s|: 1.28, 1.5 and 1.7 M/r for n = 2, 3, 4. Points within
        R/2 are centers of balls of radius R/2, on which M is half of upper - lower.
        """
        if _is_infinite(self.lower) or _is_infinite(self.upper):
            return None
        return Lipschitz(
            _FIRST_DERIVATIVE_BOUND * self._span(value) / self.radius, 0.5 * self.radius
        )

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        """`TaylorRemainder` on half the ball. Proof in space (and so in the plane). At the center
        of a ball of radius R, f_vv = R^-2 times the mean of f 5 (3 s^2 - 1) over the sphere, s the
        cosine of the angle to v; for f between lower and upper that is at most 10/(3 sqrt 3)
        (upper - lower)/R^2. Points within R/2 are centers of balls of radius R/2.

        In R^4 the factor is 6 (4 s^2 - 1), and c = 2.49 takes the place of 10/(3 sqrt 3) = 1.92.
        There |f_vv| <= c (upper - lower)/(R - u)^2 at the distance u from p, and by Taylor's
        formula the remainder at t <= R/2 is at most (upper - lower) times the integral of
        c (t - u)/(R - u)^2 over [0, t]. As one factor falls and the other rises, that is at most
        t^2/2 times the mean of c/(R - u)^2, which is c/(R (R - t)) <= 2 c/R^2: less than the
        constant, 7.7/R^2.
        """
        half = 0.5 * self.radius
        return TaylorRemainder(
            1.0001 * _SECOND_DERIVATIVE_BOUND * self._span(value) / (half * half), half
        )

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """As for `weakened_for_linear_maps`, at the centers of balls of radius R/2. In R^4, where
        f_vv is R^-2 times the mean of f 6 (4 s^2 - 1), the mean of the positive part of that kernel
        is 9 sqrt(3)/(2 pi) = 2.48, which is half the mean of its absolute value."""
        if _is_infinite(self.lower) or _is_infinite(self.upper):
            return None
        half = 0.5 * self.radius
        constant = _SECOND_DERIVATIVE_BOUND_4D if self.dimension == 4 else _SECOND_DERIVATIVE_BOUND
        return 1.0001 * constant * self._span(value) / (half * half), half

    def _span(self, value: Real) -> Real:
        """upper - lower, as the sum of the distances of both from the value."""
        return (self.upper - value) + (value - self.lower)


@dataclass(frozen=True)
class BoundedLaplacian(Promise):
    """On the ball B(p, radius) of space f stays within [lower, upper] and its Laplacian within
    [laplacian_lower, laplacian_upper].

    f is continuously differentiable there and its Laplacian a bounded function, which may jump. All
    four ends are needed: a subharmonic function has laplacian_lower = 0, but nothing follows unless
    laplacian_upper is known as well, for it may have spikes. Units: those of f, and of f over
    length squared.
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
        return self.lower - value, self.upper - value

    def implied_lipschitz(self, value: Real) -> Lipschitz:
        """On half the ball. Proof. Points within R/2 are centers of balls of radius r = R/2. There
        f is a harmonic h with the same boundary values, which are between lower and upper, less the
        integral of G Laplacian f: so |h_v| <= 3/2 (upper - lower)/(2 r), and the integral of
        |d_v G| is 3 r/8.
        """
        half = 0.5 * self.radius
        max_laplacian = fmax(dr.abs(self.laplacian_lower), dr.abs(self.laplacian_upper))
        max_slope = 0.75 * (self.upper - self.lower) / half + 0.375 * half * max_laplacian
        return Lipschitz(1.0001 * max_slope, half)

    def weakened_for_linear_maps(self, value: Real) -> Promise:
        return self.implied_lipschitz(value)

    def linearly_mapped(self, stretch: Real) -> BoundedLaplacian:
        """For a similarity A: the Laplacian of f(A x) is that of f times the square of the factor
        by which A stretches lengths, which is `stretch` up to some roundings."""
        slack = 5e-6 * (dr.abs(self.laplacian_lower) + dr.abs(self.laplacian_upper))
        lower, upper = self.laplacian_lower - slack, self.laplacian_upper + slack
        widened = dataclasses.replace(self, laplacian_lower=lower, laplacian_upper=upper)
        return super(BoundedLaplacian, widened).linearly_mapped(stretch)


@dataclass(frozen=True)
class Lipschitz(Promise):
    """|f(y) - f(p)| <= constant * |y - p| for every y with |y - p| < radius (default: all y).

    For a field with a domain: for every such y in it. Without a radius the constant is that of the
    field, the same at every point, so that it bounds all second derivatives.
    """

    constant: Real
    radius: Real = float("inf")

    units = (("constant", 1, -1), ("radius", 0, 1))
    implies_smooth = False

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        movement = self.constant * length
        return -movement, movement

    def implied_lipschitz(self, value: Real) -> Lipschitz:
        return self


@dataclass(frozen=True)
class TaylorRemainder(Promise):
    """|f(y) - f(p) - grad f(p).(y-p)| <= constant |y-p|^2/2 for every y with |y-p| < radius.

    For a field with a domain: for every such y in it. There too, the remainder of Taylor's
    polynomial of second degree is at most cubic_constant |y-p|^3/6, if that constant is known.
    """

    constant: Real
    radius: Real = float("inf")
    cubic_constant: Real = float("inf")

    units = (("constant", 1, -2), ("radius", 0, 1), ("cubic_constant", 1, -3))

    def movement_bounds(self, value: Any, slopes: SlopeRange, length: Any) -> tuple[Any, Any]:
        curved = 0.5 * self.constant * length * length
        return slopes.lower * length - curved, slopes.upper * length + curved

    def implied_second_derivative_bound(self, value: Real) -> tuple[Real, Real] | None:
        """By definition, at every point that promises it; without a radius all do."""
        del value
        return (self.constant, self.radius) if _is_infinite(self.radius) else None

    def taylor_remainder_bound(self, value: Real, length: Real, degree: int = 1) -> Real:
        if degree == 2 and _is_infinite(self.cubic_constant):
            return dr.inf
        factor = 0.5 * self.constant if degree == 1 else self.cubic_constant * length / 6
        return dr.select(length < self.radius, factor * length * length, dr.inf)


def _is_infinite(end: Any) -> bool:
    return isinstance(end, float) and math.isinf(end)
