"""The solid angle Omega of a circle, seen from a point x, and sums over many circles with the
integrals that bound them. Omega is known modulo 4 pi. In integrals along a circle, p is a point of
the circle, |dp| the length element, and D the distance from x to p. A record of a circle holds its
center, radius and unit normal.

- `UnitCircle`: the formulas, by complete elliptic integrals.
- `CircleSet`: circles on a backend, and the sums over them.

Value, gradient and Hessian of a circle are one expression: Bulirsch's loop for complete elliptic
integrals, unrolled. The forms of the formulas are chosen so that no terms cancel.
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
from harnack.fmm.edges import CurveSums
from harnack.fmm.point_values import SymmetricMatrix

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Mask, Real, Vec3
    from harnack.fmm.trail_sums import RayLine
    from harnack.geometry.curves import Circle

__all__ = ["CircleSet", "CircleSums", "UnitCircle"]

# The number of rounds of arithmetic-geometric means, after which they have converged.
_AGM_ROUNDS = {"single": 6, "double": 8}


@dataclass(frozen=True)
class UnitCircle:
    """The solid angle Omega of the unit circle, seen from a point, and its derivatives. The circle
    has radius 1 and lies in the plane z = 0 around the z axis, run counter-clockwise as seen from
    above.

    r, z: the distance of the point from the axis, and its height above the plane.
    angle: Omega in (-2 pi, 2 pi).
    nearest, farthest: the distances Rm and Rp of the point from the nearest and the farthest point
        of the circle.
    share: q = 4/(Rp (Rp + Rm)), so that q r = 1 - kc.
    radial: J/q^2, with the integral J below.
    axial: the component of the gradient along the axis.
    third: the integral I3 below.

    Symbols. Rm^2 = (1-r)^2 + z^2, Rp^2 = (1+r)^2 + z^2, and A = 1 + r^2 + z^2. K and E are the
    complete elliptic integrals of the first and second kind with the complementary modulus
    kc = Rm/Rp.

    Value. Omega = -sgn(z) W, W = 2 pi [r < 1] - 4|z| cel/((1+r) Rp). Here cel is the integral of
    (cos^2 + gamma sin^2)/(D (cos^2 + gamma^2 sin^2)) over the angles in [0, pi/2], with
    D^2 = cos^2 + kc^2 sin^2 and gamma = (1-r)/(1+r). It is Bulirsch's general complete integral
    cel(kc, gamma^2, 1, gamma) (Bulirsch 1969, Numer. Math. 13). On the cylinder r = 1, where
    gamma = 0, W = pi - 2|z| K/Rp.

    Loop. cel, K and E come from one loop of arithmetic-geometric means, which converges
    quadratically: six rounds for single precision and eight for double, unrolled to plain
    arithmetic. Besides the means a_n it computes the differences c_(n+1) = c_n^2/(4 a_(n+1)),
    c_1 = (1-kc)/2, and the sum S of 2^n c_(n+1)^2/(1-kc)^2 over n >= 1. Then
    E = K (1 - (1-kc^2)/2 - (1-kc)^2 (1/4 + S)).

    Derivatives. Let D now be the distance of the point from the circle's point at the angle phi.
    Biot and Savart's integrals over the circle,

        I3 = integral of dphi/D^3 = 4E/(Rp Rm^2),   C3 = integral of cos(phi) dphi/D^3 = r J,

    give the gradient (z x J, z y J, I3 - r^2 J) at the point (x, y, z). The known form
    J = 2 (A E/Rm^2 - K)/(r^2 Rp) cancels near the axis and far away. Insert E as above,
    1 - kc = q r, and A = Rp^2 (1 + kc^2)/2. The terms of order 0 and 1 in 1 - kc drop out, which
    leaves

        J = K q^2 [(1 + 4 kc + kc^2)/4 - (1 + kc^2) S]/(Rp kc^2).

    I3 - r^2 J cancels near the circle, where the equal form
    2 [K + ((1-r)(1+r) - z^2) E/Rm^2]/Rp does not.

    Second derivatives need I5 and C5, the same integrals with D^-5 instead of D^-3. As
    D^2 = A - 2r cos(phi), A I5 - 2r C5 = I3. And integration by parts gives C3 as 3r times the
    integral of sin^2(phi)/D^5, that is 3 A C5 = 6 r I5 + C3. So, as A^2 - 4r^2 = Rm^2 Rp^2,

        C5/r = (2 I3 + A J/3)/(Rm^2 Rp^2),   I5 = (I3 + 2r C5)/A,

    which are sums of positive terms. The second derivatives are Omega_zz = -3z (I5 - r C5),
    Omega_rz = C3 - 3 z^2 C5, and Omega_r/r = z J in the tangential direction; the trace is 0.
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
        """Compute the unit circle's solid angle, and what its derivatives need, at a point.

        r, z: the distance r >= 0 of the point from the axis, and its height z, as Dr.Jit numbers.

        On the circle's own plane z = 0 the sign of the zero decides the side.

        The class docstring has the formulas. Here kc is the ratio of the distances from the nearest
        and the farthest point of the circle; K and E are the complete elliptic integrals of that
        complementary modulus; cel is Bulirsch's general complete integral; and the solid angle is
        -W for z > 0 and W for z < 0. I3 and J are integrals from which the gradient follows.
        """
        real: Any = cast("Any", type(r))
        agm_rounds = _AGM_ROUNDS["double" if float(dr.epsilon(r)) < 1e-10 else "single"]
        gap = 1 - r
        square = dr.fma(gap, gap, z * z)
        nearest, farthest = dr.sqrt(square), dr.sqrt(dr.fma(1 + r, 1 + r, z * z))
        inverse = 1 / farthest
        # q: the attribute `share`, for which q r = 1 - kc.
        kc = nearest * inverse
        q = 4 * inverse / (farthest + nearest)
        gamma = gap / (1 + r)
        # c, d and p are Bulirsch's numbers for cel. m, k and e belong to the means: m is 2^n times
        # the arithmetic mean after n rounds. In the loop `difference` becomes c_(n+1)/(1-kc), and
        # `total` the sum S; kc_gap is 1 - kc. p must not be 0, which it would be on r = 1.
        c, d, p = real(1), dr.copysign(real(1), gamma), fmax(dr.abs(gamma), 1e-30)
        k, e, m = kc, kc, real(1)
        total, difference, kc_gap = real(0), real(0.5), q * r
        for n in range(agm_rounds):
            old_c, g = c, e / p
            c, d = c + d / p, 2 * dr.fma(old_c, g, d)
            p, m = p + g, m + k
            k = 2 * dr.sqrt(e)
            e = k * m
            if n >= 1:
                difference = difference * difference * kc_gap / (4 * 0.5 ** (n + 1) * m)
                total = dr.fma(2.0**n * difference, difference, total)
        cel = (math.pi / 2) * dr.fma(c, m, d) / (m * (m + p))
        first = (math.pi / 2 * 2.0**agm_rounds) / m  # K
        second = first * (1 - 0.5 * kc_gap * (1 + kc) - kc_gap * kc_gap * (0.25 + total))  # E
        # w: W, with its own formula on the cylinder r = 1.
        height = dr.abs(z)
        w = dr.select(r < 1, real(2 * math.pi), 0) - 4 * height * inverse / (1 + r) * cel
        w = dr.select(r == 1, math.pi - 2 * height * inverse * first, w)
        bracket = 0.25 * dr.fma(kc, 4 + kc, 1) - dr.fma(kc, kc, 1) * total
        # radial: J/q^2. third: I3.
        radial = first * inverse * bracket / (kc * kc)
        third = 4 * second * inverse / square
        # I3 - r^2 J in two forms; the first is for points near the circle.
        near_form = 2 * inverse * (first + (gap * (1 + r) - z * z) / square * second)
        axial = dr.select(first * square < 2 * second, near_form, third - kc_gap * kc_gap * radial)
        return cls(r, z, -dr.mulsign(w, z), nearest, farthest, q, radial, axial, third)

    @property
    def across(self) -> Real:
        """z J, where r J is the integral of cos(phi) dphi/D^3 over the circle, and D the distance
        of the circle's point at the angle phi. At the point (x, y, z), this number times (x, y) is
        the component of the gradient perpendicular to the axis."""
        return (self.z * self.share) * (self.share * self.radial)

    def second_derivatives(self) -> tuple[Real, Real, Real]:
        """Compute three numbers from which the Hessian of the solid angle follows: its entry zz,
        its entry rz divided by r, and its entry tt. The class docstring has the formulas, and the
        integrals J, I3, I5 and C5 over the circle in them.

        z is the direction of the circle's axis, r the radial and t the tangential direction. The
        entry rr is minus the sum of the entries zz and tt; the entries rt and zt are 0.
        """
        r, z = self.r, self.z
        a_sum = dr.fma(r, r, dr.fma(z, z, 1))  # A
        j = self.share * self.share * self.radial  # J: `radial` is J/share^2
        distance_product = self.nearest * self.farthest  # Rm Rp
        c5 = 2 * self.third + a_sum * j / 3  # (Rm Rp)^2 C5/r
        z_ratio, r_ratio = z / distance_product, r / distance_product
        # fifth_difference = I5 - r C5. As I5 = (I3 + 2 r C5)/A, it is (I3 + (2 - A) r C5)/A.
        fifth_difference = dr.fma(r_ratio * r_ratio * c5, 2 - a_sum, self.third) / a_sum
        return -3 * z * fifth_difference, dr.fma(-3 * z_ratio * z_ratio, c5, j), z * j


@dataclass(frozen=True)
class CircleSums(CurveSums):
    """Sums over a set of circles at a point x. The angle is the sum of the circles' solid angles,
    each in (-2 pi, 2 pi). Only `inverse_fourths` is an upper bound; the distance and the other two
    integrals are those of the circles.

    lower, upper: bounds of the angle on the ball around x of radius `distance`, if it is continued
        from x without its jumps of 4 pi (`planar` has the proof).
    """

    lower: Real
    upper: Real


@dataclass(frozen=True)
class _RelativeCircle:
    """A circle of any position and size, relative to a point x. In units of the circle's radius a,
    x is at the distance r from the circle's axis and at the height z above its plane.

    a: the radius of the circle.
    normal: its unit normal.
    outward: the component of x - center in the circle's plane, of length r a.
    circle: the solid angle of the unit circle, seen from a point at the distance r and the height
        z.
    """

    a: Real
    normal: Vec3
    outward: Vec3
    circle: UnitCircle

    @property
    def distance(self) -> Real:
        """The distance from x to the nearest point of the circle."""
        return self.a * self.circle.nearest

    @property
    def farthest(self) -> Real:
        """The distance from x to the farthest point of the circle."""
        return self.a * self.circle.farthest


@dataclass(frozen=True)
class CircleSet:
    """A set of circles on a backend, in unit coordinates, in which lengths are of order one. Its
    methods sum over the solid angles of all circles, seen from a point x. A record of a circle
    holds its center (3,), radius, and unit normal (3,)."""

    records: RecordTable

    @classmethod
    def upload(
        cls, backend: Backend, circles: Sequence[Circle], center: FloatArray, size: float
    ) -> CircleSet:
        """Upload circles to a backend, in unit coordinates: positions relative to `center` (3,),
        and all lengths divided by `size`."""
        # The 0 at the end pads a record to eight numbers.
        rows = [
            [*(np.array(circle.center) - center) / size, circle.radius / size, *circle.normal, 0.0]
            for circle in circles
        ]
        return cls(RecordTable.upload(backend, np.array(rows)))

    def sums(self, x: Vec3) -> CircleSums:
        """Sum over all circles at points x (3, n), in unit coordinates, in one loop over the
        circles."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the circle in the record `row` to the state, and return the new state. It holds
            the angle, the gradient, the distance of the nearest circle, the three integrals, and
            the lower bound of the continued angle."""
            angle, gradient, distance, inverse_squares, inverse_cubes, inverse_fourths, lower = (
                state
            )
            relative = self._relative(row, x)
            circle, a = relative.circle, relative.a
            # circle: the unit circle as seen from x, in units of the radius a, so that all numbers
            # are of order one. Its gradient is `across` times the vector from the axis to the
            # point, and `axial` along the axis; `third` is the integral of |dp|/D^3.
            # relative.outward: the vector from the axis to x.
            gradient = dr.fma(vector(circle.across / (a * a)), relative.outward, gradient)
            gradient = dr.fma(vector(circle.axial / a), relative.normal, gradient)
            nearest, farthest = circle.nearest, circle.farthest
            cube = circle.third / (a * a)
            # The range of the circle's continued angle, of width 4 pi, begins at `lower_end`. Above
            # the disk the angle lies in [-4 pi, 0], below it in [0, 4 pi], elsewhere in
            # [-2 pi, 2 pi]. The sign comes from the height: far away the angle consists of rounding
            # only.
            is_above = dr.mulsign(real(1), circle.z) > 0
            lower_end = dr.select(
                circle.r < 1, dr.select(is_above, real(-4 * math.pi), 0), -2 * math.pi
            )
            # The integral of |dp|/D^2 is 2 pi/(nearest farthest a). That of |dp|/D^4 is at most the
            # integral of |dp|/D^3 over the least distance, nearest a.
            return (
                angle + circle.angle,
                gradient,
                fmin(relative.distance, distance),
                inverse_squares + 2 * math.pi / (nearest * farthest * a),
                inverse_cubes + cube,
                inverse_fourths + cube / (nearest * a),
                lower + lower_end,
            )

        start = (real(0), vector(0), real(dr.inf), real(0), real(0), real(0), real(0))
        *sums, lower = self.records.for_each(add, start, "circles")
        upper = lower + 4 * math.pi * real(self.records.iteration_count)
        return CircleSums(*sums, lower=lower, upper=upper)

    def hessian(self, x: Vec3) -> SymmetricMatrix:
        """Compute the Hessian of the sum of the circles' solid angles at points x (3, n), in unit
        coordinates."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the Hessian of the circle in the record `row` to the total, whose entries are the
            state. Returns the new state."""
            relative = self._relative(row, x)
            # outward: the vector from the circle's axis to x.
            a, n, outward = relative.a, relative.normal, relative.outward
            f_zz, f_rz_over_r, f_tt = relative.circle.second_derivatives()
            inverse_square = dr.rcp(a * a)
            outward_length = dr.norm(outward)
            radial = dr.select(outward_length > 0, outward / outward_length, 0)
            # The Hessian of the circle's angle, with u = radial and f_rr = -f_zz - f_tt:
            # f_tt (I - n n - u u) + f_rr u u + f_zz n n + f_rz (n u + u n).
            # It is divided by a^2, as f is a function of x/a; and f_rz u is f_rz_over_r outward/a.
            # `add_outer_product` adds (p q^T + q p^T)/2, hence the factor 2.
            total = SymmetricMatrix(*state)
            total = total.add_outer_product(n, ((f_zz - f_tt) * inverse_square) * n)
            total = total.add_outer_product(radial, ((-f_zz - 2 * f_tt) * inverse_square) * radial)
            total = total.add_outer_product(n, (2 * f_rz_over_r * inverse_square / a) * outward)
            # The first three entries are those on the diagonal.
            return (
                *(entry + f_tt * inverse_square for entry in total.components()[:3]),
                *total.components()[3:],
            )

        start = SymmetricMatrix.zero(real).components()
        return SymmetricMatrix(*self.records.for_each(add, start, "circle hessian"))

    def line_rates(
        self, line: RayLine, lengths: tuple[Real, ...], active: Mask
    ) -> tuple[Real, ...]:
        """Bound the size of the derivative of the circles' solid angle along a line, on several
        parts of the line: for each length T, at all points within T of x in both directions.

        line: the line through x = line.x, with the unit direction line.v.
        lengths: the lengths T.
        active: the mask of the lanes to compute.

        Returns a tuple with one bound for each length. A bound is infinite where a circle may be
        within T of x, and on lanes that are not active.

        Proof. Consider one circle and a point of the line. Symbols:

        - a: the radius of the circle;
        - r, z: the distance of the point from the circle's axis, and its height above the plane;
        - d, P: the distances from the point to the nearest and the farthest point of the circle;
        - D: the distance from the point to a point p of the circle;
        - E: the complete elliptic integral of the second kind, of complementary modulus kc = d/P;
        - w: the component of the line's direction along the circle's normal.

        (1) Two integrals have closed forms:

            |grad Omega| <= integral of |dp|/D^2 = 2 pi a/(P d),

            integral of |dp|/D^3 = 4 a E/(P d^2) <= 2 pi a B,   B = sqrt((1/d^2 + 1/P^2)/2)/(P d).

        The first inequality is Biot and Savart's law. The second holds since
        E <= (pi/2) sqrt((1 + kc^2)/2), by Jensen's inequality for the square root.

        (2) The component of the gradient along the circle's plane is at most |z| times the integral
        of |dp|/D^3. So the derivative along the line is at most
        |w| 2 pi a/(P d) + sqrt(1-w^2) |z| 2 pi a B, which is small if the line runs along the
        plane.

        (3) These bounds fall as d and P grow. So they hold on a whole part of the line with the
        smallest d and P, and the largest |z|, on it. If the point moves by t, d and P fall by at
        most t. Also d >= |r - a|: for a line that passes by the circle, this is a better bound than
        the distance of a single point of the line.
        """
        real, vector = self._types

        def add(row: list[Real], rates: tuple[Any, ...]) -> tuple[Any, ...]:
            """Add the circle in the record `row` to `rates`: for each of `lengths`, a bound of the
            derivative of the solid angle along the line within this length of the point `line.x`.
            The line has the unit direction `line.v`. Returns the new bounds."""
            relative = self._relative(row, line.x)
            # slack: the rounding of distances. axial: |w| of the proof.
            slack, axial = line.slack, fmin(dr.abs(dr.dot(relative.normal, line.v)), 1)
            across = dr.sqrt(fmax(1 - axial * axial, 0))
            # `axial` is a sum of numbers of order one: its rounding may be large relative to it.
            axial += 4 * float(dr.epsilon(line.x))
            height = dr.abs(relative.circle.z) * relative.a + slack
            # The line is projected onto the circle's plane. At the position s on the line, its
            # distance from the axis is |outward + s flat_v|.
            flat_v = dr.fma(vector(-dr.dot(relative.normal, line.v)), relative.normal, line.v)
            square = dr.squared_norm(flat_v)
            closest_position = dr.select(square > 0, -dr.dot(relative.outward, flat_v) / square, 0)
            new_rates: list[Real] = []
            for length, rate in zip(lengths, rates, strict=True):
                positions = (clamp(closest_position, -length, length), -length, length)
                # r at the position nearest to the axis, and at both ends of the part.
                lowest, first, last = (
                    dr.norm(dr.fma(vector(s), flat_v, relative.outward)) for s in positions
                )
                # A lower bound of |r - a| on the part of the line.
                plane_distance = fmax(lowest - relative.a, relative.a - fmax(first, last))
                # near and far: lower bounds of the distances d and P at all points of the line
                # within `length`. P is at least d.
                near = fmax(relative.distance - length, plane_distance) - slack
                far = fmax(relative.farthest - length, near + slack) - slack
                bound = 2 * math.pi * relative.a / (near * far)
                # B is mean_inverse/(P d), the root mean square of 1/d and 1/P over P d.
                mean_inverse = dr.sqrt(0.5 * (dr.rcp(near * near) + dr.rcp(far * far)))
                max_height = dr.fma(length, axial, height)
                term = bound * dr.fma(across * max_height, mean_inverse, axial)
                new_rates.append(rate + dr.select(near > 0, term, dr.inf))
            return tuple(new_rates)

        start = tuple(real(0) for _ in lengths)
        rates = self.records.for_each(add, start, "circles along", active)
        return tuple(dr.select(active, rate, dr.inf) for rate in rates)

    def closest(self, x: Vec3) -> tuple[Vec3, Real]:
        """Find, for each of the points x (3, n), the closest point (3, n) on any of the circles.
        Returns it with the square of its distance from x, all in unit coordinates."""
        real, vector = self._types
        x = vector(x)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            """Update the state by the circle in the record `row`. The state holds the closest point
            so far, and its squared distance. Returns the new state."""
            closest_point, smallest_square = state
            relative = self._relative(row, x)
            # The closest point lies in the direction of `outward` from the center. If x is on the
            # axis, all points of the circle are equally far: any direction in the plane is right.
            outward_length = dr.norm(relative.outward)
            perpendicular = dr.normalize(_perpendicular(vector, relative.normal))
            radial = dr.select(outward_length > 0, relative.outward / outward_length, perpendicular)
            point = dr.fma(vector(relative.a), radial, vector(*row[:3]))
            squared_distance = dr.squared_norm(x - point)
            is_closer = squared_distance < smallest_square
            return dr.select(is_closer, point, closest_point), dr.select(
                is_closer, squared_distance, smallest_square
            )

        return self.records.for_each(add, (vector(0), real(dr.inf)), "nearest circle")

    @property
    def _types(self) -> tuple[Any, Any]:
        """The backend's type of numbers, and its type of vectors."""
        return self.records.backend.Float, self.records.backend.Array3f

    def _relative(self, row: list[Real], x: Vec3) -> _RelativeCircle:
        """Compute how the circle in the record `row` lies relative to points x (3, n), in unit
        coordinates."""
        vector = self.records.backend.Array3f
        center, a, normal = vector(*row[:3]), row[3], vector(*row[4:7])
        displacement = x - center
        height = dr.dot(normal, displacement)
        # A second projection removes the error of the first, which the rounded normal has caused.
        outward = dr.fma(vector(-height), normal, displacement)
        outward = dr.fma(vector(-dr.dot(normal, outward)), normal, outward)
        return _RelativeCircle(a, normal, outward, UnitCircle.at(dr.norm(outward) / a, height / a))


def _perpendicular(vector: Any, n: Vec3) -> Vec3:
    """Compute a vector perpendicular to the unit vector n. Its length is at least 0.7.

    vector: the type of the result, a Dr.Jit 3-vector.
    """
    is_flat = dr.abs(n.z) < 0.7
    return dr.select(is_flat, vector(-n.y, n.x, 0), vector(0, -n.z, n.y))
