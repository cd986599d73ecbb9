"""One file that opens in any browser, and traces a surface there."""

from __future__ import annotations

import base64
import html
import json
import os
from dataclasses import replace
from importlib import resources
from string import Template
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_vector3
from harnack.files.writing import write_atomically
from harnack.rendering import render
from harnack.rendering.surfaces.framing import visible_points
from harnack.tracer import LevelSet, Tolerance, level_set
from harnack.webgpu import bits_of, data_of, leaves, record

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.fields.field import Field
    from harnack.webgpu import Recording

__all__ = ["page"]

# Rays that travel with a page, and are traced first on the visitor's device.
_RAYS = 2048
_STILL = (640, 480)
# Both sides of the material "two-tone".
_FRONT, _BACK = (0.80, 0.255, 0.11), (0.07, 0.25, 0.40)


def page(
    what: Field | LevelSet, path: str | os.PathLike[str], *, title: str = "", **settings: Any
) -> None:
    """Write one HTML file in which a surface turns under mouse, touch and keys.

    It opens in any browser with WebGPU, without Python and without a network, from https or
    127.0.0.1; elsewhere it shows a still picture and says why. The kernel that Dr.Jit records for
    the surface is in it, translated to WGSL, as it stands: the same proofs on another GPU. Rounding
    is not proved there, so that 2,048 rays with Dr.Jit's answers are in the file, too. They are
    traced first, and if the visitor's device does not agree, nothing of what it says is drawn.

    what: a field, or a `LevelSet` with all its settings.
    path: ends in .html. title: of the page; by default what the field is.
    settings: as `harnack.level_set` takes them: level, clip, tolerance, ... The tolerance is
        by default 1e-4 of the size of the surface.

    Raises:
        ValueError: another extension; a surface without bounds, or a solid.
        UntranslatableError: the kernel holds an operation that is not translated.
        TypeError: what is no field; settings beside a `LevelSet`, which has them already.
    """
    target = os.fspath(path)
    if not target.lower().endswith((".html", ".htm")):
        raise ValueError(f"{target}: a page is written as .html")
    if isinstance(what, LevelSet) and settings:
        raise TypeError(f"{', '.join(settings)}: a LevelSet holds its settings already")
    fits = not isinstance(what, LevelSet) and "tolerance" not in settings
    surface = what if isinstance(what, LevelSet) else level_set(what, **settings)
    if surface.solid is not None:
        raise ValueError("a page draws level sets: leave out solid, and give level")
    surface = surface.in_one_call(begins=True)
    backend = choose_backend("single")
    points = visible_points(surface, backend)
    lower, upper = points.min(axis=0), points.max(axis=0)
    center = 0.5 * (lower + upper)
    radius = float(np.linalg.norm(points - center, axis=1).max())
    if fits:
        surface = replace(surface, tolerance=Tolerance(2e-4 * radius))
    scene = _scene(surface, backend, points, center, radius)
    still: Any = render(surface, show="shaded", size=_STILL, progress=False)
    image = base64.b64encode(still._repr_png_()).decode()
    text = _document(title or repr(surface.field), scene, image)
    with write_atomically(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _scene(
    surface: LevelSet, backend: Backend, points: FloatArray, center: FloatArray, radius: float
) -> dict[str, Any]:
    """What `drawing.js` takes."""
    o, d = _rays(points, center, radius)
    lanes = {"o": to_vector3(backend, o), "d": to_vector3(backend, d)}
    prepared = surface.prepare(backend)
    ends = tuple(dr.opaque(backend.Float, end) for end in (0.0, np.inf))

    def compute(o: Vec3, d: Vec3) -> dict[str, Vec3 | Real]:
        end = prepared.first_hit(o, d, *ends)
        steep = dr.rsqrt(dr.maximum(dr.squared_norm(end.gradient), 1e-37))
        return {"status": end.status, "t": end.t, "normal": end.gradient * steep}

    made = record(compute, lanes, (prepared, ends))
    given = dict(leaves("lane", lanes))
    names = [f"lane {vector} {k}" for vector in "od" for k in range(3)]
    return {
        "code": made.shader.code,
        "data": _text(data_of(made.shader, made.data)),
        "lanes": [names.index(label) for label in made.shader.lanes],
        "results": {
            label.removeprefix("result "): k for k, label in enumerate(made.shader.results)
        },
        "count": _RAYS,
        "center": center.tolist(),
        "radius": radius,
        "front": _FRONT,
        "back": _BACK,
        "tolerance": surface.tolerance.distance,
        "check": {
            "lanes": _text(np.stack([bits_of(given[label]) for label in made.shader.lanes])),
            "status": _text(bits_of(made.results["result status"])),
            "t": _text(bits_of(made.results["result t"])),
            "normal": _text(_normals(made)),
            "count": _RAYS,
        },
    }


def _normals(made: Recording) -> Any:
    return np.stack([bits_of(made.results[f"result normal {k}"]) for k in range(3)])


def _rays(points: FloatArray, center: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """Origins and unit directions (n, 3) of rays from all sides to places near the surface."""
    rng = np.random.default_rng(0)
    away = rng.normal(size=(_RAYS, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    o = center + 5.0 * radius * away
    aims = points[rng.integers(0, len(points), _RAYS)]
    way = aims + 0.05 * radius * rng.normal(size=(_RAYS, 3)) - o
    return o, way / np.linalg.norm(way, axis=1, keepdims=True)


def _text(bits: Any) -> str:
    return base64.b64encode(np.ascontiguousarray(bits).tobytes()).decode()


def _document(title: str, scene: dict[str, Any], still: str) -> str:
    script = resources.files("harnack.view").joinpath("drawing.js").read_text(encoding="utf-8")
    return _PAGE.substitute(
        title=html.escape(title),
        scene=json.dumps(scene).replace("</", "<\\/"),
        script=script.replace("</script", "<\\/script"),
        still=still,
    )


_PAGE = Template("""\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
  :root { color-scheme: light dark; }
  html, body { margin: 0; height: 100%; background: light-dark(#e6e9ee, #101114); }
  canvas, img { position: fixed; inset: 0; width: 100%; height: 100%; }
  canvas { touch-action: none; outline: none; visibility: hidden; }
  canvas:focus-visible { outline: 2px solid #4a7ebb; outline-offset: -2px; }
  img { object-fit: contain; }
  #said { position: fixed; left: 0; bottom: 0; margin: 0; padding: 0.5em 0.8em;
          font: 14px/1.4 system-ui, sans-serif; background: light-dark(#fffc, #000a); }
  #said:empty { display: none; }
</style>
<img id="still" alt="$title" src="data:image/png;base64,$still">
<canvas id="canvas" tabindex="0" role="img"
  aria-label="$title. Drag or use the arrow keys to turn it, the wheel or + and - to come closer."
></canvas>
<p id="said" role="status"></p>
<script type="module">
$script
const canvas = document.getElementById("canvas");
const say = (words, isDrawn = false) => {
  document.getElementById("said").textContent = words;
  canvas.style.visibility = isDrawn ? "visible" : "hidden";
  document.getElementById("still").style.display = isDrawn ? "none" : "";
  document.documentElement.dataset.state = isDrawn ? "drawn" : words ? "said" : "";
};
open($scene, canvas, say).then((drawing) => { window.drawing = drawing; });
</script>
</html>
""")
