"""The longest of several proofs: all are safe, so the best one counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.backend.extrema import fmax
from harnack.bounds.bound import Bound
from harnack.bounds.caps import Caps
from harnack.bounds.classic import Classic
from harnack.bounds.curvature import CurvatureStep
from harnack.bounds.lipschitz import LipschitzStep
from harnack.bounds.slope import Slope
from harnack.certify import (
    BallCertificate,
    Certificate,
    CurvatureCertificate,
    LipschitzCertificate,
)

if TYPE_CHECKING:
    from harnack.backend import Mask, Real

# What users call proofs and promises, from the sharpest proof to the plainest.
_NAMES: dict[str, Bound] = {
    "curvature": CurvatureStep(),
    "caps": Caps(),
    "slope": Slope(),
    "classic": Classic(),
    "lipschitz": LipschitzStep(),
}
_PROMISES: dict[type[Certificate], str] = {
    BallCertificate: "HarmonicBall",
    CurvatureCertificate: "Curvature",
    LipschitzCertificate: "Lipschitz",
}


@dataclass(frozen=True)
class Longest:
    """For each certificate the first bound that accepts it; of all certificates the longest step.

    Order the bounds from sharpest to plainest: a bound later in the list would only repeat a
    weaker proof from the same certificate. Every step is safe on its own, so their maximum is.
    """

    bounds: tuple[Bound, ...]

    def pairs(self, certificates: tuple[Certificate, ...]) -> list[tuple[Bound, Certificate]]:
        """The (bound, certificate) pairs in use. ValueError if no bound accepts anything."""
        chosen: list[tuple[Bound, Certificate]] = []
        for certificate in certificates:
            for bound in self.bounds:
                if bound.accepts(certificate):
                    chosen.append((bound, certificate))
                    break
        if any(bound.sufficient for bound, _ in chosen):
            chosen = [pair for pair in chosen if pair[0].sufficient or _is_supplement(pair[1])]
        if all(_is_supplement(certificate) for _, certificate in chosen):
            raise ValueError(self._useless(certificates))
        return chosen

    def _useless(self, certificates: tuple[Certificate, ...]) -> str:
        """Why no bound applies, and which would."""
        asked = ", ".join(type(bound).__name__ for bound in self.bounds)
        certificates = tuple(one for one in certificates if not _is_supplement(one))
        if not certificates:
            return (
                f"the bounds asked for ({asked}) need a promise and the field makes none: "
                "Sample.known is empty, return a HarmonicBall, Curvature or Lipschitz in it"
            )
        kinds = sorted({type(one) for one in certificates}, key=lambda kind: kind.__name__)
        promises = " and ".join(f"{_PROMISES[kind]} ({kind.__name__})" for kind in kinds)
        usable = [
            f'"{name}"'
            for name, bound in _NAMES.items()
            if any(bound.accepts(one) for one in certificates)
        ]
        return (
            f"no bound applies: the field promises {promises}, which the bounds asked for "
            f"({asked}) cannot use; choose {' or '.join(usable)}, or leave bound=None for the "
            "sharpest there is"
        )

    def step(self, certificates: tuple[Certificate, ...], slope: Real) -> Real:
        """The longest proved step along a direction in which f has this slope."""
        best = None
        for bound, certificate in self.pairs(certificates):
            length = bound.step(certificate, slope)
            best = length if best is None else fmax(best, length)
        return best

    def covers(self, certificates: tuple[Certificate, ...], slope: Real, length: Real) -> Mask:
        """Whether any one of the proofs covers the length."""
        free = None
        for bound, certificate in self.pairs(certificates):
            proved = bound.covers(certificate, slope, length)
            free = proved if free is None else free | proved
        return free


def _is_supplement(certificate: Certificate) -> bool:
    """Whether it only adds to others: see `LipschitzCertificate`."""
    return isinstance(certificate, LipschitzCertificate) and certificate.is_supplement
