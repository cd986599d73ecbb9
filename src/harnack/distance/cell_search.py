"""Nearest points of a level set by branch and bound over cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend, to_numpy
from harnack.backend.arrays import aligned, upload_vectors
from harnack.backend.elementary import length
from harnack.distance.cell_classification import CellProofs
from harnack.distance.cell_tree import FAR, Best, CellTree, SurfaceCells
from harnack.distance.tangent_plane import in_batches

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer import LevelSet

__all__ = ["Descents", "Found", "Known", "Tolerance", "search"]

# The number of cells before points are looked up in them: for each point, at least, and for fields
# with sheets, which are searched in turn as well.
_EACH, _EACH_TO_PROVE, _FEWEST, _FEWEST_ON_SHEETS = 0.16, 0.25, 10_000, 1500
# Cells at most, and which share of that where evaluations are as expensive as sums of many terms.
_MOST, _MOST_TO_PROVE, _MOST_ON_SHEETS, _EXPENSIVE = 60_000, 150_000, 20_000, 0.25
_FINEST = 40
# Cells, at least, in which the search for a point begins.
_COARSE = 300
# Cells along an edge of the cube to begin with.
_ACROSS = 8
# Times that feet of other parts of the surface are tried, from the same cells.
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

    def directly(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask]:
        """From places near the surface, in a kernel: feet, radii, and where `polish` is to be
        asked."""
        ...

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
    on_boundary: whether the feet lie on the curve that the surface ends in.
    """

    feet: FloatArray
    near: FloatArray
    on_boundary: bool = True

    def some(self, rows: IntArray | slice) -> Known:
        """Of some points."""
        return replace(self, feet=self.feet[rows], near=self.near[rows])


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
        so_far = replace(known.some(rows), feet=feet[rows])
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
    each = _EACH_TO_PROVE if tolerance.is_proved else _EACH
    enough = min(max(_FEWEST, int(each * len(points))), _MOST, most)
    if surface.field.has_sheets:
        enough = _FEWEST_ON_SHEETS
    coarse, cells = _split(proofs, root, enough, progress)
    backend, trees = choose_backend("double"), None
    if len(cells):
        trees = CellTree.of(backend, coarse), CellTree.of(backend, cells)
    parts: list[Found] = []
    for first in range(0, max(len(points), 1), _AT_ONCE):
        rows = slice(first, first + _AT_ONCE)
        at_most = most if tolerance.is_proved else 0
        job = _Search(
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

    trees: of the coarse cells and of `cells`; None if there are none.
    feet: (n, 3) the nearest points so far, or NaN. free: (n,) within these radii about them none is
    nearer. lower: (n,) proved bounds of distances. most: cells are split while they are not more.
    """

    def __init__(
        self, proofs: CellProofs, cells: SurfaceCells, trees: tuple[CellTree, CellTree] | None,
        points: FloatArray, known: Known, descents: Descents, tolerance: float, most: int,
    ) -> None:  # fmt: skip
        self.trees = trees
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
        if self.trees is not None:
            self._search_cells(*self.trees, has_sheets, progress)
        else:
            self.lower[:] = np.inf
        if not has_sheets:
            # Where sheets meet or cross within a cell, one may have no foot there; and a promise
            # that does not hold may have left out cells.
            rows = np.flatnonzero(self._is_open() | np.isnan(self.feet[:, 0]))
            rows = rows[self.known.near[rows] < _NEARER * self._distance(rows)]
            self._descend(rows, self.points[rows])
        return Found(self.feet, self.lower)

    def _search_cells(
        self, coarse: CellTree, tree: CellTree, has_sheets: bool, progress: Callable[[str], None]
    ) -> None:
        """Descend first from the foot of the coarse cell where the surface seems nearest, then from
        those of other parts that may be nearer. If some may still be, and there are not too many
        cells, those cells are split, and so on."""
        marks = dr.zeros(self.backend.Bool, len(self.cells)) if self.most else None
        if has_sheets or self._is_expensive:
            tried, rows = self._first(tree), np.arange(len(self.points))
            if not has_sheets:
                self._leave_boundary()
        else:
            rows, tried = self._begin(coarse, tree, marks)
            rows = np.union1d(rows, self._leave_boundary())
        for _ in range(_FINEST):
            self._challenge(tree, rows, [tried[rows]], marks)
            if marks is None:
                break
            rows = np.flatnonzero(self._is_open())
            split = to_numpy(marks)
            count = int(split.sum())
            if not count or not len(rows) or len(self.cells) + 4 * count > self.most:
                break
            parts = self.proofs.with_feet(_parts(self.proofs, self.cells, split))
            self.cells = SurfaceCells.joined([self.cells.some(~split), parts])
            progress(f"distances: {len(self.cells):,} cells for {len(rows):,} points")
            tree, tried = CellTree.of(self.backend, self.cells), self.feet
            marks = dr.zeros(self.backend.Bool, len(self.cells))

    def _begin(self, coarse: CellTree, tree: CellTree, marks: Any) -> tuple[IntArray, FloatArray]:
        """`_first`, and a first `_challenge`: in one kernel, where Newton's method ends.

        Returns the rows at which there is more to try, and the feet that were tried (n, 3).
        """
        backend = self.backend
        tolerance = dr.opaque(backend.Float, self.tolerance)

        def compute(x: Vec3, known: Vec3) -> tuple[Real | Vec3, ...]:
            real, none = backend.Float, backend.Array3f(FAR)
            limit = length(known - x)
            limit = dr.select(dr.isfinite(limit), limit, FAR)
            start = coarse.nearest(x, limit)
            y, free, unknown = self.descents.directly(x, start, limit)
            begins, away = start.x < 0.5 * FAR, length(y - x)
            unknown &= begins
            is_nearer = begins & ~unknown & (away < limit)
            foot = dr.select(is_nearer, y, dr.select(limit < 0.5 * FAR, known, none))
            distance = dr.select(is_nearer, away, limit)
            best = Best(
                foot, dr.select(unknown, 0, distance), dr.select(is_nearer, free, 0),
                dr.select(is_nearer, 1, real(_APART_FROM_BOUNDARY)),
            )  # fmt: skip
            lower, others = tree.nearer(x, best, (start,), tolerance, marks)
            foot = dr.select(distance < 0.5 * FAR, foot, dr.nan)
            return foot, best.free, lower, start, *others, dr.select(unknown, real(1), 0)

        self.feet, self.free, lower, start, *others, unknown = in_batches(
            backend, compute, self.points, self.known.feet
        )
        self.lower = self._rounded(lower, self.points)
        rows = np.flatnonzero(unknown)
        self._descend(rows, start[rows])
        return np.union1d(rows, self._try(np.arange(len(start)), others)), start

    @staticmethod
    def _rounded(lower: FloatArray, points: FloatArray) -> FloatArray:
        """Lower bounds (n,), less what rounding may have done to them."""
        return lower * (1 - 1e-12) - 1e-15 * np.abs(points).max(axis=1)

    @property
    def _is_expensive(self) -> bool:
        """Whether evaluations take longer than walks: then fine cells tell where to begin."""
        return self.proofs.surface.field.has_detail

    def _is_open(self) -> BoolArray:
        """Whether it is not proved that no point is nearer than the best."""
        return self.lower < self._distance(slice(None)) - self.tolerance

    def _distance(self, rows: IntArray | slice) -> FloatArray:
        """Of the best feet so far; FAR where there is none."""
        away = np.linalg.norm(self.points[rows] - self.feet[rows], axis=1)
        return np.where(np.isnan(away), FAR, away)

    def _is_boundary(self, rows: IntArray | slice) -> BoolArray:
        """Whether the best is what was known on the boundary."""
        return self.known.on_boundary & (self.feet[rows] == self.known.feet[rows]).all(axis=1)

    def _first(self, tree: CellTree) -> FloatArray:
        """Descend from the feet that seem nearest, which are returned (n, 3)."""
        limit = aligned(self.backend, self._distance(slice(None)))
        start = to_numpy(tree.nearest(upload_vectors(self.backend, self.points), limit))
        rows = np.flatnonzero(start[:, 0] < 0.5 * FAR)
        self._descend(rows, start[rows])
        return start

    def _challenge(
        self, tree: CellTree, rows: IntArray, tried: Sequence[FloatArray], marks: Any
    ) -> None:
        """Descend from the feet of other parts of the surface that may be nearer, and from further
        ones where that led nearer; with sheets, of which cells know no planes, wherever there are,
        and where evaluations are expensive one by one.

        tried: feet (k, 3) that need not be tried. marks: `CellTree.nearer`.
        """
        for _ in range(_CHALLENGES):
            if not len(rows):
                break
            starts = self._nearer(tree, rows, tried, marks)
            if self._is_expensive:
                starts = starts[:1]
            nearer = self._try(rows, starts)
            some = np.isin(rows, nearer)
            if self._is_expensive or self.proofs.surface.field.has_sheets:
                some |= starts[0][:, 0] < 0.5 * FAR
            rows, tried = rows[some], [one[some] for one in (*tried[-1:], *starts)]

    def _try(self, rows: IntArray, starts: Sequence[FloatArray]) -> IntArray:
        """Descend from feet (k, 3), FAR for none; returns the rows where that led nearer."""
        before = self._distance(rows)
        number, some = np.nonzero([start[:, 0] < 0.5 * FAR for start in starts])
        self._descend(rows[some], np.stack(starts)[number, some])
        return rows[self._distance(rows) < before]

    def _nearer(
        self, tree: CellTree, rows: IntArray, tried: Sequence[FloatArray], marks: Any
    ) -> list[FloatArray]:
        """`CellTree.nearer` for some points; raises their lower bounds."""
        backend, feet = self.backend, self.feet[rows]
        best = Best(
            upload_vectors(backend, np.where(np.isnan(feet), FAR, feet)),
            aligned(backend, self._distance(rows)), aligned(backend, self.free[rows]),
            aligned(backend, np.where(self._is_boundary(rows), _APART_FROM_BOUNDARY, 1.0)),
        )  # fmt: skip
        x = upload_vectors(backend, self.points[rows])
        tried_already = tuple(upload_vectors(backend, one) for one in tried)
        tolerance = dr.opaque(backend.Float, self.tolerance)
        lower, others = tree.nearer(x, best, tried_already, tolerance, marks)
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
        aside = np.minimum(0.25 * distance, _ASIDE * self.tolerance)
        x = self.points[rows]
        self._take(rows, *self.descents.leave_boundary(x, self.feet[rows], aside))
        return rows[self._distance(rows) < distance]

    def _descend(self, rows: IntArray, start: FloatArray) -> None:
        """Descend from places (k, 3), points of the surface or the points themselves."""
        if not len(rows):
            return
        x = self.points[rows]
        on_surface = (start != x).any(axis=1, keepdims=True)
        self._take(rows, np.where(on_surface, start, np.nan), np.zeros(len(rows)))
        self._take(rows, *self.descents.polish(x, start, self._distance(rows)))

    def _take(self, rows: IntArray, feet: FloatArray, free: FloatArray) -> None:
        """Take points of the surface (k, 3) or NaN, and their radii, where they are nearer; rows
        may come several times."""
        away = np.linalg.norm(self.points[rows] - feet, axis=1)
        nearer = np.flatnonzero(away < self._distance(rows))
        nearer = nearer[np.argsort(-away[nearer])]  # the last one stays
        self.feet[rows[nearer]], self.free[rows[nearer]] = feet[nearer], free[nearer]
