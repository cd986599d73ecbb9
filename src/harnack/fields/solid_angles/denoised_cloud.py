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
    checked_normals,
    checked_points,
    estimate_normals,
    point_tree,
)
from harnack.geometry.denoising import Denoising, lonely_points, noise_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from harnack.backend import FloatArray

    # Gradients (n, 3) of the sum at its points, given points, normals, areas and the smoothing.
    Gradients = Callable[[FloatArray, FloatArray, FloatArray, float], FloatArray]

# Normals are turned so often, by sums smoothed over so many spacings.
_TURNS, _OVER = 2, 3.0
# The smoothing length in spacings of the points that were moved; with little noise it is this times
# the root of noise over spacing, and if that is below the last number, there is none.
_SMOOTHING, _OF_ROOT, _NO_NOISE = 0.9, 1.4, 0.1
# The fewest points among which a surface, and what is far from it, can be seen.
_FEWEST = 32


@dataclass(frozen=True)
class FittedCloud:
    """points, normals: (m, 3) of the points that were kept, moved onto the surface. smoothing: the
    length over which their sum is to be smoothed; 0 where there is hardly any noise. facts: what
    was found, as for `Field.describe`."""

    points: FloatArray
    normals: FloatArray
    smoothing: float
    facts: dict[str, Any]

    @classmethod
    def of(cls, points: Any, normals: Any | None, gradients: Gradients) -> FittedCloud:
        """normals: (n, 3) or None to estimate them.

        Warns of points that are left out, as they are far from all others.

        Raises:
            CloudError: as `validate_cloud` and `estimate_normals`; few points.
        """
        x = checked_points(points)
        given = None if normals is None else checked_normals(normals, len(x))
        if len(x) < _FEWEST:
            raise CloudError(
                f"{len(x)} points do not show how much noise they have, at least {_FEWEST} are "
                'needed for smoothing="auto": give a length'
            )
        total, tree = len(x), point_tree(x)
        alone = lonely_points(x, tree)
        if len(alone):
            x = np.delete(x, alone, axis=0)
            given = None if given is None else np.delete(given, alone, axis=0)
            tree = point_tree(x)
            warnings.warn(
                f"{len(alone):,} of {total:,} points are far from all others and were left out",
                stacklevel=4,
            )
        cloud = Denoising(x, noise_of(x, given, tree), tree)
        if given is None:
            moved, turned = cloud.moved_and_turned(_normals(cloud, gradients))
        else:
            moved, turned = cloud.moved(given), given[cloud.chosen]
        noise, spacing = cloud.noise.deviation, cloud.spacing
        length = min(_SMOOTHING, _OF_ROOT * (noise / spacing) ** 0.5)
        facts = {
            "given": total,
            "left out": len(alone),
            "noise": float(f"{noise:.3g}"),
            "spacing": float(f"{spacing:.3g}"),
            "neighbors": cloud.noise.neighbors,
        }
        if length < _NO_NOISE:
            return cls(x[cloud.chosen], turned, 0.0, facts)
        return cls(moved, turned, length * spacing, facts)


def _normals(cloud: Denoising, gradients: Gradients) -> FloatArray:
    """Normals (m, 3) of the chosen points as they are given."""
    x = cloud.points[cloud.chosen]
    normals = estimate_normals(x)
    areas = np.full(len(x), cloud.spacing**2)
    for _ in range(_TURNS):
        slope = gradients(x, normals, areas, _OVER * cloud.spacing)
        against = np.einsum("ij,ij->i", slope, normals) > 0
        # Not the others, whose planes are less rounded at edges.
        normals[against] = -slope[against]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals
