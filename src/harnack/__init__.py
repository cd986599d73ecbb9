"""Guaranteed ray tracing of harmonic and other implicit surfaces.

import harnack as hk
hits = hk.trace(hk.SolidAngle(vertices), origins, directions)
"""

from __future__ import annotations

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend, files, geometry, rendering, testing
from harnack._version import __version__
from harnack.bounds import Bound, Caps, Classic, CurvatureStep, LipschitzStep, Longest, Slope
from harnack.distance import Curvatures, closest_points, curvature, signed_distance
from harnack.fields import (
    Curvature,
    DipolePotential,
    EigenfunctionSum,
    Field,
    Gyroid,
    HarmonicBall,
    HarmonicPolynomial,
    Lipschitz,
    PlaneWave,
    Product,
    Sample,
    SchwarzD,
    SchwarzP,
    ScreenedWindingNumber,
    SolidAngle,
    SphericalHarmonic,
    WindingNumber,
    cosine,
    sine,
)
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Intersection
from harnack.rendering import render
from harnack.tracer import Hits, LevelSet, Status, Tolerance, level_set, trace

__all__ = [
    "Ball",
    "Bound",
    "Box",
    "Caps",
    "Classic",
    "ConvexHull",
    "Curvature",
    "CurvatureStep",
    "Curvatures",
    "DipolePotential",
    "EigenfunctionSum",
    "Field",
    "Gyroid",
    "HalfSpace",
    "HarmonicBall",
    "HarmonicPolynomial",
    "Hits",
    "Intersection",
    "LevelSet",
    "Lipschitz",
    "LipschitzStep",
    "Longest",
    "PlaneWave",
    "Product",
    "Sample",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "Slope",
    "SolidAngle",
    "SphericalHarmonic",
    "Status",
    "Tolerance",
    "WindingNumber",
    "__version__",
    "backend",
    "closest_points",
    "cosine",
    "curvature",
    "files",
    "geometry",
    "level_set",
    "render",
    "rendering",
    "signed_distance",
    "sine",
    "testing",
    "trace",
]
