"""Sums over smoothed dipoles, for clouds of oriented points with noise: the field of a point has no
singularity there. rho is the distance from a dipole, h the smoothing length and D = sqrt(rho^2 +
h^2). The kernel is K = 1/D + h^2/(2 D^3); psi_0 = K, psi_(k+1) = -psi_k'/rho, and the numbers Q_m
bound its m-th derivatives, by m! Q_m/D^(m+1).

- `SmoothedKernel`: the kernel, with the proof of its bounds.
- `SmoothedSum`: the sum by a tree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.fields.field import Sample
from harnack.fmm.point_values import PointValues
from harnack.fmm.radial_kernel import KernelValues, RadialKernel
from harnack.fmm.radial_tree import (
    ClusteredDipoles,
    RadialTreecode,
    taylor_tree_moments,
)
from harnack.fmm.unit_frame import coordinate_rounding

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.tree import BalancedTree

# Bounds of the kernel for a distance hold at all distances of at least this fraction of it, because
# promises hold on balls of up to 0.45 of the distance (`radial_kernel`).
_BOUND_FRACTION = 0.55


class SmoothedKernel(RadialKernel):
    """The kernel K = 1/D + h^2/(2 D^3) on a backend, where rho is the distance from a dipole, h the
    smoothing length and D = sqrt(rho^2 + h^2). psi_0 = K, psi_(k+1) = -psi_k'/rho. The numbers Q_m
    bound derivatives of K: the m-th derivative along lines is at most m! Q_m/D^(m+1).

    Kernel. K consists of the first two terms of 1/rho = (D^2 - h^2)^(-1/2) in powers of h^2. It has

        psi_k = (2k-1)!! (1 + (2k+1) q/2)/D^(2k+1),   q = h^2/D^2,

    sums of positive terms; a dipole m at y = x + z gives -m.grad_y K = m.z (rho^2 + 5 h^2/2)/D^5.
    Since Laplacian D^p = p D^(p-2) (p + 1 - (p-2) q) in three dimensions, -Laplacian K/(4 pi) = 15
    h^4/(8 pi D^7). This is positive, with integral 1 and second moment 3 h^2/2. So a sum over these
    dipoles is the sum over plain dipoles, averaged with this weight. (The kernel 1/D has the weight
    3 h^2/(4 pi D^5), which has an infinite second moment: at equal noise its surfaces were farther
    off.)

    Bound. |d^m K[u_1, ..., u_m]| <= m! Q_m/D^(m+1), Q_m = 1 + q (m+1)(m+2)/4, for unit vectors.
    Proof. Equal vectors u are the worst (Banach 1938). D is the length of Z = (z, h), and along a
    line in direction u at an angle phi from Z 1/|Z + t u|^(2 l) is the generating function of
    Gegenbauer's polynomials: its m-th derivative is m! C_m^l(-cos phi)/D^(m + 2 l), at most m!
    C_m^l(1)/D^(m + 2 l). That is m!/D^(m+1) for l = 1/2, and m! (m+1)(m+2)/(2 D^(m+3)) for l = 3/2.
    As D >= h always, q <= 1. The bounds at a distance hold from 0.55 of it on, so that proved
    bounds on balls, which reach up to 0.45 of it, need no growth factor (`growth`).
    """

    def __init__(self, backend: Backend, height: float) -> None:
        """Upload the kernel. height: the smoothing length h, in the unit of the distances."""
        self.height_square = dr.opaque(backend.Float, height * height)

    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """The values psi_0, ..., psi_last of the class docstring at the distance D, by their closed
        form psi_k = (2k-1)!! (1 + (2k+1) q/2)/D^(2k+1) with q = h^2/D^2.

        distance, inverse: D and 1/D. Only 1/D is used.
        last: the largest index k.
        """
        del distance
        half_q = 0.5 * self.height_square * inverse * inverse
        thetas: list[Real] = []
        double_factorial = 1.0  # (2k-1)!!
        for k in range(last + 1):
            thetas.append(dr.fma((2 * k + 1) * double_factorial, half_q, double_factorial))
            double_factorial *= 2 * k + 1
        # First the factor that all psi_k have in common, beside the powers 1/D^(2k).
        return KernelValues(inverse, thetas)

    def bounds(self, distance: Real, last: int) -> list[Real]:
        """The numbers Q_2, ..., Q_last, which bound derivatives of the kernel: Q_m = 1 + q
        (m+1)(m+2)/4 with q = h^2/D^2. They hold at all distances D of at least 0.55
        (`_BOUND_FRACTION`) times `distance`. last: the largest index m."""
        # h/D at the least of these distances; its square is q. D is at least h, so that q <= 1.
        ratio = dr.sqrt(self.height_square) / (_BOUND_FRACTION * fmax(distance, 1e-30))
        q = fmin(ratio * ratio, 1)
        return [dr.fma(0.25 * (m + 1) * (m + 2), q, 1) for m in range(2, last + 1)]

    def growth(self, r: Real) -> Real:
        """The factor by which the numbers Q_m of `bounds` may grow if the distance shrinks by r: 1,
        because `bounds` already holds at shorter distances."""
        del r
        return 1.0

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """The distances (k,) beyond which k clusters of dipoles may be replaced by their moments:
        `accuracy` times their radii, which are given as `radius` (k,)."""
        return accuracy * radius + 1e-5  # not 0 for a cluster of radius 0


@dataclass(frozen=True)
class SmoothedSum:
    """The sum f of m_i.z_i (rho_i^2 + 5 h^2/2)/(rho_i^2 + h^2)^(5/2) over smoothed dipoles, at
    points x. m_i is the moment of the dipole at y_i, z_i = y_i - x, rho_i = |z_i|, and h is the
    smoothing length. The accuracy scale of an evaluation is a factor: larger is more accurate.

    dipoles: the sum by a tree.
    """

    dipoles: RadialTreecode

    @classmethod
    def of(
        cls, backend: Backend, tree: BalancedTree, rows: FloatArray, height: float, accuracy: float
    ) -> SmoothedSum:
        """Upload the dipoles and their tree.

        tree: the result of `dipole_hierarchy` for their points, or for the same points at earlier
            positions.
        rows: (n, 8) the records of the dipoles, from `dipole_records`.
        height: the smoothing length h, in the units of the dipoles.
        accuracy: the moments of a node are used beyond this many times its radius.
        """
        clustered = ClusteredDipoles(rows, tree, taylor_tree_moments(tree, rows))
        return cls(RadialTreecode(backend, clustered, SmoothedKernel(backend, height), accuracy))

    @property
    def coarsest_accuracy(self) -> float:
        """The smallest accuracy scale that makes a difference (`VariableAccuracy.coarsest`): 1."""
        return 1.0

    def values(self, x: Vec3, derivatives: int, closer: Real) -> PointValues:
        """f and its derivatives up to order `derivatives` at points x (3, n), with error bounds.
        closer: the accuracy scale; larger is more accurate. Values below 1 count as 1."""
        return self.dipoles.sums(x, closer, derivatives).values(x)

    def sample(self, x: Vec3, detail: Real) -> Sample:
        """A sample of f at points x: value, gradient, errors and proved bounds of second
        derivatives near x. detail: the accuracy scale; larger is more accurate."""
        # radial: with gradients, and with sums for bounds near x. sums: value, gradient and errors.
        radial = self.dipoles.sums(x, detail, 1)
        sums = radial.sums
        epsilon = self.dipoles.backend.machine_epsilon
        # Bounds of second derivatives need no growth factor for this kernel (`SmoothedKernel`), and
        # no scaling, since lengths stay in the unit of x.
        return Sample(
            sums.value,
            sums.gradient,
            radial.curvatures(lambda r: 1.0, radial.least_distance, 1.0),
            sums.truncation + sums.rounding + 8 * epsilon * dr.abs(sums.value),
            sums.gradient_error(coordinate_rounding(x)),
            truncation_error=sums.truncation,
        )
