"""What a picture is drawn from, which can be sent to other processes to have parts drawn there."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from harnack.cluster.executor import Arrays, Crew
from harnack.fields import Field
from harnack.fields.field import instead_of_field
from harnack.rendering.aov_render import VIEWS, View, Viewer
from harnack.rendering.backdrops import Gradient
from harnack.rendering.light_paths import Exposing
from harnack.rendering.mitsuba import load_dictionary, load_scene_file, take_variant
from harnack.rendering.mitsuba_plugins import register, stand_in
from harnack.rendering.placed_surface import Placement
from harnack.rendering.render_options import Request, check_memory, check_spp
from harnack.rendering.shaded_render import Seen, Shading
from harnack.rendering.stage import STUDIO_SPP, Studio, studio
from harnack.rendering.studio_surfaces import studio_objects
from harnack.tracer import LevelSet

EDGE_SPP = 9
# Light paths that a worker follows at a time: some hundred bytes each, of what may be a small
# memory, and enough for all threads.
_PATHS_A_BAND = 2**18
_SIZE = (800, 600)
# Rays of a path, shadow rays included, about.
_RAYS_A_PATH = 3


@dataclass(frozen=True)
class PictureJob:
    """All that decides what is in a picture.

    what: fields or a Mitsuba scene, as `render` takes them. asked: how to draw them. settings: of
        the surfaces. variant: of Mitsuba.

    Methods that are named like those of a drawing draw a part and give plain arrays.
    """

    what: Any
    asked: Request
    settings: Mapping[str, Any]
    variant: str

    @property
    def mi(self) -> Any:
        """Mitsuba, in the variant and with our plug-ins."""
        take_variant(self.variant)
        return register()

    @functools.cached_property
    def stage(self) -> Studio | None:
        """The studio in which surfaces are drawn; None for a Mitsuba scene."""
        if not isinstance(self.what, Field | LevelSet | list | tuple):
            return None
        asked, size = self.asked, self.asked.size or _SIZE
        check_memory(asked.show, *size)
        on_stage = studio_objects(
            self.what, asked.material, self.settings, boundary=asked.boundary,
            boundary_material=asked.boundary_material, cut=asked.cut_material,
            isolines=asked.isolines, thickness=asked.thickness,
        )  # fmt: skip
        rays = size[0] * size[1]
        if asked.show not in (*VIEWS, "shaded"):
            rays *= _RAYS_A_PATH * (asked.spp or STUDIO_SPP)
        on_stage = [replace(one, surface=one.surface.for_rays(rays)) for one in on_stage]
        return studio(
            self.mi, on_stage, size=size, camera=asked.camera,
            backdrop=asked.backdrop, up="z" if asked.up is None else asked.up,
            bare=asked.show in VIEWS, traced_light=asked.show == "color",
        )  # fmt: skip

    @functools.cached_property
    def scene(self) -> Any:
        """The Mitsuba scene that is drawn."""
        if self.stage is not None:
            return self.mi.load_dict(self.stage.scene, parallel=False)
        scene = _loaded(self.mi, self.what, self.asked.size)
        check_memory(self.asked.show, *map(int, scene.sensors()[0].film().crop_size()))
        return scene

    @functools.cached_property
    def drawing(self) -> Viewer | Exposing | Shading | None:
        """What can be drawn pixel by pixel; None for a scene that Mitsuba draws."""
        mi, asked, stage = self.mi, self.asked, self.stage
        scene = self.scene
        sensor = scene.sensors()[0]
        if asked.show in VIEWS:
            placement = Placement.identity() if stage is None else stage.placement
            viewer = Viewer.of(mi, scene, sensor, placement, asked.of)
            if isinstance(asked.backdrop, Gradient):
                viewer = replace(viewer, background=asked.backdrop.bottom)
            return viewer
        if asked.show == "shaded":
            return Shading(
                mi, scene, sensor, spp=asked.spp or EDGE_SPP, cut_out=stage is not None,
                on_floor=stage is not None and stage.has_ground, cones=asked.antialias == "cones",
            )  # fmt: skip
        tracer = stand_in(mi, scene)
        if tracer is None:
            return None
        if asked.max_depth is not None:
            tracer = tracer.with_depth(asked.max_depth)
        spp = asked.spp or check_spp(
            int(sensor.sampler().sample_count()), source=", which the scene's sampler asks for"
        )
        return Exposing(mi, scene, sensor, tracer, spp, asked.seed, asked.denoise)

    def _drawing_here(self) -> Any:
        """The drawing, after a worker may have worked in another variant."""
        take_variant(self.variant)
        return self.drawing

    def pixels(self, start: int, stop: int) -> Arrays:
        """As of `Exposing`."""
        drawing = replace(cast("Exposing", self._drawing_here()), paths_a_band=_PATHS_A_BAND)
        return _with_lost(drawing.pixels(start, stop))

    def look(self, start: int, stop: int) -> Arrays:
        """As of `Shading`."""
        return cast("Shading", self._drawing_here()).look(start, stop).numbers()

    def refine(self, *part: Any) -> Arrays:
        """As of `Shading`."""
        return _with_lost(cast("Shading", self._drawing_here()).refine(*part))

    def view(self, start: int, stop: int) -> Arrays:
        """As of `Viewer`."""
        return _arrays_of(cast("Viewer", self._drawing_here()).view(start, stop))

    def look_again(self, *part: Any) -> Arrays:
        """As of `Viewer`."""
        return _arrays_of(cast("Viewer", self._drawing_here()).look_again(*part))


@dataclass(frozen=True)
class Elsewhere:
    """Hands that are a crew's: they call methods of a job and give what its drawing would."""

    crew: Crew
    job: PictureJob

    def cut(self, count: int, most: int) -> list[tuple[int, int]]:
        """As suits the crew."""
        return self.crew.cut(count, most)

    def each(self, step: str, parts: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """In order, several at the same time."""
        drawing = self.job.drawing
        for found in self.crew.each(self.job, step, parts):
            if isinstance(drawing, Viewer):
                period = None if drawing.function is None else drawing.function.period
                yield View(**found, period=period, background=drawing.background)
            elif step == "look":
                yield Seen.from_numbers(self.job.mi, found)
            else:
                yield found["means"], int(found["lost"])


def _with_lost(found: tuple[Any, int]) -> Arrays:
    return {"means": found[0], "lost": np.array(found[1])}


def _arrays_of(view: View) -> Arrays:
    return {name: one for name, one in vars(view).items() if isinstance(one, np.ndarray)}


def _loaded(mi: Any, what: Any, size: tuple[int, int] | None) -> Any:
    if isinstance(what, mi.Scene):
        if size is not None:
            raise ValueError("size: a loaded scene has its own; set film.size of its sensor")
        scene = what
    elif isinstance(what, Mapping):
        scene = load_dictionary(mi, cast("Mapping[str, Any]", what))
    elif isinstance(what, str | os.PathLike):
        scene = load_scene_file(mi, cast("str | os.PathLike[str]", what))
    else:
        raise TypeError(
            "draw a field, a LevelSet, a list of them, or a Mitsuba scene, its dictionary or the "
            f"path of its file, not what is {instead_of_field(what)}"
        )
    if not scene.sensors():
        raise ValueError("the scene has no sensor to look through")
    if size is not None:
        params = mi.traverse(scene.sensors()[0])
        params["film.size"] = size
        params.update()
    return scene
