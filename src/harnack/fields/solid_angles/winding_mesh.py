"""Triangle meshes prepared for winding numbers: vertices at the same place are joined (welded),
faces and their reversed copies are canceled, lengths are scaled, and triangles are sorted into a
tree. A *singular edge* is an edge at which the triangles do not cancel; these edges are the
boundary of the mesh. The *multiplicity* of a face is the number of its copies minus the number of
its reversed copies. *Unit coordinates* have their origin at the center of the mesh, and the mesh
has a size of about one in them."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.fmm.multipole import NodeMoments, triangle_tree_moments
from harnack.fmm.unit_frame import round_to_single
from harnack.geometry import MeshError, validate_mesh
from harnack.geometry.welding import Welded, rounding_of
from harnack.tree import BalancedTree, build_balanced_tree
from harnack.tree.triangle_tree import MAX_TRIANGLES, PARITY_COLUMN, triangle_records

# The largest number of triangles in a leaf, and the number of children of a node: by experiment.
_LEAF_SIZE, _ARITY = 8, 4
# Cached properties that `WindingMesh.with_vertices` keeps. They depend only on the faces; or they
# are trees, which stay valid, although not optimal, when vertices move.
_KEPT_PROPERTIES = ("moving_edges", "triangles", "tree", "ray_tree", "singular_flags")


@dataclass(frozen=True)
class WindingMesh:
    """A triangle mesh with all data from which a winding number is evaluated, in double precision,
    in NumPy. *Faces* are different from each other; *triangles* are the faces, each repeated by its
    multiplicity. A singular edge is one at which triangles do not cancel.

    vertices: (n, 3), in the order of the input.
    faces: (m, 3) indices of welded vertices. No two faces are equal.
    multiplicity: (m,) for each face the number of its copies in the input minus the number of its
        reversed copies.
    input_face: (m,) the index of the input face from which each face comes.
    singular_edges: (k, 2) directed edges at which triangles do not cancel. An edge of weight 2
        occurs twice.
    input_faces: (g, 3) all faces of the input.
    weld_map: (n,) for each vertex the index of the vertex that stands for it.
    rounded: the number of positions that were joined with other positions from which they differed
        by rounding (`geometry.welding`).
    center, size: `unit_vertices` = (vertices - center)/size. The size is a power of two, so that
        scaling lengths is exact.
    """

    vertices: FloatArray
    faces: IntArray
    multiplicity: IntArray
    input_face: IntArray
    singular_edges: IntArray
    input_faces: IntArray
    weld_map: IntArray
    rounded: int
    center: FloatArray
    size: float

    @classmethod
    def of(cls, vertices: npt.ArrayLike, faces: npt.ArrayLike) -> WindingMesh:
        """Prepare the mesh of vertices (n, 3) and faces (m, 3).

        Raises:
            MeshError: as `validate_mesh`; or all faces cancel each other; or there are too many
            triangles.
        """
        x, f = validate_mesh(vertices, faces)
        welded = Welded.of(x, f)
        # The faces that are left after copies and reversed copies have been added up.
        net = welded.net
        if len(net.faces) == 0:
            raise MeshError("faces: every face is canceled by its own copy turned round")
        if net.multiplicity.sum() >= MAX_TRIANGLES:
            raise MeshError(
                f"faces: at most {MAX_TRIANGLES - 1} are possible; cut the mesh in parts"
            )
        # In the order of the attributes. A singular edge occurs as often as its weight says.
        return cls(
            x,
            net.faces,
            net.multiplicity,
            net.source,
            np.repeat(welded.edges, welded.weights, axis=0),
            f,
            welded.index,
            welded.rounded,
            *_center_and_size(x, net.faces),
        )

    def with_vertices(self, vertices: npt.ArrayLike) -> WindingMesh:
        """The mesh with other positions of its vertices (n, 3). It shares the data that depend only
        on the faces, and the hierarchy of trees that have been built. Positions, boxes and moments
        are new.

        Raises:
            MeshError: as `validate_mesh`; or there is another number of vertices; or vertices that
            coincided, so that faces were joined there, come apart.
        """
        x, faces = validate_mesh(vertices, self.input_faces)
        if len(x) != len(self.vertices):
            raise MeshError(
                f"vertices: {len(x)} of them, where {len(self.vertices)} were before: moving "
                "vertices keeps their number and their order"
            )
        # Vertices that are no longer at the place of the vertex that stands for them, whose index
        # is in self.weld_map.
        has_moved = (x != x[self.weld_map]).any(axis=1)
        # If positions that differed by rounding were joined (self.rounded is their number), they
        # may differ by rounding again.
        if self.rounded and has_moved.any():
            has_moved = np.abs(x - x[self.weld_map]).max(axis=1) > rounding_of(x)
        if has_moved.any():
            torn_faces = faces[has_moved[faces]]
            if len(torn_faces):
                i = int(torn_faces[0])
                raise MeshError(
                    f"vertices: {i} and {self.weld_map[i]} were at the same place, where faces "
                    "were "
                    "joined, and now are not: make a new winding number of this mesh"
                )
        center, size = _center_and_size(x, self.faces)
        mesh = dataclasses.replace(self, vertices=x, center=center, size=size)
        # A cached property is in the dictionary of its object once it has been computed.
        properties = vars(self)
        vars(mesh).update(
            {name: properties[name] for name in _KEPT_PROPERTIES if name in properties}
        )
        return mesh

    @functools.cached_property
    def unit_vertices(self) -> FloatArray:
        """The vertices (n, 3) in unit coordinates, with the origin at the center of the mesh and a
        size of about one."""
        return (self.vertices - self.center) / self.size

    @functools.cached_property
    def moving_edges(self) -> IntArray:
        """The directed edges (k, 2), as indices of the user's vertices, that are left if edges of
        input faces in opposite directions cancel. They contain `singular_edges`, and also those
        edges that only cancel because vertices of different indices are at the same place: if these
        move one by one, they no longer do. An edge of weight 2 occurs twice."""
        faces, count = self.input_faces, len(self.vertices)
        ends = np.concatenate([faces[:, (k, (k + 1) % 3)] for k in range(3)])
        is_forward = ends[:, 0] < ends[:, 1]
        keys = ends.min(axis=1) * count + ends.max(axis=1)
        keys, index = np.unique(keys, return_inverse=True)
        weights = np.bincount(index.ravel(), np.where(is_forward, 1, -1)).astype(np.int64)
        low, high = keys // count, keys % count
        pairs = np.where(weights[:, None] > 0, np.stack([low, high], 1), np.stack([high, low], 1))
        return np.repeat(pairs, np.abs(weights), axis=0)

    @functools.cached_property
    def triangles(self) -> IntArray:
        """Indices (k, 3) of the vertices of all triangles: the faces, each repeated by its
        multiplicity."""
        return np.repeat(self.faces, self.multiplicity, axis=0)

    @functools.cached_property
    def corners(self) -> FloatArray:
        """The positions (k, 3, 3) of the three corners of each triangle, in unit coordinates."""
        return self.unit_vertices[self.triangles]

    @functools.cached_property
    def tree(self) -> BalancedTree:
        """A balanced tree over the centroids of the triangles, for sums over triangles."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return build_balanced_tree((a + b + c) / 3, leaf_size=_LEAF_SIZE, arity=_ARITY)

    @functools.cached_property
    def ray_tree(self) -> BalancedTree:
        """A balanced tree over the centroids of the faces, for rays. It has each face once, because
        a ray crosses all copies of a face at once."""
        if len(self.faces) == len(self.triangles):
            return self.tree
        centroids = self.unit_vertices[self.faces].mean(axis=1)
        return build_balanced_tree(centroids, leaf_size=_LEAF_SIZE, arity=_ARITY)

    @functools.cached_property
    def ray_records(self) -> FloatArray:
        """Records (m, 14) of the faces, the rows of numbers that kernels read
        (`tree.triangle_tree`). The number in a record that gives crossings their sign (the parity)
        is multiplied by the face's multiplicity."""
        records = triangle_records(self.unit_vertices, self.faces)
        records[:, PARITY_COLUMN] *= self.multiplicity
        return records

    @functools.cached_property
    def records(self) -> FloatArray:
        """Records (k, 14) of the triangles, the rows of numbers that kernels read
        (`tree.triangle_tree`). Each copy of a face has a record of its own, with the index of the
        face."""
        if len(self.faces) == len(self.triangles):
            return self.ray_records
        return np.repeat(
            triangle_records(self.unit_vertices, self.faces), self.multiplicity, axis=0
        )

    @functools.cached_property
    def levels(self) -> list[NodeMoments]:
        """Multipole moments of the nodes of `tree`, one entry for each level, from the leaves to
        the root."""
        return triangle_tree_moments(self.tree, self.corners)

    @functools.cached_property
    def singular_flags(self) -> FloatArray:
        """For each triangle (k, 3), three numbers for the edges from corner 0 to 1, 1 to 2 and 0 to
        2 of its record: 1 if the edge is singular, else 0. A record orders the corners by vertex
        index."""
        # An edge has the key low * count + high, with the indices of its ends. Only edges between
        # two ends of singular edges need to be looked up.
        count = len(self.vertices)
        keys = np.sort(self.singular_edges.min(axis=1) * count + self.singular_edges.max(axis=1))
        is_end = np.zeros(count, np.bool_)
        is_end[self.singular_edges] = True
        flags = np.zeros((len(self.triangles), 3))
        ends = np.sort(self.triangles, axis=1)
        for k, (i, j) in enumerate(((0, 1), (1, 2), (0, 2))):
            candidates = np.flatnonzero(is_end[ends[:, i]] & is_end[ends[:, j]])
            edges: IntArray = ends[candidates, i] * count + ends[candidates, j]
            # If an edge is singular, its key is at the place where it belongs in the sorted keys;
            # if not, another key is there. "clip" keeps the place within the array.
            flags[candidates, k] = keys.take(np.searchsorted(keys, edges), mode="clip") == edges
        return flags

    @functools.cached_property
    def box(self) -> tuple[Any, Any]:
        """The lower and the upper corner (3,) of the box around the faces, in the user's
        coordinates."""
        return _box(self.vertices, self.faces)

    @functools.cached_property
    def area(self) -> float:
        """The total area of all triangles, in the square of the user's unit."""
        p, q, r = np.moveaxis(self.corners, 1, 0)
        cross = np.linalg.norm(np.cross(q - p, r - p), axis=1)
        return float(0.5 * cross.sum() * self.size**2)

    @functools.cached_property
    def boundary_length(self) -> float:
        """The total length of all singular edges, in the user's unit."""
        ends = self.vertices[self.singular_edges]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def _box(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, FloatArray]:
    """The lower and the upper corner (3,) of the box around the vertices that the faces use."""
    used = np.zeros(len(vertices), np.bool_)
    used[faces] = True
    return vertices[used].min(axis=0), vertices[used].max(axis=0)


def _center_and_size(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, float]:
    """The center (3,) and the size that define the unit coordinates of a mesh. The center is that
    of the box around its faces, rounded to single precision. The size is the smallest power of two
    that is at least half of the box's longest side."""
    low, high = _box(vertices, faces)
    size = 2.0 ** np.ceil(np.log2(0.5 * float((high - low).max())))
    return round_to_single(0.5 * (low + high)), float(size)
