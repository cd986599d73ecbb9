"""What a bound is: a proof that a stretch of ray holds no level.

A bound is asked two questions about a certificate at p and the slope s of f along a unit
direction v: how far along v it can prove the ray free (`step`), and whether a given length is
proved free (`covers`). The backward bound of an over-stepping tracer is the second question
with the slope turned round, so it costs one evaluation of the proof and no solve.
"""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.certify import Certificate


class Bound(abc.ABC):
    """A safe step from a certificate. Knows no field and no ray, only values and a slope."""

    sufficient: ClassVar[bool] = False
    """Whether a certificate that this bound accepts makes others not worth asking."""

    @abc.abstractmethod
    def accepts(self, certificate: Certificate) -> bool:
        """Whether this proof applies to the certificate (decided when a kernel is recorded)."""

    @abc.abstractmethod
    def step(self, certificate: Certificate, slope: Real) -> Real:
        """A length L >= 0 such that f meets no level on p + t v for 0 < t < L."""

    @abc.abstractmethod
    def covers(self, certificate: Certificate, slope: Real, length: Real) -> Mask:
        """Whether f is proved to meet no level on p + t v for 0 < t < length."""
