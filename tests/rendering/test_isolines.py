"""Lines on surfaces where another function takes given values: where they are, and how wide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy
from harnack.backend.arrays import upload_vectors
from harnack.rendering import mitsuba_shape, register
from harnack.rendering.isolines import isoline_index_at
from harnack.tracer import RayStatus

mi = register()
BACKEND = choose_backend("double")
SMALL: dict[str, Any] = {"size": (64, 48), "progress": False}
CIRCLE = hk.SolidAngle(hk.geometry.example_curves.wavy_polygon(24))


def covered(lines: hk.Isolines, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    prepared = lines.upload(BACKEND, size=1.0)
    p, n = upload_vectors(BACKEND, points), upload_vectors(BACKEND, normals)
    return np.broadcast_to(to_numpy(prepared.contains(p, n)), len(points))


def on_sphere(count: int) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def around_cylinder(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the cylinder of radius 1 around the z-axis with |z| < 2, and normals."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-2, 2, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * z])
    return normals + z[:, None] * np.array([0.0, 0.0, 1.0]), normals


def check_distances(lines: hk.Isolines, points: Any, normals: Any, away: Any, width: float) -> None:
    """That lines are where points are less than half the width away from them."""
    on = covered(lines, points, normals)
    assert 0.002 < on.mean() < 0.9
    assert on[away < 0.48 * width].all()
    assert not on[away > 0.52 * width].any()


def test_contour_lines_of_a_sphere_are_as_wide_at_its_equator_as_near_its_poles() -> None:
    points, levels, width = on_sphere(100_000), [0.0, 0.5, -0.9], 0.02
    latitude = np.arcsin(points[:, 2])
    away = np.abs(latitude[:, None] - np.arcsin(levels)).min(axis=1)
    check_distances(hk.Isolines("z", levels, width=width), points, points, away, width)


def test_width_does_not_depend_on_how_steep_the_function_is() -> None:
    points, normals = around_cylinder(100_000)
    width = 0.02
    lines = hk.Isolines(lambda x, y, z: hk.math.exp(3 * z), np.exp([-3.0, 0.0, 4.5]), width=width)
    away = np.abs(points[:, 2:] - np.array([-1.0, 0.0, 1.5])).min(axis=1)
    check_distances(lines, points, normals, away, width)


def test_spacing_is_lines_at_its_multiples() -> None:
    points, normals = around_cylinder(20_000)
    away = np.abs(points[:, 2] - 0.3 * np.round(points[:, 2] / 0.3))
    check_distances(hk.Isolines("z", interval=0.3, width=0.04), points, normals, away, 0.04)


@pytest.mark.parametrize("count", [1, 2, 5, 63, 64, 200])
def test_the_nearest_of_many_levels_is_found(count: int) -> None:
    points, normals = around_cylinder(20_000)
    levels = np.random.default_rng(count).uniform(-2, 2, count)
    away = np.abs(points[:, 2:] - levels).min(axis=1)
    width = 0.4 / count
    check_distances(hk.Isolines("z", levels, width=width), points, normals, away, width)


class Turn(hk.Field):
    """The angle around the z-axis, from -pi to pi, jumping where it is passed."""

    period = 2 * np.pi

    def evaluate(self, p: Any) -> hk.fields.Sample:
        import drjit as dr

        square = p.x * p.x + p.y * p.y
        return hk.fields.Sample(dr.atan2(p.y, p.x), type(p)(-p.y, p.x, 0) / square, ())


@pytest.mark.parametrize(
    ("settings", "angles"),
    [
        ({"levels": [np.pi]}, [np.pi]),
        ({"levels": [3.1, 0.5]}, [3.1, 0.5]),
        ({"levels": -3.1}, [-3.1]),
        ({"levels": [3.1 + 4 * np.pi]}, [3.1]),
        ({"levels": [0.0]}, [0.0]),
        ({"interval": np.pi / 3}, np.arange(6) * np.pi / 3),
        ({}, np.arange(12) * np.pi / 6),
    ],
)
def test_isolines_of_angles_are_right_where_these_jump(
    settings: dict[str, Any], angles: Any
) -> None:
    points, normals = around_cylinder(50_000)
    angle = np.arctan2(points[:, 1], points[:, 0])
    apart = angle[:, None] - np.asarray(angles)
    away = np.abs(np.angle(np.exp(1j * apart))).min(axis=1)
    check_distances(hk.Isolines(Turn(), width=0.03, **settings), points, normals, away, 0.03)


def test_a_spacing_that_does_not_divide_the_period_is_refused() -> None:
    with pytest.raises(ValueError, match=r"period 6\.28319.*does not divide"):
        hk.Isolines(Turn(), interval=1.0)


def test_lines_near_a_maximum_reach_at_most_half_a_width_too_far() -> None:
    points = on_sphere(400_000)
    width = 0.05
    away = np.arccos(np.clip(points[:, 2], -1, 1))  # from the pole
    for below in (-0.1 * width**2, 0.0, 0.1 * width**2, width**2):
        on = covered(hk.Isolines("z", [1 - below], width=width), points, points)
        line = np.arccos(min(1 - below, 1))
        assert away[on].max() < line + 1.02 * width


def test_a_function_that_is_constant_on_the_surface_has_no_lines() -> None:
    points = on_sphere(50_000)
    lines = hk.Isolines(hk.Sphere(1.0), [0.0], width=0.1)
    single = choose_backend("single")
    p = upload_vectors(single, points)
    assert not to_numpy(lines.upload(single, 1.0).contains(p, p)).any()


def test_the_last_of_several_lines_covers_the_others() -> None:
    points, normals = around_cylinder(5000)
    lines = [hk.Isolines("z", [0.0], width=1.0), hk.Isolines("x", [0.0], width=0.5)]
    p, n = upload_vectors(BACKEND, points), upload_vectors(BACKEND, normals)
    uploaded = tuple(isolines.upload(BACKEND, 1.0) for isolines in lines)
    number = to_numpy(isoline_index_at(uploaded, p, n, BACKEND.UInt32))
    first, second = (covered(isolines, points, normals) for isolines in lines)
    assert (first & second).any()
    np.testing.assert_array_equal(number, np.where(second, 2, np.where(first, 1, 0)))


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        (("w",), {"interval": 1}, "isolines are drawn: 'w' is no formula"),
        ((3,), {"interval": 1}, 'must be a text such as "z" or'),
        (("z",), {}, "say which isolines"),
        (("z", [0]), {"interval": 1}, "either levels or an interval"),
        (("z", []), {}, "at least one"),
        (("z", [np.nan]), {}, "finite"),
        (("z", "high"), {}, "must be numbers"),
        (("z",), {"interval": -1}, "interval of isolines must be positive"),
        (("z", 0), {"width": 0}, "width of isolines must be positive"),
        (("z", 0), {"color": "blak"}, 'did you mean "black"'),
    ],
)
def test_what_is_wrong_is_said(arguments: Any, settings: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        hk.Isolines(*arguments, **settings)


def test_pictures_refuse_isolines_that_make_no_sense() -> None:
    lines = hk.Isolines("z", interval=0.1)
    with pytest.raises(TypeError, match=r"must be harnack\.Isolines"):
        hk.render(CIRCLE, show="shaded", isolines="z", **SMALL)
    with pytest.raises(ValueError, match='isolines need a picture with show="path"'):
        hk.render(CIRCLE, show="depth", isolines=lines, **SMALL)
    with pytest.raises(ValueError, match="on its own level set: it is constant there"):
        hk.render(CIRCLE, show="shaded", isolines=hk.Isolines(CIRCLE), **SMALL)
    with pytest.raises(ValueError, match="isolines: a Mitsuba scene is drawn as it is"):
        hk.render({"type": "scene"}, isolines=lines, **SMALL)


def seen(what: Any, isolines: Any, show: str, **settings: Any) -> np.ndarray:
    asked = {"backdrop": "white", "spp": 16, **SMALL, **settings}
    return hk.render(what, show=show, isolines=isolines, **asked).srgb.astype(int)


@pytest.mark.slow
def test_pictures_of_values_have_isolines_and_smooth_edges() -> None:
    """Numbers are those of one ray a pixel, whatever is drawn; edges are means of several."""
    asked: dict[str, Any] = {"show": "value", "color_by": "x", "backdrop": "white", **SMALL}
    lines = hk.Isolines("x", [0.0], width=0.15, color="black")
    plain, lined = hk.render(CIRCLE, spp=1, **asked), hk.render(CIRCLE, isolines=lines, **asked)
    np.testing.assert_array_equal(plain, np.asarray(lined))
    on_line = (lined.srgb < 60).all(axis=-1) & ~np.isnan(lined)
    assert on_line.any()
    assert np.abs(np.asarray(lined)[on_line]).max() < 0.1
    beside = np.isnan(plain)  # pixels that a ray through the middle does not see covered
    assert (plain.srgb[beside] == 255).all()
    smooth = beside & (hk.render(CIRCLE, **asked).srgb < 255).any(axis=-1)
    assert smooth.any()
    # A line of half a pixel has no gaps.
    thin = hk.Isolines("x", [0.0], width=0.02, color="black")
    with_line, without = (hk.render(CIRCLE, isolines=one, **asked).srgb for one in (thin, None))
    step = np.nanmedian(np.abs(np.diff(plain, axis=1)))
    crossed = np.abs(plain) < 0.4 * step
    assert crossed.sum() > 10
    assert (with_line[crossed] < without[crossed]).any(axis=-1).all()


@pytest.mark.few(1)
@pytest.mark.parametrize("show", ["path", "shaded"])
def test_lines_have_their_colors(show: str) -> None:
    plain = seen(hk.Sphere(1.0), None, show, material="clay")
    width = 0.3
    lines = [hk.Isolines("z", [0.0], width=width, color="blue")]
    image = seen(hk.Sphere(1.0), lines, show, material="clay")
    changed = np.abs(image - plain).max(axis=-1) > 25
    status = hk.render(hk.Sphere(1.0), show="status", **SMALL)
    on = changed & (status == RayStatus.HIT)
    assert (
        0.1 < on.sum() / (status == RayStatus.HIT).sum() < 0.25
    )  # the band has 0.15 of the sphere
    red, green, blue = np.median(image[on], axis=0)
    assert blue > 2 * max(red, green, 1)


@pytest.mark.slow
def test_lines_thinner_than_a_pixel_have_no_gaps_in_shaded_pictures() -> None:
    camera = hk.Camera(elevation=0)
    settings = {"material": "porcelain", "camera": camera, "size": (120, 90)}
    plain = seen(hk.Sphere(1.0), None, "shaded", **settings)
    lines = hk.Isolines("z", [0.013], width=0.012)  # 0.43 pixels
    dark = (plain - seen(hk.Sphere(1.0), lines, "shaded", **settings)).mean(axis=-1)
    columns = dark[:, 30:90].sum(axis=0)
    expected = 0.43 * 200
    assert columns.min() > 0.4 * expected
    assert columns.max() < 2.0 * expected


@pytest.mark.slow
def test_caps_of_solids_show_isolines_of_their_own_function() -> None:
    camera = hk.Camera(elevation=89)
    box = hk.Box((-2, -2, -2), (2, 2, 0))
    settings = {"level": 0.0, "side": "below", "clip": box, "camera": camera, "material": "clay"}
    field = hk.Sphere(1.0)
    plain = seen(field, None, "shaded", **settings)
    levels = field.value(np.array([[0.5, 0.0, 0.0]]))
    image = seen(field, hk.Isolines(field, levels, width=0.1), "shaded", **settings)
    y, x = np.nonzero((plain - image).max(axis=-1) > 60)
    radius = np.hypot(x - x.mean(), y - y.mean())
    assert len(radius) > 30
    assert radius.std() < 0.12 * radius.mean()


@pytest.mark.slow
def test_lines_on_glass_are_opaque_in_shaded_pictures() -> None:
    settings = {"level": 0.0, "side": "below", "material": "glass"}
    lines = hk.Isolines("z", [0.0], width=0.3, color="black")
    plain = seen(hk.Sphere(1.0), None, "shaded", **settings)
    image = seen(hk.Sphere(1.0), lines, "shaded", **settings)
    assert ((image.max(axis=-1) < 40) & (plain.min(axis=-1) > 60)).sum() > 50


@pytest.mark.slow
def test_of_several_surfaces_those_that_a_function_is_constant_on_have_no_lines() -> None:
    other = hk.Torus(1.0, 0.4)
    plain = seen([CIRCLE, other], None, "shaded")
    image = seen([CIRCLE, other], hk.Isolines(CIRCLE, width=0.05), "shaded")
    assert (np.abs(image - plain).max(axis=-1) > 25).sum() > 10


def test_there_are_no_lines_where_the_function_is_not_defined() -> None:
    points, normals = around_cylinder(5000)
    half = hk.expression(lambda x, y, z: z, domain=hk.HalfSpace((1, 0, 0), 0))
    on = covered(hk.Isolines(half, interval=0.5, width=0.1), points, normals)
    everywhere = covered(hk.Isolines("z", interval=0.5, width=0.1), points, normals)
    inside = half.domain.contains_points(points)
    assert 0.3 < inside.mean() < 0.7
    np.testing.assert_array_equal(on, everywhere & inside)


@pytest.mark.slow
def test_shapes_of_mitsuba_scenes_have_lines_in_their_own_coordinates() -> None:
    turned = mi.ScalarTransform4f().translate([5, 0, 0]).rotate([0, 1, 0], 90).scale(2)

    def scene(isolines: Any) -> Any:
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
        ball = mitsuba_shape(hk.Sphere(1.0), bsdf=bsdf, to_world=turned, isolines=isolines)
        look = mi.ScalarTransform4f().look_at([5, -9, 0], [5, 0, 0], [0, 0, 1])
        film = {"type": "hdrfilm", "width": 64, "height": 48}
        sensor = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
        light = {"type": "constant"}
        return {"type": "scene", "light": light, "ball": ball, "sensor": sensor}

    plain = hk.render(scene(None), show="shaded", progress=False)
    image = hk.render(scene(hk.Isolines("z", [0.0], width=0.3)), show="shaded", progress=False)
    y, x = np.nonzero(np.asarray(plain - image).max(axis=-1) > 0.2)
    assert abs(x.mean() - 31.5) < 1
    assert np.ptp(y) > 4 * np.ptp(x)  # z of the ball lies along x of the world
