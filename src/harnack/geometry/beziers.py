"""Bezier curves of degrees 2 and 3 as polylines within a proved distance."""

from __future__ import annotations

import math

import numpy as np

from harnack.backend import FloatArray

__all__ = ["flatten_bezier"]

_MAX_SEGMENTS = 1_000_000


def flatten_bezier(controls: FloatArray, tolerance: float) -> tuple[FloatArray, float]:
    """Flatten a Bezier curve. Returns the points (k, d) of a polyline that starts at the curve's
    first point, which is not among them, and a bound of the distance between curve and polyline.

    controls: (3, d) or (4, d), of a quadratic or a cubic curve.

    Proof. A chord between two parameters h apart is within h^2/8 max |B''| of the curve, at equal
    parameters, and |B''| <= n (n - 1) max |second difference of the control points|.

    Raises:
        ValueError: more than a million segments.
    """
    degree = len(controls) - 1
    second = (
        degree * (degree - 1) * float(np.linalg.norm(np.diff(controls, 2, axis=0), axis=1).max())
    )
    count = max(1.0, math.sqrt(second / (8.0 * tolerance)))
    if not count <= _MAX_SEGMENTS:
        raise ValueError(f"{count:,.0f} segments for one curve: allow a larger tolerance")
    count = math.ceil(count)
    t = np.linspace(0.0, 1.0, count + 1)[1:, None]
    weights = [math.comb(degree, k) * (1 - t) ** (degree - k) * t**k for k in range(degree + 1)]
    return np.hstack(weights) @ controls, second / (8.0 * count**2)
