"""Clearances (proved lower bounds of the distance to a level set) and the extents that they prove.

`clearance_function` gives clearances at points. `tight_extent` proves in which volume the level
sets lie, and `occupied_cells` in which cells. Also here: `DeviceField`, the base of fields whose
data lie on a backend, in coordinates in which they have a size of about 1.
"""

from __future__ import annotations

import abc
import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, backend_of, choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import fmax, fmin, max_norm, safe_norm
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import LevelGaps, Levels, SlopeRange, choose_enclosures, longest_free_length
from harnack.fields.batched_fields import BatchedField, SumAtDetail, cached_prepare
from harnack.fields.field import Field
from harnack.tree.empty_space import (
    BoxCells,
    OccupancyGrid,
    kdop_of_points,
    merge_kdops,
    nonempty_cells,
)

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields.samples import Sample
    from harnack.geometry import ConvexHull, Volume
    from harnack.tree.empty_space import Clearance

__all__ = ["clearance_function", "level_distance_lower_bound", "occupied_cells", "tight_extent"]

# The enclosures by which clearances are proved. They use all promises of a field: there are few
# points, and the longest proof counts.
_PROOFS = choose_enclosures("curvature")


def clearance_function(
    field: Field, levels: tuple[float, ...], precision: Precision = "double"
) -> Clearance:
    """A function that takes points (n, 3) and returns their clearances (n,): proved lower bounds of
    the distance to the nearest of the levels' surfaces (`level_distance_lower_bound`)."""
    backend = choose_backend(precision)
    prepared = field.prepare(backend)
    # Kernel parameters, so that other levels compile nothing.
    values = tuple(dr.opaque(backend.Float, level) for level in levels)
    targets = Levels(values, field.period)

    def clearance(points: FloatArray) -> FloatArray:
        """The clearances (n,) of points (n, 3)."""
        p = to_vector3(backend, points)
        return to_numpy(
            level_distance_lower_bound(backend, prepared, targets, p, prepared.evaluate(p))
        )

    return clearance


def tight_extent(
    field: Field,
    levels: tuple[float, ...],
    lower: FloatArray,
    upper: FloatArray,
    max_cells: int,
    finest: int = 5,
    points: FloatArray | None = None,
) -> ConvexHull:
    """A convex polytope of few planes that contains every point of the level sets inside a box.

    The box is cut into cells. A cell is left out if the ball around it is within the clearance of
    its center (the proved lower bound of the distance to the level sets). The polytope contains the
    remaining cells.

    lower, upper: (3,) corners of the box.
    max_cells: the largest number of cells tested in a round.
    finest: the largest number of rounds; each halves the edges of cells.
    points: (n, 3) that the polytope must contain in any case. A polytope is put around them first,
        and no cells inside of it are tested.
    """
    clearance = clearance_function(field, levels)
    margin = 1e-4 * float(np.linalg.norm(upper - lower))
    if points is not None:
        given = kdop_of_points(points, margin)
        cells = nonempty_cells(
            lower, upper, _clearance_outside(given, clearance), max_cells, finest
        )
        return merge_kdops(given, cells.bounding_kdop(margin)) if len(cells.corners) else given
    cells = nonempty_cells(lower, upper, clearance, max_cells, finest)
    if not len(cells.corners):  # no level anywhere: any box will do
        cells = BoxCells(np.array(lower)[None], np.array(upper) - np.array(lower))
    return cells.bounding_kdop(margin)


def _clearance_outside(polytope: ConvexHull, clearance: Clearance) -> Clearance:
    """A function that takes points (n, 3) and returns lengths (n,) within which there is no level
    set outside of a polytope. For a point inside the polytope it is the distance to the nearest
    face; for a point outside, the result of `clearance`.

    clearance: a function that takes points and returns lower bounds of their distances to the level
        sets.
    """

    def clearance_outside(points: FloatArray) -> FloatArray:
        """The clearances (n,) of points (n, 3)."""
        depth = (polytope.offsets - points @ polytope.normals.T).min(axis=1)
        outside = depth <= 0
        if outside.any():
            depth[outside] = clearance(points[outside])
        return depth

    return clearance_outside


def occupied_cells(
    field: Field, levels: tuple[float, ...], extent: Volume, cells_across: int
) -> OccupancyGrid:
    """A grid of cells over an extent. The cells that may contain a point of the level sets are
    marked; all others are proved to contain none.

    cells_across: the approximate number of cells along the longest side.
    """
    return OccupancyGrid.from_clearance(
        *extent.bounds(), clearance_function(field, levels, "single"), cells_across
    )


def level_distance_lower_bound(
    backend: Backend, field: Field, levels: Levels, p: Vec3, sample: Sample
) -> Real:
    """A proved lower bound of the distance from the points p to the nearest level set.

    field: prepared for the backend.
    sample: the sample of the field at p.

    Proof. Let v be a unit direction and s the slope of f at p along v. An enclosure (a proof of
    bounds of f along a path) holds f(p + t v) within an interval [L(t, s), U(t, s)]. The length
    that it proves free ends where this interval first meets a level. Neither L nor U falls as s
    grows, which every enclosure has to prove (`Enclosure`).

    All slopes at p lie in [-G, G], where G is |grad f(p)| plus its error. So an enclosure with that
    interval of slopes holds in every direction. The distances to the level above and to the level
    below are proved separately, each by the promise (a proved bound of f near p) that proves the
    larger distance.

    As in the tracer, the differences of f to the levels are reduced by the rounding of value and
    position, and the result is reduced by the rounding of p itself. If f jumps, the bound is for f
    continued smoothly through all facets, which equals f up to the nearest facet.
    """
    steepest = safe_norm(sample.gradient) + sample.gradient_error
    size = max_norm(p)
    epsilon = backend.machine_epsilon
    rounding = 8 * epsilon * dr.abs(sample.value) + 4 * epsilon * size * steepest
    gaps = levels.gaps(sample.value).reduced_by(rounding + sample.value_error)
    enclosures = _PROOFS.from_promises(
        sample.promises,
        sample.alternative_promises,
        sample.value,
        sample.value_error,
        SlopeRange(-steepest, steepest),
    )
    inf = backend.Float(dr.inf)
    upward = longest_free_length(enclosures, LevelGaps(inf, gaps.above))
    downward = longest_free_length(enclosures, LevelGaps(gaps.below, inf))
    distance = dr.select(gaps.nearest > 0, fmin(upward, downward), 0)
    if field.has_jumps:
        distance = fmin(distance, field.distance_to_jumps(p))
    return fmax(backend.Float(distance) - 2 * epsilon * size, 0)


@dataclass(frozen=True)
class UnitFrame:
    """Data of a field on a backend, in unit coordinates. A point x in unit coordinates stands for
    the point p = center + size * x. Subclasses add the data."""

    backend: Backend
    center: Vec3
    size: Real

    def to_unit(self, p: Vec3) -> Vec3:
        """The point p in unit coordinates."""
        return (self.backend.Array3f(p) - self.center) / self.size


Uploaded = TypeVar("Uploaded", bound=UnitFrame)


class DeviceField(Field, Generic[Uploaded]):
    """A field that is evaluated from data on a backend. Subclasses define `_upload`."""

    def __init__(self) -> None:
        self._device: Uploaded | None = None
        self._batches: TransientCache[Backend, Uploaded] = TransientCache()

    @abc.abstractmethod
    def _upload(self, backend: Backend, *, traced: bool) -> Uploaded:
        """The data on a backend.

        traced: whether they are for tracing; else they are for values at points.
        """

    @cached_prepare
    def prepare(self, backend: Backend) -> Self:
        if self._device is not None and self._device.backend is backend:
            return self
        prepared = copy.copy(self)
        prepared._device = self._upload(backend, traced=True)
        return prepared

    def _data_for(self, p: Vec3) -> Uploaded:
        """The data for tracing, on the backend for which the field is prepared; if it is not
        prepared, they are uploaded to the backend of p."""
        if self._device is None:
            return self._upload(backend_of(p), traced=True)
        return self._device

    def _require_data(self) -> Uploaded:
        """The data for tracing, on the backend for which the field is prepared.

        Raises:
            RuntimeError: `prepare` was not called.
        """
        if self._device is None:
            raise RuntimeError("prepare(backend) comes first, before at_detail")
        return self._device

    def _batch_data(self, backend: Backend) -> Uploaded:
        """The data for values at points, uploaded once for each backend."""
        if backend not in self._batches:
            self._batches[backend] = self._upload(backend, traced=False)
        return self._batches[backend]


class VariableAccuracyField(DeviceField[Uploaded], BatchedField):
    """A field that is a sum over sources on a backend, and can be sampled at any accuracy
    (`Field.at_accuracy`). Subclasses define `_sample`."""

    has_variable_accuracy = True

    has_separate_batch_data: ClassVar[bool] = True
    """Whether the data for values at points differ from those for tracing."""

    @abc.abstractmethod
    def _sample(self, on: Uploaded, p: Vec3, detail: Real) -> Sample:
        """The sample of f at p.

        on: the field's data on a backend.
        detail: the accuracy scale: 0 for the coarsest samples, 1 for those of `evaluate`, more for
            more accurate ones.
        """

    def evaluate(self, p: Vec3) -> Sample:
        on = self._data_for(p)
        return self._sample(on, p, on.backend.Float(1))

    def at_accuracy(self, detail: Real) -> Field:
        on = self._require_data()
        closer = fmax(on.backend.Float(detail), on.backend.Float(1))
        return SumAtDetail(
            lambda p: self._sample(on, p, detail), lambda p: self.values_at(p, 2, closer)
        )

    def _batch_data(self, backend: Backend) -> Uploaded:
        """The data for values at points. If the data for tracing do not differ from them, those are
        taken."""
        device = self._device
        if self.has_separate_batch_data or device is None or device.backend is not backend:
            return super()._batch_data(backend)
        return device


def round_to_single(center: FloatArray) -> FloatArray:
    """A center (3,), rounded to numbers that single precision represents exactly. Subtracting it
    from nearby points is then exact, however far the origin is."""
    with np.errstate(over="ignore"):
        rounded = center.astype(np.float32).astype(np.float64)
    return np.where(np.isfinite(rounded), rounded, center)


def frame_parameters(
    backend: Backend, center: FloatArray, size: float
) -> tuple[Backend, Vec3, Real]:
    """The attributes of `UnitFrame`, as kernel parameters."""
    opaque = (dr.opaque(backend.Float, float(c)) for c in center)
    return backend, backend.Array3f(*opaque), dr.opaque(backend.Float, size)


def coordinate_rounding(x: Vec3) -> Real:
    """A bound of the rounding of the coordinates of x, a point in unit coordinates, and of vertices
    of size about 1."""
    return float(dr.epsilon(x)) * (1 + dr.max(dr.abs(x)))
