"""Samples and promises of products f g of two functions, from samples of both. A promise is a
proved bound of a function near the point p of a sample. F and G are the changes of f and g from
their values at p to those at a point at the distance s from p; so the change of the product is
f G + g F + F G.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmin, safe_norm
from harnack.enclosures.promises import Lipschitz, Promise, TaylorRemainder
from harnack.enclosures.samples import Sample
from harnack.enclosures.sums import (
    PROOF_ROUNDING,
    ROUNDINGS_LEFT_OUT,
    lipschitz_promise,
    shared_radii,
    taylor_constant,
    value_error,
)

if TYPE_CHECKING:
    from harnack.backend import Real

# Where bounds of both functions hold everywhere, those of the product are computed on balls with
# these multiples of the length on which a slope may double.
_DOUBLINGS = (0.5, 2.0)


def product_sample(f: Sample, g: Sample) -> Sample:
    """Return the sample of f g, from those of f and g at one point.

    Proof of the errors. The samples may leave out eight units in the last place of their values,
    which are counted here. With the errors a and b of f and g, the error of the product is at most
    |f| b + |g| a + a b, and that of the gradient is bounded likewise. The promises of f and g hold
    up to the errors of their values. So the term F G of the change of the product has an error of
    at most a |G| + b |F|, which grows as s. It is counted as an error of the gradient.
    """
    value, gradient = f.value * g.value, f.value * g.gradient + g.value * f.gradient
    f_error, g_error = value_error(f), value_error(g)
    f_size, g_size = dr.abs(f.value) + f_error, dr.abs(g.value) + g_error
    f_slope, g_slope = safe_norm(f.gradient), safe_norm(g.gradient)
    promises, alternatives = _promises(f, g, f_size, g_size)
    epsilon = 2 * float(dr.epsilon(type(value)))
    slack = 1 + PROOF_ROUNDING
    # What is lost of products below the smallest normal number.
    underflow = 8 * float(dr.smallest(type(value)))
    error = (f_size * g_error + dr.abs(g.value) * f_error) * slack + underflow
    gradient_error = f_size * g.gradient_error + g_size * f.gradient_error
    for error_of_one, other, slope in ((f_error, g, g_slope), (g_error, f, f_slope)):
        gradient_error = gradient_error + error_of_one * _steepest(other, slope, promises)
    rounding = (ROUNDINGS_LEFT_OUT + 2) * epsilon * (f_size * g_slope + g_size * f_slope)
    truncation = f_size * g.truncation_error + g_size * f.truncation_error
    return Sample(
        value,
        gradient,
        promises,
        error,
        (gradient_error + rounding) * slack,
        truncation_error=fmin(truncation, error),
        alternative_promises=alternatives,
    )


def _steepest(sample: Sample, slope: Real, promises: tuple[Promise, ...]) -> Real:
    """Return a bound of |F|/s on the largest ball of the promises of a product, where F is the
    change of a factor; the length of its gradient, if it has no bound of Taylor's remainder.

    slope: the length of the gradient.
    """
    radius = promises[-1].radius if promises else dr.inf
    constant = taylor_constant(sample, radius)
    growth = 0.5 * radius * constant
    return slope + dr.select(dr.isfinite(0 * slope + growth), growth, 0)


def _promises(
    f: Sample, g: Sample, f_size: Real, g_size: Real
) -> tuple[tuple[Promise, ...], tuple[Promise, ...]]:
    """Return the promises of f g, and its alternative promises, which proved shorter steps.

    f_size, g_size: bounds of |f| and |g| at the point.
    """
    taylor = _taylor_remainders(f, g, f_size, g_size)
    lipschitz = _lipschitz(f, g, f_size, g_size)
    others = () if lipschitz is None else (lipschitz,)
    return (taylor, others) if taylor else (others, ())


def _taylor_remainders(
    f: Sample, g: Sample, f_size: Real, g_size: Real
) -> tuple[TaylorRemainder, ...]:
    """Return bounds of Taylor's remainder of f g on balls of a few radii; none if there is none of
    f or of g.

    Proof. Let C and D bound the remainders of f and g on a ball of radius r, as C s^2/2 and D
    s^2/2. With a = |grad f| and b = |grad g|, |F| <= (a + C r/2) s and |G| <= (b + D r/2) s on it.
    The gradient of f g is f grad g + g grad f. So the remainder of f g is at most |f| D s^2/2 + |g|
    C s^2/2 + |F G|, which is (|f| D + |g| C + 2 (a + C r/2) (b + D r/2)) s^2/2. The errors of the
    values and gradients are part of the errors of the sample.
    """
    radii = shared_radii((f, g))
    if radii is None:
        return ()
    f_slope = safe_norm(f.gradient) + f.gradient_error
    g_slope = safe_norm(g.gradient) + g.gradient_error
    if not radii:
        doubling: Real = dr.inf
        for sample, slope in ((f, f_slope), (g, g_slope)):
            constant = taylor_constant(sample, 0 * slope)
            doubling = fmin(dr.select(constant > 0, slope / constant, dr.inf), doubling)
        # Two constant functions, or functions that are linear.
        doubling = dr.select(dr.isfinite(doubling), doubling, 1)
        radii = [multiple * doubling for multiple in _DOUBLINGS]
    remainders: list[TaylorRemainder] = []
    for radius in radii:
        f_constant, g_constant = taylor_constant(f, radius), taylor_constant(g, radius)
        half = 0.5 * radius
        product = dr.fma(half, f_constant, f_slope) * dr.fma(half, g_constant, g_slope)
        constant = f_size * g_constant + g_size * f_constant + 2 * product
        remainders.append(TaylorRemainder(constant * (1 + PROOF_ROUNDING), radius))
    return tuple(remainders)


def _lipschitz(f: Sample, g: Sample, f_size: Real, g_size: Real) -> Lipschitz | None:
    """Return a bound of |f g (y) - f g (p)|/|y - p| on a ball about p; None if none follows.

    Proof. With |F| <= K s and |G| <= L s for s < r, |f G + g F + F G| <= (|f| L + |g| K + K L r) s.
    If both hold everywhere, r is the length on which the last term is as large as the others.
    """
    first, second = lipschitz_promise(f), lipschitz_promise(g)
    if first is None or second is None:
        return None
    constant = f_size * second.constant + g_size * first.constant
    both = first.constant * second.constant
    radius = fmin(first.radius, second.radius)
    if isinstance(radius, float):  # infinite
        radius = dr.select(both > 0, constant / both, 1)
    else:
        radius = dr.select(dr.isfinite(radius), radius, 1)
    return Lipschitz((constant + both * radius) * (1 + PROOF_ROUNDING), radius)
