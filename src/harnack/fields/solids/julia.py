"""Quaternion Julia sets, with proved empty balls around points outside of them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.validation import as_finite, as_integer_in_range
from harnack.enclosures import Lipschitz
from harnack.fields.samples import Sample
from harnack.fields.solids.solid import Solid, ball_around

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

Quaternion = tuple[float, float, float, float]

# Radii of the balls, as fractions of the longest possible step.
_RADII = (0.8, 0.6, 0.45, 0.3, 0.15)
# Iterates beyond this absolute value have escaped; from there on only their logarithms are
# computed.
_FAR = {"single": 1e4, "double": 1e8}


@dataclass(frozen=True)
class Julia(Solid):
    """The points whose orbit under q -> q^2 + c stays small for a number of iterations.

    c: the constant, four numbers; the real part comes first.
    iterations: N. More of them show finer parts, and the solid shrinks to the Julia set.
    fourth_coordinate: the fourth coordinate; points of space are q = x + y i + z j + slice k.

    f = 2^-N max(log(|q_N|/B), -1), with B = (1 + sqrt(1 + 4 |c|))/2: from |q| > B on an orbit
    escapes, for |q|^2 - |c| > |q| there. So f <= 0 on the filled Julia set, for any N.

    Proof of the balls. In a ball of radius r, q_n changes by at most e_n, with e_0 = r and e_(n+1)
    = 2 |q_n| e_n + e_n^2, for squares of quaternions differ by d q + q d + d^2; and its derivative
    in any direction is at most d_n, with d_0 = 1 and d_(n+1) = 2 (|q_n| + e_n) d_n. So d_n/(|q_n| -
    e_n) is a bound g_n of the derivative of log|q_n| there. Besides, |q_n| >= m_n implies |q_(n+1)|
    >= m_n^2 - |c|, and g_(n+1) <= 2 g_n/(1 - |c|/m_n^2), for |q q' + q' q| <= 2 |q| |q'|; the
    better one is used. 2^-N g_N is a Lipschitz constant of f in the ball, and so is 2^-N d_N e/B,
    as f is cut off at |q| = B/e; one is promised for each of a few radii. The rounding of an
    iterate is one more such change: e_n with r = 0 bounds the error of q_n. A ball with |q_n| - e_n
    > B for some n <= N contains nothing of the solid. The usual |z| log|z| / (2 |z'|) is no bound
    of the distance.

    Where |q_n| > R (a large number) at n < N, f = 2^-n log|q_n| - 2^-N log B within 2^-n 2
    |c|/|q_n|^2: each later iterate adds 2^-(j+1) log|1 + c/q_j^2|, and these fall. If m_n >= 2 B
    there, later m_j at least double, and all factors 1/(1 - |c|/m_j^2) together are at most
    exp(4 |c|/m_n^2).
    """

    c: Quaternion = (-0.2, 0.8, 0.0, 0.0)
    iterations: int = 10
    fourth_coordinate: float = 0.0

    def __post_init__(self) -> None:
        try:
            numbers = tuple(self.c)
        except TypeError:
            numbers = ()
        if len(numbers) != 4:
            raise ValueError(f"c of a Julia set must be four numbers, not {self.c!r}")
        c = tuple(as_finite(one, "each part of c of a Julia set") for one in numbers)
        if not math.hypot(*c) <= 10.0:
            raise ValueError(f"c of a Julia set must be no longer than 10, not {self.c!r}")
        object.__setattr__(self, "c", c)
        count = as_integer_in_range(self.iterations, "the iterations of a Julia set", 1, 60)
        object.__setattr__(self, "iterations", count)
        object.__setattr__(
            self, "fourth_coordinate", as_finite(self.fourth_coordinate, "the slice of a Julia set")
        )

    @property
    def escape_radius(self) -> float:
        """B: an orbit that has left this radius never returns."""
        return 0.5 + math.sqrt(0.25 + math.hypot(*self.c))

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def prepare(self, backend: Backend) -> Julia:
        """The same with its numbers as kernel parameters of the backend."""
        made = copy.copy(self)
        size = math.hypot(*self.c)
        for name, value in (
            ("_c", self.c),
            ("_slice", self.fourth_coordinate),
            ("_size", size),
            ("_b", self.escape_radius),
        ):
            object.__setattr__(made, name, _data(backend, value))
        return made

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """Proof. Where |q_0| = B (1 + t), t > 0, |q_n| >= B (1 + (2B)^n t) by induction, for B^2 -
        |c| = B; so f <= level needs (2B)^N t <= exp(2^N level) - 1."""
        b, scaled = self.escape_radius, 2.0**self.iterations * level
        if above or scaled > 600.0:
            return None
        beyond = math.expm1(max(scaled, 0.0)) / (2.0 * b) ** self.iterations
        reach = b * (1.0 + beyond)
        across = reach * reach - self.fourth_coordinate * self.fourth_coordinate
        return ball_around((0.0, 0.0, 0.0), math.sqrt(max(across, 0.0)))

    def evaluate(self, p: Vec3) -> Sample:
        if not hasattr(self, "_c"):
            from harnack.backend import backend_of

            return self.prepare(backend_of(p)).evaluate(p)
        zero = 0 * p.x
        value, gradient, error, (steepest,) = self._orbit(p, (zero,))
        # No step is longer than this, as the constant of a ball is at least that at its center.
        longest = dr.abs(value) / steepest
        longest = clamp(dr.select(dr.isfinite(longest), longest, 1), 1e-6, self._parameter("_b"))
        radii = tuple(longest * one for one in _RADII)
        constants = self._orbit(p, radii)[3]
        known: list[Lipschitz] = []
        for radius, most in zip(radii, constants, strict=True):
            proved = (most >= 0) & (most < dr.inf)
            known.append(Lipschitz(dr.select(proved, most, 0), dr.select(proved, radius, 0)))
        return Sample(value, gradient, tuple(known), error)

    def _parameter(self, name: str) -> Any:
        return getattr(self, name)

    def _orbit(self, p: Vec3, radii: tuple[Real, ...]) -> tuple[Any, ...]:
        """f, its gradient, how far f is off, and bounds of |grad f| in balls; for the error
        to be that of rounding alone, the first radius is 0."""
        c, size, b = self._parameter("_c"), self._parameter("_size"), self._parameter("_b")
        real = cast("Any", type(p.x))
        single = dr.type_v(real) == dr.VarType.Float32
        far = _FAR["single" if single else "double"]
        unit = 2 * float(dr.epsilon(real))
        zero, one = 0 * p.x, 0 * p.x + 1
        q = [p.x, p.y, p.z, zero + self._parameter("_slice")]
        slopes = [one, zero, zero, zero, one, zero, zero, zero, one, zero, zero, zero]
        moved = [zero + r for r in radii]
        steep = [one for _ in radii]
        start = dr.sqrt(_squared_norm(q))
        least = [fmax(start * (1 - 4 * unit) - r, 0) for r in moved]
        rates = [1 / low for low in least]

        def body(n: Any, *state: Any) -> tuple[Any, ...]:
            q, slopes = list(state[:4]), state[4:16]
            moved, steep, least, rates = _split_in_four(state[16:])
            bent: list[Any] = [None] * 12
            for k in range(3):
                a, *v = (slopes[3 * i + k] for i in range(4))
                bent[k] = 2 * (q[0] * a - (q[1] * v[0] + q[2] * v[1] + q[3] * v[2]))
                for i in range(3):
                    bent[3 * (i + 1) + k] = 2 * (q[0] * v[i] + q[i + 1] * a)
            square = _squared_norm(q)
            norm = dr.sqrt(square) * (1 + 4 * unit)
            # Each part of q^2 + c is off by a few roundings of |q|^2 + |c|.
            rounded = 8 * unit * (square + size)
            across = q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
            new = [q[0] * q[0] - across + c[0], *(2 * q[0] * q[i] + c[i] for i in (1, 2, 3))]
            farther = [(2 * norm * e + e * e) * (1 + 8 * unit) + rounded for e in moved]
            steeper = [
                2 * (norm + e) * d * (1 + 8 * unit) for e, d in zip(moved, steep, strict=True)
            ]
            after = dr.sqrt(_squared_norm(new)) * (1 - 4 * unit)
            lows: list[Real] = []
            slower: list[Real] = []
            for e, d, low, rate in zip(farther, steeper, least, rates, strict=True):
                next_low = low * low * (1 - 4 * unit) - size
                share = 1 - size / (low * low) * (1 + 4 * unit)
                by_rate = dr.select(share > 0, 2 * rate / share * (1 + 4 * unit), dr.inf)
                lows.append(fmax(fmax(after - e, 0), next_low))
                slower.append(fmin(by_rate, d / fmax(after - e, 0) * (1 + unit)))
            return n + 1, *new, *bent, *farther, *steeper, *lows, *slower

        def goes_on(n: Any, *state: Any) -> Any:
            return (n < self.iterations) & (_squared_norm(state[:4]) <= far * far)

        index = dr.uint32_array_t(real)
        begin = (dr.zeros(index, dr.width(p)), *q, *slopes, *moved, *steep, *least, *rates)
        n, *state = dr.while_loop(begin, goes_on, body, label="quaternion Julia set")
        q, slopes = state[:4], state[4:16]
        moved, steep, least, rates = _split_in_four(state[16:])
        square = _squared_norm(q)
        norm = dr.sqrt(square)
        share = dr.exp2(-real(n)) * (1 + 4 * unit)
        all_made = n >= self.iterations
        last = 2.0**-self.iterations
        offset = last * dr.log(b)
        is_floor = norm <= b * math.exp(-1.0)
        value = dr.select(is_floor, -last, share * dr.log(norm) - offset)
        scale = dr.select(is_floor, 0, share / square)
        gradient = type(p)(
            *(scale * sum(q[i] * slopes[3 * i + k] for i in range(4)) for k in range(3))
        )
        cut = b * (math.exp(-1.0) * (1 - 1e-6))  # f is constant where |q_N| is smaller
        constants: list[Real] = []
        for e, d, low, rate in zip(moved, steep, least, rates, strict=True):
            at_end = fmin(rate, d / fmax(norm * (1 - 4 * unit) - e, cut))
            later = dr.select(low >= 2 * b, rate * dr.exp(4 * size / (low * low)), dr.inf)
            constants.append(share * dr.select(all_made, at_end, later) * (1 + 8 * unit))
        # Logarithms are off by a few units of their size, or of 1.
        spread = 16 * unit * (share * (dr.abs(dr.log(norm)) + 1) + dr.abs(offset))
        spread += dr.select(all_made, 0, share * 2 * size / square)
        off = share * moved[0] / fmax(norm - moved[0], cut)
        return value, gradient, off + spread, constants


def _split_in_four(state: Any) -> tuple[Any, Any, Any, Any]:
    k = len(state) // 4
    return state[:k], state[k : 2 * k], state[2 * k : 3 * k], state[3 * k :]


def _data(backend: Backend, value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_data(backend, one) for one in cast("tuple[Any, ...]", value))
    return dr.opaque(backend.Float, float(value))


def _squared_norm(q: Any) -> Any:
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
