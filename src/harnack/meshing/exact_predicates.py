"""Exact signs of determinants. They tell on which side of a plane a point lies or, in two
dimensions, on which side of a line.

A determinant is computed in floating point, with a bound of its rounding error (Shewchuk, Adaptive
Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates, 1997). Where that leaves
the sign undecided, it is computed in integers, without rounding: all coordinates are integers times
the same power of two.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray

__all__ = ["UNDERFLOW", "SignArray", "orient2d", "orient3d"]

SignArray = npt.NDArray[np.int8]

# The unit roundoff.
_UNIT = 2.0**-53
# Shewchuk's bounds of the rounding errors of both determinants, relative to the sum of the absolute
# values of their terms.
_ORIENT3D_ERROR, _ORIENT2D_ERROR = (7 + 56 * _UNIT) * _UNIT, (3 + 16 * _UNIT) * _UNIT
# A bound of the error by underflow, for coordinates of order one.
UNDERFLOW = 1e-290


def orient3d(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> SignArray:
    """The exact signs (n,) of det(a - d, b - d, c - d), for points (n, 3). The sign is 1 if a, b, c
    run clockwise as seen from d, -1 if they run counter-clockwise, and 0 if the four points lie in
    one plane."""
    points = _scaled(np.stack([a, b, c, d], axis=1))
    edges = points[:, :3] - points[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (edges[:, k].T for k in range(3))
    terms = [(bx * cy, cx * by, az), (cx * ay, ax * cy, bz), (ax * by, bx * ay, cz)]
    determinant = sum((plus - minus) * third for plus, minus, third in terms)
    sum_of_terms = sum(
        (np.abs(plus) + np.abs(minus)) * np.abs(third) for plus, minus, third in terms
    )
    # A row of zeros makes the determinant 0 exactly. Differences of doubles are 0 only where these
    # are equal.
    is_zero = (edges == 0).all(axis=1).any(axis=1)
    return _signs_with_fallback(
        np.asarray(determinant),
        _ORIENT3D_ERROR * np.asarray(sum_of_terms),
        is_zero,
        points,
        _orient3d_exact,
    )


def orient2d(a: FloatArray, b: FloatArray, c: FloatArray) -> SignArray:
    """The exact signs (n,) of det(a - c, b - c), for points (n, 2). The sign is 1 if a, b, c run
    counter-clockwise, -1 if they run clockwise, and 0 if they lie on one line."""
    points = _scaled(np.stack([a, b, c], axis=1))
    edges = points[:, :2] - points[:, 2:]
    (ax, ay), (bx, by) = (edges[:, k].T for k in range(2))
    determinant, sum_of_terms = ax * by - ay * bx, np.abs(ax * by) + np.abs(ay * bx)
    # A row of zeros makes the determinant 0 exactly.
    is_zero = (edges == 0).all(axis=1).any(axis=1)
    return _signs_with_fallback(
        determinant, _ORIENT2D_ERROR * sum_of_terms, is_zero, points, _orient2d_exact
    )


def _scaled(points: FloatArray) -> FloatArray:
    """The points, times a power of two that makes the largest absolute value of a coordinate at
    least 1/2 and less than 1. The signs of determinants stay the same. No coordinate is rounded,
    unless it underflows."""
    largest = float(np.abs(points).max(initial=0.0))
    return points if largest == 0 else np.ldexp(points, -int(np.frexp(largest)[1]))


def _signs_with_fallback(
    value: FloatArray, error: FloatArray, zero: BoolArray, points: FloatArray, exact: Any
) -> SignArray:
    """The signs (n,) of determinants that are known up to an error. A sign that the error leaves
    undecided is computed without rounding.

    value: (n,) the approximate determinants.
    error: (n,) bounds of their errors.
    zero: (n,) mask of the determinants that are known to be 0.
    points: (n, k, d) the points that determine each determinant.
    exact: computes the determinants without rounding from points (j, k, d) with integer coordinates
        (`_integers`).
    """
    signs: SignArray = np.sign(value).astype(np.int8)
    signs[zero] = 0
    open_rows = np.flatnonzero(~zero & (np.abs(value) <= error + UNDERFLOW))
    if len(open_rows):
        signs[open_rows] = np.sign(exact(_integers(points[open_rows]))).astype(np.int8)
    return signs


def _integers(points: FloatArray) -> Any:
    """Points with integer coordinates of Python's unlimited type `int`, in an array of objects: the
    given points, all times the same power of two, without rounding. A double is an integer of 53
    bits times a power of two; the smallest of these powers becomes 1."""
    mantissa, exponent = np.frexp(points)
    # As integers of 53 bits: `frexp` gives mantissas below 1.
    mantissas = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    used = mantissa != 0
    min_exponent = int(exponent[used].min()) if used.any() else 0
    return mantissas * 2 ** np.where(used, exponent - min_exponent, 0).astype(object)


def _orient3d_exact(points: Any) -> Any:
    """Compute det(a - d, b - d, c - d) without rounding, (n,) integers.

    points: (n, 4, 3) integer coordinates of the points a, b, c, d in each row.
    """
    rows = points[:, :3] - points[:, 3:]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (rows[:, k].T for k in range(3))
    return (bx * cy - cx * by) * az + (cx * ay - ax * cy) * bz + (ax * by - bx * ay) * cz


def _orient2d_exact(points: Any) -> Any:
    """Compute det(a - c, b - c) without rounding, (n,) integers.

    points: (n, 3, 2) integer coordinates of the points a, b, c in each row.
    """
    rows = points[:, :2] - points[:, 2:]
    (ax, ay), (bx, by) = (rows[:, k].T for k in range(2))
    return ax * by - ay * bx
