"""Clearances: proved lower bounds of the distance to a level set, and the extents they prove.

`clearance_of` gives them at points, `tight_extent` and `occupied_cells` prove where level sets are.
Also here: `UploadedField`, the base of fields whose data lie on a backend, in coordinates in which
they have a size of about one.
"""

from __future__ import annotations

import abc
import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, backend_of, choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import fmax, fmin, largest_coordinate, length
from harnack.cluster.serialization import Remembered
from harnack.enclosures import Gaps, Slopes, TargetLevels, choose_proofs, longest_step
from harnack.fields.batched_fields import BatchedField, SumAtDetail, prepared_once
from harnack.fields.field import Field
from harnack.tree.empty_space import Cells, OccupiedCells, carve, union, wrapped_points

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields.samples import Sample
    from harnack.geometry import ConvexHull, Volume
    from harnack.tree.empty_space import Clearance

__all__ = ["clearance_of", "distance_below", "occupied_cells", "tight_extent"]

# Uses all promises of a field: points are few, and the longest proof counts.
_PROOFS = choose_proofs("curvature")


def clearance_of(
    field: Field, levels: tuple[float, ...], precision: Precision = "double"
) -> Clearance:
    """`distance_below` at points (n, 3)."""
    backend = choose_backend(precision)
    prepared = field.prepare(backend)
    # Kernel parameters, so that other levels compile nothing.
    values = tuple(dr.opaque(backend.Float, level) for level in levels)
    targets = TargetLevels(values, field.period)

    def clearance(points: FloatArray) -> FloatArray:
        p = to_vector3(backend, points)
        return to_numpy(distance_below(backend, prepared, targets, p, prepared.evaluate(p)))

    return clearance


def tight_extent(
    field: Field,
    levels: tuple[float, ...],
    lower: FloatArray,
    upper: FloatArray,
    most: int,
    finest: int = 5,
    points: FloatArray | None = None,
) -> ConvexHull:
    """A polytope of few planes that contains every point of the level sets inside a box.

    Cells of the box are left out if the ball around them is within the clearance of its center; the
    polytope is around those that are left.

    most, finest: as for `carve`.
    points: (n, 3) that the polytope is to contain in any case. The polytope around them need not be
        tested: a ball inside of it may be left out as well.
    """
    clearance = clearance_of(field, levels)
    slack = 1e-4 * float(np.linalg.norm(upper - lower))
    if points is not None:
        held = wrapped_points(points, slack)
        cells = carve(lower, upper, _outside(held, clearance), most, finest)
        return union(held, cells.wrapped(slack)) if len(cells.corners) else held
    cells = carve(lower, upper, clearance, most, finest)
    if not len(cells.corners):  # no level anywhere: any box will do
        cells = Cells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return cells.wrapped(slack)


def _outside(held: ConvexHull, clearance: Clearance) -> Clearance:
    """The clearance from what lies outside a polytope: inside, the distance to its faces."""

    def beyond(points: FloatArray) -> FloatArray:
        depth = (held.offsets - points @ held.normals.T).min(axis=1)
        outside = depth <= 0
        if outside.any():
            depth[outside] = clearance(points[outside])
        return depth

    return beyond


def occupied_cells(
    field: Field, levels: tuple[float, ...], extent: Volume, across: int
) -> OccupiedCells:
    """A grid over an extent, with about so many cells along its longest side."""
    return OccupiedCells.of(*extent.bounds(), clearance_of(field, levels, "single"), across)


def distance_below(
    backend: Backend, field: Field, levels: TargetLevels, p: Vec3, sample: Sample
) -> Real:
    """A proved lower bound of the distance from p to the nearest level; sample: the field at p.

    Proof. An enclosure holds f(p + tv) within [L(t, s), U(t, s)], s the slope along a unit
    direction v, and steps to where that first meets a level. Neither end falls as s grows, as every
    enclosure has to prove (`Enclosure`).

    All slopes lie in [-G, G], G = |grad f(p)| and its error: one enclosure with that interval of
    slopes holds in every direction. The distances to the level above and to that below are proved
    separately, each by the promise that proves most.

    As in the tracer the levels count as nearer by the rounding of value and position, and the
    result is shortened by the rounding of p itself. Where f jumps, all this is about f with the
    jumps taken out, which is f up to the nearest sheet.
    """
    steepest = length(sample.gradient) + sample.gradient_error
    size = largest_coordinate(p)
    epsilon = backend.epsilon
    rounding = 8 * epsilon * dr.abs(sample.value) + 4 * epsilon * size * steepest
    gaps = levels.gaps(sample.value).less(rounding + sample.error)
    enclosures = _PROOFS.enclose(
        sample.known, sample.weaker, sample.value, sample.error, Slopes(-steepest, steepest)
    )
    none = backend.Float(dr.inf)
    above = longest_step(enclosures, Gaps(none, gaps.up))
    below = longest_step(enclosures, Gaps(gaps.down, none))
    distance = dr.select(gaps.smaller > 0, fmin(above, below), 0)
    if field.has_sheets:
        distance = fmin(distance, field.distance_to_sheets(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)


@dataclass(frozen=True)
class UnitCoordinates:
    """Data on a backend in unit coordinates x: the point is center + size * x. Subclasses add the
    data."""

    backend: Backend
    center: Vec3
    size: Real

    def unit(self, p: Vec3) -> Vec3:
        """A point p in unit coordinates."""
        return (self.backend.Array3f(p) - self.center) / self.size


Uploaded = TypeVar("Uploaded", bound=UnitCoordinates)


class UploadedField(Field, Generic[Uploaded]):
    """A field that is evaluated from data on a backend. Subclasses define `_upload`."""

    def __init__(self) -> None:
        self._device: Uploaded | None = None
        self._batches: Remembered[Backend, Uploaded] = Remembered()

    @abc.abstractmethod
    def _upload(self, backend: Backend, *, traced: bool) -> Uploaded:
        """The data, for tracing or for values at points."""

    @prepared_once
    def prepare(self, backend: Backend) -> Self:
        if self._device is not None and self._device.backend is backend:
            return self
        prepared = copy.copy(self)
        prepared._device = self._upload(backend, traced=True)
        return prepared

    def _on(self, p: Vec3) -> Uploaded:
        """The data for tracing; on the backend of p if `prepare` was not called."""
        if self._device is None:
            return self._upload(backend_of(p), traced=True)
        return self._device

    def _prepared(self) -> Uploaded:
        """The data for tracing; RuntimeError if `prepare` was not called."""
        if self._device is None:
            raise RuntimeError("prepare(backend) comes first, before at_detail")
        return self._device

    def _batch(self, backend: Backend) -> Uploaded:
        """The data for values at points, uploaded once for each backend."""
        if backend not in self._batches:
            self._batches[backend] = self._upload(backend, traced=False)
        return self._batches[backend]


class DetailedField(UploadedField[Uploaded], BatchedField):
    """An uploaded sum with a choice of detail (`Field.at_detail`). Subclasses define
    `_sample`."""

    has_detail = True

    values_take_more: ClassVar[bool] = True
    """Whether the data for values at points differ from those for tracing."""

    @abc.abstractmethod
    def _sample(self, on: Uploaded, p: Vec3, detail: Real) -> Sample:
        """f at p from the data, at a detail (`Field.at_detail`)."""

    def evaluate(self, p: Vec3) -> Sample:
        on = self._on(p)
        return self._sample(on, p, on.backend.Float(1))

    def at_detail(self, detail: Real) -> Field:
        on = self._prepared()
        closer = fmax(on.backend.Float(detail), on.backend.Float(1))
        return SumAtDetail(
            lambda p: self._sample(on, p, detail), lambda p: self.values_at(p, 2, closer)
        )

    def _batch(self, backend: Backend) -> Uploaded:
        device = self._device
        if self.values_take_more or device is None or device.backend is not backend:
            return super()._batch(backend)
        return device


def single(center: FloatArray) -> FloatArray:
    """The nearest center that single precision holds exactly: subtracting it from points nearby is
    then exact, however far the origin is."""
    with np.errstate(over="ignore"):
        rounded = center.astype(np.float32).astype(np.float64)
    return np.where(np.isfinite(rounded), rounded, center)


def placed(backend: Backend, center: FloatArray, size: float) -> tuple[Backend, Vec3, Real]:
    """The attributes of `UnitCoordinates`, as kernel parameters."""
    opaque = (dr.opaque(backend.Float, float(c)) for c in center)
    return backend, backend.Array3f(*opaque), dr.opaque(backend.Float, size)


def epsilon_at(x: Vec3) -> Real:
    """The rounding of a coordinate of x, or of a vertex of size about one."""
    return float(dr.epsilon(x)) * (1 + dr.max(dr.abs(x)))
