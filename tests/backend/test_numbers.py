"""Numbers that a caller gives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend.numbers import finite, positive, real, triple, whole


@pytest.mark.parametrize("check", [real, finite, positive])
def test_numbers_are_floats(check: Callable[[Any, str], float]) -> None:
    for given in (2, 2.0, np.float32(2), np.int64(2), np.array(2.0)):
        assert (check(given, "it"), type(check(given, "it"))) == (2.0, float)
    for given in (True, "2", b"2", None, 2j, [2.0]):
        with pytest.raises(TypeError, match="it must be a number, not"):
            check(given, "it")


def test_numbers_out_of_range() -> None:
    for given in (math.nan, math.inf, -math.inf):
        assert str(real(given, "it")) == str(given)
        with pytest.raises(ValueError, match="it must be finite"):
            finite(given, "it")
    for given in (0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="it must be positive and finite"):
            positive(given, "it")
    with pytest.raises(ValueError, match=r"it must be an integer from 0 to 2\^32 - 1"):
        whole(1.5, "it", 0, 2**32 - 1)
    for wrong in (3, (1, 2), (1, 2, "3"), (1, 2, math.inf)):
        with pytest.raises((TypeError, ValueError), match="it must be"):
            triple(wrong, "it")


@pytest.mark.parametrize("make", [
    lambda x: hk.Sphere(x), lambda x: hk.Ball(radius=x), lambda x: hk.Tolerance(x),
    lambda x: hk.Sphere(1.0).grown(x),
])  # fmt: skip
def test_what_is_no_number_is_a_type_error(make: Callable[[Any], Any]) -> None:
    for given in ("1", None, 1j):
        with pytest.raises(TypeError, match="must be a number"):
            make(given)
