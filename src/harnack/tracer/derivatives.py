"""Derivatives of hits, by implicit differentiation at the hit.

A marching loop is not differentiable in any useful sense: its derivative depends on where it
stopped. The hit, f(o + t d; theta) = level, defines t(theta), and

    dt = (dlevel - df|_t) / (grad f . d),

which is what these functions attach to a detached t.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.certify import Levels

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.march import PreparedLevelSet

# Newton steps from the tolerance to rounding before the derivative is taken.
_POLISH = 4


def wants_derivatives(prepared: PreparedLevelSet, o: Vec3, d: Vec3) -> bool:
    """Whether rays, levels or the field's parameters have derivatives enabled."""
    parameters: list[Any] = [o, d, *prepared.levels.values, *prepared.field.parameters()]
    return any(dr.grad_enabled(p) for p in parameters)


def attach(
    prepared: PreparedLevelSet, o: Vec3, d: Vec3, t: Real, hit: Mask, normal: Vec3
) -> tuple[Real, Vec3]:
    """t polished to rounding with its derivative attached, and the normal at that point.

    Normals carry no derivative (they would need the Hessian).
    """
    backend = prepared.backend
    with dr.suspend_grad():
        at = dr.select(hit, t, 0)
        here, along = dr.detach(o), dr.detach(d)
        for _ in range(_POLISH):
            x = dr.fma(backend.Array3f(at), along, here)
            sample = prepared.sample(x)
            miss = prepared.levels.to_nearest(sample.value)
            slope = dr.dot(sample.gradient, along)
            step = dr.select(hit & (slope != 0), miss / slope, 0)
            # A grazing ray has no crossing to converge to; stay near the proved point.
            limit = 4 * prepared.tolerance.distance
            at = at + dr.clip(step, -limit, limit)
        x = dr.fma(backend.Array3f(at), along, here)
        sample = prepared.sample(x)
        slope = dr.dot(sample.gradient, along)
        length = dr.norm(sample.gradient)
        normal = dr.select(hit & (length > 0), sample.gradient / length, normal)
        dr.eval(at, x, slope, normal)
    value = prepared.field.differentiable_value(dr.fma(backend.Array3f(at), d, o))
    change = value - dr.detach(value)
    change = change - _change_of_nearest(prepared, sample.value)
    usable = hit & (slope != 0)
    moved = at - dr.select(usable, change / slope, 0)
    return dr.select(hit, moved, t), normal


def _change_of_nearest(prepared: PreparedLevelSet, f: Real) -> Real:
    """level - detach(level), a zero with a derivative, of the level nearest to f in each lane."""
    nearest, change = dr.inf, prepared.backend.Float(0)
    for level in prepared.levels.values:
        with dr.suspend_grad():
            one = Levels((dr.detach(level),), prepared.levels.period)
            down, up = one.gaps(f)
            gap = dr.select(up < down, up, down)
            closer = gap < nearest
            nearest = dr.select(closer, gap, nearest)
        change = dr.select(closer, level - dr.detach(level), change)
    return change
