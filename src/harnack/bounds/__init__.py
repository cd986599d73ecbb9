"""Bounds: certificates to safe steps. One proof a file."""

from __future__ import annotations

from harnack.bounds.bound import Bound
from harnack.bounds.caps import Caps
from harnack.bounds.classic import Classic
from harnack.bounds.curvature import CurvatureStep
from harnack.bounds.lipschitz import LipschitzStep
from harnack.bounds.longest import Longest
from harnack.bounds.slope import Slope
from harnack.choices import did_you_mean

__all__ = [
    "Bound",
    "Caps",
    "Classic",
    "CurvatureStep",
    "LipschitzStep",
    "Longest",
    "Slope",
    "choose_bound",
]

_NAMED: dict[str, tuple[Bound, ...]] = {
    "classic": (Classic(), LipschitzStep()),
    "slope": (Slope(), LipschitzStep()),
    "curvature": (CurvatureStep(), Caps(), Slope(), LipschitzStep()),
    "caps": (Caps(), Slope(), LipschitzStep()),
    "lipschitz": (LipschitzStep(),),
}


def choose_bound(bound: str | Bound | Longest | None = None) -> Longest:
    """The bound asked for: a name, a `Bound`, a `Longest`, or None for the sharpest known.

    Names: "classic" (the published rule), "slope", "caps" (caps where both ends are known, the
    slope bound elsewhere), "lipschitz", and "curvature" (the default: Taylor's formula alone
    where second derivatives are bounded, else as "caps"). Raises ValueError for another name.
    """
    if isinstance(bound, Longest):
        return bound
    if isinstance(bound, Bound):
        return Longest((bound,))
    name = "curvature" if bound is None else bound
    if name not in _NAMED:
        raise ValueError(
            f"unknown bound {bound!r}; choose one of {', '.join(sorted(_NAMED))}"
            f"{did_you_mean(bound, _NAMED)}"
        )
    return Longest(_NAMED[name])
