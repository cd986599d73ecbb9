"""Formulas in the text format .vm, which libfive and Fidget write. Each line is an instruction: a
name for its result, an operation, and its operands, names of results of earlier lines; or a number.
The result of the last line is the value of the formula. Lines that begin with # are comments:

    _0 var-x
    _1 const 2.5
    _2 mul _0 _1
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from harnack import arithmetic
from harnack.arithmetic.functions import reciprocal
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    import os

__all__ = ["VmFormula"]

# The largest size of a file, in bytes; a line has about 20.
_MAX_BYTES = 64_000_000
_COORDINATES = ("var-x", "var-y", "var-z")
# For each operation the number of its operands, and the function.
_FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "neg": (1, operator.neg), "square": (1, arithmetic.power(2)), "abs": (1, arithmetic.absolute),
    "recip": (1, reciprocal), "sqrt": (1, arithmetic.sqrt),
    "sin": (1, arithmetic.sin), "cos": (1, arithmetic.cos), "tan": (1, arithmetic.tan),
    "asin": (1, arithmetic.asin), "acos": (1, arithmetic.acos), "atan": (1, arithmetic.atan),
    "exp": (1, arithmetic.exp), "log": (1, arithmetic.log), "ln": (1, arithmetic.log),
    "add": (2, operator.add), "sub": (2, operator.sub), "mul": (2, operator.mul),
    "div": (2, operator.truediv), "max": (2, arithmetic.maximum),
    "min": (2, arithmetic.minimum), "atan2": (2, arithmetic.atan2),
}  # fmt: skip
_OPERATIONS = MappingProxyType(_FUNCTIONS)


@dataclass(frozen=True, eq=False)
class VmFormula:
    """A formula f(x, y, z) that is given as text in the format .vm. An object of this class is
    called like any function of three coordinates.

    name: what the text is called in messages, such as the name of its file.
    instructions: pairs of an operation and its operands: indices of earlier instructions, or the
        number of a constant.
    """

    name: str
    instructions: tuple[tuple[str, tuple[int, ...] | float], ...]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> VmFormula:
        """Read a file.

        Raises:
            OSError: the file cannot be read.
            ValueError: it is no formula (`parse`), or larger than 64 MB.
        """
        path = Path(path)
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise ValueError(f"{path} has {size:,} bytes, and a formula at most {_MAX_BYTES:,}")
        return cls.parse(path.read_bytes().decode("utf-8", "replace"), str(path))

    @classmethod
    def parse(cls, text: str, name: str = "the formula") -> VmFormula:
        """Parse a text.

        name: what the text is called in messages.

        Raises:
            ValueError: the text is not of this format. The message names the line and the mistake.
        """
        instructions: list[tuple[str, tuple[int, ...] | float]] = []
        index_of: dict[str, int] = {}
        for number, line in enumerate(text.splitlines(), start=1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            try:
                instructions.append(_instruction(words, index_of))
            except ValueError as error:
                raise ValueError(f"{name}, line {number}: {error}: {line.strip():.60}") from None
            index_of[words[0]] = len(instructions) - 1
        if not instructions:
            raise ValueError(f"{name} has no instructions: write lines such as _0 var-x")
        return cls(name, tuple(instructions))

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """The value of the formula at coordinates of any kind: numbers, NumPy or Dr.Jit arrays, or
        numbers with proved ranges.

        Raises:
            ValueError: a constant part divides by zero, or is too large.
        """
        coordinates = dict(zip(_COORDINATES, (x, y, z), strict=True))
        results: list[Any] = []
        for operation, operands in self.instructions:
            if not isinstance(operands, tuple):
                results.append(operands)
            elif operation in coordinates:
                results.append(coordinates[operation])
            else:
                function = _OPERATIONS[operation][1]
                try:
                    results.append(function(*(results[k] for k in operands)))
                except ZeroDivisionError:
                    raise ValueError(f"{self.name} divides by zero") from None
                except OverflowError:
                    raise ValueError(f"{self.name} has a number that is too large") from None
        return results[-1]

    def __repr__(self) -> str:
        return f"{self.name} ({len(self.instructions):,} instructions)"


def _instruction(
    words: list[str], index_of: Mapping[str, int]
) -> tuple[str, tuple[int, ...] | float]:
    """The operation of a line and its operands.

    words: of the line.
    index_of: the indices of the instructions before, by the names of their results.

    Raises:
        ValueError: the line is no instruction; the message says why.
    """
    if len(words) < 2:
        raise ValueError("a name and an operation are expected")
    name, operation, *operands = words
    if name in index_of:
        raise ValueError(f"there is a result {name} already")
    if operation == "const":
        try:
            value = float(operands[0]) if len(operands) == 1 else math.nan
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ValueError("const is followed by one finite number")
        return operation, float(value)
    if operation not in _COORDINATES and operation not in _OPERATIONS:
        known = ("const", *_COORDINATES, *_OPERATIONS)
        raise ValueError(
            f"{operation!r} is no operation with proved ranges, there are {', '.join(known)}"
            f"{did_you_mean(operation, known)}"
        )
    count = 0 if operation in _COORDINATES else _OPERATIONS[operation][0]
    if len(operands) != count:
        raise ValueError(f"{operation} has {count} operands, not {len(operands)}")
    for operand in operands:
        if operand not in index_of:
            raise ValueError(f"there is no result {operand} before this line")
    return operation, tuple(index_of[operand] for operand in operands)
