"""Certificates: what is known near a point about the levels asked for.

`certify` turns what a field promises (`Sample.known`, in the field's own units) into what a
bound needs. It knows kinds of knowledge, never fields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from harnack.certify.ball import BallCertificate, from_ball
from harnack.certify.curvature import CurvatureCertificate, from_curvature
from harnack.certify.levels import Levels
from harnack.certify.lipschitz import LipschitzCertificate, from_lipschitz
from harnack.fields.field import Curvature, HarmonicBall

if TYPE_CHECKING:
    from harnack.backend import Real
    from harnack.fields.field import Sample

__all__ = [
    "BallCertificate",
    "Certificate",
    "CurvatureCertificate",
    "Levels",
    "LipschitzCertificate",
    "certify",
]

Certificate = BallCertificate | LipschitzCertificate | CurvatureCertificate


def certify(sample: Sample, gap_down: Real, gap_up: Real) -> tuple[Certificate, ...]:
    """One certificate for each thing that the sample knows, in the same order."""
    return tuple(
        from_ball(known, sample.value, gap_down, gap_up, sample.error)
        if isinstance(known, HarmonicBall)
        else from_curvature(known, gap_down, gap_up)
        if isinstance(known, Curvature)
        else from_lipschitz(known, gap_down, gap_up)
        for known in sample.known
    )
