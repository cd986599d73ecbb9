"""The parts of benchmarks that decide what is compared: scenes, oracles, counts."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from benchmarks import baselines, blobs, formulas, hart, inclusion, povray
from harnack.backend import choose_backend, to_vector3
from harnack.geometry import example_curves
from harnack.literature import BottomUpLinearEnclosure

SCENE = blobs.Scene.random(6, 1.5, (0.6, 1.0), 1.6, seed=2)


def test_the_blobs_of_the_benchmark_and_of_the_library_are_the_same() -> None:
    backend = choose_backend("double")
    p = np.random.default_rng(0).uniform(-2, 2, (500, 3))
    points = to_vector3(backend, p)
    for groups in (1, 3):
        expected = SCENE.values(p, groups)
        own = blobs.BlobFormula(SCENE, groups=groups).evaluator(backend).evaluate(points)
        np.testing.assert_allclose(own.value.numpy(), expected, atol=1e-12)
        library = SCENE.field(groups).evaluator(backend).evaluate(points)
        np.testing.assert_allclose(library.value.numpy() - SCENE.threshold, expected, atol=1e-12)


@pytest.mark.few(1)
@pytest.mark.parametrize("method", inclusion.METHODS, ids=lambda one: one[0])
def test_no_method_misses_a_hit(method: inclusion.Method) -> None:
    reference = SCENE.first_inside(SCENE.rays(300), 500)
    assert 50 < np.isfinite(reference).sum() < 280
    row = inclusion.measure(SCENE, method, 300, reference)
    assert row.missed == 0
    assert 1 <= row.looks < 25


@pytest.mark.slow
def test_methods_come_in_the_published_order() -> None:
    """Those of table 1 of Aydinlilar and Zanni (2023), from the most looks to the fewest."""
    scene = inclusion.table1_scene()
    compared = [one for one in inclusion.METHODS if one[3] is not None]
    looks = [inclusion.measure(scene, one, 3000, precision="double").looks for one in compared]
    assert looks == sorted(looks, reverse=True)


@pytest.mark.slow
def test_enhancements_see_the_same_surface_with_fewer_evaluations() -> None:
    solids = hart.scenes()["nine balls and a plane"]
    plain = hart.trace(solids)
    seen = np.isfinite(plain.t)
    assert 0.5 < seen.mean() <= 1
    for asked in ({"convexity": True}, {"triangle": True}, {"bounding": True}):
        made = hart.trace(solids, **asked)
        assert made.evaluations < 0.5 * plain.evaluations
        np.testing.assert_array_equal(np.isfinite(made.t), seen)
        np.testing.assert_allclose(made.t[seen], plain.t[seen], atol=0.02)


def test_bisection_is_bounded_by_its_depth() -> None:
    from benchmarks.bisection import bisect

    backend = choose_backend("double")
    o, d, length = SCENE.rays(200)
    rays = to_vector3(backend, o), to_vector3(backend, d), backend.Float(length)
    t, looks, _ = bisect(backend, blobs.BlobFormula(SCENE), BottomUpLinearEnclosure, rays, 1e-3)
    assert looks.numpy().max() < 300
    hit = np.isfinite(t.numpy())
    values = SCENE.values((o + np.where(hit, t.numpy(), 0)[:, None] * d)[hit])
    assert np.abs(values).max() < 0.05


@pytest.mark.slow
def test_scene_files_name_the_camera_and_the_container() -> None:
    gyroid, some_blobs = povray.pictures()
    text = povray.pov_scene(gyroid, positions=False)
    assert "contained_by { sphere { <0,0,0>, 1.000000000 } }" in text
    assert "max_gradient 16.32" in text
    assert text.count("isosurface") == 1
    text = povray.pov_scene(some_blobs, positions=True)
    assert text.count("pow(max(0,1-") == 40
    assert "pigment_map" in text


@pytest.mark.slow
def test_the_oracle_finds_the_roots_of_the_tracer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(povray, "WIDTH", 24)
    gyroid = povray.pictures()[0]
    d = povray.camera_rays()
    truth = povray.oracle(gyroid, d)
    assert 0.3 < np.isfinite(truth.t).mean() < 0.7
    t, _, _ = povray.by_harnack(gyroid, d, 1)
    assert truth.wrong(gyroid, d, t)[0] == 0
    off = np.where(np.isfinite(t), t + 0.05, t)
    assert truth.wrong(gyroid, d, off)[0] > 50
    assert isinstance(gyroid.field, hk.Gyroid)


@pytest.mark.slow
def test_methods_without_a_proof_miss_first_hits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "SAMPLES", 1500)
    field = hk.SolidAngle(example_curves.wavy_polygon(12))
    results, truth = baselines.compare(field, 2 * np.pi, across=16)
    found = {one.name: one for one in results}
    assert np.isfinite(truth).sum() > 50
    assert found["harnack"].missed == found["harnack"].false == 0
    assert found["sphere tracing, L = 5"].missed > 20
    assert found["Newton"].missed > 10
    # Jumps of the angle are taken for crossings.
    assert found["bisection"].false > 100
    assert found["interval analysis"].false > 10


def test_formulas_of_the_solid_angle_are_equal_modulo_4_pi() -> None:
    loop = example_curves.wavy_polygon(12)
    x = np.random.default_rng(0).uniform(-1.2, 1.2, (500, 3))
    expected = formulas.fan(loop, x)
    for other in (formulas.quaternions(loop, x), hk.SolidAngle(loop).value(x, precision="double")):
        turns = (other - expected) / (4 * np.pi)
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-10)
    turns = (formulas.angle_sum(loop, x) - expected) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-10)
    gradient = formulas.adiels(loop, x)
    np.testing.assert_allclose(formulas.biot_savart(loop, x), gradient, rtol=1e-8, atol=1e-10)
    near = np.median(np.abs(formulas.differences(loop, x) / gradient - 1))
    assert near < 0.01
