"""Sums f of waves, periodic minimal surfaces among them (paper, section 4.7). Each term f_i is a
product of sines and cosines, or a plane wave; it is an eigenfunction of the Laplacian: Laplacian
f_i = -kappa_i^2 f_i, where kappa_i is called its wavenumber. The term becomes harmonic in four
dimensions if it is multiplied by cosh(kappa_i w) with a fourth coordinate w; the sum F of these
products is called the harmonic extension of f, and f = F at w = 0. So bounds for harmonic
functions, such as Harnack's inequality, hold for F on balls of R^4 and prove steps for f. The paper
is Gillespie, Yang, Botsch and Crane 2024.

- `EigenfunctionSum`: the field.
- `ExtensionBounds`: bounds of the harmonic extension (paper, section 4.7.1).
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_real, as_triple, check_no_derivatives, has_derivatives
from harnack.enclosures import HarmonicBall, Lipschitz, TaylorRemainder
from harnack.fields.analytic.rounding import WaveRounding
from harnack.fields.analytic.waves import (
    PlaneWave,
    Term,
    WaveBounds,
    WaveProduct,
    checked_terms,
    cosine_factor,
    evaluate_terms,
    hessian_of_terms,
    mean_wavelength,
    sine_factor,
    with_numbers,
)
from harnack.fields.attached_arrays import opaque_numbers, scaled_in_space, with_formula
from harnack.fields.attached_numbers import attached_vector
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Sample, Traits, is_attached, validate_levels_in_range
from harnack.fields.parameters import differentiable_parameters, kept_arguments
from harnack.geometry.clip_volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry.volume import Volume

__all__ = [
    "EigenfunctionSum",
    "Gyroid",
    "PlaneWave",
    "SchwarzD",
    "SchwarzP",
    "WaveProduct",
    "cosine_factor",
    "sine_factor",
]

# Ends of promised ranges are moved outwards by this fraction for the roundings of float32.
_ROUNDING_EXTENSION = 1e-5


@dataclass(frozen=True)
class ExtensionBounds:
    """Bounds of the harmonic extension F of a sum of waves f = constant + sum f_i, on balls B(p, R)
    of R^4 about points p of space. Each f_i obeys Laplacian f_i = -kappa_i^2 f_i and |f_i| <= A_i,
    and F(y, w) = constant + sum cosh(kappa_i w) f_i(y) is harmonic in R^4.

    radius: R.
    alpha, spread: the numbers alpha and E of the proof.
    largest: a bound of |F| on the ball, without the constant term.
    constant: the constant term of f. It is its own extension; it is left out of all other numbers
        and added in the end.
    largest_gradient, curvature: bounds G of |grad f| and H of the second derivatives of f.

    Proof. F(., 0) = f, and F is smaller than the paper's exp(kappa w) f. Take any wavenumber kappa,
    and let alpha = cosh(kappa R) - 1 and E = sum A_i |cosh(kappa_i R) - cosh(kappa R)|. Then

        F = cosh(kappa w) f + (rest),   |rest| <= E w^2/R^2,   cosh(kappa w) <= 1 + alpha w^2/R^2,

    as (cosh(a w) - cosh(b w))/w^2 is a power series in w^2 with coefficients of one sign. Let x =
    |y-p|/R, so that w^2/R^2 <= 1 - x^2, and write f for f(p). By Taylor's formula |f(y) - f| <= D x
    with D = min(G R, |grad f(p)| R + H R^2/2). If Dx <= f, then f(y) >= 0 and -F <= Dx - f +
    (1-x^2) E, which is at most D - f or, if D < 2E, at most E + D^2/(4E) - f. If Dx > f,

        -F <= h(x) = (1 + alpha (1-x^2)) (Dx - f) + (1-x^2) E.

    On x >= 0 this cubic is largest at its only critical point x* = D(1+alpha) / (sqrt((alpha f -
    E)^2 + 3 alpha (1+alpha) D^2) - (alpha f - E)) or, if x* > 1, at x = 1. This bounds F from
    below. The upper bound is the same with -f. Neither bound need exceed cosh(kappa R) sup|f| + E
    in size.
    """

    radius: float
    alpha: float
    spread: float
    largest: float
    constant: float
    largest_gradient: float
    curvature: float

    @classmethod
    def with_best_radius(cls, waves: WaveBounds) -> ExtensionBounds:
        """The bounds for the radius R that gives the longest steps near level 0 at a point where
        the gradient has its mean length.

        There a step is shortened by the second-order term of Harnack's bound, which is proportional
        to (f - lower)/R^2 with the lower bound of F on the ball, so the radius minimizes this. (For
        the gyroid with the cell 2 pi it is 1.1.)

        waves: bounds of the sum of waves f.
        """
        wavenumbers, amplitudes = np.array(waves.wavenumbers), np.array(waves.amplitudes)
        # The mean square of |grad f| is half the sum of A_i^2 kappa_i^2.
        mean_slope = math.sqrt(0.5 * float(amplitudes**2 @ wavenumbers**2))
        # One over the root mean square of the wavenumbers, weighted by A_i^2.
        length_unit = 1 / math.sqrt(
            float(amplitudes**2 @ wavenumbers**2) / float(amplitudes @ amplitudes)
        )
        # Radii from 0.02 to about 7 length units.
        candidates = (length_unit * 0.02 * 1.02**n for n in range(300))
        # So that cosh stays far from overflow.
        radii = [r for r in candidates if r * float(wavenumbers.max()) < 30.0]
        trials = [cls.at(waves, r) for r in radii]
        return min(trials, key=lambda trial: trial._descent_at_zero(mean_slope) / trial.radius**2)

    @classmethod
    def at(cls, waves: WaveBounds, radius: float) -> ExtensionBounds:
        """The bounds for the radius R. The proof compares F with cosh(kappa w) f for a wavenumber
        kappa of our choice, and E bounds their difference on the ball. kappa is the median of all
        wavenumbers, weighted by the amplitudes, which makes E smallest.

        waves: bounds of the sum of waves f.
        """
        growth: npt.NDArray[np.float64] = np.cosh(radius * np.array(waves.wavenumbers))
        amplitudes = np.array(waves.amplitudes)
        by_growth = np.argsort(growth)
        amplitude_sums: npt.NDArray[np.float64] = np.cumsum(amplitudes[by_growth])
        median_growth = float(
            growth[by_growth][np.argmax(amplitude_sums >= 0.5 * amplitude_sums[-1])]
        )
        spread = float(amplitudes @ np.abs(growth - median_growth)) * (1 + 1e-12)
        largest = median_growth * waves.largest_value + spread
        return cls(
            radius=radius,
            alpha=median_growth - 1,
            spread=spread,
            largest=largest,
            constant=waves.constant,
            largest_gradient=waves.largest_gradient,
            curvature=waves.largest_curvature,
        )

    def ball(self, f: Real, slope: Real) -> HarmonicBall:
        """The ball B(p, R) of R^4 about a point p, R being `radius`, with a range of F on it. F is
        the harmonic extension of f to four dimensions; the range follows from f and its slope at p.

        f: the value at p.
        slope: |grad f(p)|.
        """
        r = self.radius
        rise = fmin(self.largest_gradient * r, slope * r + 0.5 * self.curvature * r * r)
        widening = 1 + _ROUNDING_EXTENSION
        real = backend_of(f).Float
        f = f - self.constant
        lower = self.constant - widening * self._max_descent(f, rise)
        upper = self.constant + widening * self._max_descent(-f, rise)
        return HarmonicBall(real(r), lower, upper, dimension=4)

    def _max_descent(self, f: Real, rise: Real) -> Real:
        """An upper bound of -F on the ball of R^4 about p, where F is the harmonic extension of f
        to four dimensions. With -f in place of f, it is a bound of F. With x = |y-p|/R and the
        numbers alpha and E (`spread`), -F is at most h(x) = (1 + alpha (1-x^2)) (Dx - f) + (1-x^2)
        E where Dx > f, and at most Dx - f + (1-x^2) E elsewhere; the class has the proof.

        f: the value at p, without the constant term.
        rise: the number D, for which |f(y) - f(p)| <= D |y-p|/R at all points y of space in the
            ball.
        """
        alpha, spread = self.alpha, self.spread
        alpha_f_minus_spread = alpha * f - spread
        root = dr.sqrt(
            alpha_f_minus_spread * alpha_f_minus_spread + 3 * alpha * (1 + alpha) * rise * rise
        )
        # The critical point x* of the cubic h, and h there.
        x = fmin((1 + alpha) * rise / (root - alpha_f_minus_spread), 1.0)
        weight = 1 - x * x
        at_critical_point = (1 + alpha * weight) * (rise * x - f) + weight * spread
        # The case Dx <= f: the bound is D - f or, if D < 2E, E + D^2/(4E) - f.
        near_rise = rise
        if not isinstance(spread, float) or spread > 0:  # or a number of a backend
            near_rise = dr.select(rise < 2 * spread, spread + rise * rise / (4 * spread), rise)
        return fmin(fmax(at_critical_point, near_rise - f), self.largest)

    def _descent_at_zero(self, slope: float) -> float:
        """About the bound `_max_descent` at a point where f = 0 and the gradient has the length
        `slope`. It is computed from samples and without rounding, as it only serves to choose the
        radius."""
        r, alpha, spread = self.radius, self.alpha, self.spread
        rise = min(self.largest_gradient * r, slope * r + 0.5 * self.curvature * r * r)
        x = np.linspace(0.0, 1.0, 101)
        descents = (1 + alpha * (1 - x * x)) * rise * x + (1 - x * x) * spread
        return min(float(descents.max()), self.largest)


# Constants are increased by this fraction for the roundings of float32.
_ROUNDING = 1e-5
# The bound of the Hessian is increased by this further fraction for the rounding of the gradient.
_SLOPE_SHARE = 1e-5


def _moves(term: Term) -> bool:
    """Whether the wavelength of a term has derivatives."""
    if isinstance(term, PlaneWave):
        return has_derivatives(term.wave_vector)
    return any(has_derivatives(factor.frequency) for _, factor in term.factors)


class EigenfunctionSum(Field):
    """A sum f of products of sines and cosines, and of plane waves: any truncated Fourier series.
    Each term f_i is an eigenfunction of the Laplacian with the eigenvalue -kappa_i^2, so
    cosh(kappa_i w) f_i is harmonic in four dimensions, where w is the fourth coordinate; the sum of
    these is the harmonic extension of f.

    terms: `WaveProduct` and `PlaneWave` terms; frequencies in radians per unit length. Values,
        gradients and hits can be differentiated by their numbers that are Dr.Jit numbers, if terms
        is a list or tuple.
    domain: the volume in which f is drawn; by default the ball about the origin whose radius is the
        longest wavelength.

    Promises (proved bounds of f near a point). The harmonic extension equals f at w = 0;
    `ExtensionBounds` has its bounds. Let H be the bound `curvature` of the Hessian. The Lipschitz
    constant is local, |grad f(p)| + H r / 2 on the ball of radius r (Taylor), and never above
    `max_gradient`.

    Rounding. The rounding error of the value is bounded at the point (`WaveRounding`). The effect
    of the rounding error E of the gradient is included in `Sample.value_error`. For the
    `TaylorRemainder`, the constant (1 + h) H with h = `_SLOPE_SHARE` is promised. For all lengths t

        E t <= E^2/(2 h H) + h H t^2/2   (since 2 a b <= a^2 + b^2),

    so the larger constant and E^2/(2 h H), added to the value's error, cover the error of Taylor's
    formula with a rounded gradient. For the harmonic ball of radius R the effect of E is at most E
    R. The proofs on balls already allow for some of this effect: they use the slope in units of 4
    (f - lower)/R, where `lower` is the lower bound on the ball, and allow for an error of 16 u of
    this unit (`enclosures.free_radius.condition_rounding`; u is the unit roundoff). Along the
    length R this is 64 u (f - lower). f - lower is at least the number D of `ExtensionBounds` (but
    for the cap at the end of its proof), and so about H R^2/2 or more. So the proofs allow for
    about 32 u H R^2. Half of this allowance is relied on: E R - 16 u H R^2 is added to the value's
    error, if it is positive.

    Raises:
        ValueError: terms that are not finite, or a sum that is constant.
    """

    traits = Traits(is_global=True, is_cheap=True, differentiable_arguments=("terms",))

    def __init__(self, terms: Iterable[Term], *, domain: Volume | None = None) -> None:
        """Check the terms, and compute their bounds and the default domain."""
        listed = tuple(terms)
        if not is_attached(self):  # numbers of what is no list or tuple would be lost
            check_no_derivatives(type(self).__name__, listed)
        self.terms = checked_terms(listed)
        self.waves = self._bounds()
        longest = 2 * math.pi / min(self.waves.wavenumbers)
        min_wavelength = mean_wavelength(self.waves.amplitudes, self.waves.wavenumbers)
        self.traits = dataclasses.replace(self.traits, min_wavelength=min_wavelength)
        if domain is None and any(map(_moves, listed)):
            self.domain_moves = True
        self.domain = Ball(radius=longest) if domain is None else domain
        self._extension = ExtensionBounds.with_best_radius(self.waves)
        self._rounding = WaveRounding.of(self.terms)
        radius = self._extension.radius
        # The part of the error E R that need not be added to the value's error, in units of u. The
        # proofs allow for 16 times 4 (f - lower), and f - lower is about this minimum or more; half
        # of that, 32 times the minimum, is relied on.
        self._rounding_bound = 32 * min(
            0.5 * self.curvature * radius**2, self.max_gradient * radius
        )

    def _bounds(self) -> WaveBounds:
        """Proved bounds of the sum and of its derivatives. Subclasses with sharper proved constants
        override this method."""
        return WaveBounds.of(self.terms)

    @property
    def value_range(self) -> tuple[float, float]:
        """The ends (low, high) of an interval that is proved to contain all values of f."""
        middle, largest = self.waves.constant, self.waves.largest_value
        return middle - largest, middle + largest

    @property
    def max_gradient(self) -> float:
        """A proved bound of |grad f| everywhere."""
        return self.waves.largest_gradient

    @property
    def curvature(self) -> float:
        """A proved bound of the absolute second derivatives of f along any direction."""
        return self.waves.largest_curvature

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f, for every plan (what the evaluator is used for). It holds Python
        numbers, which are the same for every backend; unless derivatives by them are wanted, so
        that they change from step to step and should compile nothing."""
        del plan
        numbers: Any = (
            self.terms, self.waves, self._extension, self._rounding, self._rounding_bound
        )  # fmt: skip
        if is_attached(self):
            numbers = opaque_numbers(numbers, backend)
        return _WaveSumEvaluator(*numbers)

    def with_attached_numbers(self, backend: Backend) -> EigenfunctionSum:
        """The copy whose formula has derivatives by the numbers of the terms."""
        terms: Any = kept_arguments(self).get("terms", self.terms)

        def number(value: Any) -> Any:
            return attached_vector([value], [as_real(value, "a number")], backend)[0]

        def triple(value: Any) -> tuple[Any, Any, Any]:
            x, y, z = attached_vector(value, as_triple(value, "the wave vector"), backend)
            return x, y, z

        attached_terms = [with_numbers(term, number, triple) for term in terms]

        def expression(p: Vec3) -> tuple[Real, Vec3]:
            value, gradient = evaluate_terms(attached_terms, p)
            return value, type(p)(*gradient)

        return with_formula(self, expression)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level outside of the proved range of f."""
        validate_levels_in_range(levels, self.value_range)

    def wall_levels(self, half_width: float, *, level: float | None = None) -> tuple[float, float]:
        """The two levels that bound the wall |f - level| <= half_width: the lower one and the upper
        one.

        half_width: a difference of values of f, and no length; see `levels_of_thickness` for
            lengths.
        level: the level in the middle of the wall, by default `default_level`.

        Raises:
            ValueError: the half width is not positive, or one of the levels is outside the range of
                f.
        """
        middle = self.default_level if level is None else float(level)
        if not 0 < half_width < math.inf:
            raise ValueError(f"the half width of a wall must be positive, not {half_width!r}")
        low, high = middle - half_width, middle + half_width
        range_low, range_high = self.value_range
        if low < range_low or high > range_high:
            raise ValueError(
                f"a wall from {low:g} to {high:g} has a side without surface: the function stays "
                f"within [{range_low:g}, {range_high:g}]; take a smaller half width or thickness"
            )
        return low, high

    def levels_of_thickness(
        self, thickness: float, *, level: float | None = None
    ) -> tuple[float, float]:
        """The two levels that bound a wall about the surface f = level that is proved to be at
        least this thick.

        thickness: a length. The wall contains every point within thickness/2 of the middle surface,
            since there |f - level| <= `max_gradient` * thickness/2. Where f is less steep than at
            its steepest, the wall is thicker.
        level: the level in the middle of the wall, by default `default_level`.
        """
        # The bound depends on the numbers of the terms, and is one of Python.
        check_no_derivatives("levels_of_thickness", differentiable_parameters(self))
        return self.wall_levels(0.5 * self.max_gradient * float(thickness), level=level)

    def describe(self) -> dict[str, Any]:
        """The number of terms and the proved bounds of the sum, as a dictionary for users."""
        return {
            "terms": len(self.terms),
            "range": self.value_range,
            "max_gradient": self.max_gradient,
            "radius of the harmonic ball": self._extension.radius,
        }


@dataclass(frozen=True, eq=False)
class _WaveSumEvaluator(Evaluator):
    """The evaluator of an `EigenfunctionSum` f, which has the proofs.

    terms: the products of waves and plane waves whose sum is f.
    bounds: proved bounds of f and of its derivatives.
    extension: bounds of the harmonic extension of f on balls of R^4.
    rounding: bounds of the rounding of value and derivatives.
    rounding_bound: the part of the error E R that is not added to the value's error, as the proofs
        on balls allow for it, in units of the unit roundoff.
    """

    terms: tuple[Term, ...]
    bounds: WaveBounds
    extension: ExtensionBounds
    rounding: WaveRounding
    rounding_bound: float

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: value, gradient and bounds of f near p. These are a bound of second
        derivatives that holds everywhere, a local Lipschitz constant, and a range on a ball of four
        dimensions in which the harmonic extension of f is harmonic. `EigenfunctionSum` has the
        proofs."""
        value, components = evaluate_terms(self.terms, p)
        gradient = type(p)(*components)
        epsilon = float(dr.epsilon(type(value)))
        error, gradient_error = self.rounding.errors(p, gradient)
        gradient_norm_bound = dr.norm(gradient) + gradient_error
        max_gradient, curvature = self.bounds.largest_gradient, self.bounds.largest_curvature
        radius = 0.9 * max_gradient / curvature  # the best by experiment, gyroid and P
        local_constant = (gradient_norm_bound + 0.5 * curvature * radius) * (1 + _ROUNDING)
        lipschitz = Lipschitz(fmin(local_constant, max_gradient * (1 + _ROUNDING)), radius)
        third_derivative_bound = self.bounds.max_third_derivative * (1 + _ROUNDING)
        promises = (
            TaylorRemainder(
                curvature * (1 + _ROUNDING + _SLOPE_SHARE),
                cubic_constant=third_derivative_bound,
            ),
        )
        alternatives = (self.extension.ball(value, gradient_norm_bound), lipschitz)
        # The effects of the gradient's rounding error E: E^2/(2 h H) for Taylor's formula, with the
        # bound H of second derivatives and h = `_SLOPE_SHARE`; and for the harmonic ball of radius
        # R what E R exceeds `rounding_bound` by.
        error += gradient_error * (gradient_error * (0.5 / (_SLOPE_SHARE * curvature)))
        error += fmax(gradient_error * self.extension.radius - self.rounding_bound * epsilon, 0)
        return Sample(value, gradient, promises, error, alternative_promises=alternatives)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p. Its trace is not zero, because f itself is not
        harmonic."""
        x, y, z = (type(p)(*row) for row in hessian_of_terms(self.terms, p))
        return x, y, z

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        """Two bounds, of the rounding errors of the gradient and of the Hessian of f at p.

        sample: not used.
        """
        del sample
        return self.rounding.derivative_errors(p)

    def gradient_change_bound(self, p: Vec3, radius: Real) -> Real:
        """A bound of |grad f(y) - grad f(p)| for |y - p| <= radius: the radius times the
        `largest_curvature` of the bounds, which bounds the norm of the Hessian everywhere."""
        return 0 * p.x + radius * (self.bounds.largest_curvature * (1 + _ROUNDING))


def _wavenumber(cell: Any) -> float:
    """The wavenumber 2 pi/cell of waves that repeat after the length `cell`.

    Raises:
        TypeError, ValueError: cell is not a positive finite number.
    """
    if not (isinstance(cell, numbers.Real) or dr.is_array_v(type(cell))):
        raise TypeError(f"the edge length of the cell must be a number, not {cell!r}")
    edge = as_real(cell, "the edge length of the cell")
    if not 0 < edge < math.inf:
        raise ValueError(f"the edge length of the cell must be positive, not {cell!r}")
    return 2 * math.pi / edge


class _CubicSurface(EigenfunctionSum):
    """A sum of waves f that repeats after the length `cell` along x, y and z, with sharper proved
    bounds of |f| and |grad f| than `EigenfunctionSum` computes.

    _largest_value: a bound of |f|.
    _steepness: a bound of |grad f| for cell 2 pi.
    """

    traits = dataclasses.replace(EigenfunctionSum.traits, differentiable_arguments=("cell",))
    _largest_value: float
    _steepness: float

    def __init__(self, cell: float, terms: tuple[Term, ...], domain: Volume | None) -> None:
        """Set up the sum of the waves `terms`, which repeats after the length `cell`.

        domain: the volume in which f is drawn; None for the ball of radius `cell` about the origin.
        """
        self._wavenumber = _wavenumber(cell)
        self.cell = as_real(cell, "cell")
        self.domain_moves = domain is None and is_attached(self)
        super().__init__(terms, domain=Ball(radius=self.cell) if domain is None else domain)

    def with_attached_numbers(self, backend: Backend) -> EigenfunctionSum:
        """The copy whose formula has derivatives by the cell, with which f scales."""
        (cell,) = attached_vector([kept_arguments(self)["cell"]], [self.cell], backend)
        return with_formula(self, scaled_in_space(self.evaluator(backend), cell))

    def _bounds(self) -> WaveBounds:
        """Proved bounds of the sum of waves and of its derivatives. The bounds of |f| and |grad f|
        are those that the class states."""
        return replace(
            super()._bounds(),
            largest_value=self._largest_value,
            largest_gradient=self._steepness * self._wavenumber,
        )


class Gyroid(_CubicSurface):
    """The gyroid: f = sin X cos Y + sin Y cos Z + sin Z cos X with (X, Y, Z) = 2 pi p/cell (paper,
    Eq. 18).

    cell: the edge length of the cubic cell of periodicity, 2 pi by default (so X = x).
    domain: the volume in which f is drawn, by default the ball of radius `cell` about the origin.

    Proof of |f| <= 3/2: each term obeys 2 sin a cos b <= sin^2 a + cos^2 b, and the three right
    sides add up to 3. Proof of |grad f| <= sqrt 3 (2 pi/cell): the derivative by X is f_X = cos X
    cos Y - sin Z sin X. By Cauchy-Schwarz f_X^2 <= cos^2 Y + sin^2 Z, and the three right sides add
    up to 3. Both bounds are attained.
    """

    _largest_value = 1.5
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        """Set up the sum of the three products sin X cos Y, sin Y cos Z and sin Z cos X.

        cell: the length after which f repeats along each axis.
        domain: the volume in which f is drawn; None for the ball of radius `cell` about the origin.
        """
        k = _wavenumber(cell)
        s, c = sine_factor(k), cosine_factor(k)
        terms = (WaveProduct(1.0, x=s, y=c), WaveProduct(1.0, y=s, z=c), WaveProduct(1.0, z=s, x=c))
        super().__init__(cell, terms, domain)


class SchwarzP(_CubicSurface):
    """Schwarz's primitive surface: f = cos X + cos Y + cos Z with (X, Y, Z) = 2 pi p/cell.

    cell: the edge length of the cubic cell of periodicity, 2 pi by default.
    domain: the volume in which f is drawn, by default the ball of radius `cell` about the origin.

    |f| <= 3, and |grad f| <= sqrt 3 (2 pi/cell) since the derivatives by X, Y and Z are sines. Both
    bounds are attained.
    """

    _largest_value = 3.0
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        """Set up the sum of the three cosines cos X, cos Y and cos Z.

        cell: the length after which f repeats along each axis.
        domain: the volume in which f is drawn; None for the ball of radius `cell` about the origin.
        """
        c = cosine_factor(_wavenumber(cell))
        super().__init__(
            cell, (WaveProduct(1.0, x=c), WaveProduct(1.0, y=c), WaveProduct(1.0, z=c)), domain
        )


class SchwarzD(_CubicSurface):
    """Schwarz's diamond surface, the level 0 of f = s s s + s c c + c s c + c c s. Here the first,
    second and third s or c of each term is sin or cos of X, Y and Z, and (X, Y, Z) = 2 pi p/cell.

    cell: the edge length of the cubic cell of periodicity, 2 pi by default.
    domain: the volume in which f is drawn, by default the ball of radius `cell` about the origin.

    Proof of |f| <= sqrt 2: f = sin X cos(Y-Z) + cos X sin(Y+Z), which is at most sqrt(cos^2(Y-Z) +
    sin^2(Y+Z)) by Cauchy-Schwarz. Proof of |grad f| <= sqrt 3 (2 pi/cell): let A, B, C be the
    cosines and P, Q, R the sines of 2X, 2Y, 2Z. For cell 2 pi, |grad f|^2 = 3/2 (1 + ABC) - (PQ +
    QR + RP)/2. Here -2(PQ + QR + RP) <= P^2 + Q^2 + R^2 = 3 - S with S = A^2 + B^2 + C^2, and |ABC|
    <= (S/3)^(3/2) <= S/3, so |grad f|^2 <= 3/2 + S/2 + (3 - S)/4 <= 3. Both bounds are attained.
    """

    _largest_value = math.sqrt(2.0)
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        """Set up the sum of the four products s s s, s c c, c s c and c c s, where s and c are the
        sines and cosines of X, Y and Z.

        cell: the length after which f repeats along each axis.
        domain: the volume in which f is drawn; None for the ball of radius `cell` about the origin.
        """
        k = _wavenumber(cell)
        s, c = sine_factor(k), cosine_factor(k)
        terms = (
            WaveProduct(1.0, s, s, s),
            WaveProduct(1.0, s, c, c),
            WaveProduct(1.0, c, s, c),
            WaveProduct(1.0, c, c, s),
        )
        super().__init__(cell, terms, domain)
