"""`signed_distance`: how far points are from a level set, by four methods."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.backend.validation import refuses_derivatives
from harnack.cluster.dask_arrays import takes_blocks
from harnack.distance.closest_point_search import Closest, find_closest
from harnack.distance.tangent_plane import first_order, in_batches, second_order
from harnack.enclosures import TargetLevels
from harnack.fields.clearance import distance_below
from harnack.fields.field import Field, check_is_field
from harnack.name_suggestions import did_you_mean, is_one_of
from harnack.progress import teller
from harnack.tracer import level_set

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.tracer import LevelSet

__all__ = ["DistanceBounds", "Method", "closest_points", "distance_bounds", "signed_distance"]

Method = Literal["first", "second", "newton", "lower"]
# As close as rounding allows: the tracer raises it to that.
_CLOSE = 1e-15


@takes_blocks("points")
@refuses_derivatives
def signed_distance(
    field: Field,
    points: Any,
    *,
    level: Any = None,
    method: Method = "newton",
    precision: Precision = "double",
    progress: Callable[[str], None] | None = None,
) -> FloatArray:
    """Signed distances (n,) from points (n, 3) to a level set: positive where f > level.

    level: the level, by default the field's own; several mean the nearest one in value. Of an
        angle-valued field every level stands for all that differ from it by periods, and the sign
        is that of the one nearest in value.
    method:
        "first": (f - level)/|grad f|. Off by O(d^2) at distance d; infinite where grad f = 0.
        "second": the same with the curvature of f along its gradient. Off by O(d^3); needs the
            field's `hessian`.
        "newton": to the nearest point of the surface that a search finds (`closest_points` says
            how): an upper bound of the distance, exact to rounding if that is the nearest of all.
            `distance_bounds` says what is proved about it. Of a closed triangle mesh, and of the
            boundary of the solid of one, it is exact to rounding. NaN, with a RuntimeWarning that
            counts them, where no surface is found at all, as where there is none, or only within a
            radius that the field promises to be free.
        "lower": never longer in size than the true distance, with proof: no level lies in the
            ball of that radius about the point, not even outside the field's domain. Of first
            order too: the nearer the surface, the smaller the share that it falls short by.
        Of a field that jumps across sheets, "first" and "second" see the smooth part of the
        surface, and the nearest sheet if that is nearer and the surface lies there.
    precision: of the computation; "lower" allows for rounding in both. The search of "newton" is
        done in double precision in any case.
    progress: told what is being done.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers, an unknown
            method, a level that no surface has or, with "lower", points outside the field's
            domain, where it promises nothing.
        NotImplementedError: "second" with a field that has no second derivatives.
    """
    if not is_one_of(method, get_args(Method)):
        known = ", ".join(f'"{one}"' for one in get_args(Method))
        hint = did_you_mean(method, get_args(Method))
        raise ValueError(f"unknown method {method!r}; choose one of {known}{hint}")
    if method == "newton":
        found = _found("signed_distance", field, points, level, precision, progress)
        return np.copysign(found.distance, found.above)
    backend = choose_backend(precision)
    surface = _surface(field, level)
    levels, prepared = surface.levels_on(backend), surface.field_on(backend)
    compute = _COMPUTE[method]

    def of_points(p: Vec3) -> tuple[Real | Vec3, ...]:
        return p, compute(backend, prepared, levels, p)

    x, result = in_batches(backend, of_points, points)
    if method == "lower":
        _check_domain(field, x)
    if field.has_sheets and method != "lower":
        to_sheet = find_closest(backend, surface, levels, x, teller(None)).distance
        result = np.copysign(np.fmin(to_sheet, np.abs(result)), result)
    return result


@takes_blocks("points")
@refuses_derivatives
def closest_points(
    field: Field,
    points: Any,
    *,
    level: Any = None,
    precision: Precision = "double",
    progress: Callable[[str], None] | None = None,
) -> FloatArray:
    """The closest points (n, 3) of a level set to `points` (n, 3), as far as a search finds them.

    Of the winding number of a closed mesh, and of its solid, they are exact: the nearest of the
    triangles that are the level, cut where others pass through them. Of other fields the surface is
    enclosed in cells, and descents from the points of the surface that cells know lead to places
    where no neighbor is nearer; `distance_bounds` also splits cells where a nearer point may be.
    The curve in which the level sets of a field end counts as part of them, such as the vertices
    and edges of a solid angle, and so does the rim at which the field's domain cuts them. NaN, with
    a RuntimeWarning that counts them, where no surface is found.

    Raises:
        TypeError, ValueError: as `signed_distance`.
    """
    found = _found("closest_points", field, points, level, precision, progress)
    return found.feet


@dataclass(frozen=True)
class DistanceBounds:
    """What is known about distances to a surface. The true distance d has lower <= d <= upper.

    feet: (n, 3) points of the surface, NaN where none was found.
    upper: (n,) distances to these; NaN likewise. lower: (n,) proved; infinite where there is proved
        to be no surface.
    """

    feet: FloatArray
    upper: FloatArray
    lower: FloatArray


@takes_blocks("points")
@refuses_derivatives
def distance_bounds(
    field: Field,
    points: Any,
    *,
    level: Any = None,
    precision: Precision = "double",
    progress: Callable[[str], None] | None = None,
) -> DistanceBounds:
    """Distances of points (n, 3) from a level set, with proved lower bounds.

    `lower` is proved. Cells that hold no surface by the field's promises are left out; in each of
    the others the surface lies in a slab, where the promises say so; and around every foot there
    is a ball that holds no nearer point of the surface. `lower` is the least distance to what is
    left. Cells are split where it is less than `upper` by more than 1e-6 of the size of the
    surface, up to about half as many cells as there are points, but at least 60,000: so a few
    points are proved to that tolerance, and of many points those for which the balls suffice.

    `upper` is the distance to a point of the surface, found by several descents. Where `lower` is
    less, the true distance may lie anywhere between the two.

    Raises:
        TypeError, ValueError: as `signed_distance`.
    """
    found = _found("distance_bounds", field, points, level, precision, progress, is_proved=True)
    return DistanceBounds(found.feet, found.distance, found.lower)


def _found(
    name: str, field: Field, points: Any, level: Any, precision: Precision,
    progress: Callable[[str], None] | None, *, is_proved: bool = False,
) -> Closest:  # fmt: skip
    backend = choose_backend(precision)
    surface = _surface(field, level)
    levels = surface.levels_on(backend)
    found = find_closest(backend, surface, levels, points, teller(progress), is_proved=is_proved)
    _warn(name, found)
    return found


def _surface(field: Field, level: Any) -> LevelSet:
    check_is_field(field)
    if field.has_sheets and type(field).distance_to_sheets is Field.distance_to_sheets:
        raise NotImplementedError(
            f"{type(field).__name__} has sheets but does not say how far they are: define its "
            "method distance_to_sheets(p)"
        )
    return level_set(field, level, tolerance=_CLOSE, overstep=1.0).in_one_call()


def _warn(name: str, found: Closest) -> None:
    """Of points without an answer, and of answers that a promise of the field contradicts."""
    n = len(found.feet)
    unresolved = int(np.isnan(found.feet[:, 0]).sum())
    if unresolved:
        warnings.warn(
            f"{name}: no closest point was found for {unresolved} of {n} points (NaN): no cell "
            "that may hold the surface, and no descent from the points, led to a point of it",
            RuntimeWarning,
            stacklevel=4,
        )
    refused = int(found.is_refused.sum())
    if refused:
        warnings.warn(
            f"{name}: for {refused} of {n} points, points of the surface were found within the "
            "radius that the field's own promises prove to be free of it, and left out: the "
            "promises in `Sample.known` do not hold (harnack.testing.check_field tests them)",
            RuntimeWarning,
            stacklevel=4,
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
