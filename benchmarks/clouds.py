"""Meshes of point clouds by harnack, Open3D's Poisson and Kazhdan's: time, closed, distances."""

from __future__ import annotations

import importlib.metadata
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.distance.level_triangles import LevelTriangles
from harnack.field_from_file import read_geometry
from harnack.geometry.example_meshes import bumpy_sphere, torus_mesh

FloatArray = npt.NDArray[np.float64]
Arrays = tuple[FloatArray, npt.NDArray[np.int64]]
# From points and normals, or None: vertices and faces.
Make = Callable[[FloatArray, "FloatArray | None"], tuple[Any, Any]]

_COUNTS, _NOISE = (20_000, 200_000), 0.005
# The depth of the octree of Poisson reconstruction: the default of both programs.
_DEPTH, _SAMPLES = 8, 100_000
# The largest distance is searched again _ROUNDS times, on the triangles of the _FARTHEST points.
_ROUNDS, _FARTHEST = 2, 500
_NAMES = ("spot", "stanford-bunny", "fandisk")


@dataclass(frozen=True)
class _Row:
    """The result of a program. distance, mean: Hausdorff's and mean distance, over the diagonal."""

    seconds: float
    faces: int
    is_closed: bool
    distance: float
    mean: float


def clouds(folder: Path | None) -> str:
    """Measure, and return the section of the page. folder: of the meshes; None for made ones."""
    programs: dict[str, Make] = {"harnack": _ours, **_peers()}
    names = " | ".join(programs)
    lines = [
        "## Meshes of point clouds\n",
        f"Points chosen by chance on meshes, with Gaussian noise of {_NOISE:.1%} of the diagonal "
        "along each axis, and the normals of the mesh or none (then each program estimates them). "
        'harnack is told nothing of the noise (`smoothing="auto"`, whose numbers were chosen on '
        "spot and fandisk, 20,000 and 200,000 points), and is else as it comes; Poisson "
        f"reconstruction has depth {_DEPTH}, the default of both, and is then simplified to "
        "harnack's number of triangles (by Open3D, not timed). Each entry: seconds of CPU time, "
        "Hausdorff's distance from the mesh and the mean distance, both in % of the diagonal, from "
        f"{_SAMPLES:,} points on each to the triangles of the other, the largest one with as many "
        f"points twice again on the triangles of the {_FARTHEST} farthest; 'open' where the mesh "
        "is not closed (trimesh). The bunny has holes, which all programs span: its largest "
        "distance is that of the middle of the largest hole from its rim.\n",
        f"| mesh | points | normals | triangles | {names} |",
        "|---|---:|---|---:|" + "---|" * len(programs),
    ]
    try:
        for line in _lines(programs, folder):
            print(line, flush=True)
            lines.append(line)
    except KeyboardInterrupt:
        lines.append("\nInterrupted: the other rows were not measured.")
    return "\n".join(lines) + "\n"


def _lines(programs: dict[str, Make], folder: Path | None) -> Iterator[str]:
    """The rows of the table, each as soon as it is measured."""
    for name, mesh in _meshes(folder).items():
        for count, has_normals in itertools.product(_COUNTS, (True, False)):
            points, normals = _cloud(mesh, count)
            rows: dict[str, _Row] = {}
            max_triangles = 0
            for program, make in programs.items():
                measured = _measured(make, points, normals if has_normals else None, max_triangles)
                rows[program] = _compared(*measured, mesh)
                max_triangles = max_triangles or len(measured[1][1])
            entries = " | ".join(_entry(rows.get(program)) for program in programs)
            normals_text = "given" if has_normals else "none"
            yield f"| {name} | {count:,} | {normals_text} | {max_triangles:,} | {entries} |"


def _entry(row: _Row | None) -> str:
    if row is None:
        return ""
    if not row.faces:
        return f"{row.seconds:.1f} s, failed"
    closed = "" if row.is_closed else ", open"
    return f"{row.seconds:.1f} s, {100 * row.distance:.2f}, {100 * row.mean:.3f}{closed}"


def _meshes(folder: Path | None) -> dict[str, Arrays]:
    meshes: dict[str, Arrays] = {}
    for name in _NAMES if folder else ():
        mesh: Any = read_geometry(Path(folder or "") / f"{name}.obj", "winding")
        joined = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        joined.merge_vertices(merge_tex=True, merge_norm=True)
        meshes[name] = np.array(joined.vertices), np.array(joined.faces)
    return {**meshes, "torus": torus_mesh(1.0, 0.4, 192, 96), "bumpy sphere": bumpy_sphere(5)}


def _cloud(arrays: Arrays, count: int) -> tuple[FloatArray, FloatArray]:
    """Points with noise, and normals."""
    mesh = trimesh.Trimesh(*arrays, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    noise = _NOISE * _diagonal(arrays)
    noisy = points + np.random.default_rng(0).normal(0, noise, points.shape)
    return np.asarray(noisy), np.array(mesh.face_normals[faces])


def _diagonal(arrays: Arrays) -> float:
    return float(np.linalg.norm(np.ptp(arrays[0], axis=0)))


def _ours(points: FloatArray, normals: FloatArray | None) -> tuple[Any, Any]:
    directions = "estimate" if normals is None else normals
    surface = hk.mesh(hk.DipolePotential(points, directions, smoothing="auto"))
    return surface.vertices, surface.faces


def _peers() -> dict[str, Make]:
    """Other programs that are installed."""
    programs: dict[str, Make] = {}
    try:
        import open3d
    except ImportError:
        return programs

    def poisson(points: FloatArray, normals: FloatArray | None) -> tuple[Any, Any]:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        if normals is None:
            cloud.estimate_normals()
            cloud.orient_normals_consistent_tangent_plane(16)
        else:
            cloud.normals = open3d.utility.Vector3dVector(normals)
        make = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
        mesh, _ = make(cloud, depth=_DEPTH, n_threads=1)
        return np.asarray(mesh.vertices), np.asarray(mesh.triangles)

    programs[f"Open3D {open3d.__version__}"] = poisson
    try:
        import pymeshlab
    except ImportError:
        return programs

    def recon(points: FloatArray, normals: FloatArray | None) -> tuple[Any, Any]:
        meshes = pymeshlab.MeshSet()
        if normals is None:
            meshes.add_mesh(pymeshlab.Mesh(points))
            meshes.apply_filter("compute_normal_for_point_clouds", k=16)
        else:
            meshes.add_mesh(pymeshlab.Mesh(points, v_normals_matrix=normals))
        name = "generate_surface_reconstruction_screened_poisson"
        meshes.apply_filter(name, depth=_DEPTH, threads=1)
        mesh = meshes.current_mesh()
        return mesh.vertex_matrix(), mesh.face_matrix()

    version = importlib.metadata.version("pymeshlab")
    programs[f"PoissonRecon (pymeshlab {version})"] = recon
    return programs


def _measured(
    make: Make, points: FloatArray, normals: FloatArray | None, max_triangles: int
) -> tuple[float, Arrays]:
    """Seconds, and a mesh of at most `max_triangles` triangles; 0 for no limit."""
    start = time.process_time()
    try:
        vertices, faces = make(points, normals)
    except Exception as error:
        print(f"{type(error).__name__}: {error}", flush=True)
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    seconds = time.process_time() - start
    if max_triangles and len(faces) > max_triangles:
        import open3d

        mesh = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces)
        ).simplify_quadric_decimation(max_triangles)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    return seconds, (np.array(vertices, np.float64), np.array(faces, np.int64))


def _compared(seconds: float, result: Arrays, reference: Arrays) -> _Row:
    if not len(result[1]):
        return _Row(seconds, 0, False, math.nan, math.nan)
    mesh = trimesh.Trimesh(*result, process=False)
    distances = [_away(result, reference, 1), _away(reference, result, 2)]
    size, mean = _diagonal(reference), float(np.mean([sampled.distance for sampled in distances]))
    farthest = max(sampled.farthest for sampled in distances)
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent)
    return _Row(seconds, len(result[1]), closed, farthest / size, mean / size)


@dataclass(frozen=True)
class _Away:
    """Distances (n,) of random points of a mesh from another mesh, and about the largest
    distance."""

    distance: FloatArray
    farthest: float


def _away(arrays: Arrays, other: Arrays, seed: int) -> _Away:
    """Distances of points of a mesh from the triangles of another."""
    vertices, faces = arrays
    distance, face_ids = _sampled((vertices, faces), other, seed)
    farthest = float(distance.max())
    for k in range(_ROUNDS):
        faces = faces[face_ids]
        distances, face_ids = _sampled((vertices, faces), other, seed + 2 * k + 2)
        farthest = max(farthest, float(distances.max()))
    return _Away(distance, farthest)


def _sampled(arrays: Arrays, other: Arrays, seed: int) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Distances of random points of a mesh from the triangles of another, and the indices of the
    faces of the farthest points."""
    mesh = trimesh.Trimesh(*arrays, process=False)
    points, face_ids = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=seed)
    vertices, faces = other
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    center, size = 0.5 * (lower + upper), float((upper - lower).max())
    backend = choose_backend("double")
    surface = LevelTriangles((vertices[faces] - center) / size, center, size, True)
    offsets = surface.upload(backend)(to_vector3(backend, np.asarray(points)))
    distance = np.linalg.norm(to_numpy(offsets), axis=1)
    return distance, np.unique(face_ids[np.argsort(distance)[-_FARTHEST:]])
