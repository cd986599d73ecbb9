"""What a Lipschitz constant says about the levels near a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import Lipschitz


@dataclass(frozen=True)
class LipschitzCertificate:
    """|f(y) - f(p)| <= constant |y - p| within the radius; levels lie the gaps away in value."""

    constant: Real
    radius: Real
    gap_down: Real
    gap_up: Real


def from_lipschitz(known: Lipschitz, gap_down: Real, gap_up: Real) -> LipschitzCertificate:
    """The certificate of a (local or global) Lipschitz constant."""
    return LipschitzCertificate(known.constant, known.radius, gap_down, gap_up)
