"""All crossings of rays with level sets, one after the other, while a kernel is recorded."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.arrays import gather_vectors
from harnack.backend.loops import while_active
from harnack.fields.sheets import NO_SHEET
from harnack.tracer.contact import Contact
from harnack.tracer.tolerance import Status
from harnack.tracer.walks.stretches import SheetTracer, SheetWalk

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.march import MarchState
    from harnack.tracer.prepared import PreparedLevelSet


@dataclass(frozen=True)
class CrossingsFound:
    """The first k crossings of n rays, as Dr.Jit arrays.

    t: (n k) of crossing j of ray i at i k + j; inf where there are fewer.
    gradient: (n k, 3) of f there, of a sheet its normal; 0 where there is none.
    sheet: (n k) index of the sheet that was crossed, NO_SHEET for none.
    side: (n k) 1 where f rises through the level along the ray, -1 where it falls, 0 for none.
    count: (n) how many there are, at most k.
    end: (n) how far the ray was followed; inf if it was to its end.
    evaluations, status: (n). HIT: k crossings, and what follows was not looked at. MISS: there are
        no others.
    """

    t: Real
    gradient: Vec3
    sheet: Any
    side: Real
    count: Any
    end: Real
    evaluations: Any
    status: Any


@dataclass(frozen=True)
class _Walk:
    """Where rays are, and how many crossings they have behind them.

    sheets: where they are among sheets, whose state of the march is a part of it; None of a field
        without sheets.
    """

    march: MarchState | None
    sheets: SheetWalk | None
    count: Any

    @property
    def active(self) -> Mask:
        return self.now.active

    @property
    def now(self) -> MarchState:
        """The state of the march."""
        state = self.march if self.sheets is None else self.sheets.march
        assert state is not None
        return state

    def moved(self, now: MarchState, count: Any) -> _Walk:
        """The same walk with another state of the march."""
        if self.sheets is None:
            return _Walk(now, None, count)
        return _Walk(None, dataclasses.replace(self.sheets, march=now), count)


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
    before, behind = dr.zeros(real, n * k), dr.zeros(real, n * k)
    gradient, sheets = dr.zeros(vector, n * k), dr.full(count, NO_SHEET, n * k)
    dr.make_opaque(t, side, before, behind, gradient, sheets)
    tracer = SheetTracer(march, prepared.field, path, start, end)

    def one(now: _Walk) -> _Walk:
        there, sheet = now, None
        if now.sheets is None:
            after = march.advance(prepared.field, path, end, now.now)
        else:
            walk = tracer.next(now.sheets)
            there = _Walk(None, walk, now.count)
            after, sheet = tracer.end_of(walk)
        contact = after.contact
        assert contact is not None
        found = now.active & (after.status == int(Status.HIT))
        slot = place + now.count
        dr.scatter(t, contact.root, slot, found)
        dr.scatter(side, contact.side, slot, found)
        dr.scatter(before, contact.before, slot, found)
        dr.scatter(behind, contact.behind, slot, found)
        dr.scatter(gradient, contact.gradient, slot, found)
        if sheet is not None:
            dr.scatter(sheets, sheet, slot, found)
        crossings = now.count + dr.select(found, count(1), 0)
        more = found & (crossings < k)
        status = dr.select(more, count(int(Status.MISS)), after.status)
        if now.sheets is None:
            more &= after.base + after.reach < end
        else:
            more |= after.active
        return there.moved(dataclasses.replace(after, status=status, active=more), crossings)

    begun = _Walk(state, None, dr.zeros(count, n))
    if prepared.field.has_sheets:
        begun = _Walk(None, tracer.begin(state), dr.zeros(count, n))
    walk = while_active(begun, one, "harnack crossings")
    last = walk.now
    ray, none = dr.arange(count, n * k) // k, real(0)
    roots = Contact(side, backend.Bool(False), t, gradient, none, before, behind)
    origins, directions = gather_vectors(backend, o, ray), gather_vectors(backend, d, ray)
    t, gradient, looks = prepared.settled(origins, directions, roots, dr.isfinite(t))
    evaluations = last.evaluations + dr.block_reduce(dr.ReduceOp.Add, looks, k)
    followed = dr.select(last.status == int(Status.MISS), dr.inf, last.base)
    return CrossingsFound(t, gradient, sheets, side, walk.count, followed, evaluations, last.status)
