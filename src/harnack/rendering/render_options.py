"""Checks of the options of pictures, made before anything is drawn. Each check returns the value in
its final form, or raises an error that names the option. The first parameter is the value that the
caller gave to the option of the same name, or the option's default. `show` is the kind of the
picture, such as "path" for path tracing or "depth"."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from harnack.backend.validation import as_integer_in_range
from harnack.fields import Field
from harnack.name_suggestions import did_you_mean, with_article
from harnack.rendering.aov_render import AOV_BACKGROUNDS, AOV_MODES, MODES_WITH_SCALE
from harnack.rendering.backdrops import Backdrop, GradientBackdrop, GroundBackdrop, parse_backdrop
from harnack.rendering.camera import Camera
from harnack.rendering.isolines import Isolines, as_field, parse_isolines
from harnack.rendering.scales import require_pillow, typeface_for

SHOW_MODES: tuple[str, ...] = ("path", "shaded", *AOV_MODES)
# Pictures that may have isolines.
MODES_WITH_ISOLINES = ("path", "shaded", "value")
ANTIALIASING = ("edges", "cones")
MAX_SIDE = 32768
MAX_SPP = 1_000_000
_MAX_CHUNKS = 1_000_000
# The largest number that the path tracer's counters hold.
_MAX_INTEGER = 2**31 - 1
# Peak memory in bytes per pixel, measured at 2048 x 2048 and 4096 x 4096, rounded up.
_BYTES = {"path": 50, "shaded": 280, "value": 240}
_AOV_BYTES = 130


def check_max_depth(max_depth: Any, show: str) -> int | None:
    """Return max_depth, the largest number of edges of a light path (-1 for no limit), as an int.
    Returns None if the option is not set (None); then the scene or a default decides.

    Raises:
        ValueError: it is set, and a picture of this kind has no light paths; or it is too
            large.
        TypeError: not an integer.
    """
    if max_depth is None:
        return None
    _check_has_paths("max_depth", show)
    return check_integer("max_depth", max_depth)


def check_denoise(denoise: Any, show: str) -> bool:
    """Return whether to take the noise out of a picture.

    Raises:
        ValueError: that is requested for a picture without noise.
        TypeError: neither True nor False.
    """
    if not isinstance(denoise, bool):
        raise TypeError(f"denoise must be True or False, not {denoise!r}")
    if denoise:
        _check_has_paths("denoise", show)
    return denoise


def _check_has_paths(setting: str, show: str) -> None:
    """Raise ValueError if a picture of the kind `show` has no light paths. setting: the name of the
    option that needs them."""
    if show != "path":
        raise ValueError(f'{setting} needs a picture with show="path", not show="{show}"')


def check_isolines(isolines: Any, show: str) -> tuple[Isolines, ...]:
    """Return the value of the option `isolines` as a tuple of `Isolines`.

    Raises:
        TypeError: it is no `Isolines` and no list of them.
        ValueError: the picture cannot show isolines.
    """
    lines = parse_isolines(isolines)
    if lines and show not in MODES_WITH_ISOLINES:
        raise ValueError(
            f'isolines need a picture with show={_join_or(MODES_WITH_ISOLINES)}, not "{show}"'
        )
    return lines


def check_color_by(color_by: Any, show: str) -> Field | None:
    """Return the function whose values a picture shows, as a field; None for other pictures.

    Raises:
        ValueError: it is missing, or given for another kind of picture.
        TypeError: it is no function on space.
    """
    if show != "value":
        if color_by is not None:
            raise ValueError(f'color_by needs a picture with show="value", not show="{show}"')
        return None
    if color_by is None:
        raise ValueError(
            'show="value" needs the function whose values are shown on the surface, such as '
            'color_by="z", another field, or a function of x, y and z'
        )
    return as_field(color_by, "color_by")


def check_color_range(color_range: Any, show: str) -> tuple[float, float] | None:
    """Return the numbers (low, high) at the ends of the color scale; None if the option is not set,
    so that the ends are the least and the greatest number that is seen.

    Raises:
        ValueError: it is set, and a picture of this kind has no color scale; or the ends are not in
            order.
        TypeError: not two numbers.
    """
    if color_range is None:
        return None
    _check_scaled("color_range", show)
    wrong = f"color_range must be (low, high), two finite numbers in order, not {color_range!r}"
    try:
        low, high = (float(end) for end in color_range)
    except (TypeError, ValueError):
        raise TypeError(wrong) from None
    if not (low < high and math.isfinite(high - low)):
        raise ValueError(wrong)
    return low, high


def check_color_bar(color_bar: Any, show: str) -> bool | str:
    """Return whether to draw a color bar; a text is the title of the bar.

    Raises:
        ValueError: the picture has no color scale, or the title cannot be written.
        TypeError: neither a bool nor a text.
        ModuleNotFoundError: Pillow is not installed.
    """
    if not isinstance(color_bar, bool | str):
        raise TypeError(f"color_bar must be True, False or the bar's title, not {color_bar!r}")
    if color_bar:
        _check_scaled("color_bar", show)
        require_pillow()
    if isinstance(color_bar, str):
        if not color_bar.isprintable():
            raise ValueError(f"the title of a color bar is one line of letters, not {color_bar!r}")
        # Raises the error of letters that cannot be written, whatever their size (here 10 pixels).
        typeface_for(color_bar, 10)
    return color_bar


def check_backdrop(backdrop: Any, show: str) -> Backdrop:
    """Return the backdrop of a picture, by default the studio's light floor. Pictures of numbers
    (`AOV_MODES`) have one color behind the surfaces.

    Raises:
        TypeError, ValueError: it is no backdrop, or not one color where that is required.
    """
    if backdrop is None:
        return GroundBackdrop("light")
    behind = parse_backdrop(backdrop)
    # In place of a ground, pictures of numbers have its color at the bottom and at the top.
    if show in AOV_MODES and isinstance(behind, GroundBackdrop):
        return GradientBackdrop(*(AOV_BACKGROUNDS[behind.name],) * 2)
    if show in AOV_MODES and not (
        isinstance(behind, GradientBackdrop) and behind.bottom == behind.top
    ):
        raise ValueError(
            f'with show="{show}", backdrop must be one color, such as backdrop="white", '
            f"not {backdrop!r}"
        )
    return behind


def _check_scaled(setting: str, show: str) -> None:
    """Raise ValueError if a picture of the kind `show` has no color scale. setting: the name of the
    option that needs one."""
    if show not in MODES_WITH_SCALE:
        raise ValueError(
            f'{setting} needs a picture with show={_join_or(MODES_WITH_SCALE)}, not "{show}"'
        )


def _join_or(names: Sequence[str]) -> str:
    """Return names in quotes, joined by "or"."""
    return " or ".join(f'"{name}"' for name in names)


def check_show(show: Any) -> str:
    """Return the kind of the picture, one of `SHOW_MODES`.

    Raises:
        ValueError: it is unknown.
    """
    if not isinstance(show, str) or show not in SHOW_MODES:
        raise ValueError(
            f"show must be one of {', '.join(SHOW_MODES)}, not {show!r}"
            f"{did_you_mean(show, SHOW_MODES)}"
        )
    return show


def check_antialias(antialias: Any, show: str) -> str | None:
    """Return how pixels of a shaded picture are chosen that get more samples: "edges", "cones", or
    None if the option is not set, which means "edges".

    Raises:
        ValueError: another value, or it is set for another kind of picture.
    """
    if antialias is None:
        return None
    if not isinstance(antialias, str) or antialias not in ANTIALIASING:
        raise ValueError(
            f"antialias must be one of {', '.join(ANTIALIASING)}, not {antialias!r}"
            f"{did_you_mean(antialias, ANTIALIASING)}"
        )
    if show != "shaded":
        raise ValueError(f'antialias needs a picture with show="shaded", not show="{show}"')
    return antialias


def check_image_size(size: Any) -> tuple[int, int]:
    """Return the size of a picture in pixels, (width, height).

    Raises:
        TypeError: not two integers.
        ValueError: a side of no pixels, or of more than MAX_SIDE.
    """
    wrong = f"size must be (width, height) in pixels, such as (800, 600), not {size!r}"
    try:
        width, height = (_index(side) for side in size)
    except (TypeError, ValueError):
        raise TypeError(wrong) from None
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise ValueError(f"{wrong}: each side must be 1 to {MAX_SIDE}")
    return width, height


def check_spp(spp: Any, *, source: str = "") -> int:
    """Return the number of samples per pixel, from 1 to MAX_SPP.

    source: where the number is from, for messages, if it is not from the call.

    Raises:
        TypeError: not an integer.
        ValueError: out of this range.
    """
    number = check_integer("spp", spp)
    if not 1 <= number <= MAX_SPP:
        raise ValueError(f"spp must be at least 1 and at most {MAX_SPP}, not {number}{source}")
    return number


def check_integer(name: str, number: Any) -> int:
    """Return the value of an option as an int. name: of the option.

    Raises:
        TypeError: it is no integer.
        ValueError: a max_depth that is too large for the path tracer's counters.
    """
    try:
        integer = _index(number)
    except TypeError:
        raise TypeError(f"{name} must be an integer, not {number!r}") from None
    if name == "max_depth" and integer > _MAX_INTEGER:
        raise ValueError(f"max_depth must be at most {_MAX_INTEGER}, or -1 for no limit")
    return integer


def check_chunks(chunks: Any, *, is_divided: bool) -> int | None:
    """Return the number of parts into which a picture is divided; None if the option is not set;
    then the number is chosen to suit the workers.

    is_divided: whether it is divided at all, as it is with a client or a checkpoint.

    Raises:
        ValueError: chunks is set for a picture that is not divided, or out of range.
    """
    if chunks is not None and not is_divided:
        raise ValueError("chunks: parts are drawn one by one with a client or a checkpoint only")
    return None if chunks is None else as_integer_in_range(chunks, "chunks", 1, _MAX_CHUNKS)


def _index(number: Any) -> int:
    """Return a number as an int. True and False are no integers here.

    Raises:
        TypeError: it is no integer.
    """
    if isinstance(number, bool | np.bool_):
        raise TypeError
    return operator.index(number)


def check_camera(camera: Any) -> Camera:
    """Return the value of the option `camera` as a `Camera`.

    camera: a `Camera`, the (x, y, z) where a camera stands, or None for the default camera.

    Raises:
        TypeError: anything else.
    """
    if camera is None:
        return Camera()
    if isinstance(camera, Camera):
        return camera
    try:
        # The letters of a text such as "123" are no coordinates: () has the wrong length.
        x, y, z = (float(c) for c in (() if isinstance(camera, str) else camera))
    except (TypeError, ValueError):
        raise TypeError(
            "camera must be a harnack.Camera, such as Camera(azimuth=-50, elevation=28), or the "
            f"(x, y, z) where it stands, not {with_article(type(camera).__name__)} {camera!r}"
        ) from None
    return Camera(position=(x, y, z))


Check = Callable[[Any, str], Any]


def ignoring_mode(check: Callable[[Any], Any]) -> Check:
    """Turn a check of an option's value alone into a check of the value and the kind of the
    picture, which it ignores."""
    return lambda value, show: check(value)


def if_set(check: Callable[[Any], Any]) -> Check:
    """Turn a check of an option's value into a check that leaves None unchanged and ignores the
    kind of the picture."""
    return lambda value, show: None if value is None else check(value)


def unchecked(value: Any, show: str) -> Any:
    """Return the value unchanged: the code that uses the option checks it."""
    del show
    return value


def as_integer(name: str) -> Check:
    """Return a check that the value of the option with this name is an integer."""
    return lambda value, show: check_integer(name, value)


def refuse_studio_options(options: Mapping[str, Any]) -> None:
    """Raise ValueError if options of the studio are set, which a Mitsuba scene does not take.
    options: by name, None if not set."""
    wrong = [name for name, value in options.items() if value is not None]
    if wrong:
        raise ValueError(f"{', '.join(wrong)}: a Mitsuba scene is drawn as it is")


def check_memory(show: str, width: int, height: int) -> None:
    """Raise ValueError for a picture that does not fit into this machine's memory. show: the kind
    of picture, on which the bytes of a pixel depend. width, height: in pixels."""
    needed = width * height * _BYTES.get(show, _AOV_BYTES)
    if width * height > 2**30 or needed > _memory():
        raise ValueError(
            f"a picture of {width}x{height} pixels needs about {needed / 1e9:,.0f} GB of memory, "
            f"and this machine has {_memory() / 1e9:,.0f}: choose a smaller size"
        )


def _memory() -> float:
    """Return the bytes of memory in this machine; infinite if unknown."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf
