"""Clipping volumes: what they cut away is outside, whatever the precision and the scale."""

from __future__ import annotations

import harnack.backend as hb  # before drjit: it decides which LLVM drjit loads

# isort: split

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harnack.geometry.clip_volumes import (
    MAX_UNROLLED,
    Ball,
    Box,
    HalfSpace,
    Polytope,
    VolumeIntersection,
)
from harnack.geometry.convex_position import MAX_PLANES, ConvexHull
from harnack.geometry.volume import Volume

EPS = {"single": 2.0**-24, "double": 2.0**-53}


def sphere_points(rng: np.random.Generator, n: int) -> np.ndarray:
    x = rng.normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def tetrahedron() -> np.ndarray:
    return np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def half_space_through(point: np.ndarray) -> HalfSpace:
    normal = np.array([1.0, -2.0, 0.5])
    return HalfSpace(tuple(normal), float(point @ normal / np.linalg.norm(normal)))


def make_volume(kind: str, shift: np.ndarray, scale: float) -> Volume:
    rng = np.random.default_rng(7)
    c = tuple(shift)
    match kind:
        case "ball":
            return Ball(c, scale)
        case "box":
            return Box(tuple(shift - scale), tuple(shift + scale * np.array([1, 2, 0.3])))
        case "slab":
            far = np.array([np.inf, np.inf, scale])
            return Box(tuple(shift - far), tuple(shift + far))
        case "half-space":
            return half_space_through(shift)
        case "tetrahedron":
            return ConvexHull.from_points(shift + scale * tetrahedron())
        case "round hull":
            return ConvexHull.from_points(shift + scale * sphere_points(rng, 60))
        case "flat hull":
            return ConvexHull.from_points(shift + scale * sphere_points(rng, 20) * [1, 1, 0])
        case "rod":
            return ConvexHull.from_points(shift + scale * sphere_points(rng, 20) * [0, 1, 0])
        case "cut ball":
            return VolumeIntersection([Ball(c, scale), half_space_through(shift)])
    raise AssertionError(kind)


KINDS = ["ball", "box", "slab", "half-space", "tetrahedron", "round hull", "flat hull", "rod"]
KINDS += ["cut ball"]


def members(volume: Volume) -> list[Volume]:
    return list(volume.volumes) if isinstance(volume, VolumeIntersection) else [volume]


def exact_clip(volume: Volume, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The interval [0, inf) of rays cut to the volume, in long double, by textbook formulas."""
    o, d = o.astype(np.longdouble), d.astype(np.longdouble)
    t0, t1 = np.zeros(len(o), np.longdouble), np.full(len(o), np.inf, np.longdouble)
    for part in members(volume):
        if isinstance(part, Ball):
            oc = o - np.array(part.center)
            a, b = (d * d).sum(1), (oc * d).sum(1)
            across = oc - (b / a)[:, None] * d
            room = np.longdouble(part.radius) ** 2 - (across * across).sum(1)
            half = np.sqrt(np.maximum(room, 0) / a)
            t0 = np.maximum(t0, -b / a - half)
            t1 = np.where(room > 0, np.minimum(t1, -b / a + half), -np.inf)
            continue
        assert isinstance(part, Polytope)
        for *n, h in part.planes():
            room, speed = h - o @ np.array(n), d @ np.array(n)
            with np.errstate(divide="ignore", invalid="ignore"):
                t = room / speed
            t1 = np.where(speed > 0, np.minimum(t1, t), t1)
            t0 = np.where(speed < 0, np.maximum(t0, t), t0)
            t1 = np.where((speed == 0) & (room < 0), -np.inf, t1)
    return t0, t1


def excess(volume: Volume, x: np.ndarray) -> np.ndarray:
    """How far points lie outside, in the sense of the farthest plane or ball."""
    values = []
    for part in members(volume):
        if isinstance(part, Ball):
            values.append(np.linalg.norm(x - np.array(part.center), axis=1) - part.radius)
        else:
            assert isinstance(part, Polytope)
            rows = part.planes()
            values.append((x @ rows[:, :3].T - rows[:, 3]).max(axis=1))
    return np.max(values, axis=0)


def random_rays(
    rng: np.random.Generator, shift: np.ndarray, scale: float, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rays near the volume: inside and outside, grazing, along the axes, of any speed."""
    o = shift + scale * rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-1, 1.5, size=(n, 1))
    target = shift + scale * sphere_points(rng, n) * rng.uniform(0, 1.3, size=(n, 1))
    d = (target - o) * 10.0 ** rng.uniform(-2, 2, size=(n, 1))
    straight = rng.integers(0, 3, size=n)
    along_axis = np.eye(3)[straight] * np.sign(d[np.arange(n), straight])[:, None]
    d = np.where(rng.random((n, 1)) < 0.2, along_axis, d)
    o[: n // 10] = target[: n // 10]
    return o, d


@pytest.mark.few(5)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    log_scale=st.floats(-3, 3),
    log_distance=st.floats(-2, 4),
)
def test_clip_loses_nothing_and_adds_only_roundings(kind, precision, seed, log_scale, log_distance):
    rng = np.random.default_rng(seed)
    scale = 10.0**log_scale
    shift = scale * 10.0**log_distance * sphere_points(rng, 1)[0]
    volume = make_volume(kind, shift, scale)
    backend = hb.choose_backend(precision)
    o, d = random_rays(rng, shift, scale, 4000)
    origins, directions = hb.to_vector3(backend, o), hb.to_vector3(backend, d)
    o, d = (hb.to_numpy(v).astype(np.float64) for v in (origins, directions))
    t0, t1 = volume.upload(backend).clip(origins, directions, 0.0, dr.inf)
    t0, t1 = hb.to_numpy(t0).astype(np.float64), hb.to_numpy(t1).astype(np.float64)

    exact0, exact1 = exact_clip(volume, o, d)
    meets = exact0 < exact1
    assert (t0[meets] <= exact0[meets]).all()
    assert (t1[meets] >= exact1[meets]).all()

    hit = t0 < t1
    assert (t0[~hit] == np.inf).all()
    assert (t1[~hit] == -np.inf).all()
    size = np.abs(o).sum(axis=1) + np.linalg.norm(shift) + 3.0 * scale
    for t in (t0, t1):
        ends = hit & np.isfinite(t)
        at = o[ends] + t[ends, None] * d[ends]
        reach = size[ends] + t[ends] * np.abs(d[ends]).sum(axis=1)
        if kind in ("ball", "cut ball"):  # half the chord grows like the root of the slack
            reach = reach + np.sqrt(reach * scale)
        assert (excess(volume, at) <= 60.0 * EPS[precision] * reach).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_volume_need_not_be_prepared(kind):
    rng = np.random.default_rng(3)
    volume = make_volume(kind, np.array([0.5, -1.0, 2.0]), 1.5)
    backend = hb.choose_backend()
    o, d = random_rays(rng, np.array([0.5, -1.0, 2.0]), 1.5, 500)
    origins, directions = hb.to_vector3(backend, o), hb.to_vector3(backend, d)
    for plain, ready in zip(
        volume.clip(origins, directions, 0.0, dr.inf),
        volume.upload(backend).clip(origins, directions, 0.0, dr.inf),
        strict=True,
    ):
        np.testing.assert_allclose(hb.to_numpy(plain), hb.to_numpy(ready), rtol=1e-4)


def test_the_clip_keeps_the_given_interval():
    backend = hb.choose_backend()
    o, d = hb.to_vector3(backend, [[-3, 0, 0]]), hb.to_vector3(backend, [[1, 0, 0]])

    def clip(t_min, t_max):
        return [float(hb.to_numpy(t)[0]) for t in Ball().clip(o, d, t_min, t_max)]

    assert clip(0.0, dr.inf) == pytest.approx([2.0, 4.0], rel=1e-5)
    assert clip(2.5, 3.0) == [2.5, 3.0]
    assert clip(0.0, 1.9) == [np.inf, -np.inf]
    assert clip(4.1, 9.0) == [np.inf, -np.inf]
    assert clip(3.0, 3.0) == [np.inf, -np.inf]


def test_volumes_that_do_not_meet_leave_nothing():
    backend = hb.choose_backend()
    apart = VolumeIntersection([Ball((-2, 0, 0), 1.0), Ball((2, 0, 0), 1.0)])
    o, d = hb.to_vector3(backend, [[-9, 0, 0]]), hb.to_vector3(backend, [[1, 0, 0]])
    t0, t1 = apart.clip(o, d, 0.0, dr.inf)
    assert (hb.to_numpy(t0)[0], hb.to_numpy(t1)[0]) == (np.inf, -np.inf)
    lower, upper = apart.bounds()
    assert lower[0] > upper[0]


@pytest.mark.parametrize("points", [8, 60])
def test_clip_can_be_recorded_in_a_loop(points):
    """As an integrator does at each bounce; 60 points make a loop within a loop."""
    backend = hb.choose_backend()
    rng = np.random.default_rng(1)
    hull = ConvexHull.from_points(sphere_points(rng, points))
    assert (len(hull.normals) > MAX_UNROLLED) == (points == 60)
    o, d = random_rays(rng, np.zeros(3), 1.0, 300)
    origins, directions = hb.to_vector3(backend, o), hb.to_vector3(backend, d)
    for volume in (hull, hull.upload(backend)):

        def body(k, total, volume=volume):
            t0, t1 = volume.clip(origins, directions, 0.0, 1000.0)
            return k + 1, total + dr.select(t0 < t1, t1 - t0, 0.0)

        total = dr.while_loop(
            state=(backend.UInt32(0), dr.zeros(backend.Float, 300)),
            cond=lambda k, _: k < 3,
            body=body,
        )[1]
        t0, t1 = volume.clip(origins, directions, 0.0, 1000.0)
        once = hb.to_numpy(dr.select(t0 < t1, t1 - t0, 0.0))
        assert once.max() > 0
        np.testing.assert_allclose(hb.to_numpy(total), 3.0 * once, rtol=1e-5)


@pytest.mark.parametrize("kind", ["ball", "box", "half-space", "cut ball", "large hulls"])
def test_another_volume_of_the_kind_uses_the_same_kernel(kind):
    backend = hb.choose_backend()
    rng = np.random.default_rng(5)
    if kind == "large hulls":
        volumes: list[Volume] = [ConvexHull.from_points(sphere_points(rng, n)) for n in (50, 90)]
    else:
        volumes = [make_volume(kind, np.array([0.1, k, 0.3]), 1.0 + k) for k in (0.0, 1.5)]
    volumes = [v.upload(backend) for v in volumes]
    o, d = random_rays(rng, np.zeros(3), 1.0, 64)
    origins, directions = hb.to_vector3(backend, o), hb.to_vector3(backend, d)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        hashes = []
        for volume in volumes:
            dr.kernel_history_clear()
            dr.eval(volume.clip(origins, directions, 0.0, 9.0))
            hashes.append([entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])])
    assert len(hashes[0]) == 1
    assert hashes[0] == hashes[1]


@pytest.mark.few(15)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("kind", KINDS)
def test_contains_bounds_and_padding_agree(kind, precision):
    rng = np.random.default_rng(11)
    shift = np.array([30.0, -20.0, 5.0])
    volume = make_volume(kind, shift, 2.0)
    backend = hb.choose_backend(precision)
    x = shift + 4.0 * rng.normal(size=(20000, 3)) * rng.choice([0, 1e-8, 0.3, 1], size=(20000, 3))
    points = hb.to_vector3(backend, x)
    x = hb.to_numpy(points).astype(np.float64)
    outside = excess(volume, x)
    margin = 1e-4 if precision == "single" else 1e-12
    for inside in (
        volume.contains_points(x),
        hb.to_numpy(volume.contains(points)),
        hb.to_numpy(volume.upload(backend).contains(points)),
    ):
        assert inside[outside <= 0].all()
        assert not inside[outside > margin].any()
        assert 0 < inside.sum() < len(x)
    lower, upper = volume.bounds()
    inside = outside <= 0
    assert ((x[inside] >= lower) & (x[inside] <= upper)).all()
    moved = x[inside] + 0.7 * sphere_points(rng, int(inside.sum()))
    assert volume.padded(0.7).contains_points(moved).all()
    assert not volume.padded(0.7).contains_points(x[outside > 1.3]).any()
    signed = hb.to_numpy(volume.signed_distance(points))
    np.testing.assert_allclose(signed, outside, atol=margin)


@pytest.mark.parametrize("kind", KINDS)
def test_the_outward_normal_is_the_slope_of_the_distance(kind):
    backend = hb.choose_backend("double")
    rng = np.random.default_rng(2)
    shift = np.array([1.0, 2.0, 3.0])
    volume = make_volume(kind, shift, 1.0)
    x = shift + rng.normal(size=(500, 3))
    normal = hb.to_numpy(volume.outward_normal(hb.to_vector3(backend, x)))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-12)
    h = 1e-6
    slope = np.stack([(excess(volume, x + h * e) - excess(volume, x - h * e)) / (2 * h)
                      for e in np.eye(3)], axis=1)  # fmt: skip
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1.0) < 1e-6  # not at an edge
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(normal[smooth], slope[smooth], atol=1e-5)


def test_the_center_of_a_ball_has_a_normal_too():
    backend = hb.choose_backend()
    normal = hb.to_numpy(Ball().outward_normal(hb.to_vector3(backend, [[0, 0, 0]])))
    assert np.linalg.norm(normal) == 1.0


coordinate = st.one_of(st.integers(-3, 3).map(float), st.floats(-1e3, 1e3, width=32))


@settings(deadline=None)
@given(
    points=st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=2, max_size=12),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
)
def test_a_hull_holds_its_points_and_little_more(points, scale):
    x = scale * np.array(points)
    if len(np.unique(x, axis=0)) < 2:
        with pytest.raises(ValueError, match="two different points"):
            ConvexHull.from_points(x)
        return
    hull = ConvexHull.from_points(x)
    weights = np.random.default_rng(0).dirichlet(np.ones(len(x)), size=50)
    assert hull.contains_points(x).all()
    assert hull.contains_points(weights @ x).all()
    size = np.ptp(x, axis=0).max()
    np.testing.assert_allclose(np.linalg.norm(hull.normals, axis=1), 1.0, atol=1e-9)
    support = (x @ hull.normals.T).max(axis=0)
    assert (hull.offsets - support <= 1.1e-6 * size + 1e-14 * np.abs(x).max()).all()
    lower, upper = hull.bounds()
    assert (lower <= x.min(axis=0)).all()
    assert (x.max(axis=0) <= upper).all()
    center, far = x.mean(axis=0), 4.0 * size
    assert not hull.contains_points(
        center + far * sphere_points(np.random.default_rng(1), 200)
    ).any()


def test_a_hull_of_many_points_has_few_planes():
    x = sphere_points(np.random.default_rng(0), 6000)
    hull = ConvexHull.from_points(x)
    assert len(hull.normals) <= MAX_PLANES + 6
    assert hull.contains_points(x).all()
    assert not hull.contains_points(1.1 * x).any()


def test_coplanar_facets_become_one_plane():
    grid = np.linspace(-1, 1, 5)
    x = np.array([(a, b, c) for a in grid for b in grid for c in grid])
    assert len(ConvexHull.from_points(x).normals) == 6


def test_flat_and_straight_sets_get_thin_hulls():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    flat = ConvexHull.from_points(square)
    assert flat.contains_points([[0.5, 0.5, 0.0]])[0]
    assert not flat.contains_points([[0.5, 0.5, 1e-5], [1.00001, 0.5, 0.0]]).any()
    rod = ConvexHull.from_points(np.outer([0.0, 0.5, 2.0], [1.0, 1.0, 0.0]))
    assert rod.contains_points([[0.7, 0.7, 0.0]])[0]
    assert not rod.contains_points([[0.7, 0.7, 1e-4], [0.7, 0.71, 0], [2.1, 2.1, 0]]).any()


def test_the_offset_of_a_half_space_is_a_distance_whatever_the_length_of_its_normal():
    half_space = HalfSpace((0, 0, 2), 1.0)
    assert half_space == HalfSpace((0, 0, 1), 1.0)
    assert list(half_space.contains_points([[7, 8, 0.99], [7, 8, 1.01]])) == [True, False]
    assert half_space.padded(0.5).planes().tolist() == [[0.0, 0.0, 1.0, 1.5]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Ball(radius=0.0), "radius of a ball must be positive"),
        (lambda: Ball(radius=np.inf), "radius of a ball must be positive"),
        (lambda: Ball(radius=np.nan), "radius of a ball must be positive"),
        (lambda: Ball((0, 0)), "center of a ball must be three numbers"),
        (lambda: Ball(3.0), "center of a ball must be three numbers"),
        (lambda: Ball((0, 0, np.inf)), "center of a ball must be finite"),
        (lambda: Box((0, 0, 0), (1, -1, 1)), "lower <= upper"),
        (lambda: Box((0, 0, np.nan), (1, 1, 1)), "lower corner of a box must be finite"),
        (lambda: Box((np.inf, 0, 0), (np.inf, 1, 1)), "lower <= upper"),
        (lambda: HalfSpace((0, 0, 0), 1.0), "must not be zero"),
        (lambda: HalfSpace((0, 0, 1), np.inf), "offset of a half-space must be finite"),
        (lambda: VolumeIntersection([]), "at least one volume"),
        (lambda: Ball().padded(-1.0), "not negative"),
        (lambda: Ball().padded(np.nan), "not negative"),
        (lambda: ConvexHull.from_points(np.zeros((0, 3))), "at least two points"),
        (lambda: ConvexHull.from_points([[0, 0, 0], [0, 0, np.nan]]), "all of them finite"),
        (lambda: ConvexHull.from_points(np.zeros((4, 2))), r"shape \(n, 3\)"),
        (lambda: Ball().contains_points([0, 0, 0]), r"shape \(n, 3\)"),
    ],
)
def test_bad_volumes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
