"""Where the level sets of a solid angle can be: cells proved empty are cut away.

Plain NumPy in double precision: done once for a curve and its levels, before any ray.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import numpy.typing as npt

from harnack.geometry import ConvexHull

FloatArray = npt.NDArray[np.float64]

# Work is bounded by cells x edges: the subdivision stops before it costs more than this.
_MOST_PAIRS = 3_000_000
_FINEST = 5
_PAIRS_AT_ONCE = 500_000


def tight_extent(
    loops: tuple[FloatArray, ...], lower: FloatArray, upper: FloatArray, levels: tuple[float, ...]
) -> ConvexHull:
    """A polytope of few planes that holds every point of the level sets inside a box.

    A cell with centre x and half-diagonal h is empty if h < d (its distance to the curves) and
    no level lies in [f(x) - S, f(x) + S], where S bounds the variation of the lift on B(x, h):
    S = sum_e 2 [asinh(a/(d_e - h)) - asinh(a/d_e)], the integral of the edge bound
    2a/(rho sqrt(rho^2 + a^2)) along the way (see `SolidAngle`). Cells that are not proved empty
    are split; those left at the end are wrapped in 26 planes.
    """
    start = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    corner, size = lower[None], upper - lower
    for _ in range(_FINEST):
        if 8 * len(corner) * len(start) > _MOST_PAIRS:
            break
        size = size / 2
        steps = np.array(list(itertools.product((0, 1), repeat=3))) * size
        corner = (corner[:, None] + steps).reshape(-1, 3)
        corner = corner[~_proved_empty(start, end, corner + size / 2, size, levels)]
    if not len(corner):
        corner, size = lower[None], upper - lower
    slack = 1e-4 * float(np.linalg.norm(upper - lower))
    return _wrapped(corner + size / 2, size / 2 + slack)


def _proved_empty(
    start: FloatArray, end: FloatArray, centres: FloatArray, size: FloatArray,
    levels: tuple[float, ...],
) -> npt.NDArray[np.bool_]:  # fmt: skip
    at_once = max(1, _PAIRS_AT_ONCE // len(start))
    parts = [centres[i : i + at_once] for i in range(0, len(centres), at_once)]
    half_diagonal = 0.5 * float(np.linalg.norm(size))
    return np.concatenate([_empty(start, end, x, half_diagonal, levels) for x in parts])


def _empty(
    start: FloatArray, end: FloatArray, x: FloatArray, h: float, levels: tuple[float, ...]
) -> npt.NDArray[np.bool_]:
    a, b, e = start - x[:, None], end - x[:, None], end - start
    length = np.linalg.norm(e, axis=1)
    foot = np.clip(-(a * e).sum(axis=2) / (length * length), 0, 1)
    distance = np.linalg.norm(a + foot[..., None] * e, axis=2)
    near = ~(distance > h * 1.001)
    clear = ~near.any(axis=1)
    # Where an edge is near, the cell is kept whatever its variation: any distance will do.
    distance: FloatArray = np.where(near, 2.0 * h + length, distance)
    apart = distance - h
    half = 0.5 * length
    variation = 2 * (np.arcsinh(half / apart) - np.arcsinh(half / distance)).sum(axis=1)
    variation = variation * (1 + 1e-9) + 1e-9
    (a0, a1), (b0, b1) = _spinor(a), _spinor(b)
    f = 2 * np.angle(a0.conj() * b0 + a1.conj() * b1).sum(axis=1)
    gap = np.full(len(x), math.inf)
    for level in levels:
        gap = np.minimum(gap, np.abs(np.remainder(f - level + 2 * np.pi, 4 * np.pi) - 2 * np.pi))
    return clear & (gap > variation)


def _spinor(a: FloatArray) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128]]:
    """The unnormalised spinor of directions a (..., 3), as in `edge_sums.spinor`."""
    s = np.linalg.norm(a, axis=-1) + np.abs(a[..., 2])
    across = a[..., 0] + 1j * a[..., 1]
    up = a[..., 2] >= 0
    return np.where(up, s, across.conj()), np.where(up, across, s)


def _wrapped(centres: FloatArray, half: FloatArray) -> ConvexHull:
    """A polytope around boxes, with the 26 directions of a cube's faces, edges and corners."""
    normals = np.array([v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)], float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (centres @ normals.T).max(axis=0) + np.abs(normals) @ half
    return ConvexHull(normals, offsets, (centres - half).min(axis=0), (centres + half).max(axis=0))
