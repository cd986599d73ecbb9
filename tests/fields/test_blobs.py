"""Blobs: values, proved ranges and steps in both precisions, first hits, and hostile input."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.enclosures import LevelGaps, choose_enclosures, longest_free_length
from harnack.enclosures.samples import Ray
from harnack.fields.blobs.blob_sums import for_each_record, sum_along
from harnack.fields.blobs.grid import CellLists
from harnack.fields.formula_evaluator import FormulaEvaluator
from harnack.testing import check_field

KERNELS = {
    "compact": hk.kernels.CompactKernel(1.6),
    "cubic": hk.kernels.CubicKernel(2.0),
    "sextic": hk.kernels.SexticKernel(1.8),
    "gaussian": hk.kernels.GaussianKernel(1.0, 1e-2),
    "sharp": hk.kernels.GaussianKernel(5.0, 0.2),
}
PRECISIONS = ("single", "double")
SLOWLY = pytest.mark.slow
# Kernels that end and one that is cut; the others go through the same code, and are slow.
QUICK_KERNELS = [
    pytest.param(kernel, id=name, marks=() if name in ("compact", "gaussian") else SLOWLY)
    for name, kernel in KERNELS.items()
]
QUICK_PRECISIONS = ["single", pytest.param("double", marks=SLOWLY)]


def scene(count: int = 40, seed: int = 5, **settings: Any) -> hk.Blobs:
    """Random blobs in a box, those of the tables in docs for 40 and seed 5."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-4.0, 4.0, (count, 3))
    radii = rng.uniform(0.8, 1.6, count)
    return hk.Blobs(centers, radii, **settings)


@dataclass(frozen=True)
class Oracle:
    """A sum of blobs and its derivatives along lines in NumPy, in double precision, blob by blob;
    of kernels it takes nothing but their height, and differences of it."""

    blobs: hk.Blobs

    def sums(self, x: Any) -> Any:
        """(..., groups) the sums of all groups at points (..., 3)."""
        b = self.blobs
        reach = b.radii * b.kernel.support
        q = ((x[..., None, :] - b.centers) ** 2).sum(-1) / reach**2
        terms = b.weights * b.kernel.amplitude * b.kernel.height(q)
        groups = np.zeros(len(b), int) if b.groups is None else b.groups
        return np.stack([terms[..., groups == g].sum(-1) for g in np.unique(groups)], -1)

    def value(self, x: Any) -> Any:
        return self.sums(x).max(-1)


def lines(count: int, seed: int, size: float = 6.0) -> tuple[Any, Any, Any]:
    rng = np.random.default_rng(seed)
    p = rng.uniform(-size, size, (count, 3))
    d = rng.uniform(-3.5, 3.5, (count, 3)) - p
    return p, d / np.linalg.norm(d, axis=1)[:, None], rng.random(count) ** 2 * 3 * size


def rounded(backend: Any, *arrays: Any) -> list[Any]:
    return [one.astype(backend.dtype).astype(np.float64) for one in arrays]


def box_rays(blobs: hk.Blobs, count: int, seed: int = 1) -> tuple[Any, Any, Any]:
    """Rays between random points of the sides of the box around all supports."""
    rng = np.random.default_rng(seed)
    low, high = blobs.extent((1.0,)).bounds()
    size = high - low
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])

    def points() -> Any:
        axis = rng.choice(3, count, p=area / area.sum())
        side = rng.integers(0, 2, count)
        p = low + rng.random((count, 3)) * size
        p[np.arange(count), axis] = np.where(side, high[axis], low[axis])
        return p

    a, b = points(), points()
    length = np.linalg.norm(b - a, axis=1)
    keep = length > 1e-3
    return a[keep], ((b - a) / length[:, None])[keep], length[keep]


@pytest.mark.few(2)
@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_a_single_blob_is_a_ball(kernel: Any) -> None:
    blob = hk.Blobs([[1.0, 2.0, 3.0]], 0.7, kernel=kernel)
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    on = np.array([1.0, 2.0, 3.0]) + 0.7 * d
    np.testing.assert_allclose(blob.value(on, precision="double"), 1.0, rtol=1e-12)
    gradient = blob.gradient(on, precision="double")
    np.testing.assert_allclose(gradient / np.linalg.norm(gradient, axis=1)[:, None], -d, atol=1e-9)
    hits = hk.trace(blob, on - 3 * d, d, precision="double", tolerance=1e-9)
    np.testing.assert_allclose(hits.t, 3 - 1.4, atol=1e-7)


@pytest.mark.few(2)
@pytest.mark.parametrize("kernel", QUICK_KERNELS)
@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("count", [40, 90])  # 90 blobs are kept in a grid
def test_values_and_derivatives(kernel: Any, grouped: bool, count: int) -> None:
    groups = np.random.default_rng(1).integers(3, 8, count) if grouped else None
    weights = np.random.default_rng(2).uniform(-0.5, 1.5, count)
    blobs = scene(count, weights=weights, kernel=kernel, groups=groups)
    x = np.random.default_rng(3).uniform(-6, 6, (300, 3))
    np.testing.assert_allclose(
        blobs.value(x, precision="double"), Oracle(blobs).value(x), atol=1e-12
    )
    # The formula of jets is another way to the same numbers.
    backend = choose_backend("double")
    evaluator = blobs.evaluator(backend)
    p = to_vector3(backend, x)
    sample, jet = evaluator.evaluate(p), FormulaEvaluator.evaluate(evaluator, p)
    np.testing.assert_allclose(to_numpy(sample.value), to_numpy(jet.value), atol=1e-11)
    np.testing.assert_allclose(to_numpy(sample.gradient), to_numpy(jet.gradient), atol=1e-10)
    for mine, other in zip(
        evaluator.hessian(p), FormulaEvaluator.hessian(evaluator, p), strict=True
    ):
        np.testing.assert_allclose(to_numpy(mine), to_numpy(other), atol=1e-9)


@pytest.mark.few(1)
@pytest.mark.parametrize("kernel", QUICK_KERNELS)
def test_what_is_promised(kernel: Any) -> None:
    check_field(scene(12, weights=np.linspace(-1, 2, 12), kernel=kernel), count=60, directions=6)


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_single_precision_is_within_the_stated_error(kernel: Any) -> None:
    for offset in (0.0, 1e4):
        base = scene(90, weights=np.linspace(-1, 2, 90), kernel=kernel)
        blobs = hk.Blobs(base.centers + offset, base.radii, base.weights, kernel=kernel)
        single = choose_backend("single")
        (x,) = rounded(single, np.random.default_rng(3).uniform(-6, 6, (2000, 3)) + offset)
        sample = blobs.evaluator(single).evaluate(to_vector3(single, x))
        value = to_numpy(sample.value).astype(np.float64)
        error = to_numpy(sample.value_error) + 8 * 2.0**-23 * np.abs(value) + 1e-37
        assert (np.abs(value - Oracle(blobs).value(x)) <= error).all()
        assert np.median(to_numpy(sample.value_error)) < 1e-5 * kernel.steepness.value
        gradient = to_numpy(sample.gradient).astype(np.float64)
        off = np.linalg.norm(gradient - blobs.gradient(x, precision="double"), axis=1)
        assert (off <= to_numpy(sample.gradient_error)).all()


@pytest.mark.few(2)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("kernel", QUICK_KERNELS)
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_ranges_hold_and_are_attained(kernel: Any, precision: Any, offset: float) -> None:
    """First and second differences of a single blob along a line lie in its ranges, which is where
    rounding shows, and reach them."""
    rng = np.random.default_rng(7)
    backend = choose_backend(precision)
    count, radius = 150, 1.3
    center = np.array([0.3, -0.2, 0.1]) + offset
    blob = hk.Blobs(center[None], radius, -0.8, kernel=kernel)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    aside = np.cross(d, rng.normal(size=(count, 3)))
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    reach = radius * kernel.support
    # Through the middle, at random, just inside and just outside of the support.
    beside = rng.choice([0.0, 1e-5, 0.3, 0.7, 1 - 1e-6, 1.0, 1 + 1e-6, 1.2], count) * reach
    before = rng.choice([0.0, 0.5, 1.0, 3.0, 50.0], count) * reach
    p, d = rounded(backend, center + beside[:, None] * aside - before[:, None] * d, d)
    (length,) = rounded(backend, rng.random(count) * reach * 2 + before)
    knots = [0.0, *(backend.Float(part * length) for part in (0.4, 0.9, 1.0))]
    on_backend: Any = blob.evaluator(backend).blobs
    found = sum_along(
        on_backend.kernel, backend, to_vector3(backend, p), to_vector3(backend, d), knots,
        for_each_record(on_backend.records),
    )  # fmt: skip
    ends = [np.zeros(count), *(to_numpy(one).astype(np.float64) for one in knots[1:])]
    slack: list[Any] = []
    for k, part in enumerate(found.parts):
        s = ends[k][:, None] + np.linspace(0, 1, 300) * (ends[k + 1] - ends[k])[:, None]
        x = p[:, None] + s[..., None] * d[:, None]
        v = (x - center) / reach
        q, along = (v * v).sum(-1), (v * d[:, None]).sum(-1)
        speed = (d * d).sum(-1)[:, None]
        k1, k2 = derivatives(kernel, q)
        scale = -0.8 * kernel.amplitude
        first = scale / reach * 2 * along * k1
        second = scale / reach**2 * (2 * speed * k1 + 4 * along * along * k2)
        low, high, least, most = (
            to_numpy(one).astype(np.float64)[:, None]
            for one in (
                part.slope_range.lower,
                part.slope_range.upper,
                part.min_second_derivative,
                part.max_second_derivative,
            )
        )
        tiny = 1e-11 * kernel.amplitude * kernel.steepness.bend
        assert (low - first).max() <= tiny
        assert (first - high).max() <= tiny
        assert (least - second).max() <= tiny
        assert (second - most).max() <= tiny
        steep = scale_of(first), scale_of(second)
        slack += [(first.min(1) - low[:, 0]) / steep[0], (high[:, 0] - first.max(1)) / steep[0]]
        slack += [(second.min(1) - least[:, 0]) / steep[1], (most[:, 0] - second.max(1)) / steep[1]]
    # Sampling misses an extreme by the square of its spacing, and jumps altogether.
    assert np.quantile(slack, 0.8) < (1e-2 if precision == "single" else 1e-5)


def scale_of(sampled: Any) -> float:
    return float(np.abs(sampled).max())


def derivatives(kernel: Any, q: Any) -> tuple[Any, Any]:
    """The first two derivatives of a kernel in q, from its formula in mind and not its code."""
    inside = q < 1
    w = np.where(inside, 1 - q, 0)
    if kernel.name == "compact":
        return -3 * w**2, 6 * w
    if kernel.name == "sextic":
        return np.where(inside, (-22 + 34 * q - 12 * q * q) / 9, 0), np.where(
            inside, (34 - 24 * q) / 9, 0
        )
    if kernel.name == "cubic":
        r = np.sqrt(q)
        return np.where(inside, -3 + 3 * r, 0), np.where(inside, 1.5 / np.maximum(r, 1e-300), 0)
    rate = kernel.sharpness * kernel.support**2
    e = np.exp(rate * w)
    return np.where(inside, -rate * (e - 1), 0), np.where(inside, rate * rate * e, 0)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "enclosures",
    [
        "pieces",
        *(
            pytest.param(one, marks=SLOWLY)
            for one in ("quadratic-taylor", "linear-taylor", "segment")
        ),
    ],
)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("count", [40, 90])
def test_steps_are_free_and_no_longer(
    enclosures: Any, precision: Any, grouped: bool, count: int
) -> None:
    """F stays within the gaps for the step proved, and some step is the longest possible."""
    backend = choose_backend(precision)
    groups = np.arange(count) % 5 if grouped else None
    blobs = scene(count, weights=np.linspace(1.5, -0.3, count), groups=groups)
    p, d, length = lines(250, 11)
    p, d, length = rounded(backend, p, d, length)
    path = Ray(to_vector3(backend, p), to_vector3(backend, d), choose_enclosures(enclosures))
    look = blobs.evaluator(backend).sample_ray(path, backend.Float(0), backend.Float(length), 0.0)
    value = to_numpy(look.sample.value).astype(np.float64)
    rng = np.random.default_rng(1)
    size = 10 ** rng.uniform(-4, 0.5, len(p))
    up = np.where(rng.random(len(p)) < 0.3, np.inf, size)
    down = np.where(rng.random(len(p)) < 0.3, np.inf, size * rng.uniform(0.1, 3, len(p)))
    up, down = rounded(backend, up, down)
    error = to_numpy(look.sample.value_error).astype(np.float64) + 1e-6 * (precision == "single")
    gaps = LevelGaps(backend.Float(down), backend.Float(up))
    step = to_numpy(longest_free_length(look.forward, gaps)).astype(np.float64)
    assert (step >= 0).all()
    assert np.median(step) > 0
    # A path beyond the blobs is never left.
    step = np.minimum(step, 30.0)
    oracle = Oracle(blobs)

    def leaves(factor: float) -> Any:
        s = np.linspace(0, factor, 150) * step[:, None]
        f = oracle.value(p[:, None] + s[..., None] * d[:, None]) - value[:, None]
        return ((f > (up + error)[:, None]) | (-f > (down + error)[:, None])).any(1)

    assert not leaves(1.0).any()
    is_exact_to_second_order = enclosures in ("pieces", "quadratic-taylor")
    if is_exact_to_second_order and precision == "double":
        assert leaves(1.001).sum() > 3


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_first_hits_and_looks(precision: Any) -> None:
    check_first_hits(scene(), 700, precision)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", QUICK_PRECISIONS)
@pytest.mark.parametrize("grouped", [False, True])
def test_first_hits_in_a_grid(precision: Any, grouped: bool) -> None:
    groups = np.arange(90) % 4 if grouped else None
    check_first_hits(scene(90, groups=groups), 250, precision, most_looks=6.0)


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_many_first_hits(precision: Any) -> None:
    check_first_hits(scene(), 5_000, precision)


def check_first_hits(blobs: hk.Blobs, count: int, precision: Any, most_looks: float = 3.3) -> None:
    """Against values sampled densely in double precision: no crossing before a hit, none on a miss,
    and the surface at a hit."""
    o, d, length = rounded(choose_backend(precision), *box_rays(blobs, count))
    tolerance = hk.tracer.HitTolerance(value=1e-3, distance=1e-30)
    hits = hk.trace(blobs, o, d, t_max=length, tolerance=tolerance, precision=precision)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    assert np.mean(hits.evaluations) <= most_looks
    found = hits.status == hk.RayStatus.HIT
    assert 0.2 < found.mean() < 0.8
    oracle = Oracle(blobs)
    for part in np.array_split(np.arange(len(o)), max(1, len(o) // 500)):
        end = np.where(found[part], hits.t[part], length[part])
        s = np.linspace(0, 1, 400) * end[:, None]
        f = oracle.value(o[part, None] + s[..., None] * d[part, None])
        assert f.max() <= 1 + 1e-3
        # Between samples f is at most its parabola's vertex higher.
        at = f[:, -1][found[part]]
        assert (np.abs(at - 1) <= 1.1e-3).all()


@pytest.mark.parametrize("precision", PRECISIONS)
def test_a_grid_changes_no_hit(precision: Any) -> None:
    blobs = scene(300, seed=3)
    loose: Any = hk.Blobs(blobs.centers, blobs.radii)
    loose.cell_lists = None
    o, d, length = box_rays(blobs, 700)
    for level in (1.0, 2.5):
        one, two = (
            hk.trace(one, o, d, t_max=length, level=level, precision=precision, tolerance=1e-5)
            for one in (blobs, loose)
        )
        both = np.isfinite(one.t) & np.isfinite(two.t)
        assert (np.isfinite(one.t) != np.isfinite(two.t)).sum() <= 1
        assert both.sum() > 50
        assert np.abs(one.t[both] - two.t[both]).max() < 2e-3


def test_lists_hold_every_support_that_meets_a_cell() -> None:
    rng = np.random.default_rng(0)
    centers, radii = rng.uniform(-3, 3, (200, 3)), 10 ** rng.uniform(-1.5, 0.4, 200)
    lists = CellLists.of(centers, radii)
    x = rng.uniform(-4, 4, (4000, 3))
    place = np.floor((x - lists.origin) / lists.cell_size).astype(int)
    inside = ((place >= 0) & (place < np.array(lists.shape))).all(1)
    near = ((x[:, None] - centers) ** 2).sum(-1) < radii**2
    assert not near[~inside].any()
    for k in np.flatnonzero(inside):
        i, j, m = place[k]
        index = i + lists.shape[0] * (j + lists.shape[1] * m)
        listed = lists.entries[lists.starts[index] : lists.starts[index + 1]]
        assert set(np.flatnonzero(near[k])) <= set(listed.tolist())
        assert (np.diff(listed) > 0).all()
        assert (lists.empty_distance[index] == 0) == (len(listed) > 0)


def test_other_blobs_compile_nothing() -> None:
    rng = np.random.default_rng(0)
    o, d = np.full((64, 3), [0.0, 0.0, -9.0]), np.tile([0.0, 0.0, 1.0], (64, 1))
    for kernel in ("compact", "gaussian"):
        for counts in ((40, 25), (100, 180)):
            compiled: list[int] = []
            for count in counts:
                blobs = hk.Blobs(rng.uniform(-3, 3, (count, 3)), 0.9, kernel=kernel)
                with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                    dr.kernel_history_clear()
                    hk.trace(blobs, o, d)
                    kernels = dr.kernel_history((dr.KernelType.JIT,))
                compiled.append(sum(not one["cache_hit"] for one in kernels))
            assert compiled[1] == 0


def test_blobs_in_other_formulas() -> None:
    """Blobs squeezed to half their height, as a formula, against the same squeezed by hand."""
    blobs = scene(12)
    backend = choose_backend("double")
    inner: Any = blobs.evaluator(backend)
    squeezed = hk.expression(lambda x, y, z: inner.formula(x, y, 2 * z), level=1.0)
    o, d, _ = box_rays(blobs, 400)
    flat, way = o * [1, 1, 0.5], d * [1, 1, 0.5]
    speed = np.linalg.norm(way, axis=1)
    plain = hk.trace(blobs, o, d, precision="double", tolerance=1e-7)
    other = hk.trace(
        squeezed, flat, way / speed[:, None], t_max=60.0, precision="double", tolerance=1e-7
    )
    np.testing.assert_allclose(
        np.asarray(other.t) / speed, np.asarray(plain.t), rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("precision", PRECISIONS)
def test_equal_centers_far_from_the_origin(precision: Any) -> None:
    centers = np.array([[0.0, 0, 0], [0, 0, 0], [3, 0, 0]]) + 1e4
    blobs = hk.Blobs(centers, [1.0, 1.0, 0.5])
    o = np.array([1e4, 1e4, 1e4 - 10.0])
    beside = np.array([[0.0, 0, 0], [3, 0, 0], [20, 0, 0]])
    hits = hk.trace(blobs, o + beside, [[0, 0, 1.0]] * 3, precision=precision)
    kernel = hk.kernels.CompactKernel(1.6)
    level = np.cbrt(0.5 / kernel.amplitude)  # two equal blobs are one of twice the weight
    radius = 1.6 * np.sqrt(1 - level)
    np.testing.assert_allclose(hits.t[:2], [10 - radius, 9.5], atol=4e-3)
    assert hits.status[2] == hk.RayStatus.MISS


def test_rays_that_begin_inside_or_behind() -> None:
    blobs = hk.Blobs([[0.0, 0, 0]], 1.0)
    ways = [[0, 0, 1.0]] * 3
    hits = hk.trace(blobs, [[0, 0, 0.0], [0, 0, 5.0], [0, 0, -0.5]], ways)
    np.testing.assert_allclose(hits.t[[0, 2]], [1.0, 1.5], atol=1e-3)
    assert hits.status[1] == hk.RayStatus.MISS


def test_negative_blobs_carve() -> None:
    plain = hk.Blobs([[0, 0, 0], [0, 0, -0.9]], [1.0, 0.6], [1, 0])
    carved = hk.Blobs([[0, 0, 0], [0, 0, -0.9]], [1.0, 0.6], [1, -1])
    ray = [[0.0, 0, -5]], [[0, 0, 1.0]]
    assert hk.trace(carved, *ray).t[0] > hk.trace(plain, *ray).t[0] + 0.2


@pytest.mark.parametrize("radius", [1e-9, 1e9])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_blobs_of_any_size(radius: float, precision: Any) -> None:
    blobs = hk.Blobs(np.array([[0, 0, 0], [1.5, 0, 0]]) * radius, radius)
    hits = hk.trace(
        blobs, np.array([[0, 0, -5.0]]) * radius, [[0, 0, 1.0]], precision=precision,
        tolerance=1e-5 * radius,
    )  # fmt: skip
    assert 3.5 * radius < hits.t[0] < 4.0 * radius


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        (([], 1.0), {}, "shape"),
        ((np.zeros((0, 3)), 1.0), {}, "there are none"),
        (([[0, 0, np.nan]], 1.0), {}, "center 0"),
        (([[0, 0, 0]], 0.0), {}, "radius 0 is 0"),
        (([[0, 0, 0]], np.nan), {}, "radii: entry 0"),
        (([[0, 0, 0]], -1.0), {}, "positive"),
        (([[0, 0, 0]], [1.0, 2.0]), {}, "one for each center"),
        (([[0, 0, 0]], 1.0, [np.inf]), {}, "weights"),
        (([[0, 0, 0]], 1.0), {"groups": [0.5]}, "integers"),
        (([[0, 0, 0]], 1.0), {"kernel": "gausian"}, "gaussian"),
    ],
)
def test_what_are_no_blobs(arguments: Any, settings: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hk.Blobs(*arguments, **settings)


def test_what_no_kernel_can_be() -> None:
    for wrong in (
        lambda: hk.kernels.CompactKernel(0.9),
        lambda: hk.kernels.GaussianKernel(0.0),
        lambda: hk.kernels.GaussianKernel(1.0, 2.0),
    ):
        with pytest.raises(ValueError, match="must"):
            wrong()
    with pytest.raises(TypeError, match="kernel"):
        hk.Blobs([[0, 0, 0]], 1.0, kernel=3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="level 0"):
        hk.trace(scene(3), [[0, 0, 9.0]], [[0, 0, -1.0]], level=0.0)
    with pytest.raises(ValueError, match="single precision"):
        hk.trace(hk.Blobs([[0, 0, 0]], 1e-25), [[0, 0, 1.0]], [[0, 0, -1.0]])
