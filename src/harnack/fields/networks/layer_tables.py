"""The weights of a neural network as tables on a backend (a Dr.Jit device and precision), and
products of its matrices with vectors. Kernels read all sizes and weights from tables, in recorded
loops, so another network of about the same size compiles nothing.

A layer computes z = W x + b from x; x are the values of the layer before, or the point. Widths are
padded with zeros to whole blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.arrays import upload_floats, upload_integers
from harnack.backend.local_memory import local_size
from harnack.backend.record_table import PACKET, RecordTable

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, Mask, Real
    from harnack.fields.networks.activations import Activation

__all__ = [
    "INPUTS",
    "MAX_WIDTH",
    "ROWS",
    "LayerNumbers",
    "LayerTables",
    "NetworkLayer",
    "SmallNetwork",
    "loop",
    "spectral_bound",
]

INPUTS = 3
# A block of a matrix is `ROWS` rows and one column; an iteration of the loop reads `_COLUMNS`.
ROWS, _COLUMNS = 16, 4
# Sums of squares of fewer numbers than this have a relative error below `NORM_FACTOR` - 1.
MAX_WIDTH = 4096
_NORM_FACTOR = 1.001


@dataclass(frozen=True)
class NetworkLayer:
    """A layer a(W x + b) of a network.

    weights: (m, k) W. bias: (m,) b. activation: a.
    outputs: (m,) the weights of its values in the network's output.
    linear_count: so many neurons, the first ones, have the values z in place of a(z).
    own_error: a bound of the errors of z, in addition to those of rounding.
    spectral: a bound of the spectral norm of W.
    """

    weights: FloatArray
    bias: FloatArray
    activation: Activation
    outputs: FloatArray
    linear_count: int
    own_error: float
    spectral: float


@dataclass(frozen=True)
class SmallNetwork:
    """A network: layers, the number that is added to the output, and a bound of the error of the
    output, in addition to those of rounding."""

    layers: tuple[NetworkLayer, ...]
    output_bias: float
    output_error: float

    @classmethod
    def of_layers(
        cls,
        layers: Sequence[tuple[FloatArray, FloatArray]],
        activations: tuple[Activation, ...],
    ) -> SmallNetwork:
        """The network of weights (m, k) and biases (m,), of which the last has one row.

        activations: one for each layer but the last.
        """
        output, output_bias = layers[-1]
        last = len(layers) - 2
        network_layers = [
            NetworkLayer(
                weights, bias, activation, output[0] if index == last else np.zeros(len(bias)), 0,
                0.0, spectral_bound(weights),
            )
            for index, ((weights, bias), activation) in enumerate(
                zip(layers[:-1], activations, strict=True)
            )
        ]  # fmt: skip
        return cls(tuple(network_layers), float(output_bias[0]), 0.0)


@dataclass(frozen=True)
class LayerNumbers:
    """What is known of a layer, for each lane.

    first: the index of its first neuron in tables of neurons.
    place: the same in local memory, which holds the neurons of a single network.
    count: the number of its neurons, with padding.
    weights: the first packet of W.
    columns, rows: the numbers of iterations for the columns of W, and of its blocks of rows.
    kind: the index of the activation function.
    parameter, max_slope: of the activation function.
    spectral, frobenius: bounds of these norms of W.
    forward_error, backward_error: bounds of the relative rounding errors of sums, multiples of the
        sum of absolute values of the terms.
    own_error: `NetworkLayer.own_error`.
    output_norm: a bound of the norm of its weights in the output.
    """

    first: Index
    place: Index
    count: Index
    weights: Index
    columns: Index
    rows: Index
    kind: Index
    parameter: Real
    max_slope: Real
    spectral: Real
    frobenius: Real
    forward_error: Real
    backward_error: Real
    own_error: Real
    output_norm: Real


_INTEGERS = ("first", "place", "count", "weights", "columns", "rows", "kind")
_FLOATS = (
    "parameter", "max_slope", "spectral", "frobenius", "forward_error", "backward_error",
    "own_error", "output_norm",
)  # fmt: skip


def _padded(count: int, size: int) -> int:
    """The next multiple of `size`."""
    return -(-count // size) * size


def _blocks(matrix: FloatArray, rows: int, columns: int) -> FloatArray:
    """The entries of a matrix, padded with zeros, in the order in which the loop reads them: blocks
    of rows, in each the columns one after another."""
    padded = np.zeros((rows, columns))
    padded[: matrix.shape[0], : matrix.shape[1]] = matrix
    return padded.reshape(rows // ROWS, ROWS, columns).transpose(0, 2, 1).ravel()


@dataclass
class _Contents:
    """The contents of the tables of networks (`LayerTables`), of which lists are filled network by
    network. dtype: of weights. packets, neurons: how many there are."""

    dtype: type[np.float32 | np.float64]
    integers: list[int]
    floats: list[float]
    blocks: list[npt.NDArray[Any]]
    records: list[FloatArray]
    outputs: list[float]
    packets: int = 0
    neurons: int = 0
    width: int = ROWS
    total: int = 0

    @classmethod
    def of_networks(
        cls, networks: Sequence[SmallNetwork], kinds: tuple[Activation, ...], backend: Backend
    ) -> _Contents:
        """The contents for all networks."""
        unit = 0.5 * backend.machine_epsilon
        contents = cls(backend.dtype, [], [], [], [], [])
        types = [type(kind) for kind in kinds]
        for network in networks:
            place, before = 0, _COLUMNS
            for layer in network.layers:
                kind = types.index(type(layer.activation))
                count = contents._add(layer, kind, place, before, unit)
                place, before = place + count, count
            contents.total = max(contents.total, place)
            contents.outputs += [network.output_bias, network.output_error * (1 + 4 * unit)]
        return contents

    def _add(self, layer: NetworkLayer, kind: int, place: int, before: int, unit: float) -> int:
        """Add a layer. Returns the number of its neurons, with padding.

        kind: the index of the activation function. place: `LayerNumbers.place`.
        before: the number of values of the layer before, with padding.
        """
        weights, number = layer.weights, len(layer.bias)
        count = _padded(number, ROWS)
        self.integers += [
            self.neurons, place, count, self.packets, before // _COLUMNS, count // ROWS, kind,
        ]  # fmt: skip
        # Rounded up, also to single precision.
        up = 1 + 4 * unit
        activation = layer.activation
        max_slope = activation.max_slope
        if layer.linear_count:
            max_slope = max(1.0, max_slope)
        self.floats += [
            activation.parameter, max_slope, layer.spectral * up,
            float(np.linalg.norm(weights)) * (1 + 1e-9) * up, _sum_error(before) * unit * up,
            _back_sum_error(count) * unit * up, layer.own_error * up,
            float(np.linalg.norm(layer.outputs)) * _NORM_FACTOR,
        ]  # fmt: skip
        record = np.zeros((count, PACKET))
        record[:number, 0] = layer.bias
        record[:number, 1] = np.sqrt((weights * weights).sum(axis=1)) * _NORM_FACTOR
        record[:number, 2] = layer.outputs
        record[: layer.linear_count, 3] = 1
        self.records.append(record)
        self.blocks.append(_blocks(weights, count, before).astype(self.dtype))
        self.packets += count * before // PACKET
        self.neurons += count
        self.width = max(self.width, count)
        return count


def spectral_bound(matrix: FloatArray) -> float:
    """An upper bound of the spectral norm: the computed one, enlarged by far more than the backward
    error of the singular values (Golub and Van Loan, section 8.6)."""
    return float(np.linalg.norm(matrix, 2) + 1e-11 * np.linalg.norm(matrix))


@dataclass(frozen=True)
class LayerTables:
    """The tables of one or several networks with the same number of layers. The output of a network
    is a sum of weights times values, plus a number.

    layer_count: the number of layers with activations.
    integers, floats: the numbers of layers (`LayerNumbers`).
    weights: the blocks of all matrices.
    neurons: a record for each neuron: its bias, the norm of its row of W, its weight in the output,
        and 1 if it is linear, else 0.
    outputs: for each network the number that is added to its output, and a bound of its error.
    network: the index of the network, for each lane.
    width, total: the numbers that local memory holds for a layer, and for all layers.
    activations: the kinds of activation functions that occur.
    has_linear: whether some neurons are linear.
    unit: the unit roundoff.
    """

    backend: Backend
    layer_count: Index
    integers: Index
    floats: Real
    weights: Real
    neurons: RecordTable
    outputs: Real
    network: Index
    width: int
    total: int
    activations: tuple[Activation, ...]
    has_linear: bool

    @property
    def unit(self) -> float:
        """The unit roundoff u."""
        return 0.5 * self.backend.machine_epsilon

    @classmethod
    def upload(cls, backend: Backend, networks: Sequence[SmallNetwork]) -> LayerTables:
        """Upload networks. Lanes have the first one (`of_network`)."""
        layers = [layer for network in networks for layer in network.layers]
        kinds = tuple({type(layer.activation): layer.activation for layer in layers}.values())
        contents = _Contents.of_networks(networks, kinds, backend)
        return cls(
            backend,
            dr.opaque(backend.UInt32, len(networks[0].layers)),
            upload_integers(backend, np.array(contents.integers)),
            upload_floats(backend, np.array(contents.floats)),
            upload_floats(backend, np.concatenate(contents.blocks)),
            RecordTable.upload(backend, np.concatenate(contents.records)),
            upload_floats(backend, np.array(contents.outputs)),
            dr.opaque(backend.UInt32, 0),
            local_size(contents.width),
            local_size(contents.total),
            kinds,
            any(layer.linear_count > 0 for layer in layers),
        )

    def of_network(self, index: Index) -> LayerTables:
        """The tables of another network, for each lane."""
        return replace(self, network=index)

    def output(self) -> tuple[Real, Real]:
        """The number that is added to the output, and a bound of the output's error."""
        f, at = self.backend.Float, self.network * 2
        return dr.gather(f, self.outputs, at), dr.gather(f, self.outputs, at + 1)

    def layer(self, index: Index) -> LayerNumbers:
        """The numbers of a layer, from 0."""
        u, f, n, m = self.backend.UInt32, self.backend.Float, len(_INTEGERS), len(_FLOATS)
        index = self.network * self.layer_count + index
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
            parts: list[Any] = [None] * (count * ROWS)
            for c in range(_COLUMNS):
                column = i * _COLUMNS + c
                at = packet + (row * (columns * _COLUMNS) + column) * (ROWS // PACKET)
                weights = self._packet(at) + self._packet(at + 1)
                sizes = [dr.abs(weight) for weight in weights] if positive else []
                for q, vector in enumerate(inputs):
                    x = vector[column]
                    if q == count - positive:
                        weights = sizes
                    for r in range(ROWS):
                        k = q * ROWS + r
                        part = parts[k]
                        parts[k] = weights[r] * x if part is None else dr.fma(weights[r], x, part)
            return i + 1, row, inputs, [a + b for a, b in zip(sums, parts, strict=True)]

        def row_step(state: Any) -> Any:
            """Compute a block of rows."""
            row, inputs, outputs = state
            zeros = [self.backend.Float(0) + 0 * self.backend.Float(row)] * (count * ROWS)
            _, _, inputs, sums = loop(
                (u(0), row, inputs, zeros), lambda s: s[0] < columns, column_step, "columns"
            )
            for q, vector in enumerate(outputs):
                for r in range(ROWS):
                    vector[row * ROWS + r] = sums[q * ROWS + r]
            return row + 1, inputs, outputs

        _, inputs, outputs = loop((u(0), inputs, outputs), lambda s: s[0] < rows, row_step, "rows")
        return inputs, outputs

    def multiply_back(self, inputs: Any, outputs: Any, layer: LayerNumbers) -> tuple[Any, Any]:
        """Multiply a vector in local memory by the transpose of a layer's matrix. Returns the
        changed `inputs` and `outputs`.

        Each block of rows adds sums of `ROWS` products, each by chains of four fused multiply-adds,
        to all entries (`_back_sum_error`).
        """
        u, zero = self.backend.UInt32, self.backend.Float(0)

        def clear(state: Any) -> Any:
            """Set an entry to zero."""
            i, outputs = state
            outputs[i] = zero
            return i + 1, outputs

        def column_step(state: Any) -> Any:
            """Add the sums of four columns."""
            i, row, y, outputs = state
            for c in range(_COLUMNS):
                column = i * _COLUMNS + c
                at = layer.weights + (row * (layer.columns * _COLUMNS) + column) * (ROWS // PACKET)
                weights = self._packet(at) + self._packet(at + 1)
                parts = [weights[k] * y[k] for k in range(4)]
                for k in range(4, ROWS):
                    parts[k % 4] = dr.fma(weights[k], y[k], parts[k % 4])
                outputs[column] += (parts[0] + parts[1]) + (parts[2] + parts[3])
            return i + 1, row, y, outputs

        def row_step(state: Any) -> Any:
            """Add a block of rows."""
            row, inputs, outputs = state
            y = [inputs[row * ROWS + k] for k in range(ROWS)]
            start = (u(0), row, y, outputs)
            _, _, _, outputs = loop(start, lambda s: s[0] < layer.columns, column_step, "columns")
            return row + 1, inputs, outputs

        count = layer.columns * _COLUMNS
        _, outputs = loop((u(0), outputs), lambda s: s[0] < count, clear, "clear")
        start = (u(0), inputs, outputs)
        _, inputs, outputs = loop(start, lambda s: s[0] < layer.rows, row_step, "rows back")
        return inputs, outputs

    def _packet(self, index: Index) -> list[Real]:
        """Eight weights."""
        packet = dr.gather(self.backend.ArrayXf, self.weights, index, shape=(PACKET, 1))
        return [packet[j] for j in range(PACKET)]


def _sum_error(columns: int) -> float:
    """A bound, in units of u, of the relative rounding error of a row's sum and of two further
    operations, of weights rounded to single precision, and of terms of second order."""
    return 1.001 * (_COLUMNS + columns // _COLUMNS + 4)


def _back_sum_error(rows: int) -> float:
    """The same bound for sums over rows (`LayerTables.multiply_back`)."""
    return 1.001 * (ROWS // 4 + 2 + rows // ROWS + 4)


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
