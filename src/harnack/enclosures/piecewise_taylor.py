"""Enclosures of a function f along a path (a ray) from ranges of its first two derivatives on
pieces of the path. An enclosure bounds F(s), the change of f from its value at the start of the
path, at the length s. The gap to a level (a value that rays look for) is its difference from f at
the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures.enclosure import STEP_SAFETY, Enclosure, LevelGaps, PathPiece, SlopeRange
from harnack.enclosures.parabola import first_reach

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import PathRestriction


@dataclass(frozen=True)
class PiecewiseTaylorEnclosure(Enclosure):
    """An enclosure of F(s), the change of f along a path at the length s, from ranges of F' and F''
    on successive pieces of the path.

    slopes: the range of F' at s = 0.
    pieces: the pieces, in their order along the path.

    Proof of the step. Take a level above. At the start of a piece let F <= A and F' <= D, and on
    the piece let F' <= k and F'' <= c. Then F <= A + min(k s, D s + c s^2/2) on the piece, s
    measured from its start. The next piece starts with the value of this bound at the end of the
    piece, and with a slope of at most min(D + c w, k), where w is the length of the piece. The
    first s at which the bound reaches the gap is the root of a line or of a parabola. For the level
    below the same holds of -F. With exact ranges the bound converges to F with the third power of
    the length of the pieces, so that one sample may prove much of a ray.

    Source: new in harnack. With one piece it is the tighter of the linear and the quadratic Taylor
        form (Aydinlilar and Zanni 2023, section 6.1).
    """

    slopes: SlopeRange
    pieces: tuple[PathPiece, ...]

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the enclosure from ranges on a few pieces of the path up to `length`. The result
        is never None.

        function: f along the path.
        slopes: the range of its derivative at the start.
        length: the length of the path on which the enclosure is wanted.

        The first two pieces are equally long; each of the others is twice as long as the one before
        it.
        """
        count = function.piece_count
        knots = [length * 2.0 ** (k + 1 - count) for k in range(count)]
        return cls(slopes, function.derivative_ranges([0.0, *knots]))

    @property
    def reach_growth(self) -> float:
        return max(2.0, float(len(self.pieces)))

    def free_length(self, gaps: LevelGaps) -> Real:
        """Return the shorter of the lengths on which F does not reach the level above and the level
        below. gaps: the differences between f at the start and these levels."""
        # With a single level, one side is enough: the one with the finite gap.
        if gaps.is_one_sided:
            rises = gaps.below == dr.inf
            reach, is_free = self._free_on_pieces(fmin(gaps.above, gaps.below), rises)
        else:
            # True for the level above, False for the level below.
            up, is_free_above = self._free_on_pieces(gaps.above, True)
            down, is_free_below = self._free_on_pieces(gaps.below, False)
            reach, is_free = fmin(up, down), is_free_above & is_free_below
        # The end of the last piece is exact: shortened, a ray that misses would need one more
        # sample.
        reach = fmax(reach, 0)
        return dr.select(is_free, reach, reach * STEP_SAFETY)

    def arrives(self, gaps: LevelGaps, length: Real) -> Mask:
        """Return the mask of lanes on which f is proved to take a level for some 0 <= s <= length.

        gaps: the differences between f at the start and the next levels.

        Proof. On the first piece F' is known, so F is continuous, and F(s) is at most s times the
        upper end of the range of F'. If that end is negative, F falls to the level below by s =
        gap/|end|. For the level above the same holds with the lower end.
        """
        first = self.pieces[0]
        reach = fmin(first.length, length) * STEP_SAFETY
        falls = -first.slope_range.upper * reach >= gaps.below
        return falls | (first.slope_range.lower * reach >= gaps.above)

    def _free_on_pieces(self, gap: Real, rises: Mask | bool) -> tuple[Real, Mask]:
        """Return the length on which F does not reach the level above, or the level below, and the
        mask of lanes on which this is the length of all pieces.

        gap: the difference in value to that level.
        rises: True for the level above. Otherwise -F is bounded in place of F.

        The length ends at the first s at which the bound of F reaches the gap.
        """

        def one_sided(upper: Real, lower: Real) -> Real:
            """Return the upper bound of a quantity of F (a slope or a second derivative) that lies
            between `lower` and `upper`; if the level is below, the upper bound -lower of the same
            quantity of -F."""
            return dr.select(rises, upper, -lower)

        slope = one_sided(self.slopes.upper, self.slopes.lower)
        no_level = gap == dr.inf
        remaining = dr.select(no_level, 0, gap)  # the rest of the gap at the start of the piece
        free_so_far = type(gap)(0)
        is_free = gap >= 0  # and not NaN
        for piece in self.pieces:
            max_slope = one_sided(piece.slope_range.upper, piece.slope_range.lower)
            curvature = one_sided(piece.max_second_derivative, piece.min_second_derivative)
            slope, reach, remaining = self._advance_piece(
                remaining, slope, max_slope, curvature, piece.length
            )
            reach = dr.select(no_level, piece.length, reach)
            free_so_far = dr.select(is_free, free_so_far + reach, free_so_far)
            is_free &= reach >= piece.length
        return free_so_far, is_free

    @classmethod
    def _advance_piece(
        cls, gap: Real, slope: Real, max_slope: Real, curvature: Real, length: Real
    ) -> tuple[Real, Real, Real]:
        """Advance the bound of F over one piece.

        gap: the gap that remains at the start of the piece.
        slope: the largest F' at the start.
        max_slope, curvature: the largest F' and F'' on the piece.
        length: the length of the piece.

        Returns the largest F' at the end of the piece, the part of the length on which the gap is
        not reached, and the gap that remains at the end.
        """
        # A range that is NaN is unknown.
        slope = dr.select((slope <= max_slope) | dr.isnan(max_slope), slope, max_slope)
        # The lengths on which the line and the parabola stay below the gap. A NaN slope gives 0.
        by_line = dr.select(max_slope > 0, gap / max_slope, dr.select(max_slope <= 0, dr.inf, 0))
        by_line = dr.select(gap > 0, by_line, 0)
        by_parabola = first_reach(gap, slope, curvature)
        reach = fmin(fmax(by_parabola, by_line) * STEP_SAFETY, length)
        # From here on, the rise of F on the whole piece: by the parabola, by the line, and the
        # smaller of both. The two terms of the parabola may cancel, so the rounding error is that
        # of each term, not that of their sum.
        epsilon = 4 * float(dr.epsilon(type(gap)))
        curved, linear = 0.5 * length * length * curvature, slope * length
        by_parabola = (curved + linear) + epsilon * (dr.abs(curved) + dr.abs(linear))
        rise = fmin(by_parabola, max_slope * length + epsilon * dr.abs(max_slope * length))
        slope = dr.fma(curvature, length, slope)
        # The slope at the end is rounded up.
        return dr.fma(0.25 * epsilon, dr.abs(slope), slope), reach, gap - rise
