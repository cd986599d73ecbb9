"""Jets of distances in closed form: ranges contain what longer arithmetic gives."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from harnack.arithmetic import Interval, Jet, norm, segment_distance
from harnack.arithmetic.distance_jets import jet_of_point_distance, jet_of_segment_distance
from harnack.backend import choose_backend
from harnack.fields.solids.round_cones import axial_frames

COUNT = 4_000


def cases(kind: str, dtype: Any) -> tuple[Any, ...]:
    """Points (n, 3), vectors (n, 3), lengths (n,), frames (n, 12) and half lengths (n,)."""
    rng = np.random.default_rng(3)
    points, vectors = rng.normal(size=(2, COUNT, 3))
    vectors /= np.linalg.norm(vectors, axis=1)[:, None]
    lengths = 10.0 ** rng.uniform(-4, 1, COUNT)
    middles, axes = rng.normal(size=(2, COUNT, 3))
    half = 10.0 ** rng.uniform(-2, 1, COUNT)
    if kind == "far":
        points, middles = points + 1e4, middles + 1e4
    if kind == "thin":
        points, middles, half = 1e-12 * points, 1e-12 * middles, 1e-12 * half
    if kind == "aligned":  # lines along the axis, through it, and points on it
        axes[:, :2], vectors[: COUNT // 2, :2], middles[:] = 0.0, 0.0, 0.0
        points[: COUNT // 4, :2] = 0.0
        points[COUNT // 2 :] = -vectors[COUNT // 2 :] * lengths[COUNT // 2 :, None] / 2
    if kind == "long":
        vectors, lengths = 3.0 * vectors, 1e3 * lengths
    frames = axial_frames(middles, axes)
    return tuple(entry.astype(dtype) for entry in (points, vectors, lengths, frames, half))


def exact(points: Any, vectors: Any, frames: Any, half: Any) -> tuple[Any, ...]:
    """The distance of points (..., n, 3) from segments, its slope and second derivative along
    vectors (n, 3), and its gradient, in long double precision."""
    rows = frames.astype(np.longdouble).reshape(-1, 3, 4)
    local = (rows[..., :3] * points[..., None, :]).sum(-1) - rows[..., 3]
    rates = (rows[..., :3] * vectors[:, None, :].astype(np.longdouble)).sum(-1)
    beyond = local[..., 0] - np.clip(local[..., 0], -half, half)
    q = np.stack([beyond, local[..., 1], local[..., 2]], -1)
    f = np.sqrt((q * q).sum(-1))
    with np.errstate(all="ignore"):
        unit = q / f[..., None]
        slope = (unit * rates).sum(-1)
        moving = np.where(beyond == 0, 0, rates[:, 0]) ** 2 + (rates[:, 1:] ** 2).sum(-1)
        second = (moving - slope * slope) / f
    return f, slope, second, (unit[..., None] * rows[..., :3]).sum(-2)


def contains(interval: Interval, value: Any, slack: Any = 0.0) -> Any:
    low, high = (np.array(end, np.longdouble) for end in (interval.lower, interval.upper))
    is_low = (low <= value + slack) | np.isnan(low) | np.isnan(value)
    return is_low & ((high >= value - slack) | np.isnan(high) | np.isnan(value))


@pytest.mark.parametrize("kind", ["near", "far", "thin", "aligned", "long"])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_ranges_contain_the_distance_and_its_derivatives(precision: Any, kind: str) -> None:
    backend = choose_backend(precision)
    points, vectors, lengths, frames, half = cases(kind, backend.dtype)
    p, d = (backend.Array3f(*entry.T) for entry in (points, vectors))
    numbers = [backend.Float(column) for column in frames.T]
    w, reach = backend.Float(lengths), backend.Float(half)
    at_point = jet_of_segment_distance(Jet.at_point(p), numbers, reach)
    piece = jet_of_segment_distance(Jet.along_ray(p, d, 0.0, w), numbers, reach)
    assert at_point is not None
    assert piece is not None
    assert piece.jet_at_start is not None
    f, slope, _, gradient = exact(points.astype(np.longdouble), vectors, frames, half)
    assert contains(at_point.value, f).all()
    for k, derivative in enumerate(at_point.first_derivatives):
        assert contains(derivative, gradient[:, k]).all()
    (start_slope,) = piece.jet_at_start.first_derivatives
    assert contains(piece.jet_at_start.value, f).all()
    assert contains(start_slope, slope).all()
    s = np.linspace(0, 1, 33, dtype=np.longdouble)[:, None] * lengths
    on_line = points + s[..., None] * vectors
    f, slope, second, _ = exact(on_line, vectors, frames, half)
    assert contains(piece.value, f).all()
    assert contains(piece.first_derivatives[0], slope).all()
    # The second derivative is a difference here, which is rounded.
    rounding = 1e-17 * ((vectors**2).sum(-1) + np.abs(points).max() ** 2) / np.maximum(f, 1e-30)
    is_known = rounding < 1e-6 * np.maximum(np.abs(second), 1e-6 / lengths)
    assert is_known.mean() > 0.5 or kind == "thin"
    inside = contains(piece.second_derivatives[0], second, rounding + 1e-9 * np.abs(second))
    assert (inside | ~is_known).all()


def test_closed_forms_are_as_sharp_as_the_general_arithmetic() -> None:
    backend = choose_backend("double")
    points, vectors, lengths, frames, half = cases("near", np.float64)
    p, d = (backend.Array3f(*entry.T) for entry in (points, vectors))
    numbers = [backend.Float(column) for column in frames.T]
    line = Jet.along_ray(p, d, 0.0, backend.Float(lengths))
    x, y, z = line
    rows = (numbers[k : k + 4] for k in (0, 4, 8))
    h, u, v = (x * a + y * b + z * c - e for a, b, c, e in rows)
    quick = segment_distance(line, numbers, backend.Float(half))
    slow = norm(u, v, ((abs(h) - backend.Float(half)).pointwise_maximum(h.constant(0.0))))
    for closed, general in (
        (quick.value, slow.value),
        (quick.first_derivatives[0], slow.first_derivatives[0]),
        (quick.second_derivatives[0], slow.second_derivatives[0]),
    ):
        width, general_width = (np.array(e.upper - e.lower) for e in (closed, general))
        assert (width <= general_width * (1 + 1e-6) + 1e-12).mean() > 0.9


def test_points_without_a_length_and_overflow() -> None:
    backend = choose_backend("single")
    p = backend.Array3f([0.0, 1e30, np.inf, np.nan, 1e-30], 0.0, 0.0)
    d = backend.Array3f(1.0, 0.0, 0.0)
    for length in (0.0, 1.0, np.inf):
        w = backend.Float(length) + 0 * backend.Float([1, 1, 1, 1, 1])
        jet = jet_of_point_distance(Jet.along_ray(p, d, 0.0, w), [0.0, 0.0, 0.0])
        assert jet is not None
        low, high = (np.array(end) for end in (jet.value.lower, jet.value.upper))
        assert (low >= 0).all()
        assert low[0] == 0
        assert low[1] <= 1e30
        assert not (high[1:3] < 1e30).any()
        (slope,) = jet.first_derivatives
        assert contains(slope, np.array([1, 1, 1, 1, 1.0])).all()
        assert dr.all(slope.lower <= 1)


def test_other_functions_have_no_closed_form() -> None:
    backend = choose_backend("single")
    x, y, z = Jet.at_point(backend.Array3f(1.0, 2.0, 3.0))
    center = [0.0, 0.0, 0.0]
    assert jet_of_point_distance((x, y, z), center) is not None
    assert jet_of_point_distance((x + x, y, z), center) is None
    assert jet_of_point_distance((y, x, z), center) is None
    assert jet_of_point_distance(Jet.at_point(backend.Array3f(1.0), order=2), center) is None
    ball = Jet.over_ball(backend.Array3f(1.0), backend.Float(0.1))
    assert jet_of_point_distance(ball, center) is None
