"""What a person turns is data: other curves, levels, tolerances and cameras compile no kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.geometry.example_meshes import icosphere
from harnack.rendering import Camera, register

register()


def knot(k: int) -> hk.Field:
    t = np.linspace(0, 2 * np.pi, 60 + k, endpoint=False)
    x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    return hk.SolidAngle((1 + 0.1 * k) * np.column_stack([x, y, -np.sin(3 * t)]) + k)


def cut_sphere(k: int) -> hk.Field:
    """With so many edges that rays jump across empty cells: without these the kernel is another."""
    vertices, faces = icosphere(3)
    return hk.WindingNumber((1 + 0.1 * k) * vertices, faces[np.arange(len(faces)) % (5 + k) > 0])


def tree(k: int) -> hk.Field:
    vertices, faces = icosphere(2)
    kept = faces[np.arange(len(faces)) % (5 + k) > 0]
    return hk.WindingNumber((1 + 0.1 * k) * vertices, kept, method="tree")


def cloud(k: int) -> hk.Field:
    vertices, _ = icosphere(3)
    return hk.DipolePotential((1 + 0.1 * k) * vertices, vertices)


def compiled(call: Callable[[], object], size: int | None = None) -> int:
    """How many kernels, of `size` lanes if given, were not there yet when `call` needed them.

    What a former run has left on disk counts: it was compiled for these very numbers.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        call()
        kernels = dr.kernel_history((dr.KernelType.JIT,))
    new = (one for one in kernels if not one["cache_hit"] or one["cache_disk"])
    return sum(size in (None, one["size"]) for one in new)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "level"),
    [(knot, 6.0), (cut_sphere, 0.5), (tree, 0.5), (cloud, 6.0)],
)
def test_another_surface_compiles_no_kernel(make: Callable[[int], hk.Field], level: float) -> None:
    rng = np.random.default_rng(0)

    def trace(k: int) -> int:
        o = np.tile([3.0 + 0.1 * k, -2.0, 2.0], (300, 1))
        d = 0.4 * rng.normal(size=(300, 3)) - o
        settings = {"level": level * (1 - 0.01 * k), "tolerance": 1e-4 * (1 + 0.1 * k)}
        # Of rays: those that pack a tree are small, and come in a few kinds by its size.
        return compiled(lambda: hk.trace(make(k), o, d, precision="single", **settings), size=300)

    trace(0), trace(1)
    assert [trace(k) for k in range(2, 5)] == [0] * 3


@pytest.mark.few(1)
@pytest.mark.parametrize("search", ["crossings", "require_crossing"])
@pytest.mark.parametrize(("make", "level"), [(knot, 6.0), (cut_sphere, 0.5)])
def test_crossings_of_another_surface_compile_no_kernel(
    make: Callable[[int], hk.Field], level: float, search: str
) -> None:
    o = 3 * np.random.default_rng(0).normal(size=(300, 3))

    def follow(surface: hk.Surface, options: hk.TraceOptions) -> Any:
        if search == "crossings":
            return hk.crossings(surface, o, -o, max_crossings=5, options=options)
        return hk.trace(surface, o, -o, options=options.replace(require_crossing=True))

    def trace(k: int) -> int:
        options = hk.TraceOptions(tolerance=1e-4 * (1 + 0.1 * k), precision="single")
        surface = hk.Surface(make(k), level * (1 - 0.01 * k))
        return compiled(lambda: follow(surface, options), size=300)

    trace(0), trace(1)
    assert [trace(k) for k in range(2, 6)] == [0] * 4


def around_a_circle(k: int) -> np.ndarray:
    """Vertices first in a plane, then in convex position, then in no position at all."""
    t = np.linspace(0, 2 * np.pi, 30, endpoint=False)
    circle = np.column_stack([np.cos(t), np.sin(t), 0 * t])
    return circle + 0.002 * k**2 * np.random.default_rng(k).normal(size=circle.shape)


def test_curves_around_a_circle_have_hulls_of_all_kinds() -> None:
    curves = [hk.SolidAngle(around_a_circle(k)) for k in range(10)]
    assert [one.lift_bound for one in curves[:2]] == ["planar", "range"]
    assert curves[-1].lift_bound == "edges"
    assert len({len(one.extent((2 * np.pi,)).planes()) for one in curves}) > 2


@pytest.mark.few(1)
@pytest.mark.parametrize("wanted", ["value", "trace"])
@pytest.mark.parametrize("level", [None, 5.0])
def test_a_step_of_an_optimization_compiles_no_kernel(wanted: str, level: float | None) -> None:
    """Other proofs would hold of each of the curves, and hulls have other numbers of planes."""
    backend = choose_backend()
    towards = 0.3 * np.random.default_rng(0).normal(size=(40, 3))
    points, d = (to_vector3(backend, v) for v in (towards, towards - [0, 0, 3]))

    def step(k: int) -> None:
        vertices = to_vector3(backend, around_a_circle(k))
        own = None if level is None else backend.Float(level + 0.01 * k)
        dr.enable_grad(vertices, own)
        curve = hk.SolidAngle(vertices)
        if wanted == "value":
            loss = dr.square(dr.sin(curve.value(points) / 4))
        else:
            # What is literal must not become a part of kernels: `own`, and where rays start.
            hits = hk.trace(curve, backend.Array3f(0, 0.01 * k, 3), d, level=own)
            loss = dr.select(hits.is_hit, dr.square(hits.t), 0)
        dr.backward(dr.sum(loss))
        assert np.abs(to_numpy(vertices.grad)).max() > 0
        assert own is None or (float(own.grad[0]) != 0) == (wanted == "trace")

    dr.flush_kernel_cache()  # what other tests have compiled
    step(0), step(1)
    assert [compiled(lambda k=k: step(k)) for k in range(2, 10)] == [0] * 8


def camera(k: int) -> Camera:
    return Camera(azimuth=-50 + 7.3 * k, elevation=20 + k, fov=20 + k, zoom=1 + 0.05 * k)


def drawn(what: Any, k: int, show: str, **settings: Any) -> int:
    """How many kernels a small picture compiles, of which all is other than in the k before."""
    settings = {"camera": camera(k), "backdrop": ("light", "dark")[k % 2], "seed": k} | settings
    small = {"size": (24, 18), "spp": 4, "progress": False}
    return compiled(lambda: hk.render(what, show=show, **settings, **small))


@pytest.mark.slow
@pytest.mark.parametrize("show", [pytest.param("path", marks=pytest.mark.slow), "shaded"])
def test_another_picture_compiles_no_kernel(show: str) -> None:
    def picture(k: int) -> int:
        settings: dict[str, Any] = {"level": 6 - 0.02 * k}
        if show == "path":
            settings["max_depth"] = 3 + k
        return drawn(knot(k), k, show, tolerance=1e-4 * (1 + 0.1 * k), **settings)

    picture(0), picture(1)
    assert [picture(k) for k in range(2, 5)] == [0] * 3


HARMONIC = hk.SphericalHarmonic(3, 2)


def cut(k: int) -> hk.geometry.Volume:
    box = hk.Box((-1 - 0.1 * k, -1, -1), (1, 2, 0.5 + 0.01 * k))
    return hk.geometry.VolumeIntersection([hk.Ball((0.01 * k, 0, 0), 1 + 0.1 * k), box])


def lines(k: int) -> list[hk.Isolines]:
    """At other levels, of other widths and colors."""
    levels = np.random.default_rng(k).normal(size=3 + k)
    color = (0.04 * k, 1 - 0.04 * k, 0.5)
    return [
        hk.Isolines("z", levels, width=0.01 + 0.001 * k, color=color),
        hk.Isolines(knot(k), interval=np.pi / (1 + k), color="white"),
        hk.Isolines("x", interval=0.1 + 0.01 * k),
    ]


@pytest.mark.slow
def test_other_isolines_compile_no_kernel() -> None:
    def picture(k: int) -> int:
        return drawn(HARMONIC, k, "shaded", level=0.2, clip=cut(k), isolines=lines(k))

    picture(0), picture(1)
    assert [picture(k) for k in range(2, 5)] == [0] * 3


PICTURES: dict[str, Callable[[int], int]] = {
    **{
        show: lambda k, show=show: drawn(
            knot(k), k, show, level=6 - 0.02 * k, color_by=knot(k + 1) if show == "value" else None
        )
        for show in hk.rendering.SHOW_MODES
    },
    "clipped": lambda k: drawn(HARMONIC, k, "path", level=0.1 + 0.01 * k, clip=cut(k)),
    "glass": lambda k: drawn(
        HARMONIC, k, "path", level=0.1 + 0.01 * k, side="below", clip=cut(k), material="glass"
    ),
    "amber": lambda k: drawn(
        HARMONIC, k, "shaded", level=0.1 + 0.01 * k, side="below", clip=cut(k), material="amber"
    ),
    "wall": lambda k: drawn(
        HARMONIC, k, "shaded", level=(-0.1 - 0.01 * k, 0.2), side="between", clip=cut(k)
    ),
    "section": lambda k: drawn(
        HARMONIC,
        k,
        "shaded",
        level=0.1 + 0.01 * k,
        side="below",
        section_material="gold",
        section=hk.HalfSpace((0.02 * k, -1, 0.3), 0.01 * k),
    ),
    "largest": lambda k: drawn(
        HARMONIC, k, "shaded", level=0.1 + 0.01 * k, largest=24 + k, clip=cut(k)
    ),
    "mesh": lambda k: drawn(cut_sphere(k), k, "shaded"),
    "tree": lambda k: drawn(tree(k), k, "shaded"),
    "cloud": lambda k: drawn(cloud(k), k, "shaded", level=6 - 0.06 * k),
    "isolines": lambda k: drawn(HARMONIC, k, "path", level=0.2, clip=cut(k), isolines=lines(k)),
    "two": lambda k: drawn([knot(k), cut_sphere(k)], k, "path"),
}


def test_another_number_of_points_compiles_no_kernel() -> None:
    field, points = cut_sphere(0), np.random.default_rng(0).normal(size=(700, 3))
    for count in (600, 601):
        field.value(points[:count], precision="single")
    for count in (607, 700):
        assert compiled(lambda n=count: field.value(points[:n], precision="single")) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_no_other_picture_compiles_a_kernel(name: str) -> None:
    PICTURES[name](0), PICTURES[name](1)
    assert [PICTURES[name](k) for k in range(2, 4)] == [0] * 2
