"""Sums of dipoles by a tree: far ones as multipoles, near ones one by one, with certificates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmin
from harnack.fields.far_clusters import FarClusters
from harnack.fields.multipole import all_levels
from harnack.fields.nearby import rounding_of_dipole
from harnack.tree import NO_PRIMITIVE, Node, build_hierarchy, for_each

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
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
    rounding: float

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
        return cls(FarClusters.of(backend, tree, levels, rows, accuracy), rounding)

    def at(self, x: Vec3, derivatives: int) -> tuple[Any, ...]:
        """Value, gradient and Hessian's parts (as asked for), and a bound of the value's error:
        of truncation and of rounding, last."""
        real = self.clusters.backend.Float

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, *rest, rounded = state
            inverse, one, slope, bend = _dipole(row, x, derivatives)
            value = value + dr.select(active, one, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(active, slope, 0)
            if derivatives == 2:
                pairs = zip(rest[1:], bend, strict=True)
                rest[1:] = [old + dr.select(active, new, 0) for old, new in pairs]
            more = dr.select(active, rounding_of_dipole(row[6], inverse), 0)
            return value, *rest, rounded + more

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return for_each(node, near, add, sums)

        *sums, rounded, error = self.clusters.at(x, derivatives, leaf, (real(0),))
        return *sums, dr.fma(self.clusters.backend.epsilon, rounded, error + self.rounding)

    def sample(self, x: Vec3, fine: Mask) -> Sample:
        """Value, gradient and certificate at x: see `nearby.Nearby.sample`."""
        vector, real = self.clusters.backend.Array3f, self.clusters.backend.Float
        epsilon = self.clusters.backend.epsilon

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, g, error, slope_error, clear, s4, s5, rounded, nearest = state
            inverse, one, slope, _ = _dipole(row, x, 1)
            near = dr.rcp(inverse)
            cube = dr.select(active, row[6] * (inverse * inverse * inverse), 0)
            return (
                value + dr.select(active, one, 0),
                g + dr.select(active, slope, 0),
                error,
                slope_error,
                dr.select(active, fmin(near, clear), clear),
                dr.fma(cube, inverse, s4),
                dr.fma(cube * inverse, inverse, s5),
                rounded + dr.select(active, rounding_of_dipole(row[6], inverse), 0),
                dr.select(active & (near <= clear), vector(*row[3:6]), nearest),
            )

        def leaf(node: Node, near: Mask, sums: tuple[Any, ...]) -> tuple[Any, ...]:
            return for_each(node, near, add, sums)

        found, (rounded, nearest) = self.clusters.near(x, fine, leaf, (real(0), vector(0)))
        # Where one point's own field drowns the others', the surface has that point's normal; f
        # is larger on the other side.
        weight = dr.norm(nearest)
        beside = (found.clear * found.clear < _BESIDE * weight) & (weight > 0)
        normal = dr.select(beside, -nearest / weight, dr.normalize(found.gradient))
        rounded = dr.select(dr.isfinite(rounded), epsilon * rounded, 0)
        return found.sample(1.0, self.rounding + rounded, normal)


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
    five = 3 * u * u2 * u2
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = [
        five * (5 * along * u2 * z[i] * z[j] - m[i] * z[j] - z[i] * m[j] - (along if i == j else 0))
        for i, j in pairs
    ]
    return u, value, gradient, hessian
