"""What a Lipschitz constant says about the levels near a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.fields.field import LineLipschitz

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import Lipschitz


@dataclass(frozen=True)
class LipschitzCertificate:
    """|f(y) - f(p)| <= constant |y - p| within the radius; levels lie the gaps away in value.

    is_supplement: it holds on a line alone, and adds to certificates that hold everywhere.
    """

    constant: Real
    radius: Real
    gap_down: Real
    gap_up: Real
    is_supplement: bool = False


def from_lipschitz(
    known: Lipschitz | LineLipschitz, gap_down: Real, gap_up: Real
) -> LipschitzCertificate:
    """The certificate of a (local or global) Lipschitz constant, everywhere or along a line."""
    on_line = isinstance(known, LineLipschitz)
    return LipschitzCertificate(known.constant, known.radius, gap_down, gap_up, on_line)
