"""`signed_distance`: how far points are from a level set, by four methods."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, get_args

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.choices import did_you_mean
from harnack.distance.batches import in_batches
from harnack.distance.closest import Closest, find_closest
from harnack.distance.estimates import first_order, second_order
from harnack.enclosures import TargetLevels
from harnack.fields.clearance import distance_below
from harnack.fields.field import Field
from harnack.tracer import level_set

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.tracer import LevelSet

__all__ = ["Method", "closest_points", "signed_distance"]

Method = Literal["first", "second", "newton", "lower"]
# As close as rounding allows: the tracer raises it to that.
_CLOSE = 1e-15


def signed_distance(
    field: Field,
    points: Any,
    *,
    level: Any = None,
    method: Method = "newton",
    precision: Precision = "double",
) -> FloatArray:
    """Signed distances (n,) from points (n, 3) to a level set: positive where f > level.

    level: the level, by default the field's own; several mean the nearest one in value. Of an
        angle-valued field every level stands for all that differ from it by periods, and the sign
        is that of the one nearest in value.
    method:
        "first": (f - level)/|grad f|. Off by O(d^2) at distance d; infinite where grad f = 0.
        "second": the same with the curvature of f along its gradient. Off by O(d^3); needs the
            field's `hessian`.
        "newton": to a point of the surface found by search, the closest in its neighbourhood
            (`closest_points`). Exact to rounding if it is the closest of all, else too long in
            size: an upper bound, and never below what "lower" proves but for rounding. NaN, with a
            RuntimeWarning that counts them, where no surface is found at all, as where there is
            none, or only within a radius that the field promises to be free.
            The slowest by far: some hundred evaluations, and as many rays for points beside sheets
            that are not the surface.
        "lower": never longer in size than the true distance, with proof: no level lies in the
            ball of that radius about the point, not even outside the field's domain. Of first
            order too: the nearer the surface, the smaller the share that it falls short by.
        Of a field that jumps across sheets, "first" and "second" see the smooth part of the
        surface, and the nearest sheet if that is nearer and the surface lies there.
    precision: of the computation; "lower" allows for rounding in both.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers, an unknown
            method, a level that no surface has or, with "lower", points outside the field's
            domain, where it promises nothing.
        NotImplementedError: "second" with a field that has no second derivatives.
    """
    if method not in get_args(Method):
        known = ", ".join(f'"{one}"' for one in get_args(Method))
        hint = did_you_mean(method, get_args(Method))
        raise ValueError(f"unknown method {method!r}; choose one of {known}{hint}")
    backend = choose_backend(precision)
    surface = _surface(field, level)
    levels = _levels(backend, surface)
    if method == "newton":
        found = find_closest(backend, surface, levels, points, _silent)
        _warn("signed_distance", found)
        return np.copysign(found.distance, found.above)
    prepared = field.prepare(backend)
    compute = _COMPUTE[method]

    def of_points(p: Vec3) -> tuple[Real | Vec3, ...]:
        return p, compute(backend, prepared, levels, p)

    x, result = in_batches(backend, of_points, points)
    if method == "lower":
        _check_domain(field, x)
    if field.has_sheets and method != "lower":
        to_sheet = find_closest(backend, surface, levels, x, _silent).distance
        result = np.copysign(np.fmin(to_sheet, np.abs(result)), result)
    return result


def closest_points(
    field: Field, points: Any, *, level: Any = None, precision: Precision = "double"
) -> FloatArray:
    """The closest points (n, 3) of a level set to `points` (n, 3) that a search finds.

    Each lies on the surface to rounding, and no point of the surface in its neighbourhood is
    nearer; one elsewhere may be, though several descents are tried (`find_closest`). Of sheets,
    such as the triangles of a mesh, the nearest that is the surface is found, and where a nearer
    one is not, rays look for what may be nearer, such as a crease in which two meet. The curve in
    which the level sets of a field end counts as part of them, such as the vertices and edges of
    a solid angle. Where every descent ends at a critical or singular point of f, or outside the
    field's domain, the nearest point of the surface that some rays find is taken, and from there
    as far down as descent leads: that need not be a minimum, such as where the rim of a surface
    cut by the domain is closest. NaN, with a RuntimeWarning that counts them, where rays find no
    surface either.

    Raises:
        TypeError, ValueError: as `signed_distance`.
    """
    backend = choose_backend(precision)
    surface = _surface(field, level)
    found = find_closest(backend, surface, _levels(backend, surface), points, _silent)
    _warn("closest_points", found)
    return found.feet


def _silent(message: str) -> None:
    del message


def _surface(field: Field, level: Any) -> LevelSet:
    if field.has_sheets and type(field).distance_to_sheets is Field.distance_to_sheets:
        raise NotImplementedError(
            f"{type(field).__name__} has sheets but does not say how far they are: define its "
            "method distance_to_sheets(p)"
        )
    return level_set(field, level, tolerance=_CLOSE, overstep=1.0)


def _levels(backend: Backend, surface: LevelSet) -> TargetLevels:
    values = tuple(
        one if dr.is_array_v(type(one)) else dr.opaque(backend.Float, float(one))
        for one in surface.levels
    )
    return TargetLevels(values, surface.field.period)


def _warn(name: str, found: Closest) -> None:
    """Of points without an answer, and of answers that a promise of the field contradicts."""
    n = len(found.feet)
    unresolved = int(np.isnan(found.feet[:, 0]).sum())
    if unresolved:
        warnings.warn(
            f"{name}: no closest point was found for {unresolved} of {n} points (NaN): no descent "
            "from there ends on the surface, and no ray that was tried meets it",
            RuntimeWarning,
            stacklevel=3,
        )
    refused = int(found.is_refused.sum())
    if refused:
        warnings.warn(
            f"{name}: for {refused} of {n} points, points of the surface were found within the "
            "radius that the field's own promises prove to be free of it, and left out: the "
            "promises in `Sample.known` do not hold (harnack.testing.check_field tests them)",
            RuntimeWarning,
            stacklevel=3,
        )


def _check_domain(field: Field, points: FloatArray) -> None:
    if field.domain is None or not len(points):
        return
    outside = np.flatnonzero(~field.domain.contains_points(points))
    if outside.size:
        rest = f" and {outside.size - 1} more" if outside.size > 1 else ""
        raise ValueError(
            f"points: entry {outside[0]}{rest} outside the domain of {type(field).__name__}, where "
            "it promises nothing; leave such points out, or give the field a larger domain"
        )


def _first(backend: Backend, field: Field, levels: TargetLevels, p: Vec3) -> Real:
    del backend
    sample = field.evaluate(p)
    return first_order(-levels.to_nearest(sample.value), sample.gradient)


def _second(backend: Backend, field: Field, levels: TargetLevels, p: Vec3) -> Real:
    del backend
    sample, rows = field.evaluate(p), field.hessian(p)
    return second_order(-levels.to_nearest(sample.value), sample.gradient, rows)


def _lower(backend: Backend, field: Field, levels: TargetLevels, p: Vec3) -> Real:
    sample = field.evaluate(p)
    above = -levels.to_nearest(sample.value)
    return dr.copysign(distance_below(backend, field, levels, p, sample), above)


_COMPUTE: dict[str, Callable[[Backend, Field, TargetLevels, Vec3], Real]] = {
    "first": _first,
    "second": _second,
    "lower": _lower,
}
