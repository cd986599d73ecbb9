"""The job of a picture: everything that determines it, in an object that can be sent to other
processes, which draw parts of the picture. A task is the object that draws any part of one picture:
an `AovTask`, a `PathRenderTask` or a `ShadedTask`. A picture is drawn in the studio, a stage for
fields and surfaces, or it is of a Mitsuba scene."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from harnack.cluster.executor import TaskResult
from harnack.fields import Field
from harnack.fields.field import suggest_field
from harnack.rendering.aov_render import AOV_MODES, AovBuffers, AovTask
from harnack.rendering.backdrops import GradientBackdrop
from harnack.rendering.light_paths import PathRenderTask
from harnack.rendering.mitsuba import load_dict, load_scene_file, set_variant
from harnack.rendering.mitsuba_plugins import equivalent_path_tracer, register
from harnack.rendering.option_table import RenderOptions
from harnack.rendering.placed_surface import Placement
from harnack.rendering.render_options import check_memory, check_spp
from harnack.rendering.shaded_render import GBuffer, ShadedTask
from harnack.rendering.stage import STUDIO_SPP, StudioScene, build_studio
from harnack.rendering.studio_surfaces import studio_objects
from harnack.tracer import Surface, TracedSurface, TraceOptions

EDGE_SPP = 9
# The number of light paths that a worker follows at a time. A path takes a few hundred bytes, and a
# worker's memory may be small; the number is enough for all threads.
_PATHS_A_BAND = 2**18
DEFAULT_SIZE = (800, 600)
# The approximate number of rays of a path, including shadow rays.
_RAYS_A_PATH = 3


@dataclass(frozen=True)
class RenderJob:
    """Everything that determines a picture. It makes the scene and the task that draws the picture,
    and other processes can make the same ones from a copy of it.

    surfaces: the first argument of `render`: fields or surfaces, or a Mitsuba scene.
    options: the options of the picture.
    trace_options: the `TraceOptions` of all surfaces, or None.
    shorthand: options of surfaces and traces that were set by keywords, by name.
    variant: the Mitsuba variant.

    The task is an `AovTask`, a `PathRenderTask` or a `ShadedTask`. Each of the methods
    `render_range`, `render_samples`, `render_gbuffer` and `refine_pixels` calls the method of the
    task that has the same name, and returns its result as plain arrays by name.
    """

    surfaces: Any
    options: RenderOptions
    trace_options: TraceOptions | None
    shorthand: Mapping[str, Any]
    variant: str

    @property
    def mi(self) -> Any:
        """The module `mitsuba`, in the variant of this job and with the plug-ins of harnack."""
        set_variant(self.variant)
        return register()

    @functools.cached_property
    def stage(self) -> StudioScene | None:
        """The studio in which surfaces are drawn; None for a Mitsuba scene."""
        if not isinstance(self.surfaces, Field | Surface | TracedSurface | list | tuple):
            return None
        options, size = self.options, self.options.size or DEFAULT_SIZE
        check_memory(options.show, *size)
        objects = studio_objects(
            self.surfaces, options.material, self.trace_options, self.shorthand,
            boundary_radius=options.boundary_radius, boundary_material=options.boundary_material,
            section_material=options.section_material, isolines=options.isolines,
            thickness=options.thickness,
        )  # fmt: skip
        # Fields make a longer preparation if many rays are to be traced.
        ray_count = size[0] * size[1]
        if options.show not in (*AOV_MODES, "shaded"):
            ray_count *= _RAYS_A_PATH * (options.spp or STUDIO_SPP)
        objects = [
            replace(element, surface=element.surface.for_rays(ray_count)) for element in objects
        ]
        return build_studio(
            self.mi, objects, size=size, camera=options.camera,
            backdrop=options.backdrop, up="z" if options.up is None else options.up,
            surfaces_only=options.show in AOV_MODES, traced_light=options.show == "path",
        )  # fmt: skip

    @functools.cached_property
    def scene(self) -> Any:
        """The Mitsuba scene that is drawn."""
        if self.stage is not None:
            return self.mi.load_dict(self.stage.scene, parallel=False)
        scene = _loaded(self.mi, self.surfaces, self.options.size)
        check_memory(self.options.show, *map(int, scene.sensors()[0].film().crop_size()))
        return scene

    @functools.cached_property
    def task(self) -> AovTask | PathRenderTask | ShadedTask | None:
        """The task, which draws the picture part by part; None for a scene that Mitsuba's own
        integrator draws."""
        mi, options, stage = self.mi, self.options, self.stage
        scene = self.scene
        sensor = scene.sensors()[0]
        if options.show in AOV_MODES:
            placement = Placement.identity() if stage is None else stage.placement
            aov_task = AovTask.of(mi, scene, sensor, placement, options.color_by)
            # Of pictures of numbers, the bottom and the top of the backdrop have the same color.
            if isinstance(options.backdrop, GradientBackdrop):
                aov_task = replace(aov_task, background=options.backdrop.bottom)
            return aov_task
        if options.show == "shaded":
            # In the studio, the backdrop is added to the picture afterwards: it is cut out.
            return ShadedTask(
                mi, scene, sensor, spp=options.spp or EDGE_SPP, cut_out=stage is not None,
                on_floor=stage is not None and stage.has_ground, cones=options.antialias == "cones",
            )  # fmt: skip
        # Path tracing, with the settings of the scene's integrator.
        tracer = equivalent_path_tracer(mi, scene)
        if tracer is None:
            return None
        if options.max_depth is not None:
            tracer = tracer.with_depth(options.max_depth)
        spp = options.spp or check_spp(
            int(sensor.sampler().sample_count()), source=", which the scene's sampler asks for"
        )
        # The denoiser needs the features, albedo and normal, at first hits.
        return PathRenderTask(mi, scene, sensor, tracer, spp, options.seed, options.denoise)

    def _task_in_variant(self) -> Any:
        """Set the Mitsuba variant of this job and return the task. A process may have drawn in
        another variant meanwhile."""
        set_variant(self.variant)
        return self.task

    def render_range(self, start: int, stop: int) -> TaskResult:
        """Draw the pixels from `start` to `stop` by `render_range` of the task, an `AovTask` or a
        `PathRenderTask`. Returns its result as arrays by name."""
        task = self._task_in_variant()
        if isinstance(task, AovTask):
            return _arrays_of(task.render_range(start, stop))
        task = replace(cast("PathRenderTask", task), paths_a_band=_PATHS_A_BAND)
        return _with_lost(task.render_range(start, stop))

    def render_samples(self, *part: Any) -> TaskResult:
        """Call `AovTask.render_samples`. Returns its result as arrays by name. part: its
        arguments."""
        return _arrays_of(cast("AovTask", self._task_in_variant()).render_samples(*part))

    def render_gbuffer(self, start: int, stop: int) -> TaskResult:
        """Call `ShadedTask.render_gbuffer`, which finds the first hits in the pixels from `start`
        to `stop`. Returns its result as arrays by name."""
        return cast("ShadedTask", self._task_in_variant()).render_gbuffer(start, stop).to_numpy()

    def refine_pixels(self, *part: Any) -> TaskResult:
        """Call `ShadedTask.refine_pixels`, which averages samples in pixels. Returns its result as
        arrays by name. part: its arguments."""
        return _with_lost(cast("ShadedTask", self._task_in_variant()).refine_pixels(*part))

    def decode(self, step: str, arrays: TaskResult) -> Any:
        """Turn the arrays by name that the method `step` of this job returned into what the method
        of the task returns."""
        if isinstance(self.task, AovTask):
            period = None if self.task.function is None else self.task.function.period
            return AovBuffers(**cast("Any", arrays), period=period, background=self.task.background)
        if step == "render_gbuffer":
            return GBuffer.from_numbers(self.mi, arrays)
        return arrays["means"], int(arrays["lost"])


def _with_lost(result: tuple[Any, int]) -> TaskResult:
    """Return a result of `render_range` or `refine_pixels`, means of colors and the number of rays
    that ran out of steps, as arrays by name."""
    return {"means": result[0], "lost": np.array(result[1])}


def _arrays_of(view: AovBuffers) -> TaskResult:
    """Return the arrays of an `AovBuffers`, by name."""
    return {name: array for name, array in vars(view).items() if isinstance(array, np.ndarray)}


def _loaded(mi: Any, source: Any, size: tuple[int, int] | None) -> Any:
    """Load the Mitsuba scene that is the first argument of `render`.

    source: a loaded scene, a dictionary, or the path of an XML file.
    size: (width, height) that the film gets, in pixels; None to keep its size.

    Raises:
        TypeError: another argument.
        ValueError: the scene has no sensor, or a size is given for a loaded scene.
    """
    if isinstance(source, mi.Scene):
        if size is not None:
            raise ValueError("size: a loaded scene has its own; set film.size of its sensor")
        scene = source
    elif isinstance(source, Mapping):
        scene = load_dict(mi, cast("Mapping[str, Any]", source))
    elif isinstance(source, str | os.PathLike):
        scene = load_scene_file(mi, cast("str | os.PathLike[str]", source))
    else:
        raise TypeError(
            "draw a field, a Surface, a list of them, or a Mitsuba scene, its dictionary or the "
            f"path of its file, not what is {suggest_field(source)}"
        )
    if not scene.sensors():
        raise ValueError("the scene has no sensor to look through")
    if size is not None:
        # Mitsuba changes the size of a film that is loaded already.
        scene_parameters = mi.traverse(scene.sensors()[0])
        scene_parameters["film.size"] = size
        scene_parameters.update()
    return scene
