"""What `render` is asked for, checked before anything is drawn."""

from __future__ import annotations

import inspect
import math
import operator
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harnack.choices import did_you_mean
from harnack.rendering.pictures.views import VIEWS
from harnack.rendering.studio.camera import Camera
from harnack.rendering.studio.lighting import BACKDROPS
from harnack.tracer import level_set

__all__ = [
    "ANTIALIASING",
    "MAX_SIDE",
    "MAX_SPP",
    "SHOW_MODES",
    "Request",
    "check_backdrop",
    "check_camera",
    "check_integer",
    "check_memory",
    "check_settings",
    "check_show",
    "check_size",
    "check_spp",
    "checked_request",
    "refuse_studio_settings",
]

SHOW_MODES: tuple[str, ...] = ("color", "shaded", *VIEWS)
ANTIALIASING = ("edges", "cones")
MAX_SIDE = 16384
MAX_SPP = 1_000_000
# Of the path tracer's counters.
_MAX_INTEGER = 2**31 - 1
# Bytes a pixel at the peak, measured at 2048 x 2048 and 4096 x 4096, rounded up.
_BYTES = {"color": 50, "shaded": 280}
_BYTES_OF_VIEWS = 130


@dataclass(frozen=True)
class Request:
    """What `render` is asked for, as it is used: sizes and counts are integers, None for unset."""

    show: str
    size: tuple[int, int] | None
    spp: int | None
    max_depth: int | None
    seed: int
    camera: Camera
    backdrop: str
    antialias: str | None = None
    denoise: bool = False


def checked_request(
    *,
    show: Any,
    size: Any,
    spp: Any,
    max_depth: Any,
    seed: Any,
    camera: Any,
    backdrop: Any,
    antialias: Any = None,
    denoise: Any = False,
) -> Request:
    """What was asked for.

    Raises:
        TypeError, ValueError: naming the argument that is wrong, and what it should be.
    """
    check_show(show)
    check_antialias(antialias, show, spp)
    if not isinstance(denoise, bool):
        raise TypeError(f"denoise must be True or False, not {denoise!r}")
    if denoise and show != "color":
        raise ValueError(f'denoise is of pictures with show="color", not show="{show}"')
    return Request(
        show,
        None if size is None else check_size(size),
        None if spp is None else check_spp(spp),
        None if max_depth is None else check_integer("max_depth", max_depth),
        check_integer("seed", seed),
        Camera() if camera is None else check_camera(camera),
        "light" if backdrop is None else check_backdrop(backdrop),
        antialias,
        denoise,
    )


def check_show(show: Any) -> None:
    """Raise ValueError for what is no mode."""
    if not isinstance(show, str) or show not in SHOW_MODES:
        raise ValueError(
            f"show must be one of {', '.join(SHOW_MODES)}, not {show!r}"
            f"{did_you_mean(show, SHOW_MODES)}"
        )


def check_antialias(antialias: Any, show: str, spp: Any) -> None:
    """Raise ValueError for what is no way to choose pixels, or where there is none to choose."""
    if antialias is None:
        return
    if not isinstance(antialias, str) or antialias not in ANTIALIASING:
        raise ValueError(
            f"antialias must be one of {', '.join(ANTIALIASING)}, not {antialias!r}"
            f"{did_you_mean(antialias, ANTIALIASING)}"
        )
    if show != "shaded":
        raise ValueError(f'antialias is of pictures with show="shaded", not show="{show}"')
    if antialias == "cones" and spp == 1:
        raise ValueError(
            'antialias="cones" finds pixels for more than one sample, and spp is 1: give spp=9, '
            "or leave it away"
        )


def check_size(size: Any) -> tuple[int, int]:
    """A size in pixels.

    Raises:
        TypeError: not two integers.
        ValueError: a side of no pixel, or of more than MAX_SIDE.
    """
    wrong = f"size must be (width, height) in pixels, such as (800, 600), not {size!r}"
    try:
        width, height = (operator.index(side) for side in size)
    except (TypeError, ValueError):
        raise TypeError(wrong) from None
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"{wrong}: each side must be 1 to {MAX_SIDE}")
    return width, height


def check_spp(spp: Any, *, source: str = "") -> int:
    """Samples a pixel. source: of what, if not of the call."""
    number = check_integer("spp", spp)
    if not 1 <= number <= MAX_SPP:
        raise ValueError(f"spp must be at least 1 and at most {MAX_SPP}, not {number}{source}")
    return number


def check_integer(name: str, number: Any) -> int:
    """An integer of any sign.

    Raises:
        TypeError: it is none.
        ValueError: a max_depth beyond what is counted in.
    """
    try:
        integer = operator.index(number)
    except TypeError:
        raise TypeError(f"{name} must be an integer, not {number!r}") from None
    if name == "max_depth" and integer > _MAX_INTEGER:
        raise ValueError(f"max_depth must be at most {_MAX_INTEGER}, or -1 for no limit")
    return integer


def check_camera(camera: Any) -> Camera:
    """A camera, or one at a position (x, y, z)."""
    if isinstance(camera, Camera):
        return camera
    try:
        x, y, z = (float(c) for c in (() if isinstance(camera, str) else camera))
    except (TypeError, ValueError):
        raise TypeError(
            "camera must be a harnack.Camera, such as Camera(azimuth=-50, elevation=28), or the "
            f"(x, y, z) where it stands, not a {type(camera).__name__} {camera!r}"
        ) from None
    return Camera(position=(x, y, z))


def check_backdrop(backdrop: Any) -> str:
    """What is behind the surfaces.

    Raises:
        ValueError: unknown.
    """
    if not isinstance(backdrop, str) or backdrop not in BACKDROPS:
        raise ValueError(
            f"backdrop must be one of {', '.join(BACKDROPS)}, not {backdrop!r}"
            f"{did_you_mean(backdrop, BACKDROPS)}"
        )
    return backdrop


def check_settings(settings: Mapping[str, Any], own: Sequence[str]) -> None:
    """Raise TypeError for a setting that neither `render` (own) nor `level_set` has."""
    of_surface = [name for name in inspect.signature(level_set).parameters if name != "field"]
    for name in settings:
        if name not in of_surface:
            raise TypeError(
                f"there is no setting {name!r}; there are {', '.join(own)} and, of surfaces, "
                f"{', '.join(of_surface)}{did_you_mean(name, (*own, *of_surface))}"
            )


def refuse_studio_settings(given: Mapping[str, Any]) -> None:
    """Settings of the studio make no sense for a scene that has everything already."""
    wrong = [name for name, value in given.items() if value is not None]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: a Mitsuba scene is drawn as it is")


def check_memory(show: str, width: int, height: int) -> None:
    """Raise ValueError for a picture that does not fit into this machine's memory."""
    needed = width * height * _BYTES.get(show, _BYTES_OF_VIEWS)
    if width * height > 2**30 or needed > _memory():
        raise ValueError(
            f"a picture of {width}x{height} pixels needs about {needed / 1e9:,.0f} GB of memory, "
            f"and this machine has {_memory() / 1e9:,.0f}: choose a smaller size"
        )


def _memory() -> float:
    """Bytes of memory in this machine; infinite where that cannot be told."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf
