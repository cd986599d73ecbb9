"""The largest stretch that an enclosure proves free, found from the safe side.

Enclosures are exact at p, so they are written as f(p) + q k(q) with q = t/R: the movement
q k(q) is compared with the gap to the level, and nothing large is ever subtracted. Near a
surface the gap is tiny, and an answer found to an absolute accuracy would stall the march; this
solver is accurate relative to the answer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import clamp, fmax

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

# The open ball: at q = 1 the enclosures are 0 * inf.
LARGEST_FRACTION = 1.0 - 1e-5
# The last candidate is pulled back this far so that it ends on the safe side of the root.
PULL_BACK = 1.0 - 2e-6


def largest_covered(movement: Callable[[Real], Real], gap: Real, start: Real, rounds: int) -> Real:
    """The largest q in [0, 1) with q k(q) <= gap, to about 1e-5 relative, never beyond it.

    `movement` is k, with the property that q k(q) crosses each gap > 0 upwards at most once, and
    `start` a q that is known to be safe (a coarser closed-form proof).

    Why it is safe: only a q at which q k(q) <= gap was *evaluated* is returned, or `start`; by
    the single crossing, all smaller q are then safe too. The candidates only affect length:
    each solves the quadratic q (k_i + k' (q - q_i)) = gap, k' the secant slope of k through the
    last two points, which converges like the secant method.
    """
    zero = type(gap)(0)
    largest = type(gap)(LARGEST_FRACTION)
    safe = clamp(start, 0, LARGEST_FRACTION)
    unsafe = largest
    free = largest * movement(largest) <= gap
    previous_q, previous_k = zero, movement(zero)
    q, k = fmax(safe, 1e-9), movement(fmax(safe, 1e-9))
    for i in range(rounds):
        candidate = _next(q, k, previous_q, previous_k, gap)
        candidate = clamp(candidate, safe, unsafe)
        candidate = candidate * PULL_BACK if i == rounds - 1 else candidate
        previous_q, previous_k = q, k
        q, k = candidate, movement(candidate)
        good: Mask = q * k <= gap
        safe = dr.select(good & (q > safe), q, safe)
        unsafe = dr.select(good, unsafe, q)
    return dr.select(free, largest, safe)


def _next(q: Real, k: Real, previous_q: Real, previous_k: Real, gap: Real) -> Real:
    """The positive root of x (k + k' (x - q)) = gap with the secant slope k'."""
    run = q - previous_q
    slope = dr.select(run == 0, 0, (k - previous_k) / run)
    constant = dr.fma(-slope, q, k)
    root = dr.sqrt(fmax(dr.fma(constant, constant, 4 * slope * gap), 0))
    # Both forms are the root; each cancels where the other is used.
    rises = constant > 0
    above = dr.select(rises, 2 * gap, root - constant)
    below = dr.select(rises, constant + root, 2 * slope)
    candidate = above / below
    return dr.select((below > 0) & dr.isfinite(candidate), candidate, LARGEST_FRACTION)
