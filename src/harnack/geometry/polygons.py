"""Cutting polygons into triangles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from harnack.geometry.convex_volume import BoolArray, FloatArray
from harnack.geometry.meshes import IntArray, MeshError

__all__ = ["triangulate"]

# Corners cubed, summed over polygons with dents: some ten seconds of work.
_MOST_WORK = 2_000_000_000
# Twice the area of a triangle, in a polygon of size about 1, up to which it is no ear.
_FLAT = 1e-12
_CHUNK = 2_000_000


def triangulate(vertices: FloatArray, polygons: IntArray) -> IntArray:
    """Triangles (m (k - 2), 3) of polygons (m, k), k >= 3, polygon by polygon.

    vertices: (n, 3). A polygon that need not be quite flat is judged by its shadow along its mean
    normal. Where the fan around its first corner is not a proper triangulation, because the polygon
    has dents, ears are cut off one by one (Meisters 1975). Polygons that cross themselves get
    triangles that overlap; in a winding number these still add up to the polygon.

    Raises:
        MeshError: so many polygons with dents and so many corners that it would take long.
    """
    m, k = len(polygons), int(polygons.shape[1])
    steps = np.arange(1, k - 1, dtype=np.int64)
    fans = np.stack([np.zeros_like(steps), steps, steps + 1], axis=1)
    pattern = np.broadcast_to(fans, (m, k - 2, 3))
    if k > 3 and m:
        bent = np.concatenate(
            [_has_dents(vertices, part) for part in _parts(polygons, max(1, _CHUNK // k))]
        )
        if bent.any():
            pattern = pattern.copy()
            pattern[bent] = _cut_ears(vertices, polygons[bent])
    rows = np.arange(m, dtype=np.int64)[:, None, None]
    return polygons[rows, pattern].reshape(-1, 3)


def _parts(polygons: IntArray, size: int) -> list[IntArray]:
    return [polygons[k : k + size] for k in range(0, len(polygons), size)]


def _has_dents(vertices: FloatArray, polygons: IntArray) -> BoolArray:
    """Whether some triangle of the fan around the first corner is turned over or flat: (m,)."""
    p = vertices[polygons]
    spokes = p[:, 1:] - p[:, :1]
    areas = np.cross(spokes[:, :-1], spokes[:, 1:])
    normal = areas.sum(axis=1)
    least = _FLAT * np.einsum("mj,mj->m", normal, normal)
    return (np.einsum("mkj,mj->mk", areas, normal) <= least[:, None]).any(axis=1)


def _shadows(vertices: FloatArray, polygons: IntArray) -> FloatArray:
    """Plane coordinates (m, k, 2) of polygons, counter-clockwise, along their mean normals."""
    p = vertices[polygons]
    p = p - p[:, :1]
    normal = np.cross(p[:, :-1], p[:, 1:]).sum(axis=1)
    # The axis most across the normal gives a first tangent, the cross product the second.
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    second = np.cross(normal, first)
    size = np.abs(p).max(axis=(1, 2), keepdims=True)[..., 0]
    axes = [axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True) * size, 1e-300)
            for axis in (first, second)]  # fmt: skip
    return np.stack([np.einsum("mkj,mj->mk", p, axis) for axis in axes], axis=2)


def _cut_ears(vertices: FloatArray, polygons: IntArray) -> IntArray:
    """Corner numbers (m, k - 2, 3) of the triangles of polygons (m, k) with dents."""
    m, k = polygons.shape
    if m * k**3 > _MOST_WORK:
        raise MeshError(
            f"{m:,} polygons with dents and {k:,} corners each take too long to triangulate: "
            "let the program that made the file triangulate them"
        )
    parts = _parts(polygons, max(1, _CHUNK // (k * k)))
    return np.concatenate([_cut_ears_of_part(_shadows(vertices, part)) for part in parts])


def _cut_ears_of_part(shadows: FloatArray) -> IntArray:
    m, k = len(shadows), int(shadows.shape[1])
    left = np.tile(np.arange(k, dtype=np.int64), (m, 1))
    row = np.arange(m, dtype=np.int64)
    triangles = np.empty((m, k - 2, 3), dtype=np.int64)
    for cut in range(k - 3):
        ear = _first_ears(np.take_along_axis(shadows, left[:, :, None], axis=1))
        count = k - cut
        around = np.stack([(ear - 1) % count, ear, (ear + 1) % count], axis=1)
        triangles[:, cut] = left[row[:, None], around]
        keep = np.arange(count, dtype=np.int64) != ear[:, None]
        left = left[keep].reshape(m, count - 1)
    triangles[:, -1] = left
    return triangles


def _first_ears(p: FloatArray) -> npt.NDArray[np.intp]:
    """Number of the first corner (m,) of each polygon (m, k, 2) that can be cut off.

    Its triangle turns left and holds no other vertex. Where there is none, the polygon crosses
    itself, and the corner that turns left most is taken.
    """
    before, after = np.roll(p, 1, axis=1), np.roll(p, -1, axis=1)
    turn = _cross(p - before, after - p)
    inside = np.ones((*p.shape[:2], p.shape[1]), dtype=bool)
    for a, b in ((before, p), (p, after), (after, before)):
        inside &= _cross((b - a)[:, :, None], p[:, None] - a[:, :, None]) >= 0.0
        inside &= (p[:, None] != a[:, :, None]).any(axis=3)  # not a corner of the triangle itself
    is_ear = (turn > _FLAT) & ~inside.any(axis=2)
    return np.argmax(np.where(is_ear, np.inf, turn), axis=1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
