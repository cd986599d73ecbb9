"""Distances of the surface from hits that may be due to rounding alone. f is the function whose
level is the surface, and a hit is a point of a ray at which |f - level| is within a tolerance or
within the error of f.

Suppose that grad f is 0 on the surface, for example where two sheets of it meet. Then f - level
behaves as c u^m, with u the distance from the surface and m > 1. Rounding hides the surface there
from afar: at all distances up to (e/c)^(1/m), f equals the level up to its error e. The usual
estimate e/|grad f| of the distance is only of first order, and m times too short there. So the
surface is searched for around such hits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, safe_norm, safe_normalize
from harnack.backend.loops import loop_while_active
from harnack.enclosures.samples import value_error_bound

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.evaluator import Evaluator

# The search distance grows by the first factor in each round, up to the second number times the
# size of coordinates. A side of the level is sure only if f is within this fraction of the period
# of the level, so that a jump from one period to the next is no change of sides.
_DISTANCE_GROWTH, _MAX_DISTANCE_FRACTION = 1.25, 1 / 16
_MAX_PERIOD_FRACTION = 0.25
# The number of directions from a hit: both along the gradient, and both along two axes across it.
_DIRECTION_COUNT = 6


@dataclass(frozen=True)
class Doubtful:
    """Hits around which the surface is searched for, as arrays with one entry for each hit.

    position: (3,) the hit.
    normal: (3,) unit vector along the gradient of f.
    size: a bound of the coordinates along the ray up to the hit.
    distance: the first distance from the hit at which the search samples f.
    """

    position: Vec3
    normal: Vec3
    size: Real
    distance: Real


@dataclass(frozen=True)
class _SearchState:
    """The state of the search for the surface around each hit. Samples of f are taken in rounds: in
    six directions from the hit, at a distance that grows from round to round. Where f comes nearer
    to the level along the gradient and then turns back, the point at which it turns is searched
    for.

    distance: the distance of the next sample from the hit.
    way: the index of the direction of the next sample, 0 to 5; 0 and 1 are along the gradient.
    above, below: whether f was surely above the level at some sample so far, and whether it was
        surely below the level at some sample so far.
    low, high, low_slope, high_slope: two lengths along the gradient between which f turns back, and
        the slopes of f there.
    searches: whether the point at which f turns back is being searched for.
    may_turn: whether such a point may still be found.
    sample_count: the number of samples so far.
    is_found: whether the surface was found.
    active: whether the search goes on.
    """

    distance: Real
    way: Any
    above: Mask
    below: Mask
    low: Real
    high: Real
    low_slope: Real
    high_slope: Real
    searches: Mask
    may_turn: Mask
    sample_count: Any
    is_found: Mask
    active: Mask


def seen_distance(backend: Backend, evaluator: Evaluator, levels: Levels, hits: Doubtful) -> Real:
    """Return a distance from each hit within which the surface was found, at least `hits.distance`;
    inf if it was not found within a sixteenth of the size of coordinates.

    Proof. Two cases count as found. (1) At one sampled point f is certainly above the level, and at
    another one certainly below: the differences exceed the bounds of its error. All points lie
    within this distance of the hit. So f takes the level between them, or jumps past it. (2) f only
    touches the level and stays on one side. Then it turns back: its slope along the gradient at the
    hit changes sign. Secants and bisection find the point of this change, and f equals the level
    there up to its error. No sample in this precision can tell such a point from the surface.
    """
    at_hit = evaluator.evaluate(hits.position)
    # The level nearest to f at the hit.
    level = at_hit.value + levels.offset_to_nearest(at_hit.value)
    period = levels.period
    farthest = fmax(_MAX_DISTANCE_FRACTION * hits.size, hits.distance)
    smallest = 4 * backend.machine_epsilon * hits.size

    def offset_of(sample: Any) -> tuple[Real, Real, Mask]:
        """Return three results for a sample of f: f minus the level that is nearest to f at the
        hit; a bound of the error of f; and the mask of lanes on which it is certain on which side
        of the level f is."""
        offset, error = (
            sample.value - level,
            value_error_bound(sample, safe_norm(sample.gradient), hits.size),
        )
        if period is None:
            return offset, error, dr.abs(offset) > error
        offset = offset - period * dr.round(offset / period)
        return (
            offset,
            error,
            (dr.abs(offset) > error) & (dr.abs(offset) < _MAX_PERIOD_FRACTION * period),
        )

    # Two axes at right angles to the gradient, made from an axis that is far from parallel to it.
    normal, vector = hits.normal, backend.Array3f
    axis = dr.select(dr.abs(normal.x) < 0.6, vector(1, 0, 0), vector(0, 1, 0))
    first_axis = safe_normalize(dr.cross(normal, axis))
    second_axis = dr.cross(normal, first_axis)
    offset, _, is_sure = offset_of(at_hit)
    # Multiplied by this sign, a slope < 0 leads towards the level.
    side = dr.select(offset > 0, backend.Float(1), -1)

    def sample_once(now: _SearchState) -> _SearchState:
        """Take one more sample: in the next of six directions, or at the point at which f may turn
        back. Returns the state after it."""
        direction = dr.select(
            now.way < 2, hits.normal, dr.select(now.way < 4, first_axis, second_axis)
        )
        # Of the two opposite directions along an axis, the even one comes first.
        direction = dr.select((now.way & 1) == 0, direction, -direction)
        length = dr.select(now.searches, _turning_point(now), now.distance)
        sample = evaluator.evaluate(dr.fma(type(direction)(length), direction, hits.position))
        offset, error, is_sure = offset_of(sample)
        above, below = now.above | (is_sure & (offset > 0)), now.below | (is_sure & (offset < 0))
        # With the sign `side`, slopes < 0 lead towards the level.
        slope = side * dr.dot(sample.gradient, direction)
        first_slope = side * dr.dot(at_hit.gradient, direction)
        is_seen = (above & below) | (now.searches & (dr.abs(offset) <= error))
        # Has f turned back from the level between the hit and this sample?
        is_turning = now.may_turn & ~now.searches & (now.way < 2)
        is_turning &= (first_slope < 0) & (slope > sample.gradient_error)
        # The part of the interval in which the slope changes sign is kept.
        is_low = now.searches & (slope < 0)
        is_high = is_turning | (now.searches & ~is_low)
        low = dr.select(is_turning, 0, dr.select(is_low, length, now.low))
        high = dr.select(is_high, length, now.high)
        # Down to an interval as short as rounding (`smallest`).
        goes_on = is_turning | (now.searches & (high - low > smallest))
        keeps_way = goes_on & ~is_seen
        # Next direction; after the last one, the distance grows.
        way_index = dr.select(keeps_way, now.way, (now.way + 1) % _DIRECTION_COUNT)
        is_round = ~keeps_way & (way_index == 0)
        distance = dr.select(is_round & ~is_seen, _DISTANCE_GROWTH * now.distance, now.distance)
        return _SearchState(
            distance=distance,
            way=way_index,
            above=above,
            below=below,
            low=low,
            high=high,
            low_slope=dr.select(is_turning, first_slope, dr.select(is_low, slope, now.low_slope)),
            high_slope=dr.select(is_high, slope, now.high_slope),
            searches=keeps_way,
            # A search that has ended in vain is not begun again.
            may_turn=now.may_turn & ~(now.searches & ~goes_on),
            sample_count=now.sample_count + 1,
            is_found=is_seen,
            active=now.active & ~is_seen & (distance <= farthest),
        )

    # The sample at the hit may show a side of the level. No interval is known yet (zeros). In the
    # order: distance, way, above, below, low, high, their slopes, searches, may_turn, sample_count,
    # is_found, active.
    zero, yes, no = backend.Float(0), backend.Bool(True), backend.Bool(False)
    begin = _SearchState(
        hits.distance, backend.UInt32(0), is_sure & (offset > 0), is_sure & (offset < 0),
        zero, zero, zero, zero, no, yes, backend.UInt32(0), no, yes,
    )  # fmt: skip
    end = loop_while_active(begin, sample_once, "harnack doubtful hits")
    return dr.select(end.is_found, end.distance, dr.inf)


def _turning_point(now: _SearchState) -> Real:
    """Return the length along the gradient at which f may turn back from the level: by the secant
    through the slopes at `low` and `high`, and by bisection, in turns. If the secant leaves the
    interval, bisection takes its place."""
    fraction = now.low_slope / (now.low_slope - now.high_slope)
    by_secant = ((now.sample_count & 1) == 0) & (fraction > 0) & (fraction < 1)
    return dr.fma(dr.select(by_secant, fraction, 0.5), now.high - now.low, now.low)
