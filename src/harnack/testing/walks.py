"""Fields looked at from outside: values, gradients and continuous lifts as NumPy arrays."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.testing.poisson import FloatArray

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.fields.field import Field, Knowledge, Sample

__all__ = ["Look", "look_at", "movements", "random_directions", "random_points"]


@dataclass(frozen=True)
class Look:
    """A field at n points: value (n,), gradient (n, 3), rounding error (n,), promises (n,) each."""

    value: FloatArray
    gradient: FloatArray
    error: FloatArray
    known: tuple[Knowledge, ...]


def look_at(field: Field, points: FloatArray, precision: Precision = "double") -> Look:
    """The field at points (n, 3), all numbers of its promises as float64 arrays (n,)."""
    n = len(points)
    sample = _sample(field, points, precision)

    def on_host(one: Knowledge) -> Knowledge:
        numbers: dict[str, Any] = {
            key: _spread(value, n) for key, value in vars(one).items() if key != "dimension"
        }
        return dataclasses.replace(one, **numbers)

    known = tuple(on_host(one) for one in sample.known)
    return Look(
        _spread(sample.value, n),
        np.broadcast_to(to_numpy(sample.gradient), (n, 3)).astype(np.float64),
        _spread(sample.error, n),
        known,
    )


def movements(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far the continuous lift of f moves along rays: f(start + t direction) - f(start).

    start, direction: (n, 3). lengths: t (n, m), each row rising from 0. Returns the movements
    (n, m) and |gradient| there (n, m). A value known modulo the period is continued to the one
    that the mean of the gradients at both ends of an interval predicts.
    """
    n, m = lengths.shape
    points = start[:, None] + lengths[..., None] * direction[:, None]
    look = look_at(field, points.reshape(-1, 3))
    value, gradient = look.value.reshape(n, m), look.gradient.reshape(n, m, 3)
    slope = np.einsum("nmk,nk->nm", gradient, direction)
    move = np.diff(value, axis=1)
    if field.period is not None:
        expected = 0.5 * (slope[:, 1:] + slope[:, :-1]) * np.diff(lengths, axis=1)
        expected = np.where(np.isfinite(expected), expected, 0)
        # A gradient may grow without limit at a curve; there the lift still moves little.
        expected = np.clip(expected, -0.5 * field.period, 0.5 * field.period)
        move -= field.period * np.round((move - expected) / field.period)
    total = np.concatenate([np.zeros((n, 1)), np.cumsum(move, axis=1)], axis=1)
    return total, np.linalg.norm(gradient, axis=2)


def random_points(field: Field, rng: np.random.Generator, n: int) -> FloatArray:
    """n points of the field's domain; where that is unbounded, around its default surface."""
    volume = field.domain if field.domain is not None else field.extent((field.default_level,))
    if volume is None:
        return 3 * random_directions(rng, n) * rng.random((n, 1))
    lower, upper = volume.bounds()
    lower, upper = np.where(np.isfinite(lower), lower, -3), np.where(np.isfinite(upper), upper, 3)
    found = np.zeros((0, 3))
    while len(found) < n:
        points = rng.uniform(lower, upper, (4 * n, 3))
        if field.domain is not None:
            points = points[field.domain.contains_points(points)]
        found = np.concatenate([found, points])
    return found[:n]


def random_directions(rng: np.random.Generator, n: int) -> FloatArray:
    """n unit vectors, uniform on the sphere."""
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sample(field: Field, points: FloatArray, precision: Precision) -> Sample:
    backend = choose_backend(precision)
    return field.prepare(backend).evaluate(to_vector3(backend, points, "points"))


def _spread(value: object, n: int) -> FloatArray:
    array = to_numpy(value) if dr.is_array_v(value) else np.asarray(value)
    return np.broadcast_to(array, (n,)).astype(np.float64)
