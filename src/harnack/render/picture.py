"""`render`: a field in, a picture out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from harnack.fields.field import Field
from harnack.render.images import check_picture_path, tone_mapped, write_image
from harnack.render import materials
from harnack.render.plugins import register
from harnack.render.studio import Camera, studio
from harnack.render.views import VIEWS, look
from harnack.tracer import LevelSet, level_set

ShowMode = Literal["color", "normal", "evaluations", "status", "depth"]
SHOW_MODES: tuple[str, ...] = ("color", *VIEWS)
Image = npt.NDArray[Any]

# Camera rays of one pass: the bar moves and Ctrl-C works between passes.
_RAYS_A_PASS = 2**20


def render(
    what: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    show: ShowMode = "color",
    size: tuple[int, int] | None = None,
    spp: int | None = None,
    material: Any = None,
    camera: Camera | None = None,
    max_depth: int = 12,
    seed: int = 0,
    progress: bool = True,
    **settings: Any,
) -> Image:
    """Draw fields or a Mitsuba scene, and write the picture to `path` if there is one.

    what: a field, a `LevelSet` or a list of them, drawn in the studio; or a Mitsuba scene, its
        dictionary, or the path of its XML file, with surfaces made by `harnack.render.shape`.
    path: .png (8-bit sRGB, tone mapped) or .exr (the numbers).
    show: "color"; or what one ray a pixel found: "normal", "evaluations" (of the fields),
        "status" and "depth".
    size: (width, height) in pixels, by default (800, 600) or the scene's own.
    spp: samples a pixel of a color picture, by default 64 or the scene's own.
    material: a name of `MATERIALS`, a `Material` or a BSDF dictionary; one for each surface.
    camera: where the studio is seen from.
    max_depth: longest light path, in edges; -1 for no limit.
    seed: another seed, other noise; the same seed, the same picture.
    settings: of the surface, as `harnack.level_set` takes them: level, clip, tolerance, solid, ...

    Returns the numbers: (h, w, 3) linear sRGB radiance, (h, w, 3) normals, or (h, w).

    A ray that runs out of steps is drawn magenta, and a warning says how many there were.

    Raises ValueError before anything is drawn for an unknown file type, mode or material.
    """
    target = None if path is None else check_picture_path(path)
    if show not in SHOW_MODES:
        raise ValueError(f"show must be one of {', '.join(SHOW_MODES)}, not {show!r}")
    mi = register()
    if _is_scene(what):
        scene = _loaded(mi, what)
    else:
        scene = _in_studio(mi, what, material, size, camera, max_depth, show != "color", settings)
    sensor = scene.sensors()[0]
    if show == "color":
        integrator = _integrator(mi, scene, max_depth)
        image = _radiance(mi, scene, sensor, integrator, spp or 64, seed, progress)
        drawn = tone_mapped(image)
    else:
        view = look(mi, scene, sensor)
        image, drawn = VIEWS[show].numbers(view), VIEWS[show].picture(view)
    if target is not None:
        exact = target.suffix.lower() == ".exr"
        write_image(mi, target, image.astype(np.float32) if exact else drawn)
    return image


def _is_scene(what: Any) -> bool:
    return not isinstance(what, (Field, LevelSet, Sequence)) or isinstance(what, str)


def _loaded(mi: Any, what: Any) -> Any:
    if isinstance(what, mi.Scene):
        return what
    if isinstance(what, Mapping):
        return mi.load_dict(dict(what))
    return mi.load_file(str(what))


def _in_studio(
    mi: Any, what: Any, asked: Any, size: Any, camera: Any, max_depth: int, bare: bool, settings: Any
) -> Any:
    surfaces = [
        one if isinstance(one, LevelSet) else level_set(one, **settings)
        for one in (what if isinstance(what, Sequence) else [what])
    ]
    names = asked if isinstance(asked, Sequence) and not isinstance(asked, str) else [asked] * len(surfaces)
    made = [materials.material(name) for name in names]
    return mi.load_dict(
        studio(
            mi, surfaces, made,
            size=size or (800, 600), camera=camera or Camera(), max_depth=max_depth, bare=bare,
        )
    )  # fmt: skip


def _integrator(mi: Any, scene: Any, max_depth: int) -> Any:
    own = scene.integrator()
    if hasattr(own, "take_lost"):
        return own
    return mi.load_dict({"type": "harnack_path", "max_depth": max_depth})


def _radiance(
    mi: Any, scene: Any, sensor: Any, integrator: Any, spp: int, seed: int, progress: bool
) -> npt.NDArray[np.float32]:
    width, height = sensor.film().crop_size()
    step = max(1, _RAYS_A_PASS // (int(width) * int(height)))
    passes = [min(step, spp - done) for done in range(0, spp, step)]
    total = np.zeros((int(height), int(width), 3))
    integrator.take_lost()
    with _bar(progress, spp) as advance:
        for index, count in enumerate(passes):
            image = integrator.render(scene, sensor, seed=(seed * 0x9E3779B1 + index) % 2**32, spp=count)
            total += count * np.array(image)[..., :3]
            advance(count)
    lost = integrator.take_lost()
    if lost:
        warnings.warn(f"{lost} rays ran out of steps and are drawn magenta", stacklevel=3)
    return (total / spp).astype(np.float32)


@contextmanager
def _bar(shown: bool, total: int) -> Iterator[Callable[[int], None]]:
    columns = (TextColumn("rendering"), BarColumn(), TextColumn("{task.completed}/{task.total} spp"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not shown, transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda count: bar.advance(task, count)

