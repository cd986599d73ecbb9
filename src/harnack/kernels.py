"""Kernels of blobs: functions of the distance from a point. The level sets of their sums are
surfaces (`Blobs`)."""

from __future__ import annotations

from harnack.fields.blobs.kernels import (
    CompactKernel,
    CubicKernel,
    GaussianKernel,
    SexticKernel,
)

__all__ = ["CompactKernel", "CubicKernel", "GaussianKernel", "SexticKernel"]
