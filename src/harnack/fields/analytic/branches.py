"""Analytic functions of a complex variable z with all their branches, for Riemann surfaces. A
branch g is one of the values that such a function takes near a point, continued analytically; the
square root has the two branches sqrt z and -sqrt z. A singular point is one where some branch is
not analytic, such as 0 for the square root; at a branch point a turn around it leads from one
branch to another (in the code all singular points are called branch points). Of each g either the
real or the imaginary part is drawn as the height of a surface over the plane. If that part may be
shifted by multiples of a period, such as 2 pi for Im log z, the shifted branches count as one."""

from __future__ import annotations

import abc
import importlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr

from harnack.backend import backend_of
from harnack.backend.elementary import fmax, fmin, sincos
from harnack.backend.validation import as_real, check_no_derivatives

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import Backend, Real

# A Dr.Jit complex number, whose value may differ from lane to lane.
Complex = Any

# Points nearer than this to a singular point are moved away from it: squares of such distances do
# not underflow.
_MIN_DISTANCE = 1e-12
# The smallest distance to a zero, added to the rounding: in single precision its square and the
# inverse of its square are still finite numbers other than 0.
_MIN_ZERO_DISTANCE = 1e-18
# What counts as the distance to the nearest singular point if there are no singular points.
_CLEARANCE_WITHOUT_POINTS = 2.0
# Bounds of second derivatives are multiplied by this factor, for the rounding of logarithms and
# powers.
_BOUND_MARGIN = 1 + 2e-4


def complex_type(backend: Backend) -> Any:
    """The Dr.Jit type of complex numbers (`Complex2f` or `Complex2f64`) of this backend and
    precision."""
    suffix = "64" if backend.precision == "double" else ""
    return getattr(importlib.import_module(f"drjit.{backend.name}.ad"), f"Complex2f{suffix}")


def complex_of(x: Real, y: Real) -> Complex:
    """The complex number x + i y, of the backend and precision of x."""
    return complex_type(backend_of(x))(x, y)


def derivatives(number: Complex, part: str) -> tuple[Real, Real]:
    """The derivatives by x and by y of the real or imaginary part of an analytic function g(x + i
    y).

    number: the derivative g'(z) of the function as a complex function.
    part: "imag" or "real": the part of g that is differentiated.

    By the Cauchy-Riemann equations they are Im g' and Re g' for the imaginary part, and Re g' and
    -Im g' for the real part.
    """
    if part == "imag":
        return number.imag, number.real
    return number.real, -number.imag


@dataclass(frozen=True)
class BranchPoint:
    """A point of the complex plane where a branch g of a function is not analytic, with a bound of
    how far all branches are from a common value near it: |g - value| <= constant |z -
    location|^power, with power > 0, for all z within `radius` of the point. If the drawn part of g
    has a period, the bound holds after a shift of g by whole periods.

    location: the point.
    power, constant, radius, value: the numbers of the bound. The power is None if no such bound is
        known, as at poles and logarithms.

    Raises:
        TypeError, ValueError: a number is not finite (the radius may be infinite), or the power,
            constant or radius is not positive.
    """

    location: complex
    power: float | None = None
    constant: float = 1.0
    radius: float = math.inf
    value: complex = 0.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_no_derivatives("a BranchPoint", vars(self))
        object.__setattr__(self, "location", _finite(self.location, "the place of a branch point"))
        object.__setattr__(self, "value", _finite(self.value, "the value at a branch point"))
        for name in ("power", "constant", "radius"):
            if name == "power" and self.power is None:
                continue
            number = as_real(getattr(self, name), f"the {name} of a branch point")
            if not number > 0 or (name != "radius" and number == math.inf):
                raise ValueError(f"the {name} of a branch point must be positive, not {number!r}")
            object.__setattr__(self, name, number)


@dataclass(frozen=True)
class DeviceBranchPoint:
    """A `BranchPoint` with Dr.Jit numbers: a point of the complex plane where a branch g of a
    function is not analytic, with a bound of the branches near it.

    at: the point.
    power, constant, radius, value: the bound |g - value| <= constant |z - at|^power of all branches
        g at points z within the radius; the power is None if no such bound is known.
    """

    at: Complex
    power: float | None
    constant: Real
    radius: Real
    value: Complex

    @classmethod
    def upload(cls, backend: Backend, point: BranchPoint) -> DeviceBranchPoint:
        """The branch point with numbers of a backend that are no literals."""
        at, value = _uploaded((point.location, point.value), backend)
        constant, radius = (
            dr.opaque(backend.Float, number) for number in (point.constant, point.radius)
        )
        return cls(at, point.power, constant, radius, value)


@dataclass(frozen=True)
class Branch:
    """One branch g of an analytic function at a point z: the value g(z), the derivative g'(z) as
    `first` and, if it is known, g"(z) as `second`."""

    value: Complex
    first: Complex
    second: Complex | None = None


class PlaneRegion(abc.ABC):
    """A region of the complex plane, on which second derivatives of analytic functions are bounded
    (`BranchEvaluator.second_derivative_bound`). The bounds need only its distances from singular
    points, and a disk around it. All numbers are rounded to the safe side: they hold for the exact
    region."""

    @abc.abstractmethod
    def distances(self, at: Complex) -> tuple[Real, Real]:
        """Return two bounds of the distances of the region's points from the point `at`: a lower
        bound of the smallest and an upper bound of the largest."""

    @abc.abstractmethod
    def disk(self) -> tuple[Complex, Real]:
        """The center and the radius of a disk that contains the region."""


@dataclass(frozen=True)
class PlaneSegment(PlaneRegion):
    """The straight segment of the complex plane from z to z + length w.

    z, w: Dr.Jit complex numbers; w need not have length 1.
    length: the factor of w, >= 0.
    rounding: a bound of the rounding error of z, as a distance.
    """

    z: Complex
    w: Complex
    length: Real
    rounding: Real

    def distances(self, at: Complex) -> tuple[Real, Real]:
        """A lower bound of the smallest distance from the point `at` to the segment, and an upper
        bound of the largest.

        The smallest distance is that of the foot of the perpendicular from `at`, or, if the foot is
        not on the segment, of the end nearer to it. The largest distance is that of an end, since
        the distance from a point is a convex function along a line.
        """
        x, y = self.z.real - at.real, self.z.imag - at.imag
        # The foot is z + foot_position w; |w|^2 is 0 for a segment that is a single point.
        speed_squared = dr.square(self.w.real) + dr.square(self.w.imag)
        foot_position = -(x * self.w.real + y * self.w.imag) / speed_squared
        foot_position = dr.select(speed_squared > 0, fmin(fmax(foot_position, 0), self.length), 0)
        start, foot_distance, end = (
            dr.sqrt(dr.square(x + position * self.w.real) + dr.square(y + position * self.w.imag))
            for position in (0.0, foot_position, self.length)
        )
        # For the rounding of z, and of the computation.
        slack = self.rounding + 1e-6 * start
        return fmax(fmin(foot_distance, start) - slack, 0), fmax(end, start) * (1 + 1e-6) + slack

    def disk(self) -> tuple[Complex, Real]:
        half = 0.5 * self.length
        return self.z + half * self.w, half * abs(self.w) * (1 + 1e-6) + self.rounding


@dataclass(frozen=True)
class Disk(PlaneRegion):
    """The disk of the complex plane with center z and this radius.

    rounding: a bound of the rounding error of z, as a distance.
    """

    z: Complex
    radius: Real
    rounding: Real

    def distances(self, at: Complex) -> tuple[Real, Real]:
        center_distance = abs(self.z - at)
        slack = self.rounding + 1e-6 * center_distance + self.radius
        return fmax(center_distance - slack, 0), center_distance + slack

    def disk(self) -> tuple[Complex, Real]:
        return self.z, self.radius + self.rounding


@dataclass(frozen=True)
class Branches(abc.ABC):
    """An analytic function of a complex variable z with all its branches g (the values that it
    takes near a point, continued analytically), and proved bounds of them. Either the real or the
    imaginary part of g is drawn. Branches whose drawn parts differ by whole periods count as one. A
    singular point, also called a branch point here, is one where a branch is not analytic.
    """

    @property
    @abc.abstractmethod
    def branch_points(self) -> tuple[BranchPoint, ...]:
        """The points where a branch is not analytic. Along every curve that avoids these points,
        each branch can be continued."""

    def period(self, imaginary: bool) -> float | None:
        """A number by which the drawn part of each branch may be shifted to give the drawn part of
        a branch again; None if there is no such number.

        imaginary: True if the imaginary part is drawn, False if the real part is drawn.
        """
        del imaginary
        return None

    @property
    def count(self) -> int:
        """The number of branches. Those whose drawn parts differ by whole periods count as one."""
        return 1

    @abc.abstractmethod
    def on_backend(self, backend: Backend) -> BranchEvaluator:
        """The object that evaluates these branches on a backend."""

    def max_abs(self, center: complex, radius: float) -> float:
        """An upper bound of |g|, for all branches g, on the disk with this center and radius;
        infinite if no bound is known."""
        del center, radius
        return math.inf


@dataclass(frozen=True, eq=False)
class BranchEvaluator(abc.ABC):
    """An analytic function of a complex variable z with all its branches g, to be evaluated on a
    backend. Its numbers lie there as data, not as literals: Dr.Jit then need not compile its code
    again for other numbers.

    points: the singular points, where a branch is not analytic.
    """

    points: tuple[DeviceBranchPoint, ...]

    @abc.abstractmethod
    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """All branches at the point z, in any order. Of branches whose drawn parts differ by whole
        periods, there is only one."""

    @abc.abstractmethod
    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        """A bound of |g"| on a region of the plane that holds for all branches g; infinite if no
        bound is known.

        part: the region.
        """

    def move_off_singularities(self, z: Complex, rounding: Real) -> Complex:
        """The point z, or a point beside it if z is at a singular point, where derivatives are NaN.

        rounding: a bound of the rounding error of z, as a distance. If z is nearer to a singular
            point than this (plus 1e-12), it is replaced by a point at that distance.
        """
        min_distance = rounding + _MIN_DISTANCE
        for point in self.points:
            moved = type(z)(point.at.real + min_distance, point.at.imag)
            z = dr.select(abs(z - point.at) < min_distance, moved, z)
        return z

    def clearance(self, z: Complex) -> Real:
        """The distance from z to the nearest singular point. If there are no singular points, the
        result is 2, since it limits the size of the disks on which the branches are bounded."""
        nearest = 0 * z.real + (dr.inf if self.points else _CLEARANCE_WITHOUT_POINTS)
        for point in self.points:
            nearest = fmin(abs(z - point.at), nearest)
        return nearest

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        """A bound of the rounding error of the values of all branches, as a multiple of the machine
        epsilon (2^-23 in single precision). By default it is 8 times the largest |value|.

        z: the point.
        branches: all branches at z, as `evaluate` returns them.
        """
        del z
        largest: Real = 0.0
        for branch in branches:
            largest = fmax(8 * abs(branch.value), largest)
        return largest


@dataclass(frozen=True)
class PowerProduct(Branches):
    """The function g(z) = product of (z - a_i)^alpha_i, with rational exponents alpha_i. It has q
    branches, where q is the least common denominator of the exponents: a full turn around a_i
    multiplies g by exp(2 pi i alpha_i), and these factors generate the q-th roots of unity. It is
    singular at the a_i whose exponent is no positive integer.

    centers: the points a_i.
    exponents: the exponents alpha_i, in the same order.
    denominator: q.

    Bound of |g"|. With e_i = alpha_i/(z - a_i) one has g" = g ((sum e_i)^2 - sum alpha_i/(z -
    a_i)^2). So, if d_i is the distance of z from a_i,

        |g"|/|g| <= sum_i |alpha_i (alpha_i - 1)|/d_i^2 + 2 sum_(i<j) |alpha_i alpha_j|/(d_i d_j).

    Each term of this times |g| is a product of powers of the d_i. On a region a power with an
    exponent below 0 is largest at the smallest d_i of the region, and any other power at the
    largest d_i. For a single factor the bound is attained.
    """

    centers: tuple[complex, ...]
    exponents: tuple[float, ...]
    denominator: int

    @property
    def count(self) -> int:
        return self.denominator

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        """The points a_i whose exponent alpha_i is no positive integer, where g = product of (z -
        a_i)^alpha_i is not analytic.

        For an exponent alpha > 0 all branches are near 0 there: |g| <= C |z - a_i|^alpha within
        half the distance to the nearest other a_j, where C bounds the product of all other factors.
        """
        points: list[BranchPoint] = []
        for i, (a, alpha) in enumerate(zip(self.centers, self.exponents, strict=True)):
            if alpha > 0 and alpha.is_integer():
                continue
            if alpha < 0:  # g is infinite there, so no bound is stated
                points.append(BranchPoint(a))
                continue
            other_factors = [
                (abs(a - b), beta)
                for j, (b, beta) in enumerate(zip(self.centers, self.exponents, strict=True))
                if j != i
            ]
            radius = 0.5 * min((d for d, _ in other_factors), default=math.inf)
            # A power is largest at the largest distance |z - a_j| if its exponent is positive, else
            # at the smallest one; these are |a_i - a_j| plus and minus the radius.
            constant = math.prod(
                (d + math.copysign(radius, beta)) ** beta for d, beta in other_factors
            )
            # (1e-6 covers the rounding of the product.)
            points.append(BranchPoint(a, alpha, constant * (1 + 1e-6), radius))
        return tuple(points)

    def on_backend(self, backend: Backend) -> BranchEvaluator:
        points = _device_points(self.branch_points, backend)
        centers = _uploaded(self.centers, backend)
        return _PowerProductEvaluator(points, centers, self.exponents, self.denominator)

    def max_abs(self, center: complex, radius: float) -> float:
        """An upper bound of |g| on the disk with this center and radius: the product of bounds of
        all factors |z - a_i|^alpha_i. It is infinite if the disk contains an a_i with a negative
        exponent."""
        product = 1.0
        for a, alpha in zip(self.centers, self.exponents, strict=True):
            distance = abs(a - center)
            if alpha < 0 and distance <= radius:
                return math.inf
            # The largest distance if alpha is positive, else the smallest one.
            product *= (distance + math.copysign(radius, alpha)) ** alpha
        return product


@dataclass(frozen=True, eq=False)
class _PowerProductEvaluator(BranchEvaluator):
    """The branches of a `PowerProduct`, which has the bound of |g"|, on a backend.

    centers: the points a_i.
    exponents: the exponents alpha_i, in the same order.
    denominator: q, the number of branches.
    """

    centers: tuple[Complex, ...]
    exponents: tuple[float, ...]
    denominator: int

    def move_off_singularities(self, z: Complex, rounding: Real) -> Complex:
        """The point z, or a point beside it if z is at a singular point or at a zero of g.

        rounding: a bound of the rounding error of z, as a distance.

        A zero a_i with a positive integer exponent is no singular point of g. But `evaluate`
        computes the logarithm of g, which is infinite there. A point at a zero is moved by a few
        roundings of the zero's coordinates (at least 1e-18).
        """
        z = super().move_off_singularities(z, rounding)
        unit = 4 * float(dr.epsilon(z.real))
        for a, alpha in zip(self.centers, self.exponents, strict=True):
            if alpha > 0 and alpha.is_integer():
                min_distance = _MIN_ZERO_DISTANCE + unit * fmax(dr.abs(a.real), dr.abs(a.imag))
                moved = type(z)(a.real + min_distance, a.imag)
                z = dr.select(abs(z - a) < min_distance, moved, z)
        return z

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """All q branches of g = product of (z - a_i)^alpha_i at z: one value, computed from the
        logarithm of the product, times each of the q-th roots of unity.

        With the logarithmic derivative e = sum alpha_i/(z - a_i), g' = g e and g" = g (e^2 - sum
        alpha_i/(z - a_i)^2).
        """
        # The real and the imaginary part of log g; e; and the sum of alpha_i/(z - a_i)^2.
        log_size, angle = 0 * z.real, 0 * z.real
        log_derivative = type(z)(log_size, log_size)
        square_sum = log_derivative
        for a, alpha in zip(self.centers, self.exponents, strict=True):
            offset = z - a
            log_size = log_size + alpha * dr.log(abs(offset))
            angle = angle + alpha * dr.atan2(offset.imag, offset.real)
            inverse = dr.rcp(offset)
            log_derivative = log_derivative + alpha * inverse
            square_sum = square_sum + alpha * (inverse * inverse)
        abs_g = dr.exp(log_size)
        sine, cosine = sincos(angle)
        g = type(z)(abs_g * cosine, abs_g * sine)
        second_ratio = log_derivative * log_derivative - square_sum
        branches: list[Branch] = []
        for k in range(self.denominator):
            rotation = 2 * math.pi * k / self.denominator
            value = g * type(z)(math.cos(rotation), math.sin(rotation)) if k else g
            branches.append(Branch(value, value * log_derivative, value * second_ratio))
        return tuple(branches)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        """A bound of |g"| on a region of the plane that holds for all branches g. The class has the
        proof: a sum of products of powers of the distances d_i from the points a_i. Each product is
        computed from the logarithms of the distances.

        part: the region.
        """
        log_nearest: list[Real] = []
        log_farthest: list[Real] = []
        for a in self.centers:
            smallest, largest = part.distances(a)
            log_nearest.append(dr.log(smallest))
            log_farthest.append(dr.log(largest))
        alphas, bound = self.exponents, 0 * part.disk()[1]
        for i, alpha_i in enumerate(alphas):
            for j, alpha_j in enumerate(alphas[: i + 1]):
                # The coefficient of this term of |g"|/|g|.
                factor = abs(alpha_i * (alpha_i - 1)) if i == j else 2 * abs(alpha_i * alpha_j)
                if factor == 0:
                    continue
                # The exponents of the d_k in |g|/(d_i d_j).
                powers = [alpha - (k == i) - (k == j) for k, alpha in enumerate(alphas)]
                logs = [
                    power * (log_nearest if power < 0 else log_farthest)[k]
                    for k, power in enumerate(powers)
                    if power != 0
                ]
                # Without any power (g is a quadratic polynomial) |g"| is this one constant term.
                bound = bound + factor * dr.exp(sum(logs)) if logs else factor
        return bound * _BOUND_MARGIN

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        """A bound of the rounding error of the values of all branches at z, as a multiple of the
        machine epsilon.

        branches: all branches at z, as `evaluate` returns them.

        Each value is exp of a sum of logarithms and angles, so its relative error is a few
        roundings of the terms of these sums: four of each logarithm and of each angle, times the
        size of its exponent, and twelve for the rest. An angle is at most pi. All branches have the
        same absolute value.
        """
        roundings = 12 + 4 * math.pi * sum(abs(alpha) for alpha in self.exponents)
        for a, alpha in zip(self.centers, self.exponents, strict=True):
            roundings = roundings + 4 * abs(alpha) * dr.abs(dr.log(abs(z - a)))
        return roundings * abs(branches[0].value)


@dataclass(frozen=True)
class Logarithm(Branches):
    """The function g(z) = sum n_i log(z - a_i) with integers n_i: the logarithm of a product of
    integer powers. Its imaginary part is determined up to multiples of 2 pi gcd(n_i); branches that
    differ by these count as one. It is singular at the points a_i.

    centers: the points a_i.
    multiplicities: the integers n_i, in the same order.

    Bound. |g"| = |sum n_i/(z - a_i)^2| <= sum |n_i|/d_i^2 on a region, if d_i is the smallest
    distance of the region from a_i.
    """

    centers: tuple[complex, ...] = (0j,)
    multiplicities: tuple[int, ...] = (1,)

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        return tuple(BranchPoint(a) for a in self.centers)

    def period(self, imaginary: bool) -> float | None:
        return 2 * math.pi * math.gcd(*self.multiplicities) if imaginary else None

    def on_backend(self, backend: Backend) -> BranchEvaluator:
        points = _device_points(self.branch_points, backend)
        return _LogarithmEvaluator(points, _uploaded(self.centers, backend), self.multiplicities)


@dataclass(frozen=True, eq=False)
class _LogarithmEvaluator(BranchEvaluator):
    """The only branch of a `Logarithm`, which has the bound of |g"|, on a backend.

    centers: the points a_i.
    multiplicities: the integers n_i, in the same order.
    """

    centers: tuple[Complex, ...]
    multiplicities: tuple[int, ...]

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """g = sum n_i log(z - a_i) at z, as a tuple with a single branch: all other values differ
        from it by whole periods."""
        zero = type(z)(0 * z.real, 0 * z.real)
        value, first, second = zero, zero, zero
        for a, n in zip(self.centers, self.multiplicities, strict=True):
            offset = z - a
            inverse = dr.rcp(offset)
            value = value + n * type(z)(dr.log(abs(offset)), dr.atan2(offset.imag, offset.real))
            first = first + n * inverse
            second = second - n * (inverse * inverse)
        return (Branch(value, first, second),)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        total = 0 * part.disk()[1]
        for a, n in zip(self.centers, self.multiplicities, strict=True):
            total = total + abs(n) / dr.square(part.distances(a)[0])
        return total * _BOUND_MARGIN

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        """A bound of the rounding error of g = sum n_i log(z - a_i) at z, as a multiple of the
        machine epsilon. It is a sum of bounds for the logarithms and for the angles, which are at
        most pi.

        branches: not used.
        """
        del branches
        roundings = 0 * z.real
        for a, n in zip(self.centers, self.multiplicities, strict=True):
            roundings = roundings + abs(n) * (8 * math.pi + 4 * dr.abs(dr.log(abs(z - a))))
        return roundings


@dataclass(frozen=True)
class ArcSine(Branches):
    """The function asin with all its branches, which are g and pi - g plus multiples of 2 pi, with
    g the principal branch. It is singular at 1 and -1.

    Bound of |g"|. g' = (1 - z^2)^(-1/2) and g" = z g'^3, so |g"| <= |z|/(d_1 d_2)^(3/2), where d_1
    and d_2 are the distances of z from 1 and -1.

    Bound at the branch points 1 and -1. At 1, asin(1 - w) = pi/2 - 2 asin sqrt(w/2), and the series
    of asin has positive coefficients, so |g - pi/2| <= 2 asin sqrt(|w|/2). As asin is convex on [0,
    1], for |w| <= 1/2 this is at most (pi/3)/sqrt(1/2) sqrt|w|. At -1 the same holds by symmetry.
    """

    @property
    def count(self) -> int:
        return 2

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        constant = math.pi / 3 * math.sqrt(2.0) * (1 + 1e-6)
        half = 0.5 * math.pi
        return BranchPoint(1, 0.5, constant, 0.5, half), BranchPoint(-1, 0.5, constant, 0.5, -half)

    def period(self, imaginary: bool) -> float | None:
        return None if imaginary else 2 * math.pi

    def on_backend(self, backend: Backend) -> BranchEvaluator:
        return _ArcSineEvaluator(_device_points(self.branch_points, backend))


@dataclass(frozen=True, eq=False)
class _ArcSineEvaluator(BranchEvaluator):
    """The branches of an `ArcSine`, which has the bound of |g"|, on a backend."""

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """The two branches g and pi - g of asin at z, where g is the principal branch, by Kahan's
        formulas (1987), in which nothing cancels."""
        root_minus, root_plus = dr.sqrt(1 - z), dr.sqrt(1 + z)
        product = root_minus * root_plus
        real = dr.atan2(z.real, product.real)
        imaginary = dr.asinh(root_minus.real * root_plus.imag - root_minus.imag * root_plus.real)
        g, first = type(z)(real, imaginary), dr.rcp(product)
        second = z * (first * first * first)
        return Branch(g, first, second), Branch(math.pi - g, -first, -second)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        complex_number = cast("Any", type(part.disk()[0]))
        distance_from_1, _ = part.distances(complex_number(1, 0))
        distance_from_minus_1, _ = part.distances(complex_number(-1, 0))
        _, max_abs_z = part.distances(complex_number(0, 0))
        inverse_product = 1 / (distance_from_1 * distance_from_minus_1)
        return max_abs_z * inverse_product * dr.sqrt(inverse_product) * _BOUND_MARGIN


@dataclass(frozen=True)
class UserBranches(Branches):
    """An analytic function of a complex variable with all its branches that a user has written.

    function: a function of z that returns all branches at z, each as (g, g') or (g, g', g").
    singular: the points where a branch is not analytic.
    second_bound: a function of z and r that returns a bound of |g"| on the disk of radius r about
        z, for all branches g.
    branch_count: the number of branches.
    shift: the period of the drawn part, or None.

    A bound of |g"| on a region is the user's bound on a disk that contains the region (for a
    segment, the smallest such disk). It is infinite if a singular point lies in that disk.
    """

    function: Callable[[Any], Any]
    singular: tuple[BranchPoint, ...]
    second_bound: Callable[[Any, Any], Any]
    branch_count: int
    shift: float | None = None

    @property
    def count(self) -> int:
        return self.branch_count

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        return self.singular

    def period(self, imaginary: bool) -> float | None:
        del imaginary
        return self.shift

    def on_backend(self, backend: Backend) -> BranchEvaluator:
        points = _device_points(self.branch_points, backend)
        return _UserBranchEvaluator(points, self.function, self.second_bound)


@dataclass(frozen=True, eq=False)
class _UserBranchEvaluator(BranchEvaluator):
    """The branches that a user has written (`UserBranches`), on a backend.

    function: a function of z that returns all branches at z, each as (g, g') or (g, g', g").
    second_bound: a function of z and r that returns a bound of |g"| on the disk of radius r about
        z, for all branches g.
    """

    function: Callable[[Any], Any]
    second_bound: Callable[[Any, Any], Any]

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """The branches at z that the user's function returns; Python numbers among them are
        converted to Dr.Jit numbers."""
        branches: list[Branch] = []
        for numbers in self.function(z):
            parts = [part if dr.is_array_v(type(part)) else type(z)(part) for part in numbers]
            branches.append(Branch(*parts))
        return tuple(branches)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        """A bound of |g"| on a region that holds for all branches g: the user's bound on a disk
        that contains the region. It is infinite if a singular point lies in the disk, or if the
        user's bound is negative or NaN.

        part: the region.
        """
        center, radius = part.disk()
        # False if the radius is NaN.
        is_free = radius == radius
        for point in self.points:
            is_free = is_free & (abs(center - point.at) > radius)
        bound = 0 * radius + self.second_bound(center, radius)
        return dr.select(is_free & (bound >= 0), bound, dr.inf)


def _device_points(
    points: tuple[BranchPoint, ...], backend: Backend
) -> tuple[DeviceBranchPoint, ...]:
    """The branch points on a backend."""
    return tuple(DeviceBranchPoint.upload(backend, point) for point in points)


def _uploaded(points: tuple[complex, ...], backend: Backend) -> tuple[Complex, ...]:
    """The points of the complex plane as Dr.Jit numbers of a backend that are not literals."""
    make_complex = complex_type(backend)
    real = backend.Float
    return tuple(make_complex(dr.opaque(real, a.real), dr.opaque(real, a.imag)) for a in points)


def _finite(value: Any, name: str) -> complex:
    """`value` as a complex number.

    name: what the value is, for the messages.

    Raises:
        TypeError, ValueError: it is no complex number, or not finite.
    """
    try:
        number = complex(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a complex number, not {value!r}") from None
    if not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{name} must be finite, not {value!r}")
    return number
