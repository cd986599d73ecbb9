"""First hits of rays with level sets, every step proved."""

from __future__ import annotations

from harnack.tracer.crossings import AllHits
from harnack.tracer.hits import Hits, trace
from harnack.tracer.level_contact import Status, Tolerance
from harnack.tracer.surface import LevelSet, level_set
from harnack.tracer.surface_tracer import MarchResult, PreparedLevelSet

__all__ = [
    "AllHits",
    "Hits",
    "LevelSet",
    "MarchResult",
    "PreparedLevelSet",
    "Status",
    "Tolerance",
    "level_set",
    "trace",
]
