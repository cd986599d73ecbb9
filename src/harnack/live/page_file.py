"""Writes one HTML file, a page, that opens in any browser and traces surfaces there. The page holds
a state (the surfaces as data) for each combination of slider values that it offers; states other
than the initial one are stored as differences from it."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import itertools
import json
import math
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np

from harnack.cluster.executor import Executor, TaskResult, open_executor
from harnack.files.file_geometry import write_atomically
from harnack.live.live_scene import ControlState, LiveScene, encode_arrays, state_delta
from harnack.live.scene_file import with_flat_options
from harnack.live.shading_data import shader_constants
from harnack.live.sliders import slider_values_in_errors
from harnack.progress import show_progress
from harnack.rendering.camera import Camera
from harnack.rendering.mitsuba import set_variant
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.option_table import refuse_others, shows_options

if TYPE_CHECKING:
    from harnack.live.live_scene import JsonDict
    from harnack.tracer import TraceOptions

__all__ = [
    "MODULES", "check_title", "document", "page", "passes", "resource", "script", "still_png",
]  # fmt: skip

_STILL_SIZE = (640, 480)
# The largest number of values of a slider without a step; the number of combinations of values of
# all sliders that is aimed at if none has a step; and the largest number of combinations.
_MAX_SLIDER_VALUES, _CHOICES, _MOST_CHOICES = 33, 300, 1000
# Up to this number of combinations, the camera frames all of them; of more, every other value of
# each slider, and its ends.
_FRAMED = 100
# If the states take more than the first number of bytes, sliders without steps get fewer values,
# but at least 9 if there is one slider, and 5 each of several; and the bytes of a page above which
# a warning is given.
_TARGET_BYTES, _FEWEST, _MANY_BYTES = 4e6, (9, 5), 8e6
MODULES = (
    "camera.js", "channels.js", "curve_editor.js", "device_check.js", "dom.js", "floor_light.js",
    "legend.js", "panel.js", "placement.js", "renderer.js", "slider_states.js",
)  # fmt: skip
# What brings other states: those in the page, or Python's answers.
_CHANNEL_SCRIPTS = {
    "frames": "scene.sliders.length ? new SliderStates(scene.frames) : null",
    "server": "new WebSocketChannel(`ws://${location.host}/questions${location.search}`)",
}


@shows_options("page")
def page(
    surfaces: Any,
    path: str | os.PathLike[str],
    *,
    options: TraceOptions | None = None,
    **keywords: Any,
) -> None:
    """Write one HTML file in which surfaces turn under mouse, touch and keys.

        hk.page(field, "surface.html")
        hk.page(field, "levels.html", level=hk.Slider(1, 12))
        hk.page(lambda w: hk.fields.Morph(a, b, w=w), "morph.html", w=hk.Slider(0, 1))

    The file opens in any browser with WebGPU, without Python and without a network; some browsers
    offer WebGPU only to pages from https or 127.0.0.1. A browser without WebGPU shows a still
    picture and says why. The file holds the kernel that Dr.Jit records for each surface, translated
    to WGSL, so that the visitor's GPU takes the same proved steps. As rounding on that GPU is not
    proved, the file also holds 2,048 rays for each surface with Dr.Jit's results. The browser
    traces these rays first, and draws nothing that its GPU computes if the results do not agree.

    surfaces: a field, a `Surface`, or a list of them, as for `render`; or a function of sliders
        that returns them.
    path: the file to write; it must end in .html or .htm.
    title: the title of the page; by default the field's own text.
    progress: whether a bar shows how much of the page is done, as for `render`.
    options, keywords: options of `render` and of traces: level, clip, tolerance, material, camera,
        up, boundary_radius, ..., and backdrop="light" or "dark". Options for still pictures alone
        are refused. The value of an option that is a number may be a `Slider`. Any other value may
        be a function whose arguments are named like sliders. The file stores a state for every
        combination of slider values. A slider without a step has 33 values, two such sliders have
        17 each, and fewer if the states would take more than 4 MB (at least 9 for one slider, 5
        each for several). A page with sliders of more than 8 MB is written with a warning.
    client, checkpoint: a Dask client (or its address) that computes the states, and a folder in
        which finished states are kept, as for `render`.

    Raises:
        ValueError: a path that does not end in .html; a surface without bounds; a transparent
            material; sliders with too many combinations of values; slider values for which nothing
            can be drawn (the message says why).
        UntranslatableError: the kernel holds an operation that has no translation to WGSL.
        TypeError: a surface that is no field; an unknown option; a slider that nothing depends on.
    """
    target = os.fspath(path)
    settings = with_flat_options({**keywords, "options": options})
    refuse_others("page", settings)
    title, progress = settings.pop("title", ""), settings.pop("progress", True)
    client, checkpoint = settings.pop("client", None), settings.pop("checkpoint", None)
    check_title(title)
    if not target.lower().endswith((".html", ".htm")):
        raise ValueError(f"{target}: a page is written as .html")
    # The states for all slider values are computed part by part, here or on a cluster.
    job = PageJob(surfaces, settings, register().variant())
    with show_progress("page", progress) as reporter:
        live = job.live
        scene = live.scene(title or live.content.name)
        with open_executor(job, client, checkpoint) as workers:
            scene["frames"] = _slider_states(job, workers, reporter.advance)
    text = document(scene, still_png(live)).encode()
    with write_atomically(target) as partial:
        partial.write_bytes(text)
    if len(text) > _MANY_BYTES and live.content.sliders:
        count = len(scene["frames"]["frames"])
        warnings.warn(
            f"{target} has {len(text) / 1e6:.1f} MB, because it holds what is drawn at {count:,} "
            "places of the sliders: give them larger steps",
            stacklevel=2,
        )


def check_title(title: Any) -> None:
    """Raise `TypeError` if the title is not a string."""
    if not isinstance(title, str):
        raise TypeError(f"title must be text, not {title!r:.60}")


def still_png(live: LiveScene) -> str:
    """Draw the initial state, and return it as base64 text of a PNG file. A page shows it where the
    browser cannot trace."""
    camera = Camera(**live.pose)
    still: Any = live.render_still(
        live.initial_controls, show=live.show, size=_STILL_SIZE, camera=camera
    )
    return base64.b64encode(still._repr_png_()).decode()


def _places(live: LiveScene) -> dict[str, list[float]]:
    """Choose the slider values for which a page stores states. Returns a list of values for each
    slider by name. A slider with a step has all its values. A slider without a step has evenly
    spaced values, fewer if the states are large (see `_TARGET_BYTES`).

    Raises:
        ValueError: there are more than `_MOST_CHOICES` combinations of slider values.
    """
    sliders = live.content.sliders
    # n sliders with `count` values each have count^n combinations.
    count = max(2, min(_MAX_SLIDER_VALUES, int(_CHOICES ** (1 / max(1, len(sliders))))))
    values_by_name = {name: slider.values(count) for name, slider in sliders.items()}
    total = math.prod(map(len, values_by_name.values()))
    if total > _MOST_CHOICES:
        raise ValueError(
            f"the sliders {', '.join(sliders)} have {total:,} choices of places, which a page "
            f"without Python behind it has to hold, and {_MOST_CHOICES:,} at most: give larger "
            "steps or fewer sliders, or use harnack.view"
        )
    if all(slider.step is not None for slider in sliders.values()):
        return values_by_name
    ends = ({name: values[k] for name, values in values_by_name.items()} for k in (0, -1))
    # The size of a state is estimated by those with all sliders at their lower, and at their upper
    # ends.
    largest_bytes = max(
        len(json.dumps(_slider_state(live, slider_values))) for slider_values in ends
    )
    # The index is False (0) for one slider and True (1) for several.
    fewest = min(count, _FEWEST[len(sliders) > 1])
    while (
        count > fewest
        and largest_bytes * math.prod(map(len, values_by_name.values())) > _TARGET_BYTES
    ):
        # Half as many intervals.
        count = max(fewest, (count + 1) // 2)
        values_by_name = {name: slider.values(count) for name, slider in sliders.items()}
    return values_by_name


def _framing_values(places: Mapping[str, list[float]]) -> Mapping[str, list[float]]:
    """Return the slider values by which the picture is framed.

    places: the values of each slider in the page. They are returned unchanged if they have at most
        `_FRAMED` combinations; otherwise every other value of each slider, and its last one, are
        returned.
    """
    if math.prod(map(len, places.values())) <= _FRAMED:
        return places
    return {name: sorted({*values[::2], values[-1]}) for name, values in places.items()}


def _slider_combinations(places: Mapping[str, list[float]]) -> list[dict[str, float]]:
    """Return all combinations of the values of the sliders, each as a value by slider name. The
    last slider changes fastest.

    places: the values of each slider, by name.
    """
    return [dict(zip(places, place, strict=True)) for place in itertools.product(*places.values())]


def _slider_state(live: LiveScene, values: Mapping[str, float]) -> JsonDict:
    """Return the state of the scene `live` at the given slider values, as JSON data that hold its
    difference from the initial state."""
    with slider_values_in_errors(values):
        state = live.state(ControlState(values))
    return encode_arrays(state_delta(live.initial_state, state, checks=False))


@dataclass(frozen=True)
class PageJob:
    """The arguments of `page`, in a form that can be sent to other processes, which compute the
    states of the page. A state is the surfaces as data for given slider values.

    surfaces: the content of the page, as `page` takes it.
    settings: the options of `page` by name, sliders included.
    variant: the Mitsuba variant of this process, which the other processes are to use too.
    """

    surfaces: Any
    settings: Mapping[str, Any]
    variant: str

    @functools.cached_property
    def unframed(self) -> LiveScene:
        """The live scene of the arguments, framed for the start values of its sliders alone."""
        set_variant(self.variant)
        return LiveScene.of(self.surfaces, dict(self.settings))

    @functools.cached_property
    def places(self) -> dict[str, list[float]]:
        """The slider values for which the page stores states, by slider name."""
        return _places(self.unframed)

    @functools.cached_property
    def live(self) -> LiveScene:
        """The live scene, framed for all slider values that the page stores."""
        return self.unframed.framed(_slider_combinations(_framing_values(self.places)))

    @functools.cached_property
    def digest(self) -> str:
        """A hash of the initial state, as text. Differences of other states can be applied only to
        the same initial state."""
        return hashlib.blake2b(
            json.dumps(encode_arrays(self.live.initial_state)).encode()
        ).hexdigest()

    def state(self, values: Mapping[str, float], digest: str) -> TaskResult:
        """Return the difference of the state at the given slider values from the initial state, as
        {"text": bytes of JSON in an array of uint8}.

        digest: the hash of the page's initial state, in the process that writes the page.

        Raises:
            RuntimeError: this process computes an initial state with another hash.
        """
        if self.digest != digest:
            raise RuntimeError(
                "a worker prepares this surface with other numbers than this process does: write "
                "the page without client and checkpoint"
            )
        text = json.dumps(_slider_state(self.live, values)).encode()
        return {"text": np.frombuffer(text, np.uint8)}


def _slider_states(job: PageJob, workers: Executor, advance: Any) -> JsonDict:
    """Compute the states of a page. Returns {"places": the values of each slider, "frames": the
    difference from the initial state for each combination of them, in the order of
    `_slider_combinations`}.

    job: the arguments of the page.
    workers: run the parts of the work, in this process or on a cluster.
    advance: called with the finished fraction of the work after each part.
    """
    frames: list[JsonDict] = []
    tasks = [(values, job.digest) for values in _slider_combinations(job.places)]
    for result in workers.run_tasks("state", tasks):
        frames.append(json.loads(result["text"].tobytes()))
        advance(1 / len(tasks))
    return {"places": job.places, "frames": frames}


def script(*names: str) -> str:
    """Return the named JavaScript modules of this folder, joined into one script without imports
    and exports."""
    parts = [resource(name) for name in names]
    text = "\n".join(re.sub(r"^import .*?;\n", "", part, flags=re.M | re.S) for part in parts)
    return re.sub(r"^export ", "", text, flags=re.M)


def document(scene: Mapping[str, Any], still: str, link: str = "frames") -> str:
    """Return the text of an HTML page.

    scene: the data of `LiveScene.scene`.
    still: base64 text of a PNG file.
    link: where the page gets other states from: "frames" for states stored in it, or "server" for
        Python's answers.
    """
    return _PAGE.substitute(
        title=html.escape(scene["title"]),
        style=resource("panel.css"),
        # Text must not end the element in which it stands.
        script=script(*MODULES).replace("</script", "<\\/script"),
        passes=json.dumps(passes()).replace("</", "<\\/"),
        scene=json.dumps(scene).replace("<", "\\u003c"),
        still=still,
        link=_CHANNEL_SCRIPTS[link],
    )


def passes() -> str:
    """Return the shaders of a page, in WGSL: the constants of shading, and the text of
    passes.wgsl."""
    return shader_constants() + resource("passes.wgsl")


def resource(name: str) -> str:
    """Return the text of a file of this folder, such as a JavaScript module."""
    return resources.files("harnack.live").joinpath(name).read_text(encoding="utf-8")


_PAGE = Template("""\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<link rel="icon" href="data:,">
<style>
html, body { margin: 0; height: 100%; }
body > div { height: 100%; }
$style</style>
<div id="surface"></div>
<script type="module">
$script
const scene = $scene;
const passes = $passes;
const root = document.getElementById("surface");
root.addEventListener("panel", (e) => { window.panel = e.detail; });
window.panel = new Panel(root, scene, passes, $link,
  "data:image/png;base64,$still");
window.panel.open();
</script>
</html>
""")
