"""Damaged meshes closed by harnack and by other programs: time, crossings, and distances."""

from __future__ import annotations

import importlib.metadata
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import cKDTree

import harnack as hk
from harnack.field_from_file import read_surface
from harnack.geometry.mesh_shapes import torus_mesh
from harnack.meshing.checks import intersecting_faces

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Arrays = tuple[FloatArray, IntArray]

_SHARES = (0.02, 0.05, 0.10)
_SAMPLES = 100_000
# What takes long is asked for these only.
_SLOW = ("alpha wrap", "Poisson")
_OF_SLOW = (("patches", 0.05), ("cracks", 0.05))
# Larger meshes are not asked of others: the time of all together counts.
_MOST_FACES = 30_000


@dataclass(frozen=True)
class _Row:
    """What a program made. distance: Hausdorff's, as a part of the diagonal, sampled."""

    seconds: float
    faces: int
    is_closed: bool
    crossings: int
    distance: float
    note: str


def repair(folder: Path | None) -> str:
    """Measure, and return the section of the page. folder: of more meshes; None for made ones."""
    peers = _peers()
    lines = [
        "## Repair\n",
        "Meshes with damage of 2, 5 and 10 % of their faces: six *patches* lost, single *faces* "
        "lost, faces *flipped*, faces *doubled*, patches lost and *noise* of 0.2 % of the diagonal "
        "on vertices, patches lost and all faces loose (*cracks* of 0.05 %). Closed means "
        "watertight and wound consistently by trimesh, and that manifold3d takes it as a solid; "
        "crossing are triangles that pass through others, decided exactly. The distance is "
        f"Hausdorff's from the undamaged mesh by {_SAMPLES:,} points on each, in % of the "
        "diagonal: where patches are lost it is how deep a dent the flattest surface leaves. Time "
        f"is CPU time. Beside harnack: {', '.join(peers) or 'nothing else was installed'}.\n",
        "| mesh | faces | damage | program | seconds | triangles | closed | crossing | distance "
        "| kept |",
        "|---|---:|---|---|---:|---:|---|---:|---:|---|",
    ]
    for name, whole in _meshes(folder).items():
        for kind in _KINDS:
            for share in _SHARES if kind == "patches" else _SHARES[1:2]:
                given = damaged(*whole, kind, share, seed=11)
                for program, close in {"harnack": _ours, **peers}.items():
                    if program.startswith(_SLOW) and (kind, share) not in _OF_SLOW:
                        continue
                    row = _measured(close, given, whole)
                    lines.append(
                        f"| {name} | {len(given[1]):,} | {kind} {share:.0%} | {program} "
                        f"| {row.seconds:.1f} | {row.faces:,} | {'yes' if row.is_closed else 'no'} "
                        f"| {row.crossings:,} | {100 * row.distance:.2f} | {row.note} |"
                    )
                    print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def _meshes(folder: Path | None) -> dict[str, Arrays]:
    found: dict[str, Arrays] = {"torus": torus_mesh(1.0, 0.4, 96, 48)}
    for path in sorted(folder.glob("*.obj")) if folder else []:
        mesh: Any = read_surface(path, "winding")
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        joined = trimesh.Trimesh(vertices, faces, process=False)
        joined.merge_vertices(merge_tex=True, merge_norm=True)
        if joined.is_watertight and len(faces) <= _MOST_FACES:
            found[path.stem] = np.array(joined.vertices), np.array(joined.faces)
    return found


_KINDS = ("patches", "faces", "flips", "doubles", "noise", "cracks")


def damaged(vertices: FloatArray, faces: IntArray, kind: str, share: float, seed: int) -> Arrays:
    """A mesh with damage of a kind to a share of its faces."""
    rng = np.random.default_rng(seed)
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    center = vertices[faces].mean(axis=1)
    lost = np.zeros(len(faces), np.bool_)
    for place in rng.choice(len(faces), 6, replace=False):
        near = np.argsort(np.linalg.norm(center - center[place], axis=1))
        lost[near[: max(1, int(share * len(faces) / 6))]] = True
    rest = faces[~lost]
    some = rng.choice(len(rest), max(1, int(share * len(rest))), replace=False)
    if kind == "faces":
        return vertices, faces[rng.random(len(faces)) > share]
    if kind == "flips":
        rest = rest.copy()
        rest[some] = rest[some, ::-1]
    if kind == "doubles":
        rest = np.concatenate([rest, rest[some]])
    if kind == "noise":
        return vertices + rng.normal(0, 2e-3 * diagonal, vertices.shape), rest
    if kind == "cracks":
        loose = vertices[rest] + rng.normal(0, 5e-4 * diagonal, (len(rest), 1, 3))
        return loose.reshape(-1, 3), np.arange(3 * len(rest)).reshape(-1, 3)
    return vertices, rest


Close = Callable[[FloatArray, IntArray], tuple[Any, Any, str]]


def _ours(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
    made = hk.repair(trimesh.Trimesh(vertices, faces, process=False))
    return made.vertices, made.faces, "all" if made.metadata["harnack"]["kept"] else "none"


def _peers() -> dict[str, Close]:
    """Other programs that are installed."""
    found: dict[str, Close] = {}
    try:
        import pymeshfix
    except ImportError:
        pass
    else:

        def fixed(vertices: FloatArray, faces: IntArray) -> tuple[Any, Any, str]:
            return (*pymeshfix.clean_from_arrays(vertices, faces), "most")

        found[f"pymeshfix {importlib.metadata.version('pymeshfix')}"] = fixed
    try:
        import pymeshlab
    except ImportError:
        return found
    version = importlib.metadata.version("pymeshlab")
    for label, name in (
        ("alpha wrap", "generate_alpha_wrap"),
        ("Poisson", "generate_surface_reconstruction_screened_poisson"),
    ):

        def filtered(
            vertices: FloatArray, faces: IntArray, name: str = name
        ) -> tuple[Any, Any, str]:
            meshes = pymeshlab.MeshSet()
            meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
            meshes.apply_filter("compute_normal_per_vertex")
            meshes.apply_filter(name)
            mesh = meshes.current_mesh()
            return mesh.vertex_matrix(), mesh.face_matrix(), "none"

        found[f"{label} (pymeshlab {version})"] = filtered
    return found


def _measured(close: Close, given: Arrays, whole: Arrays) -> _Row:
    start = time.process_time()
    try:
        vertices, faces, note = close(*given)
    except Exception as error:
        return _Row(time.process_time() - start, 0, False, 0, math.nan, type(error).__name__)
    seconds = time.process_time() - start
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(faces):
        return _Row(seconds, 0, False, 0, math.nan, "empty")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    is_closed = bool(mesh.is_watertight and mesh.is_winding_consistent) and _is_solid(mesh)
    distance = _hausdorff(mesh, trimesh.Trimesh(*whole, process=False))
    crossings = len(intersecting_faces(vertices, faces))
    return _Row(seconds, len(faces), is_closed, crossings, distance, note)


def _is_solid(mesh: trimesh.Trimesh) -> bool:
    from manifold3d import Error, Manifold, Mesh64

    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces).astype(np.uint64)
    return Manifold(Mesh64(vertices, faces)).status() == Error.NoError


def _hausdorff(one: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    a, b = (
        np.asarray(trimesh.sample.sample_surface(mesh, _SAMPLES, seed=k)[0])
        for k, mesh in enumerate((one, other))
    )
    far = max(float(cKDTree(x).query(y)[0].max()) for x, y in ((a, b), (b, a)))
    return far / float(np.linalg.norm(np.ptp(np.asarray(other.vertices), axis=0)))
