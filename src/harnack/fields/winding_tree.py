"""Winding numbers by a tree: clusters of far triangles as multipoles, near ones exactly.

Barill et al. 2018 ("Fast winding numbers for soups and clouds") with orders 0 to 2, gradients and
Hessians from the same moments, a bound of what the truncation costs, and certificates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmin
from harnack.fields.edge_hessian import SymmetricSum
from harnack.fields.edge_lift import times
from harnack.fields.field import HarmonicBall, Sample
from harnack.fields.multipole import Level, cartesian, truncation
from harnack.fields.multipole_kernel import far_terms
from harnack.fields.triangle_kernel import NearTriangle
from harnack.tree import Node, PackedTree, for_each, pack, walk
from harnack.tree.triangles import EDGES, INDEX, NO_TRIANGLE, in_slots

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.sheets import Crossing
    from harnack.fields.winding_mesh import WindingMesh
    from harnack.tree.hierarchy import FloatArray
    from harnack.tree.triangles import Frame

_SHARE = 1 / (4 * math.pi)
_REACH, _ROUNDING = 0.5, 2e-5
# Columns of a record behind those of `tree.triangles`: 1 where an edge is singular.
_SINGULAR = EDGES + 3


def node_columns(level: Level, accuracy: float, order: int) -> FloatArray:
    """Numbers of nodes as the walks below read them.

    centre, accepting distance, gradient error G, V | 15 coefficients, value error E. A node is
    taken as a whole beyond `accuracy` times its radius. V bounds sums over its dipoles there,
    sum a/rho^3 <= V/r^3 and sum a/rho^4 <= V/r^4: with q = radius/r, the second derivative of
    rho^-p is at most p(p+1) ((1-q) r)^-(p+2) and the first moment about the centre vanishes, so
    sum a rho^-p <= r^-p (area + p(p+1)/2 spread/((1-q)^(p+2) r^2)); p = 4 is the larger.
    """
    accept = accuracy * level.radius
    value, slope = truncation(level, accept, order)
    q = 1 / accuracy
    wide = level.spread / np.maximum(accept, 1e-300) ** 2 / (1 - q) ** 6
    bound = level.area + 10 * wide
    head = np.stack([accept, slope, bound], axis=1)
    return np.concatenate(
        [level.centre, head, cartesian(level.moments, order), value[:, None]], axis=1
    )


@dataclass(frozen=True)
class TreeWinding:
    """w of a mesh on a backend, in units in which the mesh has a size of about one."""

    backend: Backend
    tree: PackedTree
    accuracy: float
    order: int
    rounding: float

    @classmethod
    def of(cls, backend: Backend, mesh: WindingMesh, accuracy: float, order: int) -> TreeWinding:
        """Everything uploaded."""
        nodes = [node_columns(level, accuracy, order) for level in mesh.levels]
        records = np.concatenate([mesh.records, mesh.singular_flags], axis=1)
        # Terms of a sum over all triangles, rounded each and added with random signs.
        rounding = backend.epsilon * (4 + math.sqrt(len(mesh.triangles)) / 8)
        return cls(backend, pack(backend, mesh.tree, nodes, in_slots(mesh.tree, records)), accuracy,
                   order, rounding)  # fmt: skip

    def at(self, x: Vec3, derivatives: int) -> tuple[Real, Vec3, SymmetricSum | None, Real]:
        """w, gradient, Hessian (as asked for) and the bound of the truncation error of w."""
        real, vector = self.backend.Float, self.backend.Array3f
        zero = SymmetricSum.zero(real)
        sums: tuple[Any, ...] = (vector(0), *zero.parts())[: (0, 1, 7)[derivatives]]

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            r, length, far = self._far(node, x)
            c = node.payload(far)
            inverse = dr.rcp(length)
            terms = far_terms(c, r, inverse, derivatives)
            value, error, *rest = state
            value = value + dr.select(far, terms.value, 0)
            error = dr.fma(dr.select(far, c[15], 0), self._decay(inverse), error)
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(far, terms.gradient, 0)
            if derivatives == 2 and terms.hessian is not None:
                pairs = zip(rest[1:], terms.hessian.parts(), strict=True)
                rest[1:] = [old + dr.select(far, new, 0) for old, new in pairs]
            near = ~far & node.is_leaf
            value, *rest = self._near(node, near, x, derivatives, (value, *rest))
            return ~far, (value, error, *rest)

        value, error, *rest = walk(self.tree, visit, (real(0), real(0), *sums))
        gradient = _SHARE * rest[0] if derivatives >= 1 else vector(0)
        hessian = SymmetricSum(*(_SHARE * part for part in rest[1:])) if derivatives == 2 else None
        return _SHARE * value, gradient, hessian, _SHARE * error

    def _far(self, node: Node, x: Vec3) -> tuple[Vec3, Real, Mask]:
        """x from the node's centre, its length, and whether that is enough."""
        r = x - self.backend.Array3f(*node.head[:3])
        length = dr.norm(r)
        return r, length, length > node.head[3]

    def _decay(self, inverse: Real) -> Real:
        """r^-(order + 3), as the first term left out."""
        power = inverse * inverse * inverse
        for _ in range(self.order):
            power = power * inverse
        return power

    def _near(
        self, node: Node, near: Mask, x: Vec3, derivatives: int, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """The sums with the triangles of a leaf added, with one arctangent for all of them."""
        real = self.backend.Float

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            zr, zi, turns, *rest = state
            triangle = NearTriangle.of(row, x)
            zr, zi, turns = times(zr, zi, turns, *triangle.factor())
            if derivatives >= 1:
                rest[0] = rest[0] + dr.select(active, triangle.gradient(), 0)
            if derivatives == 2:
                rest[1:] = triangle.add_hessian(SymmetricSum(*rest[1:]), active).parts()
            return zr, zi, turns, *rest

        value, *rest = state
        zr, zi, turns, *rest = for_each(node, near, add, (real(1), real(0), real(0), *rest))
        angle = 2 * dr.fma(2 * dr.pi, turns, dr.atan2(zi, zr))
        return value + dr.select(near, angle, 0), *rest

    def start(self, frame: Frame, t: Real, active: Mask) -> Real:
        """No crossings are counted: every sum is the whole of w."""
        del frame, t, active
        return self.backend.Float(0)

    def on_stretch(
        self, frame: Frame, x: Vec3, behind: Crossing, ahead: Crossing, turns: Real
    ) -> Sample:
        """w on a stretch of a ray, with a certificate.

        Certificate. Let D be the least of r - R over far nodes and of the distances d_e to
        *open* edges of near triangles, and r = D/2. Far dipoles a at rho >= D have gradients of
        at most 2a/rho^3, so they move f on B(x, r) by at most sum a ((rho-r)^-2 - rho^-2)
        <= sum a (2r/rho^3 + 8r^2/rho^4), as (1-t)^-2 - 1 - 2t <= 8t^2 for t <= 1/2; V bounds
        these sums. By Stokes the near triangles' field is that of the boundary of their union.
        An edge of length L that is not singular and nearer than (accuracy - 1) L/2 is not part
        of it: a far node with a triangle at it has radius R >= L/2 and is farther than accuracy
        R, hence the edge farther than (accuracy - 1) R. All other edges count as open, each
        with the variation that `SolidAngle` proves. No singular edge is within r.

        The two triangles at the ends of the stretch are told which side of them x is on.
        """
        del frame, turns
        real, vector = self.backend.Float, self.backend.Array3f

        def visit(node: Node, state: tuple[Any, ...]) -> tuple[Mask, tuple[Any, ...]]:
            value, g, error, slope_error, clear, s1, s2 = state
            r, length, far = self._far(node, x)
            c = node.payload(far)
            inverse = dr.select(far, dr.rcp(length), 0)
            terms = far_terms(c, r, inverse, 1)
            value = value + dr.select(far, terms.value, 0)
            g = g + dr.select(far, terms.gradient, 0)
            cube, decay = inverse * inverse * inverse, self._decay(inverse)
            error = dr.fma(c[15], decay, error)
            slope_error = dr.fma(node.head[4], decay * inverse, slope_error)
            apart = dr.fma(node.head[3], -1 / self.accuracy, length)
            clear = dr.select(far, fmin(apart, clear), clear)
            s1 = dr.fma(node.head[5], cube, s1)
            s2 = dr.fma(node.head[5], cube * inverse, s2)
            state = (value, g, error, slope_error, clear, s1, s2)
            near = ~far & node.is_leaf
            return ~far, self._near_certified(node, near, x, behind, ahead, state)

        start = (real(0), vector(0), real(0), real(0), real(dr.inf), real(0), real(0))
        sums = walk(self.tree, visit, start)
        return self._sample(*sums)

    def _near_certified(
        self, node: Node, near: Mask, x: Vec3, behind: Crossing, ahead: Crossing,
        state: tuple[Any, ...],
    ) -> tuple[Any, ...]:  # fmt: skip
        real, index = self.backend.Float, self.backend.UInt32
        # Edges nearer than this many half lengths have both their triangles among the near ones.
        closed = (0.5 * (self.accuracy - 1)) ** 2

        def add(row: list[Real], active: Mask, state: tuple[Any, ...]) -> tuple[Any, ...]:
            zr, zi, turns, g, clear, s1, s2 = state
            triangle = NearTriangle.of(row, x)
            re, im = triangle.factor()
            number = dr.select(row[INDEX] >= 0, index(row[INDEX]), NO_TRIANGLE - 1)
            im = dr.select(number == ahead.sheet, -dr.mulsign(dr.abs(im), ahead.jump), im)
            im = dr.select(number == behind.sheet, dr.mulsign(dr.abs(im), behind.jump), im)
            zr, zi, turns = times(zr, zi, turns, re, im)
            g = g + dr.select(active, triangle.gradient(), 0)
            distances = triangle.squared_distances()
            for k, (near2, inverse) in enumerate(zip(distances, triangle.inverse, strict=True)):
                open_ = (row[_SINGULAR + k] > 0) | (near2 * inverse >= closed)
                open_ &= active & (inverse > 0)
                clear = dr.select(open_, fmin(dr.sqrt(near2), clear), clear)
                first = dr.rsqrt(near2 * dr.fma(near2, 4 * inverse, 1))
                s1 = s1 + dr.select(open_, first, 0)
                s2 = s2 + dr.select(open_, first * dr.rsqrt(near2), 0)
            return zr, zi, turns, g, clear, s1, s2

        value, g, error, slope_error, clear, s1, s2 = state
        begin = (real(1), real(0), real(0), g, clear, s1, s2)
        zr, zi, turns, g, clear, s1, s2 = for_each(node, near, add, begin)
        angle = 2 * dr.fma(2 * dr.pi, turns, dr.atan2(zi, zr))
        value = value + dr.select(near, angle, 0)
        return value, g, error, slope_error, clear, s1, s2

    def _sample(
        self, value: Real, g: Vec3, error: Real, slope_error: Real, clear: Real, s1: Real, s2: Real
    ) -> Sample:
        epsilon = self.backend.epsilon
        distance = clear * (1 - _ROUNDING) - 8 * epsilon
        r = _REACH * distance
        variation = _SHARE * 2 * r * (s1 + 4 * r * s2) * (1 + _ROUNDING)
        value, gradient = _SHARE * value, _SHARE * g
        ball = HarmonicBall(r, value - variation, value + variation)
        apart = (clear > 8 * epsilon) & dr.isfinite(dr.squared_norm(gradient))
        steep = self.backend.Array3f(0, 0, _SHARE / (4 * epsilon))
        return Sample(
            value,
            dr.select(apart, gradient, steep),
            (ball,),
            error=_SHARE * error + self.rounding,
            gradient_error=dr.select(apart, _SHARE * slope_error, 0),
        )
