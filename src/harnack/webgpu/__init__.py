"""Kernels that Dr.Jit recorded, on any GPU: translated, run, and compared with Dr.Jit.

Other GPUs get the recorded kernel: the text that Dr.Jit writes for LLVM is what a lane does, loops
and all, and is read back (`llvm_parser`) and written as WGSL (`wgsl`). Which pointer is which array
is known by labels, which Dr.Jit prints (`recording`). No field is written twice, and none is
trusted: a sample of each call's rays is compared with Dr.Jit's own answers (`device`).
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
