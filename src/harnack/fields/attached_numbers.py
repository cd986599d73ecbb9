"""Derivatives of formulas by the numbers that they are made of, such as the radius of a sphere.

A field stores Python numbers. If arguments of its constructor were Dr.Jit numbers with derivatives,
these are kept beside (`fields.parameters`). Here a copy of the field has them in place of its own,
and its formula, evaluated with plain Dr.Jit numbers, is an expression that Dr.Jit differentiates.
So this serves fields whose formula uses the attributes of `Traits.differentiable_arguments` as they
are, and nothing that was computed of them in Python: this would have no derivative."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.arithmetic.jet import Dual
from harnack.backend import backend_of
from harnack.backend.elementary import max_norm
from harnack.fields.evaluator import Evaluator
from harnack.fields.parameters import (
    ATTACHED,
    attributes_of,
    differentiable_parameters,
    kept_arguments,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

__all__ = [
    "attached",
    "attached_vector",
    "gradient_with_parameters",
    "has_own_formula",
    "own_formula",
    "refuse_moving_domain",
    "value_with_parameters",
    "with_attached_arguments",
]


def value_with_parameters(field: Any, evaluator: Evaluator, p: Vec3) -> Real:
    """f(p) as an expression that Dr.Jit can differentiate with respect to p and to the parameters
    of a field. evaluator: that of the field."""
    if ATTACHED not in vars(field):
        return evaluator.differentiable_value(p)
    # By p, the derivative is the gradient of the sample, also at ties.
    value = Evaluator.differentiable_value(evaluator, p)
    at = _beside(dr.detach(p))
    own = 0 * at.x + _formula_of_attached(field, at)(at.x, at.y, at.z)
    return value + (own - dr.detach(own))


# How far points are moved off ties, in machine epsilons of their coordinates; and along which
# vector, so that it is along no tie.
_TIE_OFFSET, _TIE_DIRECTION = 64.0, (0.71, 0.59, 0.83)


def _beside(p: Vec3) -> Vec3:
    """Points some roundings away from p. Points of a surface often lie on a tie of its formula,
    such as max(f, 0), where the derivative of an expression is that of neither side; beside it, it
    is that of one side."""
    with dr.suspend_grad():
        length = _TIE_OFFSET * float(dr.epsilon(type(p.x))) * max_norm(dr.detach(p))
        moved = type(p)(*_TIE_DIRECTION) * length
    return p + moved


def gradient_with_parameters(field: Any, evaluator: Evaluator, p: Vec3) -> Vec3 | None:
    """The gradient at p as an expression that Dr.Jit can differentiate with respect to p and to the
    parameters of a field; None where that is not known. At ties of a maximum or minimum it is that
    of one side. evaluator: that of the field."""
    formula: Any = getattr(evaluator, "formula", None)
    if ATTACHED in vars(field):
        formula = _formula_of_attached(field, p)
    elif any(map(dr.grad_enabled, differentiable_parameters(field))):
        default = Evaluator.differentiable_gradient  # it knows no parameters
        is_known = type(evaluator).differentiable_gradient is not default
        return evaluator.differentiable_gradient(p) if is_known else None
    elif formula is None or getattr(evaluator, "uploaded", None) is not None:
        return evaluator.differentiable_gradient(p)  # a loop runs the steps of a long formula
    coordinates = Dual.at_point(_beside(p))
    try:
        result = coordinates[0].coerce(formula(*coordinates))
    except TypeError:  # it accepts ranges of derivatives alone
        return None if ATTACHED in vars(field) else evaluator.differentiable_gradient(p)
    gradient = type(p)(*(0 * p.x + entry for entry in result.first_derivatives))
    with dr.suspend_grad():
        value = evaluator.evaluate(dr.detach(p)).gradient
    return dr.replace_grad(value, gradient)


def refuse_moving_domain(field: Any) -> None:
    """Raise NotImplementedError if the domain of a field, or of a term or factor of it, follows
    from numbers with derivatives (its attribute `domain_moves`), for what depends on where the
    domain ends: how this moves is not known."""
    if getattr(field, "domain_moves", False):
        raise NotImplementedError(
            f"the domain of this {type(field).__name__} moves with a number that carries "
            "derivatives, and these lack that motion: detach the number, or give a domain of your "
            "own where the class takes one"
        )
    for name in ("terms", "factors"):
        for part in getattr(field, "__dict__", {}).get(name, ()):
            if hasattr(part, "traits"):
                refuse_moving_domain(part)


def _formula_of_attached(field: Any, p: Vec3) -> Callable[[Any, Any, Any], Any]:
    """The formula of a field with its numbers attached, on the backend of points p."""
    if hasattr(field, "formula"):
        own_formula(field)  # raises an error if a user's class has another function
    return attached(field, backend_of(p)).formula


def attached(value: Any, backend: Backend) -> Any:
    """A copy of a field, in which arguments with derivatives are in place of the attributes that
    hold their numbers, in the fields that it is made of as well; or the copy of what contains
    fields."""
    if isinstance(value, tuple):
        return tuple(attached(entry, backend) for entry in cast("tuple[Any, ...]", value))
    if ATTACHED not in getattr(value, "__dict__", {}):
        return value
    own = getattr(value, "with_attached_numbers", None)
    if own is not None:
        return own(backend)
    return with_attached_arguments(value, value.traits.differentiable_arguments, backend)


def with_attached_arguments(field: Any, names: tuple[str, ...], backend: Backend) -> Any:
    """The copy of a field with its arguments of these names attached (`attached`)."""
    other, kept = copy.copy(field), kept_arguments(field)
    for name in list(attributes_of(other)):
        # What was computed of the numbers is computed anew.
        if isinstance(
            inspect.getattr_static(cast("Any", type(field)), name, None), cached_property
        ):
            del attributes_of(other)[name]
    for name in names:
        number = kept.get(name)
        old = getattr(field, name)
        if isinstance(old, Mapping):
            own: dict[str, Any] = number or {}
            entries = cast("Any", old).items()
            new: Any = {k: _attached_number(own.get(k, e), e, backend) for k, e in entries}
        else:
            new = _attached_number(old if number is None else number, old, backend)
        object.__setattr__(other, name, new)
    return other


def _attached_number(argument: Any, stored: Any, backend: Backend) -> Any:
    """An argument of the constructor in the form of `stored`, the attribute that holds it: a
    number, a tuple of numbers or what contains fields."""
    if isinstance(stored, float):
        return attached_vector(argument, [stored], backend)[0] if _has_array(argument) else stored
    if isinstance(stored, tuple) and _has_array(argument):
        return attached_vector(argument, cast("Any", stored), backend)
    return attached(stored, backend)


def _has_array(value: Any) -> bool:
    """Whether a value is a Dr.Jit array, or a tuple or list with such."""
    entries = cast("Any", value) if isinstance(value, tuple | list) else (value,)
    return any(dr.is_array_v(cast("Any", type(entry))) for entry in entries)


def attached_vector(value: Any, plain: Sequence[float], backend: Backend) -> tuple[Any, ...]:
    """The numbers of a Dr.Jit vector, array or tensor, or of a tuple of numbers, as numbers of a
    backend, with their derivatives. plain: their values."""
    if isinstance(value, tuple | list):
        entries = cast("Any", value)
    else:
        flat = value.array if dr.is_tensor_v(value) else value
        kind = cast("Any", type(flat))
        index = dr.uint32_array_t(kind)
        is_vector = dr.depth_v(kind) > 1
        entries = flat if is_vector else [
            dr.gather(kind, flat, index(k)) for k in range(len(plain))
        ]  # fmt: skip
    return tuple(
        _as_parameter(entry, number, backend) for entry, number in zip(entries, plain, strict=True)
    )


def _as_parameter(entry: Any, plain: float, backend: Backend) -> Any:
    """A number of a backend with the derivative of a Dr.Jit number, if it is one. Its value is a
    kernel parameter: as a literal, each value would compile another kernel."""
    with dr.suspend_grad():
        value = dr.opaque(backend.Float, plain)
    if dr.is_tensor_v(entry):
        entry = entry.array
    return dr.replace_grad(value, backend.Float(entry)) if _has_array(entry) else value


def has_own_formula(field: Any) -> bool:
    """Whether the method `formula` of a field gives its function f. It does not if a user's class
    overrides `evaluate` or `evaluator`, and leaves the formula as it is."""
    for kind in type(field).__mro__:
        if "formula" in vars(kind) or kind.__module__.startswith("harnack."):
            return True
        if "evaluate" in vars(kind):  # a class that defines `evaluator` has it, too
            return False
    return True


def own_formula(field: Any) -> Callable[[Any, Any, Any], Any]:
    """The formula of a field, for a field whose formula is made of it.

    Raises:
        TypeError: a user's class has another function than its formula (`has_own_formula`).
    """
    if not has_own_formula(field):
        name = type(field).__name__
        raise TypeError(
            f"{name} has a function of its own, and the formula of a class that it is derived "
            "from, and here the formula is needed: define formula(x, y, z) of the same function "
            f"in {name}"
        )
    return field.formula
