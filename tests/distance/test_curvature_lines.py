"""Lines of curvature: known ones, and where they end."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk

TORUS = hk.Torus(1.0, 0.4)
SEEDS = np.array([[1.45, 0, 0], [1, 0, 0.4], [0, 1.2, 0.3]])


def azimuth(line: np.ndarray) -> np.ndarray:
    return np.unwrap(np.arctan2(line[:, 1], line[:, 0]))


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
def test_lines_of_a_torus_are_its_circles(precision: Any) -> None:
    small = 1e-4 if precision == "single" else 1e-9
    settings: dict[str, Any] = {"step": 0.05, "length": 1.5, "precision": precision}
    around = hk.distance.curvature_lines(TORUS, SEEDS, family="maximum", **settings)
    along = hk.distance.curvature_lines(TORUS, SEEDS, family="minimum", **settings)
    for one, other in zip(around, along, strict=True):
        assert len(one) == len(other) == 61
        assert np.abs(TORUS.value(one, precision="double")).max() < small
        assert np.ptp(azimuth(one)) < small  # meridians, of curvature 1/0.4
        assert np.ptp(one[:, 2]) > 0.6
        assert np.ptp(other[:, 2]) < small  # parallels
        assert np.ptp(azimuth(other)) > 2.0
        # Steps of the arc's length, to their own curvature.
        steps = np.linalg.norm(np.diff(one, axis=0), axis=1)
        np.testing.assert_allclose(steps, 0.05, rtol=2e-3)


@pytest.mark.slow
def test_the_error_falls_with_the_fourth_power_of_the_step() -> None:
    """On an ellipsoid: the ends of lines, against steps eight times as short."""
    body, seed = hk.Ellipsoid((1.0, 0.7, 0.45)), [[0.6, 0.45, 0.2]]

    def end(step: float) -> np.ndarray:
        (line,) = hk.distance.curvature_lines(body, seed, step=step, length=0.64)
        return line[-1]

    exact = end(0.005)
    coarse, fine = (np.linalg.norm(end(step) - exact) for step in (0.08, 0.04))
    print(coarse, fine)
    assert coarse < 2e-3
    assert fine < coarse / 10


@pytest.mark.slow
def test_lines_end_at_umbilics_at_curves_and_at_the_clip_volume() -> None:
    # On a sphere every point is an umbilic: no direction is known, and there is no line.
    lines = hk.distance.curvature_lines(hk.Sphere(), SEEDS, step=0.1, length=1.0)
    assert [len(line) for line in lines] == [0, 0, 0]
    # The surface of a circle at the level 1.2 is a surface of revolution: meridians end at the
    # circle, near which the surface is ever more bent, or at the axis, where there is an umbilic.
    field = hk.SolidAngle(hk.geometry.Circle(1.0))
    seeds = np.array([[0.5, 0.0, -1.0], [0.9, 0.1, -0.5]])
    families: tuple[Any, ...] = ("maximum", "minimum")
    lines = [
        hk.distance.curvature_lines(field, seeds, level=1.2, step=0.02, length=4.0, family=one)
        for one in families
    ]
    both = [line for family in lines for line in family]
    parallels = [line for line in both if np.ptp(line[:, 2]) < 1e-6]
    meridians = [line for line in both if np.ptp(azimuth(line)) < 1e-6]
    assert len(parallels) == len(meridians) == 2
    for line in meridians:
        assert len(line) < 200
        assert np.hypot(line[:, 0], line[:, 1]).max() < 2.0
    (cut,) = hk.distance.curvature_lines(
        TORUS, SEEDS[:1], step=0.05, length=9.0, family="minimum",
        clip=hk.HalfSpace((-1.0, 0, 0), -0.5),
    )  # fmt: skip
    assert 0.5 <= cut[:, 0].min() < 0.55
    (empty,) = hk.distance.curvature_lines(
        TORUS, SEEDS[:1], step=0.05, length=1.0, clip=hk.HalfSpace((1.0, 0, 0), 0.0)
    )
    assert empty.shape == (0, 3)


def test_the_rim_of_a_constant_angle_is_a_line_of_curvature() -> None:
    """Joachimsthal: a surface that meets a plane at one angle has a line of curvature there. So,
    beside a circle, one family runs along it."""
    ring = [hk.geometry.Circle(1.0), hk.geometry.Circle(0.4, (0.2, 0, 0), (0, 0, -1))]
    field, level, near = hk.SolidAngle(ring), -2 * math.pi + 1.2, 0.01
    radius = 1 - near * math.cos(0.6)
    seed = [[0.0, radius, near * math.sin(0.6)]]
    lines = [
        hk.distance.curvature_lines(
            field, seed, level=level, step=0.002, length=0.3, family=family
        )[0]
        for family in ("maximum", "minimum")
    ]
    spread = sorted(float(np.ptp(np.hypot(line[:, 0], line[:, 1]))) for line in lines)
    assert spread[0] < 0.2 * near < 0.2 < spread[1]


def test_what_is_no_line() -> None:
    assert hk.distance.curvature_lines(TORUS, np.zeros((0, 3)), step=0.1, length=1.0) == []
    for wrong in ({"step": 0.0}, {"length": math.inf}, {"step": -1.0}, {"step": 1e-9}):
        settings: dict[str, Any] = {"step": 0.1, "length": 1.0, **wrong}
        with pytest.raises(ValueError, match=r"must be positive|at most"):
            hk.distance.curvature_lines(TORUS, SEEDS, **settings)
    with pytest.raises(ValueError, match='did you mean "maximum"'):
        hk.distance.curvature_lines(TORUS, SEEDS, step=0.1, length=1.0, family="maximu")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seeds"):
        hk.distance.curvature_lines(TORUS, [[0.0, math.nan, 1.0]], step=0.1, length=1.0)
