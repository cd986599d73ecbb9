"""Sums of blobs: at a point; along a path, with ranges of both derivatives on its pieces; and as
jets.

Each is one loop over the blobs. Positions are relative to each blob and in units of its own
support, so that the same bounds hold for blobs of every size. Jets allow blobs to be deformed and
blended.

Rounding. Let u be the unit roundoff, v the vector from the point to a center in units of the
support, t = v.d. Centers are stored as the sum of two numbers, so that the error of v is at most
4u|v|. Then the errors of t, of the distance h of the line from the center (as a length) and of the
positions x = s - t are at most 8u(2 + |t|) where they matter. That is a displacement of the blob
relative to the path, which also covers that |d| is 1 only up to 2u. A displacement by e changes f'
by at most `KernelLipschitz.slope` times e, and f'' by `KernelLipschitz.bend` times e (its jumps at
the end of the support are tested for within a margin), or by `BlobKernel.lipschitz_fraction` of
these bounds. A sum of n terms adds n u times the sum of their largest absolute values. Both are
added to the ranges, outwards. The error of the value at the point is at most 8u |dk/dq|, by the
rounding of q, plus (16 + n)u m, with m as in `BlobKernel.profile`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.enclosures import SlopeRange
from harnack.enclosures.enclosure import PathPiece

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.fields.blobs.kernels import BlobKernel, ChordProfile

State: TypeAlias = "tuple[Any, ...]"
# A function of the record of a blob and of a state: the state with that blob added.
EachBlob: TypeAlias = "Callable[[list[Real], State], State]"
# A function that applies an `EachBlob` to all blobs that matter, from an initial state.
ForEach: TypeAlias = "Callable[[EachBlob, State], State]"


@dataclass(frozen=True)
class SumValue:
    """A sum of blobs at points: its value and gradient, and bounds of their rounding errors."""

    value: Real
    gradient: Vec3
    error: Real
    gradient_error: Real


# The fastest number of pieces of a path, for sums over all blobs, and for sums over the blobs of a
# cell, where lengths are short. Finding the blobs costs more than ranges.
PIECES, PIECES_IN_CELL = 4, 3


@dataclass(frozen=True)
class SumOnRay:
    """A sum along the path from p: its value at p, and ranges of its derivatives on pieces (a
    `PathRestriction`)."""

    start: SumValue
    parts: tuple[PathPiece, ...]

    @property
    def piece_count(self) -> int:
        """The number of pieces."""
        return len(self.parts)

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """The ranges, for the same knots for which they were computed."""
        assert len(knots) == len(self.parts) + 1
        return self.parts


class KnotRecorder:
    """A stand-in for a `PathRestriction` that records the knots that a proof asks for."""

    def __init__(self, piece_count: int = PIECES) -> None:
        self.piece_count = piece_count
        self.knots: tuple[Real, ...] | None = None

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """Record the knots; the ranges returned have no meaning."""
        self.knots = tuple(knots)
        ends = itertools.pairwise(knots)
        return tuple(PathPiece(b - a, SlopeRange(0.0, 0.0), 0.0, 0.0) for a, b in ends)


def value_at(kernel: BlobKernel, backend: Backend, p: Vec3, for_each: ForEach) -> SumValue:
    """The sum at points p."""
    real = backend.Float

    def body(row: list[Real], state: State) -> State:
        inverse, amplitude = row[6], row[7]
        v = _vector_to_center(p, row) * inverse
        return _add_value(kernel, v, inverse, amplitude, state)

    state = for_each(body, tuple(real(0) for _ in range(_VALUE_STATE_SIZE)))
    return _value(kernel, backend, state)


def sum_along(
    kernel: BlobKernel,
    backend: Backend,
    p: Vec3,
    d: Vec3,
    knots: Sequence[Real],
    for_each: ForEach,
    *,
    signed: bool = True,
) -> SumOnRay:
    """The sum along p + s d, with ranges of its derivatives on the pieces between knots.

    signed: whether amplitudes may be negative.
    """
    real = backend.Float
    count = len(knots) - 1
    u = 0.5 * backend.machine_epsilon
    jumps = kernel.second_derivative_jumps

    def body(row: list[Real], state: State) -> State:
        start, sums = state[:_VALUE_STATE_SIZE], list(state[_VALUE_STATE_SIZE:])
        inverse, amplitude = row[6], row[7]
        v = _vector_to_center(p, row) * inverse
        start = _add_value(kernel, v, inverse, amplitude, start)

        t = dr.dot(v, d)
        across = v - t * d
        squared = dr.dot(across, across)
        height = fmin(squared, 1)
        inside = 1 - height
        chord = kernel.chord(height, inside)
        size = 1 + dr.abs(t)
        margin = (64 * u) * size
        positions = [dr.fma(knot, inverse, -t) for knot in knots]
        is_near = (
            (squared < 1 + margin) & (positions[0] < 1 + margin) & (positions[-1] > -1 - margin)
        )
        slope_scale = amplitude * inverse
        bend_scale = slope_scale * inverse

        a = clamp(positions[0], -chord.half_length, chord.half_length)
        first_a, second_a = kernel.derivatives(height, inside, a)
        for k in range(count):
            b = clamp(positions[k + 1], -chord.half_length, chord.half_length)
            first_b, second_b = kernel.derivatives(height, inside, b)
            slopes = _slopes(chord, a, b, first_a, first_b)
            bends = _second_derivative_range(chord, a, b, second_a, second_b)
            if jumps:
                bends = _with_jumps(bends, inside, margin, positions[k], positions[k + 1])
            for index, (lower, upper), scale in ((0, slopes, slope_scale), (2, bends, bend_scale)):
                if signed:
                    positive = scale > 0
                    lower, upper = (
                        dr.select(positive, lower, upper),
                        dr.select(positive, upper, lower),
                    )
                sums[4 * k + index] = dr.fma(lower, scale, sums[4 * k + index])
                sums[4 * k + index + 1] = dr.fma(upper, scale, sums[4 * k + index + 1])
            a, first_a, second_a = b, first_b, second_b

        nearest = fmax(fmax(positions[0], -positions[-1]), 0)
        share = kernel.lipschitz_fraction(inside, nearest * nearest)
        weight = dr.select(is_near, (size + 1) * share, 0)
        sums[-3] = dr.fma(dr.abs(slope_scale), weight, sums[-3])
        sums[-2] = dr.fma(dr.abs(bend_scale), weight, sums[-2])
        sums[-1] = sums[-1] + dr.select(is_near, real(1), 0)
        return (*start, *sums)

    state = for_each(body, tuple(real(0) for _ in range(_VALUE_STATE_SIZE + 4 * count + 3)))
    steepness = kernel.steepness
    slope_size, bend_size, terms = state[-3:]
    rounding = u * (16 + terms)
    slope_error = rounding * steepness.slope * slope_size
    bend_error = rounding * steepness.bend * bend_size
    pieces: list[PathPiece] = []
    for k, (begin, end) in enumerate(itertools.pairwise(knots)):
        lower, upper, min_second, max_second = state[
            _VALUE_STATE_SIZE + 4 * k : _VALUE_STATE_SIZE + 4 * k + 4
        ]
        slopes = SlopeRange(lower - slope_error, upper + slope_error)
        pieces.append(
            PathPiece(end - begin, slopes, min_second - bend_error, max_second + bend_error)
        )
    return SumOnRay(_value(kernel, backend, state[:_VALUE_STATE_SIZE]), tuple(pieces))


def hessian_at(kernel: BlobKernel, backend: Backend, p: Vec3, for_each: ForEach) -> State:
    """The second derivatives (6,) of the sum at points p: the upper triangle row by row."""

    def body(row: list[Real], state: State) -> State:
        inverse, amplitude = row[6], row[7]
        v = _vector_to_center(p, row) * inverse
        q = dr.dot(v, v)
        scale = amplitude * inverse * inverse
        diagonal = 2 * scale * kernel.profile(q)[1]
        mixed = 4 * scale * kernel.second_derivative(q)
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        return tuple(
            total + dr.select(q < 1, mixed * v[i] * v[j] + (diagonal if i == j else 0), 0)
            for total, (i, j) in zip(state, pairs, strict=True)
        )

    return for_each(body, tuple(backend.Float(0) for _ in range(6)))


# The length of the part of the state for the value at the point: the value, the gradient, the sums
# for the errors, and the number of terms.
_VALUE_STATE_SIZE = 8


def _add_value(kernel: BlobKernel, v: Vec3, inverse: Real, amplitude: Real, state: State) -> State:
    """The state, of `_VALUE_STATE_SIZE` numbers, with another blob added.

    v: the vector from p to its center, in units of its support. inverse: of the support's radius.
    """
    value, x, y, z, slopes, scales, gradient_size, terms = state
    q = dr.dot(v, v)
    k, dk, scale = kernel.profile(q)
    slope = amplitude * dk
    radial = -2 * slope * inverse
    is_inside = q < 1.001
    size = dr.abs(amplitude)
    return (
        dr.fma(amplitude, k, value),
        dr.fma(radial, v.x, x),
        dr.fma(radial, v.y, y),
        dr.fma(radial, v.z, z),
        slopes + dr.abs(slope),
        dr.fma(size, scale, scales),
        gradient_size + dr.select(is_inside, size * inverse * kernel.lipschitz_fraction(1.0, q), 0),
        terms + dr.select(is_inside, type(q)(1), 0),
    )


def _value(kernel: BlobKernel, backend: Backend, state: State) -> SumValue:
    """The sum and its errors, from the state of the loop."""
    value, x, y, z, slopes, scales, gradient_size, terms = state
    roundoff = 0.5 * backend.machine_epsilon
    error = roundoff * dr.fma(16 + terms, scales, 8 * slopes)
    gradient_error = roundoff * (32 + terms) * kernel.steepness.slope * gradient_size
    return SumValue(value, backend.Array3f(x, y, z), error, gradient_error)


def _vector_to_center(p: Vec3, row: list[Real]) -> Vec3:
    """The vector from p to the center of a blob."""
    return type(p)(*((row[k] - p[k]) + row[3 + k] for k in range(3)))


def _slopes(chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real) -> tuple[Real, Real]:
    """The range of the first derivative between a and b."""
    falls = (a <= chord.steepest_position) & (b >= chord.steepest_position)
    rises = (a <= -chord.steepest_position) & (b >= -chord.steepest_position)
    lower = dr.select(falls, -chord.steepest, fmin(at_a, at_b))
    return lower, dr.select(rises, chord.steepest, fmax(at_a, at_b))


def _second_derivative_range(
    chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real
) -> tuple[Real, Real]:
    """The range of the second derivative between a and b."""
    center = (a <= 0) & (b >= 0)
    right = (a <= chord.max_curvature_position) & (b >= chord.max_curvature_position)
    left = (a <= -chord.max_curvature_position) & (b >= -chord.max_curvature_position)
    lower = dr.select(center, chord.min_second, fmin(at_a, at_b))
    return lower, dr.select(left | right, chord.max_second, fmax(at_a, at_b))


def _with_jumps(
    bends: tuple[Real, Real], inside: Real, margin: Real, begin: Real, end: Real
) -> tuple[Real, Real]:
    """The range of the second derivative, with 0 included where the piece leaves the support, and 0
    alone where it does not meet the support."""
    low, high = bends
    nearest = fmax(fmax(begin, -end), 0)
    meets = nearest * nearest < inside + margin
    farthest = fmax(dr.abs(begin), dr.abs(end))
    leaves: Mask = ~(farthest * farthest <= inside - margin)
    low, high = (dr.select(leaves, fmin(low, 0), low), dr.select(leaves, fmax(high, 0), high))
    return dr.select(meets, low, 0), dr.select(meets, high, 0)


def for_each_record(records: RecordTable, *, active: Mask = True) -> ForEach:
    """A loop over all records."""

    def for_each(body: EachBlob, state: State) -> State:
        return records.for_each(body, state, "blobs", active)

    return for_each


def for_each_listed(records: RecordTable, entries: Any, begin: Any, end: Any) -> ForEach:
    """A loop over the records of a list: `entries` from begin to end."""
    kind = records.backend.UInt32

    def for_each(body: EachBlob, state: State) -> State:
        def step(i: Any, *state: Any) -> State:
            return i + 1, *body(records.read_record(dr.gather(kind, entries, i)), state)

        def has_more(i: Any, *_: Any) -> Mask:
            return i < end

        return dr.while_loop((kind(begin), *state), has_more, step, label="blobs of a cell")[1:]

    return for_each


Coordinates: TypeAlias = tuple[Jet, Jet, Jet]
Term: TypeAlias = "Callable[[list[Real]], Jet]"


def sum_jets(term: Term, like: Jet, zero: Real, for_each: ForEach) -> Jet:
    """The sum of a jet for each record, in a loop whose state is the ends of all intervals.

    like: a jet of the same variables. zero: the number 0 on each lane.
    """

    def body(row: list[Real], state: State) -> State:
        total = jet_from_bounds(like, iter(state)) + term(row)
        return tuple(jet_bounds(total, zero))

    start = tuple(jet_bounds(like.constant(0.0), zero))
    return jet_from_bounds(like, iter(for_each(body, start)))


def blob_term(kernel: BlobKernel, coordinates: Coordinates) -> Term:
    """The function of a record that returns the jet of its blob, at jets of the coordinates."""
    function = kernel.function()

    def term(row: list[Real]) -> Jet:
        inverse, amplitude = row[6], row[7]
        x, y, z = (((axis - row[k]) - row[3 + k]) * inverse for k, axis in enumerate(coordinates))
        return (x**2 + y**2 + z**2).apply(function) * amplitude

    return term


def jet_bounds(jet: Jet, zero: Real) -> Iterator[Any]:
    """The bounds of all intervals of a jet, as numbers of the backend."""
    for interval in (jet.value, *jet.first_derivatives, *jet.second_derivatives):
        yield zero + interval.lower
        yield zero + interval.upper
    if jet.jet_at_start is not None:
        yield from jet_bounds(jet.jet_at_start, zero)


def jet_from_bounds(like: Jet, ends: Iterator[Any]) -> Jet:
    """The jet with these bounds, of the same variables as another jet: the inverse of
    `jet_bounds`."""
    value = Interval(next(ends), next(ends))
    first = tuple(Interval(next(ends), next(ends)) for _ in like.first_derivatives)
    second = tuple(Interval(next(ends), next(ends)) for _ in like.second_derivatives)
    start = None if like.jet_at_start is None else jet_from_bounds(like.jet_at_start, ends)
    return Jet(value, first, second, start, like.piece_length)
