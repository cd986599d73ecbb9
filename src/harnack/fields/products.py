"""Products of two fields, f g. A product is sampled by samples of its factors: derivatives follow
by the product rule, and so do their proved bounds (`enclosures.products`). A product of harmonic
functions is not harmonic. (A product of formulas is a formula: `combining.FormulaProduct`.)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.elementary import fmin, safe_norm
from harnack.backend.tensors import accepts_tensors
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.enclosures.parabola import TaylorEnclosure
from harnack.enclosures.parabola_arithmetic import RayFunction, multiplied_enclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.products import product_sample
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.enclosures.sums import shared_reach, value_error
from harnack.fields.attached_numbers import gradient_with_parameters, value_with_parameters
from harnack.fields.capabilities import Boundary, VariableAccuracy
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.operands import (
    carries_derivatives,
    check_term,
    common_domain,
    common_traits,
    joined_boundary,
    nothing_known_message,
    sample_rays,
)
from harnack.geometry.clip_volumes import box_around_volumes
from harnack.name_suggestions import with_article

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.enclosures import Enclosure
    from harnack.geometry import Volume


class FieldProduct(Field):
    """The product f g of two fields, its factors, as a field. It is also written f * g.

    factors: the two fields, real-valued and without jumps.

    The domain is the intersection of those of the factors, and the default level is 0.

    Raises:
        TypeError: a factor that is no field.
        ValueError: not two factors; a factor that is angle-valued, jumps across facets, or is a
            union of patches.
    """

    traits = Traits(has_parameter_derivatives=True, differentiable_arguments=("factors",))

    def __init__(self, factors: Iterable[Field]) -> None:
        """Check the factors, and set what follows from them: the domain and the traits."""
        self.factors: tuple[Field, ...] = tuple(factors)
        if len(self.factors) != 2:
            raise ValueError(f"a product has two factors, not {len(self.factors)}")
        for factor in self.factors:
            check_term(factor)
            if factor.traits.has_jumps:
                raise ValueError(
                    f"{with_article(type(factor).__name__)} jumps across facets, and products of "
                    "such fields are not known; sums are: harnack.fields.FieldSum"
                )
            if factor.period is not None:
                raise ValueError(
                    f"{with_article(type(factor).__name__)} is angle-valued: known up to multiples "
                    "of its period, it has no product with another field; it may be multiplied by "
                    "a number"
                )
        self.domain = common_domain(self.factors)
        traits = common_traits(self.factors)
        self.traits = dataclasses.replace(
            traits, has_parameter_derivatives=True, differentiable_arguments=("factors",)
        )

    @property
    def boundary(self) -> Boundary | None:
        """The points at which the level sets of a factor end; None if there are none."""
        known = [factor.boundary for factor in self.factors]
        boundaries = [boundary for boundary in known if boundary is not None]
        return joined_boundary(boundaries) if boundaries else None

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """A volume that contains the level sets: at the level 0, on which one of the factors is 0,
        a box around theirs; else the domain."""
        return extent_of_product(self.factors, levels, self.domain)

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision | None = None) -> Any:
        """The values (n,) of the product at points (n, 3), as of `Field.value`: the products of
        those of the factors."""
        if carries_derivatives(self, points):
            return super().value(points, precision=precision)
        first, second = (f.value(points, precision=precision) for f in self.factors)
        return first * second

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> ProductEvaluator:
        inner = Plan(ray_count=plan.ray_count)
        first, second = (factor.evaluator(backend, inner) for factor in self.factors)
        return ProductEvaluator(self.factors, first, second)


def extent_of_product(
    factors: Iterable[Field], levels: tuple[float, ...], domain: Volume | None
) -> Volume | None:
    """A volume that contains the level sets of a product with this domain: at the level 0, on which
    one of the factors is 0, a box around theirs; else the domain. None if none is known."""
    if any(level != 0 for level in levels):
        return domain
    volumes = [_zero_extent(factor) for factor in factors]
    known = [volume for volume in volumes if volume is not None]
    return (box_around_volumes(known) if len(known) == len(volumes) else None) or domain


def _zero_extent(factor: Field) -> Volume | None:
    """A volume that contains the points at which a field is 0; None if none is known, and if the
    level 0 is refused, as that of blobs, which are 0 in all of the space outside of them."""
    try:
        factor.validate_levels((0.0,))
    except ValueError:
        return None
    return factor.extent((0.0,))


@dataclass(frozen=True, eq=False)
class ProductEvaluator(Evaluator):
    """The evaluator of a product of two fields, its factors.

    factors: the factors.
    first, second: their evaluators.
    """

    factors: tuple[Field, ...]
    first: Evaluator
    second: Evaluator

    @property
    def name(self) -> str:
        """The name of the field's class, for messages."""
        return FieldProduct.__name__

    @property
    def is_steep(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.first.is_steep or self.second.is_steep

    @property
    def variable_accuracy(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> VariableAccuracy | None:
        """How f is sampled with different accuracy: both factors, if they can be sampled so, have
        the same accuracy scale. None if neither can."""
        factors = self.first, self.second
        accuracies = [factor.variable_accuracy for factor in factors]
        known = [accuracy for accuracy in accuracies if accuracy is not None]

        def at(scale: Real) -> Evaluator:
            """The product, with its factors sampled at this accuracy scale."""
            pairs = zip(factors, accuracies, strict=True)
            first, second = (f if a is None else a.at(scale) for f, a in pairs)
            return ProductEvaluator(self.factors, first, second)

        return VariableAccuracy(at, min(a.coarsest for a in known)) if known else None

    def evaluate(self, p: Vec3) -> Sample:
        return product_sample(self.first.evaluate(p), self.second.evaluate(p))

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample of the product at the point of a ray with parameter t, with enclosures in
        front of the point and behind it. Along the ray the slopes of the factors have signs, so
        that bounds are sharper than those in every direction."""
        evaluators = self.first, self.second
        first, second = ray_samples = sample_rays(evaluators, path, t, ahead, back)
        sample = product_sample(first.sample, second.sample)
        if not {PiecewiseTaylorEnclosure, TaylorEnclosure} & {*path.proofs.kinds}:
            return path.enclose(sample)
        reach = shared_reach([first.sample, second.sample])
        functions = RayFunction.ahead(first), RayFunction.ahead(second)
        forward = multiplied_enclosure(*functions, fmin(reach, ahead))
        if forward is None:
            raise ValueError(nothing_known_message(evaluators, functions))
        behind = RayFunction.behind(first), RayFunction.behind(second)
        backward = multiplied_enclosure(*behind, fmin(reach, back))
        fronts: tuple[Enclosure, ...] = (forward,)
        backs: tuple[Enclosure, ...] = () if backward is None else (backward,)
        growth = max(entry.reach_growth for entry in ray_samples)
        slope = first.sample.value * second.slope + second.sample.value * first.slope
        if not sample.promises:
            return RaySample(sample, fronts, backs, slope, growth)
        by_promises = path.enclose(sample)
        # Bounds that follow from promises do not depend on the lengths asked for, which may be far
        # too long at first.
        return dataclasses.replace(
            by_promises,
            forward=(*by_promises.forward, *fronts),
            backward=(*by_promises.backward, *backs),
            reach_growth=growth,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The rows of f Hess g + g Hess f + grad f grad g^T + grad g grad f^T."""
        f, g = self.first.evaluate(p), self.second.evaluate(p)
        pairs = zip(self.first.hessian(p), self.second.hessian(p), strict=True)
        x, y, z = (
            g.value * row
            + f.value * other
            + f.gradient[k] * g.gradient
            + g.gradient[k] * f.gradient
            for k, (row, other) in enumerate(pairs)
        )
        return x, y, z

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p, of the gradient and of the Hessian. That of the Hessian is the sum
        of the errors of its four terms, and of eight roundings of each."""
        epsilon = 2 * float(dr.epsilon(type(p.x)))
        evaluators = self.first, self.second
        samples = [evaluator.evaluate(p) for evaluator in evaluators]
        pairs = zip(evaluators, samples, strict=True)
        errors = [evaluator.derivative_errors(p, entry) for evaluator, entry in pairs]
        total = 0 * p.x
        for (f, (f_slope_error, _)), (g, (_, second_error)), evaluator in (
            ((samples[0], errors[0]), (samples[1], errors[1]), self.second),
            ((samples[1], errors[1]), (samples[0], errors[0]), self.first),
        ):
            size, error = dr.abs(f.value) + value_error(f), value_error(f)
            rows = evaluator.hessian(p)
            norm = dr.sqrt(sum((dr.squared_norm(row) for row in rows), 0 * p.x))
            slope, other = safe_norm(f.gradient), safe_norm(g.gradient)
            total = total + size * second_error + (error + 8 * epsilon * size) * norm
            total = total + (2 * f_slope_error + 8 * epsilon * slope) * (other + f_slope_error)
        return sample.gradient_error, total * (1 + 1e-5)

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A bound of |grad (f g)(y) - grad (f g)(p)| for |y - p| <= radius r.

        Proof. Let A and B bound the changes of grad f and grad g. Then f changes by at most F =
        (|grad f| + A) r, and g by at most G = (|grad g| + B) r. The gradient is f grad g + g grad
        f; so it changes by at most |f| B + F (|grad g| + B) + |g| A + G (|grad f| + A).
        """
        bound = 0 * p.x
        samples = self.first.evaluate(p), self.second.evaluate(p)
        changes = [e.gradient_change_bound(p, radius) for e in (self.first, self.second)]
        slopes = [
            safe_norm(sample.gradient) + sample.gradient_error + change
            for sample, change in zip(samples, changes, strict=True)
        ]
        for k in (0, 1):
            size = dr.abs(samples[k].value) + value_error(samples[k])
            bound = bound + size * changes[1 - k] + radius * slopes[0] * slopes[1]
        return bound * (1 + 1e-5)

    def differentiable_value(self, p: Vec3) -> Real:
        f, g = (value_with_parameters(factor, e, p) for factor, e in self._pairs)
        return f * g

    def differentiable_gradient(self, p: Vec3) -> Vec3 | None:
        gradients = [gradient_with_parameters(factor, e, p) for factor, e in self._pairs]
        if gradients[0] is None or gradients[1] is None:
            return None
        f, g = (value_with_parameters(factor, e, p) for factor, e in self._pairs)
        return f * gradients[1] + g * gradients[0]

    @property
    def _pairs(self) -> tuple[tuple[Field, Evaluator], ...]:
        """The factors with their evaluators."""
        return (self.factors[0], self.first), (self.factors[1], self.second)
