"""Point clouds with normals: validation, the area of the surface that each point represents, and
estimated normals. A cloud is a sample of a surface: points (n, 3), unit normals (n, 3) that point
to the positive (outer) side, and areas (n,) whose sum is about the area of the surface. A neighbor
of a point is one of the points nearest to it. The plane of a point is the plane that best fits its
neighbors, an estimate of the surface's tangent plane. Points at the same position are allowed; sums
over the points count each of them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from harnack.backend.validation import (
    TRANSPOSE_ADVICE,
    FloatArray,
    IntArray,
    as_real_array,
    check_coordinate_size,
    check_finite,
    check_vectors,
    format_vector,
    others_suffix,
)
from harnack.geometry.boundary_edges import weld_vertices
from harnack.geometry.neighborhoods import kd_tree
from harnack.geometry.voronoi_areas import TangentVoronoi

__all__ = ["CloudError", "estimate_areas", "estimate_normals", "validate_cloud"]

MAX_POINTS = 100_000_000
# Points per step: the temporary arrays of one step then stay in the cache of one core.
_CHUNK = 4096
# The radius at which a point's Voronoi cell is cut off is at most this multiple of the median of
# its neighbors' radii.
_MAX_RADIUS_RATIO = 3.0
# Number of points whose cells are computed at once.
_POINTS_PER_BATCH = 1 << 18
_NONFINITE_ADVICE = "its components must be finite; remove the point"


class CloudError(ValueError):
    """A point cloud cannot be used; the message says why and what to do."""


def validate_cloud(
    points: npt.ArrayLike, normals: npt.ArrayLike | None, areas: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Validate a cloud. Returns points (n, 3), unit normals (n, 3) and areas (n,): float64 copies
    that cannot be written to. `estimate_areas` and `estimate_normals` compute missing areas and
    normals.

    points: (n, 3).
    normals: (n, 3), of any length but zero.
    areas: (n,), positive, in the square of the points' unit; a single number stands for all.

    Raises:
        CloudError: not numbers of these shapes, or no points; a value that is not finite; a normal
            of length zero; an area that is not positive; coordinates above 1e100.
    """
    x = as_cloud_points(points)
    n = as_unit_normals(normals, len(x))
    a = _as_numbers(areas, "the areas")
    if a.ndim == 0:
        a = np.full(len(x), float(a))
    if a.shape != (len(x),):
        raise CloudError(f"there are {len(x):,} points: the areas must have shape ({len(x)},), not "
                         f"{a.shape}")  # fmt: skip
    bad = np.flatnonzero(~((a > 0.0) & (a < np.inf)))
    if bad.size:
        raise CloudError(
            f"the area of point {bad[0]} is {a[bad[0]]:g}{others_suffix(bad.size)}: areas must be "
            "positive and finite; remove points that stand for no area"
        )
    for array in (x, n, a):
        array.setflags(write=False)
    return x, n, a


def as_cloud_points(points: Any) -> FloatArray:
    """Convert points to a new float64 array (n, 3) of finite numbers, n >= 1.

    Raises:
        CloudError: points are not numbers of that shape, or have coordinates above 1e100.
    """
    x = _as_numbers(points, "the points")
    if x.size == 0:
        raise CloudError("there are no points: give an array (n, 3)")
    check_vectors(x, "the points", CloudError, transposed=TRANSPOSE_ADVICE)
    check_finite(x, "point {}", CloudError, _NONFINITE_ADVICE)
    check_coordinate_size(x, CloudError)
    return x


def as_unit_normals(normals: Any, count: int) -> FloatArray:
    """Convert normals to a new array (count, 3), scaled to unit length.

    Raises:
        CloudError: normals are missing or not of that shape, or a normal is zero or not finite.
    """
    if normals is None:
        raise CloudError(
            "the cloud has no normals, which say where outside is: give them, or estimate them "
            "with harnack.geometry.estimate_normals(points) and look at the result"
        )
    n = _as_numbers(normals, "the normals")
    check_vectors(n, "the normals", CloudError, transposed=TRANSPOSE_ADVICE)
    if len(n) != count:
        raise CloudError(
            f"there are {count:,} points but {len(n):,} normals: every point needs one normal"
        )
    check_finite(n, "normal {}", CloudError, _NONFINITE_ADVICE)
    largest = np.abs(n).max(axis=1, keepdims=True)
    bad = np.flatnonzero(largest == 0.0)
    if bad.size:
        raise CloudError(
            f"normal {bad[0]} is zero{others_suffix(bad.size)}: remove these points, or estimate "
            "all "
            "normals with harnack.geometry.estimate_normals(points)"
        )
    n = n / largest  # first, so that squares neither overflow nor vanish
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def estimate_areas(
    points: npt.ArrayLike, normals: npt.ArrayLike, neighbors: int = 20
) -> FloatArray:
    """Estimate the area (n,) that each point of a cloud represents: the area of its Voronoi cell
    (the points of space that are nearer to it than to any other point) in its tangent plane.

    Barill et al. 2018, section 3.1, project the nearest neighbors to the tangent plane and take the
    area of the point's Voronoi cell among them. Here the point's Voronoi cell in space is
    intersected with the tangent plane instead. For points in a plane this is the same. But here a
    point on the other side of a thin wall does not shrink the cell, since its bisecting plane is
    parallel to the tangent plane. Points at the same position share a cell.

    Let R be the distance of the farthest neighbor that is used. Points that are no neighbors are
    farther away, and can cut the cell only at distances above R/2. So within the disc of radius R/2
    the cell is exact, and it is cut off at this radius. At the boundary of an open surface a cell
    may be unbounded: if all neighbors lie on one side of a line through the point, their mirror
    images bound the cell too, so that it extends as far outwards as inwards. The radius is also
    limited to three times the median of its neighbors' radii, so that an isolated point gets no
    more area than its neighbors.

    points, normals: (n, 3) each.
    neighbors: the number of neighbors that are used. More neighbors take more time; with fewer,
        large cells of uneven samples are cut off.

    Raises:
        CloudError: points or normals are not valid (see `validate_cloud`); all points are at one
            position; fewer than 3 neighbors.
    """
    x = as_cloud_points(points)
    n = as_unit_normals(normals, len(x))
    check_neighbors(neighbors)
    welded = weld_vertices(x)
    # The distinct positions, and for each point the index of its position.
    positions, position_of = np.unique(welded, return_inverse=True)
    sharing_count = np.bincount(position_of)[position_of]
    tree = build_point_tree(x[positions])
    # The place of each position in the order of the tree.
    rank = np.empty(len(positions), np.int64)
    rank[tree.indices] = np.arange(len(positions))
    # In the order of the tree neighbors follow each other, which halves the time.
    order = np.argsort(rank[position_of])
    nearest = np.empty((len(x), min(neighbors, tree.n - 1)), np.uint32)
    radii = np.empty(len(positions))

    def find_neighbors(rows: slice) -> None:
        """Find the neighbors of the points `rows`, and half the distance of each point from its
        farthest neighbor. They are stored in the arrays `nearest` and `radii` of the enclosing
        function."""
        batch = order[rows]
        nearest[batch], distance = nearest_neighbors(tree, x[batch], neighbors)
        radii[position_of[batch]] = 0.5 * distance[:, -1]

    parallel_over_slices(find_neighbors, len(x))
    areas = np.empty(len(x))
    cells = TangentVoronoi.of(tree.data)
    for start in range(0, len(x), _POINTS_PER_BATCH):
        # The cut-off radius of each cell: half of R, but at most three times the neighbors' median.
        batch = order[start : start + _POINTS_PER_BATCH]
        max_radius = _MAX_RADIUS_RATIO * np.median(radii[nearest[batch]], axis=1)
        cell_radii = np.minimum(radii[position_of[batch]], max_radius)
        areas[batch] = cells.areas(x[batch], n[batch], nearest[batch], cell_radii)
    return areas / sharing_count


def _as_numbers(values: Any, name: str) -> FloatArray:
    """Convert values to a new float64 array.

    name: what they are, for messages.

    Raises:
        CloudError: they are not real numbers, or there are too many.
    """
    ragged = "are ragged: every row needs as many numbers"
    array = as_real_array(values, name, CloudError, ragged=ragged, other="must be real numbers")
    if array.size > 3 * MAX_POINTS:
        raise CloudError(f"{name} have shape {array.shape}: at most {MAX_POINTS:,} are accepted")
    return np.array(array, dtype=np.float64, order="C")


def check_neighbors(neighbors: int) -> None:
    """Raise CloudError if the number of neighbors is less than 3: too few to fit a plane."""
    if neighbors < 3:
        raise CloudError(f"at least 3 neighbors are needed, not {neighbors}")


def build_point_tree(points: FloatArray) -> Any:
    """Build a search tree (SciPy's cKDTree) of points (n, 3), all different, for
    `nearest_neighbors`.

    Raises:
        CloudError: there is only a single point.
    """
    if len(points) < 2:
        raise CloudError("all points are at one position: a surface needs points beside each other")
    return kd_tree(points)


def nearest_neighbors(tree: Any, points: FloatArray, count: int) -> tuple[IntArray, FloatArray]:
    """Find the k nearest other points of a tree for each of m of its points. Returns their indices
    (m, k) and distances (m, k), nearest first.

    tree: a search tree (`build_point_tree`) of points that are all different.
    points: (m, 3), all of which must be points of the tree.
    count: the number of neighbors, k; k is less if the tree has fewer other points.

    Raises:
        CloudError: a point and all its neighbors lie within 1e-100.
    """
    distance, index = tree.query(points, k=min(count + 1, tree.n))
    # The squares of such distances would underflow.
    if distance[:, -1].min() < 1e-100:
        raise CloudError(f"a point and its {count} neighbors all lie within 1e-100: remove some")
    # All points of the tree are different, so the nearest one found is the point itself.
    return index[:, 1:], distance[:, 1:]


def parallel_over_slices(work: Callable[[slice], None], count: int) -> None:
    """Call `work` for slices that make up range(count), on all cores. An error in a call is raised
    here."""
    slices = [slice(k, min(k + _CHUNK, count)) for k in range(0, count, _CHUNK)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(work, slices):
            pass


# Normals of clouds that have none: local planes, turned to agree with each other.

Indices = npt.NDArray[np.int64] | npt.NDArray[np.int32]

# A neighborhood lies on a line if its second variance over its first is below this.
_COLLINEAR_RATIO = 1e-9
# The choice of the number of neighbors if none is given. The flatness is a ratio of two standard
# deviations of the positions of a point's neighbors: the smallest, along the normal, over the
# middle one; its median over at most _PROBES points counts. The first of _NEIGHBOR_COUNTS whose
# flatness is below _MAX_FLATNESS is taken. If there is none, the largest count is tried among
# random halves, quarters, ... of the points, until they are fewer than _MIN_SUBSET. If none
# qualifies, the choice of smallest flatness is taken; a choice replaces the best one before it if
# its flatness is below _FLATNESS_GAIN times that of the best.
_NEIGHBOR_COUNTS, _MAX_FLATNESS, _PROBES, _MIN_SUBSET, _FLATNESS_GAIN = (
    (16, 32, 64),
    0.45,
    1000,
    1000,
    0.9,
)
# The number of the nearest points with a normal that vote on the sign of a point's normal.
_VOTING_NEIGHBORS = 8
# The directions of extreme points: towards the faces, edges and corners of a cube.
_DIRECTIONS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(d)])


def estimate_normals(points: npt.ArrayLike, neighbors: int | None = None) -> FloatArray:
    """Estimate unit normals (n, 3), outward, of points (n, 3) that sample a surface.

    The method is that of Hoppe et al. 1992. A normal is, up to its sign, the direction in which a
    point and its nearest neighbors vary least. The signs are propagated from point to point along
    the spanning tree of the graph of neighbors in which normals agree best. Normals are compared
    after mirroring, as Xie et al. 2003 propose; this propagates the sign correctly around edges and
    thin walls. Points are first moved onto the planes of their neighbors, as noise would disturb
    the mirroring. A single sign then remains to be chosen for each connected component of the
    graph. In 26 directions the component's extreme point is found; the sign is chosen such that the
    normals of these points face outward, summed over the directions; for a closed surface this is
    right, however unevenly it is sampled.

    neighbors: the number of neighbors to which planes are fitted. None chooses 16; for noisy points
        up to 64, so that the directions of the planes are known to a few degrees. If 64 are not
        enough, neighbors are searched only among a random subset of the points (with a fixed seed),
        as sparse as the noise requires.

    As each component faces outward by itself, the inner wall of a hollow body does not face its
    cavity. The side that an open surface faces is a convention; for a flat surface it is the
    positive side of the axis nearest to its normal. If details are smaller than the distance of the
    neighbors, normals may have the wrong sign: look at the result. Points at the same position get
    the same normal.

    Raises:
        CloudError: points are no finite numbers (n, 3) or have coordinates above 1e100; fewer than
            4 positions; neighbors of a point that lie on a line and have no plane; fewer than 3
            neighbors.
    """
    x = as_cloud_points(points)
    if neighbors is not None:
        check_neighbors(neighbors)
    # The distinct positions, and for each point the index of its position.
    positions, position_of = np.unique(weld_vertices(x), return_inverse=True)
    x = x[positions]
    if len(x) < 4:
        raise CloudError(f"{len(x)} different points do not show a surface: give at least 4")
    subset = np.arange(len(x))
    if neighbors is None:
        neighbors, subset = _choose_neighborhood(x)
    tree = build_point_tree(x[subset])
    planes = _fit_tangent_planes(x[subset], tree, neighbors)
    piece, parent = _spanning_forest(planes)
    sign = _propagate_signs(planes, parent)
    normals = planes.normals * sign[:, None]
    normals *= _outward_signs(x[subset], normals, piece)[piece, None]
    # Planes were fitted to a subset only; the other points get their normals from it.
    if len(subset) < len(x):
        normals = _transfer_normals(x, tree, normals, neighbors)
    return normals[position_of]


def _choose_neighborhood(x: FloatArray) -> tuple[int, IntArray]:
    """Choose the neighbors to which planes are fitted at the points x (n, 3), by the noise of the
    points. Returns the number of neighbors, and the indices (k,) of the points among which
    neighbors are searched: all points, or a random subset if the noise is large."""
    rng = np.random.default_rng(0)
    probes = x[rng.choice(len(x), min(len(x), _PROBES), replace=False)]
    subset = np.arange(len(x))
    best_flatness, best_choice = np.inf, (_NEIGHBOR_COUNTS[0], subset)
    counts_to_try = _NEIGHBOR_COUNTS
    while True:
        tree = build_point_tree(x[subset])
        for count in counts_to_try:
            neighbors_of, _ = nearest_neighbors(tree, probes, count)
            offsets = tree.data[neighbors_of]
            offsets = offsets - offsets.mean(axis=1, keepdims=True)
            # In increasing order: along the normal, then in the tangent plane.
            variances = np.linalg.eigvalsh(np.einsum("mki,mkj->mij", offsets, offsets))
            flatness = np.median(
                np.sqrt(np.abs(variances[:, 0]) / np.maximum(variances[:, 1], 1e-300))
            )
            if flatness < _FLATNESS_GAIN * best_flatness:
                best_flatness, best_choice = float(flatness), (count, subset)
            if best_flatness < _MAX_FLATNESS:
                return best_choice
        if len(subset) < _MIN_SUBSET:
            return best_choice
        # Too noisy: try half of the points, with the largest number of neighbors.
        subset, counts_to_try = (
            np.sort(rng.choice(subset, len(subset) // 2, replace=False)),
            _NEIGHBOR_COUNTS[-1:],
        )


def _transfer_normals(
    x: FloatArray, tree: Any, known_normals: FloatArray, neighbors: int
) -> FloatArray:
    """Compute unit normals (n, 3) of the points x (n, 3) from the known normals of k of them. For
    each point, a plane is fitted to the nearest points with known normals; the point's normal is
    the normal of this plane. Of its two signs, the one is taken for which the inner products with
    the known normals of the nearest eight of these points have a sum >= 0.

    x: (n, 3) all points.
    tree: the search tree of the k points with known normals.
    known_normals: (k, 3) their unit normals.
    neighbors: the number of known points to which a plane is fitted.
    """
    normals = np.empty_like(x)

    def fit_slice(rows: slice) -> None:
        """Compute the normals of the points `rows`."""
        _, index = tree.query(x[rows], k=min(neighbors, tree.n))
        offsets = tree.data[index] - tree.data[index].mean(axis=1, keepdims=True)
        _, eigenvectors = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))
        # The direction of the smallest variance.
        plane_normals = eigenvectors[:, :, 0]
        projections = np.einsum(
            "mki,mi->mk", known_normals[index[:, :_VOTING_NEIGHBORS]], plane_normals
        )
        normals[rows] = plane_normals * np.where(projections.sum(axis=1) < 0, -1.0, 1.0)[:, None]

    parallel_over_slices(fit_slice, len(x))
    return normals


@dataclass(frozen=True)
class _TangentPlanes:
    """For each point of a cloud the plane that best fits it and its neighbors.

    points: (n, 3) the points, each moved onto its plane.
    normals: (n, 3) unit normals of the planes, of either sign.
    neighbors: (n, k) the indices of the neighbors.
    """

    points: FloatArray
    normals: FloatArray
    neighbors: npt.NDArray[np.int32]


def _fit_tangent_planes(x: FloatArray, tree: Any, neighbors: int) -> _TangentPlanes:
    """Fit a plane to each point of a cloud and its nearest neighbors.

    x: (n, 3) the points.
    tree: the search tree of these points.
    neighbors: the number of neighbors.

    Raises:
        CloudError: the neighbors of a point lie on a line.
    """
    normals, points = np.empty_like(x), np.empty_like(x)
    nearest = np.empty((len(x), min(neighbors, len(x) - 1)), dtype=np.int32)
    on_line = np.zeros(len(x), dtype=bool)

    def fit_slice(rows: slice) -> None:
        """Fit the planes of the points `rows`. Offsets of neighbors are relative to the point, in
        units of the distance of the farthest neighbor."""
        # The farthest neighbor is at a distance above 0, as all points of the tree are different.
        index, distance = nearest_neighbors(tree, x[rows], neighbors)
        nearest[rows] = index
        offsets = (x[index] - x[rows, None]) / distance[:, -1, None, None]
        # The point itself, with the offset 0, counts as well.
        offsets = np.concatenate([offsets, np.zeros_like(offsets[:, :1])], axis=1)
        center = offsets.mean(axis=1, keepdims=True)
        offsets -= center
        variances, eigenvectors = np.linalg.eigh(np.einsum("mki,mkj->mij", offsets, offsets))
        normals[rows] = eigenvectors[:, :, 0]
        # The plane passes through the center; its height above the point, along the normal.
        height = np.einsum("mi,mi->m", center[:, 0], eigenvectors[:, :, 0]) * distance[:, -1]
        points[rows] = x[rows] + height[:, None] * eigenvectors[:, :, 0]
        on_line[rows] = variances[:, 1] <= _COLLINEAR_RATIO * variances[:, 2]

    parallel_over_slices(fit_slice, len(x))
    if on_line.any():
        first = int(np.flatnonzero(on_line)[0])
        raise CloudError(
            f"the {nearest.shape[1]} nearest neighbors of {on_line.sum():,} points lie on a line, "
            f"first of {format_vector(x[first])}: they show no surface; ask for more neighbors, or "
            "give normals"
        )
    return _TangentPlanes(points, normals, nearest)


def _agreement(planes: _TangentPlanes, i: Indices, j: Indices) -> FloatArray:
    """How well the normals of points i[k] and j[k] agree, for each of m pairs: the inner product
    (m,) of normal i with the mirror image of normal j in the plane that bisects the two points. On
    a circle, across an edge between two planes and across a thin wall it is 1 if both normals face
    outward (Xie et al. 2003).

    i, j: (m,) indices of points.
    """
    x, normals = planes.points, planes.normals
    edge = x[j] - x[i]
    length = np.linalg.norm(edge, axis=1, keepdims=True)
    # Points at the same position have no such plane; nothing is mirrored then.
    edge /= np.where(length > 0.0, length, 1.0)
    a, b = normals[i], normals[j]
    product_along_edge = np.einsum("ij,ij->i", edge, a) * np.einsum("ij,ij->i", edge, b)
    # Mirroring b in the plane at right angles to e gives b - 2 (b.e) e.
    return np.einsum("ij,ij->i", a, b) - 2.0 * product_along_edge


def _spanning_forest(planes: _TangentPlanes) -> tuple[IntArray, IntArray]:
    """Find the spanning forest of the graph of neighbors in which normals agree best: a tree in
    each connected component, with the smallest sum of weights 1 - |agreement| of its edges
    (`_agreement`).

    Returns, for each point, its connected component (n,), counted from 0, and its parent (n,) in
    the forest; a root is its own parent.
    """
    import scipy.sparse  # imported here: it takes half a second, and few programs need it

    sparse: Any = scipy.sparse
    nearest = planes.neighbors
    n, k = nearest.shape
    weight = np.empty((n, k))

    def weigh_edges(rows: slice) -> None:
        """Compute the weights of the edges that begin at the points `rows`; they are small where
        normals agree."""
        start = np.repeat(np.arange(rows.start, rows.stop, dtype=np.int64), k)
        agreement = np.abs(_agreement(planes, start, nearest[rows].ravel()))
        # SciPy takes a weight of 0 for a missing edge.
        weight[rows] = np.maximum(1.0 - agreement, 0.0).reshape(-1, k) + 1e-9

    parallel_over_slices(weigh_edges, n)
    # The matrix of the graph in compressed rows: k entries for each point. SciPy before 1.16 finds
    # spanning trees with 32-bit indices only.
    index_type = np.int32 if n * k < 2**31 else np.int64
    row_starts = np.arange(0, n * k + 1, k, dtype=index_type)
    columns = nearest.ravel().astype(index_type)
    graph = sparse.csr_array((weight.ravel(), columns, row_starts), shape=(n, n))
    forest = sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    _, component = sparse.csgraph.connected_components(forest, directed=False)
    # An additional node is joined to all roots, so that one search from it visits all points.
    _, roots = np.unique(component, return_index=True)
    start = np.concatenate([forest.row, np.full(len(roots), n)])
    end = np.concatenate([forest.col, roots])
    joined_graph = sparse.csr_array((np.ones(len(start)), (start, end)), shape=(n + 1, n + 1))
    _, predecessors = sparse.csgraph.breadth_first_order(joined_graph, n, directed=False)
    parent = np.asarray(predecessors[:n], dtype=np.int64)
    parent[roots] = roots
    return np.asarray(component, dtype=np.int64), parent


def _propagate_signs(planes: _TangentPlanes, parent: IntArray) -> FloatArray:
    """Find the sign (n,) for each normal such that neighbors in the forest agree. Each edge of the
    forest has the sign of the agreement of its two normals (`_agreement`); the sign of a point is
    the product of the signs of the edges from the point to the root of its tree.

    planes: the planes with their normals.
    parent: (n,) the parent of each point in the forest; a root is its own parent.

    The signs are multiplied along the paths by pointer doubling: after step i, `parent` is the
    ancestor 2^i generations up, or the root.
    """
    agreement = _agreement(planes, np.arange(len(parent)), parent)
    sign = np.where(agreement < 0.0, -1.0, 1.0)
    while True:
        ancestor = parent[parent]
        if np.array_equal(ancestor, parent):
            return sign
        sign *= sign[parent]
        parent = ancestor


def _outward_signs(x: FloatArray, normals: FloatArray, component: IntArray) -> FloatArray:
    """Find the sign (p,) for each connected component of a cloud such that the normals of its
    extreme points in 26 directions, on the whole, face outward. The extreme points of a flat
    component do not decide; its sign is that for which the normals point to the positive side of
    the coordinate axis nearest to them.

    x, normals: (n, 3) points, and normals that agree within each component.
    component: (n,) the component of each point.
    """
    # Sorted by component, so that each component is a range of rows.
    order = np.argsort(component, kind="stable")
    x, normals, component = x[order], normals[order], component[order]
    starts = np.flatnonzero(np.append(True, component[1:] != component[:-1]))
    outwardness = np.zeros(len(starts))
    for direction in _DIRECTIONS / np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True):
        height = x @ direction
        # The farthest point of each component in this direction (the first of several).
        highest = np.flatnonzero(height == np.maximum.reduceat(height, starts)[component])
        _, first = np.unique(component[highest], return_index=True)
        outwardness += normals[highest[first]] @ direction
    # For flat components, the largest coordinate of the sum of their normals decides.
    total = np.add.reduceat(normals, starts)
    main_component = np.take_along_axis(total, np.abs(total).argmax(axis=1)[:, None], axis=1)[:, 0]
    decisive = np.where(np.abs(outwardness) > 1e-6, outwardness, main_component)
    return np.where(decisive < 0.0, -1.0, 1.0)
