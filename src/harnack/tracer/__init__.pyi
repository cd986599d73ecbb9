"""The names of the package, and where they are."""

from .hits import ClearanceHits, Hits, trace
from .level_contact import HitTolerance, RayStatus
from .ray_crossings import RayCrossings, crossings
from .surface import Side, Surface
from .surface_tracer import MarchResult, SurfaceTracer
from .trace_options import TraceKeywords, TraceOptions
from .traced_surface import TracedSurface, traced_surface

__all__ = [
    "ClearanceHits",
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
