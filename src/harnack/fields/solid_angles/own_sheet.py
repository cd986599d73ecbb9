"""Open meshes that lie on the level set of their own winding number, such as a file that `mesh`
wrote of a `SolidAngle`.

Off its triangles the winding number w of a mesh is, modulo 1, the solid angle of its boundary over
4 pi, and the level set of that spans the boundary. Where the triangles themselves lie on it, w has
the level right beside all of them: on which side of it w is there, and so whether w passes the
level where it jumps, is a matter of rounding, or of how far a flat triangle is from a round
surface. What has the level is then a checkerboard; but within the coarseness of the triangles it is
the mesh itself.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.geometry.meshes import solid_angles

if TYPE_CHECKING:
    from harnack.fields.solid_angles.winding_mesh import WindingMesh

__all__ = ["lies_on_own_level"]

# Of the mesh's size: vertices are on the surface within this, the rounding of single precision and
# of decimals in files. A box of this height without a bottom is such a sheet.
_ON_SURFACE = 1e-5
# Where all vertices are on the boundary, w at centers of triangles is the level up to this: beside
# a thin triangle w is so steep that every surface is near it.
_ROUNDING = 1e-7
# Centers of triangles are within this part of the longest edge; those that `mesh` makes within a
# twentieth.
_FLAT = 0.1
# Of so many vertices and centers, this part have to be so; the first decides most meshes.
_MOST, _NEARLY_ALL, _FIRST = 400, 0.99, 1
# So many points are compared with the sum over all triangles, within this part of a turn.
_COUNTED, _SAME = 8, 0.25
_AT_ONCE = 1 << 20
# The apex of all edges' triangles; any direction that edges are not likely to have.
_APEX: FloatArray = np.array([0.3017, 0.5043, 0.8091]) / math.sqrt(
    0.3017**2 + 0.5043**2 + 0.8091**2
)


def lies_on_own_level(mesh: WindingMesh, level: float) -> bool:
    """Whether the triangles of an open mesh lie on the surface that spans its boundary, with this
    level of w modulo 1, and are the points at which w jumps from the level by one.

    Looked at and not proved: vertices that are not on the boundary are on that surface within the
    rounding of files, in first order, but for one in a hundred; if there are none, w has the level
    at centers of triangles, up to rounding; centers are within a part of the triangles' edges. Then
    it is all of the surface: of each edge of the boundary, which is that of one triangle, one sheet
    of it begins, and every part of it ends there (a harmonic function has no closed level set but
    about its poles).
    """
    if not len(mesh.singular_edges) or (mesh.multiplicity != 1).any():
        return False
    inner = np.zeros(len(mesh.vertices), np.bool_)
    inner[mesh.faces] = True
    inner[mesh.singular_edges] = False
    x = mesh.unit_vertices
    edges = x[mesh.singular_edges]
    corners = mesh.corners
    is_filled = inner.any()
    points = _some(x[inner] if is_filled else corners.mean(axis=1), _MOST)
    # In units in which the mesh has a size of one to two.
    most = 2 * _ON_SURFACE if is_filled else _ROUNDING

    def is_on(places: FloatArray) -> BoolArray:
        gap, distance = _offsets(edges, places, level)
        return (distance if is_filled else gap) < most

    if not is_on(points[:_FIRST]).all() or np.mean(is_on(points)) < _NEARLY_ALL:
        return False
    corners = _some(corners, _MOST)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    _, far = _offsets(edges, corners.mean(axis=1), level)
    if np.mean(far < _FLAT * longest) < _NEARLY_ALL:
        return False
    # The mean of w on both sides, which are the level and one more or less than it.
    mean = np.array([_mean_winding(mesh.corners, point) for point in _some(points, _COUNTED)])
    return any(bool((np.abs(mean - level - way) < _SAME).all()) for way in (-0.5, 0.5))


def _some(rows: FloatArray, most: int) -> FloatArray:
    """At most so many rows, from all over."""
    return rows[:: -(-len(rows) // most)]


def _offsets(edges: FloatArray, points: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """By how much w modulo 1 at points (n, 3) differs from a level, and how far they are from the
    surface that spans closed edges (k, 2, 3), by the slope of their solid angle: the sum of those
    of triangles from each edge to an apex far away."""
    gaps: list[FloatArray] = []
    slopes: list[FloatArray] = []
    step = max(1, _AT_ONCE // len(edges))
    for first in range(0, len(points), step):
        batch = points[first : first + step, None]
        p, q = edges[None, :, 0] - batch, edges[None, :, 1] - batch
        a, b = np.linalg.norm(p, axis=2), np.linalg.norm(q, axis=2)
        normal: FloatArray = np.cross(p, q)
        cosine = a * b + (p * q).sum(axis=2)
        below = cosine + b * (p @ _APEX) + a * (q @ _APEX)
        turn = 2 * np.arctan2(normal @ _APEX, below)
        with np.errstate(divide="ignore", invalid="ignore"):  # on an edge it has no slope
            rates = ((a + b) / (a * b * cosine))[:, :, None] * normal
        gap: FloatArray = turn.sum(axis=1) / (4 * math.pi) - level
        gaps.append(np.abs(gap - np.round(gap)))
        slopes.append(np.linalg.norm(rates.sum(axis=1), axis=1) / (4 * math.pi))
    gap = np.concatenate(gaps)
    return gap, gap / np.maximum(np.concatenate(slopes), 1e-300)


def _mean_winding(corners: FloatArray, point: FloatArray) -> float:
    """The mean of the winding numbers on both sides of a mesh (m, 3, 3) at a point of it: that of
    all triangles but those that it lies on, which fill half of all directions."""
    angles = solid_angles(corners, point)
    is_off = np.abs(angles) < 2 * (math.pi - _ON_SURFACE)
    return float(angles[is_off].sum()) / (4 * math.pi)
