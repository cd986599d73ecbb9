"""Computation on a GPU behind WebGPU: shaders compiled and run, a sample compared with Dr.Jit.

The package `wgpu` drives the GPU through Vulkan, Metal or Direct3D.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import IntArray, backend_of, to_numpy
from harnack.backend.arrays import upload_integers
from harnack.webgpu.recording import labeled_leaves, record_kernel
from harnack.webgpu.wgsl import WORKGROUP, Shader

__all__ = [
    "Arrays",
    "CompiledShader",
    "Device",
    "DeviceMismatchError",
    "NoDeviceError",
    "Words",
    "as_words",
    "evaluate_on_device",
    "find_device",
    "pack_shader_data",
]

Words = npt.NDArray[np.uint32]
# Seconds that one dispatch should take: a system kills what keeps its display waiting.
_MIN_DISPATCH_SECONDS, _MAX_DISPATCH_SECONDS = 0.1, 0.4
_INITIAL_BATCH, _MAX_BATCH = 1 << 15, 1 << 21
# Workgroups along an axis, at most, on every device.
_MAX_WORKGROUPS_PER_AXIS = 65535
# Shaders that stay compiled.
_SHADER_CACHE_SIZE = 64


class NoDeviceError(RuntimeError):
    """There is no device behind WebGPU, or no package to reach it."""


@dataclass(frozen=True)
class Device:
    """A WebGPU device, and the name by which it identifies itself."""

    handle: Any
    name: str

    @functools.lru_cache(maxsize=_SHADER_CACHE_SIZE)  # noqa: B019  # devices last as long as the process
    def compile(self, shader: Shader) -> CompiledShader:
        """The compiled shader; each shader is compiled once."""
        module = self.handle.create_shader_module(code=shader.code)
        pipeline = self.handle.create_compute_pipeline(
            layout="auto", compute={"module": module, "entry_point": "main"}
        )
        return CompiledShader(self, shader, pipeline)


@functools.cache
def find_device() -> Device:
    """The fastest device that there is.

    Raises:
        NoDeviceError: there is none, or the package `wgpu` is missing.
    """
    try:
        import wgpu
    except ImportError:
        raise NoDeviceError(
            'backend="webgpu" needs the package wgpu: pip install "harnack[webgpu]"'
        ) from None
    try:
        adapter: Any = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as wrong:
        raise NoDeviceError(f"no device for WebGPU was found: {wrong}") from None
    wanted = ("max-storage-buffer-binding-size", "max-buffer-size")
    limits = {name: adapter.limits[name] for name in wanted}
    info = adapter.info
    name = f"{info['device']} ({info['backend_type']})"
    return Device(adapter.request_device_sync(required_limits=limits), name)


@dataclass(frozen=True)
class CompiledShader:
    """A shader, compiled for a device."""

    device: Device
    shader: Shader
    pipeline: Any

    def run(
        self, data: Mapping[str, Any], lanes: Mapping[str, Any], count: int
    ) -> dict[str, Words]:
        """Run the shader on `count` lanes. Returns the bits of each result, (count,), by label.

        data: by label, the numbers and tables that the shader reads.
        lanes: by label, arrays (count,).
        """
        made = pack_shader_data(self.shader, data)
        given = np.stack([as_words(lanes[label]) for label in self.shader.lanes])
        results = np.empty((len(self.shader.results), count), np.uint32)
        first, size = 0, _INITIAL_BATCH
        while first < count:
            last = min(first + size, count)
            start = time.perf_counter()
            results[:, first:last] = self._dispatch(made, given[:, first:last])
            took = time.perf_counter() - start
            if took < _MIN_DISPATCH_SECONDS and size < _MAX_BATCH:
                size *= 2
            elif took > _MAX_DISPATCH_SECONDS and size > WORKGROUP:
                size //= 2
            first = last
        return dict(zip(self.shader.results, results, strict=True))

    def _dispatch(self, data: Words, lanes: Words) -> Words:
        import wgpu

        handle, usage = self.device.handle, wgpu.BufferUsage
        count = lanes.shape[1]
        data = data.copy()
        data[0] = count
        size = 4 * count * len(self.shader.results)
        buffers = [
            handle.create_buffer_with_data(data=data, usage=usage.STORAGE),
            handle.create_buffer_with_data(data=np.ascontiguousarray(lanes), usage=usage.STORAGE),
            handle.create_buffer(size=size, usage=usage.STORAGE | usage.COPY_SRC),
        ]
        entries = [{"binding": k, "resource": {"buffer": one}} for k, one in enumerate(buffers)]
        layout = self.pipeline.get_bind_group_layout(0)
        encoder = handle.create_command_encoder()
        work = encoder.begin_compute_pass()
        work.set_pipeline(self.pipeline)
        work.set_bind_group(0, handle.create_bind_group(layout=layout, entries=entries))
        groups = -(-count // WORKGROUP)
        across = min(groups, _MAX_WORKGROUPS_PER_AXIS)
        work.dispatch_workgroups(across, -(-groups // across))
        work.end()
        handle.queue.submit([encoder.finish()])
        found: Words = np.frombuffer(handle.queue.read_buffer(buffers[2]), dtype=np.uint32)
        for one in buffers:
            one.destroy()
        return found.reshape(-1, count)


def pack_shader_data(shader: Shader, data: Mapping[str, Any]) -> Words:
    """The buffer of numbers and tables that a shader reads (`Shader`), with the number of lanes set
    to 0."""
    tables = [as_words(data[label]) for label in shader.tables]
    numbers = [as_words(data[label])[:1] for label in shader.numbers]
    begin = 2 + len(tables) + len(numbers)
    places = begin + np.cumsum([0, *map(len, tables)])[:-1].astype(np.uint32)
    head = np.zeros(2, np.uint32)
    return np.concatenate([head, places, *numbers, *tables]).astype(np.uint32)


def as_words(array: Any) -> Words:
    """The 32 bits of each entry."""
    values: npt.NDArray[Any] = np.atleast_1d(
        to_numpy(array) if dr.is_array_v(type(array)) else array
    )
    if values.dtype.itemsize != 4:
        values = values.astype(np.uint32)
    return np.ascontiguousarray(values).view(np.uint32)


# Whole computations.

Arrays: TypeAlias = "dict[str, npt.NDArray[Any]]"
# Lanes that Dr.Jit computes as well: spread evenly over all.
_CHECKED_LANES = 4096


class DeviceMismatchError(RuntimeError):
    """The results of a device differ from Dr.Jit's."""


def evaluate_on_device(
    device: Device,
    compute: Callable[..., Mapping[str, Any]],
    lanes: Mapping[str, Any],
    data: Any,
    find_mismatch: Callable[[IntArray, Arrays, Arrays], str],
) -> Arrays:
    """Evaluate `compute(**lanes)` on a device. Returns NumPy arrays by name.

    compute, data: as `record_kernel` takes them.
    lanes: Dr.Jit arrays of n entries each.
    find_mismatch: a function of a sample of the lanes, Dr.Jit's results there and the device's,
        which describes an error of the latter; it returns nothing if they agree.

    Raises:
        UntranslatableError: the kernel contains an unknown operation.
        DeviceMismatchError: the results differ.
    """
    count = max(dr.width(one) for one in lanes.values())
    # Two at least: a single lane would be a number.
    some = max(2, min(count, _CHECKED_LANES))
    rows: IntArray = np.arange(some) * (count - 1) // (some - 1)
    recording = record_kernel(
        compute, {name: _gather_lanes(one, rows) for name, one in lanes.items()}, data
    )
    program = device.compile(recording.shader)
    given = {label: to_numpy(one) for label, one in labeled_leaves("lane", dict(lanes))}
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
    wrong = find_mismatch(rows, _columns_to_arrays(expected), _columns_to_arrays(sample))
    if wrong:
        raise DeviceMismatchError(
            f"{device.name} does not compute what Dr.Jit does: {wrong}. Nothing that it says is "
            "used: leave out backend"
        )
    return _columns_to_arrays(found)


def _gather_lanes(array: Any, rows: npt.NDArray[np.int64]) -> Any:
    index = upload_integers(backend_of(array), rows.astype(np.uint32))
    some = dr.gather(type(array), array, index)
    dr.make_opaque(some)
    return some


def _columns_to_arrays(columns: Arrays) -> Arrays:
    """Columns "result name" and "result name k" as arrays (n,) and (n, 3) by name."""
    parts: dict[str, list[npt.NDArray[Any]]] = {}
    for label, column in columns.items():
        parts.setdefault(label.split()[1], []).append(column)
    return {
        name: several[0] if len(several) == 1 else np.column_stack(several)
        for name, several in parts.items()
    }
