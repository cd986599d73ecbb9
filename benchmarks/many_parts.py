"""Models of many parts: unions of spheres and struts, smooth unions, and a lattice in a cylinder.

Each model is measured in a process of its own, first without and then with kernels on disk.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

import harnack as hk

from .scenes import camera

_COUNTS = (10, 100, 1_000, 10_000)
# The size of pictures; the number of rays to a side of what is traced; and the number of cells of
# the lattice along the diameter and the height of the cylinder.
_SIZE, _WIDTH, _CELLS = (160, 120), 256, 20
_ROOT = Path(__file__).resolve().parent.parent


def spheres(count: int) -> list[hk.fields.Solid]:
    """Spheres at random in the unit cube about the origin, of a size that fills a part of it."""
    rng = np.random.default_rng(0)
    radius = 0.4 * count ** (-1 / 3)
    return [hk.Sphere(radius, tuple(center)) for center in rng.uniform(-0.5, 0.5, (count, 3))]


def random_struts(count: int, smooth: float | None = None) -> hk.fields.Solid:
    """Struts of different radii at random in the unit cube about the origin. smooth: the radius of
    fillets; None for none."""
    rng = np.random.default_rng(1)
    size = count ** (-1 / 3)
    start = rng.uniform(-0.5, 0.5, (count, 3))
    nodes = np.concatenate([start, start + size * rng.uniform(-0.5, 0.5, (count, 3))])
    edges = np.column_stack([np.arange(count), count + np.arange(count)])
    radii = size * rng.uniform(0.05, 0.15, 2 * count)
    return hk.solids.struts(nodes, edges, radii, smooth=smooth)


def lattice(cells: int) -> hk.fields.Solid:
    """An octet lattice in a cylinder of 40 mm, with so many cells along its diameter and height.
    One unit is 40 mm."""
    cylinder = hk.Cylinder(0.5, 1.0)
    cell = 1.0 / cells
    return hk.lattice.octet(cell, region=cylinder).struts(0.08 * cell) & cylinder


_KINDS: dict[str, Callable[[int], hk.fields.Solid]] = {
    "spheres": lambda n: hk.union(spheres(n)),
    "struts": random_struts,
    "spheres, smooth": lambda n: hk.smooth_union(spheres(n), 0.1 * n ** (-1 / 3)),
    "struts, smooth": lambda n: random_struts(n, 0.1 * n ** (-1 / 3)),
    "octet lattice": lattice,
}


@dataclass(frozen=True)
class Row:
    """What was measured of a model, in CPU seconds of all cores.

    construction: of the solid.
    first_picture: of a shaded picture.
    microseconds, evaluations: of a camera ray, in a second trace.
    compiled: kernels that were compiled for a picture and a trace of the model with one more part;
        None if it was not tried.
    mesh: of a mesh; None if none was made.
    triangles: of the mesh.
    """

    construction: float
    first_picture: float
    microseconds: float
    evaluations: float
    compiled: int | None = None
    mesh: float | None = None
    triangles: int | None = None


def measure(kind: str, count: int) -> Row:
    """Measure a model in this process. kind: a key of `_KINDS`; count: its parts, or its cells."""
    make = _KINDS[kind]
    from harnack import rendering

    del rendering  # imported, so that its import is not measured
    start = time.process_time()
    solid = make(count)
    construction = time.process_time() - start
    origin, directions = camera(_WIDTH)
    origins = np.broadcast_to(origin, directions.shape)
    first_picture = _draw(solid)
    hk.trace(solid, origins, directions)
    start = time.process_time()
    hits = hk.trace(solid, origins, directions)
    evaluations = float(np.mean(np.array(hits.evaluations)))
    microseconds = (time.process_time() - start) / len(directions) * 1e6
    row = partial(Row, construction, first_picture, microseconds, evaluations)
    if kind == "octet lattice":
        start = time.process_time()
        mesh: Any = hk.mesh(solid, tolerance=0.02 / count, max_triangles=20_000_000)
        return row(mesh=time.process_time() - start, triangles=len(mesh.faces))
    return row(compiled=_compiled(lambda: _draw(make(count + 1))))


def _draw(solid: hk.fields.Solid) -> float:
    """Draw a solid, shaded, and return the CPU seconds."""
    start = time.process_time()
    hk.render(solid, show="shaded", size=_SIZE, progress=False)
    return time.process_time() - start


def _compiled(task: Callable[[], Any]) -> int:
    """The number of kernels that are compiled in a task."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        task()
        history: list[dict[str, Any]] = dr.kernel_history()
    return sum(not k.get("cache_hit", True) and not k.get("cache_disk", False) for k in history)


def _measured_apart(kind: str, count: int, home: Path) -> Row:
    """Measure in a process of its own whose kernels are kept in a folder.

    home: the folder that is the user's home to it, where Dr.Jit keeps kernels.
    """
    run = subprocess.run(
        [sys.executable, "-m", "benchmarks.many_parts", kind, str(count)],
        cwd=_ROOT, env={**os.environ, "HOME": str(home)}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    if run.returncode != 0:
        raise RuntimeError(f"measuring {count:,} {kind} failed ({run.returncode}): {run.stderr}")
    return Row(**json.loads(run.stdout.splitlines()[-1]))


def many_parts(counts: tuple[int, ...] = _COUNTS, cells: int = _CELLS) -> str:
    """Measure, and return the section of the page.

    counts: of the parts of unions; smooth unions have the last but one.
    cells: of the lattice, along the cylinder.
    """
    models = [(kind, n) for kind in ("spheres", "struts") for n in counts]
    models += [(kind, counts[max(0, len(counts) - 2)]) for kind in _KINDS if "smooth" in kind]
    models += [("octet lattice", cells)]
    lines = [
        "## Models of many parts\n",
        "Unions of spheres and of struts at random (`benchmarks/many_parts.py`), the same with "
        f"fillets, and an octet lattice of {cells} cells to a side in a cylinder of 40 mm, with "
        "struts of 0.08 cells. *Made*: the solid. *First picture*: shaded, "
        f"{_SIZE[0]} x {_SIZE[1]} pixels, in a fresh process, without kernels on disk and with "
        f"them. A ray: of {_WIDTH} x {_WIDTH} of a camera, in a second trace. *Kernels*: compiled "
        "for a picture of the model with one part more. Seconds and microseconds are of CPU "
        "time, of all cores.\n",
        "| model | parts | made, s | first picture, cold, s | with kernels, s | a ray, µs "
        "| evaluations | kernels |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    notes: list[str] = []
    for kind, count in models:
        with tempfile.TemporaryDirectory() as folder:
            cold = _measured_apart(kind, count, Path(folder))
            warm = _measured_apart(kind, count, Path(folder))
        parts = f"{count}³ cells" if kind == "octet lattice" else f"{count:,}"
        compiled = "" if cold.compiled is None else str(cold.compiled)
        lines.append(
            f"| {kind} | {parts} | {warm.construction:.2f} | {cold.first_picture:.1f} "
            f"| {warm.first_picture:.1f} | {warm.microseconds:.1f} | {warm.evaluations:.2f} "
            f"| {compiled} |"
        )
        if warm.mesh is not None:
            notes.append(
                f"\nThe lattice's mesh, within 0.02 cells: {warm.mesh:.0f} s, "
                f"{warm.triangles:,} triangles."
            )
    return "\n".join([*lines, *notes, ""])


if __name__ == "__main__":
    print(json.dumps(vars(measure(sys.argv[1], int(sys.argv[2])))))
