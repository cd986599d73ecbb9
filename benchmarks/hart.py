"""Hart's enhancements of sphere tracing, as he measured them: with and without each.

Everything here is the benchmark's own and lockstep NumPy in double precision, so that evaluations
of distances are counted as a program on one ray would make them. Two rules of the paper are used as
corrected: distances known from before are shortened by all travel since and the nearest is found
anew in every step (its Figure 6 misses surfaces), and convexity is asked of f itself, not of the
solid (its Equation 21).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_vector3
from harnack.enclosures import Lipschitz, SlopeRange
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.fields.formula import Formula

_WIDTH, _FAR, _NEAR, _MOST = 96, 40.0, 1e-4, 600
_BLOCK = 8


@dataclass(frozen=True)
class Solid:
    """A solid by its signed distance.

    distance: of points (n, 3). gradient: (n, 3), for convex distances alone; else None.
    ball: center and radius of a ball around it; None if it is infinite.
    """

    distance: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], np.ndarray] | None
    ball: tuple[np.ndarray, float] | None


@dataclass(frozen=True)
class Count:
    """evaluations: of distances, a ray. steps: a ray. bounds: evaluations of bounding balls, a ray.
    lengths: of all steps. t: where each ray ended; infinite if it hit nothing."""

    evaluations: float
    steps: float
    bounds: float
    lengths: np.ndarray
    t: np.ndarray


def ball(x: float, y: float, z: float, radius: float) -> Solid:
    c = np.array([x, y, z])
    return Solid(
        lambda p: np.linalg.norm(p - c, axis=1) - radius,
        lambda p: (p - c) / np.linalg.norm(p - c, axis=1)[:, None],
        (c, radius),
    )


def plane(height: float) -> Solid:
    return Solid(
        lambda p: p[:, 2] - height, lambda p: np.broadcast_to([0.0, 0.0, 1.0], p.shape), None
    )


def torus(center: tuple[float, float, float], large: float, small: float, turn: float) -> Solid:
    """A torus, turned about the x axis."""
    c = np.array(center)
    rotation = np.array([
        [1, 0, 0], [0, math.cos(turn), -math.sin(turn)], [0, math.sin(turn), math.cos(turn)],
    ])  # fmt: skip

    def distance(p: np.ndarray) -> np.ndarray:
        q = (p - c) @ rotation.T
        return np.hypot(np.hypot(q[:, 0], q[:, 1]) - large, q[:, 2]) - small

    return Solid(distance, None, (c, large + small))


def scenes() -> dict[str, list[Solid]]:
    """The ball, nine balls above a plane, and 14 tori in place of the logo's 14 Bezier tubes."""
    balls = [ball(1.2 * (i - 1), 1.2 * (j - 1), 0.5, 0.5) for i in range(3) for j in range(3)]
    tori = [
        torus((0.62 * (k % 5 - 2), 0.7 * (k // 5 - 1), 0.15 * (k % 3)), 0.22, 0.06, 0.5 * k)
        for k in range(14)
    ]
    return {
        "one ball": [ball(0, 0, 0, 1.0)],
        "nine balls and a plane": [*balls, plane(0.0)],
        "14 tori": tori,
    }


def rays() -> tuple[np.ndarray, np.ndarray]:
    """Eye (3,) and unit directions, row by row, looking slightly down at the origin."""
    eye = np.array([0.0, -4.5, 2.2])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    pixel = (2 * (np.arange(_WIDTH) + 0.5) / _WIDTH - 1) * 0.45
    x, y = np.meshgrid(pixel, -pixel)
    d = (forward + x[..., None] * right + y[..., None] * up).reshape(-1, 3)
    return eye, d / np.linalg.norm(d, axis=1, keepdims=True)


def trace(
    solids: list[Solid], *, convexity: bool = False, triangle: bool = False,
    bounding: bool = False, start: np.ndarray | None = None,
) -> Count:  # fmt: skip
    """Sphere tracing with the enhancements that are chosen.

    Each solid has a parameter `free`, up to which the ray is known not to meet it. Proof of the
    enhancements: |f(x + t v) - f(x)| <= t keeps an earlier distance valid, less the travel since
    (triangle inequality); a convex f lies above its tangent, f + t v.grad f, so that a ray that
    leaves a convex solid never meets it; and a ray is as far from a solid as from a ball around it.
    """
    eye, d = rays()
    n, m = len(d), len(solids)
    t = np.zeros(n) if start is None else start.copy()
    free = np.zeros((n, m))
    active = np.ones(n, bool)
    hit = np.zeros(n, bool)
    evaluations = bounds = steps = 0
    lengths: list[np.ndarray] = []
    for _ in range(_MOST):
        rows = np.flatnonzero(active)
        if not rows.size:
            break
        p = eye + t[rows, None] * d[rows]
        steps += rows.size
        nearest = np.full(rows.size, np.inf)
        limits = free[rows] if triangle or convexity else np.zeros((rows.size, m))
        if bounding:
            # Balls first, nearest first: a heap would do the same one by one.
            for k, solid in enumerate(solids):
                if solid.ball is not None:
                    center, radius = solid.ball
                    is_due = np.isfinite(limits[:, k])
                    gap = np.linalg.norm(p - center, axis=1) - radius
                    limits[is_due, k] = np.maximum(limits[is_due, k], t[rows][is_due] + gap[is_due])
                    bounds += int(is_due.sum())
        order = np.argsort(limits, axis=1) if bounding or triangle else None
        touching = np.zeros(rows.size, bool)
        for rank in range(m):
            solid_ids = np.full(rows.size, rank) if order is None else order[:, rank]
            bound = limits[np.arange(rows.size), solid_ids]
            is_due = np.isfinite(bound)
            if triangle or bounding:
                is_due &= bound < nearest
                nearest = np.where(~is_due, np.minimum(nearest, bound), nearest)
            for k in np.unique(solid_ids[is_due]):
                subset = np.flatnonzero(is_due & (solid_ids == k))
                solid = solids[k]
                f = solid.distance(p[subset])
                evaluations += subset.size
                reach = f
                if convexity and solid.gradient is not None:
                    rate = (solid.gradient(p[subset]) * d[rows[subset]]).sum(1)
                    gap = np.where(rate < 0, f / np.maximum(-rate, 1e-300), np.inf)
                    reach = np.maximum(f, gap)
                new_bound = t[rows[subset]] + reach
                free[rows[subset], k] = new_bound
                nearest[subset] = np.minimum(nearest[subset], new_bound)
                touching[subset] |= f < _NEAR
        step = nearest - t[rows]
        lengths.append(step[(step > 0) & np.isfinite(step)])
        hit[rows[touching]] = True
        escaped = ~touching & ~(nearest < _FAR)
        moving = ~touching & ~escaped
        t[rows[moving]] = nearest[moving]
        active[rows[touching | escaped]] = False
    return Count(
        evaluations / n, steps / n, bounds / n, np.concatenate(lengths), np.where(hit, t, np.inf)
    )


def coherent(solids: list[Solid]) -> Count:
    """Image coherence: a cone around each block of pixels is marched first, and its rays start
    where it stopped.

    Proof. Points at t on the rays of a block are within t w of its axis, with w the largest
    distance of their directions from the axis': while f on the axis exceeds that, none of the rays
    has met anything, and a step (f - t w)/(1 + w) keeps it so.
    """
    eye, d = rays()
    side = _WIDTH // _BLOCK
    blocks = d.reshape(side, _BLOCK, side, _BLOCK, 3).transpose(0, 2, 1, 3, 4)
    blocks = blocks.reshape(side * side, -1, 3)
    axis = blocks.mean(1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    width = np.linalg.norm(blocks - axis[:, None], axis=2).max(1)
    t, evaluations = np.zeros(len(axis)), 0
    active = np.ones(len(axis), bool)
    for _ in range(_MOST):
        rows = np.flatnonzero(active)
        if not rows.size:
            break
        p = eye + t[rows, None] * axis[rows]
        f = np.min([solid.distance(p) for solid in solids], axis=0)
        evaluations += rows.size * len(solids)
        step = (f - t[rows] * width[rows]) / (1 + width[rows])
        stops = step < 0.05 * t[rows] * width[rows] + _NEAR
        t[rows[~stops]] += step[~stops]
        active[rows[stops | (t[rows] > _FAR)]] = False
    start = np.broadcast_to(t[:, None], blocks.shape[:2]).reshape(side, side, _BLOCK, _BLOCK)
    count = trace(solids, start=start.transpose(0, 2, 1, 3).reshape(-1).copy())
    return Count(count.evaluations + evaluations / len(d), count.steps, 0.0, count.lengths, count.t)


_ENHANCED: tuple[tuple[str, dict[str, bool]], ...] = (
    ("none", {}),
    ("convexity", {"convexity": True}),
    ("triangle inequality", {"triangle": True}),
    ("both", {"convexity": True, "triangle": True}),
    ("bounding balls", {"bounding": True}),
    ("bounding balls, triangle inequality", {"bounding": True, "triangle": True}),
)
# The printed results of the paper, in percent of the time without enhancement.
_PRINTED = {
    ("one ball", "convexity"): 69,
    ("nine balls and a plane", "convexity"): 59,
    ("nine balls and a plane", "triangle inequality"): 46,
    ("nine balls and a plane", "both"): 40,
    ("14 tori", "triangle inequality"): 73,
    ("14 tori", "bounding balls"): 21,
}


class _Ellipsoid(Formula):
    """A convex f that can be marched with and without its convexity."""

    lipschitz = 1.0
    domain = hk.Ball(radius=3.0)

    def formula(self, x: object, y: object, z: object) -> object:
        return (x * x + (2 * y) ** 2 + (2 * z) ** 2) ** 0.5 * 0.5 - 0.5  # type: ignore[operator]


class _Tangent(ParabolaEnclosure):
    """The enclosure of a convex f with a Lipschitz constant K: slope s <= F(s) <= K s (Hart's
    Theorem 4, for f itself)."""

    @classmethod
    def from_promise(
        cls, promise: Any, value: Any, error: Any, slopes: SlopeRange
    ) -> _Tangent | None:
        if not isinstance(promise, Lipschitz):
            return None
        return cls(SlopeRange(slopes.lower, promise.constant), 0.0, 0.0, promise.radius)


def hart() -> str:
    """The section of the page."""
    lines = [
        "## Enhancements of sphere tracing\n",
        "Table 2 of Hart (1996), as evaluations of distances a ray and in percent of those "
        f"without enhancement: {_WIDTH} x {_WIDTH} rays, hits within {_NEAR}. The logo's 14 "
        "tubes are 14 tori here. All of them see the same surface.\n",
        "| scene | enhancement | evaluations a ray | percent | printed | steps a ray "
        "| bounding balls a ray |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    histograms: dict[str, np.ndarray] = {}
    for scene, solids in scenes().items():
        plain = trace(solids)
        rows = [(name, trace(solids, **options)) for name, options in _ENHANCED]
        rows.append((f"image coherence, blocks of {_BLOCK}", coherent(solids)))
        for name, count in rows:
            if scene == "14 tori" and name in ("convexity", "both"):
                continue  # tori are not convex
            is_hit = np.isfinite(plain.t)
            assert (is_hit == np.isfinite(count.t)).mean() > 0.999
            are_hits = is_hit & np.isfinite(count.t)
            assert np.abs(plain.t - count.t)[are_hits].max() < 0.1
            printed = _PRINTED.get((scene, name), "")
            lines.append(
                f"| {scene} | {name} | {count.evaluations:.2f} "
                f"| {100 * count.evaluations / plain.evaluations:.0f} | {printed} "
                f"| {count.steps:.2f} | {count.bounds:.2f} |"
            )
            if scene == "one ball" and name in ("none", "convexity"):
                histograms[name] = count.lengths
    lines += ["", *_histogram_lines(histograms), "", *_on_our_tracer()]
    return "\n".join(lines) + "\n"


def _histogram_lines(histograms: dict[str, np.ndarray]) -> list[str]:
    """The histogram of steps towards one ball, by powers of four (the paper's Figure 12)."""
    edges = [0.0, *(4.0**k for k in range(-7, 2)), math.inf]
    names = [f"< {edge:.1e}" for edge in edges[1:-1]] + ["longer"]
    lines = [
        "Steps towards one ball, by length, for each 1,000 rays (Figure 12):\n",
        "| enhancement | " + " | ".join(names) + " |",
        "|---|" + "---:|" * len(names),
    ]
    for name, lengths in histograms.items():
        counts = np.histogram(lengths, edges)[0] * 1000 / _WIDTH**2
        lines.append(f"| {name} | " + " | ".join(f"{number:.0f}" for number in counts) + " |")
    return lines


def _on_our_tracer() -> list[str]:
    """Evaluations of a convex f with its Lipschitz constant, and with ranges that use its
    convexity."""
    backend = choose_backend("double")
    eye, d = rays()
    o, directions = to_vector3(backend, eye[None]), to_vector3(backend, d)
    looks: dict[Any, float] = {}
    for enclosures in ("lipschitz", _Tangent, "quadratic-taylor", None):
        hits = hk.trace(
            _Ellipsoid(), o, directions, level=0.0, enclosures=enclosures, tolerance=_NEAR
        )
        looks[enclosures] = float(hits.evaluations.numpy().mean())
    return [
        "On our tracer, a convex ellipsoid, drawn in a ball, takes "
        f"{looks['lipschitz']:.2f} looks a ray with its Lipschitz constant, {looks[_Tangent]:.2f} "
        "with that and its convexity (the slope bounds f from below: one more promise, and no more "
        f"to evaluate), {looks['quadratic-taylor']:.2f} with the range of its second "
        f"derivative by interval arithmetic, {looks[None]:.2f} by the default. So convexity pays "
        "where a field knows of it. Bounding volumes pay wherever an evaluation costs more than "
        "they do, as in the grid of blobs. The triangle inequality skips evaluations of single "
        "rays, which kernels over packets of rays would make anyhow, and image coherence gains "
        "little once a ray takes three looks.",
    ]
