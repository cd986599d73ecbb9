"""Distances of the surface from hits that may be due to rounding alone.

Where grad f is 0 on the surface, as where two sheets of it meet, f - level behaves as a power c u^m
of the distance u. Rounding hides the surface there from afar: f equals the level, up to its error
e, as far as (e/c)^(1/m). The estimate e/|grad f| of the distance is then only of first order, and m
times too short. So the surface is searched for around such hits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, safe_norm, safe_normalize
from harnack.backend.loops import loop_while_active
from harnack.fields.samples import value_error_bound

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.field import Field

# The search distance grows by the first factor in each round, up to the second number times the
# size of coordinates. A side of the level is sure only if f is within this fraction of the period
# of the level, so that a jump from one period to the next is no change of sides.
_DISTANCE_GROWTH, _MAX_DISTANCE_FRACTION = 1.25, 1 / 16
_MAX_PERIOD_FRACTION = 0.25
# The number of directions from a hit: both along the gradient, and both along two axes across it.
_DIRECTION_COUNT = 6


@dataclass(frozen=True)
class Doubtful:
    """Hits around which the surface is searched for.

    position: (3,) of the hits.
    normal: (3,) unit vector along the gradient.
    size: a bound of the coordinates along the ray up to the hit.
    distance: the distance from the hit at which the search begins.
    """

    position: Vec3
    normal: Vec3
    size: Real
    distance: Real


@dataclass(frozen=True)
class _SearchState:
    """The state of the search around a hit.

    distance: the distance of the next sample.
    way: index of its direction.
    above, below: whether f was surely seen on these sides of the level.
    low, high, low_slope, high_slope: lengths along the gradient between which f turns back from the
        level, and the slopes there.
    searches: whether the point at which f turns back is being searched for.
    may_turn: whether such a point may still be found.
    looks: the number of samples so far.
    seen: whether the surface was seen.
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
    looks: Any
    seen: Mask
    active: Mask


def seen_distance(backend: Backend, field: Field, levels: Levels, hits: Doubtful) -> Real:
    """A distance from each hit within which the surface was seen, at least `hits.distance`;
    infinite if it was not seen within a sixteenth of the size of coordinates.

    Proof. At one sampled point f is certainly on one side of the level, and at another sampled
    point certainly on the other side: by more than the bound of its error at each. All points lie
    within this distance of the hit, so f takes the level between them, or jumps past it at a facet.
    If f only touches the level, it stays on one side, and no sign tells. Then it turns back: its
    slope along the gradient of the hit changes sign, and at the point of this change, which secants
    and bisection give, f equals the level up to its error. No sample in this precision can tell
    such a point from the surface.
    """
    at_hit = field.evaluate(hits.position)
    level = at_hit.value + levels.offset_to_nearest(at_hit.value)
    period = levels.period
    farthest = fmax(_MAX_DISTANCE_FRACTION * hits.size, hits.distance)
    smallest = 4 * backend.machine_epsilon * hits.size

    def offset_of(sample: Any) -> tuple[Real, Real, Mask]:
        """f less the level, the bound of its error, and whether its side is sure."""
        x, error = (
            sample.value - level,
            value_error_bound(sample, safe_norm(sample.gradient), hits.size),
        )
        if period is None:
            return x, error, dr.abs(x) > error
        x = x - period * dr.round(x / period)
        return x, error, (dr.abs(x) > error) & (dr.abs(x) < _MAX_PERIOD_FRACTION * period)

    normal, vector = hits.normal, backend.Array3f
    axis = dr.select(dr.abs(normal.x) < 0.6, vector(1, 0, 0), vector(0, 1, 0))
    across = safe_normalize(dr.cross(normal, axis))
    second = dr.cross(normal, across)
    x, _, is_sure = offset_of(at_hit)
    side = dr.select(x > 0, backend.Float(1), -1)

    def body(now: _SearchState) -> _SearchState:
        direction = dr.select(now.way < 2, hits.normal, dr.select(now.way < 4, across, second))
        direction = dr.select((now.way & 1) == 0, direction, -direction)
        length = dr.select(now.searches, _turning_point(now), now.distance)
        sample = field.evaluate(dr.fma(type(direction)(length), direction, hits.position))
        x, error, is_sure = offset_of(sample)
        above, below = now.above | (is_sure & (x > 0)), now.below | (is_sure & (x < 0))
        slope = side * dr.dot(sample.gradient, direction)
        first_slope = side * dr.dot(at_hit.gradient, direction)
        is_seen = (above & below) | (now.searches & (dr.abs(x) <= error))
        # Does f turn back from the level in this direction?
        turns = now.may_turn & ~now.searches & (now.way < 2)
        turns &= (first_slope < 0) & (slope > sample.gradient_error)
        is_low = now.searches & (slope < 0)
        is_high = turns | (now.searches & ~is_low)
        low = dr.select(turns, 0, dr.select(is_low, length, now.low))
        high = dr.select(is_high, length, now.high)
        goes_on = turns | (now.searches & (high - low > smallest))
        stays = goes_on & ~is_seen
        way_index = dr.select(stays, now.way, (now.way + 1) % _DIRECTION_COUNT)
        is_round = ~stays & (way_index == 0)
        distance = dr.select(is_round & ~is_seen, _DISTANCE_GROWTH * now.distance, now.distance)
        return _SearchState(
            distance=distance,
            way=way_index,
            above=above,
            below=below,
            low=low,
            high=high,
            low_slope=dr.select(turns, first_slope, dr.select(is_low, slope, now.low_slope)),
            high_slope=dr.select(is_high, slope, now.high_slope),
            searches=stays,
            may_turn=now.may_turn & ~(now.searches & ~goes_on),
            looks=now.looks + 1,
            seen=is_seen,
            active=now.active & ~is_seen & (distance <= farthest),
        )

    zero, yes, no = backend.Float(0), backend.Bool(True), backend.Bool(False)
    begin = _SearchState(
        hits.distance, backend.UInt32(0), is_sure & (x > 0), is_sure & (x < 0), zero, zero, zero,
        zero, no, yes, backend.UInt32(0), no, yes,
    )  # fmt: skip
    end = loop_while_active(begin, body, "harnack doubtful hits")
    return dr.select(end.seen, end.distance, dr.inf)


def _turning_point(now: _SearchState) -> Real:
    """The length at which f may turn back: by the secant through the slopes and by bisection, in
    turns."""
    fraction = now.low_slope / (now.low_slope - now.high_slope)
    by_secant = ((now.looks & 1) == 0) & (fraction > 0) & (fraction < 1)
    return dr.fma(dr.select(by_secant, fraction, 0.5), now.high - now.low, now.low)
