"""The largest part of a surface, and the largest body of a closed one, with its cavities."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.checks import MeshingError
from harnack.meshing.edges import IntArray, dots, lengths
from harnack.meshing.lattice_surface import Surface

__all__ = ["largest_body", "largest_part"]


def largest_part(surface: Surface) -> Surface:
    """The connected part with the largest area."""
    part = _parts(surface)
    areas = np.bincount(part, np.linalg.norm(_crosses(surface), axis=1))
    return Surface.of(surface.vertices, surface.faces[part == areas.argmax()])


def largest_body(surface: Surface) -> Surface:
    """Of a closed surface the body with the largest volume: an outer shell and the shells of its
    cavities, which are turned inwards, so that their volume is negative.

    Proof. Shells are closed, connected and do not meet. Where the surface bounds a set, a shell
    turned inwards has the set around it, whose part there has an outer shell; of those that hold
    the cavity it is the innermost, the smallest one: another one in between would be
    outside of the part, with nothing of the set between both. That a shell holds a point is told by
    its winding number there, a whole one.

    Raises:
        MeshingError: a cavity that lies in no shell.
    """
    part = _parts(surface)
    names, shell = np.unique(part, return_inverse=True)
    cross, corner = _crosses(surface), surface.vertices[surface.faces]
    center = surface.vertices.mean(axis=0)
    volumes = np.bincount(shell, dots(cross, corner[:, 0] - center)) / 6
    bodies = volumes.copy()
    owner = np.arange(len(names))
    outer = np.flatnonzero(volumes > 0)
    outer = outer[np.argsort(volumes[outer])]
    for cavity in np.flatnonzero(volumes <= 0):
        point = corner[np.flatnonzero(shell == cavity)[0]].mean(axis=0)
        holds = (one for one in outer if _winding(corner[shell == one], point) > 0.5)
        if (found := next(holds, None)) is None:
            raise MeshingError("a part of the mesh is inside out: choose a smaller `spacing`")
        owner[cavity] = found
        bodies[found] += volumes[cavity]
    kept = outer[bodies[outer].argmax()] if len(outer) else -1
    return Surface.of(surface.vertices, surface.faces[owner[shell] == kept])


def _parts(surface: Surface) -> IntArray:
    """(m,) of each face the number of its connected part."""
    import scipy.sparse  # here: half a second that few need
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    faces, n = surface.faces, len(surface.vertices)
    rows, columns = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    joined = sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return np.asarray(csgraph.connected_components(joined, directed=False)[1])[faces[:, 0]]


def _crosses(surface: Surface) -> FloatArray:
    """(m, 3) normals of faces, twice as long as their areas."""
    corner = surface.vertices[surface.faces]
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _winding(corner: FloatArray, point: FloatArray) -> float:
    """The winding number around a point of triangles (m, 3, 3), by their solid angles (Van Oosterom
    and Strackee 1983)."""
    a, b, c = (corner[:, k] - point for k in range(3))
    x, y, z = lengths(a), lengths(b), lengths(c)
    below = x * y * z + dots(a, b) * z + dots(b, c) * x + dots(c, a) * y
    return float(np.arctan2(dots(a, np.cross(b, c)), below).sum()) / (2 * math.pi)
