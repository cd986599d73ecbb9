"""Volumes that are proved to contain level sets of weighted sums of fields, w_1 f_1 + ... + w_n f_n
+ c, from the volumes of their terms f_i (`sums.FieldSum`, `combining.FormulaSum`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.fields.operands import far_from_zero
from harnack.geometry.clip_volumes import box_around_volumes

if TYPE_CHECKING:
    from harnack.fields.field import Field
    from harnack.geometry import Volume

__all__ = ["WeightedTerms"]


@dataclass(frozen=True, eq=False)
class WeightedTerms:
    """The terms of a sum.

    terms, weights, constant: the fields f_i, the numbers w_i and c.
    period: that of the sum; None if it is real-valued.
    """

    terms: tuple[Field, ...]
    weights: tuple[float, ...]
    constant: float
    period: float | None = None

    def levels_of_single(self, levels: tuple[float, ...]) -> tuple[float, ...] | None:
        """The levels of the only term whose level sets are those of the sum; None if there are
        several terms, or if the weight is 0."""
        weight, *others = self.weights
        if others or weight == 0:
            return None
        return tuple((level - self.constant) / weight for level in levels)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for levels of the sum that its only term does not have."""
        inner = self.levels_of_single(levels)
        if inner is not None:
            self.terms[0].validate_levels(inner)

    def extent(self, levels: tuple[float, ...], domain: Volume | None) -> Volume | None:
        """A volume that contains the level sets: of a single term, that of its own level sets; of
        several terms, the domain or, without a domain, a box around volumes that are proved for
        each of them. None if none is known.

        domain: that of the sum.
        """
        inner = self.levels_of_single(levels)
        if inner is not None:
            return self.terms[0].extent(inner)
        if domain is not None:
            return domain
        volumes = [volume for level in levels for volume in self._extents_of_terms(level)]
        known = [volume for volume in volumes if volume is not None]
        return box_around_volumes(known) if known and len(known) == len(volumes) else None

    def _extents_of_terms(self, level: float) -> list[Volume | None]:
        """Volumes that together contain the level set of a level; None among them if one is not
        known, as for terms that do not fall off with the distance.

        Proof. Let g be the difference between the level and the constant. Where the sum of n terms
        takes the level, one of the w_i f_i is at least g/n, if g > 0; at most g/n, if g < 0. If a
        term is angle-valued, g is reduced by the nearest multiple of the period, and one of the w_i
        f_i differs from each multiple of its own period by at least |g|/n: otherwise the sum would
        differ from a multiple of the period by less than |g|. Where a term has such values, it has
        these levels, or is on one side of them (`bounded_side_extent`).
        """
        used = [pair for pair in zip(self.terms, self.weights, strict=True) if pair[1] != 0]
        gap = level - self.constant
        if self.period is not None:
            gap = math.remainder(gap, self.period)
        if gap == 0 or not used:
            return [None]
        distance_of_all = abs(gap) / len(used)
        sign = None if self.period is not None else math.copysign(1.0, gap)
        return [
            far_from_zero(term, weight, distance_of_all, sign)
            for term, weight in used
            # Otherwise no value differs so much from the nearest multiple of the period.
            if term.period is None or distance_of_all <= abs(weight) * 0.5 * term.period
        ]
