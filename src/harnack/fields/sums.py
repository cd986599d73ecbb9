"""Weighted sums of fields, w_1 f_1 + ... + w_n f_n + c. The fields are the terms of the sum. A sum
is sampled by samples of its terms: values and derivatives are added, and so are their proved bounds
(`enclosures.sums`). A sum of harmonic terms is harmonic. (A sum of formulas is a formula:
`combining.FormulaSum`.)
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax, fmin
from harnack.backend.tensors import accepts_tensors
from harnack.backend.validation import as_finite
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
from harnack.fields.attached_numbers import gradient_with_parameters, value_with_parameters
from harnack.fields.capabilities import Boundary, Jumps, VariableAccuracy
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.operands import (
    carries_derivatives,
    check_term,
    common_domain,
    common_period,
    common_traits,
    joined_boundary,
    nothing_known_message,
    sample_rays,
    weighted_boundary,
)
from harnack.fields.sum_extents import WeightedTerms
from harnack.fields.sum_jumps import WeightedJumps
from harnack.fields.weights import (
    checked_number,
    checked_weights,
    device_number,
    device_numbers,
    host_number,
    host_numbers,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.enclosures import Enclosure
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid


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
            whose weights have no such quotients, or are Dr.Jit numbers; several terms that jump
            across facets; a term that is a union of patches.
    """

    traits = Traits(has_parameter_derivatives=True, differentiable_arguments=("terms",))

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
        if sum(term.traits.has_jumps for term in entries) > 1:
            raise ValueError(
                "only one term of a sum may jump across facets, as winding numbers of meshes do: "
                "for equal weights, take harnack.WindingNumber of all meshes as one; of open "
                "meshes, harnack.SolidAngle of their boundaries does not jump; of points, "
                "harnack.DipolePotential does not"
            )
        self.terms: tuple[Field, ...] = entries
        self.weights = checked_weights(weights, len(entries))
        self.constant = checked_number(constant, "constant")
        self._weight_numbers = host_numbers(self.weights)
        self._constant_number = host_number(self.constant)
        for number in (*self._weight_numbers, self._constant_number):
            as_finite(number, "weights and constant")
        period = common_period(entries, self.weights, self._weight_numbers)
        object.__setattr__(self, "period", period)  # of the instance, in place of the class's
        self.domain = common_domain(entries)
        levels = [term.default_level for term in entries]
        level = float(np.dot(self._weight_numbers, levels))
        if self.period is not None and abs(math.remainder(level, self.period)) < 1e-6 * self.period:
            level += 0.5 * self.period  # the value far away has no bounded level set
        self.default_level = level
        pairs = [*zip(entries, self._weight_numbers, strict=True)]
        self.traits = dataclasses.replace(
            common_traits(entries),
            has_jumps=any(term.traits.has_jumps and weight != 0 for term, weight in pairs),
            is_larger_inside=all(
                term.traits.is_larger_inside == (weight > 0) for term, weight in pairs
            ),
            has_parameter_derivatives=True,
            differentiable_arguments=type(self).traits.differentiable_arguments,
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
            return weighted_boundary(boundaries[0], known[0][1])
        return joined_boundary(boundaries)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that contains the level sets: of a single term, that of its own level sets; of
        several terms, the domain or, without a domain, a box around volumes that are proved for
        each of them."""
        return self._weighted.extent(levels, self.domain)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        self._weighted.validate_levels(levels)

    @property
    def _weighted(self) -> WeightedTerms:
        """The terms with their weights, as Python numbers."""
        numbers = tuple(self._weight_numbers)
        return WeightedTerms(self.terms, numbers, self._constant_number, self.period)

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
        levels = self._weighted.levels_of_single(plan.levels) or ()
        inner_plan = Plan(levels, plan.ray_count)
        moved = device_numbers(self.weights, backend, len(self.terms))
        terms = tuple(
            _Term(
                term,
                term.evaluator(backend, inner_plan),
                dr.opaque(backend.Float, number),
                number,
                weight,
            )
            for term, number, weight in zip(self.terms, self._weight_numbers, moved, strict=True)
        )
        moved_constant = device_number(self.constant, backend)
        constant = dr.opaque(backend.Float, self._constant_number)
        return SumEvaluator(terms, constant, self._constant_number != 0, moved_constant)


@dataclass(frozen=True, eq=False)
class _Term:
    """A term of a sum on a backend.

    field: the field f, and evaluator: its evaluator.
    weight: its weight, a kernel parameter without derivatives.
    number: the same as a Python number.
    moved_weight: the weight as it was given if it is a Dr.Jit number, which may have derivatives;
        else None.
    """

    field: Field
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
        return weight * value_with_parameters(self.field, self.evaluator, p)

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        """The gradient of weight * f at p, with derivatives with respect to p, the weight and
        parameters of f; None where that of f is not known."""
        gradient = gradient_with_parameters(self.field, self.evaluator, p)
        weight = self.weight if self.moved_weight is None else self.moved_weight
        return None if gradient is None else weight * gradient


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
    def jumps(self) -> Jumps | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The facets of the term that jumps; None if there is none."""
        for k, term in enumerate(self.terms):
            if term.evaluator.jumps is None or term.number == 0:
                continue

            def continued(evaluator: Evaluator, k: int = k) -> Evaluator:
                """The sum, with this evaluator of the term that jumps."""
                term = dataclasses.replace(self.terms[k], evaluator=evaluator)
                terms = (*self.terms[:k], term, *self.terms[k + 1 :])
                return dataclasses.replace(self, terms=terms)

            return WeightedJumps(
                term.evaluator.jumps,
                term.weight,
                is_negative=term.is_negative,
                with_continuation=continued,
            )
        return None

    @property
    def variable_accuracy(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> VariableAccuracy | None:
        """How f is sampled with different accuracy: all terms that can be sampled so have the same
        accuracy scale. None if there is no such term."""
        accuracies = [term.evaluator.variable_accuracy for term in self.terms]
        known = [accuracy for accuracy in accuracies if accuracy is not None]

        def sampled_at(term: _Term, accuracy: VariableAccuracy, scale: Real) -> _Term:
            """A term that is sampled at this accuracy scale, and never up to an unknown integer,
            which the weight would multiply."""
            if accuracy.may_lack_integer:
                scale = fmax(scale, accuracy.coarsest)
            return dataclasses.replace(term, evaluator=accuracy.at(scale))

        def at(scale: Real) -> Evaluator:
            """The sum, with its terms sampled at this accuracy scale."""
            pairs = zip(self.terms, accuracies, strict=True)
            terms = tuple(term if a is None else sampled_at(term, a, scale) for term, a in pairs)
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

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        total = 0 * p
        for term in self.terms:
            if term.number != 0 or term.moved_weight is not None:
                gradient = term.differentiable_gradient(p)
                if gradient is None:
                    return None
                total = total + gradient
        return total
