"""The messages of the command line: errors, names, and the handling of Ctrl-C while a command runs.

Errors and names are printed on a single line, in the terms of the command line.
"""

from __future__ import annotations

import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

from harnack.rendering import UnboundedSurfaceError
from harnack.rendering.render_options import OPTION_NAMES

# Ctrl-C.

# A terminal and a parent process may both pass on the same Ctrl-C.
_SAME = 1.0


@dataclass
class Interrupts:
    """Whether Ctrl-C was pressed, and when (`time.monotonic`)."""

    pressed: bool = False
    when: float = -_SAME

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt, but not again while the first one is being answered."""
        del number, frame
        now = time.monotonic()
        if self.pressed and now - self.when < _SAME:
            return
        self.pressed, self.when = True, now
        raise KeyboardInterrupt


@contextmanager
def track_interrupts() -> Generator[Interrupts]:
    """Context manager that records Ctrl-C within the block, where signals can be handled (the main
    thread)."""
    interrupts = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield interrupts
        return
    before = signal.signal(signal.SIGINT, interrupts)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)


# Messages.


@contextmanager
def print_warnings() -> Generator[None]:
    """Context manager that prints each warning of the block on a single line, in the terms of the
    command line."""
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def note(message: Any, category: type[Warning], *place: Any, **more: Any) -> None:
            if issubclass(category, UserWarning | RuntimeWarning):
                print(f"note: {python_to_cli_terms(str(message))}", file=sys.stderr)
            else:
                shown(message, category, *place, **more)

        warnings.showwarning = note
        yield


# Arguments of Python that are options of the command line.
_DIFFERENT_CLI_NAMES = (
    "backdrop", "boundary", "camera", "isolines", "max_depth", "progress", "value_range",
)  # fmt: skip
OPTIONS = (
    *(name for name in OPTION_NAMES if name not in _DIFFERENT_CLI_NAMES),
    "bound", "cell_size", "confirm", "keep", "largest", "level", "max_triangles", "normals",
    "read_as", "simplify", "smoothing", "take_boundary", "tolerance",
)  # fmt: skip
_PARAMETER = re.compile(r'parameters=\{"(\w+)": 1\.0\}')
# One of them with a value, as messages write it, that is not inside of a call.
_ARGUMENT = re.compile(rf'(?<![(\w])({"|".join(OPTIONS)})=("[^"]*"|True\b|[\w.-]+)')
# What is written otherwise. Longer phrases come before their parts.
_CLI_PHRASES = {
    "with a client or a checkpoint": "with --scheduler or --checkpoint",
    "(tiles=)": "(--tiles)",
    "clip=harnack.Ball((0, 0, 0), 1)": "--ball 0,0,0,1",
    "clip=harnack.Box(lower, upper)": "--box X,Y,Z,X,Y,Z",
    "or harnack.Ball(center, radius)": "or --ball X,Y,Z,RADIUS",
    "section=harnack.HalfSpace(normal, offset)": "--section X,Y,Z,OFFSET",
    "target=(x, y, z)": "--target X,Y,Z",
    "boundary=0.03": "--boundary-tube 0.03",
    "harnack.Slider(low, high, step=...)": "--slider NAME=LOW:HIGH:STEP",
    "`harnack.repair`": "`harnack repair`",
    "solid=True": "--solid",
    "solid=(-math.inf, level)": "--solid :LEVEL",
    "solid=(-math.inf, 0.0)": "--solid :0",
    "solid=(low, high)": "--solid LOW:HIGH",
    "solid=(0.5, math.inf)": "--solid 0.5:",
    'backdrop="white"': "--backdrop white",
    "up= ": "--up ",
    "max_triangles": "--max-triangles",
    " (apply_translation), or scale it (apply_scale)": ", or scale it (--scale)",
}


def error_line(error: Exception) -> str:
    """'error: ...' for an exception, printable and on one line."""
    return printable(re.sub(r"\s*\n\s*", " ", f"error: {_explanation(error)}".strip()))


def printable(text: str) -> str:
    """Text on one line whose control characters, which terminals obey, are written as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _explanation(error: Exception) -> str:
    if isinstance(error, UnboundedSurfaceError):
        if error.bounded_level is not None:
            return (
                f"{error.reason}; choose another --level, such as {level_text(error.bounded_level)}"
            )
        return f"{error.reason}; cut it, such as by --ball 0,0,0,2"
    if isinstance(error, MemoryError):
        return f"there is not enough memory: choose a smaller --size ({error})"
    return python_to_cli_terms(str(error))


def python_to_cli_terms(text: str) -> str:
    """A message of the library, reworded: options of the command line in place of arguments of
    Python."""
    for written, option in _CLI_PHRASES.items():
        text = text.replace(written, option)
    text = _PARAMETER.sub(r"--set \1=1", text)
    return _ARGUMENT.sub(lambda found: _option(*found.groups()), text)


def _option(name: str, value: str) -> str:
    option = f"--{name.rstrip('_').replace('_', '-')}"
    return option if value == "True" else f"{option} {value.strip(chr(34))}"


def level_text(level: float | None) -> str:
    """A level as one writes it on the command line: "2pi", "0.5"."""
    ratio = (level or 0.0) / 3.141592653589793
    if ratio and abs(2 * ratio - round(2 * ratio)) < 1e-9:
        return f"{ratio:g}pi" if ratio != 1 else "pi"
    return f"{level:g}"
