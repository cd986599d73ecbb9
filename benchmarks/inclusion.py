"""Forward inclusion functions on blobs: looks and time a ray of the published methods and ours."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import numpy as np

import harnack as hk
from harnack.backend import choose_backend, to_float, to_vector3
from harnack.enclosures import AffineBand, BottomUpLinear, Enclosure

from .bisection import bisect
from .blobs import BlobFormula, Scene

RAYS, CHECKED, SAMPLES = 100_000, 20_000, 600
# Name, bound, whether ranges of derivatives are exact, looks a ray in the published table 1.
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
    ("pieces (the default)", None, True, None),
)
_BISECTED: dict[str | None, type[Enclosure]] = {
    "bisect affine": AffineBand,
    "bisect linear": BottomUpLinear,
}


@dataclass(frozen=True)
class Row:
    """One method: looks a ray, over all rays and those that hit; core time a ray; hits missed."""

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
    _, bound, exact, _ = method
    backend = choose_backend(precision)  # type: ignore[arg-type]
    origins, directions, lengths = scene.rays(count)
    o, d = to_vector3(backend, origins), to_vector3(backend, directions)
    end = to_float(backend, lengths)
    seconds: list[float] = []
    field = BlobFormula(scene, exact)
    if bound in _BISECTED:
        for _ in range(3):
            t, n, core = bisect(backend, field, _BISECTED[bound], (o, d, end), 1e-3)
            seconds.append(core)
        return _row(method, t.numpy(), np.isfinite(t.numpy()), n.numpy(), seconds, lengths,
                    reference)  # fmt: skip
    surface = hk.level_set(
        field,
        0.0,
        bound=bound,
        overstep=1.0,
        tolerance=hk.Tolerance(distance=0.0, value=1e-3),
    )
    hits = None
    for _ in range(3):  # the first run compiles
        core = time.process_time()
        hits = hk.trace(surface, o, d, t_max=end)
        dr.sync_thread()
        seconds.append(time.process_time() - core)
    assert hits is not None
    hit = hits.status.numpy() == int(hk.Status.HIT)
    assert not (hits.status.numpy() == int(hk.Status.OUT_OF_STEPS)).any()
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


def inclusion() -> str:
    """The section of the page."""
    scene = table1_scene()
    reference = scene.first_inside(tuple(one[:CHECKED] for one in scene.rays(RAYS)), SAMPLES)
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
    return "\n".join(lines) + "\n"
