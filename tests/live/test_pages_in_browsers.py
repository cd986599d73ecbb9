"""Pages in a real browser: the pictures of `render`, turned, by sliders, and no word to anybody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import harnack as hk
from harnack.geometry import example_curves
from harnack.geometry.example_meshes import icosphere
from tests.live.browsers import Page, chromium, served

pytestmark = pytest.mark.browser
SIZE = (320, 240)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as one:
        yield one


def holed() -> hk.WindingNumber:
    vertices, faces = icosphere(2)
    return hk.WindingNumber(vertices, faces[20:])


# What is drawn, and how: surfaces of a curve, a formula, a mesh with a hole, a solid that is cut
# and has lines, a union, and two solids.
SCENES: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    "curve": lambda: (hk.SolidAngle(example_curves.torus_knot(2, 3, 60)), {}),
    "formula": lambda: (
        hk.expression("x^4 + y^4 + z^4 - x^2 - y^2 - z^2 = -0.4"),
        {"clip": hk.Ball(radius=2.0), "material": "gold", "backdrop": "dark"},
    ),
    "mesh": lambda: (holed(), {}),
    "solid": lambda: (
        hk.Gyroid(0.6, domain=hk.Ball(radius=1.0)),
        {
            "level": (-0.6, 0.6), "side": "between", "section": hk.HalfSpace((1.0, -1.0, 0.5), 0.1),
            "section_material": "coral", "isolines": hk.Isolines("z", interval=0.25),
        },
    ),
    "union": lambda: (
        hk.union(hk.Sphere(0.8), hk.Cuboid((1.2, 1.2, 1.8))),
        {"material": "clay"},
    ),
    "two": lambda: (
        [hk.Torus(1.0, 0.25), hk.Sphere(0.5)],
        {"material": ["porcelain", "two-tone"], "camera": hk.Camera(azimuth=40, elevation=50)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_page_shows_what_render_draws(name: str, browser: Any, tmp_path: Path) -> None:
    """Six of the sixteen samples that a page takes of a pixel show as much."""
    what, settings = SCENES[name]()
    hk.page(what, tmp_path / "a.html", progress=False, **settings)
    hk.render(what, tmp_path / "a.png", show="shaded", size=SIZE, progress=False, **settings)
    expected = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(float)
    with served(tmp_path) as address:
        page = Page(browser, f"{address}/a.html", SIZE, samples=6)
        assert page.message == ""
        found = page.picture(f"page-{name}").astype(float)
        page.close()
    off = np.abs(found - expected).max(axis=2) / 255
    assert np.median(off) < 0.02
    assert off.mean() < 0.02
    # Silhouettes: what differs much is nowhere two pixels wide.
    much = ndimage.binary_erosion(off > 0.2, np.ones((3, 3)))
    assert much.mean() < 2e-4


def test_all_of_many_surfaces_have_their_own_materials(browser: Any, tmp_path: Path) -> None:
    """Each surface has three paints, and a byte once counted them: the last are beyond it."""
    count = 90
    centers = [(k % 10 - 4.5, k // 10 - 4.0, 0.0) for k in range(count)]
    colors = [("red", "lime", "blue")[k % 3] for k in range(count)]
    path = tmp_path / "a.html"
    hk.page(
        [hk.Sphere(0.35, center) for center in centers], path, material=colors,
        camera=hk.Camera(elevation=80), progress=False,
    )  # fmt: skip
    with served(tmp_path) as address:
        page = Page(browser, f"{address}/a.html", SIZE, samples=1)
        picture = page.picture("page-many")
        places = page.do(
            "(centers) => centers.map((p) => panel.camera.project(panel.placement.toStage(p),"
            " innerWidth, innerHeight))",
            centers,
        )
        page.close()
    found = [int(np.argmax(picture[round(p["y"]), round(p["x"])])) for p in places]
    assert found == [k % 3 for k in range(count)]
