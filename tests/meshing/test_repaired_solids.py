"""Whether what `repair` returns is the solid that was given: by sums of solid angles."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry.example_meshes import icosphere
from harnack.geometry.mesh_edges import distance_from_triangles
from harnack.meshing.bodies import closed_parts
from harnack.meshing.intended_solid import IntendedSolid
from harnack.meshing.joined_pieces import boundary_of_solid
from harnack.meshing.marching_tetrahedra import delaunay
from harnack.meshing.triangle_mesh import TriangleMesh
from tests.oracles.direct_sums import winding_sum
from tests.oracles.mesh_distance import distances_to_triangles
from tests.oracles.triangle_pairs import intersecting_pairs

CREATE: Any = trimesh.creation


def box(sides: Sequence[float], center: Sequence[float] = (0, 0, 0)) -> trimesh.Trimesh:
    result = CREATE.box(sides)
    result.apply_translation(center)
    return result


def together(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(list(parts))


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh = mesh.copy()
    mesh.invert()
    return mesh


def repaired(damaged: trimesh.Trimesh, **options: Any) -> trimesh.Trimesh:
    """The result, of which nothing is wrong that it does not tell."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*not quite the solid")
        result = hk.repair(damaged, **options)
    assert result.metadata["harnack"]["differs"] is None
    assert result.is_watertight
    return result


def check_is(result: trimesh.Trimesh, winding: Any, bounds: Any, count: int = 1500) -> None:
    """The inside is where a winding number is above 1/2, but for where that is in doubt, or nearer
    to the surface than it has to be right."""
    low, high = bounds
    margin = 0.03 * (high - low)
    points = np.random.default_rng(7).uniform(low - margin, high + margin, (count, 3))
    w, inside = winding(points), winding_sum(result.triangles)(points) > 0.5
    wrong = points[(inside & (w < 0.14)) | (~inside & (w > 0.86))]
    assert len(wrong) < 0.01 * count
    near = distances_to_triangles(wrong, result.triangles[result.area_faces > 0]).min(axis=1)
    assert (near < 2e-3 * (high - low).max()).all()


# Literal cases, with their volumes.


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_cube_with_a_cavity_that_is_inside_out(is_whole: bool) -> None:
    """The cavity was taken for a part of its own, and its volume added: 8,512."""
    damaged = inverted(together(box([20, 20, 20]), inverted(box([8, 8, 8]))))
    if not is_whole:
        damaged = together(damaged, box([5, 5, 5], (40, 0, 0)))
    result = repaired(damaged)
    facts = result.metadata["harnack"]
    assert result.volume == pytest.approx(7488 + (0 if is_whole else 125))
    assert (facts["stage"], facts["kept"], facts["turned"]) == ("cleaned", len(damaged.faces), 24)


@pytest.mark.parametrize("turns", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
@pytest.mark.parametrize("lost", ["outer", "inner"])
def test_a_cube_in_a_cube_one_of_which_lacks_a_triangle(turns: Any, lost: str) -> None:
    """The one that was closed was turned by itself, and both volumes were added: 8,512."""
    outer, inner = box([20, 20, 20]).subdivide(), box([8, 8, 8]).subdivide()
    broken = {"outer": outer, "inner": inner}[lost]
    broken.update_faces(np.arange(len(broken.faces)) > 0)
    parts = (
        part if turn > 0 else inverted(part)
        for part, turn in zip((outer, inner), turns, strict=True)
    )
    result = repaired(together(*parts))
    is_hollow = turns[0] != turns[1]
    assert result.volume == pytest.approx(7488 if is_hollow else 8000)
    if result.metadata["harnack"]["stage"] == "cleaned":
        inside = len(inner.faces)
        assert result.metadata["harnack"]["left_out"]["inside"] == (0 if is_hollow else inside)


def test_a_recess_that_is_inside_out() -> None:
    """It lies in the cube and shares three of its planes: it was taken for a part of its own."""
    damaged = together(box([10, 10, 10]), inverted(box([5, 5, 5], (2.5, 2.5, 2.5))))
    assert repaired(inverted(damaged)).volume == pytest.approx(875)
    assert repaired(damaged).volume == pytest.approx(875)


def grid(*cells: Sequence[float]) -> trimesh.Trimesh:
    return together(*(box([1, 1, 1], cell) for cell in cells))


@pytest.mark.parametrize(
    ("make", "volume"),
    [
        (lambda: together(box([20, 20, 20]), box([10, 10, 5], (0, 0, 12.5))), 8500.0),
        (lambda: together(box([20, 20, 20]), box([10, 10, 5], (3, 2, 7.5))), 8000.0),
        (lambda: grid((0, 0, 0), (1, 0, 0), (1, 1, 0)), 3.0),
        # A solid in a cavity in a solid; and a hollow in what winds twice, which is no hollow.
        (lambda: together(box([3] * 3), inverted(box([2] * 3)), box([1] * 3)), 20.0),
        (lambda: together(box([4] * 3), box([3] * 3), inverted(box([2] * 3))), 64.0),
        (
            lambda: together(
                box([4] * 3), box([3] * 3), inverted(box([2] * 3)), inverted(box([1] * 3))
            ),
            63.0,
        ),
    ],
)
@pytest.mark.parametrize("turns", ["as it is", "inside out", "turned", "merged"])
def test_parts_that_touch_or_lie_in_each_other(make: Any, volume: float, turns: str) -> None:
    damaged = make()
    if turns == "inside out":
        damaged.invert()
    if turns == "turned":  # so that planes are planes up to rounding
        turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
        damaged.vertices = damaged.vertices @ (turn * np.sign(np.linalg.det(turn)))
    if turns == "merged":
        damaged.merge_vertices()
    result = repaired(damaged)
    assert result.volume == pytest.approx(volume, rel=1e-6)
    if turns != "turned":  # else corners are apart from planes by rounding, which it cannot tell
        assert not len(intersecting_pairs(np.asarray(result.vertices), np.asarray(result.faces)))


def test_boxes_that_share_an_edge_are_told_apart() -> None:
    """By what has material in between: all corners and edges are shared."""
    damaged = grid((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (2, 2, 0))
    damaged.merge_vertices()
    x, faces = np.asarray(damaged.vertices), np.asarray(damaged.faces, np.int64)
    parts = closed_parts(x, faces, faces)
    assert [len(part) for part in parts] == [12] * 5
    assert (np.ptp(x[faces[parts[0]]], axis=(0, 1)) == 1).all()


def test_two_loose_balls() -> None:
    ball = CREATE.icosphere(subdivisions=0)
    corner = np.concatenate([ball.triangles, np.add(ball.triangles, [3, 0, 0])])
    corner = corner + np.random.default_rng(0).normal(0, 1e-6, corner.shape)
    every = np.arange(3 * len(corner)).reshape(-1, 3)
    damaged = trimesh.Trimesh(corner.reshape(-1, 3), every, process=False)
    assert repaired(damaged).volume == pytest.approx(2 * ball.volume, rel=1e-5)


def test_qhull_raises_no_error_of_its_own() -> None:
    """As for these balls with keep="all", after a minute."""
    with pytest.raises(hk.MeshingError, match="no Delaunay tetrahedra of 9 points"):
        delaunay(np.zeros((9, 3)))


def halves_along_a_zigzag() -> trimesh.Trimesh:
    """Of a ball, moved apart. Edges lie on each other where they were moved along themselves."""
    ball = CREATE.uv_sphere(count=[10, 10])
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    upper = vertices[faces].mean(axis=1)[:, 2] > 1e-9
    apart = np.concatenate([vertices - [0, 0, 0.05], np.add(vertices, [0, 0, 0.05])])
    return trimesh.Trimesh(apart, np.where(upper[:, None], faces + len(vertices), faces))


@pytest.mark.slow
def test_halves_of_a_ball_along_a_zigzag() -> None:
    """Half of the ball was left out, after 40 seconds."""
    damaged = halves_along_a_zigzag()
    result = repaired(damaged)
    assert "the result of cleaned is another solid" in result.metadata["harnack"]["why"]
    assert result.volume == pytest.approx(4.31, abs=0.03)
    check_is(result, winding_sum(damaged.triangles), damaged.bounds)


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_a_part_that_passes_through_a_face_along_its_edges(first: str) -> None:
    """No edge passes through a triangle, so that all was kept, and the part in the box counted
    twice: 1,010.67."""
    ends = np.array([[2, 0, 0], [0, 2, 0], [-2, 0, 0], [0, -2, 0], [0, 0, 2], [0, 0, -2.0]])
    top = [[k, (k + 1) % 4, 4] for k in range(4)]
    bottom = [[(k + 1) % 4, k, 5] for k in range(4)]
    octahedron = trimesh.Trimesh(ends, top + bottom if first == "top" else bottom + top)
    damaged = together(box([10, 10, 10], (0, 0, -5)), octahedron)
    assert repaired(damaged).volume == pytest.approx(1000 + octahedron.volume / 2)
    apart = together(box([10, 10, 10], (0, 0, -7)), octahedron)  # a corner touches a face
    assert repaired(apart).metadata["harnack"]["stage"] == "filled"


def test_an_edge_on_a_face() -> None:
    """A prism stands with an edge on the side of a box: triangles there passed through each other
    by rounding, so that `mesh` raised an error, and `repair` made all anew."""
    turns = 2 * np.pi * np.arange(5) / 5
    base = np.column_stack([6 * np.cos(turns), 6 * np.sin(turns), np.zeros(5)])
    prism = trimesh.Trimesh(np.concatenate([base, np.add(base, [0, 0, 4])])).convex_hull
    corner = np.array([6 * np.cos(turns[1]), 6 * np.sin(turns[1]), 0])
    prism.apply_translation(np.array([14, 18, 14]) / 3 - corner)
    damaged = together(box([5, 4, 5], (5.5, 8, 9.5)), prism)
    volume = 100 + prism.volume
    result = repaired(damaged)
    assert result.metadata["harnack"]["stage"] == "boolean_union"
    assert result.volume == pytest.approx(volume, rel=1e-7)
    assert hk.mesh(hk.solid(damaged)).volume == pytest.approx(volume, rel=1e-7)


# One shell that passes through itself.


def test_a_shell_that_passes_through_its_own_face_along_two_edges() -> None:
    """All faces at the two edges have a corner in common with that face: nothing was wrong, said
    `check_print`, and `repair` kept what winds around the lower tetrahedron the other way."""
    corners = [[0, 0, 0], [4, 0, 0], [2, 4, 0], [2, 1, 0], [2, -1, 3], [2, -1, -3]]
    upper = [[0, 3, 4], [3, 1, 4], [2, 4, 1], [2, 0, 4]]
    lower = [[0, 5, 3], [3, 5, 1], [1, 5, 0], [2, 1, 0]]
    fold = trimesh.Trimesh(corners, upper + lower, process=False)
    assert fold.is_watertight
    assert fold.is_winding_consistent
    assert fold.volume == pytest.approx(6 - 2)
    assert hk.check_print(fold).problems[0].kind == "touching faces"
    result = repaired(fold)
    assert result.metadata["harnack"]["stage"] == "boolean_union"
    assert result.volume == pytest.approx(6)
    assert hk.check_print(result).is_printable


def bridged() -> trimesh.Trimesh:
    """A box with half an octahedron in its top, whose surfaces are one by a bridge between them."""
    ball = CREATE.box([10, 10, 10])
    ends = 1.2 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [[k, (k + 1) % 4, 4] for k in range(4)] + [[(k + 1) % 4, k, 5] for k in range(4)]
    octahedron = trimesh.Trimesh(np.add(ends, [-2.5, -2.5, 5]), faces, process=False)
    whole = together(ball, octahedron)
    middle = whole.triangles_center
    start = int((middle.sum(axis=1) * (np.abs(middle[:, 2] - 5) < 1e-9)).argmax())
    end = 12 + int((middle[12:] @ [1, 1, 2]).argmax())
    rims = [whole.faces[start], whole.faces[end]]
    holes = [0.1 * whole.vertices[rim] + 0.9 * whole.vertices[rim].mean(axis=0) for rim in rims]
    first = len(whole.vertices)
    a, b = [first, first + 1, first + 2], [first + 3, first + 4, first + 5]
    ways = [[b[(r - k) % 3] for k in range(3)] for r in range(3)]
    ends = np.concatenate(holes)
    lengths = [np.linalg.norm(ends[:3] - ends[np.subtract(way, first)], axis=1) for way in ways]
    loops = [(rims[0], a), (rims[1], b), (a, ways[int(np.argmin(np.sum(lengths, axis=1)))])]
    made = [
        face
        for one, other in loops
        for k, j in ((0, 1), (1, 2), (2, 0))
        for face in ([one[k], one[j], other[j]], [one[k], other[j], other[k]])
    ]
    kept = np.delete(whole.faces, [start, end], axis=0)
    return trimesh.Trimesh(
        np.concatenate([whole.vertices, *holes]), np.concatenate([kept, made]), process=False
    )


def test_a_shell_joined_by_a_bridge() -> None:
    """It was kept, and half of the octahedron counted twice."""
    damaged = bridged()
    assert damaged.is_watertight
    assert damaged.body_count == 1
    assert "touching faces" in [one.kind for one in hk.check_print(damaged).problems]
    assert repaired(damaged).volume == pytest.approx(damaged.volume - 2 / 3 * 1.2**3)


@pytest.mark.parametrize(
    ("corner", "volume"), [((0, 5, 5), 500), ((-3, 5, 5), 500), ((5, 5, 0), 1250 / 3)]
)
def test_a_box_bent_into_its_own_face(corner: Any, volume: float) -> None:
    """It took 20 to 96 s by cells, and its volume was off by 1e-5."""
    bent = box([10, 10, 10], (5, 5, 5))
    ends = np.asarray(bent.vertices).copy()
    ends[(ends == 10).all(axis=1)] = corner
    result = repaired(trimesh.Trimesh(ends, bent.faces, process=False))
    assert result.metadata["harnack"]["stage"] == "boolean_union"
    assert result.volume == pytest.approx(volume)


def test_two_tetrahedra_whose_edges_cross() -> None:
    """Edges meet edges alone, at the centers of a cube's faces, and every triangle passes through
    others."""
    corners = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])
    star = together(trimesh.Trimesh(corners, faces), trimesh.Trimesh(1 - corners, faces[:, ::-1]))
    assert star.volume == pytest.approx(2 / 3)
    cut = boundary_of_solid(star.vertices, star.faces)
    assert trimesh.Trimesh(cut.vertices, cut.faces).volume == pytest.approx(0.5, rel=1e-12)
    assert repaired(star).volume == pytest.approx(0.5, rel=1e-12)
    with pytest.raises(hk.MeshingError, match="none of its triangles is sound"):
        hk.repair(star, keep="valid")


def test_faces_without_area_hide_no_difference() -> None:
    """All places were at distance 0 from these."""
    flat = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0]]], np.float64)
    assert distance_from_triangles(np.array([1.0, 3, 4]), flat) == pytest.approx(5)


# What finds it.


def test_a_difference_is_told() -> None:
    vertices, faces = icosphere(3)
    two = together(
        trimesh.Trimesh(vertices, faces), trimesh.Trimesh(np.add(vertices, [3, 0, 0]), faces)
    )
    damaged = IntendedSolid.of(two)
    assert damaged.difference(TriangleMesh(two.vertices, np.asarray(two.faces)), 1e-3) is None
    lost = damaged.difference(TriangleMesh(vertices, faces), 1e-3)
    assert lost is not None
    assert (lost.missing > 300, lost.added) == (True, 0)
    assert (np.linalg.norm(lost.places - [3, 0, 0], axis=1) < 1).all()
    assert "such as near" in str(lost)
    more = IntendedSolid.of(trimesh.Trimesh(vertices, faces)).difference(
        TriangleMesh(two.vertices, np.asarray(two.faces)), 1e-3
    )
    assert more is not None
    assert more.volumes == pytest.approx((2 * lost.volumes[0], lost.volumes[0]))
    # Within the length that is allowed nothing differs.
    assert (
        damaged.difference(TriangleMesh(1.01 * two.vertices, np.asarray(two.faces)), 0.05) is None
    )


@pytest.mark.parametrize("sides", [[1.0, 1.0, 0.003], [0.01, 0.01, 0.01]])
def test_parts_that_hold_no_other_points_are_missed(sides: Any) -> None:
    """Made anew, with what else cannot be kept, they were lost without a word."""
    rest, part = box([3, 3, 3]), box(sides, (4, 0, 0))
    result = TriangleMesh(np.asarray(rest.vertices), np.asarray(rest.faces, np.int64))
    difference = IntendedSolid.of(together(rest, part)).difference(result, 4e-3)
    assert difference is not None
    assert (difference.missing, difference.added) == (12, 0)
    cavity = IntendedSolid.of(together(rest, inverted(box(sides, (0.2, 0, 0))))).difference(
        result, 4e-3
    )
    assert cavity is not None
    assert (cavity.missing, cavity.added) == (0, 12)


def test_what_differs_is_said_if_nothing_better_is_found() -> None:
    """No patches can be made where edges lie on each other, and the triangles there go."""
    damaged = halves_along_a_zigzag()
    with pytest.warns(UserWarning, match=r"not quite the solid that was given: .* such as near"):
        result = hk.repair(damaged, keep="valid")
    differs = result.metadata["harnack"]["differs"]
    assert differs["missing"] > 500
    assert differs["share"] > 0.1
    assert result.volume < 2.5


# Random assemblies.


def random_parts(seed: int) -> list[trimesh.Trimesh]:
    """Two to five closed parts: stacked, overlapping, nested, or on a grid; some inside out."""
    rng = np.random.default_rng(seed)
    kind, count = seed % 4, int(rng.integers(2, 6))
    if kind == 0:
        heights = rng.uniform(0.3, 1.0, count)
        ends = np.cumsum(heights)
        stack = [
            box([*rng.uniform(0.4, 1.2, 2), h], [*rng.uniform(-0.3, 0.3, 2), end - h / 2])
            if rng.random() < 0.5
            else CREATE.cylinder(
                rng.uniform(0.3, 0.7), segment=[[0, 0, end - h], [0, 0, end]], sections=9
            )
            for h, end in zip(heights, ends, strict=True)
        ]
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
        for part in stack if seed % 8 else ():
            part.apply_transform(turn)
        return stack
    if kind == 1:
        return [random_part(rng, inverts=k > 0 and rng.random() < 0.3) for k in range(count)]
    if kind == 2:
        scales = np.cumprod(rng.uniform(0.5, 0.75, count))
        ball = CREATE.icosphere(subdivisions=1)
        result = [trimesh.Trimesh(scale * ball.vertices, ball.faces) for scale in scales]
        return [
            inverted(part) if k and rng.random() < 0.6 else part for k, part in enumerate(result)
        ]
    cells = rng.choice(8, count, replace=False)
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    return [box([1, 1, 1], corners[cell]) for cell in cells]


def random_part(rng: np.random.Generator, *, inverts: bool) -> trimesh.Trimesh:
    kinds = (
        lambda: box(rng.uniform(0.6, 1.4, 3).tolist()),
        lambda: CREATE.icosphere(subdivisions=2, radius=rng.uniform(0.4, 0.8)),
        lambda: CREATE.torus(0.6, rng.uniform(0.15, 0.3), major_sections=16, minor_sections=10),
    )
    result = kinds[int(rng.integers(3))]()
    result.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    result.apply_translation(rng.uniform(-0.5, 0.5, 3))
    return inverted(result) if inverts else result


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_random_assemblies(seed: int) -> None:
    parts = random_parts(seed)
    damaged = together(*parts)
    if seed % 3 == 1:
        damaged.merge_vertices()
    if seed % 5 == 4:
        damaged.invert()
    result = repaired(damaged)

    def winding(points: Any) -> Any:
        """A part that is inside out counts as one that is not, unless it lies in another."""
        sums = [winding_sum(part.triangles)(points) for part in parts]
        if seed % 4 == 1:
            sums = [w * np.sign(part.volume) for w, part in zip(sums, parts, strict=True)]
        return sum(sums)

    check_is(result, winding, damaged.bounds)


def welded_parts(seed: int) -> trimesh.Trimesh:
    """Two to four boxes and tetrahedra with whole coordinates, whose corners are joined until they
    are one shell."""
    rng = np.random.default_rng(seed)
    while True:
        parts = list[trimesh.Trimesh]()
        for _ in range(rng.integers(2, 5)):
            low = rng.integers(0, 4, 3)
            part = CREATE.box(bounds=[low, low + rng.integers(1, 4, 3)])
            if rng.random() < 0.5:
                corners = rng.integers(0, 5, (4, 3))
                if abs(np.linalg.det(corners[1:] - corners[0])) > 2:
                    part = trimesh.Trimesh(corners).convex_hull
            parts.append(part)
        whole = together(*parts)
        whole.merge_vertices()
        if len(trimesh.graph.connected_components(whole.edges_unique)) == 1:
            return whole


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_random_parts_welded_to_one_shell(seed: int) -> None:
    damaged = welded_parts(seed)
    result = repaired(damaged)
    check_is(result, winding_sum(damaged.triangles), damaged.bounds)
