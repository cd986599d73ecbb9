"""Which pixels surfaces may cover in part: found by cones, so that no thin part is overlooked.

The ray through the middle of a pixel misses what is thinner than the pixel more often than not, and
so do those of its neighbours. The cone that holds the pixel does not.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import BoolArray, choose_backend, to_numpy
from harnack.rendering.mitsuba.variant import mitsuba_backend
from harnack.rendering.mitsuba.world import World
from harnack.rendering.surfaces.placement import PlacedSurface

if TYPE_CHECKING:
    from harnack.backend import Backend, Real, Vec3
    from harnack.geometry import Volume


class Finder:
    """The surfaces of a world, to be met by cones.

    Raises:
        ValueError: a field that jumps, such as the winding number of a mesh: it is constant on both
            sides of the surface, so that its values tell no distance.
    """

    def __init__(self, mi: Any, world: World) -> None:
        self.mi = mi
        self.placed = tuple(_prepared(mi, carrier) for carrier in world.carriers)

    def find(self, ray: Any, position: Any) -> BoolArray:
        """Whether the cones of pixels are covered in part before the points that rays see.

        ray: through the middles, with differentials. position: seen; NaN where nothing is.
        """
        mi = self.mi
        away = dr.norm(position - ray.o)
        t = dr.select(dr.isfinite(away), away, dr.largest(mi.Float))
        x, y = ray.d_x - ray.d, ray.d_y - ray.d
        radius = 0.5 * dr.maximum(dr.norm(x + y), dr.norm(x - y))  # half the longer diagonal
        found = dr.zeros(mi.Bool, dr.width(ray.d))
        for placed, around in self.placed:
            found |= placed.covers_in_part(ray.o, ray.d, radius, t, around)
        found_there: BoolArray = to_numpy(found)
        return found_there


def _prepared(mi: Any, carrier: Any) -> tuple[PlacedSurface, Any]:
    """A surface that can be looked at outside its extent, and balls in and around the extent."""
    surface, backend = carrier.surface, mitsuba_backend(mi)
    if surface.field.has_parts:
        raise ValueError(
            f'antialias="cones" takes a level set of one function, and {surface.field!r} has one '
            'for each part. Leave antialias at "edges"'
        )
    if surface.field.has_sheets:
        raise ValueError(
            f'antialias="cones" takes fields without jumps, and {surface.field!r} jumps: its '
            'values tell no distance. Leave antialias at "edges"'
        )
    placed = replace(carrier.placed, prepared=surface.prepare(backend, crosses=True))
    return placed, balls_of(surface.volume, backend)


def balls_of(volume: Volume | None, backend: Backend) -> tuple[Vec3, Real, Real] | None:
    """The middle of a volume, and the radii about it of a ball in it and of one around it; None
    where it has no end or no such ball was found."""
    if volume is None:
        return None
    lower, upper = (np.asarray(end, dtype=np.float64) for end in volume.bounds())
    if not np.isfinite(upper - lower).all():
        return None
    middle = (0.5 * (lower + upper)).tolist()
    # Not half the box: other volumes have faces that lie nearer to its middle.
    there = choose_backend("double").Array3f(*middle)
    depth = -float(to_numpy(volume.signed_distance(there))[0]) * (1 - 1e-6)
    if not depth > 0:
        return None
    size = 0.5 * float(np.linalg.norm(upper - lower))
    numbers = [dr.opaque(backend.Float, x) for x in (*middle, depth, size)]
    return backend.Array3f(*numbers[:3]), numbers[3], numbers[4]
