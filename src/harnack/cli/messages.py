"""Messages of the command line, and the handling of Ctrl-C while a command runs. Messages of the
library name keywords of Python, such as `max_steps=`; here they become options of the command line,
such as --max-steps.

Errors are printed on a single line.
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

from harnack.field_from_file import FILE_OPTIONS
from harnack.rendering import UnboundedSurfaceError
from harnack.rendering.option_table import OPTIONS

# Ctrl-C.

# A terminal and a parent process may both pass on the same Ctrl-C.
_SAME = 1.0


@dataclass
class Interrupts:
    """A record of whether Ctrl-C was pressed, and when (in seconds of `time.monotonic`). The object
    is called as the handler of the signal SIGINT, which Ctrl-C sends."""

    pressed: bool = False
    when: float = -_SAME

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Note the signal, and raise `KeyboardInterrupt`. The arguments, with which Python calls a
        handler, are not used. A second signal within a second is ignored: a terminal and a parent
        process may both pass on the same Ctrl-C."""
        del number, frame
        now = time.monotonic()
        if self.pressed and now - self.when < _SAME:
            return
        self.pressed, self.when = True, now
        raise KeyboardInterrupt


@contextmanager
def track_interrupts() -> Generator[Interrupts]:
    """Context manager that yields a record of whether Ctrl-C was pressed within it. Signals can be
    handled in the main thread only; in other threads nothing is recorded."""
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
    """Context manager that prints each warning raised within it on a single line of the error
    output, in the terms of the command line."""
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def note(message: Any, category: type[Warning], *args: Any, **kwargs: Any) -> None:
            """Print a warning if its category is one that is meant for users (UserWarning or
            RuntimeWarning); pass all other warnings to Python's own function. The parameters are
            those of `warnings.showwarning`."""
            if issubclass(category, UserWarning | RuntimeWarning):
                print(f"note: {python_to_cli_terms(str(message))}", file=sys.stderr)
            else:
                shown(message, category, *args, **kwargs)

        warnings.showwarning = note
        yield


_SWITCHES = {"take_boundary", *(option.name for option in OPTIONS if option.is_switch)}
_NAMES = (*FILE_OPTIONS, *(option.name for option in OPTIONS if option.is_on_command_line))
_ANY = "|".join(_NAMES)
# A call; or an option with a value; or its name alone, at the start, in backticks or with an
# underscore.
_KEYWORD = re.compile(
    r"(?P<call>[\w.]+\((?:[^()]|\([^()]*\))*\))"
    rf"|(?<![\w.])(?P<name>{_ANY})="
    r'(?P<value>"[^"]*"|\([^()]*\)|\[[^]]*\]|[\w.-]*\w|\.\.\.)'
    rf"|\A(?P<first>{_ANY})(?=: )|`(?P<quoted>{_ANY})`"
    rf"|(?<![\w./-])(?P<alone>(?=[a-z]+_)(?:{_ANY}))\b(?![/=]|\.\w)"
)
_PARAMETER = re.compile(r'parameters=\{"(\w+)": 1\.0\}')


def error_line(error: Exception) -> str:
    """Return the line that is printed for an exception: "error: ..." without line breaks and
    control characters."""
    return printable(re.sub(r"\s*\n\s*", " ", f"error: {_explanation(error)}".strip()))


def printable(text: str) -> str:
    """Return the text with its unprintable characters, such as control characters that a terminal
    would obey, written as escapes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _explanation(error: Exception) -> str:
    """Return the message of an exception in the terms of the command line; for the most frequent
    errors, with an option to try."""
    if isinstance(error, UnboundedSurfaceError):
        if error.bounded_level is not None:
            return (
                f"{error.reason}; choose another --level, such as {level_text(error.bounded_level)}"
            )
        return f"{error.reason}; cut it, such as by --clip ball:0,0,0,2"
    if isinstance(error, MemoryError):
        return f"there is not enough memory: choose a smaller --size ({error})"
    return python_to_cli_terms(str(error))


def python_to_cli_terms(text: str) -> str:
    """Replace keywords of Python in a message of the library, such as `max_steps=`, by options of
    the command line, such as --max-steps."""
    text = _PARAMETER.sub(r"--parameter \1=1", text)
    return _KEYWORD.sub(_option, text)


def _option(match: re.Match[str]) -> str:
    """Return the option of the command line that replaces a match of `_KEYWORD`, with its value if
    the match has one. A call such as f(level=1) stays as it is."""
    if match["call"]:
        return match["call"]
    name = match["name"] or match["first"] or match["quoted"] or match["alone"]
    flag = f"--{name.replace('_', '-')}"
    if match["value"] is None or name in _SWITCHES:
        return flag
    # Without quotes (chr(34)), brackets and spaces: "(0, 1)" becomes "0,1".
    return f"{flag} {match['value'].strip(chr(34)).strip('()[]').replace(' ', '')}"


def level_text(level: float | None) -> str:
    """Return the text of a level on the command line, such as "2pi" or "0.5": a multiple of pi for
    a nonzero multiple of pi/2, otherwise a plain number. level: the number; None raises a
    TypeError."""
    ratio = (level or 0.0) / 3.141592653589793  # as a multiple of pi
    if ratio and abs(2 * ratio - round(2 * ratio)) < 1e-9:
        return f"{ratio:g}pi" if ratio != 1 else "pi"
    return f"{level:g}"
