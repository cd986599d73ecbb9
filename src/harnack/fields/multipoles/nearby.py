"""What sums over a tree of dipoles tell about a field near a point: how far nodes bend, and how all
that was summed becomes a certificate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.fields.field import Curvature, HarmonicBall, LineLipschitz, Sample
from harnack.fields.multipoles.moments import KNOWN
from harnack.fields.multipoles.multipole import Level
from harnack.fields.multipoles.multipole_kernel import Terms
from harnack.fields.multipoles.truncation import sup_norm

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real, Vec3
    from harnack.fields.edges.edge_passing import Line
    from harnack.tree.hierarchy import FloatArray

# Parts of the free distance out to which curvatures are stated: the shorter, the smaller.
_REACHES = (0.2, 0.4, 0.6)
# The part of the way to the dipoles of far nodes out to which they are stated.
_WAY = 0.65
_ROUNDING = 2e-5
# Roundings of a coordinate within which a singular point is near.
_BESIDE = 256.0
# What rounding does to gradients and second derivatives: see `far_clusters.Errors`.
SLOPE_ROUNDINGS, SECOND_ROUNDINGS = 16.0, 320.0

Sums: TypeAlias = "tuple[Any, ...]"


def bend_columns(level: Level, rough: float) -> tuple[FloatArray, FloatArray]:
    """A and K (k,) of nodes that are seen from beyond r0 = `rough` times their radius R.

    From there on a step by t = q r, q <= Q = `longest_part(rough)`, moves a node's field off the
    linear by at most

        (A + K/r^2) t^2/r^4 Phi_1(q),   Phi_l(q) = ((1-q)^-(l+1) - 1 - (l+1)q)/q^2.

    The term l, a harmonic function of degree -(l+1), is at most B_l/r^(l+1), and its k-th
    derivative along a line (l+k)!/l! B_l/r^(l+1+k) (`truncation.truncation`, k times). So Taylor's
    remainder is at most B_l Phi_l(q) t^2/r^(l+3). In Phi_l/Phi_1 the ratio of coefficients,
    (l+k)!/(l! (k+1)!), grows with k, so that the quotient grows with q: W_l = Phi_l(Q)/Phi_1(Q)
    serves. With r >= r0: A = B_1 + W_2 B_2/r0 and K = sum_{l>=3} W_l B_l/r0^(l-3), for l >= 6 of
    B_l <= l R^(l-5) sum a |d|^4, with Phi_l(Q) < (1-Q)^-(l+1)/Q^2.
    """
    r0, q = np.maximum(rough * level.radius, 1e-50), longest_part(rough)
    ratio = [((1 - q) ** -(n + 1) - 1 - (n + 1) * q) / (q * q * _phi(q)) for n in range(KNOWN + 1)]
    terms = [ratio[n] * sup_norm(level.moments, n) for n in range(1, KNOWN + 1)]
    x = 1 / (rough * (1 - q))
    rest = x * (6 - 5 * x) / (1 - x) ** 2 / ((1 - q) ** 6 * q * q * _phi(q))
    wide = rest * level.fourth / r0**2 + sum(term / r0**n for n, term in enumerate(terms[2:]))
    return terms[0] + terms[1] / r0, wide


def longest_part(rough: float) -> float:
    """Of the distance of a far node's centre: the longest step that certificates cover."""
    return _WAY * (1 - 1 / rough)


def free_part(rough: float) -> float:
    """Of the distance of a far node's centre: what is counted as free of dipoles."""
    return longest_part(rough) / _REACHES[-1]


def _phi(q: float) -> float:
    """Phi_1 of `bend_columns`: convex, and 3 at 0."""
    return (3 - 2 * q) / (1 - q) ** 2


def with_far_node(
    sums: Sums, terms: Terms, far: Mask, inverse: Real, size: Real, left_out: tuple[Real, Real],
    free: Real, unit: Real,
) -> Sums:  # fmt: skip
    """The sums of `Nearby`, in its order, with a node's added where it is far, 1/inverse away.

    size: A + K/r^2 of `bend_columns`; left_out: of value and gradient; free: as far as the node
    counts as free of dipoles; unit: the rounding of a coordinate. Elsewhere terms and inverse are
    0.
    """
    value, g, truncation, slope_truncation, rounding, clear, s4, s5 = sums
    fourth = size * dr.square(inverse * inverse)
    return (
        value + dr.select(far, terms.value, 0),
        g + dr.select(far, terms.gradient, 0),
        truncation + left_out[0],
        slope_truncation + left_out[1],
        rounding + rounding_of_dipole(size, inverse, unit),
        dr.select(far, fmin(free, clear), clear),
        s4 + fourth,
        dr.fma(fourth, inverse, s5),
    )


def rounding_of_dipole(area: Real, inverse: Real, unit: Real) -> Real:
    """What rounding may do to the value of a dipole at distance rho = 1/inverse.

    unit: the rounding of a coordinate, at least epsilon: it moves the value by at most
    2 unit area/rho^3, twice in the difference of two coordinates; the four roundings of its term
    do so by 4 epsilon area/rho^2.
    """
    square = inverse * inverse
    return (unit * area) * dr.fma(4 * inverse, square, 4 * square)


@dataclass(frozen=True)
class Nearby:
    """What sums over a tree tell about f near x.

    truncation, slope_truncation: bounds of what was left out of value and gradient. rounding: of
    the value. clear: the distance of the nearest dipole, or `free_part` of that to the nearest far
    node's centre if that is less. s4, s5: sums of a/rho^4 and a/rho^5 over dipoles a at rho and,
    with A + K/r^2 for a, over far nodes at r.
    """

    backend: Backend
    value: Real
    gradient: Vec3
    truncation: Real
    slope_truncation: Real
    rounding: Real
    clear: Real
    s4: Real
    s5: Real

    def sample(
        self,
        share: float,
        unit: Real,
        rounding: Real,
        normal: Vec3 | None = None,
        along: tuple[LineLipschitz, ...] = (),
    ) -> Sample:
        """`share` times f, with what is known of it.

        unit: the rounding of a coordinate. rounding: what there is of it in the value besides.
        along: what is known of f along a line besides.

        Certificate. Along a line the k-th derivative of a dipole a at rho is at most
        (k+1)! a/rho^(k+2) (it is a mixed derivative of a/rho, whose tensor is symmetric and takes
        its largest value on equal vectors), so that Taylor's remainder after the linear term is at
        most a ((rho-t)^-2 - rho^-2 - 2t rho^-3) = a t^2 rho^-4 phi(t/rho), phi(q) =
        (3-2q)/(1-q)^2. That of a far node is at most that of a dipole of area A + K/r^2 in its
        centre, for t/r <= `longest_part` (`bend_columns`). phi is convex: on [0, b] it lies below
        3 + rise q, rise = (phi(b)-3)/b = (4-3b)/(1-b)^2. With t <= r = b clear,
        |f(y) - f(x) - g.(y-x)| <= t^2 (3 s4 + rise r s5).
        A ball of that radius bounds f by |g| r more, and holds harmonic f: dipoles of far nodes
        are farther away than 1 - 1/rough times the centre, and `longest_part` is less.
        """
        g = share * self.gradient
        slope_error = share * dr.fma(SLOPE_ROUNDINGS * unit, self.s4, self.slope_truncation)
        distance = self.clear * (1 - _ROUNDING) - 4 * unit
        bends = [self._bend(share, b, b * distance) for b in _REACHES]
        slope, widest = dr.norm(g) + slope_error, bends[-1]
        r = widest.radius
        variation = (1 + _ROUNDING) * r * dr.fma(0.5 * r, widest.constant, slope)
        value = share * self.value
        ball = HarmonicBall(r, value - variation, value + variation)
        # On a singular point itself all values meet: a gradient so steep that it is as near to any
        # level as can be, and an error that says how far away such a level is. So it is beside one,
        # where rounding leaves nothing of the gradient.
        reach, most = 16 * unit, share * 1.6e5 * math.pi
        apart = (self.clear > reach) & dr.isfinite(value) & dr.isfinite(dr.squared_norm(g))
        lost = ~(slope_error <= dr.norm(g)) & (self.clear <= _BESIDE * unit)
        apart, reach = apart & ~lost, fmax(self.clear, reach)
        steep = self.backend.Array3f(0, 0, most / reach)
        error = dr.fma(share, self.truncation + self.rounding, rounding)
        return Sample(
            dr.select(apart, value, 0),
            dr.select(apart, g, steep),
            (*bends, *(LineLipschitz(share * one.constant, one.radius) for one in along)),
            dr.select(apart, error, most),
            dr.select(apart, slope_error, 0),
            normal,
            dr.select(apart, share * self.truncation, 0),
            (ball,),
        )

    def with_rates(
        self, line: Line, lengths: tuple[Real, ...], rates: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """The rates K of `edge_passing` for some edges, with those of all that is summed up here.

        f moves by at most |s| |g . v| + s^2 (3 s4 + rise r s5) for |s| <= r (`sample`), if g is
        known up to its truncation and rounding. Infinite for lengths above r.
        """
        unit = line.slack
        slope = dr.abs(dr.dot(self.gradient, line.v)) + self.slope_truncation
        slope = dr.fma(SLOPE_ROUNDINGS * unit, self.s4, slope)
        b = _REACHES[-1]
        r = b * (self.clear * (1 - _ROUNDING) - 4 * unit)
        bend = dr.fma(dr.select(self.s5 > 0, r, 0) * _rise(b), self.s5, 3 * self.s4)
        pairs = zip(lengths, rates, strict=True)
        found = (
            dr.select(active & (length <= r), rate + dr.fma(length, bend, slope), dr.inf)
            for length, rate in pairs
        )
        return tuple(found)

    def _bend(self, share: float, b: float, r: Real) -> Curvature:
        """What is known out to r = b times the free distance."""
        third = 3 * self.s4
        return Curvature((2 + 2 * _ROUNDING) * share * dr.fma(r * _rise(b), self.s5, third), r)


def _rise(b: float) -> float:
    """The slope of the chord of phi over [0, b]: see `Nearby.sample`."""
    return (4 - 3 * b) / (1 - b) ** 2
