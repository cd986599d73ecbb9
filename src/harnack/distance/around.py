"""The surface as a point sees it: first hits of rays that leave the point in all directions.

Descents follow the gradient, and where f is nearly constant, as far from a cloud of points, that
leads anywhere. Rays are proved, so where they pass nothing there is nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray
from harnack.tracer import trace

if TYPE_CHECKING:
    from harnack.backend import Backend
    from harnack.tracer import LevelSet

__all__ = ["nearest_seen", "surface_box"]

_RAYS = 32
_ACROSS = 2048
_AT_ONCE = 4096  # points
# Shares of the extent that rays are aimed into in turn, since it is wider than the surface.
_SHARES = (0.45, 0.7, 1.0)
# Powers of the root of x^4 = x + 1.
_STRIDES = 1.2207440846057596 ** -np.arange(1.0, 4.0)


def nearest_seen(backend: Backend, surface: LevelSet, points: FloatArray) -> FloatArray:
    """The nearest first hit (n, 3) of 32 rays from each of the points (n, 3).

    They are aimed at points of the volume that holds the surface, the same for all; where that
    has no end, in directions all over the sphere. If all of them miss, the nearest first hit of
    2048 rays across the volume; NaN if those miss as well.
    """
    parts = [np.zeros((0, 3))]
    bounds = surface_box(surface)
    for start in range(0, len(points), _AT_ONCE):
        x = points[start : start + _AT_ONCE]
        o = np.repeat(x, _RAYS, axis=0)
        hits = trace(surface, o, _directions(bounds, x), precision=backend.precision)
        t = np.where(hits.hit, hits.t, np.inf).reshape(-1, _RAYS)
        rows, first = np.arange(len(x)), t.argmin(axis=1)
        position = hits.position.reshape(-1, _RAYS, 3)[rows, first]
        parts.append(np.where(np.isfinite(t[rows, first])[:, None], position, np.nan))
    near = np.concatenate(parts)
    missed = np.isnan(near[:, 0])
    if bounds is not None and missed.any():
        lower, upper = bounds
        spread = _spread(2 * _ACROSS)
        o, target = lower + (upper - lower) * spread.reshape(2, -1, 3)
        hits = trace(surface, o, target - o, precision=backend.precision)
        if hits.hit.any():
            found = hits.position[hits.hit]
            import scipy.spatial  # here: half a second that few need

            tree: Any = scipy.spatial.KDTree(found)
            near[missed] = found[tree.query(points[missed])[1]]
    return near


def surface_box(surface: LevelSet) -> tuple[FloatArray, FloatArray] | None:
    """Corners of a finite box that holds the surface, if one is known."""
    if surface.volume is None:
        return None
    lower, upper = surface.volume.bounds()
    return (lower, upper) if np.isfinite([lower, upper]).all() else None


def _spread(n: int) -> FloatArray:
    """Points (n, 3) evenly spread over the unit cube: the R3 sequence."""
    return np.remainder(0.5 + np.arange(n)[:, None] * _STRIDES, 1.0)


def _directions(bounds: tuple[FloatArray, FloatArray] | None, points: FloatArray) -> FloatArray:
    """(32 n, 3), those of each of the points (n, 3) in turn; none of them zero."""
    spread = _spread(_RAYS)
    if bounds is not None:
        lower, upper = bounds
        shares = 0.5 + np.resize(_SHARES, _RAYS)[:, None] * (spread - 0.5)
        ways = lower + (upper - lower) * shares - points[:, None]
    else:
        turn, z = 2 * np.pi * spread[:, 0], 2 * spread[:, 1] - 1
        flat = np.sqrt(1 - z * z)
        ways = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z]) + 0 * points[:, None]
    ways[~(np.linalg.norm(ways, axis=2) > 0)] = (1.0, 0.0, 0.0)
    return ways.reshape(-1, 3)
