"""Colors and images behind surfaces: their pixels, and what is no backdrop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import harnack as hk
from harnack.rendering.images import exr_bytes
from harnack.rendering.scales import NAMED_COLORS, linear_from_srgb, parse_color

SMALL: dict[str, Any] = {"size": (40, 30), "progress": False, "show": "shaded", "spp": 4}


def drawn(backdrop: Any, **settings: Any) -> Any:
    return hk.render(hk.Sphere(1.0), backdrop=backdrop, **SMALL, **settings)


def corners(picture: Any) -> np.ndarray:
    return picture.srgb[[0, 0, -1, -1], [0, -1, 0, -1]]


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("given", "pixel"),
    [
        ("steelblue", (70, 130, 180)),
        ("#4682b4", (70, 130, 180)),
        ("#48b", (0x44, 0x88, 0xBB)),
        ((0.2, 0.4, 0.6), (51, 102, 153)),
        (np.array([0.2, 0.4, 0.6]), (51, 102, 153)),
        ("white", (255, 255, 255)),
        ("black", (0, 0, 0)),
    ],
)
def test_colors_are_shown_as_they_are(given: Any, pixel: tuple[int, int, int]) -> None:
    picture = drawn(given)
    assert np.abs(corners(picture).astype(int) - pixel).max() <= 1
    shown = [part / 255 for part in pixel]
    np.testing.assert_allclose(
        picture[0, 0], linear_from_srgb((shown[0], shown[1], shown[2])), atol=0.004
    )


def test_the_surface_is_the_same_before_any_color() -> None:
    middle = np.s_[10:20, 15:25]
    reference = drawn("white").srgb[middle]
    for backdrop in ("black", ("red", "blue")):
        np.testing.assert_array_equal(drawn(backdrop).srgb[middle], reference)


def test_gradients_go_from_the_bottom_to_the_top() -> None:
    column = drawn(("white", "black")).srgb[:, 0, 0].astype(int)
    expected = 255 * (np.arange(30) + 0.5) / 30
    assert np.abs(column - expected).max() <= 1


def blocks(shape: tuple[int, int]) -> np.ndarray:
    """Bytes (h, w, 3): red at the left, green in the middle, blue at the right."""
    image = np.zeros((*shape, 3), dtype=np.uint8)
    for k, part in enumerate(np.array_split(np.arange(shape[1]), 3)):
        image[:, part, k] = 200
    return image


def check_blocks(picture: Any) -> None:
    """That the picture shows the three colors of `blocks` in its upper corner rows."""
    row = picture.srgb[0].astype(int)
    assert np.abs(row[0] - (200, 0, 0)).max() <= 2
    assert np.abs(row[20] - (0, 200, 0)).max() <= 2
    assert np.abs(row[-1] - (0, 0, 200)).max() <= 2


@pytest.mark.few(2)
@pytest.mark.parametrize("shape", [(30, 40), (300, 400), (12, 16), (200, 80)])
def test_images_cover_the_picture(shape: tuple[int, int]) -> None:
    check_blocks(drawn(blocks(shape)))


def test_a_wide_image_is_cut_at_its_sides() -> None:
    row = drawn(blocks((30, 1200))).srgb[0].astype(int)
    assert np.abs(row - (0, 200, 0)).max() <= 2


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "A.JPEG"])
def test_images_are_read_from_files(name: str, tmp_path: Path) -> None:
    Image.fromarray(blocks((60, 80))).save(tmp_path / name, quality=98, subsampling=0)
    for path in (tmp_path / name, str(tmp_path / name)):
        row = drawn(path).srgb[0].astype(int)
        assert np.abs(row[[0, 20, -1]] - np.diag([200] * 3)).max() <= 6


def test_gray_images_and_clear_ones_are_read(tmp_path: Path) -> None:
    Image.fromarray(np.full((30, 40), 100, dtype=np.uint8)).save(tmp_path / "gray.png")
    assert np.abs(corners(drawn(tmp_path / "gray.png")).astype(int) - 100).max() <= 1
    clear = np.zeros((30, 40, 4), dtype=np.uint8)
    clear[:, :20, 3] = 255
    Image.fromarray(clear).save(tmp_path / "clear.png")
    row = drawn(tmp_path / "clear.png").srgb[0]
    assert (row[0] == 0).all()
    assert (row[-1] == 255).all()


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_files_are_radiance(channels: int, tmp_path: Path) -> None:
    image = np.full((30, 40, channels), 0.25, dtype=np.float32)
    image[:, 20:] = 3.0
    if channels == 4:
        image[..., 3] = 1.0
    (tmp_path / "a.exr").write_bytes(exr_bytes(image[..., 0] if channels == 1 else image))
    picture = drawn(tmp_path / "a.exr")
    np.testing.assert_allclose(picture[0, 0], 0.25)
    np.testing.assert_allclose(picture[0, -1], 3.0)
    assert np.abs(picture.srgb[0, 0].astype(int) - 137).max() <= 1
    assert (picture.srgb[0, -1] == 255).all()


def test_floats_are_linear() -> None:
    picture = drawn(np.full((3, 4, 3), 0.25))
    np.testing.assert_allclose(picture[0, 0], 0.25, rtol=1e-5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("steelbleu", 'did you mean "steelblue"'),
        (("white",), "backdrop must be one of light, dark"),
        (("white", "blu"), 'a color of the backdrop.*did you mean "blue"'),
        ((0.1, 0.2, 3), "three numbers from 0 to 1"),
        (7, "backdrop must be one of light, dark"),
        ("#12345", "backdrop must be one of"),
        (np.zeros((4, 4)), r"shape \(h, w, 3\), not \(4, 4\)"),
        (np.zeros((0, 4, 3)), r"shape \(h, w, 3\), not \(0, 4, 3\)"),
        (np.full((4, 4, 3), np.nan), "finite numbers"),
        (np.full((4, 4, 3), 200), "bytes \\(uint8\\) or floats, not int64"),
        ("missing.png", r"missing\.png: there is no such file"),
        (Path("a.tiff"), r"a\.tiff: a backdrop is an image: \.png"),
    ],
)
def test_what_is_no_backdrop_is_said(given: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        drawn(given)


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr"])
def test_files_that_hold_no_image_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"no image at all")
    with pytest.raises(ValueError, match=f"a{name[1:]}: this is no image that can be read as"):
        drawn(tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match="this is a directory"):
        drawn(tmp_path / name)


def test_names_of_colors_are_those_of_css() -> None:
    assert len(NAMED_COLORS) == 148
    assert parse_color("RebeccaPurple", "it") == (0x66 / 255, 0x33 / 255, 0x99 / 255)
