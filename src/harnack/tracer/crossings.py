"""All crossings of rays with level sets, one after the other, while a kernel is recorded."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.loops import while_active
from harnack.tracer.tolerance import Status

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.march import MarchState
    from harnack.tracer.prepared import PreparedLevelSet


@dataclass(frozen=True)
class CrossingsFound:
    """The first k crossings of n rays, as Dr.Jit arrays.

    t: (n k) of crossing j of ray i at i k + j; inf where there are fewer.
    gradient: (n k, 3) of f there; 0 where there is none.
    side: (n k) 1 where f rises through the level along the ray, -1 where it falls, 0 for none.
    count: (n) how many there are, at most k.
    end: (n) how far the ray was followed; inf if it was to its end.
    evaluations, status: (n). HIT: k crossings, and what follows was not looked at. MISS: there are
        no others.
    """

    t: Real
    gradient: Vec3
    side: Real
    count: Any
    end: Real
    evaluations: Any
    status: Any


@dataclass(frozen=True)
class _Walk:
    """Where rays are, and how many crossings they have behind them."""

    march: MarchState
    count: Any

    @property
    def active(self) -> Mask:
        return self.march.active


def find_crossings(
    prepared: PreparedLevelSet, o: Vec3, d: Vec3, t_min: Real, t_max: Real, k: int
) -> CrossingsFound:
    """The first k crossings of rays o + t d, |d| = 1, for t_min <= t <= t_max.

    What is guaranteed, and why, is in `Hysteresis`: between two crossings the ray is one march, in
    which a contact may begin and end as often as it likes.
    """
    backend = prepared.backend
    real, vector, count = backend.Float, backend.Array3f, backend.UInt32
    march, path, start, end, state = prepared.ready(o, d, t_min, t_max, True, crosses=True)
    n = max(dr.width(array) for array in (path.origin, path.direction, start, end))
    place = dr.arange(count, n) * k
    # Filled in from within the loop, so they must lie in memory before it is recorded.
    t, side = dr.full(real, dr.inf, n * k), dr.zeros(real, n * k)
    gradient = dr.zeros(vector, n * k)
    dr.make_opaque(t, side, gradient)

    def one(now: _Walk) -> _Walk:
        after = march.advance(prepared.field, path, end, now.march)
        contact = after.contact
        assert contact is not None
        found = now.active & (after.status == int(Status.HIT))
        slot = place + now.count
        dr.scatter(t, contact.root, slot, found)
        dr.scatter(side, contact.side, slot, found)
        dr.scatter(gradient, contact.gradient, slot, found)
        crossings = now.count + dr.select(found, count(1), 0)
        more = found & (crossings < k)
        free = after.base + after.reach >= end
        status = dr.select(more & free, count(int(Status.MISS)), after.status)
        march_on = dataclasses.replace(after, status=status, active=more & ~free)
        return _Walk(march_on, crossings)

    walk = while_active(_Walk(state, dr.zeros(count, n)), one, "harnack crossings")
    last = walk.march
    followed = dr.select(last.status == int(Status.MISS), dr.inf, last.base)
    return CrossingsFound(t, gradient, side, walk.count, followed, last.evaluations, last.status)
