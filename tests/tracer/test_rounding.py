"""Over-relaxation in rounded arithmetic: no surface may slip through between two looks.

Both looks, forward from one point and back from the next, are exact to first order, so near a
surface they meet right at it; without room for rounding, one ray in ten went through at a
tolerance of 1e-11 in double precision.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves


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
@pytest.mark.parametrize("enclosures", ["slope", "caps"])
@pytest.mark.parametrize(
    ("precision", "tolerance"),
    [("double", 1e-8), ("double", 1e-11), ("double", 1e-14), ("single", 1e-5), ("single", 1e-7)],
)
def test_no_surface_slips_through(enclosures: str, precision: str, tolerance: float) -> None:
    field = hk.SolidAngle(example_curves.wavy_polygon(64))
    o, d = camera(48)
    plain = hk.trace(field, o, d, over_relaxation=1.0, tolerance=1e-5, precision="double")
    over = hk.trace(field, o, d, enclosures=enclosures, tolerance=tolerance, precision=precision)
    assert plain.is_hit.sum() > 500
    # Rays within the coarser tolerance of the border may go either way.
    assert (over.is_hit != plain.is_hit).sum() <= 2
    both = over.is_hit & plain.is_hit
    assert (over.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert np.quantile(np.abs(over.t - plain.t)[both], 0.99) < 2e-4


ALONG = math.pi / 2 / math.sqrt(3)
# Formulas that jump across a plane, its normal and its distance from the origin.
JUMPS = {
    "atan2": (lambda x, y, z: hk.math.atan2(x - y, -2.0 - x * x) + 0.1 * z, (1, -1, 0), 0.0),
    "atan2 of y": ("atan2(y, x - 9)", (0, 1, 0), 0.0),
    "sign": ("(x + y - 0.2) / abs(x + y - 0.2) + 2 + 0.1*z", (1, 1, 0), 0.1 * math.sqrt(2)),
    "arc of pole": ("atan(1 / (x + 2*y + z)) + 0.01*x", (1, 2, 1), 0.0),
    "inverse power": (lambda x, y, z: hk.math.tanh((x - y + 0.1 * z) ** -3.0), (1, -1, 0.1), 0.0),
    "tangent": (lambda x, y, z: hk.math.atan(hk.math.tan(x + y + z)), (1, 1, 1), ALONG),
    "logarithm": (
        lambda x, y, z: hk.math.atan(hk.math.log(abs(x - y)) * (x - y) / abs(x - y)) + 1,
        (1, -1, 0), 0.0,
    ),
}  # fmt: skip


def through(plane: tuple[float, float, float], offset: float) -> tuple[np.ndarray, ...]:
    """Rays to points of a plane, and their lengths: they arrive there up to rounding."""
    rng, normal = np.random.default_rng(5), np.array(plane) / np.linalg.norm(plane)
    x = rng.uniform(-1, 1, (400, 3))
    x -= ((x @ normal) - offset)[:, None] * normal
    d = rng.normal(size=x.shape)
    d /= np.linalg.norm(d, axis=1)[:, None]
    t = 10 ** rng.uniform(-1, 0, len(x))
    return x - t[:, None] * d, d, t


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", list(JUMPS))
def test_no_ray_passes_a_jump(name: str, precision: str) -> None:
    """Half of these rays were called misses behind the cut of atan2: its steps shrank to the
    rounding of t, which led across."""
    formula, plane, offset = JUMPS[name]
    o, d, t = through(plane, offset)
    solid = hk.solid(hk.expression(formula), below=0)
    hits = hk.trace(solid, o, d, t_max=t + 0.2, precision=precision, max_steps=150)
    assert (hits.status != hk.RayStatus.MISS).all()
    assert (hits.t <= t + 1e-5).all()


RANGES = (
    "quadratic-taylor", "linear-taylor", "segment", "bottom-up-linear", "bottom-up-quadratic",
    "mixed", "affine", "interval",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*RANGES, "union", "moved", "require_crossing"])
def test_no_ray_passes_a_jump_by_any_proof(kind: str) -> None:
    o, d, t = through((1, -1, 0), 0.0)
    surface = hk.expression(JUMPS["atan2"][0])
    settings = {}
    if kind == "union":
        surface = hk.solid(surface, below=0) | hk.Sphere(0.1).translated((50, 0, 0))
    elif kind == "moved":
        surface, o = hk.solid(surface, below=0).translated((0.3, 0.1, 0)), np.add(o, (0.3, 0.1, 0))
    else:
        settings = {kind: True} if kind == "require_crossing" else {"enclosures": kind}
    for precision in ("single", "double"):
        hits = hk.trace(
            surface, o, d, t_max=t + 0.2, precision=precision, max_steps=150, **settings
        )
        assert (hits.status == hk.RayStatus.OUT_OF_STEPS).all()
        assert (hits.t <= t + 1e-5).all()


def test_height_fields_stop_at_jumps() -> None:
    o, d, t = through((1, -1, 0), 0.0)
    domain = hk.geometry.Box((-5, -5, -20), (5, 5, 20))
    field = hk.fields.HeightField(lambda x, y: 10 * hk.math.atan(1 / (x - y)), domain=domain)
    hits = hk.trace(field, o, d, t_max=t + 0.2, precision="single", max_steps=150)
    assert (hits.status != hk.RayStatus.MISS).all()
