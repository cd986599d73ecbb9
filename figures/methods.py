"""Figs. 24 to 27: marching cubes, fixed steps, claimed constants and root finding, all unproved."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

import harnack as hk
from benchmarks import baselines
from benchmarks.baselines import APART, Method, Rays, Result
from harnack.geometry import example_curves
from harnack.rendering import Camera

from .figure import Report
from .panels import Panel, doubled, fitting, halved, montage
from .view import BACK, FALSE, FRONT, MISSED, Array, Pixels, View, marked, mesh_hits

_FALSE_SHEET = (0.85, 0.25, 0.55)


@dataclass(frozen=True)
class _Contest:
    """A surface traced by several methods along the same rays.

    inside: (pixels,) whether a pixel has a ray, where the field has a domain. truth: the oracle's
    first hits of these rays.
    """

    view: View
    rays: Rays
    inside: Array
    truth: Array
    ours: Result

    @classmethod
    def of(cls, field: hk.Field, level: float, view: View) -> _Contest:
        rays, inside = Rays.along(field, level, view.eye, view.directions())
        truth = baselines.oracle(rays)
        return cls(view, rays, inside, truth, baselines.measure_ours(rays, truth))

    @property
    def hits(self) -> int:
        return int(np.isfinite(self.truth).sum())

    def measure(self, name: str, method: Method) -> Result:
        return baselines.measure(self.rays, name, method, self.truth)

    def drawn(self, result: Result) -> Pixels:
        """The picture by a method: missed first hits magenta, false hits green."""
        hit = np.isfinite(result.t)
        t = np.where(hit, result.t, 0)
        points = self.rays.origins + t[:, None] * self.rays.directions
        gradient = np.zeros_like(points)
        gradient[hit] = self.rays.field.gradient(points[hit], precision="double")
        size = np.linalg.norm(gradient, axis=1, keepdims=True)
        normal = np.zeros((len(self.inside), 3))
        normal[self.inside] = gradient / np.maximum(size, 1e-30)
        picture = self.view.shade(normal, self._all(hit))
        for is_marked, color in ((result.early, FALSE), (result.late, MISSED)):
            picture = marked(picture, self._all(is_marked), color)
        return picture

    def told(self, results: list[Result]) -> str:
        """Counts of methods; for harnack also the distance of its false hits from the surface."""
        text = "; ".join(
            f"{row.name}: {row.missed:,} missed and {row.false:,} false at {row.evaluations:.1f} "
            "evaluations a ray"
            for row in results
        )
        rows = np.flatnonzero(self.ours.early)
        if not len(rows):
            return text
        gap = np.abs(self.rays.above(self.ours.t[rows], rows))
        points = self.rays.points(self.ours.t[rows], rows)
        slope = np.linalg.norm(self.rays.field.gradient(points, precision="double"), axis=1)
        return (
            f"{text}, where the surface is grazed at a distance of {(gap / slope).max():.0e} at "
            "most, by value over slope"
        )

    def panel(self, result: Result) -> Panel:
        text = f"{result.evaluations:.0f} looks, {result.missed} missed, {result.false} false"
        return Panel(doubled(self.drawn(result)), f"{result.name}: {text}")

    def _all(self, values: Array) -> Array:
        """Values of all pixels, from values of the pixels with a ray."""
        pixels = np.zeros(len(self.inside), bool)
        pixels[self.inside] = values
        return pixels


@functools.cache
def _contest(name: str, width: int) -> _Contest:
    """The contest of Figs. 25, 26 and 27, cached, as its oracle takes most of the time."""
    size = fitting(max(16, 2 * width // 3))  # drawn at twice this size
    camera = Camera(azimuth=-60, elevation=24, zoom=0.95)
    if name == "gyroid":
        ball = hk.Ball(radius=1)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        view = View.of(0.75 * corners, size, camera)
        return _Contest.of(hk.Gyroid(cell=2 / 3, domain=ball), 0.0, view)
    field = (
        baselines.trefoil() if name == "trefoil" else hk.SolidAngle(example_curves.wavy_polygon(12))
    )
    if name == "trefoil":
        camera = Camera(azimuth=-80, elevation=52, zoom=0.9)
    return _Contest.of(field, 2 * math.pi, View.of(field.loops[0], size, camera))


_COLORS = (
    f"Missed first hits are magenta; hits where nothing is, or more than {APART} before the "
    "surface, green; against dense samples of every ray."
)


def figure_25(width: int) -> Report:
    """Fixed steps."""
    contest = _contest("polygon", width)
    steps = (0.1, 0.02, 0.004)
    results = [contest.measure(f"steps {s:g}", baselines.fixed_steps(s)) for s in steps]
    results.append(contest.ours)
    caption = (
        f"The 2π level of a polygon of 12 vertices, {len(contest.truth):,} rays with "
        f"{contest.hits:,} hits, followed in equal steps (unproved) and by harnack. {_COLORS} "
        f"{contest.told(results)}. With the smallest step no hit is missed here, and nothing says "
        "so beforehand."
    )
    differs = (
        "The paper's polygon and steps are not stated; its pictures are 1423 x 800. Ours refuses "
        "changes of sign by more than half a period, without which every jump would be a hit."
    )
    panels = [contest.panel(result) for result in results]
    return Report(montage(panels[:2], panels[2:]), caption, differs)


def figure_26(width: int) -> Report:
    """Sphere tracing with constants that are claimed."""
    rows, texts = [], []
    for name, label in (("polygon", "polygon of 12 vertices"), ("trefoil", "trefoil")):
        contest = _contest(name, width)
        results = [
            contest.measure(f"L = {constant:g}", baselines.sphere_tracing(constant))
            for constant in (5.0, 50.0, 500.0)
        ]
        results.append(contest.ours)
        panels = [contest.panel(result) for result in results]
        rows += [panels[:2], panels[2:]]
        texts.append(
            f"{label}, {len(contest.truth):,} rays with {contest.hits:,} hits: "
            f"{contest.told(results)}"
        )
    caption = (
        "Sphere tracing with three claimed Lipschitz constants L, of which none holds near the "
        f"curve (unproved), and harnack. {_COLORS} Rays that are still on their way after "
        f"{baselines.MOST:,} steps count as missed. {'. '.join(texts)}."
    )
    differs = (
        "The paper's surface is not stated. Its observation that L = 50 costs as much as Harnack "
        "tracing is about its own rule; with ours, any of these constants costs more."
    )
    return Report(montage(*rows), caption, differs)


def figure_27(width: int) -> Report:
    """Root finding."""
    rows, texts = [], []
    for name, label in (("gyroid", "gyroid"), ("polygon", "polygon of 12 vertices"),
                        ("trefoil", "trefoil")):  # fmt: skip
        contest = _contest(name, width)
        methods: list[tuple[str, Method]] = [
            ("Newton", baselines.newton), ("bisection", baselines.bisection)
        ]  # fmt: skip
        if name != "trefoil":  # whose 48 edges take a minute in interval arithmetic
            methods.append(("intervals", baselines.interval_analysis))
        results = [*(contest.measure(*method) for method in methods), contest.ours]
        panels = [contest.panel(method) for method in results]
        rows += [panels[:2], panels[2:]]
        texts.append(
            f"{label}, {len(contest.truth):,} rays with {contest.hits:,} hits: "
            f"{contest.told(results)}"
        )
    caption = (
        f"Newton's method, bisection and interval analysis (unproved), and harnack. {_COLORS} "
        f"{'. '.join(texts)}. Interval analysis is a proof where the function is continuous, as "
        "the gyroid is: its false hits there are leaves that it cannot tell from the surface; on "
        "the angles it stops at jumps."
    )
    differs = (
        "The paper's settings are not stated; ours are in `benchmarks/baselines.py`. Bisection "
        "and interval analysis find the jumps of the angle, as in the paper; that opaque "
        "background is what is green here."
    )
    return Report(montage(*rows), caption, differs)


def figure_24(width: int) -> Report:
    """Marching cubes of the raw function."""
    loop = example_curves.wavy_polygon(12)
    field = hk.SolidAngle(loop)
    view = View.of(1.25 * loop, tuple(2 * s for s in fitting(width)), Camera(-60, 24))
    truth = view.trace(field, tolerance=1e-7, precision="double")
    real = np.where(truth.is_hit, truth.t, np.inf)
    panels, texts = [], []
    for cells, keep in ((48, False), (144, False), (48, True), (144, True)):
        vertices, faces, close = _marching_cubes(field, cells)
        faces, close = (faces[close], close[close]) if keep else (faces, close)
        hits = mesh_hits(vertices, faces, view.eye, view.directions())
        face = np.where(hits.is_hit, hits.face, 0)
        front, back = (np.where(close[face][:, None], c, _FALSE_SHEET) for c in (FRONT, BACK))
        shown = view.shade(hits.normal, hits.is_hit, front, back)
        lost = truth.is_hit & ~hits.is_hit
        shown = marked(shown, lost, MISSED)
        is_wrong = hits.is_hit & ~((hits.t < real + APART) & (hits.t > real - APART))
        name = f"{cells}^3 cells, filtered" if keep else f"{cells}^3 cells"
        panels.append(Panel(halved(shown), name))
        texts.append(
            f"{name}: {len(faces):,} triangles, {100 * (~close).mean():.0f} % of them far from "
            f"the level; of {int(truth.is_hit.sum()):,} hits {int(lost.sum()):,} are lost, and "
            f"{int(is_wrong.sum()):,} rays end more than {APART} from the surface"
        )
    ours = view.trace(field)
    unequal = ours.is_hit != truth.is_hit
    panels.append(Panel(halved(view.shade(ours.normal, ours.is_hit)), "harnack"))
    caption = (
        "Marching cubes (scikit-image; unproved) of the solid angle of 12 vertices modulo 4π, "
        "level 2π, on grids of [-1.3, 1.3]³. Triangles whose middle is farther than π/2 from the "
        "level are pink: the sheet on which the angle jumps. Filtered are those without them; "
        f"what is then lost of the true surface is magenta. {'; '.join(texts)}. harnack along the "
        f"same rays: {ours.evaluations.mean():.1f} evaluations a ray, {int(unequal.sum())} rays "
        "differ in whether they hit from the reference, whose tolerance is a thousandth of its."
    )
    differs = (
        "The paper also shows Mathematica's adaptive `ContourPlot3D`, which is not free software "
        "and is left out. Its polygon and grid are not stated."
    )
    return Report(montage(panels[:3], panels[3:]), caption, differs)


def _marching_cubes(field: hk.SolidAngle, cells: int) -> tuple[Array, Array, Array]:
    """Vertices and triangles of the 2 pi level of the angle in [0, 4 pi), and which of them have
    centers at which the angle is within pi/2 of that level."""
    from skimage.measure import marching_cubes

    u = np.linspace(-1.3, 1.3, cells + 1)
    grid = np.stack(np.meshgrid(u, u, u, indexing="ij"), axis=-1).reshape(-1, 3)
    value = np.mod(field.value(grid, precision="single"), 4 * np.pi).reshape((cells + 1,) * 3)
    vertices, faces, _, _ = marching_cubes(value, 2 * np.pi)
    vertices = vertices * (2.6 / cells) - 1.3
    centers = vertices[faces].mean(axis=1)
    middle = np.mod(field.value(centers, precision="single"), 4 * np.pi)
    return vertices, faces.astype(np.int64), np.abs(middle - 2 * np.pi) < np.pi / 2
