"""Clear matter in pictures: the laws of Beer and Lambert, Snell and Fresnel, and wrong tints."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.enclosures import Lipschitz
from harnack.fields.field import Field, Sample
from harnack.rendering import Material, mitsuba_shape, register, render
from harnack.rendering.mitsuba import refract

mi = register()
T = mi.ScalarTransform4f
SKY = np.array([0.2, 0.3, 0.5])
EYE = np.array([1.5, -4.0, 2.0])
TINT = np.array([0.8, 0.5, 0.25])
N = 40


class Sphere(Field):
    """|p| - 1."""

    def __init__(self) -> None:
        self.domain = hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> Sample:
        distance = dr.norm(p)
        return Sample(distance - 1.0, p / distance, (Lipschitz(1.0),))


def drawn(*members: Any, show: str = "shaded", spp: int = 1) -> np.ndarray:
    look = T().look_at(origin=EYE.tolist(), target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": N, "height": N, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": SKY.tolist()}}
    named = {f"member{k}": member for k, member in enumerate(members)}
    scene = {"type": "scene", "sensor": sensor, "sky": sky, **named}
    return render(scene, show=show, spp=spp, progress=False)


def ball(index: float, radius: float = 1.0, **settings: Any) -> Any:
    bsdf = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
    settings = {"level": 0.0, "side": "below", "tint": TINT, "tolerance": 1e-5, **settings}
    return mitsuba_shape(Sphere(), bsdf=bsdf, to_world=T().scale(radius), **settings)


def chords(radius: float = 1.0) -> np.ndarray:
    """Lengths in a sphere of the rays through the middles of pixels."""
    back = EYE / np.linalg.norm(EYE)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    place = (2 * (np.arange(N) + 0.5) / N - 1) * np.tan(np.radians(20))
    x, y = np.meshgrid(place, -place)
    d = x[..., None] * right + y[..., None] * np.cross(back, right) - back
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ EYE
    return 2 * np.sqrt(np.maximum(b * b - EYE @ EYE + radius**2, 0))


@pytest.mark.parametrize("require_crossing", [False, True])
def test_a_ball_absorbs_light_by_the_law_of_beer_and_lambert(require_crossing: bool) -> None:
    image, chord = drawn(ball(1.0, require_crossing=require_crossing)), chords()
    expected = SKY * TINT ** chord[..., None]
    assert 0.2 < (chord > 0.1).mean() < 0.7
    np.testing.assert_allclose(image[chord > 0.1], expected[chord > 0.1], rtol=3e-3)
    np.testing.assert_allclose(image[chord == 0], expected[chord == 0], rtol=2e-2)


def test_lengths_are_those_of_the_world() -> None:
    image, chord = drawn(ball(1.0, 0.5)), chords(0.5)[..., None]
    inside = chord[..., 0] > 0.1
    np.testing.assert_allclose(image[inside], (SKY * TINT**chord)[inside], rtol=3e-3)


def test_light_paths_lose_the_same_light() -> None:
    image, chord = drawn(ball(1.0), show="path", spp=64), chords()[..., None]
    inside = chord[..., 0] > 1.6  # where the mean over a pixel is that of its middle
    expected = (SKY * TINT**chord)[inside]
    assert np.quantile(np.abs(image[inside] / expected - 1), 0.98) < 0.03
    np.testing.assert_allclose(image[inside].mean(axis=0), expected.mean(axis=0), rtol=1e-2)


def test_walls_of_a_shell_absorb_and_its_hollow_does_not() -> None:
    image = drawn(ball(1.0, level=(-0.4, 0.0), side="between"))
    wall = (chords() - chords(0.6))[..., None]
    inside = (wall[..., 0] > 0.1) & (np.abs(chords(0.6) - 0.2) > 0.2)
    np.testing.assert_allclose(image[inside], (SKY * TINT**wall)[inside], rtol=1e-2)


def test_glass_bends_light_and_shows_what_is_opaque_behind_it() -> None:
    """A ball of glass turns what is behind it upside down."""
    gray = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.02] * 3}}
    board = T().look_at(origin=(-EYE / 2).tolist(), target=EYE.tolist(), up=[0, 0, 1])
    upper = {"type": "rectangle", "to_world": board @ T().translate([0, 3, 0]).scale([6, 3, 1]),
             "bsdf": {"type": "twosided", "nested": gray}}  # fmt: skip
    image = drawn(ball(1.5, tint=None), upper).mean(axis=-1)
    middle = N // 2
    column = image[:, middle]
    assert column[1] < 0.05 < column[-2]  # beside the ball
    assert column[middle - 4] > 2 * column[middle + 4]  # through it


@pytest.mark.parametrize("index", [1.0, 1.3, 1.5, 0.8])
def test_rays_follow_snell_and_fresnel(index: float) -> None:
    angle = np.linspace(0.01, 1.55, 200)
    d = mi.Vector3f(np.sin(angle).astype(np.float32), 0, -np.cos(angle).astype(np.float32))
    for into in (True, False):
        normal = mi.Vector3f(0, 0, 1 if into else -1)
        onward, reflected = (np.array(each) for each in refract(normal, d, mi.Float(index)))
        ratio = index if into else 1 / index
        sine = np.sin(angle) / ratio
        passes = sine < 0.9999
        np.testing.assert_allclose(onward[0][passes], sine[passes], atol=2e-5)
        assert (onward[2][passes] < 0).all()
        mirrored = sine > 1.0001
        np.testing.assert_allclose(onward[2][mirrored], np.cos(angle)[mirrored], atol=1e-5)
        assert (reflected[mirrored] == 1).all()
        i, t = np.cos(angle[passes]), np.sqrt(1 - sine[passes] ** 2)
        share = 0.5 * (((i - ratio * t) / (i + ratio * t)) ** 2
                       + ((ratio * i - t) / (ratio * i + t)) ** 2)  # fmt: skip
        np.testing.assert_allclose(reflected[passes], share, atol=2e-3)
    if index == 1.0:
        assert (reflected == 0).all()


@pytest.mark.slow
def test_named_glass_is_tinted_in_both_kinds_of_picture() -> None:
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    small: dict[str, Any] = {
        "level": (-0.4, 0.4),
        "side": "between",
        "size": (40, 30),
        "progress": False,
    }
    for show in ("shaded", "path"):
        amber = render(gyroid, material="amber", show=show, spp=8, **small)[10:20, 14:26]
        clear = render(gyroid, material="glass", show=show, spp=8, **small)[10:20, 14:26]
        warm = amber[..., 0].mean() / amber[..., 2].mean()
        assert warm > 1.3 * clear[..., 0].mean() / clear[..., 2].mean()


def test_bad_tints_are_refused() -> None:
    with pytest.raises(ValueError, match=r"in \(0, 1\]"):
        ball(1.5, tint=(0.5, 0.0, 0.5))
    with pytest.raises(TypeError, match=r"such as \(0.9, 0.5, 0.1\)"):
        ball(1.5, tint="amber")
    with pytest.raises(ValueError, match='give side="below"'):
        mitsuba_shape(Sphere(), tint=(0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match="needs an inside"):
        render(Sphere(), material="amber", progress=False)
    with pytest.raises(ValueError, match="light passes through"):
        Material({"type": "diffuse"}, tint=(0.5, 0.5, 0.5))
