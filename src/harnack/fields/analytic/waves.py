"""Sums of sine waves: their terms, values and gradients, and proved bounds of the sum. A term is
either a plane wave A cos(k . p + phase) with a wave vector k, or a product of sines and cosines of
single coordinates, called its factors. A factor is the sine or cosine of frequency * coordinate +
phase. Every product is also a sum of plane waves. Terms are evaluated as the user wrote them,
because a product needs only one sine and one cosine for each coordinate; they are bounded as sums
of plane waves."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.elementary import sincos
from harnack.backend.validation import (
    as_finite,
    as_real,
    as_triple,
    check_no_derivatives,
    has_derivatives,
)

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

__all__ = [
    "PlaneWave",
    "Term",
    "WaveBounds",
    "WaveFactor",
    "WaveProduct",
    "cosine_factor",
    "sine_factor",
]


@dataclass(frozen=True)
class WaveFactor:
    """The function sin(frequency * t + phase), or cos if `is_cosine`, of a single coordinate t, as
    a factor of a product of waves.

    frequency: in radians per unit length, not 0.
    phase: in radians.

    Raises:
        TypeError, ValueError: a number is not finite, or the frequency is 0.
    """

    frequency: float
    phase: float
    is_cosine: bool
    keeps_derivatives: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the numbers, and convert those without derivatives to Python floats."""
        for name in ("frequency", "phase"):
            object.__setattr__(
                self, name, _checked_number(getattr(self, name), f"the {name} of a factor")
            )
        if as_real(self.frequency, "the frequency") == 0:
            raise ValueError("a factor of frequency 0 is a constant: multiply the amplitude by it")


def _checked_number(value: Any, name: str) -> Any:
    """A finite number as a Python float; a Dr.Jit number with derivatives as it is.

    Raises:
        TypeError, ValueError: it is no finite number.
        NotImplementedError: it is a number of another library with derivatives.
    """
    number = as_finite(value, name)
    if dr.is_array_v(cast("Any", type(value))) and has_derivatives(value):
        return value
    check_no_derivatives(name, value)
    return number


def sine_factor(frequency: float = 1.0, phase: float = 0.0) -> WaveFactor:
    """The factor sin(frequency * coordinate + phase) of a product of waves. frequency is in radians
    per unit length, phase in radians."""
    return WaveFactor(frequency, phase, False)


def cosine_factor(frequency: float = 1.0, phase: float = 0.0) -> WaveFactor:
    """The factor cos(frequency * coordinate + phase) of a product of waves. frequency is in radians
    per unit length, phase in radians."""
    return WaveFactor(frequency, phase, True)


@dataclass(frozen=True)
class WaveProduct:
    """A product of waves: the amplitude times the factors of x, y and z, each a sine or cosine of
    that coordinate. None stands for no factor.

    WaveProduct(2.0, x=sine_factor(3.0), y=cosine_factor(4.0)) is 2 sin(3x) cos(4y), an
    eigenfunction of the Laplacian with eigenvalue -(9 + 16).
    """

    amplitude: float
    x: WaveFactor | None = None
    y: WaveFactor | None = None
    z: WaveFactor | None = None
    keeps_derivatives: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the amplitude and the factors."""
        _checked_number(self.amplitude, "the amplitude of a product")
        for name in "xyz":
            factor = getattr(self, name)
            if factor is not None and not isinstance(factor, WaveFactor):
                raise TypeError(
                    f"{name} of a product is made by sine or cosine, not {factor!r:.60}"
                )

    @property
    def factors(self) -> tuple[tuple[int, WaveFactor], ...]:
        """The pairs (axis, factor) for the coordinates that have a factor; the axis is 0, 1 or 2
        for x, y or z."""
        named = enumerate((self.x, self.y, self.z))
        return tuple((axis, factor) for axis, factor in named if factor is not None)


@dataclass(frozen=True)
class PlaneWave:
    """The plane wave amplitude * cos(wave_vector . p + phase). Its Laplacian is -|wave_vector|^2
    times itself."""

    amplitude: float
    wave_vector: tuple[float, float, float]
    phase: float = 0.0
    keeps_derivatives: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the numbers, and convert the wave vector to a tuple of three floats, unless it has
        derivatives."""
        _checked_number(self.amplitude, "the amplitude of a plane wave")
        _checked_number(self.phase, "the phase of a plane wave")
        vector: Any = as_triple(self.wave_vector, "the wave vector")
        if dr.is_array_v(cast("Any", type(self.wave_vector))):
            vector = self.wave_vector if has_derivatives(self.wave_vector) else vector
        else:
            vector = tuple(_checked_number(k, "the wave vector") for k in self.wave_vector)
        object.__setattr__(self, "wave_vector", vector)


Term = WaveProduct | PlaneWave
TermType = TypeVar("TermType", bound=WaveProduct | PlaneWave | WaveFactor)


def with_numbers(
    term: TermType, number: Callable[[Any], Any], triple: Callable[[Any], tuple[Any, Any, Any]]
) -> TermType:
    """A copy of a term with the function `number` of each of its numbers in place of these, and
    the function `triple` of its wave vector."""
    other = copy.copy(term)
    for name in ("amplitude", "frequency", "phase"):
        if hasattr(term, name):
            object.__setattr__(other, name, number(getattr(term, name)))
    if isinstance(term, PlaneWave):
        object.__setattr__(other, "wave_vector", triple(term.wave_vector))
    if isinstance(term, WaveProduct):
        for axis, factor in term.factors:
            object.__setattr__(other, "xyz"[axis], with_numbers(factor, number, triple))
    return other


def checked_terms(terms: Iterable[Term]) -> tuple[Term, ...]:
    """The terms as a tuple, checked, and with Python floats in place of all numbers.

    Raises:
        ValueError, TypeError: there is no term, or a term is invalid; the message names the first
            invalid term.
    """
    listed = tuple(terms)
    if not listed:
        raise ValueError("a sum needs at least one term")
    for n, term in enumerate(listed):
        if not isinstance(term, WaveProduct | PlaneWave):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"term {n} must be a Product or a PlaneWave, not {term!r}")
    return tuple(
        with_numbers(
            term,
            lambda value: as_real(value, "a number of a term"),
            lambda value: as_triple(value, "the wave vector"),
        )
        for term in listed
    )


class _FactorEvaluator:
    """A function that evaluates factors of products (sines and cosines of one coordinate) and their
    derivatives at a point p. Each sine and cosine is computed once, even if several factors have
    the same angle."""

    def __init__(self, p: Vec3) -> None:
        self._p = p
        self._sincos: dict[Any, tuple[Real, Real]] = {}

    def __call__(self, axis: int, factor: WaveFactor) -> tuple[Real, Real]:
        """Return the values at p of a factor and of its derivative by its coordinate.

        axis: the index of the coordinate.
        """
        numbers = (factor.frequency, factor.phase)
        key = (axis, *(n if isinstance(n, float) else id(n) for n in numbers))
        if key not in self._sincos:
            self._sincos[key] = sincos(_angle(factor.frequency * self._p[axis], factor.phase))
        sine, cosine = self._sincos[key]
        return (
            (cosine, -factor.frequency * sine)
            if factor.is_cosine
            else (sine, factor.frequency * cosine)
        )


def evaluate_terms(terms: Sequence[Term], p: Vec3) -> tuple[Real, list[Real]]:
    """Return the value of the sum of the terms at p, a Dr.Jit vector, and the three components of
    its gradient."""
    evaluate_factor = _FactorEvaluator(p)
    value, gradient = p[0] * 0.0, [p[0] * 0.0 for _ in range(3)]
    for term in terms:
        if isinstance(term, PlaneWave):
            k = term.wave_vector
            angle = _angle(k[0] * p[0] + k[1] * p[1] + k[2] * p[2], term.phase)
            sine, cosine = sincos(angle)
            value += term.amplitude * cosine
            for axis in range(3):
                if not _is_number(k[axis], 0):
                    gradient[axis] -= term.amplitude * k[axis] * sine
            continue
        # (axis, value, derivative) of each factor of a product.
        values = [(axis, *evaluate_factor(axis, factor)) for axis, factor in term.factors]
        value += _product([f for _, f, _ in values], term.amplitude)
        for axis, _, derivative in values:
            # The derivative along an axis: all other factors stay as they are.
            factors = [f for factor_axis, f, _ in values if factor_axis != axis]
            gradient[axis] += _product([*factors, derivative], term.amplitude)
    return value, gradient


def hessian_of_terms(terms: Sequence[Term], p: Vec3) -> list[list[Real]]:
    """The matrix of second derivatives of the sum of the terms at p, as three rows of three.

    For a plane wave with wave vector k it is -k k^T times the wave. For a product, differentiating
    twice along one axis multiplies it by -frequency^2; differentiating along two axes replaces the
    factor of each of them by its derivative.
    """
    evaluate_factor = _FactorEvaluator(p)
    upper = {(i, j): p[0] * 0.0 for i in range(3) for j in range(i, 3)}
    for term in terms:
        if isinstance(term, PlaneWave):
            k = term.wave_vector
            angle = _angle(k[0] * p[0] + k[1] * p[1] + k[2] * p[2], term.phase)
            wave = term.amplitude * sincos(angle)[1]  # times the cosine
            for i, j in upper:
                if not (_is_number(k[i], 0) or _is_number(k[j], 0)):
                    upper[i, j] -= k[i] * k[j] * wave
            continue
        frequency = {axis: factor.frequency for axis, factor in term.factors}
        value_and_derivative = {
            axis: evaluate_factor(axis, factor) for axis, factor in term.factors
        }
        for i, j in upper:
            if i in value_and_derivative and j in value_and_derivative:
                # How often each axis is differentiated: once takes the derivative, twice the value
                # again.
                order = {axis: (axis == i) + (axis == j) for axis in value_and_derivative}
                factors = [
                    value_and_derivative[axis][1 if n == 1 else 0] for axis, n in order.items()
                ]
                product = _product(factors, term.amplitude)
                upper[i, j] += -(frequency[i] ** 2) * product if i == j else product
    return [[upper[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]


def _angle(angle: Real, phase: float) -> Real:
    """angle + phase; without the addition if the phase is 0, which saves an operation and its
    rounding."""
    return angle if _is_number(phase, 0) else angle + phase


def _product(factors: Sequence[Real], amplitude: float) -> Real:
    """The product of the amplitude and all factors. A multiplication by 1 is left out, which saves
    an operation and its rounding."""
    product: Real = None
    for factor in factors:
        product = factor if product is None else product * factor
    if product is None:
        return amplitude
    return product if _is_number(amplitude, 1) else amplitude * product


def _is_number(value: Any, number: float) -> bool:
    """Whether a value is a Python number, and this one. (A number on a backend is not known.)"""
    return isinstance(value, float | int) and value == number


@dataclass(frozen=True)
class WaveBounds:
    """Proved bounds of a sum of plane waves f = constant + sum_i A_i cos(k_i . p + phase_i), A_i >
    0, with wave vectors k_i, and of its derivatives.

    wavenumbers: the |k_i|.
    amplitudes: the A_i, in the same order.
    constant: the constant term of f.
    largest_value: bounds |f - constant|; it is sum A_i.
    largest_gradient: bounds |grad f|. For a unit vector v, |v . grad f| <= sum A_i |k_i . v|, which
        is at most sum A_i |k_i| and, by Cauchy-Schwarz, at most sqrt(sum A_i) sqrt(sum A_i (k_i .
        v)^2).
    largest_curvature: bounds |v . H v| for unit vectors v and the Hessian H. It is the largest
        eigenvalue of the matrix sum A_i k_i k_i^T, as |v . H v| <= sum A_i (k_i . v)^2.
    max_third_derivative: bounds the absolute third derivative along v, which is at most sum A_i
        |k_i . v|^3. It is the largest |k_i| times largest_curvature.

    For the gyroid's three terms these bounds are 3, sqrt 6, 2 and 2 sqrt 2; the true largest values
    are 3/2, sqrt 3, 2, and at most 2.31.
    """

    wavenumbers: tuple[float, ...]
    amplitudes: tuple[float, ...]
    constant: float
    largest_value: float
    largest_gradient: float
    largest_curvature: float
    max_third_derivative: float

    @classmethod
    def of(cls, terms: Iterable[Term]) -> WaveBounds:
        """Compute the bounds of the sum of the terms. The terms are written as plane waves, and
        waves with equal wave vectors are added first.

        Raises:
            ValueError: the sum is constant.
        """
        waves: dict[tuple[float, ...], complex] = {}
        for term in terms:
            for k, amplitude in _plane_waves(term):
                waves[k] = waves.get(k, 0.0) + amplitude
        constant = waves.pop((0.0, 0.0, 0.0), 0j).real
        waves = {k: amplitude for k, amplitude in waves.items() if amplitude != 0}
        if not waves:
            raise ValueError("the sum is constant: it has no level sets")
        wave_vectors = np.array(list(waves))
        absolute_amplitudes = np.abs(np.array(list(waves.values())))
        # All sums below have positive terms: a few roundings, covered by this factor.
        margin = 1.0 + 1e-12
        matrix: npt.NDArray[np.float64] = np.einsum(
            "n,ni,nj->ij", absolute_amplitudes, wave_vectors, wave_vectors
        )
        curvature = float(np.linalg.eigvalsh(matrix)[-1]) * margin
        lengths = np.linalg.norm(wave_vectors, axis=1)
        value = float(absolute_amplitudes.sum()) * margin
        # The second bound: by Cauchy-Schwarz, (sum A_i |k_i . v|)^2 is at most sum A_i times sum
        # A_i (k_i . v)^2.
        gradient = min(float(absolute_amplitudes @ lengths) * margin, math.sqrt(value * curvature))
        # The last one bounds third derivatives: their terms are those of second derivatives, each
        # times at most the largest |k_i|.
        return cls(
            tuple(float(v) for v in lengths),
            tuple(float(v) for v in absolute_amplitudes),
            constant,
            value,
            gradient,
            curvature,
            float(lengths.max()) * margin * curvature,
        )


def mean_wavelength(amplitudes: npt.ArrayLike, wavenumbers: npt.ArrayLike) -> float:
    """A typical wavelength of a sum of waves: 2 pi over the root mean square of the wavenumbers,
    weighted by the absolute amplitudes. For a single wave it is its wavelength. For a sum it is the
    length of the waves that dominate its shape, and not that of the shortest wave.

    amplitudes, wavenumbers: arrays (n,).
    """
    weights, numbers = np.abs(amplitudes), np.asarray(wavenumbers, np.float64)
    # Divided by the largest, so that no square overflows.
    largest = float(numbers.max())
    mean_square = float((weights * (numbers / largest) ** 2).sum() / weights.sum())
    return 2 * math.pi / (largest * math.sqrt(mean_square))


def _plane_waves(term: Term) -> list[tuple[tuple[float, ...], complex]]:
    """The plane waves whose sum is the term, as pairs (k, A) of a wave vector and a complex
    amplitude: the term is the sum of all Re(A exp(i k . p)). The first nonzero component of each
    wave vector k is positive (`_canonical`).

    A product cos a cos b cos c is the mean of cos(a +- b +- c) over the signs.
    """
    if isinstance(term, PlaneWave):
        phasor = term.amplitude * complex(math.cos(term.phase), math.sin(term.phase))
        return [_canonical(term.wave_vector, phasor)]
    # Multiply by one factor after another: each wave becomes two, with the sum and the difference
    # of the angles. The first factor makes one wave of the constant.
    waves: list[tuple[tuple[float, ...], complex]] = [((0.0, 0.0, 0.0), complex(term.amplitude))]
    for index, (axis, factor) in enumerate(term.factors):
        phasor = complex(math.cos(factor.phase), math.sin(factor.phase))
        phasor *= 1 if factor.is_cosine else -1j  # sin t = cos(t - pi/2)
        signs = (1.0,) if index == 0 else (1.0, -1.0)
        waves = [
            (
                tuple(v + sign * factor.frequency * (i == axis) for i, v in enumerate(k)),
                amplitude * (phasor if sign > 0 else phasor.conjugate()) / len(signs),
            )
            for k, amplitude in waves
            for sign in signs
        ]
    return [_canonical(k, amplitude) for k, amplitude in waves]


def _canonical(k: Sequence[float], amplitude: complex) -> tuple[tuple[float, ...], complex]:
    """The same plane wave Re(amplitude exp(i k . p)), written with a wave vector whose first
    nonzero component is positive: its wave vector and its complex amplitude.

    If k has to be negated for this, the amplitude is conjugated: cos(k.p + t) = cos(-k.p - t). So k
    and -k give the same result.
    """
    leading = next((v for v in k if v != 0), 0.0)
    if leading < 0:
        # The sum with 0.0 turns -0.0 into 0.0, as the vector is a key.
        return tuple(-v + 0.0 for v in k), amplitude.conjugate()
    return tuple(v + 0.0 for v in k), amplitude
