"""A function and its derivatives as a single number: `Jet` holds ranges, intervals that are proved
to contain the values and derivatives, and `Dual` plain numbers. A formula that is evaluated with
jets as its coordinates returns the jet of its value. The variables are either the coordinates x, y
and z at a point or on a box, or the length s along a path, which is a piece of a ray. Jets at a
point give value, gradient and Hessian with proved bounds of rounding; jets on a piece of a path
give the ranges from which steps are proved. Such a jet also holds the jet at the start of its
piece, because the ranges on the piece follow more sharply from the values there and from the higher
derivatives. Indices denote derivatives by variables: x_i, x_ij."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.functions import (
    ElementaryFunction,
    exp,
    log,
    power,
    reciprocal,
    sqrt,
    sqrt_range,
)
from harnack.arithmetic.interval import ONE, ZERO, Interval, machine_epsilon, typed_select
from harnack.arithmetic.operators import FormulaNumber, exponent_of
from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3


@dataclass(frozen=True, eq=False)
class Jet(FormulaNumber):
    """Ranges (intervals) of a function of n variables, and of its first and second derivatives, on
    a box of the variables. Mostly n = 1, the length along a path, or n = 3, the coordinates at a
    point.

    The arithmetic is interval arithmetic of value, first and second derivatives at once (Moore
    1966). The Taylor forms of Aydinlilar and Zanni (2023, section 6.1) consist of it.

    value: the range of the function.
    first_derivatives: (n,) the ranges of the partial derivatives.
    second_derivatives: (n (n+1) / 2,) the ranges of the second derivatives, the rows of the upper
        triangle of the Hessian; empty if they are not needed. At a kink, where the first derivative
        jumps up, the range has no upper end; where it jumps down, no lower end.
    jet_at_start: for a piece of a path, the jet at its start, from which ranges on the piece are
        narrowed; None otherwise.
    piece_length: the length of the piece; 0 at a point. It is a number of the backend, and tells
        the precision if all ranges are Python numbers.
    roots: functions such that this function is the sum of their squares; empty if none are known.
        The square root of a sum of squares is a norm, whose slopes are bounded. By the chain rule
        of the square root they would be unbounded where all squares are 0.
    """

    value: Interval
    first_derivatives: tuple[Interval, ...]
    second_derivatives: tuple[Interval, ...]
    jet_at_start: Jet | None = None
    piece_length: Real = 0.0
    roots: tuple[Jet, ...] = ()

    @classmethod
    def at_point(cls, p: Vec3, *, order: int = 1) -> tuple[Jet, Jet, Jet]:
        """The jets of the coordinates x, y and z at points p, as functions of the three variables
        x, y and z. A formula of them gives its gradient and Hessian.

        order: the highest order of derivatives, 1 or 2.
        """
        # Six second derivatives; the first derivatives of coordinate k are 1 by itself, else 0.
        second = (ZERO,) * 6 if order > 1 else ()
        units = [tuple(ONE if i == k else ZERO for i in range(3)) for k in range(3)]
        zero = 0 * p.x
        x, y, z = (Jet(Interval.point(p[k]), units[k], second, piece_length=zero) for k in range(3))
        return x, y, z

    @classmethod
    def over_ball(cls, p: Vec3, radius: Real) -> tuple[Jet, Jet, Jet]:
        """The jets of the coordinates x, y and z, as functions of the three variables x, y and z,
        on boxes around the balls B(p, radius)."""
        x, y, z = cls.at_point(p)
        ends = Interval(-radius, radius)
        x, y, z = (dataclasses.replace(jet, value=jet.value + ends) for jet in (x, y, z))
        return x, y, z

    @classmethod
    def along_ray(
        cls,
        p: Vec3,
        direction: Vec3,
        start: Real,
        end: Real,
        *,
        is_rounded: bool = False,
    ) -> tuple[Jet, Jet, Jet]:
        """The three coordinates of the points p + s d as functions of s, on the piece start <= s <=
        end.

        direction: d.
        is_rounded: whether the path passes p only up to the rounding of p's coordinates. Ranges
            then hold for all such paths, each along d.
        """

        def coordinate(x: Real, slope: Real) -> Jet:
            """The function x + s slope on the piece, with its jet at the start of the piece."""
            rate = Interval.point(slope)
            base = Interval.point(x)
            if is_rounded:
                base = base.widened(machine_epsilon(x))
            at_start = _moved(base, rate, start)
            first, second = (rate,), (ZERO,)
            # (0 * x is the number 0 in the type of x.)
            anchor = Jet(at_start, first, second, piece_length=0 * x)
            return Jet(at_start.hull(_moved(base, rate, end)), first, second, anchor, end - start)

        x, y, z = (coordinate(p[k], direction[k]) for k in range(3))
        return x, y, z

    # Operators.

    def constant(self, x: float | Real) -> Jet:
        """The constant number x as a function of the same variables."""
        if dr.is_array_v(cast("Any", type(x))):
            return self._constant(Interval.point(x))
        return self._constant(Interval.enclosing(float(x), type(self.backend_number())))

    def constant_between(self, lower: Real, upper: Real) -> Jet:
        return self._constant(Interval(lower, upper))

    def _constant(self, value: Interval) -> Jet:
        """A constant that lies in the interval `value`, as a function of the same variables."""
        zeros = (ZERO,) * len(self.first_derivatives), (ZERO,) * len(self.second_derivatives)
        start = None if self.jet_at_start is None else self.jet_at_start._constant(value)
        return Jet(value, *zeros, start, self.piece_length)

    def backend_number(self) -> Any:
        """Any Dr.Jit number among the ends of the ranges; `piece_length` if all ends are Python
        numbers."""
        for interval in (self.value, *self.first_derivatives):
            if dr.is_array_v(cast("Any", type(interval.lower))):
                return interval.lower
        return self.piece_length

    def sum(self, other: Jet) -> Jet:
        """The sum of this function and another one. The sum of two sums of squares is a sum of
        squares."""
        jet = Jet(
            self.value + other.value,
            tuple(
                x + y for x, y in zip(self.first_derivatives, other.first_derivatives, strict=True)
            ),
            tuple(
                x + y
                for x, y in zip(self.second_derivatives, other.second_derivatives, strict=True)
            ),
            piece_length=self.piece_length,
        )
        if self.jet_at_start is not None:
            jet = jet.narrowed_from_start(self.jet_at_start + other.jet_at_start, self.piece_length)
        is_sum_of_squares = bool(self.roots and other.roots)
        return (
            dataclasses.replace(jet, roots=self.roots + other.roots) if is_sum_of_squares else jet
        )

    def moved(self, by: Interval) -> Jet:
        """The sum of this function and a constant that lies in an interval."""
        start = None if self.jet_at_start is None else self.jet_at_start.moved(by)
        return dataclasses.replace(self, value=self.value + by, jet_at_start=start, roots=())

    def __neg__(self) -> Jet:
        """The function times -1."""
        return dataclasses.replace(
            self,
            value=-self.value,
            first_derivatives=tuple(-derivative for derivative in self.first_derivatives),
            second_derivatives=tuple(-derivative for derivative in self.second_derivatives),
            jet_at_start=None if self.jet_at_start is None else -self.jet_at_start,
            roots=(),
        )

    def product(self, other: Jet) -> Jet:
        """The product of this function and another one, by the product rule. A sum of squares times
        a positive constant is a sum of squares again."""
        if other is self:  # a square, whose range is sharper than that of a product
            return self.apply(power(2))
        x, y = self.value, other.value
        first = tuple(
            x * v + y * u
            for u, v in zip(self.first_derivatives, other.first_derivatives, strict=True)
        )
        second = tuple(
            x * other.second_derivatives[k]
            + (
                self.first_derivatives[i] * other.first_derivatives[j]
                + self.first_derivatives[j] * other.first_derivatives[i]
            )
            + y * self.second_derivatives[k]
            for k, (i, j) in enumerate(self.hessian_indices())
        )
        jet = Jet(x * y, first, second, piece_length=self.piece_length)
        if self.jet_at_start is not None:
            jet = jet.narrowed_from_start(self.jet_at_start * other.jet_at_start, self.piece_length)
        roots = self._scaled_roots(y) or other._scaled_roots(x)
        return dataclasses.replace(jet, roots=roots) if roots else jet

    def _scaled_roots(self, factor: Interval) -> tuple[Jet, ...]:
        """The functions whose squares add up to the product of this function with a constant; an
        empty tuple if they are not known, or if the constant is not known to be positive. Each is
        one of the attribute `roots` times the square root of the constant.

        factor: the range of the constant.
        """
        if not (self.roots and factor.is_literal and factor.lower > 0):
            return ()
        low, high = (math.sqrt(cast("float", entry)) for entry in (factor.lower, factor.upper))
        kind = cast("Any", type(self.backend_number()))
        # The range of the constant's root, rounded outwards.
        low, high = math.nextafter(low, 0.0), math.nextafter(high, math.inf)
        scale = Interval.enclosing(low, kind).hull(Interval.enclosing(high, kind))
        return tuple(entry * entry._constant(scale) for entry in self.roots)

    def __truediv__(self, other: Any) -> Any:
        """The quotient of this function and another one: this function times the reciprocal.

        Raises:
            ZeroDivisionError: the divisor is the Python number 0.
        """
        if isinstance(other, Jet):
            return self * other.apply(reciprocal)
        b = self._coerce_or_none(other)
        if b is None:
            return NotImplemented
        if not b.value.is_literal:
            return self * b.apply(reciprocal)
        if float(other) == 0.0:
            raise ZeroDivisionError("a formula divides by the constant 0")
        return self * self._constant(b.value.reciprocal())

    def __pow__(self, exponent: Any) -> Jet:
        """This function to a power: as exp(exponent log(this)) for an exponent that is a function,
        else by the elementary function `power`. The power 1/2 of a known sum of squares is a
        norm."""
        if isinstance(exponent, Jet):
            if self.value.is_literal:  # Python numbers: take the type from the exponent
                base = exponent._constant(self.value_on_backend(exponent.backend_number()))
                return (base.apply(log) * exponent).apply(exp)
            return (self.apply(log) * exponent).apply(exp)
        n = exponent_of(exponent)
        return self.apply(sqrt if n == 0.5 and self.roots else power(n))

    # Functions.

    def apply(self, function: ElementaryFunction) -> Jet:
        """The composition f(g) of an elementary function f, `function`, with this function g.

        Its derivatives are f(g)' = f' g' and f(g)'' = f'' g' g' + f' g'', with f' and f'' on the
        range of g. The square root of a known sum of squares is computed as a norm.
        """
        # The square root of a sum of squares. (`norms` itself imports this module.)
        if function is sqrt and self.roots:
            from harnack.arithmetic.norms import norm

            return norm(*self.roots)
        x = self.value_on_backend()
        # The ranges of f, f' and f'' on the range of g.
        value, slope, curvature = function.ranges(x)
        first_derivatives = tuple(slope * derivative for derivative in self.first_derivatives)
        second_derivatives = tuple(
            curvature
            * (
                self.first_derivatives[i].square()
                if i == j
                else self.first_derivatives[i] * self.first_derivatives[j]
            )
            + slope * self.second_derivatives[k]
            for k, (i, j) in enumerate(self.hessian_indices())
        )
        jet = Jet(value, first_derivatives, second_derivatives, piece_length=self.piece_length)
        if self.jet_at_start is not None:
            jet = jet.narrowed_from_start(self.jet_at_start.apply(function), self.piece_length)
        is_square = function.name == "power 2"
        return dataclasses.replace(jet, roots=(self,)) if is_square else jet

    def pointwise_maximum(self, other: Jet) -> Jet:
        """The larger of this function x and another function y at each point.

        Proof. If one function is larger everywhere in the box, it is the maximum. Otherwise each
        derivative of the maximum is that of one of the two, except where they cross. There the
        first derivative jumps up, so that the second derivative has no upper bound.
        """
        x, y = self.value_on_backend(), other.value_on_backend(self.backend_number())
        is_x_larger, is_y_larger = x.lower > y.upper, y.lower > x.upper

        def chosen(u: Interval, v: Interval, *, kink: bool) -> Interval:
            """The range of the larger function, or of one of its derivatives. u is that range for
            x, and v for y. Where neither is known to be larger, the result is the hull of u and v.

            kink: whether u and v are ranges of a second derivative by the same variable twice,
                which has no upper bound where x and y cross; then the hull has no upper end.
            """
            if u.is_literal and v.is_literal and u == v and not kink:
                return u
            hull = u.hull(v)
            high = dr.inf if kink else hull.upper
            # (The last argument of `typed_select` tells the type of the numbers only.)
            return Interval(
                typed_select(
                    is_x_larger,
                    u.lower,
                    typed_select(is_y_larger, v.lower, hull.lower, x.lower),
                    x.lower,
                ),
                typed_select(
                    is_x_larger, u.upper, typed_select(is_y_larger, v.upper, high, x.lower), x.lower
                ),
            )

        pairs = self.hessian_indices()
        # The larger of both lower ends, and the larger of both upper ends.
        value = Interval(x.intersect(y).lower, x.hull(y).upper)
        first = tuple(
            chosen(u, v, kink=False)
            for u, v in zip(self.first_derivatives, other.first_derivatives, strict=True)
        )
        second = tuple(
            chosen(u, v, kink=i == j)
            for (i, j), u, v in zip(
                pairs, self.second_derivatives, other.second_derivatives, strict=True
            )
        )
        jet = Jet(value, first, second, piece_length=self.piece_length)
        if self.jet_at_start is None:
            return jet
        return jet.narrowed_from_start(
            self.jet_at_start.maximum(other.jet_at_start), self.piece_length
        )

    def polar_angle(self, x: Jet) -> Jet:
        """The polar angle of the point (x, y), where y is this function.

        Proof. The angle is the imaginary part of log z with z = x + i y. The derivatives of log z
        are z_i/z and z_ij/z - (z_i/z)(z_j/z), where an index is a derivative by a variable. With
        z_i/z = rho_i + i theta_i and r^2 = x^2 + y^2 these are

            theta_i = (x y_i - y x_i)/r^2,   rho_i = (x x_i + y y_i)/r^2,
            theta_ij = (x y_ij - y x_ij)/r^2 - theta_i rho_j - theta_j rho_i.

        On a box that meets the cut of the angle (the negative x axis), the ranges of the
        derivatives are all numbers. In the code u and v are the ranges of x and y. `inverse_r` is
        at first the range of r and then that of 1/r; `cosine` and `sine` are at first the ranges of
        x and y times 1/r, and then these, clipped to [-1, 1].
        """
        number = x.backend_number() if self.value.is_literal else self.backend_number()
        v, u = self.value_on_backend(number), x.value_on_backend(number)
        value, meets_cut = angle_range(v, u)
        # (The first result of `ranges` is the range of the function itself.)
        inverse_r = sqrt_range(u.square() + v.square())
        # 1/r is at least 0, and x/r and y/r are within [-1, 1].
        inverse_r = Interval(0 * inverse_r.lower, dr.inf).intersect(inverse_r.reciprocal())
        cosine, sine = (bound * inverse_r for bound in (u, v))
        cosine, sine = (
            Interval(fmax(bound.lower, -1), fmin(bound.upper, 1)) for bound in (cosine, sine)
        )
        variables = range(len(self.first_derivatives))
        theta = [wronskian_range(x, self, u, v, i) * inverse_r * inverse_r for i in variables]
        rho = [
            (cosine * x.first_derivatives[i] + sine * self.first_derivatives[i]) * inverse_r
            for i in variables
        ]
        second = [
            (cosine * self.second_derivatives[k] - sine * x.second_derivatives[k]) * inverse_r
            - (theta[i] * rho[j] + theta[j] * rho[i])
            for k, (i, j) in enumerate(self.hessian_indices())
        ]

        def uncut(bound: Interval) -> Interval:
            """The range of a derivative; all numbers where the box meets the cut of the angle."""
            return Interval(
                typed_select(meets_cut, -dr.inf, bound.lower, number),
                typed_select(meets_cut, dr.inf, bound.upper, number),
            )

        first = tuple(uncut(bound) for bound in theta)
        jet = Jet(
            value, first, tuple(uncut(bound) for bound in second), piece_length=self.piece_length
        )
        if self.jet_at_start is None or x.jet_at_start is None:
            return jet
        return jet.narrowed_from_start(
            self.jet_at_start.polar_angle(x.jet_at_start), self.piece_length
        )

    def select(self, condition: Mask, other: Jet) -> Jet:
        """This jet on lanes where the condition holds, the jet `other` on all other lanes."""
        number = self.backend_number()

        def chosen(u: Interval, v: Interval) -> Interval:
            """The range u on lanes where the condition holds, v on all other lanes."""
            if u.is_literal and v.is_literal and u == v:
                return u
            low = typed_select(condition, u.lower, v.lower, number)
            return Interval(low, typed_select(condition, u.upper, v.upper, number))

        start = None
        if self.jet_at_start is not None and other.jet_at_start is not None:
            start = self.jet_at_start.select(condition, other.jet_at_start)
        return Jet(
            chosen(self.value, other.value),
            tuple(
                chosen(u, v)
                for u, v in zip(self.first_derivatives, other.first_derivatives, strict=True)
            ),
            tuple(
                chosen(u, v)
                for u, v in zip(self.second_derivatives, other.second_derivatives, strict=True)
            ),
            start,
            self.piece_length,
        )

    def value_on_backend(self, like: Any = None) -> Interval:
        """The range of the value with Dr.Jit numbers as its ends: if they are Python numbers, they
        are converted.

        like: a number of the type to use; by default one of this jet.
        """
        if not self.value.is_literal:
            return self.value
        kind = cast("Any", type(self.backend_number() if like is None else like))
        low = kind(self.value.lower)
        # A point interval has the same object as both ends.
        return Interval(
            low, low if self.value.lower == self.value.upper else kind(self.value.upper)
        )

    def hessian_indices(self) -> list[tuple[int, int]]:
        """The pairs (i, j) of variables by which the second derivatives are taken, in the order in
        which they are stored."""
        n = len(self.first_derivatives)
        return [(i, j) for i in range(n) for j in range(i, n)][: len(self.second_derivatives)]

    def narrowed_from_start(self, start: Jet | None, width: Real) -> Jet:
        """This jet on a piece of a path, with its ranges narrowed by the values at the start of the
        piece.

        start: the jet at the start; None leaves this jet unchanged.
        width: the length w of the piece.

        Proof. f(s) = f(0) + s f'(r) for some r between 0 and s, so f stays within f(0) + [0, w] f'.
        The same holds for f' and f''. It also holds if f' jumps, since the range of f'' then allows
        the jump.
        """
        if start is None:
            return self
        # The range of the change since the start of the piece. A piece has one variable, the
        # length, so that derivatives have the index 0.
        rise = range_times_length(self.first_derivatives[0], width)
        first = self.first_derivatives[0]
        if self.second_derivatives:
            slope_from_start = start.first_derivatives[0] + range_times_length(
                self.second_derivatives[0], width
            )
            first = first.intersect(slope_from_start)
        value = self.value.intersect(start.value + rise)
        return Jet(value, (first,), self.second_derivatives, start, width)


def wronskian_range(x: Jet, y: Jet, u: Interval, v: Interval, i: int) -> Interval:
    """The range of w = x y_i - y x_i on a box or on a piece of a path, where y_i and x_i are
    derivatives by the variable i.

    x, y: the two functions, as jets (ranges of value and derivatives).
    u, v: the ranges of the values of x and of y, with Dr.Jit numbers as ends.
    i: the index of the variable.

    On a piece of a path the variable i is the length s. Then w has the derivative x y_ii - y x_ii,
    as the terms x_i y_i cancel. So w also lies in a second range: its value at the start of the
    piece, plus lengths up to that of the piece times the range of this derivative. The result is
    the intersection of the two ranges. For coordinates, which are linear in s, the derivative is 0,
    and w is its value at the start.
    """
    w = u * y.first_derivatives[i] - v * x.first_derivatives[i]
    if x.jet_at_start is None or y.jet_at_start is None:
        return w
    at_start = (
        x.jet_at_start.value * y.jet_at_start.first_derivatives[i]
        - y.jet_at_start.value * x.jet_at_start.first_derivatives[i]
    )
    derivative = u * y.second_derivatives[i] - v * x.second_derivatives[i]
    return w.intersect(at_start + range_times_length(derivative, x.piece_length))


def range_times_length(slope: Interval, width: Real) -> Interval:
    """The range of s t for 0 <= s <= width and t in the interval `slope`. It contains 0.

    width: a length >= 0, a number of the backend.

    If the product for the lower end of `slope` overflows to +infinity, or that for the upper end to
    -infinity, rounding outwards makes it NaN. The end of the result is then 0, as it should be,
    since s t = 0 at s = 0: fmin and fmax with 0 return 0 rather than NaN.
    """
    if slope.is_zero:
        return ZERO
    product = slope * Interval(width, width)
    return Interval(fmin(product.lower, 0.0), fmax(product.upper, 0.0))


def _moved(base: Interval, rate: Interval, s: Real) -> Interval:
    """The range of b + r s for all numbers b of the interval `base` and r of the interval `rate`; s
    is a single number."""
    if isinstance(s, float) and s == 0.0:
        return base
    return base + rate * Interval.point(s)


_Partials = tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class Dual(FormulaNumber):
    """A function of x, y and z at a point: its value and its three partial derivatives there, as
    plain numbers without ranges. So nothing is proved with it.

    At a tie, such as in max(x, 0) at x = 0, the ranges of a `Jet` contain all slopes nearby. A dual
    number has the slope of one of the two sides there, since maxima and minima compare the values
    alone.
    """

    value: Real
    first_derivatives: _Partials

    @classmethod
    def at_point(cls, p: Vec3) -> tuple[Dual, Dual, Dual]:
        """The coordinates x, y and z at points p, as functions of the three variables x, y and
        z."""
        return cls(p.x, (1.0, 0.0, 0.0)), cls(p.y, (0.0, 1.0, 0.0)), cls(p.z, (0.0, 0.0, 1.0))

    def constant(self, x: float | Real) -> Dual:
        return Dual(cast("Any", type(self.value))(x), (0.0, 0.0, 0.0))

    def constant_between(self, lower: Real, upper: Real) -> Dual:
        del upper  # nothing is proved with dual numbers
        return self.constant(lower)

    def sum(self, other: Dual) -> Dual:
        """The sum of this function and another one."""
        return Dual(
            self.value + other.value,
            _map_partials(operator.add, self.first_derivatives, other.first_derivatives),
        )

    def product(self, other: Dual) -> Dual:
        """The product of this function and another one, by the product rule."""
        own_value, other_value = self.value, other.value

        def rule(a: Any, b: Any) -> Any:
            """The partial derivative of the product, from the partial derivatives a and b of the
            two factors."""
            return a * other_value + own_value * b

        return Dual(
            own_value * other_value,
            _map_partials(rule, self.first_derivatives, other.first_derivatives),
        )

    def __neg__(self) -> Dual:
        return Dual(-self.value, _map_partials(operator.neg, self.first_derivatives))

    def apply(self, function: ElementaryFunction) -> Dual:
        """The composition of an elementary function with this function.

        If this function is constant, so is the result, even where the slope of the elementary
        function is infinite, such as that of the root in a norm of zeros.
        """
        # The derivative of the elementary function, as the middle of its range at a point.
        slope = function.ranges(Interval.point(self.value))[1].midpoint
        real = cast("Any", type(self.value))

        def rule(a: Any) -> Any:
            """Compute the partial derivative of the result, from that of this function, a. (Where a
            is 0 only at this point, it still has derivatives by the numbers of the formula.)"""
            return a * dr.select((real(a) == 0) & ~dr.isfinite(slope), 0, slope)

        return Dual(function.on_drjit(self.value), _map_partials(rule, self.first_derivatives))

    def polar_angle(self, x: Dual) -> Dual:
        """The polar angle of the point (x, y), where y is this function. With an index for a
        derivative, its derivatives are (x y_i - y x_i)/(x^2 + y^2)."""
        u, v = x.value, self.value

        def rule(a: Any, b: Any) -> Any:
            """Compute the partial derivative of the angle, from those of x and y, a and b."""
            return (u * b - v * a) / (u * u + v * v)

        return Dual(
            dr.atan2(v, u), _map_partials(rule, x.first_derivatives, self.first_derivatives)
        )

    def pointwise_maximum(self, other: Dual) -> Dual:
        """The larger of this function and another function; at a tie, the other function."""
        is_own = self.value > other.value

        def rule(a: Any, b: Any) -> Any:
            """The partial derivative of the larger function, from the partial derivatives a of this
            function and b of the other one."""
            return dr.select(is_own, a, b)

        value = dr.select(is_own, self.value, other.value)
        return Dual(value, _map_partials(rule, self.first_derivatives, other.first_derivatives))


def _map_partials(function: Callable[..., Any], *partials: _Partials) -> _Partials:
    """Apply `function` three times: to the derivatives of one or several functions by x, to their
    derivatives by y, and to those by z. Returns the three results.

    partials: for each function its three partial derivatives.
    """
    x, y, z = (function(*of_axis) for of_axis in zip(*partials, strict=True))
    return x, y, z
