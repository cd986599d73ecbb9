"""Nearest points of a level set by branch and bound over cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.arrays import aligned, upload_vectors
from harnack.cells import Cells
from harnack.distance.cell_tree import FAR, CellTree, SurfaceCells
from harnack.distance.surface_cells import CellProofs

if TYPE_CHECKING:
    from harnack.tracer import LevelSet

__all__ = ["Found", "Polish", "search"]

# From points x and places y of the surface nearby: nearer places of it, NaN where none was found,
# and radii about these within which none is nearer.
Polish: TypeAlias = "Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]"

# Cells that are split before the points are asked which of them matter.
_COARSE = 1500
# Cells at most: so many for each point, within these limits.
_FEWEST, _EACH, _MOST = 40_000, 0.5, 150_000
_MOST_ON_SHEETS = 20_000
# Of these shares where evaluations are as dear as those of many terms.
_DEAR = 0.25
_FINEST = 40
# Feet of other parts of the surface that are tried after the nearest: of cells so far apart, in
# edges.
_CHALLENGES, _APART = 3, 3.0
# Points that are looked at together, so that memory is bounded.
_AT_ONCE = 1 << 18
_GROWTHS = 6


@dataclass
class Found:
    """The nearest points found: feet (n, 3), NaN where none was, and proved lower bounds (n,) of
    the distance."""

    feet: FloatArray
    lower: FloatArray


def search(
    surface: LevelSet, points: FloatArray, polish: Polish, start: FloatArray, tolerance: float,
    progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """The nearest points of a level set to `points` (n, 3).

    start: (n, 3) points of the surface that are known already, or NaN.
    tolerance: of distances: cells are split until none may hold a point that is nearer than the
        best by more than that, or there are too many.
    """
    box = _box(surface)
    if box is not None:
        if (box[0] > box[1]).any():
            return Found(np.full_like(points, np.nan), np.full(len(points), np.inf))
        root = _cube(*box)
        return _in_parts(surface, root, True, points, polish, start, tolerance, progress)
    feet, lower = start.copy(), np.zeros(len(points))
    rows = np.arange(len(points))
    half = 0.0
    for _ in range(_GROWTHS):
        if not len(rows):
            break
        root = _cube(points[rows].min(axis=0), points[rows].max(axis=0))
        known = np.linalg.norm(points[rows] - feet[rows], axis=1)
        size = 1.0 + 2 * float(root.size[0])
        half = max(4 * half, size, 1.1 * float(np.nanmax(known, initial=0.0)))
        root = Cells(root.corners - half, root.size + 2 * half)
        found = _in_parts(
            surface, root, False, points[rows], polish, feet[rows], tolerance, progress
        )
        feet[rows], lower[rows] = found.feet, found.lower
        distance = np.linalg.norm(points[rows] - found.feet, axis=1)
        rows = rows[~(distance <= half)]
    return Found(feet, lower)


def _box(surface: LevelSet) -> tuple[FloatArray, FloatArray] | None:
    volume = surface.volume
    if volume is None:
        return None
    lower, upper = volume.bounds()
    return (lower, upper) if np.isfinite([lower, upper]).all() else None


def _cube(lower: FloatArray, upper: FloatArray) -> Cells:
    size = float((upper - lower).max()) * (1 + 1e-6) + 1e-12 * float(np.abs([lower, upper]).max())
    size = max(size, 1e-30)
    return Cells((0.5 * (lower + upper) - 0.5 * size)[None], np.full(3, size))


def _in_parts(
    surface: LevelSet, root: Cells, whole: bool, points: FloatArray, polish: Polish,
    start: FloatArray, tolerance: float, progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """`whole`: whether all of the surface is in the root."""
    proofs = CellProofs(surface)
    cells = _split(proofs, root, _COARSE, progress)
    parts: list[Found] = []
    for first in range(0, max(len(points), 1), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        job = _Search(proofs, cells, points[rows], polish, start[rows].copy(), tolerance)
        parts.append(job.run(progress))
    found = Found(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("feet", "lower")))
    if not whole:
        to_walls = np.minimum(points - root.corners, root.corners + root.size - points).min(axis=1)
        found.lower = np.minimum(found.lower, to_walls)
    return found


def _split(
    proofs: CellProofs, root: Cells, most: int, progress: Callable[[str], None]
) -> SurfaceCells:
    """Cells of one size, split from the root until there are many."""
    kept = proofs.kept(root)
    for _ in range(_FINEST):
        if not 0 < len(kept) <= most:
            break
        kept = proofs.kept(_halves(kept))
        progress(f"distances: {len(kept):,} cells")
    return kept


def _halves(cells: SurfaceCells) -> Cells:
    half = float(cells.half[0])
    corners = cells.centre - half
    return Cells(corners, np.full(3, 2 * half)).split()


class _Search:
    """The search for some points, from cells that hold all of the surface.

    feet: (n, 3) the nearest points so far, or NaN. free: (n,) within these radii about them none is
    nearer. lower: (n,) proved bounds of distances. is_open: (n,) whether these may be raised.
    tried: (n, 3) where the last challenge began.
    done: cells that are split no more. finest: those that may be.
    """

    def __init__(
        self, proofs: CellProofs, cells: SurfaceCells, points: FloatArray, polish: Polish,
        feet: FloatArray, tolerance: float,
    ) -> None:  # fmt: skip
        self.proofs, self.points, self.polish = proofs, points, polish
        self.backend = choose_backend("double")
        self.finest, self.done = cells, list[SurfaceCells]()
        self.feet, self.free = feet, np.zeros(len(points))
        self.lower, self.is_open = np.zeros(len(points)), np.ones(len(points), np.bool_)
        self.tolerance, self.tried = tolerance, np.full_like(points, FAR)
        most = _MOST_ON_SHEETS if proofs.surface.field.has_sheets else _MOST
        share = _DEAR if proofs.surface.field.has_detail else 1.0
        self.most = int(share * min(max(_FEWEST, _EACH * len(points)), most))

    def run(self, progress: Callable[[str], None]) -> Found:
        """What is found."""
        has_sheets = self.proofs.surface.field.has_sheets
        if not has_sheets:
            self._descend(np.arange(len(self.points)), self.points)
        self._improve(self._tree())
        for _ in range(_FINEST):
            wanted = self._bounded(self._tree())
            count = int(wanted.sum())
            if not count or sum(map(len, self.done)) + 4 * count > self.most:
                break
            self.done.append(self.finest.some(~wanted))
            self.finest = self.proofs.kept(_halves(self.finest.some(wanted)))
            progress(
                f"distances: {len(self.finest):,} cells for {int(self.is_open.sum()):,} points"
            )
            self._improve(self._tree())
        # With sheets they would be as dear as all else, and triangles that are known say enough.
        known = has_sheets and not np.isnan(self.feet).any()
        for challenge in range(1, (0 if known else _CHALLENGES) + 1):
            self._improve(self._tree(), challenge)
        self._bounded(self._tree())
        return Found(self.feet, self.lower)

    def _tree(self) -> CellTree | None:
        cells = SurfaceCells.joined([*self.done, self.finest])
        return CellTree.of(self.backend, cells) if len(cells) else None

    def _distance(self, rows: IntArray) -> FloatArray:
        """Of the best feet so far; FAR where there is none."""
        away = np.linalg.norm(self.points[rows] - self.feet[rows], axis=1)
        return np.where(np.isnan(away), FAR, away)

    def _of_rows(self, rows: IntArray) -> tuple[Any, ...]:
        """Points, their best feet, radii about these and the distances, on the backend."""
        backend, feet = self.backend, self.feet[rows]
        return (
            upload_vectors(backend, self.points[rows]),
            upload_vectors(backend, np.where(np.isnan(feet), FAR, feet)),
            aligned(backend, self.free[rows]), aligned(backend, self._distance(rows)),
        )  # fmt: skip

    def _improve(self, tree: CellTree | None, challenge: int = 0) -> None:
        """To nearer points from the nearest feet of cells that are nearer than the best. challenge:
        from those of parts of the surface that were not tried yet, even if they are a little
        farther; its number, from 1."""
        rows = np.flatnonzero(self.is_open)
        if tree is None or not len(rows):
            return
        before = self._distance(rows)
        x, y, free, distance = self._of_rows(rows)
        tried, apart, limit = upload_vectors(self.backend, self.tried[rows]), 0 * free, distance
        if challenge:
            some = free > 0 if challenge == 1 else self.backend.Bool(True)
            apart = dr.select(some, 2 * _APART, self.backend.Float(0))
            limit = limit + dr.minimum(0.1 * limit, 2 * self._cell())
        first = bool((before == FAR).all())
        square, foot = tree.nearest_foot(x, (y, tried), apart, limit, unbounded=first)
        dr.eval(square, foot)
        there, start = np.sqrt(to_numpy(square)), to_numpy(foot)
        some = np.isfinite(there)
        rows, before, there, start = rows[some], before[some], there[some], start[some]
        if challenge:
            self.tried[rows] = start
        nearer = there < before
        self.feet[rows[nearer]], self.free[rows[nearer]] = start[nearer], 0
        self._descend(rows, start)

    def _descend(self, rows: IntArray, start: FloatArray) -> None:
        """To nearer points from places (k, 3), if there are any."""
        better, free = self.polish(self.points[rows], start)
        away = np.linalg.norm(self.points[rows] - better, axis=1)
        nearer = away < self._distance(rows)
        self.feet[rows[nearer]], self.free[rows[nearer]] = better[nearer], free[nearer]

    def _cell(self) -> float:
        """The length of an edge of the finest cells."""
        return 2 * min(float(part.half[0]) for part in [*self.done, self.finest] if len(part))

    def _bounded(self, tree: CellTree | None) -> BoolArray:
        """Raise the lower bounds. Returns which of the finest cells may hold a point that is nearer
        than the best."""
        rows = np.flatnonzero(self.is_open)
        if tree is None:  # no surface
            self.lower[:], self.is_open[:] = np.inf, False
        if tree is None or not len(rows):
            return np.zeros(len(self.finest), np.bool_)
        x, y, free, distance = self._of_rows(rows)
        count = sum(map(len, self.done)) + len(self.finest)
        marks = dr.zeros(self.backend.Bool, count)
        tolerance = dr.opaque(self.backend.Float, self.tolerance)
        lower = to_numpy(tree.mark(x, y, free, distance, tolerance, marks))
        self.is_open[rows] = lower < to_numpy(distance) - self.tolerance
        size = np.abs(self.points[rows]).max(axis=1)
        self.lower[rows] = np.maximum(lower * (1 - 1e-12) - 1e-15 * size, 0)
        return to_numpy(marks)[count - len(self.finest) :]
