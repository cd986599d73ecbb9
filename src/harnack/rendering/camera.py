"""`Camera`, which chooses from where a picture is seen such that the surfaces fill it, and
`CameraPose`, the position and orientation that result. In the world z is up."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import Box
from harnack.geometry.volume import as_point

# The part of the picture that the surface fills at zoom 1.
_FILL_FRACTION = 0.86


# Angles of view in degrees: of a camera that chooses its distance, of one with points to be framed
# beside or behind it, and the widest that is chosen to frame everything from a given position.
_DEFAULT_FOV, _FOV_INSIDE, _WIDEST = 26.0, 60.0, 120.0
_AZIMUTH, _ELEVATION = -50.0, 28.0

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """From where a picture is seen. What is not set is chosen such that the surfaces fill the
    picture.

    azimuth, elevation: the direction from the surfaces to the camera, in degrees; azimuth 0 is +x
        and 90 is +y, elevation 90 is straight above. By default -50 and 28.
    fov: the larger of the horizontal and vertical angle of view, in degrees. By default 26; for a
        camera with a position or a distance, the angle at which the surfaces fill the picture.
    zoom: with 1, the surfaces fill the picture up to a margin. With a larger number the camera
        comes closer; if it has a position or a distance, the angle of view becomes smaller instead.
    box: a box, in the coordinates of the surfaces, that fills the picture in place of the visible
        surfaces; it stands on the ground. With the same box, pictures of surfaces that change fit
        each other, and no rays are traced to find the frame.
    position: (x, y, z), where the camera stands, in the coordinates of the surfaces, in place of
        azimuth and elevation.
    target: (x, y, z), the point in the middle of the picture, in the same coordinates; by default
        the middle of what fills the picture.
    distance: of the camera from the target, in the same unit; by default such that the surfaces
        fill the picture.
    """

    azimuth: float | None = None
    elevation: float | None = None
    fov: float | None = None
    zoom: float = 1.0
    box: Box | None = None
    position: Point | None = None
    target: Point | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        for name in ("azimuth", "elevation", "fov", "zoom", "distance"):
            number = getattr(self, name)
            if (number is not None or name == "zoom") and (
                isinstance(number, bool | str) or not _is_number(number)
            ):
                raise TypeError(f"{name} of a camera must be a number, not {number!r}")
        if self.fov is not None and not 0 < self.fov < 170:
            raise ValueError(f"fov must lie between 0 and 170 degrees, not {self.fov}")
        if not 0 < self.zoom < math.inf:
            raise ValueError(f"zoom must be positive, not {self.zoom}")
        if self.azimuth is not None and not math.isfinite(self.azimuth):
            raise ValueError(f"azimuth must be a finite number of degrees, not {self.azimuth}")
        if self.elevation is not None and not abs(self.elevation) <= 90:
            raise ValueError(f"elevation must lie within -90 and 90 degrees, not {self.elevation}")
        if self.box is not None and not isinstance(cast("object", self.box), Box):
            raise TypeError(f"box must be a harnack.Box, not {type(self.box).__name__}")
        if self.box is not None and not np.isfinite(self.box.bounds()).all():
            raise ValueError("box must be finite")
        if self.box is not None and not np.ptp(self.box.bounds(), axis=0).any():
            raise ValueError(f"box must be larger than a point, and this one is not: {self.box}")
        for name in ("position", "target"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_point(getattr(self, name), name))
        if self.distance is not None and not 0 < self.distance < math.inf:
            raise ValueError(f"distance must be positive, not {self.distance}")
        for name in ("azimuth", "elevation", "distance"):
            if self.position is not None and getattr(self, name) is not None:
                raise ValueError(f"a camera has a position or {name}, not both")
        if self.position is not None and self.position == self.target:
            raise ValueError(f"position and target are the same point, {self.position}")

    @property
    def azimuth_elevation(self) -> tuple[float, float]:
        """Azimuth and elevation, in degrees, of a camera without a position."""
        return (
            _AZIMUTH if self.azimuth is None else self.azimuth,
            _ELEVATION if self.elevation is None else self.elevation,
        )

    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return unit vectors (3,) in the world that point to the right, up, and back to the
        camera, for a camera with azimuth and elevation."""
        a, e = map(math.radians, self.azimuth_elevation)
        back = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        return right, np.cross(back, right), back

    def frame_points(
        self, points: FloatArray, size: tuple[int, int]
    ) -> tuple[FloatArray, FloatArray]:
        """Place the camera such that it keeps all points (n, 3) within a picture of `size` (width,
        height), as close as its angle of view allows. Returns its origin (3,) and a target (3,) in
        front of it.

        Let x, y, z be the coordinates of a point to the right, up, and back to the camera. Let (cx,
        cy, h) be those of the camera, and slope the tangent of half its horizontal angle of view. A
        point is in the picture if |x - cx| <= slope (h - z), and likewise for y with the vertical
        angle. So the largest x + slope z and the smallest x - slope z over all points give cx and
        the least h. The same for y gives cy and another least h; the larger h is taken. Then the
        distance of the camera from the middle of the points is divided by `zoom`.
        """
        right, up, back = self.axes()
        x, y, z = points @ right, points @ up, points @ back
        origin = np.zeros(3)
        height = -math.inf
        for coordinate, axis, slope in zip((x, y), (right, up), self._slopes(size), strict=True):
            # |coordinate - c| <= slope (height - z) for all points.
            largest_sum, smallest_difference = (
                (coordinate + slope * z).max(),
                (coordinate - slope * z).min(),
            )
            origin = origin + (largest_sum + smallest_difference) / 2 * axis
            height = max(height, (largest_sum - smallest_difference) / (2 * slope))
        middle = float(z.max() + z.min()) / 2
        origin = origin + (middle + (height - middle) / self.zoom) * back
        return origin, origin - back

    def pose(
        self,
        points: FloatArray,
        size: tuple[int, int],
        to_world: Callable[[FloatArray], FloatArray],
    ) -> CameraPose:
        """Place the camera in the world such that it sees the given points. Returns its
        `CameraPose`.

        points: (n, 3) points of the world that are to be in the picture.
        size: (width, height) of the picture in pixels.
        to_world: maps points (n, 3) from the coordinates of the surfaces to the world, with one
            scale for all axes.

        A camera that has neither position, target nor distance is placed by `frame_points`.
        Otherwise it looks at its target, by default the middle of the points. Then, of distance and
        angle of view, the one that is not given is chosen such that the points fill the picture.
        """
        if self.position is None and self.target is None and self.distance is None:
            origin, target = self.frame_points(points, size)
            # The second of the axes is up, and the azimuth comes before the elevation.
            return CameraPose(
                origin, target, self.axes()[1], self.fov_or_default, self.azimuth_elevation[0]
            )
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        # `to_world` maps arrays of points: here of one point.
        target = middle if self.target is None else to_world(np.array([self.target]))[0]
        if self.position is not None:
            origin = to_world(np.array([self.position]))[0]
            to_camera = origin - target
            distance = float(np.linalg.norm(to_camera))
            if not distance > 0:
                raise ValueError(
                    f"position {self.position} is in the middle of what is seen: say where to look "
                    "with a target (x, y, z)"
                )
            azimuth = math.degrees(math.atan2(to_camera[1], to_camera[0]))
            elevation = math.degrees(math.asin(max(-1.0, min(1.0, to_camera[2] / distance))))
            oriented_camera = replace(self, azimuth=azimuth, elevation=elevation, position=None)
        else:
            oriented_camera, distance = self, None
            if self.distance is not None:
                # One unit of the surfaces' coordinates, as a vector of the world.
                unit = np.diff(to_world(np.array([[0.0, 0, 0], [1, 0, 0]])), axis=0)
                distance = self.distance * float(np.linalg.norm(unit))
        # The coordinates of the points relative to the target, along the axes of the camera.
        right, up, back = oriented_camera.axes()
        relative = points - target
        x, y, z = np.abs(relative @ right), np.abs(relative @ up), relative @ back
        fov = self.fov_or_default
        # Choose the distance: |x| <= slope (distance - z) for all points, and likewise for y.
        if distance is None:
            slopes = self._slopes(size)
            distance = max(float((a / s + z).max()) for a, s in zip((x, y), slopes, strict=True))
            # Points that coincide with the target need a distance, too.
            distance = max(distance / self.zoom, 1e-3)
        elif self.fov is None:
            fov = self._fov_to_frame(np.array([x, y]), distance - z, size)
        else:
            # The distance and the angle of view are given: zoom narrows the angle.
            fov = 2 * math.degrees(math.atan(math.tan(math.radians(fov) / 2) / self.zoom))
        return CameraPose(
            target + distance * back, target, up, fov, oriented_camera.azimuth_elevation[0]
        )

    def _fov_to_frame(self, across: FloatArray, depth: FloatArray, size: tuple[int, int]) -> float:
        """Choose the angle of view, in degrees, of a camera at a given position such that n points
        fill the picture. It is at most 120, and 60 if a point lies beside or behind the camera.

        across: (2, n) absolute horizontal and vertical distances of the points from the axis of the
            view.
        depth: (n,) their distances from the camera along this axis.
        size: (width, height) of the picture in pixels.
        """
        if depth.min() <= 0:
            return _FOV_INSIDE
        # fov belongs to the longer side of the picture; the other side's slopes are scaled to it.
        side_ratios = max(size) / np.array(size)
        slopes = (across / depth).max(axis=1) * side_ratios
        # The angle must not be 0 if all points lie on the axis.
        fov = 2 * math.degrees(
            math.atan(max(float(slopes.max()), 1e-4) / _FILL_FRACTION / self.zoom)
        )
        return min(fov, _WIDEST)

    @property
    def fov_or_default(self) -> float:
        """The angle of view that was set, in degrees, or else 26, that of a camera that chooses its
        distance."""
        return _DEFAULT_FOV if self.fov is None else self.fov

    def _slopes(self, size: tuple[int, int]) -> tuple[float, float]:
        """Return two numbers for a picture of `size` (width, height): the tangents of half the
        angle of view, horizontally and vertically, of the part in the middle that surfaces are to
        fill (86 percent of each side)."""
        slope = math.tan(math.radians(self.fov_or_default) / 2) * _FILL_FRACTION / max(size)
        return slope * size[0], slope * size[1]


def _is_number(value: Any) -> bool:
    """Return whether `float` accepts a value."""
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


@dataclass(frozen=True)
class CameraPose:
    """Position, orientation and angle of view of a camera, in world coordinates (z is up).

    origin, target, up: (3,) where the camera stands, the point in the middle of the picture, and
        the unit vector that is up in the picture.
    fov: the larger of the horizontal and vertical angle of view, in degrees.
    azimuth: the angle from the x axis to the horizontal part of the vector from target to origin,
        in degrees.
    """

    origin: FloatArray
    target: FloatArray
    up: FloatArray
    fov: float
    azimuth: float
