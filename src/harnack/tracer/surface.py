"""A surface to trace: a field, its levels, clip volumes, and the settings of the tracer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of, to_float
from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.tensors import is_tensor, tensor_to_array
from harnack.backend.validation import as_integer_in_range, check_no_derivatives, flag
from harnack.enclosures import EnclosureChoice, EnclosureKinds, Levels, choose_enclosures
from harnack.fields.field import check_is_field
from harnack.geometry import VolumeIntersection
from harnack.geometry.volume import check_volume
from harnack.tracer.largest_component import largest_component_cells, validate_component_cells
from harnack.tracer.level_contact import HitTolerance
from harnack.tracer.surface_tracer import SurfaceTracer

if TYPE_CHECKING:
    from harnack.backend import Backend, Real
    from harnack.fields.field import Field
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid

_T = TypeVar("_T")

# Levels nearer than this to an integer are traced by samples that know their branch: far away a
# winding number comes arbitrarily near to such a level.
_INTEGER_MARGIN = 1e-3

_FIRST_HITS_ONLY = (
    "largest=... works for first hits alone: it cannot be combined with all_hits, confirm or "
    'antialias="cones"'
)


@dataclass(frozen=True)
class Surface:
    """A surface, that is the points at which a field takes one of the levels, and how to trace it.

    field: the function f.
    levels: one or more numbers, or Dr.Jit numbers; `level_set` fills in the field's default.
    tolerance: see `HitTolerance`.
    max_steps: the number of evaluations of the field after which a ray is out of steps.
    bound: the proofs by which steps are made (`choose_enclosures`).
    clip: a volume to cut the surface with, besides the field's own domain.
    section: another volume, which cuts the surface open: the faces of a solid on it may have a
        material of their own.
    largest: 0 for the whole surface. Otherwise the number of cells along the longest side of the
        box (True for 128), by which components are told apart; components that are not separated by
        cells proved empty count as a single component. Then the surface is only the component, of
        the part within domain and clip, with the largest sum of projected areas along x, y and z
        (`largest_component_cells`).
    confirm: whether a ray hits only where f passes to the other side of the level, by at least half
        the tolerance. A ray that comes within the tolerance and turns back (a graze) goes on.
    solid: (low, high) for the closed solid {low <= f <= high} cut by the volume, whose levels are
        the finite ends; only renderers use it.
    overstep: the over-relaxation factor in [1, 2). Trial steps are this many times as long as the
        proved steps, and are kept if an enclosure behind the trial point covers the rest (Keinert
        et al. 2014). 1 turns over-relaxation off.
    """

    field: Field
    levels: tuple[Real, ...] = ()
    clip: Volume | None = None
    tolerance: HitTolerance = dataclasses.field(default_factory=HitTolerance)
    max_steps: int = 2000
    bound: EnclosureKinds = dataclasses.field(default_factory=choose_enclosures)
    overstep: float = 1.4
    solid: tuple[float, float] | None = None
    confirm: bool = False
    section: Volume | None = None
    largest: int = 0
    # Results of `memoize`; None outside of a call of the library.
    _call_cache: dict[Any, Any] | None = dataclasses.field(
        default=None, repr=False, compare=False, kw_only=True
    )

    def __post_init__(self) -> None:
        check_is_field(self.field)
        if not isinstance(cast("Any", self.levels), tuple):
            raise TypeError(
                f"levels must be a tuple of numbers, not {self.levels!r:.60}; harnack.level_set "
                "makes a Surface of one number, or of several"
            )
        for level in self.levels:
            if not dr.is_array_v(type(level)):
                _number(level)
        if self.solid is not None:
            _ends(self.solid)
        if not isinstance(cast("Any", self.tolerance), HitTolerance):
            raise TypeError(f"tolerance must be a Tolerance, not {self.tolerance!r:.60}")
        if not isinstance(cast("Any", self.bound), EnclosureKinds):
            raise TypeError(
                f"bound must be the Proofs that harnack.level_set makes, not {self.bound!r:.60}"
            )
        object.__setattr__(self, "largest", validate_component_cells(self.largest))
        for name in ("clip", "section"):
            check_volume(getattr(self, name), name)
        object.__setattr__(
            self, "max_steps", as_integer_in_range(self.max_steps, "max_steps", 1, 2**31 - 1)
        )
        flag(self.confirm, "confirm")
        overstep = _as_number(self.overstep, "overstep must be a number in [1, 2)")
        if not 1 <= overstep < 2:
            raise ValueError(f"overstep must lie in [1, 2), not {self.overstep}")
        object.__setattr__(self, "overstep", overstep)  # NumPy's would ask Dr.Jit for numbers
        if self.field.has_jumps and self.field.period is not None:
            raise ValueError("a field with sheets must be real-valued: its period must be None")
        if self.confirm:
            self.validate_crossings("confirm")
        if self.largest and (self.field.has_jumps or self.field.has_patches):
            raise ValueError(
                f"largest=... needs one continuous function, and this {type(self.field).__name__} "
                "jumps or has parts"
            )
        if self.largest and self.confirm:
            raise ValueError(_FIRST_HITS_ONLY)

    def validate_crossings(self, setting: str) -> None:
        """Raise an error if crossings of this surface cannot be traced.

        ValueError for several levels of a field with jumps, as a jump may cross more than one level
        at once; NotImplementedError for a field with patches.

        setting: the name of the setting that needs crossings, for the message.
        """
        if self.field.has_patches:
            raise NotImplementedError(
                f"{setting} takes one function, and this {type(self.field).__name__} has one for "
                "each part: trace a part by itself, such as mesh.face(0) of a polygon mesh"
            )
        if self.field.has_jumps and len(self.levels) > 1:
            raise ValueError(
                f"{setting} takes one level of a field with sheets, such as this "
                f"{type(self.field).__name__}, not {len(self.levels)}: trace each level by itself"
            )

    @property
    def level_values(self) -> tuple[float, ...]:
        """The levels as Python numbers."""
        return tuple(_number(level) for level in self.levels)

    @property
    def clip_volume(self) -> Volume | None:
        """The intersection of clip and section; None if there is neither."""
        return _intersection([self.clip, self.section])

    def with_call_cache(self, *, begins: bool = False) -> Surface:
        """This surface with a cache for a single call of the library, so that field, extent and
        cells are prepared only once. Copies by `dataclasses.replace` share the cache.

        begins: start with an empty cache, as users may have changed the field in place since the
            last call.
        """
        return (
            self if self._call_cache is not None and not begins else replace(self, _call_cache={})
        )

    def memoize(self, what: Any, make: Callable[[], _T]) -> _T:
        """The result of `make()`, cached for this field, these levels and the key `what`. Without a
        cache (outside of a call of the library), `make` is called each time."""
        if self._call_cache is None:
            return make()
        key = what, id(self.field), self.level_values
        if key not in self._call_cache:
            self._call_cache[key] = (
                make(),
                self.field,
            )  # a reference, so that no other field gets its id
        return self._call_cache[key][0]

    @property
    def extent(self) -> Volume | None:
        """The volume that is proved to contain the level sets; None if none is known."""
        return self.memoize("extent", lambda: self.field.extent(self.level_values))

    @property
    def volume(self) -> Volume | None:
        """The volume to which rays are clipped: the intersection of domain, proved extent, clip and
        section; None for all of space."""
        return _intersection([self.field.domain, self.extent, self.clip, self.section])

    def for_rays(self, count: int) -> Surface:
        """The same surface, prepared for this many rays (`Field.for_ray_count`)."""
        return replace(self, field=self.field.for_ray_count(count))

    def evaluator(self, backend: Backend) -> Field:
        """The field, prepared for a backend and cached, with and without derivatives apart."""
        is_followed = any(dr.grad_enabled(one) for one in self.field.parameters())
        what = "field", backend, is_followed
        return self.memoize(
            what, lambda: self.field.with_levels(self.level_values).prepare(backend)
        )

    def target_levels(self, backend: Backend) -> Levels:
        """The levels on a backend."""
        levels = tuple(
            as_kernel_parameters(to_float(backend, level, "level")) for level in self.levels
        )
        return Levels(levels, self.field.period)

    def _occupied(self) -> OccupancyGrid | None:
        """The cells that may contain a level that counts; None if no cells are known."""
        if not self.largest:
            return self.memoize("cells", lambda: self.field.occupied_cells(self.level_values))
        whole = _intersection([self.field.domain, self.extent, self.clip])
        given = self.field, self.level_values, whole, self.solid, self.largest
        what = "largest", self.clip, self.solid, self.largest
        return self.memoize(what, lambda: largest_component_cells(*given))

    def prepare(
        self, backend: Backend, *, crosses: bool = False, many: bool = True
    ) -> SurfaceTracer:
        """The tracer of this surface, with all data on a backend, for use in a recorded kernel.

        crosses: whether rays will look for crossings.
        many: whether there will be so many rays that it pays to search for empty cells first.
        """
        if self.largest and crosses:
            raise ValueError(_FIRST_HITS_ONLY)
        volume, region = self.volume, None
        occupied = self._occupied() if self.largest or (many and not crosses) else None
        if crosses or self.confirm:
            region = _intersection([self.field.domain, self.clip, self.section])
        field, around = self.evaluator(backend), None
        if field.has_unknown_branch and all(
            abs(math.remainder(one, 1)) > _INTEGER_MARGIN for one in self.level_values
        ):
            extent = self.field.extent(_with_reduced_levels(self.level_values))
            around = None if extent is None else extent.prepare(backend)
        return SurfaceTracer(
            backend,
            field,
            self.target_levels(backend),
            None if volume is None else volume.prepare(backend),
            self.bound,
            self.tolerance.prepare(backend),
            dr.opaque(backend.UInt32, self.max_steps),
            self.overstep,
            self.confirm,
            None if region is None else region.prepare(backend),
            None if occupied is None else occupied.upload(backend),
            only_component=self.largest > 0,
            section=None if self.section is None else self.section.prepare(backend),
            known_branch_volume=around,
        )


def level_set(
    field: Field,
    level: Any = None,
    *,
    clip: Volume | None = None,
    tolerance: float | HitTolerance = 1e-4,
    max_steps: int = 2000,
    bound: EnclosureChoice = None,
    overstep: float | None = None,
    solid: tuple[float, float] | None = None,
    confirm: bool = False,
    section: Volume | None = None,
    largest: bool | int = False,
) -> Surface:
    """A `Surface` from user arguments: a level or several levels, a tolerance, the name of a bound.

    level: None for the default level of the field.
    largest: True or a number of cells for the largest component only, as in `Surface`.

    Raises ValueError for a level that is not a finite number or that the field cannot have, and
    TypeError if `field` is no field.
    """
    check_is_field(field)
    if solid is not None:
        if level is not None:
            raise ValueError("give either level or solid: the ends of a solid are its levels")
        low, high = _ends(solid)
        if not low < high or not (math.isfinite(low) or math.isfinite(high)):
            raise ValueError(f"solid must be (low, high) with low < high, one finite, not {solid}")
        if field.period is not None:
            raise ValueError("an angle-valued field has no inside: solid needs a real-valued one")
        if field.has_patches:
            raise ValueError(
                f"a {type(field).__name__} is many surfaces and no closed solid: draw it without "
                "solid"
            )
        if field.has_jumps:
            raise ValueError(
                "a field that jumps across sheets has no closed solid: values between low and "
                "high may end at a sheet, with no level there; draw its level set without solid"
            )
        level = [end for end in (low, high) if math.isfinite(end)]
    asked = _as_levels(field.default_level if level is None else level)
    for one in asked:
        if not math.isfinite(_number(one)):
            raise ValueError(f"level must be finite, not {_number(one)}")
    field.validate_levels(tuple(_number(one) for one in asked))
    if not isinstance(tolerance, HitTolerance):
        tolerance = HitTolerance(_as_number(tolerance, "tolerance must be a length or a Tolerance"))
    overstep = field.over_relaxation if overstep is None else overstep
    return Surface(
        field,
        asked,
        clip,
        tolerance,
        max_steps,
        choose_enclosures(bound),
        overstep,
        solid,
        confirm,
        section,
        largest,
    )


def _with_reduced_levels(levels: tuple[float, ...]) -> tuple[float, ...]:
    """The levels, and for those farther from 0 than a half the nearest ones of the same ladder,
    which |f| reaches sooner."""
    rungs = dict.fromkeys(math.remainder(level, 1) for level in levels if abs(level) > 0.5)
    return levels + tuple(rung for rung in rungs if rung not in levels)


def _intersection(parts: Sequence[Volume | None]) -> Volume | None:
    """The intersection of some volumes; None, for all of space, if there are none."""
    kept = list(dict.fromkeys(part for part in parts if part is not None))
    if not kept:
        return None
    return kept[0] if len(kept) == 1 else VolumeIntersection(tuple(kept))


def _as_levels(level: Any) -> tuple[Any, ...]:
    if is_tensor(level):
        numbers = tensor_to_array(level, "level")
        backend = backend_of(numbers)
        each = map(backend.UInt32, range(dr.width(numbers)))
        return tuple(dr.gather(backend.Float, numbers, k) for k in each)
    is_row = isinstance(level, np.ndarray) and np.ndim(cast("Any", level)) == 1
    if is_row or (isinstance(level, Sequence) and not isinstance(level, str)):
        several: list[Any] = [*level]
        if not several:
            raise ValueError("level: give at least one")
        parts = [_as_levels(one) if is_tensor(one) else (one,) for one in several]
        return tuple(one for part in parts for one in part)
    return (cast("Any", level),)


def _ends(solid: Any) -> tuple[float, float]:
    wrong = "solid must be (low, high), two numbers"
    try:
        low, high = solid
    except (TypeError, ValueError):
        raise TypeError(f"{wrong}, not {solid!r}") from None
    return _as_number(low, wrong), _as_number(high, wrong)


def _as_number(number: Any, wrong: str) -> float:
    check_no_derivatives("a level or setting that is no Dr.Jit number", number)
    try:
        return float("nothing" if isinstance(number, str | bool | np.bool_) else number)
    except (TypeError, ValueError):
        raise TypeError(f"{wrong}, not {number!r}") from None


def _number(level: Any) -> float:
    if dr.is_array_v(type(level)):
        return float(dr.detach(level)[0])
    return _as_number(level, "level must be a number, or several, such as 0.5 or 2 * math.pi")
