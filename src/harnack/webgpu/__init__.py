"""Kernels that Dr.Jit recorded, on any GPU: translated, run, and compared with Dr.Jit."""

from __future__ import annotations

from harnack.webgpu.device import Device, NoDeviceError, bits_of, data_of, find_device
from harnack.webgpu.evaluation import Arrays, DeviceDisagreesError, evaluate
from harnack.webgpu.kernel import UntranslatableError
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
