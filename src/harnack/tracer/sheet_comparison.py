"""What a look at the end of a ray interval tells about the sheet there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.enclosures import Gaps, TargetLevels
from harnack.fields.sheets import NO_SHEET, Crossing
from harnack.tracer.tolerance import Status

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

ON_SHEET = max(Status) + 1
"""Status of a ray that hit a sheet, until `SheetTracer` turns it into a plain HIT."""


@dataclass(frozen=True)
class SheetComparison:
    """Result of comparing a sample with the sheet at the end of its ray interval.

    has_crossing: the interval ends at a sheet.
    at_crossing: the sample is accepted and lies there, at the end of the interval.
    is_hit: besides, a level lies between the values on both sides, up to the total error.
    gaps: to the levels below and above, of the value behind the sheet if `at_crossing`.
    normal: of the sheet.
    """

    has_crossing: Mask
    at_crossing: Mask
    is_hit: Mask
    gaps: Gaps
    normal: Vec3

    def mark(self, status: Any, gradient: Vec3) -> tuple[Any, Vec3]:
        """Status and gradient, those of the sheet where it was hit."""
        marked = type(status)(dr.select(self.is_hit, ON_SHEET, status))
        return marked, dr.select(self.is_hit, self.normal, gradient)


def compare_with_sheet(
    ahead: Crossing, there: Mask, value: Real, total_error: Real, levels: TargetLevels
) -> SheetComparison:
    """Compare samples that are proved, at the crossing where `there` holds, with the value before
    it.

    The sheet is the surface if a level lies between the values on its two sides. They are known
    up to `total_error`, and a level within that of either counts as between: such a sheet is the
    surface or just fails to be, and its points are no farther than rounding from the level. To
    decide the other way could lose a surface, for the march has proved that the level is not met
    *before* the sheet, which rounding may contradict by as much. Sheets at the same t count as one,
    with the sum of their jumps (`SheetTracer._together`).
    """
    has_crossing = ahead.sheet != NO_SHEET
    at_crossing = has_crossing & there
    behind = value + dr.select(at_crossing, ahead.jump, 0)
    low, high = fmin(value, behind) - total_error, fmax(value, behind) + total_error
    is_hit = at_crossing & (levels.gaps(low).up <= high - low)
    return SheetComparison(has_crossing, at_crossing, is_hit, levels.gaps(behind), ahead.normal)
