"""Evaluations a ray and rays a second for every rule on every scene."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_vector3

from .scenes import Scene, WithoutExtent, camera

WIDTH = 512
REPEATS = 5
RULES: tuple[tuple[str, str | None, float | None], ...] = (
    ("classic", "classic", 1.75),
    ("slope", "slope", 1.0),
    ("slope, over-stepping", "slope", 1.4),
    ("caps", "caps", 1.0),
    ("caps, over-stepping", "caps", 1.4),
    ("all proofs, over-stepping", None, None),
)


@dataclass(frozen=True)
class Row:
    """One scene under one rule. Times are medians of several runs."""

    scene: str
    rule: str
    evaluations: float
    evaluations_hitting: float
    most: int
    out_of_steps: int
    hits: int
    core_seconds: float
    nanoseconds_a_vertex: float

    @property
    def rays_per_core_second(self) -> float:
        return WIDTH * WIDTH / self.core_seconds


def threads() -> int:
    """Threads that Dr.Jit computes with."""
    return dr.thread_count()


def measure(
    scene: Scene, rule: tuple[str, str | None, float | None], field: hk.Field | None = None
) -> Row:
    """Trace the camera's rays and count."""
    name, enclosures, over_relaxation = rule
    backend = choose_backend()
    eye, directions = camera(WIDTH)
    o = to_vector3(backend, eye[None])
    d = to_vector3(backend, directions)
    surface = hk.Surface(field or scene.make())
    options = hk.TraceOptions(
        tolerance=1e-4, enclosures=enclosures, over_relaxation=over_relaxation
    )
    seconds, hits = [], None
    for _ in range(REPEATS + 1):  # the first run compiles
        wall, core = time.perf_counter(), time.process_time()
        hits = hk.trace(surface, o, d, t_max=10.0, options=options)
        dr.sync_thread()
        wall, core = time.perf_counter() - wall, time.process_time() - core
        # On a GPU the processor only waits: one device is one core.
        seconds.append(wall if backend.name == "cuda" else core)
    assert hits is not None
    n, status = hits.evaluations.numpy(), hits.status.numpy()
    hit = status == int(hk.RayStatus.HIT)
    median = float(np.median(seconds[1:]))
    vertex = median / (n.sum() * scene.vertices) * 1e9 if scene.vertices else float("nan")
    return Row(
        scene.name, name, float(n.mean()), float(n[hit].mean()), int(n.max()),
        int((status == int(hk.RayStatus.OUT_OF_STEPS)).sum()), int(hit.sum()), median, vertex,
    )  # fmt: skip


def published(scene: Scene) -> Row:
    """The classic rule as published: no clip volume, so rays march past the surface to t_max."""
    field = scene.make()
    assert isinstance(field, hk.SolidAngle)
    open_field = WithoutExtent(list(field.loops), lift_bound="paper")
    return measure(scene, ("classic, as published (no clip)", "classic", 1.75), open_field)


def machine() -> str:
    """The processor or device, for the heading of the table."""
    backend = choose_backend()
    if backend.name == "cuda":
        import subprocess

        query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        return subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    name = "unknown processor"
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            models = [line.split(":")[1].strip() for line in lines if "model name" in line]
        name = models[0] if models else name
    return f"{name}, {threads()} threads"
