"""Struts: the solid around the edges of a graph in space, such as a lattice or a truss. It is a
union of capsules or of round cones, one for each edge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harnack.backend.validation import (
    as_real_array,
    check_coordinate_size,
    check_finite,
    check_vectors,
    no_derivatives,
)
from harnack.fields.solids.booleans import smooth_union, union
from harnack.fields.solids.round_cones import Capsule, RoundCone
from harnack.fields.solids.tube import checked_pairs, checked_radii

if TYPE_CHECKING:
    import numpy.typing as npt

    from harnack.backend import FloatArray
    from harnack.fields.solids.solid import Point, Solid


@no_derivatives
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

    Part k of the union is the strut of edge k. Ends are round, so that the struts at a node join
    without gaps. In contrast to `TubeNetwork`, the result is a solid, which is combined, cut and
    moved.

    Raises:
        ValueError: arrays of other shapes, numbers that are not finite, an index out of range, an
            edge without a length, or a radius that is not positive.
    """
    array = as_real_array(nodes, "the nodes of struts")
    check_vectors(array, "the nodes of struts")
    points: FloatArray = np.array(array, dtype=np.float64)
    check_finite(points, "node {} of struts", ValueError)
    check_coordinate_size(points, ValueError)
    pairs = checked_pairs(edges, points, ("edge", "node", "struts"))
    radii = checked_radii(radius, len(points), ("node", "struts"))
    ends: list[list[int]] = pairs.tolist()
    corners: list[Point] = [(x, y, z) for x, y, z in points.tolist()]
    sizes: list[float] = radii.tolist()
    parts: list[Solid] = [
        Capsule(corners[a], corners[b], sizes[a])
        if sizes[a] == sizes[b]
        else RoundCone(corners[a], corners[b], (sizes[a], sizes[b]))
        for a, b in ends
    ]
    return union(parts) if smooth is None else smooth_union(parts, smooth)
