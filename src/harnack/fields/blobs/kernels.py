"""Kernels of blobs: functions of the distance from the center, with their derivatives along lines.
A blob is a bump around a center that ends at a certain distance, the radius of its support. A
kernel is the shape of the bump: a function k(q) of the squared distance q from the center, with
lengths in units of the support's radius. It falls from the center to 0 at q = 1, where it ends with
dk/dq = 0. Take a line that passes the center at the distance h. Its chord is the part inside the
support, of half length S with S^2 = 1 - h^2. Let x be the position on the line, measured from the
point nearest to the center; then the kernel along the line is f(x) = k(h^2 + x^2) for |x| <= S.

The derivatives of f have the same shape for all kernels, and the proofs rest on it:

- f' is odd. For x > 0 it falls to a single minimum at x = c1, then rises to 0 at S.
- f'' is even. It rises from a minimum at 0 to a single maximum at c2, then falls until S.

So the ends of their ranges on any piece of the line are among the values at the two ends of the
piece and three numbers that depend on the chord: f'(-c1), f''(0) and f''(c2). At S, f'' of some
kernels jumps to 0 (`second_derivative_jumps`).
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr
import numpy as np

from harnack.arithmetic import ElementaryFunction, Interval
from harnack.arithmetic.interval import machine_epsilon
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_real
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real


@dataclass(frozen=True)
class ChordProfile:
    """The largest and smallest values of the first two derivatives of a kernel along a line, and
    the positions at which they are taken. Positions x are measured along the line from the point
    nearest to the kernel's center, in units of the support's radius.

    half_length: S, half the length of the line's part inside the support, which is |x| <= S; 0 if
        the line misses the support.
    steepest_position: c1 >= 0. The first derivative has its maximum at x = -c1 and its minimum at
        c1.
    steepest: the maximum of the first derivative; the minimum is minus this number.
    max_curvature_position: c2 >= 0. The second derivative has its maximum at x = -c2 and at c2.
    max_second: the maximum of the second derivative.
    min_second: the minimum of the second derivative, which is taken at x = 0.
    """

    half_length: Real
    steepest_position: Real
    steepest: Real
    max_curvature_position: Real
    max_second: Real
    min_second: Real


@dataclass(frozen=True)
class KernelLipschitz:
    """Lipschitz constants of a kernel and of its first two derivatives along lines. Bounds of
    rounding use them: if rounding displaces the line, or the position on it, by a length e, the
    number changes by at most its constant times e. Lengths are in units of the support's radius.

    value: the constant of the kernel k.
    slope: the constant of the first derivative along a line; also a bound of |grad k|.
    bend: the constant of the second derivative along a line. The jump of the second derivative at
        the end of the support is not included.
    """

    value: float
    slope: float
    bend: float


class BlobKernel(abc.ABC):
    """The shape of a blob: a function k(q) of the squared distance q from the blob's center, in
    units of the support's radius; it is 0 for q >= 1, the outside of the support. Along a line at
    the distance h from the center, at the position x from the line's point nearest to it, q = h^2 +
    x^2. The part of the line inside the support is |x| <= S with S^2 = 1 - h^2. A blob of weight 1
    is the kernel times `amplitude`, so that it has the value 1 at the blob's radius, which is
    smaller than the radius of the support."""

    name: ClassVar[str]
    second_derivative_jumps: ClassVar[bool] = True
    """Whether the second derivative along a line jumps where the support ends."""

    @property
    @abc.abstractmethod
    def support(self) -> float:
        """The radius of the support, at which a blob ends, divided by the radius of the blob."""

    @property
    @abc.abstractmethod
    def steepness(self) -> KernelLipschitz:
        """The Lipschitz constants of the kernel and of its first two derivatives along lines."""

    @abc.abstractmethod
    def height(self, q: FloatArray) -> FloatArray:
        """The kernel's values k(q), as a NumPy array in double precision. q: squared distances from
        the center, in units of the support's radius."""

    @abc.abstractmethod
    def profile(self, q: Real) -> tuple[Real, Real, Real]:
        """The kernel at a squared distance from the center, in units of the support's radius, as
        three numbers: the value k(q); the derivative dk/dq; and a number m for the bound of the
        rounding. The error of the computed k is at most 16 unit roundoffs times (m + |dk/dq|)."""

    @abc.abstractmethod
    def second_derivative(self, q: Real) -> Real:
        """The second derivative of the kernel k(q) by the squared distance q."""

    @abc.abstractmethod
    def chord(self, height_squared: Real, half_chord_squared: Real) -> ChordProfile:
        """The extreme values of the kernel's first two derivatives along lines, one line for each
        lane. Lengths are in units of the support's radius.

        height_squared: h^2 <= 1, with h the distance of the line from the kernel's center.
        half_chord_squared: S^2 = 1 - h^2 >= 0, with S half the length of the line's part inside the
            support.
        """

    @abc.abstractmethod
    def derivatives(
        self, height_squared: Real, half_chord_squared: Real, x: Real
    ) -> tuple[Real, Real]:
        """The first and the second derivative of the kernel along lines, at the position x. Lengths
        are in units of the support's radius.

        height_squared: h^2 <= 1, with h the distance of the line from the kernel's center.
        half_chord_squared: S^2 = 1 - h^2 >= 0, with S half the length of the line's part inside the
            support.
        x: the position on the line, from the point nearest to the center; |x| <= S.
        """

    def lipschitz_fraction(self, half_chord_squared: Real, nearest: Real) -> Real:
        """A factor by which the Lipschitz constants `steepness` may be multiplied on a part of a
        line, where the kernel may be less steep than elsewhere. It is at most 1; by default it is
        1. Lengths are in units of the support's radius.

        half_chord_squared: S^2, with S half the length of the line's part inside the support.
        nearest: a lower bound of x^2 on the part, with x the position on the line from the point
            nearest to the kernel's center.
        """
        del half_chord_squared, nearest
        return 1.0

    @abc.abstractmethod
    def derivative_ranges(self, q: Interval) -> tuple[Interval, Interval, Interval]:
        """Intervals that contain all values of the kernel k(q), of dk/dq and of d2k/dq2 (three
        intervals) for squared distances q >= 0 in an interval."""

    def on_backend(self, backend: Backend) -> BlobKernel:
        """This kernel with its numbers as Dr.Jit arrays of the backend that are not literals:
        Dr.Jit then need not compile its code again if they change. By default the kernel itself,
        for kernels without such numbers."""
        del backend
        return self

    @property
    def amplitude(self) -> float:
        """The factor of the kernel in a blob of weight 1, which makes the blob's value 1 at the
        blob's radius: one over k at that radius, where q = 1/support^2."""
        return 1.0 / float(self.height(np.array([self.support**-2.0]))[0])

    def function(self) -> ElementaryFunction:
        """The kernel as an `ElementaryFunction` of q, which can be applied to a jet (ranges of a
        function and of its derivatives)."""
        return ElementaryFunction(
            self.name, self.derivative_ranges, lambda q: self.profile(q)[0], self.height
        )


@dataclass(frozen=True)
class CompactKernel(BlobKernel):
    """The compact polynomial kernel k = (1 - q)^3, where q is the squared distance from the center
    in units of the support's radius. Its second derivative is continuous (Aydinlilar and Zanni
    2023, eq. 7 with n = 6).

    support: the radius at which a blob ends, divided by the radius of the blob (at which a blob of
        weight 1 has the value 1).

    Let f(x) be the kernel along a line, at the position x from the point nearest to the center. The
    line's part inside the support is |x| <= S. With w = S^2 - x^2,

        f' = -6 x w^2,    f'' = 6 w (4 x^2 - w),    f''' = 24 x (3w - 2x^2).

    So f'' = 0 at x^2 = S^2/5, and f''' = 0 at x = 0 and at x^2 = 3 S^2/5.
    """

    support: float = 1.6  # pyright: ignore[reportIncompatibleMethodOverride]
    name = "compact"
    second_derivative_jumps = False

    def __post_init__(self) -> None:
        _check_support(self.support)

    @property
    def steepness(self) -> KernelLipschitz:
        return KernelLipschitz(5.0, 12.0, 90.0)

    def height(self, q: FloatArray) -> FloatArray:
        return np.maximum(1 - q, 0) ** 3

    def profile(self, q: Real) -> tuple[Real, Real, Real]:
        w = fmax(1 - q, 0)
        squared = w * w
        k = squared * w
        return k, -3 * squared, k

    def second_derivative(self, q: Real) -> Real:
        return 6 * fmax(1 - q, 0)

    def chord(self, height_squared: Real, half_chord_squared: Real) -> ChordProfile:
        """The extreme values of the kernel's first two derivatives along lines, with lengths in
        units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center; not used, as S^2 = 1 -
            h^2.
        half_chord_squared: S^2, with S half the length of the line's part inside the support.

        Proof. f' is largest where f'' = 0, at x^2 = S^2/5; there w = S^2 - x^2 = 4/5 S^2, and |f'|
        = 6 |x| w^2 = 3.84 S^4 |x|. f'' is largest where f''' = 0, at x^2 = 3/5 S^2; there f'' = 4.8
        S^4.
        """
        half_length, fourth_power = (
            dr.sqrt(half_chord_squared),
            half_chord_squared * half_chord_squared,
        )
        steepest_x = math.sqrt(0.2) * half_length
        # Half the chord; the largest |f'| and the largest f'', each as position and size; the
        # smallest f''.
        return ChordProfile(
            half_length,
            steepest_x,
            3.84 * fourth_power * steepest_x,
            math.sqrt(0.6) * half_length,
            4.8 * fourth_power,
            -6 * fourth_power,
        )

    def derivatives(
        self, height_squared: Real, half_chord_squared: Real, x: Real
    ) -> tuple[Real, Real]:
        square = x * x
        w = half_chord_squared - square
        return -6 * x * (w * w), 6 * w * dr.fma(4, square, -w)

    def derivative_ranges(self, q: Interval) -> tuple[Interval, Interval, Interval]:
        """Intervals that contain all values of the kernel k(q), of dk/dq and of d2k/dq2 (three
        intervals) for q in an interval. With w = max(1 - q, 0) they are w^3, -3 w^2 and 6 w. Each
        is monotone in w, so its values at the ends of w, moved outwards for rounding, are the ends
        of its interval."""
        w = _one_minus(q)
        epsilon = machine_epsilon(w.lower)
        return (
            _widened_range(w.lower * w.lower * w.lower, w.upper * w.upper * w.upper, 4 * epsilon),
            _widened_range(-3 * w.upper * w.upper, -3 * w.lower * w.lower, 4 * epsilon),
            _widened_range(6 * w.lower, 6 * w.upper, 2 * epsilon),
        )


@dataclass(frozen=True)
class SexticKernel(BlobKernel):
    """The sextic kernel of soft objects, k = 1 - 22/9 q + 17/9 q^2 - 4/9 q^3, where q is the
    squared distance from the center in units of the support's radius. With w = 1 - q it is w^2 (5 +
    4w)/9 (Wyvill, McPheeters and Wyvill 1986; Hart 1996, appendix D).

    support: the radius at which a blob ends, divided by the radius of the blob (at which a blob of
        weight 1 has the value 1).

    Let f(x) be the kernel along a line, at the position x from the point nearest to the center. The
    line's part inside the support, the chord, is |x| <= S. With w = S^2 - x^2,

        f' = -4/9 x w (5 + 6w),    f'' = -4/9 w (5 + 6w) + 8/9 x^2 (5 + 12w),
        f''' = 4/9 x (15 + 36w - 24x^2).

    So f''' = 0 at x = 0 and at x^2 = 1/4 + 3/5 S^2. If that second position lies outside of the
    chord, f'' rises from x = 0 to the end x = S of the chord. f'' = 0 is a quadratic equation in
    x^2. The sum of its roots is 1/2 + 6/5 S^2, and their product is S^2 (5 + 6 S^2)/30; the larger
    root lies outside of the chord.
    """

    support: float = 2.0  # pyright: ignore[reportIncompatibleMethodOverride]
    name = "sextic"

    def __post_init__(self) -> None:
        _check_support(self.support)

    @property
    def steepness(self) -> KernelLipschitz:
        return KernelLipschitz(4.0, 10.0, 60.0)

    def height(self, q: FloatArray) -> FloatArray:
        w = np.maximum(1 - q, 0)
        return w * w * (5 + 4 * w) / 9

    def profile(self, q: Real) -> tuple[Real, Real, Real]:
        w = fmax(1 - q, 0)
        k = w * w * dr.fma(4 / 9, w, 5 / 9)
        return k, -w * dr.fma(4 / 3, w, 10 / 9), k

    def second_derivative(self, q: Real) -> Real:
        return dr.select(q < 1, dr.fma(8 / 3, 1 - q, 10 / 9), 0)

    def chord(self, height_squared: Real, half_chord_squared: Real) -> ChordProfile:
        """The extreme values of the kernel's first two derivatives along lines, with lengths in
        units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center.
        half_chord_squared: S^2 = 1 - h^2, with S half the length of the line's part inside the
            support.

        f' is largest at a zero of f''. There x^2 is the smaller root of a quadratic equation, whose
        roots have the sum 1/2 + 6/5 S^2 and the product S^2 (5 + 6 S^2)/30. f'' is largest at x^2 =
        1/4 + 3/5 S^2, or at x = S if that is nearer.
        """
        root_sum = dr.fma(1.2, half_chord_squared, 0.5)
        root_product = half_chord_squared * dr.fma(0.2, half_chord_squared, 1 / 6)
        # The smaller root, as the product over the larger one: nothing cancels.
        steepest_x = dr.sqrt(
            2 * root_product / (root_sum + dr.sqrt(fmax(root_sum * root_sum - 4 * root_product, 0)))
        )
        peak_x = dr.sqrt(fmin(dr.fma(0.6, half_chord_squared, 0.25), half_chord_squared))
        min_first, _ = self.derivatives(height_squared, half_chord_squared, steepest_x)
        _, max_second = self.derivatives(height_squared, half_chord_squared, peak_x)
        # Half the chord; the largest |f'| and the largest f'', each as position and size; the
        # smallest f''.
        return ChordProfile(
            dr.sqrt(half_chord_squared),
            steepest_x,
            -min_first,
            peak_x,
            max_second,
            -half_chord_squared * dr.fma(8 / 3, half_chord_squared, 20 / 9),
        )

    def derivatives(
        self, height_squared: Real, half_chord_squared: Real, x: Real
    ) -> tuple[Real, Real]:
        """The first and the second derivative of the kernel along lines, at the position x from the
        point nearest to the center. Lengths are in units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center; not used, as S^2 = 1 -
            h^2.
        half_chord_squared: S^2, with S half the length of the line's part inside the support.
        """
        square = x * x
        w = half_chord_squared - square
        part = w * dr.fma(8 / 3, w, 20 / 9)
        return -x * part, dr.fma(square, dr.fma(32 / 3, w, 40 / 9), -part)

    def derivative_ranges(self, q: Interval) -> tuple[Interval, Interval, Interval]:
        """Intervals that contain all values of the kernel k(q), of dk/dq and of d2k/dq2 (three
        intervals) for q in an interval. For q < 1 each of the three is monotone in q, so its values
        at the ends of q, moved outwards for rounding, are the ends of its interval."""
        w = _one_minus(q)
        epsilon = machine_epsilon(w.lower)

        def value_at(w: Real) -> Real:
            """The kernel k(q) as a function of w = 1 - q."""
            return w * w * (4 / 9 * w + 5 / 9)

        def slope_at(w: Real) -> Real:
            """The derivative dk/dq as a function of w = 1 - q."""
            return -w * (4 / 3 * w + 10 / 9)

        second = _widened_range(8 / 3 * w.lower + 10 / 9, 8 / 3 * w.upper + 10 / 9, 4 * epsilon)
        return (
            _widened_range(value_at(w.lower), value_at(w.upper), 6 * epsilon),
            _widened_range(slope_at(w.upper), slope_at(w.lower), 6 * epsilon),
            _range_with_support_end(second, q),
        )


@dataclass(frozen=True)
class CubicKernel(BlobKernel):
    """The cubic kernel of soft objects, k = 1 - 3 r^2 + 2 r^3 = (1 - r)^2 (1 + 2r), where r =
    sqrt(q) is the distance from the center in units of the support's radius (Hart 1996, eq. 36).

    support: the radius at which a blob ends, divided by the radius of the blob (at which a blob of
        weight 1 has the value 1).

    Let f(x) be the kernel on a line at the distance h from the center, at the position x from the
    point nearest to the center. With r^2 = h^2 + x^2,

        f' = -6 x (1 - r),    f'' = -6 (1 - r - x^2/r),    f''' = 6 x/r (3 - x^2/r^2).

    As |x| <= r, the third derivative is >= 0 for x >= 0. So f'' rises from x = 0 to the end of the
    line's part inside the support, which is its largest value. |f'| is largest at the zero of f'',
    where r + x^2/r = 1. This gives a quadratic equation for x^2, whose solution is x^2 = (1 - 4h^2
    + sqrt(1 + 8h^2))/8.
    """

    support: float = 2.0  # pyright: ignore[reportIncompatibleMethodOverride]
    name = "cubic"

    def __post_init__(self) -> None:
        _check_support(self.support)

    @property
    def steepness(self) -> KernelLipschitz:
        return KernelLipschitz(5.0, 12.0, 40.0)

    def height(self, q: FloatArray) -> FloatArray:
        r = np.sqrt(np.clip(q, 0, 1))
        return (1 - r) ** 2 * (1 + 2 * r)

    def profile(self, q: Real) -> tuple[Real, Real, Real]:
        # At the center the root would have an infinite slope.
        r = dr.sqrt(fmax(fmin(q, 1), float(dr.smallest(type(q)))))
        w = 1 - r
        k = w * w * dr.fma(2, r, 1)
        return k, -3 * w, k

    def second_derivative(self, q: Real) -> Real:
        return dr.select(q < 1, 1.5 / dr.sqrt(fmax(q, float(dr.smallest(type(q))))), 0)

    def chord(self, height_squared: Real, half_chord_squared: Real) -> ChordProfile:
        """The extreme values of the kernel's first two derivatives along lines, with lengths in
        units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center.
        half_chord_squared: S^2 = 1 - h^2, with S half the length of the line's part inside the
            support.

        f' is largest at the zero of f'', which has x^2 = (1 - 4h^2 + sqrt(1 + 8h^2))/8. f'' rises
        from 6 h - 6 at x = 0 to 6 S^2 at the end x = S.
        """
        half_length = dr.sqrt(half_chord_squared)
        steepest_x = dr.sqrt(
            fmax(1 + dr.sqrt(dr.fma(8, height_squared, 1)) - 4 * height_squared, 0) * 0.125
        )
        steepest_x = fmin(steepest_x, half_length)
        min_first, _ = self.derivatives(height_squared, half_chord_squared, steepest_x)
        # Half the chord; the largest |f'| and the largest f'', each as position and size; the
        # smallest f''.
        return ChordProfile(
            half_length,
            steepest_x,
            -min_first,
            half_length,
            6 * half_chord_squared,
            6 * dr.sqrt(height_squared) - 6,
        )

    def derivatives(
        self, height_squared: Real, half_chord_squared: Real, x: Real
    ) -> tuple[Real, Real]:
        square = x * x
        r = dr.sqrt(fmax(height_squared + square, float(dr.smallest(type(x)))))
        return -6 * x * (1 - r), 6 * (square / r - (1 - r))

    def derivative_ranges(self, q: Interval) -> tuple[Interval, Interval, Interval]:
        """Intervals that contain all values of the kernel k(q), of dk/dq and of d2k/dq2 (three
        intervals) for q in an interval. For q < 1 each of the three is monotone in q, so its values
        at the ends of q, moved outwards for rounding, are the ends of its interval."""
        low_r, high_r = dr.sqrt(fmin(fmax(q.lower, 0), 1)), dr.sqrt(fmin(q.upper, 1))
        epsilon = machine_epsilon(low_r)

        def value_at(r: Real) -> Real:
            """The kernel at the distance r = sqrt(q) from the center."""
            return (1 - r) * (1 - r) * (1 + 2 * r)

        # dk/dq is -3 (1 - r), and d2k/dq2 is 1.5/r. r has an absolute error of half an epsilon, and
        # 1 - r of at most as much.
        slope = Interval(-3 * (1 - low_r) - 8 * epsilon, fmin(-3 * (1 - high_r) + 8 * epsilon, 0))
        value = Interval(fmax(value_at(high_r) - 8 * epsilon, 0), value_at(low_r) + 8 * epsilon)
        second = Interval(1.5 / high_r, dr.select(low_r > 0, 1.5 / low_r, dr.inf)).widened(
            8 * epsilon
        )
        return value, slope, _range_with_support_end(second, q)


# Coefficients of a polynomial P, constant term first. For 0 <= u <= 1 the solution y of
# e^-y (1 - 2y) = u is (1 - u) P(u), within 3e-5.
_ZERO_OF_SECOND = (
    0.49997092305737245, -0.3219978627536485, 0.32259825712084994,
    -0.30315186994209903, 0.18704273421313763, -0.051146934086341474,
)  # fmt: skip


@dataclass(frozen=True)
class GaussianKernel(BlobKernel):
    """The Gaussian kernel k = exp(z) - 1 - z with z = b (1 - q), where q is the squared distance
    from the center in units of the support's radius. It is a Gaussian minus its tangent, as a
    function of q, at the end q = 1 of the support. (Aydinlilar and Zanni 2023, eq. 6, use a
    Gaussian that does not end.)

    A Gaussian that is only cut off jumps, and no step across the jump could be proved. With the
    tangent subtracted, it ends as smoothly as the other kernels, and its ranges are exact. It
    differs from the Gaussian by a parabola, which is small if the tail is small.

    sharpness: the number s of the Gaussian exp(-s d^2/radius^2), with d the distance from the
        center and the radius of the blob.
    tail: the value of the Gaussian where the blob ends, as a fraction of its value at the blob's
        radius.
    rate: b as a Dr.Jit number, which `on_backend` sets; None otherwise.

    Let f(x) be the kernel along a line, at the position x from the point nearest to the center. The
    line's part inside the support is |x| <= S. With z = b (S^2 - x^2) and y = b x^2,

        f' = -2 b x (e^z - 1),    f'' = 2b (e^z (2y - 1) + 1),    f''' = 4 b^2 x e^z (3 - 2y).

    So the maximum of f'' is at y = 3/2, or at x = S if S is nearer. f'' = 0 where e^-y (1 - 2y) =
    e^-(b S^2). So y is a function of the single number e^-(b S^2), and is approximated by a
    polynomial. The polynomial's error e changes the extreme value of f' by the order of e^2.
    """

    sharpness: float = 1.0
    tail: float = 1e-3
    rate: Any = None
    name = "gaussian"

    def __post_init__(self) -> None:
        """Raise ValueError unless sharpness and tail are in the ranges that the kernel allows."""
        if not 0 < as_real(self.sharpness, "sharpness") <= 12:
            raise ValueError(f"sharpness must be in (0, 12], not {self.sharpness!r}")
        if not 1e-6 <= as_real(self.tail, "tail") <= 0.5:
            raise ValueError(
                f"tail must lie between 1e-6 and 0.5, not {self.tail!r}: it is what is left of a "
                "Gaussian where the blob ends"
            )

    @property
    def support(self) -> float:
        return math.sqrt(1 - math.log(self.tail) / self.sharpness)

    @property
    def _rate(self) -> Any:
        """The number b of the kernel exp(z) - 1 - z with z = b (1 - q): a Dr.Jit number if the
        kernel is on a backend, else a Python number."""
        return self.sharpness * self.support**2 if self.rate is None else self.rate

    @property
    def steepness(self) -> KernelLipschitz:
        """The Lipschitz constants of the kernel and of its first two derivatives along lines:
        multiples of e^b, the kernel's exponential at the center."""
        b = self.sharpness * self.support**2
        exp_b = math.exp(b)
        # For the kernel, its first and its second derivative.
        return KernelLipschitz(
            4 * b * exp_b, 8 * b * (1 + math.sqrt(b)) * exp_b, 16 * b * (1 + b) * exp_b
        )

    def on_backend(self, backend: Backend) -> BlobKernel:
        return GaussianKernel(
            self.sharpness, self.tail, dr.opaque(backend.Float, float(self._rate))
        )

    def height(self, q: FloatArray) -> FloatArray:
        z = self.sharpness * self.support**2 * np.maximum(1 - q, 0)
        return np.expm1(z) - z

    def profile(self, q: Real) -> tuple[Real, Real, Real]:
        z = self._rate * fmax(1 - q, 0)
        e = dr.exp(z)
        return e - 1 - z, -self._rate * (e - 1), dr.select(z > 0, e, 0)

    def second_derivative(self, q: Real) -> Real:
        return dr.select(q < 1, self._rate * self._rate * dr.exp(self._rate * (1 - q)), 0)

    def chord(self, height_squared: Real, half_chord_squared: Real) -> ChordProfile:
        """The extreme values of the kernel's first two derivatives along lines, with lengths in
        units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center; not used, as S^2 = 1 -
            h^2.
        half_chord_squared: S^2, with S half the length of the line's part inside the support.

        Let z = b S^2 and y = b x^2 for the position x on the line. f' is largest at the zero of
        f'', where e^-y (1 - 2y) = e^-z; an approximation of its solution is (1 - u) P(u) with u =
        e^-z and the polynomial P of `_ZERO_OF_SECOND`. f'' is largest at y = 3/2, or at the end y =
        z of the chord if z < 3/2.
        """
        b = self._rate
        z = b * half_chord_squared
        exp_z = dr.exp(z)
        u = 1 / exp_z
        # P(u), by Horner's scheme.
        polynomial: Any = _ZERO_OF_SECOND[-1]
        for coefficient in reversed(_ZERO_OF_SECOND[:-1]):
            polynomial = dr.fma(polynomial, u, coefficient)
        y = fmax((1 - u) * polynomial, 0)
        steepest_x = dr.sqrt(y / b)
        is_at_end = z < 1.5
        # f'' = 2b (e^(z - y) (2y - 1) + 1): at y = z it is 4 b z, at y = 3/2 it is 2b (2 e^z e^-1.5
        # + 1).
        max_second = (
            2
            * b
            * (2 * dr.select(is_at_end, z, exp_z * math.exp(-1.5)) + dr.select(is_at_end, 0, 1))
        )
        # Half the chord; the largest |f'| and the largest f'', each as position and size; the
        # smallest f''.
        return ChordProfile(
            dr.sqrt(half_chord_squared),
            steepest_x,
            2 * b * steepest_x * (dr.exp(z - y) - 1),
            dr.sqrt(fmin(1.5, z) / b),
            max_second,
            -2 * b * (exp_z - 1),
        )

    def derivatives(
        self, height_squared: Real, half_chord_squared: Real, x: Real
    ) -> tuple[Real, Real]:
        """The first and the second derivative of the kernel along lines, at the position x from the
        point nearest to the center. Lengths are in units of the support's radius.

        height_squared: h^2, with h the distance of a line from the center; not used, as S^2 = 1 -
            h^2.
        half_chord_squared: S^2, with S half the length of the line's part inside the support.
        """
        b = self._rate
        y = b * (x * x)
        e = dr.exp(b * half_chord_squared - y)
        return -2 * b * x * (e - 1), 2 * b * dr.fma(e, dr.fma(2, y, -1), 1)

    def lipschitz_fraction(self, half_chord_squared: Real, nearest: Real) -> Real:
        """A factor, at most 1, by which the Lipschitz constants `steepness` may be multiplied on a
        part of a line. Lengths are in units of the support's radius.

        half_chord_squared: S^2, with S half the length of the line's part inside the support.
        nearest: a lower bound of x^2 on the part, with x the position on the line from the point
            nearest to the kernel's center.

        Proof. All constants are multiples of the largest e^z with z = b (S^2 - x^2), which is e^b
        on a line through the center (S = 1 and x = 0). So the factor is e^(b (S^2 - 1)) e^(-b x^2).
        The last factor is bounded by e^y >= (1 + y/32)^32 with y = b x^2.
        """
        b = self._rate
        # (1 + y/32)^32, by squaring five times.
        power = dr.fma(b / 32, nearest, 1)
        for _ in range(5):
            power = power * power
        # e^(b (S^2 - 1)), with a margin for rounding. A Python number stands for S = 1.
        largest = (
            1.01
            if isinstance(half_chord_squared, float)
            else 1.01 * dr.exp(b * (half_chord_squared - 1))
        )
        return fmin(largest / power, 1)

    def derivative_ranges(self, q: Interval) -> tuple[Interval, Interval, Interval]:
        """Intervals that contain all values of the kernel k(q), of dk/dq and of d2k/dq2 (three
        intervals) for q in an interval. With z = b max(1 - q, 0) they are e^z - 1 - z, -b (e^z - 1)
        and b^2 e^z. Each is monotone in z, so its values at the ends of z, moved outwards for
        rounding, are the ends of its interval."""
        w = _one_minus(q)
        b, epsilon = self._rate, machine_epsilon(w.lower)
        # The error of the product with b is half an epsilon, that of the exponential eight.
        error = 16 * epsilon
        z = Interval(b * w.lower, b * w.upper).widened(2 * epsilon)
        exp_low, exp_high = dr.exp(z.lower), dr.exp(z.upper)
        value = Interval(
            fmax(exp_low - 1 - z.lower - error * exp_low, 0),
            exp_high - 1 - z.upper + error * exp_high,
        )
        slope = Interval(
            -b * (exp_high - 1) - error * b * exp_high,
            fmin(-b * (exp_low - 1) + error * b * exp_low, 0),
        )
        second = Interval(b * b * exp_low, b * b * exp_high).widened(error)
        return value, slope, _range_with_support_end(second, q)


KERNELS: dict[str, type[BlobKernel]] = {
    "compact": CompactKernel,
    "gaussian": GaussianKernel,
    "cubic": CubicKernel,
    "sextic": SexticKernel,
}


def choose_kernel(kernel: str | BlobKernel) -> BlobKernel:
    """The kernel with this name, with its default parameters. If `kernel` is a kernel already, it
    is returned as it is.

    Raises:
        ValueError: an unknown name.
        TypeError: neither a name nor a kernel.
    """
    if isinstance(kernel, BlobKernel):
        return kernel
    if not isinstance(kernel, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"kernel must be a name or a kernel such as Compact(1.6), not {kernel!r}")
    if kernel not in KERNELS:
        raise ValueError(
            f"unknown kernel {kernel!r}; choose one of {', '.join(KERNELS)}"
            f"{did_you_mean(kernel, KERNELS)}"
        )
    return KERNELS[kernel]()


def _check_support(support: float) -> None:
    """Raise ValueError unless a support is above 1 and at most 100."""
    if not 1.0 < as_real(support, "support") <= 100.0:
        raise ValueError(
            f"support must lie between 1 and 100, not {support!r}: it is where a blob ends, in "
            "parts of its radius"
        )


def _one_minus(q: Interval) -> Interval:
    """The interval of all values of max(1 - q, 0) for q in the given interval."""
    w = Interval(1.0, 1.0) - q
    return Interval(fmax(w.lower, 0), fmax(w.upper, 0))


def _widened_range(lower: Real, upper: Real, relative_error: float) -> Interval:
    """The interval [lower, upper], with each end moved outwards by the fraction `relative_error` of
    itself, for rounding.

    lower, upper: the computed values of a monotone function at the two ends of a range, the smaller
        one first.
    """
    return Interval(lower, upper).widened(relative_error)


def _range_with_support_end(second: Interval, q: Interval) -> Interval:
    """The interval of all values of a kernel's second derivative d2k/dq2 for q in an interval, also
    beyond the end q = 1 of the support, where it is 0.

    second: an interval of its values for the q < 1, where it is positive.
    q: the interval of squared distances. If it reaches 1, the result contains 0.
    """
    return Interval(
        dr.select(q.upper < 1, fmax(second.lower, 0), 0), dr.select(q.lower <= 1, second.upper, 0)
    )
