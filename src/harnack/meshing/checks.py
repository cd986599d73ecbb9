"""What a mesh of a level set has to satisfy, whatever made it."""

from __future__ import annotations

from typing import Any, Never, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.edges import Edges, IntArray, directed_edges

__all__ = [
    "LocalError",
    "MeshingError",
    "TooLargeError",
    "check_manifold",
    "euler_characteristic",
    "singular_vertices",
]


class MeshingError(ValueError):
    """A level set that could not be meshed; the message says why and what to do."""


class LocalError(MeshingError):
    """A check that failed in known places (k, 3), so that smaller cells there may be enough."""

    def __init__(self, message: str, places: FloatArray) -> None:
        super().__init__(message)
        self.places = places


class TooLargeError(MeshingError):
    """A mesh that would be so large that it was not begun."""


def euler_characteristic(faces: IntArray) -> int:
    """Vertices in use, less edges, and faces."""
    vertices = int(np.count_nonzero(np.bincount(faces.ravel())))
    return vertices - len(Edges.of(directed_edges(faces)).ends) + len(faces)


def check_manifold(faces: IntArray, vertices: FloatArray | None = None) -> None:
    """Raise unless every edge has one or two faces, which run it in opposite directions, and the
    faces around every vertex are joined by edges.

    vertices: (n, 3), to say where not.

    Raises:
        MeshingError: otherwise; a LocalError, given vertices.
    """

    def fail(message: str, where: IntArray) -> Never:
        if vertices is None:
            raise MeshingError(message)
        raise LocalError(message, vertices[where])

    pairs = directed_edges(faces)
    edges = Edges.of(pairs)
    index, uses = edges.index, edges.uses
    if (uses > 2).any():
        fail(
            f"{(uses > 2).sum()} edges of the mesh have more than two faces: the level set crosses "
            "itself, or cells are too large for it; choose a smaller `spacing`, or another level",
            np.unique(pairs[uses[index] > 2]),
        )
    ways = np.bincount(index, np.where(pairs[:, 0] < pairs[:, 1], 1, -1), minlength=len(uses))
    if ((uses == 2) & (ways != 0)).any():
        fail(
            "neighbouring faces of the mesh do not agree on its two sides: cells are too large for "
            "this level set; choose a smaller `spacing`",
            np.unique(pairs[((uses == 2) & (ways != 0))[index]]),
        )
    if _fans(faces, index, uses)[0] > np.count_nonzero(np.bincount(faces.ravel())):
        fail(
            "sheets of the mesh touch in a point: cells are too large for this level set; choose a "
            "smaller `spacing`, or another level",
            singular_vertices(faces),
        )


def singular_vertices(faces: IntArray) -> IntArray:
    """Vertices, by index, at which faces (m, 3) are not a manifold: those of edges with more than
    two faces, and those that have more than one fan of faces."""
    pairs, count = directed_edges(faces), int(faces.max(initial=-1)) + 1
    edges = Edges.of(pairs)
    many = np.unique(pairs[edges.uses[edges.index] > 2])
    _, fan = _fans(faces, edges.index, edges.uses)
    # Each fan once, at its vertex.
    _, first = np.unique(fan, return_index=True)
    fans = np.bincount(faces.ravel()[first], minlength=count)
    return np.union1d(many, np.flatnonzero(fans > 1))


def _fans(faces: IntArray, edge: IntArray, uses: IntArray) -> tuple[int, IntArray]:
    """How many fans of faces, joined by edges, all vertices have together, and of each corner of
    the faces (3m,) the fan that it belongs to."""
    import scipy.sparse  # here: half a second that few need
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    m = len(faces)
    corner = np.arange(3 * m).reshape(m, 3)
    # Corners at both ends of the edge k of a face, in the order of `directed_edges`.
    first = np.concatenate([corner[:, 0], corner[:, 1], corner[:, 2]])
    second = np.concatenate([corner[:, 1], corner[:, 2], corner[:, 0]])
    order = np.argsort(edge, kind="stable")
    pairs = order[np.isin(edge[order], np.flatnonzero(uses == 2))].reshape(-1, 2)
    one, other = pairs[:, 0], pairs[:, 1]  # run in opposite directions
    rows = np.concatenate([first[one], second[one]])
    columns = np.concatenate([second[other], first[other]])
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(3 * m, 3 * m))
    number, fan = csgraph.connected_components(joined, directed=False)
    return int(number), np.asarray(fan, np.int64)
