"""Translates kernels that Dr.Jit recorded for GPUs that WebGPU supports, runs them there, and
compares the results with Dr.Jit's. A kernel is the program that Dr.Jit compiles for a computation
on arrays; it runs once for each lane, that is for each entry of the arrays, such as a ray.

Dr.Jit prints a recorded kernel, loops included, as a program in LLVM's language. `llvm_parser`
parses this text to statements (`kernel`), and `wgsl` writes them in WGSL, WebGPU's language. Labels
that Dr.Jit prints tell which array each pointer belongs to (`recording`). So no field is
implemented twice. The results are not trusted: for a sample of the rays of each call they are
compared with Dr.Jit's own results (`device`).
"""

from __future__ import annotations

from harnack.webgpu.device import (
    Arrays,
    Device,
    DeviceMismatchError,
    NoDeviceError,
    as_words,
    evaluate_on_device,
    find_device,
    pack_shader_data,
)
from harnack.webgpu.kernel import UntranslatableError
from harnack.webgpu.recording import RecordedKernel, labeled_leaves, record_kernel

__all__ = [
    "Arrays",
    "Device",
    "DeviceMismatchError",
    "NoDeviceError",
    "RecordedKernel",
    "UntranslatableError",
    "as_words",
    "evaluate_on_device",
    "find_device",
    "labeled_leaves",
    "pack_shader_data",
    "record_kernel",
]
