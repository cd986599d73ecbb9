"""All figures by number."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from . import polygons, tracing
from .figure import Figure

_ALL = (
    Figure(
        1,
        "A surface without inside or outside",
        "a nonplanar polygon spanned by a level set, isolines of a slice of the function, spheres "
        "that show Harnack bounds along a ray, and smooth reflection lines.",
        polygons.figure_1,
    ),
    Figure(
        4,
        "Bounds that do not hold",
        "artifacts where the lower bound c given to the algorithm does not bound the function: worse "
        "as c grows, and for rays that come from below.",
        tracing.figure_4,
    ),
    Figure(
        5,
        "Stopping conditions",
        "by |f - f*| < ε alone rays end in a region of uneven thickness; divided by the length of the "
        "gradient, in one of nearly even thickness.",
        tracing.figure_5,
    ),
    Figure(
        8,
        "Nonplanar polygons, their boundaries and levels",
        "well-behaved surfaces while the boundary leaves its plane (top), and other levels, by which "
        "convexity is adjusted (bottom).",
        polygons.figure_8,
    ),
    Figure(
        9,
        "Bilinear patches fold over",
        "quadrilaterals by bilinear interpolation, which folds over even in a plane, beside level "
        "sets of the solid angle, which do not.",
        polygons.figure_9,
    ),
    Figure(
        13,
        "Holes and knots",
        "polygons with holes (left) and with knotted boundaries (right).",
        polygons.figure_13,
    ),
    Figure(
        22,
        "Iterations a ray",
        "the most iterations are needed near silhouettes; stopping by the gradient takes fewer than by "
        "the value alone, above all near the boundary.",
        tracing.figure_22,
    ),
    Figure(
        23,
        "Convergence",
        "errors in value and in distance after each iteration, of Harnack tracing and of sphere tracing "
        "a mesh of the same level set: means and 99 % bands; sphere tracing needs many fewer.",
        tracing.figure_23,
    ),
)

FIGURES: Mapping[int, Figure] = MappingProxyType({one.number: one for one in _ALL})
"""The figures of the paper that show a result."""
