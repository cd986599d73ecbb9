"""Derivatives of neural networks by points, weights and biases: value and gradient as expressions
that Dr.Jit can differentiate in both modes.

A layer computes x' = a(z) with z = W x + b. The three derivatives t_c = dx/dp_c by the coordinates
of the point are passed forward beside the values:

    z = W x + b,   x' = a(z);      dz/dp_c = W t_c,   t'_c = a'(z) (W t_c).

At the last layer, which has no activation, they are f and grad f. All of this is products of a
matrix of values (a row for each point) with W, and functions of single numbers. So is what reverse
mode needs: with the derivatives G of some number by the entries of P = X W^T, those by X are G W,
and those by W are G^T X, the sum over all points (`_Product`). Derivatives of the gradient contain
a'(z), whose derivative is a''(z) dz; the jumps of a' at a kink have none.

Memory grows with the number of points times the sum of all widths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.fields.networks.layer_tables import INPUTS

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.networks.activations import Activation

__all__ = ["DifferentiableLayer", "network_gradient", "network_value"]

DifferentiableLayer: TypeAlias = "tuple[Real, Real]"
"""The numbers of W, row after row, and of b, on a backend."""

# Sums over points are cut into parts, so that there are about so many lanes.
_MIN_LANES = 1 << 16


def network_value(
    backend: Backend,
    layers: Sequence[DifferentiableLayer],
    activations: Sequence[Activation],
    p: Vec3,
) -> Real:
    """f at points p.

    activations: those of all layers but the last.
    """
    values: Real = dr.ravel(p)
    for layer, activation in zip(layers, (*activations, None), strict=True):
        values = _affine(backend, values, layer, dr.width(p))
        if activation is not None:
            values, _ = _activated(backend, activation, values)
    return values


def network_gradient(
    backend: Backend,
    layers: Sequence[DifferentiableLayer],
    activations: Sequence[Activation],
    p: Vec3,
) -> Vec3:
    """grad f at points p. The arguments are those of `network_value`."""
    count = dr.width(p)
    index = backend.UInt32
    values: Real = dr.ravel(p)
    tangents: list[Real] = []
    for layer, activation in zip(layers, (*activations, None), strict=True):
        weights, bias = layer
        values = _affine(backend, values, layer, count)
        if tangents:
            tangents = [_product(backend, t, weights, count, dr.width(bias)) for t in tangents]
        else:  # those of the point itself are 1 and 0
            row = dr.arange(index, dr.width(values)) % dr.opaque(index, dr.width(bias))
            tangents = [dr.gather(backend.Float, weights, row * INPUTS + c) for c in range(INPUTS)]
        if activation is not None:
            values, slopes = _activated(backend, activation, values)
            tangents = [slopes * t for t in tangents]
    return backend.Array3f(*tangents)


def _affine(backend: Backend, values: Real, layer: DifferentiableLayer, count: int) -> Real:
    """W x + b of a layer, point after point, from the values x at `count` points."""
    weights, bias = layer
    product = _product(backend, values, weights, count, dr.width(bias))
    index = backend.UInt32
    row = dr.arange(index, dr.width(product)) % dr.opaque(index, dr.width(bias))
    return product + dr.gather(backend.Float, bias, row)


def _activated(backend: Backend, activation: Activation, z: Real) -> tuple[Real, Real]:
    """a(z) and a'(z) of an activation function, with the derivatives a'(z) and a''(z) by z."""
    with dr.suspend_grad():
        at, parameter = dr.detach(z), dr.opaque(backend.Float, activation.parameter)
        point, second = activation.at(at, parameter), activation.second(at, parameter)
    return dr.replace_grad(point.value, point.slope * z), dr.replace_grad(point.slope, second * z)


def _product(backend: Backend, x: Real, weights: Real, count: int, rows: int) -> Real:
    """The numbers of X W^T, row after row, from those of X and W.

    count: the number of rows of X. rows: that of W.
    """
    return dr.custom(_Product, backend, x, weights, count, rows)


class _Product(dr.CustomOp):
    """The product P = X W^T of two matrices (n, k) and (m, k), as a Dr.Jit operation. Its change is
    dX W^T + X dW^T. With the derivatives G (n, m) of a number by P, those by X are G W and those by
    W are G^T X, since the number changes by the sum of all G_ij dP_ij."""

    def eval(self, backend: Backend, x: Real, weights: Real, count: int, rows: int) -> Real:
        """The numbers of P. The arguments are those of `_product`."""
        self._backend, self._x, self._weights = backend, x, weights
        self._shape = count, rows, dr.width(weights) // rows
        return self._of(x, weights)

    def _of(self, x: Real, weights: Real) -> Real:
        """X W^T for other matrices of the same shapes."""
        n, m, k = self._shape
        index = self._backend.UInt32
        place, rows = dr.arange(index, m * k), dr.opaque(index, m)
        transposed = dr.gather(
            self._backend.Float, weights, (place % rows) * dr.opaque(index, k) + place // rows
        )
        return _contract(self._backend, (x, k, 1), transposed, (n, m, k))

    def forward(self) -> None:
        """Compute the change of P."""
        dx, dw = self.grad_in("x"), self.grad_in("weights")
        self.set_grad_out(self._of(dx, self._weights) + self._of(self._x, dw))

    def backward(self) -> None:
        """Compute the derivatives by X and W."""
        n, m, k = self._shape
        g, backend = self.grad_out(), self._backend
        self.set_grad_in("x", _contract(backend, (g, m, 1), self._weights, (n, k, m)))
        self.set_grad_in("weights", _contract(backend, (g, 1, m), self._x, (m, k, n)))


def _contract(
    backend: Backend, left: tuple[Real, int, int], right: Real, sizes: tuple[int, int, int]
) -> Real:
    """The product A B of two matrices, row after row.

    left: the numbers of A, and the distances of its entries from row to row and from column to
        column.
    right: the numbers of B, row after row.
    sizes: the numbers of rows and of columns of the result, and of terms of its sums, which are the
        columns of A. They are kernel parameters.

    A lane computes up to eight neighboring entries of a row, for which it reads an entry of A and
    neighbors in B for each term. A few sums of many terms are cut into parts, each with a lane.
    """
    (a, row_step, term_step), (rows, columns, count) = left, sizes
    index, real = backend.UInt32, backend.Float
    at_once = next(size for size in (8, 4, 2, 1) if columns % size == 0)
    packets = columns // at_once
    parts = max(1, min(count // 64, _MIN_LANES // max(1, rows * packets)))
    numbers = (count, -(-count // parts), packets, row_step, term_step)
    count_, length, packets_, row_step_, term_step_ = (dr.opaque(index, n) for n in numbers)
    lane = dr.arange(index, rows * packets * parts)
    cell, part = (lane // parts, lane % parts) if parts > 1 else (lane, index(0))
    end = dr.minimum((part + 1) * length, count_)
    row, packet = cell // packets_, cell % packets_
    # Reading several numbers at once needs evaluated arrays.
    dr.eval(a, right)

    def add(i: Any, *sums: Any) -> tuple[Any, ...]:
        """The sums with term i."""
        factor = dr.gather(real, a, row * row_step_ + i * term_step_)
        place = i * packets_ + packet
        if at_once == 1:
            return i + 1, dr.fma(factor, dr.gather(real, right, place), sums[0])
        entries = dr.gather(backend.ArrayXf, right, place, shape=(at_once, 1))
        return i + 1, *(dr.fma(factor, entries[j], sums[j]) for j in range(at_once))

    def has_more(i: Any, *_: Any) -> Mask:
        """Whether there is a term i."""
        return i < end

    zeros = [dr.zeros(real, dr.width(lane)) for _ in range(at_once)]
    _, *sums = dr.while_loop((part * length, *zeros), has_more, add, label="matrix product")
    if parts > 1:
        sums = [dr.block_sum(total, parts) for total in sums]
    return sums[0] if at_once == 1 else dr.ravel(backend.ArrayXf(sums))
