"""Sums of dipoles by a tree: far ones as multipoles, near ones one by one, with certificates."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmin
from harnack.fields.multipoles.far_clusters import Errors, FarClusters
from harnack.fields.multipoles.multipole import all_levels
from harnack.fields.multipoles.nearby import rounding_of_dipole
from harnack.fields.symmetric import SymmetricSum
from harnack.fields.unit_coordinates import epsilon_at
from harnack.tree import NO_PRIMITIVE, Node, build_hierarchy, for_each

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.batch import Values
    from harnack.fields.field import Sample
    from harnack.tree import Hierarchy
    from harnack.tree.hierarchy import FloatArray

_LEAF_SIZE, _ARITY = 8, 4
# Beside a point means within this part (of its area, in squared distance).
_BESIDE = 0.04


def hierarchy_of(points: FloatArray) -> Hierarchy:
    """Which of the points (n, 3) lie in which leaf."""
    return build_hierarchy(points, leaf_size=_LEAF_SIZE, arity=_ARITY)


@dataclass(frozen=True)
class DipoleTree:
    """sum_i m_i.(y_i - x)/|y_i - x|^3 on a backend; a record holds y_i, m_i and |m_i|."""

    clusters: FarClusters
    rounding: Real

    @classmethod
    def of(
        cls, backend: Backend, tree: Hierarchy, points: FloatArray, moments: FloatArray,
        accuracy: float,
    ) -> DipoleTree:  # fmt: skip
        """From points (n, 3) of size about one and moments (n, 3), area times normal.

        tree: `hierarchy_of` these points, or of where they were once.
        """
        levels = all_levels(tree, points[:, None], moments[:, None], points, points)
        weight = np.linalg.norm(moments, axis=1, keepdims=True)
        rows = tree.gather(np.concatenate([points, moments, weight], axis=1))
        empty = tree.slots == NO_PRIMITIVE
        rows[empty, :3] = np.broadcast_to(rows[:, :1, :3], (*empty.shape, 3))[empty]
        # Rounded terms, most of them of the size of their share of the whole, random in sign.
        area = float(weight.sum())
        rounding = backend.epsilon * (16 + math.sqrt(len(points)) / 8) * max(1.0, area)
        clusters = FarClusters.of(backend, tree, levels, rows, accuracy)
        return cls(clusters, dr.opaque(backend.Float, rounding))

    def at(self, x: Vec3, derivatives: int, closer: Real) -> Values:
        """Value and derivatives (as asked for) at x, `closer` as for `FarClusters.at`."""
        count, unit = len(dataclasses.fields(Errors)), epsilon_at(x)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            errors, (value, *rest) = Errors(*state[:count]), state[count:]
            inverse, one, slope, bend = _dipole(row, x, derivatives)
            closer, rounded = self._rounded(row, inverse, unit)
            # On a point itself, to rounding, nothing is known: its error is infinite.
            active_here = active & dr.isfinite(inverse)
            value = value + dr.select(active_here, one, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(active_here, slope, 0)
            if derivatives == 2:
                pairs = zip(rest[1:], bend, strict=True)
                rest[1:] = [old + dr.select(active_here, new, 0) for old, new in pairs]
            fourth = row[6] * dr.square(closer * closer)
            errors = dataclasses.replace(
                errors,
                rounding=errors.rounding + dr.select(active, rounded, 0),
                s4=errors.s4 + dr.select(active, fourth, 0),
                s5=errors.s5 + dr.select(active, fourth * closer, 0),
            )
            return *errors.parts(), value, *rest

        def leaf(node: Node, near: Mask, errors: Errors, sums: Any) -> tuple[Errors, Any]:
            state = for_each(node, near, add, (*errors.parts(), *sums))
            return Errors(*state[:count]), state[count:]

        errors, (value, *rest) = self.clusters.at(x, derivatives, leaf, closer)
        gradient = rest[0] if derivatives >= 1 else None
        hessian = SymmetricSum(*rest[1:7]) if derivatives == 2 else None
        return errors.values(1.0, unit, self.rounding, value, gradient, hessian)

    def _rounded(self, row: list[Real], inverse: Real, unit: Real) -> tuple[Real, Real]:
        """One over the distance to a dipole, less what rounding may have done to it, and what
        rounding may do to its value. Both are 0 for padding, infinite on the dipole itself."""
        near = dr.rcp(inverse) - 2 * unit
        closer = dr.select(near > 0, dr.rcp(near), dr.inf)
        rounded = rounding_of_dipole(row[6], closer, unit)
        some = row[6] > 0
        return dr.select(some, closer, 0), dr.select(some, rounded, 0)

    def sample(self, x: Vec3, detail: Real) -> Sample:
        """Value, gradient and certificate at x: see `nearby.Nearby.sample`."""
        vector, unit = self.clusters.backend.Array3f, epsilon_at(x)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, g, truncation, slope_truncation, rounding, clear, s4, s5, nearest = state
            inverse, one, slope, _ = _dipole(row, x, 1)
            near = dr.rcp(inverse)
            cube = dr.select(active, row[6] * (inverse * inverse * inverse), 0)
            # On a point itself, to 16 roundings, nothing is known, and `Nearby.sample` says so.
            rounded = rounding_of_dipole(row[6], fmin(inverse, dr.rcp(8 * unit)), unit)
            return (
                value + dr.select(active, one, 0),
                g + dr.select(active, slope, 0),
                truncation,
                slope_truncation,
                rounding + dr.select(active, rounded, 0),
                dr.select(active, fmin(near, clear), clear),
                dr.fma(cube, inverse, s4),
                dr.fma(cube * inverse, inverse, s5),
                dr.select(active & (near <= clear), vector(*row[3:6]), nearest),
            )

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return for_each(node, near, add, sums)

        found, (nearest,) = self.clusters.near(x, detail, leaf, (vector(0),))
        # Where one point's own field drowns the others', the surface has that point's normal; f
        # is larger on the other side.
        weight = dr.norm(nearest)
        beside = (found.clear * found.clear < _BESIDE * weight) & (weight > 0)
        normal = dr.select(beside, -nearest / weight, dr.normalize(found.gradient))
        return found.sample(1.0, unit, self.rounding, normal)


def _dipole(row: list[Real], x: Vec3, derivatives: int) -> tuple[Real, Real, Vec3, list[Real]]:
    """One over the distance to a dipole, its value, gradient (paper, Eq. 12 and 15) and Hessian
    (xx, yy, zz, xy, xz, yz).

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
        return u, value, vector(0), []
    gradient = (u * u2) * dr.fma(vector(3 * along * u2), z, -m)
    if derivatives == 1:
        return u, value, gradient, []
    # By the unit vector n = u z, so that powers of u do not overflow sooner than the result.
    n, four = u * z, 3 * (u2 * u2)
    along = dr.dot(m, n)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = [
        four * (5 * along * n[i] * n[j] - m[i] * n[j] - n[i] * m[j] - (along if i == j else 0))
        for i, j in pairs
    ]
    return u, value, gradient, hessian
