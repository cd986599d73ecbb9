"""Answers the questions of a page about its live scene, whether they come by a socket or from a
notebook. A client is an open page. A state of the controls is the values of all sliders, the edited
curve, the cut and the settings that a person has changed.

A question is {"kind": ..., ...} of plain numbers, lists and text. All of its parts are checked, as
it comes from outside.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harnack.backend.validation import as_finite
from harnack.distance import curvature
from harnack.geometry import Ball, Box, HalfSpace
from harnack.live.live_scene import (
    LIVE_MODES,
    LIVE_OPTIONS,
    ControlState,
    LiveScene,
    check_opaque,
    encode_arrays,
    live_options,
    state_delta,
    surface_colors,
)
from harnack.live.preview_renderer import CameraAxes, PreviewRenderer, PreviewSurface
from harnack.live.scene_file import parse_scene
from harnack.live.sliders import extreme_slider_values
from harnack.name_suggestions import did_you_mean
from harnack.progress import Progress, ProgressFunction
from harnack.rendering import Camera
from harnack.rendering.backdrops import GROUNDS
from harnack.rendering.render_options import check_image_size
from harnack.rendering.stage import parse_material
from harnack.tracer import RayStatus, trace

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.geometry import Volume
    from harnack.live.live_scene import JsonDict
    from harnack.live.preview_renderer import Preview
    from harnack.rendering.stage import StudioObject

__all__ = ["MessageHandler", "RequestError", "Session", "parse_camera"]

# Points of all curves of one message, so that no message fills the memory.
_MOST_POINTS = 20_000
# Steps of a ray that are drawn.
_MOST_STEPS = 200
# Seconds between two messages about progress.
_PROGRESS_INTERVAL = 0.1
_LARGEST_PICTURE = 8192


def _ignore_progress(progress: Progress) -> None:
    """Ignore how far some work is."""


class RequestError(ValueError):
    """The error for a question that is malformed or asks for something impossible."""


class Cancelled(Exception):
    """The exception by which a computation stops because its client cancelled it or is gone."""


@dataclass
class _PreviewCache:
    """The surfaces of one state of the controls, prepared for previews (quick pictures that Python
    draws). Only that of the last state is kept: a person rarely returns to an earlier one.

    key: the state of the controls, as a tuple that can be compared.
    drawn: the surfaces as objects of the studio.
    prepared: the surfaces on the stage, with their colors.
    rays: the number of rays that were traced through them so far.
    prepared_rays: the number of rays for which they were prepared.
    """

    key: Any
    drawn: list[StudioObject]
    prepared: list[PreviewSurface] = field(default_factory=list[PreviewSurface])
    rays: int = 0
    prepared_rays: int = 0


class MessageHandler:
    """Reads the messages of one client (an open page), and turns the answers of its `Session` into
    messages.

    session: answers the questions.
    is_gone: whether the client has closed its page; then running computations stop.
    """

    def __init__(self, live: LiveScene) -> None:
        self.session = Session(live)
        self.is_gone = False
        self._cancelled: set[int] = set()

    def read(self, text: str) -> JsonDict | None:
        """Return the question in a message; None for a message of kind "cancel", whose question is
        marked as cancelled.

        Raises:
            RequestError: the message is no JSON object with a whole number "id".
        """
        try:
            data = json.loads(text)
        except (ValueError, RecursionError):
            raise RequestError("a question is an object in JSON") from None
        if not isinstance(data, dict):
            raise RequestError("a question is an object")
        question = cast("JsonDict", data)
        if question.get("kind") == "cancel" and type(question.get("which")) is int:
            self._cancelled.add(question["which"])
            return None
        # An answer with a picture has four bytes for it.
        number = question.get("id")
        if type(number) is not int or not 0 <= number < 2**32:
            raise RequestError("id must be a whole number, by which the answer is known")
        return question

    def answer(self, question: JsonDict, send: Callable[[JsonDict], None]) -> JsonDict | bytes:
        """Answer a question. Returns the message to send back: a JSON object or, for a picture,
        bytes. The bytes are five little-endian numbers of four bytes (the question's id, height,
        width, and the two ends of the depths in single precision), and then the pixels: red, green,
        blue and alpha, row by row. Errors become messages too.

        send: called with messages about the progress of long work.
        """
        number, last = question["id"], time.monotonic()

        def report(progress: Progress) -> None:
            """Send the progress from time to time.

            Raises:
                Cancelled: the client cancelled the question or is gone.
            """
            nonlocal last
            if self.is_gone or number in self._cancelled:
                raise Cancelled("stopped, as asked")
            now = time.monotonic()
            if now > last + _PROGRESS_INTERVAL:
                last = now
                send({"id": number, "done": progress.done})

        try:
            # A question that was cancelled while it waited is not begun.
            report(Progress())
            answer = self.session.answer(question, report)
        except Exception as wrong:
            kind = "" if isinstance(wrong, Cancelled) else f"{type(wrong).__name__}: "
            return {"id": number, "error": f"{kind}{wrong}"}
        finally:
            self._cancelled.discard(number)
        if isinstance(answer, dict):
            return {"id": number, "answer": answer}
        # The message of a picture: id, height and width, the ends of the depths, and the pixels.
        head = np.array([number, *answer.pixels.shape[:2]], dtype="<u4").tobytes()
        return head + np.array(answer.depths, dtype="<f4").tobytes() + answer.pixels.tobytes()


class Session:
    """Answers questions about a live scene for one client (an open page), and keeps what the next
    preview can use again. Each kind of question has a method, which gets the question, the state of
    the controls, and `report`, a function to be called with each finished fraction of the work."""

    def __init__(self, live: LiveScene) -> None:
        self.live = live
        self._painter = PreviewRenderer()
        self._painted: _PreviewCache | None = None

    def answer(
        self, question: Mapping[str, Any], report: ProgressFunction = _ignore_progress
    ) -> JsonDict | Preview:
        """Answer a question. Returns JSON data, or a picture for the kind "draw".

        question: "kind" selects what is asked; "sliders", "loops", "cut" and "settings" are the
            state of the controls.
        report: called during long work with the fraction of it, from 0 to 1, that was finished
            since the last call; an exception that it raises ends the work.

        Raises:
            RequestError: the question makes no sense; the message says which questions do.
            ValueError, TypeError, ...: errors of the library for numbers that make no surface.
        """
        kinds = {
            "change": self._delta_response,
            "probe": self._probe,
            "picture": self._picture_response,
            "draw": self._preview_response,
            "save": self._save,
            "load": self._load,
        }
        kind = question.get("kind")
        if kind not in kinds:
            raise RequestError(f"kind must be one of {', '.join(kinds)}, not {kind!r}")
        return kinds[kind](question, self.controls(question), report)

    def controls(self, question: Mapping[str, Any]) -> ControlState:
        """Return the state of the controls that a question asks about.

        Raises:
            RequestError: some part of the state is malformed or out of its range.
        """
        values = self._values(question.get("sliders", {}))
        loops, cut = self._loops(question.get("loops")), _volume(question.get("cut"))
        return ControlState(values, loops, cut, _settings(question.get("settings", {})))

    def _values(self, numbers: Any) -> dict[str, float]:
        """Return the values of all sliders by name: the values in `numbers` (a dictionary by slider
        name), moved to values that the sliders can have, and the start values of all other sliders.

        Raises:
            RequestError: an unknown slider, or a value that is not between the ends of its slider.
        """
        sliders = self.live.content.sliders
        if not isinstance(numbers, dict):
            raise RequestError("sliders must be numbers by name")
        values = dict(self.live.content.starts)
        for name, value in cast("dict[str, Any]", numbers).items():
            if name not in sliders:
                raise RequestError(f"there is no slider {name!r}{did_you_mean(name, sliders)}")
            slider = sliders[name]
            if not _is_number(value) or not slider.low <= value <= slider.high:
                raise RequestError(
                    f"{name} must be a number from {slider.low:g} to {slider.high:g}, not {value!r}"
                )
            values[name] = float(value) if slider.step is None else slider.nearest(value)
        return values

    def _loops(self, curves: Any) -> list[FloatArray] | None:
        """Return the vertices (n, 3) of each edited loop; None if there are no edits. curves: a
        list of points for each loop, or None.

        Raises:
            RequestError: malformed or too many points.
        """
        if curves is None:
            return None
        if not self.live.editable:
            raise RequestError("loops: this surface has no curve whose points can be moved")
        if not isinstance(curves, list) or not curves:
            raise RequestError("loops must be a list of curves")
        loops = [_points(curve, "loops") for curve in cast("list[Any]", curves)]
        if sum(map(len, loops)) > _MOST_POINTS:
            raise RequestError(f"loops: at most {_MOST_POINTS:,} points")
        return loops

    def _delta_response(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> JsonDict:
        """Answer "change": compute the data of all surfaces for the controls. Returns how it
        differs from the data at the start, as JSON data."""
        state = self.live.state(controls)
        checks = question.get("checks") is True
        return encode_arrays(state_delta(self.live.initial_state, state, checks=checks))

    def _probe(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> JsonDict:
        """Answer "probe": trace one ray, given in the surfaces' coordinates. Returns its nearest
        hit as JSON data: status, position, normal, value and curvatures, and "steps", the distances
        that the tracer's successive steps reached.

        The steps are found by tracing the ray again with 1, 2, 3, ... steps. A hit on a jump of the
        field has the index of a triangle in place of value and curvatures.
        """
        origin = _points([question.get("origin")], "origin")
        direction = _points([question.get("direction")], "direction")
        surfaces = [
            surface_of_scene.surface for surface_of_scene in self.live.surfaces_at(controls)
        ]
        # A `TracedSurface` consists of a `Surface` and of options of traces. All arrays of a result
        # have one entry, as there is one ray.
        results = [
            trace(surface_of_scene.surface, origin, direction, options=surface_of_scene.options)
            for surface_of_scene in surfaces
        ]
        nearest = min(range(len(results)), key=lambda k: float(results[k].t[0]))
        hits, surface = results[nearest], surfaces[nearest]
        # A ray with a limit of `count` evaluations ends where its step of that number ends.
        # Only steps that lead farther are listed.
        steps = [0.0]
        for count in range(1, min(int(hits.evaluations[0]), _MOST_STEPS)):
            options = surface.options.replace(max_steps=count)
            reached = trace(surface.surface, origin, direction, options=options).t[0]
            if steps[-1] < reached < hits.t[0]:
                steps.append(float(reached))
        answer: JsonDict = {
            "status": RayStatus(int(hits.status[0])).name,
            "evaluations": int(hits.evaluations[0]),
            "steps": steps,
        }
        if not hits.is_hit[0]:
            return answer
        point = hits.position
        answer |= {
            "t": float(hits.t[0]),
            "position": point[0].tolist(),
            "normal": hits.normal[0].tolist(),
        }
        # At a hit on a triangle the field jumps, and has no derivatives.
        if hits.primitive_index[0] >= 0:
            return answer | {"triangle": int(hits.primitive_index[0])}
        value, period = float(surface.field.value(point)[0]), surface.field.period
        if period is not None and len(surface.level_values):
            # The value, of those that differ by whole periods, that is nearest to a level.
            levels = np.asarray(surface.level_values, np.float64)
            shifts = np.round((levels - value) / period) * period
            value += float(shifts[np.argmin(np.abs(value + shifts - levels))])
        answer["value"] = value
        try:
            curvatures = curvature(surface.field, point)
        except NotImplementedError:
            return answer
        return answer | {
            "mean": float(curvatures.mean[0]),
            "gaussian": float(curvatures.gaussian[0]),
        }

    def _preview_response(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> Preview:
        """Answer "draw": return a preview with one ray per pixel, from the camera "eye" of the
        question."""
        size = _size(question)
        show, ground = question.get("show", "shaded"), question.get("ground", self.live.backdrop)
        if show not in LIVE_MODES or ground not in GROUNDS:
            raise RequestError(
                f"show is one of {', '.join(LIVE_MODES)}, ground of {', '.join(GROUNDS)}"
            )
        eye = question.get("eye")
        if not isinstance(eye, dict):
            raise RequestError("eye must be an object of origin, right, up, forward and pixel")
        axes = cast("JsonDict", eye)
        # `_points` makes an array (1, 3) of a list with one point.
        origin, right, up, forward = (
            _points([axes.get(name)], f"eye: {name}")[0]
            for name in ("origin", "right", "up", "forward")
        )
        pixel: Any = axes.get("pixel")
        if not _is_number(pixel) or not pixel > 0:
            raise RequestError("eye: pixel must be a positive number")
        camera = CameraAxes(origin, right, up, forward, pixel)
        return self._painter.paint(
            self._surfaces(controls, size[0] * size[1]), camera, size, show=show, ground=ground,
            is_idle=question.get("is_idle") is True,
        )  # fmt: skip

    def _surfaces(self, controls: ControlState, rays: int) -> list[PreviewSurface]:
        """Return the surfaces prepared for previews.

        rays: the number of rays of the next picture.

        The surfaces of the last call are returned again if the controls are the same. But once
        twice as many rays were traced as they were prepared for, the surfaces are prepared again:
        then building cells may take less time than it saves. Cells hold local expansions of the
        field, which make each ray faster.
        """
        # Arrays are compared by their bytes.
        loops = None if controls.curves is None else [loop.tobytes() for loop in controls.curves]
        key = controls.values, loops, controls.cut_volume, controls.settings
        state = self._painted
        if state is None or state.key != key:
            state = self._painted = _PreviewCache(key, self.live.surfaces_at(controls))
        state.rays += rays
        # Powers of two: so surfaces are seldom prepared again.
        rays = 1 << (state.rays - 1).bit_length()
        if not state.prepared or rays != state.prepared_rays:
            state.prepared_rays = rays
            state.drawn = [
                replace(body, surface=body.surface.for_rays(rays)) for body in state.drawn
            ]
            state.prepared = [
                PreviewSurface(self.live.place(body), surface_colors(body)) for body in state.drawn
            ]
        return state.prepared

    def _picture_response(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> JsonDict:
        """Answer "picture": draw by `render` from the camera of the question. Returns {"png":
        base64 text of a PNG file}."""
        size = _size(question)
        picture: Any = self.live.render_still(
            controls, show=question.get("show", "shaded"), size=size, progress=report,
            camera=self._camera(question), spp=question.get("spp"),
            backdrop=question.get("ground", self.live.backdrop),
        )  # fmt: skip
        return {"png": base64.b64encode(picture._repr_png_()).decode()}

    def _camera(self, question: Mapping[str, Any]) -> Camera:
        """Return the camera of a question. In the question, position and target are in stage
        coordinates; in the result they are in the surfaces' coordinates."""
        placement = self.live.placement
        eye, target, fov = parse_camera(question.get("camera"))
        eye, target = (placement.apply_inverse(point[None])[0] for point in (eye, target))
        return Camera(position=tuple(eye.tolist()), target=tuple(target.tolist()), fov=fov)

    def _save(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> JsonDict:
        """Answer "save": return {"text": the scene file of the state, "lost": names of the sliders
        that it cannot hold}."""
        text, lost = self.live.to_scene_text(
            controls, camera=self._camera(question), show=question.get("show", "shaded"),
            backdrop=question.get("ground", self.live.backdrop), up=self.live.up,
        )  # fmt: skip
        return {"text": text, "lost": lost}

    def _load(
        self, question: Mapping[str, Any], controls: ControlState, report: ProgressFunction
    ) -> JsonDict:
        """Answer "load": replace the scene by that of a scene file, whose text is in the question,
        and return the new scene's data as `LiveScene.scene` does. Of the settings of the file only
        those that `live_options` selects are used."""
        text = question.get("text")
        if not isinstance(text, str):
            raise RequestError("text must be that of a scene file")
        saved = parse_scene(text)
        settings = {**live_options(saved.settings), **saved.sliders}
        live = LiveScene.of([*saved.surfaces], settings, edits=True, sources=saved.sources)
        self.live = live.framed(extreme_slider_values(live.content.sliders))
        self._painter, self._painted = PreviewRenderer(), None
        return self.live.scene(self.live.content.name)


def parse_camera(camera: Any) -> tuple[FloatArray, FloatArray, float]:
    """Return position (3,), target (3,) and field of view in degrees from {"position": ...,
    "target": ..., "fov": ...}.

    Raises:
        RequestError: `camera` is no such object, or its numbers make no camera.
    """
    if not isinstance(camera, dict):
        raise RequestError("camera must be an object of position, target and fov")
    pose = cast("JsonDict", camera)
    # `_points` makes an array (1, 3) of a list with one point.
    eye, target = (
        _points([pose.get(name)], f"camera: {name}")[0] for name in ("position", "target")
    )
    fov: Any = pose.get("fov")
    if not _is_number(fov):
        raise RequestError("camera: fov must be a number of degrees")
    try:
        Camera(position=tuple(eye.tolist()), target=tuple(target.tolist()), fov=fov)
    except ValueError as wrong:
        raise RequestError(f"camera: {wrong}") from None
    return eye, target, fov


def _size(question: Mapping[str, Any]) -> tuple[int, int]:
    """Return the size (w, h) in pixels of the picture that a question asks for.

    Raises:
        RequestError: a side is too long.
    """
    size = check_image_size(question.get("size"))
    if max(size) > _LARGEST_PICTURE:
        raise RequestError(f"size: at most {_LARGEST_PICTURE} pixels a side")
    return size


def _volume(cut: Any) -> Volume | None:
    """Return the volume that cuts all surfaces, in their coordinates; None for no cut.

    cut: {"ball": [center, radius]}, {"box": [two corners]} or {"plane": [normal, offset]} of a
        half-space, each a flat list of numbers; None for no cut.

    Raises:
        RequestError: `cut` is none of these.
    """
    if cut is None:
        return None
    # How many numbers each kind has.
    kinds = {"ball": 4, "box": 6, "plane": 4}
    data = cast("JsonDict", cut) if isinstance(cut, dict) else {}
    if len(data) != 1 or not set(data) <= set(kinds):
        raise RequestError(f"cut is one of {', '.join(kinds)} and its numbers")
    ((kind, numbers),) = data.items()
    listed = cast("list[Any]", numbers) if isinstance(numbers, list) else []
    if len(listed) != kinds[kind] or not all(map(_is_number, listed)):
        raise RequestError(f"cut: a {kind} has {kinds[kind]} finite numbers")
    if kind == "ball":
        return Ball(tuple(listed[:3]), listed[3])
    if kind == "box":
        return Box(tuple(listed[:3]), tuple(listed[3:]))
    return HalfSpace(tuple(listed[:3]), listed[3])


def _settings(data: Any) -> dict[str, Any]:
    """Return the options that a person has changed, by name.

    Raises:
        RequestError: they are not valid values of `LIVE_OPTIONS`.
    """
    if not isinstance(data, dict):
        raise RequestError("settings must be an object with names")
    settings = cast("JsonDict", data)
    for name, value in settings.items():
        if name not in LIVE_OPTIONS:
            raise RequestError(
                f"there is no setting {name!r:.60}{did_you_mean(name, LIVE_OPTIONS)}"
            )
        if name == "material":
            if not isinstance(value, str):
                raise RequestError(f"material must be a name or a color, not {value!r:.60}")
            try:
                # Light must not pass through what is drawn live.
                check_opaque(parse_material(value))
            except ValueError as wrong:
                raise RequestError(str(wrong)) from None
        elif value is not None and not (_is_number(value) and value > 0):
            raise RequestError(f"{name} must be a positive number or null, not {value!r:.60}")
    return settings


def _points(numbers: Any, name: str) -> FloatArray:
    """Return an array of points (n, 3) from a list of lists.

    Raises:
        RequestError: not three finite numbers each. The message begins with `name`.
    """
    wrong = f"{name}: points are three finite numbers each"
    try:
        points: FloatArray = np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise RequestError(wrong) from None
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise RequestError(wrong)
    return points


def _is_number(value: Any) -> bool:
    """Return whether a value is a finite int or float, and no bool."""
    try:
        as_finite(value, "it")
    except (TypeError, ValueError):
        return False
    return isinstance(value, int | float)
