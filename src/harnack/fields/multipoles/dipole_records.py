"""Oriented points as records, one by one and in the leaves of a tree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harnack.tree import NO_PRIMITIVE, build_hierarchy

if TYPE_CHECKING:
    from harnack.tree import Hierarchy
    from harnack.tree.hierarchy import FloatArray

# Dipoles of a leaf at most, and children of a node: by experiment.
_LEAF_SIZE, _ARITY = 8, 4


def hierarchy_of(points: FloatArray) -> Hierarchy:
    """Which of the points (n, 3) lie in which leaf."""
    return build_hierarchy(points, leaf_size=_LEAF_SIZE, arity=_ARITY)


def dipole_rows(points: FloatArray, moments: FloatArray) -> FloatArray:
    """(n, 8) records: position, moment, its length, 0. moments: (n, 3) area times normal."""
    weight = np.linalg.norm(moments, axis=1, keepdims=True)
    return np.concatenate([points, moments, weight, np.zeros_like(weight)], axis=1)


def padding_row(row: FloatArray) -> FloatArray:
    """(..., 8) records of dipoles (..., 8) without a moment, which add nothing."""
    empty = np.zeros_like(row)
    empty[..., :3] = row[..., :3]
    return empty


def in_slots(tree: Hierarchy, rows: FloatArray) -> FloatArray:
    """Records (leaves, leaf_size, 8); empty slots are without a moment, at the leaf's first."""
    slots = tree.gather(rows)
    empty = tree.slots == NO_PRIMITIVE
    slots[empty] = np.broadcast_to(padding_row(slots[:, :1]), slots.shape)[empty]
    return slots
