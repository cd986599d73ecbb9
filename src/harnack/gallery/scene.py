"""A named scene of the gallery: its contents, and how to draw it."""

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
    """A named picture, and how to draw it.

    surfaces: a function that returns the surfaces.
    materials: a name for each of them (or a single name for all).
    options: of the traces.
    demo_spp: samples a pixel in `make demo`, few, to keep that to a few minutes; 0 to leave the
        scene out of it.
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
        """Render the picture by `harnack.rendering`; options of `render` override the scene's."""
        surfaces = self.surfaces()
        return render(surfaces, path, **{**self.settings(len(surfaces)), **options})

    def settings(self, count: int) -> dict[str, Any]:
        """The options of `render` by which `count` surfaces are drawn."""
        names = self.materials * count if len(self.materials) == 1 else self.materials
        return {
            "material": list(names), "camera": self.camera, "show": self.show,
            "options": self.options,
        }  # fmt: skip
