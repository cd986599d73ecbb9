"""Where a surface really is: found by tracing it from all sides.

The volume that a surface is proved to lie in can be many times larger than the surface. A
picture wants to be filled by what there is to see.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, to_float, to_numpy, to_vector3
from harnack.fields.field_cache import FieldCache
from harnack.rendering.surfaces.extent import box_of
from harnack.rendering.surfaces.placement import PlacedSurface, Placement
from harnack.tracer import Tolerance

if TYPE_CHECKING:
    from harnack.backend import Backend
    from harnack.tracer import LevelSet

# Rays a side of the grid on each of the six faces of the box, and then of what is found there.
_GRID, _CLOSER = 48, 32
# Rays of one tile are followed together.
_TILE = 8
# Squares of lengths, divided by tolerances, stay far from the ends of single precision.
_SMALLEST, _LARGEST = 1e-15, 1e16
_POINTS: FieldCache[FloatArray] = FieldCache()


def visible_points(surface: LevelSet, backend: Backend) -> FloatArray:
    """Points (n, 3) of the surface, as seen from the six sides of the box it lies in.

    Those of a field that is uploaded once are found once, as long as the settings are the same:
    when only the camera moves, nothing is traced for it.

    Raises:
        ValueError: it has no bounds, or a size that single precision cannot draw; nothing is
            found of it.
    """
    ends = box_of(surface)
    check_size(ends)
    prepared = surface.field_on(backend)

    def found() -> FloatArray:
        return _found(surface, backend, ends)

    if prepared is surface.field:  # it may have changed in place
        return found()
    settings = (surface.numbers, surface.cut, surface.solid, surface.largest, surface.max_steps)
    return _POINTS.get(prepared, (*settings, surface.bound, surface.overstep), found)


def check_size(ends: FloatArray) -> None:
    """Raise ValueError for a box (2, 3) that single precision cannot draw."""
    if 0.0 < (ends[1] - ends[0]).max() < _SMALLEST or np.abs(ends).max() > _LARGEST:
        raise ValueError(
            f"the surface lies in a box from {_point(ends[0])} to {_point(ends[1])}: pictures are "
            f"computed in single precision, for sizes from {_SMALLEST:g} and coordinates up to "
            f"{_LARGEST:g}; choose units nearer to 1"
        )


def _found(surface: LevelSet, backend: Backend, ends: FloatArray) -> FloatArray:
    """Points on a coarse grid, and on one as close as the surface fills."""
    lower, upper = ends
    points = _probe(surface, backend, lower, upper, _GRID)
    if len(points) == 0:
        if (lower > upper).any():
            raise ValueError(
                "nothing is to be seen of this surface: its domain, clip and section do not "
                "overlap, so that nothing is left to draw"
            )
        raise ValueError(
            "nothing is to be seen of this surface: no ray of a grid on the sides of its box "
            f"{_point(ends[0])} to {_point(ends[1])} meets it; "
            "try another level or clip"
        )
    margin = 0.6 * float((ends[1] - ends[0]).max()) / _GRID
    lower = np.maximum(points.min(axis=0) - margin, ends[0])
    upper = np.minimum(points.max(axis=0) + margin, ends[1])
    closer = _probe(surface, backend, lower, upper, _CLOSER)
    return np.concatenate([points, closer])


def _point(corner: FloatArray) -> str:
    return "(" + ", ".join(f"{c:.4g}" for c in corner) + ")"


def _probe(
    surface: LevelSet, backend: Backend, lower: FloatArray, upper: FloatArray, grid: int
) -> FloatArray:
    """First encounters of parallel rays, grid x grid from each of the six sides of a box."""
    size = float(np.linalg.norm(upper - lower))
    # A twentieth of the way between rays: sums over trees take long where more is asked for.
    rough = replace(surface, tolerance=Tolerance(1e-3 * size))
    placed = PlacedSurface.of(rough, Placement.identity(), backend)
    o, d, length = _rays(lower, upper, 0.01 * size, grid)
    met = placed.meet(
        to_vector3(backend, o),
        to_vector3(backend, d),
        to_float(backend, length),
        backend.Bool(True),
    )
    dr.eval(met.position, met.met)  # one by one, each would march anew
    points: FloatArray = to_numpy(met.position)[to_numpy(met.met)]
    return points.astype(np.float64)


def _rays(
    lower: FloatArray, upper: FloatArray, gap: float, grid: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Origins, directions and lengths of a grid of rays through the box along each axis, tile by
    tile."""
    rows = grid // _TILE
    # Axes: tiles down and across, and rays down and across a tile.
    index = np.indices((rows, rows, _TILE, _TILE), dtype=np.float64)
    u = ((_TILE * index[1] + index[3] + 0.5) / grid).ravel()
    v = ((_TILE * index[0] + index[2] + 0.5) / grid).ravel()
    origins: list[FloatArray] = []
    directions: list[FloatArray] = []
    lengths: list[FloatArray] = []
    for axis in range(3):
        across = [(axis + 1) % 3, (axis + 2) % 3]
        for sign in (1.0, -1.0):
            o = np.empty((len(u), 3))
            o[:, across] = lower[across] + np.column_stack([u, v]) * (upper - lower)[across]
            o[:, axis] = lower[axis] - gap if sign > 0 else upper[axis] + gap
            origins.append(o)
            directions.append(np.tile(sign * np.eye(3)[axis], (len(u), 1)))
            lengths.append(np.full(len(u), upper[axis] - lower[axis] + 2 * gap))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(lengths)
