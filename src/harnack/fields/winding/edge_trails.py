"""The solid angle of boundary edges at many points: values alone, and as fast as they will go.

The formula is that of `edge_lift`, arranged so that little is done twice. The boundary of a chain
of triangles enters every vertex as often as it leaves it, so that its edges make up closed
trails, and what a factor needs of a vertex is computed once and not once for each of its edges;
a record of edges is fetched once for eight points; nothing is divided. Points about which rounding
could have decided wrongly are told apart, for `edge_lift` to do again.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import drjit as dr
import numpy as np

from harnack.backend.extrema import fmax, fmin
from harnack.backend.lengths import largest_coordinate
from harnack.backend.records import Records

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, IntArray, Mask, Real, Vec3

# Edges of a record: its five vertices and the number of its edges fill two packets of eight.
_EDGES = 4
# Points of a lane: as many as registers hold, by experiment.
_POINTS = 3
# Sides closer to zero than this many rounding errors of their products are not trusted; theirs
# are six at most, those of `tree.triangles.side` one.
_UNSURE = 16
# Beyond this distance, in sizes of the mesh, the products of lengths could leave float32.
_FAR = 1024.0

# A point, and 1 or -1 for the way that its ray goes along the z axis.
Point: TypeAlias = "tuple[Vec3, Real]"
Complex: TypeAlias = "tuple[Real, Real]"
# u (|a| + |z|), v (|a| + |z|) and s of a vertex.
Seen: TypeAlias = "tuple[Real, Real, Real]"


@dataclass(frozen=True)
class _Bits:
    """What the formats of floating-point numbers differ in."""

    integer: Any
    mantissa: int
    bias: int

    @classmethod
    def of(cls, backend: Backend) -> _Bits:
        mantissa, bias = (23, 127) if backend.precision == "single" else (52, 1023)
        return cls(dr.int_array_t(backend.Float), mantissa, bias)

    def sign(self, x: Real) -> Any:
        """-1 where the sign bit is set, also for -0, else 0."""
        bits = dr.reinterpret_array(self.integer, x)
        return bits >> (self.mantissa + self.bias.bit_length() + 1)

    def about_one_over(self, x: Real) -> Real:
        """The power of two that brings x > 0 between one and two."""
        exponent = dr.reinterpret_array(self.integer, x) & ((2 * self.bias + 1) << self.mantissa)
        return dr.reinterpret_array(type(x), (2 * self.bias << self.mantissa) - exponent)


@dataclass(frozen=True)
class _Product:
    """A product of factors whose arguments are counted on.

    z = x + iy, of any length; half: how many half planes round it is, so that the sum theta of
    the factors' principal arguments lies in [half pi, (half + 1) pi]. The sign bit of y is
    half's parity.
    """

    x: Real
    y: Real
    half: Any

    @classmethod
    def of(cls, bits: _Bits, factor: Complex) -> _Product:
        return cls(*factor, bits.sign(factor[1]))

    def times(self, bits: _Bits, factor: Complex) -> _Product:
        """The product with one factor more.

        Its argument, in [-pi, pi], takes theta at most one half plane on, or one back if the sign
        bit of its imaginary part is set; and on (or back) it is exactly if the sign of y changes.
        That holds for the computed y as well: it has a sign other than its exact value's only
        if its two terms cancel, and then the exact theta is about the very multiple of pi that
        the count takes it over (arguments of like signs and y x' < 0: about +-pi; of unlike
        signs: about 0). A term that underflows keeps its sign bit.
        """
        x = dr.fma(self.x, factor[0], -(self.y * factor[1]))
        y = dr.fma(self.x, factor[1], self.y * factor[0])
        changes = bits.sign(self.y) ^ bits.sign(y)
        return _Product(x, y, self.half + (changes & (bits.sign(factor[1]) | 1)))

    def times_product(self, bits: _Bits, other: _Product) -> _Product:
        """The product with another, whose own turns are added."""
        z = self.times(bits, (other.x, other.y))
        return _Product(z.x, z.y, z.half + ((other.half + 1) & -2))

    def scaled(self, bits: _Bits) -> tuple[_Product, Real]:
        """The same of length about one, and how long it was; a power of two rounds nothing."""
        length = dr.abs(self.x) + dr.abs(self.y)
        scale = bits.about_one_over(length)
        return _Product(self.x * scale, self.y * scale, self.half), length

    def turns(self) -> Real:
        """theta/(2 pi)."""
        real = cast("Any", type(self.x))
        # atan2 takes no notice of the sign of a zero.
        y = dr.copysign(fmax(dr.abs(self.y), real(1e-30)), self.y)
        return dr.fma(dr.atan2(y, self.x), 0.5 / dr.pi, real((self.half + 1) >> 1))


@dataclass(frozen=True)
class EdgeTrails:
    """Directed edges on the device, as records of consecutive edges of closed trails."""

    records: Records

    @classmethod
    def upload(cls, backend: Backend, vertices: FloatArray, edges: IntArray) -> EdgeTrails:
        """Edges (k, 2) between vertices (n, 3), as often out of a vertex as into it."""
        rows: list[FloatArray] = []
        for trail in closed_trails(edges):
            count = len(trail) - 1
            trips = -(-count // _EDGES)
            first = _EDGES * np.arange(trips)[:, None]
            index = np.minimum(first + np.arange(_EDGES + 1), count)
            filled = np.minimum(count - first, _EDGES)
            rows.append(np.concatenate([vertices[trail[index]].reshape(trips, -1), filled], 1))
        return cls(Records.upload(backend, np.concatenate(rows)))

    def turns(self, x: Vec3, way: Real) -> tuple[Real, Mask]:
        """1/(4 pi) times the sum of Omega_e at points x, and whether to doubt it.

        way: 1 for the direction d = z; -1 for x and the edges mirrored in a plane z = const.
        Each lane of the kernel takes several points. Doubt is where a side is nearer to zero
        than rounding can tell, where a factor is (beside an edge or a short one), and far away.
        """
        dr.eval(x, way)
        backend, n = self.records.backend, dr.width(x)
        real, index = backend.Float, backend.UInt32
        lanes = -(-n // _POINTS)
        lane = dr.arange(index, lanes)
        places = [dr.minimum(lane + k * lanes, n - 1) for k in range(_POINTS)]
        points = [
            (dr.gather(backend.Array3f, x, place), dr.gather(real, way, place)) for place in places
        ]
        products, doubts = self._over_records(points)
        turns = [-one.turns() for one in products]  # of conjugate factors
        dr.eval(*turns, *doubts)
        order = dr.arange(index, n)
        some = dr.gather(real, dr.concat(doubts), order) <= 0
        far = largest_coordinate(x) > _FAR
        return dr.gather(real, dr.concat(turns), order), some | far

    def _over_records(self, points: list[Point]) -> tuple[list[_Product], list[Real]]:
        """For each point the product of all factors, and a number below 0 where it is in doubt."""
        backend = self.records.backend
        real, bits = backend.Float, _Bits.of(backend)
        slack = real(-_UNSURE * 0.5 * backend.epsilon)

        def add(row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
            # Edges that fill a record up are from a vertex to itself: no doubt about those.
            slacks = [dr.select(row[15] > k, slack, 1) for k in range(_EDGES)]
            pairs = zip(points, state, strict=True)
            return tuple(_with_record(bits, row, slacks, x, old) for x, old in pairs)

        one = (real(1), real(0), bits.integer(0), real(1))
        out = self.records.for_each(add, tuple(one for _ in points), "trails")
        return [_Product(*one[:3]) for one in out], [one[3] for one in out]


def _with_record(
    bits: _Bits, row: list[Real], slacks: list[Real], x: Point, state: tuple[Any, ...]
) -> tuple[Any, ...]:
    """The product (x, y, half) and the doubt with the four edges of a record.

    They are multiplied among themselves first: that product has an argument of nearly zero, at
    which rounding costs least.
    """
    z, doubt = _Product(*state[:3]), state[3]
    smallest = 2.0**-100 if bits.mantissa < 50 else 2.0**-800
    a = _seen(bits, row[0:3], x)
    part: _Product | None = None
    for k in range(_EDGES):
        b = _seen(bits, row[3 * k + 3 : 3 * k + 6], x)
        factor, sure = _factor(a, b, slacks[k])
        doubt = fmin(sure, doubt)
        part = _Product.of(bits, factor) if part is None else part.times(bits, factor)
        if k == 1:
            part, length = part.scaled(bits)
            doubt = fmin(length - smallest, doubt)
        a = b
    z, length = z.times_product(bits, cast("_Product", part)).scaled(bits)
    return z.x, z.y, z.half, fmin(length - smallest, doubt)


def _seen(bits: _Bits, vertex: list[Real], point: Point) -> Seen:
    """A vertex from a point: (u t, v t, s t) with t = |a| + |z| and s = |a| - way z.

    s t is (|a| + |z|)^2 or u^2 + v^2: there is no difference that could cancel.
    """
    x, way = point
    u, v, z = vertex[0] - x[0], vertex[1] - x[1], vertex[2] - x[2]
    across = dr.fma(u, u, v * v)
    t = dr.sqrt(dr.fma(z, z, across)) + dr.abs(z)
    signs = dr.reinterpret_array(bits.integer, z) ^ dr.reinterpret_array(bits.integer, way)
    s = dr.select(signs < 0, t * t, across)
    return u * t, v * t, s


def _factor(a: Seen, b: Seen, slack: Real) -> tuple[Complex, Real]:
    """The conjugate of F_e times something positive; and a number below 0 where it is in doubt."""
    back = a[1] * b[0]
    im = dr.fma(a[0], b[1], -back)
    re = dr.fma(a[2], b[2], dr.fma(a[0], b[0], a[1] * b[1]))
    return (re, im), dr.fma(dr.abs(back), slack, dr.abs(im))


def closed_trails(edges: IntArray) -> list[IntArray]:
    """Directed edges (k, 2) as trails of vertices, each ending where it begins; each edge once.

    Raises:
        ValueError: an edge leads to where none goes on.
    """
    onwards: defaultdict[int, list[int]] = defaultdict(list)
    for a, b in edges.tolist():
        onwards[a].append(b)
    trails: list[IntArray] = []
    for start in list(onwards):
        while onwards[start]:
            trail = [start]
            while onwards[trail[-1]]:
                trail.append(onwards[trail[-1]].pop())
            if trail[-1] != start:
                raise ValueError(f"edges: not closed, more go to vertex {trail[-1]} than from it")
            trails.append(np.array(trail, np.int64))
    return trails
