"""Cells around the largest component of a level set, or of a solid."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy, to_vector3
from harnack.backend.elementary import safe_norm
from harnack.enclosures import Levels
from harnack.fields.batched_fields import FieldCache
from harnack.fields.clearance import clearance_function
from harnack.tree.empty_space import OccupancyGrid, largest_connected_component

if TYPE_CHECKING:
    from harnack.backend import BoolArray
    from harnack.fields.field import Field
    from harnack.geometry import Volume

__all__ = ["CELLS_ACROSS", "largest_component_cells"]

# Cells along the longest side of the box around a surface, unless users ask for another number.
CELLS_ACROSS = 128
# Centers more than the first number of cells away from the surface, to first order, are far from
# it; the cells do not separate components if more than the second number of them are far.
_FAR_CELLS, _MAX_FAR_FRACTION = 4.0, 0.5

_Ends: TypeAlias = tuple[float, float]
_CELLS: FieldCache[OccupancyGrid] = FieldCache()


def largest_component_cells(
    field: Field, levels: tuple[float, ...], volume: Volume | None, solid: _Ends | None, across: int
) -> OccupancyGrid:
    """Cells that contain the largest component of a level set in a volume, or of a solid {low <= f
    <= high}: the component with the largest sum of projected areas along x, y and z.

    The cells also contain all components that are not separated from it by cells proved empty (see
    `largest_connected_component`).

    A cell is left out if it, or each of its eight octants, is proved to contain no point of the
    level set or no point of the volume. The first holds if the ball around the cell is within the
    clearance of its center (or, if the center is outside of the domain of the field, of a point at
    the boundary of the domain), the second by the signed distance of the volume. For a solid, cells
    inside of it are kept, too, although they contain no level. For the rest of the proof see
    `largest_connected_component`.

    Raises:
        ValueError: the volume is not bounded; or most of the cells that could not be proved empty
            are far from the surface, so that the groups would say nothing.
    """
    ends = None if volume is None else np.array(volume.bounds(), np.float64)
    if volume is None or ends is None or not np.isfinite(ends).all():
        raise ValueError(
            "largest needs a surface with bounds: give it a clip, such as a ball (harnack.Ball)"
        )

    def build() -> OccupancyGrid:
        return _build_cells(field.with_levels(levels), levels, volume, solid, across)

    if field.parameters():  # they may change in place
        return build()
    return _CELLS.get(field, (levels, volume, solid, across), build)


def _build_cells(
    field: Field, levels: tuple[float, ...], volume: Volume, solid: _Ends | None, across: int
) -> OccupancyGrid:
    beyond = _distance_beyond(volume)
    to_domain = _projection_to_domain(field)
    in_solid = None if solid is None else _inside_solid(field, solid)
    to_levels = clearance_function(field, levels, "double")

    def clearance(points: FloatArray) -> FloatArray:
        clearances = np.maximum(beyond(points), 0.0)
        inner, distances = to_domain(points)
        finite = np.isfinite(distances)
        if not finite.any():
            return clearances
        length = to_levels(inner[finite]) - distances[finite]
        if in_solid is not None:
            length[in_solid(inner[finite])] = 0.0
        clearances[finite] = np.maximum(clearances[finite], length)
        return clearances

    lower, upper = (np.array(end, np.float64) for end in volume.bounds())
    if (lower > upper).any() or (lower == upper).all():  # rays do not meet a single point
        return OccupancyGrid.empty()
    cells = OccupancyGrid.from_clearance(lower, upper, clearance, across).refined(clearance)
    _refuse_if_unproved(field, levels, solid, cells)
    return largest_connected_component(cells)


def _refuse_if_unproved(
    field: Field, levels: tuple[float, ...], solid: _Ends | None, cells: OccupancyGrid
) -> None:
    """Raise ValueError if most cells that are left are far from the surface."""
    centers = cells.occupied_centers()
    if field.domain is not None:
        centers = centers[field.domain.contains_points(centers)]
    if not len(centers):
        return
    gap, slope, value = _samples(field, levels)(centers)
    far = gap > _FAR_CELLS * cells.cell_size * slope
    if solid is not None:
        far &= ~((value >= solid[0]) & (value <= solid[1]))
    if far.sum() > _MAX_FAR_FRACTION * len(far):
        raise ValueError(
            f"largest: with {round(max(cells.shape))} cells along the longest side, most cells of "
            f"this {type(field).__name__} could not be proved empty, so that its components cannot "
            "be told apart: give a larger number of cells, or mesh it with largest=True"
        )


def _projection_to_domain(field: Field) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """A function of points (n, 3) that returns nearby points (n, 3) in the field's domain, outside
    of which its promises need not hold, and the distances (n,) between the two, infinite where no
    such point was found. If the returned point is at least c away from a set, the argument is at
    least c minus this distance away from it.
    """
    domain = None if field.is_global else field.domain
    backend = choose_backend("double")
    prepared = None if domain is None else domain.prepare(backend)

    def project(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        distances = np.zeros(len(points))
        if domain is None or prepared is None:
            return points, distances
        outside = ~domain.contains_points(points)
        if not outside.any():
            return points, distances
        x = points[outside]
        p = to_vector3(backend, x)
        depth = (1 + 1e-9) * to_numpy(prepared.signed_distance(p)) + 1e-12 * np.abs(x).max()
        y = x - depth[:, None] * to_numpy(prepared.outward_normal(p))
        inner = points.copy()
        inner[outside] = y
        length = 1.000001 * np.linalg.norm(x - y, axis=1)
        distances[outside] = np.where(domain.contains_points(y), length, np.inf)
        return inner, distances

    return project


def _distance_beyond(volume: Volume) -> Callable[[FloatArray], FloatArray]:
    """A function of points (n, 3): a lower bound of their distances from the volume, negative
    inside."""
    backend = choose_backend("double")
    prepared = volume.prepare(backend)

    def beyond(points: FloatArray) -> FloatArray:
        distance = to_numpy(prepared.signed_distance(to_vector3(backend, points)))
        rounding = 64 * float(np.finfo(np.float64).eps) * (1 + float(np.abs(points).max()))
        return np.broadcast_to(distance, len(points)) - rounding

    return beyond


def _samples(
    field: Field, levels: tuple[float, ...]
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
    """A function of points (n, 3): the gaps from f to the nearest level, |grad f|, and f."""
    backend = choose_backend("double")
    prepared = field.prepare(backend)
    targets = Levels(tuple(dr.opaque(backend.Float, level) for level in levels), field.period)

    def samples(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        sample = prepared.evaluate(to_vector3(backend, points))
        arrays = (targets.gaps(sample.value).nearest, safe_norm(sample.gradient), sample.value)
        gap, slope, value = (np.broadcast_to(to_numpy(array), len(points)) for array in arrays)
        return gap, slope, value

    return samples


def _inside_solid(field: Field, solid: _Ends) -> Callable[[FloatArray], BoolArray]:
    """A function of points (n, 3): whether low <= f <= high."""
    backend = choose_backend("double")
    prepared = field.prepare(backend)

    def within(points: FloatArray) -> BoolArray:
        value = to_numpy(prepared.evaluate(to_vector3(backend, points)).value)
        return np.broadcast_to((value >= solid[0]) & (value <= solid[1]), len(points))

    return within


def validate_component_cells(largest: object) -> int:
    """The number of cells along the longest side of the box, validated; 0 for all components.

    Raises:
        TypeError: neither a truth value nor an integer.
        ValueError: fewer cells than 8, or more than 512.
    """
    wrong = (
        "largest is True, or how many cells to tell components apart by along the longest side, "
        f"from 8 to 512, not {largest!r}"
    )
    if isinstance(largest, bool | np.bool_):
        return CELLS_ACROSS if largest else 0
    try:
        across = operator.index(largest)  # pyright: ignore[reportArgumentType]
    except TypeError:
        raise TypeError(wrong) from None
    if across and not 8 <= across <= 512:
        raise ValueError(wrong)
    return across
