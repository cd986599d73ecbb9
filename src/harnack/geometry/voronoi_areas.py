"""Areas of the Voronoi cells of points in their tangent planes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_integers, upload_vectors
from harnack.backend.elementary import fmax, fmin, orthonormal_basis_rows

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real

__all__ = ["TangentVoronoi"]

# Lines that are cut at once by each of the others.
_LINES_PER_ITERATION = 4
# Sines below which lines are parallel, and distances below which these are equal.
_PARALLEL = 1e-12


@dataclass(frozen=True)
class _BisectorLine:
    """The bisector line n . y = h that bounds a cell towards a neighbor, in units of the cell's
    radius.

    x, y: the components of n, of length 1; both are 0, and h is 1, if the line misses the unit
        disc.
    neighbor: the vector from the point to the neighbor, projected to the tangent plane.
    """

    x: Real
    y: Real
    h: Real
    neighbor: tuple[Real, Real]


@dataclass(frozen=True)
class TangentVoronoi:
    """Computes Voronoi areas of points in their tangent planes. positions: of all possible
    neighbors, on a backend; each coordinate (n,)."""

    backend: Backend
    positions: tuple[Real, ...]

    @classmethod
    def of(cls, positions: FloatArray) -> TangentVoronoi:
        """Upload the positions (n, 3) of all possible neighbors."""
        backend = choose_backend("double")
        columns = np.asarray(positions, np.float64).T
        return cls(backend, tuple(upload_floats(backend, column) for column in columns))

    def areas(
        self, points: FloatArray, normals: FloatArray, nearest: npt.NDArray[Any], radii: FloatArray
    ) -> FloatArray:
        """(m,) the areas of the cells of points (m, 3). The cell of a point is { y : |y| <= R, y
        nearer to the point than to each neighbor }, in the plane through the point normal to its
        normal.

        nearest: (m, k) the indices of the neighbors among the positions.
        radii: (m,) R of each point.

        Where all neighbors lie on one side of a line through the point, their mirror images count
        too.
        """
        areas, rim = self._cell_areas(points, normals, nearest, radii, mirrored=False)
        if rim.any():
            rim_points = points[rim], normals[rim], nearest[rim], radii[rim]
            areas[rim], _ = self._cell_areas(*rim_points, mirrored=True)
        return areas * radii * radii

    def _cell_areas(
        self, points: FloatArray, normals: FloatArray, nearest: npt.NDArray[Any],
        radii: FloatArray, *, mirrored: bool,
    ) -> tuple[FloatArray, BoolArray]:  # fmt: skip
        """The areas (m,) of cells in units of the radii squared, and whether all neighbors lie on
        one side.

        On line j, at distance h_j from the center, the other lines and the circle leave an interval
        of the position s along it. The region is star shaped, so its area is the sum of the
        triangles between these intervals and the center, and of circular sectors in the directions
        that remain. All neighbors lie on one side if one of them has no other neighbor to its left.
        """
        backend, index = self.backend, self.backend.UInt32
        u, v = (upload_vectors(backend, axis) for axis in orthonormal_basis_rows(normals))
        center, scale = upload_vectors(backend, points), upload_floats(backend, 1 / radii)
        count = nearest.shape[1]
        table = upload_integers(backend, np.ascontiguousarray(nearest.T).ravel())
        lane, width = dr.arange(index, len(points)), dr.opaque(index, len(points))
        lines = dr.opaque(index, count * (2 if mirrored else 1))
        rows = dr.opaque(index, count)

        def line(i: Any, active: Mask) -> _BisectorLine:
            row = dr.select(i < rows, i, i - rows)
            bisector = dr.gather(index, table, row * width + lane, active)
            location = [dr.gather(backend.Float, part, bisector, active) for part in self.positions]
            offset = (backend.Array3f(*location) - center) * scale
            sign = dr.select(i < rows, backend.Float(1), backend.Float(-1))
            # The plane that bisects the offset d meets the tangent plane in q . y = |d|^2/2.
            q = sign * dr.dot(offset, u), sign * dr.dot(offset, v)
            return _crossing(backend, q, 0.5 * dr.squared_norm(offset))

        def step(j: Any, *state: Any) -> tuple[Any, ...]:
            numbers = [j + t for t in range(_LINES_PER_ITERATION)]
            bisectors = [line(number, number < lines) for number in numbers]
            area, angle, is_rim = state
            for number, bisector, interval in zip(
                numbers,
                bisectors,
                _clip_bisectors(backend, numbers, bisectors, line, lines),
                strict=True,
            ):
                lower, upper, has_left = interval
                is_cut, location = lower < upper, number < lines
                lower, upper = dr.select(is_cut, lower, 0), dr.select(is_cut, upper, 0)
                area = area + dr.select(location, 0.5 * bisector.h * (upper - lower), 0)
                turn = dr.atan2(upper, bisector.h) - dr.atan2(lower, bisector.h)
                angle = angle + dr.select(location, turn, 0)
                is_rim = is_rim | (
                    location
                    & ~has_left
                    & ((bisector.neighbor[0] != 0) | (bisector.neighbor[1] != 0))
                )
            return j + _LINES_PER_ITERATION, area, angle, is_rim

        zero = backend.Float(0) + 0 * scale
        start = index(0) + 0 * lane, zero, zero, zero > 1
        condition = _while_below(lines)
        _, area, angle, is_rim = dr.while_loop(start, condition, step, label="lines")
        total = area + 0.5 * fmax(2 * math.pi - angle, 0)
        dr.eval(total, is_rim)
        return to_numpy(total), to_numpy(is_rim)


def _while_below(count: Any) -> Callable[..., Mask]:
    """Whether a loop's first number is below the count."""

    def more(i: Any, *_: Any) -> Mask:
        return i < count

    return more


def _crossing(backend: Backend, q: tuple[Real, Real], b: Real) -> _BisectorLine:
    """The line q . y = b in the unit disc."""
    length = dr.sqrt(dr.square(q[0]) + dr.square(q[1]))
    crosses = length > b
    inverse = dr.select(crosses, dr.rcp(length), 0)
    return _BisectorLine(q[0] * inverse, q[1] * inverse, dr.select(crosses, b * inverse, 1), q)


def _clip_bisectors(
    backend: Backend, numbers: list[Any], own_lines: list[_BisectorLine], line: Any, lines: Any
) -> list[tuple[Real, Real, Mask]]:
    """For each of these bisector lines, the interval of it that all other lines leave, and whether
    a neighbor is to the left of its neighbor."""
    start: list[Any] = []
    for bisector in own_lines:
        half_chord = dr.sqrt(fmax(1 - dr.square(bisector.h), 0))
        start += [-half_chord, half_chord, half_chord > dr.inf]

    def cut(i: Any, *state: Any) -> tuple[Any, ...]:
        other, new = line(i, i < lines), list[Any]()
        for t, (number, bisector) in enumerate(zip(numbers, own_lines, strict=True)):
            lower, upper, has_left = state[3 * t : 3 * t + 3]
            # The rate at which this line nears the other line, along this line.
            slope = other.y * bisector.x - other.x * bisector.y
            distance = other.h - bisector.h * (other.x * bisector.x + other.y * bisector.y)
            is_parallel = dr.abs(slope) < _PARALLEL
            bound = distance / dr.select(is_parallel, 1, slope)
            lower = dr.select(slope < -_PARALLEL, fmax(lower, bound), lower)
            upper = dr.select(slope > _PARALLEL, fmin(upper, bound), upper)
            # Of equal lines only the first counts.
            is_hidden = is_parallel & (distance < dr.select(number > i, _PARALLEL, -_PARALLEL))
            upper = dr.select(is_hidden, -dr.inf, upper)
            has_left = has_left | (
                bisector.neighbor[0] * other.neighbor[1] - bisector.neighbor[1] * other.neighbor[0]
                > 0
            )
            new += [lower, upper, has_left]
        return i + 1, *new

    zero = backend.UInt32(0) + 0 * numbers[0]
    final: tuple[Any, ...] = dr.while_loop(
        (zero, *start), _while_below(lines), cut, label="other lines"
    )
    final = final[1:]
    return [(final[k], final[k + 1], final[k + 2]) for k in range(0, len(final), 3)]
