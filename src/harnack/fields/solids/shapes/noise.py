"""Lattice noise: gradients at the points of a lattice, and what is proved about them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import drjit as dr

if TYPE_CHECKING:
    from harnack.backend import Real

Fade: TypeAlias = Literal["quintic", "cubic"]

CORNERS = tuple(itertools.product((0, 1), repeat=3))


@dataclass(frozen=True)
class NoiseConstants:
    """Bounds of noise on a lattice of unit length, with any unit vectors at its points.

    largest: of |noise|. slope: of |grad noise|. curvature: of all second derivatives.

    Proof. With weights w_c of the corners c of a cell and r_c = x - c, noise is sum w_c g_c.r_c.
    |noise| <= sum w_c |r_c| <= sqrt(sum w_c |r_c|^2), which is the root of three terms of at most
    1/4: s(t) lies below the line (1 + 2t)/4 up to its middle, for it is convex there. sqrt(3)/2 is
    attained in the middle.

    The derivative along v is sum g_c.(A_c v) with A_c = w_c I + r_c grad w_c^T, at most sum |A_c v|
    <= sqrt(v^T (sum A_c^T A_c / o_c) v) for weights o_c > 0 with the sum 1 (Cauchy and Schwarz).
    With the spectral norms of the A_c as weights the root of the largest eigenvalue is at most
    2.183 for the cubic and sqrt(499)/8 = 2.7923 for the quintic fade on a grid of the cell, and
    changes slowly between its points: 2.2 and 2.82 leave room for that. In the middle sqrt(19)/2 =
    2.1794 and sqrt(499)/8 are attained. Hart's 3 (1996, appendix F) is a bound, but its reason (3/2
    of the fade times 2 of the vectors) is none: values of a table have no Lipschitz constant.

    A second derivative d_ij is, in the same way along the other axes, at most a sum over the
    corners of one or two axes; the largest sum of a row of these bounds is one of the spectral norm
    of the Hessian: 17.64 and 24.35 on a grid.
    """

    largest: float
    slope: float
    curvature: float


CONSTANTS: dict[Fade, NoiseConstants] = {
    "cubic": NoiseConstants(math.sqrt(0.75), 2.2, 18.0),
    "quintic": NoiseConstants(math.sqrt(0.75), 2.82, 25.0),
}


def fade(kind: Fade, t: Any) -> tuple[Any, Any, Any]:
    """The weight of the farther end, 0 to 1, and its first two derivatives."""
    if kind == "cubic":
        return t * t * (3 - 2 * t), 6 * t * (1 - t), 6 - 12 * t
    rest = 1 - t
    return (
        t * t * t * (10 + t * (6 * t - 15)),
        30 * (t * rest) * (t * rest),
        60 * t * rest * (1 - 2 * t),
    )


def cell_noise(kind: Fade, t: Any, vectors: Any) -> tuple[Any, list[Any], list[Any]]:
    """Noise in a cell: value, gradient (3,) and Hessian (6,), rows of the upper triangle.

    t: (3,) where in the cell, 0 to 1. vectors: (8,) unit vectors (3,) at the corners, as `CORNERS`.
    """
    weights: list[tuple[tuple[Any, Any], ...]] = []
    for one in t:
        s, ds, dds = fade(kind, one)
        weights.append(((1 - s, s), (-ds, ds), (-dds, dds)))
    value: Any = 0.0
    gradient: list[Any] = [0.0] * 3
    hessian: list[Any] = [0.0] * 6

    def weight(corner: tuple[int, ...], orders: list[int]) -> Any:
        return (
            weights[0][orders[0]][corner[0]]
            * weights[1][orders[1]][corner[1]]
            * weights[2][orders[2]][corner[2]]
        )

    for corner, g in zip(CORNERS, vectors, strict=True):
        inner = sum(g[k] * (t[k] - corner[k]) for k in range(3))
        w = weight(corner, [0, 0, 0])
        value = value + w * inner
        dw = [weight(corner, [int(i == k) for i in range(3)]) for k in range(3)]
        for k in range(3):
            gradient[k] = gradient[k] + (w * g[k] + dw[k] * inner)
        for m, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
            orders = [int(i == k) + int(j == k) for k in range(3)]
            hessian[m] = hessian[m] + (dw[i] * g[j] + dw[j] * g[i] + weight(corner, orders) * inner)
    return value, gradient, hessian


def lattice_vector(x: Any, y: Any, z: Any, seed: Any, like: Real) -> list[Any]:
    """A unit vector that looks random, for integers (Dr.Jit, 32 bits without a sign)."""
    h = x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F + seed * 0x9E3779B1
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        h = (h ^ (h >> shift)) * factor
    h = h ^ (h >> 16)
    # Odd numbers below 1024 in size: exact, and none is 0.
    real = cast("Any", type(like))
    parts = [real((h >> (10 * k)) & 1023) * 2 - 1023 for k in range(3)]
    scale = 1 / dr.sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2])
    return [one * scale for one in parts]
