"""Evaluators of long formulas, which are interpreted and not compiled. A formula is recorded as a
tape (`harnack.tape`), a list of instructions. A grid of cells over the surface has a list for each
cell, of those instructions that matter there. At a point the list of its cell is run, so that the
cost of a sample is what is near, and kernels do not depend on the length of the formula."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import Interval, Jet
from harnack.arithmetic.operators import Tally, tally_of
from harnack.backend.arrays import upload_floats, upload_integers
from harnack.backend.elementary import fmin, max_norm, safe_norm
from harnack.enclosures import SlopeRange
from harnack.enclosures.enclosure import PathPiece
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import RaySample
from harnack.fields.batched_fields import FieldCache, cached_upload
from harnack.fields.field import Field
from harnack.fields.formula_evaluator import FormulaEvaluator, FormulaOnRay
from harnack.geometry import Box
from harnack.tape.cells import CELL_MARGIN, TapeCells
from harnack.tape.interpreter import TapeProgram, rounded_ends
from harnack.tape.level_box import level_box
from harnack.tape.pruning import BoxTapes
from harnack.tape.recording import Tape, record
from harnack.tree.empty_space import EmptySpaceGrid, OccupancyGrid

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, Mask, Real, Vec3
    from harnack.enclosures.samples import Ray, Sample
    from harnack.fields.evaluator import Plan
    from harnack.geometry import Volume

__all__ = ["TapeEvaluator", "extent_of_formula", "recorded_tape", "tape_evaluator"]

# Formulas of more instructions are interpreted, and combinations of more than half as many, since
# much of them is left out in each cell; shorter ones are compiled.
_MIN_INSTRUCTIONS = 40
# Equal operations, as of equal parts, are one instruction, but are compiled once for each part.
# Formulas of more operations, where equal ones count each time, are interpreted.
_MAX_OPERATIONS = 80
# Rounding may move points by this many machine epsilons of their coordinates and of the length
# along a ray; where that is more than a quarter of the margin of cells, the whole list is run.
_ROUNDINGS = 64.0


# For each field its tape, and its cells by levels.
_TAPES: FieldCache[Tape | None] = FieldCache()
_CELLS: FieldCache[dict[tuple[float, ...], TapeCells | None]] = FieldCache()
# For each field, by levels, the corners of a box around them.
_BOXES: FieldCache[dict[tuple[float, ...], tuple[FloatArray, FloatArray] | None]] = FieldCache()
# The largest number of levels for which the cells of a field are kept.
_MAX_KEPT = 4


@dataclass(frozen=True)
class _UploadedTape:
    """The lists of a field on a backend.

    program: the lists.
    grid: the cells; None if the surface lies in no known box.
    cells: the same in NumPy.
    """

    program: TapeProgram
    grid: _CellGrid | None
    cells: TapeCells | None


def tape_evaluator(
    field: Any, backend: Backend, plan: Plan, *, shortest: int | None = None
) -> TapeEvaluator | None:
    """The evaluator of a field by its tape; None if its formula is short, or cannot be recorded.

    field: a field with a method `formula`.
    shortest: the largest number of instructions of a short formula; None for the number from which
        on interpreting was measured to be quicker.
    """
    if not _is_long(field, shortest):
        return None
    uploaded: _UploadedTape = _upload(field, backend, plan.levels)
    lipschitz = getattr(field, "lipschitz", None)
    constant = dr.opaque(backend.Float, float(lipschitz)) if lipschitz is not None else None
    whole = uploaded.program.formula(dr.opaque(backend.UInt32, 0))
    dr.eval(whole.begin, whole.end)  # data of kernels, which are recorded (`harnack.webgpu`)
    return TapeEvaluator(field, whole, constant, uploaded)


def _is_long(field: Any, shortest: int | None) -> bool:
    """Whether a field is interpreted (`tape_evaluator`)."""
    tape = recorded_tape(field)
    if tape is None:
        return False
    if shortest is None:
        is_single = hasattr(cast("Any", type(field)), "tally")
        shortest = _MIN_INSTRUCTIONS if is_single else _MIN_INSTRUCTIONS // 2
    return tape.operation_count > shortest or tape.call_count > _MAX_OPERATIONS


def extent_of_formula(field: Any, levels: tuple[float, ...]) -> Volume | None:
    """A box that contains the level sets of a formula, by its ranges on half-spaces; None if none
    is found, and for formulas that cannot be recorded."""
    tape = recorded_tape(field) if levels else None
    if tape is None:
        return None
    kept = _BOXES.get(field, None, dict)
    if levels not in kept:
        kept[levels] = level_box(tape, levels)
    corners = kept[levels]
    if corners is None:
        return None
    (a, b, c), (d, e, f) = (corner.tolist() for corner in corners)
    return Box((a, b, c), (d, e, f))


@cached_upload
def _upload(field: Any, backend: Backend, levels: tuple[float, ...]) -> _UploadedTape:
    """Upload the lists of a field, for levels; () for all values."""
    tape = recorded_tape(field)
    assert tape is not None
    kept = _CELLS.get(field, None, dict)
    if levels not in kept:
        while len(kept) >= _MAX_KEPT:
            del kept[next(iter(kept))]
        kept[levels] = _cells_of(field, tape, levels)
    cells = kept[levels]
    if cells is None:
        return _UploadedTape(TapeProgram.upload(backend, BoxTapes.whole(tape)), None, None)
    program = TapeProgram.upload(backend, cells.lists)
    return _UploadedTape(program, _CellGrid.upload(backend, cells), cells)


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
    """The cells over the box that contains the level sets; None if there is no such box. levels: ()
    for all values, over the box of the default level."""
    extent = field.extent(levels or (field.default_level,))
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
    sides: for each list the number of cells along a side of the block that has it.
    floors, caps: for each list the limits between which it computes values rightly; None if it
        computes all values rightly.
    """

    list_of_cell: Index
    sides: Index
    floors: Real | None
    caps: Real | None

    @classmethod
    def upload(cls, backend: Backend, cells: TapeCells) -> _CellGrid:
        layout, limits = cls.upload_layout(backend, cells), cells.limits
        lists, sides = (upload_integers(backend, a) for a in (cells.list_of_cell, cells.sides))
        if not limits.levels:
            return cls(*layout, CELL_MARGIN, lists, sides, None, None)
        # Rounded inwards.
        _, floors = rounded_ends(backend, limits.floor)
        caps, _ = rounded_ends(backend, limits.cap)
        floors, caps = (upload_floats(backend, a) for a in (floors, caps))
        return cls(*layout, CELL_MARGIN, lists, sides, floors, caps)

    def block_at(self, p: Vec3, t: Real) -> _Block:
        """The block of cells with one list in which p lies.

        t: the parameter of the ray on which p lies; 0 for no ray.
        """
        kind, cell = self.backend.UInt32, self.cell(p)
        position = cell.cell_coordinates
        is_valid = position.x >= 0
        for k in range(3):
            is_valid &= (position[k] >= 0) & (position[k] < self.shape[k])
        rounding = _ROUNDINGS * self.backend.machine_epsilon * (max_norm(p) + dr.abs(t))
        is_valid &= rounding < 0.25 * self.margin * self.cell_size
        index = dr.gather(kind, self.list_of_cell, dr.select(is_valid, cell.index, 0))
        index = dr.select(is_valid, index, 0)
        side = self.backend.Float(dr.gather(kind, self.sides, index))
        corner = dr.floor(cell.corner / side) * side
        return _Block(self, index, is_valid, position - corner, side)


@dataclass(frozen=True)
class _Block:
    """The block of cells in which a point lies, for each lane.

    index: of its list.
    is_valid: False for points outside of the grid, and where rounding may move points out of the
        margin of a block: there the list is the whole tape.
    offset: the point relative to the lower corner of the block, in cells.
    side: of the block, in cells.
    """

    grid: _CellGrid
    index: Index
    is_valid: Mask
    offset: Vec3
    side: Real

    def exit_length(self, d: Vec3) -> Real:
        """The length up to which the path from the point in direction d stays in the inner half of
        the margin around the block; infinite where the list is the whole tape."""
        length: Real = self.grid.backend.Float(dr.inf)
        for k in range(3):
            gap = dr.select(d[k] > 0, self.side - self.offset[k], self.offset[k])
            gap = gap + 0.5 * self.grid.margin
            length = fmin(length, dr.select(d[k] == 0, dr.inf, gap / dr.abs(d[k])))
        return dr.select(self.is_valid, length * self.grid.cell_size, dr.inf)

    def border_distance(self) -> Real:
        """The distance of the point from the middle of the margin around the block; infinite where
        the list is the whole tape."""
        nearest: Real = self.grid.backend.Float(dr.inf)
        for k in range(3):
            nearest = fmin(nearest, fmin(self.offset[k], self.side - self.offset[k]))
        nearest = nearest + 0.5 * self.grid.margin
        return dr.select(self.is_valid, nearest * self.grid.cell_size, dr.inf)

    def exact(self, program: TapeProgram, p: Vec3, active: Mask) -> _Block:
        """The block, or the whole tape where the value at p is not within the limits of its
        list."""
        if self.grid.floors is None:
            return self
        zero = 0 * p.x
        numbers = [Jet(Interval.point(p[k]), (), (), piece_length=zero) for k in range(3)]
        value = program.formula(self.index, active & self.is_valid)(*numbers).value
        kind = self.grid.backend.Float
        floor, cap = (dr.gather(kind, a, self.index) for a in (self.grid.floors, self.grid.caps))
        is_valid = self.is_valid & (value.lower > floor) & (value.upper < cap)
        return replace(self, index=dr.select(is_valid, self.index, 0), is_valid=is_valid)


@dataclass(frozen=True, eq=False)
class TapeEvaluator(FormulaEvaluator):
    """The evaluator of a formula by its tape. In a cell of the grid it runs the list of the cell.

    Proof. The list of a cell gives the formula's values in the cell enlarged by its margin
    (`TapeCells`), or a function with the same level sets there. Samples at a point in the cell use
    points in half of the margin: on a ray, a length that ends there; in all directions, a ball that
    ends there. The other half is for rounding, which `block_at` compares with it. Samples on rays
    are of the function of the list, which takes a level where the formula does, and is the same
    near it. Samples at points, which are used for more than levels, are of the formula itself:
    where the value of a list may differ from it, the whole tape is run. So are samples on rays if
    their enclosures follow from promises: these hold for f, and beyond the cell.

    uploaded: the lists.
    """

    uploaded: _UploadedTape

    @functools.cached_property
    def _roughness(self) -> tuple[bool, bool, bool]:
        """Whether a part of f may jump, may turn abruptly, and may be steep (`_tallies_of`)."""
        tallies = list(_tallies_of(self.field))
        is_abrupt = any(tally.turns_within(finest) for tally, finest in tallies)
        is_steep = is_abrupt or any(tally.is_steep for tally, _ in tallies)
        return any(tally.may_jump for tally, _ in tallies), is_abrupt, is_steep

    @functools.cached_property
    def may_jump(self) -> bool:
        return self._roughness[0]

    @property
    def is_abrupt(self) -> bool:
        return self._roughness[1]

    @property
    def is_steep(self) -> bool:
        return self._roughness[2]

    @property
    def list_margin(self) -> float:
        """How far from the surface the values of short lists are those of f, as measured: hits
        within this length are sampled by their lists, others mostly by the whole tape. Infinite
        without cells."""
        cells = self.uploaded.cells
        return math.inf if cells is None else CELL_MARGIN * cells.cell_size

    def _with_list(self, formula: Any, radius: Real | None) -> FormulaEvaluator:
        """The evaluator of a formula that is valid within a radius; None for everywhere."""
        return _ListEvaluator(self.field, formula, self.lipschitz, self, radius)

    def _at(self, p: Vec3) -> FormulaEvaluator:
        """The evaluator of f at points p."""
        grid, program = self.uploaded.grid, self.uploaded.program
        if grid is None:
            return self._with_list(self.formula, None)
        # Points that are no numbers, as those of rays without a hit, need no list.
        is_number = dr.isfinite(p.x + p.y + p.z)
        block = grid.block_at(p, 0.0 * p.x).exact(program, p, is_number)
        formula = program.formula(block.index, is_number)
        return self._with_list(formula, block.border_distance())

    def evaluate(self, p: Vec3) -> Sample:
        return self._at(p).evaluate(p)

    def evaluate_where(self, p: Vec3, active: Mask) -> Sample:
        """The sample at p on active lanes, and NaN on others, where no list is run. (Outside of the
        cells it would be the whole one.)"""
        return self.evaluate(dr.select(active, p, dr.nan))

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return self._at(p).hessian(p)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return self._at(p).derivative_errors(p, sample)

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        p, d = path.point(t), path.direction
        near = self._with_list(self.formula, None)
        if self.uploaded.grid is not None:
            block = self.uploaded.grid.block_at(p, t)
            formula = self.uploaded.program.formula(block.index)
            near = self._with_list(formula, block.border_distance())
            ahead = fmin(ahead, block.exit_length(d))
        uses_ranges = PiecewiseTaylorEnclosure in path.proofs.kinds
        if self.may_jump or self.is_abrupt or near.is_convex or not uses_ranges:
            return near.sample_ray(path, t, ahead, back)
        # As there, with a single loop for the jets at the point and on the ray.
        formula: Any = near.formula
        at_point, on_piece = formula.of_several([Jet.at_point(p), Jet.along_ray(p, d, 0.0, ahead)])
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
        cells = self.uploaded.cells
        if cells is None or not cells.limits.levels:
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
    def may_jump(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.parent.may_jump

    @property
    def is_abrupt(self) -> bool:
        return self.parent.is_abrupt

    @property
    def is_convex(self) -> bool:
        """Whether f is convex and the whole tape is run: a tangent to the function of a list bounds
        f neither from a point where it is not f, nor beyond the cell."""
        return self.radius is None and getattr(self.field, "is_convex", False)

    def enclose_by_promises(self, path: Ray, p: Vec3, sample: Sample) -> RaySample:
        """The ray sample that follows from the promises of f itself (`TapeEvaluator`)."""
        return super().enclose_by_promises(path, p, self.parent.evaluate(p))

    @property
    def max_radius(self) -> Real:
        return super().max_radius if self.radius is None else fmin(self.radius, super().max_radius)


def _tallies_of(field: Any) -> Iterator[tuple[Tally, float]]:
    """For each part of a field the summary of its operations, and the number within which it counts
    as abrupt if it may turn (`FormulaEvaluator.is_abrupt`). Combinations turn no faster than their
    parts, of which each is judged by itself, as their own evaluators would judge it. Blends are no
    steeper than 2^(1/p) times their steepest part, which their Lipschitz constant says. (A summary
    of their whole formula would estimate slopes that grow by a factor with every blend within
    another.)"""
    parts: Any = getattr(field, "parts", None) or ()
    inner, lipschitz = getattr(field, "field", None), getattr(field, "lipschitz", None)
    has_tally = hasattr(cast("Any", type(field)), "tally")
    if parts and all(isinstance(part, Field) for part in parts):
        if has_tally and lipschitz is not None:
            yield Tally(steepest=float(lipschitz)), 1.0
        for part in parts:
            yield from _tallies_of(part)
    elif not has_tally and isinstance(inner, Field):
        yield from _tallies_of(inner)
    else:
        tally: Tally = field.tally if has_tally else tally_of(field.formula)
        yield tally, tally.finest if lipschitz is None else 1.0
