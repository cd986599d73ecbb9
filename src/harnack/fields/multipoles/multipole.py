"""Moments of dipoles about the nodes of a tree.

`moments` says what they are. All in double precision: sums over dipoles and over children in
Dr.Jit, on many threads and without temporaries, the rest, of one row a node, in NumPy.
"""

# Harmonics have degree l.
# ruff: noqa: E741

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, choose_backend, to_numpy
from harnack.backend.arrays import aligned, aligned_integers
from harnack.backend.extrema import fmax, fmin
from harnack.fields.multipoles.moments import KEYS, KNOWN, Pairs, moved, of_dipole, regular
from harnack.tree import NO_PRIMITIVE, Hierarchy

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

Moments = dict[tuple[int, int], npt.NDArray[np.complex128]]
# Degree, order, and 0 for the real or 1 for the imaginary part.
_PARTS = tuple((l, m, part) for l, m in KEYS for part in range(2 if m else 1))
# Numbers of `_powers`.
_POWERS = 10


@dataclass(frozen=True)
class NodeMoments:
    """The nodes of one level of the tree.

    center: (k, 3) about which the moments are taken: the mean of the dipoles by area.
    radius: (k,) of a ball around it that holds all the dipoles.
    area: (k,) sum of a_i = |a_i n_i|.
    second, third, fourth: (k, 3, 3), (k, 3) and (k,) sums of a_i d_i d_i^T, of a_i |d_i|^2 d_i and
        of a_i |d_i|^4.
    moments: M_lm, (k,) each, for 1 <= l <= 5 and m >= 0.
    """

    center: FloatArray
    radius: FloatArray
    area: FloatArray
    second: FloatArray
    third: FloatArray
    fourth: FloatArray
    moments: Moments


def all_levels(
    tree: Hierarchy, points: FloatArray, normals: FloatArray, low: FloatArray, high: FloatArray
) -> list[NodeMoments]:
    """Moments of the nodes of all levels, from the leaves to the root.

    points, normals: (n, s, 3) dipoles of each of n primitives; a normal's length is its area.
    low, high: (n, 3) boxes that hold the primitives.
    """
    backend, each = choose_backend("double"), points.shape[1]
    p, n, lows, highs = (aligned(backend, x.ravel()) for x in (points, normals, low, high))

    def primitive(i: Any) -> _Primitive:
        dipoles = [
            _Dipole(_row(backend, n, i * each + k), ((1.0, _row(backend, p, i * each + k)),))
            for k in range(each)
        ]
        return _Primitive(dipoles, _row(backend, lows, i), _row(backend, highs, i))

    return _levels(backend, tree, primitive)


def triangle_levels(tree: Hierarchy, corners: FloatArray) -> list[NodeMoments]:
    """Moments of the nodes of all levels, for triangles (n, 3, 3): exact up to rounding."""
    backend = choose_backend("double")
    buffer = aligned(backend, corners.ravel())
    rule = tuple(zip(*(part.tolist() for part in triangle_rule()), strict=True))

    def primitive(i: Any) -> _Primitive:
        a, b, c = (_row(backend, buffer, 3 * i + k) for k in range(3))
        points = [(weight, a * u + b * v + c * w) for (u, v, w), weight in rule]
        dipole = _Dipole(0.5 * dr.cross(b - a, c - a), points)
        return _Primitive([dipole], fmin(fmin(a, b), c), fmax(fmax(a, b), c))

    return _levels(backend, tree, primitive)


@dataclass(frozen=True)
class _Dipole:
    """A dipole that is spread over points, with weights of sum 1. Its area is its length."""

    normal: Vec3
    points: Sequence[tuple[float, Vec3]]


@dataclass(frozen=True)
class _Primitive:
    """Its dipoles, and a box that holds it."""

    dipoles: Sequence[_Dipole]
    low: Vec3
    high: Vec3


def _row(backend: Backend, buffer: Real, i: Any) -> Vec3:
    return backend.Array3f(*(dr.gather(backend.Float, buffer, 3 * i + k) for k in range(3)))


def _levels(
    backend: Backend, tree: Hierarchy, primitive: Callable[[Any], _Primitive]
) -> list[NodeMoments]:
    level, parts, low, high = _leaves(backend, tree, primitive)
    levels = [level]
    for arity in tree.arities:
        low = low.reshape(-1, arity, 3).min(axis=1)
        high = high.reshape(-1, arity, 3).max(axis=1)
        level, parts = _parents(backend, level, parts, low, high)
        levels.append(level)
    return levels


def _leaves(
    backend: Backend, tree: Hierarchy, primitive: Callable[[Any], _Primitive]
) -> tuple[NodeMoments, list[Real], FloatArray, FloatArray]:
    """The leaves, their `_PARTS` on the backend, and boxes around them.

    One lane a leaf, which looks at its primitives twice: for the center, and about it.
    """
    index, real, vector = backend.UInt32, backend.Float, backend.Array3f
    filled = tree.slots != NO_PRIMITIVE
    slots = aligned_integers(backend, np.where(filled, tree.slots, 0).ravel())
    leaf = dr.arange(index, len(filled))
    first = leaf * dr.opaque(index, tree.leaf_size)
    end = first + dr.gather(index, aligned_integers(backend, filled.sum(axis=1)), leaf)

    def visit(body: Callable[..., tuple[Any, ...]], state: tuple[Any, ...]) -> tuple[Any, ...]:
        def step(slot: Any, *state: Any) -> tuple[Any, ...]:
            return slot + 1, *body(primitive(dr.gather(index, slots, slot)), *state)

        def more(slot: Any, *_: Any) -> Any:
            return slot < end

        return dr.while_loop((first, *state), more, step, label="slots")[1:]

    def measured(of: _Primitive, low: Vec3, high: Vec3, area: Real, weighted: Vec3) -> Any:
        for one in of.dipoles:
            size = dr.norm(one.normal)
            area, weighted = area + size, weighted + size * sum(w * p for w, p in one.points)
        return fmin(low, of.low), fmax(high, of.high), area, weighted

    def summed(of: _Primitive, *parts: Real) -> tuple[Any, ...]:
        for one in of.dipoles:
            away = [(weight, point - center) for weight, point in one.points]
            more = _powers(dr.norm(one.normal), away) + _flat(_spread_out(one.normal, away))
            parts = tuple(a + b for a, b in zip(parts, more, strict=True))
        return parts

    nothing = (vector(dr.inf), vector(-dr.inf), real(0), vector(0))
    low, high, area, weighted = visit(measured, nothing)
    # The mean of positions by area, or the box's middle where there is no area.
    center = dr.select(area > 0, weighted / dr.select(area > 0, area, 1), 0.5 * (low + high))
    sums = visit(summed, (real(0),) * (_POWERS + len(_PARTS)))
    powers, parts = sums[:_POWERS], sums[_POWERS:]
    dr.eval(low, high, area, center, *sums)
    boxes = to_numpy(low), to_numpy(high)
    at, (xx, yy, zz, xy, xz, yz, *third, fourth) = to_numpy(center), map(to_numpy, powers)
    second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    sizes = to_numpy(area), second, np.stack(third, axis=1), fourth
    return NodeMoments(at, _reach(at, *boxes), *sizes, _moments_of(parts)), list(parts), *boxes


def _powers(area: Real, points: Sequence[tuple[float, Vec3]]) -> list[Real]:
    """A dipole's part of `second` (xx, yy, zz, xy, xz, yz), `third` and `fourth`."""
    total: list[Real] = [area * 0] * _POWERS
    for weight, d in points:
        square, share = dr.squared_norm(d), weight * area
        pairs = (d.x * d.x, d.y * d.y, d.z * d.z, d.x * d.y, d.x * d.z, d.y * d.z)
        powers = (*pairs, *(square * d), square * square)
        total = [dr.fma(share, one, old) for one, old in zip(powers, total, strict=True)]
    return total


def _spread_out(normal: Vec3, points: Sequence[tuple[float, Vec3]]) -> Pairs:
    means: Pairs = {}
    for weight, d in points:
        for key, (re, im) in regular(d.x, d.y, d.z, KNOWN - 1).items():
            a, b = means.get(key, (0.0, 0.0))
            means[key] = a + weight * re, b + weight * im
    return of_dipole(means, normal.x, normal.y, normal.z)


def _flat(moments: Pairs) -> list[Any]:
    """Real and imaginary parts, as many as there are in `_PARTS`."""
    return [moments[l, m][part] for l, m, part in _PARTS]


def _moments_of(parts: Sequence[Real]) -> Moments:
    out = {key: np.zeros(dr.width(parts[0]), np.complex128) for key in KEYS}
    for (l, m, part), values in zip(_PARTS, parts, strict=True):
        if part:
            out[l, m].imag = to_numpy(values)
        else:
            out[l, m].real = to_numpy(values)
    return out


def _parents(
    backend: Backend, below: NodeMoments, parts: list[Real], low: FloatArray, high: FloatArray
) -> tuple[NodeMoments, list[Real]]:
    """The level above, whose boxes are given, and its `_PARTS`."""
    count, arity = len(low), len(below.area) // len(low)
    area = below.area.reshape(-1, arity).sum(axis=1)
    weighted = (below.area[:, None] * below.center).reshape(-1, arity, 3).sum(axis=1)
    some = (area > 0)[:, None]
    center = np.where(some, weighted / np.where(some, area[:, None], 1), 0.5 * (low + high))
    shift = below.center - np.repeat(center, arity, axis=0)
    given: Pairs = dict.fromkeys(KEYS, (0.0, 0.0))
    for (l, m, part), values in zip(_PARTS, parts, strict=True):
        given[l, m] = (given[l, m][0], values) if part else (values, 0.0)
    found = _flat(moved(given, *(aligned(backend, one) for one in shift.T)))
    dr.eval(*found)
    first = arity * dr.arange(backend.UInt32, count)
    sums = [sum(dr.gather(backend.Float, one, first + k) for k in range(arity)) for one in found]
    dr.eval(*sums)
    second, third, fourth = (
        one.reshape(count, arity, *one.shape[1:]).sum(axis=1) for one in _moved(below, shift)
    )
    reach, moments = _reach(center, low, high), _moments_of(sums)
    return NodeMoments(center, reach, area, second, third, fourth, moments), sums


def _moved(level: NodeMoments, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Second, third and fourth about center - s: what they are of d + s. About its own center a
    node has no first moment."""
    a, square = level.area[:, None], (s * s).sum(axis=1)
    trace, bent = np.einsum("kii->k", level.second), np.einsum("kij,kj->ki", level.second, s)
    second = level.second + a[:, None] * s[:, :, None] * s[:, None]
    third = level.third + trace[:, None] * s + 2 * bent + a * square[:, None] * s
    fourth = level.fourth + 2 * trace * square + level.area * square * square
    return second, third, fourth + 4 * ((level.third + bent) * s).sum(axis=1)


def _reach(center: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Distance from the center to the farthest corner of the box."""
    return np.linalg.norm(np.maximum(high - center, center - low), axis=1)


def cartesian(moments: Moments, order: int = 2) -> FloatArray:
    """(k, 15) coefficients of the terms l <= order + 1, as `multipole_kernel` reads them.

    Term l is P_l(r)/r^(2l+1) with harmonic polynomials P_1 = D.r; P_2 with the coefficients of
    xx, yy, 2xy, 2xz, 2yz (zz follows: the trace is zero); P_3 with those of xyy, xzz, xxy, yzz,
    xxz, yyz, xyz (x^3, y^3, z^3 follow).
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
    kept = -np.stack([*dipole, *quadrupole, *octupole], axis=1)
    kept[:, (3, 8, 15)[order] :] = 0
    return kept


def triangle_rule() -> tuple[FloatArray, FloatArray]:
    """Barycentric coordinates (6, 3) of points in a triangle, and their weights (6,), sum 1.

    They integrate polynomials of degree at most four exactly, and so give exact moments for
    l <= 5: Dunavant's six-point rule (1985).
    """
    rule = ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322))
    points: list[tuple[float, float, float]] = []
    for corner, _ in rule:
        apex = 1 - 2 * corner
        points += [(apex, corner, corner), (corner, apex, corner), (corner, corner, apex)]
    return np.array(points), np.repeat([weight for _, weight in rule], 3)
