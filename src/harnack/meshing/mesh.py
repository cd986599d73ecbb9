"""Meshes of level sets: `mesh`."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.fields import Field, SolidAngle
from harnack.geometry import Box
from harnack.geometry.net_loops import net_loops
from harnack.meshing.checks import (
    MeshingError,
    boundary_edges,
    check_manifold,
    euler_characteristic,
)
from harnack.meshing.intersections import intersecting_faces, turned_faces
from harnack.meshing.isotopy import Isotopy, isotopy_of
from harnack.meshing.marching import Crossings, crossings_of, is_cut, triangles_of
from harnack.meshing.points import Boundary, Places, PointSet, box_cells, place_points
from harnack.meshing.refinement import improved, refined, smoothed
from harnack.meshing.rims import whole_edges
from harnack.meshing.samples import LevelFunction
from harnack.meshing.tetrahedra import IntArray, Tetrahedra, delaunay, edge_keys

if TYPE_CHECKING:
    from collections.abc import Callable

    import trimesh

    from harnack.backend import FloatArray
    from harnack.cells import Cells
    from harnack.geometry import Volume

__all__ = ["mesh"]

# Cells across the level set, if nothing is asked for; curves have their own length besides.
_ACROSS = 24
_MOST_ATTEMPTS = 4
# Edges of a curve that are longer than so many cells are cut.
_LONGEST = 2.5
# How often edges of a curve that are too near to others are halved.
_MOST_CUTS = 4
# How often points of flat tetrahedra, which spoil the proof of isotopy, are taken out.
_MOST_REMOVALS = 3
_FEW = 200


def mesh(
    field: Field,
    level: float | None = None,
    *,
    tolerance: float = 1e-3,
    spacing: float | None = None,
    clip: Volume | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> trimesh.Trimesh:
    """Triangles of a level set.

    Tetrahedra around the level set, found by an octree whose empty cells are proved empty, are cut
    by it; the surface of an angle ends exactly at its curve. Then edges are cut and vertices moved
    onto the surface until middles of edges and centres of triangles are within the tolerance.

    field: a `SolidAngle` of polygons, or a real-valued field that is continuous.
    level: None for the field's default.
    tolerance: how far triangles may be from the surface, as a part of the size of the level set's
        box (its longest side), sampled and not proved.
    spacing: of cells before anything is refined, in the field's unit; None chooses. Sheets that are
        nearer to each other are told apart where that is noticed; else a MeshingError says so.
    clip: a `Box`, needed where the level set has no extent; the surface ends at its faces. None for
        the field's domain, if that is a box.
    seed: of the small random moves that keep points in general position.
    progress: told what is being done.

    Returns:
        A trimesh.Trimesh. Vertices of a curve come first, in order, bit by bit, and its edges are
        the rim. `metadata["harnack"]` has level, spacing, evaluations, the Euler characteristic,
        boundary: indices (k, 2) of edges of one face, and
        proved, integrated: how many changes along edges of tetrahedra are proved to be differences
            of wrapped values, and how many were integrated;
        isotopy, isotopy_far: the shares of tetrahedra on which the first triangles are proved to
            have the topology of the level set (`meshing.isotopy`), of all and of those farther than
            1.5 times the spacing from the curve;
        turned: triangles, smaller than the tolerance, that are turned over.

    Raises:
        MeshingError: a ValueError, if it could not be done; the message says why.
        TypeError: a field that jumps or has parts, or another clip volume than a box.
    """
    import trimesh

    report = progress or _silent
    field = _checked(field, clip)
    level = field.default_level if level is None else float(level)
    field.check_levels((level,))
    if not (0 < tolerance < 0.5):
        raise ValueError(
            f"tolerance is a part of the size: it must lie in (0, 0.5), not {tolerance}"
        )
    lower, upper, walls = _box(field, level, clip)
    size = float((upper - lower).max())
    if spacing is not None and not 0 < spacing < math.inf:
        raise ValueError(f"spacing must be a positive length, not {spacing!r}")
    start = size / _ACROSS if spacing is None else float(spacing)
    function = LevelFunction(field, level)
    attempts = 1 if spacing is not None else _MOST_ATTEMPTS
    first = _embedded(
        function, start, attempts, (lower, upper), walls, seed, 0.5 * tolerance * size, report
    )
    vertices, faces = first.vertices, first.faces
    kept = np.unique(faces)
    place = np.full(len(vertices), -1, np.int64)
    place[kept] = np.arange(len(kept))
    faces = place[faces]
    result = trimesh.Trimesh(vertices[kept], faces, process=False, validate=False)
    result.metadata["harnack"] = {
        "level": level,
        "spacing": first.spacing,
        "evaluations": function.evaluations,
        "euler_characteristic": euler_characteristic(faces),
        "proved": first.crossings.proved,
        "integrated": first.crossings.integrated,
        "isotopy": first.isotopy.proved,
        "isotopy_far": first.isotopy.proved_far,
        "turned": first.turned,
        "boundary": boundary_edges(faces),
    }
    return result


def _checked(field: Any, clip: Volume | None) -> Field:
    if not isinstance(field, Field):
        raise TypeError(f"mesh needs a field, not {type(field).__name__}")
    if field.has_parts or field.has_sheets:
        raise TypeError(
            f"{type(field).__name__} is not one continuous function: mesh its parts, or the "
            "solid angle of its boundary"
        )
    if clip is not None and not isinstance(clip, Box):
        raise TypeError(f"clip must be a harnack.Box, not {type(clip).__name__}")
    if isinstance(field, SolidAngle):
        if field.circles:
            raise TypeError(
                "the mesh of a circle ends on a polygon: give circle.polygon(n) in its place"
            )
        if clip is not None:
            raise TypeError("the surface of a curve ends at its curve: leave clip out")
        return SolidAngle(list(field.loops))
    if field.period is not None:
        raise TypeError(f"{type(field).__name__} is angle-valued and does not say where it ends")
    return field


def _box(
    field: Field, level: float, clip: Volume | None
) -> tuple[FloatArray, FloatArray, tuple[FloatArray, FloatArray] | None]:
    """The box to be filled, and its faces if the surface ends there."""
    if clip is None and isinstance(field.domain, Box):
        clip = field.domain
    if clip is not None:
        lower, upper = (np.array(end, np.float64) for end in clip.bounds())
        return lower, upper, (lower, upper)
    if field.domain is not None:
        raise MeshingError(
            f"{type(field).__name__} ends at its domain, which is no box: give "
            "clip=harnack.Box(lower, upper)"
        )
    if isinstance(field, SolidAngle) and abs(math.remainder(level, 4 * math.pi)) < 1e-6:
        raise MeshingError(
            f"level {level:g} is a multiple of 4 pi: the surface of a curve has no end there; "
            "choose a level between them, such as 2 pi"
        )
    extent = field.extent((level,))
    if extent is None:
        raise MeshingError(
            f"{type(field).__name__} does not say where its level {level:g} ends: give "
            "clip=harnack.Box(lower, upper)"
        )
    lower, upper = (np.array(end, np.float64) for end in extent.bounds())
    return lower, upper, None


@dataclass(frozen=True)
class _Surface:
    """Triangles, and how they were found. turned: faces turned over."""

    vertices: FloatArray
    faces: IntArray
    curve: Boundary
    spacing: float
    crossings: Crossings
    isotopy: Isotopy
    turned: int = 0


def _embedded(
    function: LevelFunction,
    spacing: float,
    attempts: int,
    box: tuple[FloatArray, FloatArray],
    walls: tuple[FloatArray, FloatArray] | None,
    seed: int,
    tolerance: float,
    report: Callable[[str], None],
) -> _Surface:
    """Triangles within the tolerance, none of which pass through others; where some do, or are
    turned over, cells are made smaller and all is done again."""
    finer: tuple[Places, ...] = ()
    best: _Surface | None = None
    crossing = np.zeros(0, np.int64)
    for attempt in range(_MOST_ATTEMPTS):
        first = _first_mesh(function, spacing, attempts, box, walls, seed, finer, report)
        spacing = first.spacing
        faces = first.faces
        vertices = smoothed(function, first.vertices, faces, walls)
        vertices, faces = refined(function, vertices, faces, tolerance, walls, report)
        vertices, faces = improved(function, vertices, faces, tolerance, walls, report)
        turned = turned_faces(function, vertices, faces)
        if isinstance(function.field, SolidAngle):
            kept = sum(map(len, net_loops(function.field.loops)))
            vertices, faces = whole_edges(
                function, vertices, faces, kept, len(first.curve.points), tolerance
            )
        check_manifold(faces)
        crossing = intersecting_faces(vertices, faces)
        if not len(crossing) and (best is None or len(turned) < best.turned):
            best = dataclasses.replace(first, vertices=vertices, faces=faces, turned=len(turned))
        bad = np.union1d(crossing, turned)
        if not len(bad):
            break
        if attempt < _MOST_ATTEMPTS - 1:
            report(f"{len(bad)} triangles fail: smaller cells there")
            finer = (*finer, Places(vertices[faces[bad]].mean(axis=1), spacing))
    if best is None:
        raise MeshingError(
            f"{len(crossing)} triangles pass through others, in cells as small as "
            f"{spacing / 2 ** len(finer):.3g}: choose a smaller `tolerance` or `spacing`"
        )
    return best


def _first_mesh(
    function: LevelFunction,
    spacing: float,
    attempts: int,
    box: tuple[FloatArray, FloatArray],
    walls: tuple[FloatArray, FloatArray] | None,
    seed: int,
    finer: tuple[Places, ...],
    report: Callable[[str], None],
) -> _Surface:
    """Triangles in cells of that spacing, or where that fails of smaller ones."""
    loops = net_loops(function.field.loops) if isinstance(function.field, SolidAngle) else ()
    curve = (
        Boundary.of(loops, _LONGEST * spacing) if loops else Boundary(np.zeros((0, 3)), _NO_EDGES)
    )
    for k, places in enumerate(finer):  # balls on long edges leave no room for points
        curve = curve.split_near(places, spacing * 0.5**k)
    margin = 0.5 * spacing if walls is None else 0.0
    root = box_cells(box[0] - margin, box[1] + margin, spacing, exact=walls is not None)
    report(f"cells of {spacing:.3g}")
    try:
        curve, points, tets = _filled(function, root, curve, walls, seed, finer)
        report(f"{len(points.points):,} points, {len(tets.corners):,} tetrahedra")
        surface = _in_tetrahedra(function, points, tets, curve, spacing, walls)
        for _ in range(_MOST_REMOVALS):
            # Beside a curve all is never proved, and little is gained.
            if len(curve.edges) or not 0 < len(surface.isotopy.open_far) < _FEW:
                break
            points = _without_slivers(points, surface.isotopy.open_far, walls)
            try:
                tets = delaunay(points.points)
                other = _in_tetrahedra(function, points, tets, curve, spacing, walls)
            except MeshingError:  # of fewer points; the first surface passed all checks
                break
            if len(other.isotopy.open_far) < len(surface.isotopy.open_far):
                surface = other
    except MeshingError:
        if attempts == 1:
            raise
        return _first_mesh(function, 0.6 * spacing, attempts - 1, box, walls, seed, finer, report)
    return surface


def _in_tetrahedra(
    function: LevelFunction,
    points: PointSet,
    tets: Tetrahedra,
    curve: Boundary,
    spacing: float,
    walls: tuple[FloatArray, FloatArray] | None,
) -> _Surface:
    """Triangles in tetrahedra, checked, and what is proved about them."""
    crossings = crossings_of(function, points, tets)
    vertices, faces = triangles_of(function, points, tets, crossings)
    if not len(faces):
        raise MeshingError("the level set is empty: no cell of the box holds the level")
    check_manifold(faces)
    if len(curve.edges):
        _check_boundary(faces, curve)
    cut = is_cut(points, tets, crossings)
    isotopy = isotopy_of(function, points, tets, cut, faces, curve, spacing, walls)
    return _Surface(vertices, faces, curve, spacing, crossings, isotopy)


def _without_slivers(
    points: PointSet,
    corners: IntArray,
    walls: tuple[FloatArray, FloatArray] | None,
) -> PointSet:
    """Points but for one of each of some tetrahedra with corners (k, 4), which is on no wall."""
    count = np.bincount(corners.ravel(), minlength=len(points.points))
    if walls is not None:
        x = points.points
        count[((x <= walls[0]) | (x >= walls[1])).any(axis=1)] = 0
    often = count[corners]
    worst = corners[np.arange(len(corners)), often.argmax(axis=1)]
    return points.without(np.unique(worst[often.max(axis=1) > 0]))


def _filled(
    function: LevelFunction,
    root: tuple[Cells, int],
    curve: Boundary,
    walls: tuple[FloatArray, FloatArray] | None,
    seed: int,
    finer: tuple[Places, ...],
) -> tuple[Boundary, PointSet, Tetrahedra]:
    """Tetrahedra that have all edges of the curve, which is cut where others are too near."""
    for _ in range(_MOST_CUTS):
        points = place_points(function, root, curve, walls, seed, finer)
        tets = delaunay(points.points)
        has_edge = tets.has_edges(curve.edges)
        if has_edge.all():
            return curve, points, tets
        curve = curve.split(~has_edge)
    raise MeshingError("edges of the curve are too near to others: choose a smaller `spacing`")


def _silent(text: str) -> None:
    """Tells nobody."""


_NO_EDGES = np.zeros((0, 2), np.int64)


def _check_boundary(faces: IntArray, curve: Boundary) -> None:
    edges = boundary_edges(faces)
    count = max(int(faces.max()) + 1, len(curve.points))
    if not np.array_equal(np.sort(edge_keys(edges, count)), np.sort(edge_keys(curve.edges, count))):
        raise MeshingError(
            "the mesh does not end at the curve: cells are too large for it; choose a smaller "
            "`spacing`"
        )
