"""Fields that can be evaluated at large numbers of points at once, and caches that live as long as
a field. A field is a function f of space. `BatchedField` gives its values, derivatives and error
bounds at NumPy points, as NumPy arrays. The computation itself is a Dr.Jit kernel, with one point
per lane. Many such fields are sums over sources in a tree, where a far cluster of sources is
approximated as one source; this causes a truncation error. `FieldCache` and `cached_prepare` cache
results that are computed or uploaded once per field."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast
from weakref import finalize

import drjit as dr

from harnack.backend import FloatArray, backend_of
from harnack.backend.arrays import as_kernel_parameters
from harnack.backend.elementary import fmax
from harnack.backend.tensors import accepts_tensors
from harnack.cluster.dask_arrays import accepts_dask_arrays
from harnack.fields.batch_evaluation import evaluate_points
from harnack.fields.field import EvaluateOnly, Field

if TYPE_CHECKING:
    from harnack.backend import Backend, Precision, Real, Vec3
    from harnack.fields.samples import Sample

# A bound of the rounding of the sums of dipoles' moments, as a fraction of the total weight. The
# sums are made in double precision.
_MOMENT_ROUNDING = 32 * 2.0**-53


@dataclass(frozen=True)
class SymmetricMatrix:
    """A symmetric 3 x 3 matrix in each lane, as a record of its six entries xx, yy, zz, xy, xz, yz.
    Loops that add up such matrices (Hessians) keep it in their state."""

    xx: Real
    yy: Real
    zz: Real
    xy: Real
    xz: Real
    yz: Real

    @classmethod
    def zero(cls, real: Any) -> SymmetricMatrix:
        """The matrix of zeros.

        real: the type of its entries, such as a Dr.Jit Float.
        """
        return cls(*(real(0) for _ in range(6)))

    def add_outer_product(self, u: Vec3, v: Vec3) -> SymmetricMatrix:
        """This matrix plus the symmetric matrix (u v^T + v u^T)/2."""
        half = 0.5 * v
        return SymmetricMatrix(
            dr.fma(u.x, v.x, self.xx),
            dr.fma(u.y, v.y, self.yy),
            dr.fma(u.z, v.z, self.zz),
            self.xy + dr.fma(u.x, half.y, u.y * half.x),
            self.xz + dr.fma(u.x, half.z, u.z * half.x),
            self.yz + dr.fma(u.y, half.z, u.z * half.y),
        )

    def components(self) -> tuple[Real, ...]:
        """The six entries in the order of the constructor, as a tuple for the state of a loop."""
        return self.xx, self.yy, self.zz, self.xy, self.xz, self.yz

    def rows(self, vector: Any) -> tuple[Vec3, Vec3, Vec3]:
        """The three rows of the matrix.

        vector: the type of a row, a Dr.Jit 3-vector.
        """
        return (
            vector(self.xx, self.xy, self.xz),
            vector(self.xy, self.yy, self.yz),
            vector(self.xz, self.yz, self.zz),
        )


@dataclass(frozen=True)
class PointValues:
    """The value of a field's function f at points and, if requested, its gradient and Hessian, with
    bounds of their truncation and rounding errors. All are Dr.Jit arrays, with one point per lane.

    error: a bound of the error of `value`.
    gradient, hessian: None if they were not requested.
    gradient_error: a bound of the error of `gradient`, as a length.
    hessian_error: a bound of the error of the second derivative along any line, which is the
        spectral norm of the Hessian's error.
    """

    value: Real
    error: Real
    gradient: Vec3 | None = None
    hessian: SymmetricMatrix | None = None
    gradient_error: Real = 0.0
    hessian_error: Real = 0.0

    def with_far_field_errors(self, x: Vec3, terms: int, weight: float) -> PointValues:
        """The same values, with error bounds that also hold at points far away from the field's
        data. These values are a sum over dipoles.

        x: the points, in coordinates in which the field's data have a size of about 1.
        terms: the number of terms that were summed.
        weight: the sum of the absolute weights of all dipoles (the factors of their values).

        Two errors matter only far away. First, a term of a derivative is the product of a factor
        that falls like |x|^-5 and one that grows like |x|^2, and the first may underflow. Second,
        where dipoles nearly cancel, the rounding of their summed moments is proportional to the
        weight of all dipoles, not to the small sum.
        """
        smallest = float(dr.smallest(type(x.x)))
        underflow = 4 * smallest * terms * (1 + dr.squared_norm(x))
        # Nearer than 4 the second error does not matter, so |x| counts as at least 4.
        inverse = dr.rcp(fmax(dr.norm(x), type(x.x)(4)))
        moment_error = _MOMENT_ROUNDING * weight * dr.square(inverse)
        return dataclasses.replace(
            self,
            error=self.error + underflow + moment_error,
            gradient_error=self.gradient_error + underflow + 4 * moment_error * inverse,
            hessian_error=self.hessian_error + underflow + 24 * moment_error * dr.square(inverse),
        )

    def rescaled(self, size: Real) -> PointValues:
        """The values of the scaled function g(x) = f(x / size) at the points `size` times x, from
        these values of f at x. Where a number has overflowed, its error is infinite."""
        gradient, hessian, inverse = self.gradient, self.hessian, 1 / size
        gradient_error, hessian_error = self.gradient_error, self.hessian_error
        if gradient is not None:
            gradient = gradient * inverse
            is_finite = dr.isfinite(gradient.x) & dr.isfinite(gradient.y) & dr.isfinite(gradient.z)
            # By the chain rule derivatives of order k are divided by size^k.
            gradient_error = dr.select(is_finite, gradient_error * inverse, dr.inf)
        if hessian is not None:
            hessian = type(hessian)(*(inverse * inverse * entry for entry in hessian.components()))
            is_finite = dr.isfinite(sum(hessian.components()))
            hessian_error = dr.select(is_finite, hessian_error * (inverse * inverse), dr.inf)
        error = dr.select(dr.isfinite(self.value), self.error, dr.inf)
        return PointValues(self.value, error, gradient, hessian, gradient_error, hessian_error)


class BatchedField(Field):
    """A field whose values, derivatives and error bounds can be evaluated at large numbers of
    points at once. Points are either Dr.Jit 3-vectors, one point per lane, or NumPy arrays (n, 3),
    for which results are NumPy arrays. Many such fields are sums over sources in a tree, in which a
    far cluster of sources is approximated as one source; this causes a truncation error. Subclasses
    define `values_at`."""

    @abc.abstractmethod
    def values_at(self, x: Vec3, derivatives: int, closer: Real = 1.0) -> PointValues:
        """Values of f at points x, with error bounds and, if requested, derivatives. x is a Dr.Jit
        3-vector of any backend and precision.

        derivatives: 0 for values only, 1 for gradients too, 2 for Hessians too.
        closer: the accuracy scale, at least 1; larger is more accurate. It multiplies the distance
            from which on a cluster of sources is approximated. With infinity nothing is
            approximated.

        It is not called while a loop is being recorded, unless `derivatives` is 2.
        """

    def sharp_values_at(self, x: Vec3) -> PointValues:
        """Values and gradients at points x, as accurate as `gradient` returns them to users. The
        default is `values_at`; subclasses may compute the gradient more accurately (`sharpened`).
        It is not called while a loop is being recorded."""
        return self.values_at(x, 1)

    def differentiable_value(self, p: Vec3) -> Real:
        """f at p as an expression that Dr.Jit can differentiate once with respect to p, in reverse
        and in forward mode. Its derivative is the gradient of `sharp_values_at`."""
        with dr.suspend_grad():
            at = self.sharp_values_at(dr.detach(p))
        # Dr.Jit would drop a gradient that is the literal 0, such as that of a closed mesh, and
        # with it the dependence on p. A kernel parameter is no literal.
        return dr.replace_grad(
            at.value, dr.dot(as_kernel_parameters(at.gradient), p - dr.detach(p))
        )

    @accepts_dask_arrays("points")
    @accepts_tensors
    def value(self, points: Any, *, precision: Precision | None = None) -> Any:
        if dr.is_array_v(type(points)):
            if dr.grad_enabled(points):
                return self.differentiable_value(points)
            return self.values_at(points, 0).value
        return self._choose_at_points(points, precision, 0, lambda at: (at.value,))[0]

    @accepts_dask_arrays("points")
    @accepts_tensors
    def gradient(self, points: Any, *, precision: Precision | None = None) -> Any:
        if dr.is_array_v(type(points)):
            if dr.grad_enabled(points):
                return super().gradient(points)
            return self.sharp_values_at(points).gradient
        return self._choose_at_points(points, precision, 1, lambda at: (at.gradient,))[0]

    def value_and_gradient(
        self, points: Any, *, precision: Precision | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the values (n,) and the gradients (n, 3) of f at points (n, 3), as NumPy arrays.
        Together they take hardly more time than gradients alone.

        precision: "single" or "double"; None for that of the points.
        """
        value, gradient = self._choose_at_points(
            points, precision, 1, lambda at: (at.value, at.gradient)
        )
        return value, gradient

    def rough_value_and_gradient(
        self, points: Any, *, precision: Precision | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the values (n,) and the gradients (n, 3) at points (n, 3), by a single pass over
        the tree of sources. The gradients may have large errors, so they are for estimates only, or
        for points where f is so steep that the errors do not matter.

        precision: "single" or "double"; None for that of the points.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """The values, then the gradients, at the Dr.Jit points x."""
            del backend
            at = self.values_at(x, 1)
            return at.value, at.gradient

        value, gradient = evaluate_points(points, kernel, precision)
        return value, gradient

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return _required_hessian(self.values_at(p, 2)).rows(backend_of(p).Array3f)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return sample.gradient_error, self.values_at(p, 2).hessian_error

    @accepts_dask_arrays("points")
    def error_bound(self, points: Any, *, precision: Precision | None = None) -> FloatArray:
        """Bounds (n,) of the error of `value` at points (n, 3). They include the proved truncation
        error and the rounding error of f. They do not include the change of f by rounding the
        points to single precision.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 0, lambda at: (at.error,))[0]

    @accepts_dask_arrays("points")
    def gradient_error_bound(
        self, points: Any, *, precision: Precision | None = None
    ) -> FloatArray:
        """Bounds (n,) of the error of `gradient`, as a length, at points (n, 3). They include the
        proved truncation error and the rounding error. They do not include the change of the
        gradient by rounding the points.

        For a sum over a tree the bound is about a hundred times the error itself: the sum is made
        only as accurate as an estimate of the error demands (`sharpened`), and the proved bound is
        far larger than the estimate.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 1, lambda at: (at.gradient_error,))[0]

    @accepts_dask_arrays("points")
    def hessian_error_bound(self, points: Any, *, precision: Precision | None = None) -> FloatArray:
        """Bounds (n,) of the error of `hessian`, in the spectral norm, at points (n, 3). They
        include the proved truncation error and the rounding error. They do not include the change
        of the Hessian by rounding the points.

        precision: "single" or "double"; None for that of the points.
        """
        return self._choose_at_points(points, precision, 2, lambda at: (at.hessian_error,))[0]

    def _choose_at_points(
        self,
        points: Any,
        precision: Precision | None,
        derivatives: int,
        choose: Callable[[PointValues], tuple[Any, ...]],
    ) -> tuple[FloatArray, ...]:
        """Evaluate the field at points (n, 3) or (3,), and return the results that `choose`
        selects, as a tuple of NumPy arrays in the order of the points.

        precision: "single", "double", or None for that of the points.
        derivatives: the order up to which derivatives are computed, 0 to 2.
        choose: a function that takes the `PointValues` of a batch of points and returns the wanted
            Dr.Jit arrays.
        """

        def kernel(backend: Backend, x: Vec3) -> tuple[Any, ...]:
            """The tuple that `choose` selects from the values at the Dr.Jit points x. If gradients
            but no Hessians are asked for, the gradients are computed more accurately, by
            `sharp_values_at`."""
            del backend
            sharp = derivatives == 1
            return choose(self.sharp_values_at(x) if sharp else self.values_at(x, derivatives))

        return evaluate_points(points, kernel, precision)


class SumAtDetail(EvaluateOnly):
    """A sum over sources, sampled at one accuracy scale (larger is more accurate; the parameter of
    `VariableAccuracy.at`), with second derivatives. It is made of two functions of a point
    p, a Dr.Jit 3-vector.

    evaluate: returns the sample at p: value, gradient and proved bounds of f near p.
    values: returns the `PointValues` at p with the Hessian, at the same accuracy scale.
    """

    def __init__(
        self, evaluate: Callable[[Vec3], Sample], values: Callable[[Vec3], PointValues]
    ) -> None:
        super().__init__(evaluate)
        self._values = values

    def hessian(self, p: Vec3) -> tuple[Vec3, Vec3, Vec3]:
        return _required_hessian(self._values(p)).rows(backend_of(p).Array3f)

    def derivative_errors(self, p: Vec3, sample: Sample) -> tuple[Real, Real]:
        return sample.gradient_error, self._values(p).hessian_error


# Accuracy scales at which the gradient of a sum over a tree is computed again: multiples of the
# distance from which on a cluster is taken as one source. The next scale is used if the last one
# changed the gradient by more than the fraction `_MAX_CHANGE` of its length. (Measured: twice the
# distance leaves a sixteenth of the error or less. So the remaining error is below 1 % of the
# length, with a reserve of a factor of four.)
_DISTANCE_MULTIPLES, _MAX_CHANGE = (2.0, 4.0, 8.0), 0.04
# A gradient is not refined if its error is proved to be at most this fraction of its length.
_ACCEPTED_ERROR = 0.01


def sharpened(at: Callable[[Vec3, Real], PointValues], x: Vec3) -> PointValues:
    """Values and gradients of a sum over a tree at points x, where gradients are summed so
    accurately that their errors are about 1 % of their lengths.

    at: a function that takes points and an accuracy scale, and returns values and gradients there.
        The scale multiplies the distance from which on a cluster of sources counts as one source.
        The values are those for the scale 1; for the gradients the scale is raised where needed.

    Far terms may nearly cancel, as the triangles of a mesh with small holes do. Then the gradient
    is far smaller than the truncation errors of its clusters. Proved bounds of these errors add up
    absolute values, and would demand that all terms are summed nearly everywhere. So the observed
    change of the gradient from one scale to the next decides whether to refine it further. The
    error bounds that are returned stay proved.
    """
    real = cast("Any", type(x.x))
    dr.eval(x)
    # The scale is a kernel parameter, so that all scales use the same compiled kernel.
    values = at(x, dr.opaque(real, 1.0))
    gradient, error = as_kernel_parameters(values.gradient), real(values.gradient_error)
    # Adding zeros gives arrays of full width, one number per lane, which can be scattered into.
    gradient, error = gradient + dr.zeros(type(x), dr.width(x)), error + dr.zeros(real, dr.width(x))
    dr.eval(values.value, values.error, gradient, error)
    # The indices of the points whose gradient is to be refined.
    # (Written with ~, so that NaN counts as not accurate.)
    rows = dr.compress(~(error <= _ACCEPTED_ERROR * dr.norm(gradient)))
    for closer in _DISTANCE_MULTIPLES:
        if not len(rows):
            break
        points = dr.gather(type(x), x, rows)
        dr.eval(points)
        refined = at(points, dr.opaque(real, closer))
        change = dr.norm(refined.gradient - dr.gather(type(x), gradient, rows))
        length = dr.norm(as_kernel_parameters(refined.gradient))
        # Accurate enough by the observed change, or by the proved bound.
        is_accurate = (change <= _MAX_CHANGE * length) | (
            refined.gradient_error <= _ACCEPTED_ERROR * length
        )
        dr.scatter(gradient, refined.gradient, rows)
        dr.scatter(error, refined.gradient_error, rows)
        dr.eval(gradient, error, is_accurate)
        rows = dr.gather(type(rows), rows, dr.compress(~is_accurate))
        dr.eval(rows)
    return dataclasses.replace(values, gradient=gradient, gradient_error=error)


def _required_hessian(values: PointValues) -> SymmetricMatrix:
    """The Hessian in `values`, which must have been computed with second derivatives.

    Raises:
        RuntimeError: they were computed without second derivatives.
    """
    if values.hessian is None:
        raise RuntimeError("values_at(x, 2) gave no Hessian")
    return values.hessian


Prepare = TypeVar("Prepare", bound=Callable[..., Field])
Value = TypeVar("Value")


class FieldCache(Generic[Value]):
    """A cache that keeps one value for each field, together with the key for which the value was
    made. If the value is requested for another key, it is made again and replaced. It is dropped
    when the field is deleted.

    A value must not refer to its field, or neither of them would ever be deleted.
    """

    def __init__(self) -> None:
        # For each field, by its identity (`id`): the key, the field's attributes when the value was
        # made, and the value. (A user's field may have no hash, or equal another one.)
        self._kept: dict[int, tuple[Any, dict[str, Any], Value]] = {}

    def get(self, field: Field, key: Any, make: Callable[[], Value]) -> Value:
        """The value of a field for this key. It is the cached value if that was made for the same
        key, and no attribute of the field was set since then. Otherwise it is the result of make(),
        which is then cached. (A value that is the field itself is not cached, as it would keep the
        field alive.)"""
        if id(field) in self._kept:
            kept_key, attributes, value = self._kept[id(field)]
            now = vars(field)
            same = attributes.keys() == now.keys()
            # Attributes are compared by identity: it is fast, and arrays have no single truth value
            # of ==.
            if same and kept_key == key and all(attributes[name] is now[name] for name in now):
                return value
        value = make()
        if value is not field:
            if id(field) not in self._kept:
                # Drop the value when the field is deleted.
                finalize(field, self._kept.pop, id(field), None).atexit = False
            self._kept[id(field)] = key, {**vars(field)}, value
        return value


def cached_prepare(prepare: Prepare) -> Prepare:
    """Decorator of a field's method `prepare`, which uploads the field's data to a backend. The
    decorated method uploads a field only once to each backend.

    A field with parameters is uploaded at each call: a parameter may change in place, and its
    derivatives belong to a single trace.
    """
    # For each backend a cache of prepared fields, without keys.
    caches: defaultdict[Backend, FieldCache[Field]] = defaultdict(FieldCache)

    @functools.wraps(prepare)
    def cached(self: Field, backend: Backend) -> Field:
        """The prepared field: the cached one, unless the field has parameters."""
        if self.differentiable_parameters():
            return prepare(self, backend)
        return caches[backend].get(self, None, lambda: prepare(self, backend))

    return cast("Prepare", cached)
