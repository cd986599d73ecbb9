"""Whether triangles of meshes that share vertices pass through each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.meshing.edges import Edges, IntArray, directed_edges
from harnack.tree import build_hierarchy
from harnack.tree.triangles import NO_TRIANGLE, Frame, TriangleRays, triangle_records

if TYPE_CHECKING:
    from harnack.backend import BoolArray

__all__ = ["edges_through"]

# Ends of an edge, as parts of its length, where it may touch a triangle.
_ENDS = 1e-9


def edges_through(vertices: FloatArray, of: IntArray, through: IntArray) -> int:
    """How many edges of faces `of` (m, 3) pass through faces `through` (k, 3), which may share
    vertices (n, 3) with them.

    Two triangles that cross do so along a segment, each end of which is on an edge of one of them:
    so neither set passes through the other if edges of neither pass through faces of the other.
    Edges are followed as rays through a tree of the faces, in double precision. An edge that merely
    ends on a face, as edges of neighbours do, does not count, nor does one within a face's plane.
    """
    if not len(of) or not len(through):
        return 0
    pairs = Edges.of(directed_edges(of)).ends
    corners = vertices[through]
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    pairs = pairs[_overlaps(vertices[pairs], lower, upper)]
    if not len(pairs):
        return 0
    centre, size = 0.5 * (lower + upper), float((upper - lower).max())
    x = (vertices - centre) / size
    a, b = x[pairs[:, 0]], x[pairs[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    backend = choose_backend("double")
    tree = build_hierarchy(x[through].mean(axis=1))
    rays = TriangleRays.of(backend, tree, triangle_records(x, through))
    o, d = to_vector3(backend, a), to_vector3(backend, (b - a) / length[:, None])
    frame = Frame.along(backend, o, d)
    span = backend.Float(length)
    start = _ENDS * span, backend.UInt32(NO_TRIANGLE)
    t, number, _, _ = rays.next(frame, start, span * (1 - _ENDS), True)
    found = dr.select(number != NO_TRIANGLE, t, dr.inf)
    dr.eval(found)
    return int(np.isfinite(to_numpy(found)).sum())


def _overlaps(ends: FloatArray, lower: FloatArray, upper: FloatArray) -> BoolArray:
    """(k,) whether the boxes of edges (k, 2, 3) meet a box."""
    return ((ends.min(axis=1) <= upper) & (ends.max(axis=1) >= lower)).all(axis=1)
