"""Writes triangle meshes to files: STL, OBJ and PLY by trimesh, GLB, 3MF and USD by own writers.
Closed meshes stay closed in single precision, which files hold; normals, colors and the unit are
written where the format has them, and refused where it has not."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import check_writable, write_atomically
from harnack.files.glb_writer import write_glb
from harnack.files.mesh_contents import METERS, Colors, LengthUnit, MeshContents
from harnack.files.three_mf_writer import write_3mf
from harnack.files.usd_writer import import_usd, write_usd
from harnack.geometry.neighborhoods import kd_tree
from harnack.geometry.vertex_splitting import SplitVertices, crease_sides, normals_of_sides
from harnack.name_suggestions import did_you_mean

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "MESH_FILES",
    "check_mesh_path",
    "has_normals_unasked",
    "write_mesh",
    "write_plain_mesh",
]


@dataclass(frozen=True)
class _Format:
    """What a format of meshes has.

    default_unit: the unit of coordinates if none is asked for; None for a format without units.
    has_normals: whether it has normals at vertices.
    is_for_viewers: whether normals are written unasked, since viewers show facets without them.
    has_colors: whether it has colors.
    has_opacity: whether its colors have an opacity.
    """

    default_unit: LengthUnit | None = None
    has_normals: bool = True
    is_for_viewers: bool = False
    has_colors: bool = True
    has_opacity: bool = True

    @property
    def lacking(self) -> tuple[str, ...]:
        """The names of what the format does not have."""
        has = {
            "unit": self.default_unit is not None,
            "normals at vertices": self.has_normals,
            "colors": self.has_colors,
        }
        return tuple(name for name, is_there in has.items() if not is_there)


_USD = _Format("cm", is_for_viewers=True)
_FORMATS: Mapping[str, _Format] = MappingProxyType({
    ".stl": _Format(has_normals=False, has_colors=False),
    ".ply": _Format(),
    ".obj": _Format(has_opacity=False),
    ".glb": _Format("m", is_for_viewers=True),
    ".3mf": _Format("mm", has_normals=False),
    ".usda": _USD, ".usdc": _USD, ".usdz": _USD,
})  # fmt: skip

MESH_FILES = tuple(_FORMATS)
"""Endings of the files that meshes are written to."""


def check_mesh_path(
    path: str | os.PathLike[str],
    *,
    unit: LengthUnit | None = None,
    normals: bool = False,
    colors: bool = False,
) -> Path:
    """Return the path of a mesh file to be written. Everything that can be checked before the mesh
    is computed is checked here.

    unit: the unit that is to be written; None for none.
    normals, colors: whether the mesh has normals and colors that are to be written.

    Raises:
        ValueError: the extension is not that of a mesh format, or the format lacks what is to be
            written.
        ModuleNotFoundError: the format needs a package that is not installed.
        OSError: the file cannot be written there.
    """
    target = Path(path)
    kind = target.suffix.lower()
    if kind not in _FORMATS:
        raise ValueError(f"{target} has no extension of a mesh: name it {', '.join(MESH_FILES)}")
    if unit is not None and unit not in METERS:
        raise ValueError(
            f"unit must be {', '.join(METERS)} or None, not {unit!r}{did_you_mean(unit, METERS)}"
        )
    needed = {"unit": unit is not None, "normals at vertices": normals, "colors": colors}
    for noun, is_needed in needed.items():
        if is_needed and noun in _FORMATS[kind].lacking:
            others = [name for name, form in _FORMATS.items() if noun not in form.lacking]
            raise ValueError(
                f"{target}: a {kind} file has no {noun}; leave out the {noun.split()[0]}, or name "
                f"it {', '.join(others)}"
            )
    if _FORMATS[kind] is _USD:
        import_usd("Usd")
    check_writable(target)
    return target


def has_normals_unasked(path: Path) -> bool:
    """Return whether normals are written to a mesh file of this name by default."""
    return _FORMATS[path.suffix.lower()].is_for_viewers


def write_mesh(
    mesh: trimesh.Trimesh,
    path: str | os.PathLike[str],
    *,
    unit: LengthUnit | None = None,
    normals: bool | npt.ArrayLike | None = None,
) -> None:
    """Write a mesh in the format of the path's extension: .stl, .ply, .obj, .glb, .3mf, .usda,
    .usdc or .usdz. If writing fails, no file is left.

    A closed mesh is still closed after rounding to single precision, which files hold. In .ply,
    .obj and .glb files, vertices have copies at the same position where the mesh has creases and
    normals, or faces of several colors (.obj, .glb).

    mesh: the mesh, whose z axis is up. Its colors, of vertices or of faces, are written as well:
        to .glb and USD files as linear ones, which their standards say, to others as they are
        (sRGB). An .obj file has no opacity, which is left out with a warning. The color of a
        texture is written at vertices, with a warning.
    unit: what one unit of the coordinates is: "mm", "cm", "m" or "in". .3mf and USD files say so;
        coordinates of a .glb file are meters, and are converted. By default coordinates are
        written as they are, and the unit is that of the format: the millimeter of .3mf, the
        meter of .glb and the centimeter of USD files.
    normals: whether to write unit normals at vertices, by default to .glb and USD files: the mean
        of the faces' normals, on both sides of edges of more than 30 degrees separately. Or better
        ones, an array (n, 3), such as `field.gradient(mesh.vertices)`, of any length and of
        either sign; they are used where they are within 20 degrees of that mean.

    Up is z in USD files, which say so. The standard of .glb says that y is up: there the mesh is
    turned. Other formats say nothing.

    Raises:
        TypeError: `mesh` is no trimesh.Trimesh.
        ValueError: another extension; the format has no unit, no normals or no colors, and they
            are asked for or the mesh has them; normals of another shape.
        ModuleNotFoundError: the format needs a package that is not installed.
        MeshingError: the mesh is closed, and cannot be written as a closed one.
        OSError: the file cannot be written there.
    """
    vertex_colors, face_colors = _colors_of(mesh)
    if not len(mesh.faces):
        raise ValueError("the mesh has no faces: there is nothing to write")
    if not np.isfinite(np.asarray(mesh.vertices, np.float64)).all():
        raise ValueError("the mesh has coordinates that are not finite: it cannot be written")
    has_colors = vertex_colors is not None or face_colors is not None
    is_asked = normals is not None and normals is not False
    target = check_mesh_path(path, unit=unit, normals=is_asked, colors=has_colors)
    given = _given_normals(normals, len(mesh.vertices))
    from harnack.meshing.closed_export import ClosedMesh

    rounded, digits = ClosedMesh.of(mesh).rounded_for_file()
    if given is not None and not np.array_equal(rounded.vertices, mesh.vertices):
        # Rounding moves vertices by little, joins some and leaves out others.
        _, nearest = kd_tree(np.asarray(mesh.vertices)).query(np.asarray(rounded.vertices))
        given = given[nearest]
    write_plain_mesh(rounded, target, unit=unit, normals=normals, given=given, digits=digits)


def write_plain_mesh(
    mesh: trimesh.Trimesh,
    target: Path,
    *,
    unit: LengthUnit | None = None,
    normals: Any = None,
    given: FloatArray | None = None,
    digits: int | None = None,
) -> None:
    """Write a mesh as it is, whether or not it is closed in single precision. The parameters are
    those of `write_mesh`, which have been checked.

    given: (n, 3) the normals that were given, or None.
    digits: the decimals of coordinates in text; None for nine digits of the largest one.
    """
    kind = target.suffix.lower()
    form = _FORMATS[kind]
    has_normals = form.is_for_viewers if normals is None else normals is not False
    contents = _contents(mesh, has_normals, given)
    unit = unit or form.default_unit
    with write_atomically(target) as partial:
        if kind == ".glb":
            write_glb(partial, contents, METERS[unit or "m"])
        elif kind == ".3mf":
            write_3mf(partial, contents, unit or "mm")
        elif form is _USD:
            write_usd(partial, contents, METERS[unit or "cm"])
        else:
            _write_by_trimesh(partial, kind, contents, digits)


def _contents(mesh: trimesh.Trimesh, has_normals: bool, given: FloatArray | None) -> MeshContents:
    """Return what is to be written of a mesh. given: (n, 3) better normals than those of faces, or
    None.

    Raises:
        ValueError: the mesh has no faces, or numbers that are not finite.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not len(faces):
        raise ValueError("the mesh has no faces: there is nothing to write")
    if not np.isfinite(vertices).all():
        raise ValueError("the mesh has coordinates that are not finite: it cannot be written")
    vertex_colors, face_colors = _colors_of(mesh)
    sides, normals = SplitVertices(np.arange(len(vertices)), faces), None
    if has_normals:
        sides = SplitVertices.by_labels(faces, crease_sides(vertices, faces))
        normals = normals_of_sides(vertices, faces, sides, given)
        # Readers want vectors of length 1 also where faces without an area have no normal.
        normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return MeshContents(
        vertices, faces, bool(mesh.is_watertight), sides, normals, vertex_colors, face_colors
    )


def _colors_of(mesh: trimesh.Trimesh) -> tuple[Colors | None, Colors | None]:
    """Return the colors of the vertices (n, 4) and those of the faces (m, 4) of a mesh, of which at
    most one is not None. Those of a texture become colors of vertices, with a warning.

    Raises:
        TypeError: it is no mesh of trimesh.
    """
    import trimesh  # here, since it takes half a second

    if not isinstance(cast("Any", mesh), trimesh.Trimesh):
        hint = "; to_mesh() makes one of a scene" if hasattr(mesh, "to_mesh") else ""
        raise TypeError(f"a trimesh.Trimesh is written, not {type(mesh).__name__}{hint}")
    visual: Any = mesh.visual
    if visual.kind == "texture":
        return _material_colors(visual, len(mesh.vertices)), None
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors, np.uint8).reshape(-1, 4), None
    if visual.kind == "face":
        return None, np.asarray(visual.face_colors, np.uint8).reshape(-1, 4)
    return None, None


def _material_colors(visual: Any, count: int) -> Colors | None:
    """Return the colors of the vertices (count, 4) of a mesh with a material: those of its texture,
    with a warning, or its one color; None if it has neither.

    visual: a `TextureVisuals` of trimesh. By the glTF standard the base color of a material is a
        factor of its texture.
    """
    material = visual.material
    is_pbr = hasattr(material, "baseColorFactor")
    image = material.baseColorTexture if is_pbr else material.image
    factor = material.baseColorFactor if is_pbr else None
    if visual.uv is not None and image is not None:
        warnings.warn("the texture is written as colors of vertices", stacklevel=4)
        colors = np.asarray(visual.to_color().vertex_colors, np.float64).reshape(-1, 4)
        colors *= 1.0 if factor is None else np.asarray(material.main_color) / 255.0
        return np.rint(colors).astype(np.uint8)
    # The color of a simple material that was not set is that of trimesh's default.
    has_color = factor is not None if is_pbr else (material != type(material)())
    if not has_color:
        return None
    return np.tile(np.asarray(material.main_color, np.uint8), (count, 1))


def _given_normals(normals: bool | npt.ArrayLike | None, count: int) -> FloatArray | None:
    """Return the normals (count, 3) that were given; None if they are to be computed, or none are
    to be written. Raises a ValueError for another shape."""
    if normals is None or isinstance(normals, bool):
        return None
    try:
        array = np.asarray(normals, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (count, 3):
        raise ValueError(
            f"normals must be True, False, None or an array ({count}, 3), a row for each vertex, "
            f"not {f'one of shape {array.shape}' if array.size else repr(normals)[:60]}"
        )
    return array


def _write_by_trimesh(path: Path, kind: str, contents: MeshContents, digits: int | None) -> None:
    """Write a mesh to an .stl, .ply or .obj file.

    digits: the decimals of coordinates in an .obj file, or None.
    """
    import trimesh  # here, since it takes half a second

    options: dict[str, Any] = {}
    face_colors = None
    if kind == ".ply" and contents.face_colors is not None:
        # This format has colors of faces, so that vertices need not be split for them.
        sides, face_colors = contents.sides, contents.face_colors
        positions, faces = contents.vertices[sides.vertex], sides.faces
        normals, colors = contents.normals, None
    else:
        arrays = contents.at_vertices()
        positions, faces, normals = arrays.positions, arrays.faces, arrays.normals
        colors = arrays.colors
    if kind == ".obj":
        if digits is None:
            largest = float(np.abs(positions).max())
            digits = max(8, 8 - math.floor(math.log10(largest))) if largest else 8
        options = {"digits": digits, "include_normals": normals is not None, "header": "harnack"}
        if colors is not None and not _FORMATS[kind].has_opacity and (colors[:, 3] < 255).any():
            warnings.warn("an .obj file has no opacity: it is left out", stacklevel=4)
    elif kind == ".ply":
        options = {"vertex_normal": normals is not None}
    _trimesh_of(trimesh, positions, faces, normals, colors, face_colors).export(
        path, file_type=kind[1:], **options
    )


def _trimesh_of(
    trimesh: Any,
    positions: FloatArray,
    faces: IntArray,
    normals: FloatArray | None,
    vertex_colors: Colors | None,
    face_colors: Colors | None,
) -> Any:
    """Return a trimesh.Trimesh of arrays, as they are."""
    return trimesh.Trimesh(
        positions, faces, vertex_normals=normals, vertex_colors=vertex_colors,
        face_colors=face_colors, process=False, validate=False,
    )  # fmt: skip
