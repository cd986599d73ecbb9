"""The interface of a clip volume: a convex set to which rays are cut. A ray is o + t d, with origin
o, direction d and ray parameter t. The backend is where Dr.Jit runs; a kernel is a program that it
compiles, and a kernel parameter a number that may change without compiling again.

Extents are clip volumes, too: volumes that are proved to contain the level set of a field. The 2π
level of the solid angle of a curve in convex position lies in the curve's hull; for other curves,
empty cells are removed from an isoperimetric box. So rays that miss the extent take no time, and
for a ray without an end a miss can be proved. If a field is expensive to evaluate
(`Field.occupied_cells`) and there are many rays, the march also jumps across the empty cells of a
grid.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend.validation import as_real, as_real_array, check_no_derivatives, check_vectors

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, BoolArray, FloatArray, Mask, Real, Vec3

Point: TypeAlias = tuple[float, float, float]


class Volume(abc.ABC):
    """A closed convex set in space, not empty, to which rays are cut.

    In any precision, `clip` and `contains` lose no point of the volume: they exclude a point only
    if it is certainly outside. They may admit points that lie outside by a few rounding errors of
    the coordinates (about 1e-6 of the distance to the ray's origin in single precision).

    Methods that take Dr.Jit arrays can be called while a loop is being recorded.

    `a & b` is the intersection of two volumes, which is convex as well.
    """

    def __new__(cls, *given: Any, **named: Any) -> Self:
        """Make a volume. Raises an error for numbers with derivatives, which would be lost."""
        check_no_derivatives(cls.__name__, *given, *named.values())
        return super().__new__(cls)

    def __and__(self, other: object) -> Volume:
        """The intersection of two volumes. If one of them is an intersection itself, its volumes
        become members of the new intersection."""
        from harnack.geometry.clip_volumes import VolumeIntersection

        if not isinstance(other, Volume):
            return NotImplemented
        return VolumeIntersection((*_operands(self), *_operands(other)))

    @abc.abstractmethod
    def clip(self, o: Vec3, d: Vec3, t_min: Real, t_max: Real) -> tuple[Real, Real]:
        """The interval [t0, t1] of the ray parameters t, 0 <= t_min <= t <= t_max, for which the
        point o + t d of each ray lies inside the volume. Returns t0 and t1. If a ray misses the
        volume, t0 = inf and t1 = -inf; otherwise t0 < t1.

        o, d: origins and directions; d need not have unit length, but must not be zero.
        """

    @abc.abstractmethod
    def contains(self, p: Vec3) -> Mask:
        """Whether points p lie in the volume, boundary included."""

    @abc.abstractmethod
    def signed_distance(self, p: Vec3) -> Real:
        """The distance of p from the boundary, negative inside. For points outside it may be a
        lower bound of the distance."""

    @abc.abstractmethod
    def outward_normal(self, p: Vec3) -> Vec3:
        """Unit outward normal of the part of the boundary nearest to p, for p near the boundary."""

    @abc.abstractmethod
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner, (3,) each, of an axis-aligned box around the volume; coordinates
        may be infinite."""

    @abc.abstractmethod
    def contains_points(self, points: npt.ArrayLike) -> BoolArray:
        """Whether points (n, 3) lie in the volume, computed in double precision by NumPy: (n,)."""

    @abc.abstractmethod
    def padded(self, distance: float) -> Volume:
        """A volume that contains every point within `distance` (>= 0, finite) of this volume."""

    def upload(self, backend: Backend) -> Volume:
        """An equal volume whose numbers are kernel parameters on the backend. So no other kernel
        has to be compiled for another volume of the same kind."""
        del backend
        return self


def _operands(volume: Volume) -> tuple[Volume, ...]:
    """The volumes of an intersection, as a tuple; for a volume of another kind, that volume
    alone."""
    volumes: tuple[Volume, ...] | None = getattr(volume, "volumes", None)
    return (volume,) if volumes is None else volumes


def clip_rounding(backend: Backend) -> float:
    """The relative error that is allowed for one formula of clipping: ten roundings, each of half a
    unit in the last place. The longest chain of roundings among all volumes (a plane: its normal
    rounded to the backend, three products, three sums, one division) is nine."""
    return 10.0 * float(dr.epsilon(backend.Float))


def normalize_empty_interval(t0: Real, t1: Real) -> tuple[Real, Real]:
    """The interval [t0, t1] of each lane; (inf, -inf) where it is empty or a single point."""
    is_nonempty = t0 < t1
    return dr.select(is_nonempty, t0, dr.inf), dr.select(is_nonempty, t1, -dr.inf)


def as_point(value: Iterable[float], name: str, *, finite: bool = True) -> Point:
    """Convert three numbers to a tuple of floats.

    name: what they are, for messages.
    finite: whether all must be finite.

    Raises:
        ValueError: not three numbers, NaN, or infinite where it must not be.
    """
    try:
        if isinstance(value, str | bytes):  # iterable, but not of numbers
            raise TypeError
        numbers = tuple(as_real(v, name) for v in value)
    except TypeError:
        raise ValueError(f"{name} must be three numbers, not {value!r}") from None
    if len(numbers) != 3:
        raise ValueError(f"{name} must be three numbers, not {numbers}")
    if any(map(math.isnan, numbers)) or (finite and not all(map(math.isfinite, numbers))):
        raise ValueError(f"{name} must be finite, not {numbers}")
    return numbers


def check_volume(value: object, name: str) -> None:
    """Raise TypeError for a value that is neither a volume nor None.

    name: what it is, for the message.
    """
    if value is not None and not isinstance(value, Volume):
        raise TypeError(
            f"{name} must be a volume: a harnack.Ball, harnack.Box or harnack.HalfSpace, or an "
            f"intersection of these, not {value!r}"
        )


def as_padding(distance: float) -> float:
    """Convert the distance by which a volume is enlarged to a float.

    Raises:
        ValueError: it is negative, infinite or NaN.
    """
    if not 0.0 <= distance < np.inf:
        raise ValueError(f"the padding must be finite and not negative, not {distance!r}")
    return float(distance)


def as_points(points: npt.ArrayLike) -> FloatArray:
    """Convert points to a float64 array (n, 3).

    Raises:
        ValueError: no real numbers, or another shape.
    """
    array = as_real_array(points, "points")
    check_vectors(array, "points")
    return np.asarray(array, dtype=np.float64)
