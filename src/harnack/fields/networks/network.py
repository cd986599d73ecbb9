"""Neural networks as fields: multilayer perceptrons, whose level sets are traced with a proof."""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.arrays import upload_floats
from harnack.backend.elementary import clamp, fmin, safe_norm
from harnack.backend.validation import check_no_derivatives, make_read_only
from harnack.enclosures import Lipschitz, SlopeRange
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import RaySample, Sample
from harnack.fields.attached_arrays import attached_array, host_array, with_formula
from harnack.fields.batched_fields import FieldCache, cached_upload
from harnack.fields.clearance import occupied_cells
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits, copies_numbers, is_attached
from harnack.fields.networks.activations import Activation, ReLU, activation_of
from harnack.fields.networks.box_ranges import ranges_in_boxes
from harnack.fields.networks.cell_networks import networks_of_cells
from harnack.fields.networks.expansion import BallBound, Expansion, RayBound, expand
from harnack.fields.networks.layer_tables import (
    INPUTS,
    MAX_WIDTH,
    LayerTables,
    SmallNetwork,
    spectral_bound,
)
from harnack.fields.networks.network_grid import NetworkGrid
from harnack.fields.networks.torch_modules import layers_of_modules
from harnack.fields.networks.weight_derivatives import network_gradient, network_value
from harnack.fields.parameters import kept_arguments
from harnack.geometry.clip_volumes import Box
from harnack.tree.empty_space import OccupancyGrid

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, BoolArray, FloatArray, Real, Vec3
    from harnack.enclosures.samples import Ray
    from harnack.geometry.volume import Volume
    from harnack.tree.empty_space import BoxCells, EmptinessTest

__all__ = ["Network"]

Layer: TypeAlias = "tuple[FloatArray, FloatArray]"

# The radii of balls in which samples bound the gradient, as fractions of the domain's diagonal.
# The cells of the grids below, of which 8 and 32 are across, are a bit smaller than balls of them.
_RADII = (0.25, 0.07, 2.0**-6, 2.0**-8)
# On a ray the change is bounded up to the wanted length, and up to this part of it; the next sample
# asks for a length of so many proved steps. By experiment, as the numbers of cells.
_SHORTER, _REACH_GROWTH = 0.25, 4.0
_COARSE_CELLS, _CELLS = 8, 32
# For fewer rays than this no fine cells are made.
_MIN_RAYS = 2048
# The numbers of fine cells across for ReLU networks of at most so many weights, whose ranges are
# computed by products of matrices, and for others, which are sampled.
_CELLS_OF_RELU = ((20_000, 24), (300_000, _CELLS), (2_000_000, 16))
_CELLS_OF_OTHERS = ((20_000, _CELLS),)
# The largest number of weights of all small networks of cells: 128 MB in single precision.
_MAX_CELL_WEIGHTS = 1 << 25
# Lengths on rays are taken between these: beyond are only rays without an end.
_SHORTEST, _LONGEST = 1e-30, 1e15

# The largest weight and Lipschitz constant: the squares of which bounds are made must not overflow
# in single precision.
_MAX_WEIGHT = 1e17

_GRIDS: FieldCache[dict[Any, Any]] = FieldCache()


class Network(Field):
    """A neural network f: a multilayer perceptron that takes a point and gives one number, such as
    a signed distance, that was fitted to a shape. Its surface is the level set f = level, and f is
    smaller inside.

    Each layer but the last computes a(W x + b) from the values x of the layer before, with an
    activation function a; the last one is W x + b with a single row.

    **All proofs are about the network**, not about the shape that it was fitted to. The module
    `expansion` has them: along a ray f is a parabola up to remainders, which are bounded neuron by
    neuron and weighted by a pass backwards. Weights are data: another network of about the same
    size compiles nothing. In single precision the weights are rounded, which its errors include.

    layers: a sequence of pairs (W, b) of arrays (m, k) and (m,). The first k is 3, and the last m
        is 1; there are at least two layers, of at most 4,096 values. Or a mapping of such arrays by
        names, as of `from_file`: the state_dict of a module of PyTorch, or its named_parameters.
        Values, gradients and hits can be differentiated by arrays that are Dr.Jit tensors.
    activation: "relu", "tanh", "sine", "softplus" or "elu"; or a pair of such a name and its
        parameter: ("sine", w0) is sin(w0 z), with w0 = 30 by default, ("softplus", beta) is
        log(1 + exp(beta z))/beta, and ("elu", alpha) is alpha (exp z - 1) for z < 0, both with 1 by
        default. Or a list of these, one for each layer but the last.
    domain: a bounded volume in which f is drawn. None stands for the cube from -1 to 1, in which
        networks are trained mostly.
    level: the level that is drawn if the user names none.

    Promises (proved bounds of f near a point): Lipschitz constants in balls of four sizes, from
    ranges of the gradient (`expansion`), and the product of the norms of all layers everywhere.

    Source: new in harnack. Sharp and Jacobson 2022 (Spelunking the Deep) bound networks in boxes
        and along rays by affine arithmetic.

    Raises:
        ValueError: arrays of other shapes, NaN or infinity, another activation, or an unbounded
            domain.
        TypeError: layers that are no pairs of arrays of real numbers.
    """

    traits = Traits(over_relaxation=1.0, differentiable_arguments=("layers",))

    def __init__(
        self,
        layers: Sequence[tuple[Any, Any]] | Mapping[str, Any],
        *,
        activation: Any = "relu",
        domain: Volume | None = None,
        level: float = 0.0,
    ) -> None:
        """Check the layers, and compute a bound of the gradient."""
        pairs = _pairs_of_layers(layers)
        if not is_attached(self):  # numbers of what is no list, tuple or mapping would be lost
            check_no_derivatives(type(self).__name__, pairs)
        self.layers = _checked_layers(pairs)
        self.activation = activation
        self._activations = _checked_activations(activation, len(self.layers) - 1)
        self.domain = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)) if domain is None else domain
        lower, upper = self.domain.bounds()
        if not np.isfinite([lower, upper]).all():
            raise ValueError(f"the domain of a network must be a bounded volume, not {domain!r}")
        self.default_level = self.level = float(level)
        if not np.isfinite(self.level):
            raise ValueError(f"level must be a finite number, not {level!r}")
        bound = 1.0
        for weights, _ in self.layers:
            bound *= spectral_bound(weights)
        for entry in self._activations:
            bound *= entry.max_slope
        self.lipschitz = bound * (1 + 1e-9)
        sizes = [float(np.abs(entries).max()) for layer in self.layers for entries in layer]
        if not max(*sizes, self.lipschitz) <= _MAX_WEIGHT:  # it may be NaN
            raise ValueError(
                f"the weights of this network, or their products, are above {_MAX_WEIGHT:.0e}, the "
                "squares of which overflow in single precision: scale the network"
            )
        kinks = any(entry.kink(entry.parameter) != 0 for entry in self._activations)
        self.traits = dataclasses.replace(self.traits, has_creases=kinks)
        make_read_only(self.layers)

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        *,
        activation: Any = None,
        domain: Volume | None = None,
        level: float = 0.0,
    ) -> Self:
        """Read a network from a file of NumPy (.npz).

        path: of the file. Its arrays are named by a layer and "weight" or "bias", in the order of
            the numbers in the names: "0.weight", "0.bias", "2.weight", ... as in a state_dict of
            PyTorch, or "weight_0", "bias_0", "weight_1", .... An array "activation" may hold the
            name of the activation function, and "parameter" its number.
        activation: as of `Network`; None for what the file says, or else "relu".
        domain, level: as of `Network`.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: no .npz file, or no arrays with such names, or the errors of `Network`.
        """
        try:
            archive = np.load(os.fspath(path), allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ValueError(f"{os.fspath(path)} is no .npz file of NumPy: {error}") from None
        if not hasattr(archive, "files"):
            raise ValueError(f"{os.fspath(path)} holds a single array: save layers by numpy.savez")
        with archive:
            arrays = {name: archive[name] for name in archive.files}
        stored = str(arrays.pop("activation", "relu"))
        if "parameter" in arrays:
            stored = (stored, float(arrays.pop("parameter")))
        layers = _layers_of_names(arrays, os.fspath(path))
        return cls(
            layers, activation=stored if activation is None else activation, domain=domain,
            level=level,
        )  # fmt: skip

    @classmethod
    @copies_numbers
    def from_torch(cls, module: Any, *, domain: Volume | None = None, level: float = 0.0) -> Self:
        """Take the weights of a torch.nn.Sequential of Linear layers with an activation between
        each two: ReLU, Tanh, Softplus, ELU, or a module named Sine or SineLayer with an attribute
        w0 or omega_0. Sequentials may be nested. PyTorch is not imported.

        A Softplus of PyTorch is z itself beyond its threshold, by default 20, where this one
        differs from it by less than exp(-20)/beta.

        module: the module. Its weights are copied: later changes of it change nothing here, and
            nothing can be differentiated by them. For that, pass module.parameters() one by one to
            a function that `harnack.io.wrap_for_torch` has wrapped, and there make a `Network` of a
            mapping of them by their names.
        domain, level: as of `Network`.

        Raises:
            TypeError: another kind of module, which is named.
            ValueError: the modules are in another order, or the errors of `Network`.
        """
        layers, activations = layers_of_modules(module)
        return cls(layers, activation=activations, domain=domain, level=level)

    @property
    def widths(self) -> tuple[int, ...]:
        """The numbers of values of all layers, from the 3 coordinates to the 1 value."""
        return (INPUTS, *(len(weights) for weights, _ in self.layers))

    @property
    def weight_count(self) -> int:
        """The number of weights and biases."""
        return sum(weights.size + bias.size for weights, bias in self.layers)

    @property
    def _is_relu(self) -> bool:
        """Whether all activations are ReLUs."""
        return all(isinstance(entry, ReLU) for entry in self._activations)

    @property
    def _fine_cells(self) -> int | None:
        """The number of fine cells across the domain for many rays; None for no such cells."""
        choices = _CELLS_OF_RELU if self._is_relu else _CELLS_OF_OTHERS
        return next((cells for most, cells in choices if self.weight_count <= most), None)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        has_cells = bool(plan.levels) and plan.ray_count >= _MIN_RAYS and self._is_relu
        levels = plan.levels if has_cells and self._fine_cells is not None else ()
        data = self._upload(backend, levels)
        return _NetworkEvaluator(self, plan, self._fine_cells, self._activations, *data)

    def with_attached_numbers(self, backend: Backend) -> Network:
        """The copy whose formula has derivatives by weights and biases."""
        arguments = _pairs_of_layers(kept_arguments(self)["layers"])
        layers = [
            (attached_array(w, weights, backend), attached_array(b, bias, backend))
            for (w, b), (weights, bias) in zip(arguments, self.layers, strict=True)
        ]

        def value(p: Vec3) -> Real:
            return network_value(backend, layers, self._activations, p)

        def expression(p: Vec3) -> tuple[Real, Vec3]:
            return value(p), network_gradient(backend, layers, self._activations, p)

        return with_formula(self, expression, value)

    @cached_upload
    def _upload(
        self, backend: Backend, levels: tuple[float, ...]
    ) -> tuple[LayerTables, Real, Real, NetworkGrid | None]:
        """The tables on a backend; the Lipschitz constant; the diagonal of the domain; and which
        cells have small networks.

        levels: those for which cells have networks; () for none.
        """
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        networks = [SmallNetwork.of_layers(self.layers, self._activations)]
        grid = None
        if levels and self._fine_cells is not None:
            cells = self.cells(levels, self._fine_cells)
            small = networks_of_cells(
                self.layers, self._activations[0], cells.occupied_boxes(), _MAX_CELL_WEIGHTS
            )
            if small is not None:
                networks += small
                grid = NetworkGrid.upload(backend, cells)
        return (
            LayerTables.upload(backend, networks),
            dr.opaque(backend.Float, self.lipschitz * (1 + 1e-6)),
            dr.opaque(backend.Float, float(np.linalg.norm(upper - lower))),
            grid,
        )

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A box around the coarse cells of the domain that may contain one of the levels; the
        domain if none may."""
        grid = self.cells(levels, _COARSE_CELLS)
        centers = grid.occupied_centers()
        if not len(centers) or self.domain is None:
            return self.domain
        lower, upper = self.domain.bounds()
        half = 0.5001 * grid.cell_size
        low = np.maximum(centers.min(axis=0) - half, lower)
        high = np.minimum(centers.max(axis=0) + half, upper)
        if (low >= high).any():  # the grid reaches a bit beyond the domain
            return self.domain
        box = Box(tuple(low.tolist()), tuple(high.tolist()))
        return box if isinstance(self.domain, Box) else self.domain & box

    def cells(self, levels: tuple[float, ...], across: int) -> OccupancyGrid:
        """The grid over the domain with about `across` cells along its longest side. Cells that
        are not marked as occupied are proved to contain none of the levels. It is computed once
        for the last levels."""
        assert self.domain is not None
        grids, domain = _GRIDS.get(self, levels, dict), self.domain
        if across not in grids:
            if self._is_relu and self._fine_cells is not None:
                grids[across] = OccupancyGrid.from_test(
                    *domain.bounds(), self._emptiness_test(levels), across
                )
            else:
                grids[across] = occupied_cells(self, levels, domain, across)
        return grids[across]

    def _emptiness_test(self, levels: tuple[float, ...]) -> EmptinessTest:
        """A test of boxes: whether a ReLU network takes none of the levels in them, or they lie
        outside of the domain's box."""
        assert self.domain is not None
        lower, upper = self.domain.bounds()

        def is_empty(boxes: BoxCells, margin: float) -> BoolArray:
            room = margin * boxes.size
            is_apart = (boxes.corners - room > upper) | (boxes.corners + boxes.size + room < lower)
            reaches: BoolArray = ~np.any(is_apart, axis=1)
            ranges = ranges_in_boxes(self.layers, boxes.subset(reaches), margin)
            has_no_level = np.ones(len(boxes.corners), np.bool_)
            # NaN proves nothing.
            has_no_level[reaches] = np.logical_and.reduce(
                [(ranges.lower > level) | (ranges.upper < level) for level in levels]
            )
            return has_no_level

        return is_empty

    def describe(self) -> dict[str, Any]:
        """The shape of the network as a dictionary for users."""
        kinds = [entry.name for entry in self._activations]
        return {
            "widths": self.widths,
            "weights": self.weight_count,
            "activations": kinds[0] if len(set(kinds)) == 1 else tuple(kinds),
            "Lipschitz constant everywhere": self.lipschitz,
        }


def _pairs_of_layers(layers: Any) -> list[Any]:
    """The pairs of weights and bias of the argument `layers` of `Network`."""
    if isinstance(layers, Mapping):
        return list(_layers_of_names(dict(cast("Mapping[str, Any]", layers)), "the mapping"))
    if isinstance(layers, str | bytes) or not isinstance(layers, Iterable):
        raise TypeError(
            f"layers is a sequence of pairs (weights, bias) of arrays, not {type(layers).__name__}"
        )
    return list(cast("Iterable[Any]", layers))


def _checked_layers(pairs: list[Any]) -> tuple[Layer, ...]:
    """The layers as arrays of double precision. Raises the errors of `Network`."""
    if len(pairs) < 2:
        raise ValueError(f"a network needs at least two layers, not {len(pairs)}")
    checked: list[Layer] = []
    before = INPUTS
    for index, pair in enumerate(pairs):
        name = f"layer {index}"
        if not isinstance(pair, Sequence) or len(cast("Sequence[Any]", pair)) != 2:
            raise TypeError(
                f"{name} is no pair (weights, bias): layers = [(W0, b0), (W1, b1), ...]"
            )
        weights, bias = (
            host_array(part, f"{what} of {name}", type_error=TypeError)
            for part, what in zip(cast("Sequence[Any]", pair), ("weights", "bias"), strict=True)
        )
        if weights.ndim != 2 or weights.shape[1] != before or len(weights) == 0:
            raise ValueError(
                f"the weights of {name} must have shape (m, {before}), with a column for each "
                f"{'coordinate' if index == 0 else 'value of the layer before'}, not "
                f"{weights.shape}"
            )
        kind = cast("Any", type(cast("Any", pair)[1]))
        if bias.shape == () and dr.is_array_v(kind):  # a Dr.Jit array of one number
            bias = bias.reshape(1)
        if bias.shape != (len(weights),):
            raise ValueError(
                f"the bias of {name} must have shape ({len(weights)},), not {bias.shape}"
            )
        if len(weights) > MAX_WIDTH:
            raise ValueError(f"{name} has {len(weights):,} values, and may have {MAX_WIDTH:,}")
        if not (np.isfinite(weights).all() and np.isfinite(bias).all()):
            raise ValueError(f"{name} has weights that are NaN or infinite")
        checked.append((weights, bias))
        before = len(weights)
    if before != 1:
        raise ValueError(
            f"the last layer must have one row, since a field has one value, not {before}"
        )
    return tuple(checked)


def _checked_activations(choice: Any, count: int) -> tuple[Activation, ...]:
    """The activation functions of all layers but the last."""
    if not isinstance(choice, list):
        return (activation_of(choice),) * count
    choices = cast("list[Any]", choice)
    if len(choices) != count:
        raise ValueError(
            f"a list of activations has one for each layer but the last, {count}, not "
            f"{len(choices)}"
        )
    return tuple(activation_of(entry) for entry in choices)


def _layers_of_names(arrays: dict[str, Any], path: str) -> list[tuple[Any, Any]]:
    """The layers of arrays with names, in the order of the numbers in the names."""
    layers: dict[str, dict[str, Any]] = {}
    for name, array in arrays.items():
        match = re.search(r"weight|bias", name)
        if match is None:
            raise ValueError(
                f'{path} has an array {name!r}: names of layers contain "weight" or "bias", such '
                "as 0.weight and 0.bias, or weight_0 and bias_0"
            )
        layer = name[: match.start()] + name[match.end() :]
        layers.setdefault(layer, {})[match.group()] = array
    for layer, parts in layers.items():
        if len(parts) != 2:
            (part,) = parts
            raise ValueError(f"{path} has a {part} of layer {layer!r} and no other array of it")

    def numbers(name: str) -> list[int]:
        return [int(digits) for digits in re.findall(r"\d+", name)]

    return [(layers[name]["weight"], layers[name]["bias"]) for name in sorted(layers, key=numbers)]


@dataclass(frozen=True, eq=False)
class _NetworkEvaluator(Evaluator):
    """The evaluator of a network, which has the proofs in `expansion`.

    field: the network.
    plan: what it is used for.
    fine_cells: the number of fine cells across the domain for many rays; None for no such cells.
    activations: those of all layers but the last.
    tables: the weights.
    lipschitz: a Lipschitz constant of f everywhere.
    size: the diagonal of the domain.
    grid: the cells that have small networks; None for no such cells.
    """

    field: Network
    plan: Plan
    fine_cells: int | None
    activations: tuple[Activation, ...]
    tables: LayerTables
    lipschitz: Real
    size: Real
    grid: NetworkGrid | None

    def evaluate(self, p: Vec3) -> Sample:
        if self.grid is None:
            return self._sample_in_balls(p, self.tables, dr.inf)
        place = self.grid.place(p)
        return self._sample_in_balls(p, self.tables.of_network(place.network), place.radius)

    def _sample_in_balls(self, p: Vec3, tables: LayerTables, largest: Real) -> Sample:
        """The sample with bounds in balls. tables: of the network that is right in the ball of the
        radius `largest` around p."""
        radii = [fmin(self.size * part, largest) for part in _RADII]
        expansion = expand(tables, p, radii, None)
        norm = safe_norm(expansion.gradient) * (1 + 1e-5)
        bounds = cast("tuple[BallBound, ...]", expansion.bounds)
        balls = [Lipschitz(norm + bound.gradient_change, bound.radius) for bound in bounds]
        return self._sample(expansion, (*balls, self._everywhere(p)))

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with enclosures in front of it up to
        the length `ahead` and up to a part of it; in a cell with a small network, up to where the
        ray leaves the cell. If the caller asks for other kinds of enclosures, they follow from the
        sample at the point, of the whole network, whose balls are larger than cells."""
        p = path.point(t)
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            del ahead, back
            return path.enclose(self._sample_in_balls(p, self.tables, dr.inf))
        tables = self.tables
        if self.grid is not None:
            place = self.grid.place_on_ray(path, t, p)
            tables, ahead = tables.of_network(place.network), fmin(ahead, place.radius)
        length = clamp(ahead, _SHORTEST, _LONGEST)
        expansion = expand(tables, p, [length, _SHORTER * length], path.direction)
        slope = dr.dot(expansion.gradient, path.direction)
        rounding = 4 * self.tables.unit * safe_norm(expansion.gradient)
        around = SlopeRange.around(slope, expansion.linear_error + rounding)
        enclosures: list[ParabolaEnclosure] = []
        for bound in cast("tuple[RayBound, ...]", expansion.bounds):
            slopes = SlopeRange(around.lower + bound.lower_slope, around.upper + bound.upper_slope)
            enclosures.append(
                ParabolaEnclosure(slopes, bound.lower_second, bound.upper_second, bound.length)
            )
        sample = self._sample(expansion, (self._everywhere(p),))
        return RaySample(sample, tuple(enclosures), (), slope, _REACH_GROWTH, expansion.slope_error)

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        # The whole network: a ball may be larger than a cell.
        bounds = cast("tuple[BallBound, ...]", expand(self.tables, p, [radius], None).bounds)
        return bounds[0].gradient_change

    def differentiable_gradient(self, p: Vec3) -> Vec3:
        """grad f at p as an expression that Dr.Jit can differentiate with respect to p."""
        backend = self.tables.backend
        layers = [
            (upload_floats(backend, weights.ravel()), upload_floats(backend, bias))
            for weights, bias in self.field.layers
        ]
        return network_gradient(backend, layers, self.activations, p)

    def occupied_cells(self) -> OccupancyGrid | None:
        cells = self.fine_cells
        if cells is None or not self.plan.levels or self.plan.ray_count < _MIN_RAYS:
            return None
        return self.field.cells(self.plan.levels, cells)

    def _everywhere(self, p: Vec3) -> Lipschitz:
        """The Lipschitz constant everywhere."""
        return Lipschitz(0 * p.x + self.lipschitz)

    def _sample(self, expansion: Expansion, promises: tuple[Lipschitz, ...]) -> Sample:
        """The sample of an expansion."""
        return Sample(
            expansion.value,
            expansion.gradient,
            promises,
            expansion.value_error,
            expansion.gradient_error,
        )
