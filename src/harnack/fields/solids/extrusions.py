"""Solids from outlines in the plane: `Extrusion` along the z axis, `SolidOfRevolution` about it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Interval, Jet, norm
from harnack.arithmetic.jet import range_times_length
from harnack.arithmetic.norms import orthogonal_intersection
from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_finite, as_positive
from harnack.enclosures import Enclosure, LevelGaps, Lipschitz
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.fields.batched_fields import cached_prepare
from harnack.fields.formula import is_jet
from harnack.fields.samples import Ray, RaySample, Sample
from harnack.fields.solids.deformations import Taper, Twist
from harnack.fields.solids.outline_distance import (
    OutlineEdges,
    OutlineSample,
    SignedDistanceEnclosure,
)
from harnack.fields.solids.solid import Solid, box_around, set_frozen
from harnack.geometry.outline_loops import make_outline

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

# The next ray sample is bounded up to this multiple of the last step: evaluations are expensive, so
# that long proofs pay (`RaySample.reach_growth`).
_REACH_GROWTH = 4.0
# A lower bound of |gradient| of a signed distance, which is 1 wherever the gradient exists.
_MIN_GRADIENT = 0.99
# If coordinates of jets have an error of more than this many roundings, they stand for a range.
_MAX_POINT_ROUNDINGS = 256.0


@dataclass(frozen=True, eq=False)
class Extrusion(Solid):
    """An extruded region of the plane z = 0: the points above the region, with 0 <= z <= height.

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
    right angles (`orthogonal_intersection`). So its Lipschitz constant is 1. Along a path more is
    proved: see `ExtrusionEnclosure`.

    With twist or taper, f at p is this function at the preimage of p, which has the same z. Along a
    path f changes no faster than the preimage moves; ranges bound its speed. Proof of the promise
    in all directions. Let c be the Lipschitz constant of the inverse of the taper on a ball about p
    of radius R, and b that of the inverse of the twist on a ball of radius S about the point that
    the first returns (proofs: `Taper`, `Twist`). Then both maps together have the constant b c
    within min(R, S/c). So has f, because the signed distance has the constant 1.

    Raises:
        ValueError: loops that enclose no area; a height or a taper that is not positive.
    """

    loops: Any
    height: float
    twist: float = 0.0
    taper: float = 1.0

    def __post_init__(self) -> None:
        """Check the arguments, and make the maps `Twist` and `Taper`."""
        set_frozen(self, "loops", make_outline(self.loops))
        height = as_positive(self.height, "the height of an extruded outline")
        twist = as_finite(self.twist, "the twist of an extruded outline, in degrees,")
        taper = as_positive(self.taper, "the taper of an extruded outline")
        for name, value in (("height", height), ("twist", twist), ("taper", taper)):
            set_frozen(self, name, value)
        set_frozen(self, "_turning", Twist(math.radians(twist) / height) if twist else None)
        profile = (0.0, 1.0), (height, taper)
        set_frozen(self, "_tapering", Taper(*profile) if taper != 1.0 else None)
        set_frozen(self, "lipschitz", 1.0 if self.is_straight else None)

    @property
    def is_straight(self) -> bool:
        """Whether it has neither twist nor taper."""
        return self.twist == 0.0 and self.taper == 1.0

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def describe(self) -> dict[str, Any]:
        return {"edges": sum(map(len, self.loops))}

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: a box around the outline, grown by the
        level. For a twisted or tapered solid it contains the images of that box at all heights.
        None if `above`."""
        if above:
            return None
        points = np.concatenate(self.loops)
        lower, upper = points.min(axis=0) - level, points.max(axis=0) + level
        if not self.is_straight:
            max_scale = max(1.0, self.taper)
            lower, upper = max_scale * np.minimum(lower, 0.0), max_scale * np.maximum(upper, 0.0)
        if self.twist:
            radius = float(np.linalg.norm(points, axis=1).max()) + max(level, 0.0)
            upper = np.full(2, radius * max(1.0, self.taper))
            lower = -upper
        (half_x, half_y), (center_x, center_y) = 0.5 * (upper - lower), 0.5 * (upper + lower)
        half_height = 0.5 * self.height
        return box_around(
            (float(half_x), float(half_y), half_height + level),
            (float(center_x), float(center_y), half_height),
        )

    @cached_prepare
    def prepare(self, backend: Backend) -> Extrusion:
        """The same solid with its edges and numbers on the backend."""
        prepared = copy.copy(self)
        set_frozen(prepared, "_outline", OutlineEdges.upload(backend, self.loops))
        set_frozen(prepared, "_half", dr.opaque(backend.Float, 0.5 * self.height))
        for name in ("_turning", "_tapering"):
            deform = getattr(self, name)
            set_frozen(prepared, name, None if deform is None else deform.prepare(backend))
        return prepared

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p. Without twist and taper it follows from that of the outline in the
        plane. Otherwise the outline is sampled at the preimage of p. Ranges of the preimage and of
        its derivatives then give the gradient by the chain rule, and the errors."""
        solid = _prepared_for(self, p)
        if self.is_straight:
            planar = solid._outline.sample(p.x, p.y)
            return solid._sample_of_outline(p, planar, cast("Any", type(p))(*planar.gradient, 0))
        x, y, _ = solid._preimage(*Jet.at_point(p))
        zero = 0 * p.x
        u, v = (zero + component.value.midpoint for component in (x, y))
        planar = solid._outline.sample(u, v)
        spread = zero + x.value.radius + y.value.radius
        gradient_ranges = [
            Interval.point(planar.gradient[0]) * a + Interval.point(planar.gradient[1]) * b
            for a, b in zip(x.first_derivatives, y.first_derivatives, strict=True)
        ]
        gradient = cast("Any", type(p))(
            *(zero + component.midpoint for component in gradient_ranges)
        )
        constant, radius = solid._preimage_lipschitz(p)
        error = (
            sum((component.radius for component in gradient_ranges), zero)
            + planar.gradient_error * constant
        )
        moved = OutlineSample(planar.value, planar.gradient, planar.error + 2 * spread, error)
        return solid._sample_of_outline(p, moved, gradient, Lipschitz(constant, radius))

    def _sample_of_outline(
        self, p: Vec3, side: OutlineSample, gradient: Vec3, promise: Lipschitz | None = None
    ) -> Sample:
        """The sample of the solid at p, from that of the outline in the plane and the distance from
        the ends.

        side: the sample of the distance from the outline.
        gradient: the gradient of that distance as a function in space.
        promise: a Lipschitz constant of f; None for the constant 1 everywhere.
        """
        epsilon = 2 * float(dr.epsilon(type(p.x)))
        half = cast("Any", self)._half
        end_distance = dr.abs(p.z - half) - half
        value, side_weight, end_weight = _corner(side.value, end_distance)
        vertical = dr.mulsign(end_weight, p.z - half)
        gradient = gradient * side_weight + cast("Any", type(p))(0, 0, vertical)
        error = side.error + 8 * epsilon * (dr.abs(p.z) + half)
        gradient_error = side.gradient_error + 8 * epsilon
        # Where both distances count, their weights are as accurate as the distances.
        gradient_error = gradient_error + dr.select(
            (side_weight > 0) & (end_weight > 0), fmin(2 * error / value, 2), 0
        )
        promises = (Lipschitz(0 * p.x + 1) if promise is None else promise,)
        return Sample(value, gradient, promises, error, gradient_error)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The ray sample. Without twist and taper its enclosure (the proof of bounds of f along the
        ray) is an `ExtrusionEnclosure`. Otherwise its enclosures follow from a Lipschitz constant
        along the ray, the speed of the preimage. It has no enclosure looking back. If the caller
        asks for other kinds of enclosures, those of the promises are used."""
        del back
        p, d = path.point(t), path.direction
        if not self.is_straight:
            sample = self.evaluate(p)
            min_norm = self._min_gradient_norm(sample)
            path_constant = _prepared_for(self, p)._path_lipschitz(
                p, d, fmin(ahead, 2 * dr.abs(sample.value))
            )
            ray_sample = path.enclose(replace(sample, ray_promises=(path_constant,)))
            # The speed has no bound looking back.
            return replace(ray_sample, backward=(), min_gradient_norm=min_norm)
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        solid = _prepared_for(self, p)
        outline: OutlineEdges = solid._outline
        knots = outline.knots(p.x, p.y, ahead)
        planar = outline.sample(p.x, p.y, (d.x, d.y), knots)
        sample = solid._sample_of_outline(p, planar, cast("Any", type(p))(*planar.gradient, 0))
        planar_slope = planar.gradient[0] * d.x + planar.gradient[1] * d.y
        planar_enclosure = SignedDistanceEnclosure.around(planar, planar_slope, knots)
        height = p.z - solid._half
        enclosure = ExtrusionEnclosure(
            sample.value, sample.value_error, planar_enclosure, height, solid._half, d.z
        )
        slope = dr.dot(sample.gradient, d)
        return RaySample(
            sample, (enclosure,), (), slope, _REACH_GROWTH, min_gradient_norm=_MIN_GRADIENT
        )

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at coordinates that are jets or Dr.Jit numbers."""
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(_vector(x, y, z))
        solid = _prepared_for(self, x.piece_length)
        u, v, w = solid._preimage(x, y, z)
        return orthogonal_intersection(
            outline_distance_jet(solid._outline.sample, u, v), abs(w - solid._half) - solid._half
        )

    def _preimage(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The preimage of (x, y, z): the point that taper and twist map to it. Coordinates may be
        numbers of any arithmetic."""
        for deform in (cast("Any", self)._tapering, cast("Any", self)._turning):
            if deform is not None:
                x, y, z = deform.preimage(x, y, z)
        return x, y, z

    def _path_lipschitz(self, p: Vec3, direction: Vec3, length: Real) -> Lipschitz:
        """A Lipschitz constant of f along the path from p, up to the length `length`. It is the
        largest speed of the preimage of the path's point, as f has the Lipschitz constant 1 in the
        preimage."""
        local = self._preimage(*Jet.along_ray(p, direction, 0.0, length))
        speeds = [0 * p.x + jet.first_derivatives[0].max_abs for jet in local]
        speed = dr.norm(cast("Any", type(p))(*speeds)) * (1 + 1e-5)
        is_known = dr.isfinite(speed) & (length > 0)
        return Lipschitz(dr.select(is_known, speed, dr.inf), dr.select(is_known, length, 0))

    def _min_gradient_norm(self, sample: Sample) -> Real:
        """A lower bound of |grad f|, from the Lipschitz constant c that a sample promises.

        Proof. f at p is the signed distance of an outline's extrusion, whose gradient is at least
        `_MIN_GRADIENT` long, at the preimage of p. So |grad f| is at least `_MIN_GRADIENT` times
        the smallest singular value of the derivative of the inverse map, and that is at least the
        product of the smallest singular values for the twist and for the taper. For the twist, the
        singular values are s, 1 and 1/s with s >= 1, so the smallest is 1/s. For the taper, they
        are k and those of a 2 x 2 matrix of determinant k. Let q be the larger of these two; then q
        >= k and q >= 1, so the smallest is at least k/q. As c is at least s q, and k at least
        1/max(1, taper), k/(s q) is at least 1/(max(1, taper) c).
        """
        (promise,) = sample.promises
        return _MIN_GRADIENT / (max(1.0, self.taper) * cast("Lipschitz", promise).constant)

    def _preimage_lipschitz(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of the inverse map (`_preimage`) on a ball about p, and the radius
        of that ball."""
        taper, twist = cast("Any", self)._tapering, cast("Any", self)._turning
        constant, radius = 0 * p.x + 1, 0 * p.x + dr.inf
        if taper is not None:
            constant, radius = taper.preimage_lipschitz(p)
            p = cast("Any", type(p))(*taper.preimage(p.x, p.y, p.z))
        if twist is not None:
            inner_constant, inner_radius = twist.preimage_lipschitz(p)
            constant, radius = (
                constant * inner_constant,
                fmin(radius, inner_radius / constant * (1 - 1e-5)),
            )
        return constant, radius


def _prepared_for(solid: Any, like: Any) -> Any:
    """The solid, prepared for the backend of `like`, a number or a point. A solid that is prepared
    is returned as it is."""
    return solid if hasattr(solid, "_outline") else solid.prepare(backend_of(like))


def _vector(x: Real, y: Real, z: Real) -> Vec3:
    """The Dr.Jit 3-vector with these components."""
    return backend_of(x).Array3f(x, y, z)


def _corner(d: Real, w: Real) -> tuple[Real, Real, Real]:
    """The signed distance from two faces at right angles (`orthogonal_intersection`), and its
    derivatives by d and by w.

    d, w: the signed distances from each of the faces.
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
    """An enclosure of the signed distance f from an extruded outline along a path.

    value, error: f at the start, and a bound of its error.
    side: the enclosure of the distance d from the outline in the plane.
    height: z above the middle of the solid.
    half: half of the solid's height. So w = |height| - half is the distance from the ends.
    rate: the derivative of z along the path.

    Proof. max(d, w) <= f, with equality where f <= 0. So f stays above a level as long as d does or
    w does, and it stays below a level <= 0 as long as both do. The errors of d and w are at most
    `error`. Besides, f changes by no more than the length of the path. Along a line w is |height|
    less a constant. If w falls, it reaches the value lower by g at the length g/|rate|, unless the
    height comes to 0 before. If it rises, it never reaches that value. It reaches the value higher
    by g at the length g/|rate| if it rises, and at (2 |height| + g)/|rate| if it falls first.
    """

    value: Real
    error: Real
    side: SignedDistanceEnclosure
    height: Real
    half: Real
    rate: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """The length of the path on which f is proved to meet neither the level above nor the level
        below.

        In the code the deficits are by how much w and d are less than f at the start, error
        included.
        """
        inf = type(gaps.below)(dr.inf)
        end_distance = dr.abs(self.height) - self.half
        end_deficit, side_deficit = (
            self.value - end_distance + self.error,
            self.value - self.side.value + self.error,
        )
        down = fmax(gaps.below, self._fall(gaps.below - end_deficit))
        side_gap = gaps.below - side_deficit
        down = fmax(
            dr.select(side_gap > 0, self.side.free_length(LevelGaps(side_gap, inf)), 0), down
        )
        is_inside = self.value + gaps.above + self.error <= 0  # also for unrounded numbers
        error = 2 * self.error
        up = fmin(
            self._rise(gaps.above + end_deficit - error),
            self.side.free_length(LevelGaps(inf, fmax(gaps.above + side_deficit - error, 0))),
        )
        up = fmax(gaps.above, dr.select(is_inside, up, 0))
        is_valid = (gaps.below >= 0) & (gaps.above >= 0)
        return dr.select(is_valid, fmin(down, up) * (1 - 1e-6), 0)

    def _fall(self, gap: Real) -> Real:
        """A length of the path on which w falls by less than `gap`."""
        is_unreached = (self.height * self.rate >= 0) | (gap > dr.abs(self.height))
        length = dr.select(is_unreached, dr.inf, gap / dr.abs(self.rate))
        return dr.select((gap > 0) & (length >= 0), length, 0)

    def _rise(self, gap: Real) -> Real:
        """A length of the path on which w rises by less than `gap`."""
        is_falling = self.height * self.rate < 0
        path = gap + dr.select(is_falling, 2 * dr.abs(self.height), 0)
        length = dr.select(self.rate == 0, dr.inf, path / dr.abs(self.rate))
        return dr.select((gap > 0) & (length >= 0), length, 0)


def outline_distance_jet(nearest: Callable[[Real, Real], OutlineSample], x: Jet, y: Jet) -> Jet:
    """The jet of a signed distance d in the plane.

    nearest: a function that returns the sample of d at a point (u, v).
    x, y: jets of the coordinates.

    Proof. d has the Lipschitz constant 1. So its derivative by any variable is at most the length
    of the derivative of (x, y) by that variable, and its value at the start is known up to the
    error of the coordinates there. On a piece d may have kinks, so that second derivatives have no
    bound. At a point, the gradient and the second derivatives are those of the distance from the
    nearest edge or vertex. If coordinates are ranges that stand for a ball, and not numbers with
    their rounding, another edge may be nearest, as on a piece.
    """
    starts = [jet_u if jet_u.jet_at_start is None else jet_u.jet_at_start for jet_u in (x, y)]
    zero = 0 * x.piece_length
    u, v = (zero + jet_u.value.midpoint for jet_u in starts)
    nearest_sample = nearest(u, v)
    input_error = zero + starts[0].value.radius + starts[1].value.radius
    size = dr.abs(u) + dr.abs(v) + dr.abs(nearest_sample.value)
    is_ball = input_error > _MAX_POINT_ROUNDINGS * float(dr.epsilon(size)) * size
    value_error = nearest_sample.error + input_error
    value = Interval(nearest_sample.value, nearest_sample.value).widened(1e-6, 0.0)
    value = value + Interval(-value_error, value_error)

    def lipschitz_range(i: int, jet_u: Jet, jet_v: Jet) -> Interval:
        """The range of the derivative of d by variable i that the Lipschitz constant 1 of d proves.

        jet_u, jet_v: the jets of the two coordinates.
        """
        a, b = zero + jet_u.first_derivatives[i].max_abs, zero + jet_v.first_derivatives[i].max_abs
        limit = dr.sqrt(dr.fma(a, a, b * b)) * (1 + 1e-5)
        return Interval(-limit, limit)

    def or_range_on_ball(jet_u: Interval, limit: Interval) -> Interval:
        """An interval: `jet_u` where the coordinates are those of a point, and `limit` where they
        are ranges that stand for a ball."""
        lower, upper = (zero + jet_u.lower, limit.lower), (zero + jet_u.upper, limit.upper)
        return Interval(*(dr.select(is_ball, b, a) for a, b in (lower, upper)))

    all_numbers = Interval(zero - dr.inf, zero + dr.inf)
    errors = Interval(zero - nearest_sample.gradient_error, zero + nearest_sample.gradient_error)
    gx, gy = (Interval.point(jet_u) + errors for jet_u in nearest_sample.gradient)
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
    first = tuple(lipschitz_range(i, x, y) for i in count)
    piece_value = value + range_times_length(first[0], x.piece_length)
    unknown_second = (all_numbers,) * len(x.second_derivatives)
    return Jet(piece_value, first, unknown_second, start, x.piece_length)


@dataclass(frozen=True, eq=False)
class SolidOfRevolution(Solid):
    """The solid of revolution, about the z axis, of an outline in the half-plane (r, z), r >= 0.

    loops: the outline, an array (n, 2) of the vertices (r, z) of a closed loop, or several such
        arrays (even-odd rule). Edges on the axis are inside of the solid, and no part of its
        surface.

    f is the signed distance, with the Lipschitz constant 1. Proof. The nearest point of a surface
    of revolution lies in the half-plane of p, so f is the signed distance of (r, z) from the
    outline. Along a path, `OutlineEdges.sample` bounds the distance on the tangent line of (r, z).
    The point (r, z) departs from that line in r alone. r(s) is convex along the path, and lies
    above its tangent by e(s) = (c/r)^2 s^2/(r(s) + r + r' s) >= 0, where c/r is the component of
    the direction across the half-plane. As the distance has the constant 1, it is less by at most
    e(s). A concave bound less a convex function is still concave, and `TangentEnclosure` needs no
    more than that.

    Raises:
        ValueError: loops that enclose no area, or with points of r < 0.
    """

    loops: Any

    lipschitz = 1.0

    def __post_init__(self) -> None:
        """Check the loops."""
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
        if above:
            return None
        points = np.concatenate(self.loops)
        radius = float(points[:, 0].max()) + level
        lower, upper = float(points[:, 1].min()), float(points[:, 1].max())
        half = 0.5 * (upper - lower) + level
        return box_around((radius, radius, half), (0.0, 0.0, 0.5 * (lower + upper)))

    @cached_prepare
    def prepare(self, backend: Backend) -> SolidOfRevolution:
        prepared = copy.copy(self)
        set_frozen(prepared, "_outline", OutlineEdges.upload(backend, self.loops, axis=True))
        return prepared

    def evaluate(self, p: Vec3) -> Sample:
        r, outward = _from_axis(p)
        return self._sample(p, r, outward, _prepared_for(self, p)._outline.sample(r, p.z))

    def _sample(self, p: Vec3, r: Real, outward: tuple[Real, Real], side: OutlineSample) -> Sample:
        """The sample at p, from that of the outline in the half-plane.

        r: the distance of p from the axis.
        outward: x and y of the unit vector from the axis to p.
        side: the sample of the signed distance from the outline at (r, z).
        """
        epsilon = 2 * float(dr.epsilon(type(p.x)))
        radial, up = side.gradient
        gradient = cast("Any", type(p))(radial * outward[0], radial * outward[1], up)
        error = side.error + 8 * epsilon * r
        return Sample(
            side.value,
            gradient,
            (Lipschitz(0 * p.x + 1),),
            error,
            side.gradient_error + 8 * epsilon,
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The ray sample. Its enclosure is that of the distance from the outline along the tangent
        line of the path in the half-plane, whose lower bounds are reduced by `_tangent_gap`. It has
        no enclosure looking back."""
        del back
        p, d = path.point(t), path.direction
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        outline: OutlineEdges = _prepared_for(self, p)._outline
        r, (unit_x, unit_y) = _from_axis(p)
        knots = outline.knots(r, p.z, ahead)
        rate, across = unit_x * d.x + unit_y * d.y, unit_x * d.y - unit_y * d.x
        side = outline.sample(r, p.z, (rate, d.z), knots)
        epsilon = 2 * float(dr.epsilon(type(r)))
        lower_bounds = tuple(
            bound - _tangent_gap(r, rate, across, knot, epsilon)
            for bound, knot in zip(side.lower_bounds, knots, strict=True)
        )
        lower_bounds = tuple(dr.select(bound == bound, bound, -dr.inf) for bound in lower_bounds)
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
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(_vector(x, y, z))
        return outline_distance_jet(_prepared_for(self, x.width)._outline.nearest, norm(x, y), z)


def _from_axis(p: Vec3) -> tuple[Real, tuple[Real, Real]]:
    """The distance of p from the z axis, and the unit vector (x, y) that points away from the axis;
    for p on the axis, any unit vector."""
    r = dr.sqrt(dr.fma(p.x, p.x, p.y * p.y))
    is_off_axis = r > 0
    return r, (dr.select(is_off_axis, p.x / r, 1), dr.select(is_off_axis, p.y / r, 0))


def _tangent_gap(r: Real, rate: Real, across: Real, s: Real, epsilon: float) -> Real:
    """By how much r(s) is above its tangent line at s = 0, rounded upwards, where r(s)^2 = (r +
    rate s)^2 + (across s)^2 is the squared distance from the axis.

    r: at s = 0.
    rate, across: the components of the path's direction away from the axis and around it.
    """
    line, sideways = r + rate * s, across * s
    length = dr.sqrt(dr.fma(line, line, sideways * sideways))
    gap = dr.select(line > 0, sideways / (length + line) * sideways, length - line)
    return gap * (1 + 1e-5) + 16 * epsilon * (dr.abs(line) + dr.abs(sideways))
