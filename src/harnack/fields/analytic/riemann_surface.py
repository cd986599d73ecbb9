"""Riemann surfaces of functions of a complex variable, as graphs over the plane (paper, 4.6). The
function has several branches g_j (its possible values near a point z). The surface over the plane z
= x + i y has the heights u_j = Im g_j(z), or Re g_j(z), times a factor. At a point p of space over
z, with the height h, phi_j = h - u_j is the height of p above branch j; the branch with the
smallest |phi_j| is called the nearest. The field is f = s |phi_j| of the nearest branch, with a
sign s of 1 or -1. A singular point is a z where a branch is not analytic; near some of them, the
branch points with a power, all branches are near one value. If the heights repeat with a period,
each branch stands for all its shifts by whole periods."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.validation import as_finite, check_no_derivatives
from harnack.enclosures import Enclosure, HarmonicBall, Lipschitz, SlopeRange, TaylorRemainder
from harnack.enclosures.extremum import BranchPointEnclosure, BranchSample, NearestBranchEnclosure
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import Ray, RaySample, Sample
from harnack.fields.analytic.branches import Branches, Disk, PlaneSegment, complex_of, derivatives
from harnack.fields.analytic.plane import copied_arguments, make_branches
from harnack.fields.attached_arrays import with_formula
from harnack.fields.attached_numbers import attached_vector
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.parameters import kept_arguments
from harnack.geometry.clip_volumes import Ball, Box, VolumeIntersection

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.analytic.branches import Branch, BranchEvaluator, Complex, DeviceBranchPoint
    from harnack.geometry import Volume

# Second derivatives along the ray are bounded on the whole requested length, and on lengths that
# cross these fractions of the distance to the nearest singular point. By experiment this is the
# best of several sets of fractions.
_FRACTIONS = (0.4, 0.8)
# Promises hold in disks whose radius is this fraction of that distance.
_DISK_FRACTION = 0.5
# The largest length of a ray, and the largest distance to a singular point, that proofs use.
_MAX_LENGTH = 1e6
# Bounds of second derivatives are multiplied by this factor, for the rounding of slopes.
_BOUND_MARGIN = 1 + 1e-4


@dataclass(frozen=True)
class _BranchValue:
    """One branch of a function at a point p of space: phi = h - u, where h is the height of p and u
    the height of this branch's surface over the same point of the plane. The gradient of phi is (x,
    y, 1): the attributes x and y are the derivatives of phi, that is, of -u.

    phi: the value of phi.
    x, y: the derivatives of phi by x and y, which are those of -u. The derivative by z is 1.
    sign_factor: 1 or -1; the field's sign is the product of these factors of all branches.
    """

    phi: Real
    x: Real
    y: Real
    sign_factor: Real

    @property
    def steepness(self) -> Real:
        """The length of the gradient of phi."""
        return dr.sqrt(dr.fma(self.x, self.x, dr.fma(self.y, self.y, 1)))

    def slope(self, direction: Vec3) -> Real:
        """The derivative of phi (the height of the point above the branch) along a direction."""
        return dr.fma(self.x, direction.x, dr.fma(self.y, direction.y, direction.z))

    def coincides_with(self, other: _BranchValue) -> Mask:
        """A mask of the lanes on which this branch touches the branch `other`: phi (the height of
        the point above the branch) and its gradient are the same. A branch coincides with itself.

        On a line of symmetry two branches agree in phi and in its derivative by x but not by y;
        they do not coincide, and f has a crease there.
        """
        # x and y are the derivatives of phi; its derivative by the height is 1.
        return (self.phi == other.phi) & (self.x == other.x) & (self.y == other.y)


@dataclass(frozen=True)
class _PointBranches:
    """All branches of a function at a point p of space. For each branch, phi is the height of p
    above the branch's surface.

    z: the projection of p to the complex plane, moved off singular points.
    h: the height of p.
    branches: phi and its gradient for each branch.
    nearest: the branch with the smallest |phi|.
    sign: 1 or -1; f is this sign times phi of the nearest branch.
    error: a bound of the rounding error of each phi.
    rounding: a bound of the rounding error of z, as a distance.
    """

    z: Complex
    h: Real
    branches: tuple[_BranchValue, ...]
    nearest: _BranchValue
    sign: Real
    error: Real
    rounding: Real

    @property
    def value(self) -> Real:
        """The value of the field f at the point."""
        return self.sign * self.nearest.phi


class RiemannSurface(Field):
    """The surface h = Im g(x + i y), or Re, over the plane, of an analytic function with all its
    branches g_j. At a point p of space with the height h, phi_j = h - Im g_j is the height of p
    above branch j. With several branches f = s min_j |phi_j|, where s is the sign of the product of
    all phi_j; with one branch f = phi.

    function: "log", "sqrt", "cbrt", "power" (z^exponent), "asin"; a mapping {a_i: alpha_i} for the
        product of (z - a_i)^alpha_i; or a function of a Dr.Jit complex number that returns all its
        branches, each as (g, g') or (g, g', g'') in Dr.Jit complex numbers.
    part: "imag" or "real": the part of g that is the height h.
    exponent: for "power": a rational number such as Fraction(2, 3) or 2 / 3.
    argument: for "log", "sqrt", "cbrt" and "power": the mapping {a_i: n_i} of the product of (z -
        a_i)^n_i that is the argument of the function, by default z.
    singular_points: for a function of your own, the points where a branch is not analytic: complex
        numbers, or `BranchPoint`s, which describe how all branches meet there.
    second_bound: for a function of your own, a bound second_bound(z, r) of |g''|, of all branches,
        on the disk of radius r about z; used only if no singular point lies in the disk.
    period: for a function of your own with one branch, a number such that the drawn part plus any
        whole multiple of it also belongs to the surface.
    height: a factor of g other than 0, which scales the height of the surface.
    domain: the volume in which the surface is drawn; by default the ball of radius 1 about the
        origin, of radius 4 for "log" and 2 for "asin".

    f is continuous and single-valued, as that product is, and zero only on the surface. With one
    branch it is, for a logarithm, determined up to the period. level=(-w, w) with side="between"
    draws a solid: all points that are at most w above or below the surface.

    Proof. Along a ray the set of branches can be continued as long as no singular point is met. So
    branch cuts and the numbering of branches do not matter. For each branch
    `NearestBranchEnclosure` computes the length of the ray within which the surface of this branch
    cannot be met, and takes the minimum over all branches. It uses the slopes of the branches at
    the sample, and a bound of |g''| on the segment of the plane below the ray, which holds for all
    branches (`BranchEvaluator.second_derivative_bound`): since h is linear along the ray,
    |d^2 phi_j/ds^2| <= |g''| |w|^2, where w is the projection of the ray's direction to the plane.
    The nearest branch may change between two samples, because the proof covers all branches. Near
    branch points with a power > 0 all branches are near one value; `BranchPointEnclosure` proves
    the step of a ray that passes such a point at another height.

    A point is a hit if |f| is at most the tolerance times |grad f| and, near such a branch point,
    the surface is not proved to be farther away than the tolerance: there the slope grows without
    bound, and |f|/|grad f| is no distance. Near poles and logarithms every height is near the
    surface.

    Raises:
        TypeError, ValueError: a parameter is given that does not belong to this function, or is
            missing; or the function is invalid.
    """

    traits = Traits(is_global=True, differentiable_arguments=("height",))

    def __init__(
        self,
        function: str | Mapping[complex, Any] | Callable[[Any], Any],
        part: str = "imag",
        *,
        exponent: Any = None,
        argument: Mapping[complex, int] | None = None,
        singular_points: Iterable[Any] | None = None,
        second_bound: Callable[[Any, Any], Any] | None = None,
        period: float | None = None,
        height: float = 1.0,
        domain: Volume | None = None,
    ) -> None:
        """Check the arguments, which the class describes, and make the branches of the function."""
        if part not in ("imag", "real"):
            raise ValueError(f'part must be "imag" or "real", not {part!r}')
        if as_finite(height, "height") == 0:
            raise ValueError("height must be a factor other than 0")
        self.part = part
        self.height = as_finite(height, "height")
        self._branch_arguments = copied_arguments(
            function=function,
            exponent=exponent,
            argument=argument,
            singular_points=singular_points,
            second_bound=second_bound,
            period=period,
        )
        self.branches: Branches = make_branches(**self._branch_arguments)
        # The radius of the default domain.
        radius = {"log": 4.0, "asin": 2.0}.get(function, 1.0) if isinstance(function, str) else 1.0
        self.domain = Ball(radius=radius) if domain is None else domain
        # The period is scaled like the heights. Only with one branch is f itself periodic.
        shift = self.branches.period(part == "imag")
        self._shift = None if shift is None else abs(self.height) * shift
        self._is_single = self.branches.count == 1
        self.traits = dataclasses.replace(self.traits, has_creases=not self._is_single)
        if self._shift is not None:
            # The heights of all sheets move, each by its number of periods.
            check_no_derivatives("a RiemannSurface with a period", height)
        if self._is_single:
            self.period = self._shift  # pyright: ignore[reportAttributeAccessIssue]

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name, those of the function as they were given."""
        return {**super().constructor_arguments(), **self._branch_arguments}

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        """The evaluator of f for any plan. Its numbers lie on the backend as data, not as literals:
        Dr.Jit then need not compile its code again for other numbers."""
        del plan
        branches = self.branches.on_backend(backend)
        height, shift = dr.opaque(backend.Float, self.height), self._shift
        # With a single branch the shift is the field's period, and f is computed without it.
        if shift is not None and not self._is_single:
            shift = dr.opaque(backend.Float, shift)
        return _RiemannSurfaceEvaluator(branches, self.part, height, shift, self._is_single)

    def with_attached_numbers(self, backend: Backend) -> RiemannSurface:
        """The copy whose formula has derivatives by the factor `height`.

        With the height h of a point, f = s (h - H u) with the factor H, whose value is H0, the
        nearest branch u and a sign s, which is the derivative of f by z. So for the field f0 with
        the factor H0, f = s h + (H/H0) (f0 - s h), and the derivatives of f by x and y are H/H0
        times those of f0.
        """
        evaluator = self.evaluator(backend)
        (height,) = attached_vector([kept_arguments(self)["height"]], [self.height], backend)

        def expression(p: Vec3) -> tuple[Real, Vec3]:
            value = Evaluator.differentiable_value(evaluator, p)
            gradient = Evaluator.differentiable_gradient(evaluator, p)
            if gradient is None:
                gradient = evaluator.evaluate(dr.detach(p)).gradient
                message = "the gradient of a RiemannSurface of branches without second derivatives"
                check_no_derivatives(message, p)
            ratio, upright = height / dr.detach(height), dr.detach(gradient.z) * p.z
            value = upright + ratio * (value - upright)
            return value, type(p)(ratio * gradient.x, ratio * gradient.y, gradient.z)

        return with_formula(self, expression)

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The part of the domain between the lowest and the highest height that the level sets can
        have over it; the whole domain if the heights are not bounded or exceed it; None if there is
        no domain.

        levels: the levels of f.
        """
        if self.domain is None or self._shift is not None:
            return self.domain
        max_height = self._max_height()
        if not max_height < math.inf:
            return self.domain
        # (1e-5 covers the rounding of the height.)
        max_level_height = max_height * (1 + 1e-5) + max(abs(level) for level in levels)
        lower, upper = self.domain.bounds()
        if max_level_height >= min(-lower[2], upper[2]):
            return self.domain
        # A box needs finite corners.
        low, high = (np.nan_to_num(corner, posinf=1e9, neginf=-1e9) for corner in (lower, upper))
        slab = Box((low[0], low[1], -max_level_height), (high[0], high[1], max_level_height))
        return VolumeIntersection((self.domain, slab))

    def _max_height(self) -> float:
        """An upper bound of the height |h| of the surface over the domain; infinite if none is
        known. It is a bound on a disk around the domain's projection to the plane."""
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        corners = [complex(x, y) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])]
        if not np.isfinite(corners).all():
            return math.inf
        # The first and the last corner are opposite.
        middle = 0.5 * (corners[0] + corners[3])
        reach = max(abs(corner - middle) for corner in corners)
        return abs(self.height) * self.branches.max_abs(middle, reach)

    def describe(self) -> dict[str, Any]:
        """The number of branches, the period and the singular points, as a dictionary for users."""
        return {
            "branches": self.branches.count,
            "period": self._shift,
            "singular points": [point.location for point in self.branches.branch_points],
        }


@dataclass(frozen=True, eq=False)
class _RiemannSurfaceEvaluator(Evaluator):
    """The evaluator of the field f of a `RiemannSurface`, which has the proofs, on a backend.

    branches: the analytic function g with all its branches.
    part: the part of g that is the height, "imag" or "real".
    height: the factor of the height, a number of the backend.
    shift: the period of the heights; None if they do not repeat.
    is_single: whether there is a single branch.
    """

    branches: BranchEvaluator
    part: str
    height: Real
    shift: Real | None
    is_single: bool

    @property
    def _height_factor(self) -> Real:
        """The absolute value of the factor `height`, by which the branches are multiplied."""
        return dr.abs(self.height)

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p, with three proved bounds of f near p, which use disks of the plane
        without singular points. They are a bound of second derivatives; a Lipschitz constant; and,
        as an alternative, a range of f on a ball in which f is harmonic.

        The bound of second derivatives holds within the radius in which no other branch can become
        the nearest, the Lipschitz constant on the whole disk. If two branches touch at p, f is not
        harmonic near p, and the ball has the radius 0.
        """
        at_p = self._branches_at(p)
        sample = self._sample(at_p)
        clearance = self.branches.clearance(at_p.z)
        radius = _DISK_FRACTION * fmin(clearance, _MAX_LENGTH)
        second_bound = (
            self._height_factor
            * self.branches.second_derivative_bound(Disk(at_p.z, radius, at_p.rounding))
            * _BOUND_MARGIN
        )
        # The largest slope of any branch at p.
        steepest: Real = 0.0
        for branch in at_p.branches:
            steepest = fmax(branch.steepness, steepest)
        # The radius within which no other branch can become the nearest: |phi_j| - |phi_i| > 0.
        # Branches that touch at p have the same value and gradient, and stay within the same
        # parabola; but the nearest of two branches is not harmonic.
        free_radius, touching_count = radius, 0 * radius
        for branch in at_p.branches:
            excess = fmax(dr.abs(branch.phi) - dr.abs(at_p.nearest.phi), 0)
            slope_sum = branch.steepness + at_p.nearest.steepness
            # The positive root r of slope_sum r + second_bound r^2 = excess: up to there the branch
            # is farther away than the nearest one. This form of it does not cancel.
            change_radius = (
                2
                * excess
                / (slope_sum + dr.sqrt(slope_sum * slope_sum + 4 * second_bound * excess))
            )
            is_touching = branch.coincides_with(at_p.nearest)
            free_radius = fmin(dr.select(is_touching, radius, change_radius), free_radius)
            touching_count += dr.select(is_touching, 1, 0)
        remainder = TaylorRemainder(second_bound, free_radius)
        # By Taylor's formula; the factors 1 + 1e-5 cover rounding.
        max_slope = (steepest + second_bound * radius) * (1 + 1e-5)
        max_change = (max_slope * free_radius + 0.5 * second_bound * free_radius * free_radius) * (
            1 + 1e-5
        )
        # The nearest branch coincides with itself, so a count of 1 means that it is alone.
        ball_radius = dr.select(touching_count < 2, free_radius, 0)
        ball = HarmonicBall(ball_radius, sample.value - max_change, sample.value + max_change)
        return Sample(
            sample.value,
            sample.gradient,
            (remainder, Lipschitz(max_slope, radius)),
            sample.value_error,
            sample.gradient_error,
            alternative_promises=(ball,),
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample at the position t of a ray, with enclosures (proved bounds of the change of f
        along the ray) in front of the point and behind it. They follow from bounds of all branches
        on the segment of the plane below the ray.

        path: the ray.
        t: a length along it.
        ahead, back: the lengths in front of and behind the point on which enclosures are wanted.

        If the ray's options exclude the sharpest proofs (`PiecewiseTaylorEnclosure`), the
        enclosures follow from the sample of `evaluate` instead.
        """
        p, d = path.point(t), path.direction
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        at_point = self._branches_at(p)
        sample = self._sample(at_point)
        slope = at_point.sign * at_point.nearest.slope(d)
        projection = complex_of(d.x, d.y)
        speed = abs(projection)
        longest = fmin(ahead, _MAX_LENGTH * (1 + max_norm(p)))
        clearance = self.branches.clearance(at_point.z)
        # A shorter segment that stays away from singular points has smaller second derivatives, so
        # its proof may reach farther.
        lengths = [longest, *(fmin(longest, share * clearance / speed) for share in _FRACTIONS)]
        forwards = [self._enclosure(at_point, d, projection, length) for length in lengths]
        if not self.is_single:
            forwards += self._cusp_enclosures(at_point, d, projection)
        # Slightly longer than the requested length, as steps are rounded down.
        back = fmin(back, _MAX_LENGTH) * (1 + 1e-5)
        backwards = (self._enclosure(at_point, -d, -projection, back),)
        return RaySample(sample, tuple(forwards), backwards, slope)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of f at p, which is that of the nearest branch. f is
        harmonic, so its trace is 0; and it is linear in z, so all derivatives by z are 0.

        Raises:
            NotImplementedError: the user's branches come without second derivatives.
        """
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), self._rounding(p))
        branches = self.branches.evaluate(z)
        graphs = self._graphs(p, branches)
        u_xx, u_xy = 0 * p.x, 0 * p.x
        at_p = self._nearest_branch(z, p.z, graphs, 0.0, 0.0)  # the errors are not used here
        for k, graph in enumerate(graphs):
            # With a period each branch gives two graphs, the second half of the list.
            second = branches[k % len(branches)].second
            if second is None:
                raise NotImplementedError(
                    "the branches of this Riemann surface come without second derivatives: return "
                    "(g, g', g'') for each"
                )
            branch_xx, branch_xy = derivatives(second, self.part)
            is_nearest = graph.coincides_with(at_p.nearest)
            u_xx, u_xy = (
                dr.select(is_nearest, branch_xx, u_xx),
                dr.select(is_nearest, branch_xy, u_xy),
            )
        # f is the sign times (h - height u), so u counts with a minus.
        scale = -at_p.sign * self.height
        u_xx, u_xy, zero = scale * u_xx, scale * u_xy, 0 * p.x
        vector = cast("Any", type(p))
        return vector(u_xx, u_xy, zero), vector(u_xy, -u_xx, zero), vector(zero, zero, zero)

    # At points.

    def _rounding(self, p: Vec3) -> Real:
        """A generous bound of the rounding error of the projection of p to the plane, as a distance
        in the plane."""
        return 4 * backend_of(p).machine_epsilon * max_norm(p)

    def _graphs(self, p: Vec3, branches: tuple[Branch, ...]) -> list[_BranchValue]:
        """For each branch the height phi of p above the branch's surface, with its gradient and its
        factor of the field's sign. The surface over z has the height u.

        branches: the branches of g at the projection of p.

        If the heights repeat with a period and there are several branches, as for asin, each branch
        stands for all surfaces at the heights u plus whole multiples of the period. The list has
        two of them for each branch: in its first half the surface nearest to p, in its second half
        the next one on the other side of p. The field's sign is then the product of the signs of
        sin(pi phi/period), one for each branch, with phi before any shift (for asin it is the sign
        of sin u - sin h). So the factors are those signs in the first half, and 1 in the second
        half.
        """
        nearest_graphs: list[_BranchValue] = []
        next_graphs: list[_BranchValue] = []
        for branch in branches:
            u = branch.value.imag if self.part == "imag" else branch.value.real
            slope_x, slope_y = derivatives(branch.first, self.part)
            phi, slope_x, slope_y = (
                p.z - self.height * u,
                -self.height * slope_x,
                -self.height * slope_y,
            )
            real = cast("Any", type(phi))
            sign_factor = dr.select(phi < 0, real(-1), 1)
            if self.shift is not None and not self.is_single:
                periods = dr.floor(phi / self.shift)
                # The sign of sin(pi phi/period) is 1 if the number of whole periods is even.
                sign_factor = dr.select(periods == 2 * dr.floor(0.5 * periods), real(1), -1)
                phi = phi - self.shift * dr.round(phi / self.shift)
                next_graphs.append(
                    # The graph on the other side of p: one period away, against the sign of phi.
                    _BranchValue(phi - dr.mulsign(real(self.shift), phi), slope_x, slope_y, real(1))
                )
            nearest_graphs.append(_BranchValue(phi, slope_x, slope_y, sign_factor))
        return nearest_graphs + next_graphs

    def _branches_at(self, p: Vec3) -> _PointBranches:
        """All branches at the point p, with bounds of their rounding errors."""
        rounding = self._rounding(p)
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), rounding)
        branches = self.branches.evaluate(z)
        # The errors of u and of the height of p.
        error_units = self._height_factor * self.branches.value_rounding(z, branches) + 4 * dr.abs(
            p.z
        )
        error = backend_of(p).machine_epsilon * error_units
        # Near a branch point, slopes do not bound the rounding of values. If z is within 2
        # roundings of the point, the exact z is within 3, and both values are within the point's
        # bound of their common value: the error is at most twice that bound.
        for point in self.branches.points:
            if point.power is not None:
                is_close = abs(z - point.at) <= 2 * rounding
                jump = (
                    2 * self._height_factor * point.constant * dr.power(3 * rounding, point.power)
                )
                error += dr.select(is_close, jump, 0)
        graphs = self._graphs(p, branches)
        for graph in graphs:  # NaN would never be selected as the nearest
            error = dr.select(dr.isnan(graph.phi), dr.nan, error)
        return self._nearest_branch(z, p.z, graphs, error, rounding)

    def _nearest_branch(
        self, z: Complex, h: Real, graphs: list[_BranchValue], error: Real, rounding: Real
    ) -> _PointBranches:
        """All branches at a point, with the nearest branch (the smallest |phi|) and the sign of f
        determined.

        z, h: the projection of the point to the plane, and its height.
        graphs: phi (the height of the point above the branch) and its gradient for each branch.
        error, rounding: bounds of the errors of phi and of z, which are only stored in the result.
        """
        nearest, sign = graphs[0], type(graphs[0].phi)(1)
        if not self.is_single:
            for graph in graphs[1:]:
                is_closer = dr.abs(graph.phi) < dr.abs(nearest.phi)
                nearest = _BranchValue(
                    dr.select(is_closer, graph.phi, nearest.phi),
                    dr.select(is_closer, graph.x, nearest.x),
                    dr.select(is_closer, graph.y, nearest.y),
                    nearest.sign_factor,
                )
            # f = s |phi|, as a multiple of phi.
            sign = dr.select(nearest.phi < 0, -sign, sign)
            for graph in graphs:
                sign = sign * graph.sign_factor
        return _PointBranches(z, h, tuple(graphs), nearest, sign, error, rounding)

    def _sample(self, local: _PointBranches) -> Sample:
        """The sample of f at a point, without bounds of f near it.

        local: all branches at the point.

        The gradient error is 0 except near a branch point, where all branches meet: there it is so
        large that the tracer does not count the point as a hit if the surface is proved to be
        farther away than |f|/|grad f|.
        """
        nearest, sign = local.nearest, local.sign
        vector = backend_of(nearest.phi).Array3f
        # The gradient of phi = h - u is (x, y, 1), where x and y are the derivatives of -u. f is
        # sign phi.
        gradient = vector(sign * nearest.x, sign * nearest.y, sign)
        # No hit if the surface is proved to be farther away than f/|grad f|.
        norm, distance = dr.norm(gradient), self._proved_distance(local)
        # With d the proved distance, |gradient| minus the gradient error is |f|/d, so that the
        # distance which the tracer takes for the surface's is d.
        slope = dr.abs(nearest.phi) / distance
        gradient_error = dr.select(distance > 0, fmax(norm - slope, 0), 0)
        return Sample(local.value, gradient, (), local.error, gradient_error)

    # Near branch points.

    def _bounded_branch_points(
        self, local: _PointBranches
    ) -> list[tuple[DeviceBranchPoint, Complex, Real]]:
        """The branch points near which all branches are near one value: those with a bound |g -
        value| <= constant |z - location|^power. An empty list if the function has only one branch.

        local: all branches at a point p of space, with the projection z of p to the plane.

        The result has three members for each branch point: the branch point itself; z minus its
        location; and the height of p above the height that belongs to `value`. (If heights repeat
        with a period, it is the height above the nearest of all shifts of that one.)
        """
        points: list[tuple[DeviceBranchPoint, Complex, Real]] = []
        if self.is_single:
            return points
        for point in self.branches.points:
            if point.power is None:
                continue
            value = point.value.imag if self.part == "imag" else point.value.real
            height = local.h - self.height * value
            if self.shift is not None:
                height -= self.shift * dr.round(height / self.shift)
            points.append((point, local.z - point.at, height))
        return points

    def _cusp_enclosures(
        self, local: _PointBranches, d: Vec3, projection: Complex
    ) -> list[Enclosure]:
        """Enclosures: proofs of lengths of a ray on which f takes none of the levels (the values
        that rays look for). There is one for each branch point where all branches meet. Near it the
        branches are near one value; the proof holds if the ray passes it at another height.

        local: all branches at the sample on the ray.
        d: the direction of the ray.
        projection: the projection of d to the complex plane.
        """
        enclosures: list[Enclosure] = []
        speed = abs(projection)
        for point, offset, height in self._bounded_branch_points(local):
            # The position and the distance at which the ray's projection passes the branch point
            # nearest.
            closest_position = (
                -(offset.real * projection.real + offset.imag * projection.imag) / speed
            )
            closest_position = dr.select(speed > 0, closest_position, 0)
            min_distance = (
                dr.abs(offset.real * projection.imag - offset.imag * projection.real) / speed
            )
            min_distance = dr.select(speed > 0, min_distance, abs(offset)) + local.rounding
            # How fast the ray's height approaches the common value. With a period there is one
            # above and one below.
            approach_rate = dr.abs(d.z)
            if self.shift is None:
                approach_rate = fmax(-dr.mulsign(d.z, height), 0)
            gap = fmax(dr.abs(height) - local.error, 0)
            # (1e-6 and 1e-5 cover rounding.)
            inner_radius = 0 * height + point.radius * (1 - 1e-6) - local.rounding
            # The bound of the heights near the branch point: its power, its constant, and the
            # radius within which it holds.
            bound = (point.power, self._height_factor * point.constant * (1 + 1e-5), inner_radius)
            distance = dr.abs(local.nearest.phi)
            enclosures.append(
                BranchPointEnclosure(
                    gap,
                    approach_rate,
                    closest_position,
                    min_distance,
                    speed,
                    *bound,
                    distance,
                    local.value >= 0,
                )
            )
        return enclosures

    def _proved_distance(self, local: _PointBranches) -> Real:
        """A proved lower bound of the distance from a point p of space to the surface, near a
        branch point where all branches meet; 0 if there is no such point.

        local: all branches at p.

        Proof. Let a be the branch point, z the projection of p, y the absolute height of p above
        the common value at a, and C and alpha the constant and the power of the bound at a. A ball
        of radius r about p contains no point of the surface if C (|z - a| + r)^alpha <= y - r. So
        for any height m this holds for each r with r <= m and C (|z - a| + r)^alpha <= y - m. The
        largest such r is computed for two m: for y/2, and for the m at which C (|z - a| + m)^alpha
        is y, which is nearly sharp where the surface is steep.
        """
        proved = 0 * local.h
        for point, offset, y in self._bounded_branch_points(local):
            power, constant = point.power, self._height_factor * point.constant
            assert power is not None
            y, norm = dr.abs(y), abs(offset)
            for m in (0.5 * y, dr.power(y / constant, 1 / power) - norm):
                radius = dr.power(fmax(y - m, 0) / constant, 1 / power) - norm
                # The bound at a holds up to the distance `point.radius` from a.
                radius = fmin(fmin(radius, point.radius - norm), m)
                proved = fmax(radius, proved)
        return proved

    # Along a ray.

    def _enclosure(
        self, local: _PointBranches, d: Vec3, projection: Complex, length: Real
    ) -> Enclosure:
        """An enclosure of f along a ray: a proof how far the ray can go before f takes a level, a
        value that rays look for. It follows from a sample on the ray and from bounds of all
        branches.

        local: all branches at the sample.
        d: the direction of the ray.
        projection: the projection of d to the complex plane.
        length: the length of the ray on which the proof holds.
        """
        segment = PlaneSegment(local.z, projection, length, local.rounding)
        second_bound = self._height_factor * self.branches.second_derivative_bound(segment)
        speed = abs(projection)
        # For the rounding of slopes, and of the position of the point.
        epsilon = backend_of(d).machine_epsilon
        slope_error = dr.select(speed > 0, second_bound * local.rounding, 0)
        # By the length along the ray, not along the plane. If the ray is vertical, f is linear on
        # it.
        second_bound = dr.select(speed > 0, second_bound * dr.square(speed) * _BOUND_MARGIN, 0)

        def slope_range(branch: _BranchValue, sign: Real) -> SlopeRange:
            """An interval that contains the derivative of sign * phi along the ray at the sample,
            where phi is the height of the point above `branch`. It includes the rounding of the
            derivative."""
            slope = branch.slope(d)
            # The gradient of phi is (x, y, 1).
            size = dr.abs(branch.x * d.x) + dr.abs(branch.y * d.y) + dr.abs(d.z)
            return SlopeRange.around(sign * slope, 16 * epsilon * size + slope_error * speed)

        # A single branch: f = phi has this slope, and second derivatives up to the bound.
        if self.is_single:
            return ParabolaEnclosure(
                slope_range(local.nearest, local.sign), -second_bound, second_bound, length
            )
        distance = dr.abs(local.nearest.phi)
        one = type(distance)(1)
        # For each branch: the range of the slope of |phi|, and by how much |phi| is larger than
        # that of the nearest branch, with rounding subtracted.
        samples = tuple(
            BranchSample(
                slope_range(branch, dr.mulsign(one, branch.phi)),
                dr.abs(branch.phi) - distance - self._extra_rounding(branch, local),
            )
            for branch in local.branches
        )
        nearest = BranchSample(
            slope_range(local.nearest, dr.mulsign(one, local.nearest.phi)), 0 * distance
        )
        return NearestBranchEnclosure(
            samples, nearest, distance, local.value >= 0, second_bound, length
        )

    @staticmethod
    def _extra_rounding(branch: _BranchValue, local: _PointBranches) -> Real:
        """By how much more the rounding of z may change phi of `branch` than phi of the nearest
        branch; at least 0. phi is the height of the point above the branch.

        local: all branches at the point, with the projection z of the point to the plane.
        """
        return fmax(branch.steepness - local.nearest.steepness, 0) * local.rounding
