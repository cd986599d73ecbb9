"""Nearest points of a level set by branch and bound over cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.cells import Cells
from harnack.distance.cell_tree import FAR, CellTree, SurfaceCells
from harnack.distance.surface_cells import CellProofs

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.tracer import LevelSet

__all__ = ["Found", "Polish", "search"]

# From points x and places y of the surface nearby: nearer places of it, NaN where none was found,
# and radii about these within which none is nearer.
Polish = "Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]"

# Cells that are split before the points are asked which of them matter.
_COARSE = 1500
# Cells at most: so many for each point, within these limits.
_FEWEST, _EACH, _MOST = 6_000, 1.0, 120_000
_MOST_ON_SHEETS = 20_000
_FINEST = 40
# Feet of other parts of the surface that are tried after the nearest: of cells so far apart, in
# edges.
_CHALLENGES, _APART = 2, 4.0
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
    surface: LevelSet, points: FloatArray, polish: Any, start: FloatArray, tolerance: float,
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
    surface: LevelSet, root: Cells, whole: bool, points: FloatArray, polish: Any,
    start: FloatArray, tolerance: float, progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """`whole`: whether all of the surface is in the root."""
    proofs = CellProofs(surface)
    cells, size = _split(proofs, root, _COARSE, progress)
    parts: list[Found] = []
    for first in range(0, max(len(points), 1), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        job = _Search(proofs, cells, size, points[rows], polish, start[rows].copy(), tolerance)
        parts.append(job.run(progress))
    found = Found(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("feet", "lower")))
    if not whole:
        to_walls = np.minimum(points - root.corners, root.corners + root.size - points).min(axis=1)
        found.lower = np.minimum(found.lower, to_walls)
    return found


def _split(
    proofs: CellProofs, root: Cells, most: int, progress: Callable[[str], None]
) -> tuple[SurfaceCells, float]:
    """Cells of one size, split from the root until there are many, and their size."""
    cells = root
    kept = proofs.kept(root)
    for _ in range(_FINEST):
        if not 0 < len(kept) <= most:
            break
        cells = _halves(kept)
        kept = proofs.kept(cells)
        progress(f"distances: {len(kept):,} cells")
    return kept, float(cells.size[0])


def _halves(cells: SurfaceCells) -> Cells:
    half = float(cells.half[0])
    corners = cells.centre - half
    return Cells(corners, np.full(3, 2 * half)).split()


class _Search:
    """The search for some points, from cells that hold all of the surface."""

    def __init__(
        self, proofs: CellProofs, cells: SurfaceCells, size: float, points: FloatArray, polish: Any,
        feet: FloatArray, tolerance: float,
    ) -> None:  # fmt: skip
        self.proofs, self.points, self.polish = proofs, points, polish
        self.backend = choose_backend("double")
        self.finest, self.done = cells, []
        self.feet, self.free = feet, np.zeros(len(points))
        self.tolerance, self.size = tolerance, size
        most = _MOST_ON_SHEETS if proofs.surface.field.has_sheets else _MOST
        self.most = int(min(max(_FEWEST, _EACH * len(points)), most))

    def run(self, progress: Callable[[str], None]) -> Found:
        n = len(self.points)
        if not n or not len(self.finest):
            return Found(self.feet, np.full(n, np.inf))
        tree = self._tree()
        self._improve(tree, apart=0.0)
        for _ in range(_FINEST):
            wanted = self._wanted(tree)
            count = int(wanted.sum())
            if not count or sum(map(len, self.done)) + 4 * count > self.most:
                break
            self.done.append(self.finest.some(~wanted))
            self.finest = self.proofs.kept(_halves(self.finest.some(wanted)))
            progress(f"distances: {len(self.finest):,} cells for {n:,} points")
            if not sum(map(len, [*self.done, self.finest])):
                return Found(self.feet, np.full(n, np.inf))
            tree = self._tree()
            if not len(self.finest):
                break
        self._improve(tree, apart=0.0)
        for _ in range(_CHALLENGES):
            self._improve(tree, apart=_APART)
        return Found(self.feet, self._lower(tree))

    def _tree(self) -> CellTree:
        return CellTree.of(self.backend, SurfaceCells.joined([*self.done, self.finest]))

    def _distance(self) -> FloatArray:
        """Of the best feet so far; FAR where there is none."""
        away = np.linalg.norm(self.points - self.feet, axis=1)
        return np.where(np.isnan(away), FAR, away)

    def _on_device(self) -> tuple[Any, ...]:
        backend = self.backend
        feet = np.where(np.isnan(self.feet), FAR, self.feet)
        return (
            to_vector3(backend, self.points), to_vector3(backend, feet),
            backend.Float(self.free), backend.Float(self._distance()),
        )  # fmt: skip

    def _improve(self, tree: CellTree, apart: float) -> None:
        """From the nearest feet of cells, those of other parts of the surface, to nearer points."""
        backend = self.backend
        x, y, _, distance = self._on_device()
        square, foot = tree.nearest_foot(
            x, y, dr.opaque(backend.Float, apart * 2), distance * (1 + 1e-9)
            if apart == 0 else distance + dr.minimum(0.05 * distance, 2 * self._cell()),
        )
        dr.eval(square, foot)
        there = np.sqrt(to_numpy(square))
        before = self._distance()
        rows = np.flatnonzero(there < (before if apart == 0 else np.inf))
        if not len(rows):
            return
        start = to_numpy(foot)[rows]
        better, free = self.polish(self.points[rows], start)
        away = np.linalg.norm(self.points[rows] - better, axis=1)
        off = ~(away <= there[rows])  # the way down led nowhere: the foot itself
        better[off], away[off], free[off] = start[off], there[rows][off], 0
        nearer = away < before[rows]
        self.feet[rows[nearer]], self.free[rows[nearer]] = better[nearer], free[nearer]

    def _cell(self) -> float:
        half = [part.half.max() for part in (*self.done[-1:], self.finest) if len(part)]
        return 2 * float(min(half)) if half else 0.0

    def _wanted(self, tree: CellTree) -> Any:
        """Which of the finest cells may hold a point that is nearer than the best."""
        x, y, free, distance = self._on_device()
        count = sum(map(len, self.done)) + len(self.finest)
        marks = dr.zeros(self.backend.Bool, count)
        tree.mark(x, y, free, distance - self.tolerance, marks)
        return to_numpy(marks)[count - len(self.finest) :]

    def _lower(self, tree: CellTree) -> FloatArray:
        x, y, free, distance = self._on_device()
        lower = to_numpy(tree.lower(x, y, free, distance))
        return np.maximum(lower * (1 - 1e-12) - 1e-15 * np.abs(self.points).max(axis=1), 0)
