"""Rounding of long sums and products: bounds that grow with the number of terms, and are needed."""

from __future__ import annotations

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend
from harnack.fmm.edge_lift import FACTOR_ROUNDINGS, LiftedProduct
from harnack.fmm.source_sums import SourceSums, SourceTerm

UNIT = 2.0**-24  # the largest relative error of one operation


def test_rounding_of_a_product_grows_with_its_factors() -> None:
    """Factors that turn by less than half a rounding are lost one by one, all in the same way: a
    bound that grew like the square root of their number would be 30 times too small here."""
    count, backend = 4000, choose_backend("single")
    start, turn = (a.ravel() for a in np.meshgrid(np.linspace(-3, 3, 61), [2.9e-8, 1e-7, 2e-7]))
    re, im, turn = (a.astype(np.float32) for a in (np.cos(start), np.sin(start), turn))
    product = LiftedProduct(*(backend.Float(a) for a in (re, im, 0 * re)))
    one, small = backend.Float(1), backend.Float(turn)
    for k in range(count):
        product = product.times(one, small)
        if k % 20 == 0:
            dr.eval(*product.to_state())
    exact = np.arctan2(im.astype(float), re.astype(float)) + count * np.arctan(turn.astype(float))
    error = np.abs(product.angle().numpy() - 2 * exact).max()
    bound = FACTOR_ROUNDINGS * UNIT * count
    assert 0.05 * bound < error <= bound
    assert error > 20 * UNIT * (16 + np.sqrt(count))


def test_terms_that_are_lost_in_a_sum_are_found_again() -> None:
    """Each is less than a rounding of the sum, so that the total alone would stay where it was."""
    backend = choose_backend("single")
    sums = SourceSums.zero(backend, dr.inf, 0).add_term(SourceTerm(backend.Float(1)), True)
    for _ in range(200):
        sums = sums.add_term(SourceTerm(backend.Float(0.99 * UNIT)), True)
        sums = sums.add_term(SourceTerm(backend.Float(0)), True).add_term(
            SourceTerm(backend.Float(5)), False
        )
    bound = float(sums.rounding[0]) + UNIT
    assert abs(float(sums.value[0]) - (1 + 200 * 0.99 * UNIT)) <= 2 * UNIT
    assert abs(float(sums.total[0]) - (1 + 200 * 0.99 * UNIT)) > 2 * bound
    back = sums.add_term(SourceTerm(backend.Float(-1)), True)
    assert abs(float(back.value[0]) / (200 * 0.99 * UNIT) - 1) < 1e-5


def test_the_value_of_a_long_sum_is_within_its_bound() -> None:
    """3,000 terms of both signs and of all sizes, on 300 lanes."""
    backend, rng = choose_backend("single"), np.random.default_rng(1)
    terms = rng.normal(size=(3000, 300)) * 10.0 ** rng.uniform(-6, 1, (3000, 300))
    terms = terms.astype(np.float32)
    sums = SourceSums.zero(backend, dr.inf, 0)
    for k, row in enumerate(terms):
        sums = sums.add_term(SourceTerm(backend.Float(row)), True)
        if k % 20 == 0:
            dr.eval(sums.total, sums.compensation, sums.rounding)
    exact = terms.astype(float).sum(axis=0)
    bound = sums.rounding.numpy() + UNIT * np.abs(exact)
    assert (np.abs(sums.value.numpy() - exact) <= bound).all()
    assert (np.abs(sums.total.numpy() - exact) > UNIT * np.abs(exact)).mean() > 0.9


def test_error_of_a_curve_covers_single_precision() -> None:
    """A side of 20,000 vertices, which turns at each by less than a rounding as seen from x."""
    z = np.linspace(-1, 1, 20_000)
    side = np.column_stack([np.ones_like(z), 1.5e-3 * z, z])
    loop = np.concatenate([side, [[-1, 0.7, 1], [-1, -0.6, -1]]]).astype(np.float32)
    field = hk.SolidAngle(loop.astype(float))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (500, 3)).astype(np.float32)
    values = []
    for precision in ("single", "double"):
        backend = choose_backend(precision)
        sample = field.evaluator(backend).evaluate(backend.Array3f(points.T.astype(backend.dtype)))
        values.append((sample.value.numpy().astype(float), sample.value_error.numpy()))
    (rounded, error), (exact, _) = values
    assert (np.abs(rounded - exact) <= error).all()
    assert (np.abs(rounded - exact) > 2 * UNIT * (8 + 2 * np.sqrt(len(z)))).any()
