"""What a harmonic ball says about the levels near a point.

Everything is stated as a distance in value from f(p), so that bounds never subtract two large
numbers: `room_below = f - lower` and `room_above = upper - f` are how far the promise lets the
function move, `gap_down` and `gap_up` how far it must move to reach a level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import HarmonicBall

# Distances carry a few roundings of float32; a radius is shortened by this much.
RADIUS_SLACK = 1.0 - 1e-6


@dataclass(frozen=True)
class BallCertificate:
    """f is harmonic on B(p, radius) of R^dimension and moves there by less than the rooms.

    A room of None says that this side is not bounded. Slopes passed to bounds are derivatives
    of f along a unit direction, in f per length.
    """

    radius: Real
    room_below: Real | None
    room_above: Real | None
    gap_down: Real
    gap_up: Real
    dimension: int


def from_ball(
    ball: HarmonicBall, f: Real, gap_down: Real, gap_up: Real, error: Real = 0.0
) -> BallCertificate:
    """The certificate of a harmonic ball at a point with value f, known up to `error`.

    The ends of the promise are moved out by the error and eight units in the last place of f:
    a promise that seems to leave f no room would otherwise prove f constant. A radius that is
    not a positive number, or a NaN anywhere, gives a certificate that proves nothing (radius 0).
    """
    blur = dr.fma(8 * float(dr.epsilon(type(f))), dr.abs(f), error)
    proved = ball.radius > 0

    def room(end: Real, sign: float) -> Real | None:
        nonlocal proved
        if isinstance(end, float) and math.isinf(end):
            return None
        distance = sign * (end - f)
        proved = proved & (distance == distance)  # not NaN
        return fmax(distance, 0) + blur

    below, above = room(ball.lower, -1.0), room(ball.upper, 1.0)
    radius = dr.select(proved, ball.radius * RADIUS_SLACK, 0)
    return BallCertificate(radius, below, above, gap_down, gap_up, ball.dimension)
