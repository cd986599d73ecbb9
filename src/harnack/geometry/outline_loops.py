"""Outlines of regions of the plane: closed loops of points, cleaned so that they bound a region. A
loop is an array (n, 2) of points; its last point is joined to its first. `make_outline` accepts any
loops, and determines the region inside by a rule: points around which an odd number of loops runs
(even-odd), or points with a winding number other than 0. The loops that it returns do not cross,
and have the region on their left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.backend.validation import as_real_array, check_coordinate_size, check_finite
from harnack.geometry.flat_lists import next_in_lists, ranks_in_lists

__all__ = ["FillingRule", "Outline", "make_outline", "scale_for_clipper"]

Outline = tuple[FloatArray, ...]
"""Loops (n_i, 2) that do not cross, the region on their left: holes run clockwise."""
FillingRule = Literal["even-odd", "nonzero"]

MAX_EDGES = 200_000
# Segments that are closer than this fraction of the outline's size count as touching.
_TOUCH_TOLERANCE = 1e-12
# Number of pairs of segments that are compared at once; and the largest number in all: if there are
# more pairs, crossings are resolved without looking for them first.
_PAIRS_PER_BATCH, _MAX_PAIRS = 2_000_000, 100_000_000
# Coordinates are scaled to about this size for Clipper2, which rounds them to 1e-8.
_CLIPPER_SIZE = 2.0**17


def make_outline(loops: Any, rule: FillingRule = "even-odd") -> Outline:
    """The outline of the region inside of loops: the loops that bound it.

    loops: an array (n, 2) of the points of a closed loop, the last joined to the first, or several
        such arrays of different lengths. Loops may be nested to any depth, and may have either
        orientation.
    rule: which points are inside. "even-odd": points around which an odd number of loops runs, so
        that a loop in another loop is a hole, whatever its orientation. "nonzero": points whose
        winding number is not 0; the letters of fonts use this rule.

    With "even-odd", loops that neither touch nor cross keep their points exactly. Others are cut
    where they cross (by the library Clipper2, through manifold3d), with points rounded to about
    1e-13 of the outline's size.

    Raises:
        ValueError: a loop is malformed or too large; there is no area inside.
        TypeError: not numbers.
    """
    valid_loops = _validated_loops(loops)
    points = np.concatenate(valid_loops)
    size = float(np.ptp(points, axis=0).max())
    if not size > 0:
        raise ValueError("an outline encloses no area: all of its points are one")
    tolerance = _TOUCH_TOLERANCE * (size + float(np.abs(points).max()))
    if rule == "even-odd" and not _self_intersects(valid_loops, tolerance):
        return _orient_loops(valid_loops)
    outline = _resolve_crossings(valid_loops, rule)
    if not outline:
        raise ValueError("an outline encloses no area")
    return outline


def _validated_loops(loops: Any) -> list[FloatArray]:
    """Convert loops to a list of arrays (n, 2), without points that repeat the point before.

    Raises:
        ValueError: no loops, a wrong shape, numbers that are not finite or too large, too many
            points, or fewer than three points that are left.
    """
    entries: list[Any] = [loops] if _is_one_loop(loops) else list(loops)
    if not entries:
        raise ValueError("an outline needs a loop of points at least, and there is none")
    valid_loops: list[FloatArray] = []
    total = 0
    for k, loop in enumerate(entries):
        name = f"loop {k} of an outline"
        array = as_real_array(loop, name)
        if array.ndim != 2 or array.shape[1] != 2:
            raise ValueError(f"{name} must have shape (n, 2), not {array.shape}")
        points = np.array(array, dtype=np.float64)
        check_finite(points, f"point {{}} of {name}", ValueError)
        check_coordinate_size(points, ValueError)
        total += len(points)
        if total > MAX_EDGES:
            raise ValueError(f"an outline has at most {MAX_EDGES:,} points: flatten it less finely")
        points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
        if len(points) < 3:
            raise ValueError(f"{name} needs three points or more that differ, not {len(points)}")
        valid_loops.append(points)
    return valid_loops


def _is_one_loop(loops: Any) -> bool:
    """Whether the argument of `make_outline` is a single loop (n, 2), and not a list of loops.

    Raises:
        TypeError: it is neither.
    """
    if isinstance(loops, np.ndarray):
        return cast("FloatArray", loops).ndim == 2
    try:
        first = loops[0]
        return np.ndim(first) == 1
    except (TypeError, IndexError, KeyError, ValueError):
        if hasattr(loops, "__iter__"):
            return False
        raise TypeError(
            f"an outline is an array (n, 2) of points, or a list of them, not {loops!r}"
        ) from None


def _edges_and_successors(loops: list[FloatArray]) -> tuple[FloatArray, FloatArray, IntArray]:
    """The edges of closed loops (n, 2). Returns the starts (m, 2) and the ends (m, 2) of all edges,
    and for each edge the index (m,) of the next edge of the same loop."""
    start = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    return start, end, next_in_lists(np.array([len(loop) for loop in loops], dtype=np.int64))


def _self_intersects(loops: list[FloatArray], tolerance: float) -> bool:
    """Whether loops (n, 2) cross or touch themselves or each other: two edges that are not
    neighbors come within `tolerance` (a length) of each other, or an edge folds back on its
    neighbor. Also True if there are too many pairs of edges to compare."""
    start, end, successor = _edges_and_successors(loops)
    next_edge = end[successor] - start[successor]
    edge = end - start
    turn = edge[:, 0] * next_edge[:, 1] - edge[:, 1] * next_edge[:, 0]
    dot = (edge * next_edge).sum(axis=1)
    size = np.linalg.norm(edge, axis=1) * np.linalg.norm(next_edge, axis=1)
    # The next edge runs back: parallel and opposite.
    if ((np.abs(turn) <= 1e-9 * size) & (dot < 0)).any():
        return True
    lower, upper = np.minimum(start, end) - tolerance, np.maximum(start, end) + tolerance
    # Edges in the order of their lowest x. Each edge is compared with the following ones up to its
    # highest x; `counts` is their number.
    order = np.argsort(lower[:, 0], kind="stable")
    last = cast("IntArray", lower[order, 0].searchsorted(upper[order, 0], side="right"))
    counts: IntArray = last - np.arange(1, len(order) + 1)
    if int(counts.sum()) > _MAX_PAIRS:
        return True
    begin = 0
    while begin < len(order):
        stop = begin + max(1, int(counts[begin:].cumsum().searchsorted(_PAIRS_PER_BATCH)))
        batch = counts[begin:stop]
        # All pairs of the batch: edge order[rows] and each of the edges up to its highest x.
        rows = np.arange(begin, stop).repeat(batch)
        i, j = order[rows], order[rows + 1 + ranks_in_lists(batch)]
        is_near = (lower[i, 1] <= upper[j, 1]) & (lower[j, 1] <= upper[i, 1])
        is_near &= (successor[i] != j) & (successor[j] != i)
        i, j = i[is_near], j[is_near]
        if _segments_touch(start[i], end[i], start[j], end[j], tolerance).any():
            return True
        begin = stop
    return False


def _segments_touch(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, tolerance: float
) -> BoolArray:
    """Whether two segments, from a to b and from c to d, cross or come within `tolerance` (a
    length) of each other: (k,) for k pairs. a, b, c and d are (k, 2)."""

    def orientation(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        """Twice the signed area (k,) of the triangles with the corners p, q and r: positive if r is
        to the left of the line from p to q."""
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    # The ends of each segment are on different sides of the other one's line.
    is_crossing = (orientation(a, b, c) * orientation(a, b, d) < 0) & (
        orientation(c, d, a) * orientation(c, d, b) < 0
    )
    distance = np.minimum.reduce([
        _distances(a, c, d), _distances(b, c, d), _distances(c, a, b), _distances(d, a, b)
    ])  # fmt: skip
    return is_crossing | (distance <= tolerance)


def _distances(p: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """The distances (k,) of points p from the segments from a to b, for k triples (p, a, b) of
    points; each array is (k, 2)."""
    edge = b - a
    t = ((p - a) * edge).sum(axis=1) / (edge * edge).sum(axis=1)
    return np.linalg.norm(p - a - np.clip(t, 0, 1)[:, None] * edge, axis=1)


def _orient_loops(loops: list[FloatArray]) -> Outline:
    """The outline of loops that neither cross nor touch: each loop is oriented so that the region
    is on its left. The region lies inside of a loop if an even number of other loops runs around
    it, otherwise outside."""
    start, end, _ = _edges_and_successors(loops)
    loop_index = np.repeat(np.arange(len(loops)), [len(points) for points in loops])
    oriented: list[FloatArray] = []
    for k, loop in enumerate(loops):
        x, y = loop[0]
        # A ray from the loop's first point in the direction of x crosses a loop around it an odd
        # number of times.
        spans_y = (start[:, 1] > y) != (end[:, 1] > y)
        spans_y &= loop_index != k
        a, b = start[spans_y], end[spans_y]
        crossing = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
        is_hole = np.count_nonzero(crossing > x) % 2 == 1
        # Counter-clockwise for the outside of a region, clockwise for a hole.
        oriented.append(loop[::-1].copy() if (_area(loop) > 0) == is_hole else loop)
    return _make_read_only(oriented)


def _area(loop: FloatArray) -> float:
    """The signed area of a loop (n, 2), positive if it runs counter-clockwise."""
    # Relative to the first point, to avoid rounding errors far from the origin.
    offsets = loop - loop[0]
    next_offsets = np.roll(offsets, -1, axis=0)
    return 0.5 * float(
        (offsets[:, 0] * next_offsets[:, 1] - offsets[:, 1] * next_offsets[:, 0]).sum()
    )


def _resolve_crossings(loops: list[FloatArray], rule: FillingRule) -> Outline:
    """The outline of the region inside of loops that cross or touch, computed by the library
    Clipper2.

    rule: which points are inside, as for `make_outline`: "even-odd", or "nonzero" for a winding
        number other than 0.
    """
    from manifold3d import CrossSection, FillRule

    fill = FillRule.EvenOdd if rule == "even-odd" else FillRule.NonZero
    points = np.concatenate(loops)
    lower, upper = points.min(axis=0), points.max(axis=0)
    # A power of two, about a thousandth of the outline's size. The center is rounded to a multiple
    # of it, so that loops that were rounded before still have the same center.
    grid = 2.0 ** (math.frexp(float((upper - lower).max()))[1] - 10)
    center: FloatArray = np.rint(0.5 * (lower + upper) / grid) * grid
    scaled, scale = scale_for_clipper([loop - center for loop in loops])
    polygons = cast("list[FloatArray]", CrossSection(scaled, fill).to_polygons())
    outline = [np.array(loop, np.float64) for loop in polygons]
    # In a canonical order, so that the same region always has the same loops: each loop begins at
    # its lowest point (of several, the leftmost).
    outline = [
        np.roll(loop, -int(np.lexsort(loop.T)[0]), axis=0) for loop in outline if len(loop) > 2
    ]
    outline.sort(key=lambda loop: (loop[0].tolist(), loop[1].tolist()))
    return _make_read_only([loop / scale + center for loop in outline])


def _make_read_only(loops: list[FloatArray]) -> Outline:
    """The loops, made read-only, as an outline."""
    for loop in loops:
        loop.setflags(write=False)
    return tuple(loops)


def scale_for_clipper(outline: Sequence[FloatArray]) -> tuple[list[FloatArray], float]:
    """Multiply loops by a power of two that is so large that Clipper2's rounding to 1e-8 hardly
    matters. Returns the scaled loops, and the factor."""
    largest = max(float(np.abs(loop).max()) for loop in outline)
    # The second result of `frexp` is the exponent of two.
    scale = 2.0 ** (math.frexp(_CLIPPER_SIZE)[1] - math.frexp(largest)[1])
    return [np.ascontiguousarray(loop * scale) for loop in outline], scale
