"""Points with noise made ready for a smoothed sum of dipoles: moved onto the surface, with normals
where there are none, and the length over which to smooth.

Estimated normals are turned by the sum itself (Lin et al. 2024): where most of them are right, the
sum of all, smoothed over several points, falls across the surface in the right direction at the
others too, such as those of a thin ear whose two sides were told apart wrongly.
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

    # Gradients (n, 3) of the sum at its points, given points, normals, areas and the smoothing.
    Gradients = Callable[[FloatArray, FloatArray, FloatArray, float], FloatArray]

# Normals are turned so often, by sums smoothed over so many spacings.
_FLIP_ROUNDS, _FLIP_SMOOTHING = 2, 3.0
# The smoothing length in spacings of the points that were moved; with little noise it is this times
# the root of noise over spacing, and if that is below the last number, there is none.
_SMOOTHING, _SMOOTHING_OF_ROOT, _NO_NOISE = 0.9, 1.4, 0.1
# The fewest points among which a surface, and what is far from it, can be seen.
_MIN_POINTS = 32


@dataclass(frozen=True)
class DenoisedCloud:
    """points, normals: (m, 3) of the points that were kept, moved onto the surface. smoothing: the
    length over which their sum is to be smoothed; 0 where there is hardly any noise. facts: what
    was found, as for `Field.describe`."""

    points: FloatArray
    normals: FloatArray
    smoothing: float
    report: dict[str, Any]

    @classmethod
    def of(cls, points: Any, normals: Any | None, gradients: Gradients) -> DenoisedCloud:
        """normals: (n, 3) or None to estimate them.

        Warns of points that are left out, as they are far from all others.

        Raises:
            CloudError: as `validate_cloud` and `estimate_normals`; few points.
        """
        x = as_cloud_points(points)
        given = None if normals is None else as_unit_normals(normals, len(x))
        if len(x) < _MIN_POINTS:
            raise CloudError(
                f"{len(x)} points do not show how much noise they have, at least {_MIN_POINTS} are "
                'needed for smoothing="auto": give a length'
            )
        total, tree = len(x), build_point_tree(x)
        alone = outlier_indices(x, tree)
        if len(alone):
            x = np.delete(x, alone, axis=0)
            given = None if given is None else np.delete(given, alone, axis=0)
            tree = build_point_tree(x)
            warnings.warn(
                f"{len(alone):,} of {total:,} points are far from all others and were left out",
                stacklevel=4,
            )
        cloud = CloudDenoiser(x, estimate_noise(x, given, tree), tree)
        if given is None:
            moved, turned = cloud.denoise_points_and_normals(_normals(cloud, gradients))
        else:
            moved, turned = cloud.denoise_points(given), given[cloud.selected]
        noise, spacing = cloud.noise.deviation, cloud.spacing
        length = min(_SMOOTHING, _SMOOTHING_OF_ROOT * (noise / spacing) ** 0.5)
        facts = {
            "given": total,
            "left out": len(alone),
            "noise": float(f"{noise:.3g}"),
            "spacing": float(f"{spacing:.3g}"),
            "neighbors": cloud.noise.neighbor_count,
        }
        if length < _NO_NOISE:
            return cls(x[cloud.selected], turned, 0.0, facts)
        return cls(moved, turned, length * spacing, facts)


def _normals(cloud: CloudDenoiser, gradients: Gradients) -> FloatArray:
    """Normals (m, 3) of the chosen points as they are given."""
    x = cloud.points[cloud.selected]
    normals = estimate_normals(x)
    areas = np.full(len(x), cloud.spacing**2)
    for _ in range(_FLIP_ROUNDS):
        slope = gradients(x, normals, areas, _FLIP_SMOOTHING * cloud.spacing)
        against = np.einsum("ij,ij->i", slope, normals) > 0
        # Not the others, whose planes are less rounded at edges.
        normals[against] = -slope[against]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals
