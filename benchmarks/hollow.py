"""Meshes hollowed, with a lattice inside and vents: time, closedness, and walls, measured without
the library's own distances."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.spatial
import trimesh

import harnack as hk
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection import intersecting_faces

from .repair import is_solid

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# In millimeters: the size to which parts are scaled, walls, cells, and the radius of vents; and the
# tolerance, as a part of the longest side.
_SIZE, _WALL, _CELL, _VENT = 80.0, 2.0, 8.0, 2.0
_TOLERANCE = 1.2e-3
_NAMES = ("stanford-bunny", "spot", "cow", "homer")
# Number of meshes that are processed at once; and the message at each attempt.
_AT_ONCE, _TOGETHER = 4, "putting the parts together"
# Number of sampled points of the outer side; the distance from it within which faces count as parts
# of it; and the distance from the axes of vents, in millimeters, beyond which points are used.
_SAMPLES, _OUTSIDE, _AWAY = 20_000, 1e-5, 3.0


@dataclass(frozen=True)
class _Row:
    """The part that was made of a mesh. attempts: the number of times that its parts were put
    together. walls: the thinnest, the median, and the thickness that 99.9 % are below."""

    seconds: float
    attempts: int
    triangles: int
    is_closed: bool
    walls: tuple[float, float, float]


def hollow(folder: Path) -> str:
    """Measure, and return the section of the page. folder: the folder of the meshes."""
    lines = [
        "## Hollow parts\n",
        f"Meshes repaired, scaled to {_SIZE:g} mm of height, hollowed by {_WALL:g} mm, with walls "
        f"of a gyroid of cell {_CELL:g} mm inside and two vents, meshed with the tolerance "
        f"{_TOLERANCE:g} of their size, and written to STL. Closed: watertight and wound "
        "consistently by trimesh, a solid by manifold3d, and without triangles that pass through "
        f"others, decided exactly. Walls: from {_SAMPLES:,} points of the mesh that was given to "
        "the nearest other face of the part, away from the vents, exact on the triangles, by a "
        "program of its own: the thinnest, the median, and what 99.9 % are thinner than, in "
        "millimeters; where walls of the gyroid are, and in what is thinner than two walls, they "
        "are thicker. Seconds are of CPU time, import, repair and export included.\n",
        "| mesh | seconds | attempts | triangles | closed | thinnest | median | 99.9 % |",
        "|---|---:|---:|---:|---|---:|---:|---:|",
    ]
    paths = [path for name in _NAMES if (path := folder / f"{name}.obj").exists()]
    with get_context("spawn").Pool(_AT_ONCE, maxtasksperchild=1) as pool:
        for path, row in zip(paths, pool.imap(_measured, paths), strict=True):
            if isinstance(row, str):
                lines.append(f"| {path.stem} | | | | refused: {row} | | | |")
                continue
            walls = " | ".join(f"{thickness:.2f}" for thickness in row.walls)
            closed = "yes" if row.is_closed else "no"
            lines.append(
                f"| {path.stem} | {row.seconds:.0f} | {row.attempts} | {row.triangles:,} "
                f"| {closed} | {walls} |"
            )
    return "\n".join([*lines, ""])


def _measured(path: Path) -> _Row | str:
    """The row of a file, in a new process; or the reason why the part cannot be made."""
    loaded: Any = trimesh.load(path)
    repaired = hk.repair(loaded)
    repaired.apply_scale(_SIZE / repaired.extents[1])
    outer, gyroid = hk.solid(repaired), hk.Gyroid(_CELL)
    lattice = hk.solid(gyroid, between=gyroid.levels_of_thickness(0.8))
    body = outer.shell(_WALL) | (outer & lattice)
    (x, _, z), vent = repaired.bounds.mean(axis=0), hk.Cylinder(_VENT, 12.0).rotated(90, "x")
    axes = [np.array((x + side, repaired.bounds[0, 1], z)) for side in (-15.0, 5.0)]
    for position in axes:
        body = body - vent.translated(tuple(position))
    stages: list[str] = []
    size = float(repaired.extents.max())
    with tempfile.TemporaryDirectory() as folder:
        try:
            part = hk.mesh(body, tolerance=_TOLERANCE * size, progress=stages.append)
            part.export(f"{folder}/part.stl")
        except MeshingError as error:
            return str(error)
        seconds = time.process_time()
        mesh: Any = trimesh.load(f"{folder}/part.stl")
    is_closed = bool(mesh.is_watertight and mesh.is_winding_consistent) and is_solid(mesh)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    is_closed = is_closed and not len(intersecting_faces(vertices, faces))
    walls = _walls(repaired, vertices[faces], axes)
    return _Row(seconds, stages.count(_TOGETHER), len(faces), is_closed, walls)


# Walls.


def _walls(
    mesh: trimesh.Trimesh, corner: FloatArray, axes: list[FloatArray]
) -> tuple[float, float, float]:
    """The thinnest wall, the median and the thickness that 99.9 % are below, of the triangles (m,
    3, 3) of a part whose outer side is that of a mesh."""
    outside = Triangles(np.asarray(mesh.triangles, np.float64))
    size = float(mesh.extents.max())
    # A face lies on the mesh if its corners and points of its edges do.
    middle = 0.5 * (corner + np.roll(corner, 1, axis=1))
    samples = np.concatenate([corner, middle, corner.mean(axis=1)[:, None]], axis=1)
    is_inner = np.zeros(len(corner), np.bool_)
    for k in range(samples.shape[1]):
        rows = np.flatnonzero(~is_inner)
        is_inner[rows] = outside.distance(samples[rows, k], _OUTSIDE * size) > _OUTSIDE * size
    is_inner &= ~_beside_vents(corner.mean(axis=1), axes, 0.5)
    points, _ = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=5)
    points = np.asarray(points)[~_beside_vents(points, axes, _AWAY)]
    wall = Triangles(corner[is_inner]).distance(points)
    return float(wall.min()), float(np.median(wall)), float(np.quantile(wall, 0.999))


def _beside_vents(points: FloatArray, axes: list[FloatArray], room: float) -> npt.NDArray[np.bool_]:
    """(n,) whether points are within a vent, along y, or at most `room` away from it."""
    is_beside = np.zeros(len(points), np.bool_)
    for axis in axes:
        distance = np.hypot(points[:, 0] - axis[0], points[:, 2] - axis[2])
        is_beside |= (distance < _VENT + room) & (np.abs(points[:, 1] - axis[1]) < 6.0 + room)
    return is_beside


class Triangles:
    """Triangles (m, 3, 3), for distances from them: triangles whose centers are near enough are
    compared one by one."""

    def __init__(self, corner: FloatArray) -> None:
        center = corner.mean(axis=1)
        radius = np.linalg.norm(corner - center[:, None], axis=2).max(axis=1)
        self._vertices = scipy.spatial.cKDTree(corner.reshape(-1, 3))
        # By size, so that few large ones do not make all of them candidates.
        group = np.ceil(np.log2(np.maximum(radius, 1e-9))).astype(np.int64)
        self._groups = [
            (float(radius[rows].max()), corner[rows], scipy.spatial.cKDTree(center[rows]))
            for rows in (np.flatnonzero(group == size) for size in np.unique(group))
        ]

    def distance(self, points: FloatArray, enough: float = np.inf) -> FloatArray:
        """(n,) distances of points (n, 3); exact where at most `enough`, elsewhere at least
        `enough`."""
        return np.concatenate(
            [self._of_some(points[i : i + 2000], enough) for i in range(0, len(points), 2000)]
            or [np.zeros(0)]
        )

    def _of_some(self, points: FloatArray, enough: float) -> FloatArray:
        distances = self._vertices.query(points)[0]
        for radius, corner, centers in self._groups:
            reach = np.minimum(distances, 1.01 * enough) + radius
            near = centers.query_ball_point(points, reach)
            count = np.array([len(ids) for ids in near])
            if not count.sum():
                continue
            rows = np.repeat(np.arange(len(points)), count)
            triangles = corner[np.concatenate([np.asarray(ids, np.int64) for ids in near if ids])]
            np.minimum.at(distances, rows, distance_to_triangles(points[rows], triangles))
        return distances


def distance_to_triangles(p: FloatArray, corner: FloatArray) -> FloatArray:
    """(n,) distances from each point (n, 3) to its triangle (n, 3, 3): to the plane if the
    projection is inside, else to the nearest edge."""
    best = np.full(len(p), np.inf)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    is_inside = np.ones(len(p), np.bool_)
    for k in range(3):
        start, edge = corner[:, k], corner[:, (k + 1) % 3] - corner[:, k]
        length = np.maximum((edge * edge).sum(axis=1), 1e-300)
        fraction = np.clip(((p - start) * edge).sum(axis=1) / length, 0, 1)
        best = np.minimum(best, np.linalg.norm(p - start - fraction[:, None] * edge, axis=1))
        is_inside &= (np.cross(edge, p - start) * normal).sum(axis=1) >= 0
    size = np.linalg.norm(normal, axis=1)
    height = np.abs(((p - corner[:, 0]) * normal).sum(axis=1)) / np.maximum(size, 1e-300)
    return np.where(is_inside & (size > 0), np.minimum(best, height), best)
