"""The same pictures by POV-Ray's isosurface, by isoray and by harnack: core time, wrong pixels."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from rich.progress import track

import harnack as hk
from harnack.backend import choose_backend, to_vector3

from .blobs import Scene
from .scenes import EYE, FIELD_OF_VIEW

WIDTH, TOLERANCE, SAMPLES = 256, 1e-4, 1500
# Every _CHECKED-th pixel of a row and of a column is compared with the oracle.
_CHECKED = 2
# A pixel is wrong where one sees a surface and the other does not, or sees it this much later; or
# where the hit is farther from the surface than this many tolerances.
_APART, _NEAR = 2e-3, 3.0
# Positions are written to pictures as <0.1, 0.9> for coordinates in [-_SIZE, _SIZE].
_SIZE = 2.0


@dataclass(frozen=True)
class Drawn:
    """A surface that all programs draw.

    field, level: f, or f plus a constant, and the level that is the surface.
    formula: f of x, y, z, arrays of any kind, positive inside. values: of points (n, 3) in NumPy.
    gradients: (n, 3).
    intervals: f of x, y, z as pairs of arrays, by isoray's interval arithmetic.
    povray: f as POV-Ray writes it, negative inside, of x, y, z. steepest: the largest |grad f|.
    """

    name: str
    field: hk.Field
    level: float
    domain: hk.Ball | hk.Box
    formula: Callable[[Any, Any, Any], Any]
    values: Callable[[np.ndarray], np.ndarray]
    gradients: Callable[[np.ndarray], np.ndarray]
    intervals: Callable[..., tuple[np.ndarray, np.ndarray]]
    povray: str
    steepest: float

    @property
    def container(self) -> str:
        if isinstance(self.domain, hk.Ball):
            return f"sphere {{ <0,0,0>, {self.domain.radius:.9f} }}"
        lower, upper = (np.asarray(corner) for corner in (self.domain.lower, self.domain.upper))
        return f"box {{ {_vector(lower)}, {_vector(upper)} }}"


@dataclass(frozen=True)
class Oracle:
    """First roots along the camera's rays, by dense sampling and bisection in double precision.

    t: infinite where there is none. doubtful: pixels where the ray grazes the surface within the
        tolerance, before the first root or in it, so that either answer is right.
    """

    t: np.ndarray
    doubtful: np.ndarray

    def wrong(self, drawn: Drawn, d: np.ndarray, t: np.ndarray) -> tuple[int, int]:
        """The number of wrong distances, without and with the doubtful pixels.

        A hit before the root is right if it is near the surface: within `_NEAR` tolerances of it,
        to first order.
        """
        is_hit, has_root = np.isfinite(t), np.isfinite(self.t)
        p = EYE + np.where(is_hit, t, 0.0)[:, None] * d
        with np.errstate(invalid="ignore"):
            is_far = np.abs(drawn.values(p)) > _NEAR * TOLERANCE * np.linalg.norm(
                drawn.gradients(p), axis=1
            )
            is_wrong = (is_hit != has_root) | (is_hit & has_root & ((t > self.t + _APART) | is_far))
        return int((is_wrong & ~self.doubtful).sum()), int(is_wrong.sum())


def has_povray() -> bool:
    """Whether POV-Ray is installed."""
    return shutil.which("povray") is not None


def pictures() -> list[Drawn]:
    """A gyroid in a ball, and 40 compact blobs in a box."""
    return [_gyroid(), _blobs()]


def _gyroid() -> Drawn:
    k = 3 * math.pi

    def formula(x: Any, y: Any, z: Any) -> Any:
        s, c = (
            [hk.math.sin(k * axis) for axis in (x, y, z)],
            [hk.math.cos(k * axis) for axis in (x, y, z)],
        )
        return -(s[0] * c[1] + s[1] * c[2] + s[2] * c[0])

    def values(p: np.ndarray) -> np.ndarray:
        return formula(*p.T)

    def gradients(p: np.ndarray) -> np.ndarray:
        s, c = np.sin(k * p), np.cos(k * p)
        return -k * np.column_stack(
            [c[:, i] * c[:, (i + 1) % 3] - s[:, (i + 2) % 3] * s[:, i] for i in range(3)]
        )

    def intervals(*ends: Any) -> tuple[np.ndarray, np.ndarray]:
        from isoray.arithmetic.interval import ia_cos, ia_mul, ia_sin

        axes = [(k * ends[2 * i], k * ends[2 * i + 1]) for i in range(3)]
        s, c = [ia_sin(*axis) for axis in axes], [ia_cos(*axis) for axis in axes]
        products = [ia_mul(*s[i], *c[(i + 1) % 3]) for i in range(3)]
        return -sum(axis[1] for axis in products), -sum(axis[0] for axis in products)

    text = "+".join(f"sin({k:.12f}*{a})*cos({k:.12f}*{b})" for a, b in ("xy", "yz", "zx"))
    ball = hk.Ball(radius=1.0)
    return Drawn(
        "gyroid, 3 cells across", hk.Gyroid(cell=2 / 3, domain=ball), 0.0, ball, formula, values,
        gradients, intervals, text, math.sqrt(3) * k,
    )  # fmt: skip


def _blobs() -> Drawn:
    scene = Scene.random(40, 0.7, (0.14, 0.28), 1.6, seed=5)
    low, high = scene.box
    box = hk.Box(tuple(low.tolist()), tuple(high.tolist()))

    def gradients(p: np.ndarray) -> np.ndarray:
        total = np.zeros_like(p)
        for c, reach, height in zip(scene.centers, scene.reaches, scene.heights, strict=True):
            v = p - c
            w = np.maximum(1 - (v**2).sum(1) / reach**2, 0)
            total += (-6 * height / reach**2 * w**2)[:, None] * v
        return total

    def intervals(*ends: Any) -> tuple[np.ndarray, np.ndarray]:
        from isoray.arithmetic.interval import ia_sqr

        low, high = np.full(len(ends[0]), -scene.threshold), np.full(len(ends[0]), -scene.threshold)
        for c, reach, height in zip(scene.centers, scene.reaches, scene.heights, strict=True):
            squares = [ia_sqr(ends[2 * i] - c[i], ends[2 * i + 1] - c[i]) for i in range(3)]
            nearest, farthest = (sum(square[side] for square in squares) for side in (0, 1))
            low += height * np.maximum(1 - farthest / reach**2, 0) ** 3
            high += height * np.maximum(1 - nearest / reach**2, 0) ** 3
        return low, high

    def formula(x: Any, y: Any, z: Any) -> Any:
        total = -scene.threshold
        for c, reach, height in zip(scene.centers, scene.reaches, scene.heights, strict=True):
            u, v, w = x - float(c[0]), y - float(c[1]), z - float(c[2])
            inside = dr.maximum(1 - (u * u + v * v + w * w) * float(reach**-2), 0)
            total = total + float(height) * inside * inside * inside
        return total

    terms = [
        f"{height:.12f}*pow(max(0,1-{reach**-2:.12f}*((x-({c[0]:.12f}))*(x-({c[0]:.12f}))"
        f"+(y-({c[1]:.12f}))*(y-({c[1]:.12f}))+(z-({c[2]:.12f}))*(z-({c[2]:.12f})))),3)"
        for c, reach, height in zip(scene.centers, scene.reaches, scene.heights, strict=True)
    ]
    points = np.random.default_rng(0).uniform(low, high, (400_000, 3))
    max_slope = float(np.linalg.norm(gradients(points), axis=1).max())
    return Drawn(
        "40 blobs", scene.field(), scene.threshold, box, formula, scene.values, gradients,
        intervals, f"{scene.threshold:.12f}-({'+'.join(terms)})", max_slope,
    )  # fmt: skip


def camera_rays() -> np.ndarray:
    """Unit directions (WIDTH^2, 3), row by row from the top, from `EYE`."""
    forward, right, up = _axes()
    pixel = (2 * (np.arange(WIDTH) + 0.5) / WIDTH - 1) * math.tan(FIELD_OF_VIEW / 2)
    x, y = np.meshgrid(pixel, -pixel)
    d = (forward + x[..., None] * right + y[..., None] * up).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def _axes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return forward, right, np.cross(right, forward)


def spans(drawn: Drawn, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths at which rays enter and leave the container; far < near where they miss it."""
    if isinstance(drawn.domain, hk.Ball):
        middle = -(d @ EYE)
        square = EYE @ EYE - middle**2
        half = np.sqrt(np.maximum(drawn.domain.radius**2 - square, 0))
        return middle - half, np.where(square < drawn.domain.radius**2, middle + half, -1.0)
    ends = [(np.asarray(corner) - EYE) / d for corner in (drawn.domain.lower, drawn.domain.upper)]
    return np.minimum(*ends).max(1), np.maximum(*ends).min(1)


def oracle(drawn: Drawn, d: np.ndarray) -> Oracle:
    """First changes of sign at `SAMPLES` points a ray, bisected, by a loop that shares nothing with
    the tracer."""
    backend = choose_backend("double")
    count, real = backend.UInt32, backend.Float
    start_t, far = (real(length) for length in spans(drawn, d))
    directions = to_vector3(backend, d)
    crosses = far > start_t

    def value(t: Any) -> Any:
        return drawn.formula(*(float(EYE[k]) + t * directions[k] for k in range(3)))

    start = value(start_t)

    def first(k: Any, index: Any, before: Any) -> tuple[Any, ...]:
        current = value(start_t + (far - start_t) * (real(k) / SAMPLES))
        is_first = (index == 0) & ((current > 0) != (before > 0))
        return k + 1, dr.select(is_first, k, index), current

    index = dr.while_loop(
        (count(1) + dr.zeros(count, len(d)), dr.zeros(count, len(d)), start),
        lambda k, index, _: crosses & (k <= SAMPLES) & (index == 0),
        first,
    )[1]
    has_root = index > 0
    a = start_t + (far - start_t) * (real(index) - 1) / SAMPLES
    b = start_t + (far - start_t) * real(index) / SAMPLES
    for _ in range(40):
        middle = 0.5 * (a + b)
        same = (value(middle) > 0) == (start > 0)
        a, b = dr.select(same, middle, a), dr.select(same, b, middle)
    # Nearly touched well before the first root, or a root right at the container.
    last = dr.select(has_root, dr.maximum(index, 4) - 4, SAMPLES)

    def touched(k: Any, min_value: Any) -> tuple[Any, ...]:
        t = start_t + (far - start_t) * (real(k) / SAMPLES)
        return k + 1, dr.minimum(min_value, dr.abs(value(t)))

    def behind_root(k: Any, most: Any) -> tuple[Any, ...]:
        current = value(start_t + (far - start_t) * (real(k) / SAMPLES))
        behind = (current > 0) != (start > 0)
        return k + 1, dr.select(behind, dr.maximum(most, dr.abs(current)), most), behind

    min_value = dr.while_loop(
        (dr.zeros(count, len(d)), dr.full(real, dr.inf, len(d))),
        lambda k, _: crosses & (k <= last),
        touched,
    )[1]
    # Or behind it for so short that it is within the tolerance of the surface all the time.
    beyond = dr.while_loop(
        (count(index), dr.zeros(real, len(d)), dr.full(backend.Bool, True, len(d))),
        lambda k, most, behind: has_root & behind & (k <= SAMPLES),
        lambda k, most, behind: behind_root(k, most),
    )
    shallow = has_root & ~beyond[2] & (beyond[1] < 1.1 * TOLERANCE * drawn.steepest)
    edge = has_root & ((index <= 3) | (index + 3 >= SAMPLES))
    doubtful = (min_value < 1.1 * TOLERANCE * drawn.steepest) | edge | shallow
    t = dr.select(has_root, b, dr.inf)
    dr.eval(t, doubtful)
    return Oracle(t.numpy(), doubtful.numpy())


def by_harnack(
    drawn: Drawn, d: np.ndarray, threads: int, *, require_crossing: bool = False
) -> tuple[np.ndarray, float, float]:
    """Distances, and the best core and wall time of three after the first, which compiles."""
    backend = choose_backend()
    before = dr.thread_count()
    dr.set_thread_count(threads)
    try:
        o, directions = to_vector3(backend, EYE[None]), to_vector3(backend, d)
        surface = hk.Surface(drawn.field, drawn.level, clip=drawn.domain)
        options = hk.TraceOptions(tolerance=TOLERANCE, require_crossing=require_crossing)
        cores, walls, hits = [], [], None
        for _ in range(4):
            wall, core = time.perf_counter(), time.process_time()
            hits = hk.trace(surface, o, directions, t_max=20.0, options=options)
            dr.sync_thread()
            cores.append(time.process_time() - core)
            walls.append(time.perf_counter() - wall)
    finally:
        dr.set_thread_count(before)
    assert hits is not None
    hit = hits.status.numpy() == int(hk.RayStatus.HIT)
    return np.where(hit, hits.t.numpy(), np.inf), min(cores[1:]), min(walls[1:])


def by_povray(
    drawn: Drawn, d: np.ndarray, threads: int, *, positions: bool
) -> tuple[np.ndarray | None, float, float]:
    """Distances if positions are requested, and core and wall time of tracing as POV-Ray reports
    them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.pov"
        path.write_text(pov_scene(drawn, positions=positions), encoding="utf-8")
        if positions:
            core, wall = _run_povray(path, threads, Path(folder) / "scene.png")
            return _distances(Path(folder) / "scene.png", d), core, wall
        core, wall = _run_povray(path, threads, None)
        return None, core, wall


def pov_scene(drawn: Drawn, *, positions: bool) -> str:
    """The scene file. Colors are positions, or flat."""
    forward, right, up = _axes()
    wide = 2 * math.tan(FIELD_OF_VIEW / 2)
    flat = "pigment { rgb <1,1,1> }"
    if positions:
        maps = [
            f"[1 function {{ 0.5+{axis}*{0.4 / _SIZE:.12f} }} color_map {{ [0 rgb 0] "
            f"[1 rgb {_vector(3 * np.eye(3)[k])}] }}]"
            for k, axis in enumerate("xyz")
        ]
        flat = f"pigment {{ average pigment_map {{ {' '.join(maps)} }} }}"
    return (
        "#version 3.7;\nglobal_settings { assumed_gamma 1.0 }\nbackground { rgb 0 }\n"
        f"camera {{ perspective location {_vector(EYE)} direction {_vector(forward)} "
        f"right {_vector(wide * right)} up {_vector(wide * up)} }}\n"
        f"isosurface {{ function {{ {drawn.povray} }} contained_by {{ {drawn.container} }} "
        f"threshold 0 accuracy {TOLERANCE} max_gradient {drawn.steepest:.6f} open\n"
        f"{flat} finish {{ ambient 1 diffuse 0 }} }}\n"
    )


def _vector(v: np.ndarray) -> str:
    return "<" + ",".join(f"{float(number):.12f}" for number in v) + ">"


def _run_povray(path: Path, threads: int, out: Path | None) -> tuple[float, float]:
    """Core and wall seconds of tracing, without starting and reading the scene."""
    writing = [f"+O{out}", "+FN16", "File_Gamma=1.0"] if out else ["Output_to_File=false"]
    command = [
        "povray", f"+I{path}", f"+W{WIDTH}", f"+H{WIDTH}", "-D", "-A", f"+WT{threads}",
        *writing,
    ]  # fmt: skip
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    times = re.search(
        r"Trace Time:.*?\(([\d.]+) seconds\)\s*using \d+ thread\(s\) with ([\d.]+) CPU-seconds",
        process.stderr,
        re.DOTALL,
    )
    if process.returncode or times is None:
        raise RuntimeError(f"povray failed:\n{process.stderr[-2000:]}")
    return float(times[2]), float(times[1])


def _distances(path: Path, d: np.ndarray) -> np.ndarray:
    """t of the positions that the colors of a picture encode; infinite at the background."""
    from mitsuba import Bitmap

    pixels = np.array(Bitmap(str(path)), dtype=np.float64).reshape(-1, 3)[: len(d)] / 65535
    points = (pixels - 0.5) * (_SIZE / 0.4)
    t = ((points - EYE) * d).sum(1)
    return np.where(pixels.max(1) > 0.01, t, np.inf)


def by_isoray(drawn: Drawn, d: np.ndarray) -> tuple[np.ndarray, float]:
    """Distances and core time on one core, of bisection by isoray's interval arithmetic.

    Its default, gradients at the corners of boxes, proves nothing and is several times slower.
    """
    from isoray import NaturalIntervalInclusion, bisect_trace

    def function(p: np.ndarray) -> tuple[np.ndarray, None]:
        return drawn.values(p), None

    def recipe(*bounds: Any) -> tuple[np.ndarray, np.ndarray]:
        return drawn.intervals(*bounds[:6])

    near, far = spans(drawn, d)
    core = time.process_time()
    result = bisect_trace(
        np.broadcast_to(EYE, d.shape), d, near, far, far > near,
        NaturalIntervalInclusion(recipe), function, threshold=TOLERANCE,
    )  # fmt: skip
    return np.where(result.is_hit, result.t, np.inf), time.process_time() - core


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """NumPy's products of matrices on one core, so that core times compare."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


def compare_with_povray() -> str:
    """The section of the page; isoray is left out where it is not installed."""
    d, lines = camera_rays(), []
    checked = np.arange(WIDTH * WIDTH).reshape(WIDTH, WIDTH)[::_CHECKED, ::_CHECKED].ravel()
    every = os.cpu_count() or 1
    for drawn in track(pictures(), description="povray"):
        truth = oracle(drawn, d[checked])
        rows: list[tuple[str, float, float | None, np.ndarray]] = []
        for threads in (1, every):
            t, core, wall = by_harnack(drawn, d, threads)
            name = f"harnack, {threads} thread{'s'[: threads > 1]}"
            rows.append((name, core / len(d), wall / len(d), t[checked]))
        t, core, wall = by_harnack(drawn, d, 1, require_crossing=True)
        name = "harnack, 1 thread, require_crossing=True"
        rows.append((name, core / len(d), wall / len(d), t[checked]))
        t, _, _ = by_povray(drawn, d, every, positions=True)
        assert t is not None
        for threads in (1, every):
            _, core, wall = by_povray(drawn, d, threads, positions=False)
            name = f"POV-Ray 3.7, {threads} thread{'s'[: threads > 1]}"
            rows.append((name, core / len(d), wall / len(d), t[checked]))
        if importlib.util.find_spec("isoray") is not None:
            with _one_thread():
                t, core = by_isoray(drawn, d[checked])
            rows.append(("isoray 0.4, intervals", core / len(checked), None, t))
        for name, core, wall, t in rows:
            wrong, with_grazing = truth.wrong(drawn, d[checked], t)
            shown = "" if wall is None else f"{1e6 * wall:.3f}"
            lines.append(
                f"| {drawn.name} | {name} | {1e6 * core:.3f} | {shown} "
                f"| {core / rows[0][1]:.1f} x | {wrong} | {with_grazing} |"
            )
    return "\n".join([
        "## Beside POV-Ray and isoray\n",
        f"{WIDTH} x {WIDTH} first hits by the camera above, tolerance 1e-4, without shading. "
        "POV-Ray 3.7 draws an `isosurface` with max_gradient at the largest gradient there is in "
        "the container, which no user knows and which favors it, and with flat color; its times "
        "are what it tells of tracing. isoray 0.4 bisects with NumPy by its interval arithmetic. "
        f"Wrong pixels, of {len(checked):,}: seen or not, {_APART} behind the first root, or "
        f"{_NEAR:.0f} tolerances off the surface, against {SAMPLES} samples a ray and bisection in "
        "double precision. The last column counts rays as well that graze the surface within the "
        "tolerance and see or miss it.\n",
        "| picture | by | core us a ray | wall us a ray | core, of harnack's | wrong "
        "| with grazing |",
        "|---|---|---:|---:|---:|---:|---:|",
        *lines,
    ]) + "\n"  # fmt: skip
