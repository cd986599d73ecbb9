"""Outlines of regions of the plane: closed loops of points, cleaned so that they bound a region.

`make_outline` accepts any loops, and determines the region inside by the even-odd rule or by
winding numbers. The loops that it returns do not cross, and have the region on their left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.backend.validation import as_real_array, check_coordinate_size, check_finite

__all__ = ["FillingRule", "Outline", "make_outline", "scale_for_clipper"]

Outline = tuple[FloatArray, ...]
"""Loops (n_i, 2) that do not cross, the region on their left: holes run clockwise."""
FillingRule = Literal["even-odd", "nonzero"]

MAX_EDGES = 200_000
# Segments closer than this part of the outline's size count as touching.
_TOUCH_TOLERANCE = 1e-12
# Pairs of segments that are compared at once, and in all; with more, crossings are resolved unseen.
_CHUNK, _MOST_PAIRS = 2_000_000, 100_000_000
# Coordinates are scaled to about this size for Clipper2, which rounds them to 1e-8.
_CLIPPER_SIZE = 2.0**17


def make_outline(loops: Any, rule: FillingRule = "even-odd") -> Outline:
    """The loops that bound the region inside of loops.

    loops: an array (n, 2) of the vertices of a closed loop, the last joined to the first, or
        several such arrays of different lengths. Loops may be nested to any depth, and may run
        either way.
    rule: which points are inside. "even-odd": points around which an odd number of loops runs, so
        that a loop in another is a hole, whichever way it runs. "nonzero": points around which
        loops run more often one way than the other; the letters of fonts use this rule.

    Loops that neither touch nor cross keep their vertices exactly. Others are cut where they cross
    (by Clipper2, through manifold3d), with vertices rounded to about 1e-13 of the outline's size.

    Raises:
        ValueError: a loop is malformed or too large; there is no area inside.
        TypeError: not numbers.
    """
    given = _checked_loops(loops)
    points = np.concatenate(given)
    size = float(np.ptp(points, axis=0).max())
    if not size > 0:
        raise ValueError("an outline encloses no area: all of its points are one")
    tolerance = _TOUCH_TOLERANCE * (size + float(np.abs(points).max()))
    if rule == "even-odd" and not _self_intersects(given, tolerance):
        return _orient_loops(given)
    made = _resolve_crossings(given, rule)
    if not made:
        raise ValueError("an outline encloses no area")
    return made


def _checked_loops(loops: Any) -> list[FloatArray]:
    several: list[Any] = [loops] if _is_one_loop(loops) else list(loops)
    if not several:
        raise ValueError("an outline needs a loop of points at least, and there is none")
    made: list[FloatArray] = []
    total = 0
    for k, one in enumerate(several):
        name = f"loop {k} of an outline"
        array = as_real_array(one, name)
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
        made.append(points)
    return made


def _is_one_loop(loops: Any) -> bool:
    """Whether this is a single loop (n, 2), and no list of loops."""
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
    """Start, end (m, 2) of all edges, and the index of the edge that follows each."""
    start = np.concatenate(loops)
    end = np.concatenate([np.roll(one, -1, axis=0) for one in loops])
    after: IntArray = np.arange(1, len(start) + 1, dtype=np.int64)
    last = np.array([len(one) for one in loops], dtype=np.int64).cumsum() - 1
    after[last] = np.concatenate([[0], last[:-1] + 1])
    return start, end, after


def _self_intersects(loops: list[FloatArray], tolerance: float) -> bool:
    """Whether edges touch or cross that are no neighbors, or neighbors run back on each other."""
    start, end, after = _edges_and_successors(loops)
    back = end[after] - start[after]
    along = end - start
    turn = along[:, 0] * back[:, 1] - along[:, 1] * back[:, 0]
    ahead = (along * back).sum(axis=1)
    size = np.linalg.norm(along, axis=1) * np.linalg.norm(back, axis=1)
    if ((np.abs(turn) <= 1e-9 * size) & (ahead < 0)).any():
        return True
    low, high = np.minimum(start, end) - tolerance, np.maximum(start, end) + tolerance
    order = np.argsort(low[:, 0], kind="stable")
    last = cast("IntArray", low[order, 0].searchsorted(high[order, 0], side="right"))
    counts: IntArray = last - np.arange(1, len(order) + 1)
    if int(counts.sum()) > _MOST_PAIRS:
        return True
    begin = 0
    while begin < len(order):
        stop = begin + max(1, int(counts[begin:].cumsum().searchsorted(_CHUNK)))
        some = counts[begin:stop]
        rows = np.arange(begin, stop).repeat(some)
        offset = np.arange(len(rows)) - (some.cumsum() - some).repeat(some)
        i, j = order[rows], order[rows + 1 + offset]
        near = (low[i, 1] <= high[j, 1]) & (low[j, 1] <= high[i, 1])
        near &= (after[i] != j) & (after[j] != i)
        i, j = i[near], j[near]
        if _segments_touch(start[i], end[i], start[j], end[j], tolerance).any():
            return True
        begin = stop
    return False


def _segments_touch(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, tolerance: float
) -> BoolArray:
    """Whether segments from a to b and from c to d, (k, 2) each, cross or touch."""

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        return (q[:, 0] - p[:, 0]) * (r[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (r[:, 0] - p[:, 0])

    crossing = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    nearest = np.minimum.reduce([
        _distances(a, c, d), _distances(b, c, d), _distances(c, a, b), _distances(d, a, b)
    ])  # fmt: skip
    return crossing | (nearest <= tolerance)


def _distances(p: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """The distance of each point from its segment."""
    along = b - a
    share = ((p - a) * along).sum(axis=1) / (along * along).sum(axis=1)
    return np.linalg.norm(p - a - np.clip(share, 0, 1)[:, None] * along, axis=1)


def _orient_loops(loops: list[FloatArray]) -> Outline:
    """Simple loops, with the region on the left of each. The region lies inside of a loop if an
    even number of other loops runs around it, else outside."""
    start, end, _ = _edges_and_successors(loops)
    owner = np.repeat(np.arange(len(loops)), [len(one) for one in loops])
    made: list[FloatArray] = []
    for k, loop in enumerate(loops):
        x, y = loop[0]
        spans = (start[:, 1] > y) != (end[:, 1] > y)
        spans &= owner != k
        a, b = start[spans], end[spans]
        at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
        is_hole = np.count_nonzero(at > x) % 2 == 1
        made.append(loop[::-1].copy() if (_area(loop) > 0) == is_hole else loop)
    return _make_read_only(made)


def _area(loop: FloatArray) -> float:
    p = loop - loop[0]
    q = np.roll(p, -1, axis=0)
    return 0.5 * float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())


def _resolve_crossings(loops: list[FloatArray], rule: FillingRule) -> Outline:
    """The boundary of the region of loops that cross or touch."""
    from manifold3d import CrossSection, FillRule

    fill = FillRule.EvenOdd if rule == "even-odd" else FillRule.NonZero
    points = np.concatenate(loops)
    low, high = points.min(axis=0), points.max(axis=0)
    unit = 2.0 ** (math.frexp(float((high - low).max()))[1] - 10)
    # A multiple of the unit, so that the rounded loops have the same one.
    center: FloatArray = np.rint(0.5 * (low + high) / unit) * unit
    scaled, scale = scale_for_clipper([one - center for one in loops])
    found = cast("list[FloatArray]", CrossSection(scaled, fill).to_polygons())
    made = [np.array(one, np.float64) for one in found]
    # In an order of its own, so that the same region always has the same loops.
    made = [np.roll(one, -int(np.lexsort(one.T)[0]), axis=0) for one in made if len(one) > 2]
    made.sort(key=lambda one: (one[0].tolist(), one[1].tolist()))
    return _make_read_only([one / scale + center for one in made])


def _make_read_only(loops: list[FloatArray]) -> Outline:
    for one in loops:
        one.setflags(write=False)
    return tuple(loops)


def scale_for_clipper(outline: Sequence[FloatArray]) -> tuple[list[FloatArray], float]:
    """The loops times a power of two, so large that Clipper2's rounding hardly matters; and that
    factor."""
    largest = max(float(np.abs(one).max()) for one in outline)
    scale = 2.0 ** (math.frexp(_CLIPPER_SIZE)[1] - math.frexp(largest)[1])
    return [np.ascontiguousarray(one * scale) for one in outline], scale
