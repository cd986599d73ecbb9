"""Makes a field from a surface file. A field is a function whose level set is drawn; the kind of
field depends on what the file holds: a mesh, a cloud of points, curves, polygons, metaballs or a
molecule. The file also decides which of its axes points up, and how the surface is drawn by
default."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from harnack.backend import FloatArray
from harnack.fields import Field
from harnack.fields.blobs.blobs import Blobs, Molecule
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.polygon_mesh import PolygonMesh
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.files import (
    Atoms,
    FileFormatError,
    LoadedCloud,
    LoadedCurves,
    LoadedMesh,
    LoadedPolygons,
    Metaballs,
    read_geometry,
    read_loops,
)
from harnack.files.geometry_files import LoadedGeometry, ReadAs
from harnack.rendering.framing import UP_AXES, rotation_to_z_up

__all__ = ["FILE_OPTIONS", "UP_AXES", "Axis", "FieldFromFile", "field_from_file"]

FILE_OPTIONS = ("read_as", "take_boundary", "normals", "smoothing", "up")
"""The keywords of `field_from_file`."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

_Y_UP_FORMATS = (".glb", ".gltf")
_Y_UP_BY_CONVENTION = (".obj",)
# Where `read_loops` itself takes the boundary of faces.
_LOOP_FILES = (".obj", ".ply", ".loops")


@dataclass(frozen=True, eq=False)
class FieldFromFile:
    """The field that was made from a surface file, and how to draw it.

    field: the field, in coordinates in which z points up.
    summary: on one line, what the file holds, and which axis of it points up and why.
    show, material: the values of these options of `render` that are used by default. Surfaces of
        meshes and clouds are "shaded" with a single ray per pixel, as each ray takes many times as
        long as a ray of a curve's surface.
    """

    field: Field
    summary: str
    show: str
    material: str


def field_from_file(
    path: str | os.PathLike[str],
    *,
    read_as: ReadAs | None = None,
    take_boundary: bool = False,
    normals: Literal["estimate"] | None = None,
    smoothing: float | Literal["auto"] | None = None,
    up: Axis | None = None,
) -> FieldFromFile:
    """Make a field from a surface file. A mesh becomes a `WindingNumber`, a cloud of points with
    normals a `DipolePotential`, and closed curves a `SolidAngle`. Polygons become a `PolygonMesh`
    (on request), and metaballs and molecules become `Blobs`.

    path: the file.
    read_as: "winding", "dipole", "loops" or "polygons": what the file is taken to hold. None lets
        `read_geometry` decide.
    take_boundary: whether to use the curves that bound the faces instead of the faces.
    normals: "estimate" estimates the normals of a point cloud, and ignores normals in the file.
    smoothing: for noisy point clouds, the length over which noise is evened out, in the file's
        unit; "auto" measures the noise (see `DipolePotential`).
    up: the axis of the file that is turned to z. By default y for glTF, whose standard says so, and
        for meshes and clouds of .obj files, most of which have y up; z for all other files.

    Raises:
        FileFormatError: the file cannot be read by `read_geometry`; or a point cloud has no
            normals; or the field does not accept the data.
        ValueError: options that contradict each other or the file.
    """
    # Check the options as far as possible before the file is read.
    path = Path(path)
    if take_boundary and read_as not in (None, "loops"):
        raise ValueError(
            f'take_boundary=True takes faces as curves, which contradicts read_as="{read_as}"'
        )
    if normals not in (None, "estimate"):
        raise ValueError(f'normals must be "estimate" or None, not {normals!r}')
    if up not in (None, *UP_AXES):
        raise ValueError(f"up must be one of {', '.join(UP_AXES)} or None, not {up!r}")
    surface = _read(path, read_as, take_boundary)
    if normals is not None and not isinstance(surface, LoadedCloud):
        raise ValueError(
            f"{path}: normals are estimated for point clouds, and this is something else: "
            f'{surface.summary}; leave out normals="estimate", or take its points with '
            'read_as="dipole"'
        )
    # Check the options against what the file holds.
    is_curve = isinstance(surface, LoadedCurves)
    if smoothing is not None and not isinstance(surface, LoadedCloud):
        raise ValueError(
            f"{path}: smoothing is for point clouds, and this is something else: {surface.summary}"
        )
    axis, why = (up, "as asked") if up is not None else _default_up_axis(path, is_curve=is_curve)
    try:
        field = _field(surface, normals, smoothing or 0.0, rotation_to_z_up(axis))
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error
    show, material = ("path", "two-tone") if is_curve else ("shaded", "eggshell")
    return FieldFromFile(field, f"{surface.summary}; {axis} is up, {why}", show, material)


def _default_up_axis(path: Path, *, is_curve: bool) -> tuple[Axis, str]:
    """Return the axis that points up in a file, as far as the suffix of its name tells, and the
    reason in words.

    is_curve: whether the file holds curves.
    """
    kind = path.suffix.lower()
    if kind in _Y_UP_FORMATS:
        return "y", "the standard of the format"
    if kind in _Y_UP_BY_CONVENTION and not is_curve:
        return "y", "as in most .obj files"
    return "z", "for want of a standard (the option up turns it)"


def _read(path: Path, read_as: ReadAs | None, boundary: bool) -> LoadedGeometry:
    """Return the geometry in a file: the curves that bound its faces if `boundary` is True;
    otherwise what `read_as` says or, if that is None, what `read_geometry` finds."""
    # For these formats `read_loops` finds the boundary itself.
    if boundary and path.suffix.lower() in _LOOP_FILES:
        loops = tuple(read_loops(path, boundary=True))
        noun = "loop" if len(loops) == 1 else "loops"
        count = f"{len(loops):,} {noun} of {sum(map(len, loops)):,} vertices"
        return LoadedCurves(loops, f"{count}: the boundary of the faces, as asked")
    return read_geometry(path, "loops" if boundary else read_as)


def _field(
    surface: LoadedGeometry,
    normals: str | None,
    smoothing: float | Literal["auto"],
    rotation: FloatArray,
) -> Field:
    """Return the field of some geometry, rotated by a matrix.

    surface: the geometry that was read from a file.
    normals: "estimate" to estimate the normals of a point cloud, otherwise None.
    smoothing: the smoothing of a point cloud, a length or "auto".
    rotation: (3, 3) the matrix.

    Raises:
        ValueError: a point cloud without normals, or data that the field does not accept.
    """
    if isinstance(surface, LoadedMesh):
        return WindingNumber(surface.vertices @ rotation.T, surface.faces)
    if isinstance(surface, LoadedCurves):
        return SolidAngle([loop @ rotation.T for loop in surface.loops])
    if isinstance(surface, LoadedPolygons):
        return PolygonMesh(surface.vertices @ rotation.T, surface.faces)
    if isinstance(surface, Metaballs):
        centers = surface.centers @ rotation.T
        return Blobs(centers, surface.radii, surface.weights, groups=surface.groups)
    if isinstance(surface, Atoms):
        return Molecule(replace(surface, positions=surface.positions @ rotation.T))
    # What remains is a cloud of points.
    points = surface.points @ rotation.T
    if normals == "estimate":
        return DipolePotential(points, normals, surface.areas, smoothing=smoothing)
    if surface.normals is None:
        raise ValueError(
            f"{surface.summary}. Its normals are missing, which say where outside is: add them to "
            'the file, or let them be estimated with normals="estimate"'
        )
    given = surface.normals @ rotation.T
    return DipolePotential(points, given, surface.areas, smoothing=smoothing)
