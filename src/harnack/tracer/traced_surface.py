"""`TracedSurface`: a `Surface` with `TraceOptions`, and the data that one call of the library (of
`trace`, `render`, `mesh` and others) prepares from both. The surface consists of the points at
which a function f, the field, takes one of given values, the levels; or it is the boundary of a
solid, on which f lies in a range.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import numpy as np

from harnack.backend import to_float
from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.validation import check_length_range
from harnack.enclosures import EnclosureKinds, Levels, choose_enclosures
from harnack.fields.evaluator import Plan
from harnack.fields.field import checked_evaluator
from harnack.fields.parameters import differentiable_parameters
from harnack.geometry import ConvexHull
from harnack.name_suggestions import with_article
from harnack.tracer.largest_component import largest_component_cells
from harnack.tracer.level_contact import HitTolerance
from harnack.tracer.surface import Surface, intersection_of, level_number, side_range
from harnack.tracer.surface_tracer import SurfaceTracer
from harnack.tracer.trace_options import (
    SURFACE_OPTIONS,
    TRACE_OPTIONS,
    TraceOptions,
    surface_and_options,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Real
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Field
    from harnack.geometry import Volume
    from harnack.tracer.surface import Side
    from harnack.tree.empty_space import OccupancyGrid

_T = TypeVar("_T")

# Levels nearer than this to an integer are traced by samples that know their branch: far away a
# winding number comes arbitrarily near to such a level.
_INTEGER_MARGIN = 1e-3
# The default tolerance, as a fraction of the longest side of the box; and for unbounded surfaces.
_RELATIVE_TOLERANCE, _UNBOUNDED_TOLERANCE = 1e-4, 1e-4
# From this number of rays on, extents have at most this number of planes.
_MANY_RAYS, _MAX_PLANES = 1_000_000, 48

_FIRST_HITS_ONLY = (
    "largest=... works for first hits alone: it cannot be combined with crossings, "
    'require_crossing or antialias="cones"'
)


class CallCache:
    """Keeps results for the length of one call of the library, by a field and a key. Unlike those
    of a `FieldCache`, which last as long as the field, they need not be compared with the field's
    attributes, which do not change during a call; and they may refer to the field."""

    def __init__(self) -> None:
        self._kept: dict[Any, tuple[Any, Field]] = {}

    def get_or_make(self, field: Field, key: Any, make: Callable[[], _T]) -> _T:
        """Return the result for this field and key: that of `make()` at the first time."""
        full_key = id(field), key
        if full_key not in self._kept:
            # With a reference to the field, so that no other field gets its id.
            self._kept[full_key] = make(), field
        return self._kept[full_key][0]


@dataclass(frozen=True)
class TracedSurface:
    """A surface and how rays are traced to it, for one call of the library. The surface consists of
    the points at which f takes one of the levels, or is the boundary of a solid.

    field: the function f.
    levels: the values of f on the surface, which may be Dr.Jit numbers.
    clip, section: volumes that cut the surface; None for all of space. The faces of a solid on
        `section` may have a material of their own.
    side: "surface" or None for the level set; "below", "above" or "between" for a solid.
    largest: the number of cells along the longest side of the box by which the largest component is
        told apart; 0 for all components.
    tolerance: how near to the surface a hit must be; None for one that follows the size of the
        surface (`hit_tolerance`).
    enclosures: the classes of enclosures by which steps are proved. An enclosure is an interval
        that is proved to contain the change of f along a ray.
    max_steps: the number of evaluations of f after which a ray is out of steps.
    over_relaxation: trial steps are at most this many times as long as proved steps.
    require_crossing: whether a ray hits only where f passes to the other side of the level.
    ray_count: the number of rays that will be traced; 0 if it is not known. For many rays a field
        may make a longer preparation (`Plan`).
    """

    field: Field
    levels: tuple[Real, ...] = ()
    clip: Volume | None = None
    section: Volume | None = None
    side: Side | None = None
    largest: int = 0
    tolerance: HitTolerance | None = None
    enclosures: EnclosureKinds = dataclasses.field(default_factory=choose_enclosures)
    max_steps: int = 2000
    over_relaxation: float = 1.4
    require_crossing: bool = False
    ray_count: int = 0
    # Results of `memoize`; None outside of a call of the library.
    _call_cache: CallCache | None = dataclasses.field(
        default=None, repr=False, compare=False, kw_only=True
    )

    def __post_init__(self) -> None:
        if self.require_crossing:
            self.validate_crossings("require_crossing")
            if self.largest:
                raise ValueError(_FIRST_HITS_ONLY)

    @classmethod
    def of(cls, surface: Surface, options: TraceOptions) -> TracedSurface:
        """Combine a surface with the options of a call.

        Raises:
            ValueError, NotImplementedError: options that this surface cannot have.
        """
        over_relaxation, default_over_relaxation = (
            options.over_relaxation,
            surface.field.traits.over_relaxation,
        )
        return cls(
            surface.field,
            surface.levels,
            **surface.keywords,
            tolerance=options.hit_tolerance,
            enclosures=options.enclosure_kinds,
            max_steps=options.max_steps,
            over_relaxation=default_over_relaxation if over_relaxation is None else over_relaxation,
            require_crossing=options.require_crossing,
        )

    @property
    def surface(self) -> Surface:
        """The field with its levels, volumes and side as a `Surface`, without the options of
        traces."""
        return Surface(
            self.field, self.levels, clip=self.clip, section=self.section, side=self.side,
            largest=self.largest,
        )  # fmt: skip

    @property
    def options(self) -> TraceOptions:
        """The options of traces as a `TraceOptions`, without the surface."""
        return TraceOptions(
            tolerance=self.tolerance, enclosures=self.enclosures, max_steps=self.max_steps,
            over_relaxation=self.over_relaxation, require_crossing=self.require_crossing,
        )  # fmt: skip

    def validate_crossings(self, option: str) -> None:
        """Raise an error if this surface is of a kind whose crossings with rays cannot be counted.

        option: the name of the function or option that needs crossings, for the message.

        Raises:
            ValueError: the field has jumps and there are several levels; a jump may cross more than
                one level at once.
            NotImplementedError: the field is a union of patches, each with a function of its own.
        """
        if self.field.traits.has_patches:
            raise NotImplementedError(
                f"{option} takes one function, and this {type(self.field).__name__} has one for "
                "each patch: trace a patch by itself, such as mesh.face(0) of a polygon mesh"
            )
        if self.field.traits.has_jumps and len(self.levels) > 1:
            raise ValueError(
                f"{option} takes one level of a field with jumps, such as this "
                f"{type(self.field).__name__}, not {len(self.levels)}: trace each level by itself"
            )

    @property
    def level_values(self) -> tuple[float, ...]:
        """The levels as Python numbers."""
        return tuple(level_number(level) for level in self.levels)

    @property
    def clip_volume(self) -> Volume | None:
        """The intersection of clip and section; None if there is neither."""
        return intersection_of([self.clip, self.section])

    @property
    def solid_range(self) -> tuple[float, float] | None:
        """The interval (low, high) of the values of f on the closed solid; None if the surface is
        the level set itself."""
        return side_range(self.side, self.level_values)

    def with_call_cache(self, *, begins: bool = False) -> TracedSurface:
        """Return this surface with a cache for a single call of the library, so that its field,
        extent and cells are made only once. Copies made by `dataclasses.replace` share the
        cache. A surface that has a cache is returned unchanged.

        begins: whether to start with an empty cache even if the surface has one, as users may have
            changed the field in place since the last call.
        """
        if self._call_cache is not None and not begins:
            return self
        return replace(self, _call_cache=CallCache())

    def memoize(self, key: Any, compute: Callable[[], _T]) -> _T:
        """Return `compute()`. Within a call of the library the result is cached for this field,
        these levels and `key`; otherwise `compute` is called each time."""
        if self._call_cache is None:
            return compute()
        return self._call_cache.get_or_make(self.field, (key, self.level_values), compute)

    @property
    def extent(self) -> Volume | None:
        """The volume in which the level sets are proved to lie; None if none is known. For many
        rays a polytope has only some of its planes: with hundreds, clipping rays takes longer than
        the march of a field with cells."""
        extent = self.memoize("extent", lambda: self.field.extent(self.level_values))
        if self.ray_count >= _MANY_RAYS and isinstance(extent, ConvexHull):
            return extent.with_planes(_MAX_PLANES)
        return extent

    @property
    def volume(self) -> Volume | None:
        """The volume to which rays are clipped: the intersection of the field's domain, the proved
        extent, clip and section; None for all of space."""
        return intersection_of([self.field.domain, self.extent, self.clip, self.section])

    @property
    def hit_tolerance(self) -> HitTolerance:
        """How near to the surface a hit must be: the tolerance that was set, or else 1e-4 of the
        longest side of the box of `volume` (1e-4 if this box is unbounded)."""
        return default_tolerance(self.volume) if self.tolerance is None else self.tolerance

    def for_rays(self, count: int) -> TracedSurface:
        """Return this surface with the number of rays that will be traced, `ray_count`."""
        return replace(self, ray_count=count)

    def evaluator(self, backend: Backend) -> Evaluator:
        """Return the field's evaluator for these levels and this number of rays. It is cached; a
        field with derivatives enabled and one without have separate entries."""
        parameters = differentiable_parameters(self.field)
        has_derivatives = any(map(dr.grad_enabled, parameters))
        key, plan = ("evaluator", backend, self.ray_count, has_derivatives), self.plan
        return self.memoize(key, lambda: checked_evaluator(self.field, backend, plan))

    @property
    def plan(self) -> Plan:
        """What evaluators of the field will be used for."""
        return Plan(self.level_values, self.ray_count)

    def target_levels(self, backend: Backend) -> Levels:
        """Return the levels as Dr.Jit numbers that kernels take as parameters, with the period of
        the field."""
        levels = tuple(
            as_kernel_parameters(to_float(backend, level, "level")) for level in self.levels
        )
        return Levels(levels, self.field.period)

    def _occupied(self, evaluator: Evaluator) -> OccupancyGrid | None:
        """Return the grid of cells with a mark on those that may contain a level of the surface;
        None if no cells are known. If only the largest component is traced, only its cells are
        marked.

        evaluator: the field's evaluator for these levels and this number of rays.
        """
        # `largest` is a number of cells, 0 for all components. Results are kept for this field,
        # these levels and a key; the key has what else they depend on.
        if not self.largest:
            return self.memoize(("cells", self.ray_count), evaluator.occupied_cells)
        volume = intersection_of([self.field.domain, self.extent, self.clip])
        key = "largest", self.clip, self.side, self.largest
        return self.memoize(
            key,
            lambda: largest_component_cells(
                self.field, self.level_values, volume, self.solid_range, self.largest
            ),
        )

    def _check_size(self, backend: Backend) -> None:
        """Raise ValueError if the surface is too large or too small for a backend's precision."""
        around, volume = intersection_of([self.field.domain, self.extent]), self.volume
        for box in (around, volume):
            if box is not None:
                check_length_range(box.bounds(), backend.precision, "the surface has")

    def tracer(
        self, backend: Backend, *, crosses: bool = False, many_rays: bool = True
    ) -> SurfaceTracer:
        """Return the tracer of this surface, with all data on a backend, for use in a recorded
        kernel.

        crosses: whether rays will look for crossings, and not for first hits.
        many_rays: whether there will be so many rays that it saves time to compute first which
            cells contain no level.

        The tracer of a field whose samples may lack an unknown integer (a winding number modulo 1)
        gets a volume outside of which the integer is known; but not if a level is nearly an
        integer.
        """
        if self.largest and crosses:
            raise ValueError(_FIRST_HITS_ONLY)
        volume, region = self.volume, None
        self._check_size(backend)
        evaluator, known_volume = self.evaluator(backend), None
        needs_cells = self.largest or (many_rays and not crosses)
        occupied = self._occupied(evaluator) if needs_cells else None
        # Rays that look for crossings start a little outside the extent, but inside `region`.
        if crosses or self.require_crossing:
            region = intersection_of([self.field.domain, self.clip, self.section])
        # No level may be nearly an integer.
        if evaluator.modulo_one is not None and all(
            abs(math.remainder(level, 1)) > _INTEGER_MARGIN for level in self.level_values
        ):
            # Outside the extent of the levels and of their remainders modulo 1, f is nearer to 0
            # than all of these.
            extent = self.field.extent(_with_reduced_levels(self.level_values))
            known_volume = None if extent is None else extent.upload(backend)
        return SurfaceTracer(
            backend,
            self.field,
            evaluator,
            self.target_levels(backend),
            None if volume is None else volume.upload(backend),
            self.enclosures,
            self.hit_tolerance.upload(backend),
            dr.opaque(backend.UInt32, self.max_steps),
            self.over_relaxation,
            self.require_crossing,
            None if region is None else region.upload(backend),
            None if occupied is None else occupied.upload(backend),
            only_component=self.largest > 0,
            section=None if self.section is None else self.section.upload(backend),
            known_branch_volume=known_volume,
        )


def traced_surface(
    surface: Field | Surface | TracedSurface,
    options: TraceOptions | None = None,
    *,
    verb: str = "a trace",
    **keywords: Any,
) -> TracedSurface:
    """Make the `TracedSurface` of a call of a function of the library (`trace`, `render`, ...).

    surface: a `TracedSurface`, which is returned; a `Surface`; or a field, with keywords of
        `Surface`.
    options: a `TraceOptions`; or keywords in its place.
    verb: the name of the called function, for messages.

    Raises:
        TypeError, ValueError: keywords that contradict the objects beside them, or values that
            `Surface` or `TraceOptions` refuses.
    """
    if isinstance(surface, TracedSurface) and options is None and not keywords:
        return surface
    honored = (*SURFACE_OPTIONS, *TRACE_OPTIONS)
    return TracedSurface.of(*surface_and_options(verb, surface, options, keywords, honored))


def check_has_inside(surface: TracedSurface) -> None:
    """Raise ValueError if the surface is meant as the boundary of a solid, and the field is of a
    kind that has no closed solids: angle-valued, with jumps, or a union of patches."""
    field = surface.field
    if surface.solid_range is None:
        return
    if field.period is not None:
        raise ValueError("an angle-valued field has no inside: side needs a real-valued one")
    if field.traits.has_patches:
        raise ValueError(
            f"{with_article(type(field).__name__)} is many surfaces and no closed solid: draw it "
            "without side"
        )
    if field.traits.has_jumps:
        raise ValueError(
            "a field that jumps has no closed solid: values on one side may end at a facet, with "
            "no level there; draw its level set without side"
        )


def default_tolerance(volume: Volume | None) -> HitTolerance:
    """Return the default tolerance of hits: 1e-4 of the longest side of the box of a volume; the
    length 1e-4 if the volume is None or unbounded."""
    side = math.nan if volume is None else float(np.ptp(np.array(volume.bounds()), axis=0).max())
    is_bounded = math.isfinite(side) and side > 0
    return HitTolerance(_RELATIVE_TOLERANCE * side if is_bounded else _UNBOUNDED_TOLERANCE)


def _with_reduced_levels(levels: tuple[float, ...]) -> tuple[float, ...]:
    """Return the levels, and after them further levels: for each level of more than 1/2 in absolute
    value, its remainder modulo 1, the number in [-1/2, 1/2] that differs from it by an integer."""
    remainders = dict.fromkeys(math.remainder(level, 1) for level in levels if abs(level) > 0.5)
    return levels + tuple(level for level in remainders if level not in levels)
