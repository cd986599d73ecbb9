"""Areas of the Voronoi cells of points in their tangent planes. The cell of a point x is the set of
the points y of its tangent plane with |y - x| <= R that are nearer to x than to each of its
neighbors, which lie anywhere in space. So the cell is the part of a disc of radius R that is
bounded by lines: for each neighbor the bisector line, on which y is as far from x as from the
neighbor. Lengths are in units of R inside of kernels; each lane computes one cell."""

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

# Number of lines that are intersected with all other lines in one iteration.
_LINES_PER_ITERATION = 4
# Lines count as parallel if the sine of their angle is below this; parallel lines count as equal if
# their distance is below this.
_PARALLEL = 1e-12


@dataclass(frozen=True)
class _BisectorLine:
    """The bisector line of a neighbor, on which points of the tangent plane are as far from the
    cell's point as from the neighbor: n . y = h, with y relative to the point, in units of the
    cell's radius.

    x, y: the components of n, of length 1; both are 0, and h is 1, if the line misses the unit
        disc.
    h: the distance of the line from the point.
    neighbor: the vector from the point to the neighbor, projected to the tangent plane.
    """

    x: Real
    y: Real
    h: Real
    neighbor: tuple[Real, Real]


@dataclass(frozen=True)
class TangentVoronoi:
    """Computes the areas of Voronoi cells of points in their tangent planes, on a device. Each cell
    is bounded by the bisector lines of the point's neighbors (on which a point of the plane is as
    far from the cell's point as from the neighbor), and cut off at a radius R.

    positions: the three coordinates of all n possible neighbors, each an array (n,) on the device.
    """

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
        """Compute the areas (m,) of the cells of points. The cell of a point x is the set of the
        points y of its tangent plane with |y - x| <= R that are nearer to x than to each of its
        neighbors. If all neighbors lie on one side of a line through x, the images of the neighbors
        under reflection in x count as neighbors, too.

        points: (m, 3).
        normals: (m, 3) unit normals of the tangent planes.
        nearest: (m, k) the indices of the neighbors among the positions.
        radii: (m,) R of each point.
        """
        areas, one_sided = self._cell_areas(points, normals, nearest, radii, mirrored=False)
        if one_sided.any():
            one_sided_points = (
                points[one_sided],
                normals[one_sided],
                nearest[one_sided],
                radii[one_sided],
            )
            areas[one_sided], _ = self._cell_areas(*one_sided_points, mirrored=True)
        return areas * radii * radii

    def _cell_areas(
        self, points: FloatArray, normals: FloatArray, nearest: npt.NDArray[Any],
        radii: FloatArray, *, mirrored: bool,
    ) -> tuple[FloatArray, BoolArray]:  # fmt: skip
        """Compute the areas (m,) of the cells of m points, in units of their squared radii; and a
        mask (m,) of the points whose neighbors all lie on one side of a line through the point.

        points, normals: (m, 3) the points, and the unit normals of their tangent planes.
        nearest: (m, k) indices of the neighbors among `positions`.
        radii: (m,) the radius at which each cell is cut off.
        mirrored: whether the images of the neighbors under reflection in the point count as
            neighbors, too.

        Each neighbor j has a bisector line in the tangent plane. The part of this line that lies
        within the circle of the radius and not beyond another line is an edge of the cell. The cell
        is star shaped, so its area is the sum of the triangles between these edges and the center,
        and of circular sectors in the remaining directions. All neighbors lie on one side if there
        is one to whose left, as seen from the point, no other neighbor lies.
        """
        backend, index = self.backend, self.backend.UInt32
        u, v = (upload_vectors(backend, axis) for axis in orthonormal_basis_rows(normals))
        center, scale = upload_vectors(backend, points), upload_floats(backend, 1 / radii)
        count = nearest.shape[1]
        # Neighbor by neighbor: entry i * m + k is neighbor i of point k.
        table = upload_integers(backend, np.ascontiguousarray(nearest.T).ravel())
        lane, width = dr.arange(index, len(points)), dr.opaque(index, len(points))
        line_count = dr.opaque(index, count * (2 if mirrored else 1))
        neighbor_count = dr.opaque(index, count)

        def bisector(i: Any, active: Mask) -> _BisectorLine:
            """The bisector line of neighbor i; for i from k on, where k is the number of neighbors,
            that of the image of neighbor i - k under reflection in the point. active: mask of lanes
            in which it is needed."""
            row = dr.select(i < neighbor_count, i, i - neighbor_count)
            neighbor_id = dr.gather(index, table, row * width + lane, active)
            position = [
                dr.gather(backend.Float, coordinate, neighbor_id, active)
                for coordinate in self.positions
            ]
            offset = (backend.Array3f(*position) - center) * scale
            sign = dr.select(i < neighbor_count, backend.Float(1), backend.Float(-1))
            # The plane that bisects the offset d meets the tangent plane in q . y = |d|^2/2.
            q = sign * dr.dot(offset, u), sign * dr.dot(offset, v)
            return _line_in_disc(backend, q, 0.5 * dr.squared_norm(offset))

        def add_lines(j: Any, *state: Any) -> tuple[Any, ...]:
            """Add the triangles at the lines j, j + 1, ... to the area, and the angles of these
            triangles to the sum of angles. Note whether there is a line whose neighbor has no other
            neighbor to its left. Returns the next line's number and the new state; the state is
            (area, angle, is_one_sided)."""
            numbers = [j + t for t in range(_LINES_PER_ITERATION)]
            own_lines = [bisector(number, number < line_count) for number in numbers]
            area, angle, is_one_sided = state
            for number, own_line, interval in zip(
                numbers,
                own_lines,
                _clip_bisectors(backend, numbers, own_lines, bisector, line_count),
                strict=True,
            ):
                lower, upper, has_left = interval
                is_cut, is_line = lower < upper, number < line_count
                lower, upper = dr.select(is_cut, lower, 0), dr.select(is_cut, upper, 0)
                # The triangle from the center to the edge has the height h.
                area = area + dr.select(is_line, 0.5 * own_line.h * (upper - lower), 0)
                turn = dr.atan2(upper, own_line.h) - dr.atan2(lower, own_line.h)
                angle = angle + dr.select(is_line, turn, 0)
                is_one_sided = is_one_sided | (
                    is_line
                    & ~has_left
                    & ((own_line.neighbor[0] != 0) | (own_line.neighbor[1] != 0))
                )
            return j + _LINES_PER_ITERATION, area, angle, is_one_sided

        # Zeros of the width of the lanes; `zero > 1` is False in all of them.
        zero = backend.Float(0) + 0 * scale
        initial = index(0) + 0 * lane, zero, zero, zero > 1
        condition = _below(line_count)
        _, area, angle, is_one_sided = dr.while_loop(initial, condition, add_lines, label="lines")
        # Sectors of the unit disc in the directions without an edge.
        total = area + 0.5 * fmax(2 * math.pi - angle, 0)
        dr.eval(total, is_one_sided)
        return to_numpy(total), to_numpy(is_one_sided)


def _below(count: Any) -> Callable[..., Mask]:
    """The condition of a Dr.Jit loop: a function of the loop's state that tells whether its first
    entry is below `count`."""

    def is_active(i: Any, *_: Any) -> Mask:
        """Whether the first entry i of the state is below `count`."""
        return i < count

    return is_active


def _line_in_disc(backend: Backend, q: tuple[Real, Real], b: Real) -> _BisectorLine:
    """The line q . y = b in the plane, b >= 0, with its normal scaled to unit length. If it misses
    the unit disc, its normal becomes 0, and its distance from the point 1. q is the projection of
    the line's neighbor to the plane, and is kept with the line."""
    length = dr.sqrt(dr.square(q[0]) + dr.square(q[1]))
    crosses = length > b
    inverse = dr.select(crosses, dr.rcp(length), 0)
    return _BisectorLine(q[0] * inverse, q[1] * inverse, dr.select(crosses, b * inverse, 1), q)


def _clip_bisectors(
    backend: Backend,
    indices: list[Any],
    own_lines: list[_BisectorLine],
    bisector: Any,
    line_count: Any,
) -> list[tuple[Real, Real, Mask]]:
    """Find the edges of a cell on the lines `own_lines`. Each line belongs to a neighbor, its own
    neighbor.

    Returns three results for each of these lines. The first two, lower and upper, are the ends of
    the interval of positions along the line that lie in the cell, that is, in the unit disc and not
    beyond another line; it is empty if lower >= upper. The third tells whether some neighbor lies
    to the left of the line's own neighbor: its direction from the point, projected to the tangent
    plane, is less than 180 degrees counter-clockwise of the direction to the own neighbor. If no
    neighbor does, all neighbors lie on one side of a line through the point.

    indices: the index of each of `own_lines` among all lines.
    bisector: bisector(i, mask) returns line i, in lanes of the mask.
    line_count: the number of all lines.
    """
    initial: list[Any] = []
    for own_line in own_lines:
        half_chord = dr.sqrt(fmax(1 - dr.square(own_line.h), 0))
        # The chord of the disc on each line; and False in all lanes.
        initial += [-half_chord, half_chord, half_chord > dr.inf]

    def clip_by_line(i: Any, *state: Any) -> tuple[Any, ...]:
        """Clip the intervals of all own lines by line i. Note for each own line whether the
        neighbor of line i is to the left of the own line's neighbor. The state has three entries
        for each own line: lower, upper, has_left. Returns the next i, and the new state."""
        other, clipped = bisector(i, i < line_count), list[Any]()
        for t, (index, own_line) in enumerate(zip(indices, own_lines, strict=True)):
            lower, upper, has_left = state[3 * t : 3 * t + 3]
            # The rate at which a point that moves along the own line nears the other line.
            slope = other.y * own_line.x - other.x * own_line.y
            # How far the foot of the own line (position 0) is inside of the other line.
            distance = other.h - own_line.h * (other.x * own_line.x + other.y * own_line.y)
            is_parallel = dr.abs(slope) < _PARALLEL
            bound = distance / dr.select(is_parallel, 1, slope)
            lower = dr.select(slope < -_PARALLEL, fmax(lower, bound), lower)
            upper = dr.select(slope > _PARALLEL, fmin(upper, bound), upper)
            # An own line beyond a parallel one is no edge. If lines are equal, only the first
            # counts.
            is_hidden = is_parallel & (distance < dr.select(index > i, _PARALLEL, -_PARALLEL))
            upper = dr.select(is_hidden, -dr.inf, upper)
            has_left = has_left | (
                own_line.neighbor[0] * other.neighbor[1] - own_line.neighbor[1] * other.neighbor[0]
                > 0
            )
            clipped += [lower, upper, has_left]
        return i + 1, *clipped

    zero = backend.UInt32(0) + 0 * indices[0]
    final: tuple[Any, ...] = dr.while_loop(
        (zero, *initial), _below(line_count), clip_by_line, label="other lines"
    )
    final = final[1:]
    return [(final[k], final[k + 1], final[k + 2]) for k in range(0, len(final), 3)]
