"""Growth of the cost of winding numbers and of point clouds with their number of elements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.backend import choose_backend, to_vector3
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.geometry.example_meshes import bumpy_sphere, remove_faces

from .scenes import EYE, camera
from .winding import cube_points, seconds_of

SUBDIVISIONS = (4, 5, 6, 7, 8)
CLOUDS = (10_000, 100_000, 1_000_000)
POINTS = 1_000_000
WIDTH = 256
REPEATS = 7
TREE = "tree, 10 % of faces removed"
EXACT = "exact, closed"
HOLE = "mesh, exact, one hole of 1 %"
SOUP = "mesh, tree, 10 % of faces removed"
CLOUD = "dipole cloud"

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class AtPoints:
    """Microseconds a point, of many points; seconds to construct the field from arrays."""

    series: str
    elements: int
    made: float
    microseconds: float


@dataclass(frozen=True)
class AlongRays:
    """Means over all rays, hitting or not."""

    series: str
    elements: int
    hitting: float
    evaluations: float
    most: int
    out_of_steps: int
    microseconds: float


def one_hole(vertices: FloatArray, faces: Any, fraction: float = 0.01) -> Any:
    """The faces without the given fraction that lies nearest to the camera."""
    towards = vertices[faces].mean(axis=1) @ (EYE / np.linalg.norm(EYE))
    return faces[np.sort(np.argsort(towards)[: len(faces) - round(fraction * len(faces))])]


def bumpy_cloud(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (n, 3) spread evenly over the bumpy sphere, their normals and the areas they hold.

    A Fibonacci sphere of directions u, moved to radius r(u): the normal is along
    u - grad r/r with grad r tangential, and each point holds 4 pi/n r^2/(normal . u).
    """
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    u = np.column_stack([np.cos(angle), np.sin(angle), z])
    u[:, :2] *= np.sqrt(1 - z * z)[:, None]
    s, c = np.sin(5 * u), np.cos(5 * u)
    r = 1 + 0.15 * s.prod(axis=1)
    slope = 0.75 * c * np.roll(s, 1, axis=1) * np.roll(s, 2, axis=1)
    slope -= (slope * u).sum(axis=1, keepdims=True) * u
    normal = u - slope / r[:, None]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    areas = 4 * np.pi / n * r * r / (normal * u).sum(axis=1)
    return u * r[:, None], normal, areas


def at_points(series: str, vertices: FloatArray, faces: Any, method: Any) -> AtPoints:
    """`WindingNumber.value` on NumPy arrays."""
    points, fields = cube_points(POINTS), []

    def make() -> None:
        field = WindingNumber(vertices, faces, method=method)
        field.value(points[:10], precision="single")
        fields.append(field)

    seconds = seconds_of(make)

    def evaluate() -> None:
        fields[0].value(points, precision="single")

    evaluate()  # compiles
    times = [seconds_of(evaluate) for _ in range(REPEATS)]
    return AtPoints(series, len(faces), seconds, float(np.median(times)) / POINTS * 1e6)


def along_rays(series: str, elements: int, field: hk.Field) -> AlongRays:
    """Trace the camera's rays; the first of the calls uploads the field."""
    backend = choose_backend()
    eye, directions = camera(WIDTH)
    o, d = to_vector3(backend, eye[None]), to_vector3(backend, directions)
    hits: list[hk.Hits] = []

    def call() -> None:
        hits[:] = [hk.trace(field, o, d, t_max=10.0, tolerance=1e-4)]
        dr.sync_thread()

    call()  # compiles
    seconds = float(np.median([seconds_of(call) for _ in range(REPEATS)]))
    n, status = hits[0].evaluations.numpy(), hits[0].status.numpy()
    return AlongRays(
        series, elements, float((status == int(hk.RayStatus.HIT)).mean()), float(n.mean()),
        int(n.max()), int((status == int(hk.RayStatus.OUT_OF_STEPS)).sum()), seconds / n.size * 1e6,
    )  # fmt: skip


def growth(picture: Path) -> str:
    """Measure, plot, and return the section of the page."""
    points: list[AtPoints] = []
    rays: list[AlongRays] = []
    for k in SUBDIVISIONS:
        v, f = bumpy_sphere(k)
        damaged = remove_faces(f, 0.1, 0)
        points.append(at_points(TREE, v, damaged, "tree"))
        points.append(at_points(EXACT, v, f, "exact"))
        cut = one_hole(v, f)
        rays.append(along_rays(HOLE, len(cut), WindingNumber(v, cut, method="exact")))
        rays.append(along_rays(SOUP, len(damaged), WindingNumber(v, damaged, method="tree")))
        print(*points[-2:], *rays[-2:], sep="\n", flush=True)
    for n in CLOUDS:
        rays.append(along_rays(CLOUD, n, DipolePotential(*bumpy_cloud(n))))
        print(rays[-1], flush=True)
    plot(picture, points, rays)
    return _section(picture.name, points, rays)


def _section(picture: str, points: list[AtPoints], rays: list[AlongRays]) -> str:
    lines = [
        "## Growth with the number of elements\n",
        f"Bumpy spheres of 5,000 to 1.3 million triangles at {POINTS:,} points in "
        f"[-1.5, 1.5]^3, sorting and transfers included; and {WIDTH} x {WIDTH} rays of the "
        "camera above, tolerance 1e-4, single precision, to such spheres and to oriented points on "
        "them. *Made* is the time to build and upload the field, with its "
        f"first, compiling call. Medians of {REPEATS} runs. The rays are enough for cells of the "
        "smaller meshes of which a tenth is removed, but not of the larger ones, nor of clouds.\n",
        f"![time a point, time a ray and evaluations a ray]({picture})\n",
        "| winding number at points | triangles | made, seconds | microseconds a point |",
        "|---|---:|---:|---:|",
    ]
    for row in sorted(points, key=lambda row: row.series):
        lines.append(
            f"| {row.series} | {row.elements:,} | {row.made:.2f} | {row.microseconds:.3f} |"
        )
    lines += [
        "",
        "| traced | elements | rays that hit | evaluations a ray | most | out of steps "
        "| microseconds a ray |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in sorted(rays, key=lambda row: row.series):
        lines.append(
            f"| {row.series} | {row.elements:,} | {100 * row.hitting:.0f} % "
            f"| {row.evaluations:.2f} | {row.most} | {row.out_of_steps} "
            f"| {row.microseconds:.2f} |"
        )
    return "\n".join(lines) + "\n"


def plot(path: Path, points: list[AtPoints], rays: list[AlongRays]) -> None:
    """Three panels over the number of elements."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(13, 4), layout="constrained")
    panels: list[tuple[list[Any], str, str]] = [
        (points, "microseconds", "microseconds a point"),
        (rays, "microseconds", "microseconds a ray"),
        (rays, "evaluations", "evaluations a ray"),
    ]
    for axis, (rows, quantity, label) in zip(axes, panels, strict=True):
        for series in dict.fromkeys(row.series for row in rows):
            selected = [row for row in rows if row.series == series]
            y = [getattr(row, quantity) for row in selected]
            axis.plot([row.elements for row in selected], y, "o-", label=series)
        axis.set(xscale="log", xlabel="triangles or points", ylabel=label)
        axis.legend(loc="center right")
    # Clouds take tens of times as long as meshes: only a logarithm shows both.
    axes[1].set_yscale("log")
    axes[0].set_ylim(bottom=0)
    axes[2].set_ylim(bottom=0)
    temporary = path.with_suffix(".tmp.png")
    figure.savefig(temporary, dpi=110)
    temporary.replace(path)
    pyplot.close(figure)
