"""Samples of light paths: stratified in every pair of dimensions, and the same wherever drawn."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from harnack.backend.arrays import upload_integers
from harnack.rendering import register
from harnack.rendering.integrator import SobolSampler
from harnack.rendering.mitsuba import mitsuba_backend

mi: Any = register()


def sampler(pixel: np.ndarray, index: np.ndarray, seed: int = 0, dimension: int = 0) -> Any:
    backend = mitsuba_backend(mi)
    pixels, indices = (upload_integers(backend, one) for one in (pixel, index))
    return SobolSampler(mi, pixels, indices, mi.UInt32(seed), mi.UInt32(dimension))


def points(one: Any) -> np.ndarray:
    return np.array(one.next_2d()).reshape(2, -1).T.astype(float)


@pytest.mark.parametrize("power", [2, 4, 6])
@pytest.mark.parametrize("seed", [0, 1, 4_000_000_000])
def test_each_box_of_equal_area_holds_one_sample(power: int, seed: int) -> None:
    n = 2**power
    for pixel in (0, 1, 639):
        one = sampler(np.full(n, pixel), np.arange(n), seed)
        for _ in range(4):
            x, y = points(one).T
            for a in range(power + 1):
                column = np.floor(x * 2**a) * 2 ** (power - a)
                assert len(np.unique(column + np.floor(y * 2 ** (power - a)))) == n


def test_dimensions_pixels_and_seeds_have_nothing_in_common() -> None:
    n = 2**14
    pixels, samples = np.arange(n), np.zeros(n)
    one, other = sampler(pixels, samples, 5), sampler(pixels, samples, 6)
    drawn = np.column_stack([points(one) for _ in range(3)] + [points(other) for _ in range(3)])
    assert drawn.min() >= 0
    assert drawn.max() < 1
    np.testing.assert_allclose(drawn.mean(axis=0), 0.5, atol=5 / np.sqrt(12 * n))
    correlation = np.corrcoef(drawn.T) - np.eye(12)
    assert np.abs(correlation).max() < 5 / np.sqrt(n)


def test_a_path_has_the_same_numbers_on_any_lane() -> None:
    pixel, index = np.repeat(np.arange(40), 8), np.tile(np.arange(8), 40)
    rows = np.random.default_rng(0).permutation(320)[:100]
    whole = sampler(pixel, index, 3)
    some = whole.at_vertex(2, mi.UInt32(rows.astype(np.uint32)))
    alone = whole.at_vertex(2, dr.arange(mi.UInt32, 320))
    for _ in range(3):
        np.testing.assert_array_equal(points(alone)[rows], points(some))
