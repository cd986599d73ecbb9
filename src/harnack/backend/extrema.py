"""Minimum, maximum and clamp as one instruction each.

`drjit.minimum` follows IEEE 754's NaN-propagating `minimum`, three instructions with AVX2 (and
a crash with LLVM 15 and 16). A comparison and a select become a single `minps`. With a NaN in
either place the *second* argument is returned: put the safe value there.
"""

from __future__ import annotations

from typing import Any

import drjit as dr


def fmin(a: Any, b: Any) -> Any:
    """The smaller of a and b; b if either is NaN."""
    return dr.select(a < b, a, b)


def fmax(a: Any, b: Any) -> Any:
    """The larger of a and b; b if either is NaN."""
    return dr.select(a > b, a, b)


def clamp(x: Any, low: Any, high: Any) -> Any:
    """x limited to [low, high]; low if x is NaN."""
    return fmin(fmax(x, low), high)
