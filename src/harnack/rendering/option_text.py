"""Parsers of the values of options as people write them on a command line, such as "2pi" or
"800x600".

Each function raises ValueError, with a sentence that says how the value is written.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

from harnack.enclosures.selection import ENCLOSURE_NAMES
from harnack.geometry import Ball, Box, HalfSpace, Volume
from harnack.name_suggestions import did_you_mean
from harnack.rendering.backdrops import IMAGE_FILES, parse_backdrop
from harnack.rendering.isolines import Isolines
from harnack.rendering.scales import parse_color
from harnack.rendering.stage import parse_material

# The number of characters of an argument that messages repeat.
_SHOWN = 60
_AXES = ("x", "y", "z", "-x", "-y", "-z")


def quoted(text: str) -> str:
    """Return the text in quotes, for messages; only its beginning if it is long."""
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")


def parse_choice(*names: str) -> Callable[[str], str]:
    """Return a parser that accepts one of several names and returns it."""

    def choice(text: str) -> str:
        """Return the text, if it is one of the names."""
        if text not in names:
            raise ValueError(
                f"{quoted(text)} is none of {', '.join(names)}{did_you_mean(text, names)}"
            )
        return text

    return choice


parse_enclosures = parse_choice(*ENCLOSURE_NAMES)
parse_axis = parse_choice(*_AXES)


def parse_number(text: str) -> float:
    """Return the finite number that a text holds, as a float."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{quoted(text)} must be a finite number")
    return number


def parse_positive(text: str) -> float:
    """Return the positive number that a text holds, as a float."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise ValueError(f"{quoted(text)} must be a positive number")
    return number


def parse_count(text: str) -> int:
    """Return the whole number from 1 to 999999999 that a text holds."""
    number = int(text) if re.fullmatch(r"[0-9]{1,9}", text) else 0
    if number < 1:
        raise ValueError(f"{quoted(text)} must be a whole number from 1 to 999999999")
    return number


def parse_integer(text: str) -> int:
    """Return the integer of at most 18 digits that a text holds."""
    if not re.fullmatch(r"[+-]?[0-9]{1,18}", text):
        raise ValueError(f"{quoted(text)} must be an integer of at most 18 digits")
    return int(text)


def parse_port(text: str) -> int:
    """Return the number of a network port, from 0 to 65535, that a text holds."""
    if not re.fullmatch(r"[0-9]{1,5}", text) or int(text) > 65535:
        raise ValueError(f"{quoted(text)} must be a number from 0 to 65535")
    return int(text)


def parse_level(text: str, kind: str = "level") -> float:
    """Return the level (value of the field) that a text holds: a finite number, or a multiple of pi
    such as "2pi", "1.5*pi" or "-pi/2".

    kind: what a message calls the text: another number may be written in the same way.
    """
    # A factor, pi and a divisor; each of them may be missing.
    match = re.fullmatch(
        r"([+-]?[\d.]*(?:e[+-]?\d+)?)\s*\*?\s*(pi)?\s*(?:/\s*([\d.]+))?", text.strip()
    )
    try:
        if not match:
            raise ValueError
        factor, has_pi, divisor = match.groups()
        if factor in ("", "+", "-"):
            if not has_pi:
                raise ValueError
            # "pi" and "-pi" have the factor 1 and -1.
            factor += "1"
        level = float(factor) * (math.pi if has_pi else 1.0) / float(divisor or 1.0)
        if not math.isfinite(level):
            raise ValueError
        return level
    except (ValueError, ZeroDivisionError):
        raise ValueError(f"{quoted(text)} is no {kind}; write 0.5, 2pi or pi/3") from None


def parse_levels(text: str) -> float | list[float]:
    """Return the level (value of the field) that a text holds, or a list of several levels
    separated by commas."""
    levels = [parse_level(part) for part in text.split(",")]
    return levels if len(levels) > 1 else levels[0]


def parse_range(text: str) -> tuple[float, float]:
    """Return the two ends of a range, such as (-0.3, 0.3) for "-0.3:0.3". Multiples of pi are
    understood."""
    low, colon, high = text.partition(":")
    if not colon:
        raise ValueError(f"{quoted(text)}: write two values as -0.3:0.3")
    ends = parse_level(low, "number"), parse_level(high, "number")
    if not ends[0] < ends[1]:
        raise ValueError(f"{quoted(text)}: the first value must be the lower one")
    return ends


def parse_size(text: str) -> tuple[int, int]:
    """Return the width and height in pixels, such as (800, 600) for "800x600"."""
    match = re.fullmatch(r"([0-9]{1,9})[xX]([0-9]{1,9})", text)
    if not match:
        raise ValueError(f"{quoted(text)} is no size; write it as 800x600")
    return int(match[1]), int(match[2])


def parse_numbers(text: str, count: int) -> tuple[float, ...]:
    """Return a tuple of `count` finite numbers, which the text separates by commas."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{quoted(text)} must be {count} numbers with commas")
    return numbers


def parse_point(text: str) -> tuple[float, ...]:
    """Return the coordinates of a point, such as (1.0, 0.0, 2.0) for "1,0,2"."""
    return parse_numbers(text, 3)


def parse_clip(text: str) -> Volume:
    """Return the volume that a text such as "ball:0,0,0,1" or "box:-1,-1,-1,1,1,1" describes."""
    kind, colon, rest = text.partition(":")
    if not colon or kind not in ("ball", "box"):
        raise ValueError(
            f"{quoted(text)} is no volume; write ball:X,Y,Z,RADIUS, such as ball:0,0,0,1, or "
            "box:X,Y,Z,X,Y,Z, such as box:-1,-1,-1,1,1,1"
        )
    if kind == "ball":
        x, y, z, radius = parse_numbers(rest, 4)
        return Ball((x, y, z), radius)
    x0, y0, z0, x1, y1, z1 = parse_numbers(rest, 6)
    return Box((x0, y0, z0), (x1, y1, z1))


def parse_section(text: str) -> HalfSpace:
    """Return the half-space that a text such as "0,0,1" or "0,0,1,0.2" describes: the side of a
    plane away from the vector of the first three numbers. The fourth number is the distance of the
    plane from the origin, by default 0."""
    plane = parse_numbers(text, 4 if text.count(",") == 3 else 3)
    x, y, z = plane[:3]
    if not any((x, y, z)):
        raise ValueError(f"{quoted(text)}: the vector must not be zero")
    return HalfSpace((x, y, z), plane[3] if len(plane) == 4 else 0.0)


def parse_formula(text: str) -> str:
    """Return the text itself, if it is a formula of x, y and z."""
    from harnack.fields.expressions import TextFormula  # imported here: few pictures need it

    TextFormula.parse(text)
    return text


def parse_isolines_text(text: str) -> Isolines:
    """Return the isolines that a text such as "z:0.1" describes: those of z at all multiples of
    0.1."""
    formula, colon, interval = text.rpartition(":")
    if not colon:
        raise ValueError(
            f"{quoted(text)}: write a coordinate or a formula, and an interval, as z:0.1"
        )
    return Isolines(parse_formula(formula), interval=parse_positive(interval))


def parse_material_name(text: str) -> str:
    """Return the text itself, if it is the name of a material, or a color."""
    parse_material(text)
    return text


def parse_color_name(text: str) -> str:
    """Return the text itself, if it is the name of a color or "#rrggbb"."""
    parse_color(text, "a color")
    return text


def parse_backdrop_text(text: str) -> Any:
    """Return the value of the option `backdrop` of `render` that a text describes: a name, a color,
    two colors separated by a comma, or the file of an image."""
    parts = [part.strip() for part in text.split(",")]
    is_file = text.lower().endswith(IMAGE_FILES)
    backdrop: Any = text if is_file or len(parts) != 2 else tuple(parts)
    parse_backdrop(backdrop)
    return backdrop
