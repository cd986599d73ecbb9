"""How far a long task has come: a bar in a terminal, text in notebooks and log files."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

Advance = Callable[[float], None]
# Seconds between lines. What is done sooner writes none.
_INTERVAL = 5.0


@contextmanager
def progress_bar(name: str, shown: bool | Advance) -> Generator[Advance]:
    """Progress of `name` on stderr; what it yields is told each part, of 1, that has been finished.

    shown: whether to show it; or who is told in its place, and may raise an exception to end all.

    In a notebook a bar would need ipywidgets, and control codes of terminals are shown as they are.
    """
    console = Console(stderr=True)
    if callable(shown):
        yield shown
    elif not shown:
        yield lambda part: None
    elif console.is_terminal and not console.is_jupyter:
        columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("", total=1.0)
            yield lambda part: bar.advance(task, part)
    else:
        yield _Lines(name)


class _Lines:
    """Writes a line of text now and then."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._done = 0.0
        self._start = self._last = time.monotonic()

    def __call__(self, part: float) -> None:
        self._done += part
        now = time.monotonic()
        if now - self._last < _INTERVAL or self._done >= 1 - 1e-9:
            return
        self._last = now
        past = now - self._start
        left = past * (1 - self._done) / self._done
        text = f"{self._name}: {self._done:.0%} after {past:.0f} s, about {left:.0f} s left"
        print(text, file=sys.stderr, flush=True)
