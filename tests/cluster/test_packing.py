"""What is sent of an object, and its name."""

from __future__ import annotations

import pickle
from functools import cached_property
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cluster.packing import Packed, Remembered, name_of
from harnack.gallery import SCENES
from harnack.geometry import shapes

POINTS = np.random.default_rng(0).normal(size=(20, 3))


class Counted:
    """Something that remembers what it computes."""

    def __init__(self, number: Any) -> None:
        self.number = number
        self.kept: Remembered[str, int] = Remembered()

    @cached_property
    def twice(self) -> Any:
        return 2 * self.number


def test_what_was_computed_is_not_sent_and_changes_no_name() -> None:
    one = Counted(3)
    before = Packed.of(one, "test")
    assert one.twice == 6
    one.kept["a"] = 1
    after = Packed.of(one, "test")
    assert after == before
    there = after.open()
    assert "twice" not in vars(there)
    assert there.kept == {}
    assert there.twice == 6
    assert after.open() is there


def test_names_tell_objects_apart() -> None:
    names = {name_of(one, "test") for one in (1, 1.0, "1", [1], (1,), None, True, Counted(1))}
    assert len(names) == 8
    assert name_of(Counted(np.zeros(3)), "test") != name_of(
        Counted(np.zeros(3, np.float32)), "test"
    )


def test_names_do_not_depend_on_which_equal_objects_are_the_same() -> None:
    array = np.arange(3.0)
    assert name_of([array, array], "test") == name_of([array, array.copy()], "test")


@pytest.mark.parametrize("name", ["trefoil", "cloud", "soup", "helix", "letters", "gyroid", "lava"])
def test_surfaces_keep_their_names_when_they_are_used(name: str) -> None:
    fresh, used = SCENES[name].surfaces(), SCENES[name].surfaces()
    for one in used:
        hk.trace(one, POINTS * 3, -POINTS)
    packed = Packed.of(fresh, "test")
    assert Packed.of(used, "test") == packed
    for one, other in zip(packed.open(), fresh, strict=True):
        np.testing.assert_array_equal(one.field.value(POINTS), other.field.value(POINTS))


def test_functions_of_formulas_are_sent_by_name() -> None:
    for one in (hk.exp, hk.sin, hk.absolute if hasattr(hk, "absolute") else hk.cos):
        assert pickle.loads(pickle.dumps(one)) is one


def test_functions_that_name_modules_are_sent() -> None:
    there = Packed.of(lambda r: hk.Sphere(r).value(np.zeros((1, 3))), "test").open()
    assert there(2.0) == -2


def test_what_cannot_be_sent_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"^client: it cannot be sent.*generator"):
        Packed.of((k for k in range(3)), "client")


def test_moved_clouds_take_their_tree_with_them() -> None:
    """The shape of a tree decides about the last bits."""
    cloud = SCENES["cloud"].surfaces()[0].field
    assert isinstance(cloud, hk.DipolePotential)
    cloud.value(POINTS)
    moved = cloud.moved(cloud.points * [1, 1, 3], cloud.normals, cloud.areas)
    there = Packed.of(moved, "test").open()
    np.testing.assert_array_equal(moved.value(POINTS), there.value(POINTS))


def test_curves_are_small() -> None:
    assert len(Packed.of(hk.SolidAngle(shapes.wavy_polygon(24)), "test").data) < 3000
