"""Closed meshes of struts, the unions of capsules and round cones along the edges of a graph. Each
strut is cut at its middle in two halves, and the halves that begin at a node are its star. If stars
meet at the middles of edges only, each is united by itself, and the results are joined there.
Stars of the same shape, of which a lattice has thousands, are united once.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.geometry.mesh_edges import row_norms
from harnack.geometry.neighborhoods import kd_tree
from harnack.meshing.closed_mesh import from_manifold, polygon_factor, to_manifold
from harnack.meshing.meshing_errors import TriangleLimitError
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from manifold3d import Manifold

    from harnack.backend import FloatArray, IntArray
    from harnack.fields.solids.struts import Struts

__all__ = ["strut_manifold"]

# The smallest number of points around, also for struts far thinner than the tolerance.
_LEAST_AROUND = 6
# Lengths that differ by less than this fraction of them count as equal, and radii that differ by
# less than this fraction of the longest edge or of the largest radius.
_SAME = 1e-9
# So many pairs of halves are compared at once, and at most so many in all.
_PAIRS_AT_ONCE, _MOST_PAIRS = 500_000, 60_000_000


def strut_manifold(struts: Struts, level: float, tolerance: float, most_faces: int) -> Manifold:
    """Make a mesh of the points where the function f of struts is at most `level`. Faces are within
    `tolerance` (a length) of its surface, and cross sections of struts have the right area.

    Proof of the tolerance. The radii are enlarged by a factor k, for the area, and vertices lie on
    the surfaces of the larger struts. Let r be the largest radius, s the smallest one, a the angle
    between points around, and b that between rings on balls. Chords of these angles are k r a^2/8
    and k r b^2/8 deep at most. So on the mesh of a strut, its function is at most (k - 1) r, and at
    least (k - 1) s - k r (a^2 + b^2)/8. Neither is farther from 0 than the tolerance. The union of
    the meshes contains the points where f is less than the smaller bound, since one of the struts'
    meshes contains them, and no point where f is larger than the other.

    most_faces: the largest number of triangles, before coplanar ones are merged.

    Raises:
        TriangleLimitError: there would be more triangles.
    """
    from manifold3d import Manifold, OpType

    edges = np.unique(np.sort(struts.edges, axis=1), axis=0)
    radii = struts.radii + level
    edges = edges[(radii[edges] > 0).any(axis=1)]
    nodes, edges, radii = _with_tips(struts.nodes, edges, radii)
    if not len(edges):
        return Manifold()
    # Each ring needs more points than these, by which the number is found below.
    around = 2 * math.pi / math.sqrt(12 * tolerance / float(radii[edges].max()))
    _check_size(int(around), tolerance, most_faces)
    graph = _Graph.of(nodes, edges, radii, tolerance, most_faces)
    vertices_of_strut = graph.around * math.ceil(math.pi / graph.step)
    _check_size(vertices_of_strut, tolerance, most_faces)
    if graph.has_halves and _are_stars_apart(graph):
        surface = _joined_stars(graph)
        if surface is not None:
            return to_manifold(surface)
    _check_size(len(edges) * vertices_of_strut, tolerance, most_faces)
    return Manifold.batch_boolean(
        [to_manifold(graph.strut_surface(k)) for k in range(len(edges))], OpType.Add
    )


def _with_tips(
    nodes: FloatArray, edges: IntArray, radii: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Nodes, edges and radii in which no radius is negative: a cone whose radius comes to 0, or to
    a tiny fraction of itself, ends at a node of its own there. Radii are linear along edges, so its
    points are the same. Cones shorter than the rounding of nodes are left out."""
    ends = radii[edges]
    cut, side = np.nonzero(ends <= _SAME * ends.max(axis=1, keepdims=True))
    other = edges[cut, 1 - side]
    share = np.minimum(radii[other] / (radii[other] - ends[cut, side]), 1.0)
    tips = nodes[other] + share[:, None] * (nodes[edges[cut, side]] - nodes[other])
    edges = edges.copy()
    edges[cut, side] = len(nodes) + np.arange(len(cut))
    nodes, radii = np.concatenate([nodes, tips]), np.append(radii, np.zeros(len(cut)))
    return nodes, edges[(nodes[edges[:, 0]] != nodes[edges[:, 1]]).any(axis=1)], radii


def _check_size(vertices: int, tolerance: float, most_faces: int) -> None:
    """Raise TriangleLimitError if a closed mesh with so many vertices has too many faces."""
    if 2 * vertices > most_faces:
        raise TriangleLimitError(
            f"struts within {tolerance:.3g} take more than {2 * vertices:,} triangles before they "
            f"are simplified, and {most_faces:,} are allowed: choose a larger `tolerance`, or "
            "raise `max_triangles`"
        )


@dataclass(frozen=True)
class _Graph:
    """The edges of a graph, and what the meshes of struts need. Half 2 k of strut k begins at the
    first node of edge k, half 2 k + 1 at the second one.

    nodes: (n, 3). edges: (m, 2) indices of nodes.
    around: the number of points of each ring around a strut.
    step: the largest angle between rings on a ball.
    radii: (2 m,) for each half the radius of the ball about its node, enlarged (`_resolution`).
    vectors: (2 m, 3) for each half the vector from its node to the other one.
    frames: (m, 2, 3) for each edge two unit vectors at right angles to it and to each other, from
        which rings are made; opposite edges have the same.
    middle_radii: (m,) the radii of rings in the middle of edges.
    kinds: (2 m,) equal for halves of the same shape and direction.
    tolerance, most_faces: the arguments of `strut_manifold`.
    has_halves: whether struts can be cut in halves: no ball reaches over the middle of an edge
        beside the cone. Only whole struts may be taken otherwise.
    """

    nodes: FloatArray
    edges: IntArray
    around: int
    step: float
    radii: FloatArray
    vectors: FloatArray
    frames: FloatArray
    middle_radii: FloatArray
    kinds: IntArray
    tolerance: float
    most_faces: int
    has_halves: bool

    @classmethod
    def of(
        cls,
        nodes: FloatArray,
        edges: IntArray,
        radii: FloatArray,
        tolerance: float,
        most_faces: int,
    ) -> _Graph:
        """The graph of edges (m, 2) between nodes (n, 3), which have balls of radii (n,)."""
        ends = radii[edges]
        largest, smallest = float(ends.max()), float(ends.min())
        around, step, factor = _resolution(tolerance / largest, smallest / largest)
        ends = factor * ends
        vector = nodes[edges[:, 1]] - nodes[edges[:, 0]]
        length = row_norms(vector)
        slope = (ends[:, 0] - ends[:, 1]) / length
        # The cone touches the balls at circles, which must lie on their sides of the middle.
        is_plain = np.abs(slope) < 1
        is_plain &= np.abs(slope) * ends.max(axis=1) < 0.5 * length * (1 - _SAME)
        has_halves = bool(is_plain.all())
        # The line along the cone from one circle to the other; at the middle of the edge:
        slope = slope.clip(-1, 1)
        cosine = np.sqrt((1 - slope) * (1 + slope))
        first, last = slope * ends[:, 0], length + slope * ends[:, 1]
        share = (0.5 * length - first) / np.where(is_plain, last - first, 1.0)
        middle_radii = cosine * (ends[:, 0] + share * (ends[:, 1] - ends[:, 0]))
        # Directions and lengths, each to a fraction of itself: some edges are far shorter.
        steps = np.rint(vector / length[:, None] / _SAME).astype(np.int64)
        longest = float(length.max())
        size = np.rint(np.log(length / longest) / _SAME).astype(np.int64)
        thickness = np.rint(ends / (_SAME * max(longest, float(ends.max())))).astype(np.int64)
        vectors = np.stack([vector, -vector], axis=1).reshape(-1, 3)
        # The shape of a half: its direction and length, and both radii.
        shape = np.stack(
            [
                np.column_stack([steps * sign, size, thickness[:, order]])
                for sign, order in ((1, [0, 1]), (-1, [1, 0]))
            ],
            axis=1,
        ).reshape(-1, 6)
        kinds = np.unique(shape, axis=0, return_inverse=True)[1].reshape(-1)
        return cls(
            nodes, edges, around, step, ends.ravel(), vectors, _frames(steps), middle_radii,
            kinds, tolerance, most_faces, has_halves,
        )  # fmt: skip

    def ring(self, edge: int, radius: float) -> FloatArray:
        """The points (around, 3) of a ring around an edge, relative to its center."""
        return radius * (_circle(self.around) @ self.frames[edge])

    def half_surface(self, half: int) -> TriangleMesh:
        """The closed surface of a half, relative to its node. The last vertices are those of the
        ring in the middle of the edge."""
        edge, vector, radius = half // 2, 0.5 * self.vectors[half], float(self.radii[half])
        rings = self._ball_rings(half)
        apex = -radius / float(np.linalg.norm(vector)) * vector
        middle = vector + self.ring(edge, float(self.middle_radii[edge]))
        # Rings run around the edge from its first node to its second one.
        return _closed_surface(apex, [*rings, middle], None, is_turned=half % 2 == 1)

    def strut_surface(self, edge: int) -> TriangleMesh:
        """The closed surface of a whole strut."""
        (start, end), (first, last) = self.edges[edge], (2 * edge, 2 * edge + 1)
        for half, node in ((first, start), (last, end)):
            if self._slope(half) >= 1:  # the ball contains the other one
                origin, vector, ball = self.nodes[node], self.vectors[half], self._ball_rings(half)
                apex = self.radii[half] / np.linalg.norm(vector) * vector
                return _closed_surface(
                    origin - apex, [origin + ring for ring in ball[:-1]], origin + apex,
                    is_turned=half == last,
                )  # fmt: skip
        rings: list[list[FloatArray]] = []
        caps: list[FloatArray] = []
        for half, node in ((first, start), (last, end)):
            origin, vector = self.nodes[node], self.vectors[half]
            rings.append([origin + ring for ring in self._ball_rings(half)])
            caps.append(origin - self.radii[half] / np.linalg.norm(vector) * vector)
        return _closed_surface(caps[0], [*rings[0], *reversed(rings[1])], caps[1], is_turned=False)

    def _slope(self, half: int) -> float:
        """By how much the radius decreases from the node of a half to the other one, per length. At
        most -1 or at least 1 if one ball contains the other."""
        difference = float(self.radii[half] - self.radii[half ^ 1])
        return difference / float(np.linalg.norm(self.vectors[half]))

    def _ball_rings(self, half: int) -> list[FloatArray]:
        """The rings on the ball of a half, relative to its node, from its end to the circle at
        which the cone touches it; to the other end if the ball contains the other one."""
        vector, radius = self.vectors[half], float(self.radii[half])
        if radius == 0:
            return []
        length = float(np.linalg.norm(vector))
        slope = min(self._slope(half), 1.0)
        widest = math.acos(-slope)
        count = max(1 if slope < 1 else 3, math.ceil(widest / self.step))
        angles = [widest * (k + 1) / count for k in range(count)]
        return [
            self.ring(half // 2, radius * math.sin(angle))
            - radius * math.cos(angle) / length * vector
            for angle in angles
        ]


def _resolution(depth: float, ratio: float) -> tuple[int, float, float]:
    """The number of points around struts, the largest angle b between rings on balls, and the
    factor k by which radii are enlarged (`strut_manifold`).

    depth: the tolerance, as a fraction of the largest radius.
    ratio: of the smallest radius to the largest.
    """
    around = max(_LEAST_AROUND, int(2 * math.pi / math.sqrt(12 * depth)) - 1)
    while True:
        angle = 2 * math.pi / around
        factor = polygon_factor(around)
        square = 8 * (depth + (factor - 1) * ratio) / factor - angle * angle
        if factor - 1 <= depth and square >= depth:
            return around, math.sqrt(square), factor
        around += 1


def _circle(count: int) -> FloatArray:
    """Points (count, 2) of the unit circle, counter-clockwise."""
    angles = 2 * math.pi * np.arange(count) / count
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _frames(steps: IntArray) -> FloatArray:
    """For vectors (m, 3) of integers two unit vectors (m, 2, 3) at right angles to each and to each
    other. Opposite vectors have the same ones in another order of rotation, and equal vectors have
    equal ones (Duff et al. 2017, "Building an orthonormal basis, revisited")."""
    # The first component that is not 0 is made positive.
    is_nonzero = steps != 0
    first = np.take_along_axis(steps, is_nonzero.argmax(axis=1)[:, None], axis=1)
    axis = (steps * np.sign(first)).astype(np.float64)
    axis /= row_norms(axis)[:, None]
    x, y, z = axis.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    v = np.stack([b, sign + y * y * a, -y], axis=1)
    # Rings are counter-clockwise as seen from the second node of the edge.
    is_reversed = np.sign(first) < 0
    return np.stack([np.where(is_reversed, v, u), np.where(is_reversed, u, v)], axis=1)


def _closed_surface(
    apex: FloatArray, rings: list[FloatArray], end: FloatArray | None, *, is_turned: bool
) -> TriangleMesh:
    """The surface through an apex, rings of points (n, 3) each, and an apex at the other end; None
    for a flat polygon there. The rings run counter-clockwise as seen from that end, or clockwise if
    `is_turned`."""
    around, count = len(rings[0]), len(rings)
    vertices = [apex[None], *([] if end is None else [end[None]]), *rings]
    offset = len(vertices) - count
    here = np.arange(around)
    after = (here + 1) % around
    ring = [offset + k * around for k in range(count)]
    faces = [np.stack([np.zeros_like(here), ring[0] + after, ring[0] + here], axis=1)]
    for low, high in itertools.pairwise(ring):
        faces.append(np.stack([low + here, low + after, high + after], axis=1))
        faces.append(np.stack([low + here, high + after, high + here], axis=1))
    if end is None:
        inner = np.arange(1, around - 1)
        faces.append(ring[-1] + np.stack([np.zeros_like(inner), inner, inner + 1], axis=1))
    else:
        faces.append(np.stack([np.ones_like(here), ring[-1] + here, ring[-1] + after], axis=1))
    all_faces = np.concatenate(faces)
    return TriangleMesh(np.concatenate(vertices), all_faces[:, ::-1] if is_turned else all_faces)


# Whether stars meet at the middles of edges only.


def _are_stars_apart(graph: _Graph) -> bool:
    """Whether halves that begin at different nodes are apart, but for the two halves of an edge;
    and whether no other half of a star comes near the middle of an edge.

    Proof that the joined stars are then the surface of the union. A half is contained in the points
    within its larger radius of its segment. So a point in two stars lies on the polygon in the
    middle of an edge, which no further half touches: it is a polygon of the surface of both stars.
    """
    edge = np.arange(2 * len(graph.edges)) // 2
    start = graph.nodes[graph.edges.ravel()]
    vector = 0.5 * graph.vectors
    radius = np.maximum(graph.radii, graph.middle_radii[edge])
    tree = kd_tree(start + 0.5 * vector)
    reach = 2 * float((0.5 * row_norms(vector) + radius).max())
    if tree.count_neighbors(tree, reach) > 2 * _MOST_PAIRS:
        return False
    pairs: IntArray = tree.query_pairs(reach, output_type="ndarray")
    pairs = pairs[edge[pairs[:, 0]] != edge[pairs[:, 1]]]
    nodes = graph.edges.ravel()
    for k in range(0, len(pairs), _PAIRS_AT_ONCE):
        i, j = pairs[k : k + _PAIRS_AT_ONCE].T
        is_same = nodes[i] == nodes[j]
        a, b = i[~is_same], j[~is_same]
        between = _segment_distances(start[a], vector[a], start[b], vector[b])
        if (between <= (radius[a] + radius[b]) * (1 + _SAME)).any():
            return False
        # Halves of a star: the middle of each, and the other one.
        for a, b in ((i[is_same], j[is_same]), (j[is_same], i[is_same])):
            middle, nothing = start[a] + vector[a], np.zeros((len(a), 3))
            between = _segment_distances(middle, nothing, start[b], vector[b])
            if (between <= (radius[a] + radius[b]) * (1 + _SAME)).any():
                return False
    return True


def _segment_distances(p: FloatArray, u: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
    """The distances (n,) of segments, from p to p + u and from q to q + v, (n, 3) each. u may be
    0. (Ericson 2005, "Real-Time Collision Detection", section 5.1.9.)"""

    def dot(a: FloatArray, b: FloatArray) -> FloatArray:
        """The scalar products of rows."""
        return np.einsum("ij,ij->i", a, b)

    w = p - q
    a, b, c, d, e = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    determinant = a * c - b * b
    is_askew = determinant > 1e-12 * a * c
    s = np.where(is_askew, (b * e - c * d) / np.where(is_askew, determinant, 1.0), 0.0).clip(0, 1)
    t = ((b * s + e) / c).clip(0, 1)
    s = np.where(a > 0, (b * t - d) / np.where(a > 0, a, 1.0), 0.0).clip(0, 1)
    return row_norms(w + s[:, None] * u - t[:, None] * v)


# Stars.


@dataclass(frozen=True)
class _Star:
    """The united halves that begin at a node, relative to it, without the polygons in the middles
    of edges.

    vertices: (v, 3). faces: (f, 3).
    rings: (halves, n) for each half the vertices of its ring in the middle of the edge.
    """

    vertices: FloatArray
    faces: IntArray
    rings: IntArray

    @classmethod
    def of(cls, graph: _Graph, halves: IntArray) -> _Star | None:
        """The star of these halves; None if a polygon in the middle of an edge is not as it was."""
        from manifold3d import Manifold, OpType

        surfaces = [graph.half_surface(half) for half in halves.tolist()]
        united = Manifold.batch_boolean([to_manifold(s) for s in surfaces], OpType.Add)
        mesh = from_manifold(united)
        middles = np.concatenate([s.vertices[-graph.around :] for s in surfaces])
        distance, nearest = kd_tree(mesh.vertices).query(middles)
        scale = float(np.abs(middles).max())
        if (distance > _SAME * scale).any() or len(np.unique(nearest)) < len(nearest):
            return None
        rings = nearest.reshape(-1, graph.around)
        ring_of = np.full(len(mesh.vertices), -1)
        ring_of[rings] = np.arange(len(rings))[:, None]
        corners = ring_of[mesh.faces]
        is_polygon = (corners >= 0).all(axis=1) & (np.ptp(corners, axis=1) == 0)
        counts = np.bincount(corners[is_polygon, 0], minlength=len(rings))
        if (counts != graph.around - 2).any():
            return None
        return cls(mesh.vertices, mesh.faces[~is_polygon], rings)


def _joined_stars(graph: _Graph) -> TriangleMesh | None:
    """The surface of all stars, joined at the rings in the middles of edges; None if a star could
    not be made. Vertex k n + j is point j of the ring of edge k; others follow."""
    nodes = graph.edges.ravel()
    # The halves of each node, those of smaller kinds first.
    order = np.lexsort([graph.kinds, nodes])
    borders = np.flatnonzero(np.diff(nodes[order])) + 1
    stars: dict[bytes, list[IntArray]] = {}
    for halves in np.split(order, borders):
        stars.setdefault(graph.kinds[halves].tobytes(), []).append(halves)
    middles = 0.5 * (graph.nodes[graph.edges[:, 0]] + graph.nodes[graph.edges[:, 1]])
    rings = middles[:, None] + graph.middle_radii[:, None, None] * (
        _circle(graph.around) @ graph.frames
    )
    vertices: list[FloatArray] = [rings.reshape(-1, 3)]
    faces: list[IntArray] = []
    count = len(vertices[0])
    for halves_of_stars in stars.values():
        star = _Star.of(graph, halves_of_stars[0])
        if star is None:
            return None
        halves = np.stack(halves_of_stars)
        # Of each star the vertices that are in no ring.
        inner = np.setdiff1d(np.arange(len(star.vertices)), star.rings)
        index = np.empty((len(halves), len(star.vertices)), np.int64)
        index[:, inner] = count + np.arange(len(halves) * len(inner)).reshape(len(halves), -1)
        points = np.arange(graph.around)
        index[:, star.rings] = halves[:, :, None] // 2 * graph.around + points
        origin = graph.nodes[nodes[halves[:, 0]]]
        vertices.append((origin[:, None] + star.vertices[inner]).reshape(-1, 3))
        faces.append(index[:, star.faces].reshape(-1, 3))
        count += len(vertices[-1])
        _check_size(count, graph.tolerance, graph.most_faces)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))
