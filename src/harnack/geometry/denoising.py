"""Point clouds with noise: an estimate of the noise, and points moved onto the surface that they
sample. A cloud has points (n, 3) and unit normals (n, 3). A point with noise lies off the surface
by some distance, whose standard deviation is the noise; the spacing is the distance of neighboring
points. The neighbors of a point are the points nearest to it. `CloudDenoiser` moves points along
their normals to the height of the surface that their neighbors predict, so that sums over them need
less smoothing, and edges stay sharper.

Let x be a point with the normal n. A neighbor j of it, at p_j with the normal n_j, predicts that
the surface near x is at the height

    t_j = (n + n_j)/2 . (p_j - x)

above x, along the normal n of x. If x is on the surface, t_j is 0 on a sphere, and to second order
on every surface, however far the neighbor is: at x, the tangent plane of j is as far outside of the
surface as p_j is inside of the tangent plane of x. So the mean of t_j does not shrink curved
surfaces, as the mean of the positions would. Neighbors are weighted by distance and by the angle
between n and n_j, so that neighbors around an edge or on the other side of a wall do not count.

The noise is removed from the points, not from the field. A kernel wide enough for the noise rounds
all edges and shrinks curved parts. Points moved along their normals need to be smoothed over a
spacing only: the mean error of surfaces was a tenth to a third less than by smoothing over 1.4
sqrt(noise * spacing) alone, and areas were right, which had been twice as large. The field stays a
sum of dipoles, with all its bounds: only its data change (`denoised_cloud`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend.validation import BoolArray, FloatArray, IntArray
from harnack.geometry.clouds import (
    Indices,
    build_point_tree,
    nearest_neighbors,
    parallel_over_slices,
)

__all__ = ["CloudDenoiser", "NoiseEstimate", "estimate_noise", "outlier_indices"]

# A point is an outlier if the distance of its fourth neighbor is more than _OUTLIER_RATIO times the
# typical distance of fourth neighbors.
_OUTLIER_RATIO, _OUTLIER_NEIGHBORS = 6.0, 4
# Noise is measured at _PROBES points. The number of neighbors is the first of _COUNTS for which the
# farthest neighbor is at least _MIN_REACH standard deviations away. Neighbors do not count if the
# cosine between the normals is at most _MIN_NORMAL_COSINE, 60 degrees.
_PROBES, _COUNTS, _MIN_REACH, _MIN_NORMAL_COSINE = 1000, (16, 64, 256, 1024), 4.5, 0.5
# _NEIGHBORS_PER_NOISE * noise / spacing neighbors are used, within the two limits: half of them lie
# within 3.1 sqrt(noise * spacing), by experiment a compromise of noise and detail.
_NEIGHBORS_PER_NOISE, _MIN_NEIGHBORS, _MAX_NEIGHBORS = 62.0, 16, 256
# If noise / spacing exceeds _MAX_NOISE_PER_SPACING, only a random fraction
# _MAX_NOISE_PER_SPACING * spacing / noise of the points (at least _MIN_KEPT_FRACTION) is selected
# and moved. All points still count as neighbors.
_MAX_NOISE_PER_SPACING, _MIN_KEPT_FRACTION = 1.2, 0.1
# The weight of a neighbor falls to exp(-3) at the farthest one, and to 1/e if its normal n_j has
# this difference |n - n_j|: for given normals, and for estimated ones.
_DISTANCE_DECAY, _NORMAL_SCALE, _ESTIMATED_NORMAL_SCALE = 3.0, 0.8, 0.4
# Normals are estimated again from moved points _NORMAL_ITERATIONS times, each from
# _PLANE_NEIGHBORS points. Where only a fraction of the points is moved, these are first moved by
# _INITIAL_NEIGHBORS of each other.
_NORMAL_ITERATIONS, _PLANE_NEIGHBORS, _INITIAL_NEIGHBORS = 2, 32, 32
# A point is not moved if its neighbors face the other way: then the rate at which the mean of t_j
# falls, as the point moves along n, is below this.
_MIN_SLOPE = 0.25
# A point is dropped if less than this fraction of its neighbors, by weight, has a normal similar to
# its own estimated one: such points lie in the middle of thin parts. At edges and corners the
# fraction is larger.
_MIN_AGREEING_WEIGHT = 0.1


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of a cloud: how far its points lie off the surface. Both lengths are in the unit of
    the points.

    deviation: the standard deviation of the points from the surface, along its normal.
    spacing: the square root of the median area that a point stands for.
    """

    deviation: float
    spacing: float

    @property
    def neighbor_count(self) -> int:
        """The number of neighbors whose predicted heights of the surface are averaged; more noise
        needs more."""
        count = round(_NEIGHBORS_PER_NOISE * self.deviation / self.spacing)
        return min(max(count, _MIN_NEIGHBORS), _MAX_NEIGHBORS)

    def kept_fraction(self) -> float:
        """The fraction, at most 1, of the points that `CloudDenoiser` selects and moves. If the
        noise is large relative to the spacing, it is less than 1: fewer points show the surface
        just as well."""
        fraction = _MAX_NOISE_PER_SPACING * self.spacing / max(self.deviation, 1e-300)
        return min(max(fraction, _MIN_KEPT_FRACTION), 1.0)


def outlier_indices(points: FloatArray, tree: Any) -> IntArray:
    """Find the outliers among points (n, 3): points whose fourth neighbor is more than six times as
    far away as the fourth neighbor of a typical point. The typical distance is the median over the
    point's own neighbors, or the median over all points, whichever is larger. Returns the indices
    (k,).

    tree: the search tree of these points.
    """
    count = min(_OUTLIER_NEIGHBORS, len(points) - 1)
    nearest = np.empty((len(points), count), np.int64)
    distances = np.empty(len(points))

    def find_neighbors(rows: slice) -> None:
        """Find the neighbors of the points `rows`, and the distance of each point from its fourth
        neighbor."""
        distance, index = tree.query(points[rows], k=count + 1)
        nearest[rows], distances[rows] = index[:, 1:], distance[:, -1]

    parallel_over_slices(find_neighbors, len(points))
    # The larger one of the two typical distances.
    expected = np.maximum(np.median(distances[nearest], axis=1), np.median(distances))
    return np.flatnonzero(distances > _OUTLIER_RATIO * expected)


def estimate_noise(points: FloatArray, normals: FloatArray | None, tree: Any) -> NoiseEstimate:
    """Estimate the noise and the spacing of a cloud.

    Up to 1000 points of the cloud are probes. A neighbor j of a probe, at p_j with the normal n_j,
    predicts that the surface is at the height t_j = (n + n_j)/2 . (p_j - x) above a probe x with
    the normal n. The noise is the median, over the probes, of the standard deviation of t_j. If
    `normals` is None, distances from the plane that best fits the neighbors are used instead, so
    that curvature counts as noise.

    The number of neighbors grows from 16 to at most 1024, until the farthest neighbor of a probe is
    (in the median over the probes) 4.5 standard deviations away: fewer neighbors reach no farther
    than the noise, and show no surface.

    points: (n, 3).
    normals: (n, 3) unit normals, or None.
    tree: the search tree of the points.
    """
    rng = np.random.default_rng(0)
    probes = np.sort(rng.choice(len(points), min(len(points), _PROBES), replace=False))
    noise = NoiseEstimate(0.0, 1.0)  # replaced in the loop
    for count in _COUNTS:
        index, distance = nearest_neighbors(tree, points[probes], count)
        offsets = points[index] - points[probes, None]
        if normals is None:
            deviation = float(np.median(_deviations_from_planes(offsets)))
        else:
            deviations = _deviations_by_normals(offsets, normals[probes], normals[index])
            deviation = float(np.median(deviations))
        radius = float(np.median(distance[:, -1]))
        # count neighbors in a disc of this radius: each stands for radius^2 pi / count.
        noise = NoiseEstimate(deviation, radius * math.sqrt(math.pi / index.shape[1]))
        # Also stop if the cloud has no more points.
        if radius >= _MIN_REACH * deviation or index.shape[1] < count:
            break
    return noise


def _deviations_from_planes(offsets: FloatArray) -> FloatArray:
    """For each of m points, the standard deviation (m,) of its neighbors from the plane that fits
    them best.

    offsets: (m, k, 3) from the point to its neighbors.
    """
    centered = offsets - offsets.mean(axis=1, keepdims=True)
    variances = np.linalg.eigvalsh(np.matmul(centered.transpose(0, 2, 1), centered))
    # A plane has three parameters.
    degrees_of_freedom = max(offsets.shape[1] - 3, 1)
    return np.sqrt(np.maximum(variances[:, 0], 0.0) / degrees_of_freedom)


def _min_variance_axes(offsets: FloatArray, weights: FloatArray | None) -> FloatArray:
    """For each of m points, the unit vector (m, 3) along which the offsets of its neighbors vary
    least: the one with the smallest weighted sum of squared components.

    offsets: (m, k, 3).
    weights: (m, k) of the offsets; None for equal weights.
    """
    weighted = offsets if weights is None else offsets * weights[:, :, None]
    _, axes = np.linalg.eigh(np.matmul(weighted.transpose(0, 2, 1), offsets))
    return axes[:, :, 0]


def _deviations_by_normals(
    offsets: FloatArray, normals: FloatArray, neighbor_normals: FloatArray
) -> FloatArray:
    """For each of m points, compute the standard deviation (m,) of the heights of the surface that
    its neighbors predict. A neighbor j with the offset d_j and the normal n_j predicts the surface
    at the height t_j = (n + n_j)/2 . d_j above a point with the normal n. Only neighbors with a
    similar normal count.

    offsets: (m, k, 3) from each point to its neighbors.
    normals: (m, 3) the unit normals of the points.
    neighbor_normals: (m, k, 3) the unit normals of the neighbors.
    """
    is_similar = np.einsum("mi,mki->mk", normals, neighbor_normals) > _MIN_NORMAL_COSINE
    heights = np.einsum("mki,mki->mk", 0.5 * (normals[:, None] + neighbor_normals), offsets)
    # At least 2, as count - 1 divides.
    count = np.maximum(is_similar.sum(axis=1), 2)
    mean = (heights * is_similar).sum(axis=1) / count
    return np.sqrt(((heights - mean[:, None]) ** 2 * is_similar).sum(axis=1) / (count - 1))


class CloudDenoiser:
    """Moves points of a noisy cloud along their normals onto the surface that the cloud samples.
    The selected points are moved. These are all points, or a random part of them if the noise is so
    large that fewer points show the surface just as well. All points count as neighbors.

    points: (n, 3).
    noise: the noise of the cloud.
    tree: the search tree of the points.
    selected: (m,) indices of the selected points.
    """

    def __init__(self, points: FloatArray, noise: NoiseEstimate, tree: Any | None = None) -> None:
        """Select the points to be moved. points, noise: the cloud, and its noise. tree: the search
        tree of the points; it is built if it is None."""
        self.points, self.noise = points, noise
        self.tree = build_point_tree(points) if tree is None else tree
        self.selected = np.arange(len(points))
        if (fraction := noise.kept_fraction()) < 1:
            subset = np.random.default_rng(0).choice(
                len(points), max(4, round(fraction * len(points))), replace=False
            )
            # In the order of the tree, so that neighbors of neighbors are looked up together.
            rank = np.empty(len(points), np.int64)
            rank[self.tree.indices] = self.selected
            self.selected = subset[np.argsort(rank[subset])]

    @property
    def spacing(self) -> float:
        """The mean distance between neighboring selected points, in the unit of the points."""
        return self.noise.spacing * math.sqrt(len(self.points) / len(self.selected))

    def denoise_points(self, normals: FloatArray) -> FloatArray:
        """Move the selected points along their known normals onto the surface; returns the points
        (m, 3). If only a part of the points is selected, the selected points are first moved to the
        heights that the nearest selected points predict, so that the search for neighbors starts
        near the surface.

        normals: (n, 3) the unit normals of all points.
        """
        points, own_normals = self.points[self.selected], normals[self.selected]
        if len(points) < len(self.points):
            points = _move_along_normals(
                points,
                own_normals,
                _neighbors(build_point_tree(points), points, _INITIAL_NEIGHBORS),
                points,
                own_normals,
                _NORMAL_SCALE,
            )
        neighbors = _neighbors(self.tree, points, self.noise.neighbor_count)
        return _move_along_normals(
            points, own_normals, neighbors, self.points, normals, _NORMAL_SCALE
        )

    def denoise_points_and_normals(self, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Move the selected points and improve their normals, in alternation. Returns points and
        unit normals, (k, 3) each. k may be less than m: a point is dropped if hardly any of its
        neighbors has a normal similar to its own.

        normals: (m, 3) estimated unit normals of the selected points.
        """
        start, normal_scale = self.points[self.selected], _ESTIMATED_NORMAL_SCALE
        if len(start) == len(self.points):
            # `nearest`: for each point of the cloud, the selected point whose normal it gets.
            # `adjacent`: for each selected point, its neighbors among the selected points.
            nearest = self.selected
            adjacent = _neighbors(self.tree, start, _PLANE_NEIGHBORS)
        else:
            tree = build_point_tree(start)
            nearest = _neighbors(tree, self.points, 1)[:, 0]  # a single neighbor
            adjacent = _neighbors(tree, start, _INITIAL_NEIGHBORS)
            start = _move_along_normals(start, normals, adjacent, start, normals, normal_scale)
        neighbors = _neighbors(self.tree, start, self.noise.neighbor_count)
        moved = _move_along_normals(
            start, normals, neighbors, self.points, normals[nearest], normal_scale
        )
        for _ in range(_NORMAL_ITERATIONS):
            normals = _refit_normals(moved, normals, adjacent, normal_scale)
            moved = _move_along_normals(
                start, normals, neighbors, self.points, normals[nearest], normal_scale
            )
        # Points are judged at their old places, where their neighbors were found.
        is_self = neighbors == self.selected[:, None]
        is_kept = (
            _agreeing_weight(
                start, normals, neighbors, is_self, self.points, normals[nearest], normal_scale
            )
            >= _MIN_AGREEING_WEIGHT
        )
        return moved[is_kept], normals[is_kept]


def _neighbors(tree: Any, points: FloatArray, count: int) -> Indices:
    """Find the points of a tree that are nearest to points (m, 3); returns their indices (m, k). A
    point that belongs to the tree is its own first neighbor. k = `count`, or less if the tree has
    fewer points."""
    count = min(count, tree.n)
    index = np.empty((len(points), count), np.int32)

    def find_slice(rows: slice) -> None:
        """Find the indices of the neighbors of the points in a slice of all points, and store them
        in the array `index` of the enclosing function."""
        # (`query` returns distances and indices.)
        index[rows] = tree.query(points[rows], k=count)[1].reshape(-1, count)

    parallel_over_slices(find_slice, len(points))
    return index


def _move_along_normals(
    start: FloatArray,
    own_normals: FloatArray,
    neighbors: Indices,
    points: FloatArray,
    normals: FloatArray,
    normal_scale: float,
) -> FloatArray:
    """Move points along their normals onto the surface that their neighbors predict; returns the
    moved points (m, 3). A neighbor j at p_j with the normal n_j predicts that the surface is at the
    height t_j = (n + n_j)/2 . (p_j - x) above a point x with the normal n. Each point moves along n
    to where the weighted mean of t_j is 0. A point stays in its place if the weighted mean of t_j
    hardly changes with the movement, as where the normals of the neighbors point the other way.

    start: (m, 3) the points.
    own_normals: (m, 3) their unit normals.
    neighbors: (m, k) indices of their neighbors among `points`.
    points, normals: (n, 3) each, the points of the cloud and their unit normals.
    normal_scale: the difference |n - n_j| at which the weight of a neighbor falls to 1/e.

    Weights depend on the distance along the tangent plane only. If they depended on the distance in
    space, neighbors that are off the surface to the same side as the point would hold it there.
    """
    moved = np.empty_like(start)

    def move_slice(rows: slice) -> None:
        """Move the points in a slice of `start`, and store them in `moved` (arrays of the enclosing
        function)."""
        n, index = own_normals[rows], neighbors[rows]
        neighbor_normals, offsets = normals[index], points[index] - start[rows, None]
        # n . (p_j - x), the height of each neighbor above the point.
        height = np.einsum("mi,mki->mk", n, offsets)
        cosine = np.einsum("mi,mki->mk", n, neighbor_normals)
        weight = _weights(_squared_tangential(offsets, height), cosine, normal_scale)
        # t_j, the mean of n_j . (p_j - x) and n . (p_j - x); both are linear where x moves along n.
        predicted = 0.5 * (np.einsum("mki,mki->mk", neighbor_normals, offsets) + height)
        # The rate at which the mean of t_j falls as x moves along n.
        slope = 0.5 * (weight * (cosine + 1)).sum(axis=1)
        # A point with a smaller slope stays.
        mean = np.where(slope > _MIN_SLOPE, (weight * predicted).sum(axis=1), 0.0)
        moved[rows] = start[rows] + (mean / np.maximum(slope, _MIN_SLOPE))[:, None] * n

    parallel_over_slices(move_slice, len(start))
    return moved


def _agreeing_weight(
    start: FloatArray,
    own_normals: FloatArray,
    neighbors: Indices,
    is_own: BoolArray,
    points: FloatArray,
    normals: FloatArray,
    normal_scale: float,
) -> FloatArray:
    """For each of m points, the fraction (m,) of its neighbors, by weight, that have a normal
    similar to its own. Neighbors have weights that fall with the distance. A normal counts as
    similar by a number that is 1 for equal normals and falls with the angle between them.

    start, own_normals: (m, 3) the points whose fractions are computed, and their unit normals.
    neighbors: (m, k) indices of their neighbors among `points`, the cloud.
    is_own: (m, k) whether a neighbor is the point itself, which does not count.
    points, normals: (n, 3) each, the points of the cloud and their unit normals.
    normal_scale: the length |n - n'| of the difference of two unit normals at which this number is
        1/e.
    """
    fraction = np.empty(len(start))

    def compute_slice(rows: slice) -> None:
        """Compute the results of `_agreeing_weight` for the points in a slice of `start`, and store
        them in `fraction` (arrays of the enclosing function)."""
        n, index = own_normals[rows], neighbors[rows]
        offsets = points[index] - start[rows, None]
        # n . (p_j - x), the height of each neighbor above the point's tangent plane.
        height = np.einsum("mi,mki->mk", n, offsets)
        # The weight by distance alone; 0 for a neighbor that is the point itself.
        weight = (
            np.exp(-_DISTANCE_DECAY * _relative_to_largest(_squared_tangential(offsets, height)))
            * ~is_own[rows]
        )
        cosine = np.einsum("mi,mki->mk", n, normals[index])
        # The part of this weight that is left if neighbors with other normals count less.
        fraction[rows] = (weight * _normal_weight(cosine, normal_scale)).sum(axis=1) / weight.sum(
            axis=1
        )

    parallel_over_slices(compute_slice, len(start))
    return fraction


def _refit_normals(
    points: FloatArray, normals: FloatArray, neighbors: Indices, normal_scale: float
) -> FloatArray:
    """Fit new unit normals (m, 3) to points. A normal is that of the plane that best fits the
    point's neighbors, where neighbors with a similar normal have the largest weight. Of its two
    signs, the one nearer to the old normal is taken.

    points: (m, 3).
    normals: (m, 3) the old normals.
    neighbors: (m, k) indices of the neighbors among the points.
    normal_scale: the difference |n - n'| of two unit normals at which the weight of a neighbor
        falls to 1/e.
    """
    refitted = np.empty_like(normals)

    def refit_slice(rows: slice) -> None:
        """Fit normals at the points in a slice of `points`, and store them in `refitted` (arrays of
        the enclosing function)."""
        index = neighbors[rows]
        offsets = points[index] - points[rows, None]
        cosine = np.einsum("mi,mki->mk", normals[rows], normals[index])
        weight = _weights(_squared_lengths(offsets), cosine, normal_scale)
        # Relative to the weighted mean of the neighbors.
        offsets -= np.einsum("mk,mki->mi", weight, offsets)[:, None]
        axis = _min_variance_axes(offsets, weight)
        is_reversed = np.einsum("mi,mi->m", axis, normals[rows]) < 0
        refitted[rows] = np.where(is_reversed[:, None], -axis, axis)

    parallel_over_slices(refit_slice, len(points))
    return refitted


def _squared_lengths(offsets: FloatArray) -> FloatArray:
    """The squared lengths (m, k) of offsets (m, k, 3)."""
    return np.einsum("mki,mki->mk", offsets, offsets)


def _squared_tangential(offsets: FloatArray, height: FloatArray) -> FloatArray:
    """The squared lengths (m, k) of the parts of offsets (m, k, 3) that are parallel to the tangent
    planes.

    height: (m, k) the components of the offsets along the normals.
    """
    return np.maximum(_squared_lengths(offsets) - height * height, 0.0)


def _relative_to_largest(square: FloatArray) -> FloatArray:
    """Squared distances (m, k), divided by the largest one in each row."""
    return square / np.maximum(square.max(axis=1, keepdims=True), 1e-300)


def _normal_weight(cosine: FloatArray, normal_scale: float) -> FloatArray:
    """Weights (m, k) of neighbors by the angle between normals: 1 for equal normals, 1/e for
    normals whose difference has the length `normal_scale`.

    cosine: (m, k) the cosines of the angles.
    """
    # |n - n'|^2 = 2 - 2 cos.
    return np.exp(-(2 - 2 * cosine) / normal_scale**2)


def _weights(square: FloatArray, cosine: FloatArray, normal_scale: float) -> FloatArray:
    """Weights (m, k) of the neighbors of m points, with sum 1 in each row. They fall with the
    distance and with the angle between normals.

    square: (m, k) the squared distances.
    cosine: (m, k) the cosines of the angles between the normals.
    normal_scale: the length |n - n'| of the difference of two unit normals at which the weight
        falls to 1/e.
    """
    weight = np.exp(-_DISTANCE_DECAY * _relative_to_largest(square)) * _normal_weight(
        cosine, normal_scale
    )
    return weight / weight.sum(axis=1, keepdims=True)
