"""Combinations of solids: unions, intersections, complements, offsets, and blends."""

from __future__ import annotations

import copy
import math
import numbers
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.arithmetic import maximum, minimum
from harnack.arithmetic.norms import blend_intersection, blend_union
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.backend.validation import as_finite
from harnack.enclosures import Enclosure, Lipschitz
from harnack.enclosures.extremum import MaximumEnclosure, MaximumOperand, NegatedEnclosure
from harnack.fields.field import Field
from harnack.fields.formula import prepare_value, probe_jets
from harnack.fields.samples import Ray, RaySample, Sample, value_error_bound
from harnack.fields.solids.solid import FormulaSolid, Solid, SolidOfField, not_a_solid
from harnack.geometry import Box, VolumeIntersection

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

# Other parts are used to narrow the range of the value if that shifts it by more than this fraction
# of its error; at creases the shift is nearly always smaller.
_MIN_SHIFT = 0.25


def union(*solids: Solid) -> Solid:
    """All points of any of the solids. Raises ValueError for none, TypeError for no solids."""
    return BooleanSolid(_flatten_operands(solids, is_union=True), is_union=True)


def intersection(*solids: Solid) -> Solid:
    """The points that are in all of the solids. Raises as `union`."""
    return BooleanSolid(_flatten_operands(solids, is_union=False), is_union=False)


def _flatten_operands(solids: tuple[Solid, ...], *, is_union: bool) -> tuple[Solid, ...]:
    if not solids:
        raise ValueError("give at least one solid")
    flat: list[Solid] = []
    for solid in solids:
        if not isinstance(solid, Solid):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(not_a_solid(solid))
        if isinstance(solid, BooleanSolid) and solid.is_union == is_union:
            flat.extend(solid.parts)
        else:
            flat.append(solid)
    return tuple(flat)


@dataclass(frozen=True, eq=False)
class BooleanSolid(Solid):
    """The union, min f_i, or the intersection, max f_i, of solids.

    If the f_i are distances, the minimum is exact outside and only a bound inside, and the maximum
    is only a bound. Hart 1996, equation 16, calls the union exact inside too; unit discs at -1/2
    and 1/2 show that it is not: the distance at 0 is 0.866, and not 0.5.
    """

    parts: tuple[Solid, ...]
    is_union: bool

    def __post_init__(self) -> None:
        domains = list(dict.fromkeys(one.domain for one in self.parts if one.domain is not None))
        domain = None
        if domains:
            domain = domains[0] if len(domains) == 1 else VolumeIntersection(domains)
        object.__setattr__(self, "domain", domain)
        object.__setattr__(
            self, "has_variable_accuracy", any(one.has_variable_accuracy for one in self.parts)
        )
        coarsest = min((one.coarsest_accuracy for one in self.parts), default=1.0)
        object.__setattr__(self, "coarsest_accuracy", coarsest)
        # A part that proves nothing looking back would refuse all longer steps.
        object.__setattr__(self, "over_relaxation", min(one.over_relaxation for one in self.parts))
        object.__setattr__(self, "min_wavelength", min_wavelength(self.parts))
        constants = [one.lipschitz for one in self.parts]
        known = all(one is not None for one in constants)
        object.__setattr__(self, "lipschitz", max(constants) if known else None)

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return BooleanSolid(tuple(one.map_operands(change) for one in self.parts), self.is_union)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        hulls = [one.sublevel_extent(level, above=above) for one in self.parts]
        known = [one for one in hulls if one is not None]
        if self.is_union == above:
            return VolumeIntersection(known) if len(known) > 1 else next(iter(known), None)
        if len(known) < len(hulls):
            return None
        return _around(known)

    @property
    def is_steep(self) -> bool:
        return any(part.is_steep for part in self.parts)

    def prepare(self, backend: Backend) -> Solid:
        return self._of([one.prepare(backend) for one in self.parts])

    def at_accuracy(self, detail: Real) -> Field:
        return self._of([one.at_accuracy(detail) for one in self.parts])

    def for_ray_count(self, count: int) -> Field:
        def make(parts: list[Any]) -> Solid:
            return BooleanSolid(tuple(parts), self.is_union)

        return self._for_rays(self.parts, count, make)

    def _of(self, parts: list[Field]) -> Solid:
        """The same combination of other operands, which need not be solids."""
        other = copy.copy(self)
        object.__setattr__(other, "parts", tuple(parts))
        return other

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        values = [one.formula(x, y, z) for one in self.parts]
        if len(values) == 1:
            return values[0]
        return minimum(*values) if self.is_union else maximum(*values)

    def evaluate(self, p: Vec3) -> Sample:
        samples = [one.evaluate(p) for one in self.parts]
        return self._combine_samples(samples, max_norm(p))[0]

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        best: Any = None
        rows: Any = None
        for one in self.parts:
            value, own = one.evaluate(p).value, one.hessian(p)
            if rows is None:
                best, rows = value, own
                continue
            chosen = (value < best) if self.is_union else (value > best)
            rows = tuple(dr.select(chosen, a, b) for a, b in zip(own, rows, strict=True))
            best = dr.select(chosen, value, best)
        return rows

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """The largest derivative errors of the operands that may be the extreme one. Infinite where
        rounding leaves open which one is, since derivatives jump there."""
        size = max_norm(p)
        sign = -1.0 if self.is_union else 1.0
        whole = value_error_bound(sample, safe_norm(sample.gradient), size)
        near, slopes, bends = 0 * p.x, 0 * p.x, 0 * p.x
        for one in self.parts:
            own = one.evaluate(p)
            doubt = value_error_bound(own, safe_norm(own.gradient), size)
            is_open = ~(sign * (sample.value - own.value) > doubt + whole)
            near = near + dr.select(is_open, 1.0, 0.0)
            slope, bend = one.derivative_errors(p, own)
            # NaN is kept, as it bounds nothing.
            slopes = dr.select(is_open & ~(slope <= slopes), slope, slopes)
            bends = dr.select(is_open & ~(bend <= bends), bend, bends)
        is_one = near <= 1
        return dr.select(is_one, slopes, dr.inf), dr.select(is_one, bends, dr.inf)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The ray sample of the combination, from those of all operands, by `MaximumEnclosure`."""
        looks = [one.sample_ray(path, t, ahead, back) for one in self.parts]
        size = max_norm(path.origin) + t
        sample, below, extreme = self._combine_samples([one.sample for one in looks], size)
        slope, slope_error = looks[-1].slope, looks[-1].slope_error_bound
        for look in looks[:-1]:
            is_chosen = look.sample.value == extreme
            slope = dr.select(is_chosen, look.slope, slope)
            slope_error = dr.select(is_chosen, look.slope_error_bound, slope_error)
        front = self._enclosures([one.forward for one in looks], below)
        behind = self._enclosures([one.backward for one in looks], below)
        growth = max(one.reach_growth for one in looks)
        return RaySample(sample, front, behind, slope, growth, slope_error)

    def _enclosures(
        self, parts: list[tuple[Enclosure, ...]], below: list[tuple[Real, Real]]
    ) -> tuple[Enclosure, ...]:
        if not all(parts):
            return ()
        if self.is_union:
            parts = [tuple(NegatedEnclosure(one) for one in part) for part in parts]
        greatest = MaximumEnclosure(
            tuple(
                MaximumOperand(*lengths, part) for lengths, part in zip(below, parts, strict=True)
            )
        )
        return (NegatedEnclosure(greatest),) if self.is_union else (greatest,)

    def _combine_samples(
        self, samples: list[Sample], size: Real
    ) -> tuple[Sample, list[tuple[Real, Real]], Real]:
        """The sample of the combination; for each operand bounds (lower, upper) of the difference
        by which it is below the greatest operand; and the greatest (for a union, the least) value.

        Proof of the errors. Let v_i be values with errors e_i (all rounding, `value_error_bound`),
        v = v_k the greatest. max f_i <= max(v_i + e_i) = v + max(e_i - (v - v_i)), and max f_i >=
        v_k - e_k. So max(e_i - (v - v_i)) is the error of the combination. As max f_i >= v_j - e_j
        for every j, an operand with a smaller error may exclude most of that range. Then the value
        is the middle of the remaining range, for otherwise a ray would hit, by the rounding of an
        operand, a surface that lies inside of another operand. The tracer subtracts the error of
        the combination from its gaps. If the error of an operand is larger, the excess is
        subtracted from the difference by which the operand is below.
        """
        sign = -1.0 if self.is_union else 1.0
        values = [sign * one.value for one in samples]
        greatest = values[0]
        for one in values[1:]:
            greatest = fmax(one, greatest)
        chosen = samples[-1]
        value, gradient, slope_error = chosen.value, chosen.gradient, chosen.gradient_error
        value, slope_error = 0 * greatest + value, 0 * greatest + slope_error
        for sample, own in zip(samples[:-1], values[:-1], strict=True):
            is_greatest = own >= greatest
            value = dr.select(is_greatest, sample.value, value)
            gradient = dr.select(is_greatest, sample.gradient, gradient)
            slope_error = dr.select(is_greatest, sample.gradient_error, slope_error)
        errors = [value_error_bound(one, safe_norm(one.gradient), size) for one in samples]
        error, truncation = 0 * greatest, 0 * greatest
        for sample, own, off in zip(samples, values, errors, strict=True):
            gap = greatest - own
            error = fmax(fmax(off - gap, sample.value_error - gap), error)
            truncation = fmax(sample.truncation_error - gap, truncation)
        least = values[0] - errors[0]
        for own, off in zip(values[1:], errors[1:], strict=True):
            least = fmax(own - off, least)
        shift = 0.5 * (least - (greatest - error))
        shift = dr.select(shift > _MIN_SHIFT * error, shift, 0)
        extreme, value = value, value + sign * shift
        greatest, error = greatest + shift, error - shift
        # `Sample.value_error` leaves out the rounding that follows from value and gradient.
        plain = Sample(value, gradient, ())
        stated = value_error_bound(plain, safe_norm(gradient), size)
        joined = Sample(
            value, gradient, self._common_lipschitz(samples), fmax(error - stated, 0), slope_error,
            truncation_error=truncation,
        )  # fmt: skip
        whole = value_error_bound(joined, safe_norm(gradient), size)
        return (
            joined,
            [
                (
                    fmax(greatest - own - fmax(off - whole, 0), 0),
                    greatest - own + fmax(off - whole, 0),
                )
                for own, off in zip(values, errors, strict=True)
            ],
            extreme,
        )

    def _common_lipschitz(self, samples: list[Sample]) -> tuple[Lipschitz, ...]:
        """The largest of the Lipschitz constants of the parts, which is one of the combination."""
        constant: Any = 0.0
        radius: Any = math.inf
        for sample in samples:
            own = lipschitz_of(sample)
            if own is None:
                return ()
            constant = fmax(0 * sample.value + own.constant, constant)
            radius = fmin(0 * sample.value + own.radius, radius)
        return (Lipschitz(constant, radius),)


def min_wavelength(parts: Iterable[Solid]) -> float | None:
    """The smallest `Field.min_wavelength` of several fields."""
    return min(
        (one.min_wavelength for one in parts if one.min_wavelength is not None), default=None
    )


def lipschitz_of(sample: Sample) -> Lipschitz | None:
    """A Lipschitz constant that a sample promises, or one that follows from another promise."""
    found = [one.implied_lipschitz(sample.value) for one in sample.all_promises]
    stated = (one for one in sample.all_promises if isinstance(one, Lipschitz))
    return next(stated, None) or next((one for one in found if one is not None), None)


def _around(volumes: list[Volume]) -> Volume | None:
    """A box around volumes; None if they have no bounds."""
    corners = [one.bounds() for one in volumes]
    low = np.min([one for one, _ in corners], axis=0)
    high = np.max([one for _, one in corners], axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    if len(volumes) == 1:
        return volumes[0]
    return Box(tuple(low), tuple(high))


@dataclass(frozen=True, eq=False)
class Complement(SolidOfField):
    """All points that are not inside a solid: -f."""

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
        return -self.field.formula(x, y, z)

    def evaluate(self, p: Vec3) -> Sample:
        return negated_sample(self.field.evaluate(p))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        x, y, z = self.field.hessian(p)
        return -x, -y, -z

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        return negated_look(self.field.sample_ray(path, t, ahead, back))


def negated_look(look: RaySample) -> RaySample:
    """The ray sample of -f from that of f."""
    return RaySample(
        negated_sample(look.sample),
        tuple(NegatedEnclosure(one) for one in look.forward),
        tuple(NegatedEnclosure(one) for one in look.backward),
        -look.slope,
        look.reach_growth,
        look.slope_error,
    )


def negated_sample(sample: Sample) -> Sample:
    """The sample of -f from that of f."""
    return sample.map_promises(
        lambda one: one.negated(),
        value=-sample.value,
        gradient=-sample.gradient,
        shading_normal=None if sample.shading_normal is None else -sample.shading_normal,
    )


@dataclass(frozen=True, eq=False)
class OffsetSolid(SolidOfField):
    """The points where f <= distance.

    Proof. f - distance has the enclosures of f, and its Lipschitz constant.
    """

    field: Solid
    distance: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "distance", as_finite(self.distance, "distance"))
        self._copy_settings("domain", "lipschitz")

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return self.field.sublevel_extent(level + self.distance, above=above)

    def prepare(self, backend: Backend) -> Solid:
        other = super().prepare(backend)
        object.__setattr__(other, "distance", prepare_value(self.distance, backend))
        return other

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return self.field.formula(x, y, z) - self.distance

    def evaluate(self, p: Vec3) -> Sample:
        return self._shifted(self.field.evaluate(p))

    def _shifted(self, sample: Sample) -> Sample:
        """The sample of f - distance, with the rounding of the difference."""
        size = dr.abs(sample.value) + abs(self.distance)
        return sample.map_promises(
            lambda one: one.shifted(-self.distance),
            value=sample.value - self.distance,
            value_error=sample.value_error + 8 * float(dr.epsilon(type(sample.value))) * size,
        )

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self.field.hessian(p)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        look = self.field.sample_ray(path, t, ahead, back)
        return replace(look, sample=self._shifted(look.sample))


@dataclass(frozen=True, eq=False)
class BlendedSolid(FormulaSolid):
    """The union or intersection of two solids with a fillet: see `arithmetic.norms.blend_union`.

    Its Lipschitz constant is 2^(1/p) times the larger of the solids' own. A union's fillet lies
    where both functions are at most the radius: within the union of the solids grown by the radius.
    """

    is_cheap = False

    parts: tuple[Solid, Solid]
    radius: Any
    power: Any
    is_union: bool

    def __post_init__(self) -> None:
        for name, least, value in (("radius", 0.0, self.radius), ("power", 1.0, self.power)):
            good = isinstance(value, numbers.Real) and least <= float(value) < math.inf
            if not good or value == 0:
                bound = "above 0" if least == 0.0 else f"of at least {least:g}"
                raise ValueError(f"{name} must be a number {bound}, not {value!r}")
            object.__setattr__(self, name, float(value))
        for one in self.parts:
            if not isinstance(one, Solid):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise TypeError(not_a_solid(one))
            one.formula(*probe_jets())  # raises TypeError for a solid without a formula
        constants = [one.lipschitz for one in self.parts]
        known = all(one is not None for one in constants)
        lipschitz = 2 ** (1 / self.power) * max(constants) * (1 + 1e-6) if known else None
        object.__setattr__(self, "lipschitz", lipschitz)
        object.__setattr__(self, "min_wavelength", min_wavelength(self.parts))
        object.__setattr__(self, "domain", union(*self.parts).domain)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        whole = union(*self.parts) if self.is_union else self.parts[0] & self.parts[1]
        if self.is_union:
            return (
                whole.sublevel_extent(level, above=True)
                if above
                else whole.sublevel_extent(self._min_operand_bound(level))
            )
        return (
            whole.sublevel_extent(-self._min_operand_bound(-level), above=True)
            if above
            else whole.sublevel_extent(level)
        )

    def _min_operand_bound(self, level: float) -> float:
        """A bound of the smaller of both functions where their blended union is at most `level`.

        Proof. The blend grows with both, so it is at least that of the lesser value m taken twice:
        r - 2^(1/p) (r - m) for m < r, and m beyond.
        """
        if level >= self.radius:
            return level
        return self.radius - (self.radius - level) / 2 ** (1 / self.power) * (1 - 1e-9)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        a, b = (one.formula(x, y, z) for one in self.parts)
        blend = blend_union if self.is_union else blend_intersection
        return blend(a, b, self.radius, self.power)

    def prepare(self, backend: Backend) -> Solid:
        other = copy.copy(self)
        parts = tuple(one.prepare(backend) for one in self.parts)
        object.__setattr__(other, "parts", parts)
        # The power stays a literal: the ranges of x^p depend on the kind of number that p is.
        object.__setattr__(other, "radius", prepare_value(self.radius, backend))
        return other
