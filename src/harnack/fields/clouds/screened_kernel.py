"""What a dipole, or a cluster of dipoles, adds to a screened winding number, and its bounds.

Kernel. K(rho) = exp(-kappa rho)/rho is the Yukawa potential: Delta K = kappa^2 K away from 0. With
psi_0 = K and psi_(k+1) = -psi_k'/rho one has psi_k = theta_k(kappa rho) exp(-kappa rho)/
rho^(2k+1), where theta_0 = 1, theta_1 = 1 + t, theta_k = (2k-1) theta_(k-1) + t^2 theta_(k-2) are
the reverse Bessel polynomials: sums of positive terms, which lose no digits for any t. A dipole m
at y = x + z gives

    -m.grad_y K = m.z psi_1 = (1 + kappa rho) exp(-kappa rho) m.z/rho^3,

and a polynomial P(z) times psi_k has the gradient grad P psi_k - P psi_(k+1) z and the Hessian
HP psi_k - (grad P z^T + z grad P^T) psi_(k+1) - P psi_(k+1) I + P psi_(k+2) z z^T (in z; the
gradient in x has the opposite sign).

Bound. |d^m K[u_1, ..., u_m]| <= |K^(m)(rho)| for unit vectors: a derivative of K along a line is no
larger than along the line to its pole. Proof: d^m K is a symmetric form, so equal vectors u are the
worst (Banach 1938). Write s^m as sum_j b_mj P_j(s) in Legendre polynomials, b_mj >= 0; then
(u.grad)^m = sum_j b_mj |grad|^(m-j) Y_j(grad) with j = m, m-2, ... and solid harmonics Y_j about u.
On K, |grad|^2 is kappa^2, and Y_j(grad) K = (-1)^j psi_j Y_j(z) = (-1)^j rho^j psi_j P_j(cos)
(Hobson 1892). Every coefficient has the sign (-1)^m, and |P_j| <= 1 = P_j(1).

    |K^(m)(rho)| = m! Q_m(kappa rho)/rho^(m+1),   Q_m(t) = exp(-t) sum_(j<=m) t^j/j!,

decreases in rho, as K is completely monotone; Q_m decreases from 1 to 0 and grows with m.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.enclosures import Curvature, HarmonicBall
from harnack.fields.sums import SUM_ROUNDING, FieldSums, Terms
from harnack.fields.symmetric import SymmetricSum

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, Mask, Real, Vec3


LONGEST = 80.0
"""Beyond this many screening lengths exponentials stay at exp(-80) = 2e-35, as single precision
cannot go on: bounds are then too large, and values off by less than 1e-33 area/(4 pi rho^2)."""

# Radii of curvature promises, in distances to the nearest dipole: each is the best somewhere.
_REACHES = (0.1, 0.25, 0.45)
# The ball of the harmonic certificate: it shrinks where the kernel falls fast.
_BALL, _SHRINK = 0.35, 0.1
# Pairs of points and dipoles looked at for the default level.
_PAIRS, _MOST_PROBES, _LEAST_PROBES = 8_000_000, 512, 24


@dataclass(frozen=True)
class Part:
    """A term P(z) psi_k: P, its gradient and Hessian, all times |z|^(-2k), k = 1, 2, 3 by place."""

    value: Real
    gradient: Vec3
    hessian: tuple[Real, ...] | None = None


@dataclass(frozen=True)
class ScreenedSums:
    """Sums over all dipoles, weights w_i = area_i/(4 pi), distances d_i, Q_m at kappa d_i.

    sums: value, derivatives and bounds; s4 and s5 are the sums of w Q_3/d^4 and w Q_3/d^5, which
        for an infinite length are those of `FieldSums`.
    steep, steeper: sums of w Q_2/d^3 and w Q_2/d^4.
    ClusterMoments add the bounds of their sums.
    """

    sums: FieldSums
    steep: Real
    steeper: Real

    @classmethod
    def zero(cls, backend: Backend, derivatives: int) -> ScreenedSums:
        """Of no dipoles; derivatives: as for `FieldSums.zero`."""
        zero = backend.Float(0)
        return cls(FieldSums.zero(backend, dr.inf, derivatives), zero, zero)

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> ScreenedSums:
        """From `parts`."""
        return cls(FieldSums.of(parts[0]), *parts[1:])

    def parts(self) -> tuple[Any, ...]:
        """In the order of the constructor, as loops want them."""
        return self.sums.parts(), self.steep, self.steeper

    def plus(self, source: Source, rounding: Real, active: Mask) -> ScreenedSums:
        """With one more dipole or cluster, where active.

        rounding: of a sum of so many terms, as part of the sum of their absolute values. That sum
        is at most the one of w Q_2/d^2; and 6 epsilon w Q_2/d^3 is what positions do.
        """
        tail, sums = source.tail, self.sums.plus(source.terms, active)
        steep = source.weight * tail.second * tail.cube
        bent = source.weight * tail.third * tail.cube * tail.inverse
        bounds = steep, steep * tail.inverse, bent, bent * tail.inverse
        errors = source.error, source.gradient_error, source.hessian_error
        steep, steeper, bent, more_bent, error, slope, second = (
            dr.select(active, one, 0) for one in (*bounds, *errors)
        )
        nearer, old = fmin(tail.distance, sums.free_distance), sums.second_truncation
        # Dr.Jit's epsilon is half the distance from 1 to the next number, ours is all of it.
        positions = 6 * 2 * float(dr.epsilon(steep))
        sums = dataclasses.replace(
            sums,
            truncation=sums.truncation + error,
            slope_truncation=sums.slope_truncation + slope,
            second_truncation=None if old is None else old + second,
            rounding=dr.fma(steep, dr.fma(rounding, tail.distance, positions), sums.rounding),
            free_distance=dr.select(active, nearer, sums.free_distance),
            s4=sums.s4 + bent,
            s5=sums.s5 + more_bent,
        )
        return ScreenedSums(sums, self.steep + steep, self.steeper + steeper)


@dataclass(frozen=True)
class Tail:
    """Q_2 and Q_3 at a distance, and its powers."""

    distance: Real
    inverse: Real
    cube: Real
    second: Real
    third: Real

    @classmethod
    def of(cls, distance: Real, inverse: Real, t: Real, decay: Real) -> Tail:
        """At t = kappa distance, decay = exp(-t)."""
        sum2 = dr.fma(t, dr.fma(t, 0.5, 1), 1)
        sum3 = dr.fma(t * t * t, 1 / 6, sum2)
        return cls(distance, inverse, inverse * inverse * inverse, decay * sum2, decay * sum3)


def _type_of(vector: object) -> Any:
    return type(vector)


def thetas(t: Real, last: int) -> list[Real]:
    """theta_0(t), ..., theta_last(t)."""
    square = t * t
    out: list[Real] = [1.0, 1 + t]
    for k in range(2, last + 1):
        out.append(dr.fma(square, out[k - 2], (2 * k - 1) * out[k - 1]))
    return out


def combine(
    parts: Sequence[Part], z: Vec3, inverse: Real, t: Real, decay: Real, derivatives: int
) -> Terms:
    """The sum of terms at z, inverse = 1/|z|, t = kappa |z|, decay = exp(-t).

    derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian. Powers of 1/|z| are
    spread over the factors, so that none overflows.
    """
    vector = _type_of(z)
    theta = thetas(t, len(parts) + derivatives)
    u2, scale = inverse * inverse, decay * inverse
    value, along, twice = 0.0, 0.0, 0.0
    gradient, slopes, matrix = vector(0), vector(0), [0.0] * 6
    for k, part in enumerate(parts, start=1):
        value = dr.fma(theta[k], part.value, value)
        if derivatives == 0:
            continue
        along = dr.fma(theta[k + 1], part.value, along)
        gradient = dr.fma(vector(theta[k]), part.gradient, gradient)
        if derivatives == 2:
            twice = dr.fma(theta[k + 2], part.value, twice)
            slopes = dr.fma(vector(theta[k + 1]), part.gradient, slopes)
            if part.hessian is not None:
                matrix = [dr.fma(theta[k], h, m) for h, m in zip(part.hessian, matrix, strict=True)]
    if derivatives == 0:
        return Terms(scale * value)
    along = along * u2
    first = scale * dr.fma(vector(along), z, -gradient)
    if derivatives < 2:
        return Terms(scale * value, first, None)
    rest = SymmetricSum(*(scale * m for m in matrix))
    across = dr.fma(vector(twice * u2), z, -2 * slopes)
    rest = rest.plus((scale * u2) * across, z)
    along = scale * along
    whole = dataclasses.replace(rest, xx=rest.xx - along, yy=rest.yy - along, zz=rest.zz - along)
    return Terms(scale * value, first, whole)


@dataclass(frozen=True)
class Source:
    """A dipole or a cluster seen from x, and how fast it changes.

    weight: of all its dipoles, which are no nearer than `tail` is for.
    error, gradient_error, hessian_error: of a cluster.
    """

    terms: Terms
    weight: Real
    tail: Tail
    error: Real = 0.0
    gradient_error: Real = 0.0
    hessian_error: Real = 0.0


def seen_dipole(row: Sequence[Real], x: Vec3, kappa: Real, derivatives: int) -> Source:
    """A dipole (position, moment, weight = |moment|, 0: eight numbers) from x. kappa = 1/length."""
    vector = _type_of(x)
    z, m = vector(row[0], row[1], row[2]) - x, vector(row[3], row[4], row[5])
    squared = dr.squared_norm(z)
    inverse = dr.rsqrt(squared)
    distance = squared * inverse
    t = fmin(kappa * distance, LONGEST)
    decay = dr.exp(-t)
    u2 = inverse * inverse
    part = Part(dr.dot(m, z) * u2, m * u2)
    terms = combine([part], z, inverse, t, decay, derivatives)
    return Source(terms, row[6], Tail.of(distance, inverse, t, decay))


def cluster_parts(c: Sequence[Real], z: Vec3, inverse: Real) -> list[Part]:
    """The parts of a cluster with coefficients c (`screened_tree.coefficients`), centre x + z.

    P_1 = c0.z + c3; P_2 = z.(A z + b); P_3 = C[z, z, z] with symmetric A, C.
    """
    vector = _type_of(z)
    u2 = inverse * inverse
    u4 = u2 * u2
    u6 = u4 * u2
    dipole, b = vector(c[0], c[1], c[2]), vector(c[10], c[11], c[12])
    axx, ayy, azz, axy, axz, ayz = c[4:10]
    az = _times((axx, ayy, azz, axy, axz, ayz), z)
    xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz = c[13:23]
    cz = tuple(
        dr.fma(i, z.x, dr.fma(j, z.y, k * z.z))
        for i, j, k in (
            (xxx, xxy, xxz), (xyy, yyy, yyz), (xzz, yzz, zzz),
            (xxy, xyy, xyz), (xxz, xyz, xzz), (xyz, yyz, yzz),
        )
    )  # fmt: skip
    czz = _times(cz, z)
    return [
        Part((dr.dot(dipole, z) + c[3]) * u2, dipole * u2),
        Part(
            dr.dot(az + b, z) * u4,
            dr.fma(2, az, b) * u4,
            tuple(2 * u4 * a for a in (axx, ayy, azz, axy, axz, ayz)),
        ),
        Part(dr.dot(czz, z) * u6, 3 * u6 * czz, tuple(6 * u6 * a for a in cz)),
    ]


def _times(matrix: Sequence[Real], z: Vec3) -> Vec3:
    """A symmetric matrix (xx, yy, zz, xy, xz, yz) times z."""
    xx, yy, zz, xy, xz, yz = matrix
    return _type_of(z)(
        dr.fma(xx, z.x, dr.fma(xy, z.y, xz * z.z)),
        dr.fma(xy, z.x, dr.fma(yy, z.y, yz * z.z)),
        dr.fma(xz, z.x, dr.fma(yz, z.y, zz * z.z)),
    )


def promises(
    screened: ScreenedSums, f: Real, gradient: Vec3, kappa: Real, size: Real, epsilon: float
) -> tuple[tuple[Curvature, ...], HarmonicBall]:
    """What `ScreenedWindingNumber` proves: how it bends, and a ball, which proves shorter steps.
    f, gradient: at the point, in units of `size`.

    Radii stay below 36 lengths, so that exp(kappa r) times sums in which exponentials are held at
    exp(-80) neither overflows nor grows.
    """
    out, sums = 1 + SUM_ROUNDING, screened.sums
    nearest = fmax(sums.free_distance * (1 - SUM_ROUNDING) - 8 * epsilon, 0)
    most = fmin(nearest, LONGEST / kappa)

    def bend(r: Real, share: float) -> Real:
        return 2 * out * dr.exp(kappa * r) * sums.remainder(share, r)

    known: list[Curvature] = []
    for share in _REACHES:
        r = share * most
        known.append(Curvature(bend(r, share) / (size * size), r * size))
    r = _BALL * most / dr.fma(_SHRINK * kappa, most, 1)
    chord = (1 / (1 - _BALL) ** 2 - 1 - 2 * _BALL) / _BALL**2
    moved = out * dr.exp(kappa * r) * r * dr.fma(chord * r, screened.steeper, 2 * screened.steep)
    slope = dr.norm(gradient) + sums.slope_truncation
    moved = fmin(moved, out * r * dr.fma(0.5 * r, bend(r, _BALL), slope))
    least = dr.cos(fmin(kappa * r, math.pi))
    ends = (f - moved, f + moved)
    products = [end * least for end in ends]
    lower, upper = fmin(ends[0], products[0]), fmax(ends[1], products[1])
    # A negative cosine turns the interval round.
    lower, upper = fmin(lower, products[1]), fmax(upper, products[0])
    return tuple(known), HarmonicBall(r * size, lower, upper, dimension=4)


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
