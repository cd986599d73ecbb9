"""A small photo studio: ground, lights and a camera that frames what stands there.

Surfaces are scaled to a stage of radius about 1 that stands on the ground z = 0, so that lights,
shadows and tolerances of Mitsuba's rays suit every size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.geometry.convex_volume import FloatArray
from harnack.rendering.mitsuba.carrier import shape
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.studio.lighting import ground, lights
from harnack.rendering.surfaces.framing import visible_points
from harnack.rendering.surfaces.placement import Placement
from harnack.tracer import LevelSet, Tolerance

if TYPE_CHECKING:
    from harnack.rendering.studio.materials import Material


@dataclass(frozen=True)
class Camera:
    """A view of the stage.

    azimuth, elevation: of the direction the camera looks from, in degrees; azimuth 0 is +x and
        90 is +y, elevation 90 is straight from above.
    fov: the larger of the horizontal and vertical angle of view, in degrees.
    zoom: 1 frames the surface tightly with a margin; more comes closer.
    turn: degrees by which the surface is turned about the x, y and z axes, in this order, before
        it is put on the ground.
    """

    azimuth: float = -50.0
    elevation: float = 28.0
    fov: float = 26.0
    zoom: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.fov < 170:
            raise ValueError(f"fov must lie between 0 and 170 degrees, not {self.fov}")
        if not 0 < self.zoom < math.inf:
            raise ValueError(f"zoom must be positive, not {self.zoom}")
        if not abs(self.elevation) <= 90:
            raise ValueError(f"elevation must lie within -90 and 90 degrees, not {self.elevation}")

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


# Of fitted surfaces, on the stage.
_TOLERANCE = 1e-4
# Light of one path, where white is 1.
_CLAMP = 2.0
# The part of the picture that the surface fills at zoom 1.
_FILLED = 0.86


@dataclass(frozen=True)
class Exhibit:
    """A surface on the stage.

    fitted: whether to give it a tolerance that suits its size in place of its own.
    """

    surface: LevelSet
    material: Material
    fitted: bool = False


@dataclass(frozen=True)
class Studio:
    """A scene dictionary, and the length in it of a unit of the surfaces' coordinates."""

    scene: dict[str, Any]
    unit: float


def studio(
    mi: Any,
    exhibits: Sequence[Exhibit],
    *,
    size: tuple[int, int],
    camera: Camera,
    backdrop: str = "light",
    bare: bool = False,
) -> Studio:
    """Surfaces on the stage, seen in a picture of (width, height) pixels.

    bare: only surfaces and camera, without ground and lights.
    """
    backend = mitsuba_backend(mi)
    points = np.concatenate([visible_points(one.surface, backend) for one in exhibits])
    placement = on_ground(points)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "clamp": _CLAMP},
        "sensor": _sensor(mi, camera, placement.apply(points), size),
    }
    for k, one in enumerate(exhibits):
        surface = one.surface
        if one.fitted:
            surface = replace(surface, tolerance=Tolerance(_TOLERANCE / placement.scale))
        bsdf = one.material.bsdf(solid=surface.solid is not None)
        scene[f"surface{k}"] = shape(surface, bsdf=bsdf, to_world=placement.matrix)
    if not bare:
        scene |= {**ground(mi, backdrop), **lights(mi, camera.azimuth)}
    return Studio(scene, placement.scale)


def stratified(spp: int) -> int:
    """The samples a pixel, at least `spp`, that the studio's sampler can arrange in a grid."""
    rows = max(1, math.isqrt(spp))
    return rows * -(-spp // rows)


def on_ground(points: FloatArray) -> Placement:
    """Scales points (n, 3) to half a diagonal of 1 and puts them on the ground."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    scale = 2.0 / max(float(np.linalg.norm(upper - lower)), 1e-30)
    foot = np.array([*(lower + upper)[:2] / 2, lower[2]])
    return Placement(scale, np.eye(3), -scale * foot)


def _sensor(mi: Any, camera: Camera, points: FloatArray, size: tuple[int, int]) -> dict[str, Any]:
    origin, target = camera.fit(points, size)
    _, up, _ = camera.frame()
    look = mi.ScalarTransform4f().look_at(
        origin=origin.tolist(), target=target.tolist(), up=up.tolist()
    )
    return {
        "type": "perspective",
        "fov": camera.fov,
        "fov_axis": "larger",
        "near_clip": 1e-3,
        "to_world": look,
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": "gaussian"},
            "pixel_format": "luminance" if mi.is_monochromatic else "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "multijitter", "sample_count": 64},
    }
