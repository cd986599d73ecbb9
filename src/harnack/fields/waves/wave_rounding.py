"""How far rounding moves `waves.evaluate_terms` at a point p, in units of u (the unit roundoff).

Everything is to first order in u, as in `harmonic_rounding`. A sine or cosine is right to 2u
(`backend.sines`).

- The angle of a factor, fl(fl(k) x + phase), is off by c u |k x|, c = 2 for the two roundings of
  the product, 0 where k is a power of two; where there is a phase by 2u |phase| and u |k x| more.
  Where all factors of an axis have one |k|, the first is the same for all of them: a move of the
  point by c u |x|, after which value *and* gradient are those of the moved point.
- The angle of a plane wave is off by 5u sum |k_i x_i| + 2u |phase|.
- A product of n factors is off by n times that of a sine, by u for each product with a factor and
  2u for an amplitude other than 1; a partial sum by u of its size.
- A derivative along one axis carries the frequency as well: 2u more; a second derivative 6u.
  Of an entry i, j of the Hessian the error is at most d |k_i| |k_j|, which as a matrix has the
  norm d |k|^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr

from harnack.fields.waves.waves import Factor, PlaneWave, Term

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

_SINE = 2.0

Share: TypeAlias = tuple[float, float, float, float]


@dataclass(frozen=True)
class WaveRounding:
    """Rounding of a sum of waves in units of u.

    move: (x, y, z) by how much of each coordinate rounding moves the point for all terms alike.
    value, gradient: (constant, x, y, z), the rest of the rounding: the constant plus those times
        the sizes of the coordinates.
    slopes, hessian: the same, of all that is done to the gradient and the Hessian at the point
        that was given: no part of it is a move.
    """

    move: tuple[float, float, float]
    value: Share
    gradient: Share
    slopes: Share
    hessian: Share

    @classmethod
    def of(cls, terms: Sequence[Term]) -> WaveRounding:
        """What the operations of `evaluate_terms` add up to."""
        common = [_common(terms, axis) for axis in range(3)]
        value, gradient, alone, second = ([0.0] * 4 for _ in range(4))
        sizes, slopes, bends = 0.0, 0.0, 0.0
        for n, term in enumerate(terms):
            size, vector = abs(term.amplitude), _vector(term)
            steep = math.sqrt(sum(k * k for k in vector))
            bend = size * steep * steep
            sizes, slopes, bends = sizes + size, slopes + size * steep, bends + bend
            angle, per_axis, operations = _of_term(term, common)
            _, all_per_axis, _ = _of_term(term, (None, None, None))
            partial = (sizes, slopes, bends) if n else (0.0, 0.0, 0.0)  # the first is added to 0
            value[0] += size * (angle + operations) + partial[0]
            gradient[0] += size * steep * (angle + operations + 2) + partial[1]
            second[0] += bend * (angle + operations + 6) + partial[2]
            for axis in range(3):
                value[axis + 1] += size * per_axis[axis]
                gradient[axis + 1] += size * steep * per_axis[axis]
                alone[axis + 1] += size * steep * all_per_axis[axis]
                second[axis + 1] += bend * all_per_axis[axis]
        alone[0] = gradient[0]
        moves = [0.0 if k is None else _rounded(k) for k in common]
        a, b, c, d = ((s[0], s[1], s[2], s[3]) for s in (value, gradient, alone, second))
        return cls((moves[0], moves[1], moves[2]), a, b, c, d)

    def errors(self, p: Vec3, gradient: Vec3) -> tuple[Real, Real]:
        """Errors of value and gradient at p; the latter once the point is moved as `move` says."""
        size = [dr.abs(p.x), dr.abs(p.y), dr.abs(p.z)]
        value, slope = self.value[0], self.gradient[0]
        for axis in range(3):
            if self.move[axis] > 0:
                value = value + self.move[axis] * size[axis] * dr.abs(gradient[axis])
            if self.value[axis + 1] > 0:
                value = value + self.value[axis + 1] * size[axis]
                slope = slope + self.gradient[axis + 1] * size[axis]
        unit = float(dr.epsilon(type(p.x)))
        return unit * (value + 0 * p.x), unit * (slope + 0 * p.x)

    def derivative_errors(self, p: Vec3) -> tuple[Real, Real]:
        """Errors of gradient and Hessian at p itself."""
        unit = float(dr.epsilon(type(p.x)))

        def at(share: Share) -> Real:
            far = (one * dr.abs(x) for one, x in zip(share[1:], p, strict=True))
            return unit * (share[0] + sum(far, 0 * p.x))

        return at(self.slopes), at(self.hessian)


def _vector(term: Term) -> tuple[float, ...]:
    if isinstance(term, PlaneWave):
        return term.wave_vector
    return tuple(factor.frequency for _, factor in term.factors)


def _common(terms: Sequence[Term], axis: int) -> float | None:
    """The one |frequency| of all terms along an axis; None where there are more."""
    found: set[float] = set()
    for term in terms:
        if isinstance(term, PlaneWave):
            if term.wave_vector[axis] != 0:
                return None
        else:
            found |= {abs(factor.frequency) for other, factor in term.factors if other == axis}
    return found.pop() if len(found) == 1 else None


def _rounded(frequency: float) -> float:
    """The rounding of frequency and product together; none for powers of two."""
    return 0.0 if abs(math.frexp(frequency)[0]) == 0.5 else 2.0


def _of_term(term: Term, common: Sequence[float | None]) -> tuple[float, list[float], float]:
    """Of a term of amplitude 1: the rounding of its angles, constant and by the coordinates' sizes,
    and that of its operations."""
    if isinstance(term, PlaneWave):
        operations = _SINE + 2
        return 2 * abs(term.phase), [5 * abs(k) for k in term.wave_vector], operations
    angle, per_axis = 0.0, [0.0] * 3
    for axis, factor in term.factors:
        angle += 2 * abs(factor.phase)
        per_axis[axis] = abs(factor.frequency) * _of_angle(factor, common[axis] is not None)
    n = len(term.factors)
    return angle, per_axis, n * _SINE + max(n - 1, 0) + (0 if term.amplitude == 1.0 else 2)


def _of_angle(factor: Factor, is_common: bool) -> float:
    total = 0.0 if is_common else _rounded(factor.frequency)
    return total + 1.0 if factor.phase else total
