"""A bound made wrong on purpose: a test suite that accepts it is worth nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.bounds import Bound

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.certify import Certificate

__all__ = ["Scaled"]


@dataclass(frozen=True)
class Scaled(Bound):
    """`bound` with every step, and every length it covers, multiplied by `factor`."""

    bound: Bound
    factor: float

    def accepts(self, certificate: Certificate) -> bool:
        return self.bound.accepts(certificate)

    def step(self, certificate: Certificate, slope: Real) -> Real:
        return self.factor * self.bound.step(certificate, slope)

    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        return self.bound.covers(certificate, slope, length / self.factor)
