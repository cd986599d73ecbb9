"""Runs shaders (programs in WGSL, WebGPU's language) on a GPU, and compares a sample of the results
with Dr.Jit's. A shader runs once for each lane, that is for each entry of its input arrays, such as
a ray. A label is the name by which the caller and the shader identify an array. A table is an array
that lanes read at computed indices.

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
from harnack.optional_packages import import_optional
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
# Seconds that a dispatch should take: the system may kill a program that blocks the display. The
# number of lanes of a dispatch is doubled below the first, and halved above the second.
_MIN_DISPATCH_SECONDS, _MAX_DISPATCH_SECONDS = 0.1, 0.4
_INITIAL_BATCH, _MAX_BATCH = 1 << 15, 1 << 21
# The largest number of workgroups along an axis, on every device.
_MAX_WORKGROUPS_PER_AXIS = 65535
# Number of shaders that stay compiled.
_SHADER_CACHE_SIZE = 64


class NoDeviceError(RuntimeError):
    """The error if WebGPU finds no device, or the package `wgpu` is not installed."""


@dataclass(frozen=True)
class Device:
    """A GPU that WebGPU drives. handle: the device object of the package `wgpu`. name: the device's
    own name."""

    handle: Any
    name: str

    @functools.lru_cache(maxsize=_SHADER_CACHE_SIZE)  # noqa: B019  # devices last as long as the process
    def compile(self, shader: Shader) -> CompiledShader:
        """Compile a shader for this device. The 64 shaders used last stay compiled."""
        module = self.handle.create_shader_module(code=shader.code)
        pipeline = self.handle.create_compute_pipeline(
            layout="auto", compute={"module": module, "entry_point": "main"}
        )
        return CompiledShader(self, shader, pipeline)


@functools.cache
def find_device() -> Device:
    """Return the fastest WebGPU device of this machine.

    Raises:
        NoDeviceError: there is no device, or the package `wgpu` is not installed.
    """
    message = 'backend="webgpu" needs the package wgpu: pip install "harnack[webgpu]"'
    try:
        wgpu = import_optional("wgpu", message)
    except ModuleNotFoundError:
        raise NoDeviceError(message) from None
    try:
        adapter: Any = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as error:
        raise NoDeviceError(f"no device for WebGPU was found: {error}") from None
    # Ask for buffers as large as the device allows; WebGPU's default limits are smaller.
    names = ("max-storage-buffer-binding-size", "max-buffer-size")
    limits = {name: adapter.limits[name] for name in names}
    info = adapter.info
    name = f"{info['device']} ({info['backend_type']})"
    return Device(adapter.request_device_sync(required_limits=limits), name)


@dataclass(frozen=True)
class CompiledShader:
    """A shader (a program in WGSL, WebGPU's language) that is compiled for a device. It runs once
    for each lane, that is for each entry of its input arrays. A label is the name of an array.
    pipeline: the compute pipeline of the package `wgpu`."""

    device: Device
    shader: Shader
    pipeline: Any

    def run(self, data: Mapping[str, Any], lanes: Mapping[str, Any]) -> dict[str, Words]:
        """Run the shader on all lanes. Returns the results by label, each as the 32 bits of its
        numbers, (count,).

        data: the numbers and tables that the shader reads, by label.
        lanes: arrays (count,) with an entry for each lane, by label.

        The lanes are computed in batches whose size is adapted so that each takes a fraction of a
        second.
        """
        lane_words = [as_words(lanes[label]) for label in self.shader.lanes]
        results = self.run_words(pack_shader_data(self.shader, data), np.stack(lane_words))
        return dict(zip(self.shader.results, results, strict=True))

    def run_words(self, data: Words, lanes: Words) -> Words:
        """Do what `run` does with arrays that are packed already. Returns the bits of the results,
        (number of results, count).

        data: the buffer of numbers and tables, as `pack_shader_data` returns it.
        lanes: (number of arrays, count) the bits of each array with an entry per lane.
        """
        import wgpu

        usage = wgpu.BufferUsage
        data_buffer = self.device.handle.create_buffer_with_data(
            data=data, usage=usage.STORAGE | usage.COPY_DST
        )
        count = lanes.shape[1]
        results = np.empty((len(self.shader.results), count), np.uint32)
        start, batch_size = 0, _INITIAL_BATCH
        while start < count:
            end = min(start + batch_size, count)
            start_time = time.perf_counter()
            results[:, start:end] = self._dispatch(data_buffer, lanes[:, start:end])
            elapsed = time.perf_counter() - start_time
            # Long computations may block the display, and short ones waste time on their start.
            if elapsed < _MIN_DISPATCH_SECONDS and batch_size < _MAX_BATCH:
                batch_size *= 2
            elif elapsed > _MAX_DISPATCH_SECONDS and batch_size > WORKGROUP:
                batch_size //= 2
            start = end
        data_buffer.destroy()
        return results

    def _dispatch(self, data_buffer: Any, lanes: Words) -> Words:
        """Run the shader on all of these lanes at once. Returns the bits of its results, (number of
        results, count).

        data_buffer: the numbers and tables on the device.
        lanes: (number of arrays, count) the bits of each array with an entry per lane.
        """
        import wgpu

        handle, usage = self.device.handle, wgpu.BufferUsage
        count = lanes.shape[1]
        # The first word of the data is the number of lanes.
        handle.queue.write_buffer(data_buffer, 0, np.array([count], np.uint32))
        result_bytes = 4 * count * len(self.shader.results)
        buffers = [
            data_buffer,
            handle.create_buffer_with_data(data=np.ascontiguousarray(lanes), usage=usage.STORAGE),
            handle.create_buffer(size=result_bytes, usage=usage.STORAGE | usage.COPY_SRC),
        ]
        entries = [
            {"binding": k, "resource": {"buffer": buffer}} for k, buffer in enumerate(buffers)
        ]
        # The shader's three buffers are bindings 0 to 2 of its only group, 0.
        layout = self.pipeline.get_bind_group_layout(0)
        encoder = handle.create_command_encoder()
        compute_pass = encoder.begin_compute_pass()
        compute_pass.set_pipeline(self.pipeline)
        compute_pass.set_bind_group(0, handle.create_bind_group(layout=layout, entries=entries))
        # Quotients are rounded up: surplus lanes end at once, as the shader compares with `count`.
        groups = -(-count // WORKGROUP)
        # The groups of lanes are arranged in a rectangle, as each axis is limited.
        groups_a_row = min(groups, _MAX_WORKGROUPS_PER_AXIS)
        compute_pass.dispatch_workgroups(groups_a_row, -(-groups // groups_a_row))
        compute_pass.end()
        handle.queue.submit([encoder.finish()])
        result_words: Words = np.frombuffer(handle.queue.read_buffer(buffers[2]), dtype=np.uint32)
        for buffer in buffers[1:]:
            buffer.destroy()
        return result_words.reshape(-1, count)


def pack_shader_data(shader: Shader, data: Mapping[str, Any]) -> Words:
    """Return the buffer of numbers and tables that a shader reads, as 32-bit words (see `Shader`
    for its layout). The number of lanes, its first word, is 0.

    data: the numbers and tables by label.
    """
    tables = [as_words(data[label]) for label in shader.tables]
    numbers = [as_words(data[label])[:1] for label in shader.numbers]
    # Before the tables stand two words (the number of lanes, and 0), the start of each table, and
    # the numbers.
    tables_start = 2 + len(tables) + len(numbers)
    table_starts = tables_start + np.cumsum([0, *map(len, tables)])[:-1].astype(np.uint32)
    header = np.zeros(2, np.uint32)
    return np.concatenate([header, table_starts, *numbers, *tables]).astype(np.uint32)


def as_words(array: Any) -> Words:
    """Return the entries of a number or array as 32-bit words (n,): the bits of 32-bit floats and
    integers. Numbers of other types are converted to integers first."""
    values: npt.NDArray[Any] = np.atleast_1d(
        to_numpy(array) if dr.is_array_v(type(array)) else array
    )
    if values.dtype.itemsize != 4:
        values = values.astype(np.uint32)
    return np.ascontiguousarray(values).view(np.uint32)


# Whole computations.

Arrays: TypeAlias = "dict[str, npt.NDArray[Any]]"
# Number of lanes that Dr.Jit computes as well, spread evenly over all lanes.
_CHECKED_LANES = 4096


class DeviceMismatchError(RuntimeError):
    """The error if the results of a device disagree with Dr.Jit's results for a sample of the
    lanes."""


def evaluate_on_device(
    device: Device,
    compute: Callable[..., Mapping[str, Any]],
    lanes: Mapping[str, Any],
    data: Any,
    find_mismatch: Callable[[IntArray, Arrays, Arrays], str],
) -> Arrays:
    """Evaluate `compute(**lanes)` on a device. Returns NumPy arrays by name.

    compute: a function of Dr.Jit arrays that returns Dr.Jit arrays by name, computed by a single
        kernel.
    lanes: Dr.Jit arrays of n entries each, by name.
    data: an object that contains all other arrays that `compute` reads.
    find_mismatch: compares results for a sample of the lanes. It is called with the indices of
        these lanes, Dr.Jit's results and the device's results, and returns a description of an
        error of the device, or "" if the results agree.

    The kernel is recorded while Dr.Jit computes the sample itself.

    Raises:
        UntranslatableError: the kernel contains an unknown operation.
        DeviceMismatchError: the results differ.
    """
    count = max(dr.width(array) for array in lanes.values())
    # At least two: a single lane would be a number.
    sample_count = max(2, min(count, _CHECKED_LANES))
    sample_lanes: IntArray = np.arange(sample_count) * (count - 1) // (sample_count - 1)
    recording = record_kernel(
        compute, {name: _gather_lanes(array, sample_lanes) for name, array in lanes.items()}, data
    )
    compiled = device.compile(recording.shader)
    lane_arrays = {label: to_numpy(array) for label, array in labeled_leaves("lane", dict(lanes))}
    bits = compiled.run(recording.data, lane_arrays)
    expected: Arrays = {}
    results: Arrays = {}
    for label, array in recording.results.items():
        expected[label] = to_numpy(array)
        results[label] = bits[label].view(expected[label].dtype)
    # Results that are the same constant for all lanes are not computed by the kernel.
    for label, array in recording.constants.items():
        expected[label] = np.full(len(sample_lanes), to_numpy(array)[0])
        results[label] = np.full(count, to_numpy(array)[0])
    device_sample = {label: array[sample_lanes] for label, array in results.items()}
    mismatch = find_mismatch(
        sample_lanes, _columns_to_arrays(expected), _columns_to_arrays(device_sample)
    )
    if mismatch:
        raise DeviceMismatchError(
            f"{device.name} does not compute what Dr.Jit does: {mismatch}. Nothing that it says is "
            "used: leave out backend"
        )
    return _columns_to_arrays(results)


def _gather_lanes(array: Any, rows: npt.NDArray[np.int64]) -> Any:
    """Return the entries of a Dr.Jit array or vector at the indices `rows` (k,), evaluated."""
    index = upload_integers(backend_of(array), rows.astype(np.uint32))
    gathered = dr.gather(type(array), array, index)
    dr.make_opaque(gathered)
    return gathered


def _columns_to_arrays(columns: Arrays) -> Arrays:
    """Put components together to vectors. Returns the results by name, each an array (n,) or
    (n, 3).

    columns: arrays (n,) with the labels "result NAME" for numbers, or "result NAME k" for component
        k of a vector.
    """
    groups: dict[str, list[npt.NDArray[Any]]] = {}
    for label, column in columns.items():
        groups.setdefault(label.split()[1], []).append(column)
    return {
        name: group[0] if len(group) == 1 else np.column_stack(group)
        for name, group in groups.items()
    }
