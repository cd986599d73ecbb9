"""Make the pictures of the site that are missing: of scenes and of examples.

Delete one to have it made anew. Those that the README shows are made by `make images`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from gallery import SMALL, picture_of
from PIL import Image

from harnack.gallery import SCENES

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
EXAMPLES = DOCS / "images" / "examples"
_SIZE = (480, 360)
_QUALITY = 88


def main() -> None:
    for name in SCENES:
        if picture_of(name, DOCS) is None:
            print(name, flush=True)
            draw_scene(name, DOCS / SMALL.format(name))
    for script in sorted((ROOT / "examples").glob("*.py")):
        if not list(EXAMPLES.glob(f"{script.stem}.*")):
            print(script.name, flush=True)
            run_example(script)


def draw_scene(name: str, path: Path) -> None:
    """The scene, shaded unless it shows what rays found."""
    scene = SCENES[name]
    show = "shaded" if scene.show == "path" else scene.show
    picture = scene.render(show=show, size=_SIZE, progress=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.to_pil().convert("RGB").save(path, quality=_QUALITY)


def run_example(script: Path) -> None:
    """What the example draws, films as they are and pictures as small files."""
    EXAMPLES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, str(script), folder], check=True)
        for film in Path(folder).glob("*.gif"):
            (EXAMPLES / f"{script.stem}.gif").write_bytes(film.read_bytes())
        for picture in Path(folder).glob("*.png"):
            image = Image.open(picture).convert("RGB")
            image.thumbnail((640, 480))
            image.save(EXAMPLES / f"{script.stem}.jpg", quality=_QUALITY)


if __name__ == "__main__":
    main()
