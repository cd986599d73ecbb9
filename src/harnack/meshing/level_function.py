"""The function f - level of a field f, whose level set (where it is 0) is meshed: its values and
gradients at many points at a time, and proved bounds of its change around them. If f has a period,
f - level is reduced by whole periods to the value nearest to 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, FloatArray, choose_backend
from harnack.backend.elementary import safe_norm
from harnack.enclosures import LevelGaps, Levels, SlopeRange, choose_enclosures, longest_free_length
from harnack.fields.batch_evaluation import map_batches
from harnack.fields.clearance import level_distance_lower_bound
from harnack.fields.evaluator import POINTS, Plan
from harnack.fields.formula_evaluator import without_alternatives
from harnack.fields.solids.mesh_solid import share_samples
from harnack.geometry.mesh_edges import row_norms
from harnack.tracer.traced_surface import CallCache

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields import Field

__all__ = ["CELLS_PER_WAVE", "MOST_FACES", "LevelFunction", "LevelSamples"]

MOST_FACES = 2_000_000
"""The largest number of triangles of a level set, unless another is chosen."""

CELLS_PER_WAVE = 5.0
"""The smallest number of cells along a wave (`Traits.min_wavelength`), without a given spacing."""

_PROOFS = choose_enclosures("curvature")


@dataclass(frozen=True)
class LevelSamples:
    """Values and gradients of f - level at n points.

    value: (n,) f - level; for a field with a period, such as a solid angle, reduced by multiples of
        the period to [-period/2, period/2].
    gradient: (n, 3).
    quarter_period_radius: (n,) the radius of a ball around each point. Within the ball, f is proved
        to differ from its value at the point by less than a quarter of its period. 0 if the field
        has no period."""

    value: FloatArray
    gradient: FloatArray
    quarter_period_radius: FloatArray

    def select(self, rows: Any) -> LevelSamples:
        """The samples of the selected points. rows: the indices of these points, or a mask."""
        return LevelSamples(self.value[rows], self.gradient[rows], self.quarter_period_radius[rows])

    def replaced(self, rows: Any, replacements: LevelSamples) -> LevelSamples:
        """A copy in which the samples at points `rows` (indices or a mask) are `replacements`."""
        value, gradient, radius = (
            self.value.copy(),
            self.gradient.copy(),
            self.quarter_period_radius.copy(),
        )
        value[rows], gradient[rows], radius[rows] = (
            replacements.value,
            replacements.gradient,
            replacements.quarter_period_radius,
        )
        return LevelSamples(value, gradient, radius)

    @property
    def distance(self) -> FloatArray:
        """(n,) the estimated distance from the level set: |f - level|/|gradient|."""
        slope = row_norms(self.gradient)
        return np.abs(self.value) / np.maximum(slope, 1e-300)


@dataclass
class LevelFunction:
    """The function f - level of a field f, evaluated in double precision at arrays of points.
    `evaluations` counts these points. `_evaluator` samples the field on the device
    (`_backend`), and `_levels` holds the level there.

    most_faces: the largest allowed number of triangles of the level set's mesh.
    uploads: holds evaluators in double precision; several functions may share it.
    secant_steps: the number of secant steps that find the point at which an edge of a cell meets
        the level set, for functions that are nearly linear along edges, such as distances. With 0
        it is found by a search.
    is_near: whether it is sampled near the level set, for which long formulas have shorter lists
        (`Plan.levels`).
    evaluations: the number of points at which f has been evaluated."""

    field: Field
    level: float
    most_faces: int = dataclasses.field(default=MOST_FACES, kw_only=True)
    uploads: CallCache = dataclasses.field(default_factory=CallCache, kw_only=True)
    secant_steps: int = dataclasses.field(default=0, kw_only=True)
    is_near: bool = dataclasses.field(default=False, kw_only=True)
    evaluations: int = dataclasses.field(default=0, init=False)

    def __post_init__(self) -> None:
        self._backend = choose_backend("double")
        plan = Plan((self.level,)) if self.is_near else POINTS
        self._evaluator = self.uploads.get_or_make(
            self.field, ("evaluator", plan), lambda: self.field.evaluator(self._backend, plan)
        )
        # Opaque numbers are data of kernels, so that other levels compile nothing.
        level = dr.opaque(self._backend.Float, self.level)
        self._levels = Levels((level,), self.field.period)

    @property
    def period(self) -> float | None:
        """The period of an angle-valued field; None for others."""
        return self.field.period

    def relative_to_level(self, value: FloatArray) -> FloatArray:
        """(n,) f - level for values (n,) of f. If f has a period, a multiple of the period is added
        so that the magnitude is smallest."""
        difference = value - self.level
        if self.period is None:
            return difference
        return difference - self.period * np.round(difference / self.period)

    def sample(self, points: FloatArray) -> LevelSamples:
        """Sample f - level, and its gradient, at points (n, 3)."""
        value, gradient, radius = self._in_batches(points, self._evaluated)
        return LevelSamples(self.relative_to_level(value), gradient, radius)

    def values(self, points: FloatArray) -> FloatArray:
        """(n,) f - level at points (n, 3), without gradients."""

        def value(p: Vec3) -> tuple[Real]:
            """The value of f at the points p, as a tuple of one."""
            with share_samples(), without_alternatives():
                return (self._evaluator.evaluate(p).value,)

        return self.relative_to_level(self._in_batches(points, value)[0])

    def is_on_level(self, points: FloatArray) -> BoolArray:
        """(n,) whether f equals the level at points (n, 3), up to the bound of the error of the
        computed value (rounding, and for a truncated sum its truncation)."""

        def value_and_error(p: Vec3) -> tuple[Real, Real]:
            """Two results for the points p: the value of f, and a bound of its error."""
            with without_alternatives():
                sample = self._evaluator.evaluate(p)
            return sample.value, self._backend.Float(sample.value_error)

        value, error = self._in_batches(points, value_and_error)
        return np.abs(self.relative_to_level(value)) <= error

    def gradient_bounds(
        self, points: FloatArray, radius: FloatArray
    ) -> tuple[LevelSamples, FloatArray]:
        """Samples at points (n, 3), and proved bounds (n,) of |grad f(y) - grad f(x)| for each
        point x and all y within a radius of it.

        radius: (n,) the radius of each point, a length. The rounding error of the sampled gradient
            is included in the bound.

        The samples have no `quarter_period_radius`: it is 0."""

        def compute(p: Vec3, r: Vec3) -> tuple[Real, Vec3, Real]:
            """The value and the gradient of f at the points p, and the bound of the gradient's
            change within the distance r.x of p."""
            sample = self._evaluator.evaluate(p)
            change = self._evaluator.gradient_change_bound(p, r.x) + sample.gradient_error
            return sample.value, sample.gradient, change

        # Each point counts twice: for the sample and for the bound.
        self.evaluations += 2 * len(points)
        # Kernels take vectors, so each radius is passed as a vector of three equal numbers.
        value, gradient, change = map_batches(
            self._backend, compute, points, np.column_stack([radius] * 3), at_once=1 << 18
        )
        return LevelSamples(self.relative_to_level(value), gradient, np.zeros(len(points))), change

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) a proved lower bound of the distance from points (n, 3) to the level set
        (`level_distance_lower_bound`)."""

        def bound(p: Vec3) -> tuple[Real]:
            """The lower bound of the distance from the points p to the level set, as a tuple of
            one."""
            sample = self._evaluator.evaluate(p)
            return (
                level_distance_lower_bound(self._backend, self._evaluator, self._levels, p, sample),
            )

        return self._in_batches(points, bound)[0]

    def _evaluated(self, p: Vec3) -> tuple[Real, Vec3, Real]:
        """The value and the gradient of f at points p, and the radius of a ball around each point,
        for `sample`.

        If f has a period, f is proved to change by less than a quarter of the period within this
        radius, rounding errors included. Otherwise the radius is 0."""
        if self.period is None:
            with share_samples(), without_alternatives():
                sample = self._evaluator.evaluate(p)
            return sample.value, sample.gradient, self._backend.Float(0)
        with share_samples():
            sample = self._evaluator.evaluate(p)
        max_slope = safe_norm(sample.gradient) + sample.gradient_error
        # The slope of f along any direction is at most the length of the gradient.
        slopes = SlopeRange(-max_slope, max_slope)
        enclosures = _PROOFS.from_promises(
            sample.promises, sample.alternative_promises, sample.value, sample.value_error, slopes
        )
        # A quarter above and a quarter below, minus the rounding error.
        quarter = self._backend.Float(0.2499 * self.period) - 2 * sample.value_error
        # The longest distance within which the enclosures prove that f stays in that range.
        return (
            sample.value,
            sample.gradient,
            longest_free_length(enclosures, LevelGaps(quarter, quarter)),
        )

    def _in_batches(
        self, points: FloatArray, kernel: Callable[[Vec3], tuple[Any, ...]]
    ) -> tuple[FloatArray, ...]:
        """Compute the results of a kernel (a function of points of the backend) at points (n, 3),
        batch by batch, and count the points as evaluations. Returns an array with n rows for each
        result."""
        self.evaluations += len(points)
        return map_batches(self._backend, kernel, points, at_once=1 << 18)
