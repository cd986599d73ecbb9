"""Checks that every mesh of a level set {f = 0} must pass. A mesh consists of vertices (n, 3) and
of triangular faces (m, 3), which hold the indices of their corners. The normal of a face points to
the side from which its corners run counter-clockwise. Coordinates and distances have the unit of
the vertices.

Every mesh that `mesh` returns has passed checks: vertices and centers of triangles are tested by
samples of the field, faces that pass through each other are found by exact predicates, and the
number of triangles has a limit. The largest body is chosen by signed volumes and by the nesting of
shells (`components`). Files hold single precision; vertices are rounded to it before the last
check.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, NoReturn

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    boundary_edges,
    half_edges,
    longest_edges,
    normals_at_vertices,
    row_dots,
    row_norms,
    unit_rows,
)
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import (
    LocalizedMeshingError,
    MeshingError,
    OffLevelError,
    SelfIntersectionError,
    TriangleLimitError,
    point_text,
)
from harnack.meshing.self_intersection import intersecting_faces

if TYPE_CHECKING:
    from harnack.geometry import Volume

__all__ = [
    "check_inside",
    "check_manifold",
    "check_near_level",
    "check_no_self_intersection",
    "check_triangle_limit",
    "euler_characteristic",
    "misoriented_faces",
    "nonmanifold_vertices",
    "points_off_level",
]


def misoriented_faces(function: LevelFunction, vertices: FloatArray, faces: IntArray) -> IntArray:
    """Find the faces whose normal does not point to the side on which f is larger: the dot product
    of the normal with the gradient of f at the face's center is not positive. Returns their indices
    (k,).

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    """
    corner = vertices[faces]
    normal = area_normals(corner)
    slope = function.sample(corner.mean(axis=1)).gradient
    return np.flatnonzero(row_dots(normal, slope) <= 0)


def euler_characteristic(faces: IntArray, edges: Edges | None = None) -> int:
    """The Euler characteristic of faces (m, 3): the number of vertices that they use, minus the
    number of their edges, plus the number of faces.

    edges: the `Edges` of `half_edges(faces)`, if they are known.
    """
    vertices = int(np.count_nonzero(np.bincount(faces.ravel())))
    edges = edges or Edges.of(half_edges(faces))
    return vertices - len(edges.vertices) + len(faces)


def check_manifold(faces: IntArray, vertices: FloatArray | None = None) -> None:
    """Raise an error unless faces (m, 3) form a manifold. Three conditions must hold: every edge
    has one or two faces; two faces run their common edge in opposite directions; and the faces
    around every vertex are joined to each other by edges.

    vertices: (n, 3), for the locations of failures; may be None.

    Raises:
        MeshingError: the faces are no manifold. It is a LocalizedMeshingError if vertices are
            given.
    """

    def fail(message: str, vertex_ids: IntArray) -> NoReturn:
        """Raise the error of a failed check; `vertex_ids` are the indices of the vertices at which
        it failed."""
        if vertices is None:
            raise MeshingError(message)
        raise LocalizedMeshingError(message, vertices[vertex_ids])

    pairs = half_edges(faces)
    edges = Edges.of(pairs)
    index, uses = edges.edge_of_pair, edges.multiplicity
    if (uses > 2).any():
        fail(
            f"{(uses > 2).sum()} edges of the mesh have more than two faces: the level set crosses "
            "itself, or cells are too large for it; choose a smaller `cell_size`, or another level",
            np.unique(pairs[uses[index] > 2]),
        )
    is_run_alike = edges.run_twice_alike(pairs)
    if is_run_alike.any():
        fail(
            "neighboring faces of the mesh do not agree on its two sides: cells are too large for "
            "this level set; choose a smaller `cell_size`",
            np.unique(pairs[is_run_alike[index]]),
        )
    # A manifold has one fan of faces at each vertex that is used.
    fan_count = int(_vertex_fans(faces, edges).max(initial=-1)) + 1
    if fan_count > np.count_nonzero(np.bincount(faces.ravel())):
        fail(
            "sheets of the mesh touch in a point: cells are too large for this level set; choose a "
            "smaller `cell_size`, or another level",
            nonmanifold_vertices(faces),
        )


def check_no_self_intersection(vertices: FloatArray, faces: IntArray) -> None:
    """Raise an error if a vertex is not finite, or if faces pass through each other or lie on each
    other; decided exactly.

    vertices, faces: (n, 3), (m, 3) the mesh.

    Raises:
        MeshingError: a vertex is not finite. It is a SelfIntersectionError, with the faces, if
            faces meet.
    """
    if not np.isfinite(vertices).all():
        raise MeshingError("vertices of the mesh are no numbers: choose another level or `clip`")
    crossing = intersecting_faces(vertices, faces)
    if len(crossing):
        centers = vertices[faces[crossing]].mean(axis=1)
        raise SelfIntersectionError(
            f"{len(crossing):,} of {len(faces):,} triangles pass through each other, such as near "
            f"{point_text(centers[0])}: choose a smaller `cell_size` or a larger `tolerance`",
            centers,
            crossing,
        )


def check_triangle_limit(expected: float, max_triangles: int) -> None:
    """Raise TriangleLimitError if the number `expected` of triangles is larger than
    `max_triangles`."""
    if expected > max_triangles:
        raise TriangleLimitError(
            f"the mesh takes about {expected:.2g} triangles, and max_triangles is "
            f"{max_triangles:,}: choose a larger `tolerance` or `cell_size`, a smaller `clip`, "
            "or a larger `max_triangles`"
        )


def check_inside(vertices: FloatArray, volume: Volume, slack: float) -> None:
    """Raise MeshingError if a vertex (n, 3) lies outside of a volume by more than the length
    `slack`."""
    is_outside = ~volume.padded(slack).contains_points(vertices)
    if is_outside.any():
        raise MeshingError(
            f"{is_outside.sum():,} vertices of the mesh lie outside of what was asked for, such as "
            f"{point_text(vertices[is_outside][0])}: choose a smaller `cell_size`"
        )


def check_near_level(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    volume: Volume | None,
) -> None:
    """Raise an error unless all vertices and all centers of faces are within `tolerance`, a length,
    of the level set {f = 0}, where f is the field minus its level. Samples of f decide that.

    A point passes if |f| / |grad f| <= tolerance, which estimates the distance. It passes as well
    if f has different signs at two points on a line through it, on both sides of it and at the same
    distance of at most the tolerance: a continuous f is then 0 between them. Fourteen lines are
    tried: the normal of the face, or the mean normal at the vertex, and 13 fixed lines. The fixed
    lines are askew to the axes: many parts have faces in coordinate planes, where rounding would
    decide the sign. Every cone of half-angle 28 degrees contains one of these directions; the
    corner of a cube contains a cone of half-angle 35 degrees.

    function: f.
    vertices, faces: (n, 3), (m, 3) the mesh.
    volume: the volume that cuts the solid, so that f counts as positive outside of it. None if the
        solid is not cut.

    Two kinds of points are not tested: vertices on the boundary curve of a level set of a field
    such as `SolidAngle`, since f has no value there; and centers of triangles with no edge longer
    than half of the tolerance, since their corners are tested.

    Raises:
        OffLevelError: some points are farther away; `locations` holds them.
    """
    off_level, count = points_off_level(function, vertices, faces, tolerance, volume)
    if len(off_level):
        raise OffLevelError(
            f"{len(off_level):,} of {count:,} vertices and centers of triangles are farther than "
            f"the tolerance, {tolerance:.3g}, from the level, such as {point_text(off_level[0])}: "
            "choose a smaller `cell_size` or a larger `tolerance`",
            off_level,
        )


def points_off_level(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    volume: Volume | None,
) -> tuple[FloatArray, int]:
    """Find the vertices and centers of faces that are not within `tolerance` of the level set, by
    samples of the function: |f| / |grad f| is larger, and f has the same sign at both ends of short
    segments through the point, along the normal and 13 other lines (`check_near_level`).

    function: f, which is 0 on the level set.
    vertices, faces: (n, 3), (m, 3) the mesh.
    tolerance: a length.
    volume: f counts as positive outside of it; None for no such volume.

    Returns these points (k, 3), and the number of points that were tested.
    """
    corner = vertices[faces]
    large = longest_edges(corner) > 0.5 * tolerance
    is_checked = np.ones(len(vertices), np.bool_)
    # Level sets of fields with a period may end at a curve, on which the field has no value.
    if function.period is not None:
        is_checked[boundary_edges(faces)] = False
    points = np.concatenate([vertices[is_checked], corner[large].mean(axis=1)])
    mean = normals_at_vertices(vertices, faces)
    directions = unit_rows(np.concatenate([mean[is_checked], area_normals(corner[large])]))
    # Not `>`: a distance that is not a number fails too.
    rows = np.flatnonzero(~(function.sample(points).distance <= tolerance))
    # Nearer points are tried as well: where the solid is thin, the farther ones may lie beyond it.
    for fraction, line in itertools.product((1.0, 0.25, 0.0625), (None, *_askew_lines())):
        if not len(rows):
            break
        step = fraction * tolerance * (directions[rows] if line is None else line)
        ahead, behind = (_is_positive(function, points[rows] + s * step, volume) for s in (1, -1))
        # Different signs: the level set passes between the two points.
        rows = rows[ahead == behind]
    return points[rows], len(points)


def _askew_lines() -> FloatArray:
    """Directions of 13 lines as unit vectors (13, 3): the axes, the face diagonals and the space
    diagonals of a cube. The cube is turned so that no line is near a coordinate plane or a plane at
    45 degrees to two axes."""
    # Of the 27 vectors, the first 13 are the negatives of the last 13; the one between is 0.
    directions = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))[14:]
    # The rows of an orthogonal matrix; the numbers were found by trial.
    frame: FloatArray = np.linalg.qr([[7, 7, -3], [3, -16, -7], [19, 7, -13]])[0]
    return (directions / row_norms(directions)[:, None]) @ frame


def _is_positive(
    function: LevelFunction, points: FloatArray, volume: Volume | None
) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 3) count as outside of the solid: the function is positive or not a
    number there, or the point lies outside of the volume."""
    is_positive = ~(function.sample(points).value <= 0)
    return is_positive if volume is None else is_positive | ~volume.contains_points(points)


def nonmanifold_vertices(faces: IntArray) -> IntArray:
    """Find the vertices at which faces (m, 3) are not a manifold: the ends of edges that have more
    than two faces, and vertices with more than one fan of faces. A fan is a set of faces around a
    vertex that are joined to each other by edges at that vertex. Returns the indices (k,) of these
    vertices, in increasing order."""
    pairs, count = half_edges(faces), int(faces.max(initial=-1)) + 1
    edges = Edges.of(pairs)
    overused = np.unique(pairs[edges.multiplicity[edges.edge_of_pair] > 2])
    fan = _vertex_fans(faces, edges)
    # Each fan once, at its vertex.
    vertex = np.empty(int(fan.max(initial=-1)) + 1, np.int64)
    vertex[fan] = faces.ravel()
    fans = np.bincount(vertex, minlength=count)
    return np.union1d(overused, np.flatnonzero(fans > 1))


def _vertex_fans(faces: IntArray, edges: Edges) -> IntArray:
    """Group the corners of faces (m, 3) into fans. A fan is a largest set of faces around a vertex
    that are joined to each other by edges at that vertex; each face of it takes part with its
    corner at the vertex.

    edges: the `Edges` of `half_edges(faces)`.

    Returns (3m,) for each corner the index of its fan, counted from 0 over all vertices together;
    entry 3 i + k is for corner k of face i.
    """
    m = len(faces)
    corner = np.arange(3 * m).reshape(m, 3)
    # Corners at both ends of the edge k of a face, in the order of `half_edges`.
    first = np.concatenate([corner[:, 0], corner[:, 1], corner[:, 2]])
    second = np.concatenate([corner[:, 1], corner[:, 2], corner[:, 0]])
    forward, backward = edges.paired_half_edges().T  # run in opposite directions
    # Across an edge, the corners at its one end belong together, and those at its other end.
    rows = np.concatenate([first[forward], second[forward]])
    columns = np.concatenate([second[backward], first[backward]])
    return connected_groups(np.column_stack([rows, columns]), 3 * m)
