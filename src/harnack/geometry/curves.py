"""Closed curves in space, polygonal loops and circles: validation and simple measures. A loop is an
array (n, 3) of vertices; its last vertex is joined to its first. A curve is a tuple of loops, which
may be knotted, linked, nested or cross each other. A circle is a closed curve, too, given by its
center, radius and normal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from harnack.backend.validation import (
    MAX_COORDINATE,
    TRANSPOSE_ADVICE,
    FloatArray,
    as_real_array,
    check_finite,
    check_vectors,
    format_vector,
    others_suffix,
)
from harnack.geometry.convex_position import is_convex_position

__all__ = [
    "MAX_VERTICES",
    "Circle",
    "CurveError",
    "Loops",
    "LoopsLike",
    "bounding_box",
    "cancel_opposite_circles",
    "edge_endpoints",
    "is_convex_position",
    "total_length",
    "validate_curves",
    "validate_loops",
]

_MIN_RADIUS = 1 / MAX_COORDINATE


@dataclass(frozen=True)
class Circle:
    """A circle as a closed curve, run counter-clockwise as seen from the side that its normal
    points to.

    radius: a positive length.
    center: (3,).
    normal: (3,), not zero; it is scaled to length one.

    Raises:
        ValueError: a number is not finite, the radius not positive, or the normal zero.
        TypeError: a value is not a number.
    """

    radius: float
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Validate and convert the attributes, and scale the normal to length one."""
        radius = _numbers(self.radius, "radius", ())
        if not _MIN_RADIUS <= radius <= MAX_COORDINATE:
            raise ValueError(
                f"radius of a circle must lie between {_MIN_RADIUS:g} and {MAX_COORDINATE:g}, not "
                f"{float(radius):g}"
            )
        center, normal = (
            _numbers(self.center, "center", (3,)),
            _numbers(self.normal, "normal", (3,)),
        )
        if np.abs(center).max() > MAX_COORDINATE:
            raise ValueError(f"center of a circle is {format_vector(center)}: choose smaller units")
        largest = float(np.abs(normal).max())
        if largest == 0.0:
            raise ValueError("normal of a circle is zero: give the direction of its axis")
        # A normal of unit length, to rounding, is kept as it is.
        if abs(float(normal @ normal) - 1) > 1e-15:
            # Divided by the largest component first, so that squares neither overflow nor vanish.
            normal = normal / largest
            normal = normal / np.linalg.norm(normal)
        object.__setattr__(self, "radius", float(radius))
        object.__setattr__(self, "center", tuple(center.tolist()))
        object.__setattr__(self, "normal", tuple(normal.tolist()))

    @property
    def length(self) -> float:
        """The circumference."""
        return 2 * math.pi * self.radius

    def reversed(self) -> Circle:
        """The same circle with the opposite direction, as for a hole in the region that another
        curve bounds."""
        x, y, z = self.normal
        return Circle(self.radius, self.center, (-x, -y, -z))

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner, (3,) each, of the box around the circle."""
        # The circle's extent along an axis is r times the sine of the angle between axis and
        # normal.
        half_size = self.radius * np.sqrt(np.maximum(1 - np.square(self.normal), 0))
        return np.array(self.center) - half_size, np.array(self.center) + half_size

    def polygon(self, sides: int, *, circumscribed: bool = False) -> FloatArray:
        """The corners (sides, 3) of a regular polygon that is inscribed in the circle or, if
        `circumscribed`, drawn about it.

        sides: the number of sides, at least 3.

        Raises:
            ValueError: there are fewer sides.
        """
        if sides < 3:
            raise ValueError(f"a polygon needs at least three sides, not {sides}")
        radius = self.radius / math.cos(math.pi / sides) if circumscribed else self.radius
        axis = np.array(self.normal)
        # Two axes at right angles to the normal and to each other.
        first_axis = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
        first_axis /= np.linalg.norm(first_axis)
        angle = 2 * math.pi * np.arange(sides)[:, None] / sides
        offsets = np.cos(angle) * first_axis + np.sin(angle) * np.cross(axis, first_axis)
        return np.array(self.center) + radius * offsets


def _numbers(values: Any, name: str, shape: tuple[int, ...]) -> FloatArray:
    """Convert the value of a circle's attribute `name` to a float64 array of this shape.

    Raises:
        ValueError: another shape, or a number that is not finite.
        TypeError: not numbers.
    """
    array = as_real_array(values, f"{name} of a circle", type_error=TypeError).astype(np.float64)
    if array.shape != shape:
        expected = "three numbers" if shape else "a number"
        raise ValueError(f"{name} of a circle must be {expected}, not an array {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} of a circle must be finite, not {values!r}")
    return array


def cancel_opposite_circles(circles: Iterable[Circle]) -> tuple[Circle, ...]:
    """Remove pairs of opposite circles, whose contributions to a solid angle cancel; returns the
    other circles. Only circles with exactly the same center and radius and exactly opposite normals
    cancel."""
    surplus: Counter[Circle] = Counter()
    for circle in circles:
        reverse = circle.reversed()
        if surplus[reverse] > 0:
            surplus[reverse] -= 1
        else:
            surplus[circle] += 1
    return tuple(surplus.elements())


# Polygonal curves.

MAX_VERTICES = 10_000_000

Loops: TypeAlias = tuple[FloatArray, ...]
LoopsLike: TypeAlias = npt.ArrayLike | Sequence[npt.ArrayLike]


class CurveError(ValueError):
    """A curve cannot be used; the message says why and what to do."""


def validate_loops(loops: LoopsLike, *, closed: bool = True) -> Loops:
    """Validate loops. Returns a tuple of new float64 arrays (n, 3). A loop closes by itself. If its
    last vertex repeats its first, the last is dropped; any other vertex equal to the one before it
    is an error. Edges that fold back on themselves are allowed.

    loops: an array (n, 3) of vertices, or a list of such arrays.
    closed: False for open curves, which end at their first and last vertex; these two may be equal.

    Raises:
        CurveError: the loops are malformed; the message names the fault.
    """
    parts = _as_list(loops)
    if not parts:
        raise CurveError("there are no loops: give an array (n, 3) or a list of them")
    is_list = len(parts) > 1
    kind = "loop" if closed else "curve"
    names = [f"{kind} {k}" if is_list else f"the {kind}" for k, _ in parts]
    pairs = zip(parts, names, strict=True)
    checked = [_validate_loop(part, name, closed) for (_, part), name in pairs]
    total = sum(len(loop) for loop in checked)
    if total > MAX_VERTICES:
        raise CurveError(_too_many("the curve", total))
    return tuple(checked)


def validate_curves(curves: Any) -> tuple[Loops, tuple[Circle, ...]]:
    """Validate closed curves. Returns the loops, float64 arrays (n, 3), and the circles.

    curves: a `Circle`; a loop (n, 3) of vertices; or a list in which each entry is a loop or a
        circle.

    Raises:
        CurveError: a loop is malformed; the message names the fault.
    """
    if isinstance(curves, Circle):
        return (), (curves,)
    parts = _as_parts(curves)
    if not any(isinstance(part, Circle) for part in parts):
        return validate_loops(curves), ()
    circles = tuple(part for part in parts if isinstance(part, Circle))
    loops = [
        _validate_loop(part, f"loop {k}")
        for k, part in enumerate(parts)
        if not isinstance(part, Circle)
    ]
    total = sum(len(loop) for loop in loops)
    if total > MAX_VERTICES:
        raise CurveError(_too_many("the curve", total))
    return tuple(loops), circles


def _as_parts(curves: Any) -> list[Any]:
    """The entries of a list or tuple as a list; an empty list for any other object."""
    return list(curves) if isinstance(curves, list | tuple) else []  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]


def _as_list(loops: Any) -> list[tuple[int, Any]]:
    """The loops in the argument of `validate_loops`, as pairs of a number, counted from 0, and a
    loop. The argument stands for several loops if its entries are lists of points, otherwise for a
    single loop. Numbers and shapes of the loops are not checked here.

    Raises:
        CurveError: the points of a single loop have different numbers of coordinates.
    """
    try:
        array = np.asarray(loops)
    except ValueError:  # loops of different lengths, or points of different lengths
        if any(_is_point(part) for part in loops):
            raise CurveError("every vertex needs three coordinates: some differ") from None
        # Loops of different lengths.
        return _numbered(loops)
    if array.ndim == 3:
        return _numbered(array)
    # Older NumPy makes an array of objects of loops of different lengths.
    if array.dtype == object and array.ndim == 1 and len(array):
        return _numbered(array)
    if array.ndim == 1 and array.size == 0:
        return []
    return [(0, array)]


def _is_point(part: Any) -> bool:
    """Whether an entry of a list is itself a list of numbers, such as a vertex."""
    try:
        return np.ndim(part) == 1
    except ValueError:
        return False


def _numbered(loops: Any) -> list[tuple[int, Any]]:
    """The loops, each in a pair with its number, counted from 0."""
    return [(k, loop) for k, loop in enumerate(loops)]


def _validate_loop(loop: Any, name: str, closed: bool = True) -> FloatArray:
    """Validate a loop. Returns its vertices (n, 3); a last vertex that repeats the first one is
    dropped.

    name: what the loop is, for messages.
    closed: False for a curve that ends at its first and last vertex.

    Raises:
        CurveError: the loop is malformed; the message names the fault.
    """
    vertices = _as_vertices(loop, name)
    check_finite(vertices, f"vertex {{}} of {name}", CurveError)
    if closed and len(vertices) > 1 and (vertices[0] == vertices[-1]).all():
        vertices = vertices[:-1]
    distinct = _count_distinct(vertices)
    if distinct < 3:
        raise CurveError(
            f"{name} has {distinct} different vertices: {'a closed' if closed else 'such a'} curve "
            "needs at least 3"
        )
    _check_edges(vertices, name, closed)
    return vertices


def _as_vertices(loop: Any, name: str) -> FloatArray:
    """Convert the vertices of a loop to a new float64 array (n, 3).

    name: what the loop is, for messages.

    Raises:
        CurveError: they are not numbers of that shape, or there are too many.
    """
    ragged = "is ragged: every vertex needs three coordinates"
    array = as_real_array(loop, name, CurveError, ragged=ragged)
    planar = "; append a column of zeros to a planar curve"
    check_vectors(array, name, CurveError, planar=planar, transposed=TRANSPOSE_ADVICE)
    if len(array) > MAX_VERTICES:
        raise CurveError(_too_many(name, len(array)))
    return np.array(array, dtype=np.float64, order="C")


def _count_distinct(vertices: FloatArray) -> int:
    """Count the different vertices among vertices (n, 3). Counting stops at 3."""
    remaining = vertices
    for count in range(3):
        if len(remaining) == 0:
            return count
        # Drop all copies of the first one.
        remaining = remaining[(remaining != remaining[0]).any(axis=1)]
    return 3


def _check_edges(vertices: FloatArray, name: str, closed: bool) -> None:
    """Raise CurveError for an edge of length zero, and for lengths that overflow or
    underflow.

    vertices: (n, 3).
    name: what the loop is, for messages.
    closed: whether an edge joins the last vertex to the first.
    """
    ends = np.roll(vertices, -1, axis=0)
    edges = ends - vertices
    if not closed:
        edges = edges[:-1]
    zero_edges = np.flatnonzero((edges == 0).all(axis=1))
    if zero_edges.size:
        first, second = int(zero_edges[0]), (int(zero_edges[0]) + 1) % len(vertices)
        raise CurveError(
            f"vertices {first} and {second} of {name} are both {format_vector(vertices[first])}"
            f"{others_suffix(zero_edges.size)}: remove one of them"
        )
    size = float(np.abs(vertices).max())
    shortest = float(np.abs(edges).max(axis=1).min())
    # Beyond these, products of lengths would overflow or underflow.
    if size > 1e100 or shortest < 1e-100:
        raise CurveError(
            f"{name} has coordinates up to {size:g} and an edge as short as {shortest:g}: "
            "choose units that bring it nearer to 1"
        )


def _too_many(name: str, count: int) -> str:
    """The message of an error about a curve `name` with too many vertices."""
    return f"{name} has {count:,} vertices: at most {MAX_VERTICES:,} are accepted; resample it"


def edge_endpoints(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """Two arrays (m, 3): the start points and the end points of all edges of closed loops, loop
    after loop."""
    return np.concatenate(loops), np.concatenate([np.roll(v, -1, axis=0) for v in loops])


def total_length(loops: Loops) -> float:
    """The sum of the lengths of all edges of closed loops."""
    start, end = edge_endpoints(loops)
    return float(np.linalg.norm(end - start, axis=1).sum())


def bounding_box(loops: Loops) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper corner, (3,) each, of the box around the vertices of loops."""
    vertices = np.concatenate(loops)
    return vertices.min(axis=0), vertices.max(axis=0)
