"""How large the terms of a multipole expansion are at most, and what leaving terms out may cost."""

# Harmonics have degree l.
# ruff: noqa: E741

from __future__ import annotations

import math

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.multipoles.moments import KNOWN
from harnack.fields.multipoles.multipole import Moments, NodeMoments
from harnack.fields.sums import longest_part, remainder_factor

# A bound that is rounded to single precision a few times, down each time, is one still.
_ROOM = 1 + 2.0**-20


def sup_norm(moments: Moments, l: int) -> FloatArray:
    """A bound of |term l| r^(l+1) over all directions.

    For unit x, y the addition theorem gives sum_m |I_lm(x)|^2 / ((l+m)!(l-m)!) = P_l(1) = 1, so
    by Cauchy and Schwarz |sum_m conj(M_lm) I_lm|^2 <= sum_m (l+m)! (l-m)! |M_lm|^2.
    """
    total = 0.0
    for m in range(l + 1):
        weight = math.factorial(l + m) * math.factorial(l - m) * (1 if m == 0 else 2)
        total = total + weight * np.abs(moments[l, m]) ** 2
    return np.sqrt(np.asarray(total))


def truncation(
    level: NodeMoments, nearest: FloatArray, order: int = 2
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(E, G, H): seen from r >= nearest, what the terms l >= order + 2 =: k add to f is at most
    E/r^(k+1) in value, G/r^(k+2) in gradient and H/r^(k+3) in second derivatives along lines.

    A dipole of area a at d gives the term l at most a l |d|^(l-1)/r^(l+1): on the sphere
    rho^l P_l is a trigonometric polynomial of degree l along each great circle, so by Bernstein's
    and Szego's inequality its gradient is at most l rho^(l-1). Terms up to 5 are known exactly and
    bounded by `sup_norm`; for the rest |d|^(l-1) <= R^(l-5) |d|^4 and
    sum_{l>=6} l q^(l-5) = q (6 - 5q)/(1-q)^2 with q = R/r. A harmonic function of degree
    -(l+1) has, by the same inequality, a gradient of at most l+1 times its largest value on the
    sphere through the point; the rest is then sum_{l>=6} l (l+1) q^(l-5)
    = q (42 - 70q + 30q^2)/(1-q)^3. Its derivatives along lines are harmonic of degree -(l+2), so
    that second ones are at most (l+1)(l+2) times it, and sum_{l>=6} l (l+1) (l+2) q^(l-5)
    = q (336 - 840q + 720q^2 - 210q^3)/(1-q)^4. Each term times r^(k+1) (r^(k+2), r^(k+3)) falls or
    stays as r grows, so the value at `nearest` serves. A little is added, for single precision to
    take away.
    """
    r = np.maximum(nearest, 1e-50)  # of which powers can be taken
    q = np.minimum(level.radius / r, 0.99)
    k = order + 2
    rest = level.fourth * level.radius / r ** (6 - k)
    value = rest * (6 - 5 * q) / (1 - q) ** 2
    slope = rest * (42 - 70 * q + 30 * q * q) / (1 - q) ** 3
    second = rest * (336 - 840 * q + 720 * q * q - 210 * q**3) / (1 - q) ** 4
    for l in range(k, KNOWN + 1):
        term = sup_norm(level.moments, l) / r ** (l - k)
        value, slope, second = (
            value + term,
            slope + (l + 1) * term,
            second + (l + 1) * (l + 2) * term,
        )
    return _ROOM * value, _ROOM * slope, _ROOM * second


def bend_columns(level: NodeMoments, rough: float) -> tuple[FloatArray, FloatArray]:
    """A and K (k,) of nodes that are seen from beyond r0 = `rough` times their radius R.

    From there on a step by t = q r, q <= Q = `longest_part(rough)`, moves a node's field off the
    linear by at most

        (A + K/r^2) t^2/r^4 Phi_1(q),   Phi_l(q) = ((1-q)^-(l+1) - 1 - (l+1)q)/q^2.

    The term l, a harmonic function of degree -(l+1), is at most B_l/r^(l+1), and its k-th
    derivative along a line (l+k)!/l! B_l/r^(l+1+k) (`truncation.truncation`, k times). So Taylor's
    remainder is at most B_l Phi_l(q) t^2/r^(l+3). In Phi_l/Phi_1 the ratio of coefficients,
    (l+k)!/(l! (k+1)!), grows with k, so that the quotient grows with q: W_l = Phi_l(Q)/Phi_1(Q)
    serves. With r >= r0: A = B_1 + W_2 B_2/r0 and K = sum_{l>=3} W_l B_l/r0^(l-3), for l >= 6 of
    B_l <= l R^(l-5) sum a |d|^4, with Phi_l(Q) < (1-Q)^-(l+1)/Q^2.
    """
    r0, q = np.maximum(rough * level.radius, 1e-50), longest_part(rough)
    first = q * q * remainder_factor(q)
    ratio = [((1 - q) ** -(n + 1) - 1 - (n + 1) * q) / first for n in range(KNOWN + 1)]
    terms = [ratio[n] * sup_norm(level.moments, n) for n in range(1, KNOWN + 1)]
    x = 1 / (rough * (1 - q))
    rest = x * (6 - 5 * x) / (1 - x) ** 2 / ((1 - q) ** 6 * first)
    wide = rest * level.fourth / r0**2 + sum(term / r0**n for n, term in enumerate(terms[2:]))
    return terms[0] + terms[1] / r0, wide
