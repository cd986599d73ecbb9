"""The published algorithms (paper, Alg. 1 and 2) as printed, in NumPy, for comparison with ours.

They prove as much as the claims that they are given: a lower bound that does not hold, or a value
that is wrong by rounding, makes rays pass the surface. So they are unproved here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3

Array = Any  # of any floating-point type

MOST = 1000


@dataclass(frozen=True)
class Claim:
    """The claims about a function f that the algorithm is given.

    look: from points (n, 3) to values (n,), gradients (n, 3), and radii (n,) of balls on which f >
    lower. For an angle f - level is reduced to [0, period) first, and lower is below that.
    """

    look: Callable[[Array], tuple[Array, Array, Array]]
    lower: float
    level: float
    period: float | None = None


@dataclass(frozen=True)
class Ends:
    """The ends of n rays: t, inf where there is no hit, and the number of evaluations, at most
    `most` for rays that ran out of steps."""

    t: Array
    evaluations: Array


def published(
    claim: Claim,
    origin: Array,
    directions: Array,
    start: Array,
    end: Array,
    *,
    stop: Literal["gradient", "value"] = "gradient",
    eps: float = 1e-4,
    most: int = MOST,
) -> Ends:
    """First hits without over-stepping. stop: at |f - level| <= eps |grad f|, or at <= eps."""
    t, kind = start.astype(directions.dtype), directions.dtype
    t_hit = np.full(len(t), np.inf, kind)
    count = np.zeros(len(t), np.int64)
    rows = np.flatnonzero(t < end)
    for _ in range(most):
        if not len(rows):
            break
        p = origin.astype(kind) + t[rows, None] * directions[rows]
        f, gradient, r = claim.look(p)
        count[rows] += 1
        slope = np.linalg.norm(gradient, axis=1) if stop == "gradient" else 1.0
        levels = [claim.level]
        if claim.period is not None:
            f, levels = np.mod(f - kind.type(claim.level), kind.type(claim.period)), [0.0]
            levels += [claim.period]
        gaps = [np.abs(f - level) for level in levels]
        hit = np.minimum.reduce(gaps) <= eps * slope
        u = np.maximum(f - claim.lower, 0)
        step = r.copy()
        for gap, level in zip(gaps, levels, strict=True):
            if (v := level - claim.lower) > 0:
                step = np.minimum(step, 2 * r * gap / (u + 2 * v + np.sqrt(u * (u + 8 * v))))
        t_hit[rows[hit]] = t[rows[hit]]
        t[rows] += step
        rows = rows[~hit & (t[rows] < end[rows])]
    return Ends(t_hit, count)


def claimed_angle(field: hk.SolidAngle) -> Claim:
    """The solid angle of one loop as the paper claims it: more than -4 pi, up to the loop."""
    assert field.lift_bound == "range"
    backend = choose_backend("double")
    ready = field.evaluator(backend)

    def look(p: Array) -> tuple[Array, Array, Array]:
        sample = ready.evaluate(to_vector3(backend, p))
        (ball,) = [
            promise
            for promise in sample.all_promises
            if isinstance(promise, hk.proofs.HarmonicBall)
        ]
        return to_numpy(sample.value), to_numpy(sample.gradient), to_numpy(ball.radius)

    return Claim(look, -4 * math.pi, field.default_level, 4 * math.pi)


def distance_to_loop(loop: Array) -> Callable[[Array], Array]:
    """Distances from a closed polygon (n, 3)."""
    a = loop
    b = np.roll(loop, -1, axis=0) - loop

    def distance(p: Array) -> Array:
        nearest = np.full(len(p), np.inf, p.dtype)
        for start, edge in zip(a.astype(p.dtype), b.astype(p.dtype), strict=True):
            offset = p - start
            fraction = np.clip(offset @ edge / (edge @ edge), 0, 1)
            nearest = np.minimum(nearest, ((offset - fraction[:, None] * edge) ** 2).sum(axis=1))
        return np.sqrt(nearest)

    return distance
