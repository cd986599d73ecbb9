"""The paper's figures: all of them are made, and the page shows those that are."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import harnack as hk
from figures.figure import Figure, Report
from figures.page import picture_name, sections, write
from figures.published import Claim, claimed_angle, published
from figures.registry import FIGURES
from figures.view import View, mesh_hits
from harnack.geometry import example_curves, example_meshes

PAGE = Path(__file__).resolve().parents[2] / "docs" / "figures.md"
# Those that show a result.
OF_THE_PAPER = [1, 4, 5, *range(7, 10), *range(11, 18), *range(19, 28)]


def test_every_figure_is_there_once() -> None:
    assert sorted(FIGURES) == OF_THE_PAPER
    assert all(number == one.number for number, one in FIGURES.items())
    assert len({one.make for one in FIGURES.values()}) == len(FIGURES)


def test_the_page_shows_the_figures() -> None:
    shown = sections(PAGE)
    assert list(shown) == OF_THE_PAPER
    folder = PAGE.parent / "images" / "figures"
    named = set()
    for number, text in shown.items():
        figure = FIGURES[number]
        assert text.startswith(f"## Fig. {number}: {figure.title}\n")
        assert f"**In the paper:** {figure.paper}\n" in text
        names = [picture_name(figure, is_plot=is_plot) for is_plot in (False, True)]
        (name,) = [one for one in names if f"(images/figures/{one})" in text]
        with Image.open(folder / name) as picture:
            assert min(picture.size) > 100
        named.add(name)
    files = list(folder.iterdir())
    assert {one.name for one in files} == named
    assert sum(one.stat().st_size for one in files) < 2.5e6


def test_sections_are_written_one_by_one(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    picture = Image.fromarray(np.zeros((9, 16, 3), np.uint8))
    figures = {n: Figure(n, f"title {n}", "shows", lambda _: report) for n in (4, 11)}
    report = Report(picture, "first", "nothing")
    for number in (11, 4):
        write(page, figures[number], report, seconds=1.0, width=24)
    kept = sections(page)[11]
    write(page, figures[4], Report(picture, "second", "nothing", True), seconds=1.0, width=24)
    assert list(sections(page)) == [4, 11]
    assert sections(page)[11] == kept
    assert "**Here:** second\n" in sections(page)[4]
    assert (tmp_path / "images" / "figures" / "figure-04.png").exists()


@pytest.mark.slow
def test_the_published_algorithm_depends_on_what_is_claimed() -> None:
    loop = example_curves.wavy_polygon(12)
    field = hk.SolidAngle(loop)
    view = View.of(loop, (16, 12))
    d = view.directions()
    truth = hk.trace(field, view.eye[None], d, tolerance=1e-7, precision="double")
    limits = np.zeros(len(d)), np.full(len(d), 10.0)
    claim = claimed_angle(field)
    proved = published(claim, view.eye, d, *limits, eps=1e-3, most=300)
    certain = proved.evaluations < 300
    np.testing.assert_array_equal(np.isfinite(proved.t)[certain], truth.is_hit[certain])
    assert certain.mean() > 0.9
    np.testing.assert_allclose(
        proved.t[truth.is_hit & certain], truth.t[truth.is_hit & certain], atol=0.02
    )
    wrong = Claim(claim.look, math.pi, claim.level, claim.period)
    passed = ~np.isfinite(published(wrong, view.eye, d, *limits, most=300).t) & truth.is_hit
    assert passed.sum() > 5


def test_a_view_frames_and_meets_what_it_is_given() -> None:
    vertices, faces = example_meshes.icosphere(2)
    view = View.of(vertices, (40, 30))
    pixels, depth = view.project(vertices)
    assert (pixels > 0).all()
    assert (pixels < [40, 30]).all()
    assert (depth > 0).all()
    met = mesh_hits(vertices, faces, view.eye, view.directions())
    middle = met.is_hit.reshape(30, 40)[15, 20]
    assert middle
    assert not met.is_hit.reshape(30, 40)[0, 0]
    points = view.eye + met.t[met.is_hit, None] * view.directions()[met.is_hit]
    radii = np.linalg.norm(points, axis=1)
    assert (radii < 1.001).all()
    assert (radii > 0.95).all()


@pytest.mark.slow
@pytest.mark.parametrize("number", [4, 5, 8, 11, 20, 25])
def test_figures_are_made_at_any_size(number: int) -> None:
    report = FIGURES[number].make(24)
    assert min(report.picture.size) > 30
    assert np.asarray(report.picture.convert("RGB")).std() > 5
    assert "nan" not in report.caption
    if number == 25:
        assert "harnack: 0 missed and 0 false" in report.caption
