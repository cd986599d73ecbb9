"""Distances of a point from segments and from the hulls of two balls. The coordinates of the point
are numbers of any arithmetic. Local coordinates are taken along and across the axis, in a frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

from harnack.arithmetic.distance_jets import jet_of_segment_distance
from harnack.arithmetic.norms import as_one_operation, maximum, minimum, norm

__all__ = ["Frame", "cone_distance", "segment_distance"]

Frame: TypeAlias = "tuple[float, ...]"
"""Twelve numbers, three rows (a, b, c, d): a local coordinate is a x + b y + c z - d. The first one
is along the axis, the others are at right angles to it and to each other."""


def segment_distance(point: Sequence[Any], frame: Sequence[Any], half_length: Any) -> Any:
    """The distance of a point from the segment of the points on the axis of a frame whose local
    coordinate is at most `half_length` on both sides of 0.

    point: (3,) coordinates, numbers of any arithmetic.
    frame: `Frame`.

    Let h be the coordinate along the axis, u and v those across it. The distance is the norm of u,
    v and max(|h| - half_length, 0), by which the point lies beyond an end (Pythagoras).

    It is convex, whatever the numbers of the frame are rounded to: a norm of linear functions and
    of a convex function that is not negative, with which it grows.
    """
    whole = as_one_operation("segment distance", tuple(point), *frame, half_length)
    if whole is None:
        whole = jet_of_segment_distance(point, frame, half_length)
    if whole is not None:
        return whole
    along, across, other = _local_coordinates(point, frame)
    return norm(across, other, maximum(abs(along) - half_length, 0.0))


def cone_distance(
    point: Sequence[Any], frame: Sequence[Any], length: Any, slope: Any, ratio: Any
) -> Any:
    """The least over t, 0 <= t <= length, of |p - x_t| + slope t, where x_t is the point on the
    axis of a frame with the local coordinate t. Minus a radius r, it is the signed distance from
    the convex hull of two balls: about x_0 with the radius r, and about x_length with the radius r
    - slope length (`harnack.solids.RoundCone` has the proof).

    point: (3,) coordinates of p, numbers of any arithmetic.
    frame: `Frame`.
    slope, ratio: s, 0 <= s < 1, and s / sqrt(1 - s^2).
    """
    whole = as_one_operation("cone distance", tuple(point), *frame, length, slope, ratio)
    if whole is not None:
        return whole
    along, across, other = _local_coordinates(point, frame)
    from_axis = norm(across, other)
    t = minimum(maximum(along - from_axis * ratio, 0.0), length)
    return norm(from_axis, along - t) + t * slope


def _local_coordinates(point: Sequence[Any], frame: Sequence[Any]) -> list[Any]:
    """The local coordinates of a point, the one along the axis first."""
    x, y, z = point
    rows = (frame[k : k + 4] for k in (0, 4, 8))
    return [x * a + y * b + z * c - d for a, b, c, d in rows]
