"""Evaluation of a field, or of any Dr.Jit kernel, at large numbers of NumPy points, batch by batch;
the results are NumPy arrays. A kernel here is a Python function that takes the Dr.Jit points of a
batch, one point per lane, and returns Dr.Jit arrays. The points of a batch are visited cell by cell
along a Morton curve (a space-filling curve), so that neighboring lanes visit the same nodes of a
tree."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from harnack.backend import choose_backend, to_numpy, to_vector3
from harnack.backend.arrays import (
    as_finite_vectors,
    precision_of_input,
    upload_integers,
    upload_vectors,
)
from harnack.backend.validation import check_no_derivatives
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.fields.parameters import differentiable_parameters

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Vec3

__all__ = ["accepts_numpy_points", "evaluate_points", "map_batches", "morton_order"]

# The number of points of a batch: enough to keep a GPU busy, few enough to keep memory small.
_BATCH_SIZE = 1 << 20
# There are 2^5 cells along an axis. So three coordinates make a key of 15 bits, for which NumPy
# uses radix sort.
_BITS_PER_AXIS = 5


def evaluate_points(
    points: Any,
    kernel: Callable[[Backend, Vec3], tuple[Any, ...]],
    precision: Precision | None,
) -> tuple[npt.NDArray[Any], ...]:
    """The results of `kernel` at points (n, 3), as NumPy arrays in the order of the points. For a
    single point (3,) they have no first axis.

    kernel: a function that takes a backend and a Dr.Jit 3-vector of points, and returns a tuple of
        Dr.Jit arrays.
    precision: "single" or "double"; None means double if the points are an array of float64, else
        single.

    The points are visited cell by cell along a Morton curve. Neighboring lanes then visit the same
    nodes of a tree, which halves the time.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers.
    """
    backend = choose_backend(precision or precision_of_input(points))

    def visit(x: Vec3) -> tuple[Any, ...]:
        """The results of `kernel` at the Dr.Jit points x, as a tuple of arrays in the order of x.
        The kernel itself is given the points in the order of a Morton curve."""
        order = morton_order(backend, x)
        results = kernel(backend, dr.gather(backend.Array3f, x, order))
        return tuple(_restore_order(array, order, dr.width(x)) for array in results)

    # NumPy arrays would lose derivatives.
    check_no_derivatives("what NumPy's arrays are given of", points)
    vectors = np.asarray(points)
    if vectors.shape == (3,):
        return tuple(array[0] for array in map_batches(backend, visit, vectors[None]))
    return map_batches(backend, visit, vectors)


def accepts_numpy_points(hessian: Callable[[Any, Vec3], Any]) -> Callable[..., Any]:
    """Decorator of a field's method `hessian`, which takes Dr.Jit points. The decorated method also
    takes NumPy points (n, 3) or (3,), for which it returns NumPy matrices (n, 3, 3) or (3, 3)."""

    @accepts_dask_arrays("p")
    @functools.wraps(hessian)
    def general(self: Any, p: Any, *, precision: Precision | None = None) -> Any:
        """The second derivatives at p (`Field.hessian`): for a Dr.Jit 3-vector p, the three rows of
        the matrix; for NumPy points, NumPy matrices.

        precision: for NumPy points, "single" or "double"; None for that of the points.
        """
        if dr.is_array_v(type(p)):
            check_no_derivatives(
                f"the Hessian of {type(self).__name__}", p, differentiable_parameters(self)
            )
            return hessian(self, p)

        def kernel(backend: Backend, x: Vec3) -> tuple[Vec3, Vec3, Vec3]:
            """The three rows of the Hessian at the Dr.Jit points x."""
            return self.evaluator(backend).hessian(x)

        # Three arrays of rows (n, 3) become matrices (n, 3, 3).
        return np.stack(evaluate_points(p, kernel, precision), axis=-2)

    return general


def map_batches(
    backend: Backend,
    compute: Callable[..., tuple[Any, ...]],
    points: Any,
    *extra_vectors: npt.NDArray[Any],
    at_once: int = _BATCH_SIZE,
) -> tuple[npt.NDArray[Any], ...]:
    """The results of `compute` for points (n, 3), as NumPy arrays (n,) or (n, 3), computed batch by
    batch.

    backend: the backend of the computation, which also decides the precision.
    compute: a function that takes the Dr.Jit points of a batch and its rows of each of
        `extra_vectors`, and returns a tuple of Dr.Jit arrays and vectors.
    points: (n, 3), an array-like; or a Dr.Jit 3-vector.
    extra_vectors: further arguments of `compute`, arrays (n, 3) of any values, one row for each
        point.
    at_once: the number of points of a batch.

    Raises:
        TypeError, ValueError: points that are not an (n, 3) array of finite numbers.
    """
    on_device = dr.is_array_v(cast("Any", type(points)))
    vectors = (
        to_vector3(backend, points, "points") if on_device else as_finite_vectors(points, "points")
    )
    n = dr.width(vectors) if on_device else len(vectors)
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    # One batch even for no points: it tells the shapes, and raises the errors of `compute`.
    for start in range(0, max(n, 1), at_once):
        lanes = min(at_once, n - start)
        with dr.suspend_grad():
            # Without points, `compute` is called with the origin.
            results = compute(
                *(
                    _slice_vectors(backend, array, start, lanes) if n else backend.Array3f(0)
                    for array in (vectors, *extra_vectors)
                )
            )
            dr.eval(*results)
        # A result that is the same on all lanes may have only one row.
        parts.append(tuple(_repeat_single_row(to_numpy(array), max(lanes, 1)) for array in results))
    if len(parts) == 1:
        return tuple(array[:n] for array in parts[0])
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


def _slice_vectors(backend: Backend, vectors: Any, start: int, lanes: int) -> Vec3:
    """The `lanes` vectors of a batch, which begin with the vector of index `start`, as a Dr.Jit
    vector.

    vectors: all vectors: a Dr.Jit vector, or an array (n, 3).
    """
    if dr.is_array_v(cast("Any", type(vectors))):
        return dr.gather(backend.Array3f, vectors, dr.arange(backend.UInt32, lanes) + start)
    return upload_vectors(backend, vectors[start : start + lanes], "points")


def _repeat_single_row(values: npt.NDArray[Any], n: int) -> npt.NDArray[Any]:
    """The values as an array of n rows. If `compute` returned a single row because the result is
    the same for all points, the row is repeated."""
    return values if len(values) == n else np.repeat(values, n, axis=0)


def _restore_order(values: Any, order: Any, n: int) -> Any:
    """Values of points, put back into the original order of the points.

    values: a Dr.Jit array, or a vector or matrix of such arrays, in the order in which the points
        were visited.
    order: for each visited point, its index in the original order.
    n: the number of points.
    """
    kind = cast("Any", type(values))
    if dr.depth_v(kind) == 1:
        restored = dr.zeros(kind, n)
        dr.scatter(restored, values, order)
        return restored
    return kind([_restore_order(component, order, n) for component in values])


def morton_order(backend: Backend, x: Vec3, bits: int = _BITS_PER_AXIS) -> Any:
    """The order in which points x are visited cell by cell along a Morton curve, as the indices of
    the points (a Dr.Jit UInt32).

    The box of the points is cut into 2^bits cells along its longest side. The key of a cell
    interleaves the bits of its three indices; points are sorted by their keys.

    bits: at most 10.
    """
    index, vector = backend.UInt32, backend.Array3f
    n = dr.width(x)
    if n < 2:
        return dr.arange(index, n)
    lower = vector(*(dr.min(coordinate) for coordinate in x))
    sides = [dr.max(x[k]) - lower[k] for k in range(3)]
    size = dr.maximum(dr.maximum(sides[0], sides[1]), sides[2])
    # A little less than 2^bits, so that the largest coordinate falls into the last cell.
    scale = (2**bits - 1e-3) / dr.maximum(size, 1e-30)
    key = index(0)
    for axis in range(3):
        cell = index((x[axis] - lower[axis]) * scale)
        for bit in range(bits):
            # Bit b of axis k becomes bit 3 b + k of the key.
            key |= (cell & (1 << bit)) << (2 * bit + axis)
    # NumPy sorts keys of 16 bits faster.
    keys = to_numpy(key).astype(np.uint16 if 3 * bits <= 16 else np.uint32)
    return upload_integers(backend, np.argsort(keys, kind="stable"))
