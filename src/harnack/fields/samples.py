"""The records that fields return: `Sample`, at a point, and `RaySample`, at a point of a ray with
enclosures of f ahead and behind.

Rounding is part of the proof. The enclosure (a bound of f along the ray) ahead of a point and the
enclosure behind the next point may be exact to first order. Then they meet right at a surface, and
with rounded arithmetic one ray in ten slipped through at tight tolerances. So the difference of f
to every level is reduced by the rounding error of f, and a tolerance below that error is raised to
it.
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
    """Value, gradient and promises of a field f at a point p.

    value: f(p).
    gradient: (3,) the gradient of f at p.
    promises: what f guarantees near p.
    value_error: a bound of the error of `value`. It includes the truncation error. It includes
        rounding errors only as far as they exceed eight units in the last place, or eight times the
        smallest normal number; and it does not include |gradient| times the rounding of the point
        itself. The tracer adds these. Steps are shortened by the error.
    gradient_error: a bound of the truncation and rounding error of `gradient`, as a length; 0 if
        the error is only the rounding of a few operations.
    shading_normal: (3,) unit normal to shade with, for points near a singular point of the surface,
        where the gradient is of no use; None for the direction of the gradient. Steps do not depend
        on it.
    truncation_error: the part of `value_error` that a sample of higher accuracy reduces
        (`Field.at_accuracy`).
    alternative_promises: promises that are also valid, but gave shorter steps than `promises` in
        every measurement. They are used only if the
        caller names the enclosures to use.
    ray_promises: further promises, which hold only for points of the ray of a `Field.sample_ray`.
    branch_unknown: the lanes on which f is known only modulo 1 (`JumpSurface.has_unknown_branch`);
        None if there are none.
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
        """All promises, the alternative ones last."""
        return self.promises + self.alternative_promises

    def map_promises(self, change: Callable[[Promise], Promise], **numbers: Any) -> Sample:
        """This sample with each promise replaced by change(promise), the alternative promises
        included. `ray_promises` stay as they are.

        numbers: new values of further attributes, by their names.
        """
        promises, alternatives = (
            tuple(map(change, group)) for group in (self.promises, self.alternative_promises)
        )
        return dataclasses.replace(
            self, promises=promises, alternative_promises=alternatives, **numbers
        )

    def shifted(self, offset: Real) -> Sample:
        """The sample of f + offset at the same point. The rounding of the sum is not counted."""
        return self.map_promises(lambda promise: promise.shifted(offset), value=self.value + offset)

    def select(self, mask: Mask, other: Sample) -> Sample:
        """The sample `other` on the lanes of the mask, this sample on all other lanes. Both samples
        must have promises of the same kinds in the same order. The result has no shading normal."""
        names = "value", "gradient", "value_error", "gradient_error", "truncation_error"
        numbers = {k: dr.select(mask, getattr(other, k), getattr(self, k)) for k in names}
        groups: dict[str, Any] = {}
        for k in ("promises", "alternative_promises", "ray_promises"):
            pairs = zip(getattr(self, k), getattr(other, k), strict=True)
            groups[k] = tuple(ours.select(mask, theirs) for ours, theirs in pairs)
        return dataclasses.replace(self, shading_normal=None, **numbers, **groups)


_R = TypeVar("_R", bound=Sample | Promise)
_SAMPLE_HELP = (
    "return harnack.proofs.Sample(value, gradient, promises), with a Dr.Jit number, a Dr.Jit "
    "3-vector and a tuple of promises, such as (harnack.proofs.Lipschitz(1.0),) if |grad f| <= 1"
)


def validate_samples(
    evaluate: Callable[[Any, Vec3], Sample],
) -> Callable[[Any, Vec3], Sample]:
    """Wrap the method `evaluate` of a field so that its result is checked.

    The wrapped method raises TypeError if `evaluate` returns anything but a valid `Sample`, and
    NotImplementedError if the value has derivatives that the field would drop. It also turns NumPy
    scalars in the sample into Python numbers, as Dr.Jit takes no NumPy scalars.
    """

    @functools.wraps(evaluate)
    def checked(self: Any, p: Vec3) -> Sample:
        """The sample at p that `evaluate` returns, after all checks."""
        sample: Any = evaluate(self, p)
        name = f"{type(self).__name__}.evaluate"
        if not isinstance(sample, Sample):
            raise TypeError(
                f"{name} returned {_describe_type(sample)}, not a Sample: {_SAMPLE_HELP}"
            )
        group: Any
        for place, group in (
            ("promises", sample.promises),
            ("alternative_promises", sample.alternative_promises),
        ):
            if not isinstance(group, tuple):
                raise TypeError(
                    f"{name}: Sample.{place} is {_describe_type(group)}, not a tuple: "
                    f"{_SAMPLE_HELP}"
                )
            for promise in cast("tuple[Any, ...]", group):
                if not isinstance(promise, Promise):
                    wrong = f"Sample.{place} holds {_describe_type(promise)}, no promise"
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
    """The record, with attributes that are NumPy scalars turned into Python numbers, as Dr.Jit
    takes no NumPy scalars."""
    scalars: dict[str, Any] = {
        key: value.item() for key, value in vars(record).items() if isinstance(value, np.generic)
    }
    return dataclasses.replace(record, **scalars) if scalars else record


def _describe_type(value: Any) -> str:
    """The type of a value in words, for messages."""
    return "nothing" if value is None else f"an object of type {type(value).__name__}"


def space_scaled(sample: Sample, size: Real) -> Sample:
    """The sample of the function x -> f(x / size) at the point size * p, from the sample of f at p.

    Values stay the same. Radii are multiplied by the size. Gradients and Lipschitz constants are
    divided by it. Bounds of second derivatives and of Laplacians are divided by its square.
    """
    return sample.map_promises(
        lambda promise: promise.space_scaled(size),
        gradient=sample.gradient / size,
        gradient_error=sample.gradient_error / size,
        ray_promises=tuple(promise.space_scaled(size) for promise in sample.ray_promises),
    )


def value_error_bound(sample: Sample, gradient_norm: Real, size: Real) -> Real:
    """A bound of the error of a sample's value: truncation, rounding, and the effect of the
    rounding of the point.

    gradient_norm: |gradient| of the sample.
    size: a bound of the absolute values of the point's coordinates.
    """
    kind = cast("Any", type(sample.value))
    epsilon = 2 * float(dr.epsilon(kind))
    # Numbers below the smallest normal one may underflow to 0.
    smallest = kind(float(dr.smallest(kind)))
    value = 8 * fmax(epsilon * dr.abs(sample.value), smallest)
    return dr.fma(gradient_norm, 4 * epsilon * size, value + sample.value_error)


@dataclass(frozen=True)
class RaySample:
    """A sample on a ray, with enclosures of f in both directions.

    Below, x(t) = o + t d is the ray and s >= 0 a length along it.

    sample: the sample at x(t).
    forward: enclosures of f(x(t + s)) - f(x(t)), as functions of s.
    backward: enclosures of f(x(t - s)) - f(x(t)), from the same evaluation.
    slope: the derivative of f along the ray at x(t), with an error of at most `slope_error_bound`.
    reach_growth: up to which length the enclosures of the next sample should be computed, as a
        multiple of the step that this sample proves.
    slope_error: a bound of the error of `slope` that is smaller than `Sample.gradient_error`; None
        if no such bound is known. (On a crease the gradient is a range, but the derivative along a
        ray that runs in the crease may be a number.)
    min_gradient_norm: a lower bound of |grad f| that may be larger than |gradient| minus
        `Sample.gradient_error`, as on a crease; None if no such bound is known.
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
        """A bound of the error of `slope`: `slope_error` or, if that is None, the error of the
        gradient."""
        return self.sample.gradient_error if self.slope_error is None else self.slope_error


@dataclass(frozen=True)
class Ray:
    """Rays o + t d with |d| = 1, and the classes of enclosures (proofs of bounds of f along a ray)
    by which steps on them are proved.

    origin, direction: (3,) o and d, one ray per lane.
    proofs: the classes of enclosures to use.
    """

    origin: Vec3
    direction: Vec3
    proofs: EnclosureKinds

    def point(self, t: Real) -> Vec3:
        """The points at parameters t."""
        return dr.fma(type(self.origin)(t), self.direction, self.origin)

    def enclose(self, sample: Sample) -> RaySample:
        """The sample with enclosures: intervals, as functions of the length s along the ray, that
        provably contain the change of f from the sample's point, ahead and behind.

        They follow from the sample's promises (proved bounds of f near the point) and the slope of
        f along the ray. The gradient has an error, so the slope enters the proofs as an interval.
        """
        slope = dr.dot(sample.gradient, self.direction)
        slopes = SlopeRange.around(slope, sample.gradient_error)
        arguments = sample.promises, sample.alternative_promises, sample.value, sample.value_error
        ahead, back = (
            self.proofs.from_promises(*arguments, interval, sample.ray_promises)
            for interval in (slopes, slopes.negated())
        )
        return RaySample(sample, ahead, back, slope)
