# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
"""ReLU networks in cells: ranges in boxes, small networks that equal the network in a cell, and
samples and first hits with them."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.evaluator import Plan
from harnack.fields.networks import box_ranges, network
from harnack.fields.networks.activations import activation_of
from harnack.fields.networks.box_ranges import ranges_in_boxes
from harnack.fields.networks.cell_networks import networks_of_cells
from harnack.tree.empty_space import BoxCells
from tests.fields.test_network import check_hits, random_layers, rays_from
from tests.oracles.networks import network_value, network_value_and_gradient

SHAPES = ((16,), (24, 17), (20, 12, 14))


def boxes(size: float, count: int = 40) -> BoxCells:
    corners = np.random.default_rng(1).uniform(-1, 1 - size, (count, 3))
    return BoxCells(corners, np.full(3, size))


def points_in(cells: BoxCells, margin: float = 0.0) -> Any:
    """300 points (300, n, 3) in each box, corners among them."""
    unit = np.random.default_rng(2).uniform(-margin, 1 + margin, (300, len(cells.corners), 3))
    unit[:100] = np.where(unit[:100] > 0.5, 1 + margin, -margin)
    return cells.corners + unit * cells.size


@pytest.mark.parametrize("most", [None, 1])
@pytest.mark.parametrize("size", [0.02, 0.3])
def test_ranges_hold_in_boxes(size: float, most: int | None, monkeypatch: Any) -> None:
    """most: of numbers at once: with 1, remainders have no unknown numbers of their own."""
    if most is not None:
        monkeypatch.setattr(box_ranges, "_MAX_NUMBERS", most)
    for seed, shape in enumerate(SHAPES):
        layers, cells = random_layers(seed, shape), boxes(size)
        ranges = ranges_in_boxes(layers, cells, 0.1)
        x = points_in(cells, 0.1)
        for (weights, bias), active, dead in zip(
            layers[:-1], ranges.is_active, ranges.is_dead, strict=True
        ):
            z = x @ weights.T + bias
            assert not (active & (z < 0).any(axis=0)).any()
            assert not (dead & (z > 0).any(axis=0)).any()
            x = np.maximum(z, 0)
        value = (x @ layers[-1][0].T + layers[-1][1])[..., 0]
        assert (value >= ranges.lower).all()
        assert (value <= ranges.upper).all()
        if most is None and size < 0.1:  # sharp: few neurons are open in a small box
            assert np.median((ranges.upper - ranges.lower) / np.ptp(value, axis=0)) < 1.1


def test_small_networks_equal_the_network_in_their_cells() -> None:
    for seed, shape in enumerate(SHAPES):
        layers = random_layers(seed, shape)
        for size in (1e-3, 0.2):
            cells = boxes(size, 20)
            networks = networks_of_cells(layers, activation_of("relu"), cells, 10**6)
            assert networks is not None
            sizes = [sum(layer.weights.size for layer in network.layers) for network in networks]
            if size == 1e-3:
                assert np.median(sizes) < 0.1 * sum(weights.size for weights, _ in layers) + 30
            for k, small in enumerate(networks):
                x = points_in(cells)[:, k]
                expected = network_value(layers, "relu", x)
                output, values = cast("Any", np).full(len(x), small.output_bias), x
                for layer in small.layers:
                    z = values @ layer.weights.T + layer.bias
                    is_linear = np.arange(z.shape[1]) < layer.linear_count
                    values = np.where(is_linear, z, np.maximum(z, 0))
                    output = output + values @ layer.outputs
                    largest = np.linalg.norm(layer.weights, 2) if layer.weights.size else 0
                    assert largest <= layer.spectral <= 1.6 * largest + 1e-12
                assert (np.abs(output - expected) <= small.output_error + 1e-14).all()
                assert 0 < small.output_error < 1e-10
    assert networks_of_cells(random_layers(1), activation_of("relu"), boxes(0.2), 100) is None


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
def test_samples_in_cells_are_right_in_their_balls(precision: Any) -> None:
    layers, rng = random_layers(3), np.random.default_rng(4)
    field, backend = hk.Network(layers), choose_backend(precision)
    evaluator: Any = field.evaluator(backend, Plan((0.0,), 10_000))
    grid = evaluator.occupied_cells()
    centers = grid.occupied_centers()
    p = centers[rng.integers(len(centers), size=300)]
    p = p + grid.cell_size * rng.uniform(-0.499, 0.499, p.shape)
    p = np.concatenate([p, rng.uniform(-1, 1, (100, 3))]).astype(np.float32).astype(float)
    at = to_vector3(backend, p)
    place = evaluator.grid.place(at)
    networks, radius = to_numpy(place.network), to_numpy(place.radius)
    assert (networks[:300] > 0).all()
    assert (networks == 0).any()
    assert np.isinf(radius[networks == 0]).all()
    sample = evaluator.evaluate(at)
    value, gradient = network_value_and_gradient(layers, "relu", p)
    assert (np.abs(to_numpy(sample.value) - value) <= to_numpy(sample.value_error) + 1e-14).all()
    off = np.linalg.norm(to_numpy(sample.gradient) - gradient, axis=1)
    assert (off <= to_numpy(sample.gradient_error) + 1e-12).all()
    for promise in sample.promises[:-1]:  # the last one holds everywhere
        length, constant = to_numpy(promise.radius), to_numpy(promise.constant)
        length = np.minimum(np.broadcast_to(length, 400), 1.0)
        v = rng.normal(size=(50, 400, 3))
        v *= length[:, None] / np.linalg.norm(v, axis=2, keepdims=True)
        change = np.abs(
            network_value(layers, "relu", (p + v).reshape(-1, 3)).reshape(50, 400) - value
        )
        assert (change <= constant * length * (1 + 1e-6) + 1e-12).all()


@pytest.mark.parametrize("shape", [pytest.param(SHAPES[0], marks=pytest.mark.slow), *SHAPES[1:2],
                                   pytest.param(SHAPES[2], marks=pytest.mark.slow)])  # fmt: skip
def test_first_hits_with_cells_are_those_of_dense_sampling(
    shape: tuple[int, ...], monkeypatch: Any
) -> None:
    monkeypatch.setattr(network, "_MIN_RAYS", 100)
    hits = check_hits(random_layers(5, shape), "relu", rays_from(1.7, 400, 6), "single")
    assert (np.asarray(hits.status) == hk.RayStatus.HIT).sum() > 50
    assert (np.asarray(hits.status) == hk.RayStatus.OUT_OF_STEPS).sum() == 0
    assert hits.evaluations.mean() < 12


@pytest.mark.slow
def test_cells_far_from_the_origin_and_at_other_levels(monkeypatch: Any) -> None:
    """Coordinates that are too coarse for cells have the whole network."""
    monkeypatch.setattr(network, "_MIN_RAYS", 100)
    layers = random_layers(15)
    for offset, tolerance in ((30.0, 2e-3), (3000.0, 0.15)):
        check_hits(layers, "relu", rays_from(1.7, 400, 14), "single", 0.2, offset, tolerance)
    check_hits(layers, "relu", rays_from(0.5, 400, 14), "double", -0.1)
    dead = [(layers[0][0], np.full(24, -50.0)), *layers[1:]]
    hits = check_hits(dead, "relu", rays_from(1.7, 400, 14), "single")
    assert (np.asarray(hits.status) == hk.RayStatus.MISS).all()
