"""The field of a `Morph`, an interpolation of two shapes a and b, at a height strictly between its
two ends. Space is a slice of four dimensions: mesh a lies at a height w below it, and mesh b at a
height gap - w above it. The field f is the sum of the solid angles that the two solids subtend at a
point of the slice, in four dimensions and divided by 2 pi^2. Each solid angle is an integral over
the mesh, which is computed by a quadrature: a sum over dipoles at quadrature points, each of which
stands for a piece of a triangle or for several small triangles. D is the distance in four
dimensions from a point of the slice to a quadrature point.

- `MorphSlice`: the field.
- `SlicedKernel`: the potential of which its dipoles are derivatives, with the proof of its bounds.
- `quadrature_points`: triangle meshes as oriented points. Large triangles are cut, small triangles
  are merged.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.polynomial import chebyshev, legendre

from harnack.backend import backend_of
from harnack.cluster.serialization import TransientCache
from harnack.enclosures import HarmonicBall
from harnack.fields.batch_evaluation import evaluate_points
from harnack.fields.batched_fields import SourceSum, SumData, SumEvaluator, cached_upload
from harnack.fields.clearance import occupied_cells, tight_extent
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.field import Sample
from harnack.fmm.point_values import PointValues
from harnack.fmm.radial_kernel import (
    BALL_FRACTION,
    KernelValues,
    RadialKernel,
    RadialSums,
)
from harnack.fmm.radial_tree import ClusteredDipoles, RadialTreecode
from harnack.fmm.treecode import dipole_records
from harnack.fmm.unit_frame import UnitFrame, center_and_size, coordinate_rounding, frame_parameters

if TYPE_CHECKING:
    from collections.abc import Sequence

    from harnack.backend import Backend, FloatArray, IntArray, Precision, Real, Vec3
    from harnack.geometry import Volume
    from harnack.tree.empty_space import OccupancyGrid

GRADIENT_BOUND = 1.1855
"""Half the largest length of the gradient, in four dimensions, of the potential of a dipole of
moment 1 at the distance D, times D^3. It is Q_2 of `SlicedKernel`."""

# Degrees of the polynomial for the last i_n of `SlicedKernel`, by the number of bytes of a number.
# The function is singular at c = -1, so that the coefficients of degree k fall as 5.8^-k.
_DEGREES = {4: 12, 8: 22}


class SlicedKernel(RadialKernel):
    """The kernel (4/pi) K(r, w) on a backend: a radial potential in space, at the distance r from a
    point x to a source y that lies at a height w > 0 below space in four dimensions. It comes from
    the Newton kernel 1/|X|^2 of four dimensions. A dipole of moment m has the potential -m.grad_y
    of the kernel. D = sqrt(r^2 + w^2) is the distance in four dimensions, and the functions psi_k
    of a kernel are psi_0 = kernel and psi_(k+1) = -psi_k'/r (`radial_kernel`).

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

    Bound of derivatives in space. |d^m K[u_1, ..., u_m]| <= m!/D^(m+1) for the m-th derivative of
    the scaled K in the directions of unit vectors u_i, as for 1/r at the distance D.

    Proof. Equal vectors u are the worst (Banach 1938). The m-th derivative of 1/|X|^2 along a line
    is (-1)^m m! U_m(cos)/|X|^(m+2), with Chebyshev's polynomial U_m of the cosine of the angle
    between X and the line (Gegenbauer). Let z = y - x and a = u.z/D, |a| <= s. In the integral over
    v substitute t = D/sqrt(r^2 + v^2). Then the derivative of K is +-m!/D^(m+1) times (2/pi) I,
    with

        I = int_0^1 U_m(a t) t^m (1 - s^2 t^2)^(-1/2) dt.

    For s = 1, that is w = 0, I is (pi/2) P_m(a), at most pi/2: the bound is attained. For s < 1 the
    weight is the weight for s = 1 times a factor that falls from 1. So I is the integral for s = 1,
    but from 0 up to a number b <= 1 only (Bonnet's mean value theorem). As a function of b this is
    largest for b = 1, or where the integrand changes its sign, that is where U_m(a b) = 0 at an
    angle k pi/(m+1), k >= 1. Lobes of the integrand between such angles alternate in sign and grow
    with t, as t^m (1 - t^2)^(-1/2) does. So the integral is at most its last lobe, which is the
    largest if it ends at b = 1, where it is below 0.4 for m <= 7 (quadrature in
    `tests/fields/test_morph.py`).

    Bound of the gradient in four dimensions. The gradient of n.grad_x K, for a unit vector n, is at
    most 2 * 1.1855/D^3. Its square is cos^2 (K''^2 + (dw K')^2) + sin^2 (K'/r)^2, where cos and sin
    are those of the angle between n and z, K' is the derivative by r, and dw the derivative by w.
    So it is at most the larger of the two functions of c alone that cos^2 and sin^2 multiply, whose
    maximum is at w = r (the same tests).
    """

    def __init__(self, backend: Backend, height: float) -> None:
        """height: the height w of the slice above the sources, in the unit of the distances."""
        self.height = dr.opaque(backend.Float, height)
        self.height_square = dr.opaque(backend.Float, height * height)
        self._degree = _DEGREES[np.dtype(backend.dtype).itemsize]

    def at(self, distance: Real, inverse: Real, last: int) -> KernelValues:
        """Compute the functions psi_0, ..., psi_last at a distance D in four dimensions. psi_k is a
        constant times i_(k+1)/D^(2k+1). Here i_n is D^(2n-1) times the integral of
        dv/(r^2 + v^2)^n over v from w to infinity, a function of c = w/D. The integral with the
        largest n comes from a polynomial, and all others from the recurrence
        i_n = (2n s^2 i_(n+1) + c)/(2n-1), where s = r/D.

        distance: D; not used.
        inverse: 1/D.
        last: the largest index k of psi_k.
        """
        del distance
        # c = w/D, s2 = (r/D)^2; moment: i_(k+1), from k = last down; theta_k = psi_k D^(2k+1).
        # `inverse` in the result is the factor 1/D that all psi_k have in common, beside 1/D^(2k).
        c = self.height * inverse
        s2 = dr.fma(-c, c, 1)
        moment = _horner(dr.fma(2, c, -1), moment_polynomial(last + 1, self._degree))
        thetas = [_psi_factor(last) * moment]
        for k in range(last, 0, -1):
            moment = dr.fma(2 * k * s2, moment, c) * (1 / (2 * k - 1))
            thetas.insert(0, _psi_factor(k - 1) * moment)
        return KernelValues(inverse, thetas)

    def bounds(self, distance: Real, last: int) -> list[Real]:
        """List the numbers Q_2, ..., Q_last, but at least Q_2 and Q_3. They are defined by bounds:
        m! Q_m/D^(m+1) bounds the m-th derivatives of the kernel along lines at the distance D. Here
        they are the same for all distances. Q_2 bounds the gradient of a dipole's potential in four
        dimensions as well. last: the largest index m."""
        del distance
        return [GRADIENT_BOUND, *(1.0 for _ in range(3, last + 1))]

    def growth(self, r: Real) -> Real:
        """A factor that bounds how much larger the numbers Q_m of `bounds` are at a distance that
        is shorter by r: 1, as they are the same for all distances."""
        del r
        return 1.0

    def accepting_distance(self, radius: FloatArray, accuracy: float) -> FloatArray:
        """Compute the distances (k,) beyond which the moments of clusters of dipoles are used.

        radius: (k,) the radii of the clusters.
        accuracy: a cluster is used from this many times its radius on.
        """
        return accuracy * radius + 1e-5  # not 0 for a cluster of radius 0


@functools.cache
def moment_polynomial(n: int, degree: int) -> tuple[float, ...]:
    """Fit a polynomial to the integral i_n(c) of `SlicedKernel.at` for c in [0, 1].

    n: the index of the integral.
    degree: the degree of the polynomial, whose variable is 2c - 1.

    Returns its coefficients in ascending order.
    """
    # Gauss's rule on [0, 1].
    t, weight = legendre.leggauss(48)
    t, weight = 0.5 * (t + 1), 0.5 * weight

    def moment(x: FloatArray) -> FloatArray:
        """Compute the values of i_n at x = 2c - 1. x: (k,) numbers in [-1, 1].

        With c = cos phi, i_n is phi/sin phi times the integral over t in [0, 1] of
        (sin(phi t)/sin phi)^(2n-2). `t` and `weight` are the nodes and weights of Gauss's rule.
        """
        phi = np.arccos(0.5 * (x + 1))[:, None]
        ratio = np.sin(phi * t) / np.sin(phi)
        return phi[:, 0] / np.sin(phi[:, 0]) * (ratio ** (2 * n - 2) @ weight)

    # The nodes lie inside of (-1, 1), so that phi is not 0.
    nodes = chebyshev.chebpts1(2 * degree)
    series = chebyshev.chebfit(nodes, moment(nodes), degree)
    return tuple(float(coefficient) for coefficient in chebyshev.cheb2poly(series))


def _horner(x: Real, coefficients: tuple[float, ...]) -> Real:
    """Evaluate at x the polynomial with these coefficients, which begin with that of x^0."""
    total: Real = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = dr.fma(total, x, coefficient)
    return total


def _psi_factor(k: int) -> float:
    """Compute the factor (2/pi) 2^k k! in the formula of `SlicedKernel` for the function psi_k."""
    return 2 / math.pi * 2.0**k * math.factorial(k)


# Triangles are merged if their longest edge is at most this fraction of the longest edge that
# pieces of triangles may have. The cells of space in which they are merged are as wide.
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
    """Compute into how many pieces (m,) the edges of each triangle must be cut.

    corners: (m, 3, 3) of the triangles. All three edges of a triangle get the same number.
    longest: the largest length of a piece of an edge.
    """
    return np.maximum(np.ceil(_longest_edges(corners) / longest), 1).astype(np.int64)


def quadrature_points(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Make quadrature points for triangles with these corners (m, 3, 3).

    longest: the largest length of the edges of pieces. A larger triangle is cut into similar
        pieces, each with a point at its centroid. Much smaller triangles that lie in the same cell
        of space and face the same way are merged: they get a single point.
    """
    # A kind of triangles that does not occur has no part.
    # The ratios bound, for each point, moments of its group relative to |m|: the largest count.
    is_small = _longest_edges(corners) <= _CELL_FRACTION * longest
    parts = [
        make_points(triangles, longest)
        for make_points, triangles in (
            (_subdivide, corners[~is_small]),
            (_merge_small, corners[is_small]),
        )
        if len(triangles)
    ]
    return QuadraturePoints(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.moments for part in parts]),
        max(part.farthest for part in parts),
        max(part.second_moment_ratio for part in parts),
        max(part.first_moment_ratio for part in parts),
    )


def _longest_edges(corners: FloatArray) -> FloatArray:
    """Compute the length (m,) of the longest edge of each triangle. corners: (m, 3, 3)."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)


def _corner_distances(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Compute, for each of m triangles, the distance (m,) of its farthest corner from a given
    point. corners: (m, 3, 3). points: (m, 3) one for each triangle."""
    return np.linalg.norm(corners - points[:, None], axis=2).max(axis=1)


def _areas(corners: FloatArray) -> FloatArray:
    """Compute area times normal (m, 3) of triangles (m, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.cross(b - a, c - a)


def _mean_squares(corners: FloatArray) -> FloatArray:
    """Compute the mean (m,), over all points of each triangle (m, 3, 3), of the squared distance
    from the triangle's centroid: a 36th of the sum of its squared edge lengths."""
    return ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2)) / 36


def _subdivide(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Make quadrature points for triangles with these corners (m, 3, 3), which are not merged: the
    centroids of their pieces. A triangle is cut into count^2 similar pieces, where count is its
    number from `piece_counts`.

    longest: the largest length of the edges of pieces.

    `first_moment_ratio` is 0, as each piece is a group of one triangle about its centroid.
    """
    counts = piece_counts(corners, longest)
    points: list[FloatArray] = []
    moments: list[FloatArray] = []
    for count in np.unique(counts):
        triangles = corners[counts == count]
        a, b, c = np.moveaxis(triangles, 1, 0)
        # The centroids as a + u (b - a) + v (c - a). There are two kinds of pieces: those with the
        # orientation of the triangle, and those between them, rotated by half a turn.
        i, j = np.indices((count, count)).reshape(2, -1)
        steps = [(i + j < count, 1 / 3), (i + j < count - 1, 2 / 3)]
        u, v = (
            np.concatenate([index[mask] + shift for mask, shift in steps]) / count
            for index in (i, j)
        )
        middle = a[:, None] + u[:, None] * (b - a)[:, None] + v[:, None] * (c - a)[:, None]
        points.append(middle.reshape(-1, 3))
        moments.append(np.repeat(_areas(triangles) / count**2, count**2, axis=0))
    # A piece is 1/count times as large as its triangle, in all lengths. The integral of |d|^2 over
    # |m| is the mean of |d|^2 over the piece, as |m| is its area.
    second_ratio = float((_mean_squares(corners) / counts**2).max())
    farthest = float((_corner_distances(corners, corners.mean(axis=1)) / counts).max())
    return QuadraturePoints(
        np.concatenate(points), np.concatenate(moments), farthest, second_ratio, 0.0
    )


def _merge_small(corners: FloatArray, longest: float) -> QuadraturePoints:
    """Make quadrature points for small triangles with these corners (m, 3, 3). Triangles form a
    group, which has a single point, if their centroids are in the same cell of space and their
    normals have the same largest component with the same sign. So the length of the group's moment
    is at least 1/sqrt(3) of its area.

    longest: the largest length of the edges of pieces. Cells are `_CELL_FRACTION` times as wide.
    """
    # Two groups have different keys: the cell of space, the axis of the largest component of the
    # normals, and its sign.
    moments, centroids = _areas(corners), corners.mean(axis=1)
    axis = np.abs(moments).argmax(axis=1)
    is_positive = np.take_along_axis(moments, axis[:, None], axis=1)[:, 0] > 0
    cells = np.floor(centroids / (_CELL_FRACTION * longest)).astype(np.int64)
    keys = np.column_stack([cells, 2 * axis + is_positive])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    # group: the index of each triangle's group. Its point is the centroid of the group.
    group = group.ravel()
    area = np.linalg.norm(moments, axis=1)
    points = _sums(group, area[:, None] * centroids) / _sums(group, area[:, None])
    offset = centroids - points[group]
    group_moments = _sums(group, moments)
    moment_lengths = np.linalg.norm(group_moments, axis=1)
    # square_integrals: of |d|^2 over each triangle; first_moment_lengths: |T|_F of each group.
    square_integrals = area * (_mean_squares(corners) + (offset * offset).sum(axis=1))
    outer = np.einsum("ki,kj->kij", moments, offset).reshape(-1, 9)
    first_moment_lengths = np.linalg.norm(_sums(group, outer), axis=1)
    second_ratio = float((_sums(group, square_integrals[:, None])[:, 0] / moment_lengths).max())
    farthest = float(_corner_distances(corners, points[group]).max())
    return QuadraturePoints(
        points,
        group_moments,
        farthest,
        second_ratio,
        float((first_moment_lengths / moment_lengths).max()),
    )


def _sums(group: IntArray, values: FloatArray) -> FloatArray:
    """Add up the rows of `values` (m, k) that belong to the same group. group: (m,) the index of
    each row's group. Returns (number of groups, k)."""
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


class MorphSlice(SourceSum):
    """A shape between two closed meshes a and b, as the level set f = 1/2 of the field
    f(x) = (U_a(x, w) + U_b(x, gap - w))/(2 pi^2) with 0 < w < gap. For small w the shape is near
    mesh a, for w near gap it is near mesh b.

    U_a(x, w) is the solid angle that the flat solid inside mesh a subtends in four dimensions, seen
    from the point x at the height w above it (see `Morph`). It is computed as a sum over dipoles at
    quadrature points that stand for the triangles. In unit coordinates the meshes are centered at 0
    and their size is about one.

    corners: the triangles of both meshes, as two arrays (m, 3, 3).
    w, gap: the height of the slice above mesh a, and the height of mesh b above mesh a.
    spacing: the largest length of the edges of pieces of triangles, in units of the height of the
        slice above (or below) their mesh.
    accuracy: the multipole moments of a cluster of quadrature points are used beyond this many
        times its radius.

    Proved bounds of f near a point x. Let d be the smallest distance, in four dimensions, of a
    quadrature point from x. There are two kinds: bounds of the second derivatives within 0.1 d,
    0.25 d and 0.45 d (`TaylorRemainder`), and a range of f on a ball in four dimensions of radius
    0.35 d (`HarmonicBall`). The march uses the bounds of the second derivatives, which prove longer
    steps; the range is for callers that request it. `SlicedKernel` has the proof: at the distance D
    in four dimensions, the second derivatives of a dipole's part of f are at most those of a dipole
    in space at the same distance.
    """

    default_level = 0.5
    traits = dataclasses.replace(SourceSum.traits, is_larger_inside=True)

    def __init__(
        self, corners: Sequence[FloatArray], *, w: float, gap: float, spacing: float,
        accuracy: float,
    ) -> None:  # fmt: skip
        super().__init__()
        self.heights = (w, gap - w)  # of the slice above mesh a, and below mesh b
        self.spacing, self.accuracy = spacing, accuracy
        # corners: (m, 3, 3) for each of the two meshes.
        low = np.min([mesh.min(axis=(0, 1)) for mesh in corners], axis=0)
        high = np.max([mesh.max(axis=(0, 1)) for mesh in corners], axis=0)
        self._box = low, high
        self._center, self._size = center_and_size(low, high)
        # The longest edges of pieces, for each mesh.
        longest = [spacing * height for height in self.heights]
        _check_count([piece_counts(*pair) for pair in zip(corners, longest, strict=True)], w, gap)
        self._pieces = tuple(
            quadrature_points(*pair) for pair in zip(corners, longest, strict=True)
        )
        self._dipoles = tuple(self._dipole_tree(points) for points in self._pieces)
        self._extents: TransientCache[tuple[float, ...], Volume] = TransientCache()
        self._occupied: TransientCache[tuple[float, ...], OccupancyGrid] = TransientCache()

    def _dipole_tree(self, pieces: QuadraturePoints) -> ClusteredDipoles:
        """Build the tree over the dipoles of one of the two meshes, one dipole for each quadrature
        point, in unit coordinates.

        pieces: the quadrature points of the mesh, in the user's coordinates.

        Moments are scaled so that, with the scaled kernel of `SlicedKernel`, they contain the
        factor 1/(2 pi^2) of f: f is the plain sum of the dipoles' potentials over both meshes.
        """
        # By `SlicedKernel`, moments of area times normal over 4 pi give U/pi^2, and f has half.
        scale = 1 / (8 * math.pi * self._size**2)
        points = (pieces.points - self._center) / self._size
        return ClusteredDipoles.of(dipole_records(points, scale * pieces.moments))

    @property
    def point_counts(self) -> tuple[int, ...]:
        """Two numbers: how many quadrature points mesh a has, and how many mesh b has."""
        return tuple(len(dipoles.rows) for dipoles in self._dipoles)

    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Compute f and its derivatives at points x (3, n), in the unit of the meshes, with error
        bounds (`BatchedField.values_at`).

        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        closer: the accuracy scale; larger is more accurate.
        """
        buffers = self._upload(backend_of(x))
        x = buffers.to_unit(x)
        values = buffers.sums(x, closer, derivatives).values(x)
        # The sum of the lengths of all moments. 64 terms: far away a point sums only a few
        # clusters.
        weight = sum(float(dipoles.rows[:, 6].sum()) for dipoles in self._dipoles)
        return values.with_far_field_errors(x, 64, weight).rescaled(buffers.size)

    def quadrature_displacement(
        self, points: Any, precision: Precision | None = None
    ) -> FloatArray:
        """Bound, to first order, how far the surface of this field is from the surface that exact
        integration over the triangles would give. The bound is the error of the quadrature divided
        by the length of the gradient.

        points: (n, 3) points of the surface.
        precision: of the computation, "single" or "double"; None for that of the points.

        Returns (n,) lengths in the unit of the meshes. They are infinite if a triangle of a mesh
        reaches as far from its quadrature point as the slice is from that mesh.

        Proof. Let a quadrature point at distance D stand for a group of triangles with the total
        moment m (area times normal), made of triangles with moments m_i at offsets d_i from it. The
        dipole at the quadrature point replaces the sum of the group's dipoles. By Taylor's formula
        the error is at most 2 |T|_*/D^3 plus a remainder. Here T is the sum of the products
        m_i d_i^T, and |T|_* its nuclear norm, at most sqrt(3) times the Frobenius norm. The
        remainder is at most |m| times the mean of |d|^2 (3-2q)/((1-q)^2 D^4) with q = |d|/D
        (`RadialSums.remainder`).
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Real]:
            """Compute the bound at points x (3, n), as a length in the unit of the meshes, in a
            tuple of one entry."""
            data = self._upload(backend)
            x = data.to_unit(x)
            # error: the bound of the quadrature's error of f, over both meshes. The ratios of a
            # mesh bound |T| and the integral of |d|^2 of each group, divided by |m|.
            error, gradient = backend.Float(0), backend.Array3f(0)
            for cloud, piece, height in zip(data.clouds, self._pieces, self.heights, strict=True):
                # With accuracy scale 1 and gradients.
                sums = cloud.sums(x, 1.0, 1)
                # q is at most this ratio, as D is at least the height. The kernel does not grow
                # nearer to the dipoles: hence the factor 1.0. The remainder is the sum of
                # |m| (3-2q)/((1-q)^2 D^4); q2_d3 is at least the sum of |m|/D^3.
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

    def _ray_data(self, backend: Backend, plan: Plan) -> _SliceBuffers:
        del plan
        return self._upload(backend)

    @cached_upload
    def _upload(self, backend: Backend) -> _SliceBuffers:
        """Build the sums over the quadrature points of both meshes on a backend. They are the same
        for tracing and for values at points."""
        clouds = tuple(
            RadialTreecode(
                backend, dipoles, SlicedKernel(backend, height / self._size), self.accuracy
            )
            for dipoles, height in zip(self._dipoles, self.heights, strict=True)
        )
        return _SliceBuffers(*frame_parameters(backend, self._center, self._size), clouds)

    def validate_levels(self, levels: tuple[float, ...]) -> None:
        """Raise ValueError for a level whose surface would be unbounded."""
        for level in levels:
            if abs(level) < _SMALLEST_LEVEL:
                raise ValueError("level 0 of a morph reaches to infinity; the surface is at 0.5")

    def extent(self, levels: tuple[float, ...]) -> Volume:
        """Compute a volume that contains the level sets of f at these levels, once: a box without
        cells that are proved to contain no point of them (`tight_extent`). The box holds since at a
        distance of at least rho from all quadrature points |f| is at most the sum of the lengths of
        all moments, over rho^2."""
        if levels not in self._extents:
            # weight: the sum of the lengths of all moments.
            weight = sum(float(dipoles.rows[:, 6].sum()) for dipoles in self._dipoles)
            margin = 1.0001 * self._size * math.sqrt(weight / min(abs(level) for level in levels))
            low, high = self._box
            self._extents[levels] = tight_extent(
                self, levels, low - margin, high + margin, _MOST_CELLS
            )
        return self._extents[levels]

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> SumEvaluator:
        return _MorphSliceEvaluator(self, self._ray_data(backend, plan), plan.levels)

    def occupied_cells_of(self, levels: tuple[float, ...]) -> OccupancyGrid:
        """Compute, once, the cells of a grid over the extent that may contain a point of a level
        set. The other cells are proved to contain none; rays skip them."""
        return self._occupied.get_or_make(
            levels, lambda: occupied_cells(self, levels, self.extent(levels), _CELLS_ACROSS)
        )


class _MorphSliceEvaluator(SumEvaluator):
    """The evaluator of a `MorphSlice`."""

    def __init__(self, field: MorphSlice, data: SumData, levels: tuple[float, ...]) -> None:
        """levels: the levels whose level sets are traced; () for none."""
        super().__init__(field, data)
        self._slice, self._levels = field, levels

    def occupied_cells(self) -> OccupancyGrid | None:
        return self._slice.occupied_cells_of(self._levels) if self._levels else None


@dataclass(frozen=True)
class _SliceBuffers(UnitFrame):
    """The data of a `MorphSlice` on a backend, with the map from the user's coordinates to unit
    coordinates (centered at 0, of size about one).

    clouds: for each of the two meshes, the sum over the dipoles at its quadrature points, with the
        kernel at its own height.
    """

    clouds: tuple[RadialTreecode, ...]

    @property
    def coarsest_accuracy(self) -> float:
        """The accuracy scale of the coarsest samples."""
        return 1.0

    def sums(self, x: Vec3, closer: Real, derivatives: int) -> RadialSums:
        """Sum over the quadrature points of both meshes, at points x (3, n) in unit coordinates.

        closer: the accuracy scale; larger is more accurate.
        derivatives: 0 for the value only, 1 with the gradient, 2 with the Hessian.
        """
        sums = RadialSums.zero(self.backend, derivatives)
        # A cloud is the sum over the quadrature points of one mesh.
        for cloud in self.clouds:
            sums = cloud.accumulate(sums, x, closer)
        return sums

    def sample(self, p: Vec3, detail: Real) -> Sample:
        """Compute a sample at points p (3, n): f, its gradient, error bounds, and proved bounds of
        f near p, in the unit of the meshes.

        detail: the accuracy scale; larger is more accurate.
        """
        x = self.to_unit(p)
        radial = self.sums(x, detail, 1)  # 1: with gradients
        sums = radial.sums
        slope_error = sums.gradient_error(coordinate_rounding(x))
        # A lower bound of the distance, in four dimensions, to the nearest quadrature point; and
        # the range of f on the ball around x of radius r, a ball in four dimensions, in which f is
        # harmonic.
        nearest = radial.least_distance
        r = BALL_FRACTION * nearest
        # 1.0: the bounds of this kernel do not grow if distances shrink (`SlicedKernel.growth`).
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
    """Raise ValueError if the quadrature would need more than `MOST_POINTS` points.

    counts: for each mesh the result of `piece_counts`, an array with an entry for each triangle. A
        triangle needs the square of its entry.
    w, gap: the height of the slice and of mesh b, for the message.
    """
    count = sum(int((pieces.astype(float) ** 2).sum()) for pieces in counts)
    if count > MOST_POINTS:
        raise ValueError(
            f"w = {w:g} is so near to an end of the gap {gap:g} that {count:,} points would be "
            f"needed, more than {MOST_POINTS:,}: show the end itself (w = 0 or w = gap), or choose "
            "a larger spacing"
        )
