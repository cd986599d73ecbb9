"""Readers of files with meshes, point clouds, closed curves, blobs or molecules. The extension of
the file's name decides its format. Its contents decide as what it is read (a mesh, a cloud or
curves), unless the caller decides that by `read_as`. `contents` is the geometry that was found in a
file: vertices, faces, polylines. Results contain a summary: a text about the contents of the file,
and why they are read like that.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_geometry import FileFormatError, FileGeometry, FileLocation, read_bytes
from harnack.files.gltf import read_gltf
from harnack.files.molecules import MOLECULE_FILES, Atoms, parse_molecule
from harnack.files.pcd import read_pcd
from harnack.files.ply import read_ply
from harnack.files.point_tables import read_point_table
from harnack.files.scans import read_e57, read_las
from harnack.files.text_formats import (
    Metaballs,
    read_loops_text,
    read_metaballs,
    read_obj,
    read_off,
    read_stl,
)
from harnack.files.three_mf import read_3mf
from harnack.geometry.boundary_edges import (
    Edge,
    OpenChainError,
    boundary_edges,
    join_edges,
    singular_edges,
    singular_loops,
    weld_vertices,
)
from harnack.geometry.clouds import CloudError, as_cloud_points, as_unit_normals
from harnack.geometry.curves import CurveError, validate_loops
from harnack.geometry.flat_lists import next_in_lists
from harnack.geometry.mesh_edges import area_normals
from harnack.geometry.meshes import MeshError, without_zero_area_faces, zero_area_faces
from harnack.geometry.polygons import triangulate
from harnack.geometry.welding import Welded
from harnack.name_suggestions import did_you_mean

__all__ = [
    "GEOMETRY_SUFFIXES",
    "LoadedCloud",
    "LoadedCurves",
    "LoadedMesh",
    "LoadedPolygons",
    "ReadAs",
    "closed_curves_of",
    "read_geometry",
    "read_loops",
]

# Closed curves.

LocatedLoop = tuple[FloatArray, FileLocation]

_LOOP_READERS: dict[str, Callable[[Path, bytes], FileGeometry]] = {
    ".obj": read_obj,
    ".ply": read_ply,
}


def read_loops(path: str | os.PathLike[str], *, boundary: bool = False) -> list[FloatArray]:
    """Return the closed curves in an .obj, .ply or .loops file, as arrays (n, 3).

    .obj: every `f` face is a loop, every `l` polyline that ends at its first vertex is a loop, and
    all other `l` polylines are joined end to end. .ply: every face is a loop, edges are joined; a
    file with vertices only is one loop in their order. .loops: a loop on each line, x y z repeated.
    Where edges are joined, equal positions count as the same vertex.

    boundary: whether to return, in place of the faces, the boundary of the surface they form: the
        edges that do not cancel between neighboring faces. Equal positions count as the same
        vertex.

    Raises:
        FileFormatError: the file is unreadable, malformed or hostile; polylines are open;
            `validate_loops` rejects a loop; or the boundary of a closed surface is requested, which
            has none.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (*_LOOP_READERS, ".loops"):
        raise FileFormatError(f"{path}: curves are read from .obj, .ply and .loops files")
    data = read_bytes(path)
    if kind == ".loops":
        if boundary:
            raise FileFormatError(f"{path}: a .loops file has no faces to take the boundary of")
        return [_validated(loop, place) for loop, place in read_loops_text(path, data)]
    return closed_curves_of(_LOOP_READERS[kind](path, data), boundary=boundary)


def closed_curves_of(contents: FileGeometry, *, boundary: bool = False) -> list[FloatArray]:
    """Return the closed curves, arrays (n, 3), in the contents of an .obj or .ply file, by the
    rules of `read_loops`.

    contents: what was read from the file.
    boundary: whether to return the boundary of the surface that the faces form, not the faces.
    """
    placed = _boundary_loops(contents) if boundary else _all_loops(contents)
    return [_validated(loop, place) for loop, place in placed]


def _validated(loop: FloatArray, place: FileLocation) -> FloatArray:
    """Check that a loop (n, 3) is a valid closed curve, and return it. Raises a FileFormatError
    that names its place in the file if it is not."""
    try:
        return validate_loops(loop)[0]
    except CurveError as error:
        raise place.error(str(error)) from error


def _all_loops(contents: FileGeometry) -> list[LocatedLoop]:
    """Return the closed curves (n, 3) in the contents of a file, each with its place in the file.
    These are its faces and its polylines, joined end to end. If a .ply file has neither, its
    vertices are a single curve.

    Raises:
        FileFormatError: there are none, or polylines are open.
    """
    x = contents.vertices
    loops = [(x[corners], place) for corners, place in contents.faces]
    if len(contents.polylines):
        loops += _joined_polylines(contents)
    if not loops and contents.path.suffix.lower() == ".ply" and len(x):
        loops.append((x, FileLocation(contents.path)))
    if not loops:
        raise FileLocation(contents.path).error("it holds no faces or polylines to make curves of")
    return loops


def _joined_polylines(contents: FileGeometry) -> list[LocatedLoop]:
    """Return the closed curves (n, 3) that the polylines of a file form, each with its place in the
    file. A polyline that is closed is a curve; the edges of all other polylines are joined to
    curves.

    Raises:
        FileFormatError: an edge of length zero, or edges that do not form closed curves.
    """
    x, welded = contents.vertices, weld_vertices(contents.vertices)
    loops: list[LocatedLoop] = []
    open_edges: list[Edge] = []
    # For the number of a vertex, the place of a polyline that contains it.
    places: dict[int, FileLocation] = {}
    for corners, place in contents.polylines:
        # All vertices at the same position have the same number here.
        ids: list[int] = welded[corners].tolist()
        # Closed, with at least three vertices.
        if ids[0] == ids[-1] and len(ids) > 3:
            loops.append((x[ids[:-1]], place))
            continue
        for edge in itertools.pairwise(ids):
            if edge[0] == edge[1]:
                raise place.error(f"two vertices in a row are both {x[edge[0]].tolist()}")
            open_edges.append(edge)
        places.update(dict.fromkeys(ids, place))
    try:
        joined = join_edges(open_edges)
    except OpenChainError as error:
        raise places[error.vertex].error(_open_message(error, x[error.vertex])) from None
    return loops + [(x[ids], places[ids[0]]) for ids in joined]


def _open_message(error: OpenChainError, position: FloatArray) -> str:
    """Return the message of an error about edges that cannot be joined to closed curves, because at
    the vertex at `position` (3,) an edge ends, or more than two meet."""
    point = position.tolist()
    if error.count == 1:
        return (
            f"the polyline that ends at {point} is open: to close it, end it with its first "
            "vertex or add the missing segment"
        )
    return (
        f"{error.count} segments meet at {point}: two must meet at every vertex of a closed "
        "curve, or as many begin there as end"
    )


def _boundary_loops(contents: FileGeometry) -> list[LocatedLoop]:
    """Return the closed curves (n, 3) that form the boundary of the surface of a file's faces, each
    with its place in the file.

    Raises:
        FileFormatError: there are no faces, or their surface is closed.
    """
    place = FileLocation(contents.path)
    if not len(contents.faces):
        raise place.error("it has no faces to take the boundary of")
    welded = weld_vertices(contents.vertices)
    remaining = boundary_edges(
        welded[corners].tolist() for corners, _ in contents.faces if len(corners)
    )
    if not remaining:
        raise place.error("its faces form a closed surface, which has no boundary")
    return [(contents.vertices[np.array(ids)], place) for ids in join_edges(remaining)]


# All surfaces.

ReadAs: TypeAlias = Literal["winding", "dipole", "loops", "polygons"]

_READ_AS = ("winding", "dipole", "loops", "polygons")

_READERS: dict[str, Callable[[Path, bytes], FileGeometry]] = {
    ".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off,
    ".glb": read_gltf, ".gltf": read_gltf, ".3mf": read_3mf, ".xyz": read_point_table,
    ".xyzn": read_point_table, ".txt": read_point_table, ".csv": read_point_table,
    ".pts": read_point_table,
    ".pcd": read_pcd, ".las": read_las, ".laz": read_las, ".e57": read_e57,
}  # fmt: skip
_LOOP_FILES = (".obj", ".ply", ".loops")
GEOMETRY_SUFFIXES = (*_READERS, ".loops", ".blobs", *MOLECULE_FILES)


@dataclass(frozen=True, eq=False)
class LoadedMesh:
    """Triangles from a file, as `validate_mesh` returns them.

    summary: the contents of the file, and why they are read as a mesh.
    zero_area_faces: (k, 3) the faces of zero area, which are not among `faces`. They may close gaps
        that have no width.
    rounded: the number of corners that differed from others only by rounding, and were joined with
        them.
    """

    vertices: FloatArray
    faces: IntArray
    summary: str
    zero_area_faces: IntArray
    rounded: int


@dataclass(frozen=True, eq=False)
class LoadedCloud:
    """Points (n, 3) from a file, with unit normals (n, 3) and areas (n,) if the file has them.

    summary: the contents of the file, and why they are read as a point cloud.
    """

    points: FloatArray
    normals: FloatArray | None
    areas: FloatArray | None
    summary: str


@dataclass(frozen=True, eq=False)
class LoadedCurves:
    """Closed curves from a file, (n, 3) each. summary: the contents of the file, and why they are
    read as curves."""

    loops: tuple[FloatArray, ...]
    summary: str


@dataclass(frozen=True, eq=False)
class LoadedPolygons:
    """Polygons from a file, not triangulated: vertices (n, 3), and for each face the indices (k,)
    of its corners.

    summary: the contents of the file.
    """

    vertices: FloatArray
    faces: list[IntArray]
    summary: str


LoadedGeometry: TypeAlias = (
    LoadedMesh | LoadedCloud | LoadedCurves | LoadedPolygons | Metaballs | Atoms
)


def read_geometry(
    path: str | os.PathLike[str], read_as: ReadAs | None = None, *, ignore_normals: bool = False
) -> LoadedGeometry:
    """Read the surface, cloud, curves, blobs or molecule in a file: .obj, .ply, .stl, .off, .glb,
    .gltf, .3mf; clouds .las, .laz, .e57, .pcd, .xyz, .txt, .csv, .pts; .loops, .blobs; molecules
    .pdb, .ent, .cif, .mmcif.

    Faces make a mesh. But the polygons of an .obj or .ply file are curves if one of them has more
    than four corners and no two share an edge; polylines without faces are curves, too. Points
    alone make a cloud, with normals from fields that are named so, such as nx ny nz or normal_x
    normal_y normal_z (.ply, .pcd, .las, .laz, .csv), from the same number of `vn` as of `v` (.obj)
    or from columns 4 to 6 (.xyz). Colors of points are ignored. Polygons are triangulated, the
    nodes of a scene are transformed to their positions, and faces of zero area are left out.

    read_as: what to make of the contents. "winding": the faces, as a mesh. "dipole": the points; of
        a mesh the centers of its triangles, with their normals and areas. "loops": the result of
        `read_loops`; of a mesh its boundary: the edges at which its faces do not cancel, joined to
        curves. "polygons": the faces, not triangulated. None decides as above.
    ignore_normals: whether to leave out the normals of a point cloud, also wrong ones.

    Raises:
        FileFormatError: the file is unreadable, malformed, truncated or hostile, has another
            format, or contains nothing that can be read in this way.
        ModuleNotFoundError: a package that the format needs is not installed.
    """
    path = Path(path)
    kind = path.suffix.lower()
    if read_as not in (None, *_READ_AS):
        raise ValueError(
            f'read_as must be "winding", "dipole", "loops", "polygons" or None, not {read_as!r}'
            + did_you_mean(read_as, _READ_AS)
        )
    if kind not in GEOMETRY_SUFFIXES:
        raise FileFormatError(
            f"{path}: surfaces are read from {', '.join(GEOMETRY_SUFFIXES)} files"
        )
    # Very large numbers may overflow before the check that refuses them.
    with np.errstate(over="ignore", invalid="ignore"):
        return _read_geometry(path, kind, read_as, ignore_normals)


def _read_geometry(
    path: Path, kind: str, read_as: ReadAs | None, ignore_normals: bool
) -> LoadedGeometry:
    """Read a file of the format `kind` (an extension such as ".obj") in the way `read_as`. This is
    the work of `read_geometry` after both have been checked.

    ignore_normals: whether to leave out the normals of a point cloud.

    Raises:
        FileFormatError: the file cannot be read, or not in this way.
    """
    if kind == ".blobs":
        # (): these files can be read in one way only, and `read_as` must be None.
        _check_convertible(path, read_as, (), "blobs")
        return read_metaballs(path, read_bytes(path))
    if kind in MOLECULE_FILES:
        _check_convertible(path, read_as, (), "atoms")
        return parse_molecule(path, read_bytes(path))
    if kind == ".loops":
        _check_convertible(path, read_as, ("loops",), "curves")
        return _as_curves(read_loops(path), "curves, since the file lists nothing else")
    contents = _READERS[kind](path, read_bytes(path))
    try:
        # Faces come first, then polylines, then points.
        if (contents.faces.sizes >= 3).any():
            return _interpret_faces(contents, read_as)
        if len(contents.polylines):
            _check_convertible(path, read_as, ("loops",), "polylines")
            return _as_curves(closed_curves_of(contents), "polylines without faces: curves")
        if read_as == "loops" and kind == ".ply":
            why = "points joined in their order, as asked: a curve"
            return _as_curves(closed_curves_of(contents), why)
        _check_convertible(path, read_as, ("dipole",), "points")
        return _cloud(replace(contents, normals=None) if ignore_normals else contents)
    except (MeshError, CloudError) as error:
        raise FileLocation(path).error(str(error)) from error


def _check_convertible(
    path: Path, read_as: ReadAs | None, choices: tuple[str, ...], noun: str
) -> None:
    """Raise a FileFormatError unless the contents of a file can be read in the way `read_as`: it
    must be None or one of `choices`. noun: what the contents are, for the message."""
    needs = {
        "winding": "faces", "dipole": "points or faces", "loops": "polylines or faces",
        "polygons": "faces",
    }  # fmt: skip
    if read_as is not None and read_as not in choices:
        raise FileLocation(path).error(
            f'it holds {noun} only: it cannot be taken as "{read_as}", which needs {needs[read_as]}'
        )


def _interpret_faces(
    contents: FileGeometry, read_as: ReadAs | None
) -> LoadedMesh | LoadedCloud | LoadedCurves | LoadedPolygons:
    """Convert the faces in the contents of a file to the form that `read_as` asks for: a mesh, a
    cloud of points, closed curves or polygons. None means a mesh or curves, whichever the faces
    look like (`_looks_like_curves`)."""
    if read_as == "polygons":
        return _polygons(contents)
    # Only some formats are read as curves.
    can_be_loops = contents.path.suffix.lower() in _LOOP_FILES
    if read_as == "loops" and len(contents.polylines) and can_be_loops:
        return _as_curves(
            closed_curves_of(contents), "polylines and faces, taken as curves as asked"
        )
    if read_as in (None, "loops") and can_be_loops and _looks_like_curves(contents):
        return _as_curves(
            closed_curves_of(contents), "polygons of which no two share an edge: curves"
        )
    mesh = _mesh(contents)
    if read_as == "dipole":
        return _mesh_to_cloud(mesh)
    if read_as == "loops":
        return _mesh_to_boundary(contents.path, mesh)
    return mesh


def _polygons(contents: FileGeometry) -> LoadedPolygons:
    """Return the polygons of a file that have three corners or more, not triangulated."""
    sizes = contents.faces.sizes
    ends, indices = np.cumsum(sizes), np.flatnonzero(sizes >= 3)
    polygons = [contents.faces.corners[ends[k] - sizes[k] : ends[k]] for k in indices]
    min_corners, max_corners = min(map(len, polygons)), max(map(len, polygons))
    corners = f"{min_corners}" if min_corners == max_corners else f"{min_corners} to {max_corners}"
    summary = (
        f"{len(polygons):,} polygons of {corners} corners, each spanned by a surface, as asked"
    )
    return LoadedPolygons(contents.vertices, polygons, summary)


def _looks_like_curves(contents: FileGeometry) -> bool:
    """Return whether the polygons of a file are probably meant as curves and not as the faces of a
    mesh: some polygon has more than four corners, and no two polygons share an edge."""
    faces = contents.faces
    if faces.sizes.max() <= 4:
        return False
    welded = weld_vertices(contents.vertices)
    begin = welded[faces.corners]
    end = begin[next_in_lists(faces.sizes)]
    # A number for each edge, the same in both directions.
    keys = np.minimum(begin, end) * len(welded) + np.maximum(begin, end)
    # Polygons with fewer than three corners do not count.
    keys = keys[np.repeat(faces.sizes, faces.sizes) >= 3]
    return len(np.unique(keys)) == len(keys)


def _mesh(contents: FileGeometry) -> LoadedMesh:
    """Make a triangle mesh of a file's faces, with a summary of what was read.

    Raises:
        MeshError: the faces cancel each other.
    """
    triangles = triangulate(contents.vertices, contents.faces.corners, contents.faces.sizes)
    vertices, faces = without_zero_area_faces(contents.vertices, triangles)
    zero_area = triangles[zero_area_faces(vertices, triangles)]
    welded = Welded.of(vertices, faces)
    # The net faces are what remains if equal faces are added and opposite ones cancel. Singular
    # edges are those at which faces do not cancel.
    net_faces, singular = welded.net, welded.edges
    if not len(net_faces.faces):
        raise MeshError(f"its {len(faces):,} faces cancel each other: there is no surface")
    count_text = f"{len(faces):,} triangles"
    if len(singular) == 0:
        summary = f"{count_text} without singular edges: a closed mesh"
        center = vertices.mean(axis=0)
        # Six times the enclosed volume; negative if faces look inward.
        if np.linalg.det(vertices[faces] - center).sum() < 0.0:
            summary += ", whose faces look inward (the winding number inside is negative)"
    elif len(singular) >= len(faces):
        summary = f"{count_text}, {len(singular):,} singular edges: a triangle soup"
    else:
        summary = (
            f"{count_text}, {len(singular):,} singular edges: a mesh with holes or faces turned "
            "round"
        )
    if welded.rounded:
        # Each vertex gets the position of the vertex that it was joined with.
        vertices = vertices[welded.index]
        summary += f"; {welded.rounded:,} corners joined with others that were apart by rounding"
    if len(triangles) > len(faces):
        summary += f"; {len(triangles) - len(faces):,} of zero area left out"
    if len(faces) > len(net_faces.faces):
        summary += f"; {len(faces) - len(net_faces.faces):,} are added to or canceled by others"
    if len(contents.polylines):
        summary += "; polylines not used"
    return LoadedMesh(vertices, faces, summary, zero_area, welded.rounded)


def _mesh_to_cloud(mesh: LoadedMesh) -> LoadedCloud:
    """Return a cloud of points that stands for the triangles of a mesh: their centers, with their
    normals and areas."""
    corners = mesh.vertices[mesh.faces]
    area_normal = 0.5 * area_normals(corners)
    area = np.linalg.norm(area_normal, axis=1)
    summary = f"{len(area):,} triangles, each taken as a point with its normal and area, as asked"
    return LoadedCloud(corners.mean(axis=1), area_normal / area[:, None], area, summary)


def _mesh_to_boundary(path: Path, mesh: LoadedMesh) -> LoadedCurves:
    """Return the boundary of a mesh's faces as closed curves. path: of the file, for errors.

    Raises:
        FileFormatError: the faces have no boundary, or it is not a valid curve.
    """
    # The weight of an edge: how often it remains after opposite edges of faces have canceled.
    edges, weights = singular_edges(weld_vertices(mesh.vertices)[mesh.faces])
    if not len(edges):
        raise FileLocation(path).error(
            'its faces form a closed surface, which has no boundary: it cannot be taken as "loops"'
        )
    try:
        closed = singular_loops(edges, weights)
        loops = validate_loops([mesh.vertices[loop] for loop in closed])
    except CurveError as error:
        raise FileLocation(path).error(str(error)) from error
    noun = "loop" if len(loops) == 1 else "loops"
    summary = (
        f"{len(loops):,} {noun} of {sum(weights):,} edges: the boundary of the faces, as asked"
    )
    return LoadedCurves(loops, summary)


def _cloud(contents: FileGeometry) -> LoadedCloud:
    """Make a point cloud of the vertices of a file without faces, with their normals if it has
    them."""
    points = as_cloud_points(contents.vertices)
    count_text, notes = f"{len(points):,} points", "".join(f"; {note}" for note in contents.notes)
    if contents.normals is None:
        summary = f"{count_text} without faces, and no normals read: a point cloud{notes}"
        # (None: neither normals nor areas.)
        return LoadedCloud(points, None, None, summary)
    normals = as_unit_normals(contents.normals, len(points))
    summary = f"{count_text} with normals, no faces: a point cloud{notes}"
    # (None: no areas.)
    return LoadedCloud(points, normals, None, summary)


def _as_curves(loops: list[FloatArray], reason: str) -> LoadedCurves:
    """Collect closed curves `loops`, arrays (n, 3), in a `LoadedCurves`, with a summary that gives
    their number and the reason why the file is read as curves."""
    noun = "loop" if len(loops) == 1 else "loops"
    return LoadedCurves(
        tuple(loops), f"{len(loops):,} {noun} of {sum(map(len, loops)):,} vertices: {reason}"
    )
