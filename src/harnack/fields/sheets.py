"""Sheets: surfaces, such as triangles, across which a field jumps.

Off its sheets such a field is as smooth as any other. Along a ray the sheets cut the field into
*stretches*; on each of them the values, continued up to and onto both of its ends, are a smooth
function, with knowledge about it, and the tracer marches it as it does any field. Where a ray
crosses a sheet, the values just before and just behind it are compared with the levels.

A field with sheets is real-valued (no period), says `has_sheets = True`, and answers two
questions about rays o + t d, |d| = 1 (see `Field`): `next_crossing`, which sheet comes next, and
`between`, what the field looks like on the stretch between two crossings. `offset` is there for
fields that count jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3

NO_SHEET = 0xFFFFFFFF
"""The index of no sheet, larger than that of any."""


@dataclass(frozen=True)
class Crossing:
    """Where rays cross sheets; also the two ends of rays, which lie on no sheet.

    t: ray parameter; inf where no sheet is crossed.
    sheet: index of the sheet, a Dr.Jit UInt32; NO_SHEET where there is none.
    jump: f just behind it minus f just before it, along the ray; 0 where there is none.
    normal: (3,) unit, of the sheet, pointing to its side of larger f: (normal . d) jump >= 0.
        Of no meaning where there is no sheet.
    """

    t: Real
    sheet: Any
    jump: Real
    normal: Vec3


@dataclass(frozen=True)
class NearestSheet:
    """The nearest sheet to points x, of those that were asked about (`Field.nearest_sheet`).

    order: by this and then by index sheets are ordered; it grows with the distance. inf where
        there is no sheet.
    sheet: index of the sheet, a Dr.Jit UInt32; NO_SHEET where there is none.
    offset: (3,) from x to the nearest point of the sheet.
    normal: (3,) unit, of the sheet there, to either side; any direction where it has none.
    is_inner: whether that point lies inside the sheet: a line through it along the normal crosses
        the sheet there, whatever rounding does. False on a sheet's rim.
    """

    order: Real
    sheet: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask
