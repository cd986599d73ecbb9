"""Films: one frame for all pictures, nothing compiled from one to the next, all or nothing."""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from PIL import Image, ImageSequence

import harnack as hk
from harnack.cli import main
from harnack.geometry import example_curves

FIELD = hk.SolidAngle(example_curves.wavy_polygon(24))
SMALL: dict[str, Any] = {"size": (48, 36), "spp": 1, "progress": False}


def pictures(path: Path) -> list[np.ndarray]:
    with Image.open(path) as film:
        return [np.asarray(one.convert("RGB")).astype(int) for one in ImageSequence.Iterator(film)]


def orange(picture: np.ndarray) -> np.ndarray:
    return np.abs(picture[..., 0] - picture[..., 2]) > 40


@pytest.mark.slow
def test_a_turntable_goes_around_once(tmp_path: Path) -> None:
    hk.animate(FIELD, tmp_path / "a.gif", orbit=360, frames=6, **SMALL)
    film = pictures(tmp_path / "a.gif")
    assert len(film) == 6
    assert film[0].shape == (36, 48, 3)
    # The polygon has three waves: a third of a turn later it looks the same, but for the light.
    shown = [orange(one) for one in film]
    assert (shown[0] != shown[1]).mean() > 0.05
    assert (shown[0] != shown[2]).mean() < 0.02
    assert (shown[0] != shown[4]).mean() < 0.02
    for one in shown:  # whole, in each picture
        assert one.any()
        assert not one[[0, -1]].any()


def test_the_frame_stays_while_a_surface_grows(tmp_path: Path) -> None:
    """Balls of radii 1 to 2 are drawn of that size, and not each as large as the picture."""
    hk.animate(lambda s: hk.Sphere(1 + s), tmp_path / "a.gif", frames=3, show="normal", **SMALL)
    background = pictures(tmp_path / "a.gif")[0][0, 0]
    areas = [(np.abs(one - background).sum(axis=-1) > 30).sum() for one in
             pictures(tmp_path / "a.gif")]  # fmt: skip
    assert areas[1] / areas[0] == pytest.approx(2.25, rel=0.15)
    assert areas[2] / areas[0] == pytest.approx(4, rel=0.15)


@pytest.mark.slow
def test_every_setting_may_move(tmp_path: Path) -> None:
    hk.animate(
        FIELD, tmp_path / "a.gif", frames=3, level=lambda s: 3 + 6 * s, camera=hk.Camera(zoom=0.8),
        material=lambda s: ("copper", "clay", "gold")[round(2 * s)], **SMALL,
    )  # fmt: skip
    a, b, c = pictures(tmp_path / "a.gif")
    assert np.abs(a - b).mean() > 2
    assert np.abs(b - c).mean() > 2
    path = [(4.0, -4.0, 2.0), (2.0, -5.0, 3.0)]
    hk.animate(FIELD, tmp_path / "b.gif", frames=2, camera=lambda s: path[round(s)], **SMALL)
    hk.render(FIELD, tmp_path / "b.png", camera=path[1], show="shaded", **SMALL)
    last = np.asarray(Image.open(tmp_path / "b.png")).astype(int)
    assert np.abs(pictures(tmp_path / "b.gif")[1] - last).mean() < 4  # of colors, a GIF has 256


def area(picture: np.ndarray) -> int:
    return int((np.abs(picture - picture[0, 0]).sum(axis=-1) > 30).sum())


def test_the_camera_comes_closer(tmp_path: Path) -> None:
    normal = SMALL | {"show": "normal", "frames": 3}
    hk.animate(FIELD, tmp_path / "a.gif", camera=lambda s: hk.Camera(zoom=0.4 + 0.4 * s), **normal)
    areas = [area(one) for one in pictures(tmp_path / "a.gif")]
    assert areas[2] / areas[0] == pytest.approx(4, rel=0.3)


@pytest.mark.few(1)
@pytest.mark.parametrize("camera", [(4.0, -6.0, 5.0), hk.Camera(distance=8.0)])
def test_a_camera_that_has_a_place_goes_around_too(camera: Any, tmp_path: Path) -> None:
    still = SMALL | {"frames": 4, "orbit": 360}
    hk.animate(FIELD, tmp_path / "a.gif", camera=camera, **still)
    film = pictures(tmp_path / "a.gif")
    assert len(film) == 4
    assert min(np.abs(film[0] - one).mean() for one in film[1:]) > 2
    assert not any(orange(one)[[0, -1]].any() for one in film)
    hk.render(FIELD, tmp_path / "a.png", camera=camera, show="shaded", **SMALL)
    alone = orange(np.asarray(Image.open(tmp_path / "a.png")).astype(int))
    assert orange(film[0]).sum() > 0.6 * alone.sum()


@pytest.mark.slow
def test_what_is_up_may_change(tmp_path: Path) -> None:
    what = [hk.Torus(1, 0.2), hk.Sphere(0.1)]
    wide = SMALL | {"size": (120, 30), "frames": 4, "show": "normal"}
    hk.animate(what, tmp_path / "a.gif", up=lambda s: "z" if s < 0.5 else "x", **wide)
    for one in pictures(tmp_path / "a.gif"):
        rim = np.abs(one[[0, -1]] - one[0, 0]).sum(axis=-1)
        assert (rim < 30).all()


@pytest.mark.slow
@pytest.mark.parametrize("show", ["shaded", pytest.param("path", marks=pytest.mark.slow)])
def test_nothing_is_compiled_after_the_second_picture(show: str, tmp_path: Path) -> None:
    counts: list[int] = []

    def moved(s: float) -> hk.Field:
        kernels = dr.kernel_history((dr.KernelType.JIT,))
        counts.append(sum(not one["cache_hit"] or one["cache_disk"] for one in kernels))
        vertices = example_curves.wavy_polygon(24) * (
            1 + np.random.default_rng(round(99 * s)).random()
        )
        return hk.SolidAngle(vertices)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        hk.animate(moved, tmp_path / "a.gif", frames=3, orbit=40, show=show, **SMALL)
        dr.kernel_history_clear()
        hk.animate(moved, tmp_path / "a.gif", frames=4, orbit=50, show=show, **SMALL)
        kernels = dr.kernel_history((dr.KernelType.JIT,))
    assert sum(not one["cache_hit"] or one["cache_disk"] for one in kernels) == 0


@pytest.mark.slow
def test_a_film_in_mp4(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    hk.animate(
        FIELD, tmp_path / "a.mp4", frames=5, fps=12.5, orbit=90, **{**SMALL, "size": (49, 37)}
    )
    with av.open(str(tmp_path / "a.mp4")) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert float(film.streams.video[0].average_rate) == 12.5
    assert len(frames) == 5
    assert frames[0].shape == (36, 48, 3)
    assert np.abs(frames[0].astype(int) - frames[4]).mean() > 3


@pytest.mark.few(6)
@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"path": "a.avi"}, r"\.gif or \.mp4"),
        ({"frames": 0}, "frames must be from 1"),
        ({"fps": 0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"orbit": float("inf")}, "orbit"),
        ({"material": "golf"}, "gold"),
        ({"path": "a.mp4", "backdrop": "transparent"}, "no alpha"),
        ({"path": "a.mp4", "size": (1, 20)}, "at least 2 pixels"),
    ],
)
def test_films_that_cannot_be(settings: dict[str, Any], complaint: str, tmp_path: Path) -> None:
    target = tmp_path / settings.pop("path", "a.gif")
    with pytest.raises(ValueError, match=complaint):
        hk.animate(FIELD, target, **{**SMALL, "frames": 2, **settings})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["size", "show"])
def test_what_is_the_same_for_all_pictures_is_no_function(name: str, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=f"{name} is the same for all pictures of a film"):
        hk.animate(FIELD, tmp_path / "a.gif", **{**SMALL, name: lambda s: s})
    assert list(tmp_path.iterdir()) == []


def test_a_function_of_coordinates_is_no_function_of_s(tmp_path: Path) -> None:
    """It is what colors a surface, in films as in pictures."""
    path = tmp_path / "a.gif"
    film = hk.animate(
        hk.Sphere(1.0), path, frames=2, size=(32, 24), show="value", progress=False,
        color_by=lambda x, y, z: x + y * z,
    )  # fmt: skip
    assert film.path == path
    assert path.stat().st_size > 0


def test_classes_of_enclosures_are_no_functions(tmp_path: Path) -> None:
    """A film refused them as functions of s."""
    bounds = {"enclosures": hk.proofs.LipschitzEnclosure, "show": "normal", "frames": 1}
    hk.animate(hk.Sphere(1.0), tmp_path / "a.gif", **{**SMALL, **bounds})
    assert len(pictures(tmp_path / "a.gif")) == 1


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_films_have_room_for_color_bars(name: str, tmp_path: Path) -> None:
    settings = {"frames": 2, "show": "value", "color_by": "z", "color_bar": True}
    hk.animate(FIELD, tmp_path / name, orbit=90, **{**SMALL, **settings})
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / name)) as film:
        frame = next(film.decode(video=0)).to_ndarray(format="rgb24")
    assert frame.shape[1] > SMALL["size"][0] + 10


@pytest.mark.parametrize("settings", [{"orbit": "360"}, {"fps": "24"}, {"fps": None}])
def test_what_is_no_number_is_named(settings: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=f"{next(iter(settings))} must be a number"):
        hk.animate(FIELD, tmp_path / "a.gif", **SMALL, **settings)


def test_what_is_missing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("av", "PIL.Image"):
        monkeypatch.setitem(sys.modules, module, None)
    for name in ("a.gif", "a.mp4"):
        with pytest.raises(ModuleNotFoundError, match=r"harnack\[film\]"):
            hk.animate(FIELD, tmp_path / name, frames=2, **SMALL)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "a.gif"
    arguments = ["--frames", "3", "--size", "32x24", "--spp", "1", "--quiet", "--backdrop", "white"]
    assert main(["animate", "trefoil", "-o", str(target), *arguments]) == 0
    assert "wrote" in capsys.readouterr().out
    assert len(pictures(target)) == 3
    assert (pictures(target)[0][0, 0] == 255).all()
    assert main(["animate", "trefoil", "-o", str(tmp_path / "a.txt")]) != 0


def test_transparent_films_keep_their_colors(tmp_path: Path) -> None:
    """Found by a user: they had a hundred colors a frame, and bands."""
    hk.animate(
        hk.Sphere(1.0), tmp_path / "a.gif", backdrop="transparent", frames=1, size=(96, 72),
        orbit=90, progress=False,
    )  # fmt: skip
    with Image.open(tmp_path / "a.gif") as film:
        frame = np.array(film.convert("RGBA"))
    opaque = frame[..., 3] > 0
    assert 0.1 < opaque.mean() < 0.9
    assert len(np.unique(frame[opaque][:, :3], axis=0)) > 150


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_notebooks_show_a_film(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    film = hk.animate(hk.Sphere(1.0), path, frames=2, show="normal", **SMALL)
    shown = film._repr_html_()
    assert base64.b64decode(re.findall('base64,([^"]*)"', shown)[0]) == path.read_bytes()
    assert shown.startswith("<img" if ending == "gif" else "<video")
