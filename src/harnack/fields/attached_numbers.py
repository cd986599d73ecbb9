"""Derivatives of formulas by the numbers that they are made of, such as the radius of a sphere.

A field stores Python numbers. If arguments of its constructor were Dr.Jit numbers with derivatives,
these are kept beside (`fields.parameters`). Here a copy of the field has them in place of its own,
and its formula, evaluated with plain Dr.Jit numbers, is an expression that Dr.Jit differentiates.
So this serves fields whose formula uses the attributes of `Traits.differentiable_arguments` as they
are, and nothing that was computed of them in Python: this would have no derivative."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.jet import Dual
from harnack.backend.elementary import max_norm
from harnack.backend.validation import has_derivatives
from harnack.fields.evaluator import Evaluator
from harnack.fields.number_table import AlikeParts, NumberReader, NumberRecorder, NumberTable
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
    "extreme_of_parts",
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
    """The formula of a field with its numbers attached, for the lanes of points p."""
    if hasattr(field, "formula"):
        own_formula(field)  # raises an error if a user's class has another function
    return attached(field, NumberTable.of(field, p)).formula


def attached(value: Any, numbers: NumberReader) -> Any:
    """A copy of a field, in which arguments with derivatives are in place of the attributes that
    hold their numbers, in the fields that it is made of as well; or the copy of what contains
    fields."""
    if isinstance(value, tuple):
        return tuple(attached(entry, numbers) for entry in cast("tuple[Any, ...]", value))
    # Of parts that are alike, the numbers of all are read.
    traits: Any = getattr(value, "traits", None)
    is_read = not isinstance(numbers, NumberTable) and bool(
        traits is not None and traits.differentiable_arguments
    )
    if not is_read and ATTACHED not in getattr(value, "__dict__", {}):
        return _SampledPart.of(value, numbers) if hasattr(value, "evaluator") else value
    own = getattr(value, "with_read_numbers", None)
    if own is not None:
        return own(numbers)
    own = getattr(value, "with_attached_numbers", None)  # of a class that reads its numbers itself
    if own is not None:
        return own(cast("NumberTable", numbers).backend)
    return with_attached_arguments(value, value.traits.differentiable_arguments, numbers)


@dataclass(frozen=True, eq=False)
class _SampledPart:
    """A field without numbers with derivatives, and without a formula of plain numbers, as a part
    of one with such numbers: its function is sampled."""

    evaluator: Evaluator
    vector: Any

    @classmethod
    def of(cls, field: Any, numbers: NumberReader) -> Any:
        """The field itself if it has a formula, or such a part."""
        try:
            own_formula(field)(0.1, 0.2, 0.3)
        except (AttributeError, TypeError):
            backend = cast("NumberTable", numbers).backend
            return cls(field.evaluator(backend), backend.Array3f)
        return field

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit or dual numbers."""
        dual = next((v for v in (x, y, z) if isinstance(v, Dual)), None)
        if dual is None:
            return self.evaluator.differentiable_value(self.vector(x, y, z))
        coordinates = [dual.coerce(v) for v in (x, y, z)]
        point = self.vector(*(v.value for v in coordinates))
        gradient = self.evaluator.differentiable_gradient(point)
        if gradient is None:
            raise TypeError(f"second derivatives of {self.evaluator.name} are not known")
        slopes = [
            sum(gradient[k] * coordinates[k].first_derivatives[i] for k in range(3))
            for i in range(3)
        ]
        value = self.evaluator.differentiable_value(point)
        return Dual(value, (slopes[0], slopes[1], slopes[2]))


def with_attached_arguments(field: Any, names: tuple[str, ...], numbers: NumberReader) -> Any:
    """The copy of a field with its arguments of these names attached (`attached`)."""
    other, kept = copy.copy(field), kept_arguments(field)
    for name in list(attributes_of(other)):
        # What was computed of the numbers is computed anew.
        if isinstance(
            inspect.getattr_static(cast("Any", type(field)), name, None), cached_property
        ):
            del attributes_of(other)[name]
    literals: tuple[str, ...] = getattr(field, "literals", ())
    for name in names:
        number = kept.get(name)
        old = getattr(field, name)
        if name in literals and not has_derivatives(number):
            continue
        if isinstance(old, Mapping):
            own: dict[str, Any] = number or {}
            entries = cast("Any", old).items()
            new: Any = {k: _attached_number(own.get(k, e), e, numbers) for k, e in entries}
        else:
            new = _attached_number(old if number is None else number, old, numbers)
        object.__setattr__(other, name, new)
    return other


def _attached_number(argument: Any, stored: Any, numbers: NumberReader) -> Any:
    """An argument of the constructor in the form of `stored`, the attribute that holds it: a
    number, a tuple of numbers or what contains fields."""
    if isinstance(stored, float):
        return numbers.vector(argument, [stored])[0]
    if _is_numbers(stored):
        return numbers.vector(argument, stored)
    return attached(stored, numbers)


def _is_numbers(value: Any) -> bool:
    """Whether a value is a tuple of floats."""
    entries = cast("tuple[Any, ...]", value) if isinstance(value, tuple) else ()
    return bool(entries) and all(isinstance(entry, float) for entry in entries)


# So many parts with formulas that are alike are evaluated as one.
_MIN_ALIKE = 4


def extreme_of_parts(
    parts: tuple[Any, ...], numbers: NumberReader, *, is_least: bool
) -> tuple[Any, ...]:
    """The fields `parts` with their numbers attached, of which the least or greatest function
    counts. Of those whose formulas are alike, `AlikeParts` takes the place."""
    if not isinstance(numbers, NumberTable):
        return attached(parts, numbers)
    groups: dict[Any, list[Any]] = {}
    for number, part in enumerate(parts):
        shape = _shape_of(part)
        groups.setdefault((number,) if shape is None else shape, []).append(part)
    new: list[Any] = []
    for group in groups.values():
        # What has no derivatives is left as it is, unless it is many.
        if len(group) < _MIN_ALIKE:
            new += attached(tuple(group), numbers)
            continue
        recorders = [NumberRecorder(numbers) for _ in group]
        for part, recorder in zip(group, recorders, strict=True):
            attached(part, recorder)
        new.append(
            AlikeParts(
                numbers,
                np.array([recorder.values for recorder in recorders]),
                np.array([recorder.places for recorder in recorders]),
                functools.partial(attached, group[0]),
                is_least=is_least,
            )
        )
    return tuple(new)


def _shape_of(value: Any) -> Any:
    """What two parts have in common if they have the same formula of other numbers: the class, and
    all that is no number; None if that is not known."""
    if isinstance(value, float):
        return float
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, tuple):
        shapes = tuple(map(_shape_of, cast("tuple[Any, ...]", value)))
        return None if None in shapes else shapes
    kind = cast("Any", type(value))
    traits = getattr(value, "traits", None)
    is_known = kind.__module__.startswith("harnack.") and dataclasses.is_dataclass(value)
    reads_itself = hasattr(value, "with_attached_numbers")
    if not is_known or traits is None or reads_itself or not has_own_formula(value):
        return getattr(value, "alike_key", None)
    shapes = [kind]
    literals: tuple[str, ...] = getattr(value, "literals", ())
    for entry in dataclasses.fields(value):
        own = getattr(value, entry.name)
        is_literal = entry.name in literals
        if is_literal and has_derivatives(kept_arguments(value).get(entry.name)):
            return None
        is_number = entry.name in traits.differentiable_arguments or not entry.init
        is_number &= not is_literal
        is_fixed = not is_number and (isinstance(own, float) or _is_numbers(own))
        shape = own if is_fixed else _shape_of(own)
        if shape is None and own is not None:
            return None
        shapes.append(shape)
    return tuple(shapes)


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
