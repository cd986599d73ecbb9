"""Tests, by sampling, of the bounds that a Riemann surface states near its branch points. A Riemann
surface is a field made of a multivalued complex function of z; a branch is one of the values of
this function. The field's function g is the real or imaginary part of a branch, possibly known
modulo a period only. At a branch point several branches meet, and near it all branches are close to
a single value."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy
from harnack.fields.analytic.branches import complex_type
from harnack.testing.violation_search import require

if TYPE_CHECKING:
    from harnack.fields.analytic.branches import BranchPoint
    from harnack.fields.analytic.riemann_surface import RiemannSurface

__all__ = ["check_branch_points"]

# The number of test points around each branch point, and their smallest distance from it, as a
# fraction of the radius within which the bound is stated.
_POINT_COUNT, _MIN_RADIUS_FRACTION = 4000, 1e-6
# An upper bound of the rounding errors of branches and of their power.
_ROUNDING = 1e-6


def check_branch_points(field: RiemannSurface, size: float, rng: np.random.Generator) -> None:
    """Check the bounds that a Riemann surface states for its branch points.

    field: the Riemann surface.
    size: the size of the domain, which takes the place of an infinite radius.
    rng: a generator of random numbers.

    The bound for a branch point with the attributes location, value, constant and power is |g(z) -
    value| <= constant |z - location|^power for complex z within its radius, on every branch, modulo
    the period. Bounds along rays near a branch point are derived from this. It needs a test of its
    own, because few random rays come so near.

    Raises:
        BrokenPromiseError: the message names the branch point, and a point where the bound does not
            hold.
    """
    for point in field.branches.branch_points:
        if point.power is not None:
            _check_branch_point(field, point, min(point.radius, size), rng)


def _check_branch_point(
    field: RiemannSurface, point: BranchPoint, radius: float, rng: np.random.Generator
) -> None:
    """Check the bound that a Riemann surface states for one branch point, at random complex points
    within `radius` of it. `check_branch_points` has the formula of the bound.

    rng: a generator of random numbers.

    Raises:
        BrokenPromiseError: the bound does not hold.
    """
    backend = choose_backend("double")
    assert point.power is not None
    # Half of the points are near the branch point, half are spread evenly over the disc.
    radii = radius * np.where(
        rng.random(_POINT_COUNT) < 0.5,
        _MIN_RADIUS_FRACTION ** rng.random(_POINT_COUNT),
        np.sqrt(rng.random(_POINT_COUNT)) * (1 - 1e-9),
    )
    angle = rng.uniform(-math.pi, math.pi, _POINT_COUNT)
    x, y = point.location.real + radii * np.cos(angle), point.location.imag + radii * np.sin(angle)
    # Computed again from the rounded points.
    radii = np.hypot(x - point.location.real, y - point.location.imag)
    branches = field.branches.on_backend(backend)
    imaginary = field.part == "imag"
    period = field.branches.period(imaginary)
    value = point.value.imag if imaginary else point.value.real
    bound = point.constant * radii**point.power
    # The largest difference of any branch from the stated value, at each point; NaN if a branch is
    # NaN, so that the test fails.
    errors = np.zeros(_POINT_COUNT)
    for branch in branches.evaluate(complex_type(backend)(backend.Float(x), backend.Float(y))):
        component = branch.value.imag if imaginary else branch.value.real
        error: FloatArray = to_numpy(component) - value
        if period is not None:
            error = error - period * np.round(error / period)
        errors = np.maximum(errors, np.abs(error))
    # The rounding of the bound, of the values and of the point's location.
    rounding = _ROUNDING * (bound + 1e-6 * abs(value)) + 2.0**-48 * (
        abs(value) + np.abs(point.location)
    )
    require(
        errors <= bound + rounding,
        f"BranchPoint({point.location}): a branch is farther from the value {point.value} than "
        f"{point.constant:g} |z - at|^{point.power:g}: the constant must be at least "
        f"{(errors / radii**point.power).max():.6g}",
        np.column_stack([x, y, np.full(_POINT_COUNT, field.height * value)]),
        errors - bound,
    )
