"""Convex parts of space that rays are cut to: their closed formulas, no search."""

from __future__ import annotations

from harnack.geometry.volumes.hull import ConvexHull
from harnack.geometry.volumes.primitives import Ball, Box, HalfSpace, Intersection
from harnack.geometry.volumes.volume import Volume, check_volume

__all__ = ["Ball", "Box", "ConvexHull", "HalfSpace", "Intersection", "Volume", "check_volume"]
