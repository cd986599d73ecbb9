"""Every field at points: NumPy arrays, single points, Dr.Jit vectors with derivatives."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.batch_evaluation import map_batches
from harnack.geometry.example_curves import wavy_polygon
from harnack.geometry.example_meshes import icosphere

VERTICES, FACES = icosphere(1)
FIELDS: dict[str, hk.Field] = {
    "curve": hk.SolidAngle(wavy_polygon(12)),
    "harmonic": hk.SphericalHarmonic(4, 2),
    "gyroid": hk.Gyroid(),
    "mesh": hk.WindingNumber(VERTICES, FACES[np.arange(len(FACES)) % 3 > 0]),
    "tree": hk.WindingNumber(VERTICES, FACES[np.arange(len(FACES)) % 3 > 0], method="tree"),
    # Gradients are right by themselves, values as far as they are asked to be.
    "cloud": hk.DipolePotential(VERTICES, VERTICES, accuracy=50),
    "screened": hk.fields.ScreenedWindingNumber(VERTICES, VERTICES, length=1.0),
}
POINTS = np.array([[0.3, 0.2, 0.5], [0.1, -0.4, 0.25], [-0.6, 0.2, -0.3], [1.4, 0.3, 0.2]])


class Plane(hk.Field):
    """f = x."""

    def evaluate(self, p: Any) -> hk.fields.Sample:
        return hk.fields.Sample(p.x, type(p)(1, 0, 0), (hk.proofs.Lipschitz(1.0),))


@pytest.mark.few(4)
@pytest.mark.parametrize("name", FIELDS)
def test_values_and_derivatives_at_points(name: str) -> None:
    """Gradients against differences of values, Hessians against those of gradients."""
    field, h = FIELDS[name], 1e-5
    value = field.value(POINTS, precision="double")
    gradient = field.gradient(POINTS, precision="double")
    hessian = field.hessian(POINTS, precision="double")  # type: ignore[call-arg]
    assert (value.shape, gradient.shape, hessian.shape) == ((4,), (4, 3), (4, 3, 3))
    for k, step in enumerate(h * np.eye(3)):
        ahead, behind = POINTS + step, POINTS - step
        rate = field.value(ahead, precision="double") - field.value(behind, precision="double")
        np.testing.assert_allclose(rate / (2 * h), gradient[:, k], atol=1e-3)
        bend = field.gradient(ahead, precision="double") - field.gradient(
            behind, precision="double"
        )
        np.testing.assert_allclose(bend / (2 * h), hessian[:, :, k], atol=1e-2)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", FIELDS)
def test_single_points_and_no_points(name: str) -> None:
    field = FIELDS[name]
    assert np.shape(field.value(POINTS[0])) == ()
    assert field.gradient(POINTS[0]).shape == (3,)
    assert field.hessian(POINTS[0]).shape == (3, 3)  # type: ignore[attr-defined]
    np.testing.assert_allclose(field.value(POINTS[0]), field.value(POINTS)[0], rtol=1e-6)
    assert field.value(POINTS[:0]).shape == (0,)
    assert field.gradient(POINTS[:0]).shape == (0, 3)
    with pytest.raises(ValueError, match="shape"):
        field.value(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="NaN"):
        field.gradient([[np.nan, 0.0, 0.0]])


@pytest.mark.parametrize("n", [0, 1, 7, 8, 20])
def test_points_in_batches_are_points_one_by_one(n: int) -> None:
    """Of arrays and of Dr.Jit vectors; what is the same for all points is given to each."""
    backend = choose_backend("double")
    rng = np.random.default_rng(n)
    x, other = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    other[: n // 2] = np.nan  # other vectors are not looked at
    calls: list[int] = []

    def compute(p: Any, q: Any) -> tuple[Any, ...]:
        calls.append(dr.width(p))
        return dr.dot(p, q), p + q, backend.Float(3)

    for points in (x, to_vector3(backend, x)):
        calls.clear()
        product, total, three = map_batches(backend, compute, points, other, at_once=7)
        assert calls == {0: [1], 1: [1], 7: [7], 8: [7, 1], 20: [7, 7, 6]}[n]
        np.testing.assert_allclose(product, (x * other).sum(axis=1), rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(total, x + other)
        np.testing.assert_array_equal(three, np.full(n, 3.0))


@pytest.mark.few(3)
@pytest.mark.parametrize("name", FIELDS)
def test_arrays_of_drjit_carry_derivatives(name: str) -> None:
    field, backend = FIELDS[name], choose_backend("double")
    p = to_vector3(backend, POINTS)
    np.testing.assert_allclose(
        to_numpy(field.value(p)), field.value(POINTS, precision="double"), atol=1e-6
    )
    dr.enable_grad(p)
    value = field.value(p)
    dr.backward(value)
    expected = field.gradient(POINTS, precision="double")
    np.testing.assert_allclose(to_numpy(dr.grad(p)), expected, atol=1e-5)
    q = to_vector3(backend, POINTS)
    dr.enable_grad(q)
    dr.backward(field.gradient(q).x)
    bend = field.hessian(POINTS, precision="double")  # type: ignore[call-arg]
    np.testing.assert_allclose(to_numpy(dr.grad(q)), bend[:, 0], atol=1e-4)


def test_a_field_of_a_users_own_has_them_too() -> None:
    np.testing.assert_allclose(Plane().value(POINTS), POINTS[:, 0], rtol=1e-6)
    np.testing.assert_allclose(Plane().gradient(POINTS), np.tile([1.0, 0, 0], (4, 1)))
    with pytest.raises(NotImplementedError, match="second derivatives"):
        Plane().hessian(POINTS)  # type: ignore[arg-type]


def test_values_are_differentiable_in_a_curves_vertices() -> None:
    backend = choose_backend("double")
    loop, move = wavy_polygon(12), np.random.default_rng(0).normal(size=(12, 3))
    v = to_vector3(backend, loop)
    dr.enable_grad(v)
    dr.set_grad(v, to_vector3(backend, move))
    value = hk.SolidAngle(v).value(to_vector3(backend, POINTS))
    rate = to_numpy(dr.forward_to(value))
    h = 1e-6
    ahead = hk.SolidAngle(loop + h * move).value(POINTS, precision="double")
    behind = hk.SolidAngle(loop - h * move).value(POINTS, precision="double")
    np.testing.assert_allclose(rate, (ahead - behind) / (2 * h), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["curve", "mesh", pytest.param("tree", marks=pytest.mark.slow), "cloud", "screened"]
)
def test_hits_carry_derivatives_backwards(name: str) -> None:
    """Through sums that loops evaluate, in reverse mode: those of meshes and clouds raised."""
    field, backend = FIELDS[name], choose_backend("double")
    rng, h = np.random.default_rng(2), 1e-6
    o, target = np.tile([0.3, -0.4, 3.0], (60, 1)), 0.5 * rng.normal(size=(60, 3))

    def hits(origins: np.ndarray) -> Any:
        return hk.trace(field, origins, target - o, tolerance=1e-11, precision="double")

    step = np.array([h, 0, 0])
    ahead, behind = hits(o + step), hits(o - step)
    start = to_vector3(backend, o)
    dr.enable_grad(start)
    end = hk.trace(field, start, to_vector3(backend, target - o), tolerance=1e-11)
    t = to_numpy(dr.detach(end.t))
    smooth = np.isfinite(t) & (to_numpy(end.primitive_index) < 0)
    dr.backward(dr.sum(dr.select(dr.isfinite(end.t), end.t, 0)))
    smooth &= np.isfinite(ahead.t) & np.isfinite(behind.t)
    rate = np.where(smooth, ahead.t, 0) - np.where(smooth, behind.t, 0)
    rate /= 2 * h
    smooth &= np.isfinite(rate) & (np.abs(rate) < 10)
    assert smooth.sum() > 10
    off = np.abs(to_numpy(dr.grad(start))[:, 0] - rate)[smooth]
    assert np.quantile(off, 0.9) < 1e-3


def test_fields_print_as_they_were_made() -> None:
    """They printed as <... at 0x...>, or with all their numbers."""
    assert repr(hk.Gyroid(0.5, domain=hk.Ball())).startswith("Gyroid(cell=0.5, domain=Ball(")
    assert repr(hk.SphericalHarmonic(3, 1)) == "SphericalHarmonic(l=3, m=1)"
    cut = hk.Sphere(1.0) - hk.Torus(0.8, 0.2)
    assert repr(cut).startswith("BooleanSolid(parts=(Sphere(), Complement(")
    assert repr(hk.Tube([[0, 0, 0], [1, 0, 0]], 0.1)) == "Tube(points=<array 2 x 3>, radius=0.1)"
    many = (
        hk.SolidAngle(wavy_polygon(64)),
        hk.WindingNumber(*icosphere(2)),
        cut.twisted(math.degrees(1.0)),
        hk.expression(lambda x, y, z: x + y - z),
        hk.fields.LevelCurves("log", "imag"),
        hk.Blobs([[0, 0, 0]], 1.0),
        hk.fields.RiemannSurface("sqrt"),
        cut.translated((1, 2, 3)) | hk.solids.Plane(),
    )
    for field in many:
        assert "0x" not in repr(field)
        assert len(repr(field)) < 200
        assert "0x" not in repr(hk.Surface(field).field)
