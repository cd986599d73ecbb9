"""The kernel of slices of four-dimensional solid angles: a Newton kernel seen from a height w.

Kernel. 1/|X|^2 is harmonic in R^4. The solid angle of a flat solid A x {0} from (x, w) is
U = w int_A dV/(r^2 + w^2)^2 with r = |y-x|; by the divergence theorem it is the integral over the
boundary of A of -n.grad_y K, with

    K(r, w) = (1/2) int_w^oo dv/(r^2 + v^2) = atan(r/w)/(2r),   pi/(4r) for w = 0.

So each dipole -m.grad_y K is harmonic in (x, w) but at the dipole and below it. Here K is scaled by
4/pi, such that it is 1/r for w = 0: sums over m = area n/(4 pi) are then U/pi^2, and for w = 0 the
winding number. As -(1/r) d/dr (r^2+v^2)^-k = 2k (r^2+v^2)^-(k+1), with D^2 = r^2 + w^2, c = w/D,
s = r/D,

    psi_k = (2/pi) 2^k k! i_(k+1)/D^(2k+1),   i_k = D^(2k-1) int_w^oo dv/(r^2+v^2)^k,
    i_k = (2k s^2 i_(k+1) + c)/(2k-1)   by parts: positive terms, which lose no digits.

The last i_n = int_0^1 (sin(phi t)/sin phi)^(2n-2) dt phi/sin phi, cos phi = c, is a function of c
that is analytic but for c <= -1: a polynomial on [0, 1].

Bound. |d^m K[u_1, ..., u_m]| <= m!/D^(m+1) for unit vectors, as if 1/r were D away; attained for
w = 0. Proof. Equal vectors u are the worst (Banach 1938). The m-th derivative of 1/|X|^2 along a
line is (-1)^m m! U_m(cos)/|X|^(m+2) (Gegenbauer), so that, with x = D/sqrt(r^2 + v^2) and
a = u.z/D, |a| <= s, that of K is +-m!/D^(m+1) times (2/pi) I,

    I = int_0^1 U_m(a x) x^m (1 - s^2 x^2)^(-1/2) dx.

For s = 1, that is w = 0, it is (pi/2) P_m(a), at most pi/2. For s < 1 the weight is that for s = 1
times one that falls from 1, so that I is the same integral for s = 1 up to some b <= 1 (Bonnet).
That is the largest for b = 1, or where U_m(a b) = 0 at an angle k pi/(m+1), k >= 1. Lobes between
such angles alternate and grow with x, as x^m (1 - x^2)^(-1/2) does: the integral is at most its
last lobe, which is the largest if it ends at b = 1, where it is below 0.4 for m <= 7 (quadrature in
`tests/test_morph.py`).

In four dimensions the gradient of n.grad_x K is at most 2 * 1.1855/D^3: its square is
cos^2 (K''^2 + (dw K')^2) + sin^2 (K'/r)^2, cos the angle of n to z, and so at most the larger of
two functions of c alone (maximum at w = r; the same tests).
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from numpy.polynomial import chebyshev, legendre

from harnack.fields.multipoles.radial_kernel import Radial, RadialKernel

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real

GRADIENT = 1.1855
"""Half the largest gradient of a dipole in four dimensions, times D^3: it serves for Q_2."""

# Degrees of the polynomial for the last i_n in single and double precision: the singularity at
# c = -1 makes coefficients fall as 5.8^-k.
_DEGREES = {4: 12, 8: 22}


class SlicedKernel(RadialKernel):
    """(4/pi) K(r, w) on a backend, at a height w > 0."""

    def __init__(self, backend: Backend, height: float) -> None:
        self.height = dr.opaque(backend.Float, height)
        self.height_square = dr.opaque(backend.Float, height * height)
        self._degree = _DEGREES[np.dtype(backend.dtype).itemsize]

    def at(self, distance: Real, inverse: Real, last: int) -> Radial:
        del distance
        c = self.height * inverse
        s2 = dr.fma(-c, c, 1)
        moment = _horner(dr.fma(2, c, -1), last_moment(last + 1, self._degree))
        thetas = [_factor(last) * moment]
        for k in range(last, 0, -1):
            moment = dr.fma(2 * k * s2, moment, c) * (1 / (2 * k - 1))
            thetas.insert(0, _factor(k - 1) * moment)
        return Radial(inverse, thetas)

    def bounds(self, distance: Real, last: int) -> list[Real]:
        del distance
        return [GRADIENT, *(1.0 for _ in range(3, last + 1))]

    def growth(self, r: Real) -> Real:
        del r
        return 1.0

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        return accuracy * radius + 1e-5


@functools.cache
def last_moment(n: int, degree: int) -> tuple[float, ...]:
    """i_n as a polynomial in 2c - 1 on [-1, 1], coefficients from the constant on."""
    t, weight = legendre.leggauss(48)
    t, weight = 0.5 * (t + 1), 0.5 * weight

    def moment(x: FloatArray) -> FloatArray:
        phi = np.arccos(0.5 * (x + 1))[:, None]
        ratio = np.sin(phi * t) / np.sin(phi)
        return phi[:, 0] / np.sin(phi[:, 0]) * (ratio ** (2 * n - 2) @ weight)

    nodes = chebyshev.chebpts1(2 * degree)
    series = chebyshev.chebfit(nodes, moment(nodes), degree)
    return tuple(float(one) for one in chebyshev.cheb2poly(series))


def _horner(x: Real, coefficients: tuple[float, ...]) -> Real:
    out: Real = coefficients[-1]
    for one in coefficients[-2::-1]:
        out = dr.fma(out, x, one)
    return out


def _factor(k: int) -> float:
    """(2/pi) 2^k k!."""
    return 2 / math.pi * 2.0**k * math.factorial(k)
