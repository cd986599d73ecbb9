"""A proved lower bound of the distance to a level set: the safe step of every direction at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_component, length
from harnack.bounds import Bound, Caps, CurvatureStep, LipschitzStep, Slope
from harnack.certify import Certificate, Levels, certify

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.field import Field, Sample

__all__ = ["distance_below"]

# From the sharpest to the plainest: of each certificate the first that accepts it counts.
_BOUNDS: tuple[Bound, ...] = (CurvatureStep(), Caps(), Slope(), LipschitzStep())


def distance_below(backend: Backend, field: Field, levels: Levels, p: Vec3, sample: Sample) -> Real:
    """A length that the distance from p to the nearest level is proved not to fall short of.

    sample: the field at p.

    Proof. A bound proves from a certificate and the slope s along a unit direction v that
    f(p + tv) stays within [L(t, s), U(t, s)], and steps to where that first meets a level. Both
    envelopes rise with s, for each bound there is:

    - `LipschitzStep`: s does not enter.
    - `CurvatureStep`: f + st -+ H t^2/2.
    - `Slope`: with m = R s/(n u), U = u [(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1)] rises as P(q, 1) >=
      P(q, -1), and L = u P(q, m) as P(q, .) does. For upper - f, whose slope is -s, the two
      change places and signs.
    - `Caps`: U belongs to boundary values that are 1 on the caps X.v > 1-b and X.v < a-1 of the
      unit sphere, b = p + mu/(1-p), a = p - mu/(1-p), mu proportional to s. As s grows, weight
      moves from a-1 to 1-b, which is no smaller as a + b = 2p <= 2, and P(q, .) rises. L is the
      complement: the same with p -> 1-p, mu -> -mu, turned round.

    All slopes lie in [-G, G], G = |grad f(p)| and its error. So U(t, s) <= U(t, G) and L(t, s) >=
    L(t, -G): no direction meets the next level above before `step` at slope G, nor the one below
    before `step` at -G, each of which is at most that. The smaller of the two is free in every
    direction. The two, and each certificate, are proofs of their own: of each the longest counts.

    As in the tracer the levels are seen nearer by the rounding of value and position, and the
    result is shortened by the rounding of p itself. Where f jumps, all this is about f with the
    jumps taken out, which is f up to the nearest sheet.
    """
    down, up = levels.gaps(sample.value)
    steepness = length(sample.gradient) + sample.gradient_error
    size = largest_component(p)
    epsilon = backend.epsilon
    blur = dr.fma(8 * epsilon, dr.abs(sample.value), sample.error) + steepness * 4 * epsilon * size
    down, up = fmax(down - blur, 0), fmax(up - blur, 0)
    certificates = certify(sample, down, up)
    rising = _longest(certificates, steepness)
    falling = _longest(certificates, -steepness)
    distance = dr.select((down > 0) & (up > 0), fmin(rising, falling), 0)
    if field.has_sheets:
        distance = fmin(distance, field.distance_to_sheets(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)


def _longest(certificates: tuple[Certificate, ...], slope: Real) -> Real:
    best = None
    for certificate in certificates:
        bound = next((bound for bound in _BOUNDS if bound.accepts(certificate)), None)
        if bound is not None:
            free = fmax(bound.step(certificate, slope), 0)  # not a number: proves nothing
            best = free if best is None else fmax(best, free)
    if best is None:
        raise ValueError(
            "the field says nothing that a bound could use (Sample.known is empty): "
            'method="lower" needs a promise'
        )
    return best
