"""Trees of chains of boundary edges: what nodes hold, and sums along rays against all edges."""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import harnack as hk
from harnack.backend import Backend, choose_backend, to_numpy, to_vector3
from harnack.fields.solid_angles.edge_lift import LiftedEdges, lifted_sums
from harnack.fields.solid_angles.edge_trails import closed_trails
from harnack.fields.solid_angles.winding_exact import (
    ChainLeaves,
    EdgeChains,
    chain_columns,
    chain_leaves,
)
from harnack.fields.solid_angles.winding_mesh import WindingMesh
from harnack.geometry.mesh_shapes import bumpy_sphere, remove_faces
from harnack.testing import check_field
from harnack.tree import NO_PRIMITIVE
from harnack.tree.triangles import Frame


def cut(kind: str, subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A mesh with one long rim, with many short ones, or with rims of all lengths that touch."""
    vertices, faces = bumpy_sphere(subdivisions)
    if kind == "one":
        return vertices, faces[vertices[faces].mean(axis=1)[:, 2] > 0.1]
    if kind == "many":
        return vertices, faces[np.random.default_rng(0).random(len(faces)) > 0.03]
    return vertices, remove_faces(faces, 0.3, 1)


KINDS = ["one", "many", "all"]


@given(st.lists(st.integers(2, 60), min_size=1, max_size=30), st.integers(0, 99))
def test_a_node_is_one_chain_or_whole_trails(lengths: list[int], seed: int) -> None:
    rng, start = np.random.default_rng(seed), np.concatenate([[0], np.cumsum(lengths)])
    trails = [np.append(np.arange(a, b), a) for a, b in itertools.pairwise(start.tolist())]
    leaves = chain_leaves(rng.normal(size=(int(start[-1]), 3)), trails)
    tree = leaves.hierarchy()
    assert len(leaves.ends) == len(tree.slots) + 1
    held = tree.slots[tree.slots != NO_PRIMITIVE]
    np.testing.assert_array_equal(held, np.arange(sum(lengths)))  # each once, in order
    given_edges = {(int(a), int(b)) for trail in trails for a, b in itertools.pairwise(trail)}
    assert {(int(a), int(b)) for a, b in leaves.edges} == given_edges
    trail_of = np.searchsorted(start, leaves.edges[:, 0], side="right") - 1
    for nodes in tree.counts:
        size = len(tree.slots) // nodes
        for begin, end in zip(leaves.ends[:-1:size], leaves.ends[size::size], strict=True):
            some = trail_of[begin:end]
            if len(set(some.tolist())) > 1:
                for trail in set(some.tolist()):
                    assert (some == trail).sum() == lengths[trail]
            steps = leaves.edges[begin:end]
            same = some[1:] == some[:-1]
            assert (steps[1:][same, 0] == steps[:-1][same, 1]).all()


def test_chords_close_chains_and_whole_trails_have_none() -> None:
    """What a node stands for has the edges that it holds: chord and loop make up the chain."""
    mesh = WindingMesh.of(*cut("all"))
    leaves = chain_leaves(mesh.unit_vertices, closed_trails(mesh.singular))
    chords = 0
    for nodes in leaves.hierarchy().counts:
        columns = chain_columns(leaves, nodes, mesh.unit_vertices, 1e-7)
        size = (len(leaves.ends) - 1) // nodes
        for row, begin, end in zip(
            columns, leaves.ends[:-1:size], leaves.ends[size::size], strict=True
        ):
            if begin == end:
                assert (row[3:] == 0).all()
                continue
            ends = mesh.unit_vertices[leaves.edges[begin:end]]
            assert np.linalg.norm(ends - row[:3], axis=-1).max() <= row[3]
            net = (ends[:, 1] - ends[:, 0]).sum(axis=0)
            chord = row[28:31] - row[25:28] if row[31] > 0 else np.zeros(3)
            np.testing.assert_allclose(net, chord, atol=1e-12)
            chords += row[31] > 0
    assert chords > 100


def rays(
    backend: Backend, mesh: WindingMesh, n: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and directions (n, 3), half of them straight at an edge, and t (n,)."""
    rng = np.random.default_rng(seed)
    o, d = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    ends, share = mesh.unit_vertices[rng.choice(mesh.singular, n // 2)], rng.random((n // 2, 1))
    d[: n // 2] = share * ends[:, 0] + (1 - share) * ends[:, 1] - o[: n // 2]
    d /= np.linalg.norm(d, axis=1)[:, None]
    return o, d, rng.uniform(0, 3, n)


def sums_along(backend: Backend, mesh: WindingMesh, n: int, fine: bool) -> Any:
    """What the chains say, and the sums over all edges in coordinates whose z axis is the ray."""
    o, d, t = rays(backend, mesh, n, 3)
    frame = Frame.along(backend, to_vector3(backend, o), to_vector3(backend, d))
    x = dr.fma(backend.Array3f(backend.Float(t)), frame.d, frame.o)
    chains = EdgeChains.upload(backend, mesh.unit_vertices, mesh.singular)
    found = chains.near(frame, x, backend.Float(fine))
    # All edges, one ray's axes at a time: as many meshes as there are rays would be, so turn x.
    ends = mesh.unit_vertices[mesh.singular] - (o + t[:, None] * d)[:, None, None]
    axes = np.stack([to_numpy(one) for one in (frame.u, frame.v, frame.d)], axis=1)
    return found, np.einsum("neki,nji->nekj", ends, axes), axes


def summed(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum of Omega_e (n,) and gradient (n, 3), over edges (n, k, 2, 3) seen along z."""
    a, b = ends[:, :, 0], ends[:, :, 1]
    la, lb = np.linalg.norm(a, axis=2), np.linalg.norm(b, axis=2)
    s = [length - one[..., 2] for one, length in ((a, la), (b, lb))]
    re = s[0] * s[1] + a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]
    im = -(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    weight = (1 / la + 1 / lb) / (la * lb + (a * b).sum(axis=2))
    gradient = (weight[..., None] * np.cross(a, b)).sum(axis=1)
    return 2 * np.arctan2(im, re).sum(axis=1), gradient


@pytest.mark.few(1)
@pytest.mark.parametrize("fine", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_sums_along_rays_are_those_over_all_edges(kind: str, fine: bool) -> None:
    """Also of rays that pass edges closely or meet them, which are counted on either side alike."""
    backend, mesh = choose_backend("double"), WindingMesh.of(*cut(kind))
    found, ends, axes = sums_along(backend, mesh, 600, fine)
    angle, gradient = summed(ends)
    gradient = np.einsum("nj,nji->ni", gradient, axes)
    off = np.abs(to_numpy(found.value) - angle)
    aimed = np.arange(len(off)) < len(off) // 2
    # A ray through an edge may be counted on either side of it.
    off = np.where(aimed, np.abs(np.remainder(off + 1, 4 * np.pi) - 1), off)
    slant = np.linalg.norm(to_numpy(found.gradient) - gradient, axis=1)
    steep = np.linalg.norm(gradient, axis=1)
    bound = to_numpy(found.truncation + found.rounding)
    assert (off <= bound + 1e-10).all()
    assert (slant <= to_numpy(found.slope_truncation) + 1e-9 * (1 + steep)).all()
    assert (off.max() > 1e-5) != fine  # a rough look leaves something out


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", KINDS)
def test_along_the_z_axis_chains_decide_as_single_edges_do(kind: str) -> None:
    """On both sides of edges, and on them: the very same turns, in single precision too."""
    mesh = WindingMesh.of(*cut(kind))
    for precision in ("single", "double"):
        backend = choose_backend(precision)  # type: ignore[arg-type]
        rng = np.random.default_rng(1)
        corners = mesh.unit_vertices[mesh.singular]
        x = corners[:, 0] + rng.uniform(size=(len(corners), 1)) * (corners[:, 1] - corners[:, 0])
        x = np.concatenate([corners[:, 0], x, x + 1e-7, x - 1e-7])
        x[:, 2] -= rng.uniform(0.01, 3, len(x))
        p, up = to_vector3(backend, x), backend.Array3f(0, 0, 1)
        frame = Frame(p, backend.Array3f(1, 0, 0), backend.Array3f(0, 1, 0), up)
        chains = EdgeChains.upload(backend, mesh.unit_vertices, mesh.singular)
        found = to_numpy(chains.near(frame, p, backend.Float(1)).value)
        edges = LiftedEdges.upload(backend, mesh.unit_vertices, mesh.singular)
        angle = to_numpy(lifted_sums(edges, p, 0).angle)
        assert np.abs(found - angle).max() < (3e-3 if precision == "single" else 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [kind if kind == "many" else pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS],
)
def test_promises_of_chains_hold(kind: str) -> None:
    mesh = cut(kind, 1 if kind == "all" else 2)
    check_field(hk.WindingNumber(*mesh, method="exact"), count=100)


def test_leaves_of_a_single_edge_trail_pair() -> None:
    """Two edges to and fro: the shortest closed trail there is."""
    leaves = chain_leaves(np.eye(3), [np.array([0, 1, 0])])
    assert isinstance(leaves, ChainLeaves)
    assert leaves.ends.tolist() == [0, 2]
    assert leaves.hierarchy().node_count == 1
