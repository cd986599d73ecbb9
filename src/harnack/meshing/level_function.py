"""The function to be meshed, at many points at a time, and its proved bounds around them."""

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
from harnack.fields.formula import without_alternatives
from harnack.fields.solids.mesh_solid import share_samples
from harnack.meshing.edges import row_norms

if TYPE_CHECKING:
    from harnack.backend import Real, Vec3
    from harnack.fields import Field

__all__ = ["CELLS_PER_WAVE", "MOST_FACES", "EvaluatorCache", "LevelFunction", "LevelSamples"]

MOST_FACES = 2_000_000
"""Triangles of a level set, unless a person chooses otherwise."""

CELLS_PER_WAVE = 5.0
"""Cells along a wave (`Field.min_wavelength`), at the least, unless a spacing is given."""

_PROOFS = choose_enclosures("curvature")


@dataclass(frozen=True)
class LevelSamples:
    """The function at points.

    value: (n,) f - level; for an angle the value nearest to 0, in [-period/2, period/2].
    gradient: (n, 3).
    quarter_period_radius: (n,) a radius within which f is proved to change by less than a quarter
        of its period; 0 without a period.
    """

    value: FloatArray
    gradient: FloatArray
    quarter_period_radius: FloatArray

    def select(self, rows: Any) -> LevelSamples:
        """The samples at the points that `rows`, indices or a mask, select."""
        return LevelSamples(self.value[rows], self.gradient[rows], self.quarter_period_radius[rows])

    def replaced(self, rows: Any, samples: LevelSamples) -> LevelSamples:
        """The samples, with `samples` in place of the samples at points `rows`."""
        value, gradient, reach = (
            self.value.copy(),
            self.gradient.copy(),
            self.quarter_period_radius.copy(),
        )
        value[rows], gradient[rows], reach[rows] = (
            samples.value,
            samples.gradient,
            samples.quarter_period_radius,
        )
        return LevelSamples(value, gradient, reach)

    @property
    def distance(self) -> FloatArray:
        """(n,) the distance to the level, estimated by the slope: |f - level|/|gradient|."""
        steep = row_norms(self.gradient)
        return np.abs(self.value) / np.maximum(steep, 1e-300)


class EvaluatorCache:
    """Fields on the backend of double precision, each prepared once."""

    def __init__(self) -> None:
        self._evaluators: dict[int, tuple[Field, Field]] = {}

    def of(self, field: Field) -> Field:
        if id(field) not in self._evaluators:  # it is stored, so that no other field has its id
            self._evaluators[id(field)] = field, field.prepare(choose_backend("double"))
        return self._evaluators[id(field)][1]


@dataclass
class LevelFunction:
    """f - level, in double precision.

    most_faces: the largest number of triangles of its mesh.
    evaluations: of f so far, in points. uploads: the prepared fields, which functions share.
    secant_steps: the number of secant steps for the roots on edges of cells, for functions that are
        nearly linear along edges, such as distances; 0 for a search.
    """

    field: Field
    level: float
    most_faces: int = dataclasses.field(default=MOST_FACES, kw_only=True)
    uploads: EvaluatorCache = dataclasses.field(default_factory=EvaluatorCache, kw_only=True)
    secant_steps: int = dataclasses.field(default=0, kw_only=True)
    evaluations: int = dataclasses.field(default=0, init=False)

    def __post_init__(self) -> None:
        self._backend = choose_backend("double")
        self._prepared = self.uploads.of(self.field)
        # Data, so that other levels compile nothing.
        level = dr.opaque(self._backend.Float, self.level)
        self._levels = Levels((level,), self.field.period)

    @property
    def period(self) -> float | None:
        """The period of an angle-valued field; None for others."""
        return self.field.period

    def relative_to_level(self, value: FloatArray) -> FloatArray:
        """f - level, from values of f."""
        difference = value - self.level
        if self.period is None:
            return difference
        return difference - self.period * np.round(difference / self.period)

    def sample(self, points: FloatArray) -> LevelSamples:
        """The function at points (n, 3)."""
        value, gradient, reach = self._in_batches(points, self._evaluated)
        return LevelSamples(self.relative_to_level(value), gradient, reach)

    def values(self, points: FloatArray) -> FloatArray:
        """(n,) f - level alone."""

        def value(p: Vec3) -> tuple[Real]:
            with share_samples(), without_alternatives():
                return (self._prepared.evaluate(p).value,)

        return self.relative_to_level(self._in_batches(points, value)[0])

    def is_on_level(self, points: FloatArray) -> BoolArray:
        """(n,) where f equals the level up to its error: rounding error, and truncation error of a
        sum."""

        def both(p: Vec3) -> tuple[Real, Real]:
            with without_alternatives():
                sample = self._prepared.evaluate(p)
            return sample.value, self._backend.Float(sample.value_error)

        value, error = self._in_batches(points, both)
        return np.abs(self.relative_to_level(value)) <= error

    def gradient_bounds(
        self, points: FloatArray, radius: FloatArray
    ) -> tuple[LevelSamples, FloatArray]:
        """The samples of the function at points (n, 3), without `quarter_period_radius`, and a
        bound of the change of its gradient within `radius` (n,) of each point, rounding included:
        see `Field.gradient_change_bound`."""

        def compute(p: Vec3, r: Vec3) -> tuple[Real, Vec3, Real]:
            sample = self._prepared.evaluate(p)
            change = self._prepared.gradient_change_bound(p, r.x) + sample.gradient_error
            return sample.value, sample.gradient, change

        self.evaluations += 2 * len(points)
        value, gradient, change = map_batches(
            self._backend, compute, points, np.column_stack([radius] * 3), at_once=1 << 18
        )
        return LevelSamples(self.relative_to_level(value), gradient, np.zeros(len(points))), change

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) a lower bound of the distance to the level set: see `level_distance_lower_bound`."""

        def bound(p: Vec3) -> tuple[Real]:
            sample = self._prepared.evaluate(p)
            return (
                level_distance_lower_bound(self._backend, self._prepared, self._levels, p, sample),
            )

        return self._in_batches(points, bound)[0]

    def _evaluated(self, p: Vec3) -> tuple[Real, Vec3, Real]:
        if self.period is None:
            with share_samples(), without_alternatives():
                sample = self._prepared.evaluate(p)
            return sample.value, sample.gradient, self._backend.Float(0)
        with share_samples():
            sample = self._prepared.evaluate(p)
        steepest = safe_norm(sample.gradient) + sample.gradient_error
        slopes = SlopeRange(-steepest, steepest)
        enclosures = _PROOFS.from_promises(
            sample.promises, sample.alternative_promises, sample.value, sample.value_error, slopes
        )
        # A quarter above and a quarter below, minus the rounding error.
        quarter = self._backend.Float(0.2499 * self.period) - 2 * sample.value_error
        return (
            sample.value,
            sample.gradient,
            longest_free_length(enclosures, LevelGaps(quarter, quarter)),
        )

    def _in_batches(
        self, points: FloatArray, kernel: Callable[[Vec3], tuple[Any, ...]]
    ) -> tuple[FloatArray, ...]:
        self.evaluations += len(points)
        return map_batches(self._backend, kernel, points, at_once=1 << 18)
