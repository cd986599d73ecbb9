"""`check_enclosure`: tests of enclosures on random functions. A promise is a proved bound of a
function f near a point p, for example a Lipschitz constant on a ball about p. An enclosure (an
interval that contains the change of f along a ray from p) is derived from a promise and the slope
of f. For levels at given differences (gaps) above and below f(p), it proves a free length: a length
of the ray within which f meets no level. The enclosure is right if no function that the promise
allows meets a level within the free length. So random functions f(t) of the position t on a ray are
drawn that satisfy a promise on the ball |t| < reach; sets of them are arrays with one function per
row.

The random functions include those for which the inequalities in the proofs of `harnack.enclosures`
are equalities. So the test detects an enclosure whose lengths are too long by a thousandth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.enclosures import (
    BoundedLaplacian,
    Enclosure,
    HarmonicBall,
    LevelGaps,
    Lipschitz,
    Promise,
    SlopeRange,
    TaylorRemainder,
)
from harnack.enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from harnack.enclosures.free_radius import HarmonicBallEnclosure
from harnack.testing.poisson import AxialFunctions, GreenPotentials, cap_mass, kernel_difference
from harnack.testing.violation_search import BrokenPromiseError

if TYPE_CHECKING:
    from harnack.backend import Mask, Precision, Real

__all__ = [
    "PromiseCase",
    "RandomFunctions",
    "check_enclosure",
    "random_functions",
]


@dataclass(frozen=True)
class PromiseCase:
    """A promise (a proved bound) about a function f near a point p with f(p) = 0, and the gaps to
    the next levels, so that an enclosure can be made and tested. An enclosure proves a free length:
    a length of a ray from p within which f meets no level. All numbers may be arrays, with one
    function per row.

    promise: the promise.
    gap_below, gap_above: the differences between f(p) and the next level below and above, both
        positive; infinite if there is no such level.
    """

    promise: Promise
    gap_below: Real
    gap_above: Real

    def map_numbers(self, change: Callable[[Any], Any]) -> PromiseCase:
        """A copy of the case in which each number x of the promise and each gap x is replaced by
        change(x). The numbers may be Python numbers, or arrays of NumPy or Dr.Jit."""
        promise = self.promise.map_numbers(lambda number, _, __: change(number))
        return PromiseCase(promise, change(self.gap_below), change(self.gap_above))

    def enclosure(self, kind: type[Enclosure], slopes: SlopeRange) -> Enclosure | None:
        """The enclosure of the class `kind` that follows from the promise; None if the class does
        not apply to such promises.

        slopes: an interval that contains the derivative of f along the ray at p.
        """
        promise: Any = self.promise
        # Without the allowance for rounding, so that steps can be compared exactly.
        if isinstance(promise, HarmonicBall) and issubclass(kind, HarmonicBallEnclosure):
            # How far the range goes below and above f(p) = 0.
            ends = -promise.lower, promise.upper
            below, above = (None if _is_infinite(end) else end for end in ends)
            if not kind.applies_to(promise.dimension, below is not None, above is not None):
                return None
            return kind(promise.radius, below, above, promise.dimension, slopes)
        if isinstance(promise, BoundedLaplacian) and issubclass(kind, BoundedLaplacianEnclosure):
            ranges = -promise.lower, promise.upper
            ends = promise.laplacian_lower, promise.laplacian_upper
            return kind.from_ranges(promise.radius, ranges, ends, slopes)
        # f(p) = 0, without an error.
        return kind.from_promise(promise, type(slopes.lower)(0), 0.0, slopes)

    def accepts(self, kind: type[Enclosure]) -> bool:
        """Whether an enclosure of the class `kind` can be made from this kind of promise. It is
        tried with numbers -1 and 1 in place of those of the promise; infinite ends stay
        infinite."""
        lower_names = [lower for lower, _ in self.promise.interval_pairs]
        values = {
            name: -1.0 if name in lower_names else 1.0
            for name, *_ in self.promise.units
            if not _is_infinite(getattr(self.promise, name))
        }
        # Gaps and slope may be any numbers.
        case = PromiseCase(dataclasses.replace(self.promise, **values), 1.0, 1.0)
        return case.enclosure(kind, SlopeRange(0.0, 0.0)) is not None

    def step(self, kind: type[Enclosure], slope: Real, error: Real = 0.0) -> Real:
        """The free length that an enclosure of the class `kind` proves: a length of a ray from p
        within which f meets no level.

        slope: the derivative of f along the ray at p, known up to `error`.
        """
        enclosure = self.enclosure(kind, SlopeRange.around(slope, error))
        assert enclosure is not None
        return enclosure.free_length(LevelGaps(self.gap_below, self.gap_above))

    def covers(self, kind: type[Enclosure], slope: Real, length: Real, error: Real = 0.0) -> Mask:
        """Whether an enclosure of the class `kind` proves that f meets no level within `length`
        along a ray from p.

        slope: the derivative of f along the ray at p, known up to `error`.
        """
        enclosure = self.enclosure(kind, SlopeRange.around(slope, error))
        assert enclosure is not None
        return enclosure.is_free(LevelGaps(self.gap_below, self.gap_above), length)


def _is_infinite(end: Any) -> bool:
    """Whether an end of a range is the Python number inf or -inf. An array counts as finite."""
    return isinstance(end, float) and math.isinf(end)


# Functions that keep a promise.

# Number of points at which a function is sampled within a length.
_SAMPLES = 48


@dataclass(frozen=True)
class RandomFunctions:
    """A set of random functions f(t) of the position t on a ray, one function per row, all of which
    satisfy a promise (a proved bound of f on the ball |t| < reach).

    name: the name of the kind of functions, for messages.
    case: the promise, and levels such that most of the functions meet one.
    slope: (rows,) the derivatives f'(0).
    reach: (rows,) the radius of the ball on which the promise holds.
    movement: a function that returns f(t) - f(0) for positions t (rows, m) with 0 <= t < reach.
    """

    name: str
    case: PromiseCase
    slope: FloatArray
    reach: FloatArray
    movement: Callable[[FloatArray], FloatArray]


def check_enclosure(
    kind: type[Enclosure],
    *,
    rng: np.random.Generator | int = 0,
    rows: int = 400,
    precision: Precision = "double",
) -> None:
    """Test a class of enclosures against random functions for every kind of promise that it applies
    to. (A promise is a proved bound of a function near a point, from which an enclosure of this
    class derives a free length of a ray.)

    kind: the class to be tested.
    rng: a generator of random numbers, or a seed.
    rows: the number of functions of each kind.
    precision: of the tested computation.

    Checked: free lengths are numbers from 0 to the radius of the promise; no level is met within a
    free length; `is_free` agrees with `free_length`; no level is met within any length that
    `is_free` accepts.

    Raises:
        BrokenPromiseError: with the numbers of the first function for which a check fails.
        ValueError: the class applies to no kind of promise that is drawn.
    """
    accepted = 0
    generator = np.random.default_rng(rng)
    for trial in random_functions(generator, rows):
        on_device, slope = _upload(trial, precision)
        if on_device.accepts(kind):
            accepted += 1
            _check_trial(kind, trial, on_device, slope, generator, precision)
    if not accepted:
        raise ValueError(
            f"{kind.__name__} applies to none of the promises there are; define its classmethod "
            "from_promise(promise, value, error, slopes), which returns an enclosure for its kind "
            "of promise"
        )


def random_functions(rng: np.random.Generator, rows: int) -> Iterator[RandomFunctions]:
    """Yield sets of `rows` random functions of different kinds: functions that are harmonic in 2, 3
    or 4 dimensions, that have a bounded Laplacian, that are Lipschitz, or that have a bounded
    second derivative. Each set satisfies a promise of that kind.

    rng: a generator of random numbers.
    """
    with np.errstate(all="ignore"):
        for dimension in (2, 3, 4):
            yield _positive_harmonic(rng, rows, dimension, mirrored=False)
            yield _positive_harmonic(rng, rows, dimension, mirrored=True)
            yield _bounded_harmonic(rng, rows, dimension)
        yield _bounded_laplacian(rng, rows, mirrored=False)
        yield _bounded_laplacian(rng, rows, mirrored=True)
        yield _zigzag_lines(rng, rows)
        yield _parabolas(rng, rows)


def _positive_harmonic(
    rng: np.random.Generator, rows: int, n: int, *, mirrored: bool
) -> RandomFunctions:
    """Random harmonic functions f on a ball in n dimensions that are bounded on one side only: f >
    lower or, if `mirrored`, f < upper. f - lower (or upper - f) is the Poisson integral of one, two
    or three rings of mass on the sphere. A ring is given by its latitude, the cosine of its angle
    to the ray.

    rng: a generator of random numbers.
    rows: the number of functions.
    n: the dimension.
    """
    # From 10^-3 to 10^3, evenly in the logarithm.
    radius, mass = _log_uniform(rng, rows, -3, 3), _log_uniform(rng, rows, -3, 3)
    latitudes = rng.uniform(-1, 1, (rows, 3))
    # Three tenths of the rings are near a pole, where the bounds are sharp.
    near_poles = rng.choice([-1.0, 1.0], (rows, 3)) * (1 - 10 ** rng.uniform(-8, 0, (rows, 3)))
    latitudes = np.where(rng.random((rows, 3)) < 0.3, near_poles, latitudes)
    weights = rng.dirichlet([0.7] * 3, rows)
    kind = rng.integers(0, 3, rows)
    weights[kind == 0] = (1, 0, 0)  # equality in Jensen's inequality
    is_at_poles = kind == 1  # equality in the bound by the chord
    latitudes[is_at_poles, :2] = (1, -1)
    weights[is_at_poles, 2] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    # u is f - lower, or upper - f, up to a constant; its value at the center is `mass`.
    u = AxialFunctions("points", latitudes, weights * mass[:, None], radius, n)
    sign = -1.0 if mirrored else 1.0
    ends = (-math.inf, mass) if mirrored else (-mass, math.inf)
    return _with_random_levels(
        rng,
        f"positive harmonic, n = {n}, {'upper' if mirrored else 'lower'} end known",
        mass,
        radius,
        sign * u.slope,
        lambda t: sign * u.movement(t),
        HarmonicBall(radius, *ends, n),
    )


def _bounded_harmonic(rng: np.random.Generator, rows: int, n: int) -> RandomFunctions:
    """Random harmonic functions on a ball in n dimensions, each with the promise of a range of its
    values on the ball.

    rng: a generator of random numbers.
    rows: the number of functions.
    n: the dimension.

    The ray runs from the center of the ball to a pole of its sphere. On the sphere a function is
    symmetric about this axis and constant on four zones, which end at random heights on the axis.
    The four values lie in the promised range, which has a random length; for two thirds of the
    functions each value is one of its two ends.
    """
    # From 10^-3 to 10^3, evenly in the logarithm.
    radius, span = _log_uniform(rng, rows, -3, 3), _log_uniform(rng, rows, -3, 3)
    heights = np.sort(rng.uniform(0, 2, (rows, 3)), axis=1)
    is_thin = rng.random(rows) < 0.2
    heights[is_thin] *= 10 ** rng.uniform(-4, 0, is_thin.sum())[:, None]
    # The values in the four zones, as fractions of the range, from the pole in front.
    values = rng.uniform(0, 1, (rows, 4))
    kind = rng.integers(0, 3, rows)
    values[kind == 0] = (1, 0, 0, 1)  # equality in the upper cap bound
    values[kind == 1] = (0, 1, 1, 0)  # and in the lower one
    # Zones are differences of caps (a cap reaches from the pole to a height), so a cap's weight is
    # the difference between neighboring zones.
    weights = values[:, :3] - values[:, 1:]
    u = AxialFunctions("caps", heights, weights * span[:, None], radius, n)
    # The value at the center is the mean over the sphere.
    mean = values[:, 3] + (weights * cap_mass(heights, n)).sum(axis=1)
    gap_below, gap_above = span * mean, span * (1 - mean)
    return _with_random_levels(
        rng,
        f"bounded harmonic, n = {n}",
        np.minimum(gap_below, gap_above),
        radius,
        u.slope,
        u.movement,
        HarmonicBall(radius, -gap_below, gap_above, n),
    )


def _bounded_laplacian(rng: np.random.Generator, rows: int, *, mirrored: bool) -> RandomFunctions:
    """Random functions of bounded Laplacian on a ball, which are also bounded below or, if
    `mirrored`, above. Each is a Poisson integral of rings of mass on the sphere, minus the
    potential of sources in the ball.

    rng: a generator of random numbers.
    rows: the number of functions.

    The sources are a constant density in the unit ball, two balls of constant density, and a
    multiple of the Legendre polynomial P_2 of the latitude (the wave). At the distance q from the
    center, the potential of P_2 is q^2 ln(q) P_2/5 up to its sign; such a logarithm also occurs in
    the bound of `BoundedLaplacian`. The bound is attained if there is only a constant density that
    is not negative, and mass only at the poles.
    """
    # From 10^-3 to 10^3, evenly in the logarithm.
    radius, mass = _log_uniform(rng, rows, -3, 3), _log_uniform(rng, rows, -3, 3)
    latitudes, weights = rng.uniform(-1, 1, (rows, 3)), rng.dirichlet([0.7] * 3, rows)
    # The Poisson integral of the mass is at least mass (1-q^2)/8, and a potential is at most
    # (1-q^2)/6 times the largest density: so f stays above its lower end if the densities stay
    # below 0.75 of the mass. (Below, four of at most 0.18 are added, or a wave of 0.7 is alone.)
    centers = rng.uniform(-0.9, 0.9, (rows, 2))
    sizes = (1 - np.abs(centers)) * rng.uniform(0.1, 1, (rows, 2))
    density = rng.uniform(-0.18, 0.18, (rows, 4)) * 10 ** rng.uniform(-3, 0, (rows, 1))
    # Half of the functions have mass at the poles only, and no small balls; of these, half have
    # only a constant density, and half only a wave.
    kind = rng.integers(0, 4, rows)
    latitudes[kind < 2, :2], weights[kind < 2, 2], density[kind < 2, 1:3] = (1, -1), 0, 0
    density[kind == 0, 0], density[kind == 0, 3] = np.abs(density[kind == 0, 0]), 0
    density[kind == 1, 0] = 0
    density[kind == 1, 3] = rng.choice([-0.7, 0.7], rows)[kind == 1]
    weights /= weights.sum(axis=1, keepdims=True)
    density *= mass[:, None]
    balls = GreenPotentials(
        np.column_stack([np.zeros(rows), centers]), np.column_stack([np.ones(rows), sizes])
    )
    constant_density, wave_density = density[:, :3], density[:, 3]
    u = AxialFunctions("points", latitudes, weights * mass[:, None], radius, 3)
    potential, slope = balls.at_center(constant_density)
    wave_sources = np.stack([-0.5 * wave_density, wave_density])  # P_2 is between -1/2 and 1
    # Bounds of the total density, which is the Laplacian, for the promise.
    min_density = (
        density[:, 0]
        + np.minimum(constant_density[:, 1:], 0).sum(axis=1)
        + wave_sources.min(axis=0)
    )
    max_density = (
        density[:, 0]
        + np.maximum(constant_density[:, 1:], 0).sum(axis=1)
        + wave_sources.max(axis=0)
    )
    sign = -1.0 if mirrored else 1.0

    def movement(t: FloatArray) -> FloatArray:
        """f(t) - f(0) at positions t (rows, m)."""
        q = t / radius[:, None]
        wave_part = wave_density[:, None] / 5 * q * q * np.log(np.maximum(q, 1e-300))
        return sign * (u.movement(t) - balls.movement(q, constant_density) + wave_part)

    # On a slightly smaller ball, the Poisson integrals of point masses are bounded as well.
    # The end on the other side is practically infinite.
    near_end, far_end = mass - potential, 1e18 * mass
    below, above = (far_end, near_end) if mirrored else (near_end, far_end)
    lower, upper = np.sort(sign * np.stack([min_density, max_density]) / radius**2, axis=0)
    return _with_random_levels(
        rng,
        f"bounded Laplacian, {'upper' if mirrored else 'lower'} end near",
        near_end,
        radius,
        sign * (u.slope - slope / radius),
        movement,
        BoundedLaplacian(radius * (1 - 1e-9), -below, above, lower, upper),
    )


def _zigzag_lines(rng: np.random.Generator, rows: int) -> RandomFunctions:
    """Random functions with a Lipschitz constant: straight lines, and zigzag lines with two kinks.
    The absolute values of their slopes are at most the constant.

    rng: a generator of random numbers.
    rows: the number of functions.
    """
    # From 10^-3 to 10^3, evenly in the logarithm.
    radius, constant = _log_uniform(rng, rows, -3, 3), _log_uniform(rng, rows, -3, 3)
    knots = np.sort(rng.uniform(0, 1, (rows, 2)), axis=1) * radius[:, None]
    # The slopes on the three parts; two fifths of the functions are straight lines of the largest
    # slope.
    slopes = rng.uniform(-1, 1, (rows, 3)) * constant[:, None]
    is_straight = rng.random(rows) < 0.4
    slopes[is_straight] = (rng.choice([-1.0, 1.0], rows) * constant)[is_straight, None]

    def movement(t: FloatArray) -> FloatArray:
        """f(t) - f(0) at positions t (rows, m)."""
        # Behind each knot the slope differs by the difference of neighboring slopes.
        since_knot = np.maximum(t[:, :, None] - knots[:, None, :], 0)
        return slopes[:, :1] * t + (since_knot * np.diff(slopes, axis=1)[:, None, :]).sum(axis=2)

    return _with_random_levels(
        rng,
        "Lipschitz",
        constant * radius,
        radius,
        slopes[:, 0],
        movement,
        Lipschitz(constant, radius),
    )


def _parabolas(rng: np.random.Generator, rows: int) -> RandomFunctions:
    """Random functions of bounded second derivative: two parabolas, joined at a knot with equal
    slopes. The absolute value of the second derivative is at most the promised constant, and for
    half of the functions equal to it.

    rng: a generator of random numbers.
    rows: the number of functions.
    """
    # From 10^-3 to 10^3, evenly in the logarithm.
    radius, constant = _log_uniform(rng, rows, -3, 3), _log_uniform(rng, rows, -3, 3)
    curvatures = rng.uniform(-1, 1, (rows, 2)) * constant[:, None]
    # Half of the functions have the largest possible second derivative on both parts.
    is_extremal = rng.random(rows) < 0.5
    curvatures[is_extremal] = (rng.choice([-1.0, 1.0], rows) * constant)[is_extremal, None]
    knot = rng.uniform(0, 1, rows) * radius
    # Slopes from small to ten times the change of the slope on the ball.
    slope = constant * radius * rng.choice([-1.0, 1.0], rows) * 10 ** rng.uniform(-4, 1, rows)

    def movement(t: FloatArray) -> FloatArray:
        """f(t) - f(0) at positions t (rows, m)."""
        # Behind the knot the second derivative differs by `change`.
        since_knot = np.maximum(t - knot[:, None], 0)
        change = (curvatures[:, 1] - curvatures[:, 0])[:, None]
        return (
            slope[:, None] * t
            + 0.5 * curvatures[:, :1] * t * t
            + 0.5 * change * since_knot * since_knot
        )

    return _with_random_levels(
        rng,
        "bounded curvature",
        constant * radius**2,
        radius,
        slope,
        movement,
        TaylorRemainder(constant, radius),
    )


def _with_random_levels(
    rng: np.random.Generator,
    name: str,
    scale: FloatArray,
    reach: FloatArray,
    slope: FloatArray,
    movement: Callable[[FloatArray], FloatArray],
    promise: Promise,
) -> RandomFunctions:
    """Choose random levels for random functions f(t) of the position t on a ray, one function per
    row.

    For most functions, one level is the value at a random point, so that it is met. For half of
    these functions it is the only level, since of two levels the other one is often met first. All
    other levels are at random differences from f(0).

    rng: a generator of random numbers.
    name: the name of the kind of functions, for messages.
    scale: (rows,) a typical size of f - f(0).
    reach: (rows,) the radius of the ball about t = 0 on which the promise holds.
    slope: (rows,) the derivatives f'(0).
    movement: a function that returns f(t) - f(0) for t (rows, m), 0 <= t < reach.
    promise: the promise (a proved bound of f on that ball) that all functions satisfy.
    """
    rows = len(scale)
    # From 10^-9 to 10^2 times the scale, evenly in the logarithm.
    gap_below, gap_above = (
        scale * _log_uniform(rng, rows, -9, 2),
        scale * _log_uniform(rng, rows, -9, 2),
    )
    fraction = np.where(rng.random(rows) < 0.5, rng.random(rows), _log_uniform(rng, rows, -8, 0))
    # f at the random point, minus f(0). If it is positive, the level is above, else below.
    difference = movement((fraction * reach)[:, None])[:, 0]
    is_reached = (rng.random(rows) < 0.8) & (difference != 0) & np.isfinite(difference)
    gap_above = np.where(is_reached & (difference > 0), difference, gap_above)
    gap_below = np.where(is_reached & (difference < 0), -difference, gap_below)
    is_single = rng.random(rows) < 0.5
    gap_above = np.where(is_reached & is_single & (difference < 0), np.inf, gap_above)
    gap_below = np.where(is_reached & is_single & (difference > 0), np.inf, gap_below)
    return RandomFunctions(name, PromiseCase(promise, gap_below, gap_above), slope, reach, movement)


def _log_uniform(rng: np.random.Generator, rows: int, lower: float, upper: float) -> FloatArray:
    """An array (rows,) of random numbers whose decimal logarithms are uniform between `lower` and
    `upper`. rng: a generator of random numbers."""
    return 10 ** rng.uniform(lower, upper, rows)


def _upload(trial: RandomFunctions, precision: Precision) -> tuple[PromiseCase, Any]:
    """Convert numbers of a set of random functions, the trial, to Dr.Jit arrays of the given
    precision. Returns its promise with the levels, and its slopes (rows,)."""
    real = choose_backend(precision).Float
    case = trial.case.map_numbers(lambda n: real(n) if isinstance(n, np.ndarray) else n)
    return case, real(trial.slope)


def _check_trial(
    kind: type[Enclosure],
    trial: RandomFunctions,
    case: PromiseCase,
    slope: Any,
    rng: np.random.Generator,
    precision: Precision,
) -> None:
    """Check the enclosures of the class `kind` on a set of random functions, the trial.

    trial: the random functions.
    case: the trial's promise with its levels, as Dr.Jit arrays.
    slope: the trial's slopes (rows,), as a Dr.Jit array.
    rng: a generator of random numbers.
    precision: of these arrays.

    Raises:
        BrokenPromiseError: a free length is wrong for one of the functions.
    """
    rows = len(trial.slope)
    real = cast("Any", type(slope))
    step = to_numpy(case.step(kind, slope)).astype(np.float64)
    # No level may be met within the free length, and it may not be longer than the ball of the
    # promise.
    is_met = _meets_level(trial, np.minimum(step, trial.reach), precision)
    _require(trial, ~is_met, kind, "a level is met within the step {length}", step)
    is_valid = (step >= 0) & (step <= trial.reach * (1 + 1e-6))
    message = "the step {length} is no length up to {reach}, where the promise ends"
    _require(trial, is_valid, kind, message, step)
    # In single precision both are rounded, each to the safe side.
    fractions = [1 - 1e-5 if precision == "double" else 0.98, *rng.uniform(0.01, 0.98, 2)]
    for fraction in fractions:
        length = step * fraction
        is_free = to_numpy(case.covers(kind, slope, real(length)))
        _require(trial, is_free, kind, "{length} is not covered, but lies within the step", length)
    # Lengths above the free length, and any lengths: what `is_free` accepts must be free.
    lengths = [step * (1 + 10 ** rng.uniform(-4, 0, rows)), trial.reach * rng.random(rows)]
    for length in lengths:
        is_covered = to_numpy(case.covers(kind, slope, real(length)))
        tested = np.minimum(length, trial.reach)
        is_wrong = is_covered & (
            _meets_level(trial, tested, precision) | (length > trial.reach * (1 + 1e-6))
        )
        _require(trial, ~is_wrong, kind, "a level is met within {length}, which is covered", length)


def _meets_level(trial: RandomFunctions, length: FloatArray, precision: Precision) -> BoolArray:
    """A mask (rows,): whether each function of the trial meets a level strictly within its entry of
    `length` (rows,), as far as samples of the function show. In single precision the test allows
    for more rounding."""
    tolerance = 1e-9 if precision == "double" else 1e-5
    # Half of the samples are evenly spaced, the others dense towards the end of the length.
    fractions = np.concatenate([np.linspace(0, 1, _SAMPLES // 2), 1 - np.geomspace(1e-7, 0.5, 24)])
    t = (1 - tolerance) * length[:, None] * fractions
    with np.errstate(all="ignore"):
        movement = trial.movement(t)
        # An upper bound of how much rounding of its inputs changes a function: the growth in the
        # direction of a mass at the pole (latitude 1), in the highest dimension.
        q = np.minimum(t / trial.reach[:, None], 1 - 1e-12)
        growth = kernel_difference(q, 1.0, 4) + 1
    rounding = 0.0
    if precision == "single":
        rounding = 2e-6 * _value_scale(trial)[:, None] * growth
    case = trial.case
    is_above = movement > case.gap_above[:, None] * (1 + tolerance) + rounding
    is_below = -movement > case.gap_below[:, None] * (1 + tolerance) + rounding
    return (is_above | is_below).any(axis=1)


def _value_scale(trial: RandomFunctions) -> FloatArray:
    """For each function of the trial, the size (rows,) of the numbers in its evaluation. The
    rounding errors of its values are proportional to it."""
    promise, size = trial.case.promise, np.abs(trial.slope) * trial.reach
    # The range of f is the first pair, if there is one. Its nearer end counts, as the other may be
    # practically infinite.
    for low, high in promise.interval_pairs[:1]:
        size = size + np.minimum(np.abs(getattr(promise, low)), np.abs(getattr(promise, high)))
    return size


def _require(
    trial: RandomFunctions,
    holds: Any,
    kind: type[Enclosure],
    message_format: str,
    length: FloatArray,
) -> None:
    """Raise a BrokenPromiseError if `holds` (rows,) is False for a function of the trial. The
    message describes the first such function.

    kind: the class of enclosures that is tested.
    message_format: the message; {length} stands for the function's entry of `length` (rows,), and
        {reach} for the radius of its promise.
    """
    failures = np.flatnonzero(~holds)
    if not failures.size:
        return
    # Describe the first function that fails.
    row = failures[0]
    numbers = trial.case.map_numbers(lambda n: float(n[row]) if np.ndim(n) else n)
    message = message_format.format(reach=float(trial.reach[row]), length=float(length[row]))
    raise BrokenPromiseError(
        f"{kind.__name__} does not keep its promise ({trial.name}): {message}. Wrong in "
        f"{failures.size} of {len(holds)} trials; the first: {numbers}, "
        f"slope = {float(trial.slope[row])!r}"
    )
