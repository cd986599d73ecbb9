"""Sheets: surfaces, such as triangles, across which a field jumps.

Off its sheets such a field is as smooth as any other. Along a ray the sheets cut the field into
*stretches*; on each of them the values, continued up to and onto both of its ends, are a smooth
function, with knowledge about it, and the tracer marches it as it does any field. Where a ray
crosses a sheet, the values just before and just behind it are compared with the levels.

A field with sheets is real-valued (no period), says `has_sheets = True`, and answers two
questions about rays o + t d, |d| = 1 (see `Field`): `next_crossing`, which sheet comes next, and
`between`, what the field looks like on the stretch between two crossings. `offset` is there for
fields that count jumps.

Parts: surfaces that are made of many level sets, each of a function of its own, each in a box.

No function of space has all of them for one level set, as a polygon mesh shows: each of its faces
is a level set of the solid angle of that face. Along a ray the first hit is the first of all parts,
so the tracer marches those whose boxes the ray enters, one after the other in the order in which it
enters them, and no farther than the first hit so far.

A field with parts says `has_parts = True` and answers two questions (see `Field`): `next_part`,
which part comes next, and `part_at`, the field whose level set that is. The parts share the period,
the levels and the domain of the field. Its own `evaluate` has no meaning.
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


NO_PART = 0xFFFFFFFF
"""The index of no part, larger than that of any."""


@dataclass(frozen=True)
class PartEntry:
    """Where rays enter the box that a part is proved to lie in.

    enter, leave: ray parameters; inf where no box is entered.
    part: its index, a Dr.Jit UInt32; NO_PART where there is none.
    """

    enter: Real
    leave: Real
    part: Any
