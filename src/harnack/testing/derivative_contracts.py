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

# Fourth-order central differences with the spacings h and 2h: nodes in units of h, weights in units
# of 1/h. The two differ by 15 times the leading error of the one with h, so a fifth of the
# difference (_RICHARDSON_FRACTION) allows three times that error (Richardson extrapolation).
_NODES = (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)
_WEIGHTS = (0.0, 1 / 12, -8 / 12, 8 / 12, -1 / 12, 0.0)
_WIDE_WEIGHTS = (1 / 24, -8 / 24, 0.0, 0.0, 8 / 24, -1 / 24)
_RICHARDSON_FRACTION = 0.2
# Where no promise says over which length f is smooth, spacings of these fractions of `_scale`
# are tried, too.
_SPACING_FACTORS = (1.0, 0.1, 0.01, 1e-3, 1e-4)
# For a field with an error bound, the differences must agree at this fraction of the points even
# without an allowance for it: between most neighboring points the approximation itself is smooth.
_MIN_SMOOTH_FRACTION = 0.5
# For a field with creases they must agree at this fraction of the points.
_MIN_FRACTION_OFF_CREASES = 0.9


def check_derivatives(field: Field, points: FloatArray, look: FieldSamples) -> None:
    """Check gradient, Laplacian and Hessian at points (n, 3). look: the samples of the field there.

    Differences are taken within the field's domain; points too close to its border for that are
    left out.

    Raises:
        BrokenPromiseError: naming the point where they do not agree.
    """
    h, is_inside = _spacing_within(field, points, _first_spacing(points, look))
    if not is_inside.any():
        return
    points, look, h = points[is_inside], look.subset(is_inside), h[is_inside]
    has_ball = any(isinstance(promise, HarmonicBall) for promise in look.promises)
    trials = [
        list(_stencil_samples(field, points, look, factor * h))
        for factor in (_SPACING_FACTORS[:1] if has_ball else _SPACING_FACTORS)
    ]
    limits = [np.add(*_limits(field, points, look, stencil)) for stencil in trials]
    stencil = _pick_spacing(trials, np.argmin(limits, axis=0))
    _check_gradient(field, points, look, stencil)
    _check_laplacian(points, look, trials)
    try:
        _check_hessian(field, points, look, trials)
    except BrokenPromiseError:
        if not field.has_variable_accuracy:
            raise
        exact_trials = [_without_truncation(field, points, promise) for promise in trials]
        _check_hessian(field, points, look, exact_trials)


def _spacing_within(
    field: Field, points: FloatArray, h: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Spacings (n,), halved from h until all nodes lie in the domain; and a mask (n,) of the points
    at which such a spacing was found."""
    is_inside = np.ones(len(points), dtype=np.bool_)
    if field.domain is None:
        return h, is_inside
    for _ in range(24):
        is_inside[:] = True
        for axis in range(3):
            for node in (_NODES[0], _NODES[-1]):
                is_inside &= field.domain.contains_points(
                    points + (node * h)[:, None] * np.eye(3)[axis]
                )
        if is_inside.all():
            break
        h = np.where(is_inside, h, 0.5 * h)
    return h, is_inside


@dataclass(frozen=True)
class _StencilSample:
    """The samples of the field at points + node h along an axis, for a node of the differences.

    axis: 0, 1 or 2.
    node: one of `_NODES`.
    h: (n,) the spacing.
    weight: (n,) the weight of the node for the spacing h, divided by h.
    wide: (n,) the same for the spacing 2h.
    move: (n,) the value at the node less the value at the point, without jumps and periods.
    gradient: (n, 3) at the node.
    error: (n,) a bound of the error of `move`: the errors of both values.
    gradient_error: (n,) the sum of the errors of both gradients.
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
    field: Field, points: FloatArray, samples: FieldSamples, h: FloatArray
) -> Iterator[_StencilSample]:
    """The samples at all nodes of the differences around points (n, 3).

    samples: at the points.
    h: (n,) the spacing.
    """
    for axis in range(3):
        for node, weight, wide in zip(_NODES, _WEIGHTS, _WIDE_WEIGHTS, strict=True):
            direction = np.sign(node) * np.eye(3)[axis] + 0 * points
            length = np.abs(node) * h
            node_samples = sample_field(field, points + length[:, None] * direction)
            change = node_samples.value - samples.value
            if field.period is not None:
                change -= field.period * np.round(change / field.period)
            ends = np.column_stack([0 * length, length])
            change -= accumulated_jumps(field, points, direction, ends)[:, 1]
            error = samples.error + node_samples.error
            yield _StencilSample(
                axis, node, h, weight / h, wide / h, change, node_samples.gradient, error,
                samples.gradient_error + node_samples.gradient_error,
            )  # fmt: skip


def _without_truncation(
    field: Field, points: FloatArray, stencil: list[_StencilSample]
) -> list[_StencilSample]:
    """The same samples with gradients without truncation error (`Field.exact`). The Hessian of a
    field with variable accuracy may be the derivative of either gradient."""
    error = sample_field(field, points, closely=True).gradient_error
    exact: list[_StencilSample] = []
    for node_sample in stencil:
        nodes = points + (node_sample.node * node_sample.h)[:, None] * np.eye(3)[node_sample.axis]
        sample = sample_field(field, nodes, closely=True)
        errors = error + sample.gradient_error
        exact.append(
            dataclasses.replace(node_sample, gradient=sample.gradient, gradient_error=errors)
        )
    return exact


def _pick_spacing(
    trials: list[list[_StencilSample]], choice: npt.NDArray[np.intp]
) -> list[_StencilSample]:
    """The samples at one spacing for each point: that with index `choice` (n,) among the trials."""
    if len(trials) == 1:
        return trials[0]
    rows = np.arange(len(choice))

    def pick(nodes: tuple[_StencilSample, ...]) -> _StencilSample:
        arrays: dict[str, Any] = {
            name: np.stack([getattr(sample, name) for sample in nodes])[choice, rows]
            for name in ("h", "weight", "wide", "move", "gradient", "error", "gradient_error")
        }
        return dataclasses.replace(nodes[0], **arrays)

    return [pick(nodes) for nodes in zip(*trials, strict=True)]


def _first_spacing(points: FloatArray, samples: FieldSamples) -> FloatArray:
    """The spacing (n,) that is tried first."""
    return 2e-3 * _scale(points, samples)


def _scale(points: FloatArray, samples: FieldSamples) -> FloatArray:
    """A length (n,) over which the field is smooth: the smallest radius of its `HarmonicBall`
    promises, at most the extent of the points."""
    size = float(np.ptp(points, axis=0).max()) or 1.0
    radii = [promise.radius for promise in samples.promises if isinstance(promise, HarmonicBall)]
    smooth_length = np.min([np.full(len(points), size), *radii], axis=0)
    return np.maximum(smooth_length, 1e-9 * size)


def _max_coordinates(points: FloatArray) -> FloatArray:
    """The largest absolute coordinate (n,) of each point."""
    return np.abs(points).max(axis=1)


def _check_gradient(
    field: Field, points: FloatArray, samples: FieldSamples, stencil: list[_StencilSample]
) -> None:
    """Compare the gradient with central differences of the value."""
    tolerance, allowance = _limits(field, points, samples, stencil)
    error = np.linalg.norm(_difference(stencil)[0] - samples.gradient, axis=1)
    message = "the gradient is not that of the value"
    _require_agreement(error, tolerance, allowance, message, points, has_creases=field.has_creases)


def _difference(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray]:
    """The gradients (n, 3) by differences of the value: with the spacing h, and with 2h."""
    fine, wide = (np.zeros((len(stencil[0].h), 3)) for _ in range(2))
    for neighbor in stencil:
        fine[:, neighbor.axis] += neighbor.weight * neighbor.move
        wide[:, neighbor.axis] += neighbor.wide * neighbor.move
    return fine, wide


def _limits(
    field: Field, points: FloatArray, samples: FieldSamples, nodes: list[_StencilSample]
) -> tuple[FloatArray, FloatArray]:
    """Two bounds (n,) that add up to one of the error of the gradient by differences of the value:
    the truncation and rounding error of the differences; and the contribution of the errors of
    value and gradient."""
    h = nodes[0].h
    allowance = samples.gradient_error.copy()
    for neighbor in nodes:
        allowance += np.abs(neighbor.weight) * neighbor.error
    length = np.linalg.norm(samples.gradient, axis=1)
    magnitude = np.abs(samples.value) + (field.period or 0)
    tolerance = 1e-6 * length + (1e-12 * magnitude + 1e-12 * length * _max_coordinates(points)) / h
    fine, wide = _difference(nodes)
    tolerance += _RICHARDSON_FRACTION * np.linalg.norm(fine - wide, axis=1)
    if not any(promise.implies_smooth for promise in samples.promises):
        # There may be a kink between the nodes: the error is then as large as the change of the
        # gradient.
        changes = [
            np.linalg.norm(neighbor.gradient - samples.gradient, axis=1) for neighbor in nodes
        ]
        tolerance += 2 * np.max(changes, axis=0)
    else:
        tolerance += 1e-6 * _second_derivatives(nodes) * h
    return tolerance, allowance


def _second_derivatives(stencil: list[_StencilSample]) -> FloatArray:
    """(n,) sums of the absolute second derivatives along the axes."""
    return np.sum(
        [np.abs(neighbor.weight * neighbor.gradient[:, neighbor.axis]) for neighbor in stencil],
        axis=0,
    )


def _check_laplacian(
    points: FloatArray, samples: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """Compare the Laplacian with central differences of the gradient."""
    bounds = [promise for promise in samples.promises if isinstance(promise, BoundedLaplacian)]
    if not _is_harmonic(samples) and not bounds:
        return
    length = np.linalg.norm(samples.gradient, axis=1)

    def compare(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The Laplacian by differences, and two bounds of its error, as `_limits` gives them."""
        h = stencil[0].h
        laplacian = np.sum(
            [neighbor.weight * neighbor.gradient[:, neighbor.axis] for neighbor in stencil], axis=0
        )
        allowance = np.sum(
            [np.abs(neighbor.weight) * neighbor.gradient_error for neighbor in stencil], axis=0
        )
        wide = np.sum(
            [neighbor.wide * neighbor.gradient[:, neighbor.axis] for neighbor in stencil], axis=0
        )
        tolerance = 1e-6 * _second_derivatives(stencil) + _RICHARDSON_FRACTION * np.abs(
            laplacian - wide
        )
        tolerance += 1e-11 * length * (1 + _max_coordinates(points) / h) / h
        return laplacian, tolerance, allowance

    tests = [compare(stencil) for stencil in trials]
    if _is_harmonic(samples):
        message = "HarmonicBall: f is not harmonic, its Laplacian is not 0"
        _require_agreement(
            *_best_agreement([(np.abs(laplacian), *rest) for laplacian, *rest in tests]),
            message,
            points,
        )
    for bound in bounds:
        lower, upper = bound.laplacian_lower, bound.laplacian_upper
        excesses = [
            (np.maximum(np.maximum(lower - laplacian, laplacian - upper), 0), *rest)
            for laplacian, *rest in tests
        ]
        message = "BoundedLaplacian: the Laplacian is not between its ends"
        _require_agreement(*_best_agreement(excesses), message, points)


def _best_agreement(
    results: list[tuple[FloatArray, ...]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The difference, the tolerance and the allowance (n,) at the spacing that is compared.

    results: these three for each spacing.

    At each point, the two spacings with the smallest bounds are considered, and of these the one at
    which the difference exceeds its bounds less. Differences across a crease may have small bounds
    at one spacing by accident, and be wrong.
    """
    error, tolerance, allowance = (np.stack(values) for values in zip(*results, strict=True))
    limit = tolerance + allowance
    best = np.argsort(limit, axis=0)[:2]
    excess = np.take_along_axis(error - limit, best, axis=0)
    chosen = np.take_along_axis(best, excess.argmin(axis=0)[None], axis=0)
    error, tolerance, allowance = (
        np.take_along_axis(values, chosen, axis=0)[0] for values in (error, tolerance, allowance)
    )
    return error, tolerance, allowance


def _is_harmonic(samples: FieldSamples) -> bool:
    """Whether the promises say that f is harmonic."""
    return any(isinstance(ball, HarmonicBall) and ball.dimension < 4 for ball in samples.promises)


def _require_agreement(
    error: FloatArray,
    tolerance: FloatArray,
    allowance: FloatArray,
    message: str,
    points: FloatArray,
    *,
    has_creases: bool = False,
) -> None:
    """Raise unless `error` is at most tolerance + allowance at all points, and at most `tolerance`
    at more than half of them; all are (n,).

    has_creases: the field has creases; then the former may fail at a few points, whose differences
        cross a crease.
    """
    agrees = error <= tolerance + allowance
    if has_creases and agrees.mean() >= _MIN_FRACTION_OFF_CREASES:
        return
    require(agrees, message, points, error)
    if np.mean(error <= tolerance) < _MIN_SMOOTH_FRACTION:
        raise BrokenPromiseError(f"{message} at more than half of the {len(points)} points")


def _check_hessian(
    field: Field, points: FloatArray, samples: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """Compare the Hessian with central differences of the gradient, of two orders; the difference
    of the two is a measure of their error. Where f may have creases, the spacing that suits the
    gradient is far too small for second derivatives: so each quantity has its own spacing.
    """
    backend = choose_backend("double")
    try:
        rows = field.prepare(backend).hessian(to_vector3(backend, points, "points"))
    except NotImplementedError:
        return
    n = len(points)
    hessian = np.stack([np.broadcast_to(to_numpy(row), (n, 3)) for row in rows], axis=1)
    require(np.isfinite(hessian).all(axis=(1, 2)), "the Hessian is not finite", points)
    scale = _scale(points, samples)
    length = np.linalg.norm(samples.gradient, axis=1)
    size = np.abs(hessian).max(axis=(1, 2)) + length / scale
    skew = np.abs(hessian - hessian.transpose(0, 2, 1)).max(axis=(1, 2))
    require(skew <= 1e-9 * size, "the Hessian is not symmetric", points, skew)
    if _is_harmonic(samples):
        trace = np.abs(np.trace(hessian, axis1=1, axis2=2))
        require(trace <= 1e-9 * size, "f is harmonic, but its Hessian has a trace", points, trace)
    hessian_error = 0.0  # its truncation error may differ from that of the gradient
    if isinstance(field, BatchedField):
        hessian_error = field.hessian_error_bound(points, precision="double")

    def compare(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The difference between the Hessian and the differences of the gradient, and two bounds of
        its error, as `_limits` gives them."""
        h = stencil[0].h
        fine, coarse = np.zeros_like(hessian), np.zeros_like(hessian)
        for neighbor in stencil:
            fine[:, :, neighbor.axis] += neighbor.weight[:, None] * neighbor.gradient
            half = 0.5 * neighbor.node if abs(neighbor.node) == 1 else 0.0
            coarse[:, :, neighbor.axis] += half * neighbor.gradient / h[:, None]
        tolerance = 1e-7 * size + 0.1 * np.abs(fine - coarse).max(axis=(1, 2)) + hessian_error
        tolerance += 1e-11 * length * (1 + _max_coordinates(points) / h) / h
        allowance = np.sum(
            [np.abs(neighbor.weight) * neighbor.gradient_error for neighbor in stencil], axis=0
        )
        return np.abs(fine - hessian).max(axis=(1, 2)), tolerance, allowance

    agreement = _best_agreement([compare(stencil) for stencil in trials])
    message = "the Hessian is not the derivative of the gradient"
    _require_agreement(*agreement, message, points, has_creases=field.has_creases)
