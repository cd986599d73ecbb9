"""Remake docs/figures.md and its pictures. Run from the project's root."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from harnack.cli.messages import track_interrupts

from .page import write
from .registry import FIGURES

PAGE = Path(__file__).resolve().parent.parent / "docs" / "figures.md"
WIDTH = 240
LEAST = 24


def main() -> int:
    """Parse arguments, make figures, write each as soon as it is made; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m figures", description=__doc__)
    parser.add_argument(
        "--only", type=int, nargs="+", choices=sorted(FIGURES), metavar="NUMBER",
        help="figures to remake; the others stay as they are",
    )  # fmt: skip
    parser.add_argument(
        "--size", type=int, default=WIDTH, help=f"width of a panel in pixels (default {WIDTH})"
    )
    parser.add_argument("--out", type=Path, default=PAGE, help="the page to write")
    arguments = parser.parse_args()
    if arguments.size < LEAST:
        parser.error(f"--size must be at least {LEAST} pixels, not {arguments.size}")
    selected = arguments.only or sorted(FIGURES)
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    )  # fmt: skip
    with track_interrupts() as interrupts:
        try:
            with Progress(*columns) as progress:
                task = progress.add_task("figures", total=len(selected))
                for number in selected:
                    figure = FIGURES[number]
                    progress.update(task, description=f"Fig. {number}: {figure.title}")
                    start = time.perf_counter()
                    report = figure.make(arguments.size)
                    seconds = time.perf_counter() - start
                    write(arguments.out, figure, report, seconds=seconds, width=arguments.size)
                    progress.advance(task)
            print(f"wrote {arguments.out}")
            return 0
        except KeyboardInterrupt:
            pass
        except RuntimeError:
            # Ctrl-C within a plug-in reaches us as an error of Mitsuba or Dr.Jit.
            if not interrupts.pressed:
                raise
    print("stopped; the figures before this one are written", file=sys.stderr)
    return 130


if __name__ == "__main__":
    sys.exit(main())
