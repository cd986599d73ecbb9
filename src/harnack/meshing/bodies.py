"""Closed components of meshes: the faces that form them, which components lie in which, and the
boundary of the solid that they describe together. A component is a connected group of faces, and it
is closed if its faces run every edge as often in one direction as in the other. It winds around a
point k times: k is its winding number there. If the component does not cross itself, k is 0
outside; inside it is 1 if the faces look outwards ("counter-clockwise", as for curves in the
plane), and -1 if the component is inside out ("clockwise"). The size is the longest side of the
bounding box; a relative length is a fraction of the size."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.geometry import MeshError
from harnack.geometry.mesh_edges import (
    area_normals,
    half_edges,
    row_dots,
    row_norms,
    unit_normals,
)
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.checks import check_manifold
from harnack.meshing.closed_mesh import grown, to_manifold
from harnack.meshing.components import winding_around
from harnack.meshing.csg_meshing import apart_of
from harnack.meshing.joined_pieces import boundary_of_solid, neighbors, passes_itself
from harnack.meshing.meshing_errors import SelfIntersectionError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from manifold3d import Manifold

__all__ = ["closed_parts", "mended_by_cuts", "nested", "united_parts", "volume_of"]

# The smallest number of faces of a closed component. If there are more components than the second
# number, `closed_parts` returns none.
_MIN_FACES, _MAX_PARTS = 4, 200
# About how many points of a component are tested for lying in another component.
_TEST_POINTS = 16
# How deep inside of the component these points are, relative to its size.
_TEST_DEPTH = 1e-6
# Two parallel faces of two components count as in contact if they are no farther apart than the
# first number. Then one of them is moved into the other's component by the second. Both are
# relative to the size.
_CONTACT_DISTANCE, _OVERLAP = 1e-12, 1e-8
# How far components whose union crosses itself are moved outwards, relative to the size.
_GROWTH = 1e-9


def closed_parts(x: FloatArray, raw: IntArray, joined: IntArray) -> list[IntArray]:
    """Find the closed components of a mesh. Each is returned as an array (k,) of indices of its
    faces. The list is empty if there are more than 200 components.

    Two faces are connected at a common edge. If the edge has two faces, they are connected; if it
    has more faces, two of them are connected if they have material of the solid between them.

    x: (n, 3) the vertices.
    raw: (m, 3) the faces as in the input. They are searched first: here components that touch are
        still separate if each has vertices of its own.
    joined: (m, 3) the same faces, with one vertex in place of all vertices at the same position.
        The faces that belong to no component of `raw` are searched in this form.
    """
    parts: list[IntArray] = []
    is_left = np.ones(len(raw), np.bool_)
    for faces in (raw, joined):
        remaining = np.flatnonzero(is_left)
        for rows in _connected_groups(x, faces[remaining]) if len(remaining) else ():
            rows = remaining[rows]
            # Closed up to vertices at the same position.
            if len(rows) >= _MIN_FACES and _runs_edges_both_ways(joined[rows]):
                parts.append(rows)
                is_left[rows] = False
    return parts if len(parts) <= _MAX_PARTS else []


def _connected_groups(x: FloatArray, faces: IntArray) -> list[IntArray]:
    """Divide faces (m, 3) into their connected groups; each is an array (k,) of indices of faces.
    Faces are connected at common edges (`neighbors`). If an edge has two faces, they are connected;
    if it has more, two of them are connected if they have material of the solid between them.

    x: (n, 3) the vertices.
    """
    # `neighbors` lists pairs of half edges; half edge h is one of face h % len(faces).
    group = connected_groups(neighbors(x, faces) % len(faces), len(faces))
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _runs_edges_both_ways(faces: IntArray) -> bool:
    """Whether the faces (m, 3) run every edge as often in one direction as in the other."""
    pairs = half_edges(faces)
    n = int(pairs.max()) + 1
    forward_keys, backward_keys = (np.sort(pairs @ weights) for weights in ((n, 1), (1, n)))
    return bool((forward_keys == backward_keys).all())


def volume_of(x: FloatArray, faces: IntArray) -> float:
    """The signed volume of a closed mesh with vertices x (n, 3) and faces (m, 3). It is negative if
    the mesh is inside out."""
    # Relative to the center, so that rounding errors are relative to the size of the mesh.
    corner = x[faces] - x[faces].mean(axis=(0, 1))
    return float(row_dots(corner[:, 0], area_normals(corner)).sum()) / 6


def nested(x: FloatArray, parts: list[IntArray]) -> list[list[int]]:
    """Find for each closed component the components that contain all of it. Returns for each
    component the list of the indices of those that contain it, in order of increasing volume.
    Components may touch, since each is tested at points a little inside of it.

    x: (n, 3) the vertices.
    parts: the faces (k, 3) of each component.
    """
    corners = [x[part] for part in parts]
    boxes = [(corner.min(axis=(0, 1)), corner.max(axis=(0, 1))) for corner in corners]
    volumes = [volume_of(x, part) for part in parts]
    sizes = np.abs(volumes)
    holders: list[list[int]] = []
    for i, (low, high) in enumerate(boxes):
        depth = _TEST_DEPTH * float((high - low).max())
        sample = parts[i][:: max(1, len(parts[i]) // _TEST_POINTS)]
        normals = unit_normals(x[sample])
        # Against the normals, or along them if the component is inside out.
        points = x[sample].mean(axis=1) - math.copysign(depth, volumes[i]) * normals
        # A container has a box that holds this box, a larger volume, and winds around all test
        # points.
        containers = [
            j
            for j, (lower, upper) in enumerate(boxes)
            if j != i
            and (lower <= low + depth).all()
            and (upper >= high - depth).all()
            and sizes[j] > (1 + _TEST_DEPTH) * sizes[i]
            and all(abs(winding_around(corners[j], point)) > 0.5 for point in points)
        ]
        holders.append(sorted(containers, key=lambda j: sizes[j]))
    return holders


def mended_by_cuts(x: FloatArray, faces: IntArray, within: float) -> TriangleMesh:
    """Make the boundary of the set of points around which a closed mesh winds at least once. Faces
    are cut where they cross, and the boundary is composed of the pieces (`boundary_of_solid`).

    x, faces: (n, 3), (m, 3) the mesh.
    within: a length; the surface may be moved by half of it, to remove the thin triangles that
        arise where faces cross.

    Raises:
        MeshingError: nothing is left, or pieces do not fit together.
    """
    surface = apart_of(to_manifold(boundary_of_solid(x, faces)), within)
    check_manifold(surface.faces, surface.vertices)
    return surface


def united_parts(
    x: FloatArray, faces: IntArray, parts: list[IntArray], within: float
) -> TriangleMesh:
    """Make the boundary of the set of points around which closed components, all together, wind at
    least once. Components may touch, contain and intersect each other, and may be inside out. If
    the result intersects itself, as where components touch up to rounding, the components are
    enlarged by a tiny length and united again.

    Proof of the method. Let L_k be the set of points around which the components so far wind at
    least k times. Add another component, and let P be the set of points inside of it. If it winds
    counter-clockwise, it adds 1 to the winding number in P. So L_k becomes the union of L_k with
    the intersection of L_(k-1) and P. If it winds clockwise, it subtracts 1 in P. So L_k becomes
    the union of L_(k+1) with the points of L_k outside of P. Components that wind clockwise are
    added last, so that all sets but L_0, which is all of space, are bounded.

    x: (n, 3) the vertices.
    faces: (m, 3).
    parts: for each component the indices of its faces.
    within: a length; the surface may be moved by half of it, to remove thin triangles at
        intersections.

    Raises:
        MeshError: a component intersects itself.
        MeshingError: a component is no manifold; or nothing is left.
    """
    shells = [TriangleMesh.without_unused_vertices(x, faces[rows]) for rows in parts]
    shells = _make_overlap(shells)
    try:
        return _union_of_components(shells, within)
    except SelfIntersectionError:  # parts touch up to rounding, along an edge
        # The sign makes components that are inside out larger as well.
        size = _GROWTH * float(np.ptp(x[faces], axis=(0, 1)).max())
        signs = [math.copysign(1, volume_of(shell.vertices, shell.faces)) for shell in shells]
        return _union_of_components(
            [grown(shell, sign * size) for shell, sign in zip(shells, signs, strict=True)], within
        )


def _make_overlap(parts: list[TriangleMesh]) -> list[TriangleMesh]:
    """Move vertices of components that touch each other only up to rounding, so that these
    components overlap there. Returns all components. Without that, their union would have gaps as
    thin as rounding errors.

    A face counts as in contact with an earlier component if that component has a parallel face that
    looks the opposite way, and the distance from the plane of that face is not 0 but at most
    `_CONTACT_DISTANCE`. The face's vertices are then moved along its normal, into the earlier
    component, by `_OVERLAP`. Both lengths are relative to the size of all components.
    """
    corners = [shell.vertices[shell.faces] for shell in parts]
    size = float(np.ptp(np.concatenate(corners), axis=(0, 1)).max())
    normals_of_part = [unit_normals(corner) for corner in corners]
    lows = [corner.min(axis=1) - _CONTACT_DISTANCE * size for corner in corners]
    highs = [corner.max(axis=1) + _CONTACT_DISTANCE * size for corner in corners]
    moved = [parts[0]]
    for k in range(1, len(parts)):
        x, faces = parts[k].vertices.copy(), parts[k].faces
        for j in range(k):
            low, high = lows[k].min(axis=0), highs[k].max(axis=0)
            near_faces = np.flatnonzero(((lows[j] <= high) & (highs[j] >= low)).all(axis=1))
            for face in range(len(faces)) if len(near_faces) else ():
                normal = normals_of_part[k][face]
                # Unit normals whose sum is nearly 0 are opposite.
                opposite_faces = near_faces[
                    row_norms(normals_of_part[j][near_faces] + normal) <= _CONTACT_DISTANCE
                ]
                is_met = (lows[j][opposite_faces] <= highs[k][face]) & (
                    highs[j][opposite_faces] >= lows[k][face]
                )
                opposite_faces = opposite_faces[is_met.all(axis=1)]
                # The largest distance of a corner of the earlier face from the plane of this face.
                plane_distances = np.abs(
                    (corners[j][opposite_faces] - corners[k][face, 0]) @ normal
                )
                plane_distances = plane_distances.max(axis=1, initial=0.0)
                if ((plane_distances > 0) & (plane_distances <= _CONTACT_DISTANCE * size)).any():
                    x[faces[face]] = parts[k].vertices[faces[face]] + _OVERLAP * size * normal
        moved.append(TriangleMesh(x, faces))
    return moved


def _union_of_components(components: list[TriangleMesh], within: float) -> TriangleMesh:
    """Make the boundary of the set of points around which closed components, all together, wind at
    least once. `united_parts` has the proof. No two components may be in contact only up to
    rounding (`_make_overlap`).

    within: a length; the surface may be moved by half of it, to remove thin triangles at
        intersections.

    Raises:
        MeshError: a component intersects itself.
        MeshingError: the union is no manifold, or empty.
    """
    from manifold3d import Manifold

    bodies = [_manifold_of_component(component) for component in components]
    clockwise = [body for body, is_outward in bodies if not is_outward]
    # sets[k] is L_(k+1) of the proof: the points around which the components so far wind at least k
    # + 1 times. Each clockwise component needs one set more, since it moves L_(k+1) to L_k.
    # (Of manifold3d solids, ^ is the intersection, + the union, and - the difference.)
    sets = [Manifold() for _ in range(len(clockwise) + 1)]
    for solid in (body for body, is_outward in bodies if is_outward):
        shared = [sets[k] ^ solid for k in range(len(sets) - 1)]
        sets = [sets[0] + solid, *(a + b for a, b in zip(sets[1:], shared, strict=True))]
    for solid in clockwise:
        sets = [after + (before - solid) for before, after in itertools.pairwise(sets)]
    surface = apart_of(sets[0], within)
    check_manifold(surface.faces, surface.vertices)
    return surface


def _manifold_of_component(component: TriangleMesh) -> tuple[Manifold, bool]:
    """Returns two results: the manifold3d solid inside of a closed component; and whether the
    component's faces look outwards, so that it winds counter-clockwise.

    Raises:
        MeshError: the component intersects itself.
    """
    is_outward = volume_of(component.vertices, component.faces) > 0
    if len(crossing := intersecting_faces(component.vertices, component.faces)):
        raise MeshError(f"{len(crossing):,} triangles of a part pass through others of it")
    # All faces belong to one connected component, number 0.
    if passes_itself(component, np.zeros(len(component.faces), np.int64)):
        raise MeshError("a part passes through itself along edges that lie on faces")
    faces = component.faces if is_outward else component.faces[:, ::-1]
    return to_manifold(TriangleMesh(component.vertices, faces)), is_outward
