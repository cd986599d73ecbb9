"""Measure everything and write docs/benchmarks.md. Run from the project's root."""

from __future__ import annotations

import argparse
import datetime
import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from rich.progress import track

import harnack as hk

from .agreement import agreement
from .antialiasing import antialiasing
from .baselines import baselines
from .clouds import clouds
from .cluster import cluster
from .convergence import plot
from .curve_cells import curve_cells
from .derivatives import derivatives
from .distances import distances
from .formulas import formulas
from .growth import growth
from .hart import hart
from .hollow import hollow
from .inclusion import inclusion
from .laplacian import laplacian
from .live import live
from .many_parts import many_parts
from .meshes import meshes
from .networks import networks
from .pictures import pictures
from .povray import compare_with_povray, has_povray
from .rays import RULES, WIDTH, Row, machine, measure, published
from .repair import repair
from .scenes import others, polygons
from .versions import beside
from .winding import throughput

DOCS = Path(__file__).resolve().parent.parent / "docs"
SECTIONS = (
    "rays", "convergence", "winding", "agreement", "versions", "inclusion", "laplacian", "hart",
    "povray", "antialiasing", "baselines", "formulas", "meshes", "repair", "clouds", "distances",
    "derivatives", "pictures", "live", "cluster", "curves", "hollow", "parts", "networks",
)  # fmt: skip


def main() -> None:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--out", type=Path, default=DOCS / "benchmarks.md")
    parser.add_argument("--no-convergence", action="store_true", help="skip that section")
    parser.add_argument("--only", choices=SECTIONS, help="rewrite one section of the page")
    parser.add_argument("--bunny", type=Path, help="a surface file, for the winding numbers")
    parser.add_argument(
        "--meshes",
        type=Path,
        help="a folder of surface files, for agreement, repair, clouds and hollow",
    )
    parser.add_argument("--before", type=Path, help="a checkout of an earlier version, to compare")
    arguments = parser.parse_args()
    names = [arguments.only] if arguments.only else list(SECTIONS)
    if arguments.no_convergence and "convergence" in names:
        names.remove("convergence")
    if arguments.meshes is None:
        of_files = ("agreement", "hollow")
        if arguments.only in of_files:
            parser.error(f"{arguments.only} needs a folder of surface files: --meshes FOLDER")
        names = [name for name in names if name not in of_files]
    if arguments.before is None:
        if arguments.only == "versions":
            parser.error("versions needs a checkout of an earlier version: --before FOLDER")
        names = [name for name in names if name != "versions"]
    if not has_povray():
        missing = "povray needs the program povray: apt-get install povray (Debian, Ubuntu)"
        if arguments.only == "povray":
            parser.error(missing)
        print(f"skipped: {missing}")
        names = [name for name in names if name != "povray"]
    if find_spec("playwright") is None or shutil.which("chromium") is None:
        missing = "live needs Chromium: make test-browser installs it"
        if arguments.only == "live":
            parser.error(missing)
        print(f"skipped: {missing}")
        names = [name for name in names if name != "live"]
    write: dict[str, Callable[[], str]] = {
        "rays": _rays,
        "convergence": lambda: _convergence(arguments.out.with_name("convergence.png")),
        "agreement": lambda: agreement(arguments.meshes),
        "versions": lambda: beside(arguments.before),
        "hollow": lambda: hollow(arguments.meshes),
        "inclusion": inclusion,
        "laplacian": laplacian,
        "derivatives": derivatives,
        "hart": hart,
        "antialiasing": antialiasing,
        "baselines": baselines,
        "clouds": lambda: clouds(arguments.meshes),
        "cluster": cluster,
        "curves": curve_cells,
        "distances": distances,
        "formulas": formulas,
        "live": live,
        "meshes": meshes,
        "networks": networks,
        "parts": many_parts,
        "pictures": pictures,
        "repair": lambda: repair(arguments.meshes),
        "povray": compare_with_povray,
        "winding": lambda: _winding(arguments.bunny, arguments.out.with_name("growth.png")),
    }
    if arguments.only and not arguments.out.exists():
        parser.error(f"{arguments.out} is not there; write all of it first, without --only")
    texts = {name: write[name]() for name in names}
    # Read late: measuring takes minutes, in which the page may have been changed.
    page = arguments.out.read_text(encoding="utf-8") if arguments.only else _heading()
    for name, text in texts.items():
        page = merged(page, name, text)
    temporary = arguments.out.with_suffix(".tmp")
    temporary.write_text(page, encoding="utf-8")
    temporary.replace(arguments.out)
    print(f"wrote {arguments.out}")


def merged(page: str, name: str, text: str) -> str:
    """The page with a section in place of the one of that name, or at its end."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    section = f"{begin}\n\n{text}\n{end}"
    if begin not in page:
        return f"{page}\n{section}\n"
    before, rest = page.split(begin, 1)
    if end not in rest:
        raise ValueError(f"the page has {begin!r} and no {end!r} after it")
    return before + section + rest.split(end, 1)[1]


def _winding(surface: Path | None, picture: Path) -> str:
    return throughput(surface) + "\n" + growth(picture)


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
