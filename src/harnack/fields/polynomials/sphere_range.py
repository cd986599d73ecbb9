"""Proved ranges of harmonic polynomials on spheres and balls about the origin.

By the maximum principle a range on a sphere is one on its ball. Sampling alone proves nothing;
sampling with Bernstein's inequality does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.fields.polynomials.solid_harmonics import Weights, evaluate

if TYPE_CHECKING:
    from harnack.backend import Real

# The product of degree and grid spacing: ranges are proved to (this)^2/2 of their half width.
_RESOLUTION = 0.1
# Spheres on which the whole polynomial is bounded, as fractions of the largest.
_FRACTIONS = (0.25, 0.4, 0.55, 0.7, 0.85, 1.0)


def unit_sphere(covering: float) -> FloatArray:
    """Points (3, n) of the unit sphere such that none of it is further than `covering` away.

    Distances are measured along great circles. Rings at equal steps h of latitude, at equal
    steps w of longitude: the nearest point is within h/2 and w/2 of both, and for polar angles
    a, b the chord obeys chord^2 = 4 sin^2((a-b)/2) + 4 sin a sin b sin^2(w/4) <=
    (h/2)^2 + sin a sin b (w/2)^2 with sin b <= sin a + h/2.
    """
    chord = 2 * math.sin(0.5 * min(covering, math.pi))
    rings = math.ceil(math.pi / (1.4 * chord)) + 1
    h = math.pi / rings
    points: list[FloatArray] = []
    for ring in range(rings):
        a = (ring + 0.5) * h
        room = math.sqrt(chord**2 - (h / 2) ** 2)
        w = 2 * room / math.sqrt(math.sin(a) * (math.sin(a) + h / 2))
        longitude = 2 * math.pi * np.arange(n := math.ceil(2 * math.pi / w)) / n
        sine = math.sin(a)
        points.append(
            np.stack((sine * np.cos(longitude), sine * np.sin(longitude), np.full(n, math.cos(a))))
        )
    return np.concatenate(points, axis=1)


def proved_range(low: float, high: float, degree: int, covering: float) -> tuple[float, float]:
    """Bounds of a polynomial of this degree on a sphere, from its extremes over a point set.

    Every point of the sphere is within `covering` (an angle) of the set. Proof: let the true
    range be [c - A, c + A]. Along the great circle through a maximum and the nearest point of
    the set, T - c is a trigonometric polynomial of degree L with |T - c| <= A, so by Bernstein's
    inequality |T''| <= L^2 A. At the maximum T' = 0, hence `high` falls short of it by at most
    e A, e = (L covering)^2/2; in the same way `low`. So 2A <= high - low + 2 e A.
    """
    e = 0.5 * (degree * covering) ** 2
    if e >= 1:
        raise ValueError(f"the points are too far apart ({covering:g}) for degree {degree}")
    half = 0.5 * (high - low) / (1 - e)
    # The samples carry rounding errors of double precision, far below this.
    margin = e * half + 1e-11 * (abs(low) + abs(high) + half)
    return low - margin, high + margin


def range_of_harmonic(l: int, m: int) -> tuple[float, float]:  # noqa: E741
    """Proved range of Y_lm on the unit sphere, within 1e-5 of the true one.

    For m = 0 a circle through the poles takes every value. Elsewhere the factor cos(m phi) or
    sin(m phi) takes both signs alike, so that the range is symmetric.
    """
    n = 8192
    t = 2 * np.pi * np.arange(n) / n
    values = evaluate({(l, abs(m)): 1.0}, np.sin(t), 0.0 * t, np.cos(t))[0]
    low, high = proved_range(float(values.min()), float(values.max()), l, math.pi / n)
    return (low, high) if m == 0 else (-max(high, -low), max(high, -low))


@dataclass(frozen=True)
class BallRange:
    """Bounds of a harmonic polynomial f = f_0 + f_1 + ... (f_l homogeneous) on |y| <= s.

    ends: (l, lower, upper) of f_l on the unit sphere. f_l has mean 0 there, so lower <= 0 <=
        upper, and f lies in f_0 + [sum s^l lower_l, sum s^l upper_l] for |y| <= s.
    spheres: (s, lower, upper) of f itself on some spheres; as the terms seldom peak together
        this is tighter. By the maximum principle it holds on the smaller balls too.
    """

    constant: float
    ends: tuple[tuple[int, float, float], ...]
    spheres: tuple[tuple[float, float, float], ...] = ()

    @classmethod
    def of(cls, weights: Weights) -> BallRange:
        """The ranges of the degrees of a sum of solid harmonics."""
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
        """Itself with the range of the whole on spheres up to a radius; nothing new for one f_l."""
        if len(self.ends) < 2:
            return self
        points, covering = _points(weights)
        values = _values(weights, points)
        spheres = [
            (s, *sphere_range(values, s, covering)) for s in (q * largest for q in _FRACTIONS)
        ]
        return BallRange(self.constant, self.ends, tuple(spheres))

    def by_degree(self, s: Real) -> tuple[Real, Real]:
        """Lower and upper bound on |y| <= s from `ends`; s is a number or an array."""
        lower = upper = 0.0 * s
        top = max((degree for degree, _, _ in self.ends), default=0)
        ends = {degree: (low, high) for degree, low, high in self.ends}
        for degree in range(top, 0, -1):
            low, high = ends.get(degree, (0.0, 0.0))
            lower, upper = (lower + low) * s, (upper + high) * s
        return lower + self.constant, upper + self.constant

    def curvature(self, s: Real) -> Real:
        """A bound of all directional second derivatives on |y| <= s.

        If |f_l| <= M on the unit sphere, |grad f_l| <= l M there: along a great circle f_l is a
        trigonometric polynomial T of degree l, radially its derivative is l T, and
        T'^2 + l^2 T^2 <= l^2 M^2 (Bernstein-Szego). A directional derivative of f_l is again
        homogeneous and harmonic, of degree l-1, so |v.H v| <= l (l-1) M |y|^(l-2).
        """
        return self._derivative(s, 2)

    def gradient(self, s: Real) -> Real:
        """A bound of the gradient on |y| <= s, |grad f_l| <= l M |y|^(l-1): see `curvature`."""
        return self._derivative(s, 1)

    def _derivative(self, s: Real, order: int) -> Real:
        """The sum over l of l (l-1) .. (l-order+1) M |y|^(l-order), by Horner's rule."""
        total = 0.0 * s
        most = {degree: max(-low, high) for degree, low, high in self.ends}
        for degree in range(max(most, default=0), order - 1, -1):
            total = total * s + math.perm(degree, order) * most.get(degree, 0.0)
        return total

    def at(self, s: Real) -> tuple[Real, Real]:
        """Lower and upper bound on |y| <= s, a Dr.Jit array, from everything known."""
        lower, upper = self.by_degree(s)
        for radius, low, high in self.spheres:
            inside = s <= radius
            lower = fmax(dr.select(inside, low, -math.inf), lower)
            upper = fmin(dr.select(inside, high, math.inf), upper)
        return lower, upper

    def on_ball(self, s: float) -> tuple[float, float]:
        """The same for one number: the range on |y| <= s."""
        bounds = [self.by_degree(s), *((low, high) for r, low, high in self.spheres if s <= r)]
        return max(low for low, _ in bounds), min(high for _, high in bounds)


def _points(weights: Weights) -> tuple[FloatArray, float]:
    covering = _RESOLUTION / max(1, max(degree for degree, _ in weights))
    return unit_sphere(covering), covering


def _values(weights: Weights, points: FloatArray) -> dict[int, FloatArray]:
    """The values of each f_l at points of the unit sphere."""
    degrees = sorted({degree for degree, _ in weights})
    return {
        degree: evaluate({k: w for k, w in weights.items() if k[0] == degree}, *points)[0]
        for degree in degrees
    }


def sphere_range(values: dict[int, FloatArray], s: float, covering: float) -> tuple[float, float]:
    """Proved range of the sum of f_l on the sphere of radius s; values: on the unit sphere."""
    whole: FloatArray = np.sum([s**degree * v for degree, v in values.items()], axis=0)
    return proved_range(float(whole.min()), float(whole.max()), max(values), covering)
