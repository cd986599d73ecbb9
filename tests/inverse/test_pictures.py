"""Pictures with derivatives: what they show, and their derivatives against formulas and against
differences of pictures with common random numbers."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array3f, Array3f64, Float, Float64, TensorXf, TensorXf64, UInt32

import harnack as hk
from harnack.backend import choose_backend
from harnack.backend.arrays import upload_floats
from harnack.inverse.boundary_motion import BoundaryKind, boundary_motion
from harnack.inverse.film import Film
from tests.backend.test_kernels import compiled

pytestmark = pytest.mark.skipif(choose_backend().name != "llvm", reason="types of the CPU")

CAMERA = hk.Camera(position=(2.2, -2.2, 1.6), target=(0, 0, 0), fov=40)
DISTANCE = float(np.linalg.norm([2.2, -2.2, 1.6]))
LOOP = hk.geometry.example_curves.wavy_polygon(12)
CUBE = hk.Cuboid((0.6, 0.6, 0.6))


def disk_share(radius: float) -> float:
    """The part of the picture that a ball at the middle covers."""
    slope = np.tan(np.arcsin(radius / DISTANCE)) / np.tan(np.radians(20))
    return np.pi * slope**2 / 4


def lifted_loop(height: Any) -> Any:
    """A curve with one vertex lifted, as numbers or, by a Dr.Jit height, as a Dr.Jit vector."""
    if dr.is_array_v(type(height)):
        lift = dr.select(dr.arange(UInt32, 12) == 3, height, 0.0)
        return Array3f64(LOOP.T) + Array3f64(0, 0, 1) * lift
    return LOOP + np.where(np.arange(12) == 3, height, 0.0)[:, None] * [0, 0, 1]


def derivative(make: Callable[..., Any], x0: float, seeds: range, **settings: Any) -> np.ndarray:
    """The derivatives of mean colors by a number, one for each seed."""
    results: list[float] = []
    for seed in seeds:
        x = Float64(x0)
        dr.enable_grad(x)
        field, keywords = make(x)
        image = hk.picture(field, camera=CAMERA, seed=seed, **settings, **keywords)
        dr.backward(dr.mean(image, axis=None))
        results.append(float(dr.grad(x)[0]))
    return np.array(results)


def difference(
    make: Callable[..., Any], x0: float, h: float, seeds: range, **settings: Any
) -> np.ndarray:
    """Central differences of mean colors."""
    results: list[float] = []
    for seed in seeds:
        means: list[float] = []
        for x in (x0 + h, x0 - h):
            field, keywords = make(x)
            settings |= {"camera": CAMERA, "seed": seed, "precision": "double"}
            means.append(float(hk.picture(field, **settings, **keywords).mean()))
        results.append((means[0] - means[1]) / (2 * h))
    return np.array(results)


def test_mask_of_a_ball_and_its_derivative() -> None:
    make = lambda r: (hk.Sphere(r), {})  # noqa: E731
    image = hk.picture(hk.Sphere(0.7), camera=CAMERA, size=64, show="mask")
    assert image.shape == (64, 64, 1)
    assert image.dtype == np.float32
    # Pixels at the outline are covered in part, so the error is far below that of single rays.
    assert image.mean() == pytest.approx(disk_share(0.7), abs=6e-4)  # hits within 1e-4
    assert ((image > 0) & (image < 1)).mean() == pytest.approx(0.03, abs=0.02)
    exact = (disk_share(0.7 + 1e-5) - disk_share(0.7 - 1e-5)) / 2e-5
    slopes = derivative(make, 0.7, range(3), size=64, show="mask")
    assert slopes.mean() == pytest.approx(exact, rel=0.005)


CASES: dict[str, tuple[Callable[..., Any], float, float]] = {
    "a curve by a vertex": (lambda h: (hk.SolidAngle(lifted_loop(h)), {}), 0.0, 0.02),
    "a curve by its level": (lambda c: (hk.SolidAngle(LOOP), {"level": c}), 2 * np.pi, 0.05),
    "a ball by its radius": (lambda r: (hk.Sphere(r), {}), 0.7, 0.01),
    "a box by a side": (
        lambda s: (hk.Cuboid((1.2, s, 0.8)).rotated(20, (1, 2, 3)), {}), 1.0, 0.01,
    ),
    "a union by a translation": (
        lambda x: (hk.Sphere(0.5) | CUBE.translated((x, 0.1, 0.3)), {}), 0.4, 0.01,
    ),
    "a blend by its radius": (
        lambda b: (hk.Sphere(0.5).blended(CUBE.translated((0.4, 0.1, 0.3)), b), {}), 0.2, 0.02,
    ),
    "a cut torus": (
        lambda r: (hk.Torus(r, 0.25), {"clip": hk.HalfSpace((0.3, 1, 0.2), 0.0)}), 0.7, 0.01,
    ),
    "a formula in a box": (
        lambda a: (
            hk.expression(
                lambda x, y, z, a: hk.math.sin(3 * x) * hk.math.cos(3 * y) + a * z, a=a,
                domain=hk.Box((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)),
            ),
            {"level": 0.0},
        ),
        1.0, 0.02,
    ),
    "a sum by a weight": (
        lambda w: (
            hk.fields.FieldSum([hk.SphericalHarmonic(2, 0), hk.SphericalHarmonic(3, 1)], [2.0, w]),
            {"level": 0.3},
        ),
        0.5, 0.02,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("name", "show"),
    [(name, show) for name in CASES for show in ("mask", "shaded")]
    + [(name, show) for name in list(CASES)[:3] for show in ("depth", "normals")],
)
def test_derivatives_agree_with_differences(name: str, show: str) -> None:
    """Within three standard deviations of both, and a percent for what pictures leave out."""
    make, x0, h = CASES[name]
    slopes = derivative(make, x0, range(12), size=64, show=show)
    expected = difference(make, x0, h, range(4), size=128, samples=2, show=show)
    error = slopes.mean() - expected.mean()
    deviation = np.hypot(slopes.std() / 12**0.5, expected.std() / 4**0.5)
    assert abs(error) < 3 * deviation + 0.01 * abs(expected.mean()) + 5e-4
    # The deviation itself is small, so that the comparison says something.
    assert deviation < 0.03 * abs(expected.mean()) + 2e-3


def test_ends_of_level_sets_move_with_vertices() -> None:
    make, x0, _ = CASES["a curve by a vertex"]
    slopes = derivative(make, x0, range(4), size=48, show="mask")
    assert slopes.mean() == pytest.approx(0.0409, rel=0.05)  # by differences of fine pictures


def test_what_is_seen_inside() -> None:
    """Depths and normals of a sphere, and colors of a function of hits, in single precision."""
    sphere = hk.Sphere(0.7)
    view: dict[str, Any] = {"camera": CAMERA, "size": 33, "seed": None}
    assert hk.picture(sphere, show="depth", **view)[16, 16, 0] == pytest.approx(
        DISTANCE - 0.7, abs=2e-4
    )
    normal = hk.picture(sphere, show="normals", **view)[16, 16]
    np.testing.assert_allclose(normal, np.array([2.2, -2.2, 1.6]) / DISTANCE, atol=1e-6)
    # The surface of a curve shows normals on the side of the camera, from both sides.
    for z in (3.0, -3.0):
        camera = hk.Camera(position=(0.1, 0.2, z), target=(0, 0, 0), fov=40)
        image = hk.picture(hk.SolidAngle(LOOP), show="normals", camera=camera, size=17)
        assert np.sign(z) * image[8, 8, 2] > 0.5
    image = hk.picture(sphere, show=lambda hits: hits.position.z, background=-1.0, **view)
    assert image.shape == (33, 33, 1)
    assert image[0, 0, 0] == -1
    assert image[16, 16, 0] == pytest.approx(0.7 * 1.6 / DISTANCE, abs=1e-4)
    up = hk.picture(sphere, show="shaded", light=(0, 0, 1), **view)[16, 16, 0]
    assert up == pytest.approx(0.2 + 0.8 * 1.6 / DISTANCE, abs=1e-6)


@pytest.mark.slow
def test_the_mean_over_seeds_is_that_of_many_rays() -> None:
    """Smoothing at jumps leaves means as they are, also of wires thinner than a pixel."""
    wires = hk.union(
        [hk.Capsule((-1, 0.2 * k, 0.1 * k), (1, 0.2 * k + 0.1, 0), 0.012) for k in range(-1, 2)]
    )
    view: dict[str, Any] = {"camera": CAMERA, "show": "mask"}
    means = [hk.picture(wires, size=24, seed=k, **view).mean() for k in range(30)]
    fine = np.mean([hk.picture(wires, size=96, samples=3, seed=k, **view).mean() for k in (0, 1)])
    deviation = np.std(means) / 30**0.5
    assert abs(np.mean(means) - fine) < 3.5 * deviation + 2e-4
    assert deviation < 0.1 * fine


@pytest.mark.slow
def test_colors_and_boundaries_both_count() -> None:
    """The mean of the shaded picture of a plate by the direction of a translation: parallel to
    itself only its edges move."""
    plate = hk.Cuboid((1.0, 1.0, 0.02))

    def make(x: Any) -> tuple[Any, dict[str, Any]]:
        return plate.translated((x, 0.0, 0.0)), {"light": (0, 0, 1)}

    slopes = derivative(make, 0.2, range(4), size=48)
    expected = difference(make, 0.2, 0.02, range(2), size=96, samples=2)
    assert slopes.mean() == pytest.approx(expected.mean(), abs=0.01)


def test_tensors_keep_their_precision() -> None:
    for number, kind in ((Float(0.7), TensorXf), (Float64(0.7), TensorXf64)):
        dr.enable_grad(number)
        image = hk.picture(hk.Sphere(number), camera=CAMERA, size=(24, 16), show="mask")
        assert isinstance(image, kind)
        assert image.shape == (16, 24, 1)
        dr.backward(dr.sum(image, axis=None))
        assert dr.grad(number)[0] > 100
    vertices = Array3f(LOOP.T)
    dr.enable_grad(vertices)
    image = hk.picture(hk.SolidAngle(vertices), camera=CAMERA, size=24, show="mask")
    dr.backward(dr.sum(image, axis=None))
    assert np.abs(dr.grad(vertices).numpy()).max() > 1
    # No derivatives are asked for, and the parameters are Dr.Jit arrays.
    plain = hk.picture(hk.SolidAngle(Array3f(LOOP.T)), camera=CAMERA, size=8, show="mask")
    assert isinstance(plain, TensorXf)


def moved_solid(k: int) -> tuple[list[Any], Any]:
    radius = Float64(0.5 + 0.01 * k)
    dr.enable_grad(radius)
    return [radius], hk.Sphere(radius) | hk.Cuboid((0.5, 0.5, 0.9))


def aligned(numbers: np.ndarray) -> TensorXf64:
    """A tensor in memory of Dr.Jit: of a NumPy array it takes the memory, and compiles other
    kernels where this begins at other addresses."""
    return TensorXf64(upload_floats(choose_backend("double"), numbers.ravel()), numbers.shape)


def moved_curve(k: int) -> tuple[list[Any], Any]:
    vertices = aligned(LOOP * (1 + 0.02 * k))
    dr.enable_grad(vertices)
    return [vertices], hk.SolidAngle(vertices)


def moved_points(k: int) -> tuple[list[Any], Any]:
    points = hk.geometry.example_meshes.icosphere(1)[0]
    numbers = [aligned(a) for a in (0.6 * points * (1 + 0.02 * k), points, np.full(42, 0.1))]
    dr.enable_grad(numbers)
    return numbers, hk.DipolePotential(*numbers, smoothing=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("make", [moved_solid, moved_curve, moved_points])
def test_a_step_of_an_optimization_compiles_nothing(make: Any) -> None:
    def step(k: int) -> None:
        numbers, field = make(k)
        image = hk.picture(field, camera=CAMERA, size=24, seed=k)
        dr.backward(dr.mean(image, axis=None))
        dr.eval(dr.grad(numbers))

    for k in range(3):
        step(k)
    assert compiled(lambda: [step(k) for k in (3, 4)]) == 0


@pytest.mark.slow
def test_kinds_of_boundaries() -> None:
    """A cut cylinder on a plate has outlines, creases, edges and cuts."""
    seen: set[int] = set()

    def kinds(jumps: Any, *others: Any) -> Any:
        motion = boundary_motion(jumps, *others)
        seen.update(motion.kind.tolist())
        return motion

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("harnack.inverse.drawing.boundary_motion", kinds)
        solid = hk.Cylinder(0.3, 1.2) | hk.Cuboid((1, 1, 0.2)).translated((0, 0, -0.6))
        hk.picture(solid, camera=CAMERA, size=48, clip=hk.HalfSpace((1, 0, 0), 0.2))
        hk.picture(hk.SolidAngle(LOOP), camera=CAMERA, size=24)
    assert seen >= {int(kind) for kind in BoundaryKind if kind.name not in ("UNKNOWN", "SHADOW")}


def test_screen_and_space() -> None:
    film = Film.of(CAMERA, (40, 30), None)
    screen = np.random.default_rng(0).uniform(0, 30, (50, 2))
    points = film.origin + 3.0 * film.directions(screen)
    rows = film.jacobian(points)
    for k in range(3):
        shift = 1e-6 * np.eye(3)[k]
        ahead, back = (film.directions(screen + s * 1e-6 * rows[:, :, k]) for s in (1, -1))
        for sign, expected in ((1, ahead), (-1, back)):
            moved = points + sign * shift - film.origin
            moved /= np.linalg.norm(moved, axis=1, keepdims=True)
            np.testing.assert_allclose(moved, expected, atol=1e-11)


def test_what_cannot_be_done_is_refused() -> None:
    x = Float64(0.7)
    dr.enable_grad(x)
    sphere = hk.Sphere(x)
    small: dict[str, Any] = {"camera": CAMERA, "size": 16}
    with pytest.raises(ValueError, match="the camera moves with the surface"):
        hk.picture(sphere, size=16)
    hk.picture(sphere, size=16, camera=hk.Camera(box=hk.Box((-1, -1, -1), (1, 1, 1))))
    checks = lambda hits: dr.select(dr.sin(30 * hits.position.z) > 0, 1.0, 0.0)  # noqa: E731
    hk.picture(hk.Sphere(0.7), show=checks, **small)  # without derivatives
    with pytest.raises(NotImplementedError, match="no known kind of boundary"):
        hk.picture(sphere, show=checks, **small)
    vertices, faces = hk.geometry.example_meshes.icosphere(1)
    level = Float64(0.5)
    dr.enable_grad(level)
    with pytest.raises(NotImplementedError, match="made of facets or patches"):
        hk.picture(hk.WindingNumber(vertices, faces), level=level, **small)
    for wrong, message in (
        ({"show": "shadded"}, "did you mean"),
        ({"show": 3}, "a name or a function"),
        ({"size": (3, 4, 5)}, "width, height"),
        ({"size": 0}, "size"),
        ({"samples": 0}, "samples"),
        ({"seed": -1}, "seed"),
        ({"camera": "front"}, "harnack.Camera"),
        ({"light": (0, 0, 0)}, "light must be a direction"),
        ({"background": (1.0, 2.0)}, "background has 2 numbers"),
        ({"background": "blue"}, "background"),
        ({"precision": "single"}, "parameters are in double"),
        ({"backend": "webgpu"}, "picture has no backend"),
        ({"side": "below"}, "picture has no side"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            hk.picture(sphere, **{**small, **wrong})
    with pytest.raises(ValueError, match="reaches to infinity"):
        hk.picture(hk.expression("z - x*y"), size=8)


def test_surfaces_of_facets_and_patches_are_drawn() -> None:
    vertices, faces = hk.geometry.example_meshes.icosphere(2)
    mask = hk.picture(hk.WindingNumber(vertices, faces), camera=CAMERA, size=32, show="mask")
    assert mask.mean() == pytest.approx(disk_share(1.0), rel=0.05)
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.3], [0, 1, 0]])
    mesh = hk.PolygonMesh(square, [[0, 1, 2, 3]])
    camera = hk.Camera(position=(0.5, 0.5, 3.0), target=(0.5, 0.5, 0), fov=40)
    assert hk.picture(mesh, camera=camera, size=16, show="mask")[8, 8, 0] == 1


def test_lost_rays_are_told() -> None:
    with pytest.warns(UserWarning, match="ran out of steps and show the background"):
        hk.picture(hk.SolidAngle(LOOP), camera=CAMERA, size=8, max_steps=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hk.picture(hk.SolidAngle(LOOP), camera=CAMERA, size=8)
