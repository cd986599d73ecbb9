"""A camera that frames what stands on the stage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import Box

# The part of the picture that the surface fills at zoom 1.
_FILLED = 0.86


@dataclass(frozen=True)
class Camera:
    """A view of the stage.

    azimuth, elevation: of the direction the camera looks from, in degrees; azimuth 0 is +x and
        90 is +y, elevation 90 is straight from above.
    fov: the larger of the horizontal and vertical angle of view, in degrees.
    zoom: 1 frames the surface tightly with a margin; more comes closer.
    box: framed in place of what is to be seen, in the coordinates of the surfaces; it stands on the
        ground. The pictures of a film, in which surfaces change, then fit each other, and nothing
        has to be traced to find the frame.
    """

    azimuth: float = -50.0
    elevation: float = 28.0
    fov: float = 26.0
    zoom: float = 1.0
    box: Box | None = None

    def __post_init__(self) -> None:
        if not 0 < self.fov < 170:
            raise ValueError(f"fov must lie between 0 and 170 degrees, not {self.fov}")
        if not 0 < self.zoom < math.inf:
            raise ValueError(f"zoom must be positive, not {self.zoom}")
        if not abs(self.elevation) <= 90:
            raise ValueError(f"elevation must lie within -90 and 90 degrees, not {self.elevation}")
        if self.box is not None and not isinstance(cast("object", self.box), Box):
            raise TypeError(f"box must be a harnack.Box, not {type(self.box).__name__}")
        if self.box is not None and not np.isfinite(self.box.bounds()).all():
            raise ValueError("box must be finite")

    def frame(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Unit vectors of the world: to the right, up, and back to the camera."""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        back = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        return right, np.cross(back, right), back

    def fit(self, points: FloatArray, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Origin and target such that all points (n, 3) are in the picture of (width, height).

        Along each image axis the picture's edges are planes through the origin; the points'
        supports in the directions of these planes' normals give origin and distance.
        """
        right, up, back = self.frame()
        larger = max(size)
        x, y, z = points @ right, points @ up, points @ back
        origin = np.zeros(3)
        distance = -math.inf
        for across, axis, extent in ((x, right, size[0]), (y, up, size[1])):
            slope = math.tan(math.radians(self.fov) / 2) * extent / larger * _FILLED
            # |across - c| <= slope (distance - z) for all points.
            high, low = (across + slope * z).max(), (across - slope * z).min()
            origin = origin + (high + low) / 2 * axis
            distance = max(distance, (high - low) / (2 * slope))
        middle = float(z.max() + z.min()) / 2
        origin = origin + (middle + (distance - middle) / self.zoom) * back
        return origin, origin - back
