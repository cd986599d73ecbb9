"""Harmonic polynomials that approximate, in a ball, the solid angle of directed edges far from the
ball, with bounds of their truncation errors. The edges form cycles: they enter each vertex as often
as they leave it, so that they have a solid angle Omega, known modulo 4 pi. The ball has the center
c and the radius rho, and is the ball around a cell of an octree. A polynomial has the degree
p = `DEGREE`; its truncation error is the sum of all terms of higher degree.

For an edge from c + a to c + a + e, the Biot and Savart field at c + u is

    h(u) = (a - u) x e W(u),    W(u) = integral over [0, 1] of dt/|a + te - u|^3,

and grad Omega is the sum of these over the cycle. So Omega(c + u) - Omega(c) is the sum over the
edges of

    g(u) = integral over [0, 1] of u . h(su) ds = u . (a x e) integral over [0, 1] of W(su) ds.

Each g is harmonic in the ball by itself: u . h(u) = e . (u x grad) phi(u), with phi(u) the integral
of dt/|a + te - u| over [0, 1]. The operator u x grad maps harmonic functions to harmonic functions,
degree by degree, and the integral over s divides the part of degree l by l. Edges are cut into
short pieces. On each piece the integral over t is computed by Gauss's rule, with a few nodes.

- `EdgeExpansions.of`: the sum over the edges of cycles, for many balls at once.
- `tail_bounds`: the bound of the terms of higher degree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, to_numpy
from harnack.backend.arrays import upload_integers
from harnack.backend.elementary import fmin
from harnack.fmm.edges import inner_product, spinor
from harnack.fmm.local_expansion import coefficient_keys, irregular_harmonics

if TYPE_CHECKING:
    from harnack.backend import BoolArray, Mask, Real, Vec3
    from harnack.backend.record_table import RecordTable
    from harnack.fmm.edge_runs import CellEdges


DEGREE = 6
COEFFICIENTS = (DEGREE + 1) ** 2
# Edges are cut into pieces with half lengths of at most `_MAX_PIECE` times the distance of their
# middle from the ball (the last piece of an edge may be 1.3 times as long); on each piece, Gauss's
# rule has `_NODES` nodes.
_MAX_PIECE, _NODES = 1 / 6, 4
# Rounding of an edge's term of the angle at the center, and of its polynomial: see
# `EdgeExpansions.of` and `_EdgePiece.sums`.
_ANGLE_ROUNDING, _TERM_ROUNDING = 2.0**-36, 2.0**-28
# Factor by which sums of many positive numbers in double precision become bounds.
_ROUNDED_UP = 1 + 1e-9


@dataclass(frozen=True)
class EdgeExpansions:
    """The solid angles of far edges in n balls around cells of an octree. For each ball, its far
    edges form cycles, whose solid angle is approximated in the ball by a harmonic polynomial (the
    local expansion) with error bounds.

    coefficients: (n, COEFFICIENTS) of the polynomials (`local_expansion.coefficient_keys`). The
        value at the center is known modulo 4 pi.
    error, slope: (n,) bounds of the errors of value and gradient, anywhere in the ball: truncation,
        quadrature and rounding.
    """

    coefficients: FloatArray
    error: FloatArray
    slope: FloatArray

    @classmethod
    def zero(cls, n: int) -> EdgeExpansions:
        """Make the expansions of n balls that have no far edges: zeros."""
        return cls(np.zeros((n, COEFFICIENTS)), np.zeros(n), np.zeros(n))

    def plus(self, other: EdgeExpansions) -> EdgeExpansions:
        """Add the expansions of other edges, for the same balls."""
        error, slope = self.error + other.error, self.slope + other.slope
        total = self.coefficients + other.coefficients
        return EdgeExpansions(total, error * _ROUNDED_UP, slope * _ROUNDED_UP)

    def subset(self, rows: Any) -> EdgeExpansions:
        """Select the expansions of some balls. rows: a mask (n,), or an array of indices."""
        return EdgeExpansions(*(values[rows] for values in vars(self).values()))

    def to_octants(self, is_split: BoolArray, shifts: FloatArray, radius: float) -> EdgeExpansions:
        """Move the expansions of the cells that are split to the centers of their eight octants.
        The octants of a cell follow each other. Their balls lie in the ball of the cell, so that
        bounds of errors hold there as well.

        is_split: (n,) the mask of the cells that are split.
        shifts: (8, COEFFICIENTS, COEFFICIENTS) matrices from
            `local_expansion.local_to_local_matrices`.
        radius: the radius of the cells' balls.

        Rounding. In double precision, a sum of 49 products is off by less than 2^-46 of the sum of
        their absolute values. The value is the sum of these coefficients times harmonics R_jk,
        which are at most 1 in the ball and count twice at most. The gradient of a polynomial of
        degree p is at most p over the octant's radius times its largest value.
        """
        coefficients, matrix = self.coefficients[is_split], shifts.reshape(-1, COEFFICIENTS)
        shifted = (coefficients @ matrix.T).reshape(-1, COEFFICIENTS)
        # For each octant and each coefficient of the cell, by how much the coefficients of the
        # octant can be larger. 2^-44 is 2^-46, times 2 as harmonics count twice, and twice that.
        column_sums = np.abs(shifts).sum(axis=1)
        rounding = 2.0**-44 * (np.abs(coefficients) @ column_sums.T).ravel()
        error, slope = (np.repeat(bound[is_split], 8) for bound in (self.error, self.slope))
        return EdgeExpansions(shifted, error + rounding, slope + 2 * DEGREE / radius * rounding)

    @classmethod
    def of(
        cls, points: RecordTable, edges: CellEdges, c: Vec3, radius: Real, n: int
    ) -> EdgeExpansions:
        """Expand the solid angles of the far edges of n cells, in the balls of the cells.

        points: records (x, y, z, ...) of the points to which the edges refer.
        edges: the far edges of all cells, sorted by cell. Those of each cell form cycles.
        c: (3, n) the centers of the balls.
        radius: the radius of the balls.
        n: the number of cells.

        Rounding. The value of an expansion at its ball's center is the solid angle there. Each
        edge's part of this angle has two errors (as in `LoopEdges.rounding`). The arithmetic makes
        one of less than 2^-46. The other comes from the ends: their coordinates are below 2^3 and
        have a relative error of 2^-50, so that the angle changes by less than 2^-46/D, where D is
        the distance of the edge from the center. D is more than 2^-9, the radius of the smallest
        cells, so that this is less than 2^-37. So `_ANGLE_ROUNDING`, counted once for each edge,
        bounds the sum of both errors.
        """
        if not len(edges.cell):
            return cls.zero(n)
        backend = points.backend
        count = np.bincount(edges.cell, minlength=n)
        first_edge = upload_integers(backend, np.cumsum(count) - count)
        edge_count = upload_integers(backend, count)
        start, end = (upload_integers(backend, values) for values in (edges.start, edges.end))
        sums = _over_pieces(points, start, end, first_edge, edge_count, c, radius)
        dr.eval(*sums)
        zr, zi, error, slope, *coefficients = (
            np.broadcast_to(to_numpy(values), n) for values in sums
        )
        # The constant is the solid angle at the center: twice the argument of a product.
        table = np.stack([2 * np.arctan2(zi, zr), *coefficients], axis=1)
        return cls(table, error * _ROUNDED_UP + _ANGLE_ROUNDING * count, slope * _ROUNDED_UP)


def _over_pieces(
    points: RecordTable, start: Any, end: Any, first: Any, count: Any, c: Vec3, radius: Real
) -> tuple[Any, ...]:
    """Sum over the far edges of balls, one ball per lane. Edges are cut into short pieces.

    points: records (x, y, z, ...) of the ends of edges.
    start, end: (k,) for each edge, the rows of its ends in `points`.
    first, count: (n,) for each ball, the index of its first edge, and the number of its edges.
    c: (3, n) the centers of the balls.
    radius: the radius of the balls.

    Returns real and imaginary part of the product of the edges' factors, whose argument is half the
    solid angle at the center (`edges.sum_over_edges`); bounds of the truncation errors of value and
    gradient; and all coefficients after the first.
    """
    backend = points.backend
    index, real, vector = backend.UInt32, backend.Float, backend.Array3f

    def runs(j: Any, *_: Any) -> Mask:
        """Whether the loop goes on, on each lane: its ball has a far edge number j."""
        return j < count

    def body(j: Any, t: Real, zr: Real, zi: Real, *sums: Real) -> tuple[Any, ...]:
        """Add the piece of the ball's far edge j that begins at the parameter t in [0, 1). With its
        first piece, multiply the product (zr, zi) by the edge's factor. The ball has the center c.
        Its edges are number `first` to `first` + `count` - 1 in the lists `start` and `end`, which
        hold the rows of their ends in `points`.

        sums: bounds of the errors, and the coefficients after the first.

        Returns the arguments for the next piece, which may be the first piece of the next edge.
        """
        active = j < count
        point_ids = (dr.gather(index, values, first + j, active) for values in (start, end))
        rows = (points.read_record(point_id, active) for point_id in point_ids)
        a, b = (vector(*row[:3]) - c for row in rows)
        piece = _EdgePiece.of(a, b, t, radius)
        # The result of `spinor` ends with the spinor.
        re, im = inner_product(spinor(a)[2], spinor(b)[2])
        re, im = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
        # The product is scaled, as only its argument matters. A factor that makes it 0
        # is left out.
        scale = dr.rcp(dr.abs(re) + dr.abs(im))
        is_valid = active & (t == 0) & dr.isfinite(scale)
        zr, zi = dr.select(is_valid, re * scale, zr), dr.select(is_valid, im * scale, zi)
        added = [dr.select(active, values, 0) for values in piece.sums(radius)]
        new = [old + values for old, values in zip(sums, added, strict=True)]
        is_last = piece.stop >= 1
        j = j + dr.select(is_last, index(1), index(0))
        return j, dr.select(is_last, 0, piece.stop), zr, zi, *new

    zero = real(0)
    # Two bounds, and all coefficients but the first.
    state = (index(0), zero, real(1), zero, *([zero] * (COEFFICIENTS + 1)))
    return dr.while_loop(state, runs, body, label="far edges")[2:]  # without j and t


@dataclass(frozen=True)
class _EdgePiece:
    """A straight piece of an edge far from a ball. It is so short that Gauss's rule, with a few
    nodes, integrates along it with a small error.

    middle: the midpoint of the piece, relative to the center of the ball.
    e: the vector from its start to its end.
    stop: the parameter on the edge, from 0 to 1, at which the piece ends.
    """

    middle: Vec3
    e: Vec3
    stop: Real

    @classmethod
    def of(cls, a: Vec3, b: Vec3, t: Real, radius: Real) -> _EdgePiece:
        """Cut a piece from the edge from a to b, beginning at the parameter t.

        a, b: the ends of the edge, relative to the center of a ball.
        t: the parameter on the edge, 0 at a and 1 at b.
        radius: the radius of the ball.

        Half the length of the piece is at most `_MAX_PIECE` times the distance of its middle from
        the ball. But a remainder of the edge that would be shorter than 0.3 times the piece is
        joined to it: then the piece is up to 1.3 times as long. If the piece begins in the ball, it
        is the whole remainder of the edge. The error bounds (`_quadrature_errors`) hold for pieces
        of any length, and are infinite for a piece that is too long for them.
        """
        # With m = `_MAX_PIECE`, and the start at the distance g from the ball: the middle is at
        # least g - l/2 away if the piece has the length l. So l/2 <= m (g - l/2) suffices, which is
        # l <= 2 m/(1 + m) g.
        vector, e = cast("Any", type(a)), b - a
        start = dr.fma(vector(t), e, a)
        max_length = (2 * _MAX_PIECE / (1 + _MAX_PIECE)) * (dr.norm(start) - radius)
        step = max_length * dr.rsqrt(dr.squared_norm(e))
        stop = dr.select(step > 0, fmin(t + step, type(t)(1)), 1)
        # No short remainder is left for another piece.
        stop = dr.select(1 - stop < 0.3 * (stop - t), 1, stop)
        # The middle of the piece, the vector along it, and the parameter of its end.
        return cls(dr.fma(vector(0.5 * (t + stop)), e, a), (stop - t) * e, stop)

    def sums(self, radius: Real) -> list[Real]:
        """Compute what the piece adds to the polynomial in the ball.

        radius: the radius of the ball.

        Returns a list: bounds of the errors of value and gradient (quadrature, truncation and
        rounding), followed by all coefficients after the first.

        Rounding. Each product of a coefficient with a harmonic of the ball passes through fewer
        than 2^9 roundings of 2^-53 each. The sum of the absolute values of these products is below
        2^14 |e|/D (tests compute it), with D the distance of a node of Gauss's rule from the
        center. So the value, and the gradient times the radius, are off by at most 2^-29 |e|/D.
        """
        # self.e: the vector from the start to the end of the piece. self.middle: its middle,
        # relative to the center of the ball.
        half = 0.5 * dr.norm(self.e)
        area = dr.norm(dr.cross(self.middle, self.e))
        error, slope = _quadrature_errors(dr.norm(self.middle) - radius, half, area, radius)
        # The rule is for [-1, 1]: half of each weight makes means. |d x e| is `area` for all d on
        # the piece.
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        total: dict[Any, list[Any]] = {}
        for node, weight in zip(nodes.tolist(), (0.5 * weights).tolist(), strict=True):
            d = dr.fma(type(self.e)(0.5 * node), self.e, self.middle)
            inverse = dr.rcp(dr.norm(d))
            value_tail, slope_tail = tail_bounds(radius * inverse)
            strength = weight * area * dr.square(inverse)
            rounding = _TERM_ROUNDING * weight * 2 * half * inverse
            # total: the coefficients of phi, the mean of 1/distance over the piece (see the
            # module), from the irregular harmonics at the node.
            error = error + rounding + strength * value_tail
            slope = slope + (rounding + strength * slope_tail) / radius
            for key, pair in irregular_harmonics(d.x, d.y, d.z, inverse, DEGREE).items():
                old = total.get(key, [0.0, 0.0])
                total[key] = [part + weight * new for part, new in zip(old, pair, strict=True)]
        return [error, slope, *_rotated_coefficients(total, self.e, radius)]


def tail_bounds(q: Any) -> tuple[Any, Any]:
    """Bound the truncation errors of an infinitesimal edge dp at the vector d from the center of a
    ball of radius rho.

    q: rho/|d|.

    Returns two numbers. The solid angle at c + u minus that at the center c is the sum of a
    function g(u) of each edge. Let S be the sum of all terms of degree above p = DEGREE of the
    edge's g. Anywhere in the ball |S| is at most the first number times |d x
    dp|/|d|^2, and rho |grad S| is at most the second number times |d x dp|/|d|^2.

    Proof. For a point u of the ball, phi = sum over j of |u|^j P_j(s)/|d|^(j+1), with s the cosine
    of the angle between u and d and Legendre's polynomials P_j. So u x grad phi = sum of
    |u|^j P_j'(s)/|d|^(j+1) (u x d)/(|u||d|), and the term of degree j of g is at most
    |d x dp|/|d|^2 (|u|/|d|)^j sqrt(1-s^2)|P_j'(s)|/j.

    By the addition theorem the squares of the orthonormal harmonics of degree j add up to
    (2j+1)/(4 pi); the squares of the two of order 1 or -1 alone add up to
    2 (2j+1)/(4 pi) (1-s^2) P_j'^2/(j (j+1)). So sqrt(1-s^2)|P_j'|/j <= sqrt((j+1)/(2j)), which
    falls with j, and its value at j = p+1 (`factor` in the code) bounds all terms.

    The sum over j > p of q^j is q^(p+1)/(1-q), and that of j q^j is
    q^(p+1) (p+1 - p q)/(1-q)^2. By Bernstein and Szego's inequality a harmonic polynomial of degree
    j has a gradient of at most j/rho times its largest value on the sphere.
    """
    power = q
    for _ in range(DEGREE):
        power = power * q
    factor = math.sqrt((DEGREE + 2) / (2 * (DEGREE + 1)))
    # Nothing is proved if the edge is in the ball.
    geometric = 1 / (1 - q)
    geometric = dr.select(q < 1, geometric, dr.inf)
    value = factor * power * geometric
    return value, value * geometric * (DEGREE + 1 - DEGREE * q)


def _quadrature_errors(distance: Real, half: Real, area: Real, radius: Real) -> tuple[Real, Real]:
    """Bound the errors that Gauss's rule on a piece of an edge causes in the value g and in its
    gradient, anywhere in the ball. The bounds are infinite if the piece is too long or too near.

    distance: D, the distance of the middle of the piece from the ball.
    half: h, half the length of the piece.
    area: |a x e|, with a the start of the piece and e the vector from its start to its end.
    radius: the radius of the ball.

    Proof. Let b be the vector from the point su (s in [0, 1]) to the middle of the piece, and v the
    unit vector along the piece. W is the mean of |b + zv|^-3 over real z in [-h, h].

    1. Size for complex z. (b + zv)^2 has two roots of modulus |b| >= D, so that
       |(b + zv)^2| >= (D - |z|)^2. On the ellipse with foci -h and h and half axes that add up to
       hr, |z| <= h (r + 1/r)/2 =: S. With r so that S = 8/11 D, the integrand is at most
       M = (11/(3D))^3.
    2. Error of the rule. The Chebyshev coefficients of the integrand are at most 2 M r^-k. The rule
       with n nodes is exact up to degree 2n - 1. Of the terms of higher degree, the odd ones
       vanish; for even k >= 8 the mean of T_k over [-1, 1] is at most 1/63, and the rule gives at
       most 1. In all the mean W is off by at most 2.04 M r^-2n/(1 - r^-2).
    3. Value. g is at most |u||a x e| times a mean of W over s, with |u| <= radius.
    4. Gradient. It is a x e times the same mean, plus u . (a x e) times a mean over s of s times
       the gradient of W. This gradient is 3 times the mean of (b + zv)/|b + zv|^5, which on the
       ellipse is at most 3 (D+S)/(D-S)^5. That falls with D, and the mean of s is 1/2.

    Returns the bounds for the value and for the gradient.
    """
    # x = S/h, and r = x + sqrt(x^2 - 1). power: r^-8 for the n = 4 nodes. inverse_gap: 1/(D - S).
    x = (8 / 11) * distance / half
    r = x + dr.sqrt(dr.square(x) - 1)
    inverse = dr.square(dr.rcp(r))
    power = dr.square(dr.square(inverse))
    inverse_gap = dr.rcp((3 / 11) * distance)
    cube = inverse_gap * dr.square(inverse_gap)
    mean_error = area * 2.04 * power / (1 - inverse) * cube
    # The bound of step 4 over that of the value: 3/2 (D + S)/(D - S)^2.
    slope_factor = 1.5 * (19 / 11) * distance * dr.square(inverse_gap)
    is_valid = (distance > 0) & (x > 1)
    error = dr.select(is_valid, mean_error * radius, dr.select(half > 0, dr.inf, 0))
    return error, dr.select(is_valid, mean_error * (1 + radius * slope_factor), error)


def _rotated_coefficients(phi: dict[Any, list[Any]], e: Vec3, radius: Real) -> list[Real]:
    """Compute the coefficients of a piece's solid angle g from those of its potential phi, the mean
    of 1/distance over its points. g(u) is the integral over s in [0, 1] of
    e . (u x grad) phi(su)/s.

    phi: the coefficients L_jk of phi, as pairs of real and imaginary part by (j, k).
    e: the vector from the start to the end of the edge.
    radius: the radius of the ball.

    Returns the real and imaginary parts of the coefficients L'_jk of g, except the first, times
    radius^j, in the order of `local_expansion.coefficient_keys`.

    Proof. The derivative of conj R_jk by the angle about the z axis is -ik conj R_jk. The
    derivatives by the angles about x and y follow from those of (d/dx +- i d/dy) in `multipole`,
    and lead to the orders k - 1 and k + 1:

        L'_jk = -ik e_z L_jk + (j+k)/2 (i e_x - e_y) L_j,k-1 + (j-k)/2 (i e_x + e_y) L_j,k+1,

    divided by j for the integral over s.
    """
    radius_powers: list[Any] = [1.0]
    for _ in range(DEGREE):
        radius_powers.append(radius_powers[-1] * radius)
    coefficients: list[Real] = []
    for j, k, part in coefficient_keys(DEGREE):
        if j == 0:
            continue
        # The three terms of the formula, one after another.
        re, im = phi[j, k]
        real, imag = k * e.z * im, -k * e.z * re
        down, up = 0.5 * (j + k), 0.5 * (j - k)
        if k >= 1:
            a, b = phi[j, k - 1]
        else:  # L_j,-1 = -conj L_j1
            a, b = -phi[j, 1][0], phi[j, 1][1]
        real, imag = (real + down * (-e.x * b - e.y * a), imag + down * (e.x * a - e.y * b))
        if k < j:
            a, b = phi[j, k + 1]
            real, imag = (real + up * (-e.x * b + e.y * a), imag + up * (e.x * a + e.y * b))
        coefficients.append(radius_powers[j] / j * (imag if part else real))
    return coefficients
