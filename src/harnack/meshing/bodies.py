"""Closed components of meshes: which faces form them, how they are nested, and the solid that they
bound."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry import MeshError
from harnack.meshing.checks import SelfIntersectionError, check_manifold, intersecting_faces
from harnack.meshing.clipping import winding_around
from harnack.meshing.closed_mesh import grown, to_manifold
from harnack.meshing.csg_meshing import apart_of
from harnack.meshing.edges import IntArray, area_normals, half_edges, row_dots, row_norms
from harnack.meshing.joined_pieces import boundary_of_solid, neighbors, passes_itself
from harnack.meshing.lattice_meshing import TriangleMesh

if TYPE_CHECKING:
    from manifold3d import Manifold

__all__ = ["closed_parts", "mended_by_cuts", "nested", "united_parts", "volume_of"]

# The smallest number of faces of a closed part; and the largest number of parts that are told from
# the rest.
_MIN_FACES, _MAX_PARTS = 4, 200
# The number of points of a part that are tested for lying in another part.
_TEST_POINTS = 16
# How far within the part these points are, relative to its size.
_INSET = 1e-6
# Relative to the size: faces that are nearer than the first lie on each other, and are moved into
# each other by the second.
_ON, _INTO = 1e-12, 1e-8
# How far parts whose union crosses itself are grown, relative to the size.
_GROWN = 1e-9


def closed_parts(x: FloatArray, raw: IntArray, joined: IntArray) -> list[IntArray]:
    """The closed components of a mesh, as indices of faces: those that run along every edge as
    often in one direction as in the other.

    raw: (m, 3) faces as in the input: components that touch are told apart if they have vertices of
        their own.
    joined: (m, 3) the same faces, with one vertex for all at the same position. Here the two faces
        at an edge belong together; at an edge of more faces, those with the material between them.
    """
    parts: list[IntArray] = []
    is_left = np.ones(len(raw), np.bool_)
    for faces in (raw, joined):
        remaining = np.flatnonzero(is_left)
        for rows in _pieces(x, faces[remaining]) if len(remaining) else ():
            rows = remaining[rows]
            if len(rows) >= _MIN_FACES and _is_closed(joined[rows]):
                parts.append(rows)
                is_left[rows] = False
    return parts if len(parts) <= _MAX_PARTS else []


def _pieces(x: FloatArray, faces: IntArray) -> list[IntArray]:
    """The groups of faces, by index, that belong together at edges."""
    import scipy.sparse  # imported here: it takes half a second
    import scipy.sparse.csgraph as csgraph_module

    sparse, csgraph = cast("Any", scipy.sparse), cast("Any", csgraph_module)
    m = len(faces)
    first, second = neighbors(x, faces).T % m
    graph = sparse.coo_matrix((np.ones(len(first)), (first, second)), shape=(m, m))
    piece = np.asarray(csgraph.connected_components(graph, directed=False)[1], np.int64)
    order = np.argsort(piece, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)


def _is_closed(faces: IntArray) -> bool:
    """Whether every edge is run as often in one direction as in the other."""
    pairs = half_edges(faces)
    count = int(pairs.max()) + 1
    forward_keys, backward_keys = (np.sort(pairs @ weights) for weights in ((count, 1), (1, count)))
    return bool((forward_keys == backward_keys).all())


def volume_of(x: FloatArray, faces: IntArray) -> float:
    """The signed volume of a closed mesh, negative if it is inside out."""
    corner = x[faces] - x[faces].mean(axis=(0, 1))
    return (
        float(row_dots(corner[:, 0], area_normals(corner)).sum()) / 6
    )  # the same as the size of its corners


def nested(x: FloatArray, parts: list[IntArray]) -> list[list[int]]:
    """For each closed component, given by its faces (k, 3), the indices of the components that
    contain all of it, the smallest first. Components may touch: each is tested at points a little
    within it."""
    corners = [x[part] for part in parts]
    boxes = [(corner.min(axis=(0, 1)), corner.max(axis=(0, 1))) for corner in corners]
    volumes = [volume_of(x, part) for part in parts]
    sizes = np.abs(volumes)
    holders: list[list[int]] = []
    for i, (low, high) in enumerate(boxes):
        within = _INSET * float((high - low).max())
        sample = parts[i][:: max(1, len(parts[i]) // _TEST_POINTS)]
        normals = _unit_normals(x[sample])
        points = x[sample].mean(axis=1) - math.copysign(within, volumes[i]) * normals
        containers = [
            j
            for j, (lower, upper) in enumerate(boxes)
            if j != i
            and (lower <= low + within).all()
            and (upper >= high - within).all()
            and sizes[j] > (1 + _INSET) * sizes[i]
            and all(abs(winding_around(corners[j], point)) > 0.5 for point in points)
        ]
        holders.append(sorted(containers, key=lambda j: sizes[j]))
    return holders


def mended_by_cuts(x: FloatArray, faces: IntArray, within: float) -> TriangleMesh:
    """The boundary of the points around which a closed mesh winds at least once, by pieces of its
    faces (`boundary_of_solid`).

    within: a length, by which slivers that arise where faces cross may be moved.

    Raises:
        MeshingError: nothing is left, or pieces do not fit together.
    """
    surface = apart_of(to_manifold(boundary_of_solid(x, faces)), within)
    check_manifold(surface.faces, surface.vertices)
    return surface


def united_parts(
    x: FloatArray, faces: IntArray, parts: list[IntArray], within: float
) -> TriangleMesh:
    """The boundary of the points around which closed components wind at least once, in all. They
    may intersect, touch and contain each other, and wind clockwise.

    Proof. Let L_k be the points around which the components so far wind at least k times. With
    another component P, L_k becomes the union of L_k and of the intersection of L_(k-1) with P if P
    winds counter-clockwise around its points; if P winds clockwise, it becomes the union of L_(k+1)
    and of the points of L_k outside of P. The components that wind clockwise come last, so that all
    sets but L_0, which is all of space, are bounded.

    faces: (m, 3).
    parts: indices of the faces of each component.
    within: a length by which slivers at intersections may be moved.

    Raises:
        MeshError: a component intersects itself.
        MeshingError: a component is no manifold; or nothing is left.
    """
    shells = [TriangleMesh.without_unused_vertices(x, faces[rows]) for rows in parts]
    shells = _overlapping(shells)
    try:
        return _united(shells, within)
    except SelfIntersectionError:  # parts touch up to rounding, along an edge
        size = _GROWN * float(np.ptp(x[faces], axis=(0, 1)).max())
        signs = [math.copysign(1, volume_of(shell.vertices, shell.faces)) for shell in shells]
        return _united(
            [grown(shell, s * size) for shell, s in zip(shells, signs, strict=True)], within
        )


def _overlapping(shells: list[TriangleMesh]) -> list[TriangleMesh]:
    """The parts, with faces that lie on those of an earlier part, up to rounding, moved into that
    part by a tiny length: where the two are in one plane, but not to the last bit, gaps without a
    width would be left."""
    corners = [shell.vertices[shell.faces] for shell in shells]
    size = float(np.ptp(np.concatenate(corners), axis=(0, 1)).max())
    planes = [_unit_normals(corner) for corner in corners]
    lows = [corner.min(axis=1) - _ON * size for corner in corners]
    highs = [corner.max(axis=1) + _ON * size for corner in corners]
    moved = [shells[0]]
    for k in range(1, len(shells)):
        x, faces = shells[k].vertices.copy(), shells[k].faces
        for j in range(k):
            low, high = lows[k].min(axis=0), highs[k].max(axis=0)
            near = np.flatnonzero(((lows[j] <= high) & (highs[j] >= low)).all(axis=1))
            for face in range(len(faces)) if len(near) else ():
                normal = planes[k][face]
                on = near[row_norms(planes[j][near] + normal) <= _ON]
                is_met = (lows[j][on] <= highs[k][face]) & (highs[j][on] >= lows[k][face])
                on = on[is_met.all(axis=1)]
                height = np.abs((corners[j][on] - corners[k][face, 0]) @ normal)
                height = height.max(axis=1, initial=0.0)
                if ((height > 0) & (height <= _ON * size)).any():
                    x[faces[face]] = shells[k].vertices[faces[face]] + _INTO * size * normal
        moved.append(TriangleMesh(x, faces))
    return moved


def _unit_normals(corner: FloatArray) -> FloatArray:
    normal = area_normals(corner)
    return normal / np.maximum(row_norms(normal), 1e-300)[:, None]


def _united(shells: list[TriangleMesh], within: float) -> TriangleMesh:
    """As `united_parts`, for parts whose faces do not lie on each other up to rounding."""
    from manifold3d import Manifold

    bodies = [_manifold_of_part(shell) for shell in shells]
    clockwise = [body for body, is_body in bodies if not is_body]
    levels = [Manifold() for _ in range(len(clockwise) + 1)]
    for part in (body for body, is_body in bodies if is_body):
        shared = [levels[k] ^ part for k in range(len(levels) - 1)]
        levels = [levels[0] + part, *(a + b for a, b in zip(levels[1:], shared, strict=True))]
    for part in clockwise:
        levels = [next_level + (level - part) for level, next_level in itertools.pairwise(levels)]
    surface = apart_of(levels[0], within)
    check_manifold(surface.faces, surface.vertices)
    return surface


def _manifold_of_part(shell: TriangleMesh) -> tuple[Manifold, bool]:
    """The body that a closed part bounds, and whether the part winds counter-clockwise around
    it."""
    is_body = volume_of(shell.vertices, shell.faces) > 0
    if len(crossing := intersecting_faces(shell.vertices, shell.faces)):
        raise MeshError(f"{len(crossing):,} triangles of a part pass through others of it")
    if passes_itself(shell, np.zeros(len(shell.faces), np.int64)):
        raise MeshError("a part passes through itself along edges that lie on faces")
    faces = shell.faces if is_body else shell.faces[:, ::-1]
    return to_manifold(TriangleMesh(shell.vertices, faces)), is_body
