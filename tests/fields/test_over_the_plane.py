"""Height fields, and level curves of harmonic functions of the plane."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.testing import check_field

WAVES = hk.fields.HeightField(lambda x, y: 0.3 * hk.math.sin(3 * x) * hk.math.cos(3 * y))
THREE = {1: 1, -1: 1, 1j: -1}
CURVES = {
    "charges": hk.fields.LevelCurves("log", argument=THREE),
    "angles": hk.fields.LevelCurves("log", "imag", argument=THREE, level=1.0),
    "cubic": hk.fields.LevelCurves({0: 1, 1: 1, 1j: 1}, level=0.2),
    "pole": hk.fields.LevelCurves({0.3: -2}, "imag", level=0.5),
}


def function(name: str, z: np.ndarray) -> np.ndarray:
    """What the curves are levels of, less the level; of angles the sine of half of it."""
    if name == "charges":
        return sum(n * np.log(abs(z - a)) for a, n in THREE.items())
    if name == "angles":
        return np.sin(sum(n * np.angle(z - a) for a, n in THREE.items()) - 1.0)
    if name == "cubic":
        return (z * (z - 1) * (z - 1j)).real - 0.2
    return ((z - 0.3) ** -2.0).imag - 0.5


def rays(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    o, target = rng.uniform(-3, 3, (n, 3)), rng.uniform(-1.5, 1.5, (n, 3)) * [1, 1, 0.1]
    o[: n // 2, 2] = target[: n // 2, 2]  # half of them in a horizontal plane
    d = target - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CURVES)
def test_promises_hold(name: str) -> None:
    check_field(CURVES[name], rng=1)


@pytest.mark.slow
def test_promises_of_a_height_field_hold() -> None:
    check_field(WAVES)


def check_curves(name: str, n: int, precision: Any, enclosures: Any, samples: int) -> None:
    field = CURVES[name]
    o, d = rays(n)
    hits = hk.trace(field, o, d, precision=precision, enclosures=enclosures)
    hit = hits.status == hk.RayStatus.HIT
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert hit.sum() > 0.2 * n
    share = np.linspace(0, 1, samples)
    end = np.where(hit, hits.t - 3e-4, 8.0)
    t = np.maximum(end, 0)[:, None] * share
    p = o[:, None] + t[..., None] * d[:, None]
    inside = field.domain.contains_points(p.reshape(-1, 3)).reshape(t.shape)
    value = function(name, p[..., 0] + 1j * p[..., 1])
    # A sine passes zero at half turns too, and the cut of angles is none of it.
    passed = (value[:, 1:] * value[:, :-1] < 0) & inside[:, 1:] & inside[:, :-1]
    if name == "angles":
        turn = np.cos(
            sum(n * np.angle(p[..., 0] + 1j * p[..., 1] - a) for a, n in THREE.items()) - 1
        )
        passed &= (turn[:, 1:] > 0.5) & (turn[:, :-1] > 0.5)
    smooth = np.abs(np.diff(value, axis=1)) < 0.5
    assert not (passed & smooth).any()


@pytest.mark.few(3)
@pytest.mark.parametrize("enclosures", [None, "slope"])
@pytest.mark.parametrize("name", CURVES)
def test_no_curve_is_passed(name: str, enclosures: Any) -> None:
    check_curves(name, 200, "single", enclosures, 1500)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", CURVES)
def test_no_curve_is_passed_by_thousands_of_rays(name: str, precision: str) -> None:
    check_curves(name, 2000, precision, None, 1500)


def check_heights(n: int, precision: Any) -> None:
    """Against z - u, sampled densely."""
    rng = np.random.default_rng(3)
    o = rng.uniform(-1, 1, (n, 3)) * [2, 2, 1] + [0, 0, 1.5]
    target = rng.uniform(-1, 1, (n, 3)) * [1, 1, 0.3]
    d = (target - o) / np.linalg.norm(target - o, axis=1, keepdims=True)
    hits = hk.trace(WAVES, o, d, precision=precision)
    hit = hits.status == hk.RayStatus.HIT
    assert hit.sum() > 0.5 * n
    end = np.where(hit, hits.t - 3e-4, 6.0)
    p = o[:, None] + (end[:, None] * np.linspace(0, 1, 1500))[..., None] * d[:, None]
    f = p[..., 2] - 0.3 * np.sin(3 * p[..., 0]) * np.cos(3 * p[..., 1])
    inside = (np.abs(p) <= 1 - 1e-9).all(axis=2)
    assert not ((f[:, 1:] * f[:, :-1] < 0) & inside[:, 1:] & inside[:, :-1]).any()


def test_no_height_is_passed() -> None:
    check_heights(300, "single")


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
def test_no_height_is_passed_by_thousands_of_rays(precision: str) -> None:
    check_heights(5000, precision)


def test_height_fields_are_clipped_to_their_heights() -> None:
    volume = WAVES.extent((0.0,))
    assert volume is not None
    lower, upper = volume.bounds()
    assert upper[2] == pytest.approx(0.3, abs=0.01)
    assert lower[2] == pytest.approx(-0.3, abs=0.01)
    above = hk.trace(WAVES, [[-3, 0, 0.5]], [[1, 0, 0]])
    assert above.evaluations[0] == 0
    assert WAVES.extent((9.0,)) is WAVES.domain


def test_harnack_in_the_plane_takes_few_steps() -> None:
    """The lemniscate |z^2 - 1| = 1 from a horizontal ray: it meets the axis at sqrt 2."""
    field = hk.fields.LevelCurves("log", argument={1: 1, -1: 1})
    hits = hk.trace(field, [[3.0, 0, 0]], [[-1, 0, 0]], enclosures="slope")
    assert hits.t[0] == pytest.approx(3 - math.sqrt(2), abs=1e-3)
    assert hits.evaluations[0] < 20


def test_errors_say_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="one branch"):
        hk.fields.LevelCurves("sqrt")
    with pytest.raises(ValueError, match="part must be"):
        hk.fields.LevelCurves("log", "both")
    with pytest.raises(TypeError, match="callable"):
        hk.fields.HeightField(3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="bounded domain"):
        hk.fields.HeightField(lambda x, y: x + y, domain=hk.HalfSpace((0, 0, 1), 0.0))
    with pytest.raises(TypeError, match="functions of plain"):
        hk.fields.HeightField(lambda x, y: math.sin(x))


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "field", [hk.fields.LevelCurves("log", "imag"), hk.fields.RiemannSurface("log")]
)
def test_walls_of_entire_fields_go_beyond_where_they_are_drawn(field: hk.Field) -> None:
    """Angle-valued ones were cut to it: values said inside where rays missed."""
    walls = hk.solid(field, around=(0, 0.3))
    assert walls.domain is None
    o, d, s = np.array([5.0, 5.0, 0.1]), np.array([0.0, -1.0, 0.0]), np.linspace(0, 5, 5001)
    inside = walls.value(o + s[:, None] * d, precision="double") < 0
    first = s[np.argmax(inside)]
    assert inside.any()
    assert first > 2
    for solid in (walls, walls & hk.Cuboid((16, 16, 16))):
        hits = hk.trace(solid, [o], [d], tolerance=1e-4)
        assert hits.t[0] == pytest.approx(first, abs=2e-3)
