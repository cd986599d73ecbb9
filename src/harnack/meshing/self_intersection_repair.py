"""The local repair of closed meshes a few of whose triangles intersect each other.

Where solids are cut by each other corners are rounded, and where triangles in a plane are merged
slivers without an area remain: such triangles intersect their neighbors by about a rounding error.
Contracting or flipping an edge near them repairs most of these. Edges are tried in turn, with exact
signs, on the few triangles around.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import (
    SelfIntersectionError,
    check_no_self_intersection,
    intersecting_faces,
)
from harnack.meshing.edges import (
    IntArray,
    area_normals,
    distance_from_triangles,
    edge_keys,
    half_edges,
    row_dots,
    row_norms,
    sorted_unique,
)
from harnack.meshing.lattice_meshing import TriangleMesh

__all__ = ["resolve_local_intersections", "resolve_self_intersections"]

# If there are more crossing triangles than this, or if their neighborhood is larger, they are no
# slivers.
_MAX_CROSSING_FACES, _MAX_NEIGHBORHOOD = 400, 5_000
# The largest number of changes in one place, and the number of attempts for each.
_MAX_CHANGES, _MAX_ATTEMPTS = 40, 80
# New triangles with less than this fraction of the area that they cover may face backwards.
_NOTHING = 1e-4


def resolve_self_intersections(surface: TriangleMesh, length: float) -> TriangleMesh:
    """A closed surface, mended where its triangles pass through each other
    (`resolve_local_intersections`), so that none do.

    Raises:
        MeshingError: vertices are not finite; a SelfIntersectionError if triangles still cross.
    """
    try:
        check_no_self_intersection(surface.vertices, surface.faces)
    except SelfIntersectionError as error:
        mended, crossing_count = resolve_local_intersections(surface, error.faces, length)
        if crossing_count:
            raise
        return mended
    return surface


def resolve_local_intersections(
    surface: TriangleMesh, crossing: IntArray, length: float
) -> tuple[TriangleMesh, int]:
    """A closed surface with edges contracted and flipped where triangles cross; and the number of
    triangles that still cross.

    crossing: all faces that cross others (`intersecting_faces`).
    length: how far the surface may be moved by one change; vertices stay where they are, or are
        removed.
    """
    if not 0 < len(crossing) <= _MAX_CROSSING_FACES or length <= 0:
        return surface, len(crossing)
    vertices, faces = surface.vertices, surface.faces
    is_gone, pieces, crossing_count = np.zeros(len(faces), np.bool_), [faces[:0]], 0
    for rows, movable in _regions(vertices, faces, crossing):
        is_gone[rows] = True
        if len(rows) > _MAX_NEIGHBORHOOD:
            pieces.append(faces[rows])
            crossing_count += int(np.isin(crossing, rows).sum())
            continue
        patch, count = _reduce_crossings(_Neighborhood.of(vertices, faces[rows], movable), length)
        pieces.append(patch)
        crossing_count += count
    return TriangleMesh.without_unused_vertices(
        vertices, np.concatenate([faces[~is_gone], *pieces])
    ), crossing_count


def _regions(
    vertices: FloatArray, faces: IntArray, crossing: IntArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """The faces, by index, of separate neighborhoods, and the vertices of each that may be removed.

    A neighborhood is all faces whose boxes meet that of the faces around the faces around crossing
    faces. Vertices of faces next to crossing faces may be removed: the new faces then lie within
    that box, so that they cross no others.
    """
    import scipy.sparse  # imported here: it takes half a second
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    corner = vertices[faces]
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    near = _faces_with_corners_of(faces, faces[crossing])
    second_ring = _faces_with_corners_of(faces, faces[near])
    pairs = half_edges(faces[second_ring])
    joined = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
    part = csgraph.connected_components(joined, directed=False)[1]
    boxes: list[IntArray] = []
    for label in np.unique(part[faces[second_ring, 0]]):
        rows = second_ring[part[faces[second_ring, 0]] == label]
        low, high = lower[rows].min(axis=0), upper[rows].max(axis=0)
        members = np.flatnonzero((lower <= high).all(axis=1) & (upper >= low).all(axis=1))
        for k in reversed(range(len(boxes))):
            if len(np.intersect1d(members, boxes[k])):
                members = np.union1d(members, boxes.pop(k))
        boxes.append(members)
    for rows in boxes:
        yield rows, np.unique(faces[near[np.isin(near, rows)]])


def _faces_with_corners_of(faces: IntArray, targets: IntArray) -> IntArray:
    """The indices of faces that have a corner in common with `targets`."""
    is_corner = np.zeros(int(faces.max()) + 1, np.bool_)
    is_corner[targets] = True
    return np.flatnonzero(is_corner[faces].any(axis=1))


@dataclass(frozen=True)
class _Neighborhood:
    """Faces (m, 3) of a neighborhood, between vertices (n, 3) of the mesh; is_movable: (n,) the
    vertices all of whose faces are in the neighborhood."""

    vertices: FloatArray
    faces: IntArray
    is_movable: BoolArray
    mesh_vertices: IntArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray, movable: IntArray) -> _Neighborhood:
        """The neighborhood of these faces, whose vertices `movable` may be removed."""
        names, index = np.unique(faces, return_inverse=True)
        return cls(vertices[names], index.reshape(-1, 3), np.isin(names, movable), names)

    def crossing(self) -> IntArray:
        """Faces, by index, that pass through others."""
        return intersecting_faces(self.vertices, self.faces)

    def around(self, vertex: int) -> IntArray:
        """Faces, by index, at a vertex."""
        return np.flatnonzero((self.faces == vertex).any(axis=1))

    def neighbors(self, vertex: int) -> set[int]:
        """The vertices that edges join to a vertex."""
        return set(self.faces[self.around(vertex)].ravel().tolist()) - {vertex}

    def with_faces(self, removed: IntArray, new: IntArray) -> _Neighborhood:
        """The neighborhood with the faces `removed`, by index, replaced by `new`."""
        return dataclasses.replace(
            self, faces=np.concatenate([np.delete(self.faces, removed, axis=0), new])
        )

    def collapse_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """The faces that are removed, by index, and those that replace them if a is moved to b;
        None if sheets would touch."""
        if not (self.is_movable[a] and self.is_movable[b]):
            return None
        if len(self.neighbors(a) & self.neighbors(b)) != 2:
            return None
        removed = self.around(a)
        new = np.where(self.faces[removed] == a, b, self.faces[removed])
        return removed, new[(new != np.roll(new, 1, axis=1)).all(axis=1)]

    def flip_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """The faces that are removed, by index, and those that replace them if the edge between a
        and b is flipped to join the corners opposite to it; None if there already is such an
        edge."""
        if not (self.is_movable[a] and self.is_movable[b]):
            return None
        removed = np.intersect1d(self.around(a), self.around(b))
        if len(removed) != 2:
            return None
        first, second = (self.faces[row].tolist() for row in removed)
        if first[(first.index(a) + 1) % 3] != b:
            first, second = second, first
        (c,), (d,) = set(first) - {a, b}, set(second) - {a, b}
        if c == d or d in self.neighbors(c):
            return None
        if not (self.is_movable[c] or self.is_movable[d]):
            return None
        return removed, np.array([[a, d, c], [d, b, c]])


def _reduce_crossings(patch: _Neighborhood, length: float) -> tuple[IntArray, int]:
    """The faces of a patch, by vertices of the mesh, after changes that let fewer cross; and the
    number that still cross."""
    crossing = patch.crossing()
    for _ in range(_MAX_CHANGES):
        better = _best_change(patch, crossing, length) if len(crossing) else None
        if better is None:
            break
        patch, crossing = better
    return patch.mesh_vertices[patch.faces], len(crossing)


def _best_change(
    patch: _Neighborhood, crossing: IntArray, length: float
) -> tuple[_Neighborhood, IntArray] | None:
    """The patch after one change that lets fewer faces cross, and these faces; None if no change
    does.

    Changes that move the surface least are tried first: of edges of faces that cross, then of all
    edges at their corners.
    """
    for rows in (crossing, _faces_with_corners_of(patch.faces, patch.faces[crossing])):
        for _, removed, new in sorted(_changes(patch, rows, length), key=lambda change: change[0])[
            :_MAX_ATTEMPTS
        ]:
            changed = patch.with_faces(removed, new)
            still_crossing = changed.crossing()
            if len(still_crossing) < len(crossing):
                return changed, still_crossing
    return None


def _changes(
    patch: _Neighborhood, rows: IntArray, length: float
) -> Iterator[tuple[float, IntArray, IntArray]]:
    """Changes of the edges of the faces `rows`: how far they move the surface, the faces that are
    removed, and those that replace them."""
    count = len(patch.vertices)
    keys = sorted_unique(edge_keys(half_edges(patch.faces[rows]), count))
    for a, b in np.stack(np.divmod(keys, count), axis=1).tolist():
        for source, target in ((a, b), (b, a)):
            change = patch.collapse_edge(source, target)
            if change is not None and _keeps_orientation(patch, *change, length):
                moved = distance_from_triangles(patch.vertices[source], patch.vertices[change[1]])
                if moved <= length:
                    yield moved, *change
        change = patch.flip_edge(a, b)
        if change is not None and _keeps_orientation(patch, *change, length):
            c, d = (patch.vertices[change[1][0, k]] for k in (2, 1))
            moved = _line_distance(patch.vertices[a], patch.vertices[b], c, d)
            if moved <= length:
                yield moved, *change


def _keeps_orientation(patch: _Neighborhood, rows: IntArray, new: IntArray, length: float) -> bool:
    """Whether no new face, except slivers, faces backwards relative to the mean normal of the old
    faces, and the volume between new and old faces is no more than if the old ones moved by a
    length: a vertex on the new faces tells nothing about old faces that are folded, as at a thin
    spike."""
    corner, replaced = patch.vertices[patch.faces[rows]], patch.vertices[new]
    old, after = area_normals(corner), area_normals(replaced)
    mean = old.sum(axis=0)
    total = float(row_norms(old).sum())
    origin = corner[0, 0]
    between = (
        row_dots(replaced[:, 0] - origin, after).sum() - row_dots(corner[:, 0] - origin, old).sum()
    )
    if abs(float(between)) / 6 > length * total / 2:
        return False
    return bool(((after @ mean > 0) | (row_norms(after) <= _NOTHING * total)).all())


def _line_distance(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> float:
    """The distance between the line through a and b and the line through c and d."""
    across = np.cross(b - a, d - c)
    size = float(np.linalg.norm(across))
    return abs(float(across @ (c - a))) / size if size > 0 else np.inf
