"""Arrays in the local memory of kernels: each lane has its own, which is read and written at
indices that are computed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend.arrays import Backend

__all__ = ["allocate_local", "local_size"]

_MIN_SIZE = 16


def allocate_local(backend: Backend, size: int) -> Any:
    """An array of so many Floats in local memory, of which the last is 0.

    Dr.Jit 1.5 finds a kernel in its cache by its instructions, and the size of local arrays is not
    among them: of two kernels that differ in these alone, the second would run the first, beyond
    the end of its arrays. So an instruction has the size: the last number is set.
    """
    array = dr.alloc_local(backend.Float, size)
    array[backend.UInt32(size - 1)] = backend.Float(0)
    return array


def local_size(count: int) -> int:
    """The size of local arrays for `count` numbers: a power of two, so that kernels do not depend
    on the exact number."""
    return max(_MIN_SIZE, 1 << (count - 1).bit_length())
