"""The longest of several proofs: all are safe, so the best one counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from harnack.backend.extrema import fmax

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.bounds.bound import Bound
    from harnack.certify import Certificate


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
            chosen = [pair for pair in chosen if pair[0].sufficient]
        if all(getattr(certificate, "is_supplement", False) for _, certificate in chosen):
            names = ", ".join(type(b).__name__ for b in self.bounds)
            kinds = ", ".join(type(c).__name__ for c in certificates) or "none"
            raise ValueError(
                f"no bound applies: the field gives certificates of kind {kinds}, and the bounds "
                f"asked for ({names}) accept none of them; leave bound=None to choose by itself"
            )
        return chosen

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
