"""Antialiasing by cones: what they find, and what the pictures then show."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend
from harnack.geometry import example_meshes
from harnack.rendering import Camera, mitsuba_shape, register, render
from harnack.rendering.shaded_render import inner_and_outer_ball
from harnack.rendering.shading import StudioLight
from harnack.tracer import traced_surface
from harnack.tracer.pixel_cones import PixelCones

mi = register()
T = mi.ScalarTransform4f
N = 48
AWAY = 4.0
PIXEL = 2 * np.tan(np.radians(10)) / N
RADIUS = 0.01


def covered(what: Any, o: Any, d: Any, precision: str = "single", **settings: Any) -> np.ndarray:
    """Which cones of radius 0.01 at a distance of 4 a level set covers in part."""
    backend = choose_backend(precision)
    surface = traced_surface(what, **settings)
    prepared = surface.tracer(backend, crosses=True)
    kind = np.float32 if precision == "single" else np.float64
    rays = (backend.Array3f(np.asarray(a, dtype=kind).T.copy()) for a in np.broadcast_arrays(o, d))
    around = inner_and_outer_ball(surface.volume, backend)
    found, _ = PixelCones(prepared, *rays, backend.Float(RADIUS / AWAY), around).partially_covered(
        backend.Float(dr.inf), backend.Bool(True)
    )
    return np.array(found)


def beside(heights: np.ndarray) -> np.ndarray:
    return np.stack([np.full_like(heights, -AWAY), heights, np.zeros_like(heights)], axis=-1)


BALLS = {
    "distance": hk.Sphere(1.0),
    "polynomial": hk.expression(
        lambda x, y, z: x * x + y * y + z * z - 1, domain=hk.Ball(radius=2)
    ),
    "blob": hk.Blobs([(0.0, 0.0, 0.0)], 1.0, kernel="gaussian"),
}


@pytest.mark.few(4)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", ["distance", "polynomial", "blob"])
def test_cones_find_the_outline_of_a_ball_and_nothing_else(name: str, precision: str) -> None:
    field = BALLS[name]
    edge = hk.trace(field, [(-AWAY, 0, 0)], [(1.0, 0, 0)]).position[0, 0]
    heights = np.linspace(0, abs(edge) + 0.05, 400)
    off = (heights - abs(edge)) / RADIUS
    found = covered(field, beside(heights), (1.0, 0.0, 0.0), precision)
    assert found[np.abs(off) < 0.93].all()  # to first order
    assert not found[np.abs(off) > 1.07].any()


@pytest.mark.parametrize("thin", [0.3, 1e-2, 1e-3])
def test_no_wire_is_overlooked(thin: float) -> None:
    wire = hk.Tube(np.array([(0.0, -1, -1), (0, 1, 1)]), thin * RADIUS)
    heights = np.linspace(-0.5, 0.5, 801)
    found = covered(wire, beside(heights), (1.0, 0.0, 0.0), tolerance=1e-3 * thin * RADIUS)
    away = np.abs(heights) / np.sqrt(2) / RADIUS - thin
    assert found[away < 0.95].all()
    assert not found[away > 1.07].any()


FLAT = (hk.Cuboid((1.0, 1.0, 0.002)), hk.solids.Superellipsoid((1.0, 1.0), (1, 1, 0.02)))


@pytest.mark.parametrize("solid", FLAT)
def test_cones_widen_along_the_way(solid: Any) -> None:
    """Beside flat solids f hardly changes: one step led past all of them, and the cone, wider there
    than where it was looked at, had reached them unseen."""
    heights = np.linspace(0, 0.05, 401)
    o = np.stack([np.full_like(heights, -AWAY), np.full_like(heights, 0.01), heights], axis=-1)
    t = np.linspace(3, 5, 2001)[:, None]
    over = solid.formula(t - AWAY, 0.01 + 0 * heights, heights)
    off = (over / (RADIUS * t / AWAY)).min(axis=0)
    touched = (over.min(axis=0) > 0) & (off < 0.93)
    assert touched.sum() > 10
    assert covered(solid, o, (1.0, 0.0, 0.0))[touched].all()


def test_what_is_covered_altogether_is_not_found() -> None:
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    rng = np.random.default_rng(3)
    o = np.column_stack([np.full(4000, -AWAY), rng.uniform(-0.6, 0.6, (4000, 2))])
    found = covered(gyroid, o, (1.0, 0.0, 0.0))
    assert found.mean() < 0.2
    assert found.any()


@pytest.fixture
def black(monkeypatch: pytest.MonkeyPatch) -> None:
    """Surfaces are black: on a sky of one, pictures show how much of a pixel is free."""
    monkeypatch.setattr(StudioLight, "shade", lambda _, color, *others: color * 0)


def drawn(what: Any, **settings: Any) -> np.ndarray:
    """How much of each pixel is covered."""
    look = T().look_at(origin=[AWAY, 0, 0], target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": N, "height": N}
    scene = {
        "type": "scene", "sky": {"type": "constant"}, "what": mitsuba_shape(what),
        "sensor": {"type": "perspective", "fov": 20, "to_world": look, "film": film},
    }  # fmt: skip
    image = render(scene, show="shaded", progress=False, **settings)
    return 1 - image[..., 0]


def exact(inside: Any) -> np.ndarray:
    """The covered part of pixels, from 32 x 32 directions in each; z falls with the row."""
    place = ((np.arange(32 * N) + 0.5) / 32 - N / 2) * PIXEL
    y, z = np.meshgrid(place, -place)
    return inside(y, z).reshape(N, 32, N, 32).mean(axis=(1, 3))


@pytest.mark.usefixtures("black")
def test_a_ball_covers_as_much_of_each_pixel_as_it_should() -> None:
    radius = 0.5 + 1e-3
    image = drawn(traced_surface(hk.Sphere(radius), tolerance=1e-5), antialias="cones", spp=64)
    slope = radius / np.sqrt(AWAY**2 - radius**2)
    truth = exact(lambda y, z: np.hypot(y, z) < slope)
    assert 0.1 < truth.mean() < 0.9
    np.testing.assert_allclose(image, truth, atol=0.06)
    assert np.sqrt(np.mean((image - truth)[(truth > 0) & (truth < 1)] ** 2)) < 0.02
    less, more = (exact(lambda y, z, k=k: np.hypot(y, z) < k * slope) for k in (0.998, 1.002))
    inside = (less == 1) | (more == 0)
    once = drawn(traced_surface(hk.Sphere(radius), tolerance=1e-5), spp=1)
    np.testing.assert_array_equal(image[inside], once[inside])


@pytest.mark.usefixtures("black")
def test_a_half_space_covers_as_much_of_each_pixel_as_it_should() -> None:
    tilt, height = np.array([0.0, 0.35, 1.0]) / np.hypot(0.35, 1.0), 0.0137
    half = hk.solids.Plane(tilt, height) & hk.solids.Plane((1.0, 0.0, 0.0), 0.0)
    edge = traced_surface(half, clip=hk.Ball(radius=2.0), tolerance=1e-5)
    image = drawn(edge, antialias="cones", spp=64)
    truth = exact(lambda y, z: AWAY * (tilt[1] * y + tilt[2] * z) < height)
    assert ((truth > 0) & (truth < 1)).sum() > 0.9 * N
    np.testing.assert_allclose(image, truth, atol=0.05)


@pytest.mark.usefixtures("black")
@pytest.mark.parametrize("thin", [0.25, 0.05])
def test_wires_thinner_than_a_pixel_are_lines(thin: float) -> None:
    """A wire that is `thin` pixels wide covers that much of each column, more so as it slants."""
    slant = 0.23
    ends = np.array([(0.0, -1.0, -slant), (0.0, 1.0, slant)])
    wire = traced_surface(hk.Tube(ends, thin * PIXEL * AWAY / 2), tolerance=1e-6)
    expected = thin * np.hypot(1, slant)
    columns = drawn(wire, antialias="cones", spp=144).sum(axis=0)
    assert columns.min() > 0.5 * expected  # none is broken
    assert columns.mean() == pytest.approx(expected, rel=0.05)
    broken = drawn(wire, antialias="edges", spp=144).sum(axis=0)
    assert (broken == 0).any()


@pytest.mark.slow
@pytest.mark.usefixtures("black")
def test_a_turned_plate_seen_on_edge_is_a_line() -> None:
    """Its hull is thin and the box around that is not: cones that passed it were cut away."""
    plate = hk.Cuboid((0.6, 1.0, 0.002)).rotated(20, "x")
    columns = drawn(traced_surface(plate, tolerance=1e-5), antialias="cones", spp=64).sum(axis=0)
    middle = columns[12:-12]
    assert middle.min() > 0.5 * np.median(middle)


@pytest.mark.slow
@pytest.mark.usefixtures("black")
def test_what_hides_a_wire_hides_it_from_cones() -> None:
    ends = np.array([(-1.0, -0.3, 0.01), (-1.0, 0.3, 0.02)])
    both = traced_surface(hk.Tube(ends, 1e-4) | hk.Sphere(0.5), tolerance=1e-5)
    alone = traced_surface(hk.Sphere(0.5), tolerance=1e-5)
    images = [drawn(one, antialias="cones", spp=9) for one in (both, alone)]
    np.testing.assert_allclose(images[0], images[1], atol=0.02)


def small(what: Any, **settings: Any) -> np.ndarray:
    return render(what, **{"size": (32, 24), "show": "shaded", "progress": False, **settings})


@pytest.mark.slow
def test_edges_are_the_default() -> None:
    ball = hk.Sphere(1.0)
    np.testing.assert_array_equal(small(ball), small(ball, antialias="edges"))


@pytest.mark.slow
def test_several_surfaces_and_solids_are_found() -> None:
    ring = np.linspace(0, 2 * np.pi, 40)
    wire = hk.Tube(np.column_stack([np.cos(ring), np.sin(ring), 0 * ring]), 2e-3)
    camera = Camera(elevation=60)
    painted = ["clay", "plastic"]  # of clay, the wire is as bright as the ground
    settings: dict[str, Any] = {"camera": camera, "spp": 64, "material": painted}
    gyroid = traced_surface(
        hk.Gyroid(1.0, domain=hk.Ball(radius=0.6)),
        level=(-0.3, 0.3),
        side="between",
        tolerance=2e-4,
    )
    what = [gyroid, traced_surface(wire, tolerance=2e-5)]
    found, edges = small(what, antialias="cones", **settings), small(what, **settings)
    fine = small(what, size=(32 * 8, 24 * 8), spp=16, antialias="cones", camera=camera,
                 material=painted).reshape(24, 8, 32, 8, 3).mean(axis=(1, 3))  # fmt: skip
    error = [float(np.sqrt(np.mean((image - fine) ** 2))) for image in (found, edges)]
    assert error[0] < 0.7 * error[1]


def test_wrong_use_is_said_early() -> None:
    ball = hk.Sphere(1.0)
    with pytest.raises(ValueError, match="antialias must be one of edges, cones, not 'cone'"):
        small(ball, antialias="cone")
    with pytest.raises(ValueError, match='antialias needs a picture with show="shaded"'):
        small(ball, antialias="cones", show="depth")
    with pytest.raises(ValueError, match="spp is 1: give spp=9"):
        small(ball, antialias="cones", spp=1)
    with pytest.raises(ValueError, match="takes fields without jumps"):
        small(hk.WindingNumber(*example_meshes.icosphere(1)), antialias="cones")
