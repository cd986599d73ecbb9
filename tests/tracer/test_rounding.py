"""Over-stepping in rounded arithmetic: no surface may slip through between two looks.

Both looks, forward from one point and back from the next, are exact to first order, so near a
surface they meet right at it; without room for rounding, one ray in ten went through at a
tolerance of 1e-11 in double precision.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import shapes


def camera(width: int) -> tuple[np.ndarray, np.ndarray]:
    eye = np.array([2.2, -2.2, 1.6])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    pixel = (2 * (np.arange(width) + 0.5) / width - 1) * math.tan(math.radians(20))
    x, y = np.meshgrid(pixel, -pixel)
    d = forward + x[..., None] * right + y[..., None] * up
    return eye[None], (d / np.linalg.norm(d, axis=-1, keepdims=True)).reshape(-1, 3)


@pytest.mark.few(1)
@pytest.mark.parametrize("bound", ["slope", "caps"])
@pytest.mark.parametrize(
    ("precision", "tolerance"),
    [("double", 1e-8), ("double", 1e-11), ("double", 1e-14), ("single", 1e-5), ("single", 1e-7)],
)
def test_no_surface_slips_through(bound: str, precision: str, tolerance: float) -> None:
    field = hk.SolidAngle(shapes.wavy_polygon(64))
    o, d = camera(48)
    plain = hk.trace(field, o, d, overstep=1.0, tolerance=1e-5, precision="double")
    over = hk.trace(field, o, d, bound=bound, tolerance=tolerance, precision=precision)
    assert plain.hit.sum() > 500
    # Rays within the coarser tolerance of the border may go either way.
    assert (over.hit != plain.hit).sum() <= 2
    both = over.hit & plain.hit
    assert (over.status != hk.Status.OUT_OF_STEPS).all()
    assert np.quantile(np.abs(over.t - plain.t)[both], 0.99) < 2e-4
