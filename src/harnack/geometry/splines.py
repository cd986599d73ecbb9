"""Smooth curves through points, by cubic splines: `smooth_curve`."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from harnack.backend.validation import FloatArray
from harnack.geometry.curves import MAX_VERTICES, CurveError, validate_loops

if TYPE_CHECKING:
    from harnack.geometry.curves import LoopsLike

__all__ = ["smooth_curve"]

Parameterization = Literal["centripetal", "chord"]
# From a point to the next, the parameter of the spline grows by this power of their distance.
_POWERS = {"centripetal": 0.5, "chord": 1.0}


def smooth_curve(
    points: LoopsLike,
    samples_per_segment: int = 16,
    *,
    closed: bool = True,
    spacing: Parameterization = "centripetal",
) -> Any:
    """A smooth curve through points: a cubic spline, which has continuous second derivatives.

        hk.SolidAngle(hk.geometry.smooth_curve(points))

    points: (n, 3) in order, n >= 3, or a list of such arrays. A closed curve returns from the last
        point to the first, which need not be repeated.
    samples_per_segment: the number of vertices from each point to the next; the first of them is
        the point itself, bit for bit.
    closed: False for a curve that ends at its first and last point. There the third derivative is
        continuous at the second point and the last but one ("not a knot").
    spacing: the growth of the parameter from point to point. "centripetal": the square root of
        their distance; curves then hardly swing out or loop where points are spaced unevenly (Lee
        1989). "chord": the distance itself; curves are then rounder where points are spaced almost
        evenly.

    Returns:
        The vertices, with k = samples_per_segment: (n k, 3) for a closed curve, ((n - 1) k + 1, 3)
            for an open one; for a list of curves, a list of such arrays. The result is not checked
            for self-intersections.

    Raises:
        CurveError: fewer than 3 different points, two equal points in a row, NaN, wrong shapes, or
            too many vertices.
        TypeError: samples_per_segment is not an integer.
        ValueError: samples_per_segment less than 1, or an unknown spacing.
    """
    samples_per_segment = _as_sample_count(samples_per_segment)
    if spacing not in _POWERS:
        raise ValueError(f'spacing is "centripetal" or "chord", not {spacing!r}')
    loops = validate_loops(points, closed=closed)
    total = sum(map(len, loops)) * samples_per_segment
    if total > MAX_VERTICES:
        raise CurveError(f"{total:,} vertices are more than {MAX_VERTICES:,}: take fewer samples")
    curves = [_spline(loop, samples_per_segment, closed, _POWERS[spacing]) for loop in loops]
    return curves if _is_list(points) else curves[0]


def _as_sample_count(samples: Any) -> int:
    """Convert the number of samples per segment to an int.

    Raises:
        TypeError: not an integer.
        ValueError: less than 1.
    """
    if isinstance(samples, bool) or not hasattr(samples, "__index__"):
        raise TypeError(f"samples_per_segment must be a whole number, not {samples!r}")
    count = operator.index(samples)
    if count < 1:
        raise ValueError(
            f"samples_per_segment must be at least 1 from each point to the next, not {count}"
        )
    return count


def _is_list(points: Any) -> bool:
    """Whether the argument `points` is a list of curves (arrays of points), and not a single
    curve."""
    try:
        return np.ndim(points) == 3
    except ValueError:  # curves of different lengths
        return True


def _spline(x: FloatArray, samples: int, closed: bool, power: float) -> FloatArray:
    """Compute points of the cubic spline through the points x (n, 3) of a curve. Returns them as an
    array (k, 3); the points x themselves are among them, bit for bit.

    samples: how many of them there are from each point of x to the next.
    closed: whether the curve returns to its first point.
    power: from a point to the next, the parameter of the spline grows by this power of their
        distance.

    Raises:
        CurveError: two consecutive points are so near that their parameters are equal.
    """
    knots = np.concatenate([x, x[:1]]) if closed else x
    chords = np.diff(knots, axis=0)
    length = np.linalg.norm(chords / np.abs(chords).max(), axis=1)  # so that no square overflows
    parameters = np.concatenate([[0.0], np.cumsum(length**power)])
    if (np.diff(parameters) <= 0).any():
        k = int(np.flatnonzero(np.diff(parameters) <= 0)[0])
        raise CurveError(
            f"points {k} and {(k + 1) % len(x)} are nearer to each other than rounding, beside the "
            "length of the curve: remove one of them"
        )
    from scipy.interpolate import CubicSpline  # imported here: it takes half a second

    spline = CubicSpline(parameters, knots, bc_type="periodic" if closed else "not-a-knot")
    # The parameters of the samples (segments, samples), each segment from its first point on.
    sampled = parameters[:-1, None] + np.diff(parameters)[:, None] * (np.arange(samples) / samples)
    vertices = spline(sampled.ravel())
    vertices[::samples] = knots[:-1]
    return vertices if closed else np.concatenate([vertices, knots[-1:]])
