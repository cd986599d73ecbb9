"""Enclosures: what is proved about f along a path. One proof a file; none knows a field by name."""

from __future__ import annotations

from harnack.enclosures.arc import Arc
from harnack.enclosures.balls.ball import Ball
from harnack.enclosures.balls.bounded_laplacian import GreenBall
from harnack.enclosures.balls.caps import Caps
from harnack.enclosures.balls.classic import Classic
from harnack.enclosures.balls.slope import Slope
from harnack.enclosures.cusp import Cusp
from harnack.enclosures.enclosure import Enclosure, Gaps, Slopes
from harnack.enclosures.extremum import Greatest, Negated, Part, Stretched
from harnack.enclosures.levels import TargetLevels
from harnack.enclosures.literature import (
    AffineBand,
    Band,
    BottomUpLinear,
    BottomUpQuadratic,
    IntervalRange,
    Mixed,
)
from harnack.enclosures.nearest import Nearest, Sheet
from harnack.enclosures.parabola import Cone, Parabola, Taylor
from harnack.enclosures.pieces import LinearTaylor, OnePiece, Pieces, QuadraticTaylor, Segment
from harnack.enclosures.promises import (
    BoundedLaplacian,
    Curvature,
    HarmonicBall,
    Lipschitz,
    Promise,
)
from harnack.enclosures.proofs import Choice, Proofs, any_covers, choose_proofs, longest_step
from harnack.enclosures.restriction import Evaluable, Piece, Restriction
from harnack.enclosures.tangent import Tangent

__all__ = [
    "AffineBand",
    "Arc",
    "Ball",
    "Band",
    "BottomUpLinear",
    "BottomUpQuadratic",
    "BoundedLaplacian",
    "Caps",
    "Choice",
    "Classic",
    "Cone",
    "Curvature",
    "Cusp",
    "Enclosure",
    "Evaluable",
    "Gaps",
    "Greatest",
    "GreenBall",
    "HarmonicBall",
    "IntervalRange",
    "LinearTaylor",
    "Lipschitz",
    "Mixed",
    "Nearest",
    "Negated",
    "OnePiece",
    "Parabola",
    "Part",
    "Piece",
    "Pieces",
    "Promise",
    "Proofs",
    "QuadraticTaylor",
    "Restriction",
    "Segment",
    "Sheet",
    "Slope",
    "Slopes",
    "Stretched",
    "Tangent",
    "TargetLevels",
    "Taylor",
    "any_covers",
    "choose_proofs",
    "longest_step",
]
