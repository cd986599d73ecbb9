"""`signed_distance`: how far points are from a surface, by four methods; and closest points and
proved bounds of the distance. The surface consists of the points at which a function f, the field,
takes given values, the levels.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, backend_of, choose_backend
from harnack.backend.arrays import upload_floats
from harnack.backend.tensors import accepts_tensors, is_tensor
from harnack.backend.validation import check_no_derivatives, no_derivatives
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.distance.closest_point_search import ClosestPoints, find_closest
from harnack.distance.distance_derivatives import distance_with_derivative
from harnack.distance.tangent_plane import first_order_distance, in_batches, second_order_distance
from harnack.enclosures import Levels
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.evaluator import Evaluator
from harnack.fields.field import Field, refuse_hidden_parameters
from harnack.fields.number_table import plain_numbers
from harnack.fields.parameters import differentiable_parameters
from harnack.name_suggestions import did_you_mean, is_one_of, with_article
from harnack.progress import ProgressFunction, show_progress
from harnack.tracer import TracedSurface, TraceOptions
from harnack.tracer.surface import intersection_of
from harnack.tracer.trace_options import shows_keywords, surface_and_options

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from harnack.backend import Backend, Real, Vec3
    from harnack.tracer import Surface, TraceKeywords

__all__ = ["DistanceBounds", "Method", "closest_points", "distance_bounds", "signed_distance"]

Method = Literal["first_order", "second_order", "closest_point", "lower_bound"]
_HONORED = ("level", "clip", "section", "precision")
# The tolerance of rays; the tracer raises it to the smallest that rounding allows.
_RAY_TOLERANCE = 1e-15


@accepts_dask_arrays("points")
@shows_keywords(*_HONORED)
def signed_distance(
    surface: Field | Surface,
    points: Any,
    *,
    method: Method = "closest_point",
    progress: bool | ProgressFunction = False,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> Any:
    """Return signed distances (n,) from points (n, 3) to a surface, negative inside. The surface is
    a level set of a field's function f.

    Points that are a Dr.Jit 3-vector give a Dr.Jit array, and a tensor (n, 3) gives a tensor (n,).
    Those of the method "closest_point" have derivatives: by the points, which are unit vectors; and
    by the parameters of the field and the level, where the surface is smooth at the closest point.
    (At a crease or an end of the surface, using a derivative by parameters raises an error in
    reverse mode, and is NaN in forward mode.)

    Points with f < level are inside. For winding numbers, clouds and blobs, which are larger inside
    (`Traits.is_larger_inside`), points with f > level are inside. (trimesh has the opposite sign.)

    surface: a field or a `Surface`; `side` and `largest` are not accepted. If there are several
        levels, the sign belongs to the level nearest in value. For an angle-valued field, a level
        includes all values that differ from it by periods. With "closest_point", clip and section
        cut the surface. With "lower_bound", the bound holds for the whole surface, and so for the
        part in clip and section. The other methods raise a TypeError for a clip or section.
    method:
        "first_order": (f - level)/|grad f|. Off by O(d^2) at distance d; infinite where grad f = 0.
        "second_order": the same with the second derivative of f along its gradient. Off by O(d^3);
            needs the field's `hessian`.
        "closest_point": the distance to the nearest surface point that a search finds
            (`closest_points` says how). It is an upper bound of the true distance, and exact to
            rounding if the search finds the closest point. `distance_bounds` gives proved bounds.
            Beside creases (edges where f has no gradient) of formulas, and of combinations of more
            than 12 solids, it may be too long; of combinations of fewer, creases are searched.
            For a closed triangle mesh, and for the boundary of the solid of a closed mesh, it is
            exact to rounding. NaN where no surface is found: there is none, or it was found only
            within a radius that the field promises to be free. A RuntimeWarning counts these
            points.
        "lower_bound": a proved lower bound of the true distance: no level lies in the ball of that
            radius about the point, not even outside the field's domain. It is of first order, too:
            the nearer the surface, the smaller the relative error.
        For a field that jumps across facets, "first_order" and "second_order" see the smooth part
        of the surface, and the nearest facet if that is nearer and the surface lies there.
    progress: whether to show what is being done, or a function that is called with a `Progress`.
    options: a `TraceOptions`; distances use its `precision` alone. None is double precision.
        "lower_bound" allows for rounding in both precisions, and the search of "closest_point" is
        done in double precision in any case. Closest points have no tolerance: they are exact up to
        rounding.
    keywords: those of `Surface` beside a bare field, and `precision` in place of `options`.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers, an unknown
            method, a level that no surface has or, with "lower_bound", points outside the field's
            domain, where it promises nothing.
        NotImplementedError: "second_order" with a field that has no second derivatives; or
            derivatives that would be lost.
    """
    if not is_one_of(method, get_args(Method)):
        names = ", ".join(f'"{name}"' for name in get_args(Method))
        hint = did_you_mean(method, get_args(Method))
        raise ValueError(f"unknown method {method!r}; choose one of {names}{hint}")
    is_drjit = dr.is_array_v(cast("Any", type(points)))
    if method == "closest_point" and is_drjit:
        take = accepts_tensors(_distance_of_vectors)
        settings = {"progress": progress, "options": options, "keywords": keywords}
        return take(surface, points, **settings)
    check_no_derivatives(f'signed_distance(method="{method}")', surface, points, keywords)
    if is_drjit:
        result = signed_distance(
            surface, plain_numbers(points).reshape(-1, 3), method=method, progress=progress,
            options=options, **keywords,
        )  # fmt: skip
        kind = cast("Any", type(points))
        return kind(result) if is_tensor(points) else upload_floats(backend_of(points), result)
    traced, backend = _surface("signed_distance", surface, options, keywords)
    field = traced.field
    if method == "closest_point":
        closest = _find("signed_distance", traced, backend, points, progress)
        return _outwards(field) * np.copysign(closest.distance, closest.signed_value)
    if traced.clip_volume is not None and method != "lower_bound":
        raise TypeError(f'method="{method}" does not see clip and section: use "closest_point"')
    levels, evaluator = traced.target_levels(backend), traced.evaluator(backend)
    compute = _COMPUTE[method]

    def estimate(p: Vec3) -> tuple[Real | Vec3, ...]:
        """Return two results for p: the point as rounded, and the estimate or bound of its distance
        by the chosen method."""
        return p, compute(backend, evaluator, levels, p)

    x, result = in_batches(backend, estimate, points)
    if method == "lower_bound":
        _check_domain(field, x)
    if field.traits.has_jumps and method != "lower_bound":
        # These methods do not see facets: the nearest one of the surface is searched for. (The
        # lambda shows no progress.)
        jump_distance = find_closest(backend, traced, levels, x, lambda message: None).distance
        result = np.copysign(np.fmin(jump_distance, np.abs(result)), result)
    return _outwards(field) * result


def _distance_of_vectors(
    surface: Any, points: Vec3, *, progress: Any, options: Any, keywords: Any
) -> Real:
    """The signed distances of Dr.Jit points by their closest points, with derivatives."""
    backend = backend_of(points)
    if not dr.width(points):  # Dr.Jit adds no number to an empty array
        return dr.zeros(backend.Float, 0)
    x = plain_numbers(points).reshape(-1, 3)
    traced, search_backend = _surface("signed_distance", surface, options, keywords)
    field = traced.field
    refuse_hidden_parameters(field)
    parameters = [v for v in differentiable_parameters(field) if dr.grad_enabled(v)]
    if field.traits.has_jumps:
        check_no_derivatives(f"the distance from {with_article(type(field).__name__)}", parameters)
    with dr.suspend_grad():
        closest = _find("signed_distance", traced, search_backend, x, progress)
    sign = _outwards(field)
    distance = sign * np.copysign(closest.distance, closest.signed_value)
    return distance_with_derivative(
        field, traced.evaluator(backend), traced.target_levels(backend), points,
        closest.closest, distance, sign,
    )  # fmt: skip


def _outwards(field: Field) -> float:
    """Return the factor, 1 or -1, that makes a distance with the sign of f - level negative inside.
    It is -1 for fields that are larger inside."""
    return -1.0 if field.traits.is_larger_inside else 1.0


@accepts_dask_arrays("points")
@shows_keywords(*_HONORED)
@no_derivatives
def closest_points(
    surface: Field | Surface,
    points: Any,
    *,
    progress: bool | ProgressFunction = False,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> FloatArray:
    """Find the closest points (n, 3) of a level set of a field's function to `points` (n, 3).

    For the winding number of a closed mesh, and for its solid, they are exact: the level set
    consists of triangles, which are cut where they intersect, and the nearest one is found. For
    other fields the surface is enclosed in cells, and descents from known surface points in the
    cells lead to local minima of the distance; `distance_bounds` also subdivides cells that may
    hold a nearer point. The curves at which level sets end count as part of them: the edges and
    vertices of a solid angle, and the clip curve, at which the field's domain cuts the surface. The
    result is NaN where no surface is found; a RuntimeWarning counts these points.

    surface, points, progress, options, keywords: as in `signed_distance`.

    Raises:
        TypeError, ValueError: as `signed_distance`.
    """
    traced, backend = _surface("closest_points", surface, options, keywords)
    closest = _find("closest_points", traced, backend, points, progress)
    return closest.closest


@dataclass(frozen=True)
class DistanceBounds:
    """Proved bounds of the distances of n points from a surface. The true distance d has lower <= d
    <= upper.

    closest_points: (n, 3) points of the surface, NaN where none was found.
    upper: (n,) distances to these points; NaN where none was found.
    lower: (n,) proved lower bounds; infinite where it is proved that there is no surface.
    """

    closest_points: FloatArray
    upper: FloatArray
    lower: FloatArray


@accepts_dask_arrays("points")
@shows_keywords(*_HONORED)
@no_derivatives
def distance_bounds(
    surface: Field | Surface,
    points: Any,
    *,
    progress: bool | ProgressFunction = False,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> DistanceBounds:
    """Compute distances of points (n, 3) from a level set of a field's function f, with proved
    lower bounds.

    `lower` is proved by the field's promises (proved bounds of f near a point). These imply that
    some cubic cells of space hold no surface; that in others the surface lies in a slab between two
    parallel planes; and that a ball around each closest point holds no nearer point of the surface.
    `lower` is the distance to the nearest slab, or cell without a slab, outside of that ball. If
    `lower` is less than `upper` by more than 1e-6 of the size of the surface, cells are subdivided,
    but into no more cells than about half the number of points, or 60,000 if that is more. So for a
    few points this tolerance is reached; for many points, only if the balls suffice.

    `upper` is the distance to a point of the surface, found by several descents. Where `lower` is
    less than `upper`, the true distance may lie anywhere between the two.

    surface, points, progress, options, keywords: as in `signed_distance`.

    Raises:
        TypeError, ValueError: as `signed_distance`.
    """
    traced, backend = _surface("distance_bounds", surface, options, keywords)
    closest = _find("distance_bounds", traced, backend, points, progress, is_proved=True)
    return DistanceBounds(closest.closest, closest.distance, closest.lower)


def _find(
    name: str,
    surface: TracedSurface,
    backend: Backend,
    points: Any,
    progress: bool | ProgressFunction,
    *,
    is_proved: bool = False,
) -> ClosestPoints:
    """Find the closest point of a surface to each of `points` (n, 3), and warn if some points have
    none. The surface's clip is made part of the field's domain first.

    name: the name of the public function, for messages.
    progress: as in `signed_distance`.
    is_proved: whether the lower bounds of the result are made as large as can be proved.

    Raises NotImplementedError for a clip or section of a field with jumps.
    """
    if surface.clip_volume is not None:
        if surface.field.traits.has_jumps:
            raise NotImplementedError(
                f"{name} takes no clip and no section of "
                f"{with_article(type(surface.field).__name__)}, which jumps: cut its mesh "
                "by the volume, and give the winding number of that"
            )
        # The search asks the field for its domain.
        field = copy.copy(surface.field)
        volume = intersection_of([field.domain, surface.clip_volume])
        object.__setattr__(field, "domain", volume)  # also of frozen dataclasses
        surface = replace(surface, field=field, clip=None, section=None)
    levels = surface.target_levels(backend)
    with show_progress(name, progress) as reporter:
        closest = find_closest(backend, surface, levels, points, reporter.tell, is_proved=is_proved)
    _warn_of_failures(name, closest)
    return closest


def _surface(
    verb: str,
    surface: Field | Surface,
    options: TraceOptions | None,
    keywords: TraceKeywords,
) -> tuple[TracedSurface, Backend]:
    """Return the surface to which distances are measured, and the backend to compute them on.

    verb: the name of the public function, for messages.
    surface, options, keywords: the arguments of that function.

    Raises:
        TypeError, ValueError: the surface or an option is not valid, or distances do not have such
            an option.
        NotImplementedError: a field with jumps whose distance is not known.
    """
    target, choices = surface_and_options(verb, surface, options, keywords, _HONORED)
    field = target.field
    # (An over-relaxation of 1: rays take proved steps only.)
    closely = TraceOptions(tolerance=_RAY_TOLERANCE, over_relaxation=1.0)
    traced = TracedSurface.of(target, closely).with_call_cache()
    backend = choose_backend(choices.precision or "double")
    jumps = traced.evaluator(backend).jumps if field.traits.has_jumps else None
    if jumps is not None and not jumps.gives_distances:
        raise NotImplementedError(
            f"{type(field).__name__} has jumps but does not say how far they are: define the "
            f"method distance(p) of its {type(jumps).__name__}"
        )
    return traced, backend


def _warn_of_failures(name: str, result: ClosestPoints) -> None:
    """Warn if no surface was found for some queries; and if, for some, the point found is nearer
    than the field's promises (proved bounds of f near a point) allow, so that they are wrong.

    name: the name of the public function, for messages. result: what its search found.
    """
    # The warnings point to the caller of the public function, four calls up.
    count = len(result.closest)
    unresolved = int(np.isnan(result.closest[:, 0]).sum())
    if unresolved:
        warnings.warn(
            f"{name}: no closest point was found for {unresolved} of {count} points (NaN): no cell "
            "that may hold the surface, and no descent from the points, led to a point of it",
            RuntimeWarning,
            stacklevel=4,
        )
    refused = int(result.violates_promises.sum())
    if refused:
        warnings.warn(
            f"{name}: for {refused} of {count} points, points of the surface were found within the "
            "radius that the field's own promises prove to be free of it, and left out: the "
            "promises in `Sample.promises` do not hold (harnack.testing.check_field tests them)",
            RuntimeWarning,
            stacklevel=4,
        )


def _check_domain(field: Field, points: FloatArray) -> None:
    """Raise a ValueError if one of the points (n, 3) is outside the field's domain."""
    if field.domain is None or not len(points):
        return
    outside = np.flatnonzero(~field.domain.contains_points(points))
    if outside.size:
        more = f" and {outside.size - 1} more" if outside.size > 1 else ""
        raise ValueError(
            f"points: entry {outside[0]}{more} outside the domain of {type(field).__name__}, where "
            "it promises nothing; leave such points out, or give the field a larger domain"
        )


def _first_order(backend: Backend, evaluator: Evaluator, levels: Levels, p: Vec3) -> Real:
    """Return the first-order estimate (f - level)/|grad f| of the signed distance of p from the
    level set, for the level nearest in value. `backend` is not used."""
    del backend
    sample = evaluator.evaluate(p)
    return first_order_distance(-levels.offset_to_nearest(sample.value), sample.gradient)


def _second_order(backend: Backend, evaluator: Evaluator, levels: Levels, p: Vec3) -> Real:
    """Return the second-order estimate of the signed distance of p from the level set, with the
    sign of f - level, for the level nearest in value. `backend` is not used."""
    del backend
    sample, rows = evaluator.evaluate(p), evaluator.hessian(p)
    return second_order_distance(-levels.offset_to_nearest(sample.value), sample.gradient, rows)


def _signed_lower_bound(backend: Backend, evaluator: Evaluator, levels: Levels, p: Vec3) -> Real:
    """Return the proved lower bound of the distance of p from the level sets of all levels, with
    the sign of f - level for the level nearest in value."""
    sample = evaluator.evaluate(p)
    residual = -levels.offset_to_nearest(sample.value)
    return dr.copysign(level_distance_lower_bound(backend, evaluator, levels, p, sample), residual)


_COMPUTE: dict[str, Callable[[Backend, Evaluator, Levels, Vec3], Real]] = {
    "first_order": _first_order,
    "second_order": _second_order,
    "lower_bound": _signed_lower_bound,
}
