"""Exact signs of determinants: on which side of a plane, or of a line in a plane, points lie.

Determinants are computed in floating point, with a bound of what rounding may have done to them
(Shewchuk, Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, 1997).
Where that leaves the sign open it is found in integers: all coordinates are integers times one
power of two.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray

__all__ = ["SignArray", "sides_of_lines", "sides_of_planes"]

SignArray = npt.NDArray[np.int8]

_UNIT = 2.0**-53
# Shewchuk's bounds of the rounding of both determinants, over the sum of their terms' magnitudes.
_PLANE, _LINE = (7 + 56 * _UNIT) * _UNIT, (3 + 16 * _UNIT) * _UNIT
# What underflow may add, for coordinates of order one.
_UNDERFLOW = 1e-290


def sides_of_planes(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> SignArray:
    """(n,) signs of det(a - d, b - d, c - d), points (n, 3): 1 where d sees a, b, c run clockwise,
    0 where the four points are in one plane."""
    together = _scaled(np.stack([a, b, c, d], axis=1))
    rows = together[:, :3] - together[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (rows[:, k].T for k in range(3))
    terms = [(bx * cy, cx * by, az), (cx * ay, ax * cy, bz), (ax * by, bx * ay, cz)]
    value = sum((one - other) * height for one, other, height in terms)
    size = sum((np.abs(one) + np.abs(other)) * np.abs(height) for one, other, height in terms)
    # A difference of doubles is 0 where they are equal, and only there.
    flat = (rows == 0).all(axis=1).any(axis=1)
    return _decided(np.asarray(value), _PLANE * np.asarray(size), flat, together, _exact_sides)


def sides_of_lines(a: FloatArray, b: FloatArray, c: FloatArray) -> SignArray:
    """(n,) signs of det(a - c, b - c), points (n, 2): 1 where a, b, c run counter-clockwise, 0
    where they are in one line."""
    together = _scaled(np.stack([a, b, c], axis=1))
    rows = together[:, :2] - together[:, 2:]
    (ax, ay), (bx, by) = (rows[:, k].T for k in range(2))
    value, size = ax * by - ay * bx, np.abs(ax * by) + np.abs(ay * bx)
    flat = (rows == 0).all(axis=1).any(axis=1)
    return _decided(value, _LINE * size, flat, together, _exact_turns)


def _scaled(points: FloatArray) -> FloatArray:
    """Points times a power of two, so that the largest coordinate is of order one."""
    largest = float(np.abs(points).max(initial=0.0))
    return points if largest == 0 else np.ldexp(points, -int(np.frexp(largest)[1]))


def _decided(
    value: FloatArray, error: FloatArray, zero: BoolArray, points: FloatArray, exact: Any
) -> SignArray:
    """Signs of values known up to errors, or to be 0; by `exact` of the points where that is not
    enough."""
    signs: SignArray = np.sign(value).astype(np.int8)
    signs[zero] = 0
    open_rows = np.flatnonzero(~zero & (np.abs(value) <= error + _UNDERFLOW))
    if len(open_rows):
        signs[open_rows] = np.sign(exact(_integers(points[open_rows]))).astype(np.int8)
    return signs


def _integers(points: FloatArray) -> Any:
    """Points times a power of two, as Python's integers."""
    mantissa, exponent = np.frexp(points)
    whole = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    used = mantissa != 0
    least = int(exponent[used].min()) if used.any() else 0
    return whole * 2 ** np.where(used, exponent - least, 0).astype(object)


def _exact_sides(points: Any) -> Any:
    rows = points[:, :3] - points[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (rows[:, k].T for k in range(3))
    return (bx * cy - cx * by) * az + (cx * ay - ax * cy) * bz + (ax * by - bx * ay) * cz


def _exact_turns(points: Any) -> Any:
    rows = points[:, :2] - points[:, 2:]
    (ax, ay), (bx, by) = (rows[:, k].T for k in range(2))
    return ax * by - ay * bx
