"""`check_field` and `check_ray_samples`: tests of a field by sampling it at random points. A field
has a function f. It makes promises: proved bounds of f on a ball about each point, such as a
Lipschitz constant. It also gives enclosures: intervals that are proved to contain the change of f
along a ray, from which follows a free length, a length of the ray within which f meets no level. A
test fails with a `BrokenPromiseError`, which names the point where f is not as promised. To compare
values along a path, f is followed continuously: its jumps across facets, and by its period, are
taken out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import as_finite_vectors
from harnack.backend.validation import as_integer_in_range, as_real
from harnack.enclosures import (
    EnclosureChoice,
    HarmonicBall,
    LevelGaps,
    SlopeRange,
    TaylorRemainder,
    choose_enclosures,
    longest_free_length,
)
from harnack.enclosures.samples import Ray
from harnack.fields.analytic.riemann_surface import RiemannSurface
from harnack.fields.batched_fields import BatchedField
from harnack.fields.evaluator import Evaluator
from harnack.fields.field import Field, check_is_field, checked_evaluator
from harnack.testing.branch_contracts import check_branch_points
from harnack.testing.derivative_contracts import check_derivatives
from harnack.testing.jump_contracts import check_jumps
from harnack.testing.violation_search import (
    BrokenPromiseError,
    FieldSamples,
    distance_to_exit,
    lift_along_rays,
    random_directions,
    random_points,
    require,
    sample_field,
    search_violations,
)

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.enclosures import Promise

__all__ = ["check_field", "check_ray_samples", "proved_free_lengths"]

# Number of points at which the movement along a step is sampled.
_SAMPLES = 33


# Enclosures along paths.


def check_ray_samples(
    field: Field,
    points: FloatArray,
    *,
    rng: np.random.Generator | int = 0,
    enclosures: EnclosureChoice = None,
    precision: Precision = "double",
) -> None:
    """Test the enclosures that a field gives along rays from points (n, 3) in random directions. An
    enclosure proves, for levels at given differences (gaps) above and below f, a free length: a
    length of the ray within which f meets none of the levels. Free lengths in front of the points
    and behind them are tested.

    rng: a generator of random numbers, or a seed.
    enclosures: the kinds of enclosures to test; None for the default.
    precision: of the tested computation.

    Rays have lengths from a thousandth of the extent of the points to twice that extent. Gaps range
    from far less to far more than the change of f along the ray. Within the free length proved for
    a gap, f must not change by more than the gap plus `Sample.value_error` and the rounding of
    value and position.

    Raises:
        BrokenPromiseError: naming the point, and where f is too large or too small.
    """
    generator = np.random.default_rng(rng)
    n = len(points)
    directions = random_directions(generator, n)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    reach = size * 2.0 ** generator.uniform(-10, 1, n)
    # The change of f along each ray, which gives a scale for the gaps.
    coarse_lift = lift_along_rays(field, points, directions, reach[:, None] * np.linspace(0, 1, 9))
    scale = np.abs(coarse_lift.moved).max(axis=1) + 1e-6
    for forwards in (True, False):
        gaps = scale[:, None] * 10.0 ** generator.uniform(-3, 0.5, (n, 2))
        # 0: no level below; 1: no level above; 2: levels on both sides.
        no_level = generator.integers(0, 3, n)
        gaps[no_level < 2, no_level[no_level < 2]] = np.inf
        # A ray in direction -d that ends at the point has its last part at point + s d, s > 0. So
        # both free lengths are tested on the same points.
        steps = proved_free_lengths(
            field, points, directions if forwards else -directions, reach, gaps,
            enclosures=enclosures, precision=precision, forwards=forwards,
        )  # fmt: skip
        # Free lengths may be longer than the rays, even infinite: they are tested up to twice that.
        lengths = np.minimum(steps, 2 * reach)[:, None] * np.linspace(0, 1, _SAMPLES)
        path = lift_along_rays(field, points, directions, lengths)
        # The rounding error of the compared values, and of the points in this precision.
        epsilon = 2.0**-52 if precision == "double" else 2.0**-23
        position = epsilon * (np.abs(points).max(axis=1)[:, None] + lengths) * path.gradient_norm
        allowed = path.error + path.error[:, :1] + 8 * position + 1e-12 * scale[:, None]
        # By how much f leaves the two gaps.
        excess = np.maximum(path.moved - gaps[:, 1:], -path.moved - gaps[:, :1]) - allowed
        # For each ray the largest excess, and the point where it is.
        worst = excess.max(axis=1)
        worst_points = (
            points + np.take_along_axis(lengths, excess.argmax(axis=1)[:, None], 1) * directions
        )
        side = "ahead" if forwards else "back"
        require(worst <= 0, f"an enclosure looking {side} is left", points, worst, worst_points)


def proved_free_lengths(
    field: Field,
    points: FloatArray,
    directions: FloatArray,
    ahead: FloatArray,
    gaps: FloatArray,
    *,
    enclosures: EnclosureChoice = None,
    precision: Precision = "double",
    forwards: bool = True,
) -> FloatArray:
    """The free lengths (n,) that a field's enclosures prove along rays: lengths within which f
    meets no level.

    points, directions: (n, 3) the starts of the rays, and their unit directions.
    ahead: (n,) the length of the ray for which enclosures are requested.
    gaps: (n, 2) the differences between f at the start and the next level below and above.
    enclosures: the classes of enclosures that may be used; None for the default.
    precision: of the computation.
    forwards: True for the free length of the ray in front of its start. False for a ray that ends
        at the point: the free length of its part before the end.
    """
    backend = choose_backend(precision)
    ray = Ray(
        to_vector3(backend, points), to_vector3(backend, directions), choose_enclosures(enclosures)
    )
    length = backend.Float(np.ascontiguousarray(ahead))
    below, above = (backend.Float(np.ascontiguousarray(gaps[:, k])) for k in (0, 1))
    sample = field.evaluator(backend).sample_ray(ray, backend.Float(0), length, length)
    proofs = sample.forward if forwards else sample.backward
    # Adding 0 times an array makes one of a single number.
    steps = to_numpy(longest_free_length(proofs, LevelGaps(below, above)) + 0 * below)
    return np.broadcast_to(steps, len(points)).astype(np.float64)


# Promises.


def check_field(
    field: Field,
    points: FloatArray | None = None,
    *,
    rng: np.random.Generator | int = 0,
    count: int = 200,
    levels: Sequence[float] | None = None,
    directions: int = 12,
) -> None:
    """Test what a field promises by sampling it in double precision.

    points: (n, 3) the points of the test; points outside the field's domain are left out. By
        default `count` random points in its domain or, if it has none, around its default surface.
    rng: a generator of random numbers, or a seed.
    count: the number of random points.
    levels: the levels whose `extent` is tested; by default the default level.
    directions: the number of rays from each point on which each promise is tested.

    These checks are made:

    - Values and gradients are numbers, alike in both precisions within `Sample.value_error`. The
      gradient is that of the value. f is harmonic where a ball of dimension 2 or 3 promises it.
    - `differentiable_value` is the value and has this gradient. `hessian`, where there is one, is
      symmetric, the derivative of the gradient and, of a harmonic f, without trace.
    - The continuous change of f keeps each promise (`HarmonicBall`, `Lipschitz`, `TaylorRemainder`:
      a bound of f on a ball about the point) on rays to random points of the ball. A ray ends where
      it leaves the domain, if the promise need not hold outside.
    - The same holds for the worst pairs of points in these balls that a search finds
      (`search_violations`: about 14,000 pairs for each promise).
    - Enclosures along rays, of a field that computes its own, hold (`check_ray_samples`). A step of
      positive length is possible at most points.
    - No level set leaves its `extent`.
    - Near the branch points of a Riemann surface all branches are within the bounds that are stated
      there.

    - Of a field with `Jumps`: along rays, crossings of facets follow in order, whatever the start
      of the search, with unit normals on the side where f is larger. Between crossings the
      `continuation` has the values of f and keeps its own promises, and from one interval to the
      next it changes by the jump.

    Other checks take jumps across facets out along a ray. Values may in addition change between
    neighboring points by `Sample.value_error`, as they do where a tree approximates other clusters
    as wholes.

    The default takes one to three seconds for most fields, on two cores; for meshes about ten, for
    a `Morph` half a minute. It is a search and no proof: a promise that is wrong where nothing
    attains it is not found.

    Raises:
        BrokenPromiseError: naming the promise and the point where it is broken.
        ValueError: none of the points lies in the field's domain.
        TypeError: `evaluate` returns something else than a `Sample`; or a method of `Jumps`
            something else than it should; or `traits` and evaluator differ.
    """
    check_is_field(field)
    checked_evaluator(field, choose_backend("double"))
    generator = np.random.default_rng(rng)
    # Check and convert the arguments.
    count, directions = (
        as_integer_in_range(number, name, 1, 2**31 - 1)
        for number, name in ((count, "count"), (directions, "directions"))
    )
    points = None if points is None else as_finite_vectors(points, "points")
    if points is None:
        points = random_points(field, generator, count)
    elif field.domain is not None:
        is_inside = field.domain.contains_points(points)
        if not is_inside.any():
            raise ValueError(
                f"points: all {len(points)} lie outside the domain {field.domain} of the field, "
                "where it promises nothing; give points inside"
            )
        points = points[is_inside]
    level_list = levels if isinstance(levels, Sequence | np.ndarray) else (levels,)
    levels = [
        as_real(field.default_level if level is None else level, "levels") for level in level_list
    ]
    # The tests.
    samples = sample_field(field, points)
    _check_numbers(field, points, samples)
    # All tests below follow f across its jumps.
    check_jumps(field, points, generator)
    check_derivatives(field, points, samples)
    _check_rounding(field, points)
    _check_differentiable_value(field, points, samples)
    for number, promise in enumerate(samples.promises):
        _check_promise(field, points, samples, promise, generator, directions)
        search_violations(field, points, samples, number, generator)
    if isinstance(field, RiemannSurface):
        check_branch_points(field, float(np.ptp(points, axis=0).max()), generator)
    if _overrides_sample_ray(field):
        for precision in ("double", "single"):
            check_ray_samples(field, points, rng=generator, precision=precision)
    for level in levels:
        _check_extent(field, level, generator, count)
    _check_gradient_change(field, points, generator)


def _overrides_sample_ray(field: Field) -> bool:
    """Whether the field computes the enclosures of its change along a ray by a method of its own,
    and not from its promises (proved bounds near a point) as other fields do. Fields with jumps do
    not count."""
    kind = type(field.evaluator(choose_backend("double")))
    return kind.sample_ray is not Evaluator.sample_ray and not field.traits.has_jumps


def _check_numbers(field: Field, points: FloatArray, samples: FieldSamples) -> None:
    """Check that the values, gradients and promised bounds at points (n, 3) are valid numbers, and
    that at most points the bounds allow a ray to make a step of positive length.

    samples: the samples of the field at the points.

    Raises:
        BrokenPromiseError: a number is not valid, or no step is possible at most points.
    """
    if field.period is not None and not 0 < field.period < np.inf:
        raise BrokenPromiseError(f"period must be None or a positive number, not {field.period!r}")
    require(np.isfinite(samples.value), "the value is not a finite number", points)
    require(np.isfinite(samples.gradient).all(axis=1), "the gradient is not finite", points)
    # Without promises there must be enclosures of the field's own.
    if not samples.promises:
        if _overrides_sample_ray(field):
            return
        raise BrokenPromiseError("nothing is known: without a promise no step is possible")
    for promise in samples.promises:
        # (An entry of `units` begins with the name of a number.)
        numbers = [vars(promise)[name] for name, *_ in promise.units]
        name = type(promise).__name__
        require(~np.isnan(numbers).any(axis=0), f"{name} has a NaN", points)
        # The first pair of a promise is a range of f on the ball, so it contains the value.
        for lower, upper in promise.interval_pairs[:1]:
            is_inside = (vars(promise)[lower] <= samples.value) & (
                samples.value <= vars(promise)[upper]
            )
            require(is_inside, f"{name}: the value is not within [{lower}, {upper}]", points)
        for lower, upper in promise.interval_pairs:
            is_ordered = vars(promise)[lower] <= vars(promise)[upper]
            require(is_ordered, f"{name}: {lower} exceeds {upper}", points)
        if "constant" in vars(promise):
            require(vars(promise)["constant"] >= 0, f"{name}: the constant is negative", points)
        if isinstance(promise, TaylorRemainder) and np.isinf(promise.radius).all():
            varies = np.ptp(promise.constant) > 1e-6 * np.max(promise.constant)
            message = "a TaylorRemainder without a radius has the same constant at every point"
            require(np.full(len(points), not varies), message, points)
        if isinstance(promise, HarmonicBall):
            if promise.dimension not in (2, 3, 4):
                raise BrokenPromiseError(f"HarmonicBall has dimension {promise.dimension!r}")
            is_bounded = np.isfinite(promise.lower) | np.isfinite(promise.upper)
            require(is_bounded, "HarmonicBall: both ends are infinite", points)
    # A promise with the radius 0 proves nothing.
    is_usable = np.any([promise.radius > 0 for promise in samples.promises], axis=0)
    if is_usable.mean() < 0.5:
        raise BrokenPromiseError(
            "the radius of every promise is 0 at most points: no step is possible there"
        )


def _check_rounding(field: Field, points: FloatArray) -> None:
    """Check that the values at points (n, 3) in single precision differ from those in double
    precision by at most `Sample.value_error`, plus eight units in the last place, plus the change
    of the value by rounding the point. Points very near a singular point are left out. Raises a
    BrokenPromiseError if a value differs by more."""
    # Points that single precision represents exactly.
    single = points.astype(np.float32).astype(np.float64)
    if field.domain is not None:
        single = single[field.domain.contains_points(single)]
    if not len(single):
        return
    exact, rounded = sample_field(field, single), sample_field(field, single, "single")
    error = rounded.value - exact.value
    if field.period is not None:
        error -= field.period * np.round(error / field.period)
    # The allowed difference: stated errors, roundings of the value, and of coordinates times the
    # slope.
    roundoff = 2.0**-24
    length = np.linalg.norm(exact.gradient, axis=1)
    size = np.abs(single).max(axis=1)
    allowed = rounded.error + exact.error + 8 * roundoff * (np.abs(exact.value) + length * size)
    allowed += 8 * 2.0**-126  # numbers below the smallest normal one are lost
    # Near a singular point some promise holds only on a very small ball.
    radii = [promise.radius for promise in exact.promises] or [np.full(len(single), np.inf)]
    is_singular = np.min(radii, axis=0) < 1e-4 * np.ptp(points)
    is_right = (np.abs(error) <= allowed) | is_singular
    require(is_right, "Sample.error: in single precision the value is off by more", single, error)


def _check_differentiable_value(field: Field, points: FloatArray, samples: FieldSamples) -> None:
    """Check the method `differentiable_value` of the field's evaluator at points (n, 3): it has to
    return the value, as the field's own `evaluate` has to; and its derivative by the automatic
    differentiation of Dr.Jit, in reverse mode, has to be the gradient. Raises a BrokenPromiseError
    if not.

    samples: the samples of the field at the points.
    """
    backend = choose_backend("double")
    evaluator = field.evaluator(backend)
    x = to_vector3(backend, points, "points")
    direct = field.evaluate(x)
    dr.enable_grad(x)
    value = evaluator.differentiable_value(x)
    # Differentiate the sum over all points: the derivative by each point is its own gradient.
    dr.backward(dr.sum(value), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    dr.eval(value, x.grad)
    error = np.abs(to_numpy(value) - samples.value)
    if field.period is not None:
        error = np.abs(error - field.period * np.round(error / field.period))
    # Truncation errors of values at points, which samples may lack.
    value_error, gradient_error = 0.0, 0.0
    if isinstance(field, BatchedField):
        value_error = field.error_bound(points, precision="double")
        gradient_error = field.gradient_error_bound(points, precision="double")
    allowed = 1e-9 * (1 + np.abs(samples.value)) + 2 * samples.error + value_error
    is_right = error <= allowed
    require(is_right, "differentiable_value is not the value", points, error)
    error = np.abs(to_numpy(direct.value) - samples.value)
    if field.period is not None:
        error = np.abs(error - field.period * np.round(error / field.period))
    is_right = error <= allowed + to_numpy(0 * x.x + direct.value_error)
    message = "Field.evaluate is not the value of the evaluator that Field.evaluator returns"
    require(is_right, message, points, error)
    error = np.linalg.norm(to_numpy(x.grad) - samples.gradient, axis=1)
    size = np.linalg.norm(samples.gradient, axis=1)
    is_right = error <= 1e-6 * size + 2 * samples.gradient_error + gradient_error
    message = "differentiable_value does not have the gradient as its derivative, in reverse mode"
    require(is_right, message, points, error)


def _check_gradient_change(field: Field, points: FloatArray, rng: np.random.Generator) -> None:
    """Check `Evaluator.gradient_change_bound` at points (n, 3), for random radii and at random
    points of the balls: the gradient there may differ from that at the point by no more than the
    bound. Fields with jumps or patches do not count. Raises a BrokenPromiseError if it differs by
    more.
    """
    if field.traits.has_jumps or field.traits.has_patches:
        return
    backend = choose_backend("double")
    # Radii from 1e-4 of the size of the points to all of it.
    radius = np.ptp(points) * 10 ** rng.uniform(-4, 0, len(points))
    # Up to the domain's end, outside of which the bound need not hold.
    directions = random_directions(rng, len(points))
    length = rng.uniform(0, 1, len(points)) ** (1 / 3) * radius
    length = np.minimum(length, distance_to_exit(field, points, directions))
    evaluator = field.evaluator(backend)
    p, r = to_vector3(backend, points), backend.Float(radius)
    bound = to_numpy(evaluator.gradient_change_bound(p, r) + 0 * r)
    is_known = np.isfinite(bound)
    if not is_known.any():
        return
    there = points + length[:, None] * directions
    start, end = sample_field(field, points), sample_field(field, there)
    change = np.linalg.norm(end.gradient - start.gradient, axis=1)
    size = np.linalg.norm(start.gradient, axis=1) + np.linalg.norm(end.gradient, axis=1)
    allowed = bound + start.gradient_error + end.gradient_error + 1e-9 * size
    message = "gradient_change_bound: the gradient changes by more than the bound"
    require((change <= allowed) | ~is_known, message, points, change - bound, there)


def _check_promise(
    field: Field,
    points: FloatArray,
    samples: FieldSamples,
    promise: Promise,
    rng: np.random.Generator,
    directions: int,
) -> None:
    """Test one promise of a field: a bound of its function f on a ball about each of `points` (n,
    3). f is sampled on rays in random directions from each point, up to the radius of the ball, or
    up to twice the extent of the points if that is less.

    samples: the samples of the field at the points.
    promise: the promise, with one number for each point.
    rng: a generator of random numbers.
    directions: the number of rays from each point.

    A promise that also holds outside of the field's domain, such as that of a harmonic ball, is
    tested there as well; others only on the part of a ray in the domain.

    Raises:
        BrokenPromiseError: f breaks the bound.
    """
    name = type(promise).__name__
    radius = np.minimum(promise.radius, 2 * float(np.ptp(points, axis=0).max()) + 1e-300)
    # Denser towards the border, where singularities may lie.
    fractions = 1 - np.linspace(1, 0.03, 80) ** 2
    gradient_norm = np.linalg.norm(samples.gradient, axis=1, keepdims=True)
    steepest = samples.gradient / np.maximum(gradient_norm, 1e-300)
    steepest[gradient_norm[:, 0] == 0] = (1.0, 0.0, 0.0)
    for k in range(directions):
        # Singularities tend to lie along the gradient.
        choices = (steepest, -steepest, random_directions(rng, len(points)))
        d = choices[min(k, 2)]
        t = radius[:, None] * fractions
        if not promise.holds_outside_domain:
            t = np.minimum(radius, distance_to_exit(field, points, d))[:, None] * fractions
        lift = lift_along_rays(field, points, d, t)
        movement = lift.moved
        rounding = 1e-9 * (np.abs(samples.value)[:, None] + (field.period or 0) + np.abs(movement))
        rounding += samples.error[:, None] + lift.error  # of both ends, also of approximations
        slope = np.einsum("nk,nk->n", samples.gradient, d)
        slopes = SlopeRange(*((slope + sign * samples.gradient_error)[:, None] for sign in (-1, 1)))
        # (`map_numbers` also passes the exponents of each number's unit.)
        per_row = promise.map_numbers(lambda number, _, __: number[:, None])
        with np.errstate(invalid="ignore"):  # 0 * inf, at the point itself
            # The promised bounds of f(t) - f(0) at each sample.
            lower, upper = per_row.movement_bounds(samples.value[:, None], slopes, t)
            excess = np.maximum(movement - upper, lower - movement)
        if isinstance(promise, HarmonicBall):
            excess = np.fmax(excess, _harnack_excess(promise, samples.value, movement, fractions))
        excess = np.where(t > 0, excess, 0.0) - rounding
        worst = excess.argmax(axis=1)
        rows = np.arange(len(points))
        worst_points = points + t[rows, worst, None] * d
        message = f"{name}: f leaves what is promised here by more than rounding"
        require(excess.max(axis=1) <= 0, message, points, excess.max(axis=1), worst_points)


def _harnack_excess(
    ball: HarmonicBall, value: FloatArray, movement: FloatArray, fraction: FloatArray
) -> FloatArray:
    """An array (n, m): by how much the change of f along rays exceeds what Harnack's inequality,
    and the range of f, allow for a harmonic function on a ball. If it is positive, f is not
    harmonic on the ball or leaves the range.

    ball: the promises: n balls on which f is harmonic, with the ranges of f.
    value: (n,) f at the centers of the balls.
    movement: (n, m) f at m points of a ray from each center, minus its value at the center.
    fraction: (m,) the distances of these points from the center, as fractions of the radius.
    """
    n = ball.dimension
    # By Harnack's inequality a positive harmonic function grows at most by the factor 1 + growth,
    # and falls at most by the factor 1 - decay.
    growth = (1 + fraction) / (1 - fraction) ** (n - 1) - 1
    decay = 1 - (1 - fraction) / (1 + fraction) ** (n - 1)
    gap_below, gap_above = (value - ball.lower)[:, None], (ball.upper - value)[:, None]
    with np.errstate(invalid="ignore"):  # 0 * inf, where nothing is known
        # Apply both to f - lower and to upper - f, which are positive.
        rise = np.fmin(np.fmin(gap_below * growth, gap_above), gap_above * decay)
        fall = np.fmin(np.fmin(gap_above * growth, gap_below), gap_below * decay)
    # If the radius was reduced, the comparison is only weaker.
    return np.maximum(movement - rise * (1 + 1e-9), -movement - fall * (1 + 1e-9))


def _check_extent(field: Field, level: float, rng: np.random.Generator, count: int) -> None:
    """Check that the level set stays within its extent, the volume that is stated to contain it: f
    must not cross the level outside of the extent on `count` random segments (more for a field with
    a domain).

    rng: a generator of random numbers.

    Raises:
        BrokenPromiseError: f crosses the level outside of the extent.
    """
    volume = field.extent((level,))
    if volume is None:
        return
    lower, upper = volume.bounds()
    center, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    if not np.isfinite(half).all():
        return
    # Random segments in and around the box of the extent, up to the border of the domain.
    start = center + rng.uniform(-2.5, 2.5, (count, 3)) * half
    if field.domain is not None:
        start = np.concatenate([start, random_points(field, rng, count)])
        start = start[field.domain.contains_points(start)]
    d = random_directions(rng, len(start))
    length = np.minimum(3 * float(half.max()), distance_to_exit(field, start, d))
    t = np.linspace(0, 1, 160) * length[:, None]
    lift = lift_along_rays(field, start, d, t)
    # f - level along each segment, with its jumps.
    offsets = sample_field(field, start).value[:, None] + lift.moved + lift.jumped - level
    # To first order farther from the level than a thousandth of the extent, so f does not touch it.
    is_clear = (
        _distance_to_level(field, offsets)
        > 1e-3 * float(half.max()) * lift.gradient_norm + lift.error
    )
    # Between neighboring samples that are both clear of levels, f has passed a level.
    is_crossed = (
        _level_interval(field, offsets[:, 1:]) != _level_interval(field, offsets[:, :-1])
    ) & is_clear[:, 1:]
    row, column = np.nonzero(is_crossed & is_clear[:, :-1])
    if not row.size:
        return
    before, after, offset = t[row, column], t[row, column + 1], offsets[row, column]
    # Find each crossing more exactly: cut its interval into 32 parts, and keep the part with the
    # crossing.
    for _ in range(4):
        lengths = before[:, None] + (after - before)[:, None] * np.linspace(0, 1, 33)
        lift = lift_along_rays(field, start[row], d[row], lengths)
        values = offset[:, None] + lift.moved + lift.jumped
        first_beyond = (
            _level_interval(field, values) != _level_interval(field, values[:, :1])
        ).argmax(axis=1)
        ids = np.arange(len(row))
        before, after = lengths[ids, first_beyond - 1], lengths[ids, first_beyond]
        offset = values[ids, first_beyond - 1]
    crossings = start[row] + after[:, None] * d[row]
    is_inside = volume.contains_points(crossings)
    require(is_inside, f"extent: the surface of level {level:g} leaves {volume} here", crossings)


def _level_interval(field: Field, offset: FloatArray) -> FloatArray:
    """A number for the interval between neighboring levels in which f lies. It is the same for two
    values of f if no level separates them. If f has a period, all values that differ from a level
    by whole periods are levels, too.

    offset: f - level for one of the levels.
    """
    return np.sign(offset) if field.period is None else np.floor(offset / field.period)


def _distance_to_level(field: Field, offset: FloatArray) -> FloatArray:
    """The difference |f - level| from the nearest level. If f has a period, all values that differ
    from a level by whole periods are levels, too.

    offset: f - level for one of the levels.
    """
    nearest = 0.0 if field.period is None else field.period * np.round(offset / field.period)
    return np.abs(offset - nearest)
