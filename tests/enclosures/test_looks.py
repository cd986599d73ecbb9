"""Fields that answer looks along a path with enclosures of their own, as Taylor forms do."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import SlopeRange, choose_enclosures
from harnack.enclosures.parabola import ParabolaEnclosure
from harnack.enclosures.samples import Ray as RayPath
from harnack.enclosures.samples import RaySample
from harnack.fields import Field, Sample

CENTERS = np.random.default_rng(5).uniform(-0.8, 0.8, (5, 3))
WIDTH = 0.4
# Of exp(-u^2): the second derivative is 4u^2 - 2 times it, between -2 and 4 exp(-3/2).
_MOST = 4 * math.exp(-1.5)


class Blobs(Field):
    """A sum of Gaussians, with a curvature that holds everywhere."""

    domain = hk.Ball(radius=2.5)
    default_level = 0.5

    def evaluate(self, p: Any) -> Sample:
        value, gradient = type(p.x)(0), type(p)(0)
        for center in CENTERS:
            u = (p - type(p)(*center.tolist())) / WIDTH
            one = dr.exp(-dr.squared_norm(u))
            value, gradient = value + one, gradient - 2 / WIDTH * one * u
        return Sample(
            value, gradient, (hk.proofs.TaylorRemainder(2 * len(CENTERS) / WIDTH**2),), 1e-6
        )


class TaylorBlobs(Blobs):
    """The same; looked at along a path, it bounds second derivatives on the candidate alone.

    Proof. On a ray a Gaussian is exp(-h^2) exp(-u^2) with u linear in t, whose second derivative
    exp(-h^2) (4u^2 - 2) exp(-u^2)/width^2 has its only extrema at u = 0 (least) and u^2 = 3/2
    (most), so that its range on an interval is that of its ends and of those inside it.
    """

    def evaluator(self, backend: Any, plan: Any = None) -> TaylorEvaluator:
        return TaylorEvaluator(self, backend)


class TaylorEvaluator(hk.fields.SampleEvaluator):
    """Samples `TaylorBlobs`."""

    def sample_ray(self, path: RayPath, t: Any, ahead: Any, back: Any) -> RaySample:
        look = path.enclose(self.evaluate(path.point(t)))
        slope, sample = look.slope, look.sample
        slopes = SlopeRange.around(slope, sample.gradient_error)
        ahead = dr.select(dr.isfinite(ahead), ahead, 10.0)
        least, most = self.second_derivatives(path, t, t + ahead)
        forward = ParabolaEnclosure(slopes, least, most, ahead)
        least, most = self.second_derivatives(path, t - back, t)
        backward = ParabolaEnclosure(slopes.negated(), least, most, back)
        return RaySample(sample, (*look.forward, forward), (*look.backward, backward), slope)

    def second_derivatives(self, path: RayPath, start: Any, end: Any) -> tuple[Any, Any]:
        least, most = type(start)(0), type(start)(0)
        for center in CENTERS:
            to_center = type(path.origin)(*center.tolist()) - path.origin
            middle = dr.dot(to_center, path.direction)
            h = dr.squared_norm(to_center - middle * path.direction) / WIDTH**2
            u0, u1 = (start - middle) / WIDTH, (end - middle) / WIDTH
            bends = [(4 * u * u - 2) * dr.exp(-u * u) for u in (u0, u1)]
            low, high = dr.minimum(*bends), dr.maximum(*bends)
            low = dr.select((u0 < 0) & (u1 > 0), -2, low)
            for u in (-math.sqrt(1.5), math.sqrt(1.5)):
                high = dr.select((u0 < u) & (u1 > u), _MOST, high)
            scale = dr.exp(-h) / WIDTH**2
            least, most = least + scale * low, most + scale * high
        rounding = 1e-5 * (dr.abs(least) + dr.abs(most)) + 1e-6
        return least - rounding, most + rounding


def rays(n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    o = rng.normal(size=(n, 3))
    o *= 2.4 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1, 1, (n, 3)) - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("precision", ["single", "double"])
def test_what_a_field_proves_along_a_path_is_used(precision: Any) -> None:
    """The same hits, in fewer looks than with what holds in all directions."""
    o, d = rays(4000)
    plain = hk.trace(Blobs(), o, d, precision=precision, tolerance=1e-5)
    taylor = hk.trace(TaylorBlobs(), o, d, precision=precision, tolerance=1e-5)
    same = plain.is_hit == taylor.is_hit
    assert same.mean() > 0.999  # those that graze within the tolerance may differ
    assert 500 < plain.is_hit.sum() < 3500
    both = plain.is_hit & taylor.is_hit
    grazing = np.abs((plain.normal * d).sum(axis=1)) < 0.05
    np.testing.assert_allclose(plain.t[both & ~grazing], taylor.t[both & ~grazing], atol=5e-4)
    assert taylor.evaluations.mean() < 0.6 * plain.evaluations.mean()
    assert (taylor.status != int(hk.RayStatus.OUT_OF_STEPS)).all()


@pytest.mark.slow
def test_no_hit_of_a_path_s_own_enclosures_is_missed() -> None:
    """Against samples of f along the rays, in float64."""
    o, d = rays(1500)
    hits = hk.trace(TaylorBlobs(), o, d, tolerance=1e-5, precision="single")
    t = np.linspace(0, 4.9, 4000)
    x = o[:, None] + t[:, None] * d[:, None]
    inside = (x**2).sum(axis=2) <= 2.5**2
    distance = ((x[:, :, None] - CENTERS) ** 2).sum(axis=3) / WIDTH**2
    above = (np.exp(-distance).sum(axis=2) > 0.5 + 1e-4) & inside
    first = np.where(above.any(axis=1), t[above.argmax(axis=1)], np.inf)
    assert (hits.t <= first + 1e-4).all()


def test_enclosures_hold_along_the_path_in_both_directions() -> None:
    """Movements of f, sampled, lie within the parabolas, and reach them."""
    backend = choose_backend("double")
    real = backend.Float
    o, d = rays(600)
    rng = np.random.default_rng(2)
    t, ahead, back = (rng.uniform(0, high, 600) for high in (2.5, 1.5, 1.0))
    path = RayPath(to_vector3(backend, o), to_vector3(backend, d), choose_enclosures(None))
    field = TaylorBlobs()
    look = field.evaluator(backend).sample_ray(path, real(t), real(ahead), real(back))
    closest = np.inf
    for enclosure, sign, length in ((look.forward[-1], 1, ahead), (look.backward[-1], -1, back)):
        assert isinstance(enclosure, ParabolaEnclosure)
        slopes = to_numpy(enclosure.slopes.lower)
        least, most = (
            to_numpy(enclosure.min_second_derivative),
            to_numpy(enclosure.max_second_derivative),
        )
        for share in np.linspace(0.02, 1, 40):
            s = share * length
            there = field.value(o + (t + sign * s)[:, None] * d, precision="double")
            here = field.value(o + t[:, None] * d, precision="double")
            bent = there - here - slopes * s
            assert (bent <= 0.5 * most * s * s + 1e-12).all()
            assert (bent >= 0.5 * least * s * s - 1e-12).all()
            closest = min(closest, float((0.5 * most * s * s - bent).min()))
    assert closest < 1e-3


def test_candidates_grow_and_shrink() -> None:
    """A field is asked for twice the last step, and after a step of zero for a third."""

    class Bisecting(Field):
        """f = x - 1: knows nothing on candidates longer than 0.1, all on shorter ones."""

        domain = hk.Box((-5.0,) * 3, (5.0,) * 3)

        def evaluate(self, p: Any) -> Sample:
            return Sample(p.x - 1, type(p)(1, 0, 0), (hk.proofs.Lipschitz(math.inf),))

        def evaluator(self, backend: Any, plan: Any = None) -> BisectingEvaluator:
            return BisectingEvaluator(self, backend)

    class BisectingEvaluator(hk.fields.SampleEvaluator):
        """Samples `Bisecting`."""

        def sample_ray(self, path: RayPath, t: Any, ahead: Any, back: Any) -> RaySample:
            look = path.enclose(self.evaluate(path.point(t)))
            slopes = SlopeRange.around(look.slope, 0.0)
            short = dr.select(ahead < 0.1, ahead, 0)
            return RaySample(
                look.sample,
                (*look.forward, ParabolaEnclosure(slopes, 0.0, 0.0, short)),
                look.backward,
                look.slope,
            )

    hits = hk.trace(Bisecting(), [[-4.0, 0, 0]], [[1.0, 0, 0]], max_steps=5000)
    assert hits.is_hit[0]
    assert hits.t[0] == pytest.approx(5.0, abs=2e-4)
    assert hits.evaluations[0] < 400
    endless = Bisecting()
    endless.domain = None
    hits = hk.trace(endless, [[-4.0, 0, 0]], [[1.0, 0, 0]], t_max=math.inf)
    assert hits.t[0] == pytest.approx(5.0, abs=2e-4)
    assert hits.evaluations[0] < 400


@pytest.mark.parametrize("unit", [1e-24, 1e20])
def test_enclosures_of_values_of_any_size_miss_nothing(unit: float) -> None:
    """Squares of such slopes vanish or overflow in single precision: 469 hits were passed."""

    class Scaled(TaylorBlobs):
        default_level = 0.5 * unit

        def evaluator(self, backend: Any, plan: Any = None) -> ScaledEvaluator:
            return ScaledEvaluator(self, backend)

    class ScaledEvaluator(TaylorEvaluator):
        """Samples `Scaled`."""

        def sample_ray(self, path: RayPath, t: Any, ahead: Any, back: Any) -> RaySample:
            look = super().sample_ray(path, t, ahead, back)
            sample = look.sample

            def scaled(one: ParabolaEnclosure) -> ParabolaEnclosure:
                slopes = SlopeRange(one.slopes.lower * unit, one.slopes.upper * unit)
                bends = one.min_second_derivative * unit, one.max_second_derivative * unit
                return ParabolaEnclosure(slopes, *bends, one.reach)

            seen = Sample(
                sample.value * unit, sample.gradient * unit, (), sample.value_error * unit
            )
            ahead, back = scaled(look.forward[-1]), scaled(look.backward[-1])
            return RaySample(seen, (ahead,), (back,), look.slope * unit)

    o, d = rays(20_000)
    plain = hk.trace(TaylorBlobs(), o, d, tolerance=1e-5, over_relaxation=1.8, precision="single")
    scaled = hk.trace(Scaled(), o, d, tolerance=1e-5, over_relaxation=1.8, precision="single")
    assert (plain.is_hit == scaled.is_hit).mean() > 0.9998


def test_a_level_within_a_large_error_is_not_passed() -> None:
    """f is off by 0.001 and says so: on which side the level lies is not known."""

    class Off(Field):
        domain = hk.Box((-5.0,) * 3, (5.0,) * 3)

        def evaluate(self, p: Any) -> Sample:
            near = dr.abs(p.x) < 0.3
            value = p.x - dr.select(near, 0.001, 0.0)
            error = dr.select(near, 0.001001, 0.0)
            return Sample(value, type(p)(1, 0, 0), (hk.proofs.TaylorRemainder(1.0),), error)

    hits = hk.trace(Off(), [[2e-4, 0, 0]], [[-1.0, 0, 0]], level=0.0, precision="single")
    assert hits.status[0] != int(hk.RayStatus.MISS)


@pytest.mark.parametrize("distance", [1e-5, 1e-6, 1e-7])
def test_rays_beside_the_origin_of_coordinates_reach_the_surface(distance: float) -> None:
    """The size of coordinates is tiny there, and the rounding of the value is not."""
    t = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rng, n = np.random.default_rng(0), 1000
    o = distance * np.column_stack([rng.normal(size=(n, 2)), np.ones(n)])
    d = np.array([0, 0, -1.0]) + 0.3 * rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    down = d[:, 2] < -0.2
    circle = hk.SolidAngle(np.column_stack([np.cos(t), np.sin(t), 0 * t]))
    hits = hk.trace(circle, o[down], d[down], tolerance=1e-6, precision="single")
    assert hits.is_hit.all()
    assert (hits.evaluations < 50).all()
