"""Where a field is not one smooth function whose level sets have no end.

Sheets: surfaces, such as triangles, across which a field jumps.

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

Boundary: curves at which every level set ends, such as those of an angle, which goes round them.

Detail: how closely a field is evaluated, where that can be chosen, and what is left out.

A sum over a tree takes clusters of far terms as a whole. The farther off these have to be, the less
is left out, and the longer it takes. Far from the surface much may be left out: the tracer begins
coarsely and asks for detail where what is left out makes steps shorter.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fields.field import Field

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


class Sheets:
    """What a field with sheets is asked for, and what those without answer.

    All of it may be asked for while a loop is being recorded; rays are o + t d with |d| = 1, and
    answers for lanes that are not active are not looked at.
    """

    has_sheets: bool = False
    """Whether f jumps across sheets. Then `next_crossing` and `between` are needed, and what
    `evaluate` promises is about f with the jumps taken out."""

    def next_crossing(
        self, o: Vec3, d: Vec3, after: Crossing, t_max: Real, active: Mask
    ) -> Crossing:
        """The first crossing strictly after another one, with t <= t_max.

        Crossings are ordered by (t, sheet): sheets crossed at the same t come one after the other
        by their index. NO_SHEET is the largest index, so that nothing follows it at the same t.
        Every crossing of a walk along the ray must come up in that order, at the same t and with
        the same jump, whatever the walk began with. Where there is none, t = inf, sheet =
        NO_SHEET, jump = 0.
        """
        del o, d, after, t_max, active
        return Crossing(float("inf"), NO_SHEET, 0.0, (0.0, 0.0, 0.0))

    def offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        """A number of this field's own at the start of a ray, handed back by `between`.

        The tracer adds the jump of every crossing that it passes. Crossings with t <= t_min are
        behind the start (`next_crossing` after (t_min, NO_SHEET)), all others ahead of it.
        """
        del o, d, t_min, active
        return 0.0

    def between(self, o: Vec3, d: Vec3, behind: Crossing, ahead: Crossing, offset: Real) -> Field:
        """The field as seen on the stretch of the ray between two successive crossings.

        `evaluate` of the field returned is asked at points p = o + t d with behind.t <= t <=
        ahead.t, to rounding. It gives the value continued along the stretch, *also at its ends*:
        at ahead.t what f is just before that sheet, at behind.t just behind that one, even where
        rounding puts p on the other side or the two t are equal. What it promises is about the
        smooth function that continues these values through all sheets; the tracer uses it on the
        stretch only.

        behind: the crossing last passed, or the start of the ray with sheet NO_SHEET.
        ahead: the next one, or t = inf and sheet NO_SHEET.
        offset: `offset` at the start of the ray plus all jumps since.
        """
        del o, d, behind, ahead, offset
        return cast("Field", self)

    def distance_to_sheets(self, p: Vec3) -> Real:
        """The distance from p to the nearest sheet, rounded down: lower bounds of distances rest on
        it. inf where there is none."""
        del p
        return float("inf")

    def nearest_sheet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestSheet | None:
        """The first sheet behind `after` = (order, index), nearer than the distance `limit`.

        Sheets are ordered by their distance from p, in whatever measure `NearestSheet.order` gives,
        then by index; from (-1, NO_SHEET) on, all come up, each once. The default, None, says
        nothing: distances then look for the nearest sheet alone, by how `distance_to_sheets` falls.
        """
        del p, after, limit, active
        return None

    def mesh_of_sheets(self) -> tuple[FloatArray, IntArray, bool] | None:
        """Vertices (n, 3) and faces (m, 3) of the mesh whose winding number f is, faces as often as
        they count, and whether f is a whole number everywhere off them; None if f is no winding
        number. Distances ask for it."""
        return None


class Parts:
    """What a field with parts is asked for, and what those without answer. `for_levels` comes
    first; the others may be asked for while a loop is being recorded."""

    has_parts: bool = False
    """Whether the surface is that of many level sets, each of a field of its own. Then `next_part`
    and `part_at` are needed."""

    def for_levels(self, levels: tuple[float, ...]) -> Field:
        """This field with boxes that hold the parts of these levels, to be prepared."""
        del levels
        return cast("Field", self)

    def next_part(
        self, o: Vec3, d: Vec3, after: PartEntry, start: Real, end: Real, active: Mask
    ) -> PartEntry:
        """The first box behind `after` that a ray enters at start <= t <= end.

        A ray that begins in a box enters it at `start`. Entries are ordered by (enter, part), and
        every box that the ray meets between `start` and `end` must come up in that order, once,
        after an entry at less than `start`. Where there is none, part = NO_PART.
        """
        del o, d, after, start, end, active
        return PartEntry(float("inf"), float("inf"), NO_PART)

    def part_at(self, index: Any) -> Field:
        """The field, in each lane another, whose level set the part with that index is. Its
        `evaluate` and `look` may be called for points of any size, promises hold in all space."""
        del index
        return cast("Field", self)


class Boundary:
    """What a field whose level sets end at curves is asked for, and what others answer."""

    @property
    def boundary_curves(self) -> tuple[FloatArray, ...]:
        """Closed curves (n, 3) at which level sets end; the first point is not repeated."""
        return ()

    def closest_on_boundary(self, p: Vec3) -> Vec3 | None:
        """The closest point of the curve in which every level set ends; None where none does.

        Only distances ask for it, while no loop is being recorded. Ends at `domain` do not count.
        """
        del p
        return None

    def change_along(self, p: FloatArray, q: FloatArray) -> FloatArray | None:
        """How an angle-valued f changes along straight segments from p to q (n, 3), followed as it
        goes round; None if only its values are known. Meshes ask for it on long edges."""
        del p, q
        return None


# A detail at which nothing is left out.
NO_TRUNCATION = 1e9


class Detail:
    """What a field of many details is asked for, and what one that has a single one answers."""

    has_detail: bool = False
    """Whether f can be evaluated more coarsely and more closely; then `at_detail` is needed."""

    coarsest_detail: float = 1.0
    """What detail 0 amounts to, as a detail in (0, 1]: see `at_detail`."""

    def at_detail(self, detail: Real) -> Field:
        """This field, evaluated so closely in each lane: 0 as coarsely as the field allows, 1 as
        `evaluate` does, more than 1 more closely.

        `Sample.truncation` falls about as detail^-3 and is 0 for a detail that is large enough.
        A coarse sample is as true as any: it states a larger `error`. The tracer asks for detail
        where that error matters.
        """
        del detail
        return cast("Field", self)

    def without_truncation(self, backend: Backend) -> Field:
        """This field, prepared for the backend, with nothing left out when it is evaluated."""
        if not self.has_detail:
            return cast("Field", self)
        closely: Any = copy.copy(self)
        closely.evaluate = self.at_detail(backend.Float(NO_TRUNCATION)).evaluate
        return closely
