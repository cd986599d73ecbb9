"""The film of a camera: which ray belongs to a point of the picture, where a point of space is
seen, and the grid of lines on which rays are traced. Screen coordinates (u, v) count pixels to the
right and down, from the upper left corner."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from harnack.rendering.camera import Camera

if TYPE_CHECKING:
    from typing_extensions import Self

    from harnack.backend import FloatArray, IntArray
    from harnack.geometry import Volume


class Screen(Protocol):
    """Where n points of space are seen: by a camera, or, for shadows, by lights."""

    def at(self, index: IntArray) -> Self:
        """The screen for the points with these indices."""
        ...

    def directions(self, screen: FloatArray) -> FloatArray:
        """The unit directions (n, 3) of the rays through screen points (n, 2)."""
        ...

    def origins(self, screen: FloatArray) -> FloatArray:
        """The origins (n, 3), or (1, 3) if all are the same, of the rays through screen points."""
        ...

    def jacobian(self, points: FloatArray) -> FloatArray:
        """The derivatives (n, 2, 3) of screen points by the points (n, 3) that are seen there."""
        ...

    def pixel_width(self, points: FloatArray) -> FloatArray:
        """The length (n,) at points (n, 3) that is seen as one unit of the screen."""
        ...


@dataclass(frozen=True)
class Film:
    """A film of pixels in front of a pinhole camera.

    origin: (3,) the position of the camera.
    right, up, forward: (3,) its axes. `right` and `up` have the lengths of the tangents of half the
        angle of view, so that forward + right is the direction to the right border.
    size: (width, height) in pixels.
    """

    origin: FloatArray
    right: FloatArray
    up: FloatArray
    forward: FloatArray
    size: tuple[int, int]

    @classmethod
    def of(cls, camera: Camera, size: tuple[int, int], volume: Volume | None) -> Film:
        """Place a camera in the coordinates of the surface.

        volume: what fills the picture if the camera has no box; None if nothing bounded is known.

        Raises:
            ValueError: something bounded is needed, and the volume is not.
        """
        box = camera.box if camera.box is not None else volume
        bounds = None if box is None else np.array(box.bounds())
        if bounds is None or not np.isfinite(bounds).all():
            if not has_fixed_pose(camera):
                raise ValueError(
                    "the surface reaches to infinity, so say what the picture shows: give the "
                    "camera a box, or a position, a target and a fov"
                )
            bounds = np.zeros((2, 3))
        corners = np.array([*itertools.product(*bounds.T)])
        pose = camera.pose(corners, size, lambda points: points)
        forward = pose.target - pose.origin
        forward = forward / np.linalg.norm(forward)
        up = pose.up - (pose.up @ forward) * forward
        up = up / np.linalg.norm(up)
        slope = math.tan(math.radians(pose.fov) / 2) / max(size)
        right = np.cross(forward, up) * slope * size[0]
        return cls(np.array(pose.origin, float), right, up * slope * size[1], forward, size)

    def at(self, index: IntArray) -> Film:
        """This film, which is the same for all points."""
        del index
        return self

    def origins(self, screen: FloatArray) -> FloatArray:
        """The origin (1, 3) of all rays."""
        del screen
        return self.origin[None]

    def directions(self, screen: FloatArray) -> FloatArray:
        """The unit directions (n, 3) of the rays through screen points (n, 2)."""
        u, v = (2 * screen / self.size - 1).T
        d = self.forward + u[:, None] * self.right - v[:, None] * self.up
        return d / np.linalg.norm(d, axis=1, keepdims=True)

    def jacobian(self, points: FloatArray) -> FloatArray:
        """The derivatives (n, 2, 3) of the screen points at which points of space (n, 3) are seen.

        Let q be the point minus the origin, z = q . forward, and r the unit vector to the right,
        with slope k. Then u = (1 + q . r/(k z)) width/2, and du = (r - (q . r/z) forward) . dq
        width/(2 k z); likewise v, with the opposite sign.
        """
        q = points - self.origin
        z = q @ self.forward
        rows: list[FloatArray] = []
        for axis, length, sign in ((self.right, self.size[0], 1), (self.up, self.size[1], -1)):
            slope = np.linalg.norm(axis)
            unit = axis / slope
            across = unit - ((q @ unit) / z)[:, None] * self.forward
            rows.append(sign * across * (length / (2 * slope * z))[:, None])
        return np.stack(rows, axis=1)

    def pixel_width(self, points: FloatArray) -> FloatArray:
        """The width (n,) of a pixel at the depth of points (n, 3), a length."""
        depth = (points - self.origin) @ self.forward
        return 2 * depth * np.linalg.norm(self.right) / self.size[0]


def at_least_two(points: FloatArray) -> FloatArray:
    """The points (n, k), or a single one twice: kernels for a single lane are others, and would be
    compiled at the first step of an optimization at which only one point is of some kind."""
    return np.repeat(points, 2, axis=0) if len(points) == 1 else points


def pixel_indices(screen: FloatArray, size: tuple[int, int]) -> IntArray:
    """The indices (n,) of the pixels in which screen points (n, 2) lie, counted by rows."""
    column, row = (np.minimum(screen[:, k].astype(int), size[k] - 1) for k in (0, 1))
    return row * size[0] + column


def has_fixed_pose(camera: Camera) -> bool:
    """Whether position, direction and angle of view of a camera are all set, or follow from a box
    that is set, so that they do not depend on the surface."""
    if camera.box is not None:
        return True
    is_placed = camera.position is not None or (
        camera.distance is not None and camera.target is not None
    )
    return is_placed and camera.target is not None and camera.fov is not None


@dataclass(frozen=True)
class Grid:
    """The lines of a grid of rays, in screen coordinates: of each column and row of parts of pixels
    one line, between the borders of the picture.

    columns, rows: the coordinates of the lines, with both borders.
    samples: the number of lines in a row or column of pixels.
    """

    columns: FloatArray
    rows: FloatArray
    samples: int

    @classmethod
    def of(cls, size: tuple[int, int], samples: int, random: np.random.Generator | None) -> Grid:
        """A grid for a picture of this size, with lines at random places in the parts; in their
        middles for None."""
        lines: list[FloatArray] = []
        for side in size:
            count = side * samples
            place = np.full(count, 0.5) if random is None else random.uniform(size=count)
            inner = (np.arange(count) + place) / samples
            lines.append(np.concatenate([[0.0], inner, [float(side)]]))
        return cls(lines[0], lines[1], samples)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and columns of lines."""
        return len(self.rows), len(self.columns)

    @property
    def points(self) -> FloatArray:
        """(n, 2) the screen points at which lines cross, row by row."""
        u, v = np.meshgrid(self.columns, self.rows)
        return np.stack([u.ravel(), v.ravel()], axis=1)
