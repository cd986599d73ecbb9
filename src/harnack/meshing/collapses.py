"""Slivers taken out of a mesh by merging the two ends of their shortest edge."""

from __future__ import annotations

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.flips import least_angles
from harnack.meshing.samples import LevelFunction
from harnack.meshing.tetrahedra import IntArray

__all__ = ["without_slivers"]

# Triangles with a smaller angle are slivers: 4 degrees.
_SLIVER = 0.07
# The least cosine between normals of new triangles and the slope.
_FACING = 0.3


def without_slivers(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    fixed: BoolArray,
    tolerance: float,
) -> IntArray:
    """Faces without those slivers of which an end of the shortest edge can be moved to the other.

    An edge (u, v) can be contracted to u without a change of topology if u and v have just the two
    neighbours in common that are the third corners of its faces (the link condition), and v is not
    `fixed` (n,), as vertices of the rim are. It is, if no new triangle is a sliver, all face the
    way that the surface does, and their centres are within `tolerance` of it.
    """
    slivers = np.flatnonzero(least_angles(vertices, faces) < _SLIVER)
    gone = np.zeros(len(faces), np.bool_)
    faces = faces.copy()
    for row in slivers:
        if gone[row]:
            continue
        corner = vertices[faces[row]]
        lengths = np.linalg.norm(np.roll(corner, -1, axis=0) - corner, axis=1)
        k = int(lengths.argmin())
        ends = int(faces[row, k]), int(faces[row, (k + 1) % 3])
        for kept, lost in (ends, ends[::-1]):
            if fixed[lost]:
                continue
            around = np.flatnonzero((faces == lost).any(axis=1) & ~gone)
            beside = (faces[around] == kept).any(axis=1)
            if not _can_contract(faces[~gone], kept, lost):
                continue
            new = np.where(faces[around[~beside]] == lost, kept, faces[around[~beside]])
            if _is_good(function, vertices, new, tolerance):
                faces[around[~beside]] = new
                gone[around[beside]] = True
                break
    return faces[~gone]


def _can_contract(faces: IntArray, kept: int, lost: int) -> bool:
    """The link condition, of an edge with two faces."""
    near, far = (faces[(faces == v).any(axis=1)] for v in (kept, lost))
    common = np.setdiff1d(np.intersect1d(near, far), [kept, lost])
    beside = far[(far == kept).any(axis=1)]
    return len(beside) == 2 and np.array_equal(common, np.setdiff1d(beside, [kept, lost]))


def _is_good(
    function: LevelFunction, vertices: FloatArray, new: IntArray, tolerance: float
) -> bool:
    corner = vertices[new]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    samples = function.at(corner.mean(axis=1))
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(samples.gradient, axis=1)
    facing = (normal * samples.gradient).sum(axis=1) > _FACING * size
    near = samples.distance <= tolerance
    return bool((facing & near & (least_angles(vertices, new) > _SLIVER)).all())
