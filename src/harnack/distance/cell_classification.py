"""Classifies cubes of space, the cells, by how a surface passes through them. The surface is a
level set of a function f: f takes a given value on it, the level. A cell may be proved to hold no
point of the surface. In other cells, if possible, a slab (the space between two parallel planes) is
found that contains the surface, and a point of the surface. The boundary of the field's domain cuts
the level set in a curve, the *clip curve*. A point of it is found in cells through which it passes.

`ClipCurveDescent` finds the closest point of the clip curve.
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
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Sample
    from harnack.geometry import Volume
    from harnack.tracer import TracedSurface

__all__ = ["CellClassifier", "ClipCurveDescent", "taylor_remainder"]

# Largest number of iterations along the clip curve, and of corrections back to it after one step.
_ROUNDS, _MAX_CURVE_CORRECTIONS = 80, 8
# In machine epsilons of the coordinates: the depth inside the domain at which points of the clip
# curve are placed, the tolerance of that depth, and the tolerance of their distance from the level.
_DOMAIN_INSET, _DEPTH_TOLERANCE, _LEVEL_TOLERANCE = 64.0, 48.0, 256.0
# Steps end at this fraction of the distance to another face of the domain.
_STEP_TO_FACE = 0.999
# States of a search at a corner of the domain, where two faces meet: the next step leads into the
# other face; or a step has led there.
_TURNING, _TURNED = 1, 2
# The search ends if the step has been reduced to this fraction.
_MIN_STEP_FACTOR = 1e-9
# Lower bound of the second derivative that the Newton step divides by: the step along the curve is
# at most 20 |(x - y) . t|.
_MIN_SECOND_DERIVATIVE = 0.05
# Two normals belong to one face if the cosine of their angle differs from 1 by less than this.
_SAME_FACE = 1e-6
# The search ends at steps below this fraction of the distance: the relative error of the distance
# that remains is half its square.
_MIN_RELATIVE_STEP = 1e-8


@dataclass(frozen=True)
class ClipCurveDescent:
    """Finds the point of the clip curve that is closest to a query x by descent. In the clip curve
    the boundary of the field's domain (the volume in which the field is defined) cuts the level
    set. On this curve f = level and h = 0, where h is the signed distance from the boundary of the
    domain. The boundary may have several smooth faces, which meet at edges.

    evaluator, domain: the function f and its domain, on the backend.
    levels: the values of f on the surface; at a point the level nearest to f counts.
    """

    backend: Backend
    evaluator: Evaluator
    levels: Levels
    domain: Volume

    def closest(self, x: Vec3, start: Vec3) -> tuple[Vec3, Real]:
        """Return a point y of the clip curve at which the distance from x has a local minimum,
        found by descent from `start`; and the curvature of the curve at y. Both are NaN where the
        curve is not reached.

        Let t be the curve's unit tangent at y, and y'' its second derivative by arc length, which
        follows from the second derivatives of f and h along t (differences of their gradients).
        Half the squared distance has the derivative -(x - y).t along the curve and the second
        derivative 1 - (x - y).y''. With Newton's step w, their negative quotient, the next point is
        y + w t + w^2/2 y''; Newton's method for both equations then leads back to the curve. The
        step is accepted if the result is nearer to x; else a quarter of it is tried.

        If a step leads to another face of the domain, steps end at the plane of that face from then
        on, so that they lead to the corner where the curve meets both faces. From there the search
        goes on, once, along the curve in the other face.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x = vector(x)

        def body(
            y: Vec3, best: Vec3, nearest: Real, w: Real, tangent: Vec3, second: Vec3, normal: Vec3,
            face_normal: Vec3, face_offset: Real, corner: Any, factor: Real, tries: Any, k: Any,
            active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            """Try the point y, and choose the next one. Returns the new state: values in the order
            of the parameters.

            best, nearest: the best point of the curve so far, and its distance from x; infinite if
                there is none.
            w, tangent, second, normal: Newton's step, the curve's tangent and second
                derivative y'', and the face's normal, all at `best`.
            face_normal, face_offset: the plane of another face that ends steps; the normal is 0 if
                there is none.
            corner: 0 before the search has come to a corner; `_TURNING` if its next step leads into
                the other face there; `_TURNED` after that step.
            factor: the fraction of Newton's step that is tried.
            tries: the number of corrections towards the curve since the last step.
            k: the number of points tried so far.
            active: whether the search goes on.
            """
            # Is the point y on the curve, and nearer to x than the best one?
            trial = self._at(y)
            distance = safe_norm(x - y)
            has_best = dr.isfinite(nearest)
            is_new_face = dr.dot(trial.normal, normal) < 1 - _SAME_FACE
            face_gap = fmax(face_offset - dr.dot(face_normal, best), 0)
            # At a corner the point in the other face may be a little farther from x: by some of the
            # gap to that face and of rounding.
            turns_corner = (
                (corner == _TURNING)
                & is_new_face
                & (distance < nearest + 8 * face_gap + 100 * trial.near)
            )
            accepted = trial.is_on & (~has_best | (distance < nearest) | turns_corner)
            # A step across another face makes that face end the next steps. A point that is off the
            # curve otherwise is corrected towards it, several times if necessary.
            has_no_face = ~(dr.squared_norm(face_normal) > 0)
            crosses_face = has_best & is_new_face & has_no_face & ~accepted & (corner != _TURNING)
            is_corrected = ~trial.is_on & ~crosses_face & (tries < _MAX_CURVE_CORRECTIONS)
            is_corrected &= dr.isfinite(dr.squared_norm(trial.correction))
            is_rejected = ~accepted & ~is_corrected
            # A point on the curve that is nearer to x is accepted: the next Newton step.
            curvature_term = 1 - dr.dot(x - y, trial.second_derivative)
            step = dr.dot(x - y, trial.tangent) / fmax(
                dr.abs(curvature_term), _MIN_SECOND_DERIVATIVE
            )
            w = dr.select(accepted, clamp(step, -distance, distance), w)
            best, nearest = dr.select(accepted, y, best), dr.select(accepted, distance, nearest)
            tangent = dr.select(accepted, trial.tangent, tangent)
            second = dr.select(accepted, trial.second_derivative, second)
            changes_face = accepted & is_new_face
            face_normal = dr.select(
                crosses_face, trial.normal, dr.select(changes_face, 0, face_normal)
            )
            face_offset = dr.select(
                crosses_face, dr.dot(trial.normal, y) + trial.depth, face_offset
            )
            normal = dr.select(accepted, trial.normal, normal)
            factor = dr.select(accepted, fmin(4 * factor, 1), factor)
            factor = dr.select(is_rejected & ~crosses_face, 0.25 * factor, factor)
            # The step s meets the face where face_rate |s| + s^2/2 face_normal.y'' = face_gap.
            s, face_gap = factor * w, fmax(face_offset - dr.dot(face_normal, best), 0)
            face_rate = dr.sign(w) * dr.dot(face_normal, tangent)
            limit_divisor = face_rate + dr.sqrt(
                face_rate * face_rate + 2 * face_gap * dr.dot(face_normal, second)
            )
            limit = dr.select(
                limit_divisor > 0, _STEP_TO_FACE * 2 * face_gap / limit_divisor, dr.inf
            )
            is_limited = ~(has_no_face & ~crosses_face) & (limit < dr.abs(s))
            s = dr.select(is_limited, clamp(s, -limit, limit), s)
            target = dr.fma(vector(s), tangent, best) + vector(0.5 * s * s) * second
            # The search ends at short steps, unless a face has shortened them.
            min_step = dr.select(is_limited, 0, _MIN_RELATIVE_STEP * nearest)
            is_short = dr.abs(s) <= fmax(min_step, trial.near)
            corner = dr.select((corner == _TURNING) & ~is_corrected, _TURNED, corner)
            # The steps have come to the corner: the next point lies a little beyond the other face.
            at_face = is_short & is_limited & ~is_corrected & (corner == 0)
            corner = dr.select(at_face, _TURNING, corner)
            target = dr.select(
                at_face, dr.fma(vector(face_gap + 8 * trial.near), face_normal, best), target
            )
            active &= (
                (is_corrected | accepted | has_best)
                & (factor > _MIN_STEP_FACTOR)
                & (k + 1 < _ROUNDS)
            )
            active &= is_corrected | at_face | ~is_short
            y, tries = (
                dr.select(is_corrected, y + trial.correction, target),
                dr.select(is_corrected, tries + 1, 0),
            )
            return (
                y, best, nearest, w, tangent, second, normal, face_normal, face_offset, corner,
                factor, tries, k + 1, active,
            )  # fmt: skip

        def is_active(*state: Any) -> Mask:
            return state[-1]

        # Nothing of the curve is known at the start; Newton's step is a whole one.
        undefined, zero = vector(dr.nan), vector(0)
        state = (
            vector(start), undefined, real(dr.inf), real(0), zero, undefined, zero, zero, real(0),
            count(0), real(1), count(0), count(0), self.backend.Bool(True),
        )  # fmt: skip
        final = dr.while_loop(state, is_active, body, label="along the rim")
        # The best point, and its curvature, which is the length of y'' (`second`).
        return final[1], safe_norm(final[5])

    def _at(self, y: Vec3) -> _ClipCurveState:
        """Return the geometry at a point y near the clip curve: the derivatives of the curve there,
        and the step that leads back to it.

        Let u and n be the unit normals of the level set and of the domain. The tangent t = y' of
        the curve is along their cross product. On the curve u.y' = 0 and n.y' = 0. Differentiated
        by arc length, u.y'' = -u'.t and n.y'' = -n'.t, where u' and n' are the derivatives of the
        normals along t, computed by differences.
        """
        real, vector = self.backend.Float, self.backend.Array3f
        sample = self.evaluator.evaluate(y)
        gradient, scale = vector(sample.gradient), max_norm(y)
        gradient_norm, n = safe_norm(gradient), vector(self.domain.outward_normal(y))
        u = gradient / gradient_norm
        depth = (
            -self.domain.signed_distance(y) - _DOMAIN_INSET * self.backend.machine_epsilon * scale
        )
        # To first order, the distances to the level set along u (`offset`), and along n to a
        # surface just inside of the boundary, where points of the curve are placed (`depth`).
        # `near` is the rounding of the first.
        offset = self.levels.offset_to_nearest(sample.value) / gradient_norm
        near = dr.fma(
            _LEVEL_TOLERANCE * self.backend.machine_epsilon,
            scale,
            real(sample.value_error) / gradient_norm,
        )
        cosine = dr.dot(n, u)
        sine_squared = 1 - cosine * cosine

        def solution(along_u: Real, along_n: Real) -> Vec3:
            """Return the shortest vector whose inner products with u and n are `along_u` and
            `along_n`."""
            first, second = along_u - cosine * along_n, along_n - cosine * along_u
            return (vector(first) * u + vector(second) * n) / sine_squared

        t = dr.cross(u, n) * dr.rsqrt(sine_squared)
        # The step of the differences; u' . t and n' . t.
        step = self.backend.machine_epsilon**0.5 * fmax(scale, real(1e-30))
        next_point = dr.fma(vector(step), t, y)
        u_change = dr.dot(vector(self.evaluator.evaluate(next_point).gradient) - gradient, t) / (
            gradient_norm * step
        )
        n_change = dr.dot(vector(self.domain.outward_normal(next_point)) - n, t) / step
        # Across an edge of the domain the normal jumps: that change is not curvature.
        n_change = dr.select(dr.abs(n_change) * step < 1e-3, n_change, 0)
        is_on = (dr.abs(offset) <= near) & (
            dr.abs(depth) <= _DEPTH_TOLERANCE * self.backend.machine_epsilon * scale
        )
        return _ClipCurveState(
            is_on, near, solution(offset, depth), t, solution(-u_change, -n_change), n, depth
        )


@dataclass(frozen=True)
class _ClipCurveState:
    """The geometry at a point near the clip curve, in which the boundary of the field's domain cuts
    the level set.

    near: the length by which rounding may have moved the level set there.
    is_on: whether the point is on the curve: within `near` of the level set, and within a few
        roundings of the boundary.
    correction: the step back to the curve, to first order.
    tangent, second_derivative: unit tangent of the curve, and its second derivative by arc length.
    normal: the outward normal of the domain.
    depth: how far the point is inside the domain, less a margin.
    """

    is_on: Mask
    near: Real
    correction: Vec3
    tangent: Vec3
    second_derivative: Vec3
    normal: Vec3
    depth: Real


# Cells.

# The largest number of Newton steps; and if they shrink at a rate between the two below, as they do
# towards a multiple root.
_MAX_STEPS = 6
_MAX_SLOW_STEPS, _SLOW_RATES = 14, (0.4, 0.97)
# The radius of the ball around a cube of half size 1.
_CUBE_CIRCUMRADIUS = 3**0.5 * (1 + 1e-9)
# A point counts as on the level if the last Newton step was below this fraction of the radius of
# the ball around the cell.
_POINT_TOLERANCE = 1e-7
# Directions of the rays through a cell, for fields that jump.
_DIAGONALS = ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0))


def taylor_remainder(sample: Sample, radius: Real, degree: int = 1) -> Real:
    """Return a bound of the Taylor remainder |f(y) - T(y)| for |y - p| <= radius. p is the point of
    the sample, and T the Taylor polynomial of f about p, of the degree `degree`, 1 or 2. The bound
    follows from the sample's promises (proved bounds of f near p); it is infinite if these imply
    none. When the radius decreases, the bound falls at least as fast as radius^(degree + 1), except
    for the errors of value and gradient, which are included."""
    bound: Real = dr.inf
    for promise in sample.all_promises:
        bound = fmin(bound, promise.taylor_remainder_bound(sample.value, radius, degree))
    return bound + sample.value_error + sample.gradient_error * radius


def multiplicity(step: Real, last: Real) -> Real:
    """Estimate the multiplicity m of the root towards which Newton's method converges, from its
    last two steps.

    step, last: the current step (with its sign), and the length of the one before.

    Near a root of multiplicity m, each step is about 1 - 1/m times the one before, and a step m
    times as long as Newton's leads to the root. So the result is 1/(1 - |step|/last), if the ratio
    of the steps is between 0.4 and 0.97. Otherwise it is 1.
    """
    ratio = dr.abs(step) / last
    is_slow = (ratio > _SLOW_RATES[0]) & (ratio < _SLOW_RATES[1])
    return dr.select(is_slow, 1 / (1 - ratio), 1)


@dataclass
class CellClassifier:
    """Classifies cells, cubes that may hold a surface, in double precision: it proves some of them
    empty, and bounds the surface in others. The surface is a level set of a function f, or consists
    of facets at which f jumps.

    surface: the surface.
    """

    surface: TracedSurface

    def __post_init__(self) -> None:
        """Upload the surface in double precision, and the descent to the clip curve if its domain
        cuts it."""
        self._backend = choose_backend("double")
        self._tracer = self.surface.tracer(self._backend)
        self._levels = self._tracer.levels
        self._volume = _domain(self.surface)
        self._has_hessian = has_hessian(self._backend, self._evaluator)
        self._clip_descent = None
        if self._volume is not None and not self.surface.field.traits.has_jumps:
            volume = self._volume.upload(self._backend)
            self._clip_descent = ClipCurveDescent(
                self._backend, self._evaluator, self._levels, volume
            )

    @property
    def _evaluator(self) -> Evaluator:
        """The evaluator of the function f."""
        return self._tracer.evaluator

    def nonempty_cells(self, center: FloatArray, half: FloatArray) -> SurfaceCells:
        """Return the cubes that are not proved to be free of the surface. Each has the slab (two
        parallel planes) in which its part of the surface lies, if one is found.

        center: (n, 3) centers of the cubes.
        half: (n,) half the length of their edges.

        A cube is left out if the ball around it lies outside the domain. If that ball meets the
        domain, but the cube's center lies outside, the cube is returned without a slab.
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
        # `is_empty` has numbers, 1 or 0. Cells whose center is outside are kept.
        is_nonempty = np.ones(len(cells), np.bool_)
        is_nonempty[is_inside] = is_empty == 0
        return cells.select(is_nonempty)

    def with_surface_points(self, cells: SurfaceCells) -> SurfaceCells:
        """Return the same cells with more of their attributes known: a point of the surface in each
        cell, and the normal and curvature of the surface there; and a point of the clip curve. A
        cell in which such a point is not found has `FAR_SENTINEL` in its place."""
        if not len(cells):
            return cells
        radius, start = _CUBE_CIRCUMRADIUS * cells.half, cells.center
        distance = np.full(len(cells), np.inf)
        if self._volume is not None:
            distance, start = self._at(self._pulled_inside, cells.center)
        surface_point, normal, plane_radius, curvature = self._at(
            self._surface_point_and_plane, start, radius, cells.normal
        )
        self._remove_outside(surface_point)
        clip_point, clip_curvature = cells.clip_point.copy(), cells.clip_curvature.copy()
        if self._clip_descent is not None:
            # The boundary of the domain passes through the ball around the cell.
            ids = np.flatnonzero(np.abs(distance) <= radius)
            clip_point[ids], clip_curvature[ids] = self._at(
                self._clip_point, start[ids], radius[ids]
            )
            self._remove_outside(clip_point)
        return dataclasses.replace(
            cells,
            surface_point=surface_point,
            normal=normal,
            plane_radius=plane_radius,
            curvature=curvature,
            clip_point=clip_point,
            clip_curvature=clip_curvature,
        )

    def _at(
        self, compute: Callable[..., tuple[Any, ...]], points: FloatArray, *values: FloatArray
    ) -> tuple[Any, ...]:
        """Evaluate a function of Dr.Jit vectors at points (n, 3). Returns its results as arrays,
        (n,) or (n, 3) each.

        compute: the function. Its arguments are a point and `values`.
        values: further arguments of `compute`: vectors (n, 3), or numbers (n,). A number is passed
            as a vector of three equal components.
        """
        vectors = (np.tile(value[:, None], 3) if value.ndim == 1 else value for value in values)
        return in_batches(self._backend, compute, points, *vectors)

    def _remove_outside(self, surface_points: FloatArray) -> None:
        """Replace points (n, 3) that lie outside the domain by `FAR_SENTINEL`, in place."""
        if self._volume is not None and len(surface_points):
            # The huge coordinates of a missing point could overflow: 0 is tested in their place.
            surface_points[
                ~self._volume.contains_points(
                    np.where(surface_points < FAR_SENTINEL, surface_points, 0)
                )
            ] = FAR_SENTINEL

    def _distance_outside(self, p: Vec3) -> tuple[Real]:
        """Return the signed distance of p from the domain, positive outside, as a tuple of one."""
        return (self._volume.signed_distance(p),)

    def _pulled_inside(self, p: Vec3) -> tuple[Real, Vec3]:
        """Return a lower bound of the signed distance of p from the domain (positive outside); and
        the point p if it is inside, otherwise a point of the domain's boundary near p."""
        assert self._volume is not None
        distance = self._volume.signed_distance(p)
        normal = self._volume.outward_normal(p)
        return distance, dr.select(distance > 0, p - self._backend.Array3f(distance) * normal, p)

    def _slab(self, p: Vec3, radii: Vec3) -> tuple[Real | Vec3, ...]:
        """Bound the part of the surface in the ball around p.

        radii: the ball's radius, as a vector of three equal components.

        Returns 1 if the ball is proved to contain no point of the level set, else 0; and a slab
        that contains the surface in the ball: its unit normal, the offset of its middle plane from
        p along the normal, and half its thickness. If no slab is proved, the normal is 0 and the
        thickness `FAR_SENTINEL`.

        Proof. Let g be the gradient at p and E a bound of |f - (f(p) + g.(y - p))| in the ball. At
        a surface point y, |f(p) - level + g.(y - p)| <= E. Divided by |g|, this is the slab.
        """
        real, vector, radius = self._backend.Float, self._backend.Array3f, radii.x
        sample = self._evaluator.evaluate(p)
        clearance = real(0)
        if sample.all_promises:
            clearance = level_distance_lower_bound(
                self._backend, self._evaluator, self._levels, p, sample
            )
        residual, gradient_norm = (
            -self._levels.offset_to_nearest(sample.value),  # f - level
            safe_norm(sample.gradient),
        )
        # The bound E of the proof, with the rounding of f.
        linear_error = taylor_remainder(
            sample, radius
        ) + 8 * self._backend.machine_epsilon * dr.abs(sample.value)
        is_slab = (
            (gradient_norm > 0)
            & dr.isfinite(linear_error)
            & (linear_error < FAR_SENTINEL * gradient_norm)
        )
        # A slab holds the surface only if a single level, without jumps, passes through the ball.
        if len(self._levels.values) > 1 or self.surface.field.traits.has_jumps:
            is_slab &= False
        elif self._levels.period is not None:
            # f - level changes by at most |g| radius + error in the ball, so that no other level
            # (a period away) lies in it.
            is_slab &= dr.fma(gradient_norm, radius, linear_error) < self._levels.period - dr.abs(
                residual
            )
        divisor = dr.select(is_slab, gradient_norm, 1)
        normal = dr.select(is_slab, sample.gradient / divisor, vector(0, 0, 0))
        offset = dr.select(is_slab, -residual / divisor, 0)
        thickness = dr.select(is_slab, linear_error / divisor, FAR_SENTINEL)
        is_empty = (clearance > radius) | (is_slab & (dr.abs(offset) > radius + thickness))
        return dr.select(is_empty, real(1), 0), normal, offset, thickness

    def _surface_point_and_plane(
        self, p: Vec3, radii: Vec3, normal: Vec3
    ) -> tuple[Vec3, Vec3, Real, Real]:
        """Search for a surface point near p, the center of a cell.

        radii: the radius of the ball around the cell, as a vector of three equal components.
        normal: the normal of the cell's slab, or 0.

        Returns the surface point, `FAR_SENTINEL` if none is found; the normal of a plane through it
        that approximates the surface; the radius about the point within which the surface may be
        replaced by this plane (it is at most the distance to the curve at which the surface ends);
        and an upper bound of the curvature of the surface at the point.
        """
        radius, unknown = radii.x, self._backend.Float(FAR_SENTINEL)
        if self.surface.field.traits.has_jumps:
            # No plane is known to approximate the surface: the radius is 0.
            return self._nearest_ray_hit(p, radius), normal, self._backend.Float(0), unknown
        point = self._newton_point(p, radius)
        is_found = point.x < 0.5 * FAR_SENTINEL  # a missing point is at `FAR_SENTINEL`
        y = dr.select(is_found, point, p)
        gradient = self._evaluator.evaluate(y).gradient
        n = gradient / safe_norm(gradient)
        # A cell without a slab gets the tangent plane at its surface point.
        is_plane = is_found & ~(dr.squared_norm(normal) > 0) & dr.isfinite(dr.squared_norm(n))
        # Up to the far side of the ball around the cell, if no boundary is nearer.
        plane_radius, boundary = radius + safe_norm(y - p), self.surface.field.boundary
        if boundary is not None and boundary.closest_point is not None:
            plane_radius = fmin(plane_radius, safe_norm(boundary.closest_point(y) - y))
        curvature = unknown
        if self._has_hessian:
            uu, vv, uv = TangentPlane.of(gradient).restrict_hessian(self._evaluator.hessian(y))
            # The Frobenius norm of the Hessian in the tangent plane is at least its largest
            # eigenvalue.
            bound = dr.sqrt(dr.fma(uu, uu, dr.fma(vv, vv, 2 * uv * uv))) / safe_norm(gradient)
            curvature = dr.select(bound < FAR_SENTINEL, bound, unknown)
        return (
            point,
            dr.select(is_plane, n, normal),
            dr.select(is_found, plane_radius, 0),
            curvature,
        )

    def _clip_point(self, p: Vec3, radii: Vec3) -> tuple[Vec3, Real]:
        """Return a point of the clip curve near p, `FAR_SENTINEL` if none is found; and the
        curvature of the curve there.

        radii: the radius of the ball around p in which it is searched, as a vector of three equal
            components.
        """
        assert self._clip_descent is not None
        y, curvature = self._clip_descent.closest(p, p)
        is_near = safe_norm(y - p) < 2 * radii.x
        return dr.select(is_near, y, self._backend.Array3f(FAR_SENTINEL)), dr.select(
            is_near, curvature, 0
        )

    def _newton_point(self, p: Vec3, radius: Real) -> Vec3:
        """Return the point of the level set to which Newton's method along the gradient leads from
        p; `FAR_SENTINEL` if it does not converge to a point within the distance 2 `radius` of p.

        After six steps the method goes on only while its steps shrink, as they do towards a
        multiple root. These later steps are lengthened by the multiplicity of the root.
        """
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32
        zero = dr.opaque(real, 0.0)  # keeps constant components of a gradient in the loop

        def body(y: Vec3, last: Real, k: Any) -> tuple[Any, ...]:
            """Make one Newton step from y, at most as long as `radius` of `_newton_point`. Returns
            the new y, the length of this step, and the new number of steps.

            last: the length of the step before.
            k: the number of steps so far.
            """
            sample = self._evaluator.evaluate(y)
            gradient_norm = safe_norm(sample.gradient)
            off_level = self._levels.offset_to_nearest(sample.value)
            newton_step = off_level / gradient_norm
            # For the first six steps the root counts as simple.
            factor = dr.select(k >= _MAX_STEPS - 1, multiplicity(newton_step, last), 1)
            step = clamp(factor * newton_step, -radius, radius)
            goes_on = dr.isfinite(step) & (dr.norm(y - p) < 4 * radius)
            shrinks = (k < _MAX_STEPS - 1) | (dr.abs(newton_step) < _SLOW_RATES[1] * last)
            # At a point of the surface where the gradient is 0 the iteration has converged.
            is_flat = (off_level == 0) & (gradient_norm == 0)
            last = dr.select(goes_on, dr.abs(newton_step), dr.select(is_flat, 0, dr.inf))
            y = dr.select(
                goes_on, dr.fma(vector(step / gradient_norm), sample.gradient + zero, y), y
            )
            # Steps as short as this have converged.
            goes_on &= shrinks & (last > 1e-9 * radius)
            # The largest number of steps ends the loop.
            return y, last, dr.select(goes_on, k + 1, _MAX_SLOW_STEPS)

        def is_active(y: Vec3, last: Real, k: Any) -> Mask:
            del y, last
            return k < _MAX_SLOW_STEPS

        start = (vector(p), real(dr.inf), count(0))
        y, last, _ = dr.while_loop(start, is_active, body, label="feet of cells")
        is_near = (last < _POINT_TOLERANCE * radius) & (dr.norm(y - p) < 2 * radius)
        return dr.select(is_near, y, vector(FAR_SENTINEL))

    def _nearest_ray_hit(self, p: Vec3, radius: Real) -> Vec3:
        """Return, for functions that jump, the point nearest to p among the first hits of four rays
        through the ball around p, along the diagonals of the cell; `FAR_SENTINEL` without a hit.

        radius: the radius of the ball.
        """
        real, vector, count = self._backend.Float, self._backend.Array3f, self._backend.UInt32

        def body(point: Vec3, best: Real, k: Any) -> tuple[Any, ...]:
            """Trace ray k, and keep its hit if that is nearer to p than `point`, the nearest hit so
            far. Returns the new state. best: the squared distance from p to `point`."""
            # The direction of ray k.
            d = vector(*_DIAGONALS[0]) / 3**0.5
            for number, diagonal in enumerate(_DIAGONALS[1:], 1):
                d = dr.select(k == number, vector(*diagonal) / 3**0.5, d)
            # It begins at the surface of the ball and ends at its other side.
            o = dr.fma(vector(-radius), d, p)
            ray_hit = self._tracer.first_hit(o, d, real(0), 2 * radius, self._backend.Bool(True))
            is_hit = ray_hit.status == int(RayStatus.HIT)
            y = dr.fma(vector(ray_hit.t), d, o)
            square = dr.squared_norm(y - p)
            is_nearer = is_hit & (square < best)
            is_nearer &= is_on_surface(self._tracer, y, ray_hit, is_nearer)
            return dr.select(is_nearer, y, point), dr.select(is_nearer, square, best), k + 1

        def is_active(point: Vec3, best: Real, k: Any) -> Mask:
            del point, best
            return k < len(_DIAGONALS)

        start = (vector(FAR_SENTINEL), real(dr.inf), count(0))
        return dr.while_loop(start, is_active, body, label="rays through cells")[0]


def _domain(surface: TracedSurface) -> Any:
    """Return the volume in which the surface lies: the intersection of the field's domain and the
    clip volume, as far as there are any."""
    return surface.field.domain if surface.clip_volume is None else surface.volume
