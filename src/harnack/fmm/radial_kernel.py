"""Terms of dipoles and of clusters of dipoles in a sum, with bounds, for a potential that depends
only on the distance: the *kernel* K(r). A *dipole* is an oriented point y with a vector m, its
*moment*; its weight is |m|. At the point x it adds -m.grad_y K(|y - x|). A *cluster* of far dipoles
is added as a single source. f is the sum over all dipoles. psi_0 = K, psi_1, psi_2, ... are
functions of the distance, with psi_(k+1) = -psi_k'/r. The numbers Q_2, Q_3, ... bound the
derivatives of K: the m-th derivative along lines is at most m! Q_m/D^(m+1) at the distance D. D is
r, or sqrt(r^2 + height^2) if the kernel has a height.

A dipole m at y = x + z adds -m.grad_y K = m.z psi_1. A polynomial P(z) times psi_k has the gradient
grad P psi_k - P psi_(k+1) z and, with the Hessian HP of P, the Hessian HP psi_k - (grad P z^T + z
grad P^T) psi_(k+1) - P psi_(k+1) I + P psi_(k+2) z z^T. These are derivatives in z; the gradient in
x has the opposite sign. A `RadialKernel` defines K and bounds of its derivatives. All else is
shared by screened sums (`screened.YukawaKernel`), smoothed sums (`smoothed.SmoothedKernel`) and
slices of four dimensions (`morph_slice.SlicedKernel`).

Distances. A kernel may be regular at r = 0. Then it uses D = sqrt(r^2 + height^2) for all
distances: the distance in four dimensions to a point at that height above the space of the dipoles.
Its bounds are |d^m K[u_1, ..., u_m]| <= m! Q_m/D^(m+1) for the m-th derivative in the directions of
unit vectors u_i. The numbers Q_m are at most 1, unless the kernel says otherwise, grow with m, and
are constant or fall with D.
"""

from __future__ import annotations

import abc
import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures import TaylorRemainder
from harnack.fmm.point_values import LoopRecord, PointValues, SymmetricMatrix
from harnack.fmm.source_sums import SUM_MARGIN, SourceSums, SourceTerm
from harnack.fmm.unit_frame import coordinate_rounding

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3


# Radii of the `TaylorRemainder` promises, as fractions of the distance to the nearest dipole. Each
# of them proves the longest steps for some rays.
_RADIUS_FRACTIONS = (0.1, 0.25, 0.45)
# `RadialSums.variation` holds within this fraction of the distance to the nearest dipole.
BALL_FRACTION = 0.35


@dataclass(frozen=True)
class KernelValues:
    """The functions psi_0 = K, psi_1, ... of a kernel K at a distance D, where psi_(k+1) =
    -psi_k'/r. They are stored without their large powers of D.

    scale: a common factor.
    thetas: one number for each k: psi_k is scale * thetas[k]/D^(2k).
    """

    scale: Real
    thetas: Sequence[Real]


class RadialKernel(abc.ABC):
    """A radial potential K on a backend, the kernel of a sum over dipoles: its values, and bounds
    of its derivatives. K is a function of the distance D, and psi_0 = K, psi_(k+1) = -psi_k'/r.

    height_square: the square of the height of the points above the space of the dipoles, in four
        dimensions; 0 for points of that space.
    """

    height_square: Real = 0.0

    @abc.abstractmethod
    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """The values psi_0 to psi_last at the distance D = `distance`, where psi_0 = K and
        psi_(k+1) = -psi_k'/r. inverse: 1/D. last: the largest index."""

    @abc.abstractmethod
    def bounds(self, distance: Real, last: int) -> list[Real]:
        """The numbers Q_2, Q_3, ..., Q_last, but at least Q_2 and Q_3, which bound derivatives: the
        m-th derivatives of K along lines are at most m! Q_m/D^(m+1) at all distances D >=
        `distance`.

        last: the largest index m; at most 6.
        """

    @abc.abstractmethod
    def growth(self, r: Real) -> Real:
        """A factor c that bounds how the numbers Q_m of `bounds` grow as the distance shrinks: at
        the distance D - r they are at most c times as large as at D."""

    @abc.abstractmethod
    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """The distances (k,) beyond which k clusters of dipoles may be replaced by their moments.
        radius: (k,) the radii of the clusters. accuracy: the larger it is, the larger are the
        distances."""


@dataclass(frozen=True)
class PolynomialTerm:
    """The polynomial P in a term P(z) psi_k of a source, evaluated at the vector z from a point to
    the source. k = 1, 2, 3 is the position of the term in the source's list of terms.

    value, gradient, hessian: P, its gradient and its Hessian (xx, yy, zz, xy, xz, yz) by z, all
        times D^(-2k), with D the distance of the source. The Hessian is None if it is 0.
    """

    value: Real
    gradient: Vec3
    hessian: tuple[Real, ...] | None = None


@dataclass(frozen=True)
class RadialSums(LoopRecord):
    """Sums over all dipoles i at a point x: the value f, its derivatives, and sums from which
    bounds near x are computed. w_i = |m_i| is the weight of a dipole and d_i its distance from x.
    For a cluster, bounds of the sums over its dipoles are added. The numbers Q_2 and Q_3 bound
    second and third derivatives of the kernel (see the module).

    sums: value, derivatives and error bounds. Here s4 and s5 are the sums of w_i Q_3/d_i^4 and w_i
        Q_3/d_i^5, with Q_3 at d_i; for Q_3 = 1 these are those of `SourceSums`.
    q2_d3, q2_d4: the sums of w_i Q_2/d_i^3 and w_i Q_2/d_i^4, with Q_2 at d_i.
    """

    sums: SourceSums
    q2_d3: Real
    q2_d4: Real

    @classmethod
    def zero(cls, backend: Backend, derivatives: int) -> RadialSums:
        """The sums over no dipoles, to which dipoles can be added. derivatives: 0 for the value
        only, 1 with the gradient, 2 with the Hessian."""
        zero = backend.Float(0)
        return cls(SourceSums.zero(backend, dr.inf, derivatives), zero, zero)

    def plus(self, source: SourceAtPoint, rounding: Real, active: Mask) -> RadialSums:
        """The sums with a further dipole or cluster, `source`, added on active lanes.

        rounding: a bound of the rounding of the source's term, as a fraction of w Q_2/d^2. That
            number is at least the term's absolute value, with the source's weight w and distance d.
            The rounding of positions adds 6 epsilon w Q_2/d^3; `SourceSums.add_term` counts the
            rounding of the sum.
        """
        tail, sums = source.tail, self.sums.add_term(source.terms, active)
        # tail.second and tail.third are Q_2 and Q_3, tail.inverse and tail.cube 1/d and 1/d^3. What
        # the source adds to q2_d3, q2_d4, s4 and s5; then 0 on lanes that are not active.
        q2_d3 = source.weight * tail.second * tail.cube
        q3_d4 = source.weight * tail.third * tail.cube * tail.inverse
        bounds = q2_d3, q2_d3 * tail.inverse, q3_d4, q3_d4 * tail.inverse
        errors = source.error, source.gradient_error, source.hessian_error
        q2_d3, q2_d4, q3_d4, q3_d5, error, slope, second = (
            dr.select(active, bound, 0) for bound in (*bounds, *errors)
        )
        nearest, old_second = (
            fmin(tail.distance, sums.singularity_distance),
            sums.hessian_truncation,
        )
        # Dr.Jit's epsilon is half the distance from 1 to the next number; the epsilon of the bounds
        # is the whole distance.
        shift = 6 * 2 * float(dr.epsilon(q2_d3))
        sums = dataclasses.replace(
            sums,
            truncation=sums.truncation + error,
            gradient_truncation=sums.gradient_truncation + slope,
            hessian_truncation=None if old_second is None else old_second + second,
            rounding=dr.fma(q2_d3, dr.fma(rounding, tail.distance, shift), sums.rounding),
            singularity_distance=dr.select(active, nearest, sums.singularity_distance),
            s4=sums.s4 + q3_d4,
            s5=sums.s5 + q3_d5,
        )
        return RadialSums(sums, self.q2_d3 + q2_d3, self.q2_d4 + q2_d4)

    def values(self, x: Vec3) -> PointValues:
        """The value at the points x of these sums, and those of its derivatives that were summed,
        with error bounds."""
        rounding = 16 * float(dr.epsilon(self.q2_d3)) * dr.abs(self.sums.value)
        return self.sums.values(1.0, coordinate_rounding(x), rounding)

    @property
    def least_distance(self) -> Real:
        """A lower bound of the distance to the nearest dipole, also after rounding."""
        distance = self.sums.singularity_distance * (1 - SUM_MARGIN)
        return fmax(distance - 16 * float(dr.epsilon(self.q2_d3)), 0)

    def remainder(self, share: float, r: Real, growth: Real) -> Real:
        """A bound of |f(y) - f(x) - grad f.(y-x)|/|y-x|^2 for |y-x| <= r.

        share: r must be at most `share` times the distance to the nearest dipole.
        growth: a factor >= 1 by which Q_3 may grow where distances from dipoles shrink by up to r
            (`RadialKernel.growth`).

        Proof. At distance s from x, each term's second derivatives are at most w_i times
        |K^(3)| = 6 Q_3/(d_i-s)^4, where Q_3 is at most growth times its value at x. By Taylor the
        integral of (t-s) times that, with t = |y-x|, bounds the term's remainder. With q = t/d_i it
        is at most growth w_i Q_3 (3-2q)/(1-q)^2 t^2/d_i^4. (3-2q)/(1-q)^2 is convex in q, and so at
        most its chord on [0, share].
        """
        # With the chord's values, the sum over i follows from s4 and s5, the sums of
        # w_i Q_3/d_i^4 and of w_i Q_3/d_i^5.
        return (1 + SUM_MARGIN) * growth * self.sums.remainder(share, r)

    def curvatures(
        self, growth: Callable[[Real], Real], least_distance: Real, size: Real
    ) -> tuple[TaylorRemainder, ...]:
        """Proved bounds of second derivatives of f on balls around x, one for each of several
        radii. By `remainder`, each bounds the difference between f and f's linear Taylor polynomial
        at x.

        growth: the function `RadialKernel.growth`: for a radius r, a bound of the factor by which
            the numbers Q_m grow if distances shrink by r.
        least_distance: a lower bound of the distance to the nearest dipole.
        size: the length, in the user's unit, that is 1 in the coordinates of the sums. The results
            are in the user's unit.
        """
        radii = [(fraction, fraction * least_distance) for fraction in _RADIUS_FRACTIONS]
        # The constant of a `TaylorRemainder` is twice the bound of the remainder over |y-x|^2.
        return tuple(
            TaylorRemainder(2 * self.remainder(fraction, r, growth(r)) / (size * size), r * size)
            for fraction, r in radii
        )

    def variation(self, r: Real, growth: Real) -> Real:
        """A bound of |f(y) - f(x)| on the ball B(x, r). r must be at most `BALL_FRACTION` times the
        distance to the nearest dipole. growth: a factor >= 1 by which Q_2 may grow where distances
        from dipoles shrink by up to r (`RadialKernel.growth`).

        It is the sum over the dipoles of w_i times the integral of |K^(2)| = 2 Q_2/(d_i-s)^3 over s
        from 0 to r. With q = r/d_i the integral is Q_2/d_i^2 times 1/(1-q)^2 - 1 = 2q + c q^2. The
        factor c grows with q, and so is at most its value at q = `BALL_FRACTION`.
        """
        c = (1 / (1 - BALL_FRACTION) ** 2 - 1 - 2 * BALL_FRACTION) / BALL_FRACTION**2
        # q2_d3, q2_d4: the sums of w_i Q_2/d_i^3 and of w_i Q_2/d_i^4.
        change = dr.fma(c * r, self.q2_d4, 2 * self.q2_d3)
        return (1 + SUM_MARGIN) * growth * r * change


@dataclass(frozen=True)
class KernelBounds:
    """A distance from a dipole, and numbers that bound the derivatives of a kernel K there and
    beyond: the m-th derivatives along lines are at most m! Q_m/D^(m+1) at distances D.

    distance, inverse, cube: the distance, one over it, and one over its cube.
    second, third: Q_2 and Q_3.
    """

    distance: Real
    inverse: Real
    cube: Real
    second: Real
    third: Real

    @classmethod
    def of(cls, distance: Real, inverse: Real, bounds: Sequence[Real]) -> KernelBounds:
        """The bounds at a distance. inverse: one over the distance. bounds: Q_2, Q_3, ... at this
        distance."""
        return cls(distance, inverse, inverse * inverse * inverse, bounds[0], bounds[1])


def _type_of(vector: object) -> Any:
    """The type of a vector, by which other vectors of this type are made."""
    return type(vector)


def combine_terms(
    parts: Sequence[PolynomialTerm], z: Vec3, inverse: Real, radial: KernelValues, derivatives: int
) -> SourceTerm:
    """The potential of a source (a dipole or a cluster) at a point, and its derivatives by the
    point: the sum of the terms P_k(z) psi_k.

    parts: the polynomials P_k for k = 1, 2, ...
    z: the vector from the point to the source.
    inverse: 1/D, with D the distance from the point to the source.
    radial: the numbers psi_0 to psi_(len(parts) + derivatives) at the distance D.
    derivatives: 0 for the value, 1 with the gradient, 2 with the Hessian.

    A term P psi_k has the gradient grad P psi_k - P psi_(k+1) z by z, and the Hessian HP psi_k -
    (grad P z^T + z grad P^T) psi_(k+1) - P psi_(k+1) I + P psi_(k+2) z z^T, with the Hessian HP of
    P. The gradient by the point has the opposite sign. So the same sums over k occur with psi_k,
    psi_(k+1) and psi_(k+2); the latter two are called `next` and `after_next` in the code. The
    common factor `scale` and powers of 1/D, which `parts` and `radial` leave out, are multiplied at
    the end, so that no factor overflows.
    """
    # theta[k], scale: psi_k without its powers of D, and the factor that all psi_k have in common.
    vector = _type_of(z)
    theta, scale, u2 = radial.thetas, radial.scale, inverse * inverse
    value, next_value, after_next_value = 0.0, 0.0, 0.0
    gradient, next_gradient, matrix = vector(0), vector(0), [0.0] * 6
    for k, part in enumerate(parts, start=1):
        value = dr.fma(theta[k], part.value, value)
        if derivatives == 0:
            continue
        next_value = dr.fma(theta[k + 1], part.value, next_value)
        gradient = dr.fma(vector(theta[k]), part.gradient, gradient)
        if derivatives == 2:
            after_next_value = dr.fma(theta[k + 2], part.value, after_next_value)
            next_gradient = dr.fma(vector(theta[k + 1]), part.gradient, next_gradient)
            if part.hessian is not None:
                matrix = [dr.fma(theta[k], h, m) for h, m in zip(part.hessian, matrix, strict=True)]
    if derivatives == 0:
        return SourceTerm(scale * value)
    next_value = next_value * u2
    slope = scale * dr.fma(vector(next_value), z, -gradient)
    if derivatives < 2:
        return SourceTerm(scale * value, slope, None)
    hessian = SymmetricMatrix(*(scale * m for m in matrix))
    # The outer product of this vector with z, made symmetric, gives the terms with z z^T and with
    # grad P z^T.
    left_factor = dr.fma(vector(after_next_value * u2), z, -2 * next_gradient)
    hessian = hessian.add_outer_product((scale * u2) * left_factor, z)
    next_value = scale * next_value
    # The term -P psi_(k+1) I.
    total = dataclasses.replace(
        hessian,
        xx=hessian.xx - next_value,
        yy=hessian.yy - next_value,
        zz=hessian.zz - next_value,
    )
    return SourceTerm(scale * value, slope, total)


@dataclass(frozen=True)
class SourceAtPoint:
    """What a source, a dipole or a cluster of dipoles, adds to a sum f at a point x, with bounds of
    its derivatives near x.

    terms: value, gradient and Hessian.
    weight: the sum of the weights |m| of its dipoles.
    tail: bounds of the kernel's derivatives at a lower bound of the distance to its nearest dipole.
    error, gradient_error, hessian_error: bounds of the truncation errors of a cluster; 0 for a
        dipole.
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
    """What a dipole adds at points x to the sum f: value and derivatives, with bounds.

    row: the dipole's record of eight numbers: position, moment, weight = |moment|, and 0.
    kernel: the radial potential.
    derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
    """
    vector = _type_of(x)
    z, m = vector(row[0], row[1], row[2]) - x, vector(row[3], row[4], row[5])
    squared = dr.squared_norm(z) + kernel.height_square
    inverse = dr.rsqrt(squared)
    distance = squared * inverse
    u2 = inverse * inverse
    # P_1 = m.z and its gradient, divided by D^2; its Hessian is 0.
    part = PolynomialTerm(dr.dot(m, z) * u2, m * u2)
    terms = combine_terms(
        [part], z, inverse, kernel.at(distance, inverse, 1 + derivatives), derivatives
    )
    # `kernel.bounds` returns Q_2 and Q_3.
    return SourceAtPoint(
        terms, row[6], KernelBounds.of(distance, inverse, kernel.bounds(distance, 3))
    )


def cluster_parts(c: Sequence[Real], z: Vec3, inverse: Real) -> list[PolynomialTerm]:
    """The polynomials P_k of a cluster of dipoles, for k = 1, 2, 3. The cluster is added as the sum
    of P_k(z) psi_k, where z is the vector from the point to the cluster's center. Each P_k is
    returned with its gradient and Hessian, all divided by D^(2k); `combine_terms` makes up for
    that.

    c: the 23 coefficients of the cluster (`radial_tree.coefficients`).
    inverse: 1/D, with D the distance of the center.

    P_1 = c0.z + c3; P_2 = z.(A z + b); P_3 = C[z, z, z] with symmetric A, C, where c0 is `c[0:3]`,
    c3 is `c[3]`, and A, b and C are the following coefficients.
    """
    vector = _type_of(z)
    u2 = inverse * inverse
    u4 = u2 * u2
    u6 = u4 * u2
    c0, b = vector(c[0], c[1], c[2]), vector(c[10], c[11], c[12])
    axx, ayy, azz, axy, axz, ayz = c[4:10]
    az = _times((axx, ayy, azz, axy, axz, ayz), z)
    xxx, yyy, zzz, xxy, xxz, xyy, yyz, xzz, yzz, xyz = c[13:23]
    # The matrix C[z] as (xx, yy, zz, xy, xz, yz), then the vector C[z, z].
    cz = tuple(
        dr.fma(i, z.x, dr.fma(j, z.y, k * z.z))
        for i, j, k in (
            (xxx, xxy, xxz), (xyy, yyy, yyz), (xzz, yzz, zzz),
            (xxy, xyy, xyz), (xxz, xyz, xzz), (xyz, yyz, yzz),
        )
    )  # fmt: skip
    czz = _times(cz, z)
    return [
        PolynomialTerm((dr.dot(c0, z) + c[3]) * u2, c0 * u2),
        PolynomialTerm(
            dr.dot(az + b, z) * u4,
            dr.fma(2, az, b) * u4,
            tuple(2 * u4 * a for a in (axx, ayy, azz, axy, axz, ayz)),
        ),
        PolynomialTerm(dr.dot(czz, z) * u6, 3 * u6 * czz, tuple(6 * u6 * a for a in cz)),
    ]


def _times(matrix: Sequence[Real], z: Vec3) -> Vec3:
    """The product of the vector z with a symmetric matrix (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = matrix
    return _type_of(z)(
        dr.fma(xx, z.x, dr.fma(xy, z.y, xz * z.z)),
        dr.fma(xy, z.x, dr.fma(yy, z.y, yz * z.z)),
        dr.fma(xz, z.x, dr.fma(yz, z.y, zz * z.z)),
    )
