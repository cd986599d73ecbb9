"""Open surfaces cut by volumes: triangles ended at planes and spheres."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Intersection, Volume
from harnack.meshing.checks import MeshingError
from harnack.meshing.lattice import Surface
from harnack.meshing.tetrahedra import IntArray, edge_keys

__all__ = ["cut_by"]

# Vertices so near to a boundary, as a part of the size, count as on it.
_NEAR = 1e-9
Heights = Callable[[FloatArray], FloatArray]


def cut_by(surface: Surface, volume: Volume) -> Surface:
    """The part of a surface in a volume. Its new ends lie on planes exactly, and between points of
    spheres; vertices that are kept stay in their order and come first.

    Raises:
        MeshingError: another kind of volume.
    """
    if isinstance(volume, Intersection):
        for one in volume.volumes:
            surface = cut_by(surface, one)
        return surface
    if isinstance(volume, Ball):
        centre, radius = np.array(volume.center), volume.radius
        return _cut(surface, lambda x: np.linalg.norm(x - centre, axis=1) - radius, volume)
    if not isinstance(volume, Box | HalfSpace | ConvexHull):
        raise MeshingError(f"a {type(volume).__name__} cannot cut a mesh: give a box or a ball")
    for row in volume.planes():
        normal, offset = row[:3], float(row[3])

        def height(x: FloatArray, n: FloatArray = normal, h: float = offset) -> FloatArray:
            return x @ n - h

        surface = _cut(surface, height, None)
    if isinstance(volume, Box):
        return Surface(_onto(surface.vertices, volume), surface.faces)
    return surface


def _onto(vertices: FloatArray, box: Box) -> FloatArray:
    """Vertices within rounding of a box's faces, put there."""
    for end in box.bounds():
        near = np.abs(vertices - end) <= _NEAR * (1 + np.abs(end))
        vertices = np.where(near, end, vertices)
    return vertices


def _cut(surface: Surface, height: Heights, ball: Ball | None) -> Surface:
    """The part where a height is not positive; it is linear along edges, or that above a sphere."""
    vertices, faces = surface.vertices, surface.faces
    if not len(faces):
        return surface
    h = height(vertices)
    h = np.where(np.abs(h) <= _NEAR * float(np.ptp(vertices, axis=0).max()), 0.0, h)
    out = (h > 0)[faces]
    # What lies on the boundary with no corner inside is left out.
    keep = (h < 0)[faces].any(axis=1)
    mixed = keep & out.any(axis=1)
    pairs = np.concatenate([faces[mixed][:, [k, (k + 1) % 3]] for k in range(3)])
    crossing = pairs[h[pairs[:, 0]] * h[pairs[:, 1]] < 0]
    keys = np.unique(edge_keys(crossing, len(vertices)))
    a, b = keys // len(vertices), keys % len(vertices)
    share = (h[a] / (h[a] - h[b]))[:, None]
    points = vertices[a] + share * (vertices[b] - vertices[a])
    if ball is not None:
        points = _on_sphere(vertices[a], vertices[b], ball)
    first = len(vertices)

    def at(i: IntArray, j: IntArray) -> IntArray:
        """The end of edges between vertices inside and outside; a vertex on the boundary itself."""
        index = np.searchsorted(keys, edge_keys(np.column_stack([i, j]), len(vertices)))
        return np.where(h[i] == 0, i, first + index)

    parts = [faces[keep & ~out.any(axis=1)]]
    rows = faces[mixed]
    number = out[mixed].sum(axis=1)
    for k in range(3):
        order = [k, (k + 1) % 3, (k + 2) % 3]
        one = rows[(number == 1) & out[mixed][:, k]][:, order]  # a is outside
        x, y = at(one[:, 1], one[:, 0]), at(one[:, 2], one[:, 0])
        parts += [np.stack([one[:, 1], one[:, 2], x], axis=1), np.stack([one[:, 2], y, x], axis=1)]
        two = rows[(number == 2) & ~out[mixed][:, k]][:, order]  # a is inside
        parts.append(np.stack([two[:, 0], at(two[:, 0], two[:, 1]), at(two[:, 0], two[:, 2])], 1))
    made = np.concatenate(parts)
    whole = (made != np.roll(made, 1, axis=1)).all(axis=1)
    return Surface.of(np.concatenate([vertices, points]), made[whole])


def _on_sphere(a: FloatArray, b: FloatArray, ball: Ball) -> FloatArray:
    """Where segments from a to b (n, 3), one inside and one outside, pass through the sphere."""
    inside = np.linalg.norm(a - ball.center, axis=1) < np.linalg.norm(b - ball.center, axis=1)
    start, end = np.where(inside[:, None], a, b), np.where(inside[:, None], b, a)
    o, d = start - ball.center, end - start
    dd, od = (d * d).sum(axis=1), (o * d).sum(axis=1)
    room = np.maximum(ball.radius**2 - (o * o).sum(axis=1), 0)
    share = room / (od + np.sqrt(od * od + dd * room))
    return start + share[:, None] * d
