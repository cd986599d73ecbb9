"""Selects components of meshes (the largest one, or the largest body with its cavities), and cuts
open surfaces at planes and spheres (`clip_to_volume`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Volume, VolumeIntersection
from harnack.geometry.meshes import solid_angles
from harnack.meshing.checks import MeshingError
from harnack.meshing.edges import IntArray, area_normals, boundary_edges, edge_keys, row_dots
from harnack.meshing.lattice_meshing import TriangleMesh

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
    """The connected component with the largest area."""
    part = _component_of_faces(surface)
    areas = np.bincount(part, np.linalg.norm(area_normals(surface.vertices[surface.faces]), axis=1))
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[part == areas.argmax()]
    )


def largest_body(surface: TriangleMesh) -> TriangleMesh:
    """The body with the largest volume of a closed surface: an outer shell and the shells of its
    cavities, which are turned inwards, so that their volume is negative.

    Proof. Shells are closed, connected and do not meet. Let the surface bound a set. A shell that
    is turned inwards has the set around it, and that part of the set has an outer shell. Of the
    shells that hold the cavity, this is the innermost and smallest one: another shell in between
    would be outside of the part, with nothing of the set between both. Whether a shell holds a
    point is told by its winding number there, which is an integer.

    Raises:
        MeshingError: a cavity that lies in no shell.
    """
    shells = Shells.of(surface)
    bodies = shells.volumes.copy()
    owner = np.arange(len(bodies))
    outer = np.flatnonzero(shells.volumes > 0)
    outer = outer[np.argsort(shells.volumes[outer])]
    for cavity in np.flatnonzero(shells.volumes <= 0):
        holds = (shell for shell in outer if shells.winding_number(shell, cavity) > 0.5)
        if (holder := next(holds, None)) is None:
            raise MeshingError("a part of the mesh is inside out: choose a smaller `cell_size`")
        owner[cavity] = holder
        bodies[holder] += shells.volumes[cavity]
    largest = outer[bodies[outer].argmax()] if len(outer) else -1
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[owner[shells.component_of_face] == largest]
    )


def drop_degenerate_components(surface: TriangleMesh) -> TriangleMesh:
    """Remove the connected components of a closed surface that are only rounding error, such as the
    remainder of a solid minus itself."""
    x, faces = surface.vertices, surface.faces
    if not len(faces):
        return surface
    part = _component_of_faces(surface)
    count = np.bincount(part)
    corner = x[faces]
    middle = (
        np.stack([np.bincount(part, c) for c in corner.mean(axis=1).T], axis=1) / count[:, None]
    )
    corner = corner - middle[part][:, None]
    normal = area_normals(corner)
    # Six times the volume and twice the area.
    volume = np.abs(np.bincount(part, (corner[:, 0] * normal).sum(axis=1)))
    area = np.bincount(part, np.linalg.norm(normal, axis=1))
    is_film = 2 * volume <= 3 * _DEGENERATE_THICKNESS * float(np.abs(x).max()) * area
    if not is_film.any():
        return surface
    rest = faces[~is_film[part]]
    return TriangleMesh.without_unused_vertices(x, rest) if len(rest) else TriangleMesh(x[:0], rest)


def component_facts(surface: TriangleMesh) -> list[dict[str, Any]]:
    """A dictionary for each connected component of a closed surface, largest first: faces, the
    number of its faces; volume, which is negative for a cavity; center, of its bounding box."""
    shells, facts = Shells.of(surface), list[dict[str, Any]]()
    counts = np.bincount(shells.component_of_face)
    for k in np.argsort(-np.abs(shells.volumes), kind="stable"):
        center = 0.5 * (shells.lower[k] + shells.upper[k])
        volume = float(shells.volumes[k])
        facts.append({"faces": int(counts[k]), "volume": volume, "center": center.tolist()})
    return facts


def faces_to_flip(surface: TriangleMesh) -> npt.NDArray[np.bool_]:
    """(m,) which faces of a closed surface to turn over so that no component is inside out: those
    of components of negative volume that lie in no other component, and so are no cavities."""
    shells = Shells.of(surface)
    inwards = (shells.volumes < 0) & (shells.nesting_depths() == 0)
    return inwards[shells.component_of_face]


@dataclass(frozen=True)
class Shells:
    """The connected components of a closed surface.

    component_of_face: (m,) the component that each face belongs to.
    volumes: (k,) signed volumes of components, negative for those turned inwards.
    lower, upper: (k, 3) their bounding boxes.
    corners: (m, 3, 3) of the faces.
    """

    component_of_face: IntArray
    volumes: FloatArray
    lower: FloatArray
    upper: FloatArray
    corners: FloatArray

    @classmethod
    def of(cls, surface: TriangleMesh) -> Shells:
        number = np.unique(_component_of_faces(surface), return_inverse=True)[1]
        corners = surface.vertices[surface.faces]
        away = corners[:, 0] - surface.vertices[surface.faces].mean(axis=(0, 1))
        volumes = (
            np.bincount(number, row_dots(area_normals(surface.vertices[surface.faces]), away)) / 6
        )
        lower, upper = np.full((len(volumes), 3), np.inf), np.full((len(volumes), 3), -np.inf)
        np.minimum.at(lower, number, corners.min(axis=1))
        np.maximum.at(upper, number, corners.max(axis=1))
        return cls(number, volumes, lower, upper, corners)

    def winding_number(self, outer: Any, inner: Any) -> float:
        """The winding number of the component `outer` at a point of the component `inner`."""
        point = self.corners[np.argmax(self.component_of_face == inner)].mean(axis=0)
        return winding_around(self.corners[self.component_of_face == outer], point)

    def nesting_depths(self) -> IntArray:
        """(k,) how often all other components wind around each component, at a point of it: more
        than 0 where it is in their material, if no two meet."""
        depth = np.zeros(len(self.volumes), np.int64)
        for k in range(len(depth)) if len(depth) > 1 else ():
            point = self.corners[np.argmax(self.component_of_face == k)].mean(axis=0)
            in_box = ((self.lower < point) & (point < self.upper)).all(axis=1)
            in_box[k] = False
            candidates = np.flatnonzero(in_box)
            depth[k] = round(sum(self.winding_number(j, k) for j in candidates))
        return depth

    def bound(self) -> npt.NDArray[np.bool_]:
        """(m,) which faces bound the points that all components together wind around at least once,
        if no two meet: across a component the winding number changes by one from its value outside,
        so that these components are turned outwards and have a winding number of 0 around them, or
        inwards and have a winding number of 1."""
        does = self.nesting_depths() == np.where(self.volumes > 0, 0, 1)
        return does[self.component_of_face]


def _component_of_faces(surface: TriangleMesh) -> IntArray:
    """(m,) the number of the connected component of each face."""
    import scipy.sparse  # imported here: it takes half a second
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    faces, n = surface.faces, len(surface.vertices)
    rows, columns = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return np.asarray(csgraph.connected_components(joined, directed=False)[1])[faces[:, 0]]


def winding_around(corner: FloatArray, point: FloatArray) -> float:
    """The winding number of triangles (m, 3, 3) around a point."""
    return float(solid_angles(corner, point).sum()) / (4 * math.pi)


# Surfaces cut by volumes.

# Vertices this near to a boundary, relative to the size, count as on it.
_ON_BOUNDARY = 1e-9
# Vertices this near, relative to their shortest edge, are moved onto it: otherwise slivers remain.
_SNAPPED = 0.25


@dataclass(frozen=True)
class _ClipBoundary:
    """One side of a volume's boundary: a plane normal.x = offset, or a sphere."""

    center: FloatArray
    normal: FloatArray
    radius: float | None

    def heights(self, x: FloatArray) -> FloatArray:
        """(n,) signed distances of points (n, 3) from the boundary, negative inside."""
        if self.radius is None:
            return (x - self.center) @ self.normal
        return np.linalg.norm(x - self.center, axis=1) - self.radius

    def slopes(self, x: FloatArray) -> FloatArray:
        """(n, 3) the gradients of these distances."""
        if self.radius is None:
            return np.broadcast_to(self.normal, x.shape)
        away = x - self.center
        return away / np.maximum(np.linalg.norm(away, axis=1), 1e-300)[:, None]


def clip_to_volume(surface: TriangleMesh, volume: Volume) -> TriangleMesh:
    """The part of a surface in a volume. Its new boundary lies on planes exactly, and on chords of
    spheres; vertices inside keep their order and come first.

    Raises:
        MeshingError: another kind of volume.
    """
    if isinstance(volume, VolumeIntersection):
        for operand in volume.volumes:
            surface = clip_to_volume(surface, operand)
        return surface
    if isinstance(volume, Ball):
        return _cut_surface(
            surface, _ClipBoundary(np.array(volume.center), np.zeros(3), volume.radius)
        )
    if not isinstance(volume, Box | HalfSpace | ConvexHull):
        raise MeshingError(f"a {type(volume).__name__} cannot cut a mesh: give a box or a ball")
    for row in volume.planes():
        surface = _cut_surface(surface, _ClipBoundary(row[:3] * row[3], row[:3], None))
    if isinstance(volume, Box):
        return TriangleMesh(_snap_to_box(surface.vertices, volume), surface.faces)
    return surface


def _snap_to_box(vertices: FloatArray, box: Box) -> FloatArray:
    """The vertices, with those within rounding of a box's faces put onto them."""
    for end in box.bounds():
        near = np.abs(vertices - end) <= _ON_BOUNDARY * (1 + np.abs(end))
        vertices = np.where(near, end, vertices)
    return vertices


def _snap_to_boundary(surface: TriangleMesh, side: _ClipBoundary) -> tuple[FloatArray, FloatArray]:
    """The vertices, and their heights. Vertices near the side are moved onto it within the
    surface's tangent plane, except those of the surface's boundary and those that would have to
    move far."""
    x, faces = surface.vertices, surface.faces
    corner = x[faces]
    edges = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).min(axis=1)
    normal = area_normals(corner)
    shortest, mean = np.full(len(x), np.inf), np.zeros_like(x)
    for k in range(3):
        np.minimum.at(shortest, faces[:, k], edges)
        np.add.at(mean, faces[:, k], normal)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    h = side.heights(x)
    moved = x
    for _ in range(4):
        slope = side.slopes(moved)
        along = slope - (slope * mean).sum(axis=1)[:, None] * mean
        square = np.maximum((along * along).sum(axis=1), 1e-3)
        moved = moved - (side.heights(moved) / square)[:, None] * along
    near = np.linalg.norm(moved - x, axis=1) < _SNAPPED * shortest
    near &= np.abs(side.heights(moved)) <= 1e-9 * shortest
    near[np.unique(boundary_edges(faces))] = False
    return np.where(near[:, None], moved, x), np.where(near, 0.0, h)


def _cut_surface(surface: TriangleMesh, side: _ClipBoundary) -> TriangleMesh:
    """The part of the surface where heights are not positive. Heights are linear along edges,
    except above a sphere."""
    faces = surface.faces
    if not len(faces):
        return surface
    vertices, h = _snap_to_boundary(surface, side)
    h = np.where(np.abs(h) <= _ON_BOUNDARY * float(np.ptp(vertices, axis=0).max()), 0.0, h)
    out = (h > 0)[faces]
    # Faces on the boundary with no corner inside are left out.
    keep = (h < 0)[faces].any(axis=1)
    mixed = keep & out.any(axis=1)
    pairs = np.concatenate([faces[mixed][:, [k, (k + 1) % 3]] for k in range(3)])
    crossing = pairs[h[pairs[:, 0]] * h[pairs[:, 1]] < 0]
    keys = np.unique(edge_keys(crossing, len(vertices)))
    a, b = keys // len(vertices), keys % len(vertices)
    fraction = (h[a] / (h[a] - h[b]))[:, None]
    points = vertices[a] + fraction * (vertices[b] - vertices[a])
    if side.radius is not None:
        points = _on_sphere(vertices[a], vertices[b], side.center, side.radius)
    first = len(vertices)

    def at(i: IntArray, j: IntArray) -> IntArray:
        """The vertex where edges from i to j meet the boundary; i itself if it lies on the
        boundary."""
        index = np.searchsorted(keys, edge_keys(np.column_stack([i, j]), len(vertices)))
        return np.where(h[i] == 0, i, first + index)

    parts = [faces[keep & ~out.any(axis=1)]]
    rows = faces[mixed]
    number = out[mixed].sum(axis=1)
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        tri = rows[(number == 1) & out[mixed][:, k]][:, order]  # a is outside
        x, y = at(tri[:, 1], tri[:, 0]), at(tri[:, 2], tri[:, 0])
        parts += [np.stack([tri[:, 1], tri[:, 2], x], axis=1), np.stack([tri[:, 2], y, x], axis=1)]
        tip = rows[(number == 2) & ~out[mixed][:, k]][:, order]  # a is inside
        parts.append(np.stack([tip[:, 0], at(tip[:, 0], tip[:, 1]), at(tip[:, 0], tip[:, 2])], 1))
    new = np.concatenate(parts)
    proper = (new != np.roll(new, 1, axis=1)).all(axis=1)
    return TriangleMesh.without_unused_vertices(np.concatenate([vertices, points]), new[proper])


def _on_sphere(a: FloatArray, b: FloatArray, center: FloatArray, radius: float) -> FloatArray:
    """The points where segments from a to b (n, 3), of which one end is inside, pass through the
    sphere."""
    inside = np.linalg.norm(a - center, axis=1) < np.linalg.norm(b - center, axis=1)
    start, end = np.where(inside[:, None], a, b), np.where(inside[:, None], b, a)
    o, d = start - center, end - start
    dd, od = (d * d).sum(axis=1), (o * d).sum(axis=1)
    room = np.maximum(radius**2 - (o * o).sum(axis=1), 0)
    fraction = room / (od + np.sqrt(od * od + dd * room))
    return start + fraction[:, None] * d
