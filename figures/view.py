"""Pinhole views: rays of all pixels, and pictures of their hits.

Comparisons need the same rays for every method, and pictures of meshes beside those of level
sets; so they are drawn here, one ray a pixel and lit by a formula, and not by `harnack.render`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import harnack as hk
from harnack.rendering import Camera, register

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]
Color = tuple[float, float, float]

FRONT: Color = (0.93, 0.55, 0.36)
BACK: Color = (0.36, 0.56, 0.72)
MISSED: Color = (1.0, 0.0, 1.0)
FALSE: Color = (0.1, 0.75, 0.2)
_PAPER: Color = (0.95, 0.95, 0.94)
_AMBIENT, _DIFFUSE, _GLOSS = 0.38, 0.62, 0.25


@dataclass(frozen=True)
class View:
    """A pinhole. axes (3, 3): unit vectors to the right, up, and back. size: (width, height)."""

    eye: Array
    axes: Array
    fov: float
    size: tuple[int, int]

    @classmethod
    def of(cls, points: Any, size: tuple[int, int], camera: Camera | None = None) -> View:
        """The view that frames points (n, 3), as the studio's camera does."""
        camera = Camera() if camera is None else camera
        eye, _ = camera.frame_points(np.asarray(points, np.float64), size)
        return cls(eye, np.stack(camera.axes()), camera.fov_or_default, size)

    @property
    def _scale(self) -> float:
        return math.tan(math.radians(self.fov) / 2) / max(self.size)

    def directions(self) -> Array:
        """(height * width, 3) unit directions through the middles of pixels, row by row."""
        width, height = self.size
        x = (2 * np.arange(width) + 1 - width) * self._scale
        y = (height - 2 * np.arange(height) - 1) * self._scale
        right, up, back = self.axes
        d = x[None, :, None] * right + y[:, None, None] * up - back
        return (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (n, 2), column and row, and depths (n,) of points (n, 3)."""
        right, up, depth = (self.axes @ (points - self.eye).T) * [[1], [1], [-1]]
        width, height = self.size
        column = 0.5 * (right / depth / self._scale + width)
        return np.column_stack([column, 0.5 * (height - up / depth / self._scale)]), depth

    def trace(self, what: Any, **settings: Any) -> hk.Hits:
        """`hk.trace` of all pixels, in single precision and with a tolerance of 1e-4 unless
        `settings` are others."""
        settings = {"precision": "single", "tolerance": 1e-4, **settings}
        return hk.trace(what, self.eye[None], self.directions(), **settings)

    def shade(
        self,
        normals: Array,
        hit: npt.NDArray[np.bool_],
        front: Color | Array = FRONT,
        back: Color | Array = BACK,
    ) -> Pixels:
        """The picture (height, width, 3) of hits with unit normals (n, 3): one color, or (n, 3)
        colors, for the side to which normals point, another for the other side."""
        d = self.directions()
        facing = -(normals * d).sum(axis=1)
        outward = normals * np.sign(facing)[:, None]
        right, up, towards = self.axes
        light = -0.45 * right + 0.75 * up + 0.75 * towards
        light /= np.linalg.norm(light)
        cosine = outward @ light
        mirrored = d + 2 * np.abs(facing)[:, None] * outward
        gloss = np.clip(mirrored @ light, 0, 1) ** 24
        color = np.where(facing[:, None] > 0, front, back)
        level = _AMBIENT + _DIFFUSE * np.clip(cosine, 0, 1)
        shown = color * level[:, None] + _GLOSS * gloss[:, None]
        return self.pixels(np.where(hit[:, None], shown, _PAPER))

    def pixels(self, colors: Array) -> Pixels:
        """The picture of colors (n, 3) in [0, 1]."""
        return (np.clip(colors, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(*self.size[::-1], 3)


def marked(picture: Pixels, where: npt.NDArray[np.bool_], color: Color) -> Pixels:
    """The picture with the selected pixels, row by row, in a color."""
    picture = picture.copy()
    picture.reshape(-1, 3)[where] = np.round(np.array(color) * 255).astype(np.uint8)
    return picture


@dataclass(frozen=True)
class MeshHits:
    """First hits of n rays with triangles: t (n,), inf for none; normals (n, 3); faces (n,)."""

    t: Array
    normal: Array
    face: npt.NDArray[np.int64]

    @property
    def is_hit(self) -> npt.NDArray[np.bool_]:
        return np.isfinite(self.t)


def mesh_hits(vertices: Any, faces: Any, eye: Array, directions: Array) -> MeshHits:
    """First hits of rays from one point with the triangles of a mesh, by Mitsuba."""
    mi = register()
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    inside = mi.traverse(mesh)
    inside["vertex_positions"] = np.asarray(vertices, np.float32).ravel()
    inside["faces"] = np.asarray(faces, np.uint32).ravel()
    inside.update()
    scene = mi.load_dict({"type": "scene", "mesh": mesh})
    ray = mi.Ray3f(mi.Point3f(*eye.tolist()), mi.Vector3f(*directions.T.astype(np.float32)))
    hits = scene.ray_intersect(ray)
    t = np.asarray(hits.t.numpy(), np.float64)
    normal = np.where(np.isfinite(t)[:, None], np.asarray(hits.n.numpy(), np.float64).T, 0.0)
    return MeshHits(t, normal, np.asarray(hits.prim_index.numpy(), np.int64))
