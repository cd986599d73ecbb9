"""Sums of blobs, computed by one loop over the blobs: values at a point, and ranges of the first
two derivatives along a path. A blob is a bump around a center that ends at a certain distance, its
support; f is the sum of all blobs. A path p + s d is a straight line from a point p, where s >= 0
is the length along it; it is cut into pieces at knots, which are values of s. The record of a blob
is its row of eight numbers (center, size and amplitude). Loops are recorded by Dr.Jit: the state of
a loop is the tuple of numbers that it changes from one blob to the next, such as the sums so far. A
jet is a set of intervals that contain the values and derivatives of a function in several
variables; sums of jets allow blobs to be deformed and blended.

Positions are relative to each blob and in units of the radius of its own support, so that the same
bounds hold for blobs of every size.

Rounding. Let u be the unit roundoff. For one blob let v be the vector from the start p of the path
to the center, in units of the support's radius. Its kernel (the shape of the bump) is a function
k(q), with q = |v|^2 at the start. Let f1 be the blob as a function of s.

- Centers are stored as the sum of two numbers, so that the error of v is at most 4u|v|.
- Let t = v.d, let h be the distance of the line from the center (a length, not its square), and x =
  s - t the position on the line. Wherever the blob is not 0, t, h and x have errors of at most 8u(2
  + |t|). Such an error is a displacement of the blob relative to the path. The bound includes that
  |d| differs from 1 by up to 2u.
- A displacement by e changes f1' by at most e times `KernelLipschitz.slope`, and f1'' by at most e
  times `KernelLipschitz.bend`. If `BlobKernel.lipschitz_fraction` is less than 1, both bounds are
  multiplied by it. (At the end of the support f1'' may jump. So the test whether a point is in the
  support has a margin.)
- A sum of n terms adds an error of n u times the sum of their largest absolute values. The ranges
  of the derivatives of f are widened by this error and by that of the displacement.
- The error of the value at the start is at most 8u |dk/dq| by the rounding of q, plus (16 + n)u m,
  with m as in `BlobKernel.profile`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

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
    """The value and the gradient (3,) of a sum of blobs at points, with bounds of their rounding
    errors: `error` for the value, `gradient_error`, a length, for the gradient."""

    value: Real
    gradient: Vec3
    error: Real
    gradient_error: Real


# The number of pieces of a path that is fastest: for a sum over all blobs, and for a sum over the
# blobs of a grid cell. In a cell paths are short, and finding the blobs costs more than ranges.
PIECES, PIECES_IN_CELL = 4, 3


@dataclass(frozen=True)
class SumOnRay:
    """A sum of blobs f along a path p + s d (a straight line from p, with s >= 0 the length along
    it), cut into pieces. Proofs of bounds of f on the path are made from it. It has the methods of
    the protocol `PathRestriction`, which such proofs call.

    start: the value and gradient of f at p.
    parts: ranges of the first two derivatives of f by s, for each piece of the path.
    """

    start: SumValue
    parts: tuple[PathPiece, ...]

    @property
    def piece_count(self) -> int:
        """The number of pieces of the path."""
        return len(self.parts)

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """The ranges of the first two derivatives of the sum, for each piece of the path. They have
        been computed already, for pieces that end at certain knots (positions on the path).

        knots: these same knots; other knots are not possible.
        """
        assert len(knots) == len(self.parts) + 1
        return self.parts


class KnotRecorder:
    """Finds out at which positions of a path (knots) a proof wants to cut the path into pieces. The
    proof takes this object for a function along the path, and asks it for ranges of derivatives on
    the pieces between knots. The object records the knots, so that the real ranges can be computed
    afterwards.

    piece_count: the number of pieces.

    knots: the recorded knots; None until a proof has asked.
    """

    def __init__(self, piece_count: int = PIECES) -> None:
        self.piece_count = piece_count
        self.knots: tuple[Real, ...] | None = None

    def derivative_ranges(self, knots: Sequence[Real]) -> tuple[PathPiece, ...]:
        """Record the knots, which are increasing positions on the path. Returns zeros in place of
        the ranges of derivatives, one `PathPiece` for each piece between two knots."""
        self.knots = tuple(knots)
        ends = itertools.pairwise(knots)
        return tuple(PathPiece(b - a, SlopeRange(0.0, 0.0), 0.0, 0.0) for a, b in ends)


def value_at(kernel: BlobKernel, backend: Backend, p: Vec3, for_each: ForEach) -> SumValue:
    """The sum of blobs at points p (3, n): value, gradient, and bounds of their rounding errors.

    kernel: the shape of all blobs.
    for_each: a function that loops over the blobs that may be nonzero at p: for_each(add_blob,
        state) calls state = add_blob(record, state) for each of them and returns the last state.
    """
    real = backend.Float

    def add_blob(row: list[Real], state: State) -> State:
        """Return the numbers of the sum so far, with one more blob added; `_add_value` lists them.
        row: the blob's record. state: the numbers before."""
        # One over the radius of the blob's support, and the factor of its kernel.
        inverse_radius, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse_radius
        return _add_value(kernel, offset, inverse_radius, amplitude, state)

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
    the pieces between knots. The module docstring bounds its rounding.

    kernel: the shape of all blobs.
    p, d: (3, n) starts of the paths, and their unit directions.
    knots: increasing values of s, the first of them 0. There is one piece less than knots.
    for_each: a function that loops over the blobs that may be nonzero on the path:
        for_each(add_blob, state) calls state = add_blob(record, state) for each of them and returns
        the last state.
    signed: whether amplitudes (factors of the blobs) may be negative.
    """
    real = backend.Float
    count = len(knots) - 1
    u = 0.5 * backend.machine_epsilon
    jumps = kernel.second_derivative_jumps

    def add_blob(row: list[Real], state: State) -> State:
        """Return the sums so far (`state`), with one more blob added. row: the blob's record.

        The state begins with the numbers that `_add_value` lists. Then come, for each piece, the
        ends of the range of the first derivative and those of the second. The last three numbers
        are for the rounding errors. With A the amplitude of a blob and R the radius of its support,
        they are the sums, over the blobs near the path, of |A|/R and of |A|/R^2, each times a
        weight; and the number of these blobs.
        """
        start, sums = state[:_VALUE_STATE_SIZE], list(state[_VALUE_STATE_SIZE:])
        # Of a record, entry 6 is one over the radius of the support, and entry 7 the amplitude.
        inverse_radius, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse_radius
        start = _add_value(kernel, offset, inverse_radius, amplitude, start)

        # Lengths are from here on in units of the support's radius.
        along = dr.dot(offset, d)
        line_offset = offset - along * d
        line_distance_squared = dr.dot(line_offset, line_offset)
        height_squared = fmin(line_distance_squared, 1)
        half_chord_squared = 1 - height_squared
        chord = kernel.chord(height_squared, half_chord_squared)
        relative_size = 1 + dr.abs(along)
        # Margins keep rounding from counting a blob as too far away.
        margin = (64 * u) * relative_size
        positions = [dr.fma(knot, inverse_radius, -along) for knot in knots]
        is_near = (
            (line_distance_squared < 1 + margin)
            & (positions[0] < 1 + margin)
            & (positions[-1] > -1 - margin)
        )
        # What turns derivatives by lengths in these units into derivatives of the blob by s.
        slope_scale = amplitude * inverse_radius
        second_scale = slope_scale * inverse_radius

        # Outside of the chord the blob is 0. (`_with_jumps` is for derivatives that jump to 0.)
        piece_begin = clamp(positions[0], -chord.half_length, chord.half_length)
        first_at_begin, second_at_begin = kernel.derivatives(
            height_squared, half_chord_squared, piece_begin
        )
        for k in range(count):
            piece_end = clamp(positions[k + 1], -chord.half_length, chord.half_length)
            first_at_end, second_at_end = kernel.derivatives(
                height_squared, half_chord_squared, piece_end
            )
            slopes = _first_derivative_range(
                chord, piece_begin, piece_end, first_at_begin, first_at_end
            )
            seconds = _second_derivative_range(
                chord, piece_begin, piece_end, second_at_begin, second_at_end
            )
            if jumps:
                seconds = _with_jumps(
                    seconds, half_chord_squared, margin, positions[k], positions[k + 1]
                )
            # Add the range to the sums of the first derivative (index 0) or of the second one
            # (index 2).
            for index, (lower, upper), scale in (
                (0, slopes, slope_scale),
                (2, seconds, second_scale),
            ):
                if signed:
                    # A negative factor exchanges the ends of a range.
                    positive = scale > 0
                    lower, upper = (
                        dr.select(positive, lower, upper),
                        dr.select(positive, upper, lower),
                    )
                sums[4 * k + index] = dr.fma(lower, scale, sums[4 * k + index])
                sums[4 * k + index + 1] = dr.fma(upper, scale, sums[4 * k + index + 1])
            piece_begin, first_at_begin, second_at_begin = piece_end, first_at_end, second_at_end

        # The smallest distance of the path from the middle of the chord.
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
    # The module's docstring has the proof: n u for the sum, and 8 u for a displacement, for which
    # 16 u is taken.
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
    """The six second derivatives xx, xy, xz, yy, yz, zz of a sum of blobs at points p (3, n).

    kernel: the shape of all blobs.
    for_each: a function that loops over the blobs that may be nonzero at p: for_each(add_blob,
        state) calls state = add_blob(record, state) for each of them and returns the last state.
    """

    def add_blob(row: list[Real], state: State) -> State:
        """Return the six sums so far (`state`), with the second derivatives of one more blob added.
        row: the blob's record.

        With v the vector from p to the center in units of the support's radius R, and q = |v|^2,
        the Hessian of A k(q) is (A/R^2) (2 k' I + 4 k'' v v^T).
        """
        # Of a record, entry 6 is one over the radius of the support, and entry 7 the amplitude.
        inverse_radius, amplitude = row[6], row[7]
        offset = _vector_to_center(p, row) * inverse_radius
        q = dr.dot(offset, offset)
        scale = amplitude * inverse_radius * inverse_radius
        # The second result of `profile` is dk/dq.
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
    kernel: BlobKernel, offset: Vec3, inverse_radius: Real, amplitude: Real, state: State
) -> State:
    """Return the sums at a point p, with another blob added.

    kernel: the shape of all blobs.
    state: the sums so far, `_VALUE_STATE_SIZE` numbers: the value; the three components of the
        gradient; the sums of |A dk/dq| and of |A| m, for the error of the value; the sum of the
        blobs' bounds of the gradient, for its error; and the number of blobs near p. Here A is the
        amplitude, k is the kernel, q the squared length of `offset`, and m is the scale of the
        rounding of k (`BlobKernel.profile`). The same numbers are returned, with the blob included.
    offset: the vector from p to the blob's center, in units of the radius of its support.
    inverse_radius: one over that radius.
    amplitude: the factor A of the kernel.
    """
    (
        value,
        gradient_x,
        gradient_y,
        gradient_z,
        slope_sum,
        rounding_sum,
        gradient_size,
        term_count,
    ) = state
    q = dr.dot(offset, offset)
    k, dk, rounding_scale = kernel.profile(q)
    slope = amplitude * dk
    # The gradient of A k(q) is A dk/dq grad q, with grad q = -2 offset / radius.
    gradient_factor = -2 * slope * inverse_radius
    # A little more than the support, so that rounding leaves out no blob.
    is_inside = q < 1.001
    # In the call of `lipschitz_fraction` the line passes through the center, so S^2 is 1.
    abs_amplitude = dr.abs(amplitude)
    return (
        dr.fma(amplitude, k, value),
        dr.fma(gradient_factor, offset.x, gradient_x),
        dr.fma(gradient_factor, offset.y, gradient_y),
        dr.fma(gradient_factor, offset.z, gradient_z),
        slope_sum + dr.abs(slope),
        dr.fma(abs_amplitude, rounding_scale, rounding_sum),
        gradient_size
        + dr.select(
            is_inside, abs_amplitude * inverse_radius * kernel.lipschitz_fraction(1.0, q), 0
        ),
        term_count + dr.select(is_inside, type(q)(1), 0),
    )


def _finished_value(kernel: BlobKernel, backend: Backend, state: State) -> SumValue:
    """The value and gradient of a sum of blobs, with bounds of their rounding errors.

    kernel: the shape of all blobs.
    state: the numbers that `_add_value` returned for the last blob.
    """
    (
        value,
        gradient_x,
        gradient_y,
        gradient_z,
        slope_sum,
        rounding_sum,
        gradient_size,
        term_count,
    ) = state
    roundoff = 0.5 * backend.machine_epsilon
    # The module's docstring has the numbers: 8 u |dk/dq| and (16 + n) u m, each summed.
    error = roundoff * dr.fma(16 + term_count, rounding_sum, 8 * slope_sum)
    gradient_error = roundoff * (32 + term_count) * kernel.steepness.slope * gradient_size
    return SumValue(
        value, backend.Array3f(gradient_x, gradient_y, gradient_z), error, gradient_error
    )


def _vector_to_center(p: Vec3, row: list[Real]) -> Vec3:
    """The vector from p to the center of a blob. row: the blob's record, in which the center is the
    sum of two vectors, entries 0 to 2 and entries 3 to 5."""
    return type(p)(*((row[k] - p[k]) + row[3 + k] for k in range(3)))


def _first_derivative_range(
    chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real
) -> tuple[Real, Real]:
    """The smallest and the largest value of the first derivative of a kernel (the shape of a blob)
    along a line, for positions from a to b on the line. It has a single maximum and a single
    minimum on the line; so if neither lies between a and b, the extreme values are at a and b.

    chord: the extreme values of the derivatives on the line, and their positions.
    at_a, at_b: the first derivative at a and at b.
    """
    has_minimum = (a <= chord.steepest_position) & (b >= chord.steepest_position)
    has_maximum = (a <= -chord.steepest_position) & (b >= -chord.steepest_position)
    lower = dr.select(has_minimum, -chord.steepest, fmin(at_a, at_b))
    return lower, dr.select(has_maximum, chord.steepest, fmax(at_a, at_b))


def _second_derivative_range(
    chord: ChordProfile, a: Real, b: Real, at_a: Real, at_b: Real
) -> tuple[Real, Real]:
    """The smallest and the largest value of the second derivative of a kernel (the shape of a blob)
    along a line, for positions from a to b on the line. On the line it has its minimum at position
    0 and its maximum at two positions, one on each side; elsewhere the extreme values are at a and
    b.

    chord: the extreme values of the derivatives on the line, and their positions.
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
    """The range (lower, upper) of the second derivative of a kernel on a piece of a line, for a
    kernel whose second derivative jumps to 0 at the end of the support. The range includes 0 if the
    piece leaves the support, and is 0 alone if the piece does not meet the support.

    inner_range: the range (lower, upper) on the part of the piece inside the support.
    half_chord_squared: S^2, with S half the length of the line's part inside the support.
    margin: a bound of the rounding of squared positions.
    begin, end: the positions of the ends of the piece, measured from the middle of the line's part
        inside the support.

    Lengths are in units of the support's radius.
    """
    low, high = inner_range
    # The smallest and the largest distance of the piece from the middle of the chord.
    nearest = fmax(fmax(begin, -end), 0)
    meets_support = nearest * nearest < half_chord_squared + margin
    farthest = fmax(dr.abs(begin), dr.abs(end))
    leaves_support: Mask = ~(farthest * farthest <= half_chord_squared - margin)
    low, high = (
        dr.select(leaves_support, fmin(low, 0), low),
        dr.select(leaves_support, fmax(high, 0), high),
    )
    return dr.select(meets_support, low, 0), dr.select(meets_support, high, 0)


def for_each_record(records: RecordTable, *, active: Mask = True, is_sum: bool = False) -> ForEach:
    """Make a function that loops over all records (rows of numbers of blobs) of a table. The
    function for_each(body, state) calls state = body(record, state) for each record and returns the
    last state.

    active: the lanes on which it loops; on all others the state stays as it is.
    is_sum: whether the state is a tuple of sums, which can be differentiated in reverse mode
        (`RecordTable.for_each`).
    """

    def for_each(body: EachBlob, state: State) -> State:
        """Call state = body(record, state) for all records, one after another. Returns the last
        state."""
        return records.for_each(body, state, "blobs", active, is_sum=is_sum)

    return for_each


def for_each_listed(
    records: RecordTable, entries: Any, begin: Any, end: Any, *, is_sum: bool = False
) -> ForEach:
    """Make a function that loops over the records (rows of numbers of blobs) with the indices
    entries[begin:end]. The function for_each(body, state) calls state = body(record, state) for
    each of these records and returns the last state.

    records: the table of the records.
    entries: an array of indices of records.
    begin, end: positions in that array, which may differ from lane to lane.
    is_sum: as of `for_each_record`.
    """
    kind = records.backend.UInt32

    def for_each(body: EachBlob, state: State) -> State:
        """Call state = body(record, state) for the listed records, one after another. Returns the
        last state."""

        def step(i: Any, *state: Any) -> State:
            return i + 1, *body(records.read_record(dr.gather(kind, entries, i)), state)

        def has_more(i: Any, *_: Any) -> Mask:
            return i < end

        return dr.while_loop(
            (kind(begin), *state),
            has_more,
            step,
            label="blobs of a cell",
            max_iterations=-1 if is_sum else None,
        )[1:]

    return for_each


Coordinates: TypeAlias = tuple[Jet, Jet, Jet]
Term: TypeAlias = "Callable[[list[Real]], Jet]"


def sum_jets(term: Term, like: Jet, zero: Real, for_each: ForEach) -> Jet:
    """The sum of the jets of all blobs. A jet is a set of intervals that contain the values and the
    derivatives of a function. The state of the loop over the blobs is the ends of all intervals of
    the sum.

    term: a function that returns the jet of a blob from its record (row of numbers).
    like: any jet with as many derivatives as those that are summed, and of the same piece of a
        path.
    zero: the number 0 on each lane.
    for_each: a function that loops over the records: for_each(add_term, state) calls state =
        add_term(record, state) for each of them and returns the last state.
    """

    def add_term(row: list[Real], state: State) -> State:
        """Return the ends of the intervals of the sum, with the jet of one more blob added. row:
        the blob's record. state: the ends so far."""
        total = jet_from_bounds(like, iter(state)) + term(row)
        return tuple(jet_bounds(total, zero))

    start = tuple(jet_bounds(like.constant(0.0), zero))
    return jet_from_bounds(like, iter(for_each(add_term, start)))


def blob_term(kernel: BlobKernel, coordinates: Coordinates) -> Term:
    """Make a function that returns the jet of a blob from its record (row of numbers). A jet is a
    set of intervals that contain the values and the derivatives of a function.

    kernel: the shape of the blob.
    coordinates: the jets of x, y and z at which the blob is evaluated.
    """
    function = kernel.function()

    def term(row: list[Real]) -> Jet:
        """The jet of a blob: amplitude times k(q), with q the squared distance from the center in
        units of the support's radius. row: the blob's record."""
        # Of a record, entry 6 is one over the radius of the support, and entry 7 the amplitude.
        inverse_radius, amplitude = row[6], row[7]
        x, y, z = (
            ((axis - row[k]) - row[3 + k]) * inverse_radius for k, axis in enumerate(coordinates)
        )
        return (x**2 + y**2 + z**2).apply(function) * amplitude

    return term


def jet_bounds(jet: Jet, zero: Real) -> Iterator[Any]:
    """Yield the ends of all intervals of a jet, one after another, as numbers of the backend. The
    order is: lower and upper end of the value, of each first derivative, and of each second
    derivative. If the jet has a jet at the start of its piece, the ends of that one follow in the
    same order.

    zero: the number 0 on each lane. It is added to each end, so that Python numbers become Dr.Jit
        numbers.
    """
    for interval in (jet.value, *jet.first_derivatives, *jet.second_derivatives):
        yield zero + interval.lower
        yield zero + interval.upper
    if jet.jet_at_start is not None:
        yield from jet_bounds(jet.jet_at_start, zero)


def jet_from_bounds(like: Jet, ends: Iterator[Any]) -> Jet:
    """The jet whose intervals have the next numbers of `ends` as their ends, in the order in which
    `jet_bounds` yields them.

    like: any jet with as many derivatives and of the same piece of a path.
    """
    value = Interval(next(ends), next(ends))
    first = tuple(Interval(next(ends), next(ends)) for _ in like.first_derivatives)
    second = tuple(Interval(next(ends), next(ends)) for _ in like.second_derivatives)
    start = None if like.jet_at_start is None else jet_from_bounds(like.jet_at_start, ends)
    return Jet(value, first, second, start, like.piece_length)


def backend_number(*jets: Jet) -> Any:
    """Any Dr.Jit number among the ends of the intervals of jets. It tells the backend and the
    number of lanes.

    Raises:
        TypeError: all ends are Python numbers.
    """
    for jet in jets:
        for interval in (jet.value, *jet.first_derivatives):
            for bound in (interval.lower, interval.upper):
                if dr.is_array_v(cast("Any", type(bound))):
                    return bound
    raise TypeError("a sum needs a point of the backend: the coordinates are constants")
