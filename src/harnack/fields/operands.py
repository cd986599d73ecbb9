"""What sums and products of fields have of the fields that are combined, their operands: domain,
traits, period, boundary, and samples on rays."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmin
from harnack.backend.validation import format_short
from harnack.enclosures.parabola_arithmetic import RayFunction
from harnack.enclosures.samples import Ray, RaySample
from harnack.enclosures.sums import shared_reach
from harnack.fields.capabilities import Boundary
from harnack.fields.clearance import bounded_side_extent
from harnack.fields.evaluator import Evaluator
from harnack.fields.field import Field, Traits, check_is_field
from harnack.fields.formula_evaluator import FormulaEvaluator
from harnack.fields.parameters import differentiable_parameters
from harnack.fields.weights import separate_weights
from harnack.geometry.clip_volumes import VolumeIntersection
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real, Vec3
    from harnack.geometry import Volume

# Products of weights and periods are multiples of a common period if their quotients are fractions
# with a denominator up to this, up to a relative error of this size.
_MAX_DENOMINATOR, _PERIOD_ERROR = 64, 1e-12


def check_term(term: Any) -> None:
    """Raise an error if a field cannot be a term of a sum or a factor of a product."""
    check_is_field(term)
    name = with_article(type(term).__name__)
    if term.traits.has_patches:
        raise ValueError(f"{name} is a union of many surfaces, which have no common function")


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
        # Fields without a domain do not say so, because it is their extent that limits solids.
        is_global=any(entry.is_global for entry in traits)
        and all(field.traits.is_global or field.domain is None for field in fields),
        has_creases=any(entry.has_creases for entry in traits),
        has_jumps=any(entry.has_jumps for entry in traits),
        has_variable_accuracy=any(entry.has_variable_accuracy for entry in traits),
    )


def common_period(
    terms: tuple[Field, ...], weights: Any, numbers_of_weights: tuple[float, ...]
) -> float | None:
    """The period of a weighted sum: the largest number of which all |w_i| P_i are multiples, where
    P_i are the periods of the angle-valued terms; None if there is no such term.

    Proof. A term is known up to multiples of |w_i| P_i. So the sum is known up to sums of such
    numbers with integer coefficients. These are the multiples of the greatest common divisor.

    Raises:
        ValueError: there is none, or a weight of an angle-valued term is a Dr.Jit number.
    """
    separate = separate_weights(weights, len(terms))
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


def weighted_boundary(boundary: Boundary, weight: float) -> Boundary:
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


def far_from_zero(
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


def carries_derivatives(field: Field, points: Any) -> bool:
    """Whether points or parameters of a field are Dr.Jit arrays with derivatives enabled."""
    arrays = (points, *differentiable_parameters(field))
    return any(dr.is_array_v(cast("Any", type(a))) and dr.grad_enabled(a) for a in arrays)


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
