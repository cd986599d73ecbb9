"""A proved lower bound of the distance to a level set: the safe step of every direction at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_component, length
from harnack.enclosures import Gaps, Slopes, TargetLevels, choose_proofs, longest_step

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.field import Field, Sample

__all__ = ["distance_below"]

# All that a field promises: points are few, and the longest proof counts.
_PROOFS = choose_proofs("curvature")


def distance_below(
    backend: Backend, field: Field, levels: TargetLevels, p: Vec3, sample: Sample
) -> Real:
    """A length that the distance from p to the nearest level is proved not to fall short of.

    sample: the field at p.

    Proof. An enclosure holds f(p + tv) within [L(t, s), U(t, s)], s the slope along a unit
    direction v, and steps to where that first meets a level. Both ends rise with s, for each there
    is:

    - `Cone`: s does not enter.
    - `Taylor`: f + st -+ H t^2/2.
    - `Slope`: with m = R s/(n u), U = u [(1+m)/2 P(q, 1) + (1-m)/2 P(q, -1)] rises as P(q, 1) >=
      P(q, -1), and L = u P(q, m) as P(q, .) does. For upper - f, whose slope is -s, the two
      change places and signs.
    - `Caps`: U belongs to boundary values that are 1 on the caps X.v > 1-b and X.v < a-1 of the
      unit sphere, b = p + mu/(1-p), a = p - mu/(1-p), mu proportional to s. As s grows, weight
      moves from a-1 to 1-b, which is no smaller as a + b = 2p <= 2, and P(q, .) rises. L is the
      complement: the same with p -> 1-p, mu -> -mu, negated.

    All slopes lie in [-G, G], G = |grad f(p)| and its error: one enclosure with that interval of
    slopes holds in every direction. The level above and that below are proofs of their own, and so
    is each promise: of each the longest counts.

    As in the tracer the levels are seen nearer by the rounding of value and position, and the
    result is shortened by the rounding of p itself. Where f jumps, all this is about f with the
    jumps taken out, which is f up to the nearest sheet.
    """
    steepest = length(sample.gradient) + sample.gradient_error
    size = largest_component(p)
    epsilon = backend.epsilon
    rounding = 8 * epsilon * dr.abs(sample.value) + 4 * epsilon * size * steepest
    gaps = levels.gaps(sample.value).less(rounding + sample.error)
    enclosures = _PROOFS.enclose(
        sample.known, sample.weaker, sample.value, sample.error, Slopes(-steepest, steepest)
    )
    none = backend.Float(dr.inf)
    above = longest_step(enclosures, Gaps(none, gaps.up))
    below = longest_step(enclosures, Gaps(gaps.down, none))
    distance = dr.select(gaps.smaller > 0, fmin(above, below), 0)
    if field.has_sheets:
        distance = fmin(distance, field.distance_to_sheets(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)
