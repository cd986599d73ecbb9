"""Hits and steps where the slope of a field has no bound (`Field.is_steep`).

|f - level| / |grad f| estimates the distance to the level only if f does not bend within it. Beside
a vertical tangent or a pole f may bend by any amount: at x = 1e-6 the slope of sqrt(|x|) + 0.5 is
500, so the level 0 should be 0.001 away, but f never takes it. So before a point counts as a hit, f
is sampled on the other side of the level; and steps that slopes do not prove may be proved by
ranges of values (`arithmetic.values`).

The same holds for a formula that is steep only within the rounding of coordinates, such as
max(-1, min(1, 1e9 y)), whose slope is 0 on both sides. A rounded point there has a level within its
error, which ends all steps. The ray hits if f is seen on the other side of the level, and is
undecided otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic import Values
from harnack.backend.elementary import fmax, fmin, max_norm, safe_normalize
from harnack.backend.loops import loop_while_active
from harnack.fields.formula import without_alternatives

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import LevelGaps, Levels
    from harnack.fields.field import Field
    from harnack.fields.samples import Ray, Sample

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


def values_between(field: Field, p: Vec3, q: Vec3, slack: Real | None = None) -> Values | None:
    """The values of a field on a box around two points, larger by `slack`; None for a field without
    a formula of its values."""
    coordinates = Values.between(p, q, slack)
    formula: Any = getattr(field, "formula", None)
    if formula is None:
        return None
    try:
        value = formula(*coordinates)
    except TypeError:  # this formula takes ranges of derivatives alone
        return None
    return coordinates[0].coerce(value).checked()


def largest_change(field: Field, p: Vec3, value: Real, reach: Real) -> Real:
    """A bound of |f(y) - f(p)| for |y - p| <= `reach`; infinite if none is known.

    Beside a vertical tangent, |grad f| times a length is a larger number, which may exceed all
    changes of f anywhere: |grad f| of |x y|^(1/3) - z at x = 1e-10 is 1e5.
    """
    values = values_between(field, p, p, reach)
    if values is None:
        return cast("Any", type(value))(dr.inf)
    change = fmax(values.value.upper - value, value - values.value.lower)
    return dr.select(dr.isfinite(change), change, dr.inf)


@dataclass(frozen=True)
class SteepPlace:
    """What the values of a field prove at a trial point.

    error: a bound of the error of f there, by its own rounding and by the rounding of the point;
        infinite where no bound is known. |grad f| times the rounding of the point is no bound. None
        for fields without a formula of their values.
    is_level: whether a level may be the value of f at the exact point: it lies in the range of f
        around the rounded point, or so near to this range that rounding may keep a ray from coming
        nearer, and f is proved to be continuous there. It is no proof that f takes the level
        (`beyond`).
    free: a length of the path on which no value of f is a level, because f stays away from levels
        or has no value at all; 0 where no length is proved.
    ahead: the length of the path on which values were bounded.
    fall, rise: bounds of how much smaller and larger f is on that length than at the point;
        infinite where no bound is known.
    """

    error: Real | None
    is_level: Mask
    free: Real
    ahead: Real
    fall: Real
    rise: Real

    @classmethod
    def at(
        cls, field: Field, levels: Levels, path: Ray, t: Real, ahead: Real, sample: Sample
    ) -> SteepPlace:
        """The bounds at the parameter t, with the sample there. ahead: the length of the path on
        which values are bounded.

        Proof of the error. The exact point lies in the box of all points that are at most `slack`
        from the rounded point in each coordinate, so f there lies in the range on the box.

        Proof of the length. All points of the path on it lie in the box around its ends, rounding
        included, and all values of f in the box lie in its range, which contains no level.
        """
        p, value = path.point(t), sample.value
        real = cast("Any", type(t))
        slack = 8 * float(dr.epsilon(real)) * (max_norm(path.origin) + t)
        ahead = dr.select(dr.isfinite(ahead), ahead, 0)
        at_point = values_between(field, p, p, slack)
        on_path = values_between(field, p, path.point(t + ahead), slack)
        if at_point is None or on_path is None:
            return cls(None, t < t, real(0), real(0), real(dr.inf), real(dr.inf))
        below, above = value - at_point.value.lower, at_point.value.upper - value
        valid = (below >= 0) & (above >= 0) & ~at_point.jumps
        gaps = levels.gaps(value)
        is_below = gaps.below < gaps.above
        near = dr.select(is_below, below, above)
        far = dr.select(is_below, above, below)
        # Steps that are shorter than a rounding of t do not advance the ray. Beside a pole f
        # changes far more on the other side.
        is_level = (gaps.nearest <= near) | (
            (gaps.nearest <= _GAP_FACTOR * near) & (far <= _MAX_ASYMMETRY * near)
        )
        error = near if gaps.is_one_sided else fmax(near, far)
        error = dr.select(valid & dr.isfinite(error), error, dr.inf)
        is_free = on_path.nowhere
        if levels.period is None:
            # A bound that is NaN stands for an infinite bound.
            misses = t == t
            for level in levels.values:
                misses &= (on_path.value.lower > level) | (on_path.value.upper < level)
            is_free = is_free | misses
        free = dr.select(is_free, ahead, 0)
        fall, rise = value - on_path.value.lower, on_path.value.upper - value
        return cls(error, is_level & valid, free, ahead, fall, rise)

    def free_of(self, gaps: LevelGaps) -> Real:
        """A length of the path on which f changes by less than these gaps; 0 where no length is
        proved. For levels at other places than `free`, as those of a ray in contact
        (`Hysteresis`)."""
        return dr.select((self.fall < gaps.below) & (self.rise < gaps.above), self.ahead, 0)


@dataclass(frozen=True)
class _SearchState:
    """The state of the test `beyond`.

    looks, sides: the number of samples, and of the samples after the search.
    passed: whether a level was passed.
    low, high: the search for the point at which f comes nearest to a level: lengths along the first
        way between which it does.
    inner, least: a length between these, and the level gap there.
    """

    looks: Any
    sides: Any
    passed: Mask
    active: Mask
    low: Real
    high: Real
    inner: Real
    least: Real


def passes(levels: Levels, value: Real, low: Real, high: Real, gaps: LevelGaps) -> Mask:
    """Whether all numbers of a range are on the other side of a level than a value, or at the
    level.

    Numbers are compared with the level itself: beside a pole, differences of values round it away,
    as 1e28 + 1 does.

    gaps: from the value to the levels; they place periodic levels.
    """
    if levels.period is not None:
        return (high - value <= -gaps.below) | (low - value >= gaps.above)
    passed: Mask = value < value
    for level in levels.values:
        passed |= ((value < level) & (low >= level)) | ((value > level) & (high <= level))
    return passed


def holds(levels: Levels, value: Real, low: Real, high: Real, gaps: LevelGaps) -> Mask:
    """Whether a level lies in a range; see `passes`."""
    if levels.period is not None:
        is_held = (low - value <= -gaps.below) & (high - value >= -gaps.below)
        return is_held | ((low - value <= gaps.above) & (high - value >= gaps.above))
    is_held: Mask = value < value
    for level in levels.values:
        is_held |= (low <= level) & (high >= level)
    return is_held


def beyond(
    backend: Backend,
    field: Field,
    levels: Levels,
    gaps: LevelGaps,
    p: Vec3,
    ways: tuple[tuple[Vec3, Real], tuple[Vec3, Real]],
    value: Real,
    reach: Real,
    searches: Mask,
    active: Mask,
) -> tuple[Mask, Any]:
    """Whether f takes a level within `reach` of p, and how many evaluations of f that took.

    ways: two directions, each with the slope of f along it.
    value: f at p.
    gaps: from f at p to the `levels`.
    searches: lanes on which a search is made, as the ray can come no nearer.

    Proof. At another point, at most `reach` away, f is on the other side of the level, and on the
    box around both it is continuous and has values everywhere: so it takes the level between them
    (up to its rounding there). Or f is the level at the other point, up to rounding, as where it
    touches the level and turns back. The points are along the first way where the slope says that
    the level is, twice as far, and at `reach`; and the next two along the second way. Where f may
    be the level at p, up to the rounding of p, others follow: along the first way by golden
    sections towards where f comes nearest to the level, then back along the second way, as rounding
    may have put p behind the level, and from the nearest place half of `reach` along each axis.
    Ranges around p are no proof: they hold numbers that are no values of f, and so do those beside
    a jump: f is at the level up to rounding only where it is continuous on a box that is many times
    as large as this rounding. If the level is not found, nothing is proved: the ray goes on, and
    comes nearer if it meets the surface.
    """
    epsilon = float(dr.epsilon(backend.Float))
    shortest = 4 * epsilon * reach

    def body(now: _SearchState) -> _SearchState:
        is_first, is_far = now.looks < 3, (now.looks == 2) | (now.looks == 4)
        is_search = now.looks >= _TRIAL_COUNT
        is_side = is_search & ((now.high - now.low <= shortest) | (now.looks >= _MAX_SAMPLES))
        is_behind = is_side & (now.sides == 0)
        direction = dr.select(is_first | (is_search & ~is_behind), ways[0][0], ways[1][0])
        slope = dr.abs(dr.select(is_first, ways[0][1], ways[1][1]))
        factor = dr.select(now.looks == 0, backend.Float(1), 2)
        distance = dr.select(is_far, reach, fmin(factor * gaps.nearest / slope, reach))
        behind, ahead = now.inner - now.low, now.high - now.inner
        section = now.inner + _GOLDEN_SECTION * dr.select(ahead >= behind, ahead, -behind)
        section = dr.select(is_behind, -reach, dr.select(is_side, now.inner, section))
        distance = dr.select(is_search, section, distance)
        side = dr.select((now.sides & 1) == 0, 0.5 * reach, -0.5 * reach)
        axis = (now.sides - 1) >> 1  # no axis if sides is 0: 0 - 1 is a large number
        offset = type(p)(*(dr.select(is_side & (axis == k), side, 0) for k in range(3)))
        q = dr.fma(type(p)(distance), direction, p) + offset
        # In coordinates in which q is rounded more coarsely than this, the box is q itself.
        half = type(p)(*(dr.select(shortest > epsilon * dr.abs(x), shortest, 0) for x in q))
        at_q = values_between(field, q - half, q + half)
        between = values_between(field, p, q)
        around_q = values_between(
            field, q - _CONTINUITY_FACTOR * half, q + _CONTINUITY_FACTOR * half
        )
        if at_q is None or between is None or around_q is None:
            with without_alternatives():
                low = high = field.evaluate(q).value
            passed = passes(levels, value, low, high, gaps)
        else:
            low, high = at_q.value.lower, at_q.value.upper
            passed = passes(levels, value, low, high, gaps)
            passed &= ~(between.jumps | between.gaps | between.nowhere)
            passed |= holds(levels, value, low, high, gaps) & ~(around_q.jumps | at_q.nowhere)
        nearest = dr.select(
            gaps.below < gaps.above, gaps.below + low - value, gaps.above + value - high
        )
        gap = dr.select(dr.isfinite(nearest), nearest, dr.inf)
        now = _narrowed(now, distance, gap, is_search & ~is_side)
        passed |= now.passed
        samples, sides = now.looks + 1, now.sides + dr.select(is_side, 1, 0)
        active = (
            now.active & ~passed & ((samples < _TRIAL_COUNT) | (searches & (sides < _SIDE_COUNT)))
        )
        return replace(now, looks=samples, sides=sides, passed=passed, active=active)

    begin = _SearchState(
        backend.UInt32(0), backend.UInt32(0), backend.Bool(False), backend.Bool(active),
        backend.Float(0), backend.Float(reach), backend.Float(0), backend.Float(gaps.nearest),
    )  # fmt: skip
    end = loop_while_active(begin, body, "harnack beyond")
    return end.passed, end.looks


def _narrowed(now: _SearchState, length: Real, gap: Real, is_search: Mask) -> _SearchState:
    """The state of the search after a sample at another length, with its gap to a level."""
    nearer, is_farther = gap <= now.least, length > now.inner
    end, is_low = dr.select(nearer, now.inner, length), nearer == is_farther
    return replace(
        now,
        low=dr.select(is_search & is_low, end, now.low),
        high=dr.select(is_search & ~is_low, end, now.high),
        inner=dr.select(is_search & nearer, length, now.inner),
        least=dr.select(is_search & nearer, gap, now.least),
    )


def down_or_up(gradient: Vec3, gaps: LevelGaps, otherwise: Vec3) -> Vec3:
    """The unit vector along which f goes to the nearer level; `otherwise` where the gradient has no
    direction."""
    direction = safe_normalize(gradient)
    direction = dr.select(gaps.below < gaps.above, -direction, direction)
    finite = dr.isfinite(direction.x + direction.y + direction.z)
    return dr.select(finite, direction, otherwise)
