"""The function `trace`, which gives the hits of rays with a surface, and its result `Hits`.

NumPy rays give NumPy arrays, Dr.Jit rays give Dr.Jit arrays, and tensors give tensors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, cast, overload

import drjit as dr
import numpy as np

from harnack.backend import backend_of, choose_backend, to_float, to_numpy, to_vector3
from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.elementary import fmax, max_norm, safe_normalize
from harnack.backend.elementary import safe_norm as norm
from harnack.backend.loops import compute_on_active
from harnack.backend.tensors import array_to_tensor, is_tensor, tensor_to_array, tensor_to_vectors
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.name_suggestions import is_one_of
from harnack.tracer.crossings import (
    RayCrossings,
    check_all_hits,
    crossings_to_numpy,
    empty_crossings,
    trace_crossings,
)
from harnack.tracer.derivatives import attach_derivatives, needs_derivatives, refuse_derivative
from harnack.tracer.doubtful import Doubtful, seen_distance
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.surface import Surface, level_set
from harnack.webgpu import evaluate_on_device, find_device

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Precision, Real, Vec3
    from harnack.enclosures import EnclosureChoice
    from harnack.fields.field import Field
    from harnack.geometry import Volume
    from harnack.tracer.surface_tracer import MarchResult, SurfaceTracer
    from harnack.webgpu import Arrays

# From so many rays on it pays to look for empty cells first.
_MIN_RAYS_FOR_CELLS = 4096
# Rays are scattered where the directions of neighbors are farther apart than this, or their origins
# than this fraction of the spread of all (both as roots of mean squares), by so many of them.
_MAX_TURN, _MAX_STRAY, _SAMPLED_RAYS = 0.15, 0.7, 4096
# A hit is doubtful where rounding adds more than this part of the tolerance to how far the surface
# may be to first order, and more than so many roundings of the point: it is taken for so many times
# as far, as where so many sheets meet. Where it is farther than so many tolerances to first order
# the surface is looked for instead, which takes a kernel.
_PART, _OF_POINTS, _SHEETS, _LARGE = 0.5, 64, 3, 8


@dataclass(frozen=True)
class Hits:
    """The ends of n rays, as NumPy arrays or, if the rays were Dr.Jit arrays or tensors, as these.

    is_hit: (n,) mask of rays that hit. Rays that ran out of steps have a finite t as well, so that
        `isfinite(t)` is no such mask.
    t: (n,) ray parameter of the hit, a length; inf for a miss; for a ray that ran out of steps, the
        parameter up to which it is proved free. A hit is within the tolerance of the first root,
        mostly before it. A confirmed hit is at a root, between two samples with f on different
        sides of the level: at the root of the cubic through their values and slopes, or of a
        bisection if there is a crease between them.
    position: (n, 3) point at t, NaN for a miss.
    normal: (n, 3) unit normal grad f/|grad f|, or of the facet that was hit, to the side of larger
        f; zero for rays without a hit.
    value: (n,) f at the last accepted point; for an angle-valued field up to a multiple of its
        period. For hits on facets, f just before the facet.
    evaluations: (n,) number of evaluations of the field.
    status: (n,) a `RayStatus`.
    primitive_index: (n,) index of the facet (such as a triangle) or of the patch (such as a face of
        a `PolygonMesh`) that was hit; -1 for misses, for hits of a smooth level set, and for all
        rays of fields that have neither facets nor patches.
    uncertainty: (n,) a length: at a hit of a smooth level set, |f - level| is proved to be at most
        (tolerance + uncertainty) |grad f|. It is 0 if the error of f is within the tolerance, and
        for all other rays. Where |grad f| may be unbounded, the surface is proved to be within the
        tolerance, or within the rounding of the point (see `HitTolerance`). Elsewhere, tolerance +
        uncertainty bounds the distance to first order: along lines and at points where grad f is 0
        and f - level behaves as a power u^m of the distance, as where m sheets of the surface meet,
        the surface may be m times as far (beside the edge of a cusp, as of y^2 = x^3, farther:
        0.002 for a tolerance of 1e-4, and 0.02 with x^5). Rounding hides the surface there from
        afar. If rounding adds more than half the tolerance, the uncertainty is that of three
        sheets. If it adds seven tolerances or more, the surface was seen within tolerance +
        uncertainty: f is certainly on different sides of the level there, or touches it up to its
        error. It is infinite if the surface was not seen within a sixteenth of the size of
        coordinates. (The evaluations of this search are not in `evaluations`.) Along a ray that
        grazes such a point, t may be too small by more than the uncertainty: the ray is not proved
        free any farther. Use `precision="double"`, or `confirm`.
    """

    t: Any
    position: Any
    normal: Any
    value: Any
    evaluations: Any
    status: Any
    primitive_index: Any
    uncertainty: Any

    @property
    def is_hit(self) -> Any:
        """(n,) mask of rays that hit."""
        return self.status == int(RayStatus.HIT)


@overload
def trace(
    field: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    level: Any = None,
    t_min: Any = 0.0,
    t_max: Any = math.inf,
    tolerance: float | HitTolerance = 1e-4,
    max_steps: int = 2000,
    bound: EnclosureChoice = None,
    clip: Volume | None = None,
    section: Volume | None = None,
    largest: bool | int = False,
    overstep: float | None = None,
    precision: Precision | None = None,
    confirm: bool = False,
    all_hits: None = None,
    backend: Literal["webgpu"] | None = None,
) -> Hits: ...


@overload
def trace(
    field: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    level: Any = None,
    t_min: Any = 0.0,
    t_max: Any = math.inf,
    tolerance: float | HitTolerance = 1e-4,
    max_steps: int = 2000,
    bound: EnclosureChoice = None,
    clip: Volume | None = None,
    section: Volume | None = None,
    largest: bool | int = False,
    overstep: float | None = None,
    precision: Precision | None = None,
    confirm: bool = False,
    all_hits: int,
    backend: None = None,
) -> RayCrossings: ...


@accepts_dask_arrays("origins", "directions", "t_min", "t_max")
def trace(
    field: Field | Surface,
    origins: Any,
    directions: Any,
    *,
    level: Any = None,
    t_min: Any = 0.0,
    t_max: Any = math.inf,
    tolerance: float | HitTolerance = 1e-4,
    max_steps: int = 2000,
    bound: EnclosureChoice = None,
    clip: Volume | None = None,
    section: Volume | None = None,
    largest: bool | int = False,
    overstep: float | None = None,
    precision: Precision | None = None,
    confirm: bool = False,
    all_hits: int | None = None,
    backend: Literal["webgpu"] | None = None,
) -> Hits | RayCrossings:
    """First hits of rays with a level set of a field. No hit is missed: every step is proved.

    field: the field to trace; or a `Surface`, which then holds all the settings.
    origins, directions: (n, 3) array-likes or Dr.Jit tensors (one of them may be (1, 3)), or Dr.Jit
        3-vectors. Directions need not have length 1; t counts multiples of the *unit* direction, so
        it is a length.
    level: level or levels; None for the field's default. May be a Dr.Jit number.
    t_min, t_max: (n,) or a number. With an infinite t_max, a ray that leaves the proved extent of
        the surface is a proved miss.
    tolerance: a length, or a `HitTolerance`. In single precision not below about 1e-6 of the
        size of the coordinates.
    bound: the proofs to use: None for all that pay; "classic" for the published rule, "slope",
        "caps", "curvature", "lipschitz"; or classes of enclosures, such as
        `harnack.SphericalCapEnclosure`.
    clip, section: volumes with which the surface is intersected.
    largest: trace only the largest component of the surface within domain and clip, as far as
        components are separated by cells proved empty. True for 128 cells along the longest side of
        the box, or their number. Rays that start so far away that rounding is more than a part of a
        cell are out of steps.
    precision: "single" or "double" for NumPy input; Dr.Jit input keeps its own precision.

    confirm: a hit counts only if f passes to the other side of the level: a ray that comes within
        the tolerance of a level and turns back does not hit it. The hit is then at a root. The
        guarantees are those of `all_hits`.
    all_hits: the number of crossings of each ray to return, in order, as `RayCrossings`. If f goes
        farther than the tolerance to both sides of the level, the crossing is not missed, and no
        crossing is counted twice. Touching a level without passing to its other side is no
        crossing, and neither is starting on it. If levels are closer in value than four tolerances,
        a quarter of their distance is the tolerance; rays run out of steps if that is below
        rounding. Otherwise the tolerance is at least eight times the rounding error of f, in single
        precision about 1e-5 of the size of the coordinates: if f goes less far than that to one
        side, the crossing may not count. `max_steps` is for the whole ray.

    backend: "webgpu" traces NumPy rays in single precision on any GPU of the system, by the package
        `wgpu` (`pip install harnack[webgpu]`), with a translation of the kernel that Dr.Jit
        records. Rounding is proved for Dr.Jit's own backends only; so at each call up to 4,096 of
        the rays are traced there, too, and the device must agree.

    With Dr.Jit rays, t and position carry derivatives with respect to rays, level, and vertices of
    a `SolidAngle`, if these have derivatives enabled (implicit differentiation at the hit). The
    other results have no derivatives: in reverse mode, using theirs raises NotImplementedError; in
    forward mode they are NaN. Fields of other numbers with derivatives enabled are refused.

    On processors, if there are at least 4,096 rays and neighbors have little to do with each other,
    rays are traced by few lanes that share a queue, unless samples are cheap (`Field.is_cheap`).
    This gives the same hits, bit by bit, in about half the time.

    Raises ValueError or TypeError for shapes that do not match, NaN, directions of length zero,
    an empty or negative interval, or a level that no surface has. With a backend, RuntimeError if
    there is no device or the device disagrees; NotImplementedError for a field whose kernel is not
    translated.
    """
    if backend is not None:
        _check_backend(backend, (origins, directions, t_min, t_max), precision, all_hits)
    surface = (
        field
        if isinstance(field, Surface)
        else level_set(
            field, level, clip=clip, section=section, largest=largest,
            tolerance=tolerance, max_steps=max_steps, bound=bound, overstep=overstep,
            confirm=confirm,
        )
    )  # fmt: skip
    k = None if all_hits is None else check_all_hits(all_hits, surface)
    if any(is_tensor(a) for a in (origins, directions)):
        return _trace_tensors(surface, origins, directions, t_min, t_max, precision, k)
    given = [a for a in (origins, directions) if dr.is_array_v(type(a))]
    if given and precision is not None:
        raise ValueError("precision follows Dr.Jit rays; give it only with NumPy ones")
    own = (
        backend_of(given[0])
        if given
        else choose_backend("single" if precision is None else precision)
    )
    o, d, near, far = _rays(own, origins, directions, t_min, t_max)
    n = max(dr.width(array) for array in (o, d, near, far))
    if min(dr.width(array) for array in (o, d, near, far)) == 0:
        n = 0
    if k is not None:
        all_of_them = empty_crossings(own)
        if n > 0:
            all_of_them = trace_crossings(
                surface, own, o, d, near, far, k, differentiable=bool(given)
            )
        return all_of_them if given else crossings_to_numpy(all_of_them, n, k)
    if n == 0:
        return _no_hits(own, as_numpy=not given)
    if backend is not None:
        return _trace_on_device(surface, own, (o, d, near, far), n)
    hits = _trace(surface, own, o, d, near, far, differentiable=bool(given))
    return hits if given else _as_numpy(hits, max(dr.width(o), dr.width(d), dr.width(near)))


def _trace_tensors(
    surface: Surface,
    origins: Any,
    directions: Any,
    t_min: Any,
    t_max: Any,
    precision: Precision | None,
    k: int | None,
) -> Any:
    """The result of `trace` for rays that are tensors, or some of which are: tensors of the shapes
    of `Hits`, or of `RayCrossings` for k crossings a ray."""
    rays = {"origins": origins, "directions": directions}
    vectors = [tensor_to_vectors(a, name) if is_tensor(a) else a for name, a in rays.items()]
    ends = {"t_min": t_min, "t_max": t_max}
    near, far = (tensor_to_array(a, name) if is_tensor(a) else a for name, a in ends.items())
    hits = trace(
        surface, *vectors, t_min=near, t_max=far, precision=precision, all_hits=cast("int", k)
    )
    n = dr.width(hits.status)
    if k is None:
        return Hits(*(array_to_tensor(value, (n,)) for value in vars(hits).values()))
    of_rays = {"count", "traced_to", "status", "evaluations"}
    shapes = {name: (n,) if name in of_rays else (n, k) for name in vars(hits)}
    return RayCrossings(
        *(array_to_tensor(getattr(hits, name), shape) for name, shape in shapes.items())
    )


def _rays(
    backend: Backend, origins: Any, directions: Any, t_min: Any, t_max: Any
) -> tuple[Vec3, Vec3, Real, Real]:
    o = as_kernel_parameters(to_vector3(backend, origins, "origins"))
    d = as_kernel_parameters(to_vector3(backend, directions, "directions"))
    near, far = to_float(backend, t_min, "t_min"), to_float(backend, t_max, "t_max")
    widths = {"origins": o, "directions": d, "t_min": near, "t_max": far}
    lengths = {name: dr.width(array) for name, array in widths.items()}
    n = max(lengths.values()) if min(lengths.values()) > 0 else 0
    for name, length in lengths.items():
        if length not in (1, n):
            raise ValueError(f"{name} has {length} entries, the others have {n}; give 1 or {n}")
    if not n:
        return o, d, near, far
    if not dr.is_array_v(type(directions)):
        _check_numpy_rays(to_numpy(max_norm(d)), to_numpy(near), to_numpy(far))
    return o, safe_normalize(d), near, far


def _check_numpy_rays(largest: Any, near: Any, far: Any) -> None:
    zero = np.flatnonzero(~(largest >= np.finfo(largest.dtype).smallest_normal))
    if zero.size:
        raise ValueError(
            f"directions: entry {zero[0]} has length zero, or is shorter than the smallest number "
            "that this precision holds; a ray needs a direction"
        )
    if (near < 0).any():
        raise ValueError("t_min must be >= 0: rays run forwards")
    empty = np.flatnonzero(~(near <= far))
    if empty.size:
        raise ValueError(f"t_max is smaller than t_min for ray {empty[0]}: swap them")


def _trace(
    surface: Surface,
    backend: Backend,
    o: Vec3,
    d: Vec3,
    near: Real,
    far: Real,
    *,
    differentiable: bool,
) -> Hits:
    count = dr.width(o, d)
    prepared = surface.for_rays(count).prepare(backend, many=count >= _MIN_RAYS_FOR_CELLS)
    if not prepared.field.is_cheap and _are_scattered(backend, dr.detach(o), dr.detach(d)):
        prepared = replace(prepared, uses_ray_queue=True)
    with dr.suspend_grad():
        origin, direction = dr.detach(o), dr.detach(d)
        rays = origin, direction, dr.detach(near), dr.detach(far)
        end, hits, doubt = _first_hits(prepared, *rays)
        if doubt is not None:
            hits = _with_seen_distances(prepared, hits, doubt)
    if differentiable and needs_derivatives(prepared, o, d):
        t, normal = attach_derivatives(prepared, o, d, end, hits.normal)
        normal, value, uncertainty = (
            refuse_derivative(prepared, o, d, name, one)
            for name, one in (
                ("normal", normal), ("value", hits.value), ("uncertainty", hits.uncertainty),
            )
        )  # fmt: skip
        position = _positions(o, d, t)
        hits = replace(
            hits, t=t, position=position, normal=normal, value=value, uncertainty=uncertainty
        )
    dr.eval(*vars(hits).values())
    return hits


def _are_scattered(backend: Backend, o: Vec3, d: Vec3) -> bool:
    """Whether many rays follow each other that have little to do with each other, unlike those of a
    camera. Of a packet of a processor most would then wait for the longest: bounces and chords
    through curves, clouds and unions of shapes take half the time by a queue, and a camera's rays a
    fifth more (measured)."""
    count = dr.width(o, d)
    if count < _MIN_RAYS_FOR_CELLS or dr.backend_v(d) != dr.JitBackend.LLVM:
        return False
    step = (count - 1) // min(count - 1, _SAMPLED_RAYS)
    first = dr.arange(backend.UInt32, (count - 1) // step) * dr.opaque(backend.UInt32, step)

    def seen(rays: Vec3, row: Any) -> FloatArray:
        at = row if dr.width(rays) > 1 else 0 * row
        return to_numpy(dr.gather(backend.Array3f, rays, at)).astype(np.float64)

    with np.errstate(over="ignore", invalid="ignore"):  # of rays that are no rays
        begin, stray = seen(o, first), seen(o, first) - seen(o, first + 1)
        turned = seen(d, first) - seen(d, first + 1)
        turns = np.square(turned).sum(axis=1).mean() > _MAX_TURN**2
        spread = 2 * begin.var(axis=0).sum()
        return bool(turns or np.square(stray).sum(axis=1).mean() > _MAX_STRAY**2 * spread > 0)


def _first_hits(
    prepared: SurfaceTracer, o: Vec3, d: Vec3, near: Real, far: Real
) -> tuple[MarchResult, Hits, _Doubt | None]:
    """Ends of rays, the same as `Hits`, without derivatives, and how sure hits are; None where
    no hit leaves a doubt."""
    backend = prepared.backend
    end = prepared.first_hit(o, d, near, far)
    hit = end.status == int(RayStatus.HIT)
    length = norm(end.gradient)
    normal = dr.select(hit & (length > 0), end.gradient / length, 0)
    sheet = dr.full(backend.Int32, -1, dr.width(end.status))
    if prepared.field.has_jumps:
        sheet = dr.reinterpret_array(backend.Int32, end.facet)  # NO_FACET becomes -1
    if end.patch is not None:
        sheet = dr.reinterpret_array(backend.Int32, end.patch)
    smooth = hit & ~end.at_jump
    # Where the gradient is no number its size has no bound (`tracer.steep`).
    uncertain = smooth & (end.tolerance_excess > 0) & (length == length)
    uncertainty = dr.select(uncertain, end.tolerance_excess / length, 0)
    doubt = None
    if end.side is None and not prepared.field.is_steep:  # others are at a root, or looked at
        doubt = _Doubt.of(prepared, o, end.t, length, uncertainty)
        farther = _SHEETS * doubt.distance - doubt.tolerance
        uncertainty = dr.select(doubt.is_doubtful, farther, uncertainty)
    position = _positions(o, d, end.t)
    hits = Hits(end.t, position, normal, end.value, end.evaluations, end.status, sheet, uncertainty)
    return end, hits, doubt


# How far the surface is from hits that rounding may have made.


@dataclass(frozen=True)
class _Doubt:
    """How sure hits are.

    size: of coordinates up to there. tolerance: as a length. distance: of the surface, to first
    order, with what rounding may add. is_doubtful: whether that may be much too short.
    """

    size: Real
    tolerance: Real
    distance: Real
    is_doubtful: Mask

    @classmethod
    def of(
        cls, prepared: SurfaceTracer, o: Vec3, t: Real, steepness: Real, uncertainty: Real
    ) -> _Doubt:
        """That of hits where |grad f| is the steepness; uncertainty: to first order."""
        t = dr.select(dr.isfinite(t), t, 0)
        size = max_norm(o) + t
        tolerance = prepared.tolerance.value_tolerance(steepness, t) / steepness
        least = fmax(_PART * tolerance, _OF_POINTS * prepared.backend.machine_epsilon * size)
        return cls(size, tolerance, tolerance + uncertainty, uncertainty > least)


@dataclass(frozen=True)
class _Around:
    """Hits to look around, and the part that each is of."""

    around: Doubtful
    part: Any


@dataclass(frozen=True)
class _Lengths:
    """A length for each hit."""

    length: Real


def _with_seen_distances(prepared: SurfaceTracer, hits: Hits, doubt: _Doubt) -> Hits:
    """The hits, with uncertainties within which the surface was seen where these are large. All are
    evaluated; nothing else is where there is no such hit."""
    backend, field = prepared.backend, prepared.field
    is_far = doubt.is_doubtful & (doubt.distance > _LARGE * doubt.tolerance)
    has_far = dr.zeros(backend.UInt32, 1)
    dr.scatter(has_far, 1, 0, is_far)
    dr.eval(has_far, *vars(hits).values())
    if not has_far[0]:
        return hits

    def seen(rays: _Around) -> _Lengths:
        sampled = field
        if field.has_patches:
            sampled = field.patch(dr.reinterpret_array(backend.UInt32, rays.part))
        return _Lengths(seen_distance(backend, sampled, prepared.levels, rays.around))

    around = Doubtful(hits.position, hits.normal, doubt.size, doubt.distance)
    far = compute_on_active(
        is_far, seen, _Around(around, hits.primitive_index), _Lengths(doubt.distance)
    )
    uncertainty = dr.select(is_far, far.length - doubt.tolerance, hits.uncertainty)
    return replace(hits, uncertainty=uncertainty)


def _positions(o: Vec3, d: Vec3, t: Real) -> Vec3:
    return dr.select(dr.isfinite(t), dr.fma(type(o)(t), d, o), dr.nan)


# Tracing on other GPUs, by WebGPU.


def _check_backend(
    backend: str, rays: tuple[Any, ...], precision: Precision | None, all_hits: int | None
) -> None:
    if not is_one_of(backend, ("webgpu",)):
        raise ValueError(
            f'backend is "webgpu", or nothing for the one that Dr.Jit has, not {backend!r}'
        )
    if any(is_tensor(one) or dr.is_array_v(type(one)) for one in rays):
        raise TypeError('backend="webgpu" takes rays as NumPy arrays: Dr.Jit\'s have a backend')
    if precision not in (None, "single"):
        raise ValueError('backend="webgpu" computes in single precision alone')
    if all_hits is not None:
        raise NotImplementedError('backend="webgpu" finds first hits alone: leave out all_hits')


def _trace_on_device(surface: Surface, backend: Backend, rays: tuple[Any, ...], count: int) -> Hits:
    prepared = surface.prepare(backend, many=count >= _MIN_RAYS_FOR_CELLS)
    lanes = {
        name: one + dr.zeros(type(one), count)
        for name, one in zip(("o", "d", "near", "far"), rays, strict=True)
    }
    dr.eval(lanes)

    def compute(o: Vec3, d: Vec3, near: Real, far: Real) -> dict[str, Any]:
        return vars(_first_hits(prepared, o, d, near, far)[1])

    directions = to_numpy(lanes["d"])

    def differences(rows: IntArray, expected: Arrays, found: Arrays) -> str:
        given = Hits(**expected), Hits(**found)
        return _compare_hits(*given, directions[rows], surface.tolerance)

    found = evaluate_on_device(find_device(), compute, lanes, prepared, differences)
    return _as_numpy(Hits(**found), count)


# Where the cosine of the angle between a ray and the normal is less than this, a device that rounds
# differently may find the hit anywhere along the surface; elsewhere, within the tolerance.
_GRAZING = 0.1
# What is asked of a device (in brackets: the worst of one that computes as it should, Mesa's on a
# CPU, over 110 surfaces). At most this share of rays has another status, or hits farther off than
# the tolerance, as at an apex (0);
_MAX_OUTLIERS = 1e-3
# nine in ten hits lie within this fraction of the tolerance (0.03), and their normals differ by no
# more than this (2e-5);
_MAX_OFFSET, _MAX_NORMAL_CHANGE = 0.1, 2e-4
# the numbers of evaluations differ, summed over all rays, by no more than this fraction of their
# sum and one for each ray (0.020).
_MAX_COUNT_CHANGE = 0.03


def _compare_hits(
    expected: Hits, found: Hits, directions: FloatArray, tolerance: HitTolerance
) -> str:
    """What differs in a device's hits by more than rounding explains; "" if nothing does.

    A ray that runs along the surface, within the tolerance, may hit it anywhere there or not at
    all, and may run out of steps.
    """
    hit, both = expected.is_hit | found.is_hit, expected.is_hit & found.is_hit
    normal = cast("FloatArray", np.where(expected.is_hit[:, None], expected.normal, found.normal))
    climb = np.abs((normal * directions).sum(axis=1))
    other = expected.status != found.status
    lost = np.maximum(expected.status, found.status) == int(RayStatus.OUT_OF_STEPS)
    graze = lost | (hit & (climb < _GRAZING))
    if (other & ~graze).any() or other.sum() > _MAX_OUTLIERS * len(other):
        k = int(np.flatnonzero(other)[0])
        return (
            f"{other.sum()} of {len(other)} rays end otherwise, such as ray {k} of the sample: "
            f"{RayStatus(expected.status[k]).name} here, {RayStatus(found.status[k]).name} there"
        )
    t = expected.t
    allowed = tolerance.distance + tolerance.per_length * np.where(both, t, 0)
    with np.errstate(invalid="ignore"):
        off = np.where(both, np.abs(found.t - t), 0) * np.maximum(climb, _GRAZING)
    rounding = 64 * np.finfo(np.float32).eps * np.where(both, 1 + np.abs(t), 1)
    if (off > 2 * allowed + rounding).mean() > _MAX_OUTLIERS:
        return f"hits lie up to {off.max():.2g} off the surface, and {allowed.max():.2g} is asked"
    if both.any() and np.quantile((off - rounding)[both] / allowed[both], 0.9) > _MAX_OFFSET:
        return "hits lie elsewhere, if within the tolerance"
    turned = np.linalg.norm(found.normal - expected.normal, axis=1)[both & (climb >= _GRAZING)]
    if turned.size and np.quantile(turned, 0.9) > _MAX_NORMAL_CHANGE:
        return "normals differ"
    many, others = (one.evaluations.astype(np.float64) for one in (expected, found))
    if np.abs(others - many).sum() > _MAX_COUNT_CHANGE * (many + 1).sum() + 2:
        return "rays take another number of evaluations"
    return ""


def _no_hits(backend: Backend, *, as_numpy: bool) -> Hits:
    number, vector = dr.zeros(backend.Float, 0), dr.zeros(backend.Array3f, 0)
    count = dr.zeros(backend.UInt32, 0)
    sheet = dr.zeros(backend.Int32, 0)
    hits = Hits(number, vector, vector, number, count, count, sheet, number)
    return _as_numpy(hits, 0) if as_numpy else hits


def _as_numpy(hits: Hits, n: int) -> Hits:
    def flat(array: Any) -> Any:
        values: Any = to_numpy(array) if dr.is_array_v(type(array)) else array
        return np.broadcast_to(values, (n, *values.shape[1:])).copy()

    return Hits(
        flat(hits.t),
        flat(hits.position),
        flat(hits.normal),
        flat(hits.value),
        flat(hits.evaluations).astype(np.int64),
        flat(hits.status).astype(np.int64),
        flat(hits.primitive_index).astype(np.int64),
        flat(hits.uncertainty),
    )
