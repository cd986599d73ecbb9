"""Where rays first hit a closed mesh, triangle by triangle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harnack.geometry.example_meshes import MeshArrays

# Rays that pass an edge this closely may go either way.
_BESIDE = 1e-4

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PlainHits:
    """Where rays first meet a triangle of a closed mesh across which w passes the level.

    For meshes of a size of about one.

    t: (n,), inf where none. allowed: (n,) how far rounding across the ray may move it, as the ray
    leans on the triangle. clear: (n,) whether the ray passes all edges clearly.
    """

    t: FloatArray
    allowed: FloatArray
    clear: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls, mesh: MeshArrays, exact: Callable[[FloatArray], FloatArray], o: FloatArray,
        d: FloatArray, tolerance: float,
    ) -> PlainHits:  # fmt: skip
        n = len(o)
        first, allowed, clear = np.full(n, np.inf), np.zeros(n), np.zeros(n, np.bool_)
        corners = mesh[0][mesh[1]]
        for k in range(n):
            crossings, lean, clear[k] = _crossings(corners, o[k], d[k])
            if not (clear[k] and len(crossings)):
                continue
            ends = np.concatenate([[0], crossings, [crossings[-1] + 1]])
            is_above = exact(o[k] + 0.5 * (ends[1:] + ends[:-1])[:, None] * d[k]) > 0.5
            changes = np.flatnonzero(is_above[1:] != is_above[:-1])
            if len(changes):
                first[k] = crossings[changes[0]]
                allowed[k] = tolerance + 1e-6 / max(lean[changes[0]], 1e-9)
        return cls(first, allowed, clear)

    def others(self, t: FloatArray) -> int:
        """The number of clear rays that are hit elsewhere."""
        with np.errstate(invalid="ignore"):
            is_same = (t == self.t) | (np.abs(t - self.t) <= self.allowed)
        return int((self.clear & ~is_same).sum())


def _crossings(
    corners: FloatArray, o: FloatArray, d: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """Where a ray crosses triangles (m, 3, 3), in order (Moeller and Trumbore 1997), |n.d| there,
    and whether it passes all edges clearly."""
    p, q, r = np.moveaxis(corners, 1, 0)
    e, f, s = q - p, r - p, o - p
    h, g = np.cross(d, f), np.cross(s, e)
    double_area = np.linalg.norm(np.cross(e, f), axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        volume = (e * h).sum(axis=1)
        u, v, t = (s * h).sum(axis=1), g @ d, (f * g).sum(axis=1)
        u, v, t = u / volume, v / volume, t / volume
        margin = np.minimum(np.minimum(u, v), 1 - u - v)
    near_edge = np.abs(margin) * np.sqrt(double_area) < _BESIDE
    ahead = t > -_BESIDE
    clear = not bool((ahead & (near_edge | ~np.isfinite(margin) | (np.abs(t) < _BESIDE))).any())
    crossed = np.flatnonzero((margin >= 0) & ahead)
    crossed = crossed[np.argsort(t[crossed])]
    return t[crossed], np.abs(volume[crossed]) / double_area[crossed], clear
