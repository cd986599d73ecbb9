"""Export of closed meshes to files in which they stay closed. Files hold single precision. So
vertices are rounded to a grid for export: the points whose coordinates are multiples of a power of
two, its spacing."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import trimesh

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import has_distinct_corners, unique_with_inverse
from harnack.meshing.checks import check_manifold
from harnack.meshing.closed_mesh import from_manifold, to_manifold, without_short_edges
from harnack.meshing.meshing_errors import (
    LocalizedMeshingError,
    MeshingError,
    SelfIntersectionError,
)
from harnack.meshing.self_intersection import intersecting_faces
from harnack.meshing.self_intersection_repair import resolve_self_intersections
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["ClosedMesh"]

# Readers such as trimesh merge points that are nearer than 1e-8 in the file's unit.
_MIN_STEP = 2.0**-26
# Coordinates may be at most this large: divided by that distance, larger ones are beyond the
# integers of readers.
_LARGEST = 2.0**36
# The size of a mesh has to be at least this many grid spacings.
_MIN_STEPS_ACROSS = 1e4
# If the rounded mesh does not pass its checks, the mesh is simplified, moving it by up to this many
# grid spacings; the numbers are tried in turn.
_SIMPLIFY_STEPS = (4, 32)
# Where triangles cross, vertices are moved by up to this many grid spacings.
_REPAIR_STEPS = 32


class ClosedMesh(trimesh.Trimesh):
    """A trimesh.Trimesh whose `export` keeps a closed mesh closed: it writes a closed file, or
    raises a MeshingError if it cannot. A mesh that is not closed is written as trimesh writes it.
    The mesh in memory stays in double precision, unchanged.

    Files hold single precision, in which the ends of short edges coincide and slivers (thin
    triangles) flip. So vertices are rounded to a grid that single precision holds, and edges
    without a length are contracted. Then it is checked that the result is closed and does not
    intersect itself. The mesh's repr is that of a trimesh.Trimesh, since it may be open.
    """

    def __repr__(self) -> str:
        return super().__repr__().replace(type(self).__name__, "Trimesh")

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> ClosedMesh:
        """A copy of any mesh as a ClosedMesh."""
        copied = trimesh.Trimesh.copy(mesh)
        copied.__class__ = cls
        return cast("ClosedMesh", copied)

    def copy(self, *args: Any, **options: Any) -> trimesh.Trimesh:
        """A copy of the mesh, as a ClosedMesh."""
        copied = super().copy(*args, **options)
        copied.__class__ = type(self)
        return copied

    def export(self, file_obj: Any = None, file_type: str | None = None, **options: Any) -> Any:
        """Write the mesh to a file, with the parameters and the result of trimesh.Trimesh.export.
        Metadata is not written: no file format holds its arrays.

        Raises:
            MeshingError: the mesh is closed, but would not be in the file: components touch, or the
                mesh is too small or too far from the origin for single precision.
        """
        written, digits = self.rounded_for_file()
        name = file_type or str(getattr(file_obj, "name", file_obj))
        # Text files need as many decimals as 2^-k has to be exact.
        if digits is not None and name.lower().endswith(("obj", "off")):
            options.setdefault("digits", digits)
        return cast("Any", written).export(file_obj, file_type, **options)

    def rounded_for_file(self) -> tuple[trimesh.Trimesh, int | None]:
        """The mesh without its metadata, rounded to what files hold if it is closed; and how many
        decimals its coordinates then have, None if it is not closed.

        Raises:
            MeshingError: as for `export`.
        """
        written = trimesh.Trimesh.copy(self)
        written.metadata.clear()
        if self.units is not None:
            written.units = self.units
        if not self.is_watertight:
            _check_precision(np.asarray(self.vertices, np.float64))
            return written, None
        grid_spacing = _grid_spacing(np.asarray(self.vertices, np.float64))
        return _quantize(written, grid_spacing), max(1, round(-math.log2(grid_spacing)))


def _grid_spacing(x: FloatArray) -> float:
    """The spacing of the grid to which vertices x (n, 3) are rounded for a file. It is a power of
    two, and so large that single precision, which has 24 bits, holds all multiples of it up to the
    largest coordinate.

    Raises:
        MeshingError: the grid is too coarse for the size of the mesh, or coordinates are too large.
    """
    return _check_precision(x, _MIN_STEP)


def _check_precision(x: FloatArray, min_step: float = 0.0) -> float:
    """The spacing of single precision at the largest coordinate of vertices x (n, 3), a power of
    two, or `min_step` if that is larger.

    Raises:
        MeshingError: the spacing is too coarse for the size of the mesh, or coordinates are too
            large for files.
    """
    largest = float(np.abs(x).max(initial=0.0))
    size = float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    # (`frexp` gives the exponent second.)
    step = max(math.ldexp(1.0, math.frexp(largest)[1] - 24), min_step)
    # `not <=` also refuses coordinates that are not numbers.
    if size < _MIN_STEPS_ACROSS * step or not largest <= _LARGEST:
        raise MeshingError(
            f"the part is {size:.3g} long, at up to {largest:.3g} from the origin, where a file "
            f"tells points apart that are {step:.2g} from each other, up to {_LARGEST:.2g}: move "
            "it to the origin (apply_translation), or scale it (apply_scale), before it is written"
        )
    return step


def _quantize(mesh: trimesh.Trimesh, step: float) -> trimesh.Trimesh:
    """Round the vertices of a closed mesh to the grid of spacing `step`, and return the rounded
    mesh. If triangles cross after rounding, vertices near them are moved; if the mesh still does
    not pass its checks, it is simplified first. A mesh with colors or textures is only rounded.

    Raises:
        MeshingError: nothing makes the rounded mesh closed and free of intersections.
    """
    original = TriangleMesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64))
    x, faces, is_kept = _merge_on_grid(original, step)
    is_plain = not cast("Any", mesh.visual).defined
    try:
        mended = _resolve_after_rounding(
            TriangleMesh(x, faces[is_kept]), original, _REPAIR_STEPS * step if is_plain else 0.0
        )
    except LocalizedMeshingError as error:
        mended = _simplify_until_valid(original, step) if is_plain else None
        if mended is None:
            x, y, z = error.locations[0]
            raise MeshingError(
                f"in a file, where points are {step:.2g} from each other at the least, parts touch "
                f"or pass through each other, such as near ({x:.4g}, {y:.4g}, {z:.4g}): move them "
                "apart or make them overlap, or choose another `tolerance`"
            ) from error
    # Otherwise the rounded mesh can be used as it is.
    if mended is not None:
        return trimesh.Trimesh(mended.vertices, mended.faces, process=False, validate=False)
    mesh.vertices, mesh.faces = x, faces
    mesh.update_faces(is_kept)
    mesh.remove_unreferenced_vertices()
    return mesh


def _simplify_until_valid(original: TriangleMesh, step: float) -> TriangleMesh | None:
    """Simplify a closed mesh by manifold3d and round it to the grid of spacing `step`, so that no
    triangles cross. Two strengths of simplification are tried; None if both fail, or if no triangle
    is left."""
    for steps in _SIMPLIFY_STEPS:
        simpler = from_manifold(without_short_edges(to_manifold(original), steps * step))
        x, faces, is_kept = _merge_on_grid(simpler, step)
        if not is_kept.any():
            return None
        rounded = TriangleMesh.without_unused_vertices(x, faces[is_kept])
        try:
            return _resolve_after_rounding(rounded, original, _REPAIR_STEPS * step) or rounded
        except LocalizedMeshingError:
            continue
    return None


def _merge_on_grid(surface: TriangleMesh, step: float) -> tuple[FloatArray, IntArray, BoolArray]:
    """Round the vertices of a surface to the grid of spacing `step`, and join vertices that
    coincide.

    Returns the rounded vertices (n, 3), coinciding ones included; the faces (m, 3), in which the
    first of the vertices at each point stands for all of them; and a mask (m,) of the faces that
    still have three different corners.
    """
    grid = np.round(surface.vertices / step)
    x = grid * step
    # group[i]: a number that vertices have in common if their coordinates so far, axis by axis, are
    # equal.
    group = np.zeros(len(x), np.int64)
    for column in (grid - grid.min(axis=0)).astype(np.int64).T:
        _, group, _, _ = unique_with_inverse(group * (int(column.max()) + 1) + column)
    # Of repeated indices the last assignment stays, so in reverse order the first vertex.
    first = np.empty(len(x), np.int64)
    first[group[::-1]] = np.arange(len(x))[::-1]
    faces = first[group][surface.faces]
    return x, faces, has_distinct_corners(faces)


def _resolve_after_rounding(
    rounded: TriangleMesh, original: TriangleMesh, length: float
) -> TriangleMesh | None:
    """Move vertices of a rounded surface near triangles that cross, by no more than `length`, until
    no triangles cross; and return the result. None if the rounded surface can be used as it is: no
    triangles cross; or they cannot be separated, but triangles of the original surface cross too,
    as in some repaired meshes.

    Raises:
        LocalizedMeshingError: the rounded surface is not closed; or triangles still cross, although
            no triangles of the original surface do.
    """
    check_manifold(rounded.faces, rounded.vertices)
    try:
        apart = resolve_self_intersections(rounded, length)
    except SelfIntersectionError:
        if not len(intersecting_faces(original.vertices, original.faces)):
            raise
        return None
    # The same object: nothing was moved.
    if apart is rounded:
        return None
    check_manifold(apart.faces, apart.vertices)
    return apart
