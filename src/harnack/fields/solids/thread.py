"""Screw threads along the z axis as solids: `Thread` winds a profile along a helix, and
`metric_thread` makes the metric threads of ISO. A profile is a polyline of points (z, r), where r
is the distance from the axis; it is repeated along the axis with the pitch as its period. The
function f of a thread is about the signed distance from its surface, negative inside."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.validation import (
    as_finite,
    as_integer_in_range,
    as_positive,
    as_real_array,
    check_finite,
    flag,
    no_derivatives,
)
from harnack.enclosures import Enclosure, LevelGaps, Lipschitz
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.solids.extrusions import SolidOfRevolution
from harnack.fields.solids.solid import Solid, set_frozen
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume

_MAX_POINTS = 32
_MAX_STARTS = 32


@dataclass(frozen=True, eq=False)
class Thread(Solid):
    """An endless screw along the z axis. Its profile, a periodic polyline of points (z, r), moves
    along the axis by `starts` pitches in each turn; the solid is all points nearer to the axis than
    the profile. At a point p with the distance r from the axis, u is p's position along the axis
    relative to the profile: z minus the distance by which the profile has moved at the angle of p.

    profile: (n, 2) points (z, r) of a polyline, at most 32. r is the distance from the axis and
        positive. The first z is within half a pitch of 0, and z rises from point to point, by less
        than a pitch in all. From the last point the polyline goes on to the first point of the next
        period, one pitch further along z.
    pitch: the period of the profile along the axis.
    starts: the number of parallel grooves.
    left_handed: whether the screw turns clockwise as it rises.

    Let (r, angle, z) be the cylindrical coordinates of p, u = z - starts pitch angle/(2 pi), and m
    the smallest r of the profile. f is the signed distance d of (r, u) from the periodic polyline
    in the plane, but is at least -m/2. The surface is exact. f is not a distance, but close to one
    where the pitch is small compared to the radius.

    Proof of the Lipschitz constant. |grad r| = 1. grad u is at right angles to grad r. Its
    components are 1 along the axis and starts pitch/(2 pi r) around it. So where r >= m/2, |grad f|
    is at most sqrt(1 + (starts pitch/(pi m))^2). Where r < m/2, d < -m/2, so that f is constant. u
    jumps by multiples of the pitch, which do not change f.

    Raises:
        ValueError: a profile that is not of this kind.
    """

    profile: Any
    pitch: float
    starts: int = 1
    left_handed: bool = False

    def __post_init__(self) -> None:
        """Check the arguments, and compute the numbers that the formula needs: three periods of the
        profile, the lead (the distance by which the screw moves in a turn), the smallest and
        largest radii, and the Lipschitz constant.

        Raises:
            ValueError, TypeError: arguments of another kind.
        """
        set_frozen(self, "pitch", as_positive(self.pitch, "the pitch of a thread"))
        set_frozen(
            self,
            "starts",
            as_integer_in_range(self.starts, "the starts of a thread", 1, _MAX_STARTS),
        )
        if not isinstance(self.left_handed, bool):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError(f"left_handed must be True or False, not {self.left_handed!r}")
        array = as_real_array(self.profile, "the profile of a thread")
        if array.ndim != 2 or array.shape[1] != 2 or not 1 <= len(array) <= _MAX_POINTS:
            raise ValueError(
                f"the profile of a thread has shape (n, 2), n from 1 to {_MAX_POINTS}, "
                f"not {array.shape}"
            )
        points = np.array(array, dtype=np.float64)
        check_finite(points, "point {} of the profile of a thread", ValueError)
        z = points[:, 0]
        rises = (np.diff(z) > 0).all() and z[-1] - z[0] < self.pitch
        if not rises or abs(z[0]) > 0.5 * self.pitch:
            raise ValueError(
                "z of the profile of a thread begins within half a pitch of 0 and rises by less "
                f"than the pitch, {self.pitch:g}: {z.tolist()!r:.80} does not"
            )
        if not (points[:, 1] > 0).all():
            raise ValueError("r of the profile of a thread must be positive")
        rows = tuple((float(a), float(b)) for a, b in points)
        set_frozen(self, "profile", rows)
        # Three periods. Points have u in the period from 0 to the pitch, and the nearest point of
        # the profile is at most half a period away along the axis. The three periods reach that
        # far.
        shifted = [(a + k * self.pitch, b) for k in (-1, 0, 1) for a, b in rows]
        shifted.append((rows[0][0] + 2 * self.pitch, rows[0][1]))
        set_frozen(self, "_points", tuple(shifted))
        # The lead is the distance by which the screw moves in a full turn; `_lead` is that per
        # radian, so that u = z - _lead * angle.
        lead = self.starts * self.pitch * (-1 if self.left_handed else 1)
        set_frozen(self, "_lead", lead / (2 * math.pi))
        # f is never less than -min_radius/2; near the axis it is this number.
        min_radius = min(b for _, b in rows)
        set_frozen(self, "_least", 0.5 * min_radius)
        max_radius = max(b for _, b in rows)
        set_frozen(self, "_most", max_radius)
        # For the rounding error: a bound of the numbers in the computation of distances.
        set_frozen(self, "_size", max_radius + 2 * self.pitch * self.starts)
        slope = self.starts * self.pitch / (math.pi * min_radius)
        set_frozen(self, "lipschitz", math.hypot(1.0, slope) * (1 + 1e-6))

    def map_operands(self, change: Callable[[Solid], Solid]) -> Solid:
        return change(self)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        del level, above
        return None

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of the thread, with its numbers as kernel parameters of the backend
        (numbers that a compiled kernel reads when it runs)."""
        del plan
        numbers: Any = cast("Any", self)

        def parameter(number: float) -> Real:
            """A number as a kernel parameter."""
            return dr.opaque(backend.Float, number)

        points = tuple((parameter(z), parameter(r)) for z, r in numbers._points)
        return _ThreadEvaluator(
            parameter(self.pitch), points, parameter(numbers._lead), parameter(numbers._least),
            parameter(numbers._most), parameter(numbers._size), parameter(self.lipschitz),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _ThreadEvaluator(Evaluator):
    """The evaluator of a `Thread`. Its numbers are kernel parameters.

    pitch: the period of the profile along the axis.
    points: the vertices (z, r) of three periods of the profile, and the first one of the next
        period.
    lead: the distance by which the screw moves along the axis for each radian.
    least: half of the smallest r of the profile. f is at least minus this number.
    most: the largest r of the profile.
    size: a bound of the numbers in the computation of distances.
    lipschitz: the Lipschitz constant of f.
    """

    pitch: Real
    points: tuple[tuple[Real, Real], ...]
    lead: Real
    least: Real
    most: Real
    size: Real
    lipschitz: Real

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p: the signed distance of (r, u) from the profile, where u is reduced to
        the period from 0 to the pitch. In the core, the points near the axis where f is at its
        lower limit, f is constant, and its gradient is 0."""
        real = cast("Any", type(p.x))
        epsilon = 2 * float(dr.epsilon(real))  # the machine epsilon
        r = dr.sqrt(dr.fma(p.x, p.x, p.y * p.y))
        # u, and then u in the period from 0 to the pitch.
        axial = p.z - dr.atan2(p.y, p.x) * self.lead
        axial = axial - dr.floor(axial / self.pitch) * self.pitch
        error = 8 * epsilon * (dr.abs(p.z) + r + self.size)
        is_outside = r >= self._profile_radius(axial)
        sign = dr.select(is_outside, real(1), real(-1))
        distance, d_r, d_z, gradient_error = self._distance_with_gradient(r, axial, sign, error)
        value = sign * distance
        # f is at least -m/2, where m is the smallest radius of the profile; `least` is m/2.
        is_core = value <= -self.least
        value = dr.select(is_core, -self.least, value)
        d_r, d_z = (dr.select(is_core, 0, derivative) for derivative in (d_r, d_z))
        # The unit vector away from the axis; 0 on the axis.
        divisor = dr.select(r > 0, r, 1)
        x, y = p.x / divisor, p.y / divisor
        # u = z - lead * angle, so the derivative of f along the tangent is that by u times
        # -lead/r. The radial, tangential and axial components are turned to x, y and z.
        tangential = -d_z * self.lead / divisor
        gradient = cast("Any", type(p))(d_r * x - tangential * y, d_r * y + tangential * x, d_z)
        # A Dr.Jit array, with the number in each lane.
        constant = 0 * p.x + self.lipschitz
        gradient_error = dr.select(is_core, 0, gradient_error * constant + 16 * epsilon)
        return Sample(value, gradient, (Lipschitz(constant),), error, gradient_error)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample of f at the point of a ray with parameter t, with enclosures: proved bounds of
        how f changes along the ray, in front of that point and behind it.

        Both directions have the bounds that follow from the Lipschitz constant. In front of the
        point there is also an `OutsideCylinderEnclosure`: outside of the cylinder around the
        thread, f is at least the distance from the cylinder.

        path: the ray.
        ahead, back: the lengths for which bounds are wanted; not used, as these hold everywhere.
        """
        del ahead, back
        p, d = path.point(t), path.direction
        ray_sample = path.enclose(self.evaluate(p))
        # The caller chooses kinds of enclosures. The one below is used with the sharpest choice,
        # which is the one that has `PiecewiseTaylorEnclosure`.
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return ray_sample
        # In this order: f, its error, r = |(x, y)|, half the derivative of r^2 along the ray, the
        # squared length of (d.x, d.y), the radius of the cylinder, the Lipschitz constant.
        cylinder = OutsideCylinderEnclosure(
            ray_sample.sample.value, ray_sample.sample.value_error,
            dr.sqrt(dr.fma(p.x, p.x, p.y * p.y)), dr.fma(p.x, d.x, p.y * d.y),
            dr.fma(d.x, d.x, d.y * d.y), 0 * p.x + self.most, 0 * p.x + self.lipschitz,
        )  # fmt: skip
        return replace(ray_sample, forward=(*ray_sample.forward, cylinder))

    def _profile_radius(self, z: Real) -> Real:
        """The profile's r at the position z along the axis. z: from 0 to the pitch."""
        height = 0 * z
        for (start_z, start_r), (end_z, end_r) in itertools.pairwise(self.points):
            r = start_r + (z - start_z) / (end_z - start_z) * (end_r - start_r)
            height = dr.select((z >= start_z) & (z <= end_z), r, height)
        return height

    def _distance_with_gradient(
        self, r: Real, z: Real, sign: Real, error: Real
    ) -> tuple[Real, Real, Real, Real]:
        """The distance of points (r, z) of the half-plane from the profile's polyline, and the
        gradient of the signed distance there.

        sign: 1 for points outside, -1 inside.
        error: a bound of the rounding of the distance. Points that are nearer than this count as
            points on the polyline.

        Returns the distance; the derivatives of the signed distance with respect to r and to z; and
        a bound of the error of these derivatives. The gradient is the normal of the nearest edge,
        or the direction away from the nearest vertex.
        """
        zero = 0 * r
        nearest, d_r, d_z, gradient_error = zero + dr.inf, zero, zero, zero
        epsilon = 2 * float(dr.epsilon(cast("Any", type(r))))  # the machine epsilon
        for (start_z, start_r), (end_z, end_r) in itertools.pairwise(self.points):
            edge_z, edge_r = zero + (end_z - start_z), zero + (end_r - start_r)
            inverse_length = dr.rsqrt(edge_z * edge_z + edge_r * edge_r)
            from_z, from_r = z - start_z, r - start_r
            fraction = (from_z * edge_z + from_r * edge_r) * inverse_length * inverse_length
            # minus_t is minus the position of the nearest point of the edge, as a fraction of the
            # edge. Then the vector from there to (r, z).
            minus_t = -clamp(fraction, 0, 1)
            to_z, to_r = dr.fma(edge_z, minus_t, from_z), dr.fma(edge_r, minus_t, from_r)
            line_distance = dr.abs(from_r * edge_z - from_z * edge_r) * inverse_length
            is_inner = (fraction > 0) & (fraction < 1)
            distance = dr.select(is_inner, line_distance, dr.sqrt(to_z * to_z + to_r * to_r))
            is_nearer = distance < nearest
            # The gradient is the edge's normal if an inner point of the edge is nearest or the
            # distance is mere rounding; else it is the direction away from the vertex, with the
            # sign.
            by_normal, scale = is_inner | (distance <= error), sign / distance
            for_r = dr.select(by_normal, edge_z * inverse_length, to_r * scale)
            for_z = dr.select(by_normal, -edge_r * inverse_length, to_z * scale)
            d_r, d_z = dr.select(is_nearer, for_r, d_r), dr.select(is_nearer, for_z, d_z)
            edge_error = dr.select(is_inner, 8 * epsilon, fmin(2 * error / distance, 2))
            gradient_error = dr.select(is_nearer, edge_error, gradient_error)
            nearest = dr.select(is_nearer, distance, nearest)
        return nearest, d_r, d_z, gradient_error


@dataclass(frozen=True)
class OutsideCylinderEnclosure(Enclosure):
    """A proved bound of the change of f along a ray, for a function f that is, outside of an
    endless cylinder about the z axis, at least the distance from the cylinder. The gaps are the
    differences between f at the start and the next level below and above.

    value, error: f at the start of the ray, and a bound of its error.
    r, radial_slope, square: the distance r(s) from the axis at the length s along the ray is given
        by r(s)^2 = r^2 + 2 radial_slope s + square s^2.
    radius: of the cylinder.
    constant: a Lipschitz constant of f.

    Proof. Let R be the radius. f stays above a level L >= 0 as long as r(s) > R + L, which holds up
    to the smaller root of a quadratic equation. The root is computed for a slightly larger
    discriminant, so that it is not rounded upwards and no root is missed. f rises no faster than
    its constant allows. (A thread lies within the largest r of its profile, R. So a point with r >
    R is at least r - R from it.)
    """

    value: Real
    error: Real
    r: Real
    radial_slope: Real
    square: Real
    radius: Real
    constant: Real

    def free_length(self, gaps: LevelGaps) -> Real:
        """The length of the ray on which f is proved to meet neither the level below nor the level
        above: the smaller of two lengths.

        gaps: the differences between f at the start and these levels.

        The points at which f is at most the level below lie in the cylinder whose radius is larger
        by that level; the first length is the length up to this cylinder. The second length is the
        gap to the level above, divided by the Lipschitz constant.
        """
        level = self.value - gaps.below + self.error
        level_radius = self.radius + level
        # With L the level below: r^2 - (R + L)^2, then the discriminant and the smaller root.
        excess = (self.r - level_radius) * (self.r + level_radius)
        squared, product = self.radial_slope * self.radial_slope, self.square * excess
        discriminant = squared - product + 1e-5 * (squared + dr.abs(product))
        root = excess / (dr.sqrt(fmax(discriminant, 0)) - self.radial_slope)
        # A ray that moves away from the axis, or has no root, never reaches the cylinder.
        length = dr.select((self.radial_slope >= 0) | (discriminant < 0), dr.inf, root)
        # The proof is for a level >= 0 and a start well outside of the cylinder; the numbers must
        # not have overflowed.
        is_known = (
            (gaps.below <= self.value)
            & (excess > 1e-5 * level_radius * level_radius)
            & (gaps.above >= 0)
        )
        is_known &= (length >= 0) & dr.isfinite(excess + squared + product)
        length = dr.select(gaps.below == dr.inf, dr.inf, dr.select(is_known, length, 0))
        # (1e-5 covers the rounding of the length.)
        return fmax(fmin(length, gaps.above / self.constant), 0) * (1 - 1e-5)


# ISO 261 and 262: nominal diameters and coarse pitches, in millimeters.
COARSE_PITCHES: Mapping[str, float] = MappingProxyType(
    {
        "M1": 0.25, "M1.1": 0.25, "M1.2": 0.25, "M1.4": 0.3, "M1.6": 0.35, "M1.8": 0.35, "M2": 0.4,
        "M2.2": 0.45, "M2.5": 0.45, "M3": 0.5, "M3.5": 0.6, "M4": 0.7, "M4.5": 0.75, "M5": 0.8,
        "M6": 1.0, "M7": 1.0, "M8": 1.25, "M9": 1.25, "M10": 1.5, "M11": 1.5, "M12": 1.75,
        "M14": 2.0, "M16": 2.0, "M18": 2.5, "M20": 2.5, "M22": 2.5, "M24": 3.0, "M27": 3.0,
        "M30": 3.5, "M33": 3.5, "M36": 4.0, "M39": 4.0, "M42": 4.5, "M45": 4.5, "M48": 5.0,
        "M52": 5.0, "M56": 5.5, "M60": 5.5, "M64": 6.0, "M68": 6.0,
    }
)  # fmt: skip
_THREAD_NAME = re.compile(r"M(\d{1,4}(?:\.\d{1,3})?)(?:\s*[xX]\s*(\d{1,3}(?:\.\d{1,3})?))?")
# The largest clearance, as a fraction of the pitch. A larger one would leave almost no crests.
_MAX_CLEARANCE = 0.1


@no_derivatives
def metric_thread(
    name: str,
    length: float,
    *,
    internal: bool = False,
    clearance: float = 0.0,
    left_handed: bool = False,
) -> Solid:
    """A metric ISO screw thread about the z axis. Lengths are in millimeters.

    name: "M8" for a coarse thread (ISO 261, from M1 to M68), "M8x1" for a thread of any other
        pitch.
    length: an external thread extends from z = 0 to z = length. Both ends are beveled by 45 degrees
        down to its root. An internal thread is to be cut out of a nut, as in `nut -
        metric_thread("M8", 20, internal=True)`. It begins one pitch below z = 0, so that it opens a
        face of the nut there, with a bevel, and ends at z = length. If the hole is to go through,
        let the thread extend a pitch beyond the other face.
    internal: whether the thread is for a nut.
    clearance: the distance by which the surface lies inside of the basic profile, or outside of it
        for an internal thread. It is measured across flanks, crests and roots, and is at most a
        tenth of the pitch. Printed threads that are to fit need 0.05 to 0.1 for both bolt and nut.
        The clearance does not move the thread along the axis: both flanks of a groove recede
        equally. So the gap on each flank between a bolt and its nut is the sum of their clearances.
    left_handed: whether the thread turns clockwise as it rises.

    The profile is the basic one of ISO 68-1, for bolt and nut alike. With P the pitch and H =
    sqrt(3)/2 P: the flanks are at 60 degrees to each other; the flats are P/8 wide at the major
    diameter and P/4 at the minor diameter; the depth between the two radii is 5/8 H. It has no
    tolerances of ISO 965 and no rounded roots.

    Raises:
        ValueError: an unknown thread, a length that leaves nothing between the bevels, or a
            clearance out of range.
    """
    diameter, pitch = _diameter_and_pitch(name)
    length = as_positive(length, "the length of a thread")
    clearance = as_finite(clearance, "the clearance of a thread")
    internal = flag(internal, "internal")
    left_handed = flag(left_handed, "left_handed")
    if not 0 <= clearance <= _MAX_CLEARANCE * pitch:
        raise ValueError(
            f"the clearance of {name} must be from 0 to {_MAX_CLEARANCE * pitch:g}, a tenth of "
            f"its pitch, not {clearance:g}"
        )
    depth = 0.625 * math.sqrt(0.75) * pitch
    # The clearance makes a bolt thinner, and the hole of a nut wider.
    sign = 1.0 if internal else -1.0
    crest, root = 0.5 * diameter + sign * clearance, 0.5 * diameter - depth + sign * clearance
    # The clearance moves each edge of the profile by c at right angles to it. Where a flat meets a
    # flank, the corner then moves along the flat by c tan(30 degrees). So crests become longer by
    # twice that, and roots shorter, or the other way round.
    shift = sign * clearance * math.tan(math.radians(30.0))
    # The lengths along the axis of the flat crest, of a flank, and of the flat root.
    flat, flank, bottom = pitch / 8 + 2 * shift, 5 * pitch / 16, pitch / 4 - 2 * shift
    z = np.cumsum([-shift, flat, flank, bottom])
    # With a single start.
    thread = Thread(np.column_stack([z, [crest, crest, root, root]]), pitch, 1, left_handed)
    outer = crest + 0.25 * depth  # beyond the crests, so that no faces coincide
    bevel = outer - root
    if internal:
        opening = [(outer, -pitch), (outer, 0.0), (root, bevel)]
        extent = SolidOfRevolution([(0.0, -pitch), (outer, -pitch), (outer, length), (0.0, length)])
        return (thread & extent) | SolidOfRevolution([(0.0, -pitch), *opening, (0.0, bevel)])
    if not length > 2 * bevel:
        raise ValueError(
            f"a thread {name} must be longer than {2 * bevel:.3g}, for its bevels, not {length:g}"
        )
    ends = [(root, 0.0), (outer, bevel), (outer, length - bevel), (root, length)]
    return thread & SolidOfRevolution([(0.0, 0.0), *ends, (0.0, length)])


def _diameter_and_pitch(name: Any) -> tuple[float, float]:
    """The diameter and the pitch of a thread, in millimeters, from its name, such as "M8" or
    "M8x1".

    Raises:
        ValueError: not the name of a thread, or a pitch that leaves no core.
    """
    match = _THREAD_NAME.fullmatch(name.strip()) if isinstance(name, str) else None
    if match is None:
        raise ValueError(f'a thread is named as "M8" or "M8x1", not {name!r:.40}')
    diameter = float(match[1])
    if match[2] is None:
        key = f"M{diameter:g}"
        if key not in COARSE_PITCHES:
            raise ValueError(
                f"there is no coarse thread {key}{did_you_mean(key, COARSE_PITCHES)}: write its "
                "pitch, as "
                f"in {key}x1"
            )
        return diameter, COARSE_PITCHES[key]
    pitch = float(match[2])
    # The diameter is more than four depths, so that a core remains.
    if not (pitch > 0 and diameter > 4 * pitch * math.sqrt(0.75) * 0.625):
        raise ValueError(f"a thread {name} leaves no core: its pitch is too large for it")
    return diameter, pitch
