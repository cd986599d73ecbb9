"""How much a bounded Laplacian moves f: the kernel's norm, bounded by a proof on a computer.

With G the Green function of the unit ball, x = q v, A = (1+3q^2)/(1-q^2)^2 and
B = (3q+q^3)/(1-q^2)^2, what `harnack.enclosures.BoundedLaplacianEnclosure` rests on is, for all 0 <
q < 1,

    kappa(q) = integral |-G(x,.) + A G(0,.) + (B/3) d_v G(0,.)| dy
             <= constant q^2 (2 + ln(1/q)) / (1-q^2)^2.

In y = q t w, |w| = 1, mu = w.v, with delta^2 = 1+t^2-2t mu, e^2 = 1-2q^2 t mu+q^4 t^2, b = B/(3q):

    kappa/q^2 = 1/2 integral over 0 < t < 1/q of |F|,      |F| = integral of |F(t, mu)| over mu,
    F = -t^2/delta + A t + b mu + q t^2/e - q A t^2 - b q^3 t^3 mu
      = (A-1) t (1-qt) + (b-1) mu (1-(qt)^3) - sum over l >= 2 of t^(1-l) (1-(qt)^(2l+1)) P_l(mu),

the last for t > 1. Three facts make that a proof.

1.  F is concave in mu (-1/delta + q/e is -(c-x)^(-1/2) + (d-x)^(-1/2) with c <= d), so it is
    positive on one interval, and |F| follows from an antiderivative and two zeros (`_norm`).
2.  A function t -> F(t) whose second derivative is at most M in the norm lies within
    M (t-t_i)(t_(i+1)-t)/2 of its chord, so |F| is at most the chord of its norms plus that:
    trapezoids plus M h^3/12 bound the integral from above. A t + b mu drops out of M; the rest
    are series of Legendre polynomials, of which |P_l| <= 2/sqrt(2l+1) (Cauchy and Schwarz).
3.  The same in q, at fixed t: between q_a and q_b, kappa/q^2 is at most the chord of its values
    plus D (q_b-q_a)^2/8 (`_between`), and the same chord bounds the right side from below.

Below the table, F is compared with its limit for q = 0 where t < T and with its terms of degree
0 and 2 beyond (`below`); above it |-G + ...| <= |G| + |...| suffices (`above`).

All of it in double precision, each step with some 1e3 units in the last place to spare.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from harnack.backend import FloatArray

__all__ = ["Proof", "kappa_ratio"]

_Function: TypeAlias = Callable[[FloatArray], FloatArray]

# Bounds of the integrals of |P_0|, |P_1| and |P_l|, l >= 2, over [-1, 1]; that of |P_2| itself.
_P0, _P1, _P = 2.0, 1.0, 2 / math.sqrt(5)
_P2 = 4 / math.sqrt(27)
_ROUNDING = 1e-13  # a norm is a sum of a dozen terms of at most 4 A (1+t)^2, each within 4 ulp


@dataclass(frozen=True)
class Proof:
    """A proof of kappa <= constant q^2 (2 + ln(1/q))/(1-q^2)^2, or its failure.

    constant: what is claimed. first, last: where the table begins and ends. step: its widths,
    relative to q and 1-q. cell: widths of cells in t, relative to t and |t-1|.
    """

    constant: float
    first: float = 0.005
    last: float = 0.87
    step: float = 0.015
    cell: float = 0.05

    def claim(self, q: float) -> float:
        """What is claimed of kappa/q^2."""
        return self.constant * (2 - math.log(q)) / (1 - q * q) ** 2

    def holds(self) -> bool:
        """Whether the claim is proved for all q in (0, 1), and what makes its crossing unique."""
        return self.below() and self.above() and self.table_margin() > 0 and self.is_convex()

    def table_margin(self) -> float:
        """The least of claim/bound - 1 over the intervals of the table; positive if proved."""
        nodes = self._nodes()
        norms = [kappa_ratio(q, self.cell) for q in nodes]
        least = math.inf
        for i, (a, b) in enumerate(itertools.pairwise(nodes)):
            more = _between(a, b)
            # The claim lies below its chord by at most this.
            d = 1 / (1 - b * b)
            bend = (2 - math.log(a)) * (4 * d**3 + 24 * b * b * d**4) + d * d / (a * a)
            less = self.constant * bend * (b - a) ** 2 / 8
            for q, norm in ((a, norms[i]), (b, norms[i + 1])):
                least = min(least, (self.claim(q) - less) / (norm + more) - 1)
        return least

    def _nodes(self) -> list[float]:
        nodes = [self.first]
        while nodes[-1] < self.last:
            q = nodes[-1]
            nodes.append(q + self.step * min(q, 1 - q))
        return nodes

    def below(self, inner: float = 10.0, middle: float = 0.05) -> bool:
        """Whether the claim holds for 0 < q <= first: kappa/q^2 <= C + (|P_2|/2) ln(1/q).

        For t < inner F is that of q = 0 up to at most 2 (A-1) t + (b-1) + ..., beyond it is
        q [-(1-r^5) P_2/r + 5 r (1-r)] with r = qt, up to terms of degrees 1 and l >= 3 and what
        (A-1)/q^2 exceeds 5 by. Below r = middle both parts of that are taken by themselves. All
        of C grows with q, and the constant is larger than |P_2|/2.
        """
        q = self.first
        assert q * inner <= middle
        assert self.constant > _P2 / 2
        a, b = _coefficients(q)
        total = _integral(0.0, inner, self.cell)
        total += 0.5 * ((a - 1) * inner**2 + (b - 1) * inner)
        total += 0.5 * _P * q**5 * inner**5 / (5 * (1 - q * q * inner))
        total += _middle_integral(middle) + 2.5 * middle**2
        total += 0.5 * _P2 * math.log(middle / (q * inner))
        total += ((a - 1) / (q * q) - 5) / 6 + 0.5 * (b - 1) / q
        # Degrees l >= 3: 1/2 |P_l| inner^(2-l)/(l-2), and |P_3| = 0.65.
        total += 0.5 * 0.65 / inner + 0.25 * _P * inner**-2 / (1 - 1 / inner)
        return total <= self.constant * (2 - math.log(q))

    def above(self, cells: int = 4000) -> bool:
        """Whether it holds for last <= q < 1.

        The integral of G(x,.) is (1-q^2)/6, and with s = B (1+r+r^2)/3 that of |A r + s mu| over mu
        at most s + (A r)^2/s, where 1/(1+r+r^2) leaves an integral in closed form.
        """
        rest = 1.5 - 0.5 * math.log(3) - math.pi / math.sqrt(12)
        q = np.linspace(self.last, 1, cells + 1)
        low, high = q[:-1], q[1:]
        a, b_high, b_low = 1 + 3 * high**2, 3 * high + high**3, 3 * low + low**3
        norm = (1 - low**2) ** 3 / 6 + 0.5 * (b_high / 4 + 3 * rest * a * a / b_low)
        return bool((norm < self.constant * low**2 * (2 - np.log(low))).all())

    def is_convex(self, slope_norm: float | None = None, cells: int = 4000) -> bool:
        """Whether what is claimed, less `slope_norm` times B, is convex in q.

        slope_norm: by default that of G(0,.) + d_v G(0,.)/3, 1/8 + (3/2) rest as in `above`.
        The second derivative of n(q)/(1-q^2)^2 times (1-q^2)^4 is
        n'' (1-q^2)^2 + 8 q n' (1-q^2) + n (4 + 20 q^2). For n = q^2 (2 - ln q), and for 3q + q^3,
        each factor is positive and monotone, so cells of q are compared end by end.
        """
        rest = 1.5 - 0.5 * math.log(3) - math.pi / math.sqrt(12)
        norm = 1 / 8 + 1.5 * rest if slope_norm is None else slope_norm
        q = np.geomspace(1e-9, 1, cells + 1)
        q = np.unique(np.concatenate([q, np.linspace(0.001, 1, cells)]))
        a, b = q[:-1], q[1:]
        near, far = 1 - a * a, 1 - b * b
        log_a, log_b = 2 - np.log(a), 2 - np.log(b)  # n' = q (2 log - 1), n'' = 2 log - 3
        less = (2 * log_b - 3) * far**2 + 8 * a * a * (2 * log_a - 1) * far
        less += a * a * log_a * (4 + 20 * a * a)
        more = 6 * b * near**2 + 8 * b * (3 + 3 * b * b) * near + (3 * b + b**3) * (4 + 20 * b * b)
        # Below the first cell n'' alone, which is larger still, is enough.
        start = self.constant * (2 * log_a[0] - 3) * near[0] ** 2 > norm * more[0]
        return bool(start and (self.constant * less > norm * more).all())


def kappa_ratio(q: float, cell: float) -> float:
    """An upper bound of kappa/q^2 at one q, above it by a few thousandths of cell^2 or so."""
    return _integral(q, 1 / q, cell)


def _coefficients(q: float) -> tuple[float, float]:
    """A and b."""
    d = 1 / (1 - q * q) ** 2
    return (1 + 3 * q * q) * d, (1 + q * q / 3) * d


def _integral(q: float, end: float, cell: float) -> float:
    """An upper bound of half the integral of |F| over 0 < t < end, which is at most 1/q."""
    closest = 1e-6  # around t = 1 the norm is taken by its parts
    t = 1 - np.geomspace(1, closest, math.ceil(-math.log(closest) / cell))
    beyond = 1 + np.geomspace(closest, end - 1, math.ceil(math.log((end - 1) / closest) / cell))
    beyond[-1] = end
    total = 0.0
    a, b = _coefficients(q)
    for nodes in (t, beyond):
        low, high = nodes[:-1], nodes[1:]
        z = q * q * high
        bend = 4 * q * (a - 1) + 6 * (b - 1) * q**3 * high
        bend = bend + q * _P * (2 / (1 - z) ** 3 - 2 - 6 * z)
        if nodes is t:
            bend = bend + 2 * _P0 + 6 * high * _P1 + _P * (2 / (1 - high) ** 3 - 2 - 6 * high)
        else:
            bend = bend + _P * 2 / (low - 1) ** 3
        norm, h = _norm(q, nodes), high - low
        total += float((0.5 * h * (norm[:-1] + norm[1:]) + bend * h**3 / 12).sum())
    # There t is 1 to within `closest`, and the integrals of 1/delta and 1/e are at most 2.
    total += 2 * closest * 1.01 * (2 + 2 * a + b + 2 * q * (1 + a) + b * q**3)
    return 0.5 * total * (1 + 1e-12)


def _norm(q: float, t: FloatArray) -> FloatArray:
    """The integral of |F(t, mu)| over mu: not below it."""
    a, b = _coefficients(q)

    def root(mu: FloatArray) -> FloatArray:
        return np.sqrt((1 - t) ** 2 + 2 * t * (1 - mu))

    def image(mu: FloatArray) -> FloatArray:
        return np.sqrt(1 - 2 * q * q * t * mu + q**4 * t * t)

    def value(mu: FloatArray) -> FloatArray:
        smooth = a * t + q * t * t * (1 / image(mu) - a)
        return smooth + b * mu * (1 - (q * t) ** 3) - t * t / np.maximum(root(mu), 1e-300)

    def slope(mu: FloatArray) -> FloatArray:
        smooth = b * (1 - (q * t) ** 3) + (q * t / image(mu)) ** 3
        return smooth - (t / np.maximum(root(mu), 1e-100)) ** 3

    def antiderivative(mu: FloatArray) -> FloatArray:
        far = t * (2 * q * t * mu - q**3 * t * t) / (image(mu) + 1)
        smooth = a * t * mu * (1 - q * t) + 0.5 * b * mu * mu * (1 - (q * t) ** 3)
        return smooth + far + t * root(mu)

    def bisect(sign: float, low: FloatArray, high: FloatArray, of: _Function) -> FloatArray:
        for _ in range(52):
            middle = 0.5 * (low + high)
            is_right = sign * of(middle) < 0
            low, high = np.where(is_right, middle, low), np.where(is_right, high, middle)
        return 0.5 * (low + high)

    ends = -np.ones_like(t), np.ones_like(t)
    top = bisect(-1.0, *ends, slope)
    left, right = bisect(1.0, ends[0], top, value), bisect(-1.0, top, ends[1], value)
    is_positive = value(top) > 0
    left, right = np.where(is_positive, left, top), np.where(is_positive, right, top)
    inside = antiderivative(right) - antiderivative(left)
    whole = antiderivative(ends[1]) - antiderivative(ends[0])
    return np.abs(2 * inside - whole) + _ROUNDING * a * (1 + t) ** 2


def _between(low: float, high: float) -> float:
    """How far kappa/q^2 rises at most above its chord for low <= q <= high.

    Where t < 1/high: D (high-low)^2/8, with D half the integral of |d^2 F/dq^2|; A-1, q (A-1),
    b-1, q^3 (b-1) are power series in q without negative coefficients, so that D is largest at
    `high`. For 1/high < t < 1/q, where F vanishes at the end: 1-(qt)^k <= k (1-qt).
    """
    end, q = 1 / high, high
    degree = np.arange(2, 2000)  # what is left out is below 1e-100 for q < 0.88
    even, odd = degree[degree % 2 == 0], degree[(degree % 2 == 1)]
    # A - 1 = sum of (2l+1) q^l over even l >= 2, b - 1 = sum of (2l+1)/3 q^(l-1) over odd l >= 3.
    second_a = ((2 * even + 1) * even * (even - 1) * q ** (even - 2.0)).sum()
    second_qa = ((2 * even + 1) * (even + 1) * even * q ** (even - 1.0)).sum()
    second_b = ((2 * odd + 1) / 3 * (odd - 1) * (odd - 2) * q ** (odd - 3.0)).sum()
    second_qb = ((2 * odd + 1) / 3 * (odd + 2) * (odd + 1) * q**odd).sum()
    total = second_a * end**2 + second_qa * 2 * end**3 / 3 + second_b * end
    total += second_qb * end**4 / 4
    norm = 2 / np.sqrt(2 * degree + 1)
    total += ((2 * degree + 1) * 2 * degree * q ** (degree - 4.0) * norm / (degree + 3)).sum()
    chord = 0.5 * total * (high - low) ** 2 / 8

    a, b = _coefficients(high)
    x = high  # 1/t, at most; sqrt(2l+1) <= sqrt(5) l/2
    size = 2 * (a - 1) / low + 3 * (b - 1) + math.sqrt(5) * (1 / (1 - x) ** 2 - 1)
    shell = 0.5 * size * 0.5 * (1 - low / high) * (1 / low - 1 / high)
    return float((chord + shell) * (1 + 1e-9))


def _middle_integral(start: float, cells: int = 4000) -> float:
    """Half the integral of |-(1-r^5) P_2/r + 5 r (1-r)| over start < r < 1, in mu and r."""
    r = np.geomspace(start, 1, cells + 1)
    level, size = 5 * r * (1 - r), (1 - r**5) / r
    share = level / np.maximum(size, 1e-300)
    zero = np.minimum(np.sqrt((2 * share + 1) / 3), 1)

    def antiderivative(mu: FloatArray) -> FloatArray:
        return level * mu - 0.5 * size * (mu**3 - mu)

    norm = 2 * (2 * antiderivative(zero) - antiderivative(np.ones_like(r)))
    low, high = r[:-1], r[1:]
    bend = (2 / low**3 + 12 * high**2) * _P2 + 10 * _P0
    h = high - low
    return 0.5 * float((0.5 * h * (norm[:-1] + norm[1:]) + bend * h**3 / 12).sum()) * (1 + 1e-12)
