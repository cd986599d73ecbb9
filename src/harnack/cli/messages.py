"""What a command prints of errors and names: one line, in the words of the command line."""

from __future__ import annotations

import re

from harnack.rendering import UnboundedSurfaceError

# Python's arguments as messages write them, and the options they are on the command line.
_OPTIONS = re.compile(r'\b(as_|normals|show|material|up|of)="([\w-]+)"')

_WORDS = {
    "boundary=True": "--boundary", "up= ": "--up ", "max_triangles": "--max-triangles",
    " (apply_translation), or scale it (apply_scale)": ", or scale it (--scale)",
}  # fmt: skip


def error_line(error: Exception) -> str:
    """'error: ...' for an exception, printable and on one line."""
    return printable(re.sub(r"\s*\n\s*", " ", f"error: {_explanation(error)}".strip()))


def printable(text: str) -> str:
    """Text on one line whose control characters, which terminals obey, are written as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _explanation(error: Exception) -> str:
    if isinstance(error, UnboundedSurfaceError):
        if error.usual is not None:
            return f"{error.reason}; choose another --level, such as {level_text(error.usual)}"
        return f"{error.reason}; cut it, such as by --ball 0,0,0,2"
    if isinstance(error, MemoryError):
        return f"there is not enough memory: choose a smaller --size ({error})"
    return in_options(str(error))


def in_options(text: str) -> str:
    """A message of the library, with options of the command line for arguments of Python."""
    text = _OPTIONS.sub(lambda found: f"--{found[1].rstrip('_')} {found[2]}", text)
    for written, option in _WORDS.items():
        text = text.replace(written, option)
    return text


def level_text(level: float | None) -> str:
    """A level as one writes it on the command line: "2pi", "0.5"."""
    ratio = (level or 0.0) / 3.141592653589793
    if ratio and abs(2 * ratio - round(2 * ratio)) < 1e-9:
        return f"{ratio:g}pi" if ratio != 1 else "pi"
    return f"{level:g}"
