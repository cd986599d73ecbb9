"""A function with its derivatives, as one number: `Jet`, with proved ranges, and `Dual`, without.

A formula that is given jets as its coordinates returns the jet of its value. So one formula serves
for values, gradients and Hessians at a point, with proved bounds of rounding, and for the ranges
that steps are proved from.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.functions import Function, exp, log, power, reciprocal, sqrt
from harnack.arithmetic.interval import ONE, ZERO, Interval, select, unit_of
from harnack.arithmetic.operators import Operators, exponent_of
from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3


@dataclass(frozen=True, eq=False)
class Jet(Operators):
    """Ranges of a function of n variables and of its derivatives on a box of them; mostly n = 1,
    the length along a path, or n = 3 at a point.

    Interval arithmetic of value, first and second derivatives at once (Moore 1966; the Taylor forms
    of Aydinlilar and Zanni 2023, section 6.1, are made of it).

    value: of the function.
    first: (n,) of the partial derivatives.
    second: (n (n+1) / 2,) of the second derivatives, rows of the upper triangle; empty if they are
        not asked for. In the sense of distributions: at a kink, where the first derivative jumps,
        the range has no upper or no lower end.
    start: with n = 1, the jet at the start of the piece, from which ranges are narrowed; None for
        the jet at a point.
    width: the length of the piece; 0 at a point. A number of the backend, which tells the precision
        where all ranges are Python numbers.
    roots: the functions of whose squares it is known to be the sum; empty if it is not known to be
        one. The root of a sum of squares is a norm, whose slopes are bounded; by the chain rule
        they would not be where all squares are 0.
    """

    value: Interval
    first: tuple[Interval, ...]
    second: tuple[Interval, ...]
    start: Jet | None = None
    width: Real = 0.0
    roots: tuple[Jet, ...] = ()

    @classmethod
    def at_point(cls, p: Vec3, *, order: int = 1) -> tuple[Jet, Jet, Jet]:
        """The coordinates as functions of themselves, at points p: for gradients and Hessians."""
        second = (ZERO,) * 6 if order > 1 else ()
        units = [tuple(ONE if i == k else ZERO for i in range(3)) for k in range(3)]
        zero = 0 * p.x
        x, y, z = (Jet(Interval.exactly(p[k]), units[k], second, width=zero) for k in range(3))
        return x, y, z

    @classmethod
    def within(cls, p: Vec3, radius: Real) -> tuple[Jet, Jet, Jet]:
        """The coordinates as functions of themselves, on boxes around the balls B(p, radius)."""
        x, y, z = cls.at_point(p)
        ends = Interval(-radius, radius)
        x, y, z = (dataclasses.replace(one, value=one.value + ends) for one in (x, y, z))
        return x, y, z

    @classmethod
    def along(
        cls,
        p: Vec3,
        direction: Vec3,
        start: Real,
        end: Real,
        *,
        anchored: bool = True,
        is_rounded: bool = False,
    ) -> tuple[Jet, Jet, Jet]:
        """The coordinates of p + s d as functions of s, start <= s <= end.

        is_rounded: whether the path leads through p up to the rounding of its coordinates alone:
            ranges then hold for all paths that do, each along d.
        """

        def coordinate(x: Real, slope: Real) -> Jet:
            rate = Interval.exactly(slope)
            base = Interval.exactly(x)
            if is_rounded:
                base = base.widened(unit_of(x))
            here = _moved(base, rate, start)
            first, second = (rate,), (ZERO,)
            anchor = Jet(here, first, second, width=0 * x) if anchored else None
            return Jet(here.hull(_moved(base, rate, end)), first, second, anchor, end - start)

        x, y, z = (coordinate(p[k], direction[k]) for k in range(3))
        return x, y, z

    # Operators.

    def constant(self, x: float | Real) -> Jet:
        """A constant number as a function of the same variables."""
        if dr.is_array_v(cast("Any", type(x))):
            return self._constant(Interval.exactly(x))
        return self._constant(Interval.constant(float(x), type(self.kind())))

    def _constant(self, value: Interval) -> Jet:
        zeros = (ZERO,) * len(self.first), (ZERO,) * len(self.second)
        start = None if self.start is None else Jet(value, *zeros, width=self.start.width)
        return Jet(value, *zeros, start, self.width)

    def kind(self) -> Any:
        """A number of the backend's type in use; a Python number if there is none."""
        for jet in (self.value, *self.first):
            if dr.is_array_v(cast("Any", type(jet.low))):
                return jet.low
        return self.width

    def sum(self, other: Jet) -> Jet:
        jet = Jet(
            self.value + other.value,
            tuple(x + y for x, y in zip(self.first, other.first, strict=True)),
            tuple(x + y for x, y in zip(self.second, other.second, strict=True)),
            width=self.width,
        )
        if self.start is not None:
            jet = jet.anchored(self.start + other.start, self.width)
        is_square = bool(self.roots and other.roots)
        return dataclasses.replace(jet, roots=self.roots + other.roots) if is_square else jet

    def __neg__(self) -> Jet:
        return dataclasses.replace(
            self,
            value=-self.value,
            first=tuple(-one for one in self.first),
            second=tuple(-one for one in self.second),
            start=None if self.start is None else -self.start,
            roots=(),
        )

    def product(self, other: Jet) -> Jet:
        if other is self:  # a square, whose range is sharper than that of a product
            return self.apply(power(2))
        x, y = self.value, other.value
        first = tuple(x * v + y * u for u, v in zip(self.first, other.first, strict=True))
        second = tuple(
            x * other.second[k]
            + (self.first[i] * other.first[j] + self.first[j] * other.first[i])
            + y * self.second[k]
            for k, (i, j) in enumerate(self.pairs())
        )
        jet = Jet(x * y, first, second, width=self.width)
        if self.start is not None:
            jet = jet.anchored(self.start * other.start, self.width)
        roots = self._scaled_roots(y) or other._scaled_roots(x)
        return dataclasses.replace(jet, roots=roots) if roots else jet

    def _scaled_roots(self, factor: Interval) -> tuple[Jet, ...]:
        """The roots of the product with a positive constant, if there are any."""
        if not (self.roots and factor.is_static and factor.low > 0):
            return ()
        low, high = (math.sqrt(cast("float", number)) for number in (factor.low, factor.high))
        kind = cast("Any", type(self.kind()))
        low, high = math.nextafter(low, 0.0), math.nextafter(high, math.inf)
        scale = Interval.constant(low, kind).hull(Interval.constant(high, kind))
        return tuple(number * number._constant(scale) for number in self.roots)

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, Jet):
            return self * other.apply(reciprocal)
        b = self._operand(other)
        if b is None:
            return NotImplemented
        if not b.value.is_static:
            return self * b.apply(reciprocal)
        if float(other) == 0.0:
            raise ZeroDivisionError("a formula divides by the constant 0")
        return self * self._constant(b.value.reciprocal())

    def __pow__(self, exponent: Any) -> Jet:
        if isinstance(exponent, Jet):
            if self.value.is_static:  # Python numbers: take the type from the exponent
                base = exponent._constant(self.dynamic_value(exponent.kind()))
                return (base.apply(log) * exponent).apply(exp)
            return (self.apply(log) * exponent).apply(exp)
        n = exponent_of(exponent)
        return self.apply(sqrt if n == 0.5 and self.roots else power(n))

    # Functions.

    def apply(self, function: Function) -> Jet:
        """A function of this one: f(g)'' = f'' g' g' + f' g''."""
        if function is sqrt and self.roots:
            from harnack.arithmetic.norms import norm

            return norm(*self.roots)
        x = self.dynamic_value()
        value, slope, curvature = function.ranges(x)
        first = tuple(slope * one for one in self.first)
        second = tuple(
            curvature * (self.first[i].square() if i == j else self.first[i] * self.first[j])
            + slope * self.second[k]
            for k, (i, j) in enumerate(self.pairs())
        )
        jet = Jet(value, first, second, width=self.width)
        if self.start is not None:
            jet = jet.anchored(self.start.apply(function), self.width)
        is_square = function.name == "power 2"
        return dataclasses.replace(jet, roots=(self,)) if is_square else jet

    def larger(self, other: Jet) -> Jet:
        """The larger of two functions at each point.

        Proof. If one is larger everywhere, it is the maximum. Else each derivative is that of one
        of
        the two, except where they cross: there the first derivative jumps up, so that the second
        one has no upper bound.
        """
        x, y = self.dynamic_value(), other.dynamic_value(self.kind())
        left, right = x.low > y.high, y.low > x.high

        def chosen(u: Interval, v: Interval, *, kink: bool) -> Interval:
            if u.is_static and v.is_static and u == v and not kink:
                return u
            both = u.hull(v)
            high = dr.inf if kink else both.high
            return Interval(
                select(left, u.low, select(right, v.low, both.low, x.low), x.low),
                select(left, u.high, select(right, v.high, high, x.low), x.low),
            )

        pairs = self.pairs()
        value = Interval(x.meet(y).low, x.hull(y).high)
        first = tuple(
            chosen(u, v, kink=False) for u, v in zip(self.first, other.first, strict=True)
        )
        second = tuple(
            chosen(u, v, kink=i == j)
            for (i, j), u, v in zip(pairs, self.second, other.second, strict=True)
        )
        jet = Jet(value, first, second, width=self.width)
        if self.start is None:
            return jet
        return jet.anchored(self.start.maximum(other.start), self.width)

    def angle(self, x: Jet) -> Jet:
        """The angle of the point (x, y), y this one.

        Proof. The angle is the imaginary part of log z, z = x + i y, whose derivatives are z_i/z
        and z_ij/z - (z_i/z)(z_j/z). With z_i/z = rho_i + i theta_i these are
        theta_i = (x y_i - y x_i)/r^2, rho_i = (x x_i + y y_i)/r^2 and
        theta_ij = (x y_ij - y x_ij)/r^2 - theta_i rho_j - theta_j rho_i.
        """
        like = x.kind() if self.value.is_static else self.kind()
        v, u = self.dynamic_value(like), x.dynamic_value(like)
        value, met = angle_range(v, u)
        over = sqrt.ranges(u.square() + v.square())[0]
        over = Interval(0 * over.low, dr.inf).meet(reciprocal.ranges(over)[0])
        c, s = (one * over for one in (u, v))
        c, s = (Interval(fmax(one.low, -1), fmin(one.high, 1)) for one in (c, s))
        count = range(len(self.first))
        turn = [across(x, self, u, v, i) * over * over for i in count]
        growth = [(c * x.first[i] + s * self.first[i]) * over for i in count]
        second = [
            (c * self.second[k] - s * x.second[k]) * over
            - (turn[i] * growth[j] + turn[j] * growth[i])
            for k, (i, j) in enumerate(self.pairs())
        ]

        def off_cut(one: Interval) -> Interval:
            return Interval(
                select(met, -dr.inf, one.low, like), select(met, dr.inf, one.high, like)
            )

        first = tuple(off_cut(one) for one in turn)
        jet = Jet(value, first, tuple(off_cut(one) for one in second), width=self.width)
        if self.start is None or x.start is None:
            return jet
        return jet.anchored(self.start.angle(x.start), self.width)

    def selected(self, condition: Mask, other: Jet) -> Jet:
        """This one on lanes where the condition holds, the other on all others."""
        kind = self.kind()

        def chosen(u: Interval, v: Interval) -> Interval:
            if u.is_static and v.is_static and u == v:
                return u
            low = select(condition, u.low, v.low, kind)
            return Interval(low, select(condition, u.high, v.high, kind))

        start = None
        if self.start is not None and other.start is not None:
            start = self.start.selected(condition, other.start)
        return Jet(
            chosen(self.value, other.value),
            tuple(chosen(u, v) for u, v in zip(self.first, other.first, strict=True)),
            tuple(chosen(u, v) for u, v in zip(self.second, other.second, strict=True)),
            start,
            self.width,
        )

    def dynamic_value(self, like: Any = None) -> Interval:
        """The range of the value as numbers of the backend."""
        if not self.value.is_static:
            return self.value
        kind = cast("Any", type(self.kind() if like is None else like))
        low = kind(self.value.low)
        return Interval(low, low if self.value.low == self.value.high else kind(self.value.high))

    def pairs(self) -> list[tuple[int, int]]:
        """Indices of the variables of each second derivative."""
        n = len(self.first)
        return [(i, j) for i in range(n) for j in range(i, n)][: len(self.second)]

    def anchored(self, start: Jet | None, width: Real) -> Jet:
        """The same, narrowed by what is known at the start of the piece.

        Proof. f(s) = f(0) + s f'(r) for some r in between, so f stays within f(0) + [0, w] f'; the
        same holds for f' and f'', also where f' jumps, by at most what f'' allows.
        """
        if start is None:
            return self
        rise = spanned(self.first[0], width)
        first = self.first[0]
        if self.second:
            turned = start.first[0] + spanned(self.second[0], width)
            first = first.meet(turned)
        value = self.value.meet(start.value + rise)
        return Jet(value, (first,), self.second, start, width)


def across(x: Jet, y: Jet, u: Interval, v: Interval, i: int) -> Interval:
    """The range of w = x y_i - y x_i, for the ranges u and v of x and y, as numbers of the backend.

    Its derivative x y_ii - y x_ii is 0 along straight lines: the range of w is narrowed from the
    start of the piece.
    """
    found = u * y.first[i] - v * x.first[i]
    if x.start is None or y.start is None:
        return found
    at_start = x.start.value * y.start.first[i] - y.start.value * x.start.first[i]
    rate = u * y.second[i] - v * x.second[i]
    return found.meet(at_start + spanned(rate, x.width))


def spanned(slope: Interval, width: Real) -> Interval:
    """The range of s times numbers of an interval, for 0 <= s <= width.

    An end that is NaN, as the product overflowed to the other side, becomes 0, which is right.
    """
    if slope.is_zero:
        return ZERO
    moved = slope * Interval(width, width)
    return Interval(fmin(moved.low, 0.0), fmax(moved.high, 0.0))


def _moved(base: Interval, rate: Interval, s: Real) -> Interval:
    """base + rate s."""
    if isinstance(s, float) and s == 0.0:
        return base
    return base + rate * Interval.exactly(s)


_Partials = tuple[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class Dual(Operators):
    """A function at a point: its value and partial derivatives, as plain numbers. No ranges, so
    nothing is proved.

    Where a formula has ties, as max(x, 0) has at x = 0, ranges of derivatives contain all slopes
    nearby. A dual number has the slopes of one side, as each comparison is decided by the values.
    """

    value: Real
    first: _Partials

    @classmethod
    def at_point(cls, p: Vec3) -> tuple[Dual, Dual, Dual]:
        """The coordinates as functions of themselves."""
        return cls(p.x, (1.0, 0.0, 0.0)), cls(p.y, (0.0, 1.0, 0.0)), cls(p.z, (0.0, 0.0, 1.0))

    def constant(self, x: float | Real) -> Dual:
        return Dual(cast("Any", type(self.value))(x), (0.0, 0.0, 0.0))

    def sum(self, other: Dual) -> Dual:
        return Dual(self.value + other.value, _each(operator.add, self.first, other.first))

    def product(self, other: Dual) -> Dual:
        x, y = self.value, other.value

        def rule(a: Any, b: Any) -> Any:
            return a * y + x * b

        return Dual(x * y, _each(rule, self.first, other.first))

    def __neg__(self) -> Dual:
        return Dual(-self.value, _each(operator.neg, self.first))

    def apply(self, function: Function) -> Dual:
        """A function of this one. Where this one is constant, so is the result, also where the
        function's slope is infinite, as that of the root in a norm of zeros."""
        slope = function.ranges(Interval.exactly(self.value))[1].middle
        real = cast("Any", type(self.value))

        def rule(a: Any) -> Any:
            return dr.select(real(a) == 0, 0, a * slope)

        return Dual(function.plain(self.value), _each(rule, self.first))

    def angle(self, x: Dual) -> Dual:
        u, v = x.value, self.value

        def rule(a: Any, b: Any) -> Any:
            return (u * b - v * a) / (u * u + v * v)

        return Dual(dr.atan2(v, u), _each(rule, x.first, self.first))

    def larger(self, other: Dual) -> Dual:
        is_own = self.value > other.value

        def rule(a: Any, b: Any) -> Any:
            return dr.select(is_own, a, b)

        value = dr.select(is_own, self.value, other.value)
        return Dual(value, _each(rule, self.first, other.first))


def _each(function: Callable[..., Any], *partials: _Partials) -> _Partials:
    x, y, z = (function(*of_axis) for of_axis in zip(*partials, strict=True))
    return x, y, z
