"""Two versions of the package beside each other, in one run: evaluations and CPU time of rays.

Run as a module it measures the version that is imported; `beside` runs it in turns for both.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_vector3
from harnack.fields.solid_angles.screened import ScreenedWindingNumber
from harnack.geometry.example_meshes import bumpy_sphere, remove_faces

from .growth import bumpy_cloud, one_hole
from .scenes import camera, others, polygons

WIDTH = 256
# Number of turns of the versions, and of runs of a scene in a turn, of which the fastest counts.
TURNS, REPEATS = 3, 3


def fields() -> dict[str, hk.Field]:
    """The traced fields, at the default level."""
    v, f = bumpy_sphere(6)
    damaged = remove_faces(f, 0.1, 0)
    points, normals, areas = bumpy_cloud(4000)
    named = {scene.name: scene.make() for scene in [*polygons(), *others()]}
    return named | {
        "dipole cloud, 10,000 points": hk.DipolePotential(*bumpy_cloud(10_000)),
        "dipole cloud, 100,000 points": hk.DipolePotential(*bumpy_cloud(100_000)),
        "screened cloud, 4,000 points": ScreenedWindingNumber(
            points, normals, areas, length=0.5, method="tree"
        ),
        "mesh by tree, 73,728 triangles": hk.WindingNumber(v, damaged, method="tree"),
        "exact mesh with a hole, 81,101 triangles": hk.WindingNumber(
            v, one_hole(v, f), method="exact"
        ),
    }


def measure() -> dict[str, list[float]]:
    """Evaluations a ray, evaluations a hitting ray and microseconds of CPU time a ray."""
    backend = choose_backend()
    eye, directions = camera(WIDTH)
    o, d = to_vector3(backend, eye[None]), to_vector3(backend, directions)
    rows: dict[str, list[float]] = {}
    for name, field in fields().items():
        hits = hk.trace(field, o, d, t_max=10.0, tolerance=1e-4)  # compiles
        seconds: list[float] = []
        for _ in range(REPEATS):
            dr.sync_thread()
            start = time.process_time()
            hits = hk.trace(field, o, d, t_max=10.0, tolerance=1e-4)
            dr.sync_thread()
            seconds.append(time.process_time() - start)
        n, hit = hits.evaluations.numpy(), hits.is_hit.numpy()
        rows[name] = [float(n.mean()), float(n[hit].mean()), min(seconds) / len(n) * 1e6]
    return rows


def beside(before: Path) -> str:
    """The section of the page; before: a checkout of the version to compare with."""
    source = before.resolve() / "src"
    if not (source / "harnack").is_dir():
        raise SystemExit(f"{before} is no checkout of harnack: it has no folder src/harnack")
    current = Path(hk.__file__).resolve().parent.parent
    rows_by_folder: dict[Path, list[dict[str, list[float]]]] = {source: [], current: []}
    for _ in range(TURNS):
        for folder, rows in rows_by_folder.items():
            rows.append(_in_a_process_of_its_own(folder))
    old, new = (_medians(rows_by_folder[folder]) for folder in (source, current))
    commit = subprocess.run(
        ["git", "-C", str(before), "rev-parse", "--short", "HEAD"],
        capture_output=True, text=True, check=True,
    ).stdout.strip()  # fmt: skip
    lines = [
        "## Beside an earlier version\n",
        f"Commit {commit} and this version in one run, in turns: {WIDTH} x {WIDTH} rays of the "
        "camera above, tolerance 1e-4, single precision. Microseconds are CPU time of all threads "
        f"a ray, the fastest of {REPEATS} runs, medians of {TURNS} turns.\n",
        "| scene | evaluations, before | now | hitting, before | now | microseconds, before | now "
        "| evaluations | CPU time |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, (all_old, hit_old, time_old) in old.items():
        all_new, hit_new, time_new = new[name]
        lines.append(
            f"| {name} | {all_old:.2f} | {all_new:.2f} | {hit_old:.2f} | {hit_new:.2f} "
            f"| {time_old:.2f} | {time_new:.2f} | {all_new / all_old:.2f} x "
            f"| {time_new / time_old:.2f} x |"
        )
    return "\n".join(lines) + "\n"


def _in_a_process_of_its_own(source: Path) -> Any:
    root = Path(__file__).resolve().parent.parent
    paths = os.pathsep.join([str(source), str(root)])
    out = subprocess.run(
        [sys.executable, "-m", "benchmarks.versions"],
        cwd=root, env={**os.environ, "PYTHONPATH": paths}, stdout=subprocess.PIPE, check=True,
    ).stdout  # fmt: skip
    return json.loads(out)


def _medians(turns: list[dict[str, list[float]]]) -> dict[str, list[float]]:
    return {name: np.median([turn[name] for turn in turns], axis=0).tolist() for name in turns[0]}


if __name__ == "__main__":
    print(json.dumps(measure()))
