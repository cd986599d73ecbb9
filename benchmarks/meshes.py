"""Meshes of level sets beside those of other programs: time, triangles, evaluations and errors."""

from __future__ import annotations

import importlib.metadata
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

import harnack as hk
from harnack.geometry import example_curves
from tests.oracles.oracle import CurveOracle

FloatArray = npt.NDArray[np.float64]
_SAMPLES = 20_000
_HITS = 4_000
_PERIOD = 4 * math.pi
# Half of a gyroid's wall, as a value of the function; its cell is 1 and the box two cells wide.
_WALL = 0.3
_CELL = 2 * math.pi
# The volume of the wall, by the values on lattices of up to 800^3 points, to 5e-5.
_VOLUME = 1.54755


@dataclass(frozen=True)
class _Row:
    """One mesh. far: the largest distance of a point of the mesh from the surface; rms: the root
    mean square; missed: the largest distance of a point of the surface from the mesh, None where it
    was not measured; all relative to the size."""

    name: str
    seconds: float
    mesh: trimesh.Trimesh
    evaluations: int
    far: float
    rms: float
    missed: float | None


def meshes() -> str:
    """Measure, and return the section of the page."""
    lines = [
        "## Meshes\n",
        "Level 2 pi of two curves, and the wall |f| < 0.3 of a gyroid of cell 1 in a box of two "
        f"cells, cut by the box. Errors are those of {_SAMPLES:,} random points of the mesh, by "
        f"the slope of the function there, and of {_HITS:,} hits of rays to the mesh, as parts of "
        "the size; tolerances are parts of the longest side of the box around the level set. Time "
        "is CPU time, with the evaluations of f, which for marching cubes are made by harnack in "
        "one batch. Marching cubes (scikit-image) meets the angle's jumps of 4 pi as surfaces; "
        "*cleaned* leaves out triangles where the angle is not near the level. Of harnack the time "
        "includes the checks and what is proved about the topology. *Volume* is the relative error "
        "of that of closed meshes, and whether their triangles face inwards. "
        f"{_peer()}\n",
        "| surface | mesh | seconds | evaluations | triangles | Euler characteristic | pieces "
        "| ends at the curve | largest error | rms | surface to mesh | volume |",
        "|---|---|---:|---:|---:|---:|---:|---|---:|---:|---:|---:|",
    ]
    hk.mesh(hk.SolidAngle(example_curves.regular_polygon(8)), tolerance=0.1)  # compiles
    for name, loop, steps in (
        ("wavy polygon", example_curves.wavy_polygon(64), (0.05, 0.025)),
        ("trefoil", example_curves.torus_knot(2, 3, 96), (0.06, 0.03)),
    ):
        rows = [_ours(loop, tolerance) for tolerance in (1e-3, 2.5e-4)]
        for step in steps:
            rows += _cubes(loop, step)
        lines += [_line(name, row, len(loop)) for row in rows]
    lines += [_line("gyroid wall", row, None) for row in _walls()]
    return "\n".join(lines) + "\n"


def _line(surface: str, row: _Row, rim: int | None) -> str:
    missed = "" if row.missed is None else f"{row.missed:.1e}"
    volume = ""
    if rim is None:
        volume = f"{abs(row.mesh.volume) / _VOLUME - 1:+.2%}"
        volume += ", inwards" if row.mesh.volume < 0 else ""
    ends = ""
    if rim is not None:
        edges = np.asarray(row.mesh.edges_sorted)
        _, uses = np.unique(edges, axis=0, return_counts=True)
        ends = "exactly" if int((uses == 1).sum()) == rim else "no"
    return (
        f"| {surface} | {row.name} | {row.seconds:.2f} | {row.evaluations:,} "
        f"| {len(row.mesh.faces):,} | {row.mesh.euler_number} | {row.mesh.body_count} | {ends} "
        f"| {row.far:.1e} | {row.rms:.1e} | {missed} | {volume} |"
    )


def _peer() -> str:
    """The version of microgen that takes part."""
    try:
        return f"microgen is {importlib.metadata.version('microgen')}."
    except importlib.metadata.PackageNotFoundError:
        return "microgen was not installed (the extra `peers`)."


def _timed(make: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    return make(), time.process_time() - start


def _ours(loop: FloatArray, tolerance: float) -> _Row:
    """tolerance: as a part of the longest side of the box around the level set."""
    extent = hk.SolidAngle(loop).extent((2 * math.pi,))
    assert extent is not None
    length = tolerance * float(np.ptp(extent.bounds(), axis=0).max())
    mesh, seconds = _timed(lambda: hk.mesh(hk.SolidAngle(loop), tolerance=length))
    evaluations = mesh.metadata["harnack"]["evaluations"]
    name = f"harnack, tolerance {tolerance:g}"
    return _Row(name, seconds, mesh, evaluations, *_curve_errors(loop, mesh))


def _curve_errors(loop: FloatArray, mesh: trimesh.Trimesh) -> tuple[float, float, float]:
    """Largest and rms error, and the largest distance of hits from the mesh, relative to the
    size."""
    size, rng = float(np.ptp(loop, axis=0).max()), np.random.default_rng(0)
    points: FloatArray = np.asarray(mesh.sample(_SAMPLES, seed=0))
    exact = CurveOracle([loop])(points)
    gap = exact.value - 2 * math.pi
    gap -= _PERIOD * np.round(gap / _PERIOD)
    # Where the slope leads past the curve, the curve, which ends every level, is the nearest.
    error = np.minimum(np.abs(gap) / np.linalg.norm(exact.gradient, axis=1), exact.smooth) / size
    direction = rng.normal(size=(8 * _HITS, 3))
    origin = 4 * direction / np.linalg.norm(direction, axis=1)[:, None]
    aim = rng.uniform(-1, 1, origin.shape) - origin
    hits = hk.trace(hk.SolidAngle(loop), origin, aim, tolerance=1e-4)
    missed = _distances(mesh, np.asarray(hits.position[hits.is_hit])[:_HITS]).max() / size
    return float(error.max()), float(np.sqrt((error**2).mean())), float(missed)


def _distances(mesh: trimesh.Trimesh, points: FloatArray) -> FloatArray:
    """(n,) distances to the nearest of the triangles of which a center or a midpoint of an edge is
    among the 32 nearest: hardly too large."""
    from scipy.spatial import cKDTree

    corner = np.asarray(mesh.triangles)
    middles = 0.5 * (corner + np.roll(corner, 1, axis=1))
    samples = np.concatenate([corner.mean(axis=1)[:, None], middles], axis=1).reshape(-1, 3)
    triangle_ids = cKDTree(samples).query(points, k=32)[1] // 4
    distances = np.full(len(points), np.inf)
    for owner in triangle_ids.T:
        foot = trimesh.triangles.closest_point(corner[owner], points)
        distances = np.minimum(distances, np.linalg.norm(foot - points, axis=1))
    return distances


def _cubes(loop: FloatArray, step: float) -> list[_Row]:
    """Marching cubes over the same box, as they are and cleaned."""
    from skimage.measure import marching_cubes

    field, evaluations = hk.SolidAngle(loop), 0
    lower, upper = (np.array(end) for end in field.extent((2 * math.pi,)).bounds())
    counts = np.ceil((upper - lower) / step).astype(int) + 3

    def wrapped(points: FloatArray) -> FloatArray:
        nonlocal evaluations
        evaluations += len(points)
        residual = field.value(points, precision="double") - 2 * math.pi
        return residual - _PERIOD * np.round(residual / _PERIOD)

    def make() -> tuple[FloatArray, Any, Any]:
        axes = [lower[k] + step * (np.arange(counts[k]) - 1) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = wrapped(grid.reshape(-1, 3)).reshape(counts)
        vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(step,) * 3)
        vertices = vertices.astype(float) + lower - step
        return vertices, faces, faces[(np.abs(wrapped(vertices)) < 1.0)[faces].all(axis=1)]

    (vertices, faces, cleaned), seconds = _timed(make)
    rows: list[_Row] = []
    for name, subset in (("", faces), (", cleaned", cleaned)):
        mesh = trimesh.Trimesh(vertices, subset, process=False)
        mesh.remove_unreferenced_vertices()
        label = f"marching cubes, step {step:g}{name}"
        rows.append(_Row(label, seconds, mesh, evaluations, *_curve_errors(loop, mesh)))
    return rows


def _gyroid(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Value (n,) and gradient (n, 3)."""
    s, c = np.sin(_CELL * x), np.cos(_CELL * x)
    a, b = np.roll(c, -1, axis=1), np.roll(s, 1, axis=1)  # c of the next, s of the one before
    value = (s * a).sum(axis=1)
    return value, _CELL * (c * a - b * s)


def _walls() -> list[_Row]:
    """The closed wall by harnack and by programs that are installed."""

    def ours() -> Any:
        box = hk.Box((-1, -1, -1), (1, 1, 1))
        return hk.mesh(
            hk.Gyroid(cell=1.0), level=(-_WALL, _WALL), side="between", clip=box, tolerance=4e-3
        )

    mesh, seconds = _timed(ours)
    evaluations = mesh.metadata["harnack"]["evaluations"]
    rows = [_Row("harnack, tolerance 0.002", seconds, mesh, evaluations, *_wall_errors(mesh))]
    rows += [_cubes_wall(step) for step in (0.05, 0.025)]
    rows += [row for row in (_manifold_wall(0.05), _microgen_wall(10), _microgen_wall(40)) if row]
    return rows


def _wall_errors(mesh: trimesh.Trimesh) -> tuple[float, float, None]:
    points: FloatArray = np.asarray(mesh.sample(_SAMPLES, seed=0))
    value, slope = _gyroid(points)
    error = np.abs(np.abs(value) - _WALL) / np.maximum(np.linalg.norm(slope, axis=1), 1e-9)
    error = np.minimum(error, np.abs(np.abs(points).max(axis=1) - 1)) / 2  # or on the box
    return float(error.max()), float(np.sqrt((error**2).mean())), None


def _cubes_wall(step: float) -> _Row:
    from skimage.measure import marching_cubes

    axis = np.arange(-1 - step, 1 + 2 * step, step)

    def make() -> trimesh.Trimesh:
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        points = grid.reshape(-1, 3)
        wall = _WALL - np.abs(_gyroid(points)[0])
        inside = np.minimum(wall, _CELL * (1 - np.abs(points).max(axis=1)))
        vertices, faces, _, _ = marching_cubes(
            inside.reshape(grid.shape[:3]), 0.0, spacing=(step,) * 3
        )
        return trimesh.Trimesh(vertices + axis[0], faces, process=False)

    mesh, seconds = _timed(make)
    name = f"marching cubes of the wall, step {step:g}"
    return _Row(name, seconds, mesh, len(axis) ** 3, *_wall_errors(mesh))


def _manifold_wall(step: float) -> _Row | None:
    """manifold3d's `level_set` calls back point by point: the points are recorded first, evaluated
    in one batch, and handed out in the same order."""
    try:
        import manifold3d
    except ImportError:
        return None
    ends = [-1.1] * 3 + [1.1] * 3
    recorded: list[tuple[float, float, float]] = []

    def make() -> trimesh.Trimesh:
        def record(x: float, y: float, z: float) -> float:
            recorded.append((x, y, z))
            return -1.0

        manifold3d.Manifold.level_set(record, ends, step)
        wall = _WALL - np.abs(_gyroid(np.array(recorded))[0])
        values = dict(zip(recorded, wall.tolist(), strict=True))

        def replay(x: float, y: float, z: float) -> float:
            value = values.get((x, y, z))
            if value is None:  # points of its root finding, one by one
                value = _WALL - abs(float(_gyroid(np.array([[x, y, z]]))[0][0]))
                values[x, y, z] = value
            return value

        solid = manifold3d.Manifold.level_set(replay, ends, step, 0.0, 1e-4)
        solid = solid ^ manifold3d.Manifold.cube([2, 2, 2], True)
        arrays = solid.to_mesh()
        recorded[:] = list(values)
        return trimesh.Trimesh(
            np.asarray(arrays.vert_properties)[:, :3], np.asarray(arrays.tri_verts), process=False
        )

    mesh, seconds = _timed(make)
    name = f"manifold3d level_set of the wall, edge {step:g}"
    return _Row(name, seconds, mesh, len(recorded), *_wall_errors(mesh))


def _microgen_wall(resolution: int) -> _Row | None:
    """microgen's sheet."""
    try:
        import microgen
        from microgen.shape.surface_functions import gyroid
    except ImportError:
        print(f"skipped: microgen, resolution {resolution}: pip install '.[peers]' (1.6 GB)")
        return None

    def make() -> trimesh.Trimesh:
        sheet = microgen.Tpms(
            surface_function=gyroid, offset=2 * _WALL, repeat_cell=2, resolution=resolution,
            cell_size=1.0,
        ).generate_vtk(type_part="sheet").triangulate()  # fmt: skip
        return trimesh.Trimesh(
            np.asarray(sheet.points, float), sheet.faces.reshape(-1, 4)[:, 1:], process=False
        )

    mesh, seconds = _timed(make)
    count = (2 * resolution) ** 3
    name = f"microgen, resolution {resolution}"
    return _Row(name, seconds, mesh, count, *_wall_errors(mesh))
