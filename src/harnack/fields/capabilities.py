"""Optional capabilities of a field. A field describes a function f of space; its surface is a
level set of f. An evaluator samples f on a backend (a Dr.Jit device and precision): a sample at a
point is value and gradient of f there, with proved bounds of f near the point ("promises"). Each
capability is an object, an attribute of the evaluator, which is None if f lacks it:

- `Evaluator.jumps`, a `Jumps`: f jumps across a surface made of facets, such as the triangles of a
  mesh.
- `Evaluator.modulo_one`, a `ModuloOne`: f can be sampled up to an unknown integer in less time.
- `Evaluator.patches`, a `Patches`: the surface is the union of many level sets (patches), each of
  its own function and inside its own box.
- `Evaluator.variable_accuracy`, a `VariableAccuracy`: f can be sampled with different accuracy.

One more is an attribute of the field:

- `Field.boundary`, a `Boundary`: every level set ends at the same curves or points.

Accuracy of sums over trees. The smaller the truncation error of a sum over a tree, the higher its
cost; and far from the surface a large error does no harm. So `VariableAccuracy.at` takes any
scale, from coarse to a direct sum. If the truncation error decides about a step or a hit, the
tracer samples the point again with higher accuracy, until a hit is within the tolerance minus
the truncation error. What rounding alone leaves uncertain about the position of a hit is reported
in `Hits.uncertainty`. If it is large, for example because grad f is 0 on the surface, `trace`
searches for the surface around the hit after the march (`doubtful`). The samples of such sums
promise a bound of the second derivatives of f near the point (`source_sums`), which holds on a
length about five times as long as the ranges of f in the published proof.
"""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harnack.enclosures.samples import describe_type
from harnack.fields.evaluator import Evaluator

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3
    from harnack.fields.field import Field, Sample

NO_FACET = 0xFFFFFFFF
"""The index that stands for no facet; larger than the index of any facet."""


@dataclass(frozen=True)
class JumpCrossing:
    """A point at which a ray o + t d crosses a facet of the surface across which f jumps. An end of
    a ray, which lies on no facet, is represented in the same way.

    t: the ray parameter; inf if no facet is crossed.
    facet: the index of the facet, a Dr.Jit UInt32; NO_FACET if there is none. Indices are below
        2^31, because `Hits.primitive_index` is an array of signed numbers.
    jump: f just behind the facet minus f just before it, along the ray; 0 if there is no facet.
    normal: (3,) the unit normal of the facet on the side where f is larger: (normal . d) jump >= 0.
        It is meaningless if there is no facet.
    """

    t: Real
    facet: Any
    jump: Real
    normal: Vec3


@dataclass(frozen=True)
class NearestFacet:
    """The facet nearest to a point x, among the facets that a query allows (`Jumps.nearest_facet`).
    Facets are the pieces of the surface across which f jumps.

    sort_key: a number that grows with the distance from x; inf if there is no facet. Facets are
        ordered by it; those with equal numbers are ordered by index.
    facet: the index of the facet, a Dr.Jit UInt32; NO_FACET if there is none.
    offset: (3,) the vector from x to the closest point of the facet.
    normal: (3,) the unit normal of the facet at that point, to either side; any direction if the
        facet has no normal.
    is_inner: whether that point lies so far inside the facet that a line through it along the
        normal crosses the facet in spite of rounding. It is False on the edges of a facet.
    """

    sort_key: Real
    facet: Any
    offset: Vec3
    normal: Vec3
    is_inner: Mask


@dataclass(frozen=True)
class MovingTriangles:
    """Triangular facets of a function f with jumps, with derivatives by their vertices.

    vertices: a Dr.Jit 3-vector with a lane for each vertex.
    corners: for each facet the index of its first, second and third corner, three Dr.Jit UInt32.
    """

    vertices: Vec3
    corners: tuple[Any, Any, Any]


NO_PATCH = 0xFFFFFFFF
"""The index that stands for no patch; larger than the index of any patch."""


@dataclass(frozen=True)
class PatchEntry:
    """The entry of a ray o + t d into a box that is proved to contain a patch, which is one of the
    level sets that together form a surface.

    enter, leave: the ray parameters at which the ray enters and leaves the box; inf if no box is
        entered.
    patch: the index of the patch, a Dr.Jit UInt32; NO_PATCH if there is none.
    """

    enter: Real
    leave: Real
    patch: Any


class Jumps(abc.ABC):
    """The facets, such as triangles, across which a function f jumps. They cut a ray o + t d, with
    |d| = 1, into intervals. On each interval f is smooth, and can be continued smoothly beyond both
    ends of the interval; this continuation is what the tracer marches along. A crossing is a point
    where the ray meets a facet (`JumpCrossing`).

    The promises of a sample (proved bounds of f near a point) are about f continued smoothly
    through all facets. Where a ray crosses a facet, the values just before and just behind it are
    compared with the levels. So the surface consists of the points off the facets at which f takes
    a level, and of the points of facets with a level between the limits of f from both sides. What
    `Evaluator.evaluate` gives at a point on a facet does not matter for that; it may be either
    limit.

    A field with jumps is real-valued (it has no period). Subclasses define two methods:
    `next_crossing` gives the next crossing of a ray, and `continuation` gives the evaluator on the
    interval between two crossings. They also define `initial_offset` if `continuation` uses its
    `offset`, unless f has no offset (0) at the start of every ray. `harnack.testing.check_field`
    tests all three.

    These methods may be called while a loop is being recorded. Results on lanes that are not active
    are ignored.
    """

    takes_all_levels: bool = False
    """Whether f takes its levels only at its facets: see `are_whole_surface`."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Wrap the methods `next_crossing` and `continuation` of a new subclass, such that they
        raise a TypeError if they return something of another type than they should."""
        super().__init_subclass__(**kwargs)
        for name, check in (("next_crossing", _check_crossing), ("continuation", _check_evaluator)):
            if name in vars(cls):
                setattr(cls, name, _with_checked_result(vars(cls)[name], check))

    @abc.abstractmethod
    def next_crossing(
        self, o: Vec3, d: Vec3, after: JumpCrossing, t_max: Real, active: Mask
    ) -> JumpCrossing:
        """The first crossing of the ray o + t d with a facet strictly after the crossing `after`,
        with t <= t_max, on active lanes.

        Crossings are ordered by (t, facet): facets that are crossed at the same t follow each other
        by index. NO_FACET is the largest index, so nothing follows it at the same t. Repeated calls
        must give every crossing of the ray in this order. The t and the jump of a crossing must not
        depend on the crossing at which the calls began. If there is no further crossing, t = inf,
        facet = NO_FACET and jump = 0.

        o, d: origin and direction of each ray.
        after: the crossing after which the search begins.
        t_max: the largest t.
        """

    def initial_offset(self, o: Vec3, d: Vec3, t_min: Real, active: Mask) -> Real:
        """A number that describes f at the start of a ray o + t d, on active lanes. The field
        chooses what kind of number it is, for example the sum of the signs of the ray's crossings
        beyond the start. The tracer adds the jump at each crossing to it, and passes the sum to
        `continuation`.

        t_min: the parameter of the start. Crossings with t <= t_min lie behind the start
            (`next_crossing` after (t_min, NO_FACET)); all others lie in front of it.
        """
        del o, d, t_min, active
        return 0.0

    @abc.abstractmethod
    def continuation(
        self, o: Vec3, d: Vec3, behind: JumpCrossing, ahead: JumpCrossing, offset: Real
    ) -> Evaluator:
        """The evaluator for the part of a ray o + t d between two consecutive crossings: it samples
        f there, continued smoothly beyond both ends.

        behind: the crossing passed last; or the start of the ray, with facet NO_FACET.
        ahead: the next crossing; or t = inf, with facet NO_FACET.
        offset: `initial_offset` at the start of the ray plus all jumps since.

        Its `evaluate` is called at points p = o + t d with behind.t <= t <= ahead.t, up to
        rounding. At the two ends it gives the limit from inside the interval, even if rounding puts
        p on the other side of the facet, or if the two t are equal. An evaluator that consists of
        such a function and of nothing else is `EvaluateOnly(function)`. Its promises (proved bounds
        near p) are about the continued function. The tracer uses them only between the two
        crossings.
        """

    def distance(self, p: Vec3) -> Real:
        """The distance from p to the nearest facet, rounded down. Lower bounds of distances use it;
        for classes that do not define it they are refused."""
        raise NotImplementedError(
            f"{type(self).__name__} gives no distances to facets: define its method distance(p)"
        )

    @property
    def gives_distances(self) -> bool:
        """Whether the class defines `distance`."""
        return type(self).distance is not Jumps.distance

    def nearest_facet(
        self, p: Vec3, after: tuple[Real, Any], limit: Real, active: Mask
    ) -> NearestFacet | None:
        """The facet that follows the facet `after` in the order of distance from p. On lanes where
        it would be farther than `limit` from p, and on lanes that are not active, no facet is found
        (NO_FACET).

        after: (sort_key, index) of a facet; (-1, NO_FACET) to begin with the nearest.
        limit: a length.

        Facets are ordered by `NearestFacet.sort_key`, then by index. Repeated calls must give each
        facet once. The default is None: computations of distances then search for the nearest facet
        only, by descent of `distance`.
        """
        del p, after, limit, active
        return None

    def moving_triangles(self) -> MovingTriangles | None:
        """The facets as triangles between vertices that may have derivatives enabled, by which hits
        on facets are differentiated; None, the default, if they are not known. Then hits of a field
        with parameters that have derivatives enabled are refused."""
        return None

    def mesh(self) -> tuple[FloatArray, IntArray, bool] | None:
        """The mesh of the facets, for a field that is the winding number of a mesh; None, the
        default, for other fields. Computations of distances use it.

        Returns the vertices (n, 3); the faces (m, 3), each repeated by its multiplicity; and
        whether f is an integer everywhere off the faces.
        """
        return None

    def smooth_field(self) -> Field | None:
        """A field without jumps whose level sets contain all points of this field's level sets,
        except those on facets; None, the default, if no such field is known. Computations of
        distances use it."""
        return None

    def are_whole_surface(self, levels: tuple[float, ...]) -> bool:
        """Whether the level set of these levels consists of all facets and of nothing else. Then
        the evaluator that `Field.evaluator` returns for a plan with these levels takes them at
        every facet and nowhere else (`takes_all_levels`). The default is False."""
        del levels
        return False


def _with_checked_result(
    method: Callable[..., Any], check: Callable[[str, Any], None]
) -> Callable[..., Any]:
    """The method of a `Jumps`, with its result passed to `check`, after a name for messages."""

    @functools.wraps(method)
    def checked(self: Any, *args: Any, **kwargs: Any) -> Any:
        """What the method returns, after the check."""
        result = method(self, *args, **kwargs)
        check(f"{type(self).__name__}.{method.__name__}", result)
        return result

    return checked


def _check_crossing(name: str, result: Any) -> None:
    """Raise TypeError unless the result of `Jumps.next_crossing` is a `JumpCrossing`."""
    if not isinstance(result, JumpCrossing):
        raise TypeError(
            f"{name} returned {describe_type(result)}: return "
            "harnack.fields.JumpCrossing(t, facet, jump, normal)"
        )


def _check_evaluator(name: str, result: Any) -> None:
    """Raise TypeError unless the result of `Jumps.continuation` is an evaluator."""
    if isinstance(result, Evaluator):
        return
    # A field is what has the method `evaluator`: `fields.field` imports this file.
    if callable(getattr(result, "evaluator", None)):
        raise TypeError(
            f"{name} returned {describe_type(result)}, a field, which describes f: return what "
            "samples f, harnack.fields.EvaluateOnly(field.evaluate), or an evaluator that was made "
            "before by field.evaluator(backend)"
        )
    raise TypeError(
        f"{name} returned {describe_type(result)}: return a harnack.fields.Evaluator whose "
        "evaluate(p) gives f between the two crossings, such as "
        "harnack.fields.EvaluateOnly(function)"
    )


class ModuloOne(abc.ABC):
    """Samples that give f only up to an integer, for a field whose jumps are all integers.

    Samples of `Jumps.continuation` may then give f only modulo 1
    (`VariableAccuracy.may_lack_integer`). Besides, `Field.extent` has to fulfill a condition. Take
    a set of levels that contains, with each level L, also that one of the numbers L + k, k an
    integer, which is nearest to 0. Then at points outside of the extent of this set no number L + k
    lies between 0 and f.
    """

    @property
    @abc.abstractmethod
    def sure_accuracy(self) -> float:
        """The smallest accuracy scale at which samples of `Jumps.continuation` give f itself, in
        (0, 1]."""

    @abc.abstractmethod
    def evaluate(self, p: Vec3) -> Sample:
        """A sample at p whose value is f minus an unknown integer, which may differ from point to
        point. So it may take less time than `Evaluator.evaluate`."""

    def value_if_cheap(self, p: Vec3, rounding: Real, active: Mask) -> Real:
        """f at p, on active lanes on which it takes less time than `Evaluator.evaluate`. The result
        is NaN on all other lanes, and where p may lie on a facet. The default is NaN everywhere.

        rounding: a bound of the rounding errors of the coordinates of p, and of the ray on which p
            lies.
        """
        del rounding, active
        return 0 * p.x + math.nan  # on each lane


class Patches(abc.ABC):
    """The patches of a surface that is the union of many level sets. Each patch is a level set of a
    function of its own, and lies in a box of its own. In a polygon mesh, for example, each face is
    a level set of the solid angle of its boundary, and no single function describes all faces. Rays
    are o + t d with |d| = 1.

    The first hit of a ray is the first of its hits with all patches. So the tracer marches along
    the patches whose boxes the ray enters, in the order in which it enters them, and no farther
    than the first hit so far.

    The patches share the period, the levels and the domain of the field, whose own `evaluate` has
    no meaning. They are those of the levels of the evaluator's plan (`Plan.levels`). The methods
    may be called while a loop is being recorded.
    """

    @abc.abstractmethod
    def next_entry(
        self, o: Vec3, d: Vec3, after: PatchEntry, start: Real, end: Real, active: Mask
    ) -> PatchEntry:
        """The first box that a ray o + t d enters after the entry `after`, with start <= t <= end,
        on active lanes. Each box is proved to contain one patch.

        A ray that begins in a box enters it at `start`. Entries are ordered by (enter, patch).
        Repeated calls, the first of them with an entry before `start`, must give every box that the
        ray meets between `start` and `end` once, in this order. If there is no further box, patch =
        NO_PATCH.
        """

    @abc.abstractmethod
    def patch(self, index: Any) -> Evaluator:
        """The evaluator of the function that has the patch with this index as one of its level
        sets.

        index: a Dr.Jit UInt32, which may differ from lane to lane.

        Its `evaluate` and `sample_ray` may be called at points of any size, and its promises
        (proved bounds near a point) hold in all of space.
        """


@dataclass(frozen=True)
class Boundary:
    """The curves at which all level sets of a field end, and the points to which all of them come
    arbitrarily near. For example, every level set of an angle around a curve ends at the curve.
    Curves at which `Field.domain` cuts level sets off do not count.

    curves: the closed curves, each as an array (n, 3) of points; the first point is not repeated at
        the end.
    points: (n, 3) the points, such as the dipoles of a cloud. Computations of distances use them.
    closest_point: a function that returns the point of the curves closest to a point p (Dr.Jit
        3-vectors). It is called only for distances, and while no loop is being recorded. None if
        there are no curves.
    continuous_change: a function that returns the change (n,) of an angle-valued f along the
        straight segments from points p (n, 3) to q (n, 3), if f is followed continuously, so
        without jumps by its period. Meshing uses it on long edges. None if only values modulo the
        period are known.
    """

    curves: tuple[FloatArray, ...] = ()
    points: FloatArray | None = None
    closest_point: Callable[[Vec3], Vec3] | None = None
    continuous_change: Callable[[FloatArray, FloatArray], FloatArray] | None = None


EXACT = 1e9
"""An accuracy scale that is so large that there is no truncation."""


@dataclass(frozen=True)
class VariableAccuracy:
    """How f can be sampled with different accuracy. An example is a sum over a tree of sources,
    which treats a far cluster of sources as a single source. The farther a cluster must be for
    that, the smaller is the truncation error and the higher the cost. The tracer starts with coarse
    samples and refines them where the truncation error shortens steps.

    An accuracy scale is a number, which may differ from lane to lane. Larger is more accurate: 0
    gives the coarsest samples of f, 1 the samples of `Evaluator.evaluate`, and a number above 1
    more accurate samples.

    at: a function that takes an accuracy scale and returns the evaluator with it; in the simplest
        case an `EvaluateOnly`. `Sample.truncation_error` falls with the scale, and is 0 if the
        scale is large enough (`EXACT`). How fast it falls matters for the time only: the scales
        that the tracer tries suit about the third power, and steps are proved for any. The
        largest that it tries is 10^6, where the truncation error should be 0. A coarse sample is as
        valid as any other; its `value_error` is larger.
    coarsest: the accuracy scale of the coarsest samples, in (0, 1]. A smaller scale, such as 0,
        gives no coarser samples, but for the next attribute.
    may_lack_integer: whether samples with a scale below `coarsest` may give f only modulo 1. Those
        samples set `Sample.branch_unknown`.
    """

    at: Callable[[Real], Evaluator]
    coarsest: float = 1.0
    may_lack_integer: bool = False


def exactly_sampled(evaluator: Evaluator, backend: Backend) -> Evaluator:
    """The evaluator of the same function without truncation error; the evaluator itself if it has a
    single accuracy.

    backend: that of the evaluator.
    """
    accuracy = evaluator.variable_accuracy
    return evaluator if accuracy is None else accuracy.at(backend.Float(EXACT))
