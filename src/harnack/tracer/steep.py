"""Tests and bounds for rays through functions f whose slope has no bound (`Field.is_steep`). A
level is a value of f that rays look for; the surface is where f takes it. Usually |f - level| /
|grad f| estimates the distance to the surface. Here it does not, so hits and steps rest on ranges
of the values of f instead.

Beside a vertical tangent or a pole f may bend by any amount. For example, the slope of sqrt(|x|) +
0.5 at x = 1e-6 is 500, so the level 0 should be 0.001 away, but f never takes it. So before a point
counts as a hit, f is sampled on the other side of the level. Steps that slopes do not prove may be
proved by ranges of values (`arithmetic.values`).

The same holds for a formula that is steep only within the rounding of coordinates, such as max(-1,
min(1, 1e9 y)), whose slope is 0 on both sides. At a rounded point near y = 0, a level lies within
the error of f, and no step is proved. Such a ray hits if f is found on the other side of the level;
otherwise it ends as out of steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic import Values
from harnack.backend.elementary import fmax, fmin, max_norm, safe_normalize
from harnack.backend.loops import loop_while_active
from harnack.fields.formula_evaluator import without_alternatives

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import LevelGaps, Levels
    from harnack.enclosures.samples import Ray, Sample
    from harnack.fields.evaluator import Evaluator

# A level may be the value of f up to rounding if its gap is at most the first number times the
# change of f by rounding on that side, and f changes on the other side by at most the second number
# times as much.
_GAP_FACTOR, _MAX_ASYMMETRY = 1.25, 8.0
# The number of points that are sampled without a search, the number of points after a search, the
# largest number of samples before these, and the golden section of the search.
_TRIAL_COUNT, _SIDE_COUNT, _MAX_SAMPLES, _GOLDEN_SECTION = 5, 7, 100, 0.381966
# The range of f on a box around a point is about the range of its values if f is continuous this
# many times as far: for x y/(x^2 + y^2), which is at most 1/2, it is then within 0.502.
_CONTINUITY_FACTOR = 1024.0


def values_between(
    evaluator: Evaluator, p: Vec3, q: Vec3, slack: Real | None = None
) -> Values | None:
    """Return the range of values of a field on the box with corners p and q, enlarged by `slack` on
    all sides. The result is None if the field has no formula that takes ranges of coordinates."""
    coordinates = Values.between(p, q, slack)
    formula: Any = getattr(evaluator, "formula", None)
    if formula is None:
        return None
    try:
        value = formula(*coordinates)
    except TypeError:  # this formula takes ranges of derivatives alone
        return None
    # (The formula may be a plain number; it becomes a range here.)
    return coordinates[0].coerce(value).checked()


def largest_change(evaluator: Evaluator, p: Vec3, value: Real, reach: Real) -> Real:
    """Return a bound of |f(y) - f(p)| for |y - p| <= `reach`; inf if none is known. value: f(p).

    Beside a vertical tangent this is much less than |grad f| times `reach`, which may exceed all
    changes of f anywhere: |grad f| of |x y|^(1/3) - z at x = 1e-10 is 1e5.
    """
    values = values_between(evaluator, p, p, reach)
    if values is None:
        return cast("Any", type(value))(dr.inf)
    change = fmax(values.value.upper - value, value - values.value.lower)
    return dr.select(dr.isfinite(change), change, dr.inf)


@dataclass(frozen=True)
class SteepPlace:
    """What ranges of the values of f prove at a trial point of a ray and on the length of the ray
    beyond it, where f is a function whose slope has no bound.

    error: a bound of the error of f at the point, from the rounding of f and of the point; inf if
        no bound is known. (|grad f| times the rounding of the point is no bound here.) None for
        functions without a formula of their values.
    is_level: whether f may equal a level at the exact point. For this f must be continuous there,
        and the level must lie in the range of f around the rounded point, or just outside of it.
        This does not prove that f takes the level; `beyond` tests that.
    free: a length of the ray beyond the point on which f is proved to take no level, because f
        stays away from levels or has no value there; 0 if no length is proved.
    ahead: the length of the ray beyond the point on which values were bounded.
    fall, rise: bounds of how far f falls and rises on that length from its value at the point; inf
        if no bound is known.
    """

    error: Real | None
    is_level: Mask
    free: Real
    ahead: Real
    fall: Real
    rise: Real

    @classmethod
    def at(
        cls, evaluator: Evaluator, levels: Levels, path: Ray, t: Real, ahead: Real, sample: Sample
    ) -> SteepPlace:
        """Compute the bounds at the parameter t of rays: of the error of f at the point, and of the
        length beyond the point on which f takes no level.

        ahead: the length of the ray beyond t on which values are bounded.
        sample: the sample of f at t.

        Proof of the bound of the error. The exact point differs from the rounded point by at most
        `slack` in each coordinate. So it lies in a box around the rounded point, and f there lies
        in the range of f on this box. If there is a single level, only errors count by which f may
        be nearer to this level.

        Proof of the free length. All points of the ray on this length lie in the box around its two
        ends, enlarged by rounding. All values of f in the box lie in its range, and the range
        contains no level.
        """
        p, value = path.point(t), sample.value
        real = cast("Any", type(t))
        slack = 8 * float(dr.epsilon(real)) * (max_norm(path.origin) + t)
        # On an infinite length nothing is bounded.
        ahead = dr.select(dr.isfinite(ahead), ahead, 0)
        at_point = values_between(evaluator, p, p, slack)
        on_path = values_between(evaluator, p, path.point(t + ahead), slack)
        # Without a formula of values nothing is proved. (t < t is False everywhere.)
        if at_point is None or on_path is None:
            return cls(None, t < t, real(0), real(0), real(dr.inf), real(dr.inf))
        below, above = value - at_point.value.lower, at_point.value.upper - value
        # The range contains f(p), its ends are numbers, and f is continuous in the box.
        is_valid = (below >= 0) & (above >= 0) & ~at_point.jumps
        gaps = levels.gaps(value)
        is_below = gaps.below < gaps.above
        error_to_level = dr.select(is_below, below, above)
        error_away = dr.select(is_below, above, below)
        # Steps that are shorter than a rounding of t do not advance the ray, so it may stop a
        # little before the level is in range. At a pole, where f changes far more on the other
        # side, this is not allowed.
        is_level = (gaps.nearest <= error_to_level) | (
            (gaps.nearest <= _GAP_FACTOR * error_to_level)
            & (error_away <= _MAX_ASYMMETRY * error_to_level)
        )
        error = error_to_level if gaps.is_one_sided else fmax(error_to_level, error_away)
        error = dr.select(is_valid & dr.isfinite(error), error, dr.inf)
        # `nowhere`: f has no value at any point of the box.
        is_free = on_path.nowhere
        if levels.period is None:
            # Start with True (t == t). An end of the range that is NaN stands for an infinite end,
            # and comparisons with it are False.
            misses_levels = t == t
            for level in levels.values:
                misses_levels &= (on_path.value.lower > level) | (on_path.value.upper < level)
            is_free = is_free | misses_levels
        free = dr.select(is_free, ahead, 0)
        fall, rise = value - on_path.value.lower, on_path.value.upper - value
        return cls(error, is_level & is_valid, free, ahead, fall, rise)

    def free_of(self, gaps: LevelGaps) -> Real:
        """Return the length `ahead` of the ray if f is proved to change on it by less than `gaps`,
        else 0.

        gaps: the differences between f and the next levels below and above. These levels need not
            be those of which the attribute `free` is proved: for a ray that looks for crossings,
            the level that it has reached counts as lying a little farther off (`Hysteresis`).
        """
        return dr.select((self.fall < gaps.below) & (self.rise < gaps.above), self.ahead, 0)


@dataclass(frozen=True)
class _SearchState:
    """The state of the test `beyond`, with one entry for each point p. The test samples f at other
    points q to find one at a level or on its other side. If the first samples do not decide, it
    searches along the first direction for the point where f comes nearest to a level.

    count: the number of all samples so far.
    side_count: the number of samples so far that were taken after the search, beside the point.
    passed: whether a sample was at a level or on its other side.
    active: whether the test goes on.
    low, high: lengths along the first direction between which f comes nearest to a level.
    inner: the length between them at which f was nearest to a level so far.
    least_gap: the difference between f and the level there.
    """

    count: Any
    side_count: Any
    passed: Mask
    active: Mask
    low: Real
    high: Real
    inner: Real
    least_gap: Real


def passes(levels: Levels, value: Real, low: Real, high: Real, gaps: LevelGaps) -> Mask:
    """Return the mask of lanes on which all numbers from `low` to `high` are at a level, or beyond
    it as seen from `value`.

    gaps: the differences between `value` and the next levels; used for periodic levels only.

    Numbers are compared with the level itself. Beside a pole, a difference of values would lose the
    level by rounding, as 1e28 + 1 does.
    """
    if levels.period is not None:
        return (high - value <= -gaps.below) | (low - value >= gaps.above)
    passed: Mask = value < value  # false everywhere
    for level in levels.values:
        passed |= ((value < level) & (low >= level)) | ((value > level) & (high <= level))
    return passed


def holds(levels: Levels, value: Real, low: Real, high: Real, gaps: LevelGaps) -> Mask:
    """Return the mask of lanes on which a level lies between `low` and `high`.

    value, gaps: f at a point, and the differences between it and the next levels. They are used for
        periodic levels only: then the two levels next to `value` count, value - gaps.below and
        value + gaps.above.
    """
    if levels.period is not None:
        is_held = (low - value <= -gaps.below) & (high - value >= -gaps.below)
        return is_held | ((low - value <= gaps.above) & (high - value >= gaps.above))
    is_held: Mask = value < value  # false everywhere
    for level in levels.values:
        is_held |= (low <= level) & (high >= level)
    return is_held


def beyond(
    backend: Backend,
    evaluator: Evaluator,
    levels: Levels,
    gaps: LevelGaps,
    p: Vec3,
    ways: tuple[tuple[Vec3, Real], tuple[Vec3, Real]],
    value: Real,
    reach: Real,
    searches: Mask,
    active: Mask,
) -> tuple[Mask, Any]:
    """Test for which points p the function f takes a level at a distance of at most `reach` from p.
    Returns the mask of these points and the number of evaluations of f.

    gaps: the differences between f at p and the next levels below and above.
    ways: two unit directions (3,), each with the slope of f along it.
    value: f at p.
    searches: mask of points around which more samples are made if the first five do not decide.
        These are points from which the ray can come no nearer to the level.
    active: mask of points that are tested.

    Proof. Either f at another point q, at most `reach` away, is on the other side of the level, and
    on the box around p and q f is continuous and has values everywhere. Then f takes the level
    between them, up to its rounding at q. Or f at q is the level up to rounding, for example
    because it touches the level and turns back.

    Points q, in this order. Along the first direction: where its slope says that the level is;
    twice as far; at `reach`. Along the second direction: twice as far as its slope says; at
    `reach`. Then, for points in `searches`: along the first direction by golden sections towards
    the point where f comes nearest to the level; then `reach` back along the second direction, as
    rounding may have put p beyond the level; then half of `reach` along each axis, both ways, from
    the nearest point.

    Ranges of f around p prove nothing, as they may contain numbers that f does not take. The same
    holds for ranges beside a jump. So f counts as the level up to rounding only if it is continuous
    on a box that is many times as large as this rounding. If the level is not found, nothing is
    proved: the ray goes on, and comes nearer if it meets the surface.
    """
    epsilon = float(dr.epsilon(backend.Float))
    shortest = 4 * epsilon * reach

    def sample_once(now: _SearchState) -> _SearchState:
        """Evaluate f at the next point q, and return the state after it. Of the variables of the
        enclosing function, p, value, gaps, ways (two directions, each with the slope of f along
        it), reach and searches are its parameters; `shortest` is a length as short as rounding."""
        # Which of the points q comes next.
        is_first, is_far = now.count < 3, (now.count == 2) | (now.count == 4)
        is_search = now.count >= _TRIAL_COUNT
        is_side = is_search & ((now.high - now.low <= shortest) | (now.count >= _MAX_SAMPLES))
        is_behind = is_side & (now.side_count == 0)
        direction = dr.select(is_first | (is_search & ~is_behind), ways[0][0], ways[1][0])
        slope = dr.abs(dr.select(is_first, ways[0][1], ways[1][1]))
        factor = dr.select(now.count == 0, backend.Float(1), 2)
        distance = dr.select(is_far, reach, fmin(factor * gaps.nearest / slope, reach))
        # The next golden section lies in the longer of the two parts on both sides of the best
        # length.
        length_below, length_above = now.inner - now.low, now.high - now.inner
        search_length = now.inner + _GOLDEN_SECTION * dr.select(
            length_above >= length_below, length_above, -length_below
        )
        search_length = dr.select(is_behind, -reach, dr.select(is_side, now.inner, search_length))
        distance = dr.select(is_search, search_length, distance)
        # Of the points after the search, two lie along each axis.
        axis_step = dr.select((now.side_count & 1) == 0, 0.5 * reach, -0.5 * reach)
        axis = (now.side_count - 1) >> 1  # no axis if the count is 0: 0 - 1 is a large number
        offset = type(p)(*(dr.select(is_side & (axis == k), axis_step, 0) for k in range(3)))
        q = dr.fma(type(p)(distance), direction, p) + offset
        # Half the sides of a box around q, a little more than the rounding of q; 0 for a coordinate
        # of q whose own rounding is larger.
        half = type(p)(*(dr.select(shortest > epsilon * dr.abs(x), shortest, 0) for x in q))
        # Ranges of f at q up to rounding, between p and q, and on a larger box around q.
        at_q = values_between(evaluator, q - half, q + half)
        between = values_between(evaluator, p, q)
        around_q = values_between(
            evaluator, q - _CONTINUITY_FACTOR * half, q + _CONTINUITY_FACTOR * half
        )
        if at_q is None or between is None or around_q is None:
            # No formula of values: the sample at q decides alone.
            with without_alternatives():
                low = high = evaluator.evaluate(q).value
            passed = passes(levels, value, low, high, gaps)
        else:
            low, high = at_q.value.lower, at_q.value.upper
            passed = passes(levels, value, low, high, gaps)
            passed &= ~(between.jumps | between.gaps | between.nowhere)
            # Or a level lies in the range of f at q up to rounding, where f is continuous.
            passed |= holds(levels, value, low, high, gaps) & ~(around_q.jumps | at_q.nowhere)
        # The difference between f at q and the level that is nearer to f at p.
        nearest = dr.select(
            gaps.below < gaps.above, gaps.below + low - value, gaps.above + value - high
        )
        gap = dr.select(dr.isfinite(nearest), nearest, dr.inf)
        now = _narrowed(now, distance, gap, is_search & ~is_side)
        passed |= now.passed
        samples, side_count = (
            now.count + 1,
            now.side_count + dr.select(is_side, 1, 0),
        )
        active = (
            now.active
            & ~passed
            & ((samples < _TRIAL_COUNT) | (searches & (side_count < _SIDE_COUNT)))
        )
        return replace(
            now,
            count=samples,
            side_count=side_count,
            passed=passed,
            active=active,
        )

    # The search begins at p (`inner` = 0), in the interval from 0 to `reach`. In the order: count,
    # side_count, passed, active, low, high, inner, least_gap.
    begin = _SearchState(
        backend.UInt32(0), backend.UInt32(0), backend.Bool(False), backend.Bool(active),
        backend.Float(0), backend.Float(reach), backend.Float(0), backend.Float(gaps.nearest),
    )  # fmt: skip
    end = loop_while_active(begin, sample_once, "harnack beyond")
    return end.passed, end.count


def _narrowed(now: _SearchState, length: Real, gap: Real, is_search: Mask) -> _SearchState:
    """Return the state of the search after a sample at another length along the first direction.
    The search looks for the point where f comes nearest to a level.

    now: the state before the sample.
    length, gap: the length of the sample, and the difference between f there and the level.
    is_search: mask of lanes whose sample belongs to the search; other lanes do not change.

    The better of this sample and the best one so far becomes `inner`; the other becomes an end of
    the interval, `low` or `high`.
    """
    # The worse of the new point and the old best one becomes an end of the interval: the low end if
    # its length is the smaller one. That is so if the new point is the better and longer one, or if
    # it is neither.
    is_nearer, is_farther = gap <= now.least_gap, length > now.inner
    end, is_low = dr.select(is_nearer, now.inner, length), is_nearer == is_farther
    return replace(
        now,
        low=dr.select(is_search & is_low, end, now.low),
        high=dr.select(is_search & ~is_low, end, now.high),
        inner=dr.select(is_search & is_nearer, length, now.inner),
        least_gap=dr.select(is_search & is_nearer, gap, now.least_gap),
    )


def down_or_up(gradient: Vec3, gaps: LevelGaps, otherwise: Vec3) -> Vec3:
    """Return the unit vector (3,) along which f goes towards the nearer level: minus the direction
    of the gradient if that level is below f, else the direction of the gradient. It is `otherwise`
    if the gradient is zero or not finite.

    gaps: the differences between f and the next levels below and above.
    """
    direction = safe_normalize(gradient)
    direction = dr.select(gaps.below < gaps.above, -direction, direction)
    is_finite = dr.isfinite(direction.x + direction.y + direction.z)
    return dr.select(is_finite, direction, otherwise)
