"""What only some fields can do: four base classes of `Field`, with defaults for all others.

- `JumpSurface`: the field jumps across surfaces, such as triangles.
- `PatchUnion`: the surface is made of many level sets, each of a function of its own, each in a
  box.
- `CommonBoundary`: every level set ends at the same curves.
- `VariableAccuracy`: the field can be evaluated more or less exactly.

Trees are asked for detail. A sum over a tree costs what its error allows, and far from the surface
a large error does no harm: `VariableAccuracy.at_accuracy` takes any detail, from coarse to a sum
one by one, and the tracer samples a point again, closer, where truncation decides: until a hit is
within the tolerance with truncation taken off. What only rounding leaves open is in
`Hits.uncertainty`; where that is large, as where grad f is 0 on the surface, the surface is looked
for around the hit (`doubtful`), after the march and in `trace` alone, so that other hits pay
nothing. What a sample proves about the surroundings is the curvature of f (`source_sums`): the
ranges of the published proof add up absolute values to first order and reach a fifth as far.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fields.field import Field, Sample

NO_FACET = 0xFFFFFFFF
"""The index of no sheet, larger than that of any."""


@dataclass(frozen=True)
class JumpCrossing:
    """Where rays cross sheets; also the two ends of rays, which lie on no sheet.

    t: ray parameter; inf where no sheet is crossed.
    facet: index of the sheet, a Dr.Jit UInt32; NO_FACET where there is none.
    jump: f just behind it minus f just before it, along the ray; 0 where there is none.
    normal: (3,) unit normal of the sheet, pointing to its side of larger f: (normal . d) jump >= 0.
        Meaningless where there is no sheet.
    """

    t: Real
    facet: Any
    jump: Real
    normal: Vec3


@dataclass(frozen=True)
class NearestFacet:
    """The nearest sheet to points x, of those that a query considers (`Field.nearest_facet`).

    sort_key: a number that grows with the distance; sheets are ordered by it, then by index. inf
        where there is no sheet.
    facet: index of the sheet, a Dr.Jit UInt32; NO_FACET where there is none.
    offset: (3,) from x to the nearest point of the sheet.
    normal: (3,) unit normal of the sheet there, to either side; any direction where it has none.
    is_inner: whether that point lies inside the sheet: a line through it along the normal crosses
        the sheet there, whatever rounding does. False on a sheet's edges.
    """

    sort_key: Real
    facet: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask


NO_PATCH = 0xFFFFFFFF
"""The index of no part, larger than that of any."""


@dataclass(frozen=True)
class PatchEntry:
    """Where rays enter the box that a part is proved to lie in.

    enter, leave: ray parameters; inf where no box is entered.
    patch: its index, a Dr.Jit UInt32; NO_PATCH where there is none.
    """

    enter: Real
    leave: Real
    patch: Any


class JumpSurface:
    """Fields with sheets: surfaces, such as triangles, across which f jumps. Defaults: no sheets.

    Off its sheets such a field is as smooth as any other. Along a ray the sheets cut the field into
    ray intervals. On each of them the values, continued onto both of its ends, are those of a
    smooth function, about which the field makes promises, and the tracer marches it as it does any
    field. Where a ray crosses a sheet, the values just before and just behind it are compared with
    the levels.

    A field with sheets is real-valued (no period), has `has_jumps = True`, and defines two
    methods: `next_jump`, which sheet comes next, and `continuation`, the field on the interval
        between two
    crossings. `initial_offset` is there for fields that count jumps.

    All methods may be called while a loop is being recorded; rays are o + t d with |d| = 1, and
    results on lanes that are not active are ignored.
    """

    has_jumps: bool = False
    """Whether f jumps across sheets. Then `next_jump` and `continuation` are needed, and the
    promises of `evaluate` are about f with the jumps taken out."""

    @property
    def has_unknown_branch(self) -> bool:
        """Whether samples of `continuation` at details below `coarsest_accuracy` may know f but for
        a whole number, where they say so (`Sample.branch_unknown`). All jumps are whole numbers
        then. Outside of the `extent` of some levels, which hold for each of them the one nearest to
        0 modulo 1, f lies between the same two of these levels, modulo 1, as 0 does."""
        return False

    def is_of_sheets_alone(self, levels: tuple[float, ...]) -> bool:
        """Whether the surface of these levels is all of the sheets and nothing else. `with_levels`
        then gives a field that shows rays the levels at every sheet, and nowhere else."""
        del levels
        return False

    only_sheets: bool = False
    """Whether this field is such a one."""

    def without_jumps(self) -> Field | None:
        """A field without sheets whose level sets hold all points of this one's that lie on no
        sheet; None where none is known. Distances use it."""
        return None

    def evaluate_modulo_one(self, p: Vec3) -> Sample:
        """f at p but for a whole number, if it `has_unknown_branch`: for less work than `evaluate`
        takes."""
        return cast("Field", self).evaluate(p)

    def value_if_cheap(self, p: Vec3, rounding: Real, active: Mask) -> Real:
        """f at p, where active, if it `has_unknown_branch` and less work than `evaluate` takes
        tells it; NaN elsewhere, and where p may lie on a sheet.

        rounding: that of the coordinates of p, and of the ray on which it lies.
        """
        del rounding, active
        return 0 * p.x + math.nan

    def next_jump(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        """The first crossing strictly after another one, with t <= t_max.

        Crossings are ordered by (t, sheet): sheets crossed at the same t come one after the other
        by their index. NO_FACET is the largest index, so that nothing follows it at the same t.
        Going along the ray, every crossing must come up in that order, with a t and a jump that do
        not depend on where the ray was entered. Where there is none, t = inf, sheet = NO_FACET,
        jump = 0.
        """
        del o, d, after, t_max, active
        return JumpCrossing(float("inf"), NO_FACET, 0.0, (0.0, 0.0, 0.0))

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        """A number that the field chooses at the start of a ray, and that `continuation` is given.

        The tracer adds the jump of every crossing that it passes. Crossings with t <= t_min are
        behind the start (`next_jump` after (t_min, NO_FACET)), all others ahead of it.
        """
        del o, d, t_min, active
        return 0.0

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> Field:
        """The field on the ray interval between two successive crossings.

        `evaluate` of the field returned is called at points p = o + t d with behind.t <= t <=
        ahead.t, to rounding. It gives the value continued along the interval, *also at its ends*:
        at ahead.t what f is just before that sheet, at behind.t just behind that one, even where
        rounding puts p on the other side or the two t are equal. Its promises are about the smooth
        function that continues these values through all sheets; the tracer uses them on the
        interval only.

        behind: the crossing last passed, or the start of the ray with sheet NO_FACET.
        ahead: the next one, or t = inf and sheet NO_FACET.
        offset: `initial_offset` at the start of the ray plus all jumps since.
        """
        del o, d, behind, ahead, offset
        return cast("Field", self)

    def distance_to_jumps(self, p: Vec3) -> Real:
        """The distance from p to the nearest sheet, rounded down, for lower bounds of distances;
        inf where there is none."""
        del p
        return float("inf")

    def nearest_facet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestFacet | None:
        """The first sheet behind `after` = (order, index), nearer than the distance `limit`.

        Sheets are ordered by `NearestFacet.sort_key`, then by index; from (-1, NO_FACET) on, each
        comes up once. The default is None: distances then search for the nearest sheet alone, by
        descent of `distance_to_jumps`.
        """
        del p, after, limit, active
        return None

    def jump_mesh(self) -> tuple[FloatArray, IntArray, bool] | None:
        """If f is the winding number of a mesh: its vertices (n, 3), its faces (m, 3), repeated by
        their multiplicity, and whether f is a whole number everywhere off them. None for other
        fields. Distances use it."""
        return None


class PatchUnion:
    """Fields with parts: the surface is made of many level sets, each of a function of its own and
    in a box of its own. Defaults: no parts.

    There is no single function with all of them for a level set. In a polygon mesh, for instance,
    each face is a level set of the solid angle of that face. Along a ray the first hit is the first
    of all parts, so the tracer marches those whose boxes the ray enters, one after the other in the
    order in which it enters them, and no farther than the first hit so far.

    A field with parts has `has_patches = True` and defines two methods: `next_patch`, which part
    comes next, and `patch`, the field whose level set that is. The parts share the period, the
    levels and the domain of the field, whose own `evaluate` has no meaning.

    `with_levels` is called first; the others may be called while a loop is being recorded.
    """

    has_patches: bool = False
    """Whether the surface is that of many level sets, each of a field of its own. Then `next_patch`
    and `patch` are needed."""

    def with_levels(self, levels: tuple[float, ...]) -> Field:
        """This field with boxes that hold the parts of these levels, to be prepared."""
        del levels
        return cast("Field", self)

    def next_patch(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        """The first box behind `after` that a ray enters at start <= t <= end.

        A ray that begins in a box enters it at `start`. Entries are ordered by (enter, part), and
        every box that the ray meets between `start` and `end` must come up in that order, once,
        after an entry at less than `start`. Where there is none, part = NO_PATCH.
        """
        del o, d, after, start, end, active
        return PatchEntry(float("inf"), float("inf"), NO_PATCH)

    def patch(self, index: Any) -> Field:
        """The field whose level set is the part with that index, which differs from lane to lane.
        Its `evaluate` and `look` may be called at points of any size; its promises hold in all of
        space."""
        del index
        return cast("Field", self)


class CommonBoundary:
    """Fields whose level sets all end at the same curves, such as an angle that is measured around
    the curves. Defaults: no such curves."""

    @property
    def boundary_curves(self) -> tuple[FloatArray, ...]:
        """Closed curves (n, 3) at which level sets end; the first point is not repeated."""
        return ()

    def closest_boundary_point(self, p: Vec3) -> Vec3 | None:
        """The closest point of the curves at which every level set ends; None if there are none.

        Only distances use it, while no loop is being recorded. Ends at `domain` do not count.
        """
        del p
        return None

    @property
    def singular_points(self) -> FloatArray:
        """Points (n, 3) that all level sets come arbitrarily near to, such as the dipoles of a
        cloud. Distances use them."""
        return np.zeros((0, 3))

    def continuous_change(self, p: FloatArray, q: FloatArray) -> FloatArray | None:
        """The change (n,) of an angle-valued f, followed continuously along straight segments from
        p to q (n, 3); None if only its values are known. Meshes use it on long edges."""
        del p, q
        return None


# A detail at which there is no truncation.
EXACT = 1e9


class VariableAccuracy:
    """Fields that can be evaluated more or less exactly. Defaults: a single detail.

    A sum over a tree takes clusters of far terms as a whole. The farther away these have to be, the
    smaller is the truncation error, and the longer it takes. Far from the surface a large error
    does
    no harm: the tracer begins with coarse samples and asks for more detail where truncation makes
    steps shorter.
    """

    has_variable_accuracy: bool = False
    """Whether f can be evaluated at different details; then `at_accuracy` is needed."""

    coarsest_accuracy: float = 1.0
    """The detail in (0, 1] that detail 0 stands for: see `at_accuracy`."""

    def at_accuracy(self, detail: Real) -> Field:
        """This field, evaluated at a detail, in each lane its own: 0 for the coarsest samples that
        the field has, 1 for those of `evaluate`, more than 1 for more exact ones.

        `Sample.truncation_error` falls about as detail^-3 and is 0 for a detail that is large
        enough. What
        a coarse sample states is true all the same: its `error` is larger.
        """
        del detail
        return cast("Field", self)

    def exact(self, backend: Backend) -> Field:
        """This field, prepared for the backend, evaluated without truncation."""
        if not self.has_variable_accuracy:
            return cast("Field", self)
        closely: Any = copy.copy(self)
        closely.evaluate = self.at_accuracy(backend.Float(EXACT)).evaluate
        return closely
