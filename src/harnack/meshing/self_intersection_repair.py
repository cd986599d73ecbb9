"""The local repair of closed meshes of which a few triangles intersect each other ("crossing
faces"). It contracts edges (an end of the edge is merged into the other) and flips edges (the edge
between two triangles becomes the other diagonal of their quadrilateral). A mesh is changed in
"neighborhoods", small groups of faces around the crossing ones.

When solids are cut along each other, the new corners are rounded. When triangles in a plane are
merged, slivers without an area remain. In both cases some triangles intersect their neighbors by
about a rounding error. Most of these intersections vanish if an edge near them is contracted or
flipped. Such changes are tried one after the other, and the triangles around each are tested
exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    area_normals,
    distance_from_triangles,
    edge_keys,
    half_edges,
    has_distinct_corners,
    row_dots,
    row_norms,
    sorted_unique,
)
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.checks import check_no_self_intersection
from harnack.meshing.meshing_errors import SelfIntersectionError
from harnack.meshing.self_intersection import intersecting_pairs
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["resolve_local_intersections", "resolve_self_intersections"]

# If there are more crossing triangles than this, or if their neighborhood is larger, they are no
# slivers.
_MAX_CROSSING, _MAX_NEIGHBORHOOD = 400, 5_000
# The largest number of changes in one place, and the number of attempts for each.
_MAX_CHANGES, _MAX_ATTEMPTS = 40, 80
# After this many changes in one place, it is given up if all changes that are left would not be
# enough even if each removed this factor times as many crossings as those so far: there the surface
# crosses itself, and no slivers do.
_CHANGES_BEFORE_FORECAST, _FORECAST_FACTOR = 5, 2
# New triangles with less than this fraction of the area that they cover may face backwards.
_NO_AREA = 1e-4


def resolve_self_intersections(surface: TriangleMesh, length: float) -> TriangleMesh:
    """Mend a closed surface so that no two of its triangles pass through each other, by contracting
    and flipping edges (`resolve_local_intersections`). Returns the given surface if none do.

    length: the largest distance by which one change may move the surface.

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
    length: the largest distance by which one change may move the surface. Vertices are removed or
        stay where they are.

    Nothing is changed if more than 400 faces cross. Neighborhoods of more than 5000 faces stay as
    they are.

    Returns:
        The changed closed surface, and the number of triangles that still cross.
    """
    if not 0 < len(crossing) <= _MAX_CROSSING or length <= 0:
        return surface, len(crossing)
    vertices, faces = surface.vertices, surface.faces
    is_gone, new_faces, crossing_count = np.zeros(len(faces), np.bool_), [faces[:0]], 0
    for neighborhood_rows, movable in _regions(vertices, faces, crossing):
        # The faces of a neighborhood are replaced by what becomes of them.
        is_gone[neighborhood_rows] = True
        if len(neighborhood_rows) > _MAX_NEIGHBORHOOD:
            new_faces.append(faces[neighborhood_rows])
            crossing_count += int(np.isin(crossing, neighborhood_rows).sum())
            continue
        changed_faces, count = _reduce_crossings(
            _Neighborhood.of(vertices, faces[neighborhood_rows], movable), length
        )
        new_faces.append(changed_faces)
        crossing_count += count
    return TriangleMesh.without_unused_vertices(
        vertices, np.concatenate([faces[~is_gone], *new_faces])
    ), crossing_count


def _regions(
    vertices: FloatArray, faces: IntArray, crossing: IntArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Divide the surroundings of crossing faces into neighborhoods that have no face in common.

    A neighborhood grows in three steps. It begins with the near faces, which share a corner with
    crossing faces. Then come the faces that share a corner with near faces; and then all faces
    whose bounding boxes meet the bounding box of the faces so far. Neighborhoods with a face in
    common are merged.

    crossing: the indices of the crossing faces.

    Yields: For each neighborhood the indices of its faces; and the indices of the vertices that may
    be removed, which are the corners of near faces. If only these are removed, the new faces lie
    within the bounding box, so they cross no face outside of the neighborhood."""
    corner = vertices[faces]
    lower, upper = corner.min(axis=1), corner.max(axis=1)
    # Two rings of faces around the crossing ones. Each connected part begins a neighborhood.
    near = _faces_at_corners(faces, faces[crossing])
    second_ring = _faces_at_corners(faces, faces[near])
    component_of_vertex = connected_groups(half_edges(faces[second_ring]), len(vertices))
    neighborhoods: list[IntArray] = []
    for component in np.unique(component_of_vertex[faces[second_ring, 0]]):
        rows = second_ring[component_of_vertex[faces[second_ring, 0]] == component]
        box_lower, box_upper = lower[rows].min(axis=0), upper[rows].max(axis=0)
        # All faces whose boxes meet the box of the part.
        face_rows = np.flatnonzero(
            (lower <= box_upper).all(axis=1) & (upper >= box_lower).all(axis=1)
        )
        for k in reversed(range(len(neighborhoods))):
            if len(np.intersect1d(face_rows, neighborhoods[k])):
                face_rows = np.union1d(face_rows, neighborhoods.pop(k))
        neighborhoods.append(face_rows)
    for rows in neighborhoods:
        yield rows, np.unique(faces[near[np.isin(near, rows)]])


def _faces_at_corners(faces: IntArray, targets: IntArray) -> IntArray:
    """The indices of the faces that have a corner in common with the faces `targets` (k, 3)."""
    is_corner = np.zeros(int(faces.max()) + 1, np.bool_)
    is_corner[targets] = True
    return np.flatnonzero(is_corner[faces].any(axis=1))


@dataclass(frozen=True)
class _Neighborhood:
    """A few faces of a mesh that are changed together, with their vertices numbered from 0. Their
    edges are contracted and flipped without a change of the rest of the mesh. Only vertices of the
    mask `is_movable`, all of whose faces belong to the neighborhood, may be removed.

    vertices: (n, 3). faces: (m, 3).
    is_movable: (n,) the mask of the vertices that may be removed. All faces at such a vertex belong
        to the neighborhood.
    mesh_vertices: (n,) the index of each vertex in the mesh.
    shifts: for changes that were tried, by the faces that they remove and add, how far they move
        the surface (a length). It is shared by all neighborhoods with the same vertices."""

    vertices: FloatArray
    faces: IntArray
    is_movable: BoolArray
    mesh_vertices: IntArray
    shifts: dict[bytes, float] = dataclasses.field(default_factory=dict[bytes, float])

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray, movable: IntArray) -> _Neighborhood:
        """The neighborhood that consists of `faces` (m, 3) of a mesh with `vertices` (n, 3).
        movable: the indices of the mesh's vertices that may be removed."""
        mesh_vertices, renumbered_faces = np.unique(faces, return_inverse=True)
        return cls(
            vertices[mesh_vertices],
            renumbered_faces.reshape(-1, 3),
            np.isin(mesh_vertices, movable),
            mesh_vertices,
        )

    @cached_property
    def _faces_at_vertices(self) -> tuple[IntArray, IntArray]:
        """Two arrays: the indices of faces, sorted by vertex, each face once for each of its
        corners; and for each vertex the position (n + 1,) at which its faces begin."""
        corners = self.faces.ravel()
        order = np.argsort(corners, kind="stable")
        starts = np.searchsorted(corners[order], np.arange(len(self.vertices) + 1))
        return order // 3, starts

    def crossing_pairs(self) -> IntArray:
        """The pairs (k, 2) of indices of faces that pass through each other."""
        return intersecting_pairs(self.vertices, self.faces)

    def around(self, vertex: int) -> IntArray:
        """The indices of the faces at a vertex."""
        rows, starts = self._faces_at_vertices
        return rows[starts[vertex] : starts[vertex + 1]]

    def neighbors(self, vertex: int) -> set[int]:
        """The vertices that share an edge with a vertex."""
        return set(self.faces[self.around(vertex)].ravel().tolist()) - {vertex}

    def with_faces(self, gone: IntArray, new: IntArray) -> _Neighborhood:
        """A copy of the neighborhood in which `new` faces (k, 3) replace the faces with the indices
        `gone`."""
        return dataclasses.replace(
            self, faces=np.concatenate([np.delete(self.faces, gone, axis=0), new])
        )

    def collapse_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """Contract the edge between the vertices a and b, by merging a into b. Returns the indices
        of the faces around a, and the faces (k, 3) that replace them. Returns None if sheets of the
        surface would touch, or if one of the two vertices may not be changed."""
        if not (self.is_movable[a] and self.is_movable[b]):
            return None
        # Only the two corners opposite to the edge may be neighbors of both ends.
        if len(self.neighbors(a) & self.neighbors(b)) != 2:
            return None
        old_rows = self.around(a)
        new_faces = np.where(self.faces[old_rows] == a, b, self.faces[old_rows])
        # Faces of which two corners are now the same vanish.
        return old_rows, new_faces[has_distinct_corners(new_faces)]

    def flip_edge(self, a: int, b: int) -> tuple[IntArray, IntArray] | None:
        """Replace the edge between the vertices a and b by the edge between the two corners
        opposite to it. Returns the indices of the two faces at the old edge, and the two faces (2,
        3) that replace them. Returns None if the new edge exists already, or if a vertex may not be
        changed."""
        if not (self.is_movable[a] and self.is_movable[b]):
            return None
        old_rows = np.intersect1d(self.around(a), self.around(b))
        if len(old_rows) != 2:
            return None
        first, second = (self.faces[row].tolist() for row in old_rows)
        # The first face is the one in which b follows a.
        if first[(first.index(a) + 1) % 3] != b:
            first, second = second, first
        (c,), (d,) = set(first) - {a, b}, set(second) - {a, b}
        if c == d or d in self.neighbors(c):
            return None
        if not (self.is_movable[c] or self.is_movable[d]):
            return None
        return old_rows, np.array([[a, d, c], [d, b, c]])


def _reduce_crossings(patch: _Neighborhood, length: float) -> tuple[IntArray, int]:
    """Contract and flip edges of the neighborhood `patch`, one after the other, as long as each
    change reduces the number of crossing faces. Give up early where the changes allowed are far
    too few.

    length: the largest distance by which one change may move the surface.

    Returns:
        The faces (m, 3), with vertices of the mesh; and the number of faces that still cross.
    """
    pairs = patch.crossing_pairs()
    first_count = len(np.unique(pairs))
    for change_count in range(_MAX_CHANGES):
        if change_count >= _CHANGES_BEFORE_FORECAST:
            removed = (first_count - len(np.unique(pairs))) / change_count
            changes_left = _MAX_CHANGES - change_count
            if len(np.unique(pairs)) > _FORECAST_FACTOR * removed * changes_left:
                break
        better = _best_change(patch, pairs, length) if len(pairs) else None
        if better is None:
            break
        patch, pairs = better
    return patch.mesh_vertices[patch.faces], len(np.unique(pairs))


def _best_change(
    patch: _Neighborhood, pairs: IntArray, length: float
) -> tuple[_Neighborhood, IntArray] | None:
    """Find one change of an edge in the neighborhood `patch` that reduces the number of crossing
    faces. Returns the neighborhood after it, and the pairs of faces that still cross; None if no
    change does so.

    pairs: (k, 2) the indices of the pairs of faces that cross now.
    length: the largest distance by which the change may move the surface.

    Edges of crossing faces are tried first, then all edges of the faces that share a corner with
    them. In both groups, the changes that move the surface least are tried first, up to 80 of them.
    """
    crossing = np.unique(pairs)
    for candidate_rows in (crossing, _faces_at_corners(patch.faces, patch.faces[crossing])):
        for _, old_rows, new_faces in sorted(
            _changes(patch, candidate_rows, length), key=lambda change: change[0]
        )[:_MAX_ATTEMPTS]:
            changed = patch.with_faces(old_rows, new_faces)
            still_crossing = _pairs_after(changed, pairs, old_rows, len(new_faces))
            if len(np.unique(still_crossing)) < len(crossing):
                return changed, still_crossing
    return None


def _pairs_after(
    changed: _Neighborhood, pairs: IntArray, gone: IntArray, new_count: int
) -> IntArray:
    """The pairs (k, 2) of faces that cross after a change of a neighborhood. Only the new faces are
    tested: whether two other faces cross is as before.

    changed: the neighborhood after the change, with the new faces last (`with_faces`).
    pairs: (k, 2) the pairs that crossed before, in the numbers of the faces then.
    gone: the indices, then, of the faces that the change removed.
    new_count: the number of new faces.
    """
    kept = pairs[~np.isin(pairs, gone).any(axis=1)]
    is_new = np.arange(len(changed.faces)) >= len(changed.faces) - new_count
    return np.concatenate(
        [
            kept - np.searchsorted(np.sort(gone), kept),
            intersecting_pairs(changed.vertices, changed.faces, is_new),
        ]
    )


def _changes(
    patch: _Neighborhood, rows: IntArray, length: float
) -> Iterator[tuple[float, IntArray, IntArray]]:
    """All contractions and flips that move the surface by at most `length`, of the edges of those
    faces of the neighborhood `patch` that have the indices `rows`.

    Yields: For each change, how far it moves the surface, a length; the indices of the faces that
    it removes; and the faces (k, 3) that replace them.
    """
    count = len(patch.vertices)
    # A key is the number a * count + b for the edge between the vertices a < b.
    keys = sorted_unique(edge_keys(half_edges(patch.faces[rows]), count))
    for a, b in np.stack(np.divmod(keys, count), axis=1).tolist():
        changes = (patch.collapse_edge(a, b), patch.collapse_edge(b, a), patch.flip_edge(a, b))
        for change, removed in zip(changes, (a, b, None), strict=True):
            if change is None:
                continue
            key = patch.faces[change[0]].tobytes() + change[1].tobytes()
            if key not in patch.shifts:
                patch.shifts[key] = _shift_of(patch, *change, (a, b), removed, length)
            if patch.shifts[key] <= length:
                yield patch.shifts[key], *change


def _shift_of(
    patch: _Neighborhood,
    old_rows: IntArray,
    new_faces: IntArray,
    edge: tuple[int, int],
    removed: int | None,
    length: float,
) -> float:
    """How far a change of an edge of the neighborhood `patch` moves the surface, a length; infinite
    if the change folds it or is large (`_is_small_change`).

    old_rows: the indices of the faces that are replaced.
    new_faces: (k, 3) the faces that replace them.
    edge: the vertices of the edge.
    removed: the end of the edge that a contraction removes; None for a flip.
    length: the largest distance by which the change may move the surface.
    """
    if not _is_small_change(patch, old_rows, new_faces, length):
        return np.inf
    if removed is not None:
        # The surface moves by the distance of the removed vertex from the new faces.
        return distance_from_triangles(patch.vertices[removed], patch.vertices[new_faces])
    # The surface moves by the distance between the old and the new edge, which joins c and d. The
    # first new face is (a, d, c).
    a, b, c, d = (patch.vertices[k] for k in (*edge, new_faces[0, 2], new_faces[0, 1]))
    return _line_distance(a, b, c, d)


def _is_small_change(
    patch: _Neighborhood, old_rows: IntArray, new_faces: IntArray, max_shift: float
) -> bool:
    """Whether new faces may replace some faces of the neighborhood `patch`, without a fold and
    without a large change of the surface.

    old_rows: the indices of the faces that are replaced.
    new_faces: (k, 3) the faces that replace them, with vertices of the neighborhood.
    max_shift: a length.

    Two conditions must hold. The normal of each new face, slivers excepted, is less than 90 degrees
    from the mean normal of the old faces. And the volume between old and new faces is at most
    `max_shift` times the area of the old faces. (The distance of a removed vertex from the new
    faces is not used instead, as it says nothing about old faces that are folded, as at a thin
    spike.)
    """
    old_corners, new_corners = patch.vertices[patch.faces[old_rows]], patch.vertices[new_faces]
    old_normals, new_normals = area_normals(old_corners), area_normals(new_corners)
    normal_sum = old_normals.sum(axis=0)
    double_area = float(row_norms(old_normals).sum())
    origin = old_corners[0, 0]
    # Six times the volume between both, as a sum of tetrahedra with the apex `origin`.
    volume = (
        row_dots(new_corners[:, 0] - origin, new_normals).sum()
        - row_dots(old_corners[:, 0] - origin, old_normals).sum()
    )
    if abs(float(volume)) / 6 > max_shift * double_area / 2:
        return False
    return bool(
        ((new_normals @ normal_sum > 0) | (row_norms(new_normals) <= _NO_AREA * double_area)).all()
    )


def _line_distance(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> float:
    """The distance between the line through a and b and the line through c and d; inf for parallel
    lines."""
    across = np.cross(b - a, d - c)
    size = float(np.linalg.norm(across))
    return abs(float(across @ (c - a))) / size if size > 0 else np.inf
