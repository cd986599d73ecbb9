"""Connected components of meshes, such as the largest one or the largest body with its cavities. A
component is a largest set of faces that are joined by common vertices. The signed volume of a
closed component is positive if its faces look outwards, and negative if it is turned inwards. The
winding number of a component around a point is then 1 or -1 inside of it, and 0 outside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    area_normals,
    row_dots,
)
from harnack.geometry.meshes import solid_angles
from harnack.geometry.neighborhoods import connected_groups
from harnack.meshing.meshing_errors import MeshingError
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = [
    "Shells",
    "component_facts",
    "drop_degenerate_components",
    "faces_to_flip",
    "largest_body",
    "largest_component",
    "winding_around",
]

# Components no thicker than this, relative to their coordinates, are rounding error.
_DEGENERATE_THICKNESS = 1e-11


def largest_component(surface: TriangleMesh) -> TriangleMesh:
    """The connected component of a surface that has the largest area."""
    part = _component_of_faces(surface)
    areas = np.bincount(part, np.linalg.norm(area_normals(surface.vertices[surface.faces]), axis=1))
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[part == areas.argmax()]
    )


def largest_body(surface: TriangleMesh) -> TriangleMesh:
    """The body with the largest volume that a closed surface bounds. A body consists of an outer
    shell and the shells of its cavities. A shell is a connected component of the surface; the
    shells of cavities are turned inwards, so that their volumes are negative. A cavity belongs to
    the smallest outer shell around it.

    Proof that this is the right outer shell. Shells are closed, connected, and do not meet; the
    surface bounds a set. Around a shell that is turned inwards there is a connected part of the
    set, and that part has an outer shell. Of all outer shells around the cavity, this is the
    innermost and so the smallest one: another shell in between would lie outside of the part, with
    nothing of the set between the two. Whether a point is inside a shell is decided by the shell's
    winding number there, which is an integer.

    Raises:
        MeshingError: a shell that is turned inwards lies in no outer shell.
    """
    shells = Shells.of(surface)
    body_volumes = shells.volumes.copy()
    outer_shell_of = np.arange(len(body_volumes))
    outer_shells = np.flatnonzero(shells.volumes > 0)
    # Smallest first.
    outer_shells = outer_shells[np.argsort(shells.volumes[outer_shells])]
    for cavity in np.flatnonzero(shells.volumes <= 0):
        shells_around = (
            shell for shell in outer_shells if shells.winding_number(shell, cavity) > 0.5
        )
        if (outer_shell := next(shells_around, None)) is None:
            raise MeshingError("a part of the mesh is inside out: choose a smaller `cell_size`")
        outer_shell_of[cavity] = outer_shell
        body_volumes[outer_shell] += shells.volumes[cavity]
    # -1 if there is no shell; then no face is chosen.
    largest = outer_shells[body_volumes[outer_shells].argmax()] if len(outer_shells) else -1
    return TriangleMesh.without_unused_vertices(
        surface.vertices, surface.faces[outer_shell_of[shells.component_of_face] == largest]
    )


def drop_degenerate_components(surface: TriangleMesh) -> TriangleMesh:
    """Remove the connected components of a closed surface that are only rounding error, such as
    what remains of a solid minus itself. A component is removed if its volume is so small, compared
    with its area, that it is about as thin as rounding errors of the coordinates."""
    x, faces = surface.vertices, surface.faces
    if not len(faces):
        return surface
    part = _component_of_faces(surface)
    count = np.bincount(part)
    corner = x[faces]
    # Each component relative to its own center, against rounding errors.
    center = (
        np.stack([np.bincount(part, c) for c in corner.mean(axis=1).T], axis=1) / count[:, None]
    )
    corner = corner - center[part][:, None]
    normal = area_normals(corner)
    # Six times the volume and twice the area.
    volume = np.abs(np.bincount(part, (corner[:, 0] * normal).sum(axis=1)))
    area = np.bincount(part, np.linalg.norm(normal, axis=1))
    # The mean thickness is 2 V / A. With 6 V and 2 A at hand: 2 (6 V) / 3 / (2 A).
    is_thin = 2 * volume <= 3 * _DEGENERATE_THICKNESS * float(np.abs(x).max()) * area
    if not is_thin.any():
        return surface
    rest = faces[~is_thin[part]]
    return TriangleMesh.without_unused_vertices(x, rest) if len(rest) else TriangleMesh(x[:0], rest)


def component_facts(surface: TriangleMesh) -> list[dict[str, Any]]:
    """Facts about the connected components of a closed surface: a dictionary for each component,
    the largest first. It has the entries `faces`, the number of faces; `volume`, which is negative
    for a cavity; and `center`, the center of the bounding box as a list of three numbers."""
    shells, facts = Shells.of(surface), list[dict[str, Any]]()
    counts = np.bincount(shells.component_of_face)
    for k in np.argsort(-np.abs(shells.volumes), kind="stable"):
        center = 0.5 * (shells.lower[k] + shells.upper[k])
        volume = float(shells.volumes[k])
        facts.append({"faces": int(counts[k]), "volume": volume, "center": center.tolist()})
    return facts


def faces_to_flip(surface: TriangleMesh) -> npt.NDArray[np.bool_]:
    """(m,) mask of the faces of a closed surface that must be turned over so that no component is
    inside out. They belong to the components that have a negative volume and lie in no other
    component; a component of negative volume within another one is a cavity."""
    shells = Shells.of(surface)
    is_inside_out = (shells.volumes < 0) & (shells.nesting_depths() == 0)
    return is_inside_out[shells.component_of_face]


@dataclass(frozen=True)
class Shells:
    """The connected components of a closed surface with m faces, called shells. A shell has a
    positive volume if its faces look outwards, and a negative volume if it is turned inwards, as
    around a cavity. Its winding number around a point is 1 or -1 inside of it, and 0 outside.
    `lower` and `upper` are the corners of the shells' boxes, and `corners` those of the faces.

    component_of_face: (m,) the index of the component of each face.
    volumes: (k,) the signed volumes of the components.
    lower, upper: (k, 3) the corners of their bounding boxes.
    corners: (m, 3, 3) the corners of the faces.
    """

    component_of_face: IntArray
    volumes: FloatArray
    lower: FloatArray
    upper: FloatArray
    corners: FloatArray

    @classmethod
    def of(cls, surface: TriangleMesh) -> Shells:
        """Find the connected components of a closed surface, their volumes and their boxes."""
        # The components are numbered from 0.
        component = np.unique(_component_of_faces(surface), return_inverse=True)[1]
        corners = surface.vertices[surface.faces]
        # Relative to the center, so that rounding errors are relative to the size of the mesh.
        offset = corners[:, 0] - surface.vertices[surface.faces].mean(axis=(0, 1))
        volumes = (
            np.bincount(component, row_dots(area_normals(surface.vertices[surface.faces]), offset))
            / 6
        )
        lower, upper = np.full((len(volumes), 3), np.inf), np.full((len(volumes), 3), -np.inf)
        np.minimum.at(lower, component, corners.min(axis=1))
        np.maximum.at(upper, component, corners.max(axis=1))
        return cls(component, volumes, lower, upper, corners)

    def winding_number(self, component: Any, part: Any) -> float:
        """The winding number of the component with index `component` around a point of the
        component with index `part`. The point is the center of one of its faces."""
        point = self.corners[np.argmax(self.component_of_face == part)].mean(axis=0)
        return winding_around(self.corners[self.component_of_face == component], point)

    def nesting_depths(self) -> IntArray:
        """(k,) for each component, the winding number of all other components together around a
        point of it. If no two components meet, it is more than 0 for components inside the material
        of other components, and 0 for outermost ones."""
        depth = np.zeros(len(self.volumes), np.int64)
        for k in range(len(depth)) if len(depth) > 1 else ():
            # The center of the component's first face.
            point = self.corners[np.argmax(self.component_of_face == k)].mean(axis=0)
            # A component winds only around points in its box.
            in_box = ((self.lower < point) & (point < self.upper)).all(axis=1)
            in_box[k] = False
            candidates = np.flatnonzero(in_box)
            depth[k] = round(sum(self.winding_number(j, k) for j in candidates))
        return depth

    def bound(self) -> npt.NDArray[np.bool_]:
        """(m,) mask of the faces that bound the set of points around which all components together
        wind at least once. It is right only if no two components meet.

        Proof. The winding number just outside of a component is its nesting depth (the winding
        number of the other components). Just inside it is larger by one or, for a component that is
        turned inwards, smaller by one. So the faces of a component bound the set if it is turned
        outwards and its nesting depth is 0, or turned inwards and its nesting depth is 1.
        """
        is_boundary = self.nesting_depths() == np.where(self.volumes > 0, 0, 1)
        return is_boundary[self.component_of_face]


def _component_of_faces(surface: TriangleMesh) -> IntArray:
    """(m,) for each face, the index of its connected component. Faces are connected by common
    vertices."""
    faces = surface.faces
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    return connected_groups(pairs, len(surface.vertices))[faces[:, 0]]


def winding_around(corner: FloatArray, point: FloatArray) -> float:
    """The winding number, around a point (3,), of triangles with corners (m, 3, 3)."""
    return float(solid_angles(corner, point).sum()) / (4 * math.pi)
