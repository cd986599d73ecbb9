"""Films: `animate` draws pictures by `render` and writes them to a GIF or MP4 file. The time s goes
from 0 in the first picture to 1 in the last, and options of a film may be functions of s. The
cameras of all pictures are chosen together such that everything stays in view and nothing jumps."""

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
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray
from harnack.backend.validation import as_finite
from harnack.cluster.executor import TaskResult, open_executor
from harnack.files.file_geometry import check_writable, write_atomically
from harnack.geometry import Box
from harnack.optional_packages import import_optional
from harnack.progress import show_progress
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

    path: the file.
    size: (width, height) of its pictures in pixels.
    """

    path: Path
    size: tuple[int, int]

    def _repr_html_(self) -> str:
        """Return HTML that shows the film in a notebook. It contains the film itself."""
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

    surfaces: as `render` draws them in its studio. The surfaces, the camera and options that may
        change from picture to picture may be functions of the time s. It goes from 0 in the first
        picture to 1 in the last; with an orbit of 360 degrees, to just before 1, so that the film
        can be repeated.
    path: .gif (Pillow) or .mp4 (PyAV: `pip install harnack[film]`).
    frames: the number of pictures.
    fps: pictures a second. In a GIF each picture lasts a whole number of hundredths of a second.
    orbit: degrees that the camera goes around its target during the film; None is 360 if nothing
        else moves, else 0.
    camera: as `render` takes it. Properties that it does not set (target, distance, angle of view)
        are the same for all pictures, and chosen such that everything is always in view.
    client, checkpoint: as `render` takes them. Each process of the cluster draws whole pictures. A
        film with more pictures, or at another speed, draws only the pictures that the folder does
        not have.
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
    # By default the camera moves only if nothing else does.
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
        # A full turn leaves out s = 1, which would show the first picture twice.
        repeats = orbit != 0 and orbit % 360 == 0
        steps = np.arange(count) / max(count if repeats else count - 1, 1)
        changing = {"surfaces": surfaces, "options": options, **arguments}
        # The values of all arguments at each time.
        moments = [
            {name: _value_at(value, s) for name, value in changing.items()} for s in steps.tolist()
        ]
        cameras = _cameras(moments, steps, orbit, size)
        frames = [
            {**moment, "camera": camera} for moment, camera in zip(moments, cameras, strict=True)
        ]
        # Pictures are drawn by `render`, in this process or on a cluster, and added in order.
        job, parts = _job(frames, {"size": size, "progress": False})
        with (
            show_progress("film", progress) as reporter,
            open_executor(job, client, checkpoint) as workers,
        ):
            for frame in workers.run_tasks("frame", parts):
                add(frame["shown"])
                reporter.advance(1 / count)
    return Animation(target, size)


@dataclass(frozen=True)
class _FilmJob:
    """Draws single pictures of a film, and can be sent to other processes.

    arguments: the arguments of `render` that all pictures of the film have in common.
    variant: the Mitsuba variant.
    """

    arguments: dict[str, Any]
    variant: str

    def frame(self, changes: dict[str, Any]) -> TaskResult:
        """Draw one picture. Returns its pixels as {"shown": array}, 8-bit sRGB.

        changes: the arguments of `render` that differ between pictures.
        """
        set_variant(self.variant)
        arguments = {**self.arguments, **changes}
        return {"shown": render(arguments.pop("surfaces"), **arguments).srgb}


def _job(
    frames: list[dict[str, Any]], shared: dict[str, Any]
) -> tuple[_FilmJob, list[tuple[dict[str, Any]]]]:
    """Separate the arguments that all pictures of a film share from those that change. Returns the
    job with the shared ones, and for each picture a tuple (changes,) for a call of
    `_FilmJob.frame`.

    frames: for each picture, the arguments of `render` by name.
    shared: further shared arguments.
    """
    first = frames[0]
    # Arguments are compared by identity: comparing the contents of arrays or fields could take
    # long.
    varying = [name for name in first if any(frame[name] is not first[name] for frame in frames)]
    shared = {**shared, **{name: first[name] for name in first if name not in varying}}
    # `register` returns the Mitsuba module, whose variant is the one that is set now.
    return _FilmJob(shared, register().variant()), [
        ({name: frame[name] for name in varying},) for frame in frames
    ]


def check_film_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of a film to write, checked.

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
    """Return the value of an option in the picture at the time s. Functions of s are called; all
    other values are constant."""
    return value(s) if _is_function_of_s(value) else value


def _is_function_of_s(value: Any) -> bool:
    """Return whether an option is a function of s, the time in a film: whether it can be called
    with one number. A function of three coordinates, by which a surface is colored, cannot. A class
    is not taken for a function."""
    if not callable(value) or isinstance(value, type):
        return False
    try:
        parameters = inspect.signature(value).parameters.values()
    except ValueError:  # a function of C
        return True
    # Keyword arguments such as **options need not be passed.
    required = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    return len(required) <= 1


def _cameras(
    moments: list[dict[str, Any]], steps: FloatArray, orbit: float, size: tuple[int, int]
) -> list[Camera]:
    """Choose the cameras of a film, one for each picture, such that the surfaces of all pictures
    are always in view. All cameras have the same box, target, distance and angle of view, unless an
    option sets them.

    moments: for each picture, the arguments of `render` by name.
    steps: (n,) the time s of each picture.
    orbit: degrees that the camera goes around its target from s = 0 to s = 1.
    size: (width, height) in pixels.

    What is in view are the corners of all boxes that cameras have or, if none has a box, the
    visible points of all surfaces. Each camera is first framed by itself. Then cameras that choose
    their distance get the largest of these distances, and cameras at a given position or distance
    get the widest angle of view.
    """
    given = [moment.get("camera") for moment in moments]
    cameras = [Camera() if camera is None else check_camera(camera) for camera in given]
    ups = [moment.get("up") for moment in moments]
    rotations = [rotation_to_z_up("z" if up is None else up) for up in ups]
    boxes = [np.array(camera.box.bounds()) for camera in cameras if camera.box is not None]
    # Tracing rays for visible points is needed only without boxes.
    points = np.concatenate(boxes or [_points(moments, steps)])
    # The lower and the upper corner of the box of all that has to be in view.
    corners = np.array([points.min(axis=0), points.max(axis=0)])
    if boxes:  # then all eight corners of this box are framed
        points = np.array(np.meshgrid(*corners.T)).reshape(3, -1).T
    box, center = Box(*map(_as_point, corners)), _as_point(corners.mean(axis=0))
    framed = [
        _orbited(replace(camera, box=box, target=camera.target or center), orbit * s, rotation)
        for camera, s, rotation in zip(cameras, steps.tolist(), rotations, strict=True)
    ]
    # Frame each camera by itself, with zoom 1. `pose` needs coordinates whose z is `up`, and a map
    # from the user's coordinates to them. Here they are rotated only, so that distances stay the
    # user's; on the stage of a picture they are scaled and moved as well.
    chooses_distance = [camera.position is None and camera.distance is None for camera in framed]
    poses = [
        replace(camera, zoom=1.0).pose(
            points @ rotation.T,
            size,
            lambda user_points, rotation=rotation: user_points @ rotation.T,
        )
        for camera, rotation in zip(framed, rotations, strict=True)
    ]
    distances = [float(np.linalg.norm(pose.origin - pose.target)) for pose in poses]
    # A default of 1 is never used: it is for films in which no camera needs the number.
    farthest = max(
        (
            length
            for length, is_chosen in zip(distances, chooses_distance, strict=True)
            if is_chosen
        ),
        default=1.0,
    )
    widest = max(
        (p.fov for p, is_chosen in zip(poses, chooses_distance, strict=True) if not is_chosen),
        default=1.0,
    )
    return [
        # The zoom is now part of the distance.
        replace(camera, distance=farthest / camera.zoom, fov=camera.fov_or_default, zoom=1.0)
        if is_chosen
        else replace(camera, fov=widest if camera.fov is None else camera.fov)
        for camera, is_chosen in zip(framed, chooses_distance, strict=True)
    ]


def _orbited(camera: Camera, orbit: float, upright: FloatArray) -> Camera:
    """Return a camera that has gone around the target of the given camera by `orbit` degrees.

    upright: (3, 3) the rotation that turns the direction that is up in the film to z.

    A camera that stands at a position is rotated about the vertical through its target; for other
    cameras the azimuth changes.
    """
    if camera.position is None:
        return replace(camera, azimuth=camera.azimuth_elevation[0] + orbit)
    c, s = math.cos(math.radians(orbit)), math.sin(math.radians(orbit))
    rotation = upright.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
    target = np.array(camera.target)
    position = target + rotation @ (np.array(camera.position) - target)
    return replace(camera, position=_as_point(position))


def _points(moments: list[dict[str, Any]], steps: FloatArray) -> FloatArray:
    """Find points (n, 3) of the visible parts of all surfaces in a film.

    moments: for each picture, the arguments of `render` by name.
    steps: (n,) the time s of each picture, for messages.

    Raises:
        ValueError: a surface is unbounded; the message names its time.
    """
    backend = mitsuba_backend(register())
    points: list[FloatArray] = []
    last_settings: Any = None
    for moment, s in zip(moments, steps.tolist(), strict=True):
        settings = {name: value for name, value in moment.items() if name in _MOVING}
        if last_settings is not None and all(
            settings[name] is last_settings[name] for name in settings
        ):
            continue  # the same surfaces
        last_settings = settings
        try:
            points += [visible_points(surface, backend) for surface in drawn_surfaces(**settings)]
        except UnboundedSurfaceError as error:
            raise ValueError(f"at s = {s:g} of the film, {error}") from None
    return np.concatenate(points)


def _as_point(point: FloatArray) -> tuple[float, float, float]:
    """Return a point (3,) as a tuple of floats."""
    x, y, z = (float(c) for c in point)
    return x, y, z


@contextmanager
def _encoder(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    """Open a film for writing. The context's value is a function that adds a picture (h, w, 3 or 4)
    to the film. The film is in the file when the block ends.

    path: .gif or .mp4.
    size: (width, height) in pixels.
    fps: pictures a second.
    """
    if path.suffix.lower() == ".gif":
        with _gif(path, fps) as add:
            yield add
    else:
        with _mp4(path, size, fps) as add:
            yield add


@contextmanager
def _gif(path: Path, fps: float) -> Generator[Callable[[Pixels], None]]:
    """Open the GIF file `path` for writing, to be shown with `fps` pictures a second. The context's
    value is a function that adds a picture (h, w, 3 or 4). The file is written when the block
    ends."""
    Image = import_optional(
        "PIL.Image", "films in .gif files need Pillow: pip install 'harnack[film]'"
    )
    pictures: list[Any] = []

    def add(pixels: Pixels) -> None:
        """Add a picture (h, w, 3 or 4) to the film. A pixel that is less than half covered becomes
        transparent."""
        opaque = Image.fromarray(np.ascontiguousarray(pixels[..., :3]))
        # 255 colors; entry 255, the last of the palette, stands for transparent pixels.
        indexed = opaque.quantize(_CLEAR, method=Image.Quantize.MEDIANCUT)
        if pixels.shape[-1] == 4:  # a GIF has no partly transparent pixels
            mask = Image.fromarray(np.where(pixels[..., 3] < 128, np.uint8(255), np.uint8(0)))
            indexed.paste(_CLEAR, mask=mask)
            indexed.info["transparency"] = _CLEAR
        pictures.append(indexed)

    yield add
    # Milliseconds: GIF files count hundredths of a second, and players slow down what is faster
    # than 50 pictures a second.
    duration = 10 * max(2, round(100 / fps))
    # loop=0: repeated for ever; disposal=2: each picture is cleared before the next one.
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=duration, loop=0, disposal=2
    )


@contextmanager
def _mp4(path: Path, size: tuple[int, int], fps: float) -> Generator[Callable[[Pixels], None]]:
    """Open the MP4 file `path` for writing, for pictures of `size` (width, height) pixels, `fps` a
    second. The context's value is a function that adds a picture (h, w, 3). An odd row or column at
    the end is left out, as H.264 stores colors for pairs of pixels."""
    av = import_optional(
        "av", "films in .mp4 files need PyAV: pip install 'harnack[film]', or write a .gif"
    )
    if min(size) < 2:
        raise ValueError(f"a film in .mp4 has sides of at least 2 pixels, not {size}")
    with av.open(str(path), "w") as container:
        # Denominators up to 1001 express the rates of television, such as 30000/1001.
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16"}  # high quality: 0 is lossless, and 23 the default

        def add(pixels: Pixels) -> None:
            """Add a picture (h, w, 3) to the film.

            Raises:
                ValueError: the picture has alpha.
            """
            if pixels.shape[-1] == 4:
                raise ValueError("films in .mp4 have no alpha: choose another backdrop, or a .gif")
            # `stream` is the video in the file `container`. Its format needs even sides, so an odd
            # last row or column is cut off.
            height, width = (side - side % 2 for side in pixels.shape[:2])
            # The size is set by the first picture, which a color bar may have widened.
            if not stream.codec_context.is_open:
                stream.width, stream.height = width, height
            height, width = stream.height, stream.width
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(pixels[:height, :width]), format="rgb24"
            )
            container.mux(stream.encode(frame))

        yield add
        # Without a picture, `encode` returns what the encoder still holds back.
        container.mux(stream.encode())
