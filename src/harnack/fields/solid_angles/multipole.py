"""Multipole moments of dipoles, moments of the nodes of a tree, and bounds of truncated expansions.

The potential of dipoles a_i n_i at y_i = c + d_i at a point x = c + r is

    f(x) = sum_i a_i n_i.(y_i - x)/|y_i - x|^3 = -sum_i a_i n_i.grad_y 1/|x - y_i|
         = -sum_{l>=1} sum_m conj(M_lm) I_lm(r),      M_lm = sum_i a_i n_i.grad R_lm(d_i)

with solid harmonics R_lm = r^l P_lm(cos t) e^(im p)/(l+m)! and I_lm = (l-m)! P_lm e^(im p)/r^(l+1)
in spherical coordinates (r, t, p), with associated Legendre functions P_lm (no Condon-Shortley
phase; R_l,-m = (-1)^m conj R_lm). They satisfy 1/|x-y| = sum conj(R_lm(y)) I_lm(x),
R_lm(a+b) = sum R_l'm'(a) R_l-l',m-m'(b), d/dz R_lm = R_l-1,m, (d/dx + i d/dy) R_lm = -R_l-1,m+1,
and (d/dx - i d/dy) R_lm = R_l-1,m-1. Tests check all of these.

- `regular_harmonics`, `dipole_moments`, `multipole_to_multipole`: harmonics, moments of a dipole,
  and moments about another point.
- `NodeMoments`, from `dipole_tree_moments` or `triangle_tree_moments`: the moments of all nodes of
  a tree.
- `truncation_bounds`, `remainder_constants`: bounds of the terms beyond an order, and of the terms
  up to it.

Here a complex number is a pair of numbers or arrays of any kind, of NumPy or of Dr.Jit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_integers
from harnack.backend.elementary import fmax, fmin
from harnack.fields.source_sums import max_step_fraction, remainder_factor
from harnack.tree import NO_PRIMITIVE, BalancedTree

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

# Harmonics have degree l.
# ruff: noqa: E741


Pair = tuple[Any, Any]
Pairs = dict[tuple[int, int], Pair]

# The largest l for which moments are computed.
MAX_DEGREE = 5
# The (l, m) for which moments are stored: 1 <= l <= MAX_DEGREE and 0 <= m <= l.
MOMENT_KEYS = tuple((l, m) for l in range(1, MAX_DEGREE + 1) for m in range(l + 1))


def regular_harmonics(x: Any, y: Any, z: Any, order: int) -> Pairs:
    """The regular solid harmonics R_lm at (x, y, z), for l <= order and 0 <= m <= l, as pairs of
    real and imaginary part. The imaginary part is the number 0 if m = 0."""
    r2 = x * x + y * y + z * z
    harmonics: Pairs = {(0, 0): (0 * x + 1, 0.0)}
    for m in range(order + 1):
        if m:
            u, v = x * (1 / (2 * m)), y * (1 / (2 * m))
            re, im = harmonics[m - 1, m - 1]
            harmonics[m, m] = (re * u, re * v) if m == 1 else (re * u - im * v, re * v + im * u)
        for l in range(m + 1, order + 1):
            scale = 1 / ((l + m) * (l - m))
            z_factor, r2_factor = (scale * (2 * l - 1)) * z, scale * r2
            re, im = harmonics[l - 1, m]
            re, im = z_factor * re, z_factor * im if m else 0.0
            if l - 2 >= m:
                second = harmonics[l - 2, m]
                re, im = re - r2_factor * second[0], im - r2_factor * second[1] if m else 0.0
            harmonics[l, m] = re, im
    return harmonics


def dipole_moments(harmonics: Pairs, nx: Any, ny: Any, nz: Any) -> Pairs:
    """The moments M_lm of a dipole at d, for l <= MAX_DEGREE.

    harmonics: R_lm(d) for l < MAX_DEGREE. For a dipole that is spread out over points, these are
        the means of R_lm over the points.
    nx, ny, nz: the dipole's normal, whose length is its area.
    """
    r, x, y = _with_negative_orders(harmonics), 0.5 * nx, 0.5 * ny
    moments: Pairs = {}
    for l, m in MOMENT_KEYS:
        re, im = (nz * component for component in r[l - 1, m]) if m < l else (0.0, 0.0)
        if abs(m + 1) < l:  # less (x - iy) R_l-1,m+1
            a, b = r[l - 1, m + 1]
            re, im = re - (x * a + y * b), im - (x * b - y * a)
        if abs(m - 1) < l:  # plus (x + iy) R_l-1,m-1
            a, b = r[l - 1, m - 1]
            re, im = re + (x * a - y * b), im + (x * b + y * a)
        moments[l, m] = re, im if m else 0.0
    return moments


def multipole_to_multipole(moments: Pairs, x: Any, y: Any, z: Any) -> Pairs:
    """The moments M_lm of dipoles about a point c, from their moments about c + (x, y, z)."""
    r, old = (
        _with_negative_orders(regular_harmonics(x, y, z, MAX_DEGREE - 1)),
        _with_negative_orders(moments),
    )
    shifted: Pairs = {}
    for l, m in MOMENT_KEYS:
        re, im = moments[l, m]
        for k in range(1, l):
            for j in range(max(-k, m - l + k), min(k, m + l - k) + 1):
                (a, b), (u, v) = old[k, j], r[l - k, m - j]
                re = re + (a * u - b * v)
                if m:
                    im = im + (a * v + b * u)
        shifted[l, m] = re, im
    return shifted


def _with_negative_orders(values: Pairs) -> Pairs:
    """Harmonics R_lm or moments M_lm, given for m >= 0, together with the entries for m < 0."""
    negative = {
        (l, -m): (re, -im) if m % 2 == 0 else (-re, im) for (l, m), (re, im) in values.items() if m
    }
    return values | negative


# Moments of nodes, all in double precision. Sums over dipoles and over children are computed in
# Dr.Jit, on many threads and without temporaries; the rest in NumPy, with a row for each node.

Moments = dict[tuple[int, int], npt.NDArray[np.complex128]]
# The keys (degree, order, part) of the real numbers that moments consist of; part is 0 for the real
# part, 1 for the imaginary part.
_MOMENT_PARTS = tuple((l, m, part) for l, m in MOMENT_KEYS for part in range(2 if m else 1))
# How many numbers `_power_terms` returns.
_POWER_COUNT = 10


@dataclass(frozen=True)
class NodeMoments:
    """The moments of the k nodes at one level of a tree.

    center: (k, 3) the point about which the moments are taken: the mean position of the dipoles,
        weighted by area.
    radius: (k,) the radius of a ball around the center that contains all dipoles.
    area: (k,) the sum of the areas a_i.
    second_moment, third_moment, fourth_moment: (k, 3, 3), (k, 3) and (k,) sums of a_i d_i d_i^T, of
        a_i |d_i|^2 d_i and of a_i |d_i|^4, with d_i the offset of a dipole from the center.
    moments: M_lm, (k,) each, for 1 <= l <= 5 and m >= 0.
    """

    center: FloatArray
    radius: FloatArray
    area: FloatArray
    second_moment: FloatArray
    third_moment: FloatArray
    fourth_moment: FloatArray
    moments: Moments


def dipole_tree_moments(
    tree: BalancedTree, points: FloatArray, normals: FloatArray, low: FloatArray, high: FloatArray
) -> list[NodeMoments]:
    """The moments of the nodes of a tree over primitives, each of which consists of dipoles. The
    list has an entry for each level of the tree, from the leaves to the root.

    points, normals: (n, s, 3) the s dipoles of each of n primitives. The length of a normal is its
        area.
    low, high: (n, 3) corners of boxes that contain the primitives.
    """
    backend, each = choose_backend("double"), points.shape[1]
    p, n, lows, highs = (upload_floats(backend, x.ravel()) for x in (points, normals, low, high))

    def primitive(i: Any) -> _DipolePrimitive:
        """The dipoles and the box of primitive i."""
        dipoles = [
            _Dipole(_row(backend, n, i * each + k), ((1.0, _row(backend, p, i * each + k)),))
            for k in range(each)
        ]
        return _DipolePrimitive(dipoles, _row(backend, lows, i), _row(backend, highs, i))

    return _all_levels(backend, tree, primitive)


def triangle_tree_moments(tree: BalancedTree, corners: FloatArray) -> list[NodeMoments]:
    """The moments of the nodes of a tree over triangles, each of which counts as a sheet of dipoles
    along its normal. They are exact up to rounding. The list has an entry for each level of the
    tree, from the leaves to the root.

    corners: (n, 3, 3) of the triangles.
    """
    backend = choose_backend("double")
    buffer = upload_floats(backend, corners.ravel())
    rule = tuple(zip(*(part.tolist() for part in triangle_rule()), strict=True))

    def primitive(i: Any) -> _DipolePrimitive:
        """Triangle i as a dipole that is spread over the points of `triangle_rule`, and its box."""
        a, b, c = (_row(backend, buffer, 3 * i + k) for k in range(3))
        points = [(weight, a * u + b * v + c * w) for (u, v, w), weight in rule]
        dipole = _Dipole(0.5 * dr.cross(b - a, c - a), points)
        return _DipolePrimitive([dipole], fmin(fmin(a, b), c), fmax(fmax(a, b), c))

    return _all_levels(backend, tree, primitive)


@dataclass(frozen=True)
class _Dipole:
    """A dipole that is spread over points.

    normal: its direction, with its area as length.
    points: pairs of a weight and a point; the weights add up to 1.
    """

    normal: Vec3
    points: Sequence[tuple[float, Vec3]]


@dataclass(frozen=True)
class _DipolePrimitive:
    """The dipoles of a primitive, and the lower and upper corner of a box that contains it."""

    dipoles: Sequence[_Dipole]
    low: Vec3
    high: Vec3


def _row(backend: Backend, buffer: Real, i: Any) -> Vec3:
    """Vector i of a buffer that holds three numbers for each vector."""
    return backend.Array3f(*(dr.gather(backend.Float, buffer, 3 * i + k) for k in range(3)))


def _all_levels(
    backend: Backend, tree: BalancedTree, primitive: Callable[[Any], _DipolePrimitive]
) -> list[NodeMoments]:
    """The moments of the nodes of a tree. The list has an entry for each level of the tree, from
    the leaves to the root.

    primitive: a function that returns the dipoles of a primitive from its index.
    """
    level, parts, low, high = _leaf_moments(backend, tree, primitive)
    levels = [level]
    for arity in tree.arities:
        low = low.reshape(-1, arity, 3).min(axis=1)
        high = high.reshape(-1, arity, 3).max(axis=1)
        level, parts = _parent_moments(backend, level, parts, low, high)
        levels.append(level)
    return levels


def _leaf_moments(
    backend: Backend, tree: BalancedTree, primitive: Callable[[Any], _DipolePrimitive]
) -> tuple[NodeMoments, list[Real], FloatArray, FloatArray]:
    """The moments of the leaves of a tree.

    primitive: a function that returns the dipoles of a primitive from its index.

    Returns the moments as NumPy arrays; the real and imaginary parts of M_lm as a list of numbers
    of the backend, in the order of `_MOMENT_PARTS`; and the lower and upper corners (n, 3) of boxes
    around the leaves.

    Each lane is a leaf, which visits its primitives twice: for the center, and for the moments
    about it.
    """
    index, real, vector = backend.UInt32, backend.Float, backend.Array3f
    filled = tree.leaf_slots != NO_PRIMITIVE
    slots = upload_integers(backend, np.where(filled, tree.leaf_slots, 0).ravel())
    leaf = dr.arange(index, len(filled))
    first = leaf * dr.opaque(index, tree.leaf_size)
    end = first + dr.gather(index, upload_integers(backend, filled.sum(axis=1)), leaf)

    def visit(body: Callable[..., tuple[Any, ...]], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Apply `body` to the primitives of each leaf, one after another. Each lane is a leaf.
        Returns the last state."""

        def step(slot: Any, *state: Any) -> tuple[Any, ...]:
            """Apply `body` to the primitive in a slot."""
            return slot + 1, *body(primitive(dr.gather(index, slots, slot)), *state)

        def more(slot: Any, *_: Any) -> Any:
            """The mask of the leaves that have further slots."""
            return slot < end

        return dr.while_loop((first, *state), more, step, label="slots")[1:]

    def measure(source: _DipolePrimitive, low: Vec3, high: Vec3, area: Real, weighted: Vec3) -> Any:
        """Add a primitive to the box from low to high, to the area, and to the sum of positions
        weighted by area."""
        for dipole in source.dipoles:
            size = dr.norm(dipole.normal)
            area, weighted = area + size, weighted + size * sum(w * p for w, p in dipole.points)
        return fmin(low, source.low), fmax(high, source.high), area, weighted

    def sum_up(source: _DipolePrimitive, *parts: Real) -> tuple[Any, ...]:
        """Add the terms of a primitive about the leaf's center to the sums `parts`: first those of
        `_power_terms`, then the moments."""
        for dipole in source.dipoles:
            offsets = [(weight, point - center) for weight, point in dipole.points]
            more = _power_terms(dr.norm(dipole.normal), offsets) + _flatten(
                _spread_dipole_moments(dipole.normal, offsets)
            )
            parts = tuple(a + b for a, b in zip(parts, more, strict=True))
        return parts

    start = (vector(dr.inf), vector(-dr.inf), real(0), vector(0))
    low, high, area, weighted = visit(measure, start)
    # The mean position weighted by area, or the box's center if there is no area.
    center = dr.select(area > 0, weighted / dr.select(area > 0, area, 1), 0.5 * (low + high))
    sums = visit(sum_up, (real(0),) * (_POWER_COUNT + len(_MOMENT_PARTS)))
    powers, parts = sums[:_POWER_COUNT], sums[_POWER_COUNT:]
    dr.eval(low, high, area, center, *sums)
    boxes = to_numpy(low), to_numpy(high)
    middle, (xx, yy, zz, xy, xz, yz, *third, fourth) = to_numpy(center), map(to_numpy, powers)
    second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    sizes = to_numpy(area), second, np.stack(third, axis=1), fourth
    return (
        NodeMoments(middle, _bounding_radius(middle, *boxes), *sizes, _moments_of(parts)),
        list(parts),
        *boxes,
    )


def _power_terms(area: Real, points: Sequence[tuple[float, Vec3]]) -> list[Real]:
    """The terms of a dipole in `second_moment` (xx, yy, zz, xy, xz, yz), `third_moment` and
    `fourth_moment` of `NodeMoments`. points: pairs of a weight and an offset from the center."""
    total: list[Real] = [area * 0] * _POWER_COUNT
    for weight, d in points:
        square, weighted_area = dr.squared_norm(d), weight * area
        pairs = (d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.x * d.z, d.y * d.z)
        powers = (*pairs, *(square * d), square * square)
        total = [
            dr.fma(weighted_area, power, old) for power, old in zip(powers, total, strict=True)
        ]
    return total


def _spread_dipole_moments(normal: Vec3, points: Sequence[tuple[float, Vec3]]) -> Pairs:
    """The moments of a dipole that is spread over points. points: pairs of a weight and an offset
    from the center."""
    means: Pairs = {}
    for weight, d in points:
        for key, (re, im) in regular_harmonics(d.x, d.y, d.z, MAX_DEGREE - 1).items():
            a, b = means.get(key, (0.0, 0.0))
            means[key] = a + weight * re, b + weight * im
    return dipole_moments(means, normal.x, normal.y, normal.z)


def _flatten(moments: Pairs) -> list[Any]:
    """The real and imaginary parts of moments, in the order of `_MOMENT_PARTS`."""
    return [moments[l, m][part] for l, m, part in _MOMENT_PARTS]


def _moments_of(parts: Sequence[Real]) -> Moments:
    """Complex moments by (l, m) in NumPy, from their parts on the backend in the order of
    `_MOMENT_PARTS`."""
    moments = {key: np.zeros(dr.width(parts[0]), np.complex128) for key in MOMENT_KEYS}
    for (l, m, part), values in zip(_MOMENT_PARTS, parts, strict=True):
        if part:
            moments[l, m].imag = to_numpy(values)
        else:
            moments[l, m].real = to_numpy(values)
    return moments


def _parent_moments(
    backend: Backend, children: NodeMoments, parts: list[Real], low: FloatArray, high: FloatArray
) -> tuple[NodeMoments, list[Real]]:
    """The moments of n parents in the tree, from the moments of their children, which are the nodes
    of the tree's next level towards the leaves.

    children: the moments of the children, sorted by parents.
    parts: the real and imaginary parts of the children's M_lm as a list of numbers of the backend,
        in the order of `_MOMENT_PARTS`.
    low, high: (n, 3) corners of boxes around the parents.

    Returns the parents' moments as NumPy arrays; and the real and imaginary parts of their M_lm as
    a list of numbers of the backend, which the call for the grandparents takes as `parts`.
    """
    count, arity = len(low), len(children.area) // len(low)
    area = children.area.reshape(-1, arity).sum(axis=1)
    weighted = (children.area[:, None] * children.center).reshape(-1, arity, 3).sum(axis=1)
    has_area = (area > 0)[:, None]
    center = np.where(has_area, weighted / np.where(has_area, area[:, None], 1), 0.5 * (low + high))
    shift = children.center - np.repeat(center, arity, axis=0)
    pairs: Pairs = dict.fromkeys(MOMENT_KEYS, (0.0, 0.0))
    for (l, m, part), values in zip(_MOMENT_PARTS, parts, strict=True):
        pairs[l, m] = (pairs[l, m][0], values) if part else (values, 0.0)
    shifted = _flatten(
        multipole_to_multipole(pairs, *(upload_floats(backend, column) for column in shift.T))
    )
    dr.eval(*shifted)
    first = arity * dr.arange(backend.UInt32, count)
    sums = [
        sum(dr.gather(backend.Float, column, first + k) for k in range(arity)) for column in shifted
    ]
    dr.eval(*sums)
    second, third, fourth = (
        column.reshape(count, arity, *column.shape[1:]).sum(axis=1)
        for column in _shifted_powers(children, shift)
    )
    radius, moments = _bounding_radius(center, low, high), _moments_of(sums)
    return NodeMoments(center, radius, area, second, third, fourth, moments), sums


def _shifted_powers(level: NodeMoments, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The second, third and fourth moments of k nodes (the attributes of `NodeMoments`) about the
    points center - s instead of their centers. Offsets d of dipoles become d + s.

    s: (k, 3). The first moment of a node about its own center is 0.
    """
    a, square = level.area[:, None], (s * s).sum(axis=1)
    trace, m2_s = (
        np.einsum("kii->k", level.second_moment),
        np.einsum("kij,kj->ki", level.second_moment, s),
    )
    second = level.second_moment + a[:, None] * s[:, :, None] * s[:, None]
    third = level.third_moment + trace[:, None] * s + 2 * m2_s + a * square[:, None] * s
    fourth = level.fourth_moment + 2 * trace * square + level.area * square * square
    return second, third, fourth + 4 * ((level.third_moment + m2_s) * s).sum(axis=1)


def _bounding_radius(center: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The distance (k,) from the center to the farthest corner of the box from low to high."""
    return np.linalg.norm(np.maximum(high - center, center - low), axis=1)


def cartesian_coefficients(moments: Moments, order: int = 2) -> FloatArray:
    """Coefficients (k, 15) of the multipole terms of k nodes in Cartesian coordinates, for the
    degrees l <= order + 1, as `treecode.multipole_terms` reads them. Coefficients of higher degree
    are 0.

    moments: the complex moments M_lm, (k,) each.
    order: 0, 1 or 2.

    The term of degree l is P_l(r)/r^(2l+1) with a harmonic polynomial P_l. P_1 = D.r with the
    coefficients D. P_2 has the coefficients of xx, yy, 2xy, 2xz, 2yz; that of zz follows, as the
    trace is zero. P_3 has the coefficients of xyy, xzz, xxy, yzz, xxz, yyz, xyz; those of x^3, y^3,
    z^3 follow.
    """
    real = {key: value.real for key, value in moments.items()}
    imag = {key: value.imag for key, value in moments.items()}
    dipole = [2 * real[1, 1], 2 * imag[1, 1], real[1, 0]]
    r20, r21, i21 = real[2, 0], 6 * real[2, 1], 6 * imag[2, 1]
    r22, i22 = 6 * real[2, 2], 6 * imag[2, 2]
    quadrupole = [-r20 + r22, -r20 - r22, i22, r21 / 2, i21 / 2]
    r30, r31, i31 = 3 * real[3, 0], 6 * real[3, 1], 6 * imag[3, 1]
    r32, i32 = 30 * real[3, 2], 30 * imag[3, 2]
    r33, i33 = 30 * real[3, 3], 30 * imag[3, 3]
    octupole = [
        -r31 - 3 * r33,
        4 * r31,
        -i31 + 3 * i33,
        4 * i31,
        -3 * r30 + r32,
        -3 * r30 - r32,
        2 * i32,
    ]
    coefficients = -np.stack([*dipole, *quadrupole, *octupole], axis=1)
    coefficients[:, (3, 8, 15)[order] :] = 0
    return coefficients


def triangle_rule() -> tuple[FloatArray, FloatArray]:
    """Barycentric coordinates (6, 3) of points in a triangle, and their weights (6,), whose sum is
    1.

    They integrate polynomials of degree at most four exactly, and so give exact moments for l <= 5.
    This is Dunavant's six-point rule (1985).
    """
    rule = ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322))
    points: list[tuple[float, float, float]] = []
    for corner, _ in rule:
        apex = 1 - 2 * corner
        points += [(apex, corner, corner), (corner, apex, corner), (corner, corner, apex)]
    return np.array(points), np.repeat([weight for _, weight in rule], 3)


# Bounds of the terms.

# A bound times this factor is still a bound after a few roundings to single precision.
_ROUND_UP = 1 + 2.0**-20


def sup_norm(moments: Moments, l: int) -> FloatArray:
    """A bound (k,), for k nodes, of r^(l+1) times the absolute value of the multipole term of
    degree l, over all directions. r is the distance from a node's center.

    For unit x, y the addition theorem gives sum_m |I_lm(x)|^2 / ((l+m)!(l-m)!) = P_l(1) = 1, so by
    Cauchy and Schwarz |sum_m conj(M_lm) I_lm|^2 <= sum_m (l+m)! (l-m)! |M_lm|^2.
    """
    total = 0.0
    for m in range(l + 1):
        weight = math.factorial(l + m) * math.factorial(l - m) * (1 if m == 0 else 2)
        total = total + weight * np.abs(moments[l, m]) ** 2
    return np.sqrt(np.asarray(total))


def truncation_bounds(
    level: NodeMoments, nearest: FloatArray, order: int = 2
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bounds (E, G, H), each (n,), of the multipole terms of n nodes that are left out if only the
    terms of degree up to order + 1 are used.

    level: the moments of the n nodes of a level of the tree.

    nearest: (n,) the bounds hold at distances r >= nearest from the centers of the nodes.

    At such distances the omitted terms, of degree l >= k = order + 2, add at most E/r^(k+1) to f,
    at most G/r^(k+2) to its gradient, and at most H/r^(k+3) to second derivatives along lines.

    Proof. A dipole of area a at d gives the term l at most a l |d|^(l-1)/r^(l+1): on the sphere
    rho^l P_l is a trigonometric polynomial of degree l along each great circle, so by Bernstein's
    and Szego's inequality its gradient is at most l rho^(l-1). Terms up to 5 are known exactly and
    bounded by `sup_norm`; for the rest |d|^(l-1) <= R^(l-5) |d|^4 and
    sum_{l>=6} l q^(l-5) = q (6 - 5q)/(1-q)^2 with q = R/r. A harmonic function of degree
    -(l+1) has, by the same inequality, a gradient of at most l+1 times its largest value on the
    sphere through the point; the rest is then sum_{l>=6} l (l+1) q^(l-5)
    = q (42 - 70q + 30q^2)/(1-q)^3. Its derivatives along lines are harmonic of degree -(l+2), so
    that second derivatives are at most (l+1)(l+2) times it, and sum_{l>=6} l (l+1) (l+2) q^(l-5)
    = q (336 - 840q + 720q^2 - 210q^3)/(1-q)^4. Each term times r^(k+1) (r^(k+2), r^(k+3)) does not
    grow with r, so the value at `nearest` is a bound. The results are increased slightly for the
    rounding to single precision.
    """
    r = np.maximum(nearest, 1e-50)  # so that powers do not underflow
    q = np.minimum(level.radius / r, 0.99)
    k = order + 2
    tail = level.fourth_moment * level.radius / r ** (6 - k)
    value = tail * (6 - 5 * q) / (1 - q) ** 2
    slope = tail * (42 - 70 * q + 30 * q * q) / (1 - q) ** 3
    second = tail * (336 - 840 * q + 720 * q * q - 210 * q**3) / (1 - q) ** 4
    for l in range(k, MAX_DEGREE + 1):
        term = sup_norm(level.moments, l) / r ** (l - k)
        value, slope, second = (
            value + term,
            slope + (l + 1) * term,
            second + (l + 1) * (l + 2) * term,
        )
    return _ROUND_UP * value, _ROUND_UP * slope, _ROUND_UP * second


def remainder_constants(level: NodeMoments, rough: float) -> tuple[FloatArray, FloatArray]:
    """Numbers A and K, each (k,), for k nodes of a tree. They bound the difference between the
    field of a node's dipoles and its linear Taylor polynomial at a point.

    They hold at points whose distance r from the node's center is at least r0, which is `rough`
    times the node's radius R. Over a step of length t = q r with
    q <= Q = `max_step_fraction(rough)`, the field differs from its linear part by at most

        (A + K/r^2) t^2/r^4 Phi_1(q),   Phi_l(q) = ((1-q)^-(l+1) - 1 - (l+1)q)/q^2.

    The term l, a harmonic function of degree -(l+1), is at most B_l/r^(l+1), and its k-th
    derivative along a line (l+k)!/l! B_l/r^(l+1+k) (the argument of `truncation_bounds`, k times).
    So Taylor's remainder is at most B_l Phi_l(q) t^2/r^(l+3). In Phi_l/Phi_1 the ratio of
    coefficients, (l+k)!/(l! (k+1)!), grows with k, so that the quotient grows with q, and
    W_l = Phi_l(Q)/Phi_1(Q) is a bound. With r >= r0: A = B_1 + W_2 B_2/r0 and K = sum_{l>=3} W_l
    B_l/r0^(l-3), for l >= 6 of B_l <= l R^(l-5) sum a |d|^4, with Phi_l(Q) < (1-Q)^-(l+1)/Q^2.
    """
    r0, q = np.maximum(rough * level.radius, 1e-50), max_step_fraction(rough)
    first = q * q * remainder_factor(q)
    ratio = [((1 - q) ** -(n + 1) - 1 - (n + 1) * q) / first for n in range(MAX_DEGREE + 1)]
    terms = [ratio[n] * sup_norm(level.moments, n) for n in range(1, MAX_DEGREE + 1)]
    x = 1 / (rough * (1 - q))
    tail = x * (6 - 5 * x) / (1 - x) ** 2 / ((1 - q) ** 6 * first)
    higher = tail * level.fourth_moment / r0**2 + sum(
        term / r0**n for n, term in enumerate(terms[2:])
    )
    return terms[0] + terms[1] / r0, higher
