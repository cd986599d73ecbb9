"""The expansion of a neural network about a point, with proved remainders.

**The identity.** A neuron's value is a(z), where z = w . x + b is linear in the values x of the
layer before. Choose a number m for each neuron, about the slope of a at the point p, and let

    r(y) = a(z(y)) - a(z(p)) - m (z(y) - z(p))

be its remainder at another point y. Values of a layer depend on remainders of earlier layers
linearly, so f(y) - f(p) = g . (y - p) + sum A r(y) holds *exactly*, a sum over all neurons. A is
the derivative of the output by the neuron's value, and g the gradient by the point, both of the
network in which each a is replaced by multiplication with its m; both come from one pass backwards.
So each remainder enters once, with the weight and the sign that it really has, and nothing is
lost by bounding the values of layers one after another. It is needed only how far each z may move.

**How far z moves** from p along a ray to the length s <= L: z(s) - z(0) = t s + e(s), where t is
the derivative by s of the linear network, and |e(s)| <= s q. q is the smaller of two bounds. One is
sum |w_i| q_i over the values x_i of the layer before, each of which has a remainder of at most q_i
s: |m| times q of its own z, plus its own remainder per length. The other is |w| P, with the norm
|w| of the row and a bound P of the norm of all these remainders; in the next layer P is max |m| |W|
P, with the spectral norm |W|, plus the norm of the neurons' own remainders. The first one is
sharper where few neurons have a remainder, the second one where many have.

In a ball of radius L the same holds in all directions at once, for the Jacobian matrix in place of
the values: at a point of the ball the gradient of z differs from that of the linear network by at
most q, and in the next layer slopes take the place of m, and changes of slopes times gradients that
of remainders.

**A remainder.** Let a = g + k max(z, 0) (`activations`), z(s) - z(0) = d and d/s in [l, h]. By
Taylor's formula the part g adds q d^2/2, where q is a second derivative of g between the two z, and
|m - g'| |d| if m is not exactly the slope. The kink adds 0 if z keeps its sign. If z may reach 0 at
the speed v, from |z| away, it adds at most |k| max(v s - |z|, 0), of the sign of k; this is at
most c s^2/2 with c = 2 (v L - |z|)/L^2 if v L <= 2 |z|, and else at most s (v L - |z|)/L. (Both are
equal to it at s = L. The first one holds as (v s - |z|)/s^2 grows up to s = 2 |z|/v.) If rounding
hides the sign of z, it adds at most |k| |d| of either sign.

**Rounding** is a remainder, too. Let E bound the norm of the errors of the computed values x. A
computed z has an own error of at most (number of roundings) u (|w| |x| + |b|), by the inequality of
Cauchy and Schwarz, and in all e = |w| E plus that. The value a(z) is off by |m| times the own error
and what was made of E by the linear network, plus errors of second order, (q/2) e^2 or, at a
kink, |k| e, plus the error of computing a. Only the terms that are new at a neuron count, weighted
with |A|: the error of f is not the product of the norms of all layers. E itself grows as P does.
The computed A and tangents have errors whose norms are bounded in the same way.

A small network (`cell_networks`) stands for a larger one. Its z differ from those of the larger one
by numbers whose bound is a part of their own errors, and its output by at most `output_error`,
which is a part of `value_error`. The bounds of changes are about the small network. So f(s) of the
larger one lies within value -+ value_error plus the change, as the step's proof needs.

The idea to follow a network's range along a ray is from Sharp and Jacobson, Spelunking the Deep
(2022), by affine arithmetic; weighting relaxations of neurons by a pass backwards is from the
verification of networks (Zhang et al., CROWN, 2018).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.backend.local_memory import allocate_local
from harnack.fields.networks.layer_tables import INPUTS, LayerTables, loop

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Index, Mask, Real, Vec3
    from harnack.fields.networks.activations import ActivationPoint
    from harnack.fields.networks.layer_tables import LayerNumbers

__all__ = ["BallBound", "Expansion", "RayBound", "expand"]

_FiveNumbers: TypeAlias = "tuple[Any, Any, Any, Any, Any]"
# Covers the roundings of bounds, each of which is a sum or product of positive numbers, or a
# square root; sums over layers have their own factor.
_ROUND_UP = 1.002


@dataclass(frozen=True)
class RayBound:
    """Bounds of the change of f along a ray, f(s) - f(0) - slope s for 0 <= s <= length:
    between lower_slope s + lower_second s^2/2 and upper_slope s + upper_second s^2/2.
    """

    length: Real
    lower_slope: Real
    upper_slope: Real
    lower_second: Real
    upper_second: Real


@dataclass(frozen=True)
class BallBound:
    """A bound of |grad f(y) - gradient| for all y within `radius` of p.

    gradient_change: the bound, in which the error of the computed gradient is included.
    """

    radius: Real
    gradient_change: Real


@dataclass(frozen=True)
class Expansion:
    """The network at a point, with bounds near it.

    value, value_error: f, and a bound of its error.
    gradient: g; up to rounding it is the gradient of f.
    gradient_error: a bound of the error of g as the gradient of f at the point.
    linear_error: a bound of the error of g as the exact sum of the module's docstring.
    slope_error: a bound of the error of g . direction as the slope of f; None for balls.
    bounds: for each length or radius.
    """

    value: Real
    value_error: Real
    gradient: Vec3
    gradient_error: Real
    linear_error: Real
    slope_error: Real
    bounds: tuple[Any, ...]


def expand(
    tables: LayerTables, p: Vec3, lengths: Sequence[Real], direction: Vec3 | None
) -> Expansion:
    """The expansion about the points p.

    lengths: of the ray; or radii of balls.
    direction: of the ray; None for balls.
    """
    return _Forward.start(tables, p, lengths, direction).run().backward(p)


@dataclass(frozen=True)
class _Scalars:
    """Numbers of a layer's values x, for each lane.

    norm: |x|.
    error: E, the bound of the norm of the errors of x.
    tangent_norm, tangent_error: the norm of the three tangents of x, and of their errors.
    jacobian_error: a bound of the norm of the difference between the Jacobian matrix of x and that
        of the linear network at p itself.
    spread: for each length P, or D for a ball.
    """

    norm: Real
    error: Real
    tangent_norm: Real
    tangent_error: Real
    jacobian_error: Real
    spread: list[Real]


@dataclass(frozen=True)
class _Memory:
    """Local memory. `x`, `z`: vectors for the values and for the tangents of a layer, before and
    after the matrix. `kept`: numbers of all neurons of all layers, `_Forward.kept_names`."""

    x: list[Any]
    z: list[Any]
    kept: list[Any]


@dataclass(frozen=True)
class _Forward:
    """The pass forwards.

    state: the numbers of the values of the last layer that was computed.
    """

    tables: LayerTables
    lengths: list[Real]
    direction: Vec3 | None
    state: _Scalars
    memory: _Memory
    output: list[Real]
    zero: Real

    @classmethod
    def start(
        cls, tables: LayerTables, p: Vec3, lengths: Sequence[Real], direction: Vec3 | None
    ) -> _Forward:
        """The pass at the points themselves."""
        backend = tables.backend
        zero = backend.Float(0) + 0 * p.x

        def real(value: Any) -> Real:
            return zero + value

        axes: list[list[Real]] = [
            [real(float(i == k)) for i in range(INPUTS)] for k in range(INPUTS)
        ]
        spreads = len(lengths)
        count = 1 + INPUTS + spreads
        x = [allocate_local(backend, tables.width) for _ in range(count)]
        z = [allocate_local(backend, tables.width) for _ in range(count)]
        per_length = 1 if direction is None else 4
        kept_count = 4 + per_length * len(lengths)
        kept = [allocate_local(backend, tables.total) for _ in range(kept_count)]
        for vector, numbers in zip(
            x, [[real(p[k]) for k in range(3)], *axes, *[[zero] * 3] * spreads], strict=True
        ):
            for k in range(INPUTS):
                vector[backend.UInt32(k)] = numbers[k]
            vector[backend.UInt32(INPUTS)] = zero
        state = _Scalars(
            norm=dr.norm(p) * _ROUND_UP,
            error=zero,
            tangent_norm=real(1.7330),
            tangent_error=zero,
            jacobian_error=zero,
            spread=[zero for _ in lengths],
        )
        return cls(
            tables, [real(length) for length in lengths], direction, state,
            _Memory(x, z, kept), [zero, zero, zero], zero,
        )  # fmt: skip

    def run(self) -> _Forward:
        """Compute all layers."""

        def step(state: Any) -> Any:
            """Compute a layer."""
            index, forward = state[0], self._with(state[1:])
            return (index + 1, *forward._layer(index)._arrays())

        start = (self.tables.backend.UInt32(0), *self._arrays())
        count = self.tables.layer_count
        return self._with(loop(start, lambda s: s[0] < count, step, "layers")[1:])

    def _arrays(self) -> tuple[Any, ...]:
        """What changes from layer to layer."""
        s = self.state
        scalars = [s.norm, s.error, s.tangent_norm, s.tangent_error, s.jacobian_error]
        memory = self.memory
        return scalars, s.spread, memory.x, memory.z, memory.kept, self.output

    def _with(self, arrays: Any) -> _Forward:
        """This pass with other arrays."""
        scalars, spread, x, z, kept, output = arrays
        return dataclasses.replace(
            self,
            state=_Scalars(*cast("_FiveNumbers", tuple(scalars)), list(spread)),
            memory=_Memory(list(x), list(z), list(kept)),
            output=list(output),
        )

    def _layer(self, index: Index) -> _Forward:
        """The pass after another layer."""
        tables, layer = self.tables, self.tables.layer(index)
        x, z = tables.multiply(
            self.memory.x,
            self.memory.z,
            layer.weights,
            layer.columns,
            layer.rows,
            len(self.lengths),
        )
        before, zero = self.state, self.zero
        # Sums of squares: of values, errors, tangents, and for each length remainders or changes;
        # and wrong slopes; the largest |m|, for each length the largest slope, and that at p.
        n = len(self.lengths)
        sums = [zero] * (6 + 2 * n)

        def step(state: Any) -> Any:
            """Compute a neuron."""
            j, x, z, kept, sums, output = state
            neuron = _Neuron.at(self, layer, j, z)
            x[0][j] = neuron.point.value
            for vector, tangent in zip(x[1 : len(x) - n], neuron.tangents, strict=True):
                vector[j] = neuron.point.slope * tangent
            for vector, spread in zip(x[-n:], neuron.spreads(layer), strict=True):
                vector[j] = spread
            at = layer.place + j
            added = neuron.added()
            for vector, number in zip(kept, neuron.kept(), strict=True):
                vector[at] = number
            sums = [
                dr.fma(b, b, a) if k < 4 + n else fmax(a, b)
                for k, (a, b) in enumerate(zip(sums, added, strict=True))
            ]
            return j + 1, x, z, kept, sums, neuron.add_to(output)

        start = (tables.backend.UInt32(0), x, z, self.memory.kept, sums, self.output)
        _, x, z, kept, sums, output = loop(start, lambda s: s[0] < layer.count, step, "neurons")
        norms = [dr.sqrt(entry) * _ROUND_UP for entry in sums[: 4 + n]]
        slope, largest = sums[4 + n], sums[5 + n : -1]
        stretch = layer.spectral * _ROUND_UP
        gain = slope * stretch
        if self.direction is None:
            gains = [fmin(steepest, layer.max_slope) * stretch for steepest in largest]
        else:
            gains = [gain] * n
        spread = [
            dr.fma(by, old, new)
            for by, old, new in zip(gains, before.spread, norms[3 : 3 + n], strict=True)
        ]
        own = layer.forward_error * layer.frobenius * before.tangent_norm * slope
        state = _Scalars(
            norm=norms[0],
            error=dr.fma(gain, before.error, norms[1]),
            tangent_norm=norms[2],
            tangent_error=dr.fma(gain, before.tangent_error, own + 4 * tables.unit * norms[2]),
            jacobian_error=dr.fma(sums[-1] * stretch, before.jacobian_error, norms[3 + n]),
            spread=spread,
        )
        return self._with((
            [
                state.norm, state.error, state.tangent_norm, state.tangent_error,
                state.jacobian_error,
            ],
            spread, x, z, kept, output,
        ))  # fmt: skip

    def backward(self, p: Vec3) -> Expansion:
        """The pass backwards, from the output to the point."""
        tables = self.tables
        u, zero, unit = tables.backend.UInt32, self.zero, tables.unit
        lengths = self.lengths
        # The sums over neurons: value error, gradient error, slope error, and for each length.
        per_length = 1 if self.direction is None else 6
        sums = [zero] * (3 + per_length * len(lengths))
        x = self.memory.x[:1]

        def clear(state: Any) -> Any:
            """Start with zeros: the output adds its weights of a layer when that is reached."""
            j, x = state
            x[0][j] = zero
            return j + 1, x

        last = tables.layer(tables.layer_count - 1)
        _, x = loop((u(0 * zero), x), lambda s: s[0] < last.count, clear, "output")

        def layer_step(state: Any) -> Any:
            """Go back over a layer."""
            index, x, z, kept, sums, error = state
            layer = tables.layer(index - 1)
            # The weights of the output are rounded.
            error = dr.fma(unit, layer.output_norm, error)

            def step(inner: Any) -> Any:
                """Add the remainders of a neuron."""
                j, x, z, kept, sums, norms = inner
                at = layer.place + j
                a = x[0][j] + tables.neurons.read_record(layer.first + j)[2]
                numbers = [vector[at] for vector in kept]
                m = numbers[0]
                z[0][j] = m * a
                sums = self._summed(sums, numbers, a, dr.fma(2 * unit, dr.abs(a), error))
                squares = [dr.fma(m * a, m * a, norms[0]), dr.fma(a, a, norms[1])]
                return j + 1, x, z, kept, sums, [*squares, fmax(norms[2], dr.abs(m))]

            _, x, z, kept, sums, norms = loop(
                (u(0), x, z, kept, sums, [zero] * 3), lambda s: s[0] < layer.count, step, "back"
            )
            error = dr.fma(2 * unit * _ROUND_UP, dr.sqrt(norms[1]), error)
            z[0], x[0] = tables.multiply_back(z[0], x[0], layer)
            norm = dr.sqrt(norms[0]) * _ROUND_UP
            own = (layer.backward_error * layer.frobenius + 2 * unit * layer.spectral) * norm
            error = dr.fma(norms[2] * layer.spectral * _ROUND_UP, error, own * _ROUND_UP)
            return index - 1, x, z, kept, sums, error

        start = (
            tables.layer_count + u(0 * zero),
            x,
            self.memory.z[:1],
            self.memory.kept,
            sums,
            zero,
        )
        _, x, _, _, sums, error = loop(start, lambda s: s[0] > 0, layer_step, "layers back")
        gradient = type(p)(*(x[0][u(k)] for k in range(INPUTS)))
        return self._result(gradient, sums, error)

    def _summed(self, sums: list[Real], numbers: list[Real], a: Real, error: Real) -> list[Real]:
        """The sums, to which the remainders of a neuron are added.

        numbers: what was kept of it. a: A, with this error.
        """
        size = dr.abs(a) + error
        new = [
            dr.fma(size, number, total)
            for number, total in zip(numbers[1:4], sums[:3], strict=True)
        ]
        if self.direction is None:
            return new + [dr.fma(size, n, t) for n, t in zip(numbers[4:], sums[3:], strict=True)]
        for k in range((len(numbers) - 4) // 2):
            low, high = numbers[4 + 2 * k : 6 + 2 * k]
            below, above, total = sums[3 + 3 * k : 6 + 3 * k]
            largest = fmax(dr.abs(low), dr.abs(high))
            own = error * largest
            new.append(below + (fmin(a * low, a * high) - own))
            new.append(above + (fmax(a * low, a * high) + own))
            new.append(dr.fma(size, largest, total))
        return new

    def _result(self, gradient: Vec3, sums: list[Real], error: Real) -> Expansion:
        """The expansion. sums: over all neurons. error: of the gradient, by rounding."""
        tables, unit = self.tables, self.tables.unit
        bias, own_error = tables.output()
        value = self.output[0] + (self.output[1] + bias)
        # The sum of the output is compensated (Ogita, Rump and Oishi 2005, Dot2), and weights and
        # bias are rounded.
        size = self.output[2] * _ROUND_UP
        value_error = sums[0] * _ROUND_UP + unit * (3 * size + 4 * dr.abs(bias) + 2 * dr.abs(value))
        value_error = value_error + own_error * _ROUND_UP
        error = error + own_error * _ROUND_UP
        slope_error = sums[2] * _ROUND_UP + error + 4 * unit * dr.norm(gradient)
        bounds: list[Any] = []
        for k, length in enumerate(self.lengths):
            if self.direction is None:
                bounds.append(BallBound(length, sums[3 + k] * _ROUND_UP + error))
                continue
            # A sum of n numbers is off by at most n u times the sum of their absolute values.
            rounding = (tables.total + 16) * unit
            ends: list[Real] = []
            for i in (3 + 6 * k, 6 + 6 * k):
                low, high, total = sums[i : i + 3]
                ends += [low - rounding * total, high + rounding * total]
            bounds.append(RayBound(length, *ends))
        return Expansion(
            value, value_error, gradient, sums[1] * _ROUND_UP + error, error, slope_error,
            tuple(bounds),
        )  # fmt: skip


@dataclass(frozen=True)
class _Neuron:
    """A neuron at the points: its number z, a(z), its tangents, and how far z may move.

    norm, output_weight: of its row, and in the output.
    own_error, error: bounds of the error of z that is new at it, and of the whole one.
    tangents: of z. tangent_size: the norm of these, with its error.
    wrong_slope: a bound of the difference between m and the slope of the part g at the exact z.
    second: a bound of the second derivative of g within `error` of z.
    is_hidden: whether rounding hides the sign of z, at a kink.
    jacobian: a bound of the gradient of z.
    moves: for each length the remainder.
    """

    forward: _Forward
    point: ActivationPoint
    output_weight: Real
    own_error: Real
    error: Real
    tangents: list[Real]
    tangent_size: Real
    wrong_slope: Real
    second: Real
    kink: Real
    is_hidden: Mask
    jacobian: Real
    moves: list[_Move]

    @classmethod
    def at(cls, forward: _Forward, layer: LayerNumbers, j: Index, z: list[Any]) -> _Neuron:
        """Neuron j of a layer. z: products with its row, in local memory."""
        tables, before = forward.tables, forward.state
        bias, norm, output_weight, linear = tables.neurons.read_record(layer.first + j)[:4]
        number = z[0][j] + bias
        tangents = [vector[j] for vector in z[1 : len(z) - len(forward.lengths)]]
        rows = layer.forward_error * _ROUND_UP
        smallest = float(dr.smallest(tables.backend.Float)) * 4096
        own = dr.fma(rows, dr.fma(norm, before.norm, dr.abs(bias)), smallest + layer.own_error)
        error = dr.fma(norm, before.error, own) * _ROUND_UP
        tangent_error = dr.fma(norm, before.tangent_error, rows * norm * before.tangent_norm)
        squares = tangents[0] * tangents[0]
        for tangent in tangents[1:]:
            squares = dr.fma(tangent, tangent, squares)
        size = (dr.sqrt(squares) + tangent_error) * _ROUND_UP
        point, kink = _activate(tables, layer, number, linear != 0)
        second = _largest(_second_range(tables, layer, number, error, error))
        is_hidden = (kink != 0) & (dr.abs(number) <= error)
        wrong = dr.fma(second, error, point.slope_error)
        neuron = cls(
            forward, point, output_weight, own, error, tangents, size, wrong, second, kink,
            is_hidden, dr.fma(norm, before.jacobian_error, size) * _ROUND_UP, [],
        )  # fmt: skip
        moves = [
            _Move.at(neuron, layer, number, fmin(norm * spread, vector[j]), tangent_error, length)
            for spread, vector, length in zip(
                before.spread, z[len(z) - len(forward.lengths) :], forward.lengths, strict=True
            )
        ]
        return dataclasses.replace(neuron, moves=moves)

    @property
    def local_error(self) -> Real:
        """The part of the error of a(z) that does not come from that of x by the linear network."""
        kink = dr.select(self.is_hidden, dr.abs(self.kink), 0)
        first = dr.abs(self.point.slope) * self.own_error + self.point.value_error
        second = (kink + self.point.slope_error + 0.5 * self.second * self.error) * self.error
        return first + second

    @property
    def slope_change(self) -> Real:
        """A bound of the difference between m and the slope of a at the exact z."""
        return self.wrong_slope + dr.select(self.is_hidden, dr.abs(self.kink), 0)

    def kept(self) -> list[Real]:
        """What the pass backwards needs: m; the errors of value, of the gradient, and of the slope
        along the ray; and the remainders."""
        change = self.slope_change
        fastest = self.moves[0].fastest if self.moves else self.tangent_size
        numbers = [self.point.slope, self.local_error, change * self.jacobian, change * fastest]
        for move in self.moves:
            numbers += move.kept()
        return numbers

    def added(self) -> list[Real]:
        """What is added to the sums of a layer."""
        slope = dr.abs(self.point.slope)
        lists = [self.point.value, self.local_error, slope * self.tangent_size]
        lists += [move.remainder for move in self.moves]
        lists += [self.slope_change * self.tangent_size, slope + self.point.slope_error]
        return [*lists, *(slope + move.change for move in self.moves), slope + self.slope_change]

    def spreads(self, layer: LayerNumbers) -> list[Real]:
        """For each length a bound, for the value a(z), of what `_Move.spread` bounds for z."""
        spreads: list[Real] = []
        for move in self.moves:
            slope = dr.abs(self.point.slope)
            if move.is_ball:
                slope = fmin(slope + move.change, layer.max_slope)
            spreads.append(dr.fma(slope, move.spread, move.remainder) * _ROUND_UP)
        return spreads

    def add_to(self, output: list[Real]) -> list[Real]:
        """The output, to which the neuron's value with its weight is added: the sum of two numbers,
        of which the second collects the rounding errors of the first; and the sum of all absolute
        values."""
        high, low, size = output
        product = self.output_weight * self.point.value
        rest = dr.fma(self.output_weight, self.point.value, -product)
        total = high + product
        part = total - high
        lost = (high - (total - part)) + (product - part)
        return [total, low + (lost + rest), size + dr.abs(product)]


@dataclass(frozen=True)
class _Move:
    """The remainder of a neuron for a length s <= L: between low s + low_second s^2/2 and high s +
    high_second s^2/2.

    fastest: a bound of |z(s) - z(0)|/s.
    change: a bound of the change of the slope, m included.
    """

    fastest: Real
    low: Real
    high: Real
    low_second: Real
    high_second: Real
    change: Real
    length: Real
    gradient: Real
    jacobian: Real
    spread: Real
    is_ball: bool

    @classmethod
    def at(
        cls, neuron: _Neuron, layer: LayerNumbers, z: Real, spread: Real, tangent_error: Real,
        length: Real,
    ) -> _Move:  # fmt: skip
        """The remainder for a length. spread: |w| P, or |w| D."""
        tables, is_ball = neuron.forward.tables, neuron.forward.direction is None
        if is_ball:
            fastest = neuron.tangent_size + spread * _ROUND_UP
            slowest = -fastest
        else:
            direction = neuron.forward.direction
            assert direction is not None
            tx, ty, tz = neuron.tangents
            tangent = tx * direction[0] + ty * direction[1] + tz * direction[2]
            width = (spread + tangent_error) * _ROUND_UP + 4 * tables.unit * neuron.tangent_size
            fastest, slowest = tangent + width, tangent - width
        speed = fmax(dr.abs(fastest), dr.abs(slowest))
        longest = length * _ROUND_UP
        above = dr.fma(fmax(fastest, 0), longest, neuron.error)
        below = dr.fma(fmax(-slowest, 0), longest, neuron.error)
        low, high = _second_range(tables, layer, z, below, above)
        most = speed * speed
        least = dr.select(
            (fastest < 0) | (slowest > 0), fmin(dr.square(fastest), dr.square(slowest)), 0
        )
        second_low = fmin(low * least, low * most)
        second_high = fmax(high * least, high * most)
        wrong = neuron.wrong_slope * speed
        size, margin = dr.abs(neuron.kink), dr.abs(z) - neuron.error
        toward = dr.select(z > 0, -slowest, fastest)
        over = dr.fma(toward, longest, -margin) + 8 * tables.unit * dr.abs(z)
        is_crossing = (over > 0) & ~neuron.is_hidden & (size > 0)
        is_short = toward * longest <= 2 * margin
        slope = dr.select(is_crossing & ~is_short, size * over / length, 0)
        second = dr.select(is_crossing & is_short, 2 * size * over / (length * length), 0)
        hidden = dr.select(neuron.is_hidden, size * speed, 0)
        up = neuron.kink > 0
        change = dr.fma(_largest((low, high)), speed * longest, neuron.wrong_slope)
        change = change + dr.select(is_crossing | neuron.is_hidden, size, 0)
        return cls(
            speed,
            -wrong - hidden - dr.select(~up, slope, 0),
            wrong + hidden + dr.select(up, slope, 0),
            second_low - dr.select(~up, second, 0),
            second_high + dr.select(up, second, 0),
            change,
            length,
            change * fastest,
            change * neuron.tangent_size,
            spread,
            is_ball,
        )

    @property
    def remainder(self) -> Real:
        """What is new at the neuron: of the remainder per length or, for a ball, of the change of
        the Jacobian matrix."""
        if self.is_ball:
            return self.jacobian
        linear = fmax(dr.abs(self.low), dr.abs(self.high))
        second = fmax(dr.abs(self.low_second), dr.abs(self.high_second))
        return dr.fma(0.5 * self.length, second, linear)

    def kept(self) -> list[Real]:
        """What the pass backwards needs: the four numbers; or a bound of the change of the
        gradient."""
        if self.is_ball:
            return [self.gradient]
        return [self.low, self.high, self.low_second, self.high_second]


def _largest(ends: tuple[Real, Real]) -> Real:
    """The largest absolute value in a range."""
    return fmax(dr.abs(ends[0]), dr.abs(ends[1]))


def _activate(
    tables: LayerTables, layer: LayerNumbers, z: Real, is_linear: Mask
) -> tuple[ActivationPoint, Real]:
    """The activation function of a layer at z, and its kink. is_linear: mask of linear neurons."""
    point, kink = None, None
    for index, kind in enumerate(tables.activations):
        other = kind.at(z, layer.parameter)
        other_kink = type(z)(kind.kink(layer.parameter))
        if point is None:
            point, kink = other, other_kink
            continue
        is_kind = layer.kind == index
        names = "value", "slope", "value_error", "slope_error"
        numbers = [dr.select(is_kind, getattr(other, k), getattr(point, k)) for k in names]
        point, kink = type(point)(*numbers), dr.select(is_kind, other_kink, kink)
    assert point is not None
    if tables.has_linear:  # only ReLUs are beside linear ones: no other numbers change
        number, slope = dr.select(is_linear, z, point.value), dr.select(is_linear, 1, point.slope)
        point = dataclasses.replace(point, value=number, slope=slope)
        kink = dr.select(is_linear, 0, kink)
    return point, kink


def _second_range(
    tables: LayerTables, layer: LayerNumbers, z: Real, below: Real, above: Real
) -> tuple[Real, Real]:
    """The range of second derivatives of the smooth part of a layer's activation function."""
    low, high = type(z)(0), type(z)(0)
    for index, kind in enumerate(tables.activations):
        ends = kind.second_range(z, below, above, layer.parameter)
        if index == 0:
            low, high = ends
            continue
        is_kind = layer.kind == index
        low, high = dr.select(is_kind, ends[0], low), dr.select(is_kind, ends[1], high)
    return low, high
