"""Derivatives of hits, by implicit differentiation at the hit.

A marching loop is not differentiable in any useful sense: its derivative depends on where it
stopped. The hit, f(o + t d; theta) = level, defines t(theta), and

    dt = (dlevel - df|_t) / (grad f . d),

which these functions attach to a detached t. A hit on a facet of a field with jumps lies on a
plane, n . (o + t d) = const, whatever the level: dt = -(n . (do + t dd))/(n . d).

Derivatives are implicit: the trace runs without them, and the derivative of t is attached at the
hit, by the gradient of the sample there. So no derivative passes through `evaluate`, which may run
a recorded loop. Derivatives that would be lost are refused, both for arguments (`validation`,
`Field.__new__`) and for results. At ties of formulas, where the gradient is a range, dual numbers a
few roundings away choose a one-sided gradient (`Formula.evaluate`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import safe_norm as norm
from harnack.backend.validation import is_plain_data
from harnack.enclosures import Levels
from harnack.fields.batched_fields import FieldCache
from harnack.fields.capabilities import EXACT
from harnack.tracer.level_contact import RayStatus

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer

# Newton steps that bring a hit from the tolerance to rounding before the derivative is taken; and
# for sums over trees, which are then evaluated without truncation.
_NEWTON_STEPS, _NEWTON_STEPS_OF_SUMS = 4, 3


# Fields without Dr.Jit numbers, which are checked only once (until an attribute is set).
_PARAMETER_FREE: FieldCache[bool] = FieldCache()


def needs_derivatives(prepared: SurfaceTracer, o: Vec3, d: Vec3) -> bool:
    """Whether rays, levels or the field's parameters have derivatives enabled.

    Raises:
        NotImplementedError: parameters of a field with jumps have derivatives enabled. They move
            the facets, and the derivative of that is not known here; zero would be wrong.
    """
    field = prepared.field
    if not _PARAMETER_FREE.get(field, None, lambda: is_plain_data(vars(field))):
        field.refuse_hidden_parameters()
    parameters = prepared.field.parameters()
    of_field = any(dr.grad_enabled(p) for p in parameters)
    if of_field and prepared.field.has_jumps:
        name = type(prepared.field).__name__
        raise NotImplementedError(
            f"hits of a field with jumps cannot be differentiated by its parameters: detach "
            f"those of this {name} (derivatives by rays and levels are attached)"
        )
    rest: list[Any] = [o, d, *prepared.levels.values]
    return of_field or any(dr.grad_enabled(p) for p in rest)


class _NoDerivative(dr.CustomOp):
    """The identity, whose derivative is not known: reverse mode raises. Forward mode, which goes
    from parameters to all that depends on them, wanted or not, gives NaN."""

    def eval(self, value: Any, what: str, sources: list[Any]) -> Any:
        del sources
        self._what = what
        return value

    def forward(self) -> None:
        self.set_grad_out(self.grad_out() + dr.nan)

    def backward(self) -> None:
        if dr.any(self.grad_out() != 0, axis=None):  # it is zero for a result that is not used
            raise NotImplementedError(
                f"{self._what} of hits cannot be differentiated, only t and position can: detach "
                "it where it is used (drjit.detach)"
            )


def refuse_derivative(prepared: SurfaceTracer, o: Vec3, d: Vec3, what: str, value: Any) -> Any:
    """The result of a trace, with an error (`_NoDerivative`) if its derivative is requested.

    Its derivative is not known, and zero would be wrong.
    """
    sources = [o, d, *prepared.levels.values, *prepared.field.parameters()]
    return dr.custom(_NoDerivative, value, what, sources)


def attach_derivatives(
    prepared: SurfaceTracer, o: Vec3, d: Vec3, end: MarchResult, normal: Vec3
) -> tuple[Real, Vec3]:
    """t, refined up to rounding, with its derivative attached, and the normal at that point.

    normal: the unit normal of the trace. Normals carry no derivative (it would need the Hessian).

    At hits on facets t is already exact, and does not depend on the level.
    """
    t, hit, prepared = end.t, end.status == int(RayStatus.HIT), prepared.hit_surface(end)
    if prepared.field.has_jumps:
        t = _on_plane(prepared, o, d, end)
        hit &= ~end.at_jump
    backend = prepared.backend
    with dr.suspend_grad():
        t_hit = dr.select(hit, t, 0)
        origin, direction = dr.detach(o), dr.detach(d)
        steps = _NEWTON_STEPS
        if prepared.field.has_variable_accuracy:
            # Truncation is as large as the tolerance, and its derivative may be much larger.
            steps = _NEWTON_STEPS_OF_SUMS
            detail = dr.select(hit, backend.Float(EXACT), 0)
            prepared = replace(prepared, field=prepared.field.at_accuracy(detail))
        for _ in range(steps):
            x = dr.fma(backend.Array3f(t_hit), direction, origin)
            sample = prepared.sample(x)
            offset = prepared.levels.offset_to_nearest(sample.value)
            slope = dr.dot(sample.gradient, direction)
            step = dr.select(hit & (slope != 0), offset / slope, 0)
            # A grazing ray may have no root to converge to; stay near the proved point.
            limit = 4 * prepared.tolerance.distance
            t_hit = t_hit + dr.clip(step, -limit, limit)
        x = dr.fma(backend.Array3f(t_hit), direction, origin)
        sample = prepared.sample(x)
        slope = dr.dot(sample.gradient, direction)
        length = norm(sample.gradient)
        normal = dr.select(hit & (length > 0), sample.gradient / length, normal)
        dr.eval(t_hit, x, slope, normal)
    point = dr.fma(backend.Array3f(t_hit), d, o)
    change = dr.dot(sample.gradient, point - x)
    if any(dr.grad_enabled(parameter) for parameter in prepared.field.parameters()):
        value = prepared.field.differentiable_value(point)
        change = value - dr.detach(value)
    change = change - _change_of_nearest(prepared, sample.value)
    return dr.select(hit, _with_derivative(t_hit, change, slope, hit), t), normal


def _on_plane(prepared: SurfaceTracer, o: Vec3, d: Vec3, end: MarchResult) -> Real:
    """t with the derivative of the intersection with a plane, at hits on facets."""
    with dr.suspend_grad():
        t_hit = dr.select(end.at_jump, end.t, 0)
        slope = dr.dot(end.gradient, dr.detach(d))
    x = dr.fma(prepared.backend.Array3f(t_hit), d, o)
    change = dr.dot(end.gradient, x - dr.detach(x))
    return _with_derivative(end.t, change, slope, end.at_jump)


def _with_derivative(t: Real, change: Real, slope: Real, where: Mask) -> Real:
    """t with the derivative of -change/slope, infinite or NaN where the slope is 0."""
    return dr.replace_grad(t, -change * dr.select(where, 1 / slope, 0))


def _change_of_nearest(prepared: SurfaceTracer, f: Real) -> Real:
    """The number level - detach(level), a zero with a derivative, of the level nearest to f in each
    lane."""
    nearest, change = dr.inf, prepared.backend.Float(0)
    for level in prepared.levels.values:
        with dr.suspend_grad():
            single = Levels((dr.detach(level),), prepared.levels.period)
            gap = single.gaps(f).nearest
            closer = gap < nearest
            nearest = dr.select(closer, gap, nearest)
        change = dr.select(closer, level - dr.detach(level), change)
    return change
