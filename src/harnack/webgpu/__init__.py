"""Kernels that Dr.Jit recorded, translated for any GPU behind WebGPU, run there, and compared with
Dr.Jit.

Dr.Jit prints a recorded kernel as a program for LLVM, loops included. That text is parsed
(`llvm_parser`) and written as WGSL (`wgsl`). Labels, which Dr.Jit prints, tell which pointer is
which array (`recording`). So no field is implemented twice; and the result is not trusted: a sample
of the rays of each call is compared with Dr.Jit's own results (`device`).
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
from harnack.webgpu.llvm_parser import UntranslatableError
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
