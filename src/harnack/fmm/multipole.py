"""Multipole moments of dipoles and of the nodes of a tree, and bounds of truncated multipole
expansions. A dipole has a position y_i, a unit normal n_i and an area a_i; f is the sum of the
potentials of all dipoles. Dipoles near a center c are replaced by a series in x - c, whose
coefficients are the moments M_lm, complex numbers of degree l and order m with 0 <= m <= l. A node
of a tree stands for all its dipoles, and has moments about its own center.

Let d_i = y_i - c be the offset of a dipole from the center. At a point x = c + r

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
- `truncation_bounds`: bounds of the terms that are left out if the series ends at a degree.
- `remainder_constants`: bounds of the remainder of f's Taylor polynomial.

Here a complex number is a pair (real part, imaginary part) of numbers or arrays of any kind, of
NumPy or of Dr.Jit.
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
from harnack.fmm.source_sums import max_step_fraction, remainder_factor
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
    """Compute the regular solid harmonics R_lm at (x, y, z), for l <= order and 0 <= m <= l.

    Returns a dictionary of pairs (real part, imaginary part) by (l, m). The imaginary part is the
    number 0 if m = 0.

    Recurrences. R_mm = R_m-1,m-1 (x + iy)/(2m), and
    R_lm = ((2l - 1) z R_l-1,m - r^2 R_l-2,m)/((l + m)(l - m)).
    """
    r2 = x * x + y * y + z * z
    harmonics: Pairs = {(0, 0): (0 * x + 1, 0.0)}  # 1 for each entry of x
    for m in range(order + 1):
        # The entry l = m by the first recurrence, then those with l > m by the second.
        if m:
            u, v = x * (1 / (2 * m)), y * (1 / (2 * m))
            re, im = harmonics[m - 1, m - 1]
            # R_00 is real.
            harmonics[m, m] = (re * u, re * v) if m == 1 else (re * u - im * v, re * v + im * u)
        for l in range(m + 1, order + 1):
            scale = 1 / ((l + m) * (l - m))
            z_factor, r2_factor = (scale * (2 * l - 1)) * z, scale * r2
            re, im = harmonics[l - 1, m]
            # For m = 0 the imaginary part is the number 0.
            re, im = z_factor * re, z_factor * im if m else 0.0
            if l - 2 >= m:
                second = harmonics[l - 2, m]
                re, im = re - r2_factor * second[0], im - r2_factor * second[1] if m else 0.0
            harmonics[l, m] = re, im
    return harmonics


def dipole_moments(harmonics: Pairs, nx: Any, ny: Any, nz: Any) -> Pairs:
    """Compute the moments M_lm = n.grad R_lm(d) of a dipole at the offset d from the center, for
    l <= MAX_DEGREE.

    harmonics: R_lm(d) for l < MAX_DEGREE, as pairs by (l, m). For a dipole that is spread out over
        points, these are the means of R_lm over the points.
    nx, ny, nz: n, the dipole's normal times its area.

    From d/dz R_lm = R_l-1,m, (d/dx + i d/dy) R_lm = -R_l-1,m+1 and (d/dx - i d/dy) R_lm = R_l-1,m-1
    follows M_lm = nz R_l-1,m - (x - iy) R_l-1,m+1 + (x + iy) R_l-1,m-1 with x = nx/2 and y = ny/2.
    """
    # A harmonic is a + ib; a product such as (x - iy)(a + ib) is written out in its two parts.
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
    """Move moments to another center: compute the moments M_lm of dipoles about a point c, from
    their moments about c + s with s = (x, y, z). Moments are pairs by (l, m).

    By the addition theorem of R_lm, M_lm is the sum over k and j of the old moment M_kj times
    R_l-k,m-j(s). The term k = l is the old moment itself.
    """
    # The limits of j are those of |j| <= k and |m - j| <= l - k. Moments with m = 0 are real.
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
    """Add the entries for m < 0 to harmonics R_lm or moments M_lm: `values` has the entries for
    m >= 0, as pairs by (l, m). The entry (l, -m) is (-1)^m times the conjugate of (l, m)."""
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
    """The moments of the k nodes at one level of a tree. A node stands for all its dipoles i, with
    areas a_i and offsets d_i from the node's center.

    center: (k, 3) the point about which the moments are taken: the mean position of the node's
        dipoles, weighted by area, or the center of their box if the area is 0.
    radius: (k,) the radius of a ball around the center that contains the node's primitives.
    area: (k,) the sum of the areas a_i.
    second_moment: (k, 3, 3) the sum of a_i d_i d_i^T.
    third_moment: (k, 3) the sum of a_i |d_i|^2 d_i.
    fourth_moment: (k,) the sum of a_i |d_i|^4.
    moments: the multipole moments M_lm for 1 <= l <= 5 and m >= 0, an array (k,) of complex numbers
        for each (l, m).
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
    """Compute the moments of the nodes of a tree over n primitives, each of which consists of s
    dipoles.

    tree: the hierarchy of the tree: which primitives are in which node.
    points: (n, s, 3) the positions of the dipoles.
    normals: (n, s, 3) their normals, each times the dipole's area.
    low, high: (n, 3) corners of boxes that contain the primitives.

    Returns one entry for each level of the tree, from the leaves to the root.
    """
    # each: the number s of dipoles of a primitive. p, n: the positions and the normals.
    backend, each = choose_backend("double"), points.shape[1]
    p, n, lows, highs = (upload_floats(backend, x.ravel()) for x in (points, normals, low, high))

    def primitive(i: Any) -> _DipolePrimitive:
        """Read the dipoles, `each` of them, and the box of primitive i from the buffers of
        positions p, normals n, and corners `lows` and `highs`. i may differ from lane to lane."""
        # 1: the whole area of a dipole is at its single point.
        dipoles = [
            _Dipole(_row(backend, n, i * each + k), ((1.0, _row(backend, p, i * each + k)),))
            for k in range(each)
        ]
        return _DipolePrimitive(dipoles, _row(backend, lows, i), _row(backend, highs, i))

    return _all_levels(backend, tree, primitive)


def triangle_tree_moments(tree: BalancedTree, corners: FloatArray) -> list[NodeMoments]:
    """Compute the moments of the nodes of a tree over triangles, each of which counts as a sheet of
    dipoles along its normal. They are exact up to rounding.

    tree: the hierarchy of the tree: which triangles are in which node.
    corners: (n, 3, 3) the corners of the triangles.

    Returns one entry for each level of the tree, from the leaves to the root.
    """
    backend = choose_backend("double")
    buffer = upload_floats(backend, corners.ravel())
    # Pairs of the barycentric coordinates of a point, and its weight.
    rule = tuple(zip(*(part.tolist() for part in triangle_rule()), strict=True))

    def primitive(i: Any) -> _DipolePrimitive:
        """Read triangle i, as a dipole that is spread over the points of `triangle_rule`, and the
        triangle's box. i may differ from lane to lane."""
        a, b, c = (_row(backend, buffer, 3 * i + k) for k in range(3))
        points = [(weight, a * u + b * v + c * w) for (u, v, w), weight in rule]
        dipole = _Dipole(0.5 * dr.cross(b - a, c - a), points)
        return _DipolePrimitive([dipole], fmin(fmin(a, b), c), fmax(fmax(a, b), c))

    return _all_levels(backend, tree, primitive)


@dataclass(frozen=True)
class _Dipole:
    """A dipole that is spread over points: each point has a fraction of its area.

    normal: the dipole's normal times its area.
    points: pairs of a fraction and a point; the fractions add up to 1.
    """

    normal: Vec3
    points: Sequence[tuple[float, Vec3]]


@dataclass(frozen=True)
class _DipolePrimitive:
    """A primitive of a tree, such as a triangle: its dipoles, and the lower and upper corner of a
    box that contains it."""

    dipoles: Sequence[_Dipole]
    low: Vec3
    high: Vec3


def _row(backend: Backend, buffer: Real, i: Any) -> Vec3:
    """Read vector i from a buffer that holds three numbers for each vector. i may differ from lane
    to lane."""
    return backend.Array3f(*(dr.gather(backend.Float, buffer, 3 * i + k) for k in range(3)))


def _all_levels(
    backend: Backend, tree: BalancedTree, primitive: Callable[[Any], _DipolePrimitive]
) -> list[NodeMoments]:
    """Compute the moments of all nodes of a tree: of the leaves from their primitives, of all other
    nodes from their children.

    primitive: a function that returns the dipoles and the box of a primitive from its index.

    Returns one entry for each level of the tree, from the leaves to the root.
    """
    level, parts, low, high = _leaf_moments(backend, tree, primitive)
    levels = [level]
    # arity: the number of children of each node at the next level.
    for arity in tree.arities:
        low = low.reshape(-1, arity, 3).min(axis=1)
        high = high.reshape(-1, arity, 3).max(axis=1)
        level, parts = _parent_moments(backend, level, parts, low, high)
        levels.append(level)
    return levels


def _leaf_moments(
    backend: Backend, tree: BalancedTree, primitive: Callable[[Any], _DipolePrimitive]
) -> tuple[NodeMoments, list[Real], FloatArray, FloatArray]:
    """Compute the moments of the n leaves of a tree. Each lane is a leaf. It visits its primitives
    twice: for its center, and for the moments about the center.

    primitive: a function that returns the dipoles and the box of a primitive from its index.

    Returns the moments as NumPy arrays; the real and imaginary parts of M_lm once more, as a list
    of arrays of the backend in the order of `_MOMENT_PARTS`; and the lower and the upper corners
    (n, 3) of boxes around the leaves.
    """
    index, real, vector = backend.UInt32, backend.Float, backend.Array3f
    filled = tree.leaf_slots != NO_PRIMITIVE
    # The slots of a leaf follow each other, filled slots first: from `first` up to `end`.
    slots = upload_integers(backend, np.where(filled, tree.leaf_slots, 0).ravel())
    leaf = dr.arange(index, len(filled))
    first = leaf * dr.opaque(index, tree.leaf_size)
    end = first + dr.gather(index, upload_integers(backend, filled.sum(axis=1)), leaf)

    def visit(body: Callable[..., tuple[Any, ...]], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Loop over the primitives of each leaf, one after another, and for each of them set state
        = body(primitive, *state). The leaf's primitives are the entries `first` to `end` - 1 of
        `slots`. Returns the last state."""

        def step(slot: Any, *state: Any) -> tuple[Any, ...]:
            """Update the state by the primitive in a slot. Returns the next slot, and then the new
            state."""
            return slot + 1, *body(primitive(dr.gather(index, slots, slot)), *state)

        def more(slot: Any, *_: Any) -> Any:
            """Whether the loop goes on, on each lane: its leaf has this slot."""
            return slot < end

        return dr.while_loop((first, *state), more, step, label="slots")[1:]

    def measure(source: _DipolePrimitive, low: Vec3, high: Vec3, area: Real, weighted: Vec3) -> Any:
        """Update four measures of a leaf by the primitive `source`, and return them. They are the
        two corners `low` and `high` of a box, the area, and `weighted`, the sum of area times
        position over the dipoles."""
        for dipole in source.dipoles:
            size = dr.norm(dipole.normal)
            area, weighted = area + size, weighted + size * sum(w * p for w, p in dipole.points)
        return fmin(low, source.low), fmax(high, source.high), area, weighted

    def sum_up(source: _DipolePrimitive, *parts: Real) -> tuple[Any, ...]:
        """Add the primitive `source` to the sums `parts` about `center`, the leaf's center, which
        is computed below before this function is used. The first sums are those of `_power_terms`,
        the further ones the real and imaginary parts of M_lm. Returns the new sums."""
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
    # As NumPy arrays; the second moments become symmetric matrices (n, 3, 3).
    middle, (xx, yy, zz, xy, xz, yz, *third, fourth) = to_numpy(center), map(to_numpy, powers)
    second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    sizes = to_numpy(area), second, np.stack(third, axis=1), fourth
    return (
        NodeMoments(middle, _bounding_radius(middle, *boxes), *sizes, _moments_of(parts)),
        list(parts),
        *boxes,
    )


def _power_terms(area: Real, points: Sequence[tuple[float, Vec3]]) -> list[Real]:
    """Compute what a dipole that is spread over points adds to the moments of its node. Returns ten
    numbers: six for the entries xx, yy, zz, xy, xz, yz of `NodeMoments.second_moment`, then three
    for `third_moment` and one for `fourth_moment`.

    area: the area of the dipole.
    points: pairs of a fraction of the area, and an offset from the node's center.
    """
    total: list[Real] = [area * 0] * _POWER_COUNT  # a zero for each lane
    for weight, d in points:
        square, weighted_area = dr.squared_norm(d), weight * area
        pairs = (d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.x * d.z, d.y * d.z)
        powers = (*pairs, *(square * d), square * square)
        total = [
            dr.fma(weighted_area, power, old) for power, old in zip(powers, total, strict=True)
        ]
    return total


def _spread_dipole_moments(normal: Vec3, points: Sequence[tuple[float, Vec3]]) -> Pairs:
    """Compute the moments M_lm of a dipole that is spread over points.

    normal: the dipole's normal times its area.
    points: pairs of a fraction of the area, and an offset from the center.
    """
    means: Pairs = {}
    for weight, d in points:
        for key, (re, im) in regular_harmonics(d.x, d.y, d.z, MAX_DEGREE - 1).items():
            a, b = means.get(key, (0.0, 0.0))
            means[key] = a + weight * re, b + weight * im
    return dipole_moments(means, normal.x, normal.y, normal.z)


def _flatten(moments: Pairs) -> list[Any]:
    """List the real and imaginary parts of moments, in the order of `_MOMENT_PARTS`: by (l, m),
    real before imaginary part."""
    return [moments[l, m][part] for l, m, part in _MOMENT_PARTS]


def _moments_of(parts: Sequence[Real]) -> Moments:
    """Join real and imaginary parts, given as arrays of a backend in the order of `_MOMENT_PARTS`,
    to complex moments M_lm by (l, m) in NumPy."""
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
    """Compute the moments of the n nodes at one level of a tree, the parents, from the moments of
    their children at the next level towards the leaves. All parents have equally many children.

    children: the moments of the children, sorted by parents.
    parts: the real and imaginary parts of the children's M_lm once more, as a list of arrays of the
        backend in the order of `_MOMENT_PARTS`.
    low, high: (n, 3) corners of boxes around the parents.

    Returns the parents' moments as NumPy arrays; and the real and imaginary parts of their M_lm
    once more, as a list of arrays of the backend, which is `parts` for the next level.
    """
    # The center as for leaves: the mean position weighted by area, or the center of the box.
    count, arity = len(low), len(children.area) // len(low)
    area = children.area.reshape(-1, arity).sum(axis=1)
    weighted = (children.area[:, None] * children.center).reshape(-1, arity, 3).sum(axis=1)
    has_area = (area > 0)[:, None]
    center = np.where(has_area, weighted / np.where(has_area, area[:, None], 1), 0.5 * (low + high))
    # The offset of each child's center from its parent's center.
    shift = children.center - np.repeat(center, arity, axis=0)
    pairs: Pairs = dict.fromkeys(MOMENT_KEYS, (0.0, 0.0))
    for (l, m, part), values in zip(_MOMENT_PARTS, parts, strict=True):
        pairs[l, m] = (pairs[l, m][0], values) if part else (values, 0.0)
    shifted = _flatten(
        multipole_to_multipole(pairs, *(upload_floats(backend, column) for column in shift.T))
    )
    dr.eval(*shifted)
    # Sum over the children of each parent, which follow each other.
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
    """Compute the second, third and fourth moments of k nodes (as defined by `NodeMoments`) about
    the points center - s instead of their centers. Each dipole's offset d becomes d + s.

    level: the moments of the nodes.
    s: (k, 3) the shift of each node.

    The formulas follow from expanding the products of d + s; the sum of a_i d_i, about the node's
    own center, is 0.
    """
    # trace: the sum of a_i |d_i|^2; m2_s: the second moment times s.
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
    """Compute, for each of k points, the distance (k,) to the farthest corner of a box of its own.
    center: (k, 3) the points. low, high: (k, 3) two opposite corners of their boxes."""
    return np.linalg.norm(np.maximum(high - center, center - low), axis=1)


def cartesian_coefficients(moments: Moments, order: int = 2) -> FloatArray:
    """Compute the coefficients (k, 15) of the multipole terms of k nodes as polynomials in x, y, z,
    as `treecode.multipole_terms` reads them.

    moments: the complex moments M_lm by (l, m), each an array (k,).
    order: 0, 1 or 2. Coefficients of terms of degree l > order + 1 are 0.

    The term of degree l is P_l(r)/r^(2l+1) with a harmonic polynomial P_l. P_1 = D.r with the
    coefficients D. P_2 has the coefficients of xx, yy, 2xy, 2xz, 2yz; that of zz follows, as the
    trace is zero. P_3 has the coefficients of xyy, xzz, xxy, yzz, xxz, yyz, xyz; those of x^3, y^3,
    z^3 follow.
    """
    real = {key: value.real for key, value in moments.items()}
    imag = {key: value.imag for key, value in moments.items()}
    # r and i: real and imaginary part of M_lm, times the factor of its Cartesian form. They follow
    # from writing conj(M_lm) I_lm, summed over m and -m, in x, y, z.
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
    # The terms of degree 1, 2 and 3 have 3, 5 and 7 coefficients.
    coefficients[:, (3, 8, 15)[order] :] = 0
    return coefficients


def triangle_rule() -> tuple[FloatArray, FloatArray]:
    """Return Dunavant's six-point quadrature rule for triangles (1985): the barycentric coordinates
    (6, 3) of its points, and their weights (6,), whose sum is 1.

    The rule integrates polynomials of degree at most four exactly. So it gives exact moments for
    l <= 5, which are integrals of polynomials of degree l - 1.
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
    """Bound the multipole term of degree l of k nodes. In all directions, at the distance r from a
    node's center, its absolute value is at most the returned number (k,) over r^(l+1).

    moments: the complex moments M_lm by (l, m), each an array (k,).

    Proof. For unit x, y the addition theorem gives sum_m |I_lm(x)|^2 / ((l+m)!(l-m)!) = P_l(1) = 1,
    so by Cauchy and Schwarz |sum_m conj(M_lm) I_lm|^2 <= sum_m (l+m)! (l-m)! |M_lm|^2.
    """
    total = 0.0
    for m in range(l + 1):
        # The terms m and -m are equal.
        weight = math.factorial(l + m) * math.factorial(l - m) * (1 if m == 0 else 2)
        total = total + weight * np.abs(moments[l, m]) ** 2
    return np.sqrt(np.asarray(total))


def truncation_bounds(
    level: NodeMoments, nearest: FloatArray, order: int = 2
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bound the multipole terms of n nodes that are left out if only the terms of degree up to
    order + 1 are used.

    level: the moments of the n nodes at one level of the tree.
    nearest: (n,) the bounds hold at distances r >= nearest from the nodes' centers.
    order: from 0 to 3.

    Returns (E, G, H), each (n,): the omitted terms, whose degrees are l >= k = order + 2, add at
    most E/r^(k+1) to f, at most G/r^(k+2) to its gradient, and at most H/r^(k+3) to second
    derivatives along lines.

    Proof. Let R be the node's radius and q = R/r.

    1. Values. A dipole of area a at the offset d from the center gives a term of degree l of at
       most a l |d|^(l-1)/r^(l+1). It is a times a derivative, by d along a line, of |d|^l P_l(s)
       over r^(l+1), with Legendre's polynomial P_l and the cosine s of the angle between d and the
       vector to the point. On the sphere |d| = rho, rho^l P_l is a trigonometric polynomial of
       degree l along each great circle, so by Bernstein's and Szego's inequality its gradient is at
       most l rho^(l-1).
    2. Terms up to degree 5 are known exactly and bounded by `sup_norm`. For the terms l >= 6,
       |d|^(l-1) <= R^(l-5) |d|^4, and sum_{l>=6} l q^(l-5) = q (6 - 5q)/(1-q)^2.
    3. Gradients. The term of degree l is a harmonic function that is homogeneous of degree -(l+1)
       in r. By the same inequality its gradient is at most (l+1)/r times its largest value on the
       sphere through the point. And
       sum_{l>=6} l (l+1) q^(l-5) = q (42 - 70q + 30q^2)/(1-q)^3.
    4. Second derivatives. The derivatives of the term along lines are harmonic and homogeneous of
       degree -(l+2), so that second derivatives are at most (l+1)(l+2)/r^2 times it. And
       sum_{l>=6} l (l+1) (l+2) q^(l-5) = q (336 - 840q + 720q^2 - 210q^3)/(1-q)^4.
    5. The bound of each term, times r^(k+1) for values, r^(k+2) for gradients or r^(k+3) for second
       derivatives, does not grow with r. So its value at `nearest` is a bound.

    The results are increased slightly for the rounding to single precision.
    """
    r = np.maximum(nearest, 1e-50)  # so that powers do not underflow
    # Callers have `nearest` of at least 1.5 radii; the limit of q only prevents a division by 0.
    q = np.minimum(level.radius / r, 0.99)
    k = order + 2
    # The terms of degree l >= 6 (steps 2 to 4), without their factor 1/r^(k+1) and so on.
    tail = level.fourth_moment * level.radius / r ** (6 - k)
    value = tail * (6 - 5 * q) / (1 - q) ** 2
    slope = tail * (42 - 70 * q + 30 * q * q) / (1 - q) ** 3
    second = tail * (336 - 840 * q + 720 * q * q - 210 * q**3) / (1 - q) ** 4
    # The terms of degree k to 5.
    for l in range(k, MAX_DEGREE + 1):
        term = sup_norm(level.moments, l) / r ** (l - k)
        value, slope, second = (
            value + term,
            slope + (l + 1) * term,
            second + (l + 1) * (l + 2) * term,
        )
    return _ROUND_UP * value, _ROUND_UP * slope, _ROUND_UP * second


def remainder_constants(level: NodeMoments, nearest_ratio: float) -> tuple[FloatArray, FloatArray]:
    """Compute numbers A and K, each (k,), for k nodes of a tree. They bound how much the potential
    f of a node's dipoles differs from its linear Taylor polynomial at a point x.

    level: the moments of the k nodes at one level of the tree.
    nearest_ratio: the smallest distance of x from the node's center, as a multiple of the node's
        radius.

    Let R be the node's radius, and r >= r0 = nearest_ratio R the distance of x from its center. At
    the distance t = q r from x, with q <= Q = `max_step_fraction(nearest_ratio)`, f differs from
    the linear polynomial by at most

        (A + K/r^2) t^2/r^4 Phi_1(q),   Phi_l(q) = ((1-q)^-(l+1) - 1 - (l+1)q)/q^2.

    Proof. The multipole term of degree l is at most B_l/r^(l+1), and its k-th derivative along a
    line is at most (l+k)!/l! B_l/r^(l+1+k) (the argument of `truncation_bounds`, k times). So
    Taylor's remainder is at most B_l Phi_l(q) t^2/r^(l+3). In Phi_l/Phi_1 the ratio of
    coefficients, (l+k)!/(l! (k+1)!), grows with k. So the quotient grows with q, and
    W_l = Phi_l(Q)/Phi_1(Q) is a bound. As r >= r0, the sum over all l is at most the formula with
    A = B_1 + W_2 B_2/r0 and K = sum_{l>=3} W_l B_l/r0^(l-3). For l >= 6,
    B_l <= l R^(l-5) sum a |d|^4 (a dipole has the area a and the offset d from the center) and
    Phi_l(Q) < (1-Q)^-(l+1)/Q^2.
    """
    # q: the number Q. 1e-50 prevents a division by zero for nodes of radius 0.
    r0, q = np.maximum(nearest_ratio * level.radius, 1e-50), max_step_fraction(nearest_ratio)
    # scaled_phi: Q^2 Phi_1(Q). weights[n]: W_n. terms[n - 1]: W_n B_n.
    scaled_phi = q * q * remainder_factor(q)
    weights = [((1 - q) ** -(n + 1) - 1 - (n + 1) * q) / scaled_phi for n in range(MAX_DEGREE + 1)]
    terms = [weights[n] * sup_norm(level.moments, n) for n in range(1, MAX_DEGREE + 1)]
    # The bounds for l >= 6 add up to `tail` times the fourth moment over r0^2. They contain the sum
    # of l y^(l-5) with y = R/(r0 (1 - Q)), which is y (6 - 5 y)/(1 - y)^2.
    y = 1 / (nearest_ratio * (1 - q))
    tail = y * (6 - 5 * y) / (1 - y) ** 2 / ((1 - q) ** 6 * scaled_phi)
    higher = tail * level.fourth_moment / r0**2 + sum(
        term / r0**n for n, term in enumerate(terms[2:])
    )
    return terms[0] + terms[1] / r0, higher
