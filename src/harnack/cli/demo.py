"""The command `demo`: six pictures in less than a minute, with a bar or lines of text that say how
far it is, and what to do next."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, Task, TaskProgressColumn, TextColumn
from rich.progress import Progress as Bar
from rich.text import Text

from harnack.backend import LLVMNotFoundError, choose_backend
from harnack.cli.sources import options_set, print_line
from harnack.gallery import SCENES
from harnack.gallery.demo import DEMO_PICTURES, DEMO_SIZE, DemoPicture
from harnack.progress import Progress, ProgressFunction

# Before this fraction is finished, the remaining time is not estimated from the elapsed time.
_LEAST_DONE = 0.05
_NEXT_STEPS = (
    "harnack page trefoil -o trefoil.html   a page in which the surface turns",
    "harnack examples                       scripts to start from",
)


def draw_demo(folder: Path, arguments: Any) -> None:
    """Draw the pictures of the demo into a folder, say how far it is, and where they are.

    folder: the folder, which exists.
    arguments: the parsed arguments of the command: `quiet`, and options that replace those of the
        pictures.
    """
    timing = DemoTiming(tuple(picture.seconds for picture in DEMO_PICTURES))
    print_line(
        f"{len(DEMO_PICTURES)} pictures, in about a minute the first time: kernels are compiled "
        "once, and kept"
    )
    for index, picture in enumerate(DEMO_PICTURES):
        scene = SCENES[picture.scene]
        time_text = f" ({timing.text(timing.done(index, 0.0))})" if index else ""
        print_line(f"{index + 1}/{len(DEMO_PICTURES)} {scene.name}: {scene.title}{time_text}")
        target = folder / f"{scene.name}.png"
        settings = {**_settings(picture), **options_set("render", arguments)}
        with _show_progress(timing, index, quiet=arguments.quiet) as progress:
            scene.render(target, **settings, progress=progress)
        print_line(f"    {target}")
    print_line(
        f"{len(DEMO_PICTURES)} pictures in {folder.resolve()}, after {timing.elapsed:.0f} s; next:"
    )
    for step in _NEXT_STEPS:
        print_line(f"    {step}")


def check_demo_backend() -> None:
    """Check that there is a device on which kernels can run.

    Raises:
        LLVMNotFoundError: there is none. The message says what to do.
    """
    try:
        choose_backend()
    except LLVMNotFoundError as error:
        raise LLVMNotFoundError(
            f"{error} (`harnack doctor` says what is installed, and what is missing)"
        ) from error


def _settings(picture: DemoPicture) -> dict[str, Any]:
    """Return the options of `render` by which a picture of the demo is drawn."""
    return {"show": picture.show, "size": DEMO_SIZE, "spp": picture.spp}


class DemoTiming:
    """How much of a series of tasks is done, and how long the rest will take. The time is counted
    from the construction on.

    seconds: how long each of the tasks takes; only the proportions matter.
    """

    def __init__(self, seconds: Sequence[float]) -> None:
        self._seconds = tuple(seconds)
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """The time since the beginning, in seconds."""
        return time.monotonic() - self._start

    def done(self, index: int, part: float) -> float:
        """Return the finished fraction of everything, when a fraction `part` of the task with this
        index is finished, and all tasks before it."""
        return (sum(self._seconds[:index]) + part * self._seconds[index]) / sum(self._seconds)

    def text(self, done: float) -> str:
        """Return how long it has taken and how much longer it will take, such as "12 s, about 20 s
        left"; without an estimate while nearly nothing is finished. done: the finished fraction of
        everything."""
        elapsed = self.elapsed
        text = f"{elapsed:.0f} s"
        if done < _LEAST_DONE:
            return text
        return f"{text}, about {elapsed * (1 - done) / done:.0f} s left"


class _TimeColumn(ProgressColumn):
    """The column of a bar that shows the elapsed and the remaining time of the whole demo, also
    while the bar stands still."""

    def __init__(self, timing: DemoTiming) -> None:
        super().__init__()
        self._timing = timing

    def render(self, task: Task) -> Text:
        """Return the text of the column. task: of the bar, whose total is 1."""
        return Text(self._timing.text(task.completed))


@contextmanager
def _show_progress(
    timing: DemoTiming, index: int, *, quiet: bool
) -> Generator[bool | ProgressFunction]:
    """Context manager that yields what `render` is given as `progress` for the picture with this
    index: on a terminal, a function that moves a bar for the whole demo; otherwise True, by which
    a picture that takes long writes lines of text; False if `quiet`."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal or console.is_jupyter:
        yield not quiet
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(),
               _TimeColumn(timing))  # fmt: skip
    with Bar(*columns, console=console, transient=True) as bar:
        name = f"picture {index + 1} of {len(DEMO_PICTURES)}"
        task = bar.add_task(name, total=1.0)
        bar.update(task, completed=timing.done(index, 0.0))

        def show(told: Progress) -> None:
            """Move the bar by what the picture tells of itself, but never back: parts of a picture
            may count their progress anew."""
            if told.done is not None:
                done = timing.done(index, told.done)
                bar.update(task, completed=max(done, bar.tasks[0].completed))

        yield show
