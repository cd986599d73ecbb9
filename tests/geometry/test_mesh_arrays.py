"""Meshes of other libraries: what is taken, and what a message says to give instead."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from harnack.geometry.example_meshes import icosphere
from harnack.geometry.meshes import mesh_arrays

VERTICES, FACES = icosphere(1)
VERBS: list[Callable[[Any], Any]] = [hk.solid, hk.repair, hk.check_print]
# The names that PyVista, Open3D and meshio give to the arrays of a mesh.
OTHERS = [
    SimpleNamespace(points=VERTICES, faces=FACES),
    SimpleNamespace(vertices=VERTICES, triangles=FACES),
    SimpleNamespace(points=VERTICES, cells_dict={"triangle": FACES}),
]


@pytest.mark.parametrize("mesh", [trimesh.Trimesh(VERTICES, FACES), (VERTICES, FACES)])
def test_objects_and_pairs_are_meshes(mesh: Any) -> None:
    vertices, faces = mesh_arrays(mesh)
    np.testing.assert_array_equal(vertices, VERTICES)
    np.testing.assert_array_equal(faces, FACES)


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("mesh", [*OTHERS, VERTICES, (VERTICES,)])
def test_other_meshes_are_refused_with_advice(verb: Callable[[Any], Any], mesh: Any) -> None:
    with pytest.raises(TypeError, match=r"mesh\.regular_faces.*mesh\.triangles.*cells_dict"):
        verb(mesh)


def test_a_pair_is_repaired_as_a_mesh_is() -> None:
    pair = hk.repair((VERTICES, FACES[1:]))
    mesh = hk.repair(trimesh.Trimesh(VERTICES, FACES[1:], process=False))
    assert pair.is_watertight
    np.testing.assert_array_equal(pair.vertices, mesh.vertices)
    np.testing.assert_array_equal(pair.faces, mesh.faces)
