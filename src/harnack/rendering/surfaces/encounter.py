"""Where a ray meets one of our surfaces: polished, with a normal that faces the right way.

Everything here is in the surface's own coordinates and knows no Mitsuba; `interaction` turns it
into what a BSDF is asked with.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend import Mask, Real, Vec3  # at run time: Dr.Jit reads SurfaceHit's annotations
from harnack.backend.lanes import on_some
from harnack.backend.lengths import length as norm
from harnack.fields.look import Sample
from harnack.tracer import Status

if TYPE_CHECKING:
    from harnack.tracer import MarchResult, PreparedLevelSet

# Polishing moves a hit by at most this many tolerances: along a ray that only grazes the surface
# there is no crossing to converge to.
_POLISH = 2.0
# A ray leaves a surface this many tolerances away from it, so as not to meet it again there.
CLEARANCE = 4.0
# A grazing ray's normal is turned until it faces the ray's side under this sine.
_GRAZING = 1e-3


@dataclass
class SurfaceHit:
    """What rays meet first. Lanes that meet nothing have met = lost = False and t = inf.

    t: ray parameter; of a lost ray, how far it is proved free.
    met: there is a surface at t.
    lost: the ray ran out of steps behind t.
    position, normal: of the surface. The normal is unit and points to the side of larger values
        or, of a solid, out of it.
    clearance: how far off the surface the next ray has to start.
    value: of the field, close to the surface or, of a sheet, just before it; of no meaning where
        nothing is met.
    evaluations: of the field.
    cut: it is a face of a solid on its section.
    mended: of a field with sheets, met between them: there the surface spans what they leave open.
    line: the number of the isoline drawn there, counted from 1; 0 for none.
    """

    t: Real
    met: Mask
    lost: Mask
    position: Vec3
    normal: Vec3
    clearance: Real
    value: Real
    evaluations: Any
    mended: Mask
    cut: Mask
    line: Any


def meet_surface(
    prepared: PreparedLevelSet, o: Vec3, d: Vec3, t_max: Real, active: Mask
) -> SurfaceHit:
    """Where rays o + t d, |d| = 1, 0 <= t <= t_max, first meet the level set.

    One Newton step along the ray, one evaluation there, and one projection along its gradient
    take a hit from within tolerance to the surface. The proof tells which side of the surface
    the ray comes from; a normal that says otherwise (the step went past the point where a
    grazing ray is nearest) is turned to that side.

    A confirmed hit is at a root already, and its side is known.

    A hit on a sheet of a field that jumps is where it is, and faces the side of larger values.
    """
    trace = prepared.first_hit(o, d, 0, t_max, active)
    if not prepared.queued:
        return _described(prepared, _Ended(o, d, trace))
    return on_some(
        trace.status == int(Status.HIT),
        lambda ended: _described(prepared, ended),
        _Ended(o, d, trace),
        _no_hit(prepared, trace),
    )


@dataclass(frozen=True)
class _Ended:
    """Rays, and where they ended."""

    o: Vec3
    d: Vec3
    trace: MarchResult


def _no_hit(prepared: PreparedLevelSet, trace: MarchResult) -> SurfaceHit:
    """What rays that hit nothing have met."""
    backend = prepared.backend
    zero, vector, none = backend.Float(0), backend.Array3f(0), backend.Bool(False)
    return SurfaceHit(
        t=trace.t,
        met=none,
        lost=trace.status == int(Status.OUT_OF_STEPS),
        position=vector,
        normal=vector,
        clearance=zero,
        value=zero,
        evaluations=trace.evaluations,
        mended=none,
        cut=none,
        line=backend.UInt32(0),
    )


def _described(prepared: PreparedLevelSet, ended: _Ended) -> SurfaceHit:
    """What is where rays ended."""
    vector, o, d, trace = prepared.backend.Array3f, ended.o, ended.d, ended.trace
    prepared = prepared.of_hit(trace)
    met = trace.status == int(Status.HIT)
    smooth = met & ~trace.on_sheet if prepared.field.has_sheets else met
    gap = prepared.levels.to_nearest(trace.value)
    slope = dr.dot(trace.gradient, d)
    reach = _POLISH * _uncertainty(prepared, trace.gradient, trace.t, trace.value)
    step = dr.select(smooth & (slope != 0), dr.clip(gap / slope, -reach, reach), 0)
    # gap > 0: the level is above, so the ray comes from the side of smaller values.
    side = dr.select(gap > 0, prepared.backend.Float(1), -1)
    if trace.side is not None:  # confirmed hits are at a root
        step, side = dr.zeros(type(step)), trace.side
    t = dr.maximum(dr.select(met, trace.t, 0) + step, 0)
    p = dr.fma(vector(t), d, o)
    sheets = prepared.field.has_sheets
    sample = _sample_where(prepared, p, d, smooth) if sheets else prepared.sample(p)
    length = norm(sample.gradient)
    normal = dr.select(length > 0, sample.gradient / length, -d)
    shading = normal if sample.normal is None else sample.normal
    uncertainty = _uncertainty(prepared, sample.gradient, t, sample.value, sample.error)
    rest = prepared.levels.to_nearest(sample.value) / length
    rest = dr.select(length > 0, dr.clip(rest, -reach, reach), 0)
    if prepared.field.has_sheets:  # behind one, the value says nothing about this surface
        rest = dr.select(dr.abs(rest) * length <= dr.abs(gap), rest, 0)
    encounter = SurfaceHit(
        t=dr.select(met, t, trace.t),
        met=met,
        lost=trace.status == int(Status.OUT_OF_STEPS),
        position=dr.fma(vector(rest), normal, p),
        normal=facing(shading, d, side),
        clearance=CLEARANCE * uncertainty,
        value=sample.value,
        evaluations=trace.evaluations + dr.select(smooth, prepared.backend.UInt32(1), 0),
        mended=smooth & prepared.field.has_sheets,
        cut=prepared.backend.Bool(False),
        line=prepared.backend.UInt32(0),
    )
    if not prepared.field.has_sheets:
        return encounter
    return dr.select(trace.on_sheet, _on_sheet(prepared, o, d, trace, encounter), encounter)


def _sample_where(prepared: PreparedLevelSet, p: Vec3, d: Vec3, active: Mask) -> Sample:
    """Value, error, gradient and normal at p where active, zeros elsewhere, and no promises.

    d: of the ray; a point without a slope has the normal -d.

    A loop of one trip or of none: of a broken mesh a look costs more than a ray that meets a
    triangle or nothing, and most rays do.
    """
    real, vector = prepared.backend.Float, prepared.backend.Array3f

    def once(trip: Any, *_: Any) -> tuple[Any, ...]:
        sample = prepared.sample(p)
        length = norm(sample.gradient)
        normal = dr.select(length > 0, sample.gradient / length, -d)
        shading = vector(normal if sample.normal is None else sample.normal)
        return trip + 1, real(sample.value), real(sample.error), vector(sample.gradient), shading

    def is_first(trip: Any, *_: Any) -> Mask:
        return active & (trip < 1)

    start = prepared.backend.UInt32(0), real(0), real(0), vector(0), vector(0)
    _, value, error, gradient, normal = dr.while_loop(start, is_first, once, label="at hits")
    return Sample(value, gradient, (), error, normal=normal)


def _on_sheet(
    prepared: PreparedLevelSet, o: Vec3, d: Vec3, trace: MarchResult, encounter: SurfaceHit
) -> SurfaceHit:
    """Encounters with sheets: t is exact to rounding, and so is the plane of the normal.

    The ray comes from the side of smaller values if it runs along the normal. The next ray keeps
    as far away as from a level set, and no less than several roundings of the position.
    """
    t = dr.select(trace.on_sheet, trace.t, 0)
    p = dr.fma(prepared.backend.Array3f(t), d, o)
    side = dr.mulsign(prepared.backend.Float(1), dr.dot(trace.gradient, d))
    rounding = 4 * prepared.backend.epsilon * (dr.max(dr.abs(o)) + t)
    tolerance = prepared.tolerance.in_value(prepared.backend.Float(1), t)
    return replace(
        encounter,
        t=t,
        position=p,
        normal=facing(trace.gradient, d, side),
        clearance=CLEARANCE * dr.maximum(tolerance, rounding),
        value=trace.value,
        mended=prepared.backend.Bool(False),
    )


def _uncertainty(
    prepared: PreparedLevelSet, gradient: Vec3, t: Real, f: Real, error: Real = 0.0
) -> Real:
    """How far from the level a point may lie and still be a hit, to first order.

    That is the tolerance, or what rounding of f (`Sample.error`) amounts to if that is more; the
    rounding of positions is far below what Mitsuba's rays keep off surfaces anyway.
    """
    steepness = norm(gradient)
    t = dr.select(dr.isfinite(t), t, 0)
    rounding = 2 * (error + 8 * prepared.backend.epsilon * dr.abs(f))
    close = dr.maximum(prepared.tolerance.in_value(steepness, t), rounding)
    return dr.select(steepness > 0, close / steepness, prepared.tolerance.distance)


def facing(normal: Vec3, d: Vec3, side: Real) -> Vec3:
    """The normal, turned if need be such that side * (normal . d) > 0."""
    along = dr.dot(normal, d)
    turned = dr.normalize(normal + (side * _GRAZING - along) * d)
    return dr.select(side * along >= _GRAZING, normal, turned)
