"""How many triangles a tolerance will take, before they are made."""

from __future__ import annotations

import numpy as np

from harnack.backend import FloatArray
from harnack.meshing.checks import MeshingError, TooLargeError
from harnack.meshing.edges import IntArray
from harnack.meshing.samples import LevelFunction

__all__ = ["check_size"]


def check_size(
    function: LevelFunction, vertices: FloatArray, faces: IntArray, tolerance: float
) -> None:
    """Raise if the triangles that refinement would make of these are more than the function allows.

    How far the middle of a triangle is from the surface falls with its area: one that is k times
    the tolerance away takes about k others. Looked at is one triangle in several.

    Raises:
        MeshingError: the function has no slope between the vertices.
        TooLargeError: with the estimate, and a tolerance that would do.
    """
    some = faces[:: max(1, len(faces) // 20_000)]
    if not len(some):
        return
    corner = vertices[some]
    at = function.at(0.5 * (corner + np.roll(corner, 1, axis=1)).reshape(-1, 3))
    is_flat = (at.value != 0) & ~at.gradient.any(axis=1)
    if is_flat.any():
        raise MeshingError(
            f"{type(function.field).__name__} is constant at {is_flat.sum():,} of "
            f"{len(is_flat):,} middles of edges, so that it does not say how far the surface is: "
            "choose a smaller `spacing`, or a function with a slope within a cell of its surface"
        )
    middle = at.distance
    ratio = middle.reshape(-1, 3).max(axis=1) / tolerance
    expected = float(np.maximum(1.0, ratio).mean()) * len(faces)
    most = function.most_faces
    if expected > most:
        enough = expected / most
        raise TooLargeError(
            f"the tolerance takes about {expected:.1e} triangles, and max_triangles is {most:,}: "
            f"choose a `tolerance` {enough:.2g} times as large, or a larger max_triangles"
        )
