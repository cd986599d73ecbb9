"""What a person turns is data: other curves, levels, tolerances and cameras compile no kernel."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.geometry.mesh_shapes import icosphere


def knot(k: int) -> hk.Field:
    t = np.linspace(0, 2 * np.pi, 60 + k, endpoint=False)
    x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    return hk.SolidAngle((1 + 0.1 * k) * np.column_stack([x, y, -np.sin(3 * t)]) + k)


def cut_sphere(k: int) -> hk.Field:
    vertices, faces = icosphere(2)
    return hk.WindingNumber((1 + 0.1 * k) * vertices, faces[np.arange(len(faces)) % (5 + k) > 0])


def tree(k: int) -> hk.Field:
    vertices, faces = icosphere(2)
    kept = faces[np.arange(len(faces)) % (5 + k) > 0]
    return hk.WindingNumber((1 + 0.1 * k) * vertices, kept, method="tree")


def cloud(k: int) -> hk.Field:
    vertices, _ = icosphere(3)
    return hk.DipolePotential((1 + 0.1 * k) * vertices, vertices)


@pytest.mark.parametrize(
    ("make", "level"),
    [(knot, 6.0), (cut_sphere, 0.5), (tree, 0.5), (cloud, 6.0)],
)
def test_another_surface_compiles_no_kernel(make: Callable[[int], hk.Field], level: float) -> None:
    rng = np.random.default_rng(0)

    def trace(k: int) -> int:
        o = np.tile([3.0 + 0.1 * k, -2.0, 2.0], (300, 1))
        d = 0.4 * rng.normal(size=(300, 3)) - o
        dr.kernel_history_clear()
        hk.trace(make(k), o, d, level=level * (1 - 0.01 * k), tolerance=1e-4 * (1 + 0.1 * k))
        kernels = dr.kernel_history((dr.KernelType.JIT,))
        # Of rays: those that pack a tree are small, and come in a few kinds by its size.
        return sum(not kernel["cache_hit"] and kernel["size"] == 300 for kernel in kernels)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        trace(0), trace(1)
        assert [trace(k) for k in range(2, 22)] == [0] * 20
