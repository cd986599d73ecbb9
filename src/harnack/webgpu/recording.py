"""Records the kernel of a computation by Dr.Jit, and finds out which array each of its parameters
is. A kernel is the program that Dr.Jit compiles for a computation; it runs once for each lane, that
is for each entry of its arrays. Dr.Jit records operations and runs them as a kernel when their
result is evaluated, that is, needed in memory. A label is a name for an array.

A kernel's text distinguishes its arrays only by the positions of their pointers. But Dr.Jit also
prints labels as comments: `drjit.set_label` labels a variable, and `JitFlag.PrintIR` prints labels.
An array that a kernel reads at computed indices is identified by the label of the result of
`drjit.gather`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import inspect
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr

from harnack.webgpu.llvm_parser import parse
from harnack.webgpu.wgsl import Shader, to_shader

__all__ = ["RecordedKernel", "labeled_leaves", "record_kernel"]

# A flag of Dr.Jit and its function `gather` are changed for all threads while a kernel is recorded.
_RECORDING_LOCK = threading.Lock()


@dataclass(frozen=True)
class RecordedKernel:
    """A kernel as a shader (a program in WGSL, WebGPU's language), and the arrays that it reads and
    writes, by their labels.

    data: the numbers and tables that the kernel reads.
    results: Dr.Jit's own results for the lanes of the recording.
    constants: results that are the same constant for all lanes, which the kernel does not compute.
    """

    shader: Shader
    data: dict[str, Any]
    results: dict[str, Any]
    constants: dict[str, Any]


def record_kernel(
    compute: Callable[..., Mapping[str, Any]], lanes: Mapping[str, Any], data: Any
) -> RecordedKernel:
    """Record the kernel of `compute(**lanes)`. It also runs on Dr.Jit's own backend for these
    lanes. Returns the kernel with the results.

    compute: returns arrays by name, none of them evaluated, all from a single kernel.
    lanes: arrays by name, of the same length of at least 2.
    data: an object that contains all other arrays that `compute` reads; it is searched for them.

    Raises:
        UntranslatableError: the kernel contains an unknown operation.
        RuntimeError: the computation is more than one kernel.
    """
    with _RECORDING_LOCK:
        labels = _ArrayLabels()
        for label, array in labeled_leaves("lane", dict(lanes)):
            dr.set_label(array, label)
        for array in _find_arrays(data):
            labels.label_array(array)
        with dr.suspend_grad(), labels.label_gathers(), _switches_as_conditions():
            outputs = compute(**lanes)
        results = dict(labeled_leaves("result", dict(outputs)))
        # Constants need no kernel.
        computed = {k: value for k, value in results.items() if not _is_constant(value)}
        for label, array in computed.items():
            dr.set_label(array, label)
        text = _evaluate_and_get_ir(list(computed.values()))
    constants = {label: value for label, value in results.items() if label not in computed}
    return RecordedKernel(_cached_shader(text), labels.labeled_arrays, computed, constants)


@functools.lru_cache(maxsize=64)
def _cached_shader(text: str) -> Shader:
    """Translate the text of a kernel in LLVM's language into a shader. The 64 shaders used last are
    kept."""
    return to_shader(parse(text))


def _is_constant(array: Any) -> bool:
    """Return whether a Dr.Jit array is a literal: a constant in the code of kernels."""
    return array.state == dr.VarState.Literal


def _evaluate_and_get_ir(arrays: list[Any]) -> str:
    """Evaluate arrays, and return the text, in LLVM's language, of the kernel that computed them.

    Raises:
        RuntimeError: that took more than one kernel, or none.
    """
    with (
        _garbage_collection_paused(),
        dr.scoped_set_flag(dr.JitFlag.KernelHistory, True),
        dr.scoped_set_flag(dr.JitFlag.PrintIR, True),
        # The flag also prints the kernel, in this thread.
        contextlib.redirect_stdout(cast("Any", _SilencedThread(sys.stdout))),
    ):
        dr.kernel_history_clear()
        dr.eval(arrays)
        kernels = [kernel for kernel in dr.kernel_history() if kernel.get("ir") is not None]
    if len(kernels) != 1:
        raise RuntimeError(f"this computation is {len(kernels)} kernels, and not one")
    return kernels[0]["ir"].getvalue()


class _SilencedThread:
    """A stream that drops what the thread that made it writes, and passes on to `stream` all that
    other threads write."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._thread = stream, threading.get_ident()

    def write(self, text: str) -> int:
        """Write a text, unless this is the silenced thread."""
        return len(text) if threading.get_ident() == self._thread else self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def _garbage_collection_paused() -> Generator[None]:
    """Context manager within which no thread collects garbage.

    This avoids a deadlock. To print a kernel, Dr.Jit waits for Python's lock while it holds its own
    lock. A thread that collects garbage holds Python's lock, and may wait for Dr.Jit's lock to free
    an array.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def _switches_as_conditions() -> Generator[None]:
    """Context manager within which `drjit.switch` of this thread records conditional statements.

    Dr.Jit calls the functions of a switch by a table of addresses, which is no part of a kernel's
    text. The conditions form a binary tree, so that a lane evaluates few of them.
    """
    module = cast("Any", dr)
    original, thread = module.switch, threading.get_ident()

    def switch(index: Any, targets: Sequence[Callable[..., Any]], *args: Any, **kwargs: Any) -> Any:
        """Call `drjit.switch` with these arguments, or do the same by conditional statements if
        this thread records."""
        if threading.get_ident() != thread or kwargs:
            return original(index, targets, *args, **kwargs)
        if len(targets) == 1:
            return targets[0](*args)
        middle = len(targets) // 2

        def first_half(index: Any, *args: Any) -> Any:
            """Call one of the targets before the middle."""
            return switch(index, targets[:middle], *args)

        def second_half(index: Any, *args: Any) -> Any:
            """Call one of the other targets."""
            return switch(index - middle, targets[middle:], *args)

        return dr.if_stmt((index, *args), index < middle, first_half, second_half)

    module.switch = switch
    try:
        yield
    finally:
        module.switch = original


class _ArrayLabels:
    """Gives labels (names) to the arrays that a kernel reads, so that the text of the kernel says
    which is which. Labels are numbered in the order of the calls. An array is evaluated if its
    numbers are in memory; otherwise a kernel still has to compute them.

    Labels are part of the text of a kernel. Data of the same structure get the same labels, so that
    their kernel is neither translated nor compiled again.

    labeled_arrays: the arrays by label.
    """

    def __init__(self) -> None:
        self.labeled_arrays: dict[str, Any] = {}
        self._tables: dict[int, str] = {}

    def label_array(self, array: Any) -> None:
        """Give an evaluated array the next label; an array that is not evaluated gets none."""
        if array.state == dr.VarState.Evaluated:
            label = f"data {len(self.labeled_arrays)}"
            dr.set_label(array, label)
            self.labeled_arrays[label] = array

    @contextlib.contextmanager
    def label_gathers(self) -> Generator[None]:
        """Context manager within which the result of each `drjit.gather` of this thread gets the
        label of the array that was read. It replaces the function `drjit.gather` meanwhile, which
        does for other threads what it always does."""
        module = cast("Any", dr)
        original, thread = module.gather, threading.get_ident()

        def gather(dtype: Any, source: Any, index: Any, *args: Any, **kwargs: Any) -> Any:
            """Call `drjit.gather` with these arguments, and label its result if this thread
            records. source: the array that is read."""
            gathered = original(dtype, source, index, *args, **kwargs)
            is_array = dr.is_array_v(type(source)) and dr.depth_v(type(source)) == 1
            if is_array and threading.get_ident() == thread:
                self._label_gathered(gathered, source)
            return gathered

        module.gather = gather
        try:
            yield
        finally:
            module.gather = original

    def _label_gathered(self, gathered: Any, source: Any) -> None:
        """Label the numbers that `drjit.gather` has read from the array `source`, so that the
        inputs of the kernel can be told from its text. Vectors are labeled component by component.

        Normally the kernel itself reads the numbers, and they get the label of `source`. But
        numbers at constant indices are read by Dr.Jit at once. They are then evaluated arrays and
        inputs of their own, which get the next label.
        """
        for _, component in labeled_leaves("", gathered):
            if component.state == dr.VarState.Evaluated:  # read at constant indices
                self.label_array(component)
            elif source.state == dr.VarState.Evaluated:
                dr.set_label(component, self._table_label(source))

    def _table_label(self, source: Any) -> str:
        """Return the label of an evaluated array from which lanes read. The array gets one at the
        first call."""
        if source.index not in self._tables:
            label = f"table {len(self._tables)}"
            self._tables[source.index] = label
            # A reference keeps the array alive, so that no other array gets its index.
            self.labeled_arrays[label] = type(source)(source)
        return self._tables[source.index]


def labeled_leaves(name: str, value: Any) -> list[tuple[str, Any]]:
    """Find the one-dimensional Dr.Jit arrays in a value. Returns them as pairs (label, array). The
    label is `name` followed by the keys and indices that lead to the array, such as "lane o 0" for
    component 0 of the entry "o".

    value: a dictionary, a Dr.Jit vector or nested array; other values contain none.
    """
    if dr.is_array_v(type(value)):
        if (
            dr.depth_v(type(value)) == 1
            and dr.size_v(type(value)) == dr.Dynamic
            and dr.is_jit_v(value)
        ):
            return [(name, value)]
        return [leaf for k in range(len(value)) for leaf in labeled_leaves(f"{name} {k}", value[k])]
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return [leaf for key, entry in items for leaf in labeled_leaves(f"{name} {key}", entry)]
    return []


def _find_arrays(data: Any) -> Iterator[Any]:
    """Yield the one-dimensional Dr.Jit arrays in an object and in all objects that it refers to,
    each once, in an order that depends only on the structure of the object."""
    visited: set[int] = set()
    pending: list[Any] = [data]
    # The search is breadth-first. Objects that were seen before are skipped, so cycles end.
    while pending:
        node = pending.pop(0)
        if id(node) in visited or isinstance(
            node, type | str | bytes | int | float | None.__class__
        ):
            continue
        visited.add(id(node))
        if dr.is_array_v(type(node)):
            for _, leaf in labeled_leaves("", node):
                yield leaf
        elif isinstance(node, dict):
            pending += node.values()
        elif isinstance(node, list | tuple):
            pending += node
        elif inspect.ismethod(node):
            pending.append(node.__self__)
        elif dataclasses.is_dataclass(node) or hasattr(node, "__dict__"):
            pending += vars(node).values()
