"""What a field returns: a `Sample` at a point, or a `RaySample`, a sample with enclosures.

Rounding is part of the proof. Two looks, forward and back, that are exact to first order meet right
at a surface; with rounded arithmetic one ray in ten slipped through at tight tolerances. Every gap
is narrowed by what rounding may have done, and a tolerance below that is raised to it.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax
from harnack.backend.validation import check_no_derivatives
from harnack.enclosures import Enclosure, EnclosureKinds, Lipschitz, Promise, SlopeRange

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Mask, Real, Vec3


@dataclass(frozen=True)
class Sample:
    """One evaluation at a point p.

    value: f(p).
    gradient: (3,) of f at p.
    promises: promises that hold near p.
    value_error_bound: a bound of the error of `value` by an approximation, and by rounding as far
        as that is more than eight units in its last place or eight times the smallest normal number
        (and more than |gradient| times the rounding of the point itself, which the tracer adds).
        Steps are shortened by it.
    gradient_error: a bound of the error of `gradient` by rounding and an approximation, as a
        length; 0 where it is only the rounding of a few operations.
    shading_normal: (3,) unit normal to shade with, where the gradient is of no use (near a singular
        point of the surface); None for the gradient's own direction. Steps do not depend on it.
    truncation_error: the part of `value_error_bound` that an evaluation at more detail reduces
        (`Field.at_detail`).
    alternative_promises: promises that are as true as `all_promises`, but proved shorter steps
        wherever that was measured. Only a bound that is asked for by name uses them.
    ray_promises: more promises, which hold only for points of the path of a `Field.sample_ray`.
    branch_unknown: where f is known but for a whole number (`JumpSurface.has_unknown_branch`); None
        for nowhere.
    """

    value: Real
    gradient: Vec3
    promises: tuple[Promise, ...]
    value_error: Real = 0.0
    gradient_error: Real = 0.0
    shading_normal: Vec3 | None = None
    truncation_error: Real = 0.0
    alternative_promises: tuple[Promise, ...] = ()
    ray_promises: tuple[Lipschitz, ...] = ()
    branch_unknown: Mask | None = None

    @property
    def all_promises(self) -> tuple[Promise, ...]:
        """All promises, the weaker ones last."""
        return self.promises + self.alternative_promises

    def map_promises(self, change: Callable[[Promise], Promise], **numbers: Any) -> Sample:
        """The sample with each promise changed, and with other attributes replaced."""
        known, weaker = (
            tuple(map(change, group)) for group in (self.promises, self.alternative_promises)
        )
        return dataclasses.replace(self, promises=known, alternative_promises=weaker, **numbers)

    def shifted(self, offset: Real) -> Sample:
        """The sample of f + offset, a number that adds no error."""
        return self.map_promises(lambda one: one.shifted(offset), value=self.value + offset)

    def select(self, mask: Mask, other: Sample) -> Sample:
        """The other sample, with promises of the same kinds, where the mask holds, this one
        elsewhere. Without normals."""
        names = "value", "gradient", "value_error", "gradient_error", "truncation_error"
        numbers = {k: dr.select(mask, getattr(other, k), getattr(self, k)) for k in names}
        groups: dict[str, Any] = {}
        for k in ("promises", "alternative_promises", "ray_promises"):
            pairs = zip(getattr(self, k), getattr(other, k), strict=True)
            groups[k] = tuple(own.select(mask, one) for own, one in pairs)
        return dataclasses.replace(self, shading_normal=None, **numbers, **groups)


_R = TypeVar("_R", bound=Sample | Promise)
_SAMPLE_HELP = (
    "return harnack.Sample(value, gradient, promises), with a Dr.Jit number, a Dr.Jit 3-vector and "
    "a tuple of promises, such as (harnack.Lipschitz(1.0),) if |grad f| <= 1"
)


def validate_samples(
    evaluate: Callable[[Any, Vec3], Sample],
) -> Callable[[Any, Vec3], Sample]:
    """The method `evaluate` of a field, which raises TypeError if it returns anything but a proper
    `Sample`, and NotImplementedError if the value has derivatives that the field would drop."""

    @functools.wraps(evaluate)
    def checked(self: Any, p: Vec3) -> Sample:
        sample: Any = evaluate(self, p)
        name = f"{type(self).__name__}.evaluate"
        if not isinstance(sample, Sample):
            raise TypeError(
                f"{name} returned {_describe_type(sample)}, not a Sample: {_SAMPLE_HELP}"
            )
        given: Any
        for place, given in (
            ("promises", sample.promises),
            ("alternative_promises", sample.alternative_promises),
        ):
            if not isinstance(given, tuple):
                raise TypeError(
                    f"{name}: Sample.{place} is {_describe_type(given)}, not a tuple: "
                    f"{_SAMPLE_HELP}"
                )
            for one in cast("tuple[Any, ...]", given):
                if not isinstance(one, Promise):
                    wrong = f"Sample.{place} holds {_describe_type(one)}, no promise"
                    raise TypeError(f"{name}: {wrong}: {_SAMPLE_HELP}")
        gradient: Any = sample.gradient
        if not dr.is_array_v(type(gradient)) or dr.size_v(type(gradient)) != 3:
            raise TypeError(
                f"{name}: Sample.gradient is {_describe_type(gradient)}, no 3-vector: "
                f"{_SAMPLE_HELP}"
            )
        if self.has_no_parameters() and not dr.grad_enabled(p):
            check_no_derivatives(type(self).__name__, sample.value)
        return _unbox_numpy(sample).map_promises(_unbox_numpy)

    return checked


def _unbox_numpy(record: _R) -> _R:
    """A record whose scalars of NumPy are Python's: Dr.Jit takes no others."""
    scalars: dict[str, Any] = {
        key: one.item() for key, one in vars(record).items() if isinstance(one, np.generic)
    }
    return dataclasses.replace(record, **scalars) if scalars else record


def _describe_type(value: Any) -> str:
    return "nothing" if value is None else f"an object of type {type(value).__name__}"


def space_scaled(sample: Sample, size: Real) -> Sample:
    """Convert a sample of f at p to one of x -> f(x / size) at size * p.

    Values stay; radii are multiplied by the size, gradients and Lipschitz constants divided by it,
    curvatures and Laplacians by its square.
    """
    return sample.map_promises(
        lambda one: one.space_scaled(size),
        gradient=sample.gradient / size,
        gradient_error=sample.gradient_error / size,
        ray_promises=tuple(one.space_scaled(size) for one in sample.ray_promises),
    )


def value_error_bound(sample: Sample, gradient_norm: Real, size: Real) -> Real:
    """A bound of the error of f by rounding and truncation, at a point whose coordinates are at
    most `size`; gradient_norm: |gradient|."""
    kind = cast("Any", type(sample.value))
    epsilon = 2 * float(dr.epsilon(kind))
    # Numbers below the smallest normal one may underflow to 0.
    smallest = kind(float(dr.smallest(kind)))
    value = 8 * fmax(epsilon * dr.abs(sample.value), smallest)
    return dr.fma(gradient_norm, 4 * epsilon * size, value + sample.value_error)


@dataclass(frozen=True)
class RaySample:
    """A sample at a point of a path, and what is proved along the path in both directions.

    forward: enclosures of f(path(t+s)) - f(path(t)).
    backward: enclosures of f(path(t-s)) - f(path(t)), from the same evaluation.
    slope: the derivative of f along the path, known up to `slope_error`.
    reach_growth: how far the enclosures of the next look should reach, as a multiple of the step
        that this one proves.
    slope_error: a bound of the error of `slope`, where one is known that is less than
        `Sample.gradient_error`: on a crease the gradient is a range, and the derivative along a ray
        that runs in the crease may still be a number. Else None.
    min_gradient_norm: a lower bound of |grad f|, where one is known that may be more than
        |gradient| less `Sample.gradient_error`, as on a crease. Else None.
    """

    sample: Sample
    forward: tuple[Enclosure, ...]
    backward: tuple[Enclosure, ...]
    slope: Real
    reach_growth: float = 2.0
    slope_error: Real | None = None
    min_gradient_norm: Real | None = None

    @property
    def slope_error_bound(self) -> Real:
        """The bound of the error of `slope`."""
        return self.sample.gradient_error if self.slope_error is None else self.slope_error


@dataclass(frozen=True)
class Ray:
    """The rays o + t d, |d| = 1, along which a field is sampled, and the proofs to use."""

    origin: Vec3
    direction: Vec3
    proofs: EnclosureKinds

    def point(self, t: Real) -> Vec3:
        """The points at parameters t."""
        return dr.fma(type(self.origin)(t), self.direction, self.origin)

    def enclose(self, sample: Sample) -> RaySample:
        """What the promises of a sample prove along the path, with the slope of f along it.

        A slope known up to an error enters as an interval: see `Enclosure`.
        """
        slope = dr.dot(sample.gradient, self.direction)
        slopes = SlopeRange.around(slope, sample.gradient_error)
        given = sample.promises, sample.alternative_promises, sample.value, sample.value_error
        ahead, back = (
            self.proofs.from_promises(*given, one, sample.ray_promises)
            for one in (slopes, slopes.negated())
        )
        return RaySample(sample, ahead, back, slope)
