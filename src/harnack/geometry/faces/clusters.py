"""Triangle meshes cut into patches: polygons with many corners that are not flat.

They are made for pictures and tests: each triangle is a point (centroid, weight * normal) in six
dimensions, patches are the clusters of Lloyd's algorithm, so that they are compact and bend little,
and their boundaries are the polygons (Cohen-Steiner, Alliez and Desbrun 2004 do so with planes).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend.numbers import FloatArray, IntArray
from harnack.geometry.chains import boundary_edges, join

__all__ = ["polygon_patches"]

# How much normals count beside places, in units of the mesh.
_NORMAL_WEIGHT = 0.25


def polygon_patches(
    vertices: FloatArray,
    faces: IntArray,
    count: int,
    *,
    iterations: int = 12,
    smoothing: int = 0,
    seed: int = 0,
) -> tuple[FloatArray, list[list[list[int]]]]:
    """Vertices and polygon faces, a list of loops each, of about `count` patches of a mesh.

    Corners of a patch are vertices of the mesh; vertices within patches are left out. smoothing:
    how often corners of just two edges are moved to the middle between where they are and the mean
    of their neighbours, since boundaries along triangles run in zigzags.

    Raises:
        ValueError: fewer than two patches, or more than triangles.
    """
    if not 2 <= count <= len(faces):
        raise ValueError(f"a mesh of {len(faces):,} faces has 2 to as many patches, not {count}")
    patch = _clusters(vertices, faces, count, iterations, seed)
    order = np.argsort(patch, kind="stable")
    parts = np.split(faces[order], np.flatnonzero(np.diff(patch[order])) + 1)
    loops = [join(boundary_edges(part.tolist())) for part in parts]
    loops = [one for one in loops if one]
    used = np.unique([corner for one in loops for loop in one for corner in loop])
    number = np.full(len(vertices), -1)
    number[used] = np.arange(len(used))
    numbered = [[[int(number[corner]) for corner in loop] for loop in one] for one in loops]
    points = vertices[used]
    if smoothing:
        ends = np.array([(a, b) for one in numbered for loop in one for a, b in _edges(loop)])
        points = _smoothed(points, np.unique(np.sort(ends, axis=1), axis=0), smoothing)
    return points, numbered


def _edges(loop: list[int]) -> list[tuple[int, int]]:
    return list(zip(loop, [*loop[1:], loop[0]], strict=True))


def _smoothed(points: FloatArray, edges: IntArray, times: int) -> FloatArray:
    """Points, of which those that just two edges (e, 2) meet at were moved along."""
    both = np.concatenate([edges, edges[:, ::-1]])
    inner = np.bincount(both[:, 0], minlength=len(points)) == 2
    both = both[np.argsort(both[:, 0], kind="stable")]
    neighbours = both[inner[both[:, 0]], 1].reshape(-1, 2)
    for _ in range(times):
        moved = points.copy()
        moved[inner] = 0.5 * (points[inner] + points[neighbours].mean(axis=1))
        points = moved
    return points


def _clusters(
    vertices: FloatArray, faces: IntArray, count: int, iterations: int, seed: int
) -> IntArray:
    """The patch of each triangle (m,)."""
    import scipy.spatial  # here: half a second that few need

    spatial: Any = scipy.spatial
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    points = np.hstack([corners.mean(axis=1), _NORMAL_WEIGHT * normal / area[:, None]])
    chance = area / area.sum()
    rng = np.random.default_rng(seed)
    centres = points[rng.choice(len(points), count, p=chance, replace=False)]
    patch = np.zeros(len(faces), dtype=np.int64)
    for _ in range(iterations):
        patch = spatial.KDTree(centres).query(points)[1]
        weight = np.bincount(patch, area, count)
        for axis in range(points.shape[1]):
            moment = np.bincount(patch, area * points[:, axis], count)
            centres[:, axis] = np.where(weight > 0, moment / np.maximum(weight, 1e-300), np.inf)
        centres = centres[weight > 0]
        count = len(centres)
    return spatial.KDTree(centres).query(points)[1]
