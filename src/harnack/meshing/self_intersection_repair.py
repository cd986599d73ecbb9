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
_MAX_CROSSING, _MAX_NEIGHBORHOOD = 400, 5_000
# The largest number of changes in one place, and the number of attempts for each.
_MAX_CHANGES, _MAX_ATTEMPTS = 40, 80
# New triangles with less than this fraction of the area that they cover may face backwards.
_NO_AREA = 1e-4


def resolve_self_intersections(surface: TriangleMesh, length: float) -> TriangleMesh:
    """A closed surface, mended so that none of its triangles pass through each other
    (`resolve_local_intersections`). It is returned unchanged if none do.

    length: how far one change may move the surface.

    Raises:
        MeshingError: vertices are not finite.
        SelfIntersectionError: some triangles still cross.
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
    """Contract and flip edges near crossing triangles, so that fewer cross.

    crossing: the indices of all faces that cross others (`intersecting_faces`).
    length: how far one change may move the surface. Vertices are removed or stay where they are.

    Returns:
        The changed closed surface, and the number of triangles that still cross.
    """
    if not 0 < len(crossing) <= _MAX_CROSSING or length <= 0:
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
    """Separate neighborhoods of crossing faces.

    A neighborhood grows in three steps: the faces that share a corner with crossing faces (the near
    faces); the faces that share a corner with those; and all faces whose bounding boxes meet the
    bounding box of the result. Neighborhoods with a face in common are merged.

    Yields: The indices of the faces of a neighborhood, and the vertices that may be removed: those
        of near faces. Faces that replace removed ones lie within the bounding box, so they cross no
        face outside of the neighborhood."""
    import scipy.sparse  # imported here: it takes half a second
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    corner = vertices[faces]
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    near = _faces_at_corners(faces, faces[crossing])
    second_ring = _faces_at_corners(faces, faces[near])
    pairs = half_edges(faces[second_ring])
    adjacency = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
    part = csgraph.connected_components(adjacency, directed=False)[1]
    neighborhoods: list[IntArray] = []
    for group in np.unique(part[faces[second_ring, 0]]):
        rows = second_ring[part[faces[second_ring, 0]] == group]
        low, high = lower[rows].min(axis=0), upper[rows].max(axis=0)
        members = np.flatnonzero((lower <= high).all(axis=1) & (upper >= low).all(axis=1))
        for k in reversed(range(len(neighborhoods))):
            if len(np.intersect1d(members, neighborhoods[k])):
                members = np.union1d(members, neighborhoods.pop(k))
        neighborhoods.append(members)
    for rows in neighborhoods:
        yield rows, np.unique(faces[near[np.isin(near, rows)]])


def _faces_at_corners(faces: IntArray, targets: IntArray) -> IntArray:
    """The indices of the faces that have a corner in common with the faces `targets` (k, 3)."""
    is_corner = np.zeros(int(faces.max()) + 1, np.bool_)
    is_corner[targets] = True
    return np.flatnonzero(is_corner[faces].any(axis=1))


@dataclass(frozen=True)
class _Neighborhood:
    """Some faces of a mesh, with vertices numbered anew.

    vertices: (n, 3). faces: (m, 3).
    is_movable: (n,) the vertices all of whose faces are in the neighborhood; these may be removed.
    mesh_vertices: (n,) the index of each vertex in the mesh."""

    vertices: FloatArray
    faces: IntArray
    is_movable: BoolArray
    mesh_vertices: IntArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray, movable: IntArray) -> _Neighborhood:
        """The neighborhood of `faces`, given by vertices of the mesh. movable: the vertices that
        may be removed."""
        names, index = np.unique(faces, return_inverse=True)
        return cls(vertices[names], index.reshape(-1, 3), np.isin(names, movable), names)

    def crossing(self) -> IntArray:
        """The indices of faces that pass through others."""
        return intersecting_faces(self.vertices, self.faces)

    def around(self, vertex: int) -> IntArray:
        """The indices of the faces at a vertex."""
        return np.flatnonzero((self.faces == vertex).any(axis=1))

    def neighbors(self, vertex: int) -> set[int]:
        """The vertices that share an edge with a vertex."""
        return set(self.faces[self.around(vertex)].ravel().tolist()) - {vertex}

    def with_faces(self, gone: IntArray, new: IntArray) -> _Neighborhood:
        """The neighborhood with the faces `gone` (indices) replaced by `new` (k, 3)."""
        return dataclasses.replace(
            self, faces=np.concatenate([np.delete(self.faces, gone, axis=0), new])
        )

    def collapse_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """Move vertex a to its neighbor b. Returns the indices of the faces that are removed, and
        the faces that replace them; None if sheets would touch, or if the vertices may not be
        removed."""
        if not (self.is_movable[a] and self.is_movable[b]):
            return None
        if len(self.neighbors(a) & self.neighbors(b)) != 2:
            return None
        removed = self.around(a)
        new = np.where(self.faces[removed] == a, b, self.faces[removed])
        return removed, new[(new != np.roll(new, 1, axis=1)).all(axis=1)]

    def flip_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """Replace the edge between a and b by one between the corners opposite to it. Returns the
        indices of the two faces that are removed, and the two that replace them; None if there
        already is such an edge, or if vertices may not be moved."""
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
    """Change edges of a neighborhood, one after the other, as long as that lets fewer faces cross.

    Returns:
        The faces, given by vertices of the mesh, and the number of those that still cross.
    """
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
    """The neighborhood after one change that lets fewer faces cross, and the indices of those that
    still cross; None if no change does.

    crossing: the indices of the faces that cross now.

    Edges of crossing faces are tried first, then all edges at their corners; of each, the changes
    that move the surface least come first."""
    for rows in (crossing, _faces_at_corners(patch.faces, patch.faces[crossing])):
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
    """The possible changes of the edges of the faces `rows` that move the surface by at most
    `length`.

    Yields: How far a change moves the surface; the indices of the faces that it removes; and the
        faces that replace them."""
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
    """Whether faces `rows` may be replaced by the faces `new` (k, 3).

    No new face, except slivers, may face against the mean normal of the old faces. And the volume
    between new and old faces may be at most what the old ones would sweep if they moved by
    `length`. That a moved vertex is near the new faces would not be enough: it tells nothing about
    old faces that are folded, as at a thin spike."""
    before, after = patch.vertices[patch.faces[rows]], patch.vertices[new]
    old, new_area = area_normals(before), area_normals(after)
    mean = old.sum(axis=0)
    total = float(row_norms(old).sum())
    origin = before[0, 0]
    volume = (
        row_dots(after[:, 0] - origin, new_area).sum() - row_dots(before[:, 0] - origin, old).sum()
    )
    if abs(float(volume)) / 6 > length * total / 2:
        return False
    return bool(((new_area @ mean > 0) | (row_norms(new_area) <= _NO_AREA * total)).all())


def _line_distance(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> float:
    """The distance between the line through a and b and the line through c and d; inf for parallel
    lines."""
    across = np.cross(b - a, d - c)
    size = float(np.linalg.norm(across))
    return abs(float(across @ (c - a))) / size if size > 0 else np.inf
