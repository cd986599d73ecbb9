"""Finds the point of a level set closest to a query x by descent: from a start point onto the level
set, then along it. f is the function, `level` is its value on the level set, and y is the current
point of the descent.

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
    from harnack.fields.evaluator import Evaluator
    from harnack.fields.field import Sample

__all__ = ["ClosestPointDescent"]

# Largest number of steps of `newton`.
_MAX_NEWTON_STEPS = 10
# `newton` stops if the next step is expected to be shorter than this fraction of the distance.
_NEWTON_TOLERANCE = 1e-11
# Largest number of steps of a descent to the level, and of one along the surface.
_MAX_LEVEL_STEPS = 60
_MAX_SURFACE_STEPS = 60
# Newton's method to a simple root takes fewer steps than this; later steps are lengthened, as for a
# multiple root.
_SIMPLE_ROOT_STEPS = 16
# A descent ends if its step has been reduced to this fraction.
_MIN_STEP_FRACTION = 1e-7
# Lower bound of the eigenvalues of B (`ClosestPointDescent.descend`) that steps are divided by:
# steps are no longer than 20 gradients.
_MIN_EIGENVALUE = 0.05
# y is a saddle or a maximum of the distance if B has an eigenvalue below this.
_INDEFINITE = -1e-3
# A point counts as on the level if rounding moves the level by at most this fraction of its
# coordinates or of the radius of the ball on which f is smooth.
_MAX_RELATIVE_UNCERTAINTY = 1 / 16
# A descent ends where f is singular within this fraction of the distance, as the surface ends
# there. The boundary of the surface is then farther by half the square of this fraction at most.
_MIN_SINGULARITY_FRACTION = 1e-5


@dataclass(frozen=True)
class _DescentState:
    """The state of a descent, which moves a point y onto a level set of f and along it: y, and
    properties of f there.

    gradient: grad f(y).
    level_uncertainty: the length by which rounding may have moved the level set at y.
    smooth_radius: the radius of the ball about y on which f is smooth.
    """

    y: Vec3
    gradient: Vec3
    level_uncertainty: Real
    smooth_radius: Real

    def parts(self) -> tuple[Any, ...]:
        """Return the attributes in the order of the constructor, as the state of a loop."""
        return self.y, self.gradient, self.level_uncertainty, self.smooth_radius

    def flat_after(self, is_flat: Mask, previous: _DescentState) -> _DescentState:
        """Return this state, changed in the lanes `is_flat`, in which both f - level and the
        gradient are 0, so that the gradient has no direction. There the result has the gradient of
        the state `previous`, and as its uncertainty of the level the rounding of coordinates
        alone."""
        epsilon = float(dr.epsilon(type(self.level_uncertainty)))
        rounding = 4 * epsilon * lengths.max_norm(self.y)
        gradient = dr.select(is_flat, previous.gradient, self.gradient)
        return _DescentState(
            self.y,
            gradient,
            dr.select(is_flat, rounding, self.level_uncertainty),
            self.smooth_radius,
        )

    def where(self, mask: Mask, other: _DescentState) -> tuple[Any, ...]:
        """Return the attributes of this state in the lanes of the mask, and of the other state in
        all other lanes, as a tuple in the order of the constructor."""
        pairs = zip(self.parts(), other.parts(), strict=True)
        return tuple(dr.select(mask, first, second) for first, second in pairs)


@dataclass(frozen=True)
class ClosestPointDescent:
    """Searches for points of a level set of f that are locally closest to query points x, by
    Newton's method and by descents along the surface. y is the current point of a search. The
    uncertainty of the level is the length by which rounding may have moved the level set.

    evaluator: samples the function f.
    levels: the values of f on the surface. At a point the level nearest to f counts.
    has_hessian: whether it can compute second derivatives of f.
    """

    backend: Backend
    evaluator: Evaluator
    levels: Levels
    has_hessian: bool

    @classmethod
    def of(cls, backend: Backend, evaluator: Evaluator, levels: Levels) -> ClosestPointDescent:
        """Make the descent, and find out whether the evaluator has a Hessian."""
        return cls(backend, evaluator, levels, has_hessian(backend, evaluator))

    def newton(self, x: Vec3, start: Vec3, limit: Real) -> tuple[Vec3, Real, Mask, Mask]:
        """Run Newton's method for the closest-point equations f(y) = level and (x - y) parallel to
        grad f(y), in one kernel, from a point `start` near the surface.

        x: the query.
        limit: a length; a search whose closest point is farther from x than this stops early.

        Returns four results. The last point y; `finish` makes the last step from it. The
        first-order distance |f - level|/|grad f| of `start` from the level. The mask of lanes that
        failed: their last step was longer than half the radius of the ball in which f is smooth.
        The mask of lanes that stopped early: their closest point is farther from x than `limit`.

        Each step combines the step of `descend` along the surface, which follows its curvature,
        with a Newton step to the level; both use derivatives at the same point. Convergence is
        quadratic: a step of length s after one of length s0 is followed by one of about s (s/s0)^2.
        As long as each step is at most half the one before, the limit of the iteration is within
        twice the current step.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        x, mask = vector(x), self.backend.Bool

        def body(
            y: Vec3, first_step: Real, last: Real, is_lost: Mask, is_far: Mask, k: Any, active: Mask
        ) -> tuple[Any, ...]:
            """Make one step from y. Returns the new state: values in the order of the parameters.

            first_step: the first-order distance of the start from the level.
            last: the length of the step before.
            is_lost, is_far: masks of the lanes that failed, and of those whose closest point is
                farther from x than `limit`, the parameters of `newton`.
            k: the number of steps so far.
            active: whether the search goes on.
            """
            # The rounding error of f is not needed here. Without it the compiler drops the code
            # that computes it, which takes as long as that of f itself.
            sample = dataclasses.replace(self.evaluator.evaluate(y), value_error=0.0)
            # The step to the level and the step along the surface, both from y.
            residual, state = self._state_at(y, sample)
            # (1: the whole step.)
            move, _ = self._tangential_step(x, state, real(1))
            step = -residual / lengths.safe_norm(state.gradient)
            first_step = dr.select(k == 0, dr.abs(step), first_step)
            move = dr.fma(vector(step), state.gradient / lengths.safe_norm(state.gradient), move)
            length, distance = dr.norm(move), dr.norm(x - y)
            max_length = 0.5 * state.smooth_radius
            is_lost = dr.select(active, length > max_length, is_lost)
            is_shrinking = (k > 0) & (length < 0.5 * last)
            # If steps halve, the end is within two steps of y.
            is_far = dr.select(active, is_shrinking & (distance - 2 * length > limit), is_far)
            # The expected length of the next step.
            next_length = length * dr.square(length / last)
            is_last = (
                is_shrinking
                & ~is_lost
                & (next_length <= dr.fma(_NEWTON_TOLERANCE, distance, state.level_uncertainty))
            )
            active &= ~is_far & dr.isfinite(length)
            # A step that is too long ends at its limit.
            y = dr.select(active, y + dr.select(is_lost, max_length / length, 1) * move, y)
            active &= ~is_last & (k + 1 < _MAX_NEWTON_STEPS)
            return y, first_step, length, is_lost, is_far, k + 1, active

        def is_active(*initial: Any) -> Mask:
            return initial[-1]

        # No lane is lost or too far yet; the step before the first one counts as infinite.
        no_lane = mask(False)
        initial = vector(start), real(0), real(dr.inf), no_lane, mask(False), count(0), mask(True)
        final = dr.while_loop(initial, is_active, body, label="Newton's method")
        y, first_step, _, is_lost, is_far, _, _ = final
        return y, first_step, is_lost, is_far

    def finish(self, x: Vec3, y: Vec3) -> tuple[Vec3, Mask, Real]:
        """Finish a search for the surface point closest to x: make one Newton step along the
        gradient, from the last iterate y onto the level.

        Returns the end of the step; the mask of lanes in which this end is on the surface and a
        local minimum of the distance from x, up to rounding; and the radius of a ball about y in
        which no point of the surface is nearer to x, 0 on lanes on which the mask is False.

        Proof that the step ends on the level. Let s be its length along grad f. It is Newton's
        step: the Taylor polynomial of degree 1 is the level at its end, so f differs from the level
        there by at most the bound of the Taylor remainder within s. Over the step the normal turns
        by about s times the curvature; the part of x - y along the surface that this causes is less
        than what `descend` allows.
        """
        sample = self.evaluator.evaluate(y)
        residual, state = self._state_at(y, sample)
        rows = self.evaluator.hessian(y) if self.has_hessian else None
        # The step along the surface is not made here, so its largest fraction (1) does not matter.
        _, is_minimum = self._tangential_step(x, state, self.backend.Float(1), rows)
        gradient_norm = lengths.safe_norm(state.gradient)
        step = -residual / gradient_norm
        # Rounding is no part of the remainder: the step cannot reduce it.
        exact = dataclasses.replace(sample, value_error=0.0, gradient_error=0.0)
        # Whether the step ends on the level, up to the uncertainty of the level.
        is_arriving = (
            taylor_remainder(exact, dr.abs(step)) <= gradient_norm * state.level_uncertainty
        )
        end, is_short = self._step_to_level(x, residual, state)
        is_arriving &= is_short
        # Either y was on the level before the step, or the step ends there.
        is_found = is_minimum & (
            self._is_on_level(residual, state) | (self._is_level_resolved(state) & is_arriving)
        )
        radius = exclusion_radius(exact, rows, x, y)
        return end, is_found, dr.select(is_found, radius, 0)

    def descend(self, x: Vec3, start: Vec3) -> tuple[Vec3, Mask, Mask]:
        """Descend from `start` to a point of the surface closest to the query x.

        Returns the last point y; the mask of lanes in which it is a closest point (a local minimum
        of the distance); and the mask of lanes in which it is a point of the level set.

        Let g = grad f(y), n = g/|g|, r = x - y, and t the part of r tangential to the surface; A is
        the Hessian of f, w a tangential vector. The surface near y is y + w - (w.Aw/(2|g|)) n + ..,
        and half the squared distance decreases by t.w - w.Bw/2 with B = 1 + (r.n) A/|g|. The step w
        along the surface is Newton's step for this quadratic function of w. If an eigenvalue of B
        is not positive, its absolute value is used, so that the step still decreases the distance.
        If an eigenvalue is negative and t vanishes, y is a saddle or a maximum of the distance (x
        is farther than a center of curvature), and the step goes along the eigenvector of the
        smaller eigenvalue. After the step Newton's method leads back to the level. The step is
        accepted if the result is no farther from x; otherwise a quarter of it is tried.

        y is accepted if |t| <= 4 sqrt(epsilon) |r| plus a few rounding errors: then, by the same
        formula, |r| exceeds the local minimum by a fraction of at most 8 epsilon/(smallest
        eigenvalue of B).
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        mask = self.backend.Bool
        x = vector(x)

        def body(
            y: Vec3, g: Vec3, uncertainty: Real, radius: Real,
            factor: Real, on_level: Mask, accepted: Mask, iteration: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            """Make one step along the surface and back to the level. It is accepted if it does not
            lead farther from x. Returns the new state: values in the order of the parameters.

            y, g, uncertainty, radius: the parts of the state (`_DescentState`).
            factor: the fraction of Newton's step that is tried.
            on_level, accepted: whether the start led to a level; whether y is a closest point.
            iteration: the number of steps so far.
            active: whether the descent goes on.
            """
            current, is_first = _DescentState(y, g, uncertainty, radius), iteration == 0
            # In iteration 0 the start is first brought to the level, without a move along it.
            move, is_minimum = self._tangential_step(x, current, factor)
            is_minimum &= ~is_first
            goes_on = active & ~is_minimum
            trial, is_arrived = self._to_level(dr.select(is_first, y, y + move), goes_on)
            # No farther from x than before, up to rounding.
            limit = dr.norm(x - y) * (1 + 8 * self.backend.machine_epsilon) + 4 * uncertainty
            is_better = goes_on & is_arrived & (dr.norm(x - trial.y) <= limit)
            new_factor = dr.select(is_better, fmin(4 * factor, 1), 0.25 * factor)
            factor = dr.select(is_first, factor, new_factor)
            accepted |= active & is_minimum
            on_level = dr.select(is_first, is_arrived, on_level)
            # The surface ends where f is not smooth. A point near there is its boundary, which the
            # descent cannot cross; then it ends.
            is_inner = trial.smooth_radius > _MIN_SINGULARITY_FRACTION * dr.norm(x - trial.y)
            is_inner &= (iteration <= _MAX_SURFACE_STEPS) & (factor > _MIN_STEP_FRACTION)
            active = goes_on & dr.select(is_first, is_arrived, is_inner)
            # Iteration 0 keeps the point on the level, whatever its distance from x.
            return (
                *trial.where(is_better | is_first, current),
                factor,
                on_level,
                accepted,
                iteration + 1,
                active,
            )

        def is_active(*state: Any) -> Mask:
            return state[-1]

        # Iteration 0 leads to the level: so the code of f occurs once in the kernel.
        state = (
            *_DescentState(vector(start), vector(0), real(0), real(0)).parts(),
            real(1), mask(False), mask(False), count(0), mask(True),
        )  # fmt: skip
        y, _, _, _, _, on_level, accepted, _, _ = dr.while_loop(
            state, is_active, body, label="along the level"
        )
        return y, accepted, on_level

    def newton_to_level(self, start: Vec3) -> Vec3:
        """Return the point of a level to which Newton's method along the gradient converges from
        `start`; NaN where it does not."""
        end, is_found = self._to_level(start, self.backend.Bool(True))
        return dr.select(is_found, end.y, dr.nan)

    def noise(self, y: Vec3) -> Real:
        """Return a bound of the length by which rounding and approximation of f may have moved the
        level set at its point y."""
        return self._evaluate(y)[1].level_uncertainty

    def last_step(self, x: Vec3, y: Vec3) -> Vec3:
        """Make the last step of a search for the point closest to x: move y onto the level along
        the gradient. Returns the end of the step; NaN if the step is so long that its end need not
        be closest to x up to rounding."""
        residual, state = self._evaluate(y)
        end, is_short = self._step_to_level(x, residual, state)
        return dr.select(is_short & self._is_level_resolved(state), end, dr.nan)

    def _step_to_level(self, x: Vec3, residual: Real, state: _DescentState) -> tuple[Vec3, Mask]:
        """Make one Newton step from the point y of `state` to the level, along the gradient.
        Returns the end of the step; and a mask that is True where the step is short enough to end
        the search: if x - y is along the gradient at y, the end of the step is closest to x up to
        rounding.

        residual: f - level at the start.
        """
        gradient_norm = lengths.safe_norm(state.gradient)
        step = -residual / gradient_norm
        end = dr.fma(self.backend.Array3f(step / gradient_norm), state.gradient, state.y)
        # A step s turns the normal by about s times the curvature. This changes the distance from x
        # by the order of s^2 only: so the limit is a square root of epsilon.
        limit = self.backend.machine_epsilon**0.5 * dr.norm(x - state.y) + state.level_uncertainty
        return end, dr.abs(step) <= limit

    def _evaluate(self, y: Vec3) -> tuple[Real, _DescentState]:
        """Evaluate f at y. Returns f - level for the nearest level, and the descent state at y."""
        return self._state_at(y, self.evaluator.evaluate(y))

    def _state_at(self, y: Vec3, sample: Sample) -> tuple[Real, _DescentState]:
        """Return f - level for the level nearest in value, and the state of a descent at y.

        sample: the sample of f at y.

        f counts as smooth on the largest ball of finite radius about y on which one of the sample's
        promises (proved bounds of f near y) implies that; everywhere if there is no such ball.
        """
        real = self.backend.Float
        scale = lengths.max_norm(y)
        epsilon, gradient_norm = self.backend.machine_epsilon, lengths.safe_norm(sample.gradient)
        # With the rounding of f - level.
        total_error = dr.fma(8 * epsilon, dr.abs(sample.value), sample.value_error)
        # Rounding of coordinates, and of f divided by its slope.
        uncertainty = dr.fma(4 * epsilon, scale, total_error / gradient_norm)
        smooth_radius = real(0)
        for promise in sample.all_promises:
            if not promise.implies_smooth:
                continue
            # A radius that is not finite is left out.
            promised_radius = real(promise.radius)
            smooth_radius = fmax(
                smooth_radius, dr.select(dr.isfinite(promised_radius), promised_radius, 0)
            )
        # No such ball: steps have no limit.
        smooth_radius = dr.select(smooth_radius > 0, smooth_radius, dr.inf)
        residual = real(-self.levels.offset_to_nearest(sample.value))
        return residual, _DescentState(
            y, self.backend.Array3f(sample.gradient), uncertainty, smooth_radius
        )

    @staticmethod
    def _is_on_level(residual: Real, state: _DescentState) -> Mask:
        """Return the mask of lanes on which the point of `state` is on the level, up to rounding.
        It is False where rounding errors are so large that nothing can be said.

        residual: f - level there.
        """
        is_resolved = ClosestPointDescent._is_level_resolved(state)
        return is_resolved & (
            dr.abs(residual) <= 2 * lengths.safe_norm(state.gradient) * state.level_uncertainty
        )

    @staticmethod
    def _is_level_resolved(state: _DescentState) -> Mask:
        """Return the mask of lanes on which the position of the level set near the point of `state`
        is known in spite of rounding. There its uncertainty is at most a sixteenth of a length: of
        the largest coordinate, or of the radius of the ball on which f is smooth."""
        size = lengths.max_norm(state.y)
        return state.level_uncertainty <= _MAX_RELATIVE_UNCERTAINTY * fmax(
            size, state.smooth_radius
        )

    def _to_level(self, start: Vec3, active: Mask) -> tuple[_DescentState, Mask]:
        """Run Newton's method along the gradient, from `start` to the nearest level. Returns the
        state at the end, and the mask of lanes in which its point is on a level, up to rounding.

        active: mask of lanes that search.

        A step is no longer than the radius of the ball on which f is known to be smooth. It is
        accepted if f at its end is nearer to a level; otherwise a quarter of it is tried.

        If f - level is a power u^m of a smooth function u, grad f is 0 on the surface, and each
        step is only 1 - 1/m times the one before. After `_SIMPLE_ROOT_STEPS` steps, the next ones
        are made longer by an estimate of m (`multiplicity`). If a step ends where f - level and its
        gradient are 0, the state gets the last gradient before.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32

        def body(
            residual: Real, y: Vec3, g: Vec3, uncertainty: Real, radius: Real,
            last: Real, factor: Real, on_level: Mask, iteration: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            """Make one Newton step towards the level. It is accepted if f at its end is nearer to
            the level. Returns the new state: values in the order of the parameters.

            residual: f - level at y.
            y, g, uncertainty, radius: the parts of the state (`_DescentState`).
            last: the length of the step before.
            factor: the fraction of Newton's step that is tried.
            on_level: whether y is on the level.
            iteration: the number of steps so far.
            active: whether the search goes on.
            """
            current, gradient_norm, is_first = (
                _DescentState(y, g, uncertainty, radius),
                lengths.safe_norm(g),
                iteration == 0,
            )
            # Iteration 0 evaluates the start; later ones try a step from y, made longer by the
            # estimated multiplicity of the root (`step_factor`).
            step = -residual / gradient_norm
            step_factor = dr.select(iteration > _SIMPLE_ROOT_STEPS, multiplicity(step, last), 1)
            length = factor * clamp(step_factor * step, -radius, radius)
            point = dr.fma(vector(length / gradient_norm), g, y)
            new_residual, trial = self._evaluate(dr.select(is_first, y, point))
            is_flat = ~is_first & (new_residual == 0) & (lengths.safe_norm(trial.gradient) == 0)
            trial = trial.flat_after(is_flat, current)
            is_better = active & (is_first | (dr.abs(new_residual) < dr.abs(residual)))
            # The fraction of Newton's step that the next iteration tries.
            next_factor = dr.select(is_better, fmin(2 * factor, 1), 0.25 * factor)
            factor = dr.select(is_first, factor, next_factor)
            on_level |= is_better & self._is_on_level(new_residual, trial)
            active &= ~on_level & (iteration <= _MAX_LEVEL_STEPS) & (factor > _MIN_STEP_FRACTION)
            residual = dr.select(is_better, new_residual, residual)
            last = dr.select(is_first, dr.inf, dr.abs(step))
            return (
                residual,
                *trial.where(is_better, current),
                last,
                factor,
                on_level,
                iteration + 1,
                active,
            )

        def is_active(*state: Any) -> Mask:
            return state[-1]

        # Iteration 0 evaluates the start.
        initial = _DescentState(vector(start), vector(0), real(0), real(0))
        on_level = self.backend.Bool(False)
        going = self.backend.Bool(active)
        state = (real(dr.inf), *initial.parts(), real(dr.inf), real(1), on_level, count(0), going)
        _, *end, _, _, on_level, _, _ = dr.while_loop(state, is_active, body, label="to the level")
        return _DescentState(*end), on_level

    def _tangential_step(
        self, x: Vec3, state: _DescentState, factor: Real, rows: Rows | None = None
    ) -> tuple[Vec3, Mask]:
        """Make one step along the surface from a point y of it, toward the point closest to x.
        Returns the step as a vector, and the mask of lanes in which y already is a local minimum of
        the distance from x, up to rounding. (The formula is derived in `descend`.)

        state: the point y, and f there.
        factor: the step is at most this fraction of the largest permitted length, the smaller of |x
            - y| and the radius of the ball on which f is smooth.
        rows: the rows of the Hessian at y. If None, they are computed.
        """
        # uu, vv and uv are the second derivatives of f along the tangents u and v of the plane.
        plane = TangentPlane.of(state.gradient)
        to_x = x - state.y
        distance = dr.norm(to_x)
        if rows is not None:
            uu, vv, uv = plane.restrict_hessian(rows)
        else:
            uu, vv, uv = self._second_derivatives(
                state.y, plane, fmin(state.smooth_radius, distance)
            )
        # The matrix B = 1 + (r.n) A/|g| of `descend` in the basis of the tangents u and v.
        height_ratio = dr.dot(to_x, plane.n) / plane.gradient_norm
        eigen = SymmetricEigen2.of(
            dr.fma(height_ratio, uu, 1), dr.fma(height_ratio, vv, 1), height_ratio * uv
        )
        # The tangential part of x - y. If it is 0 up to rounding, x - y is normal to the surface.
        tu, tv = dr.dot(to_x, plane.u), dr.dot(to_x, plane.v)
        tangential = dr.sqrt(dr.fma(tu, tu, tv * tv))
        is_normal = tangential <= dr.fma(
            4 * self.backend.machine_epsilon**0.5, distance, 8 * state.level_uncertainty
        )
        is_saddle = is_normal & (eigen.smallest < _INDEFINITE)
        # Newton's step in the basis of B's eigenvectors. At a saddle it is half the distance from
        # x, along the eigenvector of the smaller eigenvalue.
        along_largest, along_smallest = eigen.coordinates(tu, tv)
        along_largest = along_largest / fmax(dr.abs(eigen.largest), _MIN_EIGENVALUE)
        along_smallest = along_smallest / fmax(dr.abs(eigen.smallest), _MIN_EIGENVALUE)
        along_smallest = dr.select(is_saddle, 0.5 * distance, along_smallest)
        length = dr.sqrt(dr.fma(along_largest, along_largest, along_smallest * along_smallest))
        # At most the radius of the ball on which f is smooth, and the distance from x.
        max_length = factor * dr.select(is_saddle, length, fmin(state.smooth_radius, distance))
        scale = dr.select(length > 0, fmin(max_length / length, 1), 0)
        # The step w = a u + b v along the surface.
        a, b = eigen.combination(scale * along_largest, scale * along_smallest)
        vector = self.backend.Array3f
        drop = a * dr.fma(a, uu, 2 * b * uv) + b * b * vv  # w.Aw
        # How far the surface bends away from its tangent plane, to second order: w.Aw/(2|g|). It is
        # limited by the length of w, as the formula holds for small bends only.
        drop = clamp(0.5 * drop / plane.gradient_norm, -scale * length, scale * length)
        tangent_step = dr.fma(vector(a), plane.u, vector(b) * plane.v)
        return dr.fma(vector(-drop), plane.n, tangent_step), is_normal & ~is_saddle

    def _second_derivatives(
        self, y: Vec3, plane: TangentPlane, length: Real
    ) -> tuple[Real, Real, Real]:
        """Return the numbers u.Au, v.Av and u.Av, where A is the Hessian of f at y, and u and v are
        the two unit tangents of the plane.

        If the field has no Hessian, they are computed by central differences of the gradient with
        the step sqrt(epsilon) times `length`, where epsilon is the machine epsilon. Errors of these
        differences make a descent slower, but not wrong.
        """
        if self.has_hessian:
            return plane.restrict_hessian(self.evaluator.hessian(y))
        vector, count = self.backend.Array3f, self.backend.UInt32
        h = fmax(self.backend.machine_epsilon**0.5 * length, 1e-30)  # not 0, as it divides

        def body(along_u: Vec3, along_v: Vec3, k: Any) -> tuple[Any, ...]:
            """Add the term of node k to the central differences, and return the new state. The four
            nodes are y + h u, y - h u, y + h v and y - h v. An even node begins a difference, an
            odd node completes it.

            along_u, along_v: the derivatives of the gradient along u and v; in them the terms of
                the nodes before k are summed.
            """
            # Nodes 0 and 1 are along u, 2 and 3 along v; odd nodes have the step -h, so that their
            # terms are subtracted.
            direction, step = dr.select(k < 2, plane.u, plane.v), dr.select((k & 1) == 0, h, -h)
            gradient = self.evaluator.evaluate(dr.fma(vector(step), direction, y)).gradient
            term = gradient * (0.5 / step)
            new_u, new_v = dr.select((k & 1) == 0, term, along_u + term), along_v + term
            new_v = dr.select((k & 1) == 0, term, new_v)
            return dr.select(k < 2, new_u, along_u), dr.select(k < 2, along_v, new_v), k + 1

        def is_active(*state: Any) -> Mask:
            return state[-1] < 4

        # The sums start at NaN, which even nodes overwrite. If they started at 0, the sums of a
        # constant field would stay 0, and Dr.Jit would not keep them in the state of the loop.
        state = (vector(dr.nan), vector(dr.nan), count(0))
        along_u, along_v, _ = dr.while_loop(state, is_active, body, label="second derivatives")
        mixed = 0.5 * (dr.dot(plane.v, along_u) + dr.dot(plane.u, along_v))
        return dr.dot(plane.u, along_u), dr.dot(plane.v, along_v), mixed
