"""Tests that the derivatives which a field returns (gradient, Laplacian, Hessian of its function f)
agree with central differences. A central difference is a weighted sum of f, or of its gradient, at
a few nodes: positions at multiples of a spacing h from a point, along a coordinate axis. For each
point two differences are computed, with the spacings h and 2h; how much they differ tells the error
of the first. The samples at the nodes are called the stencil. If it is not known over which length
f is smooth, several spacings are tried, each with a stencil of its own.

The allowed difference has two parts: the tolerance, a bound of the error of the differences
themselves; and the allowance, which comes from the errors that the field states for its values and
gradients.
"""

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
# of 1/h. The two results differ by 15 times the leading error of the first. So a fifth of their
# difference (_RICHARDSON_FRACTION) allows three times that error (Richardson extrapolation).
_NODES = (-4.0, -2.0, -1.0, 1.0, 2.0, 4.0)
_WEIGHTS = (0.0, 1 / 12, -8 / 12, 8 / 12, -1 / 12, 0.0)
_WIDE_WEIGHTS = (1 / 24, -8 / 24, 0.0, 0.0, 8 / 24, -1 / 24)
_RICHARDSON_FRACTION = 0.2
# Where no `HarmonicBall` says over which length f is smooth, spacings smaller by these factors are
# tried, too.
_SPACING_FACTORS = (1.0, 0.1, 0.01, 1e-3, 1e-4)
# For a field with an error bound, the differences must agree at this fraction of the points even
# without an allowance for it: between most neighboring points the approximation itself is smooth.
_MIN_SMOOTH_FRACTION = 0.5
# For a field with creases they must agree at this fraction of the points.
_MIN_FRACTION_OFF_CREASES = 0.9


def check_derivatives(field: Field, points: FloatArray, look: FieldSamples) -> None:
    """Check that the gradient, Laplacian and Hessian of a field at points (n, 3) agree with central
    differences.

    look: the samples of the field at the points: values, gradients, errors and proved bounds near
        the points.

    Differences are taken within the field's domain; points too close to its border for that are
    left out.

    Raises:
        BrokenPromiseError: naming the point where they do not agree.
    """
    h, is_inside = _spacing_within(field, points, _first_spacing(points, look))
    if not is_inside.any():
        return
    points, look, h = points[is_inside], look.subset(is_inside), h[is_inside]
    has_ball = any(isinstance(entry, HarmonicBall) for entry in look.promises)
    # If f is harmonic on a ball about each point, one spacing is enough.
    trials = [
        list(_stencil_samples(field, points, look, factor * h))
        for factor in (_SPACING_FACTORS[:1] if has_ball else _SPACING_FACTORS)
    ]
    # At each point the gradient is tested with the spacing of the smallest allowed difference.
    limits = [np.add(*_limits(field, points, look, stencil)) for stencil in trials]
    stencil = _pick_spacing(trials, np.argmin(limits, axis=0))
    _check_gradient(field, points, look, stencil)
    _check_laplacian(points, look, trials)
    try:
        _check_hessian(field, points, look, trials)
    except BrokenPromiseError:
        if not field.traits.has_variable_accuracy:
            raise
        # The Hessian may be the derivative of the exact gradient, without truncation error.
        exact_trials = [_without_truncation(field, points, entry) for entry in trials]
        _check_hessian(field, points, look, exact_trials)


def _spacing_within(
    field: Field, points: FloatArray, h: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Spacings of central differences whose nodes lie in the field's domain. For each of the points
    (n, 3), the spacing h (n,) is halved until that is so.

    Returns the spacings (n,); and a mask (n,) of the points for which one was found.
    """
    is_inside = np.ones(len(points), dtype=np.bool_)
    if field.domain is None:
        return h, is_inside
    # At most 24 halvings: a point that is so near to the border has no spacing.
    for _ in range(24):
        is_inside[:] = True
        # The domain is convex, so it is enough to test the outermost nodes.
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
    """The samples of a field at one node of central differences around n points: for each point,
    the node is at the position node * h from it along a coordinate axis. `weight` and `wide` are
    the node's weights in the differences with the spacings h and 2h, and `move` is the value at the
    node minus the value at the point.

    axis: the index of the axis, 0, 1 or 2.
    node: one of `_NODES`.
    h: (n,) the spacing.
    weight: (n,) the weight of the node in the difference with the spacing h.
    wide: (n,) its weight in the difference with the spacing 2h.
    move: (n,) the value at the node minus the value at the point, without jumps and periods.
    gradient: (n, 3) the gradient at the node.
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
    """The samples of the field at all nodes of central differences around points (n, 3), one node
    after the other.

    samples: the samples at the points themselves.
    h: (n,) the spacing of the nodes.
    """
    for axis in range(3):
        for node, weight, wide in zip(_NODES, _WEIGHTS, _WIDE_WEIGHTS, strict=True):
            # (0 * points: a row for each point.)
            direction = np.sign(node) * np.eye(3)[axis] + 0 * points
            length = np.abs(node) * h
            node_samples = sample_field(field, points + length[:, None] * direction)
            change = node_samples.value - samples.value
            if field.period is not None:
                change -= field.period * np.round(change / field.period)
            ends = np.column_stack([0 * length, length])
            # Subtract the jumps of f across facets between the point and the node.
            change -= accumulated_jumps(field, points, direction, ends)[:, 1]
            error = samples.error + node_samples.error
            yield _StencilSample(
                axis, node, h, weight / h, wide / h, change, node_samples.gradient, error,
                samples.gradient_error + node_samples.gradient_error,
            )  # fmt: skip


def _without_truncation(
    field: Field, points: FloatArray, stencil: list[_StencilSample]
) -> list[_StencilSample]:
    """Return the stencil (samples at the nodes) with other gradients: those of the exact field,
    without the truncation error of a treecode. It is needed because the Hessian that a treecode
    computes may be the derivative of its own gradient or of the exact one.

    points: (n, 3) the points around which the nodes lie.
    stencil: the samples of the treecode at the nodes.
    """
    # `closely` samples without truncation error.
    error = sample_field(field, points, closely=True).gradient_error
    exact: list[_StencilSample] = []
    for node_sample in stencil:
        nodes = points + (node_sample.node * node_sample.h)[:, None] * np.eye(3)[node_sample.axis]
        sample = sample_field(field, nodes, closely=True)
        # `_StencilSample.gradient_error` is the sum of two errors: at the point and at the node.
        errors = error + sample.gradient_error
        exact.append(
            dataclasses.replace(node_sample, gradient=sample.gradient, gradient_error=errors)
        )
    return exact


def _pick_spacing(
    trials: list[list[_StencilSample]], choice: npt.NDArray[np.intp]
) -> list[_StencilSample]:
    """For each of n points, the samples at the nodes of central differences with one of several
    spacings.

    trials: for each spacing, the samples at all nodes.
    choice: (n,) for each point, the index of its spacing in `trials`.
    """
    if len(trials) == 1:
        return trials[0]
    # Point k takes its numbers from the spacing choice[k].
    rows = np.arange(len(choice))

    def pick(nodes: tuple[_StencilSample, ...]) -> _StencilSample:
        """The samples at one node, for each point from the chosen spacing.

        nodes: the samples at this node for each of the spacings.
        """
        arrays: dict[str, Any] = {
            name: np.stack([getattr(sample, name) for sample in nodes])[choice, rows]
            for name in ("h", "weight", "wide", "move", "gradient", "error", "gradient_error")
        }
        return dataclasses.replace(nodes[0], **arrays)

    return [pick(nodes) for nodes in zip(*trials, strict=True)]


def _first_spacing(points: FloatArray, samples: FieldSamples) -> FloatArray:
    """The spacings (n,) of central differences at points (n, 3) that are tried first, as lengths.

    samples: the samples of the field at the points.
    """
    return 2e-3 * _scale(points, samples)


def _scale(points: FloatArray, samples: FieldSamples) -> FloatArray:
    """For each of the points (n, 3), a length (n,) over which f is smooth: the smallest radius of
    the balls on which f is promised to be harmonic, at most the extent of the points. Without such
    balls it is the extent, which proves nothing.

    samples: the samples of the field at the points.
    """
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
    """Compare the gradients at points (n, 3) with central differences of the value. Raises a
    BrokenPromiseError where they do not agree.

    samples: the samples at the points.
    stencil: the samples at the nodes of the differences.
    """
    tolerance, allowance = _limits(field, points, samples, stencil)
    # The difference with the smaller of the two spacings.
    error = np.linalg.norm(_difference(stencil)[0] - samples.gradient, axis=1)
    message = "the gradient is not that of the value"
    _require_agreement(
        error, tolerance, allowance, message, points, has_creases=field.traits.has_creases
    )


def _difference(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray]:
    """Two arrays of gradients (n, 3) from central differences of the value: the first with the
    spacing h, the second with the spacing 2h.

    stencil: the samples at the nodes.
    """
    fine, wide = (np.zeros((len(stencil[0].h), 3)) for _ in range(2))
    for neighbor in stencil:
        fine[:, neighbor.axis] += neighbor.weight * neighbor.move
        wide[:, neighbor.axis] += neighbor.wide * neighbor.move
    return fine, wide


def _limits(
    field: Field, points: FloatArray, samples: FieldSamples, nodes: list[_StencilSample]
) -> tuple[FloatArray, FloatArray]:
    """The allowed difference between the gradient and central differences of the value, in two
    parts (n,) and (n,). The first, the tolerance, bounds the truncation and rounding error of the
    differences. The second, the allowance, comes from the errors that the field states for value
    and gradient.

    points: (n, 3).
    samples: the samples at the points.
    nodes: the samples at the nodes of the differences.
    """
    h = nodes[0].h
    allowance = samples.gradient_error.copy()
    for neighbor in nodes:
        allowance += np.abs(neighbor.weight) * neighbor.error
    length = np.linalg.norm(samples.gradient, axis=1)
    magnitude = np.abs(samples.value) + (field.period or 0)
    # Rounding errors of values and coordinates, divided by the spacing.
    tolerance = 1e-6 * length + (1e-12 * magnitude + 1e-12 * length * _max_coordinates(points)) / h
    # The difference of both tells the leading error of the first (Richardson extrapolation).
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
    """The sums (n,) for each point of the absolute values of all terms in the central differences
    of the gradient that give the second derivatives along the three axes. Each is at least the sum
    of the absolute values of these derivatives.

    stencil: the samples at the nodes.
    """
    return np.sum(
        [np.abs(neighbor.weight * neighbor.gradient[:, neighbor.axis]) for neighbor in stencil],
        axis=0,
    )


def _check_laplacian(
    points: FloatArray, samples: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """Compare the Laplacians at points (n, 3) with central differences of the gradient: they must
    be 0 where f is promised to be harmonic, and within their promised bounds. Raises a
    BrokenPromiseError if they are not.

    samples: the samples at the points.
    trials: for each of several spacings, the samples at the nodes of the differences.
    """
    bounds = [promise for promise in samples.promises if isinstance(promise, BoundedLaplacian)]
    if not _is_harmonic(samples) and not bounds:
        return
    length = np.linalg.norm(samples.gradient, axis=1)

    def compare(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return three arrays (n,): the Laplacian by central differences with one spacing; a bound
        of the error of the differences (tolerance); and the contribution of the field's own errors
        (allowance).

        stencil: the samples at the nodes.
        """
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
        # The estimated error of the difference; and rounding, of the gradients and of the
        # coordinates.
        tolerance = 1e-6 * _second_derivatives(stencil) + _RICHARDSON_FRACTION * np.abs(
            laplacian - wide
        )
        tolerance += 1e-11 * length * (1 + _max_coordinates(points) / h) / h
        return laplacian, tolerance, allowance

    # For each spacing: Laplacian, tolerance, allowance.
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
        # By how much the Laplacian is outside of its promised bounds.
        excesses = [
            (np.maximum(np.maximum(lower - laplacian, laplacian - upper), 0), *rest)
            for laplacian, *rest in tests
        ]
        message = "BoundedLaplacian: the Laplacian is not between its ends"
        _require_agreement(*_best_agreement(excesses), message, points)


def _best_agreement(
    results: list[tuple[FloatArray, ...]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Choose the spacing of central differences by which each point is judged. Returns three arrays
    (n,) at that spacing: how far the field's derivative is from the differences (error); the bound
    of the error of the differences (tolerance); and the contribution of the field's own errors
    (allowance).

    results: these three arrays for each spacing.

    At each point, the two spacings with the smallest bounds are considered, and the one at which
    the bounds are exceeded less is chosen. A single spacing would not be enough: differences across
    a crease are wrong, and may have a small bound by accident.
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
    """Whether the field promises that f is harmonic in space, on balls about the points. (A ball of
    dimension 4 says nothing about the Laplacian in space.)"""
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
    """Raise a BrokenPromiseError unless `error` is at most tolerance + allowance at all points, and
    at most `tolerance` at half of them or more.

    error: (n,) how far the field's derivative is from the differences.
    tolerance, allowance: (n,) the two parts of the allowed difference.
    message: the message of the error.
    points: (n, 3).
    has_creases: whether f may have creases. Then the first condition may fail at a few points,
        because differences across a crease are wrong.
    """
    agrees = error <= tolerance + allowance
    # A few differences across creases are allowed to be wrong.
    if has_creases and agrees.mean() >= _MIN_FRACTION_OFF_CREASES:
        return
    require(agrees, message, points, error)
    if np.mean(error <= tolerance) < _MIN_SMOOTH_FRACTION:
        raise BrokenPromiseError(f"{message} at more than half of the {len(points)} points")


def _check_hessian(
    field: Field, points: FloatArray, samples: FieldSamples, trials: list[list[_StencilSample]]
) -> None:
    """Compare the Hessians at points (n, 3) with central differences of the gradient. They must
    also be finite and symmetric, and without trace if f is harmonic. Raises a BrokenPromiseError if
    they are not. A field without Hessians passes.

    samples: the samples at the points.
    trials: for each of several spacings, the samples at the nodes of the differences.

    The differences are computed in two orders of accuracy; the difference of both is a measure of
    their error. Each tested quantity uses the spacing that suits it best. If f may have creases,
    the spacing for the gradient is far too small for second derivatives.
    """
    backend = choose_backend("double")
    try:
        rows = field.evaluator(backend).hessian(to_vector3(backend, points, "points"))
    except NotImplementedError:
        return
    n = len(points)
    hessian = np.stack([np.broadcast_to(to_numpy(row), (n, 3)) for row in rows], axis=1)
    require(np.isfinite(hessian).all(axis=(1, 2)), "the Hessian is not finite", points)
    scale = _scale(points, samples)
    length = np.linalg.norm(samples.gradient, axis=1)
    size = np.abs(hessian).max(axis=(1, 2)) + length / scale
    # A mixed derivative must not depend on the order.
    skew = np.abs(hessian - hessian.transpose(0, 2, 1)).max(axis=(1, 2))
    require(skew <= 1e-9 * size, "the Hessian is not symmetric", points, skew)
    if _is_harmonic(samples):
        trace = np.abs(np.trace(hessian, axis1=1, axis2=2))
        require(trace <= 1e-9 * size, "f is harmonic, but its Hessian has a trace", points, trace)
    hessian_error = 0.0  # its truncation error may differ from that of the gradient
    if isinstance(field, BatchedField):
        hessian_error = field.hessian_error_bound(points, precision="double")

    def compare(stencil: list[_StencilSample]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return three arrays (n,): the largest difference between an entry of the field's Hessian
        and central differences of the gradient with one spacing; a bound of the error of the
        differences (tolerance); and the contribution of the field's own errors (allowance).

        stencil: the samples at the nodes.
        """
        h = stencil[0].h
        fine, coarse = np.zeros_like(hessian), np.zeros_like(hessian)
        for neighbor in stencil:
            fine[:, :, neighbor.axis] += neighbor.weight[:, None] * neighbor.gradient
            # The second-order difference uses the nodes -1 and 1, with the weights -1/2 and 1/2.
            half = 0.5 * neighbor.node if abs(neighbor.node) == 1 else 0.0
            coarse[:, :, neighbor.axis] += half * neighbor.gradient / h[:, None]
        tolerance = 1e-7 * size + 0.1 * np.abs(fine - coarse).max(axis=(1, 2)) + hessian_error
        # Rounding: of the gradients, and of the coordinates of the nodes.
        tolerance += 1e-11 * length * (1 + _max_coordinates(points) / h) / h
        allowance = np.sum(
            [np.abs(neighbor.weight) * neighbor.gradient_error for neighbor in stencil], axis=0
        )
        return np.abs(fine - hessian).max(axis=(1, 2)), tolerance, allowance

    agreement = _best_agreement([compare(stencil) for stencil in trials])
    message = "the Hessian is not the derivative of the gradient"
    _require_agreement(*agreement, message, points, has_creases=field.traits.has_creases)
