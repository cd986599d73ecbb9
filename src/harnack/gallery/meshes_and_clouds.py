"""Scenes of the gallery: damaged meshes, closed by the level set of their winding number, and point
clouds, through which a level set passes. Each function here makes the surfaces of a scene.
"""

from __future__ import annotations

import math

import numpy as np

from harnack.backend import FloatArray
from harnack.fields.solid_angles.dipole import DipolePotential
from harnack.fields.solid_angles.winding_number import WindingNumber
from harnack.gallery.scene import Scene
from harnack.geometry import example_curves, example_meshes
from harnack.rendering import Camera
from harnack.tracer import Surface

# Evenly spread over any range: multiples of it, modulo 1.
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


def _cut_mesh() -> list[Surface]:
    """Return a bumpy sphere with 14 round holes, closed by the level set of its winding number."""
    vertices, faces = example_meshes.bumpy_sphere(6)  # subdivided six times
    directions = vertices[faces].mean(axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # Faces within 0.27 radians of one of 14 directions are left out.
    is_kept = (directions @ _spiral_directions(14).T < math.cos(0.27)).all(axis=1)
    return [Surface(WindingNumber(vertices, faces[is_kept]))]


def _spiral_directions(n: int) -> FloatArray:
    """Return n unit vectors (n, 3), spread evenly over the sphere along a spiral."""
    k = np.arange(n)
    z, angle = 1.0 - (2.0 * k + 1.0) / n, 2.0 * math.pi * _GOLDEN * k
    radius = np.sqrt(1.0 - z * z)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


def _soup() -> list[Surface]:
    """Return the level set of the winding number of loose triangles: a torus whose triangles are
    shrunk about their centers, with a tenth of them missing."""
    # The two radii, and the numbers of segments the long way round and the short way.
    vertices, faces = example_meshes.torus_mesh(1.0, 0.42, 20, 9)
    faces = example_meshes.remove_faces(faces, 0.1, seed=1)
    corners = vertices[faces]
    centers = corners.mean(axis=1, keepdims=True)
    shrunk = (centers + 0.86 * (corners - centers)).reshape(-1, 3)
    # Every triangle has three corners of its own.
    field = WindingNumber(shrunk, np.arange(len(shrunk)).reshape(-1, 3))
    return [Surface(field)]


def _cloud() -> list[Surface]:
    """Return a surface through random points of a quartic with five handles; the normals are the
    quartic's gradients. Newton's steps move random points onto the quartic."""
    points = np.random.default_rng(2).uniform(-2.5, 2.5, (12000, 3))
    for _ in range(40):
        value, gradient = _tangle(points)
        # Damped steps of Newton's method.
        points = points - 0.7 * (value / (gradient**2).sum(axis=1))[:, None] * gradient
    value, gradient = _tangle(points)
    # Points at which Newton's method did not converge are left out.
    is_on_quartic = (np.abs(value) < 1e-9) & (np.abs(points) < 2.6).all(axis=1)
    return [Surface(DipolePotential(points[is_on_quartic], gradient[is_on_quartic]))]


def _tangle(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the function f = x^4 - 5 x^2 + y^4 - 5 y^2 + z^4 - 5 z^2 + 11.8 at points (n, 3): its
    values (n,) and its gradients (n, 3). Its zero set is a surface with five handles."""
    value = (points**4 - 5.0 * points**2).sum(axis=1) + 11.8
    return value, 4.0 * points**3 - 10.0 * points


def _knot_cloud() -> list[Surface]:
    """Return a surface through points on a tube around a trefoil knot. The points are arranged like
    the seeds of a sunflower."""
    n, count = 1200, 8000
    # The trefoil is the (2, 3) torus knot, here of n vertices.
    curve = example_curves.torus_knot(2, 3, n)
    tangents = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    k = np.arange(count)
    # The point of the curve around which point k of the cloud lies.
    index = k * n // count
    angle = (2 * math.pi * _GOLDEN * k)[:, None]
    # Two vectors across the knot at each point, and the normal at an angle between them.
    u = np.cross(tangents[index], (0.0, 0.0, 1.0))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    normals = np.cos(angle) * u + np.sin(angle) * np.cross(tangents[index], u)
    radius = 0.055 * float(np.ptp(curve))
    return [Surface(DipolePotential(curve[index] + radius * normals, normals))]


MESHES = (
    Scene(
        "cut-mesh",
        "a mesh with holes, spanned by the level set of its winding number",
        _cut_mesh,
        ("eggshell",),
        show="shaded",
        demo_spp=9,
    ),
    Scene(
        "soup",
        "a soup of loose triangles, mended by its winding number",
        _soup,
        ("two-tone",),
        Camera(elevation=40),
        show="shaded",
        demo_spp=4,
    ),
    Scene(
        "cloud",
        "a surface through oriented points",
        _cloud,
        ("porcelain",),
        show="shaded",
        demo_spp=9,
    ),
    Scene(
        "knot-cloud",
        "a trefoil tube through 8,000 oriented points",
        _knot_cloud,
        ("gold",),
        Camera(azimuth=-90, elevation=70),
        show="shaded",
        demo_spp=9,
    ),
)
