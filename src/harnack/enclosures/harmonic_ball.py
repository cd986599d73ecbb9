"""Enclosures of a function f that is harmonic and bounded on a ball B(p, R) about a point p of a
ray. They prove a length of the ray on which f takes no level (a value that rays look for). The gap
to a level is its difference from f(p); q is a length as a fraction of the radius R.

- `HarnackEnclosure`: the published rule, Harnack's inequality from a lower bound alone.
- `HarnackSlopeEnclosure`: Harnack's inequality that also uses the directional derivative.
- `SphericalCapEnclosure`: the bound by spherical caps. If both a lower and an upper bound are
  known, it is the sharpest of the three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.enclosures.enclosure import STEP_SAFETY
from harnack.enclosures.free_radius import (
    FreeRadiusCondition,
    HarmonicBallEnclosure,
    condition_rounding,
    is_free_fraction,
    largest_free_fraction,
)

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import LevelGaps


@dataclass(frozen=True)
class HarnackEnclosure(HarmonicBallEnclosure):
    """Harnack's inequality for a harmonic u = f - lower > 0 on the ball B(p, R), where `lower` is a
    bound of f; it is the same in every direction. It bounds f at the fraction q of the radius from
    p, and so proves a length on which f reaches no level.

    Proof. u is a Poisson integral of a positive measure of mass u(p). Let n be the dimension, q =
    |y-p|/R, and s the cosine of the angle between y - p and a boundary point. The kernel P(q, s) =
    (1-q^2)/(1+q^2-2qs)^(n/2) lies between its values at s = -1 and s = 1, so

        u(p) (1-q)/(1+q)^(n-1) <= u(y) <= u(p) (1+q)/(1-q)^(n-1).

    The free length is q R for the q at which one of the two bounds first reaches a level. With u =
    f - lower and v = level - lower the root is, in forms that do not cancel near v = u (the printed
    Eq. 7 cancels: in float32 its step is 20 % too long at |v/u - 1| = 1e-6),

        n = 2:  |v-u| / (u+v)         n = 3:  2 |v-u| / (u + 2v + sqrt(u (u + 8v)))

    and for n = 4 the cubic is solved by Newton's method from the safe side (`_fraction_4d_up`). A
    level at or below `lower` cannot be reached inside the ball: the step is R. The slope is not
    used.

    Source: Gillespie, Yang, Botsch, Crane 2024, Eq. 4-7 (n = 3) and Eq. 27 (n = 4).
    """

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the length on which Harnack's inequality proves that f takes no level. gaps: the
        differences between f(p) and the next levels."""
        return dr.select(self.is_valid(gaps), self.radius * self._fraction(gaps), 0)

    def _fraction(self, gaps: LevelGaps) -> Real:
        """Return the free length divided by the radius. If f is bounded on both sides, each bound
        proves a fraction, and the larger one is returned. gaps: the differences between f(p) and
        the next levels."""
        # The fractions that the lower and the upper bound of f prove.
        by_lower = by_upper = None
        # For u = f - lower, "away from 0" is above.
        if self.max_fall is not None:
            by_lower = _fraction_from_one_side(
                self.max_fall, gaps.above, gaps.below, self.dimension
            )
        if self.max_rise is not None:  # the same for upper - f, positive and harmonic
            by_upper = _fraction_from_one_side(
                self.max_rise, gaps.below, gaps.above, self.dimension
            )
        if by_lower is None or by_upper is None:
            fraction = by_lower if by_upper is None else by_upper
            assert fraction is not None
            return fraction
        return fmax(by_lower, by_upper)


def _fraction_from_one_side(u: Real, gap_away: Real, gap_toward: Real, dimension: int) -> Real:
    """Return a fraction of the ball's radius on which Harnack's inequality proves that a positive
    harmonic function u reaches no level.

    u: its value at the center.
    gap_away, gap_toward: the differences from u to the next level above, which is away from 0, and
        to the next level below, toward 0.
    dimension: the dimension of the ball; 2, 3 or 4.
    """
    growing, falling = _FRACTION_FORMULAS[dimension]
    # u = 0 forces u to vanish identically: no level is ever reached. Levels below 0 never are.
    up = dr.select((gap_away == dr.inf) | (u <= 0), 1, growing(u, u + gap_away, gap_away))
    v = u - gap_toward
    down = dr.select((v <= 0) | (gap_toward == dr.inf), 1, falling(u, fmax(v, 0), gap_toward))
    return clamp(fmin(up, down), 0, 1) * STEP_SAFETY


def _fraction_2d(u: Real, v: Real, gap: Real) -> Real:
    """Return the fraction q of the radius at which a positive harmonic function may first reach a
    level, above or below, in the plane.

    u, v: the function at the center, and the level.
    gap: |v - u|.
    """
    return gap / (u + v)


def _fraction_3d(u: Real, v: Real, gap: Real) -> Real:
    """Return the fraction q of the radius at which a positive harmonic function may first reach a
    level, above or below, in space.

    u, v: the function at the center, and the level.
    gap: |v - u|.
    """
    # Two square roots, as the product u (u + 8v) may underflow or overflow.
    return 2 * gap / (u + 2 * v + dr.sqrt(u) * dr.sqrt(u + 8 * v))


def _fraction_4d_up(u: Real, v: Real, gap: Real) -> Real:
    """Return the fraction q of the radius at which a positive harmonic function may first reach a
    level v > u in R^4, or slightly less.

    u, v: the function at the center, and the level.
    gap: v - u.

    q solves (1+q)/(1-q)^3 = w with w = v/u. Newton's method approaches it from the safe side, in
    one of two forms. For w < 2 it comes from the left, with h(q) = gap - q (u + v (3 - 3q + q^2)),
    which decreases and is convex. This form cancels for large w. For these, y = 1-q is the root of
    the convex function w y^3 + y - 2, and is approached from the right.
    """
    q = gap / (u + 3 * v)  # Newton's first step, from q = 0
    for _ in range(4):
        h = gap - q * (u + v * (3 - 3 * q + q * q))
        q = q + fmax(h, 0) / (u + 3 * v * (1 - q) * (1 - q))
    w = v / u
    y = fmin(dr.cbrt(2 / w), 1)
    for _ in range(4):
        y = y - (y * dr.fma(w * y, y, 1) - 2) / dr.fma(3 * w * y, y, 1)
    # 1 - y, rounded down.
    return dr.select(v < 2 * u, q, dr.fma(y, -1 - 1e-6, 1))


def _fraction_4d_down(u: Real, v: Real, gap: Real) -> Real:
    """Return the fraction q of the radius at which a positive harmonic function may first reach a
    level v < u in R^4, or slightly less.

    u, v: the function at the center, and the level.
    gap: u - v.

    q solves (1-q)/(1+q)^3 = v/u, and is the root of h(q) = gap - q (u + v (3 + 3q + q^2)), which
    decreases and is concave. So Newton's method ends on the right of the root. The chord from (0,
    gap) to this point meets 0 on the left of the root, which is the safe side.
    """
    q = fmin(gap / (u + 3 * v), 1)  # Newton's first step, from q = 0
    for _ in range(4):
        h = gap - q * (u + v * (3 + 3 * q + q * q))
        q = q + fmin(h, 0) / (u + 3 * v * (1 + q) * (1 + q))
    # h at the end of the iteration, and the zero of the chord.
    h = fmin(gap - q * (u + v * (3 + 3 * q + q * q)), 0)
    return q * gap / (gap - h)


# For each dimension the formula for levels above, and that for levels below.
_FRACTION_FORMULAS = {
    2: (_fraction_2d, _fraction_2d),
    3: (_fraction_3d, _fraction_3d),
    4: (_fraction_4d_up, _fraction_4d_down),
}


# Gaps above this multiple of u count as this multiple, which is reached only within 1e-6 of the
# sphere.
_UNREACHABLE_GAP = 1e18


@dataclass(frozen=True)
class HarnackSlopeEnclosure(HarmonicBallEnclosure):
    """Harnack's inequality with the directional derivative, for a function f that is harmonic on a
    ball B(p, R) of R^n, n = 2, 3 or 4, and bounded on one side or on both. It bounds f along a ray
    from p, at the fraction q of the radius.

    Proof. Let u be positive and harmonic on B(p, R) of R^n, v a unit direction and q = t/R. Then
    u(p+tv) is the integral of P(q, s) dnu(s) over s in [-1, 1], where P(q, s) =
    (1-q^2)/(1+q^2-2qs)^(n/2) and the measure nu >= 0 has the mass u(p) and the first moment R
    u_v(p)/n (differentiate at q = 0: dP/dq = n s). So the mean of s is m = R u_v/(n u). P is convex
    in s, hence

        u P(q, m) <= u(p+tv) <= u [(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1)]

    (Jensen's inequality; the chord). Both bounds are attained, by a ring of mass at one latitude
    and by two point masses at the poles. The upper bound is convex in q. The lower bound rises,
    then falls: its derivative has the sign of m q^2 - 2q + m (n = 2), q^3 + m q^2 - 5q + 3m (n = 3)
    or q^3 - 3q + 2m (n = 4), and each of these decreases on [0, 1]. So the upper bound crosses a
    level at most once upwards, and the lower bound at most once downwards; if q is free of levels,
    all smaller q are. If f is bounded above, the same holds for u = upper - f > 0 with the negated
    slope. On each side the better of the two bounds is used.

    Both bounds increase with the slope, or stay: the upper one because it grows with m, as P(q, 1)
    >= P(q, -1); the lower one because P(q, .) increases. For u = upper - f the slope is negated,
    and so are the bounds, which change places.
    """

    solver_iterations: ClassVar[int] = 4
    """Rounds of `largest_free_fraction`."""

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shorter of the lengths proved for the level above and for the level below. For
        each level this is the longest length that one of its conditions proves. gaps: the
        differences between f(p) and these levels."""
        q = type(gaps.above)(1)
        for alternatives in self._conditions(gaps):
            best = type(q)(0)
            for condition in alternatives:
                best = fmax(best, largest_free_fraction(condition, self.solver_iterations))
            q = fmin(q, best)
        return dr.select(self.is_valid(gaps), q * self.radius, 0)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which, for each of the levels above and below, at least one
        condition proves that f does not reach it on the length `length`. gaps: the differences
        between f(p) and these levels."""
        q = length / self.radius
        is_covered = q <= 1
        q = clamp(q, 0, 1)
        for alternatives in self._conditions(gaps):
            side_free = None
            for condition in alternatives:
                proved = is_free_fraction(condition, q)
                side_free = proved if side_free is None else side_free | proved
            is_covered = is_covered & side_free
        return (length <= 0) | (is_covered & self.is_valid(gaps))

    def _conditions(
        self, gaps: LevelGaps
    ) -> tuple[list[FreeRadiusCondition], list[FreeRadiusCondition]]:
        """Return the conditions for f not to reach the level above, and the conditions for f not to
        reach the level below, as two lists. For each level it is enough that one of its conditions
        holds.

        gaps: the differences between f(p) and these levels.

        The bound f >= lower gives, with u = f - lower, a chord condition for the level above and a
        Jensen condition for the level below. The bound f <= upper gives, with u = upper - f, the
        two with the levels exchanged.
        """
        up: list[FreeRadiusCondition] = []
        down: list[FreeRadiusCondition] = []
        rising = self.slopes
        for u, slopes, gap_away, conditions_away, gap_toward, conditions_toward in (
            (self.max_fall, rising, gaps.above, up, gaps.below, down),  # u = f - lower
            (self.max_rise, rising.negated(), gaps.below, down, gaps.above, up),  # u = upper - f
        ):
            if u is None:
                continue
            # u = 0 forces u to vanish identically: no level is ever reached.
            inverse_u = dr.select(u > 0, 1 / u, dr.inf)
            scale = self.radius * inverse_u / self.dimension
            # m = R f_v/(n u), the mean of the cosine s over the mass on the sphere whose Poisson
            # integral is u, at the largest and at the smallest slope f_v.
            mean_upper = dr.select(u > 0, slopes.upper * scale, 0)
            mean_lower = dr.select(u > 0, slopes.lower * scale, 0)
            slack = condition_rounding(type(gaps.above))
            # NaN for a slope counts as the worst one, on both sides. (Below, a gap toward 0 counts
            # as at most u, since u stays positive.)
            m_max, m_min = fmax(fmin(mean_upper + slack, 1), -1), clamp(mean_lower - slack, -1, 1)
            conditions_away.append(
                _ChordCondition.of(
                    fmin(gap_away * inverse_u, _UNREACHABLE_GAP), m_max, self.dimension
                )
            )
            conditions_toward.append(
                _JensenCondition(fmin(gap_toward * inverse_u, 1), m_min, self.dimension)
            )
        return up, down


@dataclass(frozen=True)
class _ChordCondition:
    """The condition that a positive harmonic u, bounded by the chord of Poisson's kernel, does not
    reach the level above on a fraction q of the radius.

    With Poisson's kernel P and the other symbols of `HarnackSlopeEnclosure` it is (1+m)/2 P(q,1) +
    (1-m)/2 P(q,-1) <= w with w = 1 + (gap of u)/u, where the gap is the difference between the
    level and u at the center. The left side times (1-q)^K, K = n-1, is B = (1-q)^K + q A/(1+q)^K
    with a polynomial A. So the condition is B^(1/K) <= w^(1/K) (1-q), which has no pole. This is q
    k(q) <= g with g = w^(1/K) - 1 and k = g + 1 + (B^(1/K) - 1)/q.

    gap: g.
    mean: m, the mean of the cosine s.
    dimension: n, that of the ball.
    """

    gap: Real
    mean: Real
    dimension: int

    @classmethod
    def of(cls, gap: Real, mean: Real, dimension: int) -> _ChordCondition:
        """Make the condition.

        gap: the gap divided by u at the center, which is w - 1.
        mean, dimension: m and n.
        """
        # g = w^(1/K) - 1 with K = n - 1, in forms that do not cancel for small gaps.
        if dimension == 3:
            gap = gap / (dr.sqrt(1 + gap) + 1)
        elif dimension == 4:
            root = dr.cbrt(1 + gap)
            gap = gap / dr.fma(root, root + 1, 1)
        return cls(gap, mean, dimension)

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """Return k(0) and k'(0), of the Taylor series of k. No proof relies on them."""
        n, k = self.dimension, self.dimension - 1
        first = n * self.mean - k
        second = n * (1 - self.mean) - 0.5 * (k - 1) / (k * k) * first * first
        return self.gap + n * self.mean / k, second

    def __call__(self, q: Real) -> Real:
        """Return k(q) = g + 1 + (B^(1/K) - 1)/q, in a form that does not cancel near q = 0. The
        condition is q k(q) <= g, where g is `gap`. B is the chord of Poisson's kernel, at the mean
        m, times (1-q)^K; K is n - 1. In the code (B - 1)/q is c - K, and root is B^(1/K); so (root
        - 1)/q follows from c without a difference of large numbers."""
        m, r, s = self.mean, 1 / (1 + q), q * q
        if self.dimension == 2:
            return self.gap + 2 * (q + m) * r
        if self.dimension == 3:
            c = dr.fma(q * (5 - s) + m * (3 + s), r * r, q)  # (B - 1)/q + 2
            root = dr.sqrt(fmax(dr.fma(q, c - 2, 1), 0))
            inverse = 1 / (root + 1)
            # By root - 1 = q (c - 2)/(root + 1).
            return self.gap + inverse * (c + q * (c - 2) * inverse)
        a = q * (9 + s * (s - 2)) + 4 * m * (1 + s)
        c = dr.fma(a, r * r * r, q * (3 - q))  # (B - 1)/q + 3
        root = dr.cbrt(fmax(dr.fma(q, c - 3, 1), 0))
        inverse = 1 / dr.fma(root, root + 1, 1)
        # By root - 1 = q (c - 3)/(root^2 + root + 1).
        return self.gap + inverse * (c + q * (c - 3) * inverse * (root + 2))


@dataclass(frozen=True)
class _JensenCondition:
    """The condition that a positive harmonic u, bounded by Jensen's inequality, does not reach the
    level below on a fraction q of the radius.

    With Poisson's kernel P and the other symbols of `HarnackSlopeEnclosure` it is P(q, m) >= 1 - g
    with g = (gap of u)/u, where the gap is the difference between u at the center and the level.
    With D = 1+q^2-2qm this is (1-g) D^(n/2) <= 1-q^2, that is, q k(q) <= g with k = (1-g) (D^(n/2)
    - 1 + q^2)/q + g q. The product q k(q) is convex.

    gap: g.
    mean: m, the mean of the cosine s.
    dimension: n, that of the ball.
    """

    gap: Real
    mean: Real
    dimension: int

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """Return k(0) and k'(0), of the Taylor series of k. No proof relies on them."""
        n, m, weight = self.dimension, self.mean, 1 - self.gap
        second = 1 + 0.5 * n * (1 + (n - 2) * m * m)
        return -weight * n * m, dr.fma(weight, second, self.gap)

    def __call__(self, q: Real) -> Real:
        """Return k(q) = (1-g) (D^(n/2) - 1 + q^2)/q + g q with D = 1 + q^2 - 2 q m, in a form that
        does not cancel near q = 0. The condition is q k(q) <= g, where g is `gap`. In the code d is
        D, e is (D - 1)/q, x is the root of D, and `rise` is (D^(n/2) - 1 + q^2)/q."""
        e = q - 2 * self.mean
        d = dr.fma(q, e, 1)
        # (D^(n/2) - 1)/q is e, e (D + x + 1)/(x + 1) and e (D + 1) for n = 2, 3 and 4.
        if self.dimension == 2:
            rise = q + e
        elif self.dimension == 4:
            rise = dr.fma(e, d + 1, q)
        else:
            x = dr.sqrt(fmax(d, 0))
            rise = q + e * (d + x + 1) / (x + 1)
        return dr.fma(1 - self.gap, rise, self.gap * q)


@dataclass(frozen=True)
class SphericalCapEnclosure(HarmonicBallEnclosure):
    """The bound by spherical caps, for a function f that is harmonic on a ball B(p, R) of space and
    has values between c and C. It bounds f along a ray from p, at the fraction q of the radius.

    Proof. f = c + (C-c) g, where g is the Poisson integral of boundary values in [0, 1]. Their mean
    is p = (f-c)/(C-c) with f at the center, and their first moment along the direction v of the ray
    is mu = R f_v/(3 (C-c)), where f_v is the derivative of f along v. Let s be the cosine of the
    angle between v and a boundary point. For fixed q the kernel P(q, s) is convex in s. So among
    densities in [0, 1] with this mass and first moment, the integral of P times the density is
    largest for the indicator of the two ends {s <= a-1} and {s >= 1-b}, because P minus its chord
    through a-1 and 1-b is positive exactly there (bathtub principle). These are two spherical caps
    about v and -v of heights b = p + mu/(1-p) and a = p - mu/(1-p), which depend on p and mu alone.
    The integral over the caps is elementary. Let s1 and s2 be the distances, divided by R, from the
    point at the fraction q to the edges of the caps about v and about -v. So f is at most

        U = c + (C-c) [1 - (1-q^2)/(2q) (1/s1 - 1/s2)],
        s1^2 = (1-q)^2 + 2qb,   s2^2 = (1+q)^2 - 2qa,

    and as s2^2 - s1^2 = 4q (1-p), U <= f + gap is the same as

        (1 - gap/(C-f)) s1 s2 (s1+s2)/2 <= 1-q^2.

    A lower bound follows from the upper bound for C + c - f: p becomes 1-p and mu becomes -mu. |mu|
    <= p (1-p) holds in exact arithmetic and is enforced.

    Both bounds increase with the slope, or stay. As the slope grows, weight moves from s = a-1 to s
    = 1-b, which is no smaller since a + b = 2p <= 2, and P(q, .) increases. For the lower bound the
    same argument holds for C + c - f.

    The first crossing of a level is unique. With X = (1+q^2)/(2q), (X-s)^(-3/2) is a Laplace
    transform of exp(-tX) exp(ts), hence totally positive in (q, s) on (0, 1) x (-1, 1) (Karlin
    1968), hence variation diminishing. U - level is the transform of boundary values with signs (+,
    -, +). So its signs change at most in this order, and if it starts negative, they change once.
    """

    solver_iterations: ClassVar[int] = 4
    """Rounds of `largest_free_fraction`."""

    @classmethod
    def applies_to(cls, dimension: int, is_bounded_below: bool, is_bounded_above: bool) -> bool:
        """Return whether this class has a proof for balls of this dimension: it has one for
        dimension 3, if f is bounded on both sides.

        is_bounded_below, is_bounded_above: whether f has a lower bound, and an upper bound, on the
            ball.
        """
        return dimension == 3 and is_bounded_below and is_bounded_above

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shorter of the lengths on which f is proved not to reach the level above and
        the level below. gaps: the differences between f(p) and these levels."""
        up, down = self._conditions(gaps)
        q = fmin(
            largest_free_fraction(up, self.solver_iterations),
            largest_free_fraction(down, self.solver_iterations),
        )
        return dr.select(self.is_valid(gaps), q * self.radius, 0)

    def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to reach neither the level above nor the
        level below on the length. gaps: the differences between f(p) and these levels."""
        up, down = self._conditions(gaps)
        q = length / self.radius
        is_inside = (q <= 1) & self.is_valid(gaps)
        q = clamp(q, 0, 1)
        return (length <= 0) | (is_inside & is_free_fraction(up, q) & is_free_fraction(down, q))

    def _conditions(self, gaps: LevelGaps) -> tuple[_CapCondition, _CapCondition]:
        """Return two conditions on a fraction of the radius: for f not to reach the level above on
        it, and for f not to reach the level below.

        gaps: the differences between f(p) and these levels.
        """
        fall, rise = self.max_fall, self.max_rise
        assert fall is not None
        assert rise is not None
        inverse = 1 / (fall + rise)
        # p is where f at the center lies in its range, from 0 at c to 1 at C.
        p, rest = fall * inverse, rise * inverse
        # Times the slope, this is mu; the second condition is that for C - f, whose slope is
        # negated.
        moment_per_slope = self.radius * inverse / 3
        rising, falling = (
            moment_per_slope * self.slopes.upper,
            -moment_per_slope * self.slopes.lower,
        )
        return (
            _two_caps(gaps.above, rise, p, rest, rising),
            _two_caps(gaps.below, fall, rest, p, falling),
        )


def _two_caps(gap: Real, max_rise: Real, p: Real, rest: Real, mu: Real) -> _CapCondition:
    """Return the condition for f not to reach the level above, with the symbols of
    `SphericalCapEnclosure`.

    gap: the difference between f and that level.
    max_rise: C - f at the center.
    p, rest: p = (f - c)/(C - c), with f at the center, and 1 - p.
    mu: the largest first moment that the range of slopes allows: R f_v/(3 (C - c)) for the largest
        slope f_v.

    If c = C, f is constant and no level is ever reached. A level beyond C is not reached, either.
    """
    slack = condition_rounding(type(gap)) * p
    cap_shift = dr.select(rest > 0, mu / rest, 0) + slack
    cap_shift = fmax(fmin(cap_shift, p), -p)  # the worst one, p, if the slope is not a number
    return _CapCondition(dr.select(gap < max_rise, gap / max_rise, 1), p, rest, cap_shift)


@dataclass(frozen=True)
class _CapCondition:
    """The condition (1-g) S(q) <= 1-q^2 with S = s1 s2 (s1+s2)/2, on a fraction q of the radius,
    for f not to reach the level above. Here s1^2 = (1-q)^2 + 2qb and s2^2 = (1+q)^2 - 2qa, with the
    heights b = p + shift and a = p - shift of two spherical caps (`SphericalCapEnclosure`).

    That is q k(q) <= g with k = (1-g) (S - 1 + q^2)/q + g q.

    gap: g = gap/(C-f), where the gap is the difference between the level and f at the center, and C
        the upper bound of f on the ball.
    p: the mean of the boundary values, which are scaled to [0, 1].
    rest: 1 - p, accurate where it is small.
    shift: mu/(1-p), where mu is the first moment of the boundary values along the ray.
    """

    gap: Real
    p: Real
    rest: Real
    shift: Real

    def expansion_at_zero(self) -> tuple[Real, Real]:
        """Return k(0) and k'(0), of the Taylor series of k. No proof relies on them."""
        x, y, weight = self.rest - self.shift, self.rest + self.shift, 1 - self.gap
        second = 2.5 - 0.75 * dr.fma(x, x, y * y) - x * y + 2 * self.shift * self.shift
        return 3 * weight * self.shift, dr.fma(weight, second, self.gap)

    def __call__(self, q: Real) -> Real:
        """Return k(q) = (1-g) (S - 1 + q^2)/q + g q, in a form that does not cancel near q = 0. The
        condition is q k(q) <= g, where g is `gap`. For each of s1 and s2, s^2 = 1 + q e with a
        number e, so s = 1 + q x with x = e/(s+1). In the code `total` is the sum of the two numbers
        x, and `rise` is (S - 1 + q^2)/q."""
        e1, e2 = q - 2 * (self.rest - self.shift), q + 2 * (self.rest + self.shift)
        one_minus_q, one_plus_q = 1 - q, 1 + q
        s1 = dr.sqrt(dr.fma(one_minus_q, one_minus_q, 2 * q * (self.p + self.shift)))
        s2 = dr.sqrt(dr.fma(one_plus_q, one_plus_q, -2 * q * (self.p - self.shift)))
        inverse = 1 / ((s1 + 1) * (s2 + 1))
        total = dr.fma(e1, s2 + 1, e2 * (s1 + 1)) * inverse  # x1 + x2
        # By S = s1 s2 (1 + q total/2) and s1 s2 = 1 + q total + q^2 x1 x2.
        rise = q * dr.fma(e1 * e2, inverse, 1) + total * dr.fma(0.5 * s1, s2, 1)
        return dr.fma(1 - self.gap, rise, self.gap * q)
