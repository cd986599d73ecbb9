"""All crossings of rays, as users get them: NumPy in, NumPy out; Dr.Jit stays Dr.Jit."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.backend.arrays import gather_vectors
from harnack.backend.lengths import length as norm
from harnack.tracer.crossings import find_crossings
from harnack.tracer.derivatives import attach, refuse_derivative, wants_derivatives
from harnack.tracer.prepared import MarchResult
from harnack.tracer.tolerance import Status

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.tracer.surface import LevelSet


@dataclass(frozen=True)
class AllHits:
    """The first k crossings of n rays with the level set, in order: `trace(..., all_hits=k)`.

    As NumPy arrays, or as tensors if the rays were; if they were Dr.Jit arrays, as Dr.Jit arrays,
    in which (n, k) is flat: crossing j of ray i is at i k + j.

    t: (n, k) ray parameter of the crossing, inf where a ray has fewer. It lies between two points
        that were looked at, with f on different sides of the level, where the cubic through their
        values and slopes takes the level or, if there is a crease between them, where bisection
        finds it.
    position: (n, k, 3) point at t, NaN where there is none.
    normal: (n, k, 3) unit normal grad f/|grad f|, to the side of larger f; zero where there is
        none.
    sheet: (n, k) index of the sheet, such as a triangle, that was crossed; -1 where none was.
    side: (n, k) integers: 1 where f rises through the level along the ray, -1 where it falls
        through it, 0 where there is no crossing.
    count: (n,) how many crossings there are, at most k.
    end: (n,) how far the ray was followed: inf if to its end; else up to where the last crossing
        was noticed, just behind it, or to where the ray ran out of steps.
    status: (n,) a `Status`, of the end of the ray. MISS: it is proved that there are no other
        crossings. HIT: there are k, and what follows was not looked at. OUT_OF_STEPS: what follows
        `end` is not known.
    evaluations: (n,) how many times the field was evaluated.
    """

    t: Any
    position: Any
    normal: Any
    sheet: Any
    side: Any
    count: Any
    end: Any
    status: Any
    evaluations: Any


def check_all_hits(all_hits: Any, surface: LevelSet) -> int:
    """How many crossings to look for.

    Raises:
        TypeError: not an integer.
        ValueError: less than 1; or several levels of a field with sheets.
    """
    try:
        k = operator.index(all_hits)
    except TypeError:
        raise TypeError(
            "all_hits is how many crossings of a ray to look for, an integer such as 8, "
            f"not {all_hits!r}"
        ) from None
    if k < 1 or isinstance(all_hits, bool):
        raise ValueError(f"all_hits must be at least 1, such as 8, not {all_hits}")
    surface.check_crossings("all_hits")
    return k


def trace_all(
    surface: LevelSet,
    backend: Backend,
    o: Vec3,
    d: Vec3,
    near: Real,
    far: Real,
    k: int,
    *,
    differentiable: bool,
) -> AllHits:
    """The first k crossings, as Dr.Jit arrays."""
    prepared = surface.prepare(backend, crosses=True)
    with dr.suspend_grad():
        found = find_crossings(
            prepared, dr.detach(o), dr.detach(d), dr.detach(near), dr.detach(far), k
        )
        is_found = dr.isfinite(found.t)
        length = norm(found.gradient)
        normal = dr.select(length > 0, found.gradient / length, 0)
        dr.eval(*vars(found).values(), normal)
    ray = dr.arange(backend.UInt32, dr.width(found.t)) // k
    o, d = gather_vectors(backend, o, ray), gather_vectors(backend, d, ray)
    t, end = found.t, found.end
    if differentiable and wants_derivatives(prepared, o, d):
        with dr.suspend_grad():
            status = dr.select(is_found, backend.UInt32(int(Status.HIT)), int(Status.MISS))
            none = dr.zeros(backend.Float, dr.width(t))
            ends = MarchResult(t, none, found.gradient, none, none, status, found.sheet, found.side)
        t, normal = attach(prepared, o, d, ends, normal)
        normal = refuse_derivative(prepared, o, d, "normal", normal)
        end = refuse_derivative(prepared, o, d, "end", end)
    position = dr.select(dr.isfinite(t), dr.fma(backend.Array3f(t), d, o), dr.nan)
    side = backend.Int32(found.side)
    sheet = dr.reinterpret_array(backend.Int32, found.sheet)  # NO_SHEET becomes -1
    of_rays = found.count, end, found.status, found.evaluations
    hits = AllHits(t, position, normal, sheet, side, *of_rays)
    dr.eval(*vars(hits).values())
    return hits


def no_crossings(backend: Backend) -> AllHits:
    """Of no rays."""
    number, vector = dr.zeros(backend.Float, 0), dr.zeros(backend.Array3f, 0)
    count, side = dr.zeros(backend.UInt32, 0), dr.zeros(backend.Int32, 0)
    return AllHits(number, vector, vector, side, side, count, number, count, count)


def crossings_as_numpy(hits: AllHits, n: int, k: int) -> AllHits:
    """The same as NumPy arrays, of n rays."""

    def each(array: Any) -> Any:
        values = to_numpy(array)
        return values.reshape(n, k, *values.shape[1:])

    def of_ray(array: Any) -> Any:
        return np.broadcast_to(to_numpy(array), (n,)).copy()

    return AllHits(
        each(hits.t),
        each(hits.position),
        each(hits.normal),
        each(hits.sheet).astype(np.int64),
        each(hits.side).astype(np.int64),
        of_ray(hits.count).astype(np.int64),
        of_ray(hits.end),
        of_ray(hits.status).astype(np.int64),
        of_ray(hits.evaluations).astype(np.int64),
    )
