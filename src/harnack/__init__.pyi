"""The names at the top, and where they are. `__init__.py` imports them on first use."""

from . import arithmetic as arithmetic
from . import backend as backend
from . import distance as distance
from . import enclosures as enclosures
from . import fields as fields
from . import files as files
from . import gallery as gallery
from . import geometry as geometry
from . import io as io
from . import kernels as kernels
from . import lattice as lattice
from . import literature as literature
from . import live as live
from . import math as math
from . import meshing as meshing
from . import printing as printing
from . import proofs as proofs
from . import rendering as rendering
from . import solids as solids
from . import testing as testing
from . import tracer as tracer
from ._version import __version__
from .distance import curvature, signed_distance
from .fields.analytic.periodic import Gyroid
from .fields.analytic.polynomial import HarmonicPolynomial, SphericalHarmonic
from .fields.blobs.blobs import Blobs
from .fields.expressions import expression
from .fields.field import Field
from .fields.networks.network import Network
from .fields.solid_angles.dipole import DipolePotential
from .fields.solid_angles.polygon_mesh import PolygonMesh
from .fields.solid_angles.solid_angle import SolidAngle
from .fields.solid_angles.winding_number import WindingNumber
from .fields.solids.booleans import intersection, smooth_union, union
from .fields.solids.extrusions import Extrusion, SolidOfRevolution
from .fields.solids.from_field import solid
from .fields.solids.primitives import Cuboid, Cylinder, Ellipsoid, Sphere, Torus
from .fields.solids.round_cones import Capsule
from .fields.solids.tube import Tube
from .geometry import Ball, Box, HalfSpace
from .inverse.picture import picture
from .live import Slider, page, read_scene, view, write_scene
from .meshing import MeshingError, check_print, mesh, repair
from .progress import Progress
from .rendering import Camera, Isolines, animate, render
from .tracer import Hits, RayStatus, Surface, TraceOptions, crossings, trace

__all__ = [
    "Ball",
    "Blobs",
    "Box",
    "Camera",
    "Capsule",
    "Cuboid",
    "Cylinder",
    "DipolePotential",
    "Ellipsoid",
    "Extrusion",
    "Field",
    "Gyroid",
    "HalfSpace",
    "HarmonicPolynomial",
    "Hits",
    "Isolines",
    "MeshingError",
    "Network",
    "PolygonMesh",
    "Progress",
    "RayStatus",
    "Slider",
    "SolidAngle",
    "SolidOfRevolution",
    "Sphere",
    "SphericalHarmonic",
    "Surface",
    "Torus",
    "TraceOptions",
    "Tube",
    "WindingNumber",
    "__version__",
    "animate",
    "check_print",
    "crossings",
    "curvature",
    "expression",
    "intersection",
    "mesh",
    "page",
    "picture",
    "read_scene",
    "render",
    "repair",
    "signed_distance",
    "smooth_union",
    "solid",
    "trace",
    "union",
    "view",
    "write_scene",
]
