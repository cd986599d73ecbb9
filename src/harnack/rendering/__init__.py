"""Pictures: our surfaces in Mitsuba scenes, and a studio that makes a picture by itself."""

from __future__ import annotations

from harnack.rendering.arguments import SHOW_MODES
from harnack.rendering.carrier import shape
from harnack.rendering.extent import UnboundedSurfaceError
from harnack.rendering.materials import MATERIALS, Material
from harnack.rendering.picture import render
from harnack.rendering.plugins import register, register_surfaces
from harnack.rendering.studio import Camera

__all__ = [
    "MATERIALS",
    "SHOW_MODES",
    "Camera",
    "Material",
    "UnboundedSurfaceError",
    "register",
    "register_surfaces",
    "render",
    "shape",
]
