"""The names of the package, and where they are."""

from . import example_curves as example_curves
from . import example_meshes as example_meshes
from .clip_volumes import Ball, Box, HalfSpace, VolumeIntersection
from .clouds import CloudError, estimate_areas, estimate_normals, validate_cloud
from .convex_position import ConvexHull
from .curves import (
    Circle,
    CurveError,
    bounding_box,
    edge_endpoints,
    is_convex_position,
    total_length,
    validate_loops,
)
from .meshes import (
    MeshError,
    validate_mesh,
    without_zero_area_faces,
    zero_area_faces,
)
from .splines import smooth_curve
from .volume import Volume

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
