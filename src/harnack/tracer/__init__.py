"""First hits of rays with level sets, every step proved."""

from __future__ import annotations

from harnack.tracer.crossings import RayCrossings
from harnack.tracer.hits import Hits, trace
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.surface import Surface, level_set
from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer

__all__ = [
    "HitTolerance",
    "Hits",
    "MarchResult",
    "RayCrossings",
    "RayStatus",
    "Surface",
    "SurfaceTracer",
    "level_set",
    "trace",
]
