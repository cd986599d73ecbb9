"""The placement of live surfaces on the stage, and a camera that sees them for all values of their
sliders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.geometry import Box
from harnack.rendering.framing import rotation_to_z_up
from harnack.rendering.stage import corners_of, stage_placement

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.rendering.camera import Camera
    from harnack.rendering.placed_surface import Placement

__all__ = ["Framing", "extreme_points"]

# The shape of the picture that is framed; it fits into every window.
_SIZE = (4, 3)
# Directions in each of which the farthest point is kept. Nearly all directions are within 0.2
# radians of one of them, so that a body loses 2 % of its size; the margin of a picture is 14 %.
_DIRECTIONS = 200


@dataclass(frozen=True)
class Framing:
    """The placement of surfaces on the stage, and the camera that sees them.

    camera: a camera that turns about a target, as camera.js takes it, in the stage's coordinates.
    box: the box that stands on the ground, in the coordinates of the surfaces, where more is framed
        than is seen at first; None otherwise.
    """

    placement: Placement
    camera: dict[str, Any]
    box: Box | None

    @classmethod
    def of(cls, camera: Camera, up: Any, points: FloatArray, *, is_whole: bool) -> Framing:
        """The framing of points (n, 3) of the surfaces.

        camera: as `render` takes it; its box is framed in place of the points.
        up: as `render` takes it.
        is_whole: whether all points to be framed are seen at first; otherwise the box of the points
            stands on the ground, as in all pictures of an animation.
        """
        box = camera.box
        if box is not None:
            points = corners_of(np.array(box.bounds()))
        elif not is_whole:
            box = Box(*(_three(end) for end in (points.min(axis=0), points.max(axis=0))))
        standing = points if box is None else corners_of(np.array(box.bounds()))
        placement = stage_placement(standing, rotation_to_z_up(up))
        return cls(placement, _orbit(camera, placement, points), box)

    def with_box(self, camera: Camera) -> Camera:
        """A camera for `render` with which the surfaces stand at the same place as here."""
        return camera if camera.box is not None else replace(camera, box=self.box)


def extreme_points(points: FloatArray) -> FloatArray:
    """The points, of n (n, 3), that are farthest in any of many directions: they determine the
    framing of a camera."""
    if len(points) <= _DIRECTIONS:
        return points
    directions = np.random.default_rng(0).normal(size=(3, _DIRECTIONS))
    return points[np.unique((points @ directions).argmax(axis=0))]


def _orbit(camera: Camera, placement: Placement, points: FloatArray) -> dict[str, Any]:
    """A camera that turns about a point before it, in the coordinates of the stage."""
    on_stage = placement.apply(points)
    pose = camera.pose(on_stage, _SIZE, placement.apply)
    forward = pose.target - pose.origin
    forward = forward / np.linalg.norm(forward)
    middle = 0.5 * (on_stage.min(axis=0) + on_stage.max(axis=0))
    distance = max(float((middle - pose.origin) @ forward), 1e-3)
    elevation = np.degrees(np.arcsin(np.clip(-forward[2], -1, 1)))
    is_vertical = abs(forward[2]) > 1 - 1e-9
    azimuth = pose.azimuth if is_vertical else np.degrees(np.arctan2(-forward[1], -forward[0]))
    return {
        "target": (pose.origin + distance * forward).tolist(),
        "azimuth": float(azimuth),
        "elevation": float(elevation),
        "distance": distance,
        "fov": float(pose.fov),
    }


def _three(point: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(c) for c in point)
    return x, y, z
