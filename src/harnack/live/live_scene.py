"""Live scenes: surfaces on the stage, as data that `renderer.js` draws in a browser. The stage is
the scaled world in which surfaces stand on a floor. A person changes a scene by its controls:
sliders, the vertices of a curve, a cut, and settings such as the material. A state is the data of
all surfaces for given controls.

Each surface has a shader, a kernel translated from Dr.Jit's recording, and the 32-bit words that
the shader reads. All data is plain: numbers, lists, text, and arrays of words that `encode_arrays`
turns into text.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_vector3
from harnack.fields import Solid
from harnack.fields.solid_angles.solid_angle import SolidAngle
from harnack.geometry import HalfSpace, Volume, VolumeIntersection
from harnack.live.legend_data import EVALUATIONS_TOP, legends
from harnack.live.live_framing import Framing, extreme_points
from harnack.live.scene_file import FieldSources, to_scene_text, with_flat_options
from harnack.live.shading_data import scene_shading
from harnack.live.sliders import SliderValueError, SlidingContent, slider_values_in_errors
from harnack.rendering import render
from harnack.rendering.backdrops import FLOOR_HEIGHT, GroundBackdrop, parse_backdrop
from harnack.rendering.camera import Camera
from harnack.rendering.framing import NothingVisibleError, bounding_box, visible_points
from harnack.rendering.isolines import parse_isolines
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.option_table import (
    LIVE_MODES,
    names_of,
    refuse_others,
    refuse_unknown,
    shorthand_among,
)
from harnack.rendering.placed_surface import PlacedSurface
from harnack.rendering.render_options import check_camera
from harnack.rendering.scales import linear_from_srgb
from harnack.rendering.shading import hole_filling_tint, reflectance, two_sided_color
from harnack.rendering.stage import MATERIALS, Material, StudioObject
from harnack.rendering.studio_surfaces import studio_objects, with_visible_inside
from harnack.tracer import HitTolerance, RayStatus, Surface, TracedSurface
from harnack.tracer.trace_options import SURFACE_OPTIONS
from harnack.webgpu import as_words, labeled_leaves, pack_shader_data, record_kernel

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real, Vec3
    from harnack.rendering.images import Picture
    from harnack.rendering.placed_surface import Placement
    from harnack.rendering.surface_hits import SurfaceHit
    from harnack.webgpu import RecordedKernel

__all__ = [
    "LIVE_MODES",
    "LIVE_OPTIONS",
    "ControlState",
    "JsonDict",
    "LiveScene",
    "check_opaque",
    "color_index",
    "encode_arrays",
    "live_options",
    "state_delta",
    "status_of",
    "surface_colors",
]

JsonDict = dict[str, Any]
# Rays that travel with a surface, and are traced first on the visitor's device.
_RAYS = 2048
# Of surfaces without a tolerance of their own, on the stage.
_TOLERANCE = 1e-4
_LANES = ("o 0", "o 1", "o 2", "d 0", "d 1", "d 2", "far")
_RESULTS = ("status", "t", "normal 0", "normal 1", "normal 2", "evaluations", "paint")
# The place of a result that no shader writes, because it is 0 for all rays.
_NO_OUTPUT = 99
# Paints of a surface: the first is its own, then those of hole fillings and of faces on a section,
# then those of isolines.
_MENDED, _CUT = 1, 2
# `MAX_SURFACE_COLORS` in renderer.js.
_MOST_PAINTS = 2048
_OF_STUDIO = ("boundary_radius", "boundary_material", "section_material", "thickness")
# Of gzip: more takes longer, and gains little.
_LEVEL = 5
_STAGE_OPTIONS = ("camera", "backdrop", "up", "show")
STILL_OPTIONS = (
    "size", "spp", *names_of("render", "color", "quality", "run"),
)  # fmt: skip
"""Options that `render` has for still pictures alone."""


LIVE_OPTIONS = ("material", "boundary_radius")
"""Options that can be changed in a view: what surfaces are made of, and the radius of
tubes around the curves at which they end (None for no tubes)."""


@dataclass(frozen=True)
class ControlState:
    """The state of the controls of a live scene: its sliders, its edited curve, its cut and its
    settings.

    values: the values of all sliders by name.
    curves: vertices (n, 3) of each loop of the editable curve, in place of the field's own; None if
        nobody has edited the curve.
    cut_volume: a volume by which all surfaces are cut, as well as by their own volumes. A
        half-space is used as the option `section` of `harnack.Surface`, so that one looks inside;
        any other volume as its option `clip`, so that only the part inside of the volume is kept.
        None for no cut.
    settings: values of some of the options `LIVE_OPTIONS`, in place of those that the scene was
        opened with.
    """

    values: Mapping[str, float]
    curves: Sequence[FloatArray] | None = None
    cut_volume: Volume | None = None
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class LiveScene:
    """Surfaces that a person can turn, cut, and change by sliders in a browser: what they are as
    functions of the sliders, where they stand on the stage (the scaled world, with a floor), and
    how they are shown. A `ControlState` holds the positions of all sliders and other controls; for
    each of them `state` returns the surfaces as data.

    content: the surfaces and options as functions of the sliders.
    points: visible points (n, 3) of each surface at the start, in the surfaces' coordinates.
    camera, up: the options of `render` by these names.
    framing: the placement on the stage, and the camera that is shown at first.
    backdrop: "light" or "dark", the kind of ground.
    editable: whether a person can move the vertices of the curve of the scene's `SolidAngle`.
    show: the kind of picture shown at first, one of `LIVE_MODES`.
    sources: pairs of a field and its description in scene files, for fields from files or the
        gallery.
    """

    content: SlidingContent
    points: tuple[FloatArray, ...]
    camera: Camera
    up: Any
    framing: Framing
    backdrop: str
    editable: bool
    show: str
    sources: FieldSources = ()

    @classmethod
    def of(
        cls, surfaces: Any, options: Mapping[str, Any], *, edits: bool = False,
        sources: FieldSources = (),
    ) -> LiveScene:  # fmt: skip
        """Make the live scene from the arguments of `page` or `view`.

        surfaces: a field, a `Surface`, a list of them, or a function of sliders that returns them.
        options: options of `view` by name; values may be sliders or functions of sliders.
        edits: whether vertices of curves can be edited. If so, the recorded kernel reads the
            vertices as data, so that it serves all their positions.
        sources: pairs of a field and its description in scene files.

        Raises:
            TypeError, ValueError: the errors of `render` for its options; also for a transparent
                material, a `show` that is not in `LIVE_MODES`, and a backdrop that is not "light"
                or "dark".
        """
        refuse_others("view", options)
        options = with_flat_options(options)
        camera, backdrop, up, show = (options.pop(name, None) for name in _STAGE_OPTIONS)
        show = "shaded" if show is None else show
        if show not in LIVE_MODES:
            raise ValueError(
                f"show must be one of {', '.join(LIVE_MODES)} where it moves, not {show!r}"
            )
        ground = GroundBackdrop("light") if backdrop is None else parse_backdrop(backdrop)
        if not isinstance(ground, GroundBackdrop):
            raise ValueError('backdrop: what is drawn live stands on a ground: "light" or "dark"')
        content = SlidingContent.of(surfaces, options)
        start_values = content.starts
        # Points of the surfaces at the start: the scene is placed and framed by them.
        with slider_values_in_errors(start_values):
            objects = _objects_at(content, start_values)
            backend = choose_backend("single")
            points = tuple(visible_points(body.surface, backend) for body in objects)
        curve = _curve_of(objects) if edits else None
        up, camera = "z" if up is None else up, check_camera(camera)
        framing = Framing.of(camera, up, np.concatenate(points), is_whole=True)
        return cls(
            content, points, camera, up, framing, ground.name, curve is not None, show, sources
        )

    def framed(self, places: Iterable[Mapping[str, float]]) -> LiveScene:
        """Return this scene with a placement and a camera such that the surfaces stay in the
        picture for many slider values. A scene without sliders, or whose camera has a box, is
        returned unchanged.

        places: the slider values, each a mapping from slider names to values.

        Slider values for which nothing can be drawn are left out here. The error is reported when
        the surfaces are drawn at these values.
        """
        if not self.content.sliders or self.camera.box is not None:
            return self
        backend = choose_backend("single")
        points = [*self.points]
        for values in places:
            # Errors at these values become SliderValueErrors, which are ignored here.
            with suppress(SliderValueError), slider_values_in_errors(values):
                for body in _objects_at(self.content, values):
                    with suppress(NothingVisibleError):
                        points.append(extreme_points(visible_points(body.surface, backend)))
        # The points are not those of the surfaces at the start alone, so `is_whole` is False.
        framing = Framing.of(self.camera, self.up, np.concatenate(points), is_whole=False)
        return replace(self, framing=framing)

    @property
    def placement(self) -> Placement:
        """The similarity that maps coordinates of the surfaces to coordinates of the stage."""
        return self.framing.placement

    @cached_property
    def rays(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Test rays, a pair for each surface: origins and unit directions, both (2048, 3), in stage
        coordinates. A browser traces them and compares its results with Dr.Jit's."""
        return tuple(_rays(self.placement.apply(points)) for points in self.points)

    def scene(self, title: str) -> JsonDict:
        """Return all data that a page needs when it opens, as JSON data for `renderer.js`:
        placement, camera, sliders, legends and the initial state. title: of the page."""
        place, points = self.placement, np.concatenate(self.points)
        _, settings = self._at(self.initial_controls)
        material = settings.get("material")
        # The ball around what is seen at first, by which cuts are measured.
        middle: FloatArray = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return {
            "title": title,
            "placement": [*place.rotation.ravel().tolist(), *place.translation.tolist(),
                          place.scale],
            "camera": self.framing.camera,
            "floor": FLOOR_HEIGHT,
            "show": self.show,
            "ground": self.backdrop,
            "shading": scene_shading(),
            "sliders": [
                {"name": name, "low": slider.low, "high": slider.high, "start": slider.start,
                 "step": slider.step}
                for name, slider in self.content.sliders.items()
            ],
            "editable": self.editable,
            "materials": [name for name, material in MATERIALS.items() if not material.transparent],
            "material": material if isinstance(material, str) else None,
            "tube": None if (tube := settings.get("boundary_radius")) is None else float(tube),
            "middle": middle.tolist(),
            "reach": float(np.linalg.norm(points - middle, axis=1).max()),
            "legends": legends(),
            "evaluations_top": EVALUATIONS_TOP,
            "state": encode_arrays(self.initial_state),
        }  # fmt: skip

    @cached_property
    def initial_state(self) -> JsonDict:
        """The state (as `state` returns it) at the start values of all sliders. Later states are
        sent as differences from it."""
        return self.state(self.initial_controls)

    @property
    def pose(self) -> JsonDict:
        """The first camera as {"position": (3,), "target": (3,), "fov": degrees}, in the surfaces'
        coordinates."""
        orbit, placement = self.framing.camera, self.placement
        azimuth, elevation = np.radians([orbit["azimuth"], orbit["elevation"]])
        # The unit vector (cos e cos a, cos e sin a, sin e) from the target to the camera.
        to_camera = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)]) * np.cos(
            elevation
        )
        target = np.array(orbit["target"])
        eye, target_point = placement.apply_inverse(
            np.stack([target + orbit["distance"] * to_camera, target])
        )
        return {"position": eye.tolist(), "target": target_point.tolist(), "fov": orbit["fov"]}

    @property
    def initial_controls(self) -> ControlState:
        """The controls at the start: sliders at their start values, no edited curve, no cut."""
        return ControlState(self.content.starts)

    def state(self, controls: ControlState) -> JsonDict:
        """Return the surfaces for a state of the controls as data. "surfaces" holds a dictionary
        for each surface, as `_kernel_data` returns it. "curves" holds a list of points for each
        loop of the curves at which the surfaces end. Arrays of words are NumPy's; `encode_arrays`
        turns them into text.

        Raises:
            ValueError: the surfaces and isolines have more colors than the browser's table can
                hold.
            SliderValueError: nothing can be drawn at these slider values.
        """
        objects = self.surfaces_at(controls)
        with slider_values_in_errors(controls.values):
            placed = [self.place(body) for body in objects]
        # A state may have more surfaces than the start, whose test rays are used: further surfaces
        # take those of the last one.
        surfaces = [
            _kernel_data(body, placed_surface, *self.rays[min(k, len(self.rays) - 1)])
            for k, (body, placed_surface) in enumerate(zip(objects, placed, strict=True))
        ]
        colors = sum(len(surface["paints"]) for surface in surfaces)
        if colors > _MOST_PAINTS:
            raise ValueError(
                f"the surfaces and their isolines have {colors:,} colors, and what moves is drawn "
                f"with {_MOST_PAINTS:,} at most: draw fewer surfaces at once"
            )
        # The curves at which surfaces end, each field's once.
        curves: list[Any] = []
        for k, body in enumerate(objects):
            # Surfaces of the same field have the same curves.
            if all(body.surface.field is not other.surface.field for other in objects[:k]):
                boundary = body.surface.field.boundary
                curves += () if boundary is None else boundary.curves
        return {"surfaces": surfaces, "curves": [np.asarray(curve).tolist() for curve in curves]}

    def surfaces_at(self, controls: ControlState) -> list[StudioObject]:
        """Return the surfaces for a state of the controls, as objects of the studio (surface,
        material and isolines).

        Raises:
            SliderValueError: they cannot be made at these slider values.
        """
        with slider_values_in_errors(controls.values):
            return self._drawn(controls)

    def _at(self, controls: ControlState) -> tuple[Any, dict[str, Any]]:
        """Return the surfaces, and the options of `view` by name, for a state of the controls.
        Options that a person changed (`controls.settings`) replace those of the scene. If the tubes
        around curves were switched off, their material is dropped too."""
        content, settings = self.content.at(controls.values)
        settings |= controls.settings
        if "boundary_radius" in controls.settings and settings["boundary_radius"] is None:
            settings.pop("boundary_material", None)
        return content, settings

    def _drawn(self, controls: ControlState) -> list[StudioObject]:
        """Return the surfaces for a state of the controls as objects of the studio: with
        tolerances, cut by the volume of the controls, and with the edited curve in place of the
        field's own."""
        content, settings = self._at(controls)
        objects = _studio_objects(content, settings)
        curve = _curve_of(objects) if self.editable else None
        if (
            curve is not None
            and controls.curves is not None
            and settings.get("boundary_radius") is not None
        ):
            # The tube around the curve has to follow the edited curve.
            objects = _studio_objects(_with_loops(content, curve, controls.curves), settings)
            curve = _curve_of(objects)
        # Each surface gets a hit tolerance that fits the stage.
        objects = [self._fitted(body) for body in objects]
        if controls.cut_volume is not None:
            objects = [
                replace(body, surface=with_cut(body.surface, controls.cut_volume))
                for body in objects
            ]
        if curve is None:
            return objects
        # Vertices are passed as Dr.Jit arrays. With NumPy arrays the field would choose its proofs
        # by their numbers, and after an edit other kernels would have to be compiled.
        backend = choose_backend("single")
        loops = curve.loops if controls.curves is None else controls.curves
        field = SolidAngle([to_vector3(backend, loop) for loop in loops])
        # A copy shares the cache of its original, which holds data of the old field; `begins` gives
        # it an empty one.
        return [
            replace(body, surface=replace(body.surface, field=field).with_call_cache(begins=True))
            if body.surface.field is curve
            else body
            for body in objects
        ]

    def render_still(self, controls: ControlState, **options: Any) -> Picture:
        """Draw a still picture of a state of the controls by `render`. options: options of `render`
        that replace those of the scene."""
        _, settings = self._at(controls)
        scene_options = {
            name: settings[name] for name in ("isolines", "section_material") if name in settings
        }
        objects = self.surfaces_at(controls)
        if isinstance(options.get("camera"), Camera):
            options["camera"] = self.framing.with_box(options["camera"])
        defaults: dict[str, Any] = {"backdrop": self.backdrop, "up": self.up, "progress": False}
        materials = [body.material for body in objects]
        return render(
            [body.surface for body in objects],
            material=materials,
            **{**defaults, **scene_options, **options},
        )

    def to_scene_text(self, controls: ControlState, **options: Any) -> tuple[str, list[str]]:
        """Write a state of the controls as the text of a scene file. Returns the text, and the
        names of the sliders that it has lost. A slider is lost if a Python function depends on it;
        the text then holds the result of the function at the slider's value.

        options: more options of `render` to be written.

        Raises:
            SceneFileError: the content cannot be written as text, for example a field made in
                Python.
        """
        if isinstance(options.get("camera"), Camera):
            options["camera"] = self.framing.with_box(options["camera"])
        content, settings = self._at(controls)
        surfaces: list[Any] = [*content] if isinstance(content, list | tuple) else [content]
        curve = _curve_of(_studio_objects(content, settings)) if controls.curves else None
        # An edited curve is written in place of the field's own.
        if curve is not None:
            surfaces = _with_loops(content, curve, controls.curves)
        if controls.cut_volume is not None:
            surfaces, settings = _with_cut_options(surfaces, settings, controls.cut_volume)
        lost_sliders: list[str] = []
        for name, slider in self.content.sliders.items():
            if (
                self.content.settings.get(name) is slider and name not in controls.settings
            ):  # the slider is itself the value of an option
                settings[name] = replace(slider, start=controls.values[name])
            else:
                lost_sliders.append(name)
        return to_scene_text(surfaces, {**settings, **options}, self.sources), lost_sliders

    def _fitted(self, body: StudioObject) -> StudioObject:
        """Return the object `body` with a hit tolerance for its surface: its own or, if it has
        none, 1e-4 in units of the stage."""
        if body.surface.tolerance is not None:
            return body
        tolerance = HitTolerance(_TOLERANCE / self.placement.scale)
        return replace(body, surface=replace(body.surface, tolerance=tolerance))

    def place(self, body: StudioObject) -> PlacedSurface:
        """Return the surface of the object `body`, moved to the stage and prepared for tracing in
        single precision."""
        size = float(np.linalg.norm(np.diff(bounding_box(body.surface), axis=0)))
        backend = choose_backend("single")
        return PlacedSurface.of(body.surface, self.placement, backend, body.isolines, size)


def live_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options among `settings` that pages and views take. Options for still pictures
    alone, such as a size, are left out, and "shaded" replaces a `show` that is not in
    `LIVE_MODES`."""
    options = {name: value for name, value in settings.items() if name not in STILL_OPTIONS}
    return {**options, "show": options["show"] if options.get("show") in LIVE_MODES else "shaded"}


def with_cut(surface: TracedSurface, volume: Volume) -> TracedSurface:
    """Return the surface, cut by one more volume. A half-space becomes part of the surface's
    `section`, so that one looks inside; any other volume becomes part of its `clip`, outside of
    which nothing is drawn."""
    name = _cut_option(volume)
    combined = _overlap(getattr(surface, name), volume)
    cut_surface = replace(surface, **cast("Any", {name: combined})).with_call_cache(begins=True)
    return cut_surface if name == "clip" else with_visible_inside(cut_surface)


def _with_cut_options(
    surfaces: list[Any], settings: dict[str, Any], volume: Volume
) -> tuple[list[Any], dict[str, Any]]:
    """Cut surfaces by one more volume. Returns the surfaces and the options of the scene.

    settings: the options by name; values may be sliders.

    If keywords of `Surface`, such as a level, are among the options, the volume becomes part of the
    option `section` or `clip`; otherwise it becomes part of each surface.
    """
    name = _cut_option(volume)
    if any(option in SURFACE_OPTIONS for option in settings):
        return surfaces, {**settings, name: _overlap(settings.get(name), volume)}
    as_surfaces = [
        surface if isinstance(surface, Surface) else Surface(surface) for surface in surfaces
    ]
    return [
        surface.replace(**{name: _overlap(getattr(surface, name), volume)})
        for surface in as_surfaces
    ], settings


def _cut_option(volume: Volume) -> str:
    """Return the name of the keyword of `Surface` that takes the volume: "section" for a
    half-space, otherwise "clip"."""
    return "section" if isinstance(volume, HalfSpace) else "clip"


def _overlap(previous: Volume | None, volume: Volume) -> Volume:
    """Return the intersection of two volumes; `previous` = None stands for all of space."""
    return volume if previous is None else VolumeIntersection((previous, volume))


def _with_loops(content: Any, curve: SolidAngle, loops: Any) -> list[Any]:
    """Return the surfaces of `content` as a list, with the field `curve` replaced by the solid
    angle of an edited curve.

    content: a field, a `Surface`, or a list of them.
    loops: the edited curve, an array of vertices (n, 3) for each loop.
    """
    moved = SolidAngle([*loops])

    def edited(surface: Any) -> Any:
        """Return the surface or field, with the new curve if its field is the old one."""
        if isinstance(surface, Surface) and surface.field is curve:
            return surface.replace(field=moved)
        return moved if surface is curve else surface

    surfaces: list[Any] = [*content] if isinstance(content, list | tuple) else [content]
    return [edited(surface) for surface in surfaces]


def _objects_at(content: SlidingContent, values: Mapping[str, float]) -> list[StudioObject]:
    """Return the content at the given slider values as objects of the studio."""
    return _studio_objects(*content.at(values))


def _studio_objects(surfaces: Any, options: Mapping[str, Any]) -> list[StudioObject]:
    """Return surfaces, with the options of `view` by name, as objects of the studio.

    Raises:
        ValueError: a material is transparent.
    """
    studio = {name: options[name] for name in _OF_STUDIO if name in options}
    isolines = parse_isolines(options.get("isolines"))
    bodies = studio_objects(
        surfaces, options.get("material"), None, _surface_and_trace(options), isolines=isolines,
        **studio,
    )  # fmt: skip
    for body in bodies:
        check_opaque(body.material)
    return bodies


def _surface_and_trace(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return, of the given options, all that are keywords of `Surface` or options of traces.

    Raises:
        TypeError: an option is none that `view` has.
    """
    refuse_unknown("view", options)
    return shorthand_among(options)


def check_opaque(material: Material) -> None:
    """Raise ValueError for a material that live pictures cannot show, because light passes through
    it."""
    if material.transparent:
        raise ValueError(
            'what moves is not drawn transparent: choose another material, such as material="clay"'
        )


def _curve_of(bodies: Sequence[StudioObject]) -> SolidAngle | None:
    """Return the `SolidAngle` whose vertices can be edited; None if the objects have no such field,
    or more than one. Curves with circles cannot be edited."""
    fields = {id(body.surface.field): body.surface.field for body in bodies}
    curves = [f for f in fields.values() if isinstance(f, SolidAngle) and not f.circles]
    return curves[0] if len(curves) == 1 else None


def _kernel_data(
    body: StudioObject, placed: PlacedSurface, origins: FloatArray, directions: FloatArray
) -> JsonDict:
    """Return a surface as data for `renderer.js`: its shader and the words that the shader reads,
    its colors and tolerance, and, under "check", the test rays with the results that Dr.Jit
    computes for them.

    body: the surface with its material.
    placed: the surface on the stage.
    origins, directions: (n, 3) of the test rays, in stage coordinates.

    The entries "lanes" and "results" say in which order the shader reads the entries of a ray
    (`_LANES`) and writes its results (`_RESULTS`). "key" is a hash of the shader.
    """
    backend = choose_backend("single")
    lanes = {
        "o": to_vector3(backend, origins),
        "d": to_vector3(backend, directions),
        "far": backend.Float(np.full(len(origins), np.inf, np.float32)),
    }

    def compute(o: Vec3, d: Vec3, far: Real) -> JsonDict:
        hits = placed.intersect(o, d, far, backend.Bool(True))
        return {
            "status": status_of(hits), "t": hits.t, "normal": hits.normal,
            "evaluations": hits.evaluations, "paint": color_index(hits),
        }  # fmt: skip

    kernel = record_kernel(compute, lanes, placed)
    # The test rays and Dr.Jit's results for them, as words in the order of the shader. The label of
    # an entry is its path, such as "lane o 0" for the x of the origins.
    inputs = dict(labeled_leaves("lane", lanes))
    results = {name: kernel.results.get(f"result {name}") for name in _RESULTS}
    # A result is None here if it is the same constant for all rays. Only the last, the color, may
    # be: a surface with a single color has the index 0 everywhere.
    if any(results[name] is None for name in _RESULTS[:-1]):
        raise ValueError("what rays meet is the same for all of them: there is nothing to draw")
    # So for a result that is None, the color, the words are 0.
    answers = [
        np.zeros(len(origins), np.uint32) if x is None else as_words(x) for x in results.values()
    ]
    return {
        "key": hashlib.sha256(kernel.shader.code.encode()).hexdigest()[:16],
        "code": kernel.shader.code,
        "data": pack_shader_data(kernel.shader, kernel.data),
        "lanes": [_LANES.index(label.removeprefix("lane ")) for label in kernel.shader.lanes],
        "results": [_place(kernel, f"result {name}") for name in _RESULTS],
        "paints": surface_colors(body),
        "tolerance": placed_tolerance(body, placed),
        "check": {
            "lanes": np.stack([as_words(inputs[label]) for label in kernel.shader.lanes]),
            "results": np.stack(answers),
            "count": len(origins),
        },
    }


def status_of(met: SurfaceHit) -> Any:
    """Return the `RayStatus` of each ray as an array of integers. met: the hits of the rays."""
    hit, out_of_steps, miss = (
        type(met.evaluations)(int(status))
        for status in (RayStatus.HIT, RayStatus.OUT_OF_STEPS, RayStatus.MISS)
    )
    return dr.select(met.is_out_of_steps, out_of_steps, dr.select(met.is_hit, hit, miss))


def color_index(met: SurfaceHit) -> Any:
    """Return for each ray the index in `surface_colors` of the color of its hit. It is 0 for the
    surface itself, 1 for a filling of a hole, 2 for a cut face on a section, and 2 + k for isoline
    k = 1, 2, and so on. met: the hits of the rays."""
    index = cast("Any", type(met.evaluations))
    plain = dr.select(
        met.is_on_section, index(_CUT), dr.select(met.is_hole_filling, index(_MENDED), index(0))
    )
    return dr.select(met.isoline_index > 0, index(met.isoline_index) + _CUT, plain)


def placed_tolerance(body: StudioObject, placed: PlacedSurface) -> float:
    """Return the hit tolerance of a surface as a length in units of the stage.

    body: the surface, with the tolerance in its own coordinates.
    placed: the same surface on the stage, whose scale converts the length.
    """
    return body.surface.hit_tolerance.distance * float(placed.scale[0])


def _place(kernel: RecordedKernel, label: str) -> int:
    """Return the index of a result in the output of a kernel's shader; `_NO_OUTPUT` if the shader
    does not write the result, as it is the constant 0 for all rays.

    label: the name of the result, such as "result t".
    """
    if label in kernel.constants:
        return _NO_OUTPUT
    return kernel.shader.results.index(label)


def _rays(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return 2048 pseudo-random rays toward a surface: origins and unit directions, both (2048, 3).
    Origins lie on a sphere of radius 5 about the middle of the points' box. Each ray goes to a
    random point of the surface, displaced by about 0.05.

    points: (n, 3) of the surface, in stage coordinates.
    """
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(_RAYS, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    o = 0.5 * (points.min(axis=0) + points.max(axis=0)) + 5.0 * outward
    aims = points[rng.integers(0, len(points), _RAYS)]
    direction = aims + 0.05 * rng.normal(size=(_RAYS, 3)) - o
    return o, direction / np.linalg.norm(direction, axis=1, keepdims=True)


def surface_colors(body: StudioObject) -> list[JsonDict]:
    """Return the colors of a surface in shaded pictures, a dictionary for each of: the surface
    itself, fillings of holes, cut faces on a section, and each isoline. "front" and "back" are the
    linear sRGB colors of the sides of larger and of smaller values of the field; "glossy" is
    whether the material is glossy."""
    surface, mi = body.surface, register()
    is_solid = surface.solid_range is not None
    front, back, glossy = _reflectances(body.material.bsdf(solid=is_solid, traced_light=False))
    is_open = mi.Bool(not is_solid and not isinstance(surface.field, Solid))
    # If an open surface has one color, its side of larger values is drawn darker.
    sides = two_sided_color(front, back, is_open), back
    fillings = [hole_filling_tint(side, mi.Bool(True)) for side in sides]
    paints = [_paint(sides[0], sides[1], glossy), _paint(fillings[0], fillings[1], glossy)]
    section_material = body.material if body.section_material is None else body.section_material
    front, back, glossy = _reflectances(section_material.bsdf(solid=is_solid, traced_light=False))
    paints.append(_paint(front, back, glossy))
    # Lines are the same on both sides, and not glossy.
    lines = [mi.Color3f(*linear_from_srgb(line.srgb)) for line in body.isolines]
    return [*paints, *(_paint(line, line, False) for line in lines)]


def _paint(front: Any, back: Any, glossy: bool) -> JsonDict:
    """Return one entry of `surface_colors`. front, back: the colors of the two sides, Dr.Jit colors
    of one lane. glossy: whether the material is glossy."""
    sides = {"front": front, "back": back}
    return {
        "glossy": glossy,
        **{name: [float(part[0]) for part in color] for name, color in sides.items()},
    }


def _reflectances(bsdf: Mapping[str, Any]) -> tuple[Any, Any, bool]:
    """Return the colors of a material's front and back side (Dr.Jit colors of one lane), as shaded
    pictures use them, and whether the material is glossy. bsdf: the material as a Mitsuba
    dictionary."""
    mi = register()
    plugin = mi.load_dict(dict(bsdf), parallel=False)
    colors: list[Any] = []
    for side in (1, -1):
        si = dr.zeros(mi.SurfaceInteraction3f)
        # Light along the normal, on either side. A finite t marks the interaction as valid.
        si.wi, si.t = mi.Vector3f(0, 0, side), mi.Float(1)
        diffuse = mi.Color3f(plugin.eval_diffuse_reflectance(si, True))
        colors.append(reflectance(diffuse, mi.Bool(False)))
    flags = plugin.flags()
    glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy) or mi.has_flag(flags, mi.BSDFFlags.Delta)
    return colors[0], colors[1], bool(glossy)


def encode_arrays(value: Any) -> Any:
    """Return the same data with each NumPy array replaced by text: its bytes, compressed by gzip,
    in base64. `decodeWords` in renderer.js reads it. The tables of meshes are repetitive and shrink
    to a tenth."""
    if isinstance(value, np.ndarray):
        # mtime=0: no time of day in the data, so that equal arrays give equal texts.
        return base64.b64encode(gzip.compress(value.tobytes(), _LEVEL, mtime=0)).decode()
    if isinstance(value, dict):
        return {name: encode_arrays(entry) for name, entry in cast("JsonDict", value).items()}
    if isinstance(value, list):
        return [encode_arrays(entry) for entry in cast("list[Any]", value)]
    return value


def state_delta(first: JsonDict, state: JsonDict, *, checks: bool = True) -> JsonDict:
    """Return the difference between a state and the initial state of a scene (see
    `LiveScene.state`). For each surface it holds the indices "at" and the new values "to" of the
    words that changed, and all other entries that changed. If the surfaces have other kernels or
    tables of other sizes, the whole state is returned. `applyDelta` in slider_states.js is the
    inverse.

    first: the initial state.
    checks: whether the test rays with their results are included. The whole state always includes
        them, as no browser has checked its kernels yet.
    """
    pairs = [*zip(first["surfaces"], state["surfaces"], strict=False)]
    same_kernels = len(first["surfaces"]) == len(state["surfaces"]) and all(
        old["key"] == new["key"] and len(old["data"]) == len(new["data"]) for old, new in pairs
    )
    if not same_kernels:
        return state
    surfaces: list[JsonDict] = []
    for old, new in pairs:
        changes = {
            name: entry
            for name, entry in new.items()
            if name not in ("data", "check") and entry != old[name]
        }
        # Only the words that differ, by their places.
        at = np.flatnonzero(old["data"] != new["data"]).astype(np.uint32)
        changes |= {"at": at, "to": new["data"][at]}
        surfaces.append(changes | ({"check": new["check"]} if checks else {}))
    delta: JsonDict = {"surfaces": surfaces}
    if state["curves"] != first["curves"]:
        delta["curves"] = state["curves"]
    return delta
