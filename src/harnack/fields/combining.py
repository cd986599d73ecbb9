"""What the operators + - * / of fields return: weighted sums and products. Of formulas they are
formulas again (`FormulaSum`, `FormulaProduct`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.backend.validation import as_finite
from harnack.fields.attached_numbers import has_own_formula, own_formula
from harnack.fields.field import Field
from harnack.fields.formula import Formula
from harnack.fields.operands import common_domain, common_traits
from harnack.fields.products import FieldProduct, extent_of_product
from harnack.fields.sum_extents import WeightedTerms
from harnack.fields.sums import FieldSum
from harnack.fields.tape_evaluator import extent_of_formula
from harnack.fields.weights import as_number, is_number, separate_weights
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.geometry import Volume


def added(field: Any, other: Any, *, sign: float = 1.0) -> Field:
    """The sum field + sign * other of a field and another field or a number; NotImplemented for
    anything else, so that Python says so. Sums among them are taken apart, so that sums are not
    nested.

    Raises:
        TypeError: a solid.
    """
    if not isinstance(other, Field):
        if not is_number(other):
            return cast("Any", NotImplemented)
        parts = _parts_of(field)
        return make_sum(parts.terms, parts.weights, parts.constant + sign * as_number(other))
    if has_own_operators(other):
        return cast("Any", NotImplemented)
    first, second = _parts_of(field), _parts_of(other)
    weights = (*first.weights, *(sign * weight for weight in second.weights))
    return make_sum((*first.terms, *second.terms), weights, first.constant + sign * second.constant)


def multiplied(field: Any, factor: Any) -> Field:
    """The product of a field with a number. NotImplemented for anything else.

    Raises:
        TypeError: a solid.
    """
    if not is_number(factor):
        return cast("Any", NotImplemented)
    parts, number = _parts_of(field), as_number(factor)
    weights = tuple(weight * number for weight in parts.weights)
    return make_sum(parts.terms, weights, parts.constant * number)


def divided(field: Any, divisor: Any) -> Field:
    """The quotient of a field and a number.

    Raises:
        TypeError: a solid, or a field as the divisor.
        ZeroDivisionError: the number 0.
    """
    if isinstance(divisor, Field):
        raise TypeError(
            f"{with_article(type(divisor).__name__)} cannot be a divisor: a quotient has poles "
            "where it is 0. The level c of f/g is the level 0 of f - c * g, and a quotient of "
            "formulas is written as one formula, harnack.expression(lambda x, y, z: ...)"
        )
    if not is_number(divisor):
        return cast("Any", NotImplemented)
    return multiplied(field, 1.0 / as_number(divisor))


def make_product(first: Field, second: Field) -> Field:
    """The product of two fields."""
    if are_formulas((first, second)):
        return FormulaProduct((first, second))
    return FieldProduct((first, second))


def make_sum(terms: tuple[Field, ...], weights: tuple[Any, ...], constant: Any) -> Field:
    """The weighted sum of fields. A field that occurs several times becomes one term."""
    by_field: dict[int, tuple[Field, Any]] = {}
    for term, weight in zip(terms, weights, strict=True):
        _, known = by_field.get(id(term), (term, 0.0))
        by_field[id(term)] = term, known + weight
    terms = tuple(term for term, _ in by_field.values())
    weights = tuple(weight for _, weight in by_field.values())
    if are_formulas(terms) and all(isinstance(n, float) for n in (*weights, constant)):
        return FormulaSum(terms, weights, constant)
    return FieldSum(terms, weights, constant)


@dataclass(frozen=True)
class _Parts:
    """A field as a weighted sum.

    terms, weights, constant: those of the sum. A weight is a Python number or a Dr.Jit number.
    """

    terms: tuple[Field, ...]
    weights: tuple[Any, ...]
    constant: Any


def _parts_of(field: Field) -> _Parts:
    """The terms of a field that is a sum; the field itself as the only term of all others."""
    if isinstance(field, FormulaSum):
        return _Parts(field.terms, field.weights, field.constant)
    if type(field) is FieldSum:
        weights = separate_weights(field.weights, len(field.terms))
        return _Parts(field.terms, weights, field.constant)
    return _Parts((field,), (1.0,), 0.0)


def are_formulas(fields: Iterable[Field]) -> bool:
    """Whether all fields have formulas, so that what is computed of them is a formula, too."""
    return all(isinstance(field, Formula) and has_own_formula(field) for field in fields)


def has_own_operators(field: Field) -> bool:
    """Whether a field has operators of its own, as solids have."""
    return type(field).__radd__ is not Field.__radd__


@dataclass(frozen=True, eq=False)
class FormulaSum(Formula):
    """The sum w_1 f_1 + ... + w_n f_n + c of formulas, which is a formula.

    terms: the formulas f_i.
    weights, constant: the numbers w_i and c.

    Raises:
        TypeError, ValueError: a number that is not finite.
    """

    traits = dataclasses.replace(Formula.traits, differentiable_arguments=("terms",))

    terms: tuple[Field, ...]
    weights: tuple[float, ...]
    constant: float = 0.0

    def __post_init__(self) -> None:
        """Set what follows from the terms: the domain, the default level, the traits and the
        Lipschitz constant."""
        levels = [term.default_level for term in self.terms]
        constants = [cast("Any", term).lipschitz for term in self.terms]
        weights = tuple(as_finite(weight, "weights") for weight in self.weights)
        for name, value in (
            ("weights", weights),
            ("constant", as_finite(self.constant, "constant")),
            ("domain", common_domain(self.terms)),
            ("default_level", float(np.dot(weights, levels))),
            (
                "traits",
                dataclasses.replace(common_traits(self.terms), differentiable_arguments=("terms",)),
            ),
            (
                "lipschitz",
                None if None in constants else float(np.dot(np.abs(weights), constants)),
            ),
            (
                "is_convex",
                min(weights) >= 0 and all(cast("Any", term).is_convex for term in self.terms),
            ),
        ):
            object.__setattr__(self, name, value)

    @property
    def _weighted(self) -> WeightedTerms:
        return WeightedTerms(self.terms, self.weights, self.constant)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that contains the level sets, as of `FieldSum`; or the box of its formula
        (`extent_of_formula`)."""
        return self._weighted.extent(levels, self.domain) or extent_of_formula(self, levels)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        self._weighted.validate_levels(levels)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        total: Any = self.constant
        for term, weight in zip(self.terms, self.weights, strict=True):
            total = own_formula(term)(x, y, z) * weight + total
        return total


@dataclass(frozen=True, eq=False)
class FormulaProduct(Formula):
    """The product f g of two formulas, which is a formula.

    factors: the two formulas.
    """

    traits = dataclasses.replace(Formula.traits, differentiable_arguments=("factors",))

    factors: tuple[Field, Field]

    def __post_init__(self) -> None:
        """Set what follows from the factors: the domain and the traits."""
        object.__setattr__(self, "domain", common_domain(self.factors))
        traits = dataclasses.replace(
            common_traits(self.factors), differentiable_arguments=("factors",)
        )
        object.__setattr__(self, "traits", traits)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that contains the level sets, as of `FieldProduct`; or the box of its
        formula (`extent_of_formula`)."""
        known = extent_of_product(self.factors, levels, self.domain)
        return known or extent_of_formula(self, levels)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        first, second = self.factors
        if first is second:  # the square has a sharper range
            return own_formula(first)(x, y, z) ** 2
        return own_formula(first)(x, y, z) * own_formula(second)(x, y, z)
