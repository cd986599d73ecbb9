"""The picture of docs/live.md, a view in a browser: `make images` makes it."""

from __future__ import annotations

import sys
from pathlib import Path

import harnack as hk

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from tests.live.browsers import Page, chromium


def main(folder: Path) -> None:
    """Open a view of a trefoil's surface, with its points to be moved, and take its picture."""
    knot = hk.SolidAngle(hk.geometry.example_curves.torus_knot(2, 3, 24))
    level = hk.Slider(4.0, 9.0, 6.0)
    with (
        chromium() as browser,
        hk.view(
            knot, level=level, title="A trefoil's surface", open_browser=False, block=False
        ) as view,
    ):
        page = Page(browser, view.address, (960, 600), samples=2)
        page.tick("Edit points")
        page.rest()
        page.do("() => { panel.controls.open = true; }")
        page.tab.screenshot(path=folder / "live.png")
        page.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
