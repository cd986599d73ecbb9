"""Cosine series on a box: fitting, proved bounds, and evaluation on a backend.

    f(p) = sum a_ijk cos(i u) cos(j v) cos(k w),   (u, v, w) = pi (p - lower)/(upper - lower),

with 0 <= i < K_x, 0 <= j < K_y and 0 <= k < K_z. `fit_cosines` and `CosineBounds` are computed once
for a series, with NumPy in double precision; `CosineSums` evaluates the series.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
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
    shape[2] cells.

    lower, upper: (3,) the corners of the box.

    Their order is that of a flattened array of this shape.
    """
    axes = [
        lower[a] + (upper[a] - lower[a]) * (np.arange(n) + 0.5) / n for a, n in enumerate(shape)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def fit_cosines(grid: FloatArray, terms: tuple[int, int, int]) -> FloatArray:
    """The coefficients (K_x, K_y, K_z) of the cosine series that fits values at the midpoints of
    cells.

    grid: (n_x, n_y, n_z) the values.
    terms: the numbers of terms (K_x, K_y, K_z).

    They come from the discrete cosine transform of type 2. With as many terms as values the series
    passes through all values. Its first terms are the best fit in mean square, since the cosines
    are orthogonal on the midpoints.
    """
    from scipy import fft  # imported here, as it takes time and is rarely needed

    transform = np.asarray(cast("Any", fft).dctn(grid, type=2), dtype=np.float64) / grid.size
    coefficients = transform[: terms[0], : terms[1], : terms[2]].copy()
    for axis in range(3):
        first = [slice(None)] * 3
        first[axis] = slice(0, 1)
        coefficients[tuple(first)] *= 0.5
    return coefficients


def evaluate_on_grid(
    coefficients: FloatArray, angles: tuple[FloatArray, FloatArray, FloatArray],
    orders: tuple[int, int, int] = (0, 0, 0),
) -> FloatArray:  # fmt: skip
    """The series, or a derivative of it by the angles, on a grid of angles; an array (n_x, n_y,
    n_z).

    coefficients: (K_x, K_y, K_z).
    angles: the angles u, v and w of the grid, arrays (n_x,), (n_y,) and (n_z,).
    orders: how often the series is differentiated by u, by v and by w.
    """
    values = coefficients
    for angle, order in zip(angles, orders, strict=True):
        k: FloatArray = np.arange(values.shape[0], dtype=np.float64)
        # cos(k u) differentiated `order` times.
        waves: FloatArray = k**order * np.cos(np.outer(angle, k) + 0.5 * math.pi * order)
        values = np.moveaxis(np.tensordot(waves, values, axes=(1, 0)), 0, -1)
    return values


@dataclass(frozen=True)
class CellBounds:
    """Local bounds of the absolute directional second derivatives, on a grid of cells over the box.

    count: the number n of cells along each side of the box.
    bounds: (n^3,) for each cell a bound that holds on the cell and all its neighbors; the index
        along x runs fastest.
    """

    count: int
    bounds: FloatArray


@dataclass(frozen=True)
class CosineBounds:
    """Proved bounds of a cosine series.

    low, high: the values of f on the box are between them.
    curvature: a bound of |v . H v| for unit vectors v and the Hessian H, on the box.
    cells: local bounds of |v . H v|, finest grid first; only grids that are worth a lookup.
    cell_low, cell_high: (32, 32, 32) the ranges of f on 32^3 cells of the box.

    Proof. Let T be f, or v . H v for a fixed v. Along each axis T is a trigonometric polynomial of
    the angle, of degree n = K - 1. Take a grid of N = 2 n m > 2 n angles per full turn. The angles
    from 0 to pi suffice by symmetry: f is even in each angle, and a change of the sign of an angle
    turns v . H v into v' . H v' with other signs in v. By Ehlich and Zeller (1964), |T| <=
    (maximum over the grid)/cos(pi n/N), for one axis after the other. Let G be this bound. Then
    |T_uu| <= n^2 G (Bernstein), so the error of linear interpolation between nodes h = pi/(n m)
    apart is at most h^2/8 n^2 G = pi^2 G/(8 m^2) along each axis. A bound at the nodes of a cell,
    plus these errors, is a bound on the cell.
    """

    low: float
    high: float
    curvature: float
    cells: tuple[CellBounds, ...]
    cell_low: FloatArray
    cell_high: FloatArray

    @classmethod
    def of(cls, coefficients: FloatArray, size: FloatArray) -> CosineBounds:
        """The bounds of the series with these coefficients (K_x, K_y, K_z).

        size: (3,) the lengths of the box's sides.

        Symbols: for each axis n is the degree and m, in `densities`, the number of nodes per half
        wave. factor is the product of all 1/cos(pi n/N), and error the sum of all pi^2/(8 m^2).
        """
        degrees: list[int] = [n - 1 for n in coefficients.shape]
        densities = [min(max(_MIN_NODES, _AXIS_NODES // max(n, 1)), _MAX_NODES) for n in degrees]
        angles: list[FloatArray] = [
            math.pi * np.arange(n * m + 1) / max(n * m, 1) if n else np.zeros(1)
            for n, m in zip(degrees, densities, strict=True)
        ]
        factor = math.prod(
            1 / math.cos(0.5 * math.pi / m) if n else 1.0
            for n, m in zip(degrees, densities, strict=True)
        )
        error = sum(
            math.pi**2 / (8 * m * m) if n else 0.0 for n, m in zip(degrees, densities, strict=True)
        )
        nodes = angles[0], angles[1], angles[2]
        values = evaluate_on_grid(coefficients, nodes)
        middle = 0.5 * float(values.min() + values.max())
        half = 0.5 * float(values.max() - values.min()) * factor * (1 + _ROUNDING)
        half += _ROUNDING * abs(middle)
        norms = _spectral_norms(coefficients, nodes, math.pi / size)
        curvature = float(norms.max()) * factor * (1 + _ROUNDING)
        cells: list[CellBounds] = []
        for count in _CELLS:
            local = _cell_extremes(norms, angles, count, 1, np.maximum) + error * curvature
            local = np.minimum(local * (1 + _ROUNDING), curvature)
            if float(local.mean()) <= _MAX_RATIO * curvature:
                # x is the first index in `_cell_extremes` and runs fastest on the device.
                cells.append(CellBounds(count, np.ascontiguousarray(local.T).ravel()))
        margin = error * half + _ROUNDING * (abs(middle) + half)
        return cls(
            middle - half,
            middle + half,
            curvature,
            tuple(cells),
            _cell_extremes(values, angles, _EXTENT_CELLS, 0, np.minimum) - margin,
            _cell_extremes(values, angles, _EXTENT_CELLS, 0, np.maximum) + margin,
        )

    def extent(self, levels: tuple[float, ...]) -> tuple[FloatArray, FloatArray] | None:
        """The corners (3,), (3,) of a box that contains the level sets, as fractions of the whole
        box from 0 to 1; None if there are no level sets."""
        is_met = np.zeros(self.cell_low.shape, dtype=bool)
        for level in levels:
            is_met |= (self.cell_low <= level) & (level <= self.cell_high)
        if not is_met.any():
            return None
        low, high = np.zeros(3), np.ones(3)
        for axis in range(3):
            other_axes = tuple(a for a in range(3) if a != axis)
            indices = np.flatnonzero(is_met.any(axis=other_axes))
            low[axis], high[axis] = indices[0] / len(is_met), (indices[-1] + 1) / len(is_met)
        return low, high


def _spectral_norms(
    coefficients: FloatArray,
    nodes: tuple[FloatArray, FloatArray, FloatArray],
    rates: FloatArray,
) -> FloatArray:
    """The largest absolute eigenvalue of the Hessian at each node of a grid, an array (n_x, n_y,
    n_z).

    nodes: the angles of the grid along each axis.
    rates: (3,) the derivatives of the angles by the coordinates, pi over the sides of the box.

    The grid is evaluated in slabs, to save memory. The eigenvalues of symmetric 3x3 matrices are
    computed by Smith's formula (1961).
    """
    norms = np.empty(tuple(len(values) for values in nodes))
    slab = max(1, 400_000 // (norms.shape[1] * norms.shape[2]))
    for start in range(0, len(nodes[0]), slab):
        slab_nodes = nodes[0][start : start + slab], nodes[1], nodes[2]
        second: dict[tuple[int, int], FloatArray] = {}
        for a, b in itertools.combinations_with_replacement(range(3), 2):
            orders = [0, 0, 0]
            orders[a] += 1
            orders[b] += 1
            derivative = evaluate_on_grid(
                coefficients, slab_nodes, (orders[0], orders[1], orders[2])
            )
            second[a, b] = rates[a] * rates[b] * derivative
        xx, yy, zz = second[0, 0], second[1, 1], second[2, 2]
        xy, xz, yz = second[0, 1], second[0, 2], second[1, 2]
        mean = (xx + yy + zz) / 3
        x, y, z = xx - mean, yy - mean, zz - mean
        spread = np.sqrt((x * x + y * y + z * z + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
        divisor = np.where(spread > 0, spread, 1.0)
        x, y, z, xy, xz, yz = (values / divisor for values in (x, y, z, xy, xz, yz))
        half = 0.5 * (x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz))
        angle = np.arccos(np.clip(half, -1, 1)) / 3
        top = mean + 2 * spread * np.cos(angle)
        bottom = mean + 2 * spread * np.cos(angle + 2 * math.pi / 3)
        # Near 1, the error of the arccosine is the square root of the error of its argument.
        norms[start : start + slab] = np.maximum(np.abs(top), np.abs(bottom)) + 1e-7 * spread
    return norms


def _cell_extremes(
    values: FloatArray, angles: list[FloatArray], count: int, margin: int, ufunc: Any
) -> FloatArray:
    """The extremes of values at nodes, for each of count^3 cells of the box, (count, count, count).

    values: the values at the nodes, an array over the three axes.
    angles: the angles of the nodes along each axis, evenly spaced from 0 to pi.
    margin: the number of neighboring cells, on each side, whose nodes are included; 0 for the nodes
        in and next to the cell only.
    ufunc: np.minimum or np.maximum.
    """
    for axis in range(3):
        intervals = len(angles[axis]) - 1
        columns: list[FloatArray] = []
        for cell in range(count):
            first = max(cell - margin, 0) * intervals // count
            last = -(-min(cell + 1 + margin, count) * intervals // count)
            part = np.moveaxis(values, axis, 0)[first : last + 1]
            columns.append(ufunc.reduce(part, axis=0))
        values = np.stack(columns, axis=axis)
    return values


# Constants are increased, and radii decreased, by this fraction for the roundings of float32.
_KERNEL_ROUNDING = 1e-5


@dataclass(frozen=True)
class CosineSums:
    """The coefficients and local bounds of a cosine series on a backend. The object evaluates the
    series.

    backend: the backend.
    shape: (K_x, K_y, K_z), the numbers of terms along the axes.
    lower: the lower corner of the box.
    rate: pi over the sides of the box, the change of the angles per length.
    rows: a record (i, a_i00, a_i01, ...) for each i, the highest i first.
    rounding: bounds of the rounding errors of value and gradient, as multiples of the unit roundoff
        u, without the error that acts like a move of the point.
    curvature: a bound of the absolute directional second derivatives on the box.
    cells: bounds of the same on single cells, finest grid first.

    Evaluation. Sums over k are computed for each i and j, then sums over j for each i, and the sum
    over i last (sum factorization). This takes about 2 K^3 products, whereas a sum of terms would
    need 7 K^3. i runs in a recorded loop over the records, while the sums over j and k are
    unrolled. The coefficients are kernel parameters, so another function fitted by as many terms
    compiles no other kernel. Each sum begins with the highest frequency, so that the large terms,
    of low frequency, take part in the fewest roundings.
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
        """The series with these coefficients (K_x, K_y, K_z) on a backend.

        lower, size: (3,) the lower corner and the sides of the box.
        bounds: bounds of the directional second derivatives of the series, on the box and on cells.
        rounding: two numbers, bounds of the rounding errors of the value and of the gradient, as
            multiples of the unit roundoff u.
        """
        count, along_y, along_z = coefficients.shape
        first = np.arange(count, dtype=np.float64)[:, None]
        table = np.concatenate([first, coefficients.reshape(count, -1)], axis=1)[::-1]
        return cls(
            backend,
            (count, along_y, along_z),
            _vector_parameters(backend, lower),
            _vector_parameters(backend, np.pi / size),
            RecordTable.upload(backend, table),
            (dr.opaque(backend.Float, rounding[0]), dr.opaque(backend.Float, rounding[1])),
            dr.opaque(backend.Float, bounds.curvature * (1 + _KERNEL_ROUNDING)),
            tuple(_CellCurvatures.upload(backend, cells, size) for cells in bounds.cells),
        )

    def angles(self, p: Vec3) -> Vec3:
        """The angles (u, v, w) of points p; on the box they are from 0 to pi."""
        return (self.backend.Array3f(p) - self.lower) * self.rate

    def value(self, p: Vec3) -> tuple[Real, Vec3]:
        """The value and the gradient of the series at points p."""
        angles = self.angles(p)
        y, z = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            """The state after the terms of one i are added.

            row: the record of i.
            state: the sums so far of the value and of the three components of the gradient.
            """
            b, by, bz = _sum_plane(row, y, z)
            s, c = sincos(row[0] * angles.x)
            f, gx, gy, gz = state
            return (
                dr.fma(b, c, f),
                dr.fma(b, -row[0] * s, gx),
                dr.fma(by, c, gy),
                dr.fma(bz, c, gz),
            )

        real = self.backend.Float
        f, gx, gy, gz = self.rows.for_each(add, tuple(real(0) for _ in range(4)), "cosines")
        return f, self.rate * self.backend.Array3f(gx, gy, gz)

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the Hessian at points p."""
        angles = self.angles(p)
        y, z = _waves(angles.y, self.shape[1]), _waves(angles.z, self.shape[2])

        def add(row: list[Real], state: tuple[Real, ...]) -> tuple[Real, ...]:
            """The state after the terms of one i are added.

            row: the record of i.
            state: the sums xx, yy, zz, xy, xz, yz so far.
            """
            b, by, bz, byy, byz, bzz = _sum_plane(row, y, z, second=True)
            s, c = sincos(row[0] * angles.x)
            d, e = -row[0] * s, -row[0] * row[0] * c
            parts = (b * e, byy * c, bzz * c, by * d, bz * d, byz * c)
            return tuple(total + part for total, part in zip(state, parts, strict=True))

        real, vector, r = self.backend.Float, self.backend.Array3f, self.rate
        start = tuple(real(0) for _ in range(6))
        xx, yy, zz, xy, xz, yz = self.rows.for_each(add, start, "second cosines")
        return (
            r.x * r * vector(xx, xy, xz),
            r.y * r * vector(xy, yy, yz),
            r.z * r * vector(xz, yz, zz),
        )

    def curvatures(self, p: Vec3) -> tuple[TaylorRemainder, ...]:
        """Bounds of second derivatives on balls about p, as promises: on the smallest ball first;
        the last bound holds everywhere on the box."""
        everywhere = TaylorRemainder(self.curvature + 0 * p.x, dr.inf)
        if not self.cells:
            return (everywhere,)
        fraction = self.angles(p) * float(1 / np.pi)
        return (*(cells.curvature(fraction) for cells in self.cells), everywhere)


@dataclass(frozen=True)
class _CellCurvatures:
    """Local bounds of second derivatives on a backend.

    count: the number of cells along each side of the box.
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
        """The bounds `cells` on a backend; size: (3,) the lengths of the box's sides."""
        bounds = upload_floats(backend, cells.bounds * (1 + _KERNEL_ROUNDING))
        return cls(backend, cells.count, _vector_parameters(backend, size / cells.count), bounds)

    def curvature(self, share: Vec3) -> TaylorRemainder:
        """A bound of second derivatives on a ball about a point, as a promise: the bound of the
        cell that contains the point, which also holds on the cell's neighbors.

        share: the point, as fractions of the box from 0 to 1.

        The radius of the ball is at most the distance from the point to the boundary of the
        neighbors.
        """
        position, index = share * float(self.count), self.backend.UInt32(0)
        radius: Real = dr.inf
        for axis in (2, 1, 0):
            cell = clamp(dr.floor(position[axis]), 0, self.count - 1)
            index = index * self.count + self.backend.UInt32(cell)
            offset = position[axis] - cell
            radius = fmin((1 + fmin(offset, 1 - offset)) * self.sides[axis], radius)
        constant = dr.gather(self.backend.Float, self.bounds, index)
        return TaylorRemainder(constant, radius * (1 - _KERNEL_ROUNDING * self.count))


def _vector_parameters(backend: Backend, numbers: FloatArray) -> Vec3:
    """Three numbers as a vector of kernel parameters."""
    return backend.Array3f(*(dr.opaque(backend.Float, float(number)) for number in numbers))


def _waves(angle: Real, count: int) -> tuple[list[Real], list[Real]]:
    """cos(k angle), and its derivative -k sin(k angle) by the angle, for 0 <= k < count."""
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
    """The sum S of a_ijk cos(j v) cos(k w) over j and k, for one i, and its derivatives by the
    angles v and w.

    row: the record (i, a_i00, a_i01, ...).
    y: for all j, the list of cos(j v) and the list of its derivatives by v.
    z: for all k, the list of cos(k w) and the list of its derivatives by w.
    second: whether to compute second derivatives, too.

    Returns S, S_v and S_w; with `second` also S_vv, S_vw and S_ww.
    """
    (cos_y, slope_y), (cos_z, slope_z) = y, z
    count = len(cos_z)
    sums: list[Any] = [0 * cos_y[0]] * (6 if second else 3)
    for j in reversed(range(len(cos_y))):
        a, b, c = 0 * cos_y[0], 0 * cos_y[0], 0 * cos_y[0]
        for k in reversed(range(count)):
            coefficient = row[1 + j * count + k]
            a, b = dr.fma(coefficient, cos_z[k], a), dr.fma(coefficient, slope_z[k], b)
            if second and k:
                c = dr.fma(coefficient * float(-k * k), cos_z[k], c)
        sums[0] = dr.fma(a, cos_y[j], sums[0])
        sums[1] = dr.fma(a, slope_y[j], sums[1])
        sums[2] = dr.fma(b, cos_y[j], sums[2])
        if second:
            sums[3] = dr.fma(a * float(-j * j), cos_y[j], sums[3])
            sums[4] = dr.fma(b, slope_y[j], sums[4])
            sums[5] = dr.fma(c, cos_y[j], sums[5])
    return tuple(sums)
