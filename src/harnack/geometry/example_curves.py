"""Closed curves for pictures, tests and examples. A curve is an array (n, 3) of vertices, float64,
whose last vertex is joined to the first (which is not repeated); a list of such arrays is a curve
of several loops. All curves for which that has a meaning run counter-clockwise as seen from +z."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from harnack.backend.validation import FloatArray

ReturnPath = Literal["outside", "axis"]


def _check_whole(name: str, number: Any) -> None:
    """Raise TypeError if the value `number` of the argument `name` is not an integer."""
    if not isinstance(number, int | np.integer):
        raise TypeError(f"{name} must be a whole number, not {number!r}")


def _angles(n: int, minimum: int) -> FloatArray:
    """Angles (n,) that divide the full turn into n equal parts, in radians, from 0.

    Raises:
        ValueError: n is less than `minimum`.
        TypeError: n is not an integer.
    """
    _check_whole("the number of vertices of a curve", n)
    if n < minimum:
        raise ValueError(f"this curve needs at least {minimum} vertices, not {n}")
    return 2.0 * np.pi * np.arange(n) / n


def regular_polygon(n: int, radius: float = 1.0) -> FloatArray:
    """The regular n-gon (n, 3) in the plane z = 0, with a vertex on the x axis.

    radius: the distance of the vertices from the origin.
    """
    t = _angles(n, 3)
    return radius * np.column_stack([np.cos(t), np.sin(t), np.zeros(n)])


def wavy_polygon(n: int, amplitude: float = 0.45, waves: int = 3) -> FloatArray:
    """A polygon (n, 3) on a cylinder that is not planar: its vertices are (cos t, sin t, amplitude
    cos(waves t)) for n equally spaced angles t."""
    t = _angles(n, 3)
    return np.column_stack([np.cos(t), np.sin(t), amplitude * np.cos(waves * t)])


def torus_knot(
    p: int, q: int, n: int, *, major_radius: float = 1.0, minor_radius: float = 0.4
) -> FloatArray:
    """A (p, q) torus knot with n vertices, (n, 3): p turns about the z axis, q through the hole.
    (2, 3) is a trefoil.

    major_radius, minor_radius: of the torus on which it lies.

    Raises:
        ValueError: p and q have a common divisor; the curve would be a link of several loops.
        TypeError: p or q is not an integer.
    """
    _check_whole("p of a torus knot", p)
    _check_whole("q of a torus knot", q)
    if np.gcd(p, q) != 1:
        raise ValueError(f"p and q of a torus knot must have no common divisor, not {p} and {q}")
    t = _angles(n, 3)
    distance = major_radius + minor_radius * np.cos(q * t)
    return np.column_stack(
        [distance * np.cos(p * t), distance * np.sin(p * t), minor_radius * np.sin(q * t)]
    )


def figure_eight_knot(n: int) -> FloatArray:
    """The figure-eight knot 4_1 with n vertices, (n, 3), about 1 in size."""
    t = _angles(n, 3)
    distance = (2.0 + np.cos(2.0 * t)) / 3.0
    return np.column_stack(
        [distance * np.cos(3.0 * t), distance * np.sin(3.0 * t), np.sin(4.0 * t) / 3.0]
    )


def coil(
    turns: int,
    n: int,
    *,
    radius: float = 1.0,
    height: float = 1.0,
    return_path: ReturnPath = "outside",
) -> FloatArray:
    """A closed coil with n vertices, (n, 3): a helix about the z axis and a way back to its start.
    The solid angle of such a curve takes values in a range of the length 4 pi `turns`; bounds that
    hold for curves on convex bodies do not hold for it.

    turns: the number of full turns of the helix.
    radius: of the helix.
    height: from its lowest to its highest vertex.
    return_path: "outside" returns at 1.5 radii, parallel to the axis; "axis" along the axis.

    Raises:
        ValueError: there are too few turns or vertices, or another path is given.
    """
    if turns < 1:
        raise ValueError(f"a coil needs at least one turn, not {turns}")
    return_x = {"outside": 1.5 * radius, "axis": 0.0}
    if return_path not in return_x:
        raise ValueError(f'return_path of a coil is "outside" or "axis", not {return_path!r}')
    if n < 3 * turns + 3:
        raise ValueError(f"a coil of {turns} turns needs at least {3 * turns + 3} vertices")
    s = np.linspace(0.0, 1.0, n - 2)
    t = 2.0 * np.pi * turns * s
    helix = np.column_stack([radius * np.cos(t), radius * np.sin(t), height * (s - 0.5)])
    x = return_x[return_path]
    return np.concatenate([helix, [[x, 0.0, 0.5 * height], [x, 0.0, -0.5 * height]]])


def hopf_link(n: int) -> list[FloatArray]:
    """Two circles of radius 1 with n vertices each, each through the other's center."""
    circle = regular_polygon(n)
    upright = circle[:, [0, 2, 1]] * (-1.0, 1.0, 1.0)
    shift = np.array([0.5, 0.0, 0.0])
    return [circle - shift, upright + shift]


def borromean_rings(n: int) -> list[FloatArray]:
    """Three ellipses with n vertices each in the coordinate planes: the three are linked, but no
    two of them are."""
    circle = regular_polygon(n)
    ellipse = circle * (1.0, 0.5, 1.0)
    return [np.roll(ellipse, shift, axis=1) for shift in range(3)]


def square_with_holes(
    n: int = 24,
    *,
    side: float = 2.0,
    holes: Sequence[tuple[float, float, float]] = (
        (-0.45, -0.45, 0.3),
        (0.45, -0.3, 0.25),
        (0.1, 0.5, 0.3),
    ),
) -> list[FloatArray]:
    """A square in the plane z = 0 with round holes, which are oriented the opposite way. Returns
    the square, then the holes.

    n: the number of vertices of each hole.
    side: the length of the square's sides.
    holes: x, y and radius of each hole. They are not checked to be disjoint and within the square.
    """
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    loops: list[FloatArray] = [0.5 * side * corners]
    for x, y, radius in holes:
        clockwise = np.flip(regular_polygon(n, radius), axis=0)
        loops.append(clockwise + np.array([x, y, 0.0]))
    return loops


def random_closed_curve(
    rng: np.random.Generator, n: int, *, harmonics: int = 4, decay: float = 1.0
) -> FloatArray:
    """A random closed curve with n vertices, (n, 3), about 1 in size, and often a knot: its
    coordinates are random trigonometric polynomials.

    rng: the source of random numbers.
    harmonics: the number of frequencies.
    decay: amplitudes fall like frequency^-decay.
    """
    t = _angles(n, 3)
    if harmonics < 1:
        raise ValueError(f"a random curve needs at least one harmonic, not {harmonics}")
    k = np.arange(1, harmonics + 1)
    a, b = rng.normal(size=(2, harmonics, 3)) * (k**-decay)[:, None]
    phase = np.multiply.outer(t, k)
    curve: FloatArray = np.cos(phase) @ a + np.sin(phase) @ b
    return curve / np.abs(curve).max()


def spiky_polygon(
    rng: np.random.Generator, n: int, *, inner: float = 0.2, height: float = 0.5
) -> FloatArray:
    """A star with n vertices, (n, 3), with random distances from the z axis in [inner, 1] and
    random heights z in [-height, height]. Even vertices are spikes, odd ones lie near the distance
    `inner`.

    rng: the source of random numbers.
    """
    # At least 3 vertices, at angles that vary by up to 0.3 of their distance.
    t = _angles(n, 3) + rng.uniform(-0.3, 0.3, size=n) * (2.0 * np.pi / n)
    radii = rng.uniform(0.6, 1.0, size=n)
    radii[1::2] = rng.uniform(inner, 1.5 * inner, size=len(radii[1::2]))
    z = rng.uniform(-height, height, size=n)
    return np.column_stack([radii * np.cos(t), radii * np.sin(t), z])
