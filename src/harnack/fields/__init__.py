"""Fields: what f is. One family a file."""

from __future__ import annotations

from harnack.fields.field import Field, HarmonicBall, Lipschitz, Sample
from harnack.fields.solid_angle import SolidAngle

__all__ = ["Field", "HarmonicBall", "Lipschitz", "Sample", "SolidAngle"]
