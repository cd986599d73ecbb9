"""Circles: the solid angle of a circle at a point, and sums over many circles with integrals that
bound them.

- `UnitCircle`: the formulas, by complete elliptic integrals.
- `CircleSet`: circles on a backend, and the sums over them.

Value, gradient and Hessian of a circle are one expression: Bulirsch's loop for complete elliptic
integrals, unrolled. The forms of the formulas are chosen so that nothing cancels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.fields.batched_fields import SymmetricMatrix

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.fields.solid_angles.trail_sums import RayLine
    from harnack.geometry.curves import Circle

__all__ = ["CircleSet", "CircleSums", "UnitCircle"]

_AGM_ROUNDS = {"single": 6, "double": 8}


@dataclass(frozen=True)
class UnitCircle:
    """The solid angle Omega of the unit circle at a point, and its derivatives.

    r, z: the point: its distance from the axis, and its height above the plane.
    angle: Omega in (-2 pi, 2 pi).
    nearest, farthest: Rm and Rp.
    share: q, with q r = 1 - kc.
    radial: J/q^2.
    axial: the gradient along the axis.
    third: I3.

    The circle has radius 1 and lies in the plane z = 0, run counter-clockwise as seen from above.
    Rm^2 = (1-r)^2 + z^2 and Rp^2 = (1+r)^2 + z^2 are the squared distances of the point to the
    nearest and the farthest point of the circle, kc = Rm/Rp is the complementary modulus of all
    integrals, and A = 1 + r^2 + z^2.

    Value. Omega = -sgn(z) W, W = 2 pi [r < 1] - 4|z| cel/((1+r) Rp), where cel = integral over
    [0, pi/2] of (cos^2 + gamma sin^2)/(D (cos^2 + gamma^2 sin^2)), D^2 = cos^2 + kc^2 sin^2 and
    gamma = (1-r)/(1+r): Bulirsch's general complete integral cel(kc, gamma^2, 1, gamma) (Bulirsch
    1969, Numer. Math. 13). On the cylinder r = 1, where gamma = 0, W = pi - 2|z| K/Rp.

    All integrals come from one loop of arithmetic-geometric means, which converges quadratically:
    six rounds for single precision and eight for double, unrolled to plain arithmetic. Besides the
    means a_n it computes the differences c_(n+1) = c_n^2/(4 a_(n+1)), c_1 = (1-kc)/2, and the sum
    S of 2^n c_(n+1)^2/(1-kc)^2 over n >= 1. Then E = K (1 - (1-kc^2)/2 - (1-kc)^2 (1/4 + S)).

    Derivatives. Biot and Savart's integrals over the circle, D the distance from the point,

        I3 = integral of dphi/D^3 = 4E/(Rp Rm^2),   C3 = integral of cos(phi) dphi/D^3 = r J,

    give the gradient (z x J, z y J, I3 - r^2 J), where the known form of J,
    2 (A E/Rm^2 - K)/(r^2 Rp), cancels near the axis and far away. With E as above, 1 - kc = q r,
    q = 4/(Rp (Rp + Rm)), and A = Rp^2 (1 + kc^2)/2, the terms of order 0 and 1 in 1 - kc drop out,
    which leaves

        J = K q^2 [(1 + 4 kc + kc^2)/4 - (1 + kc^2) S]/(Rp kc^2).

    I3 - r^2 J cancels near the circle, where the equal form
    2 [K + ((1-r)(1+r) - z^2) E/Rm^2]/Rp does not.

    Second derivatives need I5 and C5, with D^-5. As D^2 = A - 2r cos(phi), A I5 - 2r C5 = I3; and
    by parts, C3 = 3r times the integral of sin^2(phi)/D^5, that is 3 A C5 = 6 r I5 + C3. So, as
    A^2 - 4r^2 = Rm^2 Rp^2,

        C5/r = (2 I3 + A J/3)/(Rm^2 Rp^2),   I5 = (I3 + 2r C5)/A,

    sums of positive terms, and Omega_zz = -3z (I5 - r C5), Omega_rz = C3 - 3 z^2 C5,
    Omega_r/r = z J; the trace is 0.
    """

    r: Real
    z: Real
    angle: Real
    nearest: Real
    farthest: Real
    share: Real
    radial: Real
    axial: Real
    third: Real

    @classmethod
    def at(cls, r: Real, z: Real) -> UnitCircle:
        """The circle's solid angle at distance r >= 0 from the axis and height z; both Dr.Jit
        numbers."""
        real: Any = cast("Any", type(r))
        rounds = _AGM_ROUNDS["double" if float(dr.epsilon(r)) < 1e-10 else "single"]
        gap = 1 - r
        square = dr.fma(gap, gap, z * z)
        nearest, farthest = dr.sqrt(square), dr.sqrt(dr.fma(1 + r, 1 + r, z * z))
        inverse = 1 / farthest
        kc = nearest * inverse
        q = 4 * inverse / (farthest + nearest)
        gamma = gap / (1 + r)
        # c, d, p are Bulirsch's numbers for cel; m and e are the numbers of the means.
        c, d, p = real(1), dr.copysign(real(1), gamma), fmax(dr.abs(gamma), 1e-30)
        k, e, m = kc, kc, real(1)
        total, ratio, kc_gap = real(0), real(0.5), q * r
        for n in range(rounds):
            old_c, g = c, e / p
            c, d = c + d / p, 2 * dr.fma(old_c, g, d)
            p, m = p + g, m + k
            k = 2 * dr.sqrt(e)
            e = k * m
            if n >= 1:
                ratio = ratio * ratio * kc_gap / (4 * 0.5 ** (n + 1) * m)
                total = dr.fma(2.0**n * ratio, ratio, total)
        cel = (math.pi / 2) * dr.fma(c, m, d) / (m * (m + p))
        first = (math.pi / 2 * 2.0**rounds) / m  # K
        second = first * (1 - 0.5 * kc_gap * (1 + kc) - kc_gap * kc_gap * (0.25 + total))  # E
        height = dr.abs(z)
        w = dr.select(r < 1, real(2 * math.pi), 0) - 4 * height * inverse / (1 + r) * cel
        w = dr.select(r == 1, math.pi - 2 * height * inverse * first, w)
        bracket = 0.25 * dr.fma(kc, 4 + kc, 1) - dr.fma(kc, kc, 1) * total
        radial = first * inverse * bracket / (kc * kc)
        third = 4 * second * inverse / square
        near_form = 2 * inverse * (first + (gap * (1 + r) - z * z) / square * second)
        axial = dr.select(first * square < 2 * second, near_form, third - kc_gap * kc_gap * radial)
        return cls(r, z, -dr.mulsign(w, z), nearest, farthest, q, radial, axial, third)

    @property
    def across(self) -> Real:
        """z J: the component of the gradient at right angles to the axis is (x, y) times this."""
        return (self.z * self.share) * (self.share * self.radial)

    def second_derivatives(self) -> tuple[Real, Real, Real]:
        """Omega_zz, Omega_rz/r and z J, the entries of the Hessian in the directions of axis,
        radius and circle.

        Omega_rr is minus the sum of the first and the last.
        """
        r, z = self.r, self.z
        squares = dr.fma(r, r, dr.fma(z, z, 1))  # A
        j = self.share * self.share * self.radial
        product = self.nearest * self.farthest
        c5 = 2 * self.third + squares * j / 3  # (Rm Rp)^2 C5/r
        up, out = z / product, r / product
        # I5 - r C5, with I5 = (I3 + 2 r C5)/A.
        axial = dr.fma(out * out * c5, 2 - squares, self.third) / squares
        return -3 * z * axial, dr.fma(-3 * up * up, c5, j), z * j


@dataclass(frozen=True)
class CircleSums:
    """Sums over circles at a point x.

    angle, gradient: the solid angle and its gradient; the angle of each circle is in (-2 pi, 2 pi).
    distance: the distance to the nearest circle.
    squares, cubes, fourths: the integrals of |dp|/D^k, k = 2 and 3, and a bound of that for k = 4,
        with D the distance from x.
    lower, upper: a range of the lift on the ball of radius `distance`: see `planar`.
    """

    angle: Real
    gradient: Vec3
    distance: Real
    squares: Real
    cubes: Real
    fourths: Real
    lower: Real
    upper: Real


@dataclass(frozen=True)
class _RelativeCircle:
    """A circle of radius a relative to x: outward is the component of x - center in the circle's
    plane, of length r a, and x is z a above this plane."""

    a: Real
    normal: Vec3
    outward: Vec3
    circle: UnitCircle

    @property
    def distance(self) -> Real:
        return self.a * self.circle.nearest

    @property
    def farthest(self) -> Real:
        return self.a * self.circle.farthest


@dataclass(frozen=True)
class CircleSet:
    """Circles on a backend, as records of center, radius and normal, with lengths of order one."""

    records: RecordTable

    @classmethod
    def upload(
        cls, backend: Backend, circles: Sequence[Circle], center: FloatArray, size: float
    ) -> CircleSet:
        """Circles in unit coordinates: relative to a center, divided by a size."""
        rows = [
            [*(np.array(circle.center) - center) / size, circle.radius / size, *circle.normal, 0.0]
            for circle in circles
        ]
        return cls(RecordTable.upload(backend, np.array(rows)))

    def sums(self, x: Vec3) -> CircleSums:
        """All sums at x, in one loop."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            angle, gradient, distance, squares, cubes, fourths, lower = state
            relative = self._relative(row, x)
            circle, a = relative.circle, relative.a
            # In units of the circle's radius, so that all numbers are of order one.
            gradient = dr.fma(vector(circle.across / (a * a)), relative.outward, gradient)
            gradient = dr.fma(vector(circle.axial / a), relative.normal, gradient)
            near, far = circle.nearest, circle.farthest
            cube = circle.third / (a * a)
            # The sign comes from the height: far away the angle consists of rounding only.
            is_above = dr.mulsign(real(1), circle.z) > 0
            window = dr.select(
                circle.r < 1, dr.select(is_above, real(-4 * math.pi), 0), -2 * math.pi
            )
            return (
                angle + circle.angle,
                gradient,
                fmin(relative.distance, distance),
                squares + 2 * math.pi / (near * far * a),
                cubes + cube,
                fourths + cube / (near * a),
                lower + window,
            )

        start = (real(0), vector(0), real(dr.inf), real(0), real(0), real(0), real(0))
        angle, gradient, distance, squares, cubes, fourths, lower = self.records.for_each(
            add, start, "circles"
        )
        upper = lower + 4 * math.pi * real(self.records.iteration_count)
        return CircleSums(angle, gradient, distance, squares, cubes, fourths, lower, upper)

    def hessian(self, x: Vec3) -> SymmetricMatrix:
        """The Hessian of the sum of solid angles."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            relative = self._relative(row, x)
            a, n, e = relative.a, relative.normal, relative.outward
            axial, mixed, tangential = relative.circle.second_derivatives()
            scale = dr.rcp(a * a)
            length = dr.norm(e)
            radial = dr.select(length > 0, e / length, 0)
            # With u = radial:
            # f_tt (I - n n - u u) + f_rr u u + f_zz n n + f_rz (n u + u n).
            total = SymmetricMatrix(*state)
            total = total.add_outer_product(n, ((axial - tangential) * scale) * n)
            total = total.add_outer_product(radial, ((-axial - 2 * tangential) * scale) * radial)
            total = total.add_outer_product(n, (2 * mixed * scale / a) * e)
            return (
                *(entry + tangential * scale for entry in total.components()[:3]),
                *total.components()[3:],
            )

        start = SymmetricMatrix.zero(real).components()
        return SymmetricMatrix(*self.records.for_each(add, start, "circle hessian"))

    def line_rates(
        self, line: RayLine, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """For each length T, a bound of the derivative along the line up to T to both sides of x;
        infinite where a circle may be within T, and on lanes that are not active.

        For a circle of radius a, of which the nearest point is at distance d and the farthest at P,
        Biot and Savart's integrals are bounded by

            |grad Omega| <= integral of |dp|/D^2 = 2 pi a/(P d)

        (D^2 = A - 2r cos(phi) has this integral exactly; the bound is attained at the center), and

            integral of |dp|/D^3 = 4 a E/(P d^2) <= 2 pi a B,   B = sqrt((1/d^2 + 1/P^2)/2)/(P d),

        as E <= (pi/2) sqrt((1 + kc^2)/2) by Jensen's inequality for the square root. Going a length
        t, both distances fall by at most t, and both bounds fall as the distances grow. Points at r
        from the axis are at least |r - a| from the circle, which is a better bound for a line that
        passes by the circle than the distance of a single point of the line. At height z above the
        circle's plane the component of the gradient along the plane is at most |z| times the
        integral of |dp|/D^3. So for a line with the component w along the normal the derivative is
        at most |w| 2 pi a/(P d) + sqrt(1-w^2) |z| 2 pi a B, which is small if the line runs along
        the plane.
        """
        real, vector = self._types

        def add(row: list[Real], rates: tuple[Any, ...]) -> tuple[Any, ...]:
            relative = self._relative(row, line.x)
            slack, axial = line.slack, fmin(dr.abs(dr.dot(relative.normal, line.v)), 1)
            across = dr.sqrt(fmax(1 - axial * axial, 0))
            # `axial` is a sum of numbers of order one: rounding may be large relative to it.
            axial += 4 * float(dr.epsilon(line.x))
            height = dr.abs(relative.circle.z) * relative.a + slack
            # The line projected along the axis: at s its distance from the axis is
            # |outward + s across_v|.
            across_v = dr.fma(vector(-dr.dot(relative.normal, line.v)), relative.normal, line.v)
            square = dr.squared_norm(across_v)
            t = dr.select(square > 0, -dr.dot(relative.outward, across_v) / square, 0)
            new_rates: list[Real] = []
            for length, rate in zip(lengths, rates, strict=True):
                ends = (clamp(t, -length, length), -length, length)
                lowest, first, second = (
                    dr.norm(dr.fma(vector(s), across_v, relative.outward)) for s in ends
                )
                passing = fmax(lowest - relative.a, relative.a - fmax(first, second))
                near = fmax(relative.distance - length, passing) - slack
                far = fmax(relative.farthest - length, near + slack) - slack
                bound = 2 * math.pi * relative.a / (near * far)
                mean = dr.sqrt(0.5 * (dr.rcp(near * near) + dr.rcp(far * far)))
                max_height = dr.fma(length, axial, height)
                term = bound * dr.fma(across * max_height, mean, axial)
                new_rates.append(rate + dr.select(near > 0, term, dr.inf))
            return tuple(new_rates)

        start = tuple(real(0) for _ in lengths)
        rates = self.records.for_each(add, start, "circles along", active)
        return tuple(dr.select(active, rate, dr.inf) for rate in rates)

    def closest(self, x: Vec3) -> tuple[Vec3, Real]:
        """The point of the circles that is closest to x, and the square of its distance."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            best, nearest = state
            relative = self._relative(row, x)
            # All points of the circle are equally far from the axis: any direction in the plane is
            # right.
            length = dr.norm(relative.outward)
            perpendicular = dr.normalize(_perpendicular(vector, relative.normal))
            radial = dr.select(length > 0, relative.outward / length, perpendicular)
            point = dr.fma(vector(relative.a), radial, vector(*row[:3]))
            square = dr.squared_norm(x - point)
            closer = square < nearest
            return dr.select(closer, point, best), dr.select(closer, square, nearest)

        return self.records.for_each(add, (vector(0), real(dr.inf)), "nearest circle")

    @property
    def _types(self) -> tuple[Any, Any]:
        return self.records.backend.Float, self.records.backend.Array3f

    def _relative(self, row: list[Real], x: Vec3) -> _RelativeCircle:
        vector = self.records.backend.Array3f
        center, a, normal = vector(*row[:3]), row[3], vector(*row[4:7])
        displacement = x - center
        height = dr.dot(normal, displacement)
        # A second projection removes the error of the first, which the rounded normal has caused.
        outward = dr.fma(vector(-height), normal, displacement)
        outward = dr.fma(vector(-dr.dot(normal, outward)), normal, outward)
        return _RelativeCircle(a, normal, outward, UnitCircle.at(dr.norm(outward) / a, height / a))


def _perpendicular(vector: Any, n: Vec3) -> Vec3:
    """A vector at right angles to n whose length is not small."""
    is_flat = dr.abs(n.z) < 0.7
    return dr.select(is_flat, vector(-n.y, n.x, 0), vector(0, -n.z, n.y))
