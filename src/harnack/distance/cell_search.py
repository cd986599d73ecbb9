"""Searches the points of a surface that are nearest to given query points, by branch and bound.
Space is divided into cubes, the cells. Cells that are proved to hold no nearer point are skipped,
and others subdivided. In many cells a point of the surface is known, from which a descent (Newton's
method along the surface) leads to a closest point.
"""

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

# The number of cells before queries are searched in them: per query, without and with proofs; the
# minimum; and the minimum for fields with jump surfaces, whose facets are searched as well.
_CELLS_PER_POINT, _CELLS_PER_PROOF, _MIN_CELLS, _MIN_JUMP_CELLS = 0.16, 0.25, 10_000, 1500
# The largest number of cells: without proofs, with proofs, and for fields with jump surfaces. If an
# evaluation is a sum of many terms, only this fraction of it.
_MAX_CELLS, _MAX_PROOF_CELLS, _MAX_JUMP_CELLS, _EXPENSIVE_FIELD_FACTOR = (
    60_000,
    150_000,
    20_000,
    0.25,
)
_MAX_SUBDIVISIONS = 40
# The smallest number of cells in which the search for a point begins.
_MIN_COARSE_CELLS = 300
# Number of cells along an edge of the first cube.
_ROOT_CELLS = 8
# Largest number of rounds of descents from surface points of further cells, before cells are split.
_MAX_CANDIDATE_ROUNDS = 4
# In tolerances: the distance from the boundary curve at which the surface is looked for.
_BOUNDARY_OFFSET = 100.0
# If the best point is on the boundary of the surface, the surface beside it was searched already:
# another surface point is tried only at this many times the usual distance from the best point.
_BOUNDARY_SEPARATION = 2.0
# A descent begins at the query itself if its first-order distance is below this fraction of the
# best distance.
_MIN_GAIN = 0.9
# Number of queries that are searched together, which bounds the memory.
_BATCH_SIZE = 1 << 18
_MAX_BOX_GROWTHS = 6
_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)


@dataclass
class SearchResult:
    """The result of a search for the points of a surface closest to n queries.

    closest: (n, 3) the closest points, NaN where none was found.
    lower_bounds: (n,) proved lower bounds of the distances of the queries from the surface.
    """

    closest: FloatArray
    lower_bounds: FloatArray


class DescentMethods(Protocol):
    """Interface of the iterations (descents) that lead from a point near a surface to the surface
    point closest to a query x. Each method returns points of the surface (n, 3), NaN where it finds
    none; and for each of these the radius of a ball about it that is proved to hold no surface
    point nearer to x."""

    def newton_in_kernel(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """Iterate as part of another kernel, from points `start` near the surface, for the queries
        x. Closest points farther from x than the length `limit` need not be found.

        Returns the closest points, the radii of the balls about them, and the mask of lanes for
        which `descend` has to be called afterwards, because the iteration did not converge.
        """
        ...

    def descend(
        self, points: FloatArray, start: FloatArray, limit: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Iterate from points `start` (n, 3) near the surface, for the queries `points` (n, 3).
        Closest points farther from the query than the lengths `limit` (n,) need not be found.

        Returns the closest points (n, 3), and the radii (n,) of the balls about them.
        """
        ...

    def descend_from_boundary(
        self, points: FloatArray, boundary: FloatArray, aside: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Iterate along the surface from points `boundary` (n, 3) of the curve at which it ends,
        for the queries `points` (n, 3).

        aside: (n,) the distance from the curve, in the direction of the query, at which the surface
            is searched; the iteration starts there.

        Returns the closest points (n, 3), and the radii (n,) of the balls about them.
        """
        ...


@dataclass(frozen=True)
class InitialGuess:
    """What is known about the closest points of n queries before cells are searched.

    closest: (n, 3) for each query a point of the surface, or NaN.
    estimate: (n,) first-order estimates of the distances from the surface.
    on_boundary: whether all points `closest` lie on the curve at which the surface ends; otherwise
        none is known to.
    """

    closest: FloatArray
    estimate: FloatArray
    on_boundary: bool = True

    def some(self, rows: IntArray | slice) -> InitialGuess:
        """Return the initial guess for the queries with the indices `rows`."""
        return replace(self, closest=self.closest[rows], estimate=self.estimate[rows])


@dataclass(frozen=True)
class StoppingRule:
    """The condition under which a search for closest points ends.

    length: an improvement of the distance by less than this length is not pursued.
    prove: whether cells are subdivided until no cell may hold a point that is nearer than the best
        one found by more than `length`, or until there are too many cells.
    """

    length: float
    prove: bool


@dataclass(frozen=True)
class _Cube:
    """A cube that contains the surface, or the part of it that is searched.

    center: (3,) its center.
    half: half the length of its edges.
    """

    center: FloatArray
    half: float

    @classmethod
    def around(cls, lower: FloatArray, upper: FloatArray) -> _Cube:
        """Return the smallest cube around the box with corners `lower` and `upper`, slightly
        enlarged."""
        half = 0.5 * float((upper - lower).max()) * (1 + 1e-6)
        half += 1e-12 * float(np.abs([lower, upper]).max())
        return cls(0.5 * (lower + upper), max(half, 1e-30))


def search(
    surface: TracedSurface, points: FloatArray, known: InitialGuess, descents: DescentMethods,
    tolerance: StoppingRule, progress: Callable[[str], None],
) -> SearchResult:  # fmt: skip
    """Search the points of a surface that are nearest to `points` (n, 3), by branch and bound.

    known: what is already known about the closest points.
    descents: the iterations that lead from a point near the surface to a closest point.
    tolerance: when the search ends.
    progress: called with a message before each stage.

    If no box is known to contain the surface, a cube around the queries is searched. Queries whose
    closest point may lie outside of it are searched again in a larger cube, several times.
    """
    box = _bounding_box(surface)
    if box is not None:
        # An empty box: there is no surface.
        if (box[0] > box[1]).any():
            return SearchResult(np.full_like(points, np.nan), np.full(len(points), np.inf))
        return _search_in_batches(
            surface, _Cube.around(*box), points, known, descents, tolerance, progress
        )
    closest, lower = known.closest.copy(), np.zeros(len(points))
    rows = np.arange(len(points))
    margin = 0.0
    for _ in range(_MAX_BOX_GROWTHS):
        if not len(rows):
            break
        x = points[rows]
        root = _Cube.around(x.min(axis=0), x.max(axis=0))
        distances = np.linalg.norm(x - closest[rows], axis=1)
        # The margin of the cube around the queries. It grows by a factor of four or more.
        margin = max(
            4 * margin, 1.0 + 4 * root.half, 1.1 * float(np.nanmax(distances, initial=0.0))
        )
        root = _Cube(root.center, root.half + margin)
        start = replace(known.some(rows), closest=closest[rows])
        result = _search_in_batches(surface, root, x, start, descents, tolerance, progress)
        # The surface may continue outside the cube: lower bounds end at its faces.
        face_distance = root.half - np.abs(x - root.center).max(axis=1)
        closest[rows], lower[rows] = result.closest, np.minimum(result.lower_bounds, face_distance)
        distance = np.linalg.norm(x - result.closest, axis=1)
        rows = rows[~(distance <= margin)]
    return SearchResult(closest, lower)


def _bounding_box(surface: TracedSurface) -> tuple[FloatArray, FloatArray] | None:
    """Return the corners (lower, upper) of a box that contains the surface; None if no finite one
    is known."""
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
    """Search the points of the surface in the cube `root` that are closest to `points` (n, 3), for
    one batch of the queries after the other.

    guess: what is already known about the closest points of all queries.
    descents: the iterations that lead from a point near the surface to a closest point.
    tolerance: when the search ends.
    progress: called with a message before each stage.

    All batches share the same cells. A first search uses few coarse cells, later ones all cells.
    """
    classifier = CellClassifier(surface)
    max_cells = _max_cells(surface, len(points), tolerance.prove)
    cells_per_point = _CELLS_PER_PROOF if tolerance.prove else _CELLS_PER_POINT
    min_cells = min(max(_MIN_CELLS, int(cells_per_point * len(points))), _MAX_CELLS, max_cells)
    if surface.field.traits.has_jumps:
        min_cells = _MIN_JUMP_CELLS
    # The cells depend on the surface and the number of queries alone, so all batches share them.
    coarse, cells = _split(classifier, root, min_cells, progress)
    backend, trees = choose_backend("double"), None
    if len(cells):
        trees = CellTree.of(backend, coarse), CellTree.of(backend, cells)
    results: list[SearchResult] = []
    for start in range(0, max(len(points), 1), _BATCH_SIZE):
        rows = slice(start, start + _BATCH_SIZE)
        # Without proofs cells are not subdivided further.
        limit = max_cells if tolerance.prove else 0
        cell_search = _CellSearch(
            classifier,
            cells,
            trees,
            points[rows],
            guess.some(rows),
            descents,
            tolerance.length,
            limit,
        )
        results.append(cell_search.run(progress))
    return SearchResult(
        *(np.concatenate([getattr(r, k) for r in results]) for k in ("closest", "lower_bounds"))
    )


def _max_cells(surface: TracedSurface, count: int, is_proved: bool) -> int:
    """Return the largest number of cells into which space is divided for a search of `count`
    queries. is_proved: whether lower bounds are to be made as large as possible."""
    if surface.field.traits.has_jumps:
        return _MAX_JUMP_CELLS
    limit = min(max(_MAX_CELLS, count // 2), _MAX_PROOF_CELLS) if is_proved else _MAX_CELLS
    return int(
        limit * (_EXPENSIVE_FIELD_FACTOR if surface.field.traits.has_variable_accuracy else 1.0)
    )


def _split(
    classifier: CellClassifier, root: _Cube, min_cells: int, progress: Callable[[str], None]
) -> tuple[SurfaceCells, SurfaceCells]:
    """Divide the cube `root` into cells that may hold the surface.

    classifier: proves cells empty, and finds slabs that contain the surface.
    min_cells: the number of cells at which the division ends.
    progress: called with a message before each stage.

    Each iteration splits the larger half of the cells into eight, until there are at least
    `min_cells`. If the surface in a cell is in one piece and lies in a slab (between two parallel
    planes), then the cell counts as smaller than it is: its size is taken to be a quarter of the
    slab's thickness.

    Returns the coarse cells of an early iteration, which are few, and the cells of the last one.
    """
    # The first cells are 8 x 8 x 8 equal cubes; `offsets` are their centers relative to the root's.
    half = root.half / _ROOT_CELLS
    offsets = (2 * np.indices((_ROOT_CELLS,) * 3).reshape(3, -1).T + 1 - _ROOT_CELLS) * half
    cells = classifier.nonempty_cells(root.center + offsets, np.full(len(offsets), half))
    coarse = cells
    for _ in range(_MAX_SUBDIVISIONS):
        if not 0 < len(cells) < min_cells:
            break
        if len(coarse) < _MIN_COARSE_CELLS:
            coarse = cells
        # The larger half is split; a flat single piece of surface counts as small.
        sizes = np.where(cells.is_single_piece, 0.25 * cells.thickness, cells.half)
        is_split = sizes >= np.median(sizes)
        children = _subdivide(classifier, cells, is_split)
        cells = SurfaceCells.concatenate([cells.select(~is_split), children])
        progress(f"distances: {len(cells):,} cells")
    return classifier.with_surface_points(coarse), classifier.with_surface_points(cells)


def _subdivide(
    classifier: CellClassifier, cells: SurfaceCells, is_split: BoolArray
) -> SurfaceCells:
    """Return the children of the cells selected by the mask `is_split` (n,), without the children
    that `classifier` proves empty. Each cell has eight children of half its size."""
    half = 0.5 * cells.half[is_split]
    center = cells.center[is_split, None] + half[:, None, None] * _CORNERS
    return classifier.nonempty_cells(center.reshape(-1, 3), np.repeat(half, 8))


class _CellSearch:
    """Branch-and-bound search for the surface points closest to a batch of queries, over cells that
    cover the surface. Coarse cells are searched first. A surface point in a cell is a candidate: a
    descent (Newton's method along the surface) from it may lead to a nearer point than the best one
    so far.

    classifier: proves that cells are empty, and finds surface points in cells that may not be.
    cells: all cells, the finest so far. Subdivision replaces them.
    trees: the tree of the coarse cells and the tree of `cells`; None if there are no cells.
    guess: what was known about the closest point of each query before the search.
    closest: (n, 3) the best point of each query so far, a point of the surface, or NaN.
    free: (n,) the radius of a ball about the best point in which no surface point is nearer to the
        query.
    lower: (n,) proved lower bounds of the distances of the queries from the surface.
    tolerance: an improvement of the distance by less than this is not pursued.
    max_cells: cells are subdivided while there are no more than these; 0 for no subdivision.
    """

    def __init__(
        self,
        classifier: CellClassifier,
        cells: SurfaceCells,
        trees: tuple[CellTree, CellTree] | None,
        points: FloatArray,
        guess: InitialGuess,
        descents: DescentMethods,
        tolerance: float,
        max_cells: int,
    ) -> None:
        """Store the search's inputs.

        points: (n, 3) the queries.
        descents: the iterations that lead from a point near the surface to a closest point.
        classifier, cells, trees, guess, tolerance, max_cells: as in the class docstring.
        """
        self.trees = trees
        self.classifier, self.cells, self.points, self.descents = (
            classifier,
            cells,
            points,
            descents,
        )
        self.backend = choose_backend("double")
        self.guess, self.closest, self.free = guess, guess.closest.copy(), np.zeros(len(points))
        self.lower, self.tolerance = np.zeros(len(points)), tolerance
        self.max_cells = max_cells

    def run(self, progress: Callable[[str], None]) -> SearchResult:
        """Search, and return the closest points and the lower bounds of the distances. progress:
        called with a message before each stage."""
        if not len(self.points):
            return SearchResult(self.closest, self.lower)
        has_jumps = self.classifier.surface.field.traits.has_jumps
        if self.trees is not None:
            self._search_cells(*self.trees, has_jumps, progress)
        else:
            # All cells were proved empty: there is no surface.
            self.lower[:] = np.inf
        if not has_jumps:
            # One more descent begins at the query itself. Two parts of the surface may meet or
            # cross within a cell, and descents may not have begun on both of them. Also, cells may
            # be missing if a promise (a proved bound of f near a point) does not hold.
            ids = np.flatnonzero(self._is_unproved() | np.isnan(self.closest[:, 0]))
            ids = ids[self.guess.estimate[ids] < _MIN_GAIN * self._distance(ids)]
            self._descend(ids, self.points[ids])
        return SearchResult(self.closest, self.lower)

    def _search_cells(
        self, coarse: CellTree, tree: CellTree, has_jumps: bool, progress: Callable[[str], None]
    ) -> None:
        """Search the cells of both trees, and subdivide cells if proofs are wanted.

        coarse, tree: the tree of the coarse cells, and the tree of all cells.
        has_jumps: whether the surface's function f jumps at facets, such as triangles.
        progress: called with a message before each stage.

        For each query the first descent begins at the surface point of the coarse cell with the
        smallest estimated distance. The next ones begin at surface points of a few cells that may
        hold a point nearer than its result. Then all cells that may hold a point nearer than the
        best one are split and searched again, until no such cells remain or there are too many.
        """
        # A mark for each cell that may hold a nearer point, if cells are to be split.
        marks = dr.zeros(self.backend.Bool, len(self.cells)) if self.max_cells else None
        # Functions that jump have no descents in a kernel; expensive ones start in a fine cell.
        if has_jumps or self._is_expensive:
            tried_starts, ids = self._descend_from_best_start(tree), np.arange(len(self.points))
            if not has_jumps:
                self._leave_boundary()
        else:
            ids, tried_starts = self._search_in_kernel(coarse, tree, marks)
            ids = np.union1d(ids, self._leave_boundary())
        for _ in range(_MAX_SUBDIVISIONS):
            self._improve(tree, ids, [tried_starts[ids]], marks)
            if marks is None:
                break
            ids = np.flatnonzero(self._is_unproved())
            # Split the marked cells, unless no query needs it or there would be too many cells.
            # (About five of a cell's eight children are expected to remain, four more than before.)
            is_split = to_numpy(marks)
            count = int(is_split.sum())
            if not count or not len(ids) or len(self.cells) + 4 * count > self.max_cells:
                break
            children = self.classifier.with_surface_points(
                _subdivide(self.classifier, self.cells, is_split)
            )
            self.cells = SurfaceCells.concatenate([self.cells.select(~is_split), children])
            progress(f"distances: {len(self.cells):,} cells for {len(ids):,} points")
            tree, tried_starts = CellTree.of(self.backend, self.cells), self.closest
            marks = dr.zeros(self.backend.Bool, len(self.cells))

    def _search_in_kernel(
        self, coarse: CellTree, tree: CellTree, marks: Any
    ) -> tuple[IntArray, FloatArray]:
        """Make the first searches for all queries. In a single kernel, a descent starts from the
        surface point of the coarse cell with the smallest estimated distance, and a few cells that
        may hold a point nearer than its result are found. Then descents start from the surface
        points of these cells. Queries for which Newton's method does not converge in the kernel are
        finished by `_descend`.

        coarse, tree: the tree of the coarse cells, and the tree of all cells.
        marks: a Bool array with an entry for each cell, or None. The entries of cells that may hold
            a nearer point for some query are set to True here.

        Returns the indices (k,) of the queries for which another round of descents is worthwhile;
        and the surface points (n, 3) at which the first descents started.
        """
        backend = self.backend
        tolerance = dr.opaque(backend.Float, self.tolerance)

        def compute(x: Vec3, guess_point: Vec3) -> tuple[Real | Vec3, ...]:
            """Descend for a query x. Returns a tuple: the best point, NaN for none; the radius of a
            ball about it in which no surface point is nearer to x; a lower bound of the distance;
            the surface point where the descent began; several candidates, surface points for the
            next descents; and 1 where Newton's method did not converge, else 0.

            guess_point: the best point before, NaN for none.

            `coarse`, `tree` and `marks` are the parameters of the enclosing function.
            """
            real, missing = backend.Float, backend.Array3f(FAR_SENTINEL)
            limit = safe_norm(guess_point - x)
            # Without a guess the limit is a huge number. `best_start` returns such coordinates for
            # a missing start, which comparisons with half of it recognize.
            limit = dr.select(dr.isfinite(limit), limit, FAR_SENTINEL)
            start = coarse.best_start(x, limit)
            y, free, unresolved = self.descents.newton_in_kernel(x, start, limit)
            has_start, end_distance = start.x < 0.5 * FAR_SENTINEL, safe_norm(y - x)
            # Lanes without a start have nothing to resolve.
            unresolved &= has_start
            is_nearer = has_start & ~unresolved & (end_distance < limit)
            # The nearer of the end of the descent and the initial guess, or none.
            point = dr.select(
                is_nearer, y, dr.select(limit < 0.5 * FAR_SENTINEL, guess_point, missing)
            )
            distance = dr.select(is_nearer, end_distance, limit)
            # A best distance of 0 on unresolved lanes means that no cell counts as nearer there.
            best = BestCandidate(
                point, dr.select(unresolved, 0, distance), dr.select(is_nearer, free, 0),
                dr.select(is_nearer, 1, real(_BOUNDARY_SEPARATION)),
            )  # fmt: skip
            lower, candidates = tree.closer_candidates(x, best, (start,), tolerance, marks)
            point = dr.select(distance < 0.5 * FAR_SENTINEL, point, dr.nan)
            return (
                point,
                best.exclusion_radius,
                lower,
                start,
                *candidates,
                dr.select(unresolved, real(1), 0),
            )

        self.closest, self.free, lower, start, *candidates, unresolved = in_batches(
            backend, compute, self.points, self.guess.closest
        )
        self.lower = self._rounded(lower, self.points)
        ids = np.flatnonzero(unresolved)
        self._descend(ids, start[ids])
        return np.union1d(
            ids, self._descend_from_candidates(np.arange(len(start)), candidates)
        ), start

    @staticmethod
    def _rounded(lower: FloatArray, points: FloatArray) -> FloatArray:
        """Return lower bounds (n,) of the distances of `points` (n, 3) that hold in spite of
        rounding: `lower` (n,) less a bound of its rounding error."""
        return lower * (1 - 1e-12) - 1e-15 * np.abs(points).max(axis=1)

    @property
    def _is_expensive(self) -> bool:
        """Whether an evaluation of the field takes longer than a walk through a tree of cells. Then
        even the first descent starts in a fine cell, near the closest point, to save evaluations.
        """
        return self.classifier.surface.field.traits.has_variable_accuracy

    def _is_unproved(self) -> BoolArray:
        """Return the mask (n,) of queries for which a point may exist that is nearer than the best
        one by more than the tolerance."""
        return self.lower < self._distance(slice(None)) - self.tolerance

    def _distance(self, rows: IntArray | slice) -> FloatArray:
        """Return the distances (k,) of the queries with the indices `rows` from their best points
        so far; `FAR_SENTINEL` where there is none."""
        distances = np.linalg.norm(self.points[rows] - self.closest[rows], axis=1)
        return np.where(np.isnan(distances), FAR_SENTINEL, distances)

    def _is_boundary(self, rows: IntArray | slice) -> BoolArray:
        """Return a mask (k,), True for queries of `rows` whose best point is still the initial
        guess and lies on the curve at which the surface ends."""
        return self.guess.on_boundary & (self.closest[rows] == self.guess.closest[rows]).all(axis=1)

    def _descend_from_best_start(self, tree: CellTree) -> FloatArray:
        """Descend for each query from the surface point of the cell of the tree with the smallest
        estimated distance. Returns these surface points (n, 3), `FAR_SENTINEL` for none."""
        # `slice(None)`: of all queries.
        limit = upload_floats(self.backend, self._distance(slice(None)))
        start = to_numpy(tree.best_start(upload_vectors(self.backend, self.points), limit))
        # Missing starts have coordinates of about `FAR_SENTINEL`.
        rows = np.flatnonzero(start[:, 0] < 0.5 * FAR_SENTINEL)
        self._descend(rows, start[rows])
        return start

    def _improve(
        self, tree: CellTree, rows: IntArray, tried: Sequence[FloatArray], marks: Any
    ) -> None:
        """Improve the best points of the queries `rows` (k,) by descents, in rounds. The descents
        start at surface points of cells in which none of the query's descents has started yet.

        A query continues to the next round if the last one improved its best point. Without an
        improvement it continues in two cases, as long as there are cells to start in. In the first
        case f has jump surfaces: then distances are only roughly estimated, so that one failure
        says little. In the second case f is expensive to evaluate: then each round tries one start
        instead of several.

        tree: the tree of the cells.
        tried: arrays (k, 3) of surface points at which descents have started already.
        marks: a Bool array with an entry for each cell, or None. The entries of cells that may hold
            a nearer point for some query are set to True here.
        """
        for _ in range(_MAX_CANDIDATE_ROUNDS):
            if not len(rows):
                break
            starts = self._closer_candidates(tree, rows, tried, marks)
            if self._is_expensive:
                starts = starts[:1]
            improved_ids = self._descend_from_candidates(rows, starts)
            # Queries without a further chance are left out of the next round.
            active = np.isin(rows, improved_ids)
            if self._is_expensive or self.classifier.surface.field.traits.has_jumps:
                # Those that had a start. (A missing one is at `FAR_SENTINEL`.)
                active |= starts[0][:, 0] < 0.5 * FAR_SENTINEL
            # Only the last of the points tried before is kept, with those of this round.
            rows, tried = (
                rows[active],
                [candidates[active] for candidates in (*tried[-1:], *starts)],
            )

    def _descend_from_candidates(self, rows: IntArray, starts: Sequence[FloatArray]) -> IntArray:
        """Descend for each of the queries `rows` (k,) from its surface point in each of the arrays
        `starts`, (k, 3), with `FAR_SENTINEL` for none. Returns the queries of `rows` whose distance
        became smaller."""
        old_distance = self._distance(rows)
        # All pairs of an array and a query with a start. (A missing one is at `FAR_SENTINEL`.)
        start_index, selected = np.nonzero([start[:, 0] < 0.5 * FAR_SENTINEL for start in starts])
        self._descend(rows[selected], np.stack(starts)[start_index, selected])
        return rows[self._distance(rows) < old_distance]

    def _closer_candidates(
        self, tree: CellTree, rows: IntArray, skipped: Sequence[FloatArray], marks: Any
    ) -> list[FloatArray]:
        """Find for the queries `rows` (k,) the surface points of cells that may hold a nearer point
        than the best one (`CellTree.closer_candidates`). Also raise the lower bounds of these
        queries.

        tree: the tree of the cells.
        skipped: arrays (k, 3) of surface points near which no candidates are wanted.
        marks: a Bool array with an entry for each cell, or None. The entries of cells that may hold
            a nearer point for some query are set to True here.

        Returns the surface points as a list of arrays (k, 3), with `FAR_SENTINEL` for none.
        """
        backend, closest = self.backend, self.closest[rows]
        best = BestCandidate(
            upload_vectors(backend, np.where(np.isnan(closest), FAR_SENTINEL, closest)),
            upload_floats(backend, self._distance(rows)), upload_floats(backend, self.free[rows]),
            upload_floats(backend, np.where(self._is_boundary(rows), _BOUNDARY_SEPARATION, 1.0)),
        )  # fmt: skip
        x = upload_vectors(backend, self.points[rows])
        skipped_points = tuple(upload_vectors(backend, candidate) for candidate in skipped)
        tolerance = dr.opaque(backend.Float, self.tolerance)
        lower, candidates = tree.closer_candidates(x, best, skipped_points, tolerance, marks)
        dr.eval(lower, *candidates)
        proved = self._rounded(to_numpy(lower), self.points[rows])
        self.lower[rows] = np.maximum(proved, self.lower[rows])
        return [to_numpy(candidate) for candidate in candidates]

    def _leave_boundary(self) -> IntArray:
        """Descend along the surface for each query whose best point lies on the curve at which the
        surface ends. Returns the indices of the queries whose distance became smaller."""
        # `slice(None)`: among all queries.
        ids = np.flatnonzero(self._is_boundary(slice(None)))
        distance = self._distance(ids)
        ids, distance = ids[distance > 0], distance[distance > 0]
        # How far beside the curve the descent starts.
        aside = np.minimum(0.25 * distance, _BOUNDARY_OFFSET * self.tolerance)
        queries = self.points[ids]
        self._update_best(
            ids, *self.descents.descend_from_boundary(queries, self.closest[ids], aside)
        )
        return ids[self._distance(ids) < distance]

    def _descend(self, ids: IntArray, start: FloatArray) -> None:
        """Descend for the queries `ids` (k,) from `start` (k, 3): surface points, or the queries
        themselves. Surface points in `start` become best points at once if they are nearer."""
        if not len(ids):
            return
        x = self.points[ids]
        on_surface = (start != x).any(axis=1, keepdims=True)
        self._update_best(ids, np.where(on_surface, start, np.nan), np.zeros(len(ids)))
        self._update_best(ids, *self.descents.descend(x, start, self._distance(ids)))

    def _update_best(self, rows: IntArray, candidates: FloatArray, free: FloatArray) -> None:
        """Replace the best points of the queries `rows` (k,) by their candidates, where these are
        nearer. A query may occur several times in `rows`.

        candidates: (k, 3) points of the surface, or NaN.
        free: (k,) radius about each candidate within which no surface point is nearer to the query.
        """
        distances = np.linalg.norm(self.points[rows] - candidates, axis=1)
        improved = np.flatnonzero(distances < self._distance(rows))
        # In order of falling distance: of several candidates of a query the last one stays.
        improved = improved[np.argsort(-distances[improved])]
        self.closest[rows[improved]], self.free[rows[improved]] = (
            candidates[improved],
            free[improved],
        )
