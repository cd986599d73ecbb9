"""`picture`, which draws a surface as a tensor with derivatives by all that the surface is made of.

A pixel is the mean of the color over its area. Its derivative has two parts. Where the picture is
smooth, colors change with the hits (`tracer.derivatives`). At its discontinuities, such as
outlines, the boundary between two colors moves: with the jump of the color from one side to the
other, dL, and the normal velocity v of the boundary on the screen (`boundary_motion`), the second
part is the integral of dL v over the boundary's length. Derivatives of hits alone leave it out.

Rays go through the points of a grid: one line in each row of pixels and one in each column, at
random places. The rows and columns are also the scanlines on which discontinuities are searched
for. A boundary crosses horizontal scanlines at the density |n_x| dl and vertical ones at |n_y| dl,
with its unit normal n; so the sum of dL v |n_x| over the crossings with the former and of dL v
|n_y| over those with the latter, times the distance of scanlines, has the mean of the integral of
dL v (n_x^2 + n_y^2) dl. It has no bias, and its variance is bounded also where a boundary is
tangent to scanlines.

The crossings also smooth the picture. On a scanline, a pixel is known by its one ray and by the
places at which the color jumps: the mean over the line follows from these. Taken with the weights
n_x^2 and n_y^2, the difference between this mean and the color of the ray has the mean 0 for a
random place of the ray, so it makes the picture smoother and leaves its mean as it is."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import backend_of, choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_integers, upload_vectors
from harnack.backend.validation import as_integer_in_range
from harnack.inverse.boundary_motion import BoundaryKind, BoundaryMotion, boundary_motion
from harnack.inverse.channels import ChannelFunction, Show, channel_function
from harnack.inverse.discontinuities import Discontinuities, Seen, find_discontinuities
from harnack.inverse.film import Film, has_fixed_pose
from harnack.rendering.camera import Camera
from harnack.tracer.derivatives import (
    change_of_nearest_level,
    change_of_value,
    needs_derivatives,
)
from harnack.tracer.hits import MIN_RAYS_FOR_CELLS, hits_with_derivatives
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.rays import RayBatch
from harnack.tracer.trace_options import TRACE_OPTIONS, shows_keywords, surface_and_options
from harnack.tracer.traced_surface import TracedSurface

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import Unpack

    from harnack.backend import Backend, BoolArray, FloatArray, IntArray, Real
    from harnack.fields.field import Field
    from harnack.tracer import Hits, Surface
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.trace_options import TraceKeywords, TraceOptions

_HONORED = ("level", "clip", "section", "largest", *TRACE_OPTIONS)
# Discontinuities are located with this tolerance of hits, as a part of the default one.
_FINE_TOLERANCE = 1e-4
# Pictures of more pixels and samples than this are refused: they would not fit into memory.
_MAX_SIDE, _MAX_SAMPLES = 8192, 16
# If more than this part of the length of boundaries is of an unknown kind, derivatives are refused.
_MAX_UNKNOWN = 0.01


@shows_keywords(*_HONORED)
def picture(
    surface: Field | Surface,
    *,
    camera: Camera = Camera(),
    size: int | tuple[int, int] = 128,
    show: Show | Callable[[Hits], Any] = "shaded",
    samples: int = 1,
    seed: int | None = 0,
    background: Any = 0.0,
    light: Any = None,
    options: TraceOptions | None = None,
    **keywords: Unpack[TraceKeywords],
) -> Any:
    """Draw a surface as a tensor (h, w, c) with derivatives, silhouettes included.

    surface: a field, or a `Surface` without a `side`.
    camera: from where it is seen, in the coordinates of the surface. For derivatives its frame must
        not follow the surface: it needs a box, or a position (or a distance), a target and a fov.
    size: (width, height) in pixels, or one number for both.
    show: "shaded", brightness under one light (c = 1); "normals", unit normals on the side of the
        camera (c = 3); "depth", distances from the camera (c = 1); "mask", 1 where the surface is
        (c = 1). Or a function from `Hits`, as Dr.Jit arrays, to a Dr.Jit array or vector, or a
        list of arrays: the channels. Its hits have normals on the side of the camera.
    samples: each pixel is the mean of samples x samples rays, one in each of its parts.
    seed: of the places of the rays in these parts. Take another one for each step of an
        optimization; with None, rays go through the middle, and derivatives of silhouettes have a
        small bias.
    background: the number, or one for each channel, where nothing is hit.
    light: (x, y, z), the direction to the light of a shaded picture; by default from above the left
        shoulder of the camera.
    options, keywords: as of `trace`.

    Returns a Dr.Jit tensor, of the precision of the parameters, if parameters of the field or the
    level are Dr.Jit arrays, as within functions for PyTorch and JAX (`harnack.io.wrap_for_torch`);
    else a NumPy array. Derivatives by these parameters have all of: changes of hits and normals,
    and motions of outlines, of edges of solids, of the curves at which level sets end, and of the
    curves at which `clip` or the domain cuts the surface, each found by bisection with proved first
    hits. Their mean over `seed` is the derivative of the mean picture. Not found are: parts of the
    surface, and gaps between them, that are thinner than the distance of the rays; and jumps of the
    color by less than 0.4 percent of its range.

    Raises:
        TypeError, ValueError: arguments of the wrong kind or size; a surface without bounds seen by
            a camera that needs them; derivatives with a camera whose frame follows the surface.
        NotImplementedError: derivatives of fields with facets or patches; by parameters that have
            none (`trace`); where more than 1 percent of the length of boundaries is of an unknown
            kind, such as where the color itself jumps on the surface.

    Warns if rays ran out of steps; these show the background.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"camera is a harnack.Camera, not {type(camera).__name__}")
    width, height = _checked_size(size)
    samples = as_integer_in_range(samples, "samples", 1, _MAX_SAMPLES)
    target, choices = surface_and_options("picture", surface, options, keywords, _HONORED)
    traced = TracedSurface.of(target, choices).with_call_cache()
    backend = _backend_of_numbers(traced)
    film = Film.of(camera, (width, height), traced.volume)
    channels = channel_function(show, background, light, film)
    grid = _Grid.random(film.size, samples, seed)
    plain = choose_backend(choices.precision or "single")
    drawing = _Drawing(traced, film, channels, grid, backend or plain)
    image = drawing.image()
    if backend is None:
        return to_numpy(image.array).reshape(image.shape)
    return image


def _checked_size(size: Any) -> tuple[int, int]:
    """The width and height of a picture."""
    sides = size if isinstance(size, tuple | list) else (size, size)
    if len(sides) != 2:
        raise ValueError(f"size is (width, height), not {size!r}")
    width, height = (as_integer_in_range(side, "size", 2, _MAX_SIDE) for side in sides)
    return width, height


def _backend_of_numbers(traced: TracedSurface) -> Backend | None:
    """The backend of the first of the field's parameters and the levels that is a Dr.Jit array;
    None if none is."""
    for value in (*traced.field.parameters().values(), *traced.levels):
        if dr.is_array_v(type(value)):
            return backend_of(value.array if dr.is_tensor_v(type(value)) else value)
    return None


@dataclass(frozen=True)
class _Grid:
    """The lines of a grid of rays, in screen coordinates: of each column and row of `samples` parts
    of pixels one line, between the borders of the picture.

    columns, rows: the coordinates of the lines, with both borders.
    samples: the number of lines in a row or column of pixels.
    """

    columns: FloatArray
    rows: FloatArray
    samples: int

    @classmethod
    def random(cls, size: tuple[int, int], samples: int, seed: int | None) -> _Grid:
        """A grid for a picture of this size, at random places in the parts; in their middles for
        seed=None."""
        random = None if seed is None else np.random.default_rng(seed)
        lines: list[FloatArray] = []
        for side in size:
            count = side * samples
            place = np.full(count, 0.5) if random is None else random.uniform(size=count)
            inner = (np.arange(count) + place) / samples
            lines.append(np.concatenate([[0.0], inner, [float(side)]]))
        return cls(lines[0], lines[1], samples)

    @property
    def shape(self) -> tuple[int, int]:
        """The number of rows and columns of lines."""
        return len(self.rows), len(self.columns)

    @property
    def points(self) -> FloatArray:
        """(n, 2) the screen points at which lines cross, row by row."""
        u, v = np.meshgrid(self.columns, self.rows)
        return np.stack([u.ravel(), v.ravel()], axis=1)


@dataclass(frozen=True)
class _Drawing:
    """A picture that is being drawn.

    surface: the surface, with the cache of this call.
    backend: where its colors are computed.
    """

    surface: TracedSurface
    film: Film
    channels: ChannelFunction
    grid: _Grid
    backend: Backend

    def image(self) -> Any:
        """The picture, as a tensor (h, w, c)."""
        width, height = self.film.size
        points = self.grid.points
        rays = self._rays(points, self.backend)
        many = rays.count >= MIN_RAYS_FOR_CELLS
        tracer = self.surface.for_rays(rays.count).tracer(self.backend, many_rays=many)
        hits, has_derivatives = hits_with_derivatives(tracer, rays)
        if has_derivatives:
            self._check_derivatives(tracer)
        colors = self.channels.of(hits, rays.direction)
        dr.eval(colors, hits)
        self._warn_of_lost_rays(hits)
        shape = self.grid.shape
        with dr.suspend_grad():
            table = np.stack([to_numpy(dr.detach(color)) for color in colors], axis=-1)
            is_hit = to_numpy(hits.is_hit)
        table = np.broadcast_to(table, (len(points), len(colors))).astype(np.float64)
        jumps = find_discontinuities(
            self.grid.columns, self.grid.rows, is_hit.reshape(shape),
            table.reshape(*shape, -1), self._look,
        )  # fmt: skip
        total = [self._averaged(color) for color in colors]
        if len(jumps.axis):
            motion = boundary_motion(jumps, self.film, self._fine_surface, self._fine_tracer)
            step = jumps.behind.color - jumps.before.color
            smoothing = _smoothing(jumps, motion, step, self.grid, self.film.size)
            total = [
                value + upload_floats(self.backend, smoothing[..., k].ravel())
                for k, value in enumerate(total)
            ]
            if has_derivatives:
                shares = self._boundary_shares(jumps, motion, -step)
                total = [value + share for value, share in zip(total, shares, strict=True)]
        flat = _interleaved(self.backend, total)
        return dr.tensor_t(type(flat))(flat, (height, width, len(total)))

    def _rays(self, points: FloatArray, backend: Backend) -> RayBatch:
        """The rays through screen points (n, 2), as Dr.Jit arrays of a backend."""
        origin = upload_vectors(backend, self.film.origin[None])
        directions = upload_vectors(backend, self.film.directions(points))
        return RayBatch.of(origin, directions, 0.0, np.inf, None)

    def _check_derivatives(self, tracer: SurfaceTracer) -> None:
        """Raise an error if pictures of this surface have no derivatives."""

    def _warn_of_lost_rays(self, hits: Hits) -> None:
        """Warn if rays ran out of steps."""
        lost = int(dr.count(hits.status == int(RayStatus.OUT_OF_STEPS))[0])
        if lost:
            warnings.warn(
                f"{lost} rays of a picture ran out of steps and show the background; raise "
                "max_steps",
                stacklevel=3,
            )

    @functools.cached_property
    def _fine_surface(self) -> TracedSurface:
        """The surface with a small tolerance, for the discontinuities."""
        tolerance = HitTolerance(_FINE_TOLERANCE * self.surface.hit_tolerance.distance)
        return replace(self.surface, tolerance=tolerance, ray_count=0)

    @functools.cached_property
    def _fine_tracer(self) -> SurfaceTracer:
        """The tracer of that surface in double precision."""
        return self._fine_surface.tracer(choose_backend("double"), many_rays=False)

    def _look(self, points: FloatArray) -> Seen:
        """What rays through screen points (n, 2) see, in double precision."""
        count = len(points)
        if not count:
            nothing = np.zeros((0, 3))
            return Seen(np.zeros(0, bool), nothing, np.zeros(0), nothing, nothing)
        tracer = self._fine_tracer
        with dr.suspend_grad():
            rays = self._rays(points, tracer.backend)
            hits, _ = hits_with_derivatives(tracer, rays)
            colors = self.channels.of(hits, rays.direction)
            dr.eval(colors, hits)
        columns = [np.broadcast_to(to_numpy(color), (count,)) for color in colors]
        return Seen(
            to_numpy(hits.is_hit), np.stack(columns, axis=1), to_numpy(hits.t),
            to_numpy(hits.position).reshape(count, 3), to_numpy(hits.normal).reshape(count, 3),
        )  # fmt: skip

    def _averaged(self, color: Real) -> Real:
        """The mean of a channel over the rays in each pixel, (h * w,). color: of all points of the
        grid; those of the borders do not count."""
        (rows, columns), samples = self.grid.shape, self.grid.samples
        backend, (width, height) = self.backend, self.film.size
        kind = type(color)
        if dr.width(color) == 1:
            return dr.zeros(kind, width * height) + color
        count = dr.opaque(backend.UInt32, columns)
        parts, across = dr.opaque(backend.UInt32, samples), dr.opaque(backend.UInt32, width)
        pixel = dr.arange(backend.UInt32, width * height)
        row, column = pixel // across * parts + 1, pixel % across * parts + 1
        total = dr.zeros(kind, width * height)
        for part in range(samples * samples):
            shift = dr.opaque(backend.UInt32, part // samples * columns + part % samples)
            total = total + dr.gather(kind, color, row * count + column + shift)
        del rows
        return total * dr.opaque(backend.Float, 1 / samples**2)

    def _boundary_shares(
        self, jumps: Discontinuities, motion: BoundaryMotion, step: FloatArray
    ) -> list[Real]:
        """Zeros (h * w,) for each channel whose derivatives are those by the motion of boundaries.

        step: (n, c) by how much larger the channels are before the jump than behind it.
        """
        tracer, backend = self._fine_tracer, self.backend
        across = np.abs(motion.normal[np.arange(len(jumps.axis)), jumps.axis]) / self.grid.samples
        size = np.abs(step).max(axis=1)
        unknown = motion.kind == int(BoundaryKind.UNKNOWN)
        if size[unknown].sum() > _MAX_UNKNOWN * size.sum():
            raise NotImplementedError(
                f"{unknown.sum()} of {len(unknown)} points at which the picture jumps belong to no "
                "known kind of boundary, so derivatives by their motion are not known; a function "
                "`show` must not jump where the surface is smooth"
            )
        width, height = self.film.size
        zeros = [dr.zeros(backend.Float, width * height) for _ in step.T]
        if not len(motion.index):
            return zeros
        point = upload_vectors(tracer.backend, motion.position)
        with dr.suspend_grad():
            sample = tracer.sample(point)
        change = change_of_value(tracer, point, point, sample.gradient)
        change = change - change_of_nearest_level(tracer, sample.value)
        weights = motion.weight * across[motion.index]
        moved = backend.Float(change * upload_floats(tracer.backend, weights))
        pixel = upload_integers(backend, _pixels(jumps, self.film.size)[motion.index])
        for k, target in enumerate(zeros):
            numbers = upload_floats(backend, step[motion.index, k].astype(backend.dtype))
            dr.scatter_add(target, moved * numbers, pixel)
        return zeros


def _pixels(jumps: Discontinuities, size: tuple[int, int]) -> IntArray:
    """The indices (n,) of the pixels in which jumps lie, counted by rows."""
    width, height = size
    u, v = jumps.screen.mean(axis=1).T
    column, row = np.minimum(u.astype(int), width - 1), np.minimum(v.astype(int), height - 1)
    return row * width + column


def _smoothing(
    jumps: Discontinuities, motion: BoundaryMotion, step: FloatArray, grid: _Grid,
    size: tuple[int, int],
) -> FloatArray:  # fmt: skip
    """What is added to a picture (h, w, c), so that pixels with jumps are means along scanlines.

    step: (n, c) by how much larger the channels are behind the jump than before it.
    """
    width, height = size
    n = np.arange(len(jumps.axis))
    place = jumps.screen.mean(axis=1)[n, jumps.axis] * grid.samples
    lines = [line[1:-1] * grid.samples for line in (grid.columns, grid.rows)]
    counts = np.array([len(line) for line in lines])[jumps.axis]
    part = np.minimum(place.astype(int), counts - 1)
    sample = np.where(
        jumps.axis == 0,
        lines[0][np.minimum(part, len(lines[0]) - 1)],
        lines[1][np.minimum(part, len(lines[1]) - 1)],
    )
    # The length of the part on the other side of the jump than its ray.
    length = np.where(sample < place, part + 1 - place, -(place - part))
    # Where the normal is not known, half of each direction.
    square = motion.normal[n, jumps.axis] ** 2
    square = np.where(motion.kind == int(BoundaryKind.UNKNOWN), 0.5, square)
    added = (length * square)[:, None] * step / grid.samples**2
    image = np.zeros((height * width, step.shape[1]))
    np.add.at(image, _pixels(jumps, size), added)
    return image.reshape(height, width, -1)


def _interleaved(backend: Backend, channels: list[Real]) -> Real:
    """The numbers of channels (n,) in one array: all those of the first pixel, then the next."""
    count = len(channels)
    if count == 1:
        return channels[0]
    total = dr.zeros(backend.Float, count * dr.width(channels[0]))
    pixel = dr.arange(backend.UInt32, dr.width(channels[0])) * count
    for k, channel in enumerate(channels):
        dr.scatter(total, channel, pixel + k)
    return total
