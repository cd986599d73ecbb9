"""Optional capabilities of fields: jumps, patches, boundary curves, variable accuracy.

Each is a base class of `Field`, with defaults for fields that lack the capability:

- `JumpSurface`: the field jumps across a surface, such as the triangles of a mesh.
- `PatchUnion`: the surface is the union of many level sets, each of its own function and inside its
  own box.
- `CommonBoundary`: every level set ends at the same curves.
- `VariableAccuracy`: the field can be sampled with different accuracy.

How accurately a tree is summed. The smaller the truncation error of a sum over a tree, the higher
its cost; and far from the surface a large error does no harm. So `VariableAccuracy.at_accuracy`
takes any accuracy, from coarse to a direct sum. If truncation decides about a step or a hit, the
tracer samples the point again with higher accuracy, until a hit is within the tolerance minus the
truncation error. The uncertainty that is due to rounding alone is reported in `Hits.uncertainty`.
If it is large, for example because grad f is 0 on the surface, `trace` searches for the surface
around the hit after the march (`doubtful`), so that other hits cost nothing more. The samples of
such sums promise a bound of the second derivatives of f near the point (`source_sums`). (The ranges
of the published proof, which add up absolute values to first order, hold only on a fifth of that
length.)
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
"""The index that stands for no facet; larger than the index of any facet."""


@dataclass(frozen=True)
class JumpCrossing:
    """A crossing of a ray with a jump surface. An end of a ray, which lies on no facet, is
    represented as a crossing too.

    t: ray parameter; inf if no facet is crossed.
    facet: index of the facet, a Dr.Jit UInt32; NO_FACET if there is none.
    jump: f just behind the facet minus f just before it, along the ray; 0 if there is no facet.
    normal: (3,) unit normal of the facet, pointing to the side on which f is larger: (normal . d)
        jump >= 0, with d the direction of the ray. It is meaningless if there is no facet.
    """

    t: Real
    facet: Any
    jump: Real
    normal: Vec3


@dataclass(frozen=True)
class NearestFacet:
    """The facet nearest to a point x, among the facets of a query (`Field.nearest_facet`).

    sort_key: a number that grows with the distance. Facets are ordered by it, then by index. It is
        inf if there is no facet.
    facet: index of the facet, a Dr.Jit UInt32; NO_FACET if there is none.
    offset: (3,) the vector from x to the closest point of the facet.
    normal: (3,) unit normal of the facet at that point, to either side; any direction if the facet
        has no normal.
    is_inner: whether that point lies inside the facet, so that a line through it along the normal
        crosses the facet there in spite of rounding. It is False on the edges of a facet.
    """

    sort_key: Real
    facet: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask


NO_PATCH = 0xFFFFFFFF
"""The index that stands for no patch; larger than the index of any patch."""


@dataclass(frozen=True)
class PatchEntry:
    """The entry of a ray into the box in which a patch is proved to lie.

    enter, leave: ray parameters; inf if no box is entered.
    patch: index of the patch, a Dr.Jit UInt32; NO_PATCH if there is none.
    """

    enter: Real
    leave: Real
    patch: Any


class JumpSurface:
    """Fields that jump across a surface of facets, such as triangles. Defaults: no facets.

    Away from its facets such a field is as smooth as any other. The facets cut a ray into
    intervals. On each interval f, continued to both of its ends, is a smooth function. The field's
    promises are about this function, and the tracer marches along it as along any field. Where a
    ray crosses a facet, the values just before and just behind it are compared with the levels.

    A field with jumps is real-valued (no period), has `has_jumps = True`, and defines two methods:
    `next_jump` gives the next crossing of a ray, and `continuation` gives the field on the interval
    between two crossings. Fields that count jumps also define `initial_offset`.

    All methods may be called while a loop is being recorded. Rays are o + t d with |d| = 1. Results
    on lanes that are not active are ignored.
    """

    has_jumps: bool = False
    """Whether f jumps across facets. Then `next_jump` and `continuation` are needed, and the
    promises of `evaluate` are about f continued smoothly through all facets."""

    @property
    def has_unknown_branch(self) -> bool:
        """Whether samples of `continuation` at an accuracy below `coarsest_accuracy` may give f
        only modulo 1.

        Then they set `Sample.branch_unknown`, and all jumps are integers. A condition on `extent`
        must hold for sets of levels of this kind: with each level, the set contains the level that
        is congruent to it modulo 1 and nearest to 0. Outside the extent of such a set, no periodic
        level lies between f and 0.
        """
        return False

    def is_of_sheets_alone(self, levels: tuple[float, ...]) -> bool:
        """Whether the surface of these levels consists of all facets and of nothing else. Then
        `with_levels` gives a field that takes the levels at every facet and nowhere else."""
        del levels
        return False

    only_sheets: bool = False
    """Whether this field takes its levels at its facets only: see `is_of_sheets_alone`."""

    def without_jumps(self) -> Field | None:
        """A field without jumps, whose level sets contain all points of this field's level sets
        that lie on no facet; None if none is known. Distances use it."""
        return None

    def evaluate_modulo_one(self, p: Vec3) -> Sample:
        """A sample at p whose value is f minus an integer. The integer is not known and may differ
        from point to point, so that the sample may take less work than `evaluate`. It is used only
        for fields with `has_unknown_branch`. The default is `evaluate`."""
        return cast("Field", self).evaluate(p)

    def value_if_cheap(self, p: Vec3, rounding: Real, active: Mask) -> Real:
        """f at p on active lanes, if it takes less work there than `evaluate`; NaN on all other
        lanes, and where p may lie on a facet. It is used only for fields with `has_unknown_branch`.
        The default is NaN everywhere.

        rounding: a bound of the rounding of the coordinates of p, and of the ray on which p lies.
        """
        del rounding, active
        return 0 * p.x + math.nan

    def next_jump(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        """The first crossing of the ray strictly after the crossing `after`, with t <= t_max.

        Crossings are ordered by (t, facet): facets crossed at the same t follow each other by
        index. NO_FACET is the largest index, so that nothing follows it at the same t. Repeated
        calls must give every crossing of the ray in this order, with a t and a jump that do not
        depend on the crossing at which the calls began. If there is no further crossing, t = inf,
        facet = NO_FACET and jump = 0.
        """
        del o, d, after, t_max, active
        return JumpCrossing(float("inf"), NO_FACET, 0.0, (0.0, 0.0, 0.0))

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        """The offset of f at the start of a ray; the field chooses its meaning.

        The tracer adds the jump at each crossing and passes the sum to `continuation`. Crossings
        with t <= t_min are behind the start (`next_jump` after (t_min, NO_FACET)), all others are
        ahead of it.
        """
        del o, d, t_min, active
        return 0.0

    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> Field:
        """f between two consecutive jump crossings of a ray, as a field.

        behind: the crossing passed last, or the start of the ray with facet NO_FACET.
        ahead: the next crossing, or t = inf and facet NO_FACET.
        offset: `initial_offset` at the start of the ray plus all jumps since.

        The field's `evaluate` is called at points p = o + t d with behind.t <= t <= ahead.t, up to
        rounding. At the two ends it gives the limit from inside the interval, even if rounding puts
        p on the other side of the facet, or if the two t are equal. Its promises are about the
        smooth function that continues these values past both ends. The tracer uses them on the
        interval only.
        """
        del o, d, behind, ahead, offset
        return cast("Field", self)

    def distance_to_jumps(self, p: Vec3) -> Real:
        """The distance from p to the nearest facet, rounded down; inf if there is none. Lower
        bounds of distances use it."""
        del p
        return float("inf")

    def nearest_facet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestFacet | None:
        """The facet that follows `after` in the order of distance from p, if it is nearer than
        `limit`.

        after: (sort_key, index) of a facet, or (-1, NO_FACET) to begin with.

        Facets are ordered by `NearestFacet.sort_key`, then by index. Repeated calls must give each
        facet once. The default is None: distances then search for the nearest facet only, by
        descent of `distance_to_jumps`.
        """
        del p, after, limit, active
        return None

    def jump_mesh(self) -> tuple[FloatArray, IntArray, bool] | None:
        """The mesh, for a field that is the winding number of a mesh; None for other fields.
        Distances use it.

        Returns the vertices (n, 3); the faces (m, 3), each repeated by its multiplicity; and
        whether f is an integer everywhere off the faces.
        """
        return None


class PatchUnion:
    """A surface that is the union of many level sets (patches). Each is a level set of its own
    function, inside its own box. Defaults: no patches.

    In a polygon mesh, for example, each face is a level set of the solid angle of its boundary, and
    no single function describes all of them. The first hit of a ray is the first of the hits of all
    patches. So the tracer marches along the patches whose boxes the ray enters, in the order in
    which it enters them, and no farther than the first hit so far.

    A field with patches has `has_patches = True` and defines two methods. `next_patch` gives the
    next patch along a ray. `patch` gives the function of a patch, as a field. The patches share the
    period, the levels and the domain of the field. The field's own `evaluate` has no meaning.

    `with_levels` is called first. The other methods may be called while a loop is being recorded.
    """

    has_patches: bool = False
    """Whether the surface is a union of patches, each of its own field. Then `next_patch` and
    `patch` are needed."""

    def with_levels(self, levels: tuple[float, ...]) -> Field:
        """This field, not yet prepared, with boxes that contain the patches of these levels."""
        del levels
        return cast("Field", self)

    def next_patch(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        """The first entry of a ray into a box after the entry `after`, with start <= t <= end. Each
        box is proved to contain one patch.

        A ray that begins in a box enters it at `start`. Entries are ordered by (enter, patch).
        Repeated calls, the first of them with an entry before `start`, must give every box that the
        ray meets between `start` and `end` once, in this order. If there is no further box, patch =
        NO_PATCH.
        """
        del o, d, after, start, end, active
        return PatchEntry(float("inf"), float("inf"), NO_PATCH)

    def patch(self, index: Any) -> Field:
        """The field one of whose level sets is the patch with this index.

        index: a Dr.Jit UInt32, which may differ from lane to lane.

        `evaluate` and `sample_ray` of the field may be called at points of any size. Its promises
        hold in all of space.
        """
        del index
        return cast("Field", self)


class CommonBoundary:
    """Fields whose level sets all end at the same curves, such as an angle around these curves.
    Defaults: no such curves."""

    @property
    def boundary_curves(self) -> tuple[FloatArray, ...]:
        """Closed curves (n, 3) at which level sets end; the first point is not repeated."""
        return ()

    def closest_boundary_point(self, p: Vec3) -> Vec3 | None:
        """The point of the common boundary curves that is closest to p; None if there are no such
        curves.

        Only distances use it, while no loop is being recorded. Curves at which `domain` cuts level
        sets off do not count.
        """
        del p
        return None

    @property
    def singular_points(self) -> FloatArray:
        """Points (n, 3) to which all level sets come arbitrarily near, such as the dipoles of a
        cloud. Distances use them."""
        return np.zeros((0, 3))

    def continuous_change(self, p: FloatArray, q: FloatArray) -> FloatArray | None:
        """The change (n,) of an angle-valued f along the straight segments from p to q, if f is
        followed continuously; None if only values modulo the period are known. Meshes use it on
        long edges.

        p, q: (n, 3).
        """
        del p, q
        return None


# An accuracy scale that is so large that there is no truncation.
EXACT = 1e9


class VariableAccuracy:
    """A field that can be sampled with different accuracy. Defaults: a single accuracy.

    A sum over a tree treats far clusters as one source. The farther clusters must be for that, the
    smaller the truncation error and the higher the cost. The tracer starts with coarse samples and
    refines them where truncation shortens steps.
    """

    has_variable_accuracy: bool = False
    """Whether f can be sampled with different accuracy; then `at_accuracy` is needed."""

    coarsest_accuracy: float = 1.0
    """The accuracy scale in (0, 1] of the coarsest samples, which scale 0 asks for: see
    `at_accuracy`."""

    def at_accuracy(self, detail: Real) -> Field:
        """This field, sampled with another accuracy.

        detail: the accuracy scale, which may differ from lane to lane. 0 gives the coarsest samples
            of the field, 1 the samples of `evaluate`, and a number above 1 more accurate samples.

        `Sample.truncation_error` falls about as detail^-3, and is 0 if detail is large enough. A
        coarse sample is valid all the same, with a larger `value_error`.
        """
        del detail
        return cast("Field", self)

    def exact(self, backend: Backend) -> Field:
        """This field, which must be prepared for the backend, with samples without truncation
        error: at the accuracy scale `EXACT`."""
        if not self.has_variable_accuracy:
            return cast("Field", self)
        closely: Any = copy.copy(self)
        closely.evaluate = self.at_accuracy(backend.Float(EXACT)).evaluate
        return closely
