"""Values on surfaces, scales of colors, and bars beside pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.rendering import mitsuba_shape, register
from harnack.rendering.images import to_uint8
from harnack.rendering.scales import ColorScale, add_color_bar, cyclic_colormap, viridis

mi = register()
SMALL: dict[str, Any] = {"size": (64, 48), "progress": False}
SPHERE = hk.Sphere(1.0)
KNOT = hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(24))


def values(of: Any, what: Any = SPHERE, **settings: Any) -> Any:
    """One ray a pixel, so that each is the color of its number."""
    return hk.render(what, show="value", color_by=of, spp=1, **SMALL, **settings)


def test_values_are_those_of_the_function_on_the_surface() -> None:
    x, y, z = (np.asarray(values(axis)) for axis in "xyz")
    met = np.isfinite(x)
    status = hk.render(SPHERE, show="status", **SMALL)
    np.testing.assert_array_equal(met, status == hk.RayStatus.HIT)
    np.testing.assert_allclose(np.sqrt(x * x + y * y + z * z)[met], 1, atol=1e-5)
    points = np.column_stack([x[met], y[met], z[met]])
    product = values(lambda x, y, z: x * y)
    np.testing.assert_allclose(product[met], points[:, 0] * points[:, 1], atol=1e-5)
    angle = values(KNOT)
    np.testing.assert_allclose(angle[met], KNOT.value(points), atol=1e-4)


def test_where_the_function_is_not_defined_there_is_no_value() -> None:
    lower = hk.expression(lambda x, y, z: x, domain=hk.Box((-2, -2, -2), (2, 2, 0)))
    z, x = np.asarray(values("z")), values(lower)
    met = np.isfinite(z)
    np.testing.assert_array_equal(np.isfinite(x)[met], z[met] < 1e-4)
    assert (x.srgb[met & (z > 1e-4)] == 115).all()


def test_values_do_not_depend_on_where_the_surface_stands() -> None:
    moved = values("x", hk.Surface(SPHERE.translated((5, 0, 0))), up="-y")
    assert np.nanmin(moved) > 4
    assert np.nanmax(moved) < 6.001


def test_values_of_scenes_are_in_the_coordinates_of_the_world() -> None:
    ball = mitsuba_shape(SPHERE, to_world=mi.ScalarTransform4f().translate([3, 0, 0]))
    look = mi.ScalarTransform4f().look_at([3, -9, 0], [3, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 12}
    sensor = {"type": "perspective", "fov": 10, "to_world": look, "film": film}
    found = hk.render({"type": "scene", "ball": ball, "s": sensor}, show="value", color_by="x")
    assert abs(np.nanmean(found) - 3) < 0.01


def test_values_from_low_to_high_go_from_blue_to_yellow() -> None:
    picture = values("z")
    z, met = np.asarray(picture), np.isfinite(picture)
    ends = to_uint8(viridis(np.array([0.0, 1.0])))
    assert np.abs(picture.srgb[z == z[met].min()].astype(int) - ends[0]).max() <= 1
    assert np.abs(picture.srgb[z == z[met].max()].astype(int) - ends[1]).max() <= 1
    fixed = values("z", color_range=(-3, 3))
    np.testing.assert_array_equal(z, fixed)
    expected = to_uint8(viridis((z[met] + 3) / 6))
    assert np.abs(fixed.srgb[met].astype(int) - expected).max() <= 1


def test_angles_are_hues_without_a_jump_at_the_period() -> None:
    ends = cyclic_colormap(np.array([0.0, 1.0, 0.5]))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    assert np.abs(ends[0] - ends[2]).max() > 0.2
    turns = cyclic_colormap(np.linspace(0, 1, 361))
    assert np.abs(np.diff(turns, axis=0)).max() < 0.02
    assert turns.min() > 0
    assert turns.max() < 1  # none was cut off
    scale = ColorScale.cyclic(4 * np.pi, "angle")
    np.testing.assert_allclose(*scale.colors(np.array([[0.5], [0.5 + 8 * np.pi]])), atol=1e-9)


@pytest.mark.parametrize(
    ("low", "high", "written"),
    [
        (0, 10, ["0", "2", "4", "6", "8", "10"]),
        (0, 1, ["0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        (-0.35, 0.4, ["-0.2", "0", "0.2", "0.4"]),
        (5.87, 8.04, ["6.0", "6.5", "7.0", "7.5", "8.0"]),
        (0, 1234567, ["0", "500000", "1000000"]),
        (-1e-6, 1e-6, ["-1e-6", "-5e-7", "0", "5e-7", "1e-6"]),
        (1e6, 1e6 + 4, ["1000000", "1000001", "1000002", "1000003", "1000004"]),
        (
            2e9,
            2e9 + 2,
            ["2e9", "2.0000000005e9", "2.000000001e9", "2.0000000015e9", "2.000000002e9"],
        ),
        (2, 2, ["2"]),
    ],
)
def test_ticks_are_nice_numbers(low: float, high: float, written: list[str]) -> None:
    ticks = ColorScale(low, high, "it").ticks(6)
    assert [text for _, text in ticks] == written
    assert all(low - 1e-9 <= number <= high + 1e-9 for number, _ in ticks)


def test_ticks_stand_for_the_numbers_that_are_written() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        low = rng.normal() * 10.0 ** rng.uniform(-9, 9)
        high = low + 10.0 ** rng.uniform(-3, 9) * max(1e-3 * abs(low), 1e-9)
        ticks = ColorScale(low, high, "it").ticks(6)
        texts = [text for _, text in ticks]
        assert 2 <= len(ticks) <= 7
        assert len(set(texts)) == len(texts)
        np.testing.assert_allclose(
            [float(text) for text in texts], [n for n, _ in ticks], atol=2e-3 * (high - low)
        )


@pytest.mark.parametrize(
    ("turns", "most", "written"),
    [
        (2, 6, ["0", "pi/2", "pi", "3 pi/2", "2 pi"]),
        (4, 6, ["0", "pi", "2 pi", "3 pi", "4 pi"]),
        (4, 3, ["0", "2 pi", "4 pi"]),
        (1, 6, ["0", "pi/2", "pi"]),
    ],
)
def test_ticks_of_angles_are_parts_of_turns(turns: int, most: int, written: list[str]) -> None:
    ticks = ColorScale.cyclic(turns * np.pi, "it").ticks(most)
    assert [text for _, text in ticks] == written
    assert ticks[-1][0] == pytest.approx(turns * np.pi)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("show", "color_by"), [("evaluations", None), ("depth", None), ("value", "z"), ("value", KNOT)]
)
def test_a_bar_changes_no_number_and_no_pixel_of_the_picture(
    show: str, color_by: Any, tmp_path: Path
) -> None:
    settings = {"show": show, "color_by": color_by, **SMALL}
    plain = hk.render(SPHERE, **settings)
    beside = hk.render(SPHERE, tmp_path / "a.png", color_bar=True, **settings)
    np.testing.assert_array_equal(plain, beside)
    np.testing.assert_array_equal(beside.srgb[:, :64], plain.srgb)
    assert beside.srgb.shape[1] > 80
    titled = hk.render(SPHERE, color_bar="a title that takes its room", **settings)
    assert titled.srgb.shape[1] > beside.srgb.shape[1]


def test_bars_show_the_colors_of_their_numbers() -> None:
    scale = ColorScale(-1.0, 3.0, "it")
    dark = (26 / 255, 26 / 255, 28 / 255)
    strip = add_color_bar(np.zeros((400, 5, 3), dtype=np.uint8), scale, dark)[:, 5:].astype(int)
    column = strip[:, 14 + 16]  # right of the title
    inside = np.flatnonzero(np.abs(column - (26, 26, 28)).max(axis=1) > 8)
    inside = np.arange(inside[0], inside[-1] + 1)
    assert 280 < len(inside) < 330
    part = 1 - (np.arange(len(inside)) + 0.5) / len(inside)
    assert np.abs(column[inside] - 255 * viridis(part)).max() < 3
    # Ticks, right of the bar, at the heights of 3, 2, 1, 0 and -1.
    white = (strip[:, 14 + 18 + 1 : 14 + 18 + 3] > 200).all(axis=(1, 2))
    ticks = np.flatnonzero(white) - inside[0]
    np.testing.assert_allclose(ticks, np.linspace(0, len(inside) - 1, 5), atol=1)


@pytest.mark.parametrize("passed", [(False, True), (True, False), (True, True)])
def test_ends_of_bars_are_points_where_numbers_lie_beyond(passed: tuple[bool, bool]) -> None:
    scale = ColorScale(-1.0, 3.0, "it")
    numbers = np.array([-1.0 - passed[0], 0.0, 3.0 + passed[1]])
    assert scale.with_exceeded(numbers).exceeded == passed
    assert scale.with_exceeded(numbers.clip(-1, 3)).exceeded == (False, False)
    assert ColorScale.cyclic(1.0, "it").with_exceeded(numbers).exceeded == (False, False)
    black = np.zeros((400, 5, 3), dtype=np.uint8)
    plain, pointed = (
        add_color_bar(black, one, (0, 0, 0))[50:, 5 + 14 : 5 + 14 + 18].max(axis=(1, 2)) > 8
        for one in (scale, scale.with_exceeded(numbers))
    )
    assert bool(np.flatnonzero(pointed)[-1] > np.flatnonzero(plain)[-1]) == passed[0]


@pytest.mark.parametrize("size", [(1, 1), (8, 6), (3, 40)])
def test_the_smallest_pictures_have_bars(size: tuple[int, int]) -> None:
    picture = hk.render(SPHERE, show="depth", color_bar=True, size=size, progress=False)
    assert picture.srgb.shape[0] == size[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"show": "value"}, "needs the function"),
        ({"show": "value", "color_by": "height"}, "color_by: 'height' is no formula"),
        ({"show": "depth", "color_by": "z"}, 'needs a picture with show="value"'),
        ({"show": "path", "color_bar": True}, 'color_bar needs a picture with show="evaluations"'),
        ({"show": "normal", "color_range": (0, 1)}, "color_range needs a picture with"),
        ({"show": "depth", "color_range": (1, 0)}, "two finite numbers in order"),
        ({"show": "depth", "color_range": 3}, "two finite numbers in order"),
        ({"show": "depth", "color_bar": 3}, "True, False or the bar's title"),
        ({"show": "depth", "color_bar": True, "path": "a.exr"}, r"bar is drawn in \.png"),
    ],
)
def test_what_is_wrong_is_said(settings: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        hk.render(SPHERE, **SMALL, **settings)


def test_without_pillow_a_bar_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'harnack\[film\]'"):
        hk.render(SPHERE, show="depth", color_bar=True, **SMALL)
