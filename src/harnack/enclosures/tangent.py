"""The tangent: a convex function stays above it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.enclosures.enclosure import ROUND_DOWN, Enclosure, Gaps, Slopes

if TYPE_CHECKING:
    from harnack.backend import Real


@dataclass(frozen=True)
class Tangent(Enclosure):
    """F(s) >= slopes.low s for all s >= 0: f is convex along the path.

    Proof. A convex function lies above its tangents, so f does not fall to a level g below before
    g/|slope|, and never if it rises here. Nothing is said of levels above. f itself must be convex;
    that the solid is, and f a bound of its distance, is not enough (Hart 1996, equation 21: 1 -
    e^-d is none). The lower end rises with the slope.
    """

    slopes: Slopes

    def step(self, gaps: Gaps) -> Real:
        falls = -self.slopes.low
        down = dr.select(falls > 0, gaps.down / falls, dr.select(falls <= 0, dr.inf, 0))
        down = dr.select(gaps.down > 0, down * ROUND_DOWN, 0)
        return dr.select(gaps.up == dr.inf, fmax(down, 0), 0)
