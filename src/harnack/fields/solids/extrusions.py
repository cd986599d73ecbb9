"""Outlines in the plane made solid: `Extrusion` along the z axis, `SolidOfRevolution` about it."""

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

# What one evaluation costs allows looks that reach so much farther than the last step.
_GROWTH = 4.0
# Of a signed distance the gradient is a unit vector wherever it exists.
_MIN_GRADIENT = 0.99
# Coordinates in jets that are known only up to more roundings are ranges.
_RANGE_ROUNDINGS = 256.0


@dataclass(frozen=True, eq=False)
class Extrusion(Solid):
    """The points over a region of the plane z = 0, of 0 <= z <= height.

    loops: the outline of the region: an array (n, 2) of the vertices of a closed loop, or several.
        A point is inside if an odd number of loops runs around it (the even-odd rule), so that
        loops in loops are holes, and islands in these, whichever way they run. Loops that cross or
        touch are cut there. Stored as `harnack.geometry.make_outline` returns them.
    height: along z.
    twist: by so many degrees the end is turned against the start, counter-clockwise as seen from
        above, about the z axis.
    taper: by this factor the end is scaled, about the z axis.

    With neither twist nor taper, f is the signed distance: the distance d from the outline in the
    plane, exact over all edges, and that from the ends, at right angles (`corner`). So its constant
    is 1. Along a path more is proved: see `ExtrusionEnclosure`.

    Else f is that function of the point that is mapped to p, which has the same z. Along a path it
    moves no faster than that point, whose speed is bounded by ranges. Proof of the promise in all
    directions: on a ball about p the inverse of the taper has the constant c within R, the inverse
    of the twist, which acts on what the first returns, the constant b within S (proofs: `Taper`,
    `Twist`); so both together have b c within min(R, S/c), and f, of constant 1, has it too.

    Raises:
        ValueError: loops that enclose no area; a height or a taper that is not positive.
    """

    loops: Any
    height: float
    twist: float = 0.0
    taper: float = 1.0

    def __post_init__(self) -> None:
        set_frozen(self, "loops", make_outline(self.loops))
        height = as_positive(self.height, "the height of an extruded outline")
        twist = as_finite(self.twist, "the twist of an extruded outline, in degrees,")
        taper = as_positive(self.taper, "the taper of an extruded outline")
        for name, one in (("height", height), ("twist", twist), ("taper", taper)):
            set_frozen(self, name, one)
        set_frozen(self, "_turning", Twist(math.radians(twist) / height) if twist else None)
        scales = (0.0, 1.0), (height, taper)
        set_frozen(self, "_tapering", Taper(*scales) if taper != 1.0 else None)
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
        if above:
            return None
        points = np.concatenate(self.loops)
        low, high = points.min(axis=0) - level, points.max(axis=0) + level
        if not self.is_straight:
            most = max(1.0, self.taper)
            low, high = most * np.minimum(low, 0.0), most * np.maximum(high, 0.0)
        if self.twist:
            radius = float(np.linalg.norm(points, axis=1).max()) + max(level, 0.0)
            high = np.full(2, radius * max(1.0, self.taper))
            low = -high
        (x, y), (a, b) = 0.5 * (high - low), 0.5 * (high + low)
        half = 0.5 * self.height
        return box_around((float(x), float(y), half + level), (float(a), float(b), half))

    @cached_prepare
    def prepare(self, backend: Backend) -> Extrusion:
        made = copy.copy(self)
        set_frozen(made, "_outline", OutlineEdges.upload(backend, self.loops))
        set_frozen(made, "_half", dr.opaque(backend.Float, 0.5 * self.height))
        for name in ("_turning", "_tapering"):
            bend = getattr(self, name)
            set_frozen(made, name, None if bend is None else bend.prepare(backend))
        return made

    def evaluate(self, p: Vec3) -> Sample:
        on = _on(self, p)
        if self.is_straight:
            side = on._outline.sample(p.x, p.y)
            return on._joined(p, side, cast("Any", type(p))(*side.gradient, 0))
        x, y, _ = on._local(*Jet.at_point(p))
        zero = 0 * p.x
        u, v = (zero + one.value.midpoint for one in (x, y))
        side = on._outline.sample(u, v)
        off = zero + x.value.radius + y.value.radius
        slopes = [
            Interval.point(side.gradient[0]) * a + Interval.point(side.gradient[1]) * b
            for a, b in zip(x.first_derivatives, y.first_derivatives, strict=True)
        ]
        gradient = cast("Any", type(p))(*(zero + one.midpoint for one in slopes))
        stretch, radius = on._stretch(p)
        doubt = sum((one.radius for one in slopes), zero) + side.gradient_error * stretch
        moved = OutlineSample(side.value, side.gradient, side.error + 2 * off, doubt)
        return on._joined(p, moved, gradient, Lipschitz(stretch, radius))

    def _joined(
        self, p: Vec3, side: OutlineSample, gradient: Vec3, promise: Lipschitz | None = None
    ) -> Sample:
        """The sample of the distance from the side and from the ends.

        gradient: that of the side's distance in space."""
        unit = 2 * float(dr.epsilon(type(p.x)))
        half = cast("Any", self)._half
        ends = dr.abs(p.z - half) - half
        value, share, rest = _corner(side.value, ends)
        up = dr.mulsign(rest, p.z - half)
        gradient = gradient * share + cast("Any", type(p))(0, 0, up)
        error = side.error + 8 * unit * (dr.abs(p.z) + half)
        doubt = side.gradient_error + 8 * unit
        # Where both count, their shares are known as well as the distances.
        doubt = doubt + dr.select((share > 0) & (rest > 0), fmin(2 * error / value, 2), 0)
        known = (Lipschitz(0 * p.x + 1) if promise is None else promise,)
        return Sample(value, gradient, known, error, doubt)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        del back
        p, d = path.point(t), path.direction
        if not self.is_straight:
            sample = self.evaluate(p)
            least = self._least_slope(sample)
            along = _on(self, p)._speed(p, d, fmin(ahead, 2 * dr.abs(sample.value)))
            look = path.enclose(replace(sample, ray_promises=(along,)))
            # Nothing is known of the speed looking back.
            return replace(look, backward=(), min_gradient_norm=least)
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        on = _on(self, p)
        outline: OutlineEdges = on._outline
        knots = outline.knots(p.x, p.y, ahead)
        side = outline.sample(p.x, p.y, (d.x, d.y), knots)
        sample = on._joined(p, side, cast("Any", type(p))(*side.gradient, 0))
        rate = side.gradient[0] * d.x + side.gradient[1] * d.y
        proved = SignedDistanceEnclosure.around(side, rate, knots)
        height = p.z - on._half
        enclosure = ExtrusionEnclosure(
            sample.value, sample.value_error, proved, height, on._half, d.z
        )
        slope = dr.dot(sample.gradient, d)
        return RaySample(sample, (enclosure,), (), slope, _GROWTH, min_gradient_norm=_MIN_GRADIENT)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(_vector(x, y, z))
        on = _on(self, x.piece_length)
        u, v, w = on._local(x, y, z)
        return orthogonal_intersection(
            outline_distance_jet(on._outline.sample, u, v), abs(w - on._half) - on._half
        )

    def _local(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The point that is mapped to (x, y, z)."""
        for bend in (cast("Any", self)._tapering, cast("Any", self)._turning):
            if bend is not None:
                x, y, z = bend.preimage(x, y, z)
        return x, y, z

    def _speed(self, p: Vec3, direction: Vec3, length: Real) -> Lipschitz:
        """The largest speed of the point that is mapped to a path, up to a length: as f has the
        constant 1 there, it is one along the path."""
        local = self._local(*Jet.along_ray(p, direction, 0.0, length))
        parts = [0 * p.x + one.first_derivatives[0].max_abs for one in local]
        speed = dr.norm(cast("Any", type(p))(*parts)) * (1 + 1e-5)
        known = dr.isfinite(speed) & (length > 0)
        return Lipschitz(dr.select(known, speed, dr.inf), dr.select(known, length, 0))

    def _least_slope(self, sample: Sample) -> Real:
        """A lower bound of |grad f|, from the constant c that a sample promises.

        Proof. It is at least the least singular value of the inverse map's derivative. That of a
        twist, whose singular values are s, 1 and 1/s, is 1/s; that of a taper, k and those of a
        2 x 2 matrix of determinant k, is k/s, for s >= k, 1. c is at least the product of both s,
        and k is at least 1/max(1, taper).
        """
        (known,) = sample.promises
        return _MIN_GRADIENT / (max(1.0, self.taper) * cast("Lipschitz", known).constant)

    def _stretch(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of `_local` on a ball about p, and its radius."""
        taper, twist = cast("Any", self)._tapering, cast("Any", self)._turning
        constant, radius = 0 * p.x + 1, 0 * p.x + dr.inf
        if taper is not None:
            constant, radius = taper.preimage_lipschitz(p)
            p = cast("Any", type(p))(*taper.preimage(p.x, p.y, p.z))
        if twist is not None:
            more, reach = twist.preimage_lipschitz(p)
            constant, radius = constant * more, fmin(radius, reach / constant * (1 - 1e-5))
        return constant, radius


def _on(solid: Any, like: Any) -> Any:
    """The solid with its data on the backend of some number or point."""
    return solid if hasattr(solid, "_outline") else solid.prepare(backend_of(like))


def _vector(x: Real, y: Real, z: Real) -> Vec3:
    return backend_of(x).Array3f(x, y, z)


def _corner(d: Real, w: Real) -> tuple[Real, Real, Real]:
    """`corner` of two signed distances, and its derivatives by them."""
    both = (d > 0) & (w > 0)
    length = dr.sqrt(dr.fma(d, d, w * w))
    first = d >= w
    value = dr.select(both, length, fmax(d, w))
    share = dr.select(both, d / length, dr.select(first, 1.0, 0.0))
    rest = dr.select(both, w / length, dr.select(first, 0.0, 1.0))
    return value, share, rest


@dataclass(frozen=True)
class ExtrusionEnclosure(Enclosure):
    """The signed distance f from an extruded outline along a path.

    value, error: of f. side: what is proved of the distance d from the outline. height, half: z
    above the middle, and half of the height, so that w = |height| - half is the distance from the
    ends. rate: of z.

    Proof. max(d, w) <= f, with equality where f <= 0. So f stays above a level as long as d does or
    w does; and it stays below a level <= 0 as long as both do. d and w are off by `error` at most.
    Besides, f moves by no more than the length of the path. w is |z| along a line: at a distance
    g below, it arrives after g/|rate| if it falls, and never if it rises, or if z = 0 lies before;
    g above, after g/|rate| if it rises and after (2 |z| + g)/|rate| if it falls first.
    """

    value: Real
    error: Real
    side: SignedDistanceEnclosure
    height: Real
    half: Real
    rate: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        none = type(gaps.below)(dr.inf)
        ends = dr.abs(self.height) - self.half
        below, beside = self.value - ends + self.error, self.value - self.side.value + self.error
        down = fmax(gaps.below, self._fall(gaps.below - below))
        aside = gaps.below - beside
        down = fmax(dr.select(aside > 0, self.side.free_length(LevelGaps(aside, none)), 0), down)
        inside = self.value + gaps.above + self.error <= 0  # also for unrounded numbers
        more = 2 * self.error
        up = fmin(
            self._rise(gaps.above + below - more),
            self.side.free_length(LevelGaps(none, fmax(gaps.above + beside - more, 0))),
        )
        up = fmax(gaps.above, dr.select(inside, up, 0))
        known = (gaps.below >= 0) & (gaps.above >= 0)
        return dr.select(known, fmin(down, up) * (1 - 1e-6), 0)

    def _fall(self, gap: Real) -> Real:
        """The length on which w stays less than `gap` below its value."""
        never = (self.height * self.rate >= 0) | (gap > dr.abs(self.height))
        free = dr.select(never, dr.inf, gap / dr.abs(self.rate))
        return dr.select((gap > 0) & (free >= 0), free, 0)

    def _rise(self, gap: Real) -> Real:
        falls = self.height * self.rate < 0
        way = gap + dr.select(falls, 2 * dr.abs(self.height), 0)
        free = dr.select(self.rate == 0, dr.inf, way / dr.abs(self.rate))
        return dr.select((gap > 0) & (free >= 0), free, 0)


def outline_distance_jet(nearest: Callable[[Real, Real], OutlineSample], x: Jet, y: Jet) -> Jet:
    """The jet of a signed distance in the plane, of jets of coordinates.

    Proof. The distance has the constant 1, so a derivative in any variable is at most the length of
    that of (x, y), and the value is off by at most what the coordinates are at the start. On a
    piece there may be kinks, so that second derivatives have no bound; at a point they are those of
    the distance from the nearest edge or vertex, as its gradient is. On a ball, where coordinates
    are ranges and not numbers with their rounding, another edge may be nearest, as on a piece.
    """
    starts = [one if one.jet_at_start is None else one.jet_at_start for one in (x, y)]
    zero = 0 * x.piece_length
    u, v = (zero + one.value.midpoint for one in starts)
    there = nearest(u, v)
    spread = zero + starts[0].value.radius + starts[1].value.radius
    size = dr.abs(u) + dr.abs(v) + dr.abs(there.value)
    is_ball = spread > _RANGE_ROUNDINGS * float(dr.epsilon(size)) * size
    off = there.error + spread
    value = Interval(there.value, there.value).widened(1e-6, 0.0)
    value = value + Interval(-off, off)

    def limits(i: int, one: Jet, two: Jet) -> Interval:
        a, b = zero + one.first_derivatives[i].max_abs, zero + two.first_derivatives[i].max_abs
        most = dr.sqrt(dr.fma(a, a, b * b)) * (1 + 1e-5)
        return Interval(-most, most)

    def unless_ball(one: Interval, most: Interval) -> Interval:
        low, high = (zero + one.lower, most.lower), (zero + one.upper, most.upper)
        return Interval(*(dr.select(is_ball, b, a) for a, b in (low, high)))

    everything = Interval(zero - dr.inf, zero + dr.inf)
    doubt = Interval(zero - there.gradient_error, zero + there.gradient_error)
    gx, gy = (Interval.point(one) + doubt for one in there.gradient)
    count = range(len(x.first_derivatives))
    u, v = starts
    ends = tuple(limits(i, u, v) for i in count)
    slopes = tuple(
        unless_ball(
            (gx * u.first_derivatives[i] + gy * v.first_derivatives[i]).intersect(ends[i]), ends[i]
        )
        for i in count
    )
    across = [gx * v.first_derivatives[i] - gy * u.first_derivatives[i] for i in count]
    bend = Interval.point(zero + there.second_derivative).widened(1e-5 + there.gradient_error)
    second = tuple(
        unless_ball(
            bend * across[i] * across[j]
            + gx * u.second_derivatives[k]
            + gy * v.second_derivatives[k],
            everything,
        )
        for k, (i, j) in enumerate(u.hessian_indices())
    )
    start = Jet(value, slopes, second, piece_length=u.piece_length)
    if x.jet_at_start is None:
        return start
    first = tuple(limits(i, x, y) for i in count)
    moved = value + range_times_length(first[0], x.piece_length)
    unknown = (everything,) * len(x.second_derivatives)
    return Jet(moved, first, unknown, start, x.piece_length)


@dataclass(frozen=True, eq=False)
class SolidOfRevolution(Solid):
    """An outline in the half-plane (r, z), r >= 0, revolved about the z axis.

    loops: as of `Extrusion`, with points (r, z). What lies on the axis is inside of the solid, and
        no part of its surface.

    f is the signed distance, with the constant 1. Proof: the nearest point of a surface of
    revolution lies in the half-plane of p. Along a path, (r, z) departs from its tangent line, on
    which `OutlineEdges.sample` bounds the distance, in r alone: r is convex along the path, so
    that it lies e(s) >= 0 above its tangent, and with e = (c/r)^2 s^2/(r(s) + r + r' s), c/r the
    part of the direction across the half-plane. A distance of constant 1 is less by e(s) at most;
    the bound less a convex function is as concave as before, which is all that `TangentEnclosure`
    needs.

    Raises:
        ValueError: loops that enclose no area, or with points of r < 0.
    """

    loops: Any

    lipschitz = 1.0

    def __post_init__(self) -> None:
        loops = make_outline(self.loops)
        least = min(float(one[:, 0].min()) for one in loops)
        if least < 0:
            raise ValueError(
                f"an outline that is revolved lies in r >= 0, and this one reaches {least:g}"
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
        low, high = float(points[:, 1].min()), float(points[:, 1].max())
        half = 0.5 * (high - low) + level
        return box_around((radius, radius, half), (0.0, 0.0, 0.5 * (low + high)))

    @cached_prepare
    def prepare(self, backend: Backend) -> SolidOfRevolution:
        made = copy.copy(self)
        set_frozen(made, "_outline", OutlineEdges.upload(backend, self.loops, axis=True))
        return made

    def evaluate(self, p: Vec3) -> Sample:
        r, out = _from_axis(p)
        return self._sample(p, r, out, _on(self, p)._outline.sample(r, p.z))

    def _sample(self, p: Vec3, r: Real, out: tuple[Real, Real], side: OutlineSample) -> Sample:
        unit = 2 * float(dr.epsilon(type(p.x)))
        along, up = side.gradient
        gradient = cast("Any", type(p))(along * out[0], along * out[1], up)
        error = side.error + 8 * unit * r
        return Sample(
            side.value, gradient, (Lipschitz(0 * p.x + 1),), error, side.gradient_error + 8 * unit
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        del back
        p, d = path.point(t), path.direction
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        outline: OutlineEdges = _on(self, p)._outline
        r, (x, y) = _from_axis(p)
        knots = outline.knots(r, p.z, ahead)
        rate, across = x * d.x + y * d.y, x * d.y - y * d.x
        side = outline.sample(r, p.z, (rate, d.z), knots)
        unit = 2 * float(dr.epsilon(type(r)))
        lows = tuple(
            low - _tangent_gap(r, rate, across, knot, unit)
            for low, knot in zip(side.lower_bounds, knots, strict=True)
        )
        lows = tuple(dr.select(low == low, low, -dr.inf) for low in lows)
        off = 8 * unit * r
        side = OutlineSample(
            side.value, side.gradient, side.error + off, side.gradient_error + 8 * unit,
            side.second_derivative, tuple(low - off for low in lows),
        )  # fmt: skip
        sample = self._sample(p, r, (x, y), side)
        slope = dr.dot(sample.gradient, d)
        enclosures = (SignedDistanceEnclosure.around(side, slope, knots),)
        return RaySample(sample, enclosures, (), slope, _GROWTH, min_gradient_norm=_MIN_GRADIENT)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        if not is_jet(x, type(self).__name__):
            return self.differentiable_value(_vector(x, y, z))
        return outline_distance_jet(_on(self, x.width)._outline.nearest, norm(x, y), z)


def _from_axis(p: Vec3) -> tuple[Real, tuple[Real, Real]]:
    """The distance from the z axis, and the unit vector away from it: any, on the axis."""
    r = dr.sqrt(dr.fma(p.x, p.x, p.y * p.y))
    off = r > 0
    return r, (dr.select(off, p.x / r, 1), dr.select(off, p.y / r, 0))


def _tangent_gap(r: Real, rate: Real, across: Real, s: Real, unit: float) -> Real:
    """r(s) less its tangent line, for r(s)^2 = (r + rate s)^2 + (across s)^2; rounded upwards."""
    line, aside = r + rate * s, across * s
    length = dr.sqrt(dr.fma(line, line, aside * aside))
    above = dr.select(line > 0, aside / (length + line) * aside, length - line)
    return above * (1 + 1e-5) + 16 * unit * (dr.abs(line) + dr.abs(aside))
