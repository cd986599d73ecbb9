"""Curves: what is accepted, their measures, and the proof that one lies on a convex body."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import scipy.spatial
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from harnack.geometry import example_curves
from harnack.geometry.convex_position import MAX_EXAMINED_VERTICES, segment_distance_lower_bound
from harnack.geometry.curves import (
    CurveError,
    bounding_box,
    edge_endpoints,
    is_convex_position,
    total_length,
    validate_loops,
)

TRIANGLE = [[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]


def is_convex(curve) -> bool:
    return is_convex_position(validate_loops(curve))


def rotation(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


def full_turn(n: int) -> np.ndarray:
    return np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)


@pytest.mark.parametrize(
    ("loops", "counts"),
    [
        (TRIANGLE, [3]),
        (np.array(TRIANGLE, dtype=np.int32), [3]),
        ([TRIANGLE], [3]),
        ([TRIANGLE, TRIANGLE], [3, 3]),
        ([TRIANGLE, example_curves.regular_polygon(5)], [3, 5]),
        ((example_curves.regular_polygon(3), example_curves.regular_polygon(3)), [3, 3]),
        ([*TRIANGLE, TRIANGLE[0]], [3]),  # a repeated closing vertex is dropped
        ([[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 1, 0]], [4]),  # folds back on itself
    ],
)
def test_loops_are_accepted_one_by_one_or_in_a_list(loops, counts):
    checked = validate_loops(loops)
    assert isinstance(checked, tuple)
    assert [loop.shape for loop in checked] == [(n, 3) for n in counts]
    assert all(loop.dtype == np.float64 for loop in checked)
    assert [loop.shape for loop in validate_loops(checked)] == [(n, 3) for n in counts]


def test_validated_loops_are_copies():
    mine = np.array(TRIANGLE)
    checked = validate_loops(mine)
    mine[:] = 7.0
    assert checked[0].tolist() == TRIANGLE


@pytest.mark.parametrize(
    ("loops", "message"),
    [
        ([], "there are no loops"),
        (np.zeros((0, 3)), "0 different vertices"),
        (TRIANGLE[:2], "2 different vertices"),
        ([[1, 1, 1]] * 5, "1 different"),
        (TRIANGLE[:2] * 3, "2 different"),
        ([TRIANGLE, TRIANGLE[:2]], "loop 1 has 2"),
        ([[0, 0], [1, 0], [0, 1]], r"not \(3, 2\); append a column of zeros"),
        (np.zeros((3, 7)), r"not \(3, 7\); transpose it"),
        ([0.0, 1.0, 2.0], r"must have shape \(n, 3\), not \(3,\)"),
        (np.zeros((2, 2, 2, 3)), r"must have shape \(n, 3\)"),
        ([[0, 0, 0], [1, 0], [0, 1, 0]], "every vertex needs three coord"),
        ([TRIANGLE, [[0, 0, 0], [1, 0]]], "loop 1 is ragged"),
        ([TRIANGLE, [[0, 0], [1, 0], [1, 1]]], "loop 1 must have shape"),
        ("abc", "must hold real numbers"),
        (None, "must hold real numbers"),
        (np.array(TRIANGLE) * 1j, "must hold real numbers"),
        ([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], r"vertex 1 .*\(1, nan, 0\)"),
        ([*TRIANGLE, [0, np.inf, 0], [np.inf] * 3], r"vertex 3.*1 more"),
        ([*TRIANGLE, TRIANGLE[2]], "vertices 2 and 3 .*: remove one"),
        ([*TRIANGLE, TRIANGLE[0], TRIANGLE[0]], "vertices 3 and 0"),
        (np.array(TRIANGLE) * 1e150, "choose units"),
        (np.array(TRIANGLE) * 1e-150, "choose units"),
        (np.broadcast_to(0.0, (20_000_000, 3)), "at most 10,000,000"),
    ],
)
def test_each_bad_curve_has_its_own_message(loops, message):
    with pytest.raises(CurveError, match=message):
        validate_loops(loops)


def test_measures_of_a_curve():
    loops = validate_loops([TRIANGLE, example_curves.regular_polygon(4)])
    start, end = edge_endpoints(loops)
    assert start.shape == end.shape == (7, 3)
    assert end[2].tolist() == TRIANGLE[0]
    np.testing.assert_allclose(end[6], start[3])
    assert total_length(loops) == pytest.approx(12.0 + 4.0 * np.sqrt(2.0))
    lower, upper = bounding_box(loops)
    np.testing.assert_allclose(lower, [-1, -1, 0], atol=1e-15)
    np.testing.assert_allclose(upper, [3, 4, 0], atol=1e-15)


@pytest.mark.parametrize("n", [3, 4, 7, 12, 64, 256])
def test_curves_on_a_cylinder_are_in_convex_position(n):
    assert is_convex(example_curves.wavy_polygon(n))
    assert is_convex(example_curves.regular_polygon(n))


@settings(deadline=None)
@given(
    seed=st.integers(0, 1000),
    log_scale=st.floats(-6, 6),
    waves=st.integers(2, 5),
    amplitude=st.floats(0.01, 0.5),
)
def test_curves_on_a_sphere_are_in_convex_position(seed, log_scale, waves, amplitude):
    t = full_turn(100)
    x = np.column_stack([np.cos(t), np.sin(t), amplitude * np.sin(waves * t + seed)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    scale = 10.0**log_scale
    assert is_convex(scale * (x @ rotation(seed) + [1.0, 2.0, 3.0]))


# Around all corners of a cube along its rims, with a detour through the inside of one face.
ON_CUBE = np.array([[0, 0, 0], [1, 0.7, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 2, 2], [2, 2, 2],
                    [2, 0, 2], [0, 0, 2]])  # fmt: skip


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e5])
def test_a_curve_within_the_faces_of_a_cube_is_in_convex_position(seed, scale):
    x = scale * (ON_CUBE @ rotation(seed))
    assert is_convex(x)
    assert is_convex(np.roll(x[::-1], seed, axis=0))
    dented = x.copy()
    dented[1] += 1e-9 * (x.mean(axis=0) - x[1])
    assert not is_convex(dented)


@pytest.mark.parametrize("seed", range(5))
def test_simple_planar_polygons_count(seed):
    star = example_curves.regular_polygon(10)
    star[::2] *= 0.4
    assert is_convex(star @ rotation(seed))
    comb = np.array([[0, 0], [4, 0], [4, 2], [3, 2], [3, 1e-3], [1, 1e-3], [1, 2], [0, 2]])
    assert is_convex(np.column_stack([comb, np.ones(8)]) @ rotation(seed))


def sphere_figure_eight() -> np.ndarray:
    t = full_turn(100)
    x, y = np.sin(t), np.sin(t) * np.cos(t)
    return np.column_stack([x, y, np.sqrt(2.0 - x * x - y * y)])


def flat_figure_eight() -> np.ndarray:
    return sphere_figure_eight() * (1.0, 1.0, 0.0)


def dented(curve: np.ndarray) -> np.ndarray:
    curve = curve.copy()
    curve[0] *= 0.9
    return curve


def spike() -> np.ndarray:
    return np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0], [1, 1, 0]])


@pytest.mark.parametrize(
    "curve",
    [
        example_curves.torus_knot(2, 3, 60),
        example_curves.figure_eight_knot(80),
        example_curves.coil(3, 60),
        example_curves.coil(5, 100, return_path="axis"),
        example_curves.hopf_link(12),
        [
            example_curves.regular_polygon(5),
            example_curves.regular_polygon(5) + np.array([0, 0, 1.0]),
        ],
        example_curves.square_with_holes(),
        sphere_figure_eight(),
        flat_figure_eight(),
        dented(example_curves.wavy_polygon(64)),
        spike(),
        example_curves.wavy_polygon(MAX_EXAMINED_VERTICES + 1),  # not examined
    ],
)
def test_no_other_curve_is_claimed_to_be_in_convex_position(curve):
    assert not is_convex(curve)


def test_a_dent_of_rounding_size_is_forgiven_and_a_larger_one_is_not():
    curve = example_curves.regular_polygon(12)
    curve[:, 2] = [0, 0.5, 0.5] * 4
    curve = np.insert(curve, 2, 0.5 * (curve[1] + curve[2]), axis=0)  # on an edge of the hull
    assert is_convex(curve)
    inward = curve[2] * [1, 1, 0] * -1.0
    assert is_convex(curve + np.outer(np.arange(13) == 2, 1e-14 * inward))
    assert not is_convex(curve + np.outer(np.arange(13) == 2, 1e-10 * inward))


def with_tiny_edge(curve: np.ndarray, length: float) -> np.ndarray:
    """The curve moved so that it starts at 0, with a vertex `length` after the first."""
    return np.insert(curve - curve[0], 1, [length, 0, 0], axis=0)


@pytest.mark.parametrize("length", [1e-90, 1e-30, 1e-17, 1e-12])
def test_an_edge_too_short_for_a_direction_proves_nothing(length: float) -> None:
    """In the coordinates of the tests it has length zero, and NaN for a direction."""
    ring = example_curves.regular_polygon(20)
    for curve in (
        np.tile(ring, (2, 1)),
        ring,
        flat_figure_eight(),
        example_curves.wavy_polygon(12),
    ):
        with np.errstate(all="raise", under="ignore"):
            assert not is_convex(with_tiny_edge(curve, length))


def test_segments_of_length_zero_have_a_clearance() -> None:
    point, other = np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]])
    with np.errstate(all="raise"):
        assert segment_distance_lower_bound(point, point, other, other) == pytest.approx(5.0)
        assert segment_distance_lower_bound(point, other, other, other) == 0.0
        assert segment_distance_lower_bound(other, other, point, -other) == pytest.approx(5.0)


def edge_depth(x: np.ndarray) -> np.ndarray:
    """How deep below the hull's surface the middle of each edge lies, by Qhull."""
    planes = scipy.spatial.ConvexHull(x).equations
    middle = 0.5 * (x + np.roll(x, -1, axis=0))
    return -(middle @ planes[:, :3].T + planes[:, 3]).max(axis=1)


def edge_distances(x: np.ndarray) -> np.ndarray:
    """Distances between sampled edges without a common vertex."""
    s = np.linspace(0, 1, 40)[:, None]
    samples = [(1 - s) * a + s * b for a, b in zip(x, np.roll(x, -1, axis=0), strict=True)]
    n = len(x)
    pairs = [(i, j) for i in range(n) for j in range(i + 2, n) if (i, j) != (0, n - 1)]
    return np.array([scipy.spatial.distance.cdist(samples[i], samples[j]).min() for i, j in pairs])


@settings(deadline=None, max_examples=300)
@given(
    n=st.integers(4, 7),
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(["grid", "ball", "sphere"]),
)
def test_convex_position_agrees_with_the_hull_of_qhull(n, seed, kind):
    rng = np.random.default_rng(seed)
    if kind == "grid":
        x = rng.integers(-2, 3, size=(n, 3)).astype(float)
        assume(len(np.unique(x, axis=0)) == n)
    else:
        x = rng.normal(size=(n, 3))
        x /= np.linalg.norm(x, axis=1, keepdims=True) if kind == "sphere" else 2.0
    assume(np.linalg.svd(x - x.mean(axis=0))[1][2] > 1e-3)
    claimed = is_convex(x)
    depth = edge_depth(x)
    if claimed:
        assert depth.max() < 1e-9
        assert edge_distances(x).min() > 0.0
    elif depth.max() < 1e-13 and kind != "grid":  # a random curve does not cross itself there
        raise AssertionError("all edges lie on the hull, but no proof was found")


@pytest.mark.slow
@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), flatten=st.sampled_from([1.0, 1e-6, 0.0]))
def test_the_clearance_of_segments_is_a_lower_bound_and_sharp(seed, flatten):
    rng = np.random.default_rng(seed)
    p1, q1, p2, q2 = rng.normal(size=(4, 200, 3)) * [1, 1, flatten]
    parallel = rng.random(200) < 0.2
    q2[parallel] = p2[parallel] + (q1 - p1)[parallel] * rng.normal(size=(parallel.sum(), 1))
    lower = segment_distance_lower_bound(p1, q1, p2, q2)
    s = np.linspace(0, 1, 201)
    a = p1[:, None] + s[:, None] * (q1 - p1)[:, None]
    b = p2[:, None] + s[:, None] * (q2 - p2)[:, None]
    sampled = np.array(
        [scipy.spatial.distance.cdist(u, v).min() for u, v in zip(a, b, strict=True)]
    )
    assert (lower <= sampled + 1e-14).all()
    spacing = (np.linalg.norm(q1 - p1, axis=1) + np.linalg.norm(q2 - p2, axis=1)) / 200
    assert (lower >= sampled - spacing).all()


def linking_number(a: np.ndarray, b: np.ndarray) -> float:
    """Gauss's integral, exactly: the solid angle between edges summed over all pairs."""
    total = 0.0
    for p, q in zip(a, np.roll(a, -1, axis=0), strict=True):
        for r, s in zip(b, np.roll(b, -1, axis=0), strict=True):
            corners = [r - p, s - p, s - q, r - q]
            n = [np.cross(corners[k], corners[(k + 1) % 4]) for k in range(4)]
            n = [v / np.linalg.norm(v) for v in n]
            area = sum(np.arcsin(np.clip(n[k] @ n[(k + 1) % 4], -1, 1)) for k in range(4))
            total += area * np.sign(np.dot(np.cross(s - r, q - p), r - p))
    return total / (4.0 * np.pi)


def test_the_links_are_linked_as_they_should_be():
    first, second = example_curves.hopf_link(20)
    assert abs(linking_number(first, second)) == pytest.approx(1.0, abs=1e-9)
    rings = example_curves.borromean_rings(20)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        assert linking_number(rings[a], rings[b]) == pytest.approx(0.0, abs=1e-9)


def test_a_coil_has_its_turns_and_closes():
    for route in ("outside", "axis"):
        (loop,) = validate_loops(example_curves.coil(5, 200, return_path=route))
        assert len(loop) == 200
        x, y, z = loop[:198].T
        turned = np.unwrap(np.arctan2(y, x))
        assert turned[-1] - turned[0] == pytest.approx(10.0 * np.pi)
        assert np.ptp(z) == pytest.approx(1.0)
        clearance = edge_distances(example_curves.coil(3, 40, return_path=route))
        assert clearance.min() > 0.1


def test_the_holes_of_the_square_run_the_other_way():
    outer, *holes = example_curves.square_with_holes()

    def area(loop):
        return 0.5 * np.cross(loop, np.roll(loop, -1, axis=0))[:, 2].sum()

    assert area(outer) == pytest.approx(4.0)
    assert len(holes) == 3
    assert all(area(hole) < 0 for hole in holes)


@pytest.mark.parametrize(
    "curve",
    [
        example_curves.torus_knot(3, 5, 90),
        example_curves.figure_eight_knot(60),
        example_curves.hopf_link(9),
        example_curves.borromean_rings(12),
        example_curves.square_with_holes(),
        example_curves.random_closed_curve(np.random.default_rng(0), 50),
        example_curves.spiky_polygon(np.random.default_rng(0), 21),
        example_curves.coil(1, 6),
    ],
)
def test_every_shape_is_a_valid_curve_of_size_about_one(curve):
    loops = validate_loops(curve)
    lower, upper = bounding_box(loops)
    assert 0.5 < (upper - lower).max() < 4.0


def test_random_shapes_repeat_with_their_generator():
    for make in (example_curves.random_closed_curve, example_curves.spiky_polygon):
        one, two = (make(np.random.default_rng(4), 20) for _ in range(2))
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: example_curves.regular_polygon(2), "at least 3 vertices"),
        (lambda: example_curves.torus_knot(2, 4, 30), "no common divisor"),
        (lambda: example_curves.coil(0, 30), "at least one turn"),
        (lambda: example_curves.coil(5, 10), "at least 18 vertices"),
        (lambda: example_curves.coil(2, 30, return_path="inside"), '"outside" or "axis"'),
        (
            lambda: example_curves.random_closed_curve(np.random.default_rng(0), 9, harmonics=0),
            "at least one harmonic",
        ),
    ],
)
def test_impossible_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "loop",
    [
        [[0, 0, 0], [1e99, 0, 0], [0, 1e-99, 0]],
        # Edges 0 and 2 share no vertex and are 1e-198 of the size apart.
        [[0, 0, 0], [1e99, 0, 0], [0, 1e99, 0], [0, 1e-99, 0]],
    ],
)
def test_what_rounds_to_no_number_is_no_proof_of_convex_position(loop) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_convex_position(validate_loops(loop))
