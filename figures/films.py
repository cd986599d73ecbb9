"""Fig. 11: level sets vary continuously with their boundary, minimal surfaces jump."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

import harnack as hk
from harnack.rendering import Camera

from .figure import Report
from .panels import Panel, halved, montage
from .view import BACK, FRONT, Array, View, mesh_hits

_DISTANCES = (0.2, 0.3, 0.455, 0.5, 0.7)
_AROUND, _ALONG = 32, 16


def figure_11(width: int) -> Report:
    """Two squares that move apart."""
    side = max(24, round(0.75 * width))
    corners = np.concatenate([_square(0.7), _square(-0.7)])
    view = View.of(corners, (2 * side, 2 * side), Camera(azimuth=-65, elevation=14))
    top, below, necks, texts = [], [], [], []
    for distance in _DISTANCES:
        field = hk.SolidAngle([_square(distance), _square(-distance)[::-1]])
        hits = view.trace(field)
        assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
        top.append(Panel(halved(view.shade(hits.normal, hits.is_hit)), f"d = {distance:g}"))
        necks.append(_neck(field))
        film = _film(distance)
        met = mesh_hits(film.vertices, film.faces, view.eye, view.directions())
        below.append(Panel(halved(view.shade(met.normal, met.is_hit, BACK, FRONT)), film.name))
        texts.append(f"{film.neck:.2f}" if film.neck else "two squares")
    last = _last_film()
    caption = (
        "Two squares of circumradius 1 at heights ±d, run against each other. Top: the 2π level "
        "of their solid angle. Its waist along x, at z = 0, measured by rays from the axis: "
        + ", ".join(f"{neck:.2f}" if neck else "none" for neck in necks)
        + ". It closes without a jump at d = √((√2 - 1)/2) = 0.455, where both squares fill a "
        "quarter of the view from the middle. Bottom (unproved): a film of least area, a mesh of "
        f"{2 * _AROUND * _ALONG:,} triangles relaxed by the cotangent scheme of Pinkall and "
        f"Polthier; waists {', '.join(texts)}. The last distance, in steps of 0.01, at which such "
        f"a film was found is {last[0]:.2f}, where its waist is still {last[1]:.2f}: then it "
        "jumps to two squares."
    )
    differs = (
        "The paper's curves are not public; this pair of squares is a candidate with a "
        "closed-form change of topology. Films are meshes, found only as far as the relaxation "
        "converges."
    )
    return Report(montage(top, below), caption, differs)


def _square(height: float) -> Array:
    return np.array([[1, 0, height], [0, 1, height], [-1, 0, height], [0, -1, height]], float)


def _neck(field: hk.SolidAngle) -> float | None:
    """Distance of the level set from the axis at z = 0, along x; None if the ray hits nothing."""
    hits = hk.trace(field, [[0, 0, 0]], [[1, 0, 0]], precision="double", t_max=3.0, tolerance=1e-4)
    return float(hits.t[0]) if hits.is_hit[0] else None


@dataclass(frozen=True)
class _Film:
    """A mesh of least area; neck: its waist along x, None if it is two squares."""

    name: str
    vertices: Array
    faces: Array
    neck: float | None


def _film(distance: float, start: _Film | None = None) -> _Film:
    """The film, by relaxation of a tube, or of a film at another distance."""
    vertices, faces = _tube(distance)
    if start is not None:
        vertices = start.vertices * [1, 1, distance / start.vertices[:, 2].max()]
    rim = np.arange(len(vertices)) // _AROUND
    fixed = (rim == 0) | (rim == _ALONG)
    neck, before = _waist(vertices), math.inf
    for _ in range(500):
        if abs(neck - before) < 1e-5 * neck:
            return _Film(f"d = {distance:g}: a film", vertices, faces, neck)
        if neck < 0.2:
            break
        vertices = _relaxed(vertices, faces, fixed)
        neck, before = _waist(vertices), neck
    corners = np.concatenate([_square(distance), _square(-distance)])
    flat = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]])
    return _Film(f"d = {distance:g}: two squares", corners, flat, None)


def _waist(vertices: Array) -> float:
    ring = vertices[_ALONG // 2 * _AROUND : (_ALONG // 2 + 1) * _AROUND]
    return float(np.linalg.norm(ring[:, :2], axis=1).max())


def _last_film() -> tuple[float, float]:
    """The largest distance, in steps of 0.01, with a film, and its waist."""
    film = _film(0.5)
    last_film = (0.5, film.neck or 0.0)
    for k in range(51, 71):
        film = _film(0.01 * k, film)
        if film.neck is None:
            break
        last_film = (0.01 * k, film.neck)
    return last_film


def _tube(distance: float) -> tuple[Array, Array]:
    """Vertices and triangles of the straight tube between the squares."""
    parameter = np.arange(_AROUND) / _AROUND * 4
    k = parameter.astype(int)
    ring = _square(0.0)
    ring = (1 - (parameter - k))[:, None] * ring[k] + (parameter - k)[:, None] * ring[(k + 1) % 4]
    heights = np.linspace(distance, -distance, _ALONG + 1)
    vertices = np.concatenate([ring + np.array([0, 0, height]) for height in heights])
    i, j = np.meshgrid(np.arange(_ALONG), np.arange(_AROUND), indexing="ij")
    a, b = i * _AROUND + j, i * _AROUND + (j + 1) % _AROUND
    c, d = a + _AROUND, b + _AROUND
    faces = [np.stack(corner, axis=-1).reshape(-1, 3) for corner in ((a, c, b), (b, c, d))]
    return vertices, np.concatenate(faces)


def _relaxed(vertices: Array, faces: Array, fixed: Array) -> Array:
    """The harmonic map of the mesh to space with its rims fixed: its area is less."""
    rows, columns, weights = [], [], []
    for k in range(3):
        i, j, apex = (faces[:, (k + n) % 3] for n in range(3))
        u, v = vertices[i] - vertices[apex], vertices[j] - vertices[apex]
        area = np.linalg.norm(np.cross(u, v), axis=1)
        weight = 0.5 * (u * v).sum(axis=1) / np.maximum(area, 1e-12)
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        weights += [-weight, -weight, weight, weight]
    n = len(vertices)
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    matrix = coo_array(entries, shape=(n, n)).tocsr()
    free = np.flatnonzero(~fixed)
    held = np.flatnonzero(fixed)
    moved = vertices.copy()
    right = -(matrix[free][:, held] @ vertices[held])
    moved[free] = splu(matrix[free][:, free].tocsc()).solve(np.ascontiguousarray(right))
    return moved
