"""Triangles of a real-valued level set in the tetrahedra of a lattice, and checks of them.

Points of the lattice near the level set are moved onto it and become vertices, which removes most
slivers (Labelle and Shewchuk 2007). Where parts of the surface then touch in a vertex or an edge,
points are moved back until they do not. With none moved the surface is a manifold: every
tetrahedron is cut by one triangle or quadrilateral, which the signs at its corners determine.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import BoolArray, FloatArray
from harnack.geometry.welding import connected_groups, pairs_within
from harnack.meshing.bcc_lattice import BccLattice, distinct_rows
from harnack.meshing.checks import (
    MeshingError,
    TriangleLimitError,
    UnrefinableError,
    nonmanifold_vertices,
)
from harnack.meshing.delaunay_points import (
    BoundaryCurve,
    TetrahedronPoints,
    newton_to_level,
    to_multiple_roots,
)
from harnack.meshing.edges import IntArray, row_norms, sorted_unique, unique_with_inverse
from harnack.meshing.isotopy import IsotopyCoverage, isotopy_of
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.meshing.marching_tetrahedra import (
    OUTSIDE_VALUE,
    Tetrahedra,
    count_crossings,
    extract_triangles,
)
from harnack.meshing.refinement import refine, smooth, smooth_within_tolerance

if TYPE_CHECKING:
    from harnack.tree.empty_space import Clearance

__all__ = [
    "IrrelevantRegion",
    "MissedPartsError",
    "TriangleMesh",
    "check_estimated_triangles",
    "check_no_missed_parts",
    "mesh_closed_surface",
    "mesh_open_surface",
    "split_faces_off_level",
]

# Distances in cells, for points of missed parts: the largest estimated distance of the level from a
# lattice point; the largest move of the point onto it; the smallest distance of the moved point
# from all triangles, by their corners and centers, which are less than half a cell from all points
# on them; and its smallest distance from the faces of the box, beyond which the surface may
# continue.
_MAX_SEED_DISTANCE, _MAX_SEED_MOVE, _MIN_MESH_DISTANCE, _MIN_WALL_DISTANCE = 1.0, 1.5, 0.75, 0.5
# In cells: points nearer than the first belong together; parts at least as long as the second count
# as missed.
_CLUSTER_DISTANCE, _MIN_MISSED_LENGTH = 1.0, 2.0
# Parts thinner than this many cells are missed nearly everywhere; and the thinnest measured.
_THIN, _MIN_THICKNESS = 0.25, 2.0**-7
# How near to the level, in cells, a point has to come by Newton's method.
_ON = 1e-3
# Newton's method may converge to a multiple root where the distance fell by at least this factor.
_SLOW = 0.7
# The test for a function that touches its level: the number of points; how far beside them, in
# cells, the function is evaluated; the number of golden sections and their ratio; and how near the
# function comes to the level, relative to its values beside the point.
_MAX_TOUCH_TESTS, _SIDE_OFFSET, _SECTIONS, _GOLDEN, _TOUCHES = (
    60,
    0.01,
    40,
    0.6180339887498949,
    1e-8,
)
# The largest fraction of vertices that may be farther from the level than the second, in cells:
# where signs change by a jump.
_MAX_JUMP_FRACTION, _FAR_DISTANCE = 0.04, 0.1
# A function that equals its level at a larger fraction of this number of points has no surface
# there.
_MAX_FLAT_FRACTION, _MAX_PROBES = 0.75, 2000
# How far around a point, in cells, the function has to equal its level for the level set to be a
# volume.
_FLAT_AROUND = 0.25


class MissedPartsError(MeshingError):
    """A level set of which some parts lie between the points of a lattice.

    places: (k, 3) points of the longest part, on the level; thickness: (k,) of the part there, a
        multiple of `_MIN_THICKNESS` cells: 0 where it is thinner, inf where it is thicker than a
        cell.
    size: of cells.
    """

    def __init__(
        self, message: str, places: FloatArray, thickness: FloatArray, size: float
    ) -> None:
        super().__init__(message)
        self.places, self.thickness, self.size = places, thickness, size

    def may_be_fixed_by(self, smaller: float) -> bool:
        """Whether cells `smaller` times as large may help: not if they would also miss a part that
        is two of these cells long and far thinner than a cell, as beside a cusp or the tip of a
        cone, which no size of cells resolves."""
        thin = self.places[self.thickness < _THIN * smaller * self.size]
        part = _longest_part(thin, _CLUSTER_DISTANCE * self.size)
        reach = float(np.ptp(part, axis=0).max()) if len(part) else 0.0
        return reach < _MIN_MISSED_LENGTH * smaller * self.size


def check_no_missed_parts(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    is_beside: BoolArray,
    surface: tuple[FloatArray, IntArray],
    size: float,
    box: tuple[FloatArray, FloatArray],
    irrelevant: Clearance | None = None,
) -> None:
    """Raise if the level set has parts, two cells long or longer, away from its triangles: thin
    walls, knife edges, islands.

    Signs at the points of a lattice do not show a wall between two of them. Newton's method,
    started at these points, finds its sides: the end point, on the level, should be near triangles.
    These points are a dense sample, and no proof. Islands smaller than a cell may be missed.

    samples: at points (n, 3) of the lattice. is_beside: (n,) which points are corners of cut
        tetrahedra.
    surface: vertices and faces. size: of a cell. box: where the level set counts; irrelevant: the
        radius around points within which it does not count.

    Raises:
        MissedPartsError: parts are missed; with points of the longest. UnrefinableError: the
            function equals its level in a volume, or touches it along a surface.
    """
    import scipy.spatial  # imported here: it takes half a second

    searching: Any = scipy.spatial
    rows = np.flatnonzero(~is_beside & (samples.distance < _MAX_SEED_DISTANCE * size))
    if not len(rows):
        return
    start = points[rows]
    step = np.full(len(rows), 0.5 * size)
    x = newton_to_level(function, start, samples.select(rows), step, None)
    end_samples = function.sample(x)
    on_level = end_samples.distance < _ON * size
    slow = ~on_level & (end_samples.distance < _SLOW * samples.distance[rows])
    if slow.any():
        x[slow] = to_multiple_roots(function, x[slow], end_samples.select(slow), step[slow])
        on_level[slow] = function.sample(x[slow]).distance < _ON * size
    on_level &= row_norms(x - start) < _MAX_SEED_MOVE * size
    deep = _MIN_WALL_DISTANCE * size
    on_level &= ((x >= box[0] + deep) & (x <= box[1] - deep)).all(axis=1)
    x = x[on_level]
    vertices, faces = surface
    if len(faces) and len(x):
        mesh_points = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
        x = x[searching.cKDTree(mesh_points).query(x)[0] > _MIN_MESH_DISTANCE * size]
    if irrelevant is not None and len(x):
        x = x[irrelevant(x) <= 0]
    part = _longest_part(x, _CLUSTER_DISTANCE * size)
    if len(part) and np.ptp(part, axis=0).max() >= _MIN_MISSED_LENGTH * size:
        _check_off_level_around(function, part, _FLAT_AROUND * size)
        _check_passes_level(function, part, size)
        a, b, c = part[0]
        raise MissedPartsError(
            f"cells of {size:.3g} miss parts of the level set, such as that at ({a:.4g}, {b:.4g}, "
            f"{c:.4g}), which are thinner or smaller: choose a smaller `cell_size`, or for a wall "
            "or "
            "an edge make the solid of smooth parts, such as hk.solid(f, between=(low, high)) or "
            "hk.solid(f, below=0) & hk.solid(g, below=0)",
            part,
            _thickness(function, part, size),
            size,
        )


def _thickness(function: LevelFunction, x: FloatArray, size: float) -> FloatArray:
    """(k,) the distance from points (k, 3) on the level to the next change of sign along the slope,
    up to `size`: 0 where the sign does not change at the point itself, inf where it does not change
    again."""
    slope = function.sample(x).gradient
    direction = slope / np.maximum(row_norms(slope), 1e-300)[:, None]
    distances = size * 2.0 ** np.arange(round(math.log2(_MIN_THICKNESS)), 1)
    sides: list[BoolArray] = []
    thickness = np.full(len(x), np.inf)
    for sign in (1.0, -1.0):
        probes = x[:, None] + sign * distances[:, None] * direction[:, None]
        is_above = function.values(probes.reshape(-1, 3)).reshape(len(x), len(distances)) > 0
        changed = is_above != is_above[:, :1]
        first = distances[changed.argmax(axis=1)]
        thickness = np.minimum(thickness, np.where(changed.any(axis=1), first, np.inf))
        sides.append(is_above[:, 0])
    return np.where(sides[0] == sides[1], 0.0, thickness)


def _check_off_level_around(function: LevelFunction, part: FloatArray, reach: float) -> None:
    """Raise if the function equals its level, up to rounding, at most of the points (n, 3) and on
    all sides of them: such as max(x, 0), for which no cells are small enough."""
    probes = part[:: -(-len(part) // _MAX_PROBES)]
    offsets = reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    near_points = (probes[:, None] + offsets).reshape(-1, 3)
    is_flat = function.is_on_level(near_points).reshape(len(probes), -1).all(axis=1)
    if is_flat.mean() > 0.5:
        a, b, c = probes[is_flat][0]
        raise UnrefinableError(
            f"{type(function.field).__name__} is {function.level:g}, up to rounding, at and around "
            f"points such as ({a:.4g}, {b:.4g}, {c:.4g}): its level there is a volume and no "
            "surface; choose another level"
        )


def _check_passes_level(function: LevelFunction, part: FloatArray, size: float) -> None:
    """Raise if the function touches its level at most of the points (n, 3) near it, and does not
    pass it, as a square, whose sign no cells show.

    Across such a point, on a line along the slope beside it, the function is on one side of the
    level, and where it comes nearest, by golden sections, it is as near as rounding allows.
    """
    x = part[:: -(-len(part) // _MAX_TOUCH_TESTS)]
    half = _SIDE_OFFSET * size
    beside = function.sample((x[:, None] + half * np.eye(3)).reshape(-1, 3)).gradient.reshape(
        -1, 3, 3
    )
    steepest = beside[np.arange(len(x)), (beside**2).sum(axis=2).argmax(axis=1)]
    direction = steepest / np.maximum(row_norms(steepest), 1e-300)[:, None]

    def along(s: FloatArray) -> FloatArray:
        return function.values(x + s[:, None] * direction)

    low, high = np.full(len(x), -half), np.full(len(x), half)
    side = np.sign(along(low))
    ends = np.minimum(side * along(low), side * along(high))
    nearest = ends.copy()
    for _ in range(_SECTIONS):
        s, t = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        near_low, near_high = side * along(s), side * along(t)
        nearest = np.minimum(nearest, np.minimum(near_low, near_high))
        low, high = np.where(near_low > near_high, s, low), np.where(near_low > near_high, high, t)
    touches = (ends > 0) & (nearest >= 0) & (nearest <= _TOUCHES * ends)
    if touches.mean() > 0.5:
        a, b, c = x[touches][0]
        name, level = type(function.field).__name__, function.level
        raise UnrefinableError(
            f"{name} comes to {level:g} without passing it, as a square does, at points such as "
            f"({a:.4g}, {b:.4g}, {c:.4g}): the surface there has one side only and no mesh finds "
            "it. Give a function that changes its sign there, such as u instead of u^2, or mesh a "
            f"thin wall, such as hk.solid(f, between=({level:g} - t, {level:g} + t)) with a small t"
        )


def _longest_part(x: FloatArray, apart: float) -> FloatArray:
    """The points (n, 3) that form the longest chain whose neighbors are no farther apart than
    `apart`."""
    if not len(x):
        return x
    part = connected_groups(pairs_within(x, apart), len(x))
    count = int(part.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, x)
    np.maximum.at(high, part, x)
    return x[part == (high - low).max(axis=1).argmax()]


def check_estimated_triangles(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> None:
    """Raise if refinement of these triangles is estimated to make more triangles than the function
    allows.

    The distance of the middle of a triangle from the surface falls with its area: a triangle that
    is k times the tolerance away is refined to about k triangles. A selection of triangles is
    examined.

    Raises:
        MeshingError: the function has no slope between the vertices.
        TriangleLimitError: the estimate exceeds the limit; with a tolerance that would suffice.
    """
    sampled = faces[:: max(1, len(faces) // 20_000)]
    if not len(sampled):
        return
    corner = vertices[sampled]
    at = function.sample(0.5 * (corner + np.roll(corner, 1, axis=1)).reshape(-1, 3))
    is_flat = (at.value != 0) & ~at.gradient.any(axis=1)
    if is_flat.any():
        raise MeshingError(
            f"{type(function.field).__name__} is constant at {is_flat.sum():,} of "
            f"{len(is_flat):,} middles of edges, so that it does not say how far the surface is: "
            "choose a smaller `cell_size`, or a function with a slope within a cell of its surface"
        )
    middle = at.distance
    ratio = middle.reshape(-1, 3).max(axis=1) / tolerance
    expected = float(np.maximum(1.0, ratio).mean()) * len(faces)
    limit = function.most_faces
    if expected > limit:
        enough = expected / limit
        raise TriangleLimitError(
            f"the tolerance takes about {expected:.1e} triangles, and max_triangles is {limit:,}: "
            f"choose a `tolerance` {enough:.2g} times as large, or a larger `max_triangles`"
        )


# Points this near to the level, relative to the length of a cell, are moved onto it.
_SNAPPED = 0.25
# The width, in cells, of the border around relevant cells that is meshed as well.
_BORDER = 2.0
# The number of cells along an edge of a block.
_BLOCK = 8
_MAX_ROUNDS = 20


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh.

    vertices: (n, 3).
    faces: (m, 3), counter-clockwise as seen from where f is greater.
    """

    vertices: FloatArray
    faces: IntArray

    @classmethod
    def without_unused_vertices(cls, vertices: FloatArray, faces: IntArray) -> TriangleMesh:
        """A mesh of these faces, without the vertices that no face uses."""
        used = np.flatnonzero(np.bincount(faces.ravel()))
        index = np.full(len(vertices), -1, np.int64)
        index[used] = np.arange(len(used))
        return cls(vertices[used], index[faces])

    def reversed(self) -> TriangleMesh:
        """The same mesh with the orientation of all faces reversed."""
        return TriangleMesh(self.vertices, self.faces[:, ::-1])


@dataclass(frozen=True)
class IrrelevantRegion:
    """The region where a surface need not be meshed, because other operands remove it.

    clearance: radii of balls about points (k, 3) that lie in the region.
    cached_cells: for each lattice, the cells that are not proved to lie in the region.
    """

    clearance: Clearance
    cached_cells: dict[tuple[float, ...], IntArray] = dataclasses.field(
        default_factory=dict[tuple[float, ...], IntArray]
    )

    def relevant_cells(self, lattice: BccLattice, limit: int) -> IntArray:
        """Indices (n, 3) of the cells that are not proved to lie in the region, and of a border of
        cells around them.

        Raises:
            MeshingError: there are more cells than `limit` triangles take.
        """
        key = (*lattice.lower.tolist(), *lattice.size.tolist(), *lattice.counts.tolist(), limit)
        if key not in self.cached_cells:
            border = _BORDER * float(lattice.size.max())
            self.cached_cells[key] = lattice.nonempty_cells(
                lambda points: self.clearance(points) - border, limit
            )
        return self.cached_cells[key]


def mesh_open_surface(
    function: LevelFunction, lattice: BccLattice, tolerance: float, report: Callable[[str], None]
) -> tuple[TriangleMesh, IsotopyCoverage]:
    """The mesh of the level set in the box of a lattice, which ends on the box's faces; and its
    proved isotopy, before it is refined.

    tolerance: of the middles of edges and faces, a length.

    Raises:
        MeshingError: no cell is cut, or there are too many; an UnrefinableError where the function
            is not finite, or its level set is a volume.
    """
    walls = lattice.lower, lattice.upper
    cells = lattice.nonempty_cells(function.clearance, function.most_faces)
    coordinates, corners = lattice.tetrahedra(cells)
    points = lattice.points(coordinates)
    report(f"{len(points):,} points, {len(corners):,} tetrahedra")
    nowhere = np.zeros(len(points), np.bool_)
    samples = _sample_lattice(function, points, lattice, nowhere)
    first = _march(function, points, samples, corners, nowhere, nowhere, lattice, walls)
    vertices, faces = first.vertices, first.faces
    _check_nothing_missed(function, points, samples, corners, first, faces, lattice, walls)
    if not len(faces):
        raise MeshingError("the level set is empty: no cell of the box holds the level")
    _check_is_continuous(function, vertices, faces, lattice)
    check_estimated_triangles(function, vertices, faces, tolerance)
    none = BoundaryCurve(np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    size = float(lattice.size.max())
    cut = first.is_cut(corners)
    isotopy = isotopy_of(function, first.points, corners, cut, faces, none, size, walls)
    vertices = smooth(function, vertices, faces, walls)
    vertices, faces = refine(function, vertices, faces, tolerance, walls, report)
    vertices = smooth_within_tolerance(function, vertices, faces, walls, tolerance)
    return TriangleMesh.without_unused_vertices(vertices, faces), isotopy


def mesh_closed_surface(
    function: LevelFunction,
    lattice: BccLattice,
    tolerance: float,
    report: Callable[[str], None],
    *,
    as_cut: bool = False,
    irrelevant: IrrelevantRegion | None = None,
) -> TriangleMesh:
    """The boundary of the points of a lattice's box where the function is negative.

    On the box it consists of the faces of the cells whose centers are negative, as if the points of
    the lattice there were on the level. Triangles in the two outermost layers of cells are coarse
    and may touch in vertices: they are to be cut away. There are no faces if the function is
    nowhere negative.

    as_cut: whether to leave the triangles as the cells cut them, which never pass through each
        other, and to leave out parts between points of the lattice: for functions with creases
        everywhere, as distances from meshes, and cells of about the tolerance.
    irrelevant: the region where the surface does not matter: except for a few cells at its border,
        the function counts as positive there, and the surface is closed by coarse triangles.

    Raises:
        MeshingError: too many cells.
    """
    limit, does_matter = function.most_faces, None
    if irrelevant is None:
        cells = lattice.nonempty_cells(function.clearance, limit)
    else:
        cells, does_matter = lattice.relevant_cells(
            function.clearance, irrelevant.relevant_cells(lattice, limit), function.values, limit
        )
    outer = lattice.outer_cells()
    if does_matter is not None:
        outer = outer[does_matter[tuple(outer.T)]]
    outer = outer[_are_negative(function, lattice, outer)]
    coordinates, corners = lattice.tetrahedra(distinct_rows(np.concatenate([cells, outer])))
    points = lattice.points(coordinates)
    report(f"{len(points):,} points, {len(corners):,} tetrahedra")
    is_wall = lattice.is_on_box(coordinates)
    is_fixed = is_wall | ((coordinates == 1) | (coordinates == 2 * lattice.counts - 1)).any(axis=1)
    is_beyond = np.zeros(len(points), np.bool_)
    if does_matter is not None:
        is_beyond = lattice.touches_cells(coordinates, ~does_matter) & ~is_wall
    samples = _sample_lattice(function, points, lattice, is_beyond)
    first = _march(function, points, samples, corners, is_fixed | is_beyond, is_wall, lattice, None)
    vertices, faces = first.vertices, first.faces
    is_coarse = first.is_beside(is_wall | is_beyond)
    is_cap = is_coarse[faces].any(axis=1)
    rest, caps = faces[~is_cap], [faces[is_cap], _wall_faces(points, samples, corners, is_wall)]
    inner = lattice.lower + 2 * lattice.size, lattice.upper - 2 * lattice.size
    if as_cut:
        return TriangleMesh.without_unused_vertices(vertices, np.concatenate([rest, *caps]))
    _check_nothing_missed(
        function, points, samples, corners, first, faces, lattice, inner,
        None if irrelevant is None else irrelevant.clearance,
    )  # fmt: skip
    # Triangles that end at the outermost cells are moved and cut, their ends are not.
    if len(rest):
        _check_is_continuous(function, vertices, rest, lattice)
        check_estimated_triangles(function, vertices, rest, tolerance)
        vertices = smooth(function, vertices, rest, None)
        counts = _inside(lattice, does_matter)
        vertices, rest = refine(function, vertices, rest, tolerance, None, report, counts)
        vertices = smooth_within_tolerance(function, vertices, rest, None, tolerance, counts)
    faces = np.concatenate([rest, *caps])
    return (
        TriangleMesh.without_unused_vertices(vertices, faces)
        if len(faces)
        else TriangleMesh(np.zeros((0, 3)), faces)
    )


def split_faces_off_level(
    function: LevelFunction, surface: TriangleMesh, farthest: float, times: int
) -> TriangleMesh:
    """The mesh in which faces whose center is farther than `farthest` from the level, as across a
    crease, are cut into three at a point on the level; so are the new faces, `times` times. All
    edges stay."""
    vertices, faces = surface.vertices, surface.faces
    pending = np.arange(len(faces))
    for _ in range(times):
        corner = vertices[faces[pending]]
        center = corner.mean(axis=1)
        samples = function.sample(center)
        off_level = np.flatnonzero(samples.distance > farthest)
        if not len(off_level):
            break
        span = 0.5 * row_norms(corner[off_level, 1] - corner[off_level, 0])
        moved = newton_to_level(function, center[off_level], samples.select(off_level), span, None)
        rows, inner = pending[off_level], len(vertices) + np.arange(len(off_level))
        a, b, c = faces[rows].T
        vertices = np.concatenate([vertices, moved])
        fans = [np.stack([*ends, inner], axis=1) for ends in ((a, b), (b, c), (c, a))]
        faces = np.concatenate([np.delete(faces, rows, axis=0), *fans])
        pending = np.arange(len(faces) - 3 * len(rows), len(faces))
    return TriangleMesh(vertices, faces)


def _are_negative(function: LevelFunction, lattice: BccLattice, cells: IntArray) -> BoolArray:
    """(k,) whether the function is negative at the centers of cells (k, 3): as at the center of the
    block of cells, where the level is proved not to be in the block."""
    shape = lattice.counts // _BLOCK + 1
    x, y, z = (cells // _BLOCK).T
    keys, index, _, _ = unique_with_inverse((x * shape[1] + y) * shape[2] + z)
    xy, z = np.divmod(keys, shape[2])
    blocks = np.stack([*np.divmod(xy, shape[1]), z], axis=1)
    centers = lattice.points(_BLOCK * (2 * blocks + 1))
    half_diagonal = 0.5 * _BLOCK * float(np.linalg.norm(lattice.size))
    is_sure = function.clearance(centers) > half_diagonal * (1 + 1e-9)
    negative = (function.values(centers) <= 0)[index]
    open_rows = np.flatnonzero(~is_sure[index])
    negative[open_rows] = function.values(lattice.points(2 * cells[open_rows] + 1)) <= 0
    return negative


def _check_nothing_missed(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    corners: IntArray,
    first: _InitialMesh,
    faces: IntArray,
    lattice: BccLattice,
    box: tuple[FloatArray, FloatArray],
    elsewhere: Clearance | None = None,
) -> None:
    # Tetrahedra with corners on both sides; those with corners on the level may have no face.
    side = np.where(first.points.is_on_level, 0.0, np.sign(first.points.samples.value))[corners]
    is_beside = np.zeros(len(points), np.bool_)
    is_beside[corners[(side.min(axis=1) < 0) & (side.max(axis=1) > 0)]] = True
    surface = first.vertices, faces
    size = float(lattice.size.max())
    check_no_missed_parts(function, points, samples, is_beside, surface, size, box, elsewhere)


def _inside(
    lattice: BccLattice, does_matter: BoolArray | None
) -> Callable[[FloatArray], BoolArray]:
    """A function that tells which points are farther than one and a half cells from the box's
    faces, and neither in nor beside irrelevant cells. does_matter: (counts) the mask of relevant
    cells.

    Triangles that end in the outermost cells would be cut again and again: the edge that they end
    with stays as it is, and their centers are no deeper than that.
    """
    lower, upper = lattice.lower + 1.5 * lattice.size, lattice.upper - 1.5 * lattice.size
    deep = None if does_matter is None else lattice.interior_cells(does_matter)

    def counts(points: FloatArray) -> BoolArray:
        is_inside = np.ones(len(points), np.bool_)
        for x, low, high in zip(points.T, lower, upper, strict=True):
            is_inside &= (x >= low) & (x <= high)
        if deep is not None:
            is_inside &= deep[tuple(lattice.cell_indices(points).T)]
        return is_inside

    return counts


def _wall_faces(
    points: FloatArray, samples: LevelSamples, corners: IntArray, is_wall: BoolArray
) -> IntArray:
    """Faces (m, 3) on the box of tetrahedra whose fourth corner is negative, seen from outside."""
    on = is_wall[corners]
    rows = np.flatnonzero(on.sum(axis=1) == 3)
    order = np.argsort(on[rows], axis=1, kind="stable")  # the fourth corner first
    apex, *base = np.take_along_axis(corners[rows], order, axis=1).T
    below = samples.value[apex] <= 0
    face, apex = np.stack(base, axis=1)[below], apex[below]
    a, b, c = (points[face[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (points[apex] - a)).sum(axis=1) > 0
    face[inward] = face[inward][:, ::-1]
    return face


def _sample_lattice(
    function: LevelFunction, points: FloatArray, lattice: BccLattice, is_beyond: BoolArray
) -> LevelSamples:
    """The function at points of a lattice, with a large positive value at irrelevant points
    `is_beyond`; raises UnrefinableError where it is not finite, or equals its level nearly
    everywhere."""
    count = len(points)
    samples = LevelSamples(np.full(count, 10 * OUTSIDE_VALUE), np.ones((count, 3)), np.zeros(count))
    points = points[~is_beyond]
    samples = samples.replaced(~is_beyond, function.sample(points))
    fails = ~np.isfinite(samples.value[~is_beyond])
    if fails.any():
        x, y, z = points[fails][0]
        nearer = ", or a smaller `cell_size`: it is asked for three cells around other parts"
        raise UnrefinableError(
            f"{type(function.field).__name__} has no finite value at {fails.sum():,} points, such "
            f"as ({x:.4g}, {y:.4g}, {z:.4g}): choose a `clip` where it has"
            + (nearer if is_beyond.any() else "")
        )
    _check_off_level_at_most_points(function, points, lattice)
    return samples


def _check_is_continuous(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, lattice: BccLattice
) -> None:
    """Raise if at many vertices the sign of the function changes and the level is not near: the
    function jumps there, and refinement would never end."""
    x = vertices[np.unique(faces)]
    is_far = function.sample(x).distance > _FAR_DISTANCE * float(lattice.size.max())
    if is_far.sum() > _MAX_JUMP_FRACTION * len(x):
        a, b, c = x[is_far][0]
        raise UnrefinableError(
            f"{type(function.field).__name__} changes its sign without coming to its level at "
            f"{is_far.sum():,} of {len(x):,} places, such as ({a:.4g}, {b:.4g}, {c:.4g}): it jumps "
            "there, as at the cut of atan2 or a pole; choose a `clip` without it, or write it "
            "otherwise, such as with the sine of an angle"
        )


def _check_off_level_at_most_points(
    function: LevelFunction, points: FloatArray, lattice: BccLattice
) -> None:
    """Raise if the function equals its level nearly everywhere, up to rounding: such as x - x, for
    which no cells are proved empty, however small they are."""
    if len(points) <= _MAX_FLAT_FRACTION * 2 * math.prod(lattice.counts.tolist()):
        return
    probes = points[:: -(-len(points) // _MAX_PROBES)]
    fraction = float(function.is_on_level(probes).mean())
    if fraction > _MAX_FLAT_FRACTION:
        raise UnrefinableError(
            f"{type(function.field).__name__} is {function.level:g}, up to rounding, at "
            f"{fraction:.0%} of the points looked at: its level there is a volume and no surface; "
            "choose another level"
        )


@dataclass(frozen=True)
class _InitialMesh:
    """Vertices and faces before refinement, and the points of the tetrahedra, with points near the
    level moved onto it; rows: (k,) the tetrahedra that the level may pass through between points,
    and crossed: (k,) whether it does; ends: (j, 2) points at the ends of the edges on which the
    other vertices lie."""

    vertices: FloatArray
    faces: IntArray
    points: TetrahedronPoints
    rows: IntArray
    crossed: BoolArray
    ends: IntArray

    def is_cut(self, corners: IntArray) -> BoolArray:
        """(m,) which of all tetrahedra, given by their corners (m, 4), hold points of the faces."""
        cut = _have_any(self.points.is_on_level, corners)
        cut[self.rows] |= self.crossed
        return cut

    def is_beside(self, mask: BoolArray) -> BoolArray:
        """Whether each vertex is one of the chosen points, or on an edge that ends there."""
        return np.concatenate([mask, mask[self.ends].any(axis=1)])


def _march(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    corners: IntArray,
    is_fixed: BoolArray,
    is_wall: BoolArray,
    lattice: BccLattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> _InitialMesh:
    """Vertices and faces of a manifold, with points near the level moved onto it.

    is_fixed: (n,) which points are not moved. is_wall: (n,) which points count as on the level.
    """
    at_rest, original = points, samples
    points, samples, is_on = _snap_points(function, points, samples, is_fixed, lattice, walls)
    is_on |= is_wall
    touching, is_affected = np.zeros(0, np.int64), np.ones(len(points), np.bool_)
    rows = cut_rows = np.flatnonzero(_may_be_cut(samples.value, is_on, corners))
    for _ in range(_MAX_ROUNDS):
        sampled, tets = (
            TetrahedronPoints(points, is_on, samples),
            Tetrahedra.of(points, corners[rows]),
        )
        crossings = count_crossings(function, sampled, tets)
        # The positions of vertices on edges do not matter for whether parts touch.
        _, faces = extract_triangles(function, sampled, tets, crossings, _middles)
        touching = nonmanifold_vertices(faces)
        touching = touching[touching < len(points)]
        touching = touching[(is_affected & ~is_wall)[touching]]
        if not len(touching):
            break
        points, is_on = points.copy(), is_on.copy()
        points[touching], is_on[touching] = at_rest[touching], False
        samples = samples.replaced(touching, original.select(touching))
        # Parts may touch anew only at points beside these: they are examined with all of their
        # tetrahedra.
        near, is_affected = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
        near[touching] = True
        is_affected[corners[_have_any(near, corners)]] = True
        affected = np.flatnonzero(_have_any(is_affected, corners))
        rows = affected[_may_be_cut(samples.value, is_on, corners[affected])]
        cut_rows = np.concatenate([cut_rows, rows])
    else:
        raise MeshingError(
            f"sheets of the level set touch at {len(touching)} places: choose a smaller `cell_size`"
        )
    # Other tetrahedra have the same points as before.
    rows = sorted_unique(cut_rows)
    rows = rows[_may_be_cut(samples.value, is_on, corners[rows])]
    sampled, tets = TetrahedronPoints(points, is_on, samples), Tetrahedra.of(points, corners[rows])
    crossings = count_crossings(function, sampled, tets)
    vertices, faces = extract_triangles(function, sampled, tets, crossings)
    crossed: BoolArray = np.asarray((crossings.count[tets.edges] != 0).any(axis=1))
    ends = tets.ends[np.flatnonzero(crossings.count)]
    return _InitialMesh(vertices, faces, sampled, rows, crossed, ends)


def _middles(low: FloatArray, high: FloatArray) -> FloatArray:
    return 0.5 * (low + high)


def _snap_points(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    is_fixed: BoolArray,
    lattice: BccLattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, LevelSamples, BoolArray]:
    """The points, with points near the level moved onto it; their samples; and which are on the
    level."""
    size = float(lattice.size.min())
    near = np.flatnonzero((samples.distance < _SNAPPED * size) & ~is_fixed)
    longest = np.full(len(near), 0.5 * _SNAPPED * size)
    moved = newton_to_level(function, points[near], samples.select(near), longest, walls, steps=4)
    new_samples = function.sample(moved)
    apart = row_norms(moved - points[near])
    steep = row_norms(new_samples.gradient)
    converged = np.abs(new_samples.value) < 1e-9 * np.maximum(steep * size, 1e-300)
    converged &= apart < 1.2 * _SNAPPED * size
    rows = near[converged]
    # A point with a value of exactly 0 counts as on the level unmoved, so that all other points
    # have a sign.
    points, is_on = points.copy(), (samples.value == 0) & ~is_fixed
    points[rows], is_on[rows] = moved[converged], True
    return points, samples.replaced(rows, new_samples.select(converged)), is_on


def _have_any(chosen: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) which tetrahedra (m, 4) have a chosen point."""
    has_chosen = np.zeros(len(corners), np.bool_)
    for column in corners.T:  # four times as fast as chosen[corners].any(axis=1)
        has_chosen |= chosen[column]
    return has_chosen


# Codes of a point above the level, below it, and on it: a sum of four codes tells how many points
# there are of each kind.
_ABOVE, _BELOW, _ON_LEVEL = 1, 5, 25


def _may_be_cut(value: FloatArray, is_on: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) whether the level may pass through tetrahedra (m, 4)."""
    kind = np.where(is_on, _ON_LEVEL, np.where(value > 0, _ABOVE, _BELOW)).astype(np.uint8)
    sums = np.zeros(len(corners), np.uint8)
    for column in corners.T:
        sums += kind[column]
    cut = np.zeros(4 * _ON_LEVEL + 1, np.bool_)
    for above, below in itertools.product(range(5), repeat=2):
        on = 4 - above - below
        if on >= 0:
            cut[above * _ABOVE + below * _BELOW + on * _ON_LEVEL] = (above and below) or on >= 3
    return cut[sums]
