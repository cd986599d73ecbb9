"""Pixel cones: tests whether a surface may cover a part of a pixel although the ray through its
middle misses it. The cone around this ray has the radius of the pixel; f is the function whose
level is the surface.

The cover of a surface is the surface moved outwards by the radius of the cone (Thomas et al. 1989;
Hart 1996, Section 3). A cone is covered in part if its ray enters the cover and leaves it again on
the same side. It is covered completely if its ray gets one radius behind the surface. All this is
to first order: the distance to a level is taken as |f - level| / |grad f|, which is right only
close to a smooth surface.

Cones only select pixels. With `antialias="cones"`, pixels whose cone may be covered in part get all
samples, and the rays of these samples give the color. Hart's coverage by a half plane (1996, Eq.
22), composited over the background, was tried and left out. Its error was as large as that of 9
rays a pixel on letters, and two to four times as large where surfaces end, have creases or are
thinner than the cone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend.elementary import fmax, fmin, safe_norm
from harnack.backend.loops import loop_while_active
from harnack.enclosures.samples import Ray
from harnack.tracer.level_contact import DeviceHitTolerance, RayStatus
from harnack.tracer.level_rule import PlainLevels
from harnack.tracer.march import March, MarchState

if TYPE_CHECKING:
    from harnack.backend import Mask, Real, Vec3
    from harnack.tracer.surface_tracer import SurfaceTracer

# A passage through the cover begins within the first number of radii outside of it, and ends the
# second number of radii off the surface. Steps are aimed the third number of radii farther than the
# end, or than a radius behind the surface.
_START_MARGIN, _END_HEIGHT, _AIM_MARGIN = 0.02, 1.1, 0.05
# The first number for approximate fields, whose samples cost more the more exact they are.
_START_MARGIN_APPROXIMATE = 0.25
# Steps of a passage: the shortest step and the longest first step, in radii; the longest of the
# other steps, as a multiple of the step before.
_MIN_STEP, _MAX_FIRST_STEP, _MAX_STEP_RATIO = 0.25, 32.0, 4.0
# Samples of a passage; a cone that has none left counts as covered in part.
_MAX_SAMPLES = 48
# A number below any slope or second derivative that matters, in radii.
_NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class _CoverState:
    """The state of a ray in the cover, the layer around the surface whose thickness is the radius
    of the cone around the ray. The height is the distance of a point of the ray over the surface,
    to first order, in radii of the cone; it is negative behind the surface.

    t, height, slope: the ray parameter of the last sample, the height there, and the derivative of
        the height along the ray.
    step: the length from there to the next sample.
    sample_count: the number of samples so far.
    active: whether the ray goes on.
    """

    t: Real
    height: Real
    slope: Real
    step: Real
    sample_count: Any
    active: Mask


@dataclass(frozen=True)
class PixelCones:
    """Cones around rays o + t d, |d| = 1, that may touch a level set of a function f. The cover is
    the layer around the surface whose thickness is the radius of the cone.

    tracer: the tracer of the level set.
    radius: the radius of a cone per unit of t.
    bounding_balls: (middle, depth, size): the common center of a ball of radius `depth` inside the
        extent of the surface and of a ball of radius `size` around the extent; None for an
        unbounded extent.
    solid: (low, high) for a solid {low <= f <= high}; None for a surface with two sides.
    """

    tracer: SurfaceTracer
    origin: Vec3
    direction: Vec3
    radius: Real
    bounding_balls: tuple[Vec3, Real, Real] | None = None
    solid: tuple[Real, Real] | None = None

    def partially_covered(self, t_max: Real, active: Mask) -> tuple[Mask, Any]:
        """Find the cones that the surface covers in part but not completely. Returns their mask and
        the number of evaluations of f.

        t_max: only the first passage of each ray through the cover is examined, and only if it
            begins before this ray parameter.
        active: mask of cones that are tested.

        A ray marches to the cover with proofs (`March.advance`). Levels then count as nearer in
        value by |grad f| times the radius. So a proved step keeps the ray a radius off the surface,
        to first order. Within the cover steps are predicted and not proved. That can only miss a
        second surface within the cover of the first. A ray that has used all samples in the cover
        counts as covered in part.
        """
        backend, tracer = self.tracer.backend, self.tracer
        real = backend.Float
        path = Ray(self.origin, self.direction, tracer.proofs)
        start, t_end = self._clip()
        end = fmin(t_end, real(t_max))
        state = MarchState.at(
            backend, start, end, active, has_detail=tracer.evaluator.variable_accuracy is not None
        )  # fmt: skip
        margin = (
            _START_MARGIN
            if tracer.evaluator.variable_accuracy is None
            else _START_MARGIN_APPROXIMATE
        )
        # The march ends a small margin outside of the cover: the tolerance grows with the cone.
        # (`distance` and `value` of the tolerance are 0, `per_length` is the margin.)
        tolerance = DeviceHitTolerance(real(0), margin * self.radius, real(0))
        rule = PlainLevels(tracer.levels)
        march_options = rule, tolerance, tracer.max_steps, tracer.over_relaxation
        march = March(backend, *march_options, cone_radius=self.radius)
        now = march.advance(tracer.evaluator, path, real(end), state)
        # A hit is a point at which the ray comes to the cover.
        is_hit = now.status == int(RayStatus.HIT)
        begin = dr.select(is_hit, now.proved_to, 0)
        gap = tracer.levels.offset_to_nearest(now.value)
        # The level that was reached, and 1 or -1 if the ray comes from larger or smaller f.
        level, side = now.value + gap, dr.select(gap < 0, real(1), -1)

        def sample_at(t: Real) -> tuple[Real, Real]:
            """Return the height over the surface at parameters t, in radii of the cone, and its
            derivative along the ray."""
            # With the accuracy at which the march has ended.
            evaluator, accuracy = tracer.evaluator, tracer.evaluator.variable_accuracy
            if accuracy is not None and now.accuracy_scale is not None:
                evaluator = accuracy.at(now.accuracy_scale)
            sample = evaluator.evaluate(dr.fma(backend.Array3f(t), self.direction, self.origin))
            return self._height(sample.value, sample.gradient, t, side, level)

        def sample_once(last: _CoverState) -> _CoverState:
            """Take one more sample within the cover. Returns the state after it."""
            t = last.t + last.step
            height, slope = sample_at(t)
            step = _next_step(
                height, slope, (slope - last.slope) / last.step, _MAX_STEP_RATIO * last.step
            )
            count = last.sample_count + 1
            # The passage ends behind the surface, off the cover, or where its samples are used up.
            has_left = (height >= _END_HEIGHT) & (slope >= 0)
            is_over = (height <= -1) | has_left | (count >= _MAX_SAMPLES) | (t >= t_end)
            step = fmax(step, _MIN_STEP * self.radius * t)
            return _CoverState(t, height, slope, step, count, last.active & ~is_over)

        height, slope = self._height(now.value, now.gradient, begin, side, level)
        # With the second derivative 0, as none is known yet.
        first_step = _next_step(height, slope, real(0), _MAX_FIRST_STEP * self.radius * begin)
        no_samples = backend.UInt32(0)
        passage = _CoverState(begin, height, slope, first_step, no_samples, is_hit & (height > -1))
        passage = loop_while_active(passage, sample_once, "harnack cover")
        return is_hit & ~(passage.height <= -1), now.evaluations + passage.sample_count

    def _height(
        self, value: Real, gradient: Vec3, t: Real, side: Real, level: Real
    ) -> tuple[Real, Real]:
        """Return the height of a point of the ray over the surface, in radii of the cone, and the
        derivative of the height along the ray.

        value, gradient, t: f, its gradient (3,) and the ray parameter of a sample.
        side: 1 if the ray comes to the level from larger f, -1 if from smaller f; not used for a
            solid.
        level: the level; not used for a solid.

        The height is inf where the gradient or t is 0.
        """
        period = self.tracer.levels.period
        offset = value - level
        if period is not None:
            offset = dr.fma(dr.round(offset / period), -period, offset)
        # The height as a difference of f, which is divided by `radius_in_value` below.
        height = side * offset
        if self.solid is not None:
            # Outside of the solid f is below `low` or above `high`: one of the differences is
            # positive, and counts. `side` tells whether the height rises with f.
            low, high = self.solid
            height = fmax(low - value, value - high)
            side = dr.select(low - value > value - high, -1, type(value)(1))
        # The radius of the cone, as a difference of f.
        radius_in_value = safe_norm(gradient) * self.radius * t
        has_slope = radius_in_value > 0
        slope = dr.select(has_slope, side * dr.dot(gradient, self.direction) / radius_in_value, 0)
        return dr.select(has_slope, height / radius_in_value, dr.inf), slope

    def _clip(self) -> tuple[Real, Real]:
        """Return the interval (start, end) of ray parameters on which the cones can touch the
        surface.

        The surface's extent is enlarged by a factor about a point m in it, so that it contains all
        points whose distance from the extent is at most the radius of the cone. (The code shrinks
        the ray instead, which is equivalent.) Proof: let a convex set C contain the ball of radius
        h about m = 0. Then it contains h u for every unit vector u. So (1 + a) C = C + a C contains
        C moved by any vector of length a h.
        """
        real = self.tracer.backend.Float
        start, end = real(0), real(dr.inf)
        if self.bounding_balls is not None and self.tracer.volume is not None:
            # Around `middle`, a ball of radius `depth` lies in the extent, and a ball of radius
            # `size` contains it.
            middle, depth, size = self.bounding_balls
            # The distance at which a cone can be last near the extent, with a margin for its radius
            # there.
            farthest = (safe_norm(middle - self.origin) + size) * (1 + 2 * self.radius)
            factor = 1 + self.radius * farthest / depth
            o = (self.origin - middle) / factor + middle
            start, end = self.tracer.volume.clip(o, self.direction, start, end)
            start, end = start * factor, end * factor
        # Outside of the region f must not be evaluated.
        if self.tracer.region is not None:
            start, end = self.tracer.region.clip(self.origin, self.direction, start, end)
        return real(start), real(end)


def _next_step(height: Real, slope: Real, second_derivative: Real, longest: Real) -> Real:
    """Return the length of the next step of a ray in the cover, at most `longest`. The step leads
    to the first of three predicted points: where the ray is lowest over the surface, where it is a
    radius behind the surface, or where it leaves the cover.

    height, slope, second_derivative: the height over the surface in radii of the cone, and its
        first and second derivatives along the ray.

    If the height falls, it reaches -1 after (height + 1)/|slope| at this slope, and is lowest after
    |slope|/second_derivative. If it rises by r = `rest` to the outside, this takes 2r/(slope +
    sqrt(slope^2 + 2 r second_derivative)). Steps lead a little beyond these points.
    """
    real = cast("Any", type(height))
    # Where the height falls: to a radius behind the surface, and to where the slope becomes 0.
    # (`_NEGLIGIBLE` avoids divisions by 0.)
    length_to_behind = (height + 1 + _AIM_MARGIN) / fmax(-slope, real(_NEGLIGIBLE))
    length_to_lowest = dr.select(
        second_derivative > _NEGLIGIBLE,
        (1 + _AIM_MARGIN) * -slope / fmax(second_derivative, real(_NEGLIGIBLE)),
        dr.inf,
    )
    # Where it rises: the rest of the height, and the slope at its end. If the rise slows down, the
    # slope counts as constant.
    rest = fmax(_END_HEIGHT + _AIM_MARGIN - height, real(0))
    end_slope = dr.sqrt(slope * slope + 2 * fmax(second_derivative, real(0)) * rest)
    length_to_outside = 2 * rest / fmax(slope + end_slope, real(_NEGLIGIBLE))
    return fmin(
        dr.select(slope < 0, fmin(length_to_behind, length_to_lowest), length_to_outside), longest
    )
