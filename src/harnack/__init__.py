"""Guaranteed ray tracing of harmonic and other implicit surfaces.

import harnack as hk
hits = hk.trace(hk.SolidAngle(vertices), origins, directions)
"""

from __future__ import annotations

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend, files, geometry, rendering, testing
from harnack._version import __version__
from harnack.distance import Curvatures, closest_points, curvature, signed_distance
from harnack.enclosures import (
    Caps,
    Classic,
    Cone,
    Curvature,
    Enclosure,
    HarmonicBall,
    Lipschitz,
    Parabola,
    Slope,
    Taylor,
)
from harnack.fields import (
    DipolePotential,
    EigenfunctionSum,
    Field,
    Gyroid,
    HarmonicPolynomial,
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
    "Box",
    "Caps",
    "Classic",
    "Cone",
    "ConvexHull",
    "Curvature",
    "Curvatures",
    "DipolePotential",
    "EigenfunctionSum",
    "Enclosure",
    "Field",
    "Gyroid",
    "HalfSpace",
    "HarmonicBall",
    "HarmonicPolynomial",
    "Hits",
    "Intersection",
    "LevelSet",
    "Lipschitz",
    "Parabola",
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
    "Taylor",
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
