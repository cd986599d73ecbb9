"""Distances to level sets and their curvatures, at points."""

from __future__ import annotations

from harnack.distance.curvature import Curvatures, curvature
from harnack.distance.signed_distance import Method, closest_points, signed_distance

__all__ = ["Curvatures", "Method", "closest_points", "curvature", "signed_distance"]
