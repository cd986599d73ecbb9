"""Sums of dipoles by a tree: far ones as multipoles, near ones one by one, with certificates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmin
from harnack.fields.edge_hessian import SymmetricSum
from harnack.fields.field import HarmonicBall, Sample
from harnack.fields.multipole import all_levels
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.winding_tree import node_columns
from harnack.tree import NO_PRIMITIVE, Node, PackedTree, build_hierarchy, for_each, pack, walk

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.hierarchy import FloatArray

_REACH, _ROUNDING = 0.5, 2e-5
_LEAF_SIZE, _ARITY = 8, 4
# Beside a point means within this part (of its area, in squared distance).
_BESIDE = 0.04


@dataclass(frozen=True)
class DipoleTree:
    """sum_i m_i.(y_i - x)/|y_i - x|^3 on a backend; a record holds y_i, m_i and |m_i|."""

    backend: Backend
    tree: PackedTree
    accuracy: float
    rounding: float

    @classmethod
    def of(
        cls, backend: Backend, points: FloatArray, moments: FloatArray, accuracy: float
    ) -> DipoleTree:
        """From points (n, 3) of size about one and moments (n, 3), area times normal."""
        tree = build_hierarchy(points, leaf_size=_LEAF_SIZE, arity=_ARITY)
        levels = all_levels(tree, points[:, None], moments[:, None], points, points)
        nodes = [node_columns(level, accuracy, 2) for level in levels]
        weight = np.linalg.norm(moments, axis=1, keepdims=True)
        rows = tree.gather(np.concatenate([points, moments, weight], axis=1))
        empty = tree.slots == NO_PRIMITIVE
        rows[empty, :3] = np.broadcast_to(rows[:, :1, :3], (*empty.shape, 3))[empty]
        # Rounded terms, most of them of the size of their share of the whole, random in sign.
        area = float(weight.sum())
        rounding = backend.epsilon * (16 + math.sqrt(len(points)) / 8) * max(1.0, area)
        return cls(backend, pack(backend, tree, nodes, rows), accuracy, rounding)

    def at(self, x: Vec3, derivatives: int) -> tuple[Any, ...]:
        """Value, gradient and Hessian's parts (as asked for), and the truncation bound, last."""
        real, vector = self.backend.Float, self.backend.Array3f
        zero = SymmetricSum.zero(real).parts()
        sums: tuple[Any, ...] = (vector(0), *zero)[: (0, 1, 7)[derivatives]]

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            error, value, *rest = state
            r, length, far = _far(node, x)
            inverse = dr.select(far, dr.rcp(length), 0)
            c = node.payload(far)
            terms = far_terms(c, r, inverse, derivatives)
            error = dr.fma(c[15], inverse * (inverse * inverse) ** 2, error)
            value = value + dr.select(far, terms.value, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(far, terms.gradient, 0)
            if derivatives == 2 and terms.hessian is not None:
                pairs = zip(rest[1:], terms.hessian.parts(), strict=True)
                rest[1:] = [old + dr.select(far, new, 0) for old, new in pairs]
            near = ~far & node.is_leaf
            return ~far, (error, *for_each(node, near, add, (value, *rest)))

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, *rest = state
            one, slope, bend = _dipole(row, x, derivatives)
            value = value + dr.select(active, one, 0)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(active, slope, 0)
            if derivatives == 2:
                pairs = zip(rest[1:], bend, strict=True)
                rest[1:] = [old + dr.select(active, new, 0) for old, new in pairs]
            return value, *rest

        error, *rest = walk(self.tree, visit, (real(0), real(0), *sums))
        return *rest, error

    def sample(self, x: Vec3) -> Sample:
        """Value, gradient and certificate at x.

        Certificate. Let r = D/2, with D the least distance to near points and of r - R over far
        nodes. A dipole a at rho >= D has a gradient of at most 2a/rho^3, so that on B(x, r) it
        moves f by at most a ((rho-r)^-2 - rho^-2) <= a (2r/rho^3 + 8r^2/rho^4), because
        (1-t)^-2 - 1 - 2t <= 8t^2 for t <= 1/2. `node_columns` bounds the sums over far nodes.
        """
        real, vector = self.backend.Float, self.backend.Array3f

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            value, g, error, slope_error, clear, s1, s2, nearest = state
            r, length, far = _far(node, x)
            c = node.payload(far)
            inverse = dr.select(far, dr.rcp(length), 0)
            terms = far_terms(c, r, inverse, 1)
            cube = inverse * inverse * inverse
            decay = cube * inverse * inverse
            apart = dr.fma(node.head[3], -1 / self.accuracy, length)
            state = (
                value + dr.select(far, terms.value, 0),
                g + dr.select(far, terms.gradient, 0),
                dr.fma(c[15], decay, error),
                dr.fma(node.head[4], decay * inverse, slope_error),
                dr.select(far, fmin(apart, clear), clear),
                dr.fma(node.head[5], cube, s1),
                dr.fma(node.head[5], cube * inverse, s2),
                nearest,
            )
            return ~far, for_each(node, ~far & node.is_leaf, add, state)

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            value, g, error, slope_error, clear, s1, s2, nearest = state
            one, slope, _ = _dipole(row, x, 1)
            near = dr.norm(vector(*row[:3]) - x)
            cube = dr.select(active, row[6] / (near * near * near), 0)
            return (
                value + dr.select(active, one, 0),
                g + dr.select(active, slope, 0),
                error,
                slope_error,
                dr.select(active, fmin(near, clear), clear),
                s1 + cube,
                s2 + cube / near,
                dr.select(active & (near <= clear), vector(*row[3:6]), nearest),
            )

        start = (real(0), vector(0), real(0), real(0), real(dr.inf), real(0), real(0), vector(0))
        return self._certified(*walk(self.tree, visit, start))

    def _certified(
        self, value: Real, g: Vec3, error: Real, slope_error: Real, clear: Real, s1: Real,
        s2: Real, nearest: Vec3,
    ) -> Sample:  # fmt: skip
        epsilon = self.backend.epsilon
        distance = clear * (1 - _ROUNDING) - 8 * epsilon
        r = _REACH * distance
        variation = 2 * r * (s1 + 4 * r * s2) * (1 + _ROUNDING)
        ball = HarmonicBall(r, value - variation, value + variation)
        # On a point itself all values meet: a gradient that says so.
        apart = (clear > 16 * epsilon) & dr.isfinite(value) & dr.isfinite(dr.squared_norm(g))
        steep = self.backend.Array3f(0, 0, 4 * math.pi / (8 * epsilon))
        # Where one point's own field drowns the others', the surface has that point's normal; f
        # is larger on the other side.
        weight = dr.norm(nearest)
        beside = (clear * clear < _BESIDE * weight) & (weight > 0)
        normal = dr.select(beside, -nearest / weight, dr.normalize(g))
        return Sample(
            dr.select(apart, value, 0),
            dr.select(apart, g, steep),
            (ball,),
            error + self.rounding,
            dr.select(apart, slope_error, 0),
            normal,
        )


def _far(node: Node, x: Vec3) -> tuple[Vec3, Real, Mask]:
    r = x - type(x)(*node.head[:3])
    length = dr.norm(r)
    return r, length, length > node.head[3]


def _dipole(row: list[Real], x: Vec3, derivatives: int) -> tuple[Real, Vec3, list[Real]]:
    """One dipole's value, gradient (paper, Eq. 12 and 15) and Hessian (xx, yy, zz, xy, xz, yz).

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
        return value, vector(0), []
    gradient = (u * u2) * dr.fma(vector(3 * along * u2), z, -m)
    if derivatives == 1:
        return value, gradient, []
    five = 3 * u * u2 * u2
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    hessian = [
        five * (5 * along * u2 * z[i] * z[j] - m[i] * z[j] - z[i] * m[j] - (along if i == j else 0))
        for i, j in pairs
    ]
    return value, gradient, hessian
