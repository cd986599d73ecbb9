"""Combinations of solids: unions, intersections, complements, offsets, and blends. A solid is the
set of points where its function f is at most 0; the solids that are combined are called operands
(in the code also parts), and their functions f_i. The union has the function min f_i, the
intersection max f_i, the complement -f. A sample of f at a point is its value and gradient there,
with bounds of their errors, and with promises (proved bounds of f near the point). A ray sample
adds enclosures: proved bounds of the change of f along the ray, in front of the point and behind
it."""

from __future__ import annotations

import copy
import dataclasses
import math
import numbers
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.arithmetic import maximum, minimum
from harnack.arithmetic.norms import blend_intersection, blend_union
from harnack.arithmetic.operators import Tally, tally_of
from harnack.backend import choose_backend
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.backend.validation import as_finite, as_real, check_no_derivatives
from harnack.enclosures import Enclosure, Lipschitz
from harnack.enclosures.extremum import MaximumEnclosure, MaximumOperand, NegatedEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample, value_error_bound
from harnack.fields.attached_numbers import extreme_of_parts, has_own_formula, own_formula
from harnack.fields.capabilities import VariableAccuracy
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, is_checked
from harnack.fields.formula import on_backend, probe_jets
from harnack.fields.number_table import is_attached_number
from harnack.fields.parameters import record_call
from harnack.fields.solids.solid import (
    EvaluatorOfInner,
    FormulaSolid,
    Solid,
    SolidOfField,
    by_numbers,
    formula_of,
    not_a_solid,
    set_frozen,
    without_levels,
)
from harnack.fields.tape_evaluator import tape_evaluator
from harnack.geometry import VolumeIntersection
from harnack.geometry.clip_volumes import box_around_volumes

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume

# The value of a combination is known to lie in a range. Bounds from other operands may narrow this
# range and so move its middle. They are used only if the middle moves by more than this fraction of
# the value's error. (At creases it nearly always moves less, and the value would change for
# nothing.)
_MIN_SHIFT = 0.25


def union(*solids: Solid | Iterable[Solid]) -> Solid:
    """The union of solids: all points that are in at least one of them.

    solids: any number of solids, each an argument, as in union(a, b, c); or one list, or any other
        iterable, of all of them.

    Raises:
        ValueError: no solids.
        TypeError: an argument that is not a solid.
    """
    return _combination(solids, is_union=True)


def intersection(*solids: Solid | Iterable[Solid]) -> Solid:
    """The intersection of solids: all points that are in each of them.

    solids: any number of solids, each an argument, as in intersection(a, b, c); or one list, or any
        other iterable, of all of them.

    Raises:
        ValueError: no solids.
        TypeError: an argument that is not a solid.
    """
    return _combination(solids, is_union=False)


def smooth_union(solids: Iterable[Solid], radius: float, *, power: float = 2.0) -> Solid:
    """The union of solids with fillets where their surfaces meet. Of a single solid it is that
    solid.

    solids: a list, or any other iterable, of solids that have formulas.
    radius: how far the fillets extend along the surfaces, where the functions are distances.
    power: the exponent of the superellipse that a fillet is a part of (`Solid.blended`).

    It is a balanced binary tree of blends of two: neighbors in the list are blended, then
    neighbors among the results, and so on, so that no point passes more than log2(n) blends. The
    order of the solids matters slightly: blending is not associative, so that near a point at
    which three or more surfaces are within the radius, the fillet depends on which two are blended
    first. Neighbors in space are best neighbors in the list.

    Raises:
        ValueError: no solids; radius or power out of range.
        TypeError: an entry that is not a solid, or has no formula.
    """
    is_attached_number((radius, power), "smooth_union")  # raises an error for others
    level: list[Solid] = [*checked_solids(solids)]
    _checked_blend(radius, power)
    while len(level) > 1:
        pairs = [level[k : k + 2] for k in range(0, len(level), 2)]
        level = [
            BlendedSolid((pair[0], pair[1]), radius, power, is_union=True)
            if len(pair) == 2
            else pair[0]
            for pair in pairs
        ]
    return level[0]


def checked_solids(solids: Iterable[Any]) -> tuple[Solid, ...]:
    """The solids of an iterable.

    Raises:
        ValueError: no solids.
        TypeError: it is no iterable, or an entry of it is not a solid.
    """
    if isinstance(solids, Solid):
        raise TypeError("give the solids as a list of them, such as smooth_union([a, b], radius)")
    if not isinstance(solids, tuple | list):
        check_no_derivatives("a combination of solids", solids)
    if isinstance(solids, str | bytes) or not isinstance(solids, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(not_a_solid(solids))
    operands = tuple(solids)
    if not operands:
        raise ValueError("give at least one solid")
    for operand in operands:
        if not isinstance(operand, Solid):
            check_no_derivatives("a combination of solids", operand)
            raise TypeError(not_a_solid(operand))
    return operands


def _combination(solids: tuple[Any, ...], *, is_union: bool) -> BooleanSolid:
    """The union (or intersection) of solids, from the arguments of `union`. An operand that is
    itself a union (or intersection) is replaced by its own operands, so that combinations are not
    nested.

    is_union: whether a union is made; otherwise an intersection.

    Raises:
        ValueError: no solids.
        TypeError: an argument that is not a solid.
    """
    is_list = len(solids) == 1 and not isinstance(solids[0], Field)
    arguments: Any = solids[0] if is_list else solids
    operands = checked_solids(arguments)
    parts: list[Solid] = []
    for operand in operands:
        if isinstance(operand, BooleanSolid) and operand.is_union == is_union:
            parts.extend(operand.parts)
        else:
            parts.append(operand)
    is_extended = len(parts) > len(operands)
    if is_extended and all(is_checked(a) and a.domain is None for a in operands):
        return BooleanSolid._joined(  # pyright: ignore[reportPrivateUsage]
            operands, tuple(parts), is_union
        )
    return BooleanSolid(tuple(parts), is_union)


@dataclass(frozen=True, eq=False)
class BooleanSolid(Solid):
    """The union of solids, whose function is the minimum of their functions f_i; or their
    intersection, whose function is the maximum of the f_i. The solids are called operands. At a
    point, the extreme operand is the one whose value is the minimum (of a union) or the maximum (of
    an intersection). A union is computed as an intersection of negated functions: min f_i =
    -max(-f_i).

    parts: the operands.
    is_union: True for the union, False for the intersection.

    If the f_i are distances, the minimum is the exact distance outside and only a bound inside, and
    the maximum is only a bound. Hart 1996, equation 16, calls the union exact inside too. A
    counterexample in the plane are the unit discs about (-1/2, 0) and (1/2, 0): at (0, 0) the
    distance from the border of the union is 0.866, but the minimum is -0.5.
    """

    traits = dataclasses.replace(Solid.traits, differentiable_arguments=("parts",))

    parts: tuple[Solid, ...]
    is_union: bool

    def __post_init__(self) -> None:
        """Set the attributes that follow from the operands: the domain, the settings for the
        tracer, and the Lipschitz constant."""
        domains = list(dict.fromkeys(part.domain for part in self.parts if part.domain is not None))
        domain = None
        if domains:
            domain = domains[0] if len(domains) == 1 else VolumeIntersection(domains)
        object.__setattr__(self, "domain", domain)
        self._set_common_attributes(self.parts)

    def _set_common_attributes(self, operands: Iterable[Solid]) -> None:
        """Set the settings for the tracer and the Lipschitz constant, from those of the parts, or
        from those of solids that are combinations of the same kind of the parts."""
        solids = tuple(operands)
        # The smallest factor of all operands. A step longer than the proved one is accepted only if
        # every operand proves the rest of it, looking back from the new point. So one operand
        # without such proofs makes longer steps useless.
        traits = dataclasses.replace(
            self.traits,
            over_relaxation=min(solid.traits.over_relaxation for solid in solids),
            min_wavelength=min_wavelength(solids),
            has_variable_accuracy=any(solid.traits.has_variable_accuracy for solid in solids),
        )
        object.__setattr__(self, "traits", traits)
        constants = [solid.lipschitz for solid in solids]
        # The minimum or maximum of functions has the largest of their constants.
        all_known = all(constant is not None for constant in constants)
        object.__setattr__(self, "lipschitz", max(constants) if all_known else None)

    @classmethod
    def _joined(
        cls, operands: tuple[Solid, ...], parts: tuple[Solid, ...], is_union: bool
    ) -> BooleanSolid:
        """The combination of solids, some of which are combinations of the same kind, whose parts
        are not looked at again: so a loop that adds a solid to a union a thousand times takes a
        time that grows with its length and not with its square.

        operands: the solids, without domains, which have been checked (`is_checked`).
        parts: the parts of those that are combinations of the same kind, and all others.
        """
        solid = object.__new__(cls)
        object.__setattr__(solid, "parts", parts)
        object.__setattr__(solid, "is_union", is_union)
        record_call(solid, (parts, is_union), {})
        solid._set_common_attributes(operands)
        return solid

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return BooleanSolid(tuple(part.map_operands(change) for part in self.parts), self.is_union)

    def operands(self) -> tuple[Solid, ...]:
        return tuple(operand for part in self.parts for operand in part.operands())

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A volume that is proved to contain all points where f <= level or, if `above`, all points
        where f >= level; None if no such volume is known.

        It is put together from the volumes of the operands. A point with max f_i <= level (or min
        f_i >= level) lies in the volumes of all operands, so in their intersection. A point with
        min f_i <= level (or max f_i >= level) lies in at least one of the volumes, so in a box
        around all of them.
        """
        extents = [part.sublevel_extent(level, above=above) for part in self.parts]
        bounded = [part for part in extents if part is not None]
        # The first case, an intersection of volumes: min f_i >= level, or max f_i <= level. An
        # operand without a volume limits nothing, and without any volume the result is None.
        if self.is_union == above:
            return VolumeIntersection(bounded) if len(bounded) > 1 else next(iter(bounded), None)
        # The second case, a box around all volumes: an operand without a volume may have such
        # points anywhere.
        if len(bounded) < len(extents):
            return None
        return box_around_volumes(bounded)

    def with_read_numbers(self, numbers: NumberReader) -> BooleanSolid:
        """The copy of the parts with their numbers attached."""
        other = copy.copy(self)
        set_frozen(other, "parts", extreme_of_parts(self.parts, numbers, is_least=self.is_union))
        return other

    @classmethod
    def of_functions(cls, parts: tuple[Any, ...], *, is_union: bool) -> BooleanSolid:
        """An object whose formula is the least or greatest of those of the parts, which need be no
        solids. It is no field that was made by its constructor."""
        solid = object.__new__(cls)
        set_frozen(solid, "parts", parts)
        set_frozen(solid, "is_union", is_union)
        return solid

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return _extremum(
            [own_formula(part)(x, y, z) for part in self.parts], is_union=self.is_union
        )

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        by_tape = tape_evaluator(self, backend, plan)
        if by_tape is not None:
            return by_tape
        parts = tuple(part.evaluator(backend, plan) for part in self.parts)
        return BooleanSolidEvaluator(parts, self.is_union)


def _extremum(values: list[Any], *, is_union: bool) -> Any:
    """The smallest (for a union) or the largest (for an intersection) of the values of operands,
    which are numbers of any arithmetic."""
    if len(values) == 1:
        return values[0]
    return minimum(*values) if is_union else maximum(*values)


@dataclass(frozen=True, eq=False)
class BooleanSolidEvaluator(Evaluator):
    """The evaluator of the minimum or the maximum of functions f_i, those of the operands. It is
    computed as `BooleanSolid` describes.

    parts: the evaluators of the operands.
    is_union: True for the minimum, False for the maximum.
    """

    parts: tuple[Evaluator, ...]
    is_union: bool

    @property
    def is_steep(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return any(part.is_steep for part in self.parts)

    @property
    def variable_accuracy(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> VariableAccuracy | None:
        """How f is sampled with different accuracy: all operands that can be sampled so have the
        same accuracy scale (larger is more accurate). None if there is no such operand."""
        accuracies = [part.variable_accuracy for part in self.parts]
        known = [accuracy for accuracy in accuracies if accuracy is not None]

        def at(scale: Real) -> Evaluator:
            """The combination, with its operands sampled at this accuracy scale."""
            pairs = zip(self.parts, accuracies, strict=True)
            parts = tuple(part if a is None else a.at(scale) for part, a in pairs)
            return BooleanSolidEvaluator(parts, self.is_union)

        # `coarsest` is the accuracy scale of the coarsest samples that an operand has.
        return VariableAccuracy(at, min(a.coarsest for a in known)) if known else None

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are numbers of any arithmetic. Raises TypeError if an operand has
        no formula."""
        values = [formula_of(part)(x, y, z) for part in self.parts]
        return _extremum(values, is_union=self.is_union)

    def evaluate(self, p: Vec3) -> Sample:
        samples = [part.evaluate(p) for part in self.parts]
        return self._combine_samples(samples, max_norm(p))[0]

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p. It is the Hessian of the operand whose value is
        the smallest (for a union) or the largest (for an intersection)."""
        extreme: Any = None
        rows: Any = None
        for part in self.parts:
            value, part_rows = part.evaluate(p).value, part.hessian(p)
            if rows is None:
                extreme, rows = value, part_rows
                continue
            # On the lanes where this operand is more extreme than those before, take its Hessian.
            is_chosen = (value < extreme) if self.is_union else (value > extreme)
            rows = tuple(dr.select(is_chosen, a, b) for a, b in zip(part_rows, rows, strict=True))
            extreme = dr.select(is_chosen, value, extreme)
        return rows

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two error bounds at p: of the gradient, as a length, and of the Hessian. They are the
        bounds of the operand whose value is the smallest (for a union) or the largest (for an
        intersection). Where the errors of the values leave open which operand that is, both are
        infinite, since derivatives jump from one operand to the other.

        sample: the sample of the combination at p.
        """
        size = max_norm(p)
        sign = -1.0 if self.is_union else 1.0
        total_error = value_error_bound(sample, safe_norm(sample.gradient), size)
        candidate_count, max_first, max_second = 0 * p.x, 0 * p.x, 0 * p.x
        for part in self.parts:
            part_sample = part.evaluate(p)
            part_error = value_error_bound(part_sample, safe_norm(part_sample.gradient), size)
            # True unless the operand's value is clearly not the extreme one. (With ~, it is true
            # for NaN.)
            may_be_extreme = ~(sign * (sample.value - part_sample.value) > part_error + total_error)
            candidate_count = candidate_count + dr.select(may_be_extreme, 1.0, 0.0)
            first, second = part.derivative_errors(p, part_sample)
            # The larger of both, written so that a NaN is kept: it says that no bound is known.
            max_first = dr.select(may_be_extreme & ~(first <= max_first), first, max_first)
            max_second = dr.select(may_be_extreme & ~(second <= max_second), second, max_second)
        is_single = candidate_count <= 1
        return dr.select(is_single, max_first, dr.inf), dr.select(is_single, max_second, dr.inf)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample of the combination at the point of a ray with parameter t, with enclosures
        (proved bounds of the change of f along the ray) in front of the point and behind it. They
        are `MaximumEnclosure`s, made from the enclosures of all operands.

        path: the ray.
        ahead, back: the lengths in front of and behind the point up to which enclosures are useful.
        """
        ray_samples = [operand.sample_ray(path, t, ahead, back) for operand in self.parts]
        size = max_norm(path.origin) + t
        sample, deficits, extreme = self._combine_samples(
            [operand.sample for operand in ray_samples], size
        )
        # The slope is that of the extreme operand, the one whose value is `extreme`; the last
        # operand, if no other one is.
        slope, slope_error = ray_samples[-1].slope, ray_samples[-1].slope_error_bound
        for ray_sample in ray_samples[:-1]:
            is_chosen = ray_sample.sample.value == extreme
            slope = dr.select(is_chosen, ray_sample.slope, slope)
            slope_error = dr.select(is_chosen, ray_sample.slope_error_bound, slope_error)
        forward = self._combine_enclosures([operand.forward for operand in ray_samples], deficits)
        backward = self._combine_enclosures([operand.backward for operand in ray_samples], deficits)
        growth = max(operand.reach_growth for operand in ray_samples)
        return RaySample(sample, forward, backward, slope, growth, slope_error)

    def _combine_enclosures(
        self, operands: list[tuple[Enclosure, ...]], deficits: list[tuple[Real, Real]]
    ) -> tuple[Enclosure, ...]:
        """The enclosures of the combination's function along a ray, from the enclosures of its
        operands; () if an operand has no enclosures.

        operands: for each operand, the enclosures of its function f_i.
        deficits: for each operand, bounds (lower, upper) of its deficit at the start. The deficit
            is the greatest value of all operands minus the operand's own value; for a union, the
            values are those of -f_i.
        """
        if not all(operands):
            return ()
        if self.is_union:
            operands = [tuple(NegatedEnclosure(kind) for kind in kinds) for kinds in operands]
        # For a union: min f_i = -max(-f_i).
        greatest = MaximumEnclosure(
            tuple(
                MaximumOperand(*bounds, kinds)
                for bounds, kinds in zip(deficits, operands, strict=True)
            )
        )
        return (NegatedEnclosure(greatest),) if self.is_union else (greatest,)

    def _combine_samples(
        self, samples: list[Sample], size: Real
    ) -> tuple[Sample, list[tuple[Real, Real]], Real]:
        """Combine the samples of all operands at one point to the sample of the union or
        intersection.

        samples: the samples of the operands.
        size: a bound of the absolute values of the point's coordinates.

        Returns three results: the sample; for each operand, bounds (lower, upper) of its deficit;
        and the extreme value, exactly as the operand computed it. The deficit is the difference
        between the greatest value of all operands and the operand's own value. For a union the
        values are those of -f_i, and the extreme value is the least f_i.

        Proof of the errors. Let v_i be the values of the operands f_i, e_i bounds of their errors
        (all rounding included, `value_error_bound`), and v = v_k the greatest value. Then max f_i
        <= max(v_i + e_i) = v + max(e_i - (v - v_i)), and max f_i >= v_k - e_k. So max(e_i - (v -
        v_i)) bounds the error of the combination. As max f_i >= v_j - e_j for every j, an operand
        with a smaller error may exclude most of that range. Then the value is set to the middle of
        the remaining range. Without this, a large rounding error of one operand could make a ray
        hit that operand's surface where it lies inside of another operand. The tracer reduces the
        differences between f and the levels by the error of the combination. If the error of an
        operand is larger than that, the bounds of its deficit are widened by the excess.
        """
        sign = -1.0 if self.is_union else 1.0
        values = [sign * operand.value for operand in samples]
        greatest = values[0]
        for operand in values[1:]:
            greatest = fmax(operand, greatest)
        last = samples[-1]
        value, gradient, slope_error = last.value, last.gradient, last.gradient_error
        # Adding 0 times a number of the backend turns Python numbers into numbers of that kind.
        value, slope_error = 0 * greatest + value, 0 * greatest + slope_error
        for sample, operand_value in zip(samples[:-1], values[:-1], strict=True):
            is_greatest = operand_value >= greatest
            value = dr.select(is_greatest, sample.value, value)
            gradient = dr.select(is_greatest, sample.gradient, gradient)
            slope_error = dr.select(is_greatest, sample.gradient_error, slope_error)
        errors = [
            value_error_bound(operand, safe_norm(operand.gradient), size) for operand in samples
        ]
        # The error of the greatest value, max(e_i - (v - v_i)) in the proof; and the part of it
        # that more accurate samples would reduce.
        error, truncation = 0 * greatest, 0 * greatest
        for sample, operand_value, operand_error in zip(samples, values, errors, strict=True):
            deficit = greatest - operand_value
            error = fmax(fmax(operand_error - deficit, sample.value_error - deficit), error)
            truncation = fmax(sample.truncation_error - deficit, truncation)
        # The largest v_j - e_j; and the shift of the value to the middle of the remaining range.
        lower_bound = values[0] - errors[0]
        for operand_value, operand_error in zip(values[1:], errors[1:], strict=True):
            lower_bound = fmax(operand_value - operand_error, lower_bound)
        shift = 0.5 * (lower_bound - (greatest - error))
        shift = dr.select(shift > _MIN_SHIFT * error, shift, 0)
        # The unshifted value is returned, too: it tells the extreme operand. For a union f is minus
        # the greatest value, so the shift has the other sign.
        extreme, value = value, value + sign * shift
        greatest, error = greatest + shift, error - shift
        # `Sample.value_error` must leave out the rounding that `value_error_bound` adds by itself,
        # from the value and the gradient (`stated`).
        plain = Sample(value, gradient, ())
        stated = value_error_bound(plain, safe_norm(gradient), size)
        joined = Sample(
            value, gradient, self._common_lipschitz(samples), fmax(error - stated, 0), slope_error,
            truncation_error=truncation,
        )  # fmt: skip
        joined_error = value_error_bound(joined, safe_norm(gradient), size)
        return (
            joined,
            [
                (
                    fmax(greatest - operand_value - fmax(operand_error - joined_error, 0), 0),
                    greatest - operand_value + fmax(operand_error - joined_error, 0),
                )
                for operand_value, operand_error in zip(values, errors, strict=True)
            ],
            extreme,
        )

    def _common_lipschitz(self, samples: list[Sample]) -> tuple[Lipschitz, ...]:
        """A Lipschitz constant of the combination near the point, as a promise: the largest of the
        operands' constants, on the smallest of their balls; () if an operand has no constant there.

        samples: the samples of the operands.
        """
        constant: Any = 0.0
        radius: Any = math.inf
        for sample in samples:
            promise = lipschitz_of(sample)
            if promise is None:
                return ()
            constant = fmax(0 * sample.value + promise.constant, constant)
            radius = fmin(0 * sample.value + promise.radius, radius)
        return (Lipschitz(constant, radius),)


def min_wavelength(parts: Iterable[Solid]) -> float | None:
    """The smallest `Traits.min_wavelength` of the solids `parts`. Solids for which it is None are
    left out; None if no solid remains."""
    wavelengths = (part.traits.min_wavelength for part in parts)
    return min((length for length in wavelengths if length is not None), default=None)


def lipschitz_of(sample: Sample) -> Lipschitz | None:
    """A Lipschitz constant of f on a ball about the point of a sample, as a promise (a proved bound
    near the point). It is a promise of the sample, or follows from one. None if no promise of the
    sample implies a Lipschitz constant."""
    implied = [promise.implied_lipschitz(sample.value) for promise in sample.all_promises]
    stated = (promise for promise in sample.all_promises if isinstance(promise, Lipschitz))
    return next(stated, None) or next((promise for promise in implied if promise is not None), None)


@dataclass(frozen=True, eq=False)
class Complement(SolidOfField):
    """The complement of a solid: all points that are not inside it. Its function is -f, where f is
    the function of the solid.

    field: the solid.
    """

    traits = dataclasses.replace(SolidOfField.traits, differentiable_arguments=("field",))

    field: Solid

    def __post_init__(self) -> None:
        self._copy_settings("domain", "lipschitz")

    def __invert__(self) -> Solid:
        return self.field

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return Complement(self.field.map_operands(change))

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return self.field.sublevel_extent(-level, above=not above)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return -own_formula(self.field)(x, y, z)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        return _ComplementEvaluator(self.field.evaluator(backend, without_levels(plan)))


class _ComplementEvaluator(EvaluatorOfInner):
    """The evaluator of -f, from that of f."""

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """-f at coordinates that are numbers of any arithmetic."""
        return -formula_of(self.inner)(x, y, z)

    def evaluate(self, p: Vec3) -> Sample:
        return negated_sample(self.inner.evaluate(p))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        x, y, z = self.inner.hessian(p)
        return -x, -y, -z

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        return negated_look(self.inner.sample_ray(path, t, ahead, back))


def negated_look(look: RaySample) -> RaySample:
    """The ray sample of the function -f, from that of f at the same point of the ray.
    (`min_gradient_norm` is left out.)"""
    return RaySample(
        negated_sample(look.sample),
        tuple(NegatedEnclosure(enclosure) for enclosure in look.forward),
        tuple(NegatedEnclosure(enclosure) for enclosure in look.backward),
        -look.slope,
        look.reach_growth,
        look.slope_error,
    )


def negated_sample(sample: Sample) -> Sample:
    """The sample of the function -f, from that of f at the same point. A promise f >= a becomes -f
    <= -a."""
    return sample.map_promises(
        lambda promise: promise.negated(),
        value=-sample.value,
        gradient=-sample.gradient,
        shading_normal=None if sample.shading_normal is None else -sample.shading_normal,
    )


@dataclass(frozen=True, eq=False)
class OffsetSolid(SolidOfField):
    """An offset of a solid: the points where f <= distance, where f is the function of the solid.
    So the function of the offset is f - distance.

    field: the solid.
    distance: the level of f that becomes the surface. Where f is a distance, the solid grows by it.

    Proof. The function f - distance changes along a ray as f does. So enclosures of f, and a
    Lipschitz constant of f, are also those of f - distance.
    """

    traits = dataclasses.replace(
        SolidOfField.traits, differentiable_arguments=("field", "distance")
    )

    field: Solid
    distance: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "distance", as_finite(self.distance, "distance"))
        self._copy_settings("domain", "lipschitz")

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return self.field.sublevel_extent(level + self.distance, above=above)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return own_formula(self.field)(x, y, z) - self.distance

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        inner = self.field.evaluator(backend, without_levels(plan))
        return _OffsetSolidEvaluator(inner, on_backend(self.distance, backend))


@dataclass(frozen=True, eq=False)
class _OffsetSolidEvaluator(EvaluatorOfInner):
    """The evaluator of f - distance, from that of f.

    distance: a kernel parameter.
    """

    distance: Real

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f - distance at coordinates that are numbers of any arithmetic."""
        return formula_of(self.inner)(x, y, z) - self.distance

    def evaluate(self, p: Vec3) -> Sample:
        return self._shifted(self.inner.evaluate(p))

    def _shifted(self, sample: Sample) -> Sample:
        """The sample of f - distance, from the sample of f at the same point. The bound of the
        error includes the rounding of the difference."""
        # The terms of the difference: its error is a few roundings of their size.
        size = dr.abs(sample.value) + abs(self.distance)
        return sample.map_promises(
            lambda promise: promise.shifted(-self.distance),
            value=sample.value - self.distance,
            value_error=sample.value_error + 8 * float(dr.epsilon(type(sample.value))) * size,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self.inner.hessian(p)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        ray_sample = self.inner.sample_ray(path, t, ahead, back)
        return replace(ray_sample, sample=self._shifted(ray_sample.sample))


def _check_formula(solid: Solid) -> None:
    """Raise TypeError for a solid without a formula. What is a `FormulaSolid` has one; a
    combination, if its parts do; and other solids are asked."""
    if isinstance(solid, BooleanSolid):
        for part in solid.parts:
            _check_formula(part)
    elif not (isinstance(solid, FormulaSolid) and has_own_formula(solid)):
        own_formula(solid)(*probe_jets())


def _checked_blend(radius: Any, power: Any) -> tuple[float, float]:
    """Radius and power of a blend as floats.

    Raises:
        ValueError: one of them is out of range.
    """
    radius, power = (
        as_real(value, name) if dr.is_array_v(type(value)) else value
        for name, value in (("radius", radius), ("power", power))
    )
    for name, least, value in (("radius", 0.0, radius), ("power", 1.0, power)):
        is_valid = isinstance(value, numbers.Real) and least <= float(value) < math.inf
        if not is_valid or value == 0:
            bound = "above 0" if least == 0.0 else f"of at least {least:g}"
            raise ValueError(f"{name} must be a number {bound}, not {value!r}")
    return float(radius), float(power)


@dataclass(frozen=True, eq=False)
class BlendedSolid(FormulaSolid):
    """The union or intersection of two solids with a fillet where their surfaces meet. Its function
    is a blend of the functions of both solids; `arithmetic.norms.blend_union` has the formula and
    its proofs.

    parts: the two solids.
    radius: how far the fillet extends along the surfaces, if the functions are distances.
    power: the exponent p of the superellipse that the fillet is a part of.
    is_union: True for the union, False for the intersection.

    Its Lipschitz constant is 2^(1/p) times the larger of the solids' constants. The fillet of a
    union lies where both functions are at most the radius. So it lies within the union of the
    solids grown by the radius.
    """

    traits = dataclasses.replace(by_numbers("parts", "radius", "power"), is_cheap=False)
    literals = ("power",)  # the ranges of x^p depend on the kind of number that p is

    parts: tuple[Solid, Solid]
    radius: Any
    power: Any
    is_union: bool

    def __post_init__(self) -> None:
        """Check the arguments, and set the attributes that follow from the two solids.

        Raises:
            ValueError: radius or power out of range.
            TypeError: a part that is not a solid, or has no formula.
        """
        radius, power = _checked_blend(self.radius, self.power)
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "power", power)
        for part in self.parts:
            if not isinstance(part, Solid):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise TypeError(not_a_solid(part))
            _check_formula(part)
        constants = [part.lipschitz for part in self.parts]
        all_known = all(part is not None for part in constants)
        # The constant of the blend of two functions, with a margin for rounding.
        lipschitz = 2 ** (1 / self.power) * max(constants) * (1 + 1e-6) if all_known else None
        object.__setattr__(self, "lipschitz", lipschitz)
        traits = dataclasses.replace(self.traits, min_wavelength=min_wavelength(self.parts))
        object.__setattr__(self, "traits", traits)
        object.__setattr__(self, "domain", union(*self.parts).domain)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A volume that is proved to contain all points where f <= level or, if `above`, all points
        where f >= level; None if no such volume is known.

        The result is such a volume for the same combination without a fillet. A fillet makes the
        function of a union smaller, so it adds points with f <= level: for these, the level is
        raised by `_min_operand_bound`. A fillet makes the function of an intersection larger, so
        the same holds for points with f >= level, with opposite signs. In the other two cases the
        level stays.
        """
        sharp = union(*self.parts) if self.is_union else self.parts[0] & self.parts[1]
        if self.is_union:
            return (
                sharp.sublevel_extent(level, above=True)
                if above
                else sharp.sublevel_extent(self._min_operand_bound(level))
            )
        return (
            sharp.sublevel_extent(-self._min_operand_bound(-level), above=True)
            if above
            else sharp.sublevel_extent(level)
        )

    def _min_operand_bound(self, level: float) -> float:
        """A bound of the smaller of the two solids' functions at all points where their blended
        union is at most `level`.

        Proof. The blend grows with both values that are blended. So it is at least the blend of the
        smaller value m with itself. With r the radius and p the power, that is r - 2^(1/p) (r - m)
        for m < r, and m for larger m. Solving r - 2^(1/p) (r - m) <= level for m gives the bound.
        """
        if level >= self.radius:
            return level
        # (1 - 1e-9 moves the bound upwards, by more than its rounding.)
        return self.radius - (self.radius - level) / 2 ** (1 / self.power) * (1 - 1e-9)

    @property
    def tally(self) -> Tally:
        """The summary of the formula's operations, for an unknown radius. The formula divides by
        the radius and multiplies by it again. So a small one makes no slope steep, and must not
        count as a number by which f may turn sharply."""
        other = copy.copy(self)
        object.__setattr__(other, "radius", choose_backend("double").Float(self.radius))
        return tally_of(other.formula)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b = (own_formula(part)(x, y, z) for part in self.parts)
        blend = blend_union if self.is_union else blend_intersection
        return blend(a, b, self.radius, self.power)
