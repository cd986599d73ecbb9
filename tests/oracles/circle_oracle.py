"""Solid angles of circles in double precision, by Carlson's integrals: no code and no formula is
shared with the library, which sums up arithmetic-geometric means."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import scipy.special

import harnack as hk
from harnack.backend import FloatArray
from tests.oracles.oracle import CurveOracle, OracleValues

__all__ = ["MixedOracle", "circle_values"]


@dataclass(frozen=True)
class MixedOracle:
    """The solid angle of polygons and circles, modulo 4 pi, with its gradient."""

    loops: Sequence[FloatArray]
    circles: Sequence[hk.geometry.Circle]

    def __call__(self, x: FloatArray) -> OracleValues:
        parts = [circle_values(circle, x) for circle in self.circles]
        if self.loops:
            parts.append(CurveOracle(self.loops)(x))
        value = np.sum([part.value for part in parts], axis=0)
        gradient = np.sum([part.gradient for part in parts], axis=0)
        smooth = np.min([part.smooth for part in parts], axis=0)
        return OracleValues(np.remainder(value + 2 * math.pi, 4 * math.pi) - 2 * math.pi,
                            gradient, smooth)  # fmt: skip


def circle_values(circle: hk.geometry.Circle, x: FloatArray) -> OracleValues:
    """Solid angle at points (n, 3), by the formulas of Paxton (1959) and of a current loop."""
    normal = np.array(circle.normal)
    away = (x - np.array(circle.center)) / circle.radius
    z = away @ normal
    outward = away - z[:, None] * normal
    r = np.linalg.norm(outward, axis=1)
    near, far = (1 - r) ** 2 + z * z, (1 + r) ** 2 + z * z
    kc = near / far  # squared
    special = cast("Any", scipy.special)
    k, e = special.ellipkm1(kc), special.ellipe(1 - kc)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Pi(n, m) = R_F + n/3 R_J at the characteristic n = 4r/(1+r)^2.
        gamma = ((1 - r) / (1 + r)) ** 2
        pi = special.elliprf(0, kc, 1) + (1 - gamma) / 3 * special.elliprj(
            0, kc, 1, np.where(r == 1, 1, gamma)
        )
        height = np.abs(z)
        third = 2 * height / np.sqrt(far) * (r - 1) / (r + 1) * pi
        w: FloatArray = np.where(r < 1, 2 * np.pi, 0) - 2 * height / np.sqrt(far) * k + third
        w = np.where(r == 1, np.pi - 2 * height / np.sqrt(far) * k, w)
        size = 1 + r * r + z * z
        # For r near 0 the difference cancels: C3 = 3 pi r/(1+z^2)^2.5 to first order.
        series = 3 * np.pi * (1 + z * z) ** -2.5
        across = np.where(r < 1e-4, series, 2 * (size * e / near - k) / (r * r * np.sqrt(far)))
        axial = 4 * e / (np.sqrt(far) * near) - r * r * across
    gradient = (z * across)[:, None] * outward + axial[:, None] * normal
    return OracleValues(
        np.where(z > 0, -w, w), gradient / circle.radius, circle.radius * np.sqrt(near)
    )
