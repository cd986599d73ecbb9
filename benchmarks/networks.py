"""Neural networks trained on the signed distance of a mesh: how soon the first picture is there,
whether a first hit is missed, and what rays cost beside other ways to find hits."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import harnack as hk
from harnack.geometry.example_meshes import bumpy_sphere
from tests.oracles.networks import first_hits, network_value_and_gradient

Layers = list[tuple[Any, Any]]

POINTS, BATCH, SAMPLES, PICTURE = 60_000, 2048, 400, (160, 120)
_SIZE = 0.6  # of the mesh
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Case:
    """A network: its widths, the steps of its training, and the rays that are compared."""

    widths: tuple[int, ...]
    steps: int
    rays: int

    @property
    def name(self) -> str:
        return "-".join(map(str, (3, *self.widths, 1)))


CASES = (Case((64, 64), 2000, 100_000), Case((256, 256, 256), 500, 5_000))


def training_set() -> tuple[Any, Any]:
    """Points, half of them near the mesh, and their signed distances."""
    rng = np.random.default_rng(0)
    vertices, faces = bumpy_sphere(4)
    vertices = _SIZE * vertices
    near = vertices[rng.integers(len(vertices), size=POINTS // 2)]
    near = near + 0.08 * rng.normal(size=near.shape)
    x = np.clip(np.concatenate([rng.uniform(-1, 1, near.shape), near]), -1, 1)
    return x.astype(np.float32), hk.signed_distance(hk.solid((vertices, faces)), x)


def trained(case: Case, x: Any, distance: Any) -> Layers:
    """A ReLU network that was fitted by Adam (Kingma and Ba 2015)."""
    rng, sizes = np.random.default_rng(1), (3, *case.widths, 1)
    numbers: list[Any] = []
    for k, m in itertools.pairwise(sizes):
        numbers += [rng.normal(size=(m, k)) * np.sqrt(2 / k), rng.uniform(-0.5, 0.5, m)]
    numbers = [array.astype(np.float32) for array in numbers]
    first, second = ([np.zeros_like(array) for array in numbers] for _ in range(2))
    for step in range(case.steps):
        rows = rng.integers(len(x), size=BATCH)
        gradients = _gradients(numbers, x[rows], distance[rows].astype(np.float32))
        rate = 2e-3 * min(1.0, 2 * (1 - step / case.steps))
        for k, gradient in enumerate(gradients):
            first[k] = 0.9 * first[k] + 0.1 * gradient
            second[k] = 0.99 * second[k] + 0.01 * gradient**2
            mean, square = first[k] / (1 - 0.9 ** (step + 1)), second[k] / (1 - 0.99 ** (step + 1))
            numbers[k] = (numbers[k] - rate * mean / (np.sqrt(square) + 1e-10)).astype(np.float32)
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _gradients(numbers: list[Any], x: Any, distance: Any) -> list[Any]:
    """The gradient of Huber's loss by all weights."""
    values = [x]
    for weights, bias in zip(numbers[:-2:2], numbers[1:-2:2], strict=True):
        values.append(np.maximum(values[-1] @ weights.T + bias, 0))
    error = (values[-1] @ numbers[-2].T + numbers[-1])[:, 0] - distance
    back = (np.clip(error / 0.01, -1, 1) / len(x))[:, None]
    gradients: list[Any] = [None] * len(numbers)
    for layer in reversed(range(len(values))):
        gradients[2 * layer : 2 * layer + 2] = [back.T @ values[layer], back.sum(axis=0)]
        back = (back @ numbers[2 * layer]) * (values[layer] > 0)
    return gradients


def _rays(count: int) -> tuple[Any, Any]:
    """Rays from a sphere around the cube to points of it, in single precision."""
    rng = np.random.default_rng(2)
    origins = rng.normal(size=(count, 3))
    origins *= 1.8 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.8, 0.8, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32).astype(float), directions.astype(np.float32).astype(float)


_FIRST = """
import sys, time
import numpy as np
import harnack as hk
start = time.process_time()
network = hk.Network.from_file(sys.argv[1])
hk.render(network, sys.argv[2], size=(int(sys.argv[3]), int(sys.argv[4])), show="shaded")
print(time.process_time() - start)
"""


def first_pictures(layers: Layers) -> tuple[float, float]:
    """The processor time in seconds of a shaded picture in a new process, without and with kernels
    that an earlier process left on the disk."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.npz"
        arrays = {f"weight_{k}": w for k, (w, _) in enumerate(layers)}
        np.savez(path, **arrays, **{f"bias_{k}": b for k, (_, b) in enumerate(layers)})
        command = [sys.executable, "-c", _FIRST, str(path), f"{folder}/picture.png"]
        command += [str(number) for number in PICTURE]
        times: list[float] = []
        for _ in range(2):  # the home folder, in which Dr.Jit keeps its kernels, is new
            process = subprocess.run(
                command, env=os.environ | {"HOME": folder}, check=True, capture_output=True,
                text=True,
            )  # fmt: skip
            times.append(float(process.stdout.split()[-1]))
    return times[0], times[1]


def missed(layers: Layers, hits: Any, expected: Any, origins: Any, directions: Any) -> int:
    """The number of rays on which the first crossing that dense sampling found was missed, or a hit
    lies where the network is not near the level."""
    status = np.asarray(hits.status)
    t = np.where(status == hk.RayStatus.HIT, hits.t, np.inf)
    wrong = t > expected + _TOLERANCE
    early = np.flatnonzero(np.isfinite(t) & (t < expected - _TOLERANCE))
    points = origins[early] + t[early, None] * directions[early]
    value, gradient = network_value_and_gradient(layers, "relu", points)
    wrong[early] = np.abs(value) > _TOLERANCE * (1 + np.linalg.norm(gradient, axis=1))
    return int(wrong.sum())


def networks() -> str:
    """The section of the page."""
    lines = [
        "## Neural networks\n",
        "ReLU networks fitted to the signed distance of a bumpy sphere's mesh. *First picture*: "
        f"processor time of {PICTURE[0]} x {PICTURE[1]} pixels, shaded, in a new process, without "
        "and with kernels on the disk. *Missed*: of the rays, compared with "
        f"{SAMPLES} samples on each and bisection, in double precision. Evaluations are means a "
        "ray, times processor time; *spheres* is sphere tracing with proved Lipschitz constants "
        'in balls (`enclosures="lipschitz"`), *samples* the dense sampling, in NumPy.\n',
        "| network | error of the fit | first picture | again | rays | missed | out of steps "
        "| evaluations | µs | spheres: evaluations | µs | samples: evaluations | µs |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    x, distance = training_set()
    for case in CASES:
        layers = trained(case, x, distance)
        field = hk.Network(layers)
        error = np.abs(field.value(x[:4096]) - distance[:4096]).mean()
        cold, warm = first_pictures(layers)
        origins, directions = _rays(case.rays)
        few = slice(0, min(case.rays, 2000))
        hk.trace(field, origins, directions)  # kernels and cells, of which first pictures tell
        start = time.process_time()
        hits = hk.trace(field, origins, directions)
        own = (time.process_time() - start) / case.rays
        hk.trace(field, origins[:64], directions[:64], enclosures="lipschitz")
        start = time.process_time()
        other = hk.trace(field, origins[few], directions[few], enclosures="lipschitz")
        spheres = (time.process_time() - start) / len(other.t)
        start = time.process_time()
        pieces = [
            first_hits(
                layers, "relu", origins[k : k + 500], directions[k : k + 500],
                ((-1.0,) * 3, (1.0,) * 3), 0.0, SAMPLES,
            )[0]
            for k in range(0, case.rays, 500)
        ]  # fmt: skip
        dense = (time.process_time() - start) / case.rays
        count = missed(layers, hits, np.concatenate(pieces), origins, directions)
        stopped = int((np.asarray(hits.status) == hk.RayStatus.OUT_OF_STEPS).sum())
        lines.append(
            f"| {case.name} | {error:.4f} | {cold:.1f} s | {warm:.1f} s | {case.rays:,} | {count} "
            f"| {stopped} | {hits.evaluations.mean():.1f} | {1e6 * own:.0f} "
            f"| {other.evaluations.mean():.1f} | {1e6 * spheres:.0f} | {SAMPLES} "
            f"| {1e6 * dense:.0f} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"
