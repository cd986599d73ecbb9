"""What a field returns about its function f: a `Sample` at a point, and a `RaySample` at a point of
a ray. A sample holds value and gradient with error bounds, and promises: proved bounds of f near
the point, such as a Lipschitz constant on a ball. A ray sample adds enclosures: intervals that are
proved to hold the change of f along the ray, in front of the point (forward) and behind it
(backward).

Rounding is part of the proof. The length proved in front of a point and the length proved behind
the next point may both end right at a surface between the two points. Without a margin for
rounding, they could overlap there by rounding alone, and the ray would pass through the surface. So
the difference of f to every level is reduced by the rounding error of f, and a tolerance below that
error is raised to it.
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
    """Value and gradient of a field's function f at a point p, with bounds of their errors, and
    with promises: proved bounds of f near p (`harnack.enclosures.promises`). All numbers may differ
    from lane to lane, one point in each.

    value: f(p).
    gradient: (3,) the gradient of f at p.
    promises: the proved bounds of f near p, such as a `Lipschitz` constant on a ball about p.
    value_error: a bound of the error of `value`. The whole truncation error is included. Of the
        rounding error, eight units in the last place of the value (or eight times the smallest
        normal number, if that is more) are left out, and only the rest is included. The tracer adds
        what is left out, and |gradient| times the rounding error of p. Steps are shortened by the
        error.
    gradient_error: a bound of the truncation and rounding error of `gradient`, as a length; 0 if
        the error is only the rounding of a few operations.
    shading_normal: (3,) the unit normal to shade with near a singular point of the surface, where
        the gradient is of no use; None for the direction of the gradient. Steps do not depend on
        it.
    truncation_error: the part of `value_error` that becomes smaller if f is sampled with higher
        accuracy (`capabilities.VariableAccuracy`).
    alternative_promises: proved bounds that are also valid, but gave shorter steps than `promises`
        in every measurement. They are used only if the caller names the enclosures to use.
    ray_promises: bounds that hold only on one ray through p: Lipschitz constants of f there. Only
        samples of `Evaluator.sample_ray` have them.
    branch_unknown: a mask, true on lanes on which `value` may differ from f by an unknown integer
        (`VariableAccuracy.may_lack_integer`); None if there are no such lanes.
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
        """The proved bounds of both kinds as one tuple: `promises`, then `alternative_promises`."""
        return self.promises + self.alternative_promises

    def map_promises(self, change: Callable[[Promise], Promise], **numbers: Any) -> Sample:
        """This sample with each of its promises, the alternative ones included, replaced by
        change(promise). `ray_promises` stay as they are.

        change: a function from a promise to a promise.
        numbers: new values of other attributes of the sample, as keywords such as value=...
        """
        promises, alternatives = (
            tuple(map(change, group)) for group in (self.promises, self.alternative_promises)
        )
        return dataclasses.replace(
            self, promises=promises, alternative_promises=alternatives, **numbers
        )

    def shifted(self, offset: Real) -> Sample:
        """The sample of the function f + offset at the same point. The rounding error of the sum is
        not counted."""
        return self.map_promises(lambda promise: promise.shifted(offset), value=self.value + offset)

    def select(self, mask: Mask, other: Sample) -> Sample:
        """The sample `other` on the lanes on which the mask is true, and this sample on all other
        lanes. Both samples must have promises of the same kinds in the same order. The result has
        no shading normal, and the mask `branch_unknown` of this sample."""
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
    """Decorator of a field's method `evaluate`: the decorated method checks what `evaluate`
    returns. It raises TypeError for anything but a valid `Sample`, and NotImplementedError if the
    value has derivatives enabled that the field would drop. It also turns NumPy scalars in the
    sample into Python numbers, because Dr.Jit takes no NumPy scalars."""

    @functools.wraps(evaluate)
    def checked(self: Any, p: Vec3) -> Sample:
        """The sample at p that `evaluate` returns, after the checks of `validate_samples`."""
        name = f"{type(self).__name__}.evaluate"
        try:
            sample: Any = evaluate(self, p)
        except RuntimeError as error:
            # What Dr.Jit says of a number that is wanted while a loop is being recorded.
            if "remains dirty" not in str(error):
                raise
            raise TypeError(
                f"{name} asked for the numbers of p, as NumPy functions do: it is recorded as part "
                "of a kernel, before there are numbers, so write it with functions of drjit, such "
                "as dr.norm(p) and dr.select(mask, a, b)"
            ) from error
        if not isinstance(sample, Sample):
            raise TypeError(
                f"{name} returned {describe_type(sample)}, not a Sample: {_SAMPLE_HELP}"
            )
        # Both attributes must be tuples of promises.
        group: Any
        for place, group in (
            ("promises", sample.promises),
            ("alternative_promises", sample.alternative_promises),
        ):
            if not isinstance(group, tuple):
                raise TypeError(
                    f"{name}: Sample.{place} is {describe_type(group)}, not a tuple: {_SAMPLE_HELP}"
                )
            for promise in cast("tuple[Any, ...]", group):
                if not isinstance(promise, Promise):
                    wrong = f"Sample.{place} holds {describe_type(promise)}, no promise"
                    raise TypeError(f"{name}: {wrong}: {_SAMPLE_HELP}")
        gradient: Any = sample.gradient
        if not dr.is_array_v(type(gradient)) or dr.size_v(type(gradient)) != 3:
            raise TypeError(
                f"{name}: Sample.gradient is {describe_type(gradient)}, no 3-vector: {_SAMPLE_HELP}"
            )
        # Derivatives of the value that do not come from p would be lost.
        # (An evaluator does not know; its field does.)
        traits = getattr(self, "traits", None)
        keeps_derivatives = traits is None or traits.has_parameter_derivatives
        if not keeps_derivatives and not dr.grad_enabled(p):
            check_no_derivatives(type(self).__name__, sample.value)
        return _unbox_numpy(sample).map_promises(_unbox_numpy)

    return checked


def _unbox_numpy(record: _R) -> _R:
    """The sample or promise `record`, with attributes that are NumPy scalars turned into Python
    numbers, because Dr.Jit takes no NumPy scalars."""
    scalars: dict[str, Any] = {
        key: value.item() for key, value in vars(record).items() if isinstance(value, np.generic)
    }
    return dataclasses.replace(record, **scalars) if scalars else record


def describe_type(value: Any) -> str:
    """The type of a value in words, for error messages: "nothing" for None."""
    return "nothing" if value is None else f"an object of type {type(value).__name__}"


def space_scaled(sample: Sample, size: Real) -> Sample:
    """The sample of the scaled function g(x) = f(x / size) at the point size * p, from the sample
    of f at p.

    The value stays the same. Radii of balls are multiplied by the size. Gradients and Lipschitz
    constants are divided by it. Bounds of second derivatives and of Laplacians are divided by its
    square.
    """
    return sample.map_promises(
        lambda promise: promise.space_scaled(size),
        gradient=sample.gradient / size,
        gradient_error=sample.gradient_error / size,
        ray_promises=tuple(promise.space_scaled(size) for promise in sample.ray_promises),
    )


def value_error_bound(sample: Sample, gradient_norm: Real, size: Real) -> Real:
    """A bound of the whole error of a sample's value: truncation, rounding, and the change of f by
    the rounding of the point p.

    gradient_norm: the length of the sample's gradient.
    size: a bound of the absolute values of the coordinates of p.
    """
    kind = cast("Any", type(sample.value))
    epsilon = 2 * float(dr.epsilon(kind))
    # The rounding of eight units in the last place, which `Sample.value_error` leaves out: at most
    # 8 machine epsilons (each is twice Dr.Jit's epsilon) of the value. Numbers below the smallest
    # normal one may underflow to 0.
    smallest = kind(float(dr.smallest(kind)))
    value = 8 * fmax(epsilon * dr.abs(sample.value), smallest)
    # The rounding of p moves it by at most 4 epsilon times size.
    return dr.fma(gradient_norm, 4 * epsilon * size, value + sample.value_error)


@dataclass(frozen=True)
class RaySample:
    """A sample of f at the point x(t) = o + t d of a ray, with enclosures in both directions:
    functions of a length s >= 0 along the ray, whose values are intervals that are proved to hold
    the change of f.

    sample: the sample at x(t).
    forward: enclosures of f(x(t + s)) - f(x(t)), the change in front of the point.
    backward: enclosures of f(x(t - s)) - f(x(t)), the change behind the point, from the same
        evaluation.
    slope: the derivative of f along the ray at x(t), with an error of at most `slope_error_bound`.
    reach_growth: the length up to which the next sample should compute its enclosures, as a
        multiple of the step that this sample proves.
    slope_error: a bound of the error of `slope` that is smaller than `Sample.gradient_error`; None
        if no such bound is known. (On a crease of f the gradient is a range, but the derivative
        along a ray that runs in the crease may be a single number.)
    min_gradient_norm: a lower bound of |grad f|. On a crease, for example, it may be larger than
        the bound that every sample gives, |gradient| minus `Sample.gradient_error`. None if no
        other bound is known.
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
        whole gradient."""
        return self.sample.gradient_error if self.slope_error is None else self.slope_error


@dataclass(frozen=True)
class Ray:
    """Rays o + t d with |d| = 1, one in each lane, and the kinds of enclosures by which steps on
    them are proved. An enclosure is an interval, as a function of the length along the ray, that is
    proved to hold the change of f.

    origin, direction: (3,) o and d.
    proofs: the classes of enclosures to use.
    """

    origin: Vec3
    direction: Vec3
    proofs: EnclosureKinds

    def point(self, t: Real) -> Vec3:
        """The points o + t d of the rays."""
        return dr.fma(type(self.origin)(t), self.direction, self.origin)

    def enclose(self, sample: Sample) -> RaySample:
        """The ray sample that follows from a sample at a point of the ray. Its enclosures, in front
        of the point and behind it, are of the kinds in `proofs`. They follow from the sample's
        promises (proved bounds of f near the point) and from the slope of f along the ray.

        The gradient has an error. So the slope enters the proofs as an interval.
        """
        slope = dr.dot(sample.gradient, self.direction)
        slopes = SlopeRange.around(slope, sample.gradient_error)
        arguments = sample.promises, sample.alternative_promises, sample.value, sample.value_error
        ahead, back = (
            self.proofs.from_promises(*arguments, interval, sample.ray_promises)
            # Looking back, f is followed along -direction, so the slope has the other sign.
            for interval in (slopes, slopes.negated())
        )
        return RaySample(sample, ahead, back, slope)
