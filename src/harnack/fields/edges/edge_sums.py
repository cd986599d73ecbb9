"""One pass over the edges of a curve: solid angle, its gradient, distance and variation.

The only loop that costs anything in a trace of a curve, so it is written for throughput: eight
edges a trip, vertices fetched in aligned packets of eight floats, one square root, one division
and about eighty additions and multiplications an edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import aligned
from harnack.backend.extrema import clamp, fmin

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3

# Two complex numbers, as four reals.
Spinor: TypeAlias = "tuple[Real, Real, Real, Real]"

# The largest 1/length^2 of a record, within the range of float32. Edges that have no length, for
# padding or by rounding, have it too: no angle, no gradient, hardly any variation.
_SHARPEST = 1e30
# Often, and without squares: beside a vertex or far away, the product of a few factors leaves the
# range of float32.
_RENORMALISE_EVERY = 2


@dataclass(frozen=True)
class EdgeBuffer:
    """Edges on the device: `trips` records of `chunk` consecutive edges each.

    A record holds chunk + 1 vertices as (x, y, z, 1/|edge to the next|^2), padded to packets of
    eight floats. Records do not lean on each other, so several loops need no special case.
    """

    backend: Backend
    buffer: Any
    trips: Any
    chunk: int

    @property
    def packets(self) -> int:
        return -(-4 * (self.chunk + 1) // 8)


@dataclass(frozen=True)
class EdgeSums:
    """Sums over all edges at x: Omega in (-2pi, 2pi], its gradient, distance to the nearest edge,
    and (if asked for) sums of a/(d sqrt(d^2+a^2)) and of the same over d, where d is the
    distance to an edge and a half its length."""

    angle: Real
    gradient: Vec3
    distance: Real
    first: Real
    second: Real


def chunk_for(loops: tuple[npt.NDArray[np.float64], ...]) -> int:
    """Eight edges a trip, or four where eight would be mostly padding."""
    edges = sum(len(loop) for loop in loops)
    padded = sum(-(-len(loop) // 8) * 8 for loop in loops)
    return 8 if padded <= 1.2 * edges else 4


def upload(backend: Backend, loops: tuple[npt.NDArray[np.float64], ...]) -> EdgeBuffer:
    """Records of the edges of closed loops, each of shape (n, 3)."""
    chunk = chunk_for(loops)
    cast = np.float64 if backend.precision == "double" else np.float32
    rounded = (loop.astype(cast).astype(np.float64) for loop in loops)
    records = np.concatenate([_records(loop, chunk) for loop in rounded])
    trips = dr.opaque(backend.UInt32, len(records))
    return EdgeBuffer(backend, aligned(backend, records.ravel().astype(cast)), trips, chunk)


def inverse_squares(edges: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """1/length^2 of edges (k, 3), (k,), or the largest number that records hold, if less.

    Too small a number makes no distance too long: the foot of the perpendicular ends nearer to
    the edge's start than it should by less than the edge's length, at most 1e-15, far below the
    rounding of distances. Nor a variation too small: 1/sqrt(d^2 (1 + 4 d^2/length^2)) grows.
    """
    squared = (edges * edges).sum(axis=1)
    return 1 / np.maximum(squared, 1 / _SHARPEST)


def _records(loop: npt.NDArray[np.float64], chunk: int) -> npt.NDArray[np.float64]:
    trips = -(-len(loop) // chunk)
    stays = np.repeat(loop[:1], trips * chunk + 1 - len(loop), axis=0)
    path = np.concatenate([loop, stays])  # back to the start, then degenerate edges
    inverse = inverse_squares(path[1:] - path[:-1])
    rows = np.concatenate([path, np.append(inverse, 0.0)[:, None]], axis=1)
    index = np.arange(trips)[:, None] * chunk + np.arange(chunk + 1)[None, :]
    flat = rows[index].reshape(trips, -1)
    return np.pad(flat, ((0, 0), (0, -flat.shape[1] % 8)))


def sum_over_edges(edges: EdgeBuffer, x: Vec3, *, variation: bool) -> EdgeSums:
    """All sums at x in one loop.

    Solid angle. For unit spinors chi(a) of the directions a = p_i - x, the product of
    <chi(p_i), chi(p_{i+1})> around a closed loop has argument Omega/2 (the Berry phase of spin
    1/2; it equals the fan formula of van Oosterom and Strackee 1983, Eq. 10, with the apex at
    infinity). With s = |a| + |a_z| and A = a_x + i a_y, chi is (s, A) above and (conj A, s)
    below: neither cancels, and the gauge drops out because each vertex enters once plain and
    once conjugated. A factor vanishes only on its own edge: there is no apex to be in line with.

    Gradient. Biot-Savart: each edge gives (1/|a|+1/|b|)/(|a||b|+a.b) a x b (Eq. 11). The
    bracket cancels beside the edge; |factor|^2 = 2 s_a s_b (|a||b|+a.b) does not.
    """
    real, vector = edges.backend.Float, edges.backend.Array3f
    wide, index = edges.backend.ArrayXf, edges.backend.UInt32
    x = vector(x)

    def body(i: Any, zr: Real, zi: Real, g: Vec3, d2: Real, s1: Real, s2: Real) -> Any:
        row: list[Real] = []
        for k in range(edges.packets):
            eight = dr.gather(wide, edges.buffer, i * edges.packets + k, shape=(8, 1))
            row += [eight[j] for j in range(8)]
        p = vector(row[0], row[1], row[2])
        a = p - x
        la, sa, ca = spinor(a)
        for j in range(edges.chunk):
            q = vector(row[4 * j + 4], row[4 * j + 5], row[4 * j + 6])
            inverse = row[4 * j + 3]
            b = q - x
            lb, sb, cb = spinor(b)
            re, im = inner_product(ca, cb)
            zr, zi = dr.fma(zr, re, -(zi * im)), dr.fma(zr, im, zi * re)
            if j % _RENORMALISE_EVERY == _RENORMALISE_EVERY - 1:
                scale = dr.rcp(dr.abs(zr) + dr.abs(zi))
                zr, zi = zr * scale, zi * scale
            e = q - p
            weight = (la + lb) * (sa * sb) / (la * lb * dr.fma(re, re, im * im))
            g = dr.fma(vector(weight), dr.cross(a, e), g)
            foot = clamp(-dr.dot(a, e) * inverse, real(0), real(1))
            near = dr.squared_norm(dr.fma(vector(foot), e, a))
            d2 = fmin(near, d2)
            if variation:
                first = dr.rsqrt(near * dr.fma(near, 4 * inverse, 1))
                s1 = s1 + first
                s2 = dr.fma(first, dr.rsqrt(near), s2)
            p, a, la, sa, ca = q, b, lb, sb, cb
        return i + 1, zr, zi, g, d2, s1, s2

    def more(i: Any, *_: Any) -> Any:
        return i < edges.trips

    start = (index(0), real(1), real(0), vector(0), real(dr.inf), real(0), real(0))
    _, zr, zi, g, d2, s1, s2 = dr.while_loop(start, more, body, label="edges")
    return EdgeSums(2 * dr.atan2(zi, zr), 2 * g, dr.sqrt(d2), s1, s2)


def inner_product(a: Spinor, b: Spinor) -> tuple[Real, Real]:
    """<a, b> as (real, imaginary), conjugate-linear in a."""
    re = dr.fma(a[0], b[0], dr.fma(a[1], b[1], dr.fma(a[2], b[2], a[3] * b[3])))
    im = dr.fma(a[0], b[1], dr.fma(a[2], b[3], -dr.fma(a[1], b[0], a[3] * b[2])))
    return re, im


def spinor(a: Vec3) -> tuple[Real, Real, Spinor]:
    """|a|, |a| + |a_z| and the (unnormalised) spinor of direction a as four reals."""
    length = dr.sqrt(dr.fma(a.z, a.z, dr.fma(a.x, a.x, a.y * a.y)))
    s = length + dr.abs(a.z)
    up = a.z >= 0
    chi = (
        dr.select(up, s, a.x),
        dr.select(up, 0, -a.y),
        dr.select(up, a.x, s),
        dr.select(up, a.y, 0),
    )
    return length, s, chi
