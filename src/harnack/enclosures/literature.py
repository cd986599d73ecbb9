"""Proofs of the literature for fields given by a formula, for comparison with `Pieces`.

Parabolas come from the bottom-up arithmetic of `harnack.arithmetic.Parabolas`, bands from affine
forms and from intervals. All of them prove steps; benchmarks measure how many a ray takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import drjit as dr

from harnack.arithmetic import Affine, Interval, Jet, Parabolas
from harnack.backend.elementary import fmax, fmin
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Evaluable, Gaps, Slopes
from harnack.enclosures.parabola import Parabola
from harnack.enclosures.piecewise_taylor import LinearTaylor, QuadraticTaylor

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Real, Vec3
    from harnack.enclosures.enclosure import Restriction


@dataclass(frozen=True)
class BottomUpQuadratic(Parabola):
    """The parabolas that a formula's arithmetic proves.

    Source: Aydinlilar and Zanni 2023, section 6.2. Proof: that of `Parabolas`, then of `Parabola`.
    """

    degree: ClassVar[int] = 2

    @classmethod
    def along(cls, function: Restriction, slopes: Slopes, length: Real) -> Self | None:
        if not isinstance(function, Evaluable):
            return None
        made = _parabolas(function, length, cls.degree)
        (a, b), (c, d) = made.bounds
        return cls(Slopes(a, c), 2 * b, 2 * d, length)

    def step(self, gaps: Gaps) -> Real:
        # All of the length, not shortened for rounding: else a ray that misses needs one more
        # sample.
        nearer = Gaps(gaps.down * ROUND_DOWN, gaps.up * ROUND_DOWN)
        known = dr.isfinite(self.slopes.low + self.slopes.high)
        known &= dr.isfinite(self.least_curvature + self.most_curvature) & (self.reach > 0)
        free = known & self.covers(nearer, self.reach)
        return dr.select(free, self.reach, super().step(gaps))


class BottomUpLinear(BottomUpQuadratic):
    """The lines that a formula's arithmetic proves.

    Source: Aydinlilar and Zanni 2023, section 5.2.
    """

    degree = 1


@dataclass(frozen=True)
class Mixed(Enclosure):
    """The longest step that one of several proofs gives for one function.

    Source: Aydinlilar and Zanni 2023, section 4 ("mixed"): bounds of derivatives where they are
    tight, bottom-up arithmetic where they are not.
    """

    several: tuple[Enclosure, ...]

    kinds: ClassVar[tuple[type[Enclosure], ...]] = (
        QuadraticTaylor, LinearTaylor, BottomUpQuadratic,
    )  # fmt: skip

    @classmethod
    def along(cls, function: Restriction, slopes: Slopes, length: Real) -> Self | None:
        made = [kind.along(function, slopes, length) for kind in cls.kinds]
        several = tuple(one for one in made if one is not None)
        return cls(several) if several else None

    def step(self, gaps: Gaps) -> Real:
        longest: Real = type(gaps.up)(0)
        for one in self.several:
            longest = fmax(one.step(gaps), longest)
        return fmax(longest, 0)


@dataclass(frozen=True)
class Band(Enclosure):
    """offsets.low + slopes.low s <= F(s) <= offsets.high + slopes.high s, for 0 <= s <= reach.

    Proof of the step: F cannot reach the gap before the upper line does. A band is not exact at
    s = 0: where its offset exceeds the gap it proves nothing, and the march asks again for a third
    of the length.
    """

    offsets: Interval
    slopes: Slopes
    reach: Real

    def step(self, gaps: Gaps) -> Real:
        up = self._free(gaps.up, self.offsets.high, self.slopes.high)
        down = self._free(gaps.down, -self.offsets.low, -self.slopes.low)
        return fmax(fmin(up, down), 0)

    def _free(self, gap: Real, offset: Real, slope: Real) -> Real:
        none = gap == dr.inf
        left = gap - offset
        reach = dr.select(slope > 0, left / slope * ROUND_DOWN, self.reach)
        known = (left > 0) & dr.isfinite(slope)  # and not NaN
        return dr.select(none, self.reach, dr.select(known, fmin(reach, self.reach), 0))


class AffineBand(Band):
    """The band of revised affine arithmetic: a front part of the length may be proved free where
    the whole is not.

    Source: Fryazinov, Pasko and Comninos 2010, as Aydinlilar and Zanni 2023 compare with it.
    """

    @classmethod
    def along(cls, function: Restriction, slopes: Slopes, length: Real) -> Self | None:
        if not isinstance(function, Evaluable):
            return None
        form = function.through(lambda p, d: Affine.along(p, d, length))
        start = _value(function)
        rate = 2 * form.slope / length
        line = Interval.exactly(form.center) + Interval.exactly(-form.slope)
        offsets = line + Interval(-form.error, form.error) - start
        slack = 4 * dr.epsilon(type(length)) * dr.abs(rate)
        return cls(offsets, Slopes(rate - slack, rate + slack), length)


class IntervalRange(Band):
    """The range of interval arithmetic on the whole length: all of it is free, or nothing is known.

    Source: Mitchell 1990.
    """

    @classmethod
    def along(cls, function: Restriction, slopes: Slopes, length: Real) -> Self | None:
        if not isinstance(function, Evaluable):
            return None
        made = function.through(lambda p, d: Jet.along(p, d, 0.0, length, anchored=False))
        zero = 0 * length
        return cls(made.value - _value(function), Slopes(zero, zero), length)


def _parabolas(function: Evaluable, length: Real, degree: int) -> Parabolas:
    return function.through(lambda p, d: Parabolas.along(p, d, length, degree=degree))


def _value(function: Evaluable) -> Interval:
    """f at the start of the path."""

    def here(p: Vec3, direction: Vec3) -> tuple[Jet, Jet, Jet]:
        del direction
        return Jet.at_point(p)

    return function.through(here).value
