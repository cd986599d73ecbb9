"""Open meshes that are their own spanning surface, such as a file of a solid angle's mesh."""

from __future__ import annotations

import functools
import io
import math
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk

SADDLE = np.array([[1.0, 0, 0.4], [0, 1, -0.4], [-1, 0, 0.4], [0, -1, -0.4]])


def share(points: np.ndarray) -> np.ndarray:
    """The solid angle of the bent square at points (n, 3), over 4 pi, in (0, 1), by two triangles
    and one that joins them."""
    a = SADDLE - points[:, None]
    length = np.linalg.norm(a, axis=2)
    total = np.zeros(len(points))
    for i, j, k in ((0, 1, 2), (0, 2, 3)):
        x, y, z = length[:, i], length[:, j], length[:, k]
        dots = [(a[:, m] * a[:, n]).sum(axis=1) for m, n in ((i, j), (j, k), (k, i))]
        below = x * y * z + dots[0] * z + dots[1] * x + dots[2] * y
        total += np.arctan2((a[:, i] * np.cross(a[:, j], a[:, k])).sum(axis=1), below)
    return np.mod(total / (2 * math.pi), 1)


@functools.cache
def sheet() -> trimesh.Trimesh:
    """The surface that spans a bent square, above a grid, as a file of single precision has it."""
    n = 8
    u, v = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, n + 1)] * 2))
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=1)
    points = weights @ SADDLE
    inner = (np.abs(u - 0.5) < 0.499) & (np.abs(v - 0.5) < 0.499)
    low, high = (points[inner] + np.array([0, 0, z]) for z in (-0.3, 0.3))
    is_less = share(low) < 0.5
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = (share(middle) < 0.5) == is_less
        low, high = np.where(below[:, None], middle, low), np.where(below[:, None], high, middle)
    points[inner] = low
    return trimesh.Trimesh(points.astype(np.float32), grid_faces(n), process=False)


def grid_faces(n: int) -> np.ndarray:
    """Triangles of a square of n by n cells."""
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    b = a + n + 1
    return np.concatenate([np.stack([a, a + 1, b + 1], axis=1), np.stack([a, b + 1, b], axis=1)])


def field(part: trimesh.Trimesh) -> hk.WindingNumber:
    return hk.WindingNumber(part.vertices, part.faces)


def box_without_bottom(height: float) -> trimesh.Trimesh:
    box = trimesh.creation.box((3, 2, height))
    return trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] > -0.5], process=False)


def grid(height: Any) -> trimesh.Trimesh:
    """A square of 8 by 8 cells at heights that are a function of x and y."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, 9)] * 2))
    return trimesh.Trimesh(np.column_stack([x, y, height(x, y)]), grid_faces(8), process=False)


def test_which_meshes_are_sheets() -> None:
    def is_sheet(part: trimesh.Trimesh, level: float = 0.5) -> bool:
        return field(part).is_whole_surface((level,))

    flat = grid(lambda x, y: 0 * x)
    assert is_sheet(sheet())
    assert is_sheet(flat)
    assert is_sheet(trimesh.Trimesh(np.eye(3), [[0, 1, 2]]))
    assert not is_sheet(sheet(), 0.25)
    assert not is_sheet(grid(lambda x, y: 0.002 * np.sin(6 * x) * np.cos(5 * y)))
    assert not is_sheet(grid(lambda x, y: 0.5 * x * y))
    assert not is_sheet(trimesh.creation.icosphere(1))
    for height in (0.001, 0.01, 1.0):
        assert not is_sheet(box_without_bottom(height))
    # w jumps by three there, and another surface has the level.
    assert not is_sheet(trimesh.Trimesh(flat.vertices, np.tile(flat.faces, (3, 1)), process=False))
    layers = [flat.vertices + np.array([0, 0, 1e-6 * k]) for k in range(3)]
    faces = [flat.faces + 81 * k for k in range(3)]
    assert not is_sheet(
        trimesh.Trimesh(np.concatenate(layers), np.concatenate(faces), process=False)
    )


def test_a_sheet_is_kept() -> None:
    original = sheet()
    result = hk.mesh(field(original))
    assert result.area == pytest.approx(original.area, rel=1e-12)
    assert len(result.faces) == len(original.faces)
    assert result.metadata["harnack"]["made_by"] == "faces"
    half = hk.mesh(field(original), clip=hk.HalfSpace((1, 0, 0), 0.0))
    assert half.area == pytest.approx(original.area / 2, rel=0.03)
    with pytest.raises(hk.MeshingError, match="choose a larger `max_triangles`"):
        hk.mesh(field(original), max_triangles=20)
    with pytest.raises(hk.MeshingError, match="nothing is inside"):
        hk.mesh(field(original), level=0.5, side="above")


def crossings(part: trimesh.Trimesh, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Where each ray crosses triangles (n, k), sorted, and inf where it does not."""
    a, b, c = np.moveaxis(np.asarray(part.triangles), 1, 0)
    h = np.cross(d[:, None], c - a)
    det, s = ((b - a) * h).sum(axis=2), o[:, None] - a
    u, q = (s * h).sum(axis=2) / det, np.cross(s, b - a)
    v, t = (q * d[:, None]).sum(axis=2) / det, (q * (c - a)).sum(axis=2) / det
    is_met = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.sort(np.where(is_met, t, np.inf), axis=1)


def test_rays_hit_every_triangle_and_nothing_else() -> None:
    original, rng = sheet(), np.random.default_rng(2)
    o = rng.normal(size=(400, 3))
    o *= 4 / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-0.7, 0.7, (400, 3)) * [1, 1, 0.4] - o
    d /= np.linalg.norm(d, axis=1)[:, None]
    right = crossings(original, o, d)
    w = field(original)
    first = hk.trace(w, o, d, precision="double")
    assert ((first.primitive_index >= 0) == np.isfinite(right[:, 0])).all()
    assert np.isfinite(right[:, 0]).sum() > 200
    hit = np.asarray(first.is_hit)
    assert np.abs(first.t[hit] - right[hit, 0]).max() < 1e-12
    every = hk.crossings(w, o, d, precision="double", max_crossings=4)
    assert (every.count == np.isfinite(right).sum(axis=1)).all()
    assert np.abs(every.t[hit, 0] - right[hit, 0]).max() < 1e-12


def test_distances_are_those_from_the_triangles() -> None:
    original = sheet()
    corners = np.asarray(original.triangles)[::7]
    shares = np.random.default_rng(3).dirichlet(np.ones(3), len(corners))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    points = np.einsum("nk,nkj->nj", shares, corners) + 1e-4 * normal
    distances = np.abs(hk.signed_distance(field(original), points))
    assert np.quantile(distances, 0.9) == pytest.approx(1e-4, rel=1e-6)
    assert (distances < 1.000001e-4).all()


@pytest.mark.slow
@pytest.mark.parametrize("level", [2 * math.pi, math.pi])
def test_what_was_written_is_read_back(level: float) -> None:
    result = hk.mesh(hk.SolidAngle(SADDLE), level=level, tolerance=1e-2, cell_size=0.25)
    written: Any = result.export(file_type="stl")
    w = field(trimesh.load(io.BytesIO(written), file_type="stl"))  # pyright: ignore
    levels = (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)
    of = [one_level for one_level in levels if w.is_whole_surface((one_level,))]
    assert of in ([[-0.5, 0.5]] if level > 6 else [[-0.75, 0.25], [-0.25, 0.75]])
    for one_level in of:
        assert hk.mesh(w, level=one_level).area == pytest.approx(result.area, rel=1e-6)
