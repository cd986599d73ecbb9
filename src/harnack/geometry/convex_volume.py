"""The array types under the name by which readers and pictures import them."""

from __future__ import annotations

from harnack.backend import BoolArray, FloatArray

__all__ = ["BoolArray", "FloatArray"]
