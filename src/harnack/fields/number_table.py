"""Numbers with derivatives, by which a formula is differentiated, in one table on a backend.

A kernel reads them by an index for each of its lanes. So a derivative in reverse mode is one
scattered sum into the table, whatever the number of parts that have numbers. (A Dr.Jit number of a
single lane that is used by many lanes would be a sum of its own, for which the whole formula is
compiled again.) Of many parts with the same formula, of which a point takes the least or the
greatest, each lane reads the numbers of that part alone (`AlikeParts`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, cast

import drjit as dr
import numpy as np

from harnack.arithmetic.jet import Dual
from harnack.backend import backend_of
from harnack.backend.arrays import upload_floats, upload_integers
from harnack.backend.validation import check_no_derivatives, has_derivatives
from harnack.fields.parameters import differentiable_parameters

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Index, IntArray, Real, Vec3

__all__ = [
    "AlikeParts",
    "NumberReader",
    "NumberRecorder",
    "NumberSlice",
    "NumberTable",
    "components_of",
    "detached",
    "is_attached_number",
    "plain_numbers",
]


class NumberReader(Protocol):
    """What gives the numbers of a field with their derivatives."""

    def vector(self, argument: Any, plain: Sequence[float]) -> tuple[Any, ...]:
        """The numbers of a Dr.Jit vector, array or tensor, or of a tuple of numbers, with their
        derivatives. plain: their values."""
        ...


class _Joined(dr.CustomOp):
    """Arrays of several lengths, joined to one table, as a Dr.Jit operation."""

    def eval(self, arrays: list[Any], table: Any) -> Any:
        """Return a copy of `table`, which holds the numbers of the arrays one after the other."""
        index, offset = dr.uint32_array_t(type(table)), 0
        self._kind, self._width = type(table), dr.width(table)
        self._places: list[Any] = []
        for array in arrays:
            width = dr.width(array)
            # As a kernel parameter, the place needs no kernel of its own.
            self._places.append(dr.arange(index, width) + dr.opaque(index, offset))
            offset += width
        return type(table)(table)

    def forward(self) -> None:
        """The rates of the arrays, joined."""
        rates = dr.zeros(self._kind, self._width)
        for rate, place in zip(self.grad_in("arrays"), self._places, strict=True):
            dr.scatter(rates, self._kind(rate), place)
        self.set_grad_out(rates)

    def backward(self) -> None:
        """The parts of the gradient, for each array its own."""
        gradient = self.grad_out()
        dr.eval(gradient)
        own = [dr.gather(self._kind, gradient, place) for place in self._places]
        self.set_grad_in("arrays", own)


@dataclass(frozen=True, eq=False)
class NumberSlice:
    """Some neighboring numbers of a Dr.Jit array.

    array: the array, vector or tensor; of a vector, numbers are counted lane by lane.
    numbers: the numbers of the slice, without derivatives.
    start: the index of the first one.
    """

    array: Any
    numbers: FloatArray
    start: int


class NumberTable:
    """The numbers of a field that are Dr.Jit arrays, as a table on a backend, and its others.

    backend: the backend.
    table: the numbers with derivatives, and after them numbers that nothing depends on.
    """

    def __init__(self, arrays: Iterable[Any], backend: Backend, width: int) -> None:
        """arrays: all Dr.Jit arrays, vectors and tensors among the numbers. width: the number of
        lanes that read them."""
        self.backend = backend
        # No literal: a uniform literal index would be taken for a number that all lanes share.
        self._zero = dr.opaque(backend.UInt32, 0, width)
        self._places: dict[int, tuple[Any, IntArray]] = {}
        parts: list[Any] = []
        count: int = 0
        for array in arrays:
            if id(array) in self._places or not dr.grad_enabled(array):
                continue
            components = [backend.Float(component) for component in components_of(array)]
            length: int = max(dr.width(component) for component in components)
            # Vectors may have a component that is the same in all lanes.
            components = [c if dr.width(c) == length else c + dr.zeros(type(c), length)
                          for c in components]  # fmt: skip
            places: IntArray = np.arange(count, count + length * len(components))
            if len(components) > 1:  # entry by entry, as in a tensor (n, 3)
                places = places.reshape(-1, length).T.ravel()
            # (The array itself is kept, so that no other one gets its id.)
            self._places[id(array)] = array, places
            parts += components
            count += len(places)
        with dr.suspend_grad():
            dr.eval(*map(dr.detach, parts))  # at once
        values: list[FloatArray] = [np.array(dr.detach(part), np.float64) for part in parts]
        # A table of one number would be one that all lanes share, too.
        numbers = np.concatenate([*values, np.zeros(2)])
        with dr.suspend_grad():
            table = upload_floats(backend, numbers)
        self.table = dr.custom(_Joined, parts, table) if parts else table
        self._count = count

    @classmethod
    def of(cls, field: Any, p: Vec3) -> NumberTable:
        """The table of the numbers of a field, for the lanes of points p."""
        return cls(differentiable_parameters(field), backend_of(p), dr.width(p))

    def places(self, argument: Any, count: int) -> IntArray:
        """The places in the table of the `count` numbers of an argument, a Dr.Jit vector, array or
        tensor, or a tuple of numbers; `no_place` for a number without derivatives."""
        if isinstance(argument, tuple | list) and count > 1:
            entries = cast("Sequence[Any]", argument)
            size = count // len(entries)
            return np.concatenate([self.places(entry, size) for entry in entries])
        if isinstance(argument, NumberSlice):
            whole = self._places[id(argument.array)][1]
            return whole[argument.start : argument.start + count]
        known = self._places.get(id(cast("Any", argument)))
        return np.full(count, self.no_place) if known is None else known[1]

    @property
    def no_place(self) -> int:
        """The place of a number that nothing depends on."""
        return self._count

    def vector(self, argument: Any, plain: Sequence[float]) -> tuple[Any, ...]:
        """`NumberReader.vector`. All numbers are kernel parameters: as literals, each value would
        compile another kernel. But a 0 without derivative stays a Python number."""
        places = self.places(argument, len(plain)).tolist()
        return tuple(map(self._number, plain, places))

    def _number(self, plain: float, place: int) -> Any:
        """A number, of its place or without a derivative."""
        if place != self.no_place:
            return dr.gather(self.backend.Float, self.table, self._zero + place)
        return dr.opaque(self.backend.Float, plain) if plain else plain


class NumberRecorder:
    """A reader that notes which numbers are read, and gives them as Python numbers. So it tells the
    numbers of a part of a field, those without derivatives too.

    values, places: the numbers, and their places in the table.
    """

    def __init__(self, table: NumberTable) -> None:
        self._table = table
        self.values: list[float] = []
        self.places: list[int] = []

    def vector(self, argument: Any, plain: Sequence[float]) -> tuple[float, ...]:
        """`NumberReader.vector`."""
        self.values += plain
        self.places += self._table.places(argument, len(plain)).tolist()
        return tuple(plain)


class _RowReader:
    """A reader of the numbers of one of many parts, whose index is one for each lane.

    is_attached: whether they have their derivatives.
    """

    def __init__(self, parts: AlikeParts, index: Index, *, is_attached: bool) -> None:
        self._parts, self._first, self._column = parts, index * parts.column_count, 0
        self._is_attached = is_attached

    def vector(self, argument: Any, plain: Sequence[float]) -> tuple[Any, ...]:
        """`NumberReader.vector`, in the order in which a `NumberRecorder` noted them."""
        del argument
        start = self._column
        self._column += len(plain)
        return tuple(
            self._parts.number(self._first, k, is_attached=self._is_attached)
            for k in range(start, self._column)
        )


class AlikeParts:
    """The least or the greatest function of many parts that have the same formula of other numbers.

    The derivative of the extreme one by its numbers is that of the part which is it: a loop finds
    that part for each lane, and its formula is evaluated once with its numbers. So what is compiled
    does not depend on how many parts there are.

    table: the table with the numbers.
    values, places: (m, k) the numbers of each part, and their places in the table.
    make: makes the formula of a part from a reader of its numbers.
    is_least: whether the least function counts; else the greatest.
    """

    def __init__(
        self, table: NumberTable, values: FloatArray, places: IntArray,
        make: Callable[[NumberReader], Any], *, is_least: bool,
    ) -> None:  # fmt: skip
        self.count, self.column_count = values.shape
        self._table, self._make, self._is_least = table, make, is_least
        self._has_places = (places != table.no_place).any(axis=0)
        with dr.suspend_grad():
            self._values = upload_floats(table.backend, values.ravel())
            self._places = upload_integers(table.backend, places.ravel())
            self._part_count = dr.opaque(table.backend.UInt32, self.count)

    def number(self, first: Index, column: int, *, is_attached: bool) -> Real:
        """The number in a column of the parts whose first numbers have the index `first`."""
        kind, table = self._table.backend.Float, self._table
        value = dr.gather(kind, self._values, first + column)
        if not (is_attached and self._has_places[column]):
            return value
        place = dr.gather(table.backend.UInt32, self._places, first + column)
        return dr.replace_grad(value, dr.gather(kind, table.table, place))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        """The extreme function at coordinates that are Dr.Jit numbers or dual numbers."""
        point = [dr.detach(v.value if isinstance(v, Dual) else v) for v in (x, y, z)]
        return self._at(self._extreme(point), x, y, z, is_attached=True)

    def _at(self, index: Index, x: Any, y: Any, z: Any, *, is_attached: bool) -> Any:
        """The function of the part with an index."""
        return self._make(_RowReader(self, index, is_attached=is_attached)).formula(x, y, z)

    def _extreme(self, point: list[Real]) -> Index:
        """The index of the part that has the extreme function at a point."""
        index, kind = self._table.backend.UInt32, self._table.backend.Float
        sign = 1 if self._is_least else -1
        width = dr.width(point)

        def next_part(k: Any, least: Any, best: Any) -> tuple[Any, Any, Any]:
            """Compare the part k."""
            value = kind(self._at(k, *point, is_attached=False)) * sign
            is_less = value < least
            return k + 1, dr.select(is_less, value, least), dr.select(is_less, k, best)

        def is_left(k: Any, least: Any, best: Any) -> Any:
            """Whether there are more parts."""
            del least, best
            return k < self._part_count

        with dr.suspend_grad():
            zero = dr.zeros(index, width)
            start = zero, dr.full(kind, dr.inf, width), zero
            return dr.while_loop(start, is_left, next_part, label="extreme part")[2]


def plain_numbers(value: Any) -> FloatArray:
    """The numbers of an array, or of nested lists and tuples, with Dr.Jit numbers, without
    derivatives. Of a vector with n lanes, (n, 3); of one with a single lane, (3,). Raises
    ValueError for entries of a list that have different shapes."""
    if isinstance(value, NumberSlice):
        return value.numbers
    if isinstance(value, tuple | list):
        entries = [plain_numbers(entry) for entry in cast("Sequence[Any]", value)]
        shapes = {np.shape(entry) for entry in entries}
        if len(shapes) > 1:
            shown = ", ".join("x".join(map(str, shape)) or "1" for shape in sorted(shapes))
            raise ValueError(f"of numbers in a list, all must be of one shape, not of {shown}")
        return np.array(entries)
    kind = cast("Any", type(value))
    if not dr.is_array_v(kind):
        return np.asarray(value, np.float64)
    if dr.is_tensor_v(kind):
        return np.array(dr.detach(value), np.float64)
    # By component: to join literals, other numbers would need another kernel.
    columns = [np.array(dr.detach(component), np.float64) for component in components_of(value)]
    numbers = np.stack(np.broadcast_arrays(*columns), axis=-1)
    numbers = numbers[:, 0] if dr.depth_v(kind) == 1 else numbers
    return numbers[0] if len(numbers) == 1 else numbers


def is_attached_number(value: Any, name: str) -> bool:
    """Whether a number, a vector or a matrix has derivatives, which are those of Dr.Jit numbers.
    Raises NotImplementedError for other values that carry derivatives."""
    if not has_derivatives(value):
        return False
    pending: list[Any] = [value]
    for entry in pending:  # the list grows in this loop
        if isinstance(entry, tuple | list):
            pending += cast("Any", entry)
        elif not isinstance(entry, NumberSlice | dr.ArrayBase):
            check_no_derivatives(name, entry)
    return True


def detached(value: Any) -> Any:
    """What holds Dr.Jit arrays, without derivatives, as a NumPy array; all else as it is."""
    return plain_numbers(value) if _holds_arrays(value) else value


def _holds_arrays(value: Any) -> bool:
    """Whether a value is a Dr.Jit array, or a list or tuple with such."""
    if isinstance(value, tuple | list):
        return any(map(_holds_arrays, cast("Sequence[Any]", value)))
    return isinstance(value, NumberSlice) or dr.is_array_v(cast("Any", type(value)))


def components_of(array: Any) -> list[Any]:
    """The arrays of one dimension that a Dr.Jit array consists of."""
    if dr.is_tensor_v(array):
        return [array.array]
    if dr.depth_v(array) > 1:
        return [inner for component in array for inner in components_of(component)]
    return [array]
