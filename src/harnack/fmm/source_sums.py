"""Sums over sources at a point x, and the bounds of f near x that follow from these sums. f is a
field's function. Its sources are of three kinds: edges; dipoles (small triangles); and far nodes of
a tree, where a far node stands for the many dipoles in it. `SourceSums` holds the sums. From them
it makes values with error bounds, or a `Sample`: value and gradient of f at x with "promises",
which are proved bounds of f near x.

Two symbols occur throughout: a is the area of a dipole, and rho is its distance from x.

Sources of another kind. A source counts as a dipole of area a if its k-th derivatives along lines
are at most (k+1)! a/rho^(k+2) for all k >= 2: the proof in `SourceSums.sample` uses nothing else of
a dipole, but that f is harmonic off the sources. For a mass m, with the potential m/rho, these
derivatives are at most k! m/rho^(k+1), so that a = m rho/3. Three things are derived for dipoles
alone, and have to be derived anew: `dipole_rounding`, which `SourceSums.add_far_node` uses as well;
the numbers `SLOPE_ROUNDINGS` and `SECOND_ROUNDINGS`, beyond which the rounding of a source's
gradient and second derivatives is added to `gradient_truncation` and `hessian_truncation`; and the
numbers A and K of a far node (`multipole.remainder_constants`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr

from harnack.backend.elementary import fmax, fmin
from harnack.enclosures import HarmonicBall, Lipschitz, TaylorRemainder
from harnack.enclosures.samples import Sample
from harnack.fmm.point_values import LoopRecord, PointValues, SymmetricMatrix

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3

TAYLOR_RADII = (0.2, 0.4, 0.6)
"""Radii of the balls about x on which second derivatives of f are bounded (`TaylorRemainder`), as
fractions of the distance to the nearest singular point. A smaller ball has a smaller bound."""
MAX_STEP_FRACTION = 0.65
"""The largest radius of such a ball, as a fraction of the distance to the dipoles of far nodes."""
# Bounds are enlarged, and distances reduced, by this fraction, for the rounding of sums.
SUM_MARGIN = 2e-5
# A singular point counts as near if its distance is at most this many roundings of a coordinate.
_NEAR_ROUNDINGS = 256.0
# The rounding of positions and of terms changes the gradient by at most the first number times s4
# times the rounding of a coordinate, and second derivatives by at most the second number times s5
# times that rounding. (s4 and s5 are sums over the sources: see `SourceSums`.)
SLOPE_ROUNDINGS, SECOND_ROUNDINGS = 16.0, 320.0


def max_step_fraction(coarse_ratio: float) -> float:
    """The longest step from x for which the bounds of `SourceSums.sample` are proved. The result is
    a fraction of the distance from x to the center of the nearest far node.

    coarse_ratio: a node is far if its center is farther from x than this many times its radius.
    """
    return MAX_STEP_FRACTION * (1 - 1 / coarse_ratio)


def singularity_fraction(coarse_ratio: float) -> float:
    """The distance at which a far node counts as a singular point, as a fraction of the distance
    from x to the center of the node. The largest of `TAYLOR_RADII` times it is `max_step_fraction`,
    the longest step of the proof. (It may itself be longer than the distance of the node's nearest
    dipole; the longest step is not.)

    coarse_ratio: a node is far if its center is farther from x than this many times its radius. It
        is at most 13: then the result is at most 1, which the proof in `SourceSums.sample` needs.
    """
    return max_step_fraction(coarse_ratio) / TAYLOR_RADII[-1]


def remainder_factor(q: float) -> float:
    """The function phi(q) = (3 - 2 q)/(1 - q)^2 for 0 <= q < 1. It is convex, and phi(0) = 3. It
    bounds the change of a dipole's value beyond its linear part. Let a be the area of the dipole
    and rho its distance from x. At the distance t < rho from x, Taylor's remainder is at most a t^2
    rho^-4 phi(t/rho)."""
    return (3 - 2 * q) / (1 - q) ** 2


def final_rounding(backend: Backend, size: float = 1.0) -> Real:
    """A bound of the rounding errors that arise after the last term was added to a sum: 16 machine
    epsilons times `size`. It is returned as a kernel parameter. (`SourceSums.add_term` counts the
    rounding errors before.)

    size: a bound of the absolute value of the numbers that are rounded.
    """
    return dr.opaque(backend.Float, backend.machine_epsilon * 16 * size)


def dipole_rounding(area: Real, inverse: Real, unit: Real) -> Real:
    """A bound of the rounding error of the value of one dipole at the distance rho from x.

    area: the area of the dipole.
    inverse: 1/rho.
    unit: a bound of the rounding error of a coordinate, at least the machine epsilon.

    The rounding of one coordinate changes the value by at most 2 unit area/rho^3. The vector from x
    to the dipole is a difference of two coordinates, so it has this error twice. The four rounded
    operations with which the value is computed change it by at most 4 epsilon area/rho^2, and
    epsilon is at most `unit`.
    """
    square = inverse * inverse
    return (unit * area) * dr.fma(4 * inverse, square, 4 * square)


@dataclass(frozen=True)
class SourceTerm:
    """The contribution of a single source (a dipole, an edge or a far node) to f and to its
    derivatives.

    value: its part of f; None for an edge, whose part of f (an angle) is added to the sum
        elsewhere.
    gradient: (3,) its part of the gradient; None if gradients were not requested.
    hessian: its part of the second derivatives; None if they were not requested.
    """

    value: Real | None
    gradient: Vec3 | None = None
    hessian: SymmetricMatrix | None = None


@dataclass(frozen=True)
class SourceSums(LoopRecord):
    """The sums over all sources (dipoles, edges and far nodes of a tree) at points x, one point in
    each lane: f, its derivatives, error bounds, and the numbers from which bounds of f near x
    follow. These numbers are the distance to the nearest singular point (a dipole or a point of an
    edge), and s4 and s5: the sums of a/rho^4 and a/rho^5 over all sources, with the area a of a
    source and its distance rho.

    total: the sum of the values as it was rounded. The property `value` adds `compensation` to it.
    gradient: (3,) of f; None if it was not requested.
    hessian: of f; None if it was not requested.
    truncation, gradient_truncation: bounds of the truncation errors of the value and of the
        gradient.
    hessian_truncation: a bound of the truncation error of the second derivative along any line;
        None without a Hessian.
    rounding: a bound of the rounding error of the value.
    singularity_distance: the distance from x to the nearest singular point, which is a dipole or a
        point of an edge; or `singularity_fraction` times the distance to the nearest far node's
        center, if that is smaller.
    s4, s5: the sums of a/rho^4 and of a/rho^5 over all sources. For a dipole at the distance rho, a
        is its area. For a far node, rho is the distance of its center, and a is A + K/rho^2 with
        the numbers A and K of `multipole.remainder_constants`. What edges add to them is derived in
        `LiftedEdge.bounds`.
    compensation: the sum of the rounding errors of the additions to `total`; see `add_term`.
    """

    total: Real
    gradient: Vec3
    hessian: SymmetricMatrix | None
    truncation: Real
    gradient_truncation: Real
    hessian_truncation: Real
    rounding: Real
    singularity_distance: Real
    s4: Real
    s5: Real
    compensation: Real

    @property
    def value(self) -> Real:
        """f at x: the plain sum plus the rounding errors of its additions."""
        return self.total + self.compensation

    @classmethod
    def zero(cls, backend: Backend, free_distance: Real, derivatives: int) -> SourceSums:
        """The sums before any source is added.

        free_distance: the initial `singularity_distance`, which stays if there are no sources.
        derivatives: 0 for values only, 1 for gradients too, 2 for Hessians too.
        """
        real, zero = backend.Float, backend.Float(0)
        gradient = backend.Array3f(0) if derivatives >= 1 else None
        hessian = SymmetricMatrix.zero(real) if derivatives == 2 else None
        hessian_truncation = None if hessian is None else zero
        # The further attributes in the order of the constructor; all sums are 0.
        bounds = zero, zero, hessian_truncation, zero, real(free_distance), zero, zero, zero
        return cls(zero, gradient, hessian, *bounds)

    def select(self, mask: Mask, other: SourceSums) -> SourceSums:
        """The sums `other` on the lanes on which the mask is true, and these sums on all other
        lanes. Neither of the two may have a Hessian."""
        pairs = zip(other.to_state(), self.to_state(), strict=True)
        # None stands for a sum that was not requested, in both.
        return SourceSums(*(None if b is None else dr.select(mask, a, b) for a, b in pairs))

    @property
    def derivatives(self) -> int:
        """The order up to which derivatives are summed: 0, 1 or 2."""
        return 0 if self.gradient is None else 1 if self.hessian is None else 2

    def gradient_error(self, unit: Real) -> Real:
        """A bound of the error of the gradient, by truncation and by the rounding of positions.

        unit: a bound of the rounding error of a coordinate.
        """
        return dr.fma(SLOPE_ROUNDINGS * unit, self.s4, self.gradient_truncation)

    def add_term(self, terms: SourceTerm, active: Mask) -> SourceSums:
        """These sums plus the contribution of one more source, on the active lanes. A derivative
        that is None in `terms` counts as 0. terms: what the source adds.

        Proof of the rounding error of the value. If the errors of n additions all have the same
        sign, they add up to n times one error; this happens where small terms are lost in a large
        sum. But the error of a single rounded sum s = fl(a + b) is a number of the same precision,
        and can be computed exactly (Knuth's TwoSum; Higham 2002, Section 4.3). With c = s - a it is
        (a - (s - c)) + (b - c). Its size is at most u |s|, where u is half the distance from 1 to
        the next number. These errors are added up in `compensation`. The error of that second sum
        is at most n u times the sum of the sizes of its terms, hence at most n u^2 times the sum of
        all |s|. For n <= 2^20 terms in single precision, n u is at most 1/16. `rounding` therefore
        grows by u |s|/8, twice that bound, which also covers its own rounding.
        """
        gradient, hessian = self.gradient, self.hessian
        if gradient is not None and terms.gradient is not None:
            gradient = gradient + dr.select(active, terms.gradient, 0)
        if hessian is not None and terms.hessian is not None:
            pairs = zip(hessian.components(), terms.hessian.components(), strict=True)
            hessian = SymmetricMatrix(*(old + dr.select(active, new, 0) for old, new in pairs))
        total, compensation, rounding = self.total, self.compensation, self.rounding
        if terms.value is not None:
            term = dr.select(active, terms.value, 0)
            total = self.total + term
            # In the docstring's words: self.total is a, term is b, total is s, added is c. The next
            # line adds the error of s.
            added = total - self.total
            compensation = compensation + ((self.total - (total - added)) + (term - added))
            # Dr.Jit's epsilon is u.
            rounding = dr.fma(float(dr.epsilon(total)) / 8, dr.abs(total), rounding)
        new = {"total": total, "compensation": compensation, "rounding": rounding}
        return dataclasses.replace(self, gradient=gradient, hessian=hessian, **new)

    def add_far_node(
        self,
        terms: SourceTerm,
        far: Mask,
        inverse: Real,
        size: Real,
        left_out: tuple[Real, Real, Real],
        free: Real,
        unit: Real,
    ) -> SourceSums:
        """These sums plus the contribution of a tree node, on the lanes where it is far.

        terms: the node's parts of f and of its derivatives.
        far: the lanes on which the node is far.
        inverse: 1 / the distance from x to the node's center; 0 on lanes where the node is not far.
        size: the node's number a, which is A + K/r^2 (`multipole.remainder_constants`, with r the
            distance of the center).
        left_out: bounds of the truncation errors that the node causes: of the value, of the
            gradient and of second derivatives; 0 on lanes where the node is not far.
        free: the distance at which the node counts as a singular point: `singularity_fraction`
            times that of its center.
        unit: a bound of the rounding error of a coordinate.
        """
        # With a = `size` and rho = 1/`inverse`: s4 grows by a/rho^4, s5 by a/rho^5.
        s4_term, second_truncation = size * dr.square(inverse * inverse), self.hessian_truncation
        second_truncation = None if second_truncation is None else second_truncation + left_out[2]
        sums = self.add_term(terms, far)
        return dataclasses.replace(
            sums,
            truncation=self.truncation + left_out[0],
            gradient_truncation=self.gradient_truncation + left_out[1],
            hessian_truncation=second_truncation,
            rounding=sums.rounding + dipole_rounding(size, inverse, unit),
            singularity_distance=dr.select(
                far, fmin(free, self.singularity_distance), self.singularity_distance
            ),
            s4=self.s4 + s4_term,
            s5=dr.fma(s4_term, inverse, self.s5),
        )

    def values(self, share: float, unit: Real, rounding: Real, outside: float = 0.0) -> PointValues:
        """The value of `share` times f at x, and those of its derivatives that were summed, with
        error bounds.

        share: the factor.
        unit: a bound of the rounding error of a coordinate, at least epsilon.
        rounding: a bound of the part of the value's rounding error that these sums do not count.
        outside: a number of further roundings of the gradient that are counted at points far from
            all sources. There, distances from sources are as long as coordinates, and also the
            rounding of powers of distances and of sums of moments matters.
        """
        # `rounding` is a bound in units of the result, so it is not multiplied.
        value, error = share * self.value, dr.fma(share, self.truncation + self.rounding, rounding)
        if self.gradient is None:
            return PointValues(value, error)
        roundings = SLOPE_ROUNDINGS * unit
        if outside:
            # `unit` is more than 2 epsilon only where coordinates are large, i.e. far from the
            # sources.
            roundings = roundings + outside * fmax(unit - 2 * float(dr.epsilon(self.value)), 0)
        gradient_error = share * dr.fma(roundings, self.s4, self.gradient_truncation)
        if self.hessian is None:
            return PointValues(value, error, share * self.gradient, None, gradient_error)
        hessian = SymmetricMatrix(*(share * part for part in self.hessian.components()))
        hessian_error = share * dr.fma(SECOND_ROUNDINGS * unit, self.s5, self.hessian_truncation)
        return PointValues(
            value, error, share * self.gradient, hessian, gradient_error, hessian_error
        )

    def sample(
        self,
        share: float,
        unit: Real,
        rounding: Real,
        normal: Vec3 | None = None,
        along: tuple[Lipschitz, ...] = (),
    ) -> Sample:
        """The sample of `share` times f at x: value and gradient with error bounds, and proved
        bounds of f near x (the promises).

        share: the factor.
        unit: a bound of the rounding error of a coordinate.
        rounding: a bound of the part of the value's rounding error that these sums do not count.
        normal: (3,) the unit normal to shade with; None for the direction of the gradient.
        along: Lipschitz constants of f on parts of a line through x, for a sample on a ray.

        At and near a singular point, where rounding leaves nothing of the gradient, the sample has
        the value 0, a very large error, and a very steep gradient: a level is then always close,
        and no step is proved.

        Proof of the promises. Consider a dipole of area a at the distance rho. The k-th derivative
        of its value along a line is at most (k+1)! a/rho^(k+2): it is a mixed derivative of a/rho,
        whose tensor is symmetric and takes its largest value on equal vectors. So at the distance t
        < rho from x, Taylor's remainder after the linear term is at most

            a ((rho-t)^-2 - rho^-2 - 2t rho^-3) = a t^2 rho^-4 phi(t/rho), phi(q) = (3-2q)/(1-q)^2.

        The remainder of a far node whose center is at the distance r is at most that of a dipole of
        area A + K/r^2 at its center, for t/r <= `max_step_fraction`
        (`multipole.remainder_constants`). phi is convex. So on [0, b] it lies below its chord 3 +
        rise q, with rise = (phi(b)-3)/b = (4-3b)/(1-b)^2. Now let R be b times
        `singularity_distance`, and g the gradient of f at x. For t = |y - x| <= R, t/rho <= b for
        all dipoles, and t/r <= b for all far nodes, because `singularity_fraction` is at most 1.
        Summed over all sources,

            |f(y) - f(x) - g.(y-x)| <= t^2 (3 s4 + rise R s5).

        This is the `TaylorRemainder` for each b in `TAYLOR_RADII`. On the ball of the largest
        radius R, f changes by at most |g| R plus this bound for t = R, which gives the range of the
        `HarmonicBall`. f is harmonic there: the dipoles of far nodes are farther away than 1 -
        1/coarse_ratio times the distance of the center, and `max_step_fraction` is less than that.
        """
        g = share * self.gradient
        slope_error = share * self.gradient_error(unit)
        # The distance to the nearest singular point, reduced for rounding.
        distance = self.singularity_distance * (1 - SUM_MARGIN) - 4 * unit
        # A TaylorRemainder bounds the second derivative, so its constant is twice that of t^2.
        scale, radii = (2 + 2 * SUM_MARGIN) * share, [(b, b * distance) for b in TAYLOR_RADII]
        taylor = [TaylorRemainder(scale * self.remainder(b, r), r) for b, r in radii]
        slope, largest = dr.norm(g) + slope_error, taylor[-1]
        r = largest.radius
        # By how much f changes at most on the largest ball: slope R + constant R^2/2.
        variation = (1 + SUM_MARGIN) * r * dr.fma(0.5 * r, largest.constant, slope)
        value = share * self.value
        ball = HarmonicBall(r, value - variation, value + variation)
        # At a singular point f has all values. There, and nearby where rounding leaves nothing of
        # the gradient, the sample gets a gradient so steep that every level is close to first
        # order, and an error as large as the distance to such a level.
        near, max_error = 16 * unit, share * 1.6e5 * math.pi
        is_regular = (
            (self.singularity_distance > near)
            & dr.isfinite(value)
            & dr.isfinite(dr.squared_norm(g))
        )
        is_unreliable = ~(slope_error <= dr.norm(g)) & (
            self.singularity_distance <= _NEAR_ROUNDINGS * unit
        )
        is_regular, near = is_regular & ~is_unreliable, fmax(self.singularity_distance, near)
        steep_gradient = type(g)(0, 0, max_error / near)
        error = dr.fma(share, self.truncation + self.rounding, rounding)
        along = tuple(promise.scaled(share) for promise in along)
        return Sample(
            dr.select(is_regular, value, 0),
            dr.select(is_regular, g, steep_gradient),
            tuple(taylor),
            dr.select(is_regular, error, max_error),
            dr.select(is_regular, slope_error, 0),
            normal,
            dr.select(is_regular, share * self.truncation, 0),
            (ball,),
            along,
        )

    def add_line_rates(
        self, v: Vec3, unit: Real, lengths: tuple[Real, ...], rates: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """Return, for each of several lengths, a rate K with |f(x + s v) - f(x)| <= K |s| for |s|
        up to that length. f is the sum over the sources of these sums and over some further edges.
        K is the sum of two rates: one that is computed here from these sums, and the given rate of
        those edges. K is infinite on lanes that are not active, and for lengths above the radius R
        of the proof.

        v: (3,) unit directions of the lines through x.
        unit: a bound of the rounding error of a coordinate of x.
        lengths: the lengths.
        rates: the rates of the edges, one for each length (`trail_sums.line_rates`).

        Proof. The sources of these sums change f by at most |s| |g . v| + s^2 (3 s4 + rise R s5)
        for |s| <= R, with the symbols and the proof of `sample`. |g . v| is raised by the
        truncation and rounding errors of the gradient g. Dividing by |s| gives a rate that grows
        with |s|.
        """
        slope = dr.abs(dr.dot(self.gradient, v)) + self.gradient_truncation
        slope = dr.fma(SLOPE_ROUNDINGS * unit, self.s4, slope)
        # R is this fraction of the distance to the nearest singular point, less rounding.
        fraction = TAYLOR_RADII[-1]
        radius = fraction * (self.singularity_distance * (1 - SUM_MARGIN) - 4 * unit)
        # Without sources s5 is 0 and R may be infinite; then R s5 would be NaN.
        remainder = self.remainder(fraction, dr.select(self.s5 > 0, radius, 0))
        pairs = zip(lengths, rates, strict=True)
        sums = (
            dr.select(active & (length <= radius), rate + dr.fma(length, remainder, slope), dr.inf)
            for length, rate in pairs
        )
        return tuple(sums)

    def remainder(self, b: float, r: Real) -> Real:
        """The number K such that f differs from its linear part by at most K t^2 at any distance t
        <= r from x: K = 3 s4 + rise r s5. Here rise is the slope of the chord over [0, b] of
        (3 - 2q)/(1 - q)^2 (`sample` has the proof).

        b: the largest ratio of t to the distance of a source from x.
        r: b times the distance to the nearest singular point, or less.
        """
        return dr.fma(_chord_slope(b) * r, self.s5, 3 * self.s4)  # `_chord_slope(b)`: rise


def _chord_slope(b: float) -> float:
    """The slope (phi(b) - 3)/b of the chord over [0, b] of the convex function phi(q) = (3 - 2q)/(1
    - q)^2. So phi(q) <= 3 + slope q for 0 <= q <= b."""
    return (4 - 3 * b) / (1 - b) ** 2
