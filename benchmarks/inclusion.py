"""Forward inclusion functions on blobs: looks and time a ray of the published methods and ours."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_float, to_vector3
from harnack.enclosures import Enclosure
from harnack.literature import AffineEnclosure, BottomUpLinearEnclosure

from .bisection import bisect
from .blobs import BlobFormula, Scene

RAYS, CHECKED, SAMPLES = 50_000, 20_000, 600
# Name, enclosures, whether ranges of derivatives are exact, looks a ray in the published table 1.
Method: TypeAlias = "tuple[str, str | None, bool, float | None]"
METHODS: tuple[Method, ...] = (
    ("revised affine arithmetic, bisection", "bisect affine", True, 15.40),
    ("bottom-up linear, bisection", "bisect linear", True, 12.55),
    ("bottom-up linear", "bottom-up-linear", True, 9.62),
    ("segment tracing", "segment", False, 8.90),
    ("linear Taylor", "linear-taylor", False, 8.11),
    ("linear Taylor, exact ranges", "linear-taylor", True, None),
    ("bottom-up quadratic", "bottom-up-quadratic", True, 5.56),
    ("quadratic Taylor", "quadratic-taylor", True, 4.79),
    ("mixed", "mixed", True, None),
    ("revised affine arithmetic, marched", "affine", True, None),
    ("pieces", None, True, None),
    ("pieces, hk.Blobs (the default)", "blobs", True, None),
)
_BISECTED: dict[str | None, type[Enclosure]] = {
    "bisect affine": AffineEnclosure,
    "bisect linear": BottomUpLinearEnclosure,
}


@dataclass(frozen=True)
class Row:
    """One method: evaluations a ray, over all rays and hitting rays; core time a ray; hits
    missed."""

    name: str
    published: float | None
    looks: float
    looks_hitting: float
    microseconds: float
    missed: int


def table1_scene() -> Scene:
    """40 random compact blobs, n = 6."""
    return Scene.random(40, 4.0, (0.8, 1.6), 1.6, seed=5)


def measure(
    scene: Scene, method: Method, count: int = RAYS,
    reference: np.ndarray | None = None, precision: str = "single",
) -> Row:  # fmt: skip
    """First hits of rays between points of the box, to 1e-3 in value and no other tolerance."""
    _, enclosures, exact, _ = method
    backend = choose_backend(precision)  # type: ignore[arg-type]
    origins, directions, lengths = scene.rays(count)
    o, d = to_vector3(backend, origins), to_vector3(backend, directions)
    end = to_float(backend, lengths)
    seconds: list[float] = []
    field: hk.Field = BlobFormula(scene, exact)
    level = 0.0
    if enclosures == "blobs":
        field, enclosures, level = scene.field(), None, scene.threshold
    if enclosures in _BISECTED:
        for _ in range(3):
            t, n, core = bisect(backend, field, _BISECTED[enclosures], (o, d, end), 1e-3)
            seconds.append(core)
        return _row(method, t.numpy(), np.isfinite(t.numpy()), n.numpy(), seconds, lengths,
                    reference)  # fmt: skip
    surface = hk.Surface(field, level)
    options = hk.TraceOptions(
        enclosures=enclosures,
        over_relaxation=1.0,
        tolerance=hk.tracer.HitTolerance(distance=0.0, value=1e-3),
    )
    hits = None
    for _ in range(3):  # the first run compiles
        core = time.process_time()
        hits = hk.trace(surface, o, d, t_max=end, options=options)
        dr.sync_thread()
        seconds.append(time.process_time() - core)
    assert hits is not None
    hit = hits.status.numpy() == int(hk.RayStatus.HIT)
    assert not (hits.status.numpy() == int(hk.RayStatus.OUT_OF_STEPS)).any()
    looks = hits.evaluations.numpy()
    return _row(method, hits.t.numpy(), hit, looks, seconds, lengths, reference)


def _row(
    method: Method, t: np.ndarray, hit: np.ndarray, looks: np.ndarray, seconds: list[float],
    lengths: np.ndarray, reference: np.ndarray | None,
) -> Row:  # fmt: skip
    missed = 0
    if reference is not None:
        n = len(reference)
        late = ~hit[:n] | (t[:n] > reference + 1e-5 * lengths[:n])
        missed = int((np.isfinite(reference) & late).sum())
    return Row(
        method[0], method[3], float(looks.mean()), float(looks[hit].mean()),
        min(seconds[1:]) / len(looks) * 1e6, missed,
    )  # fmt: skip


# Rows of tables 3 and 4: name, enclosures, whether the benchmark's own formula is used, the paper's
# numbers for the largest of sums and for one sum. Ranges of that formula in closed form are of one
# sum alone.
_ALL_ROOTS: tuple[tuple[str, str | None, bool, float | None, float | None], ...] = (
    ("segment tracing", "segment", False, 39.36, 40.97),
    ("bottom-up linear", "bottom-up-linear", True, None, 28.95),
    ("linear Taylor (of a maximum: mixed)", "linear-taylor", False, 29.03, 28.95),
    ("bottom-up quadratic", "bottom-up-quadratic", True, 15.90, 15.01),
    ("quadratic Taylor (of a maximum: mixed)", "quadratic-taylor", False, 13.28, 12.64),
    ("pieces, without a grid", None, True, None, None),
    ("pieces (the default)", None, False, None, None),
)


def all_roots(count: int = 10_000, checked: int = 1_000) -> list[str]:
    """Tables 3 and 4: all crossings of rays through 80 blobs, as sums of 5 groups and one sum."""
    scene = Scene.random(80, 4.0, (0.6, 1.3), 1.8, seed=5)
    rays = scene.rays(count, seed=2)
    backend = choose_backend()
    origins, directions = (to_vector3(backend, array) for array in rays[:2])
    end = to_float(backend, rays[2])
    lines = [
        f"All crossings of {count:,} rays through 80 blobs (`max_crossings=24`), which is what "
        "transparency needs: tables 3 (the largest of 5 sums of 16) and 4 (one sum). Their counts "
        f"are compared with 1500 samples on {checked:,} rays.\n",
        "| field | method | looks, paper | looks a ray | us a ray and core | crossings a ray "
        "| rays with other counts |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for groups, name in ((5, "largest of sums"), (1, "sum")):
        reference = scene.crossings(tuple(array[:checked] for array in rays), groups, 1500)
        for method, enclosures, uses_formula, *published in _ALL_ROOTS:
            if uses_formula and enclosures is None and groups > 1:
                continue
            field = BlobFormula(scene, groups=groups) if uses_formula else scene.field(groups)
            level = 0.0 if uses_formula else scene.threshold
            surface = hk.Surface(field, level)
            options = hk.TraceOptions(enclosures=enclosures, tolerance=1e-3, over_relaxation=1.0)
            seconds: list[float] = []
            for _ in range(2):
                core = time.process_time()
                hits = hk.crossings(
                    surface, origins, directions, t_max=end, max_crossings=24, options=options
                )
                dr.sync_thread()
                seconds.append(time.process_time() - core)
            looks, crossings = hits.evaluations.numpy(), hits.count.numpy()
            other = int((crossings[:checked] != reference).sum())
            printed = published[groups == 1]
            lines.append(
                f"| {name} | {method} | {'' if printed is None else f'{printed:.2f}'} "
                f"| {looks.mean():.2f} | {seconds[-1] / count * 1e6:.2f} "
                f"| {crossings.mean():.3f} | {other} |"
            )
    return lines


def inclusion() -> str:
    """The section of the page."""
    scene = table1_scene()
    reference = scene.first_inside(tuple(array[:CHECKED] for array in scene.rays(RAYS)), SAMPLES)
    rows = [measure(scene, method, reference=reference) for method in METHODS]
    lines = [
        "## Forward inclusion functions\n",
        f"Table 1 of Aydinlilar and Zanni (2023) on 40 random blobs with compact kernels (n = 6, "
        f"seed 5): {RAYS:,} rays between random points of the faces of their box, single "
        "precision, a hit within 1e-3 in value, and no minimal step, without which nothing would "
        f"be guaranteed. Looks are evaluations of field and proof together. Missed hits are "
        f"counted on the first {CHECKED:,} rays against {SAMPLES} samples of each in double "
        "precision. Their scene cannot be rebuilt from the paper, so it is the order that "
        "compares.\n",
        "| method | looks, paper | looks a ray | hitting | us a ray and core | missed |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        published = "" if row.published is None else f"{row.published:.2f}"
        lines.append(
            f"| {row.name} | {published} | {row.looks:.2f} | {row.looks_hitting:.2f} "
            f"| {row.microseconds:.2f} | {row.missed} |"
        )
    return "\n".join([*lines, "", *all_roots()]) + "\n"
