"""The test whether an open mesh lies on the level set of its own winding number. An example is a
mesh of the surface of a `SolidAngle`, as the function `mesh` writes it. Below, w is the winding
number of the mesh, and "the surface" is the level set of w modulo 1 that spans the boundary of the
mesh.

Away from the triangles, w modulo 1 is the solid angle of the boundary divided by 4 pi. If the
triangles lie on the surface, w tends to the level itself on one side of every triangle, and to the
level plus or minus 1 on the other side. Whether w takes the level near a triangle then depends on
rounding, or on the distance of the flat triangle from the curved surface: a picture of the hits
would be a checkerboard. Up to the size of the triangles, the level set is the mesh itself. If
`lies_on_own_level` finds such a mesh, `WindingNumber` takes the triangles as the level set.
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

# Vertices count as on the surface if they are within this fraction of the mesh's size from it. This
# allows for the rounding of single precision and of decimals in files. A box of this height without
# a bottom also counts as such a mesh.
_ON_SURFACE = 1e-5
# If all vertices are on the boundary, w at the centers of triangles must be the level up to this
# number. Distances do not decide then: beside a thin triangle w is so steep that every surface is
# near.
_ROUNDING = 1e-7
# Centers of triangles must be within this fraction of the longest edge from the surface. For
# triangles that `mesh` makes they are within a twentieth.
_MAX_CENTER_DISTANCE = 0.1
# At most `_MAX_TESTED` vertices or centers are tested, and the fraction `_REQUIRED_FRACTION` of
# these must be near the surface. The first `_TESTED_FIRST` points already rule out most meshes.
_MAX_TESTED, _REQUIRED_FRACTION, _TESTED_FIRST = 400, 0.99, 1
# At `_SUMMED_POINTS` points the winding number of all triangles is computed; it must have the
# expected value up to `_MAX_DIFFERENCE`.
_SUMMED_POINTS, _MAX_DIFFERENCE = 8, 0.25
_MAX_PAIRS = 1 << 20
# The direction of the apex, far away, of the triangles from all edges. Edges are not likely to have
# this direction.
_APEX: FloatArray = np.array([0.3017, 0.5043, 0.8091]) / math.sqrt(
    0.3017**2 + 0.5043**2 + 0.8091**2
)


def lies_on_own_level(mesh: WindingMesh, level: float) -> bool:
    """Whether the triangles of an open mesh lie on a level set of the mesh's own winding number w:
    on the surface that spans the boundary of the mesh and on which w modulo 1 has this level. False
    for a closed mesh, and for one with repeated faces.

    This is a numerical test and no proof. It tests three things at up to 400 points each:

    - 99 % of the vertices that are not on the boundary are on that surface within the rounding of
      files, to first order. If there are no such vertices, w has the level at centers of triangles,
      up to rounding.
    - The centers of triangles are near the surface, within a fraction of the triangles' edges.
    - The winding number of all triangles is right at a few points.

    Then the mesh is all of the surface: one sheet of the surface begins from each edge of the
    boundary, which belongs to a single triangle, and every part of the surface ends there, because
    a harmonic function has no closed level set except around its poles.
    """
    if not len(mesh.singular_edges) or (mesh.multiplicity != 1).any():
        return False
    is_inner = np.zeros(len(mesh.vertices), np.bool_)
    is_inner[mesh.faces] = True
    is_inner[mesh.singular_edges] = False
    x = mesh.unit_vertices
    edges = x[mesh.singular_edges]
    corners = mesh.corners
    has_inner = is_inner.any()
    points = _spaced_rows(x[is_inner] if has_inner else corners.mean(axis=1), _MAX_TESTED)
    # A distance, in units in which the mesh has a size of one to two; without inner vertices a
    # difference of w.
    max_distance = 2 * _ON_SURFACE if has_inner else _ROUNDING

    def is_on(queries: FloatArray) -> BoolArray:
        """A mask (k,) of points `queries` (k, 3): whether each is on the surface."""
        gap, distance = _level_gaps(edges, queries, level)
        return (distance if has_inner else gap) < max_distance

    # One point alone rules out most meshes.
    if not is_on(points[:_TESTED_FIRST]).all() or np.mean(is_on(points)) < _REQUIRED_FRACTION:
        return False
    corners = _spaced_rows(corners, _MAX_TESTED)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    _, center_distance = _level_gaps(edges, corners.mean(axis=1), level)
    if np.mean(center_distance < _MAX_CENTER_DISTANCE * longest) < _REQUIRED_FRACTION:
        return False
    # The mean of w on both sides of the mesh. On one side w is the level, on the other the level
    # plus or minus 1, with the same sign everywhere; so the mean is the level plus or minus 1/2.
    mean = np.array(
        [_mean_winding(mesh.corners, point) for point in _spaced_rows(points, _SUMMED_POINTS)]
    )
    return any(bool((np.abs(mean - level - side) < _MAX_DIFFERENCE).all()) for side in (-0.5, 0.5))


def _spaced_rows(rows: FloatArray, max_count: int) -> FloatArray:
    """Select at most `max_count` rows of an array, at evenly spaced indices."""
    return rows[:: -(-len(rows) // max_count)]


def _level_gaps(
    edges: FloatArray, points: FloatArray, level: float
) -> tuple[FloatArray, FloatArray]:
    """Compare w modulo 1 with a level at points (n, 3), where w is the solid angle of closed curves
    divided by 4 pi.

    edges: (k, 2, 3) both ends of the directed edges of the curves.

    Returns two arrays (n,): the absolute difference of w modulo 1 from the level; and the distance
    of the points, to first order, from the surface with this level that spans the edges. w and its
    gradient come from the solid angle of the edges, which is the sum of the solid angles of
    triangles from each edge to an apex far away.
    """
    gap_batches: list[FloatArray] = []
    slope_batches: list[FloatArray] = []
    step = max(1, _MAX_PAIRS // len(edges))
    for start in range(0, len(points), step):
        batch = points[start : start + step, None]
        # Both ends of each edge relative to each point, (batch, k, 3), and their distances.
        p, q = edges[None, :, 0] - batch, edges[None, :, 1] - batch
        a, b = np.linalg.norm(p, axis=2), np.linalg.norm(q, axis=2)
        # The solid angle of the triangle from each edge to the apex by the formula of Van Oosterom
        # and Strackee, and the edge's part of the gradient.
        normal: FloatArray = np.cross(p, q)
        cosine = a * b + (p * q).sum(axis=2)  # a b (1 + the cosine of the angle between p and q)
        denominator = cosine + b * (p @ _APEX) + a * (q @ _APEX)
        angle = 2 * np.arctan2(normal @ _APEX, denominator)
        with np.errstate(divide="ignore", invalid="ignore"):  # on an edge it has no slope
            edge_gradients = ((a + b) / (a * b * cosine))[:, :, None] * normal
        gap: FloatArray = angle.sum(axis=1) / (4 * math.pi) - level
        gap_batches.append(np.abs(gap - np.round(gap)))
        slope_batches.append(np.linalg.norm(edge_gradients.sum(axis=1), axis=1) / (4 * math.pi))
    gap = np.concatenate(gap_batches)
    return gap, gap / np.maximum(np.concatenate(slope_batches), 1e-300)


def _mean_winding(corners: FloatArray, point: FloatArray) -> float:
    """The mean of the winding numbers on both sides of a mesh, at a point (3,) of the mesh.

    corners: (m, 3, 3) the corners of the mesh's triangles.

    The mean is the winding number of the triangles that do not contain the point. From the point, a
    triangle that contains it has the solid angle 2 pi, with one sign from each side, so that it
    adds 0 to the mean.
    """
    angles = solid_angles(corners, point)
    is_off = np.abs(angles) < 2 * (math.pi - _ON_SURFACE)
    return float(angles[is_off].sum()) / (4 * math.pi)
