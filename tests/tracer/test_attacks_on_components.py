"""Cases that attacks on largest components and sections found, kept as they were."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.rendering.placed_surface import PlacedSurface, Placement
from harnack.tracer import traced_surface

SPHERES = hk.Sphere(0.5, (-0.6, 0, 0)) | hk.Sphere(0.2, (2, 0, 0))
FROM_RIGHT = [[3.0, 0, 0]], [[-1.0, 0, 0]]


@pytest.mark.few(1)
@pytest.mark.parametrize(("radius", "power"), [(0.4, 2), (0.35, 3)])
def test_a_component_on_which_the_gradient_vanishes_is_no_larger_for_it(
    radius: float, power: int
) -> None:
    """The area was counted as often as the function vanishes there."""

    def product(x: Any, y: Any, z: Any) -> Any:
        small = (x - 0.6) ** 2 + y * y + z * z - radius**2
        return ((x + 0.6) ** 2 + y * y + z * z - 0.25) * small**power

    field = hk.expression(product, domain=hk.Ball(radius=1.5))
    assert hk.trace(field, *FROM_RIGHT, largest=True).t[0] == pytest.approx(3.1, abs=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("half", [0.005, 0.001, 1e-4])
def test_both_sides_of_a_thin_plate_are_no_smaller_than_one_of_a_thick_one(half: float) -> None:
    """Where both sides passed the same cells, one was left out of the area."""
    solid = hk.Cuboid((1.8, 1.8, 2 * half)).translated((-1, 0, 0)) | hk.Sphere(0.535, (0.7, 0, 0))
    o, d = [[-1, 0.1, 5], [0.7, 0, 5]], [[0, 0, -1.0]]
    assert hk.trace(solid, o, d, largest=True).is_hit.tolist() == [True, False]


@pytest.mark.few(3)
@pytest.mark.parametrize("largest", [True, np.True_, 64, np.int64(64)])
def test_surfaces_take_what_calls_take(largest: Any) -> None:
    """True was taken for one cell; NumPy's were refused."""
    surface = hk.Surface(SPHERES, 0.0, largest=largest)
    for hits in (
        hk.trace(surface, *FROM_RIGHT),
        hk.trace(SPHERES, *FROM_RIGHT, level=0.0, largest=largest),
    ):
        assert hits.t[0] == pytest.approx(3.1, abs=1e-3)
    assert hk.Surface(SPHERES, (0.0,), largest=largest).largest == surface.largest


@pytest.mark.parametrize(
    ("largest", "error"),
    [("x", TypeError), (8.0, TypeError), (None, TypeError), (-3, ValueError), (3, ValueError)],
)
def test_what_is_no_number_of_cells_is_refused(largest: Any, error: type[Exception]) -> None:
    with pytest.raises(error, match="from 8 to 512, not"):
        hk.Surface(SPHERES, (0.0,), largest=largest)
    with pytest.raises(error, match="from 8 to 512, not"):
        hk.trace(SPHERES, *FROM_RIGHT, largest=largest)


@pytest.mark.parametrize("name", ["clip", "section"])
@pytest.mark.parametrize("volume", [3, hk.HalfSpace])
def test_what_is_no_volume_is_refused(name: str, volume: Any) -> None:
    """A class of volumes passed for one."""
    with pytest.raises(TypeError, match=f"{name} must be a volume"):
        hk.Surface(SPHERES, (0.0,), **{name: volume})
    with pytest.raises(TypeError, match=f"{name} must be a volume"):
        hk.trace(SPHERES, *FROM_RIGHT, **{name: volume})


@pytest.mark.parametrize(
    "clip",
    [
        hk.Ball() & hk.Ball((5, 0, 0), 1),
        hk.Ball() & hk.HalfSpace((1, 0, 0), -3),
        hk.Box((0, 0, 1), (0, 0, 1)),
        hk.Box((0, 0, 0), (0, 0, 0)),
    ],
    ids=["balls", "half-space", "point", "origin"],
)
def test_clips_that_leave_nothing_are_missed(clip: hk.Volume) -> None:
    """They raised ValueError or OverflowError, of arrays."""
    hits = hk.trace(hk.Sphere(1.0), [[0, 0, 3.0]], [[0, 0, -1.0]], clip=clip, largest=True)
    assert hits.status.tolist() == [hk.RayStatus.MISS]


def test_cells_of_tiny_clips_do_not_fill_the_memory() -> None:
    clip = hk.Ball((0, 0, 1), 1e-12)
    hits = hk.trace(hk.Sphere(1.0), [[0, 0, 3.0]], [[0, 0, -1.0]], clip=clip, largest=True)
    assert hits.status.tolist() == [hk.RayStatus.OUT_OF_STEPS]  # cells as small as roundings


@pytest.mark.slow
def test_faces_of_solids_are_lost_where_rounding_leaves_open_which_component_it_is() -> None:
    """The face was met all the same, an eighth off."""
    backend = choose_backend("single")
    surface = traced_surface(
        SPHERES, level=0, side="below", largest=True, section=hk.HalfSpace((0, 0, 1), 0.01)
    )
    placed = PlacedSurface.of(surface, Placement.identity(), backend)
    o, d = to_vector3(backend, [[-0.6, 0, 1e5]]), to_vector3(backend, [[0, 0, -1.0]])
    seen = placed.intersect(o, d, backend.Float(1e6), backend.Bool(True))
    assert to_numpy(seen.is_hit).tolist() == [False]
    assert to_numpy(seen.is_out_of_steps).tolist() == [True]
    assert to_numpy(placed.occludes(o, d, backend.Float(1e6), backend.Bool(True))).all()


@pytest.mark.parametrize(
    ("normal", "offset", "expected"),
    [
        ((1e200, 0, 0), 1, (1, 0, 0, 1)),
        ((1e155, 1e155, 0), 0, (math.sqrt(0.5), math.sqrt(0.5), 0, 0)),
        ((1e-200, 0, 0), 0, (1, 0, 0, 0)),
        ((3e-162, 4e-162, 0), 0.2, (0.6, 0.8, 0, 0.2)),
    ],
)
def test_normals_of_any_length_become_unit(normal: Any, offset: float, expected: Any) -> None:
    """The first became all of space, the last was 0.6 % too long."""
    half_space = hk.HalfSpace(normal, offset)
    assert (*half_space.normal, half_space.offset) == pytest.approx(expected, rel=1e-15)
    assert not half_space.contains_points([[5, 0, 0]])[0]


def test_half_spaces_that_are_almost_across_an_axis_have_no_bounds() -> None:
    """The box left out points far off the axis."""
    half_space = hk.HalfSpace((1, 1e-9, 0), 0.0)
    assert half_space.contains_points([[1e-3, -1e7, 0]])[0]
    assert np.isinf(half_space.bounds()).all()
    assert hk.HalfSpace((0, -2, 0), 1.5).bounds()[0].tolist() == [-math.inf, -1.5, -math.inf]


@pytest.mark.parametrize(
    ("normal", "offset", "name"),
    [
        ("123", 0.2, "normal of a half-space must be three numbers"),
        (("a", 0, 0), 1, "normal of a half-space must be three numbers"),
        ((1, 0, 0), "0.5", "offset of a half-space must be a number"),
        ((1, 0, 0), None, "offset of a half-space must be a number"),
        ((1, 0, 0), [1, 2], "offset of a half-space must be a number"),
    ],
)
def test_messages_say_which_number_of_a_half_space(normal: Any, offset: Any, name: str) -> None:
    with pytest.raises((TypeError, ValueError), match=name):
        hk.HalfSpace(normal, offset)
