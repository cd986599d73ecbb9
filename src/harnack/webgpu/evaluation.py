"""A computation on a device behind WebGPU, of which a sample is compared with Dr.Jit's answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import IntArray, backend_of, to_numpy
from harnack.backend.arrays import aligned_integers
from harnack.webgpu.device import Device
from harnack.webgpu.recording import leaves, record

__all__ = ["Arrays", "DeviceDisagreesError", "evaluate"]

Arrays: TypeAlias = "dict[str, npt.NDArray[Any]]"
# Lanes that Dr.Jit computes as well: spread evenly over all.
_SAMPLE = 4096


class DeviceDisagreesError(RuntimeError):
    """A device does not compute what Dr.Jit does."""


def evaluate(
    device: Device,
    compute: Callable[..., Mapping[str, Any]],
    lanes: Mapping[str, Any],
    data: Any,
    differences: Callable[[IntArray, Arrays, Arrays], str],
) -> Arrays:
    """What `compute(**lanes)` gives, as NumPy arrays by name, computed on a device.

    compute, data: as `recording.record` takes them. lanes: Dr.Jit arrays of n entries each.
    differences: of some lanes, Dr.Jit's answers and the device's, says what is wrong with the last;
        nothing if they agree.

    Raises:
        UntranslatableError: the kernel holds what is not known.
        DeviceDisagreesError: the answers differ.
    """
    count = max(dr.width(one) for one in lanes.values())
    # Two at least: a single lane would be a number.
    some = max(2, min(count, _SAMPLE))
    rows: IntArray = np.arange(some) * (count - 1) // (some - 1)
    recording = record(compute, {name: _some(one, rows) for name, one in lanes.items()}, data)
    program = device.compile(recording.shader)
    given = {label: to_numpy(one) for label, one in leaves("lane", dict(lanes))}
    bits = program.run(recording.data, given, count)
    expected: Arrays = {}
    found: Arrays = {}
    for label, one in recording.results.items():
        expected[label] = to_numpy(one)
        found[label] = bits[label].view(expected[label].dtype)
    for label, one in recording.constants.items():
        expected[label] = np.full(len(rows), to_numpy(one)[0])
        found[label] = np.full(count, to_numpy(one)[0])
    sample = {label: one[rows] for label, one in found.items()}
    wrong = differences(rows, _named(expected), _named(sample))
    if wrong:
        raise DeviceDisagreesError(
            f"{device.name} does not compute what Dr.Jit does: {wrong}. Nothing that it says is "
            "used: leave out backend"
        )
    return _named(found)


def _some(array: Any, rows: npt.NDArray[np.int64]) -> Any:
    index = aligned_integers(backend_of(array), rows.astype(np.uint32))
    some = dr.gather(type(array), array, index)
    dr.make_opaque(some)
    return some


def _named(columns: Arrays) -> Arrays:
    """Columns "result name" and "result name k" as arrays (n,) and (n, 3) by name."""
    parts: dict[str, list[npt.NDArray[Any]]] = {}
    for label, column in columns.items():
        parts.setdefault(label.split()[1], []).append(column)
    return {
        name: several[0] if len(several) == 1 else np.column_stack(several)
        for name, several in parts.items()
    }
