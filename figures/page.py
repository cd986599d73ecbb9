"""The page of figures: sections that are written one by one, in the paper's order."""

from __future__ import annotations

import datetime
import re
from pathlib import Path

import harnack as hk
from harnack.files.file_geometry import write_atomically

from .figure import Figure, Report

_HEADING = """# The paper's figures

Counterparts of the figures of *Ray Tracing Harmonic Functions* (Gillespie, Yang, Botsch, Crane
2024) that show a result. Written by `make figures`; not edited by hand. `python -m figures --only
17` remakes one.

An *evaluation* is one look at the function with its gradient; counts are exact and are those of
the rays through the middles of the pixels shown. Seconds are wall time and depend on the machine.
*Hits* are first hits. Where the paper's data are not public, ours are a reconstruction, and the
section says so. Methods marked *unproved* are here for comparison alone: nothing in the library
rests on them.
"""
_SECTION = re.compile(
    r"<!-- figure (\d+) -->\n(.*?)\n<!-- end of figure \1 -->", re.DOTALL
)  # fmt: skip


def picture_name(figure: Figure, *, is_plot: bool) -> str:
    """The file name of a figure's picture."""
    return f"figure-{figure.number:02d}.{'png' if is_plot else 'jpg'}"


def sections(page: Path) -> dict[int, str]:
    """The sections of a page by number; none if the page does not exist."""
    if not page.exists():
        return {}
    matches = _SECTION.findall(page.read_text(encoding="utf-8"))
    return {int(number): text for number, text in matches}


def write(page: Path, figure: Figure, report: Report, *, seconds: float, width: int) -> None:
    """Write a figure's picture, and its section in place of the existing section.

    Both are written to temporary names, and renamed."""
    folder = page.parent / "images" / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    name = picture_name(figure, is_plot=report.is_plot)
    with write_atomically(folder / name) as partial:
        if report.is_plot:
            report.picture.convert("P", palette=1, colors=128).save(partial, optimize=True)
        else:
            report.picture.save(partial, quality=87, subsampling=0, optimize=True)
    today = datetime.date.today().isoformat()
    text = (
        f"## Fig. {figure.number}: "
        f"{figure.title}\n\n![{figure.title}](images/figures/{name})\n\n**In the paper:** "
        f"{figure.paper}\n\n**Here:** {report.caption}\n\n**Differs:** {report.differs}\n\n*Made "
        f"in {seconds:.0f} s, harnack {hk.__version__}, {today}, panels of {width} pixels.*\n"
    )
    texts = {**sections(page), figure.number: text}
    blocks = [
        f"<!-- figure {number} -->\n{texts[number]}\n<!-- end of figure {number} -->\n"
        for number in sorted(texts)
    ]
    with write_atomically(page) as partial:
        partial.write_text("\n".join([_HEADING, *blocks]), encoding="utf-8")
