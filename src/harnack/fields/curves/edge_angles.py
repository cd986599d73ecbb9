"""The solid angle as one wide expression that Dr.Jit can differentiate in both directions.

The loop of `edge_sums` is the fast way to a number; reverse mode cannot pass a recorded loop.
Here every (point, edge) pair is a lane, and a block sum adds them up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import to_vector3
from harnack.backend.arrays import gather_vectors
from harnack.fields.edges.edge_sums import inner_product, spinor

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3


def differentiable_angle(backend: Backend, loops: tuple[Any, ...], x: Vec3) -> Real:
    """Omega(x) in steradians, modulo 4 pi, of closed loops: (n, 3) arrays or Dr.Jit vectors.

    Memory grows with points times vertices. The formula is that of `sum_over_edges`, with one
    angle an edge instead of a product: an angle may jump by 4 pi, its derivative does not.
    """
    total = dr.zeros(backend.Float, dr.width(x))
    for loop in loops:
        vertices = loop if dr.is_array_v(type(loop)) else to_vector3(backend, np.asarray(loop))
        total = total + _loop_angle(backend, vertices, backend.Array3f(x))
    return total


def _loop_angle(backend: Backend, vertices: Vec3, x: Vec3) -> Real:
    points, edges = dr.width(x), dr.width(vertices)
    lane = dr.arange(backend.UInt32, points * edges)
    point, edge = lane // edges, lane % edges
    following = dr.select(edge + 1 == edges, 0, edge + 1)
    here = gather_vectors(backend, x, point)
    a = gather_vectors(backend, vertices, edge) - here
    b = gather_vectors(backend, vertices, following) - here
    # The phase of a vertex's spinor is arbitrary; it enters its two edges with opposite signs.
    re, im = inner_product(spinor(a)[2], spinor(b)[2])
    return dr.block_sum(2 * dr.atan2(im, re), edges)
