"""The signed distance from an outline in the plane, and what it does along a line of the plane.

Edges are read in a loop. Where there are many, chains of consecutive edges are skipped by their
boxes, so that an outline of 1,000 edges costs about as much as one of 100 (`OutlineEdges`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.elementary import clamp, fmax, fmin
from harnack.backend.record_table import RecordTable
from harnack.enclosures import Enclosure, LevelGaps
from harnack.fields.solids.tube import TangentEnclosure, min_with_tangent

if TYPE_CHECKING:
    from harnack.backend import Backend, Mask, Real
    from harnack.geometry.outline_loops import Outline

# The number of edges from which on they are read by chains.
_MANY = 48
# The inner knots of the bound along a line, as fractions of the length asked for, and how far that
# length is taken to be, in multiples of coordinates, for a ray without an end.
_KNOTS = (0.0625, 0.125, 0.25, 0.5)
_FAR = 8.0
_ROUNDINGS = 4.0


@dataclass(frozen=True)
class OutlineSample:
    """What is known of the signed distance d at points of the plane.

    value: d, negative inside. gradient: (d_x, d_y), a unit vector. error, gradient_error: of them.
    second_derivative: the second derivative across the gradient: 1/d beside a vertex, else 0.
    lower_bounds: lower bounds of |d| along the line at knots, less |d| here, rounding included.
    """

    value: Real
    gradient: tuple[Real, Real]
    error: Real
    gradient_error: Real
    second_derivative: Real = 0.0
    lower_bounds: tuple[Real, ...] = ()


@dataclass(frozen=True)
class OutlineEdges:
    """The edges of an outline on a backend.

    edges: (ax, ay, bx, by, 1/length^2) from a to b, relative to `center`, the region on the left.
    chains: of consecutive edges: the box (low x, low y, high x, high y), y of both ends, the index
        of the first edge, and the number of edges; None for few edges.
    center: two numbers. size: the largest distance of a vertex from there.

    The distance is the least of those from the edges. Proof of the sign: a point is inside if the
    ray from it towards +x crosses an odd number of edges (outlines do not cross themselves). Edges
    that share a vertex compare the same numbers, so that a ray through a vertex counts once or
    twice or not at all, as it must; on which side of an edge a point lies is decided with the
    rounding of the point, which is no more than the stated error of its distance.

    Proof of the chains. The nearest edge is in no chain whose box begins farther away than another
    box has a point of its chain (each side of a box has one: Roussopoulos et al. 1995, MINMAXDIST).
    A ray towards +x that starts to the left of a box crosses the chain an odd number of times if
    the chain's ends lie on either side of the ray; one that starts to the right, above or below of
    it, never; and a box that holds the point is at distance 0, so that its edges are read.
    """

    edges: RecordTable
    chains: RecordTable | None
    center: tuple[Real, Real]
    size: Real

    @classmethod
    def upload(cls, backend: Backend, outline: Outline, *, axis: bool = False) -> OutlineEdges:
        """axis: leave out edges on the line x = 0, beyond which nothing is asked."""
        points = np.concatenate(outline)
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        start = points - center
        end = np.concatenate([np.roll(one, -1, axis=0) for one in outline]) - center
        owner = np.repeat(np.arange(len(outline)), [len(one) for one in outline])
        if axis:
            kept = (start[:, 0] != -center[0]) | (end[:, 0] != -center[0])
            # Another chain begins behind an edge that is left out.
            owner = owner + np.cumsum(~kept)
            start, end, owner = start[kept], end[kept], owner[kept]
        # In the backend's precision, in which both edges at a vertex have the same one.
        start, end = (one.astype(backend.dtype).astype(np.float64) for one in (start, end))
        square = ((end - start) ** 2).sum(axis=1)
        kept = square > 0
        start, end, square, owner = start[kept], end[kept], square[kept], owner[kept]
        rows = np.column_stack([start, end, 1.0 / square])
        chains = None
        if len(rows) >= _MANY:
            chains = RecordTable.upload(backend, _chains(start, end, owner))
        size = float(np.linalg.norm(start, axis=1).max())
        x, y, size = (dr.opaque(backend.Float, v) for v in (*map(float, center), size))
        return cls(RecordTable.upload(backend, rows), chains, (x, y), size)

    def knots(self, x: Real, y: Real, ahead: Real) -> tuple[Real, ...]:
        """Lengths at which the distance along a line is bounded, the last that asked for."""
        far = _FAR * (fmax(dr.abs(x), dr.abs(y)) + self.size + dr.abs(self.center[0]))
        length = dr.select(dr.isfinite(ahead), ahead, far)
        return (*(one * length for one in _KNOTS), ahead)

    def sample(
        self,
        x: Real,
        y: Real,
        velocity: tuple[Real, Real] | None = None,
        knots: tuple[Real, ...] = (),
    ) -> OutlineSample:
        """The signed distance of points (x, y), and along lines from there with a velocity of
        length 1 at most.

        Proof of the lows: the distance from an edge, or from the box of a chain, is a convex
        function along a line, so that it stays above its tangent (`TangentEnclosure`).
        """
        real = cast("Any", type(x))
        unit = 2 * float(dr.epsilon(real))
        x, y = x - self.center[0], y - self.center[1]
        size = dr.abs(x) + dr.abs(y)
        query = _OutlineQuery(x, y, velocity, knots, _ROUNDINGS * unit * (size + self.size), unit)
        zero = 0 * x
        start = zero + dr.inf, zero, zero, zero, zero, zero, zero > 1, zero > 1
        state = (*start, *(zero + dr.inf for _ in knots))
        if self.chains is None:
            found = self.edges.for_each(query.with_edge, state, "outline")
        else:
            found = self._by_chains(self.chains, query, state)
        distance, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *lows = found
        error = error + unit * (size + distance)
        sign = dr.select(inside, real(-1), real(1))
        # Across an edge the direction is that of its normal, also where the distance is rounding.
        # Far from it the sign decides the side, as of a wall thinner than rounding both are near.
        on_edge |= distance == 0
        side = sign * dr.mulsign(real(1), away_x * normal_x + away_y * normal_y)
        side = dr.select(distance > error, side, 1)
        gradient = tuple(
            dr.select(on_edge, n * side, sign * away / distance)
            for n, away in ((normal_x, away_x), (normal_y, away_y))
        )
        doubt = dr.select(on_edge, 8 * unit, fmin(2 * error / distance, 2))
        lower = tuple(low - distance - error for low in lows)
        bend = dr.select(on_edge, 0, sign / distance)
        return OutlineSample(sign * distance, (gradient[0], gradient[1]), error, doubt, bend, lower)

    def _by_chains(
        self, chains: RecordTable, query: _OutlineQuery, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        (most,) = chains.for_each(query.chain_upper_bound, (query.x + dr.inf,), "outline chains")
        limit = dr.sqrt(most) * (1 + 1e-5) + query.error
        index = type(chains.iteration_count)(0)

        def visit(i: Any, *state: Any) -> tuple[Any, ...]:
            row = chains.read_record(i)
            count, state = query.with_chain(row, limit, state)
            first, count = type(i)(row[6]), type(i)(count)

            def each(j: Any, *inner: Any) -> tuple[Any, ...]:
                return j + 1, *query.with_edge(self.edges.read_record(first + j), inner)

            def more(j: Any, *_: Any) -> Mask:
                return j < count

            return i + 1, *dr.while_loop((type(i)(0), *state), more, each, label="outline")[1:]

        def more_chains(i: Any, *_: Any) -> Mask:
            return i < chains.iteration_count

        start = (index, *state)
        return dr.while_loop(start, more_chains, visit, label="outline by chains")[1:]


@dataclass(frozen=True)
class _OutlineQuery:
    """Points of the plane, relative to the outline's center, and lines from them.

    error: a bound of the rounding of distances from boxes.

    The state of a loop over edges: the distance from the nearest and its rounding, the vector from
    there, the edge's normal, whether the nearest point is no vertex, whether an odd number of edges
    was crossed, and the least of the tangents at each knot.
    """

    x: Real
    y: Real
    velocity: tuple[Real, Real] | None
    knots: tuple[Real, ...]
    error: Real
    unit: float

    def with_edge(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The state with one more edge."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *lows = state
        from_x, from_y = self.x - row[0], self.y - row[1]
        side_x, side_y = row[2] - row[0], row[3] - row[1]
        share = dr.fma(from_x, side_x, from_y * side_y) * row[4]
        t = clamp(share, 0, 1)
        to_x, to_y = dr.fma(side_x, -t, from_x), dr.fma(side_y, -t, from_y)
        over, across = dr.sqrt(row[4]), dr.fma(side_x, from_y, -side_y * from_x)
        is_across = (share > 0) & (share < 1)
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        distance = dr.select(is_across, dr.abs(across) * over, distance)
        # A few roundings of the vectors, in the direction across the edge.
        size = dr.abs(from_x) + dr.abs(from_y) + dr.abs(side_x) + dr.abs(side_y)
        off = _ROUNDINGS * self.unit * size
        lows = self._lowered(lows, to_x, to_y, distance, off)
        crosses = (row[1] > self.y) != (row[3] > self.y)
        inside = inside ^ (crosses & ((across > 0) == (row[3] > row[1])))
        is_nearer = distance < nearest
        return (
            dr.select(is_nearer, distance, nearest),
            dr.select(is_nearer, off, error),
            dr.select(is_nearer, to_x, away_x),
            dr.select(is_nearer, to_y, away_y),
            dr.select(is_nearer, side_y * over, normal_x),
            dr.select(is_nearer, -side_x * over, normal_y),
            (is_nearer & is_across) | (~is_nearer & on_edge),
            inside,
            *lows,
        )

    def chain_upper_bound(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The square of a distance within which a chain has a point."""
        (least,) = state
        near_x, far_x = self._sides(self.x, row[0], row[2])
        near_y, far_y = self._sides(self.y, row[1], row[3])
        across = fmin(near_x * near_x + far_y * far_y, far_x * far_x + near_y * near_y)
        return (fmin(across, least),)

    @staticmethod
    def _sides(v: Real, low: Real, high: Real) -> tuple[Real, Real]:
        a, b = dr.abs(v - low), dr.abs(v - high)
        return fmin(a, b), fmax(a, b)

    def with_chain(
        self, row: list[Real], limit: Real, state: tuple[Any, ...]
    ) -> tuple[Real, tuple[Any, ...]]:
        """How many edges of a chain are to be read; and the state with those that are not."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *lows = state
        to_x, to_y = self.x - clamp(self.x, row[0], row[2]), self.y - clamp(self.y, row[1], row[3])
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        is_near = distance <= limit
        lowest = self._lowered(lows, to_x, to_y, distance, self.error)
        lows = [dr.select(is_near, a, b) for a, b in zip(lows, lowest, strict=True)]
        crosses = (row[4] > self.y) != (row[5] > self.y)
        inside = inside ^ (~is_near & crosses & (row[0] > self.x))
        count = dr.select(is_near, row[7], 0)
        return count, (nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *lows)

    def _lowered(self, lows: list[Real], x: Real, y: Real, distance: Real, off: Real) -> list[Real]:
        """The lows with the tangent of a distance, whose vector (x, y) is off by so much."""
        if self.velocity is None:
            return lows
        slope = (x * self.velocity[0] + y * self.velocity[1]) / distance - 2 * off / distance
        rounding = 4 * self.unit * distance
        return min_with_tangent(lows, self.knots, distance - off, slope, rounding, self.unit)


def _chains(start: FloatArray, end: FloatArray, owner: IntArray) -> FloatArray:
    """Records of chains of consecutive edges. A search reads all chains, twice, and the edges of
    some three: so the number of edges of each is about the square root of twice that of all."""
    length = max(8, round(math.sqrt(2 * len(start) / 3)))
    rows: list[Any] = []
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(owner)) + 1, [len(owner)]])
    for first, last in itertools.pairwise(bounds.tolist()):
        for k in range(first, last, length):
            stop = min(k + length, last)
            ends = np.concatenate([start[k:stop], end[k:stop]])
            rows.append(
                [*ends.min(axis=0), *ends.max(axis=0), start[k, 1], end[stop - 1, 1], k, stop - k]
            )
    return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class SignedDistanceEnclosure(Enclosure):
    """A signed distance d of constant 1 along a path, from a bound of |d|.

    Proof. As long as |d| > 0, d keeps its sign: for d > 0 it falls as |d| does, down to 0, and
    rises as |d| does; for d < 0 it is the other way around. And it moves by no more than the length
    of the path.
    """

    value: Real
    size: TangentEnclosure

    @classmethod
    def around(
        cls, nearest: OutlineSample, slope: Real, knots: tuple[Real, ...]
    ) -> SignedDistanceEnclosure:
        """slope: of d along the path."""
        distance = dr.abs(nearest.value)
        most = fmin(dr.mulsign(slope, nearest.value) + nearest.gradient_error, 1.0)
        return cls(nearest.value, TangentEnclosure(distance, most, knots, nearest.lower_bounds))

    def free_length(self, gaps: LevelGaps) -> Real:
        positive = self.value > 0
        nearer = dr.select(positive, gaps.below, gaps.above)
        farther = dr.select(positive, gaps.above, gaps.below)
        own = self.size.free_length(LevelGaps(fmin(nearer, dr.abs(self.value)), farther))
        known = (gaps.below >= 0) & (gaps.above >= 0)
        return dr.select(known, fmax(own, fmin(gaps.below, gaps.above) * (1 - 1e-6)), 0)
