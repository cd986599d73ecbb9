"""Fields sampled as NumPy arrays, the search for violations of promises, and the errors that report
them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import BoundedLaplacian, Enclosure, HarmonicBall, LevelGaps, SlopeRange
from harnack.fields.capabilities import NO_FACET, JumpCrossing

if TYPE_CHECKING:
    from harnack.backend import Mask, Precision, Real
    from harnack.enclosures import Promise
    from harnack.fields.field import Field, Sample

__all__ = [
    "BrokenPromiseError",
    "FieldSamples",
    "RayLift",
    "accumulated_jumps",
    "lift_along_rays",
    "mutated_enclosure",
    "original_enclosure",
    "random_directions",
    "random_points",
    "require",
    "sample_field",
    "search_violations",
]


class BrokenPromiseError(AssertionError):
    """A field or an enclosure promised something that is not true; the message says which promise,
    and where."""


def require(
    good: Any,
    message: str,
    points: FloatArray,
    amount: FloatArray | None = None,
    there: FloatArray | None = None,
) -> None:
    """Raise BrokenPromiseError for the worst of the points (n, 3) at which `good` (n,) is false.

    amount: (n,) the size of the violation.
    there: (n, 3) the points where it shows, if not at the points themselves.
    """
    broken: BoolArray = ~np.asarray(good, dtype=np.bool_)
    bad = np.flatnonzero(broken)
    if not bad.size:
        return
    worst = bad[0] if amount is None else bad[np.abs(amount[bad]).argmax()]
    by = "" if amount is None else f" (by {amount[worst]:.3g})"
    where = "" if there is None else f", at {there[worst].tolist()}"
    raise BrokenPromiseError(
        f"{message}{by}: point {points[worst].tolist()}{where}; {bad.size} of {len(points)} points"
    )


def mutated_enclosure(kind: type[Enclosure], factor: float, *, covers: float | None = None) -> Any:
    """A class of enclosures that is wrong on purpose, to test that the tests detect it: every free
    length is multiplied by `factor`, and every length that `is_free` accepts by `covers` (None: by
    the same factor)."""
    loose = factor if covers is None else covers
    base: Any = kind

    class Scaled(base):
        original = kind

        def free_length(self, gaps: LevelGaps) -> Real:
            inner: Any = super()
            return factor * inner.free_length(gaps)

        def is_free(self, gaps: LevelGaps, length: Real) -> Mask:
            inner: Any = super()
            return inner.is_free(gaps, length / loose)

    Scaled.__name__ = f"Scaled{kind.__name__}"
    return Scaled


def original_enclosure(kind: type[Enclosure]) -> type[Enclosure]:
    """The class from which `mutated_enclosure` derived a class; any other class itself."""
    return getattr(kind, "original", kind)


# Fields from outside: values, gradients and continuous lifts.


@dataclass(frozen=True)
class FieldSamples:
    """Samples of a field at n points: values (n,), gradients (n, 3), their error bounds and the
    promises, (n,) each."""

    value: FloatArray
    gradient: FloatArray
    error: FloatArray
    gradient_error: FloatArray
    promises: tuple[Promise, ...]

    def subset(self, rows: BoolArray) -> FieldSamples:
        """The samples at the rows given by indices or by a mask."""
        return FieldSamples(
            self.value[rows],
            self.gradient[rows],
            self.error[rows],
            self.gradient_error[rows],
            tuple(one.map_numbers(lambda number, _, __: number[rows]) for one in self.promises),
        )


def sample_field(
    field: Field, points: FloatArray, precision: Precision = "double", *, closely: bool = False
) -> FieldSamples:
    """Sample the field at points (n, 3); all numbers of its promises are float64 arrays (n,).

    closely: whether to sample without truncation error.
    """
    n = len(points)
    sample = _sample(field, points, precision, closely)
    numbers_known = [list(vars(one).values()) for one in sample.all_promises]
    # At once, or each would be computed by a kernel of its own.
    dr.eval(sample.value, sample.gradient, sample.value_error, sample.gradient_error, numbers_known)

    known = tuple(
        one.map_numbers(lambda number, _, __: _spread(number, n)) for one in sample.all_promises
    )
    return FieldSamples(
        _spread(sample.value, n),
        np.broadcast_to(to_numpy(sample.gradient), (n, 3)).astype(np.float64),
        _spread(sample.value_error, n),
        _spread(sample.gradient_error, n),
        known,
    )


@dataclass(frozen=True)
class RayLift:
    """The continuous lift of f at m points along each of n rays; all arrays are (n, m).

    moved: the movement of the lift since the ray's first point.
    jumped: the sum of the jumps of f since then, across jump surfaces.
    gradient_norm: |grad f| at the points.
    error: `Sample.value_error` at the points.
    """

    moved: FloatArray
    jumped: FloatArray
    gradient_norm: FloatArray
    error: FloatArray


def lift_along_rays(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> RayLift:
    """The movement of the continuous lift of f along rays: f(start + t direction) - f(start).

    start, direction: (n, 3), unit directions. lengths: t (n, m), each row ascending from 0.

    A value that is known modulo the period is continued to the value that the mean of the gradients
    at both ends of an interval predicts; jumps are taken out.
    """
    n, m = lengths.shape
    points = start[:, None] + lengths[..., None] * direction[:, None]
    look = sample_field(field, points.reshape(-1, 3))
    value, gradient = look.value.reshape(n, m), look.gradient.reshape(n, m, 3)
    slope = np.einsum("nmk,nk->nm", gradient, direction)
    move = np.diff(value, axis=1)
    if field.period is not None:
        expected = 0.5 * (slope[:, 1:] + slope[:, :-1]) * np.diff(lengths, axis=1)
        expected = np.where(np.isfinite(expected), expected, 0)
        # A gradient may grow without limit at a curve; there the lift still moves little.
        expected = np.clip(expected, -0.5 * field.period, 0.5 * field.period)
        move -= field.period * np.round((move - expected) / field.period)
    total = np.concatenate([np.zeros((n, 1)), np.cumsum(move, axis=1)], axis=1)
    jumped = accumulated_jumps(field, start, direction, lengths)
    return RayLift(
        total - jumped, jumped, np.linalg.norm(gradient, axis=2), look.error.reshape(n, m)
    )


def accumulated_jumps(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> FloatArray:
    """The sum (n, m) of the jumps of f since the first of the lengths (n, m) along rays, as
    `next_jump` reports them."""
    total = np.zeros_like(lengths)
    if not field.has_jumps:
        return total
    backend = choose_backend("double")
    prepared = field.prepare(backend)
    o, d = to_vector3(backend, start), to_vector3(backend, direction)
    first, far = (backend.Float(np.ascontiguousarray(lengths[:, k])) for k in (0, -1))
    behind = JumpCrossing(first, backend.UInt32(NO_FACET), backend.Float(0), d)
    while True:
        behind = prepared.next_jump(o, d, behind, far, backend.Bool(True))
        t, jump = (_spread(one, len(start)) for one in (behind.t, behind.jump))
        ahead = np.isfinite(t)
        if not ahead.any():
            return total
        passed = ahead[:, None] & (lengths >= t[:, None])
        total += np.where(passed, np.where(ahead, jump, 0)[:, None], 0)


def random_points(field: Field, rng: np.random.Generator, n: int) -> FloatArray:
    """n points of the field's domain; where that is unbounded, around its default surface."""
    volume = field.domain if field.domain is not None else field.extent((field.default_level,))
    if volume is None:
        return 3 * random_directions(rng, n) * rng.random((n, 1))
    lower, upper = volume.bounds()
    lower, upper = np.where(np.isfinite(lower), lower, -3), np.where(np.isfinite(upper), upper, 3)
    found = np.zeros((0, 3))
    while len(found) < n:
        points = rng.uniform(lower, upper, (4 * n, 3))
        if field.domain is not None:
            points = points[field.domain.contains_points(points)]
        found = np.concatenate([found, points])
    return found[:n]


def random_directions(rng: np.random.Generator, n: int) -> FloatArray:
    """n unit vectors, uniform on the sphere."""
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sample(field: Field, points: FloatArray, precision: Precision, closely: bool) -> Sample:
    backend = choose_backend(precision)
    prepared = field.prepare(backend)
    seen = prepared.exact(backend) if closely else prepared
    return seen.evaluate(to_vector3(backend, points, "points"))


def _spread(value: object, n: int) -> FloatArray:
    array = to_numpy(value) if dr.is_array_v(value) else np.asarray(value)
    return np.broadcast_to(array, (n,)).astype(np.float64)


# The search for the worst places.

# Pairs that climb: at most, and of the points given; how many moves each tries in a round, and
# rounds. Where f is known along a path only, which costs one evaluation a sample, fewer.
_MOST_PAIRS, _PAIRS_OF_POINTS = 48, 0.25
_MOVES, _ROUNDS, _PATH_COST_DIVISOR = 8, 36, 2
# Of the radius: how near places come to the border of the ball.
_BORDER = 1 - 1e-6
# Sizes of moves, in radii: the first, the least, and what success and failure make of them.
_FIRST_STEP, _MIN_STEP, _STEP_GROWTH, _STEP_SHRINKAGE = 0.25, 1e-9, 1.6, 0.6
# Of the coordinates: radii below this are left out, for rounding moves places in them.
_SMALLEST = 1e-6
# Samples on the path to a place, where f is known along it only: searching, and to be sure.
_PATH_SAMPLES, _FINAL_PATH_SAMPLES = 24, 600
# What a ratio may be above one for rounding, and rounding of the values.
_ALLOWED, _ROUNDING = 1e-6, 1e-9
# Of the radius: the spacing of differences of gradients.
_SPACING = 1e-3


@dataclass(frozen=True)
class _Candidates:
    """Pairs of points p (n, 3) and y = p + reach * w, |w| < 1, with their violation ratios (n,): a
    promise is violated where the ratio is above 1."""

    p: FloatArray
    w: FloatArray
    reach: FloatArray
    violation_ratio: FloatArray

    def best_of(self, others: _Candidates) -> tuple[_Candidates, BoolArray]:
        """For each of these n pairs, the best of itself and its m of the n * m `others`; and (n,)
        whether that is another."""
        n = len(self.p)
        m = len(others.p) // n
        which = np.arange(n) * m + others.violation_ratio.reshape(n, m).argmax(axis=1)
        better = others.violation_ratio[which] > self.violation_ratio
        rows = better[:, None]
        return _Candidates(
            np.where(rows, others.p[which], self.p),
            np.where(rows, others.w[which], self.w),
            np.where(better, others.reach[which], self.reach),
            np.where(better, others.violation_ratio[which], self.violation_ratio),
        ), better


def search_violations(
    field: Field, points: FloatArray, look: FieldSamples, number: int, rng: np.random.Generator
) -> None:
    """Search for points that violate a promise, the one with index `number` in
    `Sample.all_promises`.

    A promise that is wrong by a few percent is violated only in special places: beside a
    singularity that lies just inside of the ball, or in the one direction in which a range is
    attained. Random points miss these. So this is a random local search over pairs: a point p,
    where the promise is made, and a point y in its ball, where it is tested. Both are moved at
    random, and a move is kept if it raises the violation ratio. The step length grows after success
    and shrinks after failure.

    points: (n, 3), and `look` the samples of the field there. The search starts from the points
        with the smallest radius and from others chosen at random, with y towards the border of the
        ball: along the gradient, against it, and in random directions.

    Raises:
        BrokenPromiseError: naming both points of the worst pair.
    """
    search = _ViolationSearch(field, number, 2 * float(np.ptp(points, axis=0).max()) + 1e-300)
    part = _PATH_COST_DIVISOR if search.needs_path else 1
    pairs = min(max(int(_PAIRS_OF_POINTS * len(points)), 6), _MOST_PAIRS) // part
    moves_each = _MOVES // part
    order = np.argsort(np.broadcast_to(look.promises[number].radius, len(points)), kind="stable")
    rows = np.concatenate([order[: pairs // 3], rng.choice(len(points), pairs)])[:pairs]
    steepest = look.gradient[rows]
    length = np.linalg.norm(steepest, axis=1, keepdims=True)
    steepest = np.where(length > 0, steepest / np.maximum(length, 1e-300), [1.0, 0.0, 0.0])
    turn = np.arange(pairs)[:, None] % 3
    along = np.where(turn == 1, -1, 1) * steepest
    ways = np.where(turn == 2, random_directions(rng, pairs), along)
    found = search.pairs(points[rows], ways * rng.uniform(0.3, 1, (pairs, 1)))
    size = np.full(pairs, _FIRST_STEP)
    for _ in range(_ROUNDS // part):
        step = np.repeat(size, moves_each)[:, None]
        p, w = (np.repeat(one, moves_each, axis=0) for one in (found.p, found.w))
        reach = np.repeat(found.reach, moves_each)[:, None]
        # Half of the moves keep the point, a quarter of them the place.
        kind = np.arange(len(p))[:, None] % 4
        moves = kind >= 2
        way = rng.normal(size=p.shape) * step * 10 ** rng.uniform(-1, 0, (len(p), 1))
        shift = np.where(moves, rng.normal(size=p.shape) * step, 0)
        near = w - np.where(kind == 3, shift, 0) + np.where(kind == 3, 0, way)
        # A promise of slopes or second derivatives is broken most between neighbors: a way that is
        # turned and made shorter or longer, by a share of its length.
        length = np.linalg.norm(w, axis=1, keepdims=True)
        turned = (w + length * way) * 10 ** rng.uniform(-1, 0.5, (len(p), 1))
        near = np.where(np.arange(len(p))[:, None] % 8 == 1, turned, near)
        near = np.where(np.arange(len(p))[:, None] % 8 == 2, w + length * way, near)
        found, better = found.best_of(search.pairs(p + reach * shift, near))
        size = np.where(better, np.minimum(_STEP_GROWTH * size, 1), _STEP_SHRINKAGE * size)
        size = np.where(size < _MIN_STEP, _FIRST_STEP, size)
    worst = found.violation_ratio > 1 + _ALLOWED
    if worst.any():
        found = search.pairs(found.p[worst], found.w[worst], samples=_FINAL_PATH_SAMPLES)
        there = found.p + found.reach[:, None] * found.w
        good = ~(found.violation_ratio > 1 + _ALLOWED)
        name = type(look.promises[number]).__name__
        message = f"{name}: f leaves what is promised here, by this factor"
        require(good, message, found.p, found.violation_ratio, there)


@dataclass(frozen=True)
class _ViolationSearch:
    """The search for pairs that violate a promise.

    promise_index: of the promise in `Sample.all_promises`.
    longest: the length that stands for an infinite radius.
    """

    field: Field
    promise_index: int
    longest: float

    @property
    def needs_path(self) -> bool:
        """Whether the movement of f between two points must be added up along a path, without its
        jumps."""
        return self.field.period is not None or self.field.has_jumps

    def pairs(self, p: FloatArray, w: FloatArray, samples: int = _PATH_SAMPLES) -> _Candidates:
        """The pairs of points p (n, 3) and vectors w (n, 3), fractions of the radius, which are
        shortened to stay in the ball."""
        length = np.linalg.norm(w, axis=1, keepdims=True)
        w = w * np.minimum(1, _BORDER / np.maximum(length, 1e-300))
        ratio, reach = np.full(len(p), -np.inf), np.full(len(p), 1.0)
        rows = np.flatnonzero(self._within(p))
        if len(rows):
            look = sample_field(self.field, p[rows])
            known = look.promises[self.promise_index]
            reach[rows] = np.minimum(known.radius, self.longest)
            y = p + reach[:, None] * w
            usable = reach[rows] > _SMALLEST * np.abs(p[rows]).max(axis=1)
            if not known.holds_outside_domain:
                usable &= self._within(y[rows])
            rows, look = rows[usable], look.subset(usable)
            if len(rows):
                ratio[rows] = self._ratio(look, p[rows], w[rows], reach[rows], samples)
        return _Candidates(p, w, reach, np.where(np.isnan(ratio), -np.inf, ratio))

    def _within(self, p: FloatArray) -> BoolArray:
        inside = np.asarray(np.isfinite(p).all(axis=1))
        if self.field.domain is not None:
            inside &= self.field.domain.contains_points(np.nan_to_num(p))
        return inside

    def _ratio(
        self, look: FieldSamples, p: FloatArray, w: FloatArray, reach: FloatArray, samples: int
    ) -> FloatArray:
        known, y = look.promises[self.promise_index], p + reach[:, None] * w
        there = sample_field(self.field, y)
        moved = there.value - look.value
        if self.needs_path:
            moved = self._lift(p, y, samples)
        error = look.error + there.error
        error = error + _ROUNDING * (np.abs(look.value) + (self.field.period or 0) + np.abs(moved))
        distance = reach * np.linalg.norm(w, axis=1)
        with np.errstate(all="ignore"):
            slope = np.einsum("nk,nk->n", look.gradient, y - p) / distance
            low, high = known.movement_bounds(look.value, SlopeRange(slope, slope), distance)
            if not known.holds_outside_domain:
                middle, half = 0.5 * (low + high), 0.5 * (high - low)
                error = error + look.gradient_error * distance * (middle != 0)
                return (np.abs(moved - middle) - error) / half
            below, above = error - low, error + high
            ratio, free = np.maximum(moved / above, -moved / below), reach - distance
            if isinstance(known, HarmonicBall):
                gap = np.minimum(below + moved, above - moved)
                ratio = np.fmax(ratio, _slope_ratio(known, there, free, gap))
            if isinstance(known, BoundedLaplacian):
                spacing = _SPACING * free
                ratio = np.fmax(ratio, self._laplacian_ratio(known, y, there, spacing))
            return ratio

    def _lift(self, p: FloatArray, y: FloatArray, samples: int) -> FloatArray:
        """How far the continuous lift moves from p to y (n,)."""
        way = y - p
        length = np.linalg.norm(way, axis=1)
        d = way / np.maximum(length, 1e-300)[:, None]
        # Denser towards the border, where singularities may lie.
        share = 1 - np.linspace(1, 0, samples) ** 2
        return lift_along_rays(self.field, p, d, length[:, None] * share).moved[:, -1]

    def _laplacian_ratio(
        self, known: BoundedLaplacian, y: FloatArray, there: FieldSamples, h: FloatArray
    ) -> FloatArray:
        """One more than by how much the Laplacian at y (n, 3) leaves its ends, in their size."""
        fine, wide = np.zeros(len(y)), np.zeros(len(y))
        rounding = 4 * there.gradient_error / h
        for axis in range(3):
            for node, weight, wider in ((1, 1.0, 0.0), (2, 0.0, 0.5)):
                way = (node * h)[:, None] * np.eye(3)[axis]
                rate = (
                    sample_field(self.field, y + way).gradient
                    - sample_field(self.field, y - way).gradient
                )
                fine += weight * rate[:, axis] / (2 * h)
                wide += wider * rate[:, axis] / (2 * h)
        size = np.linalg.norm(there.gradient, axis=1)
        rounding += 1e-11 * size * (1 + np.abs(y).max(axis=1) / h) / h + np.abs(fine - wide)
        off = np.maximum(known.laplacian_lower - fine, fine - known.laplacian_upper) - rounding
        scale = np.abs(known.laplacian_lower) + np.abs(known.laplacian_upper) + 1e-300
        return 1 + off / scale


def _slope_ratio(
    known: HarmonicBall, there: FieldSamples, free: FloatArray, gap: FloatArray
) -> FloatArray:
    """The ratio of |grad f|, at points of a ball, to the largest gradient of a harmonic function
    whose value there is `gap` away from the nearer end of its range.

    Proof. At y, `free` from the border, f - lower is positive and harmonic on B(y, free), so that
    by Harnack's inequality |grad f(y)| <= n (f(y) - lower)/free; likewise upper - f. Where a
    singularity lies in the ball, the left side grows faster than the right one beside it.
    """
    slope = np.maximum(np.linalg.norm(there.gradient, axis=1) - there.gradient_error, 0)
    return np.where(gap > 0, slope * free / (known.dimension * gap), -np.inf)
