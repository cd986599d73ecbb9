"""Weighted sums of fields, w_1 f_1 + ... + w_n f_n + c. The fields are the terms of the sum. A sum
is sampled by samples of its terms: values and derivatives are added, and so are their proved bounds
(`enclosures.sums`). A sum of harmonic terms is harmonic. If all terms are formulas, so is the sum.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of, to_numpy
from harnack.backend.elementary import fmin
from harnack.backend.tensors import accepts_tensors, is_tensor, tensor_to_array
from harnack.backend.validation import as_finite, format_short
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.enclosures import Lipschitz
from harnack.enclosures.parabola_arithmetic import (
    RayFunction,
    summed_enclosure,
    summed_slope,
    weighted_enclosure,
)
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.enclosures.sums import shared_reach, summed_sample, weighted_sample
from harnack.fields.capabilities import Boundary, VariableAccuracy
from harnack.fields.clearance import bounded_side_extent
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits, check_is_field
from harnack.fields.formula import Formula, has_own_formula, own_formula
from harnack.fields.formula_evaluator import FormulaEvaluator
from harnack.fields.parameters import differentiable_parameters
from harnack.geometry.clip_volumes import VolumeIntersection, box_around_volumes
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Precision, Real, Vec3
    from harnack.enclosures import Enclosure
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid

# Products of weights and periods are multiples of a common period if their quotients are fractions
# with a denominator up to this, up to a relative error of this size.
_MAX_DENOMINATOR, _PERIOD_ERROR = 64, 1e-12


class FieldSum(Field):
    """The sum w_1 f_1 + ... + w_n f_n + c of fields f_i, its terms, as a field. It is also written
    by operators: 2 * f + g / 3 - 1.

    terms: the fields f_i: one, or a list.
    weights: the numbers w_i, as a list, an array (n,), or a Dr.Jit array or tensor of n numbers; by
        default 1 for each. Entries of a list may be Dr.Jit numbers. Dr.Jit arrays may have
        derivatives enabled: then values and hits have derivatives with respect to them.
    constant: the number c, which may be a Dr.Jit number.

    The domain is the intersection of the domains of the terms. The default level is the sum of
    theirs, times the weights; the constant does not move it. If that is a multiple of the period,
    half the period is added, since such a level set extends to infinity.

    If one term is angle-valued with the period P, the sum has the period |w| P. Of several such
    terms it has the largest period of which all |w_i| P_i are multiples; so their weights are
    integers, or have simple fractions as quotients.

    Raises:
        TypeError: a term that is no field, or a weight that is no number.
        ValueError: no terms; not a weight for each; a number that is not finite; angle-valued terms
            whose weights have no such quotients, or are Dr.Jit numbers; a term that jumps across
            facets or is a union of patches.
    """

    traits = Traits(has_parameter_derivatives=True)

    def __init__(
        self, terms: Field | Iterable[Field], weights: Any = None, constant: Any = 0.0
    ) -> None:
        """Check the arguments, which the class describes, and set what follows from the terms: the
        domain, the period, the default level and the traits."""
        entries = (terms,) if isinstance(terms, Field) else tuple(terms)
        if not entries:
            raise ValueError("give at least one term")
        for term in entries:
            check_term(term)
        self.terms: tuple[Field, ...] = entries
        self.weights = _checked_weights(weights, len(entries))
        self.constant = _checked_number(constant, "constant")
        self._weight_numbers = _host_numbers(self.weights)
        self._constant_number = _host_number(self.constant)
        for number in (*self._weight_numbers, self._constant_number):
            as_finite(number, "weights and constant")
        period = _common_period(entries, self.weights, self._weight_numbers)
        object.__setattr__(self, "period", period)  # of the instance, in place of the class's
        self.domain = common_domain(entries)
        levels = [term.default_level for term in entries]
        level = float(np.dot(self._weight_numbers, levels))
        if self.period is not None and abs(math.remainder(level, self.period)) < 1e-6 * self.period:
            level += 0.5 * self.period  # the value far away has no bounded level set
        self.default_level = level
        self.traits = dataclasses.replace(
            common_traits(entries),
            is_larger_inside=all(
                term.traits.is_larger_inside == (weight > 0)
                for term, weight in zip(entries, self._weight_numbers, strict=True)
            ),
            has_parameter_derivatives=True,
        )

    @property
    def boundary(self) -> Boundary | None:
        """The curves and points at which the level sets of any term end; None if there are none."""
        pairs = zip(self.terms, self._weight_numbers, strict=True)
        known = [(t.boundary, w) for t, w in pairs if w != 0 and t.boundary is not None]
        boundaries = [boundary for boundary, _ in known]
        if not boundaries:
            return None
        if len(self.terms) == 1:
            return _weighted_boundary(boundaries[0], known[0][1])
        return joined_boundary(boundaries)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that contains the level sets: of a single term, that of its own level sets; of
        several terms, the domain or, without a domain, a box around volumes that are proved for
        each of them (`_extents_of_terms`)."""
        inner = self._levels_of_single(levels)
        if inner is not None:
            return self.terms[0].extent(inner)
        if self.domain is not None:
            return self.domain
        volumes = [volume for level in levels for volume in self._extents_of_terms(level)]
        known = [volume for volume in volumes if volume is not None]
        return box_around_volumes(known) if known and len(known) == len(volumes) else None

    def _extents_of_terms(self, level: float) -> list[Volume | None]:
        """Volumes that together contain the level set of a level; None among them if one is not
        known, as for terms that do not fall off with the distance.

        Proof. Let g be the difference between the level and the constant. Where the sum of n terms
        takes the level, one of the w_i f_i is at least g/n, if g > 0; at most g/n, if g < 0. If a
        term is angle-valued, g is reduced by the nearest multiple of the period, and one of the w_i
        f_i differs from each multiple of its own period by at least |g|/n: otherwise the sum would
        differ from a multiple of the period by less than |g|. Where a term has such values, it has
        these levels, or is on one side of them (`bounded_side_extent`).
        """
        pairs = zip(self.terms, self._weight_numbers, strict=True)
        used = [(term, weight) for term, weight in pairs if weight != 0]
        gap = level - self._constant_number
        if self.period is not None:
            gap = math.remainder(gap, self.period)
        if gap == 0 or not used:
            return [None]
        distance_of_all = abs(gap) / len(used)
        sign = None if self.period is not None else math.copysign(1.0, gap)
        return [
            _far_from_zero(term, weight, distance_of_all, sign)
            for term, weight in used
            # Otherwise no value differs so much from the nearest multiple of the period.
            if term.period is None or distance_of_all <= abs(weight) * 0.5 * term.period
        ]

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        inner = self._levels_of_single(levels)
        if inner is not None:
            self.terms[0].validate_levels(inner)

    def _levels_of_single(self, levels: tuple[float, ...]) -> tuple[float, ...] | None:
        """The levels of the only term whose level sets are those of the sum; None if there are
        several terms, or if the weight is 0."""
        (weight, *others), constant = self._weight_numbers, self._constant_number
        if others or weight == 0:
            return None
        return tuple((level - constant) / weight for level in levels)

    def describe(self) -> dict[str, Any]:
        """The number of terms, as a dictionary for users."""
        return {"terms": len(self.terms)}

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision | None = None) -> Any:
        """The values (n,) of the sum at points (n, 3), as of `Field.value`: those of the terms,
        times their weights, added up. An angle-valued sum is reduced by its period only as far as
        its terms are."""
        if carries_derivatives(self, points):
            return super().value(points, precision=precision)
        values = (term.value(points, precision=precision) for term in self.terms)
        return self._weighted_total(values) + self._constant_number

    @accepts_dask_arrays("points")
    @accepts_tensors
    def gradient(self, points: Any, *, precision: Precision | None = None) -> Any:
        """The gradients (n, 3) of the sum at points (n, 3), as of `Field.gradient`: those of the
        terms, times their weights, added up."""
        if carries_derivatives(self, points):
            return super().gradient(points, precision=precision)
        return self._weighted_total(
            term.gradient(points, precision=precision) for term in self.terms
        )

    def _weighted_total(self, numbers: Iterable[Any]) -> Any:
        """The sum of numbers or vectors, one for each term, times the weights of the terms."""
        products = [n * w for n, w in zip(numbers, self._weight_numbers, strict=True)]
        return functools.reduce(operator.add, products)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> SumEvaluator:
        levels = self._levels_of_single(plan.levels) or ()
        inner_plan = Plan(levels, plan.ray_count)
        moved = _device_numbers(self.weights, backend, len(self.terms))
        terms = tuple(
            _Term(
                term.evaluator(backend, inner_plan),
                dr.opaque(backend.Float, number),
                number,
                weight,
            )
            for term, number, weight in zip(self.terms, self._weight_numbers, moved, strict=True)
        )
        moved_constant = _device_number(self.constant, backend)
        constant = dr.opaque(backend.Float, self._constant_number)
        return SumEvaluator(terms, constant, self._constant_number != 0, moved_constant)


def carries_derivatives(field: Field, points: Any) -> bool:
    """Whether points or parameters of a field are Dr.Jit arrays with derivatives enabled."""
    arrays = (points, *differentiable_parameters(field))
    return any(dr.is_array_v(cast("Any", type(a))) and dr.grad_enabled(a) for a in arrays)


def _far_from_zero(
    field: Field, weight: float, distance: float, sign: float | None
) -> Volume | None:
    """A volume that contains all points at which weight * f is at least `distance`, for the sign 1,
    or at most -distance, for the sign -1. For the sign None, both; and for an angle-valued f, those
    at which it differs from each multiple of its period by so much. None if none is known."""
    period = math.inf if field.period is None else abs(weight) * field.period

    def is_far(value: float) -> bool:
        """Whether points at which f is `value` are among those."""
        weighted = math.remainder(weight * value, period)
        return (abs(weighted) if sign is None else sign * weighted) >= distance

    signs = (1.0, -1.0) if sign is None else (sign,)
    return bounded_side_extent(field, tuple(s * distance / weight for s in signs), is_far)


@dataclass(frozen=True, eq=False)
class FormulaSum(Formula):
    """The sum w_1 f_1 + ... + w_n f_n + c of formulas, which is a formula.

    terms: the formulas f_i.
    weights, constant: the numbers w_i and c.

    Raises:
        TypeError, ValueError: a number that is not finite.
    """

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
            ("traits", common_traits(self.terms)),
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

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        total: Any = self.constant
        for term, weight in zip(self.terms, self.weights, strict=True):
            total = own_formula(term)(x, y, z) * weight + total
        return total


@dataclass(frozen=True, eq=False)
class _Term:
    """A term of a sum on a backend.

    evaluator: the evaluator of the field f.
    weight: its weight, a kernel parameter without derivatives.
    number: the same as a Python number.
    moved_weight: the weight as it was given if it is a Dr.Jit number, which may have derivatives;
        else None.
    """

    evaluator: Evaluator
    weight: Real
    number: float
    moved_weight: Real | None

    @property
    def is_negative(self) -> bool:
        """Whether the weight is below 0."""
        return self.number < 0

    def sample(self, sample: Sample) -> Sample:
        """The sample of weight * f, from that of f."""
        if self.number == 1:
            return sample
        return weighted_sample(
            sample, self.weight, is_negative=self.is_negative, is_exact=self.number == -1
        )

    def enclosure(self, enclosure: Enclosure) -> Enclosure:
        """The enclosure of the change of weight * f, from that of the change of f."""
        if self.number == 1:
            return enclosure
        return weighted_enclosure(enclosure, self.weight, is_negative=self.is_negative)

    def differentiable_value(self, p: Vec3) -> Real:
        """weight * f at p, with derivatives with respect to p, the weight and parameters of f."""
        weight = self.weight if self.moved_weight is None else self.moved_weight
        return weight * self.evaluator.differentiable_value(p)


@dataclass(frozen=True, eq=False)
class SumEvaluator(Evaluator):
    """The evaluator of a sum of fields.

    terms: the terms, with their weights.
    constant: the constant, a kernel parameter without derivatives.
    has_constant: whether it is not 0.
    moved_constant: the constant as it was given if it is a Dr.Jit number; else None.
    """

    terms: tuple[_Term, ...]
    constant: Real
    has_constant: bool
    moved_constant: Real | None

    @property
    def name(self) -> str:
        """The name of the field's class, for messages."""
        return FieldSum.__name__

    @property
    def is_steep(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return any(term.evaluator.is_steep for term in self._sampled)

    @property
    def _sampled(self) -> tuple[_Term, ...]:
        """The terms whose weights are not 0."""
        return tuple(term for term in self.terms if term.number != 0)

    @property
    def variable_accuracy(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> VariableAccuracy | None:
        """How f is sampled with different accuracy: all terms that can be sampled so have the same
        accuracy scale. None if there is no such term."""
        accuracies = [term.evaluator.variable_accuracy for term in self.terms]
        known = [accuracy for accuracy in accuracies if accuracy is not None]

        def at(scale: Real) -> Evaluator:
            """The sum, with its terms sampled at this accuracy scale."""
            terms = tuple(
                term if a is None else dataclasses.replace(term, evaluator=a.at(scale))
                for term, a in zip(self.terms, accuracies, strict=True)
            )
            return dataclasses.replace(self, terms=terms)

        return VariableAccuracy(at, min(a.coarsest for a in known)) if known else None

    def evaluate(self, p: Vec3) -> Sample:
        return self._sum([term.evaluator.evaluate(p) for term in self._sampled], p)

    def _sum(self, samples: list[Sample], p: Vec3) -> Sample:
        """The sample of the sum at p, from those of the fields whose weights are not 0."""
        pairs = zip(self._sampled, samples, strict=True)
        weighted = [term.sample(sample) for term, sample in pairs]
        if not weighted:
            zero = 0 * p.x
            return Sample(zero + self.constant, 0 * p, (Lipschitz(zero),))
        if len(weighted) == 1 and not self.has_constant:
            return weighted[0]
        return summed_sample(weighted, self.constant)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample of the sum at the point of a ray with parameter t, with enclosures in front of
        the point and behind it. Those of a single term are its own, scaled."""
        sampled = self._sampled
        if len(sampled) == 1:
            return self._single_ray(path, t, ahead, back)
        if not sampled:
            return path.enclose(self._sum([], path.point(t)))
        evaluators = [term.evaluator for term in sampled]
        ray_samples = sample_rays(evaluators, path, t, ahead, back)
        sample = self._sum([entry.sample for entry in ray_samples], path.point(t))
        weighted = [
            (term, term.sample(entry.sample), entry)
            for term, entry in zip(sampled, ray_samples, strict=True)
        ]
        functions = [
            RayFunction.ahead(entry).weighted(term.weight, part) for term, part, entry in weighted
        ]
        if not any(function.has_ranges for function in functions):
            return path.enclose(sample)
        length = fmin(shared_reach([part for _, part, _ in weighted]), ahead)
        forward = summed_enclosure(functions, length)
        if forward is None:
            raise ValueError(nothing_known_message(evaluators, functions))
        behind = [
            RayFunction.behind(entry).weighted(term.weight, part) for term, part, entry in weighted
        ]
        backward = summed_enclosure(behind, fmin(length, back))
        slope, error = summed_slope([f.slopes for f in functions])
        growth = max(entry.reach_growth for entry in ray_samples)
        backwards = () if backward is None else (backward,)
        return RaySample(sample, (forward,), backwards, slope, growth, error)

    def _single_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The ray sample of a sum with a single term whose weight is not 0."""
        (term,) = self._sampled
        inner = term.evaluator.sample_ray(path, t, ahead, back)
        size = dr.abs(term.weight)
        slope_error, min_norm = inner.slope_error, inner.min_gradient_norm
        return RaySample(
            self._sum([inner.sample], path.point(t)),
            tuple(map(term.enclosure, inner.forward)),
            tuple(map(term.enclosure, inner.backward)),
            term.weight * inner.slope,
            inner.reach_growth,
            None if slope_error is None else size * slope_error,
            None if min_norm is None else size * min_norm,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        rows = [0 * p, 0 * p, 0 * p]
        for term in self._sampled:
            pairs = zip(rows, term.evaluator.hessian(p), strict=True)
            rows = [row + term.weight * other for row, other in pairs]
        return rows[0], rows[1], rows[2]

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p, of the gradient and of the Hessian: those of the terms, times
        their weights, added up. The rounding of the additions is left to the gradient's error in
        `sample`; that of the Hessian counts as twice the machine epsilon of each term's entries."""
        epsilon = 2 * float(dr.epsilon(type(p.x)))
        first, second = 0 * p.x, 0 * p.x
        for term in self._sampled:
            inner = term.evaluator.evaluate(p)
            gradient_error, hessian_error = term.evaluator.derivative_errors(p, inner)
            size = dr.abs(term.weight)
            rows = term.evaluator.hessian(p) if hessian_error is not math.inf else ()
            entries = sum((dr.abs(entry) for row in rows for entry in row), 0 * p.x)
            first = first + size * gradient_error
            second = second + size * (hessian_error + 2 * len(self.terms) * epsilon * entries)
        return dr.select(first > sample.gradient_error, first, sample.gradient_error), second

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A bound of |grad f(y) - grad f(p)| for |y - p| <= radius: the sum of those of the
        terms, times the absolute values of their weights."""
        bound = 0 * p.x
        for term in self._sampled:
            bound = bound + dr.abs(term.weight) * term.evaluator.gradient_change_bound(p, radius)
        return bound * (1 + 1e-6)

    def occupied_cells(self) -> OccupancyGrid | None:
        """The grid of the only term, which is asked for the same level sets; None for several."""
        return self.terms[0].evaluator.occupied_cells() if len(self.terms) == 1 else None

    def differentiable_value(self, p: Vec3) -> Real:
        value = self.constant if self.moved_constant is None else self.moved_constant
        for term in self.terms:
            if term.number != 0 or term.moved_weight is not None:
                value = value + term.differentiable_value(p)
        return value


def sample_rays(
    evaluators: Sequence[Evaluator], path: Ray, t: Real, ahead: Real, back: Real
) -> list[RaySample]:
    """The ray samples of several functions at the points of rays with parameter t. Ranges of
    formulas are computed on lengths on which bounds of all other functions hold, because longer
    ones would be less sharp.

    path, ahead, back: as of `Evaluator.sample_ray`.
    """
    samples: dict[int, RaySample] = {}
    is_formula = [isinstance(evaluator, FormulaEvaluator) for evaluator in evaluators]
    for k, evaluator in enumerate(evaluators):
        if not is_formula[k]:
            samples[k] = evaluator.sample_ray(path, t, ahead, back)
    length = fmin(shared_reach([entry.sample for entry in samples.values()]), ahead)
    for k, evaluator in enumerate(evaluators):
        if is_formula[k]:
            samples[k] = evaluator.sample_ray(path, t, length, back)
    return [samples[k] for k in range(len(evaluators))]


def nothing_known_message(evaluators: Sequence[Evaluator], functions: Sequence[RayFunction]) -> str:
    """The text of an error: of one of several functions nothing is known along a ray with which
    bounds of sums and products are made."""
    names = [
        evaluator.name
        for evaluator, function in zip(evaluators, functions, strict=True)
        if function.parabola(1.0) is None
    ]
    return (
        f"{' and '.join(names)} promises neither a harmonic ball, nor a bound of the second "
        "derivatives, nor a Lipschitz constant, so that no bound of a sum or product follows"
    )


# Operators.


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
        weights = _separate_weights(field.weights, len(field.terms))
        return _Parts(field.terms, weights, field.constant)
    return _Parts((field,), (1.0,), 0.0)


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


def are_formulas(fields: Iterable[Field]) -> bool:
    """Whether all fields have formulas, so that what is computed of them is a formula, too."""
    return all(isinstance(field, Formula) and has_own_formula(field) for field in fields)


def has_own_operators(field: Field) -> bool:
    """Whether a field has operators of its own, as solids have."""
    return type(field).__radd__ is not Field.__radd__


def is_number(value: Any) -> bool:
    """Whether a value is a number of Python or NumPy, and no boolean; or a Dr.Jit array or tensor,
    which then must hold a single number."""
    if isinstance(value, bool | np.bool_):
        return False
    return isinstance(value, numbers.Real) or dr.is_array_v(cast("Any", type(value)))


def as_number(value: Any) -> Any:
    """The number `value` as a float, or as a Dr.Jit array of one lane.

    Raises:
        TypeError: a Dr.Jit array of other than real numbers.
        ValueError: a Dr.Jit array of several numbers.
    """
    return _checked_number(value, "a number beside a field")


# Arguments.


def check_term(term: Any) -> None:
    """Raise an error if a field cannot be a term of a sum or a factor of a product."""
    check_is_field(term)
    name = with_article(type(term).__name__)
    if term.traits.has_jumps:
        raise ValueError(
            f"{name} jumps across facets, and sums and products of such fields are not known: of "
            "winding numbers of closed meshes, add solids (harnack.solid(mesh)) by |, & and -; of "
            "open ones, take harnack.SolidAngle of their boundaries, which does not jump"
        )
    if term.traits.has_patches:
        raise ValueError(f"{name} is a union of many surfaces, which have no common function")


def _checked_number(value: Any, name: str) -> Any:
    """A number as a float, or as a Dr.Jit array of one lane. name: what it is, for messages."""
    kind = cast("Any", type(value))
    if not dr.is_array_v(kind):
        return as_finite(value, name)
    array = tensor_to_array(value, name) if is_tensor(value) else value
    if dr.depth_v(type(array)) != 1 or dr.width(array) != 1:
        raise ValueError(f"{name} must be a single number, not {format_short(value)}")
    backend_of(array)  # raises TypeError for other than real numbers
    return array


def _checked_weights(weights: Any, count: int) -> Any:
    """The weights of a sum of `count` terms: a tuple of floats and Dr.Jit arrays of one lane, or
    one Dr.Jit array of `count` lanes."""
    if weights is None:
        return (1.0,) * count
    if dr.is_array_v(cast("Any", type(weights))):
        array = tensor_to_array(weights, "weights") if is_tensor(weights) else weights
        backend_of(array)
        if dr.depth_v(type(array)) != 1 or dr.width(array) != count:
            raise ValueError(f"{count} terms need {count} weights, not {format_short(weights)}")
        return array
    try:
        entries = tuple(weights)
    except TypeError:
        raise TypeError(f"weights must be a list of numbers, not {weights!r}") from None
    if len(entries) != count:
        raise ValueError(f"{count} terms need {count} weights, not {len(entries)}")
    return tuple(_checked_number(entry, "weights") for entry in entries)


def _separate_weights(weights: Any, count: int) -> tuple[Any, ...]:
    """The weights of a sum one by one: Python numbers and Dr.Jit arrays of one lane."""
    if isinstance(weights, tuple):
        return cast("tuple[Any, ...]", weights)
    index = backend_of(weights).UInt32
    return tuple(dr.gather(type(weights), weights, index(k)) for k in range(count))


def _host_number(number: Any) -> float:
    """A Python number, or a Dr.Jit array of one lane, as a float."""
    return number if isinstance(number, float) else float(to_numpy(number)[0])


def _host_numbers(weights: Any) -> tuple[float, ...]:
    """Weights as floats."""
    if isinstance(weights, tuple):
        return tuple(_host_number(weight) for weight in cast("tuple[Any, ...]", weights))
    return tuple(map(float, to_numpy(weights)))


def _device_number(number: Any, backend: Backend) -> Real | None:
    """A Dr.Jit number in the precision of a backend, with its derivatives; None for a float."""
    return None if isinstance(number, float) else backend.Float(number)


def _device_numbers(weights: Any, backend: Backend, count: int) -> tuple[Real | None, ...]:
    """Weights that are Dr.Jit numbers in the precision of a backend, with their derivatives; None
    in place of floats."""
    return tuple(_device_number(weight, backend) for weight in _separate_weights(weights, count))


# What follows from the terms.


def common_domain(fields: Iterable[Field]) -> Volume | None:
    """The intersection of the domains of fields; None if none has one."""
    domains = list(dict.fromkeys(field.domain for field in fields if field.domain is not None))
    if not domains:
        return None
    return domains[0] if len(domains) == 1 else VolumeIntersection(domains)


def common_traits(fields: tuple[Field, ...]) -> Traits:
    """The traits of a function that is made of fields by additions and multiplications."""
    traits = [field.traits for field in fields]
    wavelengths = [entry.min_wavelength for entry in traits if entry.min_wavelength is not None]
    return Traits(
        # A step longer than the proved one is accepted only if every field proves the rest of it.
        over_relaxation=min(entry.over_relaxation for entry in traits),
        min_wavelength=min(wavelengths, default=None),
        is_cheap=all(entry.is_cheap for entry in traits),
        is_global=all(field.traits.is_global or field.domain is None for field in fields),
        has_creases=any(entry.has_creases for entry in traits),
        has_variable_accuracy=any(entry.has_variable_accuracy for entry in traits),
    )


def _common_period(
    terms: tuple[Field, ...], weights: Any, numbers_of_weights: tuple[float, ...]
) -> float | None:
    """The period of a weighted sum: the largest number of which all |w_i| P_i are multiples, where
    P_i are the periods of the angle-valued terms; None if there is no such term.

    Proof. A term is known up to multiples of |w_i| P_i. So the sum is known up to sums of such
    numbers with integer coefficients. These are the multiples of the greatest common divisor.

    Raises:
        ValueError: there is none, or a weight of an angle-valued term is a Dr.Jit number.
    """
    separate = _separate_weights(weights, len(terms))
    angles: list[float] = []
    for term, weight, number in zip(terms, separate, numbers_of_weights, strict=True):
        if term.period is None:
            continue
        if not isinstance(weight, float):
            raise ValueError(
                f"the weight of {with_article(type(term).__name__)}, which is angle-valued, must "
                "be a number of Python, and no Dr.Jit number: the period of the sum follows from it"
            )
        if number != 0:
            angles.append(abs(number) * term.period)
    if not angles:
        return None
    numerator, denominator = 0, 1
    for angle in angles:
        quotient = angle / angles[0]
        fraction = Fraction(quotient).limit_denominator(_MAX_DENOMINATOR)
        if fraction == 0 or abs(float(fraction) - quotient) > _PERIOD_ERROR * quotient:
            raise ValueError(
                "the weights of angle-valued terms must be integers, or have simple fractions as "
                f"quotients: with {format_short(numbers_of_weights)} no value of the sum is "
                "determined"
            )
        numerator = math.gcd(numerator, fraction.numerator)
        denominator = math.lcm(denominator, fraction.denominator)
    return angles[0] * numerator / denominator


def _weighted_boundary(boundary: Boundary, weight: float) -> Boundary:
    """The boundary of the level sets of weight * f, from that of the level sets of f."""
    change = boundary.continuous_change
    if change is None:
        return boundary

    def weighted_change(p: FloatArray, q: FloatArray) -> FloatArray:
        """The change of weight * f along the segments from p to q."""
        return weight * change(p, q)

    return dataclasses.replace(boundary, continuous_change=weighted_change)


def joined_boundary(boundaries: list[Boundary]) -> Boundary:
    """The curves and points of several boundaries."""
    points = [entry.points for entry in boundaries if entry.points is not None]
    closest = [entry.closest_point for entry in boundaries if entry.closest_point is not None]

    def closest_point(p: Vec3) -> Vec3:
        """The closest of the closest points of all boundaries."""
        best = closest[0](p)
        for other in closest[1:]:
            candidate = other(p)
            is_closer = dr.squared_norm(candidate - p) < dr.squared_norm(best - p)
            best = dr.select(is_closer, candidate, best)
        return best

    return Boundary(
        tuple(curve for entry in boundaries for curve in entry.curves),
        np.concatenate(points) if points else None,
        closest_point if closest else None,
    )
