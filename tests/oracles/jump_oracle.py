"""First hits of fields that jump, by dense sampling in double precision on the host.

A real function such as a winding number is above or below the level, whether it comes there
smoothly or by a jump, so its surface is where the side changes. Nothing here proves anything: a
change that is reported is one, but what lies between two samples is not seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray

__all__ = ["Verdict", "first_side_changes", "is_near_surface", "judge"]

Value: TypeAlias = Callable[[FloatArray], FloatArray]
"""A real function: points (m, 3) in, exact values (m,) out."""

_POINTS_AT_ONCE = 65_536
_HALVINGS = 48


def first_side_changes(
    value: Value,
    origins: FloatArray,
    directions: FloatArray,
    t_min: float | FloatArray,
    t_max: float | FloatArray,
    *,
    level: float,
    samples: int = 512,
) -> FloatArray:
    """The first t (n,) at which rays (n, 3), unit directions, change sides of a level; else inf.

    `samples` equal intervals of each ray are looked at, and the first whose two ends lie on
    different sides is halved until t is known to rounding. Of several changes within an interval
    an odd number shows as one of them, an even number not at all.

    t_min, t_max: numbers or (n,), finite.
    """
    n = len(origins)
    start, end = np.broadcast_to(t_min, n), np.broadcast_to(t_max, n)
    if not (np.isfinite(start).all() and np.isfinite(end).all()):
        raise ValueError("t_min and t_max must be finite: samples are a fixed number a ray")
    share = np.linspace(0.0, 1.0, samples + 1)
    first = np.full(n, math.inf)
    at_once = max(1, _POINTS_AT_ONCE // len(share))
    for i in range(0, n, at_once):
        part = slice(i, i + at_once)
        o, d = origins[part], directions[part]
        t = start[part, None] + (end - start)[part, None] * share
        is_above = _is_above(value, o, d, t, level)
        changes = is_above[:, 1:] != is_above[:, :-1]
        row = np.flatnonzero(changes.any(axis=1))
        column = changes[row].argmax(axis=1)
        low, high = t[row, column], t[row, column + 1]
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            same = _is_above(value, o[row], d[row], middle[:, None], level)[:, 0]
            same = same == is_above[row, column]
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        first[i + row] = high
    return first


def is_near_surface(value: Value, points: FloatArray, *, level: float, reach: float) -> BoolArray:
    """Whether points (n, 3) have both sides of the level around them, within `reach`.

    Looks at 26 directions and four distances down to a thousandth of `reach`, for thin gaps.
    """
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    ways = grid[np.abs(grid).sum(axis=1) > 0]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    offsets = np.concatenate([np.zeros((1, 3)), *(r * reach * ways for r in (1, 0.1, 0.01, 1e-3))])
    near = np.zeros(len(points), bool)
    for i, point in enumerate(points):
        is_above = value(point + offsets) > level
        near[i] = is_above.any() and not is_above.all()
    return near


@dataclass(frozen=True)
class Verdict:
    """Indices of rays whose hits are wrong.

    missed: the side changes earlier than the hit, on the ray and on four rays beside it.
    early: there is no surface where the hit is.
    hits, changes: how many rays hit, and how many change sides.
    """

    missed: npt.NDArray[np.int64]
    early: npt.NDArray[np.int64]
    hits: int
    changes: int

    @property
    def wrong(self) -> int:
        """How many hits are wrong."""
        return len(self.missed) + len(self.early)


def judge(
    t: FloatArray,
    value: Value,
    origins: FloatArray,
    directions: FloatArray,
    t_min: float | FloatArray,
    t_max: float | FloatArray,
    *,
    level: float,
    reach: float,
    edges: FloatArray | None = None,
    truth: FloatArray | None = None,
    beside: float | None = None,
    samples: int = 512,
) -> Verdict:
    """Compares hits t (n,), inf for misses, with the changes of sides of an exact function.

    A hit next to a jump that cuts the level off just before it is reached counts as right, as
    `tracer.stretches` says: where the function would reach it within `reach` if it went on.

    reach: how far a hit may be from the surface; a few tolerances of the trace.
    edges: (k, 2, 3) segments at which the function is singular. Around them its gradient grows
        without limit, so that any value is within tolerance of any level: hits within `reach` of
        them count as right.
    truth: (n,) what `first_side_changes` says of the same rays, where that is known already.
    beside: how far off the rays lie on which a missed surface has to show as well, so that one
        that a ray just grazes, or meets by rounding only, does not count; by default reach / 10.
    """
    n = len(origins)
    beside = 0.1 * reach if beside is None else beside
    start, end = np.broadcast_to(t_min, n), np.broadcast_to(t_max, n)

    def changes(rays: npt.NDArray[np.int64], aside: FloatArray) -> FloatArray:
        return first_side_changes(
            value, origins[rays] + aside, directions[rays], start[rays], end[rays],
            level=level, samples=samples,
        )  # fmt: skip

    truth = changes(np.arange(n), np.zeros(3)) if truth is None else truth
    missed = np.flatnonzero(truth < t - reach)
    for u, v in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        across, up = _across(directions[missed])
        missed = missed[changes(missed, beside * (u * across + v * up)) < t[missed] - reach]
    early = np.flatnonzero(t < truth - reach)
    x = origins[early] + t[early, None] * directions[early]
    near = is_near_surface(value, x, level=level, reach=reach)
    near |= _continues(value, x, directions[early], level, reach)
    if edges is not None:
        near |= _distance(x, edges) <= reach
    early = early[~near]
    return Verdict(missed, early, int(np.isfinite(t).sum()), int(np.isfinite(truth).sum()))


def _is_above(value: Value, o: FloatArray, d: FloatArray, t: FloatArray, level: float) -> BoolArray:
    """For t (n, m) on rays (n, 3)."""
    x = o[:, None] + t[..., None] * d[:, None]
    return value(x.reshape(-1, 3)).reshape(t.shape) > level


def _continues(value: Value, x: FloatArray, d: FloatArray, level: float, reach: float) -> BoolArray:
    """Whether f at x (n, 3) is nearer to the level than it moves on a step of `reach`, ahead or
    back, whichever is less: on one of the two there is no jump."""
    if not len(x):
        return np.zeros(0, np.bool_)
    here = value(x)
    moved = [np.abs(value(x + step * d) - here) for step in (reach, -reach)]
    return np.abs(here - level) <= np.minimum(*moved)


def _across(d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (n, 3) across each direction and each other."""
    axis = np.eye(3)[np.abs(d).argmin(axis=1)]
    across = np.asarray(np.cross(d, axis), dtype=np.float64)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.asarray(np.cross(d, across), dtype=np.float64)


def _distance(x: FloatArray, edges: FloatArray) -> FloatArray:
    """From points (n, 3) to the nearest of the segments (k, 2, 3); inf if there are none."""
    near = np.full(len(x), math.inf)
    for a, b in edges:
        e = b - a
        share = np.clip(((x - a) @ e) / (e @ e), 0, 1)
        near = np.minimum(near, np.linalg.norm(x - a - share[:, None] * e, axis=1))
    return near
