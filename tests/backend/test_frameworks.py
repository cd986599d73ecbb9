"""Derivatives to and from PyTorch and JAX. `make test-frameworks` installs both and runs this."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

torch: Any = pytest.importorskip("torch", reason="make test-frameworks installs PyTorch")
jax: Any = pytest.importorskip("jax", reason="make test-frameworks installs JAX")

import harnack as hk  # noqa: E402
from harnack.backend import Precision, choose_backend, to_numpy, to_vector3  # noqa: E402
from harnack.backend.llvm import best_library  # noqa: E402
from harnack.geometry import example_curves  # noqa: E402
from tests.backend.test_kernels import compiled  # noqa: E402
from tests.project.test_readme import ROOT, blocks_of, run_code  # noqa: E402

# PyTorch's and JAX's arrays lie on the CPU here.
pytestmark = pytest.mark.skipif(
    choose_backend().name != "llvm", reason="compared with Dr.Jit on the CPU"
)

PAGE = blocks_of(ROOT / "docs" / "frameworks.md")
LOOP = example_curves.wavy_polygon(12)
EYE = np.array([2.2, -2.2, 1.6])
AWAY = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)) - EYE
POINTS = 0.4 * np.random.default_rng(1).normal(size=(20, 3))


def depths(vertices: Any, origins: Any, directions: Any, level: Any) -> Any:
    hits = hk.trace(hk.SolidAngle(vertices), origins, directions, level=level)
    return dr.select(hits.is_hit, hits.t, 0)


def angles(vertices: Any, points: Any) -> Any:
    return dr.sin(hk.SolidAngle(vertices).value(points) / 4)


def slopes(points: Any) -> Any:
    return hk.SolidAngle(LOOP).gradient(points)


def depths_of_sum(first: Any, second: Any, constant: Any, origins: Any, directions: Any) -> Any:
    terms = hk.SphericalHarmonic(2, 0), hk.SphericalHarmonic(3, 1)
    field = hk.fields.FieldSum(terms, [first, second], constant)
    hits = hk.trace(field, origins, directions, level=0.1)
    return dr.select(hits.is_hit, hits.t, 0)


def clearances(vertices: Any, origins: Any, directions: Any) -> Any:
    return hk.trace(hk.SolidAngle(vertices), origins, directions, clearance=True).clearance


CASES: dict[str, tuple[Any, list[Any]]] = {
    "trace": (depths, [LOOP, np.tile(EYE, (20, 1)), AWAY, np.array(6.0)]),
    "clearance": (clearances, [LOOP, np.tile(EYE, (20, 1)), 3 * AWAY + 2 * EYE]),
    "value": (angles, [LOOP, POINTS]),
    "gradient": (slopes, [POINTS]),
    "weights": (
        depths_of_sum,
        [*map(np.array, (2.0, 1.0, 0.05)), np.tile(EYE, (20, 1)), AWAY],
    ),
}


def with_drjit(name: str, precision: Precision) -> tuple[np.ndarray, list[np.ndarray]]:
    """The result, and the gradients of the sum of its entries times 1, 2, 3 and so on."""
    function, arrays = CASES[name]
    backend = choose_backend(precision)
    given = [
        to_vector3(backend, a) if a.ndim else backend.Float(float(a))
        for a in (array.astype(backend.dtype) for array in arrays)
    ]
    dr.enable_grad(given)
    result = function(*given)
    value = to_numpy(result)
    one_by_one = dr.ravel(result) if value.ndim == 2 else result
    dr.backward(dr.sum(one_by_one * dr.arange(backend.Float, 1, value.size + 1)))
    gradients = (to_numpy(one.grad).reshape(a.shape) for one, a in zip(given, arrays, strict=True))
    return value, list(gradients)


def with_torch(name: str, precision: Precision) -> tuple[np.ndarray, list[np.ndarray]]:
    function, arrays = CASES[name]
    dtype = torch.float32 if precision == "single" else torch.float64
    arguments = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays]
    result = hk.io.wrap_for_torch(function)(*arguments)
    weights = torch.arange(1, result.numel() + 1, dtype=dtype).reshape(result.shape)
    (result * weights).sum().backward()
    return result.detach().numpy(), [value.grad.numpy() for value in arguments]


def with_jax(name: str, precision: Precision) -> tuple[np.ndarray, list[np.ndarray]]:
    function, arrays = CASES[name]
    with jax.enable_x64(precision == "double"):
        given = [jax.numpy.asarray(a, "f4" if precision == "single" else "f8") for a in arrays]
        result, pull_back = jax.vjp(hk.io.wrap_for_jax(function), *given)
        weights = jax.numpy.arange(1, result.size + 1, dtype=result.dtype).reshape(result.shape)
        return np.asarray(result), [np.asarray(one) for one in pull_back(weights)]


@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("framework", [with_torch, with_jax])
def test_values_and_derivatives_are_those_of_drjit(
    framework: Any, name: str, precision: Precision
) -> None:
    value, gradients = with_drjit(name, precision)
    found, derivatives = framework(name, precision)
    assert found.tobytes() == value.tobytes()
    assert found.dtype == (np.float32 if precision == "single" else np.float64)
    for got, expected in zip(derivatives, gradients, strict=True):
        assert got.shape == expected.shape
        scale = np.abs(expected).max()
        assert scale > 0
        # Sums over lanes are taken in any order.
        rounding = 1e-5 if precision == "single" else 1e-13
        np.testing.assert_allclose(got, expected, atol=rounding * scale)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("framework", [with_torch, with_jax])
def test_derivatives_are_limits_of_differences(
    framework: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of fourth order, each argument moved along a random direction."""
    function, arrays = CASES[name]
    rng = np.random.default_rng(2)
    gradients = framework(name, "double")[1]
    for k, gradient in enumerate(gradients):
        motion = rng.normal(size=gradient.shape)

        def weighted(step: float, k: int = k, motion: np.ndarray = motion) -> np.ndarray:
            moved = [a + (step * motion if i == k else 0) for i, a in enumerate(arrays)]
            monkeypatch.setitem(CASES, name, (function, moved))
            value = framework(name, "double")[0]
            return value.ravel() @ np.arange(1, value.size + 1)

        h = 1e-4
        slope = 8 * (weighted(h) - weighted(-h)) - (weighted(2 * h) - weighted(-2 * h))
        assert (gradient * motion).sum() == pytest.approx(slope / (12 * h), rel=1e-6)


def test_jax_compiles_around_a_wrapped_function() -> None:
    def count(x: Any, repeats: Any) -> Any:
        return {"sum": dr.sum(x * x, axis=1), "repeats": repeats}

    def loss(wrapped: Any) -> Any:
        return lambda x, n: (wrapped(x, n)["sum"] * jax.numpy.arange(20)).sum()

    x, n = jax.numpy.asarray(POINTS, "f4"), jax.numpy.array([3], "i4")
    plain = hk.io.wrap_for_jax(count)
    shaped = hk.io.wrap_for_jax(count, result_like=lambda x, n: {"sum": x[:, 0], "repeats": n})
    assert jax.jit(shaped)(x, n)["repeats"] == 3
    expected = 2 * POINTS * np.arange(20)[:, None]
    for gradient in (
        jax.grad(loss(plain)),
        jax.grad(loss(shaped)),
        jax.jit(jax.grad(loss(shaped))),
    ):
        np.testing.assert_allclose(gradient(x, n), expected, rtol=1e-5)
    jacobian = jax.jacrev(lambda x: plain(x, n)["sum"])(x)
    np.testing.assert_allclose(np.einsum("iij->ij", jacobian), 2 * POINTS, rtol=1e-5)
    with pytest.raises(TypeError, match=r"cannot run inside jax\.jit.*result="):
        jax.jit(plain)(x, n)
    with pytest.raises(TypeError, match=r"returns Dr\.Jit arrays or tensors.*not Hits"):
        hk.io.wrap_for_jax(lambda v: hk.trace(hk.SolidAngle(v), EYE[None], AWAY))(x)


def test_results_that_are_arguments_or_come_twice() -> None:
    def twice(x: Any, factor: Any) -> tuple[Any, ...]:
        y = factor * x
        return x, y, y

    def loss(x: Any, factor: Any) -> Any:
        return sum(k * one.sum() for k, one in enumerate(hk.io.wrap_for_jax(twice)(x, factor), 1))

    by_x, by_factor = jax.grad(loss, argnums=(0, 1))(jax.numpy.arange(3.0), 10.0)
    np.testing.assert_allclose(by_x, np.full(3, 1 + 5 * 10.0))
    assert by_factor == 5 * 3.0


def test_compiled_gradients_of_many_points() -> None:
    """So many that JAX hands them over by another thread."""
    points = jax.numpy.asarray(np.tile(POINTS, (5000, 1)), "f4")
    wrapped = hk.io.wrap_for_jax(angles, result_like=lambda vertices, points: points[:, 0])
    gradient = jax.jit(jax.grad(lambda v, p: wrapped(v, 2 * p).mean()))
    vertices = jax.numpy.asarray(LOOP, "f4")
    few = jax.grad(lambda v, p: hk.io.wrap_for_jax(angles)(v, 2 * p).mean())(vertices, points[:20])
    np.testing.assert_allclose(gradient(vertices, points), few, atol=1e-4)


def test_all_of_hits_comes_out() -> None:
    rays = np.tile(EYE, (20, 1)), AWAY
    expected = hk.trace(hk.SolidAngle(LOOP), *rays, precision="single")

    def everything(origins: Any, directions: Any) -> dict[str, Any]:
        return vars(hk.trace(hk.SolidAngle(LOOP), origins, directions))

    in_torch = (torch.tensor(a, dtype=torch.float32) for a in rays)
    in_jax = (jax.numpy.asarray(a, "f4") for a in rays)
    for found in (
        hk.io.wrap_for_torch(everything)(*in_torch),
        hk.io.wrap_for_jax(everything)(*in_jax),
    ):
        assert found.keys() == vars(expected).keys()
        for name, value in vars(expected).items():
            assert found[name].shape == value.shape
            np.testing.assert_allclose(np.asarray(found[name]), value, atol=5e-3, err_msg=name)


@pytest.mark.parametrize("target", ["torch", "jax"])
def test_a_loss_in_another_framework(target: str) -> None:
    backend = choose_backend()

    def gradient(loss: Any) -> np.ndarray:
        vertices = to_vector3(backend, LOOP)
        dr.enable_grad(vertices)
        origins, directions = to_vector3(backend, EYE[None]), to_vector3(backend, AWAY)
        dr.backward(loss(depths(vertices, origins, directions, 6.0)))
        return to_numpy(vertices.grad)

    expected = gradient(lambda t: dr.sum(t * t))
    found = gradient(dr.wrap(source="drjit", target=target)(lambda t: (t * t).sum()))
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def seen(vertices: Any, origins: Any, directions: Any) -> Any:
    """1 where rays hit, else 0."""
    hits = hk.trace(hk.SolidAngle(vertices), origins, directions, level=6.0)
    return dr.select(hits.is_hit, type(hits.t)(1), 0)


@pytest.mark.parametrize("framework", ["torch", "jax"])
def test_whether_rays_hit_has_no_derivative(framework: str) -> None:
    """It was exactly 0, without a word; and the value alone is as ever."""
    arguments = [np.asarray(value, np.float32) for value in (LOOP, EYE[None], AWAY)]
    if framework == "torch":
        tensors = [torch.tensor(value, requires_grad=True) for value in arguments]
        result = hk.io.wrap_for_torch(seen)(*tensors)

        def differentiated() -> None:
            result.sum().backward()
    else:
        result, pull_back = jax.vjp(hk.io.wrap_for_jax(seen), *arguments)

        def differentiated() -> None:
            pull_back(jax.numpy.ones_like(result))

    assert 0 < np.asarray(result.detach() if framework == "torch" else result).mean() <= 1
    with pytest.raises(NotImplementedError, match="nothing that has a derivative"):
        differentiated()


def test_graphs_of_pytorch_can_be_gone_back_through_again() -> None:
    """A second pass repeated the first, whatever it was asked for."""
    vertices = torch.tensor(LOOP, requires_grad=True)
    rest = [torch.tensor(value) for value in CASES["trace"][1][1:]]
    weights = torch.arange(1.0, 21.0, dtype=torch.float64), torch.linspace(-3, 1, 20).double()

    def gradient(result: Any, weight: Any, again: bool) -> Any:
        total = (result * weight).sum()
        return torch.autograd.grad(total, vertices, retain_graph=again)[0]

    kept = hk.io.wrap_for_torch(depths)(vertices, *rest)
    for weight in weights:
        alone = gradient(hk.io.wrap_for_torch(depths)(vertices, *rest), weight, False)
        torch.testing.assert_close(gradient(kept, weight, True), alone)
    points = torch.tensor(POINTS[:2])
    assert torch.autograd.gradcheck(lambda v: hk.io.wrap_for_torch(angles)(v, points), (vertices,))


def test_second_derivatives_in_pytorch_are_refused() -> None:
    """Also where they are only a part: of (r t)' = t + r t' the term r t'' was left out."""

    @hk.io.wrap_for_torch
    def value(r: Any, points: Any) -> Any:
        return hk.Sphere(r).value(points) ** 2

    r = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    point = torch.tensor([[0.3, -0.2, 0.4]], dtype=torch.float64)
    (slope,) = torch.autograd.grad((r * value(r, point)).sum(), r, create_graph=True)
    assert slope.item() == pytest.approx(0.0385165 * (0.0385165 - 1), rel=1e-4)
    for loss in (slope, slope + r**2):
        with pytest.raises(NotImplementedError, match="no second derivatives"):
            torch.autograd.grad(loss, r, retain_graph=True)
    assert torch.autograd.grad(slope.detach() * r, r)[0] == slope


def test_containers_and_other_arguments_are_passed_on() -> None:
    def both(points: Any, scale: float) -> Any:
        return {"twice": scale * points, "count": hk.SolidAngle(LOOP).value(points)}

    points = torch.tensor(POINTS, requires_grad=True)
    result = hk.io.wrap_for_torch(both)(points, 2.0)
    assert list(result) == ["twice", "count"]
    result["twice"].sum().backward()
    torch.testing.assert_close(points.grad, torch.full_like(points, 2.0))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trace", "clearance", "value"])
def test_a_step_compiles_nothing_after_the_first_two(name: str) -> None:
    """Vertices leave a plane, and then the convex position; batches begin anywhere in memory."""
    function, arrays = CASES[name]
    t = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    circle = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    vertices = torch.tensor(circle, dtype=torch.float32, requires_grad=True)
    rest = [torch.tensor(a, dtype=torch.float32) for a in arrays[1:]]
    optimizer = torch.optim.Adam([vertices], lr=0.03)
    in_torch = hk.io.wrap_for_torch(function)
    in_jax = jax.value_and_grad(lambda *given: (hk.io.wrap_for_jax(function)(*given) ** 2).sum())
    certificates: set[str] = set()

    def step(k: int) -> None:
        batch = [one[k : k + 10] if one.ndim else one + 0.01 * k for one in rest]
        optimizer.zero_grad()
        (in_torch(vertices, *batch) ** 2).sum().backward()
        optimizer.step()
        now = vertices.detach().numpy()
        in_jax(now, *(jax.numpy.asarray(one.numpy()) for one in batch))
        certificates.add(hk.SolidAngle(now).lift_bound)

    certificates.add(hk.SolidAngle(circle).lift_bound)
    step(0), step(1)
    assert [compiled(lambda k=k: step(k)) for k in range(2, 10)] == [0] * 8
    assert len(certificates) > 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "order", ["torch, jax, harnack", "harnack, jax, torch", "drjit, torch, jax"]
)
def test_any_order_of_imports(order: str) -> None:
    """Each brings an LLVM or an OpenMP of its own.

    Dr.Jit imported first loads the system's LLVM, which may be unsuitable: the variable names
    another, as the error's text says (`test_backend` has the error).
    """
    code = f"""
import {order}
import harnack as hk, jax, numpy as np, torch
torch.randn(300, 300) @ torch.randn(300, 300)
(jax.numpy.ones((300, 300)) @ jax.numpy.ones((300, 300))).block_until_ready()
loop = hk.geometry.example_curves.wavy_polygon(12)
hk.render(hk.SolidAngle(loop), size=(16, 16), show="shaded", progress=False)
value = lambda v, p: hk.SolidAngle(v).value(p)
v, p = torch.tensor(loop, requires_grad=True), torch.tensor([[0, 0, 0.5]], dtype=torch.float64)
hk.io.wrap_for_torch(value)(v, p).sum().backward()
first = lambda *arrays: hk.io.wrap_for_jax(value)(*arrays)[0]
gradient = jax.grad(first)(np.float32(loop), np.float32(p))
np.testing.assert_allclose(v.grad.numpy(), gradient, atol=1e-5)
"""
    library = best_library()
    named = {"DRJIT_LIBLLVM_PATH": str(library.path)} if library is not None else {}
    environment = os.environ | named if order.startswith("drjit") else None
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert run.returncode == 0, run.stderr


@pytest.mark.slow
@pytest.mark.parametrize("block", PAGE, ids=lambda block: block.splitlines()[-1][:40])
def test_code_of_the_page_runs(block: str, tmp_path: Path) -> None:
    run_code(block, tmp_path)


def test_the_page_has_code() -> None:
    assert len(PAGE) == 7


@pytest.mark.slow
def test_dlpack_hands_out_hits_without_a_copy() -> None:
    """The page `docs/interoperability/arrays.md`; `make test-interop` runs its other code."""
    *_, block = blocks_of(ROOT / "docs" / "interoperability" / "arrays.md")
    page: dict[str, Any] = {}
    exec(block, page)
    positions = page["hits"].position
    expected = np.array([[0.7, 0, 0.25], [0, 0.7, 0.25], [np.nan] * 3])
    for shared in (page["with_torch"].numpy(), np.asarray(page["with_jax"])):
        np.testing.assert_allclose(shared, expected, atol=1e-3)
        assert np.shares_memory(shared, np.from_dlpack(positions))


@pytest.mark.slow
def test_tensors_on_the_cpu_are_rays_like_numpy_arrays() -> None:
    expected = hk.trace(hk.SolidAngle(LOOP), EYE[None].astype("f4"), AWAY.astype("f4"))
    assert expected.is_hit.any()
    for module in (torch, jax.numpy):
        rays = [module.asarray(a.astype("f4")) for a in (EYE[None], AWAY)]
        hits = hk.trace(hk.SolidAngle(LOOP), *rays)
        assert isinstance(hits.t, np.ndarray)
        assert hits.t.tobytes() == expected.t.tobytes()


@pytest.mark.parametrize("framework", ["torch", "jax"])
@pytest.mark.parametrize(
    "made",
    [
        lambda r: hk.expression(lambda x, y, z: x * x + y * y + z * z - r.array),
        lambda r: hk.fields.HRBF(r * POINTS.astype(np.float32), POINTS),
    ],
    ids=["expression", "HRBF"],
)
def test_fields_of_learned_numbers_are_refused(framework: str, made: Any) -> None:
    def first_hits(r: Any) -> Any:
        return hk.trace(made(r), POINTS + np.array([0, 0, 3.0]), [[0, 0, -1.0]]).t

    def differentiated() -> Any:
        if framework == "torch":
            r = torch.ones(1, requires_grad=True)
            return hk.io.wrap_for_torch(first_hits)(r)
        return jax.vjp(hk.io.wrap_for_jax(first_hits), jax.numpy.ones(1))

    with pytest.raises(NotImplementedError, match="which carry derivatives"):
        differentiated()


def test_networks_and_their_gradients_have_the_derivatives_of_torch() -> None:
    torch.manual_seed(0)
    linear, softplus = torch.nn.Linear, torch.nn.Softplus
    module = torch.nn.Sequential(linear(3, 12), softplus(), linear(12, 5), softplus(), linear(5, 1))
    module = module.double()
    names, weights = zip(*module.named_parameters(), strict=True)

    @hk.io.wrap_for_torch
    def both(points: Any, *weights: Any) -> Any:
        field = hk.Network(dict(zip(names, weights, strict=True)), activation="softplus")
        return field.value(points), field.gradient(points)

    points = torch.tensor(POINTS, requires_grad=True)
    value, gradient = both(points, *weights)
    expected = module(points)[:, 0]
    (slopes,) = torch.autograd.grad(expected.sum(), points, create_graph=True)
    factors = torch.randn_like(slopes)
    variables = (points, *weights)
    ours = torch.autograd.grad(value.sum() + (gradient * factors).sum(), variables)
    theirs = torch.autograd.grad(expected.sum() + (slopes * factors).sum(), variables)
    for a, b in zip((value, gradient, *ours), (expected, slopes, *theirs), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-12)
