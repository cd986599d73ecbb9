"""Shaded pictures: the light's formula, both sides, edges, what is near, the floor, the lost."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.enclosures import Lipschitz
from harnack.fields.field import Field, Sample
from harnack.geometry import example_curves, example_meshes
from harnack.rendering import Camera, Material, mitsuba_shape, register, render, shaded_render
from harnack.rendering.hybrid_scene import HybridScene
from harnack.rendering.shaded_render import ambient_visibility
from harnack.rendering.shading import (
    FloorShadow,
    StudioLight,
    multijitter_offsets,
    tiled_pixel_order,
)
from harnack.tracer import traced_surface

mi = register()
T = mi.ScalarTransform4f
SKY = (0.2, 0.3, 0.5)
EYE = np.array([1.5, -4.0, 2.0])
N = 48
POLYGON = hk.SolidAngle(example_curves.wavy_polygon(24))


class Sphere(Field):
    """sign * (|p| - 1)."""

    def __init__(self, sign: float = 1.0) -> None:
        self.sign = sign
        self.domain = hk.Ball(radius=2.0)

    def evaluate(self, p: Any) -> Sample:
        distance = dr.norm(p)
        gradient = p * (self.sign / distance)
        return Sample(self.sign * (distance - 1.0), gradient, (Lipschitz(1.0),))


def diffuse(*color: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}


def scene(*members: Any) -> dict[str, Any]:
    look = T().look_at(origin=EYE.tolist(), target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": N, "height": N}
    sensor = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": list(SKY)}}
    named = {f"member{k}": member for k, member in enumerate(members)}
    return {"type": "scene", "sensor": sensor, "sky": sky, **named}


def drawn(*members: Any, spp: int = 1) -> np.ndarray:
    return render(scene(*members), show="shaded", spp=spp, progress=False)


def camera_axes() -> np.ndarray:
    back = EYE / np.linalg.norm(EYE)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def sphere_by_hand(color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A matt unit sphere as the formula has it, and where it is."""
    right, up, back = camera_axes()
    place = (2 * (np.arange(N) + 0.5) / N - 1) * np.tan(np.radians(20))
    x, y = np.meshgrid(place, -place)
    d = x[..., None] * right + y[..., None] * up - back
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ EYE
    inside = b * b - EYE @ EYE + 1
    t = -b - np.sqrt(np.maximum(inside, 0))
    n = EYE + t[..., None] * d
    key = np.array([-0.52, 0.62, 0.59])
    key = key / np.linalg.norm(key) @ camera_axes()
    wrapped = np.clip((n @ key + 0.25) / 1.25, 0, 1)[..., None]
    share = 0.5 + 0.5 * (n @ up)[..., None]
    sky = np.array([0.25, 0.225, 0.20]) * (1 - share) + np.array([0.36, 0.40, 0.46]) * share
    lit = color * (np.array([0.74, 0.71, 0.66]) * wrapped + sky)
    return np.where(inside[..., None] > 0, lit, SKY), inside > 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_matt_sphere_is_lit_by_the_formula_on_both_sides(sign: float) -> None:
    color = np.array([0.8, 0.5, 0.3])
    bsdf = {"type": "twosided", "nested": diffuse(*color)}
    image = drawn(mitsuba_shape(Sphere(sign), bsdf=bsdf, tolerance=1e-4))
    tint = np.array([0.52, 0.60, 0.74]) if sign > 0 else 1.0  # seen from the larger values
    expected, hit = sphere_by_hand(color * tint)
    assert 0.2 < hit.mean() < 0.7
    wrong = np.abs(image - expected).max(axis=-1) > 1e-3
    outline = hit & ~(np.roll(hit, 1, 0) & np.roll(hit, -1, 0) & np.roll(hit, 1, 1))
    assert not (wrong & ~outline).any()
    assert wrong.sum() <= 4


def test_the_background_is_that_of_color_pictures() -> None:
    image = drawn(mitsuba_shape(Sphere(), bsdf=diffuse(0.5, 0.5, 0.5)))
    _, hit = sphere_by_hand(np.ones(3))
    np.testing.assert_allclose(image[~hit], np.broadcast_to(SKY, image[~hit].shape), rtol=1e-6)
    dark = scene(mitsuba_shape(Sphere(), bsdf=diffuse(0.5, 0.5, 0.5)))
    del dark["sky"]
    assert (render(dark, show="shaded", spp=1, progress=False)[~hit] == 0).all()


def test_mitsubas_sphere_is_drawn_as_ours() -> None:
    theirs = drawn({"type": "sphere", "bsdf": diffuse(0.7, 0.2, 0.2)}, spp=4)
    ours = drawn(
        mitsuba_shape(Sphere(-1.0), bsdf={"type": "twosided", "bsdf": diffuse(0.7, 0.2, 0.2)}),
        spp=4,
    )
    assert np.mean(np.abs(ours - theirs).max(axis=-1) > 2e-3) < 0.01


@pytest.mark.slow
def test_two_colors_are_for_the_two_sides() -> None:
    material = Material(diffuse(0.8, 0.1, 0.1), diffuse(0.1, 0.1, 0.8))
    images = [
        draw(traced_surface(Sphere(sign), tolerance=1e-4), material=material) for sign in (1, -1)
    ]
    middle = [image[18:22, 28:32].mean(axis=(0, 1)) for image in images]
    assert middle[0][0] > 4 * middle[0][2]
    assert middle[1][2] > 4 * middle[1][0]


def draw(what: Any = POLYGON, **settings: Any) -> np.ndarray:
    small = {"size": (60, 40), "show": "shaded", "progress": False}
    return render(what, None, **{**small, **settings})


@pytest.mark.slow
def test_the_picture_is_always_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = draw()
    np.testing.assert_array_equal(whole, draw(seed=7))
    monkeypatch.setattr("harnack.rendering.shaded_render._RAYS_A_BAND", 333)
    np.testing.assert_allclose(draw(), whole, atol=1e-5)


@pytest.mark.slow
def test_more_samples_smooth_edges_and_nothing_else() -> None:
    once, smooth = draw(spp=1), draw(spp=16)
    changed = np.abs(once - smooth).max(axis=-1) > 1e-6
    assert 0.02 < changed.mean() < 0.4
    fine = draw(spp=1, size=(480, 320)).reshape(40, 8, 60, 8, 3).mean(axis=(1, 3))
    error = [np.abs(image - fine)[changed].mean() for image in (once, smooth)]
    assert error[1] < 0.5 * error[0]


@pytest.mark.parametrize("count", [1, 2, 4, 5, 9, 16, 30])
def test_samples_of_a_pixel_are_spread(count: int) -> None:
    places = multijitter_offsets(count)
    n = len(places)
    assert count <= n <= count + 5
    assert ((places > 0) & (places < 1)).all()
    for axis in places.T:  # one in each of n strips, either way
        assert len(np.unique(np.floor(axis * n))) == n
    np.testing.assert_allclose(places.mean(axis=0), 0.5, atol=1e-12)


@pytest.mark.slow
def test_surfaces_keep_their_own_materials_and_the_nearer_hides_the_other() -> None:
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    levels = [traced_surface(gyroid, level=level, tolerance=1e-3) for level in (-0.5, 0.5)]
    two = draw(levels, material=["plastic", "two-tone"])
    one = draw([traced_surface(gyroid, level=[-0.5, 0.5], tolerance=1e-3)], material="plastic")
    assert np.abs(two - one).mean() > 0.01
    swapped = draw(levels[::-1], material=["two-tone", "plastic"])
    np.testing.assert_allclose(two, swapped, atol=2e-2)


@pytest.mark.slow
def test_what_mends_a_mesh_is_tinted() -> None:
    vertices, faces = example_meshes.icosphere(2)
    opened = faces[vertices[faces].mean(axis=1)[:, 2] < 0.7]
    above = Camera(azimuth=0, elevation=90)
    images = [draw(hk.WindingNumber(vertices, f), material="clay", camera=above, spp=1)
              for f in (faces, opened)]  # fmt: skip
    warmth = [image[..., 0] / image[..., 2] for image in images]
    middle, rim = np.s_[18:22, 28:32], np.s_[18:22, 15:17]
    assert warmth[1][middle].min() > 1.5 * warmth[0][middle].max()
    np.testing.assert_allclose(warmth[1][rim], warmth[0][rim], rtol=0.1)


def test_metals_and_glass_have_a_color() -> None:
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    for name in ("gold", "glass"):
        image = draw(gyroid, level=(-0.4, 0.4), side="between", material=name, spp=1)
        middle = image[16:24, 24:36]
        assert 0.05 < middle.mean() < 0.9
        if name == "gold":
            assert middle[..., 0].mean() > 2 * middle[..., 2].mean()


def positions(bend: float) -> tuple[Any, Any]:
    """A floor, from the middle of a picture of 41 x 41 on a wall that rises by `bend` a unit."""
    y, x = np.mgrid[-20:21, -20:21].astype(np.float32)
    wall = (x > 0).ravel()
    points = np.stack([x.ravel(), y.ravel(), np.where(wall, bend * x.ravel(), 0)])
    normals = np.zeros_like(points)
    normals[2] = 1
    return mi.Vector3f(points), mi.Vector3f(normals)


def test_a_plane_hides_nothing_and_a_wall_hides_what_is_near(monkeypatch: Any) -> None:
    monkeypatch.setattr("harnack.rendering.shaded_render.SKY_REACH", 0.4)
    flat = np.array(ambient_visibility(mi, *positions(0.0), mi.Float(1), (41, 41))).reshape(41, 41)
    np.testing.assert_allclose(flat, 1, atol=1e-6)
    bent = np.array(ambient_visibility(mi, *positions(2.0), mi.Float(1), (41, 41))).reshape(41, 41)
    at = bent[20]
    assert 0.5 < at[20] < 0.85  # a slope of 2 hides 0.8 of the sines squared of its half, fading
    assert at[20] < at[14] < 1
    np.testing.assert_allclose(at[:3], 1, atol=1e-6)  # out of reach
    np.testing.assert_allclose(bent[10, :20], bent[20, :20], atol=0.05)


def test_the_floor_is_dark_beneath_a_ball_and_light_far_from_it() -> None:
    ball = mitsuba_shape(Sphere(), to_world=T().translate([0, 0, 1]), bsdf=diffuse(0.5, 0.5, 0.5))
    world = HybridScene.of(mi, mi.load_dict({"type": "scene", "ball": ball}))
    key = np.array([-0.6, 0.0, 0.8])
    floor = FloorShadow.of(world, StudioLight(key.tolist(), [0, 0, 1]))
    points = np.array([[0, 0, -0.002], [0.75, 0, -0.002], [-2.2, 2.2, -0.002], [0, 0, 1.0]])
    lit, sky = (np.array(part) for part in floor.at(mi.Vector3f(points.T.astype(np.float32))))
    assert lit[1] < 0.05  # where the light's axis through the ball meets the floor
    assert sky[0] < 0.15
    assert lit[0] < sky[1] or sky[0] < sky[1]
    assert min(lit[2], sky[2]) > 0.8
    assert (lit[3], sky[3]) == (1, 1)
    # From the height of its middle a ball hides 1/(1 + (d/h)^2)^(3/2) of a floor's sky
    far = np.array([[2.0, 0.0, -0.002]])
    _, part = floor.at(mi.Vector3f(far.T.astype(np.float32)))
    assert np.array(part)[0] == pytest.approx(1 - 1 / 5**1.5, abs=0.04)


@pytest.mark.slow
def test_lost_rays_are_magenta_and_counted() -> None:
    with pytest.warns(UserWarning, match=r"\d+ rays ran out of steps"):
        image = draw(max_steps=4, tolerance=1e-4, spp=1)
    lost = draw(show="status", max_steps=4, tolerance=1e-4) == hk.RayStatus.OUT_OF_STEPS
    assert lost.sum() > 20
    magenta = (image == (1, 0, 1)).all(axis=-1)
    assert not (magenta & ~lost).any()
    assert magenta.sum() > 0.9 * lost.sum()  # the others meet the floor before they are lost


VARIANT = """
import harnack as hk, mitsuba as mi
mi.set_variant("{variant}")
from harnack.geometry.example_curves import wavy_polygon
field = hk.SolidAngle(wavy_polygon(12))
print(*hk.render(field, size=(48, 36), show="shaded", progress=False).mean(axis=(0, 1)))
"""


def in_variant(name: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", VARIANT.format(variant=name)],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip


@pytest.mark.slow
def test_other_variants_draw_much_the_same_or_say_no() -> None:
    mono, rgb = (
        np.array(in_variant(name).stdout.split()[-3:], dtype=float)
        for name in ("llvm_ad_mono", "llvm_ad_rgb")
    )
    assert mono.mean() == pytest.approx(rgb.mean(), rel=0.05)
    refused = in_variant("llvm_ad_spectral")
    assert refused.returncode != 0
    assert "shaded pictures know red, green and blue" in refused.stderr


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (4, 4), (9, 5), (16, 7)])
def test_tiles_hold_every_pixel_once(size: tuple[int, int]) -> None:
    order = tiled_pixel_order(size)
    assert sorted(order) == list(range(size[0] * size[1]))
    if size == (9, 5):  # the first tile, and the first of the narrow one at the right
        assert order[:16].tolist() == [y * 9 + x for y in range(4) for x in range(4)]
        assert order[32:36].tolist() == [8, 17, 26, 35]


def test_what_first_rays_have_seen_is_not_traced_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges are the mean of nine samples, one of which is that of the first ray: the same picture
    as if all nine were traced anew."""
    counts: list[int] = []
    own = shaded_render.ShadedTask.refine_pixels

    def refine(self: Any, *part: Any) -> Any:
        counts.append(len(self.offsets))
        return own(self, *part)

    monkeypatch.setattr(shaded_render.ShadedTask, "refine_pixels", refine)
    image = drawn(mitsuba_shape(Sphere()), spp=9)
    monkeypatch.setattr(
        shaded_render, "multijitter_offsets", lambda spp: multijitter_offsets(spp) + 1e-12
    )
    again = drawn(mitsuba_shape(Sphere()), spp=9)
    assert set(counts) == {8, 9}
    np.testing.assert_allclose(image, again, atol=2e-5)


@pytest.mark.slow
def test_solids_have_the_color_of_their_outside_without_being_asked() -> None:
    """Found by a user: the outside of a `Solid` was tinted like the inside of an open surface."""
    small = {"material": "gold", "show": "shaded", "size": (40, 30), "progress": False}
    plain = hk.render(hk.Sphere(1.0), **small)
    asked = hk.render(hk.Sphere(1.0), level=0, side="below", **small)
    np.testing.assert_allclose(plain[15, 20], asked[15, 20], rtol=2e-2)


@pytest.mark.slow
def test_solids_may_be_of_glass() -> None:
    small = {"show": "shaded", "size": (40, 30), "progress": False}
    glass = hk.render(hk.Sphere(1.0), material="cobalt", **small)
    asked = hk.render(hk.Sphere(1.0), material="cobalt", level=0, side="below", **small)
    np.testing.assert_array_equal(glass, asked)
