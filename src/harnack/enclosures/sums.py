"""Samples and promises of sums sum_i w_i f_i + c of functions f_i, the terms, from those of the
terms. A promise is a proved bound of a function near the point p of a sample. A sum of harmonic
functions is harmonic; so its proofs are those of its terms, with bounds that are added.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin, safe_norm
from harnack.enclosures.promises import (
    BoundedLaplacian,
    HarmonicBall,
    Lipschitz,
    Promise,
    TaylorRemainder,
)
from harnack.enclosures.samples import Sample

if TYPE_CHECKING:
    from typing import Any

    from harnack.backend import Real

P = TypeVar("P", bound=Promise)

# A bound that is computed in some ten roundings of single precision is raised, and a radius
# lowered, by this fraction.
PROOF_ROUNDING = 2e-6
# The radii on which Taylor's remainder of a harmonic function is bounded, as fractions of the
# radius of its ball, by experiment.
_SHARES = (0.25, 0.5)
# Of the rounding error of a value, `Sample.value_error` leaves out this number of units in the last
# place; and that of a gradient is left out if it is that of a few operations, at most so many.
ROUNDINGS_LEFT_OUT = 8.0


def weighted_sample(sample: Sample, weight: Real, *, is_negative: bool, is_exact: bool) -> Sample:
    """Return the sample of weight * f, from that of f.

    weight: a number other than 0.
    is_negative: whether it is below 0.
    is_exact: whether the product is exact, as it is for weights 1 and -1.
    """
    size = -weight if is_negative else weight

    def weighted(promise: Promise) -> Promise:
        """Return the promise of weight * f."""
        scaled = promise.scaled(size)
        return scaled.negated() if is_negative else scaled

    value = weight * sample.value
    error = size * sample.value_error
    if not is_exact:
        # Weight and product are rounded.
        error = error + 4 * float(dr.epsilon(type(value))) * dr.abs(value)
    normal = sample.shading_normal
    return sample.map_promises(
        weighted,
        value=value,
        gradient=weight * sample.gradient,
        value_error=error,
        gradient_error=size * sample.gradient_error,
        truncation_error=size * sample.truncation_error,
        shading_normal=-normal if is_negative and normal is not None else normal,
        ray_promises=tuple(promise.scaled(size) for promise in sample.ray_promises),
    )


def summed_sample(terms: Sequence[Sample], constant: Real) -> Sample:
    """Return the sample of f_1 + ... + f_n + constant, from samples of the terms f_i at one point.

    Proof of the errors. The sample of a term may leave out the rounding of eight units in the last
    place of its value, and that of a few operations in its gradient. These are roundings of the
    terms; if terms cancel, they are more than so many units of the sum. So they are counted here,
    together with those of the additions.
    """
    if len(terms) == 1:
        (term,), size = terms, dr.abs(terms[0].value) + dr.abs(constant)
        rounding = (ROUNDINGS_LEFT_OUT + 1) * 2 * float(dr.epsilon(type(size)))
        moved = term.shifted(constant)
        return dataclasses.replace(moved, value_error=term.value_error + rounding * size)
    value, gradient = terms[0].value, terms[0].gradient
    value_size, gradient_size = dr.abs(value), safe_norm(gradient)
    for term in terms[1:]:
        value, gradient = value + term.value, gradient + term.gradient
        value_size = value_size + dr.abs(term.value)
        gradient_size = gradient_size + safe_norm(term.gradient)
    value, value_size = value + constant, value_size + dr.abs(constant)
    epsilon = 2 * float(dr.epsilon(type(value)))
    roundings = ROUNDINGS_LEFT_OUT + len(terms) + 1
    # Numbers below the smallest normal one may underflow to 0.
    underflow = roundings * len(terms) * float(dr.smallest(type(value)))
    promises, alternatives = summed_promises(terms)
    return Sample(
        value,
        gradient,
        tuple(promise.shifted(constant) for promise in promises),
        total([term.value_error for term in terms])
        + (roundings * epsilon * value_size + underflow),
        total([term.gradient_error for term in terms]) + roundings * epsilon * gradient_size,
        truncation_error=total([term.truncation_error for term in terms]),
        alternative_promises=tuple(promise.shifted(constant) for promise in alternatives),
    )


def summed_promises(
    terms: Sequence[Sample],
) -> tuple[tuple[Promise, ...], tuple[Promise, ...]]:
    """Return the promises of the sum of several functions, from their samples at one point, and its
    alternative promises, which proved shorter steps. A kind of promise is left out if a term has
    nothing from which it follows."""
    taylor = taylor_remainders(terms)
    # Only the first of a kind, which is the sharpest: each costs time on every ray.
    others = [
        promise
        for promise in (_harmonic_ball(terms), _bounded_laplacian(terms), _lipschitz(terms))
        if promise is not None
    ]
    # A term that makes no promise about Taylor's formula itself has a sharper one of another kind.
    is_of_all = all(_first(term.promises, TaylorRemainder) for term in terms)
    if taylor and is_of_all:
        return taylor, tuple(others)
    if taylor:
        return (*others[:1], *taylor), tuple(others[1:])
    return tuple(others), ()


def taylor_remainders(terms: Sequence[Sample]) -> tuple[TaylorRemainder, ...]:
    """Return bounds of Taylor's remainder of the sum of several functions, on balls of a few radii,
    the smallest first; none if a term implies no such bound.

    Proof. The remainder of a sum is the sum of the remainders. A bound b(r) of the remainder of a
    term at the length r decreases at least as r^2 (`Promise.taylor_remainder_bound`). So it is at
    most (2 b(r)/r^2) s^2/2 at all lengths s <= r.

    The radii are those of the terms: the first one is the smallest of their first ones, and so on.
    """
    radii = shared_radii(terms)
    if radii is None:
        return ()
    if not radii:
        promises = [cast("Any", _first(term.promises, TaylorRemainder)) for term in terms]
        constant = total([promise.constant for promise in promises])
        cubic = total([promise.cubic_constant for promise in promises])
        factor = 1 + PROOF_ROUNDING
        return (TaylorRemainder(constant * factor, cubic_constant=cubic * factor),)
    return tuple(
        TaylorRemainder(
            total([taylor_constant(term, radius) for term in terms]) * (1 + PROOF_ROUNDING), radius
        )
        for radius in radii
    )


def shared_radii(samples: Sequence[Sample]) -> list[Real] | None:
    """Return radii of balls on which Taylor's remainders of several functions are bounded: the
    smallest of their first radii, of their second ones, and so on. An empty list if one bound of
    each holds everywhere; None if there is none of a function."""
    radii = [_taylor_radii(sample) for sample in samples]
    if any(entry is None for entry in radii):
        return None
    # A function whose only bound holds everywhere limits no radius.
    limited = [entry for entry in radii if entry]
    count = max(map(len, limited), default=0)
    return [least([entry[min(k, len(entry) - 1)] for entry in limited]) for k in range(count)]


def taylor_constant(sample: Sample, radius: Real) -> Real:
    """Return a number C such that Taylor's formula of degree 1 about the point of a sample has a
    remainder of at most C s^2/2 at lengths s <= radius; infinite if none is known."""
    constant: Real = dr.inf
    for promise in _taylor_promises(sample):
        if isinstance(promise, TaylorRemainder):
            bound = dr.select(radius < promise.radius, promise.constant, dr.inf)
        else:
            remainder = promise.taylor_remainder_bound(sample.value, radius)
            bound = 2 * (remainder / radius) / radius * (1 + PROOF_ROUNDING)
        constant = fmin(bound, constant)
    return constant


def _taylor_promises(sample: Sample) -> tuple[Promise, ...]:
    """Return the promises of a sample that imply bounds of Taylor's remainder: those about the
    remainder itself or, if there are none, harmonic balls. The range of a ball is widened by the
    error of the value."""
    remainders = tuple(entry for entry in sample.promises if isinstance(entry, TaylorRemainder))
    if remainders:
        return remainders
    error = value_error(sample)
    return tuple(
        dataclasses.replace(entry, lower=entry.lower - error, upper=entry.upper + error)
        for entry in sample.all_promises
        if isinstance(entry, HarmonicBall)
    )


def _taylor_radii(sample: Sample) -> list[Real] | None:
    """Return the radii of balls on which Taylor's remainder of a function is bounded; an empty list
    if one bound holds everywhere; None if there is no bound."""
    radii: list[Real] = []
    promises = _taylor_promises(sample)
    for promise in promises:
        if not isinstance(promise, TaylorRemainder):
            radii += [share * promise.radius for share in _SHARES]
        elif not _is_unlimited(promise.radius):
            radii.append((1 - PROOF_ROUNDING) * promise.radius)
    return radii if promises else None


def shared_reach(samples: Sequence[Sample]) -> Real:
    """Return the largest length on which all of several functions have a bound of Taylor's
    remainder, or else a Lipschitz constant; infinite, as a Python number, if nothing limits it."""
    reaches: list[Real] = []
    for sample in samples:
        radii = _taylor_radii(sample)
        if radii is None:
            promise = lipschitz_promise(sample)
            radii = [] if promise is None else [promise.radius]
        for k, radius in enumerate(radii):
            if k == 0:
                reaches.append(radius)
            else:
                reaches[-1] = fmax(radius, reaches[-1])
    return least([dr.inf, *reaches])


def _harmonic_ball(terms: Sequence[Sample]) -> HarmonicBall | None:
    """Return a ball on which the sum of several harmonic functions is harmonic and bounded, at
    least on one side; None if there is none.

    Proof. A harmonic function of x and y is a harmonic function of space that does not depend on z,
    and one of space is a harmonic function of R^4 that does not depend on the fourth coordinate;
    their ranges on balls are the same. So in the largest of the dimensions all terms are harmonic
    on the smallest of the balls, and so is the sum. The bounds of the terms add up. A term with a
    larger ball has a smaller range on this one (`_narrowed`). If the sum would be bounded on
    neither side, because one term has no lower bound and another one no upper bound, half the ball
    is taken: there each term is bounded on both sides.
    """
    balls = [_first(term.all_promises, HarmonicBall) for term in terms]
    known = [ball for ball in balls if ball is not None]
    if len(known) < len(terms):
        return None
    radius = least([ball.radius for ball in known])
    is_half = all(
        any(_is_unlimited(getattr(ball, end)) for ball in known) for end in ("lower", "upper")
    )
    if is_half:
        radius = 0.5 * radius
    pairs = zip(known, terms, strict=True)
    ranges = [_narrowed(ball, radius, term, both_sides=is_half) for ball, term in pairs]
    lower, upper = (total(ends) for ends in zip(*ranges, strict=True))
    if _is_unlimited(lower) and _is_unlimited(upper):
        return None
    return HarmonicBall(radius, lower, upper, max(ball.dimension for ball in known))


def _narrowed(
    ball: HarmonicBall, radius: Real, sample: Sample, *, both_sides: bool
) -> tuple[Real, Real]:
    """Return a lower and an upper bound of the function of a sample on the ball of this radius,
    from a harmonic ball that is not smaller.

    both_sides: whether an infinite bound is replaced by a finite one. It is finite only if the
        radius is smaller than that of the harmonic ball.

    Proof. With q = radius/ball.radius, the function u = f - lower >= 0 lies between u(p) (1-q) /
    (1+q)^(n-1) and u(p) (1+q)/(1-q)^(n-1) on the smaller ball, by Harnack's inequality; and
    likewise upper - f. The error of f(p), and the rounding of these formulas, widen the range.
    """
    error = value_error(sample)
    q = fmin(radius / ball.radius * (1 + PROOF_ROUNDING), 1)
    least_factor, greatest_factor = (1 - q), (1 + q)
    for _ in range(ball.dimension - 1):
        least_factor, greatest_factor = least_factor / (1 + q), greatest_factor / (1 - q)

    def moved(end: Real, sign: float) -> tuple[Real, Real]:
        """Return how far f may move from f(p) to one end of its range, and away from that end, on
        the smaller ball. end: the upper end, with sign 1, or the lower end, with sign -1."""
        u = fmax(sign * (end - sample.value), 0) + error
        slack = PROOF_ROUNDING * u + error
        away = u * (greatest_factor - 1) * (1 + 4 * PROOF_ROUNDING)
        return u * (1 - least_factor) + slack, away + slack

    lower, upper = ball.lower, ball.upper
    has_lower, has_upper = not _is_unlimited(lower), not _is_unlimited(upper)
    if has_lower:
        fall, rise = moved(ball.lower, -1.0)
        lower = fmax(sample.value - fall, lower)
        if has_upper or both_sides:
            upper = fmin(sample.value + rise, upper)
    if has_upper:
        rise, fall = moved(ball.upper, 1.0)
        upper = fmin(sample.value + rise, upper)
        if has_lower or both_sides:
            lower = fmax(sample.value - fall, lower)
    return lower, upper


def _bounded_laplacian(terms: Sequence[Sample]) -> BoundedLaplacian | None:
    """Return a ball on which the sum of several functions and its Laplacian are bounded, where the
    range of each is that of the terms, added up; None if there is none, or if all are harmonic. The
    Laplacian of a harmonic term is 0."""
    promises: list[BoundedLaplacian] = []
    for term in terms:
        promise = _first(term.all_promises, BoundedLaplacian)
        ball = _first(term.all_promises, HarmonicBall)
        if promise is None:
            if ball is None or ball.dimension > 3:
                return None
            if _is_unlimited(ball.lower) or _is_unlimited(ball.upper):
                return None
            promise = BoundedLaplacian(ball.radius, ball.lower, ball.upper, 0.0, 0.0)
        promises.append(promise)
    if not any(_first(term.all_promises, BoundedLaplacian) for term in terms):
        return None
    names = "lower", "upper", "laplacian_lower", "laplacian_upper"
    numbers = {name: total([getattr(entry, name) for entry in promises]) for name in names}
    return BoundedLaplacian(least([entry.radius for entry in promises]), **numbers)


def _lipschitz(terms: Sequence[Sample]) -> Lipschitz | None:
    """Return a Lipschitz constant of the sum of several functions, on the smallest of the balls of
    theirs: the sum of their constants. None if a term implies none."""
    promises = [lipschitz_promise(term) for term in terms]
    known = [promise for promise in promises if promise is not None]
    if len(known) < len(terms):
        return None
    constant = total([promise.constant for promise in known])
    return Lipschitz(constant * (1 + PROOF_ROUNDING), least([promise.radius for promise in known]))


def lipschitz_promise(sample: Sample) -> Lipschitz | None:
    """Return a bound of |f(y) - f(p)|/|y - p| on a ball about the point p of a sample; None if its
    promises imply none.

    Proof for a bound C of Taylor's remainder on a ball of radius r: |f(y) - f(p)| <= |grad f| s + C
    s^2/2 <= (|grad f| + C r/2) s for s = |y - p| < r. If it holds everywhere, r is |grad f|/C, on
    which the slope of f may double.
    """
    for promise in sample.all_promises:
        if isinstance(promise, Lipschitz):
            return promise
    for promise in sample.all_promises:
        if isinstance(promise, TaylorRemainder):
            slope, radius = safe_norm(sample.gradient) + sample.gradient_error, promise.radius
            if _is_unlimited(radius):
                radius = dr.select(promise.constant > 0, slope / promise.constant, dr.inf)
                constant = 1.5 * slope
            else:
                constant = dr.fma(0.5 * radius, promise.constant, slope)
            return Lipschitz(constant * (1 + PROOF_ROUNDING), radius)
        implied = promise.implied_lipschitz(sample.value)
        if implied is not None:
            return implied
    return None


def value_error(sample: Sample) -> Real:
    """Return a bound of the error of the value of a sample, with the rounding that it leaves
    out."""
    epsilon = 2 * float(dr.epsilon(type(sample.value)))
    return dr.fma(ROUNDINGS_LEFT_OUT * epsilon, dr.abs(sample.value), sample.value_error)


def _first(promises: Sequence[Promise], kind: type[P]) -> P | None:
    """Return the first promise of a kind; None if there is none."""
    return next((entry for entry in promises if isinstance(entry, kind)), None)


def total(numbers: Sequence[Real]) -> Real:
    """Return the sum of numbers of Python or Dr.Jit. An infinite Python number among them gives it
    as the sum, so that code can ask for it while a kernel is recorded."""
    for number in numbers:
        if _is_unlimited(number):
            return number
    result = numbers[0]
    for number in numbers[1:]:
        result = result + number
    return result


def least(numbers: Sequence[Real]) -> Real:
    """Return the smallest of several numbers of Python or Dr.Jit; NaN if one is NaN."""
    result = numbers[0]
    for number in numbers[1:]:
        if isinstance(number, float) and isinstance(result, float):
            result = min(result, number)
        elif _is_unlimited(number):
            continue
        elif _is_unlimited(result):
            result = number
        else:
            result = dr.select((result <= number) | (result != result), result, number)
    return result


def _is_unlimited(number: Real) -> bool:
    """Return whether a number is an infinite Python float, which is known while a kernel is being
    recorded."""
    return isinstance(number, float) and abs(number) == dr.inf
