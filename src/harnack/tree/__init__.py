"""Trees over points, segments and triangles, and grids of cells. A *primitive* is one of the
points, segments or triangles; a *leaf* holds a few of them, and a *node* stands for all primitives
below it. Trees are built in NumPy and traversed in Dr.Jit."""

from __future__ import annotations

from harnack.tree.balanced_tree import (
    NO_PRIMITIVE,
    BalancedTree,
    PackedTree,
    VisitedNode,
    build_balanced_tree,
    for_each_primitive,
    pack_tree,
    traverse,
)

__all__ = [
    "NO_PRIMITIVE",
    "BalancedTree",
    "PackedTree",
    "VisitedNode",
    "build_balanced_tree",
    "for_each_primitive",
    "pack_tree",
    "traverse",
]
