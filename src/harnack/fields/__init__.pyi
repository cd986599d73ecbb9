"""Every field but solids, and where it is."""

from .analytic.branches import BranchPoint
from .analytic.fourier_series import FourierSeries
from .analytic.hyperspherical import HypersphericalHarmonic
from .analytic.lobes import Lobes
from .analytic.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from .analytic.plane import HeightField, LevelCurves
from .analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from .analytic.riemann_surface import RiemannSurface
from .analytic.waves import PlaneWave, WaveProduct, cosine_factor, sine_factor
from .blobs.blobs import Blobs, Molecule
from .blobs.hrbf import HRBF
from .capabilities import (
    NO_FACET,
    NO_PATCH,
    Boundary,
    JumpCrossing,
    Jumps,
    MovingTriangles,
    NearestFacet,
    PatchEntry,
    Patches,
    VariableAccuracy,
)
from .expressions import expression
from .field import EvaluateOnly, Evaluator, Field, Plan, Sample, SampleEvaluator, Traits
from .formula import Formula
from .networks.network import Network
from .products import FieldProduct
from .solid_angles.dipole import DipolePotential
from .solid_angles.morph import Morph
from .solid_angles.polygon_mesh import PolygonMesh
from .solid_angles.screened import ScreenedWindingNumber
from .solid_angles.solid_angle import SolidAngle
from .solid_angles.winding_number import WindingNumber
from .solids.solid import FormulaSolid, Solid
from .sums import FieldSum

__all__ = [
    "HRBF",
    "NO_FACET",
    "NO_PATCH",
    "Blobs",
    "Boundary",
    "BranchPoint",
    "DipolePotential",
    "EigenfunctionSum",
    "EvaluateOnly",
    "Evaluator",
    "Field",
    "FieldProduct",
    "FieldSum",
    "Formula",
    "FormulaSolid",
    "FourierSeries",
    "Gyroid",
    "HarmonicPolynomial",
    "HeightField",
    "HypersphericalHarmonic",
    "JumpCrossing",
    "Jumps",
    "LevelCurves",
    "Lobes",
    "Molecule",
    "Morph",
    "MovingTriangles",
    "NearestFacet",
    "Network",
    "PatchEntry",
    "Patches",
    "Plan",
    "PlaneWave",
    "PolygonMesh",
    "RiemannSurface",
    "Sample",
    "SampleEvaluator",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "Solid",
    "SolidAngle",
    "SphericalHarmonic",
    "Traits",
    "VariableAccuracy",
    "WaveProduct",
    "WindingNumber",
    "cosine_factor",
    "expression",
    "sine_factor",
]
