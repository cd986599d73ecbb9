"""Closed meshes whose files are closed as well."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import trimesh

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import LocalError, MeshingError, check_apart, check_manifold
from harnack.meshing.edges import IntArray
from harnack.meshing.intersections import intersecting_faces
from harnack.meshing.lattice_surface import Surface
from harnack.meshing.printing.manifolds import manifold_of, surface_of

__all__ = ["ClosedMesh"]

# Readers take points for one that are nearer than 1e-8 in the file's unit (trimesh does).
_LEAST_STEP = 2.0**-26
# In these units larger numbers are beyond their integers.
_LARGEST = 2.0**36
# A part has to be so many steps long.
_MOST_COARSE = 1e4
# Where what is snapped is not right, triangles are left out within so many steps.
_SIMPLER = (4, 32)


class ClosedMesh(trimesh.Trimesh):
    """A mesh of which `export` writes a closed file, or raises a MeshingError.

    Files hold single precision, in which the ends of short edges are one point and slivers turn
    over. Vertices are rounded to a grid that single precision holds, edges without a length are
    contracted, and it is checked that what is left is closed and does not pass through itself. The
    mesh itself stays as it is, in double precision; and what is not closed is written as trimesh
    does.
    """

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> ClosedMesh:
        """A copy of any mesh."""
        made = trimesh.Trimesh.copy(mesh)
        made.__class__ = cls
        return cast("ClosedMesh", made)

    def copy(self, *args: Any, **options: Any) -> trimesh.Trimesh:
        made = super().copy(*args, **options)
        made.__class__ = type(self)
        return made

    def export(self, file_obj: Any = None, file_type: str | None = None, **options: Any) -> Any:
        """As of a trimesh.Trimesh. Metadata stays behind: its arrays fit in no file.

        Raises:
            MeshingError: the mesh is closed, and would not be in the file: parts that touch, or
                that are too small or too far from the origin for single precision.
        """
        written = trimesh.Trimesh.copy(self)
        written.metadata.clear()
        if self.units is not None:
            written.units = self.units
        if self.is_watertight:
            step = _step(np.asarray(self.vertices, np.float64))
            written = _snapped(written, step)
            name = file_type or str(getattr(file_obj, "name", file_obj))
            if name.lower().endswith(("obj", "off")):  # exact decimals of a multiple of 2^-k
                options.setdefault("digits", max(1, round(-math.log2(step))))
        return cast("Any", written).export(file_obj, file_type, **options)


def _step(x: FloatArray) -> float:
    """The distance between neighbors of the grid that points are rounded to: a power of two, of
    which single precision, with its 24 bits, holds all multiples as large as the points.

    Raises:
        MeshingError: it is too coarse for them.
    """
    largest, size = float(np.abs(x).max()), float(np.ptp(x, axis=0).max())
    step = max(math.ldexp(1.0, math.frexp(largest)[1] - 24), _LEAST_STEP)
    if size < _MOST_COARSE * step or not largest <= _LARGEST:
        raise MeshingError(
            f"the part is {size:.3g} long, at up to {largest:.3g} from the origin, where a file "
            f"tells points apart that are {step:.2g} from each other, up to {_LARGEST:.2g}: move "
            "it to the origin (apply_translation), or scale it (apply_scale), before it is written"
        )
    return step


def _snapped(mesh: trimesh.Trimesh, step: float) -> trimesh.Trimesh:
    """The mesh with vertices on the grid; where that is not right, with fewer triangles."""
    given = Surface(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))
    x, faces, kept = _contracted(given, step)
    try:
        _check(x, faces[kept], given)
    except LocalError as error:
        simpler = None if cast("Any", mesh.visual).defined else _simpler(given, step)
        if simpler is None:
            x, y, z = error.places[0]
            raise MeshingError(
                f"in a file, where points are {step:.2g} from each other at the least, parts touch "
                f"or pass through each other, such as near ({x:.4g}, {y:.4g}, {z:.4g}): move them "
                "apart or make them overlap, or choose another `tolerance`"
            ) from error
        return simpler
    mesh.vertices, mesh.faces = x, faces
    mesh.update_faces(kept)
    mesh.remove_unreferenced_vertices()
    return mesh


def _simpler(given: Surface, step: float) -> trimesh.Trimesh | None:
    """With slivers left out by manifold3d; None if that does not help either."""
    for steps in _SIMPLER:
        simpler = surface_of(manifold_of(given).simplify(steps * step))
        x, faces, kept = _contracted(simpler, step)
        if not kept.any():
            return None
        made = Surface.of(x, faces[kept])
        try:
            _check(made.vertices, made.faces, given)
        except LocalError:
            continue
        return trimesh.Trimesh(made.vertices, made.faces, process=False, validate=False)
    return None


def _contracted(surface: Surface, step: float) -> tuple[FloatArray, IntArray, BoolArray]:
    """Vertices on the grid, faces between the first of those that are one point, and which faces
    are left."""
    x = np.round(surface.vertices / step) * step
    _, first, place = np.unique(x, axis=0, return_index=True, return_inverse=True)
    faces = first[place.reshape(-1)][surface.faces]
    return x, faces, (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def _check(x: FloatArray, faces: IntArray, given: Surface) -> None:
    """Raise a LocalError where faces are not closed, or pass through each other while those that
    were given, such as the triangles of a mesh that was repaired, do not."""
    check_manifold(faces, x)
    try:
        check_apart(x, faces)
    except LocalError:
        if not len(intersecting_faces(given.vertices, given.faces)):
            raise
