"""Fields looked at from outside: values, gradients and continuous lifts as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy, to_vector3
from harnack.fields.sheets import NO_SHEET, Crossing

if TYPE_CHECKING:
    from harnack.backend import Precision
    from harnack.enclosures import Promise
    from harnack.fields.field import Field, Sample

__all__ = [
    "FieldValues",
    "LiftAlongRays",
    "jumps",
    "look_at",
    "movements",
    "random_directions",
    "random_points",
]


@dataclass(frozen=True)
class FieldValues:
    """A field at n points: value (n,), gradient (n, 3), their errors and promises (n,) each."""

    value: FloatArray
    gradient: FloatArray
    error: FloatArray
    gradient_error: FloatArray
    known: tuple[Promise, ...]

    def at(self, rows: BoolArray) -> FieldValues:
        """The same at some of the points."""
        return FieldValues(
            self.value[rows],
            self.gradient[rows],
            self.error[rows],
            self.gradient_error[rows],
            tuple(one.each(lambda number, _, __: number[rows]) for one in self.known),
        )


def look_at(field: Field, points: FloatArray, precision: Precision = "double") -> FieldValues:
    """The field at points (n, 3), all numbers of its promises as float64 arrays (n,)."""
    n = len(points)
    sample = _sample(field, points, precision)
    numbers_known = [list(vars(one).values()) for one in sample.promises]
    # At once, or each would be computed by a kernel of its own.
    dr.eval(sample.value, sample.gradient, sample.error, sample.gradient_error, numbers_known)

    known = tuple(one.each(lambda number, _, __: _spread(number, n)) for one in sample.promises)
    return FieldValues(
        _spread(sample.value, n),
        np.broadcast_to(to_numpy(sample.gradient), (n, 3)).astype(np.float64),
        _spread(sample.error, n),
        _spread(sample.gradient_error, n),
        known,
    )


@dataclass(frozen=True)
class LiftAlongRays:
    """The continuous lift of f at m points along each of n rays, all arrays (n, m).

    moved: how far the lift has moved since the ray's first point.
    jumped: by how much f has jumped besides, across sheets.
    gradient_norm: |grad f| at the points.
    error: `Sample.error` at the points.
    """

    moved: FloatArray
    jumped: FloatArray
    gradient_norm: FloatArray
    error: FloatArray


def movements(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> LiftAlongRays:
    """How far the continuous lift of f moves along rays: f(start + t direction) - f(start).

    start, direction: (n, 3), unit directions. lengths: t (n, m), each row rising from 0. A value
    known modulo the period is continued to the one that the mean of the gradients at both ends of
    an interval predicts; jumps across sheets are taken out.
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
    jumped = jumps(field, start, direction, lengths)
    return LiftAlongRays(
        total - jumped, jumped, np.linalg.norm(gradient, axis=2), look.error.reshape(n, m)
    )


def jumps(
    field: Field, start: FloatArray, direction: FloatArray, lengths: FloatArray
) -> FloatArray:
    """By how much f has jumped (n, m) since the first of the lengths (n, m) along rays, as
    `next_crossing` says."""
    total = np.zeros_like(lengths)
    if not field.has_sheets:
        return total
    backend = choose_backend("double")
    prepared = field.prepare(backend)
    o, d = to_vector3(backend, start), to_vector3(backend, direction)
    first, far = (backend.Float(np.ascontiguousarray(lengths[:, k])) for k in (0, -1))
    behind = Crossing(first, backend.UInt32(NO_SHEET), backend.Float(0), d)
    while True:
        behind = prepared.next_crossing(o, d, behind, far, backend.Bool(True))
        t, jump = (_spread(one, len(start)) for one in (behind.t, behind.jump))
        ahead = np.isfinite(t)
        if not ahead.any():
            return total
        passed = ahead[:, None] & (lengths >= t[:, None])
        total += np.where(passed, np.where(ahead, jump, 0)[:, None], 0)


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
