"""Finds cells of a grid that contain the largest connected component of a surface. The surface
consists of the points at which a function f, the field, takes one of given values, the levels; or
it is a solid {low <= f <= high}. Components are told apart by cells between them that are proved to
hold no point of the surface.
"""

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
from harnack.fields.parameters import differentiable_parameters
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
    """Return a grid of cells, with those marked that contain the largest component of a level set
    in a volume, or of a solid {low <= f <= high} in it. The largest component is the one with the
    largest sum of projected areas along x, y and z.

    levels: the values of f on the level set.
    volume: the volume that contains the surface.
    solid: (low, high), the range of f on the solid; None for the level set itself.
    across: the number of cells along the longest side of the box of the volume.

    The marked cells also contain all components that no cells proved empty separate from the
    largest one (see `largest_connected_component`).

    A cell is not marked if it, or each of its eight octants, is proved to contain no point of the
    level set or no point of the volume. There are two proofs for the ball around a cell. First, it
    contains no point of the level set if its radius is at most the clearance of its center, which
    is a proved lower bound of the distance from the level set. If the center lies outside the
    domain of the field, a point at the boundary of the domain takes its place. Second, it contains
    no point of the volume if the signed distance from the volume shows this. Cells inside a solid
    are marked, too, although they contain no level. `largest_connected_component` has the rest of
    the proof.

    Raises:
        ValueError: the volume is not bounded; or most of the cells that could not be proved empty
            are far from the surface, so that they say nothing about components.
    """
    ends = None if volume is None else np.array(volume.bounds(), np.float64)
    if volume is None or ends is None or not np.isfinite(ends).all():
        raise ValueError("largest needs a surface with bounds: give it a clip, such as a ball")

    def build() -> OccupancyGrid:
        """Compute the grid, which is not in the cache."""
        return _build_cells(field, levels, volume, solid, across)

    if differentiable_parameters(field):  # they may change in place
        return build()
    return _CELLS.get(field, (levels, volume, solid, across), build)


def _build_cells(
    field: Field, levels: tuple[float, ...], volume: Volume, solid: _Ends | None, across: int
) -> OccupancyGrid:
    """Return the grid of `largest_component_cells`, which describes the parameters field, levels,
    volume, solid and across. No cell is marked if the volume is empty or a single point."""
    distance_beyond = _distance_beyond(volume)
    project_to_domain = _projection_to_domain(field)
    in_solid = None if solid is None else _inside_solid(field, solid)
    distance_to_levels = clearance_function(field, levels, "double")

    def clearance(points: FloatArray) -> FloatArray:
        """Return lower bounds (n,) of the distances of points (n, 3) from the part of the level set
        in the volume: bounds of the distance from the level set, or from the volume if that is
        farther; 0 inside the solid. They hold also for points outside the field's domain."""
        clearances = np.maximum(distance_beyond(points), 0.0)
        inner, distances = project_to_domain(points)
        is_finite = np.isfinite(distances)
        if not is_finite.any():
            return clearances
        length = distance_to_levels(inner[is_finite]) - distances[is_finite]
        if in_solid is not None:
            length[in_solid(inner[is_finite])] = 0.0
        # Both are lower bounds for the part of the surface in the volume, so the larger one holds.
        clearances[is_finite] = np.maximum(clearances[is_finite], length)
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
    """Raise ValueError if the centers of most marked cells are far from the surface: to first
    order, farther than 4 cell sizes, |f - level|/|grad f| > 4 sizes. Centers in the solid or
    outside the domain do not count as far."""
    centers = cells.occupied_centers()
    if field.domain is not None:
        centers = centers[field.domain.contains_points(centers)]
    if not len(centers):
        return
    gap, slope, value = _samples(field, levels)(centers)
    # To first order the surface is gap/slope away.
    is_far = gap > _FAR_CELLS * cells.cell_size * slope
    if solid is not None:
        is_far &= ~((value >= solid[0]) & (value <= solid[1]))
    if is_far.sum() > _MAX_FAR_FRACTION * len(is_far):
        raise ValueError(
            f"largest: with {round(max(cells.shape))} cells along the longest side, most cells of "
            f"this {type(field).__name__} could not be proved empty, so that its components cannot "
            "be told apart: give a larger number of cells, or mesh it with largest=True"
        )


def _projection_to_domain(field: Field) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
    """Return a function `project` of points (n, 3). For each point it returns a point in the
    field's domain near it, as an array (n, 3), and the distance between the two, (n,); the distance
    is inf if no such point was found.

    The proved bounds of f need not hold outside its domain. If the point in the domain is at least
    c away from a set, the given point is at least c minus the distance between the two away from
    it.
    """
    domain = None if field.traits.is_global else field.domain
    backend = choose_backend("double")
    uploaded_domain = None if domain is None else domain.upload(backend)

    def project(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points (n, 3) in the domain near the given ones, and the distances (n,) between
        the two."""
        distances = np.zeros(len(points))
        if domain is None or uploaded_domain is None:
            return points, distances
        is_outside = ~domain.contains_points(points)
        if not is_outside.any():
            return points, distances
        points_outside = points[is_outside]
        uploaded = to_vector3(backend, points_outside)
        # A little farther than the boundary, because of rounding.
        depth = (1 + 1e-9) * to_numpy(uploaded_domain.signed_distance(uploaded)) + 1e-12 * np.abs(
            points_outside
        ).max()
        moved = points_outside - depth[:, None] * to_numpy(uploaded_domain.outward_normal(uploaded))
        inner = points.copy()
        inner[is_outside] = moved
        # Rounded up, so that the distance is an upper bound.
        length = 1.000001 * np.linalg.norm(points_outside - moved, axis=1)
        distances[is_outside] = np.where(domain.contains_points(moved), length, np.inf)
        return inner, distances

    return project


def _distance_beyond(volume: Volume) -> Callable[[FloatArray], FloatArray]:
    """Return a function of points (n, 3) that returns lower bounds (n,) of their distances from the
    volume; they are negative inside the volume."""
    backend = choose_backend("double")
    uploaded = volume.upload(backend)

    def beyond(points: FloatArray) -> FloatArray:
        """Return lower bounds (n,) of the distances of points (n, 3) from the volume, with a margin
        for rounding."""
        distance = to_numpy(uploaded.signed_distance(to_vector3(backend, points)))
        rounding = 64 * float(np.finfo(np.float64).eps) * (1 + float(np.abs(points).max()))
        return np.broadcast_to(distance, len(points)) - rounding

    return beyond


def _samples(
    field: Field, levels: tuple[float, ...]
) -> Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
    """Return a function of points (n, 3) that returns three arrays (n,): the differences between f
    and the nearest level, |grad f|, and f."""
    backend = choose_backend("double")
    evaluator = field.evaluator(backend)
    targets = Levels(tuple(dr.opaque(backend.Float, level) for level in levels), field.period)

    def samples(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the difference between f and the nearest level, |grad f|, and f, each (n,), at
        points (n, 3)."""
        sample = evaluator.evaluate(to_vector3(backend, points))
        arrays = (targets.gaps(sample.value).nearest, safe_norm(sample.gradient), sample.value)
        gap, slope, value = (np.broadcast_to(to_numpy(array), len(points)) for array in arrays)
        return gap, slope, value

    return samples


def _inside_solid(field: Field, solid: _Ends) -> Callable[[FloatArray], BoolArray]:
    """Return a function of points (n, 3) that returns the mask (n,) of points with low <= f <=
    high, where solid = (low, high)."""
    backend = choose_backend("double")
    evaluator = field.evaluator(backend)

    def within(points: FloatArray) -> BoolArray:
        """Return the mask (n,) of points (n, 3) in the solid."""
        value = to_numpy(evaluator.evaluate(to_vector3(backend, points)).value)
        return np.broadcast_to((value >= solid[0]) & (value <= solid[1]), len(points))

    return within


def validate_component_cells(largest: object) -> int:
    """Return the number of cells that the option `largest` asks for. Components are told apart by
    cells; the number is that along the longest side of the box of the surface. It is 0 if the
    option is False (all components are kept), 128 if it is True, else the option itself.

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
    if across and not 8 <= across <= 512:  # 0 means False
        raise ValueError(wrong)
    return across
