"""Closed parts of meshes: which there are, which lie in which, and the solid that they bound."""

from __future__ import annotations

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Solid
from harnack.fields.solids.combined import Combined, Complement
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.geometry import MeshError
from harnack.geometry.chains import net_faces, weld_vertices
from harnack.meshing.clipping import winding_around
from harnack.meshing.edges import Edges, IntArray, directed_edges, dots
from harnack.meshing.sound import pieces_of

__all__ = ["closed_parts", "nested", "united_parts", "volume_of"]

# Closed parts have so many faces; of more parts than that none are told from the rest.
_LEAST_FACES, _MOST_PARTS = 4, 200
# Places of a part that have to lie in another one for the part to do.
_PLACES = 16


def closed_parts(*faces: IntArray) -> list[IntArray]:
    """Faces, by index, of the parts of a mesh that are closed: whose faces edges of two faces hold
    together, and that run every edge as often one way as the other.

    faces: (m, 3), as given, and again with corners joined, if that is to be looked at as well.
        Parts that touch are told apart as long as they have corners of their own.
    """
    found: list[IntArray] = []
    is_left = np.ones(len(faces[0]), np.bool_)
    for corners in faces:
        left = np.flatnonzero(is_left)
        if not len(left):
            break
        piece = pieces_of(Edges.of(directed_edges(corners[left])), len(left))
        order = np.argsort(piece, kind="stable")
        for rows in np.split(left[order], np.flatnonzero(np.diff(piece[order])) + 1):
            if len(rows) >= _LEAST_FACES and _is_closed(corners[rows]):
                found.append(rows)
                is_left[rows] = False
    return found if len(found) <= _MOST_PARTS else []


def _is_closed(faces: IntArray) -> bool:
    """Whether every edge is run as often one way as the other."""
    pairs = directed_edges(faces)
    count = int(pairs.max()) + 1
    forth, back = (np.sort(pairs @ way) for way in ((count, 1), (1, count)))
    return bool((forth == back).all())


def volume_of(x: FloatArray, faces: IntArray) -> float:
    """What a closed mesh holds, negative if it is inside out."""
    corner = x[faces] - x[faces].mean(axis=(0, 1))
    return float(dots(corner[:, 0], np.cross(corner[:, 1], corner[:, 2])).sum()) / 6


def nested(x: FloatArray, parts: list[IntArray]) -> list[list[int]]:
    """For each of some closed parts, faces (k, 3), the numbers of those that it lies in as a whole,
    the smallest first."""
    corners = [x[part] for part in parts]
    boxes = [(one.min(axis=(0, 1)), one.max(axis=(0, 1))) for one in corners]
    sizes = [abs(volume_of(x, part)) for part in parts]
    found: list[list[int]] = []
    for i, (low, high) in enumerate(boxes):
        points = corners[i][:: max(1, len(parts[i]) // _PLACES)].mean(axis=1)
        around = [
            j
            for j, (lower, upper) in enumerate(boxes)
            if j != i
            and (lower <= low).all()
            and (upper >= high).all()
            and sizes[j] > sizes[i]
            and all(abs(winding_around(corners[j], point)) > 0.5 for point in points)
        ]
        found.append(sorted(around, key=lambda j: sizes[j]))
    return found


def united_parts(x: FloatArray, faces: IntArray) -> Solid:
    """The union of the closed parts of a mesh, which may touch; those that are inside out are cut
    away, from the smallest part that they lie in, or from all.

    Raises:
        MeshError: a face belongs to no closed part, or there is one part alone; or as `MeshSolid`.
    """
    welded = weld_vertices(x)[faces]
    parts = closed_parts(faces, welded)
    if sum(map(len, parts)) < len(faces):  # faces on each other hide parts, and are no boundary
        welded = net_faces(welded).faces
        parts = closed_parts(welded)
    if len(parts) < 2 or sum(map(len, parts)) < len(welded):
        raise MeshError("it is not made of closed parts")
    shells = [welded[rows] for rows in parts]
    is_body = [volume_of(x, shell) > 0 for shell in shells]
    cut: dict[int, list[Solid]] = {k: [] for k in range(-1, len(shells))}
    for k, around in enumerate(nested(x, shells)):
        if not is_body[k]:
            owner = next((j for j in around if is_body[j]), -1)
            cut[owner].append(Complement(MeshSolid(x, shells[k][:, ::-1])))
    bodies: list[Solid] = [
        _all_of(MeshSolid(x, shells[k]), cut[k]) for k in range(len(shells)) if is_body[k]
    ]
    if not bodies:
        raise MeshError("all of its parts are inside out")
    whole = bodies[0] if len(bodies) == 1 else Combined(tuple(bodies), is_union=True)
    return _all_of(whole, cut[-1])


def _all_of(solid: Solid, cut: list[Solid]) -> Solid:
    return Combined((solid, *cut), is_union=False) if cut else solid
