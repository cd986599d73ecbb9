"""Checks of a triangle mesh that is to be 3D printed: which problems a slicer would report, and
where they are. A "problem" (`PrintProblem`) is one kind of defect with all of its locations; a
"component" is a connected part of the mesh. Lengths are in the mesh's unit, which is taken to be
the millimeter.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.backend.validation import as_positive
from harnack.fields.solids.mesh_solid import MeshSolid
from harnack.files.geometry_files import LoadedMesh, read_geometry
from harnack.geometry import MeshError, validate_mesh, zero_area_faces
from harnack.geometry.mesh_edges import Edges, half_edges, has_distinct_corners, longest_edges
from harnack.geometry.meshes import mesh_arrays
from harnack.geometry.welding import Welded
from harnack.meshing.checks import nonmanifold_vertices
from harnack.meshing.components import Shells
from harnack.meshing.meshing_errors import point_text
from harnack.meshing.self_intersection import intersecting_faces, touching_pairs
from harnack.meshing.thickness import wall_thickness
from harnack.meshing.triangle_mesh import TriangleMesh

__all__ = ["PrintCheck", "PrintProblem", "check_print"]

# A part is tiny if it is no longer than this, relative to the whole.
_TINY_SHARE = 0.01
# Sizes in millimeters beyond which another unit is likely.
_SMALLEST, _LARGEST = 1.0, 2000.0
_INCH = 25.4
# A part may be thinner than the smallest thickness, or larger than the build volume, by this
# relative error: files hold single precision, and thickness is measured with that accuracy.
_ROUNDING = 1e-6
# Faces longer than this, in smallest thicknesses, may hide thin places beside their centers.
_COARSE = 5.0
# In the texts of messages, {one|several} has the words for a single problem and for several.
_WORDS = re.compile(r"\{([^{}|]*)\|([^{}|]*)\}")


@dataclass(frozen=True, eq=False)
class PrintProblem:
    """One kind of defect of a mesh that is to be printed, and where it occurs.

    kind: the name of the problem, such as "open edges".
    count: how often it occurs. A problem with count 0 does not occur, and is not reported.
    locations: (k, 3) where it occurs, or some of these places.
    message: the problem in a sentence.
    is_error: True for an error, False for a hint."""

    kind: str
    count: int
    locations: FloatArray
    message: str
    is_error: bool = True


@dataclass(frozen=True)
class PrintCheck:
    """The result of checking a mesh that is to be printed.

    problems: errors first, then hints.
    size: (x, y, z) the edge lengths of the bounding box, in the mesh's unit.
    volume: the enclosed volume, in that unit cubed; None if the mesh is not closed.
    triangles: the number of triangles.
    parts: the number of connected components; faces that share a vertex are connected."""

    problems: tuple[PrintProblem, ...]
    size: tuple[float, float, float]
    volume: float | None
    triangles: int
    parts: int

    @property
    def is_printable(self) -> bool:
        """Whether there are no errors; there may be hints."""
        return not _has_errors(self.problems)

    def as_dict(self, most_places: int = 10) -> dict[str, Any]:
        """The result as a dictionary of numbers and texts, which JSON can hold. most_places: the
        largest number of locations of each problem."""
        return {
            "fine": self.is_printable,
            "size": list(self.size),
            "volume": self.volume,
            "triangles": self.triangles,
            "parts": self.parts,
            "problems": [
                {
                    "kind": problem.kind,
                    "count": problem.count,
                    "fatal": problem.is_error,
                    "message": problem.message,
                    "where": problem.locations[:most_places].tolist(),
                }
                for problem in self.problems
            ],
        }


def check_print(
    part: Any, *, min_thickness: float | None = None, build_volume: Any = None
) -> PrintCheck:
    """Find what a slicer would complain about in a mesh, and where it is.

    Errors are:

    - open edges, edges of more than two faces, and neighbors that do not agree on their two sides;
    - parts that are inside out, or in the material of other parts;
    - vertices where sheets touch, and corners and edges that lie on other faces;
    - triangles that pass through each other or lie on each other (decided exactly), and duplicate
      faces;
    - walls thinner than `min_thickness`, and a size that does not fit into `build_volume`. Edges
      with an acute angle count as thin, too; the message says how many places lie there, and they
      come last in `locations`.

    Hints are: corners that only rounding separates from others (they count as one), faces without
    an area, several parts, tiny parts, cavities without a way out (for powder and resin), a size
    that looks like inches or meters, and, if thickness is measured, faces so large that a thin
    place beside their centers may be missed.

    part: a trimesh.Trimesh, (vertices, faces), or the name of a file. Vertices at the same place
        count as one.
    min_thickness: the smallest allowed thickness, a length (see `thickness`); None to skip that
        check.
    build_volume: (x, y, z), the largest size, into which the part may be turned by a right angle
        about z; None to skip that check.

    Raises:
        MeshError: the object is no mesh.
        FileFormatError: the file cannot be read.
        ValueError: the thickness is no positive length, or the build volume not three of them.
    """
    if min_thickness is not None:
        min_thickness = as_positive(min_thickness, "min_thickness")
    if build_volume is not None and np.shape(build_volume) != (3,):
        raise ValueError(f"build_volume must be (x, y, z), three lengths, not {build_volume!r}")
    checked_build_volume = (
        None
        if build_volume is None
        else [as_positive(item, "build_volume") for item in build_volume]
    )
    x, faces, rounding_hint = _mesh_of(part)
    # Later checks assume what earlier ones found: whether the mesh is closed, and whether faces
    # cross.
    problems = _topology(x, faces)
    is_closed = not _has_errors(problems)
    shells = Shells.of(TriangleMesh(x, faces))
    crossings, touching = _contacts(x, faces, shells, is_closed)
    is_free_of_crossings = is_closed and not crossings.count
    problems += [*_component_problems(shells, is_closed, is_free_of_crossings), crossings, touching]
    if min_thickness is not None:
        problems += [
            _thin_walls(x, faces, min_thickness, not _has_errors(problems)),
            _coarse_faces(x, faces, min_thickness),
        ]
    box_lower, box_upper = x[faces].min(axis=(0, 1)), x[faces].max(axis=(0, 1))
    size = cast("tuple[float, float, float]", tuple((box_upper - box_lower).tolist()))
    problems += _size_problems(size, checked_build_volume)
    problems.append(rounding_hint)
    # Errors first.
    reported = sorted((item for item in problems if item.count), key=lambda item: not item.is_error)
    volume = float(shells.volumes.sum()) if is_closed else None
    return PrintCheck(tuple(reported), size, volume, len(faces), len(shells.volumes))


def _has_errors(problems: Sequence[PrintProblem]) -> bool:
    """Whether there is a problem that is an error, not only a hint."""
    return any(problem.is_error and problem.count for problem in problems)


def _mesh_of(part: Any) -> tuple[FloatArray, IntArray, PrintProblem]:
    """Read a mesh, and join its vertices that are at the same place or differ only by rounding.

    part: a trimesh.Trimesh, (vertices, faces), or the name of a file.

    Returns:
        The vertices (n, 3) of the mesh; the faces (m, 3) between joined vertices, including faces
        without an area; and a problem (a hint) that counts the vertices that differed by rounding.

    Raises:
        TypeError: `part` is none of these.
        MeshError: the file has no faces, or `validate_mesh` rejects the mesh.
    """
    if isinstance(part, str | os.PathLike):
        # As for a winding number, that is, as a triangle mesh.
        read = read_geometry(cast("Any", part), "winding")
        if not isinstance(read, LoadedMesh):
            raise MeshError(f"{part}: it holds no faces, so there is nothing to print")
        x, faces, rounded_count = (
            read.vertices,
            np.concatenate([read.faces, read.zero_area_faces]),
            read.rounded,
        )
    else:
        x, faces = validate_mesh(*mesh_arrays(part), allow_zero_area=True)
        rounded_count = 0
    # Vertices that differ by rounding get the index of one of them.
    welded = Welded.of(x, faces)
    count = rounded_count + welded.rounded
    text = f"{count:,} {'corner is' if count == 1 else 'corners are'} apart from others by rounding"
    rounding_hint = PrintProblem(
        "corners apart by rounding", count, np.zeros((0, 3)), text, is_error=False
    )
    return x, welded.index[faces], rounding_hint


def _problem(kind: str, locations: FloatArray, text: str, *, is_fatal: bool = True) -> PrintProblem:
    """Make a problem that occurs at k locations (k, 3), with its message.

    kind: the name of the problem.
    text: a format for the message. {} stands for k; {one|several} for the word before the bar if k
        is 1, and for the word after it otherwise.
    is_fatal: whether the problem is an error, and not only a hint."""
    count = len(locations)
    first_location = (
        "" if not count else f", {'' if count == 1 else 'such as '}at {point_text(locations[0])}"
    )
    text = _WORDS.sub(lambda match: match[1 if count == 1 else 2], text)
    return PrintProblem(
        kind, count, locations, text.format(f"{count:,}") + first_location, is_fatal
    )


def _topology(x: FloatArray, faces: IntArray) -> list[PrintProblem]:
    """The problems of how faces are connected: open edges, edges of more than two faces, neighbors
    of opposite orientation, duplicate faces, vertices where sheets touch, and faces without an
    area.

    x, faces: (n, 3), (m, 3) the mesh. Faces with two equal corners count only as faces without an
        area."""
    zero_area = zero_area_faces(x, faces)
    proper_faces = faces[has_distinct_corners(faces)]
    pairs = half_edges(proper_faces)
    edges = Edges.of(pairs)
    middle = x[edges.vertices].mean(axis=1)
    _, first, use_count = np.unique(
        np.sort(proper_faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    touching_vertices = nonmanifold_vertices(proper_faces)
    at_overused_edges = np.unique(edges.vertices[edges.multiplicity > 2])
    return [
        _problem(
            "open edges", middle[edges.multiplicity == 1], "{} {edge has|edges have} one face alone"
        ),
        _problem(
            "edges of many faces",
            middle[edges.multiplicity > 2],
            "{} {edge has|edges have} more than two faces",
        ),
        _problem(
            "sides that disagree",
            middle[edges.run_twice_alike(pairs)],
            "at {} {edge|edges} neighboring faces do not agree on what is inside",
        ),
        _problem(
            "duplicate faces",
            x[proper_faces[first[use_count > 1]]].mean(axis=1),
            "{} {face is|faces are} there twice",
        ),
        _problem(
            "touching vertices",
            x[np.setdiff1d(touching_vertices, at_overused_edges)],
            "at {} {vertex|vertices} parts touch in a point",
        ),
        _problem(
            "faces without area",
            x[faces[zero_area]].mean(axis=1),
            "{} {face has|faces have} no area",
            is_fatal=False,
        ),
    ]


def _component_problems(shells: Shells, is_closed: bool, is_clear: bool) -> list[PrintProblem]:
    """The problems of the connected components of a mesh: components that are inside out, or lie in
    the material of other components; several separate bodies; tiny bodies; and cavities.

    shells: the components.
    is_closed: whether the mesh is closed. If it is not, only tiny and several bodies are reported.
    is_clear: whether the mesh is closed and no faces pass through each other. Then a component lies
        inside another one either as a whole or not at all."""
    volumes, no_component = shells.volumes, np.zeros(len(shells.volumes), np.bool_)
    middle = 0.5 * (shells.lower + shells.upper)
    length = (shells.upper - shells.lower).max(axis=1)
    depth = shells.nesting_depths() if is_closed else np.zeros(len(volumes), np.int64)
    # A cavity is a component that is inside out within another one.
    is_hollow = (volumes < 0) & (depth > 0)
    is_nested = (volumes > 0) & (depth > 0) & is_clear
    inside_out = (volumes < 0) & ~is_hollow if is_closed else no_component
    is_tiny = (length < _TINY_SHARE * length.max()) & ~is_hollow
    body_centers = middle[~is_hollow]
    return [
        _problem(
            "inside out", middle[inside_out], "{} {part is|parts are} inside out: faces look inward"
        ),
        _problem(
            "nested parts",
            middle[is_nested],
            "{} {part is|parts are} inside the material of others: what is inside counts twice, "
            "and slicers may take it for a cavity",
        ),
        _problem(
            "cavities",
            middle[is_hollow],
            "{} {cavity has|cavities have} no way out, for powder or resin",
            is_fatal=False,
        ),
        _problem("tiny parts", middle[is_tiny], "{} {part is|parts are} tiny", is_fatal=False),
        _problem(
            "loose parts",
            body_centers if len(body_centers) > 1 else body_centers[:0],
            "there are {} parts that are not joined by vertices",
            is_fatal=False,
        ),
    ]


def _contacts(
    x: FloatArray, faces: IntArray, shells: Shells, is_closed: bool
) -> tuple[PrintProblem, PrintProblem]:
    """Two problems of a mesh: faces that pass through other faces or lie on them; and faces that
    only touch other faces.

    If a component has faces without an area, its contacts with itself are not reported: such faces
    close gaps of width zero, where other faces touch each other necessarily.

    x, faces: (n, 3), (m, 3) the mesh. shells: its connected components.
    is_closed: whether the mesh is closed; then the message advises how to unite parts that overlap.
    """
    is_flat = np.zeros(len(faces), np.bool_)
    is_flat[zero_area_faces(x, faces)] = True
    is_without_flat_faces = np.isin(
        shells.component_of_face, shells.component_of_face[is_flat], invert=True
    )
    rows = np.flatnonzero(has_distinct_corners(faces))
    # Duplicates are reported separately.
    rows = rows[np.unique(np.sort(faces[rows], axis=1), axis=0, return_index=True)[1]]
    crossing = intersecting_faces(x, faces[rows])
    advice = "; hk.mesh(hk.solid(part)) makes one of parts that overlap" if is_closed else ""
    crossing_problem = _problem(
        "crossing faces",
        x[faces[rows[crossing]]].mean(axis=1),
        "{} {triangle passes through or lies|triangles pass through or lie} on others",
    )
    rows = np.delete(rows, crossing)
    rows = rows[~is_flat[rows]]
    pairs, contacts = touching_pairs(x, faces[rows])
    first, second = rows[pairs.T]
    is_contact = is_without_flat_faces[first] | (
        shells.component_of_face[first] != shells.component_of_face[second]
    )
    touching_problem = _problem(
        "touching faces",
        np.unique(contacts[is_contact], axis=0),
        "at {} {place|places} a corner or an edge lies on a face that it is not part of: let parts "
        "overlap, or move them apart",
    )
    return dataclasses.replace(
        crossing_problem, message=crossing_problem.message + advice
    ), touching_problem


def _thin_walls(x: FloatArray, faces: IntArray, wall: float, is_solid: bool) -> PrintProblem:
    """The problem of places where the part is thinner than `wall`, a length.

    is_solid: whether the mesh bounds a solid. If it does not, the problem says instead that
        thickness could not be measured."""
    if not is_solid:
        # The name differs from that of walls that were measured to be thin.
        message = "how thick walls are is not known before the rest is mended"
        return PrintProblem("walls not measured", 1, np.zeros((0, 3)), message)
    thickness = wall_thickness(MeshSolid(x, faces))
    is_thin = thickness.is_thinner(wall - _ROUNDING * float(np.ptp(x, axis=0).max()))
    is_acute = is_thin & thickness.is_at_acute_edge()
    suffix = f"; the thinnest is {thickness.thinnest:.3g}"
    if is_acute.any():
        is_elsewhere = is_thin & ~is_acute
        which = f"{is_acute.sum():,}" if is_elsewhere.any() else "all"
        suffix += f"; {which} at edges with an acute angle, where any part is thin"
        if is_elsewhere.any():
            suffix += f", the thinnest elsewhere is {thickness.values[is_elsewhere].min():.3g}"
    text = f"at {{}} {{triangle|triangles}} the part is thinner than {wall:g}{suffix}"
    # Walls that are thin by themselves come first, then the thinnest.
    rows = np.flatnonzero(is_thin)
    rows = rows[np.lexsort((thickness.values[rows], is_acute[rows]))]
    return _problem("thin walls", x[faces[rows]].mean(axis=1), text)


def _coarse_faces(x: FloatArray, faces: IntArray, wall: float) -> PrintProblem:
    """The problem (a hint) of faces longer than five times the smallest allowed thickness `wall`, a
    length: thickness is measured at the centers of faces, so thin places beside these may be
    missed."""
    corner = x[faces]
    centers = corner[longest_edges(corner) > _COARSE * wall].mean(axis=1)
    text = f"{{}} {{triangle is|triangles are}} longer than {_COARSE:g} walls, and thickness is "
    text += "measured at centers"
    return _problem("walls measured coarsely", centers, text, is_fatal=False)


def _size_problems(size: tuple[float, float, float], bed: list[float] | None) -> list[PrintProblem]:
    """The problems of the size of a part: it is so small or large that its unit may be another one
    (inches or meters); and it does not fit into the printer.

    size: (x, y, z) the edge lengths of the part's bounding box.
    bed: [x, y, z] the edge lengths of the space into which it has to fit, possibly turned by a
        right angle about z; None if any size fits."""
    longest, no_locations = max(size), np.zeros((0, 3))
    text = " x ".join(f"{length:.4g}" for length in size)
    problems: list[PrintProblem] = []
    if longest < _SMALLEST or longest > _LARGEST:
        message = f"it is {text} mm, if files are in millimeters"
        if longest < _SMALLEST:
            message += f"; in meters {longest * 1000:.4g}, in inches {longest * _INCH:.4g} mm long"
        problems.append(PrintProblem("unit", 1, no_locations, message, is_error=False))
    # Small for millimeters, but possible.
    elif longest < 10 * _SMALLEST:
        message = f"it is {text} mm; if that is meant in inches, scale it by 25.4"
        problems.append(PrintProblem("unit", 1, no_locations, message, is_error=False))
    if bed is not None:
        x, y, z = size
        a, b, c = (side * (1 + _ROUNDING) for side in bed)
        fits = z <= c and ((x <= a and y <= b) or (y <= a and x <= b))
        if not fits:
            space = " x ".join(f"{length:g}" for length in bed)
            problems.append(PrintProblem("bed", 1, no_locations, f"{text} does not fit on {space}"))
    return problems
