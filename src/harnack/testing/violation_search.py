"""Search for points at which a field breaks a promise, and the tools of all tests of fields. A
field has a function f. Its promises are bounds of f, on a ball about each point, that it states as
proved. Here fields are sampled as NumPy arrays; f is followed continuously along rays (lifted),
without its jumps across facets and by its period; and pairs of points are searched at which f
exceeds a promised bound: a point p where the promise is made, and a point y of its ball where it is
tested."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import BoundedLaplacian, HarmonicBall, SlopeRange
from harnack.fields.capabilities import NO_FACET, JumpCrossing, exactly_sampled

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.enclosures import Promise
    from harnack.fields.field import Field, Sample

__all__ = [
    "BrokenPromiseError",
    "FieldSamples",
    "RayLift",
    "accumulated_jumps",
    "distance_to_exit",
    "lift_along_rays",
    "random_directions",
    "random_points",
    "require",
    "sample_field",
    "samples_as_arrays",
    "search_violations",
    "to_lanes",
]


class BrokenPromiseError(AssertionError):
    """Raised if a field or an enclosure promised something that is not true. The message says which
    promise, and where."""


def require(
    good: Any,
    message: str,
    points: FloatArray,
    amount: FloatArray | None = None,
    there: FloatArray | None = None,
) -> None:
    """Raise BrokenPromiseError if `good` (n,) is False at any of the points (n, 3). The message
    names the worst of these points.

    good: (n,) whether the test holds at each point.
    message: the beginning of the message.
    amount: (n,) the size of the violation; the point of the largest is the worst. None for the
        first point.
    there: (n, 3) the points where the violation shows, if not at the points themselves.
    """
    is_broken: BoolArray = ~np.asarray(good, dtype=np.bool_)
    ids = np.flatnonzero(is_broken)
    if not ids.size:
        return
    worst = ids[0] if amount is None else ids[np.abs(amount[ids]).argmax()]
    size = "" if amount is None else f" (by {amount[worst]:.3g})"
    at = "" if there is None else f", at {there[worst].tolist()}"
    raise BrokenPromiseError(
        f"{message}{size}: point {points[worst].tolist()}{at}; {ids.size} of {len(points)} points"
    )


# Fields from outside: values, gradients and continuous lifts.


@dataclass(frozen=True)
class FieldSamples:
    """Samples of a field at n points, as NumPy arrays: values (n,), gradients (n, 3), bounds of
    their errors (n,), and promises (bounds of f near each point) whose numbers are arrays (n,)."""

    value: FloatArray
    gradient: FloatArray
    error: FloatArray
    gradient_error: FloatArray
    promises: tuple[Promise, ...]

    def subset(self, rows: BoolArray) -> FieldSamples:
        """The samples at some of the points, given by a mask or by indices."""
        # `map_numbers` also passes the exponents of each number's unit, which are not used here.
        return FieldSamples(
            self.value[rows],
            self.gradient[rows],
            self.error[rows],
            self.gradient_error[rows],
            tuple(
                promise.map_numbers(lambda number, _, __: number[rows]) for promise in self.promises
            ),
        )


def sample_field(
    field: Field, points: FloatArray, precision: Precision = "double", *, closely: bool = False
) -> FieldSamples:
    """Sample the field at points (n, 3). All numbers of its promises become float64 arrays (n,).

    precision: of the evaluation.
    closely: whether to sample without truncation error.
    """
    return samples_as_arrays(_sample(field, points, precision, closely), len(points))


def samples_as_arrays(sample: Sample, n: int) -> FieldSamples:
    """A Dr.Jit sample at n points as NumPy arrays, with its promises of both kinds."""
    numbers = [list(vars(promise).values()) for promise in sample.all_promises]
    # In one kernel for all of them.
    dr.eval(sample.value, sample.gradient, sample.value_error, sample.gradient_error, numbers)

    # (`map_numbers` also passes the exponents of each number's unit.)
    promises = tuple(
        promise.map_numbers(lambda number, _, __: to_lanes(number, n))
        for promise in sample.all_promises
    )
    return FieldSamples(
        to_lanes(sample.value, n),
        np.broadcast_to(to_numpy(sample.gradient), (n, 3)).astype(np.float64),
        to_lanes(sample.value_error, n),
        to_lanes(sample.gradient_error, n),
        promises,
    )


@dataclass(frozen=True)
class RayLift:
    """The change of f along rays, followed continuously: at m points of each of n rays. All arrays
    are (n, m).

    moved: the change of f since the ray's first point, without jumps across facets and without
        jumps by the period of f.
    jumped: the sum of the jumps of f across facets since the first point.
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
    """Follow f continuously along rays: its change f(start + t direction) - f(start), without its
    jumps across facets and without jumps by its period.

    start, direction: (n, 3) the starts of the rays, and unit vectors.
    lengths: (n, m) the values of t for each ray, ascending from 0.

    If f is known modulo a period, whole periods are added at each point, so that the change since
    the point before is nearest to the one that the mean of the gradients at both points predicts.
    """
    n, m = lengths.shape
    points = start[:, None] + lengths[..., None] * direction[:, None]
    samples = sample_field(field, points.reshape(-1, 3))
    value, gradient = samples.value.reshape(n, m), samples.gradient.reshape(n, m, 3)
    slope = np.einsum("nmk,nk->nm", gradient, direction)
    changes = np.diff(value, axis=1)
    if field.period is not None:
        expected = 0.5 * (slope[:, 1:] + slope[:, :-1]) * np.diff(lengths, axis=1)
        expected = np.where(np.isfinite(expected), expected, 0)
        # Near a singular curve the gradient is unbounded, while the lift changes little.
        expected = np.clip(expected, -0.5 * field.period, 0.5 * field.period)
        changes -= field.period * np.round((changes - expected) / field.period)
    total = np.concatenate([np.zeros((n, 1)), np.cumsum(changes, axis=1)], axis=1)
    jumped = accumulated_jumps(field, start, direction, lengths)
    return RayLift(
        total - jumped, jumped, np.linalg.norm(gradient, axis=2), samples.error.reshape(n, m)
    )


def accumulated_jumps(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> FloatArray:
    """(n, m) the sums of the jumps of f across facets between the first point and each other point
    of a ray. The points are start + t direction for each t of `lengths` (n, m). The field's method
    `Jumps.next_crossing` reports the jumps one after the other."""
    total = np.zeros_like(lengths)
    if not field.traits.has_jumps:
        return total
    backend = choose_backend("double")
    jumps = field.evaluator(backend).jumps
    assert jumps is not None
    o, d = to_vector3(backend, start), to_vector3(backend, direction)
    # The crossing before the first one is at the start of the ray, on no facet: with the jump 0 and
    # any vector as normal.
    first, last = (backend.Float(np.ascontiguousarray(lengths[:, k])) for k in (0, -1))
    crossing = JumpCrossing(first, backend.UInt32(NO_FACET), backend.Float(0), d)
    while True:
        crossing = jumps.next_crossing(o, d, crossing, last, backend.Bool(True))
        t, jump = (to_lanes(values, len(start)) for values in (crossing.t, crossing.jump))
        # Rays without another crossing have t = inf.
        is_ahead = np.isfinite(t)
        if not is_ahead.any():
            return total
        is_passed = is_ahead[:, None] & (lengths >= t[:, None])
        total += np.where(is_passed, np.where(is_ahead, jump, 0)[:, None], 0)


def random_points(field: Field, rng: np.random.Generator, n: int) -> FloatArray:
    """n random points (n, 3) of the field's domain. If the field has no domain, points in the box
    of the extent of its default surface; if that is not known either, points around the origin.
    Where a box is unbounded, it is cut at -3 and 3. rng: a generator of random numbers."""
    volume = field.domain if field.domain is not None else field.extent((field.default_level,))
    if volume is None:
        return 3 * random_directions(rng, n) * rng.random((n, 1))
    lower, upper = volume.bounds()
    lower, upper = np.where(np.isfinite(lower), lower, -3), np.where(np.isfinite(upper), upper, 3)
    # Draw points in the box until enough of them lie in the domain.
    accepted = np.zeros((0, 3))
    while len(accepted) < n:
        points = rng.uniform(lower, upper, (4 * n, 3))
        if field.domain is not None:
            points = points[field.domain.contains_points(points)]
        accepted = np.concatenate([accepted, points])
    return accepted[:n]


def distance_to_exit(field: Field, points: FloatArray, d: FloatArray) -> FloatArray:
    """For rays from points (n, 3) in the unit directions d (n, 3), the lengths (n,) at which they
    leave the field's domain, which is convex; infinite if the field has no domain."""
    if field.domain is None:
        return np.full(len(points), np.inf)
    backend = choose_backend("double")
    o, direction = to_vector3(backend, points, "points"), to_vector3(backend, d, "d")
    ends = field.domain.upload(backend).clip(o, direction, backend.Float(0), backend.Float(np.inf))
    # `clip` returns where each ray is in the domain: the first and the last position.
    end = np.broadcast_to(to_numpy(ends[1]), (len(points),))
    # A little less, for rounding.
    return np.maximum(end * (1 - 1e-9) - 1e-12 * np.abs(points).max(axis=1), 0)


def random_directions(rng: np.random.Generator, n: int) -> FloatArray:
    """n random unit vectors (n, 3), uniform on the sphere. rng: a generator of random numbers."""
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sample(field: Field, points: FloatArray, precision: Precision, closely: bool) -> Sample:
    """The field's Dr.Jit sample at NumPy points (n, 3).

    closely: whether to sample without truncation error.
    """
    backend = choose_backend(precision)
    evaluator = field.evaluator(backend)
    evaluator = exactly_sampled(evaluator, backend) if closely else evaluator
    return evaluator.evaluate(to_vector3(backend, points, "points"))


def to_lanes(value: object, n: int) -> FloatArray:
    """A Dr.Jit array or a number as a float64 array (n,). A single number is repeated."""
    array = to_numpy(value) if dr.is_array_v(value) else np.asarray(value)
    return np.broadcast_to(array, (n,)).astype(np.float64)


# The search for the worst points.

# The number of pairs of points that are improved: at most, and as a fraction of the points.
_MAX_PAIRS, _PAIRS_OF_POINTS = 48, 0.25
# The number of moves that each pair tries in an iteration, and the number of iterations. The
# numbers of pairs, moves and iterations are divided by the last number if the change of f between
# two points must be followed along a path, as each sample of the path takes an evaluation.
_MOVES, _ROUNDS, _PATH_COST_DIVISOR = 8, 36, 2
# Points stay within this fraction of the radius, off the border of the ball.
_MAX_RADIUS_FRACTION = 1 - 1e-6
# Lengths of moves, in radii of the balls: the first, the smallest, and the factors after success
# and failure.
_FIRST_STEP, _MIN_STEP, _STEP_GROWTH, _STEP_SHRINKAGE = 0.25, 1e-9, 1.6, 0.6
# Balls whose radius is below this fraction of the coordinates are left out, as rounding moves
# points in them.
_MIN_RELATIVE_RADIUS = 1e-6
# The number of samples on a path between two points, if f must be followed along it: in the search,
# and for the final test.
_PATH_SAMPLES, _FINAL_PATH_SAMPLES = 24, 600
# How far a ratio may exceed 1 by rounding; and the relative rounding error of values.
_RATIO_TOLERANCE, _ROUNDING = 1e-6, 1e-9
# The spacing of differences of gradients, as a fraction of the distance to the border.
_DIFFERENCE_SPACING = 1e-3


@dataclass(frozen=True)
class _Candidates:
    """Pairs of points (p, y) at which a promise is tested: p is the point where the promise is
    made, a bound of f on a ball about p; y = p + reach * w is a point of the ball, with the ball's
    radius `reach` and |w| < 1. The violation ratio of a pair is the change of f from p to y
    relative to its bound; above 1 the promise is violated.

    p: (n, 3) the first points.
    w: (n, 3) the second points are y = p + reach * w, with |w| < 1.
    reach: (n,) the radii of the balls.
    violation_ratio: (n,) the violation ratios.
    """

    p: FloatArray
    w: FloatArray
    reach: FloatArray
    violation_ratio: FloatArray

    def best_of(self, alternatives: _Candidates) -> tuple[_Candidates, BoolArray]:
        """Choose between each of these n pairs and its m alternatives: the pair with the largest
        violation ratio is best.

        alternatives: n * m pairs, the m alternatives of the first pair first.

        Returns the n best pairs, and a mask (n,): whether the best pair is an alternative.
        """
        n = len(self.p)
        m = len(alternatives.p) // n
        # The index of the best alternative of each pair.
        best = np.arange(n) * m + alternatives.violation_ratio.reshape(n, m).argmax(axis=1)
        is_better = alternatives.violation_ratio[best] > self.violation_ratio
        mask = is_better[:, None]
        return _Candidates(
            np.where(mask, alternatives.p[best], self.p),
            np.where(mask, alternatives.w[best], self.w),
            np.where(is_better, alternatives.reach[best], self.reach),
            np.where(is_better, alternatives.violation_ratio[best], self.violation_ratio),
        ), is_better


def search_violations(
    field: Field, points: FloatArray, look: FieldSamples, number: int, rng: np.random.Generator
) -> None:
    """Search for points that violate a promise of a field, the one with index `number` in
    `Sample.all_promises`.

    points: (n, 3) the points from which the search starts.
    look: the samples of the field at the points.
    rng: a generator of random numbers.

    A promise that is wrong by a few percent is violated only at special points: beside a
    singularity that lies just inside of the ball, or in the one direction in which a range is
    attained. Random points miss these. So this is a random local search over pairs: a point p,
    where the promise is made, and a point y in its ball, where it is tested. Both are moved at
    random, and a move is kept if it raises the violation ratio (the change of f relative to its
    bound). The step length grows after success and shrinks after failure.

    The search starts from the points with the smallest radius and from random points, with y
    towards the border of the ball: along the gradient, against it, and in random directions.

    Raises:
        BrokenPromiseError: naming both points of the worst pair.
    """
    search = _ViolationSearch(field, number, 2 * float(np.ptp(points, axis=0).max()) + 1e-300)
    divisor = _PATH_COST_DIVISOR if search.needs_path else 1
    # The number of pairs. If f must be followed along paths, there are fewer pairs and moves.
    count = min(max(int(_PAIRS_OF_POINTS * len(points)), 6), _MAX_PAIRS) // divisor
    moves_each = _MOVES // divisor
    # The start of the search: p, and y in one of three directions.
    order = np.argsort(np.broadcast_to(look.promises[number].radius, len(points)), kind="stable")
    rows = np.concatenate([order[: count // 3], rng.choice(len(points), count)])[:count]
    steepest = look.gradient[rows]
    length = np.linalg.norm(steepest, axis=1, keepdims=True)
    steepest = np.where(length > 0, steepest / np.maximum(length, 1e-300), [1.0, 0.0, 0.0])
    start_kind = np.arange(count)[:, None] % 3
    axial = np.where(start_kind == 1, -1, 1) * steepest
    directions = np.where(start_kind == 2, random_directions(rng, count), axial)
    best = search.pairs(points[rows], directions * rng.uniform(0.3, 1, (count, 1)))
    steps = np.full(count, _FIRST_STEP)
    for _ in range(_ROUNDS // divisor):
        # Each pair tries `moves_each` moves.
        step = np.repeat(steps, moves_each)[:, None]
        p, w = (np.repeat(array, moves_each, axis=0) for array in (best.p, best.w))
        reach = np.repeat(best.reach, moves_each)[:, None]
        # Half of the moves keep p (kinds 0 and 1), a quarter keep y (kind 3).
        kind = np.arange(len(p))[:, None] % 4
        moves_point = kind >= 2
        change = rng.normal(size=p.shape) * step * 10 ** rng.uniform(-1, 0, (len(p), 1))
        point_shift = np.where(moves_point, rng.normal(size=p.shape) * step, 0)
        new_w = w - np.where(kind == 3, point_shift, 0) + np.where(kind == 3, 0, change)
        # A promise of slopes or second derivatives is broken most between neighbors: an offset that
        # is turned and made shorter or longer, by a fraction of its length.
        length = np.linalg.norm(w, axis=1, keepdims=True)
        rotated = (w + length * change) * 10 ** rng.uniform(-1, 0.5, (len(p), 1))
        new_w = np.where(np.arange(len(p))[:, None] % 8 == 1, rotated, new_w)
        new_w = np.where(np.arange(len(p))[:, None] % 8 == 2, w + length * change, new_w)
        # Keep the best move of each pair if it is better than the pair itself.
        best, is_better = best.best_of(search.pairs(p + reach * point_shift, new_w))
        steps = np.where(is_better, np.minimum(_STEP_GROWTH * steps, 1), _STEP_SHRINKAGE * steps)
        # A search whose steps have become tiny begins anew with large ones.
        steps = np.where(steps < _MIN_STEP, _FIRST_STEP, steps)
    is_violated = best.violation_ratio > 1 + _RATIO_TOLERANCE
    if is_violated.any():
        # Test the pairs again with more samples on each path, as too few may mislead.
        best = search.pairs(best.p[is_violated], best.w[is_violated], samples=_FINAL_PATH_SAMPLES)
        y = best.p + best.reach[:, None] * best.w
        holds = ~(best.violation_ratio > 1 + _RATIO_TOLERANCE)
        name = type(look.promises[number]).__name__
        message = f"{name}: f leaves what is promised here, by this factor"
        require(holds, message, best.p, best.violation_ratio, y)


@dataclass(frozen=True)
class _ViolationSearch:
    """The search for pairs of points (p, y) that violate a promise: a bound of f that the field
    states, at each point p, for a ball about p; y is a point of the ball. The violation ratio of a
    pair is the change of f from p to y relative to its bound. The length `longest` takes the place
    of an infinite radius.

    field: the field.
    promise_index: the index of the promise in `Sample.all_promises`.
    longest: the length that takes the place of an infinite radius.
    """

    field: Field
    promise_index: int
    longest: float

    @property
    def needs_path(self) -> bool:
        """Whether the change of f between two points has to be followed along a path between them,
        because f jumps or is known modulo a period only. Otherwise it is the difference of the
        values."""
        return self.field.period is not None or self.field.traits.has_jumps

    def pairs(self, p: FloatArray, w: FloatArray, samples: int = _PATH_SAMPLES) -> _Candidates:
        """Evaluate pairs of points: make the pairs of p (n, 3) and y = p + reach * w, where reach
        is the radius of the promise at p, with their violation ratios. The ratio is -inf for a pair
        that cannot be tested: outside of the domain, or with a radius so small that rounding moves
        the points.

        w: (n, 3). Vectors of length 1 or more are shortened, so that y lies in the ball.
        samples: the number of samples on each path from p to y.
        """
        length = np.linalg.norm(w, axis=1, keepdims=True)
        w = w * np.minimum(1, _MAX_RADIUS_FRACTION / np.maximum(length, 1e-300))
        ratios, radii = np.full(len(p), -np.inf), np.full(len(p), 1.0)
        # The pairs whose first point is in the domain; below, those that can be tested.
        rows = np.flatnonzero(self._is_in_domain(p))
        if len(rows):
            at_p = sample_field(self.field, p[rows])
            promise = at_p.promises[self.promise_index]
            radii[rows] = np.minimum(promise.radius, self.longest)
            y = p + radii[:, None] * w
            is_usable = radii[rows] > _MIN_RELATIVE_RADIUS * np.abs(p[rows]).max(axis=1)
            if not promise.holds_outside_domain:
                is_usable &= self._is_in_domain(y[rows])
            rows, at_p = rows[is_usable], at_p.subset(is_usable)
            if len(rows):
                ratios[rows] = self._ratio(at_p, p[rows], w[rows], radii[rows], samples)
        return _Candidates(p, w, radii, np.where(np.isnan(ratios), -np.inf, ratios))

    def _is_in_domain(self, p: FloatArray) -> BoolArray:
        """A mask (n,): whether the points p (n, 3) are finite and in the field's domain."""
        is_inside = np.asarray(np.isfinite(p).all(axis=1))
        if self.field.domain is not None:
            is_inside &= self.field.domain.contains_points(np.nan_to_num(p))
        return is_inside

    def _ratio(
        self, at_p: FieldSamples, p: FloatArray, w: FloatArray, reach: FloatArray, samples: int
    ) -> FloatArray:
        """The violation ratios (n,) of pairs of points p (n, 3) and y = p + reach * w. A ratio is
        the change of f from p to y, minus the error of this change, divided by the bound that the
        promise made at p gives for it. Above 1 the promise is violated.

        at_p: the samples at p.
        w: (n, 3), |w| < 1.
        reach: (n,) the radius of the promise.
        samples: the number of samples on a path from p to y, if f must be followed along it.

        For promises that are about harmonic functions or Laplacians, the ratio is also computed
        from the gradients near y, and the larger one is taken.
        """
        promise, y = at_p.promises[self.promise_index], p + reach[:, None] * w
        at_y = sample_field(self.field, y)
        moved = at_y.value - at_p.value
        if self.needs_path:
            moved = self._lift(p, y, samples)
        error = at_p.error + at_y.error
        error = error + _ROUNDING * (np.abs(at_p.value) + (self.field.period or 0) + np.abs(moved))
        distance = reach * np.linalg.norm(w, axis=1)
        with np.errstate(all="ignore"):
            slope = np.einsum("nk,nk->n", at_p.gradient, y - p) / distance
            # The promised bounds of the change.
            lower, upper = promise.movement_bounds(at_p.value, SlopeRange(slope, slope), distance)
            # A Lipschitz constant or Taylor remainder bounds the difference to the middle of both
            # bounds, which for the latter is the linear part of f.
            if not promise.holds_outside_domain:
                middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
                # For a Lipschitz constant the middle is 0, and the gradient does not enter.
                error = error + at_p.gradient_error * distance * (middle != 0)
                return (np.abs(moved - middle) - error) / half
            max_fall, max_rise = error - lower, error + upper
            ratio, margin = np.maximum(moved / max_rise, -moved / max_fall), reach - distance
            if isinstance(promise, HarmonicBall):
                # How far f at y is from the nearer end of its range.
                gap = np.minimum(max_fall + moved, max_rise - moved)
                ratio = np.fmax(ratio, _slope_ratio(promise, at_y, margin, gap))
            if isinstance(promise, BoundedLaplacian):
                spacing = _DIFFERENCE_SPACING * margin
                ratio = np.fmax(ratio, self._laplacian_ratio(promise, y, at_y, spacing))
            return ratio

    def _lift(self, p: FloatArray, y: FloatArray, samples: int) -> FloatArray:
        """The change (n,) of f along the segments from points p to points y (n, 3), without jumps
        at facets and without jumps by the period of f. f is followed through `samples` samples on
        each segment. They are denser towards y, which is often near the border of the promise's
        ball, because singularities may lie there."""
        offset = y - p
        length = np.linalg.norm(offset, axis=1)
        d = offset / np.maximum(length, 1e-300)[:, None]
        # Denser toward y.
        fractions = 1 - np.linspace(1, 0, samples) ** 2
        return lift_along_rays(self.field, p, d, length[:, None] * fractions).moved[:, -1]

    def _laplacian_ratio(
        self, bound: BoundedLaplacian, y: FloatArray, at_y: FieldSamples, h: FloatArray
    ) -> FloatArray:
        """The violation ratios (n,) of a promised bound of the Laplacian, at points y (n, 3). A
        ratio is 1 plus the amount by which the Laplacian is outside of its bounds, divided by the
        size of the bounds.

        bound: the promise.
        at_y: the samples at y.
        h: (n,) the spacing of central differences of the gradient, from which the Laplacian is
            computed; their error is estimated from the spacing 2h.
        """
        fine, wide = np.zeros(len(y)), np.zeros(len(y))
        rounding = 4 * at_y.gradient_error / h
        for axis in range(3):
            # Nodes at 1 and 2 spacings. The weights of the difference with the spacing h, and of
            # the one with 2h, which is divided by 2h once more.
            for node, weight, wide_weight in ((1, 1.0, 0.0), (2, 0.0, 0.5)):
                offset = (node * h)[:, None] * np.eye(3)[axis]
                rate = (
                    sample_field(self.field, y + offset).gradient
                    - sample_field(self.field, y - offset).gradient
                )
                fine += weight * rate[:, axis] / (2 * h)
                wide += wide_weight * rate[:, axis] / (2 * h)
        slope = np.linalg.norm(at_y.gradient, axis=1)
        # The rounding of gradients and coordinates, and the estimated error of the differences.
        rounding += 1e-11 * slope * (1 + np.abs(y).max(axis=1) / h) / h + np.abs(fine - wide)
        excess = np.maximum(bound.laplacian_lower - fine, fine - bound.laplacian_upper) - rounding
        scale = np.abs(bound.laplacian_lower) + np.abs(bound.laplacian_upper) + 1e-300
        return 1 + excess / scale


def _slope_ratio(
    promise: HarmonicBall, at_y: FieldSamples, margin: FloatArray, gap: FloatArray
) -> FloatArray:
    """The violation ratios (k,) of the promise that f is harmonic on a ball and stays within a
    range there, from gradients. A ratio is |grad f(y)| divided by the largest value that it can
    have if the promise is right.

    promise: the promise, a ball with a range of f.
    at_y: the samples at points y of the balls.
    margin: (k,) the distances of the points y from the border of their ball.
    gap: (k,) the differences between f(y) and the nearer end of the range.

    Proof. f - lower is positive and harmonic on the ball of radius `margin` about y. So by
    Harnack's inequality in n dimensions |grad f(y)| <= n (f(y) - lower)/margin; likewise for
    upper - f. The search finds singularities in the ball because the left side of the inequality
    grows faster towards them than the right side.
    """
    slope = np.maximum(np.linalg.norm(at_y.gradient, axis=1) - at_y.gradient_error, 0)
    return np.where(gap > 0, slope * margin / (promise.dimension * gap), -np.inf)
