"""Enclosures of the literature that use ranges of the first two derivatives of a function f on the
whole length of a path (a ray), for comparison with `PiecewiseTaylorEnclosure`, from which they are
derived. An enclosure bounds F(s), the change of f from its value at the start of the path, at the
length s. The gap to a level (a value that rays look for) is its difference from f at the start.
"""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax
from harnack.enclosures.enclosure import PathPiece, SlopeRange
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Real
    from harnack.enclosures.enclosure import PathRestriction


class SinglePieceEnclosure(PiecewiseTaylorEnclosure, abc.ABC):
    """Base of the enclosures of the literature that use ranges of the derivatives of f on the whole
    length of a path, as one piece."""

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the enclosure from ranges on the piece from 0 to `length`. The result is never
        None.

        function: f along the path. slopes: the range of its derivative at the start.
        """
        return cls(slopes, function.derivative_ranges([0.0, length]))


class QuadraticTaylorEnclosure(SinglePieceEnclosure):
    """Two parabolas bound f along a path, from above and from below. They follow from the slope at
    the start and from the range of F'' on the whole length (F is the change of f).

    Source: Aydinlilar and Zanni 2023, section 6.1. Proof: that of `PiecewiseTaylorEnclosure`,
        without the line.
    """

    @classmethod
    def _advance_piece(
        cls, gap: Real, slope: Real, max_slope: Real, curvature: Real, length: Real
    ) -> tuple[Real, Real, Real]:
        """Advance the parabola over the piece, as the base class does it for the parabola and a
        line; the largest slope on the piece is not used."""
        del max_slope
        return super()._advance_piece(gap, slope, type(gap)(dr.inf), curvature, length)


class LinearTaylorEnclosure(SinglePieceEnclosure):
    """Two lines through the start bound f along a path, from above and from below. Their slopes are
    the ends of the range of F' on the whole length (F is the change of f).

    Source: Aydinlilar and Zanni 2023, section 4.1; the range of F' is used as it is. Proof: that of
        `PiecewiseTaylorEnclosure`, without the parabola.
    """

    @classmethod
    def _advance_piece(
        cls, gap: Real, slope: Real, max_slope: Real, curvature: Real, length: Real
    ) -> tuple[Real, Real, Real]:
        """Advance the line over the piece, as the base class does it for a parabola and the line;
        the slope at the start and the second derivative are not used."""
        del slope, curvature
        return super()._advance_piece(gap, max_slope, max_slope, type(gap)(0), length)


class SegmentTracingEnclosure(SinglePieceEnclosure):
    """The cone |F(s)| <= K s, where F is the change of f along a path and K bounds |F'| on its
    length: segment tracing.

    Source: Galin, Guerin, Paris and Peytavie 2020; Aydinlilar and Zanni 2023, equation 10.
    """

    @classmethod
    def from_restriction(
        cls, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> Self | None:
        """Return the enclosure from the largest |F'| on the whole length. The result is never None.

        function: f along the path. slopes: the range of its derivative at the start; not used.
        """
        (piece,) = function.derivative_ranges([0.0, length])
        max_slope = fmax(piece.slope_range.upper, -piece.slope_range.lower)
        # Second derivatives of 0 make the bounds the two lines of the cone.
        interval = SlopeRange(-max_slope, max_slope)
        return cls(interval, (PathPiece(piece.length, interval, 0.0, 0.0),))
