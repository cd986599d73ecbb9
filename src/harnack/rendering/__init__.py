"""Renders pictures of surfaces, which are level sets of fields: inside Mitsuba scenes, or in a
studio that sets up lights, ground and camera by itself."""

from __future__ import annotations

from harnack.rendering.animation import animate
from harnack.rendering.camera import Camera
from harnack.rendering.framing import UnboundedSurfaceError
from harnack.rendering.images import Picture
from harnack.rendering.isolines import Isolines
from harnack.rendering.mitsuba_plugins import mitsuba_shape, register
from harnack.rendering.picture import render
from harnack.rendering.render_options import SHOW_MODES
from harnack.rendering.stage import MATERIALS, Material

__all__ = [
    "MATERIALS",
    "SHOW_MODES",
    "Camera",
    "Isolines",
    "Material",
    "Picture",
    "UnboundedSurfaceError",
    "animate",
    "mitsuba_shape",
    "register",
    "render",
]
