"""Riemann surfaces of functions of a complex variable, as graphs over the plane (paper, 4.6)."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin, max_norm
from harnack.backend.validation import as_finite
from harnack.enclosures import Enclosure, HarmonicBall, Lipschitz, SlopeRange, TaylorRemainder
from harnack.enclosures.extremum import BranchPointEnclosure, BranchSample, NearestBranchEnclosure
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.fields.analytic.branches import Branches, Disk, PlaneSegment, complex_of, derivatives
from harnack.fields.analytic.plane import make_branches
from harnack.fields.field import Field
from harnack.fields.samples import Ray, RaySample, Sample
from harnack.geometry.clip_volumes import Ball, Box, VolumeIntersection

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.analytic.branches import Branch, Complex, PreparedBranchPoint
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
    """One branch at a point p of space: phi = h - u, where h is the height of p and u that of the
    branch.

    phi: the value of phi.
    x, y: the derivatives of phi by x and y, which are those of -u. The derivative by z is 1.
    sign_factor: 1 or -1, the factor of this branch in the sign of the product of all phi.
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
        """The derivative of phi along a direction."""
        return dr.fma(self.x, direction.x, dr.fma(self.y, direction.y, direction.z))

    def coincides_with(self, other: _BranchValue) -> Mask:
        """Whether phi and its gradient equal phi and the gradient of the branch `other`. For a
        branch and itself they do.

        On a line of symmetry two branches agree in phi and in its derivative by x but not by y;
        they do not coincide, and f has a crease there.
        """
        return (self.phi == other.phi) & (self.x == other.x) & (self.y == other.y)


@dataclass(frozen=True)
class _PointBranches:
    """All branches at a point of space.

    z: the projection of the point to the complex plane, moved off singular points.
    h: the height of the point.
    branches: phi and its gradient for each branch.
    nearest: the branch with the smallest |phi|.
    sign: 1 or -1; f is this sign times phi of the nearest branch.
    error: a bound of the error of all phi by the arithmetic of their evaluation.
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
        """The value of f."""
        return self.sign * self.nearest.phi


class RiemannSurface(Field):
    """The graph h = Im g(x + i y), or Re, of an analytic function with all its branches g_j.

    function: "log", "sqrt", "cbrt", "power" (z^exponent), "asin"; a mapping {a_i: alpha_i} for the
        product of (z - a_i)^alpha_i; or a function of a Dr.Jit complex number that returns all its
        branches, each as (g, g') or (g, g', g'') in Dr.Jit complex numbers.
    part: "imag" or "real": the part of g that is the height h.
    exponent: for "power": a rational number such as Fraction(2, 3) or 2 / 3.
    argument: for "log", "sqrt", "cbrt" and "power": the mapping {a_i: n_i} of the product of
        (z - a_i)^n_i that is the argument of the function, by default z.
    singular_points: for a function of your own, the points where a branch is not analytic: complex
        numbers, or `BranchPoint`s, which describe how all branches meet there.
    second_bound: for a function of your own, a bound second_bound(z, r) of |g''|, of all branches,
        on the disk of radius r about z; used only if no singular point lies in the disk.
    period: for a function of your own with one branch, a number such that the drawn part plus any
        whole multiple of it also belongs to the surface.
    height: a factor of g other than 0, which scales the height of the surface.
    domain: the volume in which the surface is drawn; by default the ball of radius 1 about the
        origin, of radius 4 for "log" and 2 for "asin".

    With several branches f = s min_j |phi_j|, where phi_j = h - Im g_j at a point of height h, and
    s is the sign of the product of all phi_j. f is continuous and single-valued, as that product
    is, and zero only on the surface. With one branch f = phi; for a logarithm it is determined up
    to the period. level=(-w, w) with side="between" draws a solid: all points that are at most w
    above or below the surface.

    Proof. Along a ray the set of branches can be continued as long as no singular point is met. So
    branch cuts and the numbering of branches do not matter. For each branch
    `NearestBranchEnclosure` computes the length of the ray within which the surface of this branch
    cannot be met, and takes the minimum over all branches. It uses the slopes of the branches at
    the sample, and a bound of |g''| on the segment of the plane below the ray, which holds for all
    branches (`Branches.second_derivative_bound`): since h is linear along the ray,
    |d^2 phi_j/ds^2| <= |g''| |w|^2, where w is the projection of the ray's direction to the plane.
    The nearest branch may change between two samples, because the proof covers all branches.
    Near branch points with a power > 0 all branches are near one value; `BranchPointEnclosure`
    proves the step of a ray that passes such a point at another height.

    A point is a hit if |f| is at most the tolerance times |grad f| and, near such a branch point,
    the surface is not proved to be farther away than the tolerance: there the slope grows without
    bound, and |f|/|grad f| is no distance. Near poles and logarithms every height is near the
    surface.

    Raises:
        TypeError, ValueError: a parameter is given that does not belong to this function, or is
            missing; or the function is invalid.
    """

    is_global = True

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
        """Check the arguments, and make the branches of the function."""
        if part not in ("imag", "real"):
            raise ValueError(f'part must be "imag" or "real", not {part!r}')
        if as_finite(height, "height") == 0:
            raise ValueError("height must be a factor other than 0")
        self.part = part
        self.height = float(height)
        self.branches: Branches = make_branches(
            function,
            exponent=exponent,
            argument=argument,
            singular_points=singular_points,
            second_bound=second_bound,
            period=period,
        )
        radius = {"log": 4.0, "asin": 2.0}.get(function, 1.0) if isinstance(function, str) else 1.0
        self.domain = Ball(radius=radius) if domain is None else domain
        self._height: Any = self.height
        shift = self.branches.period(part == "imag")
        self._shift: Any = None if shift is None else abs(self.height) * shift
        self._is_single = self.branches.count == 1
        self.has_creases = not self._is_single
        if self._is_single:
            self.period = self._shift  # pyright: ignore[reportAttributeAccessIssue]

    def prepare(self, backend: Backend) -> RiemannSurface:
        field = copy.copy(self)
        field.branches = self.branches.prepare(backend)
        field._height = dr.opaque(backend.Float, self.height)
        if self._shift is not None and not self._is_single:
            field._shift = dr.opaque(backend.Float, self._shift)
        return field

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The part of the domain within the heights that the level sets can have over it."""
        if self.domain is None or self._shift is not None:
            return self.domain
        max_height = self._max_height()
        if not max_height < math.inf:
            return self.domain
        limit = max_height * (1 + 1e-5) + max(abs(level) for level in levels)
        lower, upper = self.domain.bounds()
        if limit >= min(-lower[2], upper[2]):
            return self.domain
        low, high = (np.nan_to_num(corner, posinf=1e9, neginf=-1e9) for corner in (lower, upper))
        slab = Box((low[0], low[1], -limit), (high[0], high[1], limit))
        return VolumeIntersection((self.domain, slab))

    def _max_height(self) -> float:
        """A bound of the height |h| of the surface over the domain; infinite if none is known."""
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        corners = [complex(x, y) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])]
        if not np.isfinite(corners).all():
            return math.inf
        middle = 0.5 * (corners[0] + corners[3])
        reach = max(abs(corner - middle) for corner in corners)
        return abs(self.height) * self.branches.max_abs(middle, reach)

    def evaluate(self, p: Vec3) -> Sample:
        """The sample at p, with promises on disks that contain no singular point.

        The bound of second derivatives holds within the radius in which no other branch can become
        the nearest, the Lipschitz constant on the whole disk. If a single branch is nearest, f is
        harmonic there.
        """
        local = self._branches_at(p)
        sample = self._sample(local)
        clearance = self.branches.clearance(local.z)
        radius = _DISK_FRACTION * fmin(clearance, _MAX_LENGTH)
        second = (
            self._height_factor
            * self.branches.second_derivative_bound(Disk(local.z, radius, local.rounding))
            * _BOUND_MARGIN
        )
        steepest: Real = 0.0
        for branch in local.branches:
            steepest = fmax(branch.steepness, steepest)
        # The radius within which no other branch can become the nearest: |phi_j| - |phi_i| > 0.
        # Branches that touch at p have the same value and gradient, and stay within the same
        # parabola; but the nearest of two branches is not harmonic.
        free_radius, touching = radius, 0 * radius
        for branch in local.branches:
            excess = fmax(dr.abs(branch.phi) - dr.abs(local.nearest.phi), 0)
            rate = branch.steepness + local.nearest.steepness
            change_radius = 2 * excess / (rate + dr.sqrt(rate * rate + 4 * second * excess))
            is_touching = branch.coincides_with(local.nearest)
            free_radius = fmin(dr.select(is_touching, radius, change_radius), free_radius)
            touching += dr.select(is_touching, 1, 0)
        remainder = TaylorRemainder(second, free_radius)
        max_slope = (steepest + second * radius) * (1 + 1e-5)
        change = (max_slope * free_radius + 0.5 * second * free_radius * free_radius) * (1 + 1e-5)
        ball_radius = dr.select(touching < 2, free_radius, 0)
        ball = HarmonicBall(ball_radius, sample.value - change, sample.value + change)
        return Sample(
            sample.value,
            sample.gradient,
            (remainder, Lipschitz(max_slope, radius)),
            sample.value_error,
            sample.gradient_error,
            alternative_promises=(ball,),
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The sample on a ray, with enclosures that are proved from all branches instead of from
        promises.

        If the ray does not use the sharpest proofs, the enclosures follow from promises.
        """
        p, d = path.point(t), path.direction
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        local = self._branches_at(p)
        sample = self._sample(local)
        slope = local.sign * local.nearest.slope(d)
        projection = complex_of(d.x, d.y)
        speed = abs(projection)
        longest = fmin(ahead, _MAX_LENGTH * (1 + max_norm(p)))
        clearance = self.branches.clearance(local.z)
        lengths = [longest, *(fmin(longest, share * clearance / speed) for share in _FRACTIONS)]
        forwards = [self._enclosure(local, d, projection, length) for length in lengths]
        if not self._is_single:
            forwards += self._cusp_enclosures(local, d, projection)
        # Slightly longer than the requested length, as steps are rounded down.
        back = fmin(back, _MAX_LENGTH) * (1 + 1e-5)
        backwards = (self._enclosure(local, -d, -projection, back),)
        return RaySample(sample, tuple(forwards), backwards, slope)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian; its trace is 0.

        Raises:
            NotImplementedError: the user's branches come without second derivatives.
        """
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), self._rounding(p))
        branches = self.branches.evaluate(z)
        graphs = self._graphs(p, branches)
        xx, xy = 0 * p.x, 0 * p.x
        local = self._nearest_branch(z, p.z, graphs, 0.0, 0.0)
        for k, graph in enumerate(graphs):
            second = branches[k % len(branches)].second
            if second is None:
                raise NotImplementedError(
                    "the branches of this Riemann surface come without second derivatives: return "
                    "(g, g', g'') for each"
                )
            branch_xx, branch_xy = derivatives(second, self.part)
            is_nearest = graph.coincides_with(local.nearest)
            xx, xy = dr.select(is_nearest, branch_xx, xx), dr.select(is_nearest, branch_xy, xy)
        scale = -local.sign * self._height
        xx, xy, zero = scale * xx, scale * xy, 0 * p.x
        vector = cast("Any", type(p))
        return vector(xx, xy, zero), vector(xy, -xx, zero), vector(zero, zero, zero)

    def describe(self) -> dict[str, Any]:
        return {
            "branches": self.branches.count,
            "period": self._shift,
            "singular points": [point.location for point in self.branches.branch_points],
        }

    # At points.

    @property
    def _height_factor(self) -> Real:
        """The absolute value of the factor of g."""
        return dr.abs(self._height)

    def _rounding(self, p: Vec3) -> Real:
        """A generous bound of the rounding error of the projection of p to the plane, as a
        distance."""
        return 4 * backend_of(p).machine_epsilon * max_norm(p)

    def _graphs(self, p: Vec3, branches: tuple[Branch, ...]) -> list[_BranchValue]:
        """phi, its gradient and its sign factor for each branch at p.

        branches: the branches of g at the projection of p.

        With a period and several branches, as for asin, each branch g gives the graphs of g plus
        all whole periods. For each branch the list then has the graph nearest to p (the first half
        of the list) and the next graph on the other side of p (the second half). In that case the
        sign factors are not those of the phi in the list, but those of sin(pi phi/period) with phi
        before the shift by whole periods: for asin their product has the sign of sin u - sin h. The
        graphs in the second half have factor 1.
        """
        values: list[_BranchValue] = []
        neighbors: list[_BranchValue] = []
        for branch in branches:
            u = branch.value.imag if self.part == "imag" else branch.value.real
            x, y = derivatives(branch.first, self.part)
            phi, x, y = p.z - self._height * u, -self._height * x, -self._height * y
            real = cast("Any", type(phi))
            sign_factor = dr.select(phi < 0, real(-1), 1)
            if self._shift is not None and not self._is_single:
                periods = dr.floor(phi / self._shift)
                sign_factor = dr.select(periods == 2 * dr.floor(0.5 * periods), real(1), -1)
                phi = phi - self._shift * dr.round(phi / self._shift)
                neighbors.append(
                    _BranchValue(phi - dr.mulsign(real(self._shift), phi), x, y, real(1))
                )
            values.append(_BranchValue(phi, x, y, sign_factor))
        return values + neighbors

    def _branches_at(self, p: Vec3) -> _PointBranches:
        """All branches at the point p, with the bounds of their errors."""
        rounding = self._rounding(p)
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), rounding)
        branches = self.branches.evaluate(z)
        units = self._height_factor * self.branches.value_rounding(z, branches) + 4 * dr.abs(p.z)
        error = backend_of(p).machine_epsilon * units
        for point in self.branches.points_on(z):  # slopes do not bound the rounding of values there
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
        """The branches at a point, with the nearest branch and the sign of f.

        z, h: the projection of the point to the plane, and its height.
        graphs: phi and its gradient for each branch at the point.
        error, rounding: bounds of the errors of phi and of z, which are stored in the result.
        """
        nearest, sign = graphs[0], type(graphs[0].phi)(1)
        if not self._is_single:
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
        """The sample of f at a point, without promises.

        Near a branch point its gradient error is so large that the point is no hit if the surface
        is proved to be farther away than |f|/|grad f|.
        """
        nearest, sign = local.nearest, local.sign
        vector = backend_of(nearest.phi).Array3f
        gradient = vector(sign * nearest.x, sign * nearest.y, sign)
        # No hit if the surface is proved to be farther away than f/|grad f|.
        norm, distance = dr.norm(gradient), self._proved_distance(local)
        slope = dr.abs(nearest.phi) / distance
        gradient_error = dr.select(distance > 0, fmax(norm - slope, 0), 0)
        return Sample(local.value, gradient, (), local.error, gradient_error)

    # Near branch points.

    def _bounded_branch_points(
        self, local: _PointBranches
    ) -> list[tuple[PreparedBranchPoint, Complex, Real]]:
        """The branch points with a bound |g - value| <= constant |z - location|^power; none for one
        branch.

        For each of them: the branch point, z minus its location, and the height of the point of
        space above the value of g at the branch point (by the nearest whole number of periods).
        """
        points: list[tuple[PreparedBranchPoint, Complex, Real]] = []
        if self._is_single:
            return points
        for point in self.branches.points_on(local.z):
            if point.power is None:
                continue
            value = point.value.imag if self.part == "imag" else point.value.real
            y = local.h - self._height * value
            if self._shift is not None:
                y -= self._shift * dr.round(y / self._shift)
            points.append((point, local.z - point.at, y))
        return points

    def _cusp_enclosures(
        self, local: _PointBranches, d: Vec3, projection: Complex
    ) -> list[Enclosure]:
        """Enclosures along a ray from branch points where all branches meet.

        local: all branches at the sample on the ray.
        d: the direction of the ray.
        projection: its projection to the complex plane.
        """
        enclosures: list[Enclosure] = []
        speed = abs(projection)
        for point, offset, y in self._bounded_branch_points(local):
            t_closest = -(offset.real * projection.real + offset.imag * projection.imag) / speed
            t_closest = dr.select(speed > 0, t_closest, 0)
            min_offset = (
                dr.abs(offset.real * projection.imag - offset.imag * projection.real) / speed
            )
            min_offset = dr.select(speed > 0, min_offset, abs(offset)) + local.rounding
            fall = dr.abs(d.z)
            if self._shift is None:
                fall = fmax(-dr.mulsign(d.z, y), 0)
            gap = fmax(dr.abs(y) - local.error, 0)
            inner_radius = 0 * y + point.radius * (1 - 1e-6) - local.rounding
            cone = (point.power, self._height_factor * point.constant * (1 + 1e-5), inner_radius)
            distance = dr.abs(local.nearest.phi)
            enclosures.append(
                BranchPointEnclosure(
                    gap, fall, t_closest, min_offset, speed, *cone, distance, local.value >= 0
                )
            )
        return enclosures

    def _proved_distance(self, local: _PointBranches) -> Real:
        """A proved lower bound of the distance to the surface near a branch point; 0 if there is no
        such point.

        Let a be the branch point, p the sample above z, y the absolute height of p above the value
        at a,  C and alpha the constant and the power of the bound at a. A ball of radius r about p
        contains no point of the surface if C (|z - a| + r)^alpha <= y - r. So for any height m this
        holds for each r with r <= m and C (|z - a| + r)^alpha <= y - m. The largest such r is
        computed for two m: for y/2, and for the m at which C (|z - a| + m)^alpha is y, which is
        nearly sharp where the surface is steep.
        """
        proved = 0 * local.h
        for point, offset, y in self._bounded_branch_points(local):
            power, constant = point.power, self._height_factor * point.constant
            assert power is not None
            y, norm = dr.abs(y), abs(offset)
            for m in (0.5 * y, dr.power(y / constant, 1 / power) - norm):
                radius = dr.power(fmax(y - m, 0) / constant, 1 / power) - norm
                radius = fmin(fmin(radius, point.radius - norm), m)
                proved = fmax(radius, proved)
        return proved

    # Along a ray.

    def _enclosure(
        self, local: _PointBranches, d: Vec3, projection: Complex, length: Real
    ) -> Enclosure:
        """The enclosure of f from a sample along a ray, from all branches.

        local: all branches at the sample.
        d: the direction of the ray.
        projection: its projection to the complex plane.
        length: the length of the ray on which the enclosure holds.
        """
        segment = PlaneSegment(local.z, projection, length, local.rounding)
        second = self._height_factor * self.branches.second_derivative_bound(segment)
        speed = abs(projection)
        # For the rounding of slopes, and of the position of the point.
        epsilon = backend_of(d).machine_epsilon
        slope_error = dr.select(speed > 0, second * local.rounding, 0)
        second = dr.select(speed > 0, second * dr.square(speed) * _BOUND_MARGIN, 0)

        def slope_range(branch: _BranchValue, sign: Real) -> SlopeRange:
            """An interval that contains the derivative of sign * phi along the ray, at the point of
            the sample. phi is the height of the point minus that of the branch; the derivative is
            computed with rounding."""
            slope = branch.slope(d)
            size = dr.abs(branch.x * d.x) + dr.abs(branch.y * d.y) + dr.abs(d.z)
            return SlopeRange.around(sign * slope, 16 * epsilon * size + slope_error * speed)

        if self._is_single:
            return ParabolaEnclosure(
                slope_range(local.nearest, local.sign), -second, second, length
            )
        distance = dr.abs(local.nearest.phi)
        unit = type(distance)(1)
        samples = tuple(
            BranchSample(
                slope_range(branch, dr.mulsign(unit, branch.phi)),
                dr.abs(branch.phi) - distance - self._extra_rounding(branch, local),
            )
            for branch in local.branches
        )
        nearest = BranchSample(
            slope_range(local.nearest, dr.mulsign(unit, local.nearest.phi)), 0 * distance
        )
        return NearestBranchEnclosure(samples, nearest, distance, local.value >= 0, second, length)

    @staticmethod
    def _extra_rounding(branch: _BranchValue, local: _PointBranches) -> Real:
        """By how much more phi of a branch may change by the rounding of z than phi of the nearest
        branch; at least 0. phi is the height of the point minus that of the branch."""
        return fmax(branch.steepness - local.nearest.steepness, 0) * local.rounding
