"""Trees over points, segments and triangles, and grids of cells.

Built in NumPy, traversed in Dr.Jit. No formulas.
"""

from __future__ import annotations

from harnack.tree.balanced_tree import (
    NO_PRIMITIVE,
    Hierarchy,
    Node,
    PackedTree,
    build_hierarchy,
    for_each,
    pack,
    walk,
)

__all__ = [
    "NO_PRIMITIVE",
    "Hierarchy",
    "Node",
    "PackedTree",
    "build_hierarchy",
    "for_each",
    "pack",
    "walk",
]
