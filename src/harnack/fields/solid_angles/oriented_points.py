"""The data of fields that are sums over oriented points."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from harnack.backend import FloatArray


class OrientedPoints:
    """Points (n, 3), unit normals (n, 3) and areas (n,). They stay as they are, since all else is
    computed from them once: other points make another field. Subclasses set them by
        `_set_points`."""

    def _set_points(self, points: FloatArray, normals: FloatArray, areas: FloatArray) -> None:
        for one in (points, normals, areas):
            one.setflags(write=False)
        self._points, self._normals, self._areas = points, normals, areas

    @property
    def points(self) -> FloatArray:
        """(n, 3)."""
        return self._points

    @property
    def normals(self) -> FloatArray:
        """(n, 3), of unit length."""
        return self._normals

    @property
    def areas(self) -> FloatArray:
        """(n,), that each point stands for."""
        return self._areas
