"""What a mesh of a level set has to satisfy, whatever made it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Never, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.meshing.edges import Edges, IntArray, boundary_edges, directed_edges, lengths
from harnack.meshing.intersections import intersecting_faces

if TYPE_CHECKING:
    from harnack.geometry import Volume
    from harnack.meshing.samples import LevelFunction

__all__ = [
    "LocalError",
    "MeshingError",
    "TooLargeError",
    "check_apart",
    "check_count",
    "check_inside",
    "check_manifold",
    "check_near_level",
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
            "neighboring faces of the mesh do not agree on its two sides: cells are too large for "
            "this level set; choose a smaller `spacing`",
            np.unique(pairs[((uses == 2) & (ways != 0))[index]]),
        )
    if _fans(faces, index, uses)[0] > np.count_nonzero(np.bincount(faces.ravel())):
        fail(
            "sheets of the mesh touch in a point: cells are too large for this level set; choose a "
            "smaller `spacing`, or another level",
            singular_vertices(faces),
        )


def check_apart(vertices: FloatArray, faces: IntArray) -> None:
    """Raise if a vertex is no point, or if faces pass through each other or lie on each other;
    decided exactly.

    Raises:
        MeshingError: so; a LocalError with the centers of these faces.
    """
    if not np.isfinite(vertices).all():
        raise MeshingError("vertices of the mesh are no numbers: choose another level or `clip`")
    crossing = intersecting_faces(vertices, faces)
    if len(crossing):
        places = vertices[faces[crossing]].mean(axis=1)
        raise LocalError(
            f"{len(crossing):,} of {len(faces):,} triangles pass through each other, such as near "
            f"{_point(places[0])}: choose a smaller `spacing` or a larger `tolerance`",
            places,
        )


def check_count(expected: float, most: int) -> None:
    """Raise TooLargeError if more triangles are expected than may be made."""
    if expected > most:
        raise TooLargeError(
            f"the mesh takes about {expected:.2g} triangles, and max_triangles is {most:,}: choose "
            "a larger `tolerance` or `spacing`, a smaller `clip`, or a larger max_triangles"
        )


def check_inside(vertices: FloatArray, volume: Volume, slack: float) -> None:
    """Raise if a vertex lies outside of a volume padded by `slack`."""
    out = ~volume.padded(slack).contains_points(vertices)
    if out.any():
        raise MeshingError(
            f"{out.sum():,} vertices of the mesh lie outside of what was asked for, such as "
            f"{_point(vertices[out][0])}: choose a smaller `spacing`"
        )


def check_near_level(
    function: LevelFunction,
    vertices: FloatArray,
    faces: IntArray,
    tolerance: float,
    volume: Volume | None,
) -> None:
    """Raise unless vertices and centers of faces are within `tolerance` of the level, by looks at
    the function.

    A point is, if the slope says so, |f|/|grad f| <= tolerance; or if f changes its sign between
    points that are as far from it, along the normal of the face and along the axes, for then a
    continuous f has its level between them. On the volume's boundary a solid is cut: to be outside
    of it counts as a positive sign. The rim of an angle is its curve, where it has no value; and
    triangles smaller than half of the tolerance are as near as their corners.

    Raises:
        LocalError: with the points that are not.
    """
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    longest = np.stack([lengths(corner[:, k] - corner[:, k - 1]) for k in range(3)]).max(axis=0)
    large = longest > 0.5 * tolerance
    is_checked = np.ones(len(vertices), np.bool_)
    if function.period is not None:
        is_checked[boundary_edges(faces)] = False
    mean = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(mean, faces[:, k], normal)
    points = np.concatenate([vertices[is_checked], corner[large].mean(axis=1)])
    ways = np.concatenate([mean[is_checked], normal[large]])
    ways /= np.maximum(lengths(ways), 1e-300)[:, None]
    far = np.flatnonzero(~(function.at(points).distance <= tolerance))
    for axis in (None, *np.eye(3)):
        if not len(far):
            return
        step = tolerance * (ways[far] if axis is None else axis)
        one, other = (_is_positive(function, points[far] + s * step, volume) for s in (1, -1))
        far = far[one == other]
    if len(far):
        raise LocalError(
            f"{len(far):,} of {len(points):,} vertices and centers of triangles are farther than "
            f"the tolerance, {tolerance:.3g}, from the level, such as {_point(points[far][0])}: "
            "choose a smaller `spacing` or a larger `tolerance`",
            points[far],
        )


def _is_positive(
    function: LevelFunction, points: FloatArray, volume: Volume | None
) -> npt.NDArray[np.bool_]:
    above = ~(function.at(points).value <= 0)
    return above if volume is None else above | ~volume.contains_points(points)


def _point(x: FloatArray) -> str:
    return "(" + ", ".join(f"{c:.4g}" for c in x) + ")"


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
