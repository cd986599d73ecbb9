"""Parabolas in the angle along a circle: for functions pulled back from a sphere.

By stereographic projection a line of space becomes a circle of the unit sphere S^3, and what is a
trigonometric polynomial on the circle has a bounded second derivative in its angle, from one end of
the line to the other. A step in that angle, taken back to the line, may be infinite.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.backend.sines import sincos
from harnack.enclosures.enclosure import Enclosure, Gaps, Slopes
from harnack.enclosures.parabola import first_root

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

# For roundings in single precision, of the angle and of the length that it becomes.
_ROUND_DOWN = 1.0 - 1e-5
_PI_BELOW = 3.14159


@dataclass(frozen=True)
class Arc(Enclosure):
    """|F - slope psi| <= curvature psi^2/2, psi the angle traveled along the path's circle.

    slopes: of f along the path, in f per length, where it starts.
    curvature: a bound of the second derivative of f in the angle, on the whole circle.
    offset: the path's parameter from the point of the line that is closest to the origin.
    square: 1 + (that point's distance to the origin)^2, called c^2.

    Proof. The line q + t v, q.v = 0, becomes the circle of the points

        y = 2x/(1 + |x|^2) = (q (1 + cos a) + c v sin a)/c^2,   w = 1 - (1 + cos a)/c^2,

    with t = c tan(a/2) and c^2 = 1 + |q|^2, at speed da/dt = 2c/S, S = c^2 + t^2. So the slope in
    the angle is S/(2c) times the slope, f keeps within the parabola of `curvature`, and the first
    psi at which that meets a gap is `first_root`. From t the angle psi leads to t + s with

        s = S sin(psi/2)/(c cos(psi/2) - t sin(psi/2)),

    and to infinity, where the path ends, as soon as the denominator is not positive: then no level
    is ever met. Relative errors of slope, curvature, gap and length change psi by as much at most,
    and an error of the denominator is one of psi of the same relative size: `_ROUND_DOWN`.
    The range rises and falls with the slope at both ends.
    """

    slopes: Slopes
    curvature: Real
    offset: Real
    square: Real

    def step(self, gaps: Gaps) -> Real:
        c = dr.sqrt(self.square)
        total = dr.fma(self.offset, self.offset, self.square)
        rate = 0.5 * total / c
        up = first_root(gaps.up, self.slopes.high * rate, self.curvature)
        down = first_root(gaps.down, -self.slopes.low * rate, self.curvature)
        half = 0.5 * _ROUND_DOWN * fmin(up, down)
        known = (up >= 0) & (down >= 0) & (self.curvature >= 0)  # and not NaN
        known &= dr.isfinite(total)  # its square does not overflow
        ends = half >= _PI_BELOW  # once around
        s, k = sincos(dr.select(ends, 0, half))
        left = dr.fma(c, k, -self.offset * s)
        length = dr.select((left > 0) & ~ends, total * s / left * _ROUND_DOWN, dr.inf)
        return dr.select(known, fmax(length, 0), 0)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        return (length <= 0) | (length <= self.step(gaps))
