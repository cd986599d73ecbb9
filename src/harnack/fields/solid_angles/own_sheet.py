"""Open meshes that lie on the level set of their own winding number, such as a file that `mesh`
wrote of a `SolidAngle`.

Off its triangles the winding number w of a mesh is, modulo 1, the solid angle of its boundary over
4 pi, and the level set of that spans the boundary. If the triangles themselves lie on this level
set, w has the level right beside all of them: the side of it on which w is, and so whether w passes
the level at the jump, depends on rounding, or on the distance of a flat triangle from a curved
surface. The points with the level then form a checkerboard; but up to the coarseness of the
triangles the level set is the mesh itself.
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

# Vertices are on the surface within this fraction of the mesh's size, the rounding of single
# precision and of decimals in files. A box of this height without a bottom is such a sheet.
_ON_SURFACE = 1e-5
# If all vertices are on the boundary, w at centers of triangles is the level up to this number:
# beside a thin triangle w is so steep that every surface is near it.
_ROUNDING = 1e-7
# Centers of triangles are within this fraction of the longest edge from the surface; of triangles
# that `mesh` makes within a twentieth.
_FLAT = 0.1
# Of at most `_MAX_POINTS` vertices and centers, the fraction `_MIN_NEAR_FRACTION` has to be near
# the surface; the first `_FIRST_POINTS` points decide most meshes.
_MAX_POINTS, _MIN_NEAR_FRACTION, _FIRST_POINTS = 400, 0.99, 1
# At `_COMPARED_POINTS` points the sum over all triangles is compared, within the fraction
# `_MAX_WINDING_DIFFERENCE` of a turn.
_COMPARED_POINTS, _MAX_WINDING_DIFFERENCE = 8, 0.25
_AT_ONCE = 1 << 20
# The apex of the triangles of all edges: a direction that edges are not likely to have.
_APEX: FloatArray = np.array([0.3017, 0.5043, 0.8091]) / math.sqrt(
    0.3017**2 + 0.5043**2 + 0.8091**2
)


def lies_on_own_level(mesh: WindingMesh, level: float) -> bool:
    """Whether the triangles of an open mesh lie on the surface that spans its boundary, with this
    level of w modulo 1, and are the points at which w jumps from the level by one.

    This is a numerical test and no proof: 99 % of the vertices that are not on the boundary are on
    that surface within the rounding of files, in first order; if there are no such vertices, w has
    the level at centers of triangles, up to rounding; centers are within a fraction of the
    triangles' edges. Then the mesh is all of the surface: from each edge of the boundary, which
    belongs to a single triangle, one sheet of the surface begins, and every part of it ends there
    (a harmonic function has no closed level set except about its poles).
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
    points = _evenly_spaced_rows(x[inner] if is_filled else corners.mean(axis=1), _MAX_POINTS)
    # In units in which the mesh has a size of one to two.
    limit = 2 * _ON_SURFACE if is_filled else _ROUNDING

    def is_on(queries: FloatArray) -> BoolArray:
        gap, distance = _offsets(edges, queries, level)
        return (distance if is_filled else gap) < limit

    if not is_on(points[:_FIRST_POINTS]).all() or np.mean(is_on(points)) < _MIN_NEAR_FRACTION:
        return False
    corners = _evenly_spaced_rows(corners, _MAX_POINTS)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    _, far = _offsets(edges, corners.mean(axis=1), level)
    if np.mean(far < _FLAT * longest) < _MIN_NEAR_FRACTION:
        return False
    # The mean of w on both sides, where w is the level, and the level plus or minus 1.
    mean = np.array(
        [
            _mean_winding(mesh.corners, point)
            for point in _evenly_spaced_rows(points, _COMPARED_POINTS)
        ]
    )
    return any(
        bool((np.abs(mean - level - side) < _MAX_WINDING_DIFFERENCE).all()) for side in (-0.5, 0.5)
    )


def _evenly_spaced_rows(rows: FloatArray, max_count: int) -> FloatArray:
    """At most `max_count` rows, evenly spaced."""
    return rows[:: -(-len(rows) // max_count)]


def _offsets(edges: FloatArray, points: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """The difference of w modulo 1 from a level at points (n, 3), and the distance of the
    points, to first order, from the surface that spans closed edges (k, 2, 3). w and its
    gradient come from the solid angle of the edges, the sum of those of triangles from each edge
    to an apex far away."""
    gaps: list[FloatArray] = []
    slopes: list[FloatArray] = []
    step = max(1, _AT_ONCE // len(edges))
    for first in range(0, len(points), step):
        batch = points[first : first + step, None]
        p, q = edges[None, :, 0] - batch, edges[None, :, 1] - batch
        a, b = np.linalg.norm(p, axis=2), np.linalg.norm(q, axis=2)
        normal: FloatArray = np.cross(p, q)
        cosine = a * b + (p * q).sum(axis=2)
        denominator = cosine + b * (p @ _APEX) + a * (q @ _APEX)
        angle = 2 * np.arctan2(normal @ _APEX, denominator)
        with np.errstate(divide="ignore", invalid="ignore"):  # on an edge it has no slope
            rates = ((a + b) / (a * b * cosine))[:, :, None] * normal
        gap: FloatArray = angle.sum(axis=1) / (4 * math.pi) - level
        gaps.append(np.abs(gap - np.round(gap)))
        slopes.append(np.linalg.norm(rates.sum(axis=1), axis=1) / (4 * math.pi))
    gap = np.concatenate(gaps)
    return gap, gap / np.maximum(np.concatenate(slopes), 1e-300)


def _mean_winding(corners: FloatArray, point: FloatArray) -> float:
    """The mean of the winding numbers on both sides of a mesh (m, 3, 3) at a point of it: the
    winding number of all triangles except those that contain the point, which fill half of all
    directions."""
    angles = solid_angles(corners, point)
    is_off = np.abs(angles) < 2 * (math.pi - _ON_SURFACE)
    return float(angles[is_off].sum()) / (4 * math.pi)
