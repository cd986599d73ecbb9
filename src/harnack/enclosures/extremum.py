"""The greatest of several functions: unions, intersections and differences of solids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Gaps
from harnack.enclosures.proofs import any_covers, longest_step

if TYPE_CHECKING:
    from harnack.backend import Mask, Real


@dataclass(frozen=True)
class Part:
    """One of several functions, where it was looked at.

    least_below, most_below: how far its value is below the greatest, up to rounding.
    enclosures: of its movement along the path.
    """

    least_below: Real
    most_below: Real
    enclosures: tuple[Enclosure, ...]


@dataclass(frozen=True)
class Greatest(Enclosure):
    """The movement of max f_i, from enclosures of the movements of all f_i.

    Proof. The greatest rises by a gap g only where some f_i rises by g plus what it is below the
    greatest: as far as none of them does, each by its own proof, it does not. It falls by g only
    where all f_i are that low: as far as one of them proves that it has not fallen so far, it has
    not. Nothing is demanded of the proofs of the parts, which may be of different kinds.
    """

    parts: tuple[Part, ...]

    def step(self, gaps: Gaps) -> Real:
        none = type(gaps.up)(dr.inf)
        up, down = none, type(gaps.up)(0)
        for part in self.parts:
            rise, fall = self._gaps(gaps, part)
            up = fmin(longest_step(part.enclosures, rise), up)
            fallen = longest_step(part.enclosures, fall)
            # A part that may be past the level already proves nothing, whatever its slope.
            down = fmax(dr.select(fall.down > 0, fallen, 0), down)
        up = dr.select(gaps.up == dr.inf, none, up)
        down = dr.select(gaps.down == dr.inf, none, down)
        reach = fmin(up, down)
        return dr.select(reach == dr.inf, self._reach(none), reach)

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        up, down = gaps.up == gaps.up, gaps.down == dr.inf
        for part in self.parts:
            rise, fall = self._gaps(gaps, part)
            up &= any_covers(part.enclosures, rise, length)
            down |= (fall.down > 0) & any_covers(part.enclosures, fall, length)
        return (up | (gaps.up == dr.inf)) & down

    def _reach(self, none: Real) -> Real:
        """How far something is known at all."""
        reach = none
        for part in self.parts:
            reach = fmin(longest_step(part.enclosures, Gaps(none, none)), reach)
        return reach

    @staticmethod
    def _gaps(gaps: Gaps, part: Part) -> tuple[Gaps, Gaps]:
        """How far the part must rise, or fall, for the greatest to meet a level."""
        none = type(gaps.up)(dr.inf)
        return (
            Gaps(none, gaps.up + part.least_below, is_one_sided=True),
            Gaps(fmax(gaps.down - part.most_below, 0), none, is_one_sided=True),
        )


@dataclass(frozen=True)
class Negated(Enclosure):
    """The movement of -f: that of f with the levels above and below exchanged."""

    inner: Enclosure

    def step(self, gaps: Gaps) -> Real:
        return self.inner.step(gaps.exchanged())

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        return self.inner.covers(gaps.exchanged(), length)


@dataclass(frozen=True)
class Stretched(Enclosure):
    """The movement of factor f along a path that is passed `speed` times as fast as `inner` says.

    Proof. The length s of the path is the length speed s of the one that `inner` is about, and a
    gap g of factor f is a gap g/factor of f. speed and factor, positive, are known to within a few
    roundings, by which steps are shortened.
    """

    inner: Enclosure
    speed: Real
    factor: Real

    def step(self, gaps: Gaps) -> Real:
        return self.inner.step(self._gaps(gaps)) / self.speed * ROUND_DOWN

    def covers(self, gaps: Gaps, length: Real) -> Mask:
        return self.inner.covers(self._gaps(gaps), length * self.speed / ROUND_DOWN)

    def _gaps(self, gaps: Gaps) -> Gaps:
        share = ROUND_DOWN / self.factor
        down, up = _scaled(gaps.down, share), _scaled(gaps.up, share)
        return Gaps(down, up, gaps.is_one_sided)


def _scaled(gap: Real, share: Real) -> Real:
    """The gap times a positive number; a level stays one, however far away it comes to lie."""
    largest = type(gap)(dr.largest(type(gap)))
    return dr.select(gap == dr.inf, gap, fmin(largest, gap * share))
