"""Surfaces live in a browser: one drawing module, in a file to send and in a view of Python's."""

from __future__ import annotations

from harnack.view.page import page
from harnack.view.scene_file import SavedScene, SceneFileError, read_scene, write_scene
from harnack.view.server import View, view
from harnack.view.sliders import Slider

__all__ = [
    "SavedScene", "SceneFileError", "Slider", "View", "page", "read_scene", "view", "write_scene",
]  # fmt: skip
