"""Cost of a path-traced picture, beside Mitsuba's own path tracer on a mesh of the surface."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

import harnack as hk
from harnack.rendering import Camera, register
from harnack.rendering.integrator import PathTracer
from harnack.rendering.light_paths import PathRenderTask, render_paths
from harnack.rendering.stage import StudioObject, build_studio, parse_material
from harnack.tracer import traced_surface

_SIZE, _SPP, _ROUNDS = (400, 300), 16, 3
_RINGS = 350


def _field(move: float = 0.0) -> hk.Field:
    t = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    return hk.SolidAngle(np.column_stack([np.cos(t) + move, np.sin(t), 0.45 * np.cos(3 * t)]))


def pictures() -> str:
    """The section of the page."""
    mi = register()
    material = parse_material("two-tone")

    def staged(fields: list[hk.Field]) -> Any:
        rays = 3 * _SIZE[0] * _SIZE[1] * _SPP  # as `render` counts them
        objects = [StudioObject(traced_surface(one).for_rays(rays), material) for one in fields]
        return build_studio(mi, objects, size=_SIZE, camera=Camera())

    one, three = staged([_field()]), staged([_field(x) for x in (-2.2, 0.0, 2.2)])
    ours = _radiance(mi, mi.load_dict(one.scene, parallel=False))
    of_three = _radiance(mi, mi.load_dict(three.scene, parallel=False))
    mesh, faces = _as_mesh(mi, one)
    path = {"type": "path", "max_depth": 12, "rr_depth": 4, "hide_emitters": True}
    other = mi.load_dict({**one.scene, "surface0": mesh, "integrator": path}, parallel=False)

    def theirs() -> np.ndarray:
        image = mi.render(other, spp=_SPP, seed=0)
        dr.eval(image)
        return np.array(image)[..., :3]

    rows = [_timed(ours), _timed(of_three), _timed(theirs)]
    unclamped = _radiance(mi, mi.load_dict(one.scene, parallel=False), clamp=np.inf)()
    base, theirs_mean = rows[2][0], rows[2][2]
    means = unclamped.mean(axis=(0, 1)), theirs_mean.mean(axis=(0, 1))
    names = (
        "polygon of 64 edges", "three of them", f"mesh of {faces:,} triangles, Mitsuba's `path`"
    )  # fmt: skip
    lines = [
        "## Pictures\n",
        f"Path traced in the studio at {_SIZE[0]} x {_SIZE[1]}, {_SPP} samples, kernels compiled: "
        f"CPU time of all threads and wall time, least of {_ROUNDS}. The mesh is of the same "
        "surface. Mean radiance (red, green, blue) with nothing clamped: "
        f"{_numbers(means[0])}, of the mesh {_numbers(means[1])}, which stays "
        "a little inside of its polygon.\n",
        "| scene | CPU s | wall s | of Mitsuba's CPU time |",
        "|---|---:|---:|---:|",
    ]
    for name, (cpu, wall, _) in zip(names, rows, strict=True):
        lines.append(f"| {name} | {cpu:.2f} | {wall:.2f} | {cpu / base:.2f} x |")
    return "\n".join(lines) + "\n"


def _numbers(three: np.ndarray) -> str:
    return ", ".join(f"{x:.5f}" for x in three)


def _radiance(mi: Any, scene: Any, clamp: float | None = None) -> Callable[[], np.ndarray]:
    tracer = scene.integrator().tracer
    if clamp is not None:
        tracer = PathTracer(mi, tracer.max_depth, tracer.rr_depth, tracer.hide_emitters, clamp)

    def draw() -> np.ndarray:
        sensor = scene.sensors()[0]
        image = render_paths(
            PathRenderTask(mi, scene, sensor, tracer, _SPP, 0), lambda _: None
        ).image
        return image[..., :3]

    return draw


def _timed(draw: Callable[[], np.ndarray]) -> tuple[float, float, np.ndarray]:
    """The smallest CPU and wall time, and the picture."""
    image = draw()  # compiles
    cpu, wall = [], []
    for _ in range(_ROUNDS):
        dr.sync_thread()
        start = time.process_time(), time.perf_counter()
        image = draw()
        dr.sync_thread()
        cpu.append(time.process_time() - start[0])
        wall.append(time.perf_counter() - start[1])
    return min(cpu), min(wall), image


def _as_mesh(mi: Any, studio: Any) -> tuple[Any, int]:
    """The surface, whose polygon is a graph over a disc, as a mesh of Mitsuba's in the studio."""
    carrier = studio.scene["surface0"]
    r = np.linspace(0, 1, _RINGS)[1:]
    angle = np.linspace(0, 2 * np.pi, _RINGS, endpoint=False)
    r, angle = (grid.ravel() for grid in np.meshgrid(r, angle, indexing="ij"))
    flat = 0.9995 * r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    o = np.column_stack([np.vstack([[0, 0], flat]), np.full(len(flat) + 1, 2.0)])
    surface = carrier.surface.surface
    hits = hk.trace(surface, o, [[0, 0, -1.0]], tolerance=1e-5, precision="single")
    j, i = np.meshgrid(np.arange(_RINGS), np.arange(_RINGS - 2))

    def at(ring: Any, k: Any) -> np.ndarray:
        return np.ravel(1 + ring * _RINGS + k % _RINGS)

    first = np.arange(_RINGS)
    middle = np.column_stack([0 * first, at(0, first), at(0, first + 1)])
    a, b, c, d = at(i, j), at(i, j + 1), at(i + 1, j), at(i + 1, j + 1)
    faces = np.vstack([middle, np.column_stack([a, c, d]), np.column_stack([a, d, b])])
    faces = faces[hits.is_hit[faces].all(axis=1)]
    vertices = carrier.placement.apply(np.nan_to_num(hits.position))
    props = mi.Properties()
    props["bsdf"] = carrier.bsdf()
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(vertices.ravel().astype(np.float32))
    params["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    params.update()
    return mesh, len(faces)
