"""The step of sphere tracing (Hart 1996)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.extrema import fmin
from harnack.bounds.bound import Bound
from harnack.certify import Certificate, LipschitzCertificate

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

_ROUND_DOWN = 1.0 - 1e-6


@dataclass(frozen=True)
class LipschitzStep(Bound):
    """Gap over constant, no further than the constant holds.

    Proof. |f(p+tv) - f(p)| <= K t for t < radius, and a level is at least min(gap) away in
    value, so it is not met for t < min(gap)/K. Source: Hart 1996, Theorem 1.
    """

    def accepts(self, certificate: Certificate) -> bool:
        return isinstance(certificate, LipschitzCertificate)

    def step(self, certificate: Certificate, slope: Real) -> Real:
        assert isinstance(certificate, LipschitzCertificate)
        c = certificate
        gap = fmin(c.gap_down, c.gap_up)
        # A constant of zero proves everything, unless f is on a level already; what is not a
        # number proves nothing.
        known = (c.gap_down > 0) & (c.gap_up > 0) & (c.constant >= 0) & (c.radius >= 0)
        return dr.select(known, fmin(gap / c.constant, c.radius), 0) * _ROUND_DOWN

    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        return length <= self.step(certificate, slope)
