"""Rays through curves and broken meshes with cells and without: time a ray, to build, memory."""

from __future__ import annotations

import functools
import resource
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.backend import choose_backend, to_vector3
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import bumpy_sphere, remove_faces

from .scenes import camera

FloatArray = npt.NDArray[np.float64]

_VERTICES, _WIDTH, _RAYS, _REPEATS = (12, 64, 256, 1024), 512, 200_000, 5
# Broken meshes: subdivisions of a sphere, and fewer rays, as some take half a millisecond.
_SUBDIVISIONS, _WIDTH_OF_MESHES, _RAYS_OF_MESHES, _REPEATS_OF_MESHES = (4, 5), 128, 10_000, 2


@dataclass(frozen=True)
class _Rays:
    """Numbers of rays: the camera's along each side, chords and bounces; and of repetitions."""

    width: int
    count: int
    repeats: int


_OF_CURVES = _Rays(_WIDTH, _RAYS, _REPEATS)
_OF_MESHES = _Rays(_WIDTH_OF_MESHES, _RAYS_OF_MESHES, _REPEATS_OF_MESHES)


def curve_cells() -> str:
    """Measure, and return the section of the page."""
    columns = "| camera | with cells | chords | with cells | bounces | with cells | build | MB |"
    lines = [
        "## Curves with cells\n",
        "The 2 pi level of the wavy polygon with N vertices, with `cells=True` and without: "
        "nanoseconds of CPU time a ray, single precision, tolerance 1e-4, the best of "
        f"{_REPEATS} runs. *Camera*: {_WIDTH} x {_WIDTH} rays. *Chords*: {_RAYS:,} lines through "
        "random points of a sphere. *Bounces*: as many rays from points of the surface that the "
        "camera sees, in random directions; scattered rays share lanes by a queue, with cells and "
        "without. *Build*: CPU seconds, with a warm kernel cache.\n",
        f"| N {columns}",
        "|---:|" + "---:|" * 8,
    ]
    for n in _VERTICES:
        make = functools.partial(hk.SolidAngle, example_curves.wavy_polygon(n))
        lines.append(_row(f"{n:,}", make, _OF_CURVES))
        print(lines[-1], flush=True)
    lines += [
        "\n## Broken meshes with cells\n",
        "The same of the winding number of a bumpy sphere, a tenth of its faces lost (*holes*), or "
        "all corners moved by about 0.1 % of its size (*soup*); microseconds, "
        f"{_WIDTH_OF_MESHES} x {_WIDTH_OF_MESHES} and {_RAYS_OF_MESHES:,} rays, the best of "
        f"{_REPEATS_OF_MESHES} runs. Without cells up to 2,048 edges at which triangles do not "
        "cancel are summed up one by one, and more by the tree of triangles. The grid of empty "
        "cells, made before, is not timed.\n",
        f"| mesh | edges {columns}",
        "|---|---:|" + "---:|" * 8,
    ]
    for subdivisions in _SUBDIVISIONS:
        for kind in ("holes", "soup"):
            mesh = broken_mesh(subdivisions, kind)
            edges = hk.WindingNumber(*mesh).describe()["singular edges"]
            make = functools.partial(hk.WindingNumber, *mesh)
            name = f"{len(bumpy_sphere(subdivisions)[1]):,} faces, {kind} | {edges:,}"
            lines.append(_row(name, make, _OF_MESHES, 1e6))
            print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def broken_mesh(subdivisions: int, kind: str) -> tuple[FloatArray, Any]:
    """A bumpy sphere with "holes", or torn into a "soup"."""
    vertices, faces = bumpy_sphere(subdivisions)
    if kind == "holes":
        return vertices, remove_faces(faces, 0.1, 0)
    corners = vertices[faces]
    corners = corners + 2e-3 * np.random.default_rng(0).normal(size=corners.shape)
    return corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3)


def _row(name: str, make: Callable[..., Any], count: _Rays, unit: float = 1e9) -> str:
    """A row of the table. unit: the number of units of time in a second."""
    plain, built = make(cells=False), 0.0
    backend = choose_backend("single")
    for _ in range(2):  # the first time compiles kernels
        field = make(cells=2000)
        field.extent((field.default_level,))
        built = _seconds(lambda field=field: field.evaluator(backend))
    entries: list[str] = []
    for o, d in (_camera(count.width), _chords(count.count), _bounces(plain, count)):
        rays = to_vector3(backend, o), to_vector3(backend, d)
        for variant in (plain, field):
            work = functools.partial(_trace, variant, rays)
            work()
            best = min(_seconds(work) for _ in range(count.repeats))
            entries.append(f"{best / len(o) * unit:,.{0 if unit > 1e6 else 1}f}")
    device_data = field.evaluator(backend)._device
    size = (device_data.built if isinstance(field, hk.WindingNumber) else device_data.cells).size
    return f"| {name} | " + " | ".join(entries) + f" | {built:.2f} s | {size / 1e6:.1f} |"


def _trace(field: Any, rays: tuple[Any, Any]) -> Any:
    hits = hk.trace(field, *rays, tolerance=1e-4)
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


def _camera(width: int) -> tuple[FloatArray, FloatArray]:
    eye, d = camera(width)
    return np.broadcast_to(eye, d.shape).copy(), d


def _chords(count: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    a, b = (1.2 * _unit(rng.normal(size=(count, 3))) for _ in range(2))
    return a, _unit(b - a)


def _bounces(field: Any, count: _Rays) -> tuple[FloatArray, FloatArray]:
    hits = hk.trace(field, *_camera(count.width), tolerance=1e-4, precision="single")
    position, normal = hits.position[hits.is_hit], hits.normal[hits.is_hit]
    rng = np.random.default_rng(1)
    chosen = rng.integers(len(position), size=count.count)
    d, normal = _unit(rng.normal(size=(count.count, 3))), normal[chosen]
    d *= np.where((d * normal).sum(axis=1, keepdims=True) < 0, -1, 1)
    return position[chosen] + 1e-3 * normal, d


def _unit(v: FloatArray) -> FloatArray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
