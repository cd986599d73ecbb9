"""Prepare noisy points for a smoothed sum of dipoles: points moved onto the surface, estimated
normals if the cloud has none, and the smoothing length.

The sum itself corrects the signs of estimated normals (Lin et al. 2024). If most of the normals are
right, the sum of all dipoles, smoothed over several points, falls across the surface in the right
direction also at points whose own normals are wrong. Such points are, for example, those of a thin
ear where the estimate confused the two sides.
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

    # A function that returns the gradients (n, 3) of the smoothed sum at the points of its dipoles,
    # from points (n, 3), normals (n, 3), areas (n,) and the smoothing length.
    Gradients = Callable[[FloatArray, FloatArray, FloatArray, float], FloatArray]

# The number of rounds in which signs of normals are corrected, and the smoothing length of the sums
# that correct them, in spacings.
_FLIP_ROUNDS, _FLIP_SMOOTHING = 2, 3.0
# The smoothing length, as a multiple of the spacing, is the smaller of `_SMOOTHING` and
# `_SMOOTHING_OF_ROOT` times the square root of noise over spacing. If it is below `_NO_NOISE`,
# points are not moved and the sum is not smoothed.
_SMOOTHING, _SMOOTHING_OF_ROOT, _NO_NOISE = 0.9, 1.4, 0.1
# The smallest number of points from which noise, and outliers, can be estimated.
_MIN_POINTS = 32


@dataclass(frozen=True)
class DenoisedCloud:
    """The result of denoising a cloud: the points that were kept, and the length over which the sum
    of their dipoles is to be smoothed.

    points, normals: (m, 3) of the points that were kept, moved onto the surface.
    smoothing: the length over which their sum is to be smoothed; 0 if there is hardly any noise.
    report: the estimated noise, the spacing, and the numbers of points, as entries for
        `Field.describe`.
    """

    points: FloatArray
    normals: FloatArray
    smoothing: float
    report: dict[str, Any]

    @classmethod
    def of(cls, points: Any, normals: Any | None, gradients: Gradients) -> DenoisedCloud:
        """Denoise points (n, 3) with normals (n, 3). If `normals` is None, they are estimated.

        gradients: computes gradients of the smoothed sum, by which signs of estimated normals are
            corrected.

        Warns if points are left out because they are far from all others.

        Raises:
            CloudError: as `validate_cloud` and `estimate_normals`; or there are too few points.
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
            warnings.warn(
                f"{len(outliers):,} of {total:,} points are far from all others and were left out",
                stacklevel=4,
            )
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
    """Estimate normals (m, 3) of the selected points of a cloud, at their original positions. Where
    the smoothed sum rises along a normal, the normal is replaced by the direction in which the sum
    falls.

    gradients: a function that returns gradients of the smoothed sum, from points, normals, areas
        and the smoothing length.
    """
    x = cloud.points[cloud.selected]
    normals = estimate_normals(x)
    areas = np.full(len(x), cloud.spacing**2)
    for _ in range(_FLIP_ROUNDS):
        slopes = gradients(x, normals, areas, _FLIP_SMOOTHING * cloud.spacing)
        is_flipped = np.einsum("ij,ij->i", slopes, normals) > 0
        # Other normals stay as they are: the fitted planes are less rounded at edges.
        normals[is_flipped] = -slopes[is_flipped]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals
