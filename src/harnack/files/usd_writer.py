"""Writing .usda, .usdc and .usdz files of Universal Scene Description, by Pixar's own library."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from harnack.files.mesh_contents import MeshContents, linear_colors
from harnack.optional_packages import import_optional

__all__ = ["import_usd", "write_usd"]


def import_usd(module: str) -> Any:
    """Import a module of usd-core, such as "Usd". Raises a ModuleNotFoundError if it is not
    installed."""
    return import_optional(
        f"pxr.{module}", "USD files are written by usd-core: pip install 'harnack[usd]'"
    )


def write_usd(path: Path, contents: MeshContents, meters: float) -> None:
    """Write a mesh as a .usda, .usdc or .usdz file: a prim "/mesh" that is not subdivided, in a
    stage in which z is up. Vertices are shared, also at creases: normals there belong to corners.

    path: the file to write.
    meters: how many meters the unit of the mesh is long, which the stage says.

    Raises:
        ModuleNotFoundError: usd-core is not installed.
    """
    utilities, asset = import_usd("UsdUtils"), import_usd("Sdf").AssetPath
    suffix = path.suffix.lower()
    # The library takes some characters in names of files as its own, so that it gets simple ones.
    with tempfile.TemporaryDirectory(prefix="harnack-") as folder:
        plain = Path(folder) / f"mesh{'.usdc' if suffix == '.usdz' else suffix}"
        _write_stage(plain, contents, meters)
        if suffix == ".usdz":
            package = plain.with_suffix(".usdz")
            if not utilities.CreateNewUsdzPackage(asset(str(plain)), str(package)):
                raise OSError(f"usd-core could not pack {path}")
            plain = package
        shutil.copyfile(plain, path)


def _write_stage(path: Path, contents: MeshContents, meters: float) -> None:
    """Write the stage to a file that does not exist yet."""
    usd, geometry, types = import_usd("Usd"), import_usd("UsdGeom"), import_usd("Vt")
    stage = usd.Stage.CreateNew(str(path))
    geometry.SetStageUpAxis(stage, geometry.Tokens.z)
    geometry.SetStageMetersPerUnit(stage, meters)
    mesh = geometry.Mesh.Define(stage, "/mesh")
    stage.SetDefaultPrim(mesh.GetPrim())

    def vectors(rows: Any) -> Any:
        """Return vectors (n, 3) as an array of the library."""
        return types.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))

    def integers(values: Any) -> Any:
        """Return integers (n,) as an array of the library."""
        return types.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))

    mesh.CreatePointsAttr(vectors(contents.vertices))
    mesh.CreateFaceVertexCountsAttr(integers(np.full(len(contents.faces), 3)))
    mesh.CreateFaceVertexIndicesAttr(integers(contents.faces.ravel()))
    ends = contents.vertices.min(axis=0), contents.vertices.max(axis=0)
    mesh.CreateExtentAttr(vectors(np.stack(ends)))
    # By default a mesh is the cage of a subdivision surface.
    mesh.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
    mesh.CreateDoubleSidedAttr(not contents.is_closed)
    if contents.normals is not None:
        is_split = len(contents.sides.vertex) != len(contents.vertices)
        of_corners = contents.normals[contents.sides.faces.ravel()]
        mesh.CreateNormalsAttr(vectors(of_corners if is_split else contents.normals))
        tokens = geometry.Tokens
        mesh.SetNormalsInterpolation(tokens.faceVarying if is_split else tokens.vertex)
    of_vertices = contents.face_colors is None
    colors = contents.vertex_colors if of_vertices else contents.face_colors
    if colors is not None:
        interpolation = geometry.Tokens.vertex if of_vertices else geometry.Tokens.uniform
        values = linear_colors(colors)
        mesh.CreateDisplayColorPrimvar(interpolation).Set(vectors(values[:, :3]))
        if (colors[:, 3] < 255).any():
            opacity = types.FloatArray.FromNumpy(np.ascontiguousarray(values[:, 3], np.float32))
            mesh.CreateDisplayOpacityPrimvar(interpolation).Set(opacity)
    stage.GetRootLayer().Save()
