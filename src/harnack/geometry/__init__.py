"""Curves, meshes, clouds and clip volumes: validation and measures. No files, no trees."""

from __future__ import annotations

from harnack.geometry import example_curves, example_meshes
from harnack.geometry.clip_volumes import Ball, Box, HalfSpace, VolumeIntersection
from harnack.geometry.clouds import CloudError, estimate_areas, estimate_normals, validate_cloud
from harnack.geometry.convex_position import ConvexHull
from harnack.geometry.curves import (
    Circle,
    CurveError,
    bounding_box,
    edge_endpoints,
    is_convex_position,
    total_length,
    validate_loops,
)
from harnack.geometry.meshes import (
    MeshError,
    validate_mesh,
    without_zero_area_faces,
    zero_area_faces,
)
from harnack.geometry.splines import smooth_curve
from harnack.geometry.volume import Volume

__all__ = [
    "Ball",
    "Box",
    "Circle",
    "CloudError",
    "ConvexHull",
    "CurveError",
    "HalfSpace",
    "MeshError",
    "Volume",
    "VolumeIntersection",
    "bounding_box",
    "edge_endpoints",
    "estimate_areas",
    "estimate_normals",
    "example_curves",
    "example_meshes",
    "is_convex_position",
    "smooth_curve",
    "total_length",
    "validate_cloud",
    "validate_loops",
    "validate_mesh",
    "without_zero_area_faces",
    "zero_area_faces",
]
