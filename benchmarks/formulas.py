"""Formulas for the solid angle of a polygon and for its gradient, and their accuracy.

The paper's Fig. 12, with numbers: each formula in single precision against the fan in 80-bit
floats, at points of a camera's rays. All are equal in exact arithmetic, modulo 4 pi.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import harnack as hk
from harnack.geometry import example_curves

Array = Any  # of any floating-point type

POINTS = 100_000
_DIFFERENCE = 1e-3


def fan(loop: Array, x: Array) -> Array:
    """Triangles about the mean of the vertices (van Oosterom and Strackee 1983)."""
    total = np.zeros(len(x), x.dtype)
    c = loop.mean(axis=0) - x
    lc = _length(c)
    for p, q in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        a, b = p - x, q - x
        la, lb = _length(a), _length(b)
        volume = _dot(a, np.cross(b, c))
        total += 2 * np.arctan2(
            volume, la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        )
    return total


def quaternions(loop: Array, x: Array) -> Array:
    """The turn of a direction carried along the spherical polygon (Chern and Ishida 2023)."""
    u = [_unit(p - x) for p in loop]
    w, v = np.ones(len(x), x.dtype), np.zeros_like(x)
    for a, b in zip(u, [*u[1:], u[0]], strict=True):
        # The shortest turn from a to b is (1 + a.b, a x b), up to its length.
        s, t = 1 + _dot(a, b), np.cross(a, b)
        w, v = s * w - _dot(t, v), s[:, None] * v + w[:, None] * t + np.cross(t, v)
        size = np.sqrt(w * w + _dot(v, v))
        w, v = w / size, v / size[:, None]
    return 2 * np.arctan2(_dot(v, u[0]), w)


def angle_sum(loop: Array, x: Array) -> Array:
    """2 pi less the exterior angles of the spherical polygon (Legendre 1817)."""
    u = [_unit(p - x) for p in loop]
    total = np.full(len(x), 2 * np.pi, x.dtype)
    for a, b, c in zip([u[-1], *u[:-1]], u, [*u[1:], u[0]], strict=True):
        first, second = np.cross(a, b), np.cross(b, c)
        total -= np.arctan2(_dot(b, np.cross(first, second)), _dot(first, second))
    return total


def biot_savart(loop: Array, x: Array) -> Array:
    """The gradient: the field of a current along the polygon."""
    total = np.zeros_like(x)
    for p, q in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        a, b = p - x, q - x
        cross = np.cross(a, b)
        along = _dot(q - p, _unit(b) - _unit(a))
        total += (along / _dot(cross, cross))[:, None] * cross
    return total


def adiels(loop: Array, x: Array) -> Array:
    """The same without a difference of nearly equal numbers (Adiels et al. 2022)."""
    total = np.zeros_like(x)
    for p, q in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        a, b = p - x, q - x
        la, lb = _length(a), _length(b)
        fraction = (1 / la + 1 / lb) / (la * lb + _dot(a, b))
        total += fraction[:, None] * np.cross(a, b)
    return total


def differences(loop: Array, x: Array) -> Array:
    """Differences of the fan at the corners of a tetrahedron."""
    total = np.zeros_like(x)
    for corner in ((1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, 1)):
        e = np.array(corner, x.dtype)
        total += fan(loop, x + x.dtype.type(_DIFFERENCE) * e)[:, None] * e
    return total / x.dtype.type(4 * _DIFFERENCE)


def _dot(a: Array, b: Array) -> Array:
    return (a * b).sum(axis=-1)


def _length(a: Array) -> Array:
    return np.sqrt(_dot(a, a))


def _unit(a: Array) -> Array:
    return a / _length(a)[..., None]


def measured() -> tuple[dict[str, Array], dict[str, Array]]:
    """Errors of values in radians, and of gradients relative to their length."""
    loop = np.asarray(example_curves.wavy_polygon(12), np.float32)
    x = np.random.default_rng(0).uniform(-1.2, 1.2, (POINTS, 3)).astype(np.float32)
    fine = np.longdouble
    value, gradient = (
        fan(loop.astype(fine), x.astype(fine)),
        adiels(loop.astype(fine), x.astype(fine)),
    )
    ours = hk.SolidAngle(loop)
    values: dict[str, Callable[[], Array]] = {
        "fan of triangles": lambda: fan(loop, x),
        "quaternions": lambda: quaternions(loop, x),
        "angle sum": lambda: angle_sum(loop, x),
        "harnack (spinors)": lambda: ours.value(x, precision="single"),
    }
    gradients: dict[str, Callable[[], Array]] = {
        "Biot-Savart": lambda: biot_savart(loop, x),
        "Adiels": lambda: adiels(loop, x),
        f"differences, {_DIFFERENCE:g} apart": lambda: differences(loop, x),
        "harnack": lambda: ours.gradient(x, precision="single"),
    }
    norm = _length(gradient)

    def error(computed: Array) -> Array:
        d = computed.astype(fine) - value
        return np.abs(d - 4 * fine(np.pi) * np.round(d / (4 * fine(np.pi))))

    with np.errstate(all="ignore"):
        of_values = {name: error(f()) for name, f in values.items()}
        of_gradients = {name: _length(f() - gradient) / norm for name, f in gradients.items()}
    return of_values, of_gradients


def formulas() -> str:
    """The section of the page."""
    lines = [
        "## Formulas for the solid angle\n",
        f"The paper's Fig. 12 in numbers: at {POINTS:,} random points around a polygon of 12 "
        "vertices, each formula in single precision against the fan in 80-bit floats. Values in "
        "radians, modulo 4 pi; of gradients the length of the error over that of the gradient. "
        "Biot-Savart's law is the one of a straight current with the difference of two unit "
        "vectors.\n",
        "| | formula | median | 99.9 % | largest | no numbers |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for kind, errors in zip(("value", "gradient"), measured(), strict=True):
        for name, error in errors.items():
            finite = np.asarray(error[np.isfinite(error)], np.float64)
            median, quantile = np.quantile(finite, [0.5, 0.999])
            lines.append(
                f"| {kind} | {name} | {median:.1e} | {quantile:.1e} | {finite.max():.1e} "
                f"| {len(error) - len(finite)} |"
            )
    return "\n".join(lines) + "\n"
