"""Formulas that are recorded as tapes have the values, the level sets and the first hits of the
formulas themselves."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.fields import tape_evaluator
from harnack.fields.batched_fields import FieldCache
from harnack.fields.solids.solid import Solid
from harnack.tape import pruning
from harnack.tape.cells import TapeCells
from harnack.tape.level_box import level_box
from harnack.tape.operations import COORDINATE_COUNT
from harnack.tape.pruning import BoxLimits, BoxTapes, PrunedTapes
from harnack.tape.recording import Tape, record
from tests.tape.random_models import random_model


def values_of(tape: Tape, lists: BoxTapes, index: int, p: Any) -> Any:
    """The values of a list of instructions at points (n, 3), computed by NumPy."""
    results: dict[int, Any] = {}
    entries = range(int(lists.starts[index]), int(lists.starts[index + 1]))
    for entry in entries:
        instruction = int(lists.instructions[entry])
        kind = int(tape.kinds[instruction])
        if kind < 0:
            results[entry] = p[:, instruction]
            continue
        operation = tape.operations[kind]
        operands: list[Any] = [*p.T]
        if not operation.is_of_point:
            columns = lists.operands[: operation.operand_count, entry]
            operands = [results[int(k)] for k in columns]
        constants = tape.constants[instruction, : operation.constant_count].tolist()
        results[entry] = operation.apply(operands, constants) + 0.0 * p[:, 0]
    return results[entries[-1]]


FORMULAS: dict[str, Any] = {
    "itself": lambda x, y, z: hk.math.maximum(x, x) + hk.math.minimum(y, y) * z,
    "coordinate": lambda x, y, z: hk.math.maximum(x, hk.math.minimum(y - 50.0, z - 90.0)),
    "constant": lambda x, y, z: hk.math.maximum(x - 70.0, 0.25),
    "powers": lambda x, y, z: x**3 - (y - 1) ** 2 / (z**2 + 3) + (x * x + 2) ** 0.5,
    "functions": lambda x, y, z: (
        hk.math.sin(3 * x) * hk.math.exp(-y * y) + hk.math.tanh(z) / (2 + hk.math.cos(x * y))
        + abs(x - z) - hk.math.log(x**2 + 1.5) + hk.math.atan(y)
    ),
    "norms": lambda x, y, z: (
        hk.math.sqrt(x * x + 4 * y * y + z * z) - hk.math.norm(x, y, p=4.0) + hk.math.norm(x, 2.0)
    ),
    "sums": lambda x, y, z: (x + y + z - 0.1) + (x - y) * 0.3 + (x + 0.2) + x * 2.0 - z / 3.0,
    "multiples of one sum": lambda x, y, z: (
        (x + y + z + 0.1) + (x + y + z + 0.1) * 0.3 + (x - y + z + 0.7) * 0.1 * (x + y)
    ),
    "nested": lambda x, y, z: hk.math.minimum(
        hk.math.maximum(abs(x) - 0.5, -abs(y) + 0.2), hk.math.maximum(x - y, y - x) - z
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_lists_of_boxes_have_the_values_of_the_formula(name: str) -> None:
    formula = FORMULAS[name]
    tape, rng = record(formula), np.random.default_rng(0)
    whole = BoxTapes.whole(tape)
    p = rng.uniform(-1, 1, (200, 3))
    np.testing.assert_allclose(
        values_of(tape, whole, 0, p), formula(*p.T) + 0.0 * p[:, 0], rtol=1e-12, atol=1e-12
    )
    lower = rng.uniform(-1, 0.8, (40, 3))
    upper = lower + rng.uniform(0.001, 0.5, (40, 1))
    pruned = whole.subset(np.zeros(40, np.int64)).pruned(lower, upper, BoxLimits.unlimited(40, ()))
    for k in range(40):
        inside = rng.uniform(lower[k], upper[k], (20, 3))
        exact = formula(*inside.T) + 0.0 * inside[:, 0]
        np.testing.assert_allclose(
            values_of(tape, pruned.lists, k, inside), exact, rtol=1e-12, atol=1e-12
        )
        assert (pruned.low[k] <= exact + 1e-12).all()
        assert (pruned.high[k] >= exact - 1e-12).all()


def test_lists_hold_coordinates_only_where_others_than_balls_read_them() -> None:
    ball, wall = hk.Sphere(0.5, (1.0, 2.0, 3.0)).formula, lambda x, y, z: x - 0.25
    tape = record(lambda x, y, z: hk.math.minimum(ball(x, y, z), wall(x, y, z)))
    corners = np.array([[1.0, 2.0, 3.0], [-9.0, 0.0, 0.0], [0.5, 1.0, 3.0]])
    lists = BoxTapes.whole(tape).subset(np.zeros(3, np.int64))
    # In the first box the ball is less, in the second one the wall, in the third one either.
    boxes = lists.pruned(corners, corners + 0.2, BoxLimits.unlimited(3, ())).lists
    assert boxes.lengths.tolist() == [1, 2, 3]


@pytest.mark.parametrize("hashes_differ", [True, False])
def test_equal_lists_are_stored_once(monkeypatch: pytest.MonkeyPatch, hashes_differ: bool) -> None:
    if not hashes_differ:
        monkeypatch.setattr(pruning, "_hashes", lambda columns, places: 0 * places)
    model = random_model(np.random.default_rng(0), 40, 0.3)
    cells = TapeCells.of(record(model.formula), np.full(3, -1.5), np.full(3, 1.5), (0.0,))
    distinct, index = cells.lists.distinct()

    def text(lists: BoxTapes, k: int) -> Any:
        entries = slice(lists.starts[k], lists.starts[k + 1])
        operands = lists.operands[:, entries] - lists.starts[k]
        return (*lists.instructions[entries].tolist(), -1, *operands.ravel().tolist())

    assert len(distinct) < len(cells.lists) / 5
    assert len({text(distinct, k) for k in range(len(distinct))}) == len(distinct)
    for k in range(0, len(cells.lists), 7):
        assert text(cells.lists, k) == text(distinct, int(index[k]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("levels", [(), (0.0,), (-0.05, 0.1)])
def test_cells_have_the_values_that_matter(seed: int, levels: tuple[float, ...]) -> None:
    rng = np.random.default_rng(seed)
    model = random_model(rng, 40, 0.3)
    tape = record(model.formula)
    cells = TapeCells.of(tape, np.full(3, -1.5), np.full(3, 1.5), levels)
    whole = BoxTapes.whole(tape)
    p = rng.uniform(-1.5, 1.5, (300, 3))
    # The cell of a point nearby: its list holds in its margin, too.
    near = np.clip(p + cells.cell_size * rng.uniform(-0.124, 0.124, p.shape), -1.5, 1.5)
    x, y, z = np.floor((near - cells.origin) / cells.cell_size).astype(np.int64).T
    index = x + cells.shape[0] * (y + cells.shape[1] * z)
    is_empty = cells.empty_distance[index] > 0
    exact = values_of(tape, whole, 0, p)
    for k, (at, cell) in enumerate(zip(p, index, strict=True)):
        which = int(cells.list_of_cell[cell])
        (value,) = values_of(tape, cells.lists, which, at[None])
        low, high = cells.limits.floor[which], cells.limits.cap[which]
        if low <= exact[k] <= high:
            assert value == pytest.approx(exact[k], abs=1e-12)
        else:
            assert value < low if exact[k] < low else value > high
        if is_empty[k]:
            assert not any(abs(exact[k] - level) < 1e-12 for level in levels)
    assert levels or not is_empty.any()
    lengths = cells.lists.lengths[cells.list_of_cell]
    assert lengths.mean() < (0.4 if levels else 0.6) * len(tape)


def test_numbers_that_overflow_are_recorded_as_they_are() -> None:
    p = np.array([[0.5, -0.25, 1.0]])
    formulas: list[Any] = [
        lambda x, y, z: x * 1e308 * 1e308,
        lambda x, y, z: x + 1e308 + 1e308 + y,
        lambda x, y, z: x / 1e-320,
        lambda x, y, z: hk.math.minimum(x + math.inf, y),
        lambda x, y, z: x * math.inf,
    ]
    with np.errstate(over="ignore"):
        for formula in formulas:
            tape = record(formula)
            np.testing.assert_array_equal(
                values_of(tape, BoxTapes.whole(tape), 0, p), formula(*p.T) + 0.0 * p[:, 0]
            )


@pytest.mark.parametrize(
    ("lines", "text"),
    [("a const 0\nb recip a", "divides by zero"), ("x var-x\na const 0\nb div x a", "by zero")],
)
def test_formulas_in_files_that_divide_by_zero_are_refused(
    tmp_path: Path, lines: str, text: str
) -> None:
    path = tmp_path / "a.vm"
    path.write_text(lines)
    with pytest.raises(ValueError, match=text):
        hk.expression.from_vm(path)


def test_blends_within_blends_are_not_steep() -> None:
    """A blend has a Lipschitz constant. Estimated from its formula, its slope grew with every blend
    within another, and rays took a hundred times as long."""
    centers = np.random.default_rng(0).uniform(-1, 1, (40, 3)).tolist()
    spheres = [hk.Sphere(0.05, tuple(c)) for c in centers]
    blend = hk.smooth_union(spheres, 0.1)
    for model in (blend, hk.smooth_union([blend.shell(0.01), *spheres[:4]], 0.1)):
        evaluator: Any = model.evaluator(choose_backend("single"))
        assert isinstance(evaluator, tape_evaluator.TapeEvaluator)
        assert not evaluator.is_steep
    step = hk.expression("max(-1, min(1, 1e9 * y))", domain=hk.Box((-1, -1, -1), (1, 1, 1)))
    steep = hk.smooth_union([*spheres, hk.solid(step, below=0.0)], 0.1)
    assert steep.evaluator(choose_backend("single")).is_steep


def test_equal_parts_are_interpreted() -> None:
    """They are a single instruction, but would be compiled one by one, for hours."""
    model = hk.smooth_union([hk.Sphere(1.0) for _ in range(300)], 0.1)
    assert isinstance(model.evaluator(choose_backend("single")), tape_evaluator.TapeEvaluator)
    hits = hk.trace(model, [[0.0, 0.0, 5.0]], [[0.0, 0.0, -1.0]])
    # In r - f, a blend is the root of the sum of squares.
    assert float(hits.t[0]) == pytest.approx(5 - 1 - 0.1 * (1 - 300**-0.5), abs=3e-4)


def fresh_caches(monkeypatch: pytest.MonkeyPatch, shortest: int) -> None:
    """Let formulas of more than `shortest` instructions be interpreted, of all fields."""
    monkeypatch.setattr(tape_evaluator, "_MIN_INSTRUCTIONS", shortest)
    monkeypatch.setattr(tape_evaluator, "_MAX_OPERATIONS", 10**9)
    for name in ("_TAPES", "_CELLS"):
        monkeypatch.setattr(tape_evaluator, name, FieldCache())


def camera_rays(count: int) -> tuple[Any, Any]:
    """Rays (count^2, 3) from the directions of a cube's diagonal, over a box of the size 3."""
    rng = np.random.default_rng(7)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    u, v = np.meshgrid(np.linspace(-1.7, 1.7, count), np.linspace(-1.7, 1.7, count))
    o = np.stack([u.ravel(), v.ravel(), np.full(count * count, 4.0)], axis=1)
    return o @ turn.T, np.tile(turn @ np.array([0.0, 0.0, -1.0]), (count * count, 1))


@pytest.mark.parametrize(
    ("seed", "count", "precision"),
    [(0, 7, "single"), pytest.param(1, 12, "double", marks=pytest.mark.slow)],
)
def test_first_hits_are_those_of_the_compiled_formula(
    monkeypatch: pytest.MonkeyPatch, seed: int, count: int, precision: Any
) -> None:
    o, d = camera_rays(60)
    hits: list[Any] = []
    for shortest in (10, 10**9):
        fresh_caches(monkeypatch, shortest)
        model = random_model(np.random.default_rng(seed), count)
        evaluator = model.evaluator(choose_backend(precision))
        assert isinstance(evaluator, tape_evaluator.TapeEvaluator) == (shortest == 10)
        hits.append(hk.trace(model, o, d, precision=precision))
    by_tape, compiled = hits
    differs = by_tape.status != compiled.status
    assert differs.mean() < 1e-3  # rays that touch within the tolerance
    assert (compiled.status == hk.RayStatus.HIT).mean() > 0.1
    both = ~differs & (compiled.status == hk.RayStatus.HIT)
    # (A ray that touches within the tolerance may hit there, or farther on.)
    later = by_tape.t[both] - compiled.t[both]
    assert (np.abs(later) < 2e-3).mean() > 0.99
    assert np.abs(model.value(by_tape.position[both])).max() < 1e-3
    # No solid before the first hit, or on rays that miss.
    end = np.where(np.isfinite(by_tape.t), by_tape.t - 5e-3, 8.0)
    for share in np.linspace(0.0, 1.0, 60):
        assert model.value(o + (share * end)[:, None] * d).min() > -2e-3
    assert not (by_tape.status == hk.RayStatus.OUT_OF_STEPS).any()


@pytest.mark.parametrize("enclosures", [None, "lipschitz", "curvature", "segment"])
def test_no_kind_of_enclosure_misses_a_sphere(enclosures: Any) -> None:
    """Promises are of the solid itself. With values of the lists of cells, which are right near the
    surface alone, sphere tracing passed 190 spheres."""
    radius, centers = 0.15, np.random.default_rng(0).uniform(-1, 1, (60, 3))
    model = hk.solids.union([hk.Sphere(radius, tuple(c)) for c in centers.tolist()])
    o, d = camera_rays(60)
    hits = hk.trace(model, o, d, enclosures=enclosures)
    away = o[:, None] - centers
    along = (away * d[:, None]).sum(axis=-1)
    square = along**2 - (away**2).sum(axis=-1) + radius**2
    first = np.where(square > 0, -along - np.sqrt(np.maximum(square, 0)), np.inf).min(axis=1)
    is_deep = square.max(axis=1) > 1e-3
    assert is_deep.sum() > 500
    assert (hits.t[is_deep] < first[is_deep] + 1e-3).all()


def test_tangents_of_lists_are_no_bounds_of_a_convex_formula() -> None:
    """Beyond a cell, and where its list is another function, they prove nothing."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def polytope(x: Any, y: Any, z: Any) -> Any:
        sides = [x * a + y * b + z * c - 0.6 for a, b, c in normals.tolist()]
        return hk.math.maximum(*sides)

    field = hk.expression(polytope, domain=hk.Box((-2, -2, -2), (2, 2, 2)), is_convex=True)
    o, d = camera_rays(40)
    hits = hk.trace(field, o, d)
    # A ray meets the polytope where it has entered all half-spaces, and left none.
    speed, height = d @ normals.T, 0.6 - o @ normals.T
    with np.errstate(divide="ignore"):
        at = height / speed
    enter = np.where(speed < 0, at, -np.inf).max(axis=1)
    leave = np.where(speed > 0, at, np.inf).min(axis=1)
    is_deep = leave - enter > 1e-2
    assert is_deep.sum() > 100
    t = hits.t[is_deep]
    assert (t < enter[is_deep] + 1e-3).all()
    assert (np.abs(((o + hits.t[:, None] * d)[is_deep] @ normals.T).max(axis=1) - 0.6) < 1e-3).all()
    assert not np.isfinite(hits.t[leave - enter < -1e-2]).any()


def test_another_model_of_the_same_kinds_compiles_nothing() -> None:
    """Radii, places, the number of parts and how they are combined are data."""
    rng = np.random.default_rng(3)

    def model(count: int) -> Solid:
        centers = rng.uniform(-1, 1, (count, 3))
        return hk.solids.union(*(hk.Sphere(0.1, tuple(c)) for c in centers.tolist()))

    o, d = camera_rays(20)
    hk.trace(model(60), o, d)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        hk.trace(model(60), o, d)
        hk.trace(model(300), o, d)
        kernels = dr.kernel_history((dr.KernelType.JIT,))
    assert kernels
    assert all(kernel["cache_hit"] and not kernel["cache_disk"] for kernel in kernels)


def range_on_box(solid: hk.solids.FormulaSolid, lower: Any, upper: Any) -> tuple[float, float]:
    """Of a solid that is a single instruction."""
    tape = record(solid.formula)
    operation = tape.operations[tape.kinds[tape.result]]
    sides = [(lower[k : k + 1], upper[k : k + 1]) for k in range(3)]
    low, high = operation.rounded_ranges(sides, list(tape.constants[tape.result][:, None]))
    return float(low[0]), float(high[0])


@pytest.mark.parametrize(
    ("start", "end", "distance"),
    [
        ((1.25, -3, 0), (1.25, 3, 0), 0.25),
        ((2, 0.5, 0), (0.5, 2, 0), 0.5 / math.sqrt(2)),
        ((4, 0, 0), (6, 0, 0), 3.0),
    ],
    ids=["beside a face", "askew to an edge", "beyond an end"],
)
def test_ranges_of_segments_are_sharp(start: Any, end: Any, distance: float) -> None:
    """The nearest point of the box has this distance: larger bounds would be wrong."""
    lower, upper = np.array([0.0, -1, -1]), np.array([1.0, 1, 1])
    low, _ = range_on_box(hk.Capsule(start, end, 0.01), lower, upper)
    assert distance - 0.01 - 1e-5 < low <= distance - 0.01


def test_ranges_of_segments_and_cones_contain_all_values() -> None:
    rng = np.random.default_rng(5)
    share = np.stack(np.meshgrid(*[np.linspace(0, 1, 9)] * 3), axis=-1).reshape(-1, 3)
    for _ in range(60):
        center, half = rng.normal(size=3), rng.uniform(0.01, 1.5, 3)
        lower, upper = center - half, center + half
        start, end = (tuple(point) for point in rng.normal(size=(2, 3)).tolist())
        points = lower + share * (upper - lower)
        for solid in (hk.Capsule(start, end, 0.1), hk.solids.RoundCone(start, end, (0.3, 0.1))):
            low, high = range_on_box(solid, lower, upper)
            values = solid.value(points, precision="double")
            assert low <= values.min()
            assert values.max() <= high


def test_short_formulas_have_a_proved_box() -> None:
    """Rays beside a quartic miss at once; a paraboloid reaches to infinity, and has no box."""
    field = hk.expression("x^4 + y^4 + z^4 = 1")
    lower, upper = field.extent((0.0,)).bounds()
    assert (lower <= -1).all()
    assert (upper >= 1).all()
    assert np.abs([lower, upper]).max() < 1.1
    hits = hk.trace(field, [[3.0, 3, 3], [0, 0, 3]], [[0.0, 0, 1], [0, 0, -1]])
    assert hits.status.tolist() == [int(hk.RayStatus.MISS), int(hk.RayStatus.HIT)]
    assert hits.evaluations[0] == 0
    assert hk.expression("x^2 + y^2 - z").extent((0.0,)) is None


def test_a_text_of_many_spheres_has_a_proved_box() -> None:
    centers = np.random.default_rng(5).uniform(-0.5, 0.5, (60, 3)).round(4)
    texts = [f"sqrt((x-({a}))^2 + (y-({b}))^2 + (z-({c}))^2) - 0.1" for a, b, c in centers]
    surface = hk.expression(f"min({', '.join(texts)})")
    extent = surface.extent((0.0,))
    assert extent is not None
    lower, upper = (np.array(corner) for corner in extent.bounds())
    assert (lower <= centers.min(axis=0) - 0.1).all()
    assert (upper >= centers.max(axis=0) + 0.1).all()
    assert (upper - lower).max() < 1.3
    # A cylinder has no end.
    assert hk.expression("min(x^2 + y^2 - 1, " + ", ".join(texts) + ")").extent((0.0,)) is None
    origins = np.column_stack([centers[:, :2], np.full(60, 3.0)])
    hits = hk.trace(surface, origins, [[0, 0, -1]], precision="double")
    near = np.linalg.norm(centers[:, None, :2] - centers[None, :, :2], axis=-1)
    tops = np.where(near < 0.1, centers[:, 2] + np.sqrt(np.fmax(0.01 - near**2, 0)), -np.inf)
    np.testing.assert_allclose(hits.t, 3.0 - tops.max(axis=1), atol=1e-3)


def test_ranges_contain_sums_of_products_that_cancel() -> None:
    """The rounding of a product is larger than any fraction of what is left of it."""
    numbers = np.random.default_rng(0).uniform(1.6, 1.7, 400)
    tape = record(lambda x, y, z: -3.0 * x + 4.95)
    boxes = np.repeat(numbers[:, None], 3, axis=1)
    lists = BoxTapes.whole(tape).subset(np.zeros(400, np.int64))
    pruned = lists.pruned(boxes, boxes, BoxLimits.unlimited(400, ()))
    for number, low, high in zip(numbers.tolist(), pruned.low, pruned.high, strict=True):
        assert Fraction(low) <= Fraction(4.95) - 3 * Fraction(number) <= Fraction(high)


@pytest.mark.parametrize(
    ("formula", "face"),
    [
        (lambda x, y, z: 4 - x * x - y * y - z * z, 2.0),
        (lambda x, y, z: hk.math.log(x * x + y * y + z * z), 1.0),
        (lambda x, y, z: hk.math.exp(-(x * x + y * y + z * z)) - math.exp(-4.0), 2.0),
        (lambda x, y, z: abs(x) ** 1.5 + abs(y) ** 2.5 + abs(z) ** 1.5 - 1, 1.0),
        (lambda x, y, z: 4 * (x * x + y * y + z * z) ** 0.5 - 4, 1.0),
        (lambda x, y, z: 3 * x * x + y * (3 * y) + 1.5 * z * (2 * z) - 3, 1.0),
    ],
    ids=["three squares", "logarithm", "bell curve", "powers", "root of powers", "multiples"],
)
def test_boxes_of_level_sets_by_half_spaces(formula: Any, face: float) -> None:
    corners = level_box(record(formula), (0.0,))
    assert corners is not None
    lower, upper = corners
    assert (upper >= face).all()
    assert (lower <= -face).all()
    assert (upper - lower).max() <= 2.2 * face


def test_numbers_that_overflow_are_not_infinite_in_ranges() -> None:
    """exp(|x|)^0.001 is 3 where |x| = 1098.6, though exp(710) overflows."""
    corners = level_box(
        record(
            lambda x, y, z: hk.math.maximum(
                hk.math.exp(abs(x)) ** 0.001 - 3, hk.math.norm(y, z) - 1
            )
        ),
        (0.0,),
    )
    assert corners is None or corners[1][0] > 1098.0
    tape = record(lambda x, y, z: hk.math.norm(x * 1e200, y * 1e200))
    corner = np.ones((1, 3))
    pruned = BoxTapes.whole(tape).pruned(corner, corner, BoxLimits.unlimited(1, ()))
    assert pruned.low[0] <= math.sqrt(2) * 1e200 <= pruned.high[0]


@pytest.mark.parametrize("scale", [0.9995, 1.0005])
def test_octants_have_the_members_that_are_as_near_as_their_cap(scale: float) -> None:
    """A ball and a capsule on the other side of the middle, at the cap from the enlarged octant."""
    margin, cap, radius = 0.1, 0.3, 0.2
    x = -scale * (margin + cap) - radius
    near = hk.Sphere(radius, (x, 0.5, 0.5)), hk.Capsule((x - 1, 0.5, 0.5), (x, 0.5, 0.5), radius)
    for solid in near:
        tape = record(hk.union(hk.Sphere(0.1, (0.5, 0.5, 0.5)), solid).formula)
        lists, limits = BoxTapes.whole(tape), BoxLimits.unlimited(1, ())
        caps = np.full(len(lists.instructions), cap)
        whole = PrunedTapes(lists, np.zeros(1), np.zeros(1), limits, caps)
        lengths = whole.octants(np.zeros((1, 3)), margin).lengths - COORDINATE_COUNT
        # The last octant is that of large x, y and z.
        assert lengths[-1] == (2 if scale < 1 else 1)
