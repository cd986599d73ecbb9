"""Ranges of a ReLU network in many boxes at once, by products of large matrices in NumPy: of its
output, so that boxes are proved to contain no level, and of its neurons, so that in each box many
neurons are proved to be *active* (z >= 0, where a(z) = z) or *dead* (z <= 0, where a(z) = 0).

In a box each value of a layer is enclosed by an affine form, as in affine arithmetic (Comba and
Stolfi 1993; for networks Singh et al. 2018): c + sum of q_k e_k, up to an error of at most r,
where each e_k is an unknown number between -1 and 1. The first three e are the coordinates of the
box. A matrix maps c and q; its absolute values map r. So z lies within c -+ (sum |q_k| + r).

A neuron whose z lies in [l, u] with l < 0 < u has l m <= 0 and, for every m between 0 and 1,

    m z <= max(z, 0) <= m z + t,   t = max(-l m, (1 - m) u),

as max(z, 0) - m z is convex in z, thus largest at an end of [l, u], and is not negative. m =
u/(u - l) makes both ends equal. So a = m z + t/2 + (t/2) e with a new number e.

Numbers are of single precision, twice as fast as double ones. What rounding adds is a part of r:
with the unit roundoff u, a sum of n products is off by at most about n u times the sum of their
absolute values, in any order, and the sum over all forms of |w| |q| is at most |w| times the norm
of the vector of all sums |c| + sum |q_k| + r.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import BoolArray, FloatArray, IntArray
    from harnack.tree.empty_space import BoxCells

__all__ = ["BoxRanges", "ranges_in_boxes"]

Layer: TypeAlias = "tuple[FloatArray, FloatArray]"
_Single: TypeAlias = "Any"

_UNIT = 2.0**-24
# Covers numbers that are too small for single precision, in sums of millions of products.
_UNDERFLOW = np.float32(1e-30)
# So many numbers may be in a matrix at once. With more unknown numbers than fit, the remainders of
# a layer's neurons become a part of r.
_MAX_NUMBERS = 1 << 24
# So many numbers are in a matrix mostly, and so many rows has a box.
_TYPICAL_NUMBERS, _TYPICAL_ROWS = 1 << 22, 64


@dataclass(frozen=True)
class BoxRanges:
    """Ranges in n boxes.

    lower, upper: (n,) bounds of the network's output; NaN if it may overflow.
    is_active, is_dead: for each layer but the last, masks (n, m) of neurons.
    """

    lower: FloatArray
    upper: FloatArray
    is_active: tuple[BoolArray, ...]
    is_dead: tuple[BoolArray, ...]


def ranges_in_boxes(layers: Sequence[Layer], boxes: BoxCells, margin: float = 0.0) -> BoxRanges:
    """The ranges of a ReLU network.

    layers: pairs of weights and biases. The last layer has one row and no activation.
    boxes: the boxes, each of which is enlarged on all sides by `margin` times its size.
    """
    width = max(len(weights) for weights, _ in layers)
    at_once = max(4, _TYPICAL_NUMBERS // (width * _TYPICAL_ROWS))
    half = boxes.size * (0.5 + margin)
    single = [(weights.astype(np.float32), bias.astype(np.float32)) for weights, bias in layers]
    with np.errstate(all="ignore"):
        parts = [
            _ranges(single, boxes.centers[k : k + at_once], half)
            for k in range(0, len(boxes.corners), at_once)
        ]
    if not parts:
        none = [np.zeros((0, len(weights)), np.bool_) for weights, _ in layers[:-1]]
        return BoxRanges(np.zeros(0), np.zeros(0), tuple(none), tuple(none))
    count = len(layers) - 1
    return BoxRanges(
        np.concatenate([part.lower for part in parts]),
        np.concatenate([part.upper for part in parts]),
        tuple(np.concatenate([p.is_active[i] for p in parts]) for i in range(count)),
        tuple(np.concatenate([p.is_dead[i] for p in parts]) for i in range(count)),
    )


@dataclass(frozen=True)
class _Forms:
    """Affine forms of k values in n boxes.

    numbers: (rows, k) for each box a run of rows: c, then all q.
    starts: (n,) the first row of each box.
    rest: (n, k) r.
    size: (n, k) bounds of |c| + sum of |q| + r.
    """

    numbers: _Single
    starts: IntArray
    rest: _Single
    size: _Single

    @classmethod
    def of_boxes(cls, centers: FloatArray, half: FloatArray) -> _Forms:
        """The coordinates in boxes."""
        count = len(centers)
        numbers = np.zeros((4 * count, 3), np.float32)
        numbers[::4] = centers
        for k in range(3):
            numbers[k + 1 :: 4, k] = half[k]
        size = (np.abs(centers) + half) * (1 + 16 * _UNIT)
        rest = (8 * _UNIT * size).astype(np.float32)
        return cls(numbers, 4 * np.arange(count), rest, size.astype(np.float32) + rest)

    @property
    def counts(self) -> IntArray:
        """The numbers (n,) of rows of boxes."""
        return np.diff(self.starts, append=len(self.numbers))

    def after(self, layer: tuple[_Single, _Single]) -> tuple[_Forms, _Single, _Single]:
        """The forms of W x + b, and bounds (n, k) of the values."""
        weights, bias = layer
        numbers = self.numbers @ weights.T
        numbers[self.starts] += bias
        # A factor for the roundings of weights, sums and norms.
        most = int(self.counts.max())
        unit = np.float32(1.01 * _UNIT * (weights.shape[1] + most + 32))
        size = np.linalg.norm(self.size, axis=1)[:, None]
        rounding = np.linalg.norm(weights, axis=1) * size + np.abs(bias)
        rest = (self.rest @ np.abs(weights.T)) * (1 + unit) + unit * rounding
        rest += _UNDERFLOW
        center = numbers[self.starts]
        size = np.add.reduceat(np.abs(numbers), self.starts, axis=0)
        radius = (size - np.abs(center)) + rest + unit * (size + rest)
        forms = _Forms(numbers, self.starts, rest, (size + rest) * (1 + unit))
        return forms, center - radius, center + radius

    def activated(self, lower: _Single, upper: _Single, open_: BoolArray) -> _Forms:
        """The forms of max(z, 0).

        lower, upper: bounds of z. open_: (n, k) mask of neurons that are neither active nor dead.
        """
        where: Any = np.where
        slope = where(open_, upper / (upper - lower), lower >= 0).astype(np.float32)
        top = where(open_, np.maximum(-lower * slope, upper - slope * upper), 0)
        half = (0.5 * (1 + 8 * _UNIT) * top).astype(np.float32)
        rest = slope * self.rest + 8 * _UNIT * (self.size + half)
        size = (slope * self.size + 2 * half) * (1 + 16 * _UNIT) + rest
        scaled = self.numbers * np.repeat(slope, self.counts, axis=0)
        scaled[self.starts] += half
        more = open_.sum(axis=1)
        if (len(scaled) + more.sum()) * scaled.shape[1] > _MAX_NUMBERS:
            return _Forms(scaled, self.starts, rest + half, size)
        box, column = np.nonzero(open_)
        numbers, starts, rows = with_rows(scaled, self.starts, more)
        numbers[rows, column] = half[box, column]
        return _Forms(numbers, starts, rest, size)


def with_rows(numbers: Any, starts: IntArray, more: IntArray) -> tuple[Any, IntArray, IntArray]:
    """Append rows of zeros to each run of rows.

    numbers: (rows, k). starts: (n,) the first row of each run. more: (n,) how many are new.

    Returns the new numbers, the new starts, and the indices of the new rows, run after run.
    """
    counts = np.diff(starts, append=len(numbers))
    ends = np.cumsum(counts + more)
    new_starts = ends - counts - more
    result = np.zeros((int(ends[-1]), *numbers.shape[1:]), numbers.dtype)
    result[np.arange(len(numbers)) + np.repeat(new_starts - starts, counts)] = numbers
    first_new = np.cumsum(more) - more
    rows = np.arange(int(more.sum())) + np.repeat(new_starts + counts - first_new, more)
    return result, new_starts, rows


def _ranges(
    layers: Sequence[tuple[_Single, _Single]], centers: FloatArray, half: FloatArray
) -> BoxRanges:
    """The ranges in boxes with these centers (n, 3) and half edge lengths (3,).

    layers: in single precision.
    """
    forms = _Forms.of_boxes(centers, half)
    active: list[BoolArray] = []
    dead: list[BoolArray] = []
    for layer in layers[:-1]:
        forms, lower, upper = forms.after(layer)
        is_active, is_dead = lower >= 0, upper <= 0
        # What is NaN is neither.
        forms = forms.activated(lower, upper, ~(is_active | is_dead))
        active.append(is_active)
        dead.append(is_dead & ~is_active)
    _, lower, upper = forms.after(layers[-1])
    return BoxRanges(
        lower[:, 0].astype(np.float64), upper[:, 0].astype(np.float64), tuple(active), tuple(dead)
    )
