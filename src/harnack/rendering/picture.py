"""Contains `render`, which draws a picture of fields, surfaces or Mitsuba scenes. Fields and
surfaces are drawn in the studio: a stage with lights, a camera and a backdrop. A picture is drawn
by a task, which renders any range of its pixels. So its parts can be computed in this process or,
by an executor, on a cluster."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from harnack.cluster.executor import Executor, open_executor
from harnack.fields import Field
from harnack.progress import ProgressFunction, show_progress
from harnack.rendering.aov_render import AOV_MODES, AovTask, aov_picture
from harnack.rendering.backdrops import GroundBackdrop
from harnack.rendering.images import Picture, check_picture_path, tone_map, write_image
from harnack.rendering.light_paths import (
    MIN_REPORTED_SECONDS,
    PathRenderTask,
    denoise_image,
    estimate_time,
    load_denoiser,
    render_paths,
)
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.option_table import (
    STUDIO_OPTIONS,
    RenderKeywords,
    RenderOptions,
    complete_options,
    shorthand_among,
    shows_options,
)
from harnack.rendering.render_job import EDGE_SPP, RenderJob
from harnack.rendering.render_options import check_chunks, refuse_studio_options
from harnack.rendering.shaded_render import ShadedTask, render_shaded
from harnack.rendering.shading import (
    backdrop_image,
    studio_wall,
)
from harnack.rendering.stage import StudioScene
from harnack.tracer import Surface, TracedSurface

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from harnack.tracer import TraceOptions

# Modes with ground and lights, and the name of the rays that they trace.
_LIT = {"path": "light paths", "shaded": "rays"}
_IN_AOV = (".R", ".G", ".B", ".A")
Image = npt.NDArray[Any]


@shows_options("render")
def render(
    surfaces: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    options: TraceOptions | None = None,
    **keywords: Unpack[RenderKeywords],
) -> Picture:
    """Draw fields or a Mitsuba scene, and write the picture to `path` if there is one.

    surfaces: a field, a `Surface` or a list of them, drawn in the studio; or a Mitsuba scene, its
        dictionary, or the path of its XML file.
    path: .png (8-bit sRGB, tone mapped) or .exr (the numbers).
    options: a `TraceOptions` for all surfaces; `precision` and `backend` must not be set. Its
        attributes may be given as keywords instead. If fields are given, the keywords of `Surface`
        (level, clip, section, side, largest) may be given too. A `Solid` with a section, or of
        glass, is drawn with its inside. The default tolerance is 1e-4 of half the diagonal of the
        box of what is drawn.
    show: the kind of picture. "path" follows light paths; "shaded" lights first hits by a formula,
        in seconds and without noise. The other kinds show what one ray a pixel found: "normal",
        "evaluations" (of the fields), "status", "depth", or "value", which colors the surface by
        the function `color_by`. Edges of pictures of values are antialiased, but the numbers that
        are returned are not.
    size: (width, height) in pixels, by default (800, 600) or the scene's own.
    spp: samples per pixel. With show="path" each pixel has so many, by default 64 or the number of
        the scene. With "shaded" and "value" pixels at edges have so many, by default 9. Other
        pictures have one ray per pixel.
    antialias: which pixels of a shaded picture get all their samples. With "edges", the default,
        pixels that differ from a neighbor. With "cones", also pixels that a surface covers in part,
        found by a cone around each pixel. So wires thinner than a pixel stay lines. Cones take
        about twice as many evaluations of fields, estimate distances by |f - level| / |grad f|,
        and raise an error for fields that jump, such as winding numbers of meshes.
    color_by: the function whose values show="value" shows on the surface: a field, "x", "y", "z",
        or a function of three coordinates. Coordinates are those of the surface; for a Mitsuba
        scene, those of the world.
    color_range: (low, high), the numbers at the ends of the color scale of values, depths or
        evaluations; by default the least and the greatest number in the picture. Give it to have
        the same colors in all pictures of a series.
    color_bar: True, or the title, for a bar with numbers to the right of these pictures. It widens
        the picture that is written and displayed, not the array that is returned. Needs Pillow,
        which `pip install harnack[film]` brings.
    max_depth: longest light path in edges, -1 for no limit; by default 12 or the scene's own.
    seed: pictures with another seed have other noise; the same seed gives the same picture. Only
        pictures with show="path" have noise.
    denoise: whether a neural network (Open Image Denoise; `pip install harnack[denoise]`) takes the
        noise out of a color picture. It guesses: do not read numbers off such a picture.
    progress: whether a bar on stderr shows how much of the picture is done, and a line before it
        how long a long picture will take. Or a function in place of the bar, which is called with
        a `Progress`; an error that it raises ends the picture.
    client: a `dask.distributed.Client`, or the address of a scheduler, whose workers draw parts of
        the picture: the same picture bit for bit, whatever the parts and however many the workers.
        Steps that need the whole picture (edges, hidden sky, removal of noise) are done in this
        process. Needs `pip install harnack[cluster]`, in this process and on the workers.
    checkpoint: a folder, in which parts that are done are kept, so that a picture that was stopped
        goes on from there. It is not emptied when the picture is done.
    chunks: how many parts a picture is divided into, with a client or a checkpoint; by default as
        suits the workers.

    In the studio only:

    material: a name of `MATERIALS`, a color as for the backdrop, a `Material` or a BSDF dictionary;
        a list, one for each surface or, of one field, for each level.
    camera: where the stage is seen from, a `Camera`, or (x, y, z) in the surfaces' coordinates.
    backdrop: what is seen behind the surfaces. "light" or "dark" has a floor; all others have none.
        A color is a name of CSS such as "white", "#rrggbb" or three numbers of sRGB. (bottom, top)
        are two colors. An image is its file (.png, .jpg, .exr) or an array (h, w, 3) of bytes or
        of linear numbers, scaled to cover the picture. "transparent" gives alpha in PNG and EXR
        files and as a fourth number, by which the first three are multiplied.
    up: what is up, "x", "y", "z", "-x", ... or a direction in the surfaces' coordinates; by
        default z.
    boundary_radius: the radius, in the surfaces' coordinates, of a tube around the curves at which
        surfaces end (`Field.boundary`). boundary_material: its material, by default "gold".
    section_material: what the faces of opaque solids on their `section` are made of.
    isolines: lines on the surfaces, of heights or of another function, where `show` is "path",
        "shaded" or "value": an `Isolines` or several.
    thickness: the thickness, in the surfaces' coordinates, of walls that are drawn in place of the
        surfaces: the closed meshes that `harnack.mesh` makes with this thickness, whose triangles
        are seen from close by.

    In shaded pictures, the side of larger values of an open surface in one color is darker, and
    what spans the gaps of a mesh is amber, or teal on warm colors.

    Light goes through solids of glass ("glass", "frosted", "amber", "cobalt", "jelly"), bent, and
    tinted glass takes some of it away by the law of Beer and Lambert. Shaded pictures look straight
    through it and leave out caustics, blur, and reflections of anything but the sky.

    Returns an array, which notebooks show as the picture. With show="path" and "shaded" it is
    linear sRGB radiance, (h, w, 3), or (h, w, 4) with alpha if the backdrop is transparent or the
    film of the scene has alpha. Normals are (h, w, 3); all else is (h, w). Depths are in units of
    the (first) surface's coordinates; values are NaN without a hit.

    A ray that runs out of steps is drawn magenta, and a warning says how many there were.

    Raises ValueError or TypeError before anything is drawn for an unknown setting, file type,
    mode or material, settings that make no surface, a surface without bounds, or a picture that
    does not fit into memory; OSError where the picture cannot be written.
    """
    target = None if path is None else check_picture_path(path)
    arguments = complete_options("render", keywords)
    client, checkpoint, progress = (arguments[k] for k in ("client", "checkpoint", "progress"))
    picture_options = RenderOptions.of(arguments)
    is_divided = client is not None or checkpoint is not None
    chunks = check_chunks(arguments["chunks"], is_divided=is_divided)
    # A missing package is reported before anything is drawn.
    if picture_options.denoise:
        load_denoiser()
    if target is not None and picture_options.color_bar and target.suffix.lower() == ".exr":
        raise ValueError(f"{target}: EXR files hold the numbers; a color bar is drawn in .png")
    shorthand = shorthand_among(arguments)
    # A Mitsuba scene has its own camera, materials and lights.
    if not _is_for_studio(surfaces):
        of_studio = {name: arguments[name] for name in STUDIO_OPTIONS}
        refuse_studio_options({**of_studio, **shorthand, "options": options})
    job = RenderJob(surfaces, picture_options, options, shorthand, register().variant())
    task = job.task
    if is_divided:
        _check_can_be_divided(surfaces, task)
    with open_executor(job, client, checkpoint, chunks) as workers:
        executor = Executor(task) if workers.is_local else replace(workers, decode=job.decode)
        title = arguments["color_by"]
        image, shown, names = _render_job(job, executor, title, progress, alone=client is None)
    if target is not None:
        exact = target.suffix.lower() == ".exr"
        write_image(job.mi, target, image if exact else shown, names)
    return Picture.of(image, shown)


def _render_job(
    job: RenderJob,
    executor: Executor,
    color_by: Any,
    progress: bool | ProgressFunction,
    *,
    alone: bool,
) -> tuple[Image, npt.NDArray[np.uint8], list[str] | None]:
    """Draw a picture. Returns its numbers, an array (h, w) or (h, w, n); its pixels, (h, w, 3 or 4)
    in 8-bit sRGB; and the names of the n channels, or None for the usual names.

    job: the scene, the options and the task of the picture.
    executor: calls the methods of the job's task, in this process or on a cluster.
    color_by: the option as the caller set it. If it is a text, it becomes the title of the color
        bar.
    progress: whether to show a progress bar, or a function that is called with a `Progress`.
    alone: whether this process draws everything. Only then is the time estimated before.
    """
    mi, options, task, sensor = job.mi, job.options, job.task, job.scene.sensors()[0]
    # A scene without level sets.
    if task is None:
        return _render_by_mitsuba(mi, job.scene, options)
    if isinstance(task, AovTask):
        # A progress bar is shown only if an executor divides the work.
        with show_progress("rendering", progress and not executor.is_local) as reporter:
            view = task.look(executor, reporter.advance)
        color_bar = (
            color_by
            if options.color_bar is True and isinstance(color_by, str)
            else options.color_bar
        )
        samples = options.spp or EDGE_SPP
        shown = aov_picture(
            options.show, task, view, options.color_range, color_bar, samples, executor
        )
        return AOV_MODES[options.show].numbers(view), shown, None
    if isinstance(task, PathRenderTask) and alone and progress:
        # A picture on a cluster is not estimated: the estimate measures this process.
        task = _with_time_estimate(job, task, progress)
        executor = Executor(task) if executor.is_local else executor
    with show_progress("rendering", progress) as reporter:
        if isinstance(task, ShadedTask):
            image, lost = render_shaded(task, executor, reporter.advance)
        else:
            paths = render_paths(task, reporter.advance, executor)
            image, lost = denoise_image(paths) if options.denoise else paths.image, paths.lost
    _warn_of(lost, _LIT[options.show])
    return *_composite_over_backdrop(mi, sensor, image, job.stage, options.show), None


def _with_time_estimate(
    job: RenderJob, task: PathRenderTask, progress: bool | ProgressFunction
) -> PathRenderTask:
    """Estimate how long the picture takes. Returns the task with the number of light paths traced
    at a time chosen such that a progress bar moves every few seconds. If the picture will take
    long, a line with the estimated time is printed to stderr.

    job: the scene and the options of the picture.
    task: follows the light paths of the picture.
    progress: whether the line may be printed; with a function, which receives the progress, it is
        not.
    """
    estimate = estimate_time(
        job.mi, job.scene, task.sensor, task.tracer, spp=task.spp,
        features=task.features,
    )  # fmt: skip
    if progress is True and estimate.picture > MIN_REPORTED_SECONDS:
        from rich.console import Console  # imported here: it takes time that few pictures need

        Console(stderr=True, highlight=False).print(
            f"this picture will take about {estimate}, with {task.spp} samples a pixel"
        )
    return replace(task, paths_a_band=estimate.paths_a_band)


def _is_for_studio(surfaces: Any) -> bool:
    """Return whether the first argument of `render` is drawn in the studio: a field, a surface, or
    a list of them. Otherwise it is a Mitsuba scene."""
    return isinstance(surfaces, Field | Surface | TracedSurface | list | tuple)


def _check_can_be_divided(surfaces: Any, task: Any) -> None:
    """Check that a picture can be divided into parts, which are drawn on a cluster or kept in a
    checkpoint.

    surfaces: the first argument of `render`.
    task: the task that draws the picture part by part; None if Mitsuba draws it.

    Raises:
        ValueError: Mitsuba's own integrator draws the scene, in one piece.
        TypeError: the scene is given as a loaded scene or a file, and only a dictionary can be
            sent.
    """
    if task is None:
        raise ValueError(
            "client, checkpoint: Mitsuba draws this scene, by an integrator of its own"
        )
    if not _is_for_studio(surfaces) and not isinstance(surfaces, Mapping):
        raise TypeError(
            "client, checkpoint: a loaded scene cannot be sent, and the files of one may change or "
            "be elsewhere: give the scene as a dictionary"
        )


def _render_by_mitsuba(
    mi: Any, scene: Any, options: RenderOptions
) -> tuple[Image, npt.NDArray[np.uint8], list[str]]:
    """Draw a scene without level sets by the integrator that the scene asks for. Returns the
    numbers (h, w, n) of all n channels, the 8-bit sRGB pixels of the color channels, and the names
    of all channels.

    Raises:
        ValueError: the options `max_depth` or `denoise` are set, which only the path tracer of this
            library honors.
    """
    for name, is_set in (
        ("max_depth", options.max_depth is not None),
        ("denoise", options.denoise),
    ):
        if is_set:
            raise ValueError(f"{name}: Mitsuba draws this scene, by an integrator of its own")
    # With 0 samples, Mitsuba takes the number of the scene.
    image = np.array(mi.render(scene, spp=options.spp or 0, seed=options.seed))
    # An integrator `aov` names each channel of its nested pictures (NAME.R, ...). These pictures
    # are also the first channels, so their names are left out here.
    names = [name for name in scene.integrator().aov_names() if name[-2:] not in _IN_AOV]
    color_count = image.shape[-1] - len(names)
    # A film has one (luminance), two, three or four color channels; further channels follow.
    names = [*{1: "Y", 2: "YA"}.get(color_count, "RGBA"[:color_count]), *names]
    return image, tone_map(image[..., :color_count] if color_count >= 3 else image[..., 0]), names


def _warn_of(lost: int, kind: str) -> None:
    """Warn that rays ran out of steps, if any did. lost: their number. kind: what to call them in
    the message, such as "light paths"."""
    if lost:
        warnings.warn(
            f"{lost} {kind} ran out of steps and are drawn magenta; raise max_steps", stacklevel=3
        )


def _composite_over_backdrop(
    mi: Any, sensor: Any, image: Image, stage: StudioScene | None, show: str
) -> tuple[Image, npt.NDArray[np.uint8]]:
    """Put the backdrop behind the surfaces of a rendered picture. Returns the picture as linear
    light (floating-point numbers) and as 8-bit sRGB pixels.

    sensor: Mitsuba's camera, with the film.
    image: (h, w, 4) linear sRGB light and the covered fraction of each pixel.
    stage: the studio; None for a Mitsuba scene, which has no backdrop.
    show: the kind of picture, "path" for path tracing or "shaded"; the ground backdrop needs it.

    Tone mapping compresses bright light in the pixels. A ground backdrop is tone mapped together
    with the surfaces; all other backdrops keep their colors.

    A Mitsuba scene is returned with the covered fraction if its film has alpha, else without it. A
    transparent picture is returned as it is.
    """
    if stage is None:
        has_alpha = mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha)
        image = image if has_alpha else np.ascontiguousarray(image[..., :3])
        return image, tone_map(image)
    if stage.backdrop is None:
        return image, tone_map(image)
    # The light is that of the whole pixel: what is not covered adds no light to it.
    light, uncovered = image[..., :3], 1 - image[..., 3:]
    if isinstance(stage.backdrop, GroundBackdrop):
        image = light + uncovered * studio_wall(mi, sensor, stage.backdrop, stage.azimuth, show)
        return image, tone_map(image)
    behind = backdrop_image(mi, stage.backdrop, (image.shape[1], image.shape[0]))
    return light + uncovered * behind, tone_map(image, behind)
