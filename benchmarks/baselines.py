"""Methods in common use for tracing such surfaces, and the number of first hits that they miss.

None of these methods proves anything about singular or angle-valued functions: they are here for
comparison alone (the paper's Figs. 25 to 27). Rays are followed for 0 <= t <= 10 with at most 2500
steps, and a value within 1e-3 of the level is a hit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.geometry import example_curves

from .scenes import camera, unit

Array = npt.NDArray[np.float64]

FAR, EPS, MOST = 10.0, 1e-3, 2500
# A hit that is farther from the oracle's than this counts as another hit.
APART = 0.02
ACROSS, SAMPLES = 64, 6000
# Number of samples of a ray that are evaluated together.
_AT_ONCE = 50


@dataclass(frozen=True)
class Rays:
    """Values of a field along n rays, with counts of evaluations; rays end at `far` (n,)."""

    field: hk.Field
    level: float
    origins: Array
    directions: Array
    far: Array
    counts: npt.NDArray[np.int64]

    @classmethod
    def of(cls, field: hk.Field, level: float, across: int) -> Rays:
        """The rays of the camera of all benchmarks."""
        eye, d = camera(across)
        return cls.along(field, level, eye, d)[0]

    @classmethod
    def along(
        cls, field: hk.Field, level: float, eye: Array, d: Array
    ) -> tuple[Rays, npt.NDArray[np.bool_]]:
        """Rays of one origin (3,) and unit directions (m, 3), from the points where they enter the
        field's domain; and which (m,) of them enter it."""
        o, far = np.tile(eye, (len(d), 1)), np.full(len(d), FAR)
        is_hit = np.ones(len(d), bool)
        if isinstance(field.domain, hk.Ball):
            middle = -(o * d).sum(axis=1)
            half = field.domain.radius**2 - (o**2).sum(axis=1) + middle**2
            is_hit, half = half > 0, np.sqrt(np.maximum(half, 0))
            o, d, far = (o + (middle - half)[:, None] * d)[is_hit], d[is_hit], 2 * half[is_hit]
        return cls(field, level, o, d, far, np.zeros(len(d), np.int64)), is_hit

    def points(self, t: Array, rows: npt.NDArray[np.int64]) -> Array:
        """(n, 3) the points at t of some rays."""
        return self.origins[rows] + t[:, None] * self.directions[rows]

    def above(self, t: Array, rows: npt.NDArray[np.int64]) -> Array:
        """(n,) f - level; of an angle, from the nearest of its levels, so that it jumps halfway
        between two of them."""
        self.counts[rows] += 1
        value = self.field.value(self.points(t, rows), precision="double") - self.level
        period = self.field.period
        return value if period is None else value - period * np.round(value / period)

    def slope(self, t: Array, rows: npt.NDArray[np.int64]) -> Array:
        """(n,) df/dt."""
        gradient = self.field.gradient(self.points(t, rows), precision="double")
        return (gradient * self.directions[rows]).sum(axis=1)


Method = Callable[[Rays], Array]


def fixed_steps(step: float) -> Method:
    """Equal steps until f - level changes its sign, by less than half a period."""

    def method(rays: Rays) -> Array:
        n = len(rays.counts)
        crossings, active = np.full(n, np.inf), np.arange(n)
        t, before = np.zeros(n), rays.above(np.zeros(n), np.arange(n))
        half = math.inf if rays.field.period is None else 0.5 * rays.field.period
        for _ in range(min(MOST, math.ceil(FAR / step))):
            if not len(active):
                break
            value = rays.above(t[active] + step, active)
            last = before[active]
            hit = (last * value <= 0) & (np.abs(last - value) < half)
            fraction = last / np.where(last == value, 1, last - value)
            crossings[active[hit]] = (t[active] + step * fraction)[hit]
            t[active] += step
            before[active] = value
            active = active[~hit]
        return crossings

    return method


def sphere_tracing(constant: float) -> Method:
    """Steps of |f - level|/L with a claimed constant that does not hold."""

    def method(rays: Rays) -> Array:
        n = len(rays.counts)
        crossings, t, active = np.full(n, np.inf), np.zeros(n), np.arange(n)
        for _ in range(MOST):
            if not len(active):
                break
            gap = np.abs(rays.above(t[active], active))
            hit = gap < EPS
            crossings[active[hit]] = t[active[hit]]
            t[active] += gap / constant
            active = active[~hit & (t[active] <= FAR)]
        return crossings

    return method


def newton(rays: Rays) -> Array:
    """Eight iterations from t = 0, no step longer than 2."""
    n = len(rays.counts)
    t, rows = np.zeros(n), np.arange(n)
    for _ in range(8):
        value, slope = rays.above(t, rows), rays.slope(t, rows)
        t = t - np.clip(value / np.where(slope == 0, 1e-30, slope), -2, 2)
    is_root = (np.abs(rays.above(t, rows)) < EPS) & (t >= 0) & (t <= FAR)
    return np.where(is_root, t, np.inf)


def bisection(rays: Rays) -> Array:
    """The first of [0, 1/8], [0, 1/4], ... in which f - level changes its sign, halved 100 times.

    It ends at a jump of an angle as well.
    """
    n = len(rays.counts)
    rows = np.arange(n)
    lower, upper = np.zeros(n), np.full(n, 0.125)
    start = rays.above(lower, rows)
    end, crossings = start.copy(), np.full(n, np.inf)
    active = rows
    for _ in range(10):
        end[active] = rays.above(upper[active], active)
        active = active[start[active] * end[active] > 0]
        upper[active] *= 2
    active = rows[start * end <= 0]
    for _ in range(100):
        if not len(active):
            break
        middle = 0.5 * (lower[active] + upper[active])
        value = rays.above(middle, active)
        hit = (np.abs(value) < EPS) | (upper[active] - lower[active] < 1e-8)
        crossings[active[hit]] = middle[hit]
        is_before = value * start[active] > 0
        lower[active] = np.where(is_before, middle, lower[active])
        upper[active] = np.where(is_before, upper[active], middle)
        active = active[~hit]
    return np.where(crossings <= FAR, crossings, np.inf)


def interval_analysis(rays: Rays) -> Array:
    """The first interval of a bisection of [0, 10], 14 times, in which f may take the level.



    For a curve: the fan of triangles in interval arithmetic. An arctangent whose arguments may lie

    on the cut is anything between -pi and pi.
    """
    n = len(rays.counts)
    bound = _fan_bounds if isinstance(rays.field, hk.SolidAngle) else _gyroid_bounds
    crossings, depth = np.full(n, np.inf), 14
    low = np.zeros((n, depth + 2))
    high = np.full((n, depth + 2), FAR)
    top = np.ones(n, np.int64)
    active = np.arange(n)
    while len(active):
        k = top[active] - 1
        a, b = low[active, k], high[active, k]
        top[active] = k
        lower, upper = bound(rays, a, b, active)
        rays.counts[active] += 1
        straddles = (lower <= rays.level) & (upper >= rays.level)
        if rays.field.period is not None:  # any of the levels
            periods = np.ceil((lower - rays.level) / rays.field.period)
            straddles = rays.level + periods * rays.field.period <= upper
        leaf = b - a < max(2 * EPS, 1.5 * FAR / 2**depth)
        is_hit, is_split = straddles & leaf, straddles & ~leaf
        crossings[active[is_hit]] = 0.5 * (a + b)[is_hit]
        rows, middle, k = active[is_split], 0.5 * (a + b)[is_split], k[is_split]
        low[rows, k], high[rows, k] = middle, b[is_split]
        low[rows, k + 1], high[rows, k + 1] = a[is_split], middle
        top[rows] = k + 2
        active = active[~is_hit & (top[active] > 0)]
    return crossings


Interval = tuple[Array, Array]


def _product(x: Interval, y: Interval) -> Interval:
    ends = np.stack([x[0] * y[0], x[0] * y[1], x[1] * y[0], x[1] * y[1]])
    return ends.min(axis=0), ends.max(axis=0)


def _sum(*terms: Interval) -> Interval:
    return sum(t[0] for t in terms), sum(t[1] for t in terms)  # type: ignore[return-value]


def _dot(x: list[Interval], y: list[Interval]) -> Interval:
    return _sum(*(_product(a, b) for a, b in zip(x, y, strict=True)))


def _less(x: Interval, y: Interval) -> Interval:
    return x[0] - y[1], x[1] - y[0]


def _length(x: list[Interval]) -> Interval:
    lower, upper = 0.0, 0.0
    for a, b in x:
        min_abs = np.where((a <= 0) & (b >= 0), 0, np.minimum(np.abs(a), np.abs(b)))
        lower, upper = lower + min_abs**2, upper + np.maximum(np.abs(a), np.abs(b)) ** 2
    return np.sqrt(lower), np.sqrt(upper)


def _fan_bounds(
    rays: Rays, start: Array, end: Array, rows: npt.NDArray[np.int64]
) -> tuple[Array, Array]:
    """Bounds of the solid angle between two lengths, of a fan about the center of the vertices."""
    field = rays.field
    assert isinstance(field, hk.SolidAngle)
    p, q = rays.points(start, rows), rays.points(end, rows)
    box = np.minimum(p, q), np.maximum(p, q)
    lower, upper = np.zeros(len(rows)), np.zeros(len(rows))
    for loop in field.loops:
        middle = loop.mean(axis=0)
        for first, second in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            a, b, c = (
                [(v[k] - box[1][:, k], v[k] - box[0][:, k]) for k in range(3)]
                for v in (first, second, middle)
            )
            cross = [
                _less(_product(b[i], c[j]), _product(b[j], c[i]))
                for i, j in ((1, 2), (2, 0), (0, 1))
            ]
            y = _dot(a, cross)
            la, lb, lc = _length(a), _length(b), _length(c)
            x = _sum(
                _product(_product(la, lb), lc), _product(_dot(a, b), lc),
                _product(_dot(b, c), la), _product(_dot(c, a), lb),
            )  # fmt: skip
            at_cut = (x[0] <= 0) & (y[0] <= 0) & (y[1] >= 0)
            angles = np.stack([np.arctan2(v, u) for u in x for v in y])
            lower += np.where(at_cut, -2 * np.pi, 2 * angles.min(axis=0))
            upper += np.where(at_cut, 2 * np.pi, 2 * angles.max(axis=0))
    return lower, upper


def _gyroid_bounds(
    rays: Rays, start: Array, end: Array, rows: npt.NDArray[np.int64]
) -> tuple[Array, Array]:
    """Bounds of sin x cos y + sin y cos z + sin z cos x between two lengths."""
    field = rays.field
    assert isinstance(field, hk.Gyroid)
    frequency = 2 * np.pi / field.cell
    p, q = frequency * rays.points(start, rows), frequency * rays.points(end, rows)
    box = np.minimum(p, q), np.maximum(p, q)
    sines = [_sine(box[0][:, k], box[1][:, k]) for k in range(3)]
    cosines = [_sine(box[0][:, k] + np.pi / 2, box[1][:, k] + np.pi / 2) for k in range(3)]
    return _sum(*(_product(sines[k], cosines[(k + 1) % 3]) for k in range(3)))


def _sine(lower: Array, upper: Array) -> Interval:
    ends = np.sin(lower), np.sin(upper)
    top = np.floor((upper - np.pi / 2) / (2 * np.pi)) > np.floor((lower - np.pi / 2) / (2 * np.pi))
    foot = np.floor((upper + np.pi / 2) / (2 * np.pi)) > np.floor((lower + np.pi / 2) / (2 * np.pi))
    return np.where(foot, -1, np.minimum(*ends)), np.where(top, 1, np.maximum(*ends))


METHODS: tuple[tuple[str, Method], ...] = (
    ("fixed steps of 0.1", fixed_steps(0.1)),
    ("fixed steps of 0.02", fixed_steps(0.02)),
    ("fixed steps of 0.004", fixed_steps(0.004)),
    ("sphere tracing, L = 5", sphere_tracing(5.0)),
    ("sphere tracing, L = 50", sphere_tracing(50.0)),
    ("Newton", newton),
    ("bisection", bisection),
    ("interval analysis", interval_analysis),
)


def oracle(rays: Rays) -> Array:
    """First crossings, from samples 1/2000 apart."""
    n = len(rays.counts)
    crossings = np.full(n, np.inf)
    middle = -(rays.origins * rays.directions).sum(axis=1)
    start, end = np.maximum(middle - 1.5, 0), np.minimum(middle + 1.5, rays.far)
    half = math.inf if rays.field.period is None else 0.5 * rays.field.period
    rows = np.flatnonzero(end > start)
    before = rays.above(start[rows], rows)
    for fractions in np.array_split(np.arange(1, SAMPLES) / (SAMPLES - 1), SAMPLES // _AT_ONCE):
        if not len(rows):
            break
        t = start[rows] + (end - start)[rows] * fractions[:, None]
        ray_ids = np.broadcast_to(rows, t.shape)
        value = rays.above(t.ravel(), ray_ids.ravel()).reshape(t.shape)
        last = np.concatenate([before[None], value[:-1]])
        crosses = (last * value <= 0) & (np.abs(last - value) < half)
        hit, first = crosses.any(axis=0), crosses.argmax(axis=0)
        at = first[hit], np.flatnonzero(hit)
        fraction = last[at] / np.where(last[at] == value[at], 1, last[at] - value[at])
        step = (end - start)[rows[hit]] / (SAMPLES - 1)
        crossings[rows[hit]] = t[at] + (fraction - 1) * step
        rows, before = rows[~hit], value[-1, ~hit]
    return crossings


@dataclass(frozen=True)
class Result:
    """The result of a method on n rays. late (n,): first crossings that it passed. early (n,): hits
    where there is none, or before the first."""

    name: str
    late: npt.NDArray[np.bool_]
    early: npt.NDArray[np.bool_]
    evaluations: float
    t: Array

    @classmethod
    def of(cls, name: str, t: Array, evaluations: float, truth: Array) -> Result:
        late = np.isfinite(truth) & (t > truth + APART)
        return cls(name, late, np.isfinite(t) & (t < truth - APART), evaluations, t)

    @property
    def missed(self) -> int:
        return int(self.late.sum())

    @property
    def false(self) -> int:
        return int(self.early.sum())


def measure(rays: Rays, name: str, method: Method, truth: Array) -> Result:
    """One method against the oracle's first crossings."""
    rays.counts[:] = 0
    t = method(rays)
    return Result.of(name, np.where(t <= rays.far, t, np.inf), float(rays.counts.mean()), truth)


def measure_ours(rays: Rays, truth: Array) -> Result:
    """`hk.trace`, in single precision, with its defaults but for the tolerance. A ray that grazes
    the surface within that may count as a hit, which the oracle does not see."""
    ours = hk.trace(
        rays.field, rays.origins, rays.directions, level=rays.level, t_max=rays.far,
        tolerance=1e-6, precision="single",
    )  # fmt: skip
    t = np.where(ours.is_hit, ours.t, np.inf)
    return Result.of("harnack", t, float(ours.evaluations.mean()), truth)


def compare(field: hk.Field, level: float, across: int = ACROSS) -> tuple[list[Result], Array]:
    """All methods on one field, harnack last, and the oracle's first crossings."""
    rays = Rays.of(field, level, across)
    truth = oracle(rays)
    results = [measure(rays, name, method, truth) for name, method in METHODS]
    return [*results, measure_ours(rays, truth)], truth


def trefoil() -> hk.SolidAngle:
    """A knot, within the unit ball: its surface has no inside, and is not a disk."""
    return hk.SolidAngle(unit(example_curves.torus_knot(2, 3, 48)))


def baselines() -> str:
    """The section of the page."""
    scenes: tuple[tuple[str, hk.Field, float], ...] = (
        ("polygon, N = 12, 2 pi", hk.SolidAngle(example_curves.wavy_polygon(12)), 2 * math.pi),
        ("trefoil, N = 48, 2 pi", trefoil(), 2 * math.pi),
        ("gyroid, 3 cells, 0", hk.Gyroid(cell=2 / 3, domain=hk.Ball(radius=1)), 0.0),
    )
    lines = [
        "## Methods without a proof\n",
        "What is commonly used where no bound is known, as in Figs. 25 to 27 of the paper, for "
        f"{ACROSS} x {ACROSS} rays with 0 <= t <= 10, against {SAMPLES} samples of each "
        "ray near the surface. Missed: the first crossing was passed. False: a hit where there is "
        f"none, or more than {APART} before the first. In double precision, but harnack in single, "
        "with a tolerance of 1e-6 and else its defaults.\n",
        "| surface | method | first hits missed | false hits | evaluations a ray |",
        "|---|---|---:|---:|---:|",
    ]
    for scene, field, level in scenes:
        results, truth = compare(field, level)
        hits = int(np.isfinite(truth).sum())
        for result in results:
            lines.append(
                f"| {scene} ({hits} hits) | {result.name} | {result.missed} | {result.false} "
                f"| {result.evaluations:.1f} |"
            )
    return "\n".join(lines) + "\n"
