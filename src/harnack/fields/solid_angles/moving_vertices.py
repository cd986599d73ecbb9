"""Vertices of meshes that are given as Dr.Jit arrays, and winding numbers with derivatives by
them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend.arrays import upload_vectors
from harnack.backend.tensors import is_tensor, tensor_to_vectors
from harnack.fields.parameters import Parametrized, kept_arguments
from harnack.fmm.moving_edges import MovingEdges
from harnack.fmm.unit_frame import UnitFrame, frame_parameters

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.fields.solid_angles.winding_number import WindingNumber

# An edge from a vertex to itself, for closed meshes: sums over no edges would depend on nothing.
_NO_EDGE = np.zeros((1, 2), np.int64)


def drjit_vertices(mesh: Parametrized) -> Any:
    """The vertices with which a field was made, if these were a Dr.Jit array or tensor; else
    None."""
    vertices = kept_arguments(mesh).get("vertices")
    return vertices if dr.is_array_v(type(vertices)) else None


def moving_vectors(backend: Backend, vectors: Any, plain: FloatArray) -> Vec3:
    """Vertices, points or normals as a 3-vector of a backend, with their derivatives if they have
    any.

    vectors: a Dr.Jit 3-vector, or a tensor (n, 3); or None.
    plain: (n, 3) the numbers that are taken if it is None.
    """
    if vectors is None:
        return upload_vectors(backend, plain)
    return backend.Array3f(tensor_to_vectors(vectors) if is_tensor(vectors) else vectors)


@dataclass(frozen=True)
class MovingWinding:
    """The winding number w of a mesh, and its gradient, with derivatives by points and vertices.

    Off the triangles, w is the solid angle of the boundary of the mesh over 4 pi, up to an integer
    that does not change as points and vertices move a little. So the derivatives of w are those of
    a sum over the edges at which triangles do not cancel; those of a closed mesh are 0.

    field: the winding number.
    edges: the edges that are left if those of different triangles cancel
        (`WindingMesh.moving_edges`).
    """

    field: WindingNumber
    edges: MovingEdges

    @classmethod
    def of(cls, field: WindingNumber, backend: Backend) -> MovingWinding:
        """The winding number on a backend."""
        mesh = field.mesh
        frame = UnitFrame(*frame_parameters(backend, mesh.center, mesh.size))
        pairs = mesh.moving_edges if len(mesh.moving_edges) else _NO_EDGE
        return cls(field, MovingEdges.of_pairs(frame, field.moving_vertices(backend), pairs))

    def value(self, p: Vec3) -> Real:
        """w at points p (3, n)."""
        with dr.suspend_grad():
            value = self.field.values_at(dr.detach(p), 0).value
        return dr.replace_grad(value, self.edges.angle(p) / (4 * math.pi))

    def gradient(self, p: Vec3) -> Vec3:
        """The gradient (3, n) of w at points p (3, n)."""
        return self.edges.gradient(p) / (4 * math.pi)
