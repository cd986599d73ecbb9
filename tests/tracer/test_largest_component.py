"""The largest component alone: first hits against those of that component by itself."""

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.clearance import occupied_cells
from harnack.rendering.placed_surface import PlacedSurface, Placement
from harnack.tracer import traced_surface
from harnack.tree import empty_space

BIG, SMALL = (0.5, (-0.6, 0.0, 0.0)), (0.3, (0.5, 0.0, 0.0))


def product(x, y, z):
    """Two spheres as the zeros of one product."""
    one, other = (
        (x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 - r * r for r, c in (BIG, SMALL)
    )
    return one * other


FIELDS = {
    "solids": hk.Sphere(*BIG) | hk.Sphere(*SMALL) | hk.Sphere(0.1, (0.1, 0.8, 0.0)),
    "expression": hk.expression(product, domain=hk.Ball(radius=1.5)),
}


def rays(n, seed):
    """Rays (n, 3) from around, from inside of both spheres, from faces of cells and along them."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(n, 3))
    o *= rng.uniform(1.5, 4, (n, 1)) / np.linalg.norm(o, axis=1)[:, None]
    d = rng.uniform(-1, 1, (n, 3)) - o
    part = n // 5
    ball = rng.normal(size=(2 * part, 3))
    ball *= rng.uniform(0, 1.2, (2 * part, 1)) / np.linalg.norm(ball, axis=1)[:, None]
    o[:part] = np.array(SMALL[1]) + SMALL[0] * ball[:part]
    o[part : 2 * part] = np.array(BIG[1]) + BIG[0] * ball[part:]
    cells = occupied_cells(FIELDS["solids"], (0.0,), FIELDS["solids"].extent((0.0,)), 128)
    corners = cells.origin + cells.cell_size * rng.integers(0, cells.shape, (2 * part, 3))
    o[2 * part : 4 * part] = corners
    d[2 * part : 3 * part] = np.eye(3)[rng.integers(0, 3, part)] * rng.choice([-1, 1], (part, 1))
    d[3 * part : 4 * part] = rng.choice([-1.0, 0.0, 1.0], (part, 3))
    d[3 * part : 4 * part, 2] += 1e-3
    return o, d / np.linalg.norm(d, axis=1)[:, None]


def through_sphere(o, d, radius, center):
    """The first crossing (n,) in front of each ray, inf for none, and which are certain."""
    o = o - np.array(center)
    along, square = (o * d).sum(axis=1), (o * o).sum(axis=1)
    room = radius**2 - square + along**2
    half = np.sqrt(np.maximum(room, 0))
    t = np.where(-along - half > 0, -along - half, -along + half)
    return np.where((room > 0) & (t > 0), t, np.inf), (
        (np.abs(room) > 2e-3) & (np.abs(np.sqrt(square) - radius) > 2e-3)
    )


def wrong(field, n, seed, **settings):
    """How many of n rays have other hits than with the big sphere alone, or run out of steps."""
    o, d = rays(n, seed)
    settings = {"precision": "single", **settings}
    if settings["precision"] == "single":
        o, d = (x.astype(np.float32).astype(np.float64) for x in (o, d))
    hits = hk.trace(field, o, d, largest=True, **settings)
    t, certain = through_sphere(o, d, *BIG)
    hit = np.isfinite(t)
    assert 0.2 * n < (hit & certain).sum() < 0.8 * n
    off = hits.is_hit != hit
    both = hits.is_hit & hit
    off[both] = np.abs(hits.t[both] - t[both]) > 5e-3
    return int((certain & (off | (hits.status == hk.RayStatus.OUT_OF_STEPS))).sum())


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize("name", FIELDS)
def test_first_hits_are_those_of_the_largest(name, precision):
    assert wrong(FIELDS[name], 5000, 0, precision=precision, tolerance=1e-5) == 0


@pytest.mark.slow
@pytest.mark.parametrize("over_relaxation", [1.0, 1.9])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-7])
def test_first_hits_with_other_steps(tolerance, over_relaxation):
    for name in FIELDS:
        count = wrong(
            FIELDS[name], 50_000, 1,
            precision="double", tolerance=tolerance, over_relaxation=over_relaxation,
        )  # fmt: skip
        assert count == 0


@pytest.mark.slow
def test_wrong_groups_are_noticed(monkeypatch):
    alone = np.zeros((3, 3, 3), np.bool_)
    alone[1, 1, 1] = True
    field = hk.Sphere(*BIG) | hk.Sphere(*SMALL)
    with monkeypatch.context() as patch:
        patch.setattr(empty_space, "_NEIGHBOR_STENCIL", alone)  # no cell has a neighbor
        assert wrong(field, 1000, 0) > 100
    field = hk.Sphere(*BIG) | hk.Sphere(*SMALL)  # nothing is kept of it
    with monkeypatch.context() as patch:
        patch.setattr(empty_space.np, "argmax", np.argmin)
        assert wrong(field, 1000, 0) > 100
    assert wrong(hk.Sphere(*BIG) | hk.Sphere(*SMALL), 1000, 0) == 0


@pytest.mark.slow
def test_pieces_that_a_clip_leaves_are_left_out():
    """Above level 1 Schwarz's P surface is a closed surface in each cell of the lattice."""
    field, ball = hk.fields.SchwarzP(1.0), hk.Ball(radius=0.9)
    o, d = rays(4000, 3)
    hits = hk.trace(field, o, d, level=1.2, clip=ball, largest=True, tolerance=1e-5)
    cell = hk.Box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    alone = hk.trace(field, o, d, level=1.2, clip=cell, tolerance=1e-5)
    whole = hk.trace(field, o, d, level=1.2, clip=ball, tolerance=1e-5)
    assert (whole.is_hit & ~alone.is_hit).sum() > 200
    assert alone.is_hit.sum() > 100
    assert (hits.is_hit != alone.is_hit).sum() <= 2  # rays that graze it
    both = hits.is_hit & alone.is_hit
    assert (np.abs(hits.t[both] - alone.t[both]) < 5e-3).mean() > 0.999


@pytest.mark.slow
def test_parts_that_end_at_the_domain_are_told_apart_there():
    """x y z = 0.05 has four parts, one in each octant where x y z > 0, that end at the sphere in
    which the polynomial is known."""
    field = hk.HarmonicPolynomial({(1, 1, 1): 1.0})
    o, d = rays(4000, 6)
    hits = hk.trace(field, o, d, level=0.05, largest=True)
    x = hits.position[hits.is_hit]
    octant = np.sign(x).mean(axis=0)
    assert np.abs(octant).tolist() == [1, 1, 1]
    corner = 2.0 * octant
    box = hk.Box(tuple(np.minimum(corner, 0)), tuple(np.maximum(corner, 0)))
    alone = hk.trace(field, o, d, level=0.05, clip=box)
    assert alone.is_hit.sum() > 100
    assert (hits.is_hit != alone.is_hit).sum() <= 3  # rays that graze it


def test_a_section_is_for_looking_into_what_was_the_largest():
    """The bigger ball is cut away but for a piece that is smaller than the other one."""
    field = hk.Sphere(*BIG) | hk.Sphere(*SMALL)
    cut = hk.HalfSpace((-1, 0, 0), 0.2)  # x >= -0.2
    o, d = np.array([[3.0, 0, 0], [0.5, 0, 3.0]]), np.array([[-1.0, 0, 0], [0, 0, -1.0]])
    hits = hk.trace(field, o, d, section=cut, largest=True)
    assert hits.is_hit.tolist() == [True, False]
    assert hits.t[0] == pytest.approx(3.1, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", "double"])
def test_of_a_solid_the_part_of_largest_volume_is_there(precision):
    backend = choose_backend(precision)
    both = hk.Sphere(*BIG) | hk.Sphere(*SMALL)
    clip = hk.HalfSpace((0.0, 1.0, 0.0), 0.1)
    o, d = rays(4000, 5)
    met = []
    for field, largest in ((both, True), (hk.Sphere(*BIG), False)):
        surface = traced_surface(field, level=0.0, side="below", clip=clip, largest=largest)
        placed = PlacedSurface.of(surface, Placement.identity(), backend)
        rays_of = to_vector3(backend, o), to_vector3(backend, d)
        seen = placed.intersect(*rays_of, backend.Float(1e3), backend.Bool(True))
        blocked = placed.occludes(*rays_of, backend.Float(1e3), backend.Bool(True))
        results = seen.is_hit, seen.t, blocked, seen.is_out_of_steps
        met.append([to_numpy(array) for array in results])
    (has, t, blocked, lost), (has_alone, t_alone, blocked_alone, _) = met
    assert not lost.any()
    assert 500 < has_alone.sum() < 3500
    assert (has != has_alone).sum() <= 4  # rays that graze it
    assert (blocked != blocked_alone).sum() <= 4
    both = has & has_alone
    assert (np.abs(t[both] - t_alone[both]) < 5e-3).mean() > 0.998


@pytest.mark.slow
def test_what_is_not_told_apart_stays_together():
    near = hk.Sphere(0.5, (-0.5005, 0, 0)) | hk.Sphere(0.4, (0.4005, 0, 0))
    o, d = np.array([[0.4, 0, 3.0], [-0.5, 0, 3.0]]), np.array([[0, 0, -1.0]])
    assert hk.trace(near, o, d, largest=True).is_hit.all()
    apart = hk.Sphere(0.5, (-0.55, 0, 0)) | hk.Sphere(0.4, (0.45, 0, 0))
    assert hk.trace(apart, o, d, largest=True).is_hit.tolist() == [False, True]
    assert hk.trace(apart, o, d, largest=16).is_hit.all()


@pytest.mark.slow
def test_rays_whose_cells_rounding_leaves_open_are_out_of_steps():
    o, d = [[1e5, 0.0, 0.0], [10.0, 0.0, 0.0]], [[-1.0, 0.0, 0.0]]
    hits = hk.trace(FIELDS["solids"], o, d, largest=True)
    assert hits.status.tolist() == [hk.RayStatus.OUT_OF_STEPS, hk.RayStatus.HIT]
    assert hk.trace(FIELDS["solids"], o, d, largest=True, precision="double").is_hit.all()


@pytest.mark.slow
def test_what_has_no_largest_component_is_refused():
    ray = [[3.0, 0, 0]], [[-1.0, 0, 0]]
    with pytest.raises(ValueError, match="first hits alone"):
        hk.trace(FIELDS["solids"], *ray, largest=True, require_crossing=True)
    with pytest.raises(TypeError, match="crossings has no largest"):
        hk.crossings(FIELDS["solids"], *ray, largest=True, max_crossings=2)
    with pytest.raises(ValueError, match="with bounds"):
        hk.trace(hk.solids.Plane(), *ray, largest=True)
    with pytest.raises(ValueError, match="from 8 to 512"):
        hk.Surface(FIELDS["solids"], largest=3)
    with pytest.raises(ValueError, match="most cells of this Blobs could not be proved empty"):
        hk.trace(hk.Blobs([[-1, 0, 0], [1, 0, 0]], 0.5), *ray, largest=True)
    mesh = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), [[0, 1, 2]]
    with pytest.raises(ValueError, match="one continuous function, and this WindingNumber jumps"):
        hk.Surface(hk.WindingNumber(*mesh), largest=True)
