"""The rules by which a point of a ray counts as a hit of the surface or as a crossing, and the ways
in which a ray can end. f is a function of space, and the surface consists of the points at which f
takes one of given values, the levels. f may jump at flat pieces of surface, called facets (such as
the triangles of a mesh); a facet belongs to the surface if a level lies between the values of f on
its two sides.

- First hits: a ray ends where f is within the `HitTolerance` of a level, or at a facet that belongs
  to the surface (`test_jump`).
- Crossings: a ray goes on, and f must pass to the other side of the level. A ray is in contact with
  a level from where it reaches it until f has left the tolerance around it. `Contact` is the state
  of a ray in contact, and `Hysteresis` is the rule by which each crossing is counted once.

A level that a ray has reached counts as lying a tolerance beyond its true place until f has left
the tolerance around it. All crossings of a ray are found in this way, and so are hits that require
a change of sign. Rays of this kind start a little outside the extent of the surface, as the surface
may touch the border of its extent.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.backend.loops import loop_while_active
from harnack.backend.validation import as_real
from harnack.enclosures import LevelGaps, Levels
from harnack.enclosures.samples import value_error_bound
from harnack.fields.capabilities import NO_FACET, JumpCrossing

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures.samples import Ray
    from harnack.fields.evaluator import Evaluator


class RayStatus(enum.IntEnum):
    """How a ray ended: without a hit, with a hit, or undecided."""

    MISS = 0
    """The ray is proved to meet no level between t_min and t_max."""
    HIT = 1
    """The ray is proved free up to t, where the surface is within tolerance."""
    OUT_OF_STEPS = 2
    """The ray is proved free up to t, and the rest of it is not known. Raise max_steps."""


@dataclass(frozen=True)
class HitTolerance:
    """How close to the surface a point of a ray must be to count as a hit. f is the function whose
    level is the surface, and t the ray parameter, a length.

    distance: a length. A point is a hit if |f - level| <= distance * |grad f|. To first order this
        is its distance from the surface (paper, Sec. 3.1.2); the exceptions are below.
    per_length: added to `distance` for each unit of t. With half the angle of a pixel, the
        tolerance grows with the size of the pixel on the surface.
    value: in units of f. A point is also a hit if |f - level| <= value, whatever the gradient.

    Steep functions. |grad f| may be unbounded, for example beside a vertical tangent or a pole of a
    formula (`Field.is_steep`). Then |f - level| / |grad f| is no distance. A point is a hit there
    only if f is proved to take the level within the tolerance, by its slope or by its values
    nearby, or up to the rounding of the point.

    Creases and spikes. At creases |grad f| jumps but is bounded. A crease at which f comes as near
    to the level as a hit must counts as a hit, even if f does not take the level. So do spikes and
    steps that are narrower than the tolerance, such as those of tanh(1e6 x) - y and of 0.5 +
    exp(-(1e5 x)^2). Some fields that are no formulas have poles, such as clouds of dipoles: rays
    that pass a pole within the tolerance count as hits of every level.

    Rounding. If rounding leaves the distance to the level uncertain by more than the tolerance,
    this uncertainty takes the place of the tolerance. It is about 1e-6 of the size of coordinates
    in single precision, and 1e-15 in double precision. It is far more where grad f is 0 on the
    surface, for example where two sheets of the surface meet (`Hits.uncertainty` tells how much).
    """

    distance: float = 1e-4
    per_length: float = 0.0
    value: float = 0.0

    def __post_init__(self) -> None:
        for name in ("distance", "per_length", "value"):
            number = as_real(getattr(self, name), f"tolerance: {name}")
            if not 0 <= number < math.inf:
                raise ValueError(f"tolerance: {name} must be finite and >= 0, not {number!r}")
        if self.distance == 0 and self.value == 0 and self.per_length == 0:
            raise ValueError("tolerance must be positive: a level set is never met exactly")

    def upload(self, backend: Backend) -> DeviceHitTolerance:
        """Return this tolerance as Dr.Jit numbers of a backend that kernels take as parameters. So
        another tolerance compiles no new kernel."""
        numbers = (self.distance, self.per_length, self.value)
        return DeviceHitTolerance(*(dr.opaque(backend.Float, number) for number in numbers))


@dataclass(frozen=True)
class DeviceHitTolerance:
    """A `HitTolerance` as Dr.Jit numbers that kernels take as parameters. f is the function whose
    level is the surface.

    distance: a length.
    per_length: added to `distance` for each unit of the ray parameter t.
    value: a difference of values of f.
    """

    distance: Real
    per_length: Real
    value: Real

    def value_tolerance(self, gradient_norm: Real, t: Real) -> Real:
        """Return the largest |f - level| at a hit at ray parameter t, where |grad f| =
        gradient_norm."""
        return fmax(gradient_norm * dr.fma(t, self.per_length, self.distance), self.value)


HIT_AT_JUMP = max(RayStatus) + 1
"""Status of a ray that hit a facet, until `JumpTracer` turns it into a plain HIT."""


@dataclass(frozen=True)
class JumpTest:
    """The comparison of a trial point of each ray with the facet at the end of the ray's interval.
    A facet is a flat piece of surface at which f jumps. The ray hits it if a level lies between the
    values of f on its two sides.

    has_crossing: whether the interval ends at a facet.
    at_crossing: whether the interval ends at a facet, and the trial point lies there and is
        accepted (no level lies before it on the ray).
    is_hit: whether, besides, a level lies between the values of f before and behind the facet, up
        to the error of f.
    gaps: the differences between f and the next levels below and above it. On lanes of
        `at_crossing`, f is taken behind the facet.
    normal: (3,) unit normal of the facet.
    """

    has_crossing: Mask
    at_crossing: Mask
    is_hit: Mask
    gaps: LevelGaps
    normal: Vec3

    def mark(self, status: Any, gradient: Vec3) -> tuple[Any, Vec3]:
        """Return `status` and `gradient`, replaced by HIT_AT_JUMP and the facet's normal on rays
        that hit the facet.

        status: the `RayStatus` of rays. gradient: (3,) the gradient of f.
        """
        marked = type(status)(dr.select(self.is_hit, HIT_AT_JUMP, status))
        return marked, dr.select(self.is_hit, self.normal, gradient)


def test_jump(
    ahead: JumpCrossing, there: Mask, value: Real, total_error: Real, levels: Levels
) -> JumpTest:
    """Compare f before and behind a facet with the levels. A facet is a flat piece of surface at
    which f jumps.

    ahead: the crossing of the facet at the end of the interval of the ray; its `facet` is NO_FACET
        if there is none.
    there: mask of rays whose trial point is accepted and lies at that crossing.
    value: f there, before the jump.
    total_error: a bound of the error of `value`.

    The facet belongs to the surface if a level lies between the values on its two sides. A level
    within `total_error` of either value counts as between them. Such a facet belongs to the
    surface, or would belong to it after a change of f by no more than rounding. The opposite choice
    could lose a surface: the march has proved that f does not take the level *before* the facet,
    and because of rounding the computed value may be on the other side of the level by as much as
    `total_error`. Facets at the same t count as one facet with the sum of their jumps
    (`JumpTracer._merge_coincident`).
    """
    has_crossing = ahead.facet != NO_FACET
    at_crossing = has_crossing & there
    behind = value + dr.select(at_crossing, ahead.jump, 0)
    low, high = fmin(value, behind) - total_error, fmax(value, behind) + total_error
    # The next level above the lower value is no farther than the higher value.
    is_hit = at_crossing & (levels.gaps(low).above <= high - low)
    return JumpTest(has_crossing, at_crossing, is_hit, levels.gaps(behind), ahead.normal)


# The band around a level is at least this many roundings of f, and at most this fraction of the
# difference between two levels, so that it is certain which level was reached.
_MIN_BAND_ROUNDINGS = 8.0
_MAX_BAND_OF_SPACING = 0.25
# In contact, f may come as near to the next level as this fraction of that difference.
_MAX_APPROACH = 0.5
# A crossing is complete where f is beyond the level by this fraction of the band. The rest is the
# gap that a ray in contact always has.
_CROSSED_FRACTION = 0.5
# In contact, trials aim at where f is beyond the level by this fraction of the band: there the
# crossing is complete, and it is clear on which side of the level f is.
CONTACT_AIM = 0.75
# In contact, truncation is judged by this fraction of the tolerance.
CONTACT_TOLERANCE = 0.5
# In contact, a step must not lead to where the band is less than the first number times the band
# before, unless the step is at most the second number times the tolerance long.
_MIN_BAND_RATIO, _SHORT_STEP = 0.25, 4.0
# The number of iterations of the search for the root of a cubic.
_ROOT_ITERATIONS = 4


@dataclass(frozen=True)
class Contact:
    """The contact of each ray with the level that it reached last. A ray is in contact from where f
    comes within the tolerance of a level until f has left the tolerance around it.

    side: on which side of the level the ray came: 1 if f was larger, -1 if smaller, 0 if all
        samples so far were at the level at which the ray started. While the ray is not in contact,
        only whether `side` is 0 has a meaning.
    is_touching: whether the ray is in contact, or may still be.
    root: the ray parameter at which f last took the level, between two samples on different sides
        of it. If there are no such samples since the contact began (the ray only grazes the level,
        or its first sample within the tolerance was on the far side already), the parameter at
        which the contact began.
    gradient: (3,) gradient of f at the root.
    tolerance_excess: by how much |f - level| at the root may exceed what the tolerance allows,
        because of rounding.
    before, after: the ray parameters of the two samples around the root; both are the root itself
        if it is the parameter at which the contact began.
    band: the tolerance in value around the level at the last sample, which f must leave to end the
        contact (`Hysteresis.band`).
    """

    side: Real
    is_touching: Mask
    root: Real
    gradient: Vec3
    tolerance_excess: Real
    before: Real
    after: Real
    band: Real

    @classmethod
    def none(cls, backend: Backend) -> Contact:
        """Return the contact of rays before their first sample: none."""
        zero = backend.Float(0)
        return cls(zero, backend.Bool(False), zero, backend.Array3f(0), zero, zero, zero, zero)


@dataclass(frozen=True)
class AcceptedPoint:
    """A sample of f at a point of each ray that the march has accepted, because no level lies
    before it on the ray.

    t, value, gradient: the ray parameter of the point, f, and its gradient (3,).
    slope: the derivative of f along the ray.
    before: (t, value, slope, gradient) of the accepted point before it.
    excess: by how much |f - level| at this point and the one before it may exceed what the
        tolerance allows, if the error of f is larger than the tolerance; else 0.
    total_error: a bound of the error of the value.
    is_near: whether f is so near to a level that a ray that looks for first hits would end there.
    band: the tolerance in value around a level (`Hysteresis.band`).
    is_end: whether the ray ends there.
    """

    t: Real
    value: Real
    gradient: Vec3
    slope: Real
    before: tuple[Real, Real, Real, Vec3]
    excess: Real
    total_error: Real
    is_near: Mask
    band: Real
    is_end: Mask


@dataclass(frozen=True)
class Hysteresis:
    """The rule by which the contact of a ray with a level begins, counts as a crossing, and ends. A
    ray is in contact with a level from where it reaches it until f has left the tolerance around
    it. During contact the level counts as lying a tolerance *beyond* its true place, as seen from
    the side from which the ray came: this is the moved level. The band is that tolerance in value.

    A ray that looks for first hits ends where f is within the tolerance of a level. A ray that goes
    on must leave the surface with a proof, and a crossing must not be counted several times because
    of rounding or because the ray runs along the surface. With the moved level, f always differs
    from it, and steps stay long.

    levels: all levels.
    spacing: the difference between the two closest levels; inf for a single level.
    is_free_before, is_free_after: whether the extent of the surface proves that the ray meets no
        level before the interval that is marched, and after it. Then f stays on one side of each
        level there. So at that end of the interval a difference between f and the level of more
        than its error is enough to tell the side.
    start: the ray parameter at which the interval begins.
    rounding: the distance from a facet, at which f jumps, by which rounding may move a ray that
        starts on it.

    Let W be the largest of the tolerances in value (`band`) at the samples of a contact. The
    guarantees are:

    1. *Nothing is missed.* If f is farther than W from a level on one side at some point of the
    ray, and on the other side at a later point, there is a crossing between the two points. Proof:
    consider a ray in contact that came from larger values of f. f is proved not to take the value
    `level - band` on it, by the same steps that prove that a ray without contact meets no level
    (`March.advance`); band is that of the last sample. So f > level - W as long as no crossing was
    noticed. Before the contact, f was proved not to take the level at all. Beside a pole the band
    grows with the slope of f, and may become larger than all later values of f. So the band of a
    sample counts up to the next sample only if the band there is not much smaller
    (`_MIN_BAND_RATIO`), or if the two samples are at most `_SHORT_STEP` tolerances apart
    (`may_reach`). A step that fails this test is made shorter, and so is a step to a sample without
    a finite error bound, for example where an exponential overflows.

    2. *Nothing is counted twice.* A crossing is noticed at a point where f is proved to be on the
    other side of the level: it differs from the level by `band/2`, which is more than its error.
    The next crossing is noticed only where f is proved to be on the first side again. So crossings
    of a level alternate in direction, and between two noticed crossings f takes the level. A ray
    that starts within the tolerance of a level is on neither side until a sample differs from the
    level by half the tolerance: leaving the level is no crossing.

    3. *Steps stay long.* In contact, f differs from the moved level by `band/2` or more, up to its
    error. So the difference that steps are solved for is at least a fifth of the band.

    Periodic f. Before contact, f lies between two neighboring periodic levels. In contact, f is
    proved to stay nearer to the level reached than to all others. Each of these two windows is less
    than a period wide, so the value modulo the period tells where in the window f is. (An enclosure
    that reaches back from a point assumes the window at that point. It shares a point with the
    interval proved before, so both are in the same window.)
    """

    levels: Levels
    spacing: Real
    is_free_before: Mask
    is_free_after: Mask
    start: Real
    rounding: Real

    @classmethod
    def of(
        cls,
        levels: Levels,
        free: tuple[Mask, Mask],
        start: Real,
        rounding: Real,
    ) -> Hysteresis:
        """Make the rule for given levels, and compute their spacing.

        free: the masks `is_free_before` and `is_free_after` of the class: whether no level lies on
            the ray before and after the interval that is marched.
        start: the ray parameter at which that interval begins.
        rounding: the distance from a facet by which rounding may move a ray that starts on it.
        """
        period = levels.period
        spacing: Real = dr.inf if period is None else period
        for k, level in enumerate(levels.values):
            for earlier in levels.values[:k]:
                gap = dr.abs(level - earlier)
                if period is not None:
                    # Reduce the difference modulo the period: to the distance of the nearest copies
                    # of the levels.
                    gap = gap - period * dr.floor(gap / period)
                    gap = fmin(gap, period - gap)
                # A level that is given twice has no spacing from itself.
                spacing = fmin(spacing, dr.select(gap > 0, gap, dr.inf))
        return cls(levels, spacing, *free, start, rounding)

    def contact_tolerance(self, within: Real) -> Real:
        """Return the contact tolerance: contact begins where |f - level| is less than this.

        within: the largest |f - level| at a hit. The result is `within`, or a quarter of the
            spacing of levels if that is less.
        """
        return fmin(within, _MAX_BAND_OF_SPACING * self.spacing)

    def band(self, within: Real, rounding: Real) -> Real:
        """Return the band: the tolerance in value around a level that f must leave to end the
        contact.

        within: the largest |f - level| at a hit. rounding: a bound of the rounding error of f.

        The band is the larger of `within` and 8 times `rounding`, but at most a quarter of the
        spacing of levels, so that it is certain which level was reached.
        """
        return fmin(
            fmax(within, _MIN_BAND_ROUNDINGS * rounding), _MAX_BAND_OF_SPACING * self.spacing
        )

    def may_reach(self, now: Contact, band: Real, step: Real, tolerance: Real) -> Mask:
        """Return the mask of rays that may take a step to a trial point. A ray in contact may if
        the band (tolerance in value) at the last sample is not much larger than that at the trial
        point, or if the step is short. A ray without contact always may.

        now: the contact at the last sample.
        band: the band at the trial point.
        step: the length of the step.
        tolerance: the hit tolerance at the trial point, a length.
        """
        comparable = now.band * _MIN_BAND_RATIO <= band
        return ~now.is_touching | comparable | (step <= _SHORT_STEP * tolerance)

    def must_sample_end(self, now: Contact, end: Real) -> Mask:
        """Return the mask of rays that must sample their end even if the march has proved the way
        to it. In contact, only the moved level is proved not to lie on this way; so the ray may
        still cross the true level.

        now: the contact of rays.
        end: the ray parameter at which they end.
        """
        return now.is_touching & (self.is_free_after | (end < dr.inf))

    def gaps(
        self, contact: Contact, value: Real, gaps: LevelGaps, band: Real, part: float = 1.0
    ) -> LevelGaps:
        """Return the differences between f and the next levels below and above it. For a ray in
        contact, the levels are moved, so that f differs from them.

        contact: which level each ray reached last, and from which side.
        value: f at the sample.
        gaps: the differences to the true levels; they are returned for rays without contact.
        band: the tolerance in value.
        part: a fraction: 1 for proofs, less for the places at which trial steps aim. The level that
            was reached counts as lying part * band beyond its true place. The next level on the
            side from which the ray came counts as lying at part * spacing / 2 from the level
            reached: half way or less. So steps prove that f stays nearer to the level reached than
            to any other level, as long as the contact lasts.
        """
        # f minus the level reached.
        offset, far_gap = -self.levels.offset_to_nearest(value), part * _MAX_APPROACH * self.spacing
        band = part * band
        # The moved levels are this far below and above the level reached. A ray that came from
        # below (side < 0) may go to the moved level above it, and back to the next level below.
        below = dr.select(contact.side < 0, far_gap, band)
        above = dr.select(contact.side > 0, far_gap, band)
        # f minus the moved level below it, and the moved level above it minus f; not negative.
        return LevelGaps(
            dr.select(contact.is_touching, fmax(below + offset, 0), gaps.below),
            dr.select(contact.is_touching, fmax(above - offset, 0), gaps.above),
        )

    def update(self, now: Contact, active: Mask, accepted: AcceptedPoint) -> tuple[Contact, Mask]:
        """Update the contact of each ray at an accepted point. Returns the new contact and the mask
        of rays that have crossed the level.

        now: the contact before.
        active: mask of rays that have an accepted point.
        accepted: that point.

        A crossing is counted where f is not on the side of the level from which the ray came, but
        on the other one, by more than half the band and more than the error of f. (At an end of the
        interval beyond which no level lies, more than the error is enough.) A contact begins at a
        point that is near enough for a hit, and ends where f is farther from the level than the
        band. Inactive rays keep their contact.
        """
        # f minus the nearest level: positive on the side of larger values. `side` is the side from
        # which the ray came: 1 for larger values, -1 for smaller ones, 0 if not known.
        offset = -self.levels.offset_to_nearest(accepted.value)
        was_touching = now.is_touching
        side = dr.select(was_touching, now.side, self._side(now, accepted, offset))

        # The root, if f has changed sides since the last point.
        t, value, slope, gradient = accepted.before
        offset_before = -self.levels.offset_to_nearest(value)
        changes_side = active & was_touching & (side * offset_before > 0) & (side * offset <= 0)
        # The part of the way between the two points; slopes are those by this part.
        fraction = cubic_root(
            offset_before, offset, (accepted.t - t) * slope, (accepted.t - t) * accepted.slope
        )
        begins = active & ~was_touching & accepted.is_near
        root = dr.select(
            changes_side, t + fraction * (accepted.t - t), dr.select(begins, accepted.t, now.root)
        )
        at_root = dr.select(begins, accepted.gradient, now.gradient)
        at_root = dr.select(changes_side, dr.lerp(gradient, accepted.gradient, fraction), at_root)
        excess = dr.select(changes_side | begins, accepted.excess, now.tolerance_excess)
        before = dr.select(changes_side, t, dr.select(begins, accepted.t, now.before))
        after = dr.select(changes_side | begins, accepted.t, now.after)

        # Is f far enough beyond the level to have crossed it, or has it left the band? At the
        # first sample of a ray that starts on a level, no side is known yet.
        is_first = (now.side == 0) & ~was_touching
        # Beyond a free end of the interval f meets no level, so it stays on its side. There f need
        # differ from the level by no more than its error.
        stays_on_side = (is_first & self.is_free_before) | (accepted.is_end & self.is_free_after)
        least_offset = dr.select(stays_on_side, 0, _CROSSED_FRACTION * accepted.band)
        is_off = dr.abs(offset) > fmax(least_offset, accepted.total_error)
        crosses = active & was_touching & is_off & (side * offset < 0)
        # A ray that started at the level is now on a side, without a crossing.
        settles = active & is_off & (side == 0)
        side = dr.select(settles | crosses, dr.select(offset > 0, type(offset)(1), -1), side)
        is_touching = dr.select(was_touching, dr.abs(offset) <= accepted.band, accepted.is_near)
        # In the order: side, is_touching, root, gradient, tolerance_excess, before, after, band.
        return Contact(
            dr.select(active, side, now.side),
            dr.select(active, is_touching, was_touching),
            root,
            at_root,
            excess,
            before,
            after,
            dr.select(active, accepted.band, now.band),
        ), crosses

    def update_at_jump(
        self, now: Contact, active: Mask, accepted: AcceptedPoint, ahead: JumpCrossing, d: Vec3
    ) -> tuple[Contact, Mask]:
        """Update the contact of each ray at a facet, where f jumps. Returns the contact behind the
        facet and the mask of rays that cross the level by this jump.

        now, accepted: the contact and the sample at an accepted point just before the facet.
        active: mask of rays that pass a facet.
        ahead: the crossing of the facet.
        d: (3,) unit direction of the ray.

        A function with jumps has a single level where crossings are counted. A ray that starts on a
        facet, up to rounding, is on neither side of the level.
        """
        # f minus the level, before the facet and (below) behind it. `side` is the side from which
        # the ray came: 1 for larger f, -1 for smaller f, 0 if not known.
        offset = -self.levels.offset_to_nearest(accepted.value)
        one = type(offset)(1)
        side = dr.select(now.is_touching, now.side, dr.select(offset > 0, one, -1))
        # The distance of the start from the facet's plane.
        starts_on_facet = (
            dr.abs(dr.dot(ahead.normal, d)) * (accepted.t - self.start) <= self.rounding
        )
        side = dr.select(starts_on_facet, 0, side)
        offset_behind = offset + ahead.jump
        # The jump changes sides, brings f near the level, or is far enough beyond it to count.
        changes_side = active & (side * offset > 0) & (side * offset_behind <= 0)
        begins = active & ~now.is_touching & (dr.abs(offset_behind) <= accepted.band)
        is_off = dr.abs(offset_behind) > fmax(
            _CROSSED_FRACTION * accepted.band, accepted.total_error
        )
        crosses = active & is_off & (side * offset_behind < 0)
        side = dr.select(is_off, dr.select(offset_behind > 0, one, -1), side)
        at_facet = changes_side | begins
        # In the order: side, is_touching, root, gradient, tolerance_excess, before, after, band.
        # At a facet the root is exact, so there is no excess, and the facet's normal stands for the
        # gradient.
        return Contact(
            dr.select(active, side, now.side),
            dr.select(active, dr.abs(offset_behind) <= accepted.band, now.is_touching),
            dr.select(at_facet, accepted.t, now.root),
            dr.select(at_facet, ahead.normal, now.gradient),
            dr.select(at_facet, 0, now.tolerance_excess),
            dr.select(at_facet, accepted.t, now.before),
            dr.select(at_facet, accepted.t, now.after),
            dr.select(active, accepted.band, now.band),
        ), crosses

    def _side(self, now: Contact, point: AcceptedPoint, offset: Real) -> Real:
        """Return from which side a ray without contact comes to the nearest level: 1 if f is larger
        there, -1 if it is smaller, 0 if the side is not known.

        now: the contact before the point.
        offset: f at the point minus the level.

        The ray met no level before, so a real-valued f is on the side of the last accepted value.
        If f is periodic, the last value may lie on either side of the level. Then the present value
        decides, or the slope of f if the present value equals the level up to its error. The side
        is not known while all samples of the ray were near a level.
        """
        if self.levels.period is None:
            # The last accepted value, compared with the level.
            is_above = point.before[1] > point.value - offset
        else:
            # If f equals the level up to its error and falls, it came from larger values.
            is_above = dr.select(dr.abs(offset) > point.total_error, offset > 0, point.slope < 0)
        # 0 stays only for a ray of which every sample so far was near a level.
        is_known = (now.side != 0) | ~point.is_near
        return dr.select(is_known, dr.select(is_above, type(offset)(1), -1), 0)


@dataclass(frozen=True)
class _Bisection:
    """The state of bisection on each ray, which narrows the interval in which f takes the level.

    before, behind: the ends of the interval, as ray parameters; f is on different sides of the
        level there.
    t: the next point to sample. gradient: (3,) the gradient of f at the last one.
    sample_count: the number of samples so far.
    active: whether bisection goes on.
    """

    before: Real
    behind: Real
    t: Real
    gradient: Vec3
    sample_count: Any
    active: Mask


def refine_crossing(
    evaluator: Evaluator, levels: Levels, tolerance: DeviceHitTolerance, path: Ray,
    contact: Contact, active: Mask,
) -> tuple[Real, Vec3, Any]:  # fmt: skip
    """Find where rays cross the level more exactly, by bisection where needed.

    Returns the roots (ray parameters), the gradients (3,) of f there, and the number of
    evaluations.

    contact: the crossings. Each has two points on different sides of the level, and a first
        approximation of the root: the root of the cubic through the values and slopes of f at these
        points.
    active: mask of rays with a crossing.

    The cubic is a bad approximation of f if f has a crease between the two points. So f is
    evaluated at the root of the cubic. If it differs from the level there by more than the
    tolerance and its error, bisection narrows the interval between the two points. It ends at a
    point within the tolerance, or where the interval is as short as rounding.
    """
    # 1 if f is larger than the level before the crossing. (Contact has the side after it.)
    side = -contact.side
    count = dr.uint32_array_t(type(contact.root))
    # Intervals are halved down to this fraction of the size of coordinates: a few roundings.
    smallest = 4 * float(dr.epsilon(type(contact.root)))

    def bisect(now: _Bisection) -> _Bisection:
        """Sample f at the point t, and keep the half of the interval in which f takes the level.
        Returns the new state."""
        sample, size = evaluator.evaluate(path.point(now.t)), max_norm(path.origin) + now.t
        offset, steepness = -levels.offset_to_nearest(sample.value), safe_norm(sample.gradient)
        is_near = dr.abs(offset) <= fmax(
            tolerance.value_tolerance(steepness, now.t), value_error_bound(sample, steepness, size)
        )
        # The half in which f changes sides. (`side` is 1 if f is larger before the crossing, else
        # -1.)
        is_before = side * offset > 0
        before = dr.select(is_before, now.t, now.before)
        behind = dr.select(is_before, now.behind, now.t)
        # The interval may become as short as rounding.
        goes_on = ~is_near & (behind - before > smallest * size)
        # If the cubic's root is good, its gradient stays.
        is_good_root = is_near & (now.sample_count == 0)
        return _Bisection(
            before,
            behind,
            dr.select(goes_on, 0.5 * (before + behind), now.t),
            dr.select(is_good_root, now.gradient, sample.gradient),
            now.sample_count + 1,
            now.active & goes_on,
        )

    begin = _Bisection(
        contact.before, contact.after, contact.root, contact.gradient, count(0), active
    )
    end = loop_while_active(begin, bisect, "harnack roots")
    return end.t, end.gradient, end.sample_count


def cubic_root(start: Real, end: Real, slope: Real, end_slope: Real) -> Any:
    """Return a root in [0, 1] of a cubic that changes sign between 0 and 1.

    start, end: the values of the cubic at 0 and 1, of different signs.
    slope, end_slope: its derivatives at 0 and 1.

    Four steps of Newton's method, from the root of the chord. Where a step leaves the interval in
    which the sign changes, this interval is halved instead.
    """
    # The cubic is start + slope u + b u^2 + c u^3.
    b = 3 * (end - start) - 2 * slope - end_slope
    c = slope + end_slope - 2 * (end - start)
    low, high = type(start)(0), type(start)(1)
    # Start at the root of the chord.
    u = start / (start - end)
    for _ in range(_ROOT_ITERATIONS):
        value = dr.fma(dr.fma(dr.fma(c, u, b), u, slope), u, start)
        rate = dr.fma(dr.fma(3 * c, u, 2 * b), u, slope)
        # Keep the part in which the sign changes.
        is_before_root = (value > 0) == (start > 0)
        low, high = dr.select(is_before_root, u, low), dr.select(is_before_root, high, u)
        next_u = u - value / rate
        is_inside = (next_u >= low) & (next_u <= high)
        u = dr.select(is_inside, next_u, 0.5 * (low + high))
    return dr.clip(u, 0, 1)
