"""Derivatives of fields by arrays of numbers that they are made of, such as the centers of blobs,
the coefficients of a series or the weights of a network (`Traits.differentiable_arguments`).

The constructor computes with the values of the arrays (`host_array`). Where derivatives are wanted,
`attached_array` puts the arrays themselves, with their derivatives, in place of the uploaded
values; the class gives value and gradient at a point as expressions of them, and
`ExpressionFormula` makes a formula of both (`fields.attached_numbers`)."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.jet import Dual
from harnack.arithmetic.operators import FormulaNumber
from harnack.backend import backend_of, to_numpy
from harnack.backend.arrays import upload_floats
from harnack.backend.validation import as_real_array
from harnack.fields.evaluator import Evaluator

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3

FieldType = TypeVar("FieldType")

__all__ = [
    "ExpressionFormula",
    "attached_array",
    "host_array",
    "opaque_numbers",
    "plain_array",
    "scaled_in_space",
    "separate_variable",
    "with_formula",
]


def host_array(
    values: Any,
    name: str,
    error: type[Exception] = ValueError,
    *,
    type_error: type[Exception] | None = None,
) -> FloatArray:
    """The numbers of an argument as a NumPy array in double precision, without derivatives.

    values: an array-like; a Dr.Jit number, array (n,) or vector of n lanes (n, 3), or a tensor; or
        nested lists of these.
    name, error, type_error: as of `as_real_array`, which raises the errors.
    """
    return np.array(
        as_real_array(plain_array(values), name, error, type_error=type_error), np.float64
    )


def plain_array(values: Any) -> Any:
    """The values without derivatives: NumPy arrays in place of Dr.Jit arrays and tensors, also of
    those in lists and tuples; a number in place of a Dr.Jit array of one entry; all else as it
    is."""
    if isinstance(values, list | tuple) and _has_drjit(values):
        return [plain_array(entry) for entry in cast("Any", values)]
    if not _is_drjit(values):
        return cast("Any", values)
    if dr.is_tensor_v(values):
        return np.array(dr.detach(values))
    array = to_numpy(values)
    return array[0] if array.shape == (1,) else array  # a single number


def attached_array(argument: Any, plain: FloatArray, backend: Backend) -> Real:
    """All numbers of an argument, row by row, as an array of the backend with derivatives. The
    values are uploaded ones, so that other numbers compile no other kernel.

    argument: the argument of the constructor, as of `host_array`.
    plain: its values.
    """
    values = upload_floats(backend, np.ascontiguousarray(plain).ravel())
    return dr.replace_grad(values, _flat(argument, backend)) if _has_drjit(argument) else values


def separate_variable(array: Any) -> Any:
    """The same numbers as another variable of Dr.Jit's graph of derivatives. In forward mode a
    derivative cannot pass through two recorded loops of which both use the same variable from
    outside, and one depends on the other."""
    zero = dr.opaque(backend_of(array).Float, 0)  # the sum with a literal would be the same
    return dr.replace_grad(dr.detach(array), array + zero)


def _flat(argument: Any, backend: Backend) -> Real:
    """The numbers of an argument, row by row, as an array of the backend."""
    if isinstance(argument, list | tuple):
        return dr.concat([_flat(entry, backend) for entry in cast("Any", argument)])
    if not _is_drjit(argument):
        return upload_floats(backend, np.asarray(argument, np.float64).ravel())
    return backend.Float(argument.array if dr.is_tensor_v(argument) else dr.ravel(argument))


def opaque_numbers(value: Any, backend: Backend) -> Any:
    """A copy of tuples, mappings and dataclasses with all floats as numbers of a backend that are
    kernel parameters, so that other numbers compile no other kernel. Equal floats become the same
    parameter."""
    known: dict[float, Real] = {}

    def converted(part: Any) -> Any:
        """The copy of a part of the value."""
        if isinstance(part, float):
            if part not in known:
                known[part] = dr.opaque(backend.Float, float(part))
            return known[part]
        if isinstance(part, tuple):
            return tuple(map(converted, cast("tuple[Any, ...]", part)))
        if isinstance(part, dict):
            return {key: converted(entry) for key, entry in cast("dict[Any, Any]", part).items()}
        if not dataclasses.is_dataclass(part) or isinstance(part, type):
            return part
        other = copy.copy(part)
        for entry in dataclasses.fields(part):
            object.__setattr__(other, entry.name, converted(getattr(part, entry.name)))
        return other

    return converted(value)


def with_formula(
    field: FieldType,
    expression: Callable[[Vec3], tuple[Real, Vec3]],
    value: Callable[[Vec3], Real] | None = None,
) -> FieldType:
    """A copy of a field whose formula is the `ExpressionFormula` of these functions."""
    other = copy.copy(field)
    formula = ExpressionFormula(type(field).__name__, expression, value)
    object.__setattr__(other, "formula", formula)
    return other


def scaled_in_space(evaluator: Evaluator, size: Real) -> Callable[[Vec3], tuple[Real, Vec3]]:
    """The value and the gradient of a field that scales with a size s of its own, f(p; s) = F(p/s),
    as expressions that Dr.Jit can differentiate with respect to p and s.

    evaluator: of the field with the value of s, which has second derivatives.
    size: s, a number with derivatives.

    With the value s0 of s and q = p s0/s, f(p; s) = f(q; s0) and grad f(p; s) = (s0/s) grad f(q;
    s0). q and s0/s have the derivatives by s; those of f and grad f by q are their gradient and
    Hessian at the value s0.
    """

    def expression(p: Vec3) -> tuple[Real, Vec3]:
        """f and grad f at p."""
        ratio = dr.detach(size) / size
        q = p * ratio
        gradient = Evaluator.differentiable_gradient(evaluator, q)
        assert gradient is not None, "the evaluator has second derivatives"
        return Evaluator.differentiable_value(evaluator, q), ratio * gradient

    return expression


def _is_drjit(value: Any) -> bool:
    """Whether a value is a Dr.Jit array."""
    return dr.is_array_v(cast("Any", type(value)))


def _has_drjit(value: Any) -> bool:
    """Whether a value is a Dr.Jit array, or a nested list with such."""
    if isinstance(value, list | tuple):
        return any(map(_has_drjit, cast("Any", value)))
    return _is_drjit(value)


@dataclass(frozen=True, eq=False)
class ExpressionFormula:
    """A formula f(x, y, z) that is made of f and grad f at points.

    name: the name of the field's class, for messages.
    expression: a function of points p that returns f(p) and grad f(p) as expressions which Dr.Jit
        can differentiate with respect to p and to the field's numbers.
    value: the same for f(p) alone; None where the other function costs no more.

    On Dr.Jit numbers the formula is f. On dual numbers the first derivatives follow by the chain
    rule: with coordinates x_k that have the derivatives x_k,j, those of f are the sums over k of
    (grad f)_k x_k,j.
    """

    name: str
    expression: Callable[[Vec3], tuple[Real, Vec3]]
    value: Callable[[Vec3], Real] | None = None

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates.

        Raises:
            TypeError: the coordinates are ranges.
        """
        like = next((c for c in (x, y, z) if isinstance(c, FormulaNumber)), None)
        if like is None:
            p = backend_of(x).Array3f(x, y, z)
            return self.expression(p)[0] if self.value is None else self.value(p)
        if not isinstance(like, Dual):
            raise TypeError(f"with its numbers attached, {self.name} gives no ranges")
        coordinates = [like.coerce(c) for c in (x, y, z)]
        values = [c.value for c in coordinates]
        value, gradient = self.expression(backend_of(values[0]).Array3f(*values))
        zero = 0 * value
        first = [
            sum((gradient[k] * c.first_derivatives[j] for k, c in enumerate(coordinates)), zero)
            for j in range(3)
        ]
        return Dual(value, (first[0], first[1], first[2]))
