"""The closed mesh of a tube, the set of points within a radius of its polylines. A "ring" is a
closed chain of points around the polyline; rings are placed along it and joined by triangles. A
polyline is cut in pieces where the mesh would pass through itself, and the meshes of the pieces are
united.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.fields.solids.tube import Tube
from harnack.geometry.mesh_edges import has_distinct_corners, row_norms
from harnack.meshing.closed_mesh import to_manifold
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from manifold3d import Manifold

__all__ = ["tube_manifold"]

_MOST_VERTICES = 4_000_000
# By how much polylines may be simplified, relative to the tolerance.
_SIMPLIFY = 0.25
# The smallest number of points around, also for wires far thinner than the tolerance.
_LEAST_AROUND = 8
# An edge leads back along the edge before if the cosine of the angle between them is at most -1
# plus this.
_REVERSAL = 1e-9


def tube_manifold(tube: Tube, level: float, tolerance: float) -> Manifold:
    """Make a mesh of the points whose distance from a tube's polylines is at most its radius +
    `level`. Vertices lie on the surface, and faces are within `tolerance` (a length) of it. The
    mesh is empty if the radius + `level` is 0 or less.

    First, vertices of a polyline are removed as long as the polyline stays within a quarter of the
    tolerance. Then each polyline is swept as a whole. If its mesh would pass through itself, as at
    corners too sharp for the radius or where the tube returns to itself, the polyline is cut in two
    at a vertex, where both parts end with a ball: the tube is the union of both parts' tubes.

    Proof of the tolerance. Let r be the radius, n the number of points around and a = 2 pi/n. The
    distances of a point from two polylines differ by no more than the polylines do: a quarter of
    the tolerance. Faces between lines along an edge have chords of angle a, which are r a^2/8 deep.
    Where two edges meet in a single ring, at an angle up to a, lines along the edge lie as deep as
    that. On the balls outside of corners and at ends both chords are of angle a at most. The sum is
    at most r a^2/4, three quarters of the tolerance.

    Raises:
        MeshingError: the mesh would have millions of faces.
    """
    from manifold3d import Manifold, OpType

    radius = tube.radius + level
    if radius <= 0:
        return Manifold()
    # The largest angle a with r a^2/4 <= 3/4 of the tolerance.
    step = math.sqrt(3 * tolerance / radius)
    segments = max(_LEAST_AROUND, math.ceil(2 * math.pi / step))
    polylines = [
        _simpler(polyline, _SIMPLIFY * tolerance) for polyline in np.split(tube.points, tube.starts)
    ]
    parts: list[Manifold] = []
    # The number of vertices so far.
    so_far = 0
    while polylines:
        # Rings of a half ball at both ends, and at least one ring at each vertex between.
        minimum = segments * sum(len(polyline) + segments // 2 for polyline in polylines)
        if so_far + minimum > _MOST_VERTICES:
            raise MeshingError(
                f"a tube within {tolerance:.3g} has more than {2 * (so_far + minimum):,} faces: "
                "choose a larger `tolerance`"
            )
        points = polylines.pop()
        swept = _Sweep(radius, segments, points).surface()
        if swept is not None and (len(points) == 2 or _is_apart(swept)):
            parts.append(to_manifold(swept))
            so_far += len(swept.vertices)
        else:
            middle = len(points) // 2
            polylines += [points[: middle + 1], points[middle:]]
    return Manifold.batch_boolean(parts, OpType.Add)


def _is_apart(surface: TriangleMesh) -> bool:
    """Whether no faces of a mesh pass through each other."""
    return not len(intersecting_faces(surface.vertices, surface.faces))


def _simpler(points: FloatArray, length: float) -> FloatArray:
    """A polyline with fewer vertices than the polyline `points` (n, 3). It leaves out vertices that
    are within `length` of the edges that replace them (Douglas and Peucker 1973).

    Conversely, all points of the new edges are within `length` of the old polyline. Proof. Let a
    point p run along the part of the old polyline that an edge replaces. The point of the edge
    nearest to p, at a distance of at most `length`, moves continuously from one end of the edge to
    the other. So every point of the edge is nearest to some p."""
    is_kept = np.zeros(len(points), np.bool_)
    is_kept[[0, -1]] = True
    waiting_ranges = [(0, len(points) - 1)]
    while waiting_ranges:
        first, last = waiting_ranges.pop()
        edge, offsets = points[last] - points[first], points[first + 1 : last] - points[first]
        square = float(edge @ edge)
        fraction = (offsets @ edge / square if square > 0 else np.zeros(len(offsets))).clip(0, 1)
        distance = row_norms(offsets - fraction[:, None] * edge)
        # If both ends are at the same point, no edge replaces the range: it is divided.
        if not len(distance) or (square > 0 and distance.max() <= length):
            continue
        # Keep the farthest vertex, and continue on both sides of it.
        farthest = first + 1 + int(distance.argmax())
        is_kept[farthest] = True
        waiting_ranges += [(first, farthest), (farthest, last)]
    return points[is_kept]


@dataclass(frozen=True)
class _Sweep:
    """A tube around a single polyline, made by sweeping a ring of points along it. A "line along
    the tube" joins points with the same number of successive rings.

    radius: of the tube, a length. ring_size: the number of points of each ring.
    points: (n, 3) the polyline; it is closed if the last point equals the first."""

    radius: float
    ring_size: int
    points: FloatArray

    def surface(self) -> TriangleMesh | None:
        """The triangles between the rings of points along the polyline. None if an edge leads back
        along the edge before it, or is too short for its corners: then a line along the tube would
        run backwards."""
        points, edge_vectors = self.points, np.diff(self.points, axis=0)
        # Scaled before they are normalized, since squares of small numbers underflow.
        directions = edge_vectors / np.abs(edge_vectors).max(axis=1)[:, None]
        directions /= row_norms(directions)[:, None]
        is_closed = len(directions) > 2 and bool((points[0] == points[-1]).all())
        frames_and_shift = self._transported(directions, is_closed=is_closed)
        if frames_and_shift is None:
            return None
        frames, shift = frames_and_shift
        direction_pairs = itertools.pairwise(
            [*directions, directions[0]] if is_closed else directions
        )
        corners = [
            self._corner(point, turn, self._directions(end_frame))
            for point, turn, (_, end_frame) in zip(
                points[1:], direction_pairs, frames, strict=False
            )
        ]
        # The rings at the start and at the end of each edge: at corners, or half balls at ends.
        if is_closed:
            starts, ends = [np.roll(corners[-1], shift, axis=1), *corners[:-1]], corners
        else:
            starts = [self._end(points[0], directions[0], frames[0][0], -1), *corners]
            ends = [*corners, self._end(points[-1], directions[-1], frames[-1][1], 1)]
        for edge, start, end in zip(directions, starts, ends, strict=True):
            # All lines along the tube must run forwards from the last ring before the edge to the
            # first after it.
            if len(directions) > 1 and not ((end[0] - start[-1]) @ edge > 0).all():
                return None
        rings = starts if is_closed else [*starts, ends[-1]]
        return self._joined(np.concatenate(rings), shift if is_closed else None)

    def _directions(self, frame: FloatArray) -> FloatArray:
        """(ring_size, 3) unit vectors at equal angles in a plane. frame: (2, 3) two orthonormal
        vectors that span the plane."""
        angle = 2 * math.pi * np.arange(self.ring_size) / self.ring_size
        return np.cos(angle)[:, None] * frame[0] + np.sin(angle)[:, None] * frame[1]

    def _corner(
        self, point: FloatArray, turn: tuple[FloatArray, FloatArray], directions: FloatArray
    ) -> FloatArray:
        """Rings (k, ring_size, 3) of points on the tube at a corner of the polyline, where two
        edges meet at `point`.

        turn: the unit vectors (3,) of the edge before and of the edge after the corner.
        directions: (ring_size, 3) unit vectors from the polyline to the points of a ring on the
            edge before the corner.

        A ring has points on the inner and on the outer side of the corner. On the inner side, the
        line along one edge and the line along the other meet in a single point, in the plane that
        bisects the corner; it is repeated in all k rings. On the outer side, the k rings are the
        points of an arc on the ball around the corner."""
        before, after = turn
        cosine, across = float(before @ after), after - (before @ after) * before
        sine = float(np.linalg.norm(across))
        if sine == 0:
            return (point + self.radius * directions)[None]
        across = across / sine
        angle = math.atan2(sine, cosine)
        inward_part = directions @ across
        step = 2 * math.pi / self.ring_size
        count = math.ceil(angle / step)
        # A small turn has a single ring, in the plane that bisects the corner.
        angles = np.array([0.5 * angle]) if count <= 1 else np.linspace(0.0, angle, count + 1)
        # The ring's directions rotated by each angle, in the plane of `across` and `before`.
        outer_points = directions + inward_part[:, None] * (
            (np.cos(angles)[:, None, None] - 1) * across - np.sin(angles)[:, None, None] * before
        )
        inner_points = directions - (inward_part * math.tan(0.5 * angle))[:, None] * before
        return point + self.radius * np.where(
            (inward_part > 0)[:, None], inner_points, outer_points
        )

    def _end(self, point: FloatArray, axis: FloatArray, frame: FloatArray, sign: int) -> FloatArray:
        """Rings (k, ring_size, 3) of points on the half ball that closes an end of the tube.

        point: the end of the polyline. axis: the unit vector of its edge there.
        frame: (2, 3) two orthonormal vectors at right angles to the edge.
        sign: -1 at the first point, where rings go from the pole to the rim; 1 at the last point,
            where they go from the rim to the pole."""
        count = math.ceil(0.25 * self.ring_size)
        angle = 0.5 * math.pi * np.arange(count + 1)[:, None, None] / count
        rings = np.cos(angle) * self._directions(frame) + sign * np.sin(angle) * axis
        return point + self.radius * (rings if sign > 0 else rings[::-1])

    def _joined(self, rings: FloatArray, shift: int | None) -> TriangleMesh:
        """The mesh that joins each ring to the next by triangles.

        rings: (k, ring_size, 3) the points of all rings along the polyline.
        shift: for a closed polyline, point i of the last ring is joined to point i + shift of the
            first ring. None for a polyline with two ends; all points of its first ring are equal,
            and so are those of its last ring.

        Points that are equal in successive rings are one vertex, and faces without three different
        vertices are left out."""
        count, n = len(rings), self.ring_size
        # Each quadrilateral has two neighboring points a, b of a ring and the points d, c of the
        # next ring.
        row, column = np.mgrid[: count - 1 if shift is None else count, :n].reshape(2, -1)
        column_shift = np.where(row == count - 1, shift or 0, 0)
        next_row = (row + 1) % count * n
        a, b = row * n + column, row * n + (column + 1) % n
        c, d = next_row + (column + column_shift + 1) % n, next_row + (column + column_shift) % n
        # Equal points get the same number: in successive rings, and at the poles of half balls.
        vertex: IntArray = np.arange(count * n, dtype=np.int64).reshape((count, n))
        for k in range(1, count):
            is_same = (rings[k] == rings[k - 1]).all(axis=1)
            vertex[k, is_same] = vertex[k - 1, is_same]
        if shift is None:
            vertex[[0, -1]] = vertex[[0, -1], :1]
        corners = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        faces: IntArray = vertex.ravel()[corners]
        is_triangle = has_distinct_corners(faces)
        return TriangleMesh.without_unused_vertices(rings.reshape(-1, 3), faces[is_triangle])

    def _transported(
        self, edges: FloatArray, *, is_closed: bool
    ) -> tuple[list[tuple[FloatArray, FloatArray]], int] | None:
        """A frame for each edge of a polyline: two orthonormal vectors (2, 3) at right angles to
        the edge. From each edge to the next, the frame turns by the rotation that takes one edge's
        direction to the next one's.

        edges: (n, 3) the unit vectors of the edges. is_closed: whether the polyline is closed.

        Returns:
            For each edge the frames at its start and at its end; and a shift. For a polyline with
            two ends, both frames of an edge are the same, and the shift is 0. For a closed
            polyline, frames also turn a little about the edges, so that point i of the last ring
            coincides with point i + shift of the first. None if an edge leads back along the edge
            before it.
        """
        start = np.cross(edges[0], np.eye(3)[np.abs(edges[0]).argmin()])
        start /= np.linalg.norm(start)
        first_vectors = [start]
        for before, after in itertools.pairwise([*edges, edges[0]] if is_closed else edges):
            cosine = float(before @ after)
            if cosine <= -1 + _REVERSAL:
                return None
            # The rotation that takes one edge's direction to the next (Rodrigues' formula); then
            # what rounding leaves along the edge is removed.
            axis, u = np.cross(before, after), first_vectors[-1]
            turned = cosine * u + np.cross(axis, u) + axis * (axis @ u) / (1 + cosine)
            turned -= (turned @ after) * after
            first_vectors.append(turned / np.linalg.norm(turned))
        shift, twist_per_edge = 0, 0.0
        if is_closed:
            # The angle by which the frame differs after one round: a whole number of points, and a
            # rest that is spread over all edges.
            mismatch = math.atan2(
                first_vectors[-1] @ np.cross(edges[0], start), first_vectors[-1] @ start
            )
            step = 2 * math.pi / self.ring_size
            shift = round(mismatch / step)
            twist_per_edge = (mismatch - shift * step) / len(edges)
        # (A closed polyline has one vector more: that after a round.)
        frames = [
            np.stack([u, np.cross(edge, u)]) for u, edge in zip(first_vectors, edges, strict=False)
        ]
        return [
            (_spun(f, -twist_per_edge * k), _spun(f, -twist_per_edge * (k + 1)))
            for k, f in enumerate(frames)
        ], shift


def _spun(frame: FloatArray, angle: float) -> FloatArray:
    """A frame of two orthonormal vectors (2, 3), turned by an angle (in radians) in their plane."""
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([c * frame[0] + s * frame[1], c * frame[1] - s * frame[0]])
