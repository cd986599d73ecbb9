"""Numbers that a caller gives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest

import harnack as hk
from harnack.backend.validation import (
    as_finite,
    as_integer_in_range,
    as_positive,
    as_real,
    as_triple,
    flag,
    integer,
)


@pytest.mark.parametrize("check", [as_real, as_finite, as_positive])
def test_numbers_are_floats(check: Callable[[Any, str], float]) -> None:
    for given in (2, 2.0, np.float32(2), np.int64(2), np.array(2.0)):
        assert (check(given, "it"), type(check(given, "it"))) == (2.0, float)
    for given in (True, "2", b"2", None, 2j, [2.0]):
        with pytest.raises(TypeError, match="it must be a number, not"):
            check(given, "it")


def test_numbers_out_of_range() -> None:
    for given in (math.nan, math.inf, -math.inf):
        assert str(as_real(given, "it")) == str(given)
        with pytest.raises(ValueError, match="it must be finite"):
            as_finite(given, "it")
    for given in (0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="it must be positive and finite"):
            as_positive(given, "it")
    with pytest.raises(ValueError, match=r"it must be an integer from 0 to 2\^32 - 1"):
        as_integer_in_range(1.5, "it", 0, 2**32 - 1)
    for wrong in (3, (1, 2), (1, 2, "3"), (1, 2, math.inf)):
        with pytest.raises((TypeError, ValueError), match="it must be"):
            as_triple(wrong, "it")


def test_flags_and_whole_numbers() -> None:
    assert flag(True, "it") is flag(np.True_, "it") is True
    assert flag(np.False_, "it") is False
    assert (integer(np.int64(3), "it"), integer(-(2**70), "it")) == (3, -(2**70))
    for original in (1, "yes", None, [], np.ones(2)):
        with pytest.raises(TypeError, match="it must be True or False, not"):
            flag(original, "it")
    for original in (1.0, "1", None, True, np.ones(2), {}):
        with pytest.raises(TypeError, match="it must be a whole number, not"):
            integer(original, "it")


SPHERE, ROW = hk.Sphere(1.0), np.linspace(1, 6, 5)
TRIANGLE = ([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]], [[0, 1, 2]])
# Each was answered by an error of Python's own that named no argument, or by none.
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "level of a mesh": (lambda: hk.mesh(SPHERE, level="abc"), "^level must be a number"),
    "row as level of a mesh": (lambda: hk.mesh(SPHERE, level=ROW), "^there are 5 levels .*of one"),
    "seed": (lambda: hk.mesh(SPHERE, seed=None), "^seed must be an integer"),
    "simplify": (lambda: hk.mesh(SPHERE, simplify=ROW), "^simplify must be True or False"),
    "side": (lambda: hk.mesh(SPHERE, side=[]), '^side must be one of "surface", "below"'),
    "progress": (lambda: hk.mesh(SPHERE, progress=None), "^progress must be True, False or a func"),
    "progress of a distance": (
        lambda: hk.distance.closest_points(SPHERE, [[2, 0, 0]], progress=1.0),
        "^progress must be True, False or a func",
    ),
    "method": (lambda: hk.signed_distance(SPHERE, [[2, 0, 0]], method=ROW), "^unknown method"),
    "precision": (lambda: hk.trace(SPHERE, [[2, 0, 0]], [[1, 0, 0]], precision=ROW), "^precision"),
    "no field for lines": (
        lambda: hk.distance.curvature_lines(None, [[1, 0, 0]], step=0.1, length=1),
        "harnack field is needed",
    ),
    "level of lines": (
        lambda: hk.distance.curvature_lines(SPHERE, [[1, 0, 0]], step=0.1, length=1, level="a"),
        "^level must be a number",
    ),
    "clip of lines": (
        lambda: hk.distance.curvature_lines(SPHERE, [[1, 0, 0]], step=0.1, length=1, clip=SPHERE),
        "^clip must be a volume",
    ),
    "no field to check": (lambda: hk.testing.check_field(None), "harnack field is needed"),
    "a class to check": (lambda: hk.testing.check_field(hk.Sphere), "the class Sphere itself"),
    "points to check": (lambda: hk.testing.check_field(SPHERE, "abc"), "^points must"),
    "count to check": (
        lambda: hk.testing.check_field(SPHERE, count=0),
        "^count must be an integer",
    ),
    "field of a surface": (lambda: hk.Surface(None), "harnack field is needed"),
    "levels of a surface": (lambda: hk.Surface(SPHERE, "abc"), "^level must be a number, or sev"),
    "tolerance of options": (lambda: hk.TraceOptions(tolerance=ROW), "^tolerance must be a length"),
    "tolerance of a surface": (
        lambda: cast("Any", hk.Surface)(SPHERE, tolerance=1e-3),
        "Surface has no argument 'tolerance'; there are field, level",
    ),
    "a surface for a field": (
        lambda: hk.testing.check_field(hk.Surface(SPHERE)),
        "take its .field, and what ",
    ),
    "level of a formula": (lambda: hk.expression("x", level=None), "^level must be a number"),
    "flag of a formula": (lambda: hk.expression("x", is_convex="no"), "^is_convex must be True or"),
    "parameters": (lambda: hk.expression("x", parameters="a"), "^parameters are numbers by name"),
    "accuracy": (lambda: hk.WindingNumber(*TRIANGLE, accuracy="a"), "^accuracy must be a number"),
    "order": (lambda: hk.WindingNumber(*TRIANGLE, order=ROW), "^order must be an integer"),
    "points of a cloud": (lambda: hk.DipolePotential(None, [[0, 0, 1]]), "points"),
    "spacing": (
        lambda: hk.fields.Morph(TRIANGLE, TRIANGLE, gap=1.0, w=0.5, spacing="a"),
        "^spacing must be a num",
    ),
    "starts": (lambda: hk.Tube(TRIANGLE[0], 0.1, starts=3), "^starts must be indices"),
    "flattening_error": (
        lambda: hk.Tube(TRIANGLE[0], 0.1, flattening_error=None),
        "^flattening_error must be a num",
    ),
    "fade": (lambda: hk.solids.Noise(fade={}), "^the fade must be"),
    "domain of points": (
        lambda: hk.fields.HRBF([[1, 0, 0]], [[1, 0, 0]], domain=SPHERE),
        "^domain must be a volume",
    ),
    "domain over the plane": (
        lambda: hk.fields.HeightField(lambda x, y: x, domain="box"),
        "^domain must be a volume",
    ),
    "amplitude": (
        lambda: hk.fields.PlaneWave("a", (1, 0, 0)),
        "^the amplitude of a plane wave must",
    ),
    "wave vector": (
        lambda: hk.fields.PlaneWave(1.0, 3.0),
        "^the wave vector must be three numbers",
    ),
    "factor": (
        lambda: hk.fields.WaveProduct(1.0, x=2.0),
        "^x of a product is made by sine or cosine",
    ),
    "frequency": (
        lambda: hk.fields.sine_factor(None),
        "^the frequency of a factor must be a number",
    ),
    "radius of a branch point": (
        lambda: hk.fields.BranchPoint(0, radius="a"),
        "^the radius of a branch ",
    ),
    "order of an harmonic": (
        lambda: hk.fields.HypersphericalHarmonic(2, 1, 0.5),
        "^the order m must be a",
    ),
    "order of a lobe": (lambda: hk.fields.Lobes(2, {}), "^m must be a whole number"),
    "support": (lambda: hk.kernels.CompactKernel(ROW), "^support must be a number"),
    "parts": (
        lambda: hk.geometry.VolumeIntersection([None]),
        "^each part of an intersection must be a volume",
    ),
    "end of a slider": (lambda: hk.Slider(None, 1.0), "^low must be a number"),
    "twice a field": (lambda: 2 * SPHERE, "a Sphere is a set of points: solids are combined"),
    "a field less than": (lambda: hk.Gyroid() < 0, "is a function of space"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_refused_by_name(name: str) -> None:
    call, message = WRONG[name]
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_levels_in_a_row_of_numpy() -> None:
    assert hk.Surface(SPHERE, ROW).levels == tuple(ROW)
    with pytest.raises(ValueError, match="at least one"):
        hk.Surface(SPHERE, np.zeros(0))
    with pytest.raises(TypeError, match="level must be a number, or several"):
        hk.Surface(SPHERE, np.eye(2))


@pytest.mark.parametrize("make", [
    lambda x: hk.Sphere(x), lambda x: hk.Ball(radius=x), lambda x: hk.tracer.HitTolerance(x),
    lambda x: hk.Sphere(1.0).offset(x),
])  # fmt: skip
def test_what_is_no_number_is_a_type_error(make: Callable[[Any], Any]) -> None:
    for given in ("1", None, 1j):
        with pytest.raises(TypeError, match="must be a number"):
            make(given)
