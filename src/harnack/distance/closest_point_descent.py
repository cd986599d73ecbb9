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
_NEAR = 1e-11  # of the distance: the last step is expected to be shorter
_STEPS_TO_LEVEL = 60
_STEPS_ALONG = 60
# Newton's method to a simple root takes fewer steps than that.
_PATIENT = 16
_MIN_STEP_FRACTION = 1e-7  # of a step: shorter ones are given up
_LEAST_EIGENVALUE = (
    0.05  # of B (`ClosestPointDescent.descend`): steps are no longer than 20 gradients
)
_INDEFINITE = -1e-3
# A place counts as on the level if rounding moves the level by at most this part of its coordinates
# or of the radius of the ball on which f is smooth.
_MAX_RELATIVE_UNCERTAINTY = 1 / 16
# No minimum is looked for nearer than this share of the distance to where f is singular, as the
# surface ends there: its boundary is farther by a share of half the square.
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
        """The fields in the order of the constructor, as loops want them."""
        return self.y, self.gradient, self.level_uncertainty, self.smooth_radius

    def flat_after(self, mask: Mask, before: _DescentState) -> _DescentState:
        """The place, where f - level and its gradient are 0 on lanes of the mask: with the gradient
        of the place before, and with the rounding of coordinates alone."""
        epsilon = float(dr.epsilon(type(self.level_uncertainty)))
        rounding = 4 * epsilon * lengths.max_norm(self.y)
        gradient = dr.select(mask, before.gradient, self.gradient)
        return _DescentState(
            self.y, gradient, dr.select(mask, rounding, self.level_uncertainty), self.smooth_radius
        )

    def where(self, mask: Mask, other: _DescentState) -> tuple[Any, ...]:
        """Its parts in some lanes, another's elsewhere."""
        pairs = zip(self.parts(), other.parts(), strict=True)
        return tuple(dr.select(mask, one, two) for one, two in pairs)


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
            y: Vec3, first: Real, last: Real, is_lost: Mask, is_far: Mask, k: Any, active: Mask
        ) -> tuple[Any, ...]:
            # What rounding does to f takes as long as f itself, and is of no matter here.
            sample = dataclasses.replace(self.field.evaluate(y), value_error=0.0)
            above, here = self._place(y, sample)
            move, _ = self._step_along(x, here, real(1))
            off = -above / lengths.safe_norm(here.gradient)
            first = dr.select(k == 0, dr.abs(off), first)
            move = dr.fma(vector(off), here.gradient / lengths.safe_norm(here.gradient), move)
            length, distance = dr.norm(move), dr.norm(x - y)
            longest = 0.5 * here.smooth_radius
            is_lost = dr.select(active, length > longest, is_lost)
            shrinks = (k > 0) & (length < 0.5 * last)
            is_far = dr.select(active, shrinks & (distance - 2 * length > limit), is_far)
            after = length * dr.square(length / last)
            is_near = (
                shrinks & ~is_lost & (after <= dr.fma(_NEAR, distance, here.level_uncertainty))
            )
            active &= ~is_far & dr.isfinite(length)
            y = dr.select(active, y + dr.select(is_lost, longest / length, 1) * move, y)
            active &= ~is_near & (k + 1 < _STEPS_DIRECT)
            return y, first, length, is_lost, is_far, k + 1, active

        def more(*state: Any) -> Mask:
            return state[-1]

        never = mask(False)
        state = vector(start), real(0), real(dr.inf), never, mask(False), count(0), mask(True)
        found = dr.while_loop(state, more, body, label="Newton's method")
        y, first, _, is_lost, is_far, _, _ = found
        return y, first, is_lost, is_far

    def finish(self, x: Vec3, y: Vec3) -> tuple[Vec3, Mask, Real]:
        """The last step from y onto the level; whether that leads to a closest point to x, by the
        criterion of `descend`; and a radius about it in which no point of the surface is nearer.

        Proof that the step, of length s along grad f, ends on the level: by Newton's formula f is
        off the level there by at most what Taylor's polynomial of first degree leaves out within s.
        It turns normals by about s times the curvature, less than slant may be in any case.
        """
        sample = self.field.evaluate(y)
        above, here = self._place(y, sample)
        rows = self.field.hessian(y) if self.has_hessian else None
        _, settled = self._step_along(x, here, self.backend.Float(1), rows)
        steep = lengths.safe_norm(here.gradient)
        off = -above / steep
        exact = dataclasses.replace(sample, value_error=0.0, gradient_error=0.0)
        lands = taylor_remainder(exact, dr.abs(off)) <= steep * here.level_uncertainty
        foot, is_short = self._step_to_level(x, above, here)
        lands &= is_short
        found = settled & (self._is_on_level(above, here) | (self._is_level_resolved(here) & lands))
        free = exclusion_radius(exact, rows, x, y)
        return foot, found, dr.select(found, free, 0)

    def descend(self, x: Vec3, start: Vec3) -> tuple[Vec3, Mask, Mask]:
        """The closest point y to x that is found from `start`, whether it is one (see above), and
        whether it is a point of the level set at all.

        A step along the surface is Newton's for |x-y|^2/2: with r = x - y, tangential part t, and
        the Hessian A in tangential coordinates, the surface near y is y + w - (w.Aw/(2|g|)) n + ..
        and half the squared distance falls by t.w - w.Bw/2 with B = 1 + (r.n) A/|g|. Where an
        eigenvalue of B is not positive its size is taken instead, so that the step still goes
        down; where t vanishes as well, y is a saddle or a maximum of the distance (x is beyond a
        center of curvature), left along that eigenvector. The step ends with Newton's method
        back to the level, and counts if it came no farther from x, else a quarter is tried.

        y is accepted if |t| <= 4 sqrt(epsilon) |r| and a few roundings: then, by the same formula,
        |r| exceeds the local minimum by a share 8 epsilon/(least eigenvalue of B).
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32
        mask = self.backend.Bool
        x = vector(x)

        def body(
            y: Vec3, g: Vec3, noise: Real, reach: Real,
            share: Real, on_level: Mask, found: Mask, n: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            here, first = _DescentState(y, g, noise, reach), n == 0
            move, settled = self._step_along(x, here, share)
            settled &= ~first
            going = active & ~settled
            there, arrived = self._to_level(dr.select(first, y, y + move), going)
            limit = dr.norm(x - y) * (1 + 8 * self.backend.machine_epsilon) + 4 * noise
            better = going & arrived & (dr.norm(x - there.y) <= limit)
            longer = dr.select(better, fmin(4 * share, 1), 0.25 * share)
            share = dr.select(first, share, longer)
            found |= active & settled
            on_level = dr.select(first, arrived, on_level)
            # Where f ceases to be smooth the surface ends: no minimum inside it.
            inner = there.smooth_radius > _MIN_SINGULARITY_FRACTION * dr.norm(x - there.y)
            inner &= (n <= _STEPS_ALONG) & (share > _MIN_STEP_FRACTION)
            active = going & dr.select(first, arrived, inner)
            return *there.where(better | first, here), share, on_level, found, n + 1, active

        def more(*state: Any) -> Mask:
            return state[-1]

        # Round 0 goes to the level: f is recorded once for both.
        state = (
            *_DescentState(vector(start), vector(0), real(0), real(0)).parts(),
            real(1), mask(False), mask(False), count(0), mask(True),
        )  # fmt: skip
        y, _, _, _, _, on_level, found, _, _ = dr.while_loop(
            state, more, body, label="along the level"
        )
        return y, found, on_level

    def newton_to_level(self, start: Vec3) -> Vec3:
        """The point of a level to which Newton's method along the gradient converges; NaN where it
        does not."""
        place, found = self._to_level(start, self.backend.Bool(True))
        return dr.select(found, place.y, dr.nan)

    def noise(self, y: Vec3) -> Real:
        """How far rounding and approximation may have moved the level at y, as a length."""
        return self._evaluate(y)[1].level_uncertainty

    def last_step(self, x: Vec3, y: Vec3) -> Vec3:
        """y moved onto the level, where it is closest to x but for so short a step as in `finish`;
        NaN elsewhere."""
        above, here = self._evaluate(y)
        foot, is_short = self._step_to_level(x, above, here)
        return dr.select(is_short & self._is_level_resolved(here), foot, dr.nan)

    def _step_to_level(self, x: Vec3, above: Real, here: _DescentState) -> tuple[Vec3, Mask]:
        """Where Newton's step along the gradient leads, and whether it is so short that the point
        stays the closest to x, to rounding."""
        steep = lengths.safe_norm(here.gradient)
        off = -above / steep
        foot = dr.fma(self.backend.Array3f(off / steep), here.gradient, here.y)
        limit = self.backend.machine_epsilon**0.5 * dr.norm(x - here.y) + here.level_uncertainty
        return foot, dr.abs(off) <= limit

    def _evaluate(self, y: Vec3) -> tuple[Real, _DescentState]:
        """f - level at y, and the place."""
        return self._place(y, self.field.evaluate(y))

    def _place(self, y: Vec3, sample: Sample) -> tuple[Real, _DescentState]:
        real = self.backend.Float
        size = lengths.max_norm(y)
        epsilon, gradient_norm = self.backend.machine_epsilon, lengths.safe_norm(sample.gradient)
        total_error = dr.fma(8 * epsilon, dr.abs(sample.value), sample.value_error)
        noise = dr.fma(4 * epsilon, size, total_error / gradient_norm)
        reach = real(0)
        for known in sample.all_promises:
            if not known.implies_smooth:
                continue
            radius = real(known.radius)
            reach = fmax(reach, dr.select(dr.isfinite(radius), radius, 0))
        reach = dr.select(reach > 0, reach, dr.inf)
        above = real(-self.levels.offset_to_nearest(sample.value))
        return above, _DescentState(y, self.backend.Array3f(sample.gradient), noise, reach)

    @staticmethod
    def _is_on_level(above: Real, place: _DescentState) -> Mask:
        """Whether a place is on the level, to rounding; False where rounding leaves that open."""
        known = ClosestPointDescent._is_level_resolved(place)
        return known & (
            dr.abs(above) <= 2 * lengths.safe_norm(place.gradient) * place.level_uncertainty
        )

    @staticmethod
    def _is_level_resolved(place: _DescentState) -> Mask:
        """Whether rounding tells anything of the level."""
        size = lengths.max_norm(place.y)
        return place.level_uncertainty <= _MAX_RELATIVE_UNCERTAINTY * fmax(
            size, place.smooth_radius
        )

    def _to_level(self, start: Vec3, active: Mask) -> tuple[_DescentState, Mask]:
        """From `start` to the nearest level by Newton's method along the gradient.

        A step is no longer than the ball on which f is known to be smooth, and counts if it comes
        nearer to a level. Returns the end, and whether it is on a level to rounding.

        Where f - level is a power u^m, as on a surface along which grad f is 0, steps shrink by 1 -
        1/m only. Those that do so for long are made `multiplicity` times as long. If such a step
        ends where f - level and its gradient are 0, the direction of the gradient is the last one.
        """
        real, vector, count = self.backend.Float, self.backend.Array3f, self.backend.UInt32

        def body(
            above: Real, y: Vec3, g: Vec3, noise: Real, reach: Real,
            last: Real, share: Real, close: Mask, n: Any, active: Mask,
        ) -> tuple[Any, ...]:  # fmt: skip
            here, gradient_norm, first = (
                _DescentState(y, g, noise, reach),
                lengths.safe_norm(g),
                n == 0,
            )
            step = -above / gradient_norm
            longer = dr.select(n > _PATIENT, multiplicity(step, last), 1)
            length = share * clamp(longer * step, -reach, reach)
            nearer = dr.fma(vector(length / gradient_norm), g, y)
            above2, there = self._evaluate(dr.select(first, y, nearer))
            is_flat = ~first & (above2 == 0) & (lengths.safe_norm(there.gradient) == 0)
            there = there.flat_after(is_flat, here)
            better = active & (first | (dr.abs(above2) < dr.abs(above)))
            longer = dr.select(better, fmin(2 * share, 1), 0.25 * share)
            share = dr.select(first, share, longer)
            close |= better & self._is_on_level(above2, there)
            active &= ~close & (n <= _STEPS_TO_LEVEL) & (share > _MIN_STEP_FRACTION)
            above = dr.select(better, above2, above)
            last = dr.select(first, dr.inf, dr.abs(step))
            return above, *there.where(better, here), last, share, close, n + 1, active

        def more(*state: Any) -> Mask:
            return state[-1]

        # Round 0 evaluates the start.
        first = _DescentState(vector(start), vector(0), real(0), real(0))
        close = self.backend.Bool(False)
        going = self.backend.Bool(active)
        state = (real(dr.inf), *first.parts(), real(dr.inf), real(1), close, count(0), going)
        _, *place, _, _, close, _, _ = dr.while_loop(state, more, body, label="to the level")
        return _DescentState(*place), close

    def _step_along(
        self, x: Vec3, here: _DescentState, share: Real, rows: Rows | None = None
    ) -> tuple[Vec3, Mask]:
        """The step along the surface, and whether y already is a local minimum of the distance.

        rows: of the Hessian, where they are known.
        """
        plane = TangentPlane.of(here.gradient)
        r = x - here.y
        distance = dr.norm(r)
        if rows is not None:
            uu, vv, uv = plane.restrict_hessian(rows)
        else:
            uu, vv, uv = self._second_derivatives(here.y, plane, fmin(here.smooth_radius, distance))
        lift = dr.dot(r, plane.n) / plane.gradient_norm
        eigen = SymmetricEigen2.of(dr.fma(lift, uu, 1), dr.fma(lift, vv, 1), lift * uv)  # of B
        tu, tv = dr.dot(r, plane.u), dr.dot(r, plane.v)
        slant = dr.sqrt(dr.fma(tu, tu, tv * tv))
        level = slant <= dr.fma(
            4 * self.backend.machine_epsilon**0.5, distance, 8 * here.level_uncertainty
        )
        saddle = level & (eigen.smallest < _INDEFINITE)
        most, least = eigen.coordinates(tu, tv)
        most = most / fmax(dr.abs(eigen.largest), _LEAST_EIGENVALUE)
        least = least / fmax(dr.abs(eigen.smallest), _LEAST_EIGENVALUE)
        least = dr.select(saddle, 0.5 * distance, least)
        length = dr.sqrt(dr.fma(most, most, least * least))
        limit = share * dr.select(saddle, length, fmin(here.smooth_radius, distance))
        scale = dr.select(length > 0, fmin(limit / length, 1), 0)
        a, b = eigen.combination(scale * most, scale * least)
        vector = self.backend.Array3f
        falls = a * dr.fma(a, uu, 2 * b * uv) + b * b * vv  # w.Aw
        falls = clamp(0.5 * falls / plane.gradient_norm, -scale * length, scale * length)
        along = dr.fma(vector(a), plane.u, vector(b) * plane.v)
        return dr.fma(vector(-falls), plane.n, along), level & ~saddle

    def _second_derivatives(
        self, y: Vec3, plane: TangentPlane, size: Real
    ) -> tuple[Real, Real, Real]:
        """u.Au, v.Av, u.Av; by differences of the gradient where the field has no Hessian, for
        their errors only cost steps."""
        if self.has_hessian:
            return plane.restrict_hessian(self.field.hessian(y))
        vector, count = self.backend.Array3f, self.backend.UInt32
        h = fmax(self.backend.machine_epsilon**0.5 * size, 1e-30)

        def body(ahead: Vec3, aside: Vec3, k: Any) -> tuple[Any, ...]:
            way, sign = dr.select(k < 2, plane.u, plane.v), dr.select((k & 1) == 0, h, -h)
            gradient = self.field.evaluate(dr.fma(vector(sign), way, y)).gradient
            change = gradient * (0.5 / sign)
            first, second = dr.select((k & 1) == 0, change, ahead + change), aside + change
            second = dr.select((k & 1) == 0, change, second)
            return dr.select(k < 2, first, ahead), dr.select(k < 2, aside, second), k + 1

        def more(*state: Any) -> Mask:
            return state[-1] < 4

        # From what is no number: a sum that stays 0, of a constant field, would be no state.
        state = (vector(dr.nan), vector(dr.nan), count(0))
        ahead, aside, _ = dr.while_loop(state, more, body, label="second derivatives")
        cross = 0.5 * (dr.dot(plane.v, ahead) + dr.dot(plane.u, aside))
        return dr.dot(plane.u, ahead), dr.dot(plane.v, aside), cross
