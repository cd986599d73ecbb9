"""Surfaces opened by a section: what is left, faces of solids there, and what these are made of."""

import math
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.cli.arguments import parse
from harnack.rendering import mitsuba_shape
from harnack.rendering.placed_surface import PlacedSurface, Placement
from harnack.tracer import SurfaceTracer, traced_surface

NORMAL, OFFSET = np.array([0.6, 0.0, 0.8]), 0.2
HALF = hk.HalfSpace((0.6, 0.0, 0.8), OFFSET)


def _rays(n, seed):
    """Rays (n, 3) from a sphere of radius 3 to points of the unit ball's surroundings."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= 3 / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-1, 1, (n, 3)) - o
    return o, d / np.linalg.norm(d, axis=1)[:, None]


def test_volumes_have_something_in_common():
    box, ball = hk.Box((-1, -1, -1), (1, 1, 1)), hk.Ball(radius=1.2)
    both = box & HALF
    assert both == hk.geometry.VolumeIntersection((box, HALF))
    assert (
        (both & ball) == hk.geometry.VolumeIntersection((box, HALF, ball)) == (box & (HALF & ball))
    )
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    inside = box.contains_points(points) & HALF.contains_points(points)
    np.testing.assert_array_equal(both.contains_points(points), inside)
    with pytest.raises(TypeError):
        _ = box & 3  # pyright: ignore
    with pytest.raises(TypeError, match="section must be a volume"):
        hk.Surface(hk.Sphere(1.0), section=3.0)  # pyright: ignore


@pytest.mark.parametrize("precision", ["single", "double"])
def test_what_lies_beyond_a_section_is_not_hit(precision):
    o, d = _rays(2000, 3)
    hits = hk.trace(hk.Sphere(1.0), o, d, section=HALF, tolerance=1e-5, precision=precision)
    b = (o * d).sum(axis=1)
    square = b * b - (o * o).sum(axis=1) + 1
    t = np.full(len(o), np.inf)
    for sign in (1, -1):
        root = -b + sign * np.sqrt(np.maximum(square, 0))
        there = (square > 0) & ((o + root[:, None] * d) @ NORMAL <= OFFSET)
        t = np.where(there, root, t)
    decided = np.abs(square) > 1e-3
    for root in (-b - np.sqrt(np.abs(square)), -b + np.sqrt(np.abs(square))):
        decided &= np.abs((o + root[:, None] * d) @ NORMAL - OFFSET) > 1e-3
    assert decided.sum() > 1500
    np.testing.assert_array_equal(hits.is_hit[decided], np.isfinite(t[decided]))
    both = decided & hits.is_hit
    np.testing.assert_allclose(hits.t[both], t[both], atol=1e-3)


@pytest.mark.parametrize("side", [None, "below"])
def test_rays_without_a_hit_are_sampled_nowhere(side: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """At their origins, far from all parts, a model of many parts would be run as a whole."""
    backend, sampled, sample = choose_backend("double"), [], SurfaceTracer.sample_where

    def noted(self: SurfaceTracer, p: Any, active: Any) -> Any:
        sampled.append(active)
        return sample(self, p, active)

    monkeypatch.setattr(SurfaceTracer, "sample_where", noted)
    surface = traced_surface(hk.Sphere(1.0), side=side)
    placed = PlacedSurface.of(surface, Placement.identity(), backend)
    o = np.array([[0.0, 0.0, 9.0], [0.0, 0.5, 9.0], [0.0, 2.0, 9.0]])
    d = np.tile([0.0, 0.0, -1.0], (3, 1))
    met = placed.intersect(
        to_vector3(backend, o), to_vector3(backend, d), backend.Float(1e3), backend.Bool(True)
    )
    assert to_numpy(met.is_hit).tolist() == [True, True, False]
    assert len(sampled) == (1 if side is None else 2)
    for active in sampled:
        assert to_numpy(active).tolist() == [True, True, False]


@pytest.mark.slow
def test_faces_of_a_solid_on_its_section_are_told_from_all_others():
    backend = choose_backend("double")
    clip = hk.HalfSpace((-1, 0, 0), 0.5)
    surface = traced_surface(hk.Sphere(1.0), side="below", clip=clip, section=HALF)
    placed = PlacedSurface.of(surface, Placement.identity(), backend)
    o, d = _rays(3000, 4)
    o[1500:] = 0.3 * o[1500:] / np.linalg.norm(o[1500:], axis=1)[:, None] - [0.1, 0, 0]  # inside
    met = placed.intersect(
        to_vector3(backend, o), to_vector3(backend, d), backend.Float(1e3), backend.Bool(True)
    )
    x, is_met, cut = to_numpy(met.position), to_numpy(met.is_hit), to_numpy(met.is_on_section)
    on_plane = np.abs(x @ NORMAL - OFFSET) < 1e-6
    elsewhere = (np.abs(np.linalg.norm(x, axis=1) - 1) < 1e-3) | (np.abs(x[:, 0] + 0.5) < 1e-6)
    assert is_met[1500:].all()
    assert 500 < cut.sum() < 2000
    np.testing.assert_array_equal(cut & is_met, cut)
    np.testing.assert_array_equal(cut[is_met & ~(on_plane & elsewhere)],
                                  on_plane[is_met & ~(on_plane & elsewhere)])  # fmt: skip
    assert (on_plane | elsewhere)[is_met].all()
    np.testing.assert_allclose(
        to_numpy(met.normal)[cut], np.tile(NORMAL, (cut.sum(), 1)), atol=0.01
    )


@pytest.mark.slow
def test_pictures_show_faces_in_their_own_material():
    settings = {"size": (40, 30), "show": "shaded", "spp": 1, "progress": False,
                "camera": hk.Camera(azimuth=-90, elevation=0), "material": "porcelain"}  # fmt: skip
    cut = hk.HalfSpace((0, -1, 0), 0.0)
    plain = hk.render(hk.Sphere(1.0), section=cut, **settings)
    red = hk.render(hk.Sphere(1.0), section=cut, section_material="plastic", **settings)
    own = hk.render(hk.Sphere(1.0), section=cut, section_material="porcelain", **settings)
    np.testing.assert_array_equal(plain, own)
    middle = red[15, 20]
    assert middle[0] > 3 * middle[1]
    assert plain[15, 20, 1] > 3 * middle[1]
    behind = {**settings, "camera": hk.Camera(azimuth=90, elevation=0)}
    seen = hk.render(hk.Sphere(1.0), section=cut, section_material="plastic", **behind)
    assert seen[15, 20, 1] > 0.5 * seen[15, 20, 0]


def test_wrong_faces_are_refused():
    cut, small = hk.HalfSpace((0, 0, 1), 0.0), {"size": (8, 6), "progress": False}
    with pytest.raises(ValueError, match="give a section, such as a half-space"):
        hk.render(hk.Sphere(1.0), section_material="gold", **small)
    with pytest.raises(ValueError, match="opaque"):
        hk.render(hk.Sphere(1.0), material="glass", section=cut, section_material="gold", **small)
    with pytest.raises(ValueError, match="solid on its section"):
        mitsuba_shape(hk.Sphere(1.0), section=cut, section_bsdf={"type": "diffuse"})


@pytest.mark.slow
def test_meshes_are_cut_by_sections_too():
    half = hk.mesh(hk.Sphere(1.0), section=hk.HalfSpace((0, 0, 1), 0.0), tolerance=5e-3)
    assert half.is_watertight
    assert half.volume == pytest.approx(2 / 3 * math.pi, rel=0.02)
    gyroid = hk.Gyroid(1.0, domain=hk.Ball(radius=0.5))
    piece = hk.mesh(gyroid, section=hk.HalfSpace((1, 0, 0), 0.0), tolerance=1e-2)
    assert piece.bounds[1, 0] <= 1e-9
    assert np.linalg.norm(piece.vertices, axis=1).max() <= 0.5 + 1e-6


def test_sections_of_the_command_line():
    options = parse(["render", "gyroid", "--section", "0,-3,4,0.5", "--section-material", "clay"])
    assert options.section == hk.HalfSpace((0, -3, 4), 0.5)
    assert options.section_material == "clay"
    section = options.section
    np.testing.assert_allclose([*section.normal, section.offset], [0, -0.6, 0.8, 0.5])
    assert parse(["mesh", "gyroid", "--section", "0,0,1"]).section == hk.HalfSpace((0, 0, 1), 0)
    for wrong in ("0,0,0", "1,2", "1,2,3,4,5"):
        with pytest.raises(SystemExit):
            parse(["render", "gyroid", "--section", wrong])


@pytest.mark.slow
def test_a_surface_is_drawn_as_a_thick_sheet():
    """A square seen along its plane is nothing to be seen of, a sheet of it a bar."""
    square = hk.SolidAngle([[0.5, 0.5, 0], [-0.5, 0.5, 0], [-0.5, -0.5, 0], [0.5, -0.5, 0]])
    camera = hk.Camera(azimuth=0, elevation=0, box=hk.Box((-1, -1, -0.5), (1, 1, 0.5)))
    settings = {"show": "depth", "size": (40, 20), "progress": False, "spp": 1, "camera": camera}
    thin = hk.render(square, **settings)
    thick = hk.render(square, thickness=0.2, boundary_radius=0.02, **settings)
    assert np.isfinite(thick).sum() > np.isfinite(thin).sum() + 10
    with pytest.raises(ValueError, match="a solid has an inside already"):
        hk.render(hk.Sphere(1.0), level=0.0, side="below", thickness=0.1, **settings)
    assert parse(["render", "trefoil", "--thickness", "0.1"]).thickness == 0.1
