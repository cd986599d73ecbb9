"""Classifies the cells that may hold a level set: each is proved empty, or gets a slab (two
parallel planes) that contains the surface, and a point of the surface.

Some of these points lie on the *clip curve*, where the boundary of the field's domain cuts the
level set; `ClipCurveDescent` finds its closest point.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend
from harnack.backend.elementary import clamp, fmax, fmin, max_norm, safe_norm
from harnack.distance.cell_tree import FAR_SENTINEL, SurfaceCells
from harnack.distance.jump_surface_search import is_on_surface
from harnack.distance.tangent_plane import TangentPlane, has_hessian, in_batches
from harnack.fields.clearance import level_distance_lower_bound
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.enclosures import Levels
    from harnack.fields.field import Field, Sample
    from harnack.geometry import Volume
    from harnack.tracer import TracedSurface

__all__ = ["CellClassifier", "ClipCurveDescent", "taylor_remainder"]

_ROUNDS, _MAX_CURVE_CORRECTIONS = 80, 8
# In epsilons, of coordinates: the depth inside the domain at which points of the clip curve are
# put, the error of that depth, and their distance from the level.
_DOMAIN_INSET, _INSET_ERROR, _LEVEL_DISTANCE = 64.0, 48.0, 256.0
# Fraction of the distance to another face at which steps end.
_BEFORE = 0.999
# States of a search at a corner of the domain: it turns into the other face, or has turned.
_TURNING, _TURNED = 1, 2
_MIN_STEP_FRACTION = 1e-9  # of a step: shorter steps are given up
_MIN_SLOPE = 0.05  # of (x - y) . t along the curve: steps are at most 20 times that product
_SAME_NORMAL = 1e-6  # cosines of angles between normals of one face differ from one by less
_MIN_STEP = 1e-8  # of the distance: the relative error that remains is half its square


@dataclass(frozen=True)
class ClipCurveDescent:
    """Descent to the closest point of the clip curve, on which f = level and h = 0, where h is the
    distance from the domain's boundary; all are prepared for one backend."""

    backend: Backend
    field: Field
    levels: Levels
    domain: Volume

    def closest(self, x: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        """A point y of the curve at which the distance from x has a local minimum, found by descent
        from `start`, and the curvature of the curve there; NaN where the curve is not reached.

        Let the curve have the tangent t and the second derivative y'', which follows from those of
        f and h along t (differences of their gradients). Half the squared distance has the
        derivative -(x - y).t along the curve and the second derivative 1 - (x - y).y'', which give
        Newton's step w t + w^2/2 y''. After a step Newton's method for both equations leads back to
        the curve. The step is accepted if the result is nearer to x, else a quarter of it is tried.
        Where the step led to another face of the domain instead, that face ends steps from then on,
        so that they lead to the corner where both faces meet; from there the search goes on, once,
        along the curve in the other face.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x = vector(x)

        def body(
            y: Vec3, best: Vec3, nearest: Real, w: Real, tangent: Vec3, ddy: Vec3, normal: Vec3,
            wall: Vec3, wall_height: Real, corner: Any, factor: Real, tries: Any, k: Any,
            active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            trial = self._at(y)
            distance = safe_norm(x - y)
            reached = dr.isfinite(nearest)
            new_face = dr.dot(trial.normal, normal) < 1 - _SAME_NORMAL
            gap = fmax(wall_height - dr.dot(wall, best), 0)
            turns = (
                (corner == _TURNING) & new_face & (distance < nearest + 8 * gap + 100 * trial.near)
            )
            accepted = trial.is_on & (~reached | (distance < nearest) | turns)
            # Beyond another face: that is a wall. Else off the curve: back to it, for several
            # steps.
            is_free = ~(dr.squared_norm(wall) > 0)
            crosses = reached & new_face & is_free & ~accepted & (corner != _TURNING)
            corrects = ~trial.is_on & ~crosses & (tries < _MAX_CURVE_CORRECTIONS)
            corrects &= dr.isfinite(dr.squared_norm(trial.correction))
            failed = ~accepted & ~corrects
            # On the curve, and nearer: the next step.
            slope = 1 - dr.dot(x - y, trial.second_derivative)
            step = dr.dot(x - y, trial.tangent) / fmax(dr.abs(slope), _MIN_SLOPE)
            w = dr.select(accepted, clamp(step, -distance, distance), w)
            best, nearest = dr.select(accepted, y, best), dr.select(accepted, distance, nearest)
            tangent = dr.select(accepted, trial.tangent, tangent)
            ddy = dr.select(accepted, trial.second_derivative, ddy)
            changes_face = accepted & new_face
            wall = dr.select(crosses, trial.normal, dr.select(changes_face, 0, wall))
            wall_height = dr.select(crosses, dr.dot(trial.normal, y) + trial.depth, wall_height)
            normal = dr.select(accepted, trial.normal, normal)
            factor = dr.select(accepted, fmin(4 * factor, 1), factor)
            factor = dr.select(failed & ~crosses, 0.25 * factor, factor)
            # The wall is met where rate |s| + s^2/2 wall.bend is the gap.
            s, gap = factor * w, fmax(wall_height - dr.dot(wall, best), 0)
            rate = dr.sign(w) * dr.dot(wall, tangent)
            root = rate + dr.sqrt(rate * rate + 2 * gap * dr.dot(wall, ddy))
            limit = dr.select(root > 0, _BEFORE * 2 * gap / root, dr.inf)
            is_limited = ~(is_free & ~crosses) & (limit < dr.abs(s))
            s = dr.select(is_limited, clamp(s, -limit, limit), s)
            target = dr.fma(vector(s), tangent, best) + vector(0.5 * s * s) * ddy
            min_step = dr.select(is_limited, 0, _MIN_STEP * nearest)
            is_short = dr.abs(s) <= fmax(min_step, trial.near)
            corner = dr.select((corner == _TURNING) & ~corrects, _TURNED, corner)
            at_wall = is_short & is_limited & ~corrects & (corner == 0)
            corner = dr.select(at_wall, _TURNING, corner)
            target = dr.select(at_wall, dr.fma(vector(gap + 8 * trial.near), wall, best), target)
            active &= (
                (corrects | accepted | reached) & (factor > _MIN_STEP_FRACTION) & (k + 1 < _ROUNDS)
            )
            active &= corrects | at_wall | ~is_short
            y, tries = (
                dr.select(corrects, y + trial.correction, target),
                dr.select(corrects, tries + 1, 0),
            )
            return (
                y, best, nearest, w, tangent, ddy, normal, wall, wall_height, corner, factor,
                tries, k + 1, active,
            )  # fmt: skip

        def is_active(*state: Any) -> Mask:
            return state[-1]

        undefined, zero = vector(dr.nan), vector(0)
        state = (
            vector(start), undefined, real(dr.inf), real(0), zero, undefined, zero, zero, real(0),
            count(0), real(1), count(0), count(0), self.backend.Bool(True),
        )  # fmt: skip
        final = dr.while_loop(state, is_active, body, label="along the rim")
        return final[1], safe_norm(final[5])

    def _at(self, y: Vec3) -> _ClipCurveState:
        real, vector = self.backend.Float, self.backend.Array3f
        sample = self.field.evaluate(y)
        gradient, size = vector(sample.gradient), max_norm(y)
        slope, n = safe_norm(gradient), vector(self.domain.outward_normal(y))
        u = gradient / slope
        depth = (
            -self.domain.signed_distance(y) - _DOMAIN_INSET * self.backend.machine_epsilon * size
        )
        offset = self.levels.offset_to_nearest(sample.value) / slope
        radius = dr.fma(
            _LEVEL_DISTANCE * self.backend.machine_epsilon, size, real(sample.value_error) / slope
        )
        cosine = dr.dot(n, u)
        sine = 1 - cosine * cosine

        def solution(along_u: Real, along_n: Real) -> Vec3:
            """The shortest vector with these inner products with u and n."""
            first, second = along_u - cosine * along_n, along_n - cosine * along_u
            return (vector(first) * u + vector(second) * n) / sine

        t = dr.cross(u, n) * dr.rsqrt(sine)
        h = self.backend.machine_epsilon**0.5 * fmax(size, real(1e-30))
        ahead = dr.fma(vector(h), t, y)
        du = dr.dot(vector(self.field.evaluate(ahead).gradient) - gradient, t) / (slope * h)
        dn = dr.dot(vector(self.domain.outward_normal(ahead)) - n, t) / h
        # Beside an edge of the domain the normal is another one ahead: no curvature.
        dn = dr.select(dr.abs(dn) * h < 1e-3, dn, 0)
        is_on = (dr.abs(offset) <= radius) & (
            dr.abs(depth) <= _INSET_ERROR * self.backend.machine_epsilon * size
        )
        return _ClipCurveState(
            is_on, radius, solution(offset, depth), t, solution(-du, -dn), n, depth
        )


@dataclass(frozen=True)
class _ClipCurveState:
    """A point near the clip curve.

    is_on: whether the point is on the curve, to the tolerance `near`.
    correction: the step back to the curve, to first order.
    tangent, second_derivative: unit tangent and second derivative of the curve.
    normal: the outward normal of the domain.
    depth: the distance of the point inside the domain, less a margin.
    """

    is_on: Mask
    near: Real
    correction: Vec3
    tangent: Vec3
    second_derivative: Vec3
    normal: Vec3
    depth: Real


# Cells.

_STEPS = 6
# More steps where Newton's steps shrink at a rate between these, as to a multiple root.
_MULTIPLE_ROOT_STEPS, _SHRINK_RATES = 14, (0.4, 0.97)
# The radius of the ball around a cube of half size 1.
_CUBE_CIRCUMRADIUS = 3**0.5 * (1 + 1e-9)
# A surface point of a cell is on the level up to this fraction of the cell.
_CLOSE = 1e-7
# Rays through a cell of a field that jumps.
_DIAGONALS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0))


def taylor_remainder(sample: Sample, radius: Real, degree: int = 1) -> Real:
    """A bound of the Taylor remainder: of |f(y) - T(y)| for |y - p| <= radius, where T is the
    Taylor polynomial of f about p, of degree 1 or 2. Infinite where the field promises no bound. As
    a function of the radius it falls at least as the power degree + 1."""
    bound: Real = dr.inf
    for promise in sample.all_promises:
        bound = fmin(bound, promise.taylor_remainder_bound(sample.value, radius, degree))
    return bound + sample.value_error + sample.gradient_error * radius


def multiplicity(step: Real, last: Real) -> Real:
    """The multiplicity m of the root to which Newton's steps lead, by the lengths of the last two
    steps: at a root like that of u^m steps shrink by the factor 1 - 1/m, and a step m times as long
    as Newton's leads to the root. It is 1 where steps shrink faster, or hardly."""
    ratio = dr.abs(step) / last
    is_slow = (ratio > _SHRINK_RATES[0]) & (ratio < _SHRINK_RATES[1])
    return dr.select(is_slow, 1 / (1 - ratio), 1)


@dataclass
class CellClassifier:
    """Classifies the cells of a level set, in double precision."""

    surface: TracedSurface

    def __post_init__(self) -> None:
        self._backend = choose_backend("double")
        self._prepared = self.surface.prepare(self._backend)
        self._levels = self._prepared.levels
        self._volume = _domain(self.surface)
        self._has_hessian = has_hessian(self._backend, self._field)
        self._rim = None
        if self._volume is not None and not self.surface.field.has_jumps:
            volume = self._volume.prepare(self._backend)
            self._rim = ClipCurveDescent(self._backend, self._field, self._levels, volume)

    @property
    def _field(self) -> Field:
        return self._prepared.field

    def nonempty_cells(self, center: FloatArray, half: FloatArray) -> SurfaceCells:
        """The cubes that are not proved empty, with the slabs that the surface lies in.

        center: (n, 3) of cubes.
        half: (n,) half the length of their edges.
        """
        is_inside = np.ones(len(center), np.bool_)
        if self._volume is not None and len(center):
            is_inside = self._volume.contains_points(center)
            (distance,) = self._at(self._distance_outside, center)
            may_hold = is_inside | (distance <= _CUBE_CIRCUMRADIUS * half)
            center, half, is_inside = center[may_hold], half[may_hold], is_inside[may_hold]
        cells = SurfaceCells.unknown(center, half)
        if not is_inside.any():
            return cells
        # Nothing is promised about points outside the domain.
        is_empty, cells.normal[is_inside], cells.offset[is_inside], cells.thickness[is_inside] = (
            self._at(self._slab, center[is_inside], _CUBE_CIRCUMRADIUS * half[is_inside])
        )
        is_nonempty = np.ones(len(cells), np.bool_)
        is_nonempty[is_inside] = is_empty == 0
        return cells.select(is_nonempty)

    def with_surface_points(self, cells: SurfaceCells) -> SurfaceCells:
        """The cells, completed by points of the surface and of the clip curve."""
        if not len(cells):
            return cells
        radius, start = _CUBE_CIRCUMRADIUS * cells.half, cells.center
        distance = np.full(len(cells), np.inf)
        if self._volume is not None:
            distance, start = self._at(self._moved_into_domain, cells.center)
        surface_point, normal, spread, curvature = self._at(
            self._surface_point_and_plane, start, radius, cells.normal
        )
        self._outside(surface_point)
        clip_point, clip_curvature = cells.clip_point.copy(), cells.clip_curvature.copy()
        if self._rim is not None:
            ids = np.flatnonzero(np.abs(distance) <= radius)
            clip_point[ids], clip_curvature[ids] = self._at(self._on_rim, start[ids], radius[ids])
            self._outside(clip_point)
        return dataclasses.replace(
            cells,
            surface_point=surface_point,
            normal=normal,
            plane_radius=spread,
            curvature=curvature,
            clip_point=clip_point,
            clip_curvature=clip_curvature,
        )

    def _at(
        self, compute: Callable[..., tuple[Any, ...]], points: FloatArray, *values: FloatArray
    ) -> tuple[Any, ...]:
        """values: vectors (n, 3), or numbers (n,), passed as vectors of equal components."""
        vectors = (np.tile(value[:, None], 3) if value.ndim == 1 else value for value in values)
        return in_batches(self._backend, compute, points, *vectors)

    def _outside(self, feet: FloatArray) -> None:
        """Replace points (n, 3) that lie outside the domain by `FAR_SENTINEL`."""
        if self._volume is not None and len(feet):
            feet[~self._volume.contains_points(np.where(feet < FAR_SENTINEL, feet, 0))] = (
                FAR_SENTINEL
            )

    def _distance_outside(self, p: Vec3) -> tuple[Real]:
        return (self._volume.signed_distance(p),)

    def _moved_into_domain(self, p: Vec3) -> tuple[Real, Vec3]:
        """A lower bound of the signed distance of p from the domain; and p, or a point of the
        boundary near p if p is outside."""
        assert self._volume is not None
        distance = self._volume.signed_distance(p)
        normal = self._volume.outward_normal(p)
        return distance, dr.select(distance > 0, p - self._backend.Array3f(distance) * normal, p)

    def _slab(self, p: Vec3, radii: Vec3) -> tuple[Real | Vec3, ...]:
        """Whether the ball holds no level (1 or 0); the slab in which the level lies."""
        real, vector, radius = self._backend.Float, self._backend.Array3f, radii.x
        sample = self._field.evaluate(p)
        free = real(0)
        if sample.all_promises:
            free = level_distance_lower_bound(self._backend, self._field, self._levels, p, sample)
        value, norm = -self._levels.offset_to_nearest(sample.value), safe_norm(sample.gradient)
        error = taylor_remainder(sample, radius) + 8 * self._backend.machine_epsilon * dr.abs(
            sample.value
        )
        is_slab = (norm > 0) & dr.isfinite(error) & (error < FAR_SENTINEL * norm)
        if len(self._levels.values) > 1 or self.surface.field.has_jumps:
            is_slab &= False
        elif self._levels.period is not None:  # no second level reaches into the ball
            is_slab &= dr.fma(norm, radius, error) < self._levels.period - dr.abs(value)
        slope = dr.select(is_slab, norm, 1)
        normal = dr.select(is_slab, sample.gradient / slope, vector(0, 0, 0))
        offset = dr.select(is_slab, -value / slope, 0)
        thickness = dr.select(is_slab, error / slope, FAR_SENTINEL)
        is_empty = (free > radius) | (is_slab & (dr.abs(offset) > radius + thickness))
        return dr.select(is_empty, real(1), 0), normal, offset, thickness

    def _surface_point_and_plane(
        self, p: Vec3, radii: Vec3, normal: Vec3
    ) -> tuple[Vec3, Vec3, Real, Real]:
        """A surface point near p; the normal of a plane that is nearly the surface there; the
        radius about the point in which it is: that of the cell, up to the curve in which the
        surface ends; and the curvature of the surface."""
        radius, unknown = radii.x, self._backend.Float(FAR_SENTINEL)
        if self.surface.field.has_jumps:
            return self._nearest_ray_hit(p, radius), normal, self._backend.Float(0), unknown
        point = self._newton_point(p, radius)
        is_found = point.x < 0.5 * FAR_SENTINEL
        y = dr.select(is_found, point, p)
        gradient = self._field.evaluate(y).gradient
        n = gradient / safe_norm(gradient)
        is_plane = is_found & ~(dr.squared_norm(normal) > 0) & dr.isfinite(dr.squared_norm(n))
        spread, boundary = radius + safe_norm(y - p), self._field.closest_boundary_point(y)
        if boundary is not None:
            spread = fmin(spread, safe_norm(boundary - y))
        curvature = unknown
        if self._has_hessian:
            uu, vv, uv = TangentPlane.of(gradient).restrict_hessian(self._field.hessian(y))
            bound = dr.sqrt(dr.fma(uu, uu, dr.fma(vv, vv, 2 * uv * uv))) / safe_norm(gradient)
            curvature = dr.select(bound < FAR_SENTINEL, bound, unknown)
        return point, dr.select(is_plane, n, normal), dr.select(is_found, spread, 0), curvature

    def _on_rim(self, p: Vec3, radii: Vec3) -> tuple[Vec3, Real]:
        """A point of the clip curve near p, and the curvature of the curve."""
        assert self._rim is not None
        y, curvature = self._rim.closest(p, p)
        is_near = safe_norm(y - p) < 2 * radii.x
        return dr.select(is_near, y, self._backend.Array3f(FAR_SENTINEL)), dr.select(
            is_near, curvature, 0
        )

    def _newton_point(self, p: Vec3, radius: Real) -> Vec3:
        """The point to which Newton's method leads from the center, if it is near."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32
        zero = dr.opaque(real, 0.0)  # no component of a gradient is a constant of the loop

        def body(y: Vec3, last: Real, k: Any) -> tuple[Any, ...]:
            sample = self._field.evaluate(y)
            slope = safe_norm(sample.gradient)
            off_level = self._levels.offset_to_nearest(sample.value)
            newton_step = off_level / slope
            factor = dr.select(k >= _STEPS - 1, multiplicity(newton_step, last), 1)
            step = clamp(factor * newton_step, -radius, radius)
            valid = dr.isfinite(step) & (dr.norm(y - p) < 4 * radius)
            shrinks = (k < _STEPS - 1) | (dr.abs(newton_step) < _SHRINK_RATES[1] * last)
            # On a surface along which the gradient is 0 the last step was the last one.
            is_flat = (off_level == 0) & (slope == 0)
            last = dr.select(valid, dr.abs(newton_step), dr.select(is_flat, 0, dr.inf))
            y = dr.select(valid, dr.fma(vector(step / slope), sample.gradient + zero, y), y)
            valid &= shrinks & (last > 1e-9 * radius)
            return y, last, dr.select(valid, k + 1, _MULTIPLE_ROOT_STEPS)

        def is_active(y: Vec3, last: Real, k: Any) -> Mask:
            del y, last
            return k < _MULTIPLE_ROOT_STEPS

        start = (vector(p), real(dr.inf), count(0))
        y, last, _ = dr.while_loop(start, is_active, body, label="feet of cells")
        is_near = (last < _CLOSE * radius) & (dr.norm(y - p) < 2 * radius)
        return dr.select(is_near, y, vector(FAR_SENTINEL))

    def _nearest_ray_hit(self, p: Vec3, radius: Real) -> Vec3:
        """The hit nearest to the center of rays through the cell, of a field that jumps."""
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32

        def body(point: Vec3, best: Real, k: Any) -> tuple[Any, ...]:
            d = vector(*_DIAGONALS[0]) / 3**0.5
            for number, diagonal in enumerate(_DIAGONALS[1:], 1):
                d = dr.select(k == number, vector(*diagonal) / 3**0.5, d)
            o = dr.fma(vector(-radius), d, p)
            ray_hit = self._prepared.first_hit(o, d, real(0), 2 * radius, self._backend.Bool(True))
            is_hit = ray_hit.status == int(RayStatus.HIT)
            y = dr.fma(vector(ray_hit.t), d, o)
            square = dr.squared_norm(y - p)
            nearer = is_hit & (square < best)
            nearer &= is_on_surface(self._prepared, y, ray_hit, nearer)
            return dr.select(nearer, y, point), dr.select(nearer, square, best), k + 1

        def is_active(point: Vec3, best: Real, k: Any) -> Mask:
            del point, best
            return k < len(_DIAGONALS)

        start = (vector(FAR_SENTINEL), real(dr.inf), count(0))
        return dr.while_loop(start, is_active, body, label="rays through cells")[0]


def _domain(surface: TracedSurface) -> Any:
    return surface.field.domain if surface.clip_volume is None else surface.volume
