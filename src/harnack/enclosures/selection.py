"""The choice of enclosures, by name or by class, and the longest length that several of them prove.
An enclosure bounds how far a function f can change along a path (a ray) from its value at a sample.
It proves a length of the path to be free: f takes no level (a value that rays look for) on it. Most
enclosures are derived from promises, proved bounds of f near the sample.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeAlias, cast, get_origin

from harnack.backend.elementary import fmax
from harnack.enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from harnack.enclosures.enclosure import Enclosure, LevelGaps, SlopeRange
from harnack.enclosures.harmonic_ball import (
    HarnackEnclosure,
    HarnackSlopeEnclosure,
    SphericalCapEnclosure,
)
from harnack.enclosures.parabola import ConvexityEnclosure, LipschitzEnclosure, TaylorEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.promises import Promise
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Mask, Real
    from harnack.enclosures.enclosure import PathRestriction
    from harnack.enclosures.promises import Lipschitz

# Classes of enclosures that use promises, each tuple from the sharpest proof to the fallback.
# `trace` and clearances take `_CURVATURE` by default.
_FALLBACK = (LipschitzEnclosure,)
_SLOPE = (HarnackSlopeEnclosure, BoundedLaplacianEnclosure, *_FALLBACK)
_CURVATURE = (TaylorEnclosure, SphericalCapEnclosure, *_SLOPE)
_KINDS_BY_NAME: dict[str, tuple[type[Enclosure], ...]] = {
    "pieces": (PiecewiseTaylorEnclosure, ConvexityEnclosure, *_CURVATURE),
    "curvature": _CURVATURE,
    "caps": (SphericalCapEnclosure, *_SLOPE),
    "slope": _SLOPE,
    "classic": (HarnackEnclosure, *_FALLBACK),
    "laplacian": (BoundedLaplacianEnclosure, *_FALLBACK),
    "lipschitz": _FALLBACK,
}
# Methods of the literature, for comparison: a name, and the class in `harnack.literature`. That
# package is imported when such a name is asked for, and by nothing else.
_LITERATURE_CLASSES = {
    "quadratic-taylor": "QuadraticTaylorEnclosure",
    "linear-taylor": "LinearTaylorEnclosure",
    "segment": "SegmentTracingEnclosure",
    "bottom-up-linear": "BottomUpLinearEnclosure",
    "bottom-up-quadratic": "BottomUpQuadraticEnclosure",
    "mixed": "LongestOfEnclosure",
    "affine": "AffineEnclosure",
    "interval": "IntervalEnclosure",
}
ENCLOSURE_NAMES = tuple(sorted((*_KINDS_BY_NAME, *_LITERATURE_CLASSES)))
# What the published rule is called elsewhere, such as in lift_bound="paper", and its name here.
_OTHER_NAMES: dict[str, str] = {"paper": "classic", "published": "classic", "harnack": "classic"}
# Names of enclosures that need no promise: they are derived from ranges of a formula.
_NAMES_USING_RANGES = [f'"{name}"' for name in ("pieces", *_LITERATURE_CLASSES)]


@dataclass(frozen=True)
class EnclosureKinds:
    """Classes of enclosures in an order. An enclosure bounds the change of a function f along a
    path; most are derived from a promise, a proved bound of f near a point. For each promise the
    first class that can use it is chosen.

    kinds: the classes, the sharpest first. A later class would only prove less from the same
        promise.
    uses_alternative_promises: whether enclosures are made also from those promises that the field
        declares weaker than its others (`Sample.alternative_promises`).
    """

    kinds: tuple[type[Enclosure], ...]
    uses_alternative_promises: bool = True

    def from_restriction(
        self, function: PathRestriction, slopes: SlopeRange, length: Real
    ) -> tuple[Enclosure, ...]:
        """Return the enclosure of a function from ranges of its derivatives along the path, as a
        tuple of one. It is made by the first class that uses such ranges; the tuple is empty if no
        class does.

        function: the function along the path.
        slopes: the range of the derivative at the start of the path.
        length: the length of the path on which the enclosure is wanted.
        """
        for kind in self.kinds:
            enclosure = kind.from_restriction(function, slopes, length)
            if enclosure is not None:
                return (enclosure,)
        return ()

    def from_promises(
        self,
        promises: tuple[Promise, ...],
        alternative_promises: tuple[Promise, ...],
        value: Real,
        error: Real,
        slopes: SlopeRange,
        ray_promises: tuple[Lipschitz, ...] = (),
    ) -> tuple[Enclosure, ...]:
        """Return the enclosures of f along a direction, one for each promise that a class can use.

        promises, alternative_promises: proved bounds of f near the point; the field declares the
            alternative ones weaker than the others.
        ray_promises: Lipschitz constants of f that hold along this direction only.
        value, error: f at the point, and a bound of its error.
        slopes: the range of the derivative of f along the direction.

        Raises:
            ValueError: no class of enclosures can use any of the promises other than
                `ray_promises`.
        """
        promises = promises + alternative_promises if self.uses_alternative_promises else promises
        enclosures = [
            self._enclosure(entry, value, error, slopes) for entry in (*promises, *ray_promises)
        ]
        if all(entry is None for entry in enclosures[: len(promises)]):
            raise ValueError(
                self._nothing_applies_message(promises + alternative_promises, value, error, slopes)
            )
        return tuple(entry for entry in enclosures if entry is not None)

    def _enclosure(
        self, promise: Promise, value: Real, error: Real, slopes: SlopeRange
    ) -> Enclosure | None:
        """Return the enclosure that the first class that can use the promise makes of it; None if
        no class can.

        value, error: f at the point, and a bound of its error.
        slopes: the range of the derivative of f along the direction.
        """
        for kind in self.kinds:
            enclosure = kind.from_promise(promise, value, error, slopes)
            if enclosure is not None:
                return enclosure
        return None

    def _nothing_applies_message(
        self, promises: tuple[Promise, ...], value: Real, error: Real, slopes: SlopeRange
    ) -> str:
        """Return the text of an error: none of these classes of enclosures can use the field's
        promises. The text names the choices of the option `enclosures` that can use them.

        promises: all promises of the field at a point.
        value, error: f at the point, and a bound of its error.
        slopes: the range of the derivative of f along the direction.
        """
        requested = ", ".join(kind.__name__ for kind in self.kinds)
        if not promises:
            kinds = ", ".join(kind.__name__ for kind in Promise.__subclasses__())
            message = (
                "the field makes no promise, from which steps would be proved: Sample.promises is "
                "empty, but evaluate must put at least one of the promises in harnack.proofs into "
                f"it: {kinds}"
            )
            # What is used if the option is left out: nothing was asked for.
            if not self.uses_alternative_promises:
                return message
            return (
                f"the enclosures asked for ({requested}) need a promise: {message}. Formulas are "
                "enclosed by ranges: leave enclosures out, or choose one of "
                f"{', '.join(_NAMES_USING_RANGES)}"
            )
        promised = " and ".join(sorted({type(promise).__name__ for promise in promises}))
        # The names whose first, sharpest class can use one of the promises.
        usable = [
            f'"{name}"'
            for name, (sharpest, *_) in _KINDS_BY_NAME.items()
            if any(
                sharpest.from_promise(promise, value, error, slopes) is not None
                for promise in promises
            )
        ]
        if not usable:
            return (
                f"no enclosure applies to what the field promises, {promised}: a HarmonicBall "
                "needs at "
                "least one limit that is not infinite, lower or upper, a BoundedLaplacian both"
            )
        # Without the field's weaker promises, these are the classes that are used if the option is
        # left out: then the hint would be of no use.
        hint = (
            ""
            if not self.uses_alternative_promises
            else ", or leave enclosures out for the sharpest there is"
        )
        return (
            f"no enclosure applies: the field promises {promised}, which the enclosures asked for "
            f"({requested}) cannot use; choose {' or '.join(usable)}{hint}"
        )


# The option `enclosures` of verbs.
EnclosureChoice: TypeAlias = (
    str | type[Enclosure] | Iterable[type[Enclosure]] | EnclosureKinds | None
)


def choose_enclosures(enclosures: EnclosureChoice = None) -> EnclosureKinds:
    """Return the classes of enclosures for the option `enclosures` of other functions. An enclosure
    bounds the change of a function along a ray, so that it proves steps.

    enclosures: a name, one or several classes of enclosures, or None for all that are worth their
        time.

    Names for all fields:

    - "classic": Harnack's inequality without the slope, the published rule.
    - "slope": Harnack's inequality with the slope.
    - "caps": spherical caps if a function is bounded on both sides, else as "slope".
    - "laplacian": the bound for functions with a bounded Laplacian.
    - "lipschitz": the Lipschitz cone.
    - "curvature": Taylor's formula if second derivatives are bounded, else as "caps".

    Names for fields with a formula: "pieces", from ranges of derivatives on pieces of the ray. For
    comparison there are "quadratic-taylor", "linear-taylor" and "segment", from ranges of
    derivatives on the whole length; and "bottom-up-linear", "bottom-up-quadratic", "mixed",
    "affine" and "interval", for which the formula is evaluated in another arithmetic.

    None means "pieces", but without the promises that a field declares weaker than its others. For
    fields without a formula "pieces" means "curvature".

    Raises:
        ValueError: another name.
        TypeError: a value that is not a class of enclosures.
    """
    if isinstance(enclosures, EnclosureKinds):
        return enclosures
    if enclosures is None:
        return EnclosureKinds(_KINDS_BY_NAME["pieces"], uses_alternative_promises=False)
    if isinstance(enclosures, str):
        return EnclosureKinds(_kinds_of_name(enclosures))
    # A single class, or several.
    classes = cast("Any", enclosures) if isinstance(enclosures, Iterable) else (enclosures,)
    kinds: tuple[Any, ...] = tuple(classes)
    if not kinds or not all(_is_proof(kind) for kind in kinds):
        raise TypeError(
            "enclosures must be a name, or classes of enclosures such as "
            "harnack.proofs.SphericalCapEnclosure or (harnack.proofs.SphericalCapEnclosure, "
            f"harnack.proofs.LipschitzEnclosure), not {enclosures!r}"
        )
    return EnclosureKinds(kinds)


def _kinds_of_name(name: str) -> tuple[type[Enclosure], ...]:
    """Return the classes of enclosures for a name. Raises ValueError if there is no such name."""
    if name in _LITERATURE_CLASSES:
        return (getattr(import_module("harnack.literature"), _LITERATURE_CLASSES[name]),)
    if name not in _KINDS_BY_NAME:
        raise ValueError(
            f"unknown enclosures {name!r}; choose one of {', '.join(ENCLOSURE_NAMES)}"
            f"{did_you_mean(_OTHER_NAMES.get(name.lower(), name), ENCLOSURE_NAMES)}"
        )
    return _KINDS_BY_NAME[name]


def _is_proof(kind: Any) -> bool:
    """Return whether `kind` is a class of enclosures that can be instantiated."""
    # Python 3.10 takes list[int] for a class.
    is_class = isinstance(kind, type) and get_origin(kind) is None
    return is_class and issubclass(kind, Enclosure) and not inspect.isabstract(kind)


def longest_free_length(enclosures: tuple[Enclosure, ...], gaps: LevelGaps) -> Real:
    """Return the longest length on which any of the enclosures proves that f takes no level.

    gaps: the differences between f and the next levels.

    Each length is proved, so their maximum is. It is at least 0, even if an enclosure gives NaN.
    """
    best: Real = type(gaps.above)(0)
    for enclosure in enclosures:
        best = fmax(enclosure.free_length(gaps), best)
    return best


def any_is_free(enclosures: tuple[Enclosure, ...], gaps: LevelGaps, length: Real) -> Mask:
    """Return the mask of lanes on which at least one of the enclosures proves that f takes no level
    on the length `length`. gaps: the differences between f and the next levels."""
    is_free = length <= 0
    for enclosure in enclosures:
        is_free |= enclosure.is_free(gaps, length)
    return is_free
