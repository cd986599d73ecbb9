"""Connected components of meshes, such as the largest one or the largest body with its cavities;
and open surfaces cut at planes and spheres (`clip_to_volume`). A component is a largest set of
faces that are joined by common vertices. The signed volume of a closed component is positive if its
faces look outwards, and negative if it is turned inwards. The winding number of a component around
a point is then 1 or -1 inside of it, and 0 outside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Volume, VolumeIntersection
from harnack.geometry.mesh_edges import (
    area_normals,
    boundary_edges,
    edge_keys,
    normals_at_vertices,
    row_dots,
    shortest_edges_at_vertices,
)
from harnack.geometry.meshes import solid_angles
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.lattice_meshing import TriangleMesh
from harnack.meshing.meshing_errors import MeshingError

__all__ = [
    "Shells",
    "clip_to_volume",
    "component_facts",
    "drop_degenerate_components",
    "faces_to_flip",
    "largest_body",
    "largest_component",
    "winding_around",
]

# Components no thicker than this, relative to their coordinates, are rounding error.
_DEGENERATE_THICKNESS = 1e-11


def largest_component(surface: TriangleMesh) -> TriangleMesh:
    """The connected component of a surface that has the largest area."""
    part = _component_of_faces(surface)
    areas = np.bincount(part, np.linalg.norm(area_normals(surface.vertices[surface.faces]), axis=1))
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[part == areas.argmax()]
    )


def largest_body(surface: TriangleMesh) -> TriangleMesh:
    """The body with the largest volume that a closed surface bounds. A body consists of an outer
    shell and the shells of its cavities. A shell is a connected component of the surface; the
    shells of cavities are turned inwards, so that their volumes are negative. A cavity belongs to
    the smallest outer shell around it.

    Proof that this is the right outer shell. Shells are closed, connected, and do not meet; the
    surface bounds a set. Around a shell that is turned inwards there is a connected part of the
    set, and that part has an outer shell. Of all outer shells around the cavity, this is the
    innermost and so the smallest one: another shell in between would lie outside of the part, with
    nothing of the set between the two. Whether a point is inside a shell is decided by the shell's
    winding number there, which is an integer.

    Raises:
        MeshingError: a shell that is turned inwards lies in no outer shell.
    """
    shells = Shells.of(surface)
    body_volumes = shells.volumes.copy()
    outer_shell_of = np.arange(len(body_volumes))
    outer_shells = np.flatnonzero(shells.volumes > 0)
    # Smallest first.
    outer_shells = outer_shells[np.argsort(shells.volumes[outer_shells])]
    for cavity in np.flatnonzero(shells.volumes <= 0):
        shells_around = (
            shell for shell in outer_shells if shells.winding_number(shell, cavity) > 0.5
        )
        if (outer_shell := next(shells_around, None)) is None:
            raise MeshingError("a part of the mesh is inside out: choose a smaller `cell_size`")
        outer_shell_of[cavity] = outer_shell
        body_volumes[outer_shell] += shells.volumes[cavity]
    largest = outer_shells[body_volumes[outer_shells].argmax()] if len(outer_shells) else -1
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[outer_shell_of[shells.component_of_face] == largest]
    )


def drop_degenerate_components(surface: TriangleMesh) -> TriangleMesh:
    """Remove the connected components of a closed surface that are only rounding error, such as
    what remains of a solid minus itself. A component is removed if its volume is so small, compared
    with its area, that it is about as thin as rounding errors of the coordinates."""
    x, faces = surface.vertices, surface.faces
    if not len(faces):
        return surface
    part = _component_of_faces(surface)
    count = np.bincount(part)
    corner = x[faces]
    # Each component relative to its own center, against rounding errors.
    center = (
        np.stack([np.bincount(part, c) for c in corner.mean(axis=1).T], axis=1) / count[:, None]
    )
    corner = corner - center[part][:, None]
    normal = area_normals(corner)
    # Six times the volume and twice the area.
    volume = np.abs(np.bincount(part, (corner[:, 0] * normal).sum(axis=1)))
    area = np.bincount(part, np.linalg.norm(normal, axis=1))
    # The mean thickness is 2 V / A. With 6 V and 2 A at hand: 2 (6 V) / 3 / (2 A).
    is_thin = 2 * volume <= 3 * _DEGENERATE_THICKNESS * float(np.abs(x).max()) * area
    if not is_thin.any():
        return surface
    rest = faces[~is_thin[part]]
    return TriangleMesh.without_unused_vertices(x, rest) if len(rest) else TriangleMesh(x[:0], rest)


def component_facts(surface: TriangleMesh) -> list[dict[str, Any]]:
    """Facts about each connected component of a closed surface, the largest first: a dictionary
    with the entries `faces`, the number of faces; `volume`, which is negative for a cavity; and
    `center`, the center of the bounding box as a list of three numbers."""
    shells, facts = Shells.of(surface), list[dict[str, Any]]()
    counts = np.bincount(shells.component_of_face)
    for k in np.argsort(-np.abs(shells.volumes), kind="stable"):
        center = 0.5 * (shells.lower[k] + shells.upper[k])
        volume = float(shells.volumes[k])
        facts.append({"faces": int(counts[k]), "volume": volume, "center": center.tolist()})
    return facts


def faces_to_flip(surface: TriangleMesh) -> npt.NDArray[np.bool_]:
    """(m,) mask of the faces of a closed surface that must be turned over so that no component is
    inside out. They belong to the components that have a negative volume and lie in no other
    component; a component of negative volume within another one is a cavity."""
    shells = Shells.of(surface)
    is_inside_out = (shells.volumes < 0) & (shells.nesting_depths() == 0)
    return is_inside_out[shells.component_of_face]


@dataclass(frozen=True)
class Shells:
    """The connected components of a closed surface with m faces, called shells. A shell has a
    positive volume if its faces look outwards, and a negative volume if it is turned inwards, as
    around a cavity. Its winding number around a point is 1 or -1 inside of it, and 0 outside.

    component_of_face: (m,) the index of the component of each face.
    volumes: (k,) the signed volumes of the components.
    lower, upper: (k, 3) the corners of their bounding boxes.
    corners: (m, 3, 3) the corners of the faces.
    """

    component_of_face: IntArray
    volumes: FloatArray
    lower: FloatArray
    upper: FloatArray
    corners: FloatArray

    @classmethod
    def of(cls, surface: TriangleMesh) -> Shells:
        """Find the connected components of a closed surface, their volumes and their boxes."""
        number = np.unique(_component_of_faces(surface), return_inverse=True)[1]
        corners = surface.vertices[surface.faces]
        # Relative to the center, so that rounding errors are relative to the size of the mesh.
        offset = corners[:, 0] - surface.vertices[surface.faces].mean(axis=(0, 1))
        volumes = (
            np.bincount(number, row_dots(area_normals(surface.vertices[surface.faces]), offset)) / 6
        )
        lower, upper = np.full((len(volumes), 3), np.inf), np.full((len(volumes), 3), -np.inf)
        np.minimum.at(lower, number, corners.min(axis=1))
        np.maximum.at(upper, number, corners.max(axis=1))
        return cls(number, volumes, lower, upper, corners)

    def winding_number(self, component: Any, part: Any) -> float:
        """How often the component with index `component` winds around a point of the component with
        index `part`: the center of a face."""
        point = self.corners[np.argmax(self.component_of_face == part)].mean(axis=0)
        return winding_around(self.corners[self.component_of_face == component], point)

    def nesting_depths(self) -> IntArray:
        """(k,) for each component, the winding number of all other components together around a
        point of it. If no two components meet, it is more than 0 for components inside the material
        of other components, and 0 for outermost ones."""
        depth = np.zeros(len(self.volumes), np.int64)
        for k in range(len(depth)) if len(depth) > 1 else ():
            point = self.corners[np.argmax(self.component_of_face == k)].mean(axis=0)
            # A component winds only around points in its box.
            in_box = ((self.lower < point) & (point < self.upper)).all(axis=1)
            in_box[k] = False
            candidates = np.flatnonzero(in_box)
            depth[k] = round(sum(self.winding_number(j, k) for j in candidates))
        return depth

    def bound(self) -> npt.NDArray[np.bool_]:
        """(m,) mask of the faces that bound the set of points around which all components together
        wind at least once. It is right only if no two components meet.

        Proof. The winding number just outside of a component is its nesting depth (the winding
        number of the other components). Just inside it is larger by one or, for a component that is
        turned inwards, smaller by one. So the faces of a component bound the set if it is turned
        outwards and its nesting depth is 0, or turned inwards and its nesting depth is 1.
        """
        is_boundary = self.nesting_depths() == np.where(self.volumes > 0, 0, 1)
        return is_boundary[self.component_of_face]


def _component_of_faces(surface: TriangleMesh) -> IntArray:
    """(m,) for each face, the index of its connected component. Faces are connected by common
    vertices."""
    faces = surface.faces
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    return connected_groups(pairs, len(surface.vertices))[faces[:, 0]]


def winding_around(corner: FloatArray, point: FloatArray) -> float:
    """The winding number, around a point (3,), of triangles with corners (m, 3, 3)."""
    return float(solid_angles(corner, point).sum()) / (4 * math.pi)


# Surfaces cut by volumes.

# Vertices that are no farther from a boundary than this, relative to the size of the mesh, count as
# on it.
_ON_BOUNDARY = 1e-9
# Vertices that are nearer to a boundary than this fraction of their shortest edge are moved onto
# it, or slivers (thin triangles) would remain.
_SNAP_DISTANCE = 0.25


@dataclass(frozen=True)
class _ClipBoundary:
    """A plane or a sphere at which a surface is cut. It has an inner side: behind the plane's
    normal, or in the sphere.

    center: (3,) a point of the plane, or the center of the sphere.
    normal: (3,) the plane's unit normal, outwards; unused for a sphere.
    radius: of the sphere; None for a plane.
    """

    center: FloatArray
    normal: FloatArray
    radius: float | None

    def heights(self, x: FloatArray) -> FloatArray:
        """(n,) signed distances of points x (n, 3) from the plane or sphere, negative on its inner
        side."""
        if self.radius is None:
            return (x - self.center) @ self.normal
        return np.linalg.norm(x - self.center, axis=1) - self.radius

    def slopes(self, x: FloatArray) -> FloatArray:
        """(n, 3) the gradients of the signed distance from the plane or sphere at points x (n, 3);
        they are unit vectors."""
        if self.radius is None:
            return np.broadcast_to(self.normal, x.shape)
        from_center = x - self.center
        return from_center / np.maximum(np.linalg.norm(from_center, axis=1), 1e-300)[:, None]


def clip_to_volume(surface: TriangleMesh, volume: Volume) -> TriangleMesh:
    """The part of a surface inside of a volume. New edges lie exactly on the volume's planes; on a
    sphere they are chords. The vertices that are kept come first and keep their order.

    Raises:
        MeshingError: the volume is neither a box, a ball, a half-space, a convex hull nor an
            intersection of such volumes.
    """
    if isinstance(volume, VolumeIntersection):
        for operand in volume.volumes:
            surface = clip_to_volume(surface, operand)
        return surface
    if isinstance(volume, Ball):
        return _cut(surface, _ClipBoundary(np.array(volume.center), np.zeros(3), volume.radius))
    if not isinstance(volume, Box | HalfSpace | ConvexHull):
        raise MeshingError(f"a {type(volume).__name__} cannot cut a mesh: give a box or a ball")
    # A row holds the plane's outward normal and its distance from the origin.
    for row in volume.planes():
        surface = _cut(surface, _ClipBoundary(row[:3] * row[3], row[:3], None))
    if isinstance(volume, Box):
        return TriangleMesh(_snap_to_box(surface.vertices, volume), surface.faces)
    return surface


def _snap_to_box(vertices: FloatArray, box: Box) -> FloatArray:
    """Move vertices (n, 3) onto the plane of a face of the box if only rounding separates them from
    it; returns all vertices."""
    for end in box.bounds():
        near = np.abs(vertices - end) <= _ON_BOUNDARY * (1 + np.abs(end))
        vertices = np.where(near, end, vertices)
    return vertices


def _snap_to_boundary(
    surface: TriangleMesh, boundary: _ClipBoundary
) -> tuple[FloatArray, FloatArray]:
    """Move vertices that are very near the plane or sphere `boundary` onto it, since cutting beside
    them would leave slivers (thin triangles). A vertex is moved in the surface's tangent plane, if
    the move is shorter than a quarter of the vertex's shortest edge. Vertices on the boundary edges
    of the surface itself are not moved.

    Returns the vertices (n, 3), and their signed distances (n,) from the plane or sphere.
    """
    x, faces = surface.vertices, surface.faces
    shortest_edge = shortest_edges_at_vertices(x, faces)
    vertex_normals = normals_at_vertices(x, faces)
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=1), 1e-300)[:, None]
    heights = boundary.heights(x)
    moved = x
    for _ in range(4):
        slope = boundary.slopes(moved)
        # A step of Newton's method within the tangent plane; at most about 1000 times the height,
        # where the tangent plane is nearly parallel to the boundary.
        tangential = slope - (slope * vertex_normals).sum(axis=1)[:, None] * vertex_normals
        squared_length = np.maximum((tangential * tangential).sum(axis=1), 1e-3)
        moved = moved - (boundary.heights(moved) / squared_length)[:, None] * tangential
    is_snapped = np.linalg.norm(moved - x, axis=1) < _SNAP_DISTANCE * shortest_edge
    # The steps must have converged.
    is_snapped &= np.abs(boundary.heights(moved)) <= 1e-9 * shortest_edge
    is_snapped[np.unique(boundary_edges(faces))] = False
    return np.where(is_snapped[:, None], moved, x), np.where(is_snapped, 0.0, heights)


def _cut(surface: TriangleMesh, boundary: _ClipBoundary) -> TriangleMesh:
    """The part of a surface on the inner side of the plane or sphere `boundary`. Edges are cut
    where they meet it, and the faces there are divided into triangles."""
    faces = surface.faces
    if not len(faces):
        return surface
    vertices, h = _snap_to_boundary(surface, boundary)
    # h is the signed distance of each vertex: inside if negative, on the boundary if 0.
    h = np.where(np.abs(h) <= _ON_BOUNDARY * float(np.ptp(vertices, axis=0).max()), 0.0, h)
    is_out = (h > 0)[faces]
    # Faces on the boundary with no corner inside are left out.
    is_kept = (h < 0)[faces].any(axis=1)
    mixed = is_kept & is_out.any(axis=1)
    edges = np.concatenate([faces[mixed][:, [k, (k + 1) % 3]] for k in range(3)])
    # Edges with one end inside and the other outside; a product of different signs is negative.
    crossed = edges[h[edges[:, 0]] * h[edges[:, 1]] < 0]
    keys = np.unique(edge_keys(crossed, len(vertices)))
    a, b = keys // len(vertices), keys % len(vertices)
    # The distance from a plane is linear along the edge.
    fraction = (h[a] / (h[a] - h[b]))[:, None]
    points = vertices[a] + fraction * (vertices[b] - vertices[a])
    if boundary.radius is not None:
        points = _sphere_cuts(vertices[a], vertices[b], boundary.center, boundary.radius)
    first_new = len(vertices)

    def crossing(i: IntArray, j: IntArray) -> IntArray:
        """(k,) the indices of the vertices at which the edges from vertices i to j, both (k,), meet
        the plane or sphere: i itself if it lies on it, else the new vertex on the edge."""
        index = np.searchsorted(keys, edge_keys(np.column_stack([i, j]), len(vertices)))
        return np.where(h[i] == 0, i, first_new + index)

    pieces = [faces[is_kept & ~is_out.any(axis=1)]]
    rows = faces[mixed]
    # How many corners of each face are outside: one or two.
    number = is_out[mixed].sum(axis=1)
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        tri = rows[(number == 1) & is_out[mixed][:, k]][:, order]  # the first corner is outside
        # Two corners inside: the part is a quadrilateral, two triangles.
        p, q = (crossing(tri[:, 1], tri[:, 0]), crossing(tri[:, 2], tri[:, 0]))
        pieces += [np.stack([tri[:, 1], tri[:, 2], p], axis=1), np.stack([tri[:, 2], q, p], axis=1)]
        tip = rows[(number == 2) & ~is_out[mixed][:, k]][:, order]  # the first corner is inside
        pieces.append(
            np.stack([tip[:, 0], crossing(tip[:, 0], tip[:, 1]), crossing(tip[:, 0], tip[:, 2])], 1)
        )
    new = np.concatenate(pieces)
    # Where a corner lies on the boundary, two corners of a piece may be the same.
    is_proper = (new != np.roll(new, 1, axis=1)).all(axis=1)
    return TriangleMesh.without_unused_vertices(np.concatenate([vertices, points]), new[is_proper])


def _sphere_cuts(a: FloatArray, b: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    """The points (n, 3) where segments from `a` to `b`, both (n, 3), pass through a sphere. One end
    of each segment is inside of the sphere, the other end outside.

    Proof. Relative to the center, the point is o + t d, with o the inner end and d the vector from
    it to the outer end. |o + t d| = radius means t^2 d.d + 2 t o.d = room, with room = radius^2 -
    o.o. Its solution t >= 0 is room / (o.d + sqrt((o.d)^2 + d.d room)).
    """
    # The inner end is the one nearer to the center.
    is_a_in = np.linalg.norm(a - center, axis=1) < np.linalg.norm(b - center, axis=1)
    start, end = np.where(is_a_in[:, None], a, b), np.where(is_a_in[:, None], b, a)
    o, d = start - center, end - start
    d_squared, o_dot_d = ((d * d).sum(axis=1), (o * d).sum(axis=1))
    room = np.maximum(radius**2 - (o * o).sum(axis=1), 0)
    fraction = room / (o_dot_d + np.sqrt(o_dot_d * o_dot_d + d_squared * room))
    return start + fraction[:, None] * d
