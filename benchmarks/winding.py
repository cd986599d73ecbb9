"""Winding numbers at points: speed and accuracy, against libigl's fast winding number."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import choose_backend, to_vector3
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry.example_meshes import MeshArrays, bumpy_sphere, remove_faces

from .curve_cells import broken_mesh
from .rays import machine

POINTS = 1_000_000
CHECKED = 2_000
REPEATS = 5
# Of cells.
_MEGABYTES = 500
LIBIGL = "libigl, value"

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One way to compute winding numbers. Seconds are medians, for all points.

    kernel: the part of `seconds` for computing, without sorting and transfers; NaN if not known.
    """

    method: str
    seconds: float
    kernel: float
    median_error: float
    largest_error: float


def libigl(vertices: FloatArray, faces: Any, points: FloatArray) -> FloatArray:
    """libigl's fast winding number of a mesh: order 2, accuracy 2, single precision inside."""
    import igl

    return np.asarray(igl.fast_winding_number(vertices, faces, points), np.float64)


def query_points(vertices: FloatArray, n: int = POINTS) -> FloatArray:
    """(n, 3) points, uniform in the bounding box made half as large again about its center."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    offsets = np.random.default_rng(1).uniform(-0.75, 0.75, (n, 3))
    return 0.5 * (low + high) + offsets * (high - low)


def cube_points(n: int = POINTS) -> FloatArray:
    """(n, 3) points, uniform in [-1.5, 1.5]^3."""
    return np.random.default_rng(1).uniform(-1.5, 1.5, (n, 3))


def seconds_of(call: Callable[[], Any]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def kernel_seconds(call: Callable[[], Any]) -> float:
    """Seconds of Dr.Jit's kernels in a call: the median of three calls."""
    seconds: list[float] = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for _ in range(3):
            dr.kernel_history_clear()
            call()
            history = dr.kernel_history((dr.KernelType.JIT,))
            seconds.append(1e-3 * sum(float(entry["execution_time"]) for entry in history))
    return float(np.median(seconds))


def compare(mesh: MeshArrays, points: FloatArray, method: Any) -> list[Row]:
    """libigl, then `value` and `value_and_gradient` of harnack: in turn, medians of REPEATS."""
    vertices, faces = mesh
    options: Any = {"cells": _MEGABYTES} if method == "cells" else {"method": method}
    if method == "tree":  # without it, gradients are looked at more closely
        options["accuracy"] = 2.0
    field = WindingNumber(vertices, faces, **options)
    calls: dict[str, Callable[[], Any]] = {
        LIBIGL: lambda: libigl(vertices, faces, points),
        f"{method}, value": lambda: field.value(points, precision="single"),
        f"{method}, value and gradient": lambda: field.value_and_gradient(
            points, precision="single"
        )[0],
    }
    exact = WindingNumber(vertices, faces, method="exact")
    truth = exact.value(points[:CHECKED], precision="double")
    # The first calls compile, and show the errors.
    errors = {name: np.abs(call()[:CHECKED] - truth) for name, call in calls.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    builds: list[float] = []
    for _ in range(REPEATS):
        # libigl builds its tree in every call.
        builds.append(seconds_of(lambda: libigl(vertices, faces, points[:10])))
        for name, call in calls.items():
            times[name].append(seconds_of(call))
    times[LIBIGL] = [total - float(np.median(builds)) for total in times[LIBIGL]]
    return [
        Row(
            name,
            float(np.median(times[name])),
            float("nan") if name == LIBIGL else kernel_seconds(call),
            float(np.median(errors[name])),
            float(errors[name].max()),
        )
        for name, call in calls.items()
    ]


def throughput(surface: Path | None = None) -> str:
    """The section of the page; surface: the file of one more mesh."""
    closed = bumpy_sphere(6)
    damaged = closed[0], remove_faces(closed[1], 0.1, 0)
    cube = cube_points()
    soup = broken_mesh(6, "soup")
    took = seconds_of(
        lambda: WindingNumber(*soup, cells=_MEGABYTES).value(cube, precision="single")
    )
    groups = [
        ("bumpy sphere, 10 % of faces removed", damaged, cube, "tree"),
        ("bumpy sphere, closed", closed, cube, "exact"),
        ("soup", soup, cube, "tree"),
        ("soup", soup, cube, "cells"),
    ]
    if surface is not None:
        # Imported here: `versions` runs this file with earlier versions of the package.
        from harnack.files import read_geometry

        read: Any = read_geometry(surface, "winding")
        mesh = np.asarray(read.vertices, np.float64), np.asarray(read.faces, np.int64)
        groups += [(surface.stem, mesh, query_points(mesh[0]), m) for m in ("exact", "tree")]
    lines = [
        "## Winding numbers at points\n",
        f"{POINTS:,} points, in [-1.5, 1.5]^3 or in the bounding box made half as large again, on "
        f"{machine()} for both libraries, which take turns; medians of {REPEATS} runs. libigl is "
        "`igl.fast_winding_number` (order 2, accuracy 2), less the time of a call with 10 points, "
        "which is the time to build its tree. harnack in single precision, its tree with the same "
        "order and accuracy and built before, as are cells of at most "
        f"{_MEGABYTES} MB, which took {took:.0f} s; its seconds are those of the call on NumPy "
        f"arrays, with sorting the points ({_sorting(cube):.2f} s) and transfers; *kernel* is "
        "what is computing. Errors are against the exact winding number in double precision at "
        f"{CHECKED:,} of the points.\n",
        "| mesh | faces | method | seconds | kernel | million points/s | speed, libigl = 1 "
        "| median error | largest error |",
        "|---|---:|---|---:|---:|---:|---:|---:|---:|",
    ]

    for name, mesh, points, method in groups:
        rows = compare(mesh, points, method)
        for row in rows:
            lines.append(_line(name, len(mesh[1]), row, rows[0].seconds))
            print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def _sorting(points: FloatArray) -> float:
    # Imported here: `versions` runs this file with earlier versions of the package.
    from harnack.fields.batch_evaluation import morton_order

    backend = choose_backend("single")
    x = to_vector3(backend, points.astype(np.float32))

    def sort() -> None:
        dr.eval(morton_order(backend, x))
        dr.sync_thread()

    sort()
    return float(np.median([seconds_of(sort) for _ in range(REPEATS)]))


def _line(mesh: str, faces: int, row: Row, libigl_seconds: float) -> str:
    kernel = "" if np.isnan(row.kernel) else f"{row.kernel:.3f}"
    return (
        f"| {mesh} | {faces:,} | {row.method} | {row.seconds:.3f} | {kernel} "
        f"| {POINTS / row.seconds / 1e6:.2f} | {libigl_seconds / row.seconds:.2f} "
        f"| {row.median_error:.1e} | {row.largest_error:.1e} |"
    )
