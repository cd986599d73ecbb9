"""Approximates Bezier curves of degrees 2 and 3 by polylines within a proved distance."""

from __future__ import annotations

import math

import numpy as np

from harnack.backend import FloatArray

__all__ = ["flatten_bezier"]

_MAX_SEGMENTS = 1_000_000


def flatten_bezier(controls: FloatArray, tolerance: float) -> tuple[FloatArray, float]:
    """Approximate a Bezier curve by a polyline within `tolerance` of it.

    controls: (3, d) or (4, d), the control points of a quadratic or a cubic curve in d dimensions.
    tolerance: the largest distance, in the unit of the control points.

    Returns the vertices (k, d) of the polyline without the first (which is the curve's first
    point), and a bound of the distance between the curve and the polyline.

    Proof. Let B be the curve and n its degree. A chord between two points of the curve whose
    parameters differ by h is within h^2/8 max |B''| of the curve, at equal parameters. |B''| is at
    most n (n - 1) times the largest second difference of the control points. With k equal pieces h
    = 1/k.

    Raises:
        ValueError: more than a million segments.
    """
    degree = len(controls) - 1
    second_bound = (
        degree * (degree - 1) * float(np.linalg.norm(np.diff(controls, 2, axis=0), axis=1).max())
    )
    count = max(1.0, math.sqrt(second_bound / (8.0 * tolerance)))
    # `not <=` also refuses a number that is not finite.
    if not count <= _MAX_SEGMENTS:
        raise ValueError(f"{count:,.0f} segments for one curve: allow a larger tolerance")
    count = math.ceil(count)
    t = np.linspace(0.0, 1.0, count + 1)[1:, None]
    # The Bernstein polynomials at the parameters.
    weights = [math.comb(degree, k) * (1 - t) ** (degree - k) * t**k for k in range(degree + 1)]
    return np.hstack(weights) @ controls, second_bound / (8.0 * count**2)
