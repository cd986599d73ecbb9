"""Fields: what f is. One family a file."""

from __future__ import annotations

from harnack.fields.field import Curvature, Field, HarmonicBall, Lipschitz, Sample
from harnack.fields.periodic import EigenfunctionSum, Gyroid, SchwarzD, SchwarzP
from harnack.fields.polynomial import HarmonicPolynomial, SphericalHarmonic
from harnack.fields.solid_angle import SolidAngle
from harnack.fields.waves import PlaneWave, Product, cosine, sine

__all__ = [
    "Curvature",
    "EigenfunctionSum",
    "Field",
    "Gyroid",
    "HarmonicBall",
    "HarmonicPolynomial",
    "Lipschitz",
    "PlaneWave",
    "Product",
    "Sample",
    "SchwarzD",
    "SchwarzP",
    "SolidAngle",
    "SphericalHarmonic",
    "cosine",
    "sine",
]
