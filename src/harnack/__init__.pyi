"""Every public name and where it is. `__init__.py` reads this file, and imports on first use."""

from . import (
    arithmetic,
    backend,
    distance,
    enclosures,
    fields,
    files,
    geometry,
    meshing,
    rendering,
    testing,
    tracer,
)
from ._version import __version__
from .arithmetic import (
    absolute,
    acos,
    asin,
    atan,
    atan2,
    cos,
    cosh,
    exp,
    log,
    maximum,
    minimum,
    norm,
    sin,
    sinh,
    sqrt,
    tan,
    tanh,
)
from .backend.tensors import wrap_for_jax, wrap_for_torch
from .cluster.zarr_files import to_zarr
from .distance import (
    Curvatures,
    DistanceBounds,
    closest_points,
    curvature,
    curvature_lines,
    distance_bounds,
    signed_distance,
)
from .enclosures.bounded_laplacian import GreenBall
from .enclosures.enclosure import Enclosure
from .enclosures.harmonic_ball import Caps, Classic, Slope
from .enclosures.parabola import Cone, Parabola, Taylor
from .enclosures.piecewise_taylor import Pieces
from .enclosures.promises import BoundedLaplacian, Curvature, HarmonicBall, Lipschitz
from .fields.analytic.branches import BranchPoint
from .fields.analytic.fourier_series import FourierSeries
from .fields.analytic.hyperspherical import HypersphericalHarmonic
from .fields.analytic.lobes import Lobes
from .fields.analytic.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from .fields.analytic.plane import HeightField, LevelCurves
from .fields.analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from .fields.analytic.riemann_surface import RiemannSurface
from .fields.analytic.waves import PlaneWave, Product, cosine, sine
from .fields.blobs.blobs import Blobs, Molecule
from .fields.blobs.hrbf import HRBF
from .fields.blobs.kernels import Compact, Cubic, Gaussian, Sextic
from .fields.expressions import expression
from .fields.field import Field, Sample
from .fields.solid_angles.dipole import DipolePotential
from .fields.solid_angles.morph import Morph
from .fields.solid_angles.polygon_mesh import PolygonMesh
from .fields.solid_angles.screened import ScreenedWindingNumber
from .fields.solid_angles.solid_angle import SolidAngle
from .fields.solid_angles.winding_number import WindingNumber
from .fields.solids.booleans import intersection, union
from .fields.solids.extrusions import Extruded, Revolved
from .fields.solids.fractal import Displaced, FractalNoise, Noise
from .fields.solids.from_field import solid
from .fields.solids.julia import Julia
from .fields.solids.primitives import (
    Capsule,
    Cuboid,
    Cylinder,
    DoubleCone,
    Ellipsoid,
    Plane,
    Sphere,
    Superellipsoid,
    Supertorus,
    Torus,
)
from .fields.solids.solid import Shape, Solid
from .fields.solids.thread import Thread, thread
from .fields.solids.tube import Tube, Tubes
from .files import outline
from .geometry import Ball, Box, Circle, ConvexHull, HalfSpace, Intersection
from .meshing import (
    MeshingError,
    PrintCheck,
    PrintProblem,
    Thickness,
    check_print,
    mesh,
    repair,
    thickness,
)
from .rendering import Camera, Isolines, animate, render
from .tracer import AllHits, Hits, LevelSet, Status, Tolerance, level_set, trace
from .view import SavedScene, SceneFileError, Slider, View, page, read_scene, view, write_scene

__all__ = [
    "HRBF",
    "AllHits",
    "Ball",
    "Blobs",
    "BoundedLaplacian",
    "Box",
    "BranchPoint",
    "Camera",
    "Caps",
    "Capsule",
    "Circle",
    "Classic",
    "Compact",
    "Cone",
    "ConvexHull",
    "Cubic",
    "Cuboid",
    "Curvature",
    "Curvatures",
    "Cylinder",
    "DipolePotential",
    "Displaced",
    "DistanceBounds",
    "DoubleCone",
    "EigenfunctionSum",
    "Ellipsoid",
    "Enclosure",
    "Extruded",
    "Field",
    "FourierSeries",
    "FractalNoise",
    "Gaussian",
    "GreenBall",
    "Gyroid",
    "HalfSpace",
    "HarmonicBall",
    "HarmonicPolynomial",
    "HeightField",
    "Hits",
    "HypersphericalHarmonic",
    "Intersection",
    "Isolines",
    "Julia",
    "LevelCurves",
    "LevelSet",
    "Lipschitz",
    "Lobes",
    "MeshingError",
    "Molecule",
    "Morph",
    "Noise",
    "Parabola",
    "Pieces",
    "Plane",
    "PlaneWave",
    "PolygonMesh",
    "PrintCheck",
    "PrintProblem",
    "Product",
    "Revolved",
    "RiemannSurface",
    "Sample",
    "SavedScene",
    "SceneFileError",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "Sextic",
    "Shape",
    "Slider",
    "Slope",
    "Solid",
    "SolidAngle",
    "Sphere",
    "SphericalHarmonic",
    "Status",
    "Superellipsoid",
    "Supertorus",
    "Taylor",
    "Thickness",
    "Thread",
    "Tolerance",
    "Torus",
    "Tube",
    "Tubes",
    "View",
    "WindingNumber",
    "__version__",
    "absolute",
    "acos",
    "animate",
    "arithmetic",
    "asin",
    "atan",
    "atan2",
    "backend",
    "check_print",
    "closest_points",
    "cos",
    "cosh",
    "cosine",
    "curvature",
    "curvature_lines",
    "distance",
    "distance_bounds",
    "enclosures",
    "exp",
    "expression",
    "fields",
    "files",
    "geometry",
    "intersection",
    "level_set",
    "log",
    "maximum",
    "mesh",
    "meshing",
    "minimum",
    "norm",
    "outline",
    "page",
    "read_scene",
    "render",
    "rendering",
    "repair",
    "signed_distance",
    "sin",
    "sine",
    "sinh",
    "solid",
    "sqrt",
    "tan",
    "tanh",
    "testing",
    "thickness",
    "thread",
    "to_zarr",
    "trace",
    "tracer",
    "union",
    "view",
    "wrap_for_jax",
    "wrap_for_torch",
    "write_scene",
]
