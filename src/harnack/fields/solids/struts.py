"""Struts: the solid around the edges of a graph in space, such as a lattice or a truss. It is a
union of capsules or of round cones, one for each edge."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.arithmetic import cone_distance, minimum, segment_distance
from harnack.arithmetic.operators import FormulaNumber, Tally, tally_of
from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.backend.validation import check_no_derivatives
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.number_table import AlikeParts, NumberTable, detached, plain_numbers
from harnack.fields.parameters import kept_arguments
from harnack.fields.solids.booleans import BooleanSolid, smooth_union
from harnack.fields.solids.round_cones import (
    Capsule,
    PlainCone,
    RoundCone,
    axial_frames,
    cone_numbers,
)
from harnack.fields.solids.solid import FormulaSolid, box_around, by_numbers, set_frozen
from harnack.fields.solids.tube import checked_pairs, checked_points, checked_radii
from harnack.fields.tape_evaluator import tape_evaluator

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from harnack.backend import Backend
    from harnack.fields.formula_evaluator import FormulaEvaluator
    from harnack.fields.number_table import NumberReader
    from harnack.fields.solids.solid import Solid
    from harnack.geometry import Volume


@dataclass(frozen=True, eq=False)
class Struts(FormulaSolid):
    """The union of struts, one for each edge of a graph. A strut is the convex hull of two balls, a
    capsule or a round cone (`RoundCone`); f is the least of their signed distances. `struts` makes
    one from any arrays.

    nodes: (n, 3) points.
    edges: (m, 2) indices of nodes, counted from 0.
    radii: (n,) of the balls about the nodes.
    """

    nodes: FloatArray
    edges: IntArray
    radii: FloatArray

    traits = by_numbers("nodes", "radii")

    lipschitz = Capsule.lipschitz

    def __post_init__(self) -> None:
        """Check the arrays, and make them read-only."""
        nodes = checked_points(detached(self.nodes), ("node", "struts"))
        edges = checked_pairs(self.edges, nodes, ("edge", "node", "struts"))
        radii = checked_radii(detached(self.radii), len(nodes), ("node", "struts"))
        for name, entries in (("nodes", nodes), ("edges", edges), ("radii", radii)):
            entries.setflags(write=False)
            set_frozen(self, name, entries)

    def __repr__(self) -> str:
        return f"Struts({len(self.nodes):,} nodes, {len(self.edges):,} edges)"

    @classmethod
    def of(cls, parts: Sequence[Capsule | RoundCone]) -> Struts:
        """The union of capsules and round cones."""
        nodes = np.array([end for part in parts for end in (part.start, part.end)])
        radii = [
            (part.radius, part.radius) if isinstance(part, Capsule) else part.radii
            for part in parts
        ]
        return cls(nodes, np.arange(2 * len(parts)).reshape(-1, 2), np.array(radii).ravel())

    def with_read_numbers(self, numbers: NumberReader) -> BooleanSolid:
        """The same function of the nodes and radii with their derivatives."""
        if not isinstance(numbers, NumberTable):
            raise TypeError("the numbers of struts are read from a table")
        kept, radii = kept_arguments(self), self.radii[self.edges]
        ends = np.where((radii[:, 1] > radii[:, 0])[:, None], self.edges[:, ::-1], self.edges)
        node_places = numbers.places(kept.get("nodes"), self.nodes.size).reshape(-1, 3)
        own_radii = kept.get("radii")
        is_single = own_radii is not None and plain_numbers(own_radii).size == 1
        radius_places = numbers.places(own_radii, 1 if is_single else len(self.radii))
        radius_places = np.broadcast_to(radius_places, len(self.radii))
        values = np.hstack([self.nodes[ends].reshape(-1, 6), self.radii[ends]])
        places = np.hstack([node_places[ends].reshape(-1, 6), radius_places[ends]])
        length = np.linalg.norm(values[:, 3:6] - values[:, :3], axis=1)
        is_nested = cone_numbers(length, values[:, 6:])[0]
        parts: list[Any] = []
        for is_ball in (False, True):
            chosen = is_nested == is_ball
            make = functools.partial(PlainCone.read, is_ball)
            if chosen.any():
                parts.append(
                    AlikeParts(numbers, values[chosen], places[chosen], make, is_least=True)
                )
        return BooleanSolid.of_functions(tuple(parts), is_union=True)

    def strut(self, number: int) -> Capsule | RoundCone:
        """The strut of the edge with this number."""
        a, b = self.edges[number].tolist()
        start, end = ((x, y, z) for x, y, z in self.nodes[[a, b]].tolist())
        first, second = float(self.radii[a]), float(self.radii[b])
        if first == second:
            return Capsule(start, end, first)
        return RoundCone(start, end, (first, second))

    @functools.cached_property
    def _rows(self) -> tuple[FloatArray, BoolArray]:
        """For each strut the numbers of its distance and then its radius, in a row (m, 16) that is
        padded; and whether it is a cone (m,)."""
        radii = self.radii[self.edges]
        larger = np.where(radii[:, 1] > radii[:, 0], 1, 0)
        ends = np.stack([larger, 1 - larger], axis=1)
        radii = np.take_along_axis(radii, ends, axis=1)
        nodes = np.take_along_axis(self.edges, ends, axis=1)
        start, end = self.nodes[nodes[:, 0]], self.nodes[nodes[:, 1]]
        vector = end - start
        length = np.linalg.norm(vector, axis=1)
        is_nested, slope, ratio = cone_numbers(length, radii)
        is_cone = (radii[:, 0] != radii[:, 1]) & ~is_nested
        # A ball that contains the other one is a capsule without a length.
        reach = np.where(is_nested, 0.0, 0.5 * length)
        origins = np.where((is_cone | is_nested)[:, None], start, 0.5 * start + 0.5 * end)
        frames = axial_frames(origins, vector)
        nothing = np.zeros((len(frames), 2))
        capsules = np.column_stack([frames, reach, radii[:, 0], nothing])
        cones = np.column_stack([frames, length, slope, ratio, radii[:, 0]])
        return np.where(is_cone[:, None], cones, capsules), is_cone

    def _strut_function(self, number: int, point: tuple[Any, Any, Any]) -> Any:
        """The function of the strut of an edge."""
        rows, is_cone = self._rows
        numbers = rows[number].tolist()
        if is_cone[number]:
            return cone_distance(point, numbers[:12], *numbers[12:15]) - numbers[15]
        return segment_distance(point, numbers[:12], numbers[12]) - numbers[13]

    def formula(self, x: Any, y: Any, z: Any) -> Any:
        point, (rows, is_cone) = (x, y, z), self._rows
        values: list[Any] = []
        if isinstance(x, FormulaNumber):
            kinds = (("round cone", rows[is_cone]), ("capsule", rows[~is_cone, :14]))
            values = [x.least_of_rows(name, point, own) for name, own in kinds if len(own)]
        if not values or values[0] is None:
            values = [self._strut_function(k, point) for k in range(len(rows))]
        return minimum(*values) if len(values) > 1 else values[0]

    @functools.cached_property
    def tally(self) -> Tally:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The summary of the formula's operations, of those struts whose numbers are the largest:
        others turn less sharply."""
        start, end = self.nodes[self.edges.T]
        first, second = self.radii[self.edges.T]
        length = np.linalg.norm(end - start, axis=1)
        farthest = np.abs(start + end).max(axis=1)
        steepest = np.abs(first - second) / length
        numbers = {int(entries.argmax()) for entries in (farthest, length, steepest)}

        def least(x: Any, y: Any, z: Any) -> Any:
            """The least of their functions."""
            values = [self._strut_function(k, (x, y, z)) for k in numbers]
            return functools.reduce(minimum, values)

        return tally_of(least)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> FormulaEvaluator:
        # Few are interpreted as well, so that another graph compiles nothing.
        return tape_evaluator(self, backend, plan, shortest=0) or super().evaluator(backend, plan)

    def sublevel_extent(self, level: float = 0.0, *, above: bool = False) -> Volume | None:
        """The box around all balls, whose radii grow by the level. None if `above`, as then the
        points are unbounded."""
        if above:
            return None
        used = np.unique(self.edges)
        reach = (self.radii[used] + level)[:, None]
        low, high = (self.nodes[used] - reach).min(axis=0), (self.nodes[used] + reach).max(axis=0)
        half, center = (0.5 * high - 0.5 * low).tolist(), (0.5 * high + 0.5 * low).tolist()
        return box_around((half[0], half[1], half[2]), center)


def struts(
    nodes: npt.ArrayLike,
    edges: npt.ArrayLike,
    radius: npt.ArrayLike,
    *,
    smooth: float | None = None,
) -> Solid:
    """The solid around the edges of a graph: the union of all struts. A strut is a capsule or,
    where the radii of its two nodes differ, a round cone (`RoundCone`).

    nodes: (n, 3) points.
    edges: (m, 2) indices of nodes, counted from 0.
    radius: a number, the radius of all struts; or (n,), one for each node.
    smooth: the radius of fillets between struts (`smooth_union`); None for none.

    Ends are round, so that the struts at a node join without gaps. In contrast to `TubeNetwork`,
    the result is a solid, which is combined, cut and moved.

    Raises:
        ValueError: arrays of other shapes, numbers that are not finite, an index out of range, an
            edge without a length, or a radius that is not positive.
    """
    graph = Struts(nodes, edges, radius)  # type: ignore[arg-type]
    if smooth is None:
        return graph
    check_no_derivatives("struts with fillets", nodes, radius)
    return smooth_union([graph.strut(k) for k in range(len(graph.edges))], smooth)
