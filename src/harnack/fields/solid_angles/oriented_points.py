"""The points, unit normals and areas of fields that are sums over oriented points. An oriented
point stands for a small piece of a surface. Dr.Jit arrays may be given for them, by which the sum
is then differentiated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import drjit as dr

from harnack.backend.arrays import upload_floats
from harnack.backend.tensors import is_tensor, tensor_to_array
from harnack.backend.validation import check_no_derivatives
from harnack.fields.parameters import kept_arguments
from harnack.fields.solid_angles.moving_vertices import moving_vectors
from harnack.fmm.moving_dipoles import MovingDipoles

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Real
    from harnack.fmm.radial_kernel import RadialKernel
    from harnack.fmm.unit_frame import UnitFrame


class OrientedPoints:
    """Points (n, 3) of a surface with unit normals (n, 3), and the areas (n,) of the pieces of the
    surface that they stand for. Subclasses set them once, by `_set_points`. Users cannot set them,
    because all other data are computed from them once: other points make another field."""

    copies_parameters: ClassVar[bool] = True  # `cached_upload`

    is_estimated: list[bool]
    """Whether normals, and whether areas, are estimated."""

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

    def _moving_dipoles(
        self, frame: UnitFrame, kernel: RadialKernel, factor: float
    ) -> MovingDipoles | None:
        """The sum as an expression by those of points, normals and areas that were given as Dr.Jit
        arrays; None if none of them has derivatives enabled.

        factor: a factor of all areas.

        Raises:
            NotImplementedError: some of the three are computed from others that have derivatives
                enabled: these derivatives are not known.
        """
        kept = kept_arguments(self)
        arrays = {name: kept[name] for name in _NAMES if _is_drjit(kept.get(name))}
        if not any(map(dr.grad_enabled, arrays.values())):
            return None
        has_normals, has_areas = (not is_estimated for is_estimated in self.is_estimated)
        check_estimates(type(self).__name__, arrays, has_normals=has_normals, has_areas=has_areas)
        backend = frame.backend
        return MovingDipoles.of(
            frame,
            kernel,
            moving_vectors(backend, arrays.get("points"), self._points),
            moving_vectors(backend, arrays.get("normals"), self._normals),
            factor * _numbers(backend, arrays.get("areas"), self._areas),
        )


_NAMES = "points", "normals", "areas"


def check_estimates(
    name: str, arrays: Mapping[str, Any], *, has_normals: bool, has_areas: bool
) -> None:
    """Raise NotImplementedError if normals or areas are estimated from points or normals that have
    derivatives enabled: how the estimates change is not known.

    name: the name of the field's class.
    arrays: the arguments "points" and "normals".
    has_normals, has_areas: whether normals and areas are given.
    """
    points, normals = arrays.get("points"), arrays.get("normals")
    if not has_normals:
        check_no_derivatives(f"{name} with estimated normals", points)
    if not has_areas:
        check_no_derivatives(f"{name} with estimated areas", points, normals)


def _numbers(backend: Backend, areas: Any, plain: FloatArray) -> Real:
    """Areas as an array of a backend; arguments as of `moving_vectors`."""
    if areas is None:
        return upload_floats(backend, plain)
    return backend.Float(tensor_to_array(areas) if is_tensor(areas) else areas)


def _is_drjit(value: Any) -> bool:
    """Whether a value is a Dr.Jit array."""
    return dr.is_array_v(type(value))
