"""Prepare a noisy point cloud for a smoothed sum of dipoles (`DipolePotential`): points are moved
onto the surface, normals are estimated if the cloud has none, and the smoothing length is chosen.
Each point is a dipole along its normal; the sum of their potentials, smoothed over a length, falls
along outward normals across the surface.

Signs of estimated normals. Some may point inwards, for example at a thin ear where the estimate
confused the two sides. If most of the normals are right, the sum of all dipoles, smoothed over
several points, falls across the surface in the right direction also at points whose own normals
are wrong. So the sum corrects the signs (Lin et al. 2024).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.geometry.clouds import (
    CloudError,
    as_cloud_points,
    as_unit_normals,
    build_point_tree,
    estimate_normals,
)
from harnack.geometry.denoising import CloudDenoiser, estimate_noise, outlier_indices

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import FloatArray

    # A function that computes the gradients (n, 3) of a smoothed sum at the points of its dipoles.
    # Its arguments are points (n, 3), normals (n, 3), areas (n,) and the smoothing length.
    Gradients = Callable[[FloatArray, FloatArray, FloatArray, float], FloatArray]

# The number of rounds in which signs of normals are corrected; and the smoothing length of the sums
# that correct them, as a multiple of the spacing of the points.
_FLIP_ROUNDS, _FLIP_SMOOTHING = 2, 3.0
# The smoothing length, as a multiple of the spacing, is the smaller of `_SMOOTHING` and
# `_SMOOTHING_OF_ROOT` times the square root of noise over spacing. If it is below `_NO_NOISE`,
# points are not moved and the sum is not smoothed.
_SMOOTHING, _SMOOTHING_OF_ROOT, _NO_NOISE = 0.9, 1.4, 0.1
# The smallest number of points from which noise, and outliers, can be estimated.
_MIN_POINTS = 32


@dataclass(frozen=True)
class DenoisedCloud:
    """The result of denoising a point cloud: the points that were kept, their normals, and the
    length over which the sum of their dipoles is to be smoothed.

    points: (m, 3) the points that were kept, moved onto the surface. If there is hardly any noise
        they are where they were.
    normals: (m, 3) their unit normals.
    smoothing: the smoothing length; 0 if there is hardly any noise.
    report: entries for `Field.describe`: the number of given points and of points left out, the
        estimated noise, the spacing, and the number of neighbors of each fit.
    """

    points: FloatArray
    normals: FloatArray
    smoothing: float
    report: dict[str, Any]

    @classmethod
    def of(cls, points: Any, normals: Any | None, gradients: Gradients) -> DenoisedCloud:
        """Denoise a point cloud. Warns if points are left out because they are far from all others.

        points: (n, 3).
        normals: (n, 3), of any length; None to estimate them.
        gradients: a function that computes gradients of the smoothed sum (`Gradients`), by which
            signs of estimated normals are corrected.

        Raises:
            CloudError: the points or the normals are not valid, or there are too few points.
        """
        x = as_cloud_points(points)
        known_normals = None if normals is None else as_unit_normals(normals, len(x))
        if len(x) < _MIN_POINTS:
            raise CloudError(
                f"{len(x)} points do not show how much noise they have, at least {_MIN_POINTS} are "
                'needed for smoothing="auto": give a length'
            )
        total, tree = len(x), build_point_tree(x)
        outliers = outlier_indices(x, tree)
        if len(outliers):
            x = np.delete(x, outliers, axis=0)
            known_normals = (
                None if known_normals is None else np.delete(known_normals, outliers, axis=0)
            )
            tree = build_point_tree(x)
            # stacklevel=4: the warning names the line that makes the field.
            warnings.warn(
                f"{len(outliers):,} of {total:,} points are far from all others and were left out",
                stacklevel=4,
            )
        # If the noise is larger than the spacing, the denoiser selects only some of the points.
        cloud = CloudDenoiser(x, estimate_noise(x, known_normals, tree), tree)
        if known_normals is None:
            new_points, new_normals = cloud.denoise_points_and_normals(
                _estimated_normals(cloud, gradients)
            )
        else:
            new_points, new_normals = (
                cloud.denoise_points(known_normals),
                known_normals[cloud.selected],
            )
        noise, spacing = cloud.noise.deviation, cloud.spacing
        # As a multiple of the spacing. It grows with the root of the noise, up to a limit.
        smoothing = min(_SMOOTHING, _SMOOTHING_OF_ROOT * (noise / spacing) ** 0.5)
        report = {
            "given": total,
            "left out": len(outliers),
            "noise": float(f"{noise:.3g}"),
            "spacing": float(f"{spacing:.3g}"),
            "neighbors": cloud.noise.neighbor_count,
        }
        if smoothing < _NO_NOISE:
            return cls(x[cloud.selected], new_normals, 0.0, report)
        return cls(new_points, new_normals, smoothing * spacing, report)


def _estimated_normals(cloud: CloudDenoiser, gradients: Gradients) -> FloatArray:
    """Estimate normals (m, 3) of the selected points of a cloud, at their original positions, and
    correct their signs. Along a right normal, which points outwards, the smoothed sum of the
    dipoles falls. Where it rises along a normal, the normal is replaced by the direction in which
    the sum falls most.

    cloud: the cloud, with the selection of its points.
    gradients: a function that computes gradients of the smoothed sum (`Gradients`).
    """
    x = cloud.points[cloud.selected]
    normals = estimate_normals(x)
    # Each point stands for a square whose side is the spacing.
    areas = np.full(len(x), cloud.spacing**2)
    for _ in range(_FLIP_ROUNDS):
        slopes = gradients(x, normals, areas, _FLIP_SMOOTHING * cloud.spacing)
        is_flipped = np.einsum("ij,ij->i", slopes, normals) > 0
        # Other normals stay as they are: the fitted planes are less rounded at edges.
        normals[is_flipped] = -slopes[is_flipped]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals
