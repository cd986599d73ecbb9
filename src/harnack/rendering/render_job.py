"""The job of a picture. It can be sent to other processes, which draw parts of the picture."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from harnack.cluster.executor import Executor, TaskResult
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
    """Everything that determines a picture.

    surfaces: the first argument of `render`: fields or surfaces, or a Mitsuba scene.
    options: the options of the picture.
    trace_options: the `TraceOptions` of all surfaces, or None.
    shorthand: options of surfaces and traces that were set by keywords, by name.
    variant: the Mitsuba variant.

    A picture is drawn by a task: an `AovTask`, a `PathRenderTask` or a `ShadedTask`. The methods
        here that are named like methods of a task call these, and return plain arrays.
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
        on_stage = studio_objects(
            self.surfaces, options.material, self.trace_options, self.shorthand,
            boundary_radius=options.boundary_radius, boundary_material=options.boundary_material,
            section_material=options.section_material, isolines=options.isolines,
            thickness=options.thickness,
        )  # fmt: skip
        rays = size[0] * size[1]
        if options.show not in (*AOV_MODES, "shaded"):
            rays *= _RAYS_A_PATH * (options.spp or STUDIO_SPP)
        on_stage = [
            replace(element, surface=element.surface.for_rays(rays)) for element in on_stage
        ]
        return build_studio(
            self.mi, on_stage, size=size, camera=options.camera,
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
        """The task that draws the picture, and can draw it part by part; None for a scene that
        Mitsuba's own integrator draws."""
        mi, options, stage = self.mi, self.options, self.stage
        scene = self.scene
        sensor = scene.sensors()[0]
        if options.show in AOV_MODES:
            placement = Placement.identity() if stage is None else stage.placement
            viewer = AovTask.of(mi, scene, sensor, placement, options.color_by)
            if isinstance(options.backdrop, GradientBackdrop):
                viewer = replace(viewer, background=options.backdrop.bottom)
            return viewer
        if options.show == "shaded":
            return ShadedTask(
                mi, scene, sensor, spp=options.spp or EDGE_SPP, cut_out=stage is not None,
                on_floor=stage is not None and stage.has_ground, cones=options.antialias == "cones",
            )  # fmt: skip
        tracer = equivalent_path_tracer(mi, scene)
        if tracer is None:
            return None
        if options.max_depth is not None:
            tracer = tracer.with_depth(options.max_depth)
        spp = options.spp or check_spp(
            int(sensor.sampler().sample_count()), source=", which the scene's sampler asks for"
        )
        return PathRenderTask(mi, scene, sensor, tracer, spp, options.seed, options.denoise)

    def _task_in_variant(self) -> Any:
        """The task, after the Mitsuba variant was set again: a worker may have worked in another
        one."""
        set_variant(self.variant)
        return self.task

    def render_range(self, start: int, stop: int) -> TaskResult:
        """The result of `render_range` of the task, an `AovTask` or a `PathRenderTask`, for pixels
        from `start` to `stop`, as arrays by name."""
        task = self._task_in_variant()
        if isinstance(task, AovTask):
            return _arrays_of(task.render_range(start, stop))
        task = replace(cast("PathRenderTask", task), paths_a_band=_PATHS_A_BAND)
        return _with_lost(task.render_range(start, stop))

    def render_samples(self, *part: Any) -> TaskResult:
        """The result of `AovTask.render_samples` as arrays by name. part: its arguments."""
        return _arrays_of(cast("AovTask", self._task_in_variant()).render_samples(*part))

    def render_gbuffer(self, start: int, stop: int) -> TaskResult:
        """The result of `ShadedTask.render_gbuffer`, the first hits of a range of pixels, as arrays
        by name."""
        return cast("ShadedTask", self._task_in_variant()).render_gbuffer(start, stop).to_numpy()

    def refine_pixels(self, *part: Any) -> TaskResult:
        """The result of `ShadedTask.refine_pixels`, the means of samples in pixels, as arrays by
        name. part: its arguments."""
        return _with_lost(cast("ShadedTask", self._task_in_variant()).refine_pixels(*part))


@dataclass(frozen=True)
class ClusterRenderExecutor:
    """Runs the tasks of a picture on a cluster, whose workers call the methods of a `RenderJob`.
    The results are those that the task itself would return."""

    executor: Executor
    job: RenderJob

    def split_range(self, count: int, max_size: int) -> list[tuple[int, int]]:
        """Ranges (start, stop) of at most `max_size` elements that cover range(count), as many as
        suit the workers."""
        return self.executor.split_range(count, max_size)

    def run_tasks(self, step: str, parts: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """The results, in order, of calls of the method named `step`; several calls run at the same
        time. Each entry of `parts` holds the arguments of one call."""
        task = self.job.task
        for arrays in self.executor.run_tasks(self.job, step, parts):
            if isinstance(task, AovTask):
                period = None if task.function is None else task.function.period
                yield AovBuffers(**arrays, period=period, background=task.background)
            elif step == "render_gbuffer":
                yield GBuffer.from_numbers(self.job.mi, arrays)
            else:
                yield arrays["means"], int(arrays["lost"])


def _with_lost(result: tuple[Any, int]) -> TaskResult:
    """A mean color and a number of rays out of steps, as arrays by name."""
    return {"means": result[0], "lost": np.array(result[1])}


def _arrays_of(view: AovBuffers) -> TaskResult:
    """The arrays of an `AovBuffers`, by name."""
    return {name: array for name, array in vars(view).items() if isinstance(array, np.ndarray)}


def _loaded(mi: Any, source: Any, size: tuple[int, int] | None) -> Any:
    """The Mitsuba scene of a loaded scene, a dictionary, or the path of an XML file, with a film of
    `size` (width, height) pixels unless that is None. Raises TypeError or ValueError for anything
    else."""
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
        params = mi.traverse(scene.sensors()[0])
        params["film.size"] = size
        params.update()
    return scene
