"""Triangles of a mesh cut where they pass through each other, and the winding numbers of the mesh
on both sides of a triangle. A *piece* is a triangle that remains of a cut face. A *knife* is a
triangle along whose plane another one is cut. The *jump* across a triangle is the difference of the
winding numbers on its two sides. A *lane* is one entry of Dr.Jit's arrays, here an edge that is
traced as a ray.

The set of points whose winding number is above 1/2, for a closed mesh that crosses itself, is
bounded by parts of the mesh's triangles. If each triangle is cut along all other triangles, every
piece lies as a whole either on the boundary of the set, or off it.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray, to_numpy, to_vector3
from harnack.backend.arrays import upload_integers
from harnack.geometry.flat_lists import ranks_in_lists
from harnack.tree.coplanar import borders_of_overlaps
from harnack.tree.triangle_tree import NO_TRIANGLE, RayFrame, TriangleTree

__all__ = [
    "separates_levels",
    "split_intersecting_faces",
    "winding_numbers_of_sides",
    "windings_of_sides",
]

# In units of the mesh's size: points closer than this are the same.
_COINCIDENT = 1e-12
# Pieces thinner than this are left out: their neighbors stand for them.
_MIN_THICKNESS = 1e-11
_CENTROID = (1 / 3, 1 / 3, 1 / 3)


def split_intersecting_faces(
    tree: TriangleTree, vertices: FloatArray, faces: IntArray, *, cuts_coplanar: bool = False
) -> tuple[FloatArray, IntArray]:
    """Cut faces (m, 3) into triangles, none of which passes through another, nor is partly covered
    by faces in its plane.

    tree: a tree of the same faces, with coordinates of at most about 1.
    vertices: (n, 3).
    cuts_coplanar: whether to cut a face also along edges inside of the part of it that other faces
        in its plane cover. Then each face in the plane of a piece covers either the whole piece or
        no part of it.

    Returns:
        The pieces (k, 3, 3), which have the orientation of their faces and fill them; and the index
        (k,) of the face that each is a piece of. Pieces thinner than 1e-11 are left out.

    Where two triangles intersect in a segment, each end of the segment lies on an edge of one of
    them. So every edge is traced as a ray. If the edge crosses a triangle T, each face at the edge
    is cut by the plane of T, if that cut meets T; and T is cut by the plane of each face at the
    edge, if that cut meets the face. An edge that meets another edge, up to rounding, counts as
    meeting all faces at that edge. Faces in the same plane are cut along the borders of the faces
    that cover them. Superfluous cuts are harmless.
    """
    corners = vertices[faces]
    # Face cut[i] is cut by face by[i], later by the triangle knives[i].
    cut, by = _crossing_faces(tree, vertices, faces)
    covered, borders = borders_of_overlaps(tree, vertices, faces, at_every_edge=cuts_coplanar)
    if not len(cut) + len(covered):
        return corners, np.arange(len(faces))
    cut, knives = np.concatenate([cut, covered]), np.concatenate([corners[by], borders])
    is_uncut = np.ones(len(faces), np.bool_)
    is_uncut[cut] = False
    # The number of each face among those that are cut.
    place_among_cut = np.cumsum(~is_uncut) - 1
    pieces, owner = _cut_up(corners[~is_uncut], place_among_cut[cut], knives)
    edges = pieces - np.roll(pieces, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # The thickness is the height above the longest edge: twice the area divided by that edge.
    is_thick = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > _MIN_THICKNESS * longest
    owner = np.concatenate([np.flatnonzero(is_uncut), np.flatnonzero(~is_uncut)[owner[is_thick]]])
    return np.concatenate([corners[is_uncut], pieces[is_thick]]), owner


def separates_levels(
    tree: TriangleTree, pieces: FloatArray, levels: tuple[float, ...]
) -> BoolArray:
    """A mask (k,) of triangles, true where any of the levels lies strictly between the winding
    numbers of a mesh on the two sides of the triangle.

    tree: the mesh.
    pieces: (k, 3, 3) the triangles.
    """
    low, high = winding_numbers_of_sides(tree, pieces)
    return np.any([(low < level) & (level < high) for level in levels], axis=0)


def winding_numbers_of_sides(
    tree: TriangleTree, pieces: FloatArray, barycentric: tuple[float, float, float] = _CENTROID
) -> tuple[FloatArray, FloatArray]:
    """The winding numbers of a mesh on the two sides of triangles. Returns the smaller (k,) and the
    larger (k,) of both numbers.

    tree: the mesh.
    pieces: (k, 3, 3) the triangles.
    barycentric: the barycentric coordinates of the point of each triangle at which they are
        computed; by default its center.
    """
    front, back = windings_of_sides(tree, pieces, barycentric)
    return np.minimum(front, back), np.maximum(front, back)


def windings_of_sides(
    tree: TriangleTree, pieces: FloatArray, shares: tuple[float, float, float] = _CENTROID
) -> tuple[FloatArray, FloatArray]:
    """The winding numbers of a mesh in front of triangles and behind them. Returns two arrays (k,).
    The front is the side from which the corners of a triangle run counter-clockwise.

    tree: the mesh.
    pieces: (k, 3, 3) the triangles.
    shares: the barycentric coordinates of the point of each triangle at which they are computed; by
        default its center.

    For each triangle, a ray along its normal counts the signed crossings ahead of a point a little
    in front of the triangle, and ahead of a point a little behind it. Triangles that coincide with
    it lie between these two points, so all of them count.
    """
    backend = tree.tree.backend
    a, b, c = np.moveaxis(pieces, 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    # Triangles without an area get an arbitrary normal.
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    points = shares[0] * a + shares[1] * b + shares[2] * c
    frame = RayFrame.along(backend, to_vector3(backend, points), to_vector3(backend, normal))
    # t: the positions on the ray of the points in front of the triangle and behind it.
    front, back = (
        to_numpy(tree.signed_crossings_ahead(frame, backend.Float(dr.opaque(backend.Float, t))))
        for t in (_COINCIDENT, -_COINCIDENT)
    )
    return front, back


def _crossing_faces(
    tree: TriangleTree, vertices: FloatArray, faces: IntArray
) -> tuple[IntArray, IntArray]:
    """Find all pairs of faces (m, 3) that pass through one another. Returns the indices (k,) of the
    first and (k,) of the second faces of the pairs; each pair occurs in both orders.

    tree: a tree of the same faces.
    vertices: (n, 3).

    Pairs are found by the edges that cross faces: an edge that crosses a face makes a pair of that
    face with each face at the edge.
    """
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    # edge: for each side of each face, three sides a face, the index of its edge.
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    # The faces at edge 0, then those at edge 1, and so on; edge_start is where each begins.
    faces_by_edge = np.argsort(edge, kind="stable") // 3
    edge_start = np.searchsorted(np.sort(edge), np.arange(len(edges) + 1))
    crossing_edge, crossed_face = _crossings_of_edges(tree, vertices, faces, edges)
    # For each crossing, all faces at the edge, each paired with the crossed face.
    count = edge_start[crossing_edge + 1] - edge_start[crossing_edge]
    places = np.repeat(edge_start[crossing_edge], count) + ranks_in_lists(count)
    passing, passed = faces_by_edge[places], np.repeat(crossed_face, count)
    pairs = np.concatenate([np.column_stack([passing, passed]), np.column_stack([passed, passing])])
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    return pairs[:, 0], pairs[:, 1]


def _crossings_of_edges(
    tree: TriangleTree, vertices: FloatArray, faces: IntArray, edges: IntArray
) -> tuple[IntArray, IntArray]:
    """All crossings of edges (m, 2) with faces that have neither end of the edge as a corner. Faces
    whose border the edge meets count as crossed.

    tree: a tree of the same faces.
    vertices: (n, 3).

    Returns:
        (k,) the index of the edge and (k,) the index of the face of each crossing.
    """
    backend = tree.tree.backend
    face_columns = [upload_integers(backend, ids) for ids in faces.T]
    edge_vectors = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(edge_vectors, axis=1)
    # In each round, find the next crossing of each edge of `searching`, as a ray from its first
    # end, after the crossing (after_t, after_n).
    searching = np.flatnonzero(length > 0)
    # The searches begin a little before t = 0, so that crossings at the first end count.
    after_t, after_n = np.full(len(edges), -_COINCIDENT), np.full(len(edges), NO_TRIANGLE, np.int64)
    batches: list[tuple[IntArray, IntArray]] = []
    while len(searching):
        o = to_vector3(backend, vertices[edges[searching, 0]])
        d = to_vector3(backend, edge_vectors[searching] / length[searching, None])
        frame = RayFrame.along(backend, o, d)
        end = backend.Float(length[searching] + _COINCIDENT)
        p, q = (upload_integers(backend, ids) for ids in edges[searching].T)

        after = backend.Float(after_t[searching]), upload_integers(backend, after_n[searching])
        t, n = _next_foreign_crossing(tree, face_columns, frame, (p, q), end, after)
        number = to_numpy(n).astype(np.int64)
        is_found = number != NO_TRIANGLE
        after_t[searching], after_n[searching] = to_numpy(t), number
        searching, number = searching[is_found], number[is_found]
        batches.append((searching, number))
    return np.concatenate([ids for ids, _ in batches]), np.concatenate([ids for _, ids in batches])


def _next_foreign_crossing(
    tree: TriangleTree, face_columns: list[Any], frame: RayFrame, ends: tuple[Any, Any],
    t_max: Any, after: tuple[Any, Any],
) -> tuple[Any, Any]:  # fmt: skip
    """The next crossing of each ray, along an edge, with a face that has neither end of this edge
    as a corner.

    tree: a tree of the faces.
    face_columns: three index arrays: the first, second and third corners of all faces.
    frame: the rays.
    ends: the vertices at the ends of the edges, two index arrays with an entry for each ray.
    t_max: the largest t.
    after: (t, number of a face), the crossing behind which the search begins.

    Returns t and the number of the face; NO_TRIANGLE if there is none.
    """
    index = tree.tree.backend.UInt32

    def body(t: Any, n: Any, active: Any) -> tuple[Any, ...]:
        """Go to the next crossing of the ray with the tree's faces, (t, number n of the crossed
        face), up to t_max. The lane stays active while one of the two ends of its edge is a corner
        of the crossed face: such crossings are skipped. Returns the new t, n and mask of active
        lanes."""
        # A face counts as crossed also if its border is within `_COINCIDENT` of the edge.
        t, n, _, _ = tree.next_crossing(frame, (t, n), t_max, active, _COINCIDENT)
        is_found = active & (n != NO_TRIANGLE)
        corners = [dr.gather(index, column, n, is_found) for column in face_columns]
        return (
            t,
            n,
            is_found & dr.any([(corner == ends[0]) | (corner == ends[1]) for corner in corners]),
        )

    def is_running(t: Any, n: Any, active: Any) -> Any:
        """The mask `active`: whether an end of the lane's edge is a corner of the face that it
        crossed last."""
        del t, n
        return active

    start = (*after, tree.tree.backend.Bool(True))
    return dr.while_loop(start, is_running, body, label="crossings of edges")[:2]


def _cut_up(
    pieces: FloatArray, piece_ids: IntArray, knives: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Cut triangles by the planes of other triangles, the knives.

    pieces: (n, 3, 3) the triangles that are cut.
    piece_ids: (k,) the index of the triangle that each knife cuts. A knife cuts only where its
        triangle, not only its plane, meets the piece.
    knives: (k, 3, 3) the triangles whose planes cut them.

    In each round every piece is cut by one of the knives that meet it: the knife in the middle of
    the list of the piece's knives. The remaining knives of the list are passed on to the new pieces
    that they meet. So the number of knives of a piece falls by about half in each round.

    Returns:
        The pieces (j, 3, 3), and the index (j,) of the triangle that each is a piece of.
    """
    finished_pieces: list[FloatArray] = []
    owners: list[IntArray] = []
    # Pairs of a piece, piece_ids[i], and a knife, knife_ids[i]. triangle_ids: the original triangle
    # of each piece.
    knife_ids, triangle_ids = np.arange(len(knives)), np.arange(len(pieces))
    while True:
        height = _heights(pieces[piece_ids], knives[knife_ids])
        height[np.abs(height) < _COINCIDENT] = 0
        is_met = (height.max(axis=1) > 0) & (height.min(axis=1) < 0)
        is_met[is_met] = _cut_meets_triangle(
            pieces[piece_ids[is_met]], height[is_met], knives[knife_ids[is_met]]
        )
        piece_ids, knife_ids, height = piece_ids[is_met], knife_ids[is_met], height[is_met]
        # Pieces that no knife meets are done.
        is_cut = np.zeros(len(pieces), np.bool_)
        is_cut[piece_ids] = True
        finished_pieces.append(pieces[~is_cut])
        owners.append(triangle_ids[~is_cut])
        if not len(piece_ids):
            return np.concatenate(finished_pieces), np.concatenate(owners)
        # Sort pairs by piece; the middle one of each piece cuts it now.
        order = np.argsort(piece_ids, kind="stable")
        piece_ids, knife_ids, height = piece_ids[order], knife_ids[order], height[order]
        cut_ids, first_pair, count = np.unique(piece_ids, return_index=True, return_counts=True)
        middle = first_pair + count // 2
        is_left = np.ones(len(piece_ids), np.bool_)
        is_left[middle] = False
        pieces, triangle_ids = (
            _pieces_at_plane(pieces[cut_ids], height[middle]),
            np.tile(triangle_ids[cut_ids], 3),
        )
        # The other knives of a piece are tried on its three new pieces. These are len(cut_ids)
        # apart in the list of new pieces.
        targets = np.searchsorted(cut_ids, piece_ids[is_left])
        piece_ids = (targets[:, None] + len(cut_ids) * np.arange(3)).ravel()
        knife_ids = np.repeat(knife_ids[is_left], 3)


def _pieces_at_plane(pieces: FloatArray, heights: FloatArray) -> FloatArray:
    """Cut triangles (k, 3, 3) by planes, each into one triangle on one side and two on the other.

    pieces: (k, 3, 3) the triangles.
    heights: (k, 3) the signed distances of the corners from the plane, some positive and some
        negative.

    Returns (3 k, 3, 3): first the k single triangles; then, of the two triangles on the other side,
    the k first ones and the k second ones.
    """
    # The corner that is alone on its side comes first; a corner in the plane belongs to the side of
    # another corner.
    signs = np.where(heights > 0, 1, -1)
    signs = np.where((heights == 0), np.where(signs.sum(axis=1) > 0, 1, -1)[:, None], signs)
    minority = np.where(signs.sum(axis=1) > 0, -1, 1)
    odd_corner = (signs == minority[:, None]).argmax(axis=1)
    order = (odd_corner[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(pieces, order[:, :, None], axis=1), 1, 0)
    h = np.take_along_axis(heights, order, axis=1)
    # a is alone on its side; p and q are where the plane cuts the edges from a to b and to c.
    p = a + (h[:, 0] / (h[:, 0] - h[:, 1]))[:, None] * (b - a)
    q = a + (h[:, 0] / (h[:, 0] - h[:, 2]))[:, None] * (c - a)
    return np.concatenate([np.stack(part, axis=1) for part in ((a, p, q), (p, b, c), (p, c, q))])


def _heights(pieces: FloatArray, knives: FloatArray) -> FloatArray:
    """The signed distances (k, 3) of the corners of triangles from the planes of other triangles.

    pieces, knives: (k, 3, 3) the triangles, and those that define the planes; each piece belongs to
        the knife with the same index.
    """
    a, b, c = np.moveaxis(knives, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.einsum("nij,nj->ni", pieces - a[:, None], normal)


def _cut_meets_triangle(pieces: FloatArray, heights: FloatArray, knives: FloatArray) -> BoolArray:
    """Whether the segment in which the plane of a knife cuts a triangle meets the knife's triangle:
    a mask (k,).

    pieces, knives: (k, 3, 3) the triangles that are cut, and the triangles whose planes cut them.
    heights: (k, 3) the signed distances of the corners of pieces from the planes.

    The segment is clipped by the three edges of the knife: low and high are the ends of what is
    left, as fractions of the segment. The mask is true where something is left, low <= high.
    """
    a, b, c = np.moveaxis(knives, 1, 0)
    normal = np.cross(b - a, c - a)
    # Where each edge of a piece meets the plane of its knife; NaN if it does not.
    ends: list[FloatArray] = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        height_i, height_j = heights[:, i], heights[:, j]
        is_crossed = (height_i * height_j < 0) | ((height_i == 0) ^ (height_j == 0))
        fraction = np.where(
            is_crossed, height_i / np.where(is_crossed, height_i - height_j, 1), np.nan
        )
        ends.append(pieces[:, i] + fraction[:, None] * (pieces[:, j] - pieces[:, i]))
    low, high = np.zeros(len(pieces)), np.ones(len(pieces))
    points = np.stack(ends, axis=1)
    # The two ends of the segment: of the three points at most two differ. The first that is not NaN
    # is one end, and the point farthest from it is the other.
    start = np.where(np.isnan(points[:, 0]), points[:, 1], points[:, 0])
    distances = np.nan_to_num(np.linalg.norm(points - start[:, None], axis=2), nan=-1.0)
    end = points[np.arange(len(points)), distances.argmax(axis=1)]
    for p, q in ((a, b), (b, c), (c, a)):
        inward = np.cross(normal, q - p)
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-300)
        # Heights of the segment's ends above the knife's edge, positive inside, with a tolerance.
        at_start, at_end = (np.einsum("nk,nk->n", x - p, inward) + 1e-9 for x in (start, end))
        # The height is linear along the segment: 0 at the fraction `root`.
        rate = at_end - at_start
        root = -at_start / np.where(rate == 0, 1, rate)
        low = np.where(rate > 0, np.maximum(low, root), low)
        high = np.where(rate < 0, np.minimum(high, root), high)
        # A segment parallel to the knife's edge and outside of it: nothing is left.
        high = np.where((rate == 0) & (at_start < 0), -1.0, high)
    return low <= high
