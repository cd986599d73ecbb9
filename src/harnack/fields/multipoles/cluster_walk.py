"""Walking a tree of clusters: far ones as a whole, the primitives of near leaves one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr

from harnack.tree import Node, PackedTree, for_each, walk

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tree.walk import EachPrimitive

State: TypeAlias = "tuple[Any, ...]"


@dataclass(frozen=True)
class SeenCluster:
    """A node of the tree from points x.

    head: its numbers that every visit reads. payload: the others, fetched where it is far.
    r: x from its center. square: |r|^2, plus that of the height. inverse: 1/sqrt(square), or 0
    where the node is not far. far: whether it is far enough to be taken as a whole.
    """

    head: tuple[Real, ...]
    payload: list[Real]
    r: Vec3
    square: Real
    inverse: Real
    far: Mask


EachCluster: TypeAlias = "Callable[[SeenCluster, State], State]"


def walk_clusters(
    tree: PackedTree, x: Vec3, closer: Real, add_cluster: EachCluster,
    add_primitive: EachPrimitive, state: State, active: Mask = True, height_square: Real = 0.0,
) -> State:  # fmt: skip
    """The state after a walk over a tree whose nodes begin with their center and the distance from
    which on they may be taken as a whole; `closer` times that is asked for.

    add_cluster(cluster, state): the state with a node added where it is far. add_primitive: as
    for `tree.for_each`, of the leaves that are not. height_square: added to the squares of all
    distances, which are then those of a point beside the space of the tree.
    """
    vector = tree.backend.Array3f

    def visit(node: Node, state: State) -> tuple[Mask, State]:
        r = x - vector(*node.head[:3])
        square = dr.squared_norm(r) + height_square
        far = square > dr.square(node.head[3] * closer)
        inverse = dr.select(far, dr.rsqrt(square), 0)
        cluster = SeenCluster(node.head, node.payload(far), r, square, inverse, far)
        state = add_cluster(cluster, state)
        return ~far, for_each(node, ~far & node.is_leaf, add_primitive, state)

    return walk(tree, visit, state, active)
