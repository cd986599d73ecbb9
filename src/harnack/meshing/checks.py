"""What a mesh of a level set has to satisfy, whatever made it."""

from __future__ import annotations

from typing import Any, Never, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.tetrahedra import IntArray, edge_keys

__all__ = [
    "LocalError",
    "MeshingError",
    "TooLargeError",
    "boundary_edges",
    "check_manifold",
    "directed_edges",
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


def directed_edges(faces: IntArray) -> IntArray:
    """(3m, 2): the edges of faces (m, 3), as they are run: all first ones (corners 0 and 1), then
    all second and all third ones."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def boundary_edges(faces: IntArray) -> IntArray:
    """(k, 2): edges of one face only, as it runs them."""
    edges = directed_edges(faces)
    count = int(faces.max(initial=-1)) + 1
    _, index, uses = np.unique(edge_keys(edges, count), return_inverse=True, return_counts=True)
    return edges[uses[index] == 1]


def euler_characteristic(faces: IntArray) -> int:
    """Vertices in use, less edges, and faces."""
    import trimesh  # here: half a second that few need

    nowhere = np.zeros((int(faces.max(initial=-1)) + 1, 3))
    surface: Any = trimesh.Trimesh(nowhere, faces, process=False, validate=False)
    return int(surface.euler_number)


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

    edges, count = directed_edges(faces), int(faces.max(initial=-1)) + 1
    _, index, uses = np.unique(edge_keys(edges, count), return_inverse=True, return_counts=True)
    if (uses > 2).any():
        fail(
            f"{(uses > 2).sum()} edges of the mesh have more than two faces: the level set crosses "
            "itself, or cells are too large for it; choose a smaller `spacing`, or another level",
            np.unique(edges[uses[index] > 2]),
        )
    ways = np.zeros(len(uses), np.int64)
    np.add.at(ways, index, np.where(edges[:, 0] < edges[:, 1], 1, -1))
    if ((uses == 2) & (ways != 0)).any():
        fail(
            "neighbouring faces of the mesh do not agree on its two sides: cells are too large for "
            "this level set; choose a smaller `spacing`",
            np.unique(edges[((uses == 2) & (ways != 0))[index]]),
        )
    if _fans(faces, index, uses)[0] > len(np.unique(faces)):
        fail(
            "sheets of the mesh touch in a point: cells are too large for this level set; choose a "
            "smaller `spacing`, or another level",
            singular_vertices(faces),
        )


def singular_vertices(faces: IntArray) -> IntArray:
    """Vertices, by index, at which faces (m, 3) are not a manifold: those of edges with more than
    two faces, and those that have more than one fan of faces."""
    edges, count = directed_edges(faces), int(faces.max(initial=-1)) + 1
    _, index, uses = np.unique(edge_keys(edges, count), return_inverse=True, return_counts=True)
    many = np.unique(edges[uses[index] > 2])
    _, fan = _fans(faces, index, uses)
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
