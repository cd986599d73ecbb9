"""Derivatives that a field gives, held against differences of what they are derivatives of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.field import HarmonicBall, Lipschitz
from harnack.testing.failures import BrokenPromiseError, require
from harnack.testing.poisson import FloatArray
from harnack.testing.walks import Look, jumps, look_at

if TYPE_CHECKING:
    from harnack.fields.field import Field

__all__ = ["check_derivatives"]

# Nodes and weights of a derivative by central differences, with an error of order h^4.
_NODES = np.array([-2.0, -1.0, 1.0, 2.0])
_WEIGHTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12
# Of a field with an error the differences must agree at this share of the points even without it:
# between neighbouring points an approximation mostly is a smooth function itself.
_SMOOTH = 0.5


def check_derivatives(field: Field, points: FloatArray, look: Look) -> None:
    """Gradient, Laplacian and Hessian at points (n, 3), where the field was looked at.

    Raises BrokenPromiseError.
    """
    nearby = list(_around(field, points, look))
    _check_gradient(field, points, look, nearby)
    _check_laplacian(points, look, nearby)
    _check_hessian(field, points, look, nearby)


@dataclass(frozen=True)
class _Nearby:
    """The field at points + node h along an axis, for a node of the differences.

    weight: (n,) of the node, over h. move: (n,) of the value since the points, jumps and periods
    taken out. error: (n,) what errors at both ends may have added to it, gradient_error likewise.
    """

    axis: int
    node: float
    weight: FloatArray
    move: FloatArray
    gradient: FloatArray
    error: FloatArray
    gradient_error: FloatArray


def _around(field: Field, points: FloatArray, look: Look) -> Iterator[_Nearby]:
    h = _spacing(points, look)
    for axis in range(3):
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            way = np.sign(node) * np.eye(3)[axis] + 0 * points
            length = np.abs(node) * h
            other = look_at(field, points + length[:, None] * way)
            move = other.value - look.value
            if field.period is not None:
                move -= field.period * np.round(move / field.period)
            ends = np.column_stack([0 * length, length])
            move -= jumps(field, points, way, ends)[:, 1]
            error = look.error + other.error
            yield _Nearby(
                axis, float(node), weight / h, move, other.gradient, error,
                look.gradient_error + other.gradient_error,
            )  # fmt: skip


def _spacing(points: FloatArray, look: Look) -> FloatArray:
    return 2e-3 * _scale(points, look)


def _scale(points: FloatArray, look: Look) -> FloatArray:
    """A length (n,) over which the field is smooth: the smallest radius that is promised."""
    size = float(np.ptp(points, axis=0).max()) or 1.0
    radii = [known.radius for known in look.known if isinstance(known, HarmonicBall)]
    smooth = np.min([np.full(len(points), size), *radii], axis=0)
    return np.maximum(smooth, 1e-9 * size)


def _size(points: FloatArray) -> FloatArray:
    return np.abs(points).max(axis=1)


def _check_gradient(field: Field, points: FloatArray, look: Look, nearby: list[_Nearby]) -> None:
    """By central differences of the value."""
    h = _spacing(points, look)
    derivative = np.zeros_like(points)
    allowance = look.gradient_error.copy()
    for one in nearby:
        derivative[:, one.axis] += one.weight * one.move
        allowance += np.abs(one.weight) * one.error
    length = np.linalg.norm(look.gradient, axis=1)
    off = np.linalg.norm(derivative - look.gradient, axis=1)
    magnitude = np.abs(look.value) + (field.period or 0)
    tolerance = 1e-6 * length + (1e-12 * magnitude + 1e-12 * length * _size(points)) / h
    # What the differences leave out is a share h^4 of what f does on the scale of the ball, or
    # all of its bend where f is only Lipschitz and may have a kink between the points.
    smooth = any(not isinstance(one, Lipschitz) for one in look.known)
    tolerance += (1e-6 if smooth else 1.0) * _bend(nearby) * h
    _agree(off, tolerance, allowance, "the gradient is not that of the value", points)


def _bend(nearby: list[_Nearby]) -> FloatArray:
    """Sizes (n,) of the terms of the Laplacian."""
    return np.sum([np.abs(one.weight * one.gradient[:, one.axis]) for one in nearby], axis=0)


def _check_laplacian(points: FloatArray, look: Look, nearby: list[_Nearby]) -> None:
    """By central differences of the gradient."""
    if not _is_harmonic(look):
        return
    h = _spacing(points, look)
    laplacian = np.sum([one.weight * one.gradient[:, one.axis] for one in nearby], axis=0)
    allowance = np.sum([np.abs(one.weight) * one.gradient_error for one in nearby], axis=0)
    length = np.linalg.norm(look.gradient, axis=1)
    tolerance = 1e-6 * _bend(nearby) + 1e-11 * length * (1 + _size(points) / h) / h
    message = "HarmonicBall: f is not harmonic, its Laplacian is not 0"
    _agree(np.abs(laplacian), tolerance, allowance, message, points)


def _is_harmonic(look: Look) -> bool:
    return any(isinstance(one, HarmonicBall) and one.dimension < 4 for one in look.known)


def _agree(
    off: FloatArray, tolerance: FloatArray, allowance: FloatArray, message: str, points: FloatArray
) -> None:
    """Everywhere within both together, at most points within the tolerance alone."""
    require(off <= tolerance + allowance, message, points, off)
    if np.mean(off <= tolerance) < _SMOOTH:
        raise BrokenPromiseError(f"{message} at more than half of the {len(points)} points")


def _check_hessian(field: Field, points: FloatArray, look: Look, nearby: list[_Nearby]) -> None:
    """By central differences of the gradient, of two orders: they tell how far to trust them."""
    backend = choose_backend("double")
    try:
        rows = field.prepare(backend).hessian(to_vector3(backend, points, "points"))
    except NotImplementedError:
        return
    n = len(points)
    hessian = np.stack([np.broadcast_to(to_numpy(row), (n, 3)) for row in rows], axis=1)
    require(np.isfinite(hessian).all(axis=(1, 2)), "the Hessian is not finite", points)
    scale = _scale(points, look)
    length = np.linalg.norm(look.gradient, axis=1)
    size = np.abs(hessian).max(axis=(1, 2)) + length / scale
    skew = np.abs(hessian - hessian.transpose(0, 2, 1)).max(axis=(1, 2))
    require(skew <= 1e-9 * size, "the Hessian is not symmetric", points, skew)
    if _is_harmonic(look):
        trace = np.abs(np.trace(hessian, axis1=1, axis2=2))
        require(trace <= 1e-9 * size, "f is harmonic, but its Hessian has a trace", points, trace)
    h = _spacing(points, look)
    fine, coarse = np.zeros_like(hessian), np.zeros_like(hessian)
    for one in nearby:
        fine[:, :, one.axis] += one.weight[:, None] * one.gradient
        half = 0.5 * one.node if abs(one.node) == 1 else 0.0
        coarse[:, :, one.axis] += half * one.gradient / h[:, None]
    off = np.abs(fine - hessian).max(axis=(1, 2))
    tolerance = 1e-7 * size + 0.1 * np.abs(fine - coarse).max(axis=(1, 2))
    tolerance += 1e-11 * length * (1 + _size(points) / h) / h
    allowance = np.sum([np.abs(one.weight) * one.gradient_error for one in nearby], axis=0)
    _agree(off, tolerance, allowance, "the Hessian is not the derivative of the gradient", points)
