"""The solid angle of a circle with its derivatives, by complete elliptic integrals.

The circle has radius 1 and lies in the plane z = 0, run counter-clockwise as seen from above. The
point is at r from the axis and z above the plane; Rm^2 = (1-r)^2 + z^2 and Rp^2 = (1+r)^2 + z^2 are
its squared distances to the nearest and the farthest point of the circle, kc = Rm/Rp is the
complementary modulus of all integrals, and A = 1 + r^2 + z^2.

Value. Omega = -sgn(z) W, W = 2 pi [r < 1] - 4|z| cel/((1+r) Rp), where cel = integral over
[0, pi/2] of (cos^2 + gamma sin^2)/(D (cos^2 + gamma^2 sin^2)), D^2 = cos^2 + kc^2 sin^2 and
gamma = (1-r)/(1+r): Bulirsch's general complete integral cel(kc, gamma^2, 1, gamma) (Bulirsch 1969,
Numer. Math. 13). On the cylinder r = 1, where gamma = 0, W = pi - 2|z| K/Rp.

All integrals come from one loop of arithmetic-geometric means, which converges quadratically: six
rounds for single precision and eight for double, unrolled, are a short stretch of plain arithmetic.
Beside the means a_n it has the differences c_(n+1) = c_n^2/(4 a_(n+1)), c_1 = (1-kc)/2, and adds up
S, the sum of 2^n c_(n+1)^2/(1-kc)^2 over n >= 1. Then E = K (1 - (1-kc^2)/2 - (1-kc)^2 (1/4 + S)).

Derivatives. Biot and Savart's integrals over the circle, seen from the point at distance D,

    I3 = integral of dphi/D^3 = 4E/(Rp Rm^2),   C3 = integral of cos(phi) dphi/D^3 = r J,

give the gradient (z x J, z y J, I3 - r^2 J), where the known form of J,
2 (A E/Rm^2 - K)/(r^2 Rp), cancels near the axis and far away. With E as above, 1 - kc = q r,
q = 4/(Rp (Rp + Rm)), and A = Rp^2 (1 + kc^2)/2, the terms of order 0 and 1 in 1 - kc drop out, and

    J = K q^2 [(1 + 4 kc + kc^2)/4 - (1 + kc^2) S]/(Rp kc^2)

is left. I3 - r^2 J cancels beside the circle,
where 2 [K + ((1-r)(1+r) - z^2) E/Rm^2]/Rp is the same and does not.

Second derivatives need I5 and C5, with D^-5. As D^2 = A - 2r cos(phi), A I5 - 2r C5 = I3; and by
parts, C3 = 3r times the integral of sin^2(phi)/D^5, that is 3 A C5 = 6 r I5 + C3. So, as
A^2 - 4r^2 = Rm^2 Rp^2,

    C5/r = (2 I3 + A J/3)/(Rm^2 Rp^2),   I5 = (I3 + 2r C5)/A,

sums of positive terms, and Omega_zz = -3z (I5 - r C5), Omega_rz = C3 - 3 z^2 C5, Omega_r/r = z J;
the trace is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.backend import Real

__all__ = ["UnitCircle"]

_ROUNDS = {"single": 6, "double": 8}


@dataclass(frozen=True)
class UnitCircle:
    """What is known of the unit circle at a point (r, z).

    angle: Omega in (-2 pi, 2 pi).
    nearest, farthest: Rm and Rp.
    share: q, with q r = 1 - kc.
    radial: J/q^2; the gradient along the axis is `axial`.
    third: I3.
    """

    r: Real
    z: Real
    angle: Real
    nearest: Real
    farthest: Real
    share: Real
    radial: Real
    axial: Real
    third: Real

    @classmethod
    def at(cls, r: Real, z: Real) -> UnitCircle:
        """r >= 0 and z: Dr.Jit numbers."""
        real: Any = cast("Any", type(r))
        rounds = _ROUNDS["double" if float(dr.epsilon(r)) < 1e-10 else "single"]
        gap = 1 - r
        square = dr.fma(gap, gap, z * z)
        nearest, farthest = dr.sqrt(square), dr.sqrt(dr.fma(1 + r, 1 + r, z * z))
        inverse = 1 / farthest
        kc = nearest * inverse
        q = 4 * inverse / (farthest + nearest)
        gamma = gap / (1 + r)
        # c, d, p are Bulirsch's numbers for cel, m and e those of the means.
        c, d, p = real(1), dr.copysign(real(1), gamma), fmax(dr.abs(gamma), 1e-30)
        k, e, m = kc, kc, real(1)
        total, ratio, drop = real(0), real(0.5), q * r
        for n in range(rounds):
            before, g = c, e / p
            c, d = c + d / p, 2 * dr.fma(before, g, d)
            p, m = p + g, m + k
            k = 2 * dr.sqrt(e)
            e = k * m
            if n >= 1:
                ratio = ratio * ratio * drop / (4 * 0.5 ** (n + 1) * m)
                total = dr.fma(2.0**n * ratio, ratio, total)
        cel = (math.pi / 2) * dr.fma(c, m, d) / (m * (m + p))
        first = (math.pi / 2 * 2.0**rounds) / m  # K
        second = first * (1 - 0.5 * drop * (1 + kc) - drop * drop * (0.25 + total))  # E
        height = dr.abs(z)
        w = dr.select(r < 1, real(2 * math.pi), 0) - 4 * height * inverse / (1 + r) * cel
        w = dr.select(r == 1, math.pi - 2 * height * inverse * first, w)
        bracket = 0.25 * dr.fma(kc, 4 + kc, 1) - dr.fma(kc, kc, 1) * total
        radial = first * inverse * bracket / (kc * kc)
        third = 4 * second * inverse / square
        beside = 2 * inverse * (first + (gap * (1 + r) - z * z) / square * second)
        axial = dr.select(first * square < 2 * second, beside, third - drop * drop * radial)
        return cls(r, z, -dr.mulsign(w, z), nearest, farthest, q, radial, axial, third)

    @property
    def across(self) -> Real:
        """z J: the gradient at right angles to the axis is (x, y) times this."""
        return (self.z * self.share) * (self.share * self.radial)

    def second_derivatives(self) -> tuple[Real, Real, Real]:
        """Omega_zz, Omega_rz/r and z J: the Hessian in the directions of axis, radius and circle.

        Omega_rr is minus the sum of the first and the last.
        """
        r, z = self.r, self.z
        squares = dr.fma(r, r, dr.fma(z, z, 1))  # A
        j = self.share * self.share * self.radial
        both = self.nearest * self.farthest
        sums = 2 * self.third + squares * j / 3  # (Rm Rp)^2 C5/r
        up, out = z / both, r / both
        # I5 - r C5, with I5 = (I3 + 2 r C5)/A.
        along = dr.fma(out * out * sums, 2 - squares, self.third) / squares
        return -3 * z * along, dr.fma(-3 * up * up, sums, j), z * j
