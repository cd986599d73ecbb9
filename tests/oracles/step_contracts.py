"""`check_steps`: no level within the steps that a proof takes in a field."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import LevelGaps, Promise
from harnack.enclosures.free_radius import allowed_movement
from harnack.testing.enclosure_contracts import PromiseCase
from harnack.testing.violation_search import (
    BrokenPromiseError,
    lift_along_rays,
    random_directions,
    random_points,
    sample_field,
)
from tests.oracles.exact import exact_step, on_host
from tests.oracles.mutated_enclosure import original_enclosure

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.enclosures import Enclosure
    from harnack.enclosures.samples import Sample
    from harnack.fields.field import Field

__all__ = ["check_steps"]


def check_steps(
    field: Field,
    kind: type[Enclosure],
    *,
    rng: np.random.Generator | int = 0,
    count: int = 400,
    precision: Precision = "double",
) -> int:
    """Take steps from random points in random directions and look for levels within them.

    Levels lie at random distances in value, from tiny to large. Checked for each promise of the
    field that the proof applies to: no level is met within the step, nor within any length that is
    covered (which is what the tracer asks when it looks back); what is stepped is covered; and
    the step is not longer than a proof of `harnack.enclosures` allows. In single
    precision levels are seen nearer by what rounding may have done, as the tracer sees them.

    Returns how many kinds of promise there were to test.

    Raises:
        BrokenPromiseError: naming the point, the direction and the step.
    """
    generator = np.random.default_rng(rng)
    backend = choose_backend(precision)
    real = backend.Float
    points = random_points(field, generator, count)
    if precision == "single":
        points = points.astype(np.float32).astype(np.float64)
    directions = random_directions(generator, count)
    p, d = to_vector3(backend, points), to_vector3(backend, directions)
    sample = field.evaluator(backend).evaluate(p)
    slope = dr.dot(sample.gradient, d)
    down, up = _gaps(field, points, generator)
    blur = _blur(sample, points, backend.machine_epsilon)
    near = LevelGaps(*(real(np.maximum(gap - blur, 0)) for gap in (down, up)))
    cases = [_case_of(one, sample, near) for one in sample.all_promises]
    accepted = [one for one in cases if one.accepts(kind)]
    for one in accepted:
        step = to_numpy(one.step(kind, slope)).astype(np.float64) * np.ones(count)
        _check_step(field, kind, one, slope, points, directions, step, (down, up))
        _check_covers(field, kind, one, slope, points, directions, step, (down, up), generator)
    return len(accepted)


def _gaps(
    field: Field, points: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Distances to the levels below and above: parts of what f varies by, and the first crossing
    of nearby levels."""
    value = sample_field(field, points).value
    variation = float(np.quantile(np.abs(value - np.median(value)), 0.9)) or 1.0
    down, up = variation * 10 ** rng.uniform(-6, 0.5, (2, len(points)))
    return down, up


def _blur(sample: Any, points: FloatArray, epsilon: float) -> FloatArray:
    steepness = to_numpy(dr.norm(sample.gradient)).astype(np.float64)
    value = np.abs(to_numpy(sample.value).astype(np.float64))
    error = (
        to_numpy(sample.value_error) if dr.is_array_v(sample.value_error) else sample.value_error
    )
    position = 4 * epsilon * np.abs(points).max(axis=1)
    return steepness * position + 8 * epsilon * value + np.asarray(error, dtype=np.float64)


def _check_step(
    field: Field, kind: type[Enclosure], case: PromiseCase, slope: Any, points: FloatArray,
    directions: FloatArray, step: FloatArray, gaps: tuple[FloatArray, FloatArray],
) -> None:  # fmt: skip
    def require(good: Any, message: str) -> None:
        _require(good, f"{type(case.promise).__name__}: {message}", points, directions, step)

    require(np.isfinite(step) & (step >= 0), "the step is not a number >= 0")
    require(~_meets(field, points, directions, step, gaps), "a level lies within the step")
    try:
        along = to_numpy(slope).astype(np.float64) * np.ones(len(points))
        exact = exact_step(original_enclosure(kind), on_host(case, len(points)), along)
    except TypeError:
        return  # a proof of the user's own
    require(step <= exact * (1 + 1e-12), "the step is longer than the proof allows")


def _check_covers(
    field: Field, kind: type[Enclosure], case: PromiseCase, slope: Any, points: FloatArray,
    directions: FloatArray, step: FloatArray, gaps: tuple[FloatArray, FloatArray],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    real = cast("Any", type(slope))

    def covered(length: FloatArray) -> Any:
        return to_numpy(case.covers(kind, slope, real(length))) & np.ones(len(step), bool)

    def require(good: Any, message: str, length: FloatArray) -> None:
        _require(good, f"{type(case.promise).__name__}: {message}", points, directions, length)

    part = step * rng.uniform(0.1, 0.9, len(step))
    require(covered(part), "a part of the step is not covered", part)
    longer = step * (1 + 10 ** rng.uniform(-3, 0.5, len(step)))
    wrong = covered(longer) & _meets(field, points, directions, longer, gaps)
    require(~wrong, "a level lies within a length that is covered", longer)


def _meets(
    field: Field, points: FloatArray, directions: FloatArray, length: FloatArray,
    gaps: tuple[FloatArray, FloatArray],
) -> Any:  # fmt: skip
    """Whether the lift is seen to move by more than a gap within the length, (n,)."""
    share = np.concatenate([np.linspace(0, 0.98, 40), 1 - np.geomspace(0.01, 1e-6, 8)])
    moved = lift_along_rays(field, points, directions, length[:, None] * share).moved
    rounding = 1e-12 * (1 + np.abs(sample_field(field, points).value[:, None]))
    down, up = gaps
    return ((moved > up[:, None] + rounding) | (-moved > down[:, None] + rounding)).any(axis=1)


def _require(
    good: Any, message: str, points: FloatArray, directions: FloatArray, length: FloatArray
) -> None:
    bad = np.flatnonzero(~np.asarray(good))
    if bad.size:
        k = bad[0]
        raise BrokenPromiseError(
            f"{message}: from {points[k].tolist()} in direction {directions[k].tolist()}, length "
            f"{float(length[k])!r}; {bad.size} of {len(points)} rays"
        )


def _case_of(promise: Promise, sample: Sample, gaps: LevelGaps) -> PromiseCase:
    """A promise of a sample with levels these gaps away, less what proofs take off for rounding."""
    if promise.interval_pairs:
        radius, below, above = allowed_movement(
            cast("Any", promise), sample.value, sample.value_error
        )
        lower = -math.inf if below is None else -below
        upper = math.inf if above is None else above
        (low, high), *_ = promise.interval_pairs
        promise = dataclasses.replace(promise, **{"radius": radius, low: lower, high: upper})
    return PromiseCase(promise, gaps.below, gaps.above)
