"""Fields: what f is. One family a file."""

from __future__ import annotations

from harnack.enclosures import BoundedLaplacian, Curvature, HarmonicBall, Lipschitz
from harnack.fields.blobs.blobs import BlobError, Blobs
from harnack.fields.blobs.hrbf import HRBF
from harnack.fields.blobs.kernels import Compact, Cubic, Gaussian, Kernel, Sextic
from harnack.fields.blobs.molecule import Molecule
from harnack.fields.curves.polygon_mesh import PolygonMesh
from harnack.fields.curves.solid_angle import SolidAngle
from harnack.fields.expressions import expression
from harnack.fields.field import Field, Sample
from harnack.fields.formula import Formula
from harnack.fields.plane.branches import BranchPoint
from harnack.fields.plane.height_field import HeightField
from harnack.fields.plane.level_curves import LevelCurves
from harnack.fields.plane.riemann_surface import RiemannSurface
from harnack.fields.polynomials.hyperspherical import HypersphericalHarmonic
from harnack.fields.polynomials.lobes import Lobes
from harnack.fields.polynomials.polynomial import HarmonicPolynomial, SphericalHarmonic
from harnack.fields.sheets import NO_SHEET, Crossing
from harnack.fields.solids.combined import intersection, union
from harnack.fields.solids.fractal import Displaced, FractalNoise, Noise
from harnack.fields.solids.julia import Julia
from harnack.fields.solids.region import solid
from harnack.fields.solids.round import (
    Capsule,
    Cylinder,
    DoubleCone,
    Ellipsoid,
    Plane,
    Sphere,
    Torus,
)
from harnack.fields.solids.solid import Shape, Solid
from harnack.fields.solids.square import Cuboid, Superellipsoid, Supertorus
from harnack.fields.solids.tube import Tube
from harnack.fields.solids.tubes import Tubes
from harnack.fields.waves.fourier_series import FourierSeries
from harnack.fields.waves.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from harnack.fields.waves.waves import PlaneWave, Product, cosine, sine
from harnack.fields.winding.dipole import DipolePotential
from harnack.fields.winding.morph import Morph
from harnack.fields.winding.screened import ScreenedWindingNumber
from harnack.fields.winding.winding_number import WindingNumber

__all__ = [
    "HRBF",
    "NO_SHEET",
    "BlobError",
    "Blobs",
    "BoundedLaplacian",
    "BranchPoint",
    "Capsule",
    "Compact",
    "Crossing",
    "Cubic",
    "Cuboid",
    "Curvature",
    "Cylinder",
    "DipolePotential",
    "Displaced",
    "DoubleCone",
    "EigenfunctionSum",
    "Ellipsoid",
    "Field",
    "Formula",
    "FourierSeries",
    "FractalNoise",
    "Gaussian",
    "Gyroid",
    "HarmonicBall",
    "HarmonicPolynomial",
    "HeightField",
    "HypersphericalHarmonic",
    "Julia",
    "Kernel",
    "LevelCurves",
    "Lipschitz",
    "Lobes",
    "Molecule",
    "Morph",
    "Noise",
    "Plane",
    "PlaneWave",
    "PolygonMesh",
    "Product",
    "RiemannSurface",
    "Sample",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "Sextic",
    "Shape",
    "Solid",
    "SolidAngle",
    "Sphere",
    "SphericalHarmonic",
    "Superellipsoid",
    "Supertorus",
    "Torus",
    "Tube",
    "Tubes",
    "WindingNumber",
    "cosine",
    "expression",
    "intersection",
    "sine",
    "solid",
    "union",
]
