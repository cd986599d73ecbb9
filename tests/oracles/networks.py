# pyright: reportUnknownVariableType=false
"""Neural networks in NumPy, in double precision, and first hits by dense sampling."""

from __future__ import annotations

from typing import Any

import numpy as np


def _activate(choice: Any, z: Any) -> tuple[Any, Any]:
    """An activation function and its slope."""
    pair: Any = choice if isinstance(choice, tuple) else (choice, None)
    name, parameter = pair
    if name == "relu":
        return np.maximum(z, 0), 1.0 * (z > 0)
    if name == "tanh":
        return np.tanh(z), 1 / np.cosh(z) ** 2
    if name == "sine":
        w = 30.0 if parameter is None else parameter
        return np.sin(w * z), w * np.cos(w * z)
    c = 1.0 if parameter is None else parameter
    if name == "softplus":
        return np.logaddexp(0, c * z) / c, 0.5 * (1 + np.tanh(0.5 * c * z))
    left = np.minimum(z, 0)
    slope: Any = np.where(z > 0, 1.0, c * np.exp(left))
    return np.where(z > 0, z, c * np.expm1(left)), slope


def network_value_and_gradient(
    layers: list[tuple[Any, Any]], activation: Any, x: Any
) -> tuple[Any, Any]:
    """The values (n,) and gradients (n, 3) of a network at points (n, 3)."""
    jacobian = np.broadcast_to(np.eye(3), (len(x), 3, 3))
    for index, (weights, bias) in enumerate(layers):
        z, jacobian = x @ weights.T + bias, weights @ jacobian
        if index == len(layers) - 1:
            return z[:, 0], jacobian[:, 0]
        choice: Any = activation[index] if isinstance(activation, list) else activation
        x, slope = _activate(choice, z)
        jacobian = jacobian * slope[:, :, None]
    raise AssertionError


def network_value(layers: list[tuple[Any, Any]], activation: Any, x: Any) -> Any:
    """The values (n,) of a network at points (n, 3)."""
    for index, (weights, bias) in enumerate(layers):
        x = x @ weights.T + bias
        if index < len(layers) - 1:
            choice: Any = activation[index] if isinstance(activation, list) else activation
            x, _ = _activate(choice, x)
    return x[:, 0]


def first_hits(
    layers: list[tuple[Any, Any]], activation: Any, origins: Any, directions: Any, box: Any,
    level: float, steps: int,
) -> tuple[Any, Any]:  # fmt: skip
    """The first crossing of the level on each ray in a box, found among so many samples and refined
    by bisection, inf if there is none; and the largest |f - level| of the samples."""
    lower, upper = (np.asarray(corner, float) for corner in box)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (lower - origins) / directions, (upper - origins) / directions
    near = np.nan_to_num(np.minimum(a, b), nan=-np.inf).max(axis=1)
    far = np.nan_to_num(np.maximum(a, b), nan=np.inf).min(axis=1)
    near = np.maximum(near, 0.0)
    inside = far > near
    near, far = np.where(inside, near, 0.0), np.where(inside, far, 0.0)

    def value(t: Any) -> Any:
        shape = t.shape
        points = origins[:, None] + t.reshape(len(origins), -1)[..., None] * directions[:, None]
        f = network_value(layers, activation, points.reshape(-1, 3)) - level
        return f.reshape(shape)

    t = near[:, None] + (far - near)[:, None] * np.linspace(0, 1, steps)
    f = value(t)
    crosses = np.sign(f[:, 1:]) != np.sign(f[:, :1])
    exists = crosses.any(axis=1) & inside
    first = crosses.argmax(axis=1)
    rows = np.arange(len(t))
    low, high, start = t[rows, first], t[rows, first + 1], np.sign(f[:, 0])
    for _ in range(50):
        middle = 0.5 * (low + high)
        is_before = np.sign(value(middle[:, None])[:, 0]) == start
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    return np.where(exists, high, np.inf), np.abs(f).max(axis=1)
