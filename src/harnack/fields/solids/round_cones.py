"""Segments with a thickness: capsules, and round cones, whose radius varies along the segment. Both
are convex hulls of two balls, and their functions are the exact signed distances. Lattices and
networks of struts are unions of many (`harnack.fields.solids.struts`)."""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.arithmetic import cone_distance, maximum, minimum, norm, segment_distance
from harnack.backend.validation import as_positive, as_triple
from harnack.fields.attached_numbers import with_attached_arguments
from harnack.fields.solids.solid import (
    FormulaSolid,
    Point,
    box_around,
    by_numbers,
    set_frozen,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.arithmetic.segments import Frame
    from harnack.backend import BoolArray, FloatArray
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume


def axial_frames(origins: FloatArray, axes: FloatArray) -> FloatArray:
    """The frames (m, 12) (`Frame`) of local coordinates that are 0 at points (m, 3), along vectors
    (m, 3) of any length but 0, and at right angles to these (Duff et al. 2017, "Building an
    orthonormal basis, revisited")."""
    axes = axes / np.abs(axes).max(axis=1)[:, None]  # so that no square underflows
    x, y, z = (axes / np.linalg.norm(axes, axis=1)[:, None]).T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = (
        np.stack([x, y, z], axis=1),
        np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1),
        np.stack([b, sign + y * y * a, -y], axis=1),
    )
    columns = [part for row in rows for part in (row, (row * origins).sum(axis=1)[:, None])]
    return np.concatenate(columns, axis=1) + 0.0  # which makes -0.0 the number 0.0


def _axial_frame(origin: Sequence[float], axis: Sequence[float]) -> Frame:
    """The frame with an origin and an axis (`axial_frames`)."""
    frames = axial_frames(np.array([origin], np.float64), np.array([axis], np.float64))
    return tuple(frames[0].tolist())


def cone_numbers(length: FloatArray, radii: FloatArray) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Whether one ball of a round cone contains the other, the slope s and s/c (`RoundCone`), for
    m cones: arrays (m,). For nested balls both numbers are 0.

    length: (m,) the distances of centers. radii: (m, 2) the larger radius first.
    """
    difference = radii[:, 0] - radii[:, 1]
    is_nested = (length <= difference) | (length == 0.0)
    length, difference = np.where(is_nested, 1.0, length), np.where(is_nested, 0.0, difference)
    # With a product that loses no digits where both lengths are nearly equal.
    ratio = difference / np.sqrt((length - difference) * (length + difference))
    return is_nested, difference / length, ratio


@dataclass(frozen=True)
class Capsule(FormulaSolid):
    """The points within `radius` of the segment from `start` to `end`. f is the signed distance.

    f is the distance from the segment (`segment_distance`) minus the radius.
    """

    is_convex = True

    # The unit vectors of the frame are rounded.
    lipschitz = 1.0 + 1e-6
    traits = by_numbers("start", "end", "radius")

    start: Point = (0.0, 0.0, -1.0)
    end: Point = (0.0, 0.0, 1.0)
    radius: float = 0.5
    _frame: Frame = dataclasses.field(init=False, repr=False, compare=False)
    _half_length: float = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the arguments, and compute the frame.

        Raises:
            ValueError: start and end are the same point, or the radius is not positive.
        """
        start = as_triple(self.start, "the start of a capsule")
        end = as_triple(self.end, "the end of a capsule")
        # Halves, so that nothing overflows.
        half = [0.5 * b - 0.5 * a for a, b in zip(start, end, strict=True)]
        half_length = math.hypot(*half)
        if half_length == 0.0:
            raise ValueError(f"a capsule from {start} to the same point is a sphere: use Sphere")
        set_frozen(self, "start", start)
        set_frozen(self, "end", end)
        set_frozen(self, "radius", as_positive(self.radius, "the radius of a capsule"))
        middle = [0.5 * a + 0.5 * b for a, b in zip(start, end, strict=True)]
        set_frozen(self, "_frame", _axial_frame(middle, half))
        set_frozen(self, "_half_length", half_length)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return segment_distance((x, y, z), self._frame, self._half_length) - self.radius

    def with_read_numbers(self, numbers: NumberReader) -> PlainCone:
        """The same function of the numbers with their derivatives."""
        own = with_attached_arguments(self, ("start", "end", "radius"), numbers)
        return PlainCone((own.start, own.end), (own.radius, own.radius))

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box of the segment, grown by radius
        and level on each side. None if `above` (a volume for all points where f >= level), as these
        points are unbounded."""
        if above:
            return None
        return _box_around_balls((self.start, self.end), (self.radius + level, self.radius + level))


@dataclass(frozen=True)
class RoundCone(FormulaSolid):
    """The convex hull of two balls, one about `start` and one about `end`: both spheres, and the
    cone that touches both. f is the signed distance, with the Lipschitz constant 1.

    radii: (2,) the radii of the balls about `start` and about `end`. If they are equal, the solid
        is a capsule. If one ball contains the other, the solid is that ball.

    Let r be the larger radius, h the coordinate along the axis from the center of the larger ball,
    q the distance from the axis, L that of the centers, s = (difference of the radii)/L, and c =
    sqrt(1 - s^2). The solid is the union of the balls about the points x_t of the axis with h = t,
    0 <= t <= L, whose radii are r_t = r - s t. f is the least over t of |p - x_t| - r_t = |(q, h -
    t)| - r + s t, a convex function of t. Its derivative vanishes at t = h - q s/c, and so the
    least one is at this t, clipped to [0, L].

    Proof that f is the signed distance. Outside, it is the distance from the nearest ball. The
    signed distance from a convex set is, inside as well, the greatest of n . p minus its support
    function over all unit vectors n; here that is the greatest of min_t (n . (p - x_t) - r_t). Over
    all n with |n| <= 1, greatest and least may be exchanged, as the function is linear in n and in
    t; this gives f. It remains to see that the greatest is attained at a unit vector. If p is not
    on the axis between the centers, the n of the best t is one, the direction of p - x_t. If p is
    such a point, f = -r_t at t = h, and a unit vector with n . (axis from the larger ball to the
    smaller) = s gives this value for all t.

    f is convex: it is the least over t of a function that is convex in p and t together.
    """

    is_convex = True

    # The unit vectors of the frame and the slope are rounded.
    lipschitz = 1.0 + 1e-6
    traits = by_numbers("start", "end", "radii")

    start: Point = (0.0, 0.0, -1.0)
    end: Point = (0.0, 0.0, 1.0)
    radii: tuple[float, float] = (0.5, 0.25)
    _frame: Frame = dataclasses.field(init=False, repr=False, compare=False)
    _center: Point = dataclasses.field(init=False, repr=False, compare=False)
    _numbers: tuple[float, ...] = dataclasses.field(init=False, repr=False, compare=False)
    _is_ball: bool = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the arguments, and compute the frame, the numbers r, L, s and s/c of the formula,
        and whether one ball contains the other.

        Raises:
            ValueError: not two positive radii.
        """
        start = as_triple(self.start, "the start of a round cone")
        end = as_triple(self.end, "the end of a round cone")
        set_frozen(self, "start", start)
        set_frozen(self, "end", end)
        set_frozen(self, "radii", _checked_radii(self.radii))
        centers, (large, small) = (start, end), self.radii
        if small > large:
            centers, (large, small) = (end, start), (small, large)
        axis = [b - a for a, b in zip(*centers, strict=True)]
        length = math.hypot(*axis)
        numbers = cone_numbers(np.array([length]), np.array([[large, small]]))
        is_ball, slope, ratio = (entry.item() for entry in numbers)
        axis = [0.0, 0.0, 1.0] if is_ball else axis
        set_frozen(self, "_frame", _axial_frame(centers[0], axis))
        set_frozen(self, "_center", centers[0])
        set_frozen(self, "_numbers", (large, length, slope, ratio))
        set_frozen(self, "_is_ball", is_ball)

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        radius, length, slope, ratio = self._numbers
        if self._is_ball:
            x, y, z = (v - c for v, c in zip((x, y, z), self._center, strict=True))
            return norm(x, y, z) - radius
        return cone_distance((x, y, z), self._frame, length, slope, ratio) - radius

    def with_read_numbers(self, numbers: NumberReader) -> PlainCone:
        """The same function of the numbers with their derivatives."""
        own = with_attached_arguments(self, ("start", "end", "radii"), numbers)
        ends, radii = (own.start, own.end), own.radii
        if self.radii[1] > self.radii[0]:
            ends, radii = ends[::-1], radii[::-1]
        return PlainCone(ends, radii, self._is_ball)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """A box that contains all points where f <= level: the box around both balls, each with
        the level added to its radius. (The sides of the balls between them vary linearly.) None if
        `above`, as then the points are unbounded."""
        if above:
            return None
        first, second = self.radii
        return _box_around_balls((self.start, self.end), (first + level, second + level))


@dataclass(frozen=True)
class PlainCone:
    """The function of a round cone or capsule, computed from its numbers, which may be those of
    Dr.Jit with derivatives.

    ends: the center of the larger ball, and that of the other one.
    radii: theirs, in that order.
    is_ball: whether the larger ball contains the other one.
    """

    ends: tuple[tuple[Any, ...], ...]
    radii: tuple[Any, Any]
    is_ball: bool = False

    @classmethod
    def read(cls, is_ball: bool, numbers: NumberReader) -> PlainCone:
        """The cone whose eight numbers a reader gives: both centers and both radii."""
        a = numbers.vector(None, (0.0,) * 8)
        return cls((a[:3], a[3:6]), (a[6], a[7]), is_ball)

    @classmethod
    def read_capsule(cls, numbers: NumberReader) -> PlainCone:
        """The capsule whose seven numbers a reader gives: both ends and the radius."""
        a = numbers.vector(None, (0.0,) * 7)
        return cls((a[:3], a[3:6]), (a[6], a[6]))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """f at (x, y, z)."""
        (start, end), (large, small) = self.ends, self.radii
        away = [v - a for v, a in zip((x, y, z), start, strict=True)]
        if self.is_ball:
            return norm(*away) - large
        axis = [b - a for a, b in zip(start, end, strict=True)]
        length = norm(*axis)
        axis = [component / length for component in axis]
        slope = (large - small) / length
        along = functools.reduce(operator.add, [a * b for a, b in zip(away, axis, strict=True)])
        across = norm(*(a - along * b for a, b in zip(away, axis, strict=True)))
        ratio = slope / (1.0 - slope * slope) ** 0.5
        t = minimum(maximum(along - across * ratio, 0.0), length)
        return norm(across, along - t) + t * slope - large


def _checked_radii(radii: Any) -> tuple[float, float]:
    """The two radii of a round cone as positive numbers.

    Raises:
        ValueError: there are not two, or one is not positive.
    """
    try:
        first, second = radii
    except (TypeError, ValueError):
        raise ValueError(f"the radii of a round cone must be two numbers, not {radii!r}") from None
    name = "the radii of a round cone"
    return as_positive(first, name), as_positive(second, name)


def _box_around_balls(centers: tuple[Point, Point], radii: tuple[float, float]) -> Volume:
    """The box around two balls, whose radii may be negative: then the sides are shortened."""
    (a, b), (r, s) = centers, radii
    lower = [min(u - r, v - s) for u, v in zip(a, b, strict=True)]
    upper = [max(u + r, v + s) for u, v in zip(a, b, strict=True)]
    half = [0.5 * high - 0.5 * low for low, high in zip(lower, upper, strict=True)]
    center = [0.5 * high + 0.5 * low for low, high in zip(lower, upper, strict=True)]
    return box_around((half[0], half[1], half[2]), center)
