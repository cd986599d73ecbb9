"""Distances to level sets and their curvatures, at points."""

from __future__ import annotations

from harnack.distance.curvature import Curvatures, Family, curvature, curvature_lines
from harnack.distance.signed_distance import (
    DistanceBounds,
    Method,
    closest_points,
    distance_bounds,
    signed_distance,
)

__all__ = [
    "Curvatures",
    "DistanceBounds",
    "Family",
    "Method",
    "closest_points",
    "curvature",
    "curvature_lines",
    "distance_bounds",
    "signed_distance",
]
