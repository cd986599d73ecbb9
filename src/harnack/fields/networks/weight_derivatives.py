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
    from harnack.backend import Backend, Real, Vec3
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
        return _contract(self._backend, (x, k, 1), (weights, k, 1), (n, m, k))

    def forward(self) -> None:
        """Compute the change of P."""
        dx, dw = self.grad_in("x"), self.grad_in("weights")
        self.set_grad_out(self._of(dx, self._weights) + self._of(self._x, dw))

    def backward(self) -> None:
        """Compute the derivatives by X and W."""
        n, m, k = self._shape
        g = self.grad_out()
        self.set_grad_in("x", _contract(self._backend, (g, m, 1), (self._weights, 1, k), (n, k, m)))
        self.set_grad_in("weights", _contract(self._backend, (g, 1, m), (self._x, 1, k), (m, k, n)))


def _contract(
    backend: Backend,
    left: tuple[Real, int, int],
    right: tuple[Real, int, int],
    sizes: tuple[int, int, int],
) -> Real:
    """The matrix of the sums over i of left[a + i, ...] right[b + i, ...], row after row.

    left, right: the numbers of a matrix, and the distances of entries from row to row of the
        result (of the left one; of the right one, from column to column) and from term to term.
    sizes: the numbers of rows, of columns and of terms. They are kernel parameters.

    A few sums of many terms are cut into parts, for each of which there is a lane.
    """
    (x, x_row, x_term), (y, y_column, y_term) = left, right
    rows, columns, count = sizes
    index, real = backend.UInt32, backend.Float
    parts = max(1, min(count // 64, _MIN_LANES // max(1, rows * columns)))
    length = -(-count // parts)  # rounded up
    u = [dr.opaque(index, n) for n in (columns, count, length, x_row, x_term, y_column, y_term)]
    columns_, count_, length_, x_row_, x_term_, y_column_, y_term_ = u
    lane = dr.arange(index, rows * columns * parts)
    cell, part = (lane // parts, lane % parts) if parts > 1 else (lane, index(0))
    first = part * length_
    end = dr.minimum(first + length_, count_)
    x_start, y_start = (cell // columns_) * x_row_, (cell % columns_) * y_column_

    def add(i: Any, total: Any) -> tuple[Any, Any]:
        """The sum with term i."""
        factor = dr.gather(real, x, x_start + i * x_term_)
        return i + 1, dr.fma(factor, dr.gather(real, y, y_start + i * y_term_), total)

    _, total = dr.while_loop(
        (first, dr.zeros(real, dr.width(lane))), lambda i, _: i < end, add, label="matrix product"
    )
    return dr.block_sum(total, parts) if parts > 1 else total
