"""Derivatives of hits, by implicit differentiation at the hit. A ray o + t d hits the surface f =
level at t; f is the function of the field, and theta are its parameters.

The loop that finds the hit is not differentiated: such a derivative would depend on where the loop
stopped. The equation of the hit, f(o + t d; theta) = level, determines t as a function of o, d,
level and theta:

    dt = (dlevel - df|_t) / (grad f . d).

Here df|_t is the change of f at a fixed t, by changes of o, d and theta. The trace runs without
derivatives, and this derivative is attached to its t, by the gradient of a sample at the hit. A hit
on a facet (a flat piece of surface at which f jumps) lies on its plane n . (o + t d - q) = 0,
whatever the level. Here q is the point of a triangle with corners v_i that has the same barycentric
weights as the hit, q = sum w_i v_i, at which n . dq is how far the plane moves:

    dt = n . (dq - do - t dd)/(n . d).

A change dn of the normal contributes dn . (o + t d - q) = 0.

So no derivative passes through `evaluate`, which may run a recorded loop. If a derivative would be
lost, an error is raised: for arguments by `validation` and `Field.__new__`, for results by
`refuse_derivative`. At points at which a formula has several one-sided gradients, dual numbers a
few roundings away choose one of them (`Formula.evaluate`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import safe_norm as norm
from harnack.backend.validation import is_plain_data
from harnack.enclosures import Levels
from harnack.fields.attached_numbers import gradient_with_parameters, value_with_parameters
from harnack.fields.batched_fields import FieldCache
from harnack.fields.capabilities import EXACT
from harnack.fields.field import refuse_hidden_parameters
from harnack.fields.parameters import differentiable_parameters
from harnack.tracer.level_contact import RayStatus

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.fields.field import Sample
    from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer

# Newton steps that bring a hit from the tolerance to rounding before the derivative is taken; and
# for sums over trees, which are then evaluated without truncation.
_NEWTON_STEPS, _NEWTON_STEPS_OF_SUMS = 4, 3
NEWTON_STEP = 4.0
"""The longest of these steps along a ray, in tolerances."""


# Fields without Dr.Jit numbers, which are checked only once (until an attribute is set).
_PARAMETER_FREE: FieldCache[bool] = FieldCache()


def needs_derivatives(tracer: SurfaceTracer, o: Vec3, d: Vec3) -> bool:
    """Return whether rays, levels or the field's parameters have derivatives enabled.

    tracer: the surface, with the levels and the field.
    o, d: (3,) origins and directions of the rays.

    Raises:
        NotImplementedError: parameters of a field with jumps have derivatives enabled. They may
            move the facets at which the field jumps, and how is not known (`Jumps.
            moving_triangles`); zero would be wrong.
    """
    field = tracer.field
    # Plain data has no derivatives; other attributes may hide some, and so may the function of a
    # user's class, which raises an error. (None: the memory has a single entry for each field.)
    is_users = not type(field).__module__.startswith("harnack.")
    if is_users or not _PARAMETER_FREE.get(field, None, lambda: is_plain_data(vars(field))):
        refuse_hidden_parameters(field)
    parameters = differentiable_parameters(tracer.field)
    field_has_derivatives = any(dr.grad_enabled(p) for p in parameters)
    jumps = tracer.evaluator.jumps
    if field_has_derivatives and jumps is not None and jumps.moving_triangles() is None:
        name = type(tracer.field).__name__
        raise NotImplementedError(
            f"hits of a field with jumps cannot be differentiated by its parameters: detach "
            f"those of this {name} (derivatives by rays and levels are attached)"
        )
    rays_and_levels: list[Any] = [o, d, *tracer.levels.values]
    return field_has_derivatives or any(dr.grad_enabled(p) for p in rays_and_levels)


class _NoDerivative(dr.CustomOp):
    """The identity, as a Dr.Jit operation, for a result whose derivative is not known. In reverse
    mode its derivative raises an error. Forward mode goes from parameters to all that depends on
    them, needed or not, so the derivative is NaN there."""

    def eval(self, value: Any, result_name: str, sources: list[Any]) -> Any:
        """Return `value`, and keep its name `result_name` for the message. sources: the arrays on
        which it depends; Dr.Jit needs them as inputs of the operation."""
        del sources
        self._result_name = result_name
        return value

    def forward(self) -> None:
        """Make the forward derivative NaN."""
        self.set_grad_out(self.grad_out() + dr.nan)

    def backward(self) -> None:
        """Raise NotImplementedError, unless the result is not used."""
        if dr.any(self.grad_out() != 0, axis=None):  # it is zero for a result that is not used
            raise NotImplementedError(
                f"{self._result_name} cannot be differentiated here; t, position, normal, value "
                "and clearance of smooth hits can, and so can distances to smooth points: detach "
                "it where it is used (drjit.detach)"
            )


def refuse_derivative(tracer: SurfaceTracer, o: Vec3, d: Vec3, result_name: str, value: Any) -> Any:
    """Return the array `value`, whose derivative is not known (and zero would be wrong). In reverse
    mode an error is raised if its derivative is used; in forward mode the derivative is NaN.

    tracer, o, d: the surface, and the origins and directions (3,) of the rays; `value` depends on
        these.
    result_name: the name of the result, for the message.
    """
    sources = [o, d, *tracer.levels.values, *differentiable_parameters(tracer.field)]
    return refuse_derivative_by(sources, f"{result_name} of hits", value)


def refuse_derivative_by(sources: list[Any], result_name: str, value: Any) -> Any:
    """Return the array `value`, as `refuse_derivative` does. sources: the arrays on which it
    depends."""
    return dr.custom(_NoDerivative, value, result_name, sources)


def value_with_derivative(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, end: MarchResult, value: Real
) -> Real:
    """Return the values of f at the ends of rays, with derivatives at hits: those of the level that
    was hit, since f is that level there whatever rays and parameters are. Those of other rays, and
    of hits on facets, where f takes no level, are refused.

    tracer, o, d, end: as for `attach_derivatives`. value: f at the ends.
    """
    is_known = end.status == int(RayStatus.HIT)
    if tracer.evaluator.jumps is not None:
        is_known &= ~end.at_jump
    change = change_of_nearest_level(tracer.hit_surface(end), dr.detach(value))
    refused = refuse_derivative(tracer, o, d, "value (but at smooth hits)", value)
    return dr.select(is_known, value + change, refused)


def attach_derivatives(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, end: MarchResult, normal: Vec3,
    *, longest_step: float = NEWTON_STEP,
) -> tuple[Real, Vec3]:  # fmt: skip
    """Return the ray parameters t of hits, refined up to rounding, with derivatives attached; and
    the normals (3,) at these points, with derivatives, or such that these are refused.

    tracer: the surface.
    o, d: (3,) origins and directions of the rays, possibly with derivatives.
    end: how the rays ended.
    normal: (3,) the unit normals of the trace, which are kept if there is no hit.
    longest_step: the longest step of Newton's method along a ray, in tolerances.

    Newton's method first moves t to the level. Then -change/slope is the derivative of t, where
    `change` is a zero whose derivative is that of f - level at fixed t. The normal is that of the
    gradient at the point o + t d, as an expression of this point and the field's parameters, where
    the field has a formula. At hits on facets, t is exact already and does not
    depend on the level.
    """
    # `hit_surface` takes the function of the patch that was hit, if the field is made of patches.
    t, is_hit, tracer = end.t, end.status == int(RayStatus.HIT), tracer.hit_surface(end)
    corners = _facet_corners(tracer, end)
    if tracer.evaluator.jumps is not None:
        t = _on_plane(tracer, o, d, end, corners)
        is_hit &= ~end.at_jump
    backend = tracer.backend
    with dr.suspend_grad():
        direction = dr.detach(d)
        tracer, t_hit, x, sample = hits_on_level(
            tracer, dr.detach(o), direction, t, is_hit, longest_step=longest_step
        )
        slope = dr.dot(sample.gradient, direction)
        length = norm(sample.gradient)
        normal = dr.select(is_hit & (length > 0), sample.gradient / length, normal)
        dr.eval(t_hit, x, slope, normal)
    point = dr.fma(backend.Array3f(t_hit), d, o)
    change = change_of_value(tracer, point, x, sample.gradient)
    change = change - change_of_nearest_level(tracer, sample.value)
    t = dr.select(is_hit, with_implicit_derivative(t_hit, change, slope, is_hit), t)
    normal = _with_normal_derivative(tracer, o, d, t, normal, is_hit)
    if corners is not None:
        normal = dr.select(end.at_jump, _with_facet_derivative(normal, corners), normal)
    return t, normal


def hits_on_level(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, t: Real, is_hit: Mask, *, longest_step: float
) -> tuple[SurfaceTracer, Real, Vec3, Sample]:
    """Move hits from within the tolerance onto the level, by Newton's method along their rays.

    o, d, t: origins and directions (3,) of the rays, and ray parameters.
    is_hit: the rays that hit; others stay at t = 0.
    longest_step: the longest step, in tolerances.

    Returns the tracer, whose samples have no truncation error now; the new t; the points (3,); and
    the samples there.
    """
    backend, steps = tracer.backend, _NEWTON_STEPS
    accuracy = tracer.evaluator.variable_accuracy
    if accuracy is not None:
        # Truncation is as large as the tolerance, and its derivative may be much larger.
        steps = _NEWTON_STEPS_OF_SUMS
        # Hits are sampled without truncation; other rays do not matter (0 is the coarsest).
        scale = dr.select(is_hit, backend.Float(EXACT), 0)
        tracer = replace(tracer, evaluator=accuracy.at(scale))
    t = dr.select(is_hit, t, 0)
    for _ in range(steps):
        sample = tracer.sample(dr.fma(backend.Array3f(t), d, o))
        # The level minus f, and the derivative of f along the ray: Newton's step.
        offset = tracer.levels.offset_to_nearest(sample.value)
        slope = dr.dot(sample.gradient, d)
        step = dr.select(is_hit & (slope != 0), offset / slope, 0)
        # A grazing ray may have no root to converge to; stay near the proved point.
        limit = longest_step * tracer.tolerance.distance
        t = t + dr.clip(step, -limit, limit)
    x = dr.fma(backend.Array3f(t), d, o)
    return tracer, t, x, tracer.sample(x)


def _with_normal_derivative(
    tracer: SurfaceTracer, o: Vec3, d: Vec3, t: Real, normal: Vec3, is_hit: Mask
) -> Vec3:
    """Return the normals with the derivative of the unit vector along the gradient, at points o + t
    d that move; where this is not known, such that it is refused."""
    evaluator = tracer.evaluator
    gradient = None
    is_known = evaluator.jumps is None or evaluator.jumps.moving_triangles() is not None
    if is_known:
        point = dr.fma(tracer.backend.Array3f(dr.select(is_hit, t, 0)), d, o)
        gradient = gradient_with_parameters(tracer.field, evaluator, point)
    if gradient is None:
        return refuse_derivative(tracer, o, d, "normal", normal)
    length = norm(gradient)
    unit = dr.select(is_hit & (length > 0), gradient / length, 0)
    return dr.replace_grad(normal, unit)


def _facet_corners(tracer: SurfaceTracer, end: MarchResult) -> tuple[Vec3, Vec3, Vec3] | None:
    """Return the three corners (3,) of the facets that were hit, with derivatives by the vertices;
    None if facets are not known as triangles. end: how the rays ended. Rays that hit no facet have
    corners at 0 without derivatives."""
    backend, jumps = tracer.backend, tracer.evaluator.jumps
    triangles = None if jumps is None else jumps.moving_triangles()
    if triangles is None:
        return None
    indices = (
        dr.gather(backend.UInt32, corner, end.facet, end.at_jump) for corner in triangles.corners
    )
    a, b, c = (
        backend.Array3f(
            *(
                # A coordinate that all vertices share has a single entry.
                x if dr.width(x) == 1 else dr.gather(backend.Float, x, index, end.at_jump)
                for x in backend.Array3f(triangles.vertices)
            )
        )
        for index in indices
    )
    return a, b, c


def _with_facet_derivative(normal: Vec3, corners: tuple[Vec3, Vec3, Vec3]) -> Vec3:
    """Return the unit normals of triangles with derivatives by their corners.

    normal: (3,) the normals without derivatives, on either side.
    """
    a, b, c = corners
    area = dr.cross(b - a, c - a)
    length = norm(area)
    # Rays without a hit have no area; a quotient by 0 would make derivatives NaN.
    unit = area / dr.select(length > 0, length, 1)
    is_reversed = dr.dot(dr.detach(unit), dr.detach(normal)) < 0
    return dr.replace_grad(dr.detach(normal), dr.select(is_reversed, -unit, unit))


def _change_on_triangle(x: Vec3, corners: tuple[Vec3, Vec3, Vec3], is_on: Mask) -> Vec3:
    """Return a zero vector with a derivative: that of the point of a moving triangle that keeps its
    barycentric weights.

    x: (3,) points of the triangles, without derivatives. is_on: on which lanes there are triangles.
    """
    with dr.suspend_grad():
        a, b, c = (dr.detach(corner) for corner in corners)
        u, v, to_x = b - a, c - a, x - a
        area = dr.cross(u, v)
        inverse = dr.select(is_on, 1 / dr.squared_norm(area), 0)
        second = dr.dot(dr.cross(to_x, v), area) * inverse
        third = dr.dot(dr.cross(u, to_x), area) * inverse
        weights = 1 - second - third, second, third
    moved = sum((w * (q - dr.detach(q)) for w, q in zip(weights, corners, strict=True)), 0 * x)
    return dr.select(is_on, moved, 0)


def _on_plane(
    tracer: SurfaceTracer,
    o: Vec3,
    d: Vec3,
    end: MarchResult,
    corners: tuple[Vec3, Vec3, Vec3] | None,
) -> Real:
    """Return the ray parameters t at which rays o + t d ended. At hits on facets, t has the
    derivative of the parameter at which the ray meets the facet's plane.

    tracer: the surface. end: how the rays ended.
    corners: those of the facets, possibly with derivatives; None if facets do not move.
    """
    with dr.suspend_grad():
        t_hit = dr.select(end.at_jump, end.t, 0)
        # At a hit on a facet, `end.gradient` is the facet's normal.
        slope = dr.dot(end.gradient, dr.detach(d))
    x = dr.fma(tracer.backend.Array3f(t_hit), d, o)
    # A zero with a derivative: that of the distance of a point at fixed t from the plane.
    moved = x - dr.detach(x)
    if corners is not None:
        moved = moved - _change_on_triangle(dr.detach(x), corners, end.at_jump)
    change = dr.dot(end.gradient, moved)
    return with_implicit_derivative(end.t, change, slope, end.at_jump)


def with_implicit_derivative(t: Real, change: Real, slope: Real, is_attached: Mask) -> Real:
    """Return t with the derivative of -change/slope on lanes of `is_attached`; infinite or NaN if
    the slope is 0 there.

    change: a zero with a derivative.
    slope: the derivative of f along the ray.
    """
    return dr.replace_grad(t, -change * dr.select(is_attached, 1 / slope, 0))


def change_of_value(tracer: SurfaceTracer, point: Vec3, x: Vec3, gradient: Vec3) -> Real:
    """Return a zero with a derivative: that of f at `point` by the point and by the parameters of
    the field.

    tracer: the surface. point: (3,) points, possibly with derivatives.
    x, gradient: (3,) the same points without derivatives, and grad f there.
    """
    if any(dr.grad_enabled(parameter) for parameter in differentiable_parameters(tracer.field)):
        # f depends on parameters, too: its own derivative has all of them.
        value = value_with_parameters(tracer.field, tracer.evaluator, point)
        return value - dr.detach(value)
    return dr.dot(gradient, point - x)


def change_of_nearest_level(tracer: SurfaceTracer, f: Real) -> Real:
    """Return a zero that carries a derivative: that of the level nearest to f on each lane. It is
    level - detach(level).

    tracer: the surface, with its levels.
    f: values of the field's function.
    """
    return change_of_level(tracer.levels, f)


def change_of_level(levels: Levels, f: Real) -> Real:
    """Return what `change_of_nearest_level` returns, for these levels."""
    nearest, change = dr.inf, type(f)(0)
    for level in levels.values:
        with dr.suspend_grad():
            single = Levels((dr.detach(level),), levels.period)
            gap = single.gaps(f).nearest
            is_nearest = gap < nearest
            nearest = dr.select(is_nearest, gap, nearest)
        change = dr.select(is_nearest, level - dr.detach(level), change)
    return change
