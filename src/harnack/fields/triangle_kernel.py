"""What one triangle adds to the winding number near it: value, gradient, Hessian, certificate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.fields.edge_field import edge_field
from harnack.fields.edge_hessian import SymmetricSum, edge_rates
from harnack.tree.nearest import squared_distance_to_segment
from harnack.tree.triangles import EDGES, PARITY, corners_of

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

# How much of a factor's terms must cancel to count by itself.
_CANCELS = 16.0
_PAIRS = ((0, 1, 1.0), (1, 2, 1.0), (0, 2, -1.0))


@dataclass(frozen=True)
class NearTriangle:
    """A triangle of a record, seen from x: corners less x, and their lengths."""

    corners: tuple[Vec3, Vec3, Vec3]
    lengths: tuple[Real, Real, Real]
    parity: Real
    inverse: tuple[Real, Real, Real]

    @classmethod
    def of(cls, row: list[Real], x: Vec3) -> NearTriangle:
        """From the numbers of a record (`tree.triangles`)."""
        p, q, r = corners_of(row, type(x))
        corners = (p - x, q - x, r - x)
        lengths = (dr.norm(corners[0]), dr.norm(corners[1]), dr.norm(corners[2]))
        return cls(corners, lengths, row[PARITY], (row[EDGES], row[EDGES + 1], row[EDGES + 2]))

    def factor(self) -> tuple[Real, Real]:
        """re + i im, its argument half the solid angle (van Oosterom and Strackee 1983)."""
        (a, b, c), (la, lb, lc) = self.corners, self.lengths
        re = dr.fma(
            la * lb, lc, dr.fma(dr.dot(a, b), lc, dr.fma(dr.dot(b, c), la, dr.dot(c, a) * lb))
        )
        # (b - a) x (c - a) does not cancel where all three are far away and close together.
        return re, self.parity * dr.dot(a, dr.cross(b - a, c - a))

    def unsure(self, re: Real, im: Real, epsilon: float) -> Real:
        """What rounding of the factor may do to the winding number.

        Its terms are la lb lc and la |b-a||c-a| at most. Beside two nearly parallel edges they
        cancel, and so its argument may turn by their rounding over its length, by pi at most.
        Where little cancels, what there is belongs to the rounding of a sum.
        """
        (a, b, c), (la, lb, lc) = self.corners, self.lengths
        terms = la * dr.fma(lb, lc, dr.norm(b - a) * dr.norm(c - a))
        cancelled = terms / (dr.abs(re) + dr.abs(im))
        turned = dr.select(cancelled < 0.0625 / epsilon, 8 * epsilon * cancelled, 0.5)
        return dr.select(cancelled <= _CANCELS, 0, turned)

    def gradient(self) -> Vec3:
        """Of the solid angle: Biot and Savart's field of the three edges (paper, Eq. 11)."""
        vector = cast("Any", type(self.corners[0]))
        total = vector(0)
        for i, j, sign in _PAIRS:
            a, b, la, lb = self.corners[i], self.corners[j], self.lengths[i], self.lengths[j]
            c, weight = edge_field(a, b, la, lb)
            total = dr.fma(vector(sign * weight), c, total)
        return self.parity * total

    def add_hessian(self, total: SymmetricSum, active: Any) -> SymmetricSum:
        """The Hessian of the solid angle added to a sum, where active."""
        sign = dr.select(active, self.parity, 0)
        for (i, j, turn), inverse in zip(_PAIRS, self.inverse, strict=True):
            c, rate = edge_rates(self.corners[i], self.corners[j] - self.corners[i], inverse)
            total = total.plus(dr.select(active, sign * turn * c, 0), dr.select(active, rate, 0))
        return total

    def squared_distances(self) -> tuple[Real, Real, Real]:
        """To the three edges, in the order of the record's inverse lengths."""
        first, second, third = (
            squared_distance_to_segment(
                self.corners[i], self.corners[j] - self.corners[i], self.inverse[k]
            )
            for k, (i, j, _) in enumerate(_PAIRS)
        )
        return first, second, third
