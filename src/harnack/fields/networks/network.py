"""Neural networks as fields: multilayer perceptrons, whose level sets are traced with a proof."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.enclosures import Lipschitz, SlopeRange
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from harnack.enclosures.samples import RaySample, Sample
from harnack.fields.batched_fields import cached_upload
from harnack.fields.evaluator import POINTS, Evaluator, Plan
from harnack.fields.field import Field, Traits
from harnack.fields.networks.activations import Activation, activation_of
from harnack.fields.networks.expansion import expand
from harnack.fields.networks.layer_tables import LayerTables, spectral_bound
from harnack.geometry.clip_volumes import Box

__all__ = ["Network"]

_RADII = (2.0**-2, 2.0**-4, 2.0**-6, 2.0**-8)

class Network(Field):
    traits = Traits(over_relaxation=1.0, has_creases=True)

    def __init__(self, layers, *, activation="relu", domain=None, level=0.0):
        self.layers = tuple((np.array(w, np.float64), np.array(b, np.float64)) for w, b in layers)
        self.activations = (activation_of(activation),) * (len(self.layers) - 1)
        self.domain = Box((-1, -1, -1), (1, 1, 1)) if domain is None else domain
        self.default_level = float(level)

    def evaluator(self, backend, plan=POINTS):
        del plan
        return _NetworkEvaluator(*self._upload(backend))

    @cached_upload
    def _upload(self, backend):
        lower, upper = self.domain.bounds()
        lip = 1.0
        for w, _ in self.layers: lip *= spectral_bound(w)
        for a in self.activations: lip *= a.max_slope
        return (LayerTables.upload(backend, list(self.layers), self.activations),
            dr.opaque(backend.Float, lip * (1 + 1e-6)),
            dr.opaque(backend.Float, float(np.linalg.norm(upper - lower))))


@dataclass(frozen=True, eq=False)
class _NetworkEvaluator(Evaluator):
    tables: LayerTables
    lipschitz: Any
    size: Any

    def evaluate(self, p):
        radii = [self.size * r for r in _RADII]
        at = expand(self.tables, p, radii, None)
        norm = dr.norm(at.gradient) * (1 + 1e-5)
        promises = [Lipschitz(norm + b.gradient_change, b.radius) for b in at.bounds]
        promises.append(Lipschitz(0 * p.x + self.lipschitz))
        return Sample(at.value, at.gradient, tuple(promises), at.value_error, at.gradient_error)

    def gradient_change_bound(self, p, radius):
        return expand(self.tables, p, [radius], None).bounds[0].gradient_change

    def sample_ray(self, path, t, ahead, back):
        if PiecewiseTaylorEnclosure not in path.proofs.kinds:
            return path.enclose(self.evaluate(path.point(t)))
        p = path.point(t)
        length = dr.clip(ahead, 1e-30, 1e15)
        lengths = [length]
        at = expand(self.tables, p, lengths, path.direction)
        slope = dr.dot(at.gradient, path.direction)
        err = at.linear_error + 4 * self.tables.unit * dr.norm(at.gradient)
        enclosures = []
        for b in at.bounds:
            slopes = SlopeRange(slope - err + b.lower_slope, slope + err + b.upper_slope)
            enclosures.append(ParabolaEnclosure(slopes, b.lower_second, b.upper_second, b.length))
        sample = Sample(at.value, at.gradient, (Lipschitz(0 * p.x + self.lipschitz),), at.value_error, at.gradient_error)
        return RaySample(sample, tuple(enclosures), (), slope, 2.0, at.slope_error)
