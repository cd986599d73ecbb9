"""A named scene of the gallery: which surfaces it has, and how to draw them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from harnack.rendering import Camera, render
from harnack.tracer import Surface, TraceOptions

SurfaceFactory = Callable[[], "list[Surface]"]

# Fine enough that no pixel of a demo picture shows it, coarse enough for shadow rays to be quick.
PICTURE_OPTIONS = TraceOptions(tolerance=2e-4)


@dataclass(frozen=True)
class Scene:
    """A named scene of the gallery: its surfaces, and how `render` draws them.

    name, title: the name on the command line, and a description in words.
    surfaces: a function that returns the surfaces.
    materials: the name of each surface's material, or a single name for all surfaces.
    camera, show, options: options of `render` by these names.
    demo_spp: samples per pixel in `harnack gallery --demo`, few enough for all these pictures to
        take some minutes; 0 leaves the scene out of them.
    """

    name: str
    title: str
    surfaces: SurfaceFactory
    materials: tuple[str, ...] = ("two-tone",)
    camera: Camera = field(default_factory=Camera)
    show: str = "path"
    options: TraceOptions = PICTURE_OPTIONS
    demo_spp: int = 0

    def render(self, path: Any = None, **options: Any) -> Any:
        """Render the scene to a file (if `path` is given), and return the picture. options: options
        of `render` that replace those of the scene."""
        surfaces = self.surfaces()
        return render(surfaces, path, **{**self.settings(len(surfaces)), **options})

    def settings(self, count: int) -> dict[str, Any]:
        """Return the options of `render` with which the scene is drawn, by name. count: the number
        of its surfaces, which are needed to repeat a single material."""
        names = self.materials * count if len(self.materials) == 1 else self.materials
        return {
            "material": list(names), "camera": self.camera, "show": self.show,
            "options": self.options,
        }  # fmt: skip
