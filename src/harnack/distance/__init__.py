"""Distances of points from level sets (the points at which a field's function f takes a given
value, the level), closest points, and curvatures of level sets.
"""

from __future__ import annotations

from harnack.distance.distance_estimates import (
    DistanceBounds,
    Method,
    closest_points,
    distance_bounds,
    signed_distance,
)
from harnack.distance.surface_curvature import CurvatureSamples, Family, curvature, curvature_lines

__all__ = [
    "CurvatureSamples",
    "DistanceBounds",
    "Family",
    "Method",
    "closest_points",
    "curvature",
    "curvature_lines",
    "distance_bounds",
    "signed_distance",
]
