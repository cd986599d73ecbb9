"""The terms of a dipole, or of a cluster of dipoles, of a radial potential K(r) in a sum, and their
bounds.

With psi_0 = K and psi_(k+1) = -psi_k'/r a dipole m at y = x + z has the term -m.grad_y K = m.z
psi_1, and a polynomial P(z) times psi_k has the gradient grad P psi_k - P psi_(k+1) z and the
Hessian HP psi_k - (grad P z^T + z grad P^T) psi_(k+1) - P psi_(k+1) I + P psi_(k+2) z z^T (in z;
the gradient in x has the opposite sign). A `RadialKernel` defines K and bounds of its derivatives;
all else is shared by screened sums (`screened.YukawaKernel`), smoothed sums
(`smoothed.SmoothedKernel`) and slices of four dimensions (`morph_slice.SlicedKernel`).

Distances. A kernel may be regular at r = 0: it uses D = sqrt(r^2 + height^2) for all distances, the
distances in four dimensions to a point at that height over the space of the dipoles. Its bounds are
|d^m K[u_1, ..., u_m]| <= m! Q_m/D^(m+1) for unit vectors u_i, with Q_m at most 1, growing with m,
and falling with D if not constant.
"""

from __future__ import annotations

import abc
import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmin
from harnack.enclosures import TaylorRemainder
from harnack.fields.batched_fields import SymmetricMatrix
from harnack.fields.source_sums import SUM_MARGIN, SourceSums, SourceTerm

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3


# Radii of the `TaylorRemainder` promises, in distances to the nearest dipole: each proves the
# longest steps for some rays.
_REACHES = (0.1, 0.25, 0.45)
# `RadialSums.variation` holds within this fraction of the distance to the nearest dipole.
BALL_FRACTION = 0.35


@dataclass(frozen=True)
class KernelValues:
    """A kernel at a distance D: psi_k = scale thetas[k]/D^(2k), for k from 0 to the requested
    order."""

    scale: Real
    thetas: Sequence[Real]


class RadialKernel(abc.ABC):
    """A radial potential K on a backend, for sums over dipoles and their trees.

    height_square: the square of the height of the points over the space of the dipoles; 0 for
        points of that space.
    """

    height_square: Real = 0.0

    @abc.abstractmethod
    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """psi_0 to psi_last at a distance D; inverse: 1/D."""

    @abc.abstractmethod
    def bounds(self, distance: Real, last: int) -> list[Real]:
        """Q_2 to Q_last, at least Q_3, which hold at all distances from `distance` on; last is at
        most 6."""

    @abc.abstractmethod
    def growth(self, r: Real) -> Real:
        """The factor by which Q_m may be larger at a distance shorter by r."""

    @abc.abstractmethod
    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """The distances D from which on the moments of clusters of these radii are used."""


@dataclass(frozen=True)
class PolynomialTerm:
    """A term P(z) psi_k: P, its gradient and its Hessian, all times D^(-2k); k = 1, 2, 3 is its
    position in a list."""

    value: Real
    gradient: Vec3
    hessian: tuple[Real, ...] | None = None


@dataclass(frozen=True)
class RadialSums:
    """Sums over all dipoles with weights w_i = |m_i| and distances d_i, with Q_m at d_i; clusters
    add bounds of the sums over their dipoles.

    sums: value, derivatives and bounds; s4 and s5 are the sums of w Q_3/d^4 and w Q_3/d^5, which
        for Q_3 = 1 are those of `SourceSums`.
    q2_d3, q2_d4: sums of w Q_2/d^3 and w Q_2/d^4.
    """

    sums: SourceSums
    q2_d3: Real
    q2_d4: Real

    @classmethod
    def zero(cls, backend: Backend, derivatives: int) -> RadialSums:
        """The sums over no dipoles; derivatives: as for `SourceSums.zero`."""
        zero = backend.Float(0)
        return cls(SourceSums.zero(backend, dr.inf, derivatives), zero, zero)

    @classmethod
    def of(cls, parts: tuple[Any, ...]) -> RadialSums:
        """The sums with these `parts`."""
        return cls(SourceSums.from_state(parts[0]), *parts[1:])

    def parts(self) -> tuple[Any, ...]:
        """The attributes in the order of the constructor, for the state of a loop."""
        return self.sums.to_state(), self.q2_d3, self.q2_d4

    def plus(self, source: SourceAtPoint, rounding: Real, active: Mask) -> RadialSums:
        """The sums with a further dipole or cluster, where active.

        rounding: the rounding of the term, as a fraction of w Q_2/d^2, which is at least its
            absolute value. The rounding of positions adds 6 epsilon w Q_2/d^3;
            `SourceSums.add_term` counts the rounding of the sum.
        """
        tail, sums = source.tail, self.sums.add_term(source.terms, active)
        q2_d3 = source.weight * tail.second * tail.cube
        q3_d4 = source.weight * tail.third * tail.cube * tail.inverse
        bounds = q2_d3, q2_d3 * tail.inverse, q3_d4, q3_d4 * tail.inverse
        errors = source.error, source.gradient_error, source.hessian_error
        q2_d3, q2_d4, q3_d4, q3_d5, error, slope, second = (
            dr.select(active, bound, 0) for bound in (*bounds, *errors)
        )
        nearest, old = fmin(tail.distance, sums.singularity_distance), sums.hessian_truncation
        # Dr.Jit's epsilon is half the distance from 1 to the next number; the epsilon of the bounds
        # is the whole distance.
        shift = 6 * 2 * float(dr.epsilon(q2_d3))
        sums = dataclasses.replace(
            sums,
            truncation=sums.truncation + error,
            gradient_truncation=sums.gradient_truncation + slope,
            hessian_truncation=None if old is None else old + second,
            rounding=dr.fma(q2_d3, dr.fma(rounding, tail.distance, shift), sums.rounding),
            singularity_distance=dr.select(active, nearest, sums.singularity_distance),
            s4=sums.s4 + q3_d4,
            s5=sums.s5 + q3_d5,
        )
        return RadialSums(sums, self.q2_d3 + q2_d3, self.q2_d4 + q2_d4)

    def remainder(self, fraction: float, r: Real, growth: Real) -> Real:
        """A bound of |f(y) - f(x) - grad f.(y-x)|/|y-x|^2 for |y-x| <= r, with r at most `fraction`
        times the distance to the nearest dipole; growth: the growth of the kernel for r.

        Each term's second derivatives are at most |K^(3)| = 6 Q_3/(d_i-s)^4 at distance s from x,
        and by Taylor the integral of (t-s) times that bounds the term's remainder, t = |y-x|. With
        t/d_i = q it is at most growth Q_3 (3-2q)/(1-q)^2 t^2/d_i^4; (3-2q)/(1-q)^2 is convex, hence
        below its chord on [0, share].
        """
        return (1 + SUM_MARGIN) * growth * self.sums.remainder(fraction, r)

    def curvatures(
        self, growth: Callable[[Real], Real], nearest: Real, size: Real
    ) -> tuple[TaylorRemainder, ...]:
        """`remainder` as promises, in units of `size`; nearest: a lower bound of the distance to
        the nearest dipole."""
        radii = [(fraction, fraction * nearest) for fraction in _REACHES]
        return tuple(
            TaylorRemainder(2 * self.remainder(fraction, r, growth(r)) / (size * size), r * size)
            for fraction, r in radii
        )

    def variation(self, r: Real, growth: Real) -> Real:
        """A bound of |f(y) - f(x)| on B(x, r), with r at most `BALL_FRACTION` times the distance to
        the nearest dipole. It is the integral of |K^(2)| = 2 Q_2/(d_i-s)^3, where 1/(1-q)^2 - 1 =
        2q + ... is convex as well."""
        chord = (1 / (1 - BALL_FRACTION) ** 2 - 1 - 2 * BALL_FRACTION) / BALL_FRACTION**2
        change = dr.fma(chord * r, self.q2_d4, 2 * self.q2_d3)
        return (1 + SUM_MARGIN) * growth * r * change


@dataclass(frozen=True)
class KernelBounds:
    """Q_2 and Q_3 that hold at a distance and beyond, and powers of that distance."""

    distance: Real
    inverse: Real
    cube: Real
    second: Real
    third: Real

    @classmethod
    def of(cls, distance: Real, inverse: Real, bounds: Sequence[Real]) -> KernelBounds:
        """The bounds at a distance; bounds: Q_2, Q_3, ... there."""
        return cls(distance, inverse, inverse * inverse * inverse, bounds[0], bounds[1])


def _type_of(vector: object) -> Any:
    return type(vector)


def combine_terms(
    parts: Sequence[PolynomialTerm], z: Vec3, inverse: Real, radial: KernelValues, derivatives: int
) -> SourceTerm:
    """The sum of terms at z, inverse = 1/D, with psi_0 to psi_(len(parts) + derivatives).

    derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian.

    Powers of 1/D are spread over the factors, so that no factor overflows.
    """
    vector = _type_of(z)
    theta, scale, u2 = radial.thetas, radial.scale, inverse * inverse
    value, radial_part, second_part = 0.0, 0.0, 0.0
    gradient, gradients, matrix = vector(0), vector(0), [0.0] * 6
    for k, part in enumerate(parts, start=1):
        value = dr.fma(theta[k], part.value, value)
        if derivatives == 0:
            continue
        radial_part = dr.fma(theta[k + 1], part.value, radial_part)
        gradient = dr.fma(vector(theta[k]), part.gradient, gradient)
        if derivatives == 2:
            second_part = dr.fma(theta[k + 2], part.value, second_part)
            gradients = dr.fma(vector(theta[k + 1]), part.gradient, gradients)
            if part.hessian is not None:
                matrix = [dr.fma(theta[k], h, m) for h, m in zip(part.hessian, matrix, strict=True)]
    if derivatives == 0:
        return SourceTerm(scale * value)
    radial_part = radial_part * u2
    slope = scale * dr.fma(vector(radial_part), z, -gradient)
    if derivatives < 2:
        return SourceTerm(scale * value, slope, None)
    hessian = SymmetricMatrix(*(scale * m for m in matrix))
    row = dr.fma(vector(second_part * u2), z, -2 * gradients)
    hessian = hessian.add_outer_product((scale * u2) * row, z)
    radial_part = scale * radial_part
    total = dataclasses.replace(
        hessian,
        xx=hessian.xx - radial_part,
        yy=hessian.yy - radial_part,
        zz=hessian.zz - radial_part,
    )
    return SourceTerm(scale * value, slope, total)


@dataclass(frozen=True)
class SourceAtPoint:
    """The terms of a dipole or a cluster at x, with bounds of its derivatives near x.

    weight: the sum of the weights of all its dipoles.
    tail: bounds of the kernel at a lower bound of the distance to its nearest dipole.
    error, gradient_error, hessian_error: the truncation errors of a cluster.
    """

    terms: SourceTerm
    weight: Real
    tail: KernelBounds
    error: Real = 0.0
    gradient_error: Real = 0.0
    hessian_error: Real = 0.0


def dipole_source(
    row: Sequence[Real], x: Vec3, kernel: RadialKernel, derivatives: int
) -> SourceAtPoint:
    """A dipole at x, from eight numbers (position, moment, weight = |moment|, 0)."""
    vector = _type_of(x)
    z, m = vector(row[0], row[1], row[2]) - x, vector(row[3], row[4], row[5])
    squared = dr.squared_norm(z) + kernel.height_square
    inverse = dr.rsqrt(squared)
    distance = squared * inverse
    u2 = inverse * inverse
    part = PolynomialTerm(dr.dot(m, z) * u2, m * u2)
    terms = combine_terms(
        [part], z, inverse, kernel.at(distance, inverse, 1 + derivatives), derivatives
    )
    return SourceAtPoint(
        terms, row[6], KernelBounds.of(distance, inverse, kernel.bounds(distance, 3))
    )


def cluster_parts(c: Sequence[Real], z: Vec3, inverse: Real) -> list[PolynomialTerm]:
    """The terms of a cluster with coefficients c (`radial_tree.coefficients`) and center x + z;
    inverse = 1/D.

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
        PolynomialTerm((dr.dot(dipole, z) + c[3]) * u2, dipole * u2),
        PolynomialTerm(
            dr.dot(az + b, z) * u4,
            dr.fma(2, az, b) * u4,
            tuple(2 * u4 * a for a in (axx, ayy, azz, axy, axz, ayz)),
        ),
        PolynomialTerm(dr.dot(czz, z) * u6, 3 * u6 * czz, tuple(6 * u6 * a for a in cz)),
    ]


def _times(matrix: Sequence[Real], z: Vec3) -> Vec3:
    """A symmetric matrix (xx, yy, zz, xy, xz, yz) times z."""
    xx, yy, zz, xy, xz, yz = matrix
    return _type_of(z)(
        dr.fma(xx, z.x, dr.fma(xy, z.y, xz * z.z)),
        dr.fma(xy, z.x, dr.fma(yy, z.y, yz * z.z)),
        dr.fma(xz, z.x, dr.fma(yz, z.y, zz * z.z)),
    )
