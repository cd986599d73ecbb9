"""Guaranteed ray tracing of harmonic and other implicit surfaces.

import harnack as hk
hits = hk.trace(hk.SolidAngle(vertices), origins, directions)
"""

from __future__ import annotations

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend, geometry, rendering, testing
from harnack._version import __version__
from harnack.bounds import Bound, Caps, Classic, CurvatureStep, LipschitzStep, Longest, Slope
from harnack.fields import (
    Curvature,
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
    SolidAngle,
    SphericalHarmonic,
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
    "Slope",
    "SolidAngle",
    "SphericalHarmonic",
    "Status",
    "Tolerance",
    "__version__",
    "backend",
    "cosine",
    "geometry",
    "level_set",
    "render",
    "rendering",
    "sine",
    "testing",
    "trace",
]
