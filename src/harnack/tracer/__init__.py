"""Finds first hits and crossings of rays with level sets of a function: the points at which it
takes a given value. Every step along a ray is proved.
"""

from __future__ import annotations

from harnack.tracer.hits import Hits, trace
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.ray_crossings import RayCrossings, crossings
from harnack.tracer.surface import Side, Surface
from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer
from harnack.tracer.trace_options import TraceKeywords, TraceOptions
from harnack.tracer.traced_surface import TracedSurface, traced_surface

__all__ = [
    "HitTolerance",
    "Hits",
    "MarchResult",
    "RayCrossings",
    "RayStatus",
    "Side",
    "Surface",
    "SurfaceTracer",
    "TraceKeywords",
    "TraceOptions",
    "TracedSurface",
    "crossings",
    "trace",
    "traced_surface",
]
