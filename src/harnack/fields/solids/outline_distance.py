"""The signed distance from an outline in the plane, and its bounds along a line of the plane.

Edges are read in a loop. If their number is large, chains of consecutive edges are skipped by their
boxes, so that an outline of 1,000 edges costs about as much as an outline of 100 (`OutlineEdges`).
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
_MIN_CHAINED = 48
# The inner knots of the bound along a line, as fractions of the length asked for; and that length,
# in multiples of coordinates, for a ray without an end.
_KNOTS = (0.0625, 0.125, 0.25, 0.5)
_ENDLESS_LENGTH = 8.0
_ROUNDINGS = 4.0


@dataclass(frozen=True)
class OutlineSample:
    """A sample of the signed distance d at points of the plane.

    value: d, negative inside. gradient: (d_x, d_y), a unit vector. error, gradient_error: bounds of
        the errors of both.
    second_derivative: the second derivative across the gradient: 1/d beside a vertex, else 0.
    lower_bounds: at each knot of a line, a lower bound of |d| there less |d| at the start, rounding
        included.
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
    chains: a record for each chain of consecutive edges: the box (low x, low y, high x, high y), y
        of both ends, the index of the first edge, and the number of edges; None for few edges.
    center: two numbers. size: the largest distance of a vertex from the center.

    The distance is the least distance from an edge. Proof of the sign: a point is inside if the ray
    from it towards +x crosses an odd number of edges (outlines do not cross themselves). Edges that
    share a vertex compare the same numbers, so that a ray through a vertex counts once or twice or
    not at all, as it must; on which side of an edge a point lies is decided with the rounding of
    the point, which is no more than the stated error of its distance.

    Proof of the chains. The nearest edge is in no chain whose box begins farther away than a point
    that another chain must have in its box (each side of a box has one: Roussopoulos et al. 1995,
    MINMAXDIST). A ray towards +x that starts to the left of a box crosses the chain an odd number
    of times if the chain's ends lie on either side of the ray; one that starts to the right, above
    or below of it, never; and a box that holds the point is at distance 0, so that its edges are
    read.
    """

    edges: RecordTable
    chains: RecordTable | None
    center: tuple[Real, Real]
    size: Real

    @classmethod
    def upload(cls, backend: Backend, outline: Outline, *, axis: bool = False) -> OutlineEdges:
        """The edges of an outline on a backend.

        axis: leave out edges on the line x = 0, beyond which no point is sampled.
        """
        points = np.concatenate(outline)
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        start = points - center
        end = np.concatenate([np.roll(array, -1, axis=0) for array in outline]) - center
        loop = np.repeat(np.arange(len(outline)), [len(array) for array in outline])
        if axis:
            keep = (start[:, 0] != -center[0]) | (end[:, 0] != -center[0])
            # Another chain begins behind an edge that is left out.
            loop = loop + np.cumsum(~keep)
            start, end, loop = start[keep], end[keep], loop[keep]
        # In the backend's precision, so that both edges at a vertex have the same coordinates of
        # it.
        start, end = (array.astype(backend.dtype).astype(np.float64) for array in (start, end))
        square = ((end - start) ** 2).sum(axis=1)
        keep = square > 0
        start, end, square, loop = (start[keep], end[keep], square[keep], loop[keep])
        rows = np.column_stack([start, end, 1.0 / square])
        chains = None
        if len(rows) >= _MIN_CHAINED:
            chains = RecordTable.upload(backend, _chains(start, end, loop))
        size = float(np.linalg.norm(start, axis=1).max())
        x, y, size = (dr.opaque(backend.Float, number) for number in (*map(float, center), size))
        return cls(RecordTable.upload(backend, rows), chains, (x, y), size)

    def knots(self, x: Real, y: Real, ahead: Real) -> tuple[Real, ...]:
        """The lengths at which the distance along a line is bounded; the last is the length asked
        for."""
        max_length = _ENDLESS_LENGTH * (
            fmax(dr.abs(x), dr.abs(y)) + self.size + dr.abs(self.center[0])
        )
        length = dr.select(dr.isfinite(ahead), ahead, max_length)
        return (*(fraction * length for fraction in _KNOTS), ahead)

    def sample(
        self,
        x: Real,
        y: Real,
        velocity: tuple[Real, Real] | None = None,
        knots: tuple[Real, ...] = (),
    ) -> OutlineSample:
        """The sample of the signed distance at points (x, y), and along lines from these with a
        velocity of length 1 at most.

        Proof of the lower bounds. The distance from an edge, or from the box of a chain, is a
        convex function along a line, so that it stays above its tangent (`TangentEnclosure`).
        """
        real = cast("Any", type(x))
        epsilon = 2 * float(dr.epsilon(real))
        x, y = x - self.center[0], y - self.center[1]
        size = dr.abs(x) + dr.abs(y)
        query = _OutlineQuery(
            x, y, velocity, knots, _ROUNDINGS * epsilon * (size + self.size), epsilon
        )
        zero = 0 * x
        start = zero + dr.inf, zero, zero, zero, zero, zero, zero > 1, zero > 1
        state = (*start, *(zero + dr.inf for _ in knots))
        if self.chains is None:
            final = self.edges.for_each(query.with_edge, state, "outline")
        else:
            final = self._by_chains(self.chains, query, state)
        distance, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = final
        error = error + epsilon * (size + distance)
        sign = dr.select(inside, real(-1), real(1))
        # Across an edge the direction is that of its normal, also where the distance is rounding.
        # Far from the edge the sign decides the side, since both edges of a wall thinner than
        # rounding are near.
        on_edge |= distance == 0
        normal_sign = sign * dr.mulsign(real(1), away_x * normal_x + away_y * normal_y)
        normal_sign = dr.select(distance > error, normal_sign, 1)
        gradient = tuple(
            dr.select(on_edge, n * normal_sign, sign * away / distance)
            for n, away in ((normal_x, away_x), (normal_y, away_y))
        )
        slope_error = dr.select(on_edge, 8 * epsilon, fmin(2 * error / distance, 2))
        lower = tuple(bound - distance - error for bound in bounds)
        curvature = dr.select(on_edge, 0, sign / distance)
        return OutlineSample(
            sign * distance, (gradient[0], gradient[1]), error, slope_error, curvature, lower
        )

    def _by_chains(
        self, chains: RecordTable, query: _OutlineQuery, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """The state after all edges, where the box of a far chain replaces its edges."""
        (square,) = chains.for_each(query.chain_upper_bound, (query.x + dr.inf,), "outline chains")
        limit = dr.sqrt(square) * (1 + 1e-5) + query.error
        index = type(chains.iteration_count)(0)

        def visit(i: Any, *state: Any) -> tuple[Any, ...]:
            record = chains.read_record(i)
            count, state = query.with_chain(record, limit, state)
            first, count = type(i)(record[6]), type(i)(count)

            def each(j: Any, *inner: Any) -> tuple[Any, ...]:
                return j + 1, *query.with_edge(self.edges.read_record(first + j), inner)

            def has_more(j: Any, *_: Any) -> Mask:
                return j < count

            return i + 1, *dr.while_loop((type(i)(0), *state), has_more, each, label="outline")[1:]

        def has_more_chains(i: Any, *_: Any) -> Mask:
            return i < chains.iteration_count

        start = (index, *state)
        return dr.while_loop(start, has_more_chains, visit, label="outline by chains")[1:]


@dataclass(frozen=True)
class _OutlineQuery:
    """Points of the plane, relative to the outline's center, and lines from them.

    error: a bound of the rounding of distances from boxes.

    The state of a loop over edges: the distance from the nearest edge and its rounding error, the
    vector from the nearest point, the edge's normal, whether the nearest point is not a vertex,
    whether an odd number of edges was crossed, and the least of the tangents at each knot.
    """

    x: Real
    y: Real
    velocity: tuple[Real, Real] | None
    knots: tuple[Real, ...]
    error: Real
    unit: float

    def with_edge(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The state after another edge."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        from_x, from_y = self.x - row[0], self.y - row[1]
        edge_x, edge_y = row[2] - row[0], row[3] - row[1]
        fraction = dr.fma(from_x, edge_x, from_y * edge_y) * row[4]
        t = clamp(fraction, 0, 1)
        to_x, to_y = dr.fma(edge_x, -t, from_x), dr.fma(edge_y, -t, from_y)
        scale, across = dr.sqrt(row[4]), dr.fma(edge_x, from_y, -edge_y * from_x)
        is_across = (fraction > 0) & (fraction < 1)
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        distance = dr.select(is_across, dr.abs(across) * scale, distance)
        # A few roundings of the vectors, in the direction across the edge.
        size = dr.abs(from_x) + dr.abs(from_y) + dr.abs(edge_x) + dr.abs(edge_y)
        rounding = _ROUNDINGS * self.unit * size
        bounds = self._lowered(bounds, to_x, to_y, distance, rounding)
        crosses = (row[1] > self.y) != (row[3] > self.y)
        inside = inside ^ (crosses & ((across > 0) == (row[3] > row[1])))
        is_nearer = distance < nearest
        return (
            dr.select(is_nearer, distance, nearest),
            dr.select(is_nearer, rounding, error),
            dr.select(is_nearer, to_x, away_x),
            dr.select(is_nearer, to_y, away_y),
            dr.select(is_nearer, edge_y * scale, normal_x),
            dr.select(is_nearer, -edge_x * scale, normal_y),
            (is_nearer & is_across) | (~is_nearer & on_edge),
            inside,
            *bounds,
        )

    def chain_upper_bound(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The smaller of the state, a squared distance, and of the square of a distance within
        which a chain has a point."""
        (min_square,) = state
        near_x, far_x = self._sides(self.x, row[0], row[2])
        near_y, far_y = self._sides(self.y, row[1], row[3])
        square = fmin(near_x * near_x + far_y * far_y, far_x * far_x + near_y * near_y)
        return (fmin(square, min_square),)

    @staticmethod
    def _sides(v: Real, lower: Real, upper: Real) -> tuple[Real, Real]:
        """The distances of a coordinate from the nearer and from the farther side of a box."""
        a, b = dr.abs(v - lower), dr.abs(v - upper)
        return fmin(a, b), fmax(a, b)

    def with_chain(
        self, row: list[Real], limit: Real, state: tuple[Any, ...]
    ) -> tuple[Real, tuple[Any, ...]]:
        """The number of edges of a chain that are to be read; and the state after the edges that
        are not."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        to_x, to_y = self.x - clamp(self.x, row[0], row[2]), self.y - clamp(self.y, row[1], row[3])
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        is_near = distance <= limit
        lowest = self._lowered(bounds, to_x, to_y, distance, self.error)
        bounds = [dr.select(is_near, a, b) for a, b in zip(bounds, lowest, strict=True)]
        crosses = (row[4] > self.y) != (row[5] > self.y)
        inside = inside ^ (~is_near & crosses & (row[0] > self.x))
        count = dr.select(is_near, row[7], 0)
        return count, (nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds)

    def _lowered(
        self, bounds: list[Real], x: Real, y: Real, distance: Real, error: Real
    ) -> list[Real]:
        """The lower bounds with the tangent of another distance, whose vector (x, y) has this
        error."""
        if self.velocity is None:
            return bounds
        slope = (x * self.velocity[0] + y * self.velocity[1]) / distance - 2 * error / distance
        rounding = 4 * self.unit * distance
        return min_with_tangent(bounds, self.knots, distance - error, slope, rounding, self.unit)


def _chains(start: FloatArray, end: FloatArray, loop_index: IntArray) -> FloatArray:
    """The records of chains of consecutive edges. A search reads all chains, twice, and the edges
    of about three chains: so the number of edges of a chain is about the square root of two thirds
    of the number of all edges."""
    length = max(8, round(math.sqrt(2 * len(start) / 3)))
    rows: list[Any] = []
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(loop_index)) + 1, [len(loop_index)]])
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
    """An enclosure of a signed distance d, of Lipschitz constant 1, along a path, from an enclosure
    of |d|.

    Proof. As long as |d| > 0, d keeps its sign. For d > 0 it falls as |d| does, down to 0, and
    rises as |d| does; for d < 0 it falls where |d| rises, and rises where |d| falls. And it changes
    by no more than the length of the path.
    """

    value: Real
    size: TangentEnclosure

    @classmethod
    def around(
        cls, nearest: OutlineSample, slope: Real, knots: tuple[Real, ...]
    ) -> SignedDistanceEnclosure:
        """The enclosure from a sample of d.

        slope: the derivative of d along the path.
        """
        distance = dr.abs(nearest.value)
        max_slope = fmin(dr.mulsign(slope, nearest.value) + nearest.gradient_error, 1.0)
        return cls(
            nearest.value, TangentEnclosure(distance, max_slope, knots, nearest.lower_bounds)
        )

    def free_length(self, gaps: LevelGaps) -> Real:
        is_positive = self.value > 0
        nearer = dr.select(is_positive, gaps.below, gaps.above)
        farther = dr.select(is_positive, gaps.above, gaps.below)
        length = self.size.free_length(LevelGaps(fmin(nearer, dr.abs(self.value)), farther))
        is_valid = (gaps.below >= 0) & (gaps.above >= 0)
        return dr.select(is_valid, fmax(length, fmin(gaps.below, gaps.above) * (1 - 1e-6)), 0)
