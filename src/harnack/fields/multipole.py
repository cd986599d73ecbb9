"""Multipole moments of dipoles about the nodes of a tree, and what leaving terms out may cost.

The potential of dipoles a_i n_i at y_i = c + d_i is, seen from x = c + r,

    f(x) = sum_i a_i n_i.(y_i - x)/|y_i - x|^3 = -sum_i a_i n_i.grad_y 1/|x - y_i|
         = -sum_{l>=1} sum_m conj(M_lm) I_lm(r),      M_lm = sum_i a_i n_i.grad R_lm(d_i)

with solid harmonics R_lm = r^l P_lm(cos t) e^(im p)/(l+m)! and I_lm = (l-m)! P_lm e^(im p)/r^(l+1)
(no Condon-Shortley phase; R_l,-m = (-1)^m conj R_lm). 1/|x-y| = sum conj(R_lm(y)) I_lm(x),
R_lm(a+b) = sum R_l'm'(a) R_l-l',m-m'(b), d/dz R_lm = R_l-1,m, (d/dx + i d/dy) R_lm = -R_l-1,m+1,
(d/dx - i d/dy) R_lm = R_l-1,m-1. All of these are held by tests. Plain NumPy in double precision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from harnack.tree import Hierarchy

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]
Moments = dict[tuple[int, int], ComplexArray]

# Terms up to here are computed. Dipole, quadrupole and octupole (orders 0, 1 and 2 of Barill et
# al. 2018) are kept, the others measure what is left out.
_KNOWN = 5
_DEGREES = tuple((degree, m) for degree in range(1, _KNOWN + 1) for m in range(degree + 1))
_LEAVES_AT_ONCE = 8192


@dataclass(frozen=True)
class Level:
    """The nodes of one level of the tree.

    centre: (k, 3) about which the moments are taken: the mean of the dipoles by area.
    radius: (k,) of a ball around it that holds all the dipoles.
    area, spread: (k,) sums of a_i = |a_i n_i| and of a_i |d_i|^2.
    moments: M_lm, (k,) each, for 1 <= l <= 5 and m >= 0.
    """

    centre: FloatArray
    radius: FloatArray
    area: FloatArray
    spread: FloatArray
    moments: Moments


def regular(d: FloatArray, order: int) -> Moments:
    """R_lm(d) for l <= order, 0 <= m <= l."""
    x, y, z = np.moveaxis(d, -1, 0)
    r2, across = x * x + y * y + z * z, x + 1j * y
    out: Moments = {(0, 0): np.ones(x.shape, np.complex128)}
    for m in range(order + 1):
        if m:
            out[m, m] = out[m - 1, m - 1] * across / (2 * m)
        for l in range(m + 1, order + 1):  # noqa: E741
            above = (2 * l - 1) * z * out[l - 1, m]
            if l - 2 >= m:
                above = above - r2 * out[l - 2, m]
            out[l, m] = above / ((l + m) * (l - m))
    return out


def _at(values: Moments, l: int, m: int) -> ComplexArray | float:  # noqa: E741
    """R_lm or M_lm for any m; zero where |m| > l."""
    if abs(m) > l:
        return 0.0
    return values[l, m] if m >= 0 else (-1) ** m * values[l, -m].conj()


def of_dipoles(d: FloatArray, normal: FloatArray) -> Moments:
    """M_lm of dipoles `normal` (k, s, 3), areas in their lengths, at d (k, s, 3): sums over s."""
    harmonics = regular(d, _KNOWN - 1)
    across = 0.5 * (normal[..., 0] + 1j * normal[..., 1])
    nz = normal[..., 2]
    return {
        (degree, m): np.asarray(
            nz * _at(harmonics, degree - 1, m)
            - across.conj() * _at(harmonics, degree - 1, m + 1)
            + across * _at(harmonics, degree - 1, m - 1)
        ).sum(axis=1)
        for degree, m in _DEGREES
    }


def moved(moments: Moments, shift: FloatArray) -> Moments:
    """Moments about c of dipoles whose moments about c + shift (k, 3) are given."""
    harmonics = regular(shift, _KNOWN - 1)
    out: Moments = {}
    for l, m in moments:  # noqa: E741
        total = moments[l, m].copy()
        for k in range(1, l):
            for j in range(-k, k + 1):
                if abs(m - j) <= l - k:
                    total += _at(moments, k, j) * _at(harmonics, l - k, m - j)
        out[l, m] = total
    return out


def all_levels(tree: Hierarchy, points: FloatArray, normals: FloatArray, low: FloatArray,
               high: FloatArray) -> list[Level]:  # fmt: skip
    """Moments of the nodes of all levels, from the leaves to the root.

    points, normals: (n, s, 3) dipoles of each of n primitives; a normal's length is its area.
    low, high: (n, 3) boxes that hold the primitives.
    """
    low, high = tree.gather(low, np.inf).min(axis=1), tree.gather(high, -np.inf).max(axis=1)
    levels = [_leaves(tree, points, normals, low, high)]
    for arity in tree.arities:
        low = low.reshape(-1, arity, 3).min(axis=1)
        high = high.reshape(-1, arity, 3).max(axis=1)
        levels.append(_parents(levels[-1], arity, low, high))
    return levels


def _leaves(tree: Hierarchy, points: FloatArray, normals: FloatArray, low: FloatArray,
            high: FloatArray) -> Level:  # fmt: skip
    parts: list[Level] = []
    for start in range(0, len(tree.slots), _LEAVES_AT_ONCE):
        rows = slice(start, start + _LEAVES_AT_ONCE)
        some = Hierarchy(tree.slots[rows], ())
        p = some.gather(points).reshape(len(some.slots), -1, 3)
        n = some.gather(normals).reshape(len(some.slots), -1, 3)
        size = np.linalg.norm(n, axis=2)
        area = size.sum(axis=1)
        centre = _centre((size[..., None] * p).sum(axis=1), area, low[rows], high[rows])
        d = p - centre[:, None]
        spread = (size * (d * d).sum(axis=2)).sum(axis=1)
        reach = _reach(centre, low[rows], high[rows])
        parts.append(Level(centre, reach, area, spread, of_dipoles(d, n)))
    joined = {
        key: np.concatenate([part.moments[key] for part in parts]) for key in parts[0].moments
    }
    return Level(
        np.concatenate([part.centre for part in parts]),
        np.concatenate([part.radius for part in parts]),
        np.concatenate([part.area for part in parts]),
        np.concatenate([part.spread for part in parts]),
        joined,
    )


def _parents(children: Level, arity: int, low: FloatArray, high: FloatArray) -> Level:
    area = children.area.reshape(-1, arity).sum(axis=1)
    weighted = (children.area[:, None] * children.centre).reshape(-1, arity, 3).sum(axis=1)
    centre = _centre(weighted, area, low, high)
    shift = children.centre - np.repeat(centre, arity, axis=0)
    moments = moved(children.moments, shift)
    summed = {key: value.reshape(-1, arity).sum(axis=1) for key, value in moments.items()}
    # About its own mean a child has no first moment, so that the squares add up.
    wider = children.spread + children.area * (shift * shift).sum(axis=1)
    spread = wider.reshape(-1, arity).sum(axis=1)
    return Level(centre, _reach(centre, low, high), area, spread, summed)


def _centre(
    weighted: FloatArray, area: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """The mean of positions weighted by area, or the box's middle where there is no area."""
    some = area > 0
    mean = weighted / np.where(some, area, 1)[:, None]
    return np.where(some[:, None], mean, 0.5 * (low + high))


def _reach(centre: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Distance from the centre to the farthest corner of the box."""
    return np.linalg.norm(np.maximum(high - centre, centre - low), axis=1)


def sup_norm(moments: Moments, l: int) -> FloatArray:  # noqa: E741
    """A bound of |term l| r^(l+1) over all directions.

    For unit x, y the addition theorem gives sum_m |I_lm(x)|^2 / ((l+m)!(l-m)!) = P_l(1) = 1, so
    by Cauchy and Schwarz |sum_m conj(M_lm) I_lm|^2 <= sum_m (l+m)! (l-m)! |M_lm|^2.
    """
    total = 0.0
    for m in range(l + 1):
        weight = math.factorial(l + m) * math.factorial(l - m) * (1 if m == 0 else 2)
        total = total + weight * np.abs(moments[l, m]) ** 2
    return np.sqrt(np.asarray(total))


def truncation(level: Level, nearest: FloatArray, order: int = 2) -> tuple[FloatArray, FloatArray]:
    """(E, G): seen from r >= nearest, what the terms l >= order + 2 =: k add to f is at most
    E/r^(k+1) in value and G/r^(k+2) in gradient.

    A dipole of area a at d gives the term l at most a l |d|^(l-1)/r^(l+1): on the sphere
    rho^l P_l is a trigonometric polynomial of degree l along each great circle, so by Bernstein's
    and Szego's inequality its gradient is at most l rho^(l-1). Terms up to 5 are known exactly and
    bounded by `sup_norm`; for the rest |d|^(l-1) <= R^(l-3) |d|^2 and
    sum_{l>=6} l q^(l-1) = q^5 (6 - 5q)/(1-q)^2 with q = R/r. A harmonic function of degree
    -(l+1) has, by the same inequality, a gradient of at most l+1 times its largest value on the
    sphere through the point; the rest is then sum_{l>=6} l (l+1) q^(l-1)
    = q^5 (42 - 70q + 30q^2)/(1-q)^3. Each term times r^(k+1) (r^(k+2)) falls or stays as r
    grows, so the value at `nearest` serves.
    """
    r = np.maximum(nearest, 1e-300)
    q = np.minimum(level.radius / r, 0.99)
    k = order + 2
    rest = level.spread * level.radius**3 / r ** (6 - k)
    value = rest * (6 - 5 * q) / (1 - q) ** 2
    slope = rest * (42 - 70 * q + 30 * q * q) / (1 - q) ** 3
    for l in range(k, _KNOWN + 1):  # noqa: E741
        term = sup_norm(level.moments, l) / r ** (l - k)
        value, slope = value + term, slope + (l + 1) * term
    return value, slope


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


def triangle_dipoles(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points and normals (n, 6, 3) that have the moments l <= 5 of triangles (n, 3, 3) exactly.

    They are integrals of polynomials of degree at most four: Dunavant's six-point rule (1985).
    """
    rule = ((0.445948490915965, 0.223381589678011), (0.091576213509771, 0.109951743655322))
    weights: list[float] = []
    barycentric: list[tuple[float, float, float]] = []
    for corner, weight in rule:
        apex = 1 - 2 * corner
        for one in ((apex, corner, corner), (corner, apex, corner), (corner, corner, apex)):
            barycentric.append(one)
            weights.append(weight)
    points = np.einsum("qv,nvk->nqk", np.array(barycentric), corners)
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return points, np.array(weights)[None, :, None] * normal[:, None]
