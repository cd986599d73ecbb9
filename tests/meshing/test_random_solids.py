"""Random solids meshed: closed, not through themselves and near what NumPy says, or refused with a
reason. The oracle shares no code with the fields: formulas of its own at points."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh

import harnack as hk
from tests.oracles.direct_sums import winding_sum
from tests.oracles.extents import longest_side

Function = Callable[[Any], Any]
TOLERANCE = 8e-3  # as a part of the longest side


def primitive(rng: np.random.Generator) -> tuple[hk.solids.Solid, Function]:
    """A solid and its own formula: negative inside."""
    kind, r = rng.integers(5), float(rng.uniform(0.3, 0.8))
    if kind == 0:
        return hk.Sphere(r), lambda p: np.linalg.norm(p, axis=1) - r
    if kind == 1:
        h = rng.uniform(0.3, 0.8, 3)
        return hk.Cuboid(tuple((2 * h).tolist())), lambda p: (np.abs(p) - h).max(axis=1)
    if kind == 2:
        h = float(rng.uniform(0.3, 0.8))
        return hk.Cylinder(r, 2 * h), lambda p: np.maximum(
            np.hypot(p[:, 0], p[:, 1]) - r, np.abs(p[:, 2]) - h
        )
    if kind == 3:
        small = 0.4 * r
        return hk.Torus(
            r, small
        ), lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - r, p[:, 2]) - small
    x, faces = trimesh.creation.icosahedron().vertices * r, trimesh.creation.icosahedron().faces
    normal = np.cross(x[faces][:, 1] - x[faces][:, 0], x[faces][:, 2] - x[faces][:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    away = (normal * x[faces][:, 0]).sum(axis=1)
    return hk.solid((x, faces)), lambda p: (p @ normal.T - away).max(axis=1)


def random_solid(rng: np.random.Generator) -> tuple[hk.solids.Solid, Function]:
    whole, inside = primitive(rng)
    for _ in range(int(rng.integers(1, 4))):
        part, own = primitive(rng)
        offset = rng.uniform(-0.6, 0.6, 3)
        degrees = float(rng.uniform(0, 180))
        part = part.rotated(degrees, "z").translated(tuple(offset.tolist()))
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

        def there(p: Any, own: Function = own, turn: Any = turn, offset: Any = offset) -> Any:
            return own((p - offset) @ turn)  # rows times a matrix: by its inverse

        how, before = rng.integers(3), inside
        if how == 0:
            whole = whole | part
            inside = lambda p, a=before, b=there: np.minimum(a(p), b(p))  # noqa: E731
        elif how == 1:
            whole = whole & part
            inside = lambda p, a=before, b=there: np.maximum(a(p), b(p))  # noqa: E731
        else:
            whole = whole - part
            inside = lambda p, a=before, b=there: np.maximum(a(p), -b(p))  # noqa: E731
    return whole, inside


def judge(seed: int) -> str:
    """ "made" or the reason for a refusal; raises AssertionError for a wrong mesh."""
    rng = np.random.default_rng(seed)
    whole, inside = random_solid(rng)
    begun = time.process_time()
    mesh, why = None, ""
    try:
        mesh = hk.mesh(whole, tolerance=TOLERANCE * longest_side(whole))
    except hk.MeshingError as error:
        why = str(error)
    if mesh is None:
        assert time.process_time() - begun < 20, f"seed {seed}: refused after too long: {why}"
        return why
    assert mesh.is_watertight, f"seed {seed}"
    assert mesh.is_winding_consistent, f"seed {seed}"
    assert mesh.volume > 0, f"seed {seed}"
    size = float(mesh.extents.max())
    corner = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    large = np.linalg.norm(normal, axis=1) > (TOLERANCE * size) ** 2
    normal = normal[large] / np.linalg.norm(normal[large], axis=1)[:, None]
    center = corner[large].mean(axis=1)
    # The boxes that tolerances relate to are those of hulls, up to twice as large.
    step = 3 * TOLERANCE * size
    out, within = inside(center + step * normal), inside(center - step * normal)
    off = 2 * TOLERANCE * size
    assert (np.abs(inside(center)) < off).all(), f"seed {seed}"
    assert (np.minimum(out, -within) > -step - off).all(), f"seed {seed}"
    points = rng.uniform(*mesh.bounds, (100, 3))
    value = inside(points)
    clear = np.abs(value) > step
    assert ((winding_sum(corner)(points[clear]) > 0.5) == (value[clear] < 0)).all(), f"seed {seed}"
    return "made"


@pytest.mark.slow
def test_random_solids_are_right_or_refused() -> None:
    """Of 200 seeds, all of which were tried, some."""
    found = [judge(seed) for seed in (*range(12), 39, 69)]
    refused = [one for one in found if one != "made"]
    assert all("empty" in one for one in refused), refused
    assert len(refused) < 6
