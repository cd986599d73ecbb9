"""Solids made from outlines in the plane: `Extrusion` along the z axis, and `SolidOfRevolution`
about it. An outline is a set of closed polygonal loops that bound a region. The function f of a
solid is the signed distance from its surface, negative inside. It is made from the signed distance
d of a point of the plane from the outline. A sample gives value and gradient at a point, with
bounds of their errors and with a Lipschitz constant. An enclosure is a proved bound of the change
of f along a ray."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Interval, Jet, norm
from harnack.arithmetic.jet import Dual, range_times_length
from harnack.arithmetic.norms import orthogonal_intersection
from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_finite, as_positive
from harnack.enclosures import Enclosure, LevelGaps, Lipschitz
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.attached_numbers import with_attached_arguments
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.formula_evaluator import is_jet
from harnack.fields.solids.deformations import Deformation, Taper, Twist
from harnack.fields.solids.outline_distance import (
    OutlineEdges,
    OutlineSample,
    SignedDistanceEnclosure,
)
from harnack.fields.solids.solid import Solid, box_around, set_frozen
from harnack.geometry.outline_loops import make_outline

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.number_table import NumberReader, NumberTable
    from harnack.geometry import Volume

# The next ray sample is bounded on a length that is this multiple of the last step
# (`RaySample.reach_growth`). An evaluation takes long, so that long steps save time.
_REACH_GROWTH = 4.0
# A lower bound of |gradient| of a signed distance, which is 1 wherever the gradient exists.
_MIN_GRADIENT = 0.99
# If coordinates have an error of more than this many roundings, they stand for a range of points.
_MAX_POINT_ROUNDINGS = 256.0


@dataclass(frozen=True, eq=False)
class Extrusion(Solid):
    """An extruded region of the plane z = 0: the points above the region, with 0 <= z <= height.
    The region is bounded by an outline. The solid may be twisted about the z axis and tapered; then
    f at p is the function of the straight solid at the preimage of p, which is the point that twist
    and taper move to p.

    loops: the outline of the region, an array (n, 2) of the vertices of a closed loop, or several
        such arrays. A point is inside if an odd number of loops surrounds it (the even-odd rule).
        So loops in loops are holes, and loops in holes are islands, whatever their orientation.
        Loops that cross or touch are cut there. They are stored as `harnack.geometry.make_outline`
        returns them.
    height: along z.
    twist: the angle in degrees by which the top end is turned against the bottom end about the z
        axis, counter-clockwise as seen from above.
    taper: the factor by which the top end is scaled about the z axis.

    Without twist and taper, f is the signed distance. It combines the distance d from the outline
    in the plane, which is exact over all edges, and the distance from the two ends, as distances at
    right angles (`orthogonal_intersection`). So its Lipschitz constant is 1. Along a ray more is
    proved: see `ExtrusionEnclosure`.

    With twist or taper, f at p is this function at the preimage of p, which has the same z. Along a
    ray f changes no faster than the preimage moves; ranges of the preimage's derivative along the
    ray bound the speed of the preimage. Proof of the Lipschitz constant in all directions. Let c be
    a Lipschitz constant of the inverse of the taper on the ball of radius R about p, and let p' be
    the image of p under this inverse. Let b be a Lipschitz constant of the inverse of the twist on
    the ball of radius S about p' (proofs: `Taper`, `Twist`). Points within min(R, S/c) of p go to
    points within S of p'. So on this ball both inverses together have the constant b c. So has f,
    because the signed distance has the constant 1.

    Raises:
        ValueError: loops that enclose no area; a height or a taper that is not positive.
    """

    traits = dataclasses.replace(
        Solid.traits, differentiable_arguments=("height", "twist", "taper")
    )

    loops: Any
    height: float
    twist: float = 0.0
    taper: float = 1.0

    def __post_init__(self) -> None:
        """Check the arguments, and make the maps `Twist` and `Taper` if they are needed.

        Raises:
            ValueError: loops that enclose no area; a height or a taper that is not positive.
        """
        set_frozen(self, "loops", make_outline(self.loops))
        height = as_positive(self.height, "the height of an extruded outline")
        twist = as_finite(self.twist, "the twist of an extruded outline, in degrees,")
        taper = as_positive(self.taper, "the taper of an extruded outline")
        for name, value in (("height", height), ("twist", twist), ("taper", taper)):
            set_frozen(self, name, value)
        set_frozen(self, "_turning", Twist(math.radians(twist) / height) if twist else None)
        profile = (0.0, 1.0), (height, taper)
        set_frozen(self, "_tapering", Taper(*profile) if taper != 1.0 else None)
        # Twist and taper have no Lipschitz constant in all of space.
        set_frozen(self, "lipschitz", 1.0 if self.is_straight else None)

    def with_read_numbers(self, numbers: NumberReader) -> _AttachedExtrusion:
        """The same function of the numbers with their derivatives."""
        own = with_attached_arguments(self, ("height", "twist", "taper"), numbers)
        backend = cast("NumberTable", numbers).backend
        return _AttachedExtrusion(
            self._upload(backend).outline, own.height, own.twist, own.taper, self.is_straight
        )

    @property
    def is_straight(self) -> bool:
        """Whether the solid has neither twist nor taper."""
        return self.twist == 0.0 and self.taper == 1.0

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        return {"edges": sum(map(len, self.loops))}

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: a box around the outline, grown by the
        level on all sides. For a twisted or tapered solid it contains the images of that box at all
        heights. None if `above` (a volume for all points where f >= level), as these points are
        unbounded."""
        if above:
            return None
        points = np.concatenate(self.loops)
        lower, upper = points.min(axis=0) - level, points.max(axis=0) + level
        if not self.is_straight:
            # The box of all scaled copies, which contains the axis. (A scale may be below 1.)
            max_scale = max(1.0, self.taper)
            lower, upper = max_scale * np.minimum(lower, 0.0), max_scale * np.maximum(upper, 0.0)
        if self.twist:
            # Turned by any angle, the outline stays in a disc about the axis, with the distance of
            # its farthest vertex as radius.
            radius = float(np.linalg.norm(points, axis=1).max()) + max(level, 0.0)
            upper = np.full(2, radius * max(1.0, self.taper))
            lower = -upper
        (half_x, half_y), (center_x, center_y) = 0.5 * (upper - lower), 0.5 * (upper + lower)
        half_height = 0.5 * self.height
        return box_around(
            (float(half_x), float(half_y), half_height + level),
            (float(center_x), float(center_y), half_height),
        )

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        del plan
        max_scale = max(1.0, self.taper)
        return _ExtrusionEvaluator(self._upload(backend), self.is_straight, max_scale)

    @cached_upload
    def _upload(self, backend: Backend) -> _ExtrusionData:
        """Upload the edges and the numbers of the solid to a backend."""
        outline = OutlineEdges.upload(backend, self.loops)
        half = dr.opaque(backend.Float, 0.5 * self.height)
        twist, taper = (
            None if deform is None else deform.on_backend(backend)
            for deform in (cast("Any", self)._turning, cast("Any", self)._tapering)
        )
        return _ExtrusionData(outline, half, twist, taper)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return self.formula_on(_backend_of_coordinate(x, type(self).__name__))(x, y, z)


@dataclass(frozen=True)
class _ExtrusionData:
    """The data of an extruded outline on a backend.

    outline: the edges of the outline.
    half: half of the height.
    twist, taper: the maps by which the straight solid is deformed, with their numbers on the
        backend; None for none.
    """

    outline: OutlineEdges
    half: Real
    twist: Deformation | None
    taper: Deformation | None


@dataclass(frozen=True, eq=False)
class _AttachedExtrusion:
    """An extrusion whose numbers may have derivatives.

    outline: its edges.
    height, twist, taper: as of `Extrusion`.
    is_straight: whether twist and taper are those that change nothing.
    """

    outline: OutlineEdges
    height: Any
    twist: Any
    taper: Any
    is_straight: bool

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit or dual numbers."""
        is_deformed = not self.is_straight or any(
            dr.is_array_v(type(v)) and dr.grad_enabled(v) for v in (self.twist, self.taper)
        )
        if is_deformed:
            tapering = Taper.of_numbers(start=(0.0, 1.0), end=(self.height, self.taper), axis="z")
            rate = self.twist * (math.pi / 180) / self.height
            x, y, z = tapering.preimage(x, y, z)
            x, y, z = Twist.of_numbers(rate=rate, axis="z").preimage(x, y, z)
        half = self.height * 0.5
        return orthogonal_intersection(self._planar_distance(x, y), abs(z - half) - half)

    def _planar_distance(self, x: Any, y: Any) -> Any:
        """The signed distance of (x, y) from the outline. It and its gradient are those of a
        sample, whose derivatives by x and y are known: the second derivative is one across the
        gradient."""
        u, v = (w.value if isinstance(w, Dual) else w for w in (x, y))
        with dr.suspend_grad():
            side = self.outline.sample(dr.detach(u), dr.detach(v))
        gx, gy = side.gradient
        du, dv = u - dr.detach(u), v - dr.detach(v)  # zeros with derivatives
        value = side.value + gx * du + gy * dv
        if not isinstance(x, Dual):
            return value
        turn = side.second_derivative * (gx * dv - gy * du)
        a, b = gx - gy * turn, gy + gx * turn
        slopes = [
            a * p + b * q for p, q in zip(x.first_derivatives, y.first_derivatives, strict=True)
        ]
        return Dual(value, (slopes[0], slopes[1], slopes[2]))


@dataclass(frozen=True, eq=False)
class _ExtrusionEvaluator(Evaluator):
    """The evaluator of an `Extrusion`.

    data: the edges and the numbers of the solid.
    is_straight: whether the solid has neither twist nor taper.
    max_scale: the largest factor by which its cross sections are scaled.
    """

    data: _ExtrusionData
    is_straight: bool
    max_scale: float

    def evaluate(self, p: Vec3) -> Sample:
        """The sample of f at p. Without twist and taper it follows from the signed distance of (x,
        y) from the outline. Otherwise the outline is sampled at the preimage of p (the point that
        twist and taper move to p). Proved ranges of the preimage and of its derivatives then give
        the gradient by the chain rule, and the errors."""
        outline = self.data.outline
        if self.is_straight:
            planar = outline.sample(p.x, p.y)
            return self._sample_of_outline(p, planar, cast("Any", type(p))(*planar.gradient, 0))
        # Jets (ranges of value and derivatives) of the preimage's coordinates.
        x, y, _ = self._preimage(*Jet.at_point(p))
        zero = 0 * p.x
        u, v = (zero + component.value.midpoint for component in (x, y))
        planar = outline.sample(u, v)
        # A bound of the error of the preimage's position. Then the components of the gradient of
        # the outline's distance as a function of p, as ranges: the chain rule, with the planar
        # gradient times the derivatives a and b of the preimage's x and y.
        spread = zero + x.value.radius + y.value.radius
        gradient_ranges = [
            Interval.point(planar.gradient[0]) * a + Interval.point(planar.gradient[1]) * b
            for a, b in zip(x.first_derivatives, y.first_derivatives, strict=True)
        ]
        gradient = cast("Any", type(p))(
            *(zero + component.midpoint for component in gradient_ranges)
        )
        constant, radius = self._preimage_lipschitz(p)
        error = (
            sum((component.radius for component in gradient_ranges), zero)
            + planar.gradient_error * constant
        )
        # The distance changes by at most as much as the preimage, which `spread` bounds; the bound
        # is doubled as a margin.
        moved = OutlineSample(planar.value, planar.gradient, planar.error + 2 * spread, error)
        return self._sample_of_outline(p, moved, gradient, Lipschitz(constant, radius))

    def _sample_of_outline(
        self, p: Vec3, side: OutlineSample, gradient: Vec3, promise: Lipschitz | None = None
    ) -> Sample:
        """The sample of the solid at p, from the distances from the outline and from the two ends.

        side: the sample of the signed distance from the outline, in the plane.
        gradient: (3,) the gradient of that distance as a function of p in space.
        promise: a Lipschitz constant of f near p; None for the constant 1 everywhere.
        """
        epsilon = 2 * float(dr.epsilon(type(p.x)))  # the machine epsilon
        half = self.data.half
        end_distance = dr.abs(p.z - half) - half
        # f, and its derivatives by the two distances.
        value, side_weight, end_weight = _corner(side.value, end_distance)
        # The derivative of |z - half| by z is the sign of z - half.
        vertical = dr.mulsign(end_weight, p.z - half)
        gradient = gradient * side_weight + cast("Any", type(p))(0, 0, vertical)
        error = side.error + 8 * epsilon * (dr.abs(p.z) + half)
        gradient_error = side.gradient_error + 8 * epsilon
        # Outside near an edge, both weights are quotients of a distance and of f: their error is
        # that of the distances over f.
        gradient_error = gradient_error + dr.select(
            (side_weight > 0) & (end_weight > 0), fmin(2 * error / value, 2), 0
        )
        # By default the constant 1, on each lane.
        promises = (Lipschitz(0 * p.x + 1) if promise is None else promise,)
        return Sample(value, gradient, promises, error, gradient_error)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with enclosures (proved bounds of the
        change of f along the ray) in front of the point, up to the length `ahead`.

        Without twist and taper the enclosure is an `ExtrusionEnclosure`, and there is none behind
        the point. Otherwise the enclosures follow from a Lipschitz constant along the ray, the
        largest speed of the preimage; there is none behind the point either. If the caller asks for
        other kinds of enclosures, they follow from the sample at the point.

        path: the ray.
        ahead, back: the lengths in front of and behind the point; `back` is not used.
        """
        del back
        p, d = path.point(t), path.direction
        if not self.is_straight:
            sample = self.evaluate(p)
            min_norm = self._min_gradient_norm(sample)
            # A constant of about 1 proves a step of about |f| to the surface: twice that is enough.
            path_constant = self._path_lipschitz(p, d, fmin(ahead, 2 * dr.abs(sample.value)))
            ray_sample = path.enclose(replace(sample, ray_promises=(path_constant,)))
            # The speed has no bound looking back.
            return replace(ray_sample, backward=(), min_gradient_norm=min_norm)
        # The caller chooses kinds of enclosures. The one below is used with the sharpest choice,
        # which is the one that has `PiecewiseTaylorEnclosure`.
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        outline, half = self.data.outline, self.data.half
        # Positions on the ray at which the distance from the outline is bounded. The ray's
        # direction in the plane is (d.x, d.y), which is no longer than 1.
        knots = outline.knots(p.x, p.y, ahead)
        planar = outline.sample(p.x, p.y, (d.x, d.y), knots)
        sample = self._sample_of_outline(p, planar, cast("Any", type(p))(*planar.gradient, 0))
        planar_slope = planar.gradient[0] * d.x + planar.gradient[1] * d.y
        planar_enclosure = SignedDistanceEnclosure.around(planar, planar_slope, knots)
        height = p.z - half
        enclosure = ExtrusionEnclosure(
            sample.value, sample.value_error, planar_enclosure, height, half, d.z
        )
        slope = dr.dot(sample.gradient, d)
        return RaySample(
            sample, (enclosure,), (), slope, _REACH_GROWTH, min_gradient_norm=_MIN_GRADIENT
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers, or jets (ranges of numbers and of their
        derivatives)."""
        if not is_jet(x, self.name):
            return self.differentiable_value(_vector(x, y, z))
        u, v, w = self._preimage(x, y, z)
        half = self.data.half
        return orthogonal_intersection(
            outline_distance_jet(self.data.outline.sample, u, v), abs(w - half) - half
        )

    def _preimage(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The preimage of (x, y, z): the point that twist and taper move to (x, y, z). Coordinates
        may be numbers of any arithmetic."""
        for deform in (self.data.taper, self.data.twist):
            if deform is not None:
                x, y, z = deform.preimage(x, y, z)
        return x, y, z

    def _path_lipschitz(self, p: Vec3, direction: Vec3, length: Real) -> Lipschitz:
        """A Lipschitz constant of f along the ray that starts at p with the unit vector
        `direction`, up to the length `length`. It is a bound of the speed of the preimage (the
        point that twist and taper move to a point of the ray), since f has the Lipschitz constant 1
        as a function of the preimage. On lanes where no bound is found, the constant is infinite,
        and holds on the length 0."""
        # The jets of the preimage's coordinates, as functions of the length from 0 to `length`.
        local = self._preimage(*Jet.along_ray(p, direction, 0.0, length))
        speeds = [0 * p.x + jet.first_derivatives[0].max_abs for jet in local]
        speed = dr.norm(cast("Any", type(p))(*speeds)) * (1 + 1e-5)
        is_known = dr.isfinite(speed) & (length > 0)
        return Lipschitz(dr.select(is_known, speed, dr.inf), dr.select(is_known, length, 0))

    def _min_gradient_norm(self, sample: Sample) -> Real:
        """A lower bound of |grad f| at a point, from the Lipschitz constant c of f near it, which
        is the only promise of the sample.

        Proof. f at p is the signed distance from a straight extrusion, taken at the preimage of p.
        The gradient of the signed distance is at least `_MIN_GRADIENT` long. So |grad f| is at
        least `_MIN_GRADIENT` times the smallest singular value of the derivative of the inverse
        map. That is at least the product of the smallest singular values for the twist and for the
        taper. For the twist, the singular values are s, 1 and 1/s with s >= 1, so the smallest is
        1/s. For the taper, they are k and the two of a 2 x 2 matrix of determinant k. Let q be the
        larger of these two; then q >= k and q >= 1, so the smallest is at least k/q. As c is at
        least s q, and k at least 1/max(1, taper), k/(s q) is at least 1/(max(1, taper) c).
        """
        (promise,) = sample.promises
        return _MIN_GRADIENT / (self.max_scale * cast("Lipschitz", promise).constant)

    def _preimage_lipschitz(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of the inverse of twist and taper (the map `_preimage`) on a ball
        about p, and the radius of that ball. The docstring of `Extrusion` has the proof."""
        taper, twist = self.data.taper, self.data.twist
        # Without twist and taper: the constant 1 in all of space, on each lane.
        constant, radius = 0 * p.x + 1, 0 * p.x + dr.inf
        if taper is not None:
            constant, radius = taper.preimage_lipschitz(p)
            p = cast("Any", type(p))(*taper.preimage(p.x, p.y, p.z))
        # The taper's inverse, with the constant c on the ball of radius R, is followed by that of
        # the twist, on a ball of radius S. Points within min(R, S/c) of p stay in both balls, and
        # the two constants are multiplied.
        if twist is not None:
            inner_constant, inner_radius = twist.preimage_lipschitz(p)
            constant, radius = (
                constant * inner_constant,
                fmin(radius, inner_radius / constant * (1 - 1e-5)),
            )
        return constant, radius


def _backend_of_coordinate(x: Any, name: str) -> Backend:
    """The backend of a coordinate of a formula: a Dr.Jit number or a jet. name: the name of the
    field, for the message of an error."""
    return backend_of(x.piece_length if is_jet(x, name) else x)


def _vector(x: Real, y: Real, z: Real) -> Vec3:
    """The Dr.Jit 3-vector with these components."""
    return backend_of(x).Array3f(x, y, z)


def _corner(d: Real, w: Real) -> tuple[Real, Real, Real]:
    """The signed distance from the edge at which two faces meet at right angles
    (`orthogonal_intersection`), and its derivatives with respect to d and to w.

    d, w: the signed distances from the planes of the two faces, negative inside.

    Outside of both faces the distance is |(d, w)|, otherwise the larger of d and w.
    """
    is_outside = (d > 0) & (w > 0)
    length = dr.sqrt(dr.fma(d, d, w * w))
    is_first = d >= w
    value = dr.select(is_outside, length, fmax(d, w))
    derivative_d = dr.select(is_outside, d / length, dr.select(is_first, 1.0, 0.0))
    derivative_w = dr.select(is_outside, w / length, dr.select(is_first, 0.0, 1.0))
    return value, derivative_d, derivative_w


@dataclass(frozen=True)
class ExtrusionEnclosure(Enclosure):
    """A proved bound of the change of f along a ray, where f is the signed distance from a straight
    extrusion. d is the signed distance from the outline in the plane. w is the signed distance from
    the two ends: w = |v| - h, where v is z above the middle of the solid, and h is half of the
    solid's height. The gaps are the differences between f at the start of the ray and the next
    level below and above.

    value, error: f at the start, and a bound of its error.
    side: the enclosure of d.
    height: v at the start.
    half: h.
    rate: the derivative of z along the ray.

    Proof. max(d, w) <= f, with equality where f <= 0. So f stays above a level as long as d does or
    w does, and it stays below a level <= 0 as long as both do. The errors of d and w are at most
    `error`. Besides, f changes by no more than the length of the ray. Along a line w is |v| minus a
    constant. If w falls at first, it is lower by g at the length g/|rate|, unless v comes to 0
    before; and it is higher by g at the length (2 |v| + g)/|rate|, with v at the start. If w rises
    at first, it is never lower than at the start, and it is higher by g at the length g/|rate|.
    """

    value: Real
    error: Real
    side: SignedDistanceEnclosure
    height: Real
    half: Real
    rate: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """The length of the ray on which f is proved to meet neither the level above nor the level
        below: the smaller of the two lengths that are proved for the levels one by one.

        gaps: the differences between f at the start and its next levels.

        In the code `end_distance` is w, and names with `side` belong to d. The deficits are upper
        bounds of f - w and f - d at the start. So w is above the level below by at least gaps.below
        minus its deficit, and so is d with its own.
        """
        inf = type(gaps.below)(dr.inf)
        end_distance = dr.abs(self.height) - self.half
        end_deficit, side_deficit = (
            self.value - end_distance + self.error,
            self.value - self.side.value + self.error,
        )
        # The level below: the longest of the lengths proved by the Lipschitz constant 1, by w, and
        # by d.
        down = fmax(gaps.below, self._fall(gaps.below - end_deficit))
        side_gap = gaps.below - side_deficit
        down = fmax(
            dr.select(side_gap > 0, self.side.free_length(LevelGaps(side_gap, inf)), 0), down
        )
        # The level above: if it is <= 0, both d and w must stay below it.
        is_inside = self.value + gaps.above + self.error <= 0  # also for unrounded numbers
        # w rises to the level above when it has risen by the gap plus f - w. The deficit is f - w
        # plus the error, and for this level the error has to be subtracted; so it is subtracted
        # twice.
        error = 2 * self.error
        up = fmin(
            self._rise(gaps.above + end_deficit - error),
            self.side.free_length(LevelGaps(inf, fmax(gaps.above + side_deficit - error, 0))),
        )
        up = fmax(gaps.above, dr.select(is_inside, up, 0))
        is_valid = (gaps.below >= 0) & (gaps.above >= 0)
        # (1e-6 covers the rounding of the length.)
        return dr.select(is_valid, fmin(down, up) * (1 - 1e-6), 0)

    def _fall(self, gap: Real) -> Real:
        """A length of the ray on which w (the signed distance from the two ends) falls by less than
        `gap`; infinite if w never falls so far."""
        # w never falls by the gap if |height| grows along the ray, or if |height| is less than the
        # gap, so that the height comes to 0 before.
        is_unreached = (self.height * self.rate >= 0) | (gap > dr.abs(self.height))
        length = dr.select(is_unreached, dr.inf, gap / dr.abs(self.rate))
        return dr.select((gap > 0) & (length >= 0), length, 0)

    def _rise(self, gap: Real) -> Real:
        """A length of the ray on which w (the signed distance from the two ends) rises by less than
        `gap`; infinite if w is constant along the ray."""
        # w falls until the height is 0, and rises from there on.
        is_falling = self.height * self.rate < 0
        path = gap + dr.select(is_falling, 2 * dr.abs(self.height), 0)
        length = dr.select(self.rate == 0, dr.inf, path / dr.abs(self.rate))
        return dr.select((gap > 0) & (length >= 0), length, 0)


def outline_distance_jet(nearest: Callable[[Real, Real], OutlineSample], x: Jet, y: Jet) -> Jet:
    """The jet (proved ranges of value and derivatives) of a signed distance d in the plane, from
    the jets of the coordinates (x, y).

    nearest: a function that returns the sample of d at a point (u, v).
    x, y: the jets of the coordinates, at a point or on a piece of a line.

    Proof. d has the Lipschitz constant 1. So its derivative by any variable is at most the length
    of the derivative of (x, y) by that variable, and its value at the start is known up to the
    error of the coordinates there. On a piece d may have kinks, so that second derivatives have no
    bound. At a point, the gradient and the second derivatives are those of the distance from the
    nearest edge or vertex. If coordinates are ranges that stand for a ball, and not numbers with
    their rounding, another edge may be nearest, as on a piece; then the bounds of the piece are
    used.
    """
    # The jets at the start of the piece; at a point, the jets themselves.
    starts = [
        coordinate if coordinate.jet_at_start is None else coordinate.jet_at_start
        for coordinate in (x, y)
    ]
    zero = 0 * x.piece_length
    u, v = (zero + coordinate.value.midpoint for coordinate in starts)
    nearest_sample = nearest(u, v)
    # A bound of the error of the coordinates at the start.
    input_error = zero + starts[0].value.radius + starts[1].value.radius
    size = dr.abs(u) + dr.abs(v) + dr.abs(nearest_sample.value)
    is_ball = input_error > _MAX_POINT_ROUNDINGS * float(dr.epsilon(size)) * size
    value_error = nearest_sample.error + input_error
    value = Interval(nearest_sample.value, nearest_sample.value).widened(1e-6, 0.0)
    value = value + Interval(-value_error, value_error)

    def lipschitz_range(i: int, jet_u: Jet, jet_v: Jet) -> Interval:
        """The range of the derivative of d by the variable i of the jets, as it follows from the
        Lipschitz constant 1 of d.

        jet_u, jet_v: the jets of the two coordinates.
        """
        a, b = zero + jet_u.first_derivatives[i].max_abs, zero + jet_v.first_derivatives[i].max_abs
        # (1e-5 covers the rounding of the length.)
        limit = dr.sqrt(dr.fma(a, a, b * b)) * (1 + 1e-5)
        return Interval(-limit, limit)

    def or_range_on_ball(at_point: Interval, on_ball: Interval) -> Interval:
        """An interval that is `at_point` on lanes where the coordinates are those of a point, and
        `on_ball` on lanes where they are ranges that stand for a ball.

        at_point: an interval that holds at a point.
        on_ball: an interval that holds on a ball.
        """
        lower, upper = (
            (zero + at_point.lower, on_ball.lower),
            (zero + at_point.upper, on_ball.upper),
        )
        return Interval(*(dr.select(is_ball, b, a) for a, b in (lower, upper)))

    all_numbers = Interval(zero - dr.inf, zero + dr.inf)
    errors = Interval(zero - nearest_sample.gradient_error, zero + nearest_sample.gradient_error)
    # The gradient of d with its error, as intervals. By the chain rule, the derivative of d by a
    # variable is its product with the derivative of (u, v) by that variable; the Lipschitz constant
    # narrows it. From here on u and v are the jets of the coordinates at the start.
    gx, gy = (Interval.point(component) + errors for component in nearest_sample.gradient)
    count = range(len(x.first_derivatives))
    u, v = starts
    ranges = tuple(lipschitz_range(i, u, v) for i in count)
    slopes = tuple(
        or_range_on_ball(
            (gx * u.first_derivatives[i] + gy * v.first_derivatives[i]).intersect(ranges[i]),
            ranges[i],
        )
        for i in count
    )
    # How fast (u, v) moves across the gradient. The second derivative of d is `curvature` in that
    # direction, and 0 along the gradient.
    across = [gx * v.first_derivatives[i] - gy * u.first_derivatives[i] for i in count]
    curvature = Interval.point(zero + nearest_sample.second_derivative).widened(
        1e-5 + nearest_sample.gradient_error
    )
    second = tuple(
        or_range_on_ball(
            curvature * across[i] * across[j]
            + gx * u.second_derivatives[k]
            + gy * v.second_derivatives[k],
            all_numbers,
        )
        for k, (i, j) in enumerate(u.hessian_indices())
    )
    start = Jet(value, slopes, second, piece_length=u.piece_length)
    if x.jet_at_start is None:
        return start
    # On a piece only the Lipschitz constant is used. The first variable is the length along the
    # piece.
    first = tuple(lipschitz_range(i, x, y) for i in count)
    piece_value = value + range_times_length(first[0], x.piece_length)
    unknown_second = (all_numbers,) * len(x.second_derivatives)
    return Jet(piece_value, first, unknown_second, start, x.piece_length)


@dataclass(frozen=True, eq=False)
class SolidOfRevolution(Solid):
    """The solid of revolution, about the z axis, of an outline in the half-plane (r, z), where r is
    the distance from the axis. f is the signed distance from its surface, which is the signed
    distance of the point (r, z) from the outline.

    loops: the outline, an array (n, 2) of the vertices (r, z) of a closed loop, or several such
        arrays (a point is inside if an odd number of loops surrounds it). Edges on the axis are
        inside of the solid, and no part of its surface.

    f has the Lipschitz constant 1. Proof. The point of the surface nearest to p lies in the
    half-plane that is bounded by the axis and contains p. So f is the signed distance of (r, z)
    from the outline. Along a ray, `OutlineEdges.sample` bounds the distance on the line that is
    tangent to the curve (r(s), z(s)) at its start. The curve departs from that line in r alone.
    r(s) is convex along the ray, and lies above its tangent by e(s) = (c/r)^2 s^2/(r(s) + r + r' s)
    >= 0, where c/r is the component of the direction across the half-plane. As the distance has the
    Lipschitz constant 1, at the true point it is less than at the point of the line by at most
    e(s). So the lower bounds along the line are reduced by e(s). A concave bound minus a convex
    function is still concave, and `TangentEnclosure` needs no more than that.

    Raises:
        ValueError: loops that enclose no area, or with points of r < 0.
    """

    loops: Any

    lipschitz = 1.0

    def __post_init__(self) -> None:
        """Check the loops.

        Raises:
            ValueError: loops that enclose no area, or with points of r < 0.
        """
        loops = make_outline(self.loops)
        min_radius = min(float(loop[:, 0].min()) for loop in loops)
        if min_radius < 0:
            raise ValueError(
                f"an outline that is revolved lies in r >= 0, and this one reaches {min_radius:g}"
            )
        set_frozen(self, "loops", loops)

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        return {"edges": sum(map(len, self.loops))}

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box of the solid, grown by the level
        on each side. None if `above` (a volume for all points where f >= level), as these points
        are unbounded."""
        if above:
            return None
        points = np.concatenate(self.loops)
        radius = float(points[:, 0].max()) + level
        lower, upper = float(points[:, 1].min()), float(points[:, 1].max())
        half = 0.5 * (upper - lower) + level
        return box_around((radius, radius, half), (0.0, 0.0, 0.5 * (lower + upper)))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        del plan
        return _SolidOfRevolutionEvaluator(self._upload(backend))

    @cached_upload
    def _upload(self, backend: Backend) -> OutlineEdges:
        """Upload the edges of the outline to a backend."""
        return OutlineEdges.upload(backend, self.loops, axis=True)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return self.formula_on(_backend_of_coordinate(x, type(self).__name__))(x, y, z)


@dataclass(frozen=True, eq=False)
class _SolidOfRevolutionEvaluator(Evaluator):
    """The evaluator of a `SolidOfRevolution`.

    outline: the edges of the outline.
    """

    outline: OutlineEdges

    def evaluate(self, p: Vec3) -> Sample:
        r, outward = _from_axis(p)
        return self._sample(p, r, outward, self.outline.sample(r, p.z))

    def _sample(self, p: Vec3, r: Real, outward: tuple[Real, Real], side: OutlineSample) -> Sample:
        """The sample of f at p, from the sample of the signed distance from the outline at (r, z).

        r: the distance of p from the axis.
        outward: x and y of the unit vector from the axis to p.
        side: the sample of the distance from the outline.
        """
        epsilon = 2 * float(dr.epsilon(type(p.x)))  # the machine epsilon
        radial, up = side.gradient
        gradient = cast("Any", type(p))(radial * outward[0], radial * outward[1], up)
        error = side.error + 8 * epsilon * r
        return Sample(
            side.value,
            gradient,
            (Lipschitz(0 * p.x + 1),),  # the constant 1, on each lane
            error,
            side.gradient_error + 8 * epsilon,
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the point of a ray with parameter t, with an enclosure (a proved bound of
        the change of f along the ray) in front of the point, up to the length `ahead`. Behind the
        point there is no enclosure.

        In the half-plane (r, z) the ray is a curve. The enclosure is that of the distance from the
        outline along the tangent line of this curve at the point. Its lower bounds are reduced by
        the distance between curve and line, `_tangent_gap`. If the caller asks for other kinds of
        enclosures, they follow from the Lipschitz constant 1.

        path: the ray.
        ahead, back: the lengths in front of and behind the point; `back` is not used.
        """
        del back
        p, d = path.point(t), path.direction
        # The caller chooses kinds of enclosures. The one below is used with the sharpest choice,
        # which is the one that has `PiecewiseTaylorEnclosure`.
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        outline = self.outline
        r, (unit_x, unit_y) = _from_axis(p)
        knots = outline.knots(r, p.z, ahead)
        # The components of the ray's direction away from the axis and around it.
        rate, across = unit_x * d.x + unit_y * d.y, unit_x * d.y - unit_y * d.x
        side = outline.sample(r, p.z, (rate, d.z), knots)
        epsilon = 2 * float(dr.epsilon(type(r)))  # the machine epsilon
        lower_bounds = tuple(
            bound - _tangent_gap(r, rate, across, knot, epsilon)
            for bound, knot in zip(side.lower_bounds, knots, strict=True)
        )
        # A bound that is NaN (infinity minus infinity, at an infinite knot) proves nothing. Only
        # NaN differs from itself.
        lower_bounds = tuple(dr.select(bound == bound, bound, -dr.inf) for bound in lower_bounds)
        # For the rounding of r.
        rounding = 8 * epsilon * r
        side = OutlineSample(
            side.value, side.gradient, side.error + rounding, side.gradient_error + 8 * epsilon,
            side.second_derivative, tuple(bound - rounding for bound in lower_bounds),
        )  # fmt: skip
        sample = self._sample(p, r, (unit_x, unit_y), side)
        slope = dr.dot(sample.gradient, d)
        enclosures = (SignedDistanceEnclosure.around(side, slope, knots),)
        return RaySample(
            sample, enclosures, (), slope, _REACH_GROWTH, min_gradient_norm=_MIN_GRADIENT
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are Dr.Jit numbers, or jets (ranges of numbers and of their
        derivatives)."""
        if not is_jet(x, self.name):
            return self.differentiable_value(_vector(x, y, z))
        return outline_distance_jet(self.outline.sample, norm(x, y), z)


def _from_axis(p: Vec3) -> tuple[Real, tuple[Real, Real]]:
    """The distance of p from the z axis, and x and y of the unit vector that points from the axis
    to p. For p on the axis the vector is (1, 0)."""
    r = dr.sqrt(dr.fma(p.x, p.x, p.y * p.y))
    is_off_axis = r > 0
    return r, (dr.select(is_off_axis, p.x / r, 1), dr.select(is_off_axis, p.y / r, 0))


def _tangent_gap(r: Real, rate: Real, across: Real, s: Real, epsilon: float) -> Real:
    """By how much r(s) is above its tangent line at s = 0, rounded upwards. r(s) is the distance
    from the axis along a ray: r(s)^2 = (r + rate s)^2 + (across s)^2, and the tangent line is r +
    rate s.

    r: the distance at s = 0.
    rate, across: the components of the ray's direction away from the axis and around it.
    s: the length along the ray.
    epsilon: the machine epsilon.
    """
    line, sideways = r + rate * s, across * s
    length = dr.sqrt(dr.fma(line, line, sideways * sideways))
    # The gap is length - line. In the first form, sideways^2/(length + line), nothing cancels, but
    # it needs a positive divisor.
    gap = dr.select(line > 0, sideways / (length + line) * sideways, length - line)
    return gap * (1 + 1e-5) + 16 * epsilon * (dr.abs(line) + dr.abs(sideways))
