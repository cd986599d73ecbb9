"""Sums of blobs: values at a point; ranges of the first two derivatives along a path, for each of
its pieces; and jets (ranges of value and derivatives in several variables).

Each sum is one loop over the blobs. Positions are relative to each blob and in units of its own
support, so that the same bounds hold for blobs of every size. Jets allow blobs to be deformed and
blended.

Rounding. Let u be the unit roundoff and f the function of one blob along the path. The path has
the direction d, and s is the position on it. Let v be the vector from the start of the path to the
blob's center, in units of the support's radius, and k(q) the kernel, with q = |v|^2 at the start.

- Centers are stored as the sum of two numbers, so that the error of v is at most 4u|v|.
- Let t = v.d, h the distance of the line from the center (h, not its square), and x = s - t the
  position on the line. Wherever the blob is not 0, t, h and x have errors of at most 8u(2 + |t|).
  That is a displacement of the blob relative to the path. It also covers that |d| differs from 1 by
  up to 2u.
- A displacement by e changes f' by at most e times `KernelLipschitz.slope`, and f'' by at most e
  times `KernelLipschitz.bend`. If `BlobKernel.lipschitz_fraction` is less than 1, both bounds are
  multiplied by it. (At the end of the support f'' may jump; there the test whether a point is in
  the support has a margin.)
- A sum of n terms adds an error of n u times the sum of their largest absolute values. This error
  and that of the displacement are added to the ranges of derivatives, outwards.
- The error of the value at the start is at most 8u |dk/dq| by the rounding of q, plus (16 + n)u m,
  with m as in `BlobKernel.profile`.
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
# A function (record of a blob, state) that returns the state with that blob added.
EachBlob: TypeAlias = "Callable[[list[Real], State], State]"
# A function (each_blob, state) that applies an `EachBlob` to one blob after another, starting with
# this state, and returns the last state.
ForEach: TypeAlias = "Callable[[EachBlob, State], State]"


@dataclass(frozen=True)
class SumValue:
    """A sum of blobs at points: its value and gradient, and bounds of their rounding errors."""

    value: Real
    gradient: Vec3
    error: Real
    gradient_error: Real


# The number of pieces of a path that is fastest: for a sum over all blobs, and for a sum over the
# blobs of a grid cell. In a cell paths are short, and finding the blobs costs more than ranges.
PIECES, PIECES_IN_CELL = 4, 3


@dataclass(frozen=True)
class SumOnRay:
    """A sum of blobs along a path p + s d. It has the methods of `PathRestriction`, from which
    enclosures (proofs about the sum along the path) are made.

    start: the sum at p.
    parts: ranges of the first two derivatives, for each piece of the path.
    """

    start: SumValue
    parts: tuple[PathPiece, ...]

    @property
    def piece_count(self) -> int:
        """The number of pieces of the path."""
        return len(self.parts)

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """The ranges on the pieces. They hold only for the knots with which the sum was computed,
        and these must be passed."""
        assert len(knots) == len(self.parts) + 1
        return self.parts


class KnotRecorder:
    """A stand-in for a function restricted to a path (`PathRestriction`). A proof asks it for
    ranges of derivatives on the pieces between knots, which are positions on the path. It records
    these knots, so that the ranges can be computed afterwards.

    piece_count: the number of pieces.

    knots: the recorded knots; None until a proof has asked.
    """

    def __init__(self, piece_count: int = PIECES) -> None:
        self.piece_count = piece_count
        self.knots: tuple[Real, ...] | None = None

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """Record the knots. The ranges that are returned are placeholders."""
        self.knots = tuple(knots)
        ends = itertools.pairwise(knots)
        return tuple(PathPiece(b - a, SlopeRange(0.0, 0.0), 0.0, 0.0) for a, b in ends)


def value_at(kernel: BlobKernel, backend: Backend, p: Vec3, for_each: ForEach) -> SumValue:
    """The sum of blobs at points p (3, n): value, gradient, and bounds of their rounding errors.

    for_each: the loop over the blobs that may be nonzero at p.
    """
    real = backend.Float

    def add_blob(row: list[Real], state: State) -> State:
        """The state of the sum (`_add_value`), with the blob of the record `row` added."""
        inverse, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse
        return _add_value(kernel, offset, inverse, amplitude, state)

    state = for_each(add_blob, tuple(real(0) for _ in range(_VALUE_STATE_SIZE)))
    return _finished_value(kernel, backend, state)


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
    """The sum of blobs along the paths p + s d, with ranges of its first two derivatives by s on
    the pieces between knots.

    p, d: (3, n) starts of the paths, and their unit directions.
    knots: increasing values of s, the first of them 0. There is one piece less than knots.
    for_each: the loop over the blobs that may be nonzero on the path.
    signed: whether amplitudes may be negative.
    """
    real = backend.Float
    count = len(knots) - 1
    u = 0.5 * backend.machine_epsilon
    jumps = kernel.second_derivative_jumps

    def add_blob(row: list[Real], state: State) -> State:
        """The state with the blob of record `row` added.

        The state is that of `_add_value`; then, for each piece, the ends of the ranges of the first
        and of the second derivative; then, for the rounding errors, the sums of the slope scales
        and of the scales of second derivatives, and the number of blobs near the path.
        """
        start, sums = state[:_VALUE_STATE_SIZE], list(state[_VALUE_STATE_SIZE:])
        inverse, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse
        start = _add_value(kernel, offset, inverse, amplitude, start)

        along = dr.dot(offset, d)
        from_line = offset - along * d
        line_distance_squared = dr.dot(from_line, from_line)
        height_squared = fmin(line_distance_squared, 1)
        half_chord_squared = 1 - height_squared
        chord = kernel.chord(height_squared, half_chord_squared)
        relative_size = 1 + dr.abs(along)
        margin = (64 * u) * relative_size
        positions = [dr.fma(knot, inverse, -along) for knot in knots]
        is_near = (
            (line_distance_squared < 1 + margin)
            & (positions[0] < 1 + margin)
            & (positions[-1] > -1 - margin)
        )
        slope_scale = amplitude * inverse
        second_scale = slope_scale * inverse

        a = clamp(positions[0], -chord.half_length, chord.half_length)
        first_at_a, second_at_a = kernel.derivatives(height_squared, half_chord_squared, a)
        for k in range(count):
            b = clamp(positions[k + 1], -chord.half_length, chord.half_length)
            first_at_b, second_at_b = kernel.derivatives(height_squared, half_chord_squared, b)
            slopes = _first_derivative_range(chord, a, b, first_at_a, first_at_b)
            seconds = _second_derivative_range(chord, a, b, second_at_a, second_at_b)
            if jumps:
                seconds = _with_jumps(
                    seconds, half_chord_squared, margin, positions[k], positions[k + 1]
                )
            for index, (lower, upper), scale in (
                (0, slopes, slope_scale),
                (2, seconds, second_scale),
            ):
                if signed:
                    positive = scale > 0
                    lower, upper = (
                        dr.select(positive, lower, upper),
                        dr.select(positive, upper, lower),
                    )
                sums[4 * k + index] = dr.fma(lower, scale, sums[4 * k + index])
                sums[4 * k + index + 1] = dr.fma(upper, scale, sums[4 * k + index + 1])
            a, first_at_a, second_at_a = b, first_at_b, second_at_b

        nearest = fmax(fmax(positions[0], -positions[-1]), 0)
        fraction = kernel.lipschitz_fraction(half_chord_squared, nearest * nearest)
        weight = dr.select(is_near, (relative_size + 1) * fraction, 0)
        sums[-3] = dr.fma(dr.abs(slope_scale), weight, sums[-3])
        sums[-2] = dr.fma(dr.abs(second_scale), weight, sums[-2])
        sums[-1] = sums[-1] + dr.select(is_near, real(1), 0)
        return (*start, *sums)

    state = for_each(add_blob, tuple(real(0) for _ in range(_VALUE_STATE_SIZE + 4 * count + 3)))
    steepness = kernel.steepness
    slope_size, second_size, term_count = state[-3:]
    rounding = u * (16 + term_count)
    slope_error = rounding * steepness.slope * slope_size
    second_error = rounding * steepness.bend * second_size
    pieces: list[PathPiece] = []
    for k, (begin, end) in enumerate(itertools.pairwise(knots)):
        lower, upper, min_second, max_second = state[
            _VALUE_STATE_SIZE + 4 * k : _VALUE_STATE_SIZE + 4 * k + 4
        ]
        slopes = SlopeRange(lower - slope_error, upper + slope_error)
        pieces.append(
            PathPiece(end - begin, slopes, min_second - second_error, max_second + second_error)
        )
    return SumOnRay(_finished_value(kernel, backend, state[:_VALUE_STATE_SIZE]), tuple(pieces))


def hessian_at(kernel: BlobKernel, backend: Backend, p: Vec3, for_each: ForEach) -> State:
    """The Hessian of the sum at points p: its upper triangle, row by row, as 6 numbers.

    for_each: the loop over the blobs that may be nonzero at p.
    """

    def add_blob(row: list[Real], state: State) -> State:
        """The six sums with the second derivatives of the blob of record `row` added."""
        inverse, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse
        q = dr.dot(offset, offset)
        scale = amplitude * inverse * inverse
        diagonal = 2 * scale * kernel.profile(q)[1]
        mixed = 4 * scale * kernel.second_derivative(q)
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        return tuple(
            total + dr.select(q < 1, mixed * offset[i] * offset[j] + (diagonal if i == j else 0), 0)
            for total, (i, j) in zip(state, pairs, strict=True)
        )

    return for_each(add_blob, tuple(backend.Float(0) for _ in range(6)))


# The length of the part of the state for the value at the point: the value, the gradient, the sums
# for the errors, and the number of terms.
_VALUE_STATE_SIZE = 8


def _add_value(
    kernel: BlobKernel, offset: Vec3, inverse: Real, amplitude: Real, state: State
) -> State:
    """The state of the sum at a point p, with another blob added.

    The state consists of `_VALUE_STATE_SIZE` numbers: the value; the three components of the
    gradient; the sums of |A dk/dq| and of |A| m, for the error of the value; the sum of the blobs'
    bounds of the gradient, for its error; and the number of blobs near p. Here A is the amplitude,
    and k and m are those of `BlobKernel.profile`.

    offset: the vector from p to the blob's center, in units of its support's radius.
    inverse: 1 / that radius.
    """
    value, x, y, z, slope_sum, rounding_sum, gradient_size, term_count = state
    q = dr.dot(offset, offset)
    k, dk, rounding_scale = kernel.profile(q)
    slope = amplitude * dk
    gradient_factor = -2 * slope * inverse
    is_inside = q < 1.001
    abs_amplitude = dr.abs(amplitude)
    return (
        dr.fma(amplitude, k, value),
        dr.fma(gradient_factor, offset.x, x),
        dr.fma(gradient_factor, offset.y, y),
        dr.fma(gradient_factor, offset.z, z),
        slope_sum + dr.abs(slope),
        dr.fma(abs_amplitude, rounding_scale, rounding_sum),
        gradient_size
        + dr.select(is_inside, abs_amplitude * inverse * kernel.lipschitz_fraction(1.0, q), 0),
        term_count + dr.select(is_inside, type(q)(1), 0),
    )


def _finished_value(kernel: BlobKernel, backend: Backend, state: State) -> SumValue:
    """The value and gradient of a sum of blobs with bounds of their rounding errors, from the last
    state of `_add_value`."""
    value, x, y, z, slope_sum, rounding_sum, gradient_size, term_count = state
    roundoff = 0.5 * backend.machine_epsilon
    error = roundoff * dr.fma(16 + term_count, rounding_sum, 8 * slope_sum)
    gradient_error = roundoff * (32 + term_count) * kernel.steepness.slope * gradient_size
    return SumValue(value, backend.Array3f(x, y, z), error, gradient_error)


def _vector_to_center(p: Vec3, row: list[Real]) -> Vec3:
    """The vector from p to the center of the blob with record `row`."""
    return type(p)(*((row[k] - p[k]) + row[3 + k] for k in range(3)))


def _first_derivative_range(
    chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real
) -> tuple[Real, Real]:
    """The smallest and the largest value of the first derivative of a kernel along a line, for
    positions from a to b on the line.

    chord: the extreme values of the derivatives on the line.
    at_a, at_b: the first derivative at a and at b.
    """
    has_minimum = (a <= chord.steepest_position) & (b >= chord.steepest_position)
    has_maximum = (a <= -chord.steepest_position) & (b >= -chord.steepest_position)
    lower = dr.select(has_minimum, -chord.steepest, fmin(at_a, at_b))
    return lower, dr.select(has_maximum, chord.steepest, fmax(at_a, at_b))


def _second_derivative_range(
    chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real
) -> tuple[Real, Real]:
    """The smallest and the largest value of the second derivative of a kernel along a line, for
    positions from a to b on the line.

    chord: the extreme values of the derivatives on the line.
    at_a, at_b: the second derivative at a and at b.
    """
    has_minimum = (a <= 0) & (b >= 0)
    has_right_peak = (a <= chord.max_curvature_position) & (b >= chord.max_curvature_position)
    has_left_peak = (a <= -chord.max_curvature_position) & (b >= -chord.max_curvature_position)
    lower = dr.select(has_minimum, chord.min_second, fmin(at_a, at_b))
    return lower, dr.select(has_left_peak | has_right_peak, chord.max_second, fmax(at_a, at_b))


def _with_jumps(
    inner_range: tuple[Real, Real], half_chord_squared: Real, margin: Real, begin: Real, end: Real
) -> tuple[Real, Real]:
    """The range (lower, upper) of the second derivative, for a kernel whose second derivative jumps
    to 0 at the end of the support. It includes 0 where the piece of the path leaves the support,
    and is 0 alone where the piece does not meet the support.

    inner_range: the range inside the support.
    half_chord_squared: S^2, with S half the length of the chord.
    margin: a bound of the rounding of squared positions.
    begin, end: the positions of the ends of the piece, measured from the middle of the chord.
    """
    low, high = inner_range
    nearest = fmax(fmax(begin, -end), 0)
    meets_support = nearest * nearest < half_chord_squared + margin
    farthest = fmax(dr.abs(begin), dr.abs(end))
    leaves_support: Mask = ~(farthest * farthest <= half_chord_squared - margin)
    low, high = (
        dr.select(leaves_support, fmin(low, 0), low),
        dr.select(leaves_support, fmax(high, 0), high),
    )
    return dr.select(meets_support, low, 0), dr.select(meets_support, high, 0)


def for_each_record(records: RecordTable, *, active: Mask = True) -> ForEach:
    """Make the loop over all records of a table, on the active lanes. It is a function (body,
    state) that applies `body` to one record after another."""

    def for_each(body: EachBlob, state: State) -> State:
        """Apply `body` to all records, one after another. Returns the last state."""
        return records.for_each(body, state, "blobs", active)

    return for_each


def for_each_listed(records: RecordTable, entries: Any, begin: Any, end: Any) -> ForEach:
    """Make the loop over the records whose indices are entries[begin:end]. It is a function (body,
    state) that applies `body` to one record after another. Each lane may have its own begin and
    end."""
    kind = records.backend.UInt32

    def for_each(body: EachBlob, state: State) -> State:
        """Apply `body` to the records of the list, one after another. Returns the last state."""

        def step(i: Any, *state: Any) -> State:
            return i + 1, *body(records.read_record(dr.gather(kind, entries, i)), state)

        def has_more(i: Any, *_: Any) -> Mask:
            return i < end

        return dr.while_loop((kind(begin), *state), has_more, step, label="blobs of a cell")[1:]

    return for_each


Coordinates: TypeAlias = tuple[Jet, Jet, Jet]
Term: TypeAlias = "Callable[[list[Real]], Jet]"


def sum_jets(term: Term, like: Jet, zero: Real, for_each: ForEach) -> Jet:
    """The sum of the jets of all blobs. A jet consists of intervals of value and derivatives. The
    loop over the blobs has the ends of all intervals of the sum as its state.

    term: a function that returns the jet of a blob from its record.
    like: any jet of the same variables and piece.
    zero: the number 0 on each lane.
    for_each: the loop over the records.
    """

    def add_term(row: list[Real], state: State) -> State:
        """Add the jet of the blob in the record `row` to the sum, whose interval ends are the
        state."""
        total = jet_from_bounds(like, iter(state)) + term(row)
        return tuple(jet_bounds(total, zero))

    start = tuple(jet_bounds(like.constant(0.0), zero))
    return jet_from_bounds(like, iter(for_each(add_term, start)))


def blob_term(kernel: BlobKernel, coordinates: Coordinates) -> Term:
    """Make a function that returns the jet of a blob from its record. A jet consists of intervals
    of value and derivatives.

    coordinates: the jets of x, y and z at which the blob is evaluated.
    """
    function = kernel.function()

    def term(row: list[Real]) -> Jet:
        """The jet of the blob with record `row`: amplitude times k(q)."""
        inverse, amplitude = row[6], row[7]
        x, y, z = (((axis - row[k]) - row[3 + k]) * inverse for k, axis in enumerate(coordinates))
        return (x**2 + y**2 + z**2).apply(function) * amplitude

    return term


def jet_bounds(jet: Jet, zero: Real) -> Iterator[Any]:
    """The lower and upper bounds of all intervals of a jet, one after another, as numbers of the
    backend.

    zero: the number 0 on each lane.
    """
    for interval in (jet.value, *jet.first_derivatives, *jet.second_derivatives):
        yield zero + interval.lower
        yield zero + interval.upper
    if jet.jet_at_start is not None:
        yield from jet_bounds(jet.jet_at_start, zero)


def jet_from_bounds(like: Jet, ends: Iterator[Any]) -> Jet:
    """The jet whose bounds are the next numbers of `ends`: the inverse of `jet_bounds`.

    like: any jet of the same variables and piece.
    """
    value = Interval(next(ends), next(ends))
    first = tuple(Interval(next(ends), next(ends)) for _ in like.first_derivatives)
    second = tuple(Interval(next(ends), next(ends)) for _ in like.second_derivatives)
    start = None if like.jet_at_start is None else jet_from_bounds(like.jet_at_start, ends)
    return Jet(value, first, second, start, like.piece_length)
