"""The scripts of examples/ run as they stand, small, and find what they say."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import harnack as hk
from tests.oracles.mesh_files import read_closed

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SMALL = (64, 48)


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_is_tested() -> None:
    source = Path(__file__).read_text(encoding="utf-8")
    for script in EXAMPLES.glob("*.py"):
        assert f'example("{script.stem}")' in source


@pytest.mark.slow
def test_the_surface_of_a_trefoil_is_a_torus_with_a_hole(tmp_path: Path) -> None:
    assert example("spanning_surface").main(tmp_path, SMALL) == -1
    assert (tmp_path / "spanning_surface.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_hollow_part_can_be_printed(tmp_path: Path) -> None:
    check = example("hollow_part").main(tmp_path, SMALL)
    assert check.is_printable
    assert check.problems == ()  # one part, and no cavity without a way out
    read_closed(tmp_path / "hollow_part.stl")


@pytest.mark.slow
def test_a_broken_mesh_is_made_whole(tmp_path: Path) -> None:
    whole = example("repaired_mesh").main(tmp_path, SMALL)
    assert whole.is_watertight
    assert whole.metadata["harnack"]["holes"] == 2
    read_closed(tmp_path / "repaired_mesh.stl")


@pytest.mark.slow
def test_a_gyroid_part_fills_what_its_walls_do(tmp_path: Path) -> None:
    # Between -w and w the gyroid fills about 2 w/3.09 of its cell, less the cut.
    assert example("gyroid_part").main(tmp_path, SMALL, tolerance=2e-2) == pytest.approx(
        0.23, abs=0.01
    )
    read_closed(tmp_path / "gyroid_part.stl")


@pytest.mark.slow
def test_parts_to_print_are_closed_and_of_the_volume_that_their_formulas_say(
    tmp_path: Path,
) -> None:
    module = example("printed_parts")
    volumes = module.main(tmp_path, SMALL, 0.03, ("nut", "plate"))
    for name in volumes:
        read_closed(tmp_path / f"{name}.stl")
    # A hexagon less a hole, whose thread is between its minor and its major diameter.
    hexagon, hole = 6.5 * 0.5 * math.sqrt(3) * 13**2, 6.5 * 0.25 * math.pi
    assert hexagon - hole * 8.3**2 < volumes["nut"] < hexagon - hole * 6.6**2


@pytest.mark.slow
def test_a_cloud_is_near_what_it_was_taken_from(tmp_path: Path) -> None:
    assert example("point_cloud").main(tmp_path, SMALL, count=2000) < 0.005


@pytest.mark.slow
def test_a_field_of_ones_own_is_hit_where_its_formula_says(tmp_path: Path) -> None:
    module = example("own_field")
    z = module.main(tmp_path, SMALL)
    value = sum(
        np.log((r + length) / (r - length))
        for start, end in module.tetrahedron().segments
        for length in [np.linalg.norm(np.subtract(start, end))]
        for r in [sum(np.linalg.norm(np.subtract([0.05, 0.1, z], p)) for p in (start, end))]
    )
    assert value == pytest.approx(12.0, abs=5e-3)


@pytest.mark.slow
def test_sharper_proofs_take_fewer_evaluations(tmp_path: Path) -> None:
    work = example("comparing_bounds").main(tmp_path, SMALL)
    assert work["classic"] > 8 * work["slope"]
    assert work["slope"] > work["caps"] > work["default"]


@pytest.mark.slow
def test_a_material_of_ones_own_colors_a_surface(tmp_path: Path) -> None:
    picture = example("mitsuba_scene").main(tmp_path, SMALL, spp=4)
    red, green, blue = np.asarray(picture)[24, 24]  # the knot; all else is gray
    assert blue > 1.1 * green
    assert red > 1.1 * green


@pytest.mark.slow
def test_a_film_has_its_frames(tmp_path: Path) -> None:
    from PIL import Image

    film = example("film").main(tmp_path, SMALL, frames=4)
    with Image.open(film) as opened:
        assert opened.n_frames == 4


@pytest.mark.slow
def test_a_curve_is_found_in_three_masks(tmp_path: Path) -> None:
    assert example("fitted_curve").main(tmp_path, (24, 18), steps=12, n=16) < 0.07  # 0.12 before


@pytest.mark.slow
def test_numbers_of_shapes_are_found_in_pictures(tmp_path: Path) -> None:
    module = example("fitted_shapes")
    fit = module.FITS["part"]
    path = fit.run(24, 12)
    before, after = (np.abs(x - fit.truth).sum() for x in (path[0], path[-1]))
    assert after < 0.7 * before


@pytest.mark.slow
def test_points_are_found_in_pictures(tmp_path: Path) -> None:
    before, after = example("fitted_points").main(tmp_path, (24, 24), steps=6, n=100)
    assert after < 0.8 * before


@pytest.mark.slow
def test_a_trefoil_is_found_in_masks_and_other_knots_are_told_apart(tmp_path: Path) -> None:
    module = example("fitted_knot")
    determinant, error = module.main(tmp_path, (24, 18), steps=12, n=24)
    assert determinant == 3
    assert error < 0.06
    curves = hk.geometry.example_curves
    assert module.knot_determinant(curves.regular_polygon(20)) == 1
    assert module.knot_determinant(curves.figure_eight_knot(60)) == 5
    assert module.knot_determinant(curves.torus_knot(2, 5, 60)) == 5
    assert module.knot_determinant(curves.torus_knot(2, 7, 80)) == 7
