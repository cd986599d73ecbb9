"""`check_field` and `check_ray_samples`: tests, by sampling, of the promises of a field and of its
enclosures along paths."""

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
from harnack.fields.analytic.riemann_surface import RiemannSurface
from harnack.fields.batched_fields import BatchedField
from harnack.fields.field import Field, check_is_field
from harnack.fields.samples import Ray
from harnack.testing.branch_contracts import check_branch_points
from harnack.testing.derivative_contracts import check_derivatives
from harnack.testing.violation_search import (
    BrokenPromiseError,
    FieldSamples,
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

# Places at which the movement along a step is sampled.
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
    """Test the enclosures that a field gives along random directions from points (n, 3).

    Lengths range from a thousandth of the extent of the points to twice that extent, and gaps from
    far below to far above the movement of f on the way. Within the free length proved for a gap, f
    must not pass the gap by more than `Sample.value_error` and the rounding of value and position.

    Raises:
        BrokenPromiseError: naming the point, and where f is too large or too small.
    """
    generator = np.random.default_rng(rng)
    n = len(points)
    directions = random_directions(generator, n)
    size = float(np.ptp(points, axis=0).max()) or 1.0
    ahead = size * 2.0 ** generator.uniform(-10, 1, n)
    rough = lift_along_rays(field, points, directions, ahead[:, None] * np.linspace(0, 1, 9))
    scale = np.abs(rough.moved).max(axis=1) + 1e-6
    for forwards in (True, False):
        gaps = scale[:, None] * 10.0 ** generator.uniform(-3, 0.5, (n, 2))
        without = generator.integers(0, 3, n)  # a level below, above, or on both sides
        gaps[without < 2, without[without < 2]] = np.inf
        steps = proved_free_lengths(
            field, points, directions if forwards else -directions, ahead, gaps,
            enclosures=enclosures, precision=precision, forwards=forwards,
        )  # fmt: skip
        lengths = np.minimum(steps, 2 * ahead)[:, None] * np.linspace(0, 1, _SAMPLES)
        path = lift_along_rays(field, points, directions, lengths)
        # What rounding leaves of the values compared, and of the points in this precision.
        unit = 2.0**-52 if precision == "double" else 2.0**-23
        position = unit * (np.abs(points).max(axis=1)[:, None] + lengths) * path.gradient_norm
        allowed = path.error + path.error[:, :1] + 8 * position + 1e-12 * scale[:, None]
        over = np.maximum(path.moved - gaps[:, 1:], -path.moved - gaps[:, :1]) - allowed
        worst = over.max(axis=1)
        where = points + np.take_along_axis(lengths, over.argmax(axis=1)[:, None], 1) * directions
        side = "ahead" if forwards else "back"
        require(worst <= 0, f"an enclosure looking {side} is left", points, worst, where)


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
    """The free lengths (n,) that a field's enclosures prove from points (n, 3) along unit
    directions.

    ahead: (n,) the reach that is asked of the enclosures.
    gaps: (n, 2) the differences in value to the levels below and above.
    forwards: False for the enclosures that look back from points on paths along `directions`.
    """
    backend = choose_backend(precision)
    path = Ray(
        to_vector3(backend, points), to_vector3(backend, directions), choose_enclosures(enclosures)
    )
    length = backend.Float(np.ascontiguousarray(ahead))
    down, up = (backend.Float(np.ascontiguousarray(gaps[:, k])) for k in (0, 1))
    look = field.prepare(backend).sample_ray(path, backend.Float(0), length, length)
    proofs = look.forward if forwards else look.backward
    steps = to_numpy(longest_free_length(proofs, LevelGaps(down, up)) + 0 * down)
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

    points: (n, 3) where to look, those outside the field's domain left out; by default `count`
        random ones in its domain or, if it has none, around its default surface.
    levels: whose `extent` to test; by default the default level.
    directions: how many ways to walk from each point within each promise.

    Checked: values and gradients are numbers, alike in both precisions within `Sample.value_error`;
    the gradient is that of the value; f is harmonic where a ball of dimension 2 or 3 says so;
    `differentiable_value` is the value and has this gradient; `hessian`, where there is one, is
    symmetric, the derivative of the gradient and, of a harmonic f, without trace; the lift of f
    keeps each promise (`HarmonicBall`, `Lipschitz`, `TaylorRemainder`) on the way to random points
    of its ball, or for the last two to where that leaves the domain, and where a search for the
    worst points and places in these balls ends (`search_violations`: some 14,000 places for each
    promise); enclosures along paths, of a field that gives its own (`check_ray_samples`), hold;
    some step is possible at most points; no level set leaves its `extent`. Jumps across sheets
    are taken out on the way, and values may move between neighboring points by `Sample.value_error`
    besides, as they do where a tree takes other clusters as wholes. Near the branch points of a
    Riemann surface all branches are within what these say.

    The default takes one to three seconds for most fields, on two cores; for meshes about ten, for
    a `Morph` half a minute. It is a search and no proof: a promise that is wrong where nothing
    attains it is not found.

    Raises:
        BrokenPromiseError: naming the promise and the point where it is broken.
        ValueError: none of the points given lies in the field's domain.
        TypeError: `evaluate` returns something else than a `Sample`.
    """
    check_is_field(field)
    generator = np.random.default_rng(rng)
    count, directions = (
        as_integer_in_range(number, name, 1, 2**31 - 1)
        for number, name in ((count, "count"), (directions, "directions"))
    )
    points = None if points is None else as_finite_vectors(points, "points")
    if points is None:
        points = random_points(field, generator, count)
    elif field.domain is not None:
        inside = field.domain.contains_points(points)
        if not inside.any():
            raise ValueError(
                f"points: all {len(points)} lie outside the domain {field.domain} of the field, "
                "where it promises nothing; give points inside"
            )
        points = points[inside]
    several = levels if isinstance(levels, Sequence | np.ndarray) else (levels,)
    levels = [
        as_real(field.default_level if level is None else level, "levels") for level in several
    ]
    look = sample_field(field, points)
    _check_numbers(field, points, look)
    check_derivatives(field, points, look)
    _check_rounding(field, points)
    _check_differentiable_value(field, points, look)
    for number, known in enumerate(look.promises):
        _check_promise(field, points, look, known, generator, directions)
        search_violations(field, points, look, number, generator)
    if isinstance(field, RiemannSurface):
        check_branch_points(field, float(np.ptp(points, axis=0).max()), generator)
    if _overrides_sample_ray(field):
        for precision in ("double", "single"):
            check_ray_samples(field, points, rng=generator, precision=precision)
    for level in levels:
        _check_extent(field, level, generator, count)


def _overrides_sample_ray(field: Field) -> bool:
    """Whether the field has enclosures along a path besides those that follow from its promises."""
    return type(field).sample_ray is not Field.sample_ray and not field.has_jumps


def _check_numbers(field: Field, points: FloatArray, look: FieldSamples) -> None:
    if field.period is not None and not 0 < field.period < np.inf:
        raise BrokenPromiseError(f"period must be None or a positive number, not {field.period!r}")
    require(np.isfinite(look.value), "the value is not a finite number", points)
    require(np.isfinite(look.gradient).all(axis=1), "the gradient is not finite", points)
    if not look.promises:
        if _overrides_sample_ray(field):
            return
        raise BrokenPromiseError("nothing is known: without a promise no step is possible")
    for known in look.promises:
        numbers = [vars(known)[name] for name, *_ in known.units]
        name = type(known).__name__
        require(~np.isnan(numbers).any(axis=0), f"{name} has a NaN", points)
        for low, high in known.interval_pairs[:1]:
            inside = (vars(known)[low] <= look.value) & (look.value <= vars(known)[high])
            require(inside, f"{name}: the value is not within [{low}, {high}]", points)
        for low, high in known.interval_pairs:
            ordered = vars(known)[low] <= vars(known)[high]
            require(ordered, f"{name}: {low} exceeds {high}", points)
        if "constant" in vars(known):
            require(vars(known)["constant"] >= 0, f"{name}: the constant is negative", points)
        if isinstance(known, TaylorRemainder) and np.isinf(known.radius).all():
            varies = np.ptp(known.constant) > 1e-6 * np.max(known.constant)
            message = "a TaylorRemainder without a radius has the same constant at every point"
            require(np.full(len(points), not varies), message, points)
        if isinstance(known, HarmonicBall):
            if known.dimension not in (2, 3, 4):
                raise BrokenPromiseError(f"HarmonicBall has dimension {known.dimension!r}")
            bounded = np.isfinite(known.lower) | np.isfinite(known.upper)
            require(bounded, "HarmonicBall: both ends are infinite", points)
    usable = np.any([known.radius > 0 for known in look.promises], axis=0)
    if usable.mean() < 0.5:
        raise BrokenPromiseError(
            "the radius of every promise is 0 at most points: no step is possible there"
        )


def _check_rounding(field: Field, points: FloatArray) -> None:
    """Check that in single precision the value is off by at most `error`, eight units in its last
    place, and the effect of rounding the point."""
    single = points.astype(np.float32).astype(np.float64)
    if field.domain is not None:
        single = single[field.domain.contains_points(single)]
    if not len(single):
        return
    exact, rounded = sample_field(field, single), sample_field(field, single, "single")
    off = rounded.value - exact.value
    if field.period is not None:
        off -= field.period * np.round(off / field.period)
    unit = 2.0**-24
    length = np.linalg.norm(exact.gradient, axis=1)
    size = np.abs(single).max(axis=1)
    allowed = rounded.error + exact.error + 8 * unit * (np.abs(exact.value) + length * size)
    allowed += 8 * 2.0**-126  # numbers below the smallest normal one are lost
    radii = [one.radius for one in exact.promises] or [np.full(len(single), np.inf)]
    singular = np.min(radii, axis=0) < 1e-4 * np.ptp(points)
    good = (np.abs(off) <= allowed) | singular
    require(good, "Sample.error: in single precision the value is off by more", single, off)


def _check_differentiable_value(field: Field, points: FloatArray, look: FieldSamples) -> None:
    backend = choose_backend("double")
    prepared = field.prepare(backend)
    x = to_vector3(backend, points, "points")
    dr.enable_grad(x)
    value = prepared.differentiable_value(x)
    dr.backward(dr.sum(value), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    dr.eval(value, x.grad)
    off = np.abs(to_numpy(value) - look.value)
    if field.period is not None:
        off = np.abs(off - field.period * np.round(off / field.period))
    own, own_slope = 0.0, 0.0  # what values at points leave out, which samples may not
    if isinstance(field, BatchedField):
        own = field.error_bound(points, precision="double")
        own_slope = field.gradient_error_bound(points, precision="double")
    good = off <= 1e-9 * (1 + np.abs(look.value)) + 2 * look.error + own
    require(good, "differentiable_value is not the value", points, off)
    off = np.linalg.norm(to_numpy(x.grad) - look.gradient, axis=1)
    size = np.linalg.norm(look.gradient, axis=1)
    good = off <= 1e-6 * size + 2 * look.gradient_error + own_slope
    message = "differentiable_value does not have the gradient as its derivative, in reverse mode"
    require(good, message, points, off)


def _check_promise(
    field: Field,
    points: FloatArray,
    look: FieldSamples,
    known: Promise,
    rng: np.random.Generator,
    directions: int,
) -> None:
    """Test a promise along random directions from each point, to the border of the promise or
    across the extent of the points.

    Promises of all space, such as harmonic balls, are tested outside of the field's domain as well.
    """
    name = type(known).__name__
    reach = np.minimum(known.radius, 2 * float(np.ptp(points, axis=0).max()) + 1e-300)
    # Denser towards the border, where singularities may lie.
    share = 1 - np.linspace(1, 0.03, 80) ** 2
    gradient_norm = np.linalg.norm(look.gradient, axis=1, keepdims=True)
    steepest = look.gradient / np.maximum(gradient_norm, 1e-300)
    steepest[gradient_norm[:, 0] == 0] = (1.0, 0.0, 0.0)
    for k in range(directions):
        # Singularities tend to lie along the gradient.
        ways = (steepest, -steepest, random_directions(rng, len(points)))
        d = ways[min(k, 2)]
        t = reach[:, None] * share
        if not known.holds_outside_domain:
            t = np.minimum(reach, _distance_to_exit(field, points, d))[:, None] * share
        walk = lift_along_rays(field, points, d, t)
        moved = walk.moved
        rounding = 1e-9 * (np.abs(look.value)[:, None] + (field.period or 0) + np.abs(moved))
        rounding += look.error[:, None] + walk.error  # of both ends, also of approximations
        slope = np.einsum("nk,nk->n", look.gradient, d)
        slopes = SlopeRange(*((slope + sign * look.gradient_error)[:, None] for sign in (-1, 1)))
        each = known.map_numbers(lambda number, _, __: number[:, None])
        with np.errstate(invalid="ignore"):  # 0 * inf, at the point itself
            low, high = each.movement_bounds(look.value[:, None], slopes, t)
            excess = np.maximum(moved - high, low - moved)
        if isinstance(known, HarmonicBall):
            excess = np.fmax(excess, _harnack_excess(known, look.value, moved, share))
        excess = np.where(t > 0, excess, 0.0) - rounding
        worst = excess.argmax(axis=1)
        rows = np.arange(len(points))
        there = points + t[rows, worst, None] * d
        message = f"{name}: f leaves what is promised here by more than rounding"
        require(excess.max(axis=1) <= 0, message, points, excess.max(axis=1), there)


def _distance_to_exit(field: Field, points: FloatArray, d: FloatArray) -> FloatArray:
    """Lengths (n,) within the domain, which is convex, of rays from points in it."""
    if field.domain is None:
        return np.full(len(points), np.inf)
    backend = choose_backend("double")
    o, way = to_vector3(backend, points, "points"), to_vector3(backend, d, "d")
    ends = field.domain.prepare(backend).clip(o, way, backend.Float(0), backend.Float(np.inf))
    end = np.broadcast_to(to_numpy(ends[1]), (len(points),))
    return np.maximum(end * (1 - 1e-9) - 1e-12 * np.abs(points).max(axis=1), 0)


def _harnack_excess(
    ball: HarmonicBall, value: FloatArray, moved: FloatArray, share: FloatArray
) -> FloatArray:
    """By how much f is outside [lower, upper], or moves by more than Harnack's inequality allows
    a positive harmonic function: then it is not harmonic on the ball."""
    n = ball.dimension
    up = (1 + share) / (1 - share) ** (n - 1) - 1
    down = 1 - (1 - share) / (1 + share) ** (n - 1)
    below, above = (value - ball.lower)[:, None], (ball.upper - value)[:, None]
    with np.errstate(invalid="ignore"):  # 0 * inf, where nothing is known
        rise = np.fmin(np.fmin(below * up, above), above * down)
        fall = np.fmin(np.fmin(above * up, below), below * down)
    # A radius cut short only makes the comparison weaker for q <= 1.
    return np.maximum(moved - rise * (1 + 1e-9), -moved - fall * (1 + 1e-9))


def _check_extent(field: Field, level: float, rng: np.random.Generator, count: int) -> None:
    """Check that the level is not crossed on segments outside the extent."""
    volume = field.extent((level,))
    if volume is None:
        return
    lower, upper = volume.bounds()
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    if not np.isfinite(half).all():
        return
    start = middle + rng.uniform(-2.5, 2.5, (count, 3)) * half
    if field.domain is not None:
        start = np.concatenate([start, random_points(field, rng, count)])
        start = start[field.domain.contains_points(start)]
    d = random_directions(rng, len(start))
    length = np.minimum(3 * float(half.max()), _distance_to_exit(field, start, d))
    t = np.linspace(0, 1, 160) * length[:, None]
    walk = lift_along_rays(field, start, d, t)
    above = sample_field(field, start).value[:, None] + walk.moved + walk.jumped - level
    # To first order, farther from the level than a thousandth of the extent: no grazing.
    clear = (
        _distance_to_level(field, above)
        > 1e-3 * float(half.max()) * walk.gradient_norm + walk.error
    )
    crossed = (
        _level_interval(field, above[:, 1:]) != _level_interval(field, above[:, :-1])
    ) & clear[:, 1:]
    row, column = np.nonzero(crossed & clear[:, :-1])
    if not row.size:
        return
    low, high, offset = t[row, column], t[row, column + 1], above[row, column]
    for _ in range(4):  # to 1e-6 of the interval
        part = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 33)
        walk = lift_along_rays(field, start[row], d[row], part)
        there = offset[:, None] + walk.moved + walk.jumped
        first = (_level_interval(field, there) != _level_interval(field, there[:, :1])).argmax(
            axis=1
        )
        some = np.arange(len(row))
        low, high = part[some, first - 1], part[some, first]
        offset = there[some, first - 1]
    at = start[row] + high[:, None] * d[row]
    inside = volume.contains_points(at)
    require(inside, f"extent: the surface of level {level:g} leaves {volume} here", at)


def _level_interval(field: Field, above: FloatArray) -> FloatArray:
    return np.sign(above) if field.period is None else np.floor(above / field.period)


def _distance_to_level(field: Field, above: FloatArray) -> FloatArray:
    whole = 0.0 if field.period is None else field.period * np.round(above / field.period)
    return np.abs(above - whole)
