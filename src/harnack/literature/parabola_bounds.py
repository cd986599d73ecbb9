"""Bounds of a function along a path by two parabolas, computed operation by operation from a
formula. A path is a piece of a ray; s is the length along it, from 0 at its start to h at its end.
A number of this arithmetic (`ParabolaBounds`) stands for a function f of s. It holds the value
f(0), and the coefficients (a, b) of two parabolas a s + b s^2, one below and one above the change
f(s) - f(0). Sums, products, functions and maxima of such numbers are such numbers again. So a
formula that is evaluated with the coordinates of the path as such numbers proves parabolas for
itself. If lines are wanted instead, b = 0 for functions that are no polynomials.

This is the bottom-up linear and quadratic arithmetic of Aydinlilar and Zanni (2023, sections 5.2
and 6.2, appendices B and C). Two details improve on the published method: functions are bounded by
chords from the value at the start, which need no validity interval; and the tighter of chords and
Taylor's formula is used.

Rounding. Coefficients are computed in rounded arithmetic; each result is moved outwards by
`_ROUNDINGS` units in the last place of the sum of the absolute values of all terms, which is more
than the number of operations done.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr

from harnack.arithmetic.angles import angle_range
from harnack.arithmetic.interval import Interval, machine_epsilon
from harnack.arithmetic.norms import as_backend_interval
from harnack.arithmetic.operators import FormulaNumber
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.literature.blob_kernel import ClippedPower
from harnack.literature.relative_angle import relative_angle

if TYPE_CHECKING:
    from harnack.arithmetic.functions import ElementaryFunction
    from harnack.backend import Real, Vec3

# The coefficients (a, b) of a s + b s^2.
Quadratic: TypeAlias = "tuple[Real, Real]"

_ROUNDINGS = 32.0
# The fraction of the length at which two bounds are compared, to choose the tighter one.
_COMPARED_AT = 0.6


@dataclass(frozen=True, eq=False)
class ParabolaBounds(FormulaNumber):
    """A function f of the length s along a path, 0 <= s <= h, with two parabolas a s + b s^2 that
    bound its change f(s) - f(0) from below and from above. A bound is the pair (a, b); it is a line
    if b = 0.

    value: the range of f at s = 0.
    lower, upper: (a, b) for the parabolas a s + b s^2 below and above f(s) - f(0).
    piece_length: the length h; the bounds hold for 0 <= s <= h.
    bound_degree: 1 if the bounds are lines (bottom-up linear arithmetic), else 2.
    polynomial_degree: the degree of f, if f is a polynomial of degree at most 2: then the two
        parabolas differ by rounding alone. None for other functions.
    """

    value: Interval
    lower: Quadratic
    upper: Quadratic
    piece_length: Real
    bound_degree: int = 2
    polynomial_degree: int | None = None

    @classmethod
    def along_ray(
        cls, p: Vec3, direction: Vec3, length: Real, *, degree: int = 2
    ) -> tuple[ParabolaBounds, ParabolaBounds, ParabolaBounds]:
        """The three coordinates of the points p + s d as functions of s, for 0 <= s <= length.

        direction: d.
        degree: 1 to bound functions by lines, 2 by parabolas.
        """

        def coordinate(x: Real, slope: Real) -> ParabolaBounds:
            """The function x + s slope. It is a line, and both bounds are this line."""
            line = slope, 0.0
            # As a polynomial it has the degree 1.
            return cls(Interval.point(x), line, line, length, degree, 1)

        x, y, z = (coordinate(p[k], direction[k]) for k in range(3))
        return x, y, z

    @property
    def bounds(self) -> tuple[Quadratic, Quadratic]:
        """The parabolas below and above f(s) - f(0); if `bound_degree` is 1, lines below and above
        it, with b = 0."""
        if self.bound_degree == 2:
            return self.lower, self.upper
        return _lines_bounding_parabolas(self.lower, self.upper, self.piece_length)

    def constant(self, x: float | Real) -> ParabolaBounds:
        """The constant number x as a function along the same path."""
        if isinstance(x, int | float):
            value = Interval.enclosing(float(x), cast("Any", type(self.piece_length)))
        else:
            value = Interval.point(x)
        return self._new(value, (0.0, 0.0), (0.0, 0.0), 0)

    def _new(
        self, value: Interval, lower: Quadratic, upper: Quadratic, polynomial: int | None = None
    ) -> ParabolaBounds:
        """A function on the same path, with the range `value` at s = 0 and the bounds `lower` and
        `upper`. If `bound_degree` is 1, the bounds are replaced by lines that bound them, unless
        the function is a polynomial.

        polynomial: the degree of the function if it is a polynomial; else None.
        """
        new = ParabolaBounds(value, lower, upper, self.piece_length, self.bound_degree, polynomial)
        if polynomial is None and self.bound_degree == 1:
            lower, upper = new.bounds
            return dataclasses.replace(new, lower=lower, upper=upper)
        return new

    def __neg__(self) -> ParabolaBounds:
        """-f: the bounds change their signs and their sides."""
        (a, b), (c, d) = self.lower, self.upper
        return dataclasses.replace(self, value=-self.value, lower=(-c, -d), upper=(-a, -b))

    def sum(self, other: Any) -> ParabolaBounds:
        """The sum of this function and another one: values and bounds are added."""
        value = self.value + other.value
        # Rounded downwards (-1) and upwards (1).
        lower = _sum(self.lower, other.lower, -1)
        upper = _sum(self.upper, other.upper, 1)
        if self.polynomial_degree is None or other.polynomial_degree is None:
            return self._new(value, lower, upper)
        return self._new(value, lower, upper, max(self.polynomial_degree, other.polynomial_degree))

    # Products.

    def product(self, other: Any) -> ParabolaBounds:
        """The product f g of this function and another one.

        Proof. Let F = f - f(0) and G = g - g(0). Then f g - f(0) g(0) = f(0) G + g(0) F + F G. Each
        of F and G lies between two parabolas, and this is linear in F and in G. So it lies between
        the smallest and the largest of the four functions in which a bound takes the place of F and
        one the place of G; each is a quartic. If the bounds are lines, a s of F and c s of G, the
        quartic is s (f(0) c + g(0) a + a c s), and the factor of s lies between its values at both
        ends. For parabolas, the derivative of the quartic is a cubic. `_lines_bounding_cubic` puts
        it between two lines, and the integrals of these are parabolas.

        If both are polynomials and f g has the degree 2, it is its own bound. If one is a constant,
        so is the bound times it.
        """
        # A constant factor.
        if other.polynomial_degree == 0:
            return self._scaled(other.value)
        if self.polynomial_degree == 0:
            return other._scaled(self.value)
        value = self.value * other.value
        if self is other:
            value = self.value.square()
        degree = None
        if self.polynomial_degree is not None and other.polynomial_degree is not None:
            degree = self.polynomial_degree + other.polynomial_degree
        # Both are of degree 1: their product is a parabola.
        if degree == 2:
            lower, upper = self._product_of_lines(other)
            return self._new(value, lower, upper, 2)  # a polynomial of degree 2
        if self.bound_degree == 1:
            return self._new(value, *self._straight_product(other))
        return self._new(value, *self._curved_product(other))

    def _scaled(self, factor: Interval) -> ParabolaBounds:
        """The product k f of this function with a constant k in the interval `factor`.

        Proof. Let k = m + e with |e| <= r. The bounds of m f are those of f times m, exchanged if m
        < 0; and |e f| <= r max(|lower|, |upper|), for each coefficient.
        """
        value = self.value * factor
        middle, radius = factor.midpoint, factor.radius
        if factor.is_zero:
            # The constant 0, a polynomial of degree 0.
            return self._new(value, (0.0, 0.0), (0.0, 0.0), 0)
        lower_bound, upper_bound = self.lower, self.upper
        # The bounds of m f; the lower one is the product with the upper bound if m < 0.
        scaled_bounds = [
            (middle * bound[0], middle * bound[1]) for bound in (lower_bound, upper_bound)
        ]
        is_negative = middle < 0
        # For each coefficient, u is that of the lower bound and v that of the upper one.
        lower = tuple(dr.select(is_negative, v, u) for u, v in zip(*scaled_bounds, strict=True))
        upper = tuple(dr.select(is_negative, u, v) for u, v in zip(*scaled_bounds, strict=True))
        sizes = [fmax(dr.abs(u), dr.abs(v)) for u, v in zip(lower_bound, upper_bound, strict=True)]
        rounding = [
            0.0 if _is_zero(lower_bound[k]) and _is_zero(upper_bound[k])
            else radius * sizes[k] + _rounding_bound(dr.abs(middle) * sizes[k])
            for k in range(2)
        ]  # fmt: skip
        return self._new(
            value,
            (lower[0] - rounding[0], lower[1] - rounding[1]),
            (upper[0] + rounding[0], upper[1] + rounding[1]),
            self.polynomial_degree,
        )

    def _product_of_lines(self, other: ParabolaBounds) -> tuple[Quadratic, Quadratic]:
        """Bounds of the product of this and another function, both polynomials of degree 1: the
        product itself, up to rounding.

        In the code v and w are the midpoints of the ranges of the two values at s = 0, and a and c
        the midpoints of the ranges of the two slopes; rv, rw, ra and rc are the radii of these
        ranges.
        """
        a, ra = _midpoint_and_half_width(self.lower[0], self.upper[0])
        c, rc = _midpoint_and_half_width(other.lower[0], other.upper[0])
        v, rv, w, rw = *_midpoint_and_radius(self.value), *_midpoint_and_radius(other.value)
        # (v + a s)(w + c s) = v w + (v c + w a) s + a c s^2
        linear = v * c + w * a
        linear_error = _rounding_bound(dr.abs(v * c) + dr.abs(w * a))
        linear_error += (
            rv * dr.abs(c) + rw * dr.abs(a) + (dr.abs(v) + rv) * rc + (dr.abs(w) + rw) * ra
        )
        quadratic = a * c
        quadratic_error = (
            _rounding_bound(dr.abs(quadratic)) + dr.abs(a) * rc + dr.abs(c) * ra + ra * rc
        )
        return (linear - linear_error, quadratic - quadratic_error), (
            linear + linear_error,
            quadratic + quadratic_error,
        )

    def _straight_product(self, other: ParabolaBounds) -> tuple[Quadratic, Quadratic]:
        """Lines that bound the change of the product f g of this and another function. `product`
        has the proof: each of four quartics is s (v c + w a + a c s), whose factor of s lies
        between its values at both ends of the path.

        In the code v and w are the midpoints of f(0) and g(0), rv and rw their radii. a and c are
        the slopes of a bound of f and of one of g.
        """
        h = self.piece_length
        v, rv, w, rw = *_midpoint_and_radius(self.value), *_midpoint_and_radius(other.value)
        lows: list[Real] = []
        highs: list[Real] = []
        for a, _ in self.bounds:
            for c, _ in other.bounds:
                # The factor of s is `linear` at s = 0 and `linear` + `quadratic` at s = h.
                linear, quadratic = v * c + w * a, a * c * h
                rounding = _rounding_bound(dr.abs(v * c) + dr.abs(w * a) + dr.abs(quadratic))
                # v and w may be off by their radii.
                rounding += rv * dr.abs(c) + rw * dr.abs(a)
                lows += [linear - rounding, linear + quadratic - rounding]
                highs += [linear + rounding, linear + quadratic + rounding]
        return (_minimum_or_inf(*lows), 0.0), (_maximum_or_inf(*highs), 0.0)

    def _curved_product(self, other: ParabolaBounds) -> tuple[Quadratic, Quadratic]:
        """Parabolas that bound the change of the product f g of this and another function.
        `product` has the proof: the derivative of each of four quartics is put between two lines.

        In the code v and w are the midpoints of f(0) and g(0), rv and rw their radii. (a, b) is
        a bound of f and (c, d) one of g, with the radii ra, rb, rc, rd of their coefficients. ah =
        a h, bh = b h^2 and so on are the coefficients for r = s/h, which goes from 0 to 1.
        """
        h = self.piece_length
        v, rv, w, rw = *_midpoint_and_radius(self.value), *_midpoint_and_radius(other.value)
        lows: list[Real] = []
        highs: list[Real] = []
        firsts, seconds = self._bound_coefficients(), other._bound_coefficients()
        pairs = [(f, g) for f in firsts for g in seconds]
        if self is other and len(firsts) == 2:  # of a square, two of the four are the same
            pairs = [(firsts[0], firsts[0]), (firsts[0], firsts[1]), (firsts[1], firsts[1])]
        for (a, b, ra, rb), (c, d, rc, rd) in pairs:
            # The derivative with respect to r = s/h: c0 + c1 r + c2 r^2 + c3 r^3.
            ah, bh, ch, dh = a * h, b * h * h, c * h, d * h * h
            terms = (
                (v * ch, w * ah),
                (2 * v * dh, 2 * ah * ch, 2 * bh * w),
                (3 * ah * dh, 3 * bh * ch),
                (4 * bh * dh,),
            )
            c0, c1, c2, c3 = (sum(term[1:], term[0]) for term in terms)
            # The lines found below have values at 0 and 1 that are sums of a value and of a slope
            # of the derivative. A term of r^k enters the value at most once, the slope k times.
            rounding_size = sum(
                ((k + 1) * dr.abs(term) for k, group in enumerate(terms) for term in group), 0 * h
            )
            # The part of the product's change that is due to the radii (those of f(0) and g(0), and
            # those of the coefficients) is at most `uncertainty` r in magnitude. A constant that is
            # added to the derivative adds just that to the change.
            size_f = dr.abs(ah) + 2 * dr.abs(bh)
            size_g = dr.abs(ch) + 2 * dr.abs(dh)
            uncertainty = rv * size_g + rw * size_f
            radius_f, radius_g = ra * h + 2 * rb * h * h, rc * h + 2 * rd * h * h
            uncertainty += radius_f * (dr.abs(w) + rw + size_g + radius_g)
            uncertainty += radius_g * (dr.abs(v) + rv + size_f)
            rounding = _rounding_bound(rounding_size) + uncertainty
            lower_start, lower_end, upper_start, upper_end = _lines_bounding_cubic(c0, c1, c2, c3)
            lows += [lower_start - rounding, lower_end - rounding]
            highs += [upper_start + rounding, upper_end + rounding]
        # The lowest and the highest line, by their values at both ends.
        return (
            _parabola_of_slopes(_minimum_or_inf(*lows[::2]), _minimum_or_inf(*lows[1::2]), h),
            _parabola_of_slopes(_maximum_or_inf(*highs[::2]), _maximum_or_inf(*highs[1::2]), h),
        )

    def _bound_coefficients(self) -> list[tuple[Real, Real, Real, Real]]:
        """The bounds of this function from which products are formed.

        In general, two tuples (a, b, 0, 0) for the parabolas below and above. For a polynomial a
        single tuple (a, b, radius of a, radius of b) for the parabola in the middle, from which
        both differ by rounding alone.
        """
        if self.polynomial_degree is None:
            return [(*self.lower, 0.0, 0.0), (*self.upper, 0.0, 0.0)]
        a, ra = _midpoint_and_half_width(self.lower[0], self.upper[0])
        b, rb = _midpoint_and_half_width(self.lower[1], self.upper[1])
        return [(a, b, ra, rb)]

    # Functions.

    def apply(self, function: ElementaryFunction) -> ParabolaBounds:
        """The composition phi(f) of an elementary function phi with this function f, by the tighter
        of two proofs on each side. If f is a constant, so is phi(f). If phi is a clipped power
        max(t, 0)^n and f a polynomial, see `_clipped_power`.

        Chords. Let x = f(s) - f(0), which is between x- and x+. Then phi(f(0) + x) - phi(f(0)) = m
        x, where m is the slope of a chord of phi from f(0). m lies in the range of phi' and, for
        convex phi, between the slopes of the chords to x- and to x+. For a convex phi these two
        chords give the upper bound. The tangent at f(0) gives the lower bound, as phi lies above
        it. For concave phi the two are exchanged. So the two parabolas of f, times the two ends of
        the range of m, bound phi(f) - phi(f(0)). One parabola bounds these four
        (`_common_upper_bound`).

        Taylor. The same difference is phi'(f(0)) x + phi''(z) x^2/2 for some z. Here x^2 is between
        s^2 times the squares of the slopes of f's own chords.
        """
        if self.polynomial_degree == 0:
            value = function.ranges(as_backend_interval(self.value, self.piece_length))[0]
            return self._new(value, (0.0, 0.0), (0.0, 0.0), 0)
        if isinstance(function, ClippedPower) and self.polynomial_degree is not None:
            return self._clipped_power(function)
        lower, upper = self.bounds
        h = self.piece_length
        start = as_backend_interval(self.value, h)
        min_change, max_change = -_maximum_on_piece(_negate(lower), h), _maximum_on_piece(upper, h)
        # At f(0), and on the range of f.
        value, slope, _ = function.ranges(start)
        _, slopes, curvature = function.ranges(
            Interval(
                (start + Interval(min_change, min_change)).lower,
                (start + Interval(max_change, max_change)).upper,
            )
        )
        # The slopes of the chords of phi from f(0) to the smallest and to the largest value of f.
        chords = [
            ((function.ranges(start + Interval(x, x))[0] - value) * Interval.point(x).reciprocal())
            for x in (min_change, max_change)
        ]
        slope_to_min, slope_to_max = (bound.intersect(slopes) for bound in chords)
        is_convex, is_concave = curvature.lower >= 0, curvature.upper <= 0

        # For a convex phi, x > 0 needs the upper chord and x < 0 the lower one.
        upper_slopes = (
            dr.select(
                is_concave, slope.lower, dr.select(is_convex, slope_to_min.lower, slopes.lower)
            ),
            dr.select(
                is_concave, slope.upper, dr.select(is_convex, slope_to_max.upper, slopes.upper)
            ),
        )
        lower_slopes = (
            dr.select(
                is_convex, slope.lower, dr.select(is_concave, slope_to_max.lower, slopes.lower)
            ),
            dr.select(
                is_convex, slope.upper, dr.select(is_concave, slope_to_min.upper, slopes.upper)
            ),
        )
        above = _common_upper_bound(
            [_scale(m, bound) for m in upper_slopes for bound in (lower, upper)], h
        )
        below = _common_lower_bound(
            [_scale(m, bound) for m in lower_slopes for bound in (lower, upper)], h
        )
        by_taylor = self._taylor_bounds(slope, curvature)
        if self.bound_degree == 1:
            by_taylor = _lines_bounding_parabolas(*by_taylor, h)
            below, above = _lines_bounding_parabolas(below, above, h)
        return self._new(
            value,
            _tighter_bound(below, by_taylor[0], h, -1),
            _tighter_bound(above, by_taylor[1], h, 1),
        )

    def _taylor_bounds(self, slope: Interval, curvature: Interval) -> tuple[Quadratic, Quadratic]:
        """Bounds of the composition phi(f) of an elementary function phi with this function f, by
        Taylor's formula; `apply` has the proof.

        slope: the range of phi' at f(0).
        curvature: the range of phi'' on the range of f.
        """
        linear_part = self._scaled(slope)
        (min_chord_slope, _), (max_chord_slope, _) = _lines_bounding_parabolas(
            self.lower, self.upper, self.piece_length
        )
        # x = f(s) - f(0) lies between s times these two slopes, so x^2 is s^2 times a square of
        # numbers between them.
        half_curvature = Interval(0.5 * curvature.lower, 0.5 * curvature.upper)
        remainder = half_curvature * Interval(min_chord_slope, max_chord_slope).square()
        # Rounded downwards (-1) and upwards (1).
        return (
            _sum(linear_part.lower, (0.0, remainder.lower), -1),
            _sum(linear_part.upper, (0.0, remainder.upper), 1),
        )

    def pointwise_maximum(self, other: Any) -> ParabolaBounds:
        """The maximum of this function f and another function g at each point.

        Proof. Let f(s) <= f(0) + F+(s), g(s) <= g(0) + G+(s) and V = max(f(0), g(0)). Above: f is
        at most V + (f(0) - V) + F+, and g at most V + (g(0) - V) + G+. One parabola bounds both
        (`_common_upper_bound`), unless one function is larger on the whole path. Below: the maximum
        is at least the function that is larger at s = 0.
        """
        f, g = self.value, other.value
        h = self.piece_length
        (f_low, f_high), (g_low, g_high) = self.bounds, other.bounds
        is_f_larger_at_start, is_g_larger_at_start = (
            (f - g).lower >= 0,
            (g - f).lower >= 0,
        )  # proved to be larger at 0
        below = _common_lower_bound([f_low, g_low], h)
        below = _select(is_f_larger_at_start, f_low, _select(is_g_larger_at_start, g_low, below))
        # Proved to be larger on the whole length: f's least is above g's largest. (-1: differences
        # are rounded downwards.)
        f_min_change, f_max_change = (
            -_maximum_on_piece(_negate(f_low), h),
            _maximum_on_piece(f_high, h),
        )
        g_min_change, g_max_change = (
            -_maximum_on_piece(_negate(g_low), h),
            _maximum_on_piece(g_high, h),
        )
        is_f_always_larger = (f - g).lower + _shift_by_rounding(
            f_min_change - g_max_change, -1, dr.abs(f_min_change) + g_max_change
        ) >= 0
        is_g_always_larger = (g - f).lower + _shift_by_rounding(
            g_min_change - f_max_change, -1, dr.abs(g_min_change) + f_max_change
        ) >= 0
        # f(0) - V and g(0) - V.
        offsets = fmin((f - g).upper, 0), fmin((g - f).upper, 0)
        above = _common_upper_bound([f_high, g_high], h, offsets)
        above = _select(is_f_always_larger, f_high, _select(is_g_always_larger, g_high, above))
        below = _select(is_f_always_larger, f_low, _select(is_g_always_larger, g_low, below))
        value = Interval(fmax(f.lower, g.lower), fmax(f.upper, g.upper))
        return self._new(value, below, above)

    def polar_angle(self, x: Any) -> ParabolaBounds:
        """The polar angle atan2(y, x) of the point z = (x, y), where y is this function and x
        another one. Its change along the path is that of the angle relative to a fixed direction,
        which is about that of z at the start (`relative_angle`). Where that is not proved, nothing
        is known beyond the start: the bounds are infinite.
        """
        h = self.piece_length
        v, u = (as_backend_interval(bounds.value, h) for bounds in (self, x))
        value, _ = angle_range(v, u)
        relative, is_valid, _, _ = relative_angle(self, x, v.midpoint, u.midpoint)
        zero = 0 * h
        return self._new(
            value,
            _select(is_valid, relative.lower, (zero - dr.inf, zero)),
            _select(is_valid, relative.upper, (zero + dr.inf, zero)),
        )

    @property
    def range(self) -> Interval:
        """The range of the function on the whole path: its value at s = 0 plus the extremes of the
        two parabolas."""
        # How far the function may fall below its value at the start, and rise above it.
        h, value = self.piece_length, as_backend_interval(self.value, self.piece_length)
        max_fall, max_rise = (
            _maximum_on_piece(_negate(self.lower), h),
            _maximum_on_piece(self.upper, h),
        )
        return Interval(
            (value + Interval(-max_fall, -max_fall)).lower,
            (value + Interval(max_rise, max_rise)).upper,
        )

    def _clipped_power(self, function: ClippedPower) -> ParabolaBounds:
        """The function max(f, 0)^n of a polynomial f of degree at most 2, on the path [0, h].

        function: the function t -> max(t, 0)^n.

        f = v + a s + b s^2 is known up to rounding: v, a and b below are the middles of narrow
        ranges, whose half widths are rv, ra and rb. `value_error` bounds |f - (v + a s + b s^2)| on
        [0, h], and also the rounding of this sum.

        Proof. If f is concave, f > 0 on at most one interval [s0, s1] of [0, h] (`start`, `end`).
        There f^n is a product, computed as one on that interval. Elsewhere f^n counts as 0, and its
        derivative is 0.

        If the bounds are parabolas, the derivative of the product lies between two lines. Raise the
        upper line, if necessary, to at least 0 at both ends of [0, h]. As a line, it is then at
        least 0 on all of [0, h], and still above the derivative on [s0, s1]. So its integral is an
        upper bound; the lower bound is found in the same way (`_extend_parabolas`). If the bounds
        are lines, `_extend_lines` has the proof.

        Because of rounding, f may be positive outside of the computed [s0, s1], but is at most r =
        2 `value_error` there. The derivative of f^n is then at most `outer_slope`, n r^(n-1) (|a| +
        2 |b| h), which is used in place of 0. If there is no interval at all, it is the bound on
        [0, h]. If f is convex, the general bounds of `apply` are used.

        Source: Aydinlilar and Zanni 2023, section 6.2.1, with a corrected extension to [0, h].
        """
        h = self.piece_length
        (a, ra), (b, rb) = (
            _midpoint_and_half_width(self.lower[k], self.upper[k]) for k in range(2)
        )
        v, rv = _midpoint_and_radius(self.value)
        size = dr.abs(v) + dr.abs(a) * h + dr.abs(b) * h * h
        value_error = _rounding_bound(size) + rv + ra * h + rb * h * h
        # The roots of v + a s + b s^2, b < 0, without cancellation.
        discriminant = a * a - 4 * b * v
        discriminant_root = dr.sqrt(fmax(discriminant, 0))
        q = -0.5 * (a + dr.select(a >= 0, discriminant_root, -discriminant_root))
        root_1, root_2 = q / b, v / q
        root_1 = dr.select(dr.isfinite(root_1), root_1, 0)
        root_2 = dr.select(dr.isfinite(root_2), root_2, 0)
        start, end = clamp(fmin(root_1, root_2), 0, h), clamp(fmax(root_1, root_2), 0, h)
        # If there is no interval, all of [0, h] stands for it, so that nothing is divided by 0; the
        # result is replaced below.
        is_empty = (discriminant <= 0) | (end <= start)
        start, end = dr.select(is_empty, 0, start), dr.select(is_empty, h, end)

        n = function.exponent
        # f as a polynomial of the length from `start`: its value, slope and b.
        start_value = fmax(v + start * (a + b * start), 0)
        start_slope = a + 2 * b * start
        inner_power = ParabolaBounds(
            Interval(fmax(start_value - value_error, 0), start_value + value_error),
            (
                start_slope - _rounding_bound(dr.abs(a) + 2 * dr.abs(b) * h) - ra - 2 * rb * h,
                b - rb,
            ),
            (
                start_slope + _rounding_bound(dr.abs(a) + 2 * dr.abs(b) * h) + ra + 2 * rb * h,
                b + rb,
            ),
            end - start,
            self.bound_degree,
            2,
        )._power_by_squaring(n)
        # The value at s = 0, and the bounds on all of [0, h].
        value, _, _ = function.ranges(as_backend_interval(self.value, h))
        outer_slope = n * (2 * value_error) ** (n - 1) * (dr.abs(a) + ra + 2 * (dr.abs(b) + rb) * h)
        is_cut = (start > 0) | (end < h)
        if self.bound_degree == 1:
            lower, upper = inner_power._extend_lines(start, end, h, value, is_cut, outer_slope)
        else:
            lower, upper = inner_power._extend_parabolas(start, h, is_cut, outer_slope)
        lower = _select(is_empty, (-outer_slope, 0.0), lower)
        upper = _select(is_empty, (outer_slope, 0.0), upper)
        # Without its polynomial degree f is bounded like any other function.
        general = ParabolaBounds(self.value, self.lower, self.upper, h, self.bound_degree)
        general = ParabolaBounds.apply(general, function)
        is_concave = b + rb < 0
        return self._new(
            value,
            _select(is_concave, lower, general.lower),
            _select(is_concave, upper, general.upper),
        )

    def _extend_parabolas(
        self, start: Real, length: Real, is_cut: Any, tail: Real
    ) -> tuple[Quadratic, Quadratic]:
        """Extend the parabolas that bound this function on an interval to parabolas that bound the
        extended function on [0, length].

        This function is known on an interval that begins at `start`; the s of its bounds counts
        from there. The extended function equals it on the interval and is constant before and after
        it.

        is_cut: whether the interval is not all of [0, length].
        tail: a bound of the derivative outside of the interval, which rounding may cause.

        The derivative of a bound is a line. It is moved to the safe side of 0 at both ends of [0,
        length], because the derivative of the extended function is 0 outside of the interval.
        """
        bounds: list[Quadratic] = []
        for sign, (a, b) in ((-1, self.lower), (1, self.upper)):
            # The derivative of the bound, continued to 0 and to `length`.
            at_start = a - 2 * b * start
            at_end = a + 2 * b * (length - start)
            rounding = _rounding_bound(dr.abs(a) + 2 * dr.abs(b) * length) + tail
            slopes = [slope + sign * rounding for slope in (at_start, at_end)]
            safe_extreme = _maximum_or_inf if sign > 0 else _minimum_or_inf
            slopes = [
                dr.select(is_cut, safe_extreme(slope, 0 * slope), slope) * length
                for slope in slopes
            ]
            bounds.append(_parabola_of_slopes(slopes[0], slopes[1], length))
        return bounds[0], bounds[1]

    def _extend_lines(
        self, start: Real, end: Real, length: Real, value: Interval, is_cut: Any, tail: Real
    ) -> tuple[Quadratic, Quadratic]:
        """Extend the lines that bound this function on an interval [start, end] to lines that bound
        the extended function on [0, length].

        This function is known on the interval. The extended function equals it there; it is
        constant before the interval, and 0 behind it.

        value: the range of the extended function at s = 0.
        is_cut: whether the interval is not all of [0, length].
        tail: a bound of the derivative outside of the interval, which rounding may cause.

        Proof. Let the change be the function minus its value at s = 0. Before `start` it is 0. So a
        line from 0 at s = 0 to the upper bound at `end` lies above it. Behind `end` the function is
        0, that is, the change is -value. A line of slope at least -value/s is above -value at s;
        slope -value/length is enough for all s >= end. Likewise slope -value/end is small enough to
        be below -value for all s >= end.
        """
        # (Factors a little above 1 allow for rounding.)
        (low_slope, _), (high_slope, _) = self.bounds
        length_fraction = (end - start) / end * (1 + 8 * machine_epsilon(length))
        slope_behind = -(value.lower / length)
        slope_behind = slope_behind + _rounding_bound(dr.abs(slope_behind))
        has_part_before = start > 0
        # The line from 0 at s = 0 to the bound at `end`, where the change is the slope times end -
        # start.
        high_slope = dr.select(
            has_part_before,
            _maximum_or_inf(high_slope, 0 * high_slope) * length_fraction,
            high_slope,
        )
        low_slope = dr.select(
            has_part_before, _minimum_or_inf(low_slope, 0 * low_slope) * length_fraction, low_slope
        )
        # If there is a part behind `end`, the line is above -value on it.
        high_slope = dr.select(end < length, _maximum_or_inf(high_slope, slope_behind), high_slope)
        low_slope = dr.select(
            end < length, _minimum_or_inf(low_slope, -(value.upper / end) * (1 + 1e-6)), low_slope
        )
        # The derivative that rounding may cause outside of the interval.
        margin = dr.select(is_cut, tail, 0)
        return (low_slope - margin, 0.0), (high_slope + margin, 0.0)


def _lines_bounding_cubic(c0: Real, c1: Real, c2: Real, c3: Real) -> tuple[Real, Real, Real, Real]:
    """Lines below and above the cubic c0 + c1 r + c2 r^2 + c3 r^3 for r on [0, 1].

    Returns l0, l1, u0, u1: the values of the lower line at 0 and 1, and of the upper line at 0 and
    1.

    Proof. The inflection t divides [0, 1] into two parts, or into one if t is outside. On each part
    the cubic is convex or concave. So it lies there between a chord and the tangent at 0 (first
    part) or at t (second part). The line through the larger values of two lines at 0 and 1 is above
    both. If rounding mistakes the sign of a second derivative, that derivative is as small as its
    rounding error.
    """
    # (NaN or infinite for c3 = 0: then it is outside.)
    t = -c2 / (3 * c3)
    is_divided = (t > 0) & (t < 1)
    t = dr.select(is_divided, t, 1)

    # On [0, t]: the slope of the chord; the tangent at 0 has the slope c1.
    chord = c1 + t * (c2 + t * c3)
    # By half the second derivative in the middle of the part.
    is_convex = c2 + 1.5 * c3 * t >= 0
    u0 = l0 = c0
    u1 = c0 + dr.select(is_convex, chord, c1)
    l1 = c0 + dr.select(is_convex, c1, chord)

    # On [t, 1]: the value and the slope of the tangent at t, and the slope of the chord to 1.
    value = c0 + t * (c1 + t * (c2 + t * c3))
    tangent = c1 + t * (2 * c2 + 3 * c3 * t)
    chord = c1 + c2 * (1 + t) + c3 * (1 + t * (1 + t))
    is_convex = c2 + 1.5 * c3 * (1 + t) >= 0
    upper_slope = dr.select(is_convex, chord, tangent)
    lower_slope = dr.select(is_convex, tangent, chord)
    u0 = dr.select(is_divided, fmax(u0, value - upper_slope * t), u0)
    u1 = dr.select(is_divided, fmax(u1, value + upper_slope * (1 - t)), u1)
    l0 = dr.select(is_divided, fmin(l0, value - lower_slope * t), l0)
    l1 = dr.select(is_divided, fmin(l1, value + lower_slope * (1 - t)), l1)
    return l0, l1, u0, u1


def _lines_bounding_parabolas(
    lower: Quadratic, upper: Quadratic, h: Real
) -> tuple[Quadratic, Quadratic]:
    """A line below the parabola `lower` and one above the parabola `upper` for s on [0, h], each as
    (slope, 0). A parabola is the pair (a, b) for a s + b s^2.

    A parabola through 0 lies between its tangent at 0, of the slope a, and its chord to h, of the
    slope a + b h.
    """
    (a, b), (c, d) = lower, upper
    if _is_zero(b) and _is_zero(d):
        return lower, upper
    # Rounded downwards (-1) and upwards (1).
    low = _minimum_or_inf(a, _shift_by_rounding(a + b * h, -1, dr.abs(a) + dr.abs(b) * h))
    high = _maximum_or_inf(c, _shift_by_rounding(c + d * h, 1, dr.abs(c) + dr.abs(d) * h))
    return (low, 0.0), (high, 0.0)


def _parabola_of_slopes(at_start: Real, at_end: Real, length: Real) -> Quadratic:
    """The parabola a s + b s^2, as (a, b), whose derivative has given values at both ends of [0,
    length].

    at_start, at_end: `length` times the derivative at 0 and at `length`.
    """
    nonempty = length > 0
    a = dr.select(nonempty, at_start / length, 0)
    b = dr.select(nonempty, (at_end - at_start) / (2 * length * length), 0)
    return a, b


def _common_upper_bound(
    parabolas: list[Quadratic], length: Real, offsets: tuple[Real, ...] = ()
) -> Quadratic:
    """A parabola a s + b s^2, as (a, b), that is above several parabolas for s on [0, length].

    parabolas: the parabolas, as pairs (a, b).
    offsets: a number c <= 0 for each, for the parabola c + a s + b s^2; by default 0.

    Proof. On [0, h] the value of c + a s + b s^2 is a weighted mean, with weights >= 0, of the
    control values c, c + a h/2 and c + a h + b h^2 (Bernstein 1912). So larger control values make
    a larger parabola.
    """
    h = length
    middle_controls: list[Real] = []
    last_controls: list[Real] = []
    for k, (a, b) in enumerate(parabolas):
        offset = offsets[k] if offsets else 0.0
        linear_term, quadratic_term = a * h, b * h * h
        rounding = _rounding_bound(
            dr.abs(offset) + dr.abs(linear_term) + dr.abs(quadratic_term) + 0 * h
        )
        middle_controls.append(offset + 0.5 * linear_term + rounding)
        last_controls.append(offset + (linear_term + quadratic_term) + rounding)
    middle_control, last_control = (
        _maximum_or_inf(*middle_controls),
        _maximum_or_inf(*last_controls),
    )
    rounding = _rounding_bound(dr.abs(middle_control) + dr.abs(last_control))
    nonempty = h > 0
    # The parabola with the control values 0, middle and last.
    a = dr.select(nonempty, 2 * middle_control / h, 0)
    b = dr.select(nonempty, (last_control - 2 * middle_control + rounding) / (h * h), 0)
    return a + _rounding_bound(dr.abs(a)), b


def _common_lower_bound(parabolas: list[Quadratic], length: Real) -> Quadratic:
    """A parabola a s + b s^2, as (a, b), that is below several parabolas for s on [0, length]."""
    return _negate(_common_upper_bound([_negate(parabola) for parabola in parabolas], length))


def _tighter_bound(first: Quadratic, second: Quadratic, length: Real, sign: int) -> Quadratic:
    """The tighter of the bounds `first` and `second`, which are on the same side, compared at one
    point of [0, length]. If one bound is NaN, it is the other bound. A bound is a parabola (a, b)
    for a s + b s^2.

    sign: 1 for upper bounds, -1 for lower bounds.
    """
    r = _COMPARED_AT * length
    first_value, second_value = (sign * r * (a + b * r) for a, b in (first, second))
    return _select((first_value <= second_value) | ~dr.isfinite(second_value), first, second)


def _maximum_on_piece(q: Quadratic, length: Real) -> Real:
    """An upper bound of the parabola a s + b s^2 for s on [0, length], at least 0; infinite if it
    is NaN.

    q: (a, b).
    """
    a, b = q
    if _is_zero(a) and _is_zero(b):
        return 0 * length
    # The largest value is at 0, at the end, or at the vertex if the parabola rises to it and then
    # falls on the way: there it is -a^2/(4b).
    end_value = length * (a + b * length)
    end_value = end_value + _rounding_bound(length * (dr.abs(a) + dr.abs(b) * length))
    has_vertex = (b < 0) & (a > 0) & (a + 2 * b * length < 0)
    vertex_value = a * (a / (-4 * b))
    vertex_value = dr.select(has_vertex, vertex_value + _rounding_bound(dr.abs(vertex_value)), 0)
    return _maximum_or_inf(0 * length, end_value, vertex_value)


def _sum(first: Quadratic, second: Quadratic, sign: int) -> Quadratic:
    """The sum of the parabolas `first` and `second`, each a pair (a, b), rounded upwards (sign 1)
    or downwards (sign -1)."""

    def plus(x: Real, y: Real) -> Real:
        """The sum of two coefficients, rounded up or down as `sign` says (1 for up); exact if one
        is the Python number 0."""
        if _is_zero(y):
            return x
        # (0.0: no size besides that of the sum. The rounding of x and y is in them already.)
        return y if _is_zero(x) else _shift_by_rounding(x + y, sign, 0.0)

    return plus(first[0], second[0]), plus(first[1], second[1])


def _scale(m: Real, q: Quadratic) -> Quadratic:
    """The parabola q = (a, b) times the number m, without rounding outwards."""
    return m * q[0], m * q[1]


def _negate(q: Quadratic) -> Quadratic:
    """The parabola (-a, -b) for q = (a, b)."""
    return -q[0], -q[1]


def _select(mask: Any, first: Quadratic, second: Quadratic) -> Quadratic:
    """The first parabola on lanes where the mask is set, the second one on all others."""
    return dr.select(mask, first[0], second[0]), dr.select(mask, first[1], second[1])


def _midpoint_and_half_width(low: Real, high: Real) -> tuple[Real, Real]:
    """The middle of the interval from `low` to `high`, and an upper bound of the distance of its
    ends from the middle."""
    if low is high or (_is_zero(low) and _is_zero(high)):
        return low, 0.0
    middle = 0.5 * low + 0.5 * high
    return middle, _shift_by_rounding(0.5 * high - 0.5 * low, 1, dr.abs(middle))


def _midpoint_and_radius(x: Interval) -> tuple[Real, Real]:
    """The middle of an interval, and an upper bound of the distance of its numbers from the
    middle."""
    return x.midpoint, _radius(x)


def _radius(x: Interval) -> Real:
    """An upper bound of the distance of an interval's numbers from its rounded middle."""
    if x.lower is x.upper or x.is_zero:
        return 0.0
    radius = x.radius
    return radius if isinstance(radius, float) else radius + _rounding_bound(dr.abs(x.midpoint))


def _is_zero(x: Real) -> bool:
    """Whether x is the Python number 0.0, which is known while Dr.Jit records code."""
    return isinstance(x, float) and x == 0.0


def _shift_by_rounding(x: Real, sign: int, size: Real) -> Real:
    """x, moved up (sign 1) or down (sign -1) by a bound of its rounding error.

    size: the sum of the absolute values of the numbers from which x was computed.
    """
    return x + sign * _rounding_bound(dr.abs(x) + size)


def _rounding_bound(size: Real) -> Real:
    """A bound of the errors by rounding and underflow in a computed sum.

    size: the sum of the absolute values of its terms. The Python number 0.0 stands for a sum that
        is exact.
    """
    if isinstance(size, float):
        assert size == 0.0
        return 0.0
    smallest = float(dr.smallest(cast("Any", type(size))))
    return dr.fma(size, _ROUNDINGS * machine_epsilon(size), _ROUNDINGS * smallest)


def _maximum_or_inf(*numbers: Real) -> Real:
    """The largest number; infinite if one is NaN."""
    largest, total = numbers[0], numbers[0]
    for number in numbers[1:]:
        largest, total = fmax(largest, number), total + number
    return dr.select(total == total, largest, dr.inf)


def _minimum_or_inf(*numbers: Real) -> Real:
    """The smallest number; minus infinity if one is NaN."""
    return -_maximum_or_inf(*(-number for number in numbers))
