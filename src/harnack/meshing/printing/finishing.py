"""The last steps of a mesh: fewer triangles, what is said of it."""

from __future__ import annotations

import math
import operator
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray
from harnack.backend.numbers import real
from harnack.meshing.checks import (
    MeshingError,
    euler_characteristic,
)
from harnack.meshing.edges import Edges, IntArray, boundary_edges, directed_edges, dots, lengths
from harnack.meshing.lattice_surface import Surface
from harnack.meshing.printing.manifolds import manifold_of, surface_of
from harnack.meshing.samples import LevelFunction

if TYPE_CHECKING:
    from collections.abc import Callable

    import trimesh


__all__ = ["check_options", "finished", "normals_of", "simplified"]

# The cosine of the angle between normals from which on an edge is a crease.
_CREASE = math.cos(math.radians(30))
# What simplification may move a surface by, as parts of the tolerance.
_SIMPLER = (0.4, 0.2, 0.1)


def check_options(tolerance: Any, spacing: Any, thickness: Any, seed: Any, most: Any) -> None:
    """Raise ValueError or TypeError for numbers out of range."""
    if not 0 < real(tolerance, "tolerance") < 0.5:
        raise ValueError(
            f"tolerance is a part of the size: it must lie in (0, 0.5), not {tolerance}"
        )
    for name, value in (("spacing", spacing), ("thickness", thickness)):
        if value is not None and not 0 < real(value, name) < math.inf:
            raise ValueError(f"{name} must be a positive length, not {value!r}")
    if operator.index(seed) < 0:
        raise ValueError(f"seed must not be negative, not {seed}")
    if operator.index(most) < 1:
        raise ValueError(f"max_triangles must be positive, not {most}")


def normals_of(function: LevelFunction, surface: Surface) -> FloatArray:
    """Unit normals (n, 3) at vertices: the slope of the field, and where it has none, as at the
    curve that a surface ends on, the mean of the faces there by area."""
    corner = surface.vertices[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    mean = np.zeros_like(surface.vertices)
    for k in range(3):
        np.add.at(mean, surface.faces[:, k], normal)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    slope = function.at(surface.vertices).gradient
    steep: FloatArray = np.linalg.norm(slope, axis=1)
    slope = slope / np.maximum(steep, 1e-300)[:, None]
    # Beside the curve slopes turn within a triangle.
    good = np.isfinite(steep) & (steep > 0) & ((slope * mean).sum(axis=1) > 0.7)
    if function.period is not None:
        good[np.unique(boundary_edges(surface.faces))] = False
    chosen: FloatArray = np.where(good[:, None], slope, mean)
    return chosen


def simplified(
    surface: Surface, tolerance: float, check: Callable[[Surface], None]
) -> tuple[Surface, dict[str, Any]]:
    """A closed surface with fewer triangles, or as it is where that cannot be.

    manifold3d's simplification: vertices are a part of those before. It moves the surface by less
    than a part of the tolerance, half of which is for all else, and what does not pass the check is
    done with a smaller part.
    """
    facts = {"triangles_before_simplification": len(surface.faces)}
    solid = manifold_of(surface)
    for part in _SIMPLER:
        made = surface_of(solid.simplify(part * tolerance))
        if not 0 < len(made.faces) < len(surface.faces):
            continue
        try:
            check(made)
        except MeshingError:
            continue
        return made, facts
    return surface, facts


def finished(surface: Surface, facts: dict[str, Any], is_closed: bool) -> trimesh.Trimesh:
    """The mesh, which is a manifold (`check_manifold`), with what is known of it in its metadata.
    Without a rim it is turned so that its volume is positive.

    Raises:
        MeshingError: it ought to be closed and to have a positive volume, and is not.
    """
    from harnack.meshing.printing.closed_mesh import ClosedMesh  # here: trimesh takes a second

    made = ClosedMesh(surface.vertices, surface.faces, process=False, validate=False)
    boundary = boundary_edges(surface.faces)
    if is_closed:
        volume = float(made.volume)
        if len(boundary) or not volume > 0:
            raise MeshingError(
                "the part did not close, or is inside out: choose a smaller `spacing`"
            )
        facts = {**facts, "volume": volume}
    elif not len(boundary) and made.volume < 0:  # f is larger inside
        made.invert()
    made.metadata["harnack"] = {
        "proved": 0,
        "integrated": 0,
        **facts,
        "euler_characteristic": euler_characteristic(surface.faces),
        "boundary": boundary,
        "creases": _creases(surface),
    }
    return made


def _creases(surface: Surface) -> int:
    """How many edges two faces meet at whose normals are more than 30 degrees apart."""
    normals = _unit_normals(surface.vertices, surface.faces)
    edges = Edges.of(directed_edges(surface.faces))
    order = np.argsort(edges.index, kind="stable")
    pairs = order[(edges.uses == 2)[edges.index[order]]].reshape(-1, 2) % len(surface.faces)
    return int((dots(normals[pairs[:, 0]], normals[pairs[:, 1]]) < _CREASE).sum())


def _unit_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(m, 3) of faces; 0 for those without an area."""
    corner = vertices[faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return cross / np.maximum(lengths(cross), 1e-300)[:, None]
