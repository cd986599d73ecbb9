"""Neural networks: values against NumPy, bounds along rays and in balls, first hits against dense
sampling, files, PyTorch's modules, and errors."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.backend.local_memory import allocate_local
from harnack.testing import check_field
from tests.oracles.networks import first_hits, network_value_and_gradient

ACTIVATIONS: dict[str, Any] = {
    "relu": "relu",
    "tanh": "tanh",
    "sine": ("sine", 5.0),
    "softplus": ("softplus", 4.0),
    "elu": ("elu", 1.5),
    "mixed": ["elu", ("sine", 2.0)],
}
WIDTHS = (24, 17)


def random_layers(
    seed: int, widths: tuple[int, ...] = WIDTHS, scale: float = 1.5
) -> list[tuple[Any, Any]]:
    """Layers with normal weights, whose values are about of the size `scale` times those before."""
    rng = np.random.default_rng(seed)
    sizes = (3, *widths, 1)
    return [
        (scale * rng.normal(size=(m, k)) / np.sqrt(k), 0.3 * rng.normal(size=m))
        for k, m in itertools.pairwise(sizes)
    ]


def rays_from(radius: float, count: int, seed: int, spread: float = 0.8) -> tuple[Any, Any]:
    """Rays from points of a sphere to points of a cube of half the edge `spread`."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-spread, spread, (count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def check_hits(
    layers: list[tuple[Any, Any]], activation: Any, rays: tuple[Any, Any], precision: Any,
    level: float = 0.0, offset: float = 0.0, tolerance: float = 1e-3,
) -> Any:  # fmt: skip
    """Trace, and compare with dense sampling: no crossing is missed, and no hit lies before the
    first crossing, unless f comes near the level there."""
    domain = hk.Box(*(((c + offset,) * 3) for c in (-1.0, 1.0)))
    moved = [(layers[0][0], layers[0][1] - layers[0][0].sum(axis=1) * offset), *layers[1:]]
    origins, directions = (np.asarray(part, np.float32).astype(float) for part in rays)
    origins = (origins + offset).astype(np.float32).astype(float)
    field = hk.Network(moved, activation=activation, domain=domain, level=level)
    hits = hk.trace(field, origins, directions, precision=precision)
    t = np.where(np.asarray(hits.status) == hk.RayStatus.HIT, hits.t, np.inf)
    expected, sizes = first_hits(
        moved, activation, origins, directions, domain.bounds(), level, steps=500
    )
    unproved = np.asarray(hits.status) == hk.RayStatus.OUT_OF_STEPS
    assert not ((t > expected + tolerance) & ~unproved).any()  # none is missed
    early = (t < expected - tolerance) & np.isfinite(t)
    at = origins[early] + t[early, None] * directions[early]
    value, gradient = network_value_and_gradient(moved, activation, at)
    room = tolerance * (1 + np.linalg.norm(gradient, axis=1)) + 1e-5 * sizes[early]
    assert (np.abs(value - level) <= room).all()
    return hits


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_values_and_gradients_are_those_of_numpy_within_their_errors(
    name: str, precision: Any
) -> None:
    layers, activation = random_layers(1), ACTIVATIONS[name]
    field = hk.Network(layers, activation=activation)
    backend = choose_backend(precision)
    p = to_vector3(backend, np.random.default_rng(2).uniform(-1, 1, (500, 3)))
    sample = field.evaluator(backend).evaluate(p)
    value, gradient = network_value_and_gradient(layers, activation, to_numpy(p).astype(np.float64))
    own = 1e-15 * (1 + np.abs(value))  # of the oracle
    error = to_numpy(sample.value_error).astype(np.float64)
    assert (np.abs(to_numpy(sample.value) - value) <= error + own).all()
    off = np.linalg.norm(to_numpy(sample.gradient) - gradient, axis=1)
    assert (off <= to_numpy(sample.gradient_error) + 1e-13).all()
    limit = 1e-3 if precision == "single" else 1e-11
    assert np.median(error) < limit


@pytest.mark.slow
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_the_contract_of_fields_holds(name: str) -> None:
    check_field(hk.Network(random_layers(3), activation=ACTIVATIONS[name]), count=40, directions=4)


@pytest.mark.few(4)
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("name", ACTIVATIONS)
def test_first_hits_are_those_of_dense_sampling(name: str, precision: Any) -> None:
    rays = rays_from(1.7, 120, 4)
    hits = check_hits(random_layers(5), ACTIVATIONS[name], rays, precision)
    assert (np.asarray(hits.status) == hk.RayStatus.HIT).sum() > 12
    assert (np.asarray(hits.status) == hk.RayStatus.OUT_OF_STEPS).sum() == 0
    assert hits.evaluations.mean() < 60


# What attacks tried: scales of weights, dead neurons, sines of high frequency, far levels, rays
# from inside and along faces, and coordinates far from the origin in single precision.
@pytest.mark.few(2)
@pytest.mark.parametrize("scale", [0.1, 4.0, 30.0])
@pytest.mark.parametrize("name", ["relu", "tanh"])
def test_weights_of_other_sizes(name: str, scale: float) -> None:
    layers = random_layers(6, scale=scale)
    weights, bias = layers[-1]
    probe = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    value, _ = network_value_and_gradient(layers, name, probe)
    layers[-1] = (weights / np.ptp(value), bias / np.ptp(value))
    level = float(np.median(value)) / float(np.ptp(value))
    hits = check_hits(layers, name, rays_from(0.5, 100, 7), "double", level)
    assert (np.asarray(hits.status) == hk.RayStatus.OUT_OF_STEPS).mean() < 0.05


def test_dead_neurons() -> None:
    layers = random_layers(8)
    weights, bias = layers[0]
    bias = np.where(np.arange(len(bias)) % 2 == 0, -50.0, bias)
    layers[0] = (weights, bias)
    check_hits(layers, "relu", rays_from(1.7, 100, 9), "single")
    # A kink through the origin of all rays, which run along it.
    layers[0] = (np.eye(24, 3), np.zeros(24))
    origins = np.zeros((60, 3))
    directions = np.concatenate([np.eye(3), -np.eye(3), rays_from(1.0, 54, 1)[1]])
    check_hits(layers, "relu", (origins, directions), "double")


def test_a_siren_of_frequency_30() -> None:
    rng = np.random.default_rng(10)
    layers = [
        (rng.uniform(-1 / 3, 1 / 3, (24, 3)), rng.uniform(-1, 1, 24)),
        (rng.uniform(-0.02, 0.02, (24, 24)), rng.uniform(-1, 1, 24)),
        (rng.uniform(-0.02, 0.02, (1, 24)), np.zeros(1)),
    ]
    check_hits(layers, "sine", rays_from(1.7, 100, 11), "double")


def test_levels_that_are_not_taken_are_proved_misses() -> None:
    hits = check_hits(random_layers(12), "tanh", rays_from(1.7, 100, 13), "single", 50.0)
    assert (np.asarray(hits.status) == hk.RayStatus.MISS).all()


def test_far_from_the_origin_in_single_precision() -> None:
    rays = rays_from(1.7, 100, 14)
    check_hits(random_layers(15), "relu", rays, "single", offset=1000.0, tolerance=2e-2)


def test_gradients_change_no_more_than_their_bound() -> None:
    rng = np.random.default_rng(16)
    for name in ("relu", "softplus"):
        layers, activation = random_layers(17), ACTIVATIONS[name]
        field, backend = hk.Network(layers, activation=activation), choose_backend("double")
        p = rng.uniform(-0.8, 0.8, (50, 3))
        for radius in (0.2, 0.02):
            evaluator = field.evaluator(backend)
            bound = to_numpy(
                evaluator.gradient_change_bound(to_vector3(backend, p), backend.Float(radius))
            )
            v = rng.normal(size=(200, 1, 3))
            y = p + radius * v / np.linalg.norm(v, axis=2, keepdims=True) * rng.random((200, 50, 1))
            _, at = network_value_and_gradient(layers, activation, p)
            _, near = network_value_and_gradient(layers, activation, y.reshape(-1, 3))
            change = np.linalg.norm(near.reshape(200, 50, 3) - at, axis=2)
            assert (change <= bound + 1e-12).all()
            assert np.median(bound) < 100 * np.median(change.max(axis=0)) + 1e-6


def test_networks_of_other_sizes_use_kernels_of_their_own() -> None:
    backend = choose_backend("double")
    for size in (32, 64, 4096):
        assert len(allocate_local(backend, size)) == size
    for widths in ((16,), (40, 70), (16,), (100, 4, 9)):
        layers = random_layers(18, widths)
        points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
        value = hk.Network(layers).value(points)
        assert np.allclose(value, network_value_and_gradient(layers, "relu", points)[0], atol=1e-12)


@pytest.mark.slow
def test_meshes() -> None:
    layers = ball_layers()
    mesh = hk.mesh(hk.Network(layers), cell_size=0.3)
    vertices = np.asarray(mesh.vertices)
    value, _ = network_value_and_gradient(layers, "relu", vertices)
    assert len(vertices) > 50
    assert np.abs(value).max() < 1e-3


def test_solids_and_distances() -> None:
    network = hk.Network(ball_layers())
    solid = hk.solid(network, below=0.0) - hk.Sphere(0.3)
    hits = hk.trace(solid, [[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    assert hits.t[0] == pytest.approx(0.3, abs=1e-3)
    distance = hk.signed_distance(network, [[0.0, 0.0, 0.0]])[0]
    assert distance == pytest.approx(-0.9 / np.sqrt(3), abs=1e-3)


def ball_layers() -> list[tuple[Any, Any]]:
    """A ReLU network that is |x| + |y| + |z| - 0.9, a regular octahedron."""
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    return [
        (faces, np.zeros(6)),
        (np.eye(6), np.zeros(6)),
        (np.ones((1, 6)), np.array([-0.9])),
    ]


def test_files(tmp_path: Path) -> None:
    layers, points = random_layers(19), np.random.default_rng(1).uniform(-1, 1, (20, 3))
    value = hk.Network(layers, activation=("elu", 2.0)).value(points)
    names = ("0", "2", "10")
    arrays = {f"{n}.weight": w for n, (w, _) in zip(names, layers, strict=True)}
    arrays |= {f"{n}.bias": b for n, (_, b) in zip(names, layers, strict=True)}
    path = tmp_path / "network.npz"
    np.savez(path, activation=np.array("elu"), parameter=np.array(2.0), **arrays)
    assert (hk.Network.from_file(path).value(points) == value).all()
    np.savez(path, **{f"bias_{k}": b for k, (_, b) in enumerate(layers)})
    with pytest.raises(ValueError, match="no other array"):
        hk.Network.from_file(path)
    np.savez(path, scale=np.ones(3))
    with pytest.raises(ValueError, match="'scale'"):
        hk.Network.from_file(path)
    path.write_text("nothing")
    with pytest.raises(ValueError, match=r"no \.npz file"):
        hk.Network.from_file(path)
    with pytest.raises(FileNotFoundError):
        hk.Network.from_file(tmp_path / "none.npz")


def module(kind: str, children: tuple[Any, ...] = (), **attributes: Any) -> Any:
    """An object like a module of PyTorch."""
    return type(kind, (SimpleNamespace,), {"children": lambda _: children})(**attributes)


def test_modules_of_pytorch() -> None:
    layers, points = random_layers(20), np.random.default_rng(1).uniform(-1, 1, (20, 3))
    linear = [module("Linear", weight=w, bias=b) for w, b in layers]
    softplus, sine = module("Softplus", beta=3.0), module("Sine", w0=4.0)
    inner = module("Sequential", (linear[0], softplus, module("Identity")))
    network = module("Sequential", (inner, linear[1], sine, linear[2]))
    field = hk.Network.from_torch(network)
    expected = hk.Network(layers, activation=[("softplus", 3.0), ("sine", 4.0)])
    assert (field.value(points) == expected.value(points)).all()
    with pytest.raises(TypeError, match="LayerNorm is not supported"):
        hk.Network.from_torch(module("Sequential", (linear[0], module("LayerNorm"))))
    with pytest.raises(ValueError, match=r"module 1 .* an activation"):
        hk.Network.from_torch(module("Sequential", (linear[0], linear[1])))
    with pytest.raises(ValueError, match="end with a Linear"):
        hk.Network.from_torch(module("Sequential", (linear[0], module("ReLU"))))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda a: a[:1], ValueError, "at least two layers"),
        (lambda a: [(a[0][0][:, :2], a[0][1]), *a[1:]], ValueError, r"shape \(m, 3\)"),
        (lambda a: [(a[0][0], a[0][1][:-1]), *a[1:]], ValueError, "the bias of layer 0"),
        (lambda a: [(a[0][0] * np.nan, a[0][1]), *a[1:]], ValueError, "NaN or infinite"),
        (lambda a: [*a[:-1], (np.ones((2, 17)), np.ones(2))], ValueError, "one row"),
        (lambda a: [*a[:-1], (a[-1][0],)], TypeError, "no pair"),
        (lambda a: "relu", TypeError, "sequence of pairs"),
        (lambda a: [(np.ones((4097, 3)), np.ones(4097)), *a[1:]], ValueError, "4,096"),
    ],
)
def test_wrong_layers_are_refused(change: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        hk.Network(change(random_layers(0)))


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"activation": "rely"}, ValueError, "did you mean"),
        ({"activation": ("relu", 2.0)}, ValueError, "no parameter"),
        ({"activation": ("elu", -1.0)}, ValueError, "positive"),
        ({"activation": 3}, TypeError, "an activation is a name"),
        ({"activation": ["relu"]}, ValueError, "one for each layer"),
        ({"level": np.inf}, ValueError, "finite"),
        ({"domain": hk.HalfSpace((0, 0, 1), 0.0)}, ValueError, "bounded"),
    ],
)
def test_wrong_choices_are_refused(keywords: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        hk.Network(random_layers(0), **keywords)


def test_weights_whose_squares_overflow_are_refused() -> None:
    """Bounds would be infinite in single precision, and every ray a hit."""
    layers = [(np.eye(3), np.zeros(3)), (np.full((1, 3), 1e20), np.zeros(1))]
    with pytest.raises(ValueError, match="overflow in single precision: scale the network"):
        hk.Network(layers, activation="softplus")
