"""The choice of proofs, by name or by class; the longest step that several enclosures prove."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from harnack.backend.elementary import fmax
from harnack.enclosures.bounded_laplacian import GreenBall
from harnack.enclosures.enclosure import Enclosure, Gaps, Slopes
from harnack.enclosures.harmonic_ball import Caps, Classic, Slope
from harnack.enclosures.literature import (
    AffineBand,
    BottomUpLinear,
    BottomUpQuadratic,
    IntervalRange,
    Mixed,
)
from harnack.enclosures.parabola import Cone, Tangent, Taylor
from harnack.enclosures.piecewise_taylor import LinearTaylor, Pieces, QuadraticTaylor, Segment
from harnack.enclosures.promises import Promise
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import Restriction
    from harnack.enclosures.promises import Lipschitz

# Of promises: from the sharpest proof to the one that all fall back on. `trace` takes `_CURVATURE`
# unasked, and so do clearances.
_FALLBACK = (Cone,)
_SLOPE = (Slope, GreenBall, *_FALLBACK)
_CURVATURE = (Taylor, Caps, *_SLOPE)
_NAMED: dict[str, tuple[type[Enclosure], ...]] = {
    "pieces": (Pieces, Tangent, *_CURVATURE),
    "quadratic-taylor": (QuadraticTaylor,),
    "linear-taylor": (LinearTaylor,),
    "segment": (Segment,),
    "bottom-up-linear": (BottomUpLinear,),
    "bottom-up-quadratic": (BottomUpQuadratic,),
    "mixed": (Mixed,),
    "affine": (AffineBand,),
    "interval": (IntervalRange,),
    "curvature": _CURVATURE,
    "caps": (Caps, *_SLOPE),
    "slope": _SLOPE,
    "classic": (Classic, *_FALLBACK),
    "laplacian": (GreenBall, *_FALLBACK),
    "lipschitz": _FALLBACK,
}
BOUNDS = tuple(sorted(_NAMED))
# Those that need no promise: they are made of ranges of a formula.
_OF_RANGES = [
    f'"{name}"' for name, (sharpest, *_) in _NAMED.items()
    if sharpest.along.__func__ is not Enclosure.along.__func__
]  # fmt: skip


@dataclass(frozen=True)
class Proofs:
    """Kinds of enclosures. For each promise the first kind that can be made of it is used.

    kinds: from the sharpest to the weakest: a later one would only prove less from the same
        promise.
    uses_weaker: whether to use promises that the field calls weaker than its others
        (`Sample.weaker`).
    """

    kinds: tuple[type[Enclosure], ...]
    uses_weaker: bool = True

    def along(self, function: Restriction, slopes: Slopes, length: Real) -> tuple[Enclosure, ...]:
        """The enclosures of a function whose ranges along the path are known; empty if none of the
        proofs uses ranges."""
        for kind in self.kinds:
            enclosure = kind.along(function, slopes, length)
            if enclosure is not None:
                return (enclosure,)
        return ()

    def enclose(
        self,
        known: tuple[Promise, ...],
        weaker: tuple[Promise, ...],
        value: Real,
        error: Real,
        slopes: Slopes,
        along: tuple[Lipschitz, ...] = (),
    ) -> tuple[Enclosure, ...]:
        """The enclosures of f along a direction in which it has these slopes.

        known, weaker, value, error, along: as in `Sample`. Raises ValueError if no proof applies to
        a promise.
        """
        promises = known + weaker if self.uses_weaker else known
        made = [self._enclosure(one, value, error, slopes) for one in (*promises, *along)]
        if all(one is None for one in made[: len(promises)]):
            raise ValueError(self._useless(known + weaker, value, error, slopes))
        return tuple(one for one in made if one is not None)

    def _enclosure(
        self, promise: Promise, value: Real, error: Real, slopes: Slopes
    ) -> Enclosure | None:
        for kind in self.kinds:
            enclosure = kind.of(promise, value, error, slopes)
            if enclosure is not None:
                return enclosure
        return None

    def _useless(
        self, promises: tuple[Promise, ...], value: Real, error: Real, slopes: Slopes
    ) -> str:
        """Why no proof applies, and which would."""
        asked = ", ".join(kind.__name__ for kind in self.kinds)
        if not promises:
            kinds = ", ".join(kind.__name__ for kind in Promise.__subclasses__())
            return (
                f"the bounds asked for ({asked}) need a promise and the field makes none: "
                f"Sample.known is empty, return one of these in it: {kinds}. Formulas are bounded "
                f"by ranges: leave bound out, or choose one of {', '.join(_OF_RANGES)}"
            )
        made = " and ".join(sorted({type(one).__name__ for one in promises}))
        usable = [
            f'"{name}"'
            for name, (sharpest, *_) in _NAMED.items()
            if any(sharpest.of(one, value, error, slopes) is not None for one in promises)
        ]
        if not usable:
            return (
                f"no bound applies to what the field promises, {made}: a HarmonicBall needs at "
                "least one limit that is not infinite, lower or upper, a BoundedLaplacian both"
            )
        others = "" if not self.uses_weaker else ", or leave bound=None for the sharpest there is"
        return (
            f"no bound applies: the field promises {made}, which the bounds asked for "
            f"({asked}) cannot use; choose {' or '.join(usable)}{others}"
        )


# A bound as users ask for it.
Choice: TypeAlias = str | type[Enclosure] | Iterable[type[Enclosure]] | Proofs | None


def choose_proofs(bound: Choice = None) -> Proofs:
    """The proofs asked for: a name, one or several classes of enclosures, or None for all that pay.

    Names: "classic" (the published rule), "slope", "caps" (caps where both ends are known, the
    slope bound elsewhere), "laplacian" (where the Laplacian is bounded), "lipschitz", and
    "curvature" (Taylor's formula where second derivatives are bounded, else as "caps"); for fields
    with a formula "pieces", and for comparison "quadratic-taylor", "linear-taylor" and "segment",
    and by the formula's own arithmetic "bottom-up-linear", "bottom-up-quadratic", "mixed", "affine"
    and "interval".
    None means "pieces", which for fields without a formula means "curvature", but without the
    promises that a field itself calls weaker than its others.

    Raises ValueError for another name, TypeError for what is no class of enclosures.
    """
    if isinstance(bound, Proofs):
        return bound
    if bound is None:
        return Proofs(_NAMED["pieces"], uses_weaker=False)
    if isinstance(bound, str):
        if bound not in _NAMED:
            raise ValueError(
                f"unknown bound {bound!r}; choose one of {', '.join(sorted(_NAMED))}"
                f"{did_you_mean(bound, _NAMED)}"
            )
        return Proofs(_NAMED[bound])
    several = cast("Any", bound) if isinstance(bound, Iterable) else (bound,)
    kinds: tuple[Any, ...] = tuple(several)
    if not kinds or not all(_is_proof(one) for one in kinds):
        raise TypeError(
            "bound must be a name, or classes of enclosures such as harnack.Caps or "
            f"(harnack.Caps, harnack.Cone), not {bound!r}"
        )
    return Proofs(kinds)


def _is_proof(kind: Any) -> bool:
    """Whether this is a class of enclosures that can be made."""
    return isinstance(kind, type) and issubclass(kind, Enclosure) and not inspect.isabstract(kind)


def longest_step(enclosures: tuple[Enclosure, ...], gaps: Gaps) -> Real:
    """The longest step that one of the enclosures proves: every one is safe, so their maximum is.

    At least 0, also where an enclosure gives NaN.
    """
    best: Real = type(gaps.up)(0)
    for one in enclosures:
        best = fmax(one.step(gaps), best)
    return best


def any_covers(enclosures: tuple[Enclosure, ...], gaps: Gaps, length: Real) -> Mask:
    """Whether one of the enclosures proves the length free."""
    free = length <= 0
    for one in enclosures:
        free |= one.covers(gaps, length)
    return free
