"""Rays that share lanes by a queue end as rays that are followed one by one do, bit by bit."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import upload_floats
from harnack.backend.loops import compute_on_active, loop_with_queue
from harnack.geometry.example_meshes import icosphere
from harnack.tracer import TracedSurface, traced_surface
from harnack.tracer.hits import _are_scattered


def cut_sphere() -> hk.Surface:
    vertices, faces = icosphere(2)
    return hk.Surface(hk.WindingNumber(vertices, faces[np.arange(len(faces)) % 7 > 0]))


def saddle() -> hk.Surface:
    t = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return hk.Surface(hk.SolidAngle(np.column_stack([np.cos(t), np.sin(t), 0.4 * np.cos(2 * t)])))


def parts() -> hk.Surface:
    from harnack.gallery import SCENES

    return SCENES["exoskeleton"].surfaces()[0]


def fourier_series() -> hk.Surface:
    waves = np.random.default_rng(1).normal(size=(3, 3, 3))
    return hk.Surface(hk.fields.FourierSeries(waves, ((-1, -1, -1), (1, 1, 1))))


CASES: dict[str, Callable[[], hk.Surface | TracedSurface]] = {
    "curve": saddle,
    "domain": fourier_series,
    "combined": lambda: hk.Surface(hk.Torus(1.0, 0.4) & hk.Cuboid((2.0, 3.0, 3.0))),
    "sheets": cut_sphere,
    "parts": parts,
    "require_crossing": lambda: traced_surface(
        hk.Gyroid(1.0, domain=hk.Ball(radius=1.0)), require_crossing=True
    ),
    "few steps": lambda: traced_surface(saddle(), max_steps=3),
}


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "precision"), [*((name, "single") for name in CASES), ("sheets", "double")]
)
def test_a_queue_changes_no_bit(name: str, precision: Any) -> None:
    backend = choose_backend(precision)
    prepared = traced_surface(CASES[name]()).tracer(backend)
    rng = np.random.default_rng(4)
    n = 3000 if name != "parts" else 1000
    o = rng.normal(size=(n, 3)) * 1.3
    d = rng.normal(size=(n, 3)) * 0.3 - o
    d /= np.linalg.norm(d, axis=1)[:, None]
    active = rng.random(n) < 0.9
    ends = rng.uniform(0.5, 4, n)

    def ended(queued: bool) -> list[np.ndarray]:
        tracer = replace(prepared, uses_ray_queue=queued)
        rays = to_vector3(backend, o), to_vector3(backend, d)
        wanted = backend.Float(upload_floats(backend, active.astype(float))) > 0
        hit = tracer.first_hit(*rays, 0, upload_floats(backend, ends), wanted)
        blocked = tracer.occluded(*rays, 0, upload_floats(backend, ends), wanted)
        results = [hit.t, hit.value, hit.gradient, hit.evaluations, hit.status, hit.facet, blocked]
        results += [] if hit.patch is None else [hit.patch]
        dr.eval(results)
        return [np.broadcast_to(to_numpy(x), (n, *to_numpy(x).shape[1:])) for x in results]

    one_by_one, queued = ended(False), ended(True)
    status = one_by_one[4]
    assert (status == int(hk.RayStatus.HIT)).sum() > n // 20
    assert (status[~active] == int(hk.RayStatus.MISS)).all()
    if name == "few steps":
        assert (status == int(hk.RayStatus.OUT_OF_STEPS)).any()
    for a, b in zip(one_by_one, queued, strict=True):
        # What a ray that missed saw last is of no meaning, but no other lane may write it.
        np.testing.assert_array_equal(a[active], b[active])


def eye_rays(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of a camera, row by row."""
    y, x = np.divmod(np.arange(n * n), n)
    d = np.column_stack([x / n - 0.5, y / n - 0.5, np.full(n * n, -1.5)])
    return np.array([[0, 0, 3.0]]), d / np.linalg.norm(d, axis=1)[:, None]


def parallel_rays(n: int) -> tuple[np.ndarray, np.ndarray]:
    """From the points of a grid, row by row."""
    y, x = np.divmod(np.arange(n * n), n)
    return np.column_stack([x / n, y / n, np.full(n * n, 2.0)]), np.array([[0, 0, -1.0]])


@pytest.mark.parametrize("rays", [eye_rays, parallel_rays])
def test_rays_are_scattered_where_neighbors_differ(rays: Any) -> None:
    backend = choose_backend("single")
    o, d = rays(80)
    order = np.random.default_rng(0).permutation(6400)
    shuffled = [one[order] if len(one) > 1 else one for one in (o, d)]

    def scattered(o: np.ndarray, d: np.ndarray) -> bool:
        return _are_scattered(backend, to_vector3(backend, o), to_vector3(backend, d))

    assert scattered(*shuffled) == (dr.backend_v(backend.Float) == dr.JitBackend.LLVM)
    assert not scattered(o, d)
    assert not scattered(*(one[:200] for one in shuffled)), "too few to share lanes"
    still = np.repeat([[0.3, 0.2, 2.0]], 6400, axis=0)
    assert not scattered(still, np.repeat([[0, 0, -1.0]], 6400, axis=0))


def test_hostile_rays_are_asked_without_a_warning() -> None:
    rng = np.random.default_rng(2)
    o, d = rng.normal(size=(5000, 3)), rng.normal(size=(5000, 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hk.trace(saddle(), o * 1e149, d, precision="double")
        lost, way = (to_vector3(choose_backend("double"), one) for one in (o, d))
        hk.trace(saddle(), dr.select(lost > 3, dr.inf, lost), way)


def test_scattered_rays_end_as_others() -> None:
    surface = saddle()
    o, d = eye_rays(80)
    order = np.random.default_rng(0).permutation(6400)
    hits, others = hk.trace(surface, o, d), hk.trace(surface, o, d[order])
    assert hits.is_hit.sum() > 1000
    for name in ("t", "position", "normal", "evaluations", "status"):
        np.testing.assert_array_equal(getattr(hits, name)[order], getattr(others, name))


@dataclass(frozen=True)
class _Count:
    """Down from a number to zero."""

    left: Any
    steps: Any
    active: Any


@pytest.mark.parametrize("n", [1, 2, 3, 50_000])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_each_lane_of_a_queue_is_followed_to_its_end(n: int, share: float) -> None:
    backend = choose_backend("single")
    rng = np.random.default_rng(n)
    numbers, active = rng.integers(1, 200, n), rng.random(n) < share
    start = _Count(
        backend.UInt32(numbers.astype(np.uint32)),
        backend.UInt32(0),
        backend.Bool(active),
    )

    def down(now: _Count) -> _Count:
        return _Count(now.left - 1, now.steps + 2, now.active & (now.left > 1))

    end = loop_with_queue(start, down, lambda now: now, "count")
    np.testing.assert_array_equal(to_numpy(end.left), np.where(active, 0, numbers))
    np.testing.assert_array_equal(to_numpy(end.steps), np.where(active, 2 * numbers, 0))
    assert not to_numpy(end.active)[active].any()


@pytest.mark.parametrize("n", [1, 2, 1000])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_only_some_lanes_are_computed(n: int, share: float) -> None:
    backend = choose_backend("single")
    rng = np.random.default_rng(n)
    x, mask = rng.normal(size=n).astype(np.float32), rng.random(n) < share
    widths: list[int] = []

    @dataclass(frozen=True)
    class Pair:
        a: Any
        b: Any

    def double(pair: Pair) -> Pair:
        widths.append(dr.width(pair.a))
        return Pair(2 * pair.a, pair.b + 1)

    lanes = Pair(backend.Float(x), backend.Float(3))
    made = compute_on_active(
        backend.Bool(mask), double, lanes, Pair(backend.Float(-1), backend.Float(-2))
    )
    np.testing.assert_array_equal(to_numpy(made.a), np.where(mask, 2 * x, -1))
    np.testing.assert_array_equal(to_numpy(made.b), np.where(mask, 4, -2))
    # One number counts as the same in all lanes.
    assert widths == ([min(max(mask.sum(), 2), n)] if mask.any() else [])
