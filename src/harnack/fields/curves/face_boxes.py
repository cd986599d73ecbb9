"""Boxes proved to hold the surface of each face of a polygon mesh, all faces at once.

In double precision, and done once for a mesh and its levels, before any ray.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import aligned, aligned_integers
from harnack.backend.extrema import fmin
from harnack.fields.curves.face_curves import PERIOD, FaceCurves
from harnack.fields.edges.edge import Edge
from harnack.fields.edges.edge_sums import inner_product, spinor

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.geometry.polygon_meshes import PolygonFaces

__all__ = ["face_boxes"]

# Cells are split up to so many times, as long as edges x cells are not more than this.
_FINEST, _MOST_PAIRS = 5, 30_000_000
# Boxes are wider than proved by this part of the size of a face.
_SLACK = 1e-4
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)), dtype=np.float64)


def face_boxes(faces: PolygonFaces, levels: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corners (m, 3) of boxes that hold the level sets of the faces' solid angles.

    The 2 pi level of a convex face lies in its convex hull (paper, Theorem B.1), which lies in the
    box of its vertices. Other surfaces lie in the isoperimetric box of `SolidAngle.extent`, of
    which cells that are proved empty are cut away (`_are_empty`); what is left is put in a box.
    """
    low, high = faces.boxes()
    nearest = min(abs(math.remainder(level, PERIOD)) for level in levels)
    size = 0.5 * np.linalg.norm(high - low, axis=1)[:, None]
    in_hull = faces.are_convex() & (nearest > 2 * math.pi * (1 - 1e-9))
    reach = 1.0001 * faces.lengths()[:, None] / math.sqrt(nearest * (PERIOD - nearest))
    lower = np.where(in_hull[:, None], low, low - reach)
    upper = np.where(in_hull[:, None], high, high + reach)
    carved = np.flatnonzero(~in_hull)
    if carved.size:
        lower[carved], upper[carved] = _carved(faces, carved, lower, upper, levels)
    return lower - _SLACK * size, upper + _SLACK * size


def _carved(
    faces: PolygonFaces, carved: IntArray, lower: FloatArray, upper: FloatArray,
    levels: tuple[float, ...],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Boxes of some faces, less the cells that are proved empty."""
    curves = FaceCurves.upload(choose_backend("double"), faces)
    sides = upper - lower
    corners = np.bincount(faces.face_of_corner)
    face, corner = carved, lower[carved]
    for _ in range(_FINEST):
        if 8 * corners[face].sum() > _MOST_PAIRS:
            break
        sides = sides / 2
        face = np.repeat(face, 8)
        corner = (corner[:, None] + _CORNERS * sides[face[::8], None]).reshape(-1, 3)
        half = 0.5 * np.linalg.norm(sides, axis=1)[face]
        kept = ~_are_empty(curves, face, corner + 0.5 * sides[face], half, levels)
        face, corner = face[kept], corner[kept]
    first = np.flatnonzero(np.diff(face, prepend=-1))
    low = np.minimum.reduceat(corner, first)
    return low, np.maximum.reduceat(corner, first) + sides[carved]


def _are_empty(
    curves: FaceCurves, face: IntArray, centres: FloatArray, half: FloatArray,
    levels: tuple[float, ...],
) -> BoolArray:  # fmt: skip
    """Whether no level set of a face comes within `half` of points: (k,) faces, (k, 3), (k,).

    Let h be `half`, less than the distance d_e to every edge e, of length 2a. A cell is empty if no
    level lies in [f - S, f + S], where S bounds how far the lift moves within h. Two bounds, the
    less of which counts:

    - Walking by s, an edge's field is at most 2a/((d_e - s) sqrt((d_e - s)^2 + a^2))
      (`SolidAngle`), whose integral is S = sum_e 2 [asinh(a/(d_e - h)) - asinh(a/d_e)].
    - The second derivative along a line is at most 2 sum_e int rho^-3 over the edge, and that
      integral at most 2a/((d_e - h)^2 sqrt((d_e - h)^2 + a^2)) (`LiftedEdge.bounds`): with the
      slope here, S = |grad f| h + h^2 sum_e 2a/((d_e - h)^2 sqrt((d_e - h)^2 + a^2)).

    A cell that holds a point of the curve is never empty.
    """
    backend = curves.heads.backend
    real = backend.Float
    index = aligned_integers(backend, face)
    on = curves.face(index).face
    x = (to_vector3(backend, centres) - on.centre) / on.size
    h = aligned(backend, half) / on.size

    def add(p: Vec3, q: Vec3, inverse: Real, state: tuple[Any, ...]) -> tuple[Any, ...]:
        zr, zi, slope, nearest, moved, bend = state
        edge = Edge.between(p, q, inverse, x)
        re, im = inner_product(spinor(edge.a)[2], spinor(edge.b)[2])
        zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
        scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
        weight, c = edge.field()
        distance, a = dr.sqrt(edge.square), 0.5 * dr.rsqrt(inverse)
        rest = distance - h
        moved = moved + 2 * (dr.asinh(a / rest) - dr.asinh(a / distance))
        bend = bend + 2 * a / (rest * rest * dr.sqrt(rest * rest + a * a))
        slope = dr.fma(type(slope)(weight), c, slope)
        return zr * scale, zi * scale, slope, fmin(distance, nearest), moved, bend

    start = (real(1), real(0), backend.Array3f(0), real(dr.inf), real(0), real(0))
    zr, zi, slope, nearest, moved, bend = on.edges.for_each(add, start, "face boxes")
    variation = fmin(moved, h * dr.fma(h, bend, dr.norm(slope)))
    f, far, s = (to_numpy(one) for one in (2 * dr.atan2(zi, zr), nearest > 1.001 * h, variation))
    gap = np.full(len(f), math.inf)
    for level in levels:
        apart = np.remainder(f - level + 0.5 * PERIOD, PERIOD) - 0.5 * PERIOD
        gap = np.minimum(gap, np.abs(apart))
    return far & (gap > s * (1 + 1e-9) + 1e-9)
