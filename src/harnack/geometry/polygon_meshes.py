"""Meshes of polygons that need not be planar: validation, measures, and a generator of examples. A
face is a closed curve through vertices, or several, such as an outline and holes. Each closed curve
is a loop, a list of vertex indices counted from 0; a corner is one entry of a loop. The positive
side of a face is the one from which the outline runs counter-clockwise and holes clockwise. Faces
need not be joined, and may cross each other."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend.validation import (
    BoolArray,
    FloatArray,
    IntArray,
    as_real_array,
    others_suffix,
)
from harnack.geometry.boundary_edges import boundary_edges, join_edges
from harnack.geometry.convex_position import is_convex_position
from harnack.geometry.flat_lists import next_in_lists
from harnack.geometry.mesh_edges import area_normals
from harnack.geometry.meshes import MAX_FACES, MeshError, checked_vertices
from harnack.geometry.neighborhoods import kd_tree

__all__ = ["PolygonFaces", "cluster_into_polygons", "validate_polygons"]

# A face counts as collinear if its corners are nearer to a line than this fraction of its size.
_COLLINEAR_TOLERANCE = 1e-9
# A turn from one edge to the next counts as a turn to the left only if its sine is at least this.
_MIN_TURN_SINE = 1e-6
# The turns of a convex polygon add up to 2 pi, within this tolerance in radians.
_REVOLUTION_TOLERANCE = 1e-6
# Faces without a convex projection are examined further, which takes 0.5 ms each, up to this
# number.
_MAX_EXAMINED_FACES = 20_000


@dataclass(frozen=True, eq=False)
class PolygonFaces:
    """Polygonal faces with any number of corners and loops, in flat arrays. A loop is a closed
    curve through vertices, a corner is one entry of a loop, and a face consists of one or more
    loops (an outline and holes). There are n vertices, k corners, l loops and m faces.

    vertices: (n, 3).
    corners: (k,) the vertex index of each corner, loop after loop.
    loop_sizes: (l,) the number of corners of each loop.
    face_of_loop: (l,) the face of each loop, ascending; every face has at least one loop.
    """

    vertices: FloatArray
    corners: IntArray
    loop_sizes: IntArray
    face_of_loop: IntArray

    @property
    def face_count(self) -> int:
        """The number of faces, m."""
        return int(self.face_of_loop[-1]) + 1

    @property
    def face_of_corner(self) -> IntArray:
        """(k,) the face of each corner."""
        return np.repeat(self.face_of_loop, self.loop_sizes)

    @property
    def loop_starts(self) -> IntArray:
        """(l,) the index in `corners` of the first corner of each loop."""
        return np.cumsum(self.loop_sizes) - self.loop_sizes

    @property
    def next_corner(self) -> IntArray:
        """(k,) the index in `corners` of the next corner of the same loop."""
        return next_in_lists(self.loop_sizes)

    @property
    def edges(self) -> IntArray:
        """(e, 2) the pairs of vertices that are joined by an edge of a face, each pair once."""
        ends = np.column_stack([self.corners, self.corners[self.next_corner]])
        return np.unique(np.sort(ends, axis=1), axis=0)

    def loops(self, face: int) -> list[FloatArray]:
        """The loops of the face with index `face`, each an array (j, 3) of points."""
        loop_ids = np.flatnonzero(self.face_of_loop == face)
        slices = (
            slice(self.loop_starts[k], self.loop_starts[k] + self.loop_sizes[k]) for k in loop_ids
        )
        return [self.vertices[self.corners[corners]] for corners in slices]

    def face_boxes(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corners, (m, 3) each, of the bounding boxes of the faces'
        vertices."""
        x, first = self.vertices[self.corners], self.first_corners
        return np.minimum.reduceat(x, first), np.maximum.reduceat(x, first)

    def face_perimeters(self) -> FloatArray:
        """(m,) the total length of the edges of each face."""
        x = self.vertices[self.corners]
        edges = np.linalg.norm(x[self.next_corner] - x, axis=1)
        return np.add.reduceat(edges, self.first_corners)

    @functools.cached_property
    def in_convex_position(self) -> BoolArray:
        """(m,) whether each face is a single loop without self-intersections that is proved to lie
        on the boundary of a convex set; False where there is no proof. A convex projection proves
        it for most faces (`_projects_to_convex_polygon`). Other faces of a single loop are examined
        by `is_convex_position`, but no more than 20,000 of them."""
        is_convex = self._projects_to_convex_polygon()
        is_single = np.bincount(self.face_of_loop, minlength=self.face_count) == 1
        unproved = np.flatnonzero(is_single & ~is_convex)[:_MAX_EXAMINED_FACES]
        for k in unproved:
            is_convex[k] = is_convex_position(tuple(self.loops(int(k))))
        return is_convex

    def _projects_to_convex_polygon(self) -> BoolArray:
        """(m,) for each face, whether it is a single loop whose projection along its mean normal is
        a convex polygon that is run around once.

        Such a loop has no self-intersection, for its projection has none. It lies on the boundary
        of a convex set, the cylinder over the projection. A turn at a corner counts only if the
        sine of its angle is more than a millionth, far above rounding, so that True is always
        right.
        """
        x = self.vertices[self.corners]
        face, first = self.face_of_corner, self.first_corners
        center = np.add.reduceat(x, first) / np.diff(np.append(first, len(x)))[:, None]
        offsets = x - center[face]
        # The sum of the cross products of successive offsets: the vector area, twice.
        normal = np.add.reduceat(np.cross(offsets, offsets[self.next_corner]), first)
        length = np.linalg.norm(normal, axis=1)
        normal /= np.where(length > 0, length, 1)[:, None]
        edge = x[self.next_corner] - x
        # A millionth of the product of the lengths of both edges at a corner, to be compared with
        # their cross product.
        least_cross = np.linalg.norm(edge, axis=1)
        least_cross *= _MIN_TURN_SINE * least_cross[self.next_corner]
        # The projection of the edges; all turns must be to the left, and add up to one revolution.
        edge -= (edge * normal[face]).sum(axis=1)[:, None] * normal[face]
        next_edge = edge[self.next_corner]
        cross_product = (np.cross(edge, next_edge) * normal[face]).sum(axis=1)
        dot_product = (edge * next_edge).sum(axis=1)
        turns_left = np.logical_and.reduceat(cross_product > least_cross, first)
        total_turn = np.add.reduceat(np.arctan2(cross_product, dot_product), first)
        is_once = np.abs(total_turn - 2 * np.pi) < _REVOLUTION_TOLERANCE
        is_single = np.bincount(self.face_of_loop, minlength=self.face_count) == 1
        return turns_left & is_once & is_single & (length > 0)

    @functools.cached_property
    def first_corners(self) -> IntArray:
        """(m,) the index in `corners` of the first corner of each face."""
        new = np.flatnonzero(np.diff(self.face_of_loop, prepend=-1))
        return self.loop_starts[new]


def validate_polygons(vertices: Any, faces: Any) -> PolygonFaces:
    """Validate polygonal faces; returns them as arrays that cannot be written to.

    vertices: (n, 3).
    faces: a sequence of faces of any lengths, each a sequence of at least three indices or a
        sequence of such loops; or an integer array (m, k).

    Raises:
        MeshError: not numbers of these shapes, an empty mesh; a coordinate that is not finite; an
            index that is not an integer or has no vertex; a loop of fewer than three vertices, or
            that visits a vertex twice; an edge of length zero, or run twice by its face; a face
            whose vertices lie on a line.
    """
    ragged = "must all have 3 coordinates"
    x = checked_vertices(as_real_array(vertices, "the vertices", MeshError, ragged=ragged))
    corners, sizes, face_of_loop = _flatten_faces(faces)
    bad = np.flatnonzero((corners < 0) | (corners >= len(x)))
    face = np.repeat(face_of_loop, sizes)
    if bad.size:
        index = int(corners[bad[0]])
        hint = ""
        if index == len(x) and int(corners.min()) == 1:
            hint = "; these indices seem to count from 1: subtract 1"
        raise MeshError(
            f"face {face[bad[0]]} has vertex {index}{others_suffix(bad.size)}, which is out of "
            "range: "
            f"there are {len(x):,} vertices, counted from 0{hint}"
        )
    polygons = PolygonFaces(x, corners, sizes, face_of_loop)
    _check_edges(polygons)
    _check_not_collinear(polygons)
    for array in (x, corners, sizes, face_of_loop):
        array.setflags(write=False)
    return polygons


def _flatten_faces(faces: Any) -> tuple[IntArray, IntArray, IntArray]:
    """Convert a list of faces to flat arrays: the corners (k,) of all loops, one loop after the
    other; and for each loop the number of its corners (l,) and its face (l,). Raises MeshError if
    that is not possible."""
    if not _is_list(faces):
        raise MeshError(f"the faces must be a list of lists of vertex indices, not {faces!r}")
    if len(faces) == 0:
        raise MeshError("there are no faces: give a list of lists of vertex indices")
    if len(faces) > MAX_FACES:
        raise MeshError(f"{len(faces):,} faces are too many: at most {MAX_FACES:,}")
    loops: list[Any] = []
    owners: list[int] = []
    for k, face in enumerate(faces):
        face_loops = _loops_of(face, k)
        loops += face_loops
        owners += [k] * len(face_loops)
    sizes = np.array([len(loop) for loop in loops], dtype=np.int64)
    if (short := np.flatnonzero(sizes < 3)).size:
        raise MeshError(
            f"face {owners[int(short[0])]} has a loop of {sizes[short[0]]} vertices"
            f"{others_suffix(short.size)}: a face needs three or more; leave it out"
        )
    corners = np.concatenate(loops).astype(np.int64)
    return corners, sizes, np.array(owners, dtype=np.int64)


def _loops_of(face: Any, k: int) -> list[Any]:
    """The loops of the face with index k, as integer arrays (n,). Raises MeshError if it is no
    face."""
    if not _is_list(face):
        raise MeshError(
            f"face {k} is {face!r}: it must be a list of vertex indices, or a list of such loops"
        )
    if len(face) == 0:
        raise MeshError(f"face {k} is empty: it needs three or more vertices; leave it out")
    is_nested = [_is_list(entry) for entry in face]
    if any(is_nested) and not all(is_nested):
        raise MeshError(f"face {k} mixes indices and loops: give one kind or the other")
    loops: list[Any] = []
    for loop in face if all(is_nested) else [face]:
        try:
            array: npt.NDArray[Any] = np.asarray(loop)
        except (ValueError, OverflowError):
            raise MeshError(f"face {k} is ragged: a loop is a list of integers") from None
        if array.size == 0:
            raise MeshError(f"face {k} has an empty loop: leave it out")
        if array.ndim != 1 or array.dtype.kind not in "iu":
            hint = ": convert them with .astype(int)" if array.dtype.kind == "f" else ""
            raise MeshError(f"face {k} must list integer indices, not {array.dtype}{hint}")
        loops.append(array)
    return loops


def _is_list(value: Any) -> bool:
    """Whether a value is a list or an array of at least one dimension."""
    is_array = isinstance(value, np.ndarray) and value.ndim > 0
    return is_array or (isinstance(value, Sequence) and not isinstance(value, str))


def _check_edges(mesh: PolygonFaces) -> None:
    """Raise MeshError for a loop that visits a vertex twice, an edge of length zero, or an edge
    that its face runs twice."""
    n = len(mesh.vertices)
    loop = np.repeat(np.arange(len(mesh.loop_sizes)), mesh.loop_sizes)
    face = mesh.face_of_corner
    # A number for each pair of a loop and a vertex.
    first = _first_repeated_key(loop * n + mesh.corners)
    if first is not None:
        raise MeshError(
            f"face {face[first]} visits vertex {mesh.corners[first]} twice: split it there into "
            "two loops of one face, or into two faces"
        )
    begin, end = mesh.corners, mesh.corners[mesh.next_corner]
    length = np.abs(mesh.vertices[begin] - mesh.vertices[end]).max(axis=1)
    # The squares of such lengths would underflow.
    if (degenerate := np.flatnonzero(length < 1e-100)).size:
        k = degenerate[0]
        raise MeshError(
            f"face {face[k]} has an edge without a length, from vertex {begin[k]} to "
            f"{end[k]}{others_suffix(degenerate.size)}: join vertices at the same place"
        )
    # A number for each edge, the same for both directions.
    _, edge = np.unique(np.minimum(begin, end) * n + np.maximum(begin, end), return_inverse=True)
    if (first := _first_repeated_key(face * len(edge) + edge.reshape(-1))) is not None:
        raise MeshError(
            f"face {face[first]} runs along the edge from vertex {begin[first]} to {end[first]} "
            "twice: leave it out of both loops, or join its neighbors"
        )


def _first_repeated_key(keys: IntArray) -> int | None:
    """The index of the first entry of `keys` whose value occurs earlier in the array; None if all
    entries differ."""
    _, first = np.unique(keys, return_index=True)
    if len(first) == len(keys):
        return None
    return int(np.setdiff1d(np.arange(len(keys)), first)[0])


def _check_not_collinear(mesh: PolygonFaces) -> None:
    """Raise a MeshError for a face whose corners are collinear. Let a be the corner that is
    farthest from the center of the face's box, and b the corner that is farthest from a. The
    corners are collinear if all are within 1e-9 of the face's size from the line through a and
    b."""
    x, face = mesh.vertices[mesh.corners], mesh.face_of_corner
    lower, upper = mesh.face_boxes()
    relative = x - (0.5 * (lower + upper))[face]
    relative /= np.abs(upper - lower).max(axis=1)[face][:, None]
    # The pole of each face is its corner a; it is the last of the face in the order by face and
    # radius.
    squared_radius = (relative * relative).sum(axis=1)
    order = np.lexsort((squared_radius, face))
    last = np.append(np.flatnonzero(np.diff(face[order])), len(order) - 1)
    pole = relative[order[last]]
    offset = relative - pole[face]
    # The direction from a to b.
    square_distance = (offset * offset).sum(axis=1)
    order = np.lexsort((square_distance, face))
    direction = offset[order[last]]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.linalg.norm(
        offset - (offset * direction[face]).sum(axis=1)[:, None] * direction[face], axis=1
    )
    widest = np.maximum.reduceat(distance, mesh.first_corners)
    if (flat := np.flatnonzero(widest < _COLLINEAR_TOLERANCE)).size:
        raise MeshError(
            f"the vertices of face {flat[0]}{others_suffix(flat.size)} lie on a line: it has no "
            "surface; leave it out"
        )


# The weight of normals relative to positions, a length in the unit of the mesh.
_NORMAL_WEIGHT = 0.25


def cluster_into_polygons(
    vertices: FloatArray,
    faces: IntArray,
    count: int,
    *,
    iterations: int = 12,
    smoothing: int = 0,
    seed: int = 0,
) -> tuple[FloatArray, list[list[list[int]]]]:
    """Cut a triangle mesh into about `count` clusters of triangles, and make a polygonal face of
    each. Returns the vertices (k, 3); and for each cluster the loops of its boundary, lists of
    vertex indices. The polygons have many corners and are not planar; they serve as examples for
    pictures and tests.

    Each triangle is a point (centroid, weight * normal) in six dimensions, and Lloyd's algorithm
    finds the clusters, so that they are compact and bend little (Cohen-Steiner, Alliez and Desbrun
    2004 do so with planes). Corners of the polygons are vertices of the mesh; all other vertices
    are left out.

    vertices, faces: (n, 3) and (m, 3), the triangle mesh.
    count: the number of clusters wanted.
    iterations: the number of steps of Lloyd's algorithm.
    smoothing: how often each corner with exactly two edges is moved to the middle between its
        position and the mean of its two neighbors, since boundaries along triangles are zigzags.
    seed: the seed of the random start.

    Raises:
        ValueError: fewer than two clusters, or more than triangles.
    """
    if not 2 <= count <= len(faces):
        raise ValueError(
            f"the number of clusters must be from 2 to {len(faces):,}, the number of faces of the "
            f"mesh, not {count}"
        )
    cluster_of = _clusters(vertices, faces, count, iterations, seed)
    order = np.argsort(cluster_of, kind="stable")
    parts = np.split(faces[order], np.flatnonzero(np.diff(cluster_of[order])) + 1)
    # For each cluster the loops of its boundary.
    loops = [join_edges(boundary_edges(part.tolist())) for part in parts]
    # A cluster that is a closed surface has no boundary.
    loops = [cluster for cluster in loops if cluster]
    used = np.unique([corner for cluster in loops for loop in cluster for corner in loop])
    new_index = np.full(len(vertices), -1)
    new_index[used] = np.arange(len(used))
    polygons = [
        [[int(new_index[corner]) for corner in loop] for loop in cluster] for cluster in loops
    ]
    points = vertices[used]
    if smoothing:
        ends = np.array(
            [(a, b) for cluster in polygons for loop in cluster for a, b in _loop_edges(loop)]
        )
        points = _smoothed(points, np.unique(np.sort(ends, axis=1), axis=0), smoothing)
    return points, polygons


def _loop_edges(loop: list[int]) -> list[tuple[int, int]]:
    """The edges of a loop of vertex indices, as pairs."""
    return list(zip(loop, [*loop[1:], loop[0]], strict=True))


def _smoothed(points: FloatArray, edges: IntArray, times: int) -> FloatArray:
    """Smooth polygons: each point with exactly two edges is moved to the middle between its
    position and the mean of its two neighbors, `times` times. Returns the points (n, 3).

    points: (n, 3).
    edges: (e, 2) indices of points, each edge once.
    """
    directed = np.concatenate([edges, edges[:, ::-1]])
    is_inner = np.bincount(directed[:, 0], minlength=len(points)) == 2
    # By start, so that the two neighbors of a point follow each other.
    directed = directed[np.argsort(directed[:, 0], kind="stable")]
    neighbors = directed[is_inner[directed[:, 0]], 1].reshape(-1, 2)
    for _ in range(times):
        moved = points.copy()
        moved[is_inner] = 0.5 * (points[is_inner] + points[neighbors].mean(axis=1))
        points = moved
    return points


def _clusters(
    vertices: FloatArray, faces: IntArray, count: int, iterations: int, seed: int
) -> IntArray:
    """Find the cluster (m,) of each triangle of a mesh. Triangles are points (centroid, weight *
    unit normal) in six dimensions, weighted by area, and are clustered by Lloyd's algorithm: each
    triangle joins the nearest center, and each center moves to the mean of its triangles.

    vertices, faces: (n, 3), (m, 3) the mesh.
    count: the number of clusters; some may become empty, and are dropped.
    iterations: the number of Lloyd's steps.
    seed: the seed of the random initial centers.
    """
    corners = vertices[faces]
    normal = area_normals(corners)
    area = np.linalg.norm(normal, axis=1)
    points = np.hstack([corners.mean(axis=1), _NORMAL_WEIGHT * normal / area[:, None]])
    probability = area / area.sum()
    rng = np.random.default_rng(seed)
    centers = points[rng.choice(len(points), count, p=probability, replace=False)]
    cluster_of = np.zeros(len(faces), dtype=np.int64)
    for _ in range(iterations):
        # [1]: the index of the nearest center (after the distance).
        cluster_of = kd_tree(centers).query(points)[1]
        weight = np.bincount(cluster_of, area, count)
        for axis in range(points.shape[1]):
            moment = np.bincount(cluster_of, area * points[:, axis], count)
            centers[:, axis] = np.where(weight > 0, moment / np.maximum(weight, 1e-300), np.inf)
        # Clusters without triangles, whose centers are infinite, are dropped.
        centers = centers[weight > 0]
        count = len(centers)
    # (`query` returns distances and indices.)
    return kd_tree(centers).query(points)[1]
