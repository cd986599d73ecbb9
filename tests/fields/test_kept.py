"""Fields are uploaded once for each backend, and framed once for all cameras."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Callable
from typing import Any, cast

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import Backend, choose_backend, to_vector3
from harnack.fields.evaluator import POINTS
from harnack.geometry.example_meshes import icosphere
from harnack.rendering import Camera, register

register()
VERTICES, FACES = icosphere(1)
FIELDS: dict[str, Callable[[], hk.Field]] = {
    "curve": lambda: hk.SolidAngle([[1, 0, 0], [0, 1, 0], [-1, 0, 0.3], [0, -1, 0]]),
    "mesh": lambda: hk.WindingNumber(VERTICES, FACES[5:]),
    "tree": lambda: hk.WindingNumber(VERTICES, FACES[5:], method="tree"),
    "cloud": lambda: hk.DipolePotential(VERTICES, VERTICES),
    "screened": lambda: hk.fields.ScreenedWindingNumber(VERTICES, VERTICES, length=1.0),
}


def uploaded(field: hk.Field, backend: Backend) -> Any:
    """The data of a field on a backend."""
    return cast("Any", field.evaluator(backend)).data


@pytest.mark.parametrize("name", FIELDS)
def test_a_field_is_uploaded_once_to_each_backend(name: str) -> None:
    field = FIELDS[name]()
    for backend in (choose_backend(), choose_backend("double")):
        data = uploaded(field, backend)
        assert uploaded(field, backend) is data
    assert uploaded(field, choose_backend()) is not data


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=() if one == "curve" else pytest.mark.slow) for one in FIELDS],
)
def test_what_is_kept_goes_with_the_field(name: str) -> None:
    field = FIELDS[name]()
    hk.render(field, show="status", size=(8, 6), progress=False)
    gone = weakref.ref(field), weakref.ref(uploaded(field, choose_backend()))
    del field
    gc.collect()
    assert [one() for one in gone] == [None, None]


def test_a_field_with_an_attribute_set_is_uploaded_again() -> None:
    class Shifted(hk.SolidAngle):
        shift = 0.0

        def evaluate(self, p: Any) -> hk.fields.Sample:
            sample = super().evaluate(p)
            return hk.fields.Sample(
                sample.value + self.shift, sample.gradient, sample.promises, sample.value_error
            )

    field = Shifted([[1, 0, 0], [0, 1, 0], [-1, 0, 0.3], [0, -1, 0]])
    rays = [[0.0, 0, 3]], [[0.0, 0.1, -1]]
    before = hk.trace(field, *rays).t
    field.shift = -0.1
    assert 0.01 < abs(hk.trace(field, *rays).t - before) < 0.1


@dataclasses.dataclass
class Ball(hk.Field):
    """Anyone's field: a dataclass, which has no hash, and which changes in place."""

    radius: float
    domain = hk.Ball(radius=2)

    def evaluate(self, p: Any) -> hk.fields.Sample:
        return hk.fields.Sample(
            dr.norm(p) - self.radius, p / dr.norm(p), (hk.proofs.Lipschitz(1.0),)
        )

    def evaluator(self, backend: Backend, plan: hk.fields.Plan = POINTS) -> hk.fields.Evaluator:
        del plan
        radius: Any = dr.opaque(backend.Float, float(self.radius))
        return hk.fields.SampleEvaluator(Ball(radius), backend)


def test_fields_of_anyone_are_drawn_as_they_are_now() -> None:
    field = Ball(0.5)
    drawn = {"show": "depth", "size": (9, 9), "progress": False}
    for radius in (0.5, 1.0, 1.0):
        field.radius = radius
        again = hk.render(field, **drawn)
        np.testing.assert_array_equal(again, hk.render(Ball(radius), **drawn))


def test_vertices_with_derivatives_are_uploaded_each_time() -> None:
    backend = choose_backend()
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0.3], [0, -1, 0]])
    field = hk.SolidAngle(to_vector3(backend, corners))
    assert uploaded(field, backend) is not uploaded(field, backend)


@pytest.mark.slow
def test_a_picture_from_another_side_finds_the_surface_no_more() -> None:
    def picture(field: hk.Field, **settings: Any) -> tuple[np.ndarray, int]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            image = hk.render(
                field, show="depth", size=(16, 12), camera=Camera(azimuth=20), progress=False,
                **settings,
            )  # fmt: skip
            return image, len(dr.kernel_history((dr.KernelType.JIT,)))

    field = FIELDS["curve"]()
    hk.render(field, show="depth", size=(16, 12), progress=False)
    again, few = picture(field)
    new, many = picture(FIELDS["curve"]())
    np.testing.assert_array_equal(again, new)
    assert few < 0.7 * many
    # With other settings it is found anew.
    ball = hk.Ball((0.5, 0, 0), 0.6)
    np.testing.assert_array_equal(
        picture(field, clip=ball)[0], picture(FIELDS["curve"](), clip=ball)[0]
    )
