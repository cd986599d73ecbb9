"""Jets (ranges of a function and of its derivatives) of the distance from a point or from a
segment, in closed form. The general arithmetic of jets gives them as well, from the operations of
the formula, with some ten times as many operations and wider ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.arithmetic.interval import (
    Interval,
    machine_epsilon,
    pad_underflow,
    round_down,
    smallest_normal,
)
from harnack.arithmetic.jet import Jet
from harnack.backend.elementary import fmax, fmin

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

__all__ = ["jet_of_point_distance", "jet_of_segment_distance"]


def jet_of_point_distance(point: Sequence[Any], center: Sequence[Any]) -> Jet | None:
    """The jet of the distance from a center; None if the coordinates are not jets of points or of
    lines (`_Start`).

    point, center: (3,) coordinates.
    """
    start = _Start.of(point)
    if start is None:
        return None
    c = [_nearest(number) for number in center]
    local = [a - b for a, b in zip(start.position, c, strict=True)]
    size = start.size + dr.abs(c[0]) + dr.abs(c[1]) + dr.abs(c[2])
    return _Distance(start, local, list(start.rates), None, size, None).jet()


def jet_of_segment_distance(
    point: Sequence[Any], frame: Sequence[Any], half_length: Any
) -> Jet | None:
    """The jet of `segment_distance`; None if the coordinates are not jets of points or of lines
    (`_Start`)."""
    start = _Start.of(point)
    if start is None:
        return None
    numbers = [_nearest(number) for number in frame]
    axes = [numbers[k : k + 3] for k in (0, 4, 8)]
    offsets = numbers[3], numbers[7], numbers[11]
    local = [
        _dot(start.position, axis, -offset) for axis, offset in zip(axes, offsets, strict=True)
    ]
    rates = [_dot(start.rates, axis) for axis in axes] if start.rates else []
    size = start.size + fmax(fmax(dr.abs(offsets[0]), dr.abs(offsets[1])), dr.abs(offsets[2]))
    # The coordinate along the axis comes last.
    local, rates, axes = ([*a[1:], *a[:1]] for a in (local, rates, axes))
    return _Distance(start, local, rates, _nearest(half_length), size, axes).jet()


def _nearest(number: Any) -> Any:
    """A number of the backend, or of Python, within a unit in the last place of a constant."""
    return number.value.lower if isinstance(number, Jet) else number


def _dot(vector: Sequence[Any], axis: Sequence[Any], offset: Any = 0.0) -> Any:
    """The scalar product of two vectors (3,), plus an offset."""
    total = offset
    for a, b in zip(vector, axis, strict=True):
        total = dr.fma(a, b, total)
    return total


@dataclass(frozen=True)
class _Start:
    """What the jets of the three coordinates are of: points, or lines p + s d for 0 <= s <= w.

    position: (3,) the coordinates of p.
    rates: (3,) those of d; () for points.
    gradient: whether the derivatives by x, y and z at points are asked for.
    length: w; None if only the derivative at the start of lines is asked for.
    zero: 0 as a number of the backend.
    """

    position: tuple[Real, ...]
    rates: tuple[Real, ...]
    gradient: bool
    length: Real | None
    zero: Real

    @classmethod
    def of(cls, point: Sequence[Any]) -> _Start | None:
        """The points or lines of three jets; None if these are of other functions, or if p is not
        exact, or the Hessian is asked for."""
        if not all(isinstance(entry, Jet) for entry in point):
            return None
        first = point[0]
        is_piece = first.jet_at_start is not None
        values = [(e.jet_at_start if is_piece else e).value for e in point]
        if any(value.is_literal or value.lower is not value.upper for value in values):
            return None
        position = tuple(value.lower for value in values)
        zero = 0 * position[0]
        slopes = [entry.first_derivatives for entry in point]
        seconds = [entry.second_derivatives for entry in point]
        if is_piece:
            if any(len(s) != 1 or s[0].lower is not s[0].upper for s in slopes):
                return None
            if any(len(s) != 1 or not s[0].is_zero for s in seconds):
                return None
            rates = tuple(s[0].lower for s in slopes)
            return cls(position, rates, False, first.piece_length, zero)
        if any(seconds):
            return None
        if not any(slopes):
            return cls(position, (), False, None, zero)
        if all(len(s) == 1 and s[0].lower is s[0].upper for s in slopes):
            return cls(position, tuple(s[0].lower for s in slopes), False, None, zero)
        is_identity = all(
            len(s) == 3 and all(e.is_literal and e.lower == float(i == k) == e.upper
                                for i, e in enumerate(s))
            for k, s in enumerate(slopes)
        )  # fmt: skip
        return cls(position, (), True, None, zero) if is_identity else None

    @property
    def size(self) -> Real:
        """|x| + |y| + |z| of p."""
        x, y, z = self.position
        return dr.abs(x) + dr.abs(y) + dr.abs(z)


@dataclass(frozen=True)
class _Nearest:
    """The distance at some points: its value, and its slopes along lines.

    value: the range of the distance.
    normal: (3,) the computed unit vector from the nearest point of the set.
    error: a bound of the error of the normal.
    """

    value: Interval
    normal: list[Real]
    error: Real

    def slope(self, rates: Sequence[Real], size: Real, largest: Real) -> Interval:
        """The range of the derivative along a vector. rates: its local coordinates; size: the sum
        of the absolute values of its coordinates; largest: a bound of its length."""
        middle = _dot(self.normal, rates, 0.0)
        error = (self.error + 8.0 * machine_epsilon(size)) * size
        return _clipped(middle, error, largest)


@dataclass(frozen=True)
class _Distance:
    """The distance from the points (0, 0, h) with |h| <= L, in local coordinates.

    start: the points, or lines.
    local, rates: (3,) the local coordinates of p, and of d.
    half_length: L; None for 0.
    size: such that the local coordinates are sums of terms whose absolute values add up to at most
        this.
    axes: (3, 3) the unit vectors of the local coordinates; None for those of x, y and z.

    Proof. The distance f is convex: with s, its slope grows, from that at the start to that at the
    end of the piece. So f is at most the larger of its values at both ends, and at least what the
    tangents at both ends say; it is also at least the distance of the box that the local
    coordinates stay in. Let q be the vector from the nearest point of the segment, and l the vector
    d. Where that point is an end of the segment, f'' = (|l|^2 - f'^2)/f = |q x l|^2/f^3, and the
    cross product is the same on the whole line. Where it is between the ends, the same holds with q
    and l at right angles to the axis. f' is continuous where the nearest point passes an end, so
    that f'' lies between the least and the largest of those that occur. At f = 0 it has no upper
    bound.

    Rounding. Let e be the machine epsilon. Constants are within e of their size, and a local
    coordinate is computed with three roundings by e/2 of at most S = `size`, so that its error is
    at most 3 e S; that of the clipped one at most 4 e S + 2 e L =: D. So the vector q has an error
    of at most 2 D, and f too, but for the rounding of the norm by 4 e of it. The unit vector q/|q|
    has an error of at most twice that of q, divided by |q|, and as all slopes are at most |d|,
    those of f follow. Squares that underflow add at most the root of the smallest normal numbers.
    """

    start: _Start
    local: list[Real]
    rates: list[Real]
    half_length: Any
    size: Real
    axes: list[Any] | None

    def jet(self) -> Jet:
        """The jet of the distance."""
        start = self.start
        at_start = self._nearest(self.local, self._error(self.size, 4.0))
        if start.gradient:
            return Jet(at_start.value, self._gradient(at_start), (), piece_length=start.zero)
        if not start.rates:
            return Jet(at_start.value, (), (), piece_length=start.zero)
        x, y, z = start.rates
        size = dr.abs(x) + dr.abs(y) + dr.abs(z)
        largest = dr.sqrt(x * x + y * y + z * z) * (1 + 4 * self._epsilon) + self._tiny_length
        slope = at_start.slope(self.rates, size, largest)
        if start.length is None:
            return Jet(at_start.value, (slope,), (), piece_length=start.zero)
        return self._on_piece(at_start, slope, size, largest, start.length)

    def _on_piece(
        self, at_start: _Nearest, slope: Interval, size: Real, largest: Real, length: Real
    ) -> Jet:
        """The jet on the piece of lines of a length. at_start, slope: value and derivative at the
        start. size, largest: those of `_Nearest.slope`."""
        end = [dr.fma(length, rate, a) for a, rate in zip(self.local, self.rates, strict=True)]
        error = self._error(self.size + length * size, 5.0)
        at_end = self._nearest(end, error)
        end_slope = at_end.slope(self.rates, size, largest)
        low = self._least(at_start, at_end, slope, end_slope, end, length, error)
        a, b = at_start.value.upper, at_end.value.upper
        high = dr.select((a > b) | dr.isnan(a), a, b)
        squared = largest * largest
        widening = 1 + 8 * self._epsilon
        curvature = self._curvature(end, error, size, Interval(low, high))
        second = Interval(curvature.lower, fmin(curvature.upper, squared / low * widening))
        first_second = Interval(0 * low, squared / at_start.value.lower * widening)
        zero = self.start.zero
        anchor = Jet(at_start.value, (slope,), (first_second,), piece_length=zero)
        slopes = Interval(slope.lower, end_slope.upper)
        return Jet(Interval(low, high), (slopes,), (second,), anchor, length)

    @property
    def _epsilon(self) -> float:
        return machine_epsilon(self.start.zero)

    @property
    def _tiny_length(self) -> float:
        """A bound of the length of vectors of which all squares underflow."""
        return 2.0 * math.sqrt(smallest_normal(self.start.zero))

    def _error(self, size: Real, units: float) -> Real:
        """The bound D of the error of a local coordinate."""
        epsilon = self._epsilon
        error = (units * epsilon) * size + smallest_normal(self.start.zero)
        return error if self.half_length is None else error + (2 * epsilon) * self.half_length

    def _nearest(self, local: Sequence[Real], error: Real) -> _Nearest:
        """The distance at points. local: their local coordinates, with this error."""
        u, v, w = local[0], local[1], self._clipped(local[2])
        length = dr.sqrt(dr.fma(u, u, dr.fma(v, v, w * w)))
        epsilon = self._epsilon
        slack = dr.fma(length, 5 * epsilon, 2 * error + self._tiny_length)
        inverse = 1 / length
        # Where the point may be on the segment, and where squares overflow, nothing is known.
        is_known = length > slack
        of_normal = dr.select(is_known, dr.fma(4 * error, inverse, 12 * epsilon), 2.0)
        normal = [dr.select(is_known, entry * inverse, 0.0) for entry in (u, v, w)]
        value = Interval(fmax(length - slack, 0.0), length + slack)
        return _Nearest(value, normal, of_normal)

    def _clipped(self, along: Real) -> Real:
        """The coordinate along the axis, from the nearest point of the segment."""
        if self.half_length is None:
            return along
        return along - fmax(fmin(along, self.half_length), -self.half_length)

    def _gradient(self, at: _Nearest) -> tuple[Interval, ...]:
        """The ranges of the derivatives by x, y and z."""
        largest = 1 + 4 * self._epsilon
        if self.axes is None:
            return tuple(_clipped(entry, at.error, largest) for entry in at.normal)
        columns = zip(*self.axes, strict=True)
        return tuple(_clipped(_dot(at.normal, c, 0.0), at.error, largest) for c in columns)

    def _least(
        self, at_start: _Nearest, at_end: _Nearest, slope: Interval, end_slope: Interval,
        end: Sequence[Real], length: Real, error: Real,
    ) -> Real:  # fmt: skip
        """A lower bound of the distance on the piece: the largest of that of the box of local
        coordinates, and of those by the tangents at both ends. (A bound that is NaN is not
        used.)"""
        first, last = list(self.local), list(end)
        first[2], last[2] = self._clipped(first[2]), self._clipped(last[2])
        u, v, w = (
            fmax(fmax(-fmax(a, b), fmin(a, b)), 0.0) for a, b in zip(first, last, strict=True)
        )
        of_box = dr.sqrt(dr.fma(u, u, dr.fma(v, v, w * w)))
        of_box -= dr.fma(of_box, 5 * self._epsilon, 2 * error + self._tiny_length)
        widened = (1 + 4 * self._epsilon) * length
        falls, grows = fmin(slope.lower, 0.0), fmax(end_slope.upper, 0.0)
        by_start = round_down(dr.fma(widened, falls, at_start.value.lower))
        by_end = round_down(dr.fma(-widened, grows, at_end.value.lower))
        return fmax(fmax(of_box, by_start), fmax(by_end, 0.0))

    def _curvature(self, end: Sequence[Real], error: Real, size: Real, value: Interval) -> Interval:
        """The range of f'' on the piece. end: the local coordinates at its end; error: of local
        coordinates on it; size: that of `_Nearest.slope`; value: the range of f."""
        (u, v, h), (lu, lv, lh), half = self.local, self.rates, self.half_length
        epsilon = self._epsilon
        slack = 4 * self._error(self.size, 4.0) * size + self._tiny_length
        around_axis = u * lv - v * lu

        def around(a: Any) -> Interval:
            """The length of the cross product for the nearest point (0, 0, a)."""
            p, q = v * lh - (h - a) * lv, (h - a) * lu - u * lh
            length = dr.sqrt(dr.fma(p, p, dr.fma(q, q, around_axis * around_axis)))
            widening = dr.fma(length, 8 * epsilon, 2 * slack)
            return Interval(fmax(length - widening, 0.0), length + widening)

        if half is None:
            cross = around(0.0)
        else:
            axial = dr.abs(around_axis)
            axial = Interval(fmax(axial - slack, 0.0), axial + slack)
            least, most = fmin(h, end[2]), fmax(h, end[2])
            cross = _hull_where(
                [
                    (axial, ~(fmax(least, -most) > half + error)),
                    (around(half), ~(most < half - error)),
                    (around(-half), ~(least > error - half)),
                ]
            )
        low, high = cross.lower / value.upper, cross.upper / value.lower
        low = pad_underflow(low * low, -1) / value.upper * (1 - 16 * epsilon)
        high = pad_underflow(high * high, 1) / value.lower * (1 + 16 * epsilon)
        return Interval(fmax(low, 0.0), high)


def _hull_where(parts: Sequence[tuple[Interval, Mask]]) -> Interval:
    """The smallest interval that contains those of the intervals, of numbers >= 0, whose masks
    hold. An upper end that is NaN stays so."""
    low: Any = dr.inf
    high: Any = 0.0
    for interval, mask in parts:
        low = fmin(low, dr.select(mask, interval.lower, dr.inf))
        end = dr.select(mask, interval.upper, 0.0)
        high = dr.select((end > high) | dr.isnan(end), end, high)
    return Interval(low, high)


def _clipped(middle: Real, error: Real, largest: Any) -> Interval:
    """The numbers within an error of the middle, and of a size of at most `largest`."""
    return Interval(fmax(middle - error, -largest), fmin(middle + error, largest))
