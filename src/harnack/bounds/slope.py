"""The slope bound: Harnack's inequality that also uses the directional derivative.

The extremal measures are the equality cases of Jensen's inequality and of the chord bound for a
convex function: a point mass ring at one latitude, and two point masses at the poles.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin

from harnack.bounds.bound import Bound
from harnack.bounds.classic import fraction
from harnack.bounds.solve import LARGEST_FRACTION, largest_covered
from harnack.certify import BallCertificate, Certificate

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Slope(Bound):
    """One- or two-sided slope bound in 2, 3 and 4 dimensions.

    Proof. A positive harmonic u on B(p, R) is, along a unit direction v and with q = t/R,
    u(p+tv) = integral of P(q, s) dnu(s) over s in [-1, 1], where P(q, s) =
    (1-q^2)/(1+q^2-2qs)^(n/2), nu >= 0 has mass u(p) and first moment R u_v(p)/n (differentiate
    at q = 0: dP/dq = n s). So the mean of s is m = R u_v/(n u), and P is convex in s, hence

        u P(q, m) <= u(p+tv) <= u [(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1)]

    (Jensen; chord), both attained. The upper bound is convex in q. The lower one rises, then
    falls: its derivative has the sign of m q^2 - 2q + m (n = 2), q^3 + m q^2 - 5q + 3m (n = 3)
    or q^3 - 3q + 2m (n = 4), each decreasing on [0, 1]. So each first crossing is unique, and
    what is free at q is free before it. With upper - f > 0 the same holds for its negative
    slope; the better of the two is kept on each side.
    """

    rounds: int = 4

    def accepts(self, certificate: Certificate) -> bool:
        return isinstance(certificate, BallCertificate)

    def step(self, certificate: Certificate, slope: Real) -> Real:
        assert isinstance(certificate, BallCertificate)
        c, start = certificate, fraction(certificate)
        moves = _movements(c, slope)
        q = type(start)(1)
        for gap, alternatives in ((c.gap_up, moves[0]), (c.gap_down, moves[1])):
            side = type(start)(0)
            for movement in alternatives:
                side = fmax(side, largest_covered(movement, gap, start, self.rounds))
            q = fmin(q, side)
        return q * c.radius

    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        assert isinstance(certificate, BallCertificate)
        c = certificate
        q = length / c.radius
        inside = q <= LARGEST_FRACTION
        q = fmin(q, LARGEST_FRACTION)
        up, down = _movements(c, slope)
        least_up = functools.reduce(fmin, (movement(q) for movement in up))
        least_down = functools.reduce(fmin, (movement(q) for movement in down))
        free = (q * least_up <= c.gap_up) & (q * least_down <= c.gap_down)
        return (length <= 0) | (inside & free)


def _movements(c: BallCertificate, slope: Real):
    """Functions k(q) with f(p+tv) - f(p) <= q k(q), and the same for f(p) - f(p+tv)."""
    up, down = [], []
    n = c.dimension
    for u, sign, away, toward in (
        (c.room_below, 1.0, up, down),  # u = f - lower, rising
        (c.room_above, -1.0, down, up),  # u = upper - f, rising as f falls
    ):
        if u is None:
            continue
        moment = sign * c.radius * slope / n  # u m
        moment = clamp(moment, -u, u)
        mean = dr.select(u > 0, moment / u, 0)
        away.append(_Chord(u, moment, n))
        toward.append(_Jensen(u, mean, n))
    return up, down


@dataclass(frozen=True)
class _Chord:
    """u [(1+m)/2 P(q,1) + (1-m)/2 P(q,-1)] - u = q k(q)."""

    u: Real
    moment: Real
    dimension: int

    def __call__(self, q: Real) -> Real:
        with_v, against_v = 0.5 * (self.u + self.moment), 0.5 * (self.u - self.moment)
        return with_v * _rise(q, self.dimension) - against_v * _rise(-q, self.dimension)


@dataclass(frozen=True)
class _Jensen:
    """u - u P(q, m) = q k(q)."""

    u: Real
    mean: Real
    dimension: int

    def __call__(self, q: Real) -> Real:
        e = q - 2 * self.mean
        d = dr.fma(q, e, 1)
        if self.dimension == 2:
            return self.u * 2 * (q - self.mean) / d
        if self.dimension == 4:
            return self.u * dr.fma(e, d + 1, q) / (d * d)
        x = dr.sqrt(d)
        return self.u * (q + e * (d + x + 1) / (x + 1)) / (d * x)


def _rise(q: Real, n: int) -> Real:
    """((1+q)/(1-q)^(n-1) - 1)/q without cancellation."""
    r = 1 / (1 - q)
    if n == 2:
        return 2 * r
    if n == 3:
        return (3 - q) * r * r
    return dr.fma(q, q - 3, 4) * r * r * r
