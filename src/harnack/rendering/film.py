"""Films: pictures one after the other, with one frame for all of them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from harnack.backend import FloatArray
from harnack.files.writing import check_writable, write_atomically
from harnack.geometry import Box
from harnack.rendering.arguments import check_camera, check_integer, check_size
from harnack.rendering.exhibits import surfaces_of
from harnack.rendering.mitsuba.plugins import register
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.picture import render
from harnack.rendering.studio.camera import Camera
from harnack.rendering.studio.upright import upright
from harnack.rendering.surfaces.framing import visible_points
from harnack.tracer import LevelSet

FILM_FILES = (".gif", ".mp4")
_SIZE = (320, 240)
_MOST_FRAMES = 10_000
Pixels = npt.NDArray[np.uint8]


def animate(
    what: Any,
    path: str | os.PathLike[str],
    *,
    frames: int = 24,
    fps: float = 24.0,
    turn: float = 0.0,
    camera: Any = None,
    size: tuple[int, int] = _SIZE,
    show: str = "shaded",
    progress: bool = True,
    **settings: Any,
) -> None:
    """Draw a film and write it to `path`.

        hk.animate(field, "turntable.gif", turn=360)
        hk.animate(lambda s: hk.Morph(a, b, gap=0.2, w=0.2 * s), "morph.mp4")
        hk.animate(field, "levels.gif", level=lambda s: 1 + 4 * s)

    what: what `render` draws in its studio. It, the camera and every setting may be a function of
        s, which goes from 0 in the first picture to 1 in the last; with a `turn` of 360 degrees,
        to just before 1, so that the film can be repeated.
    path: .gif (Pillow) or .mp4 (PyAV: `pip install harnack[film]`).
    frames: number of pictures. fps: pictures a second; those of a GIF last whole hundredths.
    turn: degrees that the camera goes around during the film.
    camera: as `render` takes it. One that does not say where it stands or what it frames gets one
        place of the target and one distance for all pictures, such that all is always in view.
    settings: of `render`.

    Raises what `render` raises; ValueError for no or too many frames, and for another file type;
    ModuleNotFoundError where Pillow or PyAV is missing. Nothing is written unless all is.
    """
    target = check_film_path(path)
    count = check_integer("frames", frames)
    if not 1 <= count <= _MOST_FRAMES:
        raise ValueError(f"frames must be from 1 to {_MOST_FRAMES:,}, not {count}")
    if not 0 < fps <= 240:
        raise ValueError(f"fps must be more than 0 and at most 240, not {fps}")
    if not math.isfinite(turn):
        raise ValueError(f"turn must be a finite number of degrees, not {turn}")
    size = check_size(size)
    with write_atomically(target) as partial, _encoder(partial, size, fps) as add:
        repeats = turn != 0 and turn % 360 == 0
        steps = np.arange(count) / max(count if repeats else count - 1, 1)
        given = {"what": what, "camera": camera, **settings}
        moments = [{name: _at(value, s) for name, value in given.items()} for s in steps.tolist()]
        cameras = _cameras(moments, turn * steps, size)
        for moment, one in _told(list(zip(moments, cameras, strict=True)), progress):
            picture = render(
                moment.pop("what"), size=size, show=show, progress=False,
                **{**moment, "camera": one},
            )  # fmt: skip
            add(picture.shown)


def check_film_path(path: str | os.PathLike[str]) -> Path:
    """The path of a film to write.

    Raises:
        ValueError: its extension is neither .gif nor .mp4.
        OSError: no file can be created there.
    """
    target = Path(path)
    if target.suffix.lower() not in FILM_FILES:
        raise ValueError(f"{target}: films are written as {' or '.join(FILM_FILES)}")
    check_writable(target)
    return target


def _at(value: Any, s: float) -> Any:
    """A setting at a moment. Fields and materials that can be called are what they are."""
    return value(s) if callable(value) and not isinstance(value, type) else value


def _told(moments: list[Any], shown: bool) -> Iterator[Any]:
    """The moments, with a progress bar on stderr."""
    columns = (TextColumn("film"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not shown, transient=True) as bar:
        yield from bar.track(moments)


def _cameras(
    moments: list[dict[str, Any]], turns: FloatArray, size: tuple[int, int]
) -> list[Camera]:
    """The camera of each picture. Those that frame the surface share a box, a target and a
    distance."""
    asked = [moment.get("camera") for moment in moments]
    cameras = [Camera() if one is None else check_camera(one) for one in asked]
    turned = [
        replace(one, azimuth=one.azimuth + turn) if one.position is None else one
        for one, turn in zip(cameras, turns.tolist(), strict=True)
    ]
    if all(one.position is not None for one in turned):
        return turned
    boxes = [np.array(one.box.bounds()) for one in turned if one.box is not None]
    points = np.concatenate(boxes or [_points(moments)])
    box = Box(_three(points.min(axis=0)), _three(points.max(axis=0)))
    if boxes:
        points = np.array(np.meshgrid(*np.array(box.bounds()).T)).reshape(3, -1).T
    middle = _three(points.min(axis=0) / 2 + points.max(axis=0) / 2)
    turn_up = upright(moments[0].get("up") or "z")

    def stood(local: FloatArray) -> FloatArray:
        return local @ turn_up.T

    framed = [replace(one, box=box, target=one.target or middle) for one in turned]
    distances = [
        float(np.linalg.norm(np.subtract(pose.origin, pose.target)))
        for pose in (
            replace(one, distance=None).pose(stood(points), size, stood)
            for one in framed
            if one.position is None
        )
    ]
    farthest = max(distances)
    return [
        one if one.position is not None
        else replace(one, distance=one.distance or farthest, fov=one.angle)
        for one in framed
    ]  # fmt: skip


def _points(moments: list[dict[str, Any]]) -> FloatArray:
    """Points (n, 3) of all that is seen in a film."""
    backend = mitsuba_backend(register())
    seen: list[FloatArray] = []
    last: Any = None
    for moment in moments:
        rest = {name: value for name, value in moment.items() if name not in _OF_PICTURES}
        if last is not None and all(rest[name] is last[name] for name in rest):
            continue  # the same surfaces
        last = rest
        surfaces: list[LevelSet] = surfaces_of(**rest)
        seen += [visible_points(one, backend) for one in surfaces]
    return np.concatenate(seen)


# Settings that do not change where a surface is.
_OF_PICTURES = ("camera", "material", "backdrop", "up", "spp", "antialias", "max_depth", "seed")


def _three(point: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(c) for c in point)
    return x, y, z


@contextmanager
def _encoder(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    """Takes pictures and has written them to `path` at the end."""
    if path.suffix.lower() == ".gif":
        with _gif(path, fps) as add:
            yield add
    else:
        with _mp4(path, size, fps) as add:
            yield add


@contextmanager
def _gif(path: Path, fps: float) -> Generator[Callable[[Pixels], None]]:
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "films in .gif files need Pillow: pip install 'harnack[film]'"
        ) from None
    pictures: list[Any] = []

    def add(pixels: Pixels) -> None:
        picture = Image.fromarray(pixels)
        if pixels.shape[-1] == 4:  # a GIF knows nothing between clear and opaque
            pictures.append(picture)
        else:
            pictures.append(picture.quantize(256, method=Image.Quantize.MEDIANCUT))

    yield add
    duration = 10 * max(2, round(100 / fps))
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=duration, loop=0, disposal=2
    )


@contextmanager
def _mp4(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    try:
        import av
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "films in .mp4 files need PyAV: pip install 'harnack[film]', or write a .gif"
        ) from None
    library = cast("Any", av)
    # H.264 has pairs of pixels.
    width, height = (side - side % 2 for side in size)
    if not (width and height):
        raise ValueError(f"a film in .mp4 has sides of at least 2 pixels, not {size}")
    with library.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "16"}

        def add(pixels: Pixels) -> None:
            if pixels.shape[-1] == 4:
                raise ValueError("films in .mp4 have no alpha: choose another backdrop, or a .gif")
            frame = library.VideoFrame.from_ndarray(
                np.ascontiguousarray(pixels[:height, :width]), format="rgb24"
            )
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode())
