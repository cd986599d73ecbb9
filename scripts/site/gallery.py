"""Sphinx extension: the directive `scene-gallery`, all scenes of the gallery with their pictures.

It reads the scenes themselves, so a page cannot fall behind them; a scene without a picture is a
warning, which ends the build. `make site-pictures` makes the pictures that are missing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from harnack.gallery import SCENES

LARGE, SMALL = "images/{}.png", "images/gallery/{}.jpg"
_LOG = logging.getLogger(__name__)


class SceneGallery(SphinxDirective):
    """Each scene: its picture, its name, what it is, and the command that draws it."""

    def run(self) -> list[nodes.Node]:
        page = Path(self.get_source_info()[0])
        entries: list[str] = []
        for scene in SCENES.values():
            picture = picture_of(scene.name, page.parent)
            if picture is None:
                _LOG.warning("no picture of the scene %s: run make site-pictures", scene.name)
                continue
            command = f"harnack render {scene.name} -o {scene.name}.png"
            entries.append(
                f"::::{{figure}} {picture}\n:alt: {scene.title}\n:width: 100%\n\n"
                f"**{scene.name}**: {scene.title}\n\n`{command}`\n::::\n"
            )
        return self.parse_text_to_nodes(
            ":::::{container} scenes\n" + "\n".join(entries) + "\n:::::\n"
        )


def picture_of(name: str, docs: Path) -> str | None:
    """The picture of a scene, as a path below docs; None if there is none."""
    paths = (LARGE.format(name), SMALL.format(name))
    return next((path for path in paths if (docs / path).exists()), None)


def setup(app: Any) -> dict[str, bool]:
    app.add_directive("scene-gallery", SceneGallery)
    return {"parallel_read_safe": True}
