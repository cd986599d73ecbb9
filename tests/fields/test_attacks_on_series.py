"""Cases that attacks on series and harmonics of spheres found, kept as they were."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk

BOX = (-1, -1, -1), (1, 1, 1)


def test_series_of_rounding_alone_are_refused() -> None:
    """Of a wave that is finer than all terms nothing but rounding was left, and drawn."""
    with pytest.raises(ValueError, match="take more terms"):
        hk.fields.FourierSeries.fit(lambda p: np.cos(10 * np.pi * (p[:, 0] + 1)), BOX, terms=4)
    with pytest.raises(TypeError, match="whole numbers"):
        hk.fields.FourierSeries.fit(lambda p: p[:, 0], BOX, terms=2.5)  # type: ignore[arg-type]


def test_harmonics_of_degree_0_have_no_level_sets() -> None:
    """At the one value that they have, rays ran out of steps."""
    field = hk.fields.HypersphericalHarmonic(0, 0, 0)
    with pytest.raises(ValueError, match="constant"):
        hk.trace(field, [[0, 0, 3.0]], [[0, 0, -1.0]], level=field.value_range[0])
