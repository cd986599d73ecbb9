"""Evaluators of long formulas, which are interpreted and not compiled. A formula is recorded as a
tape (`harnack.tape`), a list of instructions. A grid of cells over the surface has a list for each
cell, of those instructions that matter there. At a point the list of its cell is run, so that the
cost of a sample is what is near, and kernels do not depend on the length of the formula."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.arithmetic import Jet
from harnack.arithmetic.operators import OperationCounter, Tally
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmin, max_norm, safe_norm
from harnack.enclosures import SlopeRange
from harnack.enclosures.enclosure import PathPiece
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import RaySample
from harnack.fields.batched_fields import FieldCache
from harnack.fields.formula import Formula, FormulaEvaluator, FormulaOnRay
from harnack.tape.cells import CELL_MARGIN, TapeCells
from harnack.tape.interpreter import TapeProgram
from harnack.tape.operations import COORDINATE_COUNT
from harnack.tape.pruning import BoxTapes
from harnack.tape.recording import Tape, record
from harnack.tree.empty_space import EmptySpaceGrid, OccupancyGrid

if TYPE_CHECKING:
    from harnack.backend import Backend, Index, Mask, Real, Vec3
    from harnack.enclosures.samples import Ray, Sample
    from harnack.fields.evaluator import Plan
    from harnack.fields.field import Field

__all__ = ["TapeEvaluator", "recorded_tape", "tape_evaluator"]

# Formulas of more instructions are interpreted; shorter ones are compiled.
_MIN_INSTRUCTIONS = 40
# Rounding may move points by this many machine epsilons of their coordinates and of the length
# along a ray; where that is more than a quarter of the margin of cells, the whole list is run.
_ROUNDINGS = 512.0


@dataclass(frozen=True)
class _HostTape:
    """The tape of a field with its cells, in NumPy.

    cells: None if the surface lies in no known box.
    """

    tape: Tape
    cells: TapeCells | None
    levels: tuple[float, ...]


# For each field its tape; and its cells for the levels of the last call.
_TAPES: FieldCache[Tape | None] = FieldCache()
_CELLS: FieldCache[_HostTape] = FieldCache()
_PROGRAMS: FieldCache[dict[Any, tuple[TapeProgram, _CellGrid | None]]] = FieldCache()


def tape_evaluator(field: Any, backend: Backend, plan: Plan) -> TapeEvaluator | None:
    """The evaluator of a field by its tape; None if its formula is short, or cannot be recorded.

    field: a field with a method `formula`.
    """
    tape = recorded_tape(field)
    if tape is None or len(tape) <= _MIN_INSTRUCTIONS:
        return None
    levels = plan.levels or (field.default_level,)
    host = _CELLS.get(
        field, levels, lambda: _HostTape(tape, _cells_of(field, tape, levels), levels)
    )
    uploads = _PROGRAMS.get(field, levels, dict)
    if backend not in uploads:
        lists = BoxTapes.whole(tape) if host.cells is None else host.cells.lists
        grid = None if host.cells is None else _CellGrid.upload(backend, host.cells)
        uploads[backend] = TapeProgram.upload(backend, lists), grid
    program, grid = uploads[backend]
    lipschitz = getattr(field, "lipschitz", None)
    constant = dr.opaque(backend.Float, float(lipschitz)) if lipschitz is not None else None
    whole = program.formula(dr.opaque(backend.UInt32, 0))
    return TapeEvaluator(field, whole, constant, program, grid, host, is_drawn=bool(plan.levels))


def recorded_tape(field: Any) -> Tape | None:
    """The tape of a field's formula; None if it cannot be recorded. field: a field with a method
    `formula`."""
    return _TAPES.get(field, None, lambda: _record_or_none(field))


def _record_or_none(field: Any) -> Tape | None:
    try:
        return record(field.formula)
    except TypeError:  # it accepts ranges of derivatives alone
        return None


def _cells_of(field: Field, tape: Tape, levels: tuple[float, ...]) -> TapeCells | None:
    """The cells over the box that contains the level sets; None if there is no such box."""
    extent = field.extent(levels)
    if extent is None:
        return None
    lower, upper = (np.array(corner, np.float64) for corner in extent.bounds())
    if not np.isfinite([lower, upper]).all():
        return None
    return TapeCells.of(tape, lower, upper, levels)


@dataclass(frozen=True)
class _CellGrid(EmptySpaceGrid):
    """The grid of cells on a backend.

    list_of_cell: for each cell the index of its list.
    """

    list_of_cell: Index

    @classmethod
    def upload(cls, backend: Backend, cells: TapeCells) -> _CellGrid:
        layout = cls.upload_layout(backend, cells)
        return cls(*layout, CELL_MARGIN, upload_integers(backend, cells.list_of_cell))

    def list_at(self, p: Vec3, t: Real) -> tuple[Index, Mask]:
        """The list that is valid in the cell of p; and whether it is that of a cell: not outside of
        the grid, nor where rounding may move points out of the margin of the cell.

        t: the parameter of the ray on which p lies; 0 for no ray.
        """
        cell = self.cell(p)
        position, shape = cell.cell_coordinates, self.shape
        is_inside = position.x >= 0
        for k in range(3):
            is_inside &= (position[k] >= 0) & (position[k] < shape[k])
        rounding = _ROUNDINGS * self.backend.machine_epsilon * (max_norm(p) + dr.abs(t))
        is_inside &= rounding < 0.25 * self.margin * self.cell_size
        index = dr.select(is_inside, cell.index, 0)
        lists = dr.gather(self.backend.UInt32, self.list_of_cell, index)
        return dr.select(is_inside, lists, 0), is_inside

    def exit_length(self, p: Vec3, d: Vec3) -> Real:
        """The length up to which the path from p, in a cell of the grid, in direction d stays in
        the middle of the margin around the cell."""
        cell = self.cell(p)
        length: Real = self.backend.Float(dr.inf)
        margin = 0.5 * self.margin
        for k in range(3):
            offset = cell.cell_coordinates[k] - cell.corner[k]
            gap = dr.select(d[k] > 0, 1 - offset, offset) + margin
            length = fmin(length, dr.select(d[k] == 0, dr.inf, gap / dr.abs(d[k])))
        return length * self.cell_size

    def border_distance(self, p: Vec3) -> Real:
        """The distance of a point p in a cell of the grid from the middle of the margin around the
        cell."""
        cell = self.cell(p)
        nearest: Real = self.backend.Float(dr.inf)
        for k in range(3):
            offset = cell.cell_coordinates[k] - cell.corner[k]
            nearest = fmin(nearest, fmin(offset, 1 - offset) + 0.5 * self.margin)
        return nearest * self.cell_size


@dataclass(frozen=True, eq=False)
class TapeEvaluator(FormulaEvaluator):
    """The evaluator of a formula by its tape. In a cell of the grid it runs the list of the cell.

    Proof. The list of a cell gives the formula's values in the cell enlarged by its margin
    (`TapeCells`). Samples at a point in the cell use points in half of the margin: on a ray, a
    length that ends there; in all directions, a ball that ends there. The other half is for
    rounding, which `list_at` compares with it.

    program: the lists.
    grid: the cells; None if there are none.
    host: the tape and its cells in NumPy.
    is_drawn: whether the cells were made for the levels of the plan.
    """

    program: TapeProgram
    grid: _CellGrid | None
    host: _HostTape
    is_drawn: bool

    @functools.cached_property
    def tally(self) -> Tally:
        return _tally_of_tape(self.host.tape)

    @functools.cached_property
    def may_jump(self) -> bool:
        return self.tally.may_jump

    @functools.cached_property
    def is_abrupt(self) -> bool:
        return _is_abrupt(self.field, self.tally)

    @property
    def is_convex(self) -> bool:
        return getattr(self.field, "is_convex", False)

    def _near(self, p: Vec3, t: Real) -> tuple[FormulaEvaluator, Mask | None]:
        """The evaluator of the list at p, and whether it is that of a cell; None for no cells."""
        grid = self.grid
        if grid is None:
            return self._with_list(self.formula, None), None
        index, is_inside = grid.list_at(p, t)
        radius = dr.select(is_inside, grid.border_distance(p), dr.inf)
        return self._with_list(self.program.formula(index), radius), is_inside

    def _with_list(self, formula: Any, radius: Real | None) -> FormulaEvaluator:
        """The evaluator of a formula that is valid within a radius; None for everywhere."""
        return _ListEvaluator(self.field, formula, self.lipschitz, self, radius)

    def evaluate(self, p: Vec3) -> Sample:
        return self._near(p, 0.0 * p.x)[0].evaluate(p)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self._near(p, 0.0 * p.x)[0].hessian(p)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return self._near(p, 0.0 * p.x)[0].derivative_errors(p, sample)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        p = path.point(t)
        near, is_inside = self._near(p, t)
        if is_inside is not None:
            assert self.grid is not None
            to_exit = self.grid.exit_length(p, path.direction)
            ahead = dr.select(is_inside, fmin(ahead, to_exit), ahead)
        uses_ranges = PiecewiseTaylorEnclosure in path.proofs.kinds
        if self.may_jump or self.is_abrupt or self.is_convex or not uses_ranges:
            return near.sample_ray(path, t, ahead, back)
        # As there, with a single loop for the jets at the point and on the ray.
        d = path.direction
        at_point, on_piece = near.formula.of_several(
            [Jet.at_point(p), Jet.along_ray(p, d, 0.0, ahead)]
        )
        start = on_piece.jet_at_start
        (slope,), (slopes,), (curvatures,) = (
            start.first_derivatives, on_piece.first_derivatives, on_piece.second_derivatives
        )  # fmt: skip
        piece = PathPiece(
            ahead, SlopeRange(slopes.lower, slopes.upper), curvatures.lower, curvatures.upper
        )
        around = SlopeRange.around(slope.midpoint, slope.radius)
        enclosure = PiecewiseTaylorEnclosure(around, (piece,))
        sample = near.sample_of_jet(at_point, p)
        lowest = type(p)(*(0 * p.x + entry.min_abs for entry in at_point.first_derivatives))
        return RaySample(
            sample, (enclosure,), (), slope.midpoint, enclosure.reach_growth, slope.radius,
            safe_norm(lowest),
        )  # fmt: skip

    def restrict(self, p: Vec3, direction: Vec3) -> FormulaOnRay:
        """The formula restricted to a line, of any length: by the whole list."""
        return self._with_list(self.formula, None).restrict(p, direction)

    def occupied_cells(self) -> OccupancyGrid | None:
        cells = self.host.cells
        if cells is None or not self.is_drawn:
            return None
        return OccupancyGrid(cells.origin, cells.cell_size, cells.shape, cells.empty_distance)


@dataclass(frozen=True, eq=False)
class _ListEvaluator(FormulaEvaluator):
    """The evaluator of a list of instructions at each lane.

    parent: the evaluator whose lists they are.
    radius: within which the list is valid; None for everywhere.
    """

    parent: TapeEvaluator
    radius: Real | None

    @property
    def name(self) -> str:
        return self.parent.name

    @property
    def tally(self) -> Tally:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.parent.tally

    @property
    def may_jump(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.parent.may_jump

    @property
    def is_abrupt(self) -> bool:
        return self.parent.is_abrupt

    @property
    def is_convex(self) -> bool:
        return self.parent.is_convex

    @property
    def max_radius(self) -> Real:
        return super().max_radius if self.radius is None else fmin(self.radius, super().max_radius)


def _tally_of_tape(tape: Tape) -> Tally:
    """The summary of the operations of a tape."""
    tally = Tally()
    numbers: list[Any] = [OperationCounter(tally) for _ in range(COORDINATE_COUNT)]
    rows = zip(tape.kinds.tolist(), tape.operands.tolist(), tape.constants.tolist(), strict=True)
    for kind, operands, constants in rows:
        if kind < 0:
            continue
        operation = tape.operations[kind]
        counters = [numbers[k] for k in operands[: operation.operand_count]]
        values = [numbers[0].constant(c) for c in constants[: operation.constant_count]]
        numbers.append(operation.apply(counters, values))
    return tally


def _is_abrupt(field: Any, tally: Tally) -> bool:
    """Whether a formula may change by far more than its slopes allow within the rounding of
    coordinates (`FormulaEvaluator.is_abrupt`). The parts of a combination are judged each for
    itself.

    tally: the summary of the whole formula's operations.
    """
    if getattr(field, "lipschitz", None) is not None:
        return tally.turns_within(1.0)
    parts = getattr(field, "parts", None)
    if parts and not isinstance(field, Formula):
        return any(_is_abrupt(part, getattr(part, "tally", tally)) for part in parts)
    return tally.turns_within(tally.finest)
