"""`TraceOptions`, how a surface is traced; and the rule by which the functions of the library
(`trace`, `render`, `mesh`, ...) take keywords in place of `Surface` and `TraceOptions`. In this
module a verb is such a function.

Beside a bare field, a verb takes the keywords of `Surface`; without `options`, it takes those of
`TraceOptions`. Keywords beside an object that holds them raise an error, since either could be
meant. Options that a verb does not have raise an error that names all of them.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from harnack.backend.validation import as_integer_in_range, flag
from harnack.enclosures import EnclosureChoice, EnclosureKinds, choose_enclosures
from harnack.name_suggestions import did_you_mean, is_one_of, suggests_arguments
from harnack.tracer.level_contact import HitTolerance
from harnack.tracer.surface import Surface, SurfaceKeywords, as_number

if TYPE_CHECKING:
    from harnack.backend import Precision

_Function = TypeVar("_Function", bound=Callable[..., Any])


class TraceKeywords(SurfaceKeywords, total=False):
    """The keywords of `Surface` and of `TraceOptions`, which the functions of the library (`trace`,
    `render`, ...) take in place of these objects."""

    tolerance: float | HitTolerance | None
    enclosures: EnclosureChoice
    max_steps: int
    over_relaxation: float | None
    precision: Precision | None
    backend: Literal["webgpu"] | None
    require_crossing: bool


@suggests_arguments
@dataclass(frozen=True, kw_only=True)
class TraceOptions:
    """How a surface is traced, drawn, meshed or measured: the `options` of every function that
    takes a surface (`trace`, `render`, `mesh`, ...). A function raises a TypeError for options that
    it does not have, unless they have their defaults; docs/options.md says which it has. f is the
    field whose level is the surface.

    tolerance: the largest distance of hits, of points of a picture or of triangles from the
        surface, a length in the field's coordinates; or a `HitTolerance`. None follows the size of
        the surface: 1e-4 of the longest side of its box (domain, proved extent, clip and section),
        1e-3 of it for meshes, and 1e-4 where the surface has no bounds. In single precision it is
        not below about 1e-6 of the size of coordinates. Closest points are exact up to rounding.
    enclosures: the proofs by which steps are made: None for all that save time; a name, "classic"
        for the published rule, "slope", "caps", "curvature", "lipschitz" and others; or classes of
        enclosures (`harnack.enclosures.choose_enclosures`).
    max_steps: the number of evaluations of f after which a ray is out of steps: it ends undecided.
    over_relaxation: a factor in [1, 2). Trial steps are this many times as long as the proved
        steps, and are kept if an enclosure that reaches back from the trial point proves the rest
        (Keinert et al. 2014). 1 turns it off; None is the field's own choice.
    precision: "single" or "double". None follows the input: double precision for float64 arrays,
        single for all others; Dr.Jit arrays have a precision of their own.
    backend: "webgpu" traces on any GPU of the system by the package `wgpu`; None on what Dr.Jit
        has, a CPU or an NVIDIA GPU.
    require_crossing: whether a ray hits only where f passes to the other side of the level by at
        least half the tolerance. A ray that comes within the tolerance and turns back (a graze)
        goes on; a hit is at a root.

    Raises:
        TypeError, ValueError: a value of the wrong kind, or out of range, by its name.
    """

    tolerance: float | HitTolerance | None = None
    enclosures: EnclosureChoice = None
    max_steps: int = 2000
    over_relaxation: float | None = None
    precision: Precision | None = None
    backend: Literal["webgpu"] | None = None
    require_crossing: bool = False

    def __post_init__(self) -> None:
        """Check all values; `max_steps` and `over_relaxation` become Python numbers."""
        # These properties raise an error for wrong values.
        _ = self.hit_tolerance, self.enclosure_kinds
        count = as_integer_in_range(self.max_steps, "max_steps", 1, 2**31 - 1)
        object.__setattr__(self, "max_steps", count)
        flag(self.require_crossing, "require_crossing")
        if self.over_relaxation is not None:
            # A Python number: NumPy's would ask Dr.Jit for numbers.
            factor = as_number(self.over_relaxation, "over_relaxation must be a number in [1, 2)")
            if not 1 <= factor < 2:
                raise ValueError(f"over_relaxation must lie in [1, 2), not {factor}")
            object.__setattr__(self, "over_relaxation", factor)
        if self.precision is not None and not is_one_of(self.precision, ("single", "double")):
            raise ValueError(f'precision is "single" or "double", not {self.precision!r}')
        if self.backend is not None and not is_one_of(self.backend, ("webgpu",)):
            raise ValueError(
                f'backend is "webgpu", or None for what Dr.Jit has, not {self.backend!r}'
            )
        if self.backend is not None and self.precision == "double":
            raise ValueError('backend="webgpu" computes in single precision alone')

    @property
    def hit_tolerance(self) -> HitTolerance | None:
        """The tolerance as a `HitTolerance`; None if it follows the size of the surface."""
        if self.tolerance is None or isinstance(self.tolerance, HitTolerance):
            return self.tolerance
        length = as_number(self.tolerance, "tolerance must be a length or HitTolerance")
        if not 0 < length < math.inf:
            raise ValueError(
                f"tolerance must be finite and > 0, not {length!r}: a level set is never met "
                "exactly"
            )
        return HitTolerance(length)

    @property
    def enclosure_kinds(self) -> EnclosureKinds:
        """The classes of enclosures by which steps are proved. An enclosure is an interval that is
        proved to contain the change of f along a ray."""
        return choose_enclosures(self.enclosures)

    def replace(self, **changes: Any) -> TraceOptions:
        """Return these options with some values changed, by name. Raises the errors of the
        constructor."""
        return replace(self, **changes)


SURFACE_OPTIONS = tuple(SurfaceKeywords.__annotations__)
"""The names of the keywords of `Surface`."""
TRACE_OPTIONS = tuple(field.name for field in fields(TraceOptions))
"""The names of the keywords of `TraceOptions`."""


def surface_and_options(
    verb: str,
    surface: Any,
    options: TraceOptions | None,
    keywords: Mapping[str, Any],
    honored: Sequence[str],
) -> tuple[Surface, TraceOptions]:
    """Return the `Surface` and the `TraceOptions` of a call of a function of the library (`trace`,
    `render`, ...). Some options may be given as keywords.

    verb: the name of the called function, for messages.
    surface: a field or a `Surface`.
    keywords: the keywords of the call that are options of `Surface` or `TraceOptions`.
    honored: the names of the options that the called function has; all other options must have
        their defaults.

    Raises:
        TypeError: a keyword that does not exist, or that the called function does not have, also
            within `surface` and `options`; a keyword of `Surface` beside a `Surface`, or of
            `TraceOptions` beside `options`; `surface` is neither a field nor a `Surface`.
        ValueError: a value that `Surface` or `TraceOptions` refuses.
    """
    for name in keywords:
        if name not in (*SURFACE_OPTIONS, *TRACE_OPTIONS):
            raise TypeError(
                f"{verb} has no argument {name!r}{did_you_mean(name, honored)}; "
                f"{_list_of_honored(honored)}"
            )
    _refuse_not_honored(verb, surface, options, keywords, honored)
    surface_keywords = {name: value for name, value in keywords.items() if name in SURFACE_OPTIONS}
    chosen_options = trace_options_among(options, keywords)
    if isinstance(surface, Surface):
        if surface_keywords:
            raise TypeError(
                f"{', '.join(surface_keywords)}: a Surface holds its own; give {verb} "
                f"surface.replace({next(iter(surface_keywords))}=...)"
            )
    else:
        surface = Surface(surface, **surface_keywords)
    return surface, chosen_options


def trace_options(
    verb: str, options: TraceOptions | None, keywords: Mapping[str, Any], honored: Sequence[str]
) -> TraceOptions:
    """Return the `TraceOptions` of a call of a function of the library: `options`, or made from
    those keywords that are options of traces.

    verb: the name of the called function, for messages.
    honored: the names of the options that it has.

    Raises:
        TypeError: both are given; or an option is set that the called function does not have.
    """
    # (None: no surface, so no options of a surface.)
    _refuse_not_honored(verb, None, options, keywords, honored)
    return trace_options_among(options, keywords)


def _refuse_not_honored(
    verb: str, surface: Any, options: Any, keywords: Mapping[str, Any], honored: Sequence[str]
) -> None:
    """Raise TypeError if a called function does not have some of the options that are given as
    keywords, or that are set in `options` or `surface`. One message names all of them, says what to
    write in their place, and lists the options that the function has.

    The arguments are those of `surface_and_options`.
    """
    refused, remedies = [name for name in keywords if name not in honored], list[str]()
    if refused:
        remedies.append(f"leave out {', '.join(refused)}")
    set_options, of_surface = dict[str, str](), dict[str, str]()
    if isinstance(options, TraceOptions):
        set_options = {
            option.name: repr(option.default)
            for option in fields(TraceOptions)
            if option.name not in honored and getattr(options, option.name) != option.default
        }
    if isinstance(surface, Surface):
        if "largest" not in honored and surface.largest:
            of_surface["largest"] = "False"
        if "side" not in honored and surface.solid_range is not None:
            of_surface["side"] = '"surface"'
    for owner, defaults in (("options", set_options), ("surface", of_surface)):
        if defaults:
            changes = ", ".join(f"{name}={default}" for name, default in defaults.items())
            remedies.append(f"give {owner}.replace({changes})")
    refused += [name for name in (*set_options, *of_surface) if name not in refused]
    if refused:
        reason = ": faces of a solid on its clip are no part of a level set"
        raise TypeError(
            f"{verb} has no {', '.join(refused)}; {_list_of_honored(honored)}; "
            f"{' and '.join(remedies)}{reason if 'side' in of_surface else ''}"
        )


def _list_of_honored(honored: Sequence[str]) -> str:
    """Return the part of an error message that lists the options that a function has."""
    return f"of the options of surfaces and traces it has {', '.join(honored)}"


def trace_options_among(options: Any, keywords: Mapping[str, Any]) -> TraceOptions:
    """Return the `TraceOptions` of a call: `options`, or made from those keywords that are options
    of traces; other keywords are ignored.

    Raises:
        TypeError: both are given; `options` is no `TraceOptions`.
    """
    trace_keywords = {name: value for name, value in keywords.items() if name in TRACE_OPTIONS}
    if options is None:
        return TraceOptions(**trace_keywords)
    if not isinstance(options, TraceOptions):
        raise TypeError(f"options must be harnack.TraceOptions(...), not {options!r:.60}")
    if trace_keywords:
        raise TypeError(
            f"{', '.join(trace_keywords)}: there are options already; give all of them in options, "
            f"such as options.replace({next(iter(trace_keywords))}=...), or none"
        )
    return options


def shorthand_parameters() -> dict[str, inspect.Parameter]:
    """Return a keyword-only parameter for each option of `Surface` and `TraceOptions`, by name;
    signatures of functions that take these options as keywords are made from them."""
    kinds: tuple[Callable[..., Any], ...] = (Surface, TraceOptions)
    return {
        name: parameter.replace(kind=parameter.KEYWORD_ONLY)
        for kind in kinds
        for name, parameter in inspect.signature(kind).parameters.items()
        if name in (*SURFACE_OPTIONS, *TRACE_OPTIONS)
    }


def shows_keywords(*honored: str) -> Callable[[_Function], _Function]:
    """Return a decorator for a function that takes `**keywords: Unpack[TraceKeywords]`. The
    signature of the decorated function shows the keywords named in `honored`, with their defaults.
    """
    shorthand = shorthand_parameters()
    return shows_parameters([shorthand[name] for name in honored])


def shows_parameters(
    parameters: Sequence[inspect.Parameter], *, keeps_others: bool = False
) -> Callable[[_Function], _Function]:
    """Return a decorator for a function that takes `**keywords`. The signature of the decorated
    function shows `parameters` by name, in place of `**keywords`.

    keeps_others: whether the signature still shows `**keywords`, as there may be other ones.
    """

    def decorate(verb: _Function) -> _Function:
        """Give the function `verb` the changed signature, and return it."""
        signature = inspect.signature(verb)
        shown = list(signature.parameters.values())
        variadic = [parameter for parameter in shown if parameter.kind is parameter.VAR_KEYWORD]
        shown = [parameter for parameter in shown if parameter not in variadic]
        names = {parameter.name for parameter in shown}
        shown += [parameter for parameter in parameters if parameter.name not in names]
        cast("Any", verb).__signature__ = signature.replace(
            parameters=[*shown, *(variadic if keeps_others else [])]
        )
        return verb

    return decorate
