"""Rays through fields that jump: from one crossing of a sheet to the next.

Between two crossings the field is continuous, and the marching loop proves that stretch as it
proves any ray. What is added here is which stretch comes next, and when a sheet is the surface.

A smooth hit is a point within tolerance of a level of the function that continues the stretch. Its
level set may end at a sheet, so within tolerance of where it does a ray may hit although the sheet
cuts the level off: mostly near singular edges, where gradients grow without limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_component
from harnack.fields.sheets import NO_SHEET, Crossing
from harnack.tracer.tolerance import Status

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.certify import Levels
    from harnack.fields.field import Field

# base, step, reach, value, gradient, excess, evaluations, detail, status, active: see
# `PreparedLevelSet._advance`.
State: TypeAlias = "tuple[Any, ...]"
REACH, EVALUATIONS, STATUS, ACTIVE = 2, 6, 8, 9

# Sheets are at the same place if they are no farther apart than so many roundings of coordinates,
# and the cosine of the angle between them is larger than the second; of rays that graze them, as if
# the third were the sine of the angle to them.
_SAME, _PARALLEL, _STEEP = 2.0, 0.999, 1 / 64

ON_SHEET = max(Status) + 1
"""Status of a ray that hit a sheet, until `Walk` turns it into a plain HIT."""


class March(Protocol):
    """The marching loop, for a field on a stretch that ends at `stop`, at the crossing `ahead` if
    there is one. A lane that passes its crossing ends as a miss."""

    def __call__(self, field: Field, stop: Real, ahead: Crossing, state: State) -> State: ...


@dataclass(frozen=True)
class Walk:
    """Rays through a field with sheets, |d| = 1, and how to march one stretch of them."""

    backend: Backend
    field: Field
    o: Vec3
    d: Vec3
    start: Real
    end: Real
    max_steps: int
    overstep: float
    march: March

    def run(self, state: State) -> tuple[State, Any]:
        """The end state of rays, and the index of the sheet that each hit (NO_SHEET: none).

        Proof that no hit is missed: crossings come in order, so the stretches cover the ray. On
        each of them the field is the continuous one that `march` sees, up to and including its
        last point, where the value behind the sheet is compared with that before it; from there
        it goes on with the step that the value behind the sheet allows. So the part of the ray
        up to `base` is free of smooth levels, and every sheet on it was looked at.

        The walk begins just before `start`, so that a sheet on the very start is looked at.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        before = real(self.start * (1 - self.backend.epsilon) - 1e-30)
        offset = real(self.field.offset(self.o, self.d, before, state[ACTIVE]))
        outer = (offset, before, count(NO_SHEET), real(0), vector(0), *state)
        outer = loop(outer, self._stretch, "harnack stretches")
        sheet, state = outer[2], outer[5:]
        status = state[STATUS]
        on_sheet = status == ON_SHEET
        sheet = dr.select(on_sheet, sheet, count(NO_SHEET))
        status = dr.select(on_sheet, count(int(Status.HIT)), status)
        return (*state[:STATUS], status, state[ACTIVE]), sheet

    def _stretch(self, offset: Real, *outer: Any) -> tuple[Any, ...]:
        """One stretch: to the next crossing or the end of the ray, or to a hit."""
        count = self.backend.UInt32
        behind, state = Crossing(*outer[:4]), outer[4:]
        ahead, last = self._together(self._next(behind, self.end, state[ACTIVE]), state[ACTIVE])
        stops = ahead.sheet != NO_SHEET
        stop = dr.select(stops, ahead.t, self.end)
        base, _, reach = state[:3]
        # The last step may already have proved the rest of the ray.
        active = state[ACTIVE] & (stops | (base + reach < stop))
        step = fmin(self.overstep * reach, stop - base)
        state = (base, step, *state[REACH:ACTIVE], active)
        field = self.field.between(self.o, self.d, behind, ahead, offset)
        state = self.march(field, stop, ahead, state)
        status = state[STATUS]
        passed = active & stops & (status == int(Status.MISS))
        spent = passed & (state[EVALUATIONS] >= self.max_steps)
        status = dr.select(spent, count(int(Status.OUT_OF_STEPS)), status)
        offset = dr.select(passed, offset + ahead.jump, offset)
        # A sheet that was hit is the one to be named; one that was passed, the last of all there.
        t, sheet = dr.select(passed, last.t, ahead.t), dr.select(passed, last.sheet, ahead.sheet)
        crossing = (t, sheet, ahead.jump, ahead.normal)
        return (offset, *crossing, *state[:STATUS], status, passed & ~spent)

    def _together(self, first: Crossing, active: Mask) -> tuple[Crossing, Crossing]:
        """All crossings at the t of the first as one, and the last of them.

        A ray through an edge or a vertex crosses several sheets at once, in no order of theirs:
        what they do to f there is the sum of their jumps, and between them there is nothing. So do
        rays through sheets in one plane: those that lie closer behind each other than coordinates
        are rounded are at the same t, for their order is that of rounding. The sheet named is the
        first one that jumps as all of them together do.
        """
        real, count = self.backend.Float, self.backend.UInt32
        size = largest_component(self.o)
        close = _SAME * self.backend.epsilon * (size + first.t)
        steep = fmax(dr.abs(dr.dot(first.normal, self.d)), real(_STEEP))
        furthest = fmax(fmin(first.t + close / steep, self.end), first.t)

        def more(*state: Any) -> Mask:
            return state[-1]

        def body(
            jump: Real, t: Real, last: Any, up: Any, down: Any, n_up: Vec3, n_down: Vec3, go: Mask
        ) -> tuple[Any, ...]:
            one = self._next(Crossing(t, last, 0.0, first.normal), furthest, go)
            # Sheets at an angle to each other are at the same t or apart.
            level = dr.abs(dr.dot(one.normal, first.normal)) > _PARALLEL
            found = go & (one.sheet != NO_SHEET) & ((one.t == first.t) | level)
            is_up, is_down = found & (one.jump > 0), found & (one.jump < 0)
            new_up, new_down = is_up & (up == NO_SHEET), is_down & (down == NO_SHEET)
            return (
                jump + dr.select(found, one.jump, 0),
                dr.select(found, one.t, t),
                dr.select(found, one.sheet, last),
                dr.select(new_up, one.sheet, up),
                dr.select(new_down, one.sheet, down),
                dr.select(new_up, one.normal, n_up),
                dr.select(new_down, one.normal, n_down),
                found,
            )

        some = self.backend.Bool(active) & (first.sheet != NO_SHEET)
        none = count(NO_SHEET)
        start = (
            first.jump,
            first.t,
            first.sheet,
            dr.select(first.jump > 0, first.sheet, none),
            dr.select(first.jump < 0, first.sheet, none),
            first.normal,
            first.normal,
            some,
        )
        jump, t, last, up, down, n_up, n_down, _ = dr.while_loop(
            start, more, body, label="together"
        )
        sheet = dr.select(jump > 0, up, dr.select(jump < 0, down, first.sheet))
        normal = dr.select(jump > 0, n_up, dr.select(jump < 0, n_down, first.normal))
        behind = Crossing(t, last, first.jump, first.normal)
        return Crossing(first.t, sheet, real(jump), normal), behind

    def _next(self, behind: Crossing, end: Real, active: Mask) -> Crossing:
        """The field's answer as arrays of this backend; none if it lies beyond the end."""
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        ahead = self.field.next_crossing(self.o, self.d, behind, end, active)
        there = real(ahead.t) <= end
        there &= count(ahead.sheet) != NO_SHEET
        return Crossing(
            dr.select(there, real(ahead.t), dr.inf),
            dr.select(there, count(ahead.sheet), count(NO_SHEET)),
            dr.select(there, real(ahead.jump), 0),
            vector(*ahead.normal),
        )


@dataclass(frozen=True)
class Meeting:
    """What a look at a point of a stretch tells about the crossing at its end.

    awaited: the stretch ends at a crossing.
    passed: the look was at the crossing, which ends the stretch.
    hit: the sheet that was passed is the surface.
    gaps: to the levels below and above, of the value behind the sheet where it was passed.
    normal: of the sheet.
    """

    awaited: Mask
    passed: Mask
    hit: Mask
    gaps: tuple[Real, Real]
    normal: Vec3

    def mark(self, status: Any, gradient: Vec3) -> tuple[Any, Vec3]:
        """Status and gradient, those of the sheet where it was hit."""
        marked = type(status)(dr.select(self.hit, ON_SHEET, status))
        return marked, dr.select(self.hit, self.normal, gradient)


def meet(ahead: Crossing, there: Mask, value: Real, blur: Real, levels: Levels) -> Meeting:
    """Looks that are proved, at the crossing where `there` holds, with the value before it.

    The sheet is the surface if a level lies between the values on its two sides. They are known
    up to `blur`, and a level within blur of either counts as between: such a sheet is the surface
    or just fails to be, and its points are no farther than rounding from the level. To decide the
    other way could lose a surface, for the march has proved that the level is not met *before*
    the sheet, which rounding may contradict by as much. Sheets at the same t count as one, with the
    sum of their jumps (`Walk._together`).
    """
    awaited = ahead.sheet != NO_SHEET
    passed = awaited & there
    behind = value + dr.select(passed, ahead.jump, 0)
    low, high = fmin(value, behind) - blur, fmax(value, behind) + blur
    _, up = levels.gaps(low)
    hit = passed & (up <= high - low)
    return Meeting(awaited, passed, hit, levels.gaps(behind), ahead.normal)


def loop(state: Any, body: Callable[..., Any], label: str) -> Any:
    """Runs `body` on lanes of the state whose last entry holds."""

    def running(*state: Any) -> Mask:
        return state[-1]

    try:
        return dr.while_loop(state, running, body, label=label)
    except RuntimeError as error:  # Dr.Jit wraps what the body raises
        raise (error.__cause__ or error) from None
