"""Real meshes, whole and damaged: winding numbers and first hits against direct sums."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.files import read_geometry
from harnack.geometry.example_meshes import (
    MeshArrays,
    duplicate_faces,
    flip_faces,
    icosphere,
    remove_faces,
)
from tests.oracles.direct_sums import winding_sum
from tests.oracles.jump_oracle import first_side_changes, judge
from tests.oracles.mesh_rays import mesh_rays

from .plain_hits import PlainHits

FORMATS = (".obj", ".ply", ".off", ".stl", ".glb")
POINTS = 100_000
RAYS = 2_000
CHECKED = 2_000
SAMPLES = 384
DAMAGE = ("none", "holes", "flips", "duplicates", "self-intersections")
METHODS: tuple[tuple[Any, int], ...] = (("exact", 2), ("tree", 0), ("tree", 1), ("tree", 2))
# Of the size of the mesh: tolerance of the trace, and the largest distance of a hit from the
# surface.
TOLERANCE, REACH = 2e-5, 3e-4
# The largest number of damaged faces: each makes three boundary edges, which the oracle pays for.
_MOST = 300

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PointRow:
    """Winding numbers of one mesh at points by one method; errors are against the direct sum.

    outside: points with an error larger than the bound. used: the largest share of the bound.
    """

    mesh: str
    faces: int
    edges: int
    method: str
    outside: int
    median: float
    largest: float
    used: float


@dataclass(frozen=True)
class RayRow:
    """First hits on one mesh by one method.

    missed, early: hits that the oracle contradicts. explained: early hits at which w differs from
    the level by no more than its bound allows. plain: rays of a closed mesh that were compared
    with the triangles themselves, and other: how many of them differ.
    """

    mesh: str
    damage: str
    level: float
    edges: int
    method: str
    hits: int
    smooth: int
    missed: int
    early: int
    explained: int
    out_of_steps: int
    plain: int
    other: int


def read(path: Path) -> MeshArrays:
    """Vertices and faces of a surface file, moved and scaled to a largest coordinate of one."""
    surface: Any = read_geometry(path, "winding")
    vertices = np.asarray(surface.vertices, np.float64)
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - 0.5 * (lower + upper)) / (0.5 * float((upper - lower).max()))
    return _rounded(vertices), np.asarray(surface.faces, np.int64)


def damaged(mesh: MeshArrays, kind: str, seed: int) -> MeshArrays:
    """The mesh after one kind of damage."""
    vertices, faces = mesh
    fraction = min(0.05, _MOST / len(faces))
    if kind == "holes":  # four large ones and many small ones
        center = vertices[faces].mean(axis=1)
        rng = np.random.default_rng(seed)
        for point in center[rng.integers(len(faces), size=4)]:
            nearest = np.argsort(((vertices[faces].mean(axis=1) - point) ** 2).sum(axis=1))
            faces = np.delete(faces, nearest[: len(center) // 200], axis=0)
        faces = remove_faces(faces, fraction, seed)
    elif kind == "flips":
        faces = flip_faces(faces, fraction, seed)
    elif kind == "duplicates":
        faces = duplicate_faces(faces, fraction, seed)
        faces = duplicate_faces(faces, 0.5 * fraction, seed + 1, flipped=True)
    elif kind == "self-intersections":
        ball, ball_faces = icosphere(3)
        faces = np.concatenate(
            [remove_faces(faces, 0.5 * fraction, seed), ball_faces + len(vertices)]
        )
        vertices = np.concatenate([vertices, _rounded(0.35 * ball + [0.2, 0.1, 0.05])])
    elif kind != "none":
        raise ValueError(f"unknown damage {kind!r}")
    return vertices, faces


def at_points(name: str, mesh: MeshArrays) -> Iterator[PointRow]:
    """Every method at random points of the bounding cube made half as large again."""
    vertices, faces = mesh
    x = _rounded(np.random.default_rng(1).uniform(-1.5, 1.5, (POINTS, 3)))
    expected = winding_sum(vertices[faces])(x)
    for method, order in METHODS:
        field = WindingNumber(vertices, faces, method=method, order=order)
        error = np.abs(field.value(x, precision="single") - expected)
        bound = field.error_bound(x, precision="single")
        yield PointRow(
            name, len(faces), len(field.mesh.singular_edges),
            method if method == "exact" else f"{method}, order {order}",
            int((error > bound).sum()), float(np.median(error)), float(error.max()),
            float((error / bound).max()),
        )  # fmt: skip


def along_rays(
    name: str, mesh: MeshArrays, damage: str, seed: int, level: float
) -> Iterator[RayRow]:
    """First hits by both methods. Raises AssertionError if the oracle is not the direct sum."""
    vertices, faces = mesh
    lower, upper = vertices.min(axis=0) - 0.05, vertices.max(axis=0) + 0.05
    o, d = mesh_rays(vertices, faces, RAYS, seed, lower, upper)
    oracle = WindingNumber(vertices, faces, method="exact")
    edges = oracle.mesh.vertices[oracle.mesh.singular_edges]

    def exact(x: FloatArray) -> FloatArray:
        return oracle.value(x, precision="double")

    points = o + np.random.default_rng(seed).uniform(0, 3, (RAYS, 1)) * d
    assert np.abs(exact(points) - winding_sum(vertices[faces])(points)).max() < 1e-9
    t_max = 6.0
    truth = first_side_changes(exact, o, d, 0.0, t_max, level=level, samples=SAMPLES)
    plain = None if len(edges) else PlainHits.of(mesh, exact, o, d, TOLERANCE)
    for method in ("exact", "tree"):
        field: Any = WindingNumber(vertices, faces, method=method)
        hits = hk.trace(
            field, o, d, level=level, t_max=t_max, tolerance=TOLERANCE, precision="single"
        )
        t = np.where(hits.is_hit, hits.t, np.inf).astype(np.float64)
        verdict = judge(
            t, exact, o, d, 0.0, t_max,
            level=level, reach=REACH, edges=edges, truth=truth, samples=SAMPLES,
        )  # fmt: skip
        early = verdict.early
        early_points = o[early] + t[early, None] * d[early]
        yield RayRow(
            name, damage, level, len(edges), method,
            verdict.hits, int((hits.is_hit & (hits.primitive_index < 0)).sum()),
            len(verdict.missed), len(early),
            int(_explained(field, exact, level, early_points, d[early]).sum()),
            int((hits.status == hk.RayStatus.OUT_OF_STEPS).sum()),
            0 if plain is None else int(plain.clear.sum()),
            0 if plain is None else plain.others(t),
        )  # fmt: skip


def _explained(
    field: WindingNumber, exact: Callable[[FloatArray], FloatArray], level: float, x: FloatArray,
    d: FloatArray,
) -> npt.NDArray[np.bool_]:  # fmt: skip
    """Whether w just before or just behind points of rays is within its bound of the level.

    A trace accepts a point as a hit within twice the bound of the field that it traces.
    """
    traced = WindingNumber(
        field.mesh.vertices, field.mesh.triangles, method=field.method, accuracy=4.0
    )
    is_near = np.zeros(len(x), np.bool_)
    for offset in (-TOLERANCE, TOLERANCE) if len(x) else ():
        points = x + offset * d
        bound = traced.error_bound(points, precision="single")
        is_near |= np.abs(exact(points) - level) <= 2 * bound + TOLERANCE
    return is_near


def _rounded(v: FloatArray) -> FloatArray:
    """The values in single precision, so that all methods get the same mesh and points."""
    return v.astype(np.float32).astype(np.float64)


def agreement(folder: Path) -> str:
    """Compare, and return the section of the page.

    Raises FileNotFoundError if the folder holds no mesh.
    """
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in FORMATS)
    if not paths:
        raise FileNotFoundError(f"no {', '.join(FORMATS)} in {folder}")
    points: list[PointRow] = []
    hits: list[RayRow] = []
    for path in paths:
        mesh = read(path)
        for point_row in at_points(path.stem, mesh):
            points.append(point_row)
            print(point_row, flush=True)
        # For a flat mesh w stays below 1/2 and comes near it only at the mesh: a level in between.
        level = 0.25 if np.ptp(mesh[0], axis=0).min() == 0 else 0.5
        for seed, kind in enumerate(DAMAGE):
            for ray_row in along_rays(path.stem, damaged(mesh, kind, seed), kind, seed, level):
                hits.append(ray_row)
                print(ray_row, flush=True)
    return _section(points, hits)


def _section(points: list[PointRow], hits: list[RayRow]) -> str:
    broken = {(row.mesh, row.damage) for row in hits if row.edges}
    lines = [
        "## Agreement with direct sums\n",
        f"Winding numbers of meshes from public collections at {POINTS:,} random points of the "
        "bounding cube made half as large again, single precision, against a sum over all "
        "triangles in double precision. *Outside* counts errors larger than `error_bound`; *used* "
        "is the largest share of it.\n",
        "| mesh | triangles | boundary edges | method | outside | median error | largest error "
        "| used |",
        "|---|---:|---:|---|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {row.mesh} | {row.faces:,} | {row.edges:,} | {row.method} | {row.outside} "
        f"| {row.median:.1e} | {row.largest:.1e} | {row.used:.2f} |"
        for row in points
    ]
    lines += [
        "",
        f"First hits of {RAYS:,} rays each, half of them aimed at vertices and edges, on "
        f"{len(broken)} meshes with boundary edges and on closed ones; tolerance "
        f"{TOLERANCE:g} of "
        f"the size. Against the sides of the exact w at {SAMPLES + 1} points a ray: *missed* hits "
        f"are more than {REACH:g} late, *early* ones have no surface that near; of these, at the "
        "*explained* ones w is within twice its bound of the level. *Plain* rays pass every edge "
        "of a closed mesh clearly; *other* counts those not hit where they first meet a triangle "
        "across which w passes the level. A flat mesh is traced at 1/4: its w stays below 1/2.\n",
        "| mesh | damage | level | boundary edges | method | hits | off the mesh | missed | early "
        "| explained | out of steps | plain | other |",
        "|---|---|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    lines += [
        f"| {row.mesh} | {row.damage} | {row.level:g} | {row.edges:,} | {row.method} | {row.hits} "
        f"| {row.smooth} | {row.missed} | {row.early} | {row.explained} | {row.out_of_steps} "
        f"| {row.plain} | {row.other} |"
        for row in hits
    ]
    return "\n".join(lines) + "\n"
