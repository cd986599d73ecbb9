"""What is seen from where, and before which backdrop."""

from __future__ import annotations

import contextlib
import copy
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

import harnack as hk
from harnack.cli import main
from harnack.geometry import example_curves
from harnack.rendering import register, scales
from harnack.rendering.framing import rotation_to_z_up
from harnack.rendering.scales import ColorScale

FIELD = hk.SolidAngle(example_curves.wavy_polygon(24))
mi = register()
GYROID = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))


def draw(what: Any = FIELD, **settings: Any) -> Any:
    return hk.render(what, **{"size": (64, 48), "spp": 4, "progress": False, **settings})


def seen(camera: Any, **settings: Any) -> np.ndarray:
    return draw(camera=camera, show="status", **settings) == hk.RayStatus.HIT


def middle(mask: np.ndarray) -> np.ndarray:
    return np.argwhere(mask).mean(axis=0)[::-1]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "position", [(3.0, 3.0, 3.0), (0.3, -4.0, 0.1), (0.0, 0.0, 5.0), (1, 2, -9)]
)
def test_a_position_is_where_the_camera_stands(position: tuple[float, float, float]) -> None:
    """The nearest depth is that of the nearest point; and the surface is in the picture, whole."""
    depth = draw(camera=position, show="depth", size=(96, 72))
    distance = np.linalg.norm(np.array(position) - hk.distance.closest_points(FIELD, [position])[0])
    assert depth.min() == pytest.approx(distance, abs=0.03 * distance)
    hit = np.isfinite(depth)
    assert hit.any()
    assert not any(side.any() for side in (hit[0], hit[-1], hit[:, 0], hit[:, -1]))
    assert max(np.ptp(np.argwhere(hit), axis=0) / (72, 96)) > 0.6


def test_a_target_is_in_the_middle() -> None:
    box = hk.Box((-1, -1, -1), (1, 1, 1))
    from_left = hk.Camera(azimuth=-90, elevation=0, box=box, target=(-1.0, 0.0, 0.0), distance=6.0)
    from_right = hk.Camera(azimuth=-90, elevation=0, box=box, target=(1.0, 0.0, 0.0), distance=6.0)
    left, right = middle(seen(from_left)), middle(seen(from_right))
    assert left[0] > 36  # the surface lies to the right of what is looked at
    assert right[0] < 28
    straight = hk.Camera(azimuth=-90, elevation=0, target=(0.0, 0.0, 0.0))
    assert middle(seen(straight)) == pytest.approx([31.5, 23.5], abs=3)


def test_a_distance_is_that_from_the_target() -> None:
    camera = hk.Camera(azimuth=30, elevation=40, target=(0.0, 0.0, 0.0), distance=5.0)
    a, e = math.radians(30), math.radians(40)
    place = 5 * np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    np.testing.assert_array_equal(
        draw(camera=camera, show="depth"),
        draw(camera=hk.Camera(position=tuple(place), target=(0.0, 0.0, 0.0)), show="depth"),
    )


def test_a_fixed_angle_of_view_sees_less_from_nearer() -> None:
    near, far = (seen(hk.Camera(position=(0, -d, 0.0), fov=40)).sum() for d in (4.0, 8.0))
    assert near > 3 * far


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"position": (1, 2)}, "position"),
        ({"target": (1, 2, math.nan)}, "target"),
        ({"distance": 0}, "distance"),
        ({"position": (1, 2, 3), "distance": 2.0}, "position or distance"),
        ({"position": (1, 2, 3), "target": (1, 2, 3)}, "same point"),
        ({"azimuth": math.inf}, "azimuth"),
        ({"box": hk.Box((1, 1, 1), (1, 1, 1))}, "larger than a point"),
    ],
)
def test_cameras_that_cannot_be(settings: dict[str, Any], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        hk.Camera(**settings)


@pytest.mark.parametrize(
    "settings", [{"fov": "40"}, {"azimuth": "x"}, {"zoom": [1]}, {"distance": True}]
)
def test_what_is_no_number_is_named(settings: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match=f"{next(iter(settings))} of a camera must be a number"):
        hk.Camera(**settings)


@pytest.mark.parametrize("camera", ["front", "123", (1, 2), 3, {"position": (1, 2, 3)}])
def test_what_is_no_camera_is_refused(camera: Any) -> None:
    with pytest.raises(TypeError, match=r"Camera\(azimuth"):
        draw(camera=camera)


@pytest.mark.parametrize(
    "up", ["x", "y", "z", "-x", "-y", "-z", (1, 2, -3), (0, 0, -2), (0, 0, 1e-9)]
)
def test_up_is_turned_to_z_and_lengths_are_kept(up: Any) -> None:
    turn = rotation_to_z_up(up)
    way = up
    if isinstance(up, str):
        way = (-1 if up[0] == "-" else 1) * np.eye(3)["xyz".index(up[-1])]
    np.testing.assert_allclose(turn @ way / np.linalg.norm(way), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_up_turns_the_picture() -> None:
    """A surface turned by hand looks as one that is turned by the stage."""
    turned = hk.SolidAngle(example_curves.wavy_polygon(24) @ rotation_to_z_up("x").T)
    a, b = draw(turned, show="depth"), draw(up="x", show="depth")
    both = np.isfinite(a) & np.isfinite(b)
    assert (np.isfinite(a) != np.isfinite(b)).mean() < 0.01
    np.testing.assert_allclose(a[both], b[both], rtol=1e-3)


@pytest.mark.parametrize("up", ["w", "", "--x", (0, 0, 0), (1, 2)])
def test_what_is_no_direction_is_refused(up: Any) -> None:
    with pytest.raises(ValueError, match="up"):
        draw(up=up)


@pytest.mark.few(1)
@pytest.mark.parametrize("show", ["path", "shaded"])
def test_white_is_white_and_transparent_is_as_much_as_is_covered(show: str, tmp_path: Path) -> None:
    from PIL import Image

    white = draw(show=show, backdrop="white", path=tmp_path / "white.png")
    clear = draw(show=show, backdrop="transparent", path=tmp_path / "clear.png")
    assert white.shape == (48, 64, 3)
    assert clear.shape == (48, 64, 4)
    hit = draw(show="status") == hk.RayStatus.HIT
    alpha = clear[..., 3]
    assert alpha.min() == 0
    assert alpha.max() == 1
    assert np.abs(alpha - hit).mean() < 0.05
    free = alpha == 0
    assert (clear[free] == 0).all()
    np.testing.assert_array_equal(white[free], 1)
    np.testing.assert_allclose(white, clear[..., :3] + (1 - alpha[..., None]), atol=1e-6)
    on_white, with_alpha = Image.open(tmp_path / "white.png"), Image.open(tmp_path / "clear.png")
    assert (on_white.mode, with_alpha.mode) == ("RGB", "RGBA")
    assert (np.asarray(on_white)[free] == 255).all()
    np.testing.assert_array_equal(np.asarray(with_alpha)[..., 3] == 0, np.round(alpha * 255) == 0)


TORUS = hk.Torus(1, 0.3)


@pytest.mark.few(1)
@pytest.mark.parametrize("show", ["path", "shaded"])
@pytest.mark.parametrize(
    "settings",
    [
        {"camera": hk.Camera(elevation=-90)},
        {"camera": (0.0, 0.0, -5.0)},
        {"camera": hk.Camera(zoom=0.1)},
        {"size": (20, 100)},
    ],
)
def test_the_lamp_is_not_in_the_picture(show: str, settings: dict[str, Any]) -> None:
    alpha = draw(TORUS, show=show, backdrop="transparent", **settings)[..., 3]
    hit = draw(TORUS, show="status", **settings) == hk.RayStatus.HIT
    assert hit.any()
    near = np.zeros_like(hit)
    rows, columns = np.nonzero(hit)
    for y, x in zip(rows, columns, strict=True):
        near[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = True
    assert (alpha[~near] == 0).all()


def test_lights_are_hidden_from_the_camera_alone() -> None:
    """The lamp, a ball that both its sides of shine, still lights what is behind it."""
    lamp = {
        "type": "sphere", "center": [0, 0, 0.5], "radius": 0.2,
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
    }  # fmt: skip
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "hide_emitters": True},
        "sensor": {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 24},
        },
        "lamp": lamp,
        "floor": {"type": "rectangle"},
    }
    hidden = hk.render(scene, spp=64, progress=False)
    middle = hidden[10:14, 10:14].mean()
    assert 0.2 < middle < 4  # the floor under the lamp
    assert middle > hidden[0, 0].mean()
    scene["integrator"]["hide_emitters"] = False
    assert hk.render(scene, spp=64, progress=False)[11:13, 11:13].mean() > 4.9


@pytest.mark.parametrize(("depth", "light"), [(0, 0.0), (1, 1.0), (-1, 1.0)])
def test_a_path_of_no_edge_sees_nothing(depth: int, light: float) -> None:
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "max_depth": depth},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "sky": {"type": "constant"},
    }
    np.testing.assert_allclose(hk.render(scene, spp=4, progress=False), light, atol=1e-6)


def test_the_depth_of_another_integrator_is_taken() -> None:
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "center": [0, 0, 5], "radius": 9},
    }
    assert hk.render(scene, spp=4, progress=False).max() == 0


@pytest.mark.few(1)
@pytest.mark.parametrize("show", ["path", "shaded"])
@pytest.mark.parametrize("far", [50.0, 1e3, 4e3])
def test_a_surface_seen_from_far_away_is_as_large(show: str, far: float) -> None:
    """The camera frames it: a picture from farther away is a picture with less perspective."""
    camera = hk.Camera(azimuth=0, elevation=0, distance=far)
    alpha = draw(hk.Sphere(1.0), show=show, camera=camera, backdrop="transparent")[..., 3]
    assert alpha.mean() == pytest.approx(math.pi / 4 * 0.86**2 * 0.75, rel=0.06)


def test_a_camera_too_far_away_is_refused() -> None:
    with pytest.raises(ValueError, match="single precision"):
        draw(hk.Sphere(1.0), camera=(1e5, 0.0, 0.0))


def test_a_surface_far_from_the_origin_is_refused_or_blurred() -> None:
    """Single precision rounds coordinates of maps to half a meter: the picture was another one."""
    with pytest.raises(ValueError, match="move it to the origin"):
        draw(hk.Sphere(1.0).translated((4e5, 5.8e6, 100.0)), show="status")
    with pytest.warns(UserWarning, match="blurred"):
        draw(hk.Sphere(1.0).translated((2e4, 0.0, 0.0)), show="status")


@pytest.mark.parametrize(
    "settings", [{"position": (5.0, 0, 2)}, {"position": (5.0, 0, 2), "fov": 40}, {"distance": 6}]
)
def test_zoom_comes_closer_from_any_place(settings: dict[str, Any]) -> None:
    one, two = (seen(hk.Camera(zoom=zoom, **settings)).sum() for zoom in (0.5, 1.0))
    assert two / one == pytest.approx(4, rel=0.25)


def test_exr_files_keep_alpha(tmp_path: Path) -> None:
    import OpenEXR

    image = draw(backdrop="transparent", show="shaded", path=tmp_path / "a.exr")
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        np.testing.assert_array_equal(file.channels()["RGBA"].pixels, image)


def test_the_alpha_of_a_film_is_kept() -> None:
    film = {"type": "hdrfilm", "width": 32, "height": 24, "pixel_format": "rgba"}
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path"},
        "light": {"type": "directional", "direction": [0, 0, -1]},
        "sensor": {"type": "orthographic", "film": film},
        "surface": hk.rendering.mitsuba_shape(GYROID),
    }
    image = hk.render(scene, spp=4, progress=False)
    assert image.shape == (24, 32, 4)
    assert 0 < image[..., 3].mean() < 1
    film["pixel_format"] = "rgb"
    assert hk.render(scene, spp=4, progress=False).shape == (24, 32, 3)


# Not in color at 0 degrees: there the light on the ground itself ends within a few pixels.
@pytest.mark.few(1)
@pytest.mark.parametrize("backdrop", ["light", "dark"])
@pytest.mark.parametrize(
    ("show", "elevation"),
    [("path", 4.0), ("path", -20.0), ("shaded", 4.0), ("shaded", 0.0), ("shaded", -20.0)],
)
def test_there_is_no_edge_behind_the_surface(show: str, backdrop: str, elevation: float) -> None:
    camera = hk.Camera(elevation=elevation, zoom=0.4)
    image = draw(show=show, backdrop=backdrop, camera=camera, size=(96, 72), spp=64)
    column = image[:, :12].mean(axis=(1, 2))  # left of the surface, from the wall to the ground
    assert np.abs(np.diff(column)).max() < 0.12 * column.max()
    assert column.min() > 1e-3


@pytest.mark.slow
def test_a_tube_is_drawn_around_the_curve() -> None:
    """It sticks out of the surface by its radius, and follows circles."""
    bare = np.isfinite(draw(show="depth"))
    thick = np.isfinite(draw(show="depth", boundary_radius=0.1))
    assert thick.sum() > 1.05 * bare.sum()
    ring = hk.SolidAngle(hk.geometry.Circle(1.0, (0, 0, 0), (0, 0, 1)))
    camera = hk.Camera(elevation=90, box=hk.Box((-1.2, -1.2, -0.2), (1.2, 1.2, 0.2)))
    areas = [
        np.isfinite(draw(ring, show="depth", camera=camera, size=(96, 96), **rim)).sum()
        for rim in ({}, {"boundary_radius": 0.1})
    ]
    assert areas[1] / areas[0] == pytest.approx(1.1**2, rel=0.03)


@pytest.mark.parametrize("radius", [0, -1, math.nan, math.inf, "wide", True])
def test_a_tube_needs_a_radius(radius: Any) -> None:
    with pytest.raises(ValueError, match="boundary_radius is"):
        draw(boundary_radius=radius)


def test_a_tube_needs_a_curve() -> None:
    with pytest.raises(ValueError, match="ends at a curve"):
        draw(GYROID, boundary_radius=0.1)


@pytest.mark.slow
def test_pictures_show_themselves() -> None:
    image = draw(show="shaded")
    assert image._repr_png_().startswith(b"\x89PNG")
    assert image.srgb.shape == (48, 64, 3)
    assert image.to_pil().size == (64, 48)
    for made in (image[:, :, 0], image + 1, image.mean(axis=0), np.sqrt(image)):
        assert type(made) is np.ndarray
    assert isinstance(image.mean(), np.floating)
    assert not hasattr(image[0], "srgb")
    for same in (image.copy(), copy.copy(image), copy.deepcopy(image)):
        np.testing.assert_array_equal(same.srgb, image.srgb)
    sent = pickle.loads(pickle.dumps(image))
    np.testing.assert_array_equal(sent, image)
    np.testing.assert_array_equal(sent.srgb, image.srgb)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "arguments",
    [
        ["gyroid", "--side", "between", "--level", "-0.3,0.3", "--clip", "ball:0,0,0,3"],
        ["gyroid", "--side", "below", "--level", "0.1", "--backdrop", "white"],
        ["trefoil", "--position", "-5,5,2", "--target", "0,0,0", "--backdrop", "transparent"],
        [
            "polygon",
            "--clip",
            "box:-1,-1,-1,0,1,1",
            "--enclosures",
            "slope",
            "--zoom",
            "0.9",
            "--fov",
            "40",
        ],
        ["trefoil", "--up", "x", "--level", "2pi", "--boundary-radius", "0.1"],
        ["gyroid", "--up", "-x", "--backdrop", "white,steelblue"],
        ["trefoil", "--isolines", "z:0.2", "--isolines-width", "0.02", "--isolines-color", "#fff"],
    ],
)
def test_options_of_the_command(arguments: list[str], tmp_path: Path) -> None:
    target = tmp_path / "a.png"
    small = ["--show", "shaded", "--size", "32x24", "--spp", "1", "--quiet", "-o", str(target)]
    assert main(["render", *arguments, *small]) == 0
    assert target.stat().st_size > 300


@pytest.mark.slow
def test_values_with_a_bar_from_the_command_line(tmp_path: Path) -> None:
    asked = ["--show", "value", "--color-by", "z", "--color-range", "-1:1", "--color-bar"]
    small = ["--size", "32x24", "--quiet", "-o", str(tmp_path / "a.png")]
    assert main(["render", "trefoil", *asked, *small]) == 0
    assert np.array(mi.Bitmap(str(tmp_path / "a.png"))).shape[1] > 50


@pytest.mark.few(2)
@pytest.mark.parametrize("up", ["-x", "-y", "-z"])
def test_axes_with_a_minus_turn_files_from_the_command_line(up: str, tmp_path: Path) -> None:
    """As a field that is turned by hand."""
    curve = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 3]])
    lines = [*(f"v {x} {y} {z}" for x, y, z in curve.tolist()), "l 1 2 3 4 1"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    small = ["--show", "depth", "--size", "32x24", "--quiet", "-o", str(tmp_path / "a.exr")]
    assert main(["render", str(tmp_path / "a.obj"), "--up", up, *small]) == 0
    turned = hk.SolidAngle(curve @ rotation_to_z_up(up).T)
    expected = hk.render(turned, show="depth", size=(32, 24), progress=False)
    # Not by Mitsuba, which waits for ever where Dr.Jit has one thread.
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        found = np.array(file.channels()["Y"].pixels)
    met = np.isfinite(expected)
    assert met.any()
    np.testing.assert_allclose(found[met], expected[met], rtol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["trefoil", "--backdrop", "whit"], 'did you mean "white"'),
        (["trefoil", "--backdrop", "white,steelbleu"], 'did you mean "steelblue"'),
        (["trefoil", "--backdrop", "missing.png"], "missing.png: there is no such file"),
        (["trefoil", "--up", "w"], "x, y, z, -x, -y, -z"),
        (["trefoil", "--isolines", "z"], "a coordinate or a formula, and an interval, as z:0.1"),
        (["trefoil", "--isolines", "w:1"], "'w' is unknown"),
        (["trefoil", "--show", "value", "--color-by", "x*"], "'x*' is no formula"),
        (["trefoil", "--isolines", "z:0"], "positive"),
        (["trefoil", "--isolines-color", "red"], "give --isolines too"),
        (["trefoil", "--show", "value"], "such as --color-by z"),
        (["trefoil", "--enclosures", "slop"], 'did you mean "slope"'),
        (["trefoil", "--position", "1,2"], "3 numbers"),
        (["trefoil", "--side", "below"], "real-valued"),
        (["letters", "--zoom", "-1"], "positive"),
        (["trefoil", "--position", "1,2,3", "--distance", "2"], "position or distance"),
    ],
)
def test_options_that_cannot_be(
    arguments: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.suppress(SystemExit):
        assert main(["render", *arguments, "--quiet"]) != 0
    assert complaint in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.few(1)
@pytest.mark.parametrize("show", ["value", "depth", "evaluations"])
def test_pictures_of_numbers_stand_before_a_color(show: str) -> None:
    asked = {"color_by": "z"} if show == "value" else {}
    picture = hk.render(
        hk.Sphere(1.0), show=show, backdrop="white", color_bar=True, size=(40, 120),
        progress=False, **asked,
    )  # fmt: skip
    assert (picture.srgb[-1, -1] == 255).all()
    if show != "evaluations":
        assert (picture.srgb[0, 0] == 255).all()
    light = hk.render(hk.Sphere(1.0), show=show, backdrop="light", size=(8, 6), **asked)
    assert show == "evaluations" or light.srgb[0, 0].min() > 200
    for other in ("transparent", ("white", "black")):
        with pytest.raises(ValueError, match="must be one color"):
            hk.render(hk.Sphere(1.0), show=show, backdrop=other, **asked)


def test_titles_of_bars_have_the_letters_of_some_typeface(monkeypatch: pytest.MonkeyPatch) -> None:
    """ψ and ö were refused. Machines without a typeface that has them say so."""
    with contextlib.suppress(ValueError):
        face = scales.typeface_for("ψ in Höhe", 12)
        assert bytes(face.getmask("ψ")) != bytes(face.getmask("ö"))
        seen = hk.render(
            hk.Sphere(1.0), show="depth", color_bar="ψ in Höhe", size=(40, 30), progress=False
        )
        assert seen.srgb.shape[1] > 40
    monkeypatch.setattr(scales, "_TYPEFACES", ())
    with pytest.raises(ValueError, match=r"no typeface .* all letters of 'über 4π'"):
        hk.render(hk.Sphere(1.0), show="depth", color_bar="über 4π")
    with pytest.raises(ValueError, match="one line of letters"):
        hk.render(hk.Sphere(1.0), show="depth", color_bar="a\nb")


@pytest.mark.parametrize(("low", "high"), [(-0.953, 0.9999), (-0.7767, 0.9999)])
def test_small_bars_have_nice_numbers(low: float, high: float) -> None:
    assert [text for _, text in ColorScale(low, high, "z").ticks(4)] == ["-0.5", "0", "0.5"]


def test_a_camera_has_a_position_or_angles() -> None:
    """The angles were ignored."""
    for name in ("azimuth", "elevation", "distance"):
        with pytest.raises(ValueError, match=f"a position or {name}, not both"):
            hk.Camera(position=(1, 2, 3), **{name: 10.0})
    assert hk.Camera().azimuth_elevation == (-50.0, 28.0)
    assert hk.Camera(elevation=10.0).azimuth_elevation == (-50.0, 10.0)
