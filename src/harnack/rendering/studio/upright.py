"""Which way is up."""

from __future__ import annotations

from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.geometry.volumes.volume import checked_point
from harnack.names import did_you_mean

# Rotations that turn the named axis to z. From y, the front of a glTF model (z) turns to -y,
# which is where the studio's camera stands.
_UPRIGHT: dict[str, FloatArray] = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
UP_AXES: tuple[str, ...] = (*_UPRIGHT, *("-" + axis for axis in _UPRIGHT))


def upright(up: Any) -> FloatArray:
    """The rotation (3, 3) that turns an axis ("x", "-y", ...) or a vector to z.

    Raises:
        TypeError, ValueError: neither.
    """
    if isinstance(up, str):
        if up not in UP_AXES:
            raise ValueError(
                f"up must be one of {', '.join(UP_AXES)} or a vector, not {up!r}"
                f"{did_you_mean(up, UP_AXES)}"
            )
        axis = up.removeprefix("-")
        over = np.diag([1.0, -1.0, -1.0]) if up.startswith("-") else np.eye(3)
        return over @ _UPRIGHT[axis]
    way = np.array(checked_point(up, "up"))
    if not way.any():
        raise ValueError("up must be a vector that is not zero")
    way, z = way / float(np.abs(way).max()), np.array([0.0, 0.0, 1.0])
    way = way / float(np.linalg.norm(way))
    # Turned the shortest way, about the axis at right angles to both.
    across = np.cross(way, z)
    if float(np.linalg.norm(across)) < 1e-12:
        return upright("z" if way[2] > 0 else "-z")
    u = across / np.linalg.norm(across)
    before, after = np.stack([u, np.cross(way, u), way]), np.stack([u, np.cross(z, u), z])
    return after.T @ before
