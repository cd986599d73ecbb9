"""Curves in convex position, and convex hulls as clip volumes. A closed curve P is in convex
position if it lies on the boundary of a convex body and does not meet itself. Curves are closed
polygons x (n, 3), whose last vertex is joined to the first. Lengths are relative to the size of the
curve, the longest side of its bounding box. A supporting plane of an edge contains the edge and has
the whole curve on one side.

`is_convex_position` says whether a closed curve is proved to be in convex position. That is the
hypothesis of Theorems B.1 and C.1 of Gillespie, Yang, Botsch and Crane, 'Ray Tracing Harmonic
Functions' (2024): a connected curve P without self-intersections on the boundary of a convex set.
Then the 2 pi level of its solid angle lies in the hull of P, and a segment crosses that level at
most once, which gives the lower bound -4 pi.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, Real, Vec3, backend_of
from harnack.backend.elementary import orthonormal_basis_rows
from harnack.backend.validation import BoolArray
from harnack.geometry.clip_volumes import PlaneTable, Polytope, RoundingSlacks
from harnack.geometry.volume import as_padding, as_points, clip_rounding

MAX_EXAMINED_VERTICES = 2048
"""Curves with more vertices are not examined, as the tests take quadratic time."""

# All relative to the curve's size.
PLANE_TOLERANCE = 1e-12  # a vertex may lie this far off a supporting plane
ROUNDING = 1e-14  # bound of the rounding errors of a height above a plane
MIN_SEPARATION = 1e-9  # edges nearer than this count as touching
MIN_ANGLE = 1e-6  # so do edges that fold back at a smaller angle (radians)


def is_convex_position(loops: tuple[FloatArray, ...]) -> bool:
    """Whether it is proved that a curve is in convex position. Then the 2 pi level of its solid
    angle lies in the hull of the curve, and a segment crosses that level at most once (theorems
    that the module cites).

    loops: the validated loops (n, 3) of the curve.

    True means all of the following (lengths are relative to the curve's size). There is one loop.
    No edge is shorter than 1e-9: an edge that short may be nothing but rounding, and has no
    reliable direction. Edges that share no vertex are at least 1e-9 apart, and no edge folds back.
    And either all vertices lie within 1e-12 of a common plane (then P is on the boundary of its
    flat hull, a degenerate convex set), or every edge has a plane through it that no vertex exceeds
    by more than 1e-12. False means that there is no proof, as for more than 2048 vertices; it
    implies nothing about the curve.

    Stability. P is the curve, H its hull. If no vertex exceeds the plane of an edge, that edge lies
    on the boundary of H, and nothing remains to be proved. Otherwise move each point of P along the
    normal of its edge's plane until it is on the boundary of H: by at most delta = 1e-12. A vertex
    has two edges, with the normals n and n', and may move to two positions. Both lie in the wedge {
    x = a n + b n', a, b >= 0 } at the vertex, in which n.x <= delta and n'.x <= delta imply |x| <=
    2 delta / (1 + n.n'). As n.n' >= -0.9 is required (and tested), a path of this length on the
    boundary joins the two positions. The path cannot meet other edges, which are 1e-9 away; where
    it crosses an edge at the same vertex, loops of area below 1e-15 are cut off. So the theorems
    hold for a curve within w = 2e-11 of P. The solid angles of the two curves differ by at most 2 w
    / r for each edge at distance r: at r = 1e-4 that is less than the rounding error of the solid
    angle itself in single precision.
    """
    if len(loops) != 1 or not 3 <= len(loops[0]) <= MAX_EXAMINED_VERTICES:
        return False
    lower, upper = loops[0].min(axis=0), loops[0].max(axis=0)
    size = float((upper - lower).max())
    if not 0.0 < size < np.inf:
        return False
    x = (loops[0] - 0.5 * (lower + upper)) / size
    # All comparisons here are written so that NaN makes them fail.
    if not _edge_lengths(x).min() >= MIN_SEPARATION:
        return False
    return (_is_flat(x) or _lies_on_hull(x)) and is_simple(x)


def _edge_lengths(x: FloatArray) -> FloatArray:
    """The lengths (n,) of the edges of a closed polygon x (n, 3)."""
    return np.linalg.norm(np.roll(x, -1, axis=0) - x, axis=1)


def _is_flat(x: FloatArray) -> bool:
    """Whether the vertices x (n, 3) of a polygon of size 1 lie within PLANE_TOLERANCE of a common
    plane."""
    # The third result of `svd`: the directions in which the vertices vary most, less and least.
    axes: FloatArray = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2]
    # The last axis is the direction in which the vertices vary least.
    return bool(np.ptp(x @ axes[2]) <= PLANE_TOLERANCE)


def _lies_on_hull(x: FloatArray) -> bool:
    """Whether every edge of the polygon x (n, 3), of size 1, has a supporting plane up to
    PLANE_TOLERANCE, and the planes of neighboring edges do not face opposite ways."""
    count = len(x)
    normals = np.empty((count, 3))
    is_strict = np.empty(count, dtype=np.bool_)
    # To limit memory.
    edges_at_once = max(1, 200_000 // count)
    for begin in range(0, count, edges_at_once):
        indices = np.arange(begin, min(begin + edges_at_once, count))
        normals[indices], excess, is_strict[indices] = _supporting_planes(x, indices)
        if not excess.max() <= PLANE_TOLERANCE:
            return False
    next_normals = np.roll(normals, -1, axis=0)
    # No vertex exceeds the planes of these two edges: nothing is moved, and no angle is required.
    # Elsewhere the proof in `is_convex_position` requires n.n' >= -0.9.
    is_exact = is_strict & np.roll(is_strict, -1)
    return bool((is_exact | ((normals * next_normals).sum(axis=1) >= -0.9)).all())


def _supporting_planes(
    x: FloatArray, indices: np.ndarray[tuple[int], np.dtype[np.intp]]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """For each edge of the polygon x (n, 3) that begins at a vertex of `indices` (k,), find a plane
    that contains the edge and, if possible, has all vertices on one side. All vertices are on one
    side if, seen along the edge, they leave an angle of at least pi free. The plane's normal points
    to the middle of the largest free angle.

    Returns three arrays: the unit normals (k, 3) of the planes; the largest height (k,) of a vertex
    above the plane; and a mask (k,), True if all vertices except the edge's ends are below the
    plane by more than rounding.
    """
    count = len(x)
    start = x[indices]
    edge = x[(indices + 1) % count] - start
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    across, up = orthonormal_basis_rows(edge)
    offset = x[None, :, :] - start[:, None, :]
    # Coordinates of all vertices in the plane at right angles to the edge.
    a: FloatArray = np.einsum("kni,ki->kn", offset, across)
    b: FloatArray = np.einsum("kni,ki->kn", offset, up)
    angle = _widest_gap_direction(a, b)
    cosine, sine = np.cos(angle), np.sin(angle)
    height = cosine[:, None] * a + sine[:, None] * b
    excess = height.max(axis=1)
    rows = np.arange(len(indices))
    # The ends of the edge do not count.
    height[rows, indices] = -np.inf
    height[rows, (indices + 1) % count] = -np.inf
    normals = cosine[:, None] * across + sine[:, None] * up
    return normals, excess, height.max(axis=1) < -ROUNDING


def _widest_gap_direction(a: FloatArray, b: FloatArray) -> FloatArray:
    """For each of k sets of n points in the plane, find the largest angle at the origin that is
    free of points. Returns the direction of its middle, an angle (k,) in radians.

    a, b: (k, n) the coordinates of the points.

    A point at the origin (an end of the edge itself) has no direction; the direction of the
    farthest point stands for it.
    """
    distance = np.hypot(a, b)
    angle = np.arctan2(b, a)
    farthest = np.take_along_axis(angle, distance.argmax(axis=1)[:, None], axis=1)
    # Points nearer than 1e-10 count as at the origin.
    angle = np.sort(np.where(distance > 1e-10, angle, farthest), axis=1)
    # Gaps between successive angles; the last one goes around to the first angle.
    gap = np.diff(angle, axis=1, append=angle[:, :1] + 2.0 * np.pi)
    widest = gap.argmax(axis=1)[:, None]
    middle = np.take_along_axis(angle, widest, axis=1) + 0.5 * np.take_along_axis(gap, widest, 1)
    return middle[:, 0]


def is_simple(x: FloatArray) -> bool:
    """Whether the closed polygon x (n, 3), of size about 1, has no self-intersection, with a
    margin: edges without a common vertex are at least MIN_SEPARATION apart, and no edge folds back
    on its neighbor."""
    count = len(x)
    ends = np.roll(x, -1, axis=0)
    direction = (ends - x) / _edge_lengths(x)[:, None]
    # The sum of two unit vectors is nearly 0 if they are nearly opposite.
    turned = direction + np.roll(direction, -1, axis=0)
    if not np.linalg.norm(turned, axis=1).min() >= MIN_ANGLE:
        return False
    lower, upper = np.minimum(x, ends) - MIN_SEPARATION, np.maximum(x, ends)
    # Pairs of edges without a common vertex, each once; the first and the last edge have one.
    is_near = np.triu(np.ones((count, count), dtype=np.bool_), k=2)
    is_near[0, count - 1] = False
    for axis in range(3):
        is_near &= lower[:, None, axis] <= upper[None, :, axis]
        is_near &= lower[None, :, axis] <= upper[:, None, axis]
    first, second = np.nonzero(is_near)
    # In slices, to save memory.
    for begin in range(0, len(first), 100_000):
        i, j = first[begin : begin + 100_000], second[begin : begin + 100_000]
        clearance = segment_distance_lower_bound(x[i], ends[i], x[j], ends[j])
        if not clearance.min() >= MIN_SEPARATION:
            return False
    return True


def segment_distance_lower_bound(
    p1: FloatArray, q1: FloatArray, p2: FloatArray, q2: FloatArray
) -> FloatArray:
    """Lower bounds (k,) of the distances between the segments from p1 to q1 and from p2 to q2, (k,
    3) each.

    The two closest points are approximated by alternating projection (after Ericson, 'Real-Time
    Collision Detection', 5.1.9). The bound is the width of the slab between the segments, at right
    angles to the line through the two points. It is valid whether or not the projections have
    converged; if they have, it is the distance.
    """
    # Ericson's symbols: d1 and d2 are the vectors along the segments, r goes from p2 to p1, and a,
    # b, c, e, f are inner products of these.
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    c, f = _dot(d1, r), _dot(d2, r)
    determinant = a * e - b * b
    safe = np.where(determinant > 0.0, determinant, 1.0)
    # The points p1 + s d1 and p2 + t d2. At first s is nearest between the two lines, if not
    # parallel.
    s = np.where(determinant > 0.0, np.clip((b * f - c * e) / safe, 0.0, 1.0), 0.0)
    t = np.zeros_like(s)
    # Along a segment of length zero, every parameter gives the same point.
    a, e = np.where(a > 0.0, a, 1.0), np.where(e > 0.0, e, 1.0)
    for _ in range(3):
        t = np.clip((b * s + f) / e, 0.0, 1.0)
        s = np.clip((b * t - c) / a, 0.0, 1.0)
    across = (p2 + t[:, None] * d2) - (p1 + s[:, None] * d1)
    length = np.sqrt(_dot(across, across))
    n = across / np.where(length > 0.0, length, 1.0)[:, None]
    # Seen along n, the second segment is beyond `nearest` and the first one up to `farthest`.
    nearest = np.minimum(_dot(n, p2), _dot(n, q2))
    farthest = np.maximum(_dot(n, p1), _dot(n, q1))
    return np.maximum(nearest - farthest, 0.0)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """The inner products (n,) of the rows of a and b, (n, 3) each."""
    return (a * b).sum(axis=1)


# Hulls.

MAX_PLANES = 2048
"""If there are more facets, nearly parallel ones are dropped; the hull is then a little larger."""

FLATNESS = 1e-6
"""Points whose extent in a direction is below this fraction of their size get the hull of a flat or
straight set."""

_LEADING_PLANES = 24
"""Number of planes, far from each other, that rays are clipped to first."""

THIN_PADDING = 1e-6
"""Half the thickness of the hull of a flat or straight set, as a fraction of its size."""


@dataclass(frozen=True, eq=False)
class ConvexHull(Polytope):
    """A convex polytope: the set of the points x with normals[i].x <= offsets[i] for all i.
    `ConvexHull.from_points` makes it the convex hull of points.

    normals: (m, 3) unit outward normals.
    offsets: (m,) the distances of the planes from the origin.
    lower, upper: (3,) the corners of a box around the polytope.
    """

    normals: FloatArray
    offsets: FloatArray
    lower: FloatArray
    upper: FloatArray

    @staticmethod
    def from_points(points: npt.ArrayLike) -> ConvexHull:
        """The convex hull of points (n, 3), enlarged by about 1e-12 of their size.

        Each plane is pushed out to the farthest point in its direction, so all points lie inside
        however the facets' normals were rounded or merged. For points in a plane the result is a
        slab, and for points on a line a rod, which extends beyond the points by 1e-6 of their size
        on every side.

        Raises:
            ValueError: no points, NaN or infinite values, or all points the same.
        """
        x = as_points(points)
        if len(x) == 0 or not np.isfinite(x).all():
            raise ValueError("a convex hull needs at least two points, all of them finite")
        lower, upper = x.min(axis=0), x.max(axis=0)
        size = float((upper - lower).max())
        if size <= 0.0:
            raise ValueError("a convex hull needs at least two different points")
        centered = (x - 0.5 * (lower + upper)) / size
        normals, is_thin = _hull_normals(centered)
        normals = _order_by_spread(normals)
        padding = (THIN_PADDING if is_thin else 1e-12) * size
        # The rounding of the inner products in `_support`.
        padding += 4.0 * sys.float_info.epsilon * float(np.abs(x).max())
        offsets = _support(x, normals) + padding
        return ConvexHull(normals, offsets, lower - padding, upper + padding)

    def planes(self) -> FloatArray:
        """The planes as rows (normal, offset), (m, 4)."""
        return np.column_stack([self.normals, self.offsets])

    def _slacks(
        self, table: PlaneTable, o: Vec3, d: Vec3
    ) -> Callable[[Vec3, Real], RoundingSlacks]:
        """Return a function of the normal n and the offset h of a plane. The function returns
        bounds of the rounding errors of h - n.o and of n.d, for rays o + t d. table: the planes of
        the polytope. The bounds are the same for all planes, as |n| = 1 implies |n|.|o| <= |o|."""
        rounding = clip_rounding(backend_of(o))
        offset_slack, slope_slack = (
            rounding * (dr.norm(o) + table.max_offset),
            rounding * dr.norm(d),
        )
        return lambda _n, _h: (offset_slack, slope_slack)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """The lower and the upper corner (3,) of a box around the polytope."""
        return np.array(self.lower), np.array(self.upper)

    def with_planes(self, count: int) -> ConvexHull:
        """The larger polytope that is bounded by the first `count` planes and by the box."""
        planes = slice(count)
        return ConvexHull(self.normals[planes], self.offsets[planes], self.lower, self.upper)

    def padded(self, distance: float) -> ConvexHull:
        """The polytope with all planes moved outwards by `distance`, so that it contains every
        point within that distance."""
        r = as_padding(distance)
        return ConvexHull(self.normals, self.offsets + r, self.lower - r, self.upper + r)


def _support(x: FloatArray, normals: FloatArray) -> FloatArray:
    """For each normal n (m, 3), the largest n.x among the points x (n, 3); an array (m,). The
    points are taken in slices, to save memory."""
    columns = np.transpose(normals)
    highest = np.full(len(normals), -np.inf)
    for start in range(0, len(x), 4096):
        np.maximum(highest, (x[start : start + 4096] @ columns).max(axis=0), out=highest)
    return highest


def _hull_normals(x: FloatArray) -> tuple[FloatArray, bool]:
    """Find the planes of the hull of points x (n, 3), centered and of size 1. Returns the unit
    outward normals (m, 3) of half-spaces whose intersection, with suitable offsets, is the hull;
    and whether the points are flat or on a line. For flat points the normals are those of the two
    sides of a slab, and of the edges of the points' outline in their plane; for points on a line,
    those of a rod (a box)."""
    # The axes along which the points vary most, less and least: the third result of `svd`. For
    # fewer than three points the missing axes are added (`full_matrices`).
    axes: FloatArray = np.linalg.svd(x - x.mean(axis=0), full_matrices=len(x) < 3)[2]
    coordinates: FloatArray = np.einsum("ij,kj->ik", x, axes)
    thickness: FloatArray = np.ptp(coordinates, axis=0)
    both_sides = np.concatenate([axes, -axes])
    if thickness[1] <= FLATNESS:
        return both_sides, True
    if thickness[2] <= FLATNESS:
        outline = _facet_normals(coordinates[:, :2])
        if outline is None:
            return both_sides, True
        return np.concatenate([outline @ axes[:2], axes[2:], -axes[2:]]), True
    normals = _facet_normals(x)
    if normals is None:
        return both_sides, True
    return _distinct_normals(normals), False


def _facet_normals(x: FloatArray) -> FloatArray | None:
    """Compute the unit normals (m, d) of the facets of the convex hull of points x (n, d), by the
    library Qhull, which merges coplanar facets. None if Qhull finds that the points have no
    volume."""
    import scipy.spatial  # imported here: it takes half a second, and few programs need it

    qhull: Any = scipy.spatial
    try:
        equations: FloatArray = qhull.ConvexHull(x).equations
    except scipy.spatial.QhullError:
        return None
    return equations[:, :-1]


def _order_by_spread(normals: FloatArray) -> FloatArray:
    """The normals (m, 3) in another order, in which the first 24 are far from each other. So the
    first planes of a hull suffice to recognize most rays that miss it."""
    order, min_distances = [0], np.full(len(normals), np.inf)
    for _ in range(min(len(normals), _LEADING_PLANES) - 1):
        # Next comes the normal that is farthest from all normals so far; 1 - n.n' grows with the
        # angle.
        min_distances = np.minimum(min_distances, 1.0 - normals @ normals[order[-1]])
        order.append(int(np.argmax(min_distances)))
    remaining = np.setdiff1d(np.arange(len(normals)), order)
    return normals[np.concatenate([order, remaining]).astype(np.intp)]


def _distinct_normals(normals: FloatArray) -> FloatArray:
    """One unit normal of each group of nearly equal normals (n, 3), at most MAX_PLANES groups.
    Normals are grouped by rounding to 9 digits. If that leaves too many, they are rounded to fewer
    digits, and the six axis directions are added, so that the hull stays bounded."""
    digits = 9
    while True:
        _, first = np.unique(np.round(normals, digits), axis=0, return_index=True)
        if len(first) <= MAX_PLANES:
            break
        digits -= 1
    distinct = normals[np.sort(first)]
    if digits < 9:
        distinct = np.concatenate([np.eye(3), -np.eye(3), distinct])
    return distinct / np.linalg.norm(distinct, axis=1, keepdims=True)
