"""Activation functions of neural networks: their values, slopes and ranges of second derivatives.

An activation function is a sum a(z) = g(z) + k max(z, 0). g has a second derivative almost
everywhere, and is the integral of it; k is the jump of the slope at z = 0, the kink.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import clamp, fmax, fmin, sincos
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import FloatArray, Real

__all__ = ["ACTIVATIONS", "Activation", "ActivationPoint", "activation_of"]


@dataclass(frozen=True)
class ActivationPoint:
    """An activation function at a point z.

    value, slope: a(z), and its slope there. At a kink it is that of the left.
    value_error, slope_error: bounds of the rounding errors of the two numbers.
    """

    value: Real
    slope: Real
    value_error: Real
    slope_error: Real


@dataclass(frozen=True)
class Activation(abc.ABC):
    """An activation function a(z).

    parameter: its number: 0 if it has none.
    """

    parameter: float = 0.0

    name = ""
    parameter_name = ""

    def kink(self, parameter: Real) -> Real:
        """The jump k of the slope at z = 0. parameter: `parameter`, as a number or on the
        device."""
        del parameter
        return 0.0

    @property
    @abc.abstractmethod
    def max_slope(self) -> float:
        """A bound of |a(z) - a(y)|/|z - y|."""

    @abc.abstractmethod
    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        """The function at z. parameter: `parameter` on the device."""

    def second(self, z: Real, parameter: Real) -> Real:
        """The second derivative of the part g at z. parameter: `parameter` on the device. The
        default is that of a part g that is 0."""
        del parameter
        return 0 * z

    @abc.abstractmethod
    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        """Bounds of the second derivative of the part g, from z - below to z + above.

        below, above: lengths >= 0.
        """

    @abc.abstractmethod
    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The values and the slopes at numbers z of any shape, in double precision."""

    @abc.abstractmethod
    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Bounds of the absolute second derivative of the part g on intervals, in double
        precision."""

    @classmethod
    def checked(cls, parameter: float | None) -> Self:
        """The function with this parameter; None for the usual one.

        Raises:
            ValueError: a number that is not positive and finite, or for a function without one.
        """
        if parameter is None:
            return cls()
        if not cls.parameter_name:
            raise ValueError(
                f"the activation {cls.name} has no parameter, and was given {parameter}"
            )
        number = float(parameter)
        if not (math.isfinite(number) and number > 0):
            raise ValueError(
                f"{cls.parameter_name} of the activation {cls.name} must be a positive number, not "
                f"{parameter!r}"
            )
        return cls(number)


@dataclass(frozen=True)
class ReLU(Activation):
    """max(z, 0): g = 0, and a kink of 1."""

    name = "relu"

    def kink(self, parameter: Real) -> Real:
        del parameter
        return 1.0

    @property
    def max_slope(self) -> float:
        return 1.0

    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        del parameter
        return ActivationPoint(fmax(z, 0), dr.select(z > 0, type(z)(1), 0), type(z)(0), type(z)(0))

    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        del below, above, parameter
        return type(z)(0), type(z)(0)

    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.maximum(z, 0.0), (z > 0).astype(np.float64)

    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        del upper
        return np.zeros_like(lower)


@dataclass(frozen=True)
class Tanh(Activation):
    """tanh z. With w = exp(-2|z|) it is (1 - w)/(1 + w) up to the sign, its slope is 4 w/(1 + w)^2,
    and its second derivative is -2 tanh z times the slope, which is largest and smallest at z =
    -+0.6585, where it is +-4/(3 sqrt 3).

    Errors. w has a relative error of 2u (8 + 2|z|) (`arithmetic.functions`), and |z| exp(-2|z|) <=
    0.19, so that its absolute error is at most 17u. Value and slope change by at most twice, and
    four times, that of w.
    """

    name = "tanh"

    @property
    def max_slope(self) -> float:
        return 1.0

    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        del parameter
        unit = float(dr.epsilon(type(z)))
        value, slope = _tanh(z)
        return ActivationPoint(value, slope, 0 * z + 40 * unit, 0 * z + 80 * unit)

    def second(self, z: Real, parameter: Real) -> Real:
        del parameter
        value, slope = _tanh(z)
        return -2 * value * slope

    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        del parameter
        lower, upper = z - below, z + above
        (t0, s0), (t1, s1) = _tanh(lower), _tanh(upper)
        a, b = -2 * t0 * s0, -2 * t1 * s1
        # The errors of value and slope, and the rounding of the ends.
        slack = 512 * float(dr.epsilon(type(z)))
        low, high = fmin(a, b) - slack, fmax(a, b) + slack
        holds = (lower <= _TANH_TURN) & (upper >= _TANH_TURN)
        low = dr.select(holds, -_TANH_SECOND, low)
        holds = (lower <= -_TANH_TURN) & (upper >= -_TANH_TURN)
        return low, dr.select(holds, _TANH_SECOND, high)

    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        value = np.tanh(z)
        return value, 1 - value * value

    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        ends = np.maximum(*(2 * np.abs(t) * (1 - t * t) for t in (np.tanh(lower), np.tanh(upper))))
        holds = [(lower <= turn) & (upper >= turn) for turn in (-_TANH_TURN, _TANH_TURN)]
        return np.where(holds[0] | holds[1], _TANH_SECOND, ends + 1e-14)


# Where the second derivative of tanh is largest, and a bound of it.
_TANH_TURN, _TANH_SECOND = 0.65847895, 0.7698004


def _tanh(z: Real) -> tuple[Real, Real]:
    """tanh z and its slope."""
    w = dr.exp(-2 * dr.abs(z))
    inverse = 1 / (1 + w)
    value = (1 - w) * inverse
    return dr.select(z < 0, -value, value), 4 * w * inverse * inverse


@dataclass(frozen=True)
class Softplus(Activation):
    """log(1 + exp(b z))/b with the parameter b. With w = exp(-b|z|) it is max(z, 0) + log(1 + w)/b;
    its slope is 1/(1 + w) or w/(1 + w), and its second derivative b w/(1 + w)^2 falls with |z|.

    Errors. w has an absolute error of at most 18u, as |y| exp(-|y|) <= 0.37 for y = b z. log(1 + w)
    changes by at most as much, 1 + w is rounded, and the logarithm has an error of 8u near 1, and
    16u of its value.
    """

    parameter: float = 1.0

    name = "softplus"
    parameter_name = "beta"

    @property
    def max_slope(self) -> float:
        return 1.0

    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        unit = float(dr.epsilon(type(z)))
        w = dr.exp(-dr.abs(parameter * z))
        inverse = 1 / (1 + w)
        value = fmax(z, 0) + dr.log(1 + w) / parameter
        error = unit * (60 / parameter + 2 * dr.abs(value))
        slope = dr.select(z < 0, w * inverse, inverse)
        return ActivationPoint(value, slope, error, 0 * z + 40 * unit)

    def second(self, z: Real, parameter: Real) -> Real:
        w = dr.exp(-dr.abs(parameter * z))
        inverse = 1 / (1 + w)
        return parameter * w * inverse * inverse

    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        lower, upper = z - below, z + above
        nearest = dr.select((lower <= 0) & (upper >= 0), 0, fmin(dr.abs(lower), dr.abs(upper)))
        farthest = fmax(dr.abs(lower), dr.abs(upper))
        slack = 256 * float(dr.epsilon(type(z)))

        def second(y: Real) -> Real:
            w = dr.exp(-parameter * y)
            inverse = 1 / (1 + w)
            return w * inverse * inverse

        low, high = fmax(second(farthest) - slack, 0), fmin(second(nearest) + slack, 0.25)
        return parameter * low, parameter * (high * (1 + slack))

    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        w = np.exp(-np.abs(self.parameter * z))
        value = np.maximum(z, 0) + np.log1p(w) / self.parameter
        return value, np.where(z < 0, w, 1.0) / (1 + w)

    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        nearest = np.maximum(np.maximum(lower, -upper), 0.0)
        w = np.exp(-self.parameter * nearest)
        return self.parameter * (w / (1 + w) ** 2 + 1e-14)


@dataclass(frozen=True)
class ELU(Activation):
    """z for z > 0, and c (exp z - 1) for z <= 0, with the parameter c: a kink of 1 - c, and a part
    g = c z or c (exp z - 1), whose second derivative is 0 or c exp z.

    Errors. exp z has an absolute error of at most 17u for z <= 0.
    """

    parameter: float = 1.0

    name = "elu"
    parameter_name = "alpha"

    def kink(self, parameter: Real) -> Real:
        return 1.0 - parameter

    @property
    def max_slope(self) -> float:
        return max(1.0, self.parameter)

    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        unit = float(dr.epsilon(type(z)))
        is_left = z <= 0
        e = dr.exp(fmin(z, 0))
        value = dr.select(is_left, parameter * (e - 1), z)
        error = dr.select(is_left, 24 * unit * parameter, 0)
        return ActivationPoint(value, dr.select(is_left, parameter * e, 1), error, error)

    def second(self, z: Real, parameter: Real) -> Real:
        return dr.select(z <= 0, parameter * dr.exp(fmin(z, 0)), 0)

    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        lower, upper = z - below, z + above
        slack = 64 * float(dr.epsilon(type(z)))
        low = dr.select(upper >= 0, 0, fmax(dr.exp(fmin(lower, 0)) - slack, 0))
        high = dr.select(lower > 0, 0, fmin(dr.exp(fmin(upper, 0)) + slack, 1))
        return parameter * low * (1 - slack), parameter * high * (1 + slack)

    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        e = self.parameter * np.exp(np.minimum(z, 0))
        return np.where(z > 0, z, e - self.parameter), np.where(z > 0, 1.0, e)

    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        high = self.parameter * np.exp(np.minimum(upper, 0)) * (1 + 1e-14)
        return np.where(lower > 0, 0.0, high)


@dataclass(frozen=True)
class Sine(Activation):
    """sin(w z) with the parameter w.

    Errors. The angle w z is rounded, by u |w z|, and a sine or cosine has an error of 2u
    (`backend.elementary.sincos`). The second derivative -w^2 sin(w z) changes by at most w^2 times
    the change of the angle.
    """

    parameter: float = 30.0

    name = "sine"
    parameter_name = "w0"

    @property
    def max_slope(self) -> float:
        return self.parameter

    def at(self, z: Real, parameter: Real) -> ActivationPoint:
        unit = float(dr.epsilon(type(z)))
        angle = parameter * z
        sine, cosine = sincos(angle)
        error = unit * (4 + 2 * dr.abs(angle))
        return ActivationPoint(sine, parameter * cosine, error, parameter * (error + 2 * unit))

    def second(self, z: Real, parameter: Real) -> Real:
        return -parameter * parameter * sincos(parameter * z)[0]

    def second_range(self, z: Real, below: Real, above: Real, parameter: Real) -> tuple[Real, Real]:
        unit = float(dr.epsilon(type(z)))
        angle = parameter * z
        sine, _ = sincos(angle)
        change = parameter * fmax(below, above) * (1 + 8 * unit) + unit * (8 + 4 * dr.abs(angle))
        square = parameter * parameter * (1 + 4 * unit)
        return square * clamp(-sine - change, -1, 1), square * clamp(-sine + change, -1, 1)

    def on_numpy(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        angle = self.parameter * z
        return np.sin(angle), self.parameter * np.cos(angle)

    def second_bound(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        middle, half = (
            0.5 * self.parameter * (lower + upper),
            0.5 * self.parameter * (upper - lower),
        )
        size = np.abs(np.sin(middle)) + half + 1e-12 * (1 + np.abs(middle))
        return self.parameter**2 * np.minimum(size, 1.0)


ACTIVATIONS: dict[str, type[Activation]] = {
    kind.name: kind for kind in (ReLU, Tanh, Softplus, ELU, Sine)
}


def activation_of(choice: Any) -> Activation:
    """The activation function of a user's choice: a name, or a pair of a name and a parameter.

    Raises:
        ValueError: another name, or a wrong parameter.
        TypeError: anything else.
    """
    if isinstance(choice, Activation):
        return choice
    name: Any = choice
    parameter: Any = None
    if isinstance(choice, tuple) and len(cast("tuple[Any, ...]", choice)) == 2:
        name, parameter = cast("tuple[Any, Any]", choice)
    if not isinstance(name, str):
        raise TypeError(
            f'an activation is a name such as "relu", or a pair such as ("sine", 30.0), not '
            f"{choice!r}"
        )
    if name not in ACTIVATIONS:
        raise ValueError(
            f"activation must be one of {', '.join(ACTIVATIONS)}, not {name!r}"
            f"{did_you_mean(name, ACTIVATIONS)}"
        )
    return ACTIVATIONS[name].checked(parameter)
