"""Jumps of users' fields: `check_field` passes right ones, and says what is wrong of each other."""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import Backend
from harnack.fields import (
    NO_FACET,
    EvaluateOnly,
    Evaluator,
    Field,
    JumpCrossing,
    Jumps,
    Plan,
    Sample,
    SampleEvaluator,
)
from harnack.fields.evaluator import POINTS
from harnack.proofs import Lipschitz
from harnack.testing import BrokenPromiseError, check_field

HEIGHT = 0.4


class Shell(Field):
    """|p| - 1 + offset, with a given Lipschitz constant."""

    def __init__(self, offset: Any, constant: float = 1.0) -> None:
        self.offset, self.constant = offset, constant

    def evaluate(self, p: Any) -> Sample:
        r = dr.norm(p)
        gradient = p / dr.maximum(r, 1e-20)
        return Sample(r - 1 + self.offset, gradient, (Lipschitz(self.constant),))


class Plane(Jumps):
    """The plane x = 0, at which f grows by `HEIGHT`."""

    def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> JumpCrossing:
        t, index = -o.x / d.x, dr.uint32_array_t(o.x)
        is_met = active & (d.x != 0) & (t > after.t) & (t <= t_max)
        return JumpCrossing(
            dr.select(is_met, t, dr.inf),
            dr.select(is_met, index(0), index(NO_FACET)),
            dr.select(is_met, dr.copysign(type(t)(HEIGHT), d.x), 0),
            type(o)(1, 0, 0),
        )

    def initial_offset(self, o: Any, d: Any, t_min: Any, active: Any) -> Any:
        x = o.x + t_min * d.x
        return dr.select((x > 0) | ((x == 0) & (d.x > 0)), type(x)(HEIGHT), 0)

    def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
        return EvaluateOnly(Shell(offset).evaluate)


class Step(Field):
    """|p| - 1, and `HEIGHT` more where x > 0."""

    domain = hk.Ball(radius=2.0)
    traits = hk.fields.Traits(has_jumps=True)

    def __init__(self, plane: Jumps) -> None:
        self.plane = plane

    def evaluate(self, p: Any) -> Sample:
        return Shell(dr.select(p.x > 0, type(p.x)(HEIGHT), 0)).evaluate(p)

    def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
        return SampleEvaluator(self, backend, jumps=self.plane)


class NoOffset(Jumps):
    next_crossing = Plane.next_crossing
    continuation = Plane.continuation


class TooMuch(Plane):
    def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
        return EvaluateOnly(Shell(offset + 0.3).evaluate)


class TooFlat(Plane):
    def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
        return EvaluateOnly(Shell(offset, 0.2).evaluate)


class Single(Plane):
    def initial_offset(self, o: Any, d: Any, t_min: Any, active: Any) -> Any:
        return dr.select(o.x + t_min * d.x > 0, HEIGHT, 0.0)


class Changed(Plane):
    """The right crossing with some numbers exchanged."""

    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        raise NotImplementedError

    def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> JumpCrossing:
        crossing = super().next_crossing(o, d, after, t_max, active)
        return dataclasses.replace(crossing, **self.change(crossing, after))


class OtherSide(Changed):
    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        return {"normal": -crossing.normal}


class LongNormal(Changed):
    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        return {"normal": 2 * crossing.normal}


class TooHigh(Changed):
    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        return {"jump": 1.5 * crossing.jump}


class Wandering(Changed):
    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        return {"t": crossing.t * dr.select(after.t > 0.3, type(after.t)(1 + 1e-7), 1)}


class NotANumber(Changed):
    def change(self, crossing: JumpCrossing, after: JumpCrossing) -> dict[str, Any]:
        return {"jump": crossing.jump * dr.nan}


class Repeated(Plane):
    def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> JumpCrossing:
        before = dataclasses.replace(after, t=after.t - 1e9)
        return super().next_crossing(o, d, before, t_max, active)


class Unseen(Plane):
    def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> JumpCrossing:
        return super().next_crossing(o, d, after, t_max, active & False)


class WithDistance(Plane):
    factor = 1.0

    def distance(self, p: Any) -> Any:
        return self.factor * dr.abs(p.x) * (1 - 4 * dr.epsilon(type(p.x)))


class TooFar(WithDistance):
    factor = 1.5


def test_right_jumps_pass() -> None:
    check_field(Step(Plane()), count=100, directions=2)
    check_field(Step(WithDistance()), count=100, directions=2)


@pytest.mark.parametrize(
    ("plane", "message"),
    [
        (NoOffset, r"NoOffset.continuation is not f in front of .* or initial_offset \(by"),
        (TooMuch, "TooMuch.continuation is not f in front of the first crossing"),
        (TooFlat, "TooFlat.continuation: f leaves what Lipschitz promises"),
        (Single, r"or initial_offset \(in single precision it would be: dr.select of two Python"),
        (OtherSide, "OtherSide.next_crossing: the normal is not on the side where f is larger"),
        (LongNormal, "LongNormal.next_crossing: the normal does not have the length 1"),
        (TooHigh, r"TooHigh.continuation is not f behind a crossing: .* the jump there \(by"),
        (Wandering, "t, facet or jump depend on where the search begins"),
        (NotANumber, "NotANumber.next_crossing: t, facet and jump must be a number"),
        (Repeated, "Repeated.next_crossing: the crossing is not after the crossing `after`"),
        (Unseen, "Unseen.continuation is not f in front of the first crossing"),
        (TooFar, "TooFar.distance is longer than a way to a facet"),
    ],
)
def test_wrong_jumps_are_found(plane: type[Jumps], message: str) -> None:
    """Most of them were not, although `trace` missed hits."""
    with pytest.raises(BrokenPromiseError, match=message):
        check_field(Step(plane()))


def test_traits_that_say_other_than_the_evaluator_are_refused() -> None:
    """`check_field` raised an AssertionError without a text."""

    class NoJumps(Step):
        def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
            return SampleEvaluator(self, backend)

    for use in (check_field, lambda field: hk.trace(field, [[0.0, 0, 3]], [[0.0, 0, -1]])):
        with pytest.raises(TypeError, match=r"traits of NoJumps say has_jumps=True, and its eval"):
            use(NoJumps(Plane()))


def test_a_smooth_part_beside_a_facet_is_nearest() -> None:
    """The facet's point was taken, 0.053 away, and the sphere is 0.0097 away."""

    class Steps(Field):
        """|p| - 1, and 0.25 more for x > -0.3."""

        domain = hk.Ball(radius=2.0)
        traits = hk.fields.Traits(has_jumps=True)

        def evaluate(self, p: Any) -> Sample:
            return Shell(dr.select(p.x > -0.3, type(p.x)(0.25), 0)).evaluate(p)

        def evaluator(self, backend: Backend, plan: Plan = POINTS) -> Evaluator:
            return SampleEvaluator(self, backend, jumps=AtX())

    class AtX(Jumps):
        def next_crossing(
            self, o: Any, d: Any, after: Any, t_max: Any, active: Any
        ) -> JumpCrossing:
            t, index = (-0.3 - o.x) / d.x, dr.uint32_array_t(o.x)
            is_met = active & (d.x != 0) & (t > after.t) & (t <= t_max)
            return JumpCrossing(
                dr.select(is_met, t, dr.inf),
                dr.select(is_met, index(0), index(NO_FACET)),
                dr.select(is_met, dr.copysign(type(t)(0.25), d.x), 0),
                type(o)(1, 0, 0),
            )

        def initial_offset(self, o: Any, d: Any, t_min: Any, active: Any) -> Any:
            x = o.x + t_min * d.x
            is_beyond = (x > -0.3) | ((x == -0.3) & (d.x > 0))
            return dr.select(is_beyond, type(x)(0.25), 0)

        def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
            return EvaluateOnly(Shell(offset).evaluate)

        def distance(self, p: Any) -> Any:
            return dr.abs(p.x + 0.3) * (1 - 4 * dr.epsilon(type(p.x)))

    x = np.array([[-0.35266, -0.40087, 0.83405]])
    assert hk.signed_distance(Steps(), x) == pytest.approx(np.linalg.norm(x) - 1, abs=1e-9)


def test_other_types_are_refused_by_name() -> None:
    """A number as the continuation: 'int' object has no attribute 'variable_accuracy'."""

    class NoEvaluator(Plane):
        def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
            return 3

    class NoSamples(Plane):
        def continuation(self, o: Any, d: Any, behind: Any, ahead: Any, offset: Any) -> Any:
            return Shell(offset)

    class NoCrossing(Plane):
        def next_crossing(self, o: Any, d: Any, after: Any, t_max: Any, active: Any) -> Any:
            return 1.0

    for plane, message in (
        (NoEvaluator(), "NoEvaluator.continuation returned an object of type int: return a har"),
        (NoSamples(), "object of type Shell, a field, which describes f: return what samples f"),
        (NoCrossing(), "NoCrossing.next_crossing returned an object of type float: return har"),
    ):
        with pytest.raises(TypeError, match=message):
            check_field(Step(plane))
        with pytest.raises(TypeError, match=message):
            hk.trace(Step(plane), [[0.0, 0, 3]], [[0.0, 0, -1]])
