"""Lattices of struts: periodic graphs in space, of nodes and edges, from which `Lattice.struts`
makes a solid. Nodes have integer coordinates in fractions of a cell, so that neighboring cells
share theirs exactly, and no edge is there twice."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import choose_backend, to_vector3
from harnack.backend.validation import (
    as_positive,
    as_triple,
    no_derivatives,
)
from harnack.fields.solids.patterns import checked_counts
from harnack.fields.solids.solid import Solid
from harnack.fields.solids.struts import struts
from harnack.fields.solids.tube import checked_pairs, checked_points
from harnack.geometry import Volume

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy.typing as npt

    from harnack.backend import BoolArray, FloatArray, IntArray

_Steps = tuple[int, int, int]
# Edges are compared with a solid at so many points each.
_POINTS_OF_EDGE = 9


@dataclass(frozen=True, eq=False)
class Lattice:
    """A graph in space: nodes, and edges between them.

    nodes: (n, 3) points.
    edges: (m, 2) indices of nodes, counted from 0.

    `harnack.lattice` has functions that make lattices. One of your own is Lattice(nodes, edges).

    Raises:
        ValueError: arrays of other shapes, numbers that are not finite, an index out of range, or
            an edge without a length.
    """

    nodes: FloatArray
    edges: IntArray

    def __post_init__(self) -> None:
        """Check the arrays, and make them read-only."""
        nodes = checked_points(self.nodes, ("node", "a lattice"))
        object.__setattr__(self, "nodes", nodes)
        edges = checked_pairs(self.edges, nodes, ("edge", "node", "a lattice"))
        object.__setattr__(self, "edges", edges)

    def __repr__(self) -> str:
        return f"Lattice({len(self.nodes):,} nodes, {len(self.edges):,} edges)"

    @property
    def coordination(self) -> IntArray:
        """The number of edges at each node (n,)."""
        return np.bincount(self.edges.ravel(), minlength=len(self.nodes))

    def struts(self, radius: npt.ArrayLike, *, smooth: float | None = None) -> Solid:
        """The solid around the edges (`harnack.solids.struts`).

        radius: a number, or (n,), one for each node.
        smooth: the radius of fillets between struts; None for none.
        """
        return struts(self.nodes, self.edges, radius, smooth=smooth)

    def clipped(self, region: Volume | Solid) -> Lattice:
        """The lattice of the edges that touch a region, whole, with their nodes. To cut struts at
        the region's surface, intersect them with it: lattice.clipped(solid).struts(0.1) & solid.

        region: a volume such as hk.Ball, or a solid whose Lipschitz constant is known, as that of
            all shapes. No edge that touches a solid is lost, but edges may be kept that pass it
            within 1/16 of their length.

        Raises:
            ValueError: no edge touches the region; or a solid without a Lipschitz constant.
            TypeError: neither a volume nor a solid.
        """
        start, end = (self.nodes[ends] for ends in self.edges.T)
        is_kept = _touches(region, start, end)
        if not is_kept.any():
            raise ValueError(f"no edge of the lattice touches the region {region!r}")
        used, edges = np.unique(self.edges[is_kept], return_inverse=True)
        return Lattice(self.nodes[used], edges.reshape(-1, 2))


def _touches(region: Any, start: FloatArray, end: FloatArray) -> BoolArray:
    """Whether segments from `start` to `end`, (m, 3) each, touch a region, as `Lattice.clipped`
    says."""
    if isinstance(region, Volume):
        backend = choose_backend("double")
        first, last = region.clip(
            to_vector3(backend, start), to_vector3(backend, end - start),
            backend.Float(0), backend.Float(1),
        )  # fmt: skip
        is_crossed = np.array(first <= last) & np.ones(len(start), bool)
        return is_crossed | region.contains_points(start) | region.contains_points(end)
    if not isinstance(region, Solid):
        raise TypeError(
            f"a lattice is clipped to a volume or a solid, not to {type(region).__name__}"
        )
    if region.lipschitz is None:
        raise ValueError(
            f"{type(region).__name__} has no Lipschitz constant, which tells edges that are "
            "certainly outside: clip the lattice to its box, and intersect the struts with it"
        )
    t = np.linspace(0.0, 1.0, _POINTS_OF_EDGE)[:, None, None]
    points = start + t * (end - start)
    values = region.value(points.reshape(-1, 3), precision="double").reshape(points.shape[:2])
    # No point of an edge is farther from the nearest of these than half of their distance.
    reach = 0.5 * np.linalg.norm(end - start, axis=1) / (_POINTS_OF_EDGE - 1) * (1 + 1e-9)
    return (values <= region.lipschitz * reach).any(axis=0)


@dataclass(frozen=True)
class _UnitCell:
    """A cubic cell of a periodic graph.

    divisions: the number of parts of a side; coordinates are whole numbers of these.
    bonds: pairs of a node in the cell and the steps to its neighbor, each edge of the graph once.
    """

    divisions: int
    bonds: tuple[tuple[_Steps, _Steps], ...]

    def lattice(self, cell: Any, counts: Any, region: Any) -> Lattice:
        """The lattice of this cell, with the arguments of `cubic`."""
        sides = np.array(_checked_sides(cell))
        if (counts is None) == (region is None):
            raise ValueError("give counts, how many cells there are, or a region that they fill")
        if region is None:
            numbers, center = checked_counts(counts), np.zeros(3)
        else:
            lower, upper = _bounds(region)
            # A cell that would only be touched, but for rounding, is none.
            cells = [max(1, math.ceil(n - 1e-9)) for n in (upper - lower) / sides]
            numbers, center = (cells[0], cells[1], cells[2]), 0.5 * (lower + upper)
        ends = self._edges_of_block(np.array(numbers))
        points, edges = np.unique(ends.reshape(-1, 3), axis=0, return_inverse=True)
        nodes = (points / self.divisions - 0.5 * np.array(numbers)) * sides + center
        whole = Lattice(nodes, edges.reshape(-1, 2))
        return whole if region is None else whole.clipped(region)

    def _edges_of_block(self, counts: IntArray) -> IntArray:
        """The edges of a block of cells: the coordinates (m, 2, 3) of their ends, both in the block
        or on its border. They come along a Morton curve, so that neighbors in the list are near."""
        last = self.divisions * counts
        cells = np.indices(tuple(counts + 1)).reshape(3, -1).T
        corners: IntArray = self.divisions * cells
        pieces: list[IntArray] = []
        for node, steps in self.bonds:
            start: IntArray = corners + np.array(node)
            ends: IntArray = np.stack([start, start + np.array(steps)], axis=1)
            pieces.append(ends[((ends >= 0) & (ends <= last)).all(axis=(1, 2))])
        edges = np.concatenate(pieces)
        return edges[np.argsort(_morton_codes(edges.sum(axis=1)), kind="stable")]


def _morton_codes(points: IntArray) -> IntArray:
    """The positions along a Morton curve of points (n, 3) with whole coordinates from 0 to below
    2^20: their bits interleaved."""
    codes = np.zeros(len(points), np.int64)
    for bit in range(20):
        for k in range(3):
            codes |= ((points[:, k] >> bit) & 1) << (3 * bit + k)
    return codes


def _checked_sides(cell: Any) -> tuple[float, float, float]:
    """The sides of a cell, from one positive number or three."""
    name = "the cell of a lattice"
    if np.ndim(cell) == 0:
        side = as_positive(cell, name)
        return side, side, side
    return as_triple(cell, name, all_positive=True)


def _bounds(region: Any) -> tuple[FloatArray, FloatArray]:
    """The corners of a box around a region, a volume or a solid.

    Raises:
        TypeError: neither of them.
        ValueError: no such box is known.
    """
    if not isinstance(region, Volume | Solid):
        raise TypeError(
            "the region of a lattice must be a volume or a solid, such as hk.Cylinder(20, 40), not "
            f"{type(region).__name__}"
        )
    volume = region.sublevel_extent(0.0) if isinstance(region, Solid) else region
    lower, upper = (np.full(3, -np.inf), np.full(3, np.inf)) if volume is None else volume.bounds()
    if not np.isfinite([lower, upper]).all():
        raise ValueError(
            f"the region {region!r} of a lattice has no bounds: intersect it with a box"
        )
    return lower, upper


def _signed(steps: _Steps) -> tuple[_Steps, ...]:
    """All vectors with the same absolute coordinates, of any signs."""
    choices = [(v, -v) if v else (0,) for v in steps]
    return tuple((a, b, c) for a, b, c in itertools.product(*choices))


def _halves(vectors: Iterable[_Steps]) -> tuple[_Steps, ...]:
    """One of each pair of opposite vectors."""
    return tuple(vector for vector in vectors if vector > (0, 0, 0))


def _sum(a: Sequence[int], b: Sequence[int], factor: int = 1) -> _Steps:
    """The vector a + factor b."""
    x, y, z = (u + factor * v for u, v in zip(a, b, strict=True))
    return x, y, z


_FACE_DIAGONALS = (*_signed((1, 1, 0)), *_signed((1, 0, 1)), *_signed((0, 1, 1)))
_FACE_CENTERED = ((0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1))
# The four bonds of an atom of diamond, of the kind that lies within cells.
_TETRAHEDRON = ((-1, -1, -1), (1, 1, -1), (1, -1, 1), (-1, 1, 1))


def _diamond_bonds() -> tuple[tuple[_Steps, _Steps], ...]:
    """The bonds of diamond, in quarters of a cell: from the four atoms within it."""
    atoms = (tuple(2 * v + 1 for v in corner) for corner in _FACE_CENTERED)
    return tuple((_sum(atom, (0, 0, 0)), bond) for atom in atoms for bond in _TETRAHEDRON)


def _kagome_bonds() -> tuple[tuple[_Steps, _Steps], ...]:
    """The edges of the kagome lattice, in eighths of a cell. Its nodes are the middles of the bonds
    of diamond: an atom within cells has them at its tetrahedron, and one at a corner or in the
    middle of a face at the opposite one."""
    bonds: list[tuple[_Steps, _Steps]] = []
    for corner in _FACE_CENTERED:
        for sign, atom in ((1, tuple(4 * v + 2 for v in corner)), (-1, [4 * v for v in corner])):
            for a, b in itertools.combinations(_TETRAHEDRON, 2):
                steps = _sum(b, a, -1)
                bonds.append((_sum(atom, a, sign), _sum((0, 0, 0), steps, sign)))
    return tuple(bonds)


_CUBIC = _UnitCell(1, tuple(((0, 0, 0), steps) for steps in ((1, 0, 0), (0, 1, 0), (0, 0, 1))))
_BCC = _UnitCell(2, tuple(((1, 1, 1), steps) for steps in _signed((1, 1, 1))))
_FCC = _UnitCell(2, tuple(((0, 0, 0), steps) for steps in _FACE_DIAGONALS))
_OCTET = _UnitCell(
    2, tuple((node, steps) for node in _FACE_CENTERED for steps in _halves(_FACE_DIAGONALS))
)
_DIAMOND = _UnitCell(4, _diamond_bonds())
_KAGOME = _UnitCell(8, _kagome_bonds())


@no_derivatives
def cubic(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The simple cubic lattice: the edges of the cells. In the interior 6 edges meet at each node.

    cell: the side of a cell, or its three sides.
    counts: the number of cells along each axis, or three numbers. The block of cells is centered at
        the origin.
    region: instead of counts, a volume such as hk.Ball, or a solid, whose box is filled with cells,
        from its center. The edges that touch it are kept (`Lattice.clipped`).

    Raises:
        ValueError: a cell that is not positive, counts that are not positive integers, both counts
            and a region or none of them, or a region without bounds.
        TypeError: a region that is neither a volume nor a solid.
    """
    return _CUBIC.lattice(cell, counts, region)


@no_derivatives
def bcc(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The body-centered cubic lattice: each cell's center is joined to its eight corners. In the
    interior 8 edges meet at each node.

    cell, counts, region: as for `cubic`, with the same errors.
    """
    return _BCC.lattice(cell, counts, region)


@no_derivatives
def fcc(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The face-centered cubic cell: the diagonals of all faces. In the interior 12 edges meet at a
    corner, and 4 in the center of a face. (With the edges between the centers of faces it is
    `octet`, in which all nodes are alike.)

    cell, counts, region: as for `cubic`, with the same errors.
    """
    return _FCC.lattice(cell, counts, region)


@no_derivatives
def octet(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The octet truss, of octahedra and tetrahedra (Fuller 1961): the nodes are the corners and the
    centers of the faces of cells, and each is joined to all nearest ones. In the interior 12 edges
    meet at each node.

    cell, counts, region: as for `cubic`, with the same errors.
    """
    return _OCTET.lattice(cell, counts, region)


@no_derivatives
def diamond(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The bonds of diamond. In the interior 4 edges meet at each node, at equal angles if cells are
    cubes.

    cell, counts, region: as for `cubic`, with the same errors.
    """
    return _DIAMOND.lattice(cell, counts, region)


@no_derivatives
def kagome(
    cell: float | Sequence[float],
    counts: int | Sequence[int] | None = None,
    *,
    region: Volume | Solid | None = None,
) -> Lattice:
    """The three-dimensional kagome lattice, of tetrahedra that share corners (pyrochlore): its
    nodes are the middles of the bonds of diamond. In the interior 6 edges meet at each node.

    cell, counts, region: as for `cubic`, with the same errors.
    """
    return _KAGOME.lattice(cell, counts, region)
