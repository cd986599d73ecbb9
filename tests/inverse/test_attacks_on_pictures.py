"""Pictures with derivatives at their limits: nothing in sight, domains that move, colors of a
user's function."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float64, TensorXf64

import harnack as hk
from harnack.backend import choose_backend

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

CAMERA = hk.Camera(position=(2.2, -2.2, 1.6), target=(0, 0, 0), fov=40)
VIEW: dict[str, Any] = {"camera": CAMERA, "size": 16}
BALL = hk.Sphere(0.5)
# The part of the picture that this ball covers.
SHARE = np.pi / 4 * (np.tan(np.arcsin(0.5 / np.sqrt(12.24))) / np.tan(np.radians(20))) ** 2


def number(value: float) -> Float64:
    """A Dr.Jit number with a derivative."""
    result = Float64(value)
    dr.enable_grad(result)
    return result


def test_derivatives_of_what_is_not_seen_are_zero() -> None:
    """Of surfaces out of sight, and of masks that are full."""
    for show, r, center in (("mask", 0.5, 9.0), ("shaded", 0.5, 9.0), ("mask", 2.5, 0.0)):
        radius = number(r)
        image = hk.picture(hk.Sphere(radius, (0, 3 * center, center)), show=show, **VIEW)
        # A NaN from elsewhere does not reach the number.
        dr.backward(image * dr.nan)
        assert dr.grad(radius)[0] == 0


def test_domains_that_move_and_cut_the_surface_are_refused() -> None:
    for make in (hk.Gyroid, lambda r: hk.SphericalHarmonic(2, 0, radius=r)):
        with pytest.raises(NotImplementedError, match=r"the domain of this .* moves"):
            hk.picture(make(number(0.9)), level=0.1, **VIEW)
        # What a clip volume cuts off, the domain does not.
        image = hk.picture(make(number(0.9)), level=0.1, clip=hk.Ball(radius=0.5), **VIEW)
        assert dr.grad_enabled(image)


def test_colors_by_numbers_of_a_function() -> None:
    """Of a surface that moves, and of one that does not."""
    for field in (hk.Sphere(number(0.5)), BALL):
        slopes: list[float] = []
        for seed in range(3):
            c = number(0.3)
            colors = lambda hits, c=c: [c**2 + 0 * hits.t]  # noqa: E731
            image = hk.picture(field, camera=CAMERA, size=32, seed=seed, show=colors)
            assert isinstance(image, TensorXf64)
            dr.backward(dr.mean(image, axis=None))
            slopes.append(float(dr.grad(c)[0]))
        assert np.mean(slopes) == pytest.approx(0.6 * SHARE, rel=0.06)
    c = number(0.3)
    jump = lambda hits: dr.select(hits.position.x > c, 1.0, 0.0)  # noqa: E731
    with pytest.raises(NotImplementedError, match="no known kind of boundary"):
        hk.picture(BALL, show=jump, **VIEW)


def test_what_a_function_of_hits_may_return() -> None:
    for result, channels in ((1.0, 1), ([1.0, 0.5], 2), ((True,), 1)):
        assert hk.picture(BALL, show=lambda hits, r=result: r, **VIEW).shape == (16, 16, channels)
    image = hk.picture(BALL, show=lambda hits: TensorXf64(0.5) * Float64(hits.t), **VIEW)
    assert image.shape == (16, 16, 1)
    for wrong in (None, "red", lambda hits: hits.normal.numpy()):
        function = wrong if callable(wrong) else lambda hits, r=wrong: r
        with pytest.raises(TypeError, match=r"show returns a Dr\.Jit array or vector"):
            hk.picture(BALL, show=function, **VIEW)
    with pytest.raises(ValueError, match="no channels"):
        hk.picture(BALL, show=lambda hits: [], **VIEW)


@pytest.mark.slow
def test_outlines_that_end_at_edges() -> None:
    """Beside the edges, the sphere is nearly parallel to the rays."""
    slopes: list[float] = []
    for seed in range(5):
        r = number(0.65)
        solid = hk.Cuboid((1, 1, 1)) & hk.Sphere(r)
        image = hk.picture(solid, camera=CAMERA, size=48, show="mask", seed=seed)
        dr.backward(dr.mean(image, axis=None))
        slopes.append(float(dr.grad(r)[0]))
    assert np.mean(slopes) == pytest.approx(0.5582, rel=0.02)  # by differences of fine pictures
