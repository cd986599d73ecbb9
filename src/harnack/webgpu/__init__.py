"""Kernels that Dr.Jit recorded, on any GPU: translated, run, and compared with Dr.Jit."""

from __future__ import annotations

from harnack.webgpu.device import (
    Arrays,
    Device,
    DeviceDisagreesError,
    NoDeviceError,
    bits_of,
    data_of,
    evaluate,
    find_device,
)
from harnack.webgpu.llvm_parser import UntranslatableError
from harnack.webgpu.recording import Recording, leaves, record

__all__ = [
    "Arrays",
    "Device",
    "DeviceDisagreesError",
    "NoDeviceError",
    "Recording",
    "UntranslatableError",
    "bits_of",
    "data_of",
    "evaluate",
    "find_device",
    "leaves",
    "record",
]
