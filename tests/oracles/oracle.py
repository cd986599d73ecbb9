"""First crossings by dense sampling in double precision, sharing nothing with the tracer.

The solid angle is that of van Oosterom and Strackee (1983), one arctangent for each triangle of
a fan about a point near the centroid of each loop, where the library multiplies spinors. Nothing
here proves anything. A crossing that it reports is one, for the function is on the far side of a
level by more than rounding; what a ray that barely grazes a level does may escape it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from harnack.backend import FloatArray

__all__ = [
    "Crossings",
    "CurveOracle",
    "Function",
    "OracleValues",
    "first_crossings",
    "gap_to_levels",
]


# Sizes of temporary arrays, chosen to stay within a core's cache.
_PAIRS_AT_ONCE = 16_384
_HALVINGS = 14
# From the centroid to the apex, in sizes of the loop: a point in line with the apex and a vertex
# is 0/0, and the points that people choose are in line with the centroid.
_ASIDE = np.array([0.0513, 0.0271, 0.0387])


@dataclass(frozen=True)
class OracleValues:
    """A function at n points: value (n,), gradient (n, 3), and the length over which it is smooth
    (n,), such as the distance to its singularities; samples are a fraction of it apart."""

    value: FloatArray
    gradient: FloatArray
    smooth: FloatArray

    @property
    def gradient_norm(self) -> FloatArray:
        """(n,) |gradient|."""
        return np.linalg.norm(self.gradient, axis=1)


Function: TypeAlias = Callable[[FloatArray], OracleValues]


@dataclass(frozen=True)
class CurveOracle:
    """The solid angle of closed loops (k, 3) in steradians, modulo 4 pi, with its gradient."""

    loops: Sequence[FloatArray]

    def __call__(self, x: FloatArray) -> OracleValues:
        edges = sum(len(loop) for loop in self.loops)
        at_once = max(1, _PAIRS_AT_ONCE // edges)
        parts = [self._look(x[i : i + at_once]) for i in range(0, max(len(x), 1), at_once)]
        return OracleValues(
            np.concatenate([part.value for part in parts]),
            np.concatenate([part.gradient for part in parts]),
            np.concatenate([part.smooth for part in parts]),
        )

    def _look(self, x: FloatArray) -> OracleValues:
        value, gradient = np.zeros(len(x)), np.zeros_like(x)
        near = np.full(len(x), math.inf)
        for loop in self.loops:
            closed = np.concatenate([loop, loop[:1]]).T
            p = [closed[k] - x[:, k, None] for k in range(3)]
            apex = loop.mean(axis=0) + np.ptp(loop, axis=0).max() * _ASIDE
            c = [apex[k] - x[:, k, None] for k in range(3)]
            length, pc, lc = _length(p), _dot(p, c), _length(c)
            a, la, ac = [q[:, :-1] for q in p], length[:, :-1], pc[:, :-1]
            b, lb, bc = [q[:, 1:] for q in p], length[:, 1:], pc[:, 1:]
            e = np.diff(closed)
            cross, ab = _cross(a, e), _dot(a, b)  # a x e = a x b, which cancels far away
            solid = np.arctan2(_dot(cross, c), la * lb * lc + ab * lc + ac * lb + bc * la)
            value += 2 * solid.sum(axis=1)
            square = _dot(cross, cross)
            # 1/(|a||b| + a.b) = (|a||b| - a.b)/|a x b|^2: neither cancels where it is used.
            plain = la * lb + np.abs(ab)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = np.where(ab > 0, 1 / plain, plain / square)
                weight = (la + lb) / (la * lb) * inverse
                gradient += np.stack([(weight * part).sum(axis=1) for part in cross], axis=1)
            near = np.minimum(near, _distance(a, ab - la * la, e))
        return OracleValues(_wrap(value, 4 * math.pi), gradient, near)


def _dot(a: Sequence[FloatArray], b: Sequence[FloatArray]) -> FloatArray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[FloatArray], b: Sequence[FloatArray] | FloatArray) -> list[FloatArray]:
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def _length(a: Sequence[FloatArray]) -> FloatArray:
    return np.sqrt(_dot(a, a))


def _distance(a: Sequence[FloatArray], a_dot_e: FloatArray, e: FloatArray) -> FloatArray:
    """Distance to the nearest edge e (3, k): |a + s e|, s = -a.e/|e|^2 clipped to [0, 1]."""
    s = np.minimum(np.maximum(a_dot_e * (-1 / (e * e).sum(axis=0)), 0), 1)
    foot = [a[k] + s * e[k] for k in range(3)]
    return np.sqrt(_dot(foot, foot).min(axis=1))


def _wrap(value: FloatArray, period: float) -> FloatArray:
    """The representative in [-period/2, period/2)."""
    return np.remainder(value + 0.5 * period, period) - 0.5 * period


def gap_to_levels(
    value: FloatArray, levels: Sequence[float], period: float | None = None
) -> FloatArray:
    """|value - level| for the nearest of the levels, (n,)."""
    gap = np.full(value.shape, math.inf)
    for level in levels:
        away = value - level if period is None else _wrap(value - level, period)
        gap = np.minimum(gap, np.abs(away))
    return gap


@dataclass(frozen=True)
class Crossings:
    """Where rays first are beyond a level, for certain.

    before: (n,) the last sample on the side where the ray starts (inf: never beyond a level).
    beyond: (n,) a point on the other side, more than `depth` from the level to first order; a
        point in between is a crossing.
    """

    before: FloatArray
    beyond: FloatArray


def first_crossings(
    function: Function,
    origins: FloatArray,
    directions: FloatArray,
    t_min: float | FloatArray,
    t_max: float | FloatArray,
    *,
    levels: Sequence[float],
    period: float | None = None,
    depth: float,
    spacing: float = 0.06,
    finest: float,
) -> Crossings:
    """First crossings of rays (n, 3), unit directions, by samples `spacing` times the smooth
    length apart, at least `finest`. Values known modulo a period are continued along the ray.

    t_min, t_max: numbers or (n,).
    """
    n = len(origins)
    t, end = np.broadcast_to(t_min, n).astype(float), np.broadcast_to(t_max, n).astype(float)
    last, start = t.copy(), t.copy()
    look = function(origins + t[:, None] * directions)
    lift, first_cell = look.value, _cell(look.value, levels, period)
    before, beyond = np.full(n, math.inf), np.full(n, math.inf)
    alive, smooth = np.arange(n), look.smooth
    while len(alive):
        step = np.maximum(spacing * smooth, finest)
        t_next = np.minimum(t + step, end[alive])
        look = function(origins[alive] + t_next[:, None] * directions[alive])
        move = look.value - lift
        lift = lift + (move if period is None else _wrap(move, period))
        same = _cell(lift, levels, period) == first_cell[alive]
        deep = ~same & (gap_to_levels(lift, levels, period) > depth * look.gradient_norm)
        last = np.where(same, t_next, last)
        found = alive[deep]
        before[found], beyond[found], start[found] = last[deep], t_next[deep], t[deep]
        going = ~deep & (t_next < end[alive])
        alive, t, lift, last = alive[going], t_next[going], lift[going], last[going]
        smooth = look.smooth[going]
    found = np.flatnonzero(np.isfinite(beyond))
    beyond[found] = _refined(
        function, origins[found], directions[found], start[found], beyond[found],
        levels, period, depth,
    )  # fmt: skip
    return Crossings(before, beyond)


def _refined(
    function: Function, o: FloatArray, d: FloatArray, low: FloatArray, high: FloatArray,
    levels: Sequence[float], period: float | None, depth: float,
) -> FloatArray:  # fmt: skip
    """A point in (low, high] that is beyond the level by `depth` as `high` is, but barely."""
    end = function(o + high[:, None] * d)
    end_cell = _cell(end.value, levels, period)
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        look = function(o + middle[:, None] * d)
        move = look.value - end.value
        lift = end.value + (move if period is None else _wrap(move, period))
        deep = (_cell(lift, levels, period) == end_cell) & (
            gap_to_levels(lift, levels, period) > depth * look.gradient_norm
        )
        low, high = np.where(deep, low, middle), np.where(deep, middle, high)
    return high


def _cell(lift: FloatArray, levels: Sequence[float], period: float | None) -> FloatArray:
    """How many levels lie below the value: it changes where a level is crossed."""
    count = np.zeros(lift.shape)
    for level in levels:
        above = lift - level
        count += (above > 0) if period is None else np.floor(above / period)
    return count
