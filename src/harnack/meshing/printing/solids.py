"""Closed meshes of solids, cut by volumes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.fields import Field, Solid
from harnack.fields.solids.region import solid as solid_of
from harnack.geometry import Box, Intersection, Volume
from harnack.meshing.checks import LocalError, MeshingError
from harnack.meshing.lattice_surface import MissedError, Surface
from harnack.meshing.printing.manifolds import surface_of, volume_manifold
from harnack.meshing.printing.regions import RegionMesher, Sheet, is_smooth
from harnack.meshing.samples import CELLS_PER_WAVE, Uploads

__all__ = ["SolidMesh", "mesh_solid", "region_of"]

# Cells across a solid, if nothing is asked for.
_ACROSS = 24
# How many sizes of cells are tried, and what each is of the one before.
_MOST_ATTEMPTS = 3
_SMALLER = 0.6
# Room around what has an extent, as a part of its size.
_MARGIN = 0.01


@dataclass(frozen=True)
class SolidMesh:
    """A closed surface; the spacing of cells, evaluations of fields in points, and how many level
    sets it was made of. size: of its box, to which tolerances relate."""

    surface: Surface
    spacing: float
    evaluations: int
    levels: int
    size: float


def region_of(field: Field, solid: Any, level: float | None) -> tuple[Solid, float]:
    """The solid that is asked for by `solid`, (low, high) or True, and its level.

    Raises:
        ValueError: it is none; levels that no solid has.
        TypeError: neither.
    """
    if solid is True:
        if not isinstance(field, Solid):
            raise ValueError(
                f"solid=True is for solids, and a {type(field).__name__} has two sides: give "
                "solid=(low, high), the values inside, such as solid=(-math.inf, 0.0)"
            )
        level = field.default_level if level is None else float(level)
        return field, level
    if level is not None:
        raise ValueError("give either level or solid: the ends of a solid are its levels")
    try:
        low, high = (float(one) for one in solid)
    except (TypeError, ValueError):
        raise TypeError(f"solid must be (low, high), two numbers, or True, not {solid!r}") from None
    if not low < high or not (math.isfinite(low) or math.isfinite(high)):
        raise ValueError(f"solid must be (low, high) with low < high, one finite, not {solid}")
    field.check_levels(tuple(one for one in (low, high) if math.isfinite(one)))
    if low == -math.inf:
        return solid_of(field, below=high), 0.0
    if high == math.inf:
        return solid_of(field, above=low), 0.0
    if field.period is not None:
        return solid_of(field, around=(0.5 * (low + high), 0.5 * (high - low))), 0.0
    return solid_of(field, between=(low, high)), 0.0


def mesh_solid(
    solid: Solid,
    level: float,
    volume: Volume | None,
    tolerance: float,
    spacing: float | None,
    sheets: Callable[[float, float], Sheet],
    most_faces: int,
    check: Callable[[Surface, float], None],
    report: Callable[[str], None],
) -> SolidMesh:
    """The boundary of the points of a volume where a solid's function is at most `level`.

    volume: None for all of space. tolerance: a part of the size. sheets: given a tolerance and a
    spacing, both lengths, how to mesh the level sets of an angle. most_faces: of a level set.
    check: of the surface, given the size; where it fails in known places, smaller cells are tried,
        and half the tolerance: beside a thin part triangles within it may be anywhere.

    Raises:
        MeshingError: it has no bounds; it is empty; a part cannot be meshed.
    """
    lower, upper = _bounds(solid, level, volume)
    size = float((upper - lower).max())
    cells = size / _ACROSS if spacing is None else spacing
    error = 0.5 * tolerance * size
    attempts = _MOST_ATTEMPTS if spacing is None else 1
    per_wave = CELLS_PER_WAVE if spacing is None else None
    uploads = Uploads()
    while True:
        mesher = RegionMesher(
            lower, upper, error, cells, per_wave, sheets(error, cells), most_faces, report,
            uploads=uploads,
        )  # fmt: skip
        try:
            made = _put_together(mesher, solid, level, volume)
            if not len(made.faces):
                raise MeshingError("the solid is empty: no point of the box is inside")
            check(made, size)
            break
        except (MissedError, LocalError) as wrong:
            attempts -= 1
            if not attempts:
                raise
            cells *= _SMALLER
            per_wave = CELLS_PER_WAVE * size / (_ACROSS * cells)
            if isinstance(wrong, LocalError):
                error *= 0.5
            report(f"{wrong}; so cells of {cells:.3g}")
    return SolidMesh(made, min(cells, mesher.finest), mesher.evaluations, mesher.levels, size)


def _put_together(
    mesher: RegionMesher, solid: Solid, level: float, volume: Volume | None
) -> Surface:
    """The boundary of the solid in the volume."""
    if volume is None and is_smooth(solid):
        return mesher.smooth(solid, level)[0]
    lower, upper = mesher.lower, mesher.upper
    whole = mesher.below(solid, level)
    mesher.report("putting the parts together")
    if volume is None:
        volume = Box(_point(lower), _point(upper))
    cut = volume_manifold(volume, lower, upper, mesher.tolerance)
    return _on_box(surface_of(whole ^ cut), volume)


def _bounds(solid: Solid, level: float, volume: Volume | None) -> tuple[FloatArray, FloatArray]:
    """A box that holds the solid within the volume.

    Raises:
        MeshingError: there is none.
    """
    lower, upper = np.full(3, -np.inf), np.full(3, np.inf)
    if volume is not None:
        lower, upper = (np.array(end, np.float64) for end in volume.bounds())
    hull = solid.hull(level)
    if hull is not None:
        low, high = (np.array(end, np.float64) for end in hull.bounds())
        pad = _MARGIN * float((high - low).max())
        if math.isfinite(pad):
            low, high = low - pad, high + pad
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise MeshingError(
            f"{type(solid).__name__} does not say where it ends (a solid does not end at the "
            "domain of the field it is made of): give clip=harnack.Box(lower, "
            "upper) or harnack.Ball(center, radius)"
        )
    if not (lower < upper).all():
        raise MeshingError("the solid is empty: it lies outside of the clip")
    return lower, upper


def _point(x: FloatArray) -> tuple[float, float, float]:
    return float(x[0]), float(x[1]), float(x[2])


def _on_box(surface: Surface, volume: Volume) -> Surface:
    """Vertices within rounding of a box's faces, put there."""
    boxes = volume.volumes if isinstance(volume, Intersection) else (volume,)
    vertices = surface.vertices
    for box in boxes:
        if isinstance(box, Box):
            vertices = np.clip(vertices, *box.bounds())
            for end in box.bounds():
                near = np.abs(vertices - end) <= 1e-12 * (1 + np.abs(end))
                vertices = np.where(near, end, vertices)
    return Surface(vertices, surface.faces)
