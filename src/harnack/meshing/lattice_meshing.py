"""Meshes the level set of a real-valued function: a lattice divides a box into tetrahedra, and the
level set cuts these into triangles. Also checks of these meshes. "The function" is a
`LevelFunction`: a field minus its level, so the surface is where it is 0. A "cell" is a cube of the
lattice. A "sample" is the function's value, gradient and estimated distance from the level set at a
point.

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
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import BoolArray, FloatArray, IntArray
from harnack.geometry.mesh_edges import (
    row_norms,
    sorted_unique,
    unique_with_inverse,
    unit_rows,
)
from harnack.geometry.neighborhoods import connected_groups, kd_tree, pairs_within
from harnack.meshing.bcc_lattice import BccLattice, distinct_rows
from harnack.meshing.checks import nonmanifold_vertices
from harnack.meshing.delaunay_points import (
    BoundaryCurve,
    TetrahedronPoints,
    newton_to_level,
    snap_to_level,
    to_multiple_roots,
)
from harnack.meshing.isotopy import IsotopyCoverage, isotopy_of
from harnack.meshing.level_function import LevelFunction, LevelSamples
from harnack.meshing.marching_tetrahedra import (
    OUTSIDE_VALUE,
    Tetrahedra,
    count_crossings,
    extract_triangles,
)
from harnack.meshing.meshing_errors import MeshingError, TriangleLimitError, UnrefinableError
from harnack.meshing.refinement import fan_faces, refine, smooth, smooth_within_tolerance
from harnack.meshing.triangle_mesh import TriangleMesh

if TYPE_CHECKING:
    from harnack.tree.empty_space import Clearance

__all__ = [
    "IrrelevantRegion",
    "MissedPartsError",
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
    """The error for a level set with parts that the mesh misses, because they pass between the
    points of the lattice, as a wall thinner than a cell does. `places` are points of the longest
    missed part, `thickness` is how thick it is at each of them, and `size` is the size of a cell.

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
        """Whether a lattice of smaller cells may find the missed part. smaller: the size of the
        smaller cells, as a fraction of `size`.

        It cannot if the part is thinner than a quarter of a smaller cell over a length of at least
        two smaller cells: then the smaller cells miss a part, too. Such a part is beside a cusp or
        the tip of a cone, and no size of cells resolves it."""
        thin_places = self.places[self.thickness < _HOPELESS_THICKNESS * smaller * self.size]
        longest_thin_part = _longest_part(thin_places, _CLUSTER_DISTANCE * self.size)
        length = float(np.ptp(longest_thin_part, axis=0).max()) if len(longest_thin_part) else 0.0
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
    is_beside: (n,) whether each point is a corner of a tetrahedron that the mesh cuts. The search
        starts only at other points.
    surface: the vertices and faces of the mesh.
    size: the size of a cell, a length.
    box: the lower and the upper corner (3,) of the box outside of which nothing counts as missed.
    elsewhere: a function that gives, for points (k, 3), the radius (k,) of a ball around each
        within which nothing counts as missed (0: the point counts); None if all points count.

    The signs at the points of a lattice do not show a wall between two points. Newton's method,
    started at points beside the wall, finds the sides of the wall: it ends on the level set, where
    there should be triangles nearby. These end points are a dense sample, but no proof. Islands
    smaller than a cell may be missed.

    Raises:
        MissedPartsError: parts are missed; it has points of the longest part.
        UnrefinableError: the function equals its level in a volume, or touches it along a surface.
    """
    rows = np.flatnonzero(~is_beside & (samples.distance < _MAX_SEED_DISTANCE * size))
    if not len(rows):
        return
    start = points[rows]
    max_step = np.full(len(rows), 0.5 * size)
    # Move points that are less than a cell from the level set onto it (None: there are no walls).
    x = newton_to_level(function, start, samples.select(rows), max_step, None)
    end_samples = function.sample(x)
    is_on_level = end_samples.distance < _ON_LEVEL_DISTANCE * size
    # Slow convergence hints at a multiple root, for which another iteration is faster.
    is_slow = ~is_on_level & (end_samples.distance < _SLOW_CONVERGENCE * samples.distance[rows])
    if is_slow.any():
        x[is_slow] = to_multiple_roots(
            function, x[is_slow], end_samples.select(is_slow), max_step[is_slow]
        )
        is_on_level[is_slow] = function.sample(x[is_slow]).distance < _ON_LEVEL_DISTANCE * size
    # Points count only if they moved little and do not lie beside a face of the box.
    is_on_level &= row_norms(x - start) < _MAX_SEED_MOVE * size
    wall_distance = _MIN_WALL_DISTANCE * size
    is_on_level &= ((x >= box[0] + wall_distance) & (x <= box[1] - wall_distance)).all(axis=1)
    x = x[is_on_level]
    vertices, faces = surface
    # Keep the points that are far from the mesh: near them, triangles are missing.
    if len(faces) and len(x):
        mesh_points = np.concatenate([vertices[np.unique(faces)], vertices[faces].mean(axis=1)])
        # (`query` returns distances and indices.)
        x = x[kd_tree(mesh_points).query(x)[0] > _MIN_MESH_DISTANCE * size]
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
    """(k,) how thick the function's region of one sign is beside each of the points x (k, 3) on the
    level set: a length. A thin wall and a thin gap count alike.

    It is the distance to the next change of sign along the gradient or against it, the smaller of
    both, among the distances 2^-7, 2^-6, ..., 1 times `size`. It is 0 if the sign is the same on
    both sides of the point at the smallest distance: the region is thinner than that. It is inf if
    the sign does not change again."""
    gradient = function.sample(x).gradient
    direction = unit_rows(gradient)
    distances = size * 2.0 ** np.arange(round(math.log2(_MIN_THICKNESS)), 1)
    nearest_is_above: list[BoolArray] = []
    thickness = np.full(len(x), np.inf)
    for sign in (1.0, -1.0):
        # Signs at all distances, (k, number of distances).
        probes = x[:, None] + sign * distances[:, None] * direction[:, None]
        is_above = function.values(probes.reshape(-1, 3)).reshape(len(x), len(distances)) > 0
        # The first distance with another sign than the smallest one.
        changed = is_above != is_above[:, :1]
        first_change = distances[changed.argmax(axis=1)]
        thickness = np.minimum(thickness, np.where(changed.any(axis=1), first_change, np.inf))
        nearest_is_above.append(is_above[:, 0])
    return np.where(nearest_is_above[0] == nearest_is_above[1], 0.0, thickness)


def _check_off_level_around(function: LevelFunction, points: FloatArray, radius: float) -> None:
    """Raise UnrefinableError if the function equals its level in a volume, as max(x, 0) does for
    level 0. No cells are small enough for such a function.

    The function is examined at some of `points` (n, 3) on the level set. The error is raised if at
    more than half of them it equals the level, up to rounding, both at the point and at the
    distance `radius` from it in all six axis directions."""
    # Every k-th point, with the smallest k for which at most 2000 are left.
    probes = points[:: -(-len(points) // _MOST_PROBES)]
    offsets = radius * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    near_points = (probes[:, None] + offsets).reshape(-1, 3)
    is_on_level_around = function.is_on_level(near_points).reshape(len(probes), -1).all(axis=1)
    if is_on_level_around.mean() > 0.5:
        a, b, c = probes[is_on_level_around][0]
        raise UnrefinableError(
            f"{type(function.field).__name__} is {function.level:g}, up to rounding, at and around "
            f"points such as ({a:.4g}, {b:.4g}, {c:.4g}): its level there is a volume and no "
            "surface; choose another level"
        )


def _check_passes_level(function: LevelFunction, points: FloatArray, size: float) -> None:
    """Raise UnrefinableError if the function only touches its level, without changing sign, at more
    than half of the points examined. The square of a function does so, and signs at the corners of
    cells never show such a level set.

    points: (n, 3) points near the level set, some of which are examined.
    size: the size of a cell, a length.

    The function is examined along a line segment through each point that reaches a hundredth of a
    cell to both sides. The segment has the direction of the gradient at a point beside it, because
    at the point the gradient may be 0. The function touches its level if both ends of the segment
    have values on the same side of the level, and the value closest to the level, found by golden
    section search, is as close to it as rounding allows."""
    # Every k-th point, with the smallest k for which at most 60 are left.
    x = points[:: -(-len(points) // _MAX_TRIED)]
    offset = _TOUCH_OFFSET * size
    # Of the gradients at three points beside x the steepest one gives the direction.
    gradients = function.sample((x[:, None] + offset * np.eye(3)).reshape(-1, 3)).gradient.reshape(
        -1, 3, 3
    )
    steepest = gradients[np.arange(len(x)), (gradients**2).sum(axis=2).argmax(axis=1)]
    direction = unit_rows(steepest)

    def along(s: FloatArray) -> FloatArray:
        """(k,) the function's values on the segments at the signed distances s (k,) from the points
        x."""
        return function.values(x + s[:, None] * direction)

    low, high = np.full(len(x), -offset), np.full(len(x), offset)
    # Multiplied by this sign, the values at the lower ends are positive; so the smallest value
    # along the segment is the one closest to the level.
    sign_of_point = np.sign(along(low))
    end_value = np.minimum(sign_of_point * along(low), sign_of_point * along(high))
    smallest = end_value.copy()
    for _ in range(_SECTIONS):
        # The two inner points of a golden section of the interval from low to high.
        s, t = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        f_left, f_right = sign_of_point * along(s), sign_of_point * along(t)
        smallest = np.minimum(smallest, np.minimum(f_left, f_right))
        low, high = np.where(f_left > f_right, s, low), np.where(f_left > f_right, high, t)
    is_touching = (end_value > 0) & (smallest >= 0) & (smallest <= _TOUCHING * end_value)
    if is_touching.mean() > 0.5:
        a, b, c = x[is_touching][0]
        name, level = type(function.field).__name__, function.level
        raise UnrefinableError(
            f"{name} comes to {level:g} without passing it, as a square does, at points such as "
            f"({a:.4g}, {b:.4g}, {c:.4g}): the surface there has one side only and no mesh finds "
            "it. Give a function that changes its sign there, such as u instead of u^2, or mesh a "
            f"thin wall, such as hk.solid(f, between=({level:g} - t, {level:g} + t)) with a small t"
        )


def _longest_part(x: FloatArray, max_gap: float) -> FloatArray:
    """The points of x (n, 3) that belong to the connected part with the longest bounding box: an
    array (k, 3).

    Two points belong to one part if a chain of points connects them in which successive points are
    at most `max_gap` (a length) apart."""
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
    """Raise an error if refining the mesh until it is within the tolerance of the level set would
    make, by an estimate, more than `function.most_faces` triangles.

    vertices, faces: (n, 3), (m, 3) the mesh before refinement. tolerance: a length.

    The distance of the midpoints of a triangle's edges from the level set falls with the triangle's
    area. So a triangle whose midpoints are k tolerances away is refined to about k triangles. About
    20,000 triangles are examined at most.

    Raises:
        MeshingError: the gradient is 0 at the midpoint of an edge that is not on the level set.
        TriangleLimitError: the estimate exceeds the limit. The message says which tolerance would
            be possible.
    """
    sampled = faces[:: max(1, len(faces) // 20_000)]
    if not len(sampled):
        return
    corner = vertices[sampled]
    # The midpoints of the three edges of each triangle; the farthest one decides.
    midpoint_samples = function.sample(0.5 * (corner + np.roll(corner, 1, axis=1)).reshape(-1, 3))
    is_flat = (midpoint_samples.value != 0) & ~midpoint_samples.gradient.any(axis=1)
    if is_flat.any():
        raise MeshingError(
            f"{type(function.field).__name__} is constant at {is_flat.sum():,} of "
            f"{len(is_flat):,} middles of edges, so that it does not say how far the surface is: "
            "choose a smaller `cell_size`, or a function with a slope within a cell of its surface"
        )
    distance = midpoint_samples.distance
    tolerances_away = distance.reshape(-1, 3).max(axis=1) / tolerance
    expected = float(np.maximum(1.0, tolerances_away).mean()) * len(faces)
    limit = function.most_faces
    if expected > limit:
        excess = expected / limit
        raise TriangleLimitError(
            f"the tolerance takes about {expected:.1e} triangles, and max_triangles is {limit:,}: "
            f"choose a `tolerance` {excess:.2g} times as large, or a larger `max_triangles`"
        )


# Points this near to the level, relative to the length of a cell, are moved onto it.
_SNAP_DISTANCE = 0.25
# The width, in cells, of the border around relevant cells that is meshed as well.
_BORDER = 2.0
# The number of cells along an edge of a block.
_BLOCK = 8
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class IrrelevantRegion:
    """A region of space in which a surface need not be meshed, because it will be cut away: the
    solid that the surface bounds is intersected with other solids that have no points there.

    clearance: a function from points (k, 3) to radii (k,) of balls around them that lie in the
        region; 0 for points outside of it.
    cached_cells: for each lattice, the indices of the cells that are not proved to lie in the
        region."""

    clearance: Clearance
    cached_cells: dict[tuple[float, ...], IntArray] = dataclasses.field(
        default_factory=dict[tuple[float, ...], IntArray]
    )

    def relevant_cells(self, lattice: BccLattice, max_triangles: int) -> IntArray:
        """The indices (n, 3) of the cells of a lattice that are not proved to lie in the region,
        and of the cells in a border two cells wide around them.

        max_triangles: the largest number of triangles that the mesh may have.

        Raises:
            TriangleLimitError: there are more such cells than a mesh of `max_triangles` triangles
                may have.
        """
        # The lattice as a key of the dictionary.
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
    """Mesh the level set of a function in the box of a lattice. Where the level set leaves the box,
    the mesh ends on the box's faces.

    tolerance: a length, the largest distance of the midpoints of edges and of the centers of faces
        from the level set.
    report: called with messages about progress.

    Returns:
        The mesh; and for which fraction of the tetrahedra it is proved that the mesh before
        refinement has the topology of the level set.

    Raises:
        MeshingError: the level set does not meet the box, or there are too many cells.
        MissedPartsError: the mesh misses parts of the level set.
        TriangleLimitError: too many triangles would be needed for the tolerance.
        UnrefinableError: the function is not finite somewhere, or its level set is a volume.
    """
    walls = lattice.lower, lattice.upper
    cells = lattice.nonempty_cells(function.clearance, function.most_faces)
    coordinates, corners = lattice.tetrahedra(cells)
    points = lattice.points(coordinates)
    report(f"{len(points):,} points, {len(corners):,} tetrahedra")
    # No point is fixed, left out, or counted as on the level set wherever it is.
    no_points = np.zeros(len(points), np.bool_)
    samples = _sample_lattice(function, points, lattice, no_points)
    first = _march(function, points, samples, corners, no_points, no_points, lattice, walls)
    vertices, faces = first.vertices, first.faces
    _check_nothing_missed(function, points, samples, corners, first, faces, lattice, walls)
    if not len(faces):
        raise MeshingError("the level set is empty: no cell of the box holds the level")
    _check_is_continuous(function, vertices, faces, lattice)
    check_estimated_triangles(function, vertices, faces, tolerance)
    # The surface spans no curve.
    no_curve = BoundaryCurve(np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    size = float(lattice.size.max())
    is_cut = first.is_cut(corners)
    isotopy = isotopy_of(function, first.points, corners, is_cut, faces, no_curve, size, walls)
    # Better shapes first, then within the tolerance, then better shapes that stay within it.
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
    """Mesh the boundary of the set of points, in the box of a lattice, at which the function is
    negative. The mesh is closed: where the set reaches the box, faces of cells on the box close it.

    The outermost cells count as inside as a whole if the function is at most 0 at their centers.
    Triangles in the two outermost layers of cells are coarse and may touch in vertices: the caller
    cuts them away. The mesh has no faces if the function is negative nowhere.

    tolerance: a length, the largest distance of the midpoints of edges and of the centers of faces
        from the level set.
    report: called with messages about progress.
    as_cut: whether to return the triangles as the level set cuts them from the tetrahedra. They
        never pass through each other, but they are not refined, and parts between lattice points
        are missed. This is for functions with creases everywhere, such as distances from meshes, in
        cells of about the tolerance.
    elsewhere: a region in which the surface does not matter, or None. In the region, except for a
        few cells at its border, the function counts as positive, and coarse triangles close the
        surface there.

    Raises:
        MeshingError: there are too many cells.
        MissedPartsError: the mesh misses parts of the level set.
        TriangleLimitError: too many triangles would be needed for the tolerance.
        UnrefinableError: the function is not finite somewhere, or its level set is a volume.
    """
    limit, does_matter = function.most_faces, None
    if elsewhere is None:
        # Cells that may hold the level set, and the outermost cells that are inside.
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
    # Points on the box and the centers of the outermost cells must not be moved.
    is_fixed = is_wall | ((coordinates == 1) | (coordinates == 2 * lattice.counts - 1)).any(axis=1)
    is_in_region = np.zeros(len(points), np.bool_)
    if does_matter is not None:
        is_in_region = lattice.touches_cells(coordinates, ~does_matter) & ~is_wall
    samples = _sample_lattice(function, points, lattice, is_in_region)
    first = _march(
        function, points, samples, corners, is_fixed | is_in_region, is_wall, lattice, None
    )
    vertices, faces = first.vertices, first.faces
    # Triangles at the box or at the irrelevant region are coarse: they only close the surface.
    is_coarse_vertex = first.is_beside(is_wall | is_in_region)
    is_coarse_face = is_coarse_vertex[faces].any(axis=1)
    fine_faces, coarse_faces = (
        faces[~is_coarse_face],
        [faces[is_coarse_face], _wall_faces(points, samples, corners, is_wall)],
    )
    inner_box = lattice.lower + 2 * lattice.size, lattice.upper - 2 * lattice.size
    if as_cut:
        return TriangleMesh.without_unused_vertices(
            vertices, np.concatenate([fine_faces, *coarse_faces])
        )
    _check_nothing_missed(
        function, points, samples, corners, first, faces, lattice, inner_box,
        None if elsewhere is None else elsewhere.clearance,
    )  # fmt: skip
    # Triangles that end at the outermost cells are moved and cut, their ends are not.
    if len(fine_faces):
        _check_is_continuous(function, vertices, fine_faces, lattice)
        check_estimated_triangles(function, vertices, fine_faces, tolerance)
        vertices = smooth(function, vertices, fine_faces, None)
        may_refine = _refinable_points(lattice, does_matter)
        vertices, fine_faces = refine(
            function, vertices, fine_faces, tolerance, None, report, may_refine
        )
        vertices = smooth_within_tolerance(
            function, vertices, fine_faces, None, tolerance, may_refine
        )
    faces = np.concatenate([fine_faces, *coarse_faces])
    return (
        TriangleMesh.without_unused_vertices(vertices, faces)
        if len(faces)
        else TriangleMesh(np.zeros((0, 3)), faces)
    )


def split_faces_off_level(
    function: LevelFunction, surface: TriangleMesh, farthest: float, times: int
) -> TriangleMesh:
    """Cut into three each face whose center is farther than `farthest` (a length) from the level
    set, as happens where the face cuts across a crease. Returns the new mesh.

    function: f - level for a field f; it is 0 on the level set.

    The new vertex is the face's center, moved onto the level set. The new faces are examined in the
    same way, in `times` rounds at most. All edges stay.
    """
    vertices, faces = surface.vertices, surface.faces
    pending = np.arange(len(faces))
    for _ in range(times):
        corner = vertices[faces[pending]]
        center = corner.mean(axis=1)
        samples = function.sample(center)
        off_level = np.flatnonzero(samples.distance > farthest)
        if not len(off_level):
            break
        # Steps of at most half an edge, without walls (None).
        max_step = 0.5 * row_norms(corner[off_level, 1] - corner[off_level, 0])
        moved = newton_to_level(
            function, center[off_level], samples.select(off_level), max_step, None
        )
        # Each of these faces becomes a fan of three around its new vertex. The new faces are the
        # last ones, and are examined in the next round.
        rows, new_vertices = pending[off_level], len(vertices) + np.arange(len(off_level))
        vertices = np.concatenate([vertices, moved])
        fans = fan_faces(faces[rows], new_vertices)
        faces = np.concatenate([np.delete(faces, rows, axis=0), fans])
        pending = np.arange(len(faces) - 3 * len(rows), len(faces))
    return TriangleMesh(vertices, faces)


def _are_negative(function: LevelFunction, lattice: BccLattice, cells: IntArray) -> BoolArray:
    """(k,) whether the function is at most 0 at the centers of those cells of the lattice that have
    the indices `cells` (k, 3).

    Cells are grouped in blocks of 8^3. If the level set is proved not to enter a block, the sign at
    the block's center holds for all of its cells.
    """
    # Number the blocks, and keep those that contain a cell.
    shape = lattice.counts // _BLOCK + 1
    x, y, z = (cells // _BLOCK).T
    keys, block_of_cell, _, _ = unique_with_inverse((x * shape[1] + y) * shape[2] + z)
    xy, z = np.divmod(keys, shape[2])
    blocks = np.stack([*np.divmod(xy, shape[1]), z], axis=1)
    centers = lattice.points(_BLOCK * (2 * blocks + 1))
    half_diagonal = 0.5 * _BLOCK * float(np.linalg.norm(lattice.size))
    # No level within half a diagonal of the center: none in the block.
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
    """Raise MissedPartsError if the mesh misses parts of the level set that are at least two cells
    long. This function finds the points at which the search starts; `check_no_missed_parts` does
    the search.

    points, samples: points (n, 3) of the lattice, and samples of the function at them.
    corners: (m, 4) the corners of all tetrahedra.
    first: the mesh before refinement.
    faces: the faces (k, 3) of that mesh near which nothing is missed.
    box: the lower and the upper corner of the box outside of which nothing counts as missed.
    elsewhere: a function that gives, for points, the radii of balls around them in which nothing
        counts as missed; None if all points count."""
    # The mesh passes through tetrahedra with corners on both sides of the level. In a tetrahedron
    # with corners on the level it need not have a face.
    signs = np.where(first.points.is_on_level, 0.0, np.sign(first.points.samples.value))[corners]
    is_beside = np.zeros(len(points), np.bool_)
    is_beside[corners[(signs.min(axis=1) < 0) & (signs.max(axis=1) > 0)]] = True
    surface = first.vertices, faces
    size = float(lattice.size.max())
    check_no_missed_parts(function, points, samples, is_beside, surface, size, box, elsewhere)


def _refinable_points(
    lattice: BccLattice, does_matter: BoolArray | None
) -> Callable[[FloatArray], BoolArray]:
    """Make a function that tells for points (n, 3) whether triangles may be refined there, as a
    mask (n,).

    does_matter: a mask with one entry for each cell of the lattice: whether the cell is relevant;
        None if all are.

    Triangles may be refined at points farther than one and a half cells from the faces of the box
    that lie neither in an irrelevant cell nor in a cell beside one. Reason: where triangles end in
    the outermost layer of cells, the edges at their ends stay as they are, so refinement of these
    triangles would never end. Their centers are less than one and a half cells from the faces of
    the box."""
    lower, upper = lattice.lower + 1.5 * lattice.size, lattice.upper - 1.5 * lattice.size
    # Whether each cell is relevant, and all cells around it too.
    is_interior_cell = None if does_matter is None else lattice.interior_cells(does_matter)

    def may_refine(points: FloatArray) -> BoolArray:
        """(n,) whether triangles may be refined at `points` (n, 3)."""
        is_inside = np.ones(len(points), np.bool_)
        for x, low, high in zip(points.T, lower, upper, strict=True):
            is_inside &= (x >= low) & (x <= high)
        if is_interior_cell is not None:
            is_inside &= is_interior_cell[tuple(lattice.cell_indices(points).T)]
        return is_inside

    return may_refine


def _wall_faces(
    points: FloatArray, samples: LevelSamples, corners: IntArray, is_wall: BoolArray
) -> IntArray:
    """The faces (m, 3) of tetrahedra that lie on the box and close the mesh there: they cover the
    part of the box's faces next to which the function is negative.

    points, samples: the points (n, 3) of the lattice, and samples of the function at them.
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
    # The fourth corner lies inside; the normal must not point to it.
    is_inward = (np.cross(b - a, c - a) * (points[apex] - a)).sum(axis=1) > 0
    face[is_inward] = face[is_inward][:, ::-1]
    return face


def _sample_lattice(
    function: LevelFunction, points: FloatArray, lattice: BccLattice, is_irrelevant: BoolArray
) -> LevelSamples:
    """Evaluate the function (value, gradient, distance from the level set) at `points` (n, 3) of a
    lattice. Points in the mask `is_irrelevant` (n,) are not evaluated and get a large positive
    value.

    Raises:
        UnrefinableError: the function is not finite at a point, or equals its level nearly
            everywhere.
    """
    count = len(points)
    # The values of points that are not evaluated: far above the level. (From `OUTSIDE_VALUE` on, a
    # value stands for the outside, and edges that end there are cut in the middle.)
    samples = LevelSamples(np.full(count, 10 * OUTSIDE_VALUE), np.ones((count, 3)), np.zeros(count))
    points = points[~is_irrelevant]
    samples = samples.replaced(~is_irrelevant, function.sample(points))
    is_bad = ~np.isfinite(samples.value[~is_irrelevant])
    if is_bad.any():
        x, y, z = points[is_bad][0]
        advice = ", or a smaller `cell_size`: it is asked for three cells around other parts"
        raise UnrefinableError(
            f"{type(function.field).__name__} has no finite value at {is_bad.sum():,} points, such "
            f"as ({x:.4g}, {y:.4g}, {z:.4g}): choose a `clip` where it has"
            + (advice if is_irrelevant.any() else "")
        )
    _check_off_level_at_most_points(function, points, lattice)
    return samples


def _check_is_continuous(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, lattice: BccLattice
) -> None:
    """Raise UnrefinableError if more than 4 in 100 vertices of the mesh are farther than a tenth of
    a cell from the level set. The function changes its sign at every vertex; so it jumps at these
    vertices, and refinement would never end. lattice: tells the size of cells."""
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
    quarters of the lattice points `points` (n, 3), as x - x does for level 0. No cells of such a
    function are proved empty, however small they are."""
    # Cells proved empty have no points here: with few points the level set is no volume.
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
    """The mesh before refinement, and the tetrahedra from which the level set cuts it. Vertices of
    the mesh are of two kinds: the lattice points (the corners of the tetrahedra), and new ones on
    the edges that the level set crosses.

    vertices, faces: (n, 3), (m, 3) the mesh. The lattice points are the first vertices.
    points: the lattice points; those near the level set were moved onto it.
    rows: (k,) the indices of the tetrahedra that the level set may pass through.
    crossed: (k,) for each of these tetrahedra, whether the level set crosses one of its edges.
    ends: (j, 2) for each edge that the level set crosses, the indices of its two end points."""

    vertices: FloatArray
    faces: IntArray
    points: TetrahedronPoints
    rows: IntArray
    crossed: BoolArray
    ends: IntArray

    def is_cut(self, corners: IntArray) -> BoolArray:
        """(m,) whether each tetrahedron of the lattice contains a point of the mesh's faces.

        corners: (m, 4) the corners of all tetrahedra, as indices of lattice points."""
        cut = _have_any(self.points.is_on_level, corners)
        cut[self.rows] |= self.crossed
        return cut

    def is_beside(self, chosen: BoolArray) -> BoolArray:
        """(n,) for each vertex of the mesh, whether it is a chosen lattice point, or lies on an
        edge of which one end is chosen. chosen: a mask of the lattice points."""
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
    """Cut the level set from the tetrahedra of a lattice, by marching tetrahedra. Returns the mesh
    before refinement, which is a manifold.

    Before that, lattice points near the level set are moved onto it. If parts of the surface then
    touch in a moved point, the point is moved back to its original position; this is repeated until
    no parts touch.

    points, samples: points (n, 3) of the lattice, and samples of the function at them.
    corners: (m, 4) the indices of the corners of each tetrahedron.
    is_fixed: (n,) the mask of the points that must not be moved.
    is_wall: (n,) the mask of the points that count as on the level set, wherever they are.
    walls: the lower and the upper corner of the box; points on its faces stay on these. None for no
        such condition.

    Raises:
        MeshingError: parts still touch after 20 rounds.
    """
    original_points, original_samples = points, samples
    points, samples, is_on_level = _snap_points(function, points, samples, is_fixed, lattice, walls)
    is_on_level |= is_wall
    touching, is_affected = np.zeros(0, np.int64), np.ones(len(points), np.bool_)
    rows = cut_rows = np.flatnonzero(_may_be_cut(samples.value, is_on_level, corners))
    for _ in range(_MOST_ROUNDS):
        sampled, tetrahedra = (
            TetrahedronPoints(points, is_on_level, samples),
            Tetrahedra.of(points, corners[rows]),
        )
        crossings = count_crossings(function, sampled, tetrahedra)
        # The positions of vertices on edges do not matter for whether parts touch.
        _, faces = extract_triangles(function, sampled, tetrahedra, crossings, _middles)
        # Only lattice points beside a change, and not on the box, are moved back.
        touching = nonmanifold_vertices(faces)
        touching = touching[touching < len(points)]
        touching = touching[(is_affected & ~is_wall)[touching]]
        if not len(touching):
            break
        points, is_on_level = points.copy(), is_on_level.copy()
        points[touching], is_on_level[touching] = original_points[touching], False
        samples = samples.replaced(touching, original_samples.select(touching))
        # Parts may touch anew only at points beside these: they are examined with all of their
        # tetrahedra.
        is_touching, is_affected = (
            np.zeros(len(points), np.bool_),
            np.zeros(len(points), np.bool_),
        )
        is_touching[touching] = True
        is_affected[corners[_have_any(is_touching, corners)]] = True
        affected = np.flatnonzero(_have_any(is_affected, corners))
        rows = affected[_may_be_cut(samples.value, is_on_level, corners[affected])]
        cut_rows = np.concatenate([cut_rows, rows])
    else:
        raise MeshingError(
            f"sheets of the level set touch at {len(touching)} places: choose a smaller `cell_size`"
        )
    # Cut all tetrahedra that were cut in some round once more, with the final points.
    rows = sorted_unique(cut_rows)
    rows = rows[_may_be_cut(samples.value, is_on_level, corners[rows])]
    sampled, tetrahedra = (
        TetrahedronPoints(points, is_on_level, samples),
        Tetrahedra.of(points, corners[rows]),
    )
    crossings = count_crossings(function, sampled, tetrahedra)
    vertices, faces = extract_triangles(function, sampled, tetrahedra, crossings)
    crossed: BoolArray = np.asarray((crossings.count[tetrahedra.edges] != 0).any(axis=1))
    ends = tetrahedra.ends[np.flatnonzero(crossings.count)]
    return _InitialMesh(vertices, faces, sampled, rows, crossed, ends)


def _middles(low: FloatArray, high: FloatArray) -> FloatArray:
    """The midpoints (k, 3) of the edges whose ends are `low` and `high`, both (k, 3)."""
    return 0.5 * (low + high)


def _snap_points(
    function: LevelFunction,
    points: FloatArray,
    samples: LevelSamples,
    is_fixed: BoolArray,
    lattice: BccLattice,
    walls: tuple[FloatArray, FloatArray] | None,
) -> tuple[FloatArray, LevelSamples, BoolArray]:
    """Move lattice points near the level set onto it.

    A point is moved, by Newton's method, if its estimated distance from the level set is less than
    a quarter of a cell and it is not in the mask `is_fixed` (n,). A point stays where it is if the
    method does not converge, or moves it by more than 0.3 cells.

    points, samples: points (n, 3) of the lattice, and samples of the function at them.
    walls: the lower and the upper corner of the box; points on its faces stay on these. None for no
        such condition.

    Returns:
        The points (n, 3); samples of the function at them; and the mask (n,) of the points on the
        level set.
    """
    size = float(lattice.size.min())
    near = np.flatnonzero((samples.distance < _SNAP_DISTANCE * size) & ~is_fixed)
    max_step = np.full(len(near), 0.5 * _SNAP_DISTANCE * size)
    moved, new_samples, is_moved = snap_to_level(
        function, points[near], samples.select(near), size,
        max_step, 1.2 * _SNAP_DISTANCE * size, walls, steps=4,
    )  # fmt: skip
    rows = near[is_moved]
    # A point with a value of exactly 0 counts as on the level unmoved, so that all other points
    # have a sign.
    points, is_on_level = points.copy(), (samples.value == 0) & ~is_fixed
    points[rows], is_on_level[rows] = moved[is_moved], True
    return points, samples.replaced(rows, new_samples.select(is_moved)), is_on_level


def _have_any(chosen: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) whether each tetrahedron has a corner among the chosen points.

    chosen: (n,) a mask of the points. corners: (m, 4) the corners of the tetrahedra, as indices of
        points."""
    has_chosen = np.zeros(len(corners), np.bool_)
    for column in corners.T:  # four times as fast as chosen[corners].any(axis=1)
        has_chosen |= chosen[column]
    return has_chosen


# Codes of a point above the level, below it, and on it. The sum of the codes of four points tells
# how many of them are of each kind, because 5 and 25 are larger than 4 times the code before.
_ABOVE, _BELOW, _ON_LEVEL = 1, 5, 25


def _may_be_cut(value: FloatArray, is_on: BoolArray, corners: IntArray) -> BoolArray:
    """(m,) whether the level set may pass through each tetrahedron: the tetrahedron has corners on
    both sides of the level set, or at least three corners on it.

    value: (n,) the function at the points.
    is_on: (n,) whether each point is on the level set; then the sign of its value does not count.
    corners: (m, 4) the corners of the tetrahedra, as indices of points."""
    code = np.where(is_on, _ON_LEVEL, np.where(value > 0, _ABOVE, _BELOW)).astype(np.uint8)
    code_sum = np.zeros(len(corners), np.uint8)
    for column in corners.T:
        code_sum += code[column]
    # A table with the answer for each possible sum of codes.
    is_cut_by_code = np.zeros(4 * _ON_LEVEL + 1, np.bool_)
    for above, below in itertools.product(range(5), repeat=2):
        on = 4 - above - below
        if on >= 0:
            is_cut_by_code[above * _ABOVE + below * _BELOW + on * _ON_LEVEL] = (
                above and below
            ) or on >= 3
    return is_cut_by_code[code_sum]
