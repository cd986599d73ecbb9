"""What a bound of the second derivatives says about the levels near a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import Curvature


@dataclass(frozen=True)
class CurvatureCertificate:
    """|f(p + tv) - f(p) - slope t| <= constant t^2/2 for t < radius; levels lie the gaps away."""

    constant: Real
    radius: Real
    gap_down: Real
    gap_up: Real


def from_curvature(known: Curvature, gap_down: Real, gap_up: Real) -> CurvatureCertificate:
    """The certificate of a (local or global) bound of the Hessian."""
    return CurvatureCertificate(known.constant, known.radius, gap_down, gap_up)
