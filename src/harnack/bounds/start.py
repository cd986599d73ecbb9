"""Closed-form safe steps from which the sharper solves start.

They are exact to first order at p and free of cancellation, so near a surface in float32 they
keep the march moving where the sharp formulas drown in rounding.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.bounds.classic import fraction

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.certify import BallCertificate

_SHORT = 0.25


def safe_starts(c: BallCertificate, slope: Real) -> tuple[Real, Real]:
    """Safe fractions q of the radius (upwards, downwards): the longer of two plain proofs.

    One is the classic step. The other is the chord bound's parabola on q <= 1/4: with
    e(q) = (P(q,1) - 1)/q and u = f - lower, f moves up by at most

        q k(q),  k(q) = (u+m)/2 e(q) - (u-m)/2 e(-q),  m = R f_v/n,  |m| <= u,

    e(q) = n + q A(q) with a power series A >= 0, and -e(-q) = -n + q A(-q) with A(-q) <= A(q),
    so k(q) <= R f_v + q u A(1/4): the root of q (R f_v + u A q) = gap is safe. Downwards the
    same holds for upper - f and -f_v.
    """
    plain = fraction(c)
    rate = c.radius * slope
    up = _parabola(c.room_below, rate, c.gap_up, c.dimension)
    down = _parabola(c.room_above, -rate, c.gap_down, c.dimension)
    return fmax(up, plain), fmax(down, plain)


def _parabola(room: Real | None, rate: Real, gap: Real, n: int) -> Real:
    if room is None:
        return type(gap)(0)
    p_pole = (1 + _SHORT) / (1 - _SHORT) ** (n - 1)
    bend = ((p_pole - 1) / _SHORT - n) / _SHORT * room
    gap = fmin(gap, 1e30)  # no level: any large number, with a finite square root
    root = dr.sqrt(dr.fma(rate, rate, 4 * bend * gap))
    q = dr.select(rate > 0, 2 * gap / (rate + root), (root - rate) / (2 * bend))
    # A room of zero means that f is constant: then k = 0 and any q is safe.
    q = dr.select(room > 0, q, _SHORT)
    return fmin(q * (1 - 1e-6), _SHORT)
