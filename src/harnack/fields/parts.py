"""Parts: surfaces that are made of many level sets, each of a function of its own, each in a box.

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
    from harnack.backend import Real

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
