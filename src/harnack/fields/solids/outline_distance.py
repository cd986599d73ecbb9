"""The signed distance d from an outline in the plane, and its bounds along a line of the plane. An
outline is a set of closed polygonal loops that do not cross; d is negative inside. A lane of the
computation has one query point (x, y), and possibly a line from this point, with positions on it,
the knots, at which d is bounded.

Edges are read in a loop, one after the other. If there are many, consecutive edges form chains, and
far chains are skipped by their boxes. So an outline of 1,000 edges takes about as much time as an
outline of 100 (`OutlineEdges`).
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
# Along a line the distance is bounded at knots. The inner knots are these fractions of the
# requested length. If that is infinite, they are fractions of this multiple of the sum of the
# largest coordinate and the outline's size.
_KNOT_FRACTIONS = (0.0625, 0.125, 0.25, 0.5)
_ENDLESS_LENGTH = 8.0
# The error of the vector between a point and an edge, in roundings of the terms of the vector.
_VECTOR_ROUNDINGS = 4.0


@dataclass(frozen=True)
class OutlineSample:
    """The signed distance d from an outline at points of the plane, with its derivatives and error
    bounds, and with lower bounds of |d| along lines from the points.

    value: d, negative inside.
    gradient: (d_x, d_y), a unit vector.
    error: a bound of the error of `value`.
    gradient_error: a bound of the error of `gradient`, as a length.
    second_derivative: the second derivative of d across the gradient. It is 1/d if the nearest
        point of the outline is a vertex, else 0.
    lower_bounds: for each knot (a position on the line), a lower bound of |d| at the knot minus |d|
        at the start; rounding is included.
    """

    value: Real
    gradient: tuple[Real, Real]
    error: Real
    gradient_error: Real
    second_derivative: Real = 0.0
    lower_bounds: tuple[Real, ...] = ()


@dataclass(frozen=True)
class OutlineEdges:
    """The edges of an outline on a backend, as a table of records that a loop reads. The signed
    distance is computed from the nearest edge. Consecutive edges form chains; a far chain is
    skipped by its box. A line starts at each query point; the knots are positions on it at which
    the distance is bounded.

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

    Proof for chains. Each side of a chain's box holds a point of the chain. So for each chain there
    is a computable distance from the query point within which the chain must have a point
    (MINMAXDIST of Roussopoulos et al. 1995). If the box of one chain is farther away than this
    distance of another chain, the first chain does not hold the nearest edge. Now for the crossings
    of the ray towards +x. If it starts to the left of the box, it crosses the chain an odd number
    of times when the chain's two ends lie on different sides of the ray, else an even number of
    times. If it starts to the right, above or below of the box, it never crosses the chain. If it
    starts in the box, the distance from the box is 0, so that the chain's edges are read.
    """

    edges: RecordTable
    chains: RecordTable | None
    center: tuple[Real, Real]
    size: Real

    @classmethod
    def upload(cls, backend: Backend, outline: Outline, *, axis: bool = False) -> OutlineEdges:
        """The records of an outline's edges, on a backend.

        outline: its loops, each an array (n, 2) of vertices.
        axis: whether edges on the line x = 0 are left out. No point with x < 0 may be sampled then.
        """
        points = np.concatenate(outline)
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        start = points - center
        end = np.concatenate([np.roll(array, -1, axis=0) for array in outline]) - center
        # For each edge the number of its loop, so that no chain joins two loops.
        loop = np.repeat(np.arange(len(outline)), [len(array) for array in outline])
        if axis:
            # Coordinates count from the center, so that the axis is the line x = -center[0].
            keep = (start[:, 0] != -center[0]) | (end[:, 0] != -center[0])
            # Another chain begins behind an edge that is left out.
            loop = loop + np.cumsum(~keep)
            start, end, loop = start[keep], end[keep], loop[keep]
        # The coordinates are rounded to the backend's precision now, and not when they are
        # uploaded, so that the two edges at a vertex have exactly the same coordinates there.
        start, end = (array.astype(backend.dtype).astype(np.float64) for array in (start, end))
        square = ((end - start) ** 2).sum(axis=1)
        # Rounding may have made an edge a point.
        keep = square > 0
        start, end, square, loop = (start[keep], end[keep], square[keep], loop[keep])
        # The records: (ax, ay, bx, by, 1/length^2) for the edge from a to b.
        rows = np.column_stack([start, end, 1.0 / square])
        chains = None
        if len(rows) >= _MIN_EDGES_FOR_CHAINS:
            chains = RecordTable.upload(backend, _chain_records(start, end, loop))
        size = float(np.linalg.norm(start, axis=1).max())
        x, y, size = (dr.opaque(backend.Float, number) for number in (*map(float, center), size))
        return cls(RecordTable.upload(backend, rows), chains, (x, y), size)

    def knots(self, x: Real, y: Real, ahead: Real) -> tuple[Real, ...]:
        """The knots: positions on lines from points (x, y) at which the distance is bounded. They
        increase; the last is the requested length `ahead`, which may be infinite."""
        # If `ahead` is infinite, the inner knots are fractions of this length: a multiple of the
        # coordinates and of the outline's size.
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
        """The sample of the signed distance at points (x, y): value, gradient, error bounds, and
        lower bounds at the knots of lines from these points.

        velocity: (x, y) the direction of the lines, of length 1 at most; None without lines.
        knots: increasing positions on the lines at which the distance is bounded.

        Proof of the lower bounds. The distance from an edge, or from the box of a chain, is a
        convex function along a line, and lies above its tangent (`TangentEnclosure`).
        """
        real = cast("Any", type(x))
        epsilon = 2 * float(dr.epsilon(real))  # the machine epsilon
        x, y = x - self.center[0], y - self.center[1]
        size = dr.abs(x) + dr.abs(y)
        query = _OutlineQuery(
            x, y, velocity, knots, _VECTOR_ROUNDINGS * epsilon * (size + self.size), epsilon
        )
        zero = 0 * x
        # The state before any edge: the distance from the nearest edge, its error, the vector from
        # its nearest point, its normal, and two masks: whether that point is inside the edge, and
        # whether the query point is inside. (zero > 1 is False on each lane.)
        start = zero + dr.inf, zero, zero, zero, zero, zero, zero > 1, zero > 1
        state = (*start, *(zero + dr.inf for _ in knots))
        if self.chains is None:
            final = self.edges.for_each(query.with_edge, state, "outline")
        else:
            final = self._add_edges_by_chains(self.chains, query, state)
        distance, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = final
        error = error + epsilon * (size + distance)
        sign = dr.select(inside, real(-1), real(1))
        # If the nearest point is inside an edge, the gradient is plus or minus the edge's normal,
        # also where the distance is mere rounding. If the distance is larger than its error, the
        # sign of d says which: the gradient points away from the edge outside, and towards it
        # inside. (At a wall thinner than rounding the nearest edge may be that of the wall's other
        # side.) Nearer to the edge, the normal is taken as it is.
        on_edge |= distance == 0
        normal_sign = sign * dr.mulsign(real(1), away_x * normal_x + away_y * normal_y)
        normal_sign = dr.select(distance > error, normal_sign, 1)
        gradient = tuple(
            dr.select(on_edge, n * normal_sign, sign * away / distance)
            for n, away in ((normal_x, away_x), (normal_y, away_y))
        )
        slope_error = dr.select(on_edge, 8 * epsilon, fmin(2 * error / distance, 2))
        # The bounds of the distance become bounds of its change from the start.
        lower = tuple(bound - distance - error for bound in bounds)
        curvature = dr.select(on_edge, 0, sign / distance)
        return OutlineSample(
            sign * distance, (gradient[0], gradient[1]), error, slope_error, curvature, lower
        )

    def _add_edges_by_chains(
        self, chains: RecordTable, query: _OutlineQuery, state: tuple[Any, ...]
    ) -> tuple[Any, ...]:
        """Loop over the chains of edges, and return the state of the loop over edges with all edges
        added; `_OutlineQuery` lists the members of this tuple. A chain that is too far away to hold
        the nearest edge is added by its box, in place of its edges.

        chains: the records of the chains.
        query: the query points and the lines from them.
        state: the state before any edge.
        """
        # A distance within which some chain must have a point, so that the nearest edge is not
        # farther away.
        (square,) = chains.for_each(query.chain_upper_bound, (query.x + dr.inf,), "outline chains")
        # (1e-5 covers the rounding of the root.)
        max_distance = dr.sqrt(square) * (1 + 1e-5) + query.error
        index = type(chains.iteration_count)(0)

        def visit_chain(i: Any, *state: Any) -> tuple[Any, ...]:
            """Return the index of the next chain; and the state of the loop over edges with chain i
            added, by its edges if it is near, else by its box."""
            record = chains.read_record(i)
            # A near chain has `count` edges to visit. A far one has 0, and its box is already in
            # the state.
            count, state = query.with_chain(record, max_distance, state)
            # Entry 6 of the record is the index of its first edge.
            first_edge, count = type(i)(record[6]), type(i)(count)

            def each(j: Any, *edge_state: Any) -> tuple[Any, ...]:
                """Return the next index, and the state with edge j of the chain added."""
                return j + 1, *query.with_edge(self.edges.read_record(first_edge + j), edge_state)

            def has_more(j: Any, *_: Any) -> Mask:
                return j < count

            # The state of the inner loop, without its index.
            return i + 1, *dr.while_loop((type(i)(0), *state), has_more, each, label="outline")[1:]

        def has_more_chains(i: Any, *_: Any) -> Mask:
            return i < chains.iteration_count

        start = (index, *state)
        return dr.while_loop(start, has_more_chains, visit_chain, label="outline by chains")[1:]


@dataclass(frozen=True)
class _OutlineQuery:
    """Query points of the plane, one per lane, at which the signed distance from an outline is
    wanted, and lines from these points along which it is bounded at given positions, the knots. A
    loop visits the edges of the outline one by one; the methods update its state by an edge or by a
    chain of edges. The state is a tuple: the distance from the nearest edge so far, with numbers
    about this edge; whether the ray from the point towards +x has crossed an odd number of edges,
    so that the point is inside; and the bounds at the knots. Edges and chains are read as records
    (`OutlineEdges`).

    x, y: the query points, relative to the outline's center.
    velocity: the direction of the lines, of length 1 at most; None without lines.
    knots: increasing positions on the lines.
    error: a bound of the rounding of distances from boxes.
    unit: the machine epsilon.

    In detail, the state consists of these parts: the distance from the nearest edge so far, and its
    rounding error; x and y of the vector from the nearest point of that edge to the query point; x
    and y of the edge's unit normal; whether the nearest point lies inside the edge, so that it is
    no vertex; whether the ray towards +x has crossed an odd number of edges; and for each knot a
    lower bound of the distance there. The distance from an edge lies above its tangent at the start
    of the line, so the bound is the smallest value at the knot of all these tangents.
    """

    x: Real
    y: Real
    velocity: tuple[Real, Real] | None
    knots: tuple[Real, ...]
    error: Real
    unit: float

    def with_edge(self, row: list[Real], state: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return the state of the loop after one more edge was visited: a tuple, whose members the
        class docstring lists.

        row: the record of the edge from a to b: (ax, ay, bx, by, 1/length^2).
        state: the state before.
        """
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        from_x, from_y = self.x - row[0], self.y - row[1]
        edge_x, edge_y = row[2] - row[0], row[3] - row[1]
        # The nearest point of the edge, as a fraction of the edge; and the vector from it.
        fraction = dr.fma(from_x, edge_x, from_y * edge_y) * row[4]
        t = clamp(fraction, 0, 1)
        to_x, to_y = dr.fma(edge_x, -t, from_x), dr.fma(edge_y, -t, from_y)
        inverse_length, cross_product = dr.sqrt(row[4]), dr.fma(edge_x, from_y, -edge_y * from_x)
        is_inner = (fraction > 0) & (fraction < 1)
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        distance = dr.select(is_inner, dr.abs(cross_product) * inverse_length, distance)
        # A bound of the rounding of the distance: a few roundings of the vectors' components.
        size = dr.abs(from_x) + dr.abs(from_y) + dr.abs(edge_x) + dr.abs(edge_y)
        rounding = _VECTOR_ROUNDINGS * self.unit * size
        bounds = self._with_tangent(bounds, to_x, to_y, distance, rounding)
        # The ray towards +x crosses the edge if one end of the edge is above the ray, the other is
        # not, and the edge is to the right of the point.
        crosses = (row[1] > self.y) != (row[3] > self.y)
        # `cross_product` is positive if the point is to the left of the edge; if the edge goes
        # upwards, the edge is then to the right of the point.
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
        """Update the state of a loop over chains, a tuple of one number: the square of a distance
        within which some chain must have a point. The result is the smaller of the state and that
        square for one more chain.

        row: the record of the chain, which begins with its box: lowest x, lowest y, highest x,
            highest y.
        """
        (min_square,) = state
        near_x, far_x = self._distances_from_ends(self.x, row[0], row[2])
        near_y, far_y = self._distances_from_ends(self.y, row[1], row[3])
        # Each side of the box holds a point of the chain. For the nearer of the two vertical sides,
        # the farthest point is at the distance |(near_x, far_y)|; likewise for the horizontal
        # sides.
        square = fmin(near_x * near_x + far_y * far_y, far_x * far_x + near_y * near_y)
        return (fmin(square, min_square),)

    @staticmethod
    def _distances_from_ends(v: Real, lower: Real, upper: Real) -> tuple[Real, Real]:
        """The distances of a coordinate v from the nearer and from the farther of the two numbers
        `lower` and `upper`."""
        to_lower, to_upper = dr.abs(v - lower), dr.abs(v - upper)
        return fmin(to_lower, to_upper), fmax(to_lower, to_upper)

    def with_chain(
        self, row: list[Real], limit: Real, state: tuple[Any, ...]
    ) -> tuple[Real, tuple[Any, ...]]:
        """Decide whether the edges of a chain must be visited. Returns the number of edges to
        visit, and the state. If the box of the chain is within the distance `limit`, all its edges
        must be visited, and the state stays. If it is farther away, the number is 0, and the box is
        added to the state in place of the edges.

        row: the record of the chain: its box (lowest x, lowest y, highest x, highest y), y of its
            first and of its last vertex, the index of its first edge, and the number of its edges.
        limit: a distance within which the nearest edge lies.
        state: the state of the loop before, whose members the class docstring lists.
        """
        nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds = state
        to_x, to_y = self.x - clamp(self.x, row[0], row[2]), self.y - clamp(self.y, row[1], row[3])
        distance = dr.sqrt(dr.fma(to_x, to_x, to_y * to_y))
        is_near = distance <= limit
        # A far box bounds the distances from all its edges.
        bounds_with_box = self._with_tangent(bounds, to_x, to_y, distance, self.error)
        bounds = [dr.select(is_near, a, b) for a, b in zip(bounds, bounds_with_box, strict=True)]
        # A far chain crosses the ray towards +x an odd number of times if its ends are above and
        # below the ray and its box is to the right of the point.
        crosses = (row[4] > self.y) != (row[5] > self.y)
        inside = inside ^ (~is_near & crosses & (row[0] > self.x))
        count = dr.select(is_near, row[7], 0)
        return count, (nearest, error, away_x, away_y, normal_x, normal_y, on_edge, inside, *bounds)

    def _with_tangent(
        self, bounds: list[Real], x: Real, y: Real, distance: Real, error: Real
    ) -> list[Real]:
        """The lower bounds at the knots after one more edge or box was visited. Along the line, the
        distance from the edge or box lies above its tangent at the start. So at each knot the new
        bound is the smaller of the bound so far and of the tangent's value.

        bounds: the bounds so far, one for each knot.
        x, y: the vector from the nearest point of the edge or box to the query point.
        distance: the length of that vector.
        error: a bound of the error of that vector.
        """
        if self.velocity is None:
            return bounds
        # The direction of the vector is off by at most 2 error / distance.
        slope = (x * self.velocity[0] + y * self.velocity[1]) / distance - 2 * error / distance
        rounding = 4 * self.unit * distance
        return min_with_tangent(bounds, self.knots, distance - error, slope, rounding, self.unit)


def _chain_records(start: FloatArray, end: FloatArray, loop_index: IntArray) -> FloatArray:
    """The records of chains of consecutive edges (n, 8). For each chain: its box as (lowest x,
    lowest y, highest x, highest y), y of its first and of its last vertex, the index of its first
    edge, and the number of its edges.

    start, end: (n, 2) the ends of the edges.
    loop_index: (n,) a number for each edge. Edges of different numbers belong to different chains.

    Of n edges, chains of m edges make n/m chains. A query reads all chains twice, and the edges of
    about three chains: 2 n/m + 3 m records, which are fewest for m^2 = 2 n/3.
    """
    length = max(8, round(math.sqrt(2 * len(start) / 3)))
    rows: list[Any] = []
    # The index of the first edge of each run of edges with the same number; and the number of all
    # edges, as the end of the last run.
    loop_starts = np.concatenate([[0], np.flatnonzero(np.diff(loop_index)) + 1, [len(loop_index)]])
    for loop_start, loop_end in itertools.pairwise(loop_starts.tolist()):
        for k in range(loop_start, loop_end, length):
            stop = min(k + length, loop_end)
            ends = np.concatenate([start[k:stop], end[k:stop]])
            rows.append(
                [*ends.min(axis=0), *ends.max(axis=0), start[k, 1], end[stop - 1, 1], k, stop - k]
            )
    return np.array(rows, dtype=np.float64)


@dataclass(frozen=True)
class SignedDistanceEnclosure(Enclosure):
    """A proved bound of the change of a signed distance d along a line, from such a bound of |d|. d
    has the Lipschitz constant 1. The gaps are the differences between d at the start and the next
    level below and above.

    value: d at the start of the line.
    size: the enclosure of |d|.

    Proof. As long as |d| > 0, d keeps its sign. If d > 0, it falls as |d| does, down to 0, and
    rises as |d| does. If d < 0, it falls where |d| rises, and rises where |d| falls. And d changes
    by no more than the length of the line.
    """

    value: Real
    size: TangentEnclosure

    @classmethod
    def around(
        cls, nearest: OutlineSample, slope: Real, knots: tuple[Real, ...]
    ) -> SignedDistanceEnclosure:
        """The enclosure of d, from the sample of d at the start of the line.

        nearest: the sample, with lower bounds at the knots.
        slope: the derivative of d along the line at its start.
        knots: the positions on the line of the sample's lower bounds.
        """
        distance = dr.abs(nearest.value)
        # The slope of |d|, at most 1.
        max_slope = fmin(dr.mulsign(slope, nearest.value) + nearest.gradient_error, 1.0)
        return cls(
            nearest.value, TangentEnclosure(distance, max_slope, knots, nearest.lower_bounds)
        )

    def free_length(self, gaps: LevelGaps) -> Real:
        """The length of the line on which d is proved to meet neither the level below nor the level
        above.

        gaps: the differences between d at the start and these levels.
        """
        is_positive = self.value > 0
        # In terms of |d|: the gap towards 0 and the gap away from 0. Beyond the point at which d
        # passes 0, |d| tells nothing about d, so the first gap is taken as at most |d|.
        nearer = dr.select(is_positive, gaps.below, gaps.above)
        farther = dr.select(is_positive, gaps.above, gaps.below)
        length = self.size.free_length(LevelGaps(fmin(nearer, dr.abs(self.value)), farther))
        # NaN proves nothing. The Lipschitz constant 1 proves the smaller gap.
        is_valid = (gaps.below >= 0) & (gaps.above >= 0)
        # (1e-6 covers the rounding of the gap.)
        return dr.select(is_valid, fmax(length, fmin(gaps.below, gaps.above) * (1 - 1e-6)), 0)
