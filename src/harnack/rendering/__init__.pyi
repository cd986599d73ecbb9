"""The names of the package, and where they are."""

from .animation import animate
from .camera import Camera
from .framing import UnboundedSurfaceError
from .images import Picture
from .isolines import Isolines
from .mitsuba_plugins import mitsuba_shape, register
from .picture import render
from .render_options import SHOW_MODES
from .stage import MATERIALS, Material

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
