"""Old names of parameters and attributes: taken for now, with a warning that names the new one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import estimate_areas, estimate_normals

POINTS = np.random.default_rng(0).normal(size=(40, 3))
POINTS /= np.linalg.norm(POINTS, axis=1, keepdims=True)
HIGH = (0.0, 0.0, 2.0)


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        (
            lambda: hk.Circle(1.0, centre=HIGH).centre,  # pyright: ignore
            lambda: hk.Circle(1.0, center=HIGH).center,
            "center",
        ),
        (
            lambda: hk.Blobs(centres=[HIGH], radii=1.0).centres,  # pyright: ignore
            lambda: hk.Blobs(centers=[HIGH], radii=1.0).centers,
            "centers",
        ),
        (
            lambda: estimate_areas(POINTS, POINTS, neighbours=8),  # pyright: ignore
            lambda: estimate_areas(POINTS, POINTS, neighbors=8),
            "neighbors",
        ),
        (
            lambda: estimate_normals(POINTS, neighbours=8),  # pyright: ignore
            lambda: estimate_normals(POINTS, neighbors=8),
            "neighbors",
        ),
    ],
)
def test_old_names_mean_the_new_ones(
    old: Callable[[], object], new: Callable[[], object], name: str
) -> None:
    with pytest.warns(DeprecationWarning, match=f"is now called {name}; the old name") as seen:
        given = old()
    np.testing.assert_array_equal(np.asarray(given), np.asarray(new()))
    assert {one.filename for one in seen} == {__file__}


def test_old_and_new_name_at_once_are_refused() -> None:
    with pytest.raises(TypeError, match="Circle was given centre and center"):
        hk.Circle(1.0, centre=HIGH, center=HIGH)  # pyright: ignore
