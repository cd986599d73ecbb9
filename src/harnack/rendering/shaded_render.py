"""Renders shaded pictures: one ray a pixel, more rays at edges, and no noise. The first hit of each
ray is stored in a G-buffer and lit by formulas. `mi` is the Mitsuba module, and a ray that is
neither proved free nor led to a hit is called lost. The hemisphere over a point is the set of
directions above its tangent plane, from which light of the sky comes.

The rays through the middles of all pixels are traced first. Two kinds of pixels are then drawn
again, as the mean of a fixed grid of samples: pixels that differ visibly from a neighbor, and
pixels through which the edge of an isoline may pass. So outlines are smooth, lines thinner than a
pixel have no gaps, and the inside of a surface takes one ray a pixel. If requested, the cone about
each ray that contains the whole pixel is tested, too. It finds pixels that a surface covers in part
although the rays through their middles miss it. They are drawn again.
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
    from harnack.cluster.executor import Executor
    from harnack.geometry import Volume


class ConeCoverage:
    """Finds pixels that surfaces may cover in part. For each pixel it tests a cone: the cone about
    the ray through the pixel's middle that contains the whole pixel.

    The ray mostly misses parts of a surface that are thinner than the pixel, and so do the rays of
    the neighbors. The cone contains the whole pixel, so it does not miss them.

    Raises:
        ValueError: the field of a surface jumps, such as the winding number of a mesh. Such a field
            is nearly constant on each side of the surface, so its values tell no distance. Or a
            surface consists of level sets of several functions.
    """

    def __init__(self, mi: Any, world: HybridScene) -> None:
        self.mi = mi
        self.placed = tuple(_with_crossings(mi, proxy) for proxy in world.proxies)

    def partly_covered(self, ray: Any, position: Any) -> Any:
        """Return the mask of pixels whose cones a surface covers in part, in front of the points
        that their rays hit.

        ray: the rays through the middles, with differentials, that is with the rays through
            neighboring pixels.
        position: (3,) the points that the rays hit; NaN for no hit.
        """
        mi = self.mi
        # Without a hit, the cone is tested to its end.
        distance = dr.norm(position - ray.o)
        t = dr.select(dr.isfinite(distance), distance, dr.largest(mi.Float))
        # The vectors to the neighboring pixels span one pixel at distance 1.
        to_right, to_below = ray.d_x - ray.d, ray.d_y - ray.d
        # Half the longer diagonal.
        radius = 0.5 * dr.maximum(dr.norm(to_right + to_below), dr.norm(to_right - to_below))
        is_covered = dr.zeros(mi.Bool, dr.width(ray.d))
        for placed, balls in self.placed:
            is_covered |= placed.covers_in_part(ray.o, ray.d, radius, t, balls)
        return is_covered


def _with_crossings(mi: Any, proxy: Any) -> tuple[PlacedSurface, Any]:
    """Prepare the surface of a proxy (the mesh that stands for it in Mitsuba) for cones. Returns
    the surface with a tracer of its own, and a ball inside its extent and a ball around its extent,
    as `inner_and_outer_ball` returns them.

    Raises:
        ValueError: the surface consists of level sets of several functions, or its field jumps.
    """
    surface, backend = proxy.surface, mitsuba_backend(mi)
    if surface.field.traits.has_patches:
        raise ValueError(
            f'antialias="cones" takes a level set of one function, and {surface.field!r} has one '
            'for each part. Leave antialias at "edges"'
        )
    if surface.field.traits.has_jumps:
        raise ValueError(
            f'antialias="cones" takes fields without jumps, and {surface.field!r} jumps: its '
            'values tell no distance. Leave antialias at "edges"'
        )
    # Cones need a tracer that finds where f crosses the level.
    placed = replace(proxy.placed, tracer=surface.tracer(backend, crosses=True))
    return placed, inner_and_outer_ball(surface.volume, backend)


def inner_and_outer_ball(volume: Volume | None, backend: Backend) -> tuple[Vec3, Real, Real] | None:
    """Find two balls with the same center for a volume: one that lies inside it, and one that
    contains it. Returns the center (3,), which is the middle of the volume's bounding box, the
    inner radius and the outer radius. None if the volume is unbounded or no inner ball was
    found."""
    if volume is None:
        return None
    lower, upper = (np.asarray(end, dtype=np.float64) for end in volume.bounds())
    if not np.isfinite(upper - lower).all():
        return None
    middle = (0.5 * (lower + upper)).tolist()
    # The inner radius is the distance from the middle to the boundary (signed distances are
    # negative inside), and not half the box's side: other volumes have faces that lie nearer. It is
    # reduced by more than its rounding.
    center = choose_backend("double").Array3f(*middle)
    inner_radius = -float(to_numpy(volume.signed_distance(center))[0]) * (1 - 1e-6)
    if not inner_radius > 0:
        return None
    outer_radius = 0.5 * float(np.linalg.norm(upper - lower))
    # Opaque numbers are kernel parameters: other balls compile no other kernel.
    parameters = [dr.opaque(backend.Float, x) for x in (*middle, inner_radius, outer_radius)]
    return backend.Array3f(*parameters[:3]), parameters[3], parameters[4]


# The number of directions across the picture, and of points along each; the length that they cover,
# as a fraction of the larger side of the picture; and the sine of an elevation below which facets
# and rounding stay.
SKY_DIRECTIONS = 16
SKY_SAMPLES = 8
SKY_REACH = 0.16
LEAST_SINE = 0.06


def ambient_visibility(
    mi: Any, position: Any, normal: Any, width: Any, size: tuple[int, int]
) -> Any:
    """Estimate how much of the sky reaches the point that each pixel shows: the fraction of the
    hemisphere over the point, in [0, 1], that nothing near it hides.

    position: (3,) points seen by the pixels, counted by rows; NaN where nothing is seen.
    normal: (3,) unit normals there, toward the eye.
    width: the width of a pixel at the point.
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
    reach_in_pixels = SKY_REACH * max(size)
    reach_in_space = reach_in_pixels * width

    def shading_sine(k: int, direction: Any) -> Any:
        """Look at the k-th pixel along a direction (2,) in the picture. Returns the sine of the
        elevation of its point over the tangent plane, multiplied by a factor that falls with its
        distance; 0 if nothing is seen there."""
        # Points are denser near the pixel: their distances grow quadratically.
        distance = 1.0 + reach_in_pixels * ((k + 0.5) / SKY_SAMPLES) ** 2
        # The pixel nearest to this point of the picture. (x, y) is the pixel of the lane.
        u, v = x + distance * direction.x, y + distance * direction.y
        is_in_picture = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        pixel = mi.UInt32(dr.round(v)) * columns + mi.UInt32(dr.round(u))
        offset = dr.gather(mi.Vector3f, position, pixel, is_in_picture) - position
        point_distance = dr.norm(offset)
        fade = dr.maximum(1 - dr.square(point_distance / reach_in_space), 0)
        # Lower elevations may be due to facets and rounding: they count as 0.
        sine = dr.dot(offset, normal) / point_distance - LEAST_SINE
        # The sine is NaN if nothing is seen, and then not larger than 0.
        return dr.select(is_in_picture & (sine > 0), sine * fade, 0)

    def add_direction(turn: Any, hidden: Any) -> tuple[Any, Any]:
        """Do one step of the loop over directions. Returns the index of the next direction, and the
        sum of hidden fractions with this direction added. The hidden fraction of a direction is the
        square of the largest sine that `shading_sine` returns for it.

        turn: the index of this direction. hidden: the sum so far.
        """
        s, c = dr.sincos((mi.Float(turn) + 0.5) * (dr.two_pi / SKY_DIRECTIONS))
        highest = mi.Float(0)
        for k in range(SKY_SAMPLES):
            highest = dr.maximum(highest, shading_sine(k, mi.Vector2f(c, s)))
        return turn + 1, hidden + dr.square(highest)

    def is_running(turn: Any, hidden: Any) -> Any:
        del hidden
        return turn < SKY_DIRECTIONS

    start = (mi.UInt32(0), dr.zeros(mi.Float, count))
    _, hidden = dr.while_loop(start, is_running, add_direction, label="visible sky")
    return 1 - hidden / SKY_DIRECTIONS


# Rays of one band.
_RAYS_A_BAND = 2**17
# The coordinates in its pixel of the first ray.
_MIDDLE = 0.5
# The estimated fraction of the time that is spent on the first rays, for the progress bar.
_FIRST_PASS_FRACTION = 0.6


@dataclass
class GBuffer:
    """The first opaque hit of the ray of each pixel, seen through transparent solids. The hit is
    lit later.

    position, normal, eye: (3,) the point, its unit normal toward the eye, and the unit direction to
        the eye.
    width: the width of a pixel at the point.
    color: (3,) reflectance.
    light: (3,) the light that does not come from shading the point: emitted there, from the
        environment, or reflected by transparent solids; magenta for rays out of steps.
    transmittance: (3,) the fraction of light that the transparent solids in front let through.
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
        """Return a buffer of zeros for `count` pixels. Buffers of parts of the picture are
        scattered into it."""
        # The types of the attributes, in their order; width is the Float.
        vectors, colors, masks = (mi.Vector3f,) * 3, (mi.Color3f,) * 3, (mi.Bool,) * 5
        kinds = (*vectors, mi.Float, *colors, *masks)
        return cls(*(dr.zeros(kind, count) for kind in kinds))

    def to_numpy(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of this buffer as NumPy arrays, by name."""
        return {name: to_numpy(value) for name, value in vars(self).items()}

    @classmethod
    def from_numbers(cls, mi: Any, numbers: Mapping[str, npt.NDArray[Any]]) -> GBuffer:
        """Return the buffer with these arrays, which `to_numpy` returned in this process or in
        another one."""
        empty = vars(cls.nothing(mi, 0))
        return cls(
            **{name: _of_numbers(mi, type(kind), numbers[name]) for name, kind in empty.items()}
        )


def _of_numbers(mi: Any, kind: Any, numbers: npt.NDArray[Any]) -> Any:
    """Turn numbers (n,) or (n, 3) into a Dr.Jit array of type `kind`. It is uploaded such that
    kernels do not depend on its alignment in memory."""
    if dr.is_mask_v(kind):
        return kind(np.ascontiguousarray(numbers))
    columns = numbers.reshape(len(numbers), -1).T
    return kind(*(upload_floats(mitsuba_backend(mi), column) for column in columns))


class ShadedTask:
    """Renders a shaded picture, one range of pixels at a time. Pixels are traced first
    (`render_gbuffer`), lit (`shade`), and drawn again at edges (`refine_pixels`). `order` lists all
    pixels in the order in which they are traced, and `offsets` the points of a pixel that is drawn
    again.

    spp: at least this many rays are averaged for a pixel at an edge; with 1, every pixel has a
        single ray.
    on_floor: whether the surfaces stand on the floor of the studio, which shows their shadows.
    cut_out: whether to leave out the light of the backdrop behind all objects.
    cones: whether pixels are also drawn again if a surface may cover a part of the cone that
        contains the pixel (`ConeCoverage`), and not only at edges in the picture.

    Raises:
        ValueError: the Mitsuba variant is spectral (the four wavelengths of a ray do not determine
            a color); or cones are requested for a field that jumps.
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
        # The pixel's first ray goes through its middle. A sample at the same place is not traced
        # again.
        traced = (offsets == _MIDDLE).all(axis=1)
        self.offsets, self.share_of_first = offsets[~traced], float(traced.mean())
        self.refines = spp > 1
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        self.light = StudioLight.of(matrix)
        self.refraction = RefractionTracer(world, self.light, hides_lights=cut_out)
        self.floor = FloorShadow.of(world, self.light) if on_floor else None

    def render_gbuffer(self, start: int, stop: int) -> GBuffer:
        """Trace the rays through the middles of some pixels: those from `start` to `stop` in the
        list `order`. Returns their `GBuffer`."""
        mi = self.mi
        pixel = upload_indices(mi, self.order[start:stop])
        gbuffer = self._trace_pixels(pixel, mi.Vector2f(_MIDDLE))
        dr.eval(gbuffer)
        if self.finder is not None:  # a `ConeCoverage`, if cones are requested
            ray, _ = self.ray(pixel, mi.Vector2f(_MIDDLE))
            gbuffer.needs_refinement |= self.finder.partly_covered(ray, gbuffer.position)
            dr.eval(gbuffer)
        return gbuffer

    def _trace_pixels(self, pixel: Any, offset: Any) -> GBuffer:
        """Trace a ray through one point in each of n pixels. Returns their `GBuffer`.

        pixel: (n,) indices of the pixels, counted by rows.
        offset: (2,) the coordinates in [0, 1) of the point in its pixel.

        The color is the reflectance of the visible side of the surface. It is changed for metal and
        clear matter, for the inner side of an open surface, and where a hole of a mesh is closed,
        but not on isolines.
        """
        mi, scene = self.mi, self.world.scene
        ray, weight = self.ray(pixel, offset)
        # The first opaque hits, behind transparent solids (`RefractedHits`).
        hits = self.refraction.trace(mi.Ray3f(ray))
        si, first = hits.si, hits.first
        # Adding zeros gives the mask its full width.
        lost = first.is_out_of_steps | dr.zeros(mi.Bool, dr.width(pixel))
        hit = first.is_hit & ~lost
        # The normal points to larger values: that side is called the inner one.
        sees_inner_side, is_open = si.wi.z > 0, self._is_open(si)
        color, back = (self._reflectance(si, side) * weight for side in (1, -1))
        color, back = (as_rgb(mi, c, ray.wavelengths) for c in (color, back))
        is_on_line = first.isoline_index > 0
        color, back = reflectance(color, is_on_line), reflectance(back, is_on_line)
        is_off_line = ~is_on_line  # lines have their own color
        color = two_sided_color(color, back, sees_inner_side & is_open & is_off_line)
        color = hole_filling_tint(color, first.is_hole_filling & is_off_line)
        # The light that a shape emits to the eye, or that comes from the environment behind all.
        emitted = si.emitter(scene).eval(si, ~lost) * weight
        light = as_rgb(
            mi, hits.throughput * emitted + weight * hits.reflected_light, ray.wavelengths
        )
        light = dr.select(lost, mi.Color3f(OUT_OF_STEPS_COLOR), light)
        # Transparent solids cover, too: a ray that was traced more than once has met one.
        covered = hit | lost | (hits.interface_count > 1)
        if self.cut_out:
            light = dr.select(covered, light, 0)
        transmittance = as_rgb(mi, hits.throughput, ray.wavelengths)
        d = hits.ray.d
        # The normal on the side of the ray.
        normal = mi.Vector3f(dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, d)))
        t = dr.select(hit, hits.path_length + first.t, 0)
        # The width of a pixel at the hit: the distance of the neighboring pixel's ray there.
        width = dr.norm(ray.o_x + t * ray.d_x - ray.o - t * ray.d)
        flags = si.bsdf().flags()
        glossy = mi.has_flag(flags, mi.BSDFFlags.Glossy) | mi.has_flag(flags, mi.BSDFFlags.Delta)
        glossy &= is_off_line
        may_have_line_edge = hit & self.world.has_line_near(si, ray, d, t)
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
            may_have_line_edge,
        )

    def ray(self, pixel: Any, offset: Any) -> tuple[Any, Any]:
        """Return camera rays with differentials through one point in each pixel, and the weights of
        their light.

        pixel: indices of the pixels, counted by rows.
        offset: (2,) coordinates in [0, 1) of the point in its pixel.
        """
        mi = self.mi
        position = film_positions(mi, pixel, offset, self.size)
        # One fixed wavelength and the middle of the lens: no random numbers are needed.
        return self.sensor.sample_ray_differential(
            self.sensor.shutter_open(), 0.5, position, mi.Point2f(0.5)
        )

    def _reflectance(self, si: Any, side: int) -> Any:
        """Return the reflectance at normal incidence of the surface at interactions `si`. side: 1
        for the visible side, -1 for the other one."""
        mi = self.mi
        # Light arrives along the normal.
        along_normal = mi.SurfaceInteraction3f(si)
        along_normal.wi = mi.Vector3f(0, 0, dr.mulsign(mi.Float(side), si.wi.z))
        return si.bsdf().eval_diffuse_reflectance(along_normal, si.is_valid())

    def _is_open(self, si: Any) -> Any:
        """Return the mask of interactions with a level set that bounds no solid, so that both of
        its sides can be seen."""
        is_open = self.mi.Bool(False)
        for proxy in self.world.proxies:
            surface = proxy.surface
            # The zero level set of a field of the class `Solid` bounds a solid, too.
            if surface.solid_range is None and not isinstance(surface.field, Solid):
                is_open |= si.shape == self.mi.ShapePtr(proxy)
        return is_open

    def shade(self, buffer: GBuffer, sky: Any) -> Any:
        """Light the points of a G-buffer. Returns four numbers for each pixel: the radiance toward
        the eye, and 1 if anything but the environment is visible, else 0.

        sky: the fraction of the hemisphere over the pixel's point that nothing near it hides.
        """
        key_fraction = 1.0
        if self.floor is not None:
            key_fraction, sky_fraction = self.floor.at(buffer.position)
            # On the floor, the traced shadow counts if it is darker.
            sky = dr.minimum(sky, sky_fraction)
        lit = self.light.shade(
            buffer.color, buffer.normal, buffer.eye, buffer.glossy, sky, key_fraction
        )
        light = dr.select(buffer.met, buffer.transmittance * lit, 0) + buffer.light
        return self.mi.Vector4f(*light, dr.select(buffer.covered, self.mi.Float(1), 0))

    def refine_pixels(
        self, indices: IntArray, position: FloatArray, sky: FloatArray
    ) -> tuple[npt.NDArray[np.float32], int]:
        """Draw n pixels again, each with a grid of samples. Returns the mean colors (n, 4) of the
        samples, and the number of samples that ran out of steps.

        indices: (n,) the pixels, counted by rows.
        position, sky: (n, 5, 3) and (n, 5), the points seen by each pixel and its four neighbors,
            and the fractions of the hemisphere there that nothing hides (`neighborhood`).
        """
        # `offsets` are the samples of a pixel besides its middle.
        mi, spp = self.mi, len(self.offsets)
        # Successive lanes are the samples of one pixel, then those of the next.
        sample = dr.arange(mi.UInt32, len(indices) * spp)
        # Opaque numbers are kernel parameters: other numbers compile no other kernel.
        opaque_spp = dr.opaque(mi.UInt32, spp)
        pixel = dr.gather(mi.UInt32, upload_indices(mi, indices), sample // opaque_spp)
        offset_table = mi.Vector2f(
            *(upload_floats(mitsuba_backend(mi), axis) for axis in self.offsets.T)
        )
        gbuffer = self._trace_pixels(
            pixel, dr.gather(mi.Vector2f, offset_table, sample % opaque_spp)
        )
        color = self.shade(gbuffer, _nearest_sky(mi, gbuffer, sample // opaque_spp, position, sky))
        dr.eval(color, gbuffer.lost)
        return to_numpy(mean_of_blocks(color, spp)), int(dr.count(gbuffer.lost)[0])

    def neighborhood(self, indices: IntArray, *arrays: Any) -> tuple[npt.NDArray[Any], ...]:
        """Gather the entries of arrays at n pixels and their four neighbors. Returns an array (n,
        5, ...) for each given array: the entry of the pixel itself, then those of its neighbors to
        the right, to the left, below and above. Beyond the picture's border there is no neighbor,
        and the entry of the pixel itself stands in its place.

        indices: (n,) the pixels, counted by rows.
        arrays: Dr.Jit arrays with an entry for each pixel of the picture, counted by rows.
        """
        columns, rows = self.size
        x, y = indices % columns, indices // columns
        # Columns and rows of the five pixels.
        u = np.clip(x[:, None] + np.array([0, 1, -1, 0, 0]), 0, columns - 1)
        v = np.clip(y[:, None] + np.array([0, 0, 0, 1, -1]), 0, rows - 1)
        rows_of_five = upload_indices(self.mi, (v * columns + u).ravel())
        gathered = [to_numpy(dr.gather(type(array), array, rows_of_five)) for array in arrays]
        return tuple(array.reshape(len(indices), 5, *array.shape[1:]) for array in gathered)


def _nearest_sky(mi: Any, samples: GBuffer, row: Any, position: FloatArray, sky: FloatArray) -> Any:
    """Estimate for each sample which fraction of the hemisphere over its point nothing hides. This
    fraction is known for the points that whole pixels show. Among the sample's pixel and its four
    neighbors, the pixel is chosen whose point is nearest to the sample's point, and its fraction is
    taken. If none of them shows a point, the fraction is 1.

    samples: the G-buffer of the samples.
    row: for each sample, the index of its pixel among the n chosen pixels.
    position, sky: (n, 5, 3) and (n, 5), the points of the chosen pixels and their neighbors, and
        the fractions there.
    """
    least_distance, fraction = mi.Float(dr.inf), mi.Float(1)
    for k in range(position.shape[1]):
        point = dr.gather(mi.Vector3f, _of_numbers(mi, mi.Vector3f, position[:, k]), row)
        distance = dr.norm(point - samples.position)
        is_closer = distance < least_distance  # False for NaN, where nothing is seen
        least_distance = dr.select(is_closer, distance, least_distance)
        fraction = dr.select(
            is_closer, dr.gather(mi.Float, _of_numbers(mi, mi.Float, sky[:, k]), row), fraction
        )
    return fraction


def render_shaded(
    shading: ShadedTask, executor: Executor, advance: Callable[[float], None]
) -> tuple[npt.NDArray[np.float32], int]:
    """Render a shaded picture. Returns the image (h, w, 4), linear sRGB radiance and last the
    covered fraction, and the number of rays that ran out of steps.

    shading: the task.
    executor: calls methods of the task, in this process or on a cluster.
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
        dr.sync_thread()  # kernels run asynchronously: only finished work is reported
        advance(_FIRST_PASS_FRACTION * (stop - start) / count)
    # All first hits are needed before the first pixel can be lit.
    sky = ambient_visibility(mi, gbuffer.position, gbuffer.normal, gbuffer.width, size)
    dr.eval(sky)
    image = to_numpy(shading.shade(gbuffer, sky)).reshape(*size[::-1], 4)
    lost = int(dr.count(gbuffer.lost)[0])
    # Edges are those of the picture over white, as it is seen.
    is_edge = edge_pixels(tone_map(image[..., :3] + (1 - image[..., 3:]))).ravel()
    is_edge |= to_numpy(gbuffer.needs_refinement)
    edges = order[is_edge[order]] if shading.refines else order[:0]
    pixels = image.reshape(-1, 4)
    batch_size = max(1, _RAYS_A_BAND // max(1, len(shading.offsets)))
    batches = [edges[start:stop] for start, stop in executor.split_range(len(edges), batch_size)]
    arguments = ((batch, *shading.neighborhood(batch, gbuffer.position, sky)) for batch in batches)
    for batch, (color, batch_lost) in zip(
        batches, executor.run_tasks("refine_pixels", list(arguments)), strict=True
    ):
        # The ray through the middle counts as one more sample if it is one of the grid's points.
        pixels[batch] = color + shading.share_of_first * (pixels[batch] - color)
        lost += int(batch_lost)
        advance((1 - _FIRST_PASS_FRACTION) * len(batch) / len(edges))
    return image, lost
