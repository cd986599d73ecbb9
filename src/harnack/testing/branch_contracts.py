"""Contracts of the branches of a Riemann surface, tested by sampling."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.backend import FloatArray, choose_backend, to_numpy
from harnack.fields.analytic.branches import complex_type
from harnack.testing.violation_search import require

if TYPE_CHECKING:
    from harnack.fields.analytic.branches import BranchPoint
    from harnack.fields.analytic.riemann_surface import RiemannSurface

__all__ = ["check_branch_points"]

# Places about each branch point, and the least of their distances, in sizes.
_PLACES, _NEAREST = 4000, 1e-6
# More than the rounding of branches and of their power.
_SLACK = 1e-6


def check_branch_points(field: RiemannSurface, size: float, rng: np.random.Generator) -> None:
    """Check that |g - value| <= constant |z - at|^power within the radius of each branch point, for
    the part of g that is drawn, up to its period. Enclosures near a branch point are derived from
    that, and few rays come so near by chance.

    size: of the domain; it limits an infinite radius.

    Raises:
        BrokenPromiseError: naming the branch point, and the point where the bound does not hold.
    """
    for point in field.branches.branch_points:
        if point.power is not None:
            _check_branch_point(field, point, min(point.radius, size), rng)


def _check_branch_point(
    field: RiemannSurface, point: BranchPoint, radius: float, rng: np.random.Generator
) -> None:
    backend = choose_backend("double")
    assert point.power is not None
    # As many near the point as near the circle, where the power's share of g is least.
    away = radius * np.where(
        rng.random(_PLACES) < 0.5,
        _NEAREST ** rng.random(_PLACES),
        np.sqrt(rng.random(_PLACES)) * (1 - 1e-9),
    )
    angle = rng.uniform(-math.pi, math.pi, _PLACES)
    x, y = point.location.real + away * np.cos(angle), point.location.imag + away * np.sin(angle)
    away = np.hypot(x - point.location.real, y - point.location.imag)  # of the places as rounded
    branches: Any = field.branches.prepare(backend)
    imaginary = field.part == "imag"
    period: float | None = branches.period(imaginary)
    value = point.value.imag if imaginary else point.value.real
    allowed = point.constant * away**point.power
    worst = np.zeros(_PLACES)
    for branch in branches.evaluate(complex_type(backend)(backend.Float(x), backend.Float(y))):
        part = branch.value.imag if imaginary else branch.value.real
        off: FloatArray = to_numpy(part) - value
        if period is not None:
            off = off - period * np.round(off / period)
        worst = np.fmax(worst, np.abs(off))
    rounding = _SLACK * (allowed + 1e-6 * abs(value)) + 2.0**-48 * (
        abs(value) + np.abs(point.location)
    )
    require(
        worst <= allowed + rounding,
        f"BranchPoint({point.location}): a branch is farther from the value {point.value} than "
        f"{point.constant:g} |z - at|^{point.power:g}: the constant must be at least "
        f"{(worst / away**point.power).max():.6g}",
        np.column_stack([x, y, np.full(_PLACES, field.height * value)]),
        worst - allowed,
    )
