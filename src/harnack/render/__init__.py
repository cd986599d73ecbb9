"""Pictures: our surfaces in Mitsuba scenes, and a studio that makes a picture by itself."""

from __future__ import annotations

from harnack.render.carrier import shape
from harnack.render.materials import MATERIALS, Material
from harnack.render.picture import SHOW_MODES, render
from harnack.render.plugins import register, register_surfaces
from harnack.render.studio import Camera

__all__ = [
    "MATERIALS",
    "SHOW_MODES",
    "Camera",
    "Material",
    "register",
    "register_surfaces",
    "render",
    "shape",
]
