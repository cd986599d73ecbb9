"""Pictures: our surfaces in Mitsuba scenes, and a studio that makes a picture by itself."""

from __future__ import annotations

from harnack.rendering.arguments import SHOW_MODES
from harnack.rendering.film import animate
from harnack.rendering.mitsuba.plugins import register, register_surfaces
from harnack.rendering.mitsuba.shapes import shape
from harnack.rendering.picture import render
from harnack.rendering.pictures.picture_array import Picture
from harnack.rendering.studio.camera import Camera
from harnack.rendering.studio.materials import MATERIALS, Material
from harnack.rendering.surfaces.extent import UnboundedSurfaceError
from harnack.rendering.surfaces.isolines import Isolines

__all__ = [
    "MATERIALS",
    "SHOW_MODES",
    "Camera",
    "Isolines",
    "Material",
    "Picture",
    "UnboundedSurfaceError",
    "animate",
    "register",
    "register_surfaces",
    "render",
    "shape",
]
