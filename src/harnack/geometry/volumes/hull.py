"""The convex hull of points as a clipping volume."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, Real, Vec3, backend_of
from harnack.geometry.volumes.polytope import Planes, Polytope, Slacks
from harnack.geometry.volumes.volume import as_points, checked_distance, rounding

MAX_PLANES = 2048
"""Nearly parallel facets beyond this number are dropped; what is left is a little larger."""

FLATNESS = 1e-6
"""Points thinner than this part of their size get the hull of a flat or straight set."""

_SPREAD = 24
"""Planes that rays are clipped to first."""

THIN_PADDING = 1e-6
"""Half-thickness, as a part of the size, given to the hull of a flat or straight set."""


@dataclass(frozen=True, eq=False)
class ConvexHull(Polytope):
    """Half-spaces normals[i].x <= offsets[i]; make it with `ConvexHull.of`.

    normals: (m, 3), of unit length. offsets: (m,). lower, upper: (3,), a box around it.
    """

    normals: FloatArray
    offsets: FloatArray
    lower: FloatArray
    upper: FloatArray

    @staticmethod
    def of(points: npt.ArrayLike) -> ConvexHull:
        """The convex hull of points (n, 3), enlarged by about 1e-12 of their size.

        Each plane is pushed out to the farthest point in its direction, so all points lie
        inside however the facets' normals were rounded or merged. Points in a plane or on a
        line give a slab or a rod that is thicker than the points by 1e-6 of their size on
        every side.

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
        normals = _spread_first(normals)
        padding = (THIN_PADDING if is_thin else 1e-12) * size
        padding += 4.0 * sys.float_info.epsilon * float(np.abs(x).max())
        offsets = _support(x, normals) + padding
        return ConvexHull(normals, offsets, lower - padding, upper + padding)

    def planes(self) -> FloatArray:
        return np.column_stack([self.normals, self.offsets])

    def _slacks(self, table: Planes, o: Vec3, d: Vec3) -> Callable[[Vec3, Real], Slacks]:
        """As |n| = 1, |n|.|o| <= |o| serves all planes; in a bounded volume that is enough."""
        eps = rounding(backend_of(o))
        room, speed = eps * (dr.norm(o) + table.reach), eps * dr.norm(d)
        return lambda _n, _h: (room, speed)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        return np.array(self.lower), np.array(self.upper)

    def padded(self, distance: float) -> ConvexHull:
        r = checked_distance(distance)
        return ConvexHull(self.normals, self.offsets + r, self.lower - r, self.upper + r)


def _support(x: FloatArray, normals: FloatArray) -> FloatArray:
    """Largest n.x of each normal, in slices that keep the memory small."""
    columns = np.transpose(normals)
    highest = np.full(len(normals), -np.inf)
    for start in range(0, len(x), 4096):
        np.maximum(highest, (x[start : start + 4096] @ columns).max(axis=0), out=highest)
    return highest


def _hull_normals(x: FloatArray) -> tuple[FloatArray, bool]:
    """Unit outward normals that bound the hull of x (centered, of size 1), and if x is thin."""
    axes: FloatArray = np.linalg.svd(x - x.mean(axis=0), full_matrices=len(x) < 3)[2]
    along: FloatArray = np.einsum("ij,kj->ik", x, axes)
    thickness: FloatArray = np.ptp(along, axis=0)
    both_sides = np.concatenate([axes, -axes])
    if thickness[1] <= FLATNESS:
        return both_sides, True
    if thickness[2] <= FLATNESS:
        outline = _facet_normals(along[:, :2])
        if outline is None:
            return both_sides, True
        return np.concatenate([outline @ axes[:2], axes[2:], -axes[2:]]), True
    normals = _facet_normals(x)
    if normals is None:
        return both_sides, True
    return _without_duplicates(normals), False


def _facet_normals(x: FloatArray) -> FloatArray | None:
    """Facet normals by Qhull, which merges coplanar facets; None where it finds x degenerate."""
    import scipy.spatial  # here: half a second that few need

    qhull: Any = scipy.spatial
    try:
        equations: FloatArray = qhull.ConvexHull(x).equations
    except scipy.spatial.QhullError:
        return None
    return equations[:, :-1]


def _spread_first(normals: FloatArray) -> FloatArray:
    """The same normals, the first of which lie far from each other: what misses the hull misses
    a few of those planes."""
    order, left = [0], np.full(len(normals), np.inf)
    for _ in range(min(len(normals), _SPREAD) - 1):
        left = np.minimum(left, 1.0 - normals @ normals[order[-1]])
        order.append(int(np.argmax(left)))
    rest = np.setdiff1d(np.arange(len(normals)), order)
    return normals[np.concatenate([order, rest]).astype(np.intp)]


def _without_duplicates(normals: FloatArray) -> FloatArray:
    """One of each group of nearly equal normals, at most MAX_PLANES, and the six axes if cut."""
    digits = 9
    while True:
        _, first = np.unique(np.round(normals, digits), axis=0, return_index=True)
        if len(first) <= MAX_PLANES:
            break
        digits -= 1
    kept = normals[np.sort(first)]
    if digits < 9:
        kept = np.concatenate([np.eye(3), -np.eye(3), kept])
    return kept / np.linalg.norm(kept, axis=1, keepdims=True)
