"""Rays through curves with cells and without: CPU time a ray, time to build, memory."""

from __future__ import annotations

import functools
import resource
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.backend import choose_backend, to_vector3
from harnack.geometry import shapes

from .scenes import camera

FloatArray = npt.NDArray[np.float64]

_VERTICES, _WIDTH, _RAYS, _REPEATS = (12, 64, 256, 1024), 512, 200_000, 5


def curve_cells() -> str:
    """Measure, and return the section of the page."""
    lines = [
        "## Curves with cells\n",
        "The 2 pi level of the wavy polygon with N vertices, with `cells=True` and without: "
        "nanoseconds of CPU time a ray, single precision, tolerance 1e-4, the best of "
        f"{_REPEATS} runs. *Camera*: {_WIDTH} x {_WIDTH} rays. *Chords*: {_RAYS:,} lines through "
        "random points of a sphere. *Bounces*: as many rays from points of the surface that the "
        "camera sees, in random directions. *Build*: CPU seconds, with a warm kernel cache.\n",
        "| N | camera | with cells | chords | with cells | bounces | with cells | build | MB |",
        "|---:|" + "---:|" * 8,
    ]
    for n in _VERTICES:
        line = _row(n)
        print(line, flush=True)
        lines.append(line)
    return "\n".join(lines) + "\n"


def _row(n: int) -> str:
    plain, built = hk.SolidAngle(shapes.wavy_polygon(n), cells=False), 0.0
    backend = choose_backend("single")
    for _ in range(2):  # the first time compiles kernels
        field = hk.SolidAngle(shapes.wavy_polygon(n), cells=True)
        field.extent((field.default_level,))
        built = _seconds(lambda field=field: field.prepare(backend))
    entries: list[str] = []
    for o, d in (_camera(), _chords(), _bounces(plain)):
        rays = to_vector3(backend, o), to_vector3(backend, d)
        for one in (plain, field):
            work = functools.partial(_trace, one, rays)
            best = min(_seconds(work) for _ in range(_REPEATS))
            entries.append(f"{best / len(o) * 1e9:,.0f}")
    size = field.prepare(backend)._device.cells.size  # type: ignore[union-attr]
    return f"| {n:,} | " + " | ".join(entries) + f" | {built:.2f} s | {size / 1e6:.1f} |"


def _trace(field: hk.SolidAngle, rays: tuple[Any, Any]) -> Any:
    hits = hk.trace(field, *rays)
    dr.eval(hits.t)
    return hits


def _seconds(work: Callable[[], Any]) -> float:
    """CPU time of all threads."""
    dr.sync_thread()
    before = resource.getrusage(resource.RUSAGE_SELF)
    work()
    dr.sync_thread()
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _camera() -> tuple[FloatArray, FloatArray]:
    eye, d = camera(_WIDTH)
    return np.broadcast_to(eye, d.shape).copy(), d


def _chords() -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    a, b = (1.2 * _unit(rng.normal(size=(_RAYS, 3))) for _ in range(2))
    return a, _unit(b - a)


def _bounces(field: hk.SolidAngle) -> tuple[FloatArray, FloatArray]:
    hits = hk.trace(field, *_camera())
    position, normal = hits.position[hits.hit], hits.normal[hits.hit]
    rng = np.random.default_rng(1)
    chosen = rng.integers(len(position), size=_RAYS)
    d, normal = _unit(rng.normal(size=(_RAYS, 3))), normal[chosen]
    d *= np.where((d * normal).sum(axis=1, keepdims=True) < 0, -1, 1)
    return position[chosen] + 1e-3 * normal, d


def _unit(v: FloatArray) -> FloatArray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
