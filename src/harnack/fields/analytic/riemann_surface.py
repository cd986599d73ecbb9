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

# Second derivatives along the ray are bounded on the whole length asked for, and on these fractions
# of the distance to the nearest singular point; the best of several sets by experiment.
_PARTS = (0.4, 0.8)
# Promises hold in disks whose radius is this fraction of that distance.
_DISK = 0.5
# The longest length of a path on which anything is proved.
_LONGEST = 1e6
# Bounds of second derivatives are multiplied by this, for the rounding of slopes.
_WIDENED = 1 + 1e-4


@dataclass(frozen=True)
class _BranchValue:
    """A branch at a point.

    phi: h - u.
    x, y: the gradient of phi in the plane, that of -u.
    sign_factor: the sign that it contributes to the product of all phi.
    """

    phi: Real
    x: Real
    y: Real
    sign_factor: Real

    @property
    def steepness(self) -> Real:
        """|grad phi|."""
        return dr.sqrt(dr.fma(self.x, self.x, dr.fma(self.y, self.y, 1)))

    def slope(self, direction: Vec3) -> Real:
        return dr.fma(self.x, direction.x, dr.fma(self.y, direction.y, direction.z))

    def coincides_with(self, other: _BranchValue) -> Mask:
        """Whether phi and its gradient equal those of the other branch, as for a branch and itself.
        On a line of symmetry two branches agree in all but y, and f has a crease."""
        return (self.phi == other.phi) & (self.x == other.x) & (self.y == other.y)


@dataclass(frozen=True)
class _PointBranches:
    """All branches at a point.

    z, h: the point: in the plane, and the height.
    nearest: the branch with the smallest |phi|.
    sign: f is sign times its phi.
    error: of all phi, by arithmetic.
    rounding: of the position of the point.
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
        return self.sign * self.nearest.phi


class RiemannSurface(Field):
    """The graph h = Im g(x + i y), or Re, of an analytic function with all its branches g_j.

    function: "log", "sqrt", "cbrt", "power" (z^exponent), "asin"; a mapping {a_i: alpha_i} for the
        product of (z - a_i)^alpha_i; or a function of a Dr.Jit complex number that returns all its
        branches, each as (g, g') or (g, g', g'') in Dr.Jit complex numbers.
    part: "imag" or "real": which part is the height h.
    exponent: of "power": a rational number such as Fraction(2, 3) or 2 / 3.
    argument: of "log", "sqrt", "cbrt" and "power": the mapping {a_i: n_i} of the product of
        (z - a_i)^n_i that it is a function of, by default z.
    singular_points: of a function of your own, the points where a branch is not analytic: complex
        numbers, or `BranchPoint`s, which tell how all branches meet there.
    second_bound: of a function of your own, a bound second_bound(z, r) of |g''|, of all branches,
        on the disk of radius r about z; asked for where no singular point lies in that.
    period: of a function of your own with one branch, by what its drawn part may be shifted.
    height: a factor of g.
    domain: the volume that it is drawn in; by default the ball of radius 1 about the origin, of
        radius 4 for "log" and 2 for "asin".

    With several branches f = s min_j |phi_j|, phi_j = h - Im g_j, s the sign of the product of all
    phi_j: it is continuous and single-valued, as the product is, and zero only on the surface. With
    one branch f = phi, for a logarithm up to its period. level=(-w, w) with side="between" makes the surface a wall
    whose points are at most w above or below it.

    Proof. Along a ray the set of branches is continued as long as no singular point is met: so
    branch cuts and the numbering of branches do not matter. `NearestBranchEnclosure` takes the
    minimum over all branches of the step in which it could be reached, from their slopes and a
    bound of |g''| on the segment of the plane below the ray, which all share
    (`Branches.second_derivative_bound`): |d^2 phi_j/ds^2| <= |g''| |w|^2, w the projection of the
    ray's direction to the plane, for h is linear. So the nearest branch may change between two
    samples: from each of them, ahead or back, all branches are proved to be out of reach. Near
    branch points with a power > 0 all branches are near one value, and for a ray that passes at
    another height `BranchPointEnclosure` proves the step.

    A point is a hit if f is within the tolerance times |grad f| of 0 and, near such a branch point,
    if the surface is not proved to be farther away: where the slope grows without bound, f/|grad f|
    is no distance. Near poles and logarithms every height is near the surface.

    Raises:
        TypeError, ValueError: settings that do not belong together, or that are no such function.
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
        made = copy.copy(self)
        made.branches = self.branches.prepare(backend)
        made._height = dr.opaque(backend.Float, self.height)
        if self._shift is not None and not self._is_single:
            made._shift = dr.opaque(backend.Float, self._shift)
        return made

    def extent(self, levels: tuple[float, ...]) -> Volume | None:
        """The domain, cut to the heights that the surface can have over it."""
        if self.domain is None or self._shift is not None:
            return self.domain
        most = self._highest()
        if not most < math.inf:
            return self.domain
        reach = most * (1 + 1e-5) + max(abs(level) for level in levels)
        lower, upper = self.domain.bounds()
        if reach >= min(-lower[2], upper[2]):
            return self.domain
        low, high = (np.nan_to_num(one, posinf=1e9, neginf=-1e9) for one in (lower, upper))
        slab = Box((low[0], low[1], -reach), (high[0], high[1], reach))
        return VolumeIntersection((self.domain, slab))

    def _highest(self) -> float:
        """A bound of |h| over the domain; inf where none is known."""
        assert self.domain is not None
        lower, upper = self.domain.bounds()
        corners = [complex(x, y) for x in (lower[0], upper[0]) for y in (lower[1], upper[1])]
        if not np.isfinite(corners).all():
            return math.inf
        middle = 0.5 * (corners[0] + corners[3])
        reach = max(abs(corner - middle) for corner in corners)
        return abs(self.height) * self.branches.max_abs(middle, reach)

    def evaluate(self, p: Vec3) -> Sample:
        place = self._place(p)
        sample = self._sample(place)
        reach = self.branches.clearance(place.z)
        radius = _DISK * fmin(reach, _LONGEST)
        bend = (
            self._height_factor
            * self.branches.second_derivative_bound(Disk(place.z, radius, place.rounding))
            * _WIDENED
        )
        steepest: Real = 0.0
        for sheet in place.branches:
            steepest = fmax(sheet.steepness, steepest)
        # The radius within which no other branch can become the nearest: |phi_j| - |phi_i| > 0.
        # Sheets that touch here have the same value and gradient, and stay within the same
        # parabola; but the nearest of two is not harmonic.
        same, touching = radius, 0 * radius
        for sheet in place.branches:
            lead = fmax(dr.abs(sheet.phi) - dr.abs(place.nearest.phi), 0)
            rate = sheet.steepness + place.nearest.steepness
            until = 2 * lead / (rate + dr.sqrt(rate * rate + 4 * bend * lead))
            touches = sheet.coincides_with(place.nearest)
            same = fmin(dr.select(touches, radius, until), same)
            touching += dr.select(touches, 1, 0)
        curved = TaylorRemainder(bend, same)
        most = (steepest + bend * radius) * (1 + 1e-5)
        range_ = (most * same + 0.5 * bend * same * same) * (1 + 1e-5)
        alone = dr.select(touching < 2, same, 0)
        ball = HarmonicBall(alone, sample.value - range_, sample.value + range_)
        return Sample(
            sample.value,
            sample.gradient,
            (curved, Lipschitz(most, radius)),
            sample.value_error,
            sample.gradient_error,
            alternative_promises=(ball,),
        )

    def sample_ray(self, path: Ray, t: Real, ahead: Real, back: Real) -> RaySample:
        """The ray sample with proofs from all branches, instead of from promises."""
        p, d = path.point(t), path.direction
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(p))
        place = self._place(p)
        sample = self._sample(place)
        slope = place.sign * place.nearest.slope(d)
        shadow = complex_of(d.x, d.y)
        speed = abs(shadow)
        longest = fmin(ahead, _LONGEST * (1 + max_norm(p)))
        reach = self.branches.clearance(place.z)
        lengths = [longest, *(fmin(longest, part * reach / speed) for part in _PARTS)]
        forwards = [self._enclosure(place, d, shadow, length) for length in lengths]
        if not self._is_single:
            forwards += self._cusp_enclosures(place, d, shadow)
        # A little longer than asked for, as steps are rounded down.
        back = fmin(back, _LONGEST) * (1 + 1e-5)
        backwards = (self._enclosure(place, -d, -shadow, back),)
        return RaySample(sample, tuple(forwards), backwards, slope)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """Rows of the Hessian, free of trace.

        Raises:
            NotImplementedError: the branches of your own come without second derivatives.
        """
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), self._rounding(p))
        branches = self.branches.evaluate(z)
        graphs = self._graphs(p, branches)
        xx, xy = 0 * p.x, 0 * p.x
        place = self._nearest_branch(z, p.z, graphs, 0.0, 0.0)
        for k, sheet in enumerate(graphs):
            second = branches[k % len(branches)].second
            if second is None:
                raise NotImplementedError(
                    "the branches of this Riemann surface come without second derivatives: return "
                    "(g, g', g'') for each"
                )
            one_xx, one_xy = derivatives(second, self.part)
            here = sheet.coincides_with(place.nearest)
            xx, xy = dr.select(here, one_xx, xx), dr.select(here, one_xy, xy)
        share = -place.sign * self._height
        xx, xy, zero = share * xx, share * xy, 0 * p.x
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
        return dr.abs(self._height)

    def _rounding(self, p: Vec3) -> Real:
        """A generous bound of the rounding of a point in the plane."""
        return 4 * backend_of(p).machine_epsilon * max_norm(p)

    def _graphs(self, p: Vec3, branches: tuple[Branch, ...]) -> list[_BranchValue]:
        """phi of all sheets; with a period and several branches, of the two sheets of each branch
        next to the point.

        Then the product is that of sin(pi phi/period), with phi not shifted: sin u - sin h for
        asin.
        """
        made: list[_BranchValue] = []
        others: list[_BranchValue] = []
        for one in branches:
            u = one.value.imag if self.part == "imag" else one.value.real
            x, y = derivatives(one.first, self.part)
            phi, x, y = p.z - self._height * u, -self._height * x, -self._height * y
            real = cast("Any", type(phi))
            side = dr.select(phi < 0, real(-1), 1)
            if self._shift is not None and not self._is_single:
                turns = dr.floor(phi / self._shift)
                side = dr.select(turns == 2 * dr.floor(0.5 * turns), real(1), -1)
                phi = phi - self._shift * dr.round(phi / self._shift)
                others.append(_BranchValue(phi - dr.mulsign(real(self._shift), phi), x, y, real(1)))
            made.append(_BranchValue(phi, x, y, side))
        return made + others

    def _place(self, p: Vec3) -> _PointBranches:
        rounding = self._rounding(p)
        z = self.branches.move_off_singularities(complex_of(p.x, p.y), rounding)
        branches = self.branches.evaluate(z)
        units = self._height_factor * self.branches.value_rounding(z, branches) + 4 * dr.abs(p.z)
        error = backend_of(p).machine_epsilon * units
        for point in self.branches.points_on(z):  # slopes do not bound the rounding of values there
            if point.power is not None:
                close = abs(z - point.at) <= 2 * rounding
                jump = (
                    2 * self._height_factor * point.constant * dr.power(3 * rounding, point.power)
                )
                error += dr.select(close, jump, 0)
        graphs = self._graphs(p, branches)
        for sheet in graphs:  # NaN would never be chosen as the nearest
            error = dr.select(dr.isnan(sheet.phi), dr.nan, error)
        return self._nearest_branch(z, p.z, graphs, error, rounding)

    def _nearest_branch(
        self, z: Complex, h: Real, graphs: list[_BranchValue], error: Real, rounding: Real
    ) -> _PointBranches:
        nearest, sign = graphs[0], type(graphs[0].phi)(1)
        if not self._is_single:
            for one in graphs[1:]:
                closer = dr.abs(one.phi) < dr.abs(nearest.phi)
                nearest = _BranchValue(
                    dr.select(closer, one.phi, nearest.phi),
                    dr.select(closer, one.x, nearest.x),
                    dr.select(closer, one.y, nearest.y),
                    nearest.sign_factor,
                )
            # f = s |phi|, as a multiple of phi.
            sign = dr.select(nearest.phi < 0, -sign, sign)
            for one in graphs:
                sign = sign * one.sign_factor
        return _PointBranches(z, h, tuple(graphs), nearest, sign, error, rounding)

    def _sample(self, place: _PointBranches) -> Sample:
        nearest, sign = place.nearest, place.sign
        vector = backend_of(nearest.phi).Array3f
        gradient = vector(sign * nearest.x, sign * nearest.y, sign)
        # No hit if the surface is proved to be farther away than f/|grad f|.
        norm, beyond = dr.norm(gradient), self._proved_distance(place)
        slower = dr.abs(nearest.phi) / beyond
        doubt = dr.select(beyond > 0, fmax(norm - slower, 0), 0)
        return Sample(place.value, gradient, (), place.error, doubt)

    # Near branch points.

    def _ends_of_branches(
        self, place: _PointBranches
    ) -> list[tuple[PreparedBranchPoint, Complex, Real]]:
        """Branch points with a power, z relative to each, and the height over their value."""
        made: list[tuple[PreparedBranchPoint, Complex, Real]] = []
        if self._is_single:
            return made
        for point in self.branches.points_on(place.z):
            if point.power is None:
                continue
            value = point.value.imag if self.part == "imag" else point.value.real
            y = place.h - self._height * value
            if self._shift is not None:
                y -= self._shift * dr.round(y / self._shift)
            made.append((point, place.z - point.at, y))
        return made

    def _cusp_enclosures(self, place: _PointBranches, d: Vec3, shadow: Complex) -> list[Enclosure]:
        """Enclosures near branch points where all branches meet."""
        made: list[Enclosure] = []
        speed = abs(shadow)
        for point, away, y in self._ends_of_branches(place):
            along = -(away.real * shadow.real + away.imag * shadow.imag) / speed
            along = dr.select(speed > 0, along, 0)
            across = dr.abs(away.real * shadow.imag - away.imag * shadow.real) / speed
            across = dr.select(speed > 0, across, abs(away)) + place.rounding
            fall = dr.abs(d.z)
            if self._shift is None:
                fall = fmax(-dr.mulsign(d.z, y), 0)
            room = fmax(dr.abs(y) - place.error, 0)
            inside = 0 * y + point.radius * (1 - 1e-6) - place.rounding
            cone = (point.power, self._height_factor * point.constant * (1 + 1e-5), inside)
            distance = dr.abs(place.nearest.phi)
            made.append(
                BranchPointEnclosure(
                    room, fall, along, across, speed, *cone, distance, place.value >= 0
                )
            )
        return made

    def _proved_distance(self, place: _PointBranches) -> Real:
        """A proved lower bound of the distance to the surface near a branch point; 0 if there is
        none.

        With y the height over the value there, a ball of radius r about p contains nothing of the
        surface if C (|z - a| + r)^alpha <= y - r: so if r <= m and that power is y - m, for any m.
        Two m are tried: y/2, and the one for which that power is y at r = m, which is nearly sharp
        where the surface is steep.
        """
        beyond = 0 * place.h
        for point, away, y in self._ends_of_branches(place):
            power, constant = point.power, self._height_factor * point.constant
            assert power is not None
            y, r = dr.abs(y), abs(away)
            for most in (0.5 * y, dr.power(y / constant, 1 / power) - r):
                radius = dr.power(fmax(y - most, 0) / constant, 1 / power) - r
                radius = fmin(fmin(radius, point.radius - r), most)
                beyond = fmax(radius, beyond)
        return beyond

    # Along a ray.

    def _enclosure(
        self, place: _PointBranches, d: Vec3, shadow: Complex, length: Real
    ) -> Enclosure:
        """The enclosure for a length along a ray with direction d; shadow: the projection of d to
        the plane."""
        stretch = PlaneSegment(place.z, shadow, length, place.rounding)
        bend = self._height_factor * self.branches.second_derivative_bound(stretch)
        speed = abs(shadow)
        # For the rounding of slopes, and of the position of the point.
        epsilon = backend_of(d).machine_epsilon
        moved = dr.select(speed > 0, bend * place.rounding, 0)
        bend = dr.select(speed > 0, bend * dr.square(speed) * _WIDENED, 0)

        def slopes(sheet: _BranchValue, sign: Real) -> SlopeRange:
            slope = sheet.slope(d)
            size = dr.abs(sheet.x * d.x) + dr.abs(sheet.y * d.y) + dr.abs(d.z)
            return SlopeRange.around(sign * slope, 16 * epsilon * size + moved * speed)

        if self._is_single:
            return ParabolaEnclosure(slopes(place.nearest, place.sign), -bend, bend, length)
        distance = dr.abs(place.nearest.phi)
        one = type(distance)(1)
        sheets = tuple(
            BranchSample(
                slopes(sheet, dr.mulsign(one, sheet.phi)),
                dr.abs(sheet.phi) - distance - self._extra_rounding(sheet, place),
            )
            for sheet in place.branches
        )
        nearest = BranchSample(
            slopes(place.nearest, dr.mulsign(one, place.nearest.phi)), 0 * distance
        )
        return NearestBranchEnclosure(sheets, nearest, distance, place.value >= 0, bend, length)

    @staticmethod
    def _extra_rounding(sheet: _BranchValue, place: _PointBranches) -> Real:
        """How much more the rounding of the point may change phi of a branch than of the
        nearest."""
        return fmax(sheet.steepness - place.nearest.steepness, 0) * place.rounding
