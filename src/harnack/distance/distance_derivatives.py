"""Derivatives of signed distances from a level set, by the points and by what the level set depends
on: parameters of the field, and the level. They follow from the closest points, which the search
finds without derivatives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import backend_of, to_vector3
from harnack.backend.arrays import upload_floats
from harnack.backend.elementary import max_norm
from harnack.backend.elementary import safe_norm as norm
from harnack.enclosures import Levels
from harnack.fields.attached_numbers import value_with_parameters
from harnack.fields.parameters import differentiable_parameters
from harnack.tracer.derivatives import change_of_level, refuse_derivative_by

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real, Vec3
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Field

# The vector from a closest point counts as normal to the surface up to this angle, and up to an
# error of so many roundings of the coordinates.
_MAX_ANGLE, _ROUNDINGS = 1e-4, 1e4


def distance_with_derivative(
    field: Field, evaluator: Evaluator, levels: Levels, p: Vec3,
    closest: FloatArray, distance: FloatArray, outwards: float,
) -> Real:  # fmt: skip
    """The signed distances d of points p, with derivatives by the points, by the parameters of the
    field, and by the levels.

    evaluator: of the field, on the backend of p.
    levels: the values of f on the surface, possibly with derivatives.
    closest, distance: (n, 3), (n,) the closest points and the signed distances, NaN for none.
    outwards: 1, or -1 if f is larger inside.

    Proof. Let q be the only closest point to p, and d not 0. The derivative of d by p is the unit
    vector from q to p, outside, or its opposite inside: with q held fixed |p - q| has this
    derivative, and as q is a minimum, its own motion contributes nothing (Danskin). Where the level
    set is smooth at q, that vector is the unit normal n = outwards grad f/|grad f| at q, also for d
    = 0. Let f and the level depend on a parameter, with derivatives f' at fixed points and level'.
    Points of the level set with f(q) = level move along grad f/|grad f| by (level' - f')/|grad f|,
    whatever they do across it; |p - q| changes by the part of the motion along n alone, and so d
    changes by outwards (f' - level')/|grad f|, taken at q. If the level set has a crease or an end
    at q, where the vector to p is not normal to it, this does not hold: such derivatives by
    parameters are refused.
    """
    backend = backend_of(p)
    with dr.suspend_grad():
        point = dr.detach(p)
        q = to_vector3(backend, np.where(np.isfinite(closest), closest, 0.0))
        d = upload_floats(backend, distance)
        gradient = evaluator.evaluate(q).gradient
        length = norm(gradient)
        normal = outwards * dr.select(length > 0, gradient / length, 0)
        away = point - q
        size = max_norm(point) + max_norm(q)
        rounding = _ROUNDINGS * backend.machine_epsilon * size
        deviation = norm(away - normal * d)
        is_smooth = (length > 0) & (deviation <= _MAX_ANGLE * dr.abs(d) + rounding)
        direction = dr.select(dr.abs(d) > rounding, away / d, normal)
        direction = dr.select(dr.isfinite(d), direction, dr.nan)
        inverse = outwards * dr.select(is_smooth, 1 / length, 0)
        dr.eval(q, d, direction, inverse, is_smooth)
    change = dr.dot(direction, p - point)
    parameters = [v for v in differentiable_parameters(field) if dr.grad_enabled(v)]
    sources: list[Any] = [*parameters, *(v for v in levels.values if dr.grad_enabled(v))]
    if not sources:
        return dr.replace_grad(d, d + change)
    moved = -change_of_level(levels, evaluator.evaluate(q).value)
    if parameters:
        value = value_with_parameters(field, evaluator, q)
        moved = moved + value - dr.detach(value)
    refused = refuse_derivative_by(sources, "the distance from a crease or an end", 0 * d)
    change = change + dr.select(is_smooth, moved * inverse, refused)
    return dr.replace_grad(d, d + change)
