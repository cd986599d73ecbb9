"""Small networks that equal a ReLU network in the cells of a grid. In a small cell most neurons
are proved to be active, a(z) = z, or dead, a(z) = 0 (`box_ranges`). So in the cell all values of a
layer are affine functions of the point and of the values s = max(z, 0) of the *open* neurons, the
few others of earlier layers. The network of a cell has only these: layers of open neurons, and
linear neurons, which hand the point and earlier s on to the next layer.

**Errors.** Coefficients are computed in double precision. Let x be a point of the cell, s the
values of open neurons as the small network has them, and v = V (1, x, s) the values of a layer that
its computed coefficients V stand for; a are the values of the full network. Let |v - a| <= e. The
next layer has Z = W V, with b added to the first column, where each coefficient is off by at most
g = (n + 3) u times |W| |V| + |b| for sums of n products. So

    |z - (W a + b)| <= e' = |W| e + g (|W|_F | |V| c | + |b|),

with the spectral norm |W|, Frobenius' norm |W|_F, and bounds c of the absolute values of 1, x and
s. Active and dead neurons are proved to be so for the exact z, and max(z, 0) does not enlarge
differences, so that e' bounds |v - a| of the next layer, too. Each neuron of the small network thus
has an own error of z of at most e' (`NetworkLayer.own_error`), and its output one of at most the
last e'. A bound c of s is |Z| c. If c is at least 1 for coordinates, |Z| c is also a bound of the
gradient of s, so that gradients of z are off by at most e', too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from harnack.fields.networks.box_ranges import BoxRanges, ranges_in_boxes, with_rows
from harnack.fields.networks.layer_tables import (
    INPUTS,
    ROWS,
    NetworkLayer,
    SmallNetwork,
    spectral_bound,
)
from harnack.tree.empty_space import BoxCells

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.fields.networks.activations import Activation

__all__ = ["networks_of_cells"]

Layer: TypeAlias = "tuple[FloatArray, FloatArray]"

_UNIT = 2.0**-53
# In so many cells weights are counted first; and so many cells are treated at once.
_SOME_CELLS = 100
_CELLS_AT_ONCE = 384


def networks_of_cells(
    layers: Sequence[Layer], activation: Activation, boxes: BoxCells, max_weights: int
) -> list[SmallNetwork] | None:
    """For each box a network that equals a ReLU network in it; None if they would have more
    weights than about `max_weights` in all.

    layers: of the network. activation: the function ReLU.
    """
    # Some of the cells tell whether all of them would have too many.
    sample = BoxCells(boxes.corners[:: 1 + len(boxes.corners) // _SOME_CELLS], boxes.size)
    scale = len(boxes.corners) / max(1, len(sample.corners))
    if _weight_count(ranges_in_boxes(layers, sample)) * scale > max_weights:
        return None
    networks: list[SmallNetwork] = []
    norms = [spectral_bound(matrix) for matrix, _ in layers]
    for k in range(0, len(boxes.corners), _CELLS_AT_ONCE):
        part = BoxCells(boxes.corners[k : k + _CELLS_AT_ONCE], boxes.size)
        ranges = ranges_in_boxes(layers, part)
        values = _Values.of_boxes(part)
        layers_of_cells: list[list[NetworkLayer]] = [[] for _ in part.corners]
        for index, layer in enumerate(layers[:-1]):
            active, dead = ranges.is_active[index], ranges.is_dead[index]
            values, rows = values.after(layer, norms[index], active, ~(active | dead))
            for network, own in zip(layers_of_cells, rows, strict=True):
                network.append(_layer_of(own, activation, index, len(layers) - 2))
        is_output = np.ones((len(part.corners), 1), np.bool_)
        _, rows = values.after(layers[-1], norms[-1], is_output, is_output)
        networks += [_with_output(*pair) for pair in zip(layers_of_cells, rows, strict=True)]
    return networks


def _weight_count(ranges: BoxRanges) -> int:
    """The number of weights, with padding, of the networks of boxes with these ranges."""
    pairs = zip(ranges.is_active, ranges.is_dead, strict=True)
    open_ = [~(is_active | is_dead) for is_active, is_dead in pairs]
    before, count = np.full(len(open_[0]), INPUTS), 0
    for index, mask in enumerate(open_):
        after = before + mask.sum(axis=1)
        is_last = index == len(open_) - 1 and index > 0
        count += _padded(before) * _padded(after - before if is_last else after)
        before = after
    return int(np.sum(count))


def _padded(counts: IntArray) -> IntArray:
    """Numbers of neurons with padding."""
    return -(-counts // ROWS) * ROWS


@dataclass(frozen=True)
class _Rows:
    """The open neurons of a layer in a cell.

    numbers: (m, 1 + k) the coefficients of 1, x and the values s of earlier layers.
    error: e' of the module's docstring.
    """

    numbers: FloatArray
    error: float


@dataclass(frozen=True)
class _Values:
    """Values of a layer in n cells, as affine functions.

    numbers: (rows, k) for each cell a run of rows: V'. starts: (n,) their first rows.
    sizes: (rows,) c. errors: (n,) e.
    """

    numbers: FloatArray
    starts: IntArray
    sizes: FloatArray
    errors: FloatArray

    @classmethod
    def of_boxes(cls, boxes: BoxCells) -> _Values:
        """The coordinates in boxes."""
        count = len(boxes.corners)
        numbers = np.zeros(((1 + INPUTS) * count, INPUTS))
        sizes = np.ones((count, 1 + INPUTS))
        farthest = np.maximum(np.abs(boxes.corners), np.abs(boxes.corners + boxes.size))
        sizes[:, 1:] = np.maximum(1.001 * farthest, 1)
        for k in range(INPUTS):
            numbers[k + 1 :: 1 + INPUTS, k] = 1
        starts = (1 + INPUTS) * np.arange(count)
        return cls(numbers, starts, sizes.ravel(), np.zeros(count))

    def after(
        self, layer: Layer, norm: float, active: BoolArray, open_: BoolArray
    ) -> tuple[_Values, list[_Rows]]:
        """The values of the next layer, and for each cell its open neurons.

        norm: a bound of the spectral norm. active, open_: (n, m) masks of neurons.
        """
        weights, bias = layer
        numbers = self.numbers @ weights.T
        numbers[self.starts] += bias
        size = np.add.reduceat(np.abs(self.numbers) * self.sizes[:, None], self.starts, axis=0)
        unit = 1.01 * _UNIT * (weights.shape[1] + 16)
        new = np.linalg.norm(weights) * np.linalg.norm(size, axis=1) + np.linalg.norm(bias)
        errors = norm * self.errors + unit * new
        counts = np.diff(self.starts, append=len(numbers))
        rows: list[_Rows] = []
        bounds: list[FloatArray] = []
        for k, (start, count) in enumerate(zip(self.starts, counts, strict=True)):
            own = numbers[start : start + count, open_[k]].T
            rows.append(_Rows(own, float(errors[k])))
            bounds.append(1.001 * (np.abs(own) @ self.sizes[start : start + count]))
        more = open_.sum(axis=1)
        wider, starts, new_rows = with_rows(
            numbers * np.repeat(active, counts, axis=0), self.starts, more
        )
        wider[new_rows, np.nonzero(open_)[1]] = 1
        sizes, _, _ = with_rows(self.sizes, self.starts, more)
        sizes[new_rows] = np.concatenate(bounds)
        return _Values(wider, starts, sizes, errors), rows


def _layer_of(rows: _Rows, activation: Activation, index: int, last: int) -> NetworkLayer:
    """A layer of a small network: linear neurons for the point and all earlier s, and the open
    neurons. The last layer needs no linear ones, unless it is the first, too: the output takes
    what it needs from the layer in which it appears first."""
    count = rows.numbers.shape[1] - 1
    is_needed = index < last or index == 0
    linear = np.eye(count) if is_needed else np.zeros((0, count))
    weights = np.concatenate([linear, rows.numbers[:, 1:]])
    bias = np.concatenate([np.zeros(len(linear)), rows.numbers[:, 0]])
    # The norm of linear neurons is 1, and that of both together is at most the root of the sum of
    # squares.
    norm = _norm_bound(rows.numbers[:, 1:])
    spectral = float(np.hypot(1.0 if is_needed else 0.0, norm)) * (1 + 1e-9)
    outputs = np.zeros(len(weights))
    return NetworkLayer(weights, bias, activation, outputs, len(linear), rows.error, spectral)


def _norm_bound(matrix: FloatArray) -> float:
    """A bound of the spectral norm, nearly sharp, without singular values. The eigenvalues of the
    symmetric matrix G = A A' are not negative, the largest is the square of the norm, and that of
    G^4 is at most the root of the sum of the squares of its entries."""
    if not matrix.size:
        return 0.0
    scale = float(np.linalg.norm(matrix))
    if scale == 0:
        return 0.0
    gram = (matrix / scale) @ (matrix.T / scale)
    fourth = gram @ gram
    fourth = fourth @ fourth
    # Rounding: entries of G are off by some (k + 8) u, as its norm is at most 1.
    rounding = 32 * (matrix.shape[1] + matrix.shape[0] + 8) * _UNIT
    return scale * min(1.0, float(np.linalg.norm(fourth)) + rounding) ** 0.125 * (1 + 1e-9)


def _with_output(layers: list[NetworkLayer], output: _Rows) -> SmallNetwork:
    """The network of a cell. output: the coefficients of the output."""
    numbers = output.numbers[0]
    at = 1
    for index, layer in enumerate(layers):
        # The new neurons of a layer: the point in the first one, and its open neurons.
        first = 0 if index == 0 else layer.linear_count
        count = len(layer.bias) - first
        layer.outputs[first:] = numbers[at : at + count]
        at += count
    return SmallNetwork(tuple(layers), float(numbers[0]), output.error)
