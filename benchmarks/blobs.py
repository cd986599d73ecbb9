"""Compact blobs as a formula of records: the field of comparisons with published methods.

f = sum of a max(1 - |p - c|^2/R^2, 0)^3 - T over the blobs. The formula itself goes through every
arithmetic; ranges of derivatives in closed form, and those published for segment tracing, are given
besides. `Scene` and its rays are those that the published tables were repeated with before.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

import harnack as hk
from harnack.arithmetic.operators import Tally, tally_of
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.enclosures import SlopeRange
from harnack.enclosures.enclosure import PathPiece
from harnack.fields.blobs.kernels import CompactKernel
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.formula import Formula
from harnack.fields.formula_evaluator import FormulaEvaluator, FormulaOnRay
from harnack.literature import clipped_power

# Rounding of a blob's derivatives, in units of their largest absolute values.
_ROUNDINGS = 64.0


@dataclass(frozen=True)
class Scene:
    """Random blobs of compact support and their threshold.

    centers: (n, 3). reaches: (n,) R, where a blob ends. heights: (n,). threshold: T.
    """

    centers: np.ndarray
    reaches: np.ndarray
    heights: np.ndarray
    threshold: float
    width: float

    @classmethod
    def random(
        cls, count: int, size: float, radii: tuple[float, float], width: float, seed: int
    ) -> Scene:
        """Blobs of random radii r in a cube of half the edge `size`; each alone would be a ball of
        radius r, and ends at width r."""
        generator = np.random.default_rng(seed)
        centers = generator.uniform(-size, size, (count, 3))
        radius = generator.uniform(*radii, count)
        height = np.full(count, 1.0 / (1 - 1 / width**2) ** 3)
        return cls(centers, width * radius, height, 1.0, width)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        reach = self.reaches[:, None]
        return (self.centers - reach).min(0), (self.centers + reach).max(0)

    def rays(self, count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Origins, unit directions and lengths of rays between random points of the box's faces."""
        generator = np.random.default_rng(seed)
        lower, upper = self.box
        size = upper - lower
        areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])

        def points() -> np.ndarray:
            axis = generator.choice(3, count, p=areas / areas.sum())
            side = generator.integers(0, 2, count)
            p = lower + generator.random((count, 3)) * size
            p[np.arange(count), axis] = np.where(side, upper[axis], lower[axis])
            return p

        a, b = points(), points()
        length = np.linalg.norm(b - a, axis=1)
        is_long = length > 1e-6
        return a[is_long], ((b - a) / length[:, None])[is_long], length[is_long]

    def values(self, points: np.ndarray, groups: int = 1) -> np.ndarray:
        """f in double precision, at points (n, 3): of several groups the largest sum, where blob k
        is in group k modulo their number."""
        sums = np.full((groups, len(points)), -self.threshold)
        for k, c in enumerate(self.centers):
            w = 1 - ((points - c) ** 2).sum(1) / self.reaches[k] ** 2
            sums[k % groups] += self.heights[k] * np.maximum(w, 0) ** 3
        return sums.max(0)

    def crossings(self, rays: tuple[np.ndarray, ...], groups: int, samples: int) -> np.ndarray:
        """The number of sign changes of f between `samples` + 1 points of each ray."""
        o, d, length = rays
        previous, count = None, np.zeros(len(o), int)
        for k in range(samples + 1):
            is_inside = self.values(o + (length * k / samples)[:, None] * d, groups) >= 0
            count += 0 if previous is None else is_inside != previous
            previous = is_inside
        return count

    def field(self, groups: int = 1) -> hk.Blobs:
        """The same field plus its threshold, in the library's form."""
        grouped = None if groups == 1 else np.arange(len(self.centers)) % groups
        kernel = CompactKernel(support=self.width)
        return hk.Blobs(self.centers, self.reaches / self.width, kernel=kernel, groups=grouped)

    def first_inside(self, rays: tuple[np.ndarray, ...], samples: int) -> np.ndarray:
        """The first of `samples` + 1 points of each ray at which f is positive; else infinity."""
        o, d, length = rays
        entries = np.full(len(o), np.inf)
        for k in range(samples + 1):
            t = length * k / samples
            is_inside = self.values(o + t[:, None] * d) >= 0
            entries = np.where(is_inside & np.isinf(entries), t, entries)
        return entries


@dataclass(frozen=True, eq=False)
class BlobFormula(Formula):
    """The field of a `Scene`.

    exact: whether ranges of the first derivative are exact, for each blob; else products of the
        ranges of the kernel's and the distance's derivative, as in segment tracing (Galin et al.
        2020; Aydinlilar and Zanni 2023, equation 21).
    groups: as in `Scene.values`; ranges of derivatives are not supported for several.
    """

    scene: Scene
    exact: bool = True
    groups: int = 1
    may_jump = False

    def evaluator(self, backend: Any, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        return BlobEvaluator(self, self.formula_on(backend), None)

    def formula_on(self, backend: Any) -> DeviceBlobs:
        scene = self.scene
        table = np.column_stack([scene.centers, scene.reaches**-2.0, scene.heights])
        tables = [RecordTable.upload(backend, table[k :: self.groups]) for k in range(self.groups)]
        return DeviceBlobs(tuple(tables), scene.threshold, self.exact)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        raise TypeError("the formula goes over records on a backend: take formula_on(backend)")


@dataclass(frozen=True, eq=False)
class DeviceBlobs:
    """The formula of a `BlobFormula`, with the records of the blobs of each group on a backend."""

    records: tuple[RecordTable, ...]
    threshold: float
    exact: bool

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        kernel = clipped_power(3)

        def blob(row: list[Any]) -> Any:
            u, v, w = x - row[0], y - row[1], z - row[2]
            return kernel(1.0 - (u * u + v * v + w * w) * row[3]) * row[4]

        sums = [summed(group, blob) for group in self.records]
        for group in sums[1:]:
            sums[0] = hk.math.maximum(sums[0], group)
        return sums[0] - self.threshold


class BlobEvaluator(FormulaEvaluator):
    """The evaluator of a `BlobFormula`."""

    @property
    def tally(self) -> Tally:
        return tally_of(self.formula)

    def restrict(self, p: Any, direction: Any) -> BlobsAlong:
        return BlobsAlong(self, p, direction, piece_count=4)


@dataclass(frozen=True)
class BlobsAlong(FormulaOnRay):
    """Blobs along a path, with ranges of derivatives in closed form."""

    def derivative_ranges(self, knots: Sequence[Any]) -> tuple[PathPiece, ...]:
        """With x = s - s0 along the path and S half the chord, the derivative of
        a (w0 - x^2/R^2)^3 has its extrema at x^2 = S^2/5, the second at 0 and x^2 = 3 S^2/5."""
        blobs: Any = self.evaluator.formula
        count = len(knots) - 1
        zero = 0 * self.p.x

        def body(row: list[Any], state: tuple[Any, ...]) -> tuple[Any, ...]:
            center, rate, height = row[:3], row[3], row[4]
            v = [center[k] - self.p[k] for k in range(3)]
            middle = sum((v[k] * self.direction[k] for k in range(1, 3)), v[0] * self.direction[0])
            offset = [v[k] - middle * self.direction[k] for k in range(3)]
            squared_distance = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
            top = 1 - squared_distance * rate
            half = dr.sqrt(fmax(top, 0) / rate)
            rounding = _ROUNDINGS * float(dr.epsilon(type(top)))
            is_inside = half > 0
            slope_error = dr.select(is_inside, rounding * 6 * height * dr.sqrt(rate), 0)
            second_error = dr.select(is_inside, rounding * 30 * height * rate, 0)

            def first(x: Any) -> Any:
                w = fmax(top - rate * x * x, 0)
                return -6 * height * rate * x * w * w

            def second(x: Any) -> Any:
                w = fmax(top - rate * x * x, 0)
                return 6 * height * rate * w * (4 * rate * x * x - w)

            new: list[Any] = []
            for k, (start, end) in enumerate(itertools.pairwise(knots)):
                x, y = start - middle, end - middle
                if blobs.exact:
                    near = math.sqrt(0.2) * half
                    low, high = _extrema(first, x, y, half, (near, -near))
                else:
                    low, high = _product(squared_distance, rate, height, x, y)
                far = math.sqrt(0.6) * half
                min_second, max_second = _extrema(second, x, y, half, (far, -far, 0 * far))
                old = state[4 * k : 4 * k + 4]
                new += [
                    old[0] + (low - slope_error), old[1] + (high + slope_error),
                    old[2] + (min_second - second_error), old[3] + (max_second + second_error),
                ]  # fmt: skip
            return tuple(new)

        state = blobs.records[0].for_each(body, (zero,) * (4 * count), "blobs along")
        return tuple(
            PathPiece(
                end - start, SlopeRange(*state[4 * k : 4 * k + 2]), *state[4 * k + 2 : 4 * k + 4]
            )
            for k, (start, end) in enumerate(itertools.pairwise(knots))
        )


def _extrema(
    function: Callable[[Any], Any], x: Any, y: Any, half: Any, places: tuple[Any, ...]
) -> tuple[Any, Any]:
    """The smallest and the largest value on [x, y] of a function that is 0 outside [-half, half]
    and has no extrema but at the places."""
    a, b = clamp(x, -half, half), clamp(y, -half, half)
    lower = upper = function(a)
    for point in (b, *(clamp(place, a, b) for place in places)):
        value = function(point)
        lower, upper = fmin(lower, value), fmax(upper, value)
    return lower, upper


def _product(square: Any, rate: Any, height: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """The range of k'(d) times the range of d', with d the distance from the center."""
    first, last = dr.sqrt(square + x * x), dr.sqrt(square + y * y)
    ratios = [factor / fmax(d, 1e-20) for factor, d in ((x, first), (y, last))]
    nearest = dr.select((x < 0) & (y > 0), dr.sqrt(square), fmin(first, last))
    farthest = fmax(first, last)

    def kernel(d: Any) -> Any:
        w = fmax(1 - rate * d * d, 0)
        return -6 * height * rate * d * w * w

    peak = clamp(dr.sqrt(0.2 / rate), nearest, farthest)
    ends = kernel(nearest), kernel(farthest)
    low, high = fmin(fmin(*ends), kernel(peak)), fmax(*ends)
    products = [k * ratio for k in (low, high) for ratio in ratios]
    lower = upper = products[0]
    for factor in products[1:]:
        lower, upper = fmin(lower, factor), fmax(upper, factor)
    return lower, upper


def summed(records: RecordTable, term: Callable[[list[Any]], Any]) -> Any:
    """The sum of `term` of every record, in numbers of any arithmetic, in one recorded loop."""
    start = term(records.read_record(records.backend.UInt32(0)))
    zero = records.backend.Float(0)

    def body(i: Any, *state: Any) -> tuple[Any, ...]:
        total = _rebuilt(start, iter(state)) + term(records.read_record(i))
        return i + 1, *(zero + number for number in _numbers(total))

    first = (records.backend.UInt32(1), *(zero + number for number in _numbers(start)))
    state = dr.while_loop(first, lambda i, *_: i < records.iteration_count, body, label="blobs")
    return _rebuilt(start, iter(state[1:]))


def _numbers(x: Any) -> Iterator[Any]:
    """The numbers of the backend, and Python floats, of a number of any arithmetic."""
    if dataclasses.is_dataclass(x):
        for entry in dataclasses.fields(x):
            yield from _numbers(getattr(x, entry.name))
    elif isinstance(x, tuple):
        for element in x:
            yield from _numbers(element)
    elif x is not None and not isinstance(x, int):
        yield x


def _rebuilt(like: Any, numbers: Iterator[Any]) -> Any:
    if dataclasses.is_dataclass(like):
        values = {
            entry.name: _rebuilt(getattr(like, entry.name), numbers)
            for entry in dataclasses.fields(like)
        }
        return type(like)(**values)
    if isinstance(like, tuple):
        return tuple(_rebuilt(element, numbers) for element in like)
    return like if like is None or isinstance(like, int) else next(numbers)
