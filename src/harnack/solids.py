"""Namespace of solids, and of the operations that combine them (`harnack.fields.solids`)."""

from __future__ import annotations

from harnack.fields.solids.booleans import intersection, smooth_union, union
from harnack.fields.solids.extrusions import Extrusion, SolidOfRevolution
from harnack.fields.solids.fractal import DisplacedSolid, FractalNoise, Noise
from harnack.fields.solids.from_field import solid
from harnack.fields.solids.julia import Julia
from harnack.fields.solids.primitives import (
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
from harnack.fields.solids.round_cones import Capsule, RoundCone
from harnack.fields.solids.solid import FormulaSolid, Solid
from harnack.fields.solids.struts import struts
from harnack.fields.solids.thread import Thread, metric_thread
from harnack.fields.solids.tube import Tube, TubeNetwork

__all__ = [
    "Capsule",
    "Cuboid",
    "Cylinder",
    "DisplacedSolid",
    "DoubleCone",
    "Ellipsoid",
    "Extrusion",
    "FormulaSolid",
    "FractalNoise",
    "Julia",
    "Noise",
    "Plane",
    "RoundCone",
    "Solid",
    "SolidOfRevolution",
    "Sphere",
    "Superellipsoid",
    "Supertorus",
    "Thread",
    "Torus",
    "Tube",
    "TubeNetwork",
    "intersection",
    "metric_thread",
    "smooth_union",
    "solid",
    "struts",
    "union",
]
