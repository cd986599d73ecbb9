"""Outlines: which side is inside, how crossings are cut, and what is no outline."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harnack.geometry.outline_loops import make_outline


def square(r: float, x: float = 0.0) -> Any:
    return np.array([[-r + x, -r], [r + x, -r], [r + x, r], [-r + x, r]])


def area(loops: Any) -> float:
    return sum(
        0.5 * float(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1)))
        for p in loops
    )


@pytest.mark.parametrize(
    ("loops", "inside", "count"),
    [
        ([square(1), square(3), square(2)], 36 - 16 + 4, 3),
        ([square(1)[::-1], square(3), square(2)[::-1]], 36 - 16 + 4, 3),
        (square(1)[::-1], 4, 1),
        ([square(1).tolist()], 4, 1),
        (np.array([[0, 0], [2, 2], [2, 0], [0, 2]]), 2, 2),  # crosses itself
        ([square(1), square(1, 1.0)], 4, 2),  # what two squares share is outside
        ([square(1), square(1, 2.0)], 8, None),  # a common edge
        ([square(1), square(1) + 2.0], 8, 2),  # a common corner
        ([[[0, 0], [4, 0], [4, 1], [5, 1], [4, 1], [4, 4], [0, 4]]], 16, 1),  # there and back
    ],
)
def test_loops_have_the_region_on_their_left(loops: Any, inside: float, count: Any) -> None:
    for size in (1.0, 1e-9, 1e9):
        for offset in (0.0, 7.0):
            several = [loops] if np.ndim(loops[0]) == 1 else loops
            made = make_outline([size * (np.asarray(one) + offset) for one in several])
            assert area(made) / size**2 == pytest.approx(inside, rel=1e-9)
            assert count in (None, len(made))
            again = make_outline(made)
            assert all(np.array_equal(a, b) for a, b in zip(made, again, strict=True))


def test_loops_that_do_not_cross_keep_their_vertices() -> None:
    given = [square(1 / 3), square(0.1, 0.07)]
    made = make_outline(given)
    assert np.array_equal(made[0], given[0])
    assert np.array_equal(made[1], given[1][::-1])


def test_windings_count_where_they_are_asked_for() -> None:
    loops = [square(1), square(1, 1.0), square(0.2, 0.5)[::-1]]
    assert area(make_outline(loops, "nonzero")) == pytest.approx(6.0)
    assert area(make_outline(loops, "even-odd")) == pytest.approx(4.0 + 0.16)


@pytest.mark.parametrize(
    ("loops", "error", "words"),
    [
        ([], ValueError, "there is none"),
        (3, TypeError, "array \\(n, 2\\)"),
        ([[0, 0], [1, 1]], ValueError, "three points or more"),
        ([[0, 0], [1, 1], [0, 0]], ValueError, "three points or more"),
        (np.full((3, 2), np.nan), ValueError, "finite"),
        (np.full((3, 2), 1e200), ValueError, "too large"),
        (np.zeros((4, 3)), ValueError, "shape \\(n, 2\\)"),
        ([[0, 0], [1, 0], [2, 0]], ValueError, "no area"),
        ([square(1), square(1)], ValueError, "no area"),
        ("M 0 0", ValueError, "real numbers"),
        ([[[True, False]] * 3], ValueError, "real numbers"),
        (np.zeros((300_000, 2)), ValueError, "at most 200,000"),
    ],
)
def test_what_is_no_outline_is_said(loops: Any, error: Any, words: str) -> None:
    with pytest.raises(error, match=words):
        make_outline(loops)
