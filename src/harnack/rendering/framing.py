"""Computes the framing of a picture: which way is up, the box that contains a surface, and the part
of this box in which the surface is visible.

The box in which a surface is proved to lie can be many times larger than the surface. The visible
part should fill the picture, so the surface is located by tracing rays from all six sides of the
box.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, to_float, to_numpy, to_vector3
from harnack.fields import Solid
from harnack.fields.batched_fields import FieldCache, keeps_uploads
from harnack.fields.tape_evaluator import TapeEvaluator
from harnack.geometry.volume import as_point
from harnack.name_suggestions import did_you_mean
from harnack.rendering.placed_surface import PlacedSurface, Placement
from harnack.tracer import HitTolerance

if TYPE_CHECKING:
    from harnack.backend import Backend
    from harnack.tracer import TracedSurface

# Rotations that turn the named axis to z. From y, the front of a glTF model (z) turns to -y,
# which is where the studio's camera stands.
_UPRIGHT: dict[str, FloatArray] = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
UP_AXES: tuple[str, ...] = (*_UPRIGHT, *("-" + axis for axis in _UPRIGHT))


def rotation_to_z_up(up: Any) -> FloatArray:
    """Return the rotation matrix (3, 3) that turns an axis ("x", "-y", ...) or a vector to z. With
    the axis "y" it also turns z, to which the front of a glTF model looks, to -y, where the
    studio's camera stands.

    Raises:
        TypeError, ValueError: `up` is neither an axis nor a vector that is not zero.
    """
    if isinstance(up, str):
        if up not in UP_AXES:
            raise ValueError(
                f"up must be one of {', '.join(UP_AXES)} or a vector, not {up!r}"
                f"{did_you_mean(up, UP_AXES)}"
            )
        axis = up.removeprefix("-")
        # About the x axis.
        half_turn = np.diag([1.0, -1.0, -1.0]) if up.startswith("-") else np.eye(3)
        return half_turn @ _UPRIGHT[axis]
    vector = np.array(as_point(up, "up"))
    if not vector.any():
        raise ValueError("up must be a vector that is not zero")
    # Dividing by the largest coordinate first avoids overflow in the norm.
    vector, z = vector / float(np.abs(vector).max()), np.array([0.0, 0.0, 1.0])
    vector = vector / float(np.linalg.norm(vector))
    # The shortest rotation is about the axis at right angles to both. There is none if the vector
    # is z or -z.
    normal = np.cross(vector, z)
    if float(np.linalg.norm(normal)) < 1e-12:
        return rotation_to_z_up("z" if vector[2] > 0 else "-z")
    axis_of_rotation = normal / np.linalg.norm(normal)
    # Two orthonormal frames, as rows, that begin with this axis; one ends with the vector, and one
    # with z. The rotation maps the first frame to the second.
    vector_frame, z_frame = (
        np.stack([axis_of_rotation, np.cross(vector, axis_of_rotation), vector]),
        np.stack([axis_of_rotation, np.cross(z, axis_of_rotation), z]),
    )
    return z_frame.T @ vector_frame


class UnboundedSurfaceError(ValueError):
    """The error for a surface that cannot be drawn, as no bounded box that contains it is known.

    reason: the text of the error.
    bounded_level: a level of the same field whose surface has such a box; None if no such level is
        known.
    """

    def __init__(self, reason: str, bounded_level: float | None) -> None:
        hint = (
            "" if bounded_level is None else f", or choose another level, such as {bounded_level:g}"
        )
        super().__init__(f"{reason}: give it a clip, such as a ball{hint}")
        self.reason = reason
        self.bounded_level = bounded_level


class NothingVisibleError(ValueError):
    """The error for a surface that no ray hits, so that there is nothing to frame."""


def bounding_box(surface: TracedSurface) -> FloatArray:
    """Return the lower and upper corner (2, 3) of a box that contains the surface.

    Raises:
        UnboundedSurfaceError: no finite box is known.
    """
    volume = surface.volume
    ends = None if volume is None else np.array(volume.bounds(), dtype=np.float64)
    if ends is None or not np.isfinite(ends).all():
        raise _unbounded(surface)
    return ends


def _unbounded(surface: TracedSurface) -> UnboundedSurfaceError:
    """Return the error for a surface without a box. Its message explains the reason if it is one of
    the two that are known here, and suggests the default level of the field if the surface of that
    level has a box."""
    field = surface.field
    levels = surface.level_values
    levels_text = ", ".join(f"{level:g}" for level in levels)
    reason = f"the surface of level {levels_text} reaches to infinity, as far as is known"
    # The remainder is the distance from the nearest multiple of the period.
    if field.period is not None and any(
        abs(math.remainder(level, field.period)) < 1e-6 * field.period for level in levels
    ):
        reason += (
            f" (far away, an angle comes near the multiples of its period, {field.period:g}, "
            "and this is one)"
        )
    if isinstance(field, Solid):
        reason += " (a solid made of a field does not end at that field's domain)"
    default = field.default_level
    is_other = default not in levels and field.extent((default,)) is not None
    return UnboundedSurfaceError(reason, default if is_other else None)


# The number of rays along a side of the grid on each of the six faces: of the box, and of the box
# of the hits.
_GRID, _FINE_GRID = 48, 32
# Rays of one tile are followed together.
_TILE = 8
# Squares of lengths, divided by tolerances, stay far from the ends of single precision.
_SMALLEST, _LARGEST = 1e-15, 1e16
# The distance of surfaces from the origin, in units of their size, beyond which pixels at edges are
# wrong, and the one beyond which a third of all pixels may be wrong (measured: boxes, curves,
# meshes, clouds).
_MAX_SHARP_OFFSET, _MAX_OFFSET = 5e3, 1e5
_VISIBLE_POINTS_CACHE: FieldCache[FloatArray] = FieldCache()


def visible_points(surface: TracedSurface, backend: Backend) -> FloatArray:
    """Find points (n, 3) of the surface that are seen from the six sides of the box in which it
    lies. Returns them in the surface's coordinates.

    If the field's data on a backend are cached, so are the points, for the options of the surface.
    So no ray is traced for the framing if only the camera has moved. Another field may have been
    changed in place since the last call, so the points are found anew.

    Raises:
        UnboundedSurfaceError: no box around the surface is known.
        ValueError: the surface has a size that single precision cannot draw.
        NothingVisibleError: no ray hits it.
    """
    ends = bounding_box(surface)
    check_drawable_size(ends)

    def find() -> FloatArray:
        """Find the points anew, without the cache."""
        return _find_visible_points(surface, backend, ends)

    if not keeps_uploads(surface.field):  # it may have been changed in place
        return find()
    settings = (
        surface.level_values,
        surface.clip_volume,
        surface.solid_range,
        surface.largest,
        surface.max_steps,
    )
    return _VISIBLE_POINTS_CACHE.get(
        surface.field, (*settings, surface.enclosures, surface.over_relaxation), find
    )


def check_drawable_size(ends: FloatArray) -> None:
    """Raise ValueError for a box with corners `ends` (2, 3) that is too small, or has too large
    coordinates, for pictures in single precision."""
    if 0.0 < (ends[1] - ends[0]).max() < _SMALLEST or np.abs(ends).max() > _LARGEST:
        raise ValueError(
            f"the surface lies in a box from {_point(ends[0])} to {_point(ends[1])}: pictures are "
            f"computed in single precision, for sizes from {_SMALLEST:g} and coordinates up to "
            f"{_LARGEST:g}; choose units nearer to 1"
        )


def check_offset(points: FloatArray) -> None:
    """Check that surfaces are not too far from the origin for their size, as surfaces of maps are.
    Warn if rounding of coordinates blurs their edges.

    points: (n, 3) points of the surfaces.

    Raises:
        ValueError: rounding loses the surfaces.
    """
    size, distance = float(np.ptp(points, axis=0).max()), float(np.abs(points).max())
    if distance <= _MAX_SHARP_OFFSET * size or size == 0:
        return
    message = (
        f"what is drawn is {size:.4g} long and {distance:.4g} from the origin, and pictures are "
        "computed in single precision: {}; move it to the origin: subtract its center from the "
        "points that it is made of (of a solid, translated(...) does so, of a surface file "
        'origin="center")'
    )
    if distance > _MAX_OFFSET * size:
        raise ValueError(message.format("too little is left of its coordinates"))
    warnings.warn(message.format("its edges are blurred"), stacklevel=4)


def _find_visible_points(surface: TracedSurface, backend: Backend, ends: FloatArray) -> FloatArray:
    """Trace rays to find points (n, 3) of a surface: rays of a coarse grid on the box with corners
    `ends` (2, 3), and of a finer grid on the box of the points that were hit.

    Raises:
        NothingVisibleError: no ray hits the surface.
    """
    lower, upper = ends
    points = _probe(surface, backend, lower, upper, _GRID)
    if len(points) == 0:
        if (lower > upper).any():
            raise NothingVisibleError(
                "nothing is to be seen of this surface: its domain, clip and section do not "
                "overlap, so that nothing is left to draw"
            )
        # A surface that is too far from the origin has an error of its own.
        check_offset(ends)
        raise NothingVisibleError(
            "nothing is to be seen of this surface: no ray of a grid on the sides of its box "
            f"{_point(ends[0])} to {_point(ends[1])} meets it; "
            "try another level or clip"
        )
    # The surface may go on for more than half the distance between rays of the coarse grid.
    margin = 0.6 * float((ends[1] - ends[0]).max()) / _GRID
    lower = np.maximum(points.min(axis=0) - margin, ends[0])
    upper = np.minimum(points.max(axis=0) + margin, ends[1])
    finer_points = _probe(surface, backend, lower, upper, _FINE_GRID)
    return np.concatenate([points, finer_points])


def _point(corner: FloatArray) -> str:
    """Write a point (3,) as text, for messages."""
    return "(" + ", ".join(f"{c:.4g}" for c in corner) + ")"


def _probe(
    surface: TracedSurface, backend: Backend, lower: FloatArray, upper: FloatArray, grid: int
) -> FloatArray:
    """Trace parallel rays to a surface: grid x grid rays from each of the six sides of the box from
    `lower` to `upper`. Returns their first hits (n, 3)."""
    size = float(np.linalg.norm(upper - lower))
    # A twentieth of the distance between rays; smaller tolerances are slow for sums over trees, and
    # larger ones for long formulas.
    tolerance, evaluator = 1e-3 * size, surface.evaluator(backend)
    if isinstance(evaluator, TapeEvaluator):
        tolerance = min(tolerance, evaluator.list_margin)
    rough_surface = replace(surface, tolerance=HitTolerance(tolerance))
    placed = PlacedSurface.of(rough_surface, Placement.identity(), backend)
    # Rays begin and end a hundredth of the size off the box; all of them are traced (`True`).
    o, d, length = _rays(lower, upper, 0.01 * size, grid)
    hits = placed.intersect(
        to_vector3(backend, o),
        to_vector3(backend, d),
        to_float(backend, length),
        backend.Bool(True),
    )
    dr.eval(hits.position, hits.is_hit)  # separately, each would trace the rays again
    points: FloatArray = to_numpy(hits.position)[to_numpy(hits.is_hit)]
    return points.astype(np.float64)


def _rays(
    lower: FloatArray, upper: FloatArray, gap: float, grid: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return origins (n, 3), directions (n, 3) and lengths (n,) of parallel rays through a box,
    from each of its six sides. Rays that follow each other are close together.

    lower, upper: (3,) corners of the box.
    gap: the distance from the box at which rays begin and end.
    grid: the number of rays along a side of the grid, a multiple of 8.
    """
    tile_count = grid // _TILE
    # u and v are the coordinates of the rays on a side of the box, in (0, 1), tile by tile of 8 x 8
    # rays. The axes of `index` are tiles down and across, and rays down and across in a tile.
    index = np.indices((tile_count, tile_count, _TILE, _TILE), dtype=np.float64)
    u = ((_TILE * index[1] + index[3] + 0.5) / grid).ravel()
    v = ((_TILE * index[0] + index[2] + 0.5) / grid).ravel()
    origins: list[FloatArray] = []
    directions: list[FloatArray] = []
    lengths: list[FloatArray] = []
    for axis in range(3):
        other_axes = [(axis + 1) % 3, (axis + 2) % 3]
        for sign in (1.0, -1.0):
            o = np.empty((len(u), 3))
            o[:, other_axes] = (
                lower[other_axes] + np.column_stack([u, v]) * (upper - lower)[other_axes]
            )
            o[:, axis] = lower[axis] - gap if sign > 0 else upper[axis] + gap
            origins.append(o)
            directions.append(np.tile(sign * np.eye(3)[axis], (len(u), 1)))
            lengths.append(np.full(len(u), upper[axis] - lower[axis] + 2 * gap))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(lengths)
