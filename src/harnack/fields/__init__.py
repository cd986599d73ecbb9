"""Fields: what f is. One family a file."""

from __future__ import annotations

from harnack.fields.dipole import DipolePotential
from harnack.fields.field import Curvature, Field, HarmonicBall, LineLipschitz, Lipschitz, Sample
from harnack.fields.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from harnack.fields.polynomial import HarmonicPolynomial, SphericalHarmonic
from harnack.fields.screened import ScreenedWindingNumber
from harnack.fields.sheets import NO_SHEET, Crossing
from harnack.fields.solid_angle import SolidAngle
from harnack.fields.waves import PlaneWave, Product, cosine, sine
from harnack.fields.winding_number import WindingNumber

__all__ = [
    "NO_SHEET",
    "Crossing",
    "Curvature",
    "DipolePotential",
    "EigenfunctionSum",
    "Field",
    "Gyroid",
    "HarmonicBall",
    "HarmonicPolynomial",
    "LineLipschitz",
    "Lipschitz",
    "PlaneWave",
    "Product",
    "Sample",
    "SchwarzD",
    "SchwarzP",
    "ScreenedWindingNumber",
    "SolidAngle",
    "SphericalHarmonic",
    "WindingNumber",
    "cosine",
    "sine",
]
