"""The closest points of a surface that lie on sheets of its field, such as the triangles of a mesh.

A sheet is part of the surface where f passes a level from one side of it to the other. Whether it
does at a point is what a short ray through the point tells, in the same arithmetic in which rays
meet the surface anywhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.fields.sheets import NO_SHEET, Crossing, NearestSheet
from harnack.tracer import Status

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.field import Field
    from harnack.tracer.prepared import PreparedLevelSet

__all__ = ["SheetSearch", "takes_level"]

# Half the length of a ray through a point of a sheet, in epsilons of coordinates.
_SHORT = 32.0
# A regular tetrahedron about the origin, turned so that none of its edges lies in a plane that
# meshes like to lie in; and its six edges.
_CORNERS = (
    (-1.271, -0.030, 1.177),
    (0.662, -1.591, -0.176),
    (1.243, 1.088, 0.520),
    (-0.634, 0.533, -1.521),
)
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3))
# In these lengths: how far about y f is looked at, where rounding of y does little to it.
_WIDER = 64.0
# Of the way to a sheet: so far f is looked at before it.
_BEFORE = 0.98

Next: TypeAlias = "Callable[[tuple[Any, Any], Any, Any], NearestSheet]"


@dataclass(frozen=True)
class SheetSearch:
    """The search for the closest point of a prepared surface that lies on a sheet.

    scale: at least the coordinates that the field computes with, for what rounding does.
    most: sheets that are looked at for each point.
    """

    surface: PreparedLevelSet
    scale: float
    most: int

    def closest(self, x: Vec3, limit: Real) -> tuple[Vec3, Vec3]:
        """A point of the surface on a sheet, nearer to x than `limit` (NaN where none is found),
        and the way from x to the nearest sheet, the surface or not, if it is nearer than that (else
        infinite).

        Sheets are looked at in the order of their distance, each at its nearest point y to x. A
        short ray through y along the sheet's normal meets the surface there, or the sheet is none
        at y. Where y lies on the sheet's rim that ray may slip past, and the six edges of a small
        tetrahedron about y follow: a surface through y separates its corners, and one that ends in
        a curve through y leaves it through two faces, so that either crosses an edge.

        The first sheet that is met is the closest point on sheets, unless a sheet nearer than that
        belongs to the surface elsewhere than at y: the point is one of the surface in any case.
        """
        backend = self.surface.backend
        real, index, vector = backend.Float, backend.UInt32, backend.Array3f
        following = self._following(x)
        most = dr.opaque(index, self.most)
        short = _SHORT * backend.epsilon * fmax(real(self.scale), dr.max(dr.abs(x)))
        limit = real(limit)
        nothing = NearestSheet(
            real(-1), index(NO_SHEET), vector(dr.inf), vector(0), backend.Bool(False)
        )

        def body(*state: Any) -> tuple[Any, ...]:
            last = NearestSheet(*state[:5])
            probe, foot, nearest, n, active = state[5:]
            fresh = active & (probe == 0)
            found = following((last.order, last.sheet), limit, fresh)
            near = _where(fresh, found, last)
            active &= near.sheet != NO_SHEET
            nearest = dr.select(active & fresh & (n == 0), near.offset, nearest)
            y = x + near.offset
            start, end = _probe(vector, probe, near.normal)
            met, sheet, at = self._meets(y, short, start, end, active)
            at = dr.select((sheet == near.sheet) & (probe == 0), y, at)
            foot = dr.select(met, at, foot)
            n = n + dr.select(fresh, index(1), 0)
            last_probe = near.is_inner | (probe == len(_EDGES))
            active &= ~met & ~(last_probe & (n >= most))
            probe = dr.select(last_probe, index(0), probe + 1)
            return *_parts(near), probe, foot, nearest, n, active

        def more(*state: Any) -> Mask:
            return state[-1]

        start = (
            *_parts(nothing), index(0), vector(dr.nan), vector(dr.inf), index(0),
            backend.Bool(True),
        )  # fmt: skip
        *_, foot, nearest, _, _ = dr.while_loop(start, more, body, label="sheets in turn")
        return foot, nearest

    def _meets(
        self, y: Vec3, short: Real, start: Vec3, end: Vec3, active: Mask
    ) -> tuple[Mask, Any, Vec3]:
        """Whether the way between two points about y, in lengths of `short`, meets the surface; the
        sheet that it meets, and where."""
        backend = self.surface.backend
        real, vector = backend.Float, backend.Array3f
        o = dr.fma(vector(short), start, y)
        way, length = (end - start) / dr.norm(end - start), dr.norm(end - start)
        seen = self.surface.first_hit(o, way, real(0), short * length, active)
        met = active & (seen.status == int(Status.HIT))
        # To first order any level is near where the gradient has no bound, as at the sheet's rim.
        met &= takes_level(self.surface, y, _WIDER * short, met)
        return met, seen.sheet, dr.fma(vector(seen.t), way, o)

    def _following(self, x: Vec3) -> Next:
        """The sheets of the field in turn; where it does not tell them, the nearest alone."""
        field, backend = self.surface.field, self.surface.backend
        real, index = backend.Float, backend.UInt32
        probe = field.nearest_sheet(x, (real(-1), index(NO_SHEET)), real(0), backend.Bool(False))
        if probe is None:
            only = _by_differences(backend, field, x)

            def once(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestSheet:
                del active
                fresh = (after[0] < 0) & (only.order < limit)
                order = dr.select(fresh, only.order, dr.inf)
                sheet = dr.select(fresh, only.sheet, index(NO_SHEET))
                return NearestSheet(order, sheet, only.offset, only.normal, only.is_inner)

            return once

        def told(after: tuple[Real, Any], limit: Real, active: Mask) -> NearestSheet:
            found = field.nearest_sheet(x, after, limit, active)
            if found is None:
                raise RuntimeError("nearest_sheet tells sheets at some times and not at others")
            return found

        return told


def takes_level(surface: PreparedLevelSet, y: Vec3, radius: Real, active: Mask) -> Mask:
    """Whether f is seen on both sides of a level about y, no farther than 1.74 radii away.

    f is looked at in the corners of a tetrahedron and, on its edges, just before a sheet. Where two
    of these places are on different sides of a level, the surface lies on the way between them:
    f passes the level on it steadily, or by a jump. That needs no gradient, which has no bound at
    the rims of sheets: f takes all values between those on both sides of the sheet there, and no
    others.
    """
    backend, field = surface.backend, surface.field.without_truncation(surface.backend)
    real, index, vector = backend.Float, backend.UInt32, backend.Array3f
    nowhere = vector(0)

    def body(k: Any, low: Real, high: Real, active: Mask) -> tuple[Any, ...]:
        start, end = _probe(vector, k + 1, nowhere)
        o = dr.fma(vector(radius), start, y)
        length = dr.norm(end - start)
        way, reach = (end - start) / length, radius * length
        behind = Crossing(real(0), index(NO_SHEET), real(0), nowhere)
        t = real(field.next_crossing(o, way, behind, reach, active).t)
        inside = dr.select(t < reach, t, 0.5 * reach)
        for share in (real(0), _BEFORE * inside):
            value = real(field.evaluate(dr.fma(vector(share), way, o)).value)
            low, high = fmin(low, value), fmax(high, value)
        return k + 1, low, high, active & (k + 1 < len(_EDGES))

    def more(*state: Any) -> Mask:
        return state[-1]

    start = index(0), real(dr.inf), real(-dr.inf), backend.Bool(active)
    _, low, high, _ = dr.while_loop(start, more, body, label="sides of a level")
    return (low < high) & (surface.levels.gaps(low).up < high - low)


def _parts(near: NearestSheet) -> tuple[Any, ...]:
    return near.order, near.sheet, near.offset, near.normal, near.is_inner


def _where(mask: Mask, one: NearestSheet, other: NearestSheet) -> NearestSheet:
    pairs = zip(_parts(one), _parts(other), strict=True)
    return NearestSheet(*(dr.select(mask, a, b) for a, b in pairs))


def _probe(vector: Any, number: Any, normal: Vec3) -> tuple[Vec3, Vec3]:
    """Both ends of a probe about the origin: along the normal, then the tetrahedron's edges."""
    start, end = -normal, normal
    for k, (i, j) in enumerate(_EDGES):
        start = dr.select(number == k + 1, vector(*_CORNERS[i]), start)
        end = dr.select(number == k + 1, vector(*_CORNERS[j]), end)
    return start, end


def _by_differences(backend: Backend, field: Field, x: Vec3) -> NearestSheet:
    """The nearest sheet to x, from its distance d alone: along the way on which d falls.

    Central differences over h = r d are off by r^2, and by epsilon s/(r d) as rounding moves d by
    epsilon s, s the size of coordinates: with r = (epsilon s/d)^(1/3) both are small down to
    distances of a few roundings. There any direction serves: y = x is on the sheet to rounding.
    """
    real, vector = backend.Float, backend.Array3f
    d = real(field.distance_to_sheets(x))
    size = fmax(dr.max(dr.abs(x)), d)
    h = d * fmin(dr.cbrt(backend.epsilon * size / d), 0.5)
    rate: list[Real] = []
    for axis in range(3):
        move = vector(*(h if k == axis else 0 for k in range(3)))
        ahead, back = (field.distance_to_sheets(q) for q in (x + move, x - move))
        rate.append(back - ahead)
    fall = vector(*rate)
    gradient_norm = dr.norm(fall)
    has_direction = (gradient_norm > 0.2 * h) & (d > 64 * backend.epsilon * size)
    way = dr.select(has_direction, fall / gradient_norm, vector(1 / math.sqrt(3)))
    offset = dr.select(has_direction, d * way, 0)
    return NearestSheet(d, backend.UInt32(0), offset, way, backend.Bool(False))
