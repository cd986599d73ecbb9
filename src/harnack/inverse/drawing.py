"""Draws a picture with derivatives.

A pixel is the mean of the color over its area. Its derivative has two parts. Where the picture is
smooth, colors change with the hits (`tracer.derivatives`); rays on scanlines give the mean of that
(`scanline_samples`). At discontinuities, such as outlines, the boundary between two colors moves.
With the jump dL of the color from one side to the other, and the normal velocity v of the boundary
on the screen (`boundary_motion`), this second part is the integral of dL v over the boundary's
length. Derivatives of hits alone leave it out.

Rays go through the points of a grid: one line in each row of pixels and one in each column, at
random places. Rows and columns are also the scanlines on which discontinuities are searched for. A
boundary with the unit normal n crosses horizontal scanlines at the density |n_x| dl and vertical
ones at |n_y| dl. So the sum of dL v |n_x| over the crossings with the former and of dL v |n_y| over
those with the latter, times the distance of scanlines, has the mean of the integral of dL v (n_x^2
+ n_y^2) dl. It has no bias, and its variance is bounded also where a boundary is tangent to a
scanline.

The crossings also smooth the picture. On a scanline, a pixel is known by its one ray and by the
places at which the color jumps: the mean over the line follows from these. For a random place of
the ray, the difference of this mean from the color of the ray has the mean 0; so, taken with the
weights n_x^2 and n_y^2, it makes the picture smoother and leaves its mean as it is. Pieces that are
so short that a ray might not have found them are left as they are."""

from __future__ import annotations

import functools
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import choose_backend, to_numpy
from harnack.backend.arrays import upload_floats, upload_integers, upload_vectors
from harnack.backend.elementary import max_norm, safe_norm
from harnack.enclosures.samples import value_error_bound
from harnack.fields.attached_numbers import refuse_moving_domain
from harnack.fields.number_table import components_of
from harnack.fields.parameters import differentiable_parameters
from harnack.inverse.boundary_motion import BoundaryKind, BoundaryMotion, boundary_motion
from harnack.inverse.discontinuities import (
    Discontinuities,
    Seen,
    find_discontinuities,
    jump_weights,
    piece_weights,
)
from harnack.inverse.film import at_least_two, has_fixed_pose, pixel_indices
from harnack.inverse.outlines import with_exact_outlines
from harnack.inverse.scanline_samples import scanline_samples
from harnack.inverse.shadow_motion import with_shadow_motion
from harnack.name_suggestions import with_article
from harnack.tracer.derivatives import (
    change_of_nearest_level,
    change_of_value,
    hits_on_level,
    needs_derivatives,
)
from harnack.tracer.hits import MIN_RAYS_FOR_CELLS, hits_with_derivatives
from harnack.tracer.level_contact import HitTolerance, RayStatus
from harnack.tracer.rays import RayBatch

if TYPE_CHECKING:
    from harnack.backend import Backend, BoolArray, FloatArray, IntArray, Real
    from harnack.inverse.channels import ChannelFunction
    from harnack.inverse.film import Film, Grid
    from harnack.inverse.scanline_samples import ScanlineSamples
    from harnack.rendering.camera import Camera
    from harnack.tracer import Hits
    from harnack.tracer.surface_tracer import SurfaceTracer
    from harnack.tracer.traced_surface import TracedSurface

# The tolerance of hits for discontinuities and derivatives, as a part of the usual one.
_FINE_TOLERANCE = 1e-3
# A hit within the tolerance of the surface may be this many tolerances from it along its ray.
_LONGEST_STEP = 1000.0
# A warning says if more than this part of the surface that is seen has no derivative.
_MOST_LEFT_OUT = 0.05
# If more than this part of the jumps of a picture is of an unknown kind, and more than so many
# jumps of the mean size, derivatives are refused. (Where one outline passes behind another, a point
# may be of neither.)
_MAX_UNKNOWN, _FEW_UNKNOWN = 0.02, 4


def with_fine_tolerance(surface: TracedSurface) -> TracedSurface:
    """The surface with a small tolerance, as discontinuities, derivatives and shadows need it."""
    tolerance = HitTolerance(_FINE_TOLERANCE * surface.hit_tolerance.distance)
    return replace(surface, tolerance=tolerance, ray_count=0)


@dataclass(frozen=True)
class Drawing:
    """A picture that is being drawn.

    surface: the surface, with the cache of this call.
    film, grid: where the picture is, and the lines on which rays are traced.
    channels: what it shows.
    backend: of the tensor that is drawn. Discontinuities and derivatives are computed in double
        precision: rays that pass an edge within the rounding of single precision would hit it where
        its normal turns.
    random: places rays on scanlines; None for fixed places.
    camera: the camera of the film.
    """

    surface: TracedSurface
    film: Film
    channels: ChannelFunction
    grid: Grid
    backend: Backend
    random: np.random.Generator | None
    camera: Camera

    def image(self) -> Any:
        """The picture, as a Dr.Jit tensor (h, w, c)."""
        width, height = self.film.size
        # First of all, since levels would lose their derivatives where these are suspended.
        has_derivatives = self._has_derivatives
        colors, is_hit = self._colors_on_grid()
        image = self._averaged(self.channels.shown(colors))
        jumps = find_discontinuities(self.grid, is_hit, colors, self._look)
        motion = self._motion(jumps)
        if not self.channels.is_constant:
            jumps = with_exact_outlines(jumps, motion, self.film, self._fine_tracer, self.channels)
        pieces = np.ones(len(jumps)) if self.random is None else piece_weights(jumps, self.grid)
        weights = jump_weights(jumps, pieces)
        image = image + self._smoothing(jumps, motion, weights)
        channel_count = image.shape[-1]
        numbers = upload_floats(self.backend, image.ravel().astype(self.backend.dtype))
        if has_derivatives:
            self._check_derivatives(jumps, motion)
            numbers = numbers + self._zero_of_parameters()
            if self._surface_moves:
                numbers = self._with_boundary_derivatives(numbers, jumps, motion, weights)
        if has_derivatives and not self.channels.is_constant:
            random = self.random or np.random.default_rng(0)
            samples = scanline_samples(self.grid, is_hit, jumps, motion, pieces, random)
            numbers = self._with_derivatives_inside(numbers, samples)
        return dr.tensor_t(type(numbers))(numbers, (height, width, channel_count))

    def _motion(self, jumps: Discontinuities) -> BoundaryMotion:
        """How jumps move."""
        motion = boundary_motion(jumps, self.film, self._fine_surface, self._fine_tracer)
        if self.channels.lights is None:
            return motion
        return with_shadow_motion(
            motion, jumps, self.film, self._fine_surface, self.channels.lights
        )

    def _steps(self, jumps: Discontinuities) -> FloatArray:
        """By how much the channels (n, c) that are shown jump."""
        return self.channels.shown(jumps.behind.color - jumps.before.color)

    @property
    def _has_derivatives(self) -> bool:
        """Whether parameters of the field, levels or colors have derivatives enabled."""
        return self._surface_moves or self.channels.has_derivatives

    @functools.cached_property
    def _surface_moves(self) -> bool:
        """Whether parameters of the field or levels have derivatives enabled."""
        zero = self.backend.Array3f(0)
        return needs_derivatives(self._fine_tracer, zero, zero)

    def _zero_of_parameters(self) -> Real:
        """The number 0, with the derivative 0 by all parameters and levels, on which a picture
        depends also where it shows nothing of the surface."""
        kind, index = self.backend.Float, self.backend.UInt32(0)
        never, zero = dr.opaque(self.backend.Bool, False), kind(0)
        sources = [*differentiable_parameters(self.surface.field), *self.surface.levels]
        for source in sources:
            if dr.grad_enabled(source):
                for component in components_of(source):
                    first = dr.gather(type(component), component, index)
                    # (Of a literal, only the derivative gets into a kernel.)
                    zero = zero + dr.replace_grad(kind(0), dr.select(never, kind(first), 0))
        return zero

    def _check_derivatives(self, jumps: Discontinuities, motion: BoundaryMotion) -> None:
        """Raise an error if the picture's derivatives are not known."""
        field = self.surface.field
        if field.traits.has_jumps or field.traits.has_patches:
            raise NotImplementedError(
                f"pictures of {with_article(type(field).__name__)} have no derivatives, since its "
                "surface is made of facets or patches: detach its level and parameters"
            )
        if self._surface_moves and not has_fixed_pose(self.camera):
            raise ValueError(
                "the camera moves with the surface, which has no derivative: give it a box, or a "
                "position, a target and a fov"
            )
        self._check_domain(jumps.at(motion.kind == int(BoundaryKind.CUT)))
        size = np.abs(self._steps(jumps)).max(axis=1)
        is_unknown = motion.kind == int(BoundaryKind.UNKNOWN)
        few = max(_MAX_UNKNOWN, _FEW_UNKNOWN / max(len(jumps), 1))
        if size[is_unknown].sum() > few * size.sum():
            raise NotImplementedError(
                f"{is_unknown.sum()} of {len(jumps)} points at which the picture jumps belong to "
                "no known kind of boundary, so it is not known how they move; a function `show` "
                "must not jump where the surface is smooth"
            )

    def _check_domain(self, cuts: Discontinuities) -> None:
        """Raise NotImplementedError if the domain of the field cuts the surface and moves with a
        number that has derivatives. cuts: the points of cuts."""
        domain, clip = self.surface.field.domain, self.surface.clip_volume
        if domain is None or not len(cuts):
            return
        is_front = (cuts.before.t <= cuts.behind.t)[:, None]
        points = np.where(is_front, cuts.before.position, cuts.behind.position)
        x = upload_vectors(self._fine_tracer.backend, points)
        is_own = clip is None or to_numpy(
            dr.abs(domain.signed_distance(x)) <= dr.abs(clip.signed_distance(x))
        )
        if np.any(is_own):
            refuse_moving_domain(self.surface.field)

    # Colors.

    def _rays(self, points: FloatArray, backend: Backend) -> RayBatch:
        """The rays through screen points (n, 2), as Dr.Jit arrays of a backend."""
        origin = upload_vectors(backend, self.film.origin[None])
        directions = upload_vectors(backend, self.film.directions(points))
        return RayBatch.of(origin, directions, 0.0, np.inf, None)

    def _colors_on_grid(self) -> tuple[FloatArray, BoolArray]:
        """The channels (k, m, c) of the rays through the points of the grid, and which hit."""
        # Rays to lights begin at the surface, not within the usual tolerance of it.
        backend = self.backend if self.channels.lights is None else self._fine_tracer.backend
        rays = self._rays(self.grid.points, backend)
        with dr.suspend_grad():
            many, tracer = rays.count >= MIN_RAYS_FOR_CELLS, self._fine_tracer
            if self.channels.lights is None:
                tracer = self.surface.for_rays(rays.count).tracer(backend, many_rays=many)
            hits, _ = hits_with_derivatives(tracer, rays)
            if self.channels.lights is not None:
                hits = self._on_level(hits, rays)
            seen = self._seen(hits, rays)
        lost = int(dr.count(hits.status == int(RayStatus.OUT_OF_STEPS))[0])
        if lost:
            warnings.warn(
                f"{lost} rays of a picture ran out of steps and show the background; raise "
                "max_steps",
                stacklevel=4,
            )
        return seen.color.reshape(*self.grid.shape, -1), seen.is_hit.reshape(self.grid.shape)

    @functools.cached_property
    def _fine_surface(self) -> TracedSurface:
        """The surface with a small tolerance, for discontinuities and derivatives."""
        return with_fine_tolerance(self.surface)

    @functools.cached_property
    def _fine_tracer(self) -> SurfaceTracer:
        """The tracer of that surface in double precision."""
        return self._fine_surface.tracer(choose_backend("double"), many_rays=False)

    def _look(self, points: FloatArray) -> Seen:
        """What rays through screen points (n, 2) see, in double precision."""
        if not len(points):
            channel_count = len(self.channels.background) + self.channels.hidden_count
            return Seen(
                np.zeros(0, bool), np.zeros((0, channel_count)), np.zeros(0), np.zeros((0, 3))
            )
        with dr.suspend_grad():
            rays = self._rays(at_least_two(points), self._fine_tracer.backend)
            hits, _ = hits_with_derivatives(self._fine_tracer, rays)
            seen = self._seen(self._on_level(hits, rays), rays)
            return seen.at(np.arange(len(points)))

    def _on_level(self, hits: Hits, rays: RayBatch) -> Hits:
        """The hits of rays, moved from within the tolerance onto the level: near the curves at
        which level sets end, normals depend on it. Hits on facets and patches are exact already."""
        field = self._fine_tracer.field
        is_exact = field.traits.has_jumps or field.traits.has_patches
        if is_exact or field.boundary is None or field.boundary.closest_point is None:
            return hits
        return self._moved_to_level(hits, rays)

    def _moved_to_level(self, hits: Hits, rays: RayBatch) -> Hits:
        """The hits of rays, moved from within the tolerance onto the level."""
        tracer, is_hit = self._fine_tracer, hits.is_hit
        _, t, x, sample = hits_on_level(
            tracer, rays.origin, rays.direction, hits.t, is_hit, longest_step=_LONGEST_STEP
        )
        length = safe_norm(sample.gradient)
        return replace(
            hits,
            t=dr.select(is_hit, t, hits.t),
            position=dr.select(is_hit, x, hits.position),
            normal=dr.select(is_hit & (length > 0), sample.gradient / length, hits.normal),
        )

    def _seen(self, hits: Hits, rays: RayBatch) -> Seen:
        """What rays with these hits see, as NumPy arrays."""
        colors = self.channels.of(hits, rays.direction)
        dr.eval(colors, hits)
        columns = [np.broadcast_to(to_numpy(color), (rays.count,)) for color in colors]
        color = np.stack(columns, axis=1).astype(np.float64)
        is_hit = np.broadcast_to(to_numpy(hits.is_hit), (rays.count,))
        t = to_numpy(hits.t).astype(np.float64)
        return Seen(is_hit, color, t, to_numpy(hits.position).reshape(-1, 3))

    def _averaged(self, colors: FloatArray) -> FloatArray:
        """The means (h, w, c) of the rays in each pixel."""
        (width, height), parts = self.film.size, self.grid.samples
        inner = colors[1:-1, 1:-1].reshape(height, parts, width, parts, -1)
        return inner.mean(axis=(1, 3))

    def _smoothing(
        self, jumps: Discontinuities, motion: BoundaryMotion, weights: FloatArray
    ) -> FloatArray:
        """What is added to the picture (h, w, c), so that pixels with jumps are means along
        scanlines. weights: (n,) the number of jumps for which each stands."""
        width, height = self.film.size
        parts, n = self.grid.samples, np.arange(len(jumps))
        place = jumps.place * parts
        # The place of the ray in the part of a pixel in which the jump lies.
        columns, rows = self.grid.columns[1:-1] * parts, self.grid.rows[1:-1] * parts
        part = place.astype(int)
        is_row = jumps.axis == 0
        column, row = (np.minimum(part, len(line) - 1) for line in (columns, rows))
        part, ray = np.where(is_row, column, row), np.where(is_row, columns[column], rows[row])
        # The length on the other side of the jump than the ray, negative before the jump.
        length = np.where(ray < place, part + 1 - place, part - place)
        # Where the normal is not known, half of each direction.
        square = motion.normal[n, jumps.axis] ** 2
        square = np.where(motion.kind == int(BoundaryKind.UNKNOWN), 0.5, square)
        share = np.where(weights > 1, 0, length * square / parts**2)
        step = self._steps(jumps)
        image = np.zeros((height * width, step.shape[1]))
        np.add.at(image, pixel_indices(jumps.middle, self.film.size), share[:, None] * step)
        return image.reshape(height, width, -1)

    # Derivatives.

    def _with_boundary_derivatives(
        self, numbers: Real, jumps: Discontinuities, motion: BoundaryMotion, weights: FloatArray
    ) -> Real:
        """The numbers of the picture with the derivatives by the motion of boundaries.

        numbers: (h * w * c,) row by row.
        weights: (n,) the number of jumps for which each stands.
        """
        if not len(motion.index):
            return numbers
        tracer, backend, jump = self._fine_tracer, self.backend, motion.index
        point = upload_vectors(tracer.backend, motion.position)
        with dr.suspend_grad():
            sample = tracer.sample(point)
        change = change_of_value(tracer, point, point, sample.gradient)
        change = change - change_of_nearest_level(tracer, sample.value)
        across = np.abs(motion.normal[np.arange(len(jumps)), jumps.axis]) / self.grid.samples
        # The boundary moves away from what is seen before it.
        step = (-self._steps(jumps) * (across * weights)[:, None])[jump]
        pixel = pixel_indices(jumps.middle, self.film.size)[jump]
        for k in range(step.shape[1]):
            shares = change * upload_floats(tracer.backend, motion.weight * step[:, k])
            target = upload_integers(backend, pixel * step.shape[1] + k)
            numbers = _added_at(backend, numbers, shares, target)
        return numbers

    def _with_derivatives_inside(self, numbers: Real, samples: ScanlineSamples) -> Real:
        """The numbers of the picture (h * w * c,) with the derivatives of colors where the picture
        is smooth, as those of rays on scanlines.

        Rays that pass an edge within the tolerance, and so hit no point of the surface, do not
        count.
        """
        backend, tracer = self.backend, self._fine_tracer
        if not len(samples.axis):
            return numbers
        rays = self._rays(samples.screen, tracer.backend)
        hits, _ = hits_with_derivatives(tracer, rays, longest_step=_LONGEST_STEP)
        if not self._surface_moves:  # only derivatives need hits on the level
            hits = self._moved_to_level(hits, rays)
        colors = self.channels.of(hits, rays.direction)
        colors = colors[: len(colors) - self.channels.hidden_count]
        if not any(map(dr.grad_enabled, colors)):
            return numbers
        with dr.suspend_grad():
            point = dr.detach(hits.position)
            sample = tracer.sample(point)
            error = value_error_bound(sample, safe_norm(sample.gradient), max_norm(point))
            gap = dr.abs(tracer.levels.offset_to_nearest(sample.value))
            is_hit = to_numpy(hits.is_hit)
            index = np.flatnonzero(is_hit & to_numpy(gap <= 2 * error))
            _warn_of_share_left_out(samples.length, is_hit, index)
            point, normal = (to_numpy(v).reshape(-1, 3)[index] for v in (point, hits.normal))
        # The share of horizontal or vertical scanlines.
        image = np.einsum("nsi,ni->ns", self.film.jacobian(point), normal)
        total = np.maximum((image**2).sum(axis=1), np.finfo(float).tiny)
        share = image[np.arange(len(index)), samples.axis[index]] ** 2 / total
        weight = np.zeros(len(samples.axis))
        weight[index] = share * samples.length[index] / self.grid.samples
        weights = upload_floats(tracer.backend, weight)
        pixel = pixel_indices(samples.screen, self.film.size)
        for k, color in enumerate(colors):
            if dr.grad_enabled(color):
                target = upload_integers(backend, pixel * len(colors) + k)
                shares = dr.select(weights > 0, (color - dr.detach(color)) * weights, 0)
                numbers = _added_at(backend, numbers, shares, target)
        return numbers


def _warn_of_share_left_out(lengths: FloatArray, is_hit: BoolArray, index: IntArray) -> None:
    """Warn if much of the surface that is seen has no derivative.

    lengths: (n,) the lengths for which rays stand.
    is_hit, index: (n,) which hit, and (k,) those of them that reached the level.
    """
    left_out = 1 - lengths[index].sum() / max(lengths[is_hit].sum(), np.finfo(float).tiny)
    if is_hit.any() and left_out > _MOST_LEFT_OUT:
        warnings.warn(
            f"derivatives of this picture lack {100 * left_out:.0f} percent of the surface that is "
            "seen: hits there do not reach the level up to rounding",
            stacklevel=5,
        )


def _added_at(backend: Backend, numbers: Real, shares: Real, index: Any) -> Real:
    """Numbers with shares added at the given indices. The shares are zeros with derivatives."""
    total = backend.Float(numbers)
    dr.scatter_add(total, backend.Float(shares), index)
    return total
