"""Sums and products of functions along a ray, from enclosures of the functions between parabolas.
An enclosure bounds how far a function can change along the ray from its value at a sample.

The change of a function f along the ray is F(s), at the length s beyond the sample. A
`ParabolaEnclosure` states for lengths s up to its reach

    a s + c s^2/2 <= F(s) <= b s + d s^2/2.

Such bounds can be added and multiplied, and so can those of functions that are known by ranges of
their derivatives on pieces of the ray (`PiecewiseTaylorEnclosure`), and by promises alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.arithmetic.interval import Interval
from harnack.backend.elementary import fmax
from harnack.enclosures.enclosure import STEP_SAFETY, Enclosure, PathPiece, SlopeRange
from harnack.enclosures.extremum import NegatedEnclosure, ScaledEnclosure
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.sums import lipschitz_promise, taylor_constant, value_error

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.enclosures.samples import RaySample, Sample

# Lengths at which slopes are computed are rounded by less than this fraction.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class RayFunction:
    """A function f along a ray: what is known of it in front of the point of a sample, or behind
    it.

    sample: the sample of f at the point.
    slopes: the range of the derivative of f along the direction at the point.
    enclosures: the enclosures of the change of f along this direction.
    """

    sample: Sample
    slopes: SlopeRange
    enclosures: tuple[Enclosure, ...]

    @classmethod
    def ahead(cls, ray_sample: RaySample) -> RayFunction:
        """What a ray sample says of f in front of its point."""
        slopes = SlopeRange.around(ray_sample.slope, ray_sample.slope_error_bound)
        return cls(ray_sample.sample, slopes, ray_sample.forward)

    @classmethod
    def behind(cls, ray_sample: RaySample) -> RayFunction:
        """What a ray sample says of f behind its point."""
        slopes = SlopeRange.around(ray_sample.slope, ray_sample.slope_error_bound).negated()
        return cls(ray_sample.sample, slopes, ray_sample.backward)

    @property
    def pieces(self) -> PiecewiseTaylorEnclosure | None:
        """The enclosure from ranges of derivatives on pieces of the ray; None if there is none."""
        kinds = (e for e in self.enclosures if isinstance(e, PiecewiseTaylorEnclosure))
        return next(kinds, None)

    @property
    def own_parabola(self) -> ParabolaEnclosure | None:
        """The first enclosure between parabolas that does not follow from a promise; None if there
        is none."""
        return next((e for e in self.enclosures if type(e) is ParabolaEnclosure), None)

    @property
    def has_ranges(self) -> bool:
        """Whether there is an enclosure that does not follow from promises."""
        return self.pieces is not None or self.own_parabola is not None

    def weighted(self, weight: Real, sample: Sample) -> RayFunction:
        """The function weight * f, of whose enclosures only those are kept with which this file
        computes.

        weight: a number of either sign.
        sample: the sample of weight * f.
        """
        known = (self.pieces,) if self.pieces is not None else (self.own_parabola,)
        return RayFunction(
            sample,
            _scaled_range(self.slopes, weight),
            tuple(weighted_enclosure(e, weight, is_negative=False) for e in known if e is not None),
        )

    def parabola(self, length: Real) -> ParabolaEnclosure | None:
        """The sharpest enclosure of the change of f between parabolas that is at hand, for lengths
        up to `length` or up to its own reach; None if nothing is known."""
        if self.pieces is not None:
            return _parabola_of_pieces(self.pieces)
        if self.own_parabola is not None:
            return self.own_parabola
        constant = taylor_constant(self.sample, length)
        if not isinstance(constant, float):
            constant = dr.select(constant >= 0, constant, dr.nan)
            return ParabolaEnclosure(self.slopes, -constant, constant, length)
        promise = lipschitz_promise(self.sample)
        if promise is None:
            return None
        return ParabolaEnclosure(
            SlopeRange(-promise.constant, promise.constant), 0.0, 0.0, promise.radius
        )


def weighted_enclosure(enclosure: Enclosure, weight: Real, *, is_negative: bool) -> Enclosure:
    """The enclosure of the change of weight * f along a ray, from that of the change of f.

    weight: a number other than 0.
    is_negative: whether it is below 0. It does not matter for the kinds with which this file
        computes, which stay what they are.
    """
    if isinstance(enclosure, PiecewiseTaylorEnclosure):
        slopes = _scaled_range(enclosure.slopes, weight)
        return PiecewiseTaylorEnclosure(
            slopes, tuple(_scaled_piece(piece, weight) for piece in enclosure.pieces)
        )
    if type(enclosure) is ParabolaEnclosure:
        factor = Interval.point(weight)
        return _parabola(_slopes(enclosure) * factor, _seconds(enclosure) * factor, enclosure.reach)
    scaled = ScaledEnclosure(enclosure, 1.0, -weight if is_negative else weight)
    return NegatedEnclosure(scaled) if is_negative else scaled


def _scaled_piece(piece: PathPiece, weight: Real) -> PathPiece:
    """A piece of a ray, with the ranges of the derivatives of weight * f."""
    seconds = Interval(piece.min_second_derivative, piece.max_second_derivative)
    seconds = seconds * Interval.point(weight)
    slopes = _scaled_range(piece.slope_range, weight)
    return PathPiece(piece.length, slopes, seconds.lower, seconds.upper)


def _scaled_range(slopes: SlopeRange, weight: Real) -> SlopeRange:
    """A range of slopes, times a weight."""
    return _range(Interval(slopes.lower, slopes.upper) * Interval.point(weight))


def _parabola_of_pieces(pieces: PiecewiseTaylorEnclosure) -> ParabolaEnclosure:
    """An enclosure between parabolas on the length of all pieces.

    Proof. By Taylor's formula F lies between the parabolas of the slopes at the start and of the
    ends of the range of F'' on all pieces. If one of these ends is not finite, as on a crease, F
    lies on that side of the line with the slope that ends the range of F'.
    """
    first, *others = pieces.pieces
    slopes, length = first.slope_range, first.length
    low, high = first.min_second_derivative, first.max_second_derivative
    lower_slope, upper_slope = slopes.lower, slopes.upper
    for piece in others:
        length = length + piece.length
        lower_slope = _smaller(lower_slope, piece.slope_range.lower)
        upper_slope = -_smaller(-upper_slope, -piece.slope_range.upper)
        low = _smaller(low, piece.min_second_derivative)
        high = -_smaller(-high, -piece.max_second_derivative)
    zero = 0 * length
    low, high = zero + low, zero + high
    has_low, has_high = dr.isfinite(low), dr.isfinite(high)
    return ParabolaEnclosure(
        SlopeRange(
            dr.select(has_low, pieces.slopes.lower, lower_slope),
            dr.select(has_high, pieces.slopes.upper, upper_slope),
        ),
        dr.select(has_low, low, 0),
        dr.select(has_high, high, 0),
        length,
    )


def _smaller(a: Real, b: Real) -> Real:
    """The smaller of two numbers; NaN if either is NaN."""
    return dr.select((a <= b) | (a != a), a, b)


def summed_enclosure(functions: Sequence[RayFunction], length: Real) -> Enclosure | None:
    """The enclosure of the change of the sum of several functions along a ray, for lengths up to
    `length` or up to the shortest reach of their enclosures; None if nothing is known of one.

    Proof. Let the change of one function be F, with ranges of F' and F'' on pieces of the ray, and
    let the changes of all others be at most a s + c s^2/2 altogether. The change of the sum is at
    most U(s) = F(s) + a s + c s^2/2. U is a function with U' <= F' + a + c s and U'' <= F'' + c. So
    the proof of `PiecewiseTaylorEnclosure` for levels above holds with these upper ends of the
    ranges. The same is true of levels below and of the lower ends.
    """
    parabolas: list[ParabolaEnclosure] = []
    counted = [0 if f.pieces is None else len(f.pieces.pieces) for f in functions]
    main = counted.index(max(counted))
    pieces = functions[main].pieces
    for k, function in enumerate(functions):
        if pieces is None or k != main:
            parabola = function.parabola(length)
            if parabola is None:
                return None
            parabolas.append(parabola)
    if not parabolas:
        return pieces
    rest = _total(parabolas)
    reach = _shortest([length, *(parabola.reach for parabola in parabolas)])
    if pieces is None:
        return _parabola(*rest, reach)
    slopes = Interval(pieces.slopes.lower, pieces.slopes.upper) + rest[0]
    return PiecewiseTaylorEnclosure(_range(slopes), _cut_pieces(pieces.pieces, rest, reach))


def summed_slope(slopes: Sequence[SlopeRange]) -> tuple[Real, Real]:
    """The slope of a sum along a direction, and a bound of its error, from the ranges of the slopes
    of the terms."""
    total = Interval(0.0, 0.0)
    for entry in slopes:
        total = total + Interval(entry.lower, entry.upper)
    return total.midpoint, total.radius


def _cut_pieces(
    pieces: Sequence[PathPiece], rest: tuple[Interval, Interval], reach: Real
) -> tuple[PathPiece, ...]:
    """Pieces of a ray with ranges of the derivatives of F + R, where R(s) = a s + c s^2/2, up to
    the length `reach`. The lower ends are those for the lower a and c, the upper ends those for the
    upper ones.

    pieces: the pieces, with ranges of the derivatives of F.
    rest: the ranges of a and c.
    """
    start: Real = 0 * reach
    cut: list[PathPiece] = []
    for piece in pieces:
        # The length that is left is shortened by more than its rounding.
        is_whole = start + piece.length <= reach
        left = fmax((reach - start) * STEP_SAFETY, 0)
        length = dr.select(is_whole, piece.length, dr.select(piece.length >= 0, left, 0))
        at = Interval(start * (1 - _ROUNDING), (start + length) * (1 + _ROUNDING))
        lower = Interval.point(rest[0].lower) + Interval.point(rest[1].lower) * at
        upper = Interval.point(rest[0].upper) + Interval.point(rest[1].upper) * at
        slopes = Interval(piece.slope_range.lower, piece.slope_range.upper)
        slopes = slopes + Interval(lower.lower, upper.upper)
        second = Interval(piece.min_second_derivative, piece.max_second_derivative) + rest[1]
        cut.append(PathPiece(length, _range(slopes), second.lower, second.upper))
        start = start + length
    return tuple(cut)


def _total(parabolas: Sequence[ParabolaEnclosure]) -> tuple[Interval, Interval]:
    """The ranges of the slopes and of the second derivatives of enclosures between parabolas, each
    added up."""
    slopes, seconds = Interval(0.0, 0.0), Interval(0.0, 0.0)
    for entry in parabolas:
        slopes, seconds = slopes + _slopes(entry), seconds + _seconds(entry)
    return slopes, seconds


def _parabola(slopes: Interval, seconds: Interval, reach: Real) -> ParabolaEnclosure:
    """The enclosure between parabolas with these ranges of slopes and second derivatives."""
    return ParabolaEnclosure(_range(slopes), seconds.lower, seconds.upper, reach)


def _range(slopes: Interval) -> SlopeRange:
    """An interval of slopes as a `SlopeRange`."""
    return SlopeRange(slopes.lower, slopes.upper)


def _shortest(lengths: Sequence[Real]) -> Real:
    """The shortest of several lengths, at least 0; 0 if one is NaN."""
    result = lengths[0]
    for length in lengths[1:]:
        result = _smaller(length, result)
    return dr.select(result > 0, result, 0)


def multiplied_enclosure(f: RayFunction, g: RayFunction, length: Real) -> Enclosure | None:
    """The enclosure of the change of the product f g along a ray, between parabolas, for lengths up
    to `length` or up to the shortest reach of the enclosures of f and g; None if nothing is known
    of one of them.

    Proof. Let F and G be the changes of f and g. The change of the product is f G + g F + F G, with
    f and g at the start. For s <= r, F(s) = s A with A between the least a + c u/2 and the largest
    b + d u/2 for 0 <= u <= r, which are reached at u = 0 or u = r; likewise G(s) = s B. So F G is
    (2 A B) s^2/2. The ranges of f and g contain the errors of their values. Bounds of F and G that
    follow from promises hold up to these errors, which in F G are multiplied by at most s B and s
    A: they widen the slopes.
    """
    first, second = f.parabola(length), g.parabola(length)
    if first is None or second is None:
        return None
    reach = _shortest([length, first.reach, second.reach])
    f_value, g_value = _value_range(f.sample), _value_range(g.sample)
    f_mean, g_mean = _mean_slopes(first, reach), _mean_slopes(second, reach)
    product = f_mean * g_mean
    slopes = f_value * _slopes(second) + g_value * _slopes(first)
    slopes = slopes + _error_range(f.sample) * g_mean + _error_range(g.sample) * f_mean
    seconds = f_value * _seconds(second) + g_value * _seconds(first) + (product + product)
    return _parabola(slopes, seconds, reach)


def _value_range(sample: Sample) -> Interval:
    """The range of the value of a sample, with its whole error."""
    return Interval.point(sample.value) + _error_range(sample)


def _error_range(sample: Sample) -> Interval:
    """The interval of all errors that the value of a sample may have."""
    error = value_error(sample)
    return Interval(-error, error)


def _slopes(parabola: ParabolaEnclosure) -> Interval:
    """The slopes of both parabolas at the start, as an interval."""
    return Interval(parabola.slopes.lower, parabola.slopes.upper)


def _seconds(parabola: ParabolaEnclosure) -> Interval:
    """The second derivatives of both parabolas, as an interval."""
    return Interval(parabola.min_second_derivative, parabola.max_second_derivative)


def _mean_slopes(parabola: ParabolaEnclosure, length: Real) -> Interval:
    """The range of F(s)/s for 0 < s <= length."""
    half = Interval.point(0.5 * length)
    at_end = _slopes(parabola) + _seconds(parabola) * half
    return _slopes(parabola).hull(at_end)
