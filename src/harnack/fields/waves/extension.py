"""The harmonic extension of a sum of waves to four dimensions (paper, section 4.7.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import backend_of
from harnack.backend.extrema import fmax, fmin
from harnack.enclosures import HarmonicBall
from harnack.fields.waves.waves import WaveBounds

if TYPE_CHECKING:
    from harnack.backend import Real

# Promised ends are moved out by this much for the roundings of float32.
_ROUNDING = 1e-5


@dataclass(frozen=True)
class ExtensionRange:
    """What the harmonic extension of a sum of waves stays within on B(p, R) of R^4.

    With f = sum f_i, Laplacian f_i = -kappa_i^2 f_i and |f_i| <= A_i, the extension is
    F(y, w) = sum cosh(kappa_i w) f_i(y): harmonic, F(., 0) = f, and smaller than the paper's
    exp(kappa w) f. Take any wavenumber kappa, and alpha = cosh(kappa R) - 1,
    E = sum A_i |cosh(kappa_i R) - cosh(kappa R)|. Then

        F = cosh(kappa w) f + (rest),   |rest| <= E w^2/R^2,   cosh(kappa w) <= 1 + alpha w^2/R^2,

    as (cosh(a w) - cosh(b w))/w^2 is a power series in w^2 with coefficients of one sign. Put
    x = |y-p|/R, so w^2/R^2 <= 1 - x^2. By Taylor |f(y) - f(p)| <= D x with
    D = min(G R, |grad f(p)| R + H R^2/2), G and H bounds of the gradient and the Hessian. Hence
    -F <= Dx - f + (1-x^2) E where Dx <= f (there f(y) >= 0), at most
    D - f or, if D < 2E, E + D^2/(4E) - f; and where Dx > f

        -F <= h(x) = (1 + alpha (1-x^2)) (Dx - f) + (1-x^2) E,

    a cubic that on x >= 0 is largest at its one critical point
    x* = D(1+alpha) / (sqrt((alpha f - E)^2 + 3 alpha (1+alpha) D^2) - (alpha f - E)) or, if that
    is beyond it, at x = 1. The upper end is the same with -f. Neither end need exceed
    cosh(kappa R) sup|f| + E. A constant term, which is its own extension, is left out of
    all this and added in the end.
    """

    radius: float
    alpha: float
    spread: float  # E
    largest: float
    constant: float
    largest_gradient: float
    curvature: float

    @classmethod
    def best(cls, waves: WaveBounds) -> ExtensionRange:
        """The radius that is best where it matters, near level 0 at a gradient of mean size.

        There a step loses to the second-order term of the bound, which is proportional to
        (f - lower)/R^2. For the gyroid (cell 2 pi) R = 1.1, in the middle of the best: with the
        slope bound, 0.8 to 1.4 took 11.5 to 11.9 evaluations a ray, the paper's exp with the
        range +-3/2 at its best radius 21.4.
        """
        k, a = np.array(waves.wavenumbers), np.array(waves.amplitudes)
        typical = math.sqrt(0.5 * float(a**2 @ k**2))
        scale = 1 / math.sqrt(float(a**2 @ k**2) / float(a @ a))
        steps = (scale * 0.02 * 1.02**n for n in range(300))
        radii = [r for r in steps if r * float(k.max()) < 30.0]  # cosh stays far from overflow
        trials = [cls.at(waves, r) for r in radii]
        return min(trials, key=lambda trial: trial._below_host(typical) / trial.radius**2)

    @classmethod
    def at(cls, waves: WaveBounds, radius: float) -> ExtensionRange:
        """The numbers of one radius; kappa is the weighted median, which makes E smallest."""
        growth: npt.NDArray[np.float64] = np.cosh(radius * np.array(waves.wavenumbers))
        amplitudes = np.array(waves.amplitudes)
        order = np.argsort(growth)
        mass: npt.NDArray[np.float64] = np.cumsum(amplitudes[order])
        middle = float(growth[order][np.argmax(mass >= 0.5 * mass[-1])])
        spread = float(amplitudes @ np.abs(growth - middle)) * (1 + 1e-12)
        largest = middle * waves.largest_value + spread
        return cls(
            radius=radius,
            alpha=middle - 1,
            spread=spread,
            largest=largest,
            constant=waves.constant,
            largest_gradient=waves.largest_gradient,
            curvature=waves.largest_curvature,
        )

    def ball(self, f: Real, slope: Real) -> HarmonicBall:
        """The promise at a point with value f and |grad f| = slope."""
        r = self.radius
        rise = fmin(self.largest_gradient * r, slope * r + 0.5 * self.curvature * r * r)
        out = 1 + _ROUNDING
        real = backend_of(f).Float
        f = f - self.constant
        lower = self.constant - out * self._below(f, rise)
        upper = self.constant + out * self._below(-f, rise)
        return HarmonicBall(real(r), lower, upper, dimension=4)

    def _below(self, f: Real, rise: Real) -> Real:
        """A bound of -F on the ball where |f(y) - f| <= rise |y-p|/R."""
        alpha, e = self.alpha, self.spread
        b = alpha * f - e
        root = dr.sqrt(b * b + 3 * alpha * (1 + alpha) * rise * rise)
        x = fmin((1 + alpha) * rise / (root - b), 1.0)
        weight = 1 - x * x
        falling = (1 + alpha * weight) * (rise * x - f) + weight * e
        level = rise
        if e > 0:
            level = dr.select(rise < 2 * e, e + rise * rise / (4 * e), rise)
        return fmin(fmax(falling, level - f), self.largest)

    def _below_host(self, slope: float) -> float:
        """The same at f = 0 in Python floats, for choosing the radius."""
        r, alpha, e = self.radius, self.alpha, self.spread
        rise = min(self.largest_gradient * r, slope * r + 0.5 * self.curvature * r * r)
        x = np.linspace(0.0, 1.0, 101)
        falling = (1 + alpha * (1 - x * x)) * rise * x + (1 - x * x) * e
        return min(float(falling.max()), self.largest)
