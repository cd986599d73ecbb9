"""Hostile blobs, points with normals, and files of molecules: rays that all but touch, along the
faces of cells, far from the origin, against sums written here a second time in double precision."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.fields.blobs.blobs import BlobError
from harnack.fields.blobs.grid import _MARGIN, BlobGrid, CellLists
from harnack.files import FileFormatError, read_molecule

PRECISIONS = ("single", "double")
SHARPNESS, TAIL = 1.0, 1e-3
GAUSSIAN = math.sqrt(1 - math.log(TAIL) / SHARPNESS)
# A kernel, where it ends, and its formula in the squared distance as a part of that.
KERNELS: dict[str, tuple[Any, float, Any]] = {
    "compact": (hk.kernels.CompactKernel(1.02), 1.02, lambda q: (1 - q) ** 3),
    "cubic": (hk.kernels.CubicKernel(2.0), 2.0, lambda q: 1 - 3 * q + 2 * q**1.5),
    "sextic": (
        hk.kernels.SexticKernel(1.3),
        1.3,
        lambda q: 1 - (22 * q - 17 * q**2 + 4 * q**3) / 9,
    ),
    "gaussian": (
        hk.kernels.GaussianKernel(SHARPNESS, TAIL),
        GAUSSIAN,
        lambda q: np.exp(SHARPNESS * GAUSSIAN**2 * (1 - q)) - 1 - SHARPNESS * GAUSSIAN**2 * (1 - q),
    ),
}
QUICK_KERNELS = [
    pytest.param(name, marks=() if name in ("compact", "gaussian") else pytest.mark.slow)
    for name in KERNELS
]


class Sum:
    """The largest of the sums of blobs, along rays, in double precision."""

    def __init__(self, name: str, centers: Any, radii: Any, weights: Any, groups: Any) -> None:
        kernel, self.support, self.k = KERNELS[name]
        self.blobs = hk.Blobs(centers, radii, weights, kernel=kernel, groups=groups)
        self.c, self.r, self.w = centers, radii, weights / self.k(self.support**-2)
        self.groups = np.zeros(len(radii), int) if groups is None else groups

    def along(self, o: Any, d: Any, t: Any) -> Any:
        """At o + t d, t (m,)."""
        away = self.c - o
        at = away @ d
        squares = ((away - at[:, None] * d) ** 2).sum(-1) + (t[:, None] - at) ** 2
        q = squares / (self.r * self.support) ** 2
        terms = np.where(q < 1, self.w * self.k(np.minimum(q, 1)), 0)
        return np.max([terms[:, self.groups == g].sum(1) for g in set(self.groups)], axis=0)

    def gradient(self, x: Any) -> Any:
        h = 1e-5 * self.r.min()
        zero = np.zeros(1)
        return np.array(
            [
                (self.along(x + e, e / h, zero)[0] - self.along(x - e, e / h, zero)[0]) / (2 * h)
                for e in h * np.eye(3)
            ]
        )

    def times(self, o: Any, d: Any, end: float) -> Any:
        """Many t within each support that a ray meets."""
        away = self.c - o
        at = away @ d
        left = (self.r * self.support) ** 2 - ((away - at[:, None] * d) ** 2).sum(-1)
        half = np.sqrt(np.maximum(left, 0))
        t = (at[:, None] + half[:, None] * np.linspace(-1, 1, 25)).ravel()
        return np.unique(np.concatenate([[0.0, end], t[(t > 0) & (t < end)]]))

    def largest(self, o: Any, d: Any, t: Any, sign: float) -> tuple[float, float]:
        """Where sign f is largest between those t, and how large."""
        for _ in range(6):
            f = sign * self.along(o, d, t)
            k = int(np.argmax(f))
            best = float(t[k]), float(f[k])
            t = np.linspace(t[max(k - 1, 0)], t[min(k + 1, len(t) - 1)], 33)
        return best

    def tangents(self, count: int, depths: Any, rng: Any) -> tuple[Any, Any]:
        """Rays that pass through the surface f = 1 at these depths, in parts of a radius."""
        rays: list[Any] = []
        while len(rays) < count:
            i = rng.integers(len(self.c))
            d = unit(rng.normal(size=3))
            t = np.linspace(0, 3 * self.r[i] * self.support, 200)
            f = self.along(self.c[i], d, t) - 1
            (found,) = np.nonzero(f[:-1] * f[1:] < 0)
            if not found.size:
                continue
            a, b = t[found[0]], t[found[0] + 1]
            for _ in range(50):
                middle = (a + b) / 2
                here = self.along(self.c[i], d, np.array([middle]))[0] - 1
                a, b = (middle, b) if here * f[found[0]] > 0 else (a, middle)
            x = self.c[i] + a * d
            normal = unit(self.gradient(x))
            way = unit(np.cross(normal, rng.normal(size=3)))
            back = self.r[i] * rng.uniform(1, 10)
            rays.append((x + normal * rng.choice(depths) * self.r[i] - back * way, way))
        o, d = zip(*rays, strict=True)
        return np.array(o), np.array(d)


def unit(v: Any) -> Any:
    return v / np.linalg.norm(v)


def check_rays(scene: Sum, o: Any, d: Any, precision: Any, tolerance: float) -> None:
    """No crossing before a hit, none on a miss, but for what rounding of a position moves f."""
    dtype = np.float32 if precision == "single" else np.float64
    epsilon = float(np.finfo(dtype).eps)
    o, d = (one.astype(dtype).astype(np.float64) for one in (o, d))
    hits = hk.trace(scene.blobs, o, d, precision=precision, tolerance=tolerance)
    assert (hits.status != hk.RayStatus.OUT_OF_STEPS).all()
    size = np.abs(o).max() + 3 * np.ptp(scene.c) + 10 * scene.r.max()
    for i in range(len(o)):
        way, hit = unit(d[i]), hits.is_hit[i]
        # A hit may lie behind the root by less than the tolerance.
        end = max(float(hits.t[i]) - 2 * tolerance, 0.0) if hit else float(size)
        t = scene.times(o[i], way, end)
        sign = 1.0 if scene.along(o[i], way, t[:1])[0] < 1 else -1.0
        at, largest = scene.largest(o[i], way, t, sign)
        steep = np.linalg.norm(scene.gradient(o[i] + at * way))
        rounding = epsilon * (4 * steep * size + 8 * len(scene.c) * np.abs(scene.w).max())
        allowed = rounding + (steep * tolerance * 1.05 if hit else 0.0)
        assert largest - sign <= allowed, (o[i].tolist(), d[i].tolist())


@pytest.mark.few(3)
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", QUICK_KERNELS)
@pytest.mark.parametrize("kind", ["equal and nested", "negative", "groups", "grid"])
def test_rays_that_all_but_touch(name: str, precision: Any, kind: str) -> None:
    rng = np.random.default_rng(4)
    count = 90 if kind == "grid" else 12
    centers = rng.uniform(-1.5, 1.5, (count, 3)) * (count / 12) ** (1 / 3)
    radii = 10 ** rng.uniform(-0.5, 0.1, count)
    weights = np.ones(count) if kind == "grid" else rng.uniform(-1.5, 2.0, count)
    if kind == "equal and nested":
        centers[1], centers[2], weights = centers[0], centers[3] + 0.05, np.abs(weights)
        radii[2] = 0.2 * radii[3]
    groups = rng.integers(0, 4, count) if kind == "groups" else None
    scene = Sum(name, centers, radii, weights, groups)
    x = centers[:4] + 0.3
    mine = [scene.along(one, np.array([1.0, 0, 0]), np.zeros(1))[0] for one in x]
    np.testing.assert_allclose(scene.blobs.value(x, precision="double"), mine, atol=1e-10)
    depths = [1e-3, 1e-4, 3e-5] if precision == "single" else [1e-3, 1e-5, 1e-8]
    o, d = scene.tangents(20, depths, rng)
    check_rays(scene, o, d, precision, 1e-6)
    check_rays(scene, o, d, precision, 1e-2)


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["compact", "cubic"])
def test_rays_that_all_but_touch_cross_twice(name: str, precision: Any) -> None:
    """However small the tolerance, in single precision what swings by 2e-5 of the coordinates' size
    is a crossing; less need not be (`trace`)."""
    scene = Sum(name, np.zeros((1, 3)), np.ones(1), np.ones(1), None)
    depths = np.array([0.1, 1e-3, 2e-4] if precision == "single" else [0.1, 1e-4, 1e-6, 1e-9])
    o = np.column_stack([1 - depths, 0 * depths - 6, 0 * depths])
    hits = hk.crossings(
        scene.blobs, o, [[0, 1.0, 0]], precision=precision, tolerance=1e-10, max_crossings=4
    )
    half = np.sqrt(1 - (1 - depths) ** 2)
    assert (hits.count == 2).all()
    assert (hits.side[:, :2] == [1, -1]).all()
    off = 2e-5 / half if precision == "single" else 1e-13 / half
    assert (np.abs(hits.t[:, 0] - (6 - half)) < off + 1e-9).all()
    assert (np.abs(hits.t[:, 1] - (6 + half)) < off + 1e-9).all()
    first = hk.trace(
        scene.blobs, o, [[0, 1.0, 0]], precision=precision, tolerance=1e-10, require_crossing=True
    )
    np.testing.assert_array_equal(first.t, hits.t[:, 0])


@pytest.mark.few(1)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("kind", ["lattice", "giants", "clusters", "tiny"])
def test_rays_along_faces_and_edges_of_cells(precision: Any, kind: str) -> None:
    rng = np.random.default_rng(8)
    centers = rng.uniform(-6, 6, (216, 3))
    radii = rng.uniform(0.5, 1.0, 216)
    if kind == "lattice":
        centers = 2.0 * np.stack(np.meshgrid(*[np.arange(6)] * 3), -1).reshape(-1, 3)
    if kind == "giants":
        radii[:3] = 30.0, 12.0, 50.0
    if kind == "clusters":
        centers += rng.choice([0.0, 25.0, -40.0], (216, 3))
    if kind == "tiny":
        radii *= 10 ** rng.uniform(-3, 0, 216)
    scene = Sum("compact", centers, radii, np.ones(216), None)
    lists = scene.blobs.cell_lists
    assert lists is not None
    low, cell = lists.origin, lists.cell_size
    count = 60
    # From corners, edges and faces of cells that hold blobs, along axes and diagonals.
    place = np.floor((centers[rng.integers(0, 216, count)] - low) / cell)
    place += rng.random((count, 3)) * rng.integers(0, 2, (count, 3))
    d = rng.choice([-1.0, 0.0, 1.0], (count, 3))
    d[::2] = np.roll(np.eye(3), 1, axis=0)[rng.integers(0, 3, count // 2)]
    d[~d.any(1)] = 1.0, 0.0, 0.0
    d[::5] += 1e-6 * rng.normal(size=(count // 5, 3))
    back = rng.integers(0, 2, count) * rng.integers(0, 40, count)
    o = low + (place - back[:, None] * d) * cell
    check_rays(scene, o, d, precision, 1e-3)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_no_path_leaves_the_lists_of_its_cells(precision: Any) -> None:
    """Where a path may go lies within the margin in which the lists of its cells are right: of one
    cell, and of all the empty ones around."""
    rng = np.random.default_rng(2)
    centers = rng.uniform(-9, 9, (80, 3))
    lists = CellLists.of(centers, np.full(80, 0.7))
    backend = choose_backend(precision)
    grid = BlobGrid.upload(backend, lists)
    p = rng.uniform(-10, 10, (4000, 3)).astype(backend.dtype).astype(np.float64)
    p[:900] = lists.origin + rng.integers(0, lists.shape, (900, 3)) * lists.cell_size  # corners
    d = rng.normal(size=p.shape)
    d[::4] = np.eye(3)[rng.integers(0, 3, 1000)]
    d /= np.linalg.norm(d, axis=1)[:, None]
    here = grid.cell(to_vector3(backend, p))
    corner = to_numpy(here.corner).astype(np.float64)
    shape = np.array(lists.shape)
    for around in (
        np.ones(len(p)),
        np.maximum(to_numpy(here.empty_distance).astype(np.float64), 1),
    ):
        length = to_numpy(here.exit_distance(to_vector3(backend, d), backend.Float(around)))
        place = (p + np.minimum(length, 1e3)[:, None] * d - lists.origin) / lists.cell_size
        lower, upper = corner + 1 - around[:, None], corner + around[:, None]
        assert ((place <= upper + _MARGIN) | (upper >= shape)).all()
        assert ((place >= lower - _MARGIN) | (lower <= 0)).all()
        # And it does get past the face, by more than rounding.
        inside = (place < upper + 0.01) & (place > lower - 0.01)
        assert not (inside.all(1) & np.isfinite(length)).any()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_slopes_of_hrbf_on_short_pieces(precision: Any, offset: float) -> None:
    """On short pieces ranges of the slope are narrower than its rounding, which must be in them."""
    rng = np.random.default_rng(0)
    n = rng.normal(size=(17, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    f = hk.fields.HRBF(n * (1 + 0.2 * np.sin(3 * n[:, :1])) + offset, 2.0 * n)
    backend = choose_backend(precision)
    count = 500
    p = rng.uniform(-1.5, 1.5, (count, 3)) + offset
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    p, d = (one.astype(backend.dtype).astype(np.float64) for one in (p, d))
    knots = [0.0, backend.Float(1e-9), backend.Float(2e-9)]
    on_backend: Any = f.evaluator(backend).function
    ranges_along = on_backend.along(to_vector3(backend, p), to_vector3(backend, d), knots)
    v = p[:, None] - f.points
    r = np.linalg.norm(v, axis=-1)
    along = (v * d[:, None]).sum(-1)
    b = 3 * f.gradient_coefficients
    # Of a r^3 + r b.v along d.
    slope = 3 * f.value_coefficients * r * along + (v * b).sum(-1) * along / r + r * (d @ b.T)
    slope = slope.sum(1)
    tiny = 1e-13 * (1 + np.abs(slope)) if precision == "single" else 0.0
    for part in ranges_along.parts:
        low, high = (
            to_numpy(end).astype(np.float64)
            for end in (part.slope_range.lower, part.slope_range.upper)
        )
        assert (low - tiny <= slope).all()
        assert (slope <= high + tiny).all()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize(
    ("center", "radius", "weight", "most"),
    [
        (0.0, 1.0, 1e300, "single"),
        (0.0, 1e38, 1.0, "single"),
        (0.0, 1e-25, 1.0, "single"),
        (1e39, 1.0, 1.0, "single"),
        (0.0, 1e-100, 1.0, "double"),
        (0.0, 1.0, 1e308, "double"),
    ],
)
def test_blobs_that_a_precision_does_not_hold(
    center: float, radius: float, weight: float, most: str, precision: Any
) -> None:
    """They were called too small whatever was wrong with them, in single precision always; and one
    whose inverse radius vanished filled all of space."""
    blobs = hk.Blobs([[0, 0, 0], [center, 0, 0]], [1.0, radius], [1.0, weight])
    backend = choose_backend(precision)
    if precision == "double" and most == "single":
        blobs.evaluator(backend)
        return
    with pytest.raises(BlobError, match=f"^blob 1, .* for {precision} precision: "):
        blobs.evaluator(backend)


def test_radii_may_not_be_of_any_size() -> None:
    with pytest.raises(BlobError, match="too large"):
        hk.Blobs([[0, 0, 0]], 1e300)


GLYCINE = "ATOM      1  N   GLY A   1      11.104   6.134  -6.504  1.00  0.00           N\n"


@pytest.mark.parametrize(
    "line",
    [
        GLYCINE.replace("  11.104", "     nan"),
        GLYCINE.replace("ATOM", "atom").replace("  11.104", "     nan"),
        GLYCINE.replace("ATOM      1", "ATOM 100001").replace("  11.104", "     abc"),
        GLYCINE.replace("ATOM      1", "ATOM1000001").replace("  11.104", "     abc"),
        GLYCINE.replace("ATOM  ", "HETATN").replace("  11.104", "     abc"),
        GLYCINE.replace("  11.104", "  1_1.04"),
        GLYCINE.replace("   6.134", " 6.1 34 "),
    ],
)
def test_atoms_whose_coordinates_are_no_numbers(line: str, tmp_path: Path) -> None:
    """Some of these were atoms at 0 or at the digits before what is no number."""
    path = tmp_path / "a.pdb"
    path.write_text(GLYCINE + line)
    with pytest.raises(FileFormatError, match="line 2: columns 31 to 54"):
        read_molecule(path)
