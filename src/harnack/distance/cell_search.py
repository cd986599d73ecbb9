"""Nearest points of a level set by branch and bound over cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_vectors
from harnack.backend.elementary import safe_norm
from harnack.distance.cell_classification import CellClassifier
from harnack.distance.cell_tree import FAR_SENTINEL, BestCandidate, CellTree, SurfaceCells
from harnack.distance.tangent_plane import in_batches

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer import TracedSurface

__all__ = ["DescentMethods", "InitialGuess", "SearchResult", "StoppingRule", "search"]

# The number of cells before points are looked up in them: for each point, at least, and for fields
# with sheets, which are searched in turn as well.
_CELLS_PER_POINT, _EACH_TO_PROVE, _MIN_CELLS, _FEWEST_ON_SHEETS = 0.16, 0.25, 10_000, 1500
# Cells at most, and which share of that where evaluations are as expensive as sums of many terms.
_MAX_CELLS, _MOST_TO_PROVE, _MOST_ON_SHEETS, _EXPENSIVE_FIELD_FACTOR = 60_000, 150_000, 20_000, 0.25
_MAX_SUBDIVISIONS = 40
# Cells, at least, in which the search for a point begins.
_COARSE = 300
# Cells along an edge of the cube to begin with.
_ACROSS = 8
# Times that feet of other parts of the surface are tried, from the same cells.
_MAX_CANDIDATE_ROUNDS = 4
# In tolerances: how far to the side of its boundary the surface is looked for.
_BOUNDARY_OFFSET = 100.0
# Beside the boundary the surface was looked for already: if the best point is on it, other feet are
# tried only if they are this many times farther from it.
_APART_FROM_BOUNDARY = 2.0
# Descents begin at points that seem nearer to the surface than this many times the best.
_MIN_GAIN = 0.9
# Points that are searched for together, so that memory is bounded.
_BATCH_SIZE = 1 << 18
_MAX_BOX_GROWTHS = 6
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclass
class SearchResult:
    """Result of a search: the closest points (n, 3) of the surface, NaN where none was found, and
    proved lower bounds (n,) of the distance."""

    closest: FloatArray
    lower_bounds: FloatArray


class DescentMethods(Protocol):
    """Interface to the closest-point iterations. For query points x (n, 3), each method returns
    points of the surface (n, 3), NaN where it finds none, and for each a radius about it in which
    no point of the surface is nearer to x."""

    def newton_in_kernel(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """Iterate inside a kernel, from points `start` near the surface. Returns closest points,
        radii, and the lanes for which `descend` is to be called. Points farther from x than `limit`
        need not be found."""
        ...

    def descend(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Iterate from points `start` (n, 3) near the surface; points farther from the query than
        `limit` (n,) need not be found."""
        ...

    def descend_from_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Iterate from points `boundary` (n, 3) of the curve at which the surface ends, along the
        surface where it begins in the direction of x. aside: (n,) how far from the curve the
        surface is looked for."""
        ...


@dataclass(frozen=True)
class InitialGuess:
    """Initial guess for the cell search.

    feet: (n, 3) points of the surface, or NaN.
    estimate: (n,) first-order distance.
    on_boundary: whether `feet` lie on the curve at which the surface ends.
    """

    feet: FloatArray
    estimate: FloatArray
    on_boundary: bool = True

    def some(self, rows: IntArray | slice) -> InitialGuess:
        """The initial guess for the queries `rows`."""
        return replace(self, feet=self.feet[rows], estimate=self.estimate[rows])


@dataclass(frozen=True)
class StoppingRule:
    """When a search ends.

    length: an improvement of the distance by less than this length is not pursued.
    prove: whether cells are subdivided until none of them may hold a point that is nearer than the
        best one by more than `length`, or until there are too many cells.
    """

    length: float
    prove: bool


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
    surface: TracedSurface, points: FloatArray, known: InitialGuess, descents: DescentMethods,
    tolerance: StoppingRule, progress: Callable[[str], None],
) -> SearchResult:  # fmt: skip
    """The nearest points of a level set to `points` (n, 3)."""
    box = _box(surface)
    if box is not None:
        if (box[0] > box[1]).any():
            return SearchResult(np.full_like(points, np.nan), np.full(len(points), np.inf))
        return _search_in_batches(
            surface, _Cube.around(*box), points, known, descents, tolerance, progress
        )
    feet, lower = known.feet.copy(), np.zeros(len(points))
    rows = np.arange(len(points))
    half = 0.0
    for _ in range(_MAX_BOX_GROWTHS):
        if not len(rows):
            break
        x = points[rows]
        root = _Cube.around(x.min(axis=0), x.max(axis=0))
        away = np.linalg.norm(x - feet[rows], axis=1)
        half = max(4 * half, 1.0 + 4 * root.half, 1.1 * float(np.nanmax(away, initial=0.0)))
        root = _Cube(root.center, root.half + half)
        so_far = replace(known.some(rows), feet=feet[rows])
        found = _search_in_batches(surface, root, x, so_far, descents, tolerance, progress)
        # Beyond the cube there may be more.
        to_walls = root.half - np.abs(x - root.center).max(axis=1)
        feet[rows], lower[rows] = found.closest, np.minimum(found.lower_bounds, to_walls)
        distance = np.linalg.norm(x - found.closest, axis=1)
        rows = rows[~(distance <= half)]
    return SearchResult(feet, lower)


def _box(surface: TracedSurface) -> tuple[FloatArray, FloatArray] | None:
    volume = surface.volume
    if volume is None:
        return None
    lower, upper = volume.bounds()
    return (lower, upper) if np.isfinite([lower, upper]).all() else None


def _search_in_batches(
    surface: TracedSurface,
    root: _Cube,
    points: FloatArray,
    known: InitialGuess,
    descents: DescentMethods,
    tolerance: StoppingRule,
    progress: Callable[[str], None],
) -> SearchResult:
    """The nearest points in a cube, for some of the points at a time."""
    proofs = CellClassifier(surface)
    most = _max_cells(surface, len(points), tolerance.prove)
    each = _EACH_TO_PROVE if tolerance.prove else _CELLS_PER_POINT
    enough = min(max(_MIN_CELLS, int(each * len(points))), _MAX_CELLS, most)
    if surface.field.has_jumps:
        enough = _FEWEST_ON_SHEETS
    coarse, cells = _split(proofs, root, enough, progress)
    backend, trees = choose_backend("double"), None
    if len(cells):
        trees = CellTree.of(backend, coarse), CellTree.of(backend, cells)
    parts: list[SearchResult] = []
    for first in range(0, max(len(points), 1), _BATCH_SIZE):
        rows = slice(first, first + _BATCH_SIZE)
        at_most = most if tolerance.prove else 0
        job = _CellSearch(
            proofs,
            cells,
            trees,
            points[rows],
            known.some(rows),
            descents,
            tolerance.length,
            at_most,
        )
        parts.append(job.run(progress))
    return SearchResult(
        *(np.concatenate([getattr(p, k) for p in parts]) for k in ("closest", "lower_bounds"))
    )


def _max_cells(surface: TracedSurface, points: int, is_proved: bool) -> int:
    """How many cells there may be."""
    if surface.field.has_jumps:
        return _MOST_ON_SHEETS
    most = min(max(_MAX_CELLS, points // 2), _MOST_TO_PROVE) if is_proved else _MAX_CELLS
    return int(most * (_EXPENSIVE_FIELD_FACTOR if surface.field.has_variable_accuracy else 1.0))


def _split(
    proofs: CellClassifier, root: _Cube, enough: int, progress: Callable[[str], None]
) -> tuple[SurfaceCells, SurfaceCells]:
    """Cells of the root, split until there are enough: in each round the larger half of those where
    the surface may be in several pieces, and the others by how much it may bend. Before these, the
    few cells that they are parts of."""
    half = root.half / _ACROSS
    steps = (2 * np.indices((_ACROSS,) * 3).reshape(3, -1).T + 1 - _ACROSS) * half
    cells = proofs.nonempty_cells(root.center + steps, np.full(len(steps), half))
    coarse = cells
    for _ in range(_MAX_SUBDIVISIONS):
        if not 0 < len(cells) < enough:
            break
        if len(coarse) < _COARSE:
            coarse = cells
        size = np.where(cells.is_single_piece, 0.25 * cells.thickness, cells.half)
        which = size >= np.median(size)
        parts = _subdivide(proofs, cells, which)
        cells = SurfaceCells.concatenate([cells.select(~which), parts])
        progress(f"distances: {len(cells):,} cells")
    return proofs.with_surface_points(coarse), proofs.with_surface_points(cells)


def _subdivide(proofs: CellClassifier, cells: SurfaceCells, which: BoolArray) -> SurfaceCells:
    """What is left of the cells of a mask (n,), each cut in eight."""
    half = 0.5 * cells.half[which]
    center = cells.center[which, None] + half[:, None, None] * _CORNERS
    return proofs.nonempty_cells(center.reshape(-1, 3), np.repeat(half, 8))


class _CellSearch:
    """Branch-and-bound search for the points closest to a batch of queries, over cells that cover
    the surface; coarse cells are searched first.

    trees: of the coarse cells and of `cells`; None if there are none.
    feet: (n, 3) best points so far, or NaN.
    free: (n,) no surface point within this radius of the best point is nearer.
    lower: (n,) proved lower bounds of the distances.
    most: cells are subdivided while there are no more than these.
    """

    def __init__(
        self,
        proofs: CellClassifier,
        cells: SurfaceCells,
        trees: tuple[CellTree, CellTree] | None,
        points: FloatArray,
        known: InitialGuess,
        descents: DescentMethods,
        tolerance: float,
        most: int,
    ) -> None:
        self.trees = trees
        self.proofs, self.cells, self.points, self.descents = proofs, cells, points, descents
        self.backend = choose_backend("double")
        self.known, self.feet, self.free = known, known.feet.copy(), np.zeros(len(points))
        self.lower, self.tolerance = np.zeros(len(points)), tolerance
        self.max_cells = most

    def run(self, progress: Callable[[str], None]) -> SearchResult:
        """The closest points and the lower bounds of the distances."""
        if not len(self.points):
            return SearchResult(self.feet, self.lower)
        has_sheets = self.proofs.surface.field.has_jumps
        if self.trees is not None:
            self._search_cells(*self.trees, has_sheets, progress)
        else:
            self.lower[:] = np.inf
        if not has_sheets:
            # Where two parts of the surface meet or cross within a cell, descents may not have
            # begun on both of them; and a promise that does not hold may have left out cells.
            rows = np.flatnonzero(self._is_unproved() | np.isnan(self.feet[:, 0]))
            rows = rows[self.known.estimate[rows] < _MIN_GAIN * self._distance(rows)]
            self._descend(rows, self.points[rows])
        return SearchResult(self.feet, self.lower)

    def _search_cells(
        self, coarse: CellTree, tree: CellTree, has_sheets: bool, progress: Callable[[str], None]
    ) -> None:
        """Descend first from the foot of the coarse cell where the surface seems nearest, then from
        those of other parts that may be nearer. If some may still be, and there are not too many
        cells, those cells are split, and so on."""
        marks = dr.zeros(self.backend.Bool, len(self.cells)) if self.max_cells else None
        if has_sheets or self._is_expensive:
            tried, rows = self._descend_from_best_start(tree), np.arange(len(self.points))
            if not has_sheets:
                self._leave_boundary()
        else:
            rows, tried = self._first_round(coarse, tree, marks)
            rows = np.union1d(rows, self._leave_boundary())
        for _ in range(_MAX_SUBDIVISIONS):
            self._improve(tree, rows, [tried[rows]], marks)
            if marks is None:
                break
            rows = np.flatnonzero(self._is_unproved())
            split = to_numpy(marks)
            count = int(split.sum())
            if not count or not len(rows) or len(self.cells) + 4 * count > self.max_cells:
                break
            parts = self.proofs.with_surface_points(_subdivide(self.proofs, self.cells, split))
            self.cells = SurfaceCells.concatenate([self.cells.select(~split), parts])
            progress(f"distances: {len(self.cells):,} cells for {len(rows):,} points")
            tree, tried = CellTree.of(self.backend, self.cells), self.feet
            marks = dr.zeros(self.backend.Bool, len(self.cells))

    def _first_round(
        self, coarse: CellTree, tree: CellTree, marks: Any
    ) -> tuple[IntArray, FloatArray]:
        """`_descend_from_best_start`, and a first `_improve`: in one kernel, where Newton's method
        ends.

        Returns the rows at which there is more to try, and the feet that were tried (n, 3).
        """
        backend = self.backend
        tolerance = dr.opaque(backend.Float, self.tolerance)

        def compute(x: Vec3, known: Vec3) -> tuple[Real | Vec3, ...]:
            real, none = backend.Float, backend.Array3f(FAR_SENTINEL)
            limit = safe_norm(known - x)
            limit = dr.select(dr.isfinite(limit), limit, FAR_SENTINEL)
            start = coarse.best_start(x, limit)
            y, free, unknown = self.descents.newton_in_kernel(x, start, limit)
            begins, away = start.x < 0.5 * FAR_SENTINEL, safe_norm(y - x)
            unknown &= begins
            is_nearer = begins & ~unknown & (away < limit)
            foot = dr.select(is_nearer, y, dr.select(limit < 0.5 * FAR_SENTINEL, known, none))
            distance = dr.select(is_nearer, away, limit)
            best = BestCandidate(
                foot, dr.select(unknown, 0, distance), dr.select(is_nearer, free, 0),
                dr.select(is_nearer, 1, real(_APART_FROM_BOUNDARY)),
            )  # fmt: skip
            lower, others = tree.closer_candidates(x, best, (start,), tolerance, marks)
            foot = dr.select(distance < 0.5 * FAR_SENTINEL, foot, dr.nan)
            return (
                foot,
                best.exclusion_radius,
                lower,
                start,
                *others,
                dr.select(unknown, real(1), 0),
            )

        self.feet, self.free, lower, start, *others, unknown = in_batches(
            backend, compute, self.points, self.known.feet
        )
        self.lower = self._rounded(lower, self.points)
        rows = np.flatnonzero(unknown)
        self._descend(rows, start[rows])
        return np.union1d(rows, self._descend_from_candidates(np.arange(len(start)), others)), start

    @staticmethod
    def _rounded(lower: FloatArray, points: FloatArray) -> FloatArray:
        """Lower bounds (n,), less what rounding may have done to them."""
        return lower * (1 - 1e-12) - 1e-15 * np.abs(points).max(axis=1)

    @property
    def _is_expensive(self) -> bool:
        """Whether evaluations take longer than walks: then fine cells tell where to begin."""
        return self.proofs.surface.field.has_variable_accuracy

    def _is_unproved(self) -> BoolArray:
        """Whether it is not proved that no point is nearer than the best."""
        return self.lower < self._distance(slice(None)) - self.tolerance

    def _distance(self, rows: IntArray | slice) -> FloatArray:
        """Of the best feet so far; FAR where there is none."""
        away = np.linalg.norm(self.points[rows] - self.feet[rows], axis=1)
        return np.where(np.isnan(away), FAR_SENTINEL, away)

    def _is_boundary(self, rows: IntArray | slice) -> BoolArray:
        """Whether the best is what was known on the boundary."""
        return self.known.on_boundary & (self.feet[rows] == self.known.feet[rows]).all(axis=1)

    def _descend_from_best_start(self, tree: CellTree) -> FloatArray:
        """Descend from the feet that seem nearest, which are returned (n, 3)."""
        limit = upload_floats(self.backend, self._distance(slice(None)))
        start = to_numpy(tree.best_start(upload_vectors(self.backend, self.points), limit))
        rows = np.flatnonzero(start[:, 0] < 0.5 * FAR_SENTINEL)
        self._descend(rows, start[rows])
        return start

    def _improve(
        self, tree: CellTree, rows: IntArray, tried: Sequence[FloatArray], marks: Any
    ) -> None:
        """Improve the best points by descents from candidates in other cells, in rounds. A query
        continues to the next round if the last one helped; it also continues, as long as it has
        candidates, if the field has jump surfaces (their cells have no tangent planes) or is
        expensive to evaluate. Expensive fields try one candidate per round.

        tried: arrays (k, 3) of candidates to skip.
        marks: see `CellTree.closer_candidates`.
        """
        for _ in range(_MAX_CANDIDATE_ROUNDS):
            if not len(rows):
                break
            starts = self._closer_candidates(tree, rows, tried, marks)
            if self._is_expensive:
                starts = starts[:1]
            nearer = self._descend_from_candidates(rows, starts)
            some = np.isin(rows, nearer)
            if self._is_expensive or self.proofs.surface.field.has_jumps:
                some |= starts[0][:, 0] < 0.5 * FAR_SENTINEL
            rows, tried = rows[some], [one[some] for one in (*tried[-1:], *starts)]

    def _descend_from_candidates(self, rows: IntArray, starts: Sequence[FloatArray]) -> IntArray:
        """Descend from feet (k, 3), FAR for none; returns the rows where that led nearer."""
        before = self._distance(rows)
        number, some = np.nonzero([start[:, 0] < 0.5 * FAR_SENTINEL for start in starts])
        self._descend(rows[some], np.stack(starts)[number, some])
        return rows[self._distance(rows) < before]

    def _closer_candidates(
        self, tree: CellTree, rows: IntArray, tried: Sequence[FloatArray], marks: Any
    ) -> list[FloatArray]:
        """`CellTree.closer_candidates` for some points; raises their lower bounds."""
        backend, feet = self.backend, self.feet[rows]
        best = BestCandidate(
            upload_vectors(backend, np.where(np.isnan(feet), FAR_SENTINEL, feet)),
            upload_floats(backend, self._distance(rows)), upload_floats(backend, self.free[rows]),
            upload_floats(backend, np.where(self._is_boundary(rows), _APART_FROM_BOUNDARY, 1.0)),
        )  # fmt: skip
        x = upload_vectors(backend, self.points[rows])
        tried_already = tuple(upload_vectors(backend, one) for one in tried)
        tolerance = dr.opaque(backend.Float, self.tolerance)
        lower, others = tree.closer_candidates(x, best, tried_already, tolerance, marks)
        dr.eval(lower, *others)
        proved = self._rounded(to_numpy(lower), self.points[rows])
        self.lower[rows] = np.maximum(proved, self.lower[rows])
        return [to_numpy(one) for one in others]

    def _leave_boundary(self) -> IntArray:
        """Descend from the boundary of the surface, where the best point is on it; returns the rows
        where that led nearer."""
        rows = np.flatnonzero(self._is_boundary(slice(None)))
        distance = self._distance(rows)
        rows, distance = rows[distance > 0], distance[distance > 0]
        aside = np.minimum(0.25 * distance, _BOUNDARY_OFFSET * self.tolerance)
        x = self.points[rows]
        self._update_best(rows, *self.descents.descend_from_boundary(x, self.feet[rows], aside))
        return rows[self._distance(rows) < distance]

    def _descend(self, rows: IntArray, start: FloatArray) -> None:
        """Descend from places (k, 3), points of the surface or the points themselves."""
        if not len(rows):
            return
        x = self.points[rows]
        on_surface = (start != x).any(axis=1, keepdims=True)
        self._update_best(rows, np.where(on_surface, start, np.nan), np.zeros(len(rows)))
        self._update_best(rows, *self.descents.descend(x, start, self._distance(rows)))

    def _update_best(self, rows: IntArray, feet: FloatArray, free: FloatArray) -> None:
        """Take points of the surface (k, 3) or NaN, and their radii, where they are nearer; rows
        may come several times."""
        away = np.linalg.norm(self.points[rows] - feet, axis=1)
        nearer = np.flatnonzero(away < self._distance(rows))
        nearer = nearer[np.argsort(-away[nearer])]  # the last one stays
        self.feet[rows[nearer]], self.free[rows[nearer]] = feet[nearer], free[nearer]
