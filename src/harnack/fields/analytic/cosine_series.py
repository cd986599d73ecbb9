"""Cosine series on a box: fitting, proved bounds, and evaluation on a backend. A cosine series is
the sum f(p) = sum a_ijk cos(i u) cos(j v) cos(k w) over 0 <= i < K_x, 0 <= j < K_y and 0 <= k <
K_z, with an array of coefficients a of the shape (K_x, K_y, K_z). The angles u, v and w of a point
p go from 0 at the box's lower corner to pi at its upper corner: (u, v, w) = pi (p - lower)/(upper -
lower). "Second derivatives" below are those along a direction: v . H v for a unit vector v and the
Hessian H of f.

`fit_cosines` and `CosineBounds` are computed once for a series, with NumPy in double precision;
`CosineSums` evaluates the series with Dr.Jit.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import upload_floats
from harnack.backend.elementary import clamp, fmin, sincos
from harnack.backend.record_table import RecordTable
from harnack.enclosures import TaylorRemainder

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3

__all__ = ["CellBounds", "CosineBounds", "evaluate_on_grid", "fit_cosines", "midpoints"]

# The numbers of nodes for each half wave of the highest frequency: at least `_MIN_NODES`, at most
# `_MAX_NODES`, and between these limits so many that an axis has about `_AXIS_NODES` nodes.
_MIN_NODES, _AXIS_NODES, _MAX_NODES = 8, 112, 32
# The numbers of cells along each side of the grids of local bounds. A grid is used if its bounds
# are on average below `_MAX_RATIO` times the global bound: only then are they worth a lookup.
_CELLS, _MAX_RATIO = (16, 8, 4), 0.9
# The number of cells along a side of the grid by which the extent of a level is bounded.
_EXTENT_CELLS = 32
# Bounds are moved outwards by this fraction for the rounding of double precision.
_ROUNDING = 1e-9


def midpoints(lower: FloatArray, upper: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """The midpoints (n, 3) of the cells of a box that is divided into shape[0] x shape[1] x
    shape[2] equal cells.

    lower, upper: (3,) the corners of the box.

    The midpoints are in the order of the entries of a flattened array of this shape.
    """
    axes = [
        lower[a] + (upper[a] - lower[a]) * (np.arange(n) + 0.5) / n for a, n in enumerate(shape)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def fit_cosines(grid: FloatArray, terms: tuple[int, int, int]) -> FloatArray:
    """The coefficients (K_x, K_y, K_z) of the cosine series that fits given values at the midpoints
    of the cells of a box.

    grid: (n_x, n_y, n_z) the values.
    terms: the numbers of terms (K_x, K_y, K_z).

    The coefficients come from the discrete cosine transform of type 2. With as many terms as values
    the series passes through all values. With fewer terms it is the best fit in mean square, since
    the cosines are orthogonal on the midpoints.
    """
    from scipy import fft  # imported here, as it takes time and is rarely needed

    transform = np.asarray(cast("Any", fft).dctn(grid, type=2), dtype=np.float64) / grid.size
    coefficients = transform[: terms[0], : terms[1], : terms[2]].copy()
    for axis in range(3):
        # The transform gives the terms without a wave along the axis twice.
        constant_terms = [slice(None)] * 3
        constant_terms[axis] = slice(0, 1)
        coefficients[tuple(constant_terms)] *= 0.5
    return coefficients


def evaluate_on_grid(
    coefficients: FloatArray, angles: tuple[FloatArray, FloatArray, FloatArray],
    orders: tuple[int, int, int] = (0, 0, 0),
) -> FloatArray:  # fmt: skip
    """The cosine series, or a derivative of it by the angles, on a grid of angles: an array (n_x,
    n_y, n_z).

    coefficients: (K_x, K_y, K_z).
    angles: the angles u, v and w of the grid, arrays (n_x,), (n_y,) and (n_z,).
    orders: how often the series is differentiated by u, by v and by w.
    """
    values = coefficients
    for angle, order in zip(angles, orders, strict=True):
        k: FloatArray = np.arange(values.shape[0], dtype=np.float64)
        # cos(k u) differentiated `order` times.
        waves: FloatArray = k**order * np.cos(np.outer(angle, k) + 0.5 * math.pi * order)
        # Sum over the first axis, and move the new axis to the end: after three turns the order is
        # x, y, z.
        values = np.moveaxis(np.tensordot(waves, values, axes=(1, 0)), 0, -1)
    return values


@dataclass(frozen=True)
class CellBounds:
    """Local bounds of the absolute second derivatives of a function along any direction, on a grid
    of n x n x n equal cells of a box.

    count: n.
    bounds: (n^3,) for each cell a bound that holds on the cell and all its neighbors; the index
        along x runs fastest.
    """

    count: int
    bounds: FloatArray


@dataclass(frozen=True)
class CosineBounds:
    """Proved bounds of a cosine series f on its box: of its values, and of |v . H v| for unit
    vectors v and the Hessian H, which are its second derivatives along directions.

    low, high: the values of f on the box are between them.
    curvature: a bound of |v . H v| on the box.
    cells: local bounds of |v . H v|, finest grid first; only grids that are worth a lookup.
    cell_low, cell_high: (32, 32, 32) bounds of f below and above, on each of 32^3 cells of the box.

    Proof. Let T be f, or v . H v for a fixed v. Along each axis T is a trigonometric polynomial of
    the angle, of degree n = K - 1. Take a grid of N = 2 n m > 2 n angles per full turn. The angles
    from 0 to pi suffice by symmetry: f is even in each angle, and a change of the sign of an angle
    turns v . H v into v' . H v' with other signs in v. By Ehlich and Zeller (1964), |T| <= (maximum
    over the grid)/cos(pi n/N), for one axis after the other. Let G be this bound. Then |T_uu| <=
    n^2 G (Bernstein), so the error of linear interpolation between nodes h = pi/(n m) apart is at
    most h^2/8 n^2 G = pi^2 G/(8 m^2) along each axis. A bound at the nodes of a cell, plus these
    errors, is a bound on the cell.
    """

    low: float
    high: float
    curvature: float
    cells: tuple[CellBounds, ...]
    cell_low: FloatArray
    cell_high: FloatArray

    @classmethod
    def of(cls, coefficients: FloatArray, size: FloatArray) -> CosineBounds:
        """Compute the bounds of the cosine series with these coefficients (K_x, K_y, K_z) from its
        values and second derivatives on a grid of angles.

        size: (3,) the lengths of the box's sides.

        In the code n is the degree along an axis and m, in `densities`, the number of nodes per
        half wave, so that a full turn has N = 2 n m nodes. `grid_factor` is the product of all
        1/cos(pi n/N), by which f or a derivative may exceed its maximum over the grid;
        `relative_error` is the sum of all pi^2/(8 m^2), the error between nodes as a fraction of
        the bound. The class has the proof.
        """
        degrees: list[int] = [n - 1 for n in coefficients.shape]
        densities = [min(max(_MIN_NODES, _AXIS_NODES // max(n, 1)), _MAX_NODES) for n in degrees]
        # A constant axis (n = 0) has a single node.
        angles: list[FloatArray] = [
            math.pi * np.arange(n * m + 1) / max(n * m, 1) if n else np.zeros(1)
            for n, m in zip(degrees, densities, strict=True)
        ]
        grid_factor = math.prod(
            1 / math.cos(0.5 * math.pi / m) if n else 1.0
            for n, m in zip(degrees, densities, strict=True)
        )
        relative_error = sum(
            math.pi**2 / (8 * m * m) if n else 0.0 for n, m in zip(degrees, densities, strict=True)
        )
        nodes = angles[0], angles[1], angles[2]
        values = evaluate_on_grid(coefficients, nodes)
        # The value in the middle of the range is subtracted, so that the factor enlarges only the
        # range.
        mid_value = 0.5 * float(values.min() + values.max())
        half_range = 0.5 * float(values.max() - values.min()) * grid_factor * (1 + _ROUNDING)
        half_range += _ROUNDING * abs(mid_value)
        norms = _spectral_norms(coefficients, nodes, math.pi / size)
        curvature = float(norms.max()) * grid_factor * (1 + _ROUNDING)
        cells: list[CellBounds] = []
        for count in _CELLS:
            # The largest norm at the nodes of each cell and of its neighbors (margin 1).
            local = _cell_extremes(norms, angles, count, 1, np.maximum) + relative_error * curvature
            local = np.minimum(local * (1 + _ROUNDING), curvature)
            if float(local.mean()) <= _MAX_RATIO * curvature:
                # x is the first index in `_cell_extremes` and runs fastest on the device.
                cells.append(CellBounds(count, np.ascontiguousarray(local.T).ravel()))
        margin = relative_error * half_range + _ROUNDING * (abs(mid_value) + half_range)
        # The range of f on each cell alone (margin 0) comes last.
        return cls(
            mid_value - half_range,
            mid_value + half_range,
            curvature,
            tuple(cells),
            _cell_extremes(values, angles, _EXTENT_CELLS, 0, np.minimum) - margin,
            _cell_extremes(values, angles, _EXTENT_CELLS, 0, np.maximum) + margin,
        )

    def extent(self, levels: tuple[float, ...]) -> tuple[FloatArray, FloatArray] | None:
        """A box that contains the level sets: its corners (3,), (3,) as fractions of the whole box
        from 0 to 1; None if the series has no such level. It is the box around all cells that may
        have a level.

        levels: the levels.
        """
        is_met = np.zeros(self.cell_low.shape, dtype=bool)
        for level in levels:
            is_met |= (self.cell_low <= level) & (level <= self.cell_high)
        if not is_met.any():
            return None
        low, high = np.zeros(3), np.ones(3)
        for axis in range(3):
            other_axes = tuple(a for a in range(3) if a != axis)
            # The slices of cells across this axis that may have a level.
            indices = np.flatnonzero(is_met.any(axis=other_axes))
            low[axis], high[axis] = indices[0] / len(is_met), (indices[-1] + 1) / len(is_met)
        return low, high


def _spectral_norms(
    coefficients: FloatArray,
    nodes: tuple[FloatArray, FloatArray, FloatArray],
    rates: FloatArray,
) -> FloatArray:
    """The largest absolute eigenvalue of the Hessian of a cosine series at each node of a grid,
    which bounds its second derivatives along all directions: an array (n_x, n_y, n_z).

    coefficients: (K_x, K_y, K_z).
    nodes: the angles of the grid along each axis.
    rates: (3,) the derivatives of the angles by the coordinates: pi over the sides of the box.

    The grid is evaluated in slabs, to save memory. The eigenvalues of symmetric 3x3 matrices are
    computed by Smith's formula (1961).
    """
    norms = np.empty(tuple(len(values) for values in nodes))
    # At most about 400,000 nodes at a time.
    slab_size = max(1, 400_000 // (norms.shape[1] * norms.shape[2]))
    for start in range(0, len(nodes[0]), slab_size):
        slab_nodes = nodes[0][start : start + slab_size], nodes[1], nodes[2]
        second: dict[tuple[int, int], FloatArray] = {}
        for a, b in itertools.combinations_with_replacement(range(3), 2):
            # The second derivative by the coordinates a and b.
            orders = [0, 0, 0]
            orders[a] += 1
            orders[b] += 1
            derivative = evaluate_on_grid(
                coefficients, slab_nodes, (orders[0], orders[1], orders[2])
            )
            second[a, b] = rates[a] * rates[b] * derivative
        xx, yy, zz = second[0, 0], second[1, 1], second[2, 2]
        xy, xz, yz = second[0, 1], second[0, 2], second[1, 2]
        # The Hessian is mean I + spread B, where B has the eigenvalues 2 cos(angle + 2 pi k/3).
        mean = (xx + yy + zz) / 3
        b_xx, b_yy, b_zz = xx - mean, yy - mean, zz - mean
        spread = np.sqrt(
            (b_xx * b_xx + b_yy * b_yy + b_zz * b_zz + 2 * (xy * xy + xz * xz + yz * yz)) / 6
        )
        divisor = np.where(spread > 0, spread, 1.0)
        b_xx, b_yy, b_zz, xy, xz, yz = (
            values / divisor for values in (b_xx, b_yy, b_zz, xy, xz, yz)
        )
        half_determinant = 0.5 * (
            b_xx * (b_yy * b_zz - yz * yz) - xy * (xy * b_zz - yz * xz) + xz * (xy * yz - b_yy * xz)
        )
        angle = np.arccos(np.clip(half_determinant, -1, 1)) / 3
        largest_eigenvalue = mean + 2 * spread * np.cos(angle)
        smallest_eigenvalue = mean + 2 * spread * np.cos(angle + 2 * math.pi / 3)
        # Near 1, the error of the arccosine is the square root of the error of its argument.
        norms[start : start + slab_size] = (
            np.maximum(np.abs(largest_eigenvalue), np.abs(smallest_eigenvalue)) + 1e-7 * spread
        )
    return norms


def _cell_extremes(
    values: FloatArray, angles: list[FloatArray], count: int, margin: int, ufunc: Any
) -> FloatArray:
    """For each of count^3 equal cells of the box, the smallest (or the largest) of values at the
    nodes of a grid that lie in the cell or next to it: an array (count, count, count).

    values: the values at the nodes, an array over the three axes.
    angles: the angles of the nodes along each axis, evenly spaced from 0 to pi.
    margin: the number of neighboring cells, on each side, whose nodes are also included.
    ufunc: np.minimum for the smallest values, np.maximum for the largest.
    """
    for axis in range(3):
        interval_count = len(angles[axis]) - 1
        columns: list[FloatArray] = []
        for cell in range(count):
            # Rounded down, and the last one up.
            first_node = max(cell - margin, 0) * interval_count // count
            last_node = -(-min(cell + 1 + margin, count) * interval_count // count)
            part = np.moveaxis(values, axis, 0)[first_node : last_node + 1]
            columns.append(ufunc.reduce(part, axis=0))
        values = np.stack(columns, axis=axis)
    return values


# Constants are increased, and radii decreased, by this fraction for the roundings of float32.
_KERNEL_ROUNDING = 1e-5


@dataclass(frozen=True)
class CosineSums:
    """A cosine series f(p) = sum a_ijk cos(i u) cos(j v) cos(k w) on a backend, with bounds of its
    second derivatives. The angles (u, v, w) of a point p go from 0 at the box's lower corner to pi
    at its upper corner. The record of an i is its row of coefficients (i, a_i00, a_i01, ...).

    backend: the backend.
    shape: (K_x, K_y, K_z), the numbers of terms along the axes.
    lower: the lower corner of the box.
    rate: pi over the sides of the box, the change of the angles per length.
    rows: a record for each i, the highest i first.
    rounding: bounds of the rounding errors of value and gradient, as multiples of the unit roundoff
        (half of the machine epsilon). The rounding of the angles, which acts like a move of the
        point, is left out.
    curvature: a bound of the absolute second derivatives along directions, on the box.
    cells: bounds of the same derivatives on single cells of grids, finest grid first.

    Evaluation. Sums over k are computed for each i and j, then sums over j for each i, and the sum
    over i last (sum factorization). This takes about 2 K^3 products, whereas a sum of terms would
    need 7 K^3. i runs in a recorded loop over the records, while the sums over j and k are
    unrolled. The coefficients are data of the compiled code, so another function fitted by as many
    terms needs no new compilation. Each sum begins with the highest frequency, so that the large
    terms, of low frequency, take part in the fewest roundings.
    """

    backend: Backend
    shape: tuple[int, int, int]
    lower: Vec3
    rate: Vec3
    rows: RecordTable
    rounding: tuple[Real, Real]
    curvature: Real
    cells: tuple[_CellCurvatures, ...]

    @classmethod
    def upload(
        cls,
        backend: Backend,
        coefficients: FloatArray,
        lower: FloatArray,
        size: FloatArray,
        bounds: CosineBounds,
        rounding: tuple[float, float],
    ) -> CosineSums:
        """Put the cosine series with these coefficients (K_x, K_y, K_z) on a backend.

        lower, size: (3,) the lower corner and the sides of the box.
        bounds: bounds of the second derivatives of the series along directions, on the box and on
            cells.
        rounding: two numbers, bounds of the rounding errors of the value and of the gradient, as
            multiples of the unit roundoff (half of the machine epsilon).
        """
        along_x, along_y, along_z = coefficients.shape
        index_column = np.arange(along_x, dtype=np.float64)[:, None]
        # One row (i, a_i00, a_i01, ...) for each i, in reverse order.
        records = np.concatenate([index_column, coefficients.reshape(along_x, -1)], axis=1)[::-1]
        return cls(
            backend,
            (along_x, along_y, along_z),
            _vector_parameters(backend, lower),
            _vector_parameters(backend, np.pi / size),
            RecordTable.upload(backend, records),
            (dr.opaque(backend.Float, rounding[0]), dr.opaque(backend.Float, rounding[1])),
            dr.opaque(backend.Float, bounds.curvature * (1 + _KERNEL_ROUNDING)),
            tuple(_CellCurvatures.upload(backend, cells, size) for cells in bounds.cells),
        )

    def angles(self, p: Vec3) -> Vec3:
        """The angles (u, v, w) of points p in radians; on the box they are from 0 to pi."""
        return (self.backend.Array3f(p) - self.lower) * self.rate

    def with_coefficients(self, coefficients: Real) -> CosineSums:
        """Return the series with coefficients that have derivatives.

        coefficients: a_ijk in the order of i, j and k, of the same values.

        Entry n of the row of i is a_ijk with n = 1 + j K_z + k; the last row, i = 0, is the first.
        """
        along_x, along_y, along_z = self.shape
        in_plane, width = along_y * along_z, 8 * self.rows.packets_per_record
        position = dr.arange(self.backend.UInt32, along_x * width)
        i, column = along_x - 1 - position // width, position % width
        is_coefficient = (column > 0) & (column <= in_plane)
        index = dr.select(is_coefficient, i * in_plane + column - 1, 0)
        entries = dr.gather(self.backend.Float, coefficients, index, is_coefficient)
        return replace(self, rows=self.rows.with_derivatives(entries))

    def value(self, p: Vec3, *, is_sum: bool = False) -> tuple[Real, Vec3]:
        """Return the value and the gradient of the cosine series at points p.

        is_sum: whether they can be differentiated in reverse mode (`RecordTable.for_each`).
        """
        angles = self.angles(p)
        y_waves, z_waves = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            """The sums so far, with all terms of one i added.

            row: the record (i, a_i00, a_i01, ...).
            state: the sums so far of the value and of the three components of the gradient, by the
                angles.
            """
            plane_sum, plane_sum_v, plane_sum_w = _sum_plane(row, y_waves, z_waves)
            sine, cosine = sincos(row[0] * angles.x)
            total, gx, gy, gz = state
            return (
                dr.fma(plane_sum, cosine, total),
                dr.fma(plane_sum, -row[0] * sine, gx),
                dr.fma(plane_sum_v, cosine, gy),
                dr.fma(plane_sum_w, cosine, gz),
            )

        real = self.backend.Float
        # (gx, gy, gz) is the gradient by the angles.
        start = tuple(real(0) for _ in range(4))
        total, gx, gy, gz = self.rows.for_each(add, start, "cosines", is_sum=is_sum)
        return total, self.rate * self.backend.Array3f(gx, gy, gz)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian of the cosine series at points p."""
        angles = self.angles(p)
        y_waves, z_waves = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            """The sums so far, with all terms of one i added.

            row: the record (i, a_i00, a_i01, ...).
            state: the sums xx, yy, zz, xy, xz, yz so far, which are derivatives by the angles.
            """
            plane_sum, plane_sum_v, plane_sum_w, plane_sum_vv, plane_sum_vw, plane_sum_ww = (
                _sum_plane(row, y_waves, z_waves, second=True)
            )
            sine, cosine = sincos(row[0] * angles.x)
            # Of cos(i u) by u.
            first_derivative, second_derivative = -row[0] * sine, -row[0] * row[0] * cosine
            terms = (
                plane_sum * second_derivative,
                plane_sum_vv * cosine,
                plane_sum_ww * cosine,
                plane_sum_v * first_derivative,
                plane_sum_w * first_derivative,
                plane_sum_vw * cosine,
            )
            return tuple(total + part for total, part in zip(state, terms, strict=True))

        real, vector, rate = self.backend.Float, self.backend.Array3f, self.rate
        start = tuple(real(0) for _ in range(6))
        xx, yy, zz, xy, xz, yz = self.rows.for_each(add, start, "second cosines")
        return (
            # From derivatives by the angles to derivatives by the coordinates.
            rate.x * rate * vector(xx, xy, xz),
            rate.y * rate * vector(xy, yy, yz),
            rate.z * rate * vector(xz, yz, zz),
        )

    def curvatures(self, p: Vec3) -> tuple[TaylorRemainder, ...]:
        """Bounds of the series' second derivatives on balls about p, the smallest ball first. The
        last bound holds everywhere on the box."""
        everywhere = TaylorRemainder(self.curvature + 0 * p.x, dr.inf)
        if not self.cells:
            return (everywhere,)
        fraction = self.angles(p) * float(1 / np.pi)
        return (*(cells.curvature(fraction) for cells in self.cells), everywhere)


@dataclass(frozen=True)
class _CellCurvatures:
    """Local bounds of the second derivatives of a function along directions, as arrays on a
    backend: the box is divided into a grid of n x n x n equal cells, and there is a bound for each
    cell.

    count: n.
    sides: the lengths of a cell's sides.
    bounds: for each cell a bound that holds on the cell and all its neighbors; the index along x
        runs fastest.
    """

    backend: Backend
    count: int
    sides: Vec3
    bounds: Real

    @classmethod
    def upload(cls, backend: Backend, cells: CellBounds, size: FloatArray) -> _CellCurvatures:
        """Put the bounds `cells` on a backend. size: (3,) the lengths of the box's sides."""
        bounds = upload_floats(backend, cells.bounds * (1 + _KERNEL_ROUNDING))
        return cls(backend, cells.count, _vector_parameters(backend, size / cells.count), bounds)

    def curvature(self, share: Vec3) -> TaylorRemainder:
        """A bound of second derivatives on a ball about a point: the bound of the cell that
        contains the point, which also holds on the cell's neighbors.

        share: the point, as fractions of the box from 0 to 1.

        The radius of the ball is at most the distance from the point to the outside of the
        neighbors.
        """
        position, index = share * float(self.count), self.backend.UInt32(0)
        radius: Real = dr.inf
        for axis in (2, 1, 0):
            # The index of a cell is i + count (j + count k).
            cell = clamp(dr.floor(position[axis]), 0, self.count - 1)
            index = index * self.count + self.backend.UInt32(cell)
            # The cell's neighbors reach one cell beyond it on both sides.
            offset = position[axis] - cell
            radius = fmin((1 + fmin(offset, 1 - offset)) * self.sides[axis], radius)
        constant = dr.gather(self.backend.Float, self.bounds, index)
        return TaylorRemainder(constant, radius * (1 - _KERNEL_ROUNDING * self.count))


def _vector_parameters(backend: Backend, numbers: FloatArray) -> Vec3:
    """Three numbers as a vector of Dr.Jit numbers that are data and not literals."""
    return backend.Array3f(*(dr.opaque(backend.Float, float(number)) for number in numbers))


def _waves(angle: Real, count: int) -> tuple[list[Real], list[Real]]:
    """The list of cos(k angle) and the list of its derivatives -k sin(k angle) by the angle, for 0
    <= k < count."""
    values, slopes = [0 * angle + 1], [0 * angle]
    for k in range(1, count):
        s, c = sincos(float(k) * angle)
        values.append(c)
        slopes.append(-float(k) * s)
    return values, slopes


def _sum_plane(
    row: list[Real],
    y: tuple[list[Real], list[Real]],
    z: tuple[list[Real], list[Real]],
    *,
    second: bool = False,
) -> tuple[Any, ...]:
    """For one i, the sum S of a_ijk cos(j v) cos(k w) over all j and k, and its derivatives by the
    angles v and w.

    row: the record (i, a_i00, a_i01, ...) of coefficients.
    y: the list of cos(j v) for all j, and the list of its derivatives by v.
    z: the list of cos(k w) for all k, and the list of its derivatives by w.
    second: whether to compute second derivatives, too.

    Returns S, S_v and S_w; with `second` also S_vv, S_vw and S_ww.
    """
    (cos_y, slope_y), (cos_z, slope_z) = y, z
    count = len(cos_z)
    # S, S_v, S_w and, with `second`, S_vv, S_vw, S_ww.
    sums: list[Any] = [0 * cos_y[0]] * (6 if second else 3)
    for j in reversed(range(len(cos_y))):
        # The sum over k of a_ijk cos(k w), and its derivatives by w.
        inner_sum, inner_slope, inner_second = 0 * cos_y[0], 0 * cos_y[0], 0 * cos_y[0]
        for k in reversed(range(count)):
            coefficient = row[1 + j * count + k]
            inner_sum, inner_slope = (
                dr.fma(coefficient, cos_z[k], inner_sum),
                dr.fma(coefficient, slope_z[k], inner_slope),
            )
            # cos(k w) for k = 0 is constant.
            if second and k:
                inner_second = dr.fma(coefficient * float(-k * k), cos_z[k], inner_second)
        sums[0] = dr.fma(inner_sum, cos_y[j], sums[0])
        sums[1] = dr.fma(inner_sum, slope_y[j], sums[1])
        sums[2] = dr.fma(inner_slope, cos_y[j], sums[2])
        if second:
            sums[3] = dr.fma(inner_sum * float(-j * j), cos_y[j], sums[3])
            sums[4] = dr.fma(inner_slope, slope_y[j], sums[4])
            sums[5] = dr.fma(inner_second, cos_y[j], sums[5])
    return tuple(sums)
