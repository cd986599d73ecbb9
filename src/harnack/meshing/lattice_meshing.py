"""Meshes of level sets of real-valued functions (without a period), made in the tetrahedra of a
lattice, and checks of these meshes.

Points of the lattice near the level set are moved onto it and become vertices, which removes most
slivers (Labelle and Shewchuk 2007). If parts of the surface then touch in a vertex or an edge,
points are moved back until no parts touch. If no point is moved onto the level set, the surface is
a manifold: every tetrahedron is cut by at most one triangle or quadrilateral, which the signs at
its corners determine.
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

# Distances in cells, for the search of missed parts. A lattice point is moved onto the level set if
# its estimated distance from it is less than the first. The result counts if the move is less than
# the second, if the moved point is farther than the third from the corners and centers of all
# triangles (no point of a triangle is half a cell or more from these), and if it is farther than
# the fourth from the faces of the box, as the surface may continue outside of the box.
_MAX_SEED_DISTANCE, _MAX_SEED_MOVE, _MIN_MESH_DISTANCE, _MIN_WALL_DISTANCE = 1.0, 1.5, 0.75, 0.5
# In cells: points closer to each other than the first belong to one part; a part at least as long
# as the second counts as missed.
_CLUSTER_DISTANCE, _MIN_MISSED_LENGTH = 1.0, 2.0
# In cells: parts thinner than the first are missed nearly everywhere; thicknesses below the second
# are not told apart.
_HOPELESS_THICKNESS, _MIN_THICKNESS = 0.25, 2.0**-7
# The largest distance from the level set, in cells, of a point that Newton's method moved onto it.
_ON_LEVEL_DISTANCE = 1e-3
# Where Newton's method has not converged but the distance fell below this multiple of the distance
# at the start, it may be converging slowly, to a multiple root.
_SLOW_CONVERGENCE = 0.7
# The test for a function that touches its level: the largest number of points; how far beside
# them, in cells, the function is evaluated; the number of golden sections and their ratio; and how
# close to the level the function has to come, relative to its values beside the point.
_MAX_TRIED, _TOUCH_OFFSET, _SECTIONS, _GOLDEN, _TOUCHING = 60, 0.01, 40, 0.6180339887498949, 1e-8
# A function jumps if more than the first, a fraction of the vertices, are farther than the second,
# in cells, from the level set.
_MAX_JUMP_SHARE, _JUMP_DISTANCE = 0.04, 0.1
# A function that equals its level at more than this fraction of points has no surface there; and
# about how many points are tested.
_MAX_FLAT_SHARE, _MOST_PROBES = 0.75, 2000
# The level set is a volume if the function equals its level at this distance, in cells, from points
# of the level set in all directions.
_FLAT_RADIUS = 0.25


class MissedPartsError(MeshingError):
    """A level set has parts between the points of a lattice, which the mesh therefore misses.

    places: (k, 3) points on the level set, in the longest missed part.
    thickness: (k,) thicknesses of the part at these points, lengths: 2^-7, 2^-6, ..., 1 cells; 0 if
        the part is thinner, inf if it is thicker than a cell.
    size: the size of a cell, a length."""

    def __init__(
        self, message: str, places: FloatArray, thickness: FloatArray, size: float
    ) -> None:
        super().__init__(message)
        self.places, self.thickness, self.size = places, thickness, size

    def may_be_fixed_by(self, smaller: float) -> bool:
        """Whether smaller cells may find the missed part. smaller: the size of the smaller cells,
        as a fraction of `size`.

        They cannot if they too would miss a part that is at least two of the smaller cells long and
        thinner than a quarter of such a cell. Such a part is beside a cusp or the tip of a cone,
        and no size of cells resolves it."""
        thin_places = self.places[self.thickness < _HOPELESS_THICKNESS * smaller * self.size]
        part = _longest_part(thin_places, _CLUSTER_DISTANCE * self.size)
        length = float(np.ptp(part, axis=0).max()) if len(part) else 0.0
        return length < _MIN_MISSED_LENGTH * smaller * self.size


def check_no_missed_parts(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    is_beside: BoolArray,
    surface: tuple[FloatArray, IntArray],
    size: float,
    box: tuple[FloatArray, FloatArray],
    elsewhere: Clearance | None = None,
) -> None:
    """Raise an error if the mesh of a level set misses parts of it that are at least two cells
    long: thin walls, sharp edges, islands.

    points, samples: points (n, 3) of a lattice, and samples of the function at them.
    is_beside: (n,) whether each point is a corner of a tetrahedron that the mesh cuts.
    surface: the vertices and faces of the mesh.
    size: the size of a cell, a length.
    box: the lower and the upper corner (3,) of the box in which the level set counts.
    elsewhere: the radius of a ball around each point within which the level set does not count.

    The signs at the points of a lattice do not show a wall between two points. Newton's method,
    started at points beside the wall, finds the sides of the wall: it ends on the level set, where
    there should be triangles nearby. These end points are a dense sample, but no proof. Islands
    smaller than a cell may be missed.

    Raises:
        MissedPartsError: parts are missed; it has points of the longest part.
        UnrefinableError: the function equals its level in a volume, or touches it along a surface.
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
    on_level = end_samples.distance < _ON_LEVEL_DISTANCE * size
    slow = ~on_level & (end_samples.distance < _SLOW_CONVERGENCE * samples.distance[rows])
    if slow.any():
        x[slow] = to_multiple_roots(function, x[slow], end_samples.select(slow), step[slow])
        on_level[slow] = function.sample(x[slow]).distance < _ON_LEVEL_DISTANCE * size
    on_level &= row_norms(x - start) < _MAX_SEED_MOVE * size
    deep = _MIN_WALL_DISTANCE * size
    on_level &= ((x >= box[0] + deep) & (x <= box[1] - deep)).all(axis=1)
    x = x[on_level]
    vertices, faces = surface
    if len(faces) and len(x):
        mesh_points = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
        x = x[searching.cKDTree(mesh_points).query(x)[0] > _MIN_MESH_DISTANCE * size]
    if elsewhere is not None and len(x):
        x = x[elsewhere(x) <= 0]
    part = _longest_part(x, _CLUSTER_DISTANCE * size)
    if len(part) and np.ptp(part, axis=0).max() >= _MIN_MISSED_LENGTH * size:
        _check_off_level_around(function, part, _FLAT_RADIUS * size)
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
    """(k,) the thickness, a length, of the part of the solid or of the gap at points x (k, 3) on
    the level set.

    It is the distance to the next change of sign along the gradient or against it, the smaller of
    both, among distances 2^-7, 2^-6, ..., 1 times `size`. It is 0 where the sign is the same on
    both sides of the point at the smallest distance, and inf where the sign does not change again.
    """
    gradient = function.sample(x).gradient
    direction = gradient / np.maximum(row_norms(gradient), 1e-300)[:, None]
    distances = size * 2.0 ** np.arange(round(math.log2(_MIN_THICKNESS)), 1)
    nearest_is_above: list[BoolArray] = []
    thickness = np.full(len(x), np.inf)
    for sign in (1.0, -1.0):
        probes = x[:, None] + sign * distances[:, None] * direction[:, None]
        is_above = function.values(probes.reshape(-1, 3)).reshape(len(x), len(distances)) > 0
        changed = is_above != is_above[:, :1]
        first_change = distances[changed.argmax(axis=1)]
        thickness = np.minimum(thickness, np.where(changed.any(axis=1), first_change, np.inf))
        nearest_is_above.append(is_above[:, 0])
    return np.where(nearest_is_above[0] == nearest_is_above[1], 0.0, thickness)


def _check_off_level_around(function: LevelFunction, points: FloatArray, radius: float) -> None:
    """Raise if the function equals its level in a volume, as max(x, 0) does for level 0, so that no
    cells are small enough.

    That is so if, for most of `points` (n, 3), it equals the level up to rounding at the point and
    at distance `radius` from it in all six axis directions."""
    probes = points[:: -(-len(points) // _MOST_PROBES)]
    offsets = radius * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    near_points = (probes[:, None] + offsets).reshape(-1, 3)
    is_flat = function.is_on_level(near_points).reshape(len(probes), -1).all(axis=1)
    if is_flat.mean() > 0.5:
        a, b, c = probes[is_flat][0]
        raise UnrefinableError(
            f"{type(function.field).__name__} is {function.level:g}, up to rounding, at and around "
            f"points such as ({a:.4g}, {b:.4g}, {c:.4g}): its level there is a volume and no "
            "surface; choose another level"
        )


def _check_passes_level(function: LevelFunction, points: FloatArray, size: float) -> None:
    """Raise UnrefinableError if the function only touches its level, without changing sign, at more
    than half of `points` (n, 3), which are near the level set. A square does so, and signs at the
    corners of cells never show it.

    The function is examined along a line through each point, in the direction of its gradient
    beside the point (at the point it may be 0), up to a hundredth of a cell of size `size` away.
    The function touches its level if both ends of the line have values on the same side of the
    level, and its value closest to the level, found by golden sections, is as close to it as
    rounding allows."""
    x = points[:: -(-len(points) // _MAX_TRIED)]
    offset = _TOUCH_OFFSET * size
    gradients = function.sample((x[:, None] + offset * np.eye(3)).reshape(-1, 3)).gradient.reshape(
        -1, 3, 3
    )
    steepest = gradients[np.arange(len(x)), (gradients**2).sum(axis=2).argmax(axis=1)]
    direction = steepest / np.maximum(row_norms(steepest), 1e-300)[:, None]

    def along(s: FloatArray) -> FloatArray:
        """The function on the lines at the signed distances s (k,) from the points x."""
        return function.values(x + s[:, None] * direction)

    low, high = np.full(len(x), -offset), np.full(len(x), offset)
    sign_of_point = np.sign(along(low))
    end_value = np.minimum(sign_of_point * along(low), sign_of_point * along(high))
    smallest = end_value.copy()
    for _ in range(_SECTIONS):
        s, t = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        f_left, f_right = sign_of_point * along(s), sign_of_point * along(t)
        smallest = np.minimum(smallest, np.minimum(f_left, f_right))
        low, high = np.where(f_left > f_right, s, low), np.where(f_left > f_right, high, t)
    touches = (end_value > 0) & (smallest >= 0) & (smallest <= _TOUCHING * end_value)
    if touches.mean() > 0.5:
        a, b, c = x[touches][0]
        name, level = type(function.field).__name__, function.level
        raise UnrefinableError(
            f"{name} comes to {level:g} without passing it, as a square does, at points such as "
            f"({a:.4g}, {b:.4g}, {c:.4g}): the surface there has one side only and no mesh finds "
            "it. Give a function that changes its sign there, such as u instead of u^2, or mesh a "
            f"thin wall, such as hk.solid(f, between=({level:g} - t, {level:g} + t)) with a small t"
        )


def _longest_part(x: FloatArray, max_gap: float) -> FloatArray:
    """Group points x (n, 3) into connected parts, and return the points (k, 3) of the part with the
    longest bounding box.

    Two points belong to one part if a chain of points with gaps of at most `max_gap` connects them.
    """
    if not len(x):
        return x
    part = connected_groups(pairs_within(x, max_gap), len(x))
    count = int(part.max()) + 1
    lower, upper = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(lower, part, x)
    np.maximum.at(upper, part, x)
    return x[part == (upper - lower).max(axis=1).argmax()]


def check_estimated_triangles(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> None:
    """Raise an error if refining the mesh to the tolerance would, by an estimate, make more
    triangles than `function.most_faces`.

    The distance of the midpoints of a triangle's edges from the surface falls with the triangle's
    area. So a triangle with a distance of k tolerances is refined to about k triangles. A selection
    of triangles is examined.

    Raises:
        MeshingError: the gradient is 0 at the midpoint of an edge.
        TriangleLimitError: the estimate exceeds the limit. The message says which tolerance would
            be possible.
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
_SNAP_DISTANCE = 0.25
# The width, in cells, of the border around relevant cells that is meshed as well.
_BORDER = 2.0
# The number of cells along an edge of a block.
_BLOCK = 8
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh.

    vertices: (n, 3).
    faces: (m, 3) the indices of the vertices of each face, counter-clockwise as seen from the
        outside, where the meshed function is larger."""

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
    """A region of space in which a surface need not be meshed, because it will be cut away by the
    other solids with which the meshed solid is intersected.

    clearance: a function from points (k, 3) to radii (k,) of balls around them that lie in the
        region; 0 for points outside of it.
    cached_cells: for each lattice, the indices of the cells that are not proved to lie in the
        region."""

    clearance: Clearance
    cached_cells: dict[tuple[float, ...], IntArray] = dataclasses.field(
        default_factory=dict[tuple[float, ...], IntArray]
    )

    def relevant_cells(self, lattice: BccLattice, max_triangles: int) -> IntArray:
        """The indices (n, 3) of the cells that are not proved to lie in the region, and of cells
        around them, in a border two cells wide. max_triangles: the largest number of triangles.

        Raises:
            TriangleLimitError: there are more such cells than a mesh of `max_triangles` triangles
                may have.
        """
        key = (
            *lattice.lower.tolist(),
            *lattice.size.tolist(),
            *lattice.counts.tolist(),
            max_triangles,
        )
        if key not in self.cached_cells:
            border = _BORDER * float(lattice.size.max())
            self.cached_cells[key] = lattice.nonempty_cells(
                lambda points: self.clearance(points) - border, max_triangles
            )
        return self.cached_cells[key]


def mesh_open_surface(
    function: LevelFunction, lattice: BccLattice, tolerance: float, report: Callable[[str], None]
) -> tuple[TriangleMesh, IsotopyCoverage]:
    """Mesh the level set in the box of a lattice; the mesh ends on the faces of the box.

    tolerance: a length, the largest distance of the midpoints of edges and of the centers of faces
        from the level set.

    Returns:
        The mesh; and on which part of the tetrahedra the topology of the mesh before refinement is
        proved.

    Raises:
        MeshingError: the level set does not meet the box, or there are too many cells.
        UnrefinableError: the function is not finite somewhere, or its level set is a volume.
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
    elsewhere: IrrelevantRegion | None = None,
) -> TriangleMesh:
    """Mesh the boundary of the points in a lattice's box at which the function is negative.

    On the faces of the box, the boundary consists of faces of the cells whose centers are negative,
    as if the lattice points there were on the level. Triangles in the two outermost layers of cells
    are coarse and may touch in vertices: the caller cuts them away. The mesh has no faces if the
    function is negative nowhere.

    tolerance: a length, the largest distance of the midpoints of edges and of the centers of faces
        from the level set.
    as_cut: whether to return the triangles as they were made in the cells, so that they never pass
        through each other: they are not refined, and parts between lattice points are missed. This
        is for functions with creases everywhere, such as distances from meshes, in cells of about
        the tolerance.
    elsewhere: a region in which the surface does not matter. In the region, except for a few cells
        at its border, the function counts as positive, and coarse triangles close the surface
        there.

    Raises:
        MeshingError: there are too many cells.
    """
    limit, does_matter = function.most_faces, None
    if elsewhere is None:
        cells = lattice.nonempty_cells(function.clearance, limit)
    else:
        cells, does_matter = lattice.relevant_cells(
            function.clearance, elsewhere.relevant_cells(lattice, limit), function.values, limit
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
        None if elsewhere is None else elsewhere.clearance,
    )  # fmt: skip
    # Triangles that end at the outermost cells are moved and cut, their ends are not.
    if len(rest):
        _check_is_continuous(function, vertices, rest, lattice)
        check_estimated_triangles(function, vertices, rest, tolerance)
        vertices = smooth(function, vertices, rest, None)
        counts = _refinable_points(lattice, does_matter)
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
    """Cut those faces into three whose center is farther than `farthest` (a length) from the level
    set, as happens across a crease. Returns the new mesh.

    The new vertex is the face's center, moved onto the level set. The new faces are examined in the
    same way, so that a face is cut up to `times` times. All edges stay."""
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
    """(k,) whether the function is at most 0 at the centers of cells with indices (k, 3).

    Cells are grouped in blocks. If the level set is proved not to enter a block, the sign at the
    block's center holds for all of its cells."""
    shape = lattice.counts // _BLOCK + 1
    x, y, z = (cells // _BLOCK).T
    keys, block_of_cell, _, _ = unique_with_inverse((x * shape[1] + y) * shape[2] + z)
    xy, z = np.divmod(keys, shape[2])
    blocks = np.stack([*np.divmod(xy, shape[1]), z], axis=1)
    centers = lattice.points(_BLOCK * (2 * blocks + 1))
    half_diagonal = 0.5 * _BLOCK * float(np.linalg.norm(lattice.size))
    is_one_sided = function.clearance(centers) > half_diagonal * (1 + 1e-9)
    negative = (function.values(centers) <= 0)[block_of_cell]
    undecided = np.flatnonzero(~is_one_sided[block_of_cell])
    negative[undecided] = function.values(lattice.points(2 * cells[undecided] + 1)) <= 0
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
    """Raise MissedPartsError if the mesh misses parts of the level set that are at least two cells
    long. The points from which they are searched are found here; `check_no_missed_parts` does the
    search.

    points, samples: points (n, 3) of the lattice, and samples of the function at them.
    corners: (m, 4) the corners of all tetrahedra.
    first: the mesh before refinement.
    faces: the faces of it that count.
    box: the lower and the upper corner of the box where the level set counts.
    elsewhere: gives for points the radii of balls around them in which the level set does not
        count; None if it counts everywhere."""
    signs = np.where(first.points.is_on_level, 0.0, np.sign(first.points.samples.value))[corners]
    is_beside = np.zeros(len(points), np.bool_)
    is_beside[corners[(signs.min(axis=1) < 0) & (signs.max(axis=1) > 0)]] = True
    surface = first.vertices, faces
    size = float(lattice.size.max())
    check_no_missed_parts(function, points, samples, is_beside, surface, size, box, elsewhere)


def _refinable_points(
    lattice: BccLattice, does_matter: BoolArray | None
) -> Callable[[FloatArray], BoolArray]:
    """Make a function from points (n, 3) to a mask (n,): whether triangles may be refined at each
    point.

    These points are farther than one and a half cells from the faces of the box, and neither in an
    irrelevant cell nor in a cell beside one. does_matter: the mask of the relevant cells, one entry
    for each cell of the lattice; None if all are relevant.

    Triangles that end in the outermost layer of cells are not refined: refinement would never end,
    since the edges at their ends stay as they are. The centers of these triangles are less than one
    and a half cells from the faces of the box."""
    lower, upper = lattice.lower + 1.5 * lattice.size, lattice.upper - 1.5 * lattice.size
    deep = None if does_matter is None else lattice.interior_cells(does_matter)

    def counts(points: FloatArray) -> BoolArray:
        """(n,) whether triangles may be refined at points (n, 3)."""
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
    """Faces (m, 3) of tetrahedra that lie on the faces of the box and cover the negative part of
    it.

    corners: (k, 4) the indices of the corners of each tetrahedron.
    is_wall: (n,) the mask of the points on the faces of the box.

    A tetrahedron has such a face if exactly three of its corners are on the box and the function is
    at most 0 at the fourth. The faces are counter-clockwise as seen from outside of the box."""
    on_wall = is_wall[corners]
    with_wall_face = np.flatnonzero(on_wall.sum(axis=1) == 3)
    order = np.argsort(on_wall[with_wall_face], axis=1, kind="stable")  # the fourth corner first
    apex, *base = np.take_along_axis(corners[with_wall_face], order, axis=1).T
    is_negative = samples.value[apex] <= 0
    face, apex = np.stack(base, axis=1)[is_negative], apex[is_negative]
    a, b, c = (points[face[:, k]] for k in range(3))
    faces_inwards = (np.cross(b - a, c - a) * (points[apex] - a)).sum(axis=1) > 0
    face[faces_inwards] = face[faces_inwards][:, ::-1]
    return face


def _sample_lattice(
    function: LevelFunction, points: FloatArray, lattice: BccLattice, is_irrelevant: BoolArray
) -> LevelSamples:
    """Samples of the function at points (n, 3) of a lattice. Points in the mask `is_irrelevant`
    (n,) get a large positive value instead.

    Raises:
        UnrefinableError: the function is not finite at a point, or equals its level nearly
            everywhere.
    """
    count = len(points)
    samples = LevelSamples(np.full(count, 10 * OUTSIDE_VALUE), np.ones((count, 3)), np.zeros(count))
    points = points[~is_irrelevant]
    samples = samples.replaced(~is_irrelevant, function.sample(points))
    fails = ~np.isfinite(samples.value[~is_irrelevant])
    if fails.any():
        x, y, z = points[fails][0]
        advice = ", or a smaller `cell_size`: it is asked for three cells around other parts"
        raise UnrefinableError(
            f"{type(function.field).__name__} has no finite value at {fails.sum():,} points, such "
            f"as ({x:.4g}, {y:.4g}, {z:.4g}): choose a `clip` where it has"
            + (advice if is_irrelevant.any() else "")
        )
    _check_off_level_at_most_points(function, points, lattice)
    return samples


def _check_is_continuous(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, lattice: BccLattice
) -> None:
    """Raise UnrefinableError if many vertices are far from the level set. The function changes its
    sign at every vertex, so it jumps at these, and refinement would never end."""
    x = vertices[np.unique(faces)]
    is_far = function.sample(x).distance > _JUMP_DISTANCE * float(lattice.size.max())
    if is_far.sum() > _MAX_JUMP_SHARE * len(x):
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
    """Raise UnrefinableError if the function equals its level, up to rounding, at more than three
    quarters of the points (n, 3), as x - x does for level 0. No cells of such a function are proved
    empty, however small they are."""
    if len(points) <= _MAX_FLAT_SHARE * 2 * math.prod(lattice.counts.tolist()):
        return
    probes = points[:: -(-len(points) // _MOST_PROBES)]
    fraction = float(function.is_on_level(probes).mean())
    if fraction > _MAX_FLAT_SHARE:
        raise UnrefinableError(
            f"{type(function.field).__name__} is {function.level:g}, up to rounding, at "
            f"{fraction:.0%} of the points looked at: its level there is a volume and no surface; "
            "choose another level"
        )


@dataclass(frozen=True)
class _InitialMesh:
    """A mesh before refinement, and the tetrahedra that it was made in.

    vertices, faces: (n, 3), (m, 3). The first vertices are the points of the tetrahedra; the others
        lie on edges that the level set crosses.
    points: the points of the tetrahedra; points near the level set were moved onto it.
    rows: (k,) the indices of the tetrahedra that the level set may pass through.
    crossed: (k,) for each of these tetrahedra, whether the level set crosses one of its edges.
    ends: (j, 2) the indices of the two end points of each edge that the level set crosses."""

    vertices: FloatArray
    faces: IntArray
    points: TetrahedronPoints
    rows: IntArray
    crossed: BoolArray
    ends: IntArray

    def is_cut(self, corners: IntArray) -> BoolArray:
        """(m,) whether each of all tetrahedra, given by the indices of their corners (m, 4),
        contains a point of a face of the mesh."""
        cut = _have_any(self.points.is_on_level, corners)
        cut[self.rows] |= self.crossed
        return cut

    def is_beside(self, chosen: BoolArray) -> BoolArray:
        """(n,) whether each vertex is a chosen point, or lies on an edge with a chosen end. chosen:
        a mask of the points."""
        return np.concatenate([chosen, chosen[self.ends].any(axis=1)])


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
    """The mesh before refinement, a manifold, with points near the level set moved onto it.

    Where parts of the surface touch in a moved point, the point is moved back to its original
    position, until no parts touch.

    points, samples: points (n, 3) of the lattice, and samples of the function at them.
    corners: (m, 4) the indices of the corners of each tetrahedron.
    is_fixed: (n,) the mask of the points that must not be moved.
    is_wall: (n,) the mask of the points that count as on the level.
    walls: the lower and the upper corner of the box, on whose faces points stay; or None.

    Raises:
        MeshingError: parts still touch after 20 rounds.
    """
    original_points, original_samples = points, samples
    points, samples, is_on = _snap_points(function, points, samples, is_fixed, lattice, walls)
    is_on |= is_wall
    touching, is_affected = np.zeros(0, np.int64), np.ones(len(points), np.bool_)
    rows = cut_rows = np.flatnonzero(_may_be_cut(samples.value, is_on, corners))
    for _ in range(_MOST_ROUNDS):
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
        points[touching], is_on[touching] = original_points[touching], False
        samples = samples.replaced(touching, original_samples.select(touching))
        # Parts may touch anew only at points beside these: they are examined with all of their
        # tetrahedra.
        near, is_affected = (np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_))
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
    """The midpoints of the edges from `low` to `high`, both (k, 3)."""
    return 0.5 * (low + high)


def _snap_points(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    is_fixed: BoolArray,
    lattice: BccLattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, LevelSamples, BoolArray]:
    """Move points near the level set onto it.

    Points are moved if their estimated distance from the level set is less than a quarter of a cell
    and they are not in the mask `is_fixed` (n,). A point whose move does not converge stays where
    it is.

    Returns:
        The points (n, 3); samples of the function at them; and the mask (n,) of the points on the
        level set.
    """
    size = float(lattice.size.min())
    near = np.flatnonzero((samples.distance < _SNAP_DISTANCE * size) & ~is_fixed)
    max_step = np.full(len(near), 0.5 * _SNAP_DISTANCE * size)
    moved = newton_to_level(function, points[near], samples.select(near), max_step, walls, steps=4)
    new_samples = function.sample(moved)
    move = row_norms(moved - points[near])
    gradient_length = row_norms(new_samples.gradient)
    converged = np.abs(new_samples.value) < 1e-9 * np.maximum(gradient_length * size, 1e-300)
    converged &= move < 1.2 * _SNAP_DISTANCE * size
    rows = near[converged]
    # A point with a value of exactly 0 counts as on the level unmoved, so that all other points
    # have a sign.
    points, is_on = points.copy(), (samples.value == 0) & ~is_fixed
    points[rows], is_on[rows] = moved[converged], True
    return points, samples.replaced(rows, new_samples.select(converged)), is_on


def _have_any(chosen: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) whether each tetrahedron, given by the indices of its corners (m, 4), has a corner in
    the mask `chosen` (n,) of points."""
    has_chosen = np.zeros(len(corners), np.bool_)
    for column in corners.T:  # four times as fast as chosen[corners].any(axis=1)
        has_chosen |= chosen[column]
    return has_chosen


# Codes of a point above the level, below it, and on it: a sum of four codes tells how many points
# there are of each kind.
_ABOVE, _BELOW, _ON_LEVEL = 1, 5, 25


def _may_be_cut(value: FloatArray, is_on: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) whether the level set may pass through each tetrahedron, given by the indices of its
    corners (m, 4): the tetrahedron has corners on both sides of the level set, or at least three
    corners on it.

    value: (n,) the function at the points.
    is_on: (n,) whether each point is on the level set."""
    code = np.where(is_on, _ON_LEVEL, np.where(value > 0, _ABOVE, _BELOW)).astype(np.uint8)
    code_sum = np.zeros(len(corners), np.uint8)
    for column in corners.T:
        code_sum += code[column]
    cut = np.zeros(4 * _ON_LEVEL + 1, np.bool_)
    for above, below in itertools.product(range(5), repeat=2):
        on = 4 - above - below
        if on >= 0:
            cut[above * _ABOVE + below * _BELOW + on * _ON_LEVEL] = (above and below) or on >= 3
    return cut[code_sum]
