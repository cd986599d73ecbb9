"""Advice in errors about surfaces that touch or cross themselves. A point of a level set of f is
"singular" if the gradient of f is 0 there, such as a node of a Barth sextic, or a line along which
two sheets cross. No mesh of triangles without self-intersections is near such a surface."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Field
from harnack.fields.analytic.lobes import Lobes
from harnack.fields.analytic.riemann_surface import RiemannSurface
from harnack.geometry.mesh_edges import row_norms
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import LocalizedMeshingError, point_text
from harnack.meshing.sign_function import uses_sign_meshing

__all__ = ["singular_point", "singular_points_explained"]

# How many places are looked at; how many Newton steps are made from each.
_MOST_PLACES, _NEWTON_STEPS = 100, 6
# The largest distance of a singular point from the place, as a fraction of the size of the box.
_NEAR = 0.05
# The gradient counts as 0 if it is smaller than this fraction of the gradient at that distance; and
# f counts as its level if it differs by less than this fraction of its change over that distance.
_VANISHES = 0.05


@contextmanager
def singular_points_explained(
    field: Field, function: LevelFunction, size: Callable[[], float]
) -> Generator[None]:
    """A context that adds to the message of a LocalizedMeshingError raised in it, if the surface
    has a singular point near a place where the check failed.

    field: the field as the user gave it.
    function: the function of the level set that is meshed.
    size: a function that returns the longest side of the box in which it is meshed, a length. It
        is called only if there is an error.
    """
    try:
        yield
    except LocalizedMeshingError as error:
        if not error.is_explained:
            error.add(_advice(field, function, error.locations, size()))
        raise


def _advice(field: Field, function: LevelFunction, places: FloatArray, size: float) -> str:
    """What to add to the message of an error at some places (k, 3): why the surface may touch or
    cross itself there, and what to do; an empty text if there is no sign of that."""
    if uses_sign_meshing(field):
        return ""
    walls = 'walls about the surface, level=(-w, w) with side="between"'
    if isinstance(field, RiemannSurface):
        return f". Branches of a {type(field).__name__} may cross each other: choose {walls}"
    point = singular_point(function, places, size)
    if point is None:
        return ""
    reason = (
        f". The gradient of the function vanishes near {point_text(point)}: the surface may touch "
        "or cross itself there, and"
    )
    if isinstance(field, Lobes):
        return (
            f"{reason} lobes of both signs meet at the origin: mesh `lobes.positive` and "
            "`lobes.negative`, one by one, or choose a level below this one"
        )
    return f"{reason} smaller cells do not help: choose a level beside this one, or {walls}"


def singular_point(function: LevelFunction, places: FloatArray, size: float) -> FloatArray | None:
    """Look for a point (3,) near one of the places (k, 3) at which f is nearly its level and the
    gradient of f is nearly 0. Newton's method for a zero of the gradient starts at each place.
    Returns None if it finds no such point, or if f is an angle.

    function: f - level. size: the longest side of the box in which it is meshed, a length.
    """
    if function.period is not None or not len(places):
        return None
    start = places[:: -(-len(places) // _MOST_PLACES)]
    near, points = _NEAR * size, start
    for _ in range(_NEWTON_STEPS):
        step = _newton_step(function, points, 1e-4 * size)
        shrink = np.minimum(1.0, near / np.maximum(row_norms(step), 1e-300))
        points = points + step * shrink[:, None]
    samples = function.sample(points)
    # The median slope at some points at that distance.
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    around = (start[:, None] + near * directions).reshape(-1, 3)
    slopes = row_norms(function.sample(around).gradient).reshape(-1, 6)
    slope = np.median(slopes, axis=1)
    is_singular = (
        (row_norms(points - start) <= near)
        & (row_norms(samples.gradient) <= _VANISHES * slope)
        & (np.abs(samples.value) <= _VANISHES * slope * near)
        & (slope > 0)
    )
    return points[np.flatnonzero(is_singular)[0]] if is_singular.any() else None


def _newton_step(function: LevelFunction, points: FloatArray, step: float) -> FloatArray:
    """(n, 3) the steps of Newton's method from points (n, 3) to a zero of the gradient of f;
    0 where f has no finite second derivatives.

    step: for differences of gradients, a length.
    """
    moved = (points[:, None] + step * np.concatenate([np.eye(3), -np.eye(3)])).reshape(-1, 3)
    gradients = function.sample(moved).gradient.reshape(-1, 6, 3)
    hessian = (gradients[:, :3] - gradients[:, 3:]) / (2 * step)
    gradient = function.sample(points).gradient
    is_finite = np.isfinite(hessian).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
    steps = np.zeros_like(points)
    # Along lines and planes of singular points the matrix of second derivatives is degenerate: the
    # step that is shortest.
    inverse = np.linalg.pinv(hessian[is_finite], rcond=1e-2)
    steps[is_finite] = -np.einsum("nij,nj->ni", inverse, gradient[is_finite])
    return steps
