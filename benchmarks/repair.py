"""Damaged meshes closed by harnack and by other programs: how many, how near, and in what time."""

from __future__ import annotations

import importlib.metadata
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh

import harnack as hk
from harnack.field_from_file import read_geometry
from harnack.geometry.example_meshes import torus_mesh
from harnack.meshing.self_intersection import intersecting_faces

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Arrays = tuple[FloatArray, IntArray]
Damage = tuple[str, float]
Close = Callable[[FloatArray, IntArray], tuple[Any, Any, str]]

_SHARES = (0.02, 0.05, 0.10)
# Damage other than patches is measured for this share only.
_USUAL_SHARE = 0.05
_SAMPLES = 100_000
# Number of meshes that are processed at once.
_AT_ONCE = 3
# Slow programs are run for this damage only.
_SLOW, _OF_SLOW = ("alpha wrap", "screened Poisson"), ("patches", 0.05)
# Larger meshes are left out: the total time counts.
_MOST_FACES = 30_000
# A distance counts as among the best within this factor of the best, and also below the smallest
# distance that sampling resolves, relative to the diagonal.
_NEARLY, _FLOOR = 1.10, 1e-3


@dataclass(frozen=True)
class _Row:
    """The result of a program. distance: Hausdorff's, relative to the diagonal, sampled; infinite
    if there is no mesh."""

    seconds: float
    is_closed: bool
    distance: float
    stage: str


def repair(folder: Path | None) -> str:
    """Measure, and return the section of the page. folder: of further meshes; None for generated
    meshes."""
    meshes = _meshes(folder)
    rows: dict[Damage, list[dict[str, _Row]]] = defaultdict(list)
    largest_first = sorted(meshes.items(), key=lambda entry: -len(entry[1][1]))
    with ProcessPoolExecutor(_AT_ONCE, mp_context=get_context("spawn")) as pool:
        for results in pool.map(_of_mesh, largest_first):
            for damage, row in results.items():
                rows[damage].append(row)
    return "\n".join(_page(meshes, rows, list(_programs())))


def _programs() -> dict[str, Close]:
    return {"harnack": _ours, **_peers()}


def _of_mesh(entry: tuple[str, Arrays]) -> dict[Damage, dict[str, _Row]]:
    """The results of each program for one mesh, by kind and share of damage."""
    name, whole = entry
    rows: dict[Damage, dict[str, _Row]] = {}
    for kind, fraction in itertools.product(_KINDS, _SHARES):
        if kind != "patches" and fraction != _USUAL_SHARE:
            continue
        mesh = damaged(*whole, kind, fraction, seed=11)
        is_few = (kind, fraction) == _OF_SLOW
        results = {
            label: _measured(close, mesh, whole)
            for label, close in _programs().items()
            if is_few or not label.startswith(_SLOW)
        }
        rows[kind, fraction] = results
        summary = "; ".join(
            f"{label} {row.stage} {'closed' if row.is_closed else 'open'} "
            f"{100 * row.distance:.2f} {row.seconds:.1f} s"
            for label, row in results.items()
        )
        print(f"{name} {kind} {fraction:.0%}: {summary}", flush=True)
    return rows


def _page(
    meshes: dict[str, Arrays],
    rows: dict[Damage, list[dict[str, _Row]]],
    programs: list[str],
) -> list[str]:
    """The lines of the section."""
    every = [results for group in rows.values() for results in group]
    sizes = sorted(len(faces) for _, faces in meshes.values())
    lines = [
        "## Repair\n",
        f"{len(meshes)} meshes of {sizes[0]:,} to {sizes[-1]:,} triangles ({', '.join(meshes)}) "
        "with damage of 5 % of their faces, and of 2 and 10 % as well if it is patches alone: six "
        "*patches* lost; single *faces* lost; "
        "patches lost and faces *flipped*, or *doubled*, or *noise* of 0.2 % of the diagonal on "
        "all vertices; patches lost and all faces loose, moved by 0.05 % (*cracks*), or each "
        "corner moved so (*soups*). Closed: watertight and wound consistently by "
        "trimesh, a solid by manifold3d, and without triangles that pass through others, decided "
        f"exactly. Distance: Hausdorff's from the undamaged mesh, from {_SAMPLES:,} points and all "
        "vertices of each to the triangles of the other, in % of the diagonal, the median over "
        "meshes; a program is *among the best* if it is closed and within 10 % of the nearest "
        "closed result, or within 0.1 %. Seconds are of CPU time, median and largest; alpha wrap "
        "and Poisson were asked for patches of 5 % only. By harnack's "
        f"stages {_counts(results['harnack'].stage for results in every)}.\n",
        "| damage | program | closed | distance | among the best | seconds |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for (kind, share), group in rows.items():
        lines += [
            f"| {kind} {share:.0%} | {label} | {_summary(group, label)} |" for label in group[0]
        ]
    lines += [
        f"| all | {label} | {_summary([result for result in every if label in result], label)} |"
        for label in programs
    ]
    return [*lines, ""]


def _summary(rows: list[dict[str, _Row]], label: str) -> str:
    """The cells of a line of the table."""
    series = [results[label] for results in rows]
    best = [
        min(row.distance if row.is_closed else math.inf for row in results.values())
        for results in rows
    ]
    among = [
        row.is_closed and row.distance <= max(_NEARLY * least, _FLOOR)
        for row, least in zip(series, best, strict=True)
    ]
    seconds = sorted(row.seconds for row in series)
    distance = float(np.median([row.distance for row in series]))
    near = "none" if math.isinf(distance) else f"{100 * distance:.2f}"
    return (
        f"{sum(row.is_closed for row in series)} of {len(series)} | {near} | {np.mean(among):.0%} "
        f"| {float(np.median(seconds)):.1f}, {seconds[-1]:.1f}"
    )


def _counts(names: Iterable[str]) -> str:
    counts: dict[str, int] = defaultdict(int)
    for name in names:
        counts[name] += 1
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))


# Meshes, and their damage.


def _meshes(folder: Path | None) -> dict[str, Arrays]:
    """Closed meshes of files, and generated meshes."""
    meshes: dict[str, Arrays] = {
        "torus": torus_mesh(1.0, 0.4, 96, 48),
        "sphere": _arrays(trimesh.creation.icosphere(4)),
        "box": _arrays(trimesh.creation.box((1.0, 0.7, 0.4)).subdivide_to_size(0.04)),
        "knot": _knot(),
        "rings": _rings(),
        "gear": _arrays(hk.mesh(hk.Extrusion([_gear()], 0.4)).subdivide_to_size(0.06)),
        "gyroid": _arrays(
            hk.mesh(
                hk.solid(hk.Gyroid(1.0), between=(-0.4, 0.4)) & hk.Sphere(0.6),
                tolerance=6e-3,
                simplify=True,
            )
        ),
        "capsules": _arrays(
            hk.mesh(
                hk.Capsule((-1, 0, 0), (1, 0, 0), 0.3).blended(
                    hk.Capsule((0.3, -1, 0), (0.3, 1, 0.4), 0.2), 0.15
                ),
                tolerance=5.2e-3,
            )
        ),
    }
    for path in sorted(folder.glob("*.obj")) if folder else []:
        mesh: Any = read_geometry(path, "winding")
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        joined = trimesh.Trimesh(vertices, faces, process=False)
        joined.merge_vertices(merge_tex=True, merge_norm=True)
        if joined.is_watertight and len(faces) <= _MOST_FACES:
            meshes[path.stem] = np.array(joined.vertices), np.array(joined.faces)
    return meshes


def _arrays(mesh: trimesh.Trimesh) -> Arrays:
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def _knot() -> Arrays:
    """A tube around a trefoil, of rings that are turned as little as possible."""
    count, sides, radius = 160, 16, 0.35
    t = np.linspace(0, 2 * np.pi, count, endpoint=False)
    line = np.column_stack(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)]
    )
    along = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    u = np.cross(along, line - [0, 0, 3.0])  # nowhere along the curve
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(along, u)
    angle = np.arange(sides)[:, None] * (2 * np.pi / sides)
    rings = line[:, None] + radius * (np.cos(angle) * u[:, None] + np.sin(angle) * v[:, None])
    i, j = (k.ravel() for k in np.mgrid[:count, :sides])
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (a + sides) % (count * sides), (b + sides) % (count * sides)
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    return rings.reshape(-1, 3), faces[:, ::-1] if _volume(rings, faces) < 0 else faces


def _rings() -> Arrays:
    """Two linked tori."""
    vertices, faces = torus_mesh(1.0, 0.3, 64, 24)
    other = vertices[:, [2, 0, 1]] + [0.0, 1.0, 0.0]
    return np.concatenate([vertices, other]), np.concatenate([faces, faces + len(vertices)])


def _volume(vertices: FloatArray, faces: IntArray) -> float:
    return float(trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False).volume)


def _gear() -> FloatArray:
    """The outline of twelve teeth."""
    angle = np.arange(48) * (2 * np.pi / 48)
    radius = np.where(np.arange(48) % 4 < 2, 1.0, 0.8)
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


_KINDS = ("patches", "faces", "flips", "doubles", "noise", "cracks", "soups")


def damaged(vertices: FloatArray, faces: IntArray, kind: str, share: float, seed: int) -> Arrays:
    """A mesh with damage of a kind to a share of its faces."""
    rng = np.random.default_rng(seed)
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    center = vertices[faces].mean(axis=1)
    lost = np.zeros(len(faces), np.bool_)
    for face in rng.choice(len(faces), 6, replace=False):
        near = np.argsort(np.linalg.norm(center - center[face], axis=1))
        lost[near[: max(1, int(share * len(faces) / 6))]] = True
    rest = faces[~lost]
    subset = rng.choice(len(rest), max(1, int(share * len(rest))), replace=False)
    if kind == "faces":
        return vertices, faces[rng.random(len(faces)) > share]
    if kind == "flips":
        rest = rest.copy()
        rest[subset] = rest[subset, ::-1]
    if kind == "doubles":
        rest = np.concatenate([rest, rest[subset]])
    if kind == "noise":
        return vertices + rng.normal(0, 2e-3 * diagonal, vertices.shape), rest
    if kind == "cracks":
        loose = vertices[rest] + rng.normal(0, 5e-4 * diagonal, (len(rest), 1, 3))
        return loose.reshape(-1, 3), np.arange(3 * len(rest)).reshape(-1, 3)
    if kind == "soups":
        loose = vertices[rest] + rng.normal(0, 5e-4 * diagonal, (len(rest), 3, 3))
        return loose.reshape(-1, 3), np.arange(3 * len(rest)).reshape(-1, 3)
    return vertices, rest


# Programs.


def _ours(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
    mesh = hk.repair(trimesh.Trimesh(vertices, faces, process=False))
    return mesh.vertices, mesh.faces, mesh.metadata["harnack"]["stage"]


def _peers() -> dict[str, Close]:
    """Other programs that are installed."""
    programs: dict[str, Close] = {}
    try:
        import pymeshfix
    except ImportError:
        pass
    else:

        def fixed(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
            return (*pymeshfix.clean_from_arrays(vertices, faces), "")

        programs[f"pymeshfix {importlib.metadata.version('pymeshfix')}"] = fixed
    import pymeshlab

    lab: Any = pymeshlab

    def alpha_wrapped(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
        meshes = lab.MeshSet()
        meshes.add_mesh(lab.Mesh(vertices, faces))
        meshes.apply_filter("generate_alpha_wrap")
        mesh = meshes.current_mesh()
        return mesh.vertex_matrix(), mesh.face_matrix(), ""

    def by_poisson(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
        """The reconstruction from vertices with the normals of their faces; vertices without a face
        have no normal, so that the filter fails."""
        meshes = lab.MeshSet()
        meshes.add_mesh(lab.Mesh(vertices, faces))
        meshes.apply_filter("meshing_remove_unreferenced_vertices")
        meshes.apply_filter("compute_normal_per_vertex")
        meshes.apply_filter(
            "generate_surface_reconstruction_screened_poisson", preclean=True, threads=1
        )
        mesh = meshes.current_mesh()
        return mesh.vertex_matrix(), mesh.face_matrix(), ""

    version = importlib.metadata.version("pymeshlab")
    programs[f"alpha wrap (pymeshlab {version})"] = alpha_wrapped
    programs[f"screened Poisson (pymeshlab {version})"] = by_poisson
    return programs


def _measured(close: Close, damaged_mesh: Arrays, reference: Arrays) -> _Row:
    start = time.process_time()
    try:
        vertices, faces, stage = close(*damaged_mesh)
    except Exception as error:
        return _Row(time.process_time() - start, False, math.inf, type(error).__name__)
    seconds = time.process_time() - start
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(faces):
        return _Row(seconds, False, math.inf, "empty")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    is_closed = bool(mesh.is_watertight and mesh.is_winding_consistent) and is_solid(mesh)
    is_closed = is_closed and not len(intersecting_faces(vertices, faces))
    return _Row(seconds, is_closed, _hausdorff((vertices, faces), reference), stage)


def is_solid(mesh: trimesh.Trimesh) -> bool:
    """Whether manifold3d takes it."""
    from manifold3d import Error, Manifold, Mesh64

    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces).astype(np.uint64)
    return Manifold(Mesh64(vertices, faces)).status() == Error.NoError


def _hausdorff(first: Arrays, second: Arrays) -> float:
    """The distance between two meshes, from points of each to triangles of the other, over the
    diagonal of the second; by MeshLab."""
    import pymeshlab

    lab: Any = pymeshlab
    meshes = lab.MeshSet()
    for vertices, faces in (first, second):
        meshes.add_mesh(lab.Mesh(vertices, faces))
    far = max(
        meshes.get_hausdorff_distance(
            sampledmesh=k, targetmesh=1 - k, samplevert=True, sampleedge=True, sampleface=True,
            samplenum=_SAMPLES,
        )["max"]
        for k in (0, 1)
    )  # fmt: skip
    return float(far) / float(np.linalg.norm(np.ptp(second[0], axis=0)))
