"""`RayBatch`: the rays o + t d of a call, as users give them, checked and on a backend. The
direction d becomes a unit vector, so that the ray parameter t is a length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from harnack.backend import backend_of, choose_backend, to_float, to_numpy, to_vector3
from harnack.backend.arrays import as_kernel_parameters, precision_of_input
from harnack.backend.elementary import max_norm, safe_normalize
from harnack.backend.tensors import is_tensor, tensor_to_array, tensor_to_vectors
from harnack.backend.validation import check_largest_coordinate

if TYPE_CHECKING:
    from harnack.backend import Backend, FloatArray, Precision, Real, Vec3


@dataclass(frozen=True)
class RayBatch:
    """The rays o + t d, t_min <= t <= t_max, |d| = 1, of one call, as Dr.Jit arrays of a backend.

    count: the number of rays; each array has this width, or 1 if all rays share its entry.
    is_numpy: whether the rays came as NumPy arrays; then results are NumPy arrays, too, else Dr.Jit
        arrays.
    is_tensor: whether results are to be Dr.Jit tensors.
    """

    backend: Backend
    origin: Vec3
    direction: Vec3
    t_min: Real
    t_max: Real
    count: int
    is_numpy: bool
    is_tensor: bool

    @classmethod
    def of(
        cls, origins: Any, directions: Any, t_min: Any, t_max: Any, precision: Precision | None
    ) -> RayBatch:
        """Make the rays from the arguments of `trace` or `crossings`, and check them.

        origins, directions, t_min, t_max: as users give them (`trace` says in which forms).
        precision: "single" or "double"; None for the precision of the input. Dr.Jit arrays have a
            precision. Other rays are double if origins or directions are arrays of float64, else
            single.

        Raises:
            TypeError, ValueError: shapes that do not match, numbers that are not finite, directions
                of length zero, an empty or negative interval; a precision beside Dr.Jit arrays.
        """
        has_tensors = any(is_tensor(array) for array in (origins, directions))
        if has_tensors:
            origins, directions = (
                tensor_to_vectors(array, name) if is_tensor(array) else array
                for array, name in ((origins, "origins"), (directions, "directions"))
            )
            t_min, t_max = (
                tensor_to_array(end, name) if is_tensor(end) else end
                for end, name in ((t_min, "t_min"), (t_max, "t_max"))
            )
        drjit_arrays = [array for array in (origins, directions) if dr.is_array_v(type(array))]
        if drjit_arrays and precision is not None:
            raise ValueError("precision follows Dr.Jit rays; give it only with NumPy ones")
        if drjit_arrays:
            backend = backend_of(drjit_arrays[0])
        else:
            backend = choose_backend(precision or precision_of_input(origins, directions))
        o, d, near, far = _uploaded(backend, origins, directions, t_min, t_max)
        # An empty array makes the whole call empty; others have one entry or as many as there are
        # rays.
        widths = [dr.width(array) for array in (o, d, near, far)]
        count = max(widths) if min(widths) > 0 else 0
        return cls(backend, o, d, near, far, count, not drjit_arrays, has_tensors)

    @property
    def arrays(self) -> tuple[Vec3, Vec3, Real, Real]:
        """The arrays origin (3,), direction (3,), t_min and t_max."""
        return self.origin, self.direction, self.t_min, self.t_max


def _uploaded(
    backend: Backend, origins: Any, directions: Any, t_min: Any, t_max: Any
) -> tuple[Vec3, Vec3, Real, Real]:
    """Return origins, unit directions, t_min and t_max as Dr.Jit arrays of a backend. Directions
    are normalized. Raises ValueError for arrays whose lengths do not match, or that are no rays."""
    o = as_kernel_parameters(to_vector3(backend, origins, "origins"))
    d = as_kernel_parameters(to_vector3(backend, directions, "directions"))
    near, far = to_float(backend, t_min, "t_min"), to_float(backend, t_max, "t_max")
    arrays = {"origins": o, "directions": d, "t_min": near, "t_max": far}
    lengths = {name: dr.width(array) for name, array in arrays.items()}
    n = max(lengths.values()) if min(lengths.values()) > 0 else 0
    for name, length in lengths.items():
        if length not in (1, n):
            raise ValueError(f"{name} has {length} entries, the others have {n}; give 1 or {n}")
    if not n:
        return o, d, near, far
    # Reading the values of Dr.Jit arrays would evaluate them, so these are not checked.
    if not dr.is_array_v(type(directions)):
        _check_numpy_rays(to_numpy(max_norm(d)), to_numpy(near), to_numpy(far))
    if not dr.is_array_v(type(origins)):
        size = float(np.abs(np.asarray(origins)).max())
        check_largest_coordinate(size, backend.precision, "origins have")
    return o, safe_normalize(d), near, far


def _check_numpy_rays(lengths: FloatArray, near: FloatArray, far: FloatArray) -> None:
    """Raise ValueError for directions of length zero, a negative t_min, and t_max < t_min.

    lengths: (n,) largest absolute coordinates of the directions.
    near, far: (n,) t_min and t_max.
    """
    # (Conditions are negated so that NaN counts as wrong, too.)
    zero = np.flatnonzero(~(lengths >= np.finfo(lengths.dtype).smallest_normal))
    if zero.size:
        raise ValueError(
            f"directions: entry {zero[0]} has length zero, or is shorter than the smallest number "
            "that this precision holds; a ray needs a direction"
        )
    if (near < 0).any():
        raise ValueError("t_min must be >= 0: rays run forwards")
    empty = np.flatnonzero(~(near <= far))
    if empty.size:
        raise ValueError(f"t_max is smaller than t_min for ray {empty[0]}: swap them")
