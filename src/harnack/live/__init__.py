"""Draws surfaces interactively in a browser: `page` writes a standalone page, and `view` shows a
page that Python serves. The same JavaScript module draws both. A live scene is a set of surfaces
that a person can turn, cut, and change by sliders.

The browser runs the kernel that Dr.Jit recorded. `live_scene` turns the arguments of `render` into
plain data: shaders, a buffer of 32-bit words for each shader, a camera, and test rays with Dr.Jit's
results. `renderer.js` and `passes.wgsl` draw this data, the same for a page, a view and a notebook.
`panel.js` is the user interface, `live_framing` computes a camera that frames the surfaces for all
slider values, and `legend_data` holds the meaning of the colors.

Three channels (`channels.js`, `slider_states.js`) bring changes to the browser: a socket to
`server`, messages of `widget`, or state deltas stored in the page itself. `session` is the part of
Python that answers the browser's requests and checks their contents. Its answer holds only the
words that differ from the initial state, so that moving a slider compiles no kernel.
`preview_renderer` draws in Python if the browser has no WebGPU device, or if that device is slower
than Python or fails its check.
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
