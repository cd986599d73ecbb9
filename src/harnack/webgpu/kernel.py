"""Kernels as operations on single lanes. A kernel is a program that runs once for each lane, that
is for each entry of its arrays. A statement computes a result from operands, loads an entry of an
array, or stores one; loops and branches contain statements. The parameters of a kernel are pointers
to its arrays, and a label is the name of an array, which Dr.Jit prints as a comment. A table is an
array that lanes read at computed indices. A local array is one that each lane has for itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

__all__ = [
    "Branch",
    "ComputeKernel",
    "Constant",
    "Kind",
    "Load",
    "LocalArray",
    "LocalLoad",
    "LocalStore",
    "Loop",
    "LoopVariable",
    "Operand",
    "Operation",
    "Statement",
    "Store",
    "UntranslatableError",
]

Kind: TypeAlias = Literal["f32", "u32", "bool"]


class UntranslatableError(NotImplementedError):
    """The error for a kernel that contains an operation which the translation does not know."""


@dataclass(frozen=True)
class Constant:
    """A constant operand. bits: its 32 bits as an integer; 0 or 1 for a "bool"."""

    kind: Kind
    bits: int


Operand: TypeAlias = "str | Constant"


@dataclass(frozen=True)
class Operation:
    """The statement result = name(operands). Each operand is a constant or the name of the result
    of an earlier statement. kind: the type of the result."""

    result: str
    kind: Kind
    name: str
    operands: tuple[Operand, ...]


@dataclass(frozen=True)
class Load:
    """The statement result = an entry of an array.

    source: which entry is read. "lane": the entry of the lane. "number": the only entry. "table":
        entry index * stride + offset if `mask` is True (or None), otherwise the result is 0.
    parameter: the index of the array among the parameters of the kernel.
    index, stride, offset, mask: for "table" only.
    """

    result: str
    kind: Kind
    source: Literal["lane", "number", "table"]
    parameter: int
    index: Operand | None = None
    stride: int = 1
    offset: int = 0
    mask: Operand | None = None


@dataclass(frozen=True)
class Store:
    """The statement that stores `value` as the lane's entry of an array. parameter: the index of
    the array among the parameters of the kernel. kind: the type of the value."""

    parameter: int
    kind: Kind
    value: Operand


@dataclass(frozen=True)
class LocalArray:
    """An array of `size` numbers that each lane has for itself. name: by which statements identify
    it. kind: the type of its numbers; truth values are stored as 0 or 1."""

    name: str
    kind: Kind
    size: int


@dataclass(frozen=True)
class LocalLoad:
    """The statement result = entry `index` of a local array. kind: the type of the result."""

    result: str
    kind: Kind
    array: str
    index: Operand


@dataclass(frozen=True)
class LocalStore:
    """The statement that stores `value` as entry `index` of a local array."""

    array: str
    index: Operand
    value: Operand


@dataclass(frozen=True)
class LoopVariable:
    """A variable that a loop changes. before: its value before the first iteration. after: its
    value after an iteration, in terms of the values in that iteration."""

    name: str
    kind: Kind
    before: Operand
    after: Operand


@dataclass
class Loop:
    """A loop. The statements `test` compute the operand `condition`. If it is True, the statements
    `body` run and the test is made again; otherwise the loop ends."""

    variables: list[LoopVariable] = field(default_factory=list[LoopVariable])
    test: list[Statement] = field(default_factory=list["Statement"])
    condition: Operand = ""
    body: list[Statement] = field(default_factory=list["Statement"])


@dataclass(frozen=True)
class BranchResult:
    """A result of a branch: `value`, an operand in its body, where the body has run, otherwise 0.
    name: the name of the result, which the statements after the branch use."""

    name: str
    kind: Kind
    value: Operand


@dataclass
class Branch:
    """The statements `body`, which run if `condition` is True, and the results of them."""

    condition: Operand
    body: list[Statement] = field(default_factory=list["Statement"])
    results: list[BranchResult] = field(default_factory=list[BranchResult])


Statement: TypeAlias = "Operation | Load | Store | LocalLoad | LocalStore | Loop | Branch"


@dataclass(frozen=True)
class ComputeKernel:
    """The program that each lane of a kernel runs, as a list of statements.

    statements: the statements in order.
    labels: for the index of a kernel parameter, the label of its array, if a label is known. An
        array that lanes read at computed indices has the label of the values read from it.
    local_arrays: the local arrays of a lane.
    """

    statements: list[Statement]
    labels: dict[int, str]
    local_arrays: tuple[LocalArray, ...] = ()

    def walk(self) -> Iterator[Statement]:
        """Yield all statements, including those in loops and branches, in no particular order."""
        pending = list(self.statements)
        while pending:
            statement = pending.pop()
            yield statement
            if isinstance(statement, Loop):
                pending += [*statement.test, *statement.body]
            elif isinstance(statement, Branch):
                pending += statement.body
