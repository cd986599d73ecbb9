"""Repaired meshes: what is kept, what is added, and what is refused."""

from __future__ import annotations

import importlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.cli import main
from harnack.geometry import MeshError
from harnack.geometry.example_meshes import icosphere, remove_faces, torus_mesh
from harnack.meshing.harmonic_filling import (
    HoleFillingOptions,
    _collapse_midpoint,  # pyright: ignore[reportPrivateUsage]
    checked_boundary_edges,
    harmonic_patches,
    triangle_fills,
)
from harnack.meshing.hole_filling import hole_loops
from harnack.meshing.mesh_cleaning import clean_and_fill
from harnack.meshing.mesh_tolerance import MeshTolerance
from tests.oracles.mesh_files import read_closed
from tests.oracles.triangle_pairs import intersecting_pairs

AXES = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -0.6, -0.8))


def ball(directions: Any = AXES, radius: float = 0.5, subdivisions: int = 3) -> trimesh.Trimesh:
    """A sphere without the triangles within an angle of some directions."""
    vertices, faces = icosphere(subdivisions)
    middle = vertices[faces].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    gone = (middle @ np.array(directions).T > np.cos(radius)).any(axis=1)
    return trimesh.Trimesh(vertices, faces[~gone], process=False)


def check(given: trimesh.Trimesh, euler: int = 2) -> trimesh.Trimesh:
    """Repairs a mesh and judges the result by other means than `repair` does."""
    made = hk.repair(given, keep="all", filling="harmonic")
    assert made.metadata["harnack"]["stage"] == "filled"
    given = given.copy()
    given.remove_unreferenced_vertices()
    n, m = len(given.vertices), len(given.faces)
    assert made.vertices[:n].tobytes() == given.vertices.tobytes()
    assert made.faces[:m].tobytes() == given.faces.tobytes()
    assert made.is_watertight
    assert made.is_winding_consistent
    # Vertices of faces that are missing may be left without any.
    used = len(np.unique(made.faces))
    edges = len(np.unique(np.sort(made.edges, axis=1), axis=0))
    assert used - edges + len(made.faces) == euler
    field = hk.WindingNumber(given.vertices, given.faces)
    if len(made.vertices) > n:
        w = field.value(made.vertices[n:], precision="double")
        assert np.abs(w - 0.5).max() <= 1e-6
    patches = np.asarray(made.faces)[m:]
    assert not (intersecting_pairs(np.asarray(made.vertices), np.asarray(made.faces)) >= m).any()
    # Refined: centers are within the tolerance, by the slope there.
    facts = made.metadata["harnack"]
    center = made.vertices[patches].mean(axis=1)
    off = field.value(center, precision="double") - 0.5
    slope = np.linalg.norm(field.gradient(center, precision="double"), axis=1)
    rim = trimesh.grouping.group_rows(given.edges_sorted, require_count=1)
    size = np.ptp(given.vertices[np.unique(given.edges_sorted[rim])], axis=0).max()
    ends = {tuple(edge) for edge in given.edges_sorted[rim].tolist()}
    sides = np.sort(patches[:, [[0, 1], [1, 2], [2, 0]]], axis=2).tolist()
    between = np.array([all(tuple(side) in ends for side in face) for face in sides])
    assert (np.abs(off) <= 1e-3 * size * slope)[~between].all()
    assert facts["refined"]
    return made


@pytest.mark.slow
def test_a_ball_with_three_holes() -> None:
    made = check(ball())
    facts = made.metadata["harnack"]
    assert facts["holes"] == 3
    assert facts["euler_characteristic"] == 2
    assert facts["patches"] == len(made.faces) - len(ball().faces)
    assert 3.8 < made.volume < 4.19  # holes are closed from rim to rim, a little flatter than caps


@pytest.mark.slow
def test_holes_that_touch_in_vertices() -> None:
    vertices, faces = icosphere(2)
    kept = np.random.default_rng(1).random(len(faces)) > 0.12
    check(trimesh.Trimesh(vertices, faces[kept], process=False))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_many_random_holes(seed: int) -> None:
    vertices, faces = icosphere(3)
    rng = np.random.default_rng(seed)
    vertices = vertices * (1 + 0.2 * np.sin(3 * vertices[:, [1]])) + 0.004 * rng.normal(
        size=vertices.shape
    )
    check(trimesh.Trimesh(vertices, faces[rng.random(len(faces)) > 0.1], process=False))


@pytest.mark.few(1)
@pytest.mark.parametrize(("scale", "shift"), [(1e-5, 0.0), (1.0, 300.0), (2e4, -1e5)])
def test_units_and_places(scale: float, shift: float) -> None:
    small = ball(AXES[:1], subdivisions=2)
    given = trimesh.Trimesh(small.vertices * scale + shift, small.faces, process=False)
    check(given)
    made = hk.repair(given)
    assert made.metadata["harnack"]["harmonic"] == 0
    one = hk.repair(small)
    assert np.asarray(made.vertices) == pytest.approx(
        np.asarray(one.vertices) * scale + shift, abs=1e-6 * scale + 1e-12 * abs(shift)
    )


@pytest.mark.slow
def test_two_openings_of_a_tube_are_capped_or_joined() -> None:
    """Patches of a long tube are caps; those of a short wide one join its rims to a torus."""
    for height, euler in ((6.0, 2), (0.3, 0)):
        angle = np.arange(24) * (2 * np.pi / 24)
        ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(24)])
        rings = np.concatenate([ring + np.array([0, 0, z]) for z in np.linspace(0, height, 9)])
        k = np.arange(8 * 24)
        after = np.where(k % 24 == 23, k - 23, k + 1)
        halves = np.stack([k, after, after + 24], 1), np.stack([k, after + 24, k + 24], 1)
        faces = np.concatenate(halves)
        check(trimesh.Trimesh(rings, faces, process=False), euler)


def test_a_closed_mesh_gets_nothing_added() -> None:
    given = ball(((0.0, 0.0, 1.0),), radius=0.0)
    made = hk.repair(given)
    assert len(made.faces) == len(given.faces)
    assert made.metadata["harnack"]["holes"] == 0


@pytest.mark.slow
def test_patches_that_meet_the_mesh_are_refused() -> None:
    """A small ball stands in the hole of a large one."""
    large = ball(AXES[:1])
    vertices, faces = icosphere(1)
    together = trimesh.Trimesh(
        np.concatenate([large.vertices, 0.1 * vertices + [0.02, 0.01, 0.88]]),
        np.concatenate([large.faces, faces + len(large.vertices)]),
        process=False,
    )
    with pytest.raises(hk.MeshingError, match=r"meet \d+ triangles of the mesh"):
        hk.repair(together, cell_size=0.08, keep="all", filling="harmonic")


def doubled() -> trimesh.Trimesh:
    given = ball()
    three = np.concatenate([given.faces, [[given.faces[5][0], given.faces[5][1], 0]]])
    return trimesh.Trimesh(given.vertices, three, process=False)


def one_reversed() -> trimesh.Trimesh:
    given = ball()
    faces = given.faces.copy()
    faces[7] = faces[7][::-1]
    return trimesh.Trimesh(given.vertices, faces, process=False)


def soup() -> trimesh.Trimesh:
    given = ball()
    loose = given.vertices[given.faces].reshape(-1, 3)
    return trimesh.Trimesh(loose, np.arange(len(loose)).reshape(-1, 3), process=False)


def flat() -> trimesh.Trimesh:
    given = ball()
    faces = np.concatenate([given.faces, [[1, 1, 2]]])
    return trimesh.Trimesh(given.vertices, faces, process=False)


def not_a_number() -> trimesh.Trimesh:
    given = ball()
    vertices = np.array(given.vertices)
    vertices[int(given.faces[3][0]), 1] = np.nan
    return trimesh.Trimesh(vertices, given.faces, process=False)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (doubled, "more than two faces"),
        (one_reversed, "do not agree which side is outside"),
        (soup, "at the same place"),
        (flat, "zero area"),
        (not_a_number, "finite"),
    ],
)
def test_meshes_of_which_not_all_can_be_kept(make: Any, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        hk.repair(make(), keep="all")


def crossing() -> trimesh.Trimesh:
    """A ball without holes, with a triangle that stands in it and half outside."""
    vertices, faces = icosphere(3)
    spike = np.array([[0.0, 0.3, 0.2], [0.1, 1.3, 0.2], [0.1, 1.3, 0.3]])
    more = np.concatenate([faces, [[len(vertices), len(vertices) + 1, len(vertices) + 2]]])
    return trimesh.Trimesh(np.concatenate([vertices, spike]), more, process=False)


def corners(mesh: trimesh.Trimesh) -> set[bytes]:
    """Triangles by the bits of their corners, which run from the least one."""
    found: set[bytes] = set()
    for triangle in np.asarray(mesh.vertices)[np.asarray(mesh.faces)]:
        first = min(range(3), key=lambda k, t=triangle: tuple(t[k]))
        found.add(np.roll(triangle, -first, axis=0).tobytes())
    return found


def check_closed(made: trimesh.Trimesh) -> None:
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.volume > 0
    assert not len(intersecting_pairs(np.asarray(made.vertices), np.asarray(made.faces)))


@pytest.mark.parametrize(
    ("make", "message", "reason", "turned"),
    [
        (doubled, "more than two faces", "branching", 0),
        (one_reversed, "do not agree which side is outside", None, 1),
        (soup, "at the same place", None, 0),
        (flat, "zero area", "flat", 0),
        (crossing, "pass through others", "crossing", 0),
    ],
)
def test_what_is_sound_is_kept(make: Any, message: str, reason: str | None, turned: int) -> None:
    given = make()
    made = hk.repair(given)
    facts = made.metadata["harnack"]
    assert facts["stage"] == "cleaned"
    assert message in facts["why"]
    check_closed(made)
    # But for what was left out all is there, first and in its order.
    count = sum(facts["left_out"].values())
    assert facts["kept"] == len(given.faces) - count
    assert count < 30
    assert (count > 0) == (reason is not None)
    assert reason is None or facts["left_out"][reason] > 0
    assert len(made.faces) == facts["kept"] + facts["patches"]
    first = np.asarray(made.vertices)[np.asarray(made.faces)[: facts["kept"]]].reshape(-1, 9)
    rows = given.vertices[given.faces].reshape(-1, 9)
    place = {row.tobytes(): k for k, row in enumerate(rows)}
    order = [place[row.tobytes()] for row in first if row.tobytes() in place]
    assert order == sorted(order)
    assert len(order) == facts["kept"] - turned
    assert facts["turned"] == turned
    assert 3.9 < made.volume < 4.25


def test_flipped_and_doubled_faces_are_all_told() -> None:
    """A tenth of the faces of a closed ball turned over, and a tenth there twice."""
    vertices, faces = icosphere(3)
    some = np.random.default_rng(3).choice(len(faces), 256, replace=False)
    broken = faces.copy()
    broken[some[:128]] = broken[some[:128], ::-1]
    broken = np.concatenate([broken, faces[some[128:]]])
    made = hk.repair(trimesh.Trimesh(vertices, broken, process=False), keep="valid")
    facts = made.metadata["harnack"]
    assert (facts["turned"], facts["patches"], facts["left_out"]["doubled"]) == (128, 0, 128)
    assert corners(made) == corners(trimesh.Trimesh(vertices, faces, process=False))


def test_fillings_come_last_also_behind_many_duplicates() -> None:
    """A ball of 79 triangles with a hole, the first of them 300 times more: the others have
    indices above the number of vertices and triangles that are left."""
    vertices, faces = icosphere(1)
    given = np.concatenate([np.repeat(faces[:1], 300, axis=0), faces[:-1]])
    cleaned = clean_and_fill(vertices, given, lambda message: None)
    assert cleaned.left_out["doubled"] == 300
    assert cleaned.kept_faces.tolist() == [0, *range(301, 379)]
    kept = cleaned.surface.vertices[cleaned.surface.faces[:79]]
    assert (kept == vertices[given[cleaned.kept_faces]]).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_size_of_triangles(seed: int) -> None:
    """Crossing triangles are left out with what is around them, or all is made anew; no more than
    that is promised, and it is closed."""
    vertices, faces = icosphere(2)
    rng = np.random.default_rng(seed)
    noisy = vertices + rng.normal(0, 0.08 + 0.02 * seed, vertices.shape)
    damaged = trimesh.Trimesh(noisy, faces[rng.random(len(faces)) > 0.05], process=False)
    result = hk.repair(damaged, cell_size=0.2, tolerance=2.4e-2)
    check_closed(result)
    assert result.metadata["harnack"]["stage"] != "filled"
    assert result.volume == pytest.approx(4.1, abs=0.5)


@pytest.mark.slow
def test_rough_surfaces_are_made_of_larger_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = icosphere(2)
    noisy = vertices + np.random.default_rng(0).normal(0, 0.1, vertices.shape)
    given = trimesh.Trimesh(noisy, faces, process=False)
    module = importlib.import_module("harnack.meshing.repair_stages")
    monkeypatch.setattr(module, "_CELLS_ACROSS", 16)
    monkeypatch.setattr(module, "_MAX_TRIANGLES", 4_000)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rough, and so not within the tolerance
        made = hk.repair(given, keep="none")
    check_closed(made)
    assert len(made.faces) <= 4_000
    assert made.metadata["harnack"]["spacing"] > 1.3 * np.ptp(noisy, axis=0).max() / 16


def loose(noise: float) -> trimesh.Trimesh:
    """All triangles of a ball with three holes, each moved at random by a length."""
    given = ball()
    corner = given.vertices[given.faces]
    shaken = corner + np.random.default_rng(0).normal(0, noise, (len(corner), 1, 3))
    every = np.arange(3 * len(corner)).reshape(-1, 3)
    return trimesh.Trimesh(shaken.reshape(-1, 3), every, process=False)


def test_corners_of_cracks_are_joined() -> None:
    original = loose(2e-3)
    with pytest.raises(hk.MeshingError, match="open"):
        hk.repair(original, keep="valid")
    with pytest.warns(UserWarning, match="moved corners by up to 0.00"):
        result = hk.repair(original)
    facts = result.metadata["harnack"]
    assert (facts["stage"], facts["kept"], facts["joined"]) == ("welded", 0, len(original.faces))
    assert facts["holes"] == 3
    check_closed(result)
    # Corners went nowhere but to means near by.
    x = np.asarray(result.vertices)[np.asarray(result.faces)[: facts["joined"]]]
    moved = np.linalg.norm(x - original.vertices[original.faces], axis=2)
    assert 0 < moved.max() == pytest.approx(facts["moved"])
    assert facts["moved"] < 0.01
    assert np.abs(np.linalg.norm(result.vertices, axis=1) - 1).max() < 0.015


def test_what_cannot_be_joined_is_made_anew() -> None:
    """Triangles that are moved by more than half of their size."""
    damaged = loose(0.05)
    result = hk.repair(damaged, cell_size=0.15, tolerance=2e-2)
    facts = result.metadata["harnack"]
    assert (facts["stage"], facts["kept"]) == ("remeshed", 0)
    assert "are loose" in facts["why"]
    check_closed(result)
    assert result.volume == pytest.approx(4.0, abs=0.3)


def test_smooth_patches_continue_the_surface() -> None:
    """On a ball they stay near the sphere, where harmonic ones have dents; and all is kept."""
    given = ball()
    made = hk.repair(given, keep="all")
    facts = made.metadata["harnack"]
    assert (facts["stage"], facts["holes"], facts["harmonic"]) == ("filled", 3, 0)
    given = given.copy()
    given.remove_unreferenced_vertices()
    n, m = len(given.vertices), len(given.faces)
    assert made.vertices[:n].tobytes() == given.vertices.tobytes()
    assert made.faces[:m].tobytes() == given.faces.tobytes()
    check_closed(made)
    radius = np.linalg.norm(made.vertices[n:], axis=1)
    assert len(radius) > 20
    assert np.abs(radius - 1).max() < 0.01  # the cap is 0.12 high
    w = hk.WindingNumber(given.vertices, given.faces).value(made.vertices[n:], precision="double")
    assert np.abs(w - 0.5).max() <= 0.36


def test_a_tube_that_is_half_open_is_not_cut_through() -> None:
    """The least area between the rims would go through the tube, whose radius is 0.3."""
    vertices, faces = torus_mesh(1.0, 0.3, 48, 16)
    x, y, z = vertices[faces].mean(axis=1).T
    around = np.arctan2(z, np.hypot(x, y) - 1)
    kept = (np.abs(np.arctan2(y, x)) > 0.25) | (np.abs(around) > 0.55 * np.pi)
    given = trimesh.Trimesh(vertices, faces[kept], process=False)
    made = hk.repair(given)
    facts = made.metadata["harnack"]
    assert (facts["stage"], facts["holes"], facts["harmonic"]) == ("filled", 1, 0)
    check_closed(made)
    x, y, z = np.asarray(made.vertices)[len(np.unique(faces[kept])) :].T
    off = np.hypot(np.hypot(x, y) - 1, z) - 0.3
    assert len(off) > 20
    assert np.abs(off).max() < 0.06


@pytest.mark.slow
def test_rims_of_one_gap_are_joined() -> None:
    """Two halves of a ball with a gap between them: smooth patches would close each."""
    vertices, faces = icosphere(3)
    middle = vertices[faces].mean(axis=1)[:, 2]
    given = trimesh.Trimesh(vertices, faces[np.abs(middle) > 0.1], process=False)
    made = hk.repair(given, keep="all")
    facts = made.metadata["harnack"]
    assert facts["harmonic"] == facts["patches"] > 0
    assert facts["holes"] == 2
    assert len(facts["parts"]) == 1
    check_closed(made)


def test_holes_that_share_a_corner_are_told_apart() -> None:
    """Two opposite faces at a vertex of six are lost: two holes of three edges."""
    vertices, faces = icosphere(2)
    center = next(v for v in range(len(vertices)) if (faces == v).sum() == 6)
    around = np.flatnonzero((faces == center).any(axis=1))
    one = around[0]
    other = next(k for k in around if len(set(faces[k]) & set(faces[one])) == 1)
    rest = np.delete(faces, [one, other], axis=0)
    loops = hole_loops(vertices, rest, checked_boundary_edges(rest))
    assert sorted(map(len, loops)) == [3, 3]
    lost = {tuple(sorted(faces[k].tolist())) for k in (one, other)}
    assert {tuple(sorted(loop.tolist())) for loop in loops} == lost


def test_numbers_that_are_none_are_refused_anyway() -> None:
    with pytest.raises(MeshError, match="finite"):
        hk.repair(not_a_number())
    with pytest.raises(MeshError, match=r"open sheet: .* have nothing inside"):
        hk.repair(wavy_sheet(), keep="none")


def wavy_sheet() -> trimesh.Trimesh:
    """Half of it bulges to one side of what spans its rim, and half to the other."""
    u = np.linspace(0, 1, 20)
    x, y = (value.ravel() for value in np.meshgrid(u, u, indexing="ij"))
    vertices = np.column_stack([x, y, 0.1 * np.sin(2 * np.pi * x) * np.cos(2 * np.pi * y)])
    k = np.arange(400).reshape(20, 20)
    a, b, c, d = (value.ravel() for value in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    middle = vertices[faces].mean(axis=1)[:, :2] - 0.5
    return trimesh.Trimesh(vertices, faces[np.hypot(*middle.T) > 0.15], process=False)


def inside_out() -> trimesh.Trimesh:
    vertices, faces = icosphere(1)
    return trimesh.Trimesh(vertices, faces[:, ::-1], process=False)


def test_what_is_inside_out_is_turned() -> None:
    made = hk.repair(inside_out())
    facts = made.metadata["harnack"]
    assert facts["stage"] == "cleaned"
    assert "inside out" in facts["why"]
    assert facts["turned"] == len(made.faces) == 80
    assert made.volume > 3.5


def test_a_cavity_is_not_turned() -> None:
    vertices, faces = icosphere(2)
    shells = trimesh.Trimesh(
        np.concatenate([vertices, 0.5 * vertices]), np.concatenate([faces, faces[:, ::-1] + 162]),
        process=False,
    )  # fmt: skip
    made = hk.repair(shells)
    facts = made.metadata["harnack"]
    assert facts["stage"] == "filled"
    outer, inner = facts["parts"]
    assert outer["volume"] == pytest.approx(-8 * inner["volume"])
    assert made.volume == pytest.approx(outer["volume"] + inner["volume"])


def test_loose_parts_are_kept_or_dropped() -> None:
    vertices, faces = icosphere(2)
    both = trimesh.Trimesh(
        np.concatenate([vertices, 0.3 * vertices + 2]), np.concatenate([faces, faces + 162]),
        process=False,
    )  # fmt: skip
    result = hk.repair(both, keep="none", cell_size=0.2, tolerance=3e-2)
    assert result.body_count == 2
    largest = hk.repair(both, keep="none", largest=True, cell_size=0.2, tolerance=3e-2)
    assert largest.body_count == 1
    assert largest.volume > 3.5
    assert largest.metadata["harnack"]["dropped"] == 1


@pytest.mark.parametrize("keep", ["all", "valid"])
def test_loose_parts_that_are_kept_are_listed(keep: Any) -> None:
    vertices, faces = icosphere(2)
    both = trimesh.Trimesh(
        np.concatenate([0.3 * vertices + 2, vertices]), np.concatenate([faces[3:], faces + 162]),
        process=False,
    )  # fmt: skip
    for largest in (False, True):
        made = hk.repair(both, keep=keep, largest=largest)
        large, small = made.metadata["harnack"]["parts"]
        assert large["volume"] == pytest.approx(small["volume"] / 0.3**3, rel=0.02)
        assert small["center"] == pytest.approx([2, 2, 2], abs=0.01)
        assert (large["faces"], small["faces"]) == (320, 320)
        assert made.metadata["harnack"]["dropped"] == largest
        assert made.body_count == 2 - largest
    assert corners(made) == corners(trimesh.Trimesh(vertices, faces, process=False))


def test_settings_that_are_refused() -> None:
    with pytest.raises(TypeError, match=r"a pair \(vertices, faces\)"):
        hk.repair(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="tolerance"):
        hk.repair(ball(), tolerance=0)
    with pytest.raises(ValueError, match='keep is None, "all", "valid" or "none"'):
        hk.repair(ball(), keep="some")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match='filling is "smooth" or "harmonic"'):
        hk.repair(ball(), filling="flat")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="cell_size"):
        hk.repair(ball(), cell_size=float("nan"))


def test_a_middle_goes_to_an_end_of_its_edge() -> None:
    """Vertex 4 halves the edge from 0 to 1 of two triangles below vertex 2 and 3."""
    x = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0, 0]])
    faces = np.array([[0, 4, 3], [4, 2, 3], [4, 1, 2]])
    left = _collapse_midpoint(x, faces, 4, [0, 1])
    assert sorted(map(sorted, left.tolist())) in ([[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]])


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, target = tmp_path / "broken.stl", tmp_path / "whole.ply"
    ball(AXES[:1], subdivisions=2).export(source)
    assert main(["repair", str(source), "-o", str(target), "--quiet"]) == 0
    assert "1 hole," in capsys.readouterr().out
    again = ["repair", str(source), "-o", str(target), "--quiet", "--keep", "valid"]
    assert main([*again, "--filling", "smooth"]) == 0
    said = capsys.readouterr().out
    assert "kept what is sound: " in said
    assert "left out none; 1 hole," in said
    assert "; 1 part" in said
    read_closed(target)
    assert sorted(tmp_path.iterdir()) == [source, target]
    assert main(["repair", str(source), "-o", str(tmp_path / "a.txt")]) == 1
    assert "extension of a mesh" in capsys.readouterr().err


@pytest.mark.slow
def test_meshes_that_lack_single_triangles_get_them_back() -> None:
    vertices, faces = torus_mesh(1.0, 0.35, 24, 24)
    rest = remove_faces(faces, 0.1, seed=1)
    given = trimesh.Trimesh(vertices, rest, process=False)
    made = hk.repair(given)
    assert made.metadata["harnack"]["stage"] == "filled"
    assert made.faces[: len(rest)].tobytes() == given.faces.tobytes()
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.euler_number == 0
    assert made.volume == pytest.approx(trimesh.Trimesh(vertices, faces).volume, rel=2e-3)
    assert not len(intersecting_pairs(np.asarray(made.vertices), np.asarray(made.faces)))
    facts = made.metadata["harnack"]
    assert facts["patches"] == len(made.faces) - len(rest)
    assert facts["harmonic"] == 0
    lost = corners(trimesh.Trimesh(vertices, faces, process=False)) - corners(given)
    assert len(lost & corners(made)) > 0.8 * len(lost)


@pytest.mark.slow
def test_harmonic_patches_get_the_triangles_of_holes_of_three_edges() -> None:
    vertices, faces = torus_mesh(1.0, 0.35, 24, 24)
    given = trimesh.Trimesh(vertices, remove_faces(faces, 0.1, seed=1), process=False)
    edges = checked_boundary_edges(np.asarray(given.faces, np.int64))
    how = HoleFillingOptions(MeshTolerance(), None, 0, 1, lambda _: None)
    made = harmonic_patches(vertices, np.asarray(given.faces, np.int64), edges, how)
    assert made.triangle_fill_count > 50
    assert made.is_refined
    assert (made.faces[: made.triangle_fill_count] < len(vertices)).all()


@pytest.mark.slow
def test_points_are_moved_in_another_way_where_a_change_is_not_known() -> None:
    box = trimesh.creation.box().subdivide().subdivide()
    rng = np.random.default_rng(628030259)
    count = int(len(box.faces) * rng.uniform(0.05, 0.15))
    gone = rng.choice(len(box.faces), count, replace=False)
    made = hk.repair(trimesh.Trimesh(box.vertices, np.delete(box.faces, gone, 0), process=False))
    assert made.is_watertight
    assert made.euler_number == 2


def testmissing_triangles_are_those_that_stand_in_no_other() -> None:
    whole = trimesh.Trimesh(*icosphere(2), process=False)
    faces = np.asarray(whole.faces)[2:]
    lost = {tuple(sorted(face)) for face in np.asarray(whole.faces)[:2].tolist()}
    found = missing(whole.vertices, faces)
    assert {tuple(sorted(face)) for face in found.tolist()} == lost
    closed = trimesh.Trimesh(whole.vertices, np.concatenate([faces, found]), process=False)
    assert closed.is_winding_consistent
    middle = whole.vertices[whole.faces[0]].mean(axis=0)
    spike = [0.8 * middle, 1.3 * middle, 1.3 * middle + 0.01 * whole.vertices[whole.faces[0][0]]]
    n = len(whole.vertices)
    more = np.concatenate([faces, [[n, n + 1, n + 2]]])
    found = missing(np.concatenate([whole.vertices, spike]), more)
    assert {tuple(sorted(face)) for face in found.tolist()} == lost - {
        tuple(sorted(whole.faces[0]))
    }


def test_a_lone_triangle_is_not_covered_by_itself() -> None:
    assert not len(missing(np.eye(3), np.array([[0, 1, 2]])))


def missing(vertices: Any, faces: Any) -> Any:
    return triangle_fills(np.asarray(vertices), faces, checked_boundary_edges(faces))


def test_bodies_that_overlap_are_united_exactly() -> None:
    """They were made anew, which took long and moved the surface."""
    ball = trimesh.creation.icosphere(2)
    other = trimesh.Trimesh(np.add(ball.vertices, (0.7, 0.3, 0.2)), ball.faces)
    made = hk.repair(trimesh.util.concatenate([ball, other]))
    assert made.metadata["harnack"]["stage"] == "boolean_union"
    assert made.is_watertight
    assert not len(intersecting_pairs(np.asarray(made.vertices), np.asarray(made.faces)))
    expected = trimesh.boolean.union([ball, other]).volume
    assert made.volume == pytest.approx(expected, rel=1e-9)


def test_what_is_inside_the_material_of_another_part_is_left_out() -> None:
    ball = trimesh.creation.icosphere(2)
    inner = trimesh.Trimesh(0.5 * ball.vertices, ball.faces)
    made = hk.repair(trimesh.util.concatenate([ball, inner]))
    assert made.volume == pytest.approx(ball.volume)
    inner.invert()
    hollow = hk.repair(trimesh.util.concatenate([ball, inner]))
    assert hollow.metadata["harnack"]["stage"] == "filled"
    assert hollow.volume == pytest.approx(0.875 * ball.volume)


@pytest.mark.parametrize("keep", [None, "all", "none"])
def test_what_lies_in_a_plane_is_refused_at_once(keep: Any) -> None:
    """It took a minute, and then the level set was said to be empty."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) @ turn + 5.0
    with pytest.raises(MeshError, match="lie in a plane"):
        hk.repair(trimesh.Trimesh(x, [[0, 1, 2], [1, 3, 2]], process=False), keep=keep)
