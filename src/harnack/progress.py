"""The progress of long tasks, shown on stderr as a bar or as lines of text. A task reports its
progress by fractions: numbers that add up to 1 when the task is finished."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, cast

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

Advance = Callable[[float], None]
# Seconds between lines of text. A task that is finished sooner writes none.
_SECONDS_BETWEEN_LINES = 5.0
# What was finished within these first seconds (stored results, for example) does not count in the
# estimate of the remaining time.
_INSTANT_SECONDS = 0.5


def teller(progress: Callable[[str], None] | None) -> Callable[[str], None]:
    """Return the function to which messages about progress are passed: `progress` itself, or one
    that ignores them if `progress` is None.

    Raises:
        TypeError: progress is neither a function nor None.
    """
    if progress is None:
        return lambda message: None
    if not callable(progress) or isinstance(progress, type):
        raise TypeError(
            "progress must be a function that is told what is being done, such as print, not "
            f"{progress!r:.60}"
        )
    return progress


@contextmanager
def progress_bar(name: str, progress: bool | Advance) -> Generator[Advance]:
    """Context manager that shows on stderr how much of the task `name` is finished. It yields a
    function, which the task calls with each fraction that it has finished; all fractions add up to
    1.

    progress: whether to show the progress; or a function that receives the fractions instead. That
        function may raise an exception to stop the task.

    A terminal shows a bar. Notebooks and log files get lines of text, because a bar in a notebook
    would need ipywidgets, and log files would contain a terminal's control codes.

    Raises:
        TypeError: progress is neither a bool nor a function.
    """
    if not callable(progress) and not isinstance(cast("Any", progress), bool):
        raise TypeError(f"progress must be True, False or a function, not {progress!r:.60}")
    console = Console(stderr=True)
    if callable(progress):
        yield progress
    elif not progress:
        yield lambda part: None
    elif console.is_terminal and not console.is_jupyter:
        columns = (TextColumn(name), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("", total=1.0)
            yield lambda part: bar.advance(task, part)
    else:
        yield _TextProgress(name)


class _TextProgress:
    """Prints a line of text about the progress of a task every few seconds. It is called with each
    fraction of the task that was finished.

    name: the name of the task.

    _done: the fraction that is finished so far.
    _cached_fraction: the fraction that was finished within the first half second, for example
        because stored results were found. It does not count in the estimate of the remaining time.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._done = 0.0
        self._cached_fraction = 0.0
        self._start = self._last = time.monotonic()

    def __call__(self, part: float) -> None:
        """Note that the fraction `part` was finished. Print a line if the last one is several
        seconds old, unless the task is finished."""
        self._done += part
        now = time.monotonic()
        if now - self._start < _INSTANT_SECONDS:  # parts that are there already
            self._cached_fraction = self._done
        if now - self._last < _SECONDS_BETWEEN_LINES or self._done >= 1 - 1e-9:
            return
        self._last = now
        past = now - self._start
        left = past * (1 - self._done) / (self._done - self._cached_fraction or self._done)
        text = f"{self._name}: {self._done:.0%} after {past:.0f} s, about {left:.0f} s left"
        print(text, file=sys.stderr, flush=True)
