"""Contracts of derivatives: the derivatives that a field returns, compared with finite
differences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harnack.backend import BoolArray, FloatArray, choose_backend, to_numpy, to_vector3
from harnack.enclosures import BoundedLaplacian, HarmonicBall
from harnack.fields.batched_fields import BatchedField
from harnack.testing.violation_search import (
    BrokenPromiseError,
    FieldSamples,
    accumulated_jumps,
    require,
    sample_field,
)

if TYPE_CHECKING:
    from harnack.fields.field import Field

__all__ = ["check_derivatives"]

# Fourth-order central differences with spacing h and with 2h: nodes in units of h, weights in units
# of 1/h. Their difference is 15 times the leading error of the finer one, so a fifth of it
# (_RICHARDSON_SHARE) allows three times that error (Richardson extrapolation).
_NODES = (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)
_WEIGHTS = (0.0, 1 / 12, -8 / 12, 8 / 12, -1 / 12, 0.0)
_WIDE_WEIGHTS = (1 / 24, -8 / 24, 0.0, 0.0, 8 / 24, -1 / 24)
_RICHARDSON_SHARE = 0.2
# Where no promise says over which length f is smooth, spacings of these fractions of `_scale`
# are tried, too.
_SPACING_FACTORS = (1.0, 0.1, 0.01, 1e-3, 1e-4)
# For a field with an error bound, the differences must agree at this fraction of the points even
# without allowance for it: between neighboring points an approximation mostly is smooth itself.
_MIN_SMOOTH_FRACTION = 0.5
# For a field with creases they must agree at this fraction of the points.
_MIN_FRACTION_OFF_CREASES = 0.9


def check_derivatives(field: Field, points: FloatArray, look: FieldSamples) -> None:
    """Check gradient, Laplacian and Hessian at points (n, 3), where `look` has the samples of the
    field.

    Differences are taken within the field's domain; points too close to its border for that are
    left out.

    Raises:
        BrokenPromiseError: naming the point where they do not agree.
    """
    h, fits = _spacing_within(field, points, _spacing(points, look))
    if not fits.any():
        return
    points, look, h = points[fits], look.subset(fits), h[fits]
    has_ball = any(isinstance(one, HarmonicBall) for one in look.promises)
    trials = [
        list(_stencil_samples(field, points, look, q * h))
        for q in (_SPACING_FACTORS[:1] if has_ball else _SPACING_FACTORS)
    ]
    limits = [np.add(*_limits(field, points, look, nearby)) for nearby in trials]
    nearby = _pick_spacing(trials, np.argmin(limits, axis=0))
    _check_gradient(field, points, look, nearby)
    _check_laplacian(points, look, trials)
    try:
        _check_hessian(field, points, look, trials)
    except BrokenPromiseError:
        if not field.has_variable_accuracy:
            raise
        closely = [_without_truncation(field, points, one) for one in trials]
        _check_hessian(field, points, look, closely)


def _spacing_within(
    field: Field, points: FloatArray, h: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Spacings such that all nodes lie in the domain, and at which points there is such a
    spacing."""
    fits = np.ones(len(points), dtype=np.bool_)
    if field.domain is None:
        return h, fits
    for _ in range(24):
        fits[:] = True
        for axis in range(3):
            for node in (_NODES[0], _NODES[-1]):
                fits &= field.domain.contains_points(points + (node * h)[:, None] * np.eye(3)[axis])
        if fits.all():
            break
        h = np.where(fits, h, 0.5 * h)
    return h, fits


@dataclass(frozen=True)
class _StencilSample:
    """The samples of the field at points + node h along an axis, for a node of the differences.

    h: (n,) the spacing.
    weight: (n,) of the node, divided by h; wide: the same with twice the spacing.
    move: (n,) the difference of the value to that at the points, without jumps and periods.
    error: (n,) a bound of the errors of both values in it, gradient_error likewise.
    """

    axis: int
    node: float
    h: FloatArray
    weight: FloatArray
    wide: FloatArray
    move: FloatArray
    gradient: FloatArray
    error: FloatArray
    gradient_error: FloatArray


def _stencil_samples(
    field: Field, points: FloatArray, look: FieldSamples, h: FloatArray
) -> Iterator[_StencilSample]:
    for axis in range(3):
        for node, weight, wide in zip(_NODES, _WEIGHTS, _WIDE_WEIGHTS, strict=True):
            way = np.sign(node) * np.eye(3)[axis] + 0 * points
            length = np.abs(node) * h
            other = sample_field(field, points + length[:, None] * way)
            move = other.value - look.value
            if field.period is not None:
                move -= field.period * np.round(move / field.period)
            ends = np.column_stack([0 * length, length])
            move -= accumulated_jumps(field, points, way, ends)[:, 1]
            error = look.error + other.error
            yield _StencilSample(
                axis, node, h, weight / h, wide / h, move, other.gradient, error,
                look.gradient_error + other.gradient_error,
            )  # fmt: skip


def _without_truncation(
    field: Field, points: FloatArray, nearby: list[_StencilSample]
) -> list[_StencilSample]:
    """The same places with gradients without truncation (`Field.exact`), whose
    derivative the Hessian of a field with a choice of detail may be as well."""
    error = sample_field(field, points, closely=True).gradient_error
    found: list[_StencilSample] = []
    for neighbor in nearby:
        there = points + (neighbor.node * neighbor.h)[:, None] * np.eye(3)[neighbor.axis]
        look = sample_field(field, there, closely=True)
        errors = error + look.gradient_error
        found.append(dataclasses.replace(neighbor, gradient=look.gradient, gradient_error=errors))
    return found


def _pick_spacing(
    trials: list[list[_StencilSample]], choice: npt.NDArray[np.intp]
) -> list[_StencilSample]:
    """The samples at the spacing that `choice` selects for each point."""
    if len(trials) == 1:
        return trials[0]
    rows = np.arange(len(choice))

    def pick(nodes: tuple[_StencilSample, ...]) -> _StencilSample:
        arrays: dict[str, Any] = {
            name: np.stack([getattr(one, name) for one in nodes])[choice, rows]
            for name in ("h", "weight", "wide", "move", "gradient", "error", "gradient_error")
        }
        return dataclasses.replace(nodes[0], **arrays)

    return [pick(nodes) for nodes in zip(*trials, strict=True)]


def _spacing(points: FloatArray, look: FieldSamples) -> FloatArray:
    return 2e-3 * _scale(points, look)


def _scale(points: FloatArray, look: FieldSamples) -> FloatArray:
    """A length (n,) over which the field is smooth: the smallest radius of its `HarmonicBall`
    promises, at most the extent of the points."""
    size = float(np.ptp(points, axis=0).max()) or 1.0
    radii = [known.radius for known in look.promises if isinstance(known, HarmonicBall)]
    smooth = np.min([np.full(len(points), size), *radii], axis=0)
    return np.maximum(smooth, 1e-9 * size)


def _size(points: FloatArray) -> FloatArray:
    return np.abs(points).max(axis=1)


def _check_gradient(
    field: Field, points: FloatArray, look: FieldSamples, nearby: list[_StencilSample]
) -> None:
    """By central differences of the value."""
    tolerance, allowance = _limits(field, points, look, nearby)
    off = np.linalg.norm(_difference(nearby)[0] - look.gradient, axis=1)
    message = "the gradient is not that of the value"
    _require_agreement(off, tolerance, allowance, message, points, has_creases=field.has_creases)


def _difference(nearby: list[_StencilSample]) -> tuple[FloatArray, FloatArray]:
    """The gradient (n, 3) by differences of the value, with both spacings."""
    fine, wide = (np.zeros((len(nearby[0].h), 3)) for _ in range(2))
    for neighbor in nearby:
        fine[:, neighbor.axis] += neighbor.weight * neighbor.move
        wide[:, neighbor.axis] += neighbor.wide * neighbor.move
    return fine, wide


def _limits(
    field: Field, points: FloatArray, look: FieldSamples, nearby: list[_StencilSample]
) -> tuple[FloatArray, FloatArray]:
    """Two bounds (n,) of the difference between differences of the value and the gradient: their
    truncation and rounding error, and the errors of value and gradient."""
    h = nearby[0].h
    allowance = look.gradient_error.copy()
    for neighbor in nearby:
        allowance += np.abs(neighbor.weight) * neighbor.error
    length = np.linalg.norm(look.gradient, axis=1)
    magnitude = np.abs(look.value) + (field.period or 0)
    tolerance = 1e-6 * length + (1e-12 * magnitude + 1e-12 * length * _size(points)) / h
    fine, wide = _difference(nearby)
    tolerance += _RICHARDSON_SHARE * np.linalg.norm(fine - wide, axis=1)
    if not any(one.implies_smooth for one in look.promises):
        # There may be a kink between the points: as much as the gradient changes there.
        changes = [np.linalg.norm(neighbor.gradient - look.gradient, axis=1) for neighbor in nearby]
        tolerance += 2 * np.max(changes, axis=0)
    else:
        tolerance += 1e-6 * _second_derivatives(nearby) * h
    return tolerance, allowance


def _second_derivatives(nearby: list[_StencilSample]) -> FloatArray:
    """(n,) sums of the sizes of the second derivatives along the axes."""
    return np.sum(
        [np.abs(neighbor.weight * neighbor.gradient[:, neighbor.axis]) for neighbor in nearby],
        axis=0,
    )


def _check_laplacian(
    points: FloatArray, look: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """By central differences of the gradient."""
    bounds = [one for one in look.promises if isinstance(one, BoundedLaplacian)]
    if not _is_harmonic(look) and not bounds:
        return
    length = np.linalg.norm(look.gradient, axis=1)

    def differences(nearby: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        h = nearby[0].h
        laplacian = np.sum(
            [neighbor.weight * neighbor.gradient[:, neighbor.axis] for neighbor in nearby], axis=0
        )
        allowance = np.sum(
            [np.abs(neighbor.weight) * neighbor.gradient_error for neighbor in nearby], axis=0
        )
        wide = np.sum(
            [neighbor.wide * neighbor.gradient[:, neighbor.axis] for neighbor in nearby], axis=0
        )
        tolerance = 1e-6 * _second_derivatives(nearby) + _RICHARDSON_SHARE * np.abs(
            laplacian - wide
        )
        tolerance += 1e-11 * length * (1 + _size(points) / h) / h
        return laplacian, tolerance, allowance

    tried = [differences(nearby) for nearby in trials]
    if _is_harmonic(look):
        message = "HarmonicBall: f is not harmonic, its Laplacian is not 0"
        _require_agreement(
            *_likeliest([(np.abs(laplacian), *rest) for laplacian, *rest in tried]), message, points
        )
    for bound in bounds:
        low, high = bound.laplacian_lower, bound.laplacian_upper
        beyond = [
            (np.maximum(np.maximum(low - laplacian, laplacian - high), 0), *rest)
            for laplacian, *rest in tried
        ]
        message = "BoundedLaplacian: the Laplacian is not between its ends"
        _require_agreement(*_likeliest(beyond), message, points)


def _likeliest(
    tried: list[tuple[FloatArray, ...]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At each point, of the two spacings with the smallest bounds, the spacing at which they agree
    better: the difference, the tolerance and the allowance, (n,) each.

    Differences across a crease may be close at one spacing by accident, and wrong.
    """
    off, tolerance, allowance = (np.stack(rows) for rows in zip(*tried, strict=True))
    limit = tolerance + allowance
    best = np.argsort(limit, axis=0)[:2]
    over = np.take_along_axis(off - limit, best, axis=0)
    chosen = np.take_along_axis(best, over.argmin(axis=0)[None], axis=0)
    off, tolerance, allowance = (
        np.take_along_axis(rows, chosen, axis=0)[0] for rows in (off, tolerance, allowance)
    )
    return off, tolerance, allowance


def _is_harmonic(look: FieldSamples) -> bool:
    return any(isinstance(one, HarmonicBall) and one.dimension < 4 for one in look.promises)


def _require_agreement(
    off: FloatArray,
    tolerance: FloatArray,
    allowance: FloatArray,
    message: str,
    points: FloatArray,
    *,
    has_creases: bool = False,
) -> None:
    """Raise unless `off` is within both allowances together everywhere, and at most points within
    the tolerance alone.

    has_creases: differences may cross one, at few points.
    """
    good = off <= tolerance + allowance
    if has_creases and good.mean() >= _MIN_FRACTION_OFF_CREASES:
        return
    require(good, message, points, off)
    if np.mean(off <= tolerance) < _MIN_SMOOTH_FRACTION:
        raise BrokenPromiseError(f"{message} at more than half of the {len(points)} points")


def _check_hessian(
    field: Field, points: FloatArray, look: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """By central differences of the gradient, of two orders: they tell how far to trust them. The
    spacing at which the gradient is compared with values is far too small for that where f may have
    creases: so each quantity has its own."""
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
    own = 0.0  # what it leaves out need not be what the gradient does
    if isinstance(field, BatchedField):
        own = field.hessian_error_bound(points, precision="double")

    def differences(nearby: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        h = nearby[0].h
        fine, coarse = np.zeros_like(hessian), np.zeros_like(hessian)
        for neighbor in nearby:
            fine[:, :, neighbor.axis] += neighbor.weight[:, None] * neighbor.gradient
            half = 0.5 * neighbor.node if abs(neighbor.node) == 1 else 0.0
            coarse[:, :, neighbor.axis] += half * neighbor.gradient / h[:, None]
        tolerance = 1e-7 * size + 0.1 * np.abs(fine - coarse).max(axis=(1, 2)) + own
        tolerance += 1e-11 * length * (1 + _size(points) / h) / h
        allowance = np.sum(
            [np.abs(neighbor.weight) * neighbor.gradient_error for neighbor in nearby], axis=0
        )
        return np.abs(fine - hessian).max(axis=(1, 2)), tolerance, allowance

    likeliest = _likeliest([differences(nearby) for nearby in trials])
    message = "the Hessian is not the derivative of the gradient"
    _require_agreement(*likeliest, message, points, has_creases=field.has_creases)
