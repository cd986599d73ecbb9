"""All figures by number."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from . import analysis, films, methods, numerics, polygons, repairs, shells, tracing
from .figure import Figure

_ALL = (
    Figure(
        1,
        "A surface without inside or outside",
        "a nonplanar polygon spanned by a level set, isolines of a slice of the function, "
        "spheres that show Harnack bounds along a ray, and smooth reflection lines.",
        polygons.figure_1,
    ),
    Figure(
        4,
        "Bounds that do not hold",
        "artifacts where the lower bound c given to the algorithm does not bound the function: "
        "worse as c grows, and for rays that come from below.",
        tracing.figure_4,
    ),
    Figure(
        5,
        "Stopping conditions",
        "by |f - f*| < ε alone rays end in a region of uneven thickness; divided by the length "
        "of the gradient, in one of nearly even thickness.",
        tracing.figure_5,
    ),
    Figure(
        7,
        "Spherical harmonics",
        "each spherical harmonic as level sets of its harmonic polynomial, restricted to the "
        "unit ball.",
        analysis.figure_7,
    ),
    Figure(
        8,
        "Nonplanar polygons, their boundaries and levels",
        "well-behaved surfaces while the boundary leaves its plane (top), and other levels, by "
        "which convexity is adjusted (bottom).",
        polygons.figure_8,
    ),
    Figure(
        9,
        "Bilinear patches fold over",
        "quadrilaterals by bilinear interpolation, which folds over even in a plane, beside "
        "level sets of the solid angle, which do not.",
        polygons.figure_9,
    ),
    Figure(
        11,
        "Continuity",
        "level sets that vary continuously with their boundary curves (top), where minimal "
        "surfaces, often similar, jump (bottom).",
        films.figure_11,
    ),
    Figure(
        12,
        "Formulas in floating point",
        "by triangulation and quaternions solid angles are accurate, by angle sums they are not "
        "(top); gradients by Biot-Savart and by Adiels et al. are accurate, by differences they "
        "are wrong at jumps (bottom).",
        numerics.figure_12,
    ),
    Figure(
        13,
        "Holes and knots",
        "polygons with holes (left) and with knotted boundaries (right).",
        polygons.figure_13,
    ),
    Figure(
        14,
        "Exoskeletons",
        "a sparse net of curves that stands for a surface, the surface traced through it, and "
        "the plain triangulation that mesh viewers show.",
        repairs.figure_14,
    ),
    Figure(
        15,
        "Point clouds",
        "an oriented point cloud (left) and the surface that interpolates it (right), without a "
        "mesh or a linear solve.",
        repairs.figure_15,
    ),
    Figure(
        16,
        "Mesh repair",
        "a mesh with holes (left) and the surface of its generalized winding number (right).",
        repairs.figure_16,
    ),
    Figure(
        17,
        "Grid shells",
        "three shells of architecture: level sets of the solid angle of plane outlines with "
        "round holes, and networks of principal curvature; rendered in 4.5 hours.",
        shells.figure_17,
    ),
    Figure(
        19,
        "Riemann surfaces",
        "surfaces of several complex functions, in the unit ball (top) and in full view (bottom).",
        analysis.figure_19,
    ),
    Figure(
        20,
        "The gyroid",
        "a printed gyroid (left) and one traced as a slice of a harmonic function of four "
        "variables (right).",
        analysis.figure_20,
    ),
    Figure(
        21,
        "Any implicit function",
        "the 1/2 level of a sum of two Laplacian eigenfunctions, which is neither harmonic nor "
        "an eigenfunction.",
        analysis.figure_21,
    ),
    Figure(
        22,
        "Iterations a ray",
        "the most iterations are needed near silhouettes; stopping by the gradient takes fewer "
        "than by the value alone, above all near the boundary.",
        tracing.figure_22,
    ),
    Figure(
        23,
        "Convergence",
        "errors in value and in distance after each iteration, of Harnack tracing and of sphere "
        "tracing a mesh of the same level set: means and 99 % bands; sphere tracing needs many "
        "fewer.",
        tracing.figure_23,
    ),
    Figure(
        24,
        "Marching cubes",
        "marching cubes of the raw function has spurious sheets where the angle jumps, and rough "
        "edges near singularities (left); filtering faces leaves noise (right).",
        methods.figure_24,
    ),
    Figure(
        25,
        "Fixed steps",
        "ray marching tunnels through the surface with large steps, and is far too slow with "
        "small ones.",
        methods.figure_25,
    ),
    Figure(
        26,
        "Claimed Lipschitz constants",
        "sphere tracing with a claimed constant has artifacts near singularities even where it "
        "is large and slow; L = 50 costs about what Harnack tracing does.",
        methods.figure_26,
    ),
    Figure(
        27,
        "Root finding",
        "Newton's method, bisection and interval analysis on a gyroid and a polygon: wrong "
        "occlusions, gaps, and jumps taken for roots; interval analysis is right on the gyroid.",
        methods.figure_27,
    ),
)

FIGURES: Mapping[int, Figure] = MappingProxyType({one.number: one for one in _ALL})
"""The figures of the paper that show a result."""
