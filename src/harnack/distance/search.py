"""Nearest points of a level set by branch and bound over cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.arrays import aligned, upload_vectors
from harnack.distance.cell_tree import FAR, Best, CellTree, SurfaceCells
from harnack.distance.surface_cells import CellProofs

if TYPE_CHECKING:
    from harnack.tracer import LevelSet

__all__ = ["Descents", "Found", "Known", "Tolerance", "search"]

# The number of cells before points are looked up in them: for each point, at least, and for fields
# with sheets, which are searched in turn as well.
_EACH, _FEWEST, _FEWEST_ON_SHEETS = 0.05, 10_000, 1500
# Cells at most, and which share of that where evaluations are as expensive as sums of many terms.
_MOST, _MOST_TO_PROVE, _MOST_ON_SHEETS, _EXPENSIVE = 60_000, 150_000, 20_000, 0.25
_FINEST = 40
# Cells, at least, in which the search for a point begins.
_COARSE = 300
# Cells along an edge of the cube to begin with.
_ACROSS = 8
# Feet of other parts of the surface that are tried, from the same cells.
_CHALLENGES = 4
# In tolerances: how far to the side of its boundary the surface is looked for.
_ASIDE = 100.0
# Beside the boundary the surface was looked for already: if the best point is on it, other feet are
# tried only if they are this many times farther from it.
_APART_FROM_BOUNDARY = 2.0
# Descents begin at points that seem nearer to the surface than this many times the best.
_NEARER = 0.9
# Points that are searched for together, so that memory is bounded.
_AT_ONCE = 1 << 18
_GROWTHS = 6
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclass
class Found:
    """The nearest points found: feet (n, 3), NaN where none was, and proved lower bounds (n,) of
    the distance."""

    feet: FloatArray
    lower: FloatArray


class Descents(Protocol):
    """Ways to nearer points of the surface from points x (n, 3). They return feet, NaN where none
    was found, and radii about these within which none is nearer."""

    def polish(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """From places (n, 3) near the surface; feet farther than `limit` (n,) need not be found."""
        ...

    def leave_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """From points (n, 3) of the curve that the surface ends in, along the surface if it begins
        towards x. aside: (n,) how far from the curve it is looked for."""
        ...


@dataclass(frozen=True)
class Known:
    """What is known of the surface from the points alone.

    feet: (n, 3) points of the surface, or NaN. near: (n,) what the distance is to first order.
    """

    feet: FloatArray
    near: FloatArray

    def some(self, rows: IntArray | slice) -> Known:
        """Of some points."""
        return Known(self.feet[rows], self.near[rows])


@dataclass(frozen=True)
class Tolerance:
    """When a search ends.

    length: points that are nearer by less do not matter.
    is_proved: whether cells are split until none may hold a point that is nearer than the best by
        more than that, or there are too many.
    """

    length: float
    is_proved: bool


@dataclass(frozen=True)
class _Cube:
    """A cube that holds the surface, or the part of it that is searched."""

    center: FloatArray
    half: float

    @classmethod
    def around(cls, lower: FloatArray, upper: FloatArray) -> _Cube:
        """The smallest around a box, and a little more."""
        half = 0.5 * float((upper - lower).max()) * (1 + 1e-6)
        half += 1e-12 * float(np.abs([lower, upper]).max())
        return cls(0.5 * (lower + upper), max(half, 1e-30))


def search(
    surface: LevelSet, points: FloatArray, known: Known, descents: Descents,
    tolerance: Tolerance, progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """The nearest points of a level set to `points` (n, 3)."""
    box = _box(surface)
    if box is not None:
        if (box[0] > box[1]).any():
            return Found(np.full_like(points, np.nan), np.full(len(points), np.inf))
        return _in_parts(surface, _Cube.around(*box), points, known, descents, tolerance, progress)
    feet, lower = known.feet.copy(), np.zeros(len(points))
    rows = np.arange(len(points))
    half = 0.0
    for _ in range(_GROWTHS):
        if not len(rows):
            break
        x = points[rows]
        root = _Cube.around(x.min(axis=0), x.max(axis=0))
        away = np.linalg.norm(x - feet[rows], axis=1)
        half = max(4 * half, 1.0 + 4 * root.half, 1.1 * float(np.nanmax(away, initial=0.0)))
        root = _Cube(root.center, root.half + half)
        so_far = Known(feet[rows], known.near[rows])
        found = _in_parts(surface, root, x, so_far, descents, tolerance, progress)
        # Beyond the cube there may be more.
        to_walls = root.half - np.abs(x - root.center).max(axis=1)
        feet[rows], lower[rows] = found.feet, np.minimum(found.lower, to_walls)
        distance = np.linalg.norm(x - found.feet, axis=1)
        rows = rows[~(distance <= half)]
    return Found(feet, lower)


def _box(surface: LevelSet) -> tuple[FloatArray, FloatArray] | None:
    volume = surface.volume
    if volume is None:
        return None
    lower, upper = volume.bounds()
    return (lower, upper) if np.isfinite([lower, upper]).all() else None


def _in_parts(
    surface: LevelSet, root: _Cube, points: FloatArray, known: Known, descents: Descents,
    tolerance: Tolerance, progress: Callable[[str], None],
) -> Found:  # fmt: skip
    """The nearest points in a cube, for some of the points at a time."""
    proofs = CellProofs(surface)
    most = _most(surface, len(points), tolerance.is_proved)
    enough = min(max(_FEWEST, int(_EACH * len(points))), _MOST, most)
    if surface.field.has_sheets:
        enough = _FEWEST_ON_SHEETS
    coarse, cells = _split(proofs, root, enough, progress)
    parts: list[Found] = []
    for first in range(0, max(len(points), 1), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        at_most = most if tolerance.is_proved else 0
        job = _Search(
            proofs, coarse, cells, points[rows], known.some(rows), descents, tolerance.length, at_most
        )
        parts.append(job.run(progress))
    return Found(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("feet", "lower")))


def _most(surface: LevelSet, points: int, is_proved: bool) -> int:
    """How many cells there may be."""
    if surface.field.has_sheets:
        return _MOST_ON_SHEETS
    most = min(max(_MOST, points // 2), _MOST_TO_PROVE) if is_proved else _MOST
    return int(most * (_EXPENSIVE if surface.field.has_detail else 1.0))


def _split(
    proofs: CellProofs, root: _Cube, enough: int, progress: Callable[[str], None]
) -> tuple[SurfaceCells, SurfaceCells]:
    """Cells of the root, split until there are enough: in each round the larger half of those where
    the surface may be in several pieces, and the others by how much it may bend. Before these, the
    few cells that they are parts of."""
    half = root.half / _ACROSS
    steps = (2 * np.indices((_ACROSS,) * 3).reshape(3, -1).T + 1 - _ACROSS) * half
    cells = proofs.not_empty(root.center + steps, np.full(len(steps), half))
    coarse = cells
    for _ in range(_FINEST):
        if not 0 < len(cells) < enough:
            break
        if len(coarse) < _COARSE:
            coarse = cells
        size = np.where(cells.is_one_piece, 0.25 * cells.thickness, cells.half)
        which = size >= np.median(size)
        parts = _parts(proofs, cells, which)
        cells = SurfaceCells.joined([cells.some(~which), parts])
        progress(f"distances: {len(cells):,} cells")
    return proofs.with_feet(coarse), proofs.with_feet(cells)


def _parts(proofs: CellProofs, cells: SurfaceCells, which: BoolArray) -> SurfaceCells:
    """What is left of the cells of a mask (n,), each cut in eight."""
    half = 0.5 * cells.half[which]
    center = cells.center[which, None] + half[:, None, None] * _CORNERS
    return proofs.not_empty(center.reshape(-1, 3), np.repeat(half, 8))


class _Search:
    """The search for some points, from cells that hold all of the surface, and first from coarse
    ones.

    feet: (n, 3) the nearest points so far, or NaN. free: (n,) within these radii about them none is
    nearer. lower: (n,) proved bounds of distances. most: cells are split while they are not more.
    """

    def __init__(
        self, proofs: CellProofs, coarse: SurfaceCells, cells: SurfaceCells, points: FloatArray,
        known: Known, descents: Descents, tolerance: float, most: int,
    ) -> None:  # fmt: skip
        self.coarse = coarse
        self.proofs, self.cells, self.points, self.descents = proofs, cells, points, descents
        self.backend = choose_backend("double")
        self.known, self.feet, self.free = known, known.feet.copy(), np.zeros(len(points))
        self.lower, self.tolerance = np.zeros(len(points)), tolerance
        self.most = most

    def run(self, progress: Callable[[str], None]) -> Found:
        """What is found."""
        if not len(self.points):
            return Found(self.feet, self.lower)
        has_sheets = self.proofs.surface.field.has_sheets
        if len(self.cells):
            self._search_cells(has_sheets, progress)
        else:
            self.lower[:] = np.inf
        if not has_sheets:
            # Where sheets meet or cross within a cell, one may have no foot there; and a promise
            # that does not hold may have left out cells.
            rows = np.flatnonzero(self._is_open() | np.isnan(self.feet[:, 0]))
            rows = rows[self.known.near[rows] < _NEARER * self._distance(rows)]
            self._descend(rows, self.points[rows])
        return Found(self.feet, self.lower)

    def _search_cells(self, has_sheets: bool, progress: Callable[[str], None]) -> None:
        """Descend first from the foot of the coarse cell where the surface seems nearest, then from those
        of other parts that may be nearer. If some may still be, and there are not too many cells,
        those cells are split, and so on."""
        tree = CellTree.of(self.backend, self.cells)
        tried = self._first(CellTree.of(self.backend, self.coarse))
        if not has_sheets:
            self._leave_boundary()
        rows = np.arange(len(self.points))
        for _ in range(_FINEST):
            marks = self._challenge(tree, rows, tried[rows])
            if marks is None:
                break
            rows = np.flatnonzero(self._is_open())
            count = int(marks.sum())
            if not count or not len(rows) or len(self.cells) + 4 * count > self.most:
                break
            parts = self.proofs.with_feet(_parts(self.proofs, self.cells, marks))
            self.cells = SurfaceCells.joined([self.cells.some(~marks), parts])
            progress(f"distances: {len(self.cells):,} cells for {len(rows):,} points")
            tree = CellTree.of(self.backend, self.cells)

    def _is_open(self) -> BoolArray:
        """Whether it is not proved that no point is nearer than the best."""
        return self.lower < self._distance(slice(None)) - self.tolerance

    def _distance(self, rows: IntArray | slice) -> FloatArray:
        """Of the best feet so far; FAR where there is none."""
        away = np.linalg.norm(self.points[rows] - self.feet[rows], axis=1)
        return np.where(np.isnan(away), FAR, away)

    def _is_boundary(self, rows: IntArray | slice) -> BoolArray:
        """Whether the best is what was known."""
        return (self.feet[rows] == self.known.feet[rows]).all(axis=1)

    def _first(self, tree: CellTree) -> FloatArray:
        """Descend from the feet that seem nearest, which are returned (n, 3)."""
        limit = aligned(self.backend, self._distance(slice(None)))
        start = to_numpy(tree.nearest(upload_vectors(self.backend, self.points), limit))
        rows = np.flatnonzero(start[:, 0] < 0.5 * FAR)
        self._descend(rows, start[rows])
        return start

    def _challenge(self, tree: CellTree, rows: IntArray, first: FloatArray) -> BoolArray | None:
        """Descend from the feet of other parts of the surface that may be nearer, one after the
        other.

        first: (k, 3) feet that were tried. Returns which cells may hold points that are nearer than
        the best, of these points; None if no cells are to be split.
        """
        marks = dr.zeros(self.backend.Bool, len(self.cells)) if self.most else None
        second = np.full_like(first, FAR)
        for _ in range(_CHALLENGES):
            if not len(rows):
                break
            start = self._nearer(tree, rows, (first, second), marks)
            some = start[:, 0] < 0.5 * FAR
            rows, first, second = rows[some], second[some], start[some]
            self._descend(rows, start[some])
        return None if marks is None else to_numpy(marks)

    def _nearer(
        self, tree: CellTree, rows: IntArray, others: tuple[FloatArray, ...], marks: Any
    ) -> FloatArray:
        """`CellTree.nearer` for some points; raises their lower bounds."""
        backend, feet = self.backend, self.feet[rows]
        best = Best(
            upload_vectors(backend, np.where(np.isnan(feet), FAR, feet)),
            aligned(backend, self._distance(rows)), aligned(backend, self.free[rows]),
            aligned(backend, np.where(self._is_boundary(rows), _APART_FROM_BOUNDARY, 1.0)),
        )  # fmt: skip
        x = upload_vectors(backend, self.points[rows])
        tried = tuple(upload_vectors(backend, one) for one in others)
        tolerance = dr.opaque(backend.Float, self.tolerance)
        lower, foot = tree.nearer(x, best, tried, tolerance, marks)
        size = np.abs(self.points[rows]).max(axis=1)
        proved = to_numpy(lower) * (1 - 1e-12) - 1e-15 * size
        self.lower[rows] = np.maximum(proved, self.lower[rows])
        return to_numpy(foot)

    def _leave_boundary(self) -> None:
        """Descend from the boundary of the surface, where the best point is on it."""
        rows = np.flatnonzero(self._is_boundary(slice(None)))
        distance = self._distance(rows)
        rows, distance = rows[distance > 0], distance[distance > 0]
        aside = np.minimum(0.25 * distance, _ASIDE * self.tolerance)
        x = self.points[rows]
        self._take(rows, *self.descents.leave_boundary(x, self.feet[rows], aside))

    def _descend(self, rows: IntArray, start: FloatArray) -> None:
        """Descend from places (k, 3), points of the surface or the points themselves."""
        if not len(rows):
            return
        x = self.points[rows]
        on_surface = (start != x).any(axis=1, keepdims=True)
        self._take(rows, np.where(on_surface, start, np.nan), np.zeros(len(rows)))
        self._take(rows, *self.descents.polish(x, start, self._distance(rows)))

    def _take(self, rows: IntArray, feet: FloatArray, free: FloatArray) -> None:
        """Take points of the surface (k, 3) or NaN, and their radii, where they are nearer."""
        nearer = np.linalg.norm(self.points[rows] - feet, axis=1) < self._distance(rows)
        self.feet[rows[nearer]], self.free[rows[nearer]] = feet[nearer], free[nearer]
