"""Recording of formulas as tapes. A formula is a Python function of the coordinates; evaluated with
`TapeNumber`s in place of numbers it records its operations, and the result is a `Tape`: a list of
instructions, each with an operation, operands (earlier instructions) and constants."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.arithmetic.functions import exp, log, power, reciprocal, sqrt
from harnack.arithmetic.operators import FormulaNumber, exponent_of
from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.tape.operations import (
    COORDINATE_COUNT,
    Operation,
    blend_operation,
    chain_operation,
    function_operation,
    norm_operation,
    operation_named,
)

if TYPE_CHECKING:
    from harnack.arithmetic.functions import ElementaryFunction

__all__ = ["Tape", "TapeNumber", "record"]

_MAX_OPERANDS = 3
# The operations that are distances minus a radius.
_MINUS_RADIUS = {
    "distance of point": "ball",
    "segment distance of point": "capsule",
    "cone distance of point": "round cone",
}
# A number that is recorded is a sum of at most this many multiples of results of instructions.
_MAX_TERMS = 3


@dataclass(frozen=True, eq=False)
class Tape:
    """A formula as a list of n instructions. The first three are the coordinates x, y and z.

    operations: the operations that occur, each once.
    kinds: (n,) for each instruction the index of its operation; -1 for coordinates.
    operands: (n, 3) the instructions that are its operands, all before it; -1 for none.
    constants: (n, c) its constants, 0 where there are fewer.
    chains: (n,) for each member of a chain (`operations.chain_operation`) the number of its chain;
        -1 for other instructions. The members of a chain follow one another.
    result: the instruction whose result is the value of the formula.
    call_count: how many operations the formula did, where equal ones, which are one instruction,
        count each time.
    """

    operations: tuple[Operation, ...]
    kinds: IntArray
    operands: IntArray
    constants: FloatArray
    chains: IntArray
    result: int
    call_count: int

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def operation_count(self) -> int:
        """The number of operations of numbers: two for a member of a chain."""
        return len(self) + int((self.chains >= 0).sum())

    @functools.cached_property
    def constant_columns(self) -> FloatArray:
        """The constants as an array (c, n)."""
        return np.ascontiguousarray(self.constants.T)

    @functools.cached_property
    def boxes(self) -> tuple[FloatArray, FloatArray]:
        """For each instruction (3, n) the lower and the upper corner of the box of its function
        (`Operation.box`); that of all points where none is known."""
        lower, upper = np.full((3, len(self)), -np.inf), np.full((3, len(self)), np.inf)
        for kind, operation in enumerate(self.operations):
            if operation.box is not None:
                which = np.flatnonzero(self.kinds == kind)
                constants = [column[which] for column in self.constant_columns]
                lower[:, which], upper[:, which] = operation.box(
                    constants[: operation.constant_count]
                )
        return lower, upper

    @functools.cached_property
    def is_of_point(self) -> BoolArray:
        """For each instruction (n,) whether its operands are always the coordinates."""
        kinds_of_point = [operation.is_of_point for operation in self.operations]
        return np.array([*kinds_of_point, False])[self.kinds]  # coordinates have the kind -1

    @functools.cached_property
    def depths(self) -> IntArray:
        """For each instruction (n,) the length of the longest path of operands below it, on which
        all members of a chain count as one."""
        depths = [0] * len(self)
        rows: list[list[int]] = self.operands.tolist()
        chains: list[int] = self.chains.tolist()
        for k, operands in enumerate(rows):
            if chains[k] >= 0 and chains[k] == chains[k - 1]:
                depths[k] = depths[k - 1]
            else:
                depths[k] = 1 + max((depths[j] for j in operands if j >= 0), default=-1)
        return np.array(depths, np.int64)


# The index of the operation, the operands, the constants, and the number of the chain or -1.
_Row: TypeAlias = "tuple[int, tuple[int, ...], tuple[float, ...], int]"


def _coordinate_rows() -> list[_Row]:
    """The rows of the coordinates, which have no operation."""
    return [(-1, (), (), -1) for _ in range(COORDINATE_COUNT)]


@dataclass(eq=False)
class _Recorder:
    """Instructions in the order in which they were recorded. Equal instructions are recorded
    once; call_count counts them all."""

    operations: list[Operation] = field(default_factory=list[Operation])
    rows: list[_Row] = field(default_factory=_coordinate_rows)
    kind_of: dict[str, int] = field(default_factory=dict[str, int])
    index_of: dict[Any, int] = field(default_factory=dict[Any, int])
    call_count: int = 0
    chain_count: int = 0

    def add(
        self, operation: Operation, operands: tuple[int, ...], constants: tuple[float, ...] = ()
    ) -> int:
        """Add an instruction, and return its index."""
        self.call_count += 1
        key = operation.name, operands, constants
        index = self.index_of.get(key)
        if index is None:
            index = self.index_of[key] = len(self.rows)
            self.rows.append((self._kind(operation), operands, constants, -1))
        return index

    def add_chain(
        self, head: int | None, members: Sequence[tuple[Operation, Sequence[tuple[float, ...]]]]
    ) -> int:
        """Add a chain, and return the index of its last member.

        head: the instruction before the first member; None for none.
        members: for each operation of the point that occurs, the constants of its members.
        """
        chain = self.chain_count
        self.chain_count += 1
        index, before = -1, () if head is None else (head,)
        for function, constants in members:
            kind = self._kind(chain_operation(function.name))
            self.call_count += len(constants)
            for row in constants:
                index = len(self.rows)
                self.rows.append((kind, before, row, chain))
                before = (index,)
        return index

    def _kind(self, operation: Operation) -> int:
        """The index of an operation among those that occur."""
        kind = self.kind_of.get(operation.name)
        if kind is None:
            kind = self.kind_of[operation.name] = len(self.operations)
            self.operations.append(operation)
        return kind

    def tape(self, result: int) -> Tape:
        """The tape of the instructions that the result depends on. Each comes after its operands,
        and the operand with the longest chain below it comes first, so that few results have to be
        kept at a time."""
        depths = [0] * len(self.rows)
        for k, (_, operands, _, _) in enumerate(self.rows):
            depths[k] = 1 + max((depths[j] for j in operands), default=-1)
        new_index = {k: k for k in range(COORDINATE_COUNT)}
        rows, stack = self.rows[:COORDINATE_COUNT], [result]
        while stack:
            k = stack[-1]
            missing = [j for j in self.rows[k][1] if j not in new_index]
            if missing:
                stack.extend(sorted(missing, key=depths.__getitem__))
                continue
            stack.pop()
            if k not in new_index:
                new_index[k] = len(rows)
                rows.append(self.rows[k])
        operands = np.full((len(rows), _MAX_OPERANDS), -1, np.int64)
        for k, row in enumerate(rows):
            if row[1]:
                operands[k, : len(row[1])] = [new_index[j] for j in row[1]]
        # Functions of the point that became members of chains do not occur by themselves.
        used = sorted({row[0] for row in rows} - {-1})
        operations = tuple(self.operations[k] for k in used)
        new_kind = {-1: -1} | {k: new for new, k in enumerate(used)}
        kinds = np.array([new_kind[row[0]] for row in rows], np.int64)
        width = max((operation.constant_count for operation in operations), default=0)
        constants = np.zeros((len(rows), max(width, 1)))
        for kind, operation in enumerate(operations):
            of_kind = np.flatnonzero(kinds == kind)
            numbers = np.array([rows[k][2] for k in of_kind.tolist()], np.float64)
            constants[of_kind, : operation.constant_count] = numbers
        chains = np.array([row[3] for row in rows], np.int64)
        return Tape(
            operations, kinds, operands, constants, chains, new_index[result],
            self.call_count,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TapeNumber(FormulaNumber):
    """A number of a formula that is being recorded: a constant plus up to three multiples of
    results of instructions. Such sums become instructions when something else than a sum is
    computed of them, so that the three products and sums of a rotated coordinate are one
    instruction.

    terms: pairs of an instruction and a factor.
    shift: the constant.
    roots: numbers such that this one is the sum of their squares; empty if none are known. The
        square root of such a sum is a norm, whose slopes are bounded.

    Factors and constants are combined only where this is exact in double precision: what is
    recorded is the formula itself, not a rounded one.
    """

    recorder: _Recorder
    terms: tuple[tuple[int, float], ...]
    shift: float = 0.0
    roots: tuple[TapeNumber, ...] = ()

    def constant(self, x: Any) -> TapeNumber:
        """Raises TypeError for an array of Dr.Jit, whose numbers are not known here."""
        if dr.is_array_v(type(x)):
            raise TypeError("a formula with arrays of Dr.Jit cannot be recorded")
        return TapeNumber(self.recorder, (), float(x))

    def _instruction(
        self, operation: Operation, operands: Sequence[TapeNumber], constants: Sequence[float] = ()
    ) -> TapeNumber:
        """The result of an operation, as a new instruction."""
        indices = tuple(operand.index for operand in operands)
        return self._of_instruction(self.recorder.add(operation, indices, tuple(constants)))

    def _of_instruction(self, index: int) -> TapeNumber:
        """The result of an instruction."""
        return TapeNumber(self.recorder, ((index, 1.0),))

    @property
    def is_instruction(self) -> bool:
        """Whether this number is the result of an instruction and nothing else."""
        return self.shift == 0.0 and len(self.terms) == 1 and self.terms[0][1] == 1.0

    @property
    def index(self) -> int:
        """The instruction whose result is this number. It is recorded, if there is none yet."""
        if self.is_instruction:
            return self.terms[0][0]
        indices = tuple(index for index, _ in self.terms)
        factors = tuple(factor for _, factor in self.terms)
        shift, add = self.shift, self.recorder.add
        if not factors:
            return add(operation_named("constant"), (), (shift,))
        if factors == (1.0,):
            kind, operands, constants, _ = self.recorder.rows[indices[0]]
            name = _MINUS_RADIUS.get(self.recorder.operations[kind].name) if kind >= 0 else None
            if name is not None:
                return add(operation_named(name), operands, (*constants, -shift))
            return add(operation_named("shift"), indices, (shift,))
        if shift == 0.0:
            if factors == (-1.0,):
                return add(operation_named("negative"), indices)
            if len(factors) == 1:
                return add(operation_named("scale"), indices, factors)
            if factors == (1.0, 1.0):
                return add(operation_named("sum"), indices)
            if factors == (1.0, -1.0):
                return add(operation_named("difference"), indices)
            if factors == (-1.0, 1.0):
                return add(operation_named("difference"), indices[::-1])
        return add(operation_named(f"affine {len(factors)}"), indices, (*factors, shift))

    @property
    def recorded(self) -> TapeNumber:
        """This number as the result of an instruction."""
        return self._of_instruction(self.index)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, int | float) and _is_exact_sum(self.shift, float(other)):
            return TapeNumber(self.recorder, self.terms, self.shift + float(other))
        return super().__add__(other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self + -other if isinstance(other, int | float) else super().__sub__(other)

    def sum(self, other: TapeNumber) -> TapeNumber:
        """The sum of this number and another one."""
        a, b = self, other
        if not _is_exact_sum(a.shift, b.shift):
            a, b = (a.recorded, b) if a.terms else (a, b.recorded)
            if not _is_exact_sum(a.shift, b.shift):
                a, b = a.recorded, b.recorded
        both = {index for index, _ in a.terms} & {index for index, _ in b.terms}
        if both or len(a.terms) + len(b.terms) > _MAX_TERMS:
            a, b = (entry if len(entry.terms) <= 1 and not both else entry.recorded
                    for entry in (a, b))  # fmt: skip
            if a.terms and b.terms and a.terms[0][0] == b.terms[0][0]:
                a, b = a.recorded, b.recorded
                if a.index == b.index:  # a number and itself
                    return a._scaled(2.0)
        roots = self.roots + other.roots if self.roots and other.roots else ()
        return TapeNumber(self.recorder, a.terms + b.terms, a.shift + b.shift, roots)

    def __neg__(self) -> TapeNumber:
        return self._scaled(-1.0)

    def _scaled(self, factor: float) -> TapeNumber:
        """This number times a constant."""
        numbers = (*(entry for _, entry in self.terms), self.shift)
        base = self if all(_is_exact_product(n, factor) for n in numbers) else self.recorded
        terms = tuple((index, entry * factor) for index, entry in base.terms)
        shift = base.shift * factor if base.shift else 0.0  # not NaN for an infinite factor
        return TapeNumber(self.recorder, terms, shift)

    def product(self, other: TapeNumber) -> TapeNumber:
        """The product of this number and another one."""
        if other is self:
            return self.apply(power(2))
        if not other.terms:
            return self._times_constant(other.shift)
        if not self.terms:
            return other._times_constant(self.shift)
        square = self._multiple_of_square(other)
        if square is not None:
            return square
        a, b = self.index, other.index
        if a == b:
            return self.apply(power(2))
        return self._of_instruction(self.recorder.add(operation_named("product"), (a, b)))

    def _multiple_of_square(self, other: TapeNumber) -> TapeNumber | None:
        """The product with another number, if both are multiples of the same result: a multiple of
        its square, which is never negative, as the range of a product may be; None for others."""
        if self.shift or other.shift or len(self.terms) != 1 or len(other.terms) != 1:
            return None
        ((index, first),), ((other_index, second),) = self.terms, other.terms
        if index != other_index or not _is_exact_product(first, second):
            return None
        return self._of_instruction(index).apply(power(2))._times_constant(first * second)

    def _times_constant(self, factor: float) -> TapeNumber:
        """This number times a constant. Of a constant, an instruction: the product is rounded."""
        if not self.terms and not _is_exact_product(self.shift, factor):
            return self.recorded._scaled(factor)
        result, roots = self._scaled(factor), self.roots
        if not roots or factor <= 0.0:
            return result
        if factor != 1.0:
            scale = self.constant(factor).recorded.apply(sqrt)
            roots = tuple(root.product(scale) for root in roots)
        return TapeNumber(self.recorder, result.terms, result.shift, roots)

    def __truediv__(self, other: Any) -> Any:
        b = self._coerce_or_none(other)
        if b is None:
            return NotImplemented
        if b.terms:
            return self.product(b.apply(reciprocal))
        if b.shift == 0.0:
            raise ZeroDivisionError("a formula divides by the constant 0")
        inverse = 1.0 / b.shift
        if _is_exact_product(inverse, b.shift) and inverse * b.shift == 1.0:
            return self._times_constant(inverse)
        return self._instruction(operation_named("divide"), [self], [b.shift])

    def __pow__(self, exponent: Any) -> TapeNumber:
        if isinstance(exponent, TapeNumber):
            if exponent.terms:
                return exponent.product(self.apply(log)).apply(exp)
            exponent = exponent.shift
        n = exponent_of(exponent)
        return self.apply(sqrt if n == 0.5 and self.roots else power(n))

    def apply(self, function: ElementaryFunction) -> TapeNumber:
        """An elementary function of this number. The root of a sum of squares is a norm."""
        if function is sqrt and self.roots:
            return self._norm(self.roots, 2.0)
        result = self._instruction(function_operation(function), [self])
        if function.name == "power 2":
            return TapeNumber(self.recorder, result.terms, 0.0, (self,))
        return result

    def pointwise_maximum(self, other: TapeNumber) -> TapeNumber:
        return self._instruction(operation_named("maximum"), [self, other])

    def minimum(self, other: Any) -> TapeNumber:
        return self._instruction(operation_named("minimum"), [self, self.coerce(other)])

    def polar_angle(self, x: TapeNumber) -> TapeNumber:
        return self._instruction(operation_named("polar angle"), [self, x])

    def _norm(self, values: Sequence[TapeNumber], p: float) -> TapeNumber:
        """The p-norm of two or more numbers. (The norm of four numbers is that of a norm and of
        the others.)"""
        if len(values) == 1:
            return abs(values[0])
        if len(values) > _MAX_OPERANDS:
            return self._norm([self._norm(values[:_MAX_OPERANDS], p), *values[_MAX_OPERANDS:]], p)
        is_point = p == 2.0 and len(values) == _MAX_OPERANDS
        if is_point and all(len(v.terms) == 1 and v.terms[0][1] == 1.0 for v in values):
            indices = tuple(value.terms[0][0] for value in values)
            center = tuple(-value.shift for value in values)
            of_point = " of point" if indices == tuple(range(COORDINATE_COUNT)) else ""
            operation = operation_named("distance" + of_point)
            return self._of_instruction(self.recorder.add(operation, indices, center))
        return self._instruction(norm_operation(len(values), p), values)

    def _extremum(self, name: str, numbers: list[TapeNumber]) -> TapeNumber:
        """The minimum or maximum of numbers. Those that are functions of the point are members of a
        chain, for a minimum; of the others a balanced tree is made, so that a box does not decide
        one operand after another."""
        operation, rows = operation_named(name), self.recorder.rows
        members: dict[int, list[tuple[float, ...]]] = {}
        others: list[TapeNumber] = []
        for number in {number.index: number for number in numbers}.values():
            kind, _, constants, _ = rows[number.index]
            if name == "minimum" and kind >= 0 and self.recorder.operations[kind].is_of_point:
                members.setdefault(kind, []).append(constants)
            else:
                others.append(number)
        while len(others) > 1:
            pairs = [others[k : k + 2] for k in range(0, len(others), 2)]
            others = [
                self._instruction(operation, pair) if len(pair) > 1 else pair[0] for pair in pairs
            ]
        if not members:
            return others[0]
        head = others[0].index if others else None
        functions = [(self.recorder.operations[kind], rows) for kind, rows in members.items()]
        return self._of_instruction(self.recorder.add_chain(head, functions))

    def least_of_rows(self, name: str, point: Sequence[Any], rows: FloatArray) -> TapeNumber | None:
        """A chain with a member for each row; None if the point is moved."""
        if [number.index for number in point] != list(range(COORDINATE_COUNT)):
            return None
        constants = [tuple(row) for row in rows.tolist()]
        self.recorder.call_count += len(constants)
        index = self.recorder.add_chain(None, [(operation_named(name), constants)])
        return self._of_instruction(index)

    def of_several(self, name: str, values: Sequence[Any], *literals: float) -> TapeNumber | None:
        numbers: list[TapeNumber] = [self.coerce(value) for value in values]
        if name == "norm":
            return self._norm(numbers, *literals)
        if name in ("maximum", "minimum"):
            return self._extremum(name, numbers)
        if name == "orthogonal intersection":
            count = len(numbers)
            if not 2 <= count <= _MAX_OPERANDS:
                return None
            return self._instruction(operation_named(f"orthogonal {count}"), numbers)
        if name in ("segment distance", "cone distance"):
            indices = tuple(number.index for number in numbers)
            of_point = " of point" if indices == tuple(range(COORDINATE_COUNT)) else ""
            operation = operation_named(name + of_point)
            return self._of_instruction(self.recorder.add(operation, indices, literals))
        # Blended unions and intersections: two numbers and the radius.
        a, b, radius = numbers
        if radius.terms:
            return None
        operation = blend_operation(literals[0], is_union=name == "blended union")
        return self._instruction(operation, [a, b], [radius.shift])


def _is_exact_sum(a: float, b: float) -> bool:
    """Whether the sum of two numbers is not rounded. (An infinite one is, or counts as rounded.)"""
    if a == 0.0 or b == 0.0:
        return True
    return math.isfinite(a + b) and Fraction(a) + Fraction(b) == Fraction(a + b)


def _is_exact_product(a: float, b: float) -> bool:
    """Whether the product of two numbers is not rounded. (An infinite one is, or counts as
    rounded.)"""
    if abs(a) == 1.0 or abs(b) == 1.0:
        return True
    return math.isfinite(a * b) and Fraction(a) * Fraction(b) == Fraction(a * b)


def record(formula: Callable[[Any, Any, Any], Any]) -> Tape:
    """Record a formula as a tape.

    formula: a function of three coordinates, which may be numbers of any arithmetic.

    Raises:
        TypeError: the formula does not accept such numbers.
    """
    recorder = _Recorder()
    x, y, z = (TapeNumber(recorder, ((k, 1.0),)) for k in range(COORDINATE_COUNT))
    try:
        value = x.coerce(formula(x, y, z))
    except (AttributeError, RuntimeError) as error:
        raise TypeError(f"the formula cannot be recorded: {error}") from error
    return recorder.tape(value.index)
