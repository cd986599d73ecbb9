"""Dr.Jit tensors as vertices, rays, levels and points: what other frameworks' arrays arrive as."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.geometry import example_curves

LOOP = example_curves.wavy_polygon(12)
EYE = np.array([2.2, -2.2, 1.6])
AWAY = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 3)) - EYE
BACKEND = choose_backend("double")


def tensor(values: Any) -> Any:
    return dr.tensor_t(BACKEND.Float)(np.asarray(values, float))


def vector(values: Any) -> Any:
    return to_vector3(BACKEND, values)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("verb", "settings"), [(hk.trace, {}), (hk.crossings, {"max_crossings": 3})]
)
def test_tensors_are_traced_as_numpy_arrays_are(verb: Any, settings: dict[str, Any]) -> None:
    levels = [5.0, 2 * np.pi]
    field = hk.SolidAngle(LOOP, lift_bound="edges")
    settings = {"t_max": np.full(40, 9.0), **settings}
    expected = verb(field, EYE[None], AWAY, level=levels, precision="double", **settings)
    in_tensors = verb(
        hk.SolidAngle(tensor(LOOP)),
        tensor(EYE[None]),
        tensor(AWAY),
        level=tensor(levels),
        **{**settings, "t_max": tensor(np.full(40, 9.0))},
    )
    assert type(in_tensors) is type(expected)
    for name, value in vars(expected).items():
        array = getattr(in_tensors, name)
        assert dr.is_tensor_v(array)
        assert array.shape == value.shape, name
        assert array.numpy().dtype in (np.float64, np.int32)
        if name != "evaluations":  # rays begin at other hulls
            np.testing.assert_allclose(array.numpy(), value, atol=2e-4, err_msg=name)


@pytest.mark.slow
def test_levels_may_be_tensors_one_by_one() -> None:
    rays = tensor(EYE[None]), tensor(AWAY)
    levels = tensor(5.0), tensor(2 * np.pi)
    dr.enable_grad(levels[1])
    found = hk.trace(hk.SolidAngle(LOOP), *rays, level=[*levels])
    expected = hk.trace(hk.SolidAngle(LOOP), *rays, level=tensor([5.0, 2 * np.pi]))
    np.testing.assert_allclose(found.t.numpy(), expected.t.numpy(), atol=1e-3)
    dr.backward(dr.sum(dr.select(found.is_hit, found.t, 0)))
    assert levels[1].grad.shape == ()
    assert abs(levels[1].grad.numpy()) > 0


def test_no_rays_give_tensors_of_no_rays() -> None:
    none = dr.zeros(dr.tensor_t(BACKEND.Float), (0, 3))
    hits = hk.trace(hk.SolidAngle(LOOP), none, none)
    assert hits.position.shape == (0, 3)
    assert hits.t.shape == (0,)


FIELDS: dict[str, hk.Field] = {
    "curve": hk.SolidAngle(LOOP),
    "batched": hk.DipolePotential(LOOP, LOOP, areas=np.ones(12)),
    "formula": hk.Sphere(1.0),
}


@pytest.mark.parametrize("name", FIELDS)
def test_values_and_gradients_of_tensors(name: str) -> None:
    field, points = FIELDS[name], 0.3 * AWAY
    for method in (field.value, field.gradient):
        expected = to_numpy(method(vector(points)))
        found = method(tensor(points))
        assert found.shape == expected.shape
        np.testing.assert_array_equal(found.numpy(), expected)
        single = method(tensor(points[0]))
        assert single.shape == expected.shape[1:]
        np.testing.assert_allclose(single.numpy(), expected[0], rtol=1e-12)


@pytest.mark.slow
def test_derivatives_pass_through_tensors() -> None:
    inputs = {"tensor": tensor, "vector": vector}
    found: dict[str, list[np.ndarray]] = {}
    for name, make in inputs.items():
        given = [make(one) for one in (LOOP, EYE[None], AWAY)]
        dr.enable_grad(*given)
        hits = hk.trace(hk.SolidAngle(given[0]), *given[1:])
        total = dr.sum(hk.SolidAngle(given[0]).value(make(0.3 * AWAY)))
        dr.backward(dr.sum(dr.select(hits.is_hit, hits.t, 0)) + total)
        gradients = (dr.grad(one) for one in given)
        found[name] = [g.numpy() if name == "tensor" else to_numpy(g) for g in gradients]
    for got, expected in zip(*found.values(), strict=True):
        assert np.abs(expected).max() > 0
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)


def test_each_loop_of_a_curve_may_be_moved_by_itself() -> None:
    """A loop beside another that stands still has the derivative that it has with both moved."""
    other = LOOP + np.array([0, 0, 0.7])
    both, first = [tensor(LOOP), tensor(other)], [tensor(LOOP), other]
    dr.enable_grad(both[0], both[1], first[0])
    x = tensor(0.3 * AWAY)
    values = [hk.SolidAngle(loops).value(x) for loops in (both, first)]
    expected = hk.SolidAngle([LOOP, other]).value(0.3 * AWAY, precision="double")
    for value in values:
        dr.backward(dr.sum(value))
        off = np.remainder(value.numpy() - expected + 2 * np.pi, 4 * np.pi) - 2 * np.pi
        assert np.abs(off).max() < 1e-9
    np.testing.assert_allclose(both[0].grad.numpy(), first[0].grad.numpy(), rtol=1e-12)
    assert np.abs(both[1].grad.numpy()).max() > 0


@pytest.mark.slow
def test_components_that_are_one_number_have_the_derivative_of_their_sum() -> None:
    """Vertices at one height, and rays from one: they are gathered, lane by lane."""
    flat = LOOP * [1, 1, 0] + [0, 0, 0.25]
    o, d = 0.1 * AWAY * [1, 1, 0] + [0, 0, 3.0], vector([[0.1, 0.0, -1.0]])
    z: list[tuple[float, float]] = []
    for height in ((0.25, 3.0), (np.full(12, 0.25), np.full(40, 3.0))):
        vertices = BACKEND.Array3f(*(BACKEND.Float(c) for c in (*flat.T[:2], height[0])))
        origins = BACKEND.Array3f(*(BACKEND.Float(c) for c in (*o.T[:2], height[1])))
        dr.enable_grad(vertices, origins)
        hits = hk.crossings(hk.SolidAngle(vertices), origins, d, level=5.0, max_crossings=2)
        dr.backward(dr.sum(dr.select(dr.isfinite(hits.t), hits.t, 0)))
        z.append((float(dr.sum(vertices.grad.z)[0]), float(dr.sum(origins.grad.z)[0])))
    assert min(map(abs, z[0])) > 0.1
    assert z[0] == pytest.approx(z[1], rel=1e-9)


def test_vertices_and_points_may_differ_in_precision() -> None:
    vertices = dr.tensor_t(choose_backend("single").Float)(LOOP.astype(np.float32))
    dr.enable_grad(vertices)
    value = hk.SolidAngle(vertices).value(tensor(0.3 * AWAY))
    dr.backward(dr.sum(value))
    assert value.numpy().dtype == np.float64
    assert np.abs(vertices.grad.numpy()).max() > 0


def test_other_tensors_are_refused() -> None:
    whole = dr.tensor_t(BACKEND.Int32)(np.ones((4, 3), np.int32))
    with pytest.raises(
        ValueError, match=r"origins must have shape \(n, 3\), not \(3, 40\).*transp"
    ):
        hk.trace(FIELDS["curve"], tensor(AWAY.T), tensor(AWAY))
    with pytest.raises(TypeError, match=r"directions: expected floats of 32 or 64 bits"):
        hk.trace(FIELDS["curve"], tensor(EYE[None]), whole)
    with pytest.raises(hk.geometry.CurveError, match=r"a loop must have shape \(n, 3\)"):
        hk.SolidAngle(tensor(LOOP[:, :2]))
    with pytest.raises(ValueError, match=r"points must have shape \(n, 3\), not \(\)"):
        FIELDS["curve"].value(tensor(1.0))
