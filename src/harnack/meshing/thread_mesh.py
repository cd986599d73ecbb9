"""The closed mesh of a screw thread. The axis of the thread is the z axis. Its surface is swept by
a profile (height and radius of each corner, over one pitch), so each corner of the profile runs
along a helical "line". In one turn a line rises by the "lead", the number of starts times the
pitch.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.fields.solids.thread import Thread
from harnack.meshing.closed_mesh import to_manifold
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from manifold3d import Manifold

__all__ = ["thread_manifold"]

_MAX_VERTICES = 4_000_000


def thread_manifold(thread: Thread, lower: float, upper: float, tolerance: float) -> Manifold:
    """Make a closed mesh that is the screw thread for lower <= z <= upper (z along its axis).
    Outside of that range the mesh has no meaning.

    tolerance: a length, the largest distance of faces from the thread's surface.

    Vertices lie on helical lines through the corners of the thread's profile, so the edges of the
    profile are edges of the mesh. Let n be the number of vertices around, and r the largest radius.
    Faces are within 2 r (pi/n)^2 of the surface. Proof. The corners of a face differ by at most 2
    pi/n in angle. So a chord has a sagitta of r (pi/n)^2/2, and the departure of the diagonal of a
    face, which is turned by 2 pi/n, is less than three times that.

    Raises:
        MeshingError: the mesh would have millions of faces.
    """
    profile = np.array(thread.profile)
    radius = float(profile[:, 1].max())
    # The smallest number n with 2 r (pi/n)^2 <= tolerance.
    segments = max(16, math.ceil(math.pi * math.sqrt(2 * radius / tolerance)))
    lead = thread.starts * thread.pitch
    # Below and above the profile fades within a lead to a cylinder, which is closed there.
    first = math.floor((lower - 3 * lead) / thread.pitch)
    periods = math.ceil((upper + 3 * lead) / thread.pitch) - first
    lines = periods * len(profile)
    if lines * segments > _MAX_VERTICES:
        raise MeshingError(
            f"a thread within {tolerance:.3g} has {2 * lines * segments:,} faces: choose a larger "
            "`tolerance`"
        )
    # One copy of the profile for each pitch.
    shift = thread.pitch * (first + np.arange(periods))
    height: FloatArray = (profile[:, 0] + shift[:, None]).astype(np.float64).ravel()
    radii = np.tile(profile[:, 1], periods)
    vertices = _vertices(height, radii, segments, lead, thread.starts * len(profile))
    min_radius = float(profile[:, 1].min())
    # From one lead to two leads outside of the range, the radii shrink to the smallest one.
    fraction = np.minimum(
        (vertices[:, 2] - lower) / lead + 2, (upper - vertices[:, 2]) / lead + 2
    ).clip(0, 1)
    radius_of_vertex = np.linalg.norm(vertices[:, :2], axis=1)
    vertices[:, :2] *= (
        (min_radius + fraction * (radius_of_vertex - min_radius)) / radius_of_vertex
    )[:, None]
    faces = _faces(lines, segments, thread.starts * len(profile))
    vertices = np.concatenate([vertices, _middles(vertices, lines, segments)])
    if thread.left_handed:
        vertices[:, 1] *= -1
        faces = faces[:, ::-1]
    return to_manifold(TriangleMesh(vertices, faces))


def _vertices(
    height: FloatArray, radii: FloatArray, segments: int, lead: float, shift: int
) -> FloatArray:
    """The vertices of the mesh of a screw thread, which lie on helical lines about the z axis.

    height, radii: (lines,) the z of each line at angle 0, and its radius.
    segments: the number of vertices of a line in one turn.
    lead: the height that a line gains in a turn.
    shift: after a full turn, line i is where line i + shift began (at angle 0).

    Returns (lines * segments + shift, 3): the points of each line at each angle, line after line;
    then the points at angle 0 of the `shift` lines above the last one, where the last lines end
    after a turn."""
    angle = 2 * math.pi * np.arange(segments) / segments
    # The height and the radius of the last lines after a turn, where they are at angle 0 again.
    continued = height[-shift:] + lead, radii[-shift:]
    z = height[:, None] + lead * angle / (2 * math.pi)
    x, y = radii[:, None] * np.cos(angle), radii[:, None] * np.sin(angle)
    # At angle 0, x is the radius and y is 0.
    last = np.column_stack([continued[1], 0 * continued[1], continued[0]])
    return np.concatenate([np.stack([x, y, z], axis=-1).reshape(-1, 3), last])


def _index(line: IntArray, step: IntArray, lines: int, segments: int, shift: int) -> IntArray:
    """The indices, in the order of `_vertices`, of vertices that are given by a helical line and an
    angle.

    line: the numbers of the lines, from 0 to `lines` - 1 (or up to `shift` more at angle 0).
    step: the angles, as numbers from 0 to `segments` (a full turn). Line i after a full turn is
        line i + shift at angle 0.
    lines, segments: the number of lines, and of the vertices of a line in one turn."""
    # After a full turn a line is another one, at angle 0. The points of lines beyond the last come
    # after those of all lines.
    line, step = np.where(step == segments, line + shift, line), np.where(step == segments, 0, step)
    return np.where(line < lines, line * segments + step, lines * segments + line - lines)


def _faces(lines: int, segments: int, shift: int) -> IntArray:
    """The faces (m, 3) of the closed mesh of a screw thread. There are two triangles for each
    quadrilateral between neighboring vertices of neighboring helical lines, and at both ends of the
    thread a fan of triangles around a point of the axis (`_middles`).

    lines, segments: the number of helical lines, and of the vertices of a line in one turn.
    shift: after a full turn, line i is where line i + shift began (at angle 0).
    """
    line, step = (grid.ravel() for grid in np.mgrid[: lines - 1, :segments])

    def at(i: IntArray, j: IntArray) -> IntArray:
        """The indices of the vertices of lines i at angles j."""
        return _index(i, j, lines, segments, shift)

    # The four corners of each quadrilateral, in their order around it.
    a, b, c, d = at(line, step), at(line, step + 1), at(line + 1, step + 1), at(line + 1, step)
    sides = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    steps, back_lines = np.arange(segments + 1), np.arange(shift + 1)[::-1]
    middle = lines * segments + shift
    ends: list[IntArray] = []
    # An end is bounded by a loop: one turn of the first (or last) line, and then back at angle 0
    # across the lines between the turn's end and its start.
    for first, apex, sign in ((0, middle, -1), (lines - 1, middle + 1, 1)):
        along = at(np.full(segments + 1, first), steps)
        backward = at(first + back_lines, np.zeros(shift + 1, np.int64))
        loop = np.concatenate([along, backward[1:]])
        fan = np.column_stack([loop[:-1], loop[1:], np.full(len(loop) - 1, apex)])
        ends.append(fan[:, ::sign])
    return np.concatenate([sides, *ends])


def _middles(vertices: FloatArray, lines: int, segments: int) -> FloatArray:
    """(2, 3) two points of the axis that close the ends of a thread's mesh. One is at the mean
    height of the first helical line, the other at the mean height of the last.

    vertices: those of the lines (`_vertices`).
    lines, segments: the number of lines, and of the vertices of a line in one turn.
    """
    low = vertices[:segments, 2].mean()
    high = vertices[(lines - 1) * segments : lines * segments, 2].mean()
    return np.array([[0.0, 0.0, low], [0.0, 0.0, high]])
