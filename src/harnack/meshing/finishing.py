"""What is done with a mesh in the end: normals at its vertices, simplification, and conversion to
trimesh, with facts about the mesh in its metadata. A surface here is a triangle mesh."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.validation import as_integer_in_range, as_real
from harnack.geometry.mesh_edges import (
    Edges,
    boundary_edges,
    half_edges,
    normals_at_vertices,
    row_dots,
    unit_normals,
)
from harnack.meshing.checks import euler_characteristic
from harnack.meshing.closed_mesh import from_manifold, to_manifold, without_short_edges
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.self_intersection_repair import resolve_self_intersections
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from collections.abc import Callable

    import trimesh

__all__ = ["check_options", "simplify_mesh", "to_trimesh", "vertex_normals"]

# An edge is a crease if the cosine of the angle between its faces' normals is below this.
_CREASE_COSINE = math.cos(math.radians(30))
# How far simplification may move a surface, tried in this order; and how far vertices near crossing
# triangles may be moved afterwards. Both are relative to the tolerance.
_SIMPLIFIED_WITHIN, _MENDED_WITHIN = (0.4, 0.2, 0.1), 0.05


def check_options(spacing: Any, thickness: Any, seed: Any, max_triangles: Any) -> None:
    """Raise ValueError or TypeError unless options of `mesh` are in their ranges: `cell_size` (the
    parameter `spacing`) and `thickness` positive or None, `seed` a nonnegative integer,
    `max_triangles` a positive integer."""
    for name, value in (("cell_size", spacing), ("thickness", thickness)):
        if value is not None and not 0 < as_real(value, name) < math.inf:
            raise ValueError(f"{name} must be a positive length, not {value!r}")
    as_integer_in_range(seed, "seed", 0, 2**63 - 1)
    as_integer_in_range(max_triangles, "max_triangles", 1, 2**63 - 1)


def vertex_normals(function: LevelFunction, surface: TriangleMesh) -> FloatArray:
    """Unit normals (n, 3) at the vertices of a surface, in the direction of the gradient of the
    field. At some vertices the field has no gradient, as at a curve at which the surface ends, or
    the gradient is far from the direction of the faces. There the normal is the mean of the faces'
    normals, weighted by area.

    function: the field minus its level.
    """
    mean = normals_at_vertices(surface.vertices, surface.faces)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    slope = function.sample(surface.vertices).gradient
    steep: FloatArray = np.linalg.norm(slope, axis=1)
    slope = slope / np.maximum(steep, 1e-300)[:, None]
    # Finite, not zero, and within 45 degrees of the mean normal of the faces.
    is_reliable = np.isfinite(steep) & (steep > 0) & ((slope * mean).sum(axis=1) > 0.7)
    # Such surfaces end at a curve on which the field has no gradient.
    if function.period is not None:
        is_reliable[np.unique(boundary_edges(surface.faces))] = False
    chosen: FloatArray = np.where(is_reliable[:, None], slope, mean)
    return chosen


def simplify_mesh(
    surface: TriangleMesh, tolerance: float, check: Callable[[TriangleMesh], None]
) -> tuple[TriangleMesh, dict[str, Any]]:
    """Make a closed surface with fewer triangles. Returns the new surface, or the same surface if
    that fails; and facts about it as a dictionary.

    The library manifold3d simplifies the surface: it keeps some of the vertices and moves the
    surface by less than a fraction of the tolerance; half of the tolerance is left for all other
    errors. If triangles then pass through each other, vertices near them are moved. If they still
    do, or the check fails, a smaller fraction is tried.

    tolerance: a length.
    check: raises MeshingError if a surface fails its checks; it is called with surfaces whose
        triangles do not pass through each other.
    """
    facts = {"triangles_before_simplification": len(surface.faces)}
    solid = to_manifold(surface)
    for fraction in _SIMPLIFIED_WITHIN:
        simpler = from_manifold(without_short_edges(solid, fraction * tolerance))
        if not 0 < len(simpler.faces) < len(surface.faces):
            continue
        try:
            simpler = resolve_self_intersections(simpler, _MENDED_WITHIN * tolerance)
            check(simpler)
        except MeshingError:
            continue
        return simpler, facts
    return surface, facts


def to_trimesh(surface: TriangleMesh, facts: dict[str, Any], is_closed: bool) -> trimesh.Trimesh:
    """Convert a surface to a trimesh.Trimesh, with facts about it in its metadata. A mesh without a
    boundary is oriented so that its volume is positive.

    surface: a manifold (`check_manifold`).
    facts: further entries of the metadata.
    is_closed: whether the mesh must be closed.

    Raises:
        MeshingError: the mesh must be closed, but is not, or has no positive volume.
    """
    from harnack.meshing.closed_export import ClosedMesh

    mesh = ClosedMesh(surface.vertices, surface.faces, process=False, validate=False)
    pairs = half_edges(surface.faces)
    edges = Edges.of(pairs)
    boundary = pairs[edges.multiplicity[edges.edge_of_pair] == 1]
    if is_closed:
        volume = float(mesh.volume)
        if len(boundary) or not volume > 0:
            raise MeshingError(
                "the part did not close, or is inside out: choose a smaller `cell_size`"
            )
        facts = {**facts, "volume": volume}
    # Faces look to where the function is larger. If that is inside, they are turned over.
    elif not len(boundary) and mesh.volume < 0:
        mesh.invert()
    mesh.metadata["harnack"] = {
        # 0 if `facts` does not say otherwise.
        "proved": 0,
        "integrated": 0,
        **facts,
        "euler_characteristic": euler_characteristic(surface.faces, edges),
        "boundary": boundary,
        "creases": _crease_count(surface, edges),
    }
    return mesh


def _crease_count(surface: TriangleMesh, edges: Edges) -> int:
    """The number of edges whose two faces have normals more than 30 degrees apart.

    edges: the `Edges` of the `half_edges` of the surface's faces.
    """
    normals = unit_normals(surface.vertices[surface.faces])
    # Half edge h is one of face h % m.
    pairs = edges.paired_half_edges() % len(surface.faces)
    return int((row_dots(normals[pairs[:, 0]], normals[pairs[:, 1]]) < _CREASE_COSINE).sum())
