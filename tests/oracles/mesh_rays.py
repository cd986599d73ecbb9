"""Rays that are hard on meshes."""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend import FloatArray


def mesh_rays(
    vertices: FloatArray, faces: Any, n: int, seed: int, low: Any, high: Any
) -> tuple[FloatArray, FloatArray]:
    """Origins and unit directions (n, 3) of rays past a mesh of size about one.

    A quarter of them starts anywhere in the box from low to high, the others at 2.6 from the
    origin. Half are aimed at vertices, edges and faces, passing them by 1e-4 to 1e-2, the others
    anywhere into the box. Origins can be told exactly in single precision.
    """
    rng = np.random.default_rng(seed)
    o = 2.6 * _unit(rng.normal(size=(n, 3)))
    o[: n // 4] = rng.uniform(low, high, (n // 4, 3))
    target = rng.uniform(low, high, (n, 3))
    m = n // 2
    face = vertices[faces[rng.integers(len(faces), size=m)]]
    weights = rng.dirichlet(np.ones(3), m)
    weights[: m // 4] = [1, 0, 0]
    weights[m // 4 : m // 2] = [0.5, 0.5, 0]
    aside = 10 ** rng.uniform(-4, -2, (m, 1)) * _unit(rng.normal(size=(m, 3)))
    target[n - m :] = np.einsum("nv,nvk->nk", weights, face) + aside
    o, target = (one.astype(np.float32).astype(np.float64) for one in (o, target))
    return o, _unit(target - o)


def _unit(v: FloatArray) -> FloatArray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
