"""The boundary of the solid that a closed, self-intersecting mesh describes. The solid is the set
of points around which the mesh winds at least once (whose winding number is 1 or more). The faces
of the mesh are cut along each other into triangles, called "pieces". The winding numbers on both
sides of a piece tell whether it bounds the solid, and the pieces that do are joined. A "half edge"
is an edge of a face with a direction.

Where two faces meet, the vertices of pieces of one face differ by rounding from those of the other
face, and a piece may have vertices in the middle of an edge of another piece. So vertices are
merged first, and then edges are split at the vertices on them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, choose_backend
from harnack.geometry.boundary_edges import singular_edges
from harnack.geometry.flat_lists import ranks_in_lists
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    half_edges,
    has_distinct_corners,
    row_dots,
    row_norms,
)
from harnack.geometry.meshes import without_zero_area_faces
from harnack.geometry.neighborhoods import connected_groups, kd_tree, pairs_within
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection import touching_pairs
from harnack.meshing.triangle_mesh import TriangleMesh
from harnack.tree import build_balanced_tree
from harnack.tree.coplanar import overlapping_faces
from harnack.tree.triangle_splitting import split_intersecting_faces, windings_of_sides
from harnack.tree.triangle_tree import TriangleTree, triangle_records

__all__ = ["boundary_of_solid", "neighbors", "passes_itself"]

_LEAF_SIZE = 4
# Relative to the mesh's size: winding numbers beside pieces thinner than the first are not used;
# corners nearer to each other than the second are joined.
_THIN, _SAME = 1e-9, 1e-11
# Two faces around an edge count as having the same direction if the angle between them, as a
# fraction of a full turn, is less than this.
_TURN = 1e-9
# The largest number of rounds in which edges are cut at corners on them.
_MAX_ROUNDS = 200


def passes_itself(surface: TriangleMesh, number: IntArray) -> bool:
    """Whether a closed surface passes through itself along edges that lie on its faces.

    surface: a mesh of which no triangle passes through the interior of another.
    number: (m,) the number of the connected component that each face belongs to.

    Proof. Suppose that one sheet of the surface passes through another. Then each sheet is cut in
    two parts, and the winding numbers on the two sides of one part are larger by one than on the
    two sides of the other part. So the winding numbers beside pieces of touching faces are not the
    same all over a connected component. If no sheet passes through another, they are the same all
    over it, since they change at no other place."""
    pairs, _ = touching_pairs(surface.vertices, surface.faces)  # without the points of contact
    if not len(pairs):
        return False
    cut = _Cut.of(surface.vertices, surface.faces, np.unique(pairs))
    # Winding numbers beside thin pieces may be wrong, so these are left out.
    windings = np.column_stack([number[cut.owner], cut.front, cut.back])[cut.is_thick]
    # More pairs of winding numbers than components: some component has two pairs.
    distinct_windings = np.unique(windings, axis=0)
    return len(distinct_windings) > len(np.unique(distinct_windings[:, 0]))


def boundary_of_solid(vertices: FloatArray, faces: IntArray) -> TriangleMesh:
    """The boundary of the set of points around which a closed mesh winds at least once.

    vertices, faces: (n, 3), (m, 3) the mesh, which may wind around some points clockwise.

    Vertices of the mesh that the boundary has too are unchanged, bit by bit. Where the boundary
    touches itself, each sheet has vertices of its own.

    Raises:
        MeshingError: the mesh winds around no point, or the pieces do not fit together.
    """
    x, proper_faces = without_zero_area_faces(vertices, faces)
    cut = _Cut.of(x, proper_faces, np.arange(len(proper_faces)), closed=faces)
    # A piece bounds the solid if the winding number is 0 or less on one side only.
    is_boundary = (np.minimum(cut.front, cut.back) < 0.5) & (np.maximum(cut.front, cut.back) > 0.5)
    is_boundary &= ~cut.is_there_before()
    if not is_boundary.any():
        raise MeshingError("the solid is empty: the mesh winds around no point")
    pieces = cut.pieces[is_boundary]
    # The solid is on the side with the larger winding number; faces must look away from it.
    is_inward = (cut.front > cut.back)[is_boundary]
    pieces = np.where(is_inward[:, None, None], pieces[:, ::-1], pieces)
    # Corners of pieces that are at the same place, up to rounding, become one vertex.
    points = np.concatenate([cut.unit, pieces.reshape(-1, 3)])
    group = connected_groups(pairs_within(points, _SAME), len(points))
    first_at_place = np.unique(group, return_index=True)[1][group]  # corners of the mesh come first
    joined = first_at_place[len(x) :].reshape(-1, 3)
    # Pieces of which two corners became one vertex have no area.
    joined = joined[has_distinct_corners(joined)]
    joined = _cut_at_corners(points, joined)
    # New vertices, back from the unit of the cut to that of the mesh.
    all_vertices = np.concatenate([x, cut.center + cut.size * points[len(x) :]])
    return TriangleMesh.without_unused_vertices(*_apart_at_contacts(all_vertices, joined))


@dataclass(frozen=True)
class _Cut:
    """Some faces of a mesh, cut along each other into triangles ("pieces"), and the winding numbers
    of the whole mesh on both sides of each piece, `front` and `back`; the normal of a piece points
    to its front. Lengths are scaled so that coordinates are at most about one: center + size * x is
    the original position of x. `unit` are the scaled vertices of the mesh.

    tree: of the faces that were cut.
    unit: (n, 3) the vertices of the mesh, scaled.
    faces: (j, 3) the faces that were cut.
    pieces: (k, 3, 3) the corners of the pieces, scaled.
    owner: (k,) the index of the face of the mesh that each piece is a part of.
    front, back: (k,) the winding numbers on the two sides of each piece; its normal points to the
        front.
    is_thick: (k,) whether a piece is thick enough for its winding numbers to be right."""

    tree: TriangleTree
    unit: FloatArray
    faces: IntArray
    center: FloatArray
    size: float
    pieces: FloatArray
    owner: IntArray
    front: FloatArray
    back: FloatArray
    is_thick: BoolArray

    @classmethod
    def of(
        cls, vertices: FloatArray, faces: IntArray, rows: IntArray, closed: IntArray | None = None
    ) -> _Cut:
        """Cut the faces with the indices `rows` (j,) of a mesh along each other, and compute the
        winding numbers on both sides of the pieces.

        closed: all faces of the mesh, including faces without an area, with which winding numbers
            are computed. None if `faces` has all of them."""
        corner = vertices[faces]
        lower, upper = corner.min(axis=(0, 1)), corner.max(axis=(0, 1))
        # A power of two: dividing by it does not round.
        size = float(2.0 ** np.ceil(np.log2(0.5 * float((upper - lower).max()))))
        center = 0.5 * (lower + upper)
        scaled = (vertices - center) / size
        tree = _tree_of_faces(scaled, faces[rows])
        pieces, owner = split_intersecting_faces(tree, scaled, faces[rows], cuts_coplanar=True)
        closed_tree = _tree_of_faces(scaled, faces if closed is None else closed)
        front, back = windings_of_sides(closed_tree, pieces)
        edges = pieces - np.roll(pieces, 1, axis=1)
        longest_edge = np.linalg.norm(edges, axis=2).max(axis=1)
        is_thick = np.linalg.norm(area_normals(pieces), axis=1) > _THIN * longest_edge
        return cls(
            tree, scaled, faces[rows], center, size, pieces, rows[owner], front, back, is_thick
        )

    def is_there_before(self) -> BoolArray:
        """(k,) whether each piece lies on another cut face, in the same plane, whose index is lower
        than that of the piece's own face. Of several pieces at one place only the piece of the face
        with the lowest index is needed. The result is right only if all faces of the mesh were cut.
        """
        is_repeated = np.zeros(len(self.pieces), np.bool_)
        covered, covering = overlapping_faces(self.tree, self.unit, self.faces)
        covered, covering = covered[covering < covered], covering[covering < covered]
        # All pieces of each covered face, with the face that covers it.
        order = np.argsort(self.owner, kind="stable")
        start, end = (
            np.searchsorted(self.owner[order], covered, side=side) for side in ("left", "right")
        )
        count = end - start
        rows = order[np.repeat(start, count) + ranks_in_lists(count)]
        triangle = self.unit[self.faces[np.repeat(covering, count)]]
        piece_center, normal = self.pieces[rows].mean(axis=1), area_normals(triangle)
        is_within = np.ones(len(rows), np.bool_)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            inward = np.cross(normal, triangle[:, j] - triangle[:, i])
            is_within &= row_dots(inward, piece_center - triangle[:, i]) > 0
        is_repeated[rows[is_within]] = True
        return is_repeated


def _tree_of_faces(scaled: FloatArray, faces: IntArray) -> TriangleTree:
    """A search tree of the faces (m, 3) between the vertices `scaled` (n, 3), in double
    precision."""
    hierarchy = build_balanced_tree(scaled[faces].mean(axis=1), leaf_size=_LEAF_SIZE)
    return TriangleTree.of(choose_backend("double"), hierarchy, triangle_records(scaled, faces))


# Pieces joined.


def _cut_at_corners(x: FloatArray, faces: IntArray) -> IntArray:
    """Cut the faces of a surface at vertices that lie on their edges, until every edge is run as
    often in one direction as in the other: then the surface is closed.

    x: (n, 3) the vertices.

    An edge that is run more often in one direction is cut at an end of another such edge, if one
    lies on it; of several, at the end nearest to its middle. Returns the new faces (k, 3).

    Raises:
        MeshingError: edges remain that are run more often in one direction than in the other.
    """
    edges, _ = singular_edges(faces)
    for _ in range(_MAX_ROUNDS):
        if not len(edges):
            return faces
        edges = np.unique(np.sort(edges, axis=1), axis=0)
        vertex_on_edge, is_cut = _corners_on(x, edges)
        if not is_cut.any():
            break
        count = len(x)
        # Find the sides of faces that are edges to be cut; a face is cut at one side in a round.
        # The key of an edge between vertices a < b is a * count + b.
        keys = edges[is_cut] @ [count, 1]
        face_keys = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2) @ [count, 1]
        position = np.searchsorted(keys, face_keys).clip(max=len(keys) - 1)
        is_side_cut = keys[position] == face_keys
        rows, side = np.flatnonzero(is_side_cut.any(axis=1)), is_side_cut.argmax(axis=1)
        side = side[rows]
        a, b, c = (faces[rows, (side + k) % 3] for k in range(3))
        # The vertex at which the side from a to b is cut.
        p = vertex_on_edge[is_cut][position[rows, side]]
        halves = [np.column_stack([a, p, c]), np.column_stack([p, b, c])]
        # A half of a face that has the vertex p as a corner already has no area.
        halves = [half[(half[:, 0] != half[:, 2]) & (half[:, 1] != half[:, 2])] for half in halves]
        faces = np.concatenate([np.delete(faces, rows, axis=0), *halves])
        edges, _ = singular_edges(faces)
    raise MeshingError(
        f"{len(edges):,} edges of pieces of faces that pass through each other do not fit together"
    )


def _corners_on(x: FloatArray, edges: IntArray) -> tuple[IntArray, BoolArray]:
    """For each of the edges (k, 2), find an end of another one of these edges that lies on it; of
    several, the end nearest to its middle. x: (n, 3) the vertices.

    Returns:
        The indices (k,) of these vertices, 0 for an edge without one; and a mask (k,) of the edges
        that have one.
    """
    corners = np.unique(edges)
    p, q = x[edges[:, 0]], x[edges[:, 1]]
    half_length = 0.5 * row_norms(q - p)
    # Candidates lie in the ball that has the edge as its diameter.
    nearby = kd_tree(x[corners]).query_ball_point(0.5 * (p + q), half_length)
    count = np.array([len(group) for group in nearby])
    edge_row = np.repeat(np.arange(len(edges)), count)
    candidate = corners[
        np.fromiter(itertools.chain.from_iterable(nearby), np.int64, int(count.sum()))
    ]
    direction = (q - p)[edge_row] / np.maximum(2 * half_length[edge_row], 1e-300)[:, None]
    relative = x[candidate] - p[edge_row]
    position = row_dots(relative, direction)
    # On the line of the edge up to rounding (`_SAME`), and strictly between its ends.
    is_on = row_norms(relative - position[:, None] * direction) <= _SAME
    is_on &= (candidate != edges[edge_row, 0]) & (candidate != edges[edge_row, 1])
    is_on &= (position > 0) & (position < 2 * half_length[edge_row])
    edge_row, candidate, distance = (
        edge_row[is_on],
        candidate[is_on],
        np.abs(position - half_length[edge_row])[is_on],
    )
    # Of each edge's candidates, the first in the order of their distances from its middle.
    order = np.lexsort((distance, edge_row))
    edge_row, first = np.unique(edge_row[order], return_index=True)
    vertex_on_edge, is_cut = np.zeros(len(edges), np.int64), np.zeros(len(edges), np.bool_)
    vertex_on_edge[edge_row], is_cut[edge_row] = candidate[order][first], True
    return vertex_on_edge, is_cut


def neighbors(x: FloatArray, faces: IntArray) -> IntArray:
    """(k, 2) pairs of half edges at which two faces belong together.

    At an edge of two faces, these two belong together. At an edge of more faces, two faces belong
    together if they have material between them (`_wedges`). A row holds indices into
    `half_edges(faces)`.

    x: (n, 3) the vertices."""
    pairs, m = half_edges(faces), len(faces)
    edges = Edges.of(pairs)
    neighbor_pairs = [edges.paired_half_edges()]
    start = np.cumsum(edges.multiplicity) - edges.multiplicity
    for k in np.flatnonzero((edges.multiplicity > 2) & (edges.multiplicity % 2 == 0)):
        # The half edges at this edge; half edge h is of the face h % m.
        edge_halves = edges.pairs_by_edge[start[k] : start[k] + edges.multiplicity[k]]
        is_along = pairs[edge_halves, 0] == edges.vertices[k, 0]
        # The sum of a face's three corners minus the two ends of the edge.
        third_corner = faces[edge_halves % m].sum(axis=1) - pairs[edge_halves].sum(axis=1)
        neighbor_pairs.append(edge_halves[_wedges(x[edges.vertices[k]], x[third_corner], is_along)])
    return np.concatenate(neighbor_pairs)


def _wedges(ends: FloatArray, third: FloatArray, is_along: BoolArray) -> IntArray:
    """Pairs (k, 2) of faces around an edge that have material between them, as indices of its n
    faces.

    ends: (2, 3) the ends of the edge.
    third: (n, 3) the third corners of its faces.
    is_along: (n,) whether a face runs the edge from the first end to the second.

    Faces are visited counter-clockwise, as seen against the direction of the edge. Material begins
    behind a face that runs the edge backwards, since the front of the face looks back, and ends at
    the next face that runs it forwards. Of faces at the same angle, the faces at which material
    ends come first."""
    direction = ends[1] - ends[0]
    offsets = third - ends[0]
    offsets -= np.outer(offsets @ direction / (direction @ direction), direction)
    # Angles of the faces around the edge, as fractions of a turn, in steps of `_TURN`.
    axis_u: Any = offsets[0] / max(float(np.linalg.norm(offsets[0])), 1e-300)
    axis_v: Any = np.cross(direction / float(np.linalg.norm(direction)), axis_u)
    angles: FloatArray = np.arctan2(offsets @ axis_v, offsets @ axis_u) / (2 * np.pi)
    steps: IntArray = np.round(angles / _TURN).astype(np.int64) % round(1 / _TURN)
    opening_faces, wedges = list[int](), list[tuple[int, int]]()
    is_taken = np.zeros(len(third), np.bool_)
    # Faces by their angles, and at the same angle first those that run along. In the second round
    # the last opening faces meet the first closing ones.
    for k in 2 * np.lexsort((~is_along, steps)).tolist():  # twice around
        if is_taken[k]:
            continue
        if not is_along[k] and k not in opening_faces:
            opening_faces.append(k)
        elif is_along[k] and opening_faces:
            wedges.append((opening_faces.pop(), k))
            is_taken[list(wedges[-1])] = True
    return np.array(wedges, np.int64).reshape(-1, 2)


def _apart_at_contacts(x: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Where sheets of a closed surface touch in a vertex or an edge, give each sheet vertices of
    its own. x, faces: (n, 3), (m, 3) the surface. Returns the new vertices and faces.

    At each vertex, corners of faces that are connected by edges form a fan, and each fan gets a
    vertex."""
    m = len(faces)
    edge, opposite = neighbors(x, faces).T
    # Corner k of face i has the number k m + i, and so has the half edge from it to the next
    # corner. Of two half edges that belong together, one starts where the other ends: these corners
    # are of one fan.
    start, end = (edge, (opposite + m) % (3 * m)), ((edge + m) % (3 * m), opposite)
    fan = connected_groups(np.concatenate([start, end], axis=1).T, 3 * m)
    first_corner = np.unique(fan, return_index=True)[1]
    return x[faces.T.ravel()[first_corner]], fan.reshape(3, m).T
