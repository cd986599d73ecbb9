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

# The number of cells before points are looked up in them: per point; at least; and for fields with
# jump surfaces, which are searched in turn as well.
_CELLS_PER_POINT, _PROOF_CELLS_PER_POINT, _MIN_CELLS, _MIN_JUMP_CELLS = 0.16, 0.25, 10_000, 1500
# The largest number of cells, and the fraction of it where evaluations are as expensive as sums of
# many terms.
_MAX_CELLS, _MAX_PROOF_CELLS, _MAX_JUMP_CELLS, _EXPENSIVE_FIELD_FACTOR = (
    60_000,
    150_000,
    20_000,
    0.25,
)
_MAX_SUBDIVISIONS = 40
# The smallest number of cells in which the search for a point begins.
_COARSE = 300
# Number of cells along an edge of the first cube.
_ACROSS = 8
# Number of times that surface points of other parts of the surface are tried, from the same cells.
_MAX_CANDIDATE_ROUNDS = 4
# In tolerances: the distance from the boundary curve at which the surface is looked for.
_BOUNDARY_OFFSET = 100.0
# Beside the boundary the surface was looked for already: if the best point is on it, other surface
# points are tried only if they are this many times farther from it.
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
        surface where it begins in the direction of x. aside: (n,) the distance from the curve at
        which the surface is searched."""
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

    def select(self, rows: IntArray | slice) -> InitialGuess:
        """The initial guess for the queries `rows`."""
        return replace(self, feet=self.feet[rows], estimate=self.estimate[rows])


@dataclass(frozen=True)
class StoppingRule:
    """The condition under which a search ends.

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
        """The smallest cube around a box, slightly enlarged."""
        half = 0.5 * float((upper - lower).max()) * (1 + 1e-6)
        half += 1e-12 * float(np.abs([lower, upper]).max())
        return cls(0.5 * (lower + upper), max(half, 1e-30))


def search(
    surface: TracedSurface, points: FloatArray, guess: InitialGuess, descents: DescentMethods,
    tolerance: StoppingRule, progress: Callable[[str], None],
) -> SearchResult:  # fmt: skip
    """The nearest points of a level set to `points` (n, 3)."""
    box = _box(surface)
    if box is not None:
        if (box[0] > box[1]).any():
            return SearchResult(np.full_like(points, np.nan), np.full(len(points), np.inf))
        return _search_in_batches(
            surface, _Cube.around(*box), points, guess, descents, tolerance, progress
        )
    feet, lower = guess.feet.copy(), np.zeros(len(points))
    rows = np.arange(len(points))
    half = 0.0
    for _ in range(_MAX_BOX_GROWTHS):
        if not len(rows):
            break
        x = points[rows]
        root = _Cube.around(x.min(axis=0), x.max(axis=0))
        distances = np.linalg.norm(x - feet[rows], axis=1)
        half = max(4 * half, 1.0 + 4 * root.half, 1.1 * float(np.nanmax(distances, initial=0.0)))
        root = _Cube(root.center, root.half + half)
        start = replace(guess.select(rows), feet=feet[rows])
        result = _search_in_batches(surface, root, x, start, descents, tolerance, progress)
        # Beyond the cube there may be more of the surface.
        wall_distances = root.half - np.abs(x - root.center).max(axis=1)
        feet[rows], lower[rows] = result.closest, np.minimum(result.lower_bounds, wall_distances)
        distance = np.linalg.norm(x - result.closest, axis=1)
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
    guess: InitialGuess,
    descents: DescentMethods,
    tolerance: StoppingRule,
    progress: Callable[[str], None],
) -> SearchResult:
    """The nearest points in a cube, for a batch of the points at a time."""
    proofs = CellClassifier(surface)
    max_cells = _max_cells(surface, len(points), tolerance.prove)
    cells_per_point = _PROOF_CELLS_PER_POINT if tolerance.prove else _CELLS_PER_POINT
    min_cells = min(max(_MIN_CELLS, int(cells_per_point * len(points))), _MAX_CELLS, max_cells)
    if surface.field.has_jumps:
        min_cells = _MIN_JUMP_CELLS
    coarse, cells = _split(proofs, root, min_cells, progress)
    backend, trees = choose_backend("double"), None
    if len(cells):
        trees = CellTree.of(backend, coarse), CellTree.of(backend, cells)
    results: list[SearchResult] = []
    for start in range(0, max(len(points), 1), _BATCH_SIZE):
        rows = slice(start, start + _BATCH_SIZE)
        limit = max_cells if tolerance.prove else 0
        cell_search = _CellSearch(
            proofs,
            cells,
            trees,
            points[rows],
            guess.select(rows),
            descents,
            tolerance.length,
            limit,
        )
        results.append(cell_search.run(progress))
    return SearchResult(
        *(np.concatenate([getattr(r, k) for r in results]) for k in ("closest", "lower_bounds"))
    )


def _max_cells(surface: TracedSurface, count: int, is_proved: bool) -> int:
    """The largest number of cells."""
    if surface.field.has_jumps:
        return _MAX_JUMP_CELLS
    limit = min(max(_MAX_CELLS, count // 2), _MAX_PROOF_CELLS) if is_proved else _MAX_CELLS
    return int(limit * (_EXPENSIVE_FIELD_FACTOR if surface.field.has_variable_accuracy else 1.0))


def _split(
    proofs: CellClassifier, root: _Cube, min_cells: int, progress: Callable[[str], None]
) -> tuple[SurfaceCells, SurfaceCells]:
    """Cells of the root, split until there are at least `min_cells`: in each iteration the larger
    half. The size of a cell in which the surface is in one piece is a quarter of the thickness of
    its slab, by which the surface may bend. Returned first are the few coarse cells that contain
    these."""
    half = root.half / _ACROSS
    steps = (2 * np.indices((_ACROSS,) * 3).reshape(3, -1).T + 1 - _ACROSS) * half
    cells = proofs.nonempty_cells(root.center + steps, np.full(len(steps), half))
    coarse = cells
    for _ in range(_MAX_SUBDIVISIONS):
        if not 0 < len(cells) < min_cells:
            break
        if len(coarse) < _COARSE:
            coarse = cells
        sizes = np.where(cells.is_single_piece, 0.25 * cells.thickness, cells.half)
        is_split = sizes >= np.median(sizes)
        children = _subdivide(proofs, cells, is_split)
        cells = SurfaceCells.concatenate([cells.select(~is_split), children])
        progress(f"distances: {len(cells):,} cells")
    return proofs.with_surface_points(coarse), proofs.with_surface_points(cells)


def _subdivide(proofs: CellClassifier, cells: SurfaceCells, is_split: BoolArray) -> SurfaceCells:
    """The nonempty children of the cells of a mask (n,), each of which is cut in eight."""
    half = 0.5 * cells.half[is_split]
    center = cells.center[is_split, None] + half[:, None, None] * _CORNERS
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
        guess: InitialGuess,
        descents: DescentMethods,
        tolerance: float,
        max_cells: int,
    ) -> None:
        self.trees = trees
        self.proofs, self.cells, self.points, self.descents = proofs, cells, points, descents
        self.backend = choose_backend("double")
        self.guess, self.feet, self.free = guess, guess.feet.copy(), np.zeros(len(points))
        self.lower, self.tolerance = np.zeros(len(points)), tolerance
        self.max_cells = max_cells

    def run(self, progress: Callable[[str], None]) -> SearchResult:
        """The closest points and the lower bounds of the distances."""
        if not len(self.points):
            return SearchResult(self.feet, self.lower)
        has_jumps = self.proofs.surface.field.has_jumps
        if self.trees is not None:
            self._search_cells(*self.trees, has_jumps, progress)
        else:
            self.lower[:] = np.inf
        if not has_jumps:
            # Where two parts of the surface meet or cross within a cell, descents may not have
            # begun on both of them; and a promise that does not hold may have left out cells.
            ids = np.flatnonzero(self._is_unproved() | np.isnan(self.feet[:, 0]))
            ids = ids[self.guess.estimate[ids] < _MIN_GAIN * self._distance(ids)]
            self._descend(ids, self.points[ids])
        return SearchResult(self.feet, self.lower)

    def _search_cells(
        self, coarse: CellTree, tree: CellTree, has_jumps: bool, progress: Callable[[str], None]
    ) -> None:
        """Descend first from the surface point of the coarse cell where the surface seems nearest,
        then from those of other parts that may be nearer. If cells remain that may hold a nearer
        point, and there are not too many cells, those cells are split, and so on."""
        marks = dr.zeros(self.backend.Bool, len(self.cells)) if self.max_cells else None
        if has_jumps or self._is_expensive:
            tried, ids = self._descend_from_best_start(tree), np.arange(len(self.points))
            if not has_jumps:
                self._leave_boundary()
        else:
            ids, tried = self._first_round(coarse, tree, marks)
            ids = np.union1d(ids, self._leave_boundary())
        for _ in range(_MAX_SUBDIVISIONS):
            self._improve(tree, ids, [tried[ids]], marks)
            if marks is None:
                break
            ids = np.flatnonzero(self._is_unproved())
            is_split = to_numpy(marks)
            count = int(is_split.sum())
            if not count or not len(ids) or len(self.cells) + 4 * count > self.max_cells:
                break
            octants = self.proofs.with_surface_points(_subdivide(self.proofs, self.cells, is_split))
            self.cells = SurfaceCells.concatenate([self.cells.select(~is_split), octants])
            progress(f"distances: {len(self.cells):,} cells for {len(ids):,} points")
            tree, tried = CellTree.of(self.backend, self.cells), self.feet
            marks = dr.zeros(self.backend.Bool, len(self.cells))

    def _first_round(
        self, coarse: CellTree, tree: CellTree, marks: Any
    ) -> tuple[IntArray, FloatArray]:
        """`_descend_from_best_start`, and a first `_improve`: in one kernel, where Newton's method
        converges.

        Returns the indices of the queries that have more to try, and the surface points that were
        tried (n, 3).
        """
        backend = self.backend
        tolerance = dr.opaque(backend.Float, self.tolerance)

        def compute(x: Vec3, guess: Vec3) -> tuple[Real | Vec3, ...]:
            real, missing = backend.Float, backend.Array3f(FAR_SENTINEL)
            limit = safe_norm(guess - x)
            limit = dr.select(dr.isfinite(limit), limit, FAR_SENTINEL)
            start = coarse.best_start(x, limit)
            y, free, unresolved = self.descents.newton_in_kernel(x, start, limit)
            has_start, gap = start.x < 0.5 * FAR_SENTINEL, safe_norm(y - x)
            unresolved &= has_start
            is_nearer = has_start & ~unresolved & (gap < limit)
            point = dr.select(is_nearer, y, dr.select(limit < 0.5 * FAR_SENTINEL, guess, missing))
            distance = dr.select(is_nearer, gap, limit)
            best = BestCandidate(
                point, dr.select(unresolved, 0, distance), dr.select(is_nearer, free, 0),
                dr.select(is_nearer, 1, real(_APART_FROM_BOUNDARY)),
            )  # fmt: skip
            lower, feet = tree.closer_candidates(x, best, (start,), tolerance, marks)
            point = dr.select(distance < 0.5 * FAR_SENTINEL, point, dr.nan)
            return (
                point,
                best.exclusion_radius,
                lower,
                start,
                *feet,
                dr.select(unresolved, real(1), 0),
            )

        self.feet, self.free, lower, start, *feet, unresolved = in_batches(
            backend, compute, self.points, self.guess.feet
        )
        self.lower = self._rounded(lower, self.points)
        ids = np.flatnonzero(unresolved)
        self._descend(ids, start[ids])
        return np.union1d(ids, self._descend_from_candidates(np.arange(len(start)), feet)), start

    @staticmethod
    def _rounded(lower: FloatArray, points: FloatArray) -> FloatArray:
        """Lower bounds (n,), less a bound of their rounding errors."""
        return lower * (1 - 1e-12) - 1e-15 * np.abs(points).max(axis=1)

    @property
    def _is_expensive(self) -> bool:
        """Whether evaluations take longer than walks: then fine cells tell where to begin."""
        return self.proofs.surface.field.has_variable_accuracy

    def _is_unproved(self) -> BoolArray:
        """Whether it is not proved that no point is nearer than the best."""
        return self.lower < self._distance(slice(None)) - self.tolerance

    def _distance(self, rows: IntArray | slice) -> FloatArray:
        """Distances of the best points so far; FAR where there is none."""
        distances = np.linalg.norm(self.points[rows] - self.feet[rows], axis=1)
        return np.where(np.isnan(distances), FAR_SENTINEL, distances)

    def _is_boundary(self, rows: IntArray | slice) -> BoolArray:
        """Whether the best point is the initial guess, on the boundary."""
        return self.guess.on_boundary & (self.feet[rows] == self.guess.feet[rows]).all(axis=1)

    def _descend_from_best_start(self, tree: CellTree) -> FloatArray:
        """Descend from the surface points that seem nearest, which are returned (n, 3)."""
        limit = upload_floats(self.backend, self._distance(slice(None)))
        start = to_numpy(tree.best_start(upload_vectors(self.backend, self.points), limit))
        ids = np.flatnonzero(start[:, 0] < 0.5 * FAR_SENTINEL)
        self._descend(ids, start[ids])
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
            improved_ids = self._descend_from_candidates(rows, starts)
            active = np.isin(rows, improved_ids)
            if self._is_expensive or self.proofs.surface.field.has_jumps:
                active |= starts[0][:, 0] < 0.5 * FAR_SENTINEL
            rows, tried = rows[active], [feet[active] for feet in (*tried[-1:], *starts)]

    def _descend_from_candidates(self, rows: IntArray, starts: Sequence[FloatArray]) -> IntArray:
        """Descend from surface points (k, 3), FAR for none; returns the rows where that led
        nearer."""
        old_distance = self._distance(rows)
        start_index, selected = np.nonzero([start[:, 0] < 0.5 * FAR_SENTINEL for start in starts])
        self._descend(rows[selected], np.stack(starts)[start_index, selected])
        return rows[self._distance(rows) < old_distance]

    def _closer_candidates(
        self, tree: CellTree, rows: IntArray, skipped: Sequence[FloatArray], marks: Any
    ) -> list[FloatArray]:
        """`CellTree.closer_candidates` for some points; raises their lower bounds."""
        backend, feet = self.backend, self.feet[rows]
        best = BestCandidate(
            upload_vectors(backend, np.where(np.isnan(feet), FAR_SENTINEL, feet)),
            upload_floats(backend, self._distance(rows)), upload_floats(backend, self.free[rows]),
            upload_floats(backend, np.where(self._is_boundary(rows), _APART_FROM_BOUNDARY, 1.0)),
        )  # fmt: skip
        x = upload_vectors(backend, self.points[rows])
        tried_already = tuple(upload_vectors(backend, candidate) for candidate in skipped)
        tolerance = dr.opaque(backend.Float, self.tolerance)
        lower, candidates = tree.closer_candidates(x, best, tried_already, tolerance, marks)
        dr.eval(lower, *candidates)
        proved = self._rounded(to_numpy(lower), self.points[rows])
        self.lower[rows] = np.maximum(proved, self.lower[rows])
        return [to_numpy(candidate) for candidate in candidates]

    def _leave_boundary(self) -> IntArray:
        """Descend from the boundary of the surface, where the best point is on it; returns the
        queries where that led nearer."""
        ids = np.flatnonzero(self._is_boundary(slice(None)))
        distance = self._distance(ids)
        ids, distance = ids[distance > 0], distance[distance > 0]
        offset = np.minimum(0.25 * distance, _BOUNDARY_OFFSET * self.tolerance)
        x = self.points[ids]
        self._update_best(ids, *self.descents.descend_from_boundary(x, self.feet[ids], offset))
        return ids[self._distance(ids) < distance]

    def _descend(self, ids: IntArray, start: FloatArray) -> None:
        """Descend from points (k, 3): points of the surface, or the query points themselves."""
        if not len(ids):
            return
        x = self.points[ids]
        on_surface = (start != x).any(axis=1, keepdims=True)
        self._update_best(ids, np.where(on_surface, start, np.nan), np.zeros(len(ids)))
        self._update_best(ids, *self.descents.descend(x, start, self._distance(ids)))

    def _update_best(self, rows: IntArray, feet: FloatArray, free: FloatArray) -> None:
        """Replace the best points by points of the surface (k, 3) or NaN, and their radii, where
        these are nearer; rows may occur several times."""
        distances = np.linalg.norm(self.points[rows] - feet, axis=1)
        improved = np.flatnonzero(distances < self._distance(rows))
        improved = improved[np.argsort(-distances[improved])]  # the last one stays
        self.feet[rows[improved]], self.free[rows[improved]] = feet[improved], free[improved]
