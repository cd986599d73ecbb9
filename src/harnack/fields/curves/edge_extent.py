"""Where the level sets of a solid angle can be: cells proved empty are cut away.

In double precision, and done once for a curve and its levels, before any ray.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.extrema import fmin
from harnack.fields.curves.circle_sums import Circles
from harnack.fields.edges.edge import Edge
from harnack.fields.edges.edge_records import LoopEdges
from harnack.fields.edges.edge_sums import inner_product, spinor
from harnack.geometry import Circle, ConvexHull

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

# Work is bounded by cells x edges: the subdivision stops before it costs more than this.
_MOST_PAIRS = 3_000_000
_FINEST = 5


def tight_extent(
    loops: tuple[FloatArray, ...],
    circles: tuple[Circle, ...],
    lower: FloatArray,
    upper: FloatArray,
    levels: tuple[float, ...],
) -> ConvexHull:
    """A polytope of few planes that holds every point of the level sets inside a box.

    A cell with centre x and half-diagonal h is empty if h < d (its distance to the curves) and
    no level lies in [f(x) - S, f(x) + S], where S bounds the variation of the lift on B(x, h):
    S = sum_e 2 [asinh(a/(d_e - h)) - asinh(a/d_e)], the integral of the edge bound
    2a/(rho sqrt(rho^2 + a^2)) along the way (see `SolidAngle`); a circle of radius a at distances d
    and P adds the integral of its bound 2 pi a/((P-t)(d-t)) (see `circle_sums`), which is at most
    2 pi a/(P-h) ln(d/(d-h)). Cells that are not proved empty are split; those left at the end are
    wrapped in 26 planes.
    """
    corner, size = np.zeros((1, 3)), upper - lower
    scale, count = float(size.max()), sum(len(loop) for loop in loops) + 3 * len(circles)
    unit = tuple((loop - lower) / scale for loop in loops)
    backend = choose_backend("double")
    edges = LoopEdges.upload(backend, unit) if unit else None
    rounds = Circles.upload(backend, circles, lower, scale) if circles else None
    size = size / scale
    for _ in range(_FINEST):
        if 8 * len(corner) * count > _MOST_PAIRS:
            break
        size = size / 2
        steps = np.array(list(itertools.product((0, 1), repeat=3))) * size
        corner = (corner[:, None] + steps).reshape(-1, 3)
        half_diagonal = 0.5 * float(np.linalg.norm(size))
        corner = corner[~_proved_empty(edges, rounds, corner + size / 2, half_diagonal, levels)]
    if not len(corner):
        corner, size = np.zeros((1, 3)), (upper - lower) / scale
    slack = 1e-4 * float(np.linalg.norm(upper - lower))
    return _wrapped(lower + scale * (corner + size / 2), scale * size / 2 + slack)


def _proved_empty(
    edges: LoopEdges | None,
    circles: Circles | None,
    centres: FloatArray,
    h: float,
    levels: tuple[float, ...],
) -> BoolArray:
    """Whether no level lies within h of centres (n, 3); h and centres in the edges' units."""
    backend = choose_backend("double")
    x, h_device = to_vector3(backend, centres), dr.opaque(backend.Float, h)
    f, d, s = np.zeros(len(centres)), np.full(len(centres), math.inf), np.zeros(len(centres))
    parts = [_around_edges(edges, x, h_device)] if edges is not None else []
    if circles is not None:
        parts.append(circles.angle_and_variation(x, h_device))
    for part in parts:
        angle, nearest, variation = (to_numpy(one) for one in part)
        f, d, s = f + angle, np.minimum(d, nearest), s + variation
    gap = np.full(len(f), math.inf)
    for level in levels:
        gap = np.minimum(gap, np.abs(np.remainder(f - level + 2 * np.pi, 4 * np.pi) - 2 * np.pi))
    return (d > h * 1.001) & (gap > s * (1 + 1e-9) + 1e-9)


def _around_edges(edges: LoopEdges, x: Vec3, h_device: Real) -> tuple[Real, Real, Real]:
    """Solid angle at x, distance, and a bound S of the variation within h."""
    real = edges.backend.Float

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        zr, zi, nearest, variation = state
        edge = Edge.between(p, q, inverse, x)
        re, im = inner_product(spinor(edge.a)[2], spinor(edge.b)[2])
        zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
        scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
        distance, half = dr.sqrt(edge.square), 0.5 * dr.rsqrt(inverse)
        moved = dr.asinh(half / (distance - h_device)) - dr.asinh(half / distance)
        return zr * scale, zi * scale, fmin(distance, nearest), variation + 2 * moved

    start = (real(1), real(0), real(dr.inf), real(0))
    zr, zi, nearest, variation = edges.for_each(add, start, "edge extent")
    return 2 * dr.atan2(zi, zr), nearest, variation


def _wrapped(centres: FloatArray, half: FloatArray) -> ConvexHull:
    """A polytope around boxes, with the 26 directions of a cube's faces, edges and corners."""
    normals = np.array([v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)], float)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = (centres @ normals.T).max(axis=0) + np.abs(normals) @ half
    return ConvexHull(normals, offsets, (centres - half).min(axis=0), (centres + half).max(axis=0))
