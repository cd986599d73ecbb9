"""The points, unit normals and areas of fields that are sums over oriented points. An oriented
point stands for a small piece of a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.backend import FloatArray


class OrientedPoints:
    """Points (n, 3) of a surface with unit normals (n, 3), and the areas (n,) of the pieces of the
    surface that they stand for. Subclasses set them once, by `_set_points`. Users cannot set them,
    because all other data are computed from them once: other points make another field."""

    def _set_points(self, points: FloatArray, normals: FloatArray, areas: FloatArray) -> None:
        """Set the points (n, 3), normals (n, 3) and areas (n,), and make these arrays read-only."""
        for array in (points, normals, areas):
            array.setflags(write=False)
        self._points, self._normals, self._areas = points, normals, areas

    @property
    def points(self) -> FloatArray:
        """The positions (n, 3) of the points."""
        return self._points

    @property
    def normals(self) -> FloatArray:
        """The normals (n, 3) at the points, of unit length."""
        return self._normals

    @property
    def areas(self) -> FloatArray:
        """The area (n,) of the piece of surface that each point stands for."""
        return self._areas
