"""Shaded pictures: one ray a pixel, more rays at edges, and no noise.

The rays through the middles of all pixels are traced first. Two kinds of pixels are then drawn
again, as the mean of a fixed grid of samples: pixels that differ visibly from a neighbor, and
pixels through which the edge of an isoline may pass. So outlines are smooth, lines thinner than a
pixel have no gaps, and the inside of a surface costs one ray a pixel. If requested, cones around
the rays find more pixels to draw again: those that a surface covers in part although no ray through
a middle hits it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import FloatArray, IntArray, choose_backend, to_numpy, upload_floats
from harnack.fields import Solid
from harnack.rendering.hybrid_scene import HybridScene
from harnack.rendering.images import tone_map
from harnack.rendering.integrator import OUT_OF_STEPS_COLOR
from harnack.rendering.light_paths import RefractionTracer, as_rgb, mean_of_blocks
from harnack.rendering.mitsuba import mitsuba_backend
from harnack.rendering.placed_surface import PlacedSurface
from harnack.rendering.shading import (
    FloorShadow,
    StudioLight,
    edge_pixels,
    film_positions,
    hole_filling_tint,
    multijitter_offsets,
    reflectance,
    tiled_pixel_order,
    two_sided_color,
    upload_indices,
)

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume
    from harnack.rendering.shading import RenderExecutor


class ConeCoverage:
    """Finds pixels that surfaces may cover in part, by a cone around the ray through each pixel's
    middle.

    The ray mostly misses parts of a surface that are thinner than the pixel, and so do the rays of
    the neighbors. The cone contains the whole pixel, so it does not miss them.

    Raises:
        ValueError: the field of a surface jumps, such as the winding number of a mesh. It is nearly
            constant on both sides of the surface, so its values tell no distance.
    """

    def __init__(self, mi: Any, world: HybridScene) -> None:
        self.mi = mi
        self.placed = tuple(_prepared(mi, carrier) for carrier in world.proxies)

    def partly_covered(self, ray: Any, position: Any) -> Any:
        """Mask of pixels whose cones are covered in part, before the points that their rays hit.

        ray: the rays through the middles, with differentials.
        position: (3,) the points that they hit; NaN for no hit.
        """
        mi = self.mi
        distance = dr.norm(position - ray.o)
        t = dr.select(dr.isfinite(distance), distance, dr.largest(mi.Float))
        x, y = ray.d_x - ray.d, ray.d_y - ray.d
        radius = 0.5 * dr.maximum(dr.norm(x + y), dr.norm(x - y))  # half the longer diagonal
        is_covered = dr.zeros(mi.Bool, dr.width(ray.d))
        for placed, balls in self.placed:
            is_covered |= placed.covers_in_part(ray.o, ray.d, radius, t, balls)
        return is_covered


def _prepared(mi: Any, carrier: Any) -> tuple[PlacedSurface, Any]:
    """The surface of a proxy (the mesh that stands for it in Mitsuba), prepared for cones; and a
    ball inside its extent and a ball around its extent, as `inner_and_outer_ball` returns them."""
    surface, backend = carrier.surface, mitsuba_backend(mi)
    if surface.field.has_patches:
        raise ValueError(
            f'antialias="cones" takes a level set of one function, and {surface.field!r} has one '
            'for each part. Leave antialias at "edges"'
        )
    if surface.field.has_jumps:
        raise ValueError(
            f'antialias="cones" takes fields without jumps, and {surface.field!r} jumps: its '
            'values tell no distance. Leave antialias at "edges"'
        )
    placed = replace(carrier.placed, prepared=surface.prepare(backend, crosses=True))
    return placed, inner_and_outer_ball(surface.volume, backend)


def inner_and_outer_ball(volume: Volume | None, backend: Backend) -> tuple[Vec3, Real, Real] | None:
    """The middle (3,) of a volume's box, the radius of a ball about it that lies inside the volume,
    and the radius of a ball about it that contains the volume. None if the volume is unbounded or
    no inner ball was found."""
    if volume is None:
        return None
    lower, upper = (np.asarray(end, dtype=np.float64) for end in volume.bounds())
    if not np.isfinite(upper - lower).all():
        return None
    middle = (0.5 * (lower + upper)).tolist()
    # Not half the box: other volumes have faces that lie nearer to its middle.
    center = choose_backend("double").Array3f(*middle)
    depth = -float(to_numpy(volume.signed_distance(center))[0]) * (1 - 1e-6)
    if not depth > 0:
        return None
    size = 0.5 * float(np.linalg.norm(upper - lower))
    numbers = [dr.opaque(backend.Float, x) for x in (*middle, depth, size)]
    return backend.Array3f(*numbers[:3]), numbers[3], numbers[4]


# The number of directions across the picture, and of taps along each; and the length that they
# cover, as a fraction of the larger side of the picture.
_DIRECTIONS = 16
_TAPS = 8
_REACH = 0.16


def ambient_visibility(
    mi: Any, position: Any, normal: Any, width: Any, size: tuple[int, int]
) -> Any:
    """The fraction of the hemisphere over each pixel's point that nothing near it hides, in [0, 1].

    position: (3,) points seen by the pixels, counted by rows; NaN where nothing is seen.
    normal: (3,) unit normals there, towards the eye.
    width: the width of a pixel there.
    size: (width, height) of the picture in pixels.

    Along each of 16 directions across the picture, the points seen by a few pixels are examined.
    The one with the highest elevation h over the tangent plane hides sin^2 h of the light, weighted
    by the cosine (Bavoil and Sainz 2008); it counts less the farther away it is. Only what the
    picture shows can hide light. The directions are the same at all pixels, so there is no noise.
    """
    columns, rows = size
    count = columns * rows
    index = dr.arange(mi.UInt32, count)
    x, y = mi.Float(index % columns), mi.Float(index // columns)
    reach = _REACH * max(size)
    radius = reach * width

    def tap(k: int, direction: Any) -> Any:
        """The sine of the elevation of the k-th point along a direction, multiplied by a factor
        that falls with its distance; 0 if nothing is seen there."""
        distance = 1.0 + reach * ((k + 0.5) / _TAPS) ** 2
        u, v = x + distance * direction.x, y + distance * direction.y
        inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        pixel = mi.UInt32(dr.round(v)) * columns + mi.UInt32(dr.round(u))
        offset = dr.gather(mi.Vector3f, position, pixel, inside) - position
        length = dr.norm(offset)
        fade = dr.maximum(1 - dr.square(length / radius), 0)
        height = dr.dot(offset, normal) / length - 0.06  # facets and rounding stay below that
        return dr.select(inside & (height > 0), height * fade, 0)

    def add_direction(turn: Any, hidden: Any) -> tuple[Any, Any]:
        """The index of the next direction, and the sum of hidden fractions with this direction
        added."""
        s, c = dr.sincos((mi.Float(turn) + 0.5) * (dr.two_pi / _DIRECTIONS))
        highest = mi.Float(0)
        for k in range(_TAPS):
            highest = dr.maximum(highest, tap(k, mi.Vector2f(c, s)))
        return turn + 1, hidden + dr.square(highest)

    def is_running(turn: Any, hidden: Any) -> Any:
        del hidden
        return turn < _DIRECTIONS

    start = (mi.UInt32(0), dr.zeros(mi.Float, count))
    _, hidden = dr.while_loop(start, is_running, add_direction, label="visible sky")
    return 1 - hidden / _DIRECTIONS


# Rays of one band.
_RAYS_A_BAND = 2**17
# The coordinates in its pixel of the first ray.
_MIDDLE = 0.5
# The estimated fraction of the time that is spent on the first rays, for the progress bar.
_FIRST_PASS_FRACTION = 0.6


@dataclass
class GBuffer:
    """The first opaque hit of the ray of each pixel, seen through transparent solids.

    position, normal, eye: (3,) the point, its unit normal toward the eye, and the unit direction to
        the eye.
    width: the width of a pixel at the point.
    color: (3,) reflectance.
    light: (3,) the light that does not come from shading the point: emitted there, from the
        environment, or reflected by transparent solids; magenta for rays out of steps.
    transmittance: (3,) of the transparent solids in front.
    glossy: whether the material is glossy.
    met, lost: whether there is a hit, and whether the ray ran out of steps.
    covered: whether anything but the environment is visible.
    needs_refinement: whether the pixel is to be drawn again, since the edge of an isoline may cross
        it or a cone found it partly covered.
    """

    position: Any
    normal: Any
    eye: Any
    width: Any
    color: Any
    light: Any
    transmittance: Any
    glossy: Any
    met: Any
    lost: Any
    covered: Any
    needs_refinement: Any

    @classmethod
    def nothing(cls, mi: Any, count: int) -> GBuffer:
        """Arrays of zeros for `count` pixels, which parts are scattered to."""
        vectors, colors, masks = (mi.Vector3f,) * 3, (mi.Color3f,) * 3, (mi.Bool,) * 5
        kinds = (*vectors, mi.Float, *colors, *masks)
        return cls(*(dr.zeros(kind, count) for kind in kinds))

    def to_numpy(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays of this buffer as NumPy arrays, by name."""
        return {name: to_numpy(value) for name, value in vars(self).items()}

    @classmethod
    def from_numbers(cls, mi: Any, numbers: Mapping[str, npt.NDArray[Any]]) -> GBuffer:
        """The buffer whose arrays `to_numpy` returned, in this process or another."""
        empty = vars(cls.nothing(mi, 0))
        return cls(
            **{name: _of_numbers(mi, type(kind), numbers[name]) for name, kind in empty.items()}
        )


def _of_numbers(mi: Any, kind: Any, numbers: npt.NDArray[Any]) -> Any:
    """A Dr.Jit array of type `kind`, from numbers (n,) or (n, 3). It is uploaded such that kernels
    do not depend on its alignment in memory."""
    if dr.is_mask_v(kind):
        return kind(np.ascontiguousarray(numbers))
    columns = numbers.reshape(len(numbers), -1).T
    return kind(*(upload_floats(mitsuba_backend(mi), column) for column in columns))


class ShadedTask:
    """The rendering of a shaded picture for a sensor, by ranges of pixels.

    spp: at least this many rays are averaged for a pixel at an edge; with 1, every pixel has a
        single ray.
    on_floor: whether the scene is a studio's, whose floor shows shadows.
    cut_out: whether to leave out the light of the backdrop behind all objects.
    cones: whether cones find pixels to draw again, besides edges in the picture.

    Raises:
        ValueError: the Mitsuba variant is spectral, whose four wavelengths a ray do not give a
            color; or cones are requested for a field that jumps.
    """

    def __init__(
        self, mi: Any, scene: Any, sensor: Any, *, spp: int, on_floor: bool,
        cut_out: bool = False, cones: bool = False,
    ) -> None:  # fmt: skip
        if mi.is_spectral:
            raise ValueError(
                "shaded pictures know red, green and blue, and the Mitsuba variant is "
                f'{mi.variant()}: set one such as "llvm_ad_rgb", or draw in color'
            )
        world = HybridScene.of(mi, scene)
        self.mi, self.world, self.sensor, self.cut_out = mi, world, sensor, cut_out
        width, height = (int(n) for n in sensor.film().crop_size())
        self.size = (width, height)
        self.order = tiled_pixel_order(self.size)
        self.finder = ConeCoverage(mi, world) if cones else None
        offsets = multijitter_offsets(spp)
        traced = (offsets == _MIDDLE).all(axis=1)  # the offset of a pixel's first ray
        self.offsets, self.share_of_first = offsets[~traced], float(traced.mean())
        self.refines = spp > 1
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        self.light = StudioLight.of(matrix)
        self.evaluate_with = RefractionTracer(world, self.light, hides_lights=cut_out)
        self.floor = FloorShadow.of(world, self.light) if on_floor else None

    def render_gbuffer(self, start: int, stop: int) -> GBuffer:
        """The `GBuffer` of the pixels from `start` to `stop` in the order of the attribute `order`,
        by rays through their middles."""
        mi = self.mi
        pixel = upload_indices(mi, self.order[start:stop])
        gbuffer = self._trace_pixels(pixel, mi.Vector2f(_MIDDLE))
        dr.eval(gbuffer)
        if self.finder is not None:
            ray, _ = self.ray(pixel, mi.Vector2f(_MIDDLE))
            gbuffer.needs_refinement |= self.finder.partly_covered(ray, gbuffer.position)
            dr.eval(gbuffer)
        return gbuffer

    def _trace_pixels(self, pixel: Any, offset: Any) -> GBuffer:
        """The `GBuffer` of rays through one point in each of n pixels.

        pixel: (n,) indices of the pixels, counted by rows.
        offset: the coordinates in [0, 1) of the point in its pixel.
        """
        mi, scene = self.mi, self.world.scene
        ray, weight = self.ray(pixel, offset)
        hits = self.evaluate_with.trace(mi.Ray3f(ray))
        si, first = hits.si, hits.first
        lost = first.is_out_of_steps | dr.zeros(mi.Bool, dr.width(pixel))
        hit = first.is_hit & ~lost
        inside, is_open = si.wi.z > 0, self._is_open(si)
        color, back = (self._reflectance(si, side) * weight for side in (1, -1))
        color, back = (as_rgb(mi, c, ray.wavelengths) for c in (color, back))
        painted = first.isoline_index > 0
        color, back = reflectance(color, painted), reflectance(back, painted)
        plain = ~painted  # lines have their own color
        color = two_sided_color(color, back, inside & is_open & plain)
        color = hole_filling_tint(color, first.is_hole_filling & plain)
        emitted = si.emitter(scene).eval(si, ~lost) * weight
        light = as_rgb(
            mi, hits.throughput * emitted + weight * hits.reflected_light, ray.wavelengths
        )
        light = dr.select(lost, mi.Color3f(OUT_OF_STEPS_COLOR), light)
        covered = hit | lost | (hits.interface_count > 1)  # transparent solids cover, too
        if self.cut_out:
            light = dr.select(covered, light, 0)
        transmittance = as_rgb(mi, hits.throughput, ray.wavelengths)
        d = hits.ray.d
        normal = mi.Vector3f(dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, d)))
        t = dr.select(hit, hits.path_length + first.t, 0)
        width = dr.norm(ray.o_x + t * ray.d_x - ray.o - t * ray.d)
        flags = si.bsdf().flags()
        glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy) | mi.has_flag(flags, mi.BSDFFlags.Delta)
        glossy &= plain
        near = hit & self.world.has_line_near(si, ray, d, t)
        position = dr.select(hit, mi.Vector3f(si.p), dr.nan)
        return GBuffer(
            position,
            normal,
            -d,
            width,
            color,
            light,
            transmittance,
            glossy,
            hit,
            lost,
            covered,
            near,
        )

    def ray(self, pixel: Any, offset: Any) -> tuple[Any, Any]:
        """Rays with differentials through one point in each pixel, and the weights of their light.
        pixel: indices, counted by rows. offset: coordinates in [0, 1) of the point in its pixel."""
        mi = self.mi
        position = film_positions(mi, pixel, offset, self.size)
        return self.sensor.sample_ray_differential(
            self.sensor.shutter_open(), 0.5, position, mi.Point2f(0.5)
        )

    def _reflectance(self, si: Any, side: int) -> Any:
        """The reflectance at normal incidence of the visible side (1) or the other side (-1) of the
        surface at interactions `si`."""
        mi = self.mi
        straight = mi.SurfaceInteraction3f(si)
        straight.wi = mi.Vector3f(0, 0, dr.mulsign(mi.Float(side), si.wi.z))
        return si.bsdf().eval_diffuse_reflectance(straight, si.is_valid())

    def _is_open(self, si: Any) -> Any:
        """Mask of interactions with a level set of harnack that bounds no solid, so that both of
        its sides can be seen."""
        is_open = self.mi.Bool(False)
        for carrier in self.world.proxies:
            surface = carrier.surface
            if surface.solid_range is None and not isinstance(surface.field, Solid):
                is_open |= si.shape == self.mi.ShapePtr(carrier)
        return is_open

    def shade(self, buffer: GBuffer, sky: Any) -> Any:
        """The radiance of each pixel towards the eye, and as fourth number 1 if anything but the
        environment is visible, else 0.

        sky: the fraction of the hemisphere over the pixel's point that nothing near it hides.
        """
        key = 1.0
        if self.floor is not None:
            key, above = self.floor.at(buffer.position)
            sky = dr.minimum(sky, above)
        lit = self.light.shade(buffer.color, buffer.normal, buffer.eye, buffer.glossy, sky, key)
        light = dr.select(buffer.met, buffer.transmittance * lit, 0) + buffer.light
        return self.mi.Vector4f(*light, dr.select(buffer.covered, self.mi.Float(1), 0))

    def refine_pixels(
        self, indices: IntArray, position: FloatArray, sky: FloatArray
    ) -> tuple[npt.NDArray[np.float32], int]:
        """The mean colors (n, 4) of a grid of samples in each of n pixels, and the number of
        samples that ran out of steps.

        indices: (n,) the pixels, counted by rows.
        position, sky: (n, 5, 3) and (n, 5), the points seen by each pixel and its four neighbors,
            and the fractions of the hemisphere there that nothing hides (`neighborhood`).
        """
        mi, spp = self.mi, len(self.offsets)
        lane = dr.arange(mi.UInt32, len(indices) * spp)
        per_pixel = dr.opaque(mi.UInt32, spp)
        pixel = dr.gather(mi.UInt32, upload_indices(mi, indices), lane // per_pixel)
        table = mi.Vector2f(*(upload_floats(mitsuba_backend(mi), axis) for axis in self.offsets.T))
        gbuffer = self._trace_pixels(pixel, dr.gather(mi.Vector2f, table, lane % per_pixel))
        color = self.shade(gbuffer, _nearest_sky(mi, gbuffer, lane // per_pixel, position, sky))
        dr.eval(color, gbuffer.lost)
        return to_numpy(mean_of_blocks(color, spp)), int(dr.count(gbuffer.lost)[0])

    def neighborhood(self, indices: IntArray, *arrays: Any) -> tuple[npt.NDArray[Any], ...]:
        """The entries (n, 5, ...) of arrays at n pixels and their four neighbors. At the picture's
        border, a pixel takes the place of a missing neighbor.

        indices: (n,) the pixels. The arrays have an entry for each pixel of the picture. Both are
            counted by rows.
        """
        columns, rows = self.size
        x, y = indices % columns, indices // columns
        u = np.clip(x[:, None] + np.array([0, 1, -1, 0, 0]), 0, columns - 1)
        v = np.clip(y[:, None] + np.array([0, 0, 0, 1, -1]), 0, rows - 1)
        rows_of_five = upload_indices(self.mi, (v * columns + u).ravel())
        gathered = [to_numpy(dr.gather(type(array), array, rows_of_five)) for array in arrays]
        return tuple(array.reshape(len(indices), 5, *array.shape[1:]) for array in gathered)


def _nearest_sky(mi: Any, samples: GBuffer, row: Any, position: FloatArray, sky: FloatArray) -> Any:
    """For each sample, the fraction of the hemisphere that nothing hides. It is taken from that
    pixel, of the sample's pixel and its neighbors, whose point lies nearest to the sample's point.

    row: the index of the sample's pixel among the n chosen pixels.
    position, sky: (n, 5, 3) and (n, 5), the points of the chosen pixels and their neighbors, and
        the fractions there.
    """
    nearest, value = mi.Float(dr.inf), mi.Float(1)
    for k in range(position.shape[1]):
        point = dr.gather(mi.Vector3f, _of_numbers(mi, mi.Vector3f, position[:, k]), row)
        length = dr.norm(point - samples.position)
        closer = length < nearest  # not where NaN: nothing is there
        nearest = dr.select(closer, length, nearest)
        value = dr.select(
            closer, dr.gather(mi.Float, _of_numbers(mi, mi.Float, sky[:, k]), row), value
        )
    return value


def render_shaded(
    shading: ShadedTask, executor: RenderExecutor, advance: Callable[[float], None]
) -> tuple[npt.NDArray[np.float32], int]:
    """The image (h, w, 4), linear sRGB radiance and last the covered fraction, and the number of
    rays that ran out of steps.

    shading: the task. executor: calls its methods, here or on a cluster.
    advance: called with the fraction of the picture that has been finished since the last call.
    """
    mi, order, size = shading.mi, shading.order, shading.size
    count = len(order)
    gbuffer = GBuffer.nothing(mi, count)
    ranges = executor.split_range(count, _RAYS_A_BAND)
    for (start, stop), buffer in zip(
        ranges, executor.run_tasks("render_gbuffer", ranges), strict=True
    ):
        dr.scatter(gbuffer, buffer, upload_indices(mi, order[start:stop]))
        dr.eval(gbuffer)
        dr.sync_thread()
        advance(_FIRST_PASS_FRACTION * (stop - start) / count)
    sky = ambient_visibility(mi, gbuffer.position, gbuffer.normal, gbuffer.width, size)
    dr.eval(sky)
    image = to_numpy(shading.shade(gbuffer, sky)).reshape(*size[::-1], 4)
    lost = int(dr.count(gbuffer.lost)[0])
    is_edge = edge_pixels(tone_map(image[..., :3] + (1 - image[..., 3:]))).ravel()
    is_edge |= to_numpy(gbuffer.needs_refinement)
    edges = order[is_edge[order]] if shading.refines else order[:0]
    pixels = image.reshape(-1, 4)
    limit = max(1, _RAYS_A_BAND // max(1, len(shading.offsets)))
    batches = [edges[start:stop] for start, stop in executor.split_range(len(edges), limit)]
    calls = ((batch, *shading.neighborhood(batch, gbuffer.position, sky)) for batch in batches)
    for batch, (color, batch_lost) in zip(
        batches, executor.run_tasks("refine_pixels", list(calls)), strict=True
    ):
        pixels[batch] = color + shading.share_of_first * (pixels[batch] - color)
        lost += int(batch_lost)
        advance((1 - _FIRST_PASS_FRACTION) * len(batch) / len(edges))
    return image, lost
