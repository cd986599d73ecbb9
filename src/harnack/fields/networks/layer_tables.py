"""The weights of a neural network as tables on a backend (a Dr.Jit device and precision), and
products of its matrices with vectors. Kernels read all sizes and weights from tables, in recorded
loops, so another network of about the same size compiles nothing.

A layer computes z = W x + b from x; x are the values of the layer before, or the point. Widths are
padded with zeros to whole blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.arrays import upload_floats, upload_integers
from harnack.backend.local_memory import local_size
from harnack.backend.record_table import PACKET, RecordTable

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, Mask, Real
    from harnack.fields.networks.activations import Activation

__all__ = [
    "INPUTS",
    "MAX_WIDTH",
    "LayerNumbers",
    "LayerTables",
    "loop",
    "spectral_bound",
]

INPUTS = 3
# A block of a matrix is `_ROWS` rows and one column; an iteration of the loop reads `_COLUMNS`.
_ROWS, _COLUMNS = 16, 4
# Sums of squares of fewer numbers than this have a relative error below `NORM_FACTOR` - 1.
MAX_WIDTH = 4096
_NORM_FACTOR = 1.001


@dataclass(frozen=True)
class LayerNumbers:
    """What is known of a layer, for each lane.

    first: the index of its first neuron in tables of neurons.
    count: the number of its neurons, with padding.
    forward, backward: the first packets of W and of its transpose.
    columns, rows: the numbers of iterations for the columns of W, and of its blocks of rows.
    back_columns, back_rows: those of the transpose.
    kind: the index of the activation function.
    parameter, max_slope: of the activation function.
    spectral, frobenius: bounds of these norms of W.
    forward_error, backward_error: bounds of the relative rounding errors of sums, multiples of the
        sum of absolute values of the terms.
    """

    first: Index
    count: Index
    forward: Index
    backward: Index
    columns: Index
    rows: Index
    back_columns: Index
    back_rows: Index
    kind: Index
    parameter: Real
    max_slope: Real
    spectral: Real
    frobenius: Real
    forward_error: Real
    backward_error: Real


_INTEGERS = (
    "first", "count", "forward", "backward", "columns", "rows", "back_columns", "back_rows", "kind",
)  # fmt: skip
_FLOATS = (
    "parameter", "max_slope", "spectral", "frobenius", "forward_error", "backward_error",
)  # fmt: skip


def _padded(count: int, size: int) -> int:
    """The next multiple of `size`."""
    return -(-count // size) * size


def _blocks(matrix: FloatArray, rows: int, columns: int) -> FloatArray:
    """The entries of a matrix, padded with zeros, in the order in which the loop reads them: blocks
    of rows, in each the columns one after another."""
    padded = np.zeros((rows, columns))
    padded[: matrix.shape[0], : matrix.shape[1]] = matrix
    return padded.reshape(rows // _ROWS, _ROWS, columns).transpose(0, 2, 1).ravel()


def spectral_bound(matrix: FloatArray) -> float:
    """An upper bound of the spectral norm: the computed one, enlarged by far more than the backward
    error of the singular values (Golub and Van Loan, section 8.6)."""
    return float(np.linalg.norm(matrix, 2) + 1e-11 * np.linalg.norm(matrix))


@dataclass(frozen=True)
class LayerTables:
    """The tables of a network. The output is a row of weights times the values of the last layer,
    plus a number.

    layer_count: the number of layers with activations.
    integers, floats: the numbers of layers (`LayerNumbers`).
    weights: the blocks of all matrices and of their transposes.
    neurons: a record for each neuron: its bias, the norm of its row of W, and its weight in the
        output.
    output_bias, output_norm: of the output; `output_norm` bounds the norm of its weights.
    width, total: the numbers that local memory holds for a layer, and for all layers.
    activations: the kinds of activation functions that occur.
    unit: the unit roundoff.
    """

    backend: Backend
    layer_count: Index
    integers: Index
    floats: Real
    weights: Real
    neurons: RecordTable
    output_bias: Real
    output_norm: Real
    width: int
    total: int
    activations: tuple[Activation, ...]

    @property
    def unit(self) -> float:
        """The unit roundoff u."""
        return 0.5 * self.backend.machine_epsilon

    @classmethod
    def upload(
        cls,
        backend: Backend,
        layers: Sequence[tuple[FloatArray, FloatArray]],
        activations: tuple[Activation, ...],
    ) -> LayerTables:
        """Upload a network. layers: weights (m, k) and biases (m,); the last has one row.
        activations: one for each layer but the last."""
        kinds = tuple({type(entry): entry for entry in activations}.values())
        integers: list[int] = []
        floats: list[float] = []
        blocks: list[FloatArray] = []
        records: list[FloatArray] = []
        unit, packets, first, before = 0.5 * backend.machine_epsilon, 0, 0, _COLUMNS
        output, output_bias = layers[-1]
        for index, (weights, bias) in enumerate(layers[:-1]):
            activation = activations[index]
            count = _padded(len(weights), _ROWS)
            back_rows = _padded(before, _ROWS)
            pieces = _blocks(weights, count, before), _blocks(weights.T, back_rows, count)
            sizes = [len(piece) // PACKET for piece in pieces]
            integers += [
                first, count, packets, packets + sizes[0], before // _COLUMNS, count // _ROWS,
                count // _COLUMNS, back_rows // _ROWS,
                [type(kind) for kind in kinds].index(type(activation)),
            ]  # fmt: skip
            floats += [
                activation.parameter, activation.max_slope, spectral_bound(weights),
                float(np.linalg.norm(weights)) * (1 + 1e-9),
                _sum_error(before) * unit, _sum_error(count) * unit,
            ]  # fmt: skip
            record = np.zeros((count, PACKET))
            record[: len(bias), 0] = bias
            record[: len(bias), 1] = np.linalg.norm(weights, axis=1) * _NORM_FACTOR
            if index == len(layers) - 2:
                record[: len(bias), 2] = output[0]
            records.append(record)
            blocks += pieces
            packets, first, before = packets + sum(sizes), first + count, count
        # Rounded up, also to single precision.
        rounded = np.array(floats) * np.tile([1, 1, *[1 + 4 * unit] * 4], len(layers) - 1)
        return cls(
            backend,
            dr.opaque(backend.UInt32, len(layers) - 1),
            upload_integers(backend, np.array(integers)),
            upload_floats(backend, rounded),
            upload_floats(backend, np.concatenate(blocks)),
            RecordTable.upload(backend, np.concatenate(records)),
            dr.opaque(backend.Float, float(output_bias[0])),
            dr.opaque(backend.Float, float(np.linalg.norm(output)) * _NORM_FACTOR),
            local_size(max(_padded(len(weights), _ROWS) for weights, _ in layers[:-1])),
            local_size(first),
            kinds,
        )

    def layer(self, index: Index) -> LayerNumbers:
        """The numbers of a layer, from 0."""
        u, f, n, m = self.backend.UInt32, self.backend.Float, len(_INTEGERS), len(_FLOATS)
        integers = {k: dr.gather(u, self.integers, index * n + j) for j, k in enumerate(_INTEGERS)}
        floats = {k: dr.gather(f, self.floats, index * m + j) for j, k in enumerate(_FLOATS)}
        return LayerNumbers(**integers, **floats)

    def multiply(
        self,
        inputs: list[Any],
        outputs: list[Any],
        packet: Index,
        columns: Index,
        rows: Index,
        positive: int = 0,
    ) -> tuple[list[Any], list[Any]]:
        """Multiply vectors in local memory by a matrix. Returns the changed `inputs` and `outputs`.

        inputs, outputs: for each vector an array of local memory.
        packet: the first packet of the matrix. columns, rows: of its loops (`LayerNumbers`).
        positive: how many of the vectors, the last ones, are multiplied by the absolute values.

        A row is the sum over iterations of sums of four products, each by fused multiply-adds. So
        a term is rounded at most 4 times in its iteration, and once in each iteration
        (`_sum_error`).
        """
        count, u = len(inputs), self.backend.UInt32

        def column_step(state: Any) -> Any:
            """Add four columns of a block of rows."""
            i, row, inputs, sums = state
            sums = list(sums)
            parts: list[Any] = [None] * (count * _ROWS)
            for c in range(_COLUMNS):
                column = i * _COLUMNS + c
                at = packet + (row * (columns * _COLUMNS) + column) * (_ROWS // PACKET)
                weights = self._packet(at) + self._packet(at + 1)
                sizes = [dr.abs(weight) for weight in weights] if positive else []
                for q, vector in enumerate(inputs):
                    x = vector[column]
                    if q == count - positive:
                        weights = sizes
                    for r in range(_ROWS):
                        k = q * _ROWS + r
                        part = parts[k]
                        parts[k] = weights[r] * x if part is None else dr.fma(weights[r], x, part)
            return i + 1, row, inputs, [a + b for a, b in zip(sums, parts, strict=True)]

        def row_step(state: Any) -> Any:
            """Compute a block of rows."""
            row, inputs, outputs = state
            zeros = [self.backend.Float(0) + 0 * self.backend.Float(row)] * (count * _ROWS)
            _, _, inputs, sums = loop(
                (u(0), row, inputs, zeros), lambda s: s[0] < columns, column_step, "columns"
            )
            for q, vector in enumerate(outputs):
                for r in range(_ROWS):
                    vector[row * _ROWS + r] = sums[q * _ROWS + r]
            return row + 1, inputs, outputs

        _, inputs, outputs = loop((u(0), inputs, outputs), lambda s: s[0] < rows, row_step, "rows")
        return inputs, outputs

    def _packet(self, index: Index) -> list[Real]:
        """Eight weights."""
        packet = dr.gather(self.backend.ArrayXf, self.weights, index, shape=(PACKET, 1))
        return [packet[j] for j in range(PACKET)]


def _sum_error(columns: int) -> float:
    """A bound, in units of u, of the relative rounding error of a row's sum and of two further
    operations, of weights rounded to single precision, and of terms of second order."""
    return 1.001 * (_COLUMNS + columns // _COLUMNS + 4)


def loop(
    state: Any, condition: Callable[[Any], Mask], step: Callable[[Any], Any], label: str
) -> Any:
    """A recorded loop over a tuple `state`: while condition(state) is true, the state becomes
    step(state)."""
    return dr.while_loop(state, _of_tuple(condition), _of_tuple(step), label=label)


def _of_tuple(function: Callable[[Any], Any]) -> Callable[..., Any]:
    """The function of a tuple as a function of its entries."""

    def of_entries(*entries: Any) -> Any:
        return function(entries)

    return of_entries
