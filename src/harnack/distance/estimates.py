"""Distances to a level set from what is known at the point alone, to first and second order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax
from harnack.backend.lengths import length
from harnack.distance.tangent import apply

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

__all__ = ["first_order", "second_order"]


def first_order(above: Real, gradient: Vec3) -> Real:
    """above/|grad f| with above = f - level. Off by O(d^2) at distance d from a smooth surface.

    Proof. Let y be the closest point of the level set, N its normal grad f/|grad f|(y), and
    x = y + d N (x - y is normal at the closest point; d has the sign of above). Taylor's formula
    along this line, from x back to y, and |grad f(x)| = |grad f(y)| + O(d) give
    above = d N.grad f(x) + O(d^2) = d |grad f(x)| + O(d^2).

    Where the gradient is zero it is infinite with the sign of above; zero on the level itself.
    """
    return dr.select(above == 0, 0, above / length(gradient))


def second_order(above: Real, gradient: Vec3, rows: tuple[Vec3, Vec3, Vec3]) -> Real:
    """d1/(1 - k d1/2) with d1 = above/|grad f|, k = n.An/|grad f|: off by O(d^3).

    n is the unit gradient, A the Hessian, both at x; k is how fast the slope changes along n, not
    a curvature of the surface.

    Proof. With x = y + d N as in `first_order`, Taylor along that line is
    above = d N.g - d^2 N.AN/2 + O(d^3), whose root is d = e + (N.AN/N.g) e^2/2 + O(d^3) with
    e = above/N.g. N is not n: but n is smooth and n(y) = N, so N = n + O(d); for unit vectors
    N.n = 1 - |N-n|^2/2, hence N.g = |g| (1 + O(d^2)), and N.AN = n.An + O(d). As above = O(d),
    replacing N by n changes e and the second term by O(d^3): d = d1 + k d1^2/2 + O(d^3). So does
    any function with the same expansion.

    Three have it: the polynomial, the smaller root 2 d1/(1 + sqrt(1 - 2 k d1)) of the parabola, and
    Halley's quotient above. The root does not exist for k d1 > 1/2; the polynomial changes sign at
    k d1 = -2; the quotient is exact for f = c/r + const along its rays (for every f = (a+bs)/(c+es)
    on the line), as harmonic functions like to be, and bounded for k d1 < 0. For k d1 > 1, where
    Taylor's formula says nothing, its denominator is held at 1/2: the sign is always that of
    above, and the size at most 2 |d1|.
    """
    gradient_norm = length(gradient)
    n = gradient / gradient_norm
    first = first_order(above, gradient)
    k = dr.dot(n, apply(rows, n)) / gradient_norm
    quotient = first / fmax(1 - 0.5 * k * first, 0.5)
    return dr.select(dr.isfinite(first) & (first != 0), quotient, first)
