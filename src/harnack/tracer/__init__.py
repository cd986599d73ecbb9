"""First hits of rays with level sets, every step proved."""

from __future__ import annotations

from harnack.tracer.all_hits import AllHits
from harnack.tracer.contact import Status, Tolerance
from harnack.tracer.hits import Hits, trace
from harnack.tracer.prepared import MarchResult, PreparedLevelSet
from harnack.tracer.surface import LevelSet, level_set

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
