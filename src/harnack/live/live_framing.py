"""Places live surfaces on the stage (the scene's coordinates, in which the floor is horizontal),
and computes a camera that sees the surfaces for all values of their sliders."""

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
    """The placement of surfaces on the stage (the scene's coordinates, in which the floor is
    horizontal), and a camera that sees them.

    placement: the similarity that maps coordinates of the surfaces to coordinates of the stage.
    camera: a camera that turns about a target, as data for camera.js: "target", "distance" in units
        of the stage; "azimuth", "elevation" and "fov" in degrees.
    box: the box that stands on the ground, in the coordinates of the surfaces; None if the
        surfaces' own points stand on the ground.
    """

    placement: Placement
    camera: dict[str, Any]
    box: Box | None

    @classmethod
    def of(cls, camera: Camera, up: Any, points: FloatArray, *, is_whole: bool) -> Framing:
        """Place points (n, 3) of the surfaces on the stage, and frame them. Returns the `Framing`.

        camera: the camera option of `render`. If it has a box, this box is framed in place of the
            points.
        up: the up option of `render`, the axis or vector of the surfaces' coordinates that points
            up.
        is_whole: whether all points belong to the surfaces at the start. If not (points for other
            slider values are among them), the bounding box of the points stands on the ground, so
            that all states have the same placement.
        """
        box = camera.box
        if box is not None:
            points = corners_of(np.array(box.bounds()))
        elif not is_whole:
            box = Box(*(_three(end) for end in (points.min(axis=0), points.max(axis=0))))
        # What stands on the ground: the box or, without a box, the points.
        standing = points if box is None else corners_of(np.array(box.bounds()))
        placement = stage_placement(standing, rotation_to_z_up(up))
        return cls(placement, _orbit(camera, placement, points), box)

    def with_box(self, camera: Camera) -> Camera:
        """Return the given camera; if it has no box of its own, with the box of this framing.
        `render` with this camera places the surfaces on the stage exactly as this framing does."""
        return camera if camera.box is not None else replace(camera, box=self.box)


def extreme_points(points: FloatArray) -> FloatArray:
    """Return those of the points (n, 3) that are the farthest point in at least one of 200 fixed
    random directions; all points if there are at most 200. A camera that frames them frames nearly
    all n points."""
    if len(points) <= _DIRECTIONS:
        return points
    directions = np.random.default_rng(0).normal(size=(3, _DIRECTIONS))
    return points[np.unique((points @ directions).argmax(axis=0))]


def _orbit(camera: Camera, placement: Placement, points: FloatArray) -> dict[str, Any]:
    """Return a camera that turns about a target, as data for camera.js (see `Framing.camera`).

    It stands where `camera` stands when it frames the points (n, 3) after placement, and looks in
    the same direction. The target is the point of the line of sight that is as far from the camera
    as the middle of the points' box, measured along the line of sight.
    """
    on_stage = placement.apply(points)
    pose = camera.pose(on_stage, _SIZE, placement.apply)
    forward = pose.target - pose.origin
    forward = forward / np.linalg.norm(forward)
    middle = 0.5 * (on_stage.min(axis=0) + on_stage.max(axis=0))
    # The middle may lie beside or behind the camera.
    distance = max(float((middle - pose.origin) @ forward), 1e-3)
    # Azimuth and elevation say where the camera stands, opposite to where it looks.
    elevation = np.degrees(np.arcsin(np.clip(-forward[2], -1, 1)))
    # A vertical line of sight has no azimuth of its own.
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
    """Return a point (3,) as a tuple of three floats."""
    x, y, z = (float(c) for c in point)
    return x, y, z
