"""Makes a field from a surface file. A field is a function whose level set is drawn; the kind of
field depends on what the file holds: a mesh, a cloud of points, curves, polygons, metaballs or a
molecule. The file also decides which of its axes points up, and how the surface is drawn by
default."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

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

FILE_OPTIONS = ("read_as", "take_boundary", "normals", "smoothing", "up", "origin")
"""The keywords of `field_from_file`."""

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

_Y_UP_FORMATS = (".glb", ".gltf")
_Y_UP_BY_CONVENTION = (".obj",)
# Where `read_loops` itself takes the boundary of faces.
_LOOP_FILES = (".obj", ".ply", ".loops")
# Farther from the origin than this many times its size, a surface is moved if origin is "auto": of
# coordinates in single precision three digits or less are left for the surface.
_FAR = 1e3


@dataclass(frozen=True, eq=False)
class FieldFromFile:
    """The field that was made from a surface file, and how to draw it.

    field: the field, in coordinates in which z points up.
    summary: on one line, what the file holds, and which axis of it points up and why.
    origin: the point of the file, in its own coordinates, that is the origin of the field's.
    show, material: the values of these options of `render` that are used by default. Surfaces of
        meshes and clouds are "shaded" with a single ray per pixel, as each ray takes many times as
        long as a ray of a curve's surface.
    """

    field: Field
    summary: str
    origin: tuple[float, float, float]
    show: str
    material: str


@dataclass(frozen=True, eq=False)
class _Placement:
    """How points of a file are moved to the field's coordinates: `origin` (3,) is subtracted, then
    the matrix `rotation` (3, 3) turns them."""

    rotation: FloatArray
    origin: FloatArray

    def points(self, x: FloatArray) -> FloatArray:
        """Return points (n, 3) of the file in the field's coordinates."""
        return (x - self.origin) @ self.rotation.T

    def directions(self, x: FloatArray) -> FloatArray:
        """Return directions (n, 3) in the file in the field's coordinates."""
        return x @ self.rotation.T


def field_from_file(
    path: str | os.PathLike[str],
    *,
    read_as: ReadAs | None = None,
    take_boundary: bool = False,
    normals: Literal["estimate"] | None = None,
    smoothing: float | Literal["auto"] | None = None,
    up: Axis | None = None,
    origin: Literal["auto", "center"] | Sequence[float] | None = None,
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
    origin: the point (3,) of the file, in its own coordinates, that becomes the origin of the
        field's. Scans often have the coordinates of maps, of which single precision, and so
        pictures, leave nothing. "center" is the middle of the file's box, rounded to a number that
        is easily written down; "auto" is the same for what is farther than 1,000 times its size
        from the file's origin, and moves nothing else. By default nothing is moved.

    Raises:
        FileFormatError: the file cannot be read by `read_geometry`; or a point cloud has no
            normals; or the field does not accept the data.
        ModuleNotFoundError: a package that the format needs is not installed.
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
    _check_origin(origin)
    surface = _read(path, read_as, take_boundary, normals is not None)
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
    moved_to = _origin_of(_points_of(surface), origin)
    placement = _Placement(rotation_to_z_up(axis), np.array(moved_to))
    try:
        field = _field(surface, normals, smoothing or 0.0, placement)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error
    show, material = ("path", "two-tone") if is_curve else ("shaded", "eggshell")
    summary = f"{surface.summary}; {axis} is up, {why}"
    if any(moved_to):
        summary += f"; its point ({', '.join(f'{c:.15g}' for c in moved_to)}) is the origin"
    return FieldFromFile(field, summary, moved_to, show, material)


def _check_origin(origin: object) -> None:
    """Raise a ValueError unless `origin` is None, "auto", "center" or three finite numbers."""
    if origin is None or (isinstance(origin, str) and origin in ("auto", "center")):
        return
    try:
        point = np.asarray(origin, np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(
            f'origin must be "auto", "center", three finite numbers or None, not {origin!r:.60}'
        )


def _points_of(surface: LoadedGeometry) -> FloatArray:
    """Return points (n, 3) between which the geometry of a file lies."""
    if isinstance(surface, LoadedCurves):
        return np.concatenate(surface.loops)
    if isinstance(surface, Metaballs):
        return surface.centers
    if isinstance(surface, Atoms):
        return surface.positions
    if isinstance(surface, LoadedCloud):
        return surface.points
    return surface.vertices


def _origin_of(
    points: FloatArray, origin: Literal["auto", "center"] | Sequence[float] | None
) -> tuple[float, float, float]:
    """Return the point that becomes the origin, as `field_from_file` explains it. points: (n, 3)
    the points of the file."""
    if origin is None:
        return (0.0, 0.0, 0.0)
    if not isinstance(origin, str):
        x, y, z = (float(coordinate) for coordinate in origin)
        return (x, y, z)
    lower, upper = points.min(axis=0), points.max(axis=0)
    size, center = float((upper - lower).max()), 0.5 * (lower + upper)
    if not size or (origin == "auto" and float(np.abs(center).max()) <= _FAR * size):
        return (0.0, 0.0, 0.0)
    # Rounded to the power of ten below the size.
    step = 10.0 ** math.floor(math.log10(size))
    x, y, z = (float(f"{step * round(c / step):.15g}") for c in center.tolist())
    return (x, y, z)


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


def _read(
    path: Path, read_as: ReadAs | None, boundary: bool, ignore_normals: bool
) -> LoadedGeometry:
    """Return the geometry in a file: the curves that bound its faces if `boundary` is True;
    otherwise what `read_as` says or, if that is None, what `read_geometry` finds. ignore_normals:
    whether to leave out the normals of a point cloud."""
    # For these formats `read_loops` finds the boundary itself.
    if boundary and path.suffix.lower() in _LOOP_FILES:
        loops = tuple(read_loops(path, boundary=True))
        noun = "loop" if len(loops) == 1 else "loops"
        count = f"{len(loops):,} {noun} of {sum(map(len, loops)):,} vertices"
        return LoadedCurves(loops, f"{count}: the boundary of the faces, as asked")
    return read_geometry(path, "loops" if boundary else read_as, ignore_normals=ignore_normals)


def _field(
    surface: LoadedGeometry,
    normals: str | None,
    smoothing: float | Literal["auto"],
    placement: _Placement,
) -> Field:
    """Return the field of some geometry, moved and turned.

    surface: the geometry that was read from a file.
    normals: "estimate" to estimate the normals of a point cloud, otherwise None.
    smoothing: the smoothing of a point cloud, a length or "auto".
    placement: how its points are moved.

    Raises:
        ValueError: a point cloud without normals, or data that the field does not accept.
    """
    if isinstance(surface, LoadedMesh):
        return WindingNumber(placement.points(surface.vertices), surface.faces)
    if isinstance(surface, LoadedCurves):
        return SolidAngle([placement.points(loop) for loop in surface.loops])
    if isinstance(surface, LoadedPolygons):
        return PolygonMesh(placement.points(surface.vertices), surface.faces)
    if isinstance(surface, Metaballs):
        centers = placement.points(surface.centers)
        return Blobs(centers, surface.radii, surface.weights, groups=surface.groups)
    if isinstance(surface, Atoms):
        return Molecule(replace(surface, positions=placement.points(surface.positions)))
    # What remains is a cloud of points.
    points = placement.points(surface.points)
    if normals == "estimate":
        return DipolePotential(points, normals, surface.areas, smoothing=smoothing)
    if surface.normals is None:
        raise ValueError(
            f"{surface.summary}. Its normals are missing, which say where outside is: add them to "
            'the file, or let them be estimated with normals="estimate"'
        )
    given = placement.directions(surface.normals)
    return DipolePotential(points, given, surface.areas, smoothing=smoothing)
