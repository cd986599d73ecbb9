"""Outlines to more digits than bisection gives: where on their scanline rays touch the surface, and
which color it has there.

At the distance e inside an outline that bends with the radius R, the normal has turned by (2 e/R)^
(1/2): by 2 degrees for 1/216 of a pixel and R of ten pixels. And the derivatives of what is seen
grow like e^(-1/2), so that a piece of a scanline which begins too far inside by e lacks (e/L)^(1/2)
of its integral, where L is its length: near a percent. Bisection to a hundredth of that would take
as many rays as all the rest; one step of Newton's method takes two samples.

A ray of an outline comes with its contact, the point c of the ray at which it is tangent to a level
set, grad f . d = 0 (`boundary_motion`). If the ray moves by s on the screen, f at its contact
changes by s grad f . dc/ds, where c moves at its depth: motion along the ray does not count. So
s = (level - f(c))/(grad f . dc/ds) is where f at the contact is the level, up to a relative error
of the order of e/R."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np

from harnack.backend import to_numpy
from harnack.backend.arrays import upload_vectors
from harnack.backend.elementary import safe_norm
from harnack.inverse.boundary_motion import BoundaryKind
from harnack.tracer.hits import Hits
from harnack.tracer.level_contact import RayStatus

if TYPE_CHECKING:
    from harnack.backend import FloatArray, Real, Vec3
    from harnack.inverse.boundary_motion import BoundaryMotion
    from harnack.inverse.channels import ChannelFunction
    from harnack.inverse.discontinuities import Discontinuities
    from harnack.inverse.film import Film
    from harnack.tracer.surface_tracer import SurfaceTracer

# The motion of a contact on the screen is taken as a difference over this part of a pixel.
_DIFFERENCE = 0.01


def with_exact_outlines(
    jumps: Discontinuities, motion: BoundaryMotion, film: Film, tracer: SurfaceTracer,
    channels: ChannelFunction,
) -> Discontinuities:  # fmt: skip
    """The jumps of a picture with outlines where rays touch the surface, and the colors there.

    An outline stays between the two rays by which it was found.
    """
    is_outline = motion.kind[motion.index] == int(BoundaryKind.OUTLINE)
    index, contact = motion.index[is_outline], motion.position[is_outline]
    if not len(index):
        return jumps
    is_before = jumps.before.t[index] <= jumps.behind.t[index]
    traced = np.where(
        is_before[:, None], jumps.before.position[index], jumps.behind.position[index]
    )
    ends, n, backend = jumps.screen[index], np.arange(len(index)), tracer.backend
    inside, axis = ends[n, np.where(is_before, 0, 1)], jumps.axis[index]
    with dr.suspend_grad():
        points = upload_vectors(backend, contact)
        sample = tracer.sample(points)
        gap = to_numpy(tracer.levels.offset_to_nearest(sample.value))
        gradient = to_numpy(sample.gradient).reshape(-1, 3)
        direction = upload_vectors(backend, film.directions(inside))
        # At the contact the normal has no side, so it is that of the ray that hit.
        side = dr.dot(tracer.sample(upload_vectors(backend, traced)).gradient, direction)
        turn = dr.select(side > 0, -1.0, 1.0) / safe_norm(sample.gradient)
        normal = sample.gradient * turn
        distance = safe_norm(points - upload_vectors(backend, film.origin[None]))
        # Where the color is asked for, the contact is on the surface: shadows depend on it.
        step = tracer.levels.offset_to_nearest(sample.value) / dr.squared_norm(sample.gradient)
        on_surface = points + sample.gradient * dr.select(dr.isfinite(step), step, 0)
        shown = channels.of(_hits(on_surface, distance, normal), direction - normal)
    columns = [np.broadcast_to(to_numpy(color), (len(index),)) for color in shown]
    color = np.stack(columns, axis=1).astype(np.float64)
    before, behind = jumps.before.color.copy(), jumps.behind.color.copy()
    before[index[is_before]], behind[index[~is_before]] = color[is_before], color[~is_before]

    moved = inside.copy()
    moved[n, axis] += _DIFFERENCE
    depth = np.linalg.norm(contact - film.origin, axis=1)[:, None]
    motions = depth * (film.directions(moved) - film.directions(inside)) / _DIFFERENCE
    low, high = ends[n, 0, axis], ends[n, 1, axis]
    with np.errstate(invalid="ignore", divide="ignore"):
        touching: FloatArray = inside[n, axis] + gap / (gradient * motions).sum(axis=1)
    middle = (low + high) / 2
    place: FloatArray = np.where(np.isfinite(touching), np.clip(touching, low, high), middle)
    screen = jumps.screen.copy()
    screen[index, :, axis] += (place - middle)[:, None]
    return replace(
        jumps, screen=screen, before=replace(jumps.before, color=before),
        behind=replace(jumps.behind, color=behind),
    )  # fmt: skip


def _hits(position: Vec3, t: Real, normal: Vec3) -> Hits:
    """Hits at points (3,) of the surface with these unit normals (3,). t: the distances from the
    camera."""
    count = dr.zeros(dr.uint32_array_t(type(t)), dr.width(t))
    status, none = count + int(RayStatus.HIT), dr.int32_array_t(type(t))(-1)
    return Hits(t, position, normal, 0 * t, count, status, none, 0 * t)
