"""Draws live scenes on this machine's own processor, for visitors whose device is slower.

The pictures are those of `show="shaded"` with one ray a pixel, by the same formulas. They need no
Mitsuba scene, which takes longer to be put together than a small picture to be traced; and no
kernel is recorded anew for another camera, level, slider or curve of as many vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import to_numpy
from harnack.live.legend_data import FAR_GRAY, HIT_COLOR, NEAR_GRAY, evaluations_share
from harnack.live.live_scene import color_index
from harnack.rendering.backdrops import FLOOR_HEIGHT, reflectance_of
from harnack.rendering.images import SHOULDER_START, linear_to_srgb, to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.scales import viridis
from harnack.rendering.shaded_render import ambient_visibility
from harnack.rendering.shading import FloorShadow, StudioLight

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.rendering.placed_surface import PlacedSurface

__all__ = ["CameraAxes", "Pixels", "Preview", "PreviewRenderer", "PreviewSurface"]

Pixels = npt.NDArray[np.uint8]
_BEHIND = {"light": (0.90, 0.90, 0.89), "dark": (0.10, 0.10, 0.11)}
# How much darker the wall behind the stage is straight above, as in `backdrop`.
_DARKER = 0.45


@dataclass(frozen=True)
class CameraAxes:
    """A camera on the stage.

    origin: (3,) its position.
    right, up, forward: unit vectors (3,).
    pixel: the width of a pixel at distance 1.
    """

    origin: FloatArray
    right: FloatArray
    up: FloatArray
    forward: FloatArray
    pixel: float


@dataclass(frozen=True)
class Preview:
    """A preview picture.

    pixels: (h, w, 4) of sRGB and 255.
    depths: the least and the greatest distance that is seen in a picture of depths, on the stage;
        zeros in other pictures.
    """

    pixels: Pixels
    depths: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class PreviewSurface:
    """A surface on the stage, and its paints (`live_scene.surface_colors`)."""

    placed: PlacedSurface
    paints: Sequence[Mapping[str, Any]]


@dataclass
class PreviewRenderer:
    """Draws surfaces at their places on the stage. While things move it keeps the shadow on the
    floor, and the hits of the last picture, of which only the light is computed again."""

    floor: FloorShadow | None = None
    _hit_cache: tuple[Any, dict[str, Any]] | None = None

    def paint(
        self,
        painted: Sequence[PreviewSurface],
        eye: CameraAxes,
        size: tuple[int, int],
        *,
        show: str,
        ground: str,
        is_idle: bool,
    ) -> Preview:
        """A picture. is_idle: whether nothing moves, so that it pays to trace the shadow on the
        floor anew."""
        mi = register()
        light = StudioLight.of(_matrix(eye))
        has_floor = show == "shaded" and eye.origin[2] > FLOOR_HEIGHT
        numbers = [eye.origin, eye.right, eye.up, eye.forward]
        key = painted, np.ravel(numbers).tolist(), eye.pixel, size, has_floor
        if (
            self._hit_cache is None
            or self._hit_cache[0][0] is not painted
            or self._hit_cache[0][1:] != key[1:]
        ):
            self._hit_cache = key, self._trace(mi, painted, eye, size, has_floor=has_floor)
            dr.eval(self._hit_cache[1])
        hits = self._hit_cache[1]
        if show != "shaded":
            return _aov_preview(hits, show, _BEHIND[ground], size)
        # First: it evaluates, and what is recorded before that makes another kernel of the rest.
        if has_floor and (is_idle or self.floor is None):
            self.floor = FloorShadow.of(_Casting(mi, painted), light)
        width = hits["t"] * eye.pixel * dr.dot(hits["d"], _vector(mi, eye.forward))
        sky = ambient_visibility(mi, hits["position"], hits["normal"], width, size)
        reflectance = reflectance_of(ground)
        color = hits["color"]
        sun: Any = mi.Float(1)
        if self.floor is not None and has_floor:
            sun, above = self.floor.at(hits["position"])
            sun, above = dr.select(hits["ground"], sun, 1), dr.select(hits["ground"], above, 1)
            sky = dr.minimum(sky, above)
            color = dr.select(hits["ground"], _vector(mi, reflectance, mi.Color3f), color)
        lit = light.shade(color, hits["normal"], -hits["d"], hits["glossy"], sky, sun)
        far, z = _vector(mi, reflectance, mi.Color3f), mi.Vector3f(0, 0, 1)
        wall = light.shade(far, z, z, mi.Bool(False), mi.Float(1))
        wall = wall * (1 - _DARKER * dr.power(dr.clip(hits["d"].z, 0, 1), 0.7))
        room = 1 - SHOULDER_START
        bright = 1 - room * dr.exp((SHOULDER_START - lit) / room)
        shown = dr.select(hits["met"], dr.select(lit > SHOULDER_START, bright, lit), wall)
        shown = dr.clip(dr.select(hits["lost"], mi.Color3f(OUT_OF_STEPS_COLOR), shown), 0, 1)
        srgb = dr.select(
            shown <= 0.0031308, 12.92 * shown, 1.055 * dr.power(shown, 1 / 2.4) - 0.055
        )
        red, green, blue = (mi.UInt32(255 * part + 0.5) for part in srgb)
        packed = red | (green << 8) | (blue << 16) | (255 << 24)
        return Preview(to_numpy(packed).astype("<u4").view(np.uint8).reshape(size[1], size[0], 4))

    def _trace(
        self, mi: Any, painted: Sequence[PreviewSurface], eye: CameraAxes, size: tuple[int, int], *,
        has_floor: bool,
    ) -> dict[str, Any]:  # fmt: skip
        """The first hits of the rays through the middles of the pixels, arrays by name."""
        columns, rows = (dr.opaque(mi.UInt32, n) for n in size)
        index = dr.arange(mi.UInt32, size[0] * size[1])
        pixel = dr.opaque(mi.Float, eye.pixel)
        x = (mi.Float(index % columns) + 0.5 - 0.5 * mi.Float(columns)) * pixel
        y = (mi.Float(index // columns) + 0.5 - 0.5 * mi.Float(rows)) * pixel
        d = dr.normalize(
            _vector(mi, eye.forward) + x * _vector(mi, eye.right) - y * _vector(mi, eye.up)
        )
        origin = _vector(mi, eye.origin)
        vector = mitsuba_backend(mi).Array3f
        o = vector(origin) + dr.zeros(vector, dr.width(d))
        t, normal, color = mi.Float(dr.inf), mi.Vector3f(0, 0, 1), mi.Color3f(0)
        glossy, lost, ground = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        if has_floor:
            far = (FLOOR_HEIGHT - origin.z) / dr.minimum(d.z, -1e-9)
            ground = (d.z < 0) & (dr.norm(origin + far * d) < 100.0)
            t = dr.select(ground, far, t)
        evaluations = mi.UInt32(0)
        for surface in painted:
            met = surface.placed.intersect(o, vector(d), mi.Float(dr.inf), mi.Bool(True))
            evaluations += met.evaluations
            lost |= met.is_out_of_steps
            # The floor stands below what was drawn at first: it hides nothing that has moved below.
            nearer = met.is_hit & ~met.is_out_of_steps & (ground | (met.t < t))
            n = mi.Vector3f(met.normal)
            paint_color, shines = _color(mi, surface.paints, color_index(met), dr.dot(n, d) < 0)
            t = dr.select(nearer, met.t, t)
            normal = dr.select(nearer, n, normal)
            color = dr.select(nearer, paint_color, color)
            glossy = dr.select(nearer, shines, glossy)
            ground &= ~nearer
        met = dr.isfinite(t) & ~lost
        return {
            "t": t, "d": d, "normal": dr.mulsign(normal, -dr.dot(normal, d)),
            "position": dr.select(met, origin + t * d, dr.nan), "color": color, "glossy": glossy,
            "met": met, "lost": lost, "ground": ground, "evaluations": evaluations,
            "gradient": normal,
        }  # fmt: skip


@dataclass(frozen=True)
class _Casting:
    """Surfaces that cast shadows on the floor."""

    mi: Any
    painted: Sequence[PreviewSurface]

    def occluded(self, ray: Any, active: Any) -> Any:
        vector = mitsuba_backend(self.mi).Array3f
        is_occluded = self.mi.Bool(False)
        for surface in self.painted:
            is_occluded |= surface.placed.occludes(vector(ray.o), vector(ray.d), ray.maxt, active)
        return is_occluded


def _color(
    mi: Any, paints: Sequence[Mapping[str, Any]], index: Any, in_front: Any
) -> tuple[Any, Any]:
    """For each ray the color of the paint that it meets, and whether that is glossy."""
    color, glossy = mi.Color3f(0), mi.Bool(False)
    for k, paint in enumerate(paints):
        sides = (_vector(mi, paint[name], mi.Color3f) for name in ("front", "back"))
        color = dr.select(index == k, dr.select(in_front, *sides), color)
        glossy = dr.select(index == k, dr.opaque(mi.Bool, paint["glossy"]), glossy)
    return color, glossy


def _vector(mi: Any, numbers: Any, kind: Any = None) -> Any:
    """Three numbers as parameters of kernels, so that other numbers compile no other kernel."""
    return (mi.Vector3f if kind is None else kind)(
        *(dr.opaque(mi.Float, float(x)) for x in numbers)
    )


def _matrix(eye: CameraAxes) -> FloatArray:
    """The camera's axes to the left, up and forwards as columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([-eye.right, eye.up, eye.forward], axis=1)
    return matrix


def _aov_preview(
    hits: dict[str, Any], show: str, behind: Sequence[float], size: tuple[int, int]
) -> Preview:
    """A picture of normals, depths, evaluations or outcomes, as colors."""
    met, lost = to_numpy(hits["met"]), to_numpy(hits["lost"])
    picture, depths = np.empty((len(met), 3)), (0.0, 0.0)
    picture[:] = behind
    if show == "normal":
        picture[met] = 0.5 + 0.5 * to_numpy(hits["gradient"])[met]
    elif show == "depth" and met.any():
        t = to_numpy(hits["t"])[met]
        depths = float(t.min()), float(t.max())
        share = (t - depths[0]) / max(depths[1] - depths[0], 1e-12)
        picture[met] = (NEAR_GRAY + share * (FAR_GRAY - NEAR_GRAY))[:, None]
    elif show == "evaluations":
        picture[:] = viridis(evaluations_share(to_numpy(hits["evaluations"])))
    elif show == "status":
        picture[met] = HIT_COLOR
    picture[lost] = linear_to_srgb(np.array(OUT_OF_STEPS_COLOR))
    opaque = np.column_stack([picture, np.ones(len(picture))])
    return Preview(to_uint8(opaque).reshape(size[1], size[0], 4), depths)
