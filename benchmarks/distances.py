"""Distances to surfaces: time of a point, against trimesh's nearest points and scipy's."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

import harnack as hk
from harnack.geometry import example_curves, example_meshes

from .rays import machine

FloatArray = npt.NDArray[np.float64]
POINTS, FEW = 1_000_000, 2_000


def _cpu(compute: Callable[[], object]) -> float:
    """CPU seconds of all threads."""
    start = time.process_time()
    compute()
    return time.process_time() - start


def _around(field: hk.Field, n: int) -> FloatArray:
    """Points (n, 3), uniform in the middle half of the box around the surface."""
    volume = field.domain or field.extent((field.default_level,))
    assert volume is not None
    low, high = volume.bounds()
    return 0.5 * (low + high) + np.random.default_rng(0).uniform(-0.25, 0.25, (n, 3)) * (high - low)


def _cloud(n: int) -> hk.DipolePotential:
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    p = np.column_stack([flat * np.cos(angle), flat * np.sin(angle), z])
    return hk.DipolePotential(p, p, np.full(n, 4 * np.pi / n))


def _with_holes() -> hk.WindingNumber:
    vertices, faces = example_meshes.bumpy_sphere(4)
    return hk.WindingNumber(vertices, example_meshes.remove_faces(faces, 0.1, 0))


def distances(n: int = POINTS) -> str:
    """The section's text."""
    fields: dict[str, tuple[hk.Field, int]] = {
        "closed mesh, 81,920 faces": (hk.WindingNumber(*example_meshes.bumpy_sphere(6)), n),
        "polygon, 24 edges": (hk.SolidAngle(example_curves.wavy_polygon(24)), n // 10),
        "trefoil, 60 edges": (hk.SolidAngle(example_curves.torus_knot(2, 3, 60)), n // 10),
        "gyroid": (hk.Gyroid(), n // 10),
        "cloud of 2,000 points": (_cloud(2000), n // 50),
        "mesh of 5,120 faces, a tenth lost": (_with_holes(), n // 10),
    }
    rows = [
        "| surface | points | us a point | gap, median | gap, 90 % |", "|---|---|---|---|---|"
    ]  # fmt: skip
    for name, (field, count) in fields.items():
        x = _around(field, count)
        hk.signed_distance(field, x[:200])
        seconds = _cpu(lambda field=field, x=x: hk.signed_distance(field, x))
        bounds = hk.distance.distance_bounds(field, x[: min(count, 20_000)])
        gap = (bounds.upper - bounds.lower) / np.ptp(x, axis=0).max()
        median, upper = np.quantile(gap, [0.5, 0.9])
        rows.append(
            f"| {name} | {count:,} | {1e6 * seconds / count:.1f} | {median:.1g} | {upper:.1g} |"
        )
    vertices, faces = example_meshes.bumpy_sphere(6)
    x = _around(fields["closed mesh, 81,920 faces"][0], FEW)
    nearest = _cpu(lambda: cKDTree(vertices).query(x))
    peers = [f"scipy's k-d tree, to the nearest vertex alone: {1e6 * nearest / FEW:.1f} us"]
    try:
        import trimesh

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        mesh.nearest.on_surface(x[:10])  # pyright: ignore
        seconds = _cpu(lambda: mesh.nearest.on_surface(x))  # pyright: ignore
        peers.append(
            f"trimesh's `nearest.on_surface`, without a sign: {1e6 * seconds / FEW:.0f} us"
        )
    except ImportError:
        pass
    return "\n".join([
        "## Distances",
        "",
        f"`signed_distance` at points in the middle half of the box around a surface, double "
        f"precision, CPU time of all threads with all preparations ({machine()}). The gap is that "
        "between the distance and what is proved (`distance_bounds`), in sizes of that box, of the "
        "first 20,000 points.",
        "",
        *rows,
        "",
        f"To the same mesh, {FEW:,} points: " + "; ".join(peers) + ".",
        "",
    ])  # fmt: skip
