"""Twisted and tapered solids. A deformation is a one-to-one map of space that does not keep lines
straight. The preimage of a point p is the point that the map takes to p. The function f of the
image of a solid, at p, is the solid's formula at the preimage of p; so the solid must have a
formula. A Lipschitz constant of the inverse map bounds how far apart the preimages of two points
are, relative to the distance of the points."""

from __future__ import annotations

import abc
import copy
import dataclasses
import math
import numbers
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.arithmetic import cos, maximum, minimum, sin
from harnack.arithmetic.operators import tally_of
from harnack.backend.elementary import fmax, fmin
from harnack.backend.validation import as_real
from harnack.enclosures import Lipschitz, Promise
from harnack.fields.attached_numbers import attached, own_formula
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.formula import probe_jets, with_device_numbers
from harnack.fields.formula_evaluator import FormulaEvaluator, FormulaFunction
from harnack.fields.number_table import detached, is_attached_number
from harnack.fields.parameters import Parametrized
from harnack.fields.solids.solid import (
    AXES,
    FormulaSolid,
    Solid,
    SpaceMap,
    axis_index,
    by_numbers,
    formula_of,
)
from harnack.geometry import Ball, Box

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Real, Vec3
    from harnack.fields.number_table import NumberReader
    from harnack.geometry import Volume


class Deformation(SpaceMap, Parametrized):
    """A map of space that does not keep lines straight, such as a twist about an axis. It can be
    applied to solids with a formula. The preimage of a point is the point that the map takes to it.

    axis: "x", "y" or "z", the coordinate on which the map depends.
    """

    def apply(self, solid: Solid) -> Solid:
        """The image of a solid under the map.

        Raises:
            TypeError: the solid has no formula.
        """
        own_formula(solid)(*probe_jets())  # raises TypeError for a solid without a formula
        return DeformedSolid(solid, self)

    @classmethod
    def of_numbers(cls, **numbers: Any) -> Self:
        """The map of numbers that may be those of Dr.Jit with derivatives, which are not
        checked. All others are those that a constructor leaves out."""
        change = object.__new__(cls)
        for name, value in numbers.items():
            object.__setattr__(change, name, value)
        return change

    def _given(self) -> dict[str, Any]:
        """The numbers with derivatives that the map was made of, by names."""
        return vars(self).get("_given_numbers", {})

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor, in the form in which they were given."""
        fields = dataclasses.fields(cast("Any", self))
        stored = {entry.name: getattr(self, entry.name) for entry in fields}
        return stored | self._given()

    def replace(self, **changes: Any) -> Self:
        """The map with some of its numbers exchanged."""
        new = {k: tuple(v.tolist()) if isinstance(v, np.ndarray) else v for k, v in changes.items()}
        return dataclasses.replace(cast("Any", self), **(self._given() | new))

    def with_read_numbers(self, numbers: NumberReader) -> Deformation:
        """The copy with the numbers as a reader gives them."""
        other, arguments = copy.copy(self), self._given()
        for entry in dataclasses.fields(cast("Any", self)):
            plain = getattr(self, entry.name)
            argument = arguments.get(entry.name, plain)
            if isinstance(plain, float):
                object.__setattr__(other, entry.name, numbers.vector(argument, [plain])[0])
            elif isinstance(plain, tuple):
                object.__setattr__(other, entry.name, numbers.vector(argument, cast("Any", plain)))
        return other

    @property
    def min_scale(self) -> float:
        """The smallest factor by which the map multiplies lengths, and so the wavelengths of a
        solid's function. It is an estimate, for `Traits.min_wavelength`.

        The default is 1. It is also used for maps whose factors have no positive lower bound: a
        twist compresses waves the more, the farther they are from its axis.
        """
        return 1.0

    @abc.abstractmethod
    def preimage(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The point that the map takes to (x, y, z). Coordinates may be numbers of any
        arithmetic."""

    @abc.abstractmethod
    def volume(self, volume: Volume | None) -> Volume | None:
        """A volume that contains the image of `volume` under the map; None if `volume` is None or
        unbounded."""

    @abc.abstractmethod
    def preimage_lipschitz(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of the inverse map `preimage` on a ball about p, and the radius of
        that ball."""

    @abc.abstractmethod
    def on_backend(self, backend: Backend) -> Deformation:
        """The same map with its numbers as kernel parameters of the backend (numbers that a
        compiled kernel reads when it runs)."""


@dataclass(frozen=True, eq=False)
class DeformedSolid(FormulaSolid):
    """The image of a solid, the inner solid, under a deformation. f at a point p is the inner
    solid's formula at the preimage of p, the point that the deformation takes to p.

    inner: the inner solid.
    map: the deformation.

    Steps along a ray need no Lipschitz constant of the map. The ranges of the preimage's
    coordinates along the ray, and of their derivatives, are passed on to the formula.
    """

    traits = by_numbers("inner", "map")

    inner: Solid
    map: Deformation

    def with_read_numbers(self, numbers: NumberReader) -> DeformedSolid:
        """The copy with the attached numbers of the inner solid and of the map."""
        other = copy.copy(self)
        object.__setattr__(other, "inner", attached(self.inner, numbers))
        object.__setattr__(other, "map", self.map.with_read_numbers(numbers))
        return other

    def __post_init__(self) -> None:
        """Set the domain and the smallest wavelength, which follow from those of the inner
        solid."""
        if self.inner.domain is not None:
            domain = self.map.volume(self.inner.domain)
            object.__setattr__(self, "domain", domain)
        if (wavelength := self.inner.traits.min_wavelength) is not None:
            wavelength = wavelength * self.map.min_scale
            traits = dataclasses.replace(self.traits, min_wavelength=wavelength)
            object.__setattr__(self, "traits", traits)

    @property
    def may_jump(self) -> bool:
        """Whether f may jump: whether the inner solid's formula may, as the map is continuous."""
        return tally_of(self.inner.formula).may_jump

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        return self.map.volume(self.inner.sublevel_extent(level, above=above))

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        return own_formula(self.inner)(*self.map.preimage(x, y, z))

    def formula_on(self, backend: Backend) -> FormulaFunction:
        return _DeformedFormula(self.inner.formula_on(backend), self.map.on_backend(backend))

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        del plan
        inner, change = self.inner.evaluator(backend), self.map.on_backend(backend)
        # The constant of the inner solid; on the backend, if it is a formula.
        constant = inner.lipschitz if isinstance(inner, FormulaEvaluator) else self.inner.lipschitz
        formula = _DeformedFormula(formula_of(inner), change)
        return _DeformedSolidEvaluator(self, formula, self.lipschitz, constant, change)


@dataclass(frozen=True, eq=False)
class _DeformedFormula:
    """The function of a deformed solid.

    inner: the function of the inner solid.
    map: the deformation.
    """

    inner: FormulaFunction
    map: Deformation

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        return self.inner(*self.map.preimage(x, y, z))


@dataclass(frozen=True, eq=False)
class _DeformedSolidEvaluator(FormulaEvaluator):
    """The evaluator of a `DeformedSolid`.

    constant: a Lipschitz constant of the inner solid; None if none is known.
    map: the deformation.
    """

    constant: Any
    map: Deformation

    def promises(self, p: Vec3) -> tuple[Promise, ...]:
        """A Lipschitz constant of f on a ball about p, as a promise (a proved bound near p): the
        constant of the inner solid times that of the inverse map; () if the inner solid has no
        constant."""
        if self.constant is None:
            return ()
        stretch, radius = self.map.preimage_lipschitz(p)
        return (Lipschitz(self.constant * stretch, radius),)


@dataclass(frozen=True)
class Twist(Deformation):
    """The map that rotates cross sections about an axis by `rate` radians for each unit of length
    along it (Hart 1996, equation 50).

    rate: in radians per unit of length.
    axis: "x", "y" or "z".

    Proof of `preimage_lipschitz`. Let a be the rate, and x and y the coordinates across the axis.
    The derivative of the inverse map is a rotation times the matrix [[1, 0, -y a], [0, 1, x a], [0,
    0, 1]]. Its largest singular value is (m + sqrt(m^2 + 4))/2, where m is |a| times the distance
    from the axis. It grows with m, so on a ball it is bounded by its value for the largest m there.
    (Hart's equation 51 is too small for large a.)
    """

    rate: Any
    axis: str = "z"

    def __post_init__(self) -> None:
        axis_index(self.axis)
        if is_attached_number(self.rate, "a twist"):
            object.__setattr__(self, "_given_numbers", {"rate": self.rate})
            rate = as_real(self.rate, "rate, in radians a unit of length,")
            object.__setattr__(self, "rate", rate)
        if isinstance(self.rate, float) and not math.isfinite(self.rate):
            raise ValueError(f"rate must be finite, in radians a unit of length, not {self.rate!r}")

    def preimage(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        u, v, w = _axis_last((x, y, z), self.axis)
        angle = w * self.rate
        cosine, sine = cos(angle), sin(angle)
        return _axis_in_place((u * cosine + v * sine, v * cosine - u * sine, w), self.axis)

    def volume(self, volume: Volume | None) -> Volume | None:
        cylinder = _cylinder_around(volume, self.axis)
        return (
            None if cylinder is None else _box_around_cylinder(cylinder[0], cylinder[1], self.axis)
        )

    def preimage_lipschitz(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of the inverse map on a ball about p, and the radius of that ball.
        The constant is (m + sqrt(m^2 + 4))/2, where m is the rate times the largest distance from
        the axis on the ball (the class docstring has the proof). Without a twist the constant is 1
        everywhere."""
        # 0 * p.x + number is a Dr.Jit array, with the number in each lane.
        rate = dr.abs(0 * p.x + self.rate)
        axis_distance = _distance_from_axis(p, self.axis)
        # Any radius is valid; this one keeps m within a factor of about 5/4, plus 1/4.
        radius = 0.25 * axis_distance + 0.25 / rate
        m = (axis_distance + radius) * rate
        constant = 0.5 * (m + dr.sqrt(m * m + 4)) * (1 + 1e-5)
        # At the rate 0, m is NaN.
        return dr.select(rate > 0, constant, 1), dr.select(rate > 0, radius, dr.inf)

    def on_backend(self, backend: Backend) -> Twist:
        return with_device_numbers(self, backend)


@dataclass(frozen=True)
class Taper(Deformation):
    """The map that scales cross sections about an axis by a factor r that depends on the position
    along the axis. r is linear between two positions and constant beyond them.

    start, end: (position along the axis, factor r there); start lies before end, and factors are
        positive.
    axis: "x", "y" or "z".

    Proof of `preimage_lipschitz`. Let rho be the distance from the axis, r' the derivative of r
    along it, k = 1/r and m = rho |r'|/r^2. The derivative of the inverse map acts on the radial and
    the axial direction as the matrix [[k, m], [0, 1]], and on the third direction as the factor k.
    The square of its largest singular value is (S + sqrt(S^2 - 4 k^2))/2 with S = k^2 + m^2 + 1,
    which grows with k and m. So on a ball it is bounded by its value for the largest k and m there.
    (Hart's equation 49 has min 1/r.)
    """

    start: tuple[Any, Any]
    end: tuple[Any, Any]
    axis: str = "z"

    def __post_init__(self) -> None:
        """Check the arguments.

        Raises:
            ValueError: start or end is not a pair of finite numbers, start does not lie before end,
                or a factor is not positive.
        """
        axis_index(self.axis)
        pairs = {"start": self.start, "end": self.end}
        attached = {name: end for name, end in pairs.items() if is_attached_number(end, "a taper")}
        object.__setattr__(self, "_given_numbers", attached)
        for name, value in pairs.items():
            plain = detached(value)
            if plain is not value and np.ndim(plain) == 1:
                object.__setattr__(self, name, tuple(plain.tolist()))
        try:
            ends = (*self.start, *self.end)
        except TypeError:
            ends = ()
        if len(ends) != 4:
            raise ValueError(
                "start and end must be (coordinate, scale), two numbers each, "
                f"not {self.start!r} and {self.end!r}"
            )
        if not all(isinstance(number, numbers.Real) and math.isfinite(number) for number in ends):
            raise ValueError("start and end must be (coordinate, scale), finite numbers")
        if not self.start[0] < self.end[0]:
            raise ValueError(f"start must lie before end: {self.start[0]} < {self.end[0]} is wrong")
        if not (self.start[1] > 0 and self.end[1] > 0):
            raise ValueError(f"scales must be positive, not {self.start[1]}, {self.end[1]}")
        for name in ("start", "end"):
            object.__setattr__(self, name, tuple(float(number) for number in getattr(self, name)))

    @property
    def min_scale(self) -> float:
        return min(1.0, self.start[1], self.end[1])

    def preimage(self, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
        """The point that the taper takes to (x, y, z): its coordinates across the axis are divided
        by the factor r."""
        u, v, w = _axis_last((x, y, z), self.axis)
        # Positions along the axis, and the factors there.
        (a, first), (b, last) = self.start, self.end
        # The position between start (0) and end (1); then 1/r there.
        fraction = minimum(maximum((w - a) * (1.0 / (b - a)), 0.0), 1.0)
        inverse = 1.0 / (fraction * (last - first) + first)
        return _axis_in_place((u * inverse, v * inverse, w), self.axis)

    def volume(self, volume: Volume | None) -> Volume | None:
        """A box that contains the image of `volume`: the box around a cylinder about the axis,
        whose radius is multiplied by the larger factor. None if `volume` is None or unbounded."""
        # (radius, ends along the axis)
        cylinder = _cylinder_around(volume, self.axis)
        if cylinder is None:
            return None
        return _box_around_cylinder(
            cylinder[0] * max(self.start[1], self.end[1]), cylinder[1], self.axis
        )

    def preimage_lipschitz(self, p: Vec3) -> tuple[Real, Real]:
        """A Lipschitz constant of the inverse map on a ball about p, and the radius of that ball.
        The square of the constant is (S + sqrt(S^2 - 4 k^2))/2 with S = k^2 + m^2 + 1 (here
        `total`). k and m bound 1/r and rho |r'|/r^2 on the ball, where r is the factor, r' its
        derivative along the axis and rho the distance from the axis (the class docstring has the
        proof)."""
        # Positions along the axis, and the factors there, each with one lane for each ball.
        (a, first), (b, last) = ((0 * p.x + u, 0 * p.x + v) for u, v in (self.start, self.end))
        axis_distance = _distance_from_axis(p, self.axis)
        # Any radius is valid; a larger one has a larger constant.
        radius = 0.25 * axis_distance + 0.25 * (b - a)
        # The largest k and m on the ball.
        k = 1 / fmin(first, last)
        m = (axis_distance + radius) * dr.abs(last - first) / (b - a) * k * k
        total = k * k + m * m + 1
        root = dr.sqrt(fmax(total * total - 4 * k * k, 0))
        # (1e-5 covers the rounding of the constant.)
        return dr.sqrt(0.5 * (total + root)) * (1 + 1e-5), radius

    def on_backend(self, backend: Backend) -> Taper:
        return with_device_numbers(self, backend)


def _distance_from_axis(p: Vec3, axis: str) -> Real:
    """The distance of p from a coordinate axis."""
    u, v, _ = _axis_last((p.x, p.y, p.z), axis)
    return dr.sqrt(u * u + v * v)


def _axis_last(p: tuple[Any, Any, Any], axis: str) -> tuple[Any, Any, Any]:
    """The coordinates of p in cyclic order, such that the coordinate along `axis` is the last. For
    example (y, z, x) for the axis "x"."""
    k = AXES[axis]
    return p[(k + 1) % 3], p[(k + 2) % 3], p[k]


def _axis_in_place(p: tuple[Any, Any, Any], axis: str) -> tuple[Any, Any, Any]:
    """The inverse of `_axis_last`: coordinates whose last is the one along `axis`, put into the
    order x, y, z."""
    k = AXES[axis]
    x, y, z = (p[(i - k - 1) % 3] for i in range(3))
    return x, y, z


def _cylinder_around(volume: Volume | None, axis: str) -> tuple[float, tuple[float, float]] | None:
    """A cylinder about a coordinate axis that contains a volume: its radius, and the ends (low,
    high) of its range along the axis. None if there is no volume, or it is unbounded."""
    if volume is None:
        return None
    lower, upper = volume.bounds()
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        return None
    k = AXES[axis]
    # The cylinder around the box of the volume; for a ball, the smaller one around the ball. The
    # factor is for rounding.
    max_abs = np.maximum(np.abs(lower), np.abs(upper))
    radius = float(np.hypot(max_abs[(k + 1) % 3], max_abs[(k + 2) % 3])) * (1 + 1e-12)
    if isinstance(volume, Ball):
        center = np.asarray(volume.center, dtype=float)
        radius = float(np.hypot(center[(k + 1) % 3], center[(k + 2) % 3]) + volume.radius)
        radius *= 1 + 1e-12
    return radius, (float(lower[k]), float(upper[k]))


def _box_around_cylinder(radius: float, span: tuple[float, float], axis: str) -> Box:
    """The box that contains a cylinder about a coordinate axis.

    span: the ends (low, high) of the cylinder along the axis.
    """
    lower = [-radius] * 3
    upper = [radius] * 3
    lower[AXES[axis]], upper[AXES[axis]] = span
    return Box((lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]))
