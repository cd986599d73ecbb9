"""The cleaning of a damaged mesh: which triangles can stay, and what is wrong with the others. The
damaged mesh is "the input". A "filling" consists of new triangles that close a hole; an "open edge"
belongs to a single triangle. "Loose" triangles share no vertices.

Duplicate, degenerate and intersecting triangles are removed; those turned over against their
neighbors are flipped. The remaining triangles are oriented and intersect nothing, and their holes
are filled by `hole_filling`. Where that fails, the triangles around the hole are removed too, ring
by ring.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry.boundary_edges import weld_vertices
from harnack.geometry.mesh_edges import (
    Edges,
    area_normals,
    boundary_edges,
    half_edges,
    has_distinct_corners,
    row_norms,
)
from harnack.geometry.neighborhoods import connected_groups, pairs_within
from harnack.geometry.orientability import orientation_components
from harnack.meshing.checks import check_manifold, nonmanifold_vertices
from harnack.meshing.components import Shells, faces_to_flip
from harnack.meshing.hole_filling import fill_holes, hole_loops
from harnack.meshing.joined_pieces import passes_itself
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["CleanedMesh", "against_neighbors", "clean_and_fill", "weld_near_corners"]

# The largest number of rings of triangles that are removed around a hole; and the largest fraction
# of all triangles that may be removed.
_MOST_RINGS, _MAX_REMOVED_SHARE = 6, 0.5
# If the ratio of open edges to triangles is larger than this, the triangles are loose.
_MAX_OPEN_RATIO = 0.5
# The distances, relative to the median edge length, that are tried for loose triangles: corners
# nearer than the distance are joined.
_WELD_DISTANCES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)


@dataclass(frozen=True)
class CleanedMesh:
    """A closed mesh, made from a damaged one. Its first faces are the valid triangles of the
    damaged mesh (the input), with unchanged coordinates; fillings follow.

    surface: the mesh.
    kept_faces: (k,) the indices of the input faces that were kept, ascending. Face i < k of the
        mesh is input face kept_faces[i].
    turned: the indices of the kept input faces that have the reverse orientation in the mesh.
    left_out: for each reason, the number of input faces that were removed for it.
    holes: the number of filled holes."""

    surface: TriangleMesh
    kept_faces: IntArray
    turned: IntArray
    left_out: dict[str, int]
    holes: int


def clean_and_fill(
    vertices: FloatArray, faces: IntArray, report: Callable[[str], None]
) -> CleanedMesh:
    """Keep the valid triangles of a mesh (those that have an area, are no duplicates and intersect
    no others), and fill all holes, also those left by removed triangles. Around holes that cannot
    be filled, and vertices where sheets touch, up to six rings of triangles are removed, one after
    the other.

    report: called with a message before each step.

    Raises:
        MeshingError: half of the triangles or more would be removed, most of them are loose, or
            holes cannot be filled.
    """
    report("looking for triangles that are sound")
    working = _WorkingMesh.of(vertices, faces)
    holes, why, min_faces = 0, "", _MAX_REMOVED_SHARE * len(working.faces)
    for ring in range(_MOST_RINGS):
        working = working.without_nonmanifold_edges()
        if not len(working.faces):
            raise MeshingError("none of its triangles is sound")
        edges = boundary_edges(working.faces)
        if len(edges) > _MAX_OPEN_RATIO * len(working.faces):
            raise MeshingError(f"{len(edges):,} edges of {len(working.faces):,} triangles are open")
        loops = hole_loops(working.vertices, working.faces, edges)
        report(f"{len(loops):,} holes" + f", {ring} rings wider in places" * (ring > 0))
        working, unfilled, why = working.filled(loops)
        holes += len(loops) - len(unfilled)
        # Where the mesh is still no closed manifold, remove the faces around, and try again.
        failing_vertices = np.concatenate([nonmanifold_vertices(working.faces), *unfilled])
        if not len(failing_vertices):
            return working.result(holes)
        working = working.without_ring(failing_vertices)
        # Faces of fillings, which have no source, do not count.
        if (working.source_face >= 0).sum() < min_faces:
            raise MeshingError(f"half of the triangles would be left out: {why}")
    raise MeshingError(f"holes cannot be filled, even {_MOST_RINGS} rings wider: {why}")


def weld_near_corners(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray, float]:
    """Join the corners of loose triangles (which share no vertices): corners that are closer to
    each other than some distance become one vertex at their mean. Of several distances, the one
    that leaves the fewest open edges is used.

    Returns:
        The joined vertices (k, 3); the faces (m, 3), with indices of these; and how far the
        farthest corner was moved, a length.

    Raises:
        MeshingError: the triangles are not loose, or most edges stay open.
    """
    points, index = np.unique(vertices[faces].reshape(-1, 3), axis=0, return_inverse=True)
    corners = np.asarray(index, np.int64).reshape(-1, 3)
    if len(boundary_edges(corners)) <= _MAX_OPEN_RATIO * len(faces):
        raise MeshingError("its triangles are not loose")
    corner_positions = points[corners]
    median_length = float(
        np.median(
            row_norms((corner_positions - np.roll(corner_positions, 1, axis=1)).reshape(-1, 3))
        )
    )
    candidates: list[tuple[int, FloatArray, IntArray, float]] = []
    for fraction in _WELD_DISTANCES:
        group = connected_groups(pairs_within(points, fraction * median_length), len(points))
        count = np.bincount(group)[:, None]
        mean = np.stack([np.bincount(group, column) for column in points.T], axis=1) / count
        renumbered = group[corners]
        welded_faces = renumbered[has_distinct_corners(renumbered)]
        # A lost triangle counts as three open edges.
        lost_edges = 3 * (len(faces) - len(welded_faces))
        largest_move = float(row_norms(mean[group] - points).max())
        candidates.append(
            (len(boundary_edges(welded_faces)) + lost_edges, mean, welded_faces, largest_move)
        )
    # The candidate with the fewest open edges.
    count, mean, welded_faces, largest_move = min(candidates, key=lambda candidate: candidate[0])
    if count > _MAX_OPEN_RATIO * len(faces):
        raise MeshingError(
            f"triangles are loose, and {count:,} edges of {len(faces):,} stay open if near corners "
            "are joined"
        )
    return mean, welded_faces, largest_move


@dataclass(frozen=True)
class _WorkingMesh:
    """A mesh while it is cleaned. It knows from which face of the damaged mesh (the input) each of
    its faces comes, whether it was turned over, and how many input faces were removed so far.

    vertices: (n, 3), those of the input first. faces: (m, 3).
    source_face: (m,) the index of the input face that each face is; -1 for a face of a filling.
    is_turned: (m,) whether the face has the reverse orientation of its input face.
    counts: for each reason, the number of input faces that were removed for it."""

    vertices: FloatArray
    faces: IntArray
    source_face: IntArray
    is_turned: BoolArray
    counts: dict[str, int]

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> _WorkingMesh:
        """The mesh of those `faces` (m, 3) that have an area and intersect no others; of duplicates
        one is kept. Vertices at the same position count as one."""
        joined_faces = weld_vertices(vertices)[faces]
        all_faces = np.arange(len(faces))
        corner = vertices[joined_faces]
        area = row_norms(area_normals(corner))
        # Three reasons in turn: faces without an area, duplicates, and faces that intersect others.
        rows = all_faces[area > 0]
        # The last four are for faces that are removed later.
        reasons = ("flat", "doubled", "crossing", "branching", "one-sided", "around", "inside")
        counts = dict.fromkeys(reasons, 0) | {"flat": len(faces) - len(rows)}
        _, first_of_duplicates = np.unique(
            np.sort(joined_faces[rows], axis=1), axis=0, return_index=True
        )
        counts["doubled"] = len(rows) - len(first_of_duplicates)
        rows = rows[np.sort(first_of_duplicates)]
        crossing = intersecting_faces(vertices, joined_faces[rows])
        counts["crossing"] = len(crossing)
        rows = np.delete(rows, crossing)
        return cls(vertices, joined_faces[rows], rows, np.zeros(len(rows), np.bool_), counts)

    def keep_faces(self, is_kept: BoolArray, reason: str) -> _WorkingMesh:
        """The mesh with only the faces where the mask `is_kept` (m,) is set. Input faces that are
        removed are counted under `reason`, a key of `counts`."""
        removed = int((~is_kept & (self.source_face >= 0)).sum())
        counts = self.counts | {reason: self.counts[reason] + removed}
        return _WorkingMesh(
            self.vertices,
            self.faces[is_kept],
            self.source_face[is_kept],
            self.is_turned[is_kept],
            counts,
        )

    def without_nonmanifold_edges(self) -> _WorkingMesh:
        """The mesh with at most two faces at each edge, and with faces that agree in orientation
        with their neighbors.

        Faces at edges of more faces are removed, and so are sheets that hang on the surface there
        (`without_fins`). The other faces are oriented alike; those at edges where that is not
        possible are removed too."""
        working = self.without_fins()
        edges = Edges.of(half_edges(working.faces))
        # (`edge_of_pair` lists the first edges of all faces, then the second, then the third.)
        is_at_overused_edge = np.asarray(
            (edges.multiplicity > 2)[edges.edge_of_pair].reshape(3, -1).any(axis=0)
        )
        working = working.keep_faces(~is_at_overused_edge, "branching")
        is_reversed = against_neighbors(working.vertices, working.faces)
        oriented = np.where(is_reversed[:, None], working.faces[:, ::-1], working.faces)
        pairs = half_edges(oriented)
        edges = Edges.of(pairs)
        is_one_sided = edges.run_twice_alike(pairs)[edges.edge_of_pair].reshape(3, -1).any(axis=0)
        working = _WorkingMesh(
            working.vertices,
            oriented,
            working.source_face,
            working.is_turned ^ is_reversed,
            working.counts,
        )
        return working.keep_faces(~np.asarray(is_one_sided), "one-sided")

    def without_fins(self) -> _WorkingMesh:
        """The mesh without fins, sheets that hang on a surface along edges of more than two faces.

        Such edges divide the mesh into pieces. As long as there are such edges, the smallest piece
        that touches one and also has open edges is removed, but never the piece with the largest
        area."""
        working = self
        while True:
            edges = Edges.of(half_edges(working.faces))
            if not (edges.multiplicity > 2).any():
                return working
            piece_of_face = _pieces(edges, len(working.faces))
            face_count = edges.multiplicity[edges.edge_of_pair].reshape(3, -1)
            count = int(piece_of_face.max()) + 1
            # For each piece, whether some face of it has an edge of more than two faces, or an open
            # edge.
            has_overused_edge, has_open_edge = (
                np.bincount(piece_of_face, is_marked.any(axis=0), minlength=count) > 0
                for is_marked in (face_count > 2, face_count == 1)
            )
            area = np.bincount(
                piece_of_face, row_norms(area_normals(working.vertices[working.faces]))
            )
            # A fin ends in the open; the piece with the largest area is taken to be the surface
            # itself.
            fins = np.flatnonzero(has_overused_edge & has_open_edge & (area < area.max()))
            if not len(fins):
                return working
            working = working.keep_faces(piece_of_face != fins[area[fins].argmin()], "branching")

    def filled(self, loops: list[IntArray]) -> tuple[_WorkingMesh, list[IntArray], str]:
        """Fill holes whose fillings pass the checks of `fill_holes`.

        loops: for each hole, the indices (k,) of the vertices around it.

        Returns:
            The mesh with the fillings as last faces; the loops of the holes that stay open; and the
            reason for these, "" if there are none.
        """
        if not loops:
            return self, [], ""
        field = WindingNumber(self.vertices, self.faces)
        filling = fill_holes(
            self.vertices, self.faces, loops, lambda p: field.value(p, precision="double")
        )
        # New faces come from no face of the input (-1), and are not turned. `counts` stays, since
        # no face was removed.
        new_count = len(filling.faces)
        filled_mesh = _WorkingMesh(
            np.concatenate([self.vertices, filling.vertices]),
            np.concatenate([self.faces, filling.faces]),
            np.concatenate([self.source_face, np.full(new_count, -1)]),
            np.concatenate([self.is_turned, np.zeros(new_count, np.bool_)]),
            self.counts,
        )
        return filled_mesh, filling.unfilled_loops, filling.reason

    def without_ring(self, places: IntArray) -> _WorkingMesh:
        """The mesh without the faces that have a corner among the vertices with the indices
        `places`. Input faces among the removed ones are counted under the reason "around"."""
        is_bad = np.zeros(len(self.vertices), np.bool_)
        is_bad[places] = True
        return self.keep_faces(~np.asarray(is_bad[self.faces].any(axis=1)), "around")

    def result(self, holes: int) -> CleanedMesh:
        """The cleaned mesh, made from this mesh, which must be closed. Three things are done: faces
        are reversed where necessary, so that all face outwards; faces inside of the solid are
        removed; and the faces that come from the input are put first, in the input's order.

        holes: how many holes were filled so far, an entry of the result.

        Raises:
            MeshingError: the surface passes through itself.
        """
        # A rank above all indices of input faces puts fillings last.
        filling_rank = int(self.source_face.max(initial=-1)) + 1
        order = np.argsort(
            np.where(self.source_face < 0, filling_rank, self.source_face), kind="stable"
        )
        faces, source_face = self.faces[order], self.source_face[order]
        check_manifold(faces)
        is_flipped = faces_to_flip(TriangleMesh(self.vertices, faces))
        faces = np.where(is_flipped[:, None], faces[:, ::-1], faces)
        mesh = TriangleMesh(self.vertices, faces)
        shells = Shells.of(mesh)
        if passes_itself(mesh, shells.component_of_face):
            raise MeshingError("it passes through itself along edges that lie on faces")
        is_outer = shells.bound()
        dropped_count = int((source_face[~is_outer] >= 0).sum())
        faces, source_face, is_turned = (
            faces[is_outer],
            source_face[is_outer],
            (self.is_turned[order] ^ is_flipped)[is_outer],
        )
        turned = source_face[is_turned & (source_face >= 0)]
        surface = TriangleMesh.without_unused_vertices(self.vertices, faces)
        counts = self.counts | {"inside": dropped_count}
        return CleanedMesh(surface, source_face[source_face >= 0], turned, counts, holes)


def _pieces(edges: Edges, count: int) -> IntArray:
    """(m,) for each face the number of its piece. Two faces belong to one piece if a chain of faces
    leads from one to the other, in which consecutive faces share an edge that has exactly two
    faces.

    edges: the edges of the mesh, made from its `half_edges`. count: m, the number of faces."""
    return connected_groups(edges.paired_half_edges() % count, count)


def against_neighbors(x: FloatArray, faces: IntArray) -> BoolArray:
    """(m,) the mask of the faces to reverse, so that faces that share an edge agree in orientation.

    x: (n, 3) the vertices. faces: (m, 3).

    A connected part of the surface has two consistent orientations. The one that reverses less area
    is chosen. In one-sided parts, such as a Moebius strip, no face is reversed."""
    # Each connected part has two consistent orientations, with different numbers: part[i] is the
    # number of the one that has face i as it is, part[m + i] of the one that has it reversed.
    m, part = len(faces), orientation_components(faces)
    corner = x[faces]
    area = row_norms(area_normals(corner))
    kept_area = np.bincount(part[:m], area, minlength=int(part.max(initial=-1)) + 1)
    return kept_area[part[:m]] < kept_area[part[m:]]
