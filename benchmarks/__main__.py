"""Measure everything and write docs/benchmarks.md. Run from the project's root."""

from __future__ import annotations

import argparse
import datetime
from pathlib import Path

from rich.progress import track

import harnack as hk

from .convergence import plot
from .rays import RULES, WIDTH, Row, machine, measure, published
from .scenes import others, polygons

DOCS = Path(__file__).resolve().parent.parent / "docs"


def main() -> None:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--out", type=Path, default=DOCS / "benchmarks.md")
    parser.add_argument("--no-convergence", action="store_true", help="skip the plot (needs igl)")
    arguments = parser.parse_args()
    text = [_heading(), _rays()]
    if not arguments.no_convergence:
        text.append(_convergence(arguments.out.with_name("convergence.png")))
    temporary = arguments.out.with_suffix(".tmp")
    temporary.write_text("\n".join(text), encoding="utf-8")
    temporary.replace(arguments.out)
    print(f"wrote {arguments.out}")


def _heading() -> str:
    return (
        "# Benchmarks\n\n"
        "Written by `make bench`; not edited by hand. Evaluations are exact counts; times depend "
        f"on the machine ({machine()}) and are only comparable within this page. "
        f"harnack {hk.__version__}, {datetime.date.today().isoformat()}.\n\n"
        f"Pinhole at (2.2, -2.2, 1.6) looking at the origin, 40 degrees, {WIDTH} x {WIDTH} rays, "
        "tolerance 1e-4, single precision. *Evaluations* are means over all rays, hitting or "
        "not, and over the rays that hit.\n"
    )


def _rays() -> str:
    rows: list[list[Row]] = []
    for scene in track([*polygons(), *others()], description="rays"):
        group = [published(scene)] if scene.vertices else []
        group += [measure(scene, rule) for rule in RULES]
        rows.append(group)
    lines = [
        "## Evaluations and rays a second\n",
        "`classic` is the published rule (lower bound alone, over-stepping 1.75); the last "
        "column is its core time divided by that of the row. 'ns' is core time for one vertex "
        "in one evaluation, everything included.\n",
        "| scene | rule | evaluations, all | hitting | most | out of steps | rays/s and core "
        "| ns | speed-up over classic |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for group in rows:
        classic = next(row for row in group if row.rule == "classic")
        lines += [_line(row, classic) for row in group]
    return "\n".join(lines) + "\n"


def _line(row: Row, classic: Row) -> str:
    ns = f"{row.nanoseconds_a_vertex:.2f}" if row.nanoseconds_a_vertex > 0 else ""
    return (
        f"| {row.scene} | {row.rule} | {row.evaluations:.2f} | {row.evaluations_hitting:.2f} "
        f"| {row.most} | {row.out_of_steps} | {row.rays_per_core_second / 1e6:.2f} M | {ns} "
        f"| {classic.core_seconds / row.core_seconds:.1f} x |"
    )


def _convergence(path: Path) -> str:
    summary = plot(path)
    lines = [
        "## Convergence\n",
        "The paper's Fig. 23: error after each evaluation, over the rays that hit the 2 pi level "
        "of the polygon with 64 vertices, against sphere tracing with the exact distance to a "
        "mesh of 613,000 triangles of that level set.\n",
        f"![error after each evaluation]({path.name})\n",
        "| rule | median evaluations to 1e-3 | to 1e-4 | to 1e-5 |",
        "|---|---:|---:|---:|",
    ]
    for name, counts in summary.items():
        lines.append(f"| {name} | " + " | ".join(f"{count:.0f}" for count in counts) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
