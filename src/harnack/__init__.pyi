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
    CurvatureSamples,
    DistanceBounds,
    closest_points,
    curvature,
    curvature_lines,
    distance_bounds,
    signed_distance,
)
from .enclosures.bounded_laplacian import BoundedLaplacianEnclosure
from .enclosures.enclosure import Enclosure
from .enclosures.harmonic_ball import HarnackEnclosure, HarnackSlopeEnclosure, SphericalCapEnclosure
from .enclosures.parabola import LipschitzEnclosure, ParabolaEnclosure, TaylorEnclosure
from .enclosures.piecewise_taylor import PiecewiseTaylorEnclosure
from .enclosures.promises import BoundedLaplacian, HarmonicBall, Lipschitz, TaylorRemainder
from .fields.analytic.branches import BranchPoint
from .fields.analytic.fourier_series import FourierSeries
from .fields.analytic.hyperspherical import HypersphericalHarmonic
from .fields.analytic.lobes import Lobes
from .fields.analytic.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from .fields.analytic.plane import HeightField, LevelCurves
from .fields.analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from .fields.analytic.riemann_surface import RiemannSurface
from .fields.analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from .fields.blobs.blobs import Blobs, Molecule
from .fields.blobs.hrbf import HRBF
from .fields.blobs.kernels import CompactKernel, CubicKernel, GaussianKernel, SexticKernel
from .fields.expressions import expression
from .fields.field import Field, Sample
from .fields.solid_angles.dipole import DipolePotential
from .fields.solid_angles.morph import Morph
from .fields.solid_angles.polygon_mesh import PolygonMesh
from .fields.solid_angles.screened import ScreenedWindingNumber
from .fields.solid_angles.solid_angle import SolidAngle
from .fields.solid_angles.winding_number import WindingNumber
from .fields.solids.booleans import intersection, union
from .fields.solids.extrusions import Extrusion, SolidOfRevolution
from .fields.solids.fractal import DisplacedSolid, FractalNoise, Noise
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
from .fields.solids.solid import FormulaSolid, Solid
from .fields.solids.thread import Thread, metric_thread
from .fields.solids.tube import Tube, TubeNetwork
from .files import outline
from .geometry import Ball, Box, Circle, ConvexHull, HalfSpace, VolumeIntersection
from .meshing import (
    MeshingError,
    PrintCheck,
    PrintProblem,
    WallThickness,
    check_print,
    mesh,
    repair,
    wall_thickness,
)
from .rendering import Camera, Isolines, animate, render
from .tracer import (
    Hits,
    HitTolerance,
    RayCrossings,
    RayStatus,
    Surface,
    TraceOptions,
    crossings,
    trace,
)
from .view import LiveView, SceneFile, SceneFileError, Slider, page, read_scene, view, write_scene

__all__ = [
    "HRBF",
    "Ball",
    "Blobs",
    "BoundedLaplacian",
    "BoundedLaplacianEnclosure",
    "Box",
    "BranchPoint",
    "Camera",
    "Capsule",
    "Circle",
    "CompactKernel",
    "ConvexHull",
    "CubicKernel",
    "Cuboid",
    "CurvatureSamples",
    "Cylinder",
    "DipolePotential",
    "DisplacedSolid",
    "DistanceBounds",
    "DoubleCone",
    "EigenfunctionSum",
    "Ellipsoid",
    "Enclosure",
    "Extrusion",
    "Field",
    "FormulaSolid",
    "FourierSeries",
    "FractalNoise",
    "GaussianKernel",
    "Gyroid",
    "HalfSpace",
    "HarmonicBall",
    "HarmonicPolynomial",
    "HarnackEnclosure",
    "HarnackSlopeEnclosure",
    "HeightField",
    "HitTolerance",
    "Hits",
    "HypersphericalHarmonic",
    "Isolines",
    "Julia",
    "LevelCurves",
    "Lipschitz",
    "LipschitzEnclosure",
    "LiveView",
    "Lobes",
    "MeshingError",
    "Molecule",
    "Morph",
    "Noise",
    "ParabolaEnclosure",
    "PiecewiseTaylorEnclosure",
    "Plane",
    "PlaneWave",
    "PolygonMesh",
    "PrintCheck",
    "PrintProblem",
    "RayCrossings",
    "RayStatus",
    "RiemannSurface",
    "Sample",
    "SceneFile",
    "SceneFileError",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "SexticKernel",
    "Slider",
    "Solid",
    "SolidAngle",
    "SolidOfRevolution",
    "Sphere",
    "SphericalCapEnclosure",
    "SphericalHarmonic",
    "Superellipsoid",
    "Supertorus",
    "Surface",
    "TaylorEnclosure",
    "TaylorRemainder",
    "Thread",
    "Torus",
    "TraceOptions",
    "Tube",
    "TubeNetwork",
    "VolumeIntersection",
    "WallThickness",
    "WaveProduct",
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
    "cosine_factor",
    "crossings",
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
    "log",
    "maximum",
    "mesh",
    "meshing",
    "metric_thread",
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
    "sine_factor",
    "sinh",
    "solid",
    "sqrt",
    "tan",
    "tanh",
    "testing",
    "to_zarr",
    "trace",
    "tracer",
    "union",
    "view",
    "wall_thickness",
    "wrap_for_jax",
    "wrap_for_torch",
    "write_scene",
]
