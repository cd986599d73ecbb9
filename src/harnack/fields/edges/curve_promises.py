"""What a solid angle promises near a point, by integrals over the curve.

Along a unit direction v the derivative of the solid angle is the integral of v.(D x dp)/|D|^3 over
the curve, D = p - x (Biot and Savart), and its second derivative that of 3 (v.D)(v.(D x dp))/|D|^5,
as D changes by -v. D and D x dp are at right angles, so the product of their components along v is
at most half of their lengths': the second derivative is at most 3/2 times the integral of
|dp|/|D|^3. At x + s v, |D| is less by s at most. So by Taylor the rest after the linear term is,
for t < d, the distance to the curve, at most

    3/2 integral of |dp| integral over [0, t] of (t-s)/(|D|-s)^3 ds
        = 3/4 t^2 integral of |dp|/(|D|^3 (1 - t/|D|)),

and 1/(1 - u) <= 1 + u/(1 - q) for 0 <= u <= q. On the ball of radius q d that is `Curvature` with
the constant 3/2 (I3 + q d I4/(1 - q)), I3 and I4 the integrals of |dp|/|D|^3 and |dp|/|D|^4. It
holds for any piece of a curve, and adds up.

The gradient. The second derivative in every direction being at most 3/2 times the integral of
|dp|/|D|^3, so is the norm of the Hessian, and from x to x + t v the gradient moves by at most

    3/2 integral of |dp| integral over [0, t] of ds/(|D|-s)^3
        = 3/4 t integral of |dp|/|D|^3 (2 - u)/(1 - u)^2,    u = t/|D|.

For 0 <= u <= q < 1 that fraction, which is convex in u, is at most 2 + u (3 - 2q)/(1 - q)^2, its
chord. With q = t/d: at most 3/2 t I3 + 3/4 t^2 I4 (3 - 2q)/(1 - q)^2 (`slope_change`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.enclosures import Curvature, HarmonicBall
from harnack.fields.sums import SUM_ROUNDING

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3

__all__ = ["bends", "slope_change", "swept_ball"]

# Radii of the promises as parts of the distance to the curve, by experiment.
_REACHES = (0.3, 0.6, 0.85)


def bends(cubes: Real, fourths: Real, distance: Real) -> tuple[Curvature, ...]:
    """The promises: see the module. cubes, fourths: I3 and I4; distance: d, or less."""
    scale = 1.5 * (1 + SUM_ROUNDING)
    return tuple(
        Curvature(scale * dr.fma(q / (1 - q) * distance, fourths, cubes), q * distance)
        for q in _REACHES
    )


def slope_change(cubes: Real, fourths: Real, distance: Real, radius: Real) -> Real:
    """How far the gradient moves at most within `radius`: see the module; infinite where that is
    not less than the distance."""
    q = radius / distance
    growth = (3 - 2 * q) / dr.square(1 - q)
    change = radius * (1.5 * cubes + 0.75 * radius * growth * fourths)
    return dr.select(radius < distance, (1 + SUM_ROUNDING) * change, dr.inf)


def swept_ball(
    value: Real, gradient: Vec3, squares: Real, bends: tuple[Curvature, ...]
) -> HarmonicBall:
    """The range of the lift on the ball of one of its promises, which itself proves longer steps.

    squares: the integral of |dp|/|D|^2, to which the gradient is known but for its rounding.
    """
    bend = bends[1]
    slope = dr.norm(gradient) + SUM_ROUNDING * squares
    moved = (1 + SUM_ROUNDING) * bend.radius * dr.fma(0.5 * bend.radius, bend.constant, slope)
    return HarmonicBall(bend.radius, value - moved, value + moved)
