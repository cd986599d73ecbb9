"""Volumes bounded by planes, and the loop over their planes."""

from __future__ import annotations

import abc
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import Backend, Mask, Real, Vec3, aligned, backend_of
from harnack.geometry.convex_volume import (
    BoolArray,
    FloatArray,
    Volume,
    as_points,
    emptied,
    larger,
    rounding,
    smaller,
)

MAX_UNROLLED = 24
"""Up to this many planes the loop is unrolled into the kernel."""

State = TypeVar("State", bound=tuple[Any, ...])


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes n.x <= h as rows (n, h) of four numbers, in a buffer of the backend.

    length is the number of planes as a kernel parameter, so that the loop over many planes is
    compiled once for all volumes.
    """

    backend: Backend
    planes: int
    buffer: Any
    length: Any

    @staticmethod
    def upload(backend: Backend, rows: FloatArray) -> PlaneTable:
        """The table of rows (m, 4). A normal of length 0 and h = 0 would be no constraint."""
        buffer = aligned(backend, rows.ravel())
        length = dr.opaque(backend.UInt32, len(rows))
        return PlaneTable(backend, len(rows), buffer, length)

    def fold(self, state: State, step: Callable[[State, Vec3, Real], State]) -> State:
        """state = step(state, n, h) for every plane."""
        index = self.backend.UInt32
        if self.planes <= MAX_UNROLLED:
            for k in range(self.planes):
                state = step(state, *self._row(index(k)))
            return state

        def body(k: Any, *inner: Any) -> tuple[Any, ...]:
            after: Any = step(inner, *self._row(k))  # pyright: ignore[reportArgumentType]
            return (k + 1, *after)

        loop: Any = dr.while_loop  # its overloads do not know run-time array types
        result: Any = loop(
            state=(index(0), *state),
            cond=lambda k, *_: k < self.length,  # pyright: ignore
            body=body,
            label="planes",
        )
        return result[1:]

    def _row(self, k: Any) -> tuple[Vec3, Real]:
        row: Any = dr.gather(self.backend.Array4f, self.buffer, k)
        return self.backend.Array3f(row.x, row.y, row.z), row.w


@dataclass(frozen=True, eq=False)
class LiteralPlanes:
    """Planes written into the kernel as numbers: for volumes that were not prepared."""

    backend: Backend
    rows: FloatArray

    def fold(self, state: State, step: Callable[[State, Vec3, Real], State]) -> State:
        """state = step(state, n, h) for every plane."""
        for n, h in self._literals():
            state = step(state, n, h)
        return state

    def _literals(self) -> Iterator[tuple[Vec3, Real]]:
        for row in self.rows:
            x, y, z, h = (float(v) for v in row)
            yield self.backend.Array3f(x, y, z), self.backend.Float(h)


class Polytope(Volume):
    """The intersection of the half-spaces n.x <= h, with unit normals n.

    Rounding: with u the unit roundoff, the computed N = h - n.o and D = n.d are off by at most
    a few u times |n|.|o| + |h| and |n|.|d|. Adding such a bound to N and taking it from D, for
    t >= 0, turns N - t D >= 0 into a condition that every point of the volume still meets; it
    needs no case for rays parallel to a plane except D = 0, which is then exact.
    """

    @abc.abstractmethod
    def planes(self) -> FloatArray:
        """Rows (nx, ny, nz, h), shape (m, 4), float64, all finite."""

    @abc.abstractmethod
    def _uploaded(self) -> PlaneTable | None:
        """The planes on a backend, if `prepare` put them there."""

    def _table(self, backend: Backend) -> PlaneTable | LiteralPlanes:
        table = self._uploaded()
        if table is not None and table.backend == backend:
            return table
        rows = self.planes()
        is_recording = dr.flag(dr.JitFlag.SymbolicScope)  # nothing can be uploaded then
        if len(rows) <= MAX_UNROLLED or is_recording:
            return LiteralPlanes(backend, rows)
        return PlaneTable.upload(backend, rows)

    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        backend = backend_of(o)
        eps = rounding(backend)
        abs_o, abs_d = dr.abs(o), dr.abs(d)

        def step(state: tuple[Real, Real], n: Vec3, h: Real) -> tuple[Real, Real]:
            t0, t1 = state
            abs_n = dr.abs(n)
            room = h - dr.dot(n, o) + eps * (dr.dot(abs_n, abs_o) + dr.abs(h))
            speed = dr.dot(n, d) - eps * dr.dot(abs_n, abs_d)
            t = room / speed
            leaving, entering = speed > 0, speed < 0
            outside = ~(leaving | entering) & (room < 0)
            t0 = dr.select(entering, larger(t, t0), t0)
            t1 = dr.select(leaving, smaller(t, t1), t1)
            return t0, dr.select(outside, -dr.inf, t1)

        lanes = dr.zeros(backend.Float, dr.width(o, d, t_min, t_max))
        start = (lanes + t_min, lanes + t_max)
        return emptied(*self._table(backend).fold(start, step))

    def contains(self, p: Vec3) -> Mask:
        backend = backend_of(p)
        eps = rounding(backend)
        abs_p = dr.abs(p)

        def step(state: tuple[Mask], n: Vec3, h: Real) -> tuple[Mask]:
            slack = eps * (dr.dot(dr.abs(n), abs_p) + dr.abs(h))
            return (state[0] & (dr.dot(n, p) - h <= slack),)

        everywhere = dr.full(backend.Bool, True, dr.width(p))
        return self._table(backend).fold((everywhere,), step)[0]

    def signed_distance(self, p: Vec3) -> Real:
        return self._nearest_plane(p)[0]

    def outward_normal(self, p: Vec3) -> Vec3:
        return self._nearest_plane(p)[1]

    def _nearest_plane(self, p: Vec3) -> tuple[Real, Vec3]:
        backend = backend_of(p)

        def step(state: tuple[Real, Vec3], n: Vec3, h: Real) -> tuple[Real, Vec3]:
            distance = dr.dot(n, p) - h
            nearer = distance > state[0]
            return dr.select(nearer, distance, state[0]), dr.select(nearer, n, state[1])

        width = dr.width(p)
        start = (
            dr.full(backend.Float, -dr.inf, width),
            backend.Array3f(0, 0, 1) + dr.zeros(backend.Array3f, width),
        )
        return self._table(backend).fold(start, step)

    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        x = as_points(points)
        rows = self.planes()
        inside = np.ones(len(x), dtype=np.bool_)
        for row in rows:
            n, h = row[:3], float(row[3])
            slack = 8.0 * sys.float_info.epsilon * (np.abs(x) @ np.abs(n) + abs(h))
            inside &= x @ n - h <= slack
        return inside
