"""The field of a `Morph`, an interpolation of two shapes, at a height strictly between its two
ends. It is a slice of the sum of two solid angles in four dimensions.

- `MorphSlice`: the field.
- `SlicedKernel`: its kernel, with the proof of its bounds.
- `quadrature_points`: triangle meshes as oriented points. Large triangles are cut, small triangles
are merged.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.polynomial import chebyshev, legendre

from harnack.backend import backend_of
from harnack.backend.elementary import fmax
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import HarmonicBall
from harnack.fields.batch_evaluation import evaluate_points
from harnack.fields.batched_fields import PointValues
from harnack.fields.clearance import (
    UnitFrame,
    VariableAccuracyField,
    coordinate_rounding,
    frame_parameters,
    occupied_cells,
    round_to_single,
    tight_extent,
)
from harnack.fields.field import Sample
from harnack.fields.solid_angles.radial_kernel import (
    BALL_FRACTION,
    KernelValues,
    RadialKernel,
    RadialSums,
)
from harnack.fields.solid_angles.radial_tree import ClusteredDipoles, RadialTreecode
from harnack.fields.solid_angles.treecode import dipole_records
from harnack.fields.source_sums import SLOPE_ROUNDINGS, SUM_MARGIN

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, FloatArray, IntArray, Precision, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid

GRADIENT_BOUND = 1.1855
"""Half the largest gradient of a dipole in four dimensions, times D^3. It is Q_2 of
`SlicedKernel`."""

# Degrees of the polynomial for the last i_n of `SlicedKernel`, by the number of bytes of a number.
# The function is singular at c = -1, so that the coefficients of degree k fall as 5.8^-k.
_DEGREES = {4: 12, 8: 22}


class SlicedKernel(RadialKernel):
    """The kernel (4/pi) K(r, w) on a backend, at a height w > 0. It comes from the Newton kernel of
    four dimensions, restricted to a slice of three dimensions.

    Kernel. 1/|X|^2 is harmonic in R^4. The solid angle of a flat solid A x {0} at (x, w) is
    U = w int_A dV/(r^2 + w^2)^2 with r = |y-x|. By the divergence theorem U is the integral over
    the boundary of A of -n.grad_y K, with

        K(r, w) = (1/2) int_w^oo dv/(r^2 + v^2) = atan(r/w)/(2r),   pi/(4r) for w = 0.

    So each dipole -m.grad_y K is harmonic in (x, w) except at the dipole and below it. Here K is
    scaled by 4/pi, so that it is 1/r for w = 0: sums over m = area n/(4 pi) are then U/pi^2, and
    for w = 0 the winding number. As -(1/r) d/dr (r^2+v^2)^-k = 2k (r^2+v^2)^-(k+1), with
    D^2 = r^2 + w^2, c = w/D, s = r/D,

        psi_k = (2/pi) 2^k k! i_(k+1)/D^(2k+1),   i_k = D^(2k-1) int_w^oo dv/(r^2+v^2)^k,
        i_k = (2k s^2 i_(k+1) + c)/(2k-1)   by parts: positive terms, which lose no digits.

    The last i_n = int_0^1 (sin(phi t)/sin phi)^(2n-2) dt phi/sin phi, cos phi = c, is a function of
    c that is analytic except for c <= -1: on [0, 1] it is computed as a polynomial.

    Bound. |d^m K[u_1, ..., u_m]| <= m!/D^(m+1) for unit vectors, as for 1/r at the distance D. The
    bound is attained for w = 0. Proof. Equal vectors u are the worst (Banach 1938). The m-th
    derivative of 1/|X|^2 along a line is (-1)^m m! U_m(cos)/|X|^(m+2), with Chebyshev's polynomial
    U_m of the cosine of the angle between X and the line (Gegenbauer). Let z = y - x,
    x = D/sqrt(r^2 + v^2) and a = u.z/D, |a| <= s. Then the derivative of K is +-m!/D^(m+1) times
    (2/pi) I, with

        I = int_0^1 U_m(a x) x^m (1 - s^2 x^2)^(-1/2) dx.

    For s = 1, that is w = 0, it is (pi/2) P_m(a), at most pi/2. For s < 1 the weight is that for
    s = 1 times a factor that falls from 1, so that I is the same integral for s = 1 up to a number
    b <= 1 (Bonnet). The integral is largest for b = 1, or where U_m(a b) = 0 at an angle
    k pi/(m+1), k >= 1. Lobes between such angles alternate and grow with x, as
    x^m (1 - x^2)^(-1/2) does: the integral is at most its last lobe, which is the largest if it
    ends at b = 1, where it is below 0.4 for m <= 7 (quadrature in `tests/fields/test_morph.py`).

    In four dimensions the gradient of n.grad_x K is at most 2 * 1.1855/D^3: its square is
    cos^2 (K''^2 + (dw K')^2) + sin^2 (K'/r)^2, cos the cosine of the angle from n to z, and so at
    most the larger of two functions of c alone (maximum at w = r; the same tests).
    """

    def __init__(self, backend: Backend, height: float) -> None:
        """height: w, in the unit of the distances."""
        self.height = dr.opaque(backend.Float, height)
        self.height_square = dr.opaque(backend.Float, height * height)
        self._degree = _DEGREES[np.dtype(backend.dtype).itemsize]

    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """The functions psi_0 to psi_last of the class, at the distance D in four dimensions. The
        last of the integrals i_n comes from a polynomial, and the other ones from the recurrence.

        inverse: 1/D.
        """
        del distance
        c = self.height * inverse
        s2 = dr.fma(-c, c, 1)
        moment = _horner(dr.fma(2, c, -1), moment_polynomial(last + 1, self._degree))
        thetas = [_psi_factor(last) * moment]
        for k in range(last, 0, -1):
            moment = dr.fma(2 * k * s2, moment, c) * (1 / (2 * k - 1))
            thetas.insert(0, _psi_factor(k - 1) * moment)
        return KernelValues(inverse, thetas)

    def bounds(self, distance: Real, last: int) -> list[Real]:
        """The numbers Q_2 to Q_last of the class: m! Q_m/D^(m+1) bounds m-th derivatives along
        lines at distances D. They are the same for all distances."""
        del distance
        return [GRADIENT_BOUND, *(1.0 for _ in range(3, last + 1))]

    def growth(self, r: Real) -> Real:
        """A factor that bounds how much larger the numbers Q_m of `bounds` are at a distance that
        is shorter by r."""
        del r
        return 1.0

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """For clusters of dipoles with these radii (k,), the distances (k,) beyond which their
        moments are used. accuracy: the larger it is, the larger are the distances."""
        return accuracy * radius + 1e-5


@functools.cache
def moment_polynomial(n: int, degree: int) -> tuple[float, ...]:
    """The coefficients, in ascending order, of a polynomial in 2c - 1 of this degree that
    approximates the integral i_n(c) of `SlicedKernel` for c in [0, 1]."""
    t, weight = legendre.leggauss(48)
    t, weight = 0.5 * (t + 1), 0.5 * weight

    def moment(x: FloatArray) -> FloatArray:
        """The values of i_n at x = 2c - 1. x: an array of numbers in [-1, 1]."""
        phi = np.arccos(0.5 * (x + 1))[:, None]
        ratio = np.sin(phi * t) / np.sin(phi)
        return phi[:, 0] / np.sin(phi[:, 0]) * (ratio ** (2 * n - 2) @ weight)

    nodes = chebyshev.chebpts1(2 * degree)
    series = chebyshev.chebfit(nodes, moment(nodes), degree)
    return tuple(float(coefficient) for coefficient in chebyshev.cheb2poly(series))


def _horner(x: Real, coefficients: tuple[float, ...]) -> Real:
    """The value at x of the polynomial with these coefficients, in ascending order."""
    total: Real = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = dr.fma(total, x, coefficient)
    return total


def _psi_factor(k: int) -> float:
    """The factor (2/pi) 2^k k! in the formula for psi_k of `SlicedKernel`."""
    return 2 / math.pi * 2.0**k * math.factorial(k)


# The size of the cells in which triangles are merged, and the longest edge of triangles that are
# merged: both as a fraction of the longest edge that pieces may have.
_CELL_FRACTION = 0.54


@dataclass(frozen=True)
class QuadraturePoints:
    """Oriented points for the quadrature of integrals over triangles. A point stands for a piece of
    a triangle, or for several small triangles: the group of the point.

    points: (n, 3) the centroids of the groups.
    moments: (n, 3) for each group, the sum of area times normal.
    farthest: the largest distance, in all groups, between a point of a triangle and the quadrature
        point that stands for it.
    second_moment_ratio: the largest ratio, over all groups, of the integral of |d|^2 over the
        triangles of the group to |m|. Here d is the offset from the quadrature point, and m is the
        moment of the group.
    first_moment_ratio: the largest ratio, over all groups, of |T|_F to |m|. Here T (3, 3) is the
        sum of m_i d_i^T over the triangles i of the group, with m_i the triangle's area times
        normal, d_i the offset of its centroid from the quadrature point, and |T|_F the Frobenius
        norm.
    """

    points: FloatArray
    moments: FloatArray
    farthest: float
    second_moment_ratio: float
    first_moment_ratio: float


def piece_counts(corners: FloatArray, longest: float) -> IntArray:
    """The number of pieces (m,) into which each edge of the triangles (m, 3, 3) is cut, so that no
    piece is longer than `longest`."""
    return np.maximum(np.ceil(_longest_edges(corners) / longest), 1).astype(np.int64)


def quadrature_points(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Quadrature points for triangles (m, 3, 3).

    longest: the length that edges of pieces may have. A larger triangle is cut into similar pieces,
        each with a point at its centroid. Of much smaller triangles, all that lie in the same cell
        of space and face the same way have a single point.
    """
    is_small = _longest_edges(corners) <= _CELL_FRACTION * longest
    parts = [
        sample(rows, longest)
        for sample, rows in ((_subdivide, corners[~is_small]), (_merge_small, corners[is_small]))
        if len(rows)
    ]
    return QuadraturePoints(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.moments for part in parts]),
        max(part.farthest for part in parts),
        max(part.second_moment_ratio for part in parts),
        max(part.first_moment_ratio for part in parts),
    )


def _longest_edges(corners: FloatArray) -> FloatArray:
    """The lengths (m,) of the longest edges of triangles (m, 3, 3)."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)


def _corner_distances(corners: FloatArray, points: FloatArray) -> FloatArray:
    """The largest distance (m,) of a corner of each triangle (m, 3, 3) from the point (m, 3) that
    belongs to it."""
    return np.linalg.norm(corners - points[:, None], axis=2).max(axis=1)


def _areas(corners: FloatArray) -> FloatArray:
    """Area times normal (m, 3) of triangles (m, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def _mean_squares(corners: FloatArray) -> FloatArray:
    """The mean square distance (m,) from the centroid over each triangle (m, 3, 3)."""
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2)) / 36


def _subdivide(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Quadrature points for triangles (m, 3, 3) with edges longer than `longest`: the centroids of
    pieces. A triangle is cut into count^2 similar pieces, where count is its number from
    `piece_counts`. The first moments of the pieces about their centroids vanish."""
    counts = piece_counts(corners, longest)
    points: list[FloatArray] = []
    moments: list[FloatArray] = []
    for count in np.unique(counts):
        triangles = corners[counts == count]
        a, b, c = np.moveaxis(triangles, 1, 0)
        # Pieces with the orientation of the triangle, and the rotated ones between them.
        i, j = np.indices((count, count)).reshape(2, -1)
        steps = [(i + j < count, 1 / 3), (i + j < count - 1, 2 / 3)]
        u, v = (
            np.concatenate([index[mask] + shift for mask, shift in steps]) / count
            for index in (i, j)
        )
        middle = a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]
        points.append(middle.reshape(-1, 3))
        moments.append(np.repeat(_areas(triangles) / count**2, count**2, axis=0))
    spread = float((_mean_squares(corners) / counts**2).max())
    farthest = float((_corner_distances(corners, corners.mean(axis=1)) / counts).max())
    return QuadraturePoints(np.concatenate(points), np.concatenate(moments), farthest, spread, 0.0)


def _merge_small(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Quadrature points for small triangles (m, 3, 3). `longest` is the length that edges of pieces
    may have; cells are a fraction of it wide. There is a single point for all triangles whose
    centroids are in the same cell of space, and whose normals have the same largest component with
    the same sign. So the length of their total moment is at least 1/sqrt(3) of their area."""
    moments, centroids = _areas(corners), corners.mean(axis=1)
    axis = np.abs(moments).argmax(axis=1)
    is_positive = np.take_along_axis(moments, axis[:, None], axis=1)[:, 0] > 0
    cells = np.floor(centroids / (_CELL_FRACTION * longest)).astype(np.int64)
    keys = np.column_stack([cells, 2 * axis + is_positive])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.ravel()
    area = np.linalg.norm(moments, axis=1)
    points = _sums(group, area[:, None] * centroids) / _sums(group, area[:, None])
    offset = centroids - points[group]
    total = _sums(group, moments)
    length = np.linalg.norm(total, axis=1)
    square = area * (_mean_squares(corners) + (offset * offset).sum(axis=1))
    outer = np.einsum("ki,kj->kij", moments, offset).reshape(-1, 9)
    first = np.linalg.norm(_sums(group, outer), axis=1)
    spread = float((_sums(group, square[:, None])[:, 0] / length).max())
    farthest = float(_corner_distances(corners, points[group]).max())
    return QuadraturePoints(points, total, farthest, spread, float((first / length).max()))


def _sums(group: IntArray, values: FloatArray) -> FloatArray:
    """The sums (groups, k) of the rows of `values` (m, k) that belong to the same group. group:
    (m,) the index of each row's group."""
    columns: list[FloatArray] = [
        np.bincount(group, column).astype(np.float64) for column in values.T
    ]
    return np.column_stack(columns)


MOST_POINTS = 4_000_000
"""The largest number of points of the quadrature of both meshes together."""

_SMALLEST_LEVEL = 1e-6
# The largest number of cells that are tested in one round for an extent.
_MOST_CELLS = 40_000
# The number of cells of the grid along its longest side, by experiment.
_CELLS_ACROSS = 128


class MorphSlice(VariableAccuracyField["_SliceBuffers"]):
    """A shape between two closed meshes a and b, as the level set f = 1/2 of the field
    f(x) = (U_a(x, w) + U_b(x, gap - w))/(2 pi^2) with 0 < w < gap. For small w the shape is near
    mesh a, for w near gap it is near mesh b.

    U_a(x, w) is the solid angle that the flat solid inside mesh a subtends in four dimensions, seen
    from the point x at the height w above it (see `Morph`). It is computed as a sum over oriented
    points that stand for the triangles.

    corners: the triangles of both meshes, as two arrays (m, 3, 3).
    w, gap: the height of the slice above mesh a, and the height of mesh b above mesh a.
    spacing: the largest length of the edges of pieces of triangles, in units of the height of the
        slice above (or below) their mesh.
    accuracy: the moments of a cluster of points are used beyond this many times its radius.

    Promises (proved bounds of f near a point). Let d be the smallest distance, in four dimensions,
    of a quadrature point from x. The promises are a bound of the second derivatives within
    0.45 d (`TaylorRemainder`), and a range of f on a ball in four dimensions of radius 0.35 d
    (`HarmonicBall`). The steps that the latter proves are shorter. `SlicedKernel` has the proof of
    the former: the second derivatives of a point's part of f are at most those of a dipole in three
    dimensions, at a distance equal to the distance of x from the point in four dimensions.
    """

    default_level = 0.5
    is_larger_inside = True
    has_separate_batch_data = False

    def __init__(
        self, corners: Sequence[FloatArray], *, w: float, gap: float, spacing: float,
        accuracy: float,
    ) -> None:  # fmt: skip
        super().__init__()
        self.heights = (w, gap - w)
        self.spacing, self.accuracy = spacing, accuracy
        low = np.min([pair.min(axis=(0, 1)) for pair in corners], axis=0)
        high = np.max([pair.max(axis=(0, 1)) for pair in corners], axis=0)
        self._box = low, high
        self._center = round_to_single(0.5 * (low + high))
        # A power of two, so that lengths are scaled without rounding.
        self._size = 2.0 ** math.ceil(math.log2(0.5 * float((high - low).max())))
        longest = [spacing * height for height in self.heights]
        _check_count([piece_counts(*pair) for pair in zip(corners, longest, strict=True)], w, gap)
        self._pieces = tuple(
            quadrature_points(*pair) for pair in zip(corners, longest, strict=True)
        )
        self._dipoles = tuple(self._dipole_tree(pair) for pair in self._pieces)
        self._extents: TransientCache[tuple[float, ...], Volume] = TransientCache()
        self._occupied: TransientCache[tuple[float, ...], OccupancyGrid] = TransientCache()

    def _dipole_tree(self, pieces: QuadraturePoints) -> ClusteredDipoles:
        """The tree over the dipoles of the quadrature points of one of the two meshes, one dipole
        for each point.

        pieces: the quadrature points, in the user's coordinates.

        Positions are relative to the field's center and divided by its size. Moments are
        scaled so that, with the scaled kernel of `SlicedKernel`, they contain the factor 1/(2 pi^2)
        of f: f is the plain sum of the dipoles' potentials over both meshes.
        """
        scale = 1 / (8 * math.pi * self._size**2)
        points = (pieces.points - self._center) / self._size
        return ClusteredDipoles.of(dipole_records(points, scale * pieces.moments))

    @property
    def point_counts(self) -> tuple[int, ...]:
        """The numbers of quadrature points of both meshes."""
        return tuple(len(dipoles.rows) for dipoles in self._dipoles)

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Values and derivatives at points x (3, n), with error bounds (`BatchedField.values_at`).

        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        closer: the accuracy scale.
        """
        buffers = self._batch_data(backend_of(x))
        x = buffers.to_unit(x)
        sums = buffers.sums(x, closer, derivatives).sums
        rounding = 8 * buffers.backend.machine_epsilon * dr.abs(sums.value)
        values = sums.values(1.0, coordinate_rounding(x), rounding)
        weight = sum(float(dipoles.rows[:, 6].sum()) for dipoles in self._dipoles)
        return values.with_far_field_errors(x, 64, weight).rescaled(buffers.size)

    def quadrature_displacement(
        self, points: Any, precision: Precision | None = None
    ) -> FloatArray:
        """A bound (n,), to first order, of the distance between the surface of this field and the
        surface that exact integration over the triangles would give, at points (n, 3) of the
        surface. It is the bound of the quadrature's error, divided by the length of the gradient.

        Let a quadrature point at distance D stand for a part of the mesh with moment m, made of
        triangles with moments m_i at offsets d_i from it. Its error is at most 2 |T|_*/D^3 plus the
        remainder of Taylor's formula. Here T is the sum of the products m_i d_i^T, and |T|_* its
        nuclear norm, at most sqrt(3) times the Frobenius norm. The remainder is at most |m| times
        the mean of |d|^2 (3-2q)/((1-q)^2 D^4) with q = |d|/D (`RadialSums.remainder`). The bound is
        infinite where a point of the part may be as far as D from the quadrature point.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Real]:
            """The bound of the displacement at points x, as a length in the unit of the meshes."""
            data = self._batch_data(backend)
            x = data.to_unit(x)
            error, gradient = backend.Float(0), backend.Array3f(0)
            for cloud, piece, height in zip(data.clouds, self._pieces, self.heights, strict=True):
                sums = cloud.sums(x, 1.0, 1)
                ratio = piece.farthest / height
                remainder = dr.inf
                if ratio < 1:
                    remainder = sums.remainder(ratio, piece.farthest / self._size, 1.0)
                error = dr.fma(piece.second_moment_ratio / self._size**2, remainder, error)
                error = dr.fma(
                    2 * math.sqrt(3) * piece.first_moment_ratio / self._size, sums.q2_d3, error
                )
                gradient = gradient + sums.sums.gradient
            return (error / dr.norm(gradient) * data.size,)

        return evaluate_points(points, kernel, precision)[0]

    def _upload(self, backend: Backend, *, traced: bool) -> _SliceBuffers:
        """The quadrature points on a backend. They are the same for tracing and for values at
        points."""
        del traced
        clouds = tuple(
            RadialTreecode(
                backend, dipoles, SlicedKernel(backend, height / self._size), self.accuracy
            )
            for dipoles, height in zip(self._dipoles, self.heights, strict=True)
        )
        return _SliceBuffers(*frame_parameters(backend, self._center, self._size), clouds)

    def _sample(self, on: _SliceBuffers, p: Vec3, detail: Real) -> Sample:
        """The sample at p, from the data `on` of a backend, at the accuracy scale `detail`."""
        return on.sample(p, detail)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level whose surface would be unbounded."""
        for level in levels:
            if abs(level) < _SMALLEST_LEVEL:
                raise ValueError("level 0 of a morph reaches to infinity; the surface is at 0.5")

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """A volume that contains the level sets: a box without those of its cells that are proved
        empty (`tight_extent`). At a distance rho from all points |f| is at most the sum of
        their weights over rho^2, which gives the box."""
        if levels not in self._extents:
            weight = sum(float(dipoles.rows[:, 6].sum()) for dipoles in self._dipoles)
            margin = 1.0001 * self._size * math.sqrt(weight / min(abs(level) for level in levels))
            low, high = self._box
            self._extents[levels] = tight_extent(
                self, levels, low - margin, high + margin, _MOST_CELLS
            )
        return self._extents[levels]

    def occupied_cells(self, levels: tuple[float, ...]) -> OccupancyGrid:
        """Cells over the extent, without those that are proved to contain no level; computed
        once."""
        if levels not in self._occupied:
            self._occupied[levels] = occupied_cells(
                self, levels, self.extent(levels), _CELLS_ACROSS
            )
        return self._occupied[levels]


@dataclass(frozen=True)
class _SliceBuffers(UnitFrame):
    """The quadrature points of both meshes on a backend. clouds: the sum over the points of each
    mesh, at its own height."""

    clouds: tuple[RadialTreecode, ...]

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> RadialSums:
        """The sums over the quadrature points of both meshes, at points x in unit coordinates.

        closer: the accuracy scale.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        """
        sums = RadialSums.zero(self.backend, derivatives)
        for cloud in self.clouds:
            sums = cloud.accumulate(sums, x, closer)
        return sums

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """The sample of f at points p, in the unit of the meshes. detail: the accuracy scale."""
        x = self.to_unit(p)
        radial = self.sums(x, detail, 1)
        sums = radial.sums
        slope_error = dr.fma(
            SLOPE_ROUNDINGS * coordinate_rounding(x), sums.s4, sums.gradient_truncation
        )
        nearest = sums.singularity_distance * (1 - SUM_MARGIN) - 8 * self.backend.machine_epsilon
        nearest = fmax(nearest, 0)
        r = BALL_FRACTION * nearest
        change = radial.variation(r, 1.0)
        ball = HarmonicBall(r * self.size, sums.value - change, sums.value + change, dimension=4)
        return Sample(
            sums.value,
            sums.gradient / self.size,
            radial.curvatures(lambda r: 1.0, nearest, self.size),
            sums.truncation + sums.rounding,
            slope_error / self.size,
            truncation_error=sums.truncation,
            alternative_promises=(ball,),
        )


def _check_count(counts: Sequence[Any], w: float, gap: float) -> None:
    """Raise ValueError if the quadrature would need more than `MOST_POINTS` points. counts: for
    each mesh the numbers of `piece_counts`."""
    count = sum(int((pieces.astype(float) ** 2).sum()) for pieces in counts)
    if count > MOST_POINTS:
        raise ValueError(
            f"w = {w:g} is so near to an end of the gap {gap:g} that {count:,} points would be "
            f"needed, more than {MOST_POINTS:,}: show the end itself (w = 0 or w = gap), or choose "
            "a larger spacing"
        )
