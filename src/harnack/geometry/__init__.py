"""Curves, clipping volumes, triangles, welding, boundary edges, file reading. No queries."""

from __future__ import annotations

from harnack.geometry import shapes
from harnack.geometry.curves import (
    CurveError,
    bounding_box,
    edges,
    is_convex_position,
    total_length,
    validate_loops,
)
from harnack.geometry.files import FileFormatError, read_loops, write_atomically
from harnack.geometry.volumes import Ball, Box, ConvexHull, HalfSpace, Intersection, Volume

__all__ = [
    "Ball",
    "Box",
    "ConvexHull",
    "CurveError",
    "FileFormatError",
    "HalfSpace",
    "Intersection",
    "Volume",
    "bounding_box",
    "edges",
    "is_convex_position",
    "read_loops",
    "shapes",
    "total_length",
    "validate_loops",
    "write_atomically",
]
