"""Proved bounds of sums f of solid harmonics, computed from samples by Bernstein's inequality. A
solid harmonic r^l Y_lm of degree l and order m is a homogeneous harmonic polynomial; on the unit
sphere it is the spherical harmonic Y_lm. Its weight is its coefficient in the sum. f_l is the part
of f of degree l, the sum of the harmonics of this degree. For a point, r is the distance from the
origin, rho the distance from the z axis, a the polar angle (from the z axis), and b the azimuth. A
set of sample points covers the sphere within an angle if each point of the sphere is within this
angle of a sample. Bernstein's inequality bounds the derivatives of a function along a great circle,
a trigonometric polynomial, by its degree and its largest absolute value; so it bounds what the
function does between samples.

- `AxialBound`: bounds that depend on the distances rho from the z axis and r from the origin.
- `BallRange`: ranges on spheres and balls about the origin.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.elementary import fmax, fmin
from harnack.fields.analytic.solid_harmonics import (
    Legendre,
    Weights,
    evaluate,
    legendre_weight,
    unit_hessian,
)

if TYPE_CHECKING:
    from harnack.backend import Real

__all__ = [
    "AxialBound",
    "amplitudes",
    "gradient_bound",
    "hessian_bound",
    "largest_gradient",
    "largest_hessian",
    "order_on_axis",
    "value_bound",
]

# The number of intervals into which the polar angle from pole to pole is divided for samples.
_POLAR_INTERVALS = 720
# The number of samples of the angle m b over half a turn, b the azimuth.
_AZIMUTH_SAMPLES = 24


@dataclass(frozen=True)
class AxialBound:
    """A bound, at a point, of the form sum of c rho^i r^j with all c >= 0, where rho and r are the
    distances of the point from the z axis and from the origin.

    rows: (i, ((j, c), ...)) for each power i, with i and j decreasing.

    A solid harmonic r^l Y_lm vanishes to order |m| along the z axis and to order l at the origin.
    Near these places it, its derivatives and their rounding errors are far smaller than elsewhere
    on the sphere of radius r, and a useful bound must become small there, too. Since such a sum
    grows with rho and with r, its value at (rho(p) + R, |p| + R) is a bound on the whole ball B(p,
    R).

    Every r^l Y_lm is homogeneous, so the constants c need only be computed on the unit sphere. Let
    Q = Q_l^m as in `solid_harmonics`, and x + iy = sin(a) exp(i b), z = cos(a) on that sphere.
    After division by a power of sin(a), the functions to be bounded are trigonometric polynomials
    of degree at most l in the polar angle a, and of degree 1 in m b. Samples and Bernstein's
    inequality prove their largest absolute values, as in `proved_range`.
    """

    rows: tuple[tuple[int, tuple[tuple[int, float], ...]], ...]

    @classmethod
    def of(cls, terms: dict[tuple[int, int], float]) -> AxialBound:
        """The bound sum of c rho^i r^j. terms: a mapping (i, j) -> c."""
        powers = sorted({i for i, _ in terms}, reverse=True)
        return cls(
            tuple(
                (i, tuple((j, terms[k, j]) for k, j in sorted(terms, reverse=True) if k == i))
                for i in powers
            )
        )

    def __call__(self, rho: Real, r: Real) -> Real:
        """The value of the bound at points with the distances rho from the z axis and r from the
        origin, by Horner's rule in both variables."""
        # The coefficient of each power of rho, a polynomial in r.
        outer = [(i, _horner([(j, 0.0 * r + c) for j, c in row], r)) for i, row in self.rows]
        return _horner(outer, rho) if outer else 0.0 * r


def _horner(terms: list[tuple[int, Real]], x: Real) -> Real:
    """The polynomial that is the sum of c x^i over the terms (i, c), at x, by Horner's rule. The
    powers i decrease from term to term."""
    (i, total), *lower_terms = terms
    for j, c in lower_terms:
        total, i = total * _power(x, i - j) + c, j
    return total * _power(x, i) if i else total


def _power(x: Real, n: int) -> Real:
    """x^n for n >= 1, by repeated squaring."""
    half = None if n < 2 else _power(x, n // 2)
    if half is None:
        return x
    return half * half * x if n % 2 else half * half


def order_on_axis(weights: Weights) -> int:
    """The order to which a sum of solid harmonics, minus its constant term, vanishes along the z
    axis: the smallest |m| of its terms.

    weights: a mapping (l, m) -> coefficient.
    """
    return min((abs(m) for l, m in weights if l > 0), default=0)  # noqa: E741


def value_bound(weights: Weights) -> AxialBound:
    """A bound of |f|, as a sum of terms c rho^i r^j, for the sum f of solid harmonics with these
    weights. rho and r are the distances from the z axis and from the origin. With Y_lm = N Q(cos a)
    sin(a)^m times cos or sin of m b, |r^l Y_lm| is at most the largest N |Q(cos a)|, over all polar
    angles a, times rho^m r^(l-m).

    weights: a mapping (l, m) -> coefficient.
    """
    return _summed(weights, lambda l, m: (m, l, largest_value(l, m)))  # noqa: E741


def gradient_bound(weights: Weights) -> AxialBound:
    """A bound of |grad f|, as a sum of terms c rho^i r^j, for the sum f of solid harmonics with
    these weights. rho and r are the distances from the z axis and from the origin. A harmonic of
    order m contributes a power rho^(m-1) (for m = 0: rho^0).

    weights: a mapping (l, m) -> coefficient.
    """
    return _summed(weights, lambda l, m: (max(m - 1, 0), l - 1, largest_gradient(l, m)))  # noqa: E741


def hessian_bound(weights: Weights) -> AxialBound:
    """A bound of the absolute second derivatives along any direction, as a sum of terms c rho^i
    r^j, for the sum of solid harmonics with these weights. rho and r are the distances from the z
    axis and from the origin. A harmonic of order m contributes a power rho^(m-2) (for m < 2:
    rho^0).

    weights: a mapping (l, m) -> coefficient.
    """
    return _summed(weights, lambda l, m: (max(m - 2, 0), l - 2, largest_hessian(l, m)))  # noqa: E741


def _summed(weights: Weights, bound_of: Callable[[int, int], tuple[int, int, float]]) -> AxialBound:
    """The sum of the bounds of all terms of a sum of solid harmonics.

    weights: a mapping (l, m) -> coefficient.
    bound_of: a function of (l, m) with m >= 0 that returns (i, d, c), for the bound c rho^i r^(d-i)
        of r^l Y_lm or of a derivative; the term is left out if d < i.

    The orders m and -m are bounded together, by the root of the sum of the squares of their
    weights.
    """
    terms: dict[tuple[int, int], float] = {}
    for (l, m), amplitude in amplitudes(weights).items():  # noqa: E741
        power, degree, constant = bound_of(l, m)
        if degree >= power and constant > 0:
            key = (power, degree - power)
            terms[key] = terms.get(key, 0.0) + amplitude * constant
    return AxialBound.of(terms)


def amplitudes(weights: Weights) -> dict[tuple[int, int], float]:
    """For each (l, m) with m >= 0, the amplitude of the solid harmonics of degree l and orders m
    and -m together: the root of the sum of the squares of their weights. (Together they are a
    multiple of the cosine of m times a shifted azimuth.)

    weights: a mapping (l, m) -> coefficient.
    """
    sizes: dict[tuple[int, int], float] = {}
    for (l, m), weight in weights.items():  # noqa: E741
        sizes[l, abs(m)] = math.hypot(sizes.get((l, abs(m)), 0.0), weight)
    return sizes


def polar_samples(count: int = _POLAR_INTERVALS) -> tuple[FloatArray, FloatArray]:
    """Arrays (count + 1,) of cos(a) and sin(a) for polar angles a evenly spaced from 0 to pi."""
    a = np.linspace(0.0, math.pi, count + 1)
    return np.cos(a), np.sin(a)


def _proved_maximum(sampled: FloatArray, degree: int) -> float:
    """A bound of the largest absolute value of a trigonometric polynomial T in the polar angle a,
    from samples.

    sampled: the values of T at the angles of `polar_samples`.
    degree: the degree of T, or more.

    Proof. Let A be the largest absolute value. Where it is taken, the slope is 0, and by
    Bernstein's inequality the second derivative is at most degree^2 A everywhere. A sample is
    within half a spacing of that place, so the samples fall short of A by at most e A, with e =
    (degree * spacing/2)^2/2.
    """
    e = 0.5 * (max(degree, 1) * 0.5 * math.pi / _POLAR_INTERVALS) ** 2
    return float(np.abs(sampled).max()) / (1 - e) * (1 + 1e-12)


@functools.cache
def largest_value(l: int, m: int) -> float:  # noqa: E741
    """A bound of N |Q(cos a)| over all polar angles a, where the spherical harmonic is Y_lm = N
    Q(cos a) sin(a)^m times cos or sin of m times the azimuth."""
    z, _ = polar_samples()
    return legendre_weight(l, m) * _proved_maximum(
        np.broadcast_to(Legendre(z, 1.0)(l, m), z.shape), l
    )


@functools.cache
def largest_gradient(l: int, m: int) -> float:  # noqa: E741
    """A bound of |grad r^l Y_lm| / sin(a)^(m-1) on the unit sphere, for m >= 0 (m = 0: of |grad|),
    where a is the polar angle.

    Without its constant factor, the harmonic is Q rho^m cos(m b), with the polynomial Q = Q_l^m of
    z and r^2 (`solid_harmonics`). The derivative of Q by rho is -rho Q', with Q' = Q_(l-1)^(m+1).
    So the components of the gradient are cos(m b) (m Q - rho^2 Q') rho^(m-1) along rho, cos(m b)
    (l+m) Q_(l-1)^m rho^m along z, and -sin(m b) m Q rho^(m-1) along the azimuth b. The first two
    are one part and the last one another; as cos^2 + sin^2 = 1, the length of the gradient is at
    most the larger of the lengths of these parts, without cos and sin.
    """
    if l == 0:
        return 0.0
    z, rho = polar_samples()
    # On the unit sphere r^2 is 1.
    q = Legendre(z, 1.0)
    # Q and Q', divided by (2m-1)!! as `Legendre` does; for Q' it divides by (2m+1)!!.
    at_m, at_next = q(l, m), (2 * m + 1) * q(l - 1, m + 1)
    # The components without cos and sin, divided by rho^(m-1) if m > 0.
    if m == 0:
        radial, axial, azimuthal = -rho * at_next, l * q(l - 1, 0), 0.0 * z
    else:
        radial = m * at_m - rho * rho * at_next
        axial, azimuthal = rho * ((l + m) * (q(l - 1, m) if l > m else 0.0)), m * at_m
    # The square of a directional derivative is of degree 2 l, and so is their sum.
    squares = np.maximum(radial**2 + axial**2, azimuthal**2)
    return legendre_weight(l, m) * math.sqrt(_proved_maximum(squares, 2 * l))


@functools.cache
def largest_hessian(l: int, m: int) -> float:  # noqa: E741
    """A bound of |v . H v| / sin(a)^(m-2) on the unit sphere for all unit vectors v (m < 2: of |v .
    H v|), where H is the Hessian of r^l Y_lm, m >= 0, and a the polar angle.

    Proof. For fixed components of v in cylindrical coordinates, v . H v is of degree l in the polar
    angle a, and A cos(m b) + B sin(m b) in the azimuth b. The largest absolute value of the latter
    is at most the largest sample at a spacing w of m b, divided by cos(w/2).
    """
    if l < 2:
        return 0.0
    z, rho = polar_samples()
    largest = 0.0
    for m_azimuth in np.pi * np.arange(_AZIMUTH_SAMPLES) / _AZIMUTH_SAMPLES:
        azimuth = m_azimuth / max(m, 1)
        hessians = unit_hessian(l, m, rho, z, float(azimuth), removed_power=max(m - 2, 0))
        norms = np.abs(np.linalg.eigvalsh(hessians)).max(axis=1)
        largest = max(largest, _proved_maximum(norms, l))
        # Nothing depends on the azimuth.
        if m == 0:
            break
    return largest / math.cos(0.5 * math.pi / _AZIMUTH_SAMPLES)


# The product of degree and grid spacing. Half of its square is the fraction by which proved ranges
# are too wide at each end, in units of half their width.
_RESOLUTION = 0.1
# Radii of the spheres on which the whole polynomial is bounded, as fractions of the largest radius.
_FRACTIONS = (0.25, 0.4, 0.55, 0.7, 0.85, 1.0)


def unit_sphere(covering: float) -> FloatArray:
    """Points (3, n) of the unit sphere that cover it: each point of the sphere is within the angle
    `covering` of one.

    The points lie on rings at equal steps h of latitude, on each ring at equal steps w of
    longitude. The nearest one is within h/2 in latitude and w/2 in longitude. For two points with
    polar angles a and b the chord obeys

        chord^2 = 4 sin^2((a-b)/2) + 4 sin a sin b sin^2(w/4) <= (h/2)^2 + sin a sin b (w/2)^2,

    with sin b <= sin a + h/2.
    """
    chord = 2 * math.sin(0.5 * min(covering, math.pi))
    # The step h is less than 1.4 chord, so that h/2 is less than the chord, and w below is not 0.
    ring_count = math.ceil(math.pi / (1.4 * chord)) + 1
    h = math.pi / ring_count
    points: list[FloatArray] = []
    for ring in range(ring_count):
        polar_angle = (ring + 0.5) * h
        max_east_west = math.sqrt(chord**2 - (h / 2) ** 2)
        # The largest w for which this bound is at most chord^2.
        w = 2 * max_east_west / math.sqrt(math.sin(polar_angle) * (math.sin(polar_angle) + h / 2))
        longitude = 2 * math.pi * np.arange(n := math.ceil(2 * math.pi / w)) / n
        sine = math.sin(polar_angle)
        points.append(
            np.stack(
                (
                    sine * np.cos(longitude),
                    sine * np.sin(longitude),
                    np.full(n, math.cos(polar_angle)),
                )
            )
        )
    return np.concatenate(points, axis=1)


def proved_range(low: float, high: float, degree: int, covering: float) -> tuple[float, float]:
    """Bounds (lower, upper) of a polynomial on a sphere, from its smallest and largest value over a
    set of points of the sphere.

    low, high: the smallest and the largest value on the set.
    degree: the degree L of the polynomial.
    covering: an angle. Every point of the sphere is within this angle of the set.

    Proof. Let the true range be [c - A, c + A]. Take the great circle through a point with the
    largest value and the point of the set nearest to it. On this circle the polynomial is a
    trigonometric polynomial T of degree L with |T - c| <= A, so |T''| <= L^2 A by Bernstein's
    inequality. At the maximum T' = 0, hence `high` falls short of the maximum by at most e A, e =
    (L covering)^2/2. The same holds for `low`. So 2A <= high - low + 2 e A, that is, A <= (high -
    low)/2/(1 - e).

    Raises:
        ValueError: e >= 1, the points are too far apart.
    """
    e = 0.5 * (degree * covering) ** 2
    if e >= 1:
        raise ValueError(f"the points are too far apart ({covering:g}) for degree {degree}")
    half_range = 0.5 * (high - low) / (1 - e)
    # The samples carry rounding errors of double precision, far below this.
    margin = e * half_range + 1e-11 * (abs(low) + abs(high) + half_range)
    return low - margin, high + margin


def range_of_harmonic(l: int, m: int) -> tuple[float, float]:  # noqa: E741
    """A proved range (low, high) of the spherical harmonic Y_lm on the unit sphere, within 1e-5 of
    the true one.

    All absolute values are taken on the circle of azimuth 0 through the poles, and for m = 0 all
    values. Otherwise the factor cos(m phi) or sin(m phi) takes both signs alike, so that the range
    is symmetric.
    """
    sample_count = 8192
    polar_angle = 2 * np.pi * np.arange(sample_count) / sample_count
    # The first result of `evaluate` is the value, the second the gradient.
    values = evaluate(
        {(l, abs(m)): 1.0}, np.sin(polar_angle), 0.0 * polar_angle, np.cos(polar_angle)
    )[0]
    low, high = proved_range(float(values.min()), float(values.max()), l, math.pi / sample_count)
    return (low, high) if m == 0 else (-max(high, -low), max(high, -low))


@dataclass(frozen=True)
class BallRange:
    """Bounds of a harmonic polynomial f on balls |y| <= s about the origin. f = f_0 + f_1 + ...,
    where f_l is its part that is homogeneous of degree l.

    constant: f_0.
    ends: (l, lower, upper) for l > 0, the range of f_l on the unit sphere. f_l has mean 0 there, so
        lower <= 0 <= upper, and f lies in f_0 + [sum s^l lower_l, sum s^l upper_l] for |y| <= s.
    spheres: (s, lower, upper), the range of f itself on a few spheres of radius s, which also holds
        for |y| <= s. As the f_l seldom have their extremes at the same point, this range is
        tighter.

    By the maximum principle a range on a sphere is a range on its ball. The ranges are proved by
    samples and Bernstein's inequality.
    """

    constant: float
    ends: tuple[tuple[int, float, float], ...]
    spheres: tuple[tuple[float, float, float], ...] = ()

    @classmethod
    def of(cls, weights: Weights) -> BallRange:
        """Compute the ranges of the parts of each degree, for the sum of solid harmonics with these
        weights. `spheres` stays empty.

        weights: a mapping (l, m) -> coefficient.
        """
        constant, ends = 0.0, list[tuple[int, float, float]]()
        points, covering = _points(weights)
        for degree, values in _values(weights, points).items():
            if degree == 0:
                constant = float(values[0])
            else:
                low, high = float(values.min()), float(values.max())
                ends.append((degree, *proved_range(low, high, degree, covering)))
        return cls(constant, tuple(ends))

    def with_spheres(self, weights: Weights, largest: float) -> BallRange:
        """The same bounds of f, with ranges of f on six spheres added, up to the radius `largest`.

        weights: a mapping (l, m) -> coefficient, those of f. A polynomial with a single f_l besides
            f_0 is returned unchanged, since such ranges would not be tighter.
        """
        if len(self.ends) < 2:
            return self
        points, covering = _points(weights)
        values = _values(weights, points)
        spheres = [
            (s, *sphere_range(values, s, covering)) for s in (q * largest for q in _FRACTIONS)
        ]
        return BallRange(self.constant, self.ends, tuple(spheres))

    def by_degree(self, s: Real) -> tuple[Real, Real]:
        """A lower and an upper bound of f on the ball |y| <= s, from the ranges of the parts f_l
        alone. s: a number or an array."""
        lower = upper = 0.0 * s
        largest_degree = max((degree for degree, _, _ in self.ends), default=0)
        ends = {degree: (low, high) for degree, low, high in self.ends}
        for degree in range(largest_degree, 0, -1):
            low, high = ends.get(degree, (0.0, 0.0))
            # Horner's rule.
            lower, upper = (lower + low) * s, (upper + high) * s
        return lower + self.constant, upper + self.constant

    def curvature(self, s: Real) -> Real:
        """A bound of the absolute second derivatives v . H v of f along unit vectors v, on the ball
        |y| <= s. s: a number or an array.

        Proof. Let |f_l| <= M on the unit sphere. Then |grad f_l| <= l M there: along a great circle
        f_l is a trigonometric polynomial T of degree l, its radial derivative is l T, and T'^2 +
        l^2 T^2 <= l^2 M^2 (Bernstein-Szego). A directional derivative of f_l is again homogeneous
        and harmonic, of degree l-1, so |v . H v| <= l (l-1) M |y|^(l-2).
        """
        return self._derivative(s, 2)

    def gradient(self, s: Real) -> Real:
        """A bound of |grad f| on the ball |y| <= s, from |grad f_l| <= l M |y|^(l-1), where M is
        the largest |f_l| on the unit sphere. `curvature` has the proof. s: a number or an array."""
        return self._derivative(s, 1)

    def _derivative(self, s: Real, order: int) -> Real:
        """A bound of the derivatives of f of this order on the ball |y| <= s: the sum over l of l
        (l-1) .. (l-order+1) M_l s^(l-order), by Horner's rule, where M_l is the largest |f_l| on
        the unit sphere."""
        total = 0.0 * s
        max_abs = {degree: fmax(-low, high) for degree, low, high in self.ends}
        for degree in range(max(max_abs, default=0), order - 1, -1):
            total = total * s + math.perm(degree, order) * max_abs.get(degree, 0.0)
        return total

    def at(self, s: Real) -> tuple[Real, Real]:
        """A lower and an upper bound of f on the ball |y| <= s. Each is the tightest of several
        bounds: that of `by_degree`, and those on the `spheres` with a radius of s or more.

        s: a Dr.Jit array.
        """
        lower, upper = self.by_degree(s)
        for radius, low, high in self.spheres:
            # The range on a sphere holds for all smaller balls.
            inside = s <= radius
            lower = fmax(dr.select(inside, low, -math.inf), lower)
            upper = fmin(dr.select(inside, high, math.inf), upper)
        return lower, upper

    def on_ball(self, s: float) -> tuple[float, float]:
        """A lower and an upper bound of f on the ball |y| <= s, as `at` returns them.

        s: a Python number.
        """
        bounds = [self.by_degree(s), *((low, high) for r, low, high in self.spheres if s <= r)]
        return max(low for low, _ in bounds), min(high for _, high in bounds)


def _points(weights: Weights) -> tuple[FloatArray, float]:
    """Sample points of the unit sphere that are dense enough for sums of solid harmonics with these
    weights, an array (3, n); and an angle: each point of the sphere is within it of a sample point.

    weights: a mapping (l, m) -> coefficient.
    """
    covering = _RESOLUTION / max(1, max(degree for degree, _ in weights))
    return unit_sphere(covering), covering


def _values(weights: Weights, points: FloatArray) -> dict[int, FloatArray]:
    """The values (n,) of the part f_l of each degree l at points (3, n) of the unit sphere, as a
    mapping l -> values. f is the sum of solid harmonics with these weights, a mapping (l, m) ->
    coefficient."""
    degrees = sorted({degree for degree, _ in weights})
    # The first result of `evaluate` is the value, the second the gradient.
    return {
        degree: evaluate({k: w for k, w in weights.items() if k[0] == degree}, *points)[0]
        for degree in degrees
    }


def sphere_range(values: dict[int, FloatArray], s: float, covering: float) -> tuple[float, float]:
    """A proved range (low, high) of a harmonic polynomial f on the sphere of radius s about the
    origin. f is the sum of its parts f_l of each degree l.

    values: the values of each f_l at sample points of the unit sphere, by degree l.
    covering: an angle. Every point of the unit sphere is within this angle of one of these points.
    """
    total: FloatArray = np.sum([s**degree * v for degree, v in values.items()], axis=0)
    return proved_range(float(total.min()), float(total.max()), max(values), covering)
