"""Surfaces live in a browser: one drawing module, in a file to send and in a view of Python's.

The kernel that Dr.Jit recorded draws in the browser. `live_scene` makes plain data of what `render`
would draw: shaders, one buffer of words for each, a camera, rays with Dr.Jit's answers.
`drawing.js` and `passes.wgsl` draw it, the same for a page, a view and a notebook; `panel.js` is
the window, `live_framing` the camera that sees all places of the sliders, `legend_data` what colors
mean. Three links (`link.js`, `frames.js`) bring what changes: a socket to `server`, messages of
`widget`, or frames in the page itself. Python answers questions in `session`, which trusts none of
them, and sends words that differ from the first state, so that a slider compiles nothing anywhere.
Where the browser's device is missing, slower than Python or not to be believed, `preview_renderer`
draws.
"""

from __future__ import annotations

from harnack.view.page import page
from harnack.view.scene_file import SceneFile, SceneFileError, read_scene, write_scene
from harnack.view.server import LiveView, view
from harnack.view.sliders import Slider

__all__ = [
    "LiveView",
    "SceneFile",
    "SceneFileError",
    "Slider",
    "page",
    "read_scene",
    "view",
    "write_scene",
]  # fmt: skip
