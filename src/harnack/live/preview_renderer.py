"""Draws live scenes on the processor of the machine that runs Python, for visitors whose own device
is slower. A preview is such a picture: `show="shaded"` with one ray per pixel, by the same
formulas, or the colors of numbers that rays found. The stage is the scaled world in which surfaces
stand on a floor. `mi` is the Mitsuba module.

Previews need no Mitsuba scene, whose setup takes longer than tracing a small picture. Cameras,
levels, slider values and vertices are parameters of the kernels, so that changing them compiles no
new kernel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import to_numpy
from harnack.live.legend_data import FAR_GRAY, NEAR_GRAY, evaluations_share
from harnack.live.live_scene import color_index
from harnack.rendering.aov_render import AOV_BACKGROUNDS, STATUS_COLORS
from harnack.rendering.backdrops import FLOOR_HEIGHT, FLOOR_RADIUS, reflectance_of
from harnack.rendering.images import compress_highlights, linear_to_srgb, to_uint8
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.mitsuba_plugins import register
from harnack.rendering.scales import viridis
from harnack.rendering.shaded_render import ambient_visibility
from harnack.rendering.shading import FloorShadow, StudioLight, wall_brightness
from harnack.tracer import RayStatus

if TYPE_CHECKING:
    from harnack.backend import FloatArray
    from harnack.rendering.placed_surface import PlacedSurface

__all__ = ["CameraAxes", "Pixels", "Preview", "PreviewRenderer", "PreviewSurface"]

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class CameraAxes:
    """A camera on the stage (the scaled world in which surfaces stand on a floor).

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

    pixels: (h, w, 4) of bytes: sRGB and opacity 255.
    depths: the least and the greatest distance to the camera among the hits of a picture of depths,
        in units of the stage; zeros in other pictures.
    """

    pixels: Pixels
    depths: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class PreviewSurface:
    """A surface on the stage (the scaled world, with a floor), and its colors `paints`: for the
    surface itself, fillings of holes, cut faces, and isolines, as `live_scene.surface_colors`
    returns them."""

    placed: PlacedSurface
    paints: Sequence[Mapping[str, Any]]


@dataclass
class PreviewRenderer:
    """Draws surfaces on the stage (the scaled world, with a floor) as preview pictures. It keeps
    the shadow on the floor while things move, and the hits of the last picture for a picture of the
    same surfaces, camera and size."""

    floor: FloorShadow | None = None
    # Of the last picture alone, as hits take much memory.
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
        """Draw a picture of w x h pixels.

        painted: the surfaces. The hits of the last picture are used again if this is the same list
            object and nothing else has changed.
        eye: the camera on the stage.
        size: (w, h) in pixels.
        show: one of `LIVE_MODES`, such as "shaded" or "depth".
        ground: "light" or "dark", the kind of floor and background.
        is_idle: whether nothing moves. Only then is an existing shadow on the floor computed anew.
        """
        mi = register()
        light = StudioLight.of(_matrix(eye))
        has_floor = show == "shaded" and eye.origin[2] > FLOOR_HEIGHT
        camera_vectors = [eye.origin, eye.right, eye.up, eye.forward]
        cache_key = painted, np.ravel(camera_vectors).tolist(), eye.pixel, size, has_floor
        # The first entry of the key, the list of surfaces, is compared by identity.
        if (
            self._hit_cache is None
            or self._hit_cache[0][0] is not painted
            or self._hit_cache[0][1:] != cache_key[1:]
        ):
            self._hit_cache = cache_key, self._trace(mi, painted, eye, size, has_floor=has_floor)
            dr.eval(self._hit_cache[1])
        hits = self._hit_cache[1]  # the cache is a pair (key, hits)
        if show != "shaded":
            return _aov_preview(hits, show, AOV_BACKGROUNDS[ground], size)
        # The shadow is computed first: it evaluates arrays, and whatever was recorded before
        # would then be evaluated separately.
        if has_floor and (is_idle or self.floor is None):
            self.floor = FloorShadow.of(_Casting(mi, painted), light)
        # The width of a pixel at the hit: that at distance 1 (`eye.pixel`), times the hit's
        # distance in the direction of view.
        width = hits["t"] * eye.pixel * dr.dot(hits["d"], _vector(mi, eye.forward))
        sky = ambient_visibility(mi, hits["position"], hits["normal"], width, size)
        reflectance = reflectance_of(ground)
        color = hits["color"]
        key_fraction: Any = mi.Float(1)
        if self.floor is not None and has_floor:
            key_fraction, floor_visibility = self.floor.at(hits["position"])
            key_fraction, floor_visibility = (
                dr.select(hits["ground"], key_fraction, 1),
                dr.select(hits["ground"], floor_visibility, 1),
            )
            sky = dr.minimum(sky, floor_visibility)
            color = dr.select(hits["ground"], _vector(mi, reflectance, mi.Color3f), color)
        light_at_hits = light.shade(
            color, hits["normal"], -hits["d"], hits["glossy"], sky, key_fraction
        )
        floor_color, z = _vector(mi, reflectance, mi.Color3f), mi.Vector3f(0, 0, 1)
        # The wall has the color of the floor far away, and is darker higher up.
        wall = light.shade(floor_color, z, z, mi.Bool(False), mi.Float(1))
        wall = wall * wall_brightness(dr.clip(hits["d"].z, 0, 1))
        linear = dr.select(hits["met"], compress_highlights(light_at_hits, dr.select, dr.exp), wall)
        linear = dr.clip(dr.select(hits["lost"], mi.Color3f(OUT_OF_STEPS_COLOR), linear), 0, 1)
        srgb = linear_to_srgb(linear, dr.select)
        red, green, blue = (mi.UInt32(255 * part + 0.5) for part in srgb)
        # In little-endian order the bytes of a word are red, green, blue and opacity.
        packed = red | (green << 8) | (blue << 16) | (255 << 24)
        return Preview(to_numpy(packed).astype("<u4").view(np.uint8).reshape(size[1], size[0], 4))

    def _trace(
        self, mi: Any, painted: Sequence[PreviewSurface], eye: CameraAxes, size: tuple[int, int], *,
        has_floor: bool,
    ) -> dict[str, Any]:  # fmt: skip
        """Trace the rays of the camera `eye` through the middles of the pixels, row by row, to the
        surfaces `painted` and the floor. Returns Dr.Jit arrays by name, with a lane for each pixel.

        has_floor: whether the floor is drawn.

        - "t", "d", "position": distance, unit direction and position of the nearest hit.
        - "normal", "gradient": the unit normal toward the camera, and the unit normal toward larger
          values.
        - "color", "glossy": the color of the hit surface, and whether it is glossy.
        - "met", "lost", "ground": whether the ray hits something, runs out of steps, or hits the
          floor.
        - "evaluations": the number of evaluations of all surfaces' fields.
        """
        columns, rows = (dr.opaque(mi.UInt32, side) for side in size)
        index = dr.arange(mi.UInt32, size[0] * size[1])
        # The width of a pixel at distance 1; then x to the right and y down from the middle there.
        pixel = dr.opaque(mi.Float, eye.pixel)
        x = (mi.Float(index % columns) + 0.5 - 0.5 * mi.Float(columns)) * pixel
        y = (mi.Float(index // columns) + 0.5 - 0.5 * mi.Float(rows)) * pixel
        d = dr.normalize(
            _vector(mi, eye.forward) + x * _vector(mi, eye.right) - y * _vector(mi, eye.up)
        )
        origin = _vector(mi, eye.origin)
        vector = mitsuba_backend(mi).Array3f
        # Adding zeros gives the origins the width of the directions.
        o = vector(origin) + dr.zeros(vector, dr.width(d))
        # The nearest hit so far: the floor, if the ray goes down to it.
        t, normal, color = mi.Float(dr.inf), mi.Vector3f(0, 0, 1), mi.Color3f(0)
        glossy, lost, ground = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        if has_floor:
            # Rays that do not go down are left out by `ground`; for them, the divisor is not 0.
            t_floor = (FLOOR_HEIGHT - origin.z) / dr.minimum(d.z, -1e-9)
            ground = (d.z < 0) & (dr.norm(origin + t_floor * d) < FLOOR_RADIUS)
            t = dr.select(ground, t_floor, t)
        evaluations = mi.UInt32(0)
        for surface in painted:
            met = surface.placed.intersect(o, vector(d), mi.Float(dr.inf), mi.Bool(True))
            evaluations += met.evaluations
            lost |= met.is_out_of_steps
            # The floor was placed below what was drawn at first. A surface that has moved below it
            # since is drawn nevertheless.
            nearer = met.is_hit & ~met.is_out_of_steps & (ground | (met.t < t))
            surface_normal = mi.Vector3f(met.normal)
            paint_color, paint_is_glossy = _color(
                mi, surface.paints, color_index(met), dr.dot(surface_normal, d) < 0
            )
            t = dr.select(nearer, met.t, t)
            normal = dr.select(nearer, surface_normal, normal)
            color = dr.select(nearer, paint_color, color)
            glossy = dr.select(nearer, paint_is_glossy, glossy)
            ground &= ~nearer
        # From here on, `met` is the mask of rays that hit something.
        met = dr.isfinite(t) & ~lost
        return {
            "t": t, "d": d, "normal": dr.mulsign(normal, -dr.dot(normal, d)),
            "position": dr.select(met, origin + t * d, dr.nan), "color": color, "glossy": glossy,
            "met": met, "lost": lost, "ground": ground, "evaluations": evaluations,
            "gradient": normal,
        }  # fmt: skip


@dataclass(frozen=True)
class _Casting:
    """The surfaces that cast shadows on the floor, in the form that `FloorShadow.of` takes. mi:
    Mitsuba's module."""

    mi: Any
    painted: Sequence[PreviewSurface]

    def occluded(self, ray: Any, active: Any) -> Any:
        """Return for each Mitsuba ray whether some surface lies between the ray's origin and its
        end; False for lanes that are not active."""
        vector = mitsuba_backend(self.mi).Array3f
        is_occluded = self.mi.Bool(False)
        for surface in self.painted:
            is_occluded |= surface.placed.occludes(vector(ray.o), vector(ray.d), ray.maxt, active)
        return is_occluded


def _color(
    mi: Any, paints: Sequence[Mapping[str, Any]], index: Any, in_front: Any
) -> tuple[Any, Any]:
    """Return for each ray the color of the surface that it hits, and whether that surface is
    glossy.

    paints: the colors of the surface, as `live_scene.surface_colors` returns them.
    index: the index in `paints` for each ray.
    in_front: whether each ray comes from the side of larger values.
    """
    color, glossy = mi.Color3f(0), mi.Bool(False)
    for k, paint in enumerate(paints):
        sides = (_vector(mi, paint[name], mi.Color3f) for name in ("front", "back"))
        color = dr.select(index == k, dr.select(in_front, *sides), color)
        glossy = dr.select(index == k, dr.opaque(mi.Bool, paint["glossy"]), glossy)
    return color, glossy


def _vector(mi: Any, numbers: Any, kind: Any = None) -> Any:
    """Return three numbers as a vector of type `kind` (by default Vector3f) whose entries are
    parameters of kernels, so that other numbers use the same kernel."""
    return (mi.Vector3f if kind is None else kind)(
        *(dr.opaque(mi.Float, float(x)) for x in numbers)
    )


def _matrix(eye: CameraAxes) -> FloatArray:
    """Return the 4 x 4 matrix whose first three columns are the camera's unit vectors to the left,
    up and forward."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([-eye.right, eye.up, eye.forward], axis=1)
    return matrix


def _aov_preview(
    hits: dict[str, Any], show: str, behind: Sequence[float], size: tuple[int, int]
) -> Preview:
    """Return a picture whose colors stand for numbers: normals, depths, numbers of evaluations, or
    outcomes of rays (`show` = "normal", "depth", "evaluations", "status").

    hits: the result of `PreviewRenderer._trace`.
    behind: sRGB of rays that hit nothing, three numbers from 0 to 1.
    size: (w, h) in pixels.
    """
    met, lost = to_numpy(hits["met"]), to_numpy(hits["lost"])
    picture, depths = np.empty((len(met), 3)), (0.0, 0.0)
    picture[:] = behind
    if show == "normal":
        picture[met] = 0.5 + 0.5 * to_numpy(hits["gradient"])[met]
    elif show == "depth" and met.any():
        t = to_numpy(hits["t"])[met]
        depths = float(t.min()), float(t.max())
        # The divisor has a lower limit, for hits that all have the same depth.
        share = (t - depths[0]) / max(depths[1] - depths[0], 1e-12)
        picture[met] = (NEAR_GRAY + share * (FAR_GRAY - NEAR_GRAY))[:, None]
    elif show == "evaluations":
        picture[:] = viridis(evaluations_share(to_numpy(hits["evaluations"])))
    elif show == "status":
        picture[met] = STATUS_COLORS[RayStatus.HIT]
    # Rays out of steps are magenta in all pictures.
    picture[lost] = linear_to_srgb(np.array(OUT_OF_STEPS_COLOR))
    opaque = np.column_stack([picture, np.ones(len(picture))])
    return Preview(to_uint8(opaque).reshape(size[1], size[0], 4), depths)
