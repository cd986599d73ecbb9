"""Guaranteed ray tracing of harmonic and other implicit surfaces.

    import harnack as hk
    hits = hk.trace(hk.SolidAngle(vertices), origins, directions)
"""

from __future__ import annotations

# First of all imports: it decides which LLVM Dr.Jit loads, which happens on `import drjit`.
from harnack import backend
from harnack._version import __version__
from harnack.bounds import Bound, Caps, Classic, LipschitzStep, Longest, Slope
from harnack.fields import Field, HarmonicBall, Lipschitz, Sample, SolidAngle
from harnack.geometry import Ball, Box, ConvexHull, HalfSpace, Intersection
from harnack.tracer import Hits, LevelSet, Status, Tolerance, level_set, trace

__all__ = [
    "Ball",
    "Bound",
    "Box",
    "Caps",
    "Classic",
    "ConvexHull",
    "Field",
    "HalfSpace",
    "HarmonicBall",
    "Hits",
    "Intersection",
    "LevelSet",
    "Lipschitz",
    "LipschitzStep",
    "Longest",
    "Sample",
    "Slope",
    "SolidAngle",
    "Status",
    "Tolerance",
    "__version__",
    "backend",
    "level_set",
    "trace",
]
