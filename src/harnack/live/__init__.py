"""Draws surfaces live in a browser, in a standalone page (`page`) and in a view served by Python
(`view`), by the same JavaScript module.

The kernel that Dr.Jit recorded is run by the browser. `live_scene` turns the arguments of `render`
into plain data: shaders, a buffer of words for each, a camera, and rays with Dr.Jit's answers.
`renderer.js` and `passes.wgsl` draw it, the same for a page, a view and a notebook; `panel.js` is
the user interface, `live_framing` the camera that frames the surfaces for all slider values,
`legend_data` the meaning of the colors.

Three channels (`channels.js`, `slider_states.js`) bring changes: a socket to `server`, messages of
`widget`, or state deltas stored in the page itself. Python answers requests in `session`, which
trusts none of them, and sends the words that differ from the initial state, so that a slider
compiles nothing anywhere. Where the browser's device is missing, slower than Python or fails its
check, `preview_renderer` draws.
"""

from __future__ import annotations

from harnack.live.page_file import page
from harnack.live.scene_file import SceneFile, SceneFileError, read_scene, write_scene
from harnack.live.server import LiveView, view
from harnack.live.sliders import Slider

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
