"""The longest steps that can be proved, by bisection in double precision on the host.

Each is the place where an extremal function of the proof reaches a level, so a bound that steps
further is wrong and one that steps less far gives something away. Nothing here is taken from
`harnack.enclosures` but the classes that say which proof is meant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, to_numpy
from harnack.enclosures import (
    BoundedLaplacian,
    Enclosure,
    HarmonicBall,
    Lipschitz,
    Promise,
    TaylorRemainder,
)
from harnack.enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from harnack.enclosures.harmonic_ball import (
    HarnackEnclosure,
    HarnackSlopeEnclosure,
    SphericalCapEnclosure,
)
from harnack.enclosures.parabola import LipschitzEnclosure, TaylorEnclosure
from harnack.testing.enclosure_contracts import PromiseCase
from harnack.testing.poisson import cap_movement, kernel_difference

__all__ = ["BOUNDS", "exact_step", "on_host"]


def exact_step(kind: type[Enclosure], case: PromiseCase, slope: FloatArray) -> FloatArray:
    """The longest step (n,) that this proof allows from a case of NumPy arrays (n,).

    No longer than the radius. Raises TypeError for a proof whose extremal functions are not
    known here.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for bound, (promised, step) in _EXACT.items():
            if issubclass(kind, bound) and isinstance(case.promise, promised):
                return step(case.promise, case, slope)
    raise TypeError(f"no exact step is known for {kind.__name__} and {case.promise}")


def on_host(case: PromiseCase, lanes: int) -> PromiseCase:
    """The same case with NumPy arrays (lanes,) in the place of numbers and Dr.Jit arrays."""

    def host(value: object) -> FloatArray:
        array = to_numpy(value) if dr.is_array_v(value) else np.asarray(value)
        return np.broadcast_to(array.astype(np.float64), (lanes,))

    return case.map_numbers(host)


def largest_free(movement: Callable[[FloatArray], FloatArray], gap: FloatArray) -> FloatArray:
    """The q in [0, 1] at which `movement` first exceeds the gap, which it does at most once."""
    low, high = np.zeros_like(gap), np.ones_like(gap)
    for _ in range(110):
        middle = 0.5 * (low + high)
        free = movement(middle) <= gap
        low, high = np.where(free, middle, low), np.where(free, high, middle)
    return low


def _parabolas(known: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    """Second derivatives of plus and minus the constant."""
    h = known.constant
    # An infinite radius is replaced by one within which a level is surely met.
    down, up = np.minimum(c.gap_below, 1e30), np.minimum(c.gap_above, 1e30)
    steep = np.abs(slope)
    with np.errstate(divide="ignore", invalid="ignore"):
        bent: FloatArray = 4 * (steep / h + np.sqrt(2 * np.minimum(down, up) / h))
        straight: FloatArray = 2 * np.maximum(down, up) / steep
        r: FloatArray = np.minimum(known.radius, np.where(h > 0, bent, straight))

    def rise(q: FloatArray) -> FloatArray:
        return slope * q * r + 0.5 * h * (q * r) ** 2

    def fall(q: FloatArray) -> FloatArray:
        return -slope * q * r + 0.5 * h * (q * r) ** 2

    return r * np.minimum(largest_free(rise, c.gap_above), largest_free(fall, c.gap_below))


def _green(known: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    """Mass at the poles, and a density of the kernel's sign, with the constant that is proved."""
    square, below, above = known.radius**2, -known.lower, known.upper
    mean = 0.5 * square * (known.laplacian_lower + known.laplacian_upper)
    spread = 0.5 * square * (known.laplacian_upper - known.laplacian_lower)
    norm = 0.1907  # of G(0,.) + d_v G(0,.)/3, rounded up: see `green_kernel.Proof.convex`
    reach: list[FloatArray] = []
    for u, most, sign, gap in (
        (below, above, 1.0, c.gap_above),
        (above, below, -1.0, c.gap_below),
    ):
        w, m = np.maximum(u + sign * mean / 6, 0), np.maximum(sign * mean, 0)
        s = np.clip(sign * known.radius * slope / 3, -w - norm * spread, w + norm * spread)

        def movement(
            q: FloatArray, w: FloatArray = w, m: FloatArray = m, s: FloatArray = s
        ) -> FloatArray:
            square = q * q
            top = w * (5 * square - square**2) + s * (3 * q + q**3)
            top += 0.394 * spread * square * (2 - np.log(np.maximum(q, 1e-300)))
            return top / (1 - square) ** 2 + m * square / 6

        reach.append(np.where(gap > most, 1.0, largest_free(movement, gap)))
    return known.radius * np.minimum(*reach)


def _sides(ball: Any, c: PromiseCase) -> list[tuple[FloatArray, float, FloatArray, FloatArray]]:
    """(u, sign, gap away from the end, gap towards it) of the positive functions u at p."""
    sides: list[tuple[FloatArray, float, FloatArray, FloatArray]] = []
    if np.isfinite(ball.lower).any():
        sides.append((-ball.lower, 1.0, c.gap_above, c.gap_below))
    if np.isfinite(ball.upper).any():
        sides.append((ball.upper, -1.0, c.gap_below, c.gap_above))
    return sides


def _classic(ball: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    """Point masses at the poles."""
    del slope
    best = np.zeros_like(ball.radius)
    for u, _, away, toward in _sides(ball, c):
        n = ball.dimension
        up = largest_free(lambda q, n=n, u=u: u * _poles_movement(q, 1.0, n), away)
        down = largest_free(lambda q, n=n, u=u: -u * _poles_movement(q, -1.0, n), toward)
        best = np.maximum(best, np.minimum(up, down))
    return ball.radius * best


def _slope(ball: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    """Two point masses at the poles; a ring of mass at one latitude."""
    n = ball.dimension
    reach = {1.0: np.zeros_like(ball.radius), -1.0: np.zeros_like(ball.radius)}
    for u, sign, away, toward in _sides(ball, c):
        m = np.where(u > 0, np.clip(sign * ball.radius * slope / (n * u), -1, 1), 0.0)
        chord = largest_free(lambda q, m=m, u=u: u * _poles_movement(q, m, n), away)
        jensen = largest_free(lambda q, m=m, u=u: -u * kernel_difference(q, m, n), toward)
        reach[sign] = np.maximum(reach[sign], chord)
        reach[-sign] = np.maximum(reach[-sign], jensen)
    return ball.radius * np.minimum(reach[1.0], reach[-1.0])


def _caps(ball: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    """Two caps on the axis, and all but two caps."""
    below, above = -ball.lower, ball.upper
    span = below + above
    reach: list[FloatArray] = []
    for near, far, sign, gap in (
        (below, above, 1.0, c.gap_above),
        (above, below, -1.0, c.gap_below),
    ):
        p, rest = near / span, far / span
        shift = np.where(rest > 0, sign * ball.radius * slope / (3 * span * rest), 0.0)
        shift = np.clip(shift, -p, p)

        def up(
            q: FloatArray, p: FloatArray = p, rest: FloatArray = rest, shift: FloatArray = shift
        ) -> FloatArray:
            two_caps = cap_movement(q, p + shift, 3) + cap_movement(-q, p - shift, 3)
            is_thin = (rest < 0.01) & (q < 0.5)
            return span * np.where(is_thin, -_belt(q, -shift, rest), two_caps)

        reach.append(largest_free(up, gap))
    return ball.radius * np.minimum(reach[0], reach[1])


def _poles_movement(q: npt.ArrayLike, mean: npt.ArrayLike, dimension: int) -> FloatArray:
    """(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1) - 1.

    With P(q, +-1) = exp(S +- D), S = (1-n/2) log(1-q^2) and D = n artanh(q), it is
    exp(S) (cosh D + m sinh D) - 1.
    """
    q, m = np.asarray(q, np.float64), np.asarray(mean, np.float64)
    log_square, odd = (1 - 0.5 * dimension) * np.log1p(-q * q), dimension * np.arctanh(q)
    # cosh D + m sinh D - 1 in two ways: the second does not cancel near m = -1.
    plain = 2 * np.sinh(0.5 * odd) ** 2 + m * np.sinh(odd)
    near_minus_one = (1 + m) * np.sinh(odd) + np.expm1(-odd)
    rest = np.where(m < -0.5, near_minus_one, plain)
    return np.expm1(log_square) + np.exp(log_square) * rest


def _belt(q: FloatArray, middle: FloatArray, half: FloatArray) -> FloatArray:
    """The movement of the indicator of |s - middle| <= half, for small half, by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    total = np.zeros_like(q)
    for x, w in zip(nodes, weights, strict=True):
        total += 0.5 * w * half * kernel_difference(q, np.clip(middle + half * x, -1, 1), 3)
    return total


def _cone(known: Any, c: PromiseCase, slope: FloatArray) -> FloatArray:
    del slope
    return np.minimum(np.minimum(c.gap_below, c.gap_above) / known.constant, known.radius)


# Of each proof the kind of promise it is made of, and the longest step from such a promise with
# these gaps along these slopes: a new proof goes in here.
_EXACT: dict[
    type[Enclosure], tuple[type[Promise], Callable[[Any, PromiseCase, FloatArray], FloatArray]]
] = {
    HarnackEnclosure: (HarmonicBall, _classic),
    HarnackSlopeEnclosure: (HarmonicBall, _slope),
    SphericalCapEnclosure: (HarmonicBall, _caps),
    BoundedLaplacianEnclosure: (BoundedLaplacian, _green),
    LipschitzEnclosure: (Lipschitz, _cone),
    TaylorEnclosure: (TaylorRemainder, _parabolas),
}
BOUNDS = tuple(_EXACT)
