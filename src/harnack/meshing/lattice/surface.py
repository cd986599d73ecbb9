"""Triangles of a real-valued level set in the tetrahedra of a lattice.

Points of the lattice near the level set are moved onto it and become vertices, which makes most
slivers go (Labelle and Shewchuk 2007). Where sheets then touch in a vertex or an edge, points are
put back until they do not. With none moved the surface is a manifold: every tetrahedron is cut by
one triangle or quadrilateral, and signs at its corners alone say how.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.meshing.checks import MeshingError, singular_vertices
from harnack.meshing.edges import IntArray
from harnack.meshing.isotopy import Isotopy, isotopy_of
from harnack.meshing.lattice.cells import Lattice, distinct_rows
from harnack.meshing.lattice.estimates import check_size
from harnack.meshing.lattice.missed import check_nothing_missed
from harnack.meshing.marching import crossings_of, is_cut, triangles_of
from harnack.meshing.points import Boundary, PointSet, newton
from harnack.meshing.refining.refinement import refined, smoothed, smoothed_within
from harnack.meshing.rows import lengths
from harnack.meshing.samples import LevelFunction, Samples
from harnack.meshing.tetrahedra import Tetrahedra

__all__ = ["Surface", "closed_surface", "open_surface"]

# Points so near to the level, in parts of the length of a cell, are moved onto it.
_SNAPPED = 0.25
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class Surface:
    """vertices: (n, 3). faces: (m, 3), counter-clockwise as seen from where f is greater."""

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def of(cls, vertices: FloatArray, faces: IntArray) -> Surface:
        """Without the vertices that are not in use."""
        used = np.flatnonzero(np.bincount(faces.ravel()))
        place = np.full(len(vertices), -1, np.int64)
        place[used] = np.arange(len(used))
        return cls(vertices[used], place[faces])

    def reversed(self) -> Surface:
        """With the faces' other side outside."""
        return Surface(self.vertices, self.faces[:, ::-1])


def open_surface(
    function: LevelFunction, lattice: Lattice, tolerance: float, report: Callable[[str], None]
) -> tuple[Surface, Isotopy]:
    """The level set in the box of a lattice, which ends on the box's faces; and what is proved of
    it, before it is refined.

    tolerance: of the middles of edges and faces, a length.

    Raises:
        MeshingError: no cell is cut, or there are too many.
    """
    walls = lattice.lower, lattice.upper
    cells = lattice.cells_not_empty(function.clearance, function.most_faces)
    coordinates, corners = lattice.tetrahedra(cells)
    points = lattice.points(coordinates)
    report(f"{len(points):,} points, {len(corners):,} tetrahedra")
    nowhere = np.zeros(len(points), np.bool_)
    samples = _sampled(function, points)
    first = _marched(function, points, samples, corners, nowhere, nowhere, lattice, walls)
    vertices, faces = first.vertices, first.faces
    _check_nothing_missed(function, points, samples, corners, first, faces, lattice, walls)
    if not len(faces):
        raise MeshingError("the level set is empty: no cell of the box holds the level")
    check_size(function, vertices, faces, tolerance)
    none = Boundary(np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    size = float(lattice.size.max())
    isotopy = isotopy_of(function, first.points, corners, first.is_cut, faces, none, size, walls)
    vertices = smoothed(function, vertices, faces, walls)
    vertices, faces = refined(function, vertices, faces, tolerance, walls, report)
    vertices = smoothed_within(function, vertices, faces, walls, tolerance)
    return Surface.of(vertices, faces), isotopy


def closed_surface(
    function: LevelFunction, lattice: Lattice, tolerance: float, report: Callable[[str], None]
) -> Surface:
    """The boundary of the points of a lattice's box where the function is negative.

    On the box it is made of the faces of the cells whose centres are negative, as if the points of
    the lattice there were on the level. Triangles in the two outermost layers of cells are coarse
    and may touch in vertices: they are to be cut away. There are no faces if
    the function is nowhere negative.

    Raises:
        MeshingError: too many cells.
    """
    cells = lattice.cells_not_empty(function.clearance, function.most_faces)
    outer = lattice.outer_cells()
    outer = outer[function.values(lattice.points(2 * outer + 1)) <= 0]
    coordinates, corners = lattice.tetrahedra(distinct_rows(np.concatenate([cells, outer])))
    points = lattice.points(coordinates)
    report(f"{len(points):,} points, {len(corners):,} tetrahedra")
    is_wall = lattice.is_outer(coordinates)
    is_fixed = is_wall | ((coordinates == 1) | (coordinates == 2 * lattice.counts - 1)).any(axis=1)
    samples = _sampled(function, points)
    first = _marched(function, points, samples, corners, is_fixed, is_wall, lattice, None)
    vertices, faces = first.vertices, first.faces
    is_on_wall = np.zeros(len(vertices), np.bool_)
    is_on_wall[: len(points)] = is_wall
    is_cap = is_on_wall[faces].any(axis=1)
    rest, caps = faces[~is_cap], [faces[is_cap], _wall_faces(points, samples, corners, is_wall)]
    inner = lattice.lower + 2 * lattice.size, lattice.upper - 2 * lattice.size
    _check_nothing_missed(function, points, samples, corners, first, faces, lattice, inner)
    # What ends at the outermost cells is moved and cut, its ends are not.
    if len(rest):
        check_size(function, vertices, rest, tolerance)
        vertices = smoothed(function, vertices, rest, None)
        inside = _Inside(
            function.field, function.level, function, lattice, most_faces=function.most_faces
        )
        vertices, rest = refined(inside, vertices, rest, tolerance, None, report)
        vertices = smoothed_within(inside, vertices, rest, None, tolerance)
    faces = np.concatenate([rest, *caps])
    return Surface.of(vertices, faces) if len(faces) else Surface(np.zeros((0, 3)), faces)


def _check_nothing_missed(
    function: LevelFunction,
    points: FloatArray,
    samples: Samples,
    corners: IntArray,
    first: _First,
    faces: IntArray,
    lattice: Lattice,
    box: tuple[FloatArray, FloatArray],
) -> None:
    # Tetrahedra with corners on both sides; those with corners on the level may have no face.
    side = np.where(first.points.is_on, 0.0, np.sign(first.points.samples.value))[corners]
    is_beside = np.zeros(len(points), np.bool_)
    is_beside[corners[(side.min(axis=1) < 0) & (side.max(axis=1) > 0)]] = True
    surface = first.vertices, faces
    size = float(lattice.size.max())
    check_nothing_missed(function, points, samples, is_beside, surface, size, box)


@dataclass
class _Inside(LevelFunction):
    """A function that is on the level wherever it is within one and a half cells of the box.

    So nothing is cut there. Triangles that end in the outermost cells would be cut again and again:
    the edge they end with stays as it is, and their centres are no deeper than that.
    """

    function: LevelFunction
    lattice: Lattice

    def at(self, points: FloatArray) -> Samples:
        samples = self.function.at(points)
        lower = self.lattice.lower + 1.5 * self.lattice.size
        upper = self.lattice.upper - 1.5 * self.lattice.size
        is_inside = np.ones(len(points), np.bool_)
        for x, low, high in zip(points.T, lower, upper, strict=True):
            is_inside &= (x >= low) & (x <= high)
        return dataclasses.replace(samples, value=np.where(is_inside, samples.value, 0.0))


def _wall_faces(
    points: FloatArray, samples: Samples, corners: IntArray, is_wall: BoolArray
) -> IntArray:
    """Faces (m, 3) on the box of tetrahedra whose fourth corner is negative, seen from outside."""
    on = is_wall[corners]
    rows = np.flatnonzero(on.sum(axis=1) == 3)
    order = np.argsort(on[rows], axis=1, kind="stable")  # the fourth corner first
    apex, *rest = np.take_along_axis(corners[rows], order, axis=1).T
    below = samples.value[apex] <= 0
    face, apex = np.stack(rest, axis=1)[below], apex[below]
    a, b, c = (points[face[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (points[apex] - a)).sum(axis=1) > 0
    face[inward] = face[inward][:, ::-1]
    return face


def _sampled(function: LevelFunction, points: FloatArray) -> Samples:
    """Raises MeshingError where f is no number."""
    samples = function.at(points)
    bad = ~np.isfinite(samples.value)
    if bad.any():
        x, y, z = points[bad][0]
        raise MeshingError(
            f"{type(function.field).__name__} has no finite value at {bad.sum():,} points, such "
            f"as ({x:.4g}, {y:.4g}, {z:.4g}): choose a `clip` where it has"
        )
    return samples


@dataclass(frozen=True)
class _First:
    """Vertices and faces before they are refined, the points of the tetrahedra, those near the
    level moved onto it, and which tetrahedra (m,) hold points of the faces."""

    vertices: FloatArray
    faces: IntArray
    points: PointSet
    is_cut: BoolArray


def _marched(
    function: LevelFunction,
    points: FloatArray,
    samples: Samples,
    corners: IntArray,
    is_fixed: BoolArray,
    is_wall: BoolArray,
    lattice: Lattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> _First:
    """Vertices and faces of a manifold, with points near the level moved onto it.

    is_fixed: (n,) points that are not moved. is_wall: (n,) those that count as on the level.
    """
    at_rest, original = points, samples
    points, samples, is_on = _snapped(function, points, samples, is_fixed, lattice, walls)
    is_on |= is_wall
    wrong = np.zeros(0, np.int64)
    for _ in range(_MOST_ROUNDS):
        rows, tets = _cut_tetrahedra(points, samples.value, is_on, corners)
        some = PointSet(points, is_on, samples)
        crossings = crossings_of(function, some, tets)
        vertices, faces = triangles_of(function, some, tets, crossings)
        wrong = singular_vertices(faces)
        wrong = wrong[wrong < len(points)]
        wrong = wrong[~is_wall[wrong]]
        if not len(wrong):
            cut: BoolArray = np.asarray(is_on[corners].any(axis=1))
            cut[rows] |= is_cut(some, tets, crossings)
            return _First(vertices, faces, some, cut)
        points, is_on = points.copy(), is_on.copy()
        points[wrong], is_on[wrong] = at_rest[wrong], False
        samples = samples.replaced(wrong, original.some(wrong))
    raise MeshingError(
        f"sheets of the level set touch at {len(wrong)} places: choose a smaller `spacing`"
    )


def _snapped(
    function: LevelFunction,
    points: FloatArray,
    samples: Samples,
    is_fixed: BoolArray,
    lattice: Lattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, Samples, BoolArray]:
    """Points, those near the level moved onto it; their samples; and which are on it."""
    size = float(lattice.size.min())
    near = np.flatnonzero((samples.distance < _SNAPPED * size) & ~is_fixed)
    longest = np.full(len(near), 0.5 * _SNAPPED * size)
    moved = newton(function, points[near], samples.some(near), longest, walls, steps=4)
    there = function.at(moved)
    apart = lengths(moved - points[near])
    steep = lengths(there.gradient)
    good = np.abs(there.value) < 1e-9 * np.maximum(steep * size, 1e-300)
    good &= apart < 1.2 * _SNAPPED * size
    rows = near[good]
    # A value of exactly 0 counts as on the level where it is, so that others have a sign.
    points, is_on = points.copy(), (samples.value == 0) & ~is_fixed
    points[rows], is_on[rows] = moved[good], True
    return points, samples.replaced(rows, there.some(good)), is_on


def _cut_tetrahedra(
    points: FloatArray, value: FloatArray, is_on: BoolArray, corners: IntArray
) -> tuple[IntArray, Tetrahedra]:
    """Those tetrahedra that the level may cut, by their rows, with their edges numbered."""
    on = is_on[corners]
    up = (value[corners] > 0) & ~on
    down = ~up & ~on
    rows = np.flatnonzero((up.any(axis=1) & down.any(axis=1)) | (on.sum(axis=1) >= 3))
    return rows, Tetrahedra.of(points, corners[rows])
