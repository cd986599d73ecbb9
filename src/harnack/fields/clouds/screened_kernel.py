"""The screened (Yukawa) potential as a kernel of radial sums: its derivatives, and their bounds.

Kernel. K(rho) = exp(-kappa rho)/rho is the Yukawa potential: Delta K = kappa^2 K away from 0. With
psi_0 = K and psi_(k+1) = -psi_k'/rho one has psi_k = theta_k(kappa rho) exp(-kappa rho)/
rho^(2k+1), where theta_0 = 1, theta_1 = 1 + t, theta_k = (2k-1) theta_(k-1) + t^2 theta_(k-2) are
the reverse Bessel polynomials: sums of positive terms, which lose no digits for any t. A dipole m
at y = x + z gives

    -m.grad_y K = m.z psi_1 = (1 + kappa rho) exp(-kappa rho) m.z/rho^3.

Bound. |d^m K[u_1, ..., u_m]| <= |K^(m)(rho)| for unit vectors: a derivative of K along a line is no
larger than along the line to its pole. Proof: d^m K is a symmetric form, so equal vectors u are the
worst (Banach 1938). Write s^m as sum_j b_mj P_j(s) in Legendre polynomials, b_mj >= 0; then
(u.grad)^m = sum_j b_mj |grad|^(m-j) Y_j(grad) with j = m, m-2, ... and solid harmonics Y_j about u.
On K, |grad|^2 is kappa^2, and Y_j(grad) K = (-1)^j psi_j Y_j(z) = (-1)^j rho^j psi_j P_j(cos)
(Hobson 1892). Every coefficient has the sign (-1)^m, and |P_j| <= 1 = P_j(1).

    |K^(m)(rho)| = m! Q_m(kappa rho)/rho^(m+1),   Q_m(t) = exp(-t) sum_(j<=m) t^j/j!,

decreases in rho, as K is completely monotone; Q_m decreases from 1 to 0 and grows with m, and
Q_m(t - s) <= exp(s) Q_m(t).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.enclosures import Curvature, HarmonicBall
from harnack.fields.multipoles.radial_kernel import BALL, Radial, RadialKernel, RadialSums
from harnack.fields.sums import SUM_ROUNDING

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3


LONGEST = 80.0
"""Beyond this many screening lengths exponentials stay at exp(-80) = 2e-35, as single precision
cannot go on: bounds are then too large, and values off by less than 1e-33 area/(4 pi rho^2)."""

# The ball of the harmonic certificate shrinks where the kernel falls fast.
_SHRINK = 0.1
# A cluster is never taken as a whole nearer than this many radii.
_LEAST = 1.5
# Pairs of points and dipoles looked at for the default level.
_PAIRS, _MOST_PROBES, _LEAST_PROBES = 8_000_000, 512, 24


class YukawaKernel(RadialKernel):
    """exp(-kappa r)/r on a backend; kappa: one over the screening length."""

    def __init__(self, backend: Backend, kappa: float) -> None:
        self._number = kappa
        self.kappa = dr.opaque(backend.Float, kappa)

    def at(self, distance: Real, inverse: Real, last: int) -> Radial:
        t = fmin(self.kappa * distance, LONGEST)
        return Radial(dr.exp(-t) * inverse, thetas(t, last))

    def bounds(self, distance: Real, last: int) -> list[Real]:
        t = fmin(self.kappa * distance, LONGEST)
        decay = dr.exp(-t)
        sum2 = dr.fma(t, dr.fma(t, 0.5, 1), 1)
        sum3 = dr.fma(t * t * t, 1 / 6, sum2)
        out = [decay * sum2, decay * sum3]
        power = decay * (t * t * t)
        for m in range(4, last + 1):
            power = power * t
            out.append(dr.fma(power, 1 / math.factorial(m), out[-1]))
        return out

    def growth(self, r: Real) -> Real:
        return dr.exp(self.kappa * r)

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        return accepting_distance(radius, self._number, accuracy)


def thetas(t: Real, last: int) -> list[Real]:
    """theta_0(t), ..., theta_last(t)."""
    square = t * t
    out: list[Real] = [1.0, 1 + t]
    for k in range(2, last + 1):
        out.append(dr.fma(square, out[k - 2], (2 * k - 1) * out[k - 1]))
    return out


def promises(
    radial: RadialSums, f: Real, gradient: Vec3, kernel: YukawaKernel, size: Real, epsilon: float
) -> tuple[tuple[Curvature, ...], HarmonicBall]:
    """What `ScreenedWindingNumber` proves: how it bends, and a ball, which proves shorter steps.
    f, gradient: at the point, in units of `size`.

    Radii stay below 36 lengths, so that exp(kappa r) times sums in which exponentials are held at
    exp(-80) neither overflows nor grows.
    """
    sums, kappa = radial.sums, kernel.kappa
    nearest = fmax(sums.free_distance * (1 - SUM_ROUNDING) - 8 * epsilon, 0)
    most = fmin(nearest, LONGEST / kappa)
    known = radial.curvatures(kernel.growth, most, size)
    r = BALL * most / dr.fma(_SHRINK * kappa, most, 1)
    growth = kernel.growth(r)
    slope = dr.norm(gradient) + sums.slope_truncation
    bent = (1 + SUM_ROUNDING) * r * dr.fma(r, radial.remainder(BALL, r, growth), slope)
    moved = fmin(radial.variation(r, growth), bent)
    least = dr.cos(fmin(kappa * r, math.pi))
    ends = (f - moved, f + moved)
    products = [end * least for end in ends]
    lower, upper = fmin(ends[0], products[0]), fmax(ends[1], products[1])
    # A negative cosine turns the interval round.
    lower, upper = fmin(lower, products[1]), fmax(upper, products[0])
    return known, HarmonicBall(r * size, lower, upper, dimension=4)


def accepting_distance(radius: FloatArray, kappa: float, accuracy: float) -> FloatArray:
    """From where on a cluster is taken as a whole: accuracy R Q_4(kappa (r-R))^(1/5) <= r.

    Clusters of radius R on a surface cost 1/R^2 and err by R^3/r^5 Q_4 an area; the sum of errors
    is smallest at a given cost if R is proportional to r Q_4^(-1/5). Bisection, from the safe side.
    """
    low, high = _LEAST * radius, accuracy * radius
    for _ in range(40):
        r = 0.5 * (low + high)
        t = kappa * (r - radius)
        q4 = np.exp(-t) * (1 + t * (1 + t / 2 * (1 + t / 3 * (1 + t / 4))))
        good = accuracy * radius * q4**0.2 <= r
        low, high = np.where(good, low, r), np.where(good, r, high)
    return high + 1e-5


def mean_at_dipoles(rows: FloatArray, kappa: float) -> float:
    """The mean of w over (some of) the dipoles by weight, each without those at its own place."""
    n = len(rows)
    count = min(n, max(_LEAST_PROBES, min(_MOST_PROBES, _PAIRS // n)))
    probes = np.unique(np.linspace(0, n - 1, count).astype(np.int64))
    x, y, z, *moment = np.ascontiguousarray(rows[:, :6].T)
    values: list[float] = []
    for i in probes:
        d = (x - x[i], y - y[i], z - z[i])
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        apart = square > 0
        rho = np.sqrt(np.where(apart, square, 1))
        weight = np.where(apart, (1 + kappa * rho) * np.exp(-kappa * rho) / rho**3, 0)
        along = moment[0] * d[0] + moment[1] * d[1] + moment[2] * d[2]
        values.append(float(along @ weight))
    return float(np.average(values, weights=rows[probes, 6]))
