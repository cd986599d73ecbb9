"""Sums of dipoles by a tree: far ones as multipoles, near ones one by one, with certificates."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.fields.multipoles.dipole_records import dipole_rows, in_slots
from harnack.fields.multipoles.far_clusters import Treecode
from harnack.fields.multipoles.multipole import all_levels
from harnack.fields.sums import FieldSums, Terms, rounding_of_dipole, rounding_of_sum
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.fields.batch import Values
    from harnack.fields.field import Sample
    from harnack.tree import Hierarchy

# Beside a point means within this part (of its area, in squared distance).
_BESIDE = 0.04


@dataclass(frozen=True)
class DipoleTree:
    """sum_i m_i.(y_i - x)/|y_i - x|^3 on a backend; a record holds y_i, m_i and |m_i|."""

    clusters: Treecode
    rounding: Real

    @property
    def backend(self) -> Backend:
        """The one it lies on."""
        return self.clusters.backend

    @classmethod
    def of(
        cls, backend: Backend, tree: Hierarchy, points: FloatArray, moments: FloatArray,
        accuracy: float,
    ) -> DipoleTree:  # fmt: skip
        """From points (n, 3) of size about one and moments (n, 3), area times normal.

        tree: `hierarchy_of` these points, or of where they were once.
        """
        levels = all_levels(tree, points[:, None], moments[:, None], points, points)
        rows = dipole_rows(points, moments)
        # Rounded terms, most of them of the size of their share of the whole, random in sign.
        share = max(1.0, float(rows[:, 6].sum()))
        rounding = rounding_of_sum(backend, len(points), 16, growth=1 / 8, size=share)
        clusters = Treecode.of(backend, tree, levels, in_slots(tree, rows), accuracy)
        return cls(clusters, rounding)

    def at(self, x: Vec3, derivatives: int, closer: Real) -> Values:
        """Value and derivatives (as asked for) at x; closer: the detail, at least 1."""
        unit, detail = epsilon_at(x), fmax(self.backend.Float(closer), self.backend.Float(1))
        sums, _ = self._sums(x, detail, unit, derivatives)
        return self.clusters.values(sums, 1.0, unit, self.rounding)

    def _sums(self, x: Vec3, detail: Real, unit: Real, derivatives: int) -> tuple[FieldSums, Vec3]:
        """All sums, and the moment of the nearest dipole of a near leaf."""
        vector = self.backend.Array3f

        def add(
            row: list[Real], active: Mask, sums: FieldSums, own: tuple[Any, ...]
        ) -> tuple[FieldSums, tuple[Any, ...]]:
            inverse, terms = _dipole(row, x, derivatives)
            distance, some = dr.rcp(inverse), active & (row[6] > 0)
            # A bound of one over the distance less what rounding may have done to it, 2 unit:
            # 1/(1-z) <= 1 + 2z for z <= 1/2. Nearer to a dipole nothing is known, and all bounds
            # are infinite. Padding has no area and no bounds.
            z = 2 * unit * inverse
            closer = dr.select(z <= 0.5, dr.fma(2 * z, inverse, inverse), dr.inf)
            closer = dr.select(some, closer, 0)
            fourth = row[6] * dr.square(closer * closer)
            nearer = some & (distance <= sums.free_distance)
            new = dataclasses.replace(
                sums.plus(terms, active & (inverse < dr.inf)),
                rounding=sums.rounding + rounding_of_dipole(row[6], closer, unit),
                free_distance=dr.select(nearer, distance, sums.free_distance),
                s4=sums.s4 + fourth,
                s5=dr.fma(fourth, closer, sums.s5),
            )
            return new, (dr.select(nearer, vector(*row[3:6]), own[0]),)

        sums, own = self.clusters.sums(x, detail, add, (vector(0),), derivatives=derivatives)
        return sums, own[0]

    def sample(self, x: Vec3, detail: Real) -> Sample:
        """Value, gradient and certificate at x: see `FieldSums.sample`."""
        unit = epsilon_at(x)
        found, nearest = self._sums(x, detail, unit, 1)
        # Where one point's own field drowns the others', the surface has that point's normal; f
        # is larger on the other side.
        weight = dr.norm(nearest)
        beside = (found.free_distance * found.free_distance < _BESIDE * weight) & (weight > 0)
        normal = dr.select(beside, -nearest / weight, dr.normalize(found.gradient))
        return found.sample(1.0, unit, self.rounding, normal)


def _dipole(row: list[Real], x: Vec3, derivatives: int) -> tuple[Real, Terms]:
    """One over the distance to a dipole, and its value, gradient (paper, Eq. 12 and 15) and
    Hessian, as far as they are asked for.

    With z = y - x and u = 1/|z|: f = m.z u^3, grad f = 3 (m.z) u^5 z - m u^3, and
    Hess f = 15 (m.z) u^7 z z^T - 3 u^5 (m z^T + z m^T + (m.z) I).
    """
    vector = cast("Any", type(x))
    z, m = vector(*row[:3]) - x, vector(*row[3:6])
    u = dr.rsqrt(dr.squared_norm(z))
    u2 = u * u
    along = dr.dot(m, z)
    value = along * u * u2
    if derivatives == 0:
        return u, Terms(value)
    gradient = (u * u2) * dr.fma(vector(3 * along * u2), z, -m)
    if derivatives == 1:
        return u, Terms(value, gradient)
    # By the unit vector n = u z, so that powers of u do not overflow sooner than the result.
    n, four = u * z, 3 * (u2 * u2)
    along = dr.dot(m, n)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = (
        four * (5 * along * n[i] * n[j] - m[i] * n[j] - n[i] * m[j] - (along if i == j else 0))
        for i, j in pairs
    )
    return u, Terms(value, gradient, SymmetricSum(*hessian))
