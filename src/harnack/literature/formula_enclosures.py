"""Enclosures of the literature for functions f that are given by formulas, for comparison with
`PiecewiseTaylorEnclosure`. An enclosure bounds F(s), the change of f along a path (a ray) from its
value at the start, at the length s; so it proves a length on which f takes no level, a value that
rays look for.

The formula is evaluated along the path in another arithmetic, operation by operation, which bounds
f. Bounds by parabolas come from the bottom-up arithmetic of `ParabolaBounds`; bounds by two lines
(bands) come from affine forms and from intervals. All of them prove steps. Benchmarks measure how
many steps a ray takes with each.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr

from harnack.arithmetic import Interval, Jet
from harnack.backend.elementary import fmax, fmin
from harnack.enclosures.enclosure import STEP_SAFETY, Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.fields.formula_evaluator import FormulaOnRay
from harnack.literature.affine_forms import AffineForm
from harnack.literature.parabola_bounds import ParabolaBounds
from harnack.literature.taylor_forms import LinearTaylorEnclosure, QuadraticTaylorEnclosure

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Real
    from harnack.enclosures.enclosure import PathRestriction


@dataclass(frozen=True)
class BottomUpQuadraticEnclosure(ParabolaEnclosure):
    """The two parabolas that bound f along a path, from the bottom-up arithmetic of its formula:
    every operation is done with parabolas that bound its operands.

    Source: Aydinlilar and Zanni 2023, section 6.2. Proof: that of `ParabolaBounds`, then that of
        `ParabolaEnclosure`.
    """

    degree: ClassVar[int] = 2

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the enclosure of a function f along a piece of a path. It consists of two
        parabolas (or lines), found by evaluating the formula of f in the arithmetic of
        `ParabolaBounds`, operation by operation. The result is None if f has no formula.

        function: f as a function of the length along the path.
        slopes: the range of the derivative at the start of the path; not used.
        length: the length of the piece.
        """
        if not isinstance(function, FormulaOnRay):
            return None
        parabolas = _evaluate(
            function,
            ParabolaBounds.along_ray(function.p, function.direction, length, degree=cls.degree),
        )
        # The change of f lies between a s + b s^2 and c s + d s^2. (2b and 2d are the second
        # derivatives of these.)
        (a, b), (c, d) = parabolas.bounds
        return cls(SlopeRange(a, c), 2 * b, 2 * d, length)

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the whole length of the path's piece if f is proved to take no level on it;
        otherwise the length that `ParabolaEnclosure` proves.

        gaps: the differences between f at the start and the next levels below and above.

        To allow for rounding, the gaps are made smaller. The whole length is not shortened: then a
        ray that misses would need one more sample.
        """
        smaller_gaps = LevelGaps(gaps.below * STEP_SAFETY, gaps.above * STEP_SAFETY)
        is_finite = dr.isfinite(self.slopes.lower + self.slopes.upper)
        is_finite &= dr.isfinite(self.min_second_derivative + self.max_second_derivative) & (
            self.reach > 0
        )
        is_free = is_finite & self.is_free(smaller_gaps, self.reach)
        return dr.select(is_free, self.reach, super().free_length(gaps))


class BottomUpLinearEnclosure(BottomUpQuadraticEnclosure):
    """The two lines that bound f along a path, from the bottom-up arithmetic of its formula.

    Source: Aydinlilar and Zanni 2023, section 5.2.
    """

    degree = 1


@dataclass(frozen=True)
class LongestOfEnclosure(Enclosure):
    """Several enclosures of the same function; the longest of the steps that they prove is taken.

    Source: Aydinlilar and Zanni 2023, section 4 ("mixed"). There, bounds of derivatives are used if
        they are tight, and bottom-up arithmetic if they are not.
    """

    enclosures: tuple[Enclosure, ...]

    kinds: ClassVar[tuple[type[Enclosure], ...]] = (
        QuadraticTaylorEnclosure, LinearTaylorEnclosure, BottomUpQuadraticEnclosure,
    )  # fmt: skip

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return all enclosures that the classes in `kinds` prove for f; None if there is none.

        function, slopes, length: f along the path, the range of its derivative at the start, and
            the length on which the enclosures are wanted.
        """
        candidates = [kind.from_restriction(function, slopes, length) for kind in cls.kinds]
        enclosures = tuple(enclosure for enclosure in candidates if enclosure is not None)
        return cls(enclosures) if enclosures else None

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the longest length that one of the enclosures proves; at least 0, even if one of
        them gives NaN. gaps: the differences between f at the start and the next levels."""
        longest: Real = type(gaps.above)(0)
        for enclosure in self.enclosures:
            longest = fmax(enclosure.free_length(gaps), longest)
        return fmax(longest, 0)


@dataclass(frozen=True)
class BandEnclosure(Enclosure):
    """An enclosure of F(s), the change of f along a path, between two lines: for 0 <= s <= reach

        offsets.lower + slopes.lower s <= F(s) <= offsets.upper + slopes.upper s.

    Proof of the step: F cannot reach the level above before the upper line does, nor the level
    below before the lower line does. At s = 0 the lines differ, although F(0) = 0. If a line's
    offset exceeds the gap to its level, nothing is proved, and the march tries a third of the
    length.
    """

    offsets: Interval
    slopes: SlopeRange
    reach: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the length on which the upper line stays below the level above, and the lower line
        above the level below. gaps: the differences between f at the start and these levels."""
        up = self._length_below(gaps.above, self.offsets.upper, self.slopes.upper)
        down = self._length_below(gaps.below, -self.offsets.lower, -self.slopes.lower)
        return fmax(fmin(up, down), 0)

    def _length_below(self, gap: Real, offset: Real, slope: Real) -> Real:
        """Return the length on which the line offset + slope s stays below the gap; 0 if nothing is
        proved."""
        no_level = gap == dr.inf
        remaining = gap - offset
        length = dr.select(slope > 0, remaining / slope * STEP_SAFETY, self.reach)
        is_valid = (remaining > 0) & dr.isfinite(slope)  # and not NaN
        return dr.select(no_level, self.reach, dr.select(is_valid, fmin(length, self.reach), 0))


class AffineEnclosure(BandEnclosure):
    """The two lines that bound f along a path, from revised affine arithmetic. A part of the length
    at its start may be proved even if the whole is not.

    Source: Fryazinov, Pasko and Comninos 2010, as Aydinlilar and Zanni 2023 compare with it.
    """

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the two lines from evaluating the formula of f with affine forms; None if f is no
        formula.

        function: f along the path. slopes: the range of its derivative at the start; not used.

        An affine form is center + slope e + error, with e from -1 at the start of the path to 1 at
        its end. So f rises by 2 slope on the length, and starts at center - slope.
        """
        if not isinstance(function, FormulaOnRay):
            return None
        form = _evaluate(function, AffineForm.along_ray(function.p, function.direction, length))
        # The bounds are of the change of f, so the value at the start is subtracted.
        start = _value(function)
        rate = 2 * form.slope / length
        line = Interval.point(form.center) + Interval.point(-form.slope)
        offsets = line + Interval(-form.error, form.error) - start
        slack = 4 * dr.epsilon(type(length)) * dr.abs(rate)
        return cls(offsets, SlopeRange(rate - slack, rate + slack), length)


class IntervalEnclosure(BandEnclosure):
    """The range of f on the whole length, from interval arithmetic: the whole length is proved to
    hold no level, or nothing is.

    Source: Mitchell 1990.
    """

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the range from evaluating the formula of f with intervals; None if f is no
        formula.

        function: f along the path. slopes: the range of its derivative at the start; not used.
        length: the length of the piece of the path.
        """
        if not isinstance(function, FormulaOnRay):
            return None
        # Without the jets at the start of the path, from which ranges would be narrowed.
        x, y, z = (
            dataclasses.replace(coordinate, jet_at_start=None)
            for coordinate in Jet.along_ray(function.p, function.direction, 0.0, length)
        )
        jet = _evaluate(function, (x, y, z))
        zero = 0 * length
        return cls(jet.value - _value(function), SlopeRange(zero, zero), length)


def _value(function: FormulaOnRay) -> Interval:
    """Return the range of f at the start of the path, from the formula evaluated with intervals."""
    return _evaluate(function, Jet.at_point(function.p)).value


def _evaluate(function: FormulaOnRay, coordinates: tuple[Any, Any, Any]) -> Any:
    """Return the value of a formula at coordinates that are numbers of any arithmetic, as a number
    of that arithmetic."""
    value = function.evaluator.formula(*coordinates)
    return coordinates[0].constant(float(value)) if isinstance(value, int | float) else value
