"""Trees over points, segments and triangles, and grids of cells.

Built in NumPy, traversed in Dr.Jit. No formulas.
"""

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
