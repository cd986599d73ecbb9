"""Sums over dipoles whose positions and moments move, and their gradients, as expressions that
Dr.Jit differentiates by points, positions and moments (`pair_sums`). Trees and cells are faster for
many dipoles, and have no derivatives by them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.fmm.pair_sums import pair_sum

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fmm.radial_kernel import RadialKernel
    from harnack.fmm.unit_frame import UnitFrame


@dataclass(frozen=True)
class MovingDipoles:
    """Dipoles in the unit coordinates of a field, whose positions and moments may have derivatives.

    frame: the unit coordinates. Their center and size are constants.
    kernel: the kernel K of the sum, in unit coordinates.
    numbers: the coordinates of the positions y_i, then of the moments m_i: six arrays of an entry
        for each dipole.

    With z = y_i - x, D^2 = |z|^2 + h^2, where h^2 is the `height_square` of the kernel, and psi_0 =
    K, psi_(k+1) = -psi_k'/D, a dipole adds the derivative of the kernel along its moment,

        f = -m.grad_y K(D) = m.z psi_1(D),   grad_x f = -m psi_1 + (m.z) psi_2 z,

    because grad_x psi_1(D) = psi_1' grad_x D = psi_1' (-z/D) = psi_2 z.
    """

    frame: UnitFrame
    kernel: RadialKernel
    numbers: tuple[Real, ...]

    @classmethod
    def of(
        cls, frame: UnitFrame, kernel: RadialKernel, points: Vec3, normals: Vec3, areas: Real
    ) -> MovingDipoles:
        """The dipoles of oriented points, in the user's coordinates.

        points, normals: (3, n), normals of any length, of which only the direction counts.
        areas: (n,) the factor of each unit normal in its moment, in the square of the user's unit.
        """
        vector, size = frame.backend.Array3f, frame.size
        unit = vector(normals) / dr.norm(vector(normals))
        moments = frame.backend.Float(areas) / (size * size) * unit
        return cls(frame, kernel, (*frame.to_unit(points), *moments))

    def value(self, p: Vec3) -> Real:
        """The sum (n,) at points p (3, n) of space."""

        def value(x: Vec3, numbers: tuple[Real, ...]) -> tuple[Real, ...]:
            """The term of one dipole."""
            z, moment, first, _ = self._at(x, numbers)
            return (dr.dot(moment, z) * first,)

        return pair_sum(self.frame.backend, value, self.frame.to_unit(p), self.numbers)[0]

    def gradient(self, p: Vec3) -> Vec3:
        """The gradient (3, n) of the sum at points p (3, n) of space."""

        def gradient(x: Vec3, numbers: tuple[Real, ...]) -> tuple[Real, ...]:
            """The term of one dipole."""
            z, moment, first, second = self._at(x, numbers)
            term = dr.dot(moment, z) * second * z - first * moment
            return term.x, term.y, term.z

        sums = pair_sum(self.frame.backend, gradient, self.frame.to_unit(p), self.numbers)
        return self.frame.backend.Array3f(*sums) / self.frame.size

    def _at(self, x: Vec3, numbers: tuple[Any, ...]) -> tuple[Vec3, Vec3, Real, Real]:
        """For a dipole with these numbers, at the point x: the vector z, the moment, and psi_1 and
        psi_2."""
        vector = self.frame.backend.Array3f
        z, moment = vector(*numbers[:3]) - x, vector(*numbers[3:])
        distance = dr.sqrt(dr.squared_norm(z) + self.kernel.height_square)
        inverse = 1 / distance
        # 2: up to psi_2.
        values, square = self.kernel.at(distance, inverse, 2), inverse * inverse
        first = values.scale * values.thetas[1] * square
        return z, moment, first, values.scale * values.thetas[2] * (square * square)
