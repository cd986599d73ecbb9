"""Noise that is taken out of pictures, and how long a picture will take."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from harnack.rendering import mitsuba_shape, register
from harnack.rendering.integrator import PathTracer
from harnack.rendering.light_paths import (
    PathRender,
    PathRenderTask,
    TimeEstimate,
    estimate_time,
    render_paths,
)

mi = register()
POLYGON = hk.SolidAngle(example_curves.wavy_polygon(24))


def draw(what: Any = POLYGON, **settings: Any) -> np.ndarray:
    small = {"size": (64, 48), "spp": 4, "progress": False, "material": "clay"}
    return np.asarray(hk.render(what, **{**small, **settings}))


@pytest.mark.slow
def test_denoising_comes_closer_to_many_samples() -> None:
    many, few, clean = draw(spp=128), draw(), draw(denoise=True)
    before, after = (np.sqrt(np.mean((one - many) ** 2)) for one in (few, clean))
    assert after < 0.5 * before
    assert clean.mean() == pytest.approx(few.mean(), rel=0.01)


def test_what_is_covered_stays_as_it_is() -> None:
    few, clean = (draw(backdrop="transparent", denoise=on) for on in (False, True))
    np.testing.assert_array_equal(clean[..., 3], few[..., 3])
    assert clean.dtype == few.dtype
    assert (clean >= 0).all()
    assert not clean[few[..., 3] == 0][:, 3].any()


def exposed(features: bool, bsdf: dict[str, Any], **settings: Any) -> PathRender:
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24},
            },
            "light": {"type": "constant"},
            "ball": mitsuba_shape(hk.Sphere(1.0), bsdf=bsdf),
        }
    )
    exposing = PathRenderTask(
        mi, scene, scene.sensors()[0], PathTracer(mi), 16, 1, features, **settings
    )
    return render_paths(exposing, lambda _: None)


CLAY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.2]}}


def test_features_are_those_of_what_is_met_first() -> None:
    found = exposed(True, CLAY)
    assert found.albedo is not None
    assert found.normal is not None
    middle, corner = (12, 12), (0, 0)
    np.testing.assert_allclose(found.albedo[middle], [0.7, 0.5, 0.2], rtol=1e-5)
    assert found.normal[middle][2] > 0.99
    assert not found.albedo[corner].any()
    assert not found.normal[corner].any()
    whole = found.image[..., 3] == 1
    length = np.linalg.norm(found.normal, axis=-1)
    assert (length <= 1 + 1e-5).all()
    assert length[whole].min() > 0.9


@pytest.mark.parametrize(
    ("bsdf", "albedo"),
    [
        ({"type": "dielectric"}, [1, 1, 1]),
        ({"type": "conductor", "material": "Au"}, [1, 1, 1]),
        ({"type": "diffuse", "reflectance": 0.0}, [0, 0, 0]),
    ],
)
def test_mirrors_and_glass_have_no_color_of_their_own(
    bsdf: dict[str, Any], albedo: list[float]
) -> None:
    found = exposed(True, bsdf).albedo
    assert found is not None
    np.testing.assert_allclose(found[12, 12], albedo)


def test_rough_metal_keeps_its_hue() -> None:
    found = exposed(True, {"type": "roughconductor", "material": "Au", "alpha": 0.1}).albedo
    assert found is not None
    red, green, blue = found[12, 12]
    assert 1 >= red > green > blue > 0.1


def test_features_change_no_light() -> None:
    plain = exposed(False, CLAY)
    assert plain.albedo is None
    np.testing.assert_array_equal(plain.image, exposed(True, CLAY).image)


def test_denoising_is_refused_where_there_is_no_noise() -> None:
    with pytest.raises(ValueError, match='show="path"'):
        draw(denoise=True, show="shaded")
    with pytest.raises(TypeError, match="True or False"):
        draw(denoise="yes")


def test_a_missing_denoiser_is_told_before_anything_is_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    monkeypatch.setattr("harnack.rendering.render_job.register", pytest.fail)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'harnack\[denoise\]'"):
        draw(denoise=True)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(17.2, "17 s"), (89, "89 s"), (150, "2 min 30 s"), (1500, "25 min"), (9000, "2 h 30 min")],
)
def test_times_are_told_in_words(seconds: float, text: str) -> None:
    assert str(TimeEstimate(1e-6, seconds)) == text


def test_bands_last_a_few_seconds() -> None:
    assert TimeEstimate(1e-2, 1e5).paths_a_band == 2**14
    assert TimeEstimate(4e-5, 1e3).paths_a_band == 100_000
    assert TimeEstimate(0, 0).paths_a_band == 2**21


@pytest.mark.slow
def test_a_long_picture_is_announced(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quiet = draw(spp=100)
    assert not capsys.readouterr().err

    def paced(*_: Any, **__: Any) -> TimeEstimate:
        return TimeEstimate(1e-4, 30.0)

    # What is measured depends on the machine, and a quick one is not told about.
    monkeypatch.setattr("harnack.rendering.picture.estimate_time", paced)
    told = draw(spp=100, progress=True)
    assert "about 30 s, with 100 samples a pixel" in capsys.readouterr().err
    np.testing.assert_array_equal(quiet, told)


def test_the_pace_of_a_picture_is_that_of_its_paths() -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 256}},
            "light": {"type": "constant"},
            "ball": {"type": "sphere", "center": [0, 0, 4]},
        }
    )
    sensor, tracer = scene.sensors()[0], PathTracer(mi)
    one = estimate_time(mi, scene, sensor, tracer, spp=4096, features=False)
    assert one.path > 0
    width, height = sensor.film().crop_size()
    assert one.picture == pytest.approx(one.path * width * height * 4096)
