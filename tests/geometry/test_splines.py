"""Smooth curves through points: what they pass through, how smooth they are, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harnack.geometry import CurveError, smooth_curve
from harnack.geometry.example_curves import regular_polygon

TURN = 2 * np.pi * np.arange(10) / 10
POINTS = np.column_stack([np.cos(TURN), 1.4 * np.sin(TURN), np.cos(3 * TURN)])
POINTS += np.random.default_rng(3).uniform(-0.2, 0.2, POINTS.shape)


@pytest.mark.parametrize("spacing", ["centripetal", "chord"])
@pytest.mark.parametrize("closed", [True, False])
def test_smooth_curves_pass_through_their_points(closed: bool, spacing: Any) -> None:
    curve = smooth_curve(POINTS, 7, closed=closed, spacing=spacing)
    assert len(curve) == (70 if closed else 64)
    assert (curve[::7] == POINTS).all()
    fine = smooth_curve(POINTS, 700, closed=closed, spacing=spacing)
    np.testing.assert_allclose(fine[::100], curve, atol=1e-12)
    step = np.diff(np.concatenate([fine, fine[:2]]) if closed else fine, axis=0)
    way = step / np.linalg.norm(step, axis=1)[:, None]
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.05  # no corner


def test_a_smooth_curve_turns_evenly_where_pieces_meet() -> None:
    """Curvature is continuous, at the closing point too; that of a circle is nearly met."""
    curve = smooth_curve(POINTS, 500)
    a = np.diff(np.concatenate([curve, curve[:1]]), axis=0)
    b = np.roll(a, -1, axis=0)
    lengths = [np.linalg.norm(one, axis=1) for one in (a, b, a + b)]
    bent = 2 * np.linalg.norm(np.cross(a, b), axis=1) / np.prod(lengths, axis=0)
    assert np.abs(np.diff(np.append(bent, bent[0]))).max() < 0.02 * bent.max()
    circle = smooth_curve(regular_polygon(10), 20)
    assert np.abs(np.linalg.norm(circle, axis=1) - 1).max() < 1e-3


def test_smooth_curves_move_grow_and_come_in_lists() -> None:
    assert [len(one) for one in smooth_curve([POINTS, POINTS[:4]], 5)] == [50, 20]
    assert len(smooth_curve(np.stack([POINTS, POINTS + 5]), 5)) == 2
    curve = smooth_curve(POINTS)
    for size in (1e-80, 1e90):
        np.testing.assert_allclose(smooth_curve(POINTS * size) / size, curve, atol=1e-12)
    np.testing.assert_allclose(smooth_curve(POINTS + 1e6) - 1e6, curve, atol=1e-8)
    again = smooth_curve(np.concatenate([POINTS, POINTS[:1]]))
    assert (again == curve).all()


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize(
    ("points", "message"),
    [
        (POINTS[:2], "has 2 different vertices"),
        (POINTS[[0, 1, 1, 2]], "vertices 1 and 2 .* remove one"),
        (np.concatenate([POINTS, [[0, np.nan, 0]]]), "vertex 10 .* must be finite"),
        (POINTS[:, :2], "a column of zeros"),
        ([[3.0, 0, 0], [0, 0, 0], [1e-80, 0, 0], [1, 1, 1]], "points 1 and 2 are nearer"),
        ([], "no loops"),
    ],
)
def test_points_that_make_no_smooth_curve_are_refused(
    closed: bool, points: Any, message: str
) -> None:
    with pytest.raises(CurveError, match=message):
        smooth_curve(points, closed=closed)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"samples_per_segment": True}, "whole"), ({"samples_per_segment": 2.5}, "whole"),
     ({"samples_per_segment": 0}, "at least 1"), ({"spacing": "even"}, "centripetal"),
     ({"samples_per_segment": 10**7}, "fewer samples")],
)  # fmt: skip
def test_settings_of_smooth_curves_are_checked(settings: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        smooth_curve(POINTS, **settings)
