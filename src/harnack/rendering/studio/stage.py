"""A small photo studio: ground, lights and a camera that frames what stands there.

Surfaces are scaled to a stage of radius about 1 that stands on the ground z = 0, so that lights,
shadows and tolerances of Mitsuba's rays suit every size.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray
from harnack.rendering.mitsuba.shapes import shape
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.studio.backdrops import Backdrop, Ground
from harnack.rendering.studio.camera import Camera, Pose
from harnack.rendering.studio.lighting import FLOOR, ground, lights
from harnack.rendering.studio.upright import upright
from harnack.rendering.surfaces.framing import check_size, visible_points
from harnack.rendering.surfaces.isolines import Isolines
from harnack.rendering.surfaces.placement import Placement
from harnack.tracer import LevelSet, Tolerance

if TYPE_CHECKING:
    from harnack.rendering.studio.materials import Material


# Of fitted surfaces, on the stage. Those of many parts end inside the picture, in the edges of two:
# what a ray meets within the tolerance of such an edge has the normal of neither.
_TOLERANCE, _OF_PARTS = 1e-4, 1e-5
# Light of one path, where white is 1.
_CLAMP = 2.0
# Rays begin at most twice _NEAR before the stage. Clip distances are literals of kernels: as whole
# multiples they are the same for almost all cameras, whose pictures so share their kernels.
_NEAR, _FAR = 60.0, 2e4
_FARTHEST = 5e3
_LIGHT = Ground("light")


@dataclass(frozen=True)
class StudioObject:
    """A surface on the stage.

    fitted: whether to give it a tolerance that suits its size in place of its own.
    cut: the material of the faces on the section of a solid; None for that of the rest.
    isolines: drawn on it.
    """

    surface: LevelSet
    material: Material
    fitted: bool = False
    cut: Material | None = None
    isolines: tuple[Isolines, ...] = ()


@dataclass(frozen=True)
class Studio:
    """A scene dictionary, and what a picture of it needs besides.

    placement: of the surfaces in it. backdrop: as asked for. azimuth: of the camera. has_ground:
        whether the surfaces stand on a floor.
    """

    scene: dict[str, Any]
    placement: Placement
    backdrop: Backdrop
    azimuth: float
    has_ground: bool


def studio(
    mi: Any,
    studio_objects: Sequence[StudioObject],
    *,
    size: tuple[int, int],
    camera: Camera,
    backdrop: Backdrop = _LIGHT,
    up: Any = "z",
    bare: bool = False,
    traced_light: bool = True,
) -> Studio:
    """Surfaces on the stage, seen in a picture of (width, height) pixels.

    up: the direction of the surfaces' coordinates that is up on the stage, as `upright` takes it.
    bare: only surfaces and camera, without ground and lights.
    traced_light: whether the picture follows light paths, and so needs whole materials.
    """
    backend = mitsuba_backend(mi)
    if camera.box is None:
        points = np.concatenate([visible_points(one.surface, backend) for one in studio_objects])
    else:
        points = _corners(np.array(camera.box.bounds()))
    placement = on_ground(points, upright(up))
    pose = camera.pose(placement.apply(points), size, placement.apply)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "harnack_path",
            "clamp": _CLAMP,
            "hide_emitters": True,
        },
        "sensor": _sensor(mi, pose, size),
    }
    for k, one in enumerate(studio_objects):
        surface = one.surface
        if one.fitted:
            close = _OF_PARTS if surface.field.has_parts else _TOLERANCE
            surface = replace(surface, tolerance=Tolerance(close / placement.scale))
        bsdf = one.material.bsdf(solid=surface.solid is not None, traced_light=traced_light)
        cut = None if one.cut is None else one.cut.bsdf(solid=True, traced_light=traced_light)
        scene[f"surface{k}"] = shape(
            surface, bsdf=bsdf, to_world=placement.matrix, tint=one.material.tint, cut_bsdf=cut,
            isolines=one.isolines,
        )  # fmt: skip
    has_ground = False
    if not bare:
        scene |= lights(mi, pose.azimuth)
        if isinstance(backdrop, Ground) and pose.origin[2] > FLOOR:
            has_ground = True  # from below, it would hide everything
            scene |= ground(mi, backdrop.name)
    return Studio(scene, placement, backdrop, pose.azimuth, has_ground)


def _corners(ends: FloatArray) -> FloatArray:
    """Corners (8, 3) of a box (2, 3) of a size that can be drawn."""
    check_size(ends)
    return np.array(list(itertools.product(*ends.T)))


def on_ground(points: FloatArray, turned: FloatArray | None = None) -> Placement:
    """Turns points (n, 3), scales them to half a diagonal of 1 and puts them on the ground."""
    turned = np.eye(3) if turned is None else turned
    points = points @ turned.T
    lower, upper = points.min(axis=0), points.max(axis=0)
    scale = 2.0 / max(float(np.linalg.norm(upper - lower)), 1e-30)
    foot = np.array([*(lower + upper)[:2] / 2, lower[2]])
    return Placement(scale, turned, -scale * foot)


def _sensor(mi: Any, pose: Pose, size: tuple[int, int]) -> dict[str, Any]:
    # Rays begin near the stage, however far the camera is: their origins are rounded.
    away = float(np.linalg.norm(pose.origin))
    if away > _FARTHEST:
        raise ValueError(
            f"the camera is {away:,.0f} times as far away as the surface is large; pictures are "
            f"computed in single precision, which reaches to {_FARTHEST:,.0f} times"
        )
    look = mi.ScalarTransform4f().look_at(
        origin=pose.origin.tolist(), target=pose.target.tolist(), up=pose.up.tolist()
    )
    return {
        "type": "perspective",
        "fov": pose.fov,
        "fov_axis": "larger",
        "near_clip": max(1e-3, _NEAR * (away // _NEAR - 1)),
        "far_clip": _FAR,
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
