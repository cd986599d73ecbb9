"""Grid shells of the gallery: beams lie on the shell, and pictures are whole."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from harnack.gallery import SCENES
from harnack.gallery.shells import _crossing_cosine
from harnack.geometry import HalfSpace

SHELLS = ("shell-ring", "shell-court", "shell-columns")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.slow) if k else one for k, one in
             enumerate(SHELLS)],
)  # fmt: skip
def test_beams_lie_on_the_shell(name: str) -> None:
    shell, beams = SCENES[name].surfaces()
    field, tube = shell.field, beams.field
    assert isinstance(field, hk.SolidAngle)
    assert isinstance(tube, hk.Tube)
    assert field.describe()["lift_bound"] == "planar"
    assert len(tube.starts) > 25
    points = tube.points[tube.points[:, 2] > 0.02]
    assert len(points) > 200
    value = field.value(points, precision="double") - shell.levels[0]
    away = np.abs(np.remainder(value + 2 * np.pi, 4 * np.pi) - 2 * np.pi)
    slope = np.linalg.norm(field.gradient(points, precision="double"), axis=1)
    assert (away / slope).max() < 1e-3
    assert HalfSpace((0, 0, -1), 1e-6).contains_points(tube.points).all()
    rng = np.random.default_rng(0)
    o = np.array([3.0, -2.5, 2.5]) + 0 * points[:300]
    hits = hk.trace(shell, o, rng.permutation(points)[:300] - o)
    assert hits.is_hit.mean() > 0.95
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()


def test_the_angle_to_a_line_of_two_points_is_never_chosen() -> None:
    """It was NaN: such a line has no tangent at a point between two others."""
    line = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    across = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    assert _crossing_cosine(line, across) == 0.0
    assert _crossing_cosine(line, across[:2]) == 2.0
    assert _crossing_cosine(line[:2], across) == 2.0
