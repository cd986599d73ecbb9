"""Films: each picture is drawn by `render`, and the camera is chosen such that all pictures fit
together."""

from __future__ import annotations

import base64
import html
import inspect
import math
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.backend.validation import as_finite
from harnack.cluster.executor import TaskResult, open_executor
from harnack.files.file_geometry import check_writable, write_atomically
from harnack.geometry import Box
from harnack.progress import progress_bar
from harnack.rendering.camera import Camera
from harnack.rendering.framing import UnboundedSurfaceError, rotation_to_z_up, visible_points
from harnack.rendering.mitsuba import mitsuba_backend, set_variant
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.option_table import BY_NAME, SHORTHAND, complete_options, shows_options
from harnack.rendering.picture import render
from harnack.rendering.render_job import DEFAULT_SIZE
from harnack.rendering.render_options import check_camera, check_image_size, check_integer
from harnack.rendering.studio_surfaces import drawn_surfaces

if TYPE_CHECKING:
    from harnack.tracer import TraceOptions

FILM_FILES = (".gif", ".mp4")
_MAX_FRAMES = 10_000
# The options that change where surfaces are.
_MOVING = frozenset((*SHORTHAND, "surfaces", "options", "boundary_radius", "thickness"))
# The palette's last entry in a GIF, which stands for transparent.
_CLEAR = 255
Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Animation:
    """A film that was written to a file; notebooks show it.

    path: of the file.
    size: (width, height) of its pictures in pixels.
    """

    path: Path
    size: tuple[int, int]

    def _repr_html_(self) -> str:
        """HTML that shows the film in a notebook; it contains the film itself."""
        data = base64.b64encode(self.path.read_bytes()).decode()
        width, height = self.size
        size = f'width="{width}" height="{height}"'
        if self.path.suffix.lower() == ".gif":
            name = html.escape(self.path.name)
            return f'<img {size} alt="{name}" src="data:image/gif;base64,{data}">'
        source = f'<source src="data:video/mp4;base64,{data}" type="video/mp4">'
        return f"<video {size} controls loop muted autoplay>{source}</video>"


@shows_options("animate")
def animate(
    surfaces: Any,
    path: str | os.PathLike[str],
    *,
    options: TraceOptions | None = None,
    **keywords: Any,
) -> Animation:
    """Draw a film and write it to `path`; notebooks show the returned `Animation`.

        hk.animate(field, "turntable.gif", orbit=360)
        hk.animate(lambda s: hk.fields.Morph(a, b, gap=0.2, w=0.2 * s), "morph.mp4")
        hk.animate(field, "levels.gif", level=lambda s: 1 + 4 * s)

    surfaces: as `render` draws them in its studio. They, the camera and options that may change
        from picture to picture may be functions of s, which goes from 0 in the first picture to 1
        in the last; with an orbit of 360 degrees, to just before 1, so that the film can be
        repeated.
    path: .gif (Pillow) or .mp4 (PyAV: `pip install harnack[film]`).
    frames: the number of pictures.
    fps: pictures a second. In a GIF each picture lasts a whole number of hundredths of a second.
    orbit: degrees that the camera goes around its target during the film; None is 360 if nothing
        else moves, else 0.
    camera: as `render` takes it. Properties that it does not set (target, distance, angle of view)
        are the same for all pictures, and such that everything is always in view.
    client, checkpoint: as `render` takes them. Workers draw whole pictures; a film with more
        pictures, or at another speed, draws only the pictures that the folder does not have.
    options, keywords: as `render` takes them, but for `chunks`; `show` is "shaded" by default.

    Raises the errors of `render`; ValueError for no or too many frames, and for another file type;
    ModuleNotFoundError if Pillow or PyAV is missing. The file is written only if all pictures are
    drawn.
    """
    target = check_film_path(path)
    arguments = complete_options("animate", keywords)
    count = check_integer("frames", arguments.pop("frames"))
    if not 1 <= count <= _MAX_FRAMES:
        raise ValueError(f"frames must be from 1 to {_MAX_FRAMES:,}, not {count}")
    fps, orbit = as_finite(arguments.pop("fps"), "fps"), arguments.pop("orbit")
    if orbit is None:
        is_moving = any(map(_is_function_of_s, (surfaces, *arguments.values())))
        orbit = 0.0 if is_moving else 360.0
    orbit = as_finite(orbit, "orbit")
    if not 0 < fps <= 240:
        raise ValueError(f"fps must be more than 0 and at most 240, not {fps}")
    for name, value in arguments.items():
        is_constant = not BY_NAME[name].varies and name not in ("client", "progress")
        if is_constant and _is_function_of_s(value):
            raise TypeError(
                f"{name} is the same for all pictures of a film, and no function of s: give it as "
                "render takes it"
            )
    progress, client, checkpoint = (
        arguments.pop(name) for name in ("progress", "client", "checkpoint")
    )
    size = check_image_size(arguments.pop("size") or DEFAULT_SIZE)
    with write_atomically(target) as partial, _encoder(partial, size, fps) as add:
        repeats = orbit != 0 and orbit % 360 == 0
        steps = np.arange(count) / max(count if repeats else count - 1, 1)
        changing = {"surfaces": surfaces, "options": options, **arguments}
        moments = [
            {name: _value_at(value, s) for name, value in changing.items()} for s in steps.tolist()
        ]
        cameras = _cameras(moments, steps, orbit, size)
        frames = [
            {**moment, "camera": camera} for moment, camera in zip(moments, cameras, strict=True)
        ]
        job, parts = _job(frames, {"size": size, "progress": False})
        with (
            progress_bar("film", progress) as advance,
            open_executor(client, checkpoint) as workers,
        ):
            for frame in workers.run_tasks(job, "frame", parts):
                add(frame["shown"])
                advance(1 / count)
    return Animation(target, size)


@dataclass(frozen=True)
class _FilmJob:
    """The arguments of `render` that all pictures of a film have in common, and the Mitsuba
    variant. It can be sent to other processes, which draw single pictures."""

    arguments: dict[str, Any]
    variant: str

    def frame(self, changes: dict[str, Any]) -> TaskResult:
        """The pixels of one picture, as an array by name. changes: the arguments that differ
        between pictures."""
        set_variant(self.variant)
        arguments = {**self.arguments, **changes}
        return {"shown": render(arguments.pop("surfaces"), **arguments).srgb}


def _job(
    frames: list[dict[str, Any]], same: dict[str, Any]
) -> tuple[_FilmJob, list[tuple[dict[str, Any]]]]:
    """The job with the arguments that all pictures of a film share, and for each picture a tuple
    with its other arguments. same: further shared arguments."""
    first = frames[0]
    varying = [name for name in first if any(frame[name] is not first[name] for frame in frames)]
    same = {**same, **{name: first[name] for name in first if name not in varying}}
    return _FilmJob(same, register().variant()), [
        ({name: frame[name] for name in varying},) for frame in frames
    ]


def check_film_path(path: str | os.PathLike[str]) -> Path:
    """The path of a film to write, checked.

    Raises:
        ValueError: its extension is neither .gif nor .mp4.
        OSError: no file can be created there.
    """
    target = Path(path)
    if target.suffix.lower() not in FILM_FILES:
        raise ValueError(f"{target}: films are written as {' or '.join(FILM_FILES)}")
    check_writable(target)
    return target


def _value_at(value: Any, s: float) -> Any:
    """The value of an option in the picture at the time s. Functions of s are called; all other
    values are constant."""
    return value(s) if _is_function_of_s(value) else value


def _is_function_of_s(value: Any) -> bool:
    """Whether an option is a function of s, the time in a film: whether it can be called with one
    number. A function of three coordinates, by which a surface is colored, cannot."""
    if not callable(value) or isinstance(value, type):
        return False
    try:
        parameters = inspect.signature(value).parameters.values()
    except ValueError:  # a function of C
        return True
    required = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    return len(required) <= 1


def _cameras(
    moments: list[dict[str, Any]], steps: FloatArray, orbit: float, size: tuple[int, int]
) -> list[Camera]:
    """The camera of each picture, such that the surfaces of all pictures are always in view. All
    cameras have the same box, target, distance and angle of view, unless an option sets them.

    moments: the arguments of each picture. steps: (n,) the time s of each. orbit: degrees from s =
        0 to 1.
    size: (width, height) in pixels.
    """
    given = [moment.get("camera") for moment in moments]
    cameras = [Camera() if camera is None else check_camera(camera) for camera in given]
    ups = [moment.get("up") for moment in moments]
    turns = [rotation_to_z_up("z" if up is None else up) for up in ups]
    boxes = [np.array(camera.box.bounds()) for camera in cameras if camera.box is not None]
    points = np.concatenate(boxes or [_points(moments, steps)])
    ends = np.array([points.min(axis=0), points.max(axis=0)])
    if boxes:
        points = np.array(np.meshgrid(*ends.T)).reshape(3, -1).T
    box, middle = Box(*map(_as_point, ends)), _as_point(ends.mean(axis=0))
    framed = [
        _orbited(replace(camera, box=box, target=camera.target or middle), orbit * s, turn)
        for camera, s, turn in zip(cameras, steps.tolist(), turns, strict=True)
    ]
    free = [camera.position is None and camera.distance is None for camera in framed]
    poses = [
        replace(camera, zoom=1.0).pose(
            points @ turn.T, size, lambda local, turn=turn: local @ turn.T
        )
        for camera, turn in zip(framed, turns, strict=True)
    ]
    distances = [float(np.linalg.norm(pose.origin - pose.target)) for pose in poses]
    farthest = max(
        (length for length, is_free in zip(distances, free, strict=True) if is_free), default=1.0
    )
    widest = max(
        (p.fov for p, is_free in zip(poses, free, strict=True) if not is_free), default=1.0
    )
    return [
        replace(camera, distance=farthest / camera.zoom, fov=camera.fov_or_default, zoom=1.0)
        if is_free
        else replace(camera, fov=widest if camera.fov is None else camera.fov)
        for camera, is_free in zip(framed, free, strict=True)
    ]


def _orbited(camera: Camera, orbit: float, upright: FloatArray) -> Camera:
    """The camera after it has gone around its target by `orbit` degrees. upright: (3, 3) the
    rotation that turns the direction up to z."""
    if camera.position is None:
        return replace(camera, azimuth=camera.azimuth_elevation[0] + orbit)
    c, s = math.cos(math.radians(orbit)), math.sin(math.radians(orbit))
    rotation = upright.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
    target = np.array(camera.target)
    position = target + rotation @ (np.array(camera.position) - target)
    return replace(camera, position=_as_point(position))


def _points(moments: list[dict[str, Any]], steps: FloatArray) -> FloatArray:
    """Points (n, 3) of the visible parts of all surfaces in a film. moments: the arguments of each
    picture. steps: (n,) the time s of each."""
    backend = mitsuba_backend(register())
    points: list[FloatArray] = []
    last: Any = None
    for moment, s in zip(moments, steps.tolist(), strict=True):
        settings = {name: value for name, value in moment.items() if name in _MOVING}
        if last is not None and all(settings[name] is last[name] for name in settings):
            continue  # the same surfaces
        last = settings
        try:
            points += [visible_points(surface, backend) for surface in drawn_surfaces(**settings)]
        except UnboundedSurfaceError as error:
            raise ValueError(f"at s = {s:g} of the film, {error}") from None
    return np.concatenate(points)


def _as_point(point: FloatArray) -> tuple[float, float, float]:
    """A point (3,) as a tuple of floats."""
    x, y, z = (float(c) for c in point)
    return x, y, z


@contextmanager
def _encoder(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    """A context whose value is a function that adds a picture (h, w, 3 or 4) to the film. The film
    is in the file when the block ends."""
    if path.suffix.lower() == ".gif":
        with _gif(path, fps) as add:
            yield add
    else:
        with _mp4(path, size, fps) as add:
            yield add


@contextmanager
def _gif(path: Path, fps: float) -> Generator[Callable[[Pixels], None]]:
    """A context whose value is a function that adds a picture (h, w, 3 or 4) to a GIF file."""
    try:
        from PIL import Image
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "films in .gif files need Pillow: pip install 'harnack[film]'"
        ) from None
    pictures: list[Any] = []

    def add(pixels: Pixels) -> None:
        """Add a picture (h, w, 3 or 4) to the film."""
        opaque = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
        indexed = opaque.quantize(_CLEAR, method=Image.Quantize.MEDIANCUT)
        if pixels.shape[-1] == 4:  # a GIF has no partly transparent pixels
            mask = Image.fromarray(np.where(pixels[..., 3] < 128, np.uint8(255), np.uint8(0)))
            indexed.paste(_CLEAR, mask=mask)
            indexed.info["transparency"] = _CLEAR
        pictures.append(indexed)

    yield add
    duration = 10 * max(2, round(100 / fps))
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=duration, loop=0, disposal=2
    )


@contextmanager
def _mp4(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    """A context whose value is a function that adds a picture (h, w, 3) to an MP4 file."""
    try:
        import av
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "films in .mp4 files need PyAV: pip install 'harnack[film]', or write a .gif"
        ) from None
    library = cast("Any", av)
    # H.264 stores colors for pairs of pixels.
    if min(size) < 2:
        raise ValueError(f"a film in .mp4 has sides of at least 2 pixels, not {size}")
    with library.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16"}

        def add(pixels: Pixels) -> None:
            """Add a picture (h, w, 3) to the film."""
            if pixels.shape[-1] == 4:
                raise ValueError("films in .mp4 have no alpha: choose another backdrop, or a .gif")
            height, width = (side - side % 2 for side in pixels.shape[:2])
            if not stream.codec_context.is_open:
                stream.width, stream.height = width, height
            height, width = stream.height, stream.width
            frame = library.VideoFrame.from_ndarray(
                np.ascontiguousarray(pixels[:height, :width]), format="rgb24"
            )
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode())
