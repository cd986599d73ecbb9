"""The thickness of the walls of a closed mesh: how much material is behind each of its faces. It is
measured at the center of each face, by the largest ball inside of the material that touches the
face there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy, to_vector3
from harnack.fields import Solid
from harnack.fields.solids.mesh_solid import MeshSolid, solid_of_mesh
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    half_edges,
    has_distinct_corners,
    row_dots,
    row_norms,
    unit_normals,
)
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.mesh_pipeline import mesh
from harnack.tracer import trace

if TYPE_CHECKING:
    import trimesh

__all__ = ["WallThickness", "wall_thickness"]

# Rays start this far below a face, relative to the mesh's size.
_START_DEPTH = 1e-6
# The largest number of times that balls shrink; and the distance from the surface at which they
# count as touching it.
_MOST_ROUNDS, _TOUCHING = 30, 1e-6
# Two points are opposite if the cosine between their normals is below this: walls beside an edge of
# a part, at up to 120 degrees, are no thin places.
_OPPOSITE = -0.5
# An edge is acute if the cosine between the normals of its faces is below this, so that the angle
# in the material is less than 87 degrees: not the edges of a box, but for rounding.
_ACUTE = -0.05
# Beside an edge of angle a, material is 2 d tan(a/2) thick at the distance d. A place belongs to
# the edge up to this many times that distance, as walls may be curved; and a tangent of a/2 below
# the second number counts as that.
_REACH, _LEAST_TANGENT = 1.5, 0.05
# So many acute edges, those with the nearest middles, are looked at for each face.
_NEAR_EDGES = 8


@dataclass(frozen=True, eq=False)
class WallThickness:
    """The thickness of the material behind each face of a closed mesh; the result of
    `wall_thickness`.

    vertices, faces: (n, 3), (m, 3) the mesh.
    values: (m,) the thickness at the centers of faces, a length; nan for faces without an area."""

    vertices: FloatArray
    faces: IntArray
    values: FloatArray

    def __repr__(self) -> str:
        return f"Thickness({len(self.faces):,} faces, thinnest {self.thinnest:.4g})"

    @property
    def thinnest(self) -> float:
        """The smallest thickness of all faces, a length."""
        return float(np.nanmin(self.values))

    def thin_locations(self, less_than: float) -> FloatArray:
        """(k, 3) the centers of the faces at which the wall is thinner than `less_than`, a length;
        the thinnest first."""
        rows = np.flatnonzero(self.is_thinner(less_than))
        rows = rows[np.argsort(self.values[rows])]
        return self.vertices[self.faces[rows]].mean(axis=1)

    def is_thinner(self, than: float) -> BoolArray:
        """(m,) whether the wall is thinner than `than`, a length, at each face."""
        return np.asarray(np.nan_to_num(self.values, nan=np.inf) < than)

    def is_at_acute_edge(self) -> BoolArray:
        """(m,) whether each face is thin because it lies beside an edge with an acute angle, as
        where a wall is cut at a slant: any part is thin there, and its thickness goes to 0 at the
        edge.

        Let a < 87 degrees be the angle of the edge in the material. At the distance d from it the
        material is 2 d tan(a/2) thick. A face counts if d is at most 1.5 times that distance for
        its thickness. (A tangent below 0.05 counts as 0.05.)
        """
        result = np.zeros(len(self.faces), np.bool_)
        ends, tangents = _acute_edges(self.vertices, self.faces)
        rows = np.flatnonzero(np.isfinite(self.values))
        if not len(ends):
            return result
        centers = self.vertices[self.faces[rows]].mean(axis=1)
        # By 2 d tan(a/2) <= `_REACH` times the thickness.
        limits = 0.5 * _REACH * self.values[rows]
        count = min(_NEAR_EDGES, len(ends))
        # The edges with the nearest middles, a column for each.
        _, nearest = kd_tree(ends.mean(axis=1)).query(centers, k=[*range(1, count + 1)])
        for k in range(count):
            start, edge = ends[nearest[:, k], 0], ends[nearest[:, k], 1] - ends[nearest[:, k], 0]
            fraction = row_dots(centers - start, edge) / row_dots(edge, edge)
            foot = start + np.clip(fraction, 0, 1)[:, None] * edge
            distance = row_norms(centers - foot)
            result[rows] |= distance * tangents[nearest[:, k]] <= limits
        return result

    def to_colored_mesh(self, low: float, high: float) -> trimesh.Trimesh:
        """The mesh with a color for each face, by its thickness: red up to the thickness `low`,
        gray from `high` on, and between them a gradient from red over yellow to gray.
        `hk.io.write_mesh` writes such colors to files of every format but STL.
        """
        import trimesh  # imported here: it takes half a second

        fraction = np.clip((self.values - low) / max(high - low, 1e-300), 0.0, 1.0)
        # Faces without an area have no thickness; they are gray.
        fraction = np.nan_to_num(fraction, nan=1.0)
        stops = np.array([[200, 30, 30], [240, 200, 60], [190, 190, 190]], np.float64)
        colors = np.full((len(fraction), 4), 255, np.uint8)
        for k in range(3):
            colors[:, k] = np.rint(np.interp(fraction, (0.0, 0.5, 1.0), stops[:, k]))
        return trimesh.Trimesh(
            self.vertices, self.faces, face_colors=colors, process=False, validate=False
        )


def wall_thickness(part: Any, **options: Any) -> WallThickness:
    """Measure the thickness of a part behind each of its faces.

    part: a closed mesh (a trimesh.Trimesh, (vertices, faces), or the name of a file); or a solid,
        which is meshed first.
    options: for a solid, the options of `mesh`.

    At the center of a face a ray goes into the part, against the normal, and ends at the other
    side, at a distance t. A ball of diameter t touches the center from inside. Now the point of the
    surface that is nearest to the ball's center is computed. If it lies inside of the ball and on
    an opposite wall, the ball is replaced by the smaller ball that touches the face and that point.
    A wall is opposite if its normal differs from that of the face by more than 120 degrees. This is
    repeated as long as there is such a point (Ma, Bae and Choi 2012, 3D medial axis point
    approximation using nearest neighbors and the normal field). The thickness is the diameter of
    the last ball. Where walls are parallel it is their distance, and it is never more than t.

    Near an edge with a right or obtuse angle the adjacent wall is near, but not opposite. It does
    not count, so such edges are not reported as thin: the ball stops shrinking there, and the value
    is an upper bound of the thickness. At an edge with an acute angle the ray meets the adjacent
    wall, and thickness goes to 0 (`WallThickness.is_at_acute_edge`). The value of a face without an
    area is NaN.

    Distances from the triangles are computed up to 1e-6 of the mesh's size. The thickness is
    measured only at the centers of faces: divide large faces first to measure it more densely
    (`mesh.subdivide_to_size`).

    Raises:
        TypeError: options are given with a mesh.
        MeshError: a mesh that bounds no solid.
        MeshingError: a solid that cannot be meshed.
    """
    if isinstance(part, Solid) and not isinstance(part, MeshSolid):
        part = mesh(part, **options)
    elif options:
        raise TypeError(f"{next(iter(options))} is for solids: a mesh is taken as it is")
    solid = part if isinstance(part, MeshSolid) else solid_of_mesh(part)
    x, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    corner = x[faces]
    normal = area_normals(corner)
    length = row_norms(normal)
    rows = np.flatnonzero(length > 0)
    values = np.full(len(faces), np.nan)
    values[rows] = _medial_diameters(
        solid, corner[rows].mean(axis=1), normal[rows] / length[rows, None]
    )
    return WallThickness(x, faces, values)


def _acute_edges(x: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """The edges of a closed mesh at which the angle a in the material is acute.

    Returns:
        The ends (k, 2, 3) of the edges; and for each the tangent (k,) of a/2, at least 0.05.
    """
    faces = faces[has_distinct_corners(faces)]
    pairs = half_edges(faces)
    first, second = Edges.of(pairs).paired_half_edges().T
    normal, count = unit_normals(x[faces]), len(faces)
    # Half-edge k m + i is that of face i from corner k, and the corner opposite is k + 2.
    opposite = faces[second % count, (second // count + 2) % 3]
    normals = normal[first % count], normal[second % count]
    cosine = row_dots(*normals)
    is_convex = row_dots(x[opposite] - x[pairs[first, 0]], normals[0]) < 0
    is_acute = is_convex & (cosine < _ACUTE)
    # The normals are at an angle of pi - a.
    cosine = cosine[is_acute]
    tangents = np.sqrt(np.maximum(1 + cosine, 0) / (1 - cosine))
    return x[pairs[first[is_acute]]], np.maximum(tangents, _LEAST_TANGENT)


def _medial_diameters(solid: MeshSolid, start: FloatArray, normal: FloatArray) -> FloatArray:
    """(k,) the thickness of a solid at points `start` (k, 3) of its surface, with the outward unit
    normals `normal` (k, 3) there: the diameters of balls that touch the surface from inside at
    these points (`wall_thickness`).

    A ball's first diameter is the length of the ray from the point into the solid, up to the
    surface. Then the point of the surface nearest to the ball's center is computed. If it is inside
    of the ball and its normal differs from the start's by more than 120 degrees, the ball is
    replaced by the smaller one that touches both. This is repeated for each ball until its nearest
    point does not meet both conditions, and at most 30 times.
    """
    size = solid.surface.size
    start_depth = _START_DEPTH * size
    # Rays begin inside, at the depth `start_depth`, and hits within as much again do not count. The
    # tolerance is relative to the mesh: with a fixed one, rays into a small mesh would end where
    # they start.
    hits: Any = trace(
        solid, start - start_depth * normal, -normal,
        t_min=start_depth, tolerance=0.1 * start_depth, precision="double",
    )  # fmt: skip
    ray_length = np.asarray(hits.t, np.float64) + start_depth
    diameter = np.where(np.isfinite(ray_length), ray_length, 2 * size)
    # Where that is already beyond the other side, the part is no thicker than the skipped length.
    diameter[~_is_within(solid, start - 2 * start_depth * normal)] = 2 * start_depth
    active_rows = np.arange(len(diameter))
    for _ in range(_MOST_ROUNDS):
        if not len(active_rows):
            break
        # p is the point where a ball touches the surface, n the normal there, and r the ball's
        # radius.
        p, n, r = start[active_rows], normal[active_rows], 0.5 * diameter[active_rows]
        center = p - r[:, None] * n
        distance, nearest, direction = _nearest(solid, center)
        # Balls that are empty, or whose nearest point is on no opposite wall, shrink no further.
        is_inside = distance < r * (1 - _TOUCHING)
        is_shrinking = is_inside & (row_dots(direction, n) < _OPPOSITE)
        to_start = p - nearest
        depth = row_dots(to_start, n)
        is_shrinking &= depth > 0
        # The ball that touches the start and the nearest point y has the radius |start - y|^2 / (2
        # (start - y) . normal).
        radius = row_dots(to_start, to_start)[is_shrinking] / (2 * depth[is_shrinking])
        diameter[active_rows[is_shrinking]] = np.minimum(
            diameter[active_rows[is_shrinking]], 2 * radius
        )
        active_rows = active_rows[is_shrinking]
    return diameter


def _is_within(solid: MeshSolid, points: FloatArray) -> BoolArray:
    """(k,) whether points (k, 3) are inside of the solid."""
    backend = choose_backend("double")
    value = solid.evaluator(backend).evaluate(to_vector3(backend, points)).value
    return np.asarray(to_numpy(value) < 0)


def _nearest(solid: MeshSolid, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """For points (k, 3) inside of a solid, the nearest points of its surface.

    Returns:
        The distances (k,) of these; the nearest points (k, 3) themselves; and the unit vectors (k,
        3) towards them.
    """
    backend = choose_backend("double")
    sample = solid.evaluator(backend).evaluate(to_vector3(backend, points))
    value, gradient = to_numpy(sample.value), to_numpy(sample.gradient)
    # The value is the signed distance, negative inside; the gradient points to the surface.
    distance = np.abs(value)
    return distance, points - value[:, None] * gradient, gradient
