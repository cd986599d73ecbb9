"""The distance to the nearest triangle, by a tree of boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.extrema import clamp, fmax, fmin
from harnack.tree.triangles import EDGES, INDEX, PARITY, TriangleRays, corners_of
from harnack.tree.walk import Node, State, for_each, walk

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3


def distance_to_triangles(rays: TriangleRays, x: Vec3) -> Real:
    """From x to the nearest point of the triangles; boxes that are farther are passed by."""
    tree = rays.tree
    real, vector = tree.backend.Float, tree.backend.Array3f
    x = vector(x)

    def visit(node: Node, state: State) -> tuple[Mask, State]:
        low, high = vector(*node.head[:3]), vector(*node.head[3:])
        outside = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
        closer = dr.squared_norm(outside) < state[0]
        return closer, for_each(node, closer & node.is_leaf, nearer, state)

    def nearer(row: list[Real], active: Mask, state: State) -> State:
        return (dr.select(active, fmin(squared_distance(row, x), state[0]), state[0]),)

    return dr.sqrt(walk(tree, visit, (real(dr.inf),))[0])


def squared_distance(row: list[Real], x: Vec3) -> Real:
    """From x to the triangle of a record: to its plane over its inside, else to its edges."""
    vector = cast("Any", type(x))
    p, q, r = corners_of(row, vector)
    first, second, third = row[EDGES : EDGES + 3]
    best = fmin(
        squared_distance_to_segment(p - x, q - p, first),
        fmin(
            squared_distance_to_segment(q - x, r - q, second),
            squared_distance_to_segment(p - x, r - p, third),
        ),
    )
    n = dr.cross(q - p, r - p)
    square = dr.squared_norm(n)
    inside = square > 0
    for a, b in ((p, q), (q, r), (r, p)):
        inside &= dr.dot(dr.cross(b - a, x - a), n) >= 0
    height = dr.dot(x - p, n)
    return dr.select(inside, fmin(best, height * height / fmax(square, type(square)(1e-37))), best)


def squared_distance_to_segment(a: Vec3, e: Vec3, inverse: Real) -> Real:
    """From the origin to the segment from a to a + e; inverse = 1/|e|^2, anything finite for 0."""
    real, vector = cast("Any", type(inverse)), cast("Any", type(a))
    share = clamp(-dr.dot(a, e) * inverse, real(0), real(1))
    return dr.squared_norm(dr.fma(vector(share), e, a))


def jumps_within(rays: TriangleRays, x: Vec3, distance: Real) -> Real:
    """The sum of what the winding number jumps by across triangles that are so near to x."""
    tree = rays.tree
    real, vector = tree.backend.Float, tree.backend.Array3f
    x, reach = vector(x), real(distance) * real(distance)

    def visit(node: Node, state: State) -> tuple[Mask, State]:
        low, high = vector(*node.head[:3]), vector(*node.head[3:])
        outside = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
        close = dr.squared_norm(outside) <= 4 * reach
        return close, for_each(node, close & node.is_leaf, add, state)

    def add(row: list[Real], active: Mask, state: State) -> State:
        within = active & (row[INDEX] >= 0) & (squared_distance(row, x) <= reach)
        return (state[0] + dr.select(within, dr.abs(row[PARITY]), 0),)

    return walk(tree, visit, (real(0),))[0]
