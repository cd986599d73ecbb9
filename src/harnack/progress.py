"""The progress of long tasks, shown on stderr as a bar or as lines of text, or told to a function.
A task tells by fractions how much of it is finished, or by texts what is being done."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, cast

# Seconds between lines of text. A task that is finished sooner writes none.
_SECONDS_BETWEEN_LINES = 5.0
# What was finished within these first seconds (stored results, for example) does not count in the
# estimate of the remaining time.
_INSTANT_SECONDS = 0.5
# The remaining time is estimated once this fraction is finished: before, preparations weigh most.
_LEAST_DONE = 0.1


class Progress(str):
    """A text that says what a long task is doing, such as "rendering: 25%" or "refining". It is
    what a function that is given as `progress` is called with.

    done: the fraction of the task that is finished; None if it is not known.
    """

    done: float | None

    def __new__(cls, text: str = "", done: float | None = None) -> Progress:
        progress = super().__new__(cls, text)
        progress.done = done
        return progress


ProgressFunction = Callable[[Progress], None]


class ProgressReporter:
    """By which a task tells its progress.

    name: of the task, such as "rendering".
    show: called with what is told.
    """

    def __init__(self, name: str, show: ProgressFunction) -> None:
        self._name, self._show, self._done = name, show, 0.0

    def advance(self, part: float) -> None:
        """Tell that a fraction of the task was finished. All fractions add up to 1."""
        self._done += part
        self._show(Progress(f"{self._name}: {self._done:.0%}", self._done))

    def tell(self, text: str) -> None:
        """Tell what is being done now."""
        self._show(Progress(text))


@contextmanager
def show_progress(name: str, progress: bool | ProgressFunction) -> Generator[ProgressReporter]:
    """Context manager that shows on stderr how far the task `name` is. It yields the reporter, to
    which the task tells its progress.

    progress: whether to show the progress; or a function that is told it instead. That function may
        raise an exception to stop the task.

    A terminal shows a bar. Notebooks and log files get lines of text, because a bar in a notebook
    would need ipywidgets, and log files would contain a terminal's control codes.

    Raises:
        TypeError: progress is neither a bool nor a function.
    """
    if isinstance(progress, type) or not (
        callable(progress) or isinstance(cast("Any", progress), bool)
    ):
        raise TypeError(f"progress must be True, False or a function, not {progress!r:.60}")
    if callable(progress):
        yield ProgressReporter(name, progress)
        return
    if not progress:
        yield ProgressReporter(name, lambda progress: None)
        return
    if not _may_be_terminal():
        yield ProgressReporter(name, _TextLines(name))
        return
    # Imported here, as it takes time, and log files need none of it.
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if console.is_terminal and not console.is_jupyter:
        columns = (TextColumn("{task.description}", markup=False), BarColumn(),
                   TaskProgressColumn(), TimeRemainingColumn())  # fmt: skip
        with Bar(*columns, console=console, transient=True) as bar:
            task = bar.add_task(name, total=1.0)

            def show(told: Progress) -> None:
                """Show the finished fraction, or the text beside a bar of unknown length."""
                if told.done is None:
                    bar.update(task, description=told, total=None)
                else:
                    bar.update(task, completed=told.done)

            yield ProgressReporter(name, show)
    else:
        yield ProgressReporter(name, _TextLines(name))


def _may_be_terminal() -> bool:
    """Whether stderr may be a terminal, which `rich` decides. If not, it is none."""
    forced = any(os.environ.get(name) for name in ("FORCE_COLOR", "TTY_COMPATIBLE"))
    return forced or (sys.stderr is not None and sys.stderr.isatty())


class _TextLines:
    """Prints a line of text about the progress of a task every few seconds.

    name: the name of the task.

    _cached_fraction: the fraction that was finished within the first half second, for example
        because stored results were found. It does not count in the estimate of the remaining time.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._cached_fraction = 0.0
        self._start = self._last = time.monotonic()

    def __call__(self, progress: Progress) -> None:
        """Print a line if the last one is several seconds old, unless the task is finished."""
        done, now = progress.done, time.monotonic()
        past = now - self._start
        if done is not None and past < _INSTANT_SECONDS:  # parts that are there already
            self._cached_fraction = done
        is_finished = done is not None and done >= 1 - 1e-9
        if now - self._last < _SECONDS_BETWEEN_LINES or is_finished:
            return
        self._last = now
        text = f"{self._name}: {progress}"
        if done is not None:
            # By what was finished after the first half second; if that is nothing, by all.
            text = f"{progress} after {past:.0f} s"
            computed = done - self._cached_fraction or done
            if computed >= _LEAST_DONE:
                text += f", about {past * (1 - done) / computed:.0f} s left"
        print(text, file=sys.stderr, flush=True)
