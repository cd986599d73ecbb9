"""Sums of Laplacian eigenfunctions, periodic minimal surfaces among them (paper, section 4.7)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.extrema import fmax, fmin
from harnack.fields.field import Field, HarmonicBall, Lipschitz, Sample
from harnack.fields.waves import (
    PlaneWave,
    Product,
    Term,
    WaveBounds,
    checked_terms,
    cosine,
    evaluate_terms,
    sine,
)
from harnack.geometry.volumes import Ball

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.geometry.volumes import Volume

__all__ = [
    "EigenfunctionSum",
    "Gyroid",
    "PlaneWave",
    "Product",
    "SchwarzD",
    "SchwarzP",
    "cosine",
    "sine",
]

# Promised ends are moved out, and constants up, by this much for the roundings of float32.
_ROUNDING = 1e-5


class EigenfunctionSum(Field):
    """A sum of products of sines and cosines, and of plane waves: any truncated Fourier series.

    terms: `Product` and `PlaneWave` terms; frequencies in radians per unit length.
    domain: the volume it is drawn in; by default the ball about the origin whose radius is the
        longest wavelength.

    Raises ValueError for terms that are not finite or a sum that is constant.

    Each term is an eigenfunction of the Laplacian, so cosh(kappa w) f with kappa^2 = -eigenvalue
    is harmonic in R^4 and equals f at w = 0: see `ExtensionRange` for what it is bounded by. The
    Lipschitz constant is local, |grad f(p)| + H r / 2 on the ball of radius r (Taylor), where
    `curvature` H bounds the Hessian, and never above `steepness`.
    """

    def __init__(self, terms: Iterable[Term], *, domain: Volume | None = None) -> None:
        self.terms = checked_terms(terms)
        self.waves = WaveBounds.of(self.terms)
        lengths = [2 * math.pi / k for k in self.waves.wavenumbers if k > 0]
        if not lengths or self.waves.largest_curvature <= 0:
            raise ValueError("the sum is constant: it has no level sets")
        self.domain = Ball(radius=max(lengths)) if domain is None else domain
        self._extension = ExtensionRange.best(self)

    @property
    def largest_value(self) -> float:
        """Proved: |f| never exceeds it."""
        return self.waves.largest_value

    @property
    def steepness(self) -> float:
        """Proved: |grad f| never exceeds it."""
        return self.waves.largest_gradient

    @property
    def curvature(self) -> float:
        """Proved: no directional second derivative of f exceeds it in size."""
        return self.waves.largest_curvature

    def evaluate(self, p: Vec3) -> Sample:
        value, components = evaluate_terms(self.terms, p)
        gradient = type(p)(*components)
        slope = dr.norm(gradient)
        reach = 0.9 * self.steepness / self.curvature  # the best by experiment, gyroid and P
        local = (slope + 0.5 * self.curvature * reach) * (1 + _ROUNDING)
        lipschitz = Lipschitz(fmin(local, self.steepness * (1 + _ROUNDING)), reach)
        return Sample(value, gradient, (self._extension.ball(value, slope), lipschitz))

    def differentiable_value(self, p: Vec3) -> Real:
        return evaluate_terms(self.terms, p)[0]

    def check_levels(self, levels: tuple[float, ...]) -> None:
        """ValueError for a level that is proved to lie outside the range of the function."""
        for level in levels:
            if abs(level) > self.largest_value:
                raise ValueError(
                    f"no surface has level {level:g}: the function stays within "
                    f"[-{self.largest_value:g}, {self.largest_value:g}]"
                )

    def wall_levels(self, half_width: float, *, level: float | None = None) -> tuple[float, float]:
        """The two levels of the wall |f - level| <= half_width, as `solid=` wants them.

        half_width is a difference of values of f, not a length: see `levels_of_thickness`.
        level: the middle of the wall, by default `default_level`.
        """
        middle = self.default_level if level is None else float(level)
        if not 0 < half_width < math.inf:
            raise ValueError(f"the half width of a wall must be positive, not {half_width!r}")
        low, high = middle - half_width, middle + half_width
        if low < -self.largest_value and high > self.largest_value:
            raise ValueError(
                f"a wall of half width {half_width:g} fills all of space: the function stays "
                f"within [-{self.largest_value:g}, {self.largest_value:g}]; take a smaller one"
            )
        return low, high

    def levels_of_thickness(
        self, thickness: float, *, level: float | None = None
    ) -> tuple[float, float]:
        """The two levels of a wall about `level` that is proved to be at least this thick.

        thickness is a length. The wall holds every point within thickness/2 of the middle
        surface, since there |f - level| <= `steepness` * thickness/2; where f is less steep than
        at its steepest the wall is thicker.
        """
        return self.wall_levels(0.5 * self.steepness * float(thickness), level=level)

    def describe(self) -> dict[str, Any]:
        return {
            "terms": len(self.terms),
            "largest value": self.largest_value,
            "steepness": self.steepness,
            "radius of the harmonic ball": self._extension.radius,
        }


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
    cosh(kappa R) sup|f| + E.
    """

    radius: float
    alpha: float
    spread: float  # E
    largest: float
    steepness: float
    curvature: float

    @classmethod
    def best(cls, field: EigenfunctionSum) -> ExtensionRange:
        """The radius that is best where it matters, near level 0 at a gradient of mean size.

        There a step loses to the second-order term of the bound, which is proportional to
        (f - lower)/R^2. For the gyroid R = 1.06 (cell 2 pi), the best of those traced too.
        """
        k = np.array(field.waves.wavenumbers)
        a = np.array(field.waves.amplitudes)
        typical = math.sqrt(0.5 * float(a**2 @ k**2))
        scale = 1 / math.sqrt(float(a**2 @ k**2) / float(a[k > 0] @ a[k > 0]))
        radii = scale * np.geomspace(0.02, 8.0, 300)
        radii = radii[radii * k.max() < 30.0]  # cosh stays far from overflow
        trials = [cls.at(field, float(r)) for r in radii]
        return min(trials, key=lambda trial: trial._below_host(typical) / trial.radius**2)

    @classmethod
    def at(cls, field: EigenfunctionSum, radius: float) -> ExtensionRange:
        """The numbers of one radius; kappa is the weighted median, which makes E smallest."""
        growth = np.cosh(radius * np.array(field.waves.wavenumbers))
        amplitudes = np.array(field.waves.amplitudes)
        order = np.argsort(growth)
        mass = np.cumsum(amplitudes[order])
        middle = growth[order][int(np.searchsorted(mass, 0.5 * mass[-1]))]
        spread = float(amplitudes @ np.abs(growth - middle)) * (1 + 1e-12)
        largest = float(middle) * field.largest_value + spread
        return cls(
            radius, float(middle) - 1, spread, largest, field.steepness, field.curvature
        )

    def ball(self, f: Real, slope: Real) -> HarmonicBall:
        """The promise at a point with value f and |grad f| = slope."""
        r = self.radius
        rise = fmin(self.steepness * r, slope * r + 0.5 * self.curvature * r * r)
        out = 1 + _ROUNDING
        real = backend_of(f).Float
        lower, upper = -out * self._below(f, rise), out * self._below(-f, rise)
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
        rise = min(self.steepness * r, slope * r + 0.5 * self.curvature * r * r)
        x = np.linspace(0.0, 1.0, 101)
        falling = (1 + alpha * (1 - x * x)) * rise * x + (1 - x * x) * e
        return min(float(falling.max()), self.largest)


def _wavenumber(cell: float) -> float:
    if not 0 < cell < math.inf:
        raise ValueError(f"the edge length of the cell must be positive, not {cell!r}")
    return 2 * math.pi / cell


class _CubicSurface(EigenfunctionSum):
    """A surface with cubic symmetry and proved constants: bounds of |f|, |grad f| at cell 2 pi."""

    _largest_value: float
    _steepness: float

    def __init__(self, cell: float, terms: tuple[Term, ...], domain: Volume | None) -> None:
        self.cell = float(cell)
        self._wavenumber = _wavenumber(cell)
        super().__init__(terms, domain=Ball(radius=self.cell) if domain is None else domain)

    @property
    def largest_value(self) -> float:
        return self._largest_value

    @property
    def steepness(self) -> float:
        return self._steepness * self._wavenumber


class Gyroid(_CubicSurface):
    """sin X cos Y + sin Y cos Z + sin Z cos X with (X, Y, Z) = 2 pi p/cell (paper, Eq. 18).

    cell: edge length of the cubic cell that it repeats in, 2 pi by default (so X = x).
    domain: the volume it is drawn in, by default the ball of radius `cell` about the origin.

    |f| <= 3/2: 2 sin a cos b <= sin^2 a + cos^2 b, and the three right sides add up to 3.
    |grad f| <= sqrt 3 (2 pi/cell): f_X = cos X cos Y - sin Z sin X has, by Cauchy-Schwarz,
    f_X^2 <= cos^2 Y + sin^2 Z; the three right sides add up to 3. Both are attained.
    """

    _largest_value = 1.5
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        k = _wavenumber(cell)
        s, c = sine(k), cosine(k)
        terms = (Product(1.0, x=s, y=c), Product(1.0, y=s, z=c), Product(1.0, z=s, x=c))
        super().__init__(cell, terms, domain)


class SchwarzP(_CubicSurface):
    """cos X + cos Y + cos Z with (X, Y, Z) = 2 pi p/cell: Schwarz's primitive surface.

    cell, domain: as for `Gyroid`. |f| <= 3 and |grad f|^2 = sum sin^2 <= 3 (2 pi/cell)^2, both
    attained.
    """

    _largest_value = 3.0
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        c = cosine(_wavenumber(cell))
        super().__init__(cell, (Product(1.0, x=c), Product(1.0, y=c), Product(1.0, z=c)), domain)


class SchwarzD(_CubicSurface):
    """Schwarz's diamond surface, with s and c for sin and cos of (X, Y, Z) = 2 pi p/cell:

        s s s + s c c + c s c + c c s.

    cell, domain: as for `Gyroid`. |f| <= sqrt 2, attained: f = sin X cos(Y-Z) + cos X sin(Y+Z),
    at most sqrt(cos^2(Y-Z) + sin^2(Y+Z)) by Cauchy-Schwarz.
    |grad f| <= sqrt 3 (2 pi/cell), attained: with A, B, C the cosines and P, Q, R the sines of
    2X, 2Y, 2Z, |grad f|^2 = 3/2 (1 + ABC) - (PQ + QR + RP)/2. Here
    -2(PQ + QR + RP) <= P^2 + Q^2 + R^2 = 3 - S with S = A^2 + B^2 + C^2, and
    |ABC| <= (S/3)^(3/2) <= S/3, so |grad f|^2 <= 3/2 + S/2 + (3 - S)/4 <= 3.
    """

    _largest_value = math.sqrt(2.0)
    _steepness = math.sqrt(3.0)

    def __init__(self, cell: float = 2 * math.pi, *, domain: Volume | None = None) -> None:
        k = _wavenumber(cell)
        s, c = sine(k), cosine(k)
        terms = (
            Product(1.0, s, s, s),
            Product(1.0, s, c, c),
            Product(1.0, c, s, c),
            Product(1.0, c, c, s),
        )
        super().__init__(cell, terms, domain)
