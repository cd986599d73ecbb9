"""The operations of tapes. A tape is a formula that is stored as a list of instructions; each
instruction is an operation, such as a product, with operands (results of earlier instructions) and
constants. An `Operation` says how it is computed with numbers of any arithmetic, what ranges its
results have on boxes, and on which boxes its result is always that of one of its operands, so that
the others need not be computed.

Ranges are computed in double precision with NumPy, an entry for each box: pairs (lower, upper) of
arrays. A bound that is not known is infinite.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from harnack.arithmetic import (
    Jet,
    atan2,
    blend_intersection,
    blend_union,
    cone_distance,
    maximum,
    minimum,
    norm,
    orthogonal_intersection,
    segment_distance,
)
from harnack.arithmetic.distance_jets import jet_of_point_distance
from harnack.arithmetic.functions import ElementaryFunction, reciprocal
from harnack.backend import FloatArray, IntArray

__all__ = [
    "COORDINATE_COUNT",
    "Operation",
    "blend_operation",
    "chain_operation",
    "function_operation",
    "norm_operation",
    "operation_named",
]

Range: TypeAlias = "tuple[FloatArray, FloatArray]"
# Takes the ranges of the operands and the columns of constants.
RangeFunction: TypeAlias = "Callable[[Sequence[Range], Sequence[FloatArray]], Range]"
# Takes the same and limits of the result, and returns for each box the index of the operand by
# which the result may be replaced there; -1 if none is known.
ChoiceFunction: TypeAlias = "Callable[[Sequence[Range], Sequence[FloatArray], Range], IntArray]"
# Takes the constants and the limits of the result, and returns the limits of the operands.
LimitFunction: TypeAlias = "Callable[[Sequence[FloatArray], Range], Range]"
# Takes the constants, and returns the lower and the upper corners of boxes, as columns.
Corners: TypeAlias = "tuple[list[FloatArray], list[FloatArray]]"
BoxFunction: TypeAlias = "Callable[[Sequence[FloatArray]], Corners]"

# The first instructions of every tape are the coordinates x, y and z.
COORDINATE_COUNT = 3
# Ends of ranges are moved outwards by this many units in the last place: NumPy's elementary
# functions are wrong by at most four.
_UNITS = 16.0
_TINY = float(np.finfo(np.float64).tiny)
_LARGEST = float(np.finfo(np.float64).max)
_HUGE_ANGLE = 1e6


@dataclass(frozen=True, eq=False)
class Operation:
    """An operation of tapes.

    Limits of a number, a pair (floor, cap), say which of its values matter on a box: one that is
    above the cap may be replaced by any other number above the cap, and one below the floor by any
    other number below the floor, without a change of the whole formula.

    name: what identifies it; it contains literal numbers that kernels depend on, such as exponents.
    operand_count, constant_count: the numbers of operands and of constants, at most 3 and 16.
    apply: computes the result from the operands, numbers of one arithmetic, and the constants,
        which are numbers of that arithmetic too.
    ranges: computes the range of the result from those of the operands, without rounding outwards.
    choice: tells on which boxes the result may be replaced by one of the operands; None if on no
        box.
    limits: computes limits of the operands from those of the result; None if none are known.
    is_of_point: whether the operands are always the coordinates x, y and z themselves.
    is_member: whether it is an operation of a chain (`chain_operation`).
    box: of a function of the point, from its constants (c arrays), the lower and the upper corners
        (3 arrays each) of boxes: the function is at least the distance from the box outside of it;
        None if no box is known.
    least: what no result is below, however it is rounded, so that a root of it is known.
    """

    name: str
    operand_count: int
    constant_count: int
    apply: Callable[[Sequence[Any], Sequence[Any]], Any]
    ranges: RangeFunction
    choice: ChoiceFunction | None = None
    limits: LimitFunction | None = None
    is_of_point: bool = False
    is_member: bool = False
    box: BoxFunction | None = None
    least: float = -math.inf

    def rounded_ranges(self, operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        """The range of the result on each box, rounded outwards. An end that is NaN becomes
        infinite; a lower end that overflowed becomes the largest number, since an upper one does
        not stay infinite in what is computed of it, as in log(exp(x))."""
        slack = _UNITS * float(np.finfo(np.float64).eps)
        with np.errstate(all="ignore"):
            low, high = self.ranges(operands, constants)
            below, above = (np.abs(end) * slack for end in (low, high))
            # In place: memory is what this takes its time for.
            below += _TINY
            above += _TINY
            np.subtract(low, below, out=below)
            above += high
        # (fmax and fmin take the number in place of NaN.)
        np.fmax(below, self.least, out=below)
        np.fmin(above, np.inf, out=above)
        return np.minimum(below, _LARGEST, out=below), np.maximum(above, -_LARGEST, out=above)


# Ranges.


def _sum_of(terms: Sequence[Range]) -> Range:
    """The range of the sum of two numbers in these ranges. Its rounding is a fraction of the
    result, and is added for all operations."""
    (low_a, high_a), (low_b, high_b) = terms
    return low_a + low_b, high_a + high_b


def _sum_of_products(terms: Sequence[Range]) -> Range:
    """The range of the sum of two to four rounded numbers in these ranges. The rounding may exceed
    any fraction of the total, so that each end is widened by the size of what it is the sum of.
    (The other end may be infinite.)"""
    lows, highs = ([term[k] for term in terms] for k in (0, 1))
    slack = 4 * float(np.finfo(np.float64).eps)
    low, high = (functools.reduce(np.add, ends) for ends in (lows, highs))
    sizes = [functools.reduce(np.add, [np.abs(end) for end in ends]) for ends in (lows, highs)]
    return low - slack * sizes[0], high + slack * sizes[1]


def _scaled(a: Range, factor: FloatArray) -> Range:
    """The range of a number in the range a times a factor. 0 times infinity counts as 0."""
    low, high = (np.where(factor == 0.0, 0.0, end * factor) for end in a)
    return np.minimum(low, high), np.maximum(low, high)


def _product(a: Range, b: Range) -> Range:
    products = [u * v for u in a for v in b]
    return functools.reduce(np.minimum, products), functools.reduce(np.maximum, products)


def _monotone(function: Callable[..., Any]) -> RangeFunction:
    """The ranges of a function of several numbers that grows with each of them."""

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        low, high = ([entry[k] for entry in operands] for k in (0, 1))
        return function(*low, *constants), function(*high, *constants)

    return ranges


def _magnitudes(a: Range) -> Range:
    """The range of |u| for u in the range a."""
    low, high = a
    return np.maximum(np.maximum(low, -high), 0.0), np.maximum(np.abs(low), np.abs(high))


def _norm_ranges(p: float) -> RangeFunction:
    """The ranges of the p-norm of numbers."""

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        del constants
        sizes = [_magnitudes(entry) for entry in operands]
        low, high = (_norm_on_numpy([size[k] for size in sizes], p) for k in (0, 1))
        return low, high

    return ranges


def _norm_on_numpy(sizes: Sequence[FloatArray], p: float) -> FloatArray:
    """The p-norm of numbers >= 0. Where squares overflow, they are divided by the largest."""
    if p != 2.0:
        return norm(*sizes, p=p)
    length = _root_of_squares(sizes)
    if np.isfinite(length).all():
        return length
    largest = functools.reduce(np.maximum, sizes)
    scaled = largest * _root_of_squares([size / largest for size in sizes])
    return np.where(np.isinf(length), np.where(np.isinf(largest), largest, scaled), length)


def _root_of_squares(sizes: Sequence[FloatArray]) -> FloatArray:
    squares = sizes[0] * sizes[0]
    for size in sizes[1:]:
        squares += size * size
    return np.sqrt(squares)


def _affine_ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
    *factors, shift = constants
    terms = [_scaled(a, factor) for a, factor in zip(operands, factors, strict=True)]
    return _sum_of_products([*terms, (shift, shift)])


def _power_ranges(n: float) -> RangeFunction:
    """The ranges of x^n."""

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        del constants
        low, high = operands[0]
        if float(n).is_integer():
            k = int(abs(n))
            if k % 2 == 0:
                low, high = _magnitudes((low, high))
            low, high = low**k, high**k
            return (low, high) if n >= 0 else _reciprocal_range((low, high))
        is_known = low >= 0.0 if n > 0 else low > 0.0
        low, high = np.sort([np.power(low, n), np.power(high, n)], axis=0)
        return np.where(is_known, low, -np.inf), np.where(is_known, high, np.inf)

    return ranges


def _reciprocal_range(a: Range) -> Range:
    low, high = a
    is_known = (low > 0.0) | (high < 0.0)
    return np.where(is_known, 1.0 / high, -np.inf), np.where(is_known, 1.0 / low, np.inf)


def _sine_ranges(phase: float) -> RangeFunction:
    """The ranges of sin(x + phase), where the phase is a multiple of pi/2 (0.0 for the sine, pi/2
    for the cosine)."""

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        del constants
        low, high = operands[0]
        first, last = np.sin(low + phase), np.sin(high + phase)
        slack = 4 * float(np.finfo(np.float64).eps) * (np.maximum(abs(low), abs(high)) + 2.0)

        def passes(at: float) -> Any:
            """Whether the interval may contain at + 2 pi k - phase for an integer k."""
            turn = 2 * math.pi
            start, end = (low - slack + phase - at) / turn, (high + slack + phase - at) / turn
            return np.floor(end + 1e-12) >= np.ceil(start - 1e-12)

        is_unknown = ~(np.maximum(abs(low), abs(high)) < _HUGE_ANGLE)
        bottom = np.where(passes(-0.5 * math.pi) | is_unknown, -1.0, np.minimum(first, last))
        top = np.where(passes(0.5 * math.pi) | is_unknown, 1.0, np.maximum(first, last))
        return np.maximum(bottom - slack, -1.0), np.minimum(top + slack, 1.0)

    return ranges


def _function_ranges(function: ElementaryFunction) -> RangeFunction:
    """The ranges of an elementary function: those of a monotone one, or nothing is known."""
    name, _, exponent = function.name.partition(" ")
    if name == "power":
        return _power_ranges(float(exponent))
    if name in ("sin", "cos"):
        return _sine_ranges(0.0 if name == "sin" else 0.5 * math.pi)
    if name == "abs":
        return lambda operands, constants: _magnitudes(operands[0])
    if name == "reciprocal":
        return lambda operands, constants: _reciprocal_range(operands[0])
    falls = name == "acos"
    grows = name in ("sqrt", "exp", "log", "tanh", "atan", "asin", "sinh")
    domain_low, domain_high = function.domain

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        del constants
        low, high = operands[0]
        if not (falls or grows):
            return np.full_like(low, -np.inf), np.full_like(low, np.inf)
        is_known = (low >= domain_low) & (high <= domain_high)
        first, last = function.on_numpy(low), function.on_numpy(high)
        # The rounding of results near 0, such as that of a logarithm near 1.
        low, high = (last, first) if falls else (first, last)
        low, high = low - 1e-14 * (1.0 + abs(low)), high + 1e-14 * (1.0 + abs(high))
        return np.where(is_known, low, -np.inf), np.where(is_known, high, np.inf)

    return ranges


# Choices and limits.


def _chosen(conditions: Sequence[Any]) -> IntArray:
    """The index of the first condition that holds on each box; -1 where none holds."""
    result = np.full(len(conditions[0]), -1, np.int64)
    for k in reversed(range(len(conditions))):
        result[conditions[k]] = k
    return result


def _choice_of_maximum(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    """Where max(a, b) may be replaced by one of its operands: by b where a is below the floor. If b
    is less than a, both are below it. (The limits are within the range of the maximum. So a is
    also below the floor if it is below all of b.)"""
    del constants
    (_, high_a), (_, high_b) = operands
    floor, _ = limits
    return _chosen([high_b < floor, high_a < floor])


def _choice_of_minimum(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    """Where min(a, b) may be replaced by one of its operands: by b where a is above the cap."""
    del constants
    (low_a, _), (low_b, _) = operands
    _, cap = limits
    return _chosen([low_b > cap, low_a > cap])


def _choice_of_blend(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    """Where a blended union (`blend_union`) may be replaced by one of its operands.

    Proof. If a >= r, then g_a = 0 and the first term is r (1 - g_b), which is b for b < r and else
    r. If also a >= b, the second term is max(b - r, 0), and their sum is b. If a < b, both are at
    least r, and the blend is a. So if a is at least r and above the cap, the blend is b, or the
    blend and b are both above the cap.
    """
    (low_a, _), (low_b, _) = operands
    (radius,), (_, cap) = constants, limits
    return _chosen([(low_b >= radius) & (low_b > cap), (low_a >= radius) & (low_a > cap)])


def _limits_of_blend(constants: Sequence[FloatArray], limits: Range) -> Range:
    """Limits of the operands of a blended union.

    Proof. Let b be above r and above the cap. If a < r, the blend is a, whatever b is. Otherwise it
    is min(a, b): a if that is at most the cap, else a number above the cap. So b may be replaced by
    any other number above both.
    """
    (radius,), (_, cap) = constants, limits
    return np.full_like(cap, -np.inf), np.maximum(cap, radius)


def _choice_of_blended_intersection(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    """Where a blended intersection, minus the blended union of -a and -b, may be an operand."""
    return _choice_of_blend([_negated(a) for a in operands], constants, _negated(limits))


def _limits_of_blended_intersection(constants: Sequence[FloatArray], limits: Range) -> Range:
    return _negated(_limits_of_blend(constants, _negated(limits)))


def _choice_of_sides(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    """Where `orthogonal_intersection` is one of its operands.

    Proof. If all others are at most 0 and at most a, the norm of the positive ones is max(a, 0),
    and the smaller of the largest and 0 is min(a, 0). Their sum is a.
    """
    del constants, limits
    conditions: list[Any] = []
    for k, (low, _) in enumerate(operands):
        others = functools.reduce(
            np.maximum, [high for j, (_, high) in enumerate(operands) if j != k]
        )
        conditions.append((others <= 0.0) & (low >= others))
    return _chosen(conditions)


def _choice_of_absolute(
    operands: Sequence[Range], constants: Sequence[FloatArray], limits: Range
) -> IntArray:
    del constants, limits
    return _chosen([operands[0][0] >= 0.0])


def _negated(a: Range) -> Range:
    """The range, or the limits, of the number -a."""
    low, high = a
    return -high, -low


def _limits_of_shift(constants: Sequence[FloatArray], limits: Range) -> Range:
    """Limits of a number a from those of a + c. They are moved outwards by the rounding."""
    (shift,) = constants
    low, high = _sum_of([limits, (-shift, -shift)])
    slack = _UNITS * float(np.finfo(np.float64).eps)
    return low - slack * np.abs(low), high + slack * np.abs(high)


def _limits_of_scale(constants: Sequence[FloatArray], limits: Range) -> Range:
    """Limits of a number a from those of a k, which are moved outwards by the rounding; none if k
    is 0."""
    (factor,) = constants
    slack = _UNITS * float(np.finfo(np.float64).eps)
    low, high = (end / factor for end in limits)
    low, high = np.where(factor > 0.0, (low, high), (high, low))
    low, high = low - slack * np.abs(low) - _TINY, high + slack * np.abs(high) + _TINY
    is_known = np.abs(factor) > _TINY
    return np.where(is_known, low, -np.inf), np.where(is_known, high, np.inf)


# The operations.


def _affine(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
    """a k1 + b k2 + c k3 + k0, of one to three operands."""
    *factors, shift = constants
    terms = [a * factor for a, factor in zip(operands, factors, strict=True)]
    return functools.reduce(lambda a, b: a + b, terms) + shift


def _distance(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
    """The distance of the point (a, b, c) from a center, and minus a radius, if there is one."""
    distance: Any = jet_of_point_distance(operands, constants[:3])
    if distance is None:
        distance = norm(*(a - c for a, c in zip(operands, constants, strict=False)))
    return _minus(distance, constants[3:])


def _minus(distance: Any, radius: Sequence[Any]) -> Any:
    """The distance minus a radius, if there is one. Only the value of a jet changes."""
    if not radius:
        return distance
    return distance.moved(-radius[0].value) if isinstance(distance, Jet) else distance - radius[0]


def _distance_ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
    moved = [_sum_of([a, (-c, -c)]) for a, c in zip(operands, constants, strict=False)]
    low, high = _norm_ranges(2.0)(moved, ())
    return _minus_radius((low, high), constants[3:])


def _segment_distance(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
    """`segment_distance`, and minus a radius, if there is one."""
    return _minus(segment_distance(operands, constants[:12], constants[12]), constants[13:])


def _cone_distance(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
    """`cone_distance`, and minus a radius, if there is one."""
    return _minus(cone_distance(operands, constants[:12], *constants[12:15]), constants[15:])


def _segment_ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
    """The ranges of `segment_distance` on boxes, with or without a radius.

    Proof. Let c be the center of a box, and e = (+-e_x, +-e_y, e_z) its half diagonals. Along the
    axis a the box reaches from its center as far as the largest |a . e|. Across it, it reaches as
    far as the largest sqrt(|e|^2 - (a . e)^2): the distance across is convex, and so largest at a
    corner. And the distance of box and segment is at least the gap between their projections to any
    line. Lines along the coordinates, and at right angles to the axis and to a coordinate, are
    taken, as in separating two boxes (Gottschalk et al. 1996).
    """
    half_length, radius = constants[12], constants[13:]
    center, half, slack = _boxes(operands, constants)
    axis = constants[:3]
    diagonals = [
        half[0] * axis[0] * s + half[1] * axis[1] * t + half[2] * axis[2]
        for s, t in itertools.product((1.0, -1.0), repeat=2)
    ]
    along, *across = (
        center[0] * constants[k] + center[1] * constants[k + 1] + center[2] * constants[k + 2]
        - constants[k + 3]
        for k in (0, 4, 8)
    )  # fmt: skip
    from_axis = _norm_on_numpy(across, 2.0)
    sizes = [np.abs(entry) for entry in diagonals]
    reach_along = functools.reduce(np.maximum, sizes) + slack
    least = functools.reduce(np.minimum, sizes)
    squares = half[0] * half[0] + half[1] * half[1] + half[2] * half[2]
    reach_across = np.sqrt(np.maximum(squares - least * least, 0.0)) + slack
    nearest, farthest = np.abs(along) - reach_along, np.abs(along) + reach_along
    low, high = (
        _norm_on_numpy([np.maximum(q, 0.0), np.maximum(h - half_length, 0.0)], 2.0)
        for q, h in ((from_axis - reach_across, nearest), (from_axis + reach_across, farthest))
    )
    gap = _gap_of_projections(center, half, constants)
    return _minus_radius((np.maximum(low, gap) - slack, high + slack), radius)


def _gap_of_projections(
    center: Sequence[FloatArray], half: Sequence[FloatArray], constants: Sequence[FloatArray]
) -> FloatArray:
    """The largest gap between the projections of boxes and of segments to some lines
    (`_segment_ranges`); at most 0 if there is none. center, half: of the boxes."""
    axis, half_length = constants[:3], constants[12]
    # From the middle of the segment to the center of the box.
    away = [c - m for c, m in zip(center, _origin(constants), strict=True)]
    gap: Any = -np.inf
    for k, other, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        gap = np.maximum(gap, np.abs(away[k]) - half[k] - np.abs(axis[k]) * half_length)
        u, v = axis[last], axis[other]
        across = np.abs(u * away[other] - v * away[last])
        across -= np.abs(u) * half[other] + np.abs(v) * half[last]
        gap = np.maximum(gap, across / np.maximum(np.hypot(u, v), _SHORT))
    return gap


# Shorter vectors at right angles to a unit vector are too short to be divided by their length.
_SHORT = 0.25


def _cone_ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
    """The ranges of `cone_distance` on boxes, with or without a radius: its Lipschitz constant is
    1, and half of the diagonal is the largest distance from the center."""
    center, half, slack = _boxes(operands, constants)
    value = cone_distance(center, constants[:12], *constants[12:15])
    reach = _norm_on_numpy(half, 2.0) + slack + np.abs(constants[12]) * _ROUNDING_OF_POINTS
    return _minus_radius((value - reach, value + reach), constants[15:])


def _box_of_ball(constants: Sequence[FloatArray]) -> Corners:
    """The boxes of balls; of points, if there is no radius."""
    radius = constants[3] if len(constants) > 3 else 0.0 * constants[0]
    return _padded([c - radius for c in constants[:3]], [c + radius for c in constants[:3]])


def _box_of_segment(constants: Sequence[FloatArray]) -> Corners:
    """The boxes of capsules; of segments, if there is no radius."""
    middle, half_length = _origin(constants), constants[12]
    radius = constants[13] if len(constants) > 13 else 0.0 * half_length
    reach = [np.abs(constants[k]) * half_length + radius for k in range(3)]
    return _padded(
        [c - r for c, r in zip(middle, reach, strict=True)],
        [c + r for c, r in zip(middle, reach, strict=True)],
    )


def _origin(constants: Sequence[FloatArray]) -> list[FloatArray]:
    """The point (3,) whose local coordinates in a frame are 0."""
    return [
        constants[k] * constants[3]
        + constants[4 + k] * constants[7]
        + constants[8 + k] * constants[11]
        for k in range(3)
    ]


def _padded(lower: list[FloatArray], upper: list[FloatArray]) -> Corners:
    """Boxes that are larger by the rounding of their corners."""
    size = functools.reduce(np.maximum, [np.abs(entry) for entry in (*lower, *upper)])
    slack = _ROUNDING_OF_POINTS * size
    return [entry - slack for entry in lower], [entry + slack for entry in upper]


# The rounding of distances from segments, relative to the size of coordinates.
_ROUNDING_OF_POINTS = 64 * float(np.finfo(np.float64).eps)


def _boxes(
    operands: Sequence[Range], constants: Sequence[FloatArray]
) -> tuple[list[FloatArray], list[FloatArray], FloatArray]:
    """The centers of boxes, half of their sides, and a bound of the rounding of lengths in the
    frame that the constants begin with: of its unit vectors, and of sums of products."""
    center = [0.5 * low + 0.5 * high for low, high in operands]
    half = [0.5 * high - 0.5 * low for low, high in operands]
    lengths = [*center, *half, *(constants[k] for k in (3, 7, 11))]
    size: Any = sum(np.abs(entry) for entry in lengths)
    # A difference of squares of half sides is rounded by a fraction of them, and its root by more.
    return center, half, _ROUNDING_OF_POINTS * size + 1e-7 * sum(half)


def _minus_radius(distance: Range, radius: Sequence[FloatArray]) -> Range:
    """The range minus a radius, if there is one. The distance is rounded, too."""
    low, high = distance
    if not len(radius):
        return low, high
    slack = _UNITS * float(np.finfo(np.float64).eps)
    return low - slack * np.abs(low) - radius[0], high + slack * np.abs(high) - radius[0]


_OPERATIONS = (
    Operation("constant", 0, 1, lambda a, k: k[0], lambda a, k: (k[0], k[0])),
    Operation("sum", 2, 0, lambda a, k: a[0] + a[1], lambda a, k: _sum_of(a)),
    Operation(
        "difference", 2, 0, lambda a, k: a[0] - a[1],
        lambda a, k: _sum_of([a[0], (-a[1][1], -a[1][0])]),
    ),
    Operation(
        "negative", 1, 0, lambda a, k: -a[0], lambda a, k: _negated(a[0]),
        limits=lambda k, limits: _negated(limits),
    ),
    Operation(
        "shift", 1, 1, lambda a, k: a[0] + k[0], lambda a, k: _sum_of([a[0], (k[0], k[0])]),
        limits=_limits_of_shift,
    ),
    Operation(
        "scale", 1, 1, lambda a, k: a[0] * k[0], lambda a, k: _scaled(a[0], k[0]),
        limits=_limits_of_scale,
    ),
    Operation(
        "divide", 1, 1, lambda a, k: a[0] * reciprocal(k[0]),
        lambda a, k: _product(a[0], (1.0 / k[0], 1.0 / k[0])),
    ),
    Operation("affine 1", 1, 2, _affine, _affine_ranges),
    Operation("affine 2", 2, 3, _affine, _affine_ranges),
    Operation("affine 3", 3, 4, _affine, _affine_ranges),
    Operation("product", 2, 0, lambda a, k: a[0] * a[1], lambda a, k: _product(a[0], a[1])),
    Operation(
        "maximum", 2, 0, lambda a, k: maximum(a[0], a[1]), _monotone(np.maximum),
        _choice_of_maximum,
        lambda k, limits: limits,
    ),
    Operation(
        "minimum", 2, 0, lambda a, k: minimum(a[0], a[1]), _monotone(np.minimum),
        _choice_of_minimum,
        lambda k, limits: limits,
    ),
    Operation(
        "polar angle", 2, 0, lambda a, k: atan2(a[0], a[1]),
        lambda a, k: (np.full_like(a[0][0], -np.pi), np.full_like(a[0][0], np.pi)),
    ),
    Operation("distance", 3, 3, _distance, _distance_ranges),
    Operation("distance of point", 3, 3, _distance, _distance_ranges, is_of_point=True,
              box=_box_of_ball),
    Operation("ball", 3, 4, _distance, _distance_ranges, is_of_point=True, box=_box_of_ball),
    Operation("segment distance", 3, 13, _segment_distance, _segment_ranges),
    Operation("segment distance of point", 3, 13, _segment_distance, _segment_ranges,
              is_of_point=True, box=_box_of_segment),
    Operation("capsule", 3, 14, _segment_distance, _segment_ranges, is_of_point=True,
              box=_box_of_segment),
    Operation("cone distance", 3, 15, _cone_distance, _cone_ranges),
    Operation("cone distance of point", 3, 15, _cone_distance, _cone_ranges, is_of_point=True),
    Operation("round cone", 3, 16, _cone_distance, _cone_ranges, is_of_point=True),
    *(
        Operation(
            f"orthogonal {n}", n, 0, lambda a, k: orthogonal_intersection(*a),
            _monotone(lambda *a: _orthogonal_on_numpy(a)), _choice_of_sides,
        )
        for n in (2, 3)
    ),
)  # fmt: skip
_BY_NAME = {operation.name: operation for operation in _OPERATIONS}


def _orthogonal_on_numpy(sides: Sequence[FloatArray]) -> FloatArray:
    """`orthogonal_intersection` of NumPy arrays."""
    outside = norm(*(np.maximum(side, 0.0) for side in sides))
    return outside + np.minimum(functools.reduce(np.maximum, sides), 0.0)


def operation_named(name: str) -> Operation:
    """The operation of this name, which has no literals."""
    return _BY_NAME[name]


@functools.cache
def chain_operation(name: str) -> Operation:
    """The operation of members of a chain: the smaller of the value of the member before and of a
    function of the point, the operation with this name. So a minimum of many functions is one
    instruction for each, without results that are kept. Its operands are the member before, which
    the first one may lack, and then x, y and z; its ranges are those of the function alone."""
    function = operation_named(name)

    def apply(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
        return minimum(operands[0], function.apply(operands[1:], constants))

    return Operation(
        f"minimum with {name}", 1, function.constant_count, apply, function.ranges, is_member=True,
        box=function.box,
    )  # fmt: skip


@functools.cache
def norm_operation(count: int, p: float) -> Operation:
    """The p-norm of two or three numbers."""
    return Operation(
        f"norm {count} {p}", count, 0, lambda a, k: norm(*a, p=p), _norm_ranges(p), least=0.0
    )


@functools.cache
def blend_operation(exponent: float, *, is_union: bool) -> Operation:
    """The blended union or intersection of two numbers. Its constant is the radius.

    exponent: the power of the superellipse.
    """
    blend = blend_union if is_union else blend_intersection

    def apply(operands: Sequence[Any], constants: Sequence[Any]) -> Any:
        a, b = operands
        return blend(a, b, constants[0], exponent)

    def ranges(operands: Sequence[Range], constants: Sequence[FloatArray]) -> Range:
        low, high = _monotone(functools.partial(blend, power=exponent))(operands, constants)
        # The terms may be as large as the radius.
        slack = 1e-14 * np.abs(constants[0])
        return low - slack, high + slack

    choice = _choice_of_blend if is_union else _choice_of_blended_intersection
    limits = _limits_of_blend if is_union else _limits_of_blended_intersection
    kind = "union" if is_union else "intersection"
    return Operation(f"blended {kind} {exponent}", 2, 1, apply, ranges, choice, limits)


# Functions are few; a power has its exponent in its name.
_FUNCTIONS: dict[str, Operation] = {}


def function_operation(function: ElementaryFunction) -> Operation:
    """The operation that applies an elementary function to one number."""
    if function.name not in _FUNCTIONS:
        choice = _choice_of_absolute if function.name == "abs" else None
        _FUNCTIONS[function.name] = Operation(
            function.name, 1, 0, lambda a, k: function(a[0]), _function_ranges(function),
            choice, least=_least_value(function),
        )  # fmt: skip
    return _FUNCTIONS[function.name]


def _least_value(function: ElementaryFunction) -> float:
    """What no value of a function is below."""
    name, _, exponent = function.name.partition(" ")
    is_positive = name in ("abs", "exp", "sqrt") or (name == "power" and float(exponent) % 2 == 0)
    return 0.0 if is_positive else -math.inf
