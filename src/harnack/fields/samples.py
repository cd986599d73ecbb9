"""What a field returns: a `Sample` at a point, or a `Look`, a sample with enclosures."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import fmax
from harnack.backend.validation import refuse_derivatives
from harnack.enclosures import Enclosure, Lipschitz, Promise, Proofs, Slopes

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Mask, Real, Vec3


@dataclass(frozen=True)
class Sample:
    """One evaluation at a point p.

    value: f(p).
    gradient: (3,) of f at p.
    known: promises that hold near p.
    error: a bound of the error of `value` by an approximation, and by rounding as far as that is
        more than eight units in its last place or eight times the smallest normal number (and more
        than |gradient| times the rounding of the point itself, which the tracer adds). Steps are
        shortened by it.
    gradient_error: a bound of the error of `gradient` by rounding and an approximation, as a
        length; 0 where it is only the rounding of a few operations.
    normal: (3,) unit normal to shade with, where the gradient is of no use (near a singular point
        of the surface); None for the gradient's own direction. Steps do not depend on it.
    truncation: the part of `error` that an evaluation at more detail reduces (`Field.at_detail`).
    weaker: promises that are as true as `known`, but proved shorter steps wherever that was
        measured. Only a bound that is asked for by name uses them.
    along: more promises, which hold only for points of the path of a `Field.look`.
    is_modulo: where f is known but for a whole number (`Sheets.is_modulo`); None for nowhere.
    """

    value: Real
    gradient: Vec3
    known: tuple[Promise, ...]
    error: Real = 0.0
    gradient_error: Real = 0.0
    normal: Vec3 | None = None
    truncation: Real = 0.0
    weaker: tuple[Promise, ...] = ()
    along: tuple[Lipschitz, ...] = ()
    is_modulo: Mask | None = None

    @property
    def promises(self) -> tuple[Promise, ...]:
        """All promises, the weaker ones last."""
        return self.known + self.weaker

    def with_promises(self, change: Callable[[Promise], Promise], **numbers: Any) -> Sample:
        """The sample with each promise changed, and with other attributes replaced."""
        known, weaker = (tuple(map(change, group)) for group in (self.known, self.weaker))
        return dataclasses.replace(self, known=known, weaker=weaker, **numbers)

    def shifted(self, offset: Real) -> Sample:
        """The sample of f + offset, a number that adds no error."""
        return self.with_promises(lambda one: one.shifted(offset), value=self.value + offset)

    def where(self, mask: Mask, other: Sample) -> Sample:
        """The other sample, with promises of the same kinds, where the mask holds, this one
        elsewhere. Without normals."""
        names = "value", "gradient", "error", "gradient_error", "truncation"
        numbers = {k: dr.select(mask, getattr(other, k), getattr(self, k)) for k in names}
        groups: dict[str, Any] = {}
        for k in ("known", "weaker", "along"):
            pairs = zip(getattr(self, k), getattr(other, k), strict=True)
            groups[k] = tuple(own.where(mask, one) for own, one in pairs)
        return dataclasses.replace(self, normal=None, **numbers, **groups)


_R = TypeVar("_R", bound=Sample | Promise)
_HOW = (
    "return harnack.Sample(value, gradient, known), with a Dr.Jit number, a Dr.Jit 3-vector and a "
    "tuple of promises, such as (harnack.Lipschitz(1.0),) if |grad f| <= 1"
)


def checked_samples(
    evaluate: Callable[[Any, Vec3], Sample],
) -> Callable[[Any, Vec3], Sample]:
    """The method `evaluate` of a field, which raises TypeError if it returns anything but a proper
    `Sample`, and NotImplementedError if the value has derivatives that the field would drop."""

    @functools.wraps(evaluate)
    def checked(self: Any, p: Vec3) -> Sample:
        sample: Any = evaluate(self, p)
        name = f"{type(self).__name__}.evaluate"
        if not isinstance(sample, Sample):
            raise TypeError(f"{name} returned {_named(sample)}, not a Sample: {_HOW}")
        given: Any
        for place, given in (("known", sample.known), ("weaker", sample.weaker)):
            if not isinstance(given, tuple):
                raise TypeError(f"{name}: Sample.{place} is {_named(given)}, not a tuple: {_HOW}")
            for one in cast("tuple[Any, ...]", given):
                if not isinstance(one, Promise):
                    wrong = f"Sample.{place} holds {_named(one)}, no promise"
                    raise TypeError(f"{name}: {wrong}: {_HOW}")
        gradient: Any = sample.gradient
        if not dr.is_array_v(type(gradient)) or dr.size_v(type(gradient)) != 3:
            raise TypeError(f"{name}: Sample.gradient is {_named(gradient)}, no 3-vector: {_HOW}")
        if self.drops_derivatives() and not dr.grad_enabled(p):
            refuse_derivatives(type(self).__name__, sample.value)
        return _plain(sample).with_promises(_plain)

    return checked


def _plain(record: _R) -> _R:
    """A record whose scalars of NumPy are Python's: Dr.Jit takes no others."""
    scalars: dict[str, Any] = {
        key: one.item() for key, one in vars(record).items() if isinstance(one, np.generic)
    }
    return dataclasses.replace(record, **scalars) if scalars else record


def _named(value: Any) -> str:
    return "nothing" if value is None else f"an object of type {type(value).__name__}"


def lengthened(sample: Sample, size: Real) -> Sample:
    """Convert a sample of f at p to one of x -> f(x / size) at size * p.

    Values stay; radii are multiplied by the size, gradients and Lipschitz constants divided by it,
    curvatures and Laplacians by its square.
    """
    return sample.with_promises(
        lambda one: one.lengthened(size),
        gradient=sample.gradient / size,
        gradient_error=sample.gradient_error / size,
        along=tuple(one.lengthened(size) for one in sample.along),
    )


def value_error(sample: Sample, gradient_norm: Real, size: Real) -> Real:
    """A bound of the error of f by rounding and truncation, at a point whose coordinates are at
    most `size`; gradient_norm: |gradient|."""
    kind = cast("Any", type(sample.value))
    epsilon = 2 * float(dr.epsilon(kind))
    # Numbers below the smallest normal one may underflow to 0.
    smallest = kind(float(dr.smallest(kind)))
    value = 8 * fmax(epsilon * dr.abs(sample.value), smallest)
    return dr.fma(gradient_norm, 4 * epsilon * size, value + sample.error)


@dataclass(frozen=True)
class Look:
    """A sample at a point of a path, and what is proved along the path in both directions.

    ahead: enclosures of f(path(t+s)) - f(path(t)).
    back: enclosures of f(path(t-s)) - f(path(t)), from the same evaluation.
    slope: the derivative of f along the path, known up to `slope_error`.
    growth: how far the enclosures of the next look should reach, as a multiple of the step that
        this one proves.
    slope_error: a bound of the error of `slope`, where one is known that is less than
        `Sample.gradient_error`: on a crease the gradient is a range, and the derivative along a ray
        that runs in the crease may still be a number. Else None.
    least_gradient: a lower bound of |grad f|, where one is known that may be more than |gradient|
        less `Sample.gradient_error`, as on a crease. Else None.
    """

    sample: Sample
    ahead: tuple[Enclosure, ...]
    back: tuple[Enclosure, ...]
    slope: Real
    growth: float = 2.0
    slope_error: Real | None = None
    least_gradient: Real | None = None

    @property
    def slope_doubt(self) -> Real:
        """The bound of the error of `slope`."""
        return self.sample.gradient_error if self.slope_error is None else self.slope_error


@dataclass(frozen=True)
class Path:
    """The rays o + t d, |d| = 1, along which a field is sampled, and the proofs to use."""

    origin: Vec3
    direction: Vec3
    proofs: Proofs

    def point(self, t: Real) -> Vec3:
        """The points at parameters t."""
        return dr.fma(type(self.origin)(t), self.direction, self.origin)

    def look(self, sample: Sample) -> Look:
        """What the promises of a sample prove along the path, with the slope of f along it.

        A slope known up to an error enters as an interval: see `Enclosure`.
        """
        slope = dr.dot(sample.gradient, self.direction)
        slopes = Slopes.around(slope, sample.gradient_error)
        given = sample.known, sample.weaker, sample.value, sample.error
        ahead, back = (
            self.proofs.enclose(*given, one, sample.along) for one in (slopes, slopes.negated())
        )
        return Look(sample, ahead, back, slope)
