"""Finds closest points of a level set by descent: onto the level, then along it.

The result is a point of the level set, to rounding, at which x - y is normal to the surface and no
neighbor is nearer to x. It is a *local* minimum of the distance: another part of the surface may be
nearer still, so the distance is an upper bound of the true one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr

from harnack.backend import elementary as lengths
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.distance.cell_classification import multiplicity, taylor_remainder
from harnack.distance.exclusion_ball import exclusion_radius
from harnack.distance.tangent_plane import SymmetricEigen2, TangentPlane, has_hessian

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.distance.exclusion_ball import Rows
    from harnack.enclosures import Levels
    from harnack.fields.field import Field, Sample

__all__ = ["ClosestPointDescent"]

_STEPS_DIRECT = 10
_LAST_STEP = 1e-11  # of the distance: the last step is expected to be shorter
_STEPS_TO_LEVEL = 60
_STEPS_ALONG = 60
# Newton's method to a simple root takes fewer steps than this.
_PATIENT = 16
_MIN_STEP_FRACTION = 1e-7  # of a step: shorter steps are given up
_MIN_EIGENVALUE = (
    0.05  # of B (`ClosestPointDescent.descend`): steps are no longer than 20 gradients
)
_INDEFINITE = -1e-3
# A point counts as on the level if rounding moves the level by at most this fraction of its
# coordinates or of the radius of the ball on which f is smooth.
_MAX_RELATIVE_UNCERTAINTY = 1 / 16
# No minimum is looked for where f is singular within this fraction of the distance, as the surface
# ends there: its boundary is farther by a fraction of half the square.
_MIN_SINGULARITY_FRACTION = 1e-5


@dataclass(frozen=True)
class _DescentState:
    """A point y and the field there.

    gradient: of the field.
    level_uncertainty: the length by which rounding may have moved the level.
    smooth_radius: the radius of the ball on which f is smooth.
    """

    y: Vec3
    gradient: Vec3
    level_uncertainty: Real
    smooth_radius: Real

    def parts(self) -> tuple[Any, ...]:
        """The attributes in the order of the constructor, as the state of a loop."""
        return self.y, self.gradient, self.level_uncertainty, self.smooth_radius

    def flat_after(self, mask: Mask, before: _DescentState) -> _DescentState:
        """The state, where f - level and its gradient are 0 on lanes of the mask: with the gradient
        of the state before, and with the rounding of coordinates alone."""
        epsilon = float(dr.epsilon(type(self.level_uncertainty)))
        rounding = 4 * epsilon * lengths.max_norm(self.y)
        gradient = dr.select(mask, before.gradient, self.gradient)
        return _DescentState(
            self.y, gradient, dr.select(mask, rounding, self.level_uncertainty), self.smooth_radius
        )

    def where(self, mask: Mask, other: _DescentState) -> tuple[Any, ...]:
        """The attributes of this state on lanes of the mask, of the other state elsewhere."""
        pairs = zip(self.parts(), other.parts(), strict=True)
        return tuple(dr.select(mask, first, second) for first, second in pairs)


@dataclass(frozen=True)
class ClosestPointDescent:
    """Descents to closest points of the level set of a field that is prepared for a backend."""

    backend: Backend
    field: Field
    levels: Levels
    has_hessian: bool

    @classmethod
    def of(cls, backend: Backend, field: Field, levels: Levels) -> ClosestPointDescent:
        return cls(backend, field, levels, has_hessian(backend, field))

    def newton(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask, Mask]:
        """Newton's method for the closest-point equations f(y) = level and (x - y) parallel to grad
        f(y), in one kernel, from a point `start` near the surface.

        Returns y, to which `finish` adds the last step; the first-order distance of `start` from
        the level; whether the last step was longer than half the radius in which f is smooth, so
        that y is no result; and whether y will be farther from x than `limit`, where the iteration
        stops.

        Each step combines the step of `descend` along the surface, which follows its curvature,
        with a Newton step to the level; both are from derivatives at the same point. Convergence is
        quadratic: a step of length s after one of length s0 is followed by one of about s (s/s0)^2.
        While steps at least halve, the limit is within twice the current step.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x, mask = vector(x), self.backend.Bool

        def body(
            y: Vec3, first_step: Real, last: Real, is_lost: Mask, is_far: Mask, k: Any, active: Mask
        ) -> tuple[Any, ...]:
            # The rounding error of f takes as long as f itself, and is of no matter here.
            sample = dataclasses.replace(self.field.evaluate(y), value_error=0.0)
            residual, at_y = self._descent_state_at(y, sample)
            move, _ = self._step_along(x, at_y, real(1))
            step = -residual / lengths.safe_norm(at_y.gradient)
            first_step = dr.select(k == 0, dr.abs(step), first_step)
            move = dr.fma(vector(step), at_y.gradient / lengths.safe_norm(at_y.gradient), move)
            length, distance = dr.norm(move), dr.norm(x - y)
            max_length = 0.5 * at_y.smooth_radius
            is_lost = dr.select(active, length > max_length, is_lost)
            shrinks = (k > 0) & (length < 0.5 * last)
            is_far = dr.select(active, shrinks & (distance - 2 * length > limit), is_far)
            ahead = length * dr.square(length / last)
            is_near = (
                shrinks & ~is_lost & (ahead <= dr.fma(_LAST_STEP, distance, at_y.level_uncertainty))
            )
            active &= ~is_far & dr.isfinite(length)
            y = dr.select(active, y + dr.select(is_lost, max_length / length, 1) * move, y)
            active &= ~is_near & (k + 1 < _STEPS_DIRECT)
            return y, first_step, length, is_lost, is_far, k + 1, active

        def is_active(*state: Any) -> Mask:
            return state[-1]

        no_lane = mask(False)
        state = vector(start), real(0), real(dr.inf), no_lane, mask(False), count(0), mask(True)
        final = dr.while_loop(state, is_active, body, label="Newton's method")
        y, first_step, _, is_lost, is_far, _, _ = final
        return y, first_step, is_lost, is_far

    def finish(self, x: Vec3, y: Vec3) -> tuple[Vec3, Mask, Real]:
        """The last step from y onto the level; whether it leads to a closest point to x, by the
        criterion of `descend`; and a radius about it in which no point of the surface is nearer.

        Proof that the step, of length s along grad f, ends on the level: by Newton's formula f
        differs from the level there by at most the remainder of Taylor's polynomial of first degree
        within s. It turns normals by about s times the curvature, less than the tangential part may
        be in any case.
        """
        sample = self.field.evaluate(y)
        residual, at_y = self._descent_state_at(y, sample)
        rows = self.field.hessian(y) if self.has_hessian else None
        _, is_minimum = self._step_along(x, at_y, self.backend.Float(1), rows)
        slope = lengths.safe_norm(at_y.gradient)
        step = -residual / slope
        exact = dataclasses.replace(sample, value_error=0.0, gradient_error=0.0)
        arrives = taylor_remainder(exact, dr.abs(step)) <= slope * at_y.level_uncertainty
        end, is_short = self._step_to_level(x, residual, at_y)
        arrives &= is_short
        is_found = is_minimum & (
            self._is_on_level(residual, at_y) | (self._is_level_resolved(at_y) & arrives)
        )
        radius = exclusion_radius(exact, rows, x, y)
        return end, is_found, dr.select(is_found, radius, 0)

    def descend(self, x: Vec3, start: Vec3) -> tuple[Vec3, Mask, Mask]:
        """The closest point y to x that is found from `start`; whether it is a closest point (see
        above); and whether it is a point of the level set at all.

        A step along the surface is Newton's for |x-y|^2/2: with r = x - y, tangential part t, and
        the Hessian A in tangential coordinates, the surface near y is y + w - (w.Aw/(2|g|)) n + ..
        and half the squared distance falls by t.w - w.Bw/2 with B = 1 + (r.n) A/|g|. Where an
        eigenvalue of B is not positive its size is taken instead, so that the step still goes
        down; where t vanishes as well, y is a saddle or a maximum of the distance (x is beyond a
        center of curvature), left along that eigenvector. The step ends with Newton's method
        back to the level, and counts if it came no farther from x, else a quarter is tried.

        y is accepted if |t| <= 4 sqrt(epsilon) |r| plus a few rounding errors: then, by the same
        formula, |r| exceeds the local minimum by a fraction 8 epsilon/(least eigenvalue of B).
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        mask = self.backend.Bool
        x = vector(x)

        def body(
            y: Vec3, g: Vec3, noise: Real, radius: Real,
            factor: Real, on_level: Mask, accepted: Mask, n: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            at_y, first = _DescentState(y, g, noise, radius), n == 0
            move, is_minimum = self._step_along(x, at_y, factor)
            is_minimum &= ~first
            going = active & ~is_minimum
            trial, arrived = self._to_level(dr.select(first, y, y + move), going)
            limit = dr.norm(x - y) * (1 + 8 * self.backend.machine_epsilon) + 4 * noise
            better = going & arrived & (dr.norm(x - trial.y) <= limit)
            new_factor = dr.select(better, fmin(4 * factor, 1), 0.25 * factor)
            factor = dr.select(first, factor, new_factor)
            accepted |= active & is_minimum
            on_level = dr.select(first, arrived, on_level)
            # Where f ceases to be smooth the surface ends: no minimum inside it.
            is_inner = trial.smooth_radius > _MIN_SINGULARITY_FRACTION * dr.norm(x - trial.y)
            is_inner &= (n <= _STEPS_ALONG) & (factor > _MIN_STEP_FRACTION)
            active = going & dr.select(first, arrived, is_inner)
            return *trial.where(better | first, at_y), factor, on_level, accepted, n + 1, active

        def is_active(*state: Any) -> Mask:
            return state[-1]

        # Iteration 0 goes to the level: f is recorded once for both.
        state = (
            *_DescentState(vector(start), vector(0), real(0), real(0)).parts(),
            real(1), mask(False), mask(False), count(0), mask(True),
        )  # fmt: skip
        y, _, _, _, _, on_level, accepted, _, _ = dr.while_loop(
            state, is_active, body, label="along the level"
        )
        return y, accepted, on_level

    def newton_to_level(self, start: Vec3) -> Vec3:
        """The point of a level to which Newton's method along the gradient converges; NaN where it
        does not."""
        end, is_found = self._to_level(start, self.backend.Bool(True))
        return dr.select(is_found, end.y, dr.nan)

    def noise(self, y: Vec3) -> Real:
        """A bound of the length by which rounding and approximation may have moved the level at
        y."""
        return self._evaluate(y)[1].level_uncertainty

    def last_step(self, x: Vec3, y: Vec3) -> Vec3:
        """y moved onto the level, where y is closest to x except for a step as short as in
        `finish`; NaN elsewhere."""
        residual, at_y = self._evaluate(y)
        end, is_short = self._step_to_level(x, residual, at_y)
        return dr.select(is_short & self._is_level_resolved(at_y), end, dr.nan)

    def _step_to_level(self, x: Vec3, residual: Real, at_y: _DescentState) -> tuple[Vec3, Mask]:
        """The end of Newton's step along the gradient, and whether the step is so short that the
        point stays the closest to x, to rounding."""
        slope = lengths.safe_norm(at_y.gradient)
        step = -residual / slope
        end = dr.fma(self.backend.Array3f(step / slope), at_y.gradient, at_y.y)
        limit = self.backend.machine_epsilon**0.5 * dr.norm(x - at_y.y) + at_y.level_uncertainty
        return end, dr.abs(step) <= limit

    def _evaluate(self, y: Vec3) -> tuple[Real, _DescentState]:
        """f - level at y, and the state at y."""
        return self._descent_state_at(y, self.field.evaluate(y))

    def _descent_state_at(self, y: Vec3, sample: Sample) -> tuple[Real, _DescentState]:
        real = self.backend.Float
        size = lengths.max_norm(y)
        epsilon, gradient_norm = self.backend.machine_epsilon, lengths.safe_norm(sample.gradient)
        total_error = dr.fma(8 * epsilon, dr.abs(sample.value), sample.value_error)
        noise = dr.fma(4 * epsilon, size, total_error / gradient_norm)
        smooth = real(0)
        for promise in sample.all_promises:
            if not promise.implies_smooth:
                continue
            radius = real(promise.radius)
            smooth = fmax(smooth, dr.select(dr.isfinite(radius), radius, 0))
        smooth = dr.select(smooth > 0, smooth, dr.inf)
        residual = real(-self.levels.offset_to_nearest(sample.value))
        return residual, _DescentState(y, self.backend.Array3f(sample.gradient), noise, smooth)

    @staticmethod
    def _is_on_level(residual: Real, state: _DescentState) -> Mask:
        """Whether a point is on the level, to rounding; False where rounding leaves that open."""
        is_resolved = ClosestPointDescent._is_level_resolved(state)
        return is_resolved & (
            dr.abs(residual) <= 2 * lengths.safe_norm(state.gradient) * state.level_uncertainty
        )

    @staticmethod
    def _is_level_resolved(state: _DescentState) -> Mask:
        """Whether the level is not hidden by rounding."""
        size = lengths.max_norm(state.y)
        return state.level_uncertainty <= _MAX_RELATIVE_UNCERTAINTY * fmax(
            size, state.smooth_radius
        )

    def _to_level(self, start: Vec3, active: Mask) -> tuple[_DescentState, Mask]:
        """From `start` to the nearest level by Newton's method along the gradient.

        A step is no longer than the radius of the ball on which f is known to be smooth, and is
        accepted if the result is nearer to a level. Returns the end, and whether it is on a level
        to rounding.

        Where f - level is a power u^m, as on a surface along which grad f is 0, steps shrink by the
        factor 1 - 1/m only. Steps that shrink so slowly for long are made `multiplicity` times as
        long. If such a step ends where f - level and its gradient are 0, the last direction of the
        gradient is used.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32

        def body(
            residual: Real, y: Vec3, g: Vec3, noise: Real, radius: Real,
            last: Real, factor: Real, on_level: Mask, n: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            at_y, gradient_norm, first = (
                _DescentState(y, g, noise, radius),
                lengths.safe_norm(g),
                n == 0,
            )
            step = -residual / gradient_norm
            boost = dr.select(n > _PATIENT, multiplicity(step, last), 1)
            length = factor * clamp(boost * step, -radius, radius)
            point = dr.fma(vector(length / gradient_norm), g, y)
            new_residual, trial = self._evaluate(dr.select(first, y, point))
            is_flat = ~first & (new_residual == 0) & (lengths.safe_norm(trial.gradient) == 0)
            trial = trial.flat_after(is_flat, at_y)
            better = active & (first | (dr.abs(new_residual) < dr.abs(residual)))
            boost = dr.select(better, fmin(2 * factor, 1), 0.25 * factor)
            factor = dr.select(first, factor, boost)
            on_level |= better & self._is_on_level(new_residual, trial)
            active &= ~on_level & (n <= _STEPS_TO_LEVEL) & (factor > _MIN_STEP_FRACTION)
            residual = dr.select(better, new_residual, residual)
            last = dr.select(first, dr.inf, dr.abs(step))
            return residual, *trial.where(better, at_y), last, factor, on_level, n + 1, active

        def is_active(*state: Any) -> Mask:
            return state[-1]

        # Iteration 0 evaluates the start.
        first = _DescentState(vector(start), vector(0), real(0), real(0))
        on_level = self.backend.Bool(False)
        going = self.backend.Bool(active)
        state = (real(dr.inf), *first.parts(), real(dr.inf), real(1), on_level, count(0), going)
        _, *end, _, _, on_level, _, _ = dr.while_loop(state, is_active, body, label="to the level")
        return _DescentState(*end), on_level

    def _step_along(
        self, x: Vec3, at_y: _DescentState, factor: Real, rows: Rows | None = None
    ) -> tuple[Vec3, Mask]:
        """The step along the surface, and whether y already is a local minimum of the distance.

        rows: the rows of the Hessian, if they are known.
        """
        plane = TangentPlane.of(at_y.gradient)
        r = x - at_y.y
        distance = dr.norm(r)
        if rows is not None:
            uu, vv, uv = plane.restrict_hessian(rows)
        else:
            uu, vv, uv = self._second_derivatives(at_y.y, plane, fmin(at_y.smooth_radius, distance))
        lift = dr.dot(r, plane.n) / plane.gradient_norm
        eigen = SymmetricEigen2.of(dr.fma(lift, uu, 1), dr.fma(lift, vv, 1), lift * uv)  # of B
        tu, tv = dr.dot(r, plane.u), dr.dot(r, plane.v)
        tangential = dr.sqrt(dr.fma(tu, tu, tv * tv))
        is_normal = tangential <= dr.fma(
            4 * self.backend.machine_epsilon**0.5, distance, 8 * at_y.level_uncertainty
        )
        is_saddle = is_normal & (eigen.smallest < _INDEFINITE)
        first, second = eigen.coordinates(tu, tv)
        first = first / fmax(dr.abs(eigen.largest), _MIN_EIGENVALUE)
        second = second / fmax(dr.abs(eigen.smallest), _MIN_EIGENVALUE)
        second = dr.select(is_saddle, 0.5 * distance, second)
        length = dr.sqrt(dr.fma(first, first, second * second))
        limit = factor * dr.select(is_saddle, length, fmin(at_y.smooth_radius, distance))
        scale = dr.select(length > 0, fmin(limit / length, 1), 0)
        a, b = eigen.combination(scale * first, scale * second)
        vector = self.backend.Array3f
        sag = a * dr.fma(a, uu, 2 * b * uv) + b * b * vv  # w.Aw
        sag = clamp(0.5 * sag / plane.gradient_norm, -scale * length, scale * length)
        along = dr.fma(vector(a), plane.u, vector(b) * plane.v)
        return dr.fma(vector(-sag), plane.n, along), is_normal & ~is_saddle

    def _second_derivatives(
        self, y: Vec3, plane: TangentPlane, length: Real
    ) -> tuple[Real, Real, Real]:
        """u.Au, v.Av, u.Av; by differences of the gradient where the field has no Hessian, for
        their errors only cost steps."""
        if self.has_hessian:
            return plane.restrict_hessian(self.field.hessian(y))
        vector, count = self.backend.Array3f, self.backend.UInt32
        h = fmax(self.backend.machine_epsilon**0.5 * length, 1e-30)

        def body(along_u: Vec3, along_v: Vec3, k: Any) -> tuple[Any, ...]:
            direction, step = dr.select(k < 2, plane.u, plane.v), dr.select((k & 1) == 0, h, -h)
            gradient = self.field.evaluate(dr.fma(vector(step), direction, y)).gradient
            change = gradient * (0.5 / step)
            first, second = dr.select((k & 1) == 0, change, along_u + change), along_v + change
            second = dr.select((k & 1) == 0, change, second)
            return dr.select(k < 2, first, along_u), dr.select(k < 2, along_v, second), k + 1

        def is_active(*state: Any) -> Mask:
            return state[-1] < 4

        # The loop starts at NaN: a sum that stays 0, of a constant field, would not be a state.
        state = (vector(dr.nan), vector(dr.nan), count(0))
        along_u, along_v, _ = dr.while_loop(state, is_active, body, label="second derivatives")
        mixed = 0.5 * (dr.dot(plane.v, along_u) + dr.dot(plane.u, along_v))
        return dr.dot(plane.u, along_u), dr.dot(plane.v, along_v), mixed
