"""The step from a bound of the second derivatives: Taylor's formula, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.bounds.bound import Bound
from harnack.certify import Certificate, CurvatureCertificate

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

_ROUND_DOWN = 1.0 - 1e-6
_LARGEST_GAP = 1e30  # and beyond: there is no level on this side


@dataclass(frozen=True)
class CurvatureStep(Bound):
    """The first place where the parabolas through f(p) could reach a level.

    Proof. With s the slope and H the constant, f(p+tv) lies between f + s t -+ H t^2/2 (Taylor).
    The upper parabola is convex and starts below the level a gap g above, so it first meets it
    at the positive root of s t + H t^2/2 = g, written without cancellation:
    2g/(s + r) for s > 0, (r - s)/H otherwise, r = sqrt(s^2 + 2 H g); the lower one with -s.
    Exact to second order at p, so it converges quadratically at the surface.
    """

    sufficient: ClassVar[bool] = True

    def accepts(self, certificate: Certificate) -> bool:
        return isinstance(certificate, CurvatureCertificate)

    def step(self, certificate: Certificate, slope: Real) -> Real:
        assert isinstance(certificate, CurvatureCertificate)
        c = certificate
        up, down = _root(c.gap_up, slope, c.constant), _root(c.gap_down, -slope, c.constant)
        known = (up >= 0) & (down >= 0) & (c.constant >= 0) & (c.radius > 0)  # and not NaN
        return fmax(dr.select(known, fmin(fmin(up, down), c.radius), 0) * _ROUND_DOWN, 0)

    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        assert isinstance(certificate, CurvatureCertificate)
        c = certificate
        bend = 0.5 * c.constant * length * length
        free = (bend + slope * length <= c.gap_up) & (bend - slope * length <= c.gap_down)
        return (length <= 0) | ((length <= c.radius) & free)


def _root(gap: Real, rate: Real, curvature: Real) -> Real:
    """The positive root, in a form whose squares neither overflow nor vanish: close to a zero of
    high order rate, curvature and gap are all far below the root of the smallest number."""
    none = gap >= _LARGEST_GAP
    gap = dr.select(none, 0, gap)
    steep, bent = dr.abs(rate), dr.sqrt(curvature) * dr.sqrt(2 * gap)
    long = dr.select(steep > bent, steep, bent)
    share = dr.select(long > 0, dr.select(steep > bent, bent, steep) / long, 0)
    root = long * dr.sqrt(dr.fma(share, share, 1))
    falling = dr.select(curvature == 0, dr.select(gap > 0, dr.inf, 0), (root - rate) / curvature)
    return dr.select(none, dr.inf, dr.select(rate > 0, 2 * gap / (rate + root), falling))
