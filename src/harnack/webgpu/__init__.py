"""Kernels that Dr.Jit recorded, on any GPU: translated, run, and compared with Dr.Jit."""

from __future__ import annotations

from harnack.webgpu.device import Device, NoDeviceError, find_device
from harnack.webgpu.evaluation import Arrays, DeviceDisagreesError, evaluate
from harnack.webgpu.kernel import UntranslatableError

__all__ = [
    "Arrays",
    "Device",
    "DeviceDisagreesError",
    "NoDeviceError",
    "UntranslatableError",
    "evaluate",
    "find_device",
]
