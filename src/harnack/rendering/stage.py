"""A small photo studio for surfaces: it chooses ground, lights, materials, and a camera that frames
the surfaces, and makes a Mitsuba scene of them. A BSDF dictionary describes in Mitsuba how a
surface scatters light. `mi` is the Mitsuba module.

Surfaces are scaled to a radius of about 1 and stand on the ground z = 0, so that lights, shadows
and the tolerances of Mitsuba's rays suit surfaces of every size. The stage is this scaled world.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.name_suggestions import did_you_mean
from harnack.rendering.backdrops import FLOOR_HEIGHT, Backdrop, GroundBackdrop, ground, lights
from harnack.rendering.camera import Camera, CameraPose
from harnack.rendering.framing import (
    check_drawable_size,
    check_offset,
    rotation_to_z_up,
    visible_points,
)
from harnack.rendering.isolines import Isolines
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.mitsuba_plugins import mitsuba_shape
from harnack.rendering.placed_surface import Placement
from harnack.rendering.scales import NAMED_COLORS, Color, linear_from_srgb, parse_color
from harnack.tracer import HitTolerance, TracedSurface

Dictionary = dict[str, Any]

# The roughness of a material given by its color alone, between porcelain and eggshell; and its
# least and greatest reflectance, as no paint reflects no light, or all.
_PAINT, _BLACK, _WHITE = 0.2, 0.005, 0.9


def _rgb(color: Color) -> Dictionary:
    """Return the dictionary of a linear sRGB color in Mitsuba."""
    return {"type": "rgb", "value": list(color)}


def _coated(color: Color, roughness: float) -> Dictionary:
    """Return the BSDF dictionary of a colored base under a rough clear coat.

    color: the linear sRGB reflectance of the base.
    roughness: of the coat, Mitsuba's `alpha`: 0 is smooth, and 0.5 is very rough.
    """
    return {
        "type": "roughplastic",
        "diffuse_reflectance": _rgb(color),
        "alpha": roughness,
        # Light that is reflected to and fro under the coat takes on more of the base's color.
        "nonlinear": True,
    }


def _metal(name: str, roughness: float) -> Dictionary:
    """Return the BSDF dictionary of a rough metal.

    name: its symbol in Mitsuba, such as "Au".
    roughness: Mitsuba's `alpha`: 0 is smooth, and 0.5 is very rough.
    """
    return {"type": "roughconductor", "material": name, "alpha": roughness, "distribution": "ggx"}


@dataclass(frozen=True)
class Material:
    """The material of a surface.

    front: the BSDF dictionary of the side of larger values, to which the normal points; of a solid,
        its outside.
    back: the BSDF dictionary of the other side of an open surface; None for the same as the front.
    two_sided: whether open surfaces are to be wrapped such that they are seen from both sides. A
        BSDF that takes care of that itself does not need it.
    transparent: whether light passes through it, so that only a solid can have it.
    tint: the fractions of red, green and blue light that are left after one unit of length on the
        stage, on which half the diagonal of the box of all objects is 1; None for all of the light.
    """

    front: Dictionary
    back: Dictionary | None = None
    two_sided: bool = True
    transparent: bool = False
    tint: Color | None = None

    def __post_init__(self) -> None:
        if self.tint is not None and not self.transparent:
            raise ValueError(
                "tint needs a material that light passes through: give transparent=True too"
            )

    def bsdf(self, *, solid: bool, traced_light: bool = True) -> Dictionary:
        """Return the BSDF dictionary for a surface of this material.

        solid: whether the surface is the boundary of a solid; otherwise it is open.
        traced_light: whether light paths are to be traced at it. Otherwise only its diffuse
            reflectance and whether it is glossy or transparent are needed, and the dictionary may
            describe a similar BSDF that Mitsuba loads faster.

        Raises:
            ValueError: the material is transparent, and the surface is open.
        """
        front, back = self.front, self.back
        if not traced_light:  # a missing back stays None
            front, back = _without_table(front), back and _without_table(back)
        if solid:
            return front
        if self.transparent:
            raise ValueError(
                "light passes through this material, so the surface needs an inside: give "
                'side="below" or side="above"'
            )
        if not self.two_sided:
            return front
        nested: Dictionary = {"type": "twosided", "front": front}
        return nested if back is None else {**nested, "back": back}


MaterialLike = str | Color | Material | Mapping[str, Any]


def _without_table(bsdf: Dictionary) -> Dictionary:
    """Return a BSDF dictionary with the same diffuse reflectance that Mitsuba loads faster. A rough
    coat is replaced by a smooth one, for which Mitsuba need not compute a table of transmittances.
    Other dictionaries are returned unchanged."""
    # Only dictionaries with the entries of `_coated` are known well enough.
    if bsdf.keys() != _coated((0, 0, 0), 0).keys() or bsdf["type"] != "roughplastic":
        return bsdf
    return {**{key: bsdf[key] for key in bsdf if key != "alpha"}, "type": "plastic"}


def _tinted(tint: Color, index: float = 1.5) -> Material:
    """Return the material of glass that absorbs some of the light.

    tint: the fractions of red, green and blue light that are left after one unit of length.
    index: the index of refraction.
    """
    glass: Dictionary = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
    return Material(glass, transparent=True, tint=tint)


def _painted(color: Color) -> Material:
    """Return the material for a color in linear sRGB: paint under a clear coat."""
    red, green, blue = (max(_WHITE * channel, _BLACK) for channel in color)
    return Material(_coated((red, green, blue), _PAINT))


MATERIALS: Mapping[str, Material] = {
    "two-tone": Material(_coated((0.80, 0.255, 0.11), 0.22), _coated((0.07, 0.25, 0.40), 0.22)),
    "eggshell": Material(_coated((0.66, 0.13, 0.06), 0.3), _coated((0.80, 0.74, 0.64), 0.3)),
    "clay": Material({"type": "diffuse", "reflectance": _rgb((0.72, 0.62, 0.53))}),
    "porcelain": Material(_coated((0.84, 0.83, 0.80), 0.06)),
    "plastic": Material(_coated((0.62, 0.05, 0.07), 0.10)),
    "gold": Material(_metal("Au", 0.10)),
    "copper": Material(_metal("Cu", 0.12)),
    "silver": Material(_metal("Ag", 0.12)),
    "glass": Material({"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, transparent=True),
    "frosted": Material(
        {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.12}, transparent=True
    ),
    "amber": _tinted((0.86, 0.42, 0.06)),
    "cobalt": _tinted((0.10, 0.24, 0.72)),
    "jelly": _tinted((0.80, 0.12, 0.16), 1.35),
}
"""Materials by name, that look well in the studio."""


def parse_material(material: Any, option: str = "material") -> Material:
    """Return the `Material` that the value of an option describes: None for the default, a name, a
    color, a `Material`, or a BSDF dictionary, which is used unchanged.

    option: the name of the option, for messages.

    Raises:
        TypeError: it is none of these.
        ValueError: there is no material or color of that name.
    """
    if material is None:
        return MATERIALS["two-tone"]
    if isinstance(material, Material):
        return material
    if isinstance(material, Mapping):
        return Material(dict(cast("Mapping[str, Any]", material)), two_sided=False)
    if isinstance(material, str) and material.strip().lower() in MATERIALS:
        return MATERIALS[material.strip().lower()]
    try:
        return _painted(linear_from_srgb(parse_color(material, option)))
    except TypeError:
        raise TypeError(
            f"{option} must be a name, a color, a Material or a BSDF dictionary, not {material!r}; "
            f"there are {', '.join(MATERIALS)}"
        ) from None
    except ValueError:
        raise ValueError(
            f"unknown {option} {material!r}; there are {', '.join(MATERIALS)}, and colors, by a "
            f'name of CSS, "#rrggbb" or three numbers from 0 to 1'
            f"{did_you_mean(material, (*MATERIALS, *NAMED_COLORS))}"
        ) from None


# The default number of samples a pixel.
STUDIO_SPP = 64
# Default tolerances, in the stage's unit: of surfaces, and of unions of patches. These have edges
# inside the picture, where two patches meet: hits within the tolerance of such an edge have the
# normal of neither.
_TOLERANCE, _PATCH_TOLERANCE = 1e-4, 1e-5
# The largest light of a path, where white is 1.
_CLAMP = 2.0
# Rays begin at most twice _NEAR_CLIP_STEP before the stage. Clip distances are literals of kernels:
# as whole multiples they are the same for almost all cameras, whose pictures so share their
# kernels.
_NEAR_CLIP_STEP, _FAR_CLIP = 60.0, 2e4
_MAX_CAMERA_DISTANCE = 5e3
_LIGHT = GroundBackdrop("light")


@dataclass(frozen=True)
class StudioObject:
    """A surface in the studio, with its material.

    surface: if it has no tolerance, it gets one that suits the size of the drawn surfaces.
    section_material: the material of the faces at which a section cuts a solid; None for the
        material of the rest.
    isolines: lines to draw on it.
    """

    surface: TracedSurface
    material: Material
    section_material: Material | None = None
    isolines: tuple[Isolines, ...] = ()


@dataclass(frozen=True)
class StudioScene:
    """A scene of the studio, in which surfaces are scaled and stand on the ground.

    scene: the dictionary that describes it for Mitsuba.
    placement: the map from the coordinates of the surfaces to the world.
    backdrop: the backdrop that was passed to `build_studio`.
    azimuth: of the camera, in degrees.
    has_ground: whether the surfaces stand on a floor.
    """

    scene: dict[str, Any]
    placement: Placement
    backdrop: Backdrop
    azimuth: float
    has_ground: bool


def build_studio(
    mi: Any,
    studio_objects: Sequence[StudioObject],
    *,
    size: tuple[int, int],
    camera: Camera,
    backdrop: Backdrop = _LIGHT,
    up: Any = "z",
    surfaces_only: bool = False,
    traced_light: bool = True,
) -> StudioScene:
    """Put surfaces, ground, lights and a camera into a scene, for a picture of `size`
    (width, height) pixels. Returns the `StudioScene`.

    studio_objects: the surfaces with their materials.
    camera: from where the surfaces are seen; what it leaves open is chosen such that they fill the
        picture.
    backdrop: what is seen behind the surfaces.
    up: the direction, in the coordinates of the surfaces, that is up in the studio, as
        `rotation_to_z_up` takes it.
    surfaces_only: whether to leave out ground and lights.
    traced_light: whether the picture follows light paths, and so needs complete materials.
    """
    backend = mitsuba_backend(mi)
    # What fills the picture: the visible points of all surfaces, or the box that the camera names.
    if camera.box is None:
        points = np.concatenate(
            [visible_points(element.surface, backend) for element in studio_objects]
        )
    else:
        points = corners_of(np.array(camera.box.bounds()))
    placement = stage_placement(points, rotation_to_z_up(up))
    pose = camera.pose(placement.apply(points), size, placement.apply)
    # The path tracer of this library, which sees level sets, draws the scene. It limits the light
    # of a path ("clamp"), and the camera does not see the lights themselves.
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "harnack_path",
            "clamp": _CLAMP,
            "hide_emitters": True,
        },
        "sensor": _sensor(mi, pose, size),
    }
    for k, element in enumerate(studio_objects):
        surface = element.surface
        if surface.tolerance is None:
            # The default tolerance is a length on the stage; the surface needs it in its own
            # coordinates.
            length = _PATCH_TOLERANCE if surface.field.traits.has_patches else _TOLERANCE
            surface = replace(surface, tolerance=HitTolerance(length / placement.scale))
        bsdf = element.material.bsdf(
            solid=surface.solid_range is not None, traced_light=traced_light
        )
        section_bsdf = (
            None
            if element.section_material is None
            else element.section_material.bsdf(solid=True, traced_light=traced_light)
        )
        scene[f"surface{k}"] = mitsuba_shape(
            surface, bsdf=bsdf, to_world=placement.matrix, tint=element.material.tint,
            section_bsdf=section_bsdf, isolines=element.isolines,
        )  # fmt: skip
    has_ground = False
    if not surfaces_only:
        scene |= lights(mi, pose.azimuth)
        if isinstance(backdrop, GroundBackdrop) and pose.origin[2] > FLOOR_HEIGHT:
            has_ground = True  # from below, it would hide everything
            scene |= ground(mi, backdrop.name)
    return StudioScene(scene, placement, backdrop, pose.azimuth, has_ground)


def corners_of(ends: FloatArray) -> FloatArray:
    """Return the corners (8, 3) of a box with opposite corners `ends` (2, 3).

    Raises:
        ValueError: the box has a size that pictures cannot show.
    """
    check_drawable_size(ends)
    return np.array(list(itertools.product(*ends.T)))


def stage_placement(points: FloatArray, turned: FloatArray | None = None) -> Placement:
    """Return the placement of surfaces in the studio: the map that rotates them, scales them such
    that half the diagonal of their box is 1, and puts them on the ground.

    points: (n, 3) points of the surfaces; the box is that of these points, after the rotation.
    turned: the rotation (3, 3); None for no rotation.

    Raises:
        ValueError: they are too far from the origin for their size (`check_offset`).
    """
    check_offset(points)
    turned = np.eye(3) if turned is None else turned
    points = points @ turned.T
    lower, upper = points.min(axis=0), points.max(axis=0)
    # The points may all be the same.
    scale = 2.0 / max(float(np.linalg.norm(upper - lower)), 1e-30)
    # The middle of the box's base is placed at the origin of the world.
    base_point = np.array([*(lower + upper)[:2] / 2, lower[2]])
    return Placement(scale, turned, -scale * base_point)


def _sensor(mi: Any, pose: CameraPose, size: tuple[int, int]) -> dict[str, Any]:
    """Return the dictionary of the camera for Mitsuba, at the position and with the orientation of
    `pose`. size: (width, height) of the picture in pixels.

    Raises:
        ValueError: the camera is too far away for single precision.
    """
    # Rays begin near the stage, however far the camera is: their origins are rounded.
    distance = float(np.linalg.norm(pose.origin))
    if distance > _MAX_CAMERA_DISTANCE:
        raise ValueError(
            f"the camera is {distance:,.0f} times as far away as the surface is large; pictures "
            f"are computed in single precision, which reaches to {_MAX_CAMERA_DISTANCE:,.0f} times"
        )
    to_world = mi.ScalarTransform4f().look_at(
        origin=pose.origin.tolist(), target=pose.target.tolist(), up=pose.up.tolist()
    )
    return {
        "type": "perspective",
        "fov": pose.fov,
        "fov_axis": "larger",
        # Rays begin one to two steps before the stage, at a whole multiple of a step, since the
        # distance is a literal of kernels. It must be positive.
        "near_clip": max(1e-3, _NEAR_CLIP_STEP * (distance // _NEAR_CLIP_STEP - 1)),
        "far_clip": _FAR_CLIP,
        "to_world": to_world,
        "film": {
            "type": "hdrfilm",
            "width": size[0],
            "height": size[1],
            "rfilter": {"type": "gaussian"},
            "pixel_format": "luminance" if mi.is_monochromatic else "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "multijitter", "sample_count": STUDIO_SPP},
    }
