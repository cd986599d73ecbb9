"""How large surfaces are, for tolerances that are a part of their size."""

from __future__ import annotations

import numpy as np

import harnack as hk


def longest_side(field: hk.Field) -> float:
    """The longest side of the box around the volume that is proved to hold a field's surface."""
    extent = field.extent((field.default_level,))
    assert extent is not None
    return float(np.ptp(np.array(extent.bounds()), axis=0).max())
