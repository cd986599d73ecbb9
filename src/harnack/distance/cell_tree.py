"""A tree over cells that may hold a surface: which of them are near a point, and how near.

What is known of the surface in a cell is either nothing, or that it lies in a slab; besides, some
cells know a point of the surface, their foot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.extrema import fmax, fmin
from harnack.tree import PackedTree, build_hierarchy, for_each, pack, walk
from harnack.tree.nearest import square_to_some_point
from harnack.tree.triangles import box_levels

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.walk import Node, State

__all__ = ["FAR", "NO_CELL", "CellTree", "SurfaceCells"]

NO_CELL = 0xFFFFFFFF
FAR = 1e150
"""Coordinates of feet that there are not, and the thickness of slabs that say nothing."""
_LEAF_SIZE = 4


@dataclass(frozen=True)
class SurfaceCells:
    """Cubes and what is known of the surface in them.

    centre: (n, 3). half: (n,) half the length of an edge.
    foot: (n, 3) a point of the surface, no farther from the centre than the cell is wide, or FAR.
    normal: (n, 3), offset, thickness: (n,) the surface within the ball around the cell has
        |normal . (y - centre) - offset| <= thickness; FAR where nothing is known.
    """

    centre: FloatArray
    half: FloatArray
    foot: FloatArray
    normal: FloatArray
    offset: FloatArray
    thickness: FloatArray

    def __len__(self) -> int:
        return len(self.half)

    def some(self, which: BoolArray) -> SurfaceCells:
        """Those chosen by a mask (n,)."""
        return SurfaceCells(*(part[which] for part in vars(self).values()))

    @classmethod
    def joined(cls, parts: list[SurfaceCells]) -> SurfaceCells:
        """All of several."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class CellTree:
    """Cells on a backend; there is at least one."""

    tree: PackedTree

    @classmethod
    def of(cls, backend: Backend, cells: SurfaceCells) -> CellTree:
        hierarchy = build_hierarchy(cells.centre, leaf_size=_LEAF_SIZE)
        number = np.arange(len(cells), dtype=np.float64)
        records = np.column_stack([
            cells.centre, cells.half, cells.foot, cells.thickness, cells.normal, cells.offset,
            number,
        ])  # fmt: skip
        placed = hierarchy.gather(records)
        placed[hierarchy.slots < 0] = [FAR] * 3 + [0] + [FAR] * 4 + [0, 0, 1, 0, -1]
        half = cells.half[:, None]
        levels = box_levels(hierarchy, cells.centre - half, cells.centre + half)
        return cls(pack(backend, hierarchy, levels, placed))

    def nearest_foot(
        self,
        x: Vec3,
        others: tuple[Vec3, ...],
        apart: Real,
        limit: Real,
        *,
        unbounded: bool = False,
    ) -> tuple[Real, Vec3]:  # fmt: skip
        """The squared distance of the nearest foot nearer than `limit`, of cells that come nearer
        than that, and the foot; infinite if there is none. Feet that are within `apart` half
        cells of others are left out. unbounded: whether limits say nothing."""
        vector, real = self.tree.backend.Array3f, self.tree.backend.Float
        limit = real(limit)

        def each(row: list[Real], active: Mask, state: State) -> State:
            best, foot = state
            here = vector(*row[4:7])
            square = dr.squared_norm(here - x)
            radius = apart * row[3]
            apart_from = [dr.squared_norm(here - one) >= radius * radius for one in others]
            taken = active & dr.all(apart_from) & (square < best) & (_lower(vector, row, x) < limit)
            return dr.select(taken, square, best), dr.select(taken, here, foot)

        some = (1 + 1e-9) * square_to_some_point(self.tree, x, 4) if unbounded else limit * limit
        best, foot = self._walk(x, each, (some, vector(FAR)), lambda state: state[0])
        return dr.select(foot.x < 0.5 * FAR, best, dr.inf), foot

    def mark(
        self, x: Vec3, y: Vec3, free: Real, distance: Real, tolerance: Real, marks: Any
    ) -> Real:
        """Mark the cells in which the surface may be nearer to x than `distance` by more than
        `tolerance`, farther than `free` from y: a Bool for each is set in `marks`.

        Returns a length that the surface, but for what is within `free` of y, is no nearer than;
        at most `distance`.
        """
        backend = self.tree.backend
        vector, index = backend.Array3f, backend.UInt32

        def each(row: list[Real], active: Mask, state: State) -> State:
            counts = active & ~_within(vector, row, y, free) & (row[12] >= 0)
            lower = _lower(vector, row, x)
            wanted = counts & (lower < distance - tolerance)
            dr.scatter(marks, backend.Bool(True), index(fmax(row[12], 0)), wanted)
            return (dr.select(counts, fmin(state[0], lower), state[0]),)

        limit = backend.Float(distance)
        (lower,) = self._walk(x, each, (limit,), lambda state: limit * limit)
        dr.eval(lower, marks)
        return lower

    def _walk(self, x: Vec3, each: Any, start: State, limit: Callable[[State], Real]) -> State:
        """limit: the squared distance, given the state, beyond which boxes are passed by."""
        vector = self.tree.backend.Array3f

        def visit(node: Node, state: State) -> tuple[Mask, State]:
            low, high = vector(*node.head[:3]), vector(*node.head[3:6])
            away = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
            close = dr.squared_norm(away) < limit(state)
            return close, for_each(node, close & node.is_leaf, each, state)

        return walk(self.tree, visit, start)


def _lower(vector: Any, row: list[Real], x: Vec3) -> Real:
    """A length that the surface in a cell is no nearer than: of its box, and of its slab."""
    centre, half, thickness = vector(*row[:3]), row[3], row[7]
    away = x - centre
    box = dr.norm(vector(*(fmax(dr.abs(away[k]) - half, 0) for k in range(3))))
    n = vector(*row[8:11])
    height = dr.dot(away, n)
    across = dr.norm(dr.fma(vector(-height), n, away))
    off = fmax(dr.abs(height - row[11]) - thickness, 0)
    beside = fmax(across - 1.7321 * half, 0)
    return fmax(box, dr.norm(vector(off, beside, 0)))


def _within(vector: Any, row: list[Real], y: Vec3, radius: Real) -> Mask:
    """Whether a whole cell is within a radius of y."""
    away = dr.abs(y - vector(*row[:3])) + row[3]
    return dr.squared_norm(away) < radius * radius
