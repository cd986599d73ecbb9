"""The constants of shading as a page needs them: as constants of its shaders, and as data for its
scripts. The constants are those of `harnack.rendering`, by the same names: a page shades by the
same formulas, which passes.wgsl has in WGSL, the language of its shaders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from harnack.live.legend_data import FAR_GRAY, NEAR_GRAY, css_color
from harnack.rendering import backdrops, images, scales, shaded_render, shading
from harnack.rendering.aov_render import AOV_BACKGROUNDS, STATUS_COLORS
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.tracer import RayStatus

__all__ = ["scene_shading", "shader_constants"]

# The names of the constants that shaders use, by the module that defines them.
_SHADER_CONSTANTS = (
    (backdrops, ("FLOOR_RADIUS",)),
    (images, ("SHOULDER_START", "SRGB_GAMMA", "SRGB_LINEAR_END", "SRGB_OFFSET", "SRGB_SLOPE")),
    (shaded_render, ("LEAST_SINE", "SKY_REACH", "SKY_SAMPLES")),
    (shading, (
        "FLOOR_CELLS", "FLOOR_HALF_WIDTH", "FLOOR_RAY_LENGTH", "GROUND_IRRADIANCE", "HIGHLIGHT",
        "HIGHLIGHT_EXPONENT", "KEY_HIDDEN", "KEY_IRRADIANCE", "KEY_WRAP", "RAYS_PER_CELL", "RIM",
        "SAMPLE_BLOCK", "SKY_IRRADIANCE", "WALL_DARKENING", "WALL_EXPONENT",
    )),
)  # fmt: skip


def shader_constants() -> str:
    """Return the constants of shading as text in WGSL, one declaration a line."""
    constants: dict[str, Any] = {
        name: getattr(module, name) for module, names in _SHADER_CONSTANTS for name in names
    }
    constants |= {
        "FAR_GRAY": FAR_GRAY, "NEAR_GRAY": NEAR_GRAY, "OUT_OF_STEPS_COLOR": OUT_OF_STEPS_COLOR,
        "HIT_COLOR": STATUS_COLORS[RayStatus.HIT],
    }  # fmt: skip
    lines = [f"const {name} = {_wgsl(value)};\n" for name, value in constants.items()]
    rows = ", ".join(_wgsl(row) for row in scales.VIRIDIS.tolist())
    lines += [f"const VIRIDIS_DEGREE = {len(scales.VIRIDIS) - 1};\n",
              f"const VIRIDIS = array<vec3f, {len(scales.VIRIDIS)}>({rows});\n"]  # fmt: skip
    return "".join(lines)


def _wgsl(value: float | Sequence[float]) -> str:
    """Return an integer, a float or three floats as an expression in WGSL. Integers are unsigned
    there."""
    if isinstance(value, int):
        return f"{value}u"
    if isinstance(value, float):
        return repr(value)
    return f"vec3f({', '.join(map(repr, value))})"


def scene_shading() -> dict[str, Any]:
    """Return the constants of shading that scripts of a page need, as JSON data: `Shading` in
    floor_light.js."""
    return {
        "floor_cells": shading.FLOOR_CELLS,
        "rays_per_cell": shading.RAYS_PER_CELL,
        "sky_direction_count": shaded_render.SKY_DIRECTIONS,
        "key_direction": shading.KEY_DIRECTION.tolist(),
        # The groups of rays, one after the other.
        "key_light_points": shading.key_light_points().reshape(-1, 2).round(9).tolist(),
        "sky_directions": shading.sky_directions().reshape(-1, 3).round(9).tolist(),
        "least_key_height": shading.LEAST_KEY_HEIGHT,
        "blur_weights": shading.BLUR_WEIGHTS.tolist(),
        "reflectance": backdrops.GROUNDS,
        "background": AOV_BACKGROUNDS,
        "css_background": {name: css_color(color) for name, color in AOV_BACKGROUNDS.items()},
    }
