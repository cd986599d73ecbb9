"""Solids put together, moved and bent: first hits against a dense oracle, and contracts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import FloatArray, choose_backend, to_numpy
from harnack.enclosures import LevelGaps, SlopeRange
from harnack.enclosures.extremum import MaximumEnclosure, MaximumOperand, NegatedEnclosure
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.testing import check_field
from tests.fields.test_shapes import CUP, LOOPS, SCREW, SHAPES, extruded, screw

Values = Callable[[FloatArray], FloatArray]


def sphere(p: FloatArray, radius: float = 1.0, center: Any = (0, 0, 0)) -> FloatArray:
    return np.linalg.norm(p - np.asarray(center), axis=-1) - radius


def torus(p: FloatArray, major: float, minor: float) -> FloatArray:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - major, p[..., 2]) - minor


def gyroid(p: FloatArray) -> FloatArray:
    x, y, z = np.moveaxis(2 * np.pi * p, -1, 0)
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


def untwisted(p: FloatArray, rate: float) -> FloatArray:
    x, y, z = np.moveaxis(p, -1, 0)
    c, s = np.cos(rate * z), np.sin(rate * z)
    return np.stack([x * c + y * s, y * c - x * s, z], axis=-1)


def untapered(p: FloatArray) -> FloatArray:
    scale = 0.6 + 0.6 * np.clip((p[..., 2] + 1) / 2, 0, 1)
    return np.stack([p[..., 0] / scale, p[..., 1] / scale, p[..., 2]], axis=-1)


def shrunk(p: FloatArray) -> FloatArray:
    return (p - [1, 2, 3]) / 0.7


def test_flush_blends_bulge_as_their_docstring_says_and_a_slab_cuts_that_off() -> None:
    plate, rib = hk.Cuboid((40.0, 40.0, 10.0)), hk.Cylinder(4.0, 10.0)
    blend = plate.blended(rib, 2.0)
    ends = np.array([[0.0, 0.0, 5.585], [0.0, 0.0, 5.587], [0.0, 0.0, 4.999]])
    inside = [blend, blend & hk.Cuboid((60.0, 60.0, 10.0))]
    assert [(value.value(ends, precision="double") <= 0).tolist() for value in inside] == [
        [True, False, True],
        [False, False, True],
    ]


def blended(a: FloatArray, b: FloatArray, radius: float, power: float) -> FloatArray:
    g, h = np.maximum(1 - a / radius, 0), np.maximum(1 - b / radius, 0)
    near = radius * (1 - (g**power + h**power) ** (1 / power))
    return near + np.maximum(np.minimum(a, b) - radius, 0)


TURN = np.array(hk.Sphere(1.0).rotated(40, (1, 2, 3)).map.matrix)  # type: ignore[attr-defined]
CURVE = np.stack(
    [f(np.arange(24) * np.pi / 12) for f in (np.cos, np.sin, lambda t: 0.3 * np.sin(2 * t))], axis=1
)
TILT = np.array(hk.Sphere(1.0).rotated(50, "x").map.matrix)  # type: ignore[attr-defined]
FRAME = [[[-0.9, -0.7], [0.9, -0.8], [0.7, 0.8], [-0.6, 0.9]], *LOOPS[1:]]
FACTORS = np.array([-1.0, 0.8, 1.4])
SPANNING = hk.SolidAngle(CURVE)


def near_spanning(p: FloatArray) -> FloatArray:
    offset = SPANNING.value(p.reshape(-1, 3), precision="double") - 2 * np.pi
    offset -= 4 * np.pi * np.round(offset / (4 * np.pi))
    return (np.abs(offset) - 0.4).reshape(p.shape[:-1])


CASES: dict[str, tuple[Callable[[], hk.solids.Solid], Values]] = {
    "difference": (
        lambda: hk.Sphere(1.0) - hk.Torus(0.8, 0.3),
        lambda p: np.maximum(sphere(p), -torus(p, 0.8, 0.3)),
    ),
    "union": (
        lambda: hk.Sphere(0.9) | hk.Torus(1.2, 0.2),
        lambda p: np.minimum(sphere(p, 0.9), torus(p, 1.2, 0.2)),
    ),
    "hollow": (
        lambda: hk.Sphere(1.0) & ~hk.Sphere(0.9) & hk.solids.Plane((0, 0, 1), 0.2),
        lambda p: np.maximum(np.maximum(sphere(p), -sphere(p, 0.9)), p[..., 2] - 0.2),
    ),
    "grown": (
        lambda: (hk.Sphere(0.7) | hk.Torus(1.0, 0.1)).offset(0.1),
        lambda p: np.minimum(sphere(p, 0.7), torus(p, 1.0, 0.1)) - 0.1,
    ),
    "affine": (
        lambda: hk.Sphere(1.0).scaled((1, 0.5, 1.5)).rotated(40,
        (1, 2, 3)).translated((0.2, 0.1, -0.3)),
        lambda p: sphere(((p - [0.2, 0.1, -0.3]) @ TURN) / [1, 0.5, 1.5]),
    ),
    "twisted": (
        lambda: (
            (hk.Sphere(1.0) - hk.Torus(0.8, 0.3).translated((0.3, 0, 0))).twisted(math.degrees(2.0))
        ),
        lambda p: np.maximum(
            sphere(untwisted(p, 2.0)), -torus(untwisted(p, 2.0) - [0.3, 0, 0], 0.8, 0.3)
        ),
    ),
    "tapered": (
        lambda: (hk.solid(hk.Gyroid(1.0), below=0.2) & hk.Sphere(1.1)).tapered((-1, 0.6), (1, 1.2)),
        lambda p: np.maximum(gyroid(untapered(p)) - 0.2, sphere(untapered(p), 1.1)),
    ),
    "gyroid in a torus": (
        lambda: hk.solid(hk.Gyroid(1.0), between=(-0.3, 0.3)) & hk.Torus(0.8, 0.4),
        lambda p: np.maximum(np.abs(gyroid(p)) - 0.3, torus(p, 0.8, 0.4)),
    ),
    "moved gyroid": (
        lambda: (hk.solid(hk.Gyroid(1.0), above=0.1) & hk.Sphere(1.0)).scaled(0.7).translated((1,
        2, 3)),
        lambda p: 0.7 * np.maximum(0.1 - gyroid(shrunk(p)), sphere(shrunk(p))),
    ),
    "twisted gyroid": (
        lambda: (
            (hk.solid(hk.Gyroid(1.0), below=0.2) & hk.Torus(0.8, 0.4)).twisted(math.degrees(1.0))
        ),
        lambda p: np.maximum(gyroid(untwisted(p, 1.0)) - 0.2, torus(untwisted(p, 1.0), 0.8, 0.4)),
    ),
    "blend": (
        lambda: hk.Sphere(1.0).blended(hk.Sphere(0.7).translated((1.2, 0, 0)), 0.4),
        lambda p: blended(sphere(p), sphere(p, 0.7, (1.2, 0, 0)), 0.4, 2.0),
    ),
    "blended gyroid": (
        lambda: (hk.solid(hk.Gyroid(1.0), below=0.2) & hk.Sphere(1.1)).blended(
            hk.Torus(1.2, 0.2), 0.2, power=3.0
        ),
        lambda p: blended(
            np.maximum(gyroid(p) - 0.2, sphere(p, 1.1)), torus(p, 1.2, 0.2), 0.2, 3.0
        ),
    ),
    "outlines cut, mirrored and scaled": (
        lambda: (
            (hk.Extrusion(FRAME, 0.6) - hk.Extrusion(LOOPS[1:2], 2.0).translated((0.5, 0.1, -1.0)))
            .transformed(np.diag([-1.0, 1.0, 1.0])).scaled((1.0, 0.8, 1.4))
            | hk.SolidOfRevolution(CUP).scaled(0.5).translated((0.0, 0.0, -0.4))
        ),
        lambda p: np.minimum(
            np.maximum(extruded(p / FACTORS, FRAME, 0.6),
                       -extruded(p / FACTORS - [0.5, 0.1, -1.0], LOOPS[1:2], 2.0)),
            0.5 * SHAPES["cup"][1](2 * (p - [0.0, 0.0, -0.4])),
        ),
    ),
    "outline blended and bent": (
        lambda: hk.Extrusion(FRAME, 0.6).twisted(math.degrees(1.0)).blended(hk.Sphere(0.4), 0.2),
        lambda p: blended(extruded(untwisted(p, 1.0), FRAME, 0.6), sphere(p, 0.4), 0.2, 2.0),
    ),
    "thread in a block": (
        lambda: hk.Cuboid((1.8, 1.8, 1.0)) - SCREW.rotated(50.0, "x"),
        lambda p: np.maximum(np.maximum(np.abs(p[..., 0]) - 0.9, np.maximum(
            np.abs(p[..., 1]) - 0.9, np.abs(p[..., 2]) - 0.5)), -screw(p @ TILT, SCREW)),
    ),
    "spanning surface and tube": (
        lambda: hk.solid(SPANNING, around=(2 * np.pi, 0.4)) | hk.Torus(1.0, 0.1),
        lambda p: np.minimum(near_spanning(p), torus(p, 1.0, 0.1)),
    ),
}  # fmt: skip
QUICK = ("difference", "twisted", "gyroid in a torus", "spanning surface and tube")
EVERY = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CASES]


def rays(count: int, seed: int, center: Any, size: float) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(count, 3))
    o *= 3 * size / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.normal(size=(count, 3)) * 0.5 * size - o
    return o + np.asarray(center), d / np.linalg.norm(d, axis=1, keepdims=True)


def missed(
    make: Callable[[], hk.solids.Solid], value: Values, precision: Any, count: int
) -> FloatArray:
    """By how much hits come after the first sample inside, in units of the samples' distance."""
    center = (1, 2, 3) if value is CASES["moved gyroid"][1] else (0, 0, 0)
    o, d = rays(count, 3, center, 1.3)
    t = np.linspace(0, 8, 3201)
    inside = np.stack([value(o + one * d) <= 0 for one in t], axis=1)
    first = np.where(inside.any(axis=1), t[inside.argmax(axis=1)], np.inf)
    hits = hk.trace(make(), o, d, t_max=8.0, precision=precision)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert np.isfinite(first).mean() > 0.1
    # What is hit lies on the surface, within the tolerance and the slope of f.
    on = hits.is_hit
    p, n = hits.position[on].astype(float), 1e-4 * hits.normal[on]
    slope = np.abs(value(p + n) - value(p - n)) / 2e-4
    assert (np.abs(value(p)) < 4e-4 * np.maximum(slope, 1)).all()
    assert on.sum() >= np.isfinite(first).sum()
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(first), hits.t - first, -np.inf)


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_no_hit_of_a_combination_is_missed(name: str) -> None:
    late = missed(*CASES[name], "single", 1000)
    assert late.max() <= 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_hit_of_a_combination_is_missed_in_double_precision(name: str) -> None:
    late = missed(*CASES[name], "double", 800)
    assert late.max() <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_combinations_keep_their_promises(name: str) -> None:
    check_field(CASES[name][0](), count=25, directions=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["difference", "affine", "twisted", "blend", "union"])
def test_sphere_tracing_finds_the_same_hits(name: str) -> None:
    o, d = rays(2000, 5, (0, 0, 0), 1.3)
    solid = CASES[name][0]()
    ours, theirs = (
        hk.trace(solid, o, d, t_max=8.0, tolerance=1e-4, enclosures=proof)
        for proof in (None, "lipschitz")
    )
    same = ours.is_hit == theirs.is_hit
    assert same.mean() > 0.998  # rays that graze within the tolerance stop anywhere
    both = ours.is_hit & theirs.is_hit
    assert np.quantile(np.abs(ours.t - theirs.t)[both], 0.98) < 1e-3
    assert ours.evaluations.mean() < 0.7 * theirs.evaluations.mean()


def test_the_greatest_falls_only_where_all_parts_have_fallen() -> None:
    """Two functions 1 - s and -1 + 3s: the greatest is 0 at s = 1/2 at the lowest."""
    real = choose_backend("double").Float
    down = ParabolaEnclosure(SlopeRange(real(-1), real(-1)), real(0), real(0), real(10))
    up = ParabolaEnclosure(SlopeRange(real(3), real(3)), real(0), real(0), real(10))
    parts = (MaximumOperand(real(0), real(0), (down,)), MaximumOperand(real(2), real(2), (up,)))

    def step(enclosure: Any, below: Any, above: Any) -> float:
        return float(
            to_numpy(enclosure.free_length(LevelGaps(real(below), real(above))) + real(0))[0]
        )

    greatest = MaximumEnclosure(parts)
    assert step(greatest, np.inf, 0.5) == pytest.approx(2.5 / 3, rel=1e-5)  # -1 + 3s = 1.5
    assert step(greatest, 0.25, np.inf) == pytest.approx(0.25, rel=1e-5)  # 1 - s = 0.75
    assert step(greatest, 0.25, 0.5) == pytest.approx(0.25, rel=1e-5)
    negative = NegatedEnclosure(greatest)
    assert step(negative, 0.5, np.inf) == pytest.approx(2.5 / 3, rel=1e-5)


def test_a_part_past_the_level_proves_nothing() -> None:
    """A part that lies below the level below already does not keep the greatest above it,
    whichever way it runs."""
    real = choose_backend("double").Float
    falling = ParabolaEnclosure(SlopeRange(real(-1), real(-1)), real(0), real(0), real(10))
    rising = ParabolaEnclosure(SlopeRange(real(-1), real(-1)), real(4), real(4), real(10))
    parts = (
        MaximumOperand(real(0), real(0), (falling,)),
        MaximumOperand(real(2), real(2), (rising,)),
    )
    step = MaximumEnclosure(parts).free_length(LevelGaps(real(1), real(np.inf)))
    assert float(to_numpy(step + real(0))[0]) <= 1.0


def test_operators_and_methods_read_like_the_drawing() -> None:
    model = (hk.Sphere(1.0) - hk.Torus(0.8, 0.2)).twisted(math.degrees(2.0))
    hits = hk.trace(model, [[3.0, 0.1, 0.2]], [[-1.0, 0.0, 0.0]])
    assert hits.is_hit.all()
    assert (~(~model)).sublevel_extent() == model.sublevel_extent()
    flat = hk.union(hk.Sphere(1.0), hk.Sphere(0.5) | hk.Torus(1.0, 0.1))
    assert len(flat.parts) == 3  # type: ignore[attr-defined]


def test_a_solid_of_revolution_can_be_bent_and_blended() -> None:
    ring = hk.SolidOfRevolution([(0.5, -0.5), (1.0, -0.5), (1.0, 0.5), (0.5, 0.5)])
    points = [[0.75, 0.0, 0.1], [2.0, 0.0, 0.0]]
    for solid in (ring.twisted(20.0), ring.blended(hk.Sphere(0.2), 0.1)):
        np.testing.assert_allclose(solid.value(points), [-0.25, 1.0], atol=1e-5)
    # The factor is 1.3 at z = 0.1 and 1.25 at z = 0.
    tapered = ring.tapered((-0.5, 1.0), (0.5, 1.5)).value(points)
    np.testing.assert_allclose(tapered, [0.5 - 0.75 / 1.3, 0.6], atol=1e-5)
    hits = hk.trace(ring.twisted(20.0), [[3.0, 0.0, 0.1]], [[-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(hits.t, 2.0, atol=1e-3)


@pytest.mark.slow
def test_lower_bounds_of_distances_hold_for_parts_of_any_kind() -> None:
    """Harmonic fields promise no Lipschitz constant; one follows from their balls."""
    walls = hk.solid(hk.SphericalHarmonic(3, 1), between=(-0.2, 0.2))
    for model in (walls & hk.Sphere(0.9), hk.Capsule((0, 0, -1), (0, 0, 1), 0.3) - walls):
        points = np.random.default_rng(3).uniform(-0.6, 0.6, (40, 3))
        lower = hk.signed_distance(model, points, method="lower_bound")
        near = np.abs(hk.signed_distance(model, points))
        assert (np.abs(lower) <= near * (1 + 1e-6) + 1e-9)[np.isfinite(near)].all()
        assert (np.abs(lower) > 0).mean() > 0.9


def test_a_union_reaches_as_far_as_its_parts() -> None:
    far = hk.Sphere(1.0) | hk.Sphere(1.0).translated((5, 0, 0))
    hull = far.sublevel_extent()
    assert hull is not None
    low, high = hull.bounds()
    assert low[0] <= -1
    assert high[0] >= 6
    assert (far - hk.Sphere(9.0)).sublevel_extent() is not None
    assert (far | hk.solids.Plane()).sublevel_extent() is None
    assert (~far).sublevel_extent() is None
    inside = hk.solid(hk.Blobs([[0, 0, 0]], [1.0]), above=0.5).sublevel_extent()
    assert inside is None or np.isfinite(inside.bounds()).all()


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: hk.Sphere(1.0) | 3, TypeError, "only solids, such as"),
        (lambda: hk.Gyroid(1.0) | hk.Sphere(1.0), TypeError, "Gyroid is a field and no solid"),
        (lambda: hk.Sphere(1.0) - hk.Gyroid(1.0), TypeError, r"make one of it by harnack.solid\("),
        (lambda: hk.Gyroid(1.0).twisted(60.0), AttributeError, "make a solid of the field first"),
        (lambda: hk.expression(lambda x, y, z: x ^ 2), TypeError, r"powers as x\*\*2"),
        (lambda: hk.union(), ValueError, "at least one solid"),
        (lambda: hk.union(hk.Gyroid(1.0)), TypeError, "is a field and no solid"),
        (lambda: hk.Sphere(1.0).scaled(0), ValueError, "factors must be positive"),
        (lambda: hk.Sphere(1.0).scaled((1, 2)), ValueError, "factors must be positive"),
        (lambda: hk.Sphere(1.0).rotated(10, "w"), ValueError, 'axis must be "x", "y" or "z"'),
        (lambda: hk.Sphere(1.0).rotated(10, (0, 0, 0)), ValueError, "axis must be a vector"),
        (lambda: hk.Sphere(1.0).translated((1, 2)), ValueError, r"offset \(3,\)"),
        (lambda: hk.Sphere(1.0).transformed(np.ones((3, 3))), ValueError, "singular"),
        (lambda: hk.Sphere(1.0).transformed(np.eye(2)), ValueError, r"matrix \(3, 3\)"),
        (lambda: hk.Sphere(1.0).twisted(np.nan), ValueError, "rate must be finite"),
        (lambda: hk.Sphere(1.0).tapered((1, 1), (0, 1)), ValueError, "start must lie before end"),
        (lambda: hk.Sphere(1.0).tapered((0, 1), (1, -1)), ValueError, "scales must be positive"),
        (lambda: hk.Sphere(1.0).offset(np.inf), ValueError, "distance must be finite"),
        (lambda: hk.Sphere(1.0).blended(hk.Torus(1, 0.1), 0), ValueError, "radius must be"),
        (lambda: hk.Sphere(1.0).blended(hk.Torus(1, 0.1), 1, power=0.5), ValueError, "power must"),
        (lambda: hk.solid(SPANNING, below=1.0), ValueError, "is angle-valued"),
        (lambda: hk.solid(hk.Gyroid(1.0)), ValueError, "exactly one of"),
        (lambda: hk.solid(hk.Gyroid(1.0), between=(1, 0)), ValueError, "low < high"),
        (lambda: hk.solid(hk.Gyroid(1.0), below=np.nan), ValueError, "finite numbers"),
        (lambda: hk.solid(SPANNING, around=(0, 7)), ValueError, "half of the period"),
        (
            lambda: hk.solid(SPANNING, around=(0, 1)).twisted(math.degrees(1.0)), TypeError,
            "cannot be blended, twisted or tapered",
        ),
    ],
)  # fmt: skip
def test_mistakes_are_refused(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


def reach(solid: hk.Field, axis: int) -> float:
    """How far a solid about the origin goes along an axis."""
    o = 20.0 * np.eye(3)[axis]
    return float(20.0 - hk.trace(solid, [o], [-o], precision="double", tolerance=1e-7).t[0])


@pytest.mark.slow
def test_f_is_measured_in_the_units_of_each_map_in_turn() -> None:
    """A map that makes all lengths grow alike multiplies f; in a row, the others hid that."""
    ball = hk.Sphere(1)
    stretched = ball.scaled((1, 1, 2)).scaled(2).offset(0.5)  # |x/2| - 1 <= 0.25
    assert reach(stretched, 0) == pytest.approx(2.5, abs=1e-5)
    assert reach(stretched, 2) == pytest.approx(5.0, abs=1e-5)
    other = ball.scaled(2).rotated(90, "x").scaled((1, 1, 2)).offset(0.5)
    assert reach(other, 0) == pytest.approx(2.5, abs=1e-5)
    # Neither of two maps makes all lengths grow alike, though both together do.
    both = ball.scaled((1, 1, 2)).scaled((2, 2, 1)).offset(0.5)
    assert reach(both, 0) == pytest.approx(3.0, abs=1e-5)
    for solid, value in ((stretched, 0.5), (other, 0.5), (both, 0.5)):
        _, high = solid.extent((0.0,)).bounds()  # type: ignore[union-attr]
        assert high[0] >= reach(solid, 0) - 1e-5
        assert high[2] >= reach(solid, 2) - 1e-5
        assert solid.value([[0.0, 0.0, 0.0]])[0] < -value
    assert reach(ball.offset(0.5).scaled(2), 0) == pytest.approx(3.0, abs=1e-5)


def test_second_derivatives_of_walls() -> None:
    """They raised a TypeError, of an option that was right."""
    walls = hk.solid(hk.Gyroid(0.5), between=(-0.4, 0.4))
    x, h = np.array([[0.11, 0.07, -0.03], [-0.2, 0.1, 0.05]]), 1e-4
    for solid in (walls, walls.translated((0.1, 0.2, 0.3)), walls & hk.Sphere(2)):
        exact = solid.hessian(x, precision="double")
        for k in range(3):
            step = h * np.eye(3)[k]
            ahead, behind = (solid.gradient(x + s * step, precision="double") for s in (1, -1))
            np.testing.assert_allclose(
                exact[:, k], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-3
            )
    with pytest.raises(NotImplementedError, match="Tube gives no second derivatives"):
        hk.Tube([[0, 0, 0], [1, 0, 0]], 0.1).hessian(x, precision="double")


def test_numbers_of_numpy_are_numbers() -> None:
    wave = hk.fields.PlaneWave(np.float64(1.0), tuple(np.array([1.0, 2.0, 3.0])))  # type: ignore[arg-type]
    same = hk.fields.EigenfunctionSum([hk.fields.PlaneWave(1.0, (1.0, 2.0, 3.0))])
    x = [[0.1, 0.2, 0.3]]
    assert hk.fields.EigenfunctionSum([wave]).value(x) == same.value(x)
    tapered = hk.Sphere(1).tapered((np.float64(0), np.int64(1)), (np.int64(2), np.float32(0.5)))
    assert tapered.value(x) == hk.Sphere(1).tapered((0, 1), (2, 0.5)).value(x)
    ball = hk.Sphere(1)
    blend = ball.blended(ball.translated((1, 0, 0)), np.float32(0.5), power=np.int64(2))
    assert blend.value(x) == ball.blended(ball.translated((1, 0, 0)), 0.5).value(x)
    noise = hk.solids.FractalNoise(octaves=np.int64(2), seed=np.int32(1))  # type: ignore[arg-type]
    assert noise.value(x) == hk.solids.FractalNoise(octaves=2, seed=1).value(x)
    assert hk.solids.Julia(iterations=np.int64(5)).iterations == 5  # type: ignore[arg-type]
    ray = [[3, 0, 0]], [[-1, 0, 0]]
    for factor in (np.float32(1.25), np.float64(1.25), np.int64(1)):
        hits = hk.trace(ball, *ray, over_relaxation=factor)  # type: ignore[arg-type]
        assert hits.t == hk.trace(ball, *ray, over_relaxation=float(factor)).t
    with pytest.raises(ValueError, match="finite numbers"):
        hk.Sphere(1).tapered(("a", 1), (2, 0.5))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_ray_through_a_crease_is_a_hit_where_its_gradients_say_how_near_the_surface_is() -> None:
    """A path of the gallery's `carved` was out of steps: in a crease, where the gradient is a range
    as long as its middle, rounding was larger than what was left of the gap."""
    carved = (hk.Sphere(1.0) - hk.Torus(0.85, 0.28)).twisted(math.degrees(1.5), "x")
    carved = carved.blended(hk.Torus(1.15, 0.12), 0.15)
    foot = np.array([0.34748355, -0.65605646, -0.66996707])
    rng = np.random.default_rng(0)
    d = np.array([0.0982, 0.9464, 0.3076]) + 0.02 * rng.normal(size=(5000, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    o = foot + 3e-6 * rng.normal(size=(5000, 3)) - 2.148 * d
    found = hk.trace(carved, o, d, tolerance=2e-4)
    assert found.is_hit.all()


def test_the_radius_of_a_blend_is_a_number_of_the_kernel_only() -> None:
    """A blend of a small radius counted as steep: another kernel, with more samples."""
    backend = choose_backend("single")
    for radius in (0.5, 0.05):
        blend = hk.Sphere(0.5).blended(hk.Cuboid((1.0, 0.2, 0.2)), radius)
        assert not blend.evaluator(backend).is_steep


def test_what_is_no_solid_is_told_how_to_become_one() -> None:
    with pytest.raises(TypeError, match="offset"):
        hk.Sphere(1.0) - 0.1  # type: ignore[operator]
    with pytest.raises(TypeError, match=r"struts\(radius\)"):
        hk.Sphere(1.0) & hk.lattice.cubic(1.0, 2)  # type: ignore[operator]
    with pytest.raises(TypeError, match=r"domain=Ball"):
        hk.expression("x + y", clip=hk.Ball())
