"""Sphinx extension: the directive `scene-gallery`, all scenes of the gallery with their pictures,
and for each of them a page in which it turns.

It reads the scenes themselves, so a page cannot fall behind them; a scene without a picture is a
warning, which ends the build. `make site-pictures` makes the pictures that are missing. Pages that
turn are made by each build, in minutes, unless they are newer than the library.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util import logging
from sphinx.util.display import status_iterator
from sphinx.util.docutils import SphinxDirective

import harnack
from harnack.gallery import SCENES
from harnack.rendering import MATERIALS

LARGE, SMALL = "images/{}.png", "images/gallery/{}.jpg"
TURNING = "live/{}.html"
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
                f"**{scene.name}**: {scene.title}\n\n`{command}`\n\n"
                f'<a href="{TURNING.format(scene.name)}">Turn it</a>\n::::\n'
            )
        return self.parse_text_to_nodes(
            ":::::{container} scenes\n" + "\n".join(entries) + "\n:::::\n"
        )


def picture_of(name: str, docs: Path) -> str | None:
    """The picture of a scene, as a path below docs; None if there is none."""
    paths = (LARGE.format(name), SMALL.format(name))
    return next((path for path in paths if (docs / path).exists()), None)


def write_turning_pages(app: Any, error: Exception | None) -> None:
    """A page of each scene, below docs, where the gallery is."""
    if error is not None or app.builder.name != "html":
        return
    library = Path(harnack.__file__).parent
    newest = max(path.stat().st_mtime for path in library.rglob("*.*") if path.suffix != ".pyc")
    for name in status_iterator([*SCENES], "pages that turn... ", length=len(SCENES)):
        target = Path(app.outdir, "docs", TURNING.format(name))
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and target.stat().st_mtime > newest:
            continue
        scene = SCENES[name]
        surfaces = scene.surfaces()
        settings = {**scene.settings(len(surfaces)), "show": "shaded"}
        if any(MATERIALS[one].transparent for one in scene.materials):
            settings["material"] = "clay"  # what turns is opaque
        harnack.page(surfaces, target, title=scene.title, progress=False, **settings)


def setup(app: Any) -> dict[str, bool]:
    app.connect("build-finished", write_turning_pages)
    app.add_directive("scene-gallery", SceneGallery)
    return {"parallel_read_safe": True}
