"""A tree over cells that may hold a surface: which of them are near a point, and how near.

Of the surface in a cell either nothing is known, or that it lies in a slab. Besides, some cells
have a *foot*: a known point of the surface.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.backend.elementary import fmax, fmin
from harnack.backend.loops import changed_where
from harnack.tree import PackedTree, build_hierarchy, for_each, pack, walk
from harnack.tree.closest_triangles import square_to_some_point
from harnack.tree.triangle_tree import box_levels

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.tree.balanced_tree import Node, State

__all__ = ["FAR", "Best", "CellTree", "SurfaceCells"]

FAR = 1e150
"""Coordinates of missing feet, and the thickness of slabs that bound nothing."""
# Visits of nodes take a tenth of what visits of cells do.
_LEAF_SIZE = 1
# Feet of other parts of the surface that one walk finds.
_LISTED = 4
# Feet closer to one another than this many half cells lead to the same place: where the surface in
# a cell is in one piece and does not end, and elsewhere.
_APART, _APART_ELSEWHERE = 4.0, 3.0
# In half cells: the surface is in one piece in a slab that is thinner.
_THIN = 0.5
# In half cells: within this distance of its point in a cell the rim is nearly a line.
_RIM_SPREAD = 4.0


@dataclass(frozen=True)
class SurfaceCells:
    """Cubes and what is known of the surface in them.

    center: (n, 3). half: (n,) half the length of an edge.
    foot: (n, 3) a point of the surface, no farther from the center than the cell is wide, or FAR.
    normal: (n, 3), offset, thickness: (n,) the surface within the ball around the cell has |normal
        . (y - center) - offset| <= thickness, which is FAR where nothing is known. The normal is
        zero where no plane is known that is nearly the surface.
    spread: (n,) within this radius about its foot the surface is nearly that plane.
    curvature: (n,) how much it is curved there, at most; FAR where that is not known.
    rim: (n, 3) a point of the rim, the curve at which a domain cuts the surface, or FAR.
    rim_curvature: (n,) of the rim there.
    """

    center: FloatArray
    half: FloatArray
    foot: FloatArray
    normal: FloatArray
    offset: FloatArray
    thickness: FloatArray
    spread: FloatArray
    curvature: FloatArray
    rim: FloatArray
    rim_curvature: FloatArray

    @classmethod
    def unknown(cls, center: FloatArray, half: FloatArray) -> SurfaceCells:
        """Cubes of which nothing is known."""
        n = len(half)
        far, zero = np.full((n, 3), FAR), np.zeros(n)
        return cls(
            center, half, far, np.zeros((n, 3)), zero, np.full(n, FAR), zero.copy(),
            np.full(n, FAR), far.copy(), zero.copy(),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.half)

    def some(self, which: BoolArray) -> SurfaceCells:
        """Those chosen by a mask (n,)."""
        return SurfaceCells(*(part[which] for part in vars(self).values()))

    @property
    def is_one_piece(self) -> BoolArray:
        """(n,) whether the surface in a cell is in one piece, as far as its slab tells."""
        return self.thickness < _THIN * self.half

    @classmethod
    def joined(cls, parts: list[SurfaceCells]) -> SurfaceCells:
        """All of several."""
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class Best:
    """The nearest point of the surface so far.

    foot: its place. distance: how far it is.
    free: a radius about it within which no point is nearer.
    apart: how many times farther from it than from others feet have to be to be tried.
    """

    foot: Vec3
    distance: Real
    free: Real
    apart: Real


@dataclass(frozen=True)
class CellTree:
    """Cells on a backend; there is at least one."""

    tree: PackedTree

    @classmethod
    def of(cls, backend: Backend, cells: SurfaceCells) -> CellTree:
        # Points of the rim are feet of cells of their own.
        cut = np.flatnonzero(cells.rim[:, 0] < FAR)
        n, both = len(cells), np.concatenate([np.arange(len(cells)), cut])
        is_plain = cells.is_one_piece & (cells.rim[:, 0] == FAR)
        apart = np.where(is_plain, _APART, _APART_ELSEWHERE) * cells.half
        bulge = 0.15 * cells.curvature * np.square(cells.spread)
        doubt = np.where(cells.is_one_piece, np.minimum(cells.thickness, bulge), 0.0)
        records = np.column_stack([
            cells.center, cells.half, cells.foot, cells.thickness, cells.normal, cells.offset,
            np.arange(n, dtype=np.float64), cells.spread, doubt, apart,
        ])[both]  # fmt: skip
        reach = _RIM_SPREAD * cells.half[cut]
        bulge = reach * np.minimum(0.25, cells.rim_curvature[cut] * reach)
        records[n:, 4:7] = cells.rim[cut]
        records[n:, 12:] = np.column_stack([
            np.full(len(cut), -1), reach, bulge, _APART_ELSEWHERE * cells.half[cut],
        ])  # fmt: skip
        center, half = cells.center[both], cells.half[both, None]
        hierarchy = build_hierarchy(center, leaf_size=_LEAF_SIZE)
        placed = hierarchy.gather(records)
        placed[hierarchy.slots < 0] = [FAR] * 3 + [0] + [FAR] * 4 + [0, 0, 0, 0, -1, 0, 0, 0]
        levels = box_levels(hierarchy, center - half, center + half)
        return cls(pack(backend, hierarchy, levels, placed))

    def nearest(self, x: Vec3, limit: Real) -> Vec3:
        """The foot of the cell in which the surface seems to come nearest to x
        (`_Record.estimate`), and nearer than `limit`; FAR where it does not."""
        vector = self.tree.backend.Array3f

        def each(row: list[Real], active: Mask, state: State) -> State:
            best, foot = state
            cell = _Record.of(vector, row)
            near = cell.estimate(x)
            taken = active & (near < best)
            return dr.select(taken, near, best), dr.select(taken, cell.foot, foot)

        some = (1 + 1e-9) * dr.sqrt(square_to_some_point(self.tree, x, 4))
        start = fmin(some, limit), vector(FAR)
        return self._walk(x, each, start, lambda state: dr.square(state[0]))[1]

    def nearer(
        self, x: Vec3, best: Best, others: tuple[Vec3, ...], tolerance: Real, marks: Any
    ) -> tuple[Real, list[Vec3]]:
        """What cells say about points of the surface that are nearer to x than the best.

        Returns a length that the surface is no nearer than, at most the distance of the best; and
        the feet (else FAR) of the few cells where it seems to come nearest, of those in which it
        may be nearer than the best by more than `tolerance`. Feet that are not apart from the best,
        from `others` and from one another (`_APART`) are left out. In `marks`, if given, a Bool is
        set for each of those cells, wherever their feet are.
        """
        backend = self.tree.backend
        vector, index = backend.Array3f, backend.UInt32

        def each(row: list[Real], active: Mask, state: State) -> State:
            lower, *listed = state
            cell = _Record.of(vector, row)
            counts = active & ~cell.is_within(best.foot, best.free)
            here = cell.lower(x)
            wanted = counts & (here < best.distance - tolerance)
            if marks is not None:
                number = index(fmax(cell.number, 0))
                dr.scatter(marks, backend.Bool(True), number, wanted & cell.is_cell)
            lower = dr.select(counts & cell.is_cell, fmin(lower, here), lower)
            near = cell.estimate(x)
            taken = wanted & (near < best.distance + cell.doubt)
            taken &= cell.is_apart(best.foot, best.apart)
            for other in others:
                taken &= cell.is_apart(other, 1.0)
            near = dr.select(taken, near, dr.inf)
            add = functools.partial(listed_with, cell, near)
            return lower, *changed_where(taken, add, (*listed,), "listed cells")

        def listed_with(cell: _Record, near: Real, state: State) -> State:
            # The list is sorted: what is nearer takes a place, and what was there goes on to the
            # next, unless both lead to the same place.
            listed, foot = [*state], cell.foot
            for k in range(0, len(listed), 2):
                there, y = listed[k], listed[k + 1]
                is_nearer, is_apart = near < there, cell.is_apart(y, 1.0)
                listed[k] = dr.select(is_nearer, near, there)
                listed[k + 1] = dr.select(is_nearer, foot, y)
                near = dr.select(is_apart, dr.select(is_nearer, there, near), dr.inf)
                foot = dr.select(is_nearer, y, foot)
            return tuple(listed)

        def is_open(low: Vec3, high: Vec3) -> Mask:
            y = best.foot
            corner = vector(*(fmax(high[k] - y[k], y[k] - low[k]) for k in range(3)))
            return dr.squared_norm(corner) >= best.free * best.free

        limit = backend.Float(best.distance)
        empty = (one for _ in range(_LISTED) for one in (backend.Float(dr.inf), vector(FAR)))
        start = limit, *empty
        lower, *listed = self._walk(x, each, start, lambda state: limit * limit, is_open)
        return lower, listed[1::2]

    def _walk(
        self, x: Vec3, each: Any, start: State, limit: Callable[[State], Real],
        is_open: Callable[[Vec3, Vec3], Mask] = lambda low, high: low.x <= high.x,
    ) -> State:  # fmt: skip
        """limit: the squared distance, given the state, beyond which boxes are left out, and so are
        those that are not `is_open`."""
        vector = self.tree.backend.Array3f

        def visit(node: Node, state: State) -> tuple[Mask, State]:
            low, high = vector(*node.head[:3]), vector(*node.head[3:6])
            away = dr.select(x < low, low - x, dr.select(x > high, x - high, 0))
            close = (dr.squared_norm(away) < limit(state)) & is_open(low, high)
            return close, for_each(node, close & node.is_leaf, each, state)

        return walk(self.tree, visit, start)


@dataclass(frozen=True)
class _Record:
    """What the tree holds of a cell, or of a point of the rim in a cell (number < 0): the columns
    of `SurfaceCells`, and

    doubt: by how much the surface may be nearer than it seems.
    apart: feet that are closer to this one than that lead to the same place.
    """

    center: Vec3
    half: Real
    foot: Vec3
    thickness: Real
    normal: Vec3
    offset: Real
    number: Real
    spread: Real
    doubt: Real
    apart: Real

    @classmethod
    def of(cls, vector: Any, row: list[Real]) -> _Record:
        """From a row of numbers."""
        return cls(
            vector(*row[:3]), row[3], vector(*row[4:7]), row[7], vector(*row[8:11]), *row[11:16]
        )

    @property
    def is_cell(self) -> Mask:
        """Whether it is a cell of its own."""
        return self.number >= 0

    def lower(self, x: Vec3) -> Real:
        """A length that the surface in the cell is no nearer than: of its box, and of its slab."""
        vector = cast("Any", type(x))
        away = x - self.center
        box = dr.norm(vector(*(fmax(dr.abs(away[k]) - self.half, 0) for k in range(3))))
        height = dr.dot(away, self.normal)
        across = dr.norm(dr.fma(vector(-height), self.normal, away))
        off = fmax(dr.abs(height - self.offset) - self.thickness, 0)
        beside = fmax(across - 1.7321 * self.half, 0)
        return fmax(box, dr.norm(vector(off, beside, 0)))

    def estimate(self, x: Vec3) -> Real:
        """How near the surface in the cell seems to come to x, not nearer than is proved; infinite
        without a foot.

        Within the spread about the foot the surface is taken for a plane, the rim for a line: the
        way to its nearest point is at right angles to that from there to the foot.
        """
        away = x - self.foot
        height = dr.select(self.is_cell, dr.dot(away, self.normal), 0)
        square = dr.squared_norm(away) - height * height - self.spread * self.spread
        near = dr.sqrt(dr.fma(height, height, fmax(square, 0)))
        return dr.select(self.foot.x < 0.5 * FAR, fmax(near, self.lower(x)), dr.inf)

    def is_apart(self, y: Vec3, times: Real) -> Mask:
        """Whether the foot is apart from y (`_APART`), so many times as far as it has to be."""
        return dr.squared_norm(self.foot - y) >= dr.square(times * self.apart)

    def is_within(self, y: Vec3, radius: Real) -> Mask:
        """Whether the whole cell is within a radius of y."""
        away = dr.abs(y - self.center) + self.half
        return dr.squared_norm(away) < radius * radius
