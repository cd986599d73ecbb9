"""Boxes in a tree, and the order in which rays enter them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_coordinate
from harnack.tree.hierarchy import build_hierarchy
from harnack.tree.packed import PackedTree, pack
from harnack.tree.triangles import box_levels
from harnack.tree.walk import Node, State, for_each, walk

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

__all__ = ["MOST_BOXES", "NO_BOX", "BoxTree"]

# Boxes are numbered in floats; single precision counts no further.
MOST_BOXES = 2**24
NO_BOX = 0xFFFFFFFF
# Column of a record behind its box.
_NUMBER = 6
_LEAF_SIZE = 4


@dataclass(frozen=True)
class BoxTree:
    """Boxes with coordinates of at most about one, which may overlap."""

    tree: PackedTree

    @classmethod
    def of(cls, backend: Backend, lower: FloatArray, upper: FloatArray) -> BoxTree:
        """Boxes from their corners (n, 3)."""
        hierarchy = build_hierarchy(0.5 * (lower + upper), leaf_size=_LEAF_SIZE)
        number = np.arange(len(lower), dtype=np.float64)[:, None]
        records = hierarchy.gather(np.concatenate([lower, upper, number], axis=1))
        records[hierarchy.slots < 0] = [np.inf] * 3 + [-np.inf] * 3 + [-1.0]
        return cls(pack(backend, hierarchy, box_levels(hierarchy, lower, upper), records))

    def next(
        self, o: Vec3, d: Vec3, after: tuple[Real, Any], start: Real, end: Real, active: Mask
    ) -> tuple[Real, Real, Any]:
        """The first box behind `after` = (t, number) that rays o + t d, |d| = 1, enter by t <= end.

        Boxes are ordered by (t, number), where t is the place that a ray enters it, at least
        `start`; those that it has left by then are not entered. Gives t there and where the ray
        leaves the box, and its number (NO_BOX for none). After (start, NO_BOX) with start less than
        `start`, all come up, each once. A box is a little wider than given, so that no ray that
        meets it passes by for rounding.
        """
        real, index = self.tree.backend.Float, self.tree.backend.UInt32
        t_after, n_after = real(after[0]), index(after[1])
        span = self._spans(o, d)

        def visit(node: Node, state: State) -> tuple[Mask, State]:
            near, far = span(node.head)
            open_ = (near <= far) & (far >= start) & (near <= fmin(state[0], end))
            return open_, for_each(node, open_ & node.is_leaf, nearer, state)

        def nearer(row: list[Real], active: Mask, state: State) -> State:
            best, leave, number = state
            near, far = span(row)
            t, n = fmax(near, start), index(fmax(row[_NUMBER], real(0)))
            later = (t > t_after) | ((t == t_after) & (n > n_after))
            first = (t < best) | ((t == best) & (n < number))
            entered = (near <= far) & (far >= start) & (t <= end) & (row[_NUMBER] >= 0)
            taken = active & entered & later & first
            return (
                dr.select(taken, t, best),
                dr.select(taken, far, leave),
                dr.select(taken, n, number),
            )

        begun = (real(dr.inf), real(dr.inf), index(NO_BOX))
        near, far, number = walk(self.tree, visit, begun, active)
        return near, far, number

    def _spans(self, o: Vec3, d: Vec3) -> Any:
        """Where rays enter and leave a box, a little early and late for rounding.

        Each plane of the box is moved outwards by 16 roundings of the size of coordinates, and t is
        widened by 8 roundings of itself: (x - o)/d has three roundings, of which that of x - o is
        at most half a unit of coordinates.
        """
        backend = self.tree.backend
        vector = backend.Array3f
        # Never zero: 1e-18 of the boxes' size is far below their padding.
        steep = dr.select(dr.abs(d) < 1e-18, dr.select(d < 0, vector(-1e-18), vector(1e-18)), d)
        inverse = dr.rcp(steep)
        pad = 16 * backend.epsilon * (1 + largest_coordinate(o))

        def span(box: Any) -> tuple[Real, Real]:
            low, high = vector(*box[:3]) - pad, vector(*box[3:6]) + pad
            a, b = (low - o) * inverse, (high - o) * inverse
            near = fmax(fmax(fmin(a.x, b.x), fmin(a.y, b.y)), fmin(a.z, b.z))
            far = fmin(fmin(fmax(a.x, b.x), fmax(a.y, b.y)), fmax(a.z, b.z))
            slack = 8 * backend.epsilon
            return near - slack * dr.abs(near), far + slack * dr.abs(far)

        return span
