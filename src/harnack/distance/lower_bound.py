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
    direction v, and steps to where that first meets a level. Neither end falls as s grows: that is
    what every enclosure has to say of itself (`Enclosure`).

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
