"""Path-traced pictures with derivatives: direct light with shadows, against Mitsuba's paths, and
derivatives against differences of pictures with common random numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend
from harnack.inverse.boundary_motion import BoundaryKind
from harnack.inverse.shadow_motion import with_shadow_motion
from harnack.rendering import mitsuba_shape
from harnack.rendering.mitsuba import load_mitsuba

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

POSITION = (2.2, -2.2, 1.6)
CAMERA = hk.Camera(position=POSITION, target=(0, 0, 0), fov=40)
FLOOR = hk.Cuboid((3, 3, 0.1)).translated((0, 0, -0.6))
LOOP = hk.geometry.example_curves.wavy_polygon(12)
SUN = (0.3, -0.5, 1.0)


def lifted_loop(height: Any) -> Any:
    """A curve with one vertex lifted, as numbers or, by a Dr.Jit height, as a Dr.Jit vector."""
    if not dr.is_array_v(type(height)):
        return LOOP + np.where(np.arange(12) == 3, height, 0.0)[:, None] * [0, 0, 1]
    kinds = type(height)
    lift = dr.select(dr.arange(dr.uint32_array_t(kinds), 12) == 3, height, 0.0)
    vector = dr.llvm.ad.Array3f64
    return vector(LOOP.T) + vector(0, 0, 1) * lift


CASES: dict[str, tuple[Callable[[Any], Any], float, float, int]] = {
    "a ball by its radius": (
        lambda r: hk.Sphere(r).translated((0, 0.1, 0.2)) | FLOOR, 0.3, 0.01, 0,
    ),
    "a curve by a vertex": (lambda h: hk.SolidAngle(lifted_loop(h)), 0.0, 0.02, 1),
}  # fmt: skip


def weighted_mean(image: Any) -> Any:
    """The mean of a picture in which the left side counts less than the right one."""
    height, width, _ = image.shape
    ramp = np.broadcast_to((np.arange(width) + 0.5)[None, :, None] / width, (height, width, 1))
    if dr.is_tensor_v(type(image)):
        return dr.mean(image * TensorXf64(np.ascontiguousarray(ramp)), axis=None)
    return (image * ramp).mean()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_derivatives_agree_with_differences(name: str) -> None:
    make, x0, h, spp = CASES[name]
    view: dict[str, Any] = {"camera": CAMERA, "show": "path", "spp": spp, "size": 24}
    slopes: list[float] = []
    expected: list[float] = []
    for seed in range(4):
        x = Float64(x0)
        dr.enable_grad(x)
        dr.backward(weighted_mean(hk.picture(make(x), seed=seed, **view)))
        slopes.append(float(dr.grad(x)[0]))
        ahead, back = (
            weighted_mean(hk.picture(make(x0 + s), seed=seed, precision="double", **view))
            for s in (h, -h)
        )
        expected.append((ahead - back) / (2 * h))
    deviation = float(np.hypot(np.std(slopes), np.std(expected))) / 4**0.5
    error = np.mean(slopes) - np.mean(expected)
    assert abs(error) < 3 * deviation + 0.03 * abs(np.mean(expected))
    assert deviation < 0.01


def test_a_shadow_moves_with_a_ball() -> None:
    """The shadow of a translated ball on a floor is translated by as much."""
    seen: list[Any] = []

    def recorded(*arguments: Any) -> Any:
        result = with_shadow_motion(*arguments)
        seen.append((*arguments[1:3], result))
        return result

    def solid(x: float) -> Any:
        return hk.Sphere(0.3).translated((x, 0.1, 0.2)) | FLOOR

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harnack.inverse.drawing.with_shadow_motion", recorded)
        hk.picture(solid(0.0), camera=CAMERA, size=32, show="path", spp=0, light=SUN)
    jumps, film, motion = seen[0]
    h, points = 1e-6, motion.position
    change = (solid(h).value(points) - solid(-h).value(points)) / (2 * h)
    speed = np.bincount(motion.index, motion.weight * change, len(jumps))
    is_shadow = motion.kind == int(BoundaryKind.SHADOW)
    assert is_shadow.sum() > 10
    position = jumps.before.position[is_shadow]
    assert position[:, 2] == pytest.approx(-0.55, abs=1e-6)
    expected = (motion.normal[is_shadow] * film.jacobian(position)[:, :, 0]).sum(axis=1)
    assert speed[is_shadow] == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def test_brightness_of_sun_and_sky() -> None:
    view: dict[str, Any] = {"camera": CAMERA, "size": 17, "show": "path", "seed": None}
    sphere = hk.Sphere(0.7)
    normal = np.array(POSITION) / np.linalg.norm(POSITION)
    sun = hk.picture(sphere, light=SUN, spp=0, **view)[8, 8, 0]
    assert sun == pytest.approx(0.8 * normal @ SUN / np.linalg.norm(SUN), abs=1e-6)
    # Nothing hides the sky over a convex surface.
    both = hk.picture(sphere, light=SUN, spp=12, **view)[8, 8, 0]
    assert both == pytest.approx(sun + 0.2, abs=0.02)
    assert hk.picture(sphere, light=tuple(-normal), spp=0, **view)[8, 8, 0] == 0
    with pytest.raises(ValueError, match="spp counts"):
        hk.picture(sphere, spp=4, size=8, camera=CAMERA)
    with pytest.raises(ValueError, match="spp"):
        hk.picture(sphere, spp=-1, size=8, camera=CAMERA, show="path")


def scene_of(mi: Any, shape: Any) -> Any:
    """A Mitsuba scene with the same camera, sun and sky."""
    look = mi.ScalarTransform4f().look_at(list(POSITION), [0, 0, 0], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "harnack_path", "max_depth": 2, "hide_emitters": True},
            "sensor": {
                "type": "perspective", "fov": 40, "to_world": look,
                "film": {"type": "hdrfilm", "width": 16, "height": 16},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.25}},
            "sun": {
                "type": "directional", "direction": [-c for c in SUN],
                "irradiance": {"type": "rgb", "value": float(np.pi)},
            },
            "surface": shape,
        },
        parallel=False,
    )  # fmt: skip


@pytest.mark.slow
def test_pictures_are_those_of_light_paths() -> None:
    """The mean over seeds is the picture of `harnack_path` with paths of two edges."""
    mi = load_mitsuba()
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
    solid = hk.Sphere(0.3).translated((0, 0.1, 0.0)) | FLOOR
    shape = mitsuba_shape(solid, bsdf={"type": "twosided", "nested": white})
    expected = np.asarray(hk.render(scene_of(mi, shape), spp=64))[..., 0]
    view: dict[str, Any] = {"camera": CAMERA, "size": 16, "show": "path", "light": SUN}
    image = np.mean([hk.picture(solid, seed=k, **view)[..., 0] for k in range(4)], axis=0)
    assert image.mean() == pytest.approx(expected.mean(), rel=0.02)
    # Pixels differ by their filters at edges.
    assert np.median(np.abs(image - expected)) < 0.02


def test_scenes_of_mitsuba_refuse_derivatives_by_surfaces() -> None:
    mi = load_mitsuba()
    radius = mi.Float(0.7)
    scene = scene_of(mi, mitsuba_shape(hk.Sphere(radius)))
    parameters = mi.traverse(scene)
    sky = parameters["sky.radiance.value"]
    dr.enable_grad(sky)
    parameters["sky.radiance.value"] = sky
    parameters.update()
    image = mi.render(scene, parameters, spp=1)
    dr.enable_grad(radius)
    for render in (
        lambda: mi.render(scene, spp=1),
        lambda: scene.integrator().render(scene),
        lambda: dr.backward(dr.sum(image, axis=None)),
    ):
        with pytest.raises(NotImplementedError, match=r"derivatives by the numbers of this Sphere"):
            render()
    dr.disable_grad(radius)
    dr.backward(dr.sum(mi.render(scene, parameters, spp=1), axis=None))
    assert dr.grad(parameters["sky.radiance.value"]).numpy().max() > 0
