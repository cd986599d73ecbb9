"""The signed distance from an outline in the plane, and its bounds along a line of the plane.

Edges are read in a loop. If there are many, consecutive edges form chains, and far chains are
skipped by their boxes. So an outline of 1,000 edges costs about as much as an outline of 100
(`OutlineEdges`).
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
_MIN_EDGES_FOR_CHAINS = 48
# Along a line the distance is bounded at knots. The inner knots are these fractions of the length
# asked for or, if that is infinite, of this multiple of the largest coordinate and the outline's
# size.
_KNOT_FRACTIONS = (0.0625, 0.125, 0.25, 0.5)
_ENDLESS_LENGTH = 8.0
# The error of the vector between a point and an edge, in roundings of the terms of the vector.
_VECTOR_ROUNDINGS = 4.0


@dataclass(frozen=True)
class OutlineSample:
    """A sample of the signed distance d at points of the plane.

    value: d, negative inside.
    gradient: (d_x, d_y), a unit vector.
    error: a bound of the error of `value`.
    gradient_error: a bound of the error of `gradient`, as a length.
    second_derivative: the second derivative of d across the gradient. It is 1/d if the nearest
        point of the outline is a vertex, else 0.
    lower_bounds: for each knot of a line, a lower bound of |d| at the knot less |d| at the start;
        rounding is included.
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

    edges: a record (ax, ay, bx, by, 1/length^2) for each edge from a to b, relative to `center`.
        The region lies to the left of its edges.
    chains: a record for each chain of consecutive edges: its box as (lowest x, lowest y, highest x,
        highest y), y of its first and of its last vertex, the index of its first edge, and the
        number of its edges. None for a small number of edges.
    center: x and y of the center.
    size: the largest distance of a vertex from the center.

    The distance is that from the nearest edge. Proof of the sign. A point is inside if the ray from
    it towards +x crosses an odd number of edges, since outlines do not cross themselves. Edges that
    share a vertex compare the same numbers with the ray, so that a ray through a vertex counts 0, 1
    or 2 crossings there, as is right. The side of an edge on which a point lies is decided up to
    the rounding of the point, which is no more than the stated error of its distance.

    Proof for chains. Each side of a chain's box holds a point of the chain. So there is a distance
    from x within which the chain must have a point (MINMAXDIST of Roussopoulos et al. 1995). A
    chain whose box begins farther away than this distance of another chain does not hold the
    nearest edge. Now for the crossings of the ray towards +x. If it starts to the left of the box,
    it crosses the chain an odd number of times when the chain's two ends lie on different sides of
    the ray, else an even number of times. If it starts to the right, above or below of the box, it
    never crosses the chain. If it starts in the box, the distance from the box is 0, so that the
    chain's edges are read.
    """

    edges: RecordTable
    chains: RecordTable | None
    center: tuple[Real, Real]
    size: Real

    @classmethod
    def upload(cls, backend: Backend, outline: Outline, *, axis: bool = False) -> OutlineEdges:
        """The edges of an outline on a backend.

        axis: whether edges on the line x = 0 are left out. No point with x < 0 may be sampled then.
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
        if len(rows) >= _MIN_EDGES_FOR_CHAINS:
            chains = RecordTable.upload(backend, _chain_records(start, end, loop))
        size = float(np.linalg.norm(start, axis=1).max())
        x, y, size = (dr.opaque(backend.Float, number) for number in (*map(float, center), size))
        return cls(RecordTable.upload(backend, rows), chains, (x, y), size)

    def knots(self, x: Real, y: Real, ahead: Real) -> tuple[Real, ...]:
        """The positions on the lines from points (x, y) at which the distance is bounded. They
        increase; the last is the length `ahead` that is asked for, which may be infinite."""
        max_length = _ENDLESS_LENGTH * (
            fmax(dr.abs(x), dr.abs(y)) + self.size + dr.abs(self.center[0])
        )
        length = dr.select(dr.isfinite(ahead), ahead, max_length)
        return (*(fraction * length for fraction in _KNOT_FRACTIONS), ahead)

    def sample(
        self,
        x: Real,
        y: Real,
        velocity: tuple[Real, Real] | None = None,
        knots: tuple[Real, ...] = (),
    ) -> OutlineSample:
        """The sample of the signed distance at points (x, y), with lower bounds along lines from
        them.

        velocity: (x, y) the direction of the lines, of length 1 at most; None without lines.
        knots: increasing positions on the lines at which the distance is bounded.

        Proof of the lower bounds. The distance from an edge, or from the box of a chain, is a
        convex function along a line, and lies above its tangent (`TangentEnclosure`).
        """
        real = cast("Any", type(x))
        epsilon = 2 * float(dr.epsilon(real))
        x, y = x - self.center[0], y - self.center[1]
        size = dr.abs(x) + dr.abs(y)
        query = _OutlineQuery(
            x, y, velocity, knots, _VECTOR_ROUNDINGS * epsilon * (size + self.size), epsilon
        )
        zero = 0 * x
        start = zero + dr.inf, zero, zero, zero, zero, zero, zero > 1, zero > 1
        state = (*start, *(zero + dr.inf for _ in knots))
        if self.chains is None:
            final = self.edges.for_each(query.with_edge, state, "outline")
        else:
            final = self._add_edges_by_chains(self.chains, query, state)
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

    def _add_edges_by_chains(
        self, chains: RecordTable, query: _OutlineQuery, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """The state of a loop over the edges (see `_OutlineQuery`), with all edges added. If a
        chain is too far away to hold the nearest edge, its box is added in place of its edges.

        chains: the records of the chains.
        state: the state before any edge.
        """
        (square,) = chains.for_each(query.chain_upper_bound, (query.x + dr.inf,), "outline chains")
        max_distance = dr.sqrt(square) * (1 + 1e-5) + query.error
        index = type(chains.iteration_count)(0)

        def visit_chain(i: Any, *state: Any) -> tuple[Any, ...]:
            """The index of the next chain, and the state after the edges of chain i, or its box if
            it is far away, were added."""
            record = chains.read_record(i)
            count, state = query.with_chain(record, max_distance, state)
            first, count = type(i)(record[6]), type(i)(count)

            def each(j: Any, *edge_state: Any) -> tuple[Any, ...]:
                """The state with edge j of the chain added."""
                return j + 1, *query.with_edge(self.edges.read_record(first + j), edge_state)

            def has_more(j: Any, *_: Any) -> Mask:
                return j < count

            return i + 1, *dr.while_loop((type(i)(0), *state), has_more, each, label="outline")[1:]

        def has_more_chains(i: Any, *_: Any) -> Mask:
            return i < chains.iteration_count

        start = (index, *state)
        return dr.while_loop(start, has_more_chains, visit_chain, label="outline by chains")[1:]


@dataclass(frozen=True)
class _OutlineQuery:
    """Points of the plane at which the signed distance from an outline is wanted, and lines from
    these points, on which it is to be bounded.

    The methods update the state of a loop over the edges. It consists of these parts: the distance
    from the nearest edge so far and its rounding error; x and y of the vector from the nearest
    point of that edge to the query point; x and y of the edge's unit normal; whether the nearest
    point lies inside the edge, so that it is no vertex; whether the ray towards +x has crossed an
    odd number of edges; and a lower bound of the distance at each knot, a position on the line. The
    distance from an edge lies above its tangent at the start of the line, so the bound is the
    smallest of all tangents at the knot.

    x, y: the points, relative to the outline's center.
    velocity: the direction of the lines, of length 1 at most; None without lines.
    knots: increasing positions on the lines at which the distance is bounded.
    error: a bound of the rounding of distances from boxes.
    unit: the machine epsilon.
    """

    x: Real
    y: Real
    velocity: tuple[Real, Real] | None
    knots: tuple[Real, ...]
    error: Real
    unit: float

    def with_edge(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The state of the loop after the edge of the record `row` was added."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        from_x, from_y = self.x - row[0], self.y - row[1]
        edge_x, edge_y = row[2] - row[0], row[3] - row[1]
        fraction = dr.fma(from_x, edge_x, from_y * edge_y) * row[4]
        t = clamp(fraction, 0, 1)
        to_x, to_y = dr.fma(edge_x, -t, from_x), dr.fma(edge_y, -t, from_y)
        inverse_length, cross_product = dr.sqrt(row[4]), dr.fma(edge_x, from_y, -edge_y * from_x)
        is_inner = (fraction > 0) & (fraction < 1)
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        distance = dr.select(is_inner, dr.abs(cross_product) * inverse_length, distance)
        # A few roundings of the vectors, in the direction across the edge.
        size = dr.abs(from_x) + dr.abs(from_y) + dr.abs(edge_x) + dr.abs(edge_y)
        rounding = _VECTOR_ROUNDINGS * self.unit * size
        bounds = self._with_tangent(bounds, to_x, to_y, distance, rounding)
        crosses = (row[1] > self.y) != (row[3] > self.y)
        inside = inside ^ (crosses & ((cross_product > 0) == (row[3] > row[1])))
        is_nearer = distance < nearest
        return (
            dr.select(is_nearer, distance, nearest),
            dr.select(is_nearer, rounding, error),
            dr.select(is_nearer, to_x, away_x),
            dr.select(is_nearer, to_y, away_y),
            dr.select(is_nearer, edge_y * inverse_length, normal_x),
            dr.select(is_nearer, -edge_x * inverse_length, normal_y),
            (is_nearer & is_inner) | (~is_nearer & on_edge),
            inside,
            *bounds,
        )

    def chain_upper_bound(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """The smaller of two squared distances: the state, and the square of a distance within
        which the chain of the record `row` must have a point."""
        (min_square,) = state
        near_x, far_x = self._distances_from_ends(self.x, row[0], row[2])
        near_y, far_y = self._distances_from_ends(self.y, row[1], row[3])
        square = fmin(near_x * near_x + far_y * far_y, far_x * far_x + near_y * near_y)
        return (fmin(square, min_square),)

    @staticmethod
    def _distances_from_ends(v: Real, lower: Real, upper: Real) -> tuple[Real, Real]:
        """The distances of a coordinate from the nearer and from the farther end of the interval
        [lower, upper]."""
        to_lower, to_upper = dr.abs(v - lower), dr.abs(v - upper)
        return fmin(to_lower, to_upper), fmax(to_lower, to_upper)

    def with_chain(
        self, row: list[Real], limit: Real, state: tuple[Any, ...]
    ) -> tuple[Real, tuple[Any, ...]]:
        """The number of edges that must be read of the chain of the record `row`: all if its box is
        within the distance `limit`, else 0; and the state. If the box is farther away, it is added
        to the state in place of the edges."""
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        to_x, to_y = self.x - clamp(self.x, row[0], row[2]), self.y - clamp(self.y, row[1], row[3])
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        is_near = distance <= limit
        bounds_with_box = self._with_tangent(bounds, to_x, to_y, distance, self.error)
        bounds = [dr.select(is_near, a, b) for a, b in zip(bounds, bounds_with_box, strict=True)]
        crosses = (row[4] > self.y) != (row[5] > self.y)
        inside = inside ^ (~is_near & crosses & (row[0] > self.x))
        count = dr.select(is_near, row[7], 0)
        return count, (nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds)

    def _with_tangent(
        self, bounds: list[Real], x: Real, y: Real, distance: Real, error: Real
    ) -> list[Real]:
        """The smallest tangents at the knots, with the tangent of the distance from another edge or
        box included.

        bounds: the smallest tangents so far.
        x, y: the vector from the nearest point of the edge or box to the query point.
        distance: its length.
        error: a bound of the error of that vector.
        """
        if self.velocity is None:
            return bounds
        slope = (x * self.velocity[0] + y * self.velocity[1]) / distance - 2 * error / distance
        rounding = 4 * self.unit * distance
        return min_with_tangent(bounds, self.knots, distance - error, slope, rounding, self.unit)


def _chain_records(start: FloatArray, end: FloatArray, loop_index: IntArray) -> FloatArray:
    """The records of chains of consecutive edges: for each its box as (lowest x, lowest y, highest
    x, highest y), y of its first and of its last vertex, the index of its first edge, and the
    number of its edges.

    start, end: (n, 2) the ends of the edges.
    loop_index: (n,) an index that changes where the next edge belongs to another chain.

    A query reads all chains twice, and the edges of about three chains. The number of edges per
    chain that costs least is about the square root of two thirds of the number of all edges.
    """
    length = max(8, round(math.sqrt(2 * len(start) / 3)))
    rows: list[Any] = []
    loop_starts = np.concatenate([[0], np.flatnonzero(np.diff(loop_index)) + 1, [len(loop_index)]])
    for first, last in itertools.pairwise(loop_starts.tolist()):
        for k in range(first, last, length):
            stop = min(k + length, last)
            ends = np.concatenate([start[k:stop], end[k:stop]])
            rows.append(
                [*ends.min(axis=0), *ends.max(axis=0), start[k, 1], end[stop - 1, 1], k, stop - k]
            )
    return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class SignedDistanceEnclosure(Enclosure):
    """An enclosure of a signed distance d along a path, from an enclosure of |d|. The Lipschitz
    constant of d is 1.

    value: d at the start of the path.
    size: the enclosure of |d|.

    Proof. As long as |d| > 0, d keeps its sign. If d > 0, it falls as |d| does, down to 0, and
    rises as |d| does. If d < 0, it falls where |d| rises, and rises where |d| falls. And d changes
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
        knots: the positions on the path of the sample's lower bounds.
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
