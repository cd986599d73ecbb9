"""A named scene: what it shows, and how to draw it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from harnack.rendering import Camera, render
from harnack.tracer import HitTolerance, Surface

SurfaceFactory = Callable[[], "list[Surface]"]

# Fine enough that no pixel of a demo picture shows it, coarse enough for shadow rays to be quick.
PICTURE_TOLERANCE = HitTolerance(2e-4)


@dataclass(frozen=True)
class Scene:
    """A picture by name, and how to make it.

    surfaces: makes the level sets; materials: one name for each of them (or one for all).
    demo_spp: samples a pixel in `make demo`, 0 for not in it; few, to keep it to a few minutes.
    """

    name: str
    title: str
    surfaces: SurfaceFactory
    materials: tuple[str, ...] = ("two-tone",)
    camera: Camera = field(default_factory=Camera)
    show: str = "path"
    demo_spp: int = 0

    def render(self, path: Any = None, **settings: Any) -> Any:
        """The picture, as `harnack.rendering` makes it; settings override the scene's own."""
        surfaces = self.surfaces()
        return render(surfaces, path, **{**self.settings(len(surfaces)), **settings})

    def settings(self, count: int) -> dict[str, Any]:
        """How `count` surfaces are drawn, as `render` takes it."""
        names = self.materials * count if len(self.materials) == 1 else self.materials
        return {"material": list(names), "camera": self.camera, "show": self.show}
