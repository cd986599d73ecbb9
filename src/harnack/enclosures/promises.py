"""Promises: what a field knows about itself near a point, whatever the direction.

A promise is stated in the field's own units and must be *true*: every step that the tracer takes
rests on it. Enclosures are made of promises, once the slope along a direction is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from harnack.backend import Real


@dataclass(frozen=True)
class HarmonicBall:
    """f extends to a harmonic function on the ball B(p, radius) of R^dimension that stays in range.

    The continuous lift of f that agrees with `Sample.value` at p is harmonic on the open ball and
    stays within [lower, upper] there. Either end may be infinite, not both. dimension is 2, 3 or
    4: a function of the plane extended constantly, of space, or a slice of a function of R^4.
    """

    radius: Real
    lower: Real
    upper: Real
    dimension: int = 3


@dataclass(frozen=True)
class BoundedLaplacian:
    """On the ball B(p, radius) of space f stays within [lower, upper] and its Laplacian within
    [laplacian_lower, laplacian_upper].

    f is continuously differentiable there and its Laplacian a bounded function, which may jump. All
    four ends are needed: a subharmonic function is one with laplacian_lower = 0, of which nothing
    follows unless laplacian_upper is known as well, for it may have spikes. Units: those of f, and
    of f over length squared.
    """

    radius: Real
    lower: Real
    upper: Real
    laplacian_lower: Real
    laplacian_upper: Real


@dataclass(frozen=True)
class Lipschitz:
    """|f(y) - f(p)| <= constant * |y - p| for every y with |y - p| < radius (default: all y).

    Of a field with a domain: for every such y in it.
    """

    constant: Real
    radius: Real = float("inf")


@dataclass(frozen=True)
class Curvature:
    """|f(y) - f(p) - grad f(p).(y-p)| <= constant |y-p|^2/2 for every y with |y-p| < radius.

    Of a field with a domain: for every such y in it.
    """

    constant: Real
    radius: Real = float("inf")


@dataclass(frozen=True)
class LineLipschitz:
    """|f(p + s d) - f(p)| <= constant |s| for |s| < radius, with the direction d of a path.

    It adds to other promises, on which alone a ray must be able to get on: it may be infinite at
    most places.
    """

    constant: Real
    radius: Real


Promise: TypeAlias = HarmonicBall | BoundedLaplacian | Lipschitz | LineLipschitz | Curvature
