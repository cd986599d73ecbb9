"""Whether parts of a level set were missed by a lattice: thin walls, knife edges, small islands."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import MeshingError
from harnack.meshing.edges import IntArray
from harnack.meshing.points import newton
from harnack.meshing.rows import lengths
from harnack.meshing.samples import LevelFunction, Samples

__all__ = ["MissedError", "check_nothing_missed"]

# Lengths in cells: how near the level seems to a point; how far it may be moved to it; how far what
# is found has to be from all triangles, by their corners and centres, which are less than half a
# cell from all that is on them; and from the faces of the box, beyond which there may be more.
_NEAR, _FOUND, _APART, _DEEP = 1.0, 1.5, 0.75, 0.5
# Points nearer than the first belong together; parts at least as long as the second are missed.
_TOGETHER, _LONG = 1.0, 2.0
# How near to the level, in cells, a point has to come by Newton's method.
_ON = 1e-3


class MissedError(MeshingError):
    """A level set of which some parts lie between the points of a lattice."""


def check_nothing_missed(
    function: LevelFunction,
    points: FloatArray,
    samples: Samples,
    is_beside: BoolArray,
    surface: tuple[FloatArray, IntArray],
    size: float,
    box: tuple[FloatArray, FloatArray],
) -> None:
    """Raise if the level set has parts, two cells long or longer, away from its triangles.

    Signs at the points of a lattice do not see a wall between two of them. Its sides are found from
    there by Newton's method: what it ends at, on the level, should be near triangles. So many
    points are a dense sample, and no proof. Islands smaller than a cell may be missed.

    samples: at points (n, 3) of the lattice. is_beside: (n,) those of tetrahedra that are cut.
        surface: vertices and faces. size: of a cell. box: where the level set counts.

    Raises:
        MissedError: with one of the places.
    """
    import scipy.spatial  # here: half a second that few need

    searching: Any = scipy.spatial
    rows = np.flatnonzero(~is_beside & (samples.distance < _NEAR * size))
    if not len(rows):
        return
    start = points[rows]
    step = np.full(len(rows), 0.5 * size)
    x = newton(function, start, samples.some(rows), step, None)
    found = function.at(x).distance < _ON * size
    found &= lengths(x - start) < _FOUND * size
    deep = _DEEP * size
    found &= ((x >= box[0] + deep) & (x <= box[1] - deep)).all(axis=1)
    x = x[found]
    vertices, faces = surface
    if len(faces) and len(x):
        around = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
        x = x[searching.cKDTree(around).query(x)[0] > _APART * size]
    part = _longest_part(x, _TOGETHER * size)
    if len(part) and np.ptp(part, axis=0).max() >= _LONG * size:
        a, b, c = part[0]
        raise MissedError(
            f"cells of {size:.3g} miss parts of the level set, such as that at ({a:.4g}, {b:.4g}, "
            f"{c:.4g}), which are thinner or smaller: choose a smaller `spacing`, or for a wall or "
            "an edge make the solid of smooth parts, such as hk.solid(f, between=(low, high)) or "
            "hk.solid(f, below=0) & hk.solid(g, below=0)"
        )


def _longest_part(x: FloatArray, apart: float) -> FloatArray:
    """Of points (n, 3) those of the longest chain of which neighbours are no farther apart."""
    import scipy.sparse  # here: half a second that few need
    import scipy.sparse.csgraph as csgraph_module
    import scipy.spatial

    sparse, csgraph, searching = (
        cast("Any", one) for one in (scipy.sparse, csgraph_module, scipy.spatial)
    )
    if not len(x):
        return x
    one, other = searching.cKDTree(x).query_pairs(apart, output_type="ndarray").T
    joined = sparse.coo_matrix((np.ones(len(one)), (one, other)), shape=(len(x), len(x)))
    count, part = csgraph.connected_components(joined, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, x)
    np.maximum.at(high, part, x)
    return x[part == (high - low).max(axis=1).argmax()]
