"""The data of fields that are sums over oriented points."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.backend import FloatArray


class OrientedPoints:
    """Points (n, 3), unit normals (n, 3) and areas (n,). Subclasses set them once, by
    `_set_points`. Users cannot set them, because all other data are computed from them once: other
    points make another field."""

    def _set_points(self, points: FloatArray, normals: FloatArray, areas: FloatArray) -> None:
        """Set points, normals and areas, and make these arrays read-only."""
        for array in (points, normals, areas):
            array.setflags(write=False)
        self._points, self._normals, self._areas = points, normals, areas

    @property
    def points(self) -> FloatArray:
        """The points (n, 3)."""
        return self._points

    @property
    def normals(self) -> FloatArray:
        """The normals (n, 3), of unit length."""
        return self._normals

    @property
    def areas(self) -> FloatArray:
        """The areas (n,) that the points stand for."""
        return self._areas
