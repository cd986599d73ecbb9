"""Errors about surfaces that touch or cross themselves say so, and what helps."""

from __future__ import annotations

import numpy as np
import pytest

import harnack as hk
from harnack.geometry.example_meshes import icosphere
from harnack.geometry.mesh_edges import normals_at_vertices
from harnack.meshing import thickening
from harnack.meshing.level_function import LevelFunction
from harnack.meshing.meshing_errors import LocalizedMeshingError, SelfIntersectionError
from harnack.meshing.singular_advice import singular_point, singular_points_explained
from harnack.meshing.thickening import thicken
from harnack.meshing.triangle_mesh import TriangleMesh

_PLACE = np.array([[0.02, -0.01, 0.5]])


def message(field: hk.Field, level: float = 0.0, place: object = _PLACE) -> str:
    """The message of an error at a place of a level set in a box of the size 2."""
    function = LevelFunction(field, level)
    with (
        pytest.raises(LocalizedMeshingError) as error,
        singular_points_explained(field, function, lambda: 2.0),
    ):
        raise LocalizedMeshingError("failed", np.asarray(place, np.float64))
    return str(error.value)


def test_a_line_of_crossing_sheets_is_named() -> None:
    text = message(hk.expression("x*y"))
    assert "The gradient of the function vanishes near (0, 0, 0.5)" in text
    assert "choose a level beside this one, or walls" in text
    assert 'level=(-w, w) with side="between"' in text


def test_a_node_is_found_from_places_near_it() -> None:
    cone = LevelFunction(hk.expression("x^2+y^2-z^2"), 0.0)
    found = singular_point(cone, np.array([[0.9, 0.0, 0.9], [0.02, 0.01, 0.03]]), 2.0)
    assert found is not None
    np.testing.assert_allclose(found, 0.0, atol=1e-9)
    # Two sheets far from it, and another level, which does not cross itself.
    assert singular_point(cone, np.array([[0.6, 0.0, 0.6]]), 2.0) is None
    beside = LevelFunction(hk.expression("x^2+y^2-z^2"), 0.2)
    assert singular_point(beside, np.array([[0.02, 0.01, 0.03]]), 2.0) is None


def test_smooth_surfaces_get_no_such_advice() -> None:
    assert message(hk.Sphere(1.0), place=[[0.0, 0.0, 1.001]]) == "failed"
    assert message(hk.Gyroid(1.0), place=[[0.0, 0.0, 0.001]]) == "failed"


def test_branches_and_lobes_have_advice_of_their_own() -> None:
    assert "Branches of a RiemannSurface may cross" in message(hk.fields.RiemannSurface("sqrt"))
    lobes = message(hk.fields.Lobes(3, 2), place=[[0.01, -0.002, 0.01]])
    assert "`lobes.positive`" in lobes


def test_meshes_of_lobes_say_that_these_meet() -> None:
    with pytest.raises(ValueError, match=r"lobes of both signs meet at the origin"):
        hk.mesh(hk.fields.Lobes(3, 2), cell_size=0.08, tolerance=5e-3)


def test_no_thickness_is_small_enough_where_a_surface_crosses_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, faces = icosphere(2)
    x = np.concatenate([vertices, vertices + np.array([1.2, 0.013, 0.021])])
    surface = TriangleMesh(x, np.concatenate([faces, faces + len(vertices)]))
    normals = normals_at_vertices(surface.vertices, surface.faces)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    monkeypatch.setattr(thickening, "_MOST_HULLS", 100)
    with pytest.raises(SelfIntersectionError, match="its reach is 0"):
        thicken(surface, normals, 1e-3, 1e-3)
