"""Many rays by few lanes: one that has followed a ray to its end fetches the next.

Rays differ in length, and a packet of a processor waits for its longest. Bounces of light paths go
in all directions: there the longest ray of a packet took three to six times as many looks as the
mean one (measured).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from harnack.backend.lanes import while_queued
from harnack.fields.look import Path
from harnack.fields.sheets import NO_SHEET

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.enclosures import Proofs
    from harnack.fields.field import Field
    from harnack.tracer.march import March, MarchState

__all__ = ["PlainTracer", "RayTracer", "TracerOf", "trace_queued"]


class RayTracer(Protocol):
    """A walk that advances each ray by one item a turn: a trial point, a sheet, or a part."""

    def begin(self, state: MarchState) -> Any:
        """Rays at their start."""
        ...

    def next(self, walk: Any, /) -> Any:
        """One station more."""
        ...

    def end_of(self, walk: Any, /) -> tuple[MarchState, Any]:
        """The state of rays, and the index of the sheet or part that each hit."""
        ...

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The same, of rays that are followed to their end."""
        ...


# From a path, its start and its end.
TracerOf: TypeAlias = "Callable[[Path, Real, Real], RayTracer]"


@dataclass(frozen=True)
class PlainTracer:
    """Rays through a field that is continuous and has no parts."""

    march: March
    field: Field
    path: Path
    end: Real

    def begin(self, state: MarchState) -> MarchState:
        """Rays at their start."""
        return state

    def next(self, walk: MarchState) -> MarchState:
        """One trial more."""
        return self.march.next_trial(self.field, self.path, self.end, walk)

    def end_of(self, walk: MarchState) -> tuple[MarchState, Any]:
        """The state of rays; none hit a sheet."""
        return walk, self.march.backend.UInt32(NO_SHEET)

    def run(self, state: MarchState) -> tuple[MarchState, Any]:
        """The end state of rays (`March.advance` has the proof)."""
        return self.end_of(self.march.advance(self.field, self.path, self.end, state))


@dataclass(frozen=True)
class _Ray:
    """A ray from start to end, and where it is: all that a lane knows."""

    origin: Vec3
    direction: Vec3
    start: Real
    end: Real
    walk: Any

    @property
    def active(self) -> Mask:
        return self.walk.active


def trace_queued(
    tracer_of: TracerOf, path: Path, start: Real, end: Real, state: MarchState
) -> tuple[MarchState, Any]:
    """What `RayTracer.run` finds, with a queue: the same numbers, evaluated."""
    proofs: Proofs = path.proofs

    def tracer(ray: _Ray) -> RayTracer:
        return tracer_of(Path(ray.origin, ray.direction, proofs), ray.start, ray.end)

    def one(ray: _Ray) -> _Ray:
        return dataclasses.replace(ray, walk=tracer(ray).next(ray.walk))

    begun = tracer_of(path, start, end).begin(state)
    rays = _Ray(path.origin, path.direction, start, end, begun)
    walk = while_queued(rays, one, lambda ray: ray.walk, "harnack queue")
    return tracer(rays).end_of(walk)
