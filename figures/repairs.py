"""Figs. 14, 15 and 16: nets of curves, point clouds, meshes with holes."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

import harnack as hk
from harnack.gallery import SCENES
from harnack.rendering import Camera

from .figure import Report
from .panels import Panel, drawn, fitting, halved, montage, scene
from .view import BACK, FRONT, Pixels, View, mesh_hits


def figure_14(width: int) -> Report:
    """A net of curves, and the surface through it."""
    entry = SCENES["exoskeleton"]
    surface, tubes = entry.surfaces()
    mesh = surface.field
    assert isinstance(mesh, hk.PolygonMesh)
    size = fitting(width)
    settings = {"camera": entry.camera, "options": entry.options}
    net, _ = drawn(tubes, size, material="gold", **settings)
    start = time.perf_counter()
    both, _ = drawn([surface, tubes], size, material=["eggshell", "gold"], **settings)
    seconds = time.perf_counter() - start
    _, counts = drawn(surface, size, material="eggshell", **settings)
    faces = mesh.describe()["faces"]
    corners = [loop for face in range(faces) for loop in mesh.face(face).loops]
    fans = np.concatenate([
        np.stack([np.broadcast_to(loop[0], loop[1:-1].shape), loop[1:-1], loop[2:]], axis=1)
        for loop in corners
    ])  # fmt: skip
    view = View.of(mesh.vertices, (2 * size[0], 2 * size[1]), entry.camera)
    hits = mesh_hits(
        fans.reshape(-1, 3), np.arange(3 * len(fans)).reshape(-1, 3), view.eye, view.directions()
    )
    triangles = view.shade(hits.normal, hits.is_hit, (0.72, 0.30, 0.22), (0.85, 0.80, 0.72))
    _, patch_counts = scene("patches", width)
    patches = SCENES["patches"].surfaces()[0].field.describe()["faces"]
    caption = (
        f"A net of curves on a wavy torus, {faces} polygons with {len(mesh.edges)} edges (left); "
        "a level set for each polygon (middle); and a simple triangulation of the polygons by "
        f"fans (right). The middle takes {counts}, for all polygons that a ray enters; the "
        f"picture with tubes, {seconds:.1f} s, compilation and counting included. A bumpy sphere "
        f"of {patches:,} such polygons (gallery scene `patches`): {patch_counts}."
    )
    differs = (
        "The exoskeleton of de Goes et al. (2011) is not public; ours is made by clustering a "
        "mesh. The paper compares with a mesh viewer's picture."
    )
    labels = ("the net", "a level set for each polygon", "fans of triangles")
    pictures = (net, both, halved(triangles))
    panels = [Panel(p, label) for p, label in zip(pictures, labels, strict=True)]
    return Report(montage(panels), caption, differs)


def figure_15(width: int) -> Report:
    """Points with normals, and the surface through them."""
    rows, texts = [], []
    for name in ("cloud", "knot-cloud"):
        entry = SCENES[name]
        field = entry.surfaces()[0].field
        assert isinstance(field, hk.DipolePotential)
        size = fitting(width)
        start = time.perf_counter()
        picture, counts = scene(name, width)
        seconds = time.perf_counter() - start
        rows.append([
            Panel(_points(field, size, entry.camera), f"{len(field.points):,} points"),
            Panel(picture, "the surface"),
        ])  # fmt: skip
        texts.append(f"{len(field.points):,} points: {counts}; {seconds:.1f} s with compilation")
    caption = (
        "Points with normals (left; those that face away in blue) and the level 2π of their "
        "dipole potential (right), traced through a tree whose truncation is part of the proof. "
        + ". ".join(texts)
        + "."
    )
    differs = (
        "The paper's clouds are not public; ours are random points on a quartic, and a sunflower "
        "pattern on a knotted tube. The paper ends rays within a set distance of a point, ours "
        "within the tolerance alone; areas are estimated."
    )
    return Report(montage(*rows), caption, differs)


def _points(field: hk.DipolePotential, size: tuple[int, int], camera: Camera) -> Pixels:
    """Squares for points, near squares over far squares."""
    view = View.of(field.points, (2 * size[0], 2 * size[1]), camera)
    pixels, depth = view.project(field.points)
    facing = (field.normals * (view.eye - field.points)).sum(axis=1) > 0
    picture = np.full((2 * size[1], 2 * size[0], 3), 242, np.uint8)
    offsets = np.arange(max(2, round(size[0] / 120)))
    for k in np.argsort(-depth):
        column, row = np.round(pixels[k]).astype(int)
        light = 255 * (0.6 + 0.4 * (depth.max() - depth[k]) / np.ptp(depth))
        rows = np.clip(row + offsets, 0, picture.shape[0] - 1)
        columns = np.clip(column + offsets, 0, picture.shape[1] - 1)
        color = np.array(FRONT if facing[k] else BACK) * light
        picture[np.ix_(rows, columns)] = color.astype(np.uint8)
    return halved(picture)


def figure_16(width: int) -> Report:
    """Meshes with holes, and their repair by winding numbers."""
    rows, texts = [], []
    for name, label in (("cut-mesh", "round holes"), ("soup", "loose triangles")):
        entry = SCENES[name]
        surface = entry.surfaces()[0]
        field = surface.field
        assert isinstance(field, hk.WindingNumber)
        size = fitting(width)
        vertices, faces = field.mesh.vertices, field.mesh.input_faces
        view = View.of(vertices, (2 * size[0], 2 * size[1]), entry.camera)
        mesh_hit = mesh_hits(vertices, faces, view.eye, view.directions())
        before = view.shade(mesh_hit.normal, mesh_hit.is_hit)
        start = time.perf_counter()
        picture, counts = scene(name, width)
        seconds = time.perf_counter() - start
        same = replace(view, size=size)  # a quarter of the rays
        hits = same.trace(surface, tolerance=entry.options.tolerance)
        spans = hits.is_hit & (hits.primitive_index < 0)
        mesh_hit = mesh_hits(vertices, faces, same.eye, same.directions())
        through = mesh_hit.is_hit & ((mesh_hit.normal * same.directions()).sum(axis=1) > 0)
        rows.append(
            [Panel(halved(before), f"{len(faces):,} triangles"), Panel(picture, "repaired")]
        )
        texts.append(
            f"{label}, {len(faces):,} triangles with {len(field.mesh.singular_edges):,} open "
            "edges: "
            f"{counts}; of the hits, {100 * (~spans[hits.is_hit]).mean():.0f} % are on triangles "
            "and "
            f"the others on what spans the gaps, where {int(through.sum()):,} rays met the inside "
            f"of a triangle before; {seconds:.1f} s with compilation"
        )
    caption = (
        "Meshes (left; insides in blue) and the level 1/2 of their winding number (right; what "
        "spans "
        "gaps in another color): " + ". ".join(texts) + ". Hits on triangles are exact."
    )
    differs = (
        "The paper repeats Fig. 1 of Jacobson et al. (2013), whose mesh we do not have. Ours "
        "jump at triangles, which is where the paper's formula, used without changes, has no "
        "smooth level set: sound triangles stay as they are, and only gaps are spanned."
    )
    return Report(montage(*rows), caption, differs)
