"""Functions of a complex variable with all their branches, for Riemann surfaces."""

from __future__ import annotations

import abc
import importlib
import math
from dataclasses import dataclass, field, replace
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
# About the smallest number whose square, and the inverse of that, exist in single precision.
_MIN_SQUARED = 1e-18
# The distance to the nearest singular point, if there is none.
_NO_POINT = 2.0
# Bounds of second derivatives are multiplied by this factor, for the rounding of logarithms and
# powers.
_BOUND_MARGIN = 1 + 2e-4


def complex_type(backend: Backend) -> Any:
    """The type of complex numbers of a backend."""
    suffix = "64" if backend.precision == "double" else ""
    return getattr(importlib.import_module(f"drjit.{backend.name}.ad"), f"Complex2f{suffix}")


def complex_of(x: Real, y: Real) -> Complex:
    """x + i y."""
    return complex_type(backend_of(x))(x, y)


def derivatives(number: Complex, part: str) -> tuple[Real, Real]:
    """d/dx and d/dy of the part, "imag" or "real", of an analytic function whose derivative is
    `number`."""
    if part == "imag":
        return number.imag, number.real
    return number.real, -number.imag


@dataclass(frozen=True)
class BranchPoint:
    """A point of the plane where branches are not analytic.

    location: the point.
    power, constant, radius, value: within the radius of the point, all branches g have |g - value|
        <= constant |z - location|^power, with a power > 0 (up to the period of the part that is
        drawn). The power is None if no such bound is known, as at poles and logarithms.
    """

    location: complex
    power: float | None = None
    constant: float = 1.0
    radius: float = math.inf
    value: complex = 0.0

    def __post_init__(self) -> None:
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
class PreparedBranchPoint:
    """A `BranchPoint` as kernel parameters of a backend."""

    at: Complex
    power: float | None
    constant: Real
    radius: Real
    value: Complex

    @classmethod
    def of(
        cls, point: BranchPoint, make_number: Callable[[float], Real], make_complex: Any
    ) -> PreparedBranchPoint:
        """The point on a backend.

        make_number: makes a number of the backend.
        make_complex: makes a complex number of the backend from its two parts.
        """
        at, value = (
            make_complex(make_number(z.real), make_number(z.imag))
            for z in (point.location, point.value)
        )
        return cls(at, point.power, make_number(point.constant), make_number(point.radius), value)


@dataclass(frozen=True)
class Branch:
    """A branch at z: its value, derivative and, if it is known, second derivative."""

    value: Complex
    first: Complex
    second: Complex | None = None


class PlaneRegion(abc.ABC):
    """A region of the plane on which second derivatives are bounded. All its numbers are rounded
    outwards."""

    @abc.abstractmethod
    def distances(self, at: Complex) -> tuple[Real, Real]:
        """The smallest and the largest distance from a point."""

    @abc.abstractmethod
    def disk(self) -> tuple[Complex, Real]:
        """Center and radius of a disk that contains the region."""


@dataclass(frozen=True)
class PlaneSegment(PlaneRegion):
    """The segment from z to z + length w, w a Dr.Jit complex number.

    rounding: a bound of the rounding of z.
    """

    z: Complex
    w: Complex
    length: Real
    rounding: Real

    def distances(self, at: Complex) -> tuple[Real, Real]:
        """The smallest distance is that of the foot of the perpendicular, or of the end nearer to
        it; the largest is that of an end, as distances are convex."""
        x, y = self.z.real - at.real, self.z.imag - at.imag
        speed = dr.square(self.w.real) + dr.square(self.w.imag)
        closest = -(x * self.w.real + y * self.w.imag) / speed
        closest = dr.select(speed > 0, fmin(fmax(closest, 0), self.length), 0)
        start, middle, end = (
            dr.sqrt(dr.square(x + s * self.w.real) + dr.square(y + s * self.w.imag))
            for s in (0.0, closest, self.length)
        )
        slack = self.rounding + 1e-6 * start
        return fmax(fmin(middle, start) - slack, 0), fmax(end, start) * (1 + 1e-6) + slack

    def disk(self) -> tuple[Complex, Real]:
        half = 0.5 * self.length
        return self.z + half * self.w, half * abs(self.w) * (1 + 1e-6) + self.rounding


@dataclass(frozen=True)
class Disk(PlaneRegion):
    """The disk of a radius about z; rounding: a bound of the rounding of z."""

    z: Complex
    radius: Real
    rounding: Real

    def distances(self, at: Complex) -> tuple[Real, Real]:
        middle = abs(self.z - at)
        slack = self.rounding + 1e-6 * middle + self.radius
        return fmax(middle - slack, 0), middle + slack

    def disk(self) -> tuple[Complex, Real]:
        return self.z, self.radius + self.rounding


@dataclass(frozen=True)
class Branches(abc.ABC):
    """All branches of an analytic function, with proved bounds."""

    _prepared: tuple[PreparedBranchPoint, ...] = field(
        default=(), kw_only=True, repr=False, compare=False
    )

    @property
    @abc.abstractmethod
    def branch_points(self) -> tuple[BranchPoint, ...]:
        """The points where branches are not analytic; everywhere else each branch can be
        continued."""

    def period(self, imaginary: bool) -> float | None:
        """A number by which the drawn part of each branch may be shifted to give a branch again;
        None if there is no such number."""
        del imaginary
        return None

    @property
    def count(self) -> int:
        """The number of branches, up to the period."""
        return 1

    def prepare(self, backend: Backend) -> Branches:
        """The same branches with their numbers as kernel parameters of the backend."""

        def number(value: float) -> Real:
            return dr.opaque(backend.Float, value)

        make_complex = complex_type(backend)
        return replace(
            self,
            _prepared=tuple(
                PreparedBranchPoint.of(point, number, make_complex) for point in self.branch_points
            ),
        )

    def points_on(self, z: Complex) -> tuple[PreparedBranchPoint, ...]:
        """The branch points as numbers of the type of z."""
        if self._prepared:
            return self._prepared
        real, make_complex = cast("Any", type(z.real)), cast("Any", type(z))
        return tuple(
            PreparedBranchPoint.of(point, real, make_complex) for point in self.branch_points
        )

    @abc.abstractmethod
    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """All branches at z, up to the period, in any order."""

    @abc.abstractmethod
    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        """A bound of |g''| for all branches on the region `part` of the plane."""

    def move_off_singularities(self, z: Complex, rounding: Real) -> Complex:
        """z, moved by its rounding away from singular points, where derivatives are NaN."""
        min_distance = rounding + _MIN_DISTANCE
        for point in self.points_on(z):
            moved = type(z)(point.at.real + min_distance, point.at.imag)
            z = dr.select(abs(z - point.at) < min_distance, moved, z)
        return z

    def clearance(self, z: Complex) -> Real:
        """The distance to the nearest singular point."""
        nearest = 0 * z.real + (dr.inf if self.branch_points else _NO_POINT)
        for point in self.points_on(z):
            nearest = fmin(abs(z - point.at), nearest)
        return nearest

    def max_abs(self, middle: complex, reach: float) -> float:
        """A bound of |g| on the disk of radius `reach` about a point; infinite if no bound is
        known."""
        del middle, reach
        return math.inf

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        """A bound of the rounding of values, in units (2^-23 in single precision) of the number
        1."""
        del z
        largest: Real = 0.0
        for branch in branches:
            largest = fmax(8 * abs(branch.value), largest)
        return largest


@dataclass(frozen=True)
class PowerProduct(Branches):
    """The product of (z - a_i)^alpha_i, with rational exponents: q branches, q the least common
    denominator.

    A full turn around a_i multiplies g by exp(2 pi i alpha_i): these factors generate the q-th
    roots of unity.

    Bound of g'': with e_i = alpha_i/(z - a_i), g'' = g ((sum e_i)^2 - sum alpha_i/(z - a_i)^2), so

        |g''|/|g| <= sum_i |alpha_i (alpha_i - 1)|/d_i^2 + 2 sum_(i<j) |alpha_i alpha_j|/(d_i d_j),

    d_i the distances from the a_i. Times |g| each term is a product of powers of them: powers below
    0 are largest at the smallest d_i of the region and the others at the largest. Equality for a
    single factor.
    """

    centers: tuple[complex, ...]
    exponents: tuple[float, ...]
    denominator: int
    _on: tuple[Complex, ...] = field(default=(), repr=False, compare=False)

    @property
    def count(self) -> int:
        return self.denominator

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        points: list[BranchPoint] = []
        for i, (a, alpha) in enumerate(zip(self.centers, self.exponents, strict=True)):
            if alpha > 0 and alpha.is_integer():
                continue
            if alpha < 0:
                points.append(BranchPoint(a))
                continue
            factors = [
                (abs(a - b), beta)
                for j, (b, beta) in enumerate(zip(self.centers, self.exponents, strict=True))
                if j != i
            ]
            radius = 0.5 * min((d for d, _ in factors), default=math.inf)
            constant = math.prod((d + math.copysign(radius, beta)) ** beta for d, beta in factors)
            points.append(BranchPoint(a, alpha, constant * (1 + 1e-6), radius))
        return tuple(points)

    def prepare(self, backend: Backend) -> Branches:
        return replace(super().prepare(backend), _on=_uploaded(self.centers, backend))

    def _centers(self, z: Complex) -> tuple[Complex, ...]:
        return self._on or tuple(type(z)(a.real, a.imag) for a in self.centers)

    def move_off_singularities(self, z: Complex, rounding: Real) -> Complex:
        """Also away from zeros, where the logarithm of the product is infinite, by one rounding."""
        z = super().move_off_singularities(z, rounding)
        unit = 4 * float(dr.epsilon(z.real))
        for a, alpha in zip(self._centers(z), self.exponents, strict=True):
            if alpha > 0 and alpha.is_integer():
                min_distance = _MIN_SQUARED + unit * fmax(dr.abs(a.real), dr.abs(a.imag))
                moved = type(z)(a.real + min_distance, a.imag)
                z = dr.select(abs(z - a) < min_distance, moved, z)
        return z

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        scale, angle = 0 * z.real, 0 * z.real
        ratio = type(z)(scale, scale)
        squares = ratio
        for a, alpha in zip(self._centers(z), self.exponents, strict=True):
            offset = z - a
            scale = scale + alpha * dr.log(abs(offset))
            angle = angle + alpha * dr.atan2(offset.imag, offset.real)
            inverse = dr.rcp(offset)
            ratio = ratio + alpha * inverse
            squares = squares + alpha * (inverse * inverse)
        size = dr.exp(scale)
        sine, cosine = sincos(angle)
        g = type(z)(size * cosine, size * sine)
        second_ratio = ratio * ratio - squares
        branches: list[Branch] = []
        for k in range(self.denominator):
            rotation = 2 * math.pi * k / self.denominator
            value = g * type(z)(math.cos(rotation), math.sin(rotation)) if k else g
            branches.append(Branch(value, value * ratio, value * second_ratio))
        return tuple(branches)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        nearest: list[Real] = []
        farthest: list[Real] = []
        for a in self._centers(part.disk()[0]):
            low, high = part.distances(a)
            nearest.append(dr.log(low))
            farthest.append(dr.log(high))
        alphas, total = self.exponents, 0 * part.disk()[1]
        for i, alpha_i in enumerate(alphas):
            for j, alpha_j in enumerate(alphas[: i + 1]):
                factor = abs(alpha_i * (alpha_i - 1)) if i == j else 2 * abs(alpha_i * alpha_j)
                if factor == 0:
                    continue
                powers = [alpha - (k == i) - (k == j) for k, alpha in enumerate(alphas)]
                sizes = [
                    power * (nearest if power < 0 else farthest)[k]
                    for k, power in enumerate(powers)
                    if power != 0
                ]
                total = total + factor * dr.exp(sum(sizes)) if sizes else factor
        return total * _BOUND_MARGIN

    def max_abs(self, middle: complex, reach: float) -> float:
        bound = 1.0
        for a, alpha in zip(self.centers, self.exponents, strict=True):
            distance = abs(a - middle)
            if alpha < 0 and distance <= reach:
                return math.inf
            bound *= (distance + math.copysign(reach, alpha)) ** alpha
        return bound

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        """The rounding of exp and of the angle: a few units of their arguments."""
        roundings = 12 + 4 * math.pi * sum(abs(alpha) for alpha in self.exponents)
        for a, alpha in zip(self._centers(z), self.exponents, strict=True):
            roundings = roundings + 4 * abs(alpha) * dr.abs(dr.log(abs(z - a)))
        return roundings * abs(branches[0].value)


@dataclass(frozen=True)
class Logarithm(Branches):
    """sum n_i log(z - a_i), the logarithm of a product of integer powers, whose imaginary part is
    determined up to 2 pi.

    |g''| = |sum n_i/(z - a_i)^2| <= sum |n_i|/d_i^2, with the smallest distances of the region.
    """

    centers: tuple[complex, ...] = (0j,)
    multiplicities: tuple[int, ...] = (1,)
    _on: tuple[Complex, ...] = field(default=(), repr=False, compare=False)

    @property
    def branch_points(self) -> tuple[BranchPoint, ...]:
        return tuple(BranchPoint(a) for a in self.centers)

    def period(self, imaginary: bool) -> float | None:
        return 2 * math.pi * math.gcd(*self.multiplicities) if imaginary else None

    def prepare(self, backend: Backend) -> Branches:
        return replace(super().prepare(backend), _on=_uploaded(self.centers, backend))

    def _centers(self, z: Complex) -> tuple[Complex, ...]:
        return self._on or tuple(type(z)(a.real, a.imag) for a in self.centers)

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        zero = type(z)(0 * z.real, 0 * z.real)
        value, first, second = zero, zero, zero
        for a, n in zip(self._centers(z), self.multiplicities, strict=True):
            offset = z - a
            inverse = dr.rcp(offset)
            value = value + n * type(z)(dr.log(abs(offset)), dr.atan2(offset.imag, offset.real))
            first = first + n * inverse
            second = second - n * (inverse * inverse)
        return (Branch(value, first, second),)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        total = 0 * part.disk()[1]
        for a, n in zip(self._centers(part.disk()[0]), self.multiplicities, strict=True):
            total = total + abs(n) / dr.square(part.distances(a)[0])
        return total * _BOUND_MARGIN

    def value_rounding(self, z: Complex, branches: tuple[Branch, ...]) -> Real:
        del branches
        roundings = 0 * z.real
        for a, n in zip(self._centers(z), self.multiplicities, strict=True):
            roundings = roundings + abs(n) * (8 * math.pi + 4 * dr.abs(dr.log(abs(z - a))))
        return roundings


@dataclass(frozen=True)
class ArcSine(Branches):
    """asin: its branches are g and pi - g modulo 2 pi, with g the principal branch.

    g' = (1 - z^2)^(-1/2) and g'' = z g'^3, so |g''| <= |z|/(d_1 d_2)^(3/2), d_i the distances from
    1 and -1. At both points, asin(1 - w) = pi/2 - 2 asin sqrt(w/2), whose series has positive
    coefficients: |g - pi/2| <= 2 asin sqrt(|w|/2), and for |w| <= 1/2 at most (pi/3)/sqrt(1/2)
    sqrt|w|, as asin is convex.
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

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        """The branches by Kahan's formulas (1987), in which nothing cancels."""
        root_minus, root_plus = dr.sqrt(1 - z), dr.sqrt(1 + z)
        product = root_minus * root_plus
        real = dr.atan2(z.real, product.real)
        imaginary = dr.asinh(root_minus.real * root_plus.imag - root_minus.imag * root_plus.real)
        g, first = type(z)(real, imaginary), dr.rcp(product)
        second = z * (first * first * first)
        return Branch(g, first, second), Branch(math.pi - g, -first, -second)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        complex_number = cast("Any", type(part.disk()[0]))
        low1, _ = part.distances(complex_number(1, 0))
        low2, _ = part.distances(complex_number(-1, 0))
        _, largest = part.distances(complex_number(0, 0))
        inverse = 1 / (low1 * low2)
        return largest * inverse * dr.sqrt(inverse) * _BOUND_MARGIN


@dataclass(frozen=True)
class UserBranches(Branches):
    """Branches of a user's function: see `RiemannSurface`.

    On a region g'' is bounded by the user's bound on a disk around it, if no singular point lies in
    that disk; around a segment, the smallest disk.
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

    def evaluate(self, z: Complex) -> tuple[Branch, ...]:
        branches: list[Branch] = []
        for numbers in self.function(z):
            parts = [part if dr.is_array_v(type(part)) else type(z)(part) for part in numbers]
            branches.append(Branch(*parts))
        return tuple(branches)

    def second_derivative_bound(self, part: PlaneRegion) -> Real:
        middle, radius = part.disk()
        is_free = radius == radius
        for point in self.points_on(middle):
            is_free = is_free & (abs(middle - point.at) > radius)
        bound = 0 * radius + self.second_bound(middle, radius)
        return dr.select(is_free & (bound >= 0), bound, dr.inf)


def _uploaded(points: tuple[complex, ...], backend: Backend) -> tuple[Complex, ...]:
    """Points of the plane as kernel parameters of a backend."""
    make_complex = complex_type(backend)
    real = backend.Float
    return tuple(make_complex(dr.opaque(real, a.real), dr.opaque(real, a.imag)) for a in points)


def _finite(value: Any, name: str) -> complex:
    """A finite complex number. Raises TypeError or ValueError, with this name, for other values."""
    try:
        number = complex(value)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be a complex number, not {value!r}") from None
    if not (math.isfinite(number.real) and math.isfinite(number.imag)):
        raise ValueError(f"{name} must be finite, not {value!r}")
    return number
