"""The ranges of blends of jets contain what is computed from formulas."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from harnack.arithmetic import Interval, Jet, blend_intersection, blend_union
from harnack.backend import choose_backend

_COUNT, _RADIUS = 4000, 0.7


def quadratics() -> tuple[Any, Any]:
    """Coefficients (3, n) of two families of quadratics, many of them near the radius."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3, _COUNT)) * np.array([1.0, 1.5, 2.0])[:, None]
    a[0, ::3] = _RADIUS + 0.01 * rng.normal(size=len(a[0, ::3]))
    b[0, ::2] = _RADIUS + 0.01 * rng.normal(size=len(b[0, ::2]))
    a[:, :50] = b[:, :50]
    return a, b


def jet_of(coefficients: Any, length: Any, backend: Any) -> Jet:
    """The jets of quadratics c0 + c1 s + c2 s^2 on 0 <= s <= length."""
    c0, c1, c2 = (backend.Float(row) for row in coefficients)
    s = Jet(Interval(0 * c0, length), (Interval.point(1 + 0 * c0),), (Interval(0.0, 0.0),),
            Jet(Interval.point(0 * c0), (Interval.point(1 + 0 * c0),), (Interval(0.0, 0.0),),
                piece_length=0 * c0), length)  # fmt: skip
    return (s * c2 + c1) * s + c0


@pytest.mark.parametrize("blend", [blend_union, blend_intersection])
@pytest.mark.parametrize("precision", ["single", "double"])
def test_values_and_derivatives_are_within_their_ranges(blend: Any, precision: Any) -> None:
    backend = choose_backend(precision)
    a, b = quadratics()
    if blend is blend_intersection:
        a, b = -a, -b
    kind = np.float32 if precision == "single" else np.float64
    a, b, radius = a.astype(kind), b.astype(kind), float(kind(_RADIUS))
    lengths = (10.0 ** np.random.default_rng(1).uniform(-3, 0.5, _COUNT)).astype(kind)
    length = backend.Float(lengths)
    jet = blend(jet_of(a, length, backend), jet_of(b, length, backend), radius)
    ends = [np.array(backend.Float(getattr(entry, end) + 0 * length), np.float64)
            for entry in (jet.value, *jet.first_derivatives, *jet.second_derivatives)
            for end in ("lower", "upper")]  # fmt: skip
    a, b = a.astype(np.float64), b.astype(np.float64)
    sign, steps = (1.0 if blend is blend_union else -1.0), 101
    s = np.linspace(0.0, 1.0, steps)[:, None] * lengths.astype(np.float64)

    def quadratic(c: Any) -> Any:
        return sign * (c[0] + s * (c[1] + s * c[2])), sign * (c[1] + 2 * s * c[2]), sign * 2 * c[2]

    (u, du, ddu), (v, dv, ddv) = quadratic(a), quadratic(b)
    p, q = np.maximum(radius - u, 0.0), np.maximum(radius - v, 0.0)
    size = np.hypot(p, q)
    is_far = size == 0.0
    with np.errstate(all="ignore"):
        value = np.where(is_far, np.minimum(u, v), radius - size)
        slope = np.where(is_far, np.where(u < v, du, dv), (p * du + q * dv) / size)
        bend = np.where((p > 0) & (q > 0), (p * dv - q * du) ** 2 / size**3, 0.0)
        curved = np.where(is_far, np.where(u < v, ddu, ddv), (p * ddu + q * ddv) / size - bend)
    for k, exact in enumerate((value, slope, curved)):
        low, high = ends[2 * k], ends[2 * k + 1]
        slack = (
            1e-12 * (1.0 + np.abs(exact)) * np.where(size > 1e-9, 1.0 / np.clip(size, 1e-9, 1), 1)
        )
        assert (sign * exact >= low - slack).all(), k
        assert (sign * exact <= high + slack).all(), k


def test_where_one_part_is_far_the_blend_is_the_other() -> None:
    backend = choose_backend("double")
    x, y, z = Jet.at_point(backend.Array3f(0.1, 0.2, 5.0))
    jet = blend_union(x * y, z, 0.3)
    plain = x * y
    for range_of_blend, exact in zip(
        (jet.value, *jet.first_derivatives, *jet.second_derivatives),
        (plain.value, *plain.first_derivatives, *plain.second_derivatives),
        strict=True,
    ):
        assert dr.slice(range_of_blend.lower + 0 * x.value.lower) == pytest.approx(
            dr.slice(exact.lower + 0 * x.value.lower), abs=1e-12
        )
        assert dr.slice(range_of_blend.upper - range_of_blend.lower + 0 * x.value.lower) < 1e-12
