"""What a call of the library asks a field for: its data on a backend, extent and cells, once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk


class _Ball(hk.Field):
    """A ball of radius 1 that counts what it is asked for."""

    domain = hk.Ball(radius=1.5)

    def __init__(self) -> None:
        self.asked: Counter[Any] = Counter()

    def evaluator(self, backend: Any, plan: Any = None) -> hk.fields.Evaluator:
        self.asked["evaluator", backend] += 1
        return hk.fields.SampleEvaluator(self, backend)

    def extent(self, levels: tuple[float, ...]) -> Any:
        self.asked["extent", levels] += 1
        return hk.Ball(radius=1.2)

    def occupied(self, levels: tuple[float, ...]) -> Any:
        self.asked["occupied", levels] += 1

    def evaluate(self, p: Any) -> hk.fields.Sample:
        r = dr.norm(p)
        return hk.fields.Sample(r - 1, p / r, (hk.proofs.Lipschitz(1.0),))

    def hessian(self, p: Any) -> Any:
        r = dr.norm(p)
        n = p / r
        return tuple(
            type(p)(*((float(i == j) - n[i] * n[j]) / r for j in range(3))) for i in range(3)
        )


_POINTS = np.array([[2.0, 0.1, 0.2], [0.1, 1.7, 0.4], [0.3, 0.2, 1.1]])
_PICTURE = {"size": (16, 12), "progress": False}
_VERBS: dict[str, Callable[[Any], Any]] = {
    "trace": lambda f: hk.trace(f, _POINTS, -_POINTS),
    "crossings": lambda f: hk.crossings(f, _POINTS, -_POINTS, max_crossings=3),
    "shaded picture": lambda f: hk.render(f, show="shaded", **_PICTURE),
    "cones of pixels": lambda f: hk.render(f, show="shaded", antialias="cones", **_PICTURE),
    "traced light": lambda f: hk.render(f, spp=2, **_PICTURE),
    "picture of a solid": lambda f: hk.render(
        f, level=0, side="below", section=hk.HalfSpace((1, 0, 0), 0), show="shaded", **_PICTURE
    ),
    "mesh": lambda f: hk.mesh(f, cell_size=0.4, tolerance=0.02),
    "thick mesh": lambda f: hk.mesh(f, cell_size=0.4, tolerance=0.02, thickness=0.1),
    "mesh of a solid": lambda f: hk.mesh(
        f, level=(-0.3, 0), side="between", cell_size=0.4, tolerance=0.02
    ),
    "signed distance": lambda f: hk.signed_distance(f, 0.6 * _POINTS),
    "distance, first order": lambda f: hk.signed_distance(f, 0.6 * _POINTS, method="first_order"),
    "distance bounds": lambda f: hk.distance.distance_bounds(f, 0.6 * _POINTS),
    "closest points": lambda f: hk.distance.closest_points(f, 0.6 * _POINTS),
    "curvature": lambda f: hk.curvature(f, 0.6 * _POINTS),
    "curvature lines": lambda f: hk.distance.curvature_lines(
        f, 0.5 * _POINTS[:1], step=0.1, length=0.5
    ),
    "value": lambda f: f.value(_POINTS),
}


@pytest.mark.parametrize("verb", _VERBS)
def test_a_field_is_asked_once(verb: str) -> None:
    field = _Ball()
    _VERBS[verb](field)
    assert field.asked
    most = 2 if verb == "mesh of a solid" else 1  # as a whole, and as a part
    assert {what: count for what, count in field.asked.items() if count > most} == {}


def test_a_field_changed_in_place_is_asked_again() -> None:
    field = _Ball()
    surface = hk.Surface(field)
    for count in (1, 2):
        hk.render(surface, show="depth", **_PICTURE)
        assert field.asked["extent", (0.0,)] == count
